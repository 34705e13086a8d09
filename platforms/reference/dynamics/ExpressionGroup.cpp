// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionGroup.h"
#include "lepton/ParsedExpression.h"
#include "lepton/Parser.h"
#include <algorithm>
#include <utility>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::string;
using std::vector;

ExpressionGroup::ExpressionGroup(const ExpressionConstraint& example) : numParticles((int) example.particles.size()) {
    const char* const axes[] = {"x", "y", "z"};
    for (int i = 0; i < 3 * numParticles; i++)
        coordinates.push_back(graph.addVariable(axes[i % 3] + std::to_string(i / 3 + 1)));
    for (const auto& parameter : example.parameters) {
        parameterNames.push_back(parameter.first);
        parameters.push_back(graph.addVariable(parameter.first));
    }
    // Not optimized by Lepton, which for a constant that is not a number would go on for ever; the graph does it.
    value = graph.addExpression(Lepton::Parser::parse(example.expression).getRootNode());
    // These names can not be written in an expression.
    vector<std::pair<int, int>> rates;
    for (int i = 0; i < 3 * numParticles; i++) {
        velocities.push_back(graph.addVariable("velocity " + std::to_string(i)));
        rates.emplace_back(coordinates[i], velocities[i]);
    }
    rate = graph.differentiate(value, rates);
    curvature = graph.differentiate(rate, rates);
}

void ExpressionGroup::add(const ExpressionConstraint& constraint, int index, int firstEntry,
                          const vector<double>& inverseMasses) {
    indices.push_back(index);
    firstEntries.push_back(firstEntry);
    for (int i : constraint.particles) {
        particles.push_back(i);
        isMoving.push_back(inverseMasses[i] > 0);
    }
    parameterValues.resize(parameterValues.size() + parameters.size());
    setParameters(getNumConstraints() - 1, constraint.parameters);
}

void ExpressionGroup::setParameters(int n, const std::map<string, double>& newParameters) {
    for (size_t i = 0; i < parameterNames.size(); i++)
        parameterValues[n * parameterNames.size() + i] = newParameters.at(parameterNames[i]);
}

ExpressionGroup::Program& ExpressionGroup::require(Program& program, const vector<int>& outputs) {
    if (program == nullptr) {
        vector<int> inputs = coordinates;
        inputs.insert(inputs.end(), velocities.begin(), velocities.end());
        inputs.insert(inputs.end(), parameters.begin(), parameters.end());
        program.reset(new ArrayExpression(graph, inputs, outputs, std::min(MAX_BLOCK_SIZE, getNumConstraints())));
    }
    return program;
}

// Where the inputs index, index + 1, index + 2 of a program go; whether any of them is needed.
bool ExpressionGroup::findInputs(ArrayExpression& program, int index, double** inputs) {
    bool isAnyUsed = false;
    for (int j = 0; j < 3; j++) {
        const bool isUsed = program.usesInput(index + j);
        inputs[j] = isUsed ? program.getInput(index + j) : unusedInput;
        isAnyUsed |= isUsed;
    }
    return isAnyUsed;
}

// Run a program on all constraints, block by block, and call store(first, count) after each.
template <class Store>
void ExpressionGroup::run(ArrayExpression& program, const vector<Vec3>& q, const vector<Vec3>* v, const Store& store) {
    const int numCoordinates = 3 * numParticles, numParameters = (int) parameters.size();
    for (int first = 0; first < getNumConstraints(); first += MAX_BLOCK_SIZE) {
        const int count = std::min(MAX_BLOCK_SIZE, getNumConstraints() - first);
        const int* block = &particles[(size_t) first * numParticles];
        const char* moving = &isMoving[(size_t) first * numParticles];
        for (int p = 0; p < numParticles; p++) {
            double* x[3];
            if (findInputs(program, 3 * p, x))
                for (int n = 0; n < count; n++) {
                    const Vec3& position = q[block[n * numParticles + p]];
                    x[0][n] = position[0];
                    x[1][n] = position[1];
                    x[2][n] = position[2];
                }
            // A particle without mass stays where it is, whatever velocity it has been given.
            if (findInputs(program, numCoordinates + 3 * p, x))
                for (int n = 0; n < count; n++) {
                    const int place = n * numParticles + p;
                    const Vec3 velocity = moving[place] ? (*v)[block[place]] : Vec3();
                    x[0][n] = velocity[0];
                    x[1][n] = velocity[1];
                    x[2][n] = velocity[2];
                }
        }
        for (int i = 0; i < numParameters; i++)
            if (program.usesInput(2 * numCoordinates + i)) {
                double* input = program.getInput(2 * numCoordinates + i);
                for (int n = 0; n < count; n++)
                    input[n] = parameterValues[(size_t) (first + n) * numParameters + i];
            }
        program.evaluate(count);
        store(first, count);
    }
}

void ExpressionGroup::runRows(ArrayExpression& program, const vector<Vec3>& q, const vector<Vec3>* v,
                              vector<Vec3>& jacobian) {
    run(program, q, v, [&](int first, int count) {
        for (int i = 0; i < numParticles; i++) {
            const double *x = program.getOutput(3 * i), *y = program.getOutput(3 * i + 1),
                         *z = program.getOutput(3 * i + 2);
            for (int n = 0; n < count; n++)
                jacobian[firstEntries[first + n] + i] =
                    isMoving[(size_t) (first + n) * numParticles + i] ? Vec3(x[n], y[n], z[n]) : Vec3();
        }
    });
}

void ExpressionGroup::evaluate(const vector<Vec3>& q, vector<double>& g) {
    ArrayExpression& program = *require(valueProgram, {value});
    run(program, q, nullptr, [&](int first, int count) {
        for (int n = 0; n < count; n++)
            g[indices[first + n]] = program.getOutput(0)[n];
    });
}

void ExpressionGroup::evaluateJacobian(const vector<Vec3>& q, vector<Vec3>& jacobian) {
    if (jacobianProgram == nullptr)
        require(jacobianProgram, graph.findGradient(value, coordinates));
    runRows(*jacobianProgram, q, nullptr, jacobian);
}

void ExpressionGroup::evaluateCurvature(const vector<Vec3>& q, const vector<Vec3>& v, vector<double>& result) {
    ArrayExpression& program = *require(curvatureProgram, {curvature});
    run(program, q, &v, [&](int first, int count) {
        for (int n = 0; n < count; n++)
            result[indices[first + n]] = program.getOutput(0)[n];
    });
}

void ExpressionGroup::evaluateVelocityJacobian(const vector<Vec3>& q, const vector<Vec3>& v, vector<Vec3>& jacobian) {
    if (velocityJacobianProgram == nullptr)
        require(velocityJacobianProgram, graph.findGradient(rate, coordinates));
    runRows(*velocityJacobianProgram, q, &v, jacobian);
}
