// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What ConstraintSolver does in a step: passes over all clusters.

#include "constraints/ClusterStages.h"
#include "constraints/ConstraintSolver.h"
#include <algorithm>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

/*
 * A pass does the same to all clusters. Batches and free particles have it done in one go. For the others it goes through stages
 * (ClusterStages.h): a part of whole clusters through all of them at once; pieces of a cut cluster wait at the end of each for their
 * joints, which have equations and no particles.
 */
template <class StagesOfPass> struct ConstraintSolver::Pass {
    typedef StagesOfPass Stages;
    Pass(ConstraintSolver& solver, const Stages& stages, Observer* observer = nullptr) :
            stages(stages), solver(solver), system(solver.system), observer(observer) {
    }
    /** The Jacobian of the matrix that is to be factorised before the first stage, if any. */
    const ConstraintSystem::Jacobian* toFactorize() const {
        return nullptr;
    }
    /** When all stages are over. */
    void seeBlock(int block) const {
        if (observer == nullptr)
            return;
        observer->seeParticles(block);
        solver.forRangesOfBlock(block,
                                [&](int range, int first, int end) { observer->seeConstraints(range, first, end); });
    }
    void seePart(const Part& part) const {
        if (observer != nullptr)
            observer->seeConstraints(solver.rangeOf(part), part.first, part.end);
    }
    /** Before all stages, and for joints before all pieces. */
    void prepare(const Part&) const {
    }
    const Stages stages;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    Observer* const observer;
};

/** A part of general clusters, a piece or joints, with the algebra of their constraints; what the stages of a pass work on. */
struct ConstraintSolver::Clusters {
    Clusters(ConstraintSolver& solver, const Part& part, const ConstraintSystem::Jacobian& jacobian) :
            change(solver.correction), solver(solver), system(solver.system), part(part), jacobian(jacobian) {
    }
    template <class Task> void forParticles(const Task& task) const {
        for (int p = part.firstParticle; p < part.endParticle; p++)
            task(system.getGeneralParticles()[p]);
    }
    template <class Task> void forConstraints(const Task& task) const {
        for (int k = part.first; k < part.end; k++)
            task(k);
    }
    void multiply(const Vectors& w, vector<double>& x) const {
        system.multiply(jacobian, w, x, part);
    }
    void addTransposedOverMass(const vector<double>& x, double scale, Vectors& result) const {
        system.addTransposedOverMass(jacobian, x, scale, result, part);
    }
    void solve(vector<double>& x) const {
        solver.matrix.solve(x, part);
    }
    vector<double>& change;
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    const Part& part;
    const ConstraintSystem::Jacobian& jacobian;
};

struct ConstraintSolver::TrialClusters : Clusters {
    TrialClusters(ConstraintSolver& solver, const Part& part, const Trial& trial) :
            Clusters(solver, part, solver.jacobian), trial(trial), lambda(trial.multipliers) {
    }
    void move(bool withVelocities) const {
        solver.moveParticles(trial, part, withVelocities);
    }
    double evaluate(vector<double>& g) const {
        return system.evaluate(trial.positions, trial.parameters, g, jacobian, part);
    }
    double toUpdate(double x) const {
        return x / (trial.kick * trial.drift);
    }
    const Trial& trial;
    vector<double>& lambda;
};

