// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLEDYNAMICS_H_
#define OPENMMVRATTLE_VRATTLEDYNAMICS_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/AutomaticSteps.h"
#include "step/MonitorControl.h"
#include "step/StepSolver.h"
#include "step/StepState.h"
#include <functional>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * The method VRATTLE, equations (3.9)-(3.14) of Barth, Leimkuhler and Reich, for a system of particles whose forces
 * somebody else computes. It knows no Context, no Kernel and no Platform.
 *
 * A step is made in two halves, around the one evaluation of the forces that it costs:
 *
 *     dynamics.step(maxStep);                  // (3.9)-(3.11), (3.14): new positions, getNextPositions()
 *     ... compute the forces there ...
 *     dynamics.finish(forces, groupEnergy);    // (3.12)-(3.13): new on-step velocities; the step is complete
 *
 * Until finish() has returned, the state before the step is untouched. Momenta are kept as velocities: v stands for
 * M^-1 p[n], w for M^-1 p[n-1/2].
 */
class VRattleDynamics {
public:
    typedef ConstraintSolver::Parallel Parallel;
    typedef StepSettings Settings;
    typedef StepMemory Memory;

    VRattleDynamics(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints,
                    const std::vector<ExpressionConstraint>& expressions = {});

    /** Let threads share the work where that is faster. Results do not depend on their number, to the last bit. */
    void setParallel(const Parallel& parallel, int numThreads) {
        constraints.setParallel(parallel, numThreads);
    }
    /** Go through 0, ..., count - 1 on these threads, where that is faster: task(first, end). */
    template <class Task> void share(int count, const Task& task) {
        constraints.share(count, task);
    }

    /**
     * Take over settings. In the course of a run the density goes on where they allow it: it is scaled with u, and the
     * half-step momentum is formed anew.
     */
    void setSettings(const Settings& settings);

