// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonLangevinDevice.h"

using namespace OpenMMVRattle;
using std::vector;

bool CommonLangevinDevice::canGoOnDevice() {
    return method.isCalm();
}

DeviceSteps::Settings CommonLangevinDevice::makeDeviceSettings() {
    const LangevinDynamics::Noise noise = method.findNoise();
    const double factor = method.getFollowingFactor();
    DeviceSteps::Settings settings = {method.getSettings()};
    settings.atTemperature = {noise.damping, noise.size, factor > 1 ? method.findFloor() : 0.0, factor,
                              method.findLargestCalm()};
    return settings;
}

DeviceSteps::State CommonLangevinDevice::makeDeviceState() {
    DeviceSteps::State state = {1, 0, false, 0};
    const vector<double> random = method.getRandomState();
    state.reference = method.getReferences()[0];
    state.seed = (int64_t) random[0];
    state.numDrawn = (int64_t) random[1];
    return state;
}

void CommonLangevinDevice::adopt(const Vectors& positions, const Vectors& velocities, const Vectors& forces,
                                 double energy, const DeviceSteps::State& others) {
    method.adopt(positions, velocities, forces, energy, getDeviceParameters(), others.reference, others.isFollowed,
                 others.numDrawn);
}

void CommonLangevinDevice::carryOn(const DeviceSteps::State& others) {
    method.setReferences({others.reference});
    method.setRandomState({(double) others.seed, (double) others.numDrawn});
}

// What is removed of it in each step is less than U is known to.
bool CommonLangevinDevice::doesFrameMatter() {
    return false;
}

Findings CommonLangevinDevice::getFindings() {
    const DeviceSteps::State* state = findDeviceState();
    if (state != nullptr && state->isFollowed)
        return {{state->reference}, 0.0, {(double) state->seed, (double) state->numDrawn}};
    bringToHost();
    return CommonRunDevice::getFindings();
}
