// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLEDYNAMICS_H_
#define OPENMMVRATTLE_VRATTLEDYNAMICS_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/AutomaticSteps.h"
#include "step/MonitorControl.h"
#include "step/StepSolver.h"
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
 * M^-1 p[n], w for M^-1 p[n-1/2]. What others see of the state and do to it between two steps: VRattleRun (method/run).
 */
class VRattleDynamics {
public:
    typedef StepSettings Settings;

    VRattleDynamics(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints,
                    const std::vector<ExpressionConstraint>& expressions = {});
    /**
     * Take over settings and references. In the course of a run the density goes on where the change allows it: it is scaled with u, and
     * the half-step momentum is formed anew.
     */
    void setSettings(const Settings& newSettings, const std::vector<double>& references,
                     StepControl::SettingsChange change);
    /**
     * Start afresh at a state. The velocities are projected onto the constraints, whose parameters, those in force, are at rest
     * and stay so until others are set.
     *
     * @throws StepFailure    if the multipliers or monitors are not defined there; then there is no state
     */
    void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /**
     * The first half of a step. It leads to the parameters of expressions that have been set: g(q[n+1]; theta[n+1]) = 0 (3.11), and at
     * its end G v + (dg/dtheta) (theta[n+1] - theta[n])/dt = 0 (3.13).
     *
     * @param maxStep    the step must not be longer than this (ps); a shortened step goes on with the same density
     * @return the size of the step (ps)
     * @throws StepFailure    if the equations of the step have no solution that the iteration finds
     */
    double step(double maxStep);
    /** q[n+1], after that. */
    const std::vector<OpenMM::Vec3>& getNextPositions() const {
        return solver.next.q;
    }
    /**
     * The second half of a step.
     *
     * @param[in,out] forces    the applied forces at getNextPositions(); their storage is taken over, and other left in its place
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
    void abandonStep() {
        control->abandon();
    }
    /** Turn time around, without a force. */
    void reverse();
    /** Whether the next step continues a sequence of densities; if not, it is the first one. */
    bool hasStarted() const {
        return control->hasStarted();
    }

protected:
    void takeOver(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                  const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    StepControl& controlOf(const Settings& which);
    void formHalfStepVelocities();

    ConstraintSolver constraints;
    StepState now; // between two steps
    StepSolver solver;
    MonitorControl monitors;
    AutomaticSteps automatic;
    StepControl* control; // the one in force
    Settings settings;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLEDYNAMICS_H_
