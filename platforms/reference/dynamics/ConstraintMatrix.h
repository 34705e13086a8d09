// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTMATRIX_H_
#define OPENMMVRATTLE_CONSTRAINTMATRIX_H_

#include "ConstraintSystem.h"
#include "StepFailure.h"
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * The constraint matrix K = G M^-1 G^T and its factorisation L D L^T, block by block: one block a cluster. The pattern is
 * analysed once; each factorisation computes the values in place and costs time linear in the number of constraints.
 *
 * Small clusters (rigid molecules, CH_n groups) are factorised as dense blocks, large ones (chains, proteins with all
 * bonds fixed) with a sparse factorisation in a fill-reducing order.
 */
class ConstraintMatrix {
public:
    explicit ConstraintMatrix(const ConstraintSystem& system);
    /**
     * Compute and factorise K for a Jacobian.
     *
     * @throws DependentConstraints    if a pivot D_k is not larger than 1e-10 K_kk: the constraints of that cluster
     *                                 depend on each other
     */
    void factorize(const ConstraintSystem::Jacobian& jacobian);
    /** Replace x by K^-1 x. */
    void solve(std::vector<double>& x) const;

private:
    typedef Eigen::SparseMatrix<double> SparseMatrix;
    struct DenseBlock {
        int cluster, first, size;
        size_t offset; // of the block's size*size values, by rows, of which the lower triangle is used
    };
    struct SparseBlock {
        int cluster, first, size;
        SparseMatrix matrix; // the lower triangle
        Eigen::SimplicialLDLT<SparseMatrix, Eigen::Lower> factor;
    };
    void createSparsePattern(SparseBlock& block, size_t firstCoupling, size_t endCoupling);
    void factorizeDense(const DenseBlock& block);
    void factorizeSparse(SparseBlock& block);
    [[noreturn]] void throwDependent(int cluster) const;
    const ConstraintSystem& system;
    std::vector<DenseBlock> denseBlocks;
    std::vector<std::unique_ptr<SparseBlock>> sparseBlocks;
    std::vector<double> denseValues, diagonal;
    std::vector<double*> slots; // where the coupling of the same index is added up
    mutable Eigen::VectorXd scratch;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTMATRIX_H_
