// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/HostRunDevice.h"
#include "constraints/StepFailure.h"
#include "run/Fingerprint.h"
#include "run/IntegratorSettings.h"
#include "run/LangevinRun.h"
#include "run/RunState.h"
#include "run/StartCheck.h"
#include "run/VRattleRun.h"
#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::System;
using OpenMM::Vec3;
using std::vector;

namespace {

// Forces computed twice differ by no more than this fraction, whatever the order of summation in single precision.
const double FORCE_ROUNDING = 1e-4;

// Whether two sets of forces are the same but for rounding; a particle in equilibrium is measured by the others.
bool agree(const vector<Vec3>& a, const vector<Vec3>& b) {
    double meanSquare = 0;
    for (const Vec3& force : a)
        meanSquare += force.dot(force) / a.size();
    for (size_t i = 0; i < a.size(); i++) {
        const Vec3 change = b[i] - a[i];
        if (!(change.dot(change) <= FORCE_ROUNDING * FORCE_ROUNDING * std::max(meanSquare, a[i].dot(a[i]))))
            return false;
    }
    return true;
}

// Whether two vectors differ by no more than this, absolutely or relatively.
bool isRounding(const Vec3& a, const Vec3& b, double rounding) {
    for (int d = 0; d < 3; d++)
        if (!(std::fabs(a[d] - b[d]) <= rounding * std::max(1.0, std::fabs(a[d]))))
            return false;
    return true;
}

vector<double> massesOf(const System& system) {
    vector<double> masses;
    for (int i = 0; i < system.getNumParticles(); i++)
        masses.push_back(system.getParticleMass(i));
    return masses;
}

vector<DistanceConstraint> constraintsOf(const System& system) {
    vector<DistanceConstraint> constraints(system.getNumConstraints());
    for (int i = 0; i < system.getNumConstraints(); i++) {
        DistanceConstraint& c = constraints[i];
        system.getConstraintParameters(i, c.particle1, c.particle2, c.length);
    }
    return constraints;
}

} // namespace

std::unique_ptr<RunDevice> OpenMMVRattle::makeHostRunDevice(std::unique_ptr<ContextVectors> vectors,
                                                            const System& system, const IntegratorSettings& settings,
                                                            const SharedWork::Parallel& parallel, int numThreads) {
    if (settings.langevin)
        return std::make_unique<HostRunDevice<LangevinRun>>(std::move(vectors), system, settings, parallel, numThreads);
    return std::make_unique<HostRunDevice<VRattleRun>>(std::move(vectors), system, settings, parallel, numThreads);
}

template <class Method>
HostRunDevice<Method>::HostRunDevice(std::unique_ptr<ContextVectors> vectors, const System& system,
                                     const IntegratorSettings& settings, const SharedWork::Parallel& parallel,
                                     int numThreads) :
        vectors(std::move(vectors)), system(system), masses(massesOf(system)), expressions(settings.expressions),
        method(masses, constraintsOf(system), expressions) {
    method.setParallel(parallel, numThreads);
    hasMassless = std::any_of(masses.begin(), masses.end(), [](double mass) { return mass == 0; });
    for (int i = 0; i < system.getNumForces(); i++)
        reach.add(system.getForce(i));
}

// -------------------------------------------------------------------------------------------------------- the settings

template <class Method> void HostRunDevice<Method>::setSettings(const IntegratorSettings& from) {
    if (method.getConstraintSystem().getNumConstraints() == 0 && StepMonitor::needConstraints(from.terms))
        throw StepFailure("a monitor of the constraint forces is set (ConstraintMultipliers is the default) and the "
                          "System has no constraints; choose a monitor of the applied forces, such as AppliedForce or "
                          "ForcePNorm, with clearMonitors() and addMonitor(), or call clearMonitors() for fixed steps");
    method.setSettings(from);
    forceGroups = from.getActingForceGroups();
    energyGroup = from.getEnergyGroup();
}

