// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/VRattleRun.h"
#include "run/IntegratorSettings.h"
#include <algorithm>
#include <cmath>
#include <iterator>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Keeps what is at rest from being divided by zero.
const double TINY = 1e-100;

vector<double> givenReferences(const StepSettings& settings) {
    if (settings.isAutomatic)
        return {std::begin(settings.automaticReferences), std::end(settings.automaticReferences)};
    vector<double> references;
    for (const StepMonitor::Term& term : settings.terms)
        references.push_back(term.reference);
    return references;
}

bool haveSameMonitors(const StepSettings& a, const StepSettings& b) {
    auto areAlike = [](const StepMonitor::Term& x, const StepMonitor::Term& y) {
        return x.kind == y.kind && x.weight == y.weight && x.power == y.power && x.order == y.order;
    };
    if (a.isAutomatic != b.isAutomatic || a.isFixedStep != b.isFixedStep)
        return false;
    return a.isAutomatic ? a.automaticRequest == b.automaticRequest
                         : std::equal(a.terms.begin(), a.terms.end(), b.terms.begin(), b.terms.end(), areAlike);
}

// But for what automatic step control has no use for.
bool haveSameSizes(const StepSettings& a, const StepSettings& b) {
    return a.stepSize == b.stepSize && a.getMinimumStep() == b.getMinimumStep() &&
           (a.isAutomatic || (a.getMaximumStep() == b.getMaximumStep() && a.update == b.update));
}

} // namespace

void VRattleRun::setSettings(const Settings& newSettings) {
    const bool areSameMonitors = haveSameMonitors(newSettings, settings);
    const vector<double> given = givenReferences(settings), inForce = control->getReferences();
    vector<double> references = givenReferences(newSettings);
    for (size_t k = 0; k < references.size() && areSameMonitors; k++)
        if (references[k] == 0 && given[k] == 0)
            references[k] = inForce[k];
    VRattleDynamics::setSettings(newSettings, references,
                                 !areSameMonitors                       ? StepControl::Monitors
                                 : references != inForce                ? StepControl::References
                                 : haveSameSizes(newSettings, settings) ? StepControl::Nothing
                                                                        : StepControl::Sizes);
}

StepCounts VRattleRun::getCounts() {
    StepCounts counts;
    counts.rescues = getNumRescues();
    counts.shortSteps = (long long) getAutomaticControl().getMemory().mostShortSteps;
    return counts;
}

void VRattleRun::putBack(const Kept& kept) {
    settings = kept.settings;
    now = kept.state;
    solver.motion.target = kept.target;
    solver.setSettings(settings.stepSize, settings.tolerance);
    constraints.moveTo(now.q, now.theta, now.force);
    control = &controlOf(settings);
    control->changeSettings(settings, kept.memory.references, StepControl::Nothing);
    setMemory(kept.memory);
}

void VRattleRun::setMemory(const Memory& memory) {
    control->setMemory(memory);
    control->setReferences(memory.references);
    automatic.getControl().setMemory(memory.automatic);
}

void VRattleRun::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                       double energy) {
    attempt([&] { VRattleDynamics::begin(positions, velocities, forces, energy); }, remember());
}

void VRattleRun::beginFixedSteps(double stepSize) {
    Settings fixed = settings;
    fixed.isFixedStep = true;
    fixed.stepSize = stepSize;
    setSettings(fixed);
    begin(vector<Vec3>(now.q), vector<Vec3>(now.v), vector<Vec3>(now.force), now.groupEnergy);
}

void VRattleRun::adoptParameters() {
    now.theta.values = solver.motion.target;
    solver.motion.rest(now.theta);
    constraints.moveTo(now.q, now.theta, now.force);
}

// From elsewhere, as if no step had led there.
void VRattleRun::takeState(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                           double energy, const ExpressionParameters& theta) {
    auto take = [&] {
        now.theta = theta;
        takeOver(positions, velocities, forces, energy);
        control->begin();
    };
    attempt(take, remember());
}

void VRattleRun::adopt(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                       double energy, const ExpressionParameters& theta, const Memory& memory) {
    takeState(positions, velocities, forces, energy, theta);
    now.v = velocities; // which have been projected, and so changed in the last bits
    adopt(memory);
    formHalfStepVelocities();
}

// With S_c of begin().
void VRattleRun::adopt(const Memory& memory) {
    control->setMemory(memory);
    if (!settings.isAutomatic)
        return;
    setReferences(memory.references);
    AutomaticControl::Memory own = automatic.getControl().getMemory();
    static_cast<AutomaticRecursions::AutomaticNumbers&>(own) = memory.automatic;
    automatic.getControl().setMemory(own);
}

void VRattleRun::resume(const StepState& state, const Memory& memory) {
    takeState(state.q, state.v, state.force, state.groupEnergy, state.theta);
    StepState exact = state; // this has projected the velocities, which changes the last bits
    exact.rightSide = now.rightSide;
    exact.forceParts = now.forceParts;
    putBack({settings, exact, solver.motion.target, memory});
}

void VRattleRun::changeState(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                             double energy) {
    auto take = [&] {
        takeOver(positions, velocities, forces, energy);
        control->change(StepControl::Everything, 1.0);
    };
    attempt(take, remember());
    if (control->hasStarted())
        formHalfStepVelocities();
}

