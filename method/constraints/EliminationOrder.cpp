// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/EliminationOrder.h"
#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>
#include <algorithm>
#include <numeric>

using std::vector;

namespace OpenMMVRattle {

namespace {

// The entries after row order[i] has become row i.
MatrixEntries reorder(const MatrixEntries& entries, const vector<int>& order) {
    vector<int> place(order.size());
    for (size_t i = 0; i < order.size(); i++)
        place[order[i]] = (int) i;
    MatrixEntries result;
    for (const auto& entry : entries) {
        const int a = place[entry.first], b = place[entry.second];
        result.emplace_back(std::max(a, b), std::min(a, b));
    }
    return result;
}

vector<int> findMinimumDegreeOrder(int size, const MatrixEntries& entries) {
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

// The wide columns, each after all those below it in the tree. The last one before a column is one with the same entries, if there is
// any.
vector<int> orderWide(const EliminationTree& tree, const vector<char>& isWide) {
    const int size = (int) isWide.size();
    vector<vector<int>> children(size);
    vector<int> stack, result;
    for (int column = size - 1; column >= 0; column--) // so that the first child is taken from the stack first
        if (isWide[column]) {
            const int parent = tree.parent[column];
            if (parent == EliminationTree::NONE)
                stack.push_back(column);
            else
                children[parent].push_back(column);
        }
    for (int column = 0; column < size; column++) {
        const auto same = std::find_if(children[column].begin(), children[column].end(),
                                       [&](int child) { return tree.counts[child] == tree.counts[column] + 1; });
        if (same != children[column].end())
            std::rotate(children[column].begin(), same, same + 1);
    }
    // A column comes twice: at first its children are put before it.
    vector<char> isOpen(size, false);
    while (!stack.empty()) {
        const int column = stack.back();
        if (isOpen[column]) {
            result.push_back(column);
            stack.pop_back();
            continue;
        }
        isOpen[column] = true;
        stack.insert(stack.end(), children[column].begin(), children[column].end());
    }
    return result;
}

} // namespace

namespace {

/** The entries of a matrix row by row. */
struct MatrixRows {
    MatrixRows(int size, const MatrixEntries& entries) : start(size + 1, 0), columns(entries.size()) {
        for (const auto& entry : entries)
            start[entry.first + 1]++;
        std::partial_sum(start.begin(), start.end(), start.begin());
        vector<size_t> next(start.begin(), start.end() - 1);
        for (const auto& entry : entries)
            columns[next[entry.first]++] = entry.second;
    }
    vector<size_t> start;
    vector<int> columns;
};

// By the algorithm of Liu (ACM Trans. Math. Softw. 12, 1986).
vector<int> findParents(const MatrixRows& rows) {
    const int NONE = EliminationTree::NONE, size = (int) rows.start.size() - 1;
    vector<int> parent(size, NONE), ancestor(size, NONE);
    for (int row = 0; row < size; row++)
        for (size_t k = rows.start[row]; k < rows.start[row + 1]; k++) {
            int column = rows.columns[k];
            while (ancestor[column] != NONE && ancestor[column] != row)
                column = std::exchange(ancestor[column], row);
            if (ancestor[column] == NONE)
                ancestor[column] = parent[column] = row;
        }
    return parent;
}

// Walk along the entries of L in the first columns, row by row: task(row, column), until it returns false at the end of a row.
template <class Task, class RowTask>
void walkThroughFactor(const MatrixRows& rows, const vector<int>& parent, int numColumns, const Task& task,
                       const RowTask& goesOn) {
    const int size = (int) parent.size();
    vector<int> visited(size, EliminationTree::NONE);
    for (int row = 0; row < size && goesOn(); row++) {
        visited[row] = row;
        for (size_t k = rows.start[row]; k < rows.start[row + 1]; k++)
            for (int column = rows.columns[k]; column < numColumns && visited[column] != row; column = parent[column]) {
                visited[column] = row;
                task(row, column);
            }
    }
}

} // namespace

EliminationTree findEliminationTree(int size, const MatrixEntries& entries, size_t maxEntries) {
    const MatrixRows rows(size, entries);
    EliminationTree tree = {findParents(rows), vector<int>(size, 0), 0};
    auto count = [&](int, int column) {
        tree.counts[column]++;
        tree.numEntries++;
    };
    walkThroughFactor(rows, tree.parent, size, count, [&] { return tree.numEntries <= maxEntries; });
    return tree;
}

FactorColumns findFactorColumns(int numColumns, int numOuter, const MatrixEntries& entries) {
    const MatrixRows rows(numColumns + numOuter, entries);
    const vector<int> parent = findParents(rows);
    auto always = [] { return true; };
    FactorColumns result;
    result.start.assign(numColumns + 1, 0);
    walkThroughFactor(rows, parent, numColumns, [&](int, int column) { result.start[column + 1]++; }, always);
    std::partial_sum(result.start.begin(), result.start.end(), result.start.begin());
    result.rows.resize(result.start.back());
    vector<size_t> next(result.start.begin(), result.start.end() - 1);
    walkThroughFactor(
        rows, parent, numColumns, [&](int row, int column) { result.rows[next[column]++] = row; }, always);
    return result;
}

void FactorColumns::append(const FactorColumns& other) {
    const int first = getNumColumns();
    const size_t firstEntry = rows.size();
    for (int row : other.rows)
        rows.push_back(first + row);
    for (size_t k = 1; k < other.start.size(); k++)
        start.push_back(firstEntry + other.start[k]);
}

namespace {

vector<int> findLevels(const EliminationTree& tree) {
    vector<int> levels(tree.parent.size(), 0);
    for (size_t column = 0; column < levels.size(); column++)
        if (tree.parent[column] != EliminationTree::NONE)
            levels[tree.parent[column]] = std::max(levels[tree.parent[column]], levels[column] + 1);
    return levels;
}

// Put an order whose tree is known into that of places, which are numbers of its columns.
EliminationOrder arrange(const vector<int>& order, const vector<int>& levels, const vector<int>& places,
                         int numNarrow) {
    EliminationOrder result;
    result.numNarrow = numNarrow;
    result.numLevels = 0;
    for (int place : places) {
        result.rows.push_back(order[place]);
        result.levels.push_back(levels[place]);
        result.numLevels = std::max(result.numLevels, levels[place] + 1);
    }
    return result;
}

} // namespace

EliminationOrder findEliminationOrder(int size, const MatrixEntries& entries) {
    vector<int> order(size);
    std::iota(order.begin(), order.end(), 0);
    EliminationTree tree = findEliminationTree(size, entries, entries.size());
    if (tree.numEntries > entries.size()) { // there is fill, so another order may have less
        vector<int> other = findMinimumDegreeOrder(size, entries);
        EliminationTree otherTree = findEliminationTree(size, reorder(entries, other));
        tree = findEliminationTree(size, entries, otherTree.numEntries);
        if (otherTree.numEntries < tree.numEntries) {
            order.swap(other);
            tree = std::move(otherTree);
        }
    }
    const vector<int> levels = findLevels(tree);
    vector<int> places;
    vector<char> isWide(size);
    for (int column = 0; column < size; column++) {
        isWide[column] = isWide[column] || tree.counts[column] >= EliminationOrder::WIDE;
        if (!isWide[column])
            places.push_back(column);
        const int parent = tree.parent[column];
        if (parent != EliminationTree::NONE)
            isWide[parent] = isWide[parent] || isWide[column];
    }
    std::stable_sort(places.begin(), places.end(), [&](int a, int b) { return levels[a] < levels[b]; });
    const int numNarrow = (int) places.size();
    const vector<int> wide = orderWide(tree, isWide);
    places.insert(places.end(), wide.begin(), wide.end());
    return arrange(order, levels, places, numNarrow);
}

namespace {

// Those that are eliminated in a round are of the few couplings, or of no more than the given share of all rows have.
EliminationOrder eliminateInRounds(int size, const MatrixEntries& entries, int numOuter, double share) {
    const size_t FEW = 5;
    vector<vector<int>> neighbours(size + numOuter); // of what is left, sorted
    for (const auto& entry : entries) {
        neighbours[entry.first].push_back(entry.second);
        neighbours[entry.second].push_back(entry.first);
    }
    auto sortUnique = [](vector<int>& list) {
        std::sort(list.begin(), list.end());
        list.erase(std::unique(list.begin(), list.end()), list.end());
    };
    vector<int> order, left(size), chosen, candidates, joined;
    vector<size_t> degrees;
    std::iota(left.begin(), left.end(), 0);
    std::for_each(neighbours.begin(), neighbours.end(), sortUnique);
    vector<int> blockedIn(size + numOuter, -1); // the round in which a neighbour has been chosen
    vector<char> isGone(size, false);
    for (int round = 0; !left.empty(); round++) {
        auto degree = [&](int row) { return neighbours[row].size(); };
        degrees.clear();
        for (int row : left)
            degrees.push_back(degree(row));
        if (*std::min_element(degrees.begin(), degrees.end()) >= (size_t) EliminationOrder::WIDE)
            break;
        const auto last = degrees.begin() + (int) (share * (double) (degrees.size() - 1));
        std::nth_element(degrees.begin(), last, degrees.end());
        const size_t most = std::max(*last, FEW);
        candidates.clear();
        std::copy_if(left.begin(), left.end(), std::back_inserter(candidates),
                     [&](int row) { return degree(row) <= most; });
        std::stable_sort(candidates.begin(), candidates.end(), [&](int a, int b) { return degree(a) < degree(b); });
        chosen.clear();
        for (int row : candidates)
            if (blockedIn[row] != round) {
                chosen.push_back(row);
                for (int other : neighbours[row])
                    blockedIn[other] = round;
            }
        for (int row : chosen) {
            order.push_back(row);
            isGone[row] = true;
            for (int other : neighbours[row]) {
                joined.clear();
                std::set_union(neighbours[other].begin(), neighbours[other].end(), neighbours[row].begin(),
                               neighbours[row].end(), std::back_inserter(joined));
                joined.erase(std::remove_if(joined.begin(), joined.end(),
                                            [&](int each) { return each == row || each == other; }),
                             joined.end());
                neighbours[other].swap(joined);
            }
        }
        left.erase(std::remove_if(left.begin(), left.end(), [&](int row) { return isGone[row] != 0; }), left.end());
    }
    if (!left.empty()) {
        MatrixEntries rest;
        vector<int> placeOf(size + numOuter, size); // an outer row is behind all
        for (size_t k = 0; k < left.size(); k++)
            placeOf[left[k]] = (int) k;
        for (int row : left)
            for (int other : neighbours[row])
                if (placeOf[other] < placeOf[row])
                    rest.emplace_back(placeOf[row], placeOf[other]);
        for (int place : findEliminationOrder((int) left.size(), rest).rows)
            order.push_back(left[place]);
    }
    for (int row = size; row < size + numOuter; row++)
        order.push_back(row);
    const EliminationTree tree = findEliminationTree(size + numOuter, reorder(entries, order));
    const vector<int> levels = findLevels(tree);
    vector<int> places(size);
    std::iota(places.begin(), places.end(), 0);
    std::stable_sort(places.begin(), places.end(), [&](int a, int b) { return levels[a] < levels[b]; });
    const auto wide = std::find_if(places.begin(), places.end(),
                                   [&](int place) { return tree.counts[place] >= EliminationOrder::WIDE; });
    return arrange(order, levels, places, (int) (wide - places.begin()));
}

} // namespace

EliminationOrder findEliminationRounds(int size, const MatrixEntries& entries, int numOuter) {
    const EliminationOrder careful = eliminateInRounds(size, entries, numOuter, 0);
    const EliminationOrder eager = eliminateInRounds(size, entries, numOuter, 0.5);
    return 2 * eager.numLevels < careful.numLevels ? eager : careful;
}

} // namespace OpenMMVRattle
