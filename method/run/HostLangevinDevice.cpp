// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/HostLangevinDevice.h"
#include "run/IntegratorSettings.h"
#include "run/RunState.h"

using namespace OpenMMVRattle;
using std::vector;

HostLangevinDevice::HostLangevinDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                                       const IntegratorSettings& settings) :
        HostRunDevice(std::move(vectors), system, settings) {
}

void HostLangevinDevice::setMethod(const IntegratorSettings& from) {
    langevin.setSettings({from.stepSize, from.constraintTolerance, *from.langevin});
}

vector<double> HostLangevinDevice::getMonitorValues() {
    return langevin.getMonitorValues();
}

double HostLangevinDevice::computeHalfStepKineticEnergy() {
    return langevin.computeHalfStepKineticEnergy();
}

long long HostLangevinDevice::getNumSubstepped() {
    return langevin.getNumSubstepped();
}

int HostLangevinDevice::getLargestSubsteps() {
    return langevin.getLargestSubsteps();
}

vector<double> HostLangevinDevice::getRandomState() {
    return langevin.getRandomState();
}

void HostLangevinDevice::setRandomState(const vector<double>& state) {
    langevin.setRandomState(state);
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void HostLangevinDevice::exchange(LangevinDynamics::Memory& memory, RunState::Archive archive) const {
    const ConstraintSystem& constraints = langevin.getConstraintSystem();
    archive.add("parameters", memory.parameters, constraints.getNumParameters());
    archive.add("parameterRates", memory.parameterRates, constraints.getNumParameters());
    archive.add("multipliers", memory.multipliers, constraints.getNumConstraints());
    archive.add("monitorValue", memory.monitorValue);
    archive.add("lastSubstep", memory.lastSubstep);
}

void HostLangevinDevice::saveMethod(RunState& run) {
    LangevinDynamics::Memory memory = langevin.getMemory();
    exchange(memory, RunState::Archive(run));
}

LangevinDynamics::Memory HostLangevinDevice::memoryOf(const RunState& run) const {
    LangevinDynamics::Memory memory = {};
    exchange(memory, RunState::Archive(run));
    return memory;
}

bool HostLangevinDevice::canResume(const RunState& run, const IntegratorSettings&) {
    memoryOf(run);
    return true;
}

void HostLangevinDevice::resumeMethod(const State& state, const RunState& run, const IntegratorSettings&) {
    langevin.resume(state.positions, state.velocities, state.forces, state.groupEnergy, memoryOf(run));
}
