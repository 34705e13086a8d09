// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERBATCH_H_
#define OPENMMVRATTLE_CLUSTERBATCH_H_

#include "constraints/ClusterLayout.h"
#include "constraints/ClusterStages.h"
#include "openmm/Vec3.h"
#include <memory>

namespace OpenMMVRattle {

/**
 * The arrays and numbers of a step, as the cluster kernels see them. Particle arrays are in the order of the particles,
 * constraint arrays in the internal order.
 */
struct StepArrays {
    const OpenMM::Vec3* q;      // q[n]
    const OpenMM::Vec3* start; // the velocities before the kick: M^-1 p[n-1/2], or v of a step from the on-step state
    const OpenMM::Vec3* force; // F(q[n]), or null if there is none
    OpenMM::Vec3* qNext; // q[n+1]
    OpenMM::Vec3* wNext; // M^-1 p[n+1/2]
    double* lambda; // the multipliers of the step
    double* change; // what the iteration adds to them next
    double* lambdaPlus; // Lambda(q[n], p[n+1/2])
    double* rightSidePlus; // K times it
    double kick, drift; // w+ = start + kick M^-1 (F - G^T lambda), q+ = q + drift w+
};

/** The arrays of the second half of a step, at the new positions. */
struct OnStepArrays {
    const OpenMM::Vec3* q; // q[n+1]
    const OpenMM::Vec3* w; // M^-1 p[n+1/2]
    const OpenMM::Vec3* force; // F(q[n+1])
    OpenMM::Vec3* v; // M^-1 p[n+1]
    double* lambda; // Lambda(q[n+1], p[n+1])
    double* rightSide; // K times it
    double* lambdaHalf; // Lambda(q[n+1], p[n+1/2]); null if it is not wanted, and so is the following
    double* rightSideHalf; // K times it
    OpenMM::Vec3* acceleration; // M^-1 (F - G^T Lambda), or null if it is not wanted
    double kick; // of (3.12), h/(2 rho)
};

/**
 * Small clusters of one topology, such as all the waters of a box or all CH2 groups; their masses and lengths may differ. All arithmetic of a step on a cluster is done in one pass, in registers, on PACK_SIZE
 * clusters at a time; nothing is kept between passes but the multipliers.
 */
class ClusterBatch {
public:
    virtual ~ClusterBatch() {
    }
    /** The number of clusters. */
    virtual int getSize() const = 0;
    /**
     * The first cluster whose first particle is not before a given one, rounded up to a multiple of PACK_SIZE. Clusters are in the
     * order of their first particles.
     */
    virtual int findCluster(int particle) const = 0;
    /** The particles of a cluster; those of the next follow. */
    virtual const int* getParticles(int cluster) const = 0;
    /** The first constraint of a cluster in the internal order. */
    virtual int getFirstConstraint(int cluster) const = 0;
    /**
     * Solve g(q+) = 0 for the clusters first, ..., end - 1 (first is a multiple of PACK_SIZE) by Newton's iteration with the matrix of
     * the guess, each pack of clusters as often as it needs.
     *
     * @param[in,out] numUpdates    the number of updates of the cluster that needed most
     * @return the largest |g| left; larger than the tolerance, or a NaN, if a cluster did not converge quickly
     */
    virtual double solvePositions(const StepArrays& step, int first, int end, const ChordStages& stages,
                                  int& numUpdates) const = 0;
    /**
     * One pass of the coupled iteration: lambda += change, the positions and velocities from it, Lambda(q, p+), and the next
     * change.
     *
     * @return the largest |g| before the next change
     */
    virtual double coupledPass(const StepArrays& step, int first, int end) const = 0;
    /**
     * The second half of a step for the clusters first, ..., end - 1.
     *
     * @return the smallest pivot of K relative to its diagonal entry, or a NaN
     */
    virtual double finish(const OnStepArrays& step, int first, int end) const = 0;

    /**
     * The clusters of a kind as a batch, or null if there are no kernels for this topology: there are for stars of up to four bonds and
     * for triangles.
     *
     * @param firstConstraint    the first constraint of the batch in the internal order; the others follow, cluster after cluster
     */
    static std::unique_ptr<ClusterBatch> create(const ClusterLayout& layout, const ClusterKind& kind,
                                                int firstConstraint);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERBATCH_H_
