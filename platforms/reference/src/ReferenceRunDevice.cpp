// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ReferenceRunDevice.h"
#include "openmm/AndersenThermostat.h"
#include "openmm/CMAPTorsionForce.h"
#include "openmm/CMMotionRemover.h"
#include "openmm/CustomAngleForce.h"
#include "openmm/CustomBondForce.h"
#include "openmm/CustomCentroidBondForce.h"
#include "openmm/CustomCompoundBondForce.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/CustomGBForce.h"
#include "openmm/CustomHbondForce.h"
#include "openmm/CustomManyParticleForce.h"
#include "openmm/CustomNonbondedForce.h"
#include "openmm/CustomTorsionForce.h"
#include "openmm/GBSAOBCForce.h"
#include "openmm/GayBerneForce.h"
#include "openmm/HarmonicAngleForce.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/NonbondedForce.h"
#include "openmm/OpenMMException.h"
#include "openmm/PeriodicTorsionForce.h"
#include "openmm/RBTorsionForce.h"
#include "run/Fingerprint.h"
#include "run/IntegratorSettings.h"
#include "run/RunState.h"
#include "run/StartCheck.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <typeindex>

using namespace OpenMMVRattle;
using OpenMM::ContextImpl;
using OpenMM::OpenMMException;
using OpenMM::System;
using OpenMM::Vec3;
using std::vector;

