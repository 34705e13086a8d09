// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_MONITORCONTROL_H_
#define OPENMMVRATTLE_MONITORCONTROL_H_

#include "step/StepControl.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * The paper's control: monitors U_k, u = B(U/U_ref) of them, and a symmetric recursion of the density, (3.14), (3.15) or bounded.
 *
 * The recursion keeps an oscillation of rho about u for ever, so it must start without one. The smooth solution is
 * rho[1/2] = u0 + (u1 - u-1)/4 + O(h^3), u0 being u(q0,p0), or for (3.14) the mean of u(q0,p1/2) and u(q0,p-1/2); which follows from
 * docs/method.md, section 7. The first step is a step of plain RATTLE from the on-step state, which gives u1 with the one force
 * evaluation that the step costs anyway; u-1 comes from a step backwards, whose forces are extrapolated along the path from those at
 * q0 and q1, exactly so where the motion starts at rest (and then q-1 = q1) or the forces are constant.
 *
 * Where no reference value is given, rho[1/2] = 1 and it is the reference value that is chosen such that this is the smooth start:
 * no force evaluation is spent on it. Where one is given, rho[1/2] follows, and the first step is taken again with it.
 *
 * A monitor that is zero at the start, but for rounding, asks for nothing and is no measure of what comes. As long as all are so, or
 * one that has no reference value, the start is calm: steps are single ones of plain RATTLE, and the sequence of densities starts
 * after them. So it is while one without a reference value grows several times in a step, as at a minimum of the energy.
 */
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
    /** How many steps had another density than their recursion gives. */
    long long getNumRescues() const {
        return numRescues;
    }
    void changeSettings(const StepSettings& newSettings, const std::vector<double>& references,
                        SettingsChange change) override;
    void change(ChangeKind kind, double part) override;
    void reverse() override;
    void solve() override;
    bool finish() override;
    void accept() override;
    void abandon() override;
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
    double findFirstDensity();
    void lookBack();
    bool stepBack();
    bool findSmoothStart();
    void scaleReferences();
    StepMonitor monitor;
    StepDensity recursion;
    long long numRescues;
    // The step in progress.
    double u, densityScale; // u(q[n],p[n]); by which u and rho change where the velocities jump
    bool isRescued;
    // The first one.
    bool isCalm;
    std::vector<char> isNegligible; // each monitor
    double firstDensity; // the smooth rho[1/2], where it is known and the step is taken again with it; else 0
    bool hasBack;
    StepState back; // a step behind the start, if there is one
    std::vector<double> startValues, referencesBefore;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MONITORCONTROL_H_
