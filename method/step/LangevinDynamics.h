// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_LANGEVINDYNAMICS_H_
#define OPENMMVRATTLE_LANGEVINDYNAMICS_H_

#include "constraints/ConstraintSolver.h"
#include "constraints/ParameterMotion.h"
#include "openmm/Vec3.h"
#include "step/ClusterForces.h"
#include "step/StepSettings.h"
#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * Langevin dynamics at the temperature T with steps of the size H, each made of n substeps d = H/n: n = 1 while all is calm, and n =
 * 2^k + 1, always odd, when something is hard. With F = force(q), P the projection of velocities onto the constraints, and drift(s)
 * the motion along v for the time s under the constraints (that is, l with g(q + s (v - M^-1 G(q)^T l)) = 0, then v -= M^-1 G(q)^T l
 * and q += s v):
 *
 *     for i in 0 .. n-1
 *         v += d/2 M^-1 F
 *         if i = (n-1)/2:  drift(d/2);  v <- a v + sqrt(kT (1 - a^2)) M^-1/2 xi,  a = e^(-gamma H);  drift(d/2)
 *         else:            drift(d)
 *         F = force(q)
 *         v = P (v + d/2 M^-1 F)
 *
 * k is the smallest that the monitor U asks for at both ends of the step (or k_max), and solves its equations; a step whose end asks
 * for more is taken again from its beginning, **with the same noise xi**, for noise drawn anew would select against hard ends. That n
 * is odd, with the noise in the middle of the central drift, makes every k sample the positions of a harmonic oscillator
 * exactly; and each of the parts is reversible, so that k is the same in the reversed step, but for rare ones.
 *
 * The monitor measures the change of momentum by the net force f of the clusters c that constraints join,
 *
 *     A_c = sum_{i in c} (|f_i|^2/m_i + |f_i| |v_i|^2/l),   U = (sum_c A_c^4)^(1/8),
 *
 * and k is the smallest number with 2^k >= (U/U_ref)^(2/3)/c. U_ref follows U as a running median at a bounded rate, but not in
 * substepped steps hotter than thermal motion can be: so a clash does not capture it, and no calibration is needed.
 * docs/langevin_method.md has the reasons.
 *
 * Each substep is a pass of step() and finish(). All that a run asks of a method has the same meaning as in VRattleDynamics.
 */
class LangevinDynamics {
public:
    typedef ConstraintSolver::Parallel Parallel;
    typedef StepSettings Settings;
    /** What the next step depends on beside the settings, positions, velocities and forces; saved for a restart. */
    struct Memory {
        std::vector<double> parameters, parameterRates; // theta[n], and dtheta/dt of the step to it
        std::vector<double> multipliers;                // Lambda(q[n],p[n]), in internal order
        double monitorValue, lastSubstep;               // U(q[n],p[n]); d of the last step, 0 before it
    };

    LangevinDynamics(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints,
                     const std::vector<ExpressionConstraint>& expressions = {});
    void setParallel(const Parallel& parallel, int numThreads);
    template <class Task> void share(int count, const Task& task) {
        solver.share(count, task);
    }
    /** Take over settings: the step size, here H, the tolerance of the constraints and those of Langevin dynamics, which there must be. */
    void setSettings(const Settings& newSettings);
    const Settings& getSettings() const {
        return settings;
    }

