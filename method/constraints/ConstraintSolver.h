// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINTSOLVER_H_
#define OPENMMVRATTLE_CONSTRAINTSOLVER_H_

#include "constraints/ClusterBatch.h"
#include "constraints/ConstraintMatrix.h"
#include "constraints/ConstraintSystem.h"
#include "constraints/NewtonMatrix.h"
#include "constraints/SharedWork.h"
#include "constraints/StepFailure.h"
#include "constraints/Sum.h"
#include "openmm/Vec3.h"
#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * All that a method of integration asks for of constraints. How they are solved, as batches of small clusters, general ones or
 * pieces of large ones, by which iteration, and on how many threads, is known here alone; results do not depend on the number of
 * threads, to the last bit.
 *
 * It knows no densities. A method moves it to the positions of a step, tries a step from there, and completes it with the forces at
 * its end:
 *
 *     solver.moveTo(q, theta, force);                    // G, K and G M^-1 F there, as they are needed
 *     solver.solvePositions({start, kick, drift, thetaNext, qNext, wNext, lambda}, {Lambda, nullptr, margin});
 *     ... compute the forces at qNext ...
 *     solver.finish({qNext, wNext, forceNext, thetaNext, kick, v, Lambda, rightSide, nullptr});
 *     ... let q, theta and force be those of the end, by swapping the vectors ...
 *     solver.moveToEnd();                                // or moveTo() with other ones
 *
 * The first solves g(q+) = 0 with w+ = start + kick M^-1 (F - G(q)^T lambda), q+ = q + drift w+: a kick and a drift in one. What start
 * has across the constraints is absorbed by lambda, so that it need not be projected. A drift alone is one with forces that are zero
 * and any kick > 0, whose impulse -kick G^T lambda is the constraints'. The second kicks once more, projects the velocities, and finds
 * the multipliers Lambda of the state (4.3); with forces of zero, or a kick of zero, it is a projection alone. So a step of
 * RATTLE is those two with drift = h and kick = h/2 both times, and that of another splitting as many pairs as it has drifts.
 *
 * Vectors of particles are in the order of the particles, multipliers in the internal order of ConstraintSystem. Particles of mass
 * zero are written to by nothing here.
 */
class ConstraintSolver {
public:
    typedef std::vector<OpenMM::Vec3> Vectors;
    typedef SharedWork::Parallel Parallel;

    ConstraintSolver(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints,
                     const std::vector<ExpressionConstraint>& expressions = {});
    ConstraintSolver(const ConstraintSolver&) = delete;
    /** The constraints themselves: numbers, masses, clusters, units and names. */
    const ConstraintSystem& getSystem() const {
        return system;
    }
    /** The particles with mass. */
    const std::vector<int>& getMovingParticles() const {
        return movingParticles;
    }
    /** Let threads share the work where that is faster. */
    void setParallel(const Parallel& parallel, int numThreads) {
        work.setParallel(parallel, numThreads);
    }
    /** The relative error of a constraint that is no error. */
    void setTolerance(double newTolerance) {
        tolerance = newTolerance;
    }
    /** Whether threads are to share the work is found out step by step. */
    void beginStep() {
        work.beginStep();
    }
    void endStep() {
        work.endStep();
    }
    /** How many times multipliers, or positions that were projected, have been corrected. */
    long long getNumIterations() const {
        return numIterations;
    }

    // ---------------------------------------------------------------------------------------------- what is done by many

