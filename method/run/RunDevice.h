// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_RUNDEVICE_H_
#define OPENMMVRATTLE_RUNDEVICE_H_

#include "run/RunState.h"
#include <functional>
#include <vector>

namespace OpenMMVRattle {

struct ExpressionConstraint;
struct IntegratorSettings;

/**
 * All that a run needs of a platform: IntegratorRun decides what is to be done, a device does it where the positions are.
 *
 * Two states are to be kept apart. The Context's is what users see and may change. The method's is the on-step state
 * (q[n], v[n], F(q[n]), Lambda, U, rho[n-1/2] and what goes with it) that satisfies the constraints. The two are the same once
 * a step is complete. After start(), changeState() and changeVelocities() the method's may be a projection of the Context's,
 * which keeps the numbers that the user or a Force has given it until the next step is complete.
 *
 * step() need not have happened when it returns: a device may only have asked for it, and look at nothing. The run calls it again
 * and again, with updateState() and findChange() between, and then settle() once; a function that returns a number of the state
 * (getTime(), getLastStep(), getMonitorValues(), ...) waits for what it needs. A step that fails on a device that does not
 * look must leave the state before it, and everything asked for afterwards must have no effect, until settle() reports it.
 *
 * **No function that throws leaves a trace**: the state of the Context (with its time, its step count and the positions of virtual
 * sites) and the method's, references, densities and the last step are as they were before the call; for step() and settle(),
 * as before the step that failed. Work that was done is counted. Functions that take no step but need forces count them too.
 * What a Force throws passes through as it is.
 */
class RunDevice {
public:
    virtual ~RunDevice() = default;

    // ------------------------------------------------------------------------------------------------- the settings

    /**
     * Take over settings, which are consistent (IntegratorSettings::isConsistent()) and have the constraints that the device was
     * made with. Called before anything is asked that depends on them, and again between steps when they have changed. In the
     * course of a run the density goes on where the new settings allow it: it is scaled with u = U/U_ref. The values of the
     * parameters of expressions are not among them.
     *
     * @throws StepFailure    if the System cannot have one of the monitors
     */
    virtual void setSettings(const IntegratorSettings& settings) = 0;
    /**
     * Take over the values of the parameters of expressions, which the next step leads to; start() puts them in force at once.
     *
     * @return whether any is another
     */
    virtual bool setParameters(const std::vector<ExpressionConstraint>& given) = 0;
    /** What has been found in the course of the run, and what is to be in force of it, as from a saved run. */
    virtual Findings getFindings() = 0;
    virtual void setFindings(const Findings& findings) = 0;

    // -------------------------------------------------------------------------------------- what happens to the Context

    /**
     * Let the Forces that act between steps do so (ContextImpl::updateContextState(): thermostats, barostats), which may ask for
     * the size of the last step on the host.
     *
     * @return whether one of them says that the forces are no longer valid
     */
    virtual bool updateState() = 0;
    /** What there is to find of a change that nobody has announced, from the least to the greatest. */
    enum class Change {
        None,
        Velocities, /**< the velocities of the Context are others */
        State,      /**< so are the positions */
        Box         /**< so are the periodic box vectors */
    };
    /**
     * Look whether the Context's positions, velocities and box are still those of the last step, or those last told by start(),
     * changeState() and changeVelocities(). Changes come from Forces and from other integrators (of a CompoundIntegrator); what
     * users change is announced to the run, so a device looks only where there may be something to find.
     */
    virtual Change findChange() = 0;
    /**
     * A number made from the Context's positions, velocities and box, by which a saved run knows again the state that it belongs
     * to; without what is no part of a State that somebody may load. It does not change by reading it.
     */
    virtual unsigned long long getFingerprint() = 0;
    /** The same of the Context's parameters, with which forces change. */
    virtual unsigned long long getParameterFingerprint() = 0;

    /**
     * Start afresh from the Context's state: positions and velocities are moved onto the constraints, the forces computed there,
     * and Lambda and U found. There is no density yet: the next step is the first of a sequence. References stay. Virtual sites are
     * computed, for users may have put them anywhere.
     *
     * @throws StepFailure    if that is not possible, or if requireSoundStart() (StartCheck.h) finds something
     */
    virtual void start() = 0;
    /**
     * Go on from a state that a Force has changed (a barostat, say): as start(), but the density goes on, scaled with u. Values of the
     * parameters of expressions that are set are put in force at once only where another integrator has taken steps.
     */
    virtual void changeState() = 0;
    /** Go on with changed velocities at the same positions, without computing forces; the density goes on, scaled with u. */
    virtual void changeVelocities() = 0;
    /**
     * Go on with the forces computed anew, since parameters of Forces have changed, at the method's positions and velocities; the
     * density goes on, scaled with u.
     */
    virtual void changeForces() = 0;

