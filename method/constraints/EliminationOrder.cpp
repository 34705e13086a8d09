// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/EliminationOrder.h"
#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>
#include <algorithm>
#include <numeric>

using std::pair;
using std::vector;

namespace OpenMMVRattle {

namespace {

// The entries after row order[i] has become row i.
vector<pair<int, int>> reorder(const vector<pair<int, int>>& entries, const vector<int>& order) {
    vector<int> place(order.size());
    for (size_t i = 0; i < order.size(); i++)
        place[order[i]] = (int) i;
    vector<pair<int, int>> result;
    for (const auto& entry : entries) {
        const int a = place[entry.first], b = place[entry.second];
        result.emplace_back(std::max(a, b), std::min(a, b));
    }
    return result;
}

size_t countEntries(const vector<vector<int>>& pattern) {
    size_t count = 0;
    for (const auto& column : pattern)
        count += column.size();
    return count;
}

vector<int> findMinimumDegreeOrder(int size, const vector<pair<int, int>>& entries) {
    vector<Eigen::Triplet<double>> triplets;
    for (int i = 0; i < size; i++)
        triplets.emplace_back(i, i, 1.0);
    for (const auto& entry : entries) {
        triplets.emplace_back(entry.first, entry.second, 1.0);
        triplets.emplace_back(entry.second, entry.first, 1.0);
    }
    Eigen::SparseMatrix<double> matrix(size, size);
    matrix.setFromTriplets(triplets.begin(), triplets.end());
    Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, int> permutation;
    Eigen::AMDOrdering<int>()(matrix, permutation);
    return vector<int>(permutation.indices().data(), permutation.indices().data() + size);
}

} // namespace

vector<vector<int>> findFactorPattern(int size, const vector<pair<int, int>>& entries) {
    vector<vector<int>> pattern(size), children(size);
    for (const auto& entry : entries)
        pattern[entry.second].push_back(entry.first);
    for (int column = 0; column < size; column++) {
        // What the columns below it in the elimination tree leave, beside the matrix's own entries.
        vector<int>& rows = pattern[column];
        for (int child : children[column])
            rows.insert(rows.end(), pattern[child].begin() + 1, pattern[child].end());
        std::sort(rows.begin(), rows.end());
        rows.erase(std::unique(rows.begin(), rows.end()), rows.end());
        if (!rows.empty())
            children[rows[0]].push_back(column);
    }
    return pattern;
}

vector<int> findEliminationOrder(int size, const vector<pair<int, int>>& entries) {
    vector<int> order(size);
    std::iota(order.begin(), order.end(), 0);
    vector<vector<int>> pattern = findFactorPattern(size, entries);
    if (countEntries(pattern) > entries.size()) { // there is fill, so another order may have less
        vector<int> other = findMinimumDegreeOrder(size, entries);
        vector<vector<int>> otherPattern = findFactorPattern(size, reorder(entries, other));
        if (countEntries(otherPattern) < countEntries(pattern)) {
            order.swap(other);
            pattern.swap(otherPattern);
        }
    }
    vector<int> level(size, 0), places(size);
    for (int column = 0; column < size; column++)
        if (!pattern[column].empty())
            level[pattern[column][0]] = std::max(level[pattern[column][0]], level[column] + 1);
    std::iota(places.begin(), places.end(), 0);
    std::stable_sort(places.begin(), places.end(), [&](int a, int b) { return level[a] < level[b]; });
    for (int& place : places)
        place = order[place];
    return places;
}

} // namespace OpenMMVRattle
