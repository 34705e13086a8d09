// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_SPARSEFACTOR_H_
#define OPENMMVRATTLE_SPARSEFACTOR_H_

#include "constraints/FactorPattern.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The factor of a sparse symmetric positive definite matrix, as its pattern says: L D L^T in narrow columns, L L^T in panels. First
 * clear() and add the entries of the matrix, then keepDiagonal(), add what else there is, and factorize().
 */
class SparseFactor {
public:
    explicit SparseFactor(const FactorPattern& pattern);
    void clear();
    void add(unsigned slot, double value) {
        values[slot] += value;
    }
    /** A pivot is compared with what its diagonal entry is now. */
    void keepDiagonal();
    /**
     * Factorize what has been added.
     *
     * @param minPivot    the fraction of its diagonal entry that a pivot must exceed
     * @return the first column whose pivot does not, or REGULAR
     */
    int factorize(double minPivot);
    static constexpr int REGULAR = -1;
    /** What the elimination has left for the outer rows, at firstOuterValue of the pattern. */
    double getValue(size_t slot) const {
        return values[slot];
    }
    /** The first half of a solution: x becomes (L D)^-1 x; what it leaves for the outer rows is added to outer. */
    void eliminate(double* x, double* outer) const;
    /** The second half: x becomes L^-T x, outer being the solution in the outer rows. */
    void substitute(double* x, const double* outer) const;

private:
    int eliminateNarrow(double minPivot);
    void update(const std::vector<FactorPattern::Source>& sources, double* target, int height);
    int factorizePanel(const FactorPattern::Panel& panel, double minPivot);
    const FactorPattern& pattern;
    std::vector<double> values;
    std::vector<double> diagonal; // what pivots are compared with, and then 1/pivot of narrow columns
    std::vector<size_t> diagonalSlots; // of wide columns
    std::vector<int> placeOf;     // of each row in the panel that is being updated
    mutable std::vector<double> work;
    std::vector<double> product;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_SPARSEFACTOR_H_
