// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// How ConstraintSystem arranges the constraints: clusters, batches, pieces, and the internal order.

#include "constraints/ClusterBatch.h"
#include "constraints/ConstraintSystem.h"
#include "constraints/EliminationOrder.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <stdexcept>
#include <tuple>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// The number of particles of a block, whose positions, velocities and forces take 150 kB.
const int BLOCK_SIZE = 1024;
// The number of constraints that a part of the general clusters is filled up to, and that a piece of a large cluster has.
const int PART_SIZE = 1000;
// Clusters are cut from this number of constraints on. The pieces of a chain have twice the entries of L, so that cutting
// pays where the work can be shared, or does not stay in the processor's caches anyway.
const int MIN_CUT_SIZE = 20000;

} // namespace

ConstraintSystem::ConstraintSystem(const vector<double>& masses, const vector<DistanceConstraint>& distances,
                                   const vector<ExpressionConstraint>& expressions) :
        numGivenConstraints((int) (distances.size() + expressions.size())), numGivenDistances((int) distances.size()),
        masses(masses), inverseMasses(masses.size()), expressions(expressions) {
    const Given given = {distances, expressions};
    for (size_t i = 0; i < masses.size(); i++)
        inverseMasses[i] = masses[i] > 0 ? 1.0 / masses[i] : 0.0;
    for (const DistanceConstraint& c : distances)
        if ((inverseMasses[c.particle1] == 0) != (inverseMasses[c.particle2] == 0))
            throw std::invalid_argument("a distance constraint involves a particle whose mass is zero, " +
                                        std::to_string(inverseMasses[c.particle1] == 0 ? c.particle1 : c.particle2));

    // Small clusters with the same topology make a batch; the others are general.
    struct Member {
        vector<int> constraints, particles;
        ClusterShape shape;
    };
    std::map<std::pair<int, int>, vector<Member>> topologies; // by the numbers of constraints and of particles
    vector<GeneralCluster> general;
    vector<char> isInBatch(masses.size(), false);
    vector<int> all(given.getSize());
    std::iota(all.begin(), all.end(), 0);
    for (vector<int>& cluster : findClusters(given, all)) {
        vector<DistanceConstraint> members;
        bool mayBeInBatch = true;
        for (int k : cluster) {
            mayBeInBatch = mayBeInBatch && !given.isExpression(k);
            if (mayBeInBatch)
                members.push_back(distances[k]);
        }
        if (!mayBeInBatch || !ClusterBatch::isSupported(members)) {
            general.push_back(cutAndOrder(given, cluster));
            continue;
        }
        vector<int> order;
        Member member;
        ClusterBatch::arrange(members, order, member.particles);
        for (int k : order) {
            member.constraints.push_back(cluster[k]);
            member.shape.lengths.push_back(members[k].length);
        }
        for (int i : member.particles) {
            isInBatch[i] = true;
            member.shape.inverseMasses.push_back(inverseMasses[i]);
        }
        topologies[{(int) order.size(), (int) member.particles.size()}].push_back(std::move(member));
    }
    for (auto& entry : topologies) {
        const int numBonds = entry.first.first, numParticles = entry.first.second;
        vector<Member>& members = entry.second;
        std::sort(members.begin(), members.end(),
                  [](const Member& a, const Member& b) { return a.particles[0] < b.particles[0]; });
        const int first = (int) constraints.size();
        vector<int> particles;
        vector<ClusterShape> shapes;
        for (const Member& member : members) {
            clusters.push_back({(int) constraints.size(), numBonds});
            append(given, member.constraints);
            particles.insert(particles.end(), member.particles.begin(), member.particles.end());
            shapes.push_back(member.shape);
        }
        batches.push_back(ClusterBatch::create(numBonds, numBonds == 3 && numParticles == 3, shapes, particles, first));
    }
    firstGeneral = (int) constraints.size();
    auto isDistance = [&](int k) { return !given.isExpression(k); };
    auto hasNoExpression = [&](const GeneralCluster& cluster) {
        return std::all_of(cluster.joints.begin(), cluster.joints.end(), isDistance) &&
               std::all_of(cluster.pieces.begin(), cluster.pieces.end(), [&](const ClusterCut::Piece& piece) {
                   return std::all_of(piece.constraints.begin(), piece.constraints.end(), isDistance);
               });
    };
    std::stable_partition(general.begin(), general.end(), hasNoExpression);
    std::stable_partition(general.begin(), general.end(),
                          [](const GeneralCluster& cluster) { return cluster.pieces.size() == 1; });
    for (const GeneralCluster& cluster : general) {
        const int first = getNumConstraints();
        for (const ClusterCut::Piece& piece : cluster.pieces)
            append(given, piece.constraints);
        append(given, cluster.joints);
        clusters.push_back({first, getNumConstraints() - first});
    }
    groupExpressions(given);
    findStretches();
    findParts(general);
    findGroupRanges();
    findJointEnds();
    findCouplings();
    findFreeParticles(isInBatch);
    findBlocks();
    for (int k = 0; k < getNumConstraints(); k++) {
        const double length = constraints[k].length;
        inverseSquareLengths.push_back(1.0 / (length * length));
        multiplierFactors.push_back(isExpression(k) ? 1.0 : 0.5 / (length * length));
    }
}

