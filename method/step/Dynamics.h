// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_DYNAMICS_H_
#define OPENMMVRATTLE_DYNAMICS_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <functional>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * A method of integration for a system of particles with constraints, whose forces somebody else computes. It knows no Context, no
 * Kernel and no Platform.
 *
 * A step is one or more passes of two halves, around an evaluation of the forces each:
 *
 *     do {
 *         dynamics.step(maxStep);                              // new positions, getNextPositions()
 *         ... compute the forces there ...
 *     } while (!dynamics.finish(forces, groupEnergy));         // the step is complete: new positions, velocities, forces
 *
 * Until finish() has returned true, the state before the step is untouched.
 */
class Dynamics {
public:
    virtual ~Dynamics() = default;

    typedef ConstraintSolver::Parallel Parallel;
    /**
     * Let threads share the clusters, and the pieces of large ones, where that is faster. Results do not depend on the number of
     * threads, to the last bit.
     */
    virtual void setParallel(const Parallel& parallel, int numThreads) = 0;
    /** Go through 0, ..., count - 1 on these threads, where that is faster: task(first, end). */
    virtual void share(int count, const std::function<void(int, int)>& task) = 0;

    /**
     * Move positions to the nearest configuration (in the mass metric, to first order) that satisfies the constraints;
     * those that do so to the tolerance are left as they are. The parameters of expressions are those in force, theta[n].
     *
     * @return whether the positions were changed
     * @throws StepFailure    if there is no such configuration nearby
     */
    virtual bool projectPositions(std::vector<OpenMM::Vec3>& positions) = 0;
    /**
     * Start afresh at a state. The velocities are projected onto the constraints, whose parameters, those in force, are at rest
     * and stay so until others are set.
     *
     * @throws StepFailure    if the multipliers or monitors are not defined there; then everything is as it was
     */
    virtual void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                       const std::vector<OpenMM::Vec3>& forces, double groupEnergy) = 0;
    /** A function that puts back everything that it is now, to the last bit. */
    virtual std::function<void()> remember() = 0;
    /**
     * Change the parameters of an expression: the next step leads to positions that satisfy the constraint with these, and to
     * velocities that belong to the motion.
     */
    virtual void setParameters(int expression, const std::map<std::string, double>& parameters) = 0;
    /** theta[n], those in force, and the rates of the step that has led to them. */
    virtual const ExpressionParameters& getParameters() const = 0;
    /** Put those that are set in force at once, before positions are projected and the run starts afresh with begin(). */
    virtual void adoptParameters() = 0;
    /** Take over reference values U_k,ref that are in force, as from a saved run; 0 for those that are not known. */
    virtual void setReferences(const std::vector<double>& references) = 0;
    /** U_k,ref, 0 while it is not known. */
    virtual std::vector<double> getReferences() const = 0;
    /** Go on from a changed state. */
    virtual void changeState(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                             const std::vector<OpenMM::Vec3>& forces, double groupEnergy) = 0;
    /**
     * Go on with velocities that are the present ones seen from a uniformly moving frame, as a remover of the motion of the
     * centre of mass leaves them in each step. Constraints between moving particles and their multipliers know nothing of it, so
     * that it costs no more than to look.
     *
     * @return whether that is what they are; if not, nothing has been changed
     */
    virtual bool changeFrame(const std::vector<OpenMM::Vec3>& velocities) = 0;
    /** Go on with changed velocities at the same positions; as changeState(). */
    virtual void changeVelocities(const std::vector<OpenMM::Vec3>& velocities) = 0;
    /**
     * Go on with other forces at the same positions and velocities, since a parameter of a force has changed; as changeState().
     *
     * @param[in,out] forces    the applied forces; their storage is taken over, and that of the forces before left in its place
     * @throws StepFailure    if they are not finite; then nothing has been changed
     */
    virtual void changeForces(std::vector<OpenMM::Vec3>& forces, double groupEnergy) = 0;

    /**
     * The first half of a pass.
     *
     * @param maxStep    the step must not be longer than this (ps)
     * @return the time (ps) from the beginning of the step to getNextPositions()
     * @throws StepFailure    if the equations of the step have no solution that the iteration finds
     */
    virtual double step(double maxStep) = 0;
    /**
     * The second half of a pass.
     *
     * @param[in,out] forces    the applied forces at getNextPositions(); if the step is complete their storage is taken
     *                          over, and other storage is left in its place
     * @param groupEnergy       the energy of the monitor's force group there
     * @return whether the step is complete. If not, both halves are to be done again.
     * @throws StepFailure    if the forces are not finite or the constraints have become dependent
     */
    virtual bool finish(std::vector<OpenMM::Vec3>& forces, double groupEnergy) = 0;
    /** The step in progress has failed, in either half or in between: nothing that was computed for it is of any use to the next. */
    virtual void abandonStep() = 0;
    /** Turn time around, without a force. */
    virtual void reverse() = 0;

    virtual const ConstraintSystem& getConstraintSystem() const = 0;
    /** q[n]. */
    virtual const std::vector<OpenMM::Vec3>& getPositions() const = 0;
    /** After step(). */
    virtual const std::vector<OpenMM::Vec3>& getNextPositions() const = 0;
    /** M^-1 p[n]. */
    virtual const std::vector<OpenMM::Vec3>& getVelocities() const = 0;
    /** F(q[n]). */
    virtual const std::vector<OpenMM::Vec3>& getForces() const = 0;
    /** The energy of the monitor's force group at q[n]. */
    virtual double getGroupEnergy() const = 0;
    /** rho of the last step. */
    virtual double getDensity() const = 0;
    /** U_k(q[n],p[n]). */
    virtual const std::vector<double>& getMonitorValues() const = 0;
    /** Lambda(q[n],p[n]) for the constraints as ConstraintSystem writes them, in internal order. */
    virtual const std::vector<double>& getMultipliers() const = 0;
    virtual long long getNumIterations() const = 0;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_DYNAMICS_H_
