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
    /** A relative change of u that starts no oscillation to speak of: the density is not scaled for it, which would cost reversibility. */
    static constexpr double SMALL_JUMP = 0.01;
    MonitorControl(ConstraintSolver& constraints, StepSolver& solver, const StepState& now);
    std::vector<double> getReferences() const override {
        return monitor.getReferences();
    }
    void setReferences(const std::vector<double>& newReferences) override {
        monitor.setReferences(newReferences);
    }
    long long getNumRescues() const override {
        return numRescues;
    }
    bool setSettings(const StepSettings& newSettings, bool isInForce) override;
    StepMemory getMemory() const override;
    void setMemory(const StepSettings& newSettings, const StepMemory& memory) override;
    void begin() override;
    void adopt(const StepMemory& memory) override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    void prepare() override;
    bool isVariable() const override {
        return hasDensity && !isConstant();
    }
    void jump(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta, bool isLarge) override;
    void solve() override;
    ConstraintSolver::HalfStep* lookBack() override;
    ConstraintSolver::Observer* observe(const ConstraintSolver::OnStep& end) override;
    bool measure() override;
    void accept() override;
    void abandon() override;
    /** u(q[n],p[n-1/2]), which (3.14) takes; it is evaluated if need be. */
    double findHalfStepValue();

private:
    std::string explainStep() const override;
    bool isConstant() const {
        return settings.isFixedStep || monitor.getTerms().empty();
    }
    bool needsHalfStep() const;
    void applySettings(const StepSettings& newSettings, const std::vector<StepMonitor::Term>& terms);
    bool seesHalfStep() const;
    void look();
    void forget();
    void rescaleDensity();
    double limit(const std::vector<double>& monitorValues) const;
    double evaluateU(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta);

    StepMonitor monitor;
    StepDensity recursion;
    MonitorStart firstStep;
    long long numRescues;

    // The step in progress.
    double densityScale; // by which u and rho change where the parameters begin to move, or stop
    bool isRescued;
    std::vector<double> valuesNext, valuesHalf, valuesTrial;
    ConstraintSolver::HalfStep atHalfStep;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MONITORCONTROL_H_
