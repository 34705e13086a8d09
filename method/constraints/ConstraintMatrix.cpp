// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ConstraintMatrix.h"
#include <algorithm>

using namespace OpenMMVRattle;
using std::vector;

typedef ConstraintSystem::Part Part;

ConstraintMatrix::PartFactor::PartFactor(const PartAnalysis& analysis) :
        factor(analysis.pattern), outerSolution(analysis.outer.size()) {
    for (vector<double>& sum : sums)
        sum.resize(analysis.outer.size());
}

ConstraintMatrix::ConstraintMatrix(const ConstraintSystem& system) :
        ConstraintMatrix(system, std::make_shared<const Analysis>(analyse(system))) {
}

ConstraintMatrix::ConstraintMatrix(const ConstraintSystem& system, const std::shared_ptr<const Analysis>& analysis) :
        system(system), analysis(analysis), factors(analysis->begin(), analysis->end()) {
}

ConstraintMatrix::Analysis ConstraintMatrix::analyse(const ConstraintSystem& system) {
    Analysis result;
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    auto rowOf = [&](size_t i) { return system.getConstraintOf(couplings[i].row); };
    auto columnOf = [&](size_t i) { return system.getConstraintOf(couplings[i].column); };
    size_t next = 0;
    // Couplings are in the order of the parts, and in a piece's are those with its joints. More entries are those by other ways.
    auto add = [&](const Part& part, MatrixEntries entries) {
        PartAnalysis each;
        const int size = part.end - part.first;
        each.first = part.first;
        each.firstCoupling = next;
        while (next < couplings.size() && columnOf(next) < part.end) {
            if (rowOf(next) >= part.end)
                each.outer.push_back(rowOf(next));
            next++;
        }
        each.endCoupling = next;
        std::sort(each.outer.begin(), each.outer.end());
        each.outer.erase(std::unique(each.outer.begin(), each.outer.end()), each.outer.end());
        auto localRow = [&](int k) {
            if (k < part.end)
                return k - part.first;
            return size + (int) (std::lower_bound(each.outer.begin(), each.outer.end(), k) - each.outer.begin());
        };
        for (size_t i = each.firstCoupling; i < each.endCoupling; i++)
            if (rowOf(i) != columnOf(i))
                entries.emplace_back(localRow(rowOf(i)), columnOf(i) - part.first);
        std::sort(entries.begin(), entries.end());
        entries.erase(std::unique(entries.begin(), entries.end()), entries.end());
        each.pattern = FactorPattern(size, (int) each.outer.size(), entries);
        for (size_t i = each.firstCoupling; i < each.endCoupling; i++)
            each.couplingSlots.push_back(each.pattern.findSlot(localRow(rowOf(i)), columnOf(i) - part.first));
        result.push_back(std::move(each));
    };
    for (const Part& part : system.getWholeParts())
        add(part, {});
    for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters()) {
        const int firstJoint = cluster.joints.first;
        MatrixEntries left; // for the joints by the pieces
        const size_t firstPiece = result.size();
        for (int p = cluster.firstPiece; p < cluster.endPiece; p++) {
            add(system.getPieces()[p], {});
            const vector<int>& outer = result.back().outer;
            for (size_t b = 0; b < outer.size(); b++)
                for (size_t a = b + 1; a < outer.size(); a++)
                    left.emplace_back(outer[a] - firstJoint, outer[b] - firstJoint);
        }
        const size_t joints = result.size();
        add(cluster.joints, left);
        for (size_t piece = firstPiece; piece < joints; piece++) {
            const vector<int>& outer = result[piece].outer;
            for (size_t b = 0; b < outer.size(); b++)
                for (size_t a = b; a < outer.size(); a++)
                    result[piece].outerSlots.push_back(
                        result[joints].pattern.findSlot(outer[a] - firstJoint, outer[b] - firstJoint));
        }
    }
    return result;
}

void ConstraintMatrix::factorize(const ConstraintSystem::Jacobian& jacobian) {
    const int failed = tryToFactorize(jacobian, ConstraintSystem::ALL);
    if (failed != REGULAR)
        throwDependent(failed, jacobian);
}

int ConstraintMatrix::tryToFactorize(const ConstraintSystem::Jacobian& jacobian, const Part& part) {
    if (part.end == ConstraintSystem::ALL.end) {
        int failed = REGULAR;
        forParts(part.first, [&](const Part& each) {
            if (failed == REGULAR)
                failed = tryToFactorize(jacobian, each);
        });
        for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
            if (failed == REGULAR)
                failed = tryToFactorizeJoints(jacobian, cluster);
        return failed;
    }
    assemble(jacobian, part);
    return factorizeAssembled(part);
}