// The chord iteration for (3.11), A = -kick drift K(q).
struct ConstraintSolver::ChordPass : Pass<ChordStages> {
    ChordPass(ConstraintSolver& solver, const Trial& trial, const Guess& guess) :
            ChordPass(solver, trial, guess, *solver.q, solver.force->data()) {
    }
    ChordPass(ConstraintSolver& solver, const Trial& trial, const Guess& guess, const Vectors& q, const Vec3* force) :
            Pass(solver, ChordStages(guess.margin * solver.tolerance)), trial(trial), guess(guess),
            arrays(solver.arraysOf(trial, q, force)) {
    }
    void prepare(const Part& part) const {
        solver.guess(trial, guess, part.first, part.end);
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        solver.guess(trial, guess, batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
        share.addError(batch.solvePositions(arrays, begin, end, stages, share.iterations));
    }
    void runFree(int particle) const {
        solver.moveFreeParticle(arrays, particle);
    }
    TrialClusters clustersOf(const Part& part) const {
        return {solver, part, trial};
    }
    const Trial& trial;
    const Guess& guess;
    const StepArrays arrays;
};

// The first of two trials, and for the batches and the free particles the second as well.
struct ConstraintSolver::FirstPass : ChordPass {
    FirstPass(ConstraintSolver& solver, const Trial& trial, const Guess& guess, Change& change,
              const ChordPass& second) : ChordPass(solver, trial, guess), change(change), second(second) {
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        Result first, next;
        ChordPass::runBatch(batch, begin, end, first);
        const int* particles = batch.getParticles(begin);
        change.changeVelocities(particles, (int) (batch.getParticles(end) - particles));
        second.runBatch(batch, begin, end, next);
        share.addError(first.error);
        share.addError(next.error);
        share.addBatchIterations(first.iterations + next.iterations);
    }
    void seeBlock(int block) const {
        const auto& blocks = system.getBlocks();
        const int* particles = system.getFreeParticles().data() + blocks[block].freeParticle;
        const int count = blocks[block + 1].freeParticle - blocks[block].freeParticle;
        change.changeVelocities(particles, count);
        std::for_each(particles, particles + count, [&](int i) { second.runFree(i); });
    }
    Change& change;
    const ChordPass& second;
};

// The second of them for the others.
struct ConstraintSolver::SecondPass : ChordPass {
    using ChordPass::ChordPass;
    void runBatch(const ClusterBatch&, int, int, Result&) const {
    }
    void runFree(int) const {
    }
};

struct ConstraintSolver::CoupledPass : Pass<CoupledStages> {
    CoupledPass(ConstraintSolver& solver, const Trial& trial, const Coupled& coupled, const Guess* guess,
                Observer* observer) :
            Pass(solver, CoupledStages(), observer), trial(trial), coupled(coupled), guess(guess),
            arrays(solver.arraysOf(trial, *solver.q, solver.force->data())) {
        arrays.lambdaPlus = coupled.multipliers.data();
        arrays.rightSidePlus = coupled.rightSide.data();
    }
    void start(int first, int end) const {
        if (guess == nullptr)
            return;
        solver.guess(trial, *guess, first, end);
        std::fill(solver.correction.begin() + first, solver.correction.begin() + end, 0.0);
    }
    void prepare(const Part& part) const {
        start(part.first, part.end);
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        start(batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
        share.addError(batch.coupledPass(arrays, begin, end));
    }
    void runFree(int particle) const {
        solver.moveFreeParticle(arrays, particle);
    }
    struct Clusters : TrialClusters {
        Clusters(ConstraintSolver& solver, const Part& part, const Trial& trial, const Coupled& coupled) :
                TrialClusters(solver, part, trial), applied(solver.appliedTerm), rightSide(coupled.rightSide),
                multipliers(coupled.multipliers), parameters(coupled.parameters) {
        }
        double evaluate(vector<double>& g) const {
            const double error = TrialClusters::evaluate(g);
            forConstraints([&](int k) { g[k] = toUpdate(g[k]); });
            return error;
        }
        void evaluateCurvature(vector<double>& x) const {
            system.evaluateCurvature(*solver.q, trial.velocities, parameters, x, part);
        }
        const vector<double>& applied;
        vector<double>&rightSide, &multipliers;
        const ExpressionParameters& parameters;
    };
    Clusters clustersOf(const Part& part) const {
        return {solver, part, trial, coupled};
    }
    const Trial& trial;
    const Coupled& coupled;
    const Guess* guess;
    StepArrays arrays;
};

struct ConstraintSolver::FinishPass : Pass<FinishStages> {
    FinishPass(ConstraintSolver& solver, const OnStep& state, Observer* observer) :
            Pass(solver, FinishStages(), observer), state(state), half(state.atHalfStep),
            arrays{state.positions.data(),
                   state.halfStep.data(),
                   state.forces.data(),
                   state.velocities.data(),
                   state.multipliers.data(),
                   state.rightSide.data(),
                   half != nullptr ? half->multipliers.data() : nullptr,
                   half != nullptr ? half->rightSide.data() : nullptr,
                   state.accelerations != nullptr ? state.accelerations->data() : nullptr,
                   state.kick} {
    }
    const ConstraintSystem::Jacobian* toFactorize() const {
        return &solver.jacobianNext;
    }
    void prepare(const Part& part) const { // the joints' rows are in the columns of pieces
        system.evaluateJacobian(state.positions, state.parameters, solver.jacobianNext, part);
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        share.addPivot(batch.finish(arrays, begin, end));
    }
    struct Clusters : ConstraintSolver::Clusters {
        Clusters(ConstraintSolver& solver, const Part& part, const OnStep& state) :
                ConstraintSolver::Clusters(solver, part, solver.jacobianNext), state(state), kick(state.kick),
                hasHalfStep(state.atHalfStep != nullptr), hasNetAccelerations(state.accelerations != nullptr),
                w(state.halfStep), v(state.velocities),
                netAccelerations(hasNetAccelerations ? *state.accelerations : v), applied(solver.appliedTermNext),
                rightSide(state.rightSide), multipliers(state.multipliers),
                halfRightSide(hasHalfStep ? state.atHalfStep->rightSide : rightSide),
                halfMultipliers(hasHalfStep ? state.atHalfStep->multipliers : multipliers) {
        }
        Vec3 getAcceleration(int i) const {
            const Vec3 result = state.forces[i] * system.getInverseMasses()[i];
            if (hasNetAccelerations)
                netAccelerations[i] = result; // the constraints' are added in the end
            return result;
        }
        void multiplyAccelerations(vector<double>& x) const {
            system.multiplyOverMass(jacobian, state.forces, x, part);
        }
        void addParameterMotion(vector<double>& x) const {
            system.addParameterMotion(state.positions, state.parameters, x, part);
        }
        void evaluateCurvature(const Vectors& velocities, vector<double>& x) const {
            system.evaluateCurvature(state.positions, velocities, state.parameters, x, part);
        }
        const OnStep& state;
        const double kick;
        const bool hasHalfStep, hasNetAccelerations;
        const Vectors& w;
        Vectors &v, &netAccelerations; // these if they are wanted
        vector<double>&applied, &rightSide, &multipliers, &halfRightSide, &halfMultipliers; // likewise
    };
    Clusters clustersOf(const Part& part) const {
        return {solver, part, state};
    }
    void runFree(int i) const {
        Clusters one = clustersOf(ConstraintSystem::ALL);
        FinishStages::kick(one, i);
    }
    const OnStep& state;
    HalfStep* half;
    const OnStepArrays arrays;
};

template <class Each> SharedWork::Result ConstraintSolver::run(const Each& pass) {
    auto prepare = [&](const Part& part) {
        pass.prepare(part);
        auto clusters = pass.clustersOf(part);
        pass.stages.prepare(clusters);
    };
    auto factorize = [&](const Part& part, Result& share) {
        if (pass.toFactorize() != nullptr)
            share.addFailed(matrix.tryToFactorize(*pass.toFactorize(), part));
        return share.failed == ConstraintMatrix::REGULAR;
    };
    work.runOnJoints([&](const CutCluster& cluster) { prepare(cluster.joints); });
    Result result = work.run(
        [&](int block) { pass.seeBlock(block); },
        [&](const ClusterBatch& batch, int begin, int end, Result& share) { pass.runBatch(batch, begin, end, share); },
        [&](int particle) { pass.runFree(particle); },
        [&](const Part& part, Result& share) {
            prepare(part);
            if (!factorize(part, share))
                return;
            auto clusters = pass.clustersOf(part);
            const StagesResult found = runStages(pass.stages, clusters);
            pass.seePart(part);
            share.addIterations(found.stage);
            share.addError(found.error);
        },
        [&](const Part& piece, Result& share) {
            prepare(piece);
            if (factorize(piece, share))
                share.addPieceError(beginStage(pass, 0, piece));
        });
    if (!system.getPieces().empty() && result.failed == ConstraintMatrix::REGULAR)
        runCut(pass, result);
    return result;
}

// A piece's part of a stage, up to where it waits for its joints; returns the largest error.
template <class Each> double ConstraintSolver::beginStage(const Each& pass, int stage, const Part& piece) {
    auto clusters = pass.clustersOf(piece);
    pass.stages.move(stage, clusters);
    const double error = pass.stages.form(stage, clusters);
    isPieceEliminated[piece.piece] = pass.stages.isCertain(stage, error);
    if (isPieceEliminated[piece.piece])
        eliminate(pass, stage, piece);
    return error;
}

template <class Each> void ConstraintSolver::eliminate(const Each& pass, int stage, const Part& piece) {
    auto clusters = pass.clustersOf(piece);
    pass.stages.forUnknowns(stage, clusters,
                            [&](vector<double>& x, int channel) { matrix.eliminate(x, piece, channel); });
}

// The rest for cut clusters, when all pieces have begun the first stage.
template <class Each> void ConstraintSolver::runCut(const Each& pass, Result& result) {
    double error = result.pieceError, previous = std::numeric_limits<double>::infinity();
    for (int stage = 0; stage < pass.stages.getCount(); stage++) {
        work.runOnJoints([&](const CutCluster& cluster) {
            if (stage == 0 && pass.toFactorize() != nullptr)
                result.addFailed(matrix.tryToFactorizeJoints(*pass.toFactorize(), cluster));
            auto joints = pass.clustersOf(cluster.joints);
            error = largerOf(error, pass.stages.form(stage, joints));
        });
        if (result.failed != ConstraintMatrix::REGULAR)
            return;
        if (pass.stages.isLast(stage, error, previous)) {
            result.addIterations(stage);
            break;
        }
        previous = error;
        if (std::count(isPieceEliminated.begin(), isPieceEliminated.end(), false) > 0)
            work.runOnPieces([&](const Part& piece, Result&) {
                if (!isPieceEliminated[piece.piece])
                    eliminate(pass, stage, piece);
            });
        const bool isMore = stage + 1 < pass.stages.getCount();
        work.runOnJoints([&](const CutCluster& cluster) {
            auto joints = pass.clustersOf(cluster.joints);
            pass.stages.forUnknowns(stage, joints,
                                    [&](vector<double>& x, int channel) { matrix.solveJoints(x, cluster, channel); });
            pass.stages.update(joints);
            if (!isMore)
                pass.seePart(cluster.joints);
        });
        const Result pieces = work.runOnPieces([&](const Part& piece, Result& share) {
            auto clusters = pass.clustersOf(piece);
            pass.stages.forUnknowns(stage, clusters, [&](vector<double>& x, int) { matrix.substitute(x, piece); });
            pass.stages.update(clusters);
            if (isMore)
                share.addError(beginStage(pass, stage + 1, piece));
            else {
                pass.stages.complete(clusters);
                pass.seePart(piece);
            }
        });
        if (isMore)
            error = pieces.error;
    }
    result.addError(error);
}

// ------------------------------------------------------------------------------------------------------ a step from there

StepArrays ConstraintSolver::arraysOf(const Trial& trial, const Vectors& from, const Vec3* forces) {
    return {from.data(),
            trial.start.data(),
            forces,
            trial.positions.data(),
            trial.velocities.data(),
            trial.multipliers.data(),
            correction.data(),
            nullptr,
            nullptr,
            trial.kick,
            trial.drift};
}

// w+ and q+ of some particles, and what constraints do to them; w+ is kept if it is asked for.
void ConstraintSolver::moveParticles(const Trial& trial, const int* first, const int* end, const Part& part,
                                     bool withVelocities) {
    const vector<double>& inverseMasses = system.getInverseMasses();
    Vectors& net = withVelocities ? trial.velocities : trial.positions; // M^-1 (F - G^T lambda), until these are known
    for (const int* i = first; i < end; i++)
        net[*i] = (*force)[*i] * inverseMasses[*i];
    system.addTransposedOverMass(jacobian, trial.multipliers, -1.0, net, part);
    for (const int* i = first; i < end; i++) {
        const Vec3 velocity = trial.start[*i] + net[*i] * trial.kick;
        if (withVelocities)
            trial.velocities[*i] = velocity;
        trial.positions[*i] = (*q)[*i] + velocity * trial.drift;
    }
}

void ConstraintSolver::moveParticles(const Trial& trial, const Part& part, bool withVelocities) {
    const int* particles = system.getGeneralParticles().data();
    moveParticles(trial, particles + part.firstParticle, particles + part.endParticle, part, withVelocities);
}

void ConstraintSolver::moveFreeParticle(const StepArrays& step, int i) const {
    step.wNext[i] = step.start[i];
    if (step.force != nullptr)
        step.wNext[i] += step.force[i] * (step.kick * system.getInverseMasses()[i]);
    step.qNext[i] = step.q[i] + step.wNext[i] * step.drift;
}

bool ConstraintSolver::solvePositions(const Trial& trial, const Guess& guess) {
    ensureGeneralFactor();
    const Result result = run(ChordPass(*this, trial, guess));
    lastError = result.error;
    numIterations += result.iterations;
    return lastError <= tolerance || solveByNewton(trial, guess);
}

bool ConstraintSolver::solveInTurn(const Trial& trial, const Guess& guess, Change& change, const Trial& second,
                                   const Guess& secondGuess, const Vectors& noForce) {
    const Vectors &qBefore = *q, &forceBefore = *force;
    const ExpressionParameters& thetaBefore = *theta;
    try {
        ensureGeneralFactor();
        const Result first = run(
            FirstPass(*this, trial, guess, change, ChordPass(*this, second, secondGuess, trial.positions, nullptr)));
        if (!(first.error <= tolerance))
            return false;
        Result next;
        moveTo(trial.positions, trial.parameters, noForce);
        if (system.getFirstGeneral() < system.getNumConstraints()) {
            const vector<int>& particles = system.getGeneralParticles();
            share((int) particles.size(),
                  [&](int begin, int end) { change.changeVelocities(particles.data() + begin, end - begin); });
            ensureGeneralFactor();
            next = run(SecondPass(*this, second, secondGuess));
        }
        if (next.error <= tolerance) {
            lastError = std::max(first.error, next.error);
            numIterations += std::max(first.batchIterations, first.iterations + next.iterations);
            return true;
        }
    }
    catch (const StepFailure&) { // to be met again, and explained, by whoever does one after the other
    }
    moveTo(qBefore, thetaBefore, forceBefore);
    return false;
}

void ConstraintSolver::guess(const Trial& trial, const Guess& guess) {
    this->guess(trial, guess, 0, system.getNumConstraints());
}

void ConstraintSolver::guess(const Trial& trial, const Guess& guess, int first, int end) const {
    const double* from = guess.multipliers.data();
    double* to = trial.multipliers.data();
    if (guess.offset == nullptr) {
        std::copy(from + first, from + end, to + first);
        return;
    }
    const double *found = guess.offset->found.data(), *expected = guess.offset->expected.data();
    for (int k = first; k < end; k++)
        to[k] = from[k] + (found[k] - expected[k]);
}

double ConstraintSolver::coupledPass(const Trial& trial, const Coupled& coupled, const Guess* start,
                                     Observer* observer) {
    ensureGeneralFactor();
    numIterations += start == nullptr;
    return lastError = run(CoupledPass(*this, trial, coupled, start, observer)).error;
}

// ------------------------------------------------------------------------------------------------------------- its end

void ConstraintSolver::finish(const OnStep& state, Observer* observer) {
    factorScope = NoFactor;
    const Result result = run(FinishPass(*this, state, observer));
    if (result.failed != ConstraintMatrix::REGULAR)
        matrix.throwDependent(result.failed, jacobianNext);
    if (!(result.pivot > ConstraintMatrix::MIN_RELATIVE_PIVOT)) {
        // The general way knows how to name the cluster.
        system.evaluateJacobian(state.positions, state.parameters, jacobianNext);
        matrix.factorize(jacobianNext);
    }
}

void ConstraintSolver::moveToEnd() {
    jacobian.swap(jacobianNext);
    appliedTerm.swap(appliedTermNext);
    factorScope = GeneralFactor;
}
