// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/NewtonMatrix.h"
#include <algorithm>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using std::vector;

namespace {

// Above this size a block is factorised as a sparse matrix.
const int MAX_DENSE_SIZE = 32;
// Of a matrix whose rows and columns are scaled to vectors of length one: below it there is rounding alone.
const double MIN_PIVOT = 1e-13;

} // namespace

NewtonMatrix::NewtonMatrix(const ConstraintSystem& system) : system(system) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    size_t coupling = 0;
    for (const ConstraintSystem::Cluster& cluster : system.getClusters()) {
        Block block;
        block.first = cluster.first;
        block.size = cluster.size;
        block.firstCoupling = coupling;
        while (coupling < couplings.size() &&
               system.getConstraintOf(couplings[coupling].row) < cluster.first + cluster.size)
            coupling++;
        block.endCoupling = coupling;
        blocks.push_back(std::move(block));
    }
}

// Eigen keeps the pivots with L.
double NewtonMatrix::SparseFactor::findSmallestPivot() const {
    double smallest = std::numeric_limits<double>::infinity();
    for (Eigen::Index column = 0; column < cols(); column++)
        for (SCMatrix::InnerIterator entry(m_Lstore, column); entry; ++entry)
            if (entry.index() == column) {
                smallest = std::min(smallest, std::fabs(entry.value()));
                break;
            }
    return smallest;
}

// 1/|M^(-1/2) G_k^T|, so that neither pivoting nor the test for a singular matrix depends on how a constraint is scaled.
void NewtonMatrix::findScales(const ConstraintSystem::Jacobian& jacobian, vector<double>& scales) const {
    scales.assign(system.getNumConstraints(), 0.0);
    for (const ConstraintSystem::Coupling& each : system.getCouplings())
        if (each.row == each.column)
            scales[system.getConstraintOf(each.row)] += each.factor * jacobian[each.row].dot(jacobian[each.row]);
    for (double& scale : scales)
        scale = 1 / std::sqrt(scale);
}

bool NewtonMatrix::factorize(const ConstraintSystem::Jacobian& next, const ConstraintSystem::Jacobian& current) {
    findScales(next, rowScales);
    findScales(current, columnScales);
    for (Block& block : blocks)
        if (!factorize(block, next, current))
            return false;
    return true;
}

bool NewtonMatrix::factorize(Block& block, const ConstraintSystem::Jacobian& next,
                             const ConstraintSystem::Jacobian& current) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    vector<Eigen::Triplet<double>> triplets;
    for (size_t c = block.firstCoupling; c < block.endCoupling; c++) {
        const int a = couplings[c].row, b = couplings[c].column; // entries of the Jacobians
        const int row = system.getConstraintOf(a), column = system.getConstraintOf(b);
        auto add = [&](int k, int l, double value) {
            value *= couplings[c].factor * rowScales[k] * columnScales[l];
            triplets.emplace_back(k - block.first, l - block.first, value);
        };
        add(row, column, next[a].dot(current[b]));
        if (row != column)
            add(column, row, next[b].dot(current[a]));
    }
    const bool isFinite =
        std::all_of(triplets.begin(), triplets.end(), [](const auto& each) { return std::isfinite(each.value()); });
    if (!isFinite)
        return false;
    if (block.size <= MAX_DENSE_SIZE) {
        block.dense.setZero(block.size, block.size);
        for (const auto& each : triplets)
            block.dense(each.row(), each.col()) += each.value();
        block.denseFactor.compute(block.dense);
        return block.denseFactor.matrixLU().diagonal().cwiseAbs().minCoeff() > MIN_PIVOT;
    }
    const bool isNew = block.sparseFactor == nullptr;
    if (isNew) {
        block.sparse.resize(block.size, block.size);
        block.sparseFactor.reset(new SparseFactor);
    }
    block.sparse.setFromTriplets(triplets.begin(), triplets.end());
    if (isNew)
        block.sparseFactor->analyzePattern(block.sparse);
    block.sparseFactor->factorize(block.sparse);
    return block.sparseFactor->info() == Eigen::Success && block.sparseFactor->findSmallestPivot() > MIN_PIVOT;
}

void NewtonMatrix::solve(vector<double>& x) const {
    for (size_t k = 0; k < x.size(); k++)
        x[k] *= rowScales[k];
    for (const Block& block : blocks) {
        Eigen::Map<Eigen::VectorXd> y(&x[block.first], block.size);
        if (block.size <= MAX_DENSE_SIZE)
            y = block.denseFactor.solve(y).eval();
        else
            y = block.sparseFactor->solve(y).eval();
    }
    for (size_t k = 0; k < x.size(); k++)
        x[k] *= columnScales[k];
}
