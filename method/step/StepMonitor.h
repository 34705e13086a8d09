// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPMONITOR_H_
#define OPENMMVRATTLE_STEPMONITOR_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <cmath>
#include <initializer_list>
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
    };

    /** What is at the multipliers Lambda of some velocities. */
    struct Multipliers {
        const std::vector<double>& multipliers; // Lambda(q,p)
        const std::vector<double>& rightSide; // K Lambda = g''(v,v) + G M^-1 F
        const std::vector<double>* rate; // the change of Lambda along a change of the velocities; or null
    };
    /** Sums over each range of constraints (ConstraintSolver::getNumRanges()), which are added in that order. */
    struct Sums {
        std::vector<double> forces,
            forceRates; // of Lambda_k (K Lambda)_k, and of the rate of Lambda_k in place of Lambda_k
        std::vector<double> multipliers,
            multiplierRates; // of d_k^2 Lambda_k^2 and d_k^2 Lambda_k times its rate, in users' units
    };

    explicit StepMonitor(ConstraintSolver& solver);
    void setTerms(const std::vector<Term>& terms);
    const std::vector<Term>& getTerms() const {
        return terms;
    }
    void setReference(int index, double value) {
        terms[index].reference = value;
    }
    bool isEmpty() const {
        return terms.empty();
    }
    /** Whether any term needs the multipliers. */
    bool needsMultipliers() const;
    /** Whether any of some terms is defined by the constraints alone, and so is zero without them. */
    static bool needConstraints(const std::vector<Term>& terms);
    /** Throws a StepFailure if a value is not a finite number, or negative. */
    void requireValid(const std::vector<double>& values) const;
    /** Whether any term changes with the velocities at fixed positions. */
    bool dependsOnVelocities() const;
    /** Whether any term does so other than through the multipliers. */
    bool usesVelocities() const;

    /**
     * Take over the forces at new positions, on which the following evaluations are based.
     *
     * @param forces         the applied force on each particle (kJ/mol/nm)
     * @param groupEnergy    the energy of the monitor's force group (kJ/mol)
     */
    void setForces(const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /**
     * The part of setForces() that concerns a block of particles (ConstraintSystem::getBlocks()), so that threads may share it; when
     * all have been done, the rest is finishForces().
     */
    void sumForces(const std::vector<OpenMM::Vec3>& forces, int block);
    void finishForces(const std::vector<OpenMM::Vec3>& forces, double groupEnergy);
    /** Whether the forces of the last setForces() were all finite. */
    bool hasFiniteForces() const {
        return std::isfinite(forceSquared);
    }
    /** The forces of the last setForces(). */
    const std::vector<OpenMM::Vec3>& getForces() const {
        return *forces;
    }
    /** The forces of the last setForces() now lie elsewhere. */
    void forcesMoved(const std::vector<OpenMM::Vec3>& newForces) {
        forces = &newForces;
    }
    Sums makeSums() const;
    /** Make the sums of one range; threads may share the ranges. */
    void sumRange(const Multipliers& at, int range, int first, int end, Sums& sums) const;
    /** Make all of them. */
    Sums sum(const Multipliers& at) const;
    /**
     * U_k at velocities v, for every term.
     *
     * @param v              the velocities (nm/ps)
     * @param multipliers    Lambda(q,p) at these velocities
     * @param sums           those of these multipliers
     * @param values         U_k
     */
    void evaluate(const std::vector<OpenMM::Vec3>& v, const std::vector<double>& multipliers, const Sums& sums,
                  std::vector<double>& values);
    /**
     * The derivative of u along a change of the velocities, at the state of the last evaluate().
     *
     * @param v               as in evaluate()
     * @param at              the multipliers there, with their rate
     * @param sums            those of them
     * @param values          what evaluate() gave
     * @param velocityRate    the change of v
     */
    double evaluateRate(const std::vector<OpenMM::Vec3>& v, const Multipliers& at, const Sums& sums,
                        const std::vector<double>& values, const std::vector<OpenMM::Vec3>& velocityRate) const;
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
     * du/dv at the state of the last evaluate(), at the positions of the solver.
     *
     * @param theta          the parameters of the expressions
     * @param v              as in evaluate()
     * @param multipliers    as in evaluate()
     * @param values         what evaluate() gave
     * @param[out] gradient  du/dv for each particle; the chain rule through Lambda included (Lemma 4.2)
     */
    void evaluateGradient(const ExpressionParameters& theta, const std::vector<OpenMM::Vec3>& v,
                          const std::vector<double>& multipliers, const std::vector<double>& values,
                          std::vector<OpenMM::Vec3>& gradient);

private:
    bool isWanted(std::initializer_list<Kind> kinds) const;
    template <class Size> double pNorm(int count, double order, const Size& size) const;
    double squareOf(const OpenMM::Vec3& force, int particle) const;
    bool areForcesNegligible(double acceleration) const;
    double evaluateTerm(size_t index, const std::vector<OpenMM::Vec3>& v, const std::vector<double>& multipliers) const;
    double derivativeOfU(size_t index, const std::vector<double>& values, double u) const;
    int findFastest(const std::vector<OpenMM::Vec3>& v) const;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    std::vector<Term> terms;
    const std::vector<OpenMM::Vec3>* forces;
    double groupEnergy, appliedForceSquared, forceSquared, maxForce, constraintForceSquared, multipliersSquared;
    std::vector<double> forcePNorms; // of the terms of that kind
    // Of the blocks: the sums of the squares of the forces, the same over masses, and the largest square.
    std::vector<double> blockSums, blockAppliedSums, blockLargest;
    std::vector<double> toSolve, solved;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPMONITOR_H_
