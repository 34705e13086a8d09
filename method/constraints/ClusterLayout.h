// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERLAYOUT_H_
#define OPENMMVRATTLE_CLUSTERLAYOUT_H_

#include "constraints/ClusterElimination.h"
#include "constraints/DistanceConstraint.h"
#include "expressions/ExpressionGroup.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * Clusters of the same constraint graph, so that what is worked out for one of them, or written for it as code, serves all. Particles
 * and constraints of a cluster are counted by their places in it: particles with more constraints first, so that equal molecules whose
 * particles are written in another order are mostly of one kind; of a triangle the one between two equal bonds.
 */
struct ClusterKind {
    /** A cluster with so few constraints, all of them distances, is small: one thread of a GPU can have all of it. */
    static constexpr int MOST_OF_SMALL = 8;
    int numParticles = 0;                      // of a cluster, that move
    std::vector<std::vector<int>>
        particlesOf; // those of each constraint, distances before expressions; of a distance in order
    bool hasExpressions = false;
    std::vector<int> particles;   // of all clusters, one after the other: in the order of their first particles
    std::vector<int> constraints; // likewise
    ClusterElimination elimination; // for a processor that does one thing after the other
    /**
     * The elimination for a processor that does much at once: in few levels, and in pieces of about so many particles, or whole. A
     * device asks for it once, with a size that suits it.
     */
    ClusterElimination eliminateInRounds(int pieceSize = WHOLE) const;
    static constexpr int WHOLE = 0;
    int getNumConstraints() const {
        return (int) particlesOf.size();
    }
    int getNumClusters() const {
        return (int) particles.size() / numParticles;
    }
    /** A particle, or a constraint, of a cluster. */
    int getParticle(int cluster, int place) const {
        return particles[(size_t) cluster * numParticles + place];
    }
    int getConstraint(int cluster, int place) const {
        return constraints[(size_t) cluster * particlesOf.size() + place];
    }
    bool isSmall() const {
        return !hasExpressions && getNumConstraints() <= MOST_OF_SMALL;
    }
};

/**
 * How the constraints of a System fall into clusters, which are joined by shared particles that move; which of these are of one kind;
 * and in which order each is eliminated. It is a value, made once for a System from masses and topology, and plain data to whoever
 * reads it, on a processor or for a GPU; constraints are counted as they are given, distances first and then expressions.
 */
struct ClusterLayout {
    /** The number of constraints that a piece of a large cluster has on a processor. */
    static constexpr int PIECE_SIZE = 1000;
    struct Cluster {
        int kind, number; // in the kind
    };

    /**
     * @param masses    of each particle, 0 for one that does not move; a distance constraint between two of these is in no cluster
     */
    ClusterLayout(const std::vector<double>& masses, const std::vector<DistanceConstraint>& distances,
                  const std::vector<ExpressionConstraint>& expressions);
    std::vector<double> inverseMasses; // 0 for a particle that does not move
    std::vector<DistanceConstraint> distances;
    /**
     * In the order of the numbers of constraints and of particles. The first has no constraints: each particle that is free is one of its
     * clusters, of which there may be none.
     */
    std::vector<ClusterKind> kinds;
    std::vector<Cluster> clusters; // with constraints, in the order of the first of these
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERLAYOUT_H_
