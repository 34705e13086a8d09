// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPS_H_
#define OPENMMVRATTLE_STEPS_H_

#include "Examples.h"
#include "run/VRattleRun.h"
#include <cmath>
#include <vector>

namespace OpenMMVRattle {

/** Whole steps in the field of forcesAt(). */
inline void takeSteps(VRattleRun& dynamics, int steps) {
    for (int i = 0; i < steps; i++) {
        std::vector<OpenMM::Vec3> forces;
        do {
            dynamics.step(INFINITY);
            forces = forcesAt(dynamics.getNextPositions());
        } while (!dynamics.finish(forces, 0));
    }
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPS_H_
