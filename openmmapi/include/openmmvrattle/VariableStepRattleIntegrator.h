// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VARIABLESTEPRATTLEINTEGRATOR_H_
#define OPENMMVRATTLE_VARIABLESTEPRATTLEINTEGRATOR_H_

#include "openmmvrattle/ConstrainedIntegrator.h"
#include <string>

namespace OpenMMVRattle {

/**
 * An integrator for molecular dynamics with constraints whose step size varies and which is nevertheless
 * time-reversible, so that the energy error stays bounded over long runs. It is the method VRATTLE of E. Barth,
 * B. Leimkuhler and S. Reich, "A time-reversible variable-stepsize integrator for constrained dynamics"
 * (SIAM J. Sci. Comput. 21, 1999); equation numbers below are that paper's.
 *
 * A monitor U(q,p) measures how hard the motion is to follow at the moment. The step density rho follows it by a
 * symmetric recursion, by default (3.14),
 *
 *     rho[n+1/2] + rho[n-1/2] = u(q[n],p[n+1/2]) + u(q[n],p[n-1/2]),      u = B(U/U_ref),
 *
 * and the size of the step is stepSize/rho. stepSize is thus the step that is taken where U has its reference value
 * U_ref (see setReferenceMonitorValue()), and B keeps the step between two bounds (see setMaximumStepSize()). The
 * default monitor is the Euclidean norm of the Lagrange multipliers of the constraints, the paper's U2 (4.4), and in a System
 * without constraints ConstraintAndAppliedForce.
 *
 * For most uses let the integrator choose its steps without a monitor of yours: useAutomaticStepControl().
 *
 * Each step costs one evaluation of the forces, the one at its end. On top of these come: one at the start of a run, and after each
 * change of the state by the user or by a Force that moves particles (a barostat), or of the parameters of a Force; one more where
 * the first step is taken with a given reference value, since that step is then taken twice; one after loading a checkpoint or a
 * State, to compare the forces with the saved ones; and the trial steps of calibrate(). A monitor ForceGroupEnergy costs the energy of
 * its group on top of each. getNumForceEvaluations() counts all.
 *
 * The constraints are solved with a direct factorisation of the constraint matrix, so also bonds that are strongly coupled are met to
 * the tolerance or the step fails with an exception; and the multipliers, that is the constraint forces, can be read with
 * getMultipliers().
 *
 * The velocities in the Context belong to the same time as the positions, and satisfy the velocity constraints: kinetic
 * plus potential energy of a State is the energy at that time. Forces that depend on the time or the step count see those of the end of
 * the step when they are computed there.
 *
 * A step that cannot be completed throws an OpenMMException and leaves the Context in the state before that step: a run that goes
 * on from there, with other settings perhaps, is the one that it would be if that step had never been tried.
 *
 * OpenMM's XmlSerializer stores all settings. Checkpoints, and States made with integrator parameters, store the
 * settings and everything else that the next step depends on, and loading one brings all of it back, the settings as
 * well: a run that goes on from a checkpoint is the same to the last bit on the Reference platform, and from a State to
 * rounding. At the first step after that the forces are computed once more. If they are not those of the saved run,
 * because a Force has been changed in the meantime, or if a State's positions, velocities, box vectors or parameters are not the
 * Context's, the run starts afresh with the saved reference values. States and checkpoints that were written under another integrator
 * load as well: positions, velocities, time and parameters are taken, the settings stay as they are, and the run starts afresh.
 *
 * Drude particles are refused, for they need an integrator that keeps them at their energy minimum or at a temperature
 * of their own, such as OpenMM's DrudeSCFIntegrator and DrudeNoseHooverIntegrator. Ring polymers (RPMD) are the matter
 * of OpenMM's RPMDIntegrator, which takes the place of this one.
 */
class VariableStepRattleIntegrator : public ConstrainedIntegrator {
public:
    /** The recursion that gives the next step density from the last one. All are symmetric in time. */
    enum UpdateMethod {
        /** (3.14): rho + rho' = u(q,p+) + u(q,p-), solved together with the constraints. The default. */
        SemiExplicit = 0,
        /** (3.15): rho + rho' = 2 u(q,p), known before the constraints are solved. */
        Explicit = 1,
        /**
         * f(rho) + f(rho') = 2 f(u(q,p)) with f(rho) = (rho-a) - (1-a)^2/(rho-a) and a = nominal/maximum step: every
         * step stays strictly below the maximum step size and no density is ever zero or negative.
         */
        Bounded = 2
    };
    /** The kinds of monitor. F is the applied force, v the velocity, m the mass, K = G M^-1 G^T. */
    enum MonitorKind {
        /** U2 (4.4): the Euclidean norm of the multipliers Lambda(q,p), in kJ/mol/nm^2. */
        ConstraintMultipliers = 0,
        /** The mass-weighted constraint force sqrt(Lambda^T K Lambda) of Gauss's principle, in nm amu^(1/2)/ps^2. */
        ConstraintForce = 1,
        /** The mass-weighted applied force sqrt(sum |F|^2/m), in nm amu^(1/2)/ps^2. */
        AppliedForce = 2,
        /** sqrt(Lambda^T K Lambda + sum |F|^2/m), in nm amu^(1/2)/ps^2. */
        ConstraintAndAppliedForce = 3,
        /** The p-norm of the multipliers, in kJ/mol/nm^2; see addMonitor(). */
        MultiplierPNorm = 4,
        /** The p-norm over the particles of |F|, in kJ/mol/nm; see addMonitor(). */
        ForcePNorm = 5,
        /** U1 (4.1): sqrt(sum m |v|^2 + sum |F|^2), in OpenMM's units. */
        VectorField = 6,
        /** The largest |F| of any particle, in kJ/mol/nm. */
        MaxForce = 7,
        /** The speed along the unconstrained trajectory in phase space, sqrt(sum |v|^2 + sum |F|^2). */
        ArcLength = 8,
        /** The largest sqrt(|v|^2 + |F|^2) of any particle. */
        MaxParticleArcLength = 9,
        /** The potential energy of one force group, in kJ/mol; see setMonitorForceGroup(). */
        ForceGroupEnergy = 10
    };
    /**
     * Create a VariableStepRattleIntegrator with one monitor: ConstraintMultipliers, or in a System without constraints
     * ConstraintAndAppliedForce.
     *
     * @param stepSize    the nominal step size, taken where the monitor has its reference value (in ps). With 0 no step can be taken,
     *                    which will do for a Context that computes energies
     */
    explicit VariableStepRattleIntegrator(double stepSize);
    /** Create one with the settings of another, and no Context. */
    VariableStepRattleIntegrator(const VariableStepRattleIntegrator& other);
    ~VariableStepRattleIntegrator() override;
    /** Get the nominal step size: the step taken where the monitor has its reference value (in ps). */
    double getNominalStepSize() const;
    /**
     * Set the nominal step size: the step taken where the monitor has its reference value. Where step bounds have been set it must lie
     * between them when the next step is taken; the three can be set in any order. In the course of a run the density is kept, so the
     * steps change in proportion, but for what the bounds say that have been set.
     *
     * @param size    the nominal step size, measured in ps; 0 where no step is to be taken
     */
    void setNominalStepSize(double size);
    /**
     * Get the size of the most recent step (in ps); before the first step, and when the nominal step size has been set since, the
     * nominal one.
     */
    double getStepSize() const override;
    /**
     * Get the step size that is usual for the masses of the System: 1 fs for a lightest particle of 1 amu, in proportion to the root of
     * its mass. In Python a warning says so once if the nominal step size is less than a thousandth of it, since it may have been meant
     * as an error tolerance, which is what VariableVerletIntegrator takes.
     *
     * @return the step size, measured in ps; 0 while there is no Context, or if no particle has a mass
     */
    double getUsualStepSize() const;
    /** The same as setNominalStepSize(), so that scripts written for a fixed step keep working. */
    void setStepSize(double size) override;
    /** Get the smallest step size the monitor can ask for (in ps), or 0 if there is no bound. */
    double getMinimumStepSize() const;
    /**
     * Set the smallest step size the monitor can ask for. With the sum updates SemiExplicit and Explicit, rho
     * oscillates slightly about u and steps may leave the bounds by as much; where the motion is not resolved they may
     * leave them by more. With automatic step control no step is ever smaller. Default: 1/50 of the nominal step size, and 1/1000
     * with automatic step control.
     *
     * @param size    the bound in ps; 0 means no bound. It must be smaller than the nominal step size when the next step is taken
     */
    void setMinimumStepSize(double size);
    /** Get the largest step size the monitor can ask for (in ps), or 0 if there is no bound. */
    double getMaximumStepSize() const;
    /**
     * Set the largest step size the monitor can ask for; see setMinimumStepSize(). With the update Bounded no step is ever
     * larger, with the others a step of more than twice the bound is rescued (see getNumRescues()). Default: twice the
     * nominal step size.
     *
     * @param size    the bound in ps; 0 means no bound. It must be larger than the nominal step size when the next step is taken
     */
    void setMaximumStepSize(double size);
    /** Get the recursion of the step density. */
    UpdateMethod getUpdateMethod() const;
    /** Set the recursion of the step density. */
    void setUpdateMethod(UpdateMethod method);
    /**
     * Add a monitor. Several monitors are combined, each relative to its own reference value, as
     * u = sqrt(sum_k (w_k (U_k/U_k,ref)^power_k)^2 / sum_k w_k^2).
     *
     * @param kind      what the monitor measures
     * @param weight    its weight w_k > 0 in the combination; of no effect on a single monitor
     * @param power     the positive power to which U_k/U_k,ref is raised
     * @param order     the order p, at least 1, of MultiplierPNorm and ForcePNorm; of no meaning to others. 0, the default, stands
     *                  for getNormOrder(), which is 8
     * @return the index of the monitor
     */
    int addMonitor(MonitorKind kind, double weight = 1.0, double power = 1.0, double order = 0.0);
    /**
     * Remove all monitors, and end automatic step control. With none the step is fixed at the nominal size: plain RATTLE
     * (3.1-3.5).
     */
    void clearMonitors();
    /** Get the number of monitors. */
    int getNumMonitors() const;
    /**
     * Get the settings of a monitor.
     *
     * @param index          the index of the monitor
     * @param[out] kind      what the monitor measures
     * @param[out] weight    its weight in the combination
     * @param[out] power     the power to which it is raised
     */
    void getMonitor(int index, MonitorKind& kind, double& weight, double& power) const;
    /** Get the order p of a monitor, which is that of a norm if it is MultiplierPNorm or ForcePNorm. */
    double getMonitorNormOrder(int index) const;
    /** Get the force group whose energy the monitor ForceGroupEnergy uses. */
    int getMonitorForceGroup() const;
    /**
     * Set the force group whose potential energy is the monitor ForceGroupEnergy: a positive function of the positions
     * that is written as an OpenMM Force. While such a monitor exists, the group is left out of the dynamics, and
     * getIntegrationForceGroups() does not contain it: it is no part of the energy.
     *
     * @param group    the force group, between 0 and 31. Default: 31
     */
    void setMonitorForceGroup(int group);
    /**
     * Let the integrator choose its steps by itself: the setting for most uses. It takes steps of the nominal size while nothing
     * out of the ordinary happens, and shorter ones when something does, by two monitors of its own (docs/automatic.md):
     *
     * - 0, U_A, on each step: the size of the net force, applied and of constraints, of the hardest clusters of particles, and
     *   of the applied forces times the squared speeds, in nm amu^(1/2)/ps^2;
     * - 1, U_B, of each step between: from the change of the forces along it, the second time derivative of the potential
     *   energy, in the same unit.
     *
     * They take the place of the monitors, which are removed, and of the update and the maximum step size, which have no effect
     * then: no step is ever larger than 4/3 of the nominal one, and none smaller than the minimum step size, by default
     * 1/1000 of the nominal one. clearMonitors() and addMonitor() end it. getMonitorValue(),
     * getReferenceMonitorValue() and setReferenceMonitorValue() have the indices 0 and 1.
     *
     * The first steps have the nominal size, and the geometric means of the monitors over them become their reference values,
     * unless these have been set; getReferenceMonitorValue() is 0 until then. Steps in which nothing moves and nothing pulls do not
     * count. A start in a clash is seen at once. At constant energy the reference values then stay what they are, so that the run is
     * reversible; where Forces change the state (a thermostat, a barostat) they follow it, and where velocities are set that
     * are more than twice as large (four times the kinetic energy) they are found anew, as when this is called again. No step costs
     * more than one evaluation of the forces. See also getNumShortSteps().
     *
     * @param calibrationSteps    the number of first steps that the reference values are found from, at least 1. Default: 30
     */
    void useAutomaticStepControl(int calibrationSteps = 30);
    /** Get whether the automatic step control is in use. */
    bool isAutomatic() const;
    /** Get from how many first steps the automatic step control finds its reference values, as it was set last. */
    int getCalibrationSteps() const;
    /**
     * Get the order of norms that addMonitor() gives to monitors that are added without one.
     *
     * @deprecated use getMonitorNormOrder()
     */
    double getNormOrder() const;
    /**
     * Set the order of all monitors MultiplierPNorm and ForcePNorm, also of those that are added later without one.
     *
     * @deprecated give it to addMonitor()
     * @param order    the order, at least 1. Default: 8
     */
    void setNormOrder(double order);
    /**
     * Get the reference value U_ref of a monitor: where U equals it, the nominal step size is taken.
     *
     * @param index    the index of the monitor
     * @return the value in force; 0 if none was set and no step has been taken that could tell
     */
    double getReferenceMonitorValue(int index = 0) const;
    /**
     * Set the reference value U_ref of a monitor. 0 (the default) means that it is taken at the first step: the first
     * step then has the nominal size, and U_ref is the value of U that makes the sequence of densities start without
     * oscillation, which is U at the start up to the change of U over a half step. While the monitor is zero but for rounding, as
     * that of the constraint forces where nothing pulls and nothing turns, it asks for nothing: steps have the nominal size, and
     * the reference value is taken at the first step after that; and while it grows more than fivefold in a step, as that of the
     * applied forces at a minimum of the energy, it is no measure either. Where that is no good measure for the rest of the run, set one, or
     * call calibrate() later.
     *
     * @param value    the reference value in the monitor's unit, or 0
     * @param index    the index of the monitor
     */
    void setReferenceMonitorValue(double value, int index = 0);
    /**
     * Set the reference value of every monitor to its mean over a trial run of fixed steps of the nominal size, or of the two of
     * automatic step control to their geometric means. The trial run starts at the current state of the Context, and everything but the
     * reference values and the number of force evaluations is put back as it was.
     *
     * @param steps    the number of trial steps
     */
    void calibrate(int steps);
    /** Get the step density rho of the last step; 1 before the first step. */
    double getStepDensity() const;
    /**
     * Get the value U_k(q,p) of a monitor at the current positions and velocities, in the unit given with its kind.
     * Before the first step this computes the forces. With automatic step control monitor 1 is that of the last step, and 0
     * before the first one.
     *
     * @param index    the index of the monitor
     */
    double getMonitorValue(int index = 0) const;
    /**
     * Get how many steps since then had to be rescued: the sum update gave no positive density, a
     * step of more than twice the maximum, or equations that could not be solved, and the density of the update Bounded
     * was taken for that one step. The run goes on, but it is not exactly reversible across a rescued step. A number that
     * grows says that the nominal step size is too large.
     */
    long long getNumRescues() const;
    /**
     * Get the most steps in a row that automatic step control has made shorter than a tenth of the nominal size since the Context
     * was created. In Python a warning says so once they are 1000: something is hard all the time, or the reference values belong to
     * calmer times, and then useAutomaticStepControl() finds new ones.
     */
    long long getNumShortSteps() const;
    /**
     * The same as setExpressionParameterValue().
     *
     * @deprecated its name differs by one letter from that of another function
     */
    void setExpressionConstraintParameter(int index, const std::string& name, double value);
    /**
     * Advance the simulation until a given time, which is met exactly by a shortened last step. The step density goes
     * on smoothly after it, but the shortened step is not part of the reversible sequence: to retrace a run, use step().
     * A time earlier than the current one does nothing.
     *
     * @param time    the time to which the simulation is advanced, in ps
     */
    void stepTo(double time);
    /**
     * Turn time around: the velocities change sign, and the half-step momentum and the density become those of the step that would
     * have come next, so that the following steps retrace the trajectory. No force is computed, and the Context's time
     * goes on forward.
     */
    void reverse();

private:
    friend class VariableStepRattleIntegratorProxy;
    void checkMonitorIndex(int index) const;
    void checkReferenceIndex(int index) const;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VARIABLESTEPRATTLEINTEGRATOR_H_
