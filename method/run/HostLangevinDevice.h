// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTLANGEVINDEVICE_H_
#define OPENMMVRATTLE_HOSTLANGEVINDEVICE_H_

#include "run/HostRunDevice.h"
#include "run/RunState.h"
#include "step/LangevinDynamics.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/** The device of VariableStepRattleLangevinIntegrator: the method is LangevinDynamics. */
class HostLangevinDevice : public HostRunDevice<LangevinDynamics> {
public:
    HostLangevinDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                       const IntegratorSettings& settings);
    std::vector<double> getMonitorValues() override;
    double computeHalfStepKineticEnergy() override;
    long long getNumSubstepped() override;
    int getLargestSubsteps() override;
    std::vector<double> getRandomState() override;
    void setRandomState(const std::vector<double>& state) override;
    bool canResume(const RunState& run, const IntegratorSettings& saved) override;

protected:
    void setMethod(const IntegratorSettings& settings) override;
    void saveMethod(RunState& run) override;
    void resumeMethod(const State& state, const RunState& run, const IntegratorSettings& saved) override;
    LangevinDynamics& langevin = method;

private:
    void exchange(LangevinDynamics::Memory& memory, RunState::Archive archive) const;
    LangevinDynamics::Memory memoryOf(const RunState& run) const;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTLANGEVINDEVICE_H_
