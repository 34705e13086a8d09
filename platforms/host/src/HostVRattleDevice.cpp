// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "HostVRattleDevice.h"
#include "run/IntegratorSettings.h"
#include "run/RunState.h"
#include <algorithm>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::ContextImpl;
using OpenMM::Vec3;
using std::vector;

HostVRattleDevice::HostVRattleDevice(ContextImpl& context, std::unique_ptr<ContextVectors> vectors,
                                     const OpenMM::Integrator& integrator, const IntegratorSettings& settings) :
        HostRunDevice(context, std::move(vectors), integrator, settings),
        vrattle(*new VRattleDynamics(masses, getConstraints(), expressions)), settings() {
    dynamics.reset(&vrattle);
}

void HostVRattleDevice::setDynamics(const IntegratorSettings& from) {
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
    to.calibrationSteps = from.calibrationSteps;
    if (from.isAutomatic)
        std::copy(std::begin(from.automaticReferences), std::end(from.automaticReferences), to.automaticReferences);
    vrattle.setSettings(to);
    settings = to;
}

// ---------------------------------------------------------------------------------------------------------- trial runs

void HostVRattleDevice::beginTrial(double stepSize, bool isBackwards) {
    const double direction = isBackwards ? -1 : 1;
    trial.reset(new Trial{vrattle.keep(), vectors->getTime(), direction});
    VRattleDynamics::Settings fixed = settings;
    fixed.isFixedStep = true;
    fixed.stepSize = stepSize;
    Vectors velocities = vrattle.getVelocities();
    for (Vec3& v : velocities)
        v *= direction;
    try {
        vrattle.setSettings(fixed);
        vrattle.begin(trial->kept.positions, velocities, trial->kept.forces, trial->kept.groupEnergy);
    }
    catch (...) {
        endTrial();
        throw;
    }
}

void HostVRattleDevice::takeTrialStep() {
    try {
        advance(std::numeric_limits<double>::infinity(), trial->direction);
    }
    catch (...) {
        endTrial();
        throw;
    }
}

void HostVRattleDevice::endTrial() {
    if (trial == nullptr)
        return;
    vrattle.putBack(trial->kept);
    vectors->setTime(trial->time);
    trial.reset();
    putBack();
}

// ------------------------------------------------------------------------------------------------------------- numbers

vector<double> HostVRattleDevice::getMonitorValues() {
    return vrattle.getMonitorValues();
}

long long HostVRattleDevice::getNumRescues() {
    return vrattle.getNumRescues();
}

double HostVRattleDevice::getNegligibleValue() {
    return vrattle.getAutomaticControl().getNegligibleValue();
}

long long HostVRattleDevice::getNumShortSteps() {
    return (long long) vrattle.getAutomaticControl().getMemory().mostShortSteps;
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void HostVRattleDevice::saveDynamics(RunState& run) {
    const VRattleDynamics::Memory memory = vrattle.getMemory();
    run.halfStepVelocities = memory.halfStepVelocities;
    run.methodValues = {{"hasDensity", {(double) memory.hasDensity}},
                        {"density", {memory.density}},
                        {"parameters", memory.parameters},
                        {"parameterRates", memory.parameterRates},
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
        run.methodValues["automaticLearning"] = {control.stepsSinceStart, control.numLearnt,   control.logarithms[0],
                                                 control.logarithms[1],   control.temperature, control.following};
        run.methodValues["automaticShortSteps"] = {control.shortSteps, control.mostShortSteps};
    }
}

VRattleDynamics::Memory HostVRattleDevice::memoryOf(const RunState& run, const IntegratorSettings& saved) const {
    const ConstraintSystem& system = vrattle.getConstraintSystem();
    const size_t numConstraints = system.getNumConstraints(), numParameters = system.getNumParameters();
    VRattleDynamics::Memory memory = {};
    memory.hasDensity = run.getMethodValue("hasDensity") != 0;
    memory.density = run.getMethodValue("density");
    memory.halfStepVelocities = run.halfStepVelocities;
    memory.parameters = run.getMethodValues("parameters", numParameters);
    memory.parameterRates = run.getMethodValues("parameterRates", numParameters);
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
        control.forceSquares =
            run.getMethodValues("automaticForceSquares", vrattle.getAutomaticControl().getMemory().forceSquares.size());
        const vector<double>& learning = run.getMethodValues("automaticLearning", 6);
        control.stepsSinceStart = learning[0];
        control.numLearnt = learning[1];
        std::copy_n(&learning[2], numMonitors, control.logarithms);
        control.temperature = learning[4];
        control.following = learning[5];
        control.shortSteps = run.getMethodValues("automaticShortSteps", 2)[0];
        control.mostShortSteps = run.getMethodValues("automaticShortSteps", 2)[1];
    }
    return memory;
}

bool HostVRattleDevice::canResume(const RunState& run, const IntegratorSettings& saved) {
    memoryOf(run, saved);
    return run.halfStepVelocities.size() == masses.size();
}

void HostVRattleDevice::resumeDynamics(const State& state, const RunState& run, const IntegratorSettings& saved) {
    vrattle.resume(state.positions, state.velocities, state.forces, state.groupEnergy, memoryOf(run, saved));
}