namespace {

const int NO_MONITOR_GROUP = -1;
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

// What a Force may change before a step (ForceImpl::updateContextState). Of OpenMM's own Forces that are mere functions of the
// positions we know that they change nothing, of some others that they leave the positions alone; of all others we know nothing.
enum Reach { NoReach, VelocityReach, FullReach };
Reach reachOf(const OpenMM::Force& force) {
    static const std::set<std::type_index> harmless = {
        typeid(OpenMM::CMAPTorsionForce),        typeid(OpenMM::CustomAngleForce),
        typeid(OpenMM::CustomBondForce),         typeid(OpenMM::CustomCentroidBondForce),
        typeid(OpenMM::CustomCompoundBondForce), typeid(OpenMM::CustomExternalForce),
        typeid(OpenMM::CustomGBForce),           typeid(OpenMM::CustomHbondForce),
        typeid(OpenMM::CustomManyParticleForce), typeid(OpenMM::CustomNonbondedForce),
        typeid(OpenMM::CustomTorsionForce),      typeid(OpenMM::GBSAOBCForce),
        typeid(OpenMM::GayBerneForce),           typeid(OpenMM::HarmonicAngleForce),
        typeid(OpenMM::HarmonicBondForce),       typeid(OpenMM::NonbondedForce),
        typeid(OpenMM::PeriodicTorsionForce),    typeid(OpenMM::RBTorsionForce)};
    static const std::set<std::type_index> thermal = {typeid(OpenMM::AndersenThermostat),
                                                      typeid(OpenMM::CMMotionRemover)};
    if (harmless.count(typeid(force)) > 0)
        return NoReach;
    return thermal.count(typeid(force)) > 0 ? VelocityReach : FullReach;
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

ReferenceRunDevice::ReferenceRunDevice(ContextImpl& context, OpenMM::ReferencePlatform::PlatformData& data,
                                       const OpenMM::Integrator& integrator,
                                       const IntegratorSettings& integratorSettings) :
        context(context), data(data), integrator(integrator), expressions(integratorSettings.expressions), settings(),
        forceGroups(0), monitorForceGroup(NO_MONITOR_GROUP), mayForcesChangePositions(false),
        mayForcesChangeVelocities(false), lastStep{0.0, 1.0}, numForceEvaluations(0) {
    const System& system = context.getSystem();
    masses.resize(system.getNumParticles());
    for (int i = 0; i < system.getNumParticles(); i++)
        masses[i] = system.getParticleMass(i);
    isVirtualSite.resize(system.getNumParticles());
    for (int i = 0; i < system.getNumParticles(); i++)
        isVirtualSite[i] = system.isVirtualSite(i);
    hasMassless = std::any_of(masses.begin(), masses.end(), [](double mass) { return mass == 0; });
    vector<DistanceConstraint> constraints(system.getNumConstraints());
    for (int i = 0; i < system.getNumConstraints(); i++) {
        DistanceConstraint& c = constraints[i];
        system.getConstraintParameters(i, c.particle1, c.particle2, c.length);
        if (!(c.length > 0) || !std::isfinite(c.length))
            throw OpenMMException("VariableStepRattleIntegrator: constraint " + std::to_string(i) +
                                  " of the System has a length that is not a positive finite number");
    }
    for (int i = 0; i < system.getNumForces(); i++) {
        const Reach reach = reachOf(system.getForce(i));
        mayForcesChangePositions = mayForcesChangePositions || reach == FullReach;
        mayForcesChangeVelocities = mayForcesChangeVelocities || reach != NoReach;
    }
    dynamics = std::make_unique<VRattleDynamics>(masses, constraints, expressions);
    if (context.getPlatform().getName() != "Reference") { // which does everything on one thread
        // This thread is awake and takes the share of the pool's first.
        auto runOnThreads = [this](const std::function<void(int)>& task) {
            this->data.threads.execute([&task](OpenMM::ThreadPool&, int thread) {
                if (thread > 0)
                    task(thread);
            });
            task(0);
            this->data.threads.waitForThreads();
        };
        dynamics->setParallel(runOnThreads, data.threads.getNumThreads());
    }
}

// -------------------------------------------------------------------------------------------------------- the settings

void ReferenceRunDevice::setSettings(const IntegratorSettings& from) {
    VRattleDynamics::Settings to;
    to.stepSize = from.stepSize;
    to.minimumStep = from.stepSize > 0 ? from.getMinimumStep() : 0.0;
    to.maximumStep = from.stepSize > 0 ? from.getMaximumStep() : 0.0;
    to.tolerance = from.constraintTolerance;
    to.update = from.update;
    to.terms = from.monitors;
    to.isFixedStep = false;
    to.isAutomatic = from.isAutomatic;
    to.automaticRequest = from.automaticRequest;
    if (from.isAutomatic)
        std::copy(std::begin(from.automaticReferences), std::end(from.automaticReferences), to.automaticReferences);
    dynamics->setSettings(to);
    settings = to;
    forceGroups = from.getActingForceGroups();
    monitorForceGroup = from.usesMonitorForceGroup() ? from.monitorForceGroup : NO_MONITOR_GROUP;
    for (size_t i = 0; i < expressions.size(); i++)
        if (expressions[i].parameters != from.expressions[i].parameters) {
            expressions[i].parameters = from.expressions[i].parameters;
            dynamics->setParameters((int) i, expressions[i].parameters);
        }
}

vector<double> ReferenceRunDevice::getReferences() {
    return dynamics->getReferences();
}

void ReferenceRunDevice::setReferences(const vector<double>& references) {
    dynamics->setReferences(references);
}

// ------------------------------------------------------------------------------------------ what happens to the Context

bool ReferenceRunDevice::updateState() {
    return context.updateContextState();
}

RunDevice::Change ReferenceRunDevice::findChange() {
    const bool isOtherBox = !std::equal(boxVectors, boxVectors + 3, data.periodicBoxVectors);
    std::copy(data.periodicBoxVectors, data.periodicBoxVectors + 3, boxVectors);
    if (isOtherBox || dynamics->getPositions().empty())
        return Change::Box;
    // A look at all positions and velocities is spent only where it may find something: where a Force may have changed them, or
    // another integrator (of a CompoundIntegrator) may have taken steps.
    const bool mustCompare = ahead != nullptr || &context.getIntegrator() != &integrator;
    if ((mustCompare || mayForcesChangePositions) && differ(*data.positions, knownPositions()))
        return Change::State;
    if ((mustCompare || mayForcesChangeVelocities) && differ(*data.velocities, knownVelocities()))
        return Change::Velocities;
    return Change::None;
}

unsigned long long ReferenceRunDevice::getFingerprint() {
    Fingerprint fingerprint;
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0) {
            fingerprint.add((*data.positions)[i]);
            fingerprint.add((*data.velocities)[i]);
        }
    for (int i = 0; i < 3; i++)
        fingerprint.add(data.periodicBoxVectors[i]);
    for (const auto& parameter : context.getParameters()) {
        fingerprint.addBytes(parameter.first.c_str(), parameter.first.size() + 1);
        fingerprint.add(parameter.second);
    }
    return fingerprint.get();
}

void ReferenceRunDevice::start() {
    const bool hasBox = hasPeriodicBox(context.getSystem(), data.periodicBoxVectors);
    requireSoundStart(dynamics->getConstraintSystem(),
                      {*data.positions, *data.velocities, isVirtualSite, hasBox ? data.periodicBoxVectors : nullptr});
    const Vectors before = *data.positions;
    try {
        context.computeVirtualSites(); // setPositions() leaves them where the user puts them
        context.calcForcesAndEnergy(false, false, 0); // throws if no positions have been set, and computes nothing
        Vectors positions = *data.positions, forces;
        dynamics->projectPositions(positions);
        const double energy = computeForcesAt(positions, forces);
        dynamics->begin(positions, *data.velocities, forces, energy);
    }
    catch (...) {
        *data.positions = before;
        throw;
    }
    ahead.reset(new Ahead{*data.positions, *data.velocities});
}

void ReferenceRunDevice::changeState() {
    Vectors positions = *data.positions, forces;
    dynamics->projectPositions(positions); // a barostat that moves each particle by itself keeps no constraint
    const double energy = computeForcesAt(positions, forces);
    dynamics->changeState(positions, *data.velocities, forces, energy);
    ahead.reset(new Ahead{*data.positions, *data.velocities});
}

void ReferenceRunDevice::changeVelocities() {
    if (ahead == nullptr && dynamics->changeFrame(*data.velocities))
        return;
    dynamics->changeVelocities(*data.velocities);
    ahead.reset(new Ahead{*data.positions, *data.velocities});
}

void ReferenceRunDevice::writeVelocities() {
    writeMoving(dynamics->getVelocities(), *data.velocities);
    if (ahead != nullptr)
        ahead->velocities = *data.velocities;
}

// The forces at positions that may not be those of the Context, which keeps its own; returns the energy of the monitor's group.
double ReferenceRunDevice::computeForcesAt(const Vectors& positions, Vectors& forces) {
    const bool isElsewhere = differ(*data.positions, positions);
    const Vectors before = isElsewhere ? *data.positions : Vectors();
    auto putBack = [&] {
        if (isElsewhere)
            *data.positions = before;
    };
    double energy;
    try {
        if (isElsewhere) {
            writeMoving(positions, *data.positions);
            context.computeVirtualSites();
        }
        energy = computeForces();
    }
    catch (...) {
        putBack();
        throw;
    }
    forces = *data.forces;
    putBack();
    return energy;
}

double ReferenceRunDevice::computeForces() {
    context.calcForcesAndEnergy(true, false, forceGroups);
    numForceEvaluations++;
    return monitorForceGroup == NO_MONITOR_GROUP ? 0.0
                                                 : context.calcForcesAndEnergy(false, true, 1 << monitorForceGroup);
}

const vector<Vec3>& ReferenceRunDevice::knownPositions() const {
    return ahead != nullptr ? ahead->positions : dynamics->getPositions();
}

const vector<Vec3>& ReferenceRunDevice::knownVelocities() const {
    return ahead != nullptr ? ahead->velocities : dynamics->getVelocities();
}

// Particles of mass zero are not the integrator's to move: they are virtual sites, or fixed.
bool ReferenceRunDevice::differ(const Vectors& a, const Vectors& b) const {
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0 && a[i] != b[i])
            return true;
    return false;
}

