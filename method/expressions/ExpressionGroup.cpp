// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "expressions/ExpressionGroup.h"
#include <algorithm>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

ExpressionGroup::ExpressionGroup(const ExpressionConstraint& example) :
        numParticles((int) example.particles.size()), nodes(example) {
    for (const vector<int>* some : {&nodes.coordinates, &nodes.velocities, &nodes.parameters, &nodes.parameterRates})
        inputs.insert(inputs.end(), some->begin(), some->end());
}

void ExpressionGroup::add(const ExpressionConstraint& constraint, int index, int firstEntry, int firstParameter,
                          const vector<double>& inverseMasses) {
    indices.push_back(index);
    firstParameters.push_back(firstParameter);
    for (int i : constraint.particles) {
        particles.push_back(i);
        entries.push_back(inverseMasses[i] > 0 ? firstEntry++ : NO_ENTRY);
    }
}

ExpressionGroup::Program ExpressionGroup::make(const vector<int>& outputs) const {
    return Program(new ArrayExpression(nodes.graph, inputs, outputs, std::min(MAX_BLOCK_SIZE, getNumConstraints())));
}

void ExpressionGroup::compile() {
    valueProgram = make({nodes.value});
    jacobianProgram = make(nodes.gradient);
    motionProgram = make({nodes.parameterMotion});
    for (int i = 0; i < 2; i++) {
        curvaturePrograms[i] = make({nodes.curvature[i]});
        velocityJacobianPrograms[i] = make(nodes.graph.findGradient(nodes.rate[i], nodes.coordinates));
    }
}

// Run a program on the constraints of a range, block by block, and call store(work, first, count) after each.
template <class Store>
void ExpressionGroup::run(const ArrayExpression& program, const Range& range, const Store& store) const {
    const int numCoordinates = 3 * numParticles, numParameters = (int) nodes.parameters.size();
    thread_local vector<double> memory; // of the thread, since others may be at work on other ranges
    memory.resize(std::max(memory.size(), program.getWorkSize()));
    double* const work = memory.data();
    program.prepare(work);
    double unused[MAX_BLOCK_SIZE]; // what the program does not read
    // Where the inputs index, index + 1, index + 2 go; whether any of them is needed.
    auto findInputs = [&](int index, double** inputs) {
        bool isAnyUsed = false;
        for (int j = 0; j < 3; j++) {
            const bool isUsed = program.usesInput(index + j);
            inputs[j] = isUsed ? program.getInput(work, index + j) : unused;
            isAnyUsed |= isUsed;
        }
        return isAnyUsed;
    };
    for (int first = range.first; first < range.end; first += MAX_BLOCK_SIZE) {
        const int count = std::min(MAX_BLOCK_SIZE, range.end - first);
        const int* block = &particles[(size_t) first * numParticles];
        const int* blockEntries = &entries[(size_t) first * numParticles];
        for (int p = 0; p < numParticles; p++) {
            double* x[3];
            if (findInputs(3 * p, x))
                for (int n = 0; n < count; n++) {
                    const Vec3& position = range.q[block[n * numParticles + p]];
                    x[0][n] = position[0];
                    x[1][n] = position[1];
                    x[2][n] = position[2];
                }
            // A particle without mass stays where it is, whatever velocity it has been given.
            if (findInputs(numCoordinates + 3 * p, x))
                for (int n = 0; n < count; n++) {
                    const int place = n * numParticles + p;
                    const Vec3 velocity = blockEntries[place] != NO_ENTRY ? (*range.v)[block[place]] : Vec3();
                    x[0][n] = velocity[0];
                    x[1][n] = velocity[1];
                    x[2][n] = velocity[2];
                }
        }
        for (int i = 0; i < 2 * numParameters; i++)
            if (program.usesInput(2 * numCoordinates + i)) {
                const vector<double>& numbers = i < numParameters ? range.theta.values : range.theta.rates;
                double* input = program.getInput(work, 2 * numCoordinates + i);
                for (int n = 0; n < count; n++)
                    input[n] = numbers[firstParameters[first + n] + i % numParameters];
            }
        program.evaluate(work, count);
        store(work, first, count);
    }
}

void ExpressionGroup::runValues(const ArrayExpression& program, const Range& range, vector<double>& result,
                                bool mustAdd) const {
    run(program, range, [&](const double* work, int first, int count) {
        const double* output = program.getOutput(work, 0);
        for (int n = 0; n < count; n++) {
            double& x = result[indices[first + n]];
            x = mustAdd ? x + output[n] : output[n];
        }
    });
}

void ExpressionGroup::runRows(const ArrayExpression& program, const Range& range, vector<Vec3>& jacobian) const {
    run(program, range, [&](const double* work, int first, int count) {
        for (int i = 0; i < numParticles; i++) {
            const double *x = program.getOutput(work, 3 * i), *y = program.getOutput(work, 3 * i + 1),
                         *z = program.getOutput(work, 3 * i + 2);
            for (int n = 0; n < count; n++) {
                const int entry = entries[(size_t) (first + n) * numParticles + i];
                if (entry != NO_ENTRY)
                    jacobian[entry] = Vec3(x[n], y[n], z[n]);
            }
        }
    });
}

void ExpressionGroup::evaluate(const vector<Vec3>& q, const ExpressionParameters& theta, vector<double>& g, int first,
                               int end) const {
    runValues(*valueProgram, {q, nullptr, theta, first, end}, g, false);
}

void ExpressionGroup::evaluateJacobian(const vector<Vec3>& q, const ExpressionParameters& theta, vector<Vec3>& jacobian,
                                       int first, int end) const {
    runRows(*jacobianProgram, {q, nullptr, theta, first, end}, jacobian);
}

void ExpressionGroup::addParameterMotion(const vector<Vec3>& q, const ExpressionParameters& theta,
                                         vector<double>& result, int first, int end) const {
    runValues(*motionProgram, {q, nullptr, theta, first, end}, result, true);
}

void ExpressionGroup::evaluateCurvature(const vector<Vec3>& q, const vector<Vec3>& v, const ExpressionParameters& theta,
                                        vector<double>& result, int first, int end) const {
    runValues(*curvaturePrograms[theta.isMoving], {q, &v, theta, first, end}, result, false);
}

void ExpressionGroup::evaluateVelocityJacobian(const vector<Vec3>& q, const vector<Vec3>& v,
                                               const ExpressionParameters& theta, vector<Vec3>& jacobian, int first,
                                               int end) const {
    runRows(*velocityJacobianPrograms[theta.isMoving], {q, &v, theta, first, end}, jacobian);
}
