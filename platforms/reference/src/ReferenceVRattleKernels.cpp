// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ReferenceVRattleKernels.h"
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
#include "openmm/internal/ContextImpl.h"
#include "openmmvrattle/Fingerprint.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <sstream>
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
// Trial steps of automatic step control: how often they are made shorter, and the ratio of densities from which on they are.
const int MAX_HALVINGS = 8;
const double START_ACCURACY = 1.1;

[[noreturn]] void throwFailure(const std::string& what, double time, const std::string& reason,
                               const std::string& wayOut) {
    std::stringstream message;
    message.precision(10);
    message << "VariableStepRattleIntegrator: " << what << " at t = " << time << " ps failed because " << reason
            << wayOut;
    throw OpenMMException(message.str());
}

void requireFinite(const vector<Vec3>& vectors, const vector<double>& masses, const std::string& name) {
    for (size_t i = 0; i < vectors.size(); i++)
        for (int j = 0; j < 3; j++)
            if (!std::isfinite(vectors[i][j]) && masses[i] > 0)
                throw OpenMMException("VariableStepRattleIntegrator: the " + name + " of particle " +
                                      std::to_string(i) + " is not a finite number; set it before stepping");
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

vector<ExpressionConstraint> readExpressions(const VariableStepRattleIntegrator& integrator) {
    vector<ExpressionConstraint> result(integrator.getNumExpressionConstraints());
    for (size_t i = 0; i < result.size(); i++)
        integrator.getExpressionConstraintParameters((int) i, result[i].expression, result[i].particles,
                                                     result[i].parameters);
    return result;
}

// Whether two constraints are the same but for the values of their parameters.
bool areAlike(const ExpressionConstraint& a, const ExpressionConstraint& b) {
    return a.expression == b.expression && a.particles == b.particles && a.parameters.size() == b.parameters.size() &&
           std::equal(a.parameters.begin(), a.parameters.end(), b.parameters.begin(),
                      [](const auto& x, const auto& y) { return x.first == y.first; });
}

} // namespace

void ReferenceIntegrateVRattleStepKernel::initialize(const System& system,
                                                     const VariableStepRattleIntegrator& integrator) {
    masses.resize(system.getNumParticles());
    for (int i = 0; i < system.getNumParticles(); i++)
        masses[i] = system.getParticleMass(i);
    constraints.resize(system.getNumConstraints());
    for (int i = 0; i < system.getNumConstraints(); i++) {
        DistanceConstraint& c = constraints[i];
        system.getConstraintParameters(i, c.particle1, c.particle2, c.length);
        if (!(c.length > 0) || !std::isfinite(c.length))
            throw OpenMMException("VariableStepRattleIntegrator: constraint " + std::to_string(i) +
                                  " of the System has a length that is not a positive finite number");
    }
    expressions = readExpressions(integrator);
    hasMassless = std::any_of(masses.begin(), masses.end(), [](double mass) { return mass == 0; });
    mayForcesChangePositions = mayForcesChangeVelocities = false;
    for (int i = 0; i < system.getNumForces(); i++) {
        const Reach reach = reachOf(system.getForce(i));
        mayForcesChangePositions = mayForcesChangePositions || reach == FullReach;
        mayForcesChangeVelocities = mayForcesChangeVelocities || reach != NoReach;
    }
    systemFingerprint = VRattleRunState::fingerprintOf(system, integrator);
    dynamics.reset(new VRattleDynamics(masses, constraints, expressions));
    trial.reset();
    if (getPlatform().getName() != "Reference") { // which does everything on one thread
        // This thread is awake and takes the share of the pool's first.
        auto runOnThreads = [this](const std::function<void(int)>& task) {
            data.threads.execute([&task](OpenMM::ThreadPool&, int thread) {
                if (thread > 0)
                    task(thread);
            });
            task(0);
            data.threads.waitForThreads();
        };
        dynamics->setParallel(runOnThreads, data.threads.getNumThreads());
    }
    isContextAhead = false;
    forceGroups = 0;
    monitorForceGroup = NO_MONITOR_GROUP;
    areSettingsChanged = isStateChanged = true;
    restored.reset();
    lastDensity = 1;
    numForceEvaluations = 0;
    readSettings(integrator);
}

