// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTMATRIX_H_
#define OPENMMVRATTLE_CONSTRAINTMATRIX_H_

#include "constraints/ConstraintSystem.h"
#include "constraints/FactorPattern.h"
#include "constraints/SparseFactor.h"
#include "constraints/StepFailure.h"
#include <array>
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * The constraint matrix K = G M^-1 G^T and its factorisation, in the internal order of the constraints, which is an order of
 * elimination with little fill. Where each number goes is worked out once, in an Analysis that several matrices may share; a
 * factorisation then allocates nothing that grows with it.
 *
 * As in ConstraintSystem, a part of the constraints may be worked on, and several parts by several threads at the same time. Of a
 * cut cluster first all pieces are eliminated; what they leave for the joints is kept apart, so that pieces do not meet. Then come
 * the joints, with solveJoints(), and what they find is substituted into the pieces.
 */
class ConstraintMatrix {
public:
    /** An entry that a piece leaves for its joints: where its own matrix has it, and where that of the joints. */
    struct Left {
        unsigned from, to;
    };
    /** How the matrix of a part is factorised. The outer rows of a piece are the joints that share particles with it. */
    struct PartAnalysis {
        int first;                              // constraint of the part
        FactorPattern pattern;
        size_t firstCoupling, endCoupling;      // of ConstraintSystem::getCouplings()
        std::vector<unsigned> couplingSlots;    // where these go
        std::vector<int> outer;                 // the joints of a piece, in increasing order
        std::vector<Left> left;
    };
    /** Of all parts, by their index. */
    typedef std::vector<PartAnalysis> Analysis;

    explicit ConstraintMatrix(const ConstraintSystem& system);
    /** A matrix of the same pattern as another. */
    ConstraintMatrix(const ConstraintSystem& system, const std::shared_ptr<const Analysis>& analysis);
    const std::shared_ptr<const Analysis>& getAnalysis() const {
        return analysis;
    }
    /**
     * Compute and factorise K for a Jacobian.
     *
     * @throws DependentConstraints    if a pivot D_k is not larger than MIN_RELATIVE_PIVOT K_kk: the constraints of
     *                                 that cluster depend on each other
     */
    void factorize(const ConstraintSystem::Jacobian& jacobian);
    /**
     * The same for a part, returning the first constraint whose pivot is too small, or REGULAR. For a piece the rows of the joints
     * are needed too.
     */
    int tryToFactorize(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part);
    /** The same for the joints of a cut cluster, whose pieces have been factorised. */
    int tryToFactorizeJoints(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::CutCluster& cluster);
    static constexpr int REGULAR = -1;
    /** Say what is wrong with a constraint that tryToFactorize() returned. */
    [[noreturn]] void throwDependent(int constraint, const ConstraintSystem::Jacobian& jacobian) const;

    /** Replace x by K^-1 x, for all constraints or whole clusters. */
    void solve(std::vector<double>& x, const ConstraintSystem::Part& part = ConstraintSystem::ALL) const;
    /** The first half, up to the diagonal. For the sake of pieces, several x that wait for their joints at once have different channels. */
    void eliminate(std::vector<double>& x, const ConstraintSystem::Part& part, int channel = 0) const;
    /** Between the halves, K^-1 x for the joints. */
    void solveJoints(std::vector<double>& x, const ConstraintSystem::CutCluster& cluster, int channel = 0) const;
    /** The second half. */
    void substitute(std::vector<double>& x, const ConstraintSystem::Part& part) const;
    static constexpr int NUM_CHANNELS = 2;
    /**
     * A pivot below this fraction of its diagonal entry means dependent constraints. Dependent sets leave pivots of
     * 1e-16 or negative ones, while a legitimate chain of mass ratio R gives 2/R.
     */
    static constexpr double MIN_RELATIVE_PIVOT = 1e-10;

private:
    /** The numbers of a part. */
    struct PartFactor {
        explicit PartFactor(const PartAnalysis& analysis);
        SparseFactor factor;
        // In the outer rows: what eliminations leave, and the joints' solution.
        mutable std::array<std::vector<double>, NUM_CHANNELS> sums;
        mutable std::vector<double> outerSolution;
    };
    static Analysis analyse(const ConstraintSystem& system);
    template <class Task> void forParts(int first, const Task& task) const;
    void assemble(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part);
    int factorizeAssembled(const ConstraintSystem::Part& part);
    const ConstraintSystem& system;
    std::shared_ptr<const Analysis> analysis;
    std::vector<PartFactor> factors;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTMATRIX_H_
