// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/AutomaticControl.h"
#include "step/StepDensity.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// The powers of u_A and u_B, the lengths l and l_f (nm), the weight of the change of the forces, and where the dead zone ends.
const double POWERS[] = {2.0 / 3.0, 0.8};
const double LENGTH = 0.0125, FLIGHT = 0.4;
const double CHANGE_WEIGHT = 3;
const double DEAD_ZONE = 2.5;
// Below this fraction of DEAD_ZONE the density is exactly 1, so that calm steps are those of fixed steps.
const double EXACT_PART = 0.8;
// a in f(x) = (x - a) - (1 - a)^2/(x - a): no step is longer than the nominal one divided by a.
const double SMALLEST = 0.75;
// In units of the thermal momentum a step (see thermalValue()): what is hard beyond doubt, the reference then, and the least one
// while the references follow. At rest things are measured as at 300 K (kJ/mol).
const double HARD = 8, HARD_REFERENCE = 0.4, FOLLOWING_FLOOR = 0.2;
const double ROOM_TEMPERATURE = 300 * 0.00831446;
// In the same units at 300 K: what is nothing, but for rounding.
const double NEGLIGIBLE = 1e-6;
// The references follow the logarithms of the monitors, which count as no more than this above or below, in this number of steps.
const double LARGEST_SURPRISE = 2, FOLLOWING_STEPS = 100;
// They do so until so many steps have passed without a change of the state.
const double LAST_CHANGE = 1000;
// At a temperature higher by this factor references are found anew.
const double MUCH_HOTTER = 4;
// A change of the velocities by less than this fraction leaves the run that of constant energy that it was.
const double ROUNDING = 1e-6;
// In the first steps of a sequence the densities are drawn towards their monitors by this part of their distance a step, for what
// the monitors were before is not known.
const int SETTLING_STEPS = 30;
const double SETTLING = 0.1;
// What is a short step, in nominal ones.
const double SHORT = 0.1;

double f(double x) {
    return StepDensity::f(x, SMALLEST);
}

double inverseOfF(double y) {
    return StepDensity::inverseOfF(y, SMALLEST);
}

double sixteenthPower(double x) {
    for (int i = 0; i < 4; i++)
        x *= x;
    return x;
}

double sixteenthRoot(double x) {
    for (int i = 0; i < 4; i++)
        x = std::sqrt(x);
    return x;
}

// phi(u) without its upper bound: exactly 1 for u below EXACT_PART DEAD_ZONE, nearly u/DEAD_ZONE far above it.
double applyDeadZone(double u) {
    auto fourth = [](double x) { return (x * x) * (x * x); };
    const double x = std::min(u / DEAD_ZONE, 1e15); // whose sixteenth power does not overflow
    const double beyond = std::max(0.0, fourth(x) - fourth(EXACT_PART));
    return sixteenthRoot(1 + fourth(beyond));
}

void requireFinite(double value, const char* name) {
    if (!std::isfinite(value))
        throw StepFailure(std::string("the monitor ") + name +
                          " of the automatic step control became infinite or not a number");
}

} // namespace

AutomaticControl::AutomaticControl(ConstraintSolver& solver) :
        solver(solver), system(solver.getSystem()), clusterForces(solver), numClusters(clusterForces.getNumClusters()),
        references(), memory(), temperature(0), measured() {
    numDegreesOfFreedom = std::max(1.0, 3.0 * (double) solver.getMovingParticles().size() - system.getNumConstraints());
    for (vector<double>* numbers : {&memory.forceSquares, &measuredSquares, &scratch})
        numbers->resize(numClusters);
}

// -------------------------------------------------------------------------------------------------------- the monitors

// S_c and 2K/f
void AutomaticControl::findSquares(const State& state, vector<double>& squares) {
    const vector<Vec3>& netForces =
        clusterForces.findNetForces(state.positions, state.parameters, state.forces, state.multipliers);
    const vector<double>&masses = system.getMasses(), &inverseMasses = system.getInverseMasses();
    clusterForces.forClusters([&](int c, const int* first, const int* end) {
        double sum = 0;
        for (const int* i = first; i < end; i++) {
            const double speedSquared = state.velocities[*i].dot(state.velocities[*i]);
            sum += netForces[*i].dot(netForces[*i]) * inverseMasses[*i] +
                   masses[*i] * speedSquared * speedSquared / (FLIGHT * FLIGHT);
        }
        squares[c] = sum;
    });
    const vector<int>& moving = solver.getMovingParticles();
    temperature = solver.sum((int) moving.size(), [&](int p) {
        return masses[moving[p]] * state.velocities[moving[p]].dot(state.velocities[moving[p]]) / numDegreesOfFreedom;
    });
}

