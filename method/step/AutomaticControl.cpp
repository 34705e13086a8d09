// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/AutomaticControl.h"
#include <sstream>
#include <string>

using namespace OpenMMVRattle;
using namespace OpenMMVRattle::AutomaticRecursions;
using OpenMM::Vec3;
using std::vector;

namespace {

// At a temperature higher by this factor references are found anew.
const double MUCH_HOTTER = 4;
// Up to so many particles a cluster counts as one, beyond that as its part of them: what thermal motion does to them adds up.
const int SMALL_CLUSTER = 12;

void requireFinite(double value, const char* name) {
    if (!std::isfinite(value))
        throw StepFailure(std::string("the monitor ") + name +
                          " of the automatic step control became infinite or not a number");
}

} // namespace

AutomaticControl::AutomaticControl(ConstraintSolver& solver) :
        solver(solver), system(solver.getSystem()), clusterForces(solver), numClusters(clusterForces.getNumClusters()),
        choice(), references(), memory(), temperature(0), measured() {
    vector<double> sizes(numClusters);
    clusterForces.sumOverClusters([](int) { return 1.0 / SMALL_CLUSTER; }, sizes);
    for (double& size : sizes)
        size = std::max(1.0, size);
    thermalSize = std::max(1.0, clusterForces.eighthRootOfFourthPowers(sizes));
    numDegreesOfFreedom = std::max(1.0, 3.0 * (double) solver.getMovingParticles().size() - system.getNumConstraints());
    for (vector<double>* numbers : {&memory.forceSquares, &measuredSquares, &scratch})
        numbers->resize(numClusters);
    double mass = 0;
    for (int i : solver.getMovingParticles())
        mass += system.getMasses()[i];
    choice.hottest = mass * IMPOSSIBLE_SPEED * IMPOSSIBLE_SPEED / numDegreesOfFreedom;
}

void AutomaticControl::setSettings(const Settings& settings) {
    choice.stepSize = settings.stepSize;
    choice.minimumStep = settings.minimumStep;
    choice.learningSteps = settings.learningSteps;
    std::copy(settings.given, settings.given + NUM_MONITORS, choice.given);
    choice.thermalUnit = thermalSize / settings.stepSize;
}

// -------------------------------------------------------------------------------------------------------- the monitors

// S_c and 2K/f
void AutomaticControl::findSquares(const State& state, vector<double>& squares) {
    const vector<Vec3>& netForces =
        clusterForces.findNetForces(state.positions, state.parameters, state.forces, state.multipliers);
    const vector<double>&masses = system.getMasses(), &inverseMasses = system.getInverseMasses();
    clusterForces.sumOverClusters(
        [&](int i) {
            const double speedSquared = state.velocities[i].dot(state.velocities[i]);
            return netForces[i].dot(netForces[i]) * inverseMasses[i] +
                   masses[i] * speedSquared * speedSquared / (FLIGHT * FLIGHT);
        },
        squares);
    const vector<int>& moving = solver.getMovingParticles();
    temperature = solver.sum((int) moving.size(), [&](int p) {
        return masses[moving[p]] * state.velocities[moving[p]].dot(state.velocities[moving[p]]) / numDegreesOfFreedom;
    });
}

// U_A from S_c
double AutomaticControl::evaluateOnStep(const State& state, const vector<double>& squares) {
    clusterForces.sumOverClusters(
        [&](int i) {
            const Vec3 &force = state.forces[i], &v = state.velocities[i];
            return std::sqrt(force.dot(force)) * v.dot(v) / LENGTH;
        },
        scratch);
    solver.share((int) scratch.size(), [&](int first, int end) {
        for (int c = first; c < end; c++)
            scratch[c] += squares[c];
    });
    return clusterForces.eighthRootOfFourthPowers(scratch);
}

void AutomaticControl::begin(const State& state) {
    findSquares(state, memory.forceSquares);
    memory.values[OnStep] = evaluateOnStep(state, memory.forceSquares);
    memory.values[HalfStep] = 0;
}

// A run far beyond the limit of stability gains energy in each step, and goes on with all steps at their minimum.
void AutomaticControl::requirePossibleSpeeds() const {
    if (temperature <= choice.hottest)
        return;
    std::stringstream reason;
    reason
        << "the particles have become faster than light (2K/f is " << temperature
        << " kJ/mol): steps of the nominal size are beyond the limit of stability, and there is nothing left to go on "
           "from";
    throw StepFailure(reason.str());
}

void AutomaticControl::measure(const State& state, const vector<Vec3>& w, double size, const vector<Vec3>& oldForce) {
    findSquares(state, measuredSquares);
    requirePossibleSpeeds();
    measured[OnStep] = evaluateOnStep(state, measuredSquares);
    requireFinite(measured[OnStep], "U_A");
    clusterForces.sumOverClusters([&](int i) { return w[i].dot(state.forces[i] - oldForce[i]); }, scratch);
    solver.share((int) scratch.size(), [&](int first, int end) {
        for (int c = first; c < end; c++)
            scratch[c] =
                CHANGE_WEIGHT / size * std::fabs(scratch[c]) + 0.5 * (measuredSquares[c] + memory.forceSquares[c]);
    });
    measured[HalfStep] = clusterForces.eighthRootOfFourthPowers(scratch);
    requireFinite(measured[HalfStep], "U_B");
}

// -------------------------------------------------------------------------------------------- the densities and references

// U_B is not known before the first step; it asks for what U_A does.
void AutomaticControl::start() {
    for (int k = 0; k < NUM_MONITORS; k++)
        if (choice.given[k] == 0 && memory.temperature > 0 && temperature > MUCH_HOTTER * memory.temperature)
            references[k] = 0;
    memory.following = 0;
    if (!(references[OnStep] > 0 && references[HalfStep] > 0)) {
        memory.numLearnt = memory.temperature = 0;
        std::fill(std::begin(memory.logarithms), std::end(memory.logarithms), 0.0);
        automaticFindHard(&memory, references, &choice, temperature);
    }
    memory.stepsSinceStart = 0;
    const double asked = automaticTarget(references, &choice, OnStep, memory.values[OnStep]);
    for (int k = 0; k < NUM_MONITORS; k++)
        memory.behind[k] = memory.ahead[k] = asked;
}

void AutomaticControl::acceptMeasured() {
    std::copy(measured, measured + NUM_MONITORS, memory.values);
    memory.forceSquares.swap(measuredSquares);
}

void AutomaticControl::acceptStep() {
    acceptMeasured();
    automaticMoveOn(&memory, references, &choice, temperature);
}

void AutomaticControl::acceptPartOfStep(double part) {
    acceptMeasured();
    automaticMoveOnPart(&memory, references, &choice, temperature, part);
}

void AutomaticControl::change(const State& state, double part) {
    findSquares(state, memory.forceSquares);
    automaticChange(&memory, references, &choice, temperature, evaluateOnStep(state, memory.forceSquares), part);
}

void AutomaticControl::reverse() {
    std::swap_ranges(memory.behind, memory.behind + NUM_MONITORS, memory.ahead);
}
