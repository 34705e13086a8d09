// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_
#define OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_

#include "run/HostRunDevice.h"
#include "run/RunState.h"
#include "run/VRattleRun.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/** The device of VariableStepRattleIntegrator: the method is VRattleRun. */
class HostVRattleDevice : public HostRunDevice<VRattleRun> {
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
    void exchange(StepState& state, VRattleRun::Memory& memory, RunState::Archive archive, size_t numMonitors,
                  bool isAutomatic) const;
    void read(const RunState& run, const IntegratorSettings& saved, StepState& state, VRattleRun::Memory& memory) const;
    VRattleRun& vrattle = method;
    StepSettings settings;
    /** A trial run, and what is to be put back after it. */
    struct Trial {
        VRattleRun::Kept kept;
        double time, direction;
    };
    std::unique_ptr<Trial> trial;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_
