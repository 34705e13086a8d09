// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "HostRunDevice.h"
#include "HostLangevinDevice.h"
#include "HostVRattleDevice.h"
#include "openmm/OpenMMException.h"
#include "run/Fingerprint.h"
#include "run/IntegratorSettings.h"
#include "run/RunState.h"
#include "run/StartCheck.h"
#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <random>

using namespace OpenMMVRattle;
using OpenMM::ContextImpl;
using OpenMM::OpenMMException;
using OpenMM::System;
using OpenMM::Vec3;
using std::vector;

namespace {

const int NO_MONITOR_GROUP = -1, NUM_POSITION_SUMS = 8;
// Forces computed twice differ by no more than this fraction, whatever the order of summation in single precision.
const double FORCE_ROUNDING = 1e-4;

// Whether there is a box in which positions may have been wrapped: one that a Force uses, or that is not OpenMM's default.
bool hasPeriodicBox(const System& system, const Vec3* boxVectors) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            if (boxVectors[i][j] != (i == j ? 2.0 : 0.0))
                return true;
    for (int i = 0; i < system.getNumForces(); i++) {
        try {
            if (system.getForce(i).usesPeriodicBoundaryConditions())
                return true;
        }
        catch (const OpenMMException&) {
            // a Force that does not tell
        }
    }
    return false;
}

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

} // namespace

std::unique_ptr<HostRunDevice> OpenMMVRattle::makeHostRunDevice(ContextImpl& context,
                                                                std::unique_ptr<ContextVectors> vectors,
                                                                const OpenMM::Integrator& integrator,
                                                                const IntegratorSettings& settings) {
    if (settings.langevin)
        return std::make_unique<HostLangevinDevice>(context, std::move(vectors), integrator, settings);
    return std::make_unique<HostVRattleDevice>(context, std::move(vectors), integrator, settings);
}

HostRunDevice::HostRunDevice(ContextImpl& context, std::unique_ptr<ContextVectors> vectors,
                             const OpenMM::Integrator& integrator, const IntegratorSettings& integratorSettings) :
        context(context), vectors(std::move(vectors)), integrator(integrator),
        expressions(integratorSettings.expressions), forceGroups(0), monitorForceGroup(NO_MONITOR_GROUP),
        lastStep{0.0, 1.0}, numForceEvaluations(0) {
    const System& system = context.getSystem();
    masses.resize(system.getNumParticles());
    for (int i = 0; i < system.getNumParticles(); i++)
        masses[i] = system.getParticleMass(i);
    isVirtualSite.resize(system.getNumParticles());
    for (int i = 0; i < system.getNumParticles(); i++)
        isVirtualSite[i] = system.isVirtualSite(i);
    hasMassless = std::any_of(masses.begin(), masses.end(), [](double mass) { return mass == 0; });
    for (int i = 0; i < system.getNumForces(); i++)
        reach.add(system.getForce(i));
}

vector<DistanceConstraint> HostRunDevice::getConstraints() const {
    const System& system = context.getSystem();
    vector<DistanceConstraint> constraints(system.getNumConstraints());
    for (int i = 0; i < system.getNumConstraints(); i++) {
        DistanceConstraint& c = constraints[i];
        system.getConstraintParameters(i, c.particle1, c.particle2, c.length);
    }
    return constraints;
}

// -------------------------------------------------------------------------------------------------------- the settings

void HostRunDevice::setSettings(const IntegratorSettings& from) {
    setDynamics(from);
    forceGroups = from.getActingForceGroups();
    monitorForceGroup = from.usesMonitorForceGroup() ? from.monitorForceGroup : NO_MONITOR_GROUP;
    for (size_t i = 0; i < expressions.size(); i++)
        if (expressions[i].parameters != from.expressions[i].parameters) {
            expressions[i].parameters = from.expressions[i].parameters;
            dynamics->setParameters((int) i, expressions[i].parameters);
        }
}

vector<double> HostRunDevice::getReferences() {
    return dynamics->getReferences();
}

void HostRunDevice::setReferences(const vector<double>& references) {
    dynamics->setReferences(references);
}

