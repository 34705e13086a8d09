// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPMONITOR_H_
#define OPENMMVRATTLE_STEPMONITOR_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/StepDensity.h"
#include "step/StepState.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The monitors U_k(q,p) of docs/method.md, section 4, their combination
 *
 *     u = B(sqrt(sum_k (w_k (U_k/U_k,ref)^power_k)^2 / sum_k w_k^2)),
 *
 * and the derivative of u with respect to the velocities, at fixed positions. A monitor sees q only through the applied
 * force F, through the multipliers Lambda(q,p) and through the energy of a force group.
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
        double reference; // U_k,ref; 0 while it is not known
        double order = 8; // p of the p-norms, of no meaning to others
        /** Whether it is the same but for its reference. */
        bool isLike(const Term& other) const {
            return kind == other.kind && weight == other.weight && power == other.power && order == other.order;
        }
    };

    explicit StepMonitor(ConstraintSolver& solver);
    /** @param bounds    B, through which u goes */
    void setTerms(const std::vector<Term>& newTerms, const StepDensity& bounds);
    const std::vector<Term>& getTerms() const {
        return terms;
    }
    std::vector<double> getReferences() const;
    void setReferences(const std::vector<double>& references);
    void setReference(int index, double value) {
        terms[index].reference = value;
    }
    /** Whether any of some terms is defined by the constraints alone, and so is zero without them. */
    static bool needConstraints(const std::vector<Term>& terms);
    /** Whether any term changes with the velocities at fixed positions; and whether it does so other than through the multipliers. */
    bool dependsOnVelocities() const;
    bool usesVelocities() const;

    /** What the solver finds with this as its observer is to be seen: the multipliers of trial velocities, and these parameters; */
    ConstraintSolver::Coupled observeTrial(const ExpressionParameters& theta);
    /** or all that there is at the end of a step, with its forces. */
    void observe(const ConstraintSolver::OnStep& end);
    /** U_k at a state, whether it has just been observed or not. */
    void evaluate(const StepState& state, std::vector<double>& values);
    /** U_k at its half-step velocities, after that. */
    void evaluateHalfStep(const StepState& state, const ConstraintSolver::HalfStep& half, std::vector<double>& values);
    /** U_k at a state but for its velocities, which are those of the trial that has been observed. */
    void evaluateTrial(const StepState& state, const std::vector<OpenMM::Vec3>& v, std::vector<double>& values);
    /** The same at velocities that nobody has observed. */
    void evaluateAt(const StepState& state, const std::vector<OpenMM::Vec3>& v, const ExpressionParameters& theta,
                    std::vector<double>& values);
    /** The state that was evaluated last has been moved to another place. */
    void movedTo(const StepState& state) {
        forces = &state.force;
    }
    /** Forces have changed in place. */
    void forgetForces() {
        forces = seenForces = nullptr;
    }
    /** Throws a StepFailure if a force or value of the last evaluation is not a finite number, or a value is negative. */
    void requireValid(const std::vector<double>& values) const;
    /**
     * Whether a value of evaluate() is zero but for rounding, as that of multipliers where nothing pulls, or of forces that cancel
     * each other.
     *
     * @param speed           one that changes no position by more than rounding in a step (nm/ps)
     * @param acceleration    the same of an acceleration (nm/ps^2)
     */
    bool isNegligible(int index, double value, const StepState& state, double speed, double acceleration);
    /** u, the combination of the values. A term without a reference counts as if it had its value there. */
    double combine(const std::vector<double>& values) const;
    /** du/dv where these values have been found last, with the chain rule through Lambda (Lemma 4.2). */
    void evaluateGradient(const ExpressionParameters& theta, const std::vector<OpenMM::Vec3>& v,
                          const std::vector<double>& values, std::vector<OpenMM::Vec3>& gradient);

private:
    /** Over each range of constraints: of Lambda_k (K Lambda)_k, and of (d_k Lambda_k)^2 with d_k Lambda_k in users' units. */
    struct Sums {
        std::vector<double> forces, multipliers;
    };
    void seeParticles(int block) override;
    void seeConstraints(int range, int first, int end) override;
    void sumForces(const std::vector<OpenMM::Vec3>& newForces, int block);
    void sumRange(const std::vector<double>& multipliers, const std::vector<double>& rightSide, int range, int first,
                  int end, Sums& to) const;
    void sum(const std::vector<double>& multipliers, const std::vector<double>& rightSide);
    void see(const std::vector<double>& multipliers, const std::vector<double>& rightSide);
    void takeForces(const StepState& state, bool areSummed);
    void evaluate(const std::vector<OpenMM::Vec3>& v, const std::vector<double>& multipliers, const Sums& from,
                  std::vector<double>& values);
    template <class Size> double pNorm(int count, double order, const Size& size) const;
    double combineUnbounded(const std::vector<double>& values) const;
    double derivativeOfU(size_t index, const std::vector<double>& values, double u) const;
    double squareOf(const OpenMM::Vec3& force, int particle) const;
    double sumOfForces(Kind kind) const;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    std::vector<Term> terms;
    StepDensity bounds;
    // Of the state that was evaluated last.
    const std::vector<OpenMM::Vec3>* forces; // or null
    double groupEnergy, forceSquared, appliedForceSquared;
    std::vector<double> forceNorms; // of the terms that are a norm of the forces other than the square one
    // What is to be seen in a pass, and the sums of that; of |F|^2 and |F|^2/m over each block.
    const std::vector<OpenMM::Vec3>* seenForces; // or null
    const std::vector<double>*seenMultipliers, *seenRightSide;
    const ConstraintSolver::HalfStep* seenHalf; // or null
    ConstraintSolver::HalfStep trial;
    std::vector<double> blockSums, blockAppliedSums;
    Sums sums, halfSums;
    std::vector<double> toSolve, solved;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPMONITOR_H_