template <class Method> bool HostRunDevice<Method>::setParameters(const vector<ExpressionConstraint>& given) {
    bool areOthers = false;
    for (size_t i = 0; i < expressions.size(); i++)
        if (expressions[i].parameters != given[i].parameters) {
            expressions[i].parameters = given[i].parameters;
            method.setParameters((int) i, expressions[i].parameters);
            areOthers = true;
        }
    return areOthers;
}

// ------------------------------------------------------------------------------------------ what happens to the Context

// Whether the periodic box is another one than when this was asked before.
template <class Method> bool HostRunDevice<Method>::isOtherBox() {
    const Vec3* box = vectors->getBoxVectors();
    const bool isOther = !std::equal(boxVectors, boxVectors + 3, box);
    std::copy(box, box + 3, boxVectors);
    return isOther;
}

template <class Method> RunDevice::Change HostRunDevice<Method>::findChange() {
    if (isOtherBox() || method.getPositions().empty())
        return Change::Box;
    // A look at all positions and velocities is spent only where it may find something: where a Force may have changed them, or
    // another integrator (of a CompoundIntegrator) may have taken steps.
    const bool mayHaveMoved = ahead || vectors->isSharedByIntegrators() || reach.isUnknown || reach.hasBarostat;
    if (mayHaveMoved && differ(vectors->getPositions(), ahead ? ahead->positions : method.getPositions()))
        return Change::State;
    if ((mayHaveMoved || reach.hasThermostat || reach.movesFrame) &&
        differ(vectors->getVelocities(), ahead ? ahead->velocities : method.getVelocities()))
        return Change::Velocities;
    return Change::None;
}

template <class Method> void HostRunDevice<Method>::start() {
    auto putBack = [&, before = vectors->getPositions(), putBackMethod = method.remember()] {
        vectors->setPositions(before);
        putBackMethod();
    };
    auto start = [&] {
        method.adoptParameters();
        requireSoundStart(
            system, method.getConstraintSystem(),
            {vectors->getPositions(), vectors->getVelocities(), vectors->getBoxVectors(), method.getParameters()});
        vectors->computeVirtualSites(); // setPositions() leaves them where the user puts them
        vectors->requirePositions();
        takeContext(true);
    };
    attempt(start, putBack);
}

// Go on from the Context's state, moved onto the constraints.
template <class Method> void HostRunDevice<Method>::takeContext(bool isStart) {
    Vectors positions = vectors->getPositions(), forces;
    // A barostat that moves each particle by itself keeps no constraint either.
    method.projectPositions(positions, method.getParameters());
    const double energy = computeForcesAt(positions, forces);
    if (isStart)
        method.begin(positions, vectors->getVelocities(), forces, energy);
    else
        method.changeState(positions, vectors->getVelocities(), forces, energy);
    noteContext();
    stepMark = getStepMark();
}

template <class Method> void HostRunDevice<Method>::changeState() {
    if (!haveOthersStepped()) {
        takeContext(false);
        return;
    }
    // Nobody knows where others have had the constraints before their last step.
    auto take = [&] {
        method.adoptParameters();
        takeContext(false);
    };
    attempt(take, method.remember());
}

template <class Method> void HostRunDevice<Method>::changeVelocities() {
    const bool isFrame =
        method.changeFrame(ahead ? ahead->velocities : method.getVelocities(), vectors->getVelocities());
    if (!isFrame)
        method.changeVelocities(vectors->getVelocities());
    if (!isFrame || ahead)
        noteContext();
}

template <class Method> void HostRunDevice<Method>::writeVelocities() {
    vectors->writeVelocities(writerOf(method.getVelocities()), !hasMassless);
    if (ahead)
        noteContext();
}

// The Context is not in the method's state, and this is what is known of it.
template <class Method> void HostRunDevice<Method>::noteContext() {
    ahead = Ahead{vectors->getPositions(), vectors->getVelocities()};
}

template <class Method> void HostRunDevice<Method>::changeForces() {
    Vectors forces;
    const double energy = computeForcesAt(method.getPositions(), forces);
    method.changeForces(forces, energy);
}

