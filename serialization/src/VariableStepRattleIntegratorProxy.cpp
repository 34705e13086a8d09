// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleIntegratorProxy.h"
#include "openmm/OpenMMException.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include <map>
#include <memory>
#include <string>
#include <vector>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using OpenMM::SerializationNode;
using OpenMM::SerializationProxy;

namespace {

const int VERSION = 2; // 2: automatic step control, constraints by expressions
const char MINIMUM_STEP[] = "minimumStepSize", MAXIMUM_STEP[] = "maximumStepSize";
const char AUTOMATIC_CONTROL[] = "AutomaticStepControl", EXPRESSION_CONSTRAINTS[] = "ExpressionConstraints";
const char* const AUTOMATIC_REFERENCES[] = {"onStepReference", "halfStepReference"};

void writeExpressionConstraints(const VariableStepRattleIntegrator& integrator, SerializationNode& node) {
    for (int i = 0; i < integrator.getNumExpressionConstraints(); i++) {
        std::string expression;
        std::vector<int> particles;
        std::map<std::string, double> parameters;
        integrator.getExpressionConstraintParameters(i, expression, particles, parameters);
        SerializationNode& constraint = node.createChildNode("Constraint");
        constraint.setStringProperty("expression", expression);
        for (int particle : particles)
            constraint.createChildNode("Particle").setIntProperty("index", particle);
        for (const auto& parameter : parameters)
            constraint.createChildNode("Parameter")
                .setStringProperty("name", parameter.first)
                .setDoubleProperty("value", parameter.second);
    }
}

void readExpressionConstraints(const SerializationNode& node, VariableStepRattleIntegrator& integrator) {
    for (const SerializationNode& constraint : node.getChildren()) {
        std::vector<int> particles;
        std::map<std::string, double> parameters;
        for (const SerializationNode& child : constraint.getChildren()) {
            if (child.getName() == "Particle")
                particles.push_back(child.getIntProperty("index"));
            else
                parameters[child.getStringProperty("name")] = child.getDoubleProperty("value");
        }
        integrator.addConstraint(constraint.getStringProperty("expression"), particles, parameters);
    }
}

} // namespace

VariableStepRattleIntegratorProxy::VariableStepRattleIntegratorProxy() :
        SerializationProxy("VariableStepRattleIntegrator") {
}

void VariableStepRattleIntegratorProxy::serialize(const void* object, SerializationNode& node) const {
    const VariableStepRattleIntegrator& integrator = *static_cast<const VariableStepRattleIntegrator*>(object);
    node.setIntProperty("version", VERSION);
    node.setDoubleProperty("stepSize", integrator.getNominalStepSize());
    if (integrator.hasMinimumStepSize())
        node.setDoubleProperty(MINIMUM_STEP, integrator.getMinimumStepSize());
    if (integrator.hasMaximumStepSize())
        node.setDoubleProperty(MAXIMUM_STEP, integrator.getMaximumStepSize());
    node.setDoubleProperty("constraintTolerance", integrator.getConstraintTolerance());
    node.setIntProperty("integrationForceGroups", integrator.getIntegrationForceGroups());
    node.setIntProperty("updateMethod", integrator.getUpdateMethod());
    node.setDoubleProperty("normOrder", integrator.getNormOrder());
    node.setIntProperty("monitorForceGroup", integrator.getMonitorForceGroup());
    SerializationNode& monitors = node.createChildNode("Monitors");
    for (int i = 0; i < integrator.getNumMonitors(); i++) {
        VariableStepRattleIntegrator::MonitorKind kind;
        double weight, power;
        integrator.getMonitor(i, kind, weight, power);
        SerializationNode& monitor = monitors.createChildNode("Monitor");
        monitor.setIntProperty("kind", kind).setDoubleProperty("weight", weight).setDoubleProperty("power", power);
        monitor.setDoubleProperty("reference", integrator.getSetReferenceMonitorValue(i));
    }
    if (integrator.isAutomatic()) {
        SerializationNode& automatic = node.createChildNode(AUTOMATIC_CONTROL);
        automatic.setIntProperty("calibrationSteps", integrator.getCalibrationSteps());
        for (int k = 0; k < 2; k++)
            automatic.setDoubleProperty(AUTOMATIC_REFERENCES[k], integrator.getSetReferenceMonitorValue(k));
    }
    if (integrator.getNumExpressionConstraints() > 0)
        writeExpressionConstraints(integrator, node.createChildNode(EXPRESSION_CONSTRAINTS));
}

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
    integrator->clearMonitors();
    for (const SerializationNode& monitor : node.getChildNode("Monitors").getChildren()) {
        const auto kind = (VariableStepRattleIntegrator::MonitorKind) monitor.getIntProperty("kind");
        const int index =
            integrator->addMonitor(kind, monitor.getDoubleProperty("weight"), monitor.getDoubleProperty("power"));
        integrator->setReferenceMonitorValue(monitor.getDoubleProperty("reference"), index);
    }
    for (const SerializationNode& child : node.getChildren()) {
        if (child.getName() == AUTOMATIC_CONTROL) {
            integrator->useAutomaticStepControl(child.getIntProperty("calibrationSteps"));
            for (int k = 0; k < 2; k++)
                integrator->setReferenceMonitorValue(child.getDoubleProperty(AUTOMATIC_REFERENCES[k]), k);
        }
        else if (child.getName() == EXPRESSION_CONSTRAINTS)
            readExpressionConstraints(child, *integrator);
    }
    return integrator.release();
}

void registerVRattleSerializationProxies() {
    SerializationProxy::registerProxy(typeid(VariableStepRattleIntegrator), new VariableStepRattleIntegratorProxy());
}

namespace {

// Whoever loads the library, a C++ program, OpenMM's plugin loader or Python, needs no call.
const bool areProxiesRegistered = [] {
    registerVRattleSerializationProxies();
    return true;
}();

} // namespace
