// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_AUTOMATICCONTROL_H_
#define OPENMMVRATTLE_AUTOMATICCONTROL_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/ClusterForces.h"
#include "step/StepDensity.h"
#include <algorithm>
#include <cmath>
#include <vector>

namespace OpenMMVRattle {

/** The recursions, which devices have too. */
namespace AutomaticRecursions {
typedef double wide;
using std::max;
using std::min;
inline wide stretch(wide rho, wide a) {
    return StepDensity::f(rho, a);
}
inline wide unstretch(wide y, wide a) {
    return StepDensity::inverseOfF(y, a);
}
#define DEVICE
#define SELDOM inline
#include "step/AutomaticRecursions.h"
#undef SELDOM
#undef DEVICE
} // namespace AutomaticRecursions

/** Three times the speed of light (nm/ps). */
const double IMPOSSIBLE_SPEED = 1e6;

/**
 * Automatic step control: the density rho from two monitors that need no choice (docs/automatic_method.md has the reasons).
 *
 * A cluster c is a set of particles joined by constraints; a free particle is one of its own. With the applied force F, the net
 * force N = F - G^T Lambda, and what would turn the flight of a particle on the length l_f,
 *
 *     S_c = sum_{i in c} (|N_i|^2/m_i + m_i |v_i|^4/l_f^2),
 *     on step n:           A_c = S_c + sum_{i in c} |F_i| |v_i|^2/l,                                  U_A = (sum_c A_c^4)^(1/8)
 *     on half step n-1/2:  B_c = (6/dt) |sum_{i in c} w_i . (F_i[n] - F_i[n-1])| + (S_c[n] + S_c[n-1])/2,
 *                                                                                                     U_B = (sum_c B_c^4)^(1/8)
 *
 * u_A = (U_A/ref_A)^(2/3) and u_B = (U_B/ref_B)^(4/5) go through phi, which is exactly 1 while they are small (the dead zone), and
 *
 *     f(A[n+1/2]) + f(A[n-1/2]) = 2 f(phi(u_A[n])),   f(B[n+1/2]) + f(B[n-3/2]) = 2 f(phi(u_B[n-1/2])),
 *     rho = sqrt((A^2 + B^2)/2), and no more than stepSize/minimumStep.
 *
 * Both are symmetric in time, explicit, and cannot fail, since f maps (3/4, infinity) onto the real line. What is kept between
 * steps are f(A) and f(B) on the half steps behind and ahead, so that turning time around exchanges the two.
 *
 * The references are the geometric means of U_A and U_B over the first steps of the run, which have the nominal size. What is
 * hard beyond doubt then, in units of the thermal momentum a step, puts references of these units in force at once. As long as
 * Forces change the state, the references follow it. All of it are sums over clusters and particles, and a few numbers:
 * nothing that a device would need its host for.
 */
class AutomaticControl {
public:
    /** l and l_f (nm), and 6, the weight of the change of the forces. */
    static constexpr double LENGTH = 0.0125, FLIGHT = 0.4, CHANGE_WEIGHT = 6;
    /** The two monitors, in the order of everything that has two of something here. */
    enum Monitor { OnStep, HalfStep };
    static constexpr int NUM_MONITORS = 2;

    /** What a user can choose. */
    struct Settings {
        double stepSize = 0, minimumStep = 0;     // ps; no minimum if that is 0
        int learningSteps = 1;                    // how many steps the references are the mean of
        double given[NUM_MONITORS] = {};          // references that are not to be found; 0 for the others
    };

    /** What the following steps depend on, beside the references. */
    struct Memory : AutomaticRecursions::AutomaticNumbers {
        std::vector<double> forceSquares; // S_c[n]
    };

    explicit AutomaticControl(ConstraintSolver& solver);

    void setSettings(const Settings& newSettings);
    /** The settings and what follows from the System, as the recursions have them. */
    const AutomaticRecursions::AutomaticChoice& getChoice() const {
        return choice;
    }
    /** 3 n - m, by which twice the kinetic energy is divided. */
    double getNumDegreesOfFreedom() const {
        return numDegreesOfFreedom;
    }
    /** The reference value of a monitor, 0 while it is not known. */
    double getReference(int monitor) const {
        return references[monitor];
    }
    void setReference(int monitor, double value) {
        references[monitor] = value;
    }
    const Memory& getMemory() const {
        return memory;
    }
    /** 2K/f where the references were found that somebody has set. */
    void setReferenceTemperature(double kT) {
        memory.temperature = kT;
    }
    void setMemory(const Memory& newMemory) {
        memory = newMemory;
    }

    /** An on-step state. */
    struct State {
        const std::vector<OpenMM::Vec3>& positions; // nm
        const ExpressionParameters& parameters; // of expressions
        const std::vector<OpenMM::Vec3>& velocities; // nm/ps
        const std::vector<OpenMM::Vec3>& forces; // the applied ones (kJ/mol/nm)
        const std::vector<double>& multipliers; // Lambda(q,p), in internal order
    };
    /** Take over an on-step state that no step has led to: S_c and U_A. */
    void begin(const State& state);
    /**
     * Start the sequences at the state of begin(), and to find references if there are none, or if those that there are were found
     * at much smaller velocities.
     */
    void start();
    /**
     * Compute U_A at the end of a step and U_B of the step itself. Nothing is taken over until one of the functions below
     * is called.
     *
     * @param state       at its end
     * @param w           M^-1 p[n-1/2]
     * @param size        dt, the size of the step (ps)
     * @param oldForce    the applied forces at its start
     * @throws StepFailure    if a monitor is infinite or not a number
     */
    void measure(const State& state, const std::vector<OpenMM::Vec3>& w, double size,
                 const std::vector<OpenMM::Vec3>& oldForce);
    /** Take over what measure() has found, without a density (a trial run of fixed steps). */
    void acceptMeasured();
    /** Take over what measure() has found, as the end of a step of density getNext(). */
    void acceptStep();
    /** The same for a step that was only this part of a full one, between 0 and 1. */
    void acceptPartOfStep(double part);
    /**
     * Go on at a changed on-step state: A moves by as much as its monitor asks for, and so that changes again and again do not add up
     * to an oscillation, both sequences are drawn towards their monitors. Unless the change is mere rounding, the references
     * follow the run for the next steps.
     *
     * @param part    by which part of their distance, between 0 for a change that is mere rounding and 1
     */
    void change(const State& state, double part);
    /** Turn time around. */
    void reverse();

    /** rho[n-1/2]. */
    double getLast() const {
        return AutomaticRecursions::automaticDensity(&choice, memory.behind);
    }
    /** rho[n+1/2]. */
    double getNext() const {
        return AutomaticRecursions::automaticDensity(&choice, memory.ahead);
    }
    /** Where all monitors are no more than this, there is nothing to learn from. */
    double getNegligibleValue() const {
        return AutomaticRecursions::automaticNegligibleValue(&choice);
    }

private:
    void findSquares(const State& state, std::vector<double>& squares);
    void requirePossibleSpeeds() const;
    double evaluateOnStep(const State& state, const std::vector<double>& squares);

    ConstraintSolver& solver;
    const ConstraintSystem& system;
    ClusterForces clusterForces;
    int numClusters;
    double thermalSize, numDegreesOfFreedom;
    AutomaticRecursions::AutomaticChoice choice;
    double references[NUM_MONITORS];
    Memory memory;
    double temperature; // 2K/f of the state that was looked at last
    double measured[NUM_MONITORS]; // by measure()
    std::vector<double> measuredSquares, scratch;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_AUTOMATICCONTROL_H_
