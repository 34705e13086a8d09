// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTLANGEVINDEVICE_H_
#define OPENMMVRATTLE_HOSTLANGEVINDEVICE_H_

#include "HostRunDevice.h"
#include "step/LangevinDynamics.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/** The device of VariableStepRattleLangevinIntegrator: the method is LangevinDynamics. */
class HostLangevinDevice : public HostRunDevice {
public:
    HostLangevinDevice(OpenMM::ContextImpl& context, std::unique_ptr<ContextVectors> vectors,
                       const OpenMM::Integrator& integrator, const IntegratorSettings& settings);
    std::vector<double> getMonitorValues() override;
    double computeHalfStepKineticEnergy() override;
    long long getNumSubstepped() override;
    int getLargestSubsteps() override;
    std::vector<double> getRandomState() override;
    void setRandomState(const std::vector<double>& state) override;
    bool canResume(const RunState& run, const IntegratorSettings& saved) override;

protected:
    void setDynamics(const IntegratorSettings& settings) override;
    void saveDynamics(RunState& run) override;
    void resumeDynamics(const State& state, const RunState& run, const IntegratorSettings& saved) override;

private:
    LangevinDynamics::Memory memoryOf(const RunState& run) const;
    LangevinDynamics& langevin; // the method
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTLANGEVINDEVICE_H_
