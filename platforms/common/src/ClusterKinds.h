// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERKINDS_H_
#define OPENMMVRATTLE_CLUSTERKINDS_H_

#include "openmm/System.h"
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * The clusters of constrained particles that have the same constraint graph, so that one piece of code serves them all; or the
 * particles that are in no constraint.
 */
struct ClusterKind {
    int numAtoms = 1;
    std::vector<std::pair<int, int>> pairs;         // the constraints, by places of the particles in the cluster
    std::vector<std::vector<int>> atoms;            // of each cluster
    std::vector<std::vector<double>> lengths;       // of each cluster, in nm
    std::vector<std::vector<int>> constraints;      // of each cluster, by indices of the System
};

/** Sort the particles of a System that have mass into kinds by their distance constraints; those with most come first. */
class ClusterKinds {
public:
    /** What one thread can have. */
    static const int MAX_CONSTRAINTS = 8;
    /** @param areElsewhere    particles to be left out, with their constraints; none if it is empty */
    explicit ClusterKinds(const OpenMM::System& system, const std::vector<char>& areElsewhere = {});
    /** The kinds with up to MAX_CONSTRAINTS constraints, and those with more. */
    std::vector<ClusterKind> small, large;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERKINDS_H_
