// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ConstraintSystem.h"
#include "ClusterBatch.h"
#include "EliminationOrder.h"
#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <set>
#include <tuple>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// The number of particles of a block, whose positions, velocities and forces take 150 kB.
const int BLOCK_SIZE = 1024;

} // namespace

ConstraintSystem::ConstraintSystem(const vector<double>& masses, const vector<DistanceConstraint>& given) :
        numGivenConstraints((int) given.size()), masses(masses), inverseMasses(masses.size()) {
    for (size_t i = 0; i < masses.size(); i++)
        inverseMasses[i] = masses[i] > 0 ? 1.0 / masses[i] : 0.0;

    // Small clusters with the same topology, masses and lengths make a batch; the others are general.
    struct Shape {
        vector<double> inverseMasses, lengths;
        size_t numParticles;
        bool operator<(const Shape& other) const {
            return std::tie(numParticles, inverseMasses, lengths) <
                   std::tie(other.numParticles, other.inverseMasses, other.lengths);
        }
    };
    struct Member {
        vector<int> constraints, particles;
    };
    std::map<Shape, vector<Member>> shapes;
    vector<vector<int>> general;
    vector<char> isInBatch(masses.size(), false);
    for (vector<int>& cluster : findClusters(given)) {
        vector<DistanceConstraint> members;
        bool canMove = true;
        for (int k : cluster) {
            members.push_back(given[k]);
            canMove = canMove && inverseMasses[given[k].particle1] > 0 && inverseMasses[given[k].particle2] > 0;
        }
        if (!canMove || !ClusterBatch::isSupported(members)) {
            orderForElimination(given, cluster);
            general.push_back(cluster);
            continue;
        }
        vector<int> order, particles, arranged;
        ClusterBatch::arrange(members, order, particles);
        Shape shape;
        shape.numParticles = particles.size();
        for (int k : order) {
            arranged.push_back(cluster[k]);
            shape.lengths.push_back(members[k].length);
        }
        for (int i : particles) {
            isInBatch[i] = true;
            shape.inverseMasses.push_back(inverseMasses[i]);
        }
        shapes[shape].push_back({arranged, particles});
    }
    for (auto& entry : shapes) {
        const Shape& shape = entry.first;
        vector<Member>& members = entry.second;
        std::sort(members.begin(), members.end(),
                  [](const Member& a, const Member& b) { return a.particles[0] < b.particles[0]; });
        const int first = (int) constraints.size(), numBonds = (int) shape.lengths.size();
        vector<int> particles;
        for (const Member& member : members) {
            appendCluster(given, member.constraints);
            particles.insert(particles.end(), member.particles.begin(), member.particles.end());
        }
        batches.push_back(ClusterBatch::create(numBonds, numBonds == 3 && shape.numParticles == 3, shape.inverseMasses,
                                               shape.lengths, particles, first));
    }
    firstGeneral = (int) constraints.size();
    for (const vector<int>& cluster : general)
        appendCluster(given, cluster);
    findCouplings();
    classifyParticles(isInBatch);
    findBlocks();
    isFreeToTranslate = std::all_of(constraints.begin(), constraints.end(), [&](const DistanceConstraint& c) {
        return inverseMasses[c.particle1] > 0 && inverseMasses[c.particle2] > 0;
    });
    for (const DistanceConstraint& c : constraints) {
        inverseSquareLengths.push_back(1.0 / (c.length * c.length));
        distanceMultiplierFactors.push_back(0.5 / (c.length * c.length));
    }
}

ConstraintSystem::~ConstraintSystem() {
}

// Constraints that share a moving particle belong to one cluster (union-find over the particles).
vector<vector<int>> ConstraintSystem::findClusters(const vector<DistanceConstraint>& given) const {
    vector<int> parent(masses.size());
    std::iota(parent.begin(), parent.end(), 0);
    auto find = [&](int i) {
        while (parent[i] != i) {
            parent[i] = parent[parent[i]];
            i = parent[i];
        }
        return i;
    };
    for (const DistanceConstraint& c : given)
        if (inverseMasses[c.particle1] > 0 && inverseMasses[c.particle2] > 0)
            parent[find(c.particle1)] = find(c.particle2);
    vector<int> clusterOfRoot(masses.size(), -1);
    vector<vector<int>> result;
    for (int k = 0; k < (int) given.size(); k++) {
        const int moving = inverseMasses[given[k].particle1] > 0 ? given[k].particle1 : given[k].particle2;
        if (inverseMasses[moving] == 0)
            continue;
        int& cluster = clusterOfRoot[find(moving)];
        if (cluster < 0) {
            cluster = (int) result.size();
            result.emplace_back();
        }
        result[cluster].push_back(k);
    }
    return result;
}

