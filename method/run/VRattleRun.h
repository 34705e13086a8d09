// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLERUN_H_
#define OPENMMVRATTLE_VRATTLERUN_H_

#include "openmm/Vec3.h"
#include "run/RunState.h"
#include "step/VRattleDynamics.h"
#include <functional>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

struct IntegratorSettings;

/**
 * VRATTLE in a run, in which others change the state between two steps, keep it, put it back, save it and carry it on elsewhere: the
 * method of VariableStepRattleIntegrator. The other one is LangevinRun.
 */
class VRattleRun : public VRattleDynamics {
public:
    using VRattleDynamics::VRattleDynamics;

    typedef ConstraintSolver::Parallel Parallel;

    /** Let threads share the work where that is faster. Results do not depend on their number, to the last bit. */
    void setParallel(const Parallel& parallel, int numThreads) {
        constraints.setParallel(parallel, numThreads);
    }
    /** Go through 0, ..., count - 1 on these threads, where that is faster: task(first, end). */
    template <class Task> void share(int count, const Task& task) {
        constraints.share(count, task);
    }

    const Settings& getSettings() const {
        return settings;
    }
    /** Take over settings. A reference of 0 stands for the one in force, if that has been found for the same monitors. */
    void setSettings(const Settings& newSettings);

    // ------------------------------------------------------------------------------------- what others see of the state

    const ConstraintSystem& getConstraintSystem() const {
        return constraints.getSystem();
    }
    const std::vector<OpenMM::Vec3>& getPositions() const {
        return now.q;
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
    /** theta[n], those in force, and the rates of the step that has led to them. */
    const ExpressionParameters& getParameters() const {
        return now.theta;
    }
    const std::vector<double>& getMultipliers() const {
        return now.lambda;
    }
    /** rho[n-1/2]. */
    double getDensity() const {
        return control->getDensity();
    }
    std::vector<double> getMonitorValues() const {
        return control->getValues();
    }
    double getNegligibleValue() {
        return automatic.getControl().getNegligibleValue();
    }
    /** U_k,ref, 0 while it is not known; under automatic step control those of its two monitors. */
    std::vector<double> getReferences() const {
        return control->getReferences();
    }
    Findings getFindings() {
        return {getReferences(), getAutomaticControl().getMemory().temperature, {}};
    }
    void setFindings(const Findings& findings) {
        setReferences(findings.references);
        automatic.getControl().setReferenceTemperature(findings.referenceTemperature);
    }
    long long getNumIterations() const {
        return constraints.getNumIterations();
    }
    long long getNumRescues() const {
        return monitors.getNumRescues();
    }
    StepCounts getCounts();

    // --------------------------------------------------------------------------------------------------------- memory

    /** What the next step depends on beside settings and state. */
    struct Memory : StepMemory {
        std::vector<double> references;
        AutomaticControl::Memory automatic = {}; // of automatic step control
    };
    /** All that the next step depends on. */
    struct Kept {
        Settings settings;
        StepState state;
        std::vector<double> target; // of the parameters of expressions
        Memory memory;
    };
    Kept keep() {
        return {settings, now, solver.motion.target, getMemory()};
    }
    /** Put back what was kept, to the last bit. */
    void putBack(const Kept& kept);
    /** A function that puts back everything that it is now, to the last bit. */
    std::function<void()> remember() {
        return [this, kept = keep()] { putBack(kept); };
    }
    Memory getMemory() {
        return {control->getMemory(), control->getReferences(), automatic.getControl().getMemory()};
    }

    // ---------------------------------------------------------------------------------------------- starts and changes

    /**
     * Move positions to the nearest configuration (in the mass metric, to first order) that satisfies the constraints;
     * those that do so to the tolerance are left as they are.
     *
     * @return whether the positions were changed
     * @throws StepFailure    if there is no such configuration nearby
     */
    bool projectPositions(std::vector<OpenMM::Vec3>& positions, const ExpressionParameters& theta) {
        return constraints.projectPositions(positions, theta);
    }
    /** Change the parameters of an expression: those that the next step leads to. */
    void setParameters(int expression, const std::map<std::string, double>& parameters) {
        getConstraintSystem().writeParameters(expression, parameters, solver.motion.target);
    }
    /** As its base does, but a failure leaves everything as it was. So does that of all that follows here. */
    void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /** Go on with steps of a fixed size (ps), for a trial: who ends it puts back what was before. */
    void beginFixedSteps(double stepSize);
    /**
     * Go on from a saved state as if nothing had happened: the following steps are the same to the last bit if the forces are. The
     * settings and the target are those there are, and K Lambda is found.
     */
    void resume(const StepState& state, const Memory& memory);
    /**
     * Go on from an on-step state that somebody else's steps have led to, in the middle of a sequence of densities with the same
     * settings and references. The velocities are taken as they are; the half-step momentum is formed from them. Parameters that are
     * set stay what the next step leads to.
     *
     * @param theta    theta[n], with the rates of the last step
     */
    void adopt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const ExpressionParameters& theta,
               const Memory& memory);
    /** Take over what somebody else has carried on; the state is another. */
    void adopt(const Memory& memory);
    /** Put parameters that are set in force at once, and at rest: before a start, or where others have taken the last steps. */
    void adoptParameters();
    /** Take over reference values U_k,ref that are in force, as from a saved run; 0 for those that are not known. */
    void setReferences(const std::vector<double>& references) {
        control->setReferences(references);
    }
    /** u(q[n],p[n-1/2]), which (3.14) takes, for somebody who goes on elsewhere; it is evaluated if need be. */
    double findHalfStepValue() {
        return monitors.findHalfStepValue();
    }
    /** The state and the references of automatic step control. */
    const AutomaticControl& getAutomaticControl() {
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
     * @param[in,out] forces    their storage is taken over, and other left in its place
     * @throws StepFailure      if they are not finite
     */
    void changeForces(std::vector<OpenMM::Vec3>& forces, double groupEnergy);

    // -------------------------------------------------------------------------------------------- saving and resuming

    /** Write down what the next step depends on, but for what HostRunDevice has written: positions, velocities and forces. */
    void save(RunState& run);
    /** Whether it can go on from a saved run; throws an OpenMMException if the parts of that do not fit together. */
    bool canResume(const RunState& run, const IntegratorSettings& saved);
    /** Go on from a saved run, with the on-step state that belongs to it. */
    void resume(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const RunState& run,
                const IntegratorSettings& saved);

private:
    void exchange(StepState& state, Memory& memory, RunState::Archive archive, size_t numMonitors, bool isAutomatic);
    void read(const RunState& run, const IntegratorSettings& saved, StepState& state, Memory& memory);
    void setMemory(const Memory& memory);
    void takeState(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                   const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const ExpressionParameters& theta);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLERUN_H_
