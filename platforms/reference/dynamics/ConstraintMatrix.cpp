// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ConstraintMatrix.h"

using namespace OpenMMVRattle;
using std::vector;

namespace {

// Up to this size a dense block is factorised faster than a sparse one.
const int MAX_DENSE_SIZE = 16;
// A pivot below this fraction of its diagonal entry means dependent constraints. Dependent sets leave pivots of 1e-16
// or negative ones, while a legitimate chain of mass ratio R gives 2/R.
const double MIN_RELATIVE_PIVOT = 1e-10;

} // namespace

ConstraintMatrix::ConstraintMatrix(const ConstraintSystem& system) : system(system) {
    const vector<ConstraintSystem::Cluster>& clusters = system.getClusters();
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    size_t numDenseValues = 0;
    int largestSparse = 0;
    for (int c = 0; c < (int) clusters.size(); c++)
        if (clusters[c].size <= MAX_DENSE_SIZE) {
            denseBlocks.push_back({c, clusters[c].first, clusters[c].size, numDenseValues});
            numDenseValues += (size_t) clusters[c].size * clusters[c].size;
        }
        else
            largestSparse = std::max(largestSparse, clusters[c].size);
    denseValues.resize(numDenseValues);
    diagonal.resize(system.getNumConstraints());
    slots.resize(couplings.size());
    scratch.resize(largestSparse);

    // The couplings are ordered by row, and so by cluster.
    size_t coupling = 0, dense = 0;
    for (int c = 0; c < (int) clusters.size(); c++) {
        int first = clusters[c].first, size = clusters[c].size;
        size_t firstCoupling = coupling;
        while (coupling < couplings.size() && couplings[coupling].row < first + size)
            coupling++;
        if (size <= MAX_DENSE_SIZE) {
            double* values = &denseValues[denseBlocks[dense++].offset];
            for (size_t i = firstCoupling; i < coupling; i++)
                slots[i] = values + (couplings[i].row - first) * size + couplings[i].column - first;
        }
        else {
            sparseBlocks.emplace_back(new SparseBlock);
            sparseBlocks.back()->cluster = c;
            sparseBlocks.back()->first = first;
            sparseBlocks.back()->size = size;
            createSparsePattern(*sparseBlocks.back(), firstCoupling, coupling);
        }
    }
}

void ConstraintMatrix::createSparsePattern(SparseBlock& block, size_t firstCoupling, size_t endCoupling) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    vector<Eigen::Triplet<double>> triplets;
    for (size_t i = firstCoupling; i < endCoupling; i++)
        triplets.emplace_back(couplings[i].row - block.first, couplings[i].column - block.first, 1.0);
    block.matrix.resize(block.size, block.size);
    block.matrix.setFromTriplets(triplets.begin(), triplets.end());
    block.matrix.makeCompressed();
    for (size_t i = firstCoupling; i < endCoupling; i++)
        slots[i] = &block.matrix.coeffRef(couplings[i].row - block.first, couplings[i].column - block.first);
    block.factor.analyzePattern(block.matrix);
}

void ConstraintMatrix::factorize(const ConstraintSystem::Jacobian& jacobian) {
    const vector<ConstraintSystem::Coupling>& couplings = system.getCouplings();
    std::fill(denseValues.begin(), denseValues.end(), 0.0);
    for (auto& block : sparseBlocks)
        std::fill(block->matrix.valuePtr(), block->matrix.valuePtr() + block->matrix.nonZeros(), 0.0);
    // Two constraints that share both particles have two couplings with one slot, which must add up.
    for (size_t i = 0; i < couplings.size(); i++) {
        double value = couplings[i].factor * jacobian[couplings[i].row].dot(jacobian[couplings[i].column]);
        *slots[i] += value;
        if (couplings[i].row == couplings[i].column)
            diagonal[couplings[i].row] = value;
    }
    for (const DenseBlock& block : denseBlocks)
        factorizeDense(block);
    for (auto& block : sparseBlocks)
        factorizeSparse(*block);
}

// L D L^T in place: below the diagonal L, on it D.
void ConstraintMatrix::factorizeDense(const DenseBlock& block) {
    const int n = block.size;
    double* a = &denseValues[block.offset];
    for (int j = 0; j < n; j++) {
        double pivot = a[j * n + j];
        for (int k = 0; k < j; k++)
            pivot -= a[j * n + k] * a[j * n + k] * a[k * n + k];
        if (!(pivot > MIN_RELATIVE_PIVOT * diagonal[block.first + j]))
            throwDependent(block.cluster);
        a[j * n + j] = pivot;
        for (int i = j + 1; i < n; i++) {
            double sum = a[i * n + j];
            for (int k = 0; k < j; k++)
                sum -= a[i * n + k] * a[j * n + k] * a[k * n + k];
            a[i * n + j] = sum / pivot;
        }
    }
}

void ConstraintMatrix::factorizeSparse(SparseBlock& block) {
    block.factor.factorize(block.matrix);
    if (block.factor.info() != Eigen::Success)
        throwDependent(block.cluster);
    const Eigen::VectorXd& pivots = block.factor.vectorD();
    const auto& position = block.factor.permutationP().indices();
    for (int k = 0; k < block.size; k++)
        if (!(pivots[position[k]] > MIN_RELATIVE_PIVOT * diagonal[block.first + k]))
            throwDependent(block.cluster);
}

void ConstraintMatrix::throwDependent(int cluster) const {
    throw DependentConstraints(system.getClusterParticles(cluster));
}

void ConstraintMatrix::solve(vector<double>& x) const {
    for (const DenseBlock& block : denseBlocks) {
        const int n = block.size;
        const double* a = &denseValues[block.offset];
        double* y = &x[block.first];
        for (int i = 1; i < n; i++)
            for (int k = 0; k < i; k++)
                y[i] -= a[i * n + k] * y[k];
        for (int i = 0; i < n; i++)
            y[i] /= a[i * n + i];
        for (int i = n - 1; i > 0; i--)
            for (int k = 0; k < i; k++)
                y[k] -= a[i * n + k] * y[i];
    }
    for (const auto& block : sparseBlocks) {
        Eigen::Map<Eigen::VectorXd> y(&x[block->first], block->size);
        scratch.head(block->size) = block->factor.solve(y);
        y = scratch.head(block->size);
    }
}
