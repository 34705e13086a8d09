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

class ClusterKinds {
public:
    static const int MAX_CONSTRAINTS = 8;
    /** Sort the particles of a System that have mass into kinds; those with most constraints come first. */
    static std::vector<ClusterKind> find(const OpenMM::System& system);
    /** Whether no cluster has more than MAX_CONSTRAINTS constraints. */
    static bool areAllSmall(const std::vector<ClusterKind>& kinds);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERKINDS_H_
