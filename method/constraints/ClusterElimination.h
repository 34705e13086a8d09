// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERELIMINATION_H_
#define OPENMMVRATTLE_CLUSTERELIMINATION_H_

#include "constraints/ClusterCut.h"
#include "constraints/EliminationOrder.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * How the constraints of a cluster are eliminated, worked out from its graph alone: first those of each piece, which may be done at the
 * same time, then the joints between them; and which entries the factor has. It is plain data, for a processor and a GPU alike.
 */
struct ClusterElimination {
    struct Piece {
        std::vector<int> constraints; // in the order of elimination
        std::vector<int> levels;      // of each of these; see EliminationOrder
        int numLevels;
        std::vector<int> particles;
        std::vector<int>
            borders; // the joints that share particles with the piece, by their places; in increasing order
        FactorColumns columns;       // of these constraints; the rows of the borders are behind theirs
        MatrixEntries borderEntries; // what is left between the rows of the borders, below the diagonal; sorted
    };
    /** What is to be small: all that is computed, or what has to be done one after the other. */
    enum Goal { LeastFill, FewLevels };

    ClusterElimination() = default;
    /**
     * @param particlesOf    the moving particles of each constraint of the cluster
     * @param cut            its pieces and joints, or one piece that is the whole; in each the order from which a better one is sought
     */
    ClusterElimination(const std::vector<std::vector<int>>& particlesOf, const ClusterCut& cut, Goal goal);
    std::vector<Piece> pieces;
    std::vector<int> joints; // in the order of elimination
    std::vector<int> jointLevels;
    int numJointLevels = 0;
    FactorColumns jointColumns;
    bool hasWideColumns = false; // in the factor of a piece; see EliminationOrder::WIDE
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERELIMINATION_H_
