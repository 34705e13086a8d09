// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterElimination.h"
#include "constraints/EliminationOrder.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <utility>

using namespace OpenMMVRattle;
using std::vector;

namespace {

typedef std::set<std::pair<int, int>> Pairs;

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

// The outer rows that are coupled when the others have been eliminated: those with a path between them through these.
void coupleOuter(int size, const MatrixEntries& entries, const vector<int>& outer, Pairs& coupled) {
    vector<int> parents(size);
    std::iota(parents.begin(), parents.end(), 0);
    auto find = [&](int row) {
        while (parents[row] != row)
            row = parents[row] = parents[parents[row]];
        return row;
    };
    for (const auto& entry : entries)
        if (entry.first < size)
            parents[find(entry.first)] = find(entry.second);
    std::map<int, std::set<int>> reached; // by what hangs together
    auto couple = [&](int a, int b) {
        if (a != b)
            coupled.emplace(std::max(a, b), std::min(a, b));
    };
    for (const auto& entry : entries)
        if (entry.second >= size)
            couple(outer[entry.first - size], outer[entry.second - size]);
        else if (entry.first >= size)
            reached[find(entry.second)].insert(outer[entry.first - size]);
    for (const auto& each : reached)
        for (int a : each.second)
            for (int b : each.second)
                couple(a, b);
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

    Pairs coupled;
    for (size_t p = 0; p < cut.pieces.size(); p++) {
        const vector<int>& members = cut.pieces[p].constraints;
        const int size = (int) members.size();
        vector<std::pair<int, int>> ends;
        for (int row = 0; row < size; row++)
            for (int i : particlesOf[members[row]])
                ends.emplace_back(i, row);
        for (size_t b = 0; b < borders[p].size(); b++)
            for (int i : particlesOf[cut.joints[borders[p][b]]])
                if (pieceOf.at(i) == (int) p)
                    ends.emplace_back(i, size + (int) b);
        const MatrixEntries entries = coupleRows(std::move(ends));
        const EliminationOrder order = findOrder(size, entries, (int) borders[p].size(), goal);
        Piece piece = {{}, order.levels, order.numLevels, cut.pieces[p].particles, {}};
        for (int row : order.rows)
            piece.constraints.push_back(members[row]);
        pieces.push_back(std::move(piece));
        hasWideColumns = hasWideColumns || order.numNarrow < size;
        coupleOuter(size, entries, borders[p], coupled);
    }

    const EliminationOrder order = findOrder((int) cut.joints.size(), {coupled.begin(), coupled.end()}, 0, goal);
    vector<int> places(cut.joints.size());
    for (size_t place = 0; place < places.size(); place++) {
        joints.push_back(cut.joints[order.rows[place]]);
        places[order.rows[place]] = (int) place;
    }
    jointLevels = order.levels;
    numJointLevels = order.numLevels;
    for (size_t p = 0; p < pieces.size(); p++) {
        for (int j : borders[p])
            pieces[p].borders.push_back(places[j]);
        std::sort(pieces[p].borders.begin(), pieces[p].borders.end());
    }
}
