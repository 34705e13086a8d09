// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// How clusters are found, sorted into kinds, cut and eliminated, against searches by definition and elimination in a dense matrix of
// what is zero and what is not.

#include "Examples.h"
#include "TestSupport.h"
#include "constraints/ClusterLayout.h"
#include <algorithm>
#include <array>
#include <set>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

typedef vector<vector<int>> Particles; // of each constraint

// A backbone of particles with an arm at each; a ring every so often; numbers of particles that are not neighbours.
Particles makeMolecule(int backbone, int arm, int ring) {
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

// A rod: sections of three particles that distances keep rigid, each joined to the next by three constraints of all of their particles.
Particles makeSections(int numSections) {
    Particles result;
    for (int i = 0; i < 3 * numSections; i += 3) {
        result.insert(result.end(), {{i, i + 1}, {i, i + 2}, {i + 1, i + 2}});
        result.insert(result.end(), i > 0 ? 3 : 0, {i - 3, i - 2, i - 1, i, i + 1, i + 2});
    }
    return result;
}

// A chain with the distances between next neighbours too.
Particles makeStiffChain(int length) {
    Particles result = {{0, 1}};
    for (int i = 2; i <= length; i++)
        result.insert(result.end(), {{i - 2, i}, {i - 1, i}});
    return result;
}

// Rigid tetrahedra in a row, each with a corner of the next.
Particles makeTetrahedra(int count) {
    Particles result;
    for (int i = 0; i < 3 * count; i += 3)
        for (int j = i; j < i + 4; j++)
            for (int k = i; k < j; k++)
                result.push_back({k, j});
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

    vector<vector<char>> isCoupled(count, vector<char>(count, false)), isLeft; // by the pieces
    vector<std::set<int>> borders(
        found.pieces.size()); // joints that have a particle of the piece, coupled to its rows or not
    for (size_t p = 0; p < found.pieces.size(); p++)
        for (size_t j = 0; j < found.joints.size(); j++)
            for (int i : particlesOf[found.joints[j]])
                if (std::count(found.pieces[p].particles.begin(), found.pieces[p].particles.end(), i) > 0)
                    borders[p].insert((int) j);
    for (int a = 0; a < count; a++)
        for (int b = 0; b < a; b++)
            for (int i : particlesOf[order[a]])
                if (std::count(particlesOf[order[b]].begin(), particlesOf[order[b]].end(), i) > 0)
                    isCoupled[a][b] = true;
    for (int b = 0; b < count; b++) {
        if (b == firstJoint)
            isLeft = isCoupled;
        for (int a = b + 1; a < count; a++) {
            if (!isCoupled[a][b])
                continue;
            for (int c = a + 1; c < count; c++)
                if (isCoupled[c][b])
                    isCoupled[c][a] = true; // fill
            if (a >= firstJoint && b < firstJoint) {
                ASSERT(borders[pieceOf[b]].count(a - firstJoint) > 0);
            }
            else {
                ASSERT_EQUAL(pieceOf[a], pieceOf[b]); // pieces do not meet
                ASSERT(levels[a] > levels[b]);
            }
        }
    }
    // Exactly those entries are listed, by rows of the whole.
    vector<vector<char>> isListed(count, vector<char>(count, false)), isListedLeft = isListed;
    auto list = [&](const FactorColumns& columns, int first, auto rowOf) {
        for (int column = 0; column < columns.getNumColumns(); column++) {
            ASSERT(std::is_sorted(columns.begin(column), columns.end(column)));
            for (const int* row = columns.begin(column); row != columns.end(column); ++row) {
                ASSERT(!isListed[rowOf(*row)][first + column]);
                ASSERT_EQUAL((size_t) (row - columns.rows.data()), columns.find(*row, column));
                isListed[rowOf(*row)][first + column] = true;
            }
        }
    };
    int first = 0;
    for (size_t p = 0; p < found.pieces.size(); p++) {
        const ClusterElimination::Piece& piece = found.pieces[p];
        ASSERT(vector<int>(borders[p].begin(), borders[p].end()) == piece.borders);
        const int size = (int) piece.constraints.size();
        auto rowOf = [&](int row) { return row < size ? first + row : firstJoint + piece.borders[row - size]; };
        list(piece.columns, first, rowOf);
        ASSERT(std::is_sorted(piece.borderEntries.begin(), piece.borderEntries.end()));
        for (const auto& entry : piece.borderEntries)
            isListedLeft[rowOf(entry.first)][rowOf(entry.second)] = true;
        first += size;
    }
    list(found.jointColumns, firstJoint, [&](int row) { return firstJoint + row; });
    for (int a = 0; a < count; a++)
        for (int b = 0; b < a; b++) {
            ASSERT_EQUAL((int) isCoupled[a][b], (int) isListed[a][b]);
            ASSERT(b < firstJoint || isLeft[a][b] == isListedLeft[a][b]);
        }
}

void testEliminations() {
    const Particles comb = makeMolecule(90, 2, 0), rings = makeMolecule(90, 2, 7), triples = makeTriples(200);
    const Particles rod = makeSections(50), stiff = makeStiffChain(150), tetrahedra = makeTetrahedra(50);
    for (ClusterElimination::Goal goal : {ClusterElimination::LeastFill, ClusterElimination::FewLevels})
        for (const Particles& cluster : {comb, rings, triples, rod, stiff, tetrahedra}) {
            testElimination(cluster, leaveWhole(cluster), goal);
            const ClusterCut cut = cutClusterAlongTree(cluster, 30);
            ASSERT(cut.pieces.size() > 3 && !cut.joints.empty());
            testElimination(cluster, cut, goal);
        }
    // Few levels where there can be few, of a whole cluster and in pieces.
    ClusterKind chain;
    chain.particlesOf = makeMolecule(1500, 0, 0);
    const ClusterElimination whole = chain.eliminateInRounds(), inPieces = chain.eliminateInRounds(100);
    ASSERT(whole.pieces.size() == 1 && whole.joints.empty() && !whole.hasWideColumns);
    ASSERT(whole.pieces[0].numLevels <= 11);
    ASSERT(inPieces.pieces.size() > 10);
    size_t count = inPieces.joints.size();
    for (const ClusterElimination::Piece& piece : inPieces.pieces) {
        ASSERT(piece.constraints.size() <= 150 && piece.numLevels <= 8);
        count += piece.constraints.size();
    }
    ASSERT_EQUAL(chain.particlesOf.size(), count);
    // So it is where there are more couplings, and fewer of them at the ends: a few levels more for twice the length.
    for (Particles (*make)(int) : {makeSections, makeStiffChain, makeTetrahedra}) {
        std::array<int, 2> levels;
        for (int n : {0, 1}) {
            const Particles cluster = make(n == 0 ? 500 : 1000);
            const ClusterElimination found(cluster, leaveWhole(cluster), ClusterElimination::FewLevels);
            ASSERT(!found.hasWideColumns && found.pieces[0].columns.rows.size() <= 12 * cluster.size());
            levels[n] = found.pieces[0].numLevels;
        }
        ASSERT(levels[1] <= 40 && levels[1] <= levels[0] + 4);
    }
    Particles star;
    for (int i = 1; i <= 60; i++)
        star.push_back({0, i});
    ASSERT(ClusterElimination(star, leaveWhole(star), ClusterElimination::LeastFill).hasWideColumns);
}

Particles findMovingParticles(const Example& e) {
    Particles result;
    for (const DistanceConstraint& c : e.distances)
        result.push_back({c.particle1, c.particle2});
    for (const ExpressionConstraint& c : e.expressions)
        result.push_back(c.particles);
    for (vector<int>& list : result)
        list.erase(std::remove_if(list.begin(), list.end(), [&](int i) { return e.masses[i] == 0; }), list.end());
    return result;
}

// Each particle that moves and each constraint between such is in one cluster; all are as the graph of their kind says; and a cluster
// is what hangs together.
void testLayout(const Example& e) {
    const ClusterLayout layout(e.masses, e.distances, e.expressions);
    const Particles particlesOf = findMovingParticles(e);
    vector<int> clusterOf(e.masses.size(), -1), clusterOfConstraint(particlesOf.size(), -1);
    ASSERT_EQUAL(0, layout.kinds[0].getNumConstraints());
    for (int i : layout.kinds[0].particles) {
        ASSERT_EQUAL(-1, clusterOf[i]);
        clusterOf[i] = -2;
    }
    vector<int> numClusters(layout.kinds.size(), 0);
    for (size_t c = 0; c < layout.clusters.size(); c++) {
        const ClusterLayout::Cluster& cluster = layout.clusters[c];
        const ClusterKind& kind = layout.kinds[cluster.kind];
        numClusters[cluster.kind]++;
        ASSERT(cluster.number < kind.getNumClusters());
        for (int place = 0; place < kind.numParticles; place++) {
            int& mine = clusterOf[kind.getParticle(cluster.number, place)];
            ASSERT_EQUAL(-1, mine);
            mine = (int) c;
        }
        bool hasExpressions = false;
        for (int place = 0; place < kind.getNumConstraints(); place++) {
            const int k = kind.getConstraint(cluster.number, place);
            ASSERT_EQUAL(-1, clusterOfConstraint[k]);
            clusterOfConstraint[k] = (int) c;
            const bool isExpression = k >= (int) e.distances.size();
            ASSERT(isExpression || !hasExpressions);
            hasExpressions = isExpression;
            vector<int> found, expected = particlesOf[k];
            for (int i : kind.particlesOf[place])
                found.push_back(kind.getParticle(cluster.number, i));
            if (!isExpression && found != expected)
                std::swap(expected[0], expected[1]);
            ASSERT(found == expected);
        }
        ASSERT_EQUAL(kind.hasExpressions, hasExpressions);
        if (cluster.number > 0)
            ASSERT(kind.getParticle(cluster.number - 1, 0) < kind.getParticle(cluster.number, 0));
        // From one particle all others are reached.
        std::set<int> reached = {kind.getParticle(cluster.number, 0)};
        for (size_t before = 0; before < reached.size();) {
            before = reached.size();
            for (const vector<int>& list : particlesOf)
                if (std::any_of(list.begin(), list.end(), [&](int i) { return reached.count(i) > 0; }))
                    reached.insert(list.begin(), list.end());
        }
        ASSERT_EQUAL((size_t) kind.numParticles, reached.size());
    }
    for (size_t k = 0; k < particlesOf.size(); k++) {
        ASSERT_EQUAL(particlesOf[k].empty(), clusterOfConstraint[k] == -1);
        for (int i : particlesOf[k])
            ASSERT_EQUAL(clusterOfConstraint[k], clusterOf[i]);
    }
    for (size_t i = 0; i < e.masses.size(); i++)
        ASSERT_EQUAL(e.masses[i] == 0, clusterOf[i] == -1);
    for (size_t kind = 1; kind < layout.kinds.size(); kind++) {
        ASSERT_EQUAL(layout.kinds[kind].getNumClusters(), numClusters[kind]);
        const ClusterElimination& elimination = layout.kinds[kind].elimination;
        if (elimination.pieces.size() > 1)
            continue;
        vector<int> sorted = elimination.pieces[0].constraints;
        std::sort(sorted.begin(), sorted.end());
        for (int k = 0; k < layout.kinds[kind].getNumConstraints(); k++)
            ASSERT_EQUAL(k, sorted[k]);
    }
}

void testLayouts() {
    Example e = makeComb(60);
    const int fixed = e.add(0, Vec3()), other = e.add(0, Vec3(1, 0, 0));
    e.join(fixed, other);
    testLayout(e);
    testLayout(makeRod(8));
    testLayout(Example());
    // Equal molecules that are written in other orders are of one kind: waters, groups of atoms on one, rings with a tail.
    const vector<vector<std::pair<int, int>>> graphs = {
        {{0, 1}, {0, 2}, {1, 2}}, {{0, 1}, {0, 2}, {0, 3}}, {{0, 1}}, {{0, 1}, {0, 2}, {0, 3}, {0, 4}}};
    Example molecules;
    for (int copy = 0; copy < 20; copy++)
        for (const auto& graph : graphs) {
            const int first = (int) molecules.masses.size(), size = graph.back().second + 1;
            vector<int> order(size);
            for (int i = 0; i < size; i++)
                order[i] = first + i;
            for (int i = size - 1; i > 0; i--)
                std::swap(order[i], order[molecules.generator() % (i + 1)]);
            for (int i = 0; i < size; i++)
                molecules.add(1, molecules.randomVector(1));
            for (const auto& pair : graph)
                molecules.distances.push_back({order[pair.first], order[pair.second], pair.first == 1 ? 0.16 : 0.1});
        }
    molecules.shuffleDistances();
    testLayout(molecules);
    const ClusterLayout layout(molecules.masses, molecules.distances, {});
    ASSERT_EQUAL(1 + graphs.size(), layout.kinds.size());
    for (const ClusterKind& kind : layout.kinds) {
        ASSERT(kind.isSmall());
        if (kind.numParticles != 3 || kind.getNumConstraints() != 3)
            continue;
        for (int water = 0; water < kind.getNumClusters(); water++)
            for (int k = 0; k < 3; k++)
                ASSERT_EQUAL(k == 2 ? 0.16 : 0.1, layout.distances[kind.getConstraint(water, k)].length);
    }
}

} // namespace

int main() {
    return runTests({{"eliminations", testEliminations}, {"layouts", testLayouts}});
}
