// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_
#define OPENMMVRATTLE_HOSTVRATTLEDEVICE_H_

#include "HostRunDevice.h"
#include "step/VRattleDynamics.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/** The device of VariableStepRattleIntegrator: the method is VRattleDynamics. */
class HostVRattleDevice : public HostRunDevice {
public:
    HostVRattleDevice(OpenMM::ContextImpl& context, std::unique_ptr<ContextVectors> vectors,
                      const OpenMM::Integrator& integrator, const IntegratorSettings& settings);
    void beginTrial(double stepSize, bool isBackwards) override;
    void takeTrialStep() override;
    void endTrial() override;
    std::vector<double> getMonitorValues() override;
    long long getNumRescues() override;
    double getNegligibleValue() override;
    long long getNumShortSteps() override;
    bool canResume(const RunState& run, const IntegratorSettings& saved) override;

protected:
    void setDynamics(const IntegratorSettings& settings) override;
    void saveDynamics(RunState& run) override;
    void resumeDynamics(const State& state, const RunState& run, const IntegratorSettings& saved) override;
    VRattleDynamics::Memory memoryOf(const RunState& run, const IntegratorSettings& saved) const;
    VRattleDynamics& vrattle; // the method
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
