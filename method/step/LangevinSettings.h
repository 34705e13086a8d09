// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_LANGEVINSETTINGS_H_
#define OPENMMVRATTLE_LANGEVINSETTINGS_H_

namespace OpenMMVRattle {

/** What a user can choose of dynamics at constant temperature, beside the step and the tolerance of the constraints. */
struct LangevinSettings {
    static constexpr int DEFAULT_DOUBLINGS = 10;
    static constexpr int MAX_DOUBLINGS = 20;

    double temperature = 0;                // K
    double friction = 0;                   // 1/ps
    int randomSeed = 0;                    // 0: each Context has another one
    int randomStream = 0;                  // its place in a CompoundIntegrator; each has noise of its own
    int maxDoublings = DEFAULT_DOUBLINGS;  // k_max: a step may be made of 2^k_max + 1 substeps, and of one for 0
    double reference = 0;                  // U_ref; 0 to let it follow the run
    bool isReferenceFrozen = false;        // it stays what it is

    /** The substeps that a step is made of for k, always odd. */
    static int getSubsteps(int doublings) {
        return doublings == 0 ? 1 : (1 << doublings) + 1;
    }
    int getMaximumSubsteps() const {
        return getSubsteps(maxDoublings);
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_LANGEVINSETTINGS_H_
