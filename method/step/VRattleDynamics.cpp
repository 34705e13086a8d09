// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/VRattleDynamics.h"
#include <algorithm>
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// A step asked to end at a given time may be longer than the density says by this fraction, so that no sliver is left.
const double SLIVER = 1e-6;
// A relative change of the velocities that starts no oscillation to speak of.
const double SMALL_JUMP = 0.01;
// Keeps what is at rest from being divided by zero.
const double TINY = 1e-100;

} // namespace

VRattleDynamics::VRattleDynamics(const vector<double>& masses, const vector<DistanceConstraint>& distances,
                                 const vector<ExpressionConstraint>& expressions) :
        constraints(masses, distances, expressions), solver(constraints, now), monitors(constraints, solver, now),
        automatic(constraints, solver, now), control(&monitors), settings(), stepKind(StepControl::First), stepSize(0) {
    now.theta = getConstraintSystem().getGivenParameters();
    target = now.theta.values;
    now.w.resize(getConstraintSystem().getNumParticles());
    for (vector<double>* numbers : {&now.lambda, &now.rightSide, &atHalfStep.multipliers, &atHalfStep.rightSide})
        numbers->resize(getConstraintSystem().getNumConstraints());
    constraints.moveTo(now.q, now.theta, now.force);
}

StepControl& VRattleDynamics::controlOf(const Settings& which) {
    if (which.isAutomatic)
        return automatic;
    return monitors;
}

void VRattleDynamics::setSettings(const Settings& newSettings) {
    StepControl& next = controlOf(newSettings);
    const bool goesOn = next.setSettings(newSettings, control == &next);
    control = &next;
    settings = newSettings;
    solver.setSettings(settings.stepSize, settings.tolerance);
    if (now.q.empty() || goesOn)
        return;
    control->changeSettings();
    if (control->hasStarted())
        formHalfStepVelocities();
}

// ------------------------------------------------------------------------------------------- between two steps

bool VRattleDynamics::projectPositions(vector<Vec3>& positions) {
    return constraints.projectPositions(positions, now.theta);
}

void VRattleDynamics::adoptParameters() {
    now.theta.values = target;
    constraints.moveTo(now.q, now.theta, now.force);
}

template <class Change> void VRattleDynamics::attempt(const Change& change) {
    const Kept before = keep();
    try {
        change();
    }
    catch (...) {
        putBack(before);
        throw;
    }
}

void VRattleDynamics::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy) {
    attempt([&] {
        target = now.theta.values;
        std::fill(now.theta.rates.begin(), now.theta.rates.end(), 0.0);
        now.theta.isMoving = false;
        takeOver(positions, velocities, forces, energy);
        control->begin();
    });
}

// An on-step state that no step has led to, from somebody else.
void VRattleDynamics::takeOver(const vector<Vec3>& positions, const vector<Vec3>& velocities,
                               const vector<Vec3>& forces, double energy) {
    now.q = positions;
    now.v = velocities;
    now.force = forces;
    now.groupEnergy = energy;
    // Particles without mass stay as they are, in whatever array is written.
    solver.next.q = positions;
    now.w = solver.next.w = solver.next.v = velocities;
    std::fill(solver.multiplierOffset.begin(), solver.multiplierOffset.end(), 0.0);
    constraints.finish({now.q, velocities, now.force, now.theta, 0.0, now.v, now.lambda, now.rightSide, nullptr});
}

void VRattleDynamics::adopt(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy, double density, const double* halfStepValue, double offset) {
    begin(positions, velocities, forces, energy);
    monitors.adopt(density, nullptr, offset);
    formHalfStepVelocities();
    solver.stay();
    stepKind = StepControl::Regular;
    stepSize = settings.stepSize / density;
    vector<Vec3> copy = forces;
    finish(copy, energy); // what a step that has led here would have found
    now.v = velocities; // which have been projected, and so changed in the last bits
    monitors.adopt(density, halfStepValue, offset);
}

void VRattleDynamics::adopt(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy, double density, const AutomaticRecursions::AutomaticNumbers& numbers,
                            const vector<double>& references) {
    begin(positions, velocities, forces, energy);
    now.v = velocities; // which have been projected, and so changed in the last bits
    automatic.adopt(density, numbers, references);
    formHalfStepVelocities();
}

VRattleDynamics::Memory VRattleDynamics::getMemory() const {
    Memory memory = {};
    memory.halfStepVelocities = now.w;
    memory.parameters = now.theta.values;
    memory.parameterRates = now.theta.rates;
    memory.multiplierOffset = solver.multiplierOffset;
    memory.multipliers = now.lambda;
    control->getMemory(memory);
    return memory;
}

