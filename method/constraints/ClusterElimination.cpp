// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterElimination.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <utility>

using namespace OpenMMVRattle;
using std::vector;

namespace {

// The rows that share a particle, the later first.
MatrixEntries coupleRows(vector<std::pair<int, int>> ends) { // particles and rows
    std::sort(ends.begin(), ends.end());
    MatrixEntries entries;
    for (size_t a = 0; a < ends.size(); a++)
        for (size_t b = a; b > 0 && ends[b - 1].first == ends[a].first; b--)
            if (ends[b - 1].second < ends[a].second)
                entries.emplace_back(ends[a].second, ends[b - 1].second);
    std::sort(entries.begin(), entries.end());
    entries.erase(std::unique(entries.begin(), entries.end()), entries.end());
    return entries;
}

EliminationOrder findOrder(int size, const MatrixEntries& entries, int numOuter, ClusterElimination::Goal goal) {
    if (goal == ClusterElimination::FewLevels)
        return findEliminationRounds(size, entries, numOuter);
    MatrixEntries inner;
    std::copy_if(entries.begin(), entries.end(), std::back_inserter(inner),
                 [&](const std::pair<int, int>& entry) { return entry.first < size; });
    return findEliminationOrder(size, inner);
}

// The entries when rows have got other places.
MatrixEntries renumber(const MatrixEntries& entries, const vector<int>& places) {
    MatrixEntries result;
    for (const auto& entry : entries) {
        const int a = places[entry.first], b = places[entry.second];
        result.emplace_back(std::max(a, b), std::min(a, b));
    }
    std::sort(result.begin(), result.end());
    return result;
}

// The place of each row in an order; outer rows stay behind.
vector<int> findPlaces(const vector<int>& order, int numOuter) {
    vector<int> places(order.size() + numOuter);
    std::iota(places.begin(), places.end(), 0);
    for (size_t place = 0; place < order.size(); place++)
        places[order[place]] = (int) place;
    return places;
}

// What is left between outer rows: the matrix's own entries, and those that the columns fill in. Any other column hands its own on.
MatrixEntries findOuterEntries(int size, const MatrixEntries& entries, const FactorColumns& columns) {
    MatrixEntries result;
    std::copy_if(entries.begin(), entries.end(), std::back_inserter(result),
                 [&](const std::pair<int, int>& entry) { return entry.second >= size; });
    for (int column = 0; column < size; column++)
        if (columns.getParent(column) >= size)
            for (const int* a = columns.begin(column); a != columns.end(column); ++a)
                for (const int* b = columns.begin(column); b != a; ++b)
                    result.emplace_back(*a, *b);
    std::sort(result.begin(), result.end());
    result.erase(std::unique(result.begin(), result.end()), result.end());
    return result;
}

} // namespace

ClusterElimination::ClusterElimination(const vector<vector<int>>& particlesOf, const ClusterCut& cut, Goal goal) {
    std::map<int, int> pieceOf; // of the particles at joints
    for (int k : cut.joints)
        for (int i : particlesOf[k])
            pieceOf[i] = -1;
    for (size_t p = 0; p < cut.pieces.size() && !pieceOf.empty(); p++)
        for (int i : cut.pieces[p].particles) {
            const auto found = pieceOf.find(i);
            if (found != pieceOf.end())
                found->second = (int) p;
        }
    vector<vector<int>> borders(cut.pieces.size());
    for (size_t j = 0; j < cut.joints.size(); j++)
        for (int i : particlesOf[cut.joints[j]]) {
            vector<int>& list = borders[pieceOf.at(i)];
            if (list.empty() || list.back() != (int) j)
                list.push_back((int) j);
        }

    MatrixEntries coupled; // joints
    vector<MatrixEntries> entriesOf;
    for (size_t p = 0; p < cut.pieces.size(); p++) {
        const vector<int>& members = cut.pieces[p].constraints;
        const int size = (int) members.size(), numBorders = (int) borders[p].size();
        vector<std::pair<int, int>> ends;
        for (int row = 0; row < size; row++)
            for (int i : particlesOf[members[row]])
                ends.emplace_back(i, row);
        for (int b = 0; b < numBorders; b++)
            for (int i : particlesOf[cut.joints[borders[p][b]]])
                if (pieceOf.at(i) == (int) p)
                    ends.emplace_back(i, size + b);
        const MatrixEntries entries = coupleRows(std::move(ends));
        const EliminationOrder order = findOrder(size, entries, numBorders, goal);
        Piece piece = {{}, order.levels, order.numLevels, cut.pieces[p].particles, borders[p], {}, {}};
        for (int row : order.rows)
            piece.constraints.push_back(members[row]);
        entriesOf.push_back(renumber(entries, findPlaces(order.rows, numBorders)));
        piece.columns = findFactorColumns(size, numBorders, entriesOf.back());
        piece.borderEntries = findOuterEntries(size, entriesOf.back(), piece.columns);
        for (const auto& entry : piece.borderEntries)
            coupled.emplace_back(borders[p][entry.first - size], borders[p][entry.second - size]);
        hasWideColumns = hasWideColumns || order.numNarrow < size;
        pieces.push_back(std::move(piece));
    }
    if (cut.joints.empty())
        return;

    std::sort(coupled.begin(), coupled.end());
    coupled.erase(std::unique(coupled.begin(), coupled.end()), coupled.end());
    const EliminationOrder order = findOrder((int) cut.joints.size(), coupled, 0, goal);
    const vector<int> places = findPlaces(order.rows, 0);
    for (int row : order.rows)
        joints.push_back(cut.joints[row]);
    jointLevels = order.levels;
    numJointLevels = order.numLevels;
    jointColumns = findFactorColumns((int) joints.size(), 0, renumber(coupled, places));
    // The borders in the order of the joints' elimination too.
    for (size_t p = 0; p < pieces.size(); p++) {
        Piece& piece = pieces[p];
        const int size = (int) piece.constraints.size(), numBorders = (int) piece.borders.size();
        for (int& border : piece.borders)
            border = places[border];
        vector<int> sorted(numBorders), rows(size + numBorders);
        std::iota(sorted.begin(), sorted.end(), 0);
        std::sort(sorted.begin(), sorted.end(), [&](int a, int b) { return piece.borders[a] < piece.borders[b]; });
        std::iota(rows.begin(), rows.end(), 0);
        for (int b = 0; b < numBorders; b++)
            rows[size + sorted[b]] = size + b;
        std::sort(piece.borders.begin(), piece.borders.end());
        piece.columns = findFactorColumns(size, numBorders, renumber(entriesOf[p], rows));
        piece.borderEntries = renumber(piece.borderEntries, rows);
    }
}
