// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTSYSTEM_H_
#define OPENMMVRATTLE_CONSTRAINTSYSTEM_H_

#include "constraints/ClusterBatch.h"
#include "constraints/ClusterLayout.h"
#include "constraints/DistanceConstraint.h"
#include "expressions/ExpressionGroup.h"
#include "openmm/Vec3.h"
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * The constraints g(q) = 0 of a system of particles, their Jacobian G = dg/dq, and the products with it that the method needs.
 *
 * Each distance constraint is written in relative form, g = (|r|^2 - L^2)/(2 L^2) with r = q1 - q2, so that g is the
 * relative error of the distance and one tolerance serves all. Its row of G is r/L^2 on particle 1 and the opposite on
 * particle 2. A multiplier of this form is 2 L^2 times the multiplier of |r|^2 - L^2; see toGivenMultiplier().
 *
 * A constraint given as an expression is taken as it is written, g(x1, y1, z1, x2, ...) = 0. Its error is measured as a
 * distance, |g| over the norm of its gradient with respect to the particles that move, relative to EXPRESSION_LENGTH: so
 * it is the same for g and for 1000 g, and one tolerance serves these constraints too.
 *
 * Constraints are kept in an internal order in which those of one cluster (constraints joined by shared particles) are
 * neighbours: first the small clusters that come in batches of one topology, then the general ones, of these the ones with an
 * expression after the others, and last the large ones that are cut. The functions below work on a part of them: all, one of
 * getGeneralParts(), one of getPieces() of the large clusters, or the joints between these.
 *
 * A particle of mass zero does not move. Only expressions may depend on it; it has no entry in G, and no function below that
 * moves particles writes to it.
 */
class ConstraintSystem {
public:
    /**
     * The rows of G, of length getNumEntries(). A distance constraint has one entry, its place in the internal order: the part
     * of its row that acts on particle 1, 1/nm. The rows of expressions lie behind, an entry for each particle with mass.
     */
    typedef std::vector<OpenMM::Vec3> Jacobian;
    /**
     * Neighbours in the internal order: the constraints first, ..., end - 1, which are whole clusters, or a piece of a large
     * one, or the joints between its pieces. Parts that are not joints have no particle and no constraint in common, so that
     * threads may work on them at the same time.
     */
    struct Part {
        int first, end;
        int firstRow, endRow;               // of getExpressionRows()
        int firstGroupRange, endGroupRange; // the expressions by their groups
        int firstParticle, endParticle;     // of getGeneralParticles()
        int firstJointEnd, endJointEnd;     // what joints do to the particles of a piece
        int piece;                          // in getPieces(), if it is one; else NONE
        int index;                          // of all parts
    };
    static constexpr int NONE = -1;
    /** All constraints; with another beginning, all from there on. */
    static constexpr Part ALL = {0,    std::numeric_limits<int>::max(),
                                 0,    std::numeric_limits<int>::max(),
                                 0,    std::numeric_limits<int>::max(),
                                 0,    0,
                                 0,    0,
                                 NONE, NONE};
    /** A large cluster in pieces, of which each is a part, and so are the joints. See ClusterCut. */
    struct CutCluster {
        int firstPiece, endPiece; // of getPieces()
        Part joints;
    };
    /** A cluster: the constraints first, ..., first + size - 1 of the internal order; and its kind in the layout. */
    struct Cluster {
        int first, size, kind;
    };
    /**
     * Where a block of neighbouring particles begins in the lists that are worked through block by block, so that what
     * belongs together is in the processor's caches together.
     */
    struct Block {
        std::vector<int> clusters; // the first cluster of each batch; a multiple of PACK_SIZE
        int freeParticle;          // the first in getFreeParticles()
        int particle;              // the first of all
    };
    /**
     * Two constraints share a particle: an entry of K = G M^-1 G^T is the sum of factor * (row . column), row and column being
     * entries of the Jacobian. The constraint of row (see getConstraintOf()) is never before that of column.
     */
    struct Coupling {
        int row, column;
        double factor; // +-1/mass of the shared particle, or 1/m1 + 1/m2 on the diagonal of a distance constraint
    };
    /** The row of an expression has the entries first, ..., end - 1 of a Jacobian. */
    struct ExpressionRow {
        int constraint, first, end;
    };
    /** An entry of an expression's row. */
    struct ExpressionEntry {
        int constraint, particle;
    };
    /** Errors of expressions are relative to this distance (nm), which is about that of a bond. */
    static constexpr double EXPRESSION_LENGTH = 0.1;

