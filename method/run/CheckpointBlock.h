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
     * @return whether there are any; if not, for the stream holds something else here or nothing, it is left where it was
     * @throws OpenMMException    if they are of another version, or less than what was written
     */
    static bool read(std::istream& stream, std::string& data);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CHECKPOINTBLOCK_H_
