// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTSYSTEM_H_
#define OPENMMVRATTLE_CONSTRAINTSYSTEM_H_

#include "openmm/Vec3.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

class ClusterBatch;

/** The distance between two particles is fixed: |q1 - q2| = length (nm). */
struct DistanceConstraint {
    int particle1, particle2;
    double length;
};

/**
 * The constraints g(q) = 0 of a system of particles, their Jacobian G = dg/dq, and the products with it that the method needs.
 *
 * Each distance constraint is written in relative form, g = (|r|^2 - L^2)/(2 L^2) with r = q1 - q2, so that g is the
 * relative error of the distance and one tolerance serves all. Its row of G is r/L^2 on particle 1 and the opposite on
 * particle 2. A multiplier of this form is 2 L^2 times the multiplier of |r|^2 - L^2; see toDistanceMultiplier().
 *
 * Constraints are kept in an internal order in which those of one cluster (constraints joined by shared particles) are
 * neighbours: first the small clusters that come in batches of one shape, then the general ones. The functions below take
 * a first constraint and work on those from there on: 0 for all, getFirstGeneral() for the general clusters. Constraints
 * between two particles of mass zero cannot move anything and are left out.
 */
class ConstraintSystem {
public:
    /** The rows of G, one per constraint in internal order: the part that acts on particle 1, 1/nm. */
    typedef std::vector<OpenMM::Vec3> Jacobian;
    /** A cluster: the constraints first, ..., first + size - 1 of the internal order. */
    struct Cluster {
        int first, size;
    };
    /**
     * Where a block of neighbouring particles begins in the lists that are worked through block by block, so that what
     * belongs together is in the processor's caches together.
     */
    struct Block {
        std::vector<int> clusters; // the first cluster of each batch; a multiple of PACK_SIZE
        int freeParticle;          // the first in getFreeParticles()
    };
    /** Two constraints share a particle: an entry of K = G M^-1 G^T is the sum of factor * (row . column). */
    struct Coupling {
        int row, column; // row >= column
        double factor;   // +-1/mass of the shared particle, or 1/m1 + 1/m2 on the diagonal
    };

    /**
     * @param masses         the mass of each particle (amu); 0 for a particle that does not move
     * @param constraints    the distance constraints
     */
    ConstraintSystem(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints);
    ~ConstraintSystem();

    int getNumParticles() const {
        return (int) masses.size();
    }
    int getNumConstraints() const {
        return (int) constraints.size();
    }
    /** The number of constraints that were given to the constructor, with those that were left out. */
    int getNumGivenConstraints() const {
        return numGivenConstraints;
    }
    const std::vector<double>& getMasses() const {
        return masses;
    }
    /** 1/mass, and 0 for a particle of mass zero. */
    const std::vector<double>& getInverseMasses() const {
        return inverseMasses;
    }
    const DistanceConstraint& getConstraint(int index) const {
        return constraints[index];
    }
    const std::vector<Cluster>& getClusters() const {
        return clusters;
    }
    const std::vector<Coupling>& getCouplings() const {
        return couplings;
    }
    /** The batches of small clusters, whose constraints come first in the internal order. */
    const std::vector<std::unique_ptr<ClusterBatch>>& getBatches() const {
        return batches;
    }
    /** The beginnings of the blocks, and at last the end of all. */
    const std::vector<Block>& getBlocks() const {
        return blocks;
    }
    /** The first constraint that is in no batch. */
    int getFirstGeneral() const {
        return firstGeneral;
    }
    /** The particles with mass whose cluster is in no batch. */
    const std::vector<int>& getGeneralParticles() const {
        return generalParticles;
    }
    /** The particles with mass that have no constraint. */
    const std::vector<int>& getFreeParticles() const {
        return freeParticles;
    }
    /** Whether a motion of all particles with mass at one velocity satisfies the constraints: none holds a fixed particle. */
    bool isTranslationInvariant() const {
        return isFreeToTranslate;
    }
    /** The particles of a cluster, in increasing order. */
    std::vector<int> getClusterParticles(int cluster) const;

    /** g(q) in g; returns max |g|, the largest relative error of a constraint (or a NaN). */
    double evaluate(const std::vector<OpenMM::Vec3>& q, std::vector<double>& g, int first = 0) const;
    /** The index of the constraint with the largest |g|. */
    int findLargest(const std::vector<double>& g) const;
    /**
     * G(x): for x = q the Jacobian, for x = v the matrix whose rows are (d^2g/dq^2 v)^T, since a distance constraint
     * is quadratic (paper, Lemma 4.1).
     */
    void evaluateJacobian(const std::vector<OpenMM::Vec3>& x, Jacobian& jacobian, int first = 0) const;
    /** G w. */
    void multiply(const Jacobian& jacobian, const std::vector<OpenMM::Vec3>& w, std::vector<double>& result,
                  int first = 0) const;
    /** G M^-1 f. */
    void multiplyOverMass(const Jacobian& jacobian, const std::vector<OpenMM::Vec3>& f, std::vector<double>& result,
                          int first = 0) const;
    /** result += G^T x, as forces on the particles. */
    void addTransposed(const Jacobian& jacobian, const std::vector<double>& x, std::vector<OpenMM::Vec3>& result) const;
    /** result += scale M^-1 G^T x. */
    void addTransposedOverMass(const Jacobian& jacobian, const std::vector<double>& x, double scale,
                               std::vector<OpenMM::Vec3>& result, int first = 0) const;
    /** g''(v,v), the second derivative of the constraints along v. */
    void evaluateCurvature(const std::vector<OpenMM::Vec3>& v, std::vector<double>& result, int first = 0) const;
    /** The factor that turns a multiplier of constraint index into that of |r|^2 - L^2 (kJ/mol/nm^2). */
    double toDistanceMultiplier(int index) const {
        return distanceMultiplierFactors[index];
    }
    /** Bring multipliers into the order of the constructor and the units kJ/mol/nm^2. */
    void getDistanceMultipliers(const std::vector<double>& multipliers, std::vector<double>& result) const;

private:
    std::vector<std::vector<int>> findClusters(const std::vector<DistanceConstraint>& given) const;
    void orderForElimination(const std::vector<DistanceConstraint>& given, std::vector<int>& cluster) const;
    void appendCluster(const std::vector<DistanceConstraint>& given, const std::vector<int>& cluster);
    void findCouplings();
    void classifyParticles(const std::vector<char>& isInBatch);
    void findBlocks();
    int numGivenConstraints, firstGeneral;
    bool isFreeToTranslate;
    std::vector<double> masses, inverseMasses;
    std::vector<DistanceConstraint> constraints;
    std::vector<int> givenIndex; // internal order -> order of the constructor
    std::vector<double> inverseSquareLengths, distanceMultiplierFactors;
    std::vector<Cluster> clusters;
    std::vector<Coupling> couplings;
    std::vector<std::unique_ptr<ClusterBatch>> batches;
    std::vector<Block> blocks;
    std::vector<int> generalParticles, freeParticles;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTSYSTEM_H_