// U_A from S_c
double AutomaticControl::evaluateOnStep(const State& state, const vector<double>& squares) {
    clusterForces.forClusters([&](int c, const int* first, const int* end) {
        double sum = squares[c];
        for (const int* i = first; i < end; i++) {
            const Vec3 &force = state.forces[*i], &v = state.velocities[*i];
            sum += std::sqrt(force.dot(force)) * v.dot(v) / LENGTH;
        }
        scratch[c] = sum;
    });
    return clusterForces.eighthRootOfFourthPowers(scratch);
}

void AutomaticControl::begin(const State& state) {
    findSquares(state, memory.forceSquares);
    memory.values[OnStep] = evaluateOnStep(state, memory.forceSquares);
    memory.values[HalfStep] = 0;
}

void AutomaticControl::measure(const State& state, const vector<Vec3>& w, double size, const vector<Vec3>& oldForce) {
    findSquares(state, measuredSquares);
    measured[OnStep] = evaluateOnStep(state, measuredSquares);
    requireFinite(measured[OnStep], "U_A");
    clusterForces.forClusters([&](int c, const int* first, const int* end) {
        double work = 0;
        for (const int* i = first; i < end; i++)
            work += w[*i].dot(state.forces[*i] - oldForce[*i]);
        scratch[c] = CHANGE_WEIGHT * 2 / size * std::fabs(work) + 0.5 * (measuredSquares[c] + memory.forceSquares[c]);
    });
    measured[HalfStep] = clusterForces.eighthRootOfFourthPowers(scratch);
    requireFinite(measured[HalfStep], "U_B");
}

// The value of a monitor where the momenta of every cluster change by those of this 2K/f in a nominal step.
double AutomaticControl::thermalValue(double kT) const {
    return std::sqrt(kT) * std::pow((double) std::max(1, numClusters), 0.125) / settings.stepSize;
}

double AutomaticControl::getNegligibleValue() const {
    return NEGLIGIBLE * thermalValue(ROOM_TEMPERATURE);
}

// ------------------------------------------------------------------------------------------------------- the densities

// No step is below the minimum, and a density of 1 stays what it is.
double AutomaticControl::limit(double density) const {
    if (!(density > 1) || settings.minimumStep == 0)
        return density;
    const double excess = density - 1, largest = settings.stepSize / settings.minimumStep - 1;
    return 1 + excess / sixteenthRoot(1 + sixteenthPower(std::min(excess / largest, 1e15)));
}

// f(phi(u)); f(1) while there is no reference
double AutomaticControl::target(int monitor, double value) const {
    if (!isKnown(monitor))
        return 0;
    return f(limit(applyDeadZone(std::pow(value / references[monitor], POWERS[monitor]))));
}

double AutomaticControl::combine(const double (&transformed)[NUM_MONITORS]) const {
    const double a = inverseOfF(transformed[OnStep]), b = inverseOfF(transformed[HalfStep]);
    return limit(std::sqrt(0.5 * (a * a + b * b)));
}

// U_B is not known before the first step; it asks for what U_A does.
void AutomaticControl::start() {
    for (int k = 0; k < NUM_MONITORS; k++)
        if (settings.given[k] == 0 && memory.temperature > 0 && temperature > MUCH_HOTTER * memory.temperature)
            references[k] = 0;
    memory.following = 0;
    if (!isKnown(OnStep) || !isKnown(HalfStep)) {
        memory.numLearnt = memory.temperature = 0;
        std::fill(std::begin(memory.logarithms), std::end(memory.logarithms), 0.0);
        findHard();
    }
    memory.stepsSinceStart = 0;
    const double asked = target(OnStep, memory.values[OnStep]);
    for (int k = 0; k < NUM_MONITORS; k++)
        memory.behind[k] = memory.ahead[k] = asked;
}

void AutomaticControl::acceptMeasured() {
    std::copy(measured, measured + NUM_MONITORS, memory.values);
    memory.forceSquares.swap(measuredSquares);
}

void AutomaticControl::acceptStep() {
    const double density = getNext();
    memory.shortSteps = density * SHORT > 1 ? memory.shortSteps + 1 : 0;
    memory.mostShortSteps = std::max(memory.mostShortSteps, memory.shortSteps);
    acceptMeasured();
    adapt(1 / density);
    for (int k = 0; k < NUM_MONITORS; k++) {
        const double last = memory.behind[k];
        memory.behind[k] = memory.ahead[k];
        // A joins its two neighbours of step n, B those of half step n-1/2.
        memory.ahead[k] = 2 * target(k, memory.values[k]) - (k == OnStep ? memory.ahead[k] : last);
    }
}