    /** Give the Context the velocities of the method's state, at whose positions they satisfy the constraints. */
    virtual void writeVelocities() = 0;

    // ----------------------------------------------------------------------------------------------------- the steps

    /**
     * Take one step: (3.9)-(3.11) and (3.14), virtual sites, time and step count of its end, the forces there, (3.12)-(3.13).
     * A first step that has to be taken twice is (see VRattleDynamics::finish()). May only ask for it, see above.
     *
     * @param maxTime    the step must not go beyond this time (ps); one that is cut short for it ends there exactly
     * @throws StepFailure    if it cannot be completed and that is known already
     */
    virtual void step(double maxTime) = 0;
    /**
     * Wait for the steps that were asked for.
     *
     * @throws StepFailure    if one of them could not be completed; then those after it have not happened
     */
    virtual void settle() {
    }
    /** Turn time around without computing forces: VRattleDynamics::reverse(), and the Context's velocities change sign. */
    virtual void reverse() = 0;

    struct LastStep {
        double size;    // ps; 0 before the first step of this device
        double density; // rho, of reverse() too; 1 before the first step
    };
    /** Of the last step that was completed; while others are asked for, of the last of these. */
    virtual LastStep getLastStep() = 0;
    /** The time of the Context (ps). */
    virtual double getTime() = 0;
    virtual long long getStepCount() = 0;

    /**
     * Try out steps of a fixed size, which have no density, from the method's state, and put everything back but the counts of
     * work. Forces see the time of the trial, and the step count that there is.
     *
     * @param stepSize    the size of all steps (ps)
     * @param count       how many
     * @param look        is given getMonitorValues() at the end of each
     * @throws StepFailure    if one of them cannot be completed
     */
    virtual void tryOut(double stepSize, int count, const std::function<void(const std::vector<double>&)>& look) = 0;

    // -------------------------------------------------------------------------------------- numbers at the method's state

    /** U_k(q[n],p[n]) of each monitor; with automatic step control U_A[n] and U_B[n-1/2], the latter 0 before a step. */
    virtual std::vector<double> getMonitorValues() = 0;
    /** Lambda(q[n],p[n]), for the System's constraints and behind them for the expressions, in the users' units. */
    virtual std::vector<double> getMultipliers() = 0;
    /** That of one of the expressions alone. */
    virtual double getExpressionMultiplier(int index) = 0;
    /** The kinetic energy of the Context's velocities (kJ/mol). */
    virtual double computeKineticEnergy() = 0;
    /** Whether the next step goes on with the forces that somebody else has computed, who is to compute them with each energy. */
    virtual bool usesForcesOfOthers() {
        return false;
    }
    /** A value of the monitors of automatic step control that is no more than this is nothing but rounding. */
    virtual double getNegligibleValue() = 0;
    /** At constant temperature: the kinetic energy that is reported, which is not that of the velocities; the two states agree. */
    virtual double computeHalfStepKineticEnergy() = 0;
    /** How often forces have been computed, and iterations of the solver taken, since the device exists. */
    virtual long long getNumForceEvaluations() = 0;
    virtual long long getNumSolverIterations() = 0;
    /** What has been counted of steps since then. */
    virtual StepCounts getCounts() = 0;
    /** Whether the last step() was for a GPU to take, and not for the host with forces from it. */
    virtual bool hasSteppedOnDevice() {
        return false;
    }

    // ------------------------------------------------------------------------------------------- saving and resuming

    /**
     * Write down what the method goes on with beside settings and the state of the Context: all of RunState behind startsAfresh.
     * This is where vectors leave the device.
     */
    virtual void save(RunState& run) = 0;
    /**
     * Whether this device can go on from a saved run; not if it was saved by one that keeps other numbers.
     *
     * @param saved    the settings that were saved with it
     * @throws OpenMMException    if the parts of the saved run do not fit together
     */
    virtual bool canResume(const RunState& run, const IntegratorSettings& saved) = 0;
    /**
     * Go on from a saved run, whose settings and references are in force and whose fingerprint is the Context's. The forces are
     * computed, to compare them with the saved ones, for a Force may have been changed since; if they are the same but for
     * rounding they take their place.
     *
     * @param areForcesOthers    the forces are known to be others and changeForces() will follow: go on without computing any
     * @return whether it goes on; if not, nothing has been taken over
     */
    virtual bool resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) = 0;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_RUNDEVICE_H_