/*
 * Order the constraints of a cluster so that eliminating them one after the other fills in little: from the far ends of
 * the molecule towards its middle, in the order in which a depth-first walk from there leaves them. On a tree (most
 * molecules, but for rings) there is no fill at all, and neighbours in memory are neighbours in the molecule.
 */
void ConstraintSystem::orderForElimination(const vector<DistanceConstraint>& given, vector<int>& cluster) const {
    std::map<int, vector<int>> constraintsOf;
    for (int k : cluster)
        for (int i : {given[k].particle1, given[k].particle2})
            if (inverseMasses[i] > 0)
                constraintsOf[i].push_back(k);
    auto other = [&](int k, int i) { return given[k].particle1 == i ? given[k].particle2 : given[k].particle1; };
    // The particles in the order of a breadth-first walk, and from where each was reached.
    auto walkBreadthFirst = [&](int start, std::map<int, int>& origin) {
        origin = {{start, start}};
        vector<int> queue = {start};
        for (size_t next = 0; next < queue.size(); next++)
            for (int k : constraintsOf[queue[next]]) {
                int i = other(k, queue[next]);
                if (inverseMasses[i] > 0 && origin.emplace(i, queue[next]).second)
                    queue.push_back(i);
            }
        return queue.back();
    };
    // The middle of the longest path lies half-way between the particles that two walks reach last.
    std::map<int, int> origin;
    const int oneEnd = walkBreadthFirst(constraintsOf.begin()->first, origin);
    vector<int> longest = {walkBreadthFirst(oneEnd, origin)};
    while (longest.back() != oneEnd)
        longest.push_back(origin[longest.back()]);
    const int root = longest[longest.size() / 2];
    // A depth-first walk without recursion: a chain may have a million constraints.
    struct Place {
        int particle, arrivedBy;
        size_t next;
    };
    std::set<int> seen = {root}, placed, treeConstraints;
    vector<int> order;
    auto isRingOrAnchor = [&](int k) { return treeConstraints.count(k) == 0; };
    vector<Place> path = {{root, -1, 0}};
    while (!path.empty()) {
        Place& place = path.back();
        const vector<int>& list = constraintsOf[place.particle];
        if (place.next < list.size()) {
            const int k = list[place.next++], i = other(k, place.particle);
            if (inverseMasses[i] > 0 && seen.insert(i).second) {
                treeConstraints.insert(k);
                path.push_back({i, k, 0});
            }
            continue;
        }
        // Leaving a particle, with all that lies behind it placed: what is left here closes a ring, or holds an anchor.
        for (int k : list)
            if (isRingOrAnchor(k) && placed.insert(k).second)
                order.push_back(k);
        if (place.arrivedBy >= 0 && placed.insert(place.arrivedBy).second)
            order.push_back(place.arrivedBy);
        path.pop_back();
    }
    // Two constraints are coupled if they share a moving particle.
    std::map<int, int> placeOf;
    for (size_t place = 0; place < order.size(); place++)
        placeOf[order[place]] = (int) place;
    vector<std::pair<int, int>> entries;
    for (const auto& list : constraintsOf)
        for (int a : list.second)
            for (int b : list.second)
                if (placeOf[a] > placeOf[b])
                    entries.emplace_back(placeOf[a], placeOf[b]);
    std::sort(entries.begin(), entries.end());
    entries.erase(std::unique(entries.begin(), entries.end()), entries.end());
    cluster.clear();
    for (int place : findEliminationOrder((int) order.size(), entries))
        cluster.push_back(order[place]);
}

void ConstraintSystem::appendCluster(const vector<DistanceConstraint>& given, const vector<int>& cluster) {
    clusters.push_back({(int) constraints.size(), (int) cluster.size()});
    for (int k : cluster) {
        constraints.push_back(given[k]);
        givenIndex.push_back(k);
    }
}

void ConstraintSystem::classifyParticles(const vector<char>& isInBatch) {
    vector<char> isGeneral(masses.size(), false);
    for (int k = firstGeneral; k < getNumConstraints(); k++)
        isGeneral[constraints[k].particle1] = isGeneral[constraints[k].particle2] = true;
    for (int i = 0; i < getNumParticles(); i++)
        if (inverseMasses[i] > 0 && !isInBatch[i])
            (isGeneral[i] ? generalParticles : freeParticles).push_back(i);
}

void ConstraintSystem::findBlocks() {
    for (int particle = 0; particle < getNumParticles() + BLOCK_SIZE; particle += BLOCK_SIZE) {
        Block block;
        for (const auto& batch : batches)
            block.clusters.push_back(batch->findCluster(particle));
        const auto place = std::lower_bound(freeParticles.begin(), freeParticles.end(), particle);
        block.freeParticle = (int) (place - freeParticles.begin());
        blocks.push_back(block);
    }
}

