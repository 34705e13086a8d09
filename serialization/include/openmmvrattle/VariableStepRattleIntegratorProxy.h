// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VARIABLESTEPRATTLEINTEGRATORPROXY_H_
#define OPENMMVRATTLE_VARIABLESTEPRATTLEINTEGRATORPROXY_H_

#include "openmm/serialization/SerializationProxy.h"

namespace OpenMMVRattle {

/**
 * Writes the settings of a VariableStepRattleIntegrator to a SerializationNode, and makes a new integrator of them, for
 * OpenMM's XmlSerializer. The same text carries the settings in checkpoints and States.
 *
 * A step bound that was not set is not written, so that it goes on following the nominal step size.
 */
class VariableStepRattleIntegratorProxy : public OpenMM::SerializationProxy {
public:
    VariableStepRattleIntegratorProxy();
    void serialize(const void* object, OpenMM::SerializationNode& node) const override;
    void* deserialize(const OpenMM::SerializationNode& node) const override;
};

} // namespace OpenMMVRattle

/** Make our classes known to OpenMM's XmlSerializer. This happens by itself when the library is loaded. */
extern "C" void registerVRattleSerializationProxies();

#endif // OPENMMVRATTLE_VARIABLESTEPRATTLEINTEGRATORPROXY_H_