    /**
     * What is done along with a pass, while the processor's caches have what has been worked on. Several threads may do it at once,
     * each for other blocks and ranges; all of these come by, once in a pass.
     */
    class Observer {
    public:
        virtual ~Observer() {
        }
        /** A block of ConstraintSystem::getBlocks(). */
        virtual void seeParticles(int) {
        }
        /** The multipliers first, ..., end - 1 are known; this is a range of getNumRanges(). */
        virtual void seeConstraints(int, int, int) {
        }
    };
    int getNumRanges() const {
        return getNumBatchRanges() + system.getNumParts();
    }
    /**
     * Whether velocities are others seen from a uniformly moving frame, but for rounding, and constraints know nothing of that.
     *
     * @param[out] shift    the velocity of the frame, with the opposite sign
     */
    bool findFrameShift(const Vectors& before, const Vectors& after, OpenMM::Vec3& shift);
    /** Go through all ranges, task(range, first, end), on one thread. */
    template <class Task> void forRanges(const Task& task) const {
        for (size_t block = 0; block + 1 < system.getBlocks().size(); block++)
            forRangesOfBlock((int) block, task);
        auto runPart = [&](const ConstraintSystem::Part& part) { task(rangeOf(part), part.first, part.end); };
        std::for_each(system.getGeneralParts().begin(), system.getGeneralParts().end(), runPart);
        std::for_each(system.getPieces().begin(), system.getPieces().end(), runPart);
        for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
            runPart(cluster.joints);
    }
    /** Go through 0, ..., count - 1 in ranges of a fixed length, on several threads where that is faster: task(first, end). */
    template <class Task> void share(int count, const Task& task) {
        work.runOnRanges(count, [&](int, int first, int end) { task(first, end); });
    }
    /** The sum of term(0), ..., term(count - 1), and the largest, if it is not negative, for particles or constraints. */
    template <class Term> double sum(int count, const Term& term) {
        work.runOnRanges(count, [&](int range, int first, int end) {
            rangeResults[range] = sumOf(end - first, [&](int i) { return term(first + i); });
        });
        return sumOf(SharedWork::getNumRanges(count), [&](int range) { return rangeResults[range]; });
    }
    template <class Term> double largest(int count, const Term& term) {
        work.runOnRanges(count, [&](int range, int first, int end) {
            double result = 0;
            for (int i = first; i < end; i++)
                result = std::max(result, term(i));
            rangeResults[range] = result;
        });
        return SharedWork::getNumRanges(count) == 0
                   ? 0.0
                   : *std::max_element(rangeResults.begin(), rangeResults.begin() + SharedWork::getNumRanges(count));
    }

    /** (sum |x|^p)^(1/p) for such, scaled by the largest |x| so that no power overflows. */
    template <class Size> double pNorm(int count, double order, const Size& size) {
        const double most = largest(count, size);
        if (most == 0)
            return 0;
        return most * std::pow(sum(count, [&](int i) { return std::pow(size(i) / most, order); }), 1 / order);
    }

    /** The sum of weight x^2 over the particles with mass. */
    double sumOfSquares(const Vectors& x, const std::vector<double>& weights) {
        return sum((int) movingParticles.size(), [&](int p) {
            const int i = movingParticles[p];
            return weights[i] * x[i].dot(x[i]);
        });
    }

    // ------------------------------------------------------------------------------------- at the positions of a step

    /**
     * Move to positions, parameters of the expressions there, and forces. All three stay the caller's: they must live, and not change
     * until there is another call of this.
     */
    void moveTo(const Vectors& q, const ExpressionParameters& theta, const Vectors& force);
    /** Lambda(q,p) = K^-1 (g''(v,v) + G M^-1 F) (4.3) for any velocities; rightSide is K Lambda. */
    void findMultipliers(const Vectors& v, const ExpressionParameters& theta, std::vector<double>& multipliers,
                         std::vector<double>& rightSide);
    /** result -= M^-1 G^T K^-1 (G v + dg/dtheta . dtheta/dt): what brings v to where parameters that move want it. */
    void addProjection(const Vectors& v, const ExpressionParameters& theta, Vectors& result);
    /** v -= M^-1 G^T K^-1 G v, the nearest velocities along constraints whose parameters are at rest. */
    void projectVelocities(Vectors& v) {
        addProjection(v, ExpressionParameters(), v);
    }
    /** result += scale M^-1 G^T x */
    void addTransposedOverMass(const std::vector<double>& x, double scale, Vectors& result);
    /** The size that multipliers have by rounding alone, in users' units or, if they are weighted by masses, as M^(-1/2) G^T Lambda. */
    double findMultiplierRounding(bool isMassWeighted, const Vectors& v, double acceleration);

    // ------------------------------------------------------------------------------------------------- a step from there

