// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_AUTOMATICSTEPS_H_
#define OPENMMVRATTLE_AUTOMATICSTEPS_H_

#include "step/AutomaticControl.h"
#include "step/StepControl.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** Steps whose density is that of AutomaticControl. */
class AutomaticSteps : public StepControl, private ConstraintSolver::Observer {
public:
    AutomaticSteps(ConstraintSolver& constraints, StepSolver& solver, const StepState& now);
    const AutomaticControl& getControl() const {
        return control;
    }
    std::vector<double> getReferences() const override;
    void setReferences(const std::vector<double>& references) override;
    void setReferenceTemperature(double kT) {
        control.setReferenceTemperature(kT);
    }
    bool setSettings(const StepSettings& newSettings, bool isInForce) override;
    StepMemory getMemory() const override;
    void setMemory(const StepSettings& newSettings, const StepMemory& memory) override;
    void begin() override;
    void adopt(const StepMemory& memory) override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    void prepare() override;
    bool isVariable() const override;
    void jump(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta, bool isLarge) override;
    bool start() override;
    void solve() override;
    ConstraintSolver::Observer* observe(const ConstraintSolver::OnStep& end) override;
    bool measure() override;
    void accept() override;
    void abandon() override;

private:
    std::string explainStep() const override;
    void seeParticles(int block) override;
    static AutomaticControl::State stateOf(const StepState& state);
    void applySettings(const StepSettings& newSettings);
    void requireFiniteForces(const std::vector<OpenMM::Vec3>& forces);
    void takeValues();
    AutomaticControl control;
    bool isStartedNow;                        // by the step in progress
    bool isJump;                              // whether the velocities are about to jump
    AutomaticControl::Memory memoryBefore;    // a start
    std::vector<double> referencesBefore;     // a first step
    const std::vector<OpenMM::Vec3>* forcesAhead;
    std::vector<double> blockSums; // of the squares of the forces
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_AUTOMATICSTEPS_H_
