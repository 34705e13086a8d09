// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ConstraintMatrix.h"
#include "EliminationOrder.h"
#include <algorithm>

using namespace OpenMMVRattle;
using std::vector;

ConstraintMatrix::ConstraintMatrix(const ConstraintSystem& system) : system(system) {
    const int size = system.getNumConstraints();
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    vector<std::pair<int, int>> entries;
    for (const auto& coupling : couplings)
        if (system.getConstraintOf(coupling.row) != system.getConstraintOf(coupling.column))
            entries.emplace_back(system.getConstraintOf(coupling.row), system.getConstraintOf(coupling.column));
    const vector<vector<int>> pattern = findFactorPattern(size, entries);
    columnStart.assign(1, 0);
    size_t longest = 0;
    for (const vector<int>& column : pattern) {
        rows.insert(rows.end(), column.begin(), column.end());
        columnStart.push_back(rows.size());
        longest = std::max(longest, column.size());
    }
    const size_t numEntries = rows.size();
    auto slotOf = [&](int row, int column) {
        if (row == column)
            return numEntries + row;
        auto begin = rows.begin() + columnStart[column], end = rows.begin() + columnStart[column + 1];
        return (size_t) (std::lower_bound(begin, end, row) - rows.begin());
    };
    updateStart.assign(1, 0);
    for (const vector<int>& column : pattern) {
        for (size_t b = 0; b < column.size(); b++)
            for (size_t a = b; a < column.size(); a++)
                updates.push_back(slotOf(column[a], column[b]));
        updateStart.push_back(updates.size());
    }
    firstGeneralCoupling = couplings.size();
    for (size_t i = 0; i < couplings.size(); i++) {
        const int row = system.getConstraintOf(couplings[i].row), column = system.getConstraintOf(couplings[i].column);
        couplingSlots.push_back(slotOf(row, column));
        if (row >= system.getFirstGeneral())
            firstGeneralCoupling = std::min(firstGeneralCoupling, i);
    }
    values.resize(numEntries + size);
    inversePivots.resize(size);
    columnScratch.resize(longest);
}

void ConstraintMatrix::factorize(const ConstraintSystem::Jacobian& jacobian, int first) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    const size_t numEntries = rows.size();
    const int size = system.getNumConstraints();
    std::fill(values.begin() + columnStart[first], values.begin() + numEntries, 0.0);
    std::fill(values.begin() + numEntries + first, values.end(), 0.0);
    // Two constraints that share several particles have several couplings with one slot, which must add up.
    for (size_t i = first == 0 ? 0 : firstGeneralCoupling; i < couplings.size(); i++)
        values[couplingSlots[i]] += couplings[i].factor * jacobian[couplings[i].row].dot(jacobian[couplings[i].column]);
    double* diagonal = values.data() + numEntries;
    // The diagonal of K, to compare the pivots with, is kept where their inverses will be.
    std::copy(diagonal + first, diagonal + size, inversePivots.begin() + first);
    for (int column = first; column < size; column++) {
        const double pivot = diagonal[column];
        if (!(pivot > MIN_RELATIVE_PIVOT * inversePivots[column])) {
            for (size_t c = 0; c < system.getClusters().size(); c++) {
                const ConstraintSystem::Cluster& cluster = system.getClusters()[c];
                if (column < cluster.first || column >= cluster.first + cluster.size)
                    continue;
                for (int k = cluster.first; k < cluster.first + cluster.size; k++) {
                    const std::string explanation = system.explainGradient(k, jacobian);
                    if (!explanation.empty())
                        throw StepFailure(explanation);
                }
                throw DependentConstraints(system.getClusterParticles((int) c));
            }
        }
        const double inverse = 1 / pivot;
        inversePivots[column] = inverse;
        const size_t start = columnStart[column];
        const int count = (int) (columnStart[column + 1] - start);
        const size_t* update = updates.data() + updateStart[column];
        double* entry = values.data() + start;
        for (int b = 0; b < count; b++) {
            const double scaled = entry[b] * inverse;
            columnScratch[b] = scaled;
            for (int a = b; a < count; a++)
                values[*update++] -= entry[a] * scaled;
        }
        for (int b = 0; b < count; b++)
            entry[b] = columnScratch[b];
    }
}

void ConstraintMatrix::solve(vector<double>& x, int first) const {
    const int size = system.getNumConstraints();
    for (int column = first; column < size; column++) {
        const double value = x[column];
        for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
            x[rows[i]] -= values[i] * value;
        x[column] = value * inversePivots[column];
    }
    for (int column = size - 1; column >= first; column--) {
        double value = x[column];
        for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
            value -= values[i] * x[rows[i]];
        x[column] = value;
    }
}
