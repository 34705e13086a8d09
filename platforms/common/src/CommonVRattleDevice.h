// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONVRATTLEDEVICE_H_
#define OPENMMVRATTLE_COMMONVRATTLEDEVICE_H_

#include "CommonRunDevice.h"
#include "run/VRattleRun.h"

namespace OpenMMVRattle {

/** The device of VariableStepRattleIntegrator for OpenCL, CUDA and HIP. */
class CommonVRattleDevice : public CommonRunDevice<VRattleRun> {
public:
    using CommonRunDevice::CommonRunDevice;
    Findings getFindings() override;
    StepCounts getCounts() override;

protected:
    bool canGoOnDevice() override;
    DeviceSteps::Settings makeDeviceSettings() override;
    DeviceSteps::State makeDeviceState() override;
    void adopt(const Vectors& positions, const Vectors& velocities, const Vectors& forces, double energy,
               const DeviceSteps::State& others) override;
    void carryOn(const DeviceSteps::State& others) override;
    bool doesFrameMatter() override;
    VRattleRun::Memory memoryOf(const DeviceSteps::State& others);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONVRATTLEDEVICE_H_