void ReferenceIntegrateVRattleStepKernel::settingsChanged() {
    areSettingsChanged = true;
}

void ReferenceIntegrateVRattleStepKernel::stateChanged() {
    isStateChanged = true;
}

void ReferenceIntegrateVRattleStepKernel::readSettings(const VariableStepRattleIntegrator& integrator) {
    settings.stepSize = integrator.getNominalStepSize();
    settings.minimumStep = integrator.getMinimumStepSize();
    settings.maximumStep = integrator.getMaximumStepSize();
    settings.tolerance = integrator.getConstraintTolerance();
    settings.update = (StepDensity::Update) integrator.getUpdateMethod();
    settings.normOrder = integrator.getNormOrder();
    settings.isFixedStep = false;
    settings.isAutomatic = integrator.isAutomatic();
    calibrationSteps = integrator.getCalibrationSteps();
    settings.automaticRequest = integrator.getNumAutomaticRequests();
    for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
        settings.automaticReferences[k] = settings.isAutomatic ? integrator.getSetReferenceMonitorValue(k) : 0.0;
    settings.terms.clear();
    int group = NO_MONITOR_GROUP;
    for (int i = 0; i < integrator.getNumMonitors(); i++) {
        VariableStepRattleIntegrator::MonitorKind kind;
        StepMonitor::Term term;
        integrator.getMonitor(i, kind, term.weight, term.power);
        term.kind = (StepMonitor::Kind) kind;
        term.reference = integrator.getSetReferenceMonitorValue(i);
        settings.terms.push_back(term);
        if (kind == VariableStepRattleIntegrator::ForceGroupEnergy)
            group = integrator.getMonitorForceGroup();
    }
    if (group != monitorForceGroup) {
        monitorForceGroup = group;
        isStateChanged = true;
    }
    try {
        dynamics->setSettings(settings);
    }
    catch (const StepFailure& failure) {
        throw OpenMMException(std::string("VariableStepRattleIntegrator: ") + failure.what());
    }
    readParametersOfExpressions(integrator);
    areSettingsChanged = false;
}

// New values take effect at once, other constraints with Context::reinitialize().
void ReferenceIntegrateVRattleStepKernel::readParametersOfExpressions(const VariableStepRattleIntegrator& integrator) {
    const vector<ExpressionConstraint> current = readExpressions(integrator);
    areExpressionsOutdated =
        !std::equal(current.begin(), current.end(), expressions.begin(), expressions.end(), areAlike);
    if (areExpressionsOutdated)
        return;
    for (size_t i = 0; i < current.size(); i++)
        if (current[i].parameters != expressions[i].parameters) {
            expressions[i].parameters = current[i].parameters;
            dynamics->setParameters((int) i, current[i].parameters);
            if (trial != nullptr)
                trial->setParameters((int) i, current[i].parameters);
            isStateChanged = true;
        }
}

