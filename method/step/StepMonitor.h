// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPMONITOR_H_
#define OPENMMVRATTLE_STEPMONITOR_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <cmath>
#include <vector>

namespace OpenMMVRattle {

/**
 * The monitors U_k(q,p) of docs/method.md, section 4, their combination
 *
 *     u = sqrt(sum_k (w_k (U_k/U_k,ref)^power_k)^2 / sum_k w_k^2),
 *
 * and the derivative of u with respect to the velocities, at fixed positions. A monitor sees q only through the applied
 * force F, through the multipliers Lambda(q,p) and through the energy of a force group.
 */
class StepMonitor {
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
    /** Sums over each range of constraints (ConstraintSolver::getNumRanges()) for one set of multipliers, added in that order. */
    struct Sums {
        std::vector<double> forces,
            multipliers; // of Lambda_k (K Lambda)_k and (d_k Lambda_k)^2, d_k Lambda_k in users' units
    };

    explicit StepMonitor(ConstraintSolver& solver);
    void setTerms(const std::vector<Term>& newTerms);
    const std::vector<Term>& getTerms() const {
        return terms;
    }
    void setReference(int index, double value) {
        terms[index].reference = value;
    }
    /** Whether any of some terms is defined by the constraints alone, and so is zero without them. */
    static bool needConstraints(const std::vector<Term>& terms);
    /** Whether any term changes with the velocities at fixed positions; and whether it does so other than through the multipliers. */
    bool dependsOnVelocities() const;
    bool usesVelocities() const;

    /** The part of setForces() that concerns a block of particles (ConstraintSystem::getBlocks()); threads may share the blocks. */
    void sumForces(const std::vector<OpenMM::Vec3>& forces, int block);
    /**
     * Take over the forces at new positions (kJ/mol/nm) and the energy of the monitor's force group there (kJ/mol), on which the
     * following evaluations are based.
     *
     * @param areSummed    sumForces() has been called for all blocks already
     */
    void setForces(const std::vector<OpenMM::Vec3>& newForces, double energy, bool areSummed = false);
    /** Whether these were all finite. */
    bool hasFiniteForces() const {
        return std::isfinite(forceSquared);
    }
    /** They now lie elsewhere. */
    void forcesMoved(const std::vector<OpenMM::Vec3>& newForces) {
        forces = &newForces;
    }
    Sums makeSums() const;
    /** Make the sums of one range; threads may share the ranges. */
    void sumRange(const std::vector<double>& multipliers, const std::vector<double>& rightSide, int range, int first,
                  int end, Sums& sums) const;
    Sums sum(const std::vector<double>& multipliers, const std::vector<double>& rightSide) const;
    /**
     * U_k at velocities v, for every term.
     *
     * @param multipliers    Lambda(q,p) at these velocities
     * @param sums           those of these multipliers
     */
    void evaluate(const std::vector<OpenMM::Vec3>& v, const std::vector<double>& multipliers, const Sums& sums,
                  std::vector<double>& values);
    /** Throws a StepFailure if a value is not a finite number, or negative. */
    void requireValid(const std::vector<double>& values) const;
    /**
     * Whether a value of evaluate() is zero but for rounding, as that of multipliers where nothing pulls, or of forces that cancel
     * each other.
     *
     * @param speed           one that changes no position by more than rounding in a step (nm/ps)
     * @param acceleration    the same of an acceleration (nm/ps^2)
     */
    bool isNegligible(int index, double value, const std::vector<OpenMM::Vec3>& v, double speed,
                      double acceleration) const;
    /** u, the combination of the values; 1 if there is no term. A term without a reference counts as if it had its value there. */
    double combine(const std::vector<double>& values) const;
    /**
     * du/dv at the state of the last evaluate(), at the positions of the solver, the chain rule through Lambda (Lemma 4.2) included.
     *
     * @param theta          the parameters of the expressions
     * @param values         what evaluate() gave
     */
    void evaluateGradient(const ExpressionParameters& theta, const std::vector<OpenMM::Vec3>& v,
                          const std::vector<double>& multipliers, const std::vector<double>& values,
                          std::vector<OpenMM::Vec3>& gradient);

private:
    template <class Size> double pNorm(int count, double order, const Size& size) const;
    double derivativeOfU(size_t index, const std::vector<double>& values, double u) const;
    double squareOf(const OpenMM::Vec3& force, int particle) const;
    double sumOfForces(Kind kind) const;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    std::vector<Term> terms;
    const std::vector<OpenMM::Vec3>* forces;
    double groupEnergy, forceSquared, appliedForceSquared, constraintForceSquared, multipliersSquared;
    std::vector<double> forceNorms; // of the terms that are a norm of the forces other than the square one
    std::vector<double> blockSums, blockAppliedSums; // of |F|^2 and |F|^2/m over each block
    std::vector<double> toSolve, solved;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPMONITOR_H_
