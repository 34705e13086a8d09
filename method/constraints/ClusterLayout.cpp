// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterLayout.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

using namespace OpenMMVRattle;
using std::vector;

namespace {

// Clusters are cut from this number of constraints on. The pieces of a chain have twice the entries of L, so that cutting
// pays where the work can be shared, or does not stay in the processor's caches anyway.
const int MIN_CUT_SIZE = 20000;

/** What there is of constraints of both kinds, distances first. */
struct Given {
    const vector<double>& inverseMasses; // 0 for a particle that does not move
    const vector<DistanceConstraint>& distances;
    const vector<ExpressionConstraint>& expressions;
    int getSize() const {
        return (int) (distances.size() + expressions.size());
    }
    bool isExpression(int k) const {
        return k >= (int) distances.size();
    }
    vector<int> findMovingParticles(int k) const;
};

/** A cluster, its particles and constraints at the places that they have in all of its kind. */
struct Arranged {
    vector<int> particles, constraints;
    vector<vector<int>> particlesOf;
    bool hasExpressions;
};

/** Finds clusters, and the orders in each. */
class LayoutBuilder {
public:
    explicit LayoutBuilder(const Given& given) :
            given(given), degrees(given.inverseMasses.size()), particlePlaces(degrees),
            constraintPlaces(given.getSize()) {
    }
    vector<vector<int>> findClusters(const vector<int>& members) const;
    Arranged arrange(const vector<int>& cluster);
    /** After arrange(). */
    ClusterElimination cutAndOrder(const vector<int>& cluster) const;

private:
    vector<int> findMovingParticles(int k) const {
        return given.findMovingParticles(k);
    }
    void putApexFirst(vector<int>& triangle, const vector<int>& cluster) const;
    vector<int> orderAlongMolecule(const vector<int>& cluster, const vector<int>& members) const;
    vector<int> walk(const vector<int>& cluster) const;
    vector<int> walkThroughParticles(const vector<int>& cluster, const std::map<int, vector<int>>& constraintsOf) const;
    vector<int> walkThroughConstraints(const vector<int>& cluster,
                                       const std::map<int, vector<int>>& constraintsOf) const;
    const Given& given;
    vector<int> degrees, particlePlaces, constraintPlaces; // in their clusters
};

vector<int> Given::findMovingParticles(int k) const {
    vector<int> result;
    auto addIfMoving = [&](int i) {
        if (inverseMasses[i] > 0)
            result.push_back(i);
    };
    if (isExpression(k)) {
        for (int i : expressions[k - distances.size()].particles)
            addIfMoving(i);
    }
    else if (inverseMasses[distances[k].particle1] > 0)
        result = {distances[k].particle1, distances[k].particle2};
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

Arranged LayoutBuilder::arrange(const vector<int>& cluster) {
    Arranged result;
    result.hasExpressions = given.isExpression(cluster.back());
    for (int k : cluster) {
        result.particlesOf.push_back(findMovingParticles(k));
        for (int i : result.particlesOf.back())
            if (degrees[i]++ == 0)
                result.particles.push_back(i);
    }
    std::stable_sort(result.particles.begin(), result.particles.end(),
                     [&](int a, int b) { return degrees[a] > degrees[b]; });
    const bool isTriangle = cluster.size() == 3 && !result.hasExpressions && result.particles.size() == 3 &&
                            degrees[result.particles.back()] == 2;
    if (isTriangle)
        putApexFirst(result.particles, cluster);
    for (size_t place = 0; place < result.particles.size(); place++)
        particlePlaces[result.particles[place]] = (int) place;
    vector<std::pair<vector<int>, int>> sorted;
    for (size_t k = 0; k < cluster.size(); k++) {
        vector<int>& places = result.particlesOf[k];
        for (int& i : places)
            i = particlePlaces[i];
        if (!given.isExpression(cluster[k]))
            std::sort(places.begin(), places.end());
        sorted.emplace_back(std::move(places), cluster[k]);
    }
    auto isDistance = [&](const auto& each) { return !given.isExpression(each.second); };
    const auto firstExpression = std::find_if_not(sorted.begin(), sorted.end(), isDistance);
    std::sort(sorted.begin(), firstExpression);
    std::sort(firstExpression, sorted.end());
    for (size_t place = 0; place < sorted.size(); place++) {
        constraintPlaces[sorted[place].second] = (int) place;
        result.constraints.push_back(sorted[place].second);
        result.particlesOf[place] = std::move(sorted[place].first);
    }
    return result;
}

// The oxygen of a water, for example, so that equal molecules have equal lengths in the same order.
void LayoutBuilder::putApexFirst(vector<int>& triangle, const vector<int>& cluster) const {
    for (int candidate = 0; candidate < 3; candidate++) {
        vector<double> lengths;
        for (int k : cluster)
            if (given.distances[k].particle1 == triangle[candidate] ||
                given.distances[k].particle2 == triangle[candidate])
                lengths.push_back(given.distances[k].length);
        if (lengths[0] == lengths[1]) {
            std::rotate(triangle.begin(), triangle.begin() + candidate, triangle.begin() + candidate + 1);
            return;
        }
    }
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
    // From places among the given constraints, and the particles' numbers, to the places that all of the kind have.
    auto placeConstraints = [&](vector<int>& members) {
        for (int& k : members)
            k = constraintPlaces[cluster[k]];
    };
    for (ClusterElimination::Piece& piece : result.pieces) {
        placeConstraints(piece.constraints);
        for (int& i : piece.particles)
            i = particlePlaces[i];
    }
    placeConstraints(result.joints);
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

ClusterElimination ClusterKind::eliminateInRounds(int pieceSize) const {
    const ClusterCut cut = pieceSize == WHOLE ? leaveWhole(particlesOf) : cutClusterAlongTree(particlesOf, pieceSize);
    return ClusterElimination(particlesOf, cut, ClusterElimination::FewLevels);
}

ClusterLayout::ClusterLayout(const vector<double>& masses, const vector<DistanceConstraint>& givenDistances,
                             const vector<ExpressionConstraint>& expressions) : distances(givenDistances) {
    for (double mass : masses)
        inverseMasses.push_back(mass > 0 ? 1.0 / mass : 0.0);
    for (const DistanceConstraint& c : distances)
        if ((inverseMasses[c.particle1] == 0) != (inverseMasses[c.particle2] == 0))
            throw std::invalid_argument("a distance constraint involves a particle whose mass is zero, " +
                                        std::to_string(inverseMasses[c.particle1] == 0 ? c.particle1 : c.particle2));
    const Given given = {inverseMasses, distances, expressions};
    LayoutBuilder builder(given);
    vector<int> all(given.getSize());
    std::iota(all.begin(), all.end(), 0);
    const vector<vector<int>> found = builder.findClusters(all);

    typedef std::tuple<size_t, size_t, bool, vector<vector<int>>> Key;
    std::map<Key, vector<std::pair<size_t, Arranged>>> members; // with their numbers among those that were found
    vector<char> isFree(masses.size(), true);
    for (size_t c = 0; c < found.size(); c++) {
        Arranged arranged = builder.arrange(found[c]);
        for (int i : arranged.particles)
            isFree[i] = false;
        Key key(arranged.constraints.size(), arranged.particles.size(), arranged.hasExpressions,
                std::move(arranged.particlesOf));
        members[std::move(key)].emplace_back(c, std::move(arranged));
    }
    kinds.emplace_back();
    kinds[0].numParticles = 1;
    for (size_t i = 0; i < masses.size(); i++)
        if (isFree[i] && inverseMasses[i] > 0)
            kinds[0].particles.push_back((int) i);
    clusters.resize(found.size());
    for (auto& [key, list] : members) {
        ClusterKind kind;
        kind.numParticles = (int) std::get<1>(key);
        kind.hasExpressions = std::get<2>(key);
        kind.particlesOf = std::get<3>(key);
        std::sort(list.begin(), list.end(),
                  [](const auto& a, const auto& b) { return a.second.particles[0] < b.second.particles[0]; });
        for (size_t number = 0; number < list.size(); number++) {
            const auto& [c, member] = list[number];
            kind.particles.insert(kind.particles.end(), member.particles.begin(), member.particles.end());
            kind.constraints.insert(kind.constraints.end(), member.constraints.begin(), member.constraints.end());
            clusters[c] = {(int) kinds.size(), (int) number};
        }
        kind.elimination = builder.cutAndOrder(found[list[0].first]);
        kinds.push_back(std::move(kind));
    }
}