void ReferenceRunDevice::writeMoving(const Vectors& from, Vectors& to) const {
    if (!hasMassless) {
        to = from;
        return;
    }
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            to[i] = from[i];
}

// ----------------------------------------------------------------------------------------------------------- the steps

bool ReferenceRunDevice::hasStarted() {
    return dynamics->hasStarted();
}

// One step of the method in the Context, the velocities excepted. Forces see the time of its end.
double ReferenceRunDevice::advance(double maxTime, double direction) {
    const double time = data.time, maxStep = maxTime - time;
    while (true) {
        const double size = dynamics->step(maxStep);
        data.time = size < maxStep ? time + direction * size : maxTime;
        writeMoving(dynamics->getNextPositions(), *data.positions);
        context.computeVirtualSites();
        const double energy = computeForces();
        if (dynamics->finish(*data.forces, energy))
            return size;
    }
}

void ReferenceRunDevice::step(double maxTime) {
    const double time = data.time;
    const auto count = data.stepCount;
    try {
        data.stepCount++;
        lastStep.size = advance(maxTime, 1);
    }
    catch (...) {
        data.time = time;
        data.stepCount = count;
        dynamics->abandonStep();
        putBack();
        throw;
    }
    lastStep.density = dynamics->getDensity();
    writeMoving(dynamics->getVelocities(), *data.velocities);
    ahead.reset();
    beforeDensities.reset();
}

