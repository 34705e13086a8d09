// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPMONITOR_H_
#define OPENMMVRATTLE_STEPMONITOR_H_

#include "constraints/ConstraintSolver.h"
#include "constraints/ForceSquares.h"
#include "constraints/MultiplierSquares.h"
#include "openmm/Vec3.h"
#include "step/StepDensity.h"
#include "step/StepState.h"
#include <vector>

namespace OpenMMVRattle {

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

    /** Let this be the solver's observer in a pass for trial velocities, which finds the multipliers of these; */
    ConstraintSolver::Coupled observeTrial(const ExpressionParameters& theta);
    /** or in that which completes a step. */
    void observe(const ConstraintSolver::OnStep& end);
    /** U_k at the state that has been observed so, or, with what the forces are of it if they are others, at one that nobody has. */
    void evaluate(StepState& state);
    void look(StepState& state, bool areForcesOthers);
    /** U_k at its half-step velocities, after evaluate(). This and what follows holds until the next of them. */
    const Values& evaluateHalfStep(const StepState& state);
    /** U_k at a state but for its velocities, which are those of the trial that has been observed, or of nobody. */
    const Values& evaluateTrial(const StepState& state, const Vectors& v);
    const Values& evaluateAt(const StepState& state, const Vectors& v, const ExpressionParameters& theta);
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
    const Values& evaluate(const StepState& state, const Vectors& v, const MultiplierSquares& squares);
    double combineUnbounded(const Values& of) const;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    std::vector<Term> terms;
    StepDensity bounds;
    ForceSquares forceSquares;
    MultiplierSquares seen, seenHalf;
    ConstraintSolver::HalfStep trial;
    Values values;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPMONITOR_H_
