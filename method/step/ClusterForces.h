// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERFORCES_H_
#define OPENMMVRATTLE_CLUSTERFORCES_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * The net force N = F - G^T Lambda on each particle, applied and of constraints, and the clusters by which monitors add up what it
 * does: a cluster is a set of particles joined by constraints, and a free particle is one of its own.
 */
class ClusterForces {
public:
    explicit ClusterForces(ConstraintSolver& solver);
    int getNumClusters() const {
        return numClusters;
    }
    /** The cluster of each of the solver's moving particles, in their order. */
    const std::vector<int>& getClusters() const {
        return clusterOfParticle;
    }
    /** Go through the clusters, on several threads where that is faster: task(cluster, its first moving particle, the end of these). */
    template <class Task> void forClusters(const Task& task) const {
        solver.share(numClusters, [&](int first, int end) {
            for (int c = first; c < end; c++)
                task(c, &particles[firstParticles[c]], &particles[firstParticles[c + 1]]);
        });
    }
    /** N, valid until the next call. */
    const std::vector<OpenMM::Vec3>& findNetForces(const std::vector<OpenMM::Vec3>& positions,
                                                   const ExpressionParameters& parameters,
                                                   const std::vector<OpenMM::Vec3>& forces,
                                                   const std::vector<double>& multipliers);
    /** The particles of a cluster in words, for messages. */
    std::string describe(int cluster) const;
    /** (sum x^4)^(1/8), so that the largest count most. */
    double eighthRootOfFourthPowers(const std::vector<double>& x) const;

private:
    ConstraintSolver& solver;
    std::vector<int> clusterOfParticle;
    int numClusters;
    std::vector<int> firstParticles, particles; // of each cluster; one more than there are, which is the end of all
    std::vector<OpenMM::Vec3> netForces;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERFORCES_H_