void ReferenceRunDevice::settle() {
}

// The positions of the Context before a step.
void ReferenceRunDevice::putBack() {
    if (ahead != nullptr) {
        *data.positions = ahead->positions;
        return;
    }
    writeMoving(dynamics->getPositions(), *data.positions);
    context.computeVirtualSites();
}

void ReferenceRunDevice::reverse() {
    dynamics->reverse();
    lastStep.density = dynamics->getDensity();
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            (*data.velocities)[i] *= -1;
    if (ahead != nullptr)
        ahead->velocities = *data.velocities;
}

RunDevice::LastStep ReferenceRunDevice::getLastStep() {
    return lastStep;
}

double ReferenceRunDevice::getTime() {
    return data.time;
}

long long ReferenceRunDevice::getStepCount() {
    return data.stepCount;
}

// ---------------------------------------------------------------------------------------------------------- trial runs

void ReferenceRunDevice::beginTrial(double stepSize, bool isBackwards) {
    const double direction = isBackwards ? -1 : 1;
    trial.reset(new Trial{dynamics->keep(), data.time, direction});
    VRattleDynamics::Settings fixed = settings;
    fixed.isFixedStep = true;
    fixed.stepSize = stepSize;
    Vectors velocities = dynamics->getVelocities();
    for (Vec3& v : velocities)
        v *= direction;
    try {
        dynamics->setSettings(fixed);
        dynamics->begin(trial->kept.positions, velocities, trial->kept.forces, trial->kept.groupEnergy);
    }
    catch (...) {
        endTrial();
        throw;
    }
}

void ReferenceRunDevice::takeTrialStep() {
    try {
        advance(std::numeric_limits<double>::infinity(), trial->direction);
    }
    catch (...) {
        endTrial();
        throw;
    }
}

void ReferenceRunDevice::endTrial() {
    if (trial == nullptr)
        return;
    dynamics->putBack(trial->kept);
    data.time = trial->time;
    trial.reset();
    putBack();
}

// ------------------------------------------------------------------------------------------------------------- numbers

vector<double> ReferenceRunDevice::getMonitorValues() {
    if (!settings.isAutomatic)
        return dynamics->getMonitorValues();
    const AutomaticControl::Memory& memory = dynamics->getAutomaticControl().getMemory();
    return {std::begin(memory.values), std::end(memory.values)};
}

vector<double> ReferenceRunDevice::getMultipliers() {
    vector<double> result;
    dynamics->getConstraintSystem().getGivenMultipliers(dynamics->getMultipliers(), result);
    return result;
}

double ReferenceRunDevice::computeKineticEnergy() {
    double sum = 0;
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0) // the velocities of the others have no meaning, and may be no numbers
            sum += masses[i] * (*data.velocities)[i].dot((*data.velocities)[i]);
    return 0.5 * sum;
}

long long ReferenceRunDevice::getNumForceEvaluations() {
    return numForceEvaluations;
}

long long ReferenceRunDevice::getNumSolverIterations() {
    return dynamics->getNumIterations();
}

long long ReferenceRunDevice::getNumRescues() {
    return dynamics->getNumRescues();
}

double ReferenceRunDevice::getNegligibleValue() {
    return dynamics->getAutomaticControl().getNegligibleValue(dynamics->getVelocities());
}

double ReferenceRunDevice::densityOf(const vector<double>& values) {
    return dynamics->getAutomaticControl().densityOf({values[0], values[1]});
}

void ReferenceRunDevice::startDensities(const vector<double>& back, const vector<double>& secondBack) {
    beforeDensities = std::make_unique<VRattleDynamics::Kept>(dynamics->keep());
    dynamics->startAutomatic({back[0], back[1]}, {secondBack[0], secondBack[1]});
}

