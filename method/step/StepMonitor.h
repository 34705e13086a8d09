// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPMONITOR_H_
#define OPENMMVRATTLE_STEPMONITOR_H_

#include "constraints/ConstraintSolver.h"
#include "constraints/ForceSquares.h"
#include "constraints/MultiplierSquares.h"
#include "openmm/Vec3.h"
#include "step/StepDensity.h"
#include <vector>

namespace OpenMMVRattle {

/** An on-step state, and what is known of the step that has led to it. */
struct StepState {
    explicit StepState(const ConstraintSystem& system) :
            q(system.getNumParticles()), v(q), w(q), force(q), theta(system.getGivenParameters()),
            lambda(system.getNumConstraints()), rightSide(lambda), offset{lambda, lambda} {
    }
    /** As the end of a step that is still to be kicked (ps), which its half-step velocities have led to. */
    ConstraintSolver::OnStep end(double kick, ConstraintSolver::HalfStep* atHalfStep = nullptr) {
        return {q, w, force, theta, kick, v, lambda, rightSide, atHalfStep};
    }
    std::vector<OpenMM::Vec3> q, v, w, force; // q[n], M^-1 p[n], M^-1 p[n-1/2] and F(q[n])
    ExpressionParameters theta;               // theta[n], with the rates of the step
    std::vector<double> lambda, rightSide;    // Lambda(q[n],p[n]) and K Lambda
    ConstraintSolver::Offset offset;          // lambda and Lambda of the last regular step
    double groupEnergy = 0;                   // of the monitor's force group at q[n]
    std::vector<double> values, forceParts;   // U_k(q[n],p[n]), and what of each the forces alone are
    std::vector<double> halfStepValues;       // U_k(q[n],p[n-1/2]), if they have been found
};

/**
 * The monitors U_k(q,p) of docs/method.md, section 4, and their combination
 *
 *     u = B(sqrt(sum_k (w_k (U_k/U_k,ref)^power_k)^2 / sum_k w_k^2)).
 *
 * A monitor sees q only through the applied force F, through the multipliers Lambda(q,p) and through the energy of a force group.
 */
class StepMonitor : public ConstraintSolver::Observer {
public:
    enum Kind {
        ConstraintMultipliers,
        ConstraintForce,
        AppliedForce,
        ConstraintAndAppliedForce,
        MultiplierPNorm,
        ForcePNorm,
        VectorField,
        MaxForce,
        ArcLength,
        MaxParticleArcLength,
        ForceGroupEnergy
    };
    struct Term {
        Kind kind;
        double weight, power;
        double reference; // U_k,ref, if it is given; else 0
        double order = 8; // p of the p-norms, of no meaning to others
    };
    typedef std::vector<OpenMM::Vec3> Vectors;
    typedef std::vector<double> Values;

    /** Whether any of some terms is defined by the constraints alone, and so is zero without them. */
    static bool needConstraints(const std::vector<Term>& terms);
    /** Whether any changes with the velocities at fixed positions; and whether it does so other than through the multipliers. */
    static bool dependOnVelocities(const std::vector<Term>& terms);
    static bool useVelocities(const std::vector<Term>& terms);

    explicit StepMonitor(ConstraintSolver& solver);
    /** Take over terms, with their references. B is that of the bounds. */
    void setTerms(const std::vector<Term>& newTerms, const StepDensity& newBounds);
    Values references; // U_k,ref in force, 0 while they are not known

    /**
     * Complete a step (3.12)-(3.13), and find U_k there, if it is wanted at the half-step velocities too.
     *
     * @throws StepFailure    if that cannot be done, or U_k is not defined there
     */
    void finish(StepState& end, double kick, bool withHalfStep);
    /** U_k at a state for which that has not been done; what the forces are of it is found anew if they are others. */
    void look(StepState& state, bool areForcesOthers);
    /** U_k at its positions for other velocities, and theta with other rates; it holds until the next call of this or the following. */
    const Values& evaluateAt(const StepState& state, const Vectors& v, const ExpressionParameters& theta);
    /** A coupled pass from a state; returns u for the velocities that it finds. */
    double coupledPass(const StepState& state, const ConstraintSolver::Trial& trial, const ExpressionParameters& theta,
                       const ConstraintSolver::Guess* start, double& constraintError);
    /** @throws StepFailure    if a value is not a finite number, or negative */
    void requireValid(const Values& checked) const;
    /**
     * Whether a value is zero but for rounding, as that of multipliers where nothing pulls, or of forces that cancel each other.
     *
     * @param speed           one that changes no position by more than rounding in a step (nm/ps)
     * @param acceleration    the same of an acceleration (nm/ps^2)
     */
    bool isNegligible(size_t index, const StepState& state, double speed, double acceleration);
    /** u, the combination of the values. A term without a reference counts as if it had its value there. */
    double combine(const Values& of) const {
        return bounds.limit(combineUnbounded(of));
    }

private:
    void seeParticles(int block) override {
        forceSquares.seeParticles(block);
    }
    void seeConstraints(int range, int first, int end) override {
        seen.seeConstraints(range, first, end);
        seenHalf.seeConstraints(range, first, end);
    }
    void takeForces(StepState& state);
    void evaluate(const StepState& state, const Vectors& v, const MultiplierSquares& squares, Values& found);
    double combineUnbounded(const Values& of) const;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    std::vector<Term> terms;
    StepDensity bounds;
    ForceSquares forceSquares;
    MultiplierSquares seen, seenHalf;
    ConstraintSolver::HalfStep atHalfStep; // at whatever velocities but those of the state
    Values trialValues;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPMONITOR_H_
