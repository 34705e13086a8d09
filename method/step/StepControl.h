// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPCONTROL_H_
#define OPENMMVRATTLE_STEPCONTROL_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/StepSolver.h"
#include "step/StepState.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * What decides on the density rho of the steps, dt = stepSize/rho: from what it sees of the states it keeps rho[n-1/2] and what else
 * rho[n+1/2] follows from. It is told of all that happens to the state, which is the one that the StepSolver goes from.
 */
class StepControl {
public:
    enum StepKind { Regular, First, Shortened };
    /** What has been changed between two steps. */
    enum ChangeKind { Everything, Forces, Velocities, Frame };
    /** A step has come to its end. */
    struct End {
        const StepState& state;
        const std::vector<OpenMM::Vec3>& forces; // those there, which are not in the state yet
        double groupEnergy;
        const ConstraintSolver::HalfStep* atHalfStep; // or null
        StepKind kind;
        double size; // ps
    };

    StepControl(ConstraintSolver& constraints, StepSolver& solver, const StepState& now) :
            constraints(constraints), solver(solver), now(now), settings(), hasDensity(false), rho(1), rhoNext(1) {
    }
    virtual ~StepControl() {
    }
    /** Whether the next step continues a sequence of densities; if not, it is the first one. */
    bool hasStarted() const {
        return hasDensity;
    }
    /** rho[n-1/2] */
    double getDensity() const {
        return rho;
    }
    /** rho[n+1/2] of the step in progress */
    double getNextDensity() const {
        return rhoNext;
    }
    /** U_k at the state */
    const std::vector<double>& getValues() const {
        return values;
    }
    /** U_k,ref, 0 while it is not known */
    virtual std::vector<double> getReferences() const = 0;
    virtual void setReferences(const std::vector<double>& references) = 0;
    virtual long long getNumRescues() const {
        return 0;
    }
    /**
     * Take over settings.
     *
     * @param isInForce    whether this control has been in force so far
     * @return whether the densities go on as if nothing had happened; if not, changeSettings() has to follow where there is a state
     */
    virtual bool setSettings(const StepSettings& settings, bool isInForce) = 0;
    virtual void changeSettings() = 0;
    /** What the following steps depend on. */
    virtual void getMemory(StepMemory& memory) const = 0;
    virtual void setMemory(const StepSettings& settings, const StepMemory& memory) = 0;

    /**
     * The state is one that no step has led to: there is no density.
     *
     * @throws StepFailure    if a monitor is not defined there
     */
    virtual void begin() = 0;
    /**
     * The state has changed between two steps. But for a change of the velocities the half-step momentum is formed anew afterwards.
     *
     * @param part    how much of it is new, between 0 and 1
     * @throws StepFailure    if a monitor is not defined there
     */
    virtual void change(ChangeKind kind, double part) = 0;
    /** Turn time around, where solve() has found the step that would have come, and the half-step momentum is its already. */
    virtual void reverse() = 0;

    /** A step is coming. */
    virtual void prepare() = 0;
    /** Whether it depends on the monitors at all. */
    virtual bool isVariable() const = 0;
    /** The velocities will jump to these in the step, since parameters of expressions begin to move, or stop. */
    virtual void jump(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& theta, bool isLarge) = 0;
    /** Start a sequence of densities without looking ahead; returns whether that is done. */
    virtual bool start() {
        return false;
    }
    /** Else find rho[1/2] of the first step, which is one of plain RATTLE from the on-step state. */
    virtual void findFirstDensity() = 0;
    /**
     * Find rho[n+1/2], and solve the equations of the step with it.
     *
     * @throws StepFailure    if they have no solution that the iteration finds
     */
    virtual void solve() = 0;
    [[noreturn]] void throwNotConverged() {
        throw StepFailure(solver.explainFailure() + explainStep());
    }
    /** Whether the multipliers at half-step velocities are wanted at the end of a step. */
    virtual bool needsHalfStep() const {
        return false;
    }
    /** Where the forces at the end of a step are known, look back from its start if it is a first one. */
    virtual void lookBack(const std::vector<OpenMM::Vec3>&, double, StepKind, double) {
    }
    /** What is to be done along with the solution at its end. */
    virtual ConstraintSolver::Observer* observe(const ConstraintSolver::OnStep& end) = 0;
    /**
     * Look at the end of the step; nothing is taken over.
     *
     * @return whether the step stands; if not, the first density is now known better
     * @throws StepFailure    if a monitor is not defined there
     */
    virtual bool measure(const End& end) = 0;
    /** Take over what has been measured, before the state becomes that of the end, and afterwards. */
    virtual void accept(const End& end) = 0;
    virtual void settle(StepKind kind) = 0;
    /** Or the step has failed. */
    virtual void abandon() = 0;

protected:
    /** About the step that failed, for a message. */
    virtual std::string explainStep() const = 0;
    void forgetDensity() {
        hasDensity = false;
        rho = 1;
    }
    ConstraintSolver& constraints;
    StepSolver& solver;
    const StepState& now;
    StepSettings settings;
    bool hasDensity;
    double rho, rhoNext; // rho[n-1/2], rho[n+1/2]
    std::vector<double> values; // U_k
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPCONTROL_H_
