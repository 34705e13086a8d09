// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTMATRIX_H_
#define OPENMMVRATTLE_CONSTRAINTMATRIX_H_

#include "ConstraintSystem.h"
#include "StepFailure.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The constraint matrix K = G M^-1 G^T and its factorisation L D L^T, in the internal order of the constraints, which is
 * an order of elimination with little fill. Where each number goes is worked out once; a factorisation then runs through a fixed
 * schedule, allocates nothing, and costs time linear in the number of entries of L, that is, of constraints.
 *
 * As in ConstraintSystem, a part of the constraints may be worked on, all or one of getGeneralParts(), and several parts by several
 * threads at the same time.
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
    /** The same for a part, returning the first constraint whose pivot is too small, or REGULAR. */
    int tryToFactorize(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part);
    static constexpr int REGULAR = -1;
    /** Say what is wrong with a constraint that tryToFactorize() returned. */
    [[noreturn]] void throwDependent(int constraint, const ConstraintSystem::Jacobian& jacobian) const;
    /** Replace x by K^-1 x. */
    void solve(std::vector<double>& x, const ConstraintSystem::Part& part = ConstraintSystem::ALL) const;
    /**
     * A pivot below this fraction of its diagonal entry means dependent constraints. Dependent sets leave pivots of
     * 1e-16 or negative ones, while a legitimate chain of mass ratio R gives 2/R.
     */
    static constexpr double MIN_RELATIVE_PIVOT = 1e-10;

private:
    const ConstraintSystem& system;
    std::vector<size_t> couplingStart;   // of the couplings of each constraint with those before it
    std::vector<size_t> columnStart;     // of the entries of L below the diagonal
    std::vector<int> rows;               // of these entries
    std::vector<size_t> updateStart;     // of the updates that the elimination of a column makes
    std::vector<unsigned> updates;       // where they go: an entry below the diagonal, or numEntries + the row on it
    std::vector<unsigned> couplingSlots; // where the couplings go, as updates
    std::vector<double> values;          // the entries below the diagonal, then the diagonal
    std::vector<double> inversePivots;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTMATRIX_H_
