// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonVRattleDevice.h"
#include "run/IntegratorSettings.h"
#include <algorithm>

using namespace OpenMMVRattle;
using std::vector;

namespace {

vector<double> referencesOf(const DeviceSteps::State& state) {
    return {std::begin(state.references), std::end(state.references)};
}

} // namespace

CommonVRattleDevice::CommonVRattleDevice(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute,
                                         const OpenMM::Integrator& integrator, const IntegratorSettings& settings) :
        CommonRunDevice(context, compute, integrator, settings) {
}

bool CommonVRattleDevice::canGoOnDevice() {
    const vector<double> references = vrattle.getReferences();
    // Automatic step control finds its references on the way.
    return vrattle.hasStarted() &&
           (settings.isAutomatic ||
            std::all_of(references.begin(), references.end(), [](double reference) { return reference > 0; }));
}

DeviceSteps::Settings CommonVRattleDevice::makeDeviceSettings() {
    DeviceSteps::Settings to = {
        settings.stepSize,  StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep),
        settings.update,    settings.isFixedStep,
        settings.tolerance, {}};
    to.isAutomatic = settings.isAutomatic;
    if (settings.isAutomatic) {
        to.choice = vrattle.getAutomaticControl().getChoice();
        to.numDegreesOfFreedom = vrattle.getAutomaticControl().getNumDegreesOfFreedom();
        return to;
    }
    to.terms = settings.terms;
    const vector<double> references = vrattle.getReferences();
    for (size_t k = 0; k < to.terms.size(); k++)
        to.terms[k].reference = references[k];
    return to;
}

DeviceSteps::State CommonVRattleDevice::makeDeviceState() {
    const double halfStepValue = settings.isAutomatic ? 0.0 : vrattle.findHalfStepValue();
    const VRattleRun::Memory memory = vrattle.getMemory();
    DeviceSteps::State state = {memory.rho, memory.densityOffset, memory.hasHalfStepValue, halfStepValue};
    if (settings.isAutomatic) {
        state.automatic = memory.automatic;
        std::copy(memory.references.begin(), memory.references.end(), state.references);
    }
    return state;
}

VRattleRun::Memory CommonVRattleDevice::memoryOf(const DeviceSteps::State& others) {
    VRattleRun::Memory memory = vrattle.getMemory();
    memory.hasDensity = true;
    memory.rho = others.density;
    memory.densityOffset = others.densityOffset;
    memory.hasHalfStepValue = others.hasHalfStepValue;
    memory.halfStepValue = others.halfStepValue;
    static_cast<AutomaticRecursions::AutomaticNumbers&>(memory.automatic) = others.automatic;
    memory.references = referencesOf(others);
    return memory;
}

void CommonVRattleDevice::adopt(const State& state, const DeviceSteps::State& others) {
    vrattle.adopt(state.positions, state.velocities, state.forces, state.groupEnergy, getDeviceParameters(),
                  memoryOf(others));
}

void CommonVRattleDevice::carryOn(const DeviceSteps::State& others) {
    if (settings.isAutomatic)
        vrattle.adopt(memoryOf(others));
}

// What a CMMotionRemover takes away is nothing to speak of for automatic step control, which would have to look at all velocities again.
bool CommonVRattleDevice::doesFrameMatter() {
    return !settings.isAutomatic && StepMonitor::useVelocities(settings.terms);
}

vector<double> CommonVRattleDevice::getReferences() {
    const DeviceSteps::State* others = settings.isAutomatic ? findDeviceState() : nullptr;
    return others != nullptr ? referencesOf(*others) : HostVRattleDevice::getReferences();
}

double CommonVRattleDevice::getReferenceTemperature() {
    const DeviceSteps::State* others = settings.isAutomatic ? findDeviceState() : nullptr;
    return others != nullptr ? others->automatic.temperature : HostVRattleDevice::getReferenceTemperature();
}

long long CommonVRattleDevice::getNumShortSteps() {
    const DeviceSteps::State* others = settings.isAutomatic ? findDeviceState() : nullptr;
    return others != nullptr ? (long long) others->automatic.mostShortSteps : HostVRattleDevice::getNumShortSteps();
}

void CommonVRattleDevice::beginTrial(double stepSize, bool isBackwards) {
    takeToHost();
    HostVRattleDevice::beginTrial(stepSize, isBackwards);
}

vector<double> CommonVRattleDevice::getMonitorValues() {
    vector<double> values;
    return readMonitorValues(values) ? values : HostVRattleDevice::getMonitorValues();
}

long long CommonVRattleDevice::getNumRescues() {
    return HostVRattleDevice::getNumRescues() + getNumDeviceRescues();
}
