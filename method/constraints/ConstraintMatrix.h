// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTMATRIX_H_
#define OPENMMVRATTLE_CONSTRAINTMATRIX_H_

#include "constraints/ConstraintSystem.h"
#include "constraints/StepFailure.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The constraint matrix K = G M^-1 G^T and its factorisation L D L^T, in the internal order of the constraints, which is
 * an order of elimination with little fill. Where each number goes is worked out once; a factorisation then runs through a fixed
 * schedule, allocates nothing, and costs time linear in the number of entries of L, that is, of constraints.
 *
 * As in ConstraintSystem, a part of the constraints may be worked on, and several parts by several threads at the same time. Of a
 * cut cluster first all pieces are eliminated; what they leave for the joints is kept apart, so that pieces do not meet. Then come
 * the joints, with solveJoints(), and what they find is substituted into the pieces.
 */
class ConstraintMatrix {
public:
    explicit ConstraintMatrix(const ConstraintSystem& system);
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
    /** The first half, (L D)^-1 x. For the sake of pieces, several x that wait for their joints at once have different channels. */
    void eliminate(std::vector<double>& x, const ConstraintSystem::Part& part, int channel = 0) const;
    /** Between the halves, K^-1 x for the joints. */
    void solveJoints(std::vector<double>& x, const ConstraintSystem::CutCluster& cluster, int channel = 0) const;
    /** The second half, L^-T x. */
    void substitute(std::vector<double>& x, const ConstraintSystem::Part& part) const;
    static constexpr int NUM_CHANNELS = 2;
    /**
     * A pivot below this fraction of its diagonal entry means dependent constraints. Dependent sets leave pivots of
     * 1e-16 or negative ones, while a legitimate chain of mass ratio R gives 2/R.
     */
    static constexpr double MIN_RELATIVE_PIVOT = 1e-10;

private:
    /** Something to be added: of values, or a sum that a piece leaves to an x. */
    struct Addition {
        size_t target, source;
    };
    /** What a piece leaves for the joints at its ends. */
    struct Remains {
        std::vector<Addition> terms, values; // for x, and for the entries of the matrix
        size_t firstEntry;                   // in jointSums
    };
    size_t findSlot(int row, int column) const;
    static const Addition& findAddition(const std::vector<Addition>& additions, size_t target);
    void findRemains();
    void findUpdates();
    void findCouplingSlots();
    template <class Task> void forParts(int first, const Task& task) const;
    void assemble(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part);
    int eliminateColumns(const ConstraintSystem::Part& part);
    const ConstraintSystem& system;
    std::vector<size_t> couplingStart;   // of the couplings of each constraint, or of a piece, with those before it
    std::vector<size_t> columnStart;     // of the entries of L below the diagonal
    std::vector<int> rows;               // of these entries
    std::vector<size_t> updateStart;     // of the updates that the elimination of a column makes
    std::vector<unsigned> updates;       // where they go, in values
    std::vector<unsigned> couplingSlots; // where the couplings go, in values
    std::vector<double> values; // the entries below the diagonal, the diagonal, and the remains of the pieces
    std::vector<double> inversePivots;
    // If there are pieces:
    std::vector<Remains> remains; // of each piece
    std::vector<int> numJointEntries; // the last entries of each column, in the rows of joints
    std::vector<int> jointSums; // the sum that each of these adds to
    size_t numSums = 0;
    mutable std::vector<double> sums[NUM_CHANNELS]; // for the joints, while x is solved for
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTMATRIX_H_
