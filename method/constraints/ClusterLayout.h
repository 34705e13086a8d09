// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERLAYOUT_H_
#define OPENMMVRATTLE_CLUSTERLAYOUT_H_

#include "constraints/ClusterBatch.h"
#include "constraints/ClusterElimination.h"
#include "expressions/ExpressionGroup.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * How the constraints of a System fall into clusters, which are joined by shared particles that move, and in which order each cluster
 * is eliminated. It is a value, made once for a System from masses and topology, and plain data to whoever reads it, on a processor
 * or for a GPU; constraints are counted as they are given, distances first and then expressions.
 */
struct ClusterLayout {
    /** The number of constraints that a piece of a large cluster has. */
    static constexpr int PIECE_SIZE = 1000;
    /** Small clusters of one topology, in the order of their first particles. */
    struct Batch {
        int numBonds;
        bool isTriangle;
        std::vector<ClusterShape> shapes; // that occur
        std::vector<int> shapeOf;         // of each cluster
        std::vector<int> constraints, particles; // cluster after cluster, in the order of ClusterBatch::arrange()
    };

    /**
     * @param inverseMasses    1/mass of each particle, 0 for one that does not move; a distance constraint between two of
     *                         these is in no cluster
     */
    ClusterLayout(const std::vector<double>& inverseMasses, const std::vector<DistanceConstraint>& distances,
                  const std::vector<ExpressionConstraint>& expressions);
    std::vector<Batch> batches;
    std::vector<ClusterElimination>
        general; // the others: first those that are not cut, of these the ones with an expression last
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERLAYOUT_H_