// The forces at positions that may not be those of the Context, which keeps its own; returns the energy of the monitor's group.
template <class Method> double HostRunDevice<Method>::computeForcesAt(const Vectors& positions, Vectors& forces) {
    const bool isElsewhere = differ(vectors->getPositions(), positions);
    double energy = 0;
    auto putBack = [&, before = isElsewhere ? vectors->getPositions() : Vectors()] {
        if (!isElsewhere)
            return;
        vectors->setPositions(before);
        if (vectors->isSharedByIntegrators())
            vectors->invalidateForces();
    };
    auto compute = [&] {
        if (isElsewhere)
            moveContext(positions);
        energy = computeForces();
    };
    attempt(compute, putBack);
    forces = vectors->getForces();
    putBack();
    return energy;
}

template <class Method> double HostRunDevice<Method>::computeForces() {
    const double energy = vectors->computeForces(forceGroups, energyGroup);
    numForceEvaluations++;
    return energy;
}

// Whether two sets of positions or velocities are others than their digits explain, for the particles that move. Those of mass zero
// are not the integrator's to move: they are virtual sites, or fixed.
template <class Method> bool HostRunDevice<Method>::differ(const Vectors& a, const Vectors& b) {
    const double rounding = getPositionRounding();
    std::atomic<bool> areSame(true);
    method.share((int) masses.size(), [&](int first, int end) {
        for (int i = first; i < end && areSame; i++)
            if (masses[i] > 0 && a[i] != b[i] && !isRounding(a[i], b[i], rounding))
                areSame = false;
    });
    return !areSame;
}

template <class Method> void HostRunDevice<Method>::moveContext(const Vectors& positions) {
    vectors->writePositions(writerOf(positions), !hasMassless);
    vectors->computeVirtualSites();
}

// Writes those of the particles that move, on all threads.
template <class Method> ContextVectors::Writer HostRunDevice<Method>::writerOf(const Vectors& from) {
    return [&](Vectors& to) {
        method.share((int) masses.size(), [&](int first, int end) {
            if (!hasMassless) {
                std::copy(from.begin() + first, from.begin() + end, to.begin() + first);
                return;
            }
            for (int i = first; i < end; i++)
                if (masses[i] > 0)
                    to[i] = from[i];
        });
    };
}

// ----------------------------------------------------------------------------------------------------------- the steps

// One step of the method in the Context, the velocities excepted. Forces see the time of its end.
template <class Method> double HostRunDevice<Method>::advance(double maxTime) {
    const double time = vectors->getTime(), maxStep = maxTime - time;
    while (true) {
        const double size = method.step(maxStep);
        vectors->setTime(size < maxStep ? time + size : maxTime);
        moveContext(method.getNextPositions());
        const double energy = computeForces();
        if (method.finish(vectors->getForces(), energy))
            return size;
    }
}

template <class Method> void HostRunDevice<Method>::step(double maxTime) {
    auto putBackAll = [&, time = vectors->getTime(), count = vectors->getStepCount()] {
        vectors->setTime(time);
        vectors->setStepCount(count);
        method.abandonStep();
        putBack();
    };
    auto take = [&] {
        vectors->setStepCount(vectors->getStepCount() + 1);
        lastStep.size = advance(maxTime);
    };
    attempt(take, putBackAll);
    lastStep.density = method.getDensity();
    ahead.reset();
    HostRunDevice::writeVelocities();
    stepMark = getStepMark();
}

// The positions of the Context before a step.
template <class Method> void HostRunDevice<Method>::putBack() {
    if (ahead)
        vectors->setPositions(ahead->positions);
    else
        moveContext(method.getPositions());
}

template <class Method> void HostRunDevice<Method>::reverse() {
    method.reverse();
    lastStep.density = method.getDensity();
    auto turnAround = [&](Vectors& velocities) {
        for (size_t i = 0; i < masses.size(); i++)
            if (masses[i] > 0)
                velocities[i] *= -1;
    };
    vectors->writeVelocities(turnAround, false);
    if (ahead)
        noteContext();
}

