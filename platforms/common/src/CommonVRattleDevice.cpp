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

bool CommonVRattleDevice::canGoOnDevice() {
    const vector<double> references = method.getReferences();
    // Automatic step control finds its references on the way.
    return method.hasStarted() &&
           (method.getSettings().isAutomatic ||
            std::all_of(references.begin(), references.end(), [](double reference) { return reference > 0; }));
}

DeviceSteps::Settings CommonVRattleDevice::makeDeviceSettings() {
    DeviceSteps::Settings settings = {method.getSettings()};
    if (settings.isAutomatic) {
        settings.terms.clear();
        settings.choice = method.getAutomaticControl().getChoice();
        settings.numDegreesOfFreedom = method.getAutomaticControl().getNumDegreesOfFreedom();
        return settings;
    }
    const vector<double> references = method.getReferences();
    for (size_t k = 0; k < settings.terms.size(); k++)
        settings.terms[k].reference = references[k];
    return settings;
}

DeviceSteps::State CommonVRattleDevice::makeDeviceState() {
    const double halfStepValue = method.getSettings().isAutomatic ? 0.0 : method.findHalfStepValue();
    const VRattleRun::Memory memory = method.getMemory();
    DeviceSteps::State state = {memory.rho, memory.densityOffset, memory.hasHalfStepValue, halfStepValue};
    if (method.getSettings().isAutomatic) {
        state.automatic = memory.automatic;
        std::copy(memory.references.begin(), memory.references.end(), state.references);
    }
    return state;
}

VRattleRun::Memory CommonVRattleDevice::memoryOf(const DeviceSteps::State& others) {
    VRattleRun::Memory memory = method.getMemory();
    memory.hasDensity = true;
    memory.rho = others.density;
    memory.densityOffset = others.densityOffset;
    memory.hasHalfStepValue = others.hasHalfStepValue;
    memory.halfStepValue = others.halfStepValue;
    static_cast<AutomaticRecursions::AutomaticNumbers&>(memory.automatic) = others.automatic;
    memory.references = referencesOf(others);
    return memory;
}

void CommonVRattleDevice::adopt(const Vectors& positions, const Vectors& velocities, const Vectors& forces,
                                double energy, const DeviceSteps::State& others) {
    method.adopt(positions, velocities, forces, energy, getDeviceParameters(), memoryOf(others));
}

void CommonVRattleDevice::carryOn(const DeviceSteps::State& others) {
    if (method.getSettings().isAutomatic)
        method.adopt(memoryOf(others));
}

// What a CMMotionRemover takes away is nothing to speak of for automatic step control, which would have to look at all velocities again.
bool CommonVRattleDevice::doesFrameMatter() {
    return !method.getSettings().isAutomatic && StepMonitor::useVelocities(method.getSettings().terms);
}

Findings CommonVRattleDevice::getFindings() {
    const DeviceSteps::State* others = method.getSettings().isAutomatic ? findDeviceState() : nullptr;
    return others != nullptr ? Findings{referencesOf(*others), others->automatic.temperature, {}}
                             : CommonRunDevice::getFindings();
}

StepCounts CommonVRattleDevice::getCounts() {
    StepCounts counts = CommonRunDevice::getCounts();
    const DeviceSteps::State* others = method.getSettings().isAutomatic ? findDeviceState() : nullptr;
    if (others != nullptr)
        counts.shortSteps = (long long) others->automatic.mostShortSteps;
    return counts;
}
