// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_DISTANCECONSTRAINT_H_
#define OPENMMVRATTLE_DISTANCECONSTRAINT_H_

namespace OpenMMVRattle {

/** The distance between two particles is fixed: |q1 - q2| = length (nm). */
struct DistanceConstraint {
    int particle1, particle2;
    double length;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_DISTANCECONSTRAINT_H_
