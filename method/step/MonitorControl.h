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
class MonitorControl : public StepControl {
public:
    MonitorControl(ConstraintSolver& constraints, StepSolver& solver, const StepState& now);
    /** Throws a StepFailure if any of some terms is defined by constraints, and there are none. */
    static void requireConstraintsFor(const std::vector<StepMonitor::Term>& terms, const ConstraintSystem& system);
    std::vector<double> getReferences() const override;
    void setReferences(const std::vector<double>& references) override;
    long long getNumRescues() const override {
        return numRescues;
    }
    bool setSettings(const StepSettings& settings, bool isInForce) override;
    void changeSettings() override;
    void getMemory(StepMemory& memory) const override;
    void setMemory(const StepSettings& settings, const StepMemory& memory) override;
    void begin() override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    void prepare() override;
    bool isVariable() const override;
    void jump(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta, bool isLarge) override;
    void findFirstDensity() override;
    void solve() override;
    bool needsHalfStep() const override;
    void lookBack(const std::vector<OpenMM::Vec3>& forces, double groupEnergy, StepKind kind, double size) override;
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
     * @param density          rho[n-1/2]
     * @param halfStepValue    u(q[n],p[n-1/2]), or null if it is not known
     * @param offset           what (3.14) and (3.15) differed by in the last step
     */
    void adopt(double density, const double* halfStepValue, double offset);

private:
    std::string explainStep() const override;
    /** Makes the sums of a pass, at one or two sets of multipliers. */
    struct SumObserver : ConstraintSolver::Observer {
        explicit SumObserver(StepMonitor& monitor) : monitor(monitor), sums(monitor.makeSums()), halfSums(sums) {
        }
        void seeParticles(int block) override;
        void seeConstraints(int range, int first, int end) override;
        StepMonitor& monitor;
        const std::vector<OpenMM::Vec3>* forces = nullptr;
        const std::vector<double>*multipliers = nullptr, *rightSide = nullptr;
        const ConstraintSolver::HalfStep* half = nullptr;
        StepMonitor::Sums sums, halfSums;
    };
    /** (3.14) */
    struct Equation : DensityEquation {
        explicit Equation(MonitorControl& control);
        ConstraintSolver::Observer* observe(const std::vector<double>& multipliers,
                                            const std::vector<double>& rightSide) override;
        double evaluate(const std::vector<OpenMM::Vec3>& w, const std::vector<double>& multipliers) override;
        void findGradient(const std::vector<OpenMM::Vec3>& w, const ExpressionParameters& theta,
                          const std::vector<double>& multipliers, std::vector<OpenMM::Vec3>& gradient) override;
        MonitorControl& control;
    };
    double evaluateU(const std::vector<OpenMM::Vec3>& velocities, const std::vector<double>& multipliers,
                     const StepMonitor::Sums& sums);
    void applySettings(const StepSettings& newSettings, const std::vector<StepMonitor::Term>& terms);
    void ensureMonitor();
    void look();
    void forget();
    void rescaleDensity(double oldU);
    double combineAndLimit(const std::vector<double>& monitorValues) const;
    double evaluateU(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta);
    void measureAt(const StepState& state, const std::vector<OpenMM::Vec3>& forces, double groupEnergy,
                   std::vector<double>& monitorValues);
    double evaluateRate(const End& end);
    bool evaluateBackwards(const std::vector<OpenMM::Vec3>& forces, double groupEnergy, double size);
    std::vector<double> evaluateHalfSteps(double size);
    bool startDensity();
    void scaleReferences();
    static double startValue(double start, double ahead, const double* back);

    StepMonitor monitor;
    SumObserver observer;
    StepDensity density;
    bool mustForget; // the densities, for the sake of new settings
    double u; // u(q[n],p[n])
    bool hasHalfStepValue;
    double halfStepValue, rate; // u(q[n],p[n-1/2]); the change of u along F - G^T Lambda
    double densityOffset; // what (3.14) and (3.15) differed by in the last step
    double firstDensity; // of the first step, once it is known; else 0
    bool isCalm; // whether the first step is one that starts no sequence
    std::vector<char> isNegligible; // each monitor, at the first step
    std::vector<double> referencesBefore; // the first step, as long as firstDensity is known
    bool isMonitorCurrent; // whether the monitor has the forces at q[n]

    // The step in progress.
    double densityScale; // by which u and rho change where the parameters begin to move, or stop
    std::vector<double> valuesNext, valuesHalf, valuesTrial, multiplierTrial, rightSideTrial;
    std::vector<OpenMM::Vec3> acceleration;
    bool isRescued;
    long long numRescues;

    // The start: the step backwards, and the monitors there and at the start.
    bool isStart, hasBack;
    StepState back;
    std::vector<double> backValues, startValues;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MONITORCONTROL_H_
