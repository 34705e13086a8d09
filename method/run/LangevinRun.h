// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_LANGEVINRUN_H_
#define OPENMMVRATTLE_LANGEVINRUN_H_

#include "openmm/Vec3.h"
#include "run/RunState.h"
#include "step/LangevinDynamics.h"
#include <vector>

namespace OpenMMVRattle {

struct IntegratorSettings;

/** Dynamics at constant temperature in a run: the method of VariableStepRattleLangevinIntegrator. See VRattleRun, the other one. */
class LangevinRun : public LangevinDynamics {
public:
    using LangevinDynamics::LangevinDynamics;
    /** Automatic step control and trial runs are not of this method. */
    double getNegligibleValue() const {
        return 0;
    }
    void beginFixedSteps(double stepSize);
    Findings getFindings() const;
    void setFindings(const Findings& findings);
    StepCounts getCounts() const;

    void save(RunState& run) const;
    bool canResume(const RunState& run, const IntegratorSettings& saved) const;
    using LangevinDynamics::resume;
    void resume(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const RunState& run,
                const IntegratorSettings& saved);

private:
    void exchange(Memory& memory, RunState::Archive archive) const;
    Memory read(const RunState& run) const;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_LANGEVINRUN_H_
