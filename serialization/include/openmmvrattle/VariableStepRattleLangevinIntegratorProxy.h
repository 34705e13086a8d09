// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VARIABLESTEPRATTLELANGEVININTEGRATORPROXY_H_
#define OPENMMVRATTLE_VARIABLESTEPRATTLELANGEVININTEGRATORPROXY_H_

#include "openmm/serialization/SerializationProxy.h"

namespace OpenMMVRattle {

/**
 * Writes the settings of a VariableStepRattleLangevinIntegrator to a SerializationNode, and makes a new integrator of them, for
 * OpenMM's XmlSerializer. The same text carries the settings in checkpoints and States.
 */
class VariableStepRattleLangevinIntegratorProxy : public OpenMM::SerializationProxy {
public:
    VariableStepRattleLangevinIntegratorProxy();
    void serialize(const void* object, OpenMM::SerializationNode& node) const override;
    void* deserialize(const OpenMM::SerializationNode& node) const override;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VARIABLESTEPRATTLELANGEVININTEGRATORPROXY_H_
