// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterLayout.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>

using namespace OpenMMVRattle;
using std::vector;

namespace {

// Clusters are cut from this number of constraints on. The pieces of a chain have twice the entries of L, so that cutting
// pays where the work can be shared, or does not stay in the processor's caches anyway.
const int MIN_CUT_SIZE = 20000;

/** What is worked on: constraints of both kinds, distances first. */
struct Given {
    const vector<DistanceConstraint>& distances;
    const vector<ExpressionConstraint>& expressions;
    int getSize() const {
        return (int) (distances.size() + expressions.size());
    }
    bool isExpression(int k) const {
        return k >= (int) distances.size();
    }
    const ExpressionConstraint& getExpression(int k) const {
        return expressions[k - distances.size()];
    }
};

/** Finds clusters, and the order in each. */
class LayoutBuilder {
public:
    LayoutBuilder(const vector<double>& inverseMasses, const Given& given) :
            inverseMasses(inverseMasses), given(given) {
    }
    vector<vector<int>> findClusters(const vector<int>& members) const;
    ClusterElimination cutAndOrder(const vector<int>& cluster) const;

private:
    vector<int> findMovingParticles(int k) const;
    vector<int> orderAlongMolecule(const vector<int>& cluster, const vector<int>& members) const;
    vector<int> walk(const vector<int>& cluster) const;
    vector<int> walkThroughParticles(const vector<int>& cluster, const std::map<int, vector<int>>& constraintsOf) const;
    vector<int> walkThroughConstraints(const vector<int>& cluster,
                                       const std::map<int, vector<int>>& constraintsOf) const;
    const vector<double>& inverseMasses; // 0 for a particle that does not move
    const Given& given;
};

vector<int> LayoutBuilder::findMovingParticles(int k) const {
    vector<int> result;
    auto addIfMoving = [&](int i) {
        if (inverseMasses[i] > 0)
            result.push_back(i);
    };
    if (given.isExpression(k)) {
        for (int i : given.getExpression(k).particles)
            addIfMoving(i);
    }
    else if (inverseMasses[given.distances[k].particle1] > 0)
        result = {given.distances[k].particle1, given.distances[k].particle2};
    return result;
}

// Constraints that share a moving particle belong to one cluster (union-find over the particles).
vector<vector<int>> LayoutBuilder::findClusters(const vector<int>& members) const {
    vector<int> particles;
    for (int k : members)
        for (int i : findMovingParticles(k))
            particles.push_back(i);
    std::sort(particles.begin(), particles.end());
    particles.erase(std::unique(particles.begin(), particles.end()), particles.end());
    vector<int> parent(particles.size());
    std::iota(parent.begin(), parent.end(), 0);
    auto find = [&](int particle) {
        int i = (int) (std::lower_bound(particles.begin(), particles.end(), particle) - particles.begin());
        while (parent[i] != i) {
            parent[i] = parent[parent[i]];
            i = parent[i];
        }
        return i;
    };
    for (int k : members) {
        const vector<int> moving = findMovingParticles(k);
        for (size_t i = 1; i < moving.size(); i++)
            parent[find(moving[0])] = find(moving[i]);
    }
    vector<int> clusterOfRoot(particles.size(), -1);
    vector<vector<int>> result;
    for (int k : members) {
        const vector<int> moving = findMovingParticles(k);
        if (moving.empty())
            continue;
        int& cluster = clusterOfRoot[find(moving[0])];
        if (cluster < 0) {
            cluster = (int) result.size();
            result.emplace_back();
        }
        result[cluster].push_back(k);
    }
    return result;
}

// Cut a cluster that is large, and put its constraints in the order in which they are eliminated.
ClusterElimination LayoutBuilder::cutAndOrder(const vector<int>& cluster) const {
    vector<vector<int>> particlesOf;
    for (int k : cluster)
        particlesOf.push_back(findMovingParticles(k));
    ClusterCut cut;
    if ((int) cluster.size() >= MIN_CUT_SIZE)
        cut = cutCluster(particlesOf, ClusterLayout::PIECE_SIZE);
    if (cut.pieces.empty())
        cut = leaveWhole(particlesOf);
    for (ClusterCut::Piece& piece : cut.pieces)
        piece.constraints = orderAlongMolecule(cluster, piece.constraints);
    ClusterElimination result(particlesOf, cut, ClusterElimination::LeastFill);
    auto toGiven = [&](vector<int>& members) {
        for (int& k : members)
            k = cluster[k];
    };
    for (ClusterElimination::Piece& piece : result.pieces)
        toGiven(piece.constraints);
    toGiven(result.joints);
    return result;
}

// So that neighbours in memory are neighbours in the molecule. Members are places in the cluster, whose constraints are sorted.
vector<int> LayoutBuilder::orderAlongMolecule(const vector<int>& cluster, const vector<int>& members) const {
    vector<int> given, order;
    for (int place : members)
        given.push_back(cluster[place]);
    for (const vector<int>& joined : findClusters(given))
        for (int k : walk(joined))
            order.push_back((int) (std::lower_bound(cluster.begin(), cluster.end(), k) - cluster.begin()));
    return order;
}

// The constraints of a cluster, or of a connected part of it, in an order in which neighbours are coupled.
vector<int> LayoutBuilder::walk(const vector<int>& cluster) const {
    std::map<int, vector<int>> constraintsOf;
    bool hasExpression = false;
    for (int k : cluster) {
        hasExpression |= given.isExpression(k);
        for (int i : findMovingParticles(k))
            constraintsOf[i].push_back(k);
    }
    return hasExpression ? walkThroughConstraints(cluster, constraintsOf)
                         : walkThroughParticles(cluster, constraintsOf);
}

/*
 * The distance constraints of a cluster from the far ends of the molecule towards its middle, in the order in which a
 * depth-first walk from there leaves them. On a tree (most molecules, but for rings) there is no fill at all.
 */
vector<int> LayoutBuilder::walkThroughParticles(const vector<int>&,
                                                const std::map<int, vector<int>>& constraintsOf) const {
    auto other = [&](int k, int i) {
        const DistanceConstraint& c = given.distances[k];
        return c.particle1 == i ? c.particle2 : c.particle1;
    };
    // The particles in the order of a breadth-first walk, and from where each was reached.
    auto walkBreadthFirst = [&](int start, std::map<int, int>& origin) {
        origin = {{start, start}};
        vector<int> queue = {start};
        for (size_t next = 0; next < queue.size(); next++)
            for (int k : constraintsOf.at(queue[next])) {
                int i = other(k, queue[next]);
                if (origin.emplace(i, queue[next]).second)
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
    auto closesRing = [&](int k) { return treeConstraints.count(k) == 0; };
    vector<Place> path = {{root, -1, 0}};
    while (!path.empty()) {
        Place& place = path.back();
        const vector<int>& list = constraintsOf.at(place.particle);
        if (place.next < list.size()) {
            const int k = list[place.next++], i = other(k, place.particle);
            if (seen.insert(i).second) {
                treeConstraints.insert(k);
                path.push_back({i, k, 0});
            }
            continue;
        }
        // Leaving a particle, with all that lies behind it placed: what is left here closes a ring.
        for (int k : list)
            if (closesRing(k) && placed.insert(k).second)
                order.push_back(k);
        if (place.arrivedBy >= 0 && placed.insert(place.arrivedBy).second)
            order.push_back(place.arrivedBy);
        path.pop_back();
    }
    return order;
}

/*
 * The constraints of a cluster with expressions in the reverse order of a breadth-first walk (Cuthill and McKee, Proc. 24th
 * ACM National Conf., 1969) from a constraint at one end. What is chained, such as the cross-sections of a rod, then has
 * couplings to near neighbours alone.
 */
vector<int> LayoutBuilder::walkThroughConstraints(const vector<int>& cluster,
                                                  const std::map<int, vector<int>>& constraintsOf) const {
    auto walk = [&](int start) {
        std::set<int> seenConstraints = {start}, seenParticles;
        vector<int> queue = {start};
        for (size_t next = 0; next < queue.size(); next++)
            for (int i : findMovingParticles(queue[next]))
                if (seenParticles.insert(i).second)
                    for (int k : constraintsOf.at(i))
                        if (seenConstraints.insert(k).second)
                            queue.push_back(k);
        return queue;
    };
    vector<int> order = walk(walk(cluster[0]).back());
    std::reverse(order.begin(), order.end());
    return order;
}

} // namespace

ClusterLayout::ClusterLayout(const vector<double>& inverseMasses, const vector<DistanceConstraint>& distances,
                             const vector<ExpressionConstraint>& expressions) {
    for (const DistanceConstraint& c : distances)
        if ((inverseMasses[c.particle1] == 0) != (inverseMasses[c.particle2] == 0))
            throw std::invalid_argument("a distance constraint involves a particle whose mass is zero, " +
                                        std::to_string(inverseMasses[c.particle1] == 0 ? c.particle1 : c.particle2));
    const Given given = {distances, expressions};
    const LayoutBuilder builder(inverseMasses, given);
    // Small clusters with the same topology make a batch; the others are general.
    struct Member {
        vector<int> constraints, particles;
        ClusterShape shape;
    };
    std::map<std::pair<int, int>, vector<Member>> topologies; // by the numbers of constraints and of particles
    vector<int> all(given.getSize());
    std::iota(all.begin(), all.end(), 0);
    for (vector<int>& cluster : builder.findClusters(all)) {
        vector<DistanceConstraint> members;
        bool mayBeInBatch = true;
        for (int k : cluster) {
            mayBeInBatch = mayBeInBatch && !given.isExpression(k);
            if (mayBeInBatch)
                members.push_back(distances[k]);
        }
        if (!mayBeInBatch || !ClusterBatch::isSupported(members)) {
            general.push_back(builder.cutAndOrder(cluster));
            continue;
        }
        vector<int> order;
        Member member;
        ClusterBatch::arrange(members, order, member.particles);
        for (int k : order) {
            member.constraints.push_back(cluster[k]);
            member.shape.lengths.push_back(members[k].length);
        }
        for (int i : member.particles)
            member.shape.inverseMasses.push_back(inverseMasses[i]);
        topologies[{(int) order.size(), (int) member.particles.size()}].push_back(std::move(member));
    }
    for (auto& entry : topologies) {
        vector<Member>& members = entry.second;
        std::sort(members.begin(), members.end(),
                  [](const Member& a, const Member& b) { return a.particles[0] < b.particles[0]; });
        Batch batch;
        batch.numBonds = entry.first.first;
        batch.isTriangle = batch.numBonds == 3 && entry.first.second == 3;
        std::map<ClusterShape, int> numberOf;
        for (const Member& member : members) {
            batch.constraints.insert(batch.constraints.end(), member.constraints.begin(), member.constraints.end());
            batch.particles.insert(batch.particles.end(), member.particles.begin(), member.particles.end());
            const auto number = numberOf.emplace(member.shape, (int) batch.shapes.size());
            if (number.second)
                batch.shapes.push_back(member.shape);
            batch.shapeOf.push_back(number.first->second);
        }
        batches.push_back(std::move(batch));
    }
    auto isDistance = [&](int k) { return !given.isExpression(k); };
    auto hasNoExpression = [&](const ClusterElimination& cluster) {
        return std::all_of(cluster.joints.begin(), cluster.joints.end(), isDistance) &&
               std::all_of(cluster.pieces.begin(), cluster.pieces.end(), [&](const ClusterElimination::Piece& piece) {
                   return std::all_of(piece.constraints.begin(), piece.constraints.end(), isDistance);
               });
    };
    std::stable_partition(general.begin(), general.end(), hasNoExpression);
    std::stable_partition(general.begin(), general.end(),
                          [](const ClusterElimination& cluster) { return cluster.pieces.size() == 1; });
}
