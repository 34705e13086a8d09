// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The order of elimination, the pattern of a factor and the factor itself against dense algebra, without a step.

#include "Examples.h"
#include "TestSupport.h"
#include "constraints/ConstraintSystem.h"
#include "constraints/SparseFactor.h"
#include <Eigen/Dense>
#include <algorithm>
#include <set>

using namespace OpenMMVRattle;
using std::vector;

namespace {

Example dice;

// The entries below the diagonal of a graph's nodes in an order.
MatrixEntries reorder(const MatrixEntries& entries, const vector<int>& order) {
    vector<int> place(order.size());
    for (size_t i = 0; i < order.size(); i++)
        place[order[i]] = (int) i;
    MatrixEntries result;
    for (const auto& entry : entries)
        result.emplace_back(std::max(place[entry.first], place[entry.second]),
                            std::min(place[entry.first], place[entry.second]));
    return result;
}

MatrixEntries makeChain(int size) {
    MatrixEntries entries;
    for (int i = 1; i < size; i++)
        entries.emplace_back(i, i - 1);
    return entries;
}

MatrixEntries makeDense(int size) {
    MatrixEntries entries;
    for (int i = 0; i < size; i++)
        for (int j = 0; j < i; j++)
            entries.emplace_back(i, j);
    return entries;
}

// A cube of nodes, each joined to its neighbours: its factor has narrow columns and wide ones.
MatrixEntries makeCube(int edge) {
    MatrixEntries entries;
    auto node = [&](int x, int y, int z) { return (x * edge + y) * edge + z; };
    for (int x = 0; x < edge; x++)
        for (int y = 0; y < edge; y++)
            for (int z = 0; z < edge; z++) {
                if (x > 0)
                    entries.emplace_back(node(x, y, z), node(x - 1, y, z));
                if (y > 0)
                    entries.emplace_back(node(x, y, z), node(x, y - 1, z));
                if (z > 0)
                    entries.emplace_back(node(x, y, z), node(x, y, z - 1));
            }
    return entries;
}

Eigen::MatrixXd makeMatrix(int size, const MatrixEntries& entries) {
    Eigen::MatrixXd matrix = Eigen::MatrixXd::Zero(size, size);
    for (const auto& entry : entries)
        matrix(entry.first, entry.second) = matrix(entry.second, entry.first) = dice.uniform(-1, 1);
    for (int i = 0; i < size; i++)
        matrix(i, i) = 0.1 + matrix.row(i).cwiseAbs().sum();
    return matrix;
}

void put(const Eigen::MatrixXd& matrix, const MatrixEntries& entries, const FactorPattern& pattern,
         SparseFactor& factor) {
    factor.clear();
    for (const auto& entry : entries)
        factor.add(pattern.findSlot(entry.first, entry.second), matrix(entry.first, entry.second));
    for (int i = 0; i < pattern.getNumColumns(); i++)
        factor.add(pattern.findSlot(i, i), matrix(i, i));
    factor.keepDiagonal();
}

// The entries of L by its definition, from the rows that each elimination joins.
size_t countEntries(int size, const MatrixEntries& entries) {
    vector<std::set<int>> columns(size);
    size_t count = 0;
    for (const auto& entry : entries)
        columns[entry.second].insert(entry.first);
    for (int column = 0; column < size; column++) {
        count += columns[column].size();
        if (columns[column].empty())
            continue;
        const int parent = *columns[column].begin();
        columns[parent].insert(std::next(columns[column].begin()), columns[column].end());
    }
    return count;
}

} // namespace

void testOrder(int size, const MatrixEntries& entries, bool isWide) {
    const EliminationOrder order = findEliminationOrder(size, entries);
    ASSERT_EQUAL(isWide, order.numNarrow < size);
    vector<int> sorted = order.rows;
    std::sort(sorted.begin(), sorted.end());
    for (int i = 0; i < size; i++)
        ASSERT_EQUAL(i, sorted[i]);
    const MatrixEntries reordered = reorder(entries, order.rows);
    const EliminationTree tree = findEliminationTree(size, reordered);
    ASSERT_EQUAL(countEntries(size, reordered), tree.numEntries);
    ASSERT(tree.numEntries <= countEntries(size, entries));
    for (int column = 0; column < size; column++)
        ASSERT(column >= order.numNarrow || tree.counts[column] < EliminationOrder::WIDE);
    // Memory in proportion to the entries of L.
    const FactorColumns columns = findFactorColumns(size, 0, reordered);
    ASSERT_EQUAL(tree.numEntries, columns.rows.size());
    const FactorPattern pattern(columns);
    ASSERT_EQUAL(order.numNarrow, pattern.getNumNarrow());
    ASSERT(pattern.getNumValues() <=
           2.4 * (double) (tree.numEntries + size)); // the diagonal blocks of panels are whole
    ASSERT(pattern.getUpdates().size() <= EliminationOrder::WIDE / 2.0 * (double) tree.numEntries);
    size_t numSources = 0;
    for (const auto& list : pattern.getSources())
        numSources += list.size();
    ASSERT(numSources <= tree.numEntries);
}