template <class Method>
void HostRunDevice<Method>::tryOut(double stepSize, int count, const std::function<void(const vector<double>&)>& look) {
    auto end = [&, time = vectors->getTime(), putBackMethod = method.remember()] {
        putBackMethod();
        vectors->setTime(time);
        putBack();
    };
    auto takeSteps = [&] {
        method.beginFixedSteps(stepSize);
        for (int i = 0; i < count; i++) {
            advance(std::numeric_limits<double>::infinity());
            look(method.getMonitorValues());
        }
    };
    attempt(takeSteps, end);
    end();
}

// ------------------------------------------------------------------------------------------------------------- numbers

template <class Method> vector<double> HostRunDevice<Method>::getMultipliers() {
    vector<double> result;
    method.getConstraintSystem().getGivenMultipliers(method.getMultipliers(), result);
    return result;
}

template <class Method> double HostRunDevice<Method>::getExpressionMultiplier(int index) {
    return method.getConstraintSystem().getExpressionMultiplier(index, method.getMultipliers());
}

template <class Method> double HostRunDevice<Method>::computeKineticEnergy() {
    double sum = 0;
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0) // the velocities of the others have no meaning, and may be no numbers
            sum += masses[i] * vectors->getVelocities()[i].dot(vectors->getVelocities()[i]);
    return 0.5 * sum;
}

template <class Method> double HostRunDevice<Method>::computeHalfStepKineticEnergy() {
    if constexpr (std::is_same_v<Method, LangevinRun>)
        return method.computeHalfStepKineticEnergy();
    return computeKineticEnergy();
}

// ------------------------------------------------------------------------------------------------- saving and resuming

template <class Method> void HostRunDevice<Method>::save(RunState& run) {
    method.save(run);
    run.methodValues["positionSums"] = sumPositions(vectors->getPositions(), masses);
    run.forces = method.getForces();
    run.groupEnergy = method.getGroupEnergy();
    std::copy(boxVectors, boxVectors + 3, run.boxVectors);
    if (differ(vectors->getPositions(), method.getPositions()))
        run.positions = method.getPositions();
    if (differ(vectors->getVelocities(), method.getVelocities()))
        run.velocities = method.getVelocities();
    run.isContextAhead = ahead.has_value();
    if (ahead && differ(vectors->getPositions(), ahead->positions))
        run.contextPositions = ahead->positions;
    if (ahead && differ(vectors->getVelocities(), ahead->velocities))
        run.contextVelocities = ahead->velocities;
}

template <class Method>
bool HostRunDevice<Method>::resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) {
    const vector<double> sums = sumPositions(vectors->getPositions(), masses),
                         &savedSums = run.getMethodValues("positionSums", sums.size());
    const double largest = 4 * getPositionRounding() * std::sqrt(3.0 * masses.size());
    for (size_t k = 0; k < sums.size(); k++)
        if (!(std::fabs(sums[k] - savedSums[k]) <= largest))
            return false;
    const Vectors& positions = run.positions.empty() ? vectors->getPositions() : run.positions;
    const Vectors& velocities = run.velocities.empty() ? vectors->getVelocities() : run.velocities;
    Vectors forces = run.forces;
    double energy = run.groupEnergy;
    if (!areForcesOthers)
        energy = computeForcesAt(positions, forces);
    const double larger = std::max(std::fabs(energy), std::fabs(run.groupEnergy));
    if (!agree(forces, run.forces) || !(std::fabs(energy - run.groupEnergy) <= FORCE_ROUNDING * larger))
        return false;
    method.resume(positions, velocities, forces, energy, run, saved);
    ahead.reset();
    if (run.isContextAhead)
        ahead = Ahead{run.contextPositions.empty() ? vectors->getPositions() : run.contextPositions,
                      run.contextVelocities.empty() ? vectors->getVelocities() : run.contextVelocities};
    std::copy(run.boxVectors, run.boxVectors + 3, boxVectors);
    // That others have taken steps before it was saved shows in the positions.
    const bool areOthers = vectors->isSharedByIntegrators() &&
                           differ(vectors->getPositions(), ahead ? ahead->positions : method.getPositions());
    stepMark = areOthers ? NO_MARK : getStepMark();
    return true;
}

template class OpenMMVRattle::HostRunDevice<VRattleRun>;
template class OpenMMVRattle::HostRunDevice<LangevinRun>;
