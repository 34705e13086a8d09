// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionConstraintNodes.h"
#include <map>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::SerializationNode;

namespace {

const char NODE_NAME[] = "ExpressionConstraints";

} // namespace

void OpenMMVRattle::writeExpressionConstraints(const std::vector<ExpressionConstraint>& expressions,
                                               SerializationNode& parent) {
    if (expressions.empty())
        return;
    SerializationNode& node = parent.createChildNode(NODE_NAME);
    for (const ExpressionConstraint& each : expressions) {
        SerializationNode& constraint = node.createChildNode("Constraint");
        constraint.setStringProperty("expression", each.expression);
        for (int particle : each.particles)
            constraint.createChildNode("Particle").setIntProperty("index", particle);
        for (const auto& parameter : each.parameters)
            constraint.createChildNode("Parameter")
                .setStringProperty("name", parameter.first)
                .setDoubleProperty("value", parameter.second);
    }
}

void OpenMMVRattle::readExpressionConstraints(const SerializationNode& parent, ConstrainedIntegrator& integrator) {
    for (const SerializationNode& node : parent.getChildren()) {
        if (node.getName() != NODE_NAME)
            continue;
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
}