// Levels as they are defined: none of two columns of one level is in the other's elimination.
static void checkLevels(int size, const MatrixEntries& entries, const EliminationOrder& order) {
    const MatrixEntries reordered = reorder(entries, order.rows);
    vector<std::set<int>> columns(size);
    for (const auto& entry : reordered)
        columns[entry.second].insert(entry.first);
    int highest = 0;
    for (int column = 0; column < size; column++) {
        for (int row : columns[column]) {
            ASSERT(order.levels[row] > order.levels[column]);
            columns[*columns[column].begin()].insert(row);
        }
        if (!columns[column].empty())
            columns[*columns[column].begin()].erase(*columns[column].begin());
        highest = std::max(highest, order.levels[column]);
    }
    ASSERT_EQUAL(highest + 1, order.numLevels);
}

// Rounds of independent eliminations: few levels for little fill.
void testRounds(int size, const MatrixEntries& entries, int maxLevels, double maxFill) {
    const EliminationOrder order = findEliminationRounds(size, entries);
    vector<int> sorted = order.rows;
    std::sort(sorted.begin(), sorted.end());
    for (int i = 0; i < size; i++)
        ASSERT_EQUAL(i, sorted[i]);
    checkLevels(size, entries, order);
    checkLevels(size, entries, findEliminationOrder(size, entries));
    ASSERT(std::is_sorted(order.levels.begin(), order.levels.end()));
    ASSERT(order.numLevels <= maxLevels);
    const size_t entriesOfFactor = findEliminationTree(size, reorder(entries, order.rows)).numEntries;
    ASSERT((double) (entriesOfFactor + size) <= maxFill * (double) (entries.size() + size));
}

// The same with rows that stay: they are in no level, and what is eliminated beside them gives the same levels by definition.
void testOuterRounds(int size, int numOuter, const MatrixEntries& given) {
    MatrixEntries entries = given;
    for (int row = 0; row < numOuter; row++)
        for (int k = 0; k < 3; k++)
            entries.emplace_back(size + row, (int) (dice.generator() % size));
    const EliminationOrder order = findEliminationRounds(size, entries, numOuter);
    ASSERT_EQUAL(size, (int) order.rows.size());
    vector<int> sorted = order.rows, all = order.rows;
    std::sort(sorted.begin(), sorted.end());
    for (int i = 0; i < size; i++)
        ASSERT_EQUAL(i, sorted[i]);
    for (int row = size; row < size + numOuter; row++)
        all.push_back(row);
    const EliminationTree tree = findEliminationTree(size + numOuter, reorder(entries, all));
    for (int column = 0; column < size; column++) {
        const int parent = tree.parent[column];
        ASSERT(parent == EliminationTree::NONE || parent >= size || order.levels[parent] > order.levels[column]);
    }
    ASSERT(std::is_sorted(order.levels.begin(), order.levels.end()));
}

// The couplings of the bonds of a comb: a molecule with side groups and rings of three.
MatrixEntries makeMolecule(int backbone, int& size) {
    const Example e = makeComb(backbone);
    const ConstraintSystem system(e.masses, e.distances);
    MatrixEntries entries;
    for (const auto& coupling : system.getCouplings()) {
        const int row = system.getConstraintOf(coupling.row), column = system.getConstraintOf(coupling.column);
        if (row != column)
            entries.emplace_back(row, column);
    }
    size = system.getNumConstraints();
    return entries;
}

