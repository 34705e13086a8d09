// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLERUN_H_
#define OPENMMVRATTLE_VRATTLERUN_H_

#include "openmm/Vec3.h"
#include "step/VRattleDynamics.h"
#include <functional>
#include <vector>

namespace OpenMMVRattle {

/** VRATTLE in a run, in which others change the state between two steps, keep it, put it back and carry it on elsewhere. */
class VRattleRun : public VRattleDynamics {
public:
    using VRattleDynamics::VRattleDynamics;

    /** All that the next step depends on. */
    struct Kept {
        Settings settings;
        StepState state;
        std::vector<double> target; // of the parameters of expressions
        StepMemory memory;
    };
    Kept keep() const {
        return {settings, now, solver.motion.target, control->getMemory()};
    }
    /** Put back what was kept, to the last bit. */
    void putBack(const Kept& kept);
    /** A function that puts back everything that it is now, to the last bit. */
    std::function<void()> remember() {
        return [this, kept = keep()] { putBack(kept); };
    }
    StepMemory getMemory() const {
        return control->getMemory();
    }
    /** As its base does, but a failure leaves everything as it was. So does that of all that follows here. */
    void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /**
     * Go on from a saved state as if nothing had happened: the following steps are the same to the last bit if the forces are. The
     * settings and the target are those there are, and K Lambda is found.
     */
    void resume(const StepState& state, const StepMemory& memory);
    /**
     * Go on from an on-step state that somebody else's steps have led to, in the middle of a sequence of densities with the same
     * settings and references. The velocities are taken as they are; the half-step momentum is formed from them. Parameters that are
     * set stay what the next step leads to.
     *
     * @param theta    theta[n], with the rates of the last step
     */
    void adopt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const ExpressionParameters& theta,
               const StepMemory& memory);
    /** Take over what somebody else has carried on; the state is another. */
    void adopt(const StepMemory& memory) {
        control->adopt(memory);
    }
    /** Put parameters that are set in force at once, before positions are projected and the run starts afresh with begin(). */
    void adoptParameters();
    /** Whether the next step and the last one are steps at the same parameters. */
    bool areParametersAtRest() const {
        return solver.motion.isAtRest(now.theta);
    }
    /** Take over reference values U_k,ref that are in force, as from a saved run; 0 for those that are not known. */
    void setReferences(const std::vector<double>& references) {
        control->setReferences(references);
    }
    /** The 2K/f at which those of automatic step control were found. */
    void setReferenceTemperature(double kT) {
        automatic.setReferenceTemperature(kT);
    }
    /** u(q[n],p[n-1/2]), which (3.14) takes, for somebody who goes on elsewhere; it is evaluated if need be. */
    double findHalfStepValue() {
        return monitors.findHalfStepValue();
    }
    /** The state and the references of automatic step control. */
    const AutomaticControl& getAutomaticControl() const {
        return automatic.getControl();
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
     * @throws StepFailure    if they are not finite
     */
    void changeForces(const std::vector<OpenMM::Vec3>& forces, double groupEnergy);

private:
    template <class Change> void attempt(const Change& change);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLERUN_H_