// ------------------------------------------------------------------------------------------ what happens to the Context

bool HostRunDevice::updateState() {
    return context.updateContextState();
}

RunDevice::Change HostRunDevice::findChange() {
    const Vec3* box = vectors->getBoxVectors();
    const bool isOtherBox = !std::equal(boxVectors, boxVectors + 3, box);
    std::copy(box, box + 3, boxVectors);
    if (isOtherBox || dynamics->getPositions().empty())
        return Change::Box;
    // A look at all positions and velocities is spent only where it may find something: where a Force may have changed them, or
    // another integrator (of a CompoundIntegrator) may have taken steps.
    const bool mustCompare = ahead != nullptr || &context.getIntegrator() != &integrator;
    if ((mustCompare || reach.isUnknown || reach.hasBarostat) && differ(vectors->getPositions(), knownPositions()))
        return Change::State;
    if ((mustCompare || reach.isUnknown || reach.hasBarostat || reach.hasThermostat || reach.movesFrame) &&
        differ(vectors->getVelocities(), knownVelocities()))
        return Change::Velocities;
    return Change::None;
}

unsigned long long HostRunDevice::getFingerprint() {
    const Vectors& velocities = vectors->getVelocities();
    Fingerprint fingerprint;
    // In the digits that every platform keeps, so that it knows a state again that comes from another one. Positions change by rounding
    // where they are wrapped into the box; resume() compares them.
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            for (int d = 0; d < 3; d++)
                fingerprint.add((double) (float) velocities[i][d]);
    for (int i = 0; i < 3; i++)
        fingerprint.add(vectors->getBoxVectors()[i]);
    return fingerprint.get();
}

// Some sums of all positions with signs by chance, the same everywhere: whoever moves particles changes them.
vector<double> HostRunDevice::sumPositions() {
    vector<double> sums(NUM_POSITION_SUMS, 0.0);
    std::minstd_rand random;
    const Vectors& positions = vectors->getPositions();
    for (size_t i = 0; i < masses.size(); i++)
        for (int d = 0; d < 3; d++) {
            const unsigned signs = (unsigned) random() >> 8;
            for (int k = 0; k < NUM_POSITION_SUMS && masses[i] > 0; k++)
                sums[k] += (signs >> k & 1) != 0 ? positions[i][d] : -positions[i][d];
        }
    return sums;
}

unsigned long long HostRunDevice::getParameterFingerprint() {
    Fingerprint fingerprint;
    for (const auto& parameter : context.getParameters()) {
        fingerprint.addBytes(parameter.first.c_str(), parameter.first.size() + 1);
        fingerprint.add(parameter.second);
    }
    return fingerprint.get();
}

void HostRunDevice::start() {
    const Vec3* box = vectors->getBoxVectors();
    const bool hasBox = hasPeriodicBox(context.getSystem(), box);
    const Vectors before = vectors->getPositions();
    const std::function<void()> putBackDynamics = dynamics->remember();
    try {
        dynamics->adoptParameters();
        requireSoundStart(dynamics->getConstraintSystem(),
                          {vectors->getPositions(), vectors->getVelocities(), isVirtualSite, hasBox ? box : nullptr,
                           dynamics->getParameters()});
        context.computeVirtualSites(); // setPositions() leaves them where the user puts them
        context.calcForcesAndEnergy(false, false, 0); // throws if no positions have been set, and computes nothing
        Vectors positions = vectors->getPositions(), forces;
        dynamics->projectPositions(positions);
        const double energy = computeForcesAt(positions, forces);
        dynamics->begin(positions, vectors->getVelocities(), forces, energy);
    }
    catch (...) {
        vectors->setPositions(before);
        putBackDynamics();
        throw;
    }
    ahead.reset(new Ahead{vectors->getPositions(), vectors->getVelocities()});
}

void HostRunDevice::changeState() {
    Vectors positions = vectors->getPositions(), forces;
    dynamics->projectPositions(positions); // a barostat that moves each particle by itself keeps no constraint
    const double energy = computeForcesAt(positions, forces);
    dynamics->changeState(positions, vectors->getVelocities(), forces, energy);
    ahead.reset(new Ahead{vectors->getPositions(), vectors->getVelocities()});
}