void testFactor(int size, const MatrixEntries& given) {
    const MatrixEntries entries = reorder(given, findEliminationOrder(size, given).rows);
    const Eigen::MatrixXd matrix = makeMatrix(size, entries);
    const FactorPattern pattern(findFactorColumns(size, 0, entries));
    SparseFactor factor(pattern);
    const Eigen::VectorXd right = Eigen::VectorXd::LinSpaced(size, -1, 2);
    for (int repeat = 0; repeat < 2; repeat++) { // the second time on top of the first
        put(matrix, entries, pattern, factor);
        ASSERT_EQUAL(SparseFactor::REGULAR, factor.factorize(1e-10));
        Eigen::VectorXd x = right;
        factor.eliminate(x.data(), nullptr);
        factor.substitute(x.data(), nullptr);
        ASSERT((matrix * x - right).norm() <= 1e-12 * right.norm());
    }
    // Rows that are the same: the pivot of the second vanishes.
    Eigen::MatrixXd singular = matrix;
    const int last = size - 1;
    int other = last - 1;
    while (other > 0 && matrix(last, other) == 0)
        other--;
    singular.row(last).setZero();
    singular.col(last).setZero();
    singular(last, other) = singular(other, last) = singular(last, last) = 1;
    const Eigen::MatrixXd rest = singular.topLeftCorner(last, last);
    singular(last, last) = rest.ldlt().solve(Eigen::VectorXd::Unit(last, other))[other];
    put(singular, entries, pattern, factor);
    ASSERT_EQUAL(last, factor.factorize(1e-10));
}

// Rows that are not eliminated, as the joints at a piece: the Schur complement, and both halves of a solution.
void testOuterRows(int size, int numOuter, const MatrixEntries& given) {
    MatrixEntries entries = reorder(given, findEliminationOrder(size, given).rows);
    for (int row = 0; row < numOuter; row++)
        for (int k = 0; k < 5; k++)
            entries.emplace_back(size + row, (int) (dice.generator() % size));
    std::sort(entries.begin(), entries.end());
    entries.erase(std::unique(entries.begin(), entries.end()), entries.end());
    const Eigen::MatrixXd matrix = makeMatrix(size + numOuter, entries);
    const FactorPattern pattern(findFactorColumns(size, numOuter, entries), numOuter);
    SparseFactor factor(pattern);
    put(matrix, entries, pattern, factor);
    ASSERT_EQUAL(SparseFactor::REGULAR, factor.factorize(1e-10));
    const Eigen::MatrixXd inner = matrix.topLeftCorner(size, size), coupling = matrix.bottomLeftCorner(numOuter, size);
    const Eigen::LDLT<Eigen::MatrixXd> dense(inner);
    const Eigen::MatrixXd left = -coupling * dense.solve(coupling.transpose());
    Eigen::MatrixXd found = left;
    for (int b = 0; b < numOuter; b++)
        for (int a = b; a < numOuter; a++)
            found(a, b) = found(b, a) = factor.getValue(pattern.findSlot(size + a, size + b));
    ASSERT((found - left).norm() <= 1e-12 * left.norm());
    const Eigen::VectorXd right = Eigen::VectorXd::LinSpaced(size, -1, 2),
                          outer = Eigen::VectorXd::LinSpaced(numOuter, 1, 3);
    Eigen::VectorXd x = right, sum = Eigen::VectorXd::Zero(numOuter);
    factor.eliminate(x.data(), sum.data());
    ASSERT((sum + coupling * dense.solve(right)).norm() <= 1e-12 * right.norm());
    factor.substitute(x.data(), outer.data());
    ASSERT((inner * x + coupling.transpose() * outer - right).norm() <= 1e-12 * right.norm());
}

int main() {
    return runTests({
        {"order, a chain", [] { testOrder(300, makeChain(300), false); }},
        {"order, a dense matrix", [] { testOrder(150, makeDense(150), true); }},
        {"order, a cube", [] { testOrder(1000, makeCube(10), true); }},
        {"rounds, a chain", [] { testRounds(1500, makeChain(1500), 11, 1.6); }},
        {"rounds, a long chain", [] { testRounds(10000, makeChain(10000), 14, 1.6); }},
        {"rounds, a molecule",
         [] {
             int size;
             const MatrixEntries entries = makeMolecule(1500, size);
             testRounds(size, entries, 20, 1.5);
         }},
        {"rounds, a dense matrix", [] { testRounds(60, makeDense(60), 60, 1.0); }},
        {"rounds beside outer rows, a chain", [] { testOuterRounds(300, 5, makeChain(300)); }},
        {"rounds beside outer rows, a cube", [] { testOuterRounds(512, 40, makeCube(8)); }},
        {"rounds, a cube", [] { testRounds(1000, makeCube(10), 400, 100); }},
        {"factor, a chain", [] { testFactor(300, makeChain(300)); }},
        {"factor, a dense matrix", [] { testFactor(150, makeDense(150)); }},
        {"factor, a cube", [] { testFactor(1000, makeCube(10)); }},
        {"factor, one row", [] { testFactor(2, makeChain(2)); }},
        {"outer rows, a chain", [] { testOuterRows(300, 3, makeChain(300)); }},
        {"outer rows, a cube", [] { testOuterRows(512, 40, makeCube(8)); }},
    });
}
