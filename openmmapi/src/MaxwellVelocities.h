// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_MAXWELLVELOCITIES_H_
#define OPENMMVRATTLE_MAXWELLVELOCITIES_H_

#include "openmm/System.h"
#include "openmm/Vec3.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * Draw velocities (nm/ps) from the Maxwell distribution of free particles; those without mass have none. Their projection onto the
 * constraints in the metric of the masses is distributed as Maxwell's distribution on the constraints.
 *
 * @param system         gives the masses
 * @param temperature    in K
 * @param seed           gives the same velocities each time, with every compiler
 */
std::vector<OpenMM::Vec3> drawMaxwellVelocities(const OpenMM::System& system, double temperature, int seed);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MAXWELLVELOCITIES_H_
