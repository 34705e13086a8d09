// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "expressions/ExpressionDerivatives.h"
#include "lepton/ParsedExpression.h"
#include "lepton/Parser.h"
#include <utility>

using namespace OpenMMVRattle;
using std::vector;

ExpressionDerivatives::ExpressionDerivatives(const ExpressionConstraint& example) {
    const int numCoordinates = 3 * (int) example.particles.size();
    const char* const axes[] = {"x", "y", "z"};
    for (int i = 0; i < numCoordinates; i++)
        coordinates.push_back(graph.addVariable(axes[i % 3] + std::to_string(i / 3 + 1)));
    for (const auto& parameter : example.parameters)
        parameters.push_back(graph.addVariable(parameter.first));
    // Not optimized by Lepton, which for a constant that is not a number would go on for ever; the graph does it.
    value = graph.addExpression(Lepton::Parser::parse(example.expression).getRootNode());
    // These names can not be written in an expression.
    vector<std::pair<int, int>> motions[2], motionOfParameters;
    for (int i = 0; i < numCoordinates; i++) {
        velocities.push_back(graph.addVariable("velocity " + std::to_string(i)));
        motions[0].emplace_back(coordinates[i], velocities[i]);
    }
    for (size_t i = 0; i < parameters.size(); i++) {
        parameterRates.push_back(graph.addVariable("rate " + std::to_string(i)));
        motionOfParameters.emplace_back(parameters[i], parameterRates[i]);
    }
    motions[1] = motions[0];
    motions[1].insert(motions[1].end(), motionOfParameters.begin(), motionOfParameters.end());
    for (int i = 0; i < 2; i++) {
        rate[i] = graph.differentiate(value, motions[i]);
        curvature[i] = graph.differentiate(rate[i], motions[i]);
    }
    parameterMotion = graph.differentiate(value, motionOfParameters);
    gradient = graph.findGradient(value, coordinates);
}
