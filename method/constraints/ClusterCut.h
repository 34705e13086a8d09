// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERCUT_H_
#define OPENMMVRATTLE_CLUSTERCUT_H_

#include <vector>

namespace OpenMMVRattle {

/**
 * A large cluster cut into pieces of neighbouring particles. The constraints within different pieces have no particle in common,
 * so that they can be worked on at the same time, and one piece after the other while the processor's caches have it. What
 * remains are the joints, the constraints between pieces, which are solved for when all pieces have been eliminated.
 */
struct ClusterCut {
    struct Piece {
        std::vector<int> constraints, particles;
    };
    std::vector<Piece> pieces; // none if the cluster is better left whole
    std::vector<int> joints;
};

/** A cluster as one piece. */
ClusterCut leaveWhole(const std::vector<std::vector<int>>& particlesOf);

/**
 * Cut a cluster across its length. One that has none, as a sheet or a network, would get many joints, and is left whole.
 *
 * @param particlesOf    the moving particles of each constraint of the cluster
 * @param pieceSize      the number of constraints a piece should have
 * @return constraints counted as in particlesOf, particles by the numbers used there
 */
ClusterCut cutCluster(const std::vector<std::vector<int>>& particlesOf, int pieceSize);

/**
 * Cut a cluster along a tree that spans it, into pieces of at least pieceSize particles and mostly not many more: a molecule, which is
 * nearly a tree, gets about one joint a piece.
 *
 * @param particlesOf    the moving particles of each constraint of the cluster, which hang together
 */
ClusterCut cutClusterAlongTree(const std::vector<std::vector<int>>& particlesOf, int pieceSize);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERCUT_H_