// Bring the method's state in line with the Context, which may have been changed in between.
void ReferenceIntegrateVRattleStepKernel::prepare(ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                                                  bool forcesInvalid) {
    takeRestored(context);
    if (areSettingsChanged)
        readSettings(integrator);
    if (areExpressionsOutdated)
        throw OpenMMException("VariableStepRattleIntegrator: constraints have been added or replaced since the Context "
                              "was created; call reinitialize(preserveState=True) of the Context to use them");
    int groups = integrator.getIntegrationForceGroups();
    if (monitorForceGroup != NO_MONITOR_GROUP)
        groups &= ~(1 << monitorForceGroup);
    if (groups != forceGroups) {
        forceGroups = groups;
        isStateChanged = true;
    }
    // A barostat says that the forces are invalid; a new box without a word of that is the user's.
    if (haveBoxVectorsChanged() && !forcesInvalid)
        isStateChanged = true;
    // What the user changes we are told; a look at all positions and velocities is spent only where it may find something: where a
    // Force may have changed them, or another integrator (of a CompoundIntegrator) may have taken steps.
    const bool mustCompare = isContextAhead || &context.getIntegrator() != &integrator;
    const bool mustComparePositions = mustCompare || mayForcesChangePositions;
    const bool mustCompareVelocities = mustCompare || mayForcesChangeVelocities;
    try {
        if (isStateChanged)
            startAfresh(context);
        else if (forcesInvalid || (mustComparePositions && differ(*data.positions, knownPositions()))) {
            // A Force has changed the state (a barostat, say).
            isStateChanged = true;
            noteContext();
            if (expressions.empty()) { // all others keep the System's constraints
                const double energy = computeForces(context);
                dynamics->changeState(*data.positions, *data.velocities, *data.forces, energy);
            }
            else {
                vector<Vec3> positions, forces;
                const double energy = computeForcesOnConstraints(context, positions, forces);
                dynamics->changeState(positions, *data.velocities, forces, energy);
            }
        }
        else if (mustCompareVelocities && differ(*data.velocities, knownVelocities())) {
            if (isContextAhead || !dynamics->changeFrame(*data.velocities)) {
                noteContext();
                dynamics->changeVelocities(*data.velocities);
            }
        }
        isStateChanged = false;
    }
    catch (const StepFailure& failure) {
        throwFailure("the start", data.time, failure.what(), "");
    }
}

void ReferenceIntegrateVRattleStepKernel::startAfresh(ContextImpl& context) {
    requireFinite(*data.positions, masses, "position");
    requireFinite(*data.velocities, masses, "velocity");
    context.calcForcesAndEnergy(false, false, 0); // throws if no positions have been set, and computes nothing
    noteContext();
    vector<Vec3> positions, forces;
    const double energy = computeForcesOnConstraints(context, positions, forces);
    dynamics->begin(positions, *data.velocities, forces, energy);
}

// The Context's positions moved onto the constraints, and the forces there; the Context keeps its positions.
double ReferenceIntegrateVRattleStepKernel::computeForcesOnConstraints(ContextImpl& context, vector<Vec3>& positions,
                                                                       vector<Vec3>& forces) {
    positions = *data.positions;
    const bool isProjected = dynamics->projectPositions(positions);
    if (isProjected) {
        writeMoving(positions, *data.positions);
        context.computeVirtualSites();
    }
    double energy;
    try {
        energy = computeForces(context);
    }
    catch (...) {
        putBack(context);
        throw;
    }
    forces = *data.forces;
    if (isProjected)
        putBack(context);
    return energy;
}

void ReferenceIntegrateVRattleStepKernel::noteContext() {
    isContextAhead = true;
    contextPositions = *data.positions;
    contextVelocities = *data.velocities;
}

const vector<Vec3>& ReferenceIntegrateVRattleStepKernel::knownPositions() const {
    return isContextAhead ? contextPositions : dynamics->getPositions();
}

const vector<Vec3>& ReferenceIntegrateVRattleStepKernel::knownVelocities() const {
    return isContextAhead ? contextVelocities : dynamics->getVelocities();
}

double ReferenceIntegrateVRattleStepKernel::computeForces(ContextImpl& context) {
    context.calcForcesAndEnergy(true, false, forceGroups);
    numForceEvaluations++;
    return monitorForceGroup == NO_MONITOR_GROUP ? 0.0
                                                 : context.calcForcesAndEnergy(false, true, 1 << monitorForceGroup);
}

bool ReferenceIntegrateVRattleStepKernel::haveBoxVectorsChanged() {
    bool changed = false;
    for (int i = 0; i < 3; i++) {
        changed |= boxVectors[i] != data.periodicBoxVectors[i];
        boxVectors[i] = data.periodicBoxVectors[i];
    }
    return changed;
}

// Particles of mass zero are not the integrator's to move: they are virtual sites, or fixed.
bool ReferenceIntegrateVRattleStepKernel::differ(const vector<Vec3>& a, const vector<Vec3>& b) const {
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0 && a[i] != b[i])
            return true;
    return false;
}

