// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONVRATTLEDEVICE_H_
#define OPENMMVRATTLE_COMMONVRATTLEDEVICE_H_

#include "CommonRunDevice.h"
#include "run/HostVRattleDevice.h"

namespace OpenMMVRattle {

/** The device of VariableStepRattleIntegrator for OpenCL, CUDA and HIP. */
class CommonVRattleDevice : public CommonRunDevice<HostVRattleDevice> {
public:
    CommonVRattleDevice(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute,
                        const OpenMM::Integrator& integrator, const IntegratorSettings& settings);
    std::vector<double> getReferences() override;
    void beginTrial(double stepSize, bool isBackwards) override;
    std::vector<double> getMonitorValues() override;
    long long getNumRescues() override;
    double getReferenceTemperature() override;
    long long getNumShortSteps() override;

protected:
    bool canGoOnDevice() override;
    DeviceSteps::Settings makeDeviceSettings() override;
    DeviceSteps::State makeDeviceState() override;
    void adopt(const State& state, const DeviceSteps::State& others) override;
    void carryOn(const DeviceSteps::State& others) override;
    bool doesFrameMatter() override;
    VRattleRun::Memory memoryOf(const DeviceSteps::State& others);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONVRATTLEDEVICE_H_
