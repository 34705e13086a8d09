// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// How clusters are found, cut and eliminated, against elimination in a dense matrix of what is zero and what is not.

#include "TestSupport.h"
#include "constraints/ClusterLayout.h"
#include <algorithm>
#include <set>

using namespace OpenMMVRattle;
using std::vector;

namespace {

typedef vector<vector<int>> Particles; // of each constraint

// A backbone of particles with an arm at each; a ring every so often; numbers of particles that are not neighbours.
Particles makeComb(int backbone, int arm, int ring) {
    Particles result;
    auto number = [&](int i) { return 10 + 7 * i; };
    for (int i = 0; i < backbone; i++) {
        const int first = i * (arm + 1);
        if (i > 0)
            result.push_back({number(first - arm - 1), number(first)});
        if (ring > 0 && i >= ring && i % ring == 0)
            result.push_back({number(first), number(first - ring * (arm + 1))});
        for (int k = 0; k < arm; k++)
            result.push_back({number(first + k + 1), number(first + k)});
    }
    return result;
}

// The chain of a rod: constraints of three particles each.
Particles makeTriples(int count) {
    Particles result;
    for (int i = 0; i < count; i++)
        result.push_back({i, i + 1, i + 2});
    return result;
}

void testElimination(const Particles& particlesOf, const ClusterCut& cut, ClusterElimination::Goal goal) {
    const ClusterElimination found(particlesOf, cut, goal);
    ASSERT_EQUAL(cut.pieces.size(), found.pieces.size());
    const int count = (int) particlesOf.size();
    // The rows of the whole matrix in their order: each constraint once, in the piece that it was in.
    vector<int> order, pieceOf, levels;
    for (size_t p = 0; p < found.pieces.size(); p++) {
        const ClusterElimination::Piece& piece = found.pieces[p];
        ASSERT(std::is_permutation(piece.constraints.begin(), piece.constraints.end(),
                                   cut.pieces[p].constraints.begin(), cut.pieces[p].constraints.end()));
        ASSERT(piece.particles == cut.pieces[p].particles);
        ASSERT_EQUAL(piece.numLevels, *std::max_element(piece.levels.begin(), piece.levels.end()) + 1);
        order.insert(order.end(), piece.constraints.begin(), piece.constraints.end());
        levels.insert(levels.end(), piece.levels.begin(), piece.levels.end());
        pieceOf.resize(order.size(), (int) p);
    }
    const int firstJoint = (int) order.size();
    ASSERT(std::is_permutation(found.joints.begin(), found.joints.end(), cut.joints.begin(), cut.joints.end()));
    order.insert(order.end(), found.joints.begin(), found.joints.end());
    levels.insert(levels.end(), found.jointLevels.begin(), found.jointLevels.end());
    pieceOf.resize(order.size(), -1);
    ASSERT_EQUAL(count, (int) order.size());
    ASSERT_EQUAL(count, (int) levels.size());

    vector<vector<char>> isCoupled(count, vector<char>(count, false));
    vector<std::set<int>> borders(found.pieces.size());
    for (int a = 0; a < count; a++)
        for (int b = 0; b < a; b++)
            for (int i : particlesOf[order[a]])
                if (std::count(particlesOf[order[b]].begin(), particlesOf[order[b]].end(), i) > 0)
                    isCoupled[a][b] = true;
    for (int b = 0; b < count; b++)
        for (int a = b + 1; a < count; a++) {
            if (!isCoupled[a][b])
                continue;
            for (int c = a + 1; c < count; c++)
                if (isCoupled[c][b])
                    isCoupled[c][a] = true; // fill
            if (a >= firstJoint && b < firstJoint)
                borders[pieceOf[b]].insert(a - firstJoint);
            else {
                ASSERT_EQUAL(pieceOf[a], pieceOf[b]); // pieces do not meet
                ASSERT(levels[a] > levels[b]);
            }
        }
    for (size_t p = 0; p < found.pieces.size(); p++)
        ASSERT(vector<int>(borders[p].begin(), borders[p].end()) == found.pieces[p].borders);
}

void testEliminations() {
    const Particles comb = makeComb(90, 2, 0), rings = makeComb(90, 2, 7), triples = makeTriples(200);
    for (ClusterElimination::Goal goal : {ClusterElimination::LeastFill, ClusterElimination::FewLevels})
        for (const Particles& cluster : {comb, rings, triples}) {
            testElimination(cluster, leaveWhole(cluster), goal);
            const ClusterCut cut = cutClusterAlongTree(cluster, 30);
            ASSERT(cut.pieces.size() > 3 && !cut.joints.empty());
            testElimination(cluster, cut, goal);
        }
    // Few levels where there can be few.
    const Particles chain = makeComb(1500, 0, 0);
    ASSERT(ClusterElimination(chain, leaveWhole(chain), ClusterElimination::FewLevels).pieces[0].numLevels <= 11);
    ASSERT(!ClusterElimination(chain, leaveWhole(chain), ClusterElimination::FewLevels).hasWideColumns);
    Particles star;
    for (int i = 1; i <= 60; i++)
        star.push_back({0, i});
    ASSERT(ClusterElimination(star, leaveWhole(star), ClusterElimination::LeastFill).hasWideColumns);
}

} // namespace

int main() {
    return runTests({{"eliminations", testEliminations}});
}