// The densities move on by that part of what they would in a full step. U_B of a short step is spoiled by the rounding of the
// forces, and counts only if the step is at least half a full one.
void AutomaticControl::acceptPartOfStep(double part) {
    const double nominalPart = part / getNext();
    acceptMeasured();
    if (part >= 0.5)
        adapt(nominalPart);
    for (int k = 0; k < NUM_MONITORS; k++) {
        const double behind = memory.behind[k], ahead = memory.ahead[k];
        memory.behind[k] += part * (ahead - behind);
        if (k == OnStep)
            memory.ahead[k] = 2 * target(k, memory.values[k]) - memory.behind[k];
        else {
            const double afterNext = (part < 0.5 ? 2 * ahead : 2 * target(k, memory.values[k])) - behind;
            memory.ahead[k] += part * (afterNext - ahead);
        }
    }
}

void AutomaticControl::change(const State& state, double part) {
    const double before = target(OnStep, memory.values[OnStep]), halfStepValue = memory.values[HalfStep];
    begin(state);
    memory.values[HalfStep] = halfStepValue;
    if (part > ROUNDING) {
        memory.following = LAST_CHANGE;
        raiseReferences();
    }
    const double shift = target(OnStep, memory.values[OnStep]) - before;
    memory.behind[OnStep] += shift;
    memory.ahead[OnStep] += shift;
    draw(part);
}

void AutomaticControl::reverse() {
    std::swap_ranges(memory.behind, memory.behind + NUM_MONITORS, memory.ahead);
}

// Draw both sequences towards their monitors by a part of their distance.
void AutomaticControl::draw(double part) {
    for (int k = 0; k < NUM_MONITORS; k++) {
        if (memory.values[k] == 0) // not known yet, or there is nothing
            continue;
        for (double* each : {&memory.behind[k], &memory.ahead[k]})
            *each += part * (target(k, memory.values[k]) - *each);
    }
}

// ------------------------------------------------------------------------------------------------------ the references

// After a step that was this part of a nominal one. With other references the sequences keep their distances from the monitors.
void AutomaticControl::adapt(double part) {
    double before[NUM_MONITORS];
    for (int k = 0; k < NUM_MONITORS; k++)
        before[k] = target(k, memory.values[k]);
    if (!isKnown(OnStep) || !isKnown(HalfStep))
        learn();
    else if (memory.following > 0)
        follow(part);
    for (int k = 0; k < NUM_MONITORS; k++) {
        const double shift = target(k, memory.values[k]) - before[k];
        memory.behind[k] += shift;
        memory.ahead[k] += shift;
    }
    if (memory.stepsSinceStart < SETTLING_STEPS) {
        memory.stepsSinceStart++;
        draw(SETTLING);
    }
}

// The user's references stay.
void AutomaticControl::setFound(double onStep, double halfStep) {
    references[OnStep] = settings.given[OnStep] > 0 ? settings.given[OnStep] : onStep;
    references[HalfStep] = settings.given[HalfStep] > 0 ? settings.given[HalfStep] : halfStep;
    memory.stepsSinceStart = 0;
}

// What is hard beyond doubt is not learnt from.
bool AutomaticControl::findHard() {
    const double kT = std::max(temperature, ROOM_TEMPERATURE);
    if (!(memory.values[OnStep] > HARD * thermalValue(kT)))
        return false;
    setFound(HARD_REFERENCE * thermalValue(kT), HARD_REFERENCE * thermalValue(kT));
    memory.temperature = kT;
    return true;
}

// Nor is a step in which nothing pulls and nothing moves.
void AutomaticControl::learn() {
    if (findHard() || std::min(memory.values[OnStep], memory.values[HalfStep]) <= getNegligibleValue())
        return;
    memory.numLearnt++;
    memory.temperature += (temperature - memory.temperature) / memory.numLearnt;
    for (int k = 0; k < NUM_MONITORS; k++)
        memory.logarithms[k] += (std::log(memory.values[k]) - memory.logarithms[k]) / memory.numLearnt;
    if (memory.numLearnt >= settings.learningSteps)
        setFound(std::exp(memory.logarithms[OnStep]), std::exp(memory.logarithms[HalfStep]));
}

// A mean over the last steps that nothing can capture.
void AutomaticControl::follow(double part) {
    memory.following--;
    const double weight = part / FOLLOWING_STEPS;
    memory.temperature += std::min(1.0, weight) * (temperature - memory.temperature);
    for (int k = 0; k < NUM_MONITORS; k++) {
        const double surprise = std::log(memory.values[k] / references[k]);
        if (settings.given[k] == 0)
            references[k] *= std::exp(weight * std::min(std::max(surprise, -LARGEST_SURPRISE), LARGEST_SURPRISE));
    }
    raiseReferences();
}

void AutomaticControl::raiseReferences() {
    for (int k = 0; k < NUM_MONITORS; k++)
        if (settings.given[k] == 0 && isKnown(k))
            references[k] =
                std::max(references[k], std::max(FOLLOWING_FLOOR * thermalValue(temperature), getNegligibleValue()));
}
