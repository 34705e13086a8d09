// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_MULTIPLIERSQUARES_H_
#define OPENMMVRATTLE_MULTIPLIERSQUARES_H_

#include "constraints/ConstraintSolver.h"
#include "constraints/Sum.h"
#include <algorithm>
#include <cmath>
#include <vector>

namespace OpenMMVRattle {

/**
 * The sum of Lambda_k (K Lambda)_k, which is |M^(-1/2) G^T Lambda|^2, and if that is wanted of (d_k Lambda_k)^2, with d_k Lambda_k the
 * multipliers in users' units. It is found along with a pass that finds these, or else in one of its own.
 */
class MultiplierSquares {
public:
    explicit MultiplierSquares(const ConstraintSolver& solver) :
            solver(solver), system(solver.getSystem()), works(solver.getNumRanges()), squares(works) {
    }
    void setSquaresWanted(bool areWanted) {
        areSquaresWanted = areWanted;
    }
    /** These are the multipliers, and K times them, to be seen in the pass that comes. */
    void observe(const std::vector<double>& newMultipliers, const std::vector<double>& newRightSide) {
        multipliers = &newMultipliers;
        rightSide = &newRightSide;
    }
    /** Nothing is to be seen. */
    void ignore() {
        multipliers = nullptr;
    }
    /** See some that nobody has observed. */
    void look(const std::vector<double>& newMultipliers, const std::vector<double>& newRightSide) {
        observe(newMultipliers, newRightSide);
        solver.forRanges([&](int range, int first, int end) { seeConstraints(range, first, end); });
    }
    void seeConstraints(int range, int first, int end) {
        if (multipliers == nullptr)
            return;
        const double *lambda = multipliers->data() + first, *right = rightSide->data() + first;
        works[range] = sumOf(end - first, [&](int k) { return lambda[k] * right[k]; });
        if (areSquaresWanted)
            squares[range] = sumOf(end - first, [&](int k) {
                const double given = system.toGivenMultiplier(first + k) * lambda[k];
                return given * given;
            });
    }
    /** Lambda^T K Lambda; rounding could make it negative where it vanishes. */
    double getWeightedSum() const {
        return std::max(total(works), 0.0);
    }
    double getSum() const {
        return total(squares);
    }
    /** |d_k Lambda_k| */
    double sizeOf(int constraint) const {
        return std::fabs(system.toGivenMultiplier(constraint) * (*multipliers)[constraint]);
    }

private:
    static double total(const std::vector<double>& parts) {
        return sumOf((int) parts.size(), [&](int k) { return parts[k]; });
    }
    const ConstraintSolver& solver;
    const ConstraintSystem& system;
    const std::vector<double>*multipliers = nullptr, *rightSide = nullptr; // that are to be seen
    bool areSquaresWanted = false;
    std::vector<double> works, squares; // of each range
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MULTIPLIERSQUARES_H_