void HostRunDevice::changeVelocities() {
    if (ahead == nullptr && dynamics->changeFrame(vectors->getVelocities()))
        return;
    dynamics->changeVelocities(vectors->getVelocities());
    ahead.reset(new Ahead{vectors->getPositions(), vectors->getVelocities()});
}

void HostRunDevice::writeVelocities() {
    writeMovingVelocities(dynamics->getVelocities());
    if (ahead != nullptr)
        ahead->velocities = vectors->getVelocities();
}

void HostRunDevice::changeForces() {
    Vectors forces;
    const double energy = computeForcesAt(dynamics->getPositions(), forces);
    dynamics->changeForces(forces, energy);
}

// The forces at positions that may not be those of the Context, which keeps its own; returns the energy of the monitor's group.
double HostRunDevice::computeForcesAt(const Vectors& positions, Vectors& forces) {
    const bool isElsewhere = differ(vectors->getPositions(), positions);
    const Vectors before = isElsewhere ? vectors->getPositions() : Vectors();
    auto putBack = [&] {
        if (isElsewhere)
            vectors->setPositions(before);
    };
    double energy;
    try {
        if (isElsewhere) {
            writeMovingPositions(positions);
            context.computeVirtualSites();
        }
        energy = computeForces();
    }
    catch (...) {
        putBack();
        throw;
    }
    forces = vectors->getForces();
    putBack();
    return energy;
}

double HostRunDevice::computeForces() {
    // The energy first: some platforms use up the forces for it.
    const double energy =
        monitorForceGroup == NO_MONITOR_GROUP ? 0.0 : context.calcForcesAndEnergy(false, true, 1 << monitorForceGroup);
    context.calcForcesAndEnergy(true, false, forceGroups);
    numForceEvaluations++;
    return energy;
}

const vector<Vec3>& HostRunDevice::knownPositions() const {
    return ahead != nullptr ? ahead->positions : dynamics->getPositions();
}

const vector<Vec3>& HostRunDevice::knownVelocities() const {
    return ahead != nullptr ? ahead->velocities : dynamics->getVelocities();
}

// Particles of mass zero are not the integrator's to move: they are virtual sites, or fixed.
bool HostRunDevice::differ(const Vectors& a, const Vectors& b) const {
    std::atomic<bool> areSame(true);
    dynamics->share((int) masses.size(), [&](int first, int end) {
        for (int i = first; i < end && areSame; i++)
            if (masses[i] > 0 && a[i] != b[i])
                areSame = false;
    });
    return !areSame;
}

void HostRunDevice::writeMovingPositions(const Vectors& positions) {
    if (Vectors* storage = vectors->accessPositions())
        copyMoving(positions, *storage);
    else if (!hasMassless)
        vectors->setPositions(positions);
    else {
        Vectors all = vectors->getPositions();
        copyMoving(positions, all);
        vectors->setPositions(all);
    }
}

void HostRunDevice::writeMovingVelocities(const Vectors& velocities) {
    if (Vectors* storage = vectors->accessVelocities())
        copyMoving(velocities, *storage);
    else if (!hasMassless)
        vectors->setVelocities(velocities);
    else {
        Vectors all = vectors->getVelocities();
        copyMoving(velocities, all);
        vectors->setVelocities(all);
    }
}

void HostRunDevice::copyMoving(const Vectors& from, Vectors& to) const {
    dynamics->share((int) masses.size(), [&](int first, int end) {
        for (int i = first; i < end; i++)
            if (masses[i] > 0)
                to[i] = from[i];
    });
}

// ----------------------------------------------------------------------------------------------------------- the steps