VRattleDynamics::Kept VRattleDynamics::keep() const {
    return {settings, now, target, getMemory()};
}

void VRattleDynamics::putBack(const Kept& kept) {
    settings = kept.settings;
    control = &controlOf(settings);
    solver.setSettings(settings.stepSize, settings.tolerance);
    target = kept.target;
    setMemory(kept.memory);
    now = kept.state;
    constraints.moveTo(now.q, now.theta, now.force);
}

void VRattleDynamics::setMemory(const Memory& memory) {
    now.theta.values = memory.parameters;
    now.theta.rates = memory.parameterRates;
    now.theta.isMoving =
        std::any_of(now.theta.rates.begin(), now.theta.rates.end(), [](double rate) { return rate != 0; });
    now.lambda = memory.multipliers;
    now.w = memory.halfStepVelocities;
    solver.multiplierOffset = memory.multiplierOffset;
    control->setMemory(settings, memory);
}

void VRattleDynamics::resume(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                             double energy, const Memory& memory) {
    attempt([&] {
        setMemory(memory); // with the parameters
        takeOver(positions, velocities, forces, energy);
        control->begin();
    });
    now.v = velocities; // this has projected them, which changes the last bits
    setMemory(memory);
}

void VRattleDynamics::changeState(const vector<Vec3>& positions, const vector<Vec3>& velocities,
                                  const vector<Vec3>& forces, double energy) {
    attempt([&] {
        takeOver(positions, velocities, forces, energy);
        control->change(StepControl::Everything, 1.0);
    });
    if (control->hasStarted())
        formHalfStepVelocities();
}

bool VRattleDynamics::changeFrame(const vector<Vec3>& before, const vector<Vec3>& velocities) {
    const vector<int>& movingParticles = constraints.getMovingParticles();
    const int count = (int) movingParticles.size();
    const bool areOwn = &before == &now.v;
    Vec3 shift;
    if (!constraints.findFrameShift(before, velocities, shift))
        return false;
    constraints.share(count, [&](int first, int end) {
        for (int p = first; p < end; p++) {
            const int i = movingParticles[p];
            now.v[i] = areOwn ? velocities[i] : now.v[i] + shift;
            now.w[i] += shift;
        }
    });
    control->change(StepControl::Frame, 0.0);
    return true;
}

// In a metric of masses, over the particles that move.
double VRattleDynamics::squareOf(const vector<Vec3>& x, const vector<double>& weights) {
    const vector<int>& particles = constraints.getMovingParticles();
    return constraints.sum((int) particles.size(), [&](int p) {
        const int i = particles[p];
        return weights[i] * x[i].dot(x[i]);
    });
}

void VRattleDynamics::changeVelocities(const vector<Vec3>& velocities) {
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
    const double part = squareOf(change, masses) / (squareOf(now.v, masses) + TINY);
    control->change(StepControl::Velocities, std::min(1.0, std::sqrt(part)));
}

void VRattleDynamics::changeForces(const vector<Vec3>& forces, double energy) {
    const vector<double>& inverseMasses = getConstraintSystem().getInverseMasses();
    vector<Vec3>& change = solver.next.v;
    for (int i : constraints.getMovingParticles())
        change[i] = forces[i] - now.force[i];
    const double changeSquared = squareOf(change, inverseMasses);
    const double forceSquared = std::max(squareOf(forces, inverseMasses), squareOf(now.force, inverseMasses));
    if (!std::isfinite(changeSquared))
        throw StepFailure("the force on a particle is infinite or not a number");
    attempt([&] {
        now.force = forces;
        now.groupEnergy = energy;
        constraints.moveTo(now.q, now.theta, now.force);
        constraints.findMultipliers(now.v, now.theta, now.lambda, now.rightSide);
        control->change(StepControl::Forces, std::min(1.0, std::sqrt(changeSquared / (forceSquared + TINY))));
    });
    if (control->hasStarted())
        formHalfStepVelocities();
}

// p[n-1/2] = p[n] + (h/(2 rho)) (grad V + G^T Lambda)   (docs/method.md, section 7)
void VRattleDynamics::formHalfStepVelocities() {
    const double kick = 0.5 * settings.stepSize / control->getDensity();
    const vector<double>& inverseMasses = getConstraintSystem().getInverseMasses();
    for (int i : constraints.getMovingParticles())
        now.w[i] = now.v[i] - now.force[i] * (kick * inverseMasses[i]);
    constraints.addTransposedOverMass(now.lambda, kick, now.w);
}