    /** A step that is tried: w+ = start + kick M^-1 (F - G^T lambda) (3.10), q+ = q + drift w+ (3.9). */
    struct Trial {
        const Vectors& start;
        double kick, drift; // ps
        const ExpressionParameters& parameters; // at the end
        // What is found.
        Vectors &positions, &velocities; // q+ and w+
        std::vector<double>& multipliers; // lambda
    };
    /** What an iteration has found for lambda, and what there was to expect. */
    struct Offset {
        std::vector<double> found, expected;
    };
    /** Where the iteration for lambda begins, and where it ends. */
    struct Guess {
        const std::vector<double>& multipliers;
        const Offset* offset; // of another step, found - expected, is added to them; or null
        double
            margin; // the fraction of the tolerance that is aimed at; where rounding forbids it, the tolerance itself will do
    };
    /**
     * Solve g(q+) = 0 (3.11), by iterations with one matrix, and where they fail by Newton's: K(q), or in batches
     * Newton's at the guess. There is at least one update.
     *
     * @return whether it is solved; if not, explainFailure() says what is in the way
     */
    bool solvePositions(const Trial& trial, const Guess& guess);
    /** What happens to velocities between two trials; several threads may ask for it at once, each for other particles. */
    class Change {
    public:
        virtual ~Change() {
        }
        virtual void changeVelocities(const int* particles, int count) = 0;
    };
    /**
     * Solve two trials, the second of which begins where the first has ended, with velocities that are changed in between and without
     * forces; block by block the same as solvePositions(), all the changes, moveTo() the positions of the first, and solvePositions().
     *
     * @param noForce    zeros
     * @return whether it is solved; if not, all is to be done one after the other, and nothing has been moved to
     */
    bool solveInTurn(const Trial& trial, const Guess& guess, Change& change, const Trial& second,
                     const Guess& secondGuess, const Vectors& noForce);
    /** Begin with a guess without that iteration. */
    void guess(const Trial& trial, const Guess& guess);
    std::string explainFailure(const Trial& trial);
    /** Of forces whose squares have no finite sum: what to throw, with the particle that makes it so. */
    UselessForces explainForces(const Vectors& forces) const;

    /** What (3.14) wants to know of a trial. */
    struct Coupled {
        const ExpressionParameters& parameters; // theta[n] with the rates of the trial
        std::vector<double>&multipliers, &rightSide; // Lambda(q,p+) and K times it
    };
    /**
     * One chord iteration for a problem in which more is unknown than lambda. The multipliers get the correction that the pass
     * before has found; kick and drift may be others than there.
     *
     * @param start    where to begin, for the first pass; else null
     * @return the largest relative error of a constraint at the trial's positions
     */
    double coupledPass(const Trial& trial, const Coupled& coupled, const Guess* start, Observer* observer = nullptr);

    // Newton's iteration for such a problem, whose equations in lambda are A dlambda = -g + ..., A = -kick drift G(q+) M^-1 G(q)^T.
    /** w+, q+ and g(q+) for the trial's multipliers; returns the largest relative error. */
    double evaluate(const Trial& trial);
    /** Form A after evaluate(); returns whether it is regular. */
    bool linearize(const Trial& trial);
    /** x = -A^-1 g */
    void findUpdate(const Trial& trial, std::vector<double>& x);

    // --------------------------------------------------------------------------------------------------------- its end

    /** The multipliers at half-step velocities. */
    struct HalfStep {
        std::vector<double> multipliers, rightSide; // Lambda(q,p-) and K times it
    };
    /** The end of a step: (3.12)-(3.13), v = w + kick M^-1 F, projected, and Lambda(q,p) there. */
    struct OnStep {
        const Vectors &positions, &halfStep, &forces; // q, w and F
        const ExpressionParameters& parameters;
        double kick; // ps
        // What is found.
        Vectors& velocities; // v
        std::vector<double>&multipliers, &rightSide; // Lambda and K Lambda
        HalfStep* atHalfStep; // or null if it is not wanted
        Vectors* accelerations = nullptr; // M^-1 (F - G^T Lambda), or null
    };
    /**
     * Complete a step. The positions of moveTo() remain, but what was known there has to be formed again.
     *
     * @throws StepFailure    if the constraints have become dependent
     */
    void finish(const OnStep& state, Observer* observer = nullptr);
    /** After finish(): the vectors of moveTo() hold now what its positions, parameters and forces were. */
    void moveToEnd();
    /** The same where they are in other vectors now, which must live on as those of moveTo(). */
    void moveToEnd(const Vectors& newQ, const ExpressionParameters& newTheta, const Vectors& newForce) {
        q = &newQ;
        theta = &newTheta;
        force = &newForce;
        moveToEnd();
    }

