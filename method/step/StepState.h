// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPSTATE_H_
#define OPENMMVRATTLE_STEPSTATE_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <vector>

namespace OpenMMVRattle {

/** An on-step state, and what is known of the step that has led to it. */
struct StepState {
    explicit StepState(const ConstraintSystem& system) :
            q(system.getNumParticles()), v(q), w(q), force(q), theta(system.getGivenParameters()),
            lambda(system.getNumConstraints()), rightSide(lambda), offset{lambda, lambda} {
    }
    std::vector<OpenMM::Vec3> q, v, w, force; // q[n], M^-1 p[n], M^-1 p[n-1/2] and F(q[n])
    ExpressionParameters theta;               // theta[n], with the rates of the step
    std::vector<double> lambda, rightSide;    // Lambda(q[n],p[n]) and K Lambda
    ConstraintSolver::Offset offset;          // lambda and Lambda of the last regular step
    double groupEnergy = 0;                   // of the monitor's force group at q[n]
    std::vector<double> values, forceParts;   // U_k(q[n],p[n]), and what of each the forces alone are
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPSTATE_H_
