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
    for (const vector<int>& column : pattern) {
        rows.insert(rows.end(), column.begin(), column.end());
        columnStart.push_back(rows.size());
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
                updates.push_back((unsigned) slotOf(column[a], column[b]));
        updateStart.push_back(updates.size());
    }
    couplingStart.assign(size + 1, 0);
    for (const auto& coupling : couplings) { // which are in the order of their rows
        couplingSlots.push_back(
            (unsigned) slotOf(system.getConstraintOf(coupling.row), system.getConstraintOf(coupling.column)));
        couplingStart[system.getConstraintOf(coupling.row) + 1] = couplingSlots.size();
    }
    for (int k = 0; k < size; k++) // a constraint without any
        couplingStart[k + 1] = std::max(couplingStart[k], couplingStart[k + 1]);
    values.resize(numEntries + size);
    inversePivots.resize(size);
}

void ConstraintMatrix::factorize(const ConstraintSystem::Jacobian& jacobian) {
    const int failed = tryToFactorize(jacobian, ConstraintSystem::ALL);
    if (failed != REGULAR)
        throwDependent(failed, jacobian);
}

int ConstraintMatrix::tryToFactorize(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    const size_t numEntries = rows.size();
    const int first = part.first, end = std::min(part.end, system.getNumConstraints());
    double* diagonal = values.data() + numEntries;
    std::fill(values.begin() + columnStart[first], values.begin() + columnStart[end], 0.0);
    std::fill(diagonal + first, diagonal + end, 0.0);
    // Two constraints that share several particles have several couplings with one slot, which must add up.
    for (size_t i = couplingStart[first]; i < couplingStart[end]; i++)
        values[couplingSlots[i]] += couplings[i].factor * jacobian[couplings[i].row].dot(jacobian[couplings[i].column]);
    // The diagonal of K, to compare the pivots with, is kept where their inverses will be.
    std::copy(diagonal + first, diagonal + end, inversePivots.begin() + first);
    for (int column = first; column < end; column++) {
        const double pivot = diagonal[column];
        if (!(pivot > MIN_RELATIVE_PIVOT * inversePivots[column]))
            return column;
        const double inverse = 1 / pivot;
        inversePivots[column] = inverse;
        const size_t start = columnStart[column];
        const int count = (int) (columnStart[column + 1] - start);
        const unsigned* update = updates.data() + updateStart[column];
        double* entry = values.data() + start;
        for (int b = 0; b < count; b++) {
            const double scaled = entry[b] * inverse;
            for (int a = b; a < count; a++)
                values[*update++] -= entry[a] * scaled;
            entry[b] = scaled;
        }
    }
    return REGULAR;
}

void ConstraintMatrix::throwDependent(int constraint, const ConstraintSystem::Jacobian& jacobian) const {
    const vector<ConstraintSystem::Cluster>& clusters = system.getClusters();
    size_t c = 0;
    while (constraint >= clusters[c].first + clusters[c].size)
        c++;
    for (int k = clusters[c].first; k < clusters[c].first + clusters[c].size; k++) {
        const std::string explanation = system.explainGradient(k, jacobian);
        if (!explanation.empty())
            throw StepFailure(explanation);
    }
    throw DependentConstraints(system.getClusterParticles((int) c));
}

void ConstraintMatrix::solve(vector<double>& x, const ConstraintSystem::Part& part) const {
    const int end = std::min(part.end, system.getNumConstraints());
    for (int column = part.first; column < end; column++) {
        const double value = x[column];
        for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
            x[rows[i]] -= values[i] * value;
        x[column] = value * inversePivots[column];
    }
    for (int column = end - 1; column >= part.first; column--) {
        double value = x[column];
        for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
            value -= values[i] * x[rows[i]];
        x[column] = value;
    }
}
