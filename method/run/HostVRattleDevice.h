// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_
#define OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_

#include "run/HostRunDevice.h"
#include "run/RunState.h"
#include "step/VRattleDynamics.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/** The device of VariableStepRattleIntegrator: the method is VRattleDynamics. */
class HostVRattleDevice : public HostRunDevice<VRattleDynamics> {
public:
    HostVRattleDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                      const IntegratorSettings& settings);
    void beginTrial(double stepSize, bool isBackwards) override;
    void takeTrialStep() override;
    void endTrial() override;
    std::vector<double> getMonitorValues() override;
    long long getNumRescues() override;
    double getNegligibleValue() override;
    double getReferenceTemperature() override;
    void setReferenceTemperature(double temperature) override;
    long long getNumShortSteps() override;
    bool canResume(const RunState& run, const IntegratorSettings& saved) override;

protected:
    void setMethod(const IntegratorSettings& settings) override;
    void saveMethod(RunState& run) override;
    void resumeMethod(const State& state, const RunState& run, const IntegratorSettings& saved) override;
    void exchange(VRattleDynamics::Memory& memory, RunState::Archive archive, size_t numMonitors,
                  bool isAutomatic) const;
    VRattleDynamics::Memory memoryOf(const RunState& run, const IntegratorSettings& saved) const;
    VRattleDynamics& vrattle = method;
    VRattleDynamics::Settings settings;
    /** A trial run, and what is to be put back after it. */
    struct Trial {
        VRattleDynamics::Kept kept;
        double time, direction;
    };
    std::unique_ptr<Trial> trial;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_
