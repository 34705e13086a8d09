// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What ConstraintSystem makes of a ClusterLayout: the internal order, parts, blocks, and tables of indices.

#include "constraints/ClusterBatch.h"
#include "constraints/ClusterLayout.h"
#include "constraints/ConstraintSystem.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <tuple>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// The number of particles of a block, whose positions, velocities and forces take 150 kB.
const int BLOCK_SIZE = 1024;
// The number of constraints that a part of the general clusters is filled up to.
const int PART_SIZE = ClusterLayout::PIECE_SIZE;

} // namespace

ConstraintSystem::ConstraintSystem(const vector<double>& masses, const vector<DistanceConstraint>& distances,
                                   const vector<ExpressionConstraint>& expressions) :
        numGivenConstraints((int) (distances.size() + expressions.size())), numGivenDistances((int) distances.size()),
        masses(masses), layout(masses, distances, expressions), inverseMasses(layout.inverseMasses),
        expressions(expressions), freeParticles(layout.kinds[0].particles) {
    auto append = [&](int kind, int number, const vector<int>& places) {
        for (int place : places) {
            const int k = layout.kinds[kind].getConstraint(number, place);
            constraints.push_back(k >= numGivenDistances ? DistanceConstraint{-1, -1, 1.0} : distances[k]);
            givenIndex.push_back(k);
        }
    };
    vector<char> isInBatch(layout.kinds.size(), false);
    for (size_t kind = 1; kind < layout.kinds.size(); kind++) {
        auto batch = ClusterBatch::create(layout, layout.kinds[kind], getNumConstraints());
        if (batch == nullptr)
            continue;
        isInBatch[kind] = true;
        batches.push_back(std::move(batch));
        vector<int> places(layout.kinds[kind].getNumConstraints());
        std::iota(places.begin(), places.end(), 0);
        for (int number = 0; number < layout.kinds[kind].getNumClusters(); number++) {
            clusters.push_back({getNumConstraints(), (int) places.size(), (int) kind});
            append((int) kind, number, places);
        }
    }
    firstGeneral = getNumConstraints();
    const vector<ClusterLayout::Cluster> general = findGeneral(isInBatch);
    for (const ClusterLayout::Cluster& each : general) {
        const int first = getNumConstraints();
        const ClusterElimination& elimination = layout.kinds[each.kind].elimination;
        for (const ClusterElimination::Piece& piece : elimination.pieces)
            append(each.kind, each.number, piece.constraints);
        append(each.kind, each.number, elimination.joints);
        clusters.push_back({first, getNumConstraints() - first, each.kind});
    }
    groupExpressions();
    findStretches();
    findParts(general);
    findGroupRanges();
    findJointEnds();
    findCouplings();
    findBlocks();
    for (int k = 0; k < getNumConstraints(); k++) {
        const double length = constraints[k].length;
        inverseSquareLengths.push_back(1.0 / (length * length));
        multiplierFactors.push_back(isExpression(k) ? 1.0 : 0.5 / (length * length));
    }
}

ConstraintSystem::~ConstraintSystem() {
}

// The clusters that are in no batch: those that are cut last, and of each sort the ones with an expression after the others.
vector<ClusterLayout::Cluster> ConstraintSystem::findGeneral(const vector<char>& isInBatch) const {
    vector<ClusterLayout::Cluster> general;
    auto kindOf = [&](const ClusterLayout::Cluster& each) -> const ClusterKind& { return layout.kinds[each.kind]; };
    std::copy_if(layout.clusters.begin(), layout.clusters.end(), std::back_inserter(general),
                 [&](const ClusterLayout::Cluster& each) { return !isInBatch[each.kind]; });
    auto rank = [&](const ClusterLayout::Cluster& each) {
        return std::make_pair(kindOf(each).elimination.pieces.size() > 1, kindOf(each).hasExpressions);
    };
    std::stable_sort(general.begin(), general.end(), [&](const auto& a, const auto& b) { return rank(a) < rank(b); });
    return general;
}

// Give every expression its entries of a Jacobian and put it into the group of its like.
void ConstraintSystem::groupExpressions() {
    placeInGroups.resize(expressions.size());
    firstParameters.resize(expressions.size());
    typedef std::tuple<std::string, size_t, vector<std::string>> Kind;
    std::map<Kind, int> groupOf;
    vector<int> groupSizes;
    for (int k = 0; k < getNumConstraints(); k++) {
        if (!isExpression(k))
            continue;
        const int e = expressionOf(k), firstEntry = getNumEntries();
        const ExpressionConstraint& c = expressions[e];
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
void ConstraintSystem::findParts(const vector<ClusterLayout::Cluster>& general) {
    Part open = {0, firstGeneral, 0, 0, 0, 0, 0, 0, 0, 0, NONE, 0};
    auto beginNext = [&]() {
        open.index++;
        open.first = open.end;
        open.firstRow = open.endRow;
        open.firstParticle = open.endParticle;
    };
    auto extend = [&](const vector<int>& members, const vector<int>& places, const ClusterLayout::Cluster& cluster) {
        open.end += (int) members.size();
        while (open.endRow < (int) expressionRows.size() && expressionRows[open.endRow].constraint < open.end)
            open.endRow++;
        for (int place : places)
            generalParticles.push_back(layout.kinds[cluster.kind].getParticle(cluster.number, place));
        open.endParticle = (int) generalParticles.size();
    };
    auto closePart = [&]() {
        if (open.end == open.first)
            return;
        wholeParts.push_back(open);
        beginNext();
    };
    closePart(); // the batches
    for (const ClusterLayout::Cluster& cluster : general) {
        const ClusterElimination& elimination = layout.kinds[cluster.kind].elimination;
        if (elimination.pieces.size() == 1) {
            if (elimination.hasWideColumns)
                closePart();
            extend(elimination.pieces[0].constraints, elimination.pieces[0].particles, cluster);
            if (elimination.hasWideColumns || open.end - open.first >= PART_SIZE)
                closePart();
            continue;
        }
        closePart();
        CutCluster cut;
        cut.firstPiece = (int) pieces.size();
        for (const ClusterElimination::Piece& piece : elimination.pieces) {
            extend(piece.constraints, piece.particles, cluster);
            pieces.push_back(open);
            pieces.back().piece = (int) pieces.size() - 1;
            beginNext();
        }
        cut.endPiece = (int) pieces.size();
        extend(elimination.joints, {}, cluster);
        cut.joints = open;
        cutClusters.push_back(cut);
        beginNext();
    }
    closePart();
    numParts = open.index;
}

// The expressions of each part by their groups.
void ConstraintSystem::findGroupRanges() {
    for (size_t group = 0; group < groups.size(); group++)
        groupRanges.push_back({(int) group, 0, groups[group]->getNumConstraints()});
    auto addRangesOf = [&](Part& part) {
        std::map<int, GroupRange> ranges;
        for (int r = part.firstRow; r < part.endRow; r++) {
            const std::pair<int, int>& place = placeInGroups[expressionOf(expressionRows[r].constraint)];
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
