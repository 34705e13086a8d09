// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CHORDITERATION_H_
#define OPENMMVRATTLE_CHORDITERATION_H_

namespace OpenMMVRattle {

/** When an iteration with one matrix for (3.11) ends. What it has not solved by then is left to Newton's iteration. */
struct ChordIteration {
    static constexpr int MAX_UPDATES = 12;
    double aim; // the largest error that is small enough
    /**
     * When there has been at least one update, since Lambda itself, unrefined, costs accuracy even where it meets the tolerance, and the
     * error is small enough, or no longer reduced, so that it is rounding, or the caller's to deal with.
     *
     * @param error       the largest of all errors after so many updates
     * @param previous    that of one update before
     */
    bool isOver(int numUpdates, double error, double previous) const {
        return numUpdates > 0 && (error <= aim || !(error < 0.5 * previous) || numUpdates == MAX_UPDATES);
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CHORDITERATION_H_
