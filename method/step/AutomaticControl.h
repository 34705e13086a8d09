// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_AUTOMATICCONTROL_H_
#define OPENMMVRATTLE_AUTOMATICCONTROL_H_

#include "constraints/ConstraintSystem.h"
#include "openmm/Vec3.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * Automatic step control: the density rho from two monitors that need no choice (docs/automatic.md has the reasons).
 *
 * With clusters c (particles joined by constraints; a free particle is one of its own), the applied force F and
 * S_c = (Lambda^T K Lambda)_c + sum_{i in c} |F_i|^2/m_i, the squared mass-weighted size of both forces,
 *
 *     on step n:           A_c = S_c + sum_{i in c} |F_i| |v_i|^2/l,                             U_A = (sum_c A_c^4)^(1/8)
 *     on half step n-1/2:  B_c = (2/dt) |sum_{i in c} w_i . (F_i[n] - F_i[n-1])| + (S_c[n] + S_c[n-1])/2,
 *                                                                                                U_B = (sum_c B_c^4)^(1/8)
 *
 * u_A = (U_A/ref_A)^(2/3) and u_B = (U_B/ref_B)^(4/5) go through phi, which is 1 while they are small (the dead zone), and
 *
 *     f(A[n+1/2]) + f(A[n-1/2]) = 2 f(phi(u_A[n])),   f(B[n+1/2]) + f(B[n-3/2]) = 2 f(phi(u_B[n-1/2])),
 *     rho = sqrt((A^2 + B^2)/2).
 *
 * Both are symmetric in time, explicit, and cannot fail, since f maps (3/4, infinity) onto the real line. What is kept between
 * steps are f(A) and f(B) on the half steps behind and ahead, so that turning time around exchanges the two.
 */
class AutomaticControl {
public:
    /** The two monitors, in the order of everything that has two of something here. */
    enum Monitor { OnStep, HalfStep };
    static constexpr int NUM_MONITORS = 2;

    /** What the following steps depend on, beside the references. */
    struct Memory {
        double behind[NUM_MONITORS], ahead[NUM_MONITORS]; // f(A), f(B) on the half steps n-1/2 and n+1/2
        double values[NUM_MONITORS];                      // U_A[n] and U_B[n-1/2], the latter 0 before the first step
        std::vector<double> forceSquares;                 // S_c[n]
    };

    explicit AutomaticControl(const ConstraintSystem& system);

    /** The reference value of a monitor, 0 while it is not known. */
    double getReference(int monitor) const {
        return references[monitor];
    }
    void setReference(int monitor, double value) {
        references[monitor] = value;
    }
    bool hasReferences() const {
        return references[OnStep] > 0 && references[HalfStep] > 0;
    }
    const Memory& getMemory() const {
        return memory;
    }
    void setMemory(const Memory& newMemory) {
        memory = newMemory;
    }

    /**
     * Take over an on-step state that no step has led to: S_c and U_A.
     *
     * @param v              the velocities (nm/ps)
     * @param force          the applied forces (kJ/mol/nm)
     * @param multipliers    Lambda(q,p), in internal order
     * @param rightSides     K Lambda
     */
    void begin(const std::vector<OpenMM::Vec3>& v, const std::vector<OpenMM::Vec3>& force,
               const std::vector<double>& multipliers, const std::vector<double>& rightSides);
    /**
     * Compute U_A at the end of a step and U_B of the step itself; arguments as in begin(), there. Nothing is taken over until
     * one of the functions below is called.
     *
     * @param w           M^-1 p[n-1/2]
     * @param size        dt, the size of the step (ps)
     * @param oldForce    the applied forces at its start
     * @throws StepFailure    if a monitor is infinite or not a number
     */
    void measure(const std::vector<OpenMM::Vec3>& v, const std::vector<OpenMM::Vec3>& force,
                 const std::vector<double>& multipliers, const std::vector<double>& rightSides,
                 const std::vector<OpenMM::Vec3>& w, double size, const std::vector<OpenMM::Vec3>& oldForce);
    /** Take over what measure() has found, without a density (a trial run of fixed steps). */
    void acceptMeasured();
    /** Take over what measure() has found, as the end of a step of density getNext(). */
    void acceptStep();
    /** The same for a step that was only this part of a full one, between 0 and 1. */
    void acceptPartOfStep(double part);
    /**
     * Start the sequences from two steps backwards in time.
     *
     * @param back         U_A[-1] and U_B[-1/2]
     * @param secondBack   U_A[-2] and U_B[-3/2]
     */
    void start(const double (&back)[NUM_MONITORS], const double (&secondBack)[NUM_MONITORS]);
    /**
     * Go on at a changed on-step state, other arguments as in begin(): A moves by as much as its monitor asks for, and so that
     * changes again and again do not add up to an oscillation, both sequences are drawn towards their monitors.
     *
     * @param part    by which part of their distance, between 0 for a change that is mere rounding and 1
     */
    void change(const std::vector<OpenMM::Vec3>& v, const std::vector<OpenMM::Vec3>& force,
                const std::vector<double>& multipliers, const std::vector<double>& rightSides, double part);
    /** Turn time around. */
    void reverse();

    /** rho[n-1/2]. */
    double getLast() const {
        return combine(memory.behind);
    }
    /** rho[n+1/2]. */
    double getNext() const {
        return combine(memory.ahead);
    }
    /** The density that U_A and U_B alone ask for. */
    double densityOf(const double (&values)[NUM_MONITORS]) const;
    /** A value of U_A or U_B below this is zero but for rounding. */
    double getNegligibleValue(const std::vector<OpenMM::Vec3>& v) const;

private:
    double target(int monitor, double value) const;
    static double combine(const double (&transformed)[NUM_MONITORS]);
    void sumForceSquares(const std::vector<OpenMM::Vec3>& force, const std::vector<double>& multipliers,
                         const std::vector<double>& rightSides, std::vector<double>& squares) const;
    double evaluateOnStep(const std::vector<OpenMM::Vec3>& v, const std::vector<OpenMM::Vec3>& force,
                          const std::vector<double>& squares);

    const ConstraintSystem& system;
    std::vector<int> movingParticles;
    std::vector<int> clusterOfParticle; // of each moving particle in that order
    int numClusters;
    double references[NUM_MONITORS];
    Memory memory;
    double measured[NUM_MONITORS]; // by measure()
    std::vector<double> measuredSquares, scratch;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_AUTOMATICCONTROL_H_
