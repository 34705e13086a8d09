// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CHECKPOINTBLOCK_H_
#define OPENMMVRATTLE_CHECKPOINTBLOCK_H_

#include <iosfwd>
#include <string>

namespace OpenMMVRattle {

/**
 * The frame of our data in OpenMM's checkpoints: a mark, the version of the format, the length of the data and their
 * fingerprint, and the data. Other data may stand before and behind it.
 */
class CheckpointBlock {
public:
    static void write(std::ostream& stream, const std::string& data);
    /**
     * Read the data, and nothing beyond them.
     *
     * @throws OpenMMException    if the stream holds something else, another version, or less than what was written
     */
    static std::string read(std::istream& stream);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CHECKPOINTBLOCK_H_
