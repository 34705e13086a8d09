// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VARIABLESTEPRATTLELANGEVININTEGRATOR_H_
#define OPENMMVRATTLE_VARIABLESTEPRATTLELANGEVININTEGRATOR_H_

#include "openmmvrattle/ConstrainedIntegrator.h"

namespace OpenMMVRattle {

/**
 * An integrator for Langevin dynamics, so at constant temperature, with constraints: it is used as OpenMM's
 * LangevinMiddleIntegrator, samples what that one samples while all is calm, and goes through clashes, bad starts and the one bad
 * moment of a step that is otherwise not too large, where others end with a coordinate that is not a number.
 *
 * All steps have the size H = stepSize and count the same, so that averages and reporters need know nothing. A step is g-BAOAB (B.
 * Leimkuhler and C. Matthews, "Efficient molecular dynamics using geodesic integration and solvent-solute splitting", Proc. R. Soc. A
 * 472, 2016) with one evaluation of the forces: half a kick, half a drift on the constraints, friction and noise, half a drift, half a
 * kick. When something is hard, and only then, it is made of n = 2^k + 1 reversible substeps of RATTLE of the size H/n, with friction
 * and noise in the middle of the central one, and the same noise whatever n is: n evaluations of the forces.
 *
 * What is hard is measured by U = (sum_c A_c^4)^(1/8), A_c = sum_i (|f_i|^2/m_i + |f_i| |v_i|^2/l) over the particles of a cluster c
 * that constraints join, f being the net force, applied and of constraints, and l = 0.0125 nm. k is the smallest number with
 * 2^k >= (U/U_ref)^(2/3)/2.2, chosen at the beginning of a step and made larger if the end of the step asks for it, or if its
 * equations could not be solved. U_ref is a running median of U, which changes by 0.2 % a step and is no less than
 * what thermal motion must have: see setReferenceMonitorValue().
 *
 * It is no minimiser: the heat of a clash is real, and leaves at the rate of the friction. And a calm system gains nothing
 * from it.
 *
 * The velocities in the Context belong to the same time as the positions and satisfy the velocity constraints. A vibration of
 * frequency w has the variance kT (1 - (w H)^2/4) in them, so a temperature made by hand from getVelocities() is lower than
 * the one asked for, by 1.5 % for rigid water at 4 fs. The kinetic energy of a State, and the temperature that OpenMM's reporters
 * print, is that of the velocities half a substep before, which has no such error.
 *
 * The constraints are solved with a direct factorisation of the constraint matrix, so also bonds that are strongly coupled are met to
 * the tolerance; and the multipliers, that is the constraint forces, can be read with getMultipliers(). Constraints may also be given
 * as expressions with addConstraint().
 *
 * A step that cannot be completed with getMaximumSubsteps() substeps throws an OpenMMException and leaves the Context in the state
 * before that step.
 *
 * OpenMM's XmlSerializer stores all settings. Checkpoints store the settings and everything else that the next step depends on,
 * the random numbers to come and U_ref among them: a run that goes on from one is the same to the last bit on the Reference
 * platform. So do States made with integrator parameters, but for the random seed: several runs that go on from one State each have
 * the noise of their own integrator.
 */
class VariableStepRattleLangevinIntegrator : public ConstrainedIntegrator {
public:
    /**
     * Create a VariableStepRattleLangevinIntegrator.
     *
     * @param temperature      the temperature of the heat bath (in K); not negative
     * @param frictionCoeff    the friction coefficient that couples the system to it (in 1/ps); not negative. With 0 the dynamics is that
     *                         of constant energy
     * @param stepSize         the size of a step (in ps). With 0 no step can be taken, which will do for a Context that computes
     *                         energies
     */
    VariableStepRattleLangevinIntegrator(double temperature, double frictionCoeff, double stepSize);
    /** Create one with the settings of another, and no Context. */
    VariableStepRattleLangevinIntegrator(const VariableStepRattleLangevinIntegrator& other);
    ~VariableStepRattleLangevinIntegrator() override;
    /** Get the temperature of the heat bath (in K). */
    double getTemperature() const;
    /**
     * Set the temperature of the heat bath.
     *
     * @param temp    the temperature of the heat bath, measured in K; not negative
     */
    void setTemperature(double temp);
    /** Get the friction coefficient that couples the system to the heat bath (in 1/ps). */
    double getFriction() const;
    /**
     * Set the friction coefficient that couples the system to the heat bath.
     *
     * @param coeff    the friction coefficient, measured in 1/ps; not negative
     */
    void setFriction(double coeff);
    /** Get the random number seed, as it was set. See setRandomNumberSeed() for details. */
    int getRandomNumberSeed() const;
    /**
     * Set the random number seed. Two runs with the same seed that start alike have the same noise; with different seeds it is
     * independent. With 0, the default, each Context has a seed of its own. The noise of a particle is a function of the seed, the number
     * of steps that were taken since it came into force, and the index of the particle.
     *
     * @param seed    the seed
     */
    void setRandomNumberSeed(int seed);
    /** Set the size of a step, whatever number of substeps it is made of (in ps); 0 where no step is to be taken. */
    void setStepSize(double size) override;
    /** Get the most substeps that a step may be made of. */
    int getMaximumSubsteps() const;
    /**
     * Set the most substeps that a step may be made of: 2^k + 1, with k up to 20; or 1, so that no step has any. A step that asks for
     * more is tried with that many, and accepted if all numbers are finite. Default: 1025
     *
     * @param substeps    the number of substeps: 1, 3, 5, 9, 17, ...
     */
    void setMaximumSubsteps(int substeps);
    /** Get how many steps have been made of substeps since the Context was created. */
    long long getNumSubstepped() const;
    /** Get the largest number of substeps that a step has been made of since the Context was created; 1 if there were none. */
    int getLargestSubsteps() const;
    /**
     * Get the reference value U_ref of the monitor, in nm amu^(1/2)/ps^2.
     *
     * @return the value in force; 0 if none was set and no step has been taken that could tell
     */
    double getReferenceMonitorValue() const;
    /**
     * Set the reference value U_ref of the monitor, which then stays what it is. With 0, the default, it follows the run, as a running
     * median: by 0.2 % a step up where U is larger, and down where it is smaller, but no lower than max(1/2, S/5) sqrt(kT)/H, S = (sum_c
     * N_c^4)^(1/8) with the numbers N_c of particles of the clusters, and with the kT of 10 K below that temperature. It begins as U at
     * the first step, or four times that bound if that is less.
     *
     * @param value    the reference value in nm amu^(1/2)/ps^2, or 0
     */
    void setReferenceMonitorValue(double value);
    /**
     * Set whether U_ref stays what it is at the moment. Then the number of substeps depends on the state alone.
     *
     * @param frozen    whether it stays; if not, it follows the run, unless a value was set. Default: false
     */
    void freezeReference(bool frozen);
    /** Get whether freezeReference() has been called to keep U_ref. */
    bool isReferenceFrozen() const;
    /**
     * Get the value U(q,p) of the monitor at the current positions and velocities, in nm amu^(1/2)/ps^2. Before the first step this
     * computes the forces.
     */
    double getMonitorValue() const;

private:
    friend class VariableStepRattleLangevinIntegratorProxy;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VARIABLESTEPRATTLELANGEVININTEGRATOR_H_
