// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ConstraintMatrix.h"
#include "constraints/EliminationOrder.h"
#include <algorithm>
#include <set>

using namespace OpenMMVRattle;
using std::vector;

ConstraintMatrix::ConstraintMatrix(const ConstraintSystem& system) : system(system) {
    const int size = system.getNumConstraints();
    vector<std::pair<int, int>> entries;
    for (const auto& coupling : system.getCouplings())
        if (system.getConstraintOf(coupling.row) != system.getConstraintOf(coupling.column))
            entries.emplace_back(system.getConstraintOf(coupling.row), system.getConstraintOf(coupling.column));
    const vector<vector<int>> pattern = findFactorPattern(size, entries);
    columnStart.assign(1, 0);
    for (const vector<int>& column : pattern) {
        rows.insert(rows.end(), column.begin(), column.end());
        columnStart.push_back(rows.size());
    }
    values.resize(rows.size() + size);
    inversePivots.resize(size);
    findRemains();
    findUpdates();
    findCouplingSlots();
}

// Where an entry of the matrix is kept in values.
size_t ConstraintMatrix::findSlot(int row, int column) const {
    if (row == column)
        return rows.size() + row;
    const auto begin = rows.begin() + columnStart[column], end = rows.begin() + columnStart[column + 1];
    return (size_t) (std::lower_bound(begin, end, row) - rows.begin());
}

// Make room for what the pieces leave for the joints.
void ConstraintMatrix::findRemains() {
    numJointEntries.assign(system.getPieces().empty() ? 0 : system.getNumConstraints(), 0);
    for (const ConstraintSystem::Part& piece : system.getPieces()) {
        Remains r;
        r.firstEntry = jointSums.size();
        std::set<int> joints;
        std::set<size_t> slots;
        for (int column = piece.first; column < piece.end; column++) {
            const auto end = rows.begin() + columnStart[column + 1];
            const auto first = std::lower_bound(rows.begin() + columnStart[column], end, piece.end);
            numJointEntries[column] = (int) (end - first);
            jointSums.insert(jointSums.end(), first, end); // the joints, for now
            joints.insert(first, end);
            for (auto b = first; b != end; ++b)
                for (auto a = b; a != end; ++a)
                    slots.insert(findSlot(*a, *b));
        }
        for (int joint : joints)
            r.terms.push_back({(size_t) joint, numSums++});
        for (size_t slot : slots) {
            r.values.push_back({slot, values.size()});
            values.push_back(0.0);
        }
        for (size_t entry = r.firstEntry; entry < jointSums.size(); entry++)
            jointSums[entry] = (int) findAddition(r.terms, (size_t) jointSums[entry]).source;
        remains.push_back(r);
    }
    for (vector<double>& sum : sums)
        sum.resize(numSums);
}

const ConstraintMatrix::Addition& ConstraintMatrix::findAddition(const vector<Addition>& additions, size_t target) {
    return *std::lower_bound(additions.begin(), additions.end(), target,
                             [](const Addition& addition, size_t t) { return addition.target < t; });
}

void ConstraintMatrix::findUpdates() {
    const vector<ConstraintSystem::Part>& pieces = system.getPieces();
    size_t piece = 0;
    updateStart.assign(1, 0);
    for (int column = 0; column < system.getNumConstraints(); column++) {
        while (piece < pieces.size() && column >= pieces[piece].end)
            piece++;
        const size_t start = columnStart[column], end = columnStart[column + 1];
        const size_t firstJoint = end - (numJointEntries.empty() ? 0 : numJointEntries[column]);
        for (size_t b = start; b < end; b++)
            for (size_t a = b; a < end; a++) {
                const size_t slot = findSlot(rows[a], rows[b]);
                updates.push_back(
                    (unsigned) (b < firstJoint ? slot : findAddition(remains[piece].values, slot).source));
            }
        updateStart.push_back(updates.size());
    }
}

// The couplings are in the order of the parts, and within one in the order of rows; those of a piece with joints are the piece's.
void ConstraintMatrix::findCouplingSlots() {
    const int size = system.getNumConstraints();
    vector<int> endOfPiece(size, ConstraintSystem::NONE);
    for (const ConstraintSystem::Part& piece : system.getPieces())
        std::fill(endOfPiece.begin() + piece.first, endOfPiece.begin() + piece.end, piece.end);
    couplingStart.assign(size + 1, 0);
    for (const auto& coupling : system.getCouplings()) {
        const int row = system.getConstraintOf(coupling.row), column = system.getConstraintOf(coupling.column);
        couplingSlots.push_back((unsigned) findSlot(row, column));
        couplingStart[endOfPiece[column] == ConstraintSystem::NONE ? row + 1 : endOfPiece[column]] =
            couplingSlots.size();
    }
    for (int k = 0; k < size; k++) // a constraint without any
        couplingStart[k + 1] = std::max(couplingStart[k], couplingStart[k + 1]);
}

void ConstraintMatrix::factorize(const ConstraintSystem::Jacobian& jacobian) {
    const int failed = tryToFactorize(jacobian, ConstraintSystem::ALL);
    if (failed != REGULAR)
        throwDependent(failed, jacobian);
}