void ReferenceIntegrateVRattleStepKernel::writeMoving(const vector<Vec3>& from, vector<Vec3>& to) const {
    if (!hasMassless) {
        to = from;
        return;
    }
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            to[i] = from[i];
}

// One step of the method in the Context, the velocities and the time excepted.
double ReferenceIntegrateVRattleStepKernel::advance(ContextImpl& context, VRattleDynamics& method, double maxStep) {
    while (true) {
        double size = method.step(maxStep);
        writeMoving(method.getNextPositions(), *data.positions);
        context.computeVirtualSites();
        double energy = computeForces(context);
        if (method.finish(*data.forces, energy))
            return size;
    }
}

void ReferenceIntegrateVRattleStepKernel::putBack(ContextImpl& context) {
    writeMoving(knownPositions(), *data.positions);
    context.computeVirtualSites();
}

double ReferenceIntegrateVRattleStepKernel::execute(ContextImpl& context,
                                                    const VariableStepRattleIntegrator& integrator, bool forcesInvalid,
                                                    double maxTime) {
    prepare(context, integrator, forcesInvalid);
    startAutomatic(context);
    const double maxStep = maxTime - data.time;
    double size;
    try {
        size = advance(context, *dynamics, maxStep);
    }
    catch (const StepFailure& failure) {
        putBack(context);
        throwFailure("the step", data.time, failure.what(),
                     "; the Context is in the state before this step: use a smaller step size, or another monitor");
    }
    catch (...) {
        putBack(context);
        throw;
    }
    writeMoving(dynamics->getVelocities(), *data.velocities);
    isContextAhead = false;
    lastDensity = dynamics->getDensity();
    data.time = size < maxStep ? data.time + size : maxTime;
    data.stepCount++;
    return size;
}

void ReferenceIntegrateVRattleStepKernel::reverse(ContextImpl& context,
                                                  const VariableStepRattleIntegrator& integrator) {
    prepare(context, integrator, false);
    startAutomatic(context);
    try {
        dynamics->reverse();
    }
    catch (const StepFailure& failure) {
        throwFailure("reverse()", data.time, failure.what(), "; the Context is unchanged");
    }
    lastDensity = dynamics->getDensity();
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            (*data.velocities)[i] *= -1;
    contextVelocities = *data.velocities;
}

vector<double> ReferenceIntegrateVRattleStepKernel::calibrate(ContextImpl& context,
                                                              const VariableStepRattleIntegrator& integrator,
                                                              int steps) {
    prepare(context, integrator, false);
    if (settings.isAutomatic)
        return findAutomaticReferences(context, steps);
    VRattleDynamics::Settings fixed = settings;
    fixed.isFixedStep = true;
    vector<double> means(settings.terms.size(), 0.0);
    try {
        VRattleDynamics& method = beginTrial(fixed, 1);
        for (int i = 0; i < steps; i++) {
            takeTrialStep(context, method);
            for (size_t k = 0; k < means.size(); k++)
                means[k] += method.getMonitorValues()[k] / steps;
        }
    }
    catch (const StepFailure& failure) {
        putBack(context);
        throwFailure("calibrate()", data.time, failure.what(), "; the Context is unchanged: use a smaller step size");
    }
    putBack(context);
    for (size_t k = 0; k < means.size(); k++)
        if (!(means[k] > 0))
            throw OpenMMException("VariableStepRattleIntegrator: monitor " + std::to_string(k) +
                                  " is zero all along the trial run of calibrate(); choose another monitor");
    return means;
}

// A copy of the method that takes steps of its own from the current state, forward or backward in time.
VRattleDynamics& ReferenceIntegrateVRattleStepKernel::beginTrial(const VRattleDynamics::Settings& trialSettings,
                                                                 double direction) {
    if (trial == nullptr)
        trial.reset(new VRattleDynamics(masses, constraints, expressions));
    trial->setSettings(trialSettings);
    vector<Vec3> velocities = dynamics->getVelocities();
    for (Vec3& v : velocities)
        v *= direction;
    trial->begin(dynamics->getPositions(), velocities, dynamics->getForces(), dynamics->getGroupEnergy());
    return *trial;
}