    bool projectPositions(std::vector<OpenMM::Vec3>& positions, const ExpressionParameters& parameters);
    void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    std::function<void()> remember();
    Memory getMemory() const;
    /** Go on from a saved state, taken as it is, to the last bit. */
    void resume(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const Memory& memory);
    void setParameters(int expression, const std::map<std::string, double>& parameters) {
        getConstraintSystem().writeParameters(expression, parameters, motion.target);
    }
    const ExpressionParameters& getParameters() const {
        return theta;
    }
    void adoptParameters();
    void setReferences(const std::vector<double>& references);
    std::vector<double> getReferences() const {
        return {reference};
    }
    void changeState(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                     const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    bool changeFrame(const std::vector<OpenMM::Vec3>& before, const std::vector<OpenMM::Vec3>& velocities);
    void changeVelocities(const std::vector<OpenMM::Vec3>& velocities);
    void changeForces(std::vector<OpenMM::Vec3>& forces, double groupEnergy);

    /** A substep: the steps have the size H, whatever maxStep says. Fails if 2^k_max + 1 substeps are not enough. */
    double step(double maxStep);
    bool finish(std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    void abandonStep();
    void reverse();

    /**
     * The kinetic energy of P (v - d/2 M^-1 F), the velocities half a substep before: at these velocities and not the on-step ones a
     * vibration has its share of kT/2.
     */
    double computeHalfStepKineticEnergy();
    /** The seed in force, and how many steps have drawn noise with it. */
    std::vector<double> getRandomState() const {
        return {(double) seed, (double) numDrawn};
    }
    void setRandomState(const std::vector<double>& state);

    // For somebody else who takes the steps that need no substeps.

    /** Of the monitor (nm). */
    static constexpr double FLIGHT_LENGTH = 0.0125;
    /** The factor by which U_ref follows U in a step; 1 if it does not. */
    double getFollowingFactor() const;
    /** U_ref is no less than this. */
    double findFloor() const;
    /** The largest U/U_ref at both ends of a step that needs no substeps; without bound if it may have none. */
    double findLargestCalm() const;
    /** a and sqrt(kT (1 - a^2)) of the noise. */
    struct Noise {
        double damping, size;
    };
    Noise findNoise() const;
    /** Whether the next step is known to begin as one without substeps. */
    bool isCalm() const {
        return reference > 0 && !q.empty() && values[0] <= findLargestCalm() * reference;
    }
    /**
     * Go on from the state that such steps of the size H have led to.
     *
     * @param parameters    theta there, with the rates of the last step
     * @param isFollowed    U_ref has followed U there; else it does so now
     * @param drawn         steps that have drawn noise
     */
    void adopt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const ExpressionParameters& parameters,
               double newReference, bool isFollowed, int64_t drawn);
    /** How many steps have been made of substeps, and of how many at most. */
    long long getNumSubstepped() const {
        return numSubstepped;
    }
    int getLargestSubsteps() const {
        return largestSubsteps;
    }
    /**
     * Let the next steps use these normal numbers, three for each particle, in place of drawn ones; none to draw them again. For tests
     * against other statements of the method.
     */
    void setNoise(const std::vector<OpenMM::Vec3>& numbers) {
        givenNoise = numbers;
    }

    const ConstraintSystem& getConstraintSystem() const {
        return solver.getSystem();
    }
    const std::vector<OpenMM::Vec3>& getPositions() const {
        return q;
    }
    const std::vector<OpenMM::Vec3>& getNextPositions() const {
        return qNext;
    }
    const std::vector<OpenMM::Vec3>& getVelocities() const {
        return v;
    }
    const std::vector<OpenMM::Vec3>& getForces() const {
        return force;
    }
    double getGroupEnergy() const {
        return groupEnergy;
    }
    /** 1: the steps have the size that they should have. */
    double getDensity() const {
        return 1;
    }
    const std::vector<double>& getMonitorValues() const {
        return values;
    }
    const std::vector<double>& getMultipliers() const {
        return lambda;
    }
    long long getNumIterations() const {
        return solver.getNumIterations();
    }

private:
    typedef std::vector<OpenMM::Vec3> Vectors;
    double findFloor(double coldest) const;
    void startReference();
    void followReference();
    int findDoublings(double u) const;
    double evaluateMonitor(const Vectors& netAccelerations, const Vectors& velocities);
    double evaluateMonitorOfState();
    void takeState(const Vectors& positions, const Vectors& velocities, const Vectors& forces, double energy);
    void evaluateOnStep();
    void settle();
    void addNoise(const int* particles, int count, Vectors& velocities) const;
    int findNotFinite(const Vectors& x, const std::vector<int>& particles);
    bool isNowhere(const Vectors& positions, std::string& reason);
    void startAttempt();
    void raise(const std::string& reason);
    bool trySubstep(std::string& reason);
    bool tryCentralDrift(const Vectors& start, double d, const std::vector<double>& guess, std::string& reason);
    bool tryDrift(const ConstraintSolver::Trial& trial, const std::vector<double>& guess, std::string& reason);
    double findSubstep() const {
        return settings.stepSize / LangevinSettings::getSubsteps(doublings);
    }

    ConstraintSolver solver;
    ParameterMotion motion;
    ClusterForces clusterForces;
    std::vector<int> loose; // the particles without a distance constraint, whose error would tell that they are nowhere
    Settings settings;

    // The state between two steps.
    Vectors q, v, force;
    double groupEnergy;
    ExpressionParameters theta; // theta[n], with the rates of the step that has led to q[n]
    std::vector<double> lambda; // Lambda(q[n],p[n])
    std::vector<double> values; // U(q[n],p[n]), alone
    double reference; // U_ref, 0 while it is not known
    double lastSubstep; // d of the last step; 0 if there was none since the state was changed
    int64_t seed; // 0: there is none yet
    int64_t numDrawn; // steps that have drawn noise
    Vectors givenNoise;
    long long numSubstepped;
    int largestSubsteps;

    // The step in progress.
    bool isInProgress;
    bool isAtStart; // the solver is at q[n]
    int doublings, substep; // k and i
    Vectors qNow, vNow, forceNow; // at the beginning of a substep that is not the first
    Vectors qMiddle, wMiddle, noForce; // in the middle of the central drift
    Vectors qNext, wNext, vNext; // at its end, the velocities before the half kick and on step
    Vectors netAccelerations; // M^-1 (F - G^T Lambda) where U was evaluated last
    ExpressionParameters thetaNow, thetaMiddle, thetaNext;
    std::vector<double> lambdaNow, lambdaNext, multipliers, noMultipliers, rightSide;
    std::vector<double> clusterSums; // A_c
    double systemSize; // S
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_LANGEVINDYNAMICS_H_
