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
    StepSettings to;
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
    StepSettings fixed = settings;
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

void HostVRattleDevice::exchange(StepState& state, VRattleRun::Memory& memory, RunState::Archive archive,
                                 size_t numMonitors, bool isAutomatic) const {
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
    VRattleRun::Kept kept = vrattle.keep();
    run.halfStepVelocities = kept.state.w;
    for (size_t k = 0; k < kept.state.lambda.size(); k++) // the difference is all that counts
        kept.state.offset.found[k] -= kept.state.offset.expected[k];
    if (settings.isAutomatic)
        kept.state.values.clear(); // which were of monitors
    exchange(kept.state, kept.memory, RunState::Archive(run), kept.state.values.size(), settings.isAutomatic);
}

void HostVRattleDevice::read(const RunState& run, const IntegratorSettings& saved, StepState& state,
                             VRattleRun::Memory& memory) const {
    exchange(state, memory, RunState::Archive(run), saved.isAutomatic ? 0 : saved.monitors.size(), saved.isAutomatic);
    const vector<double>& rates = state.theta.rates;
    state.theta.isMoving = std::any_of(rates.begin(), rates.end(), [](double rate) { return rate != 0; });
    state.w = run.halfStepVelocities;
    memory.references = run.references;
}

bool HostVRattleDevice::canResume(const RunState& run, const IntegratorSettings& saved) {
    StepState state(vrattle.getConstraintSystem());
    VRattleRun::Memory memory;
    read(run, saved, state, memory);
    return state.w.size() == masses.size();
}

void HostVRattleDevice::resumeMethod(const State& from, const RunState& run, const IntegratorSettings& saved) {
    StepState state(vrattle.getConstraintSystem());
    VRattleRun::Memory memory;
    read(run, saved, state, memory);
    state.q = from.positions;
    state.v = from.velocities;
    state.force = from.forces;
    state.groupEnergy = from.groupEnergy;
    vrattle.resume(state, memory);
}