bool VRattleRun::changeFrame(const vector<Vec3>& before, const vector<Vec3>& velocities) {
    const vector<int>& movingParticles = constraints.getMovingParticles();
    const bool areOwn = &before == &now.v;
    Vec3 shift;
    if (!constraints.findFrameShift(before, velocities, shift))
        return false;
    constraints.share((int) movingParticles.size(), [&](int first, int end) {
        for (int p = first; p < end; p++) {
            const int i = movingParticles[p];
            now.v[i] = areOwn ? velocities[i] : now.v[i] + shift;
            now.w[i] += shift;
        }
    });
    control->change(StepControl::Frame, 0.0);
    return true;
}

void VRattleRun::changeVelocities(const vector<Vec3>& velocities) {
    const vector<double>& masses = getConstraintSystem().getMasses();
    vector<Vec3>& change = solver.next.v;
    for (int i : constraints.getMovingParticles())
        change[i] = velocities[i] - now.v[i];
    constraints.projectVelocities(change);
    for (int i : constraints.getMovingParticles()) {
        now.v[i] += change[i];
        now.w[i] += change[i];
    }
    constraints.findMultipliers(now.v, now.theta, now.lambda, now.rightSide);
    const double part = constraints.sumOfSquares(change, masses) / (constraints.sumOfSquares(now.v, masses) + TINY);
    control->change(StepControl::Velocities, std::min(1.0, std::sqrt(part)));
}

void VRattleRun::changeForces(vector<Vec3>& forces, double energy) {
    const vector<double>& inverseMasses = getConstraintSystem().getInverseMasses();
    vector<Vec3>& difference = solver.next.v;
    for (int i : constraints.getMovingParticles())
        difference[i] = forces[i] - now.force[i];
    const double changeSquared = constraints.sumOfSquares(difference, inverseMasses);
    const double forceSquared =
        std::max(constraints.sumOfSquares(forces, inverseMasses), constraints.sumOfSquares(now.force, inverseMasses));
    auto exchange = [&] {
        now.force.swap(forces);
        std::swap(now.groupEnergy, energy);
        now.lambda.swap(solver.next.lambda);
        now.rightSide.swap(solver.next.rightSide);
        constraints.moveTo(now.q, now.theta, now.force);
    };
    auto putBack = [&, memory = getMemory(), values = now.values, forceParts = now.forceParts] {
        exchange();
        now.values = values;
        now.forceParts = forceParts;
        setMemory(memory);
    };
    auto change = [&] {
        constraints.findMultipliers(now.v, now.theta, now.lambda, now.rightSide);
        control->change(StepControl::Forces, std::min(1.0, std::sqrt(changeSquared / (forceSquared + TINY))));
    };
    exchange();
    attempt(change, putBack);
    if (control->hasStarted())
        formHalfStepVelocities();
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void VRattleRun::exchange(StepState& state, Memory& memory, RunState::Archive archive, size_t numMonitors,
                          bool isAutomatic) {
    const size_t numConstraints = state.lambda.size(), numParameters = state.theta.values.size();
    archive.add("hasDensity", memory.hasDensity);
    archive.add("density", memory.rho);
    archive.add("parameters", state.theta.values, numParameters);
    archive.add("parameterRates", state.theta.rates, numParameters);
    archive.add("multiplierOffset", state.offset.found, numConstraints);
    archive.add("multipliers", state.lambda, numConstraints);
    archive.add("monitorValues", state.values, numMonitors);
    archive.add("hasHalfStepValue", memory.hasHalfStepValue);
    archive.add("halfStepValue", memory.halfStepValue);
    archive.add("rate", memory.rate);
    archive.add("densityOffset", memory.densityOffset);
    if (!isAutomatic)
        return;
    AutomaticControl::Memory& control = memory.automatic;
    archive.add("automaticBehind", {&control.behind[0], &control.behind[1]});
    archive.add("automaticAhead", {&control.ahead[0], &control.ahead[1]});
    archive.add("automaticValues", {&control.values[0], &control.values[1]});
    archive.add("automaticForceSquares", control.forceSquares, getAutomaticControl().getMemory().forceSquares.size());
    archive.add("automaticLearning", {&control.stepsSinceStart, &control.numLearnt, &control.logarithms[0],
                                      &control.logarithms[1], &control.temperature, &control.following});
    archive.add("automaticShortSteps", {&control.shortSteps, &control.mostShortSteps});
}

void VRattleRun::save(RunState& run) {
    Kept kept = keep();
    run.halfStepVelocities = kept.state.w;
    for (size_t k = 0; k < kept.state.lambda.size(); k++) // the difference is all that counts
        kept.state.offset.found[k] -= kept.state.offset.expected[k];
    if (settings.isAutomatic)
        kept.state.values.clear(); // which were of monitors
    exchange(kept.state, kept.memory, RunState::Archive(run), kept.state.values.size(), settings.isAutomatic);
}

void VRattleRun::read(const RunState& run, const IntegratorSettings& saved, StepState& state, Memory& memory) {
    exchange(state, memory, RunState::Archive(run), saved.isAutomatic ? 0 : saved.terms.size(), saved.isAutomatic);
    const vector<double>& rates = state.theta.rates;
    state.theta.isMoving = std::any_of(rates.begin(), rates.end(), [](double rate) { return rate != 0; });
    state.w = run.halfStepVelocities;
    memory.references = run.findings.references;
}

bool VRattleRun::canResume(const RunState& run, const IntegratorSettings& saved) {
    StepState state(getConstraintSystem());
    Memory memory;
    read(run, saved, state, memory);
    return state.w.size() == state.q.size();
}

void VRattleRun::resume(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                        double energy, const RunState& run, const IntegratorSettings& saved) {
    StepState state(getConstraintSystem());
    Memory memory;
    read(run, saved, state, memory);
    state.q = positions;
    state.v = velocities;
    state.force = forces;
    state.groupEnergy = energy;
    resume(state, memory);
}
