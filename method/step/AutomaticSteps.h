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
class AutomaticSteps : public StepControl {
public:
    AutomaticSteps(ConstraintSolver& constraints, StepSolver& solver, StepState& now);
    AutomaticControl& getControl() {
        return control;
    }
    std::vector<double> getValues() const override;
    std::vector<double> getReferences() const override;
    void setReferences(const std::vector<double>& references) override;
    void changeSettings(const StepSettings& newSettings, const std::vector<double>& references,
                        SettingsChange change) override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    bool start() override;
    void solve() override;
    bool finish() override;
    void accept() override;
    void abandon() override;

private:
    void applySettings(const StepSettings& newSettings);
    std::string explainStep() const override;
    static AutomaticControl::State stateOf(const StepState& state);
    AutomaticControl control;
    bool isStartedNow;                        // by the step in progress
    bool isJump;                              // whether the velocities jump in it
    AutomaticControl::Memory memoryBefore;    // a start
    std::vector<double> referencesBefore;     // likewise
    ForceSquares forceSquares;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_AUTOMATICSTEPS_H_