    // ----------------------------------------------------------------------------------------------------- anywhere

    /**
     * Move positions to the nearest configuration (in the mass metric, to first order) that satisfies the constraints; those that
     * do so to the tolerance are left as they are. What moveTo() has moved to has to be formed again.
     *
     * @return whether the positions were changed
     * @throws StepFailure    if there is no such configuration nearby
     */
    bool projectPositions(Vectors& positions, const ExpressionParameters& theta);
    /** forces -= G(q)^T x */
    void subtractConstraintForces(const Vectors& q, const ExpressionParameters& theta, const std::vector<double>& x,
                                  Vectors& forces);

private:
    typedef ConstraintSystem::Part Part;
    typedef ConstraintSystem::CutCluster CutCluster;
    typedef SharedWork::Result Result;
    enum FactorScope { NoFactor, GeneralFactor, FullFactor };
    struct Clusters;
    struct TrialClusters;
    template <class Stages> struct Pass;
    struct ChordPass;
    struct FirstPass;
    struct SecondPass;
    struct CoupledPass;
    struct FinishPass;
    int rangeOf(const Part& part) const {
        return getNumBatchRanges() + part.index;
    }
    int getNumBatchRanges() const {
        return (int) ((system.getBlocks().size() - 1) * system.getBatches().size());
    }
    template <class Task> void forRangesOfBlock(int block, const Task& task) const {
        const auto& batches = system.getBatches();
        for (size_t k = 0; k < batches.size(); k++)
            task((int) (block * batches.size() + k),
                 batches[k]->getFirstConstraint(system.getBlocks()[block].clusters[k]),
                 batches[k]->getFirstConstraint(system.getBlocks()[block + 1].clusters[k]));
    }
    template <class Each> Result run(const Each& pass);
    template <class Each> double beginStage(const Each& pass, int stage, const Part& piece);
    template <class Each> void runCut(const Each& pass, Result& result);
    template <class Each> void eliminate(const Each& pass, int stage, const Part& piece);

    void ensureFactor(FactorScope scope);
    void ensureGeneralFactor();
    StepArrays arraysOf(const Trial& trial, const Vectors& q, const OpenMM::Vec3* force);
    void moveParticles(const Trial& trial, const int* first, const int* end, const Part& part, bool withVelocities);
    void moveParticles(const Trial& trial, const Part& part, bool withVelocities);
    void moveFreeParticle(const StepArrays& step, int i) const;
    void guess(const Trial& trial, const Guess& guess, int first, int end) const;
    bool solveByNewton(const Trial& trial, const Guess& guess);
    bool iterateNewton(const Trial& trial);
    void solveLinearized(std::vector<double>& x, double scale) const;
    bool projectByChord(const ExpressionParameters& theta, Vectors& positions);
    bool projectByNewton(const ExpressionParameters& theta, Vectors& positions);
    std::string explain(const Vectors& from, const ExpressionParameters& theta, const Vectors& displacement,
                        const std::string& wayOut);

    ConstraintSystem system;
    ConstraintMatrix matrix;
    NewtonMatrix newtonMatrix;
    SharedWork work;
    std::vector<int> movingParticles;
    double tolerance;
    long long numIterations;
    double lastError; // the largest relative error of a constraint that the last iteration left

    // Where moveTo() has moved to; and there G, G M^-1 F and the factor of K, as far as the scope says. The batches do without.
    const Vectors *q, *force;
    const ExpressionParameters* theta;
    FactorScope factorScope;
    ConstraintSystem::Jacobian jacobian;
    std::vector<double> appliedTerm;

    // The step in progress.
    ConstraintSystem::Jacobian jacobianNext, velocityJacobian;
    std::vector<double> appliedTermNext, residual, correction, before;
    Vectors acceleration;
    std::vector<double> rangeResults;
    std::vector<char> isPieceEliminated; // whether the matrix has begun to solve for the unknowns of a piece
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINTSOLVER_H_