void ReferenceRunDevice::undoStartDensities() {
    if (beforeDensities != nullptr)
        dynamics->putBack(*beforeDensities);
    beforeDensities.reset();
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void ReferenceRunDevice::save(RunState& run) {
    const VRattleDynamics::Memory memory = dynamics->getMemory();
    run.halfStepVelocities = memory.halfStepVelocities;
    run.methodValues = {{"hasDensity", {(double) memory.hasDensity}},
                        {"density", {memory.density}},
                        {"multiplierOffset", memory.multiplierOffset},
                        {"multipliers", memory.multipliers},
                        {"monitorValues", memory.monitorValues},
                        {"hasHalfStepValue", {(double) memory.hasHalfStepValue}},
                        {"u", {memory.u}},
                        {"halfStepValue", {memory.halfStepValue}},
                        {"rate", {memory.rate}},
                        {"densityOffset", {memory.densityOffset}}};
    if (settings.isAutomatic) {
        const AutomaticControl::Memory& control = memory.automatic;
        run.methodValues["automaticBehind"] = {std::begin(control.behind), std::end(control.behind)};
        run.methodValues["automaticAhead"] = {std::begin(control.ahead), std::end(control.ahead)};
        run.methodValues["automaticValues"] = {std::begin(control.values), std::end(control.values)};
        run.methodValues["automaticForceSquares"] = control.forceSquares;
    }
    run.forces = dynamics->getForces();
    run.groupEnergy = dynamics->getGroupEnergy();
    std::copy(boxVectors, boxVectors + 3, run.boxVectors);
    if (differ(*data.positions, dynamics->getPositions()))
        run.positions = dynamics->getPositions();
    if (differ(*data.velocities, dynamics->getVelocities()))
        run.velocities = dynamics->getVelocities();
    run.isContextAhead = ahead != nullptr;
    if (ahead != nullptr && differ(*data.positions, ahead->positions))
        run.contextPositions = ahead->positions;
    if (ahead != nullptr && differ(*data.velocities, ahead->velocities))
        run.contextVelocities = ahead->velocities;
}

VRattleDynamics::Memory ReferenceRunDevice::memoryOf(const RunState& run, const IntegratorSettings& saved) const {
    const size_t numConstraints = dynamics->getConstraintSystem().getNumConstraints();
    VRattleDynamics::Memory memory = {};
    memory.hasDensity = run.getMethodValue("hasDensity") != 0;
    memory.density = run.getMethodValue("density");
    memory.halfStepVelocities = run.halfStepVelocities;
    memory.multiplierOffset = run.getMethodValues("multiplierOffset", numConstraints);
    memory.references = run.references;
    memory.multipliers = run.getMethodValues("multipliers", numConstraints);
    memory.monitorValues = run.getMethodValues("monitorValues", saved.monitors.size());
    memory.hasHalfStepValue = run.getMethodValue("hasHalfStepValue") != 0;
    memory.u = run.getMethodValue("u");
    memory.halfStepValue = run.getMethodValue("halfStepValue");
    memory.rate = run.getMethodValue("rate");
    memory.densityOffset = run.getMethodValue("densityOffset");
    if (saved.isAutomatic) {
        const size_t numMonitors = AutomaticControl::NUM_MONITORS;
        AutomaticControl::Memory& control = memory.automatic;
        std::copy_n(run.getMethodValues("automaticBehind", numMonitors).begin(), numMonitors, control.behind);
        std::copy_n(run.getMethodValues("automaticAhead", numMonitors).begin(), numMonitors, control.ahead);
        std::copy_n(run.getMethodValues("automaticValues", numMonitors).begin(), numMonitors, control.values);
        control.forceSquares = run.getMethodValues("automaticForceSquares",
                                                   dynamics->getAutomaticControl().getMemory().forceSquares.size());
    }
    return memory;
}

bool ReferenceRunDevice::canResume(const RunState& run, const IntegratorSettings& saved) {
    memoryOf(run, saved);
    return true;
}

bool ReferenceRunDevice::resume(const RunState& run, const IntegratorSettings& saved) {
    const Vectors& positions = run.positions.empty() ? *data.positions : run.positions;
    const Vectors& velocities = run.velocities.empty() ? *data.velocities : run.velocities;
    Vectors forces;
    const double energy = computeForcesAt(positions, forces);
    const double larger = std::max(std::fabs(energy), std::fabs(run.groupEnergy));
    if (!agree(forces, run.forces) || !(std::fabs(energy - run.groupEnergy) <= FORCE_ROUNDING * larger))
        return false;
    dynamics->resume(positions, velocities, forces, energy, memoryOf(run, saved));
    ahead.reset();
    if (run.isContextAhead)
        ahead.reset(new Ahead{run.contextPositions.empty() ? *data.positions : run.contextPositions,
                              run.contextVelocities.empty() ? *data.velocities : run.contextVelocities});
    std::copy(run.boxVectors, run.boxVectors + 3, boxVectors);
    return true;
}
