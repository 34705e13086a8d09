// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERFORCES_H_
#define OPENMMVRATTLE_CLUSTERFORCES_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <algorithm>
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
    /**
     * sums[c], the sum of term(i) over the particles i of each cluster c, on several threads where that is faster. Threads share the
     * particles, cluster after cluster, so that a large one is as good as many small ones.
     */
    template <class Term> void sumOverClusters(const Term& term, std::vector<double>& sums) {
        const int count = (int) particles.size();
        solver.share(count, [&](int first, int end) {
            int cluster = findClusterAt(first);
            for (int p = first; p < end; cluster++) {
                double sum = 0;
                for (const int last = std::min(end, firstParticles[cluster + 1]); p < last; p++)
                    sum += term(particles[p]);
                (firstParticles[cluster] < first ? heads[first / SharedWork::RANGE_SIZE] : sums[cluster]) = sum;
            }
        });
        // What a range has of a cluster that begins before it.
        for (int first = SharedWork::RANGE_SIZE; first < count; first += SharedWork::RANGE_SIZE) {
            const int cluster = findClusterAt(first);
            if (firstParticles[cluster] < first)
                sums[cluster] += heads[first / SharedWork::RANGE_SIZE];
        }
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
    int findClusterAt(int place) const {
        return (int) (std::upper_bound(firstParticles.begin(), firstParticles.end(), place) - firstParticles.begin()) -
               1;
    }
    ConstraintSolver& solver;
    int numClusters;
    std::vector<int> particles;      // that move, cluster after cluster
    std::vector<int> firstParticles; // of each cluster, by places; and the end of all
    std::vector<double> heads;       // of each range
    std::vector<OpenMM::Vec3> netForces;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERFORCES_H_