ConstraintSystem::~ConstraintSystem() {
}

vector<int> ConstraintSystem::findMovingParticles(const Given& given, int k) const {
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
vector<vector<int>> ConstraintSystem::findClusters(const Given& given, const vector<int>& members) const {
    vector<int> particles;
    for (int k : members)
        for (int i : findMovingParticles(given, k))
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
        const vector<int> moving = findMovingParticles(given, k);
        for (size_t i = 1; i < moving.size(); i++)
            parent[find(moving[0])] = find(moving[i]);
    }
    vector<int> clusterOfRoot(particles.size(), -1);
    vector<vector<int>> result;
    for (int k : members) {
        const vector<int> moving = findMovingParticles(given, k);
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
ConstraintSystem::GeneralCluster ConstraintSystem::cutAndOrder(const Given& given, const vector<int>& cluster) const {
    vector<vector<int>> particlesOf;
    for (int k : cluster)
        particlesOf.push_back(findMovingParticles(given, k));
    ClusterCut cut;
    if ((int) cluster.size() >= MIN_CUT_SIZE)
        cut = cutCluster(particlesOf, PART_SIZE);
    if (cut.pieces.empty()) {
        ClusterCut::Piece whole;
        whole.constraints = cluster;
        for (const vector<int>& particles : particlesOf)
            whole.particles.insert(whole.particles.end(), particles.begin(), particles.end());
        std::sort(whole.particles.begin(), whole.particles.end());
        whole.particles.erase(std::unique(whole.particles.begin(), whole.particles.end()), whole.particles.end());
        const bool hasWideColumns = orderForElimination(given, whole.constraints);
        return {{whole}, {}, hasWideColumns};
    }
    GeneralCluster result = {std::move(cut.pieces), std::move(cut.joints), true};
    for (int& k : result.joints)
        k = cluster[k];
    for (ClusterCut::Piece& piece : result.pieces) {
        for (int& k : piece.constraints)
            k = cluster[k];
        orderForElimination(given, piece.constraints);
    }
    orderJoints(given, result);
    return result;
}

// When the pieces have been eliminated, the joints at the ends of each are coupled.
void ConstraintSystem::orderJoints(const Given& given, GeneralCluster& cluster) const {
    std::map<int, int> pieceOf; // of the particles at joints
    for (int k : cluster.joints)
        for (int i : findMovingParticles(given, k))
            pieceOf[i] = -1;
    for (size_t p = 0; p < cluster.pieces.size(); p++)
        for (int i : cluster.pieces[p].particles) {
            const auto found = pieceOf.find(i);
            if (found != pieceOf.end())
                found->second = (int) p;
        }
    vector<std::set<int>> jointsOf(cluster.pieces.size());
    for (size_t place = 0; place < cluster.joints.size(); place++)
        for (int i : findMovingParticles(given, cluster.joints[place]))
            jointsOf[pieceOf[i]].insert((int) place);
    std::set<std::pair<int, int>> entries;
    for (const std::set<int>& joints : jointsOf)
        for (int a : joints)
            for (int b : joints)
                if (a > b)
                    entries.emplace(a, b);
    const EliminationOrder order = findEliminationOrder((int) cluster.joints.size(), {entries.begin(), entries.end()});
    vector<int> ordered;
    for (int place : order.rows)
        ordered.push_back(cluster.joints[place]);
    cluster.joints.swap(ordered);
}

/*
 * Order constraints so that eliminating them one after the other fills in little, and neighbours in memory are neighbours in the
 * molecule. Two constraints are coupled if they share a moving particle. Returns whether there are wide columns.
 */
bool ConstraintSystem::orderForElimination(const Given& given, vector<int>& members) const {
    vector<int> order;
    for (const vector<int>& joined : findClusters(given, members)) {
        const vector<int> walked = walk(given, joined);
        order.insert(order.end(), walked.begin(), walked.end());
    }
    vector<std::pair<int, int>> ends; // particles, and the places of their constraints
    for (size_t place = 0; place < order.size(); place++)
        for (int i : findMovingParticles(given, order[place]))
            ends.emplace_back(i, (int) place);
    std::sort(ends.begin(), ends.end());
    MatrixEntries entries;
    for (size_t a = 0; a < ends.size(); a++)
        for (size_t b = a; b > 0 && ends[b - 1].first == ends[a].first; b--)
            if (ends[b - 1].second < ends[a].second)
                entries.emplace_back(ends[a].second, ends[b - 1].second);
    std::sort(entries.begin(), entries.end());
    entries.erase(std::unique(entries.begin(), entries.end()), entries.end());
    const EliminationOrder best = findEliminationOrder((int) order.size(), entries);
    members.clear();
    for (int place : best.rows)
        members.push_back(order[place]);
    return best.numNarrow < (int) order.size();
}

// The constraints of a cluster, or of a connected part of it, in an order in which neighbours are coupled.
vector<int> ConstraintSystem::walk(const Given& given, const vector<int>& cluster) const {
    std::map<int, vector<int>> constraintsOf;
    bool hasExpression = false;
    for (int k : cluster) {
        hasExpression |= given.isExpression(k);
        for (int i : findMovingParticles(given, k))
            constraintsOf[i].push_back(k);
    }
    return hasExpression ? walkThroughConstraints(given, cluster, constraintsOf)
                         : walkThroughParticles(given, cluster, constraintsOf);
}

/*
 * The distance constraints of a cluster from the far ends of the molecule towards its middle, in the order in which a
 * depth-first walk from there leaves them. On a tree (most molecules, but for rings) there is no fill at all.
 */
vector<int> ConstraintSystem::walkThroughParticles(const Given& given, const vector<int>&,
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
vector<int> ConstraintSystem::walkThroughConstraints(const Given& given, const vector<int>& cluster,
                                                     const std::map<int, vector<int>>& constraintsOf) const {
    auto walk = [&](int start) {
        std::set<int> seenConstraints = {start}, seenParticles;
        vector<int> queue = {start};
        for (size_t next = 0; next < queue.size(); next++)
            for (int i : findMovingParticles(given, queue[next]))
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

void ConstraintSystem::append(const Given& given, const vector<int>& members) {
    for (int k : members) {
        constraints.push_back(given.isExpression(k) ? DistanceConstraint{-1, -1, 1.0} : given.distances[k]);
        givenIndex.push_back(k);
    }
}

// Give every expression its entries of a Jacobian and put it into the group of its like.
void ConstraintSystem::groupExpressions(const Given& given) {
    placeInGroups.resize(expressions.size());
    firstParameters.resize(expressions.size());
    typedef std::tuple<std::string, size_t, vector<std::string>> Kind;
    std::map<Kind, int> groupOf;
    vector<int> groupSizes;
    for (int k = 0; k < getNumConstraints(); k++) {
        if (!isExpression(k))
            continue;
        const int e = givenIndex[k] - numGivenDistances, firstEntry = getNumEntries();
        const ExpressionConstraint& c = given.getExpression(givenIndex[k]);
        for (int i : c.particles)
            if (inverseMasses[i] > 0)
                expressionEntries.push_back({k, i});
        expressionRows.push_back({k, firstEntry, getNumEntries()});
        vector<std::string> names;
        for (const auto& parameter : c.parameters)
            names.push_back(parameter.first);
        const auto found = groupOf.emplace(Kind(c.expression, c.particles.size(), names), (int) groups.size());
        const int group = found.first->second;
        if (found.second) {
            groups.emplace_back(new ExpressionGroup(c));
            groupSizes.push_back(0);
        }
        groups[group]->add(c, k, firstEntry, numParameters, inverseMasses);
        firstParameters[e] = numParameters;
        numParameters += (int) c.parameters.size();
        placeInGroups[e] = {group, groupSizes[group]++};
    }
    for (const auto& group : groups)
        group->compile();
}

void ConstraintSystem::findStretches() {
    for (int k = 0; k < getNumConstraints(); k++) {
        if (isExpression(k))
            continue;
        if (distanceStretches.empty() || distanceStretches.back().end != k)
            distanceStretches.push_back({k, k});
        distanceStretches.back().end++;
    }
}

// The general clusters in parts, with their particles.
void ConstraintSystem::findParts(const vector<GeneralCluster>& general) {
    Part open = {0, firstGeneral, 0, 0, 0, 0, 0, 0, 0, 0, NONE, 0};
    auto beginNext = [&]() {
        open.index++;
        open.first = open.end;
        open.firstRow = open.endRow;
        open.firstParticle = open.endParticle;
    };
    auto extend = [&](const vector<int>& members, const vector<int>& particles) {
        open.end += (int) members.size();
        while (open.endRow < (int) expressionRows.size() && expressionRows[open.endRow].constraint < open.end)
            open.endRow++;
        generalParticles.insert(generalParticles.end(), particles.begin(), particles.end());
        open.endParticle = (int) generalParticles.size();
    };
    auto closePart = [&]() {
        if (open.end == open.first)
            return;
        wholeParts.push_back(open);
        beginNext();
    };
    closePart(); // the batches
    for (const GeneralCluster& cluster : general) {
        if (cluster.pieces.size() == 1) {
            if (cluster.hasWideColumns)
                closePart();
            extend(cluster.pieces[0].constraints, cluster.pieces[0].particles);
            if (cluster.hasWideColumns || open.end - open.first >= PART_SIZE)
                closePart();
            continue;
        }
        closePart();
        CutCluster cut;
        cut.firstPiece = (int) pieces.size();
        for (const ClusterCut::Piece& piece : cluster.pieces) {
            extend(piece.constraints, piece.particles);
            pieces.push_back(open);
            pieces.back().piece = (int) pieces.size() - 1;
            beginNext();
        }
        cut.endPiece = (int) pieces.size();
        extend(cluster.joints, {});
        cut.joints = open;
        cutClusters.push_back(cut);
        beginNext();
    }
    closePart();
}

// The expressions of each part by their groups.
void ConstraintSystem::findGroupRanges() {
    for (size_t group = 0; group < groups.size(); group++)
        groupRanges.push_back({(int) group, 0, groups[group]->getNumConstraints()});
    auto addRangesOf = [&](Part& part) {
        std::map<int, GroupRange> ranges;
        for (int r = part.firstRow; r < part.endRow; r++) {
            const std::pair<int, int>& place =
                placeInGroups[givenIndex[expressionRows[r].constraint] - numGivenDistances];
            // Constraints are in their group in internal order too.
            ranges.emplace(place.first, GroupRange{place.first, place.second, place.second}).first->second.end =
                place.second + 1;
        }
        part.firstGroupRange = (int) groupRanges.size();
        for (const auto& range : ranges)
            groupRanges.push_back(range.second);
        part.endGroupRange = (int) groupRanges.size();
    };
    for (Part& part : wholeParts)
        addRangesOf(part);
    std::copy_if(wholeParts.begin(), wholeParts.end(), std::back_inserter(generalParts),
                 [&](const Part& part) { return part.first >= firstGeneral; });
    for (Part& piece : pieces)
        addRangesOf(piece);
    for (CutCluster& cut : cutClusters)
        addRangesOf(cut.joints);
}

// What the joints do to the particles of each piece.
void ConstraintSystem::findJointEnds() {
    vector<int> pieceOf(cutClusters.empty() ? 0 : masses.size(), -1);
    for (const Part& piece : pieces)
        for (int p = piece.firstParticle; p < piece.endParticle; p++)
            pieceOf[generalParticles[p]] = piece.piece;
    vector<vector<JointEnd>> endsOf(pieces.size());
    auto add = [&](const JointEnd& end) { endsOf[pieceOf[end.particle]].push_back(end); };
    for (const CutCluster& cut : cutClusters) {
        for (int k = cut.joints.first; k < cut.joints.end; k++)
            if (!isExpression(k)) {
                add({k, k, constraints[k].particle1, 1.0});
                add({k, k, constraints[k].particle2, -1.0});
            }
        for (int r = cut.joints.firstRow; r < cut.joints.endRow; r++)
            for (int entry = expressionRows[r].first; entry < expressionRows[r].end; entry++)
                add({entry, expressionRows[r].constraint, getParticleOf(entry), 1.0});
    }
    for (Part& piece : pieces) {
        piece.firstJointEnd = (int) jointEnds.size();
        jointEnds.insert(jointEnds.end(), endsOf[piece.piece].begin(), endsOf[piece.piece].end());
        piece.endJointEnd = (int) jointEnds.size();
    }
}

void ConstraintSystem::findFreeParticles(const vector<char>& isInBatch) {
    vector<char> isGeneral(masses.size(), false);
    for (int i : generalParticles)
        isGeneral[i] = true;
    for (int i = 0; i < getNumParticles(); i++)
        if (inverseMasses[i] > 0 && !isInBatch[i] && !isGeneral[i])
            freeParticles.push_back(i);
}

void ConstraintSystem::findBlocks() {
    for (int particle = 0; particle < getNumParticles() + BLOCK_SIZE; particle += BLOCK_SIZE) {
        Block block;
        for (const auto& batch : batches)
            block.clusters.push_back(batch->findCluster(particle));
        const auto place = std::lower_bound(freeParticles.begin(), freeParticles.end(), particle);
        block.freeParticle = (int) (place - freeParticles.begin());
        block.particle = std::min(particle, getNumParticles());
        blocks.push_back(block);
    }
}

void ConstraintSystem::findCouplings() {
    struct End {
        int entry, sign;
    };
    vector<vector<End>> ends(masses.size());
    auto addEnd = [&](int particle, int entry, int sign) { ends[particle].push_back({entry, sign}); };
    for (int k = 0; k < getNumConstraints(); k++) {
        if (isExpression(k))
            continue;
        int i = constraints[k].particle1, j = constraints[k].particle2;
        couplings.push_back({k, k, inverseMasses[i] + inverseMasses[j]});
        addEnd(i, k, 1);
        addEnd(j, k, -1);
    }
    for (size_t e = 0; e < expressionEntries.size(); e++) {
        const int entry = getNumConstraints() + (int) e, particle = expressionEntries[e].particle;
        couplings.push_back({entry, entry, inverseMasses[particle]});
        addEnd(particle, entry, 1);
    }
    for (size_t p = 0; p < ends.size(); p++)
        for (size_t a = 0; a < ends[p].size(); a++)
            for (size_t b = 0; b < a; b++) {
                int row = ends[p][a].entry, column = ends[p][b].entry;
                if (getConstraintOf(row) < getConstraintOf(column))
                    std::swap(row, column);
                couplings.push_back({row, column, ends[p][a].sign * ends[p][b].sign * inverseMasses[p]});
            }
    // By parts, those of a joint with a piece being the piece's: the part of the column is the coupling's. Then by rows.
    vector<int> partOf(getNumConstraints());
    auto setPart = [&](const Part& part) {
        std::fill(partOf.begin() + part.first, partOf.begin() + part.end, part.index);
    };
    std::for_each(wholeParts.begin(), wholeParts.end(), setPart);
    std::for_each(pieces.begin(), pieces.end(), setPart);
    for (const CutCluster& cut : cutClusters)
        setPart(cut.joints);
    typedef std::tuple<int, int, int, size_t> Key;
    vector<Key> keys;
    for (size_t i = 0; i < couplings.size(); i++) {
        const int row = getConstraintOf(couplings[i].row), column = getConstraintOf(couplings[i].column);
        keys.emplace_back(partOf[column], row, column, i);
    }
    std::sort(keys.begin(), keys.end());
    vector<Coupling> sorted;
    sorted.reserve(couplings.size());
    for (const Key& key : keys)
        sorted.push_back(couplings[std::get<3>(key)]);
    couplings.swap(sorted);
}
