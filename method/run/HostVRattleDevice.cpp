// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/HostVRattleDevice.h"
#include "run/IntegratorSettings.h"
#include "run/RunState.h"
#include <algorithm>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

HostVRattleDevice::HostVRattleDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                                     const IntegratorSettings& integratorSettings) :
        HostRunDevice(std::move(vectors), system, integratorSettings), settings() {
}

void HostVRattleDevice::setMethod(const IntegratorSettings& from) {
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
    if (vrattle.getConstraintSystem().getNumConstraints() == 0 && StepMonitor::needConstraints(to.terms))
        throw StepFailure("a monitor of the constraint forces is set (ConstraintMultipliers is the default) and the "
                          "System has no constraints; choose a monitor of the applied forces, such as AppliedForce or "
                          "ForcePNorm, with clearMonitors() and addMonitor(), or call clearMonitors() for fixed steps");
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
        vrattle.begin(trial->kept.state.q, velocities, trial->kept.state.force, trial->kept.state.groupEnergy);
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

double HostVRattleDevice::getReferenceTemperature() {
    return vrattle.getAutomaticControl().getMemory().temperature;
}

void HostVRattleDevice::setReferenceTemperature(double temperature) {
    vrattle.setReferenceTemperature(temperature);
}

long long HostVRattleDevice::getNumShortSteps() {
    return (long long) vrattle.getAutomaticControl().getMemory().mostShortSteps;
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void HostVRattleDevice::exchange(VRattleDynamics::Memory& memory, RunState::Archive archive, size_t numMonitors,
                                 bool isAutomatic) const {
    const ConstraintSystem& constraints = vrattle.getConstraintSystem();
    archive.add("hasDensity", memory.hasDensity);
    archive.add("density", memory.density);
    archive.add("parameters", memory.parameters, constraints.getNumParameters());
    archive.add("parameterRates", memory.parameterRates, constraints.getNumParameters());
    archive.add("multiplierOffset", memory.multiplierOffset, constraints.getNumConstraints());
    archive.add("multipliers", memory.multipliers, constraints.getNumConstraints());
    archive.add("monitorValues", memory.monitorValues, numMonitors);
    archive.add("hasHalfStepValue", memory.hasHalfStepValue);
    archive.add("u", memory.u);
    archive.add("halfStepValue", memory.halfStepValue);
    archive.add("rate", memory.rate);
    archive.add("densityOffset", memory.densityOffset);
    if (!isAutomatic)
        return;
    AutomaticControl::Memory& control = memory.automatic;
    archive.add("automaticBehind", control.behind, AutomaticControl::NUM_MONITORS);
    archive.add("automaticAhead", control.ahead, AutomaticControl::NUM_MONITORS);
    archive.add("automaticValues", control.values, AutomaticControl::NUM_MONITORS);
    archive.add("automaticForceSquares", control.forceSquares,
                vrattle.getAutomaticControl().getMemory().forceSquares.size());
    double learning[] = {control.stepsSinceStart, control.numLearnt,   control.logarithms[0],
                         control.logarithms[1],   control.temperature, control.following};
    archive.add("automaticLearning", learning, 6);
    control.stepsSinceStart = learning[0];
    control.numLearnt = learning[1];
    std::copy_n(learning + 2, AutomaticControl::NUM_MONITORS, control.logarithms);
    control.temperature = learning[4];
    control.following = learning[5];
    double shortSteps[] = {control.shortSteps, control.mostShortSteps};
    archive.add("automaticShortSteps", shortSteps, 2);
    control.shortSteps = shortSteps[0];
    control.mostShortSteps = shortSteps[1];
}

void HostVRattleDevice::saveMethod(RunState& run) {
    VRattleDynamics::Memory memory = vrattle.getMemory();
    run.halfStepVelocities = memory.halfStepVelocities;
    exchange(memory, RunState::Archive(run), memory.monitorValues.size(), settings.isAutomatic);
}

VRattleDynamics::Memory HostVRattleDevice::memoryOf(const RunState& run, const IntegratorSettings& saved) const {
    VRattleDynamics::Memory memory = {};
    memory.halfStepVelocities = run.halfStepVelocities;
    memory.references = run.references;
    exchange(memory, RunState::Archive(run), saved.monitors.size(), saved.isAutomatic);
    return memory;
}

bool HostVRattleDevice::canResume(const RunState& run, const IntegratorSettings& saved) {
    memoryOf(run, saved);
    return run.halfStepVelocities.size() == masses.size();
}

void HostVRattleDevice::resumeMethod(const State& state, const RunState& run, const IntegratorSettings& saved) {
    vrattle.resume(state.positions, state.velocities, state.forces, state.groupEnergy, memoryOf(run, saved));
}
