// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPCONTROL_H_
#define OPENMMVRATTLE_STEPCONTROL_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/StepSettings.h"
#include "step/StepSolver.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** What the density of the next step depends on, beside settings, references and the state. */
struct StepMemory {
    bool hasDensity = false; // else the next step is the first one
    double rho = 1; // rho[n-1/2]
    // Of monitors: u(q[n],p[n-1/2]), if it is known; and for speed alone the change of u along F - G^T Lambda, and what (3.14) and
    // (3.15) differed by in the last step.
    bool hasHalfStepValue = false;
    double halfStepValue = 0, rate = 0, densityOffset = 0;
};

/**
 * What decides on the density rho of the steps, dt = stepSize/rho: from what it sees of the states it keeps rho[n-1/2] and what else
 * rho[n+1/2] follows from. It is told of all that happens to the state, which is the one that the StepSolver goes from.
 */
class StepControl : protected StepMemory {
public:
    /** What has been changed between two steps. */
    enum ChangeKind { Everything, Forces, Velocities, Frame };
    /** What about settings: steps and bounds; the references of the same monitors; or these themselves. */
    enum SettingsChange { Nothing, Sizes, References, Monitors };
    StepControl(ConstraintSolver& constraints, StepSolver& solver, StepState& now) :
            constraints(constraints), solver(solver), now(now), settings(), rhoNext(1) {
    }
    virtual ~StepControl() = default;
    bool hasStarted() const {
        return hasDensity;
    }
    /** rho[n-1/2], and rho[n+1/2] of the step in progress */
    double getDensity() const {
        return rho;
    }
    double getNextDensity() const {
        return rhoNext;
    }
    /** U_k[n], and U_k,ref, 0 while it is not known */
    virtual std::vector<double> getValues() const = 0;
    virtual std::vector<double> getReferences() const = 0;
    virtual void setReferences(const std::vector<double>& references) = 0;
    const StepMemory& getMemory() const {
        return *this;
    }
    void setMemory(const StepMemory& memory) {
        static_cast<StepMemory&>(*this) = memory;
    }
    /** Take over settings, with the references that belong to them. Where these change at a state, the density goes on if it can. */
    virtual void changeSettings(const StepSettings& newSettings, const std::vector<double>& references,
                                SettingsChange change) = 0;

    /** The state is one that no step has led to: there is no density. Fails as change() does. */
    void begin() {
        forgetDensity();
        change(Everything, 1.0);
    }
    /**
     * The state has changed between two steps. But for a change of the velocities the half-step momentum is formed anew afterwards.
     *
     * @param part    how much of it is new, between 0 and 1
     * @throws StepFailure    if a monitor is not defined there
     */
    virtual void change(ChangeKind kind, double part) = 0;
    /** Turn time around, where solve() has found the step that would have come, and the half-step momentum is its already. */
    virtual void reverse() = 0;

    /** Where there is no sequence of densities yet, start one without looking ahead; returns whether that is done. */
    virtual bool start() {
        return false;
    }
    /**
     * Find rho[n+1/2], and solve the equations of the step with it; but rho[1/2] alone for a first step, which is one of plain
     * RATTLE from the on-step state.
     *
     * @throws StepFailure    if they have no solution that the iteration finds
     */
    virtual void solve() = 0;
    [[noreturn]] void throwNotConverged() {
        throw StepFailure(solver.explainFailure() + explainStep());
    }
    /**
     * The forces at the end of the step are known: complete it (3.12)-(3.13) and measure there; nothing is taken over.
     *
     * @return whether the step stands; if not, the first density is now known better
     * @throws StepFailure    if the constraints have become dependent, or a monitor is not defined there
     */
    virtual bool finish() = 0;
    /** Take over what has been measured: the state is that of the end now, and the one before is what was next. */
    virtual void accept() = 0;
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
    StepState& now;
    StepSettings settings;
    double rhoNext; // rho[n+1/2]
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPCONTROL_H_
