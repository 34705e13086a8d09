// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/NewtonMatrix.h"
#include <cmath>

using namespace OpenMMVRattle;
using std::vector;

namespace {

// Above this size a block is factorised as a sparse matrix.
const int MAX_DENSE_SIZE = 32;

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

bool NewtonMatrix::factorize(const ConstraintSystem::Jacobian& next, const ConstraintSystem::Jacobian& current) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    for (Block& block : blocks) {
        bool isDense = block.size <= MAX_DENSE_SIZE;
        vector<Eigen::Triplet<double>> triplets;
        if (isDense)
            block.dense.setZero(block.size, block.size);
        for (size_t c = block.firstCoupling; c < block.endCoupling; c++) {
            const int a = couplings[c].row, b = couplings[c].column; // entries of the Jacobians
            const int row = system.getConstraintOf(a), column = system.getConstraintOf(b), first = block.first;
            double lower = couplings[c].factor * next[a].dot(current[b]);
            double upper = couplings[c].factor * next[b].dot(current[a]);
            if (isDense) {
                block.dense(row - first, column - first) += lower;
                if (row != column)
                    block.dense(column - first, row - first) += upper;
            }
            else {
                triplets.emplace_back(row - first, column - first, lower);
                if (row != column)
                    triplets.emplace_back(column - first, row - first, upper);
            }
        }
        if (isDense) {
            block.denseFactor.compute(block.dense);
            double determinant = block.denseFactor.matrixLU().diagonal().prod();
            if (determinant == 0 || !std::isfinite(determinant))
                return false;
        }
        else {
            bool isNew = block.sparseFactor == nullptr;
            if (isNew) {
                block.sparse.resize(block.size, block.size);
                block.sparseFactor.reset(new Eigen::SparseLU<SparseMatrix>);
            }
            block.sparse.setFromTriplets(triplets.begin(), triplets.end());
            if (isNew)
                block.sparseFactor->analyzePattern(block.sparse);
            block.sparseFactor->factorize(block.sparse);
            if (block.sparseFactor->info() != Eigen::Success)
                return false;
        }
    }
    return true;
}

void NewtonMatrix::solve(vector<double>& x) const {
    for (const Block& block : blocks) {
        Eigen::Map<Eigen::VectorXd> y(&x[block.first], block.size);
        if (block.size <= MAX_DENSE_SIZE)
            y = block.denseFactor.solve(y).eval();
        else
            y = block.sparseFactor->solve(y).eval();
    }
}
