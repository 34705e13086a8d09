// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonVRattleDevice.h"
#include "run/IntegratorSettings.h"
#include <algorithm>

using namespace OpenMMVRattle;
using std::vector;

CommonVRattleDevice::CommonVRattleDevice(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute,
                                         const OpenMM::Integrator& integrator, const IntegratorSettings& settings) :
        CommonRunDevice(context, compute, integrator, settings) {
}

bool CommonVRattleDevice::canGoOnDevice() {
    const vector<double> references = vrattle.getReferences();
    return !settings.isAutomatic && vrattle.hasStarted() &&
           std::all_of(references.begin(), references.end(), [](double reference) { return reference > 0; });
}

DeviceSteps::Settings CommonVRattleDevice::makeDeviceSettings() {
    vector<StepMonitor::Term> terms = settings.terms;
    const vector<double> references = vrattle.getReferences();
    for (size_t k = 0; k < terms.size(); k++)
        terms[k].reference = references[k];
    return {
        settings.stepSize,  StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep),
        settings.update,    settings.isFixedStep,
        settings.tolerance, terms};
}

DeviceSteps::State CommonVRattleDevice::makeDeviceState() {
    const double halfStepValue = vrattle.findHalfStepValue();
    const VRattleDynamics::Memory memory = vrattle.getMemory();
    return {memory.density, memory.densityOffset, memory.hasHalfStepValue, halfStepValue};
}

void CommonVRattleDevice::adopt(const State& state, const DeviceSteps::State& others) {
    vrattle.adopt(state.positions, state.velocities, state.forces, state.groupEnergy, others.density,
                  others.hasHalfStepValue ? &others.halfStepValue : nullptr, others.densityOffset);
}

bool CommonVRattleDevice::doesFrameMatter() {
    return StepProgram::usesSpeeds(settings.terms);
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
