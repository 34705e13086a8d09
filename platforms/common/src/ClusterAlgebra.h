// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERALGEBRA_H_
#define OPENMMVRATTLE_CLUSTERALGEBRA_H_

#include "constraints/ClusterLayout.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * Writes the linear algebra of a small cluster of distance constraints as straight-line code: only those entries of K = G M^-1 G^T
 * and of its factor that the constraint graph makes non-zero are named, in the order of elimination of its kind, which keeps them few.
 */
class ClusterAlgebra {
public:
    explicit ClusterAlgebra(const ClusterKind& kind);
    /** The functions that kernels/cluster.cc asks for. */
    std::string write() const;
    /** The number of entries of the factor L, the diagonal included. */
    int getNumEntries() const;

private:
    std::string weight(int k, int l) const;
    bool isEntry(int i, int j) const {
        return entries[i][j] >= 0;
    }
    std::string lower(int i, int j) const;
    std::string writeFactorize() const;
    std::string writeSolve() const;
    std::string writeNewton() const;
    std::string writeMove() const;
    const std::vector<std::vector<int>>& pairs; // the particles of each constraint
    std::vector<int> order;                     // constraints in the order of elimination
    std::vector<std::vector<int>> entries; // by places in that order: the index in L, -1 for none
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERALGEBRA_H_