// Puts the Context back if the forces cannot be computed; a StepFailure is left to the caller.
void ReferenceIntegrateVRattleStepKernel::takeTrialStep(ContextImpl& context, VRattleDynamics& method) {
    try {
        advance(context, method, std::numeric_limits<double>::infinity());
    }
    catch (const StepFailure&) {
        throw;
    }
    catch (...) {
        putBack(context);
        throw;
    }
}

// Start automatic step control, if the run is not in the middle of a sequence of its steps.
void ReferenceIntegrateVRattleStepKernel::startAutomatic(ContextImpl& context) {
    if (!settings.isAutomatic || dynamics->hasStarted())
        return;
    if (!dynamics->getAutomaticControl().hasReferences()) {
        vector<double> references = findAutomaticReferences(context, calibrationSteps);
        for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
            if (dynamics->getReference(k) > 0) // set by the user
                references[k] = dynamics->getReference(k);
        dynamics->setReferences(references);
    }
    startFromTrialSteps(context);
}

// The geometric means of the two monitors over a trial run of fixed steps. Where steps of the nominal size fail, shorter ones
// must do.
vector<double> ReferenceIntegrateVRattleStepKernel::findAutomaticReferences(ContextImpl& context, int steps) {
    const int numMonitors = AutomaticControl::NUM_MONITORS;
    VRattleDynamics::Settings fixed = settings;
    fixed.isFixedStep = true;
    for (int halvings = 0;; halvings++) {
        vector<double> logarithms(numMonitors, 0.0);
        double floor = 0; // the logarithm of what is zero but for rounding
        try {
            VRattleDynamics& method = beginTrial(fixed, 1);
            const AutomaticControl& control = method.getAutomaticControl();
            for (int i = 0; i < steps; i++) {
                takeTrialStep(context, method);
                const double negligible = control.getNegligibleValue(method.getVelocities());
                floor += std::log(negligible) / steps;
                for (int k = 0; k < numMonitors; k++)
                    logarithms[k] += std::log(std::max(control.getMemory().values[k], negligible)) / steps;
            }
        }
        catch (const StepFailure& failure) {
            putBack(context);
            if (halvings == MAX_HALVINGS)
                throwFailure("the trial run of automatic step control", data.time, failure.what(),
                             "; the Context is unchanged: use a smaller step size");
            fixed.stepSize *= 0.5;
            continue;
        }
        putBack(context);
        vector<double> references;
        for (double logarithm : logarithms) {
            references.push_back(std::exp(logarithm));
            if (!(references.back() > 0) || !(logarithm > floor + std::log(10)))
                throw OpenMMException("VariableStepRattleIntegrator: in the trial run of the automatic step control "
                                      "there is no force and nothing turns, so there is nothing to measure steps by; "
                                      "take more trial steps with useAutomaticStepControl(), until something happens, "
                                      "or call clearMonitors() for fixed steps");
        }
        return references;
    }
}

// Two trial steps backwards start the sequences of densities. Their size is that of the first step, which only they tell.
void ReferenceIntegrateVRattleStepKernel::startFromTrialSteps(ContextImpl& context) {
    const int numMonitors = AutomaticControl::NUM_MONITORS;
    const AutomaticControl& control = dynamics->getAutomaticControl();
    VRattleDynamics::Settings fixed = settings;
    fixed.isFixedStep = true;
    double values[2][numMonitors];
    double density = control.densityOf({control.getMemory().values[0], 0.0});
    for (int tries = 0;; tries++) {
        fixed.stepSize = settings.stepSize / density;
        try {
            VRattleDynamics& method = beginTrial(fixed, -1);
            takeTrialStep(context, method);
            std::copy_n(method.getAutomaticControl().getMemory().values, numMonitors, values[0]);
            const double found = control.densityOf({control.getMemory().values[0], values[0][1]});
            if (found > START_ACCURACY * density && tries < MAX_HALVINGS) {
                density = found;
                continue;
            }
            takeTrialStep(context, method);
            std::copy_n(method.getAutomaticControl().getMemory().values, numMonitors, values[1]);
            break;
        }
        catch (const StepFailure& failure) {
            if (tries >= MAX_HALVINGS) {
                putBack(context);
                throwFailure("the start of automatic step control", data.time, failure.what(),
                             "; the Context is unchanged: use a smaller step size");
            }
            density *= 2;
        }
    }
    putBack(context);
    dynamics->startAutomatic(values[0], values[1]);
}

