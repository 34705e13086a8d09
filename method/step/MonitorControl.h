// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_MONITORCONTROL_H_
#define OPENMMVRATTLE_MONITORCONTROL_H_

#include "step/MonitorStart.h"
#include "step/StepControl.h"

namespace OpenMMVRattle {

/** The paper's control: monitors U_k, u = B(U/U_ref) of them, and a symmetric recursion of the density, (3.14), (3.15) or bounded. */
class MonitorControl : public StepControl {
public:
    /** A relative change of u that starts no oscillation to speak of: to scale the density for it would only cost reversibility. */
    static constexpr double SMALL_CHANGE = 0.01;
    MonitorControl(ConstraintSolver& constraints, StepSolver& solver, StepState& now);
    std::vector<double> getValues() const override {
        return now.values;
    }
    std::vector<double> getReferences() const override {
        return monitor.references;
    }
    void setReferences(const std::vector<double>& references) override {
        monitor.references = references;
    }
    long long getNumRescues() const {
        return numRescues;
    }
    void applySettings(const StepSettings& newSettings) override;
    void changeSettings(const StepSettings& newSettings, const std::vector<double>& references,
                        SettingsChange change) override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    void solve() override;
    ConstraintSolver::Observer* observe(ConstraintSolver::OnStep& end) override;
    bool measure() override;
    void accept() override;
    void abandon() override {
        firstStep.abandon();
    }
    /** u(q[n],p[n-1/2]), which (3.14) takes; it is evaluated if need be. */
    double findHalfStepValue();

private:
    std::string explainStep() const override;
    bool isConstant() const {
        return settings.isFixedStep || settings.terms.empty();
    }
    bool needsHalfStep() const;
    bool seesHalfStep() const;
    void rescaleDensity(double oldU);
    bool solveSum(double bounded);
    StepMonitor monitor;
    StepDensity recursion;
    MonitorStart firstStep;
    long long numRescues;
    // The step in progress.
    double u, densityScale; // u(q[n],p[n]); by which u and rho change where the velocities jump
    bool isRescued;
    ConstraintSolver::HalfStep atHalfStep;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MONITORCONTROL_H_
