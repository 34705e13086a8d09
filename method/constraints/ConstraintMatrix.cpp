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

// Which entries there are is known cluster by cluster (ClusterElimination); here is where they are kept.
ConstraintMatrix::Analysis ConstraintMatrix::analyse(const ConstraintSystem& system) {
    Analysis result;
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    auto rowOf = [&](size_t i) { return system.getConstraintOf(couplings[i].row); };
    auto columnOf = [&](size_t i) { return system.getConstraintOf(couplings[i].column); };
    size_t next = 0;
    // Couplings are in the order of the parts, and in a piece's are those with its joints.
    auto add = [&](const Part& part, const FactorColumns& columns, vector<int> outer) -> PartAnalysis& {
        PartAnalysis each;
        const int size = part.end - part.first;
        each.first = part.first;
        each.outer = std::move(outer);
        each.pattern = FactorPattern(columns, (int) each.outer.size());
        each.firstCoupling = next;
        for (; next < couplings.size() && columnOf(next) < part.end; next++) {
            const int k = rowOf(next);
            const auto place = std::lower_bound(each.outer.begin(), each.outer.end(), k);
            const int row = k < part.end ? k - part.first : size + (int) (place - each.outer.begin());
            each.couplingSlots.push_back(each.pattern.findSlot(row, columnOf(next) - part.first));
        }
        each.endCoupling = next;
        result.push_back(std::move(each));
        return result.back();
    };
    auto cluster = system.getClusters().begin();
    for (const Part& part : system.getWholeParts()) {
        FactorColumns columns;
        for (; cluster != system.getClusters().end() && cluster->first < part.end; ++cluster)
            columns.append(system.getEliminationOf(*cluster).pieces[0].columns);
        add(part, columns, {});
    }
    for (const ConstraintSystem::CutCluster& cut : system.getCutClusters()) {
        const ClusterElimination& elimination = system.getEliminationOf(*cluster++);
        const size_t firstPiece = result.size();
        for (size_t p = 0; p < elimination.pieces.size(); p++) {
            vector<int> outer = elimination.pieces[p].borders;
            for (int& joint : outer)
                joint += cut.joints.first;
            add(system.getPieces()[cut.firstPiece + p], elimination.pieces[p].columns, std::move(outer));
        }
        const FactorPattern joints = add(cut.joints, elimination.jointColumns, {}).pattern;
        for (size_t p = 0; p < elimination.pieces.size(); p++) {
            const ClusterElimination::Piece& piece = elimination.pieces[p];
            PartAnalysis& each = result[firstPiece + p];
            const int size = (int) piece.constraints.size();
            auto leave = [&](int row, int column) {
                each.left.push_back({each.pattern.findSlot(row, column),
                                     joints.findSlot(piece.borders[row - size], piece.borders[column - size])});
            };
            for (int b = 0; b < (int) piece.borders.size(); b++)
                leave(size + b, size + b);
            for (const auto& entry : piece.borderEntries)
                leave(entry.first, entry.second);
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
        for (const Left& each : (*analysis)[index].left)
            joints.add(each.to, factors[index].factor.getValue(each.from));
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