// ------------------------------------------------------------------------------------------------------- the steps

double VRattleDynamics::step(double maxStep) {
    constraints.beginStep();
    prepareStep();
    findJump();
    if (!control->hasStarted() && control->start())
        formHalfStepVelocities();
    if (control->hasStarted()) {
        stepKind = StepControl::Regular;
        control->solve(); // (3.9)-(3.11), (3.14)
    }
    else {
        stepKind = StepControl::First;
        control->findFirstDensity();
    }
    const double full = settings.stepSize / control->getNextDensity();
    if (!std::isfinite(full))
        throw StepFailure("the monitor is zero and there is no maximum step size; set one");
    const bool isShortened = full > maxStep || std::fabs(full - maxStep) <= SLIVER * full;
    stepSize = isShortened ? maxStep : full;
    if (isShortened)
        stepKind = StepControl::Shortened;
    if (stepKind != StepControl::Regular && !solver.solveFromOnStep(stepSize))
        control->throwNotConverged();
    solver.setRates(solver.next.theta, stepSize);
    return stepSize;
}

void VRattleDynamics::prepareStep() {
    solver.prepare(target);
    control->prepare();
}

/*
 * Where parameters begin to move, or stop, the velocities along the constraints jump in the step that comes, and u with them. Where
 * rates change little by little u follows, and nothing is done.
 */
void VRattleDynamics::findJump() {
    if (!control->isVariable() || !(solver.areParametersChanging() || now.theta.isMoving))
        return;
    ExpressionParameters theta = solver.parametersAtRateOf(settings.stepSize / control->getDensity());
    bool isSudden = false;
    for (size_t k = 0; k < theta.rates.size(); k++) {
        const double before = now.theta.rates[k];
        double& rate = theta.rates[k];
        if (std::fabs(rate - before) > 0.5 * std::max(std::fabs(rate), std::fabs(before)))
            isSudden = true;
        else
            rate = before;
    }
    if (!isSudden)
        return;
    const vector<double>& masses = getConstraintSystem().getMasses();
    vector<Vec3>& velocities = solver.next.v;
    for (int i : constraints.getMovingParticles())
        velocities[i] = Vec3();
    constraints.addProjection(now.v, theta, velocities);
    const double changeSquared = squareOf(velocities, masses);
    for (int i : constraints.getMovingParticles())
        velocities[i] += now.v[i];
    const double speedSquared = std::max(squareOf(velocities, masses), squareOf(now.v, masses)) + TINY;
    control->jump(velocities, theta, changeSquared > SMALL_JUMP * SMALL_JUMP * speedSquared);
}

bool VRattleDynamics::finish(vector<Vec3>& forces, double energy) {
    StepState& next = solver.next;
    control->lookBack(forces, energy, stepKind, stepSize);
    const bool withHalfStep = control->needsHalfStep() && stepKind != StepControl::Shortened;
    const ConstraintSolver::OnStep onStep = {next.q,      next.w,         forces,
                                             next.theta,  0.5 * stepSize, next.v,
                                             next.lambda, next.rightSide, withHalfStep ? &atHalfStep : nullptr};
    constraints.finish(onStep, solver.observeOffset(control->observe(onStep))); // (3.12)-(3.13)
    const StepControl::End end = {next, forces, energy, withHalfStep ? &atHalfStep : nullptr, stepKind, stepSize};
    if (!control->measure(end))
        return false;
    // From here on nothing fails.
    constraints.endStep();
    control->accept(end);
    if (stepKind == StepControl::Regular)
        solver.acceptOffset();
    next.force.swap(forces);
    next.groupEnergy = energy;
    std::swap(now, next);
    forces.swap(next.force);
    constraints.moveToEnd();
    control->settle(stepKind);
    if (control->hasStarted() && stepKind == StepControl::Shortened)
        formHalfStepVelocities();
    return true;
}

void VRattleDynamics::abandonStep() {
    control->abandon();
}

void VRattleDynamics::reverse() {
    if (control->hasStarted()) {
        prepareStep();
        control->solve();
        solver.keepOffset();
        for (int i : constraints.getMovingParticles())
            now.w[i] = -solver.next.w[i];
        control->reverse();
    }
    for (int i : constraints.getMovingParticles())
        now.v[i] = -now.v[i];
    for (double& each : now.theta.rates)
        each = -each;
}
