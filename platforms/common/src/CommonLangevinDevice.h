// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONLANGEVINDEVICE_H_
#define OPENMMVRATTLE_COMMONLANGEVINDEVICE_H_

#include "CommonRunDevice.h"
#include "run/LangevinRun.h"

namespace OpenMMVRattle {

/**
 * The device of VariableStepRattleLangevinIntegrator for OpenCL, CUDA and HIP. The GPU takes the steps that need no substeps. The
 * host takes those that do, from the state before them and with the same noise, and goes on as long as the next one begins with
 * substeps.
 */
class CommonLangevinDevice : public CommonRunDevice<LangevinRun> {
public:
    using CommonRunDevice::CommonRunDevice;
    Findings getFindings() override;

protected:
    bool canGoOnDevice() override;
    DeviceSteps::Settings makeDeviceSettings() override;
    DeviceSteps::State makeDeviceState() override;
    void adopt(const Vectors& positions, const Vectors& velocities, const Vectors& forces, double energy,
               const DeviceSteps::State& others) override;
    void carryOn(const DeviceSteps::State& others) override;
    bool doesFrameMatter() override;
    int getMostStepsUntilLook() const override {
        return 64; // of 0.2 ms or so, beside which a look costs nothing
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONLANGEVINDEVICE_H_
