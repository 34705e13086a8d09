// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STARTCHECK_H_
#define OPENMMVRATTLE_STARTCHECK_H_

#include "constraints/ConstraintSystem.h"
#include "openmm/System.h"
#include "openmm/Vec3.h"
#include <vector>

namespace OpenMMVRattle {

/** What a run is to start from. */
struct StartState {
    const std::vector<OpenMM::Vec3>&positions, &velocities;
    /** The three vectors of the periodic box in OpenMM's reduced form, which every System has, whether it means anything or not. */
    const OpenMM::Vec3* boxVectors;
    /** Of the expressions. */
    const ExpressionParameters& parameters;
};

/**
 * Refuse a state from which a run would go wrong without a word: positions or velocities that are no numbers, velocities that
 * no motion has, and molecules that are not whole. It is called before the state is moved onto the constraints, which
 * would drag the parts of such a molecule together.
 *
 * @throws StepFailure    which names the particles and the way out
 */
void requireSoundStart(const OpenMM::System& system, const ConstraintSystem& constraints, const StartState& state);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STARTCHECK_H_