void ConstraintSystem::findCouplings() {
    struct End {
        int constraint, sign;
    };
    vector<vector<End>> ends(masses.size());
    for (int k = 0; k < getNumConstraints(); k++) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        couplings.push_back({k, k, inverseMasses[i] + inverseMasses[j]});
        if (inverseMasses[i] > 0)
            ends[i].push_back({k, 1});
        if (inverseMasses[j] > 0)
            ends[j].push_back({k, -1});
    }
    for (size_t p = 0; p < ends.size(); p++)
        for (size_t a = 0; a < ends[p].size(); a++)
            for (size_t b = 0; b < a; b++) {
                int row = std::max(ends[p][a].constraint, ends[p][b].constraint);
                int column = std::min(ends[p][a].constraint, ends[p][b].constraint);
                couplings.push_back({row, column, ends[p][a].sign * ends[p][b].sign * inverseMasses[p]});
            }
    std::stable_sort(couplings.begin(), couplings.end(), [](const Coupling& a, const Coupling& b) {
        return a.row != b.row ? a.row < b.row : a.column < b.column;
    });
}

vector<int> ConstraintSystem::getClusterParticles(int cluster) const {
    std::set<int> particles;
    for (int k = clusters[cluster].first; k < clusters[cluster].first + clusters[cluster].size; k++) {
        particles.insert(constraints[k].particle1);
        particles.insert(constraints[k].particle2);
    }
    return vector<int>(particles.begin(), particles.end());
}

double ConstraintSystem::evaluate(const vector<Vec3>& q, vector<double>& g, int first) const {
    double largest = 0;
    for (int k = first; k < getNumConstraints(); k++) {
        Vec3 r = q[constraints[k].particle1] - q[constraints[k].particle2];
        double length = constraints[k].length;
        g[k] = 0.5 * (r.dot(r) - length * length) * inverseSquareLengths[k];
        double size = std::fabs(g[k]);
        if (std::isnan(size))
            return size;
        largest = std::max(largest, size);
    }
    return largest;
}

int ConstraintSystem::findLargest(const vector<double>& g) const {
    int largest = 0;
    for (int k = 1; k < getNumConstraints(); k++)
        if (!(std::fabs(g[k]) <= std::fabs(g[largest])))
            largest = k;
    return largest;
}

void ConstraintSystem::evaluateJacobian(const vector<Vec3>& x, Jacobian& jacobian, int first) const {
    for (int k = first; k < getNumConstraints(); k++)
        jacobian[k] = (x[constraints[k].particle1] - x[constraints[k].particle2]) * inverseSquareLengths[k];
}

void ConstraintSystem::multiply(const Jacobian& jacobian, const vector<Vec3>& w, vector<double>& result,
                                int first) const {
    for (int k = first; k < getNumConstraints(); k++)
        result[k] = jacobian[k].dot(w[constraints[k].particle1] - w[constraints[k].particle2]);
}

void ConstraintSystem::multiplyOverMass(const Jacobian& jacobian, const vector<Vec3>& f, vector<double>& result,
                                        int first) const {
    for (int k = first; k < getNumConstraints(); k++) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        result[k] = jacobian[k].dot(f[i] * inverseMasses[i] - f[j] * inverseMasses[j]);
    }
}

void ConstraintSystem::addTransposed(const Jacobian& jacobian, const vector<double>& x, vector<Vec3>& result) const {
    for (int k = 0; k < getNumConstraints(); k++) {
        Vec3 force = jacobian[k] * x[k];
        result[constraints[k].particle1] += force;
        result[constraints[k].particle2] -= force;
    }
}

void ConstraintSystem::addTransposedOverMass(const Jacobian& jacobian, const vector<double>& x, double scale,
                                             vector<Vec3>& result, int first) const {
    for (int k = first; k < getNumConstraints(); k++) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        Vec3 force = jacobian[k] * (scale * x[k]);
        result[i] += force * inverseMasses[i];
        result[j] -= force * inverseMasses[j];
    }
}

void ConstraintSystem::evaluateCurvature(const vector<Vec3>& v, vector<double>& result, int first) const {
    for (int k = first; k < getNumConstraints(); k++) {
        Vec3 w = v[constraints[k].particle1] - v[constraints[k].particle2];
        result[k] = w.dot(w) * inverseSquareLengths[k];
    }
}

void ConstraintSystem::getDistanceMultipliers(const vector<double>& multipliers, vector<double>& result) const {
    result.assign(numGivenConstraints, 0.0);
    for (int k = 0; k < getNumConstraints(); k++)
        result[givenIndex[k]] = multipliers[k] * distanceMultiplierFactors[k];
}