int ConstraintMatrix::tryToFactorize(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part) {
    if (part.end == ConstraintSystem::ALL.end) {
        int failed = REGULAR;
        forParts(part.first, [&](const ConstraintSystem::Part& each) {
            if (failed == REGULAR)
                failed = tryToFactorize(jacobian, each);
        });
        for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
            if (failed == REGULAR)
                failed = tryToFactorizeJoints(jacobian, cluster);
        return failed;
    }
    assemble(jacobian, part);
    if (part.piece != ConstraintSystem::NONE)
        for (const Addition& each : remains[part.piece].values)
            values[each.source] = 0;
    return eliminateColumns(part);
}

int ConstraintMatrix::tryToFactorizeJoints(const ConstraintSystem::Jacobian& jacobian,
                                           const ConstraintSystem::CutCluster& cluster) {
    assemble(jacobian, cluster.joints);
    for (int p = cluster.firstPiece; p < cluster.endPiece; p++)
        for (const Addition& each : remains[p].values)
            values[each.target] += values[each.source];
    return eliminateColumns(cluster.joints);
}

// The constraints in no cut cluster, as whole clusters, then the pieces; from the first general one on, or also those in batches.
template <class Task> void ConstraintMatrix::forParts(int first, const Task& task) const {
    if (first < system.getFirstGeneral())
        task({first, system.getFirstGeneral(), 0, 0, 0, 0, 0, 0, 0, 0, ConstraintSystem::NONE});
    for (const ConstraintSystem::Part& part : system.getGeneralParts())
        task(part);
    for (const ConstraintSystem::Part& piece : system.getPieces())
        task(piece);
}

// The entries of K in the columns of a part.
void ConstraintMatrix::assemble(const ConstraintSystem::Jacobian& jacobian, const ConstraintSystem::Part& part) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    double* diagonal = values.data() + rows.size();
    std::fill(values.begin() + columnStart[part.first], values.begin() + columnStart[part.end], 0.0);
    std::fill(diagonal + part.first, diagonal + part.end, 0.0);
    // Two constraints that share several particles have several couplings with one slot, which must add up.
    for (size_t i = couplingStart[part.first]; i < couplingStart[part.end]; i++)
        values[couplingSlots[i]] += couplings[i].factor * jacobian[couplings[i].row].dot(jacobian[couplings[i].column]);
    // The diagonal of K, to compare the pivots with, is kept where their inverses will be.
    std::copy(diagonal + part.first, diagonal + part.end, inversePivots.begin() + part.first);
}

int ConstraintMatrix::eliminateColumns(const ConstraintSystem::Part& part) {
    const double* diagonal = values.data() + rows.size();
    for (int column = part.first; column < part.end; column++) {
        const double pivot = diagonal[column];
        if (!(pivot > MIN_RELATIVE_PIVOT * inversePivots[column]))
            return column;
        const double inverse = 1 / pivot;
        inversePivots[column] = inverse;
        const size_t start = columnStart[column];
        const int count = (int) (columnStart[column + 1] - start);
        const unsigned* update = updates.data() + updateStart[column];
        double* entry = values.data() + start;
        for (int b = 0; b < count; b++) {
            const double scaled = entry[b] * inverse;
            for (int a = b; a < count; a++)
                values[*update++] -= entry[a] * scaled;
            entry[b] = scaled;
        }
    }
    return REGULAR;
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

void ConstraintMatrix::solve(vector<double>& x, const ConstraintSystem::Part& part) const {
    if (part.end == ConstraintSystem::ALL.end) {
        forParts(part.first, [&](const ConstraintSystem::Part& each) { eliminate(x, each); });
        for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
            solveJoints(x, cluster);
        forParts(part.first, [&](const ConstraintSystem::Part& each) { substitute(x, each); });
        return;
    }
    eliminate(x, part);
    substitute(x, part);
}

void ConstraintMatrix::eliminate(vector<double>& x, const ConstraintSystem::Part& part, int channel) const {
    if (part.piece == ConstraintSystem::NONE) {
        for (int column = part.first; column < part.end; column++) {
            const double value = x[column];
            for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
                x[rows[i]] -= values[i] * value;
            x[column] = value * inversePivots[column];
        }
        return;
    }
    const Remains& left = remains[part.piece];
    double* sum = sums[channel].data();
    for (const Addition& term : left.terms)
        sum[term.source] = 0;
    const int* jointSum = jointSums.data() + left.firstEntry;
    for (int column = part.first; column < part.end; column++) {
        const double value = x[column];
        const size_t end = columnStart[column + 1], firstJoint = end - numJointEntries[column];
        size_t i = columnStart[column];
        for (; i < firstJoint; i++)
            x[rows[i]] -= values[i] * value;
        for (; i < end; i++)
            sum[*jointSum++] -= values[i] * value;
        x[column] = value * inversePivots[column];
    }
}

void ConstraintMatrix::solveJoints(vector<double>& x, const ConstraintSystem::CutCluster& cluster, int channel) const {
    for (int p = cluster.firstPiece; p < cluster.endPiece; p++)
        for (const Addition& term : remains[p].terms)
            x[term.target] += sums[channel][term.source];
    eliminate(x, cluster.joints);
    substitute(x, cluster.joints);
}

void ConstraintMatrix::substitute(vector<double>& x, const ConstraintSystem::Part& part) const {
    for (int column = part.end - 1; column >= part.first; column--) {
        double value = x[column];
        for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
            value -= values[i] * x[rows[i]];
        x[column] = value;
    }
}
