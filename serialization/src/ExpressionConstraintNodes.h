// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONCONSTRAINTNODES_H_
#define OPENMMVRATTLE_EXPRESSIONCONSTRAINTNODES_H_

#include "openmm/serialization/SerializationNode.h"
#include "openmmvrattle/ConstrainedIntegrator.h"
#include "run/IntegratorSettings.h"
#include <vector>

namespace OpenMMVRattle {

/** Write the constraints of addConstraint() into a child of an integrator's node, if there are any. */
void writeExpressionConstraints(const std::vector<ExpressionConstraint>& expressions, OpenMM::SerializationNode& node);
/** Add the constraints of an integrator's node, if there are any, to an integrator. */
void readExpressionConstraints(const OpenMM::SerializationNode& node, ConstrainedIntegrator& integrator);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONCONSTRAINTNODES_H_
