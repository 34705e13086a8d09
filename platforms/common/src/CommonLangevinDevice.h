// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONLANGEVINDEVICE_H_
#define OPENMMVRATTLE_COMMONLANGEVINDEVICE_H_

#include "CommonRunDevice.h"
#include "run/HostLangevinDevice.h"

namespace OpenMMVRattle {

/**
 * The device of VariableStepRattleLangevinIntegrator for OpenCL, CUDA and HIP. The GPU takes the steps that need no substeps. The
 * host takes those that do, from the state before them and with the same noise, and goes on as long as the next one begins with
 * substeps.
 */
class CommonLangevinDevice : public CommonRunDevice<HostLangevinDevice> {
public:
    using CommonRunDevice::CommonRunDevice;
    std::vector<double> getReferences() override;
    std::vector<double> getMonitorValues() override;
    double computeHalfStepKineticEnergy() override;
    long long getNumSubstepped() override;
    int getLargestSubsteps() override;
    std::vector<double> getRandomState() override;
    void setRandomState(const std::vector<double>& state) override;

protected:
    bool canGoOnDevice() override;
    DeviceSteps::Settings makeDeviceSettings() override;
    DeviceSteps::State makeDeviceState() override;
    void adopt(const State& state, const DeviceSteps::State& others) override;
    void carryOn(const DeviceSteps::State& others) override;
    bool doesFrameMatter() override;
    int getMostStepsUntilLook() const override {
        return 64; // of 0.2 ms or so, beside which a look costs nothing
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONLANGEVINDEVICE_H_