int ConstraintMatrix::tryToFactorizeJoints(const ConstraintSystem::Jacobian& jacobian,
                                           const ConstraintSystem::CutCluster& cluster) {
    assemble(jacobian, cluster.joints);
    SparseFactor& joints = factors[cluster.joints.index].factor;
    for (int p = cluster.firstPiece; p < cluster.endPiece; p++) {
        const int index = system.getPieces()[p].index;
        const PartAnalysis& piece = (*analysis)[index];
        const unsigned* slot = piece.outerSlots.data();
        const size_t size = piece.outer.size();
        for (size_t b = 0; b < size; b++)
            for (size_t a = b; a < size; a++)
                joints.add(*slot++, factors[index].factor.getValue(piece.pattern.getFirstOuterValue() + b * size + a));
    }
    return factorizeAssembled(cluster.joints);
}

// The parts of whole clusters, then the pieces; from the first general constraint on, or also those in batches.
template <class Task> void ConstraintMatrix::forParts(int first, const Task& task) const {
    for (const Part& part : system.getWholeParts())
        if (part.first >= first)
            task(part);
    for (const Part& piece : system.getPieces())
        task(piece);
}

// The entries of K in the columns of a part.
void ConstraintMatrix::assemble(const ConstraintSystem::Jacobian& jacobian, const Part& part) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    const PartAnalysis& each = (*analysis)[part.index];
    SparseFactor& factor = factors[part.index].factor;
    factor.clear();
    // Two constraints that share several particles have several couplings with one slot, which must add up.
    for (size_t i = each.firstCoupling; i < each.endCoupling; i++)
        factor.add(each.couplingSlots[i - each.firstCoupling],
                   couplings[i].factor * jacobian[couplings[i].row].dot(jacobian[couplings[i].column]));
    factor.keepDiagonal();
}

int ConstraintMatrix::factorizeAssembled(const Part& part) {
    const int failed = factors[part.index].factor.factorize(MIN_RELATIVE_PIVOT);
    return failed == SparseFactor::REGULAR ? REGULAR : part.first + failed;
}

void ConstraintMatrix::throwDependent(int constraint, const ConstraintSystem::Jacobian& jacobian) const {
    const vector<ConstraintSystem::Cluster>& clusters = system.getClusters();
    size_t c = 0;
    while (constraint >= clusters[c].first + clusters[c].size)
        c++;
    for (int k = clusters[c].first; k < clusters[c].first + clusters[c].size; k++) {
        const std::string explanation = system.explainGradient(k, jacobian);
        if (!explanation.empty())
            throw StepFailure(explanation);
    }
    throw DependentConstraints(system.getClusterParticles((int) c), system.explainLine((int) c));
}

void ConstraintMatrix::solve(vector<double>& x, const Part& part) const {
    if (part.end == ConstraintSystem::ALL.end) {
        forParts(part.first, [&](const Part& each) { eliminate(x, each); });
        for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
            solveJoints(x, cluster);
        forParts(part.first, [&](const Part& each) { substitute(x, each); });
        return;
    }
    eliminate(x, part);
    substitute(x, part);
}

void ConstraintMatrix::eliminate(vector<double>& x, const Part& part, int channel) const {
    const PartFactor& each = factors[part.index];
    std::fill(each.sums[channel].begin(), each.sums[channel].end(), 0.0);
    each.factor.eliminate(x.data() + part.first, each.sums[channel].data());
}

void ConstraintMatrix::solveJoints(vector<double>& x, const ConstraintSystem::CutCluster& cluster, int channel) const {
    for (int p = cluster.firstPiece; p < cluster.endPiece; p++) {
        const int index = system.getPieces()[p].index;
        const vector<int>& outer = (*analysis)[index].outer;
        for (size_t k = 0; k < outer.size(); k++)
            x[outer[k]] += factors[index].sums[channel][k];
    }
    eliminate(x, cluster.joints);
    substitute(x, cluster.joints);
}

void ConstraintMatrix::substitute(vector<double>& x, const Part& part) const {
    const PartFactor& each = factors[part.index];
    const vector<int>& outer = (*analysis)[part.index].outer;
    for (size_t k = 0; k < outer.size(); k++)
        each.outerSolution[k] = x[outer[k]];
    each.factor.substitute(x.data() + part.first, each.outerSolution.data());
}
