// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_NEWTONMATRIX_H_
#define OPENMMVRATTLE_NEWTONMATRIX_H_

#include "constraints/ConstraintSystem.h"
#include <Eigen/Core>
#include <Eigen/LU>
#include <Eigen/SparseCore>
#include <Eigen/SparseLU>
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * The unsymmetric matrix G(q+) M^-1 G(q)^T of the full Newton iteration (docs/method.md, section 8: A up to a factor),
 * block by block. It is the fall-back where the chord iteration with K(q) converges slowly, so its memory is taken at
 * the first use.
 */
class NewtonMatrix {
public:
    explicit NewtonMatrix(const ConstraintSystem& system);
    /** Compute and factorise the matrix; returns whether it is regular. */
    bool factorize(const ConstraintSystem::Jacobian& next, const ConstraintSystem::Jacobian& current);
    /** Replace x by the solution of A y = x. */
    void solve(std::vector<double>& x) const;

private:
    typedef Eigen::SparseMatrix<double> SparseMatrix;
    struct SparseFactor : Eigen::SparseLU<SparseMatrix> {
        double findSmallestPivot() const;
    };
    struct Block {
        int first, size;
        size_t firstCoupling, endCoupling;
        Eigen::MatrixXd dense;
        Eigen::PartialPivLU<Eigen::MatrixXd> denseFactor;
        SparseMatrix sparse;
        std::unique_ptr<SparseFactor> sparseFactor;
    };
    void findScales(const ConstraintSystem::Jacobian& jacobian, std::vector<double>& scales) const;
    bool factorize(Block& block, const ConstraintSystem::Jacobian& next, const ConstraintSystem::Jacobian& current);
    const ConstraintSystem& system;
    std::vector<Block> blocks;
    std::vector<double> rowScales, columnScales;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_NEWTONMATRIX_H_