unsigned long long ReferenceIntegrateVRattleStepKernel::getSystemFingerprint() const {
    return systemFingerprint;
}

VRattleRunState ReferenceIntegrateVRattleStepKernel::saveRun(ContextImpl& context,
                                                             const VariableStepRattleIntegrator& integrator) {
    takeRestored(context);
    if (areSettingsChanged)
        readSettings(integrator);
    const VRattleDynamics::Memory memory = dynamics->getMemory();
    VRattleRunState run;
    run.system = systemFingerprint;
    run.context = fingerprintOfContext();
    run.lastDensity = lastDensity;
    run.references = memory.references;
    run.startsAfresh = isStateChanged;
    if (run.startsAfresh)
        return run;
    run.forceGroups = forceGroups;
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
    run.isContextAhead = isContextAhead;
    if (isContextAhead && differ(*data.positions, contextPositions))
        run.contextPositions = contextPositions;
    if (isContextAhead && differ(*data.velocities, contextVelocities))
        run.contextVelocities = contextVelocities;
    return run;
}

VRattleDynamics::Memory ReferenceIntegrateVRattleStepKernel::memoryOf(const VRattleRunState& run,
                                                                      bool isAutomatic) const {
    const size_t numConstraints = dynamics->getConstraintSystem().getNumConstraints();
    VRattleDynamics::Memory memory = {};
    memory.hasDensity = run.getMethodValue("hasDensity") != 0;
    memory.density = run.getMethodValue("density");
    memory.halfStepVelocities = run.halfStepVelocities;
    memory.multiplierOffset = run.getMethodValues("multiplierOffset", numConstraints);
    memory.references = run.references;
    memory.multipliers = run.getMethodValues("multipliers", numConstraints);
    memory.monitorValues = run.getMethodValues("monitorValues", isAutomatic ? 0 : run.references.size());
    memory.hasHalfStepValue = run.getMethodValue("hasHalfStepValue") != 0;
    memory.u = run.getMethodValue("u");
    memory.halfStepValue = run.getMethodValue("halfStepValue");
    memory.rate = run.getMethodValue("rate");
    memory.densityOffset = run.getMethodValue("densityOffset");
    if (isAutomatic) {
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

void ReferenceIntegrateVRattleStepKernel::resumeRun(ContextImpl&, const VariableStepRattleIntegrator& integrator,
                                                    const VRattleRunState& run) {
    const bool isSameSystem = run.system == systemFingerprint;
    const int numReferences = integrator.isAutomatic() ? AutomaticControl::NUM_MONITORS : integrator.getNumMonitors();
    if (isSameSystem)
        run.requireSizes((int) masses.size(), numReferences);
    VRattleDynamics::Memory memory = {};
    if (isSameSystem && !run.startsAfresh)
        memory = memoryOf(run, integrator.isAutomatic());
    restored.reset();
    readSettings(integrator);
    if ((int) run.references.size() == numReferences)
        dynamics->setReferences(run.references);
    lastDensity = run.lastDensity;
    isContextAhead = false;
    isStateChanged = run.startsAfresh || !isSameSystem || run.context != fingerprintOfContext();
    if (isStateChanged)
        return;
    restoredMemory = memory;
    restored.reset(new VRattleRunState(run));
    if (run.positions.empty())
        restored->positions = *data.positions;
    if (run.velocities.empty())
        restored->velocities = *data.velocities;
    if (run.contextPositions.empty())
        restored->contextPositions = *data.positions;
    if (run.contextVelocities.empty())
        restored->contextVelocities = *data.velocities;
}

// Go on from a restored run, unless the user has changed the state since, or the forces turn out to be others.
void ReferenceIntegrateVRattleStepKernel::takeRestored(ContextImpl& context) {
    if (restored != nullptr && !isStateChanged) {
        try {
            dynamics->resume(restored->positions, restored->velocities, restored->forces, restored->groupEnergy,
                             restoredMemory);
        }
        catch (const StepFailure& failure) {
            throwFailure("going on from a saved run", data.time, failure.what(), "");
        }
        isContextAhead = restored->isContextAhead;
        contextPositions = restored->contextPositions;
        contextVelocities = restored->contextVelocities;
        forceGroups = restored->forceGroups;
        std::copy(restored->boxVectors, restored->boxVectors + 3, boxVectors);
        isStateChanged = !areForcesAsRestored(context);
    }
    restored.reset();
}

// Computes the forces where the restored ones belong to, and takes them over if these are the same but for rounding.
bool ReferenceIntegrateVRattleStepKernel::areForcesAsRestored(ContextImpl& context) {
    if (differ(*data.positions, knownPositions()) || !std::equal(boxVectors, boxVectors + 3, data.periodicBoxVectors))
        return true; // they will be computed for other reasons
    const bool isElsewhere = isContextAhead && differ(*data.positions, dynamics->getPositions());
    if (isElsewhere) {
        writeMoving(dynamics->getPositions(), *data.positions);
        context.computeVirtualSites();
    }
    double energy;
    try {
        energy = computeForces(context);
    }
    catch (...) {
        putBack(context);
        throw;
    }
    const vector<Vec3> forces = *data.forces;
    if (isElsewhere)
        putBack(context);
    const double larger = std::max(std::fabs(energy), std::fabs(restored->groupEnergy));
    if (!agree(forces, restored->forces) || !(std::fabs(energy - restored->groupEnergy) <= FORCE_ROUNDING * larger))
        return false;
    dynamics->resume(restored->positions, restored->velocities, forces, energy, restoredMemory);
    return true;
}

unsigned long long ReferenceIntegrateVRattleStepKernel::fingerprintOfContext() const {
    Fingerprint fingerprint;
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0) {
            fingerprint.add((*data.positions)[i]);
            fingerprint.add((*data.velocities)[i]);
        }
    return fingerprint.get();
}

double ReferenceIntegrateVRattleStepKernel::computeKineticEnergy(ContextImpl&) {
    double sum = 0;
    for (size_t i = 0; i < masses.size(); i++)
        sum += masses[i] * (*data.velocities)[i].dot((*data.velocities)[i]);
    return 0.5 * sum;
}

double ReferenceIntegrateVRattleStepKernel::getStepDensity() const {
    return lastDensity;
}

double ReferenceIntegrateVRattleStepKernel::getReferenceMonitorValue(ContextImpl& context,
                                                                     const VariableStepRattleIntegrator& integrator,
                                                                     int index) {
    if (areSettingsChanged) {
        takeRestored(context);
        readSettings(integrator);
    }
    return dynamics->getReference(index);
}

double ReferenceIntegrateVRattleStepKernel::getMonitorValue(ContextImpl& context,
                                                            const VariableStepRattleIntegrator& integrator, int index) {
    prepare(context, integrator, false);
    return settings.isAutomatic ? dynamics->getAutomaticControl().getMemory().values[index]
                                : dynamics->getMonitorValues()[index];
}

vector<double> ReferenceIntegrateVRattleStepKernel::getMultipliers(ContextImpl& context,
                                                                   const VariableStepRattleIntegrator& integrator) {
    prepare(context, integrator, false);
    vector<double> result;
    dynamics->getConstraintSystem().getGivenMultipliers(dynamics->getMultipliers(), result);
    return result;
}

long long ReferenceIntegrateVRattleStepKernel::getNumForceEvaluations() const {
    return numForceEvaluations;
}

long long ReferenceIntegrateVRattleStepKernel::getNumSolverIterations() const {
    return dynamics->getNumIterations();
}

long long ReferenceIntegrateVRattleStepKernel::getNumRescues() const {
    return dynamics->getNumRescues();
}
