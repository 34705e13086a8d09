// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLEKERNELS_H_
#define OPENMMVRATTLE_VRATTLEKERNELS_H_

#include "openmm/KernelImpl.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmmvrattle/VRattleRunState.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * The kernel that a platform provides for VariableStepRattleIntegrator. The integrator holds the settings, the kernel holds
 * the state: half-step momentum, step density, forces, reference values and counts.
 */
class IntegrateVRattleStepKernel : public OpenMM::KernelImpl {
public:
    static std::string Name() {
        return "IntegrateVRattleStep";
    }
    IntegrateVRattleStepKernel(const std::string& name, const OpenMM::Platform& platform) :
            OpenMM::KernelImpl(name, platform) {
    }
    /** Prepare everything that depends on the System alone. */
    virtual void initialize(const OpenMM::System& system, const VariableStepRattleIntegrator& integrator) = 0;
    /** Take note that the settings of the integrator have changed, to be read again before the next step. */
    virtual void settingsChanged() = 0;
    /** Take note that the user has changed the state of the Context: the next step starts afresh. */
    virtual void stateChanged() = 0;
    /**
     * Take one step, and compute the forces at its end.
     *
     * @param context          the context in which to take the step
     * @param integrator       the integrator with the settings
     * @param forcesInvalid    whether the forces have changed since the last step
     * @param maxTime          the time beyond which the step must not go, in ps
     * @return the size of the step in ps
     */
    virtual double execute(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                           bool forcesInvalid, double maxTime) = 0;
    /** Turn time around; see VariableStepRattleIntegrator::reverse(). */
    virtual void reverse(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator) = 0;
    /** Compute the mean of every monitor over a trial run, which leaves the state as it was. */
    virtual std::vector<double> calibrate(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                                          int steps) = 0;
    /** The fingerprint of the masses and constraints that initialize() was given. */
    virtual unsigned long long getSystemFingerprint() const = 0;
    /** Write down what the run needs to go on; the size of the last step is the integrator's to add. */
    virtual VRattleRunState saveRun(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator) = 0;
    /**
     * Go on from a saved run, whose settings the integrator has already, with the positions and velocities that the
     * Context has now. Where these are not those of the saved run, or the masses and constraints are others, or the
     * forces turn out to be others at the next step, the run starts afresh with the saved reference values.
     */
    virtual void resumeRun(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                           const VRattleRunState& run) = 0;
    virtual double computeKineticEnergy(OpenMM::ContextImpl& context) = 0;
    /** The step density of the last step. */
    virtual double getStepDensity() const = 0;
    /** The reference value in force of a monitor, 0 if there is none yet. */
    virtual double getReferenceMonitorValue(OpenMM::ContextImpl& context,
                                            const VariableStepRattleIntegrator& integrator, int index) = 0;
    /** The value of a monitor at the current state. */
    virtual double getMonitorValue(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                                   int index) = 0;
    /** The multipliers at the current state, in the System's order, and those of expressions behind them. */
    virtual std::vector<double> getMultipliers(OpenMM::ContextImpl& context,
                                               const VariableStepRattleIntegrator& integrator) = 0;
    virtual long long getNumForceEvaluations() const = 0;
    virtual long long getNumSolverIterations() const = 0;
    virtual long long getNumRescues() const = 0;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLEKERNELS_H_