// One step of the method in the Context, the velocities excepted. Forces see the time of its end.
double HostRunDevice::advance(double maxTime, double direction) {
    const double time = vectors->getTime(), maxStep = maxTime - time;
    while (true) {
        const double size = dynamics->step(maxStep);
        vectors->setTime(size < maxStep ? time + direction * size : maxTime);
        writeMovingPositions(dynamics->getNextPositions());
        context.computeVirtualSites();
        const double energy = computeForces();
        if (dynamics->finish(vectors->getForces(), energy))
            return size;
    }
}

void HostRunDevice::step(double maxTime) {
    const double time = vectors->getTime();
    const long long count = vectors->getStepCount();
    try {
        vectors->setStepCount(count + 1);
        lastStep.size = advance(maxTime, 1);
    }
    catch (...) {
        vectors->setTime(time);
        vectors->setStepCount(count);
        dynamics->abandonStep();
        putBack();
        throw;
    }
    lastStep.density = dynamics->getDensity();
    writeMovingVelocities(dynamics->getVelocities());
    ahead.reset();
}

void HostRunDevice::settle() {
}

// The positions of the Context before a step.
void HostRunDevice::putBack() {
    if (ahead != nullptr) {
        vectors->setPositions(ahead->positions);
        return;
    }
    writeMovingPositions(dynamics->getPositions());
    context.computeVirtualSites();
}

void HostRunDevice::reverse() {
    dynamics->reverse();
    lastStep.density = dynamics->getDensity();
    Vectors velocities = vectors->getVelocities();
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            velocities[i] *= -1;
    vectors->setVelocities(velocities);
    if (ahead != nullptr)
        ahead->velocities = velocities;
}

RunDevice::LastStep HostRunDevice::getLastStep() {
    return lastStep;
}

double HostRunDevice::getTime() {
    return vectors->getTime();
}

long long HostRunDevice::getStepCount() {
    return vectors->getStepCount();
}

// ------------------------------------------------------------------------------------------------------------- numbers

vector<double> HostRunDevice::getMultipliers() {
    vector<double> result;
    dynamics->getConstraintSystem().getGivenMultipliers(dynamics->getMultipliers(), result);
    return result;
}

double HostRunDevice::computeKineticEnergy() {
    double sum = 0;
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0) // the velocities of the others have no meaning, and may be no numbers
            sum += masses[i] * vectors->getVelocities()[i].dot(vectors->getVelocities()[i]);
    return 0.5 * sum;
}

long long HostRunDevice::getNumForceEvaluations() {
    return numForceEvaluations;
}

long long HostRunDevice::getNumSolverIterations() {
    return dynamics->getNumIterations();
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void HostRunDevice::save(RunState& run) {
    saveDynamics(run);
    run.methodValues["positionSums"] = sumPositions();
    run.forces = dynamics->getForces();
    run.groupEnergy = dynamics->getGroupEnergy();
    std::copy(boxVectors, boxVectors + 3, run.boxVectors);
    if (differ(vectors->getPositions(), dynamics->getPositions()))
        run.positions = dynamics->getPositions();
    if (differ(vectors->getVelocities(), dynamics->getVelocities()))
        run.velocities = dynamics->getVelocities();
    run.isContextAhead = ahead != nullptr;
    if (ahead != nullptr && differ(vectors->getPositions(), ahead->positions))
        run.contextPositions = ahead->positions;
    if (ahead != nullptr && differ(vectors->getVelocities(), ahead->velocities))
        run.contextVelocities = ahead->velocities;
}

bool HostRunDevice::resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) {
    const vector<double> sums = sumPositions(), &savedSums = run.getMethodValues("positionSums", NUM_POSITION_SUMS);
    const double largest = 4 * getPositionRounding() * std::sqrt(3.0 * masses.size());
    for (int k = 0; k < NUM_POSITION_SUMS; k++)
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
    resumeDynamics({positions, velocities, forces, energy}, run, saved);
    ahead.reset();
    if (run.isContextAhead)
        ahead.reset(new Ahead{run.contextPositions.empty() ? vectors->getPositions() : run.contextPositions,
                              run.contextVelocities.empty() ? vectors->getVelocities() : run.contextVelocities});
    std::copy(run.boxVectors, run.boxVectors + 3, boxVectors);
    return true;
}