    /**
     * Move positions to the nearest configuration (in the mass metric, to first order) that satisfies the constraints;
     * those that do so to the tolerance are left as they are. The parameters of expressions are those in force, theta[n].
     *
     * @return whether the positions were changed
     * @throws StepFailure    if there is no such configuration nearby
     */
    bool projectPositions(std::vector<OpenMM::Vec3>& positions);
    /**
     * Start afresh at a state. The velocities are projected onto the constraints, whose parameters, those in force, are at rest
     * and stay so until others are set.
     *
     * @throws StepFailure    if the multipliers or monitors are not defined there; then everything is as it was
     */
    void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /** All that a trial run or a start changes, to be put back. */
    struct Kept {
        Settings settings;
        StepState state;
        std::vector<double> target;
        Memory memory;
    };
    Kept keep() const;
    /** Put back what was kept, to the last bit. */
    void putBack(const Kept& kept);
    /** A function that puts back everything that it is now, to the last bit. */
    std::function<void()> remember() {
        return [this, kept = keep()] { putBack(kept); };
    }
    Memory getMemory() const;
    /**
     * Change the parameters of an expression: the next step leads to positions that satisfy the constraint with these, in that
     * its position equation is g(q[n+1]; theta[n+1]) = 0 (3.11), and the velocities at its end
     * G v + (dg/dtheta) (theta[n+1] - theta[n])/dt = 0 (3.13).
     */
    void setParameters(int expression, const std::map<std::string, double>& parameters) {
        getConstraintSystem().writeParameters(expression, parameters, target);
    }
    /** theta[n], those in force, and the rates of the step that has led to them. */
    const ExpressionParameters& getParameters() const {
        return now.theta;
    }
    /** Put those that are set in force at once, before positions are projected and the run starts afresh with begin(). */
    /** Whether the next step and the last one are steps at the same parameters. */
    bool areParametersAtRest() const {
        return target == now.theta.values && !now.theta.isMoving;
    }
    void adoptParameters();
    /**
     * Go on from a saved state as if nothing had happened. The positions and velocities are taken as they are, so that the
     * following steps are the same to the last bit if the forces are.
     */
    void resume(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const Memory& memory);
    /**
     * Go on from an on-step state that somebody else's steps have led to, in the middle of a sequence of densities with the same
     * settings and references. The velocities are taken as they are; the half-step momentum is formed from them.
     *
     * @param density          rho[n-1/2]
     * @param halfStepValue    u(q[n],p[n-1/2]), or null if it is not known
     * @param offset           what (3.14) and (3.15) differed by in the last step
     * @throws StepFailure     if the multipliers or monitors are not defined there; then everything is as it was
     */
    void adopt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy, double density, const double* halfStepValue,
               double offset);
    /** Take over the numbers and references of automatic step control that somebody else has carried on; the state is another. */
    void adopt(double density, const AutomaticRecursions::AutomaticNumbers& numbers,
               const std::vector<double>& references) {
        automatic.adopt(density, numbers, references);
    }
    /** All of that. */
    void adopt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy, double density,
               const AutomaticRecursions::AutomaticNumbers& numbers, const std::vector<double>& references);
    /** u(q[n],p[n-1/2]), which (3.14) takes, for somebody who goes on elsewhere; it is evaluated if need be. */
    double findHalfStepValue() {
        return monitors.findHalfStepValue();
    }
    /** Take over reference values U_k,ref that are in force, as from a saved run; 0 for those that are not known. */
    void setReferences(const std::vector<double>& references) {
        control->setReferences(references);
    }
    /** The 2K/f at which those of automatic step control were found. */
    void setReferenceTemperature(double kT) {
        automatic.setReferenceTemperature(kT);
    }
    /** Go on from a changed state, with the density scaled with u, so that it stays free of oscillation. */
    void changeState(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                     const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /**
     * Go on with velocities that are the present ones seen from a uniformly moving frame, as a remover of the motion of the
     * centre of mass leaves them in each step. Constraints between moving particles and their multipliers know nothing of it, so
     * that it costs no more than to look.
     *
     * @param before    what the velocities were: getVelocities(), or those of somebody whose state has been projected onto these
     * @return whether that is what they are; if not, nothing has been changed
     */
    bool changeFrame(const std::vector<OpenMM::Vec3>& before, const std::vector<OpenMM::Vec3>& velocities);
    /** Go on with changed velocities at the same positions; as changeState(). */
    void changeVelocities(const std::vector<OpenMM::Vec3>& velocities);
    /**
     * Go on with other forces at the same positions and velocities, since a parameter of a force has changed; as changeState().
     *
     * @throws StepFailure    if they are not finite; then nothing has been changed
     */
    void changeForces(const std::vector<OpenMM::Vec3>& forces, double groupEnergy);

    /**
     * The first half of a step.
     *
     * @param maxStep    the step must not be longer than this (ps); a shortened step goes on with the same density
     * @return the size of the step (ps)
     * @throws StepFailure    if the equations of the step have no solution that the iteration finds
     */
    double step(double maxStep);
    /**
     * The second half of a step.
     *
     * @param[in,out] forces    the applied forces at getNextPositions(); if the step is complete their storage is taken
     *                          over, and that of the forces before is left in its place
     * @param groupEnergy       the energy of the monitor's force group there
     * @return whether the step is complete. If not, the state is as before step(), the density of the first step is now known
     *         better, and both halves are to be done again. This happens once, at a start with given reference values.
     * @throws StepFailure    if the forces are not finite or the constraints have become dependent
     */
    bool finish(std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /**
     * The step in progress has failed, in either half or in between: nothing that was computed for it, as the density and the
     * reference values of a first step, is of any use to the next.
     */
    void abandonStep();
    /** Whether the next step continues a sequence of densities; if not, it is the first one. */
    bool hasStarted() const {
        return control->hasStarted();
    }
    /** The state and the references of automatic step control. */
    const AutomaticControl& getAutomaticControl() const {
        return automatic.getControl();
    }
    /** Turn time around, without a force. */
    void reverse();

    const ConstraintSystem& getConstraintSystem() const {
        return constraints.getSystem();
    }
    const std::vector<OpenMM::Vec3>& getPositions() const {
        return now.q;
    }
    /** q[n+1], after step(). */
    const std::vector<OpenMM::Vec3>& getNextPositions() const {
        return solver.next.q;
    }
    const std::vector<OpenMM::Vec3>& getVelocities() const {
        return now.v;
    }
    const std::vector<OpenMM::Vec3>& getForces() const {
        return now.force;
    }
    double getGroupEnergy() const {
        return now.groupEnergy;
    }
    /** rho[n-1/2]. */
    double getDensity() const {
        return control->getDensity();
    }
    const std::vector<double>& getMonitorValues() const {
        return control->getValues();
    }
    /** U_k,ref, 0 while it is not known; under automatic step control those of its two monitors. */
    std::vector<double> getReferences() const {
        return control->getReferences();
    }
    const std::vector<double>& getMultipliers() const {
        return now.lambda;
    }
    long long getNumIterations() const {
        return solver.getNumIterations();
    }
    long long getNumRescues() const {
        return control->getNumRescues();
    }

private:
    void takeOver(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                  const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    template <class Change> void attempt(const Change& change);
    void setMemory(const Memory& memory);
    double squareOf(const std::vector<OpenMM::Vec3>& x, const std::vector<double>& weights);
    StepControl& controlOf(const Settings& settings);
    void formHalfStepVelocities();
    void prepareStep();
    void findJump();

    StepState now; // between two steps
    std::vector<double> target; // theta[n+1], what the next step leads to
    ConstraintSolver constraints;
    StepSolver solver;
    MonitorControl monitors;
    AutomaticSteps automatic;
    StepControl* control; // the one in force
    Settings settings;

    // The step in progress.
    StepControl::StepKind stepKind;
    double stepSize;
    ConstraintSolver::HalfStep atHalfStep;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLEDYNAMICS_H_
