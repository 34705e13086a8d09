// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_MONITORCONTROL_H_
#define OPENMMVRATTLE_MONITORCONTROL_H_

#include "step/StepControl.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** The paper's control: monitors U_k, u = B(U/U_ref) of them, and a symmetric recursion of the density, (3.14), (3.15) or bounded. */
class MonitorControl : public StepControl,
                       private DensityEquation,
                       private ConstraintSolver::Observer,
                       private MonitorMemory {
public:
    MonitorControl(ConstraintSolver& constraints, StepSolver& solver, const StepState& now);
    std::vector<double> getReferences() const override;
    void setReferences(const std::vector<double>& references) override;
    long long getNumRescues() const override {
        return numRescues;
    }
    bool setSettings(const StepSettings& next, bool isInForce) override;
    void changeSettings() override;
    void getMemory(StepMemory& memory) const override;
    void setMemory(const StepSettings& newSettings, const StepMemory& memory) override;
    void begin() override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    void prepare() override;
    bool isVariable() const override {
        return hasDensity && !isConstant();
    }
    void jump(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta, bool isLarge) override;
    void findFirstDensity() override;
    void solve() override;
    bool needsHalfStep() const override;
    void lookBack(const std::vector<OpenMM::Vec3>& forces, double energy, StepKind kind, double size) override;
    ConstraintSolver::Observer* observe(const ConstraintSolver::OnStep& end) override;
    bool measure(const End& end) override;
    void accept(const End& end) override;
    void settle(StepKind kind) override;
    void abandon() override;
    /** u(q[n],p[n-1/2]), which (3.14) takes; it is evaluated if need be. */
    double findHalfStepValue();
    /**
     * Go on in the middle of a sequence.
     *
     * @param density    rho[n-1/2]
     * @param value      u(q[n],p[n-1/2]), or null if it is not known
     * @param offset     what (3.14) and (3.15) differed by in the last step
     */
    void adopt(double density, const double* value, double offset);

private:
    std::string explainStep() const override;
    ConstraintSolver::Observer* observeTrial(const std::vector<double>& multipliers,
                                             const std::vector<double>& rightSide) override;
    double evaluate(const std::vector<OpenMM::Vec3>& w, const std::vector<double>& multipliers) override;
    void findGradient(const std::vector<OpenMM::Vec3>& w, const ExpressionParameters& theta,
                      const std::vector<double>& multipliers, std::vector<OpenMM::Vec3>& gradient) override;
    void seeParticles(int block) override;
    void seeConstraints(int range, int first, int end) override;
    bool isConstant() const {
        return settings.isFixedStep || monitor.getTerms().empty();
    }
    void applySettings(const StepSettings& newSettings, const std::vector<StepMonitor::Term>& terms);
    void ensureMonitor();
    void look();
    void forget();
    void rescaleDensity(double oldU);
    double limit(const std::vector<double>& monitorValues) const;
    double evaluateU(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta);
    void measureAt(const StepState& state, const std::vector<OpenMM::Vec3>& forces, double energy,
                   std::vector<double>& monitorValues);
    bool lookBehind(const std::vector<OpenMM::Vec3>& forces, double energy, double size);
    bool startDensity();
    void scaleReferences();

    StepMonitor monitor;
    StepDensity density;
    bool mustForget; // the densities, for the sake of new settings
    bool isMonitorCurrent; // whether the monitor has the forces at q[n]
    long long numRescues;

    // What is to be seen in a pass, and the sums of that.
    const std::vector<OpenMM::Vec3>* seenForces; // or null
    const std::vector<double>*seenMultipliers, *seenRightSide;
    const ConstraintSolver::HalfStep* seenHalf; // or null
    StepMonitor::Sums sums, halfSums;

    // The step in progress.
    double densityScale; // by which u and rho change where the parameters begin to move, or stop
    bool isRescued;
    std::vector<double> valuesNext, valuesHalf, valuesTrial, multiplierTrial, rightSideTrial;

    // The start: the step backwards, and the monitors there and at the start.
    bool isStart, hasBack;
    bool isCalm; // whether the first step is one that starts no sequence
    double firstDensity; // once it is known; else 0
    std::vector<char> isNegligible; // each monitor
    std::vector<double> referencesBefore, backValues, startValues;
    StepState back;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MONITORCONTROL_H_
