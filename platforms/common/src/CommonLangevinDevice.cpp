// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonLangevinDevice.h"

using namespace OpenMMVRattle;
using std::vector;

bool CommonLangevinDevice::canGoOnDevice() {
    return langevin.isCalm();
}

DeviceSteps::Settings CommonLangevinDevice::makeDeviceSettings() {
    const LangevinDynamics::Settings& from = langevin.getSettings();
    const LangevinDynamics::Noise noise = langevin.findNoise();
    const double factor = langevin.getFollowingFactor();
    DeviceSteps::Settings settings = {from.stepSize,         StepDensity(StepDensity::Explicit, from.stepSize, 0, 0),
                                      StepDensity::Explicit, true,
                                      from.tolerance,        {}};
    settings.langevin = DeviceSteps::Langevin{noise.damping, noise.size, factor > 1 ? langevin.findFloor() : 0.0,
                                              factor, langevin.findLargestCalm()};
    return settings;
}

DeviceSteps::State CommonLangevinDevice::makeDeviceState() {
    DeviceSteps::State state = {1, 0, false, 0};
    const vector<double> random = langevin.getRandomState();
    state.reference = langevin.getReferences()[0];
    state.seed = (int64_t) random[0];
    state.numDrawn = (int64_t) random[1];
    return state;
}

void CommonLangevinDevice::adopt(const State& state, const DeviceSteps::State& others) {
    langevin.adopt(state.positions, state.velocities, state.forces, state.groupEnergy, getDeviceParameters(),
                   others.reference, others.isFollowed, others.numDrawn);
}

void CommonLangevinDevice::carryOn(const DeviceSteps::State& others) {
    langevin.setReferences({others.reference});
    langevin.setRandomState({(double) others.seed, (double) others.numDrawn});
}

// What is removed of it in each step is less than U is known to.
bool CommonLangevinDevice::doesFrameMatter() {
    return false;
}

vector<double> CommonLangevinDevice::getReferences() {
    const DeviceSteps::State* state = findDeviceState();
    if (state == nullptr || !state->isFollowed) {
        bringToHost();
        return HostLangevinDevice::getReferences();
    }
    return {state->reference};
}

vector<double> CommonLangevinDevice::getMonitorValues() {
    vector<double> values;
    return readMonitorValues(values) ? values : HostLangevinDevice::getMonitorValues();
}

double CommonLangevinDevice::computeHalfStepKineticEnergy() {
    bringToHost();
    return HostLangevinDevice::computeHalfStepKineticEnergy();
}

long long CommonLangevinDevice::getNumSubstepped() {
    settle();
    return HostLangevinDevice::getNumSubstepped();
}

int CommonLangevinDevice::getLargestSubsteps() {
    settle();
    return HostLangevinDevice::getLargestSubsteps();
}

vector<double> CommonLangevinDevice::getRandomState() {
    const DeviceSteps::State* state = findDeviceState();
    return state != nullptr ? vector<double>{(double) state->seed, (double) state->numDrawn}
                            : HostLangevinDevice::getRandomState();
}

void CommonLangevinDevice::setRandomState(const vector<double>& state) {
    takeToHost();
    HostLangevinDevice::setRandomState(state);
}
