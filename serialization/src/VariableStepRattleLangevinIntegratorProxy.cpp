// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleLangevinIntegratorProxy.h"
#include "ExpressionConstraintNodes.h"
#include "openmm/OpenMMException.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include "run/IntegratorSettings.h"
#include <memory>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using OpenMM::SerializationNode;
using OpenMM::SerializationProxy;

namespace {

const int VERSION = 1;

} // namespace

VariableStepRattleLangevinIntegratorProxy::VariableStepRattleLangevinIntegratorProxy() :
        SerializationProxy("VariableStepRattleLangevinIntegrator") {
}

void VariableStepRattleLangevinIntegratorProxy::serialize(const void* object, SerializationNode& node) const {
    const IntegratorSettings& settings = *static_cast<const VariableStepRattleLangevinIntegrator*>(object)->settings;
    node.setIntProperty("version", VERSION);
    node.setDoubleProperty("stepSize", settings.stepSize);
    node.setDoubleProperty("constraintTolerance", settings.tolerance);
    node.setIntProperty("integrationForceGroups", settings.forceGroups);
    node.setDoubleProperty("temperature", settings.langevin->temperature);
    node.setDoubleProperty("friction", settings.langevin->friction);
    node.setIntProperty("randomSeed", settings.langevin->randomSeed);
    node.setIntProperty("maximumSubsteps", settings.langevin->getMaximumSubsteps());
    node.setDoubleProperty("reference", settings.langevin->reference);
    node.setBoolProperty("isReferenceFrozen", settings.langevin->isReferenceFrozen);
    writeExpressionConstraints(settings.expressions, node);
}

// Through the integrator's functions, which refuse what is wrong.
void* VariableStepRattleLangevinIntegratorProxy::deserialize(const SerializationNode& node) const {
    const int version = node.getIntProperty("version");
    if (version != VERSION)
        throw OpenMMException("VariableStepRattleLangevinIntegrator: the settings are written in version " +
                              std::to_string(version) + " of their format and this plugin reads version " +
                              std::to_string(VERSION) + "; use the version of the plugin that wrote them");
    auto integrator = std::make_unique<VariableStepRattleLangevinIntegrator>(
        node.getDoubleProperty("temperature"), node.getDoubleProperty("friction"), node.getDoubleProperty("stepSize"));
    integrator->setConstraintTolerance(node.getDoubleProperty("constraintTolerance"));
    integrator->setIntegrationForceGroups(node.getIntProperty("integrationForceGroups"));
    integrator->setRandomNumberSeed(node.getIntProperty("randomSeed"));
    integrator->setMaximumSubsteps(node.getIntProperty("maximumSubsteps"));
    integrator->setReferenceMonitorValue(node.getDoubleProperty("reference"));
    integrator->freezeReference(node.getBoolProperty("isReferenceFrozen"));
    readExpressionConstraints(node, *integrator);
    return integrator.release();
}