    /**
     * @param masses         the mass of each particle (amu); 0 for a particle that does not move
     * @param constraints    the distance constraints; one between two particles of mass zero is left out, as in OpenMM
     * @param expressions    the constraints given as expressions, of at least one particle with mass each
     */
    ConstraintSystem(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints,
                     const std::vector<ExpressionConstraint>& expressions = {});
    ~ConstraintSystem();

    int getNumParticles() const {
        return (int) masses.size();
    }
    int getNumConstraints() const {
        return (int) constraints.size();
    }
    const std::vector<double>& getMasses() const {
        return masses;
    }
    /** 1/mass, and 0 for a particle of mass zero. */
    const std::vector<double>& getInverseMasses() const {
        return inverseMasses;
    }
    /** The length of a Jacobian. */
    int getNumEntries() const {
        return getNumConstraints() + (int) expressionEntries.size();
    }
    /** Whether a constraint is given as an expression. */
    bool isExpression(int index) const {
        return !expressions.empty() && givenIndex[index] >= numGivenDistances;
    }
    /** A distance constraint. */
    const DistanceConstraint& getConstraint(int index) const {
        return constraints[index];
    }
    /** A constraint that is given as an expression, with values of its parameters. */
    ExpressionConstraint getExpression(int index, const ExpressionParameters& theta) const;
    const std::vector<ExpressionRow>& getExpressionRows() const {
        return expressionRows;
    }
    /** The particle on which an entry of an expression's row acts. */
    int getParticleOf(int entry) const {
        return expressionEntries[entry - getNumConstraints()].particle;
    }
    /** The constraint that an entry of a Jacobian belongs to. */
    int getConstraintOf(int entry) const {
        return entry < getNumConstraints() ? entry : expressionEntries[entry - getNumConstraints()].constraint;
    }
    /** The number of parameters of all expressions. */
    int getNumParameters() const {
        return numParameters;
    }
    /** The parameters that the constructor was given, at rest. */
    ExpressionParameters getGivenParameters() const;
    /** Write the parameters of an expression, counted in the order of the constructor, into the values of all. */
    void writeParameters(int expression, const std::map<std::string, double>& parameters,
                         std::vector<double>& values) const;
    /** Parameters and rates in the order of the constructor's expressions, for others who know them so, and back. */
    ExpressionParameters toGivenOrder(const ExpressionParameters& theta) const;
    ExpressionParameters fromGivenOrder(const ExpressionParameters& given) const;
    /**
     * The way from parameters theta to others, such that following it changes g as going there does: the difference, but for a
     * parameter that stands for an angle and has been set back by a full turn that is what is left of it.
     *
     * @param q                positions that satisfy the constraints for theta
     * @param theta            the parameters there
     * @param target           the values to come
     * @param[out] change      the way to them
     */
    void findParameterChange(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta,
                             const std::vector<double>& target, std::vector<double>& change) const;
    /** A constraint in words, for messages. */
    std::string describe(int index) const;
    /** How the constraints fall into clusters, and how these are eliminated. */
    const ClusterLayout& getLayout() const {
        return layout;
    }
    const std::vector<Cluster>& getClusters() const {
        return clusters;
    }
    const ClusterElimination& getEliminationOf(const Cluster& cluster) const {
        return layout.kinds[cluster.kind].elimination;
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
    /**
     * The general clusters that are not cut, in parts: each is a few clusters that are worked through together while the
     * processor's caches have them.
     */
    const std::vector<Part>& getGeneralParts() const {
        return generalParts;
    }
    /** The batches, if there are any, as one part, and the general parts. */
    const std::vector<Part>& getWholeParts() const {
        return wholeParts;
    }
    /** The number of all parts: their indices are less than this. */
    int getNumParts() const {
        return numParts;
    }
    /** The pieces of all large clusters. */
    const std::vector<Part>& getPieces() const {
        return pieces;
    }
    const std::vector<CutCluster>& getCutClusters() const {
        return cutClusters;
    }
    /** The particles with mass whose cluster is in no batch, part by part. */
    const std::vector<int>& getGeneralParticles() const {
        return generalParticles;
    }
    /** The particles with mass that have no constraint. */
    const std::vector<int>& getFreeParticles() const {
        return freeParticles;
    }
    /** Whether a motion of all particles with mass at one velocity is known to satisfy the constraints. */
    bool isTranslationInvariant() const {
        return expressions.empty();
    }
    /** The particles of a cluster, in increasing order. */
    std::vector<int> getClusterParticles(int cluster) const;

    /**
     * g(q) in g, for parameters theta of the expressions.
     *
     * @param nearby    the Jacobian at q or nearby, which gives the errors of expressions their length
     * @return the largest relative error of a constraint, or a NaN
     */
    double evaluate(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta, std::vector<double>& g,
                    const Jacobian& nearby, const Part& part = ALL) const;
    /** How far the particles are from where an expression holds, to first order, in units of EXPRESSION_LENGTH. */
    double findErrorOf(const ExpressionRow& row, const std::vector<double>& g, const Jacobian& nearby) const;
    /** The index of the constraint with the largest relative error. */
    int findLargest(const std::vector<double>& g, const Jacobian& nearby) const;
    /**
     * The expression that is closest to a singular geometry, where its gradient is infinite or zero and no iteration finds a
     * solution: a motion changes its gradient by at least a fraction of its size, though it is short beside the distances of the
     * expression's particles.
     *
     * @param q                   positions
     * @param theta               the parameters of the expressions
     * @param displacement        the motion from there (nm)
     * @param jacobian            G(q)
     * @param velocityJacobian    work space
     * @return the constraint, or NONE
     */
    int findSingular(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta,
                     const std::vector<OpenMM::Vec3>& displacement, const Jacobian& jacobian,
                     Jacobian& velocityJacobian) const;
    /** G(q), the Jacobian. */
    void evaluateJacobian(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta, Jacobian& jacobian,
                          const Part& part = ALL) const;
    /** result += dg/dtheta . dtheta/dt, the change of the constraints in time at fixed q. */
    void addParameterMotion(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta,
                            std::vector<double>& result, const Part& part = ALL) const;
    /**
     * G(v), the matrix whose rows are (d^2g/dq^2 v)^T at q: half the derivative of g''(v,v) with respect to v. For distance
     * constraints it is the Jacobian with v in place of q, since they are quadratic (paper, Lemma 4.1). Where parameters move, it is
     * the derivative of G along both motions.
     */
    void evaluateVelocityJacobian(const std::vector<OpenMM::Vec3>& q, const std::vector<OpenMM::Vec3>& v,
                                  const ExpressionParameters& theta, Jacobian& jacobian, const Part& part = ALL) const;
    /** G w. */
    void multiply(const Jacobian& jacobian, const std::vector<OpenMM::Vec3>& w, std::vector<double>& result,
                  const Part& part = ALL) const;
    /** G M^-1 f. */
    void multiplyOverMass(const Jacobian& jacobian, const std::vector<OpenMM::Vec3>& f, std::vector<double>& result,
                          const Part& part = ALL) const;
    /** result += G^T x, as forces on the particles; for a piece, what its own constraints do. */
    void addTransposed(const Jacobian& jacobian, const std::vector<double>& x, std::vector<OpenMM::Vec3>& result,
                       const Part& part = ALL) const;
    /** result += scale M^-1 G^T x; for a piece, what all constraints do to its particles. */
    void addTransposedOverMass(const Jacobian& jacobian, const std::vector<double>& x, double scale,
                               std::vector<OpenMM::Vec3>& result, const Part& part = ALL) const;
    /** g''(v,v), the second derivative of the constraints along v at q, and along the motion of the parameters. */
    void evaluateCurvature(const std::vector<OpenMM::Vec3>& q, const std::vector<OpenMM::Vec3>& v,
                           const ExpressionParameters& theta, std::vector<double>& result,
                           const Part& part = ALL) const;
    /**
     * The factor that turns a multiplier of constraint index into that of the constraint as users see it: |r|^2 - L^2
     * (kJ/mol/nm^2) for a distance, and the expression itself (kJ/mol over the unit of g), whose factor is 1.
     */
    double toGivenMultiplier(int index) const {
        return multiplierFactors[index];
    }
    /** Bring multipliers into the order of the constructor, distances first, and into the users' units. */
    void getGivenMultipliers(const std::vector<double>& multipliers, std::vector<double>& result) const;
    /** That of an expression, counted in the order of the constructor. */
    double getExpressionMultiplier(int expression, const std::vector<double>& multipliers) const;
    /** Say in words what is wrong with a constraint whose gradient is zero or not finite; empty if neither is so. */
    std::string explainGradient(int index, const Jacobian& jacobian) const;
    /** Say in words, and with the way out, that positions are too large for the tolerance of a constraint; else empty. */
    std::string explainResolution(int index, const std::vector<OpenMM::Vec3>& q, double tolerance) const;
    /** Say in words, and with the way out, that all distances of three particles in a line are among a cluster's; else empty. */
    std::string explainLine(int cluster) const;

private:
    /** A stretch of distance constraints in the internal order: first, ..., end - 1. */
    struct Stretch {
        int first, end;
    };
    /** Constraints of an expression group that are in one part: the places first, ..., end - 1 in the group. */
    struct GroupRange {
        int group, first, end;
    };
    /** What a joint does to a particle. */
    struct JointEnd {
        int entry, constraint, particle;
        double sign;
    };
    void groupExpressions();
    void findStretches();
    void findCouplings();
    std::vector<ClusterLayout::Cluster> findGeneral(const std::vector<char>& isInBatch) const;
    void findParts(const std::vector<ClusterLayout::Cluster>& general);
    void findGroupRanges();
    void findJointEnds();
    void findBlocks();
    template <class Task> void forDistances(const Part& part, const Task& task) const;
    template <class Task> void forRows(const Part& part, const Task& task) const;
    template <class Task> void forGroups(const Part& part, const Task& task) const;
    template <class Copy> void forParameters(const Copy& copy) const;
    const ExpressionRow& findRow(int constraint) const;
    /** Of a constraint that is given as an expression: its place among these, as they were given. */
    int expressionOf(int index) const {
        return givenIndex[index] - numGivenDistances;
    }
    std::vector<int> getParticles(int index) const; // of a constraint, as they were given
    void evaluateDistanceRows(const std::vector<OpenMM::Vec3>& x, Jacobian& jacobian, const Part& part) const;
    int numGivenConstraints, numGivenDistances, firstGeneral, numParts;
    std::vector<double> masses;
    ClusterLayout layout;
    const std::vector<double>& inverseMasses;
    std::vector<DistanceConstraint> constraints; // in the place of an expression there is nothing of meaning
    std::vector<int> givenIndex;                 // internal order -> order of the constructor
    std::vector<double> inverseSquareLengths, multiplierFactors;
    std::vector<Stretch> distanceStretches;
    std::vector<ExpressionConstraint> expressions; // in the order of the constructor
    std::vector<std::unique_ptr<ExpressionGroup>> groups;
    std::vector<std::pair<int, int>> placeInGroups; // group and number therein of each expression
    std::vector<int> firstParameters;               // of each expression in ExpressionParameters
    int numParameters = 0;
    std::vector<GroupRange> groupRanges; // first each group as a whole, then those of the parts
    std::vector<ExpressionRow> expressionRows; // in internal order, and their entries too
    std::vector<ExpressionEntry> expressionEntries;
    std::vector<Cluster> clusters;
    std::vector<Coupling> couplings;
    std::vector<std::unique_ptr<ClusterBatch>> batches;
    std::vector<Block> blocks;
    std::vector<Part> wholeParts, generalParts, pieces;
    std::vector<CutCluster> cutClusters;
    std::vector<JointEnd> jointEnds;
    std::vector<int> generalParticles;
    const std::vector<int>& freeParticles;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTSYSTEM_H_
