// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleIntegratorProxy.h"
#include "ExpressionConstraintNodes.h"
#include "openmm/OpenMMException.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegratorProxy.h"
#include "run/IntegratorSettings.h"
#include <memory>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using OpenMM::SerializationNode;
using OpenMM::SerializationProxy;

namespace {

const int VERSION =
    3; // 2: automatic step control, constraints by expressions; 3: default monitor, order of each monitor
const char MINIMUM_STEP[] = "minimumStepSize", MAXIMUM_STEP[] = "maximumStepSize";
const char AUTOMATIC_CONTROL[] = "AutomaticStepControl";
const char* const AUTOMATIC_REFERENCES[] = {"onStepReference", "halfStepReference"};

} // namespace

VariableStepRattleIntegratorProxy::VariableStepRattleIntegratorProxy() :
        SerializationProxy("VariableStepRattleIntegrator") {
}

void VariableStepRattleIntegratorProxy::serialize(const void* object, SerializationNode& node) const {
    const IntegratorSettings& settings = *static_cast<const VariableStepRattleIntegrator*>(object)->settings;
    node.setIntProperty("version", VERSION);
    node.setDoubleProperty("stepSize", settings.stepSize);
    if (settings.minimumStep != IntegratorSettings::USE_DEFAULT)
        node.setDoubleProperty(MINIMUM_STEP, settings.minimumStep);
    if (settings.maximumStep != IntegratorSettings::USE_DEFAULT)
        node.setDoubleProperty(MAXIMUM_STEP, settings.maximumStep);
    node.setDoubleProperty("constraintTolerance", settings.tolerance);
    node.setIntProperty("integrationForceGroups", settings.forceGroups);
    node.setIntProperty("updateMethod", settings.update);
    node.setDoubleProperty("normOrder", settings.normOrder);
    node.setIntProperty("monitorForceGroup", settings.monitorForceGroup);
    SerializationNode& monitors = node.createChildNode("Monitors");
    monitors.setBoolProperty("areDefault", settings.isDefaultMonitor);
    for (const StepMonitor::Term& monitor : settings.terms)
        monitors.createChildNode("Monitor")
            .setIntProperty("kind", monitor.kind)
            .setDoubleProperty("weight", monitor.weight)
            .setDoubleProperty("power", monitor.power)
            .setDoubleProperty("order", monitor.order)
            .setDoubleProperty("reference", monitor.reference);
    if (settings.isAutomatic) {
        SerializationNode& automatic = node.createChildNode(AUTOMATIC_CONTROL);
        automatic.setIntProperty("calibrationSteps", settings.calibrationSteps);
        for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
            automatic.setDoubleProperty(AUTOMATIC_REFERENCES[k], settings.automaticReferences[k]);
    }
    writeExpressionConstraints(settings.expressions, node);
}

// Through the integrator's functions, which refuse what is wrong.
void* VariableStepRattleIntegratorProxy::deserialize(const SerializationNode& node) const {
    const int version = node.getIntProperty("version");
    if (version < 1 || version > VERSION)
        throw OpenMMException("VariableStepRattleIntegrator: the settings are written in version " +
                              std::to_string(version) + " of their format and this plugin reads version " +
                              std::to_string(VERSION) +
                              "; use the version of the plugin that wrote them, or a newer one");
    auto integrator = std::make_unique<VariableStepRattleIntegrator>(node.getDoubleProperty("stepSize"));
    if (node.hasProperty(MINIMUM_STEP))
        integrator->setMinimumStepSize(node.getDoubleProperty(MINIMUM_STEP));
    if (node.hasProperty(MAXIMUM_STEP))
        integrator->setMaximumStepSize(node.getDoubleProperty(MAXIMUM_STEP));
    integrator->setConstraintTolerance(node.getDoubleProperty("constraintTolerance"));
    integrator->setIntegrationForceGroups(node.getIntProperty("integrationForceGroups"));
    integrator->setUpdateMethod((VariableStepRattleIntegrator::UpdateMethod) node.getIntProperty("updateMethod"));
    integrator->setNormOrder(node.getDoubleProperty("normOrder"));
    integrator->setMonitorForceGroup(node.getIntProperty("monitorForceGroup"));
    const SerializationNode& monitors = node.getChildNode("Monitors");
    integrator->clearMonitors();
    for (const SerializationNode& monitor : monitors.getChildren()) {
        const auto kind = (VariableStepRattleIntegrator::MonitorKind) monitor.getIntProperty("kind");
        const int index =
            integrator->addMonitor(kind, monitor.getDoubleProperty("weight"), monitor.getDoubleProperty("power"),
                                   monitor.getDoubleProperty("order", 0.0));
        integrator->setReferenceMonitorValue(monitor.getDoubleProperty("reference"), index);
    }
    integrator->settings->isDefaultMonitor =
        monitors.getBoolProperty("areDefault", false) && integrator->getNumMonitors() == 1;
    for (const SerializationNode& child : node.getChildren()) {
        if (child.getName() == AUTOMATIC_CONTROL) {
            integrator->useAutomaticStepControl(child.getIntProperty("calibrationSteps"));
            for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
                integrator->setReferenceMonitorValue(child.getDoubleProperty(AUTOMATIC_REFERENCES[k]), k);
        }
    }
    readExpressionConstraints(node, *integrator);
    return integrator.release();
}

void registerVRattleSerializationProxies() {
    SerializationProxy::registerProxy(typeid(VariableStepRattleIntegrator), new VariableStepRattleIntegratorProxy());
    SerializationProxy::registerProxy(typeid(VariableStepRattleLangevinIntegrator),
                                      new VariableStepRattleLangevinIntegratorProxy());
}

namespace {

// Whoever loads the library, a C++ program, OpenMM's plugin loader or Python, needs no call.
const bool areProxiesRegistered = [] {
    registerVRattleSerializationProxies();
    return true;
}();

} // namespace
