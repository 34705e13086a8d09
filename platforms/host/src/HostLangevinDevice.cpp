// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "HostLangevinDevice.h"
#include "run/IntegratorSettings.h"
#include "run/RunState.h"

using namespace OpenMMVRattle;
using std::vector;

HostLangevinDevice::HostLangevinDevice(OpenMM::ContextImpl& context, std::unique_ptr<ContextVectors> vectors,
                                       const OpenMM::Integrator& integrator, const IntegratorSettings& settings) :
        HostRunDevice(context, std::move(vectors), integrator, settings),
        langevin(*new LangevinDynamics(masses, getConstraints(), expressions)) {
    dynamics.reset(&langevin);
}

void HostLangevinDevice::setDynamics(const IntegratorSettings& from) {
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

void HostLangevinDevice::saveDynamics(RunState& run) {
    const LangevinDynamics::Memory memory = langevin.getMemory();
    run.methodValues = {{"parameters", memory.parameters},
                        {"parameterRates", memory.parameterRates},
                        {"multipliers", memory.multipliers},
                        {"monitorValue", {memory.monitorValue}},
                        {"lastSubstep", {memory.lastSubstep}}};
}

LangevinDynamics::Memory HostLangevinDevice::memoryOf(const RunState& run) const {
    const ConstraintSystem& system = langevin.getConstraintSystem();
    const size_t numConstraints = system.getNumConstraints(), numParameters = system.getNumParameters();
    return {run.getMethodValues("parameters", numParameters), run.getMethodValues("parameterRates", numParameters),
            run.getMethodValues("multipliers", numConstraints), run.getMethodValue("monitorValue"),
            run.getMethodValue("lastSubstep")};
}

bool HostLangevinDevice::canResume(const RunState& run, const IntegratorSettings&) {
    memoryOf(run);
    return true;
}

void HostLangevinDevice::resumeDynamics(const State& state, const RunState& run, const IntegratorSettings&) {
    langevin.resume(state.positions, state.velocities, state.forces, state.groupEnergy, memoryOf(run));
}
