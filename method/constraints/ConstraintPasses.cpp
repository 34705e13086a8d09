// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What ConstraintSolver does in a step: passes over all clusters.

#include "constraints/ChordIteration.h"
#include "constraints/ConstraintSolver.h"
#include <algorithm>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

/*
 * A pass does the same to all clusters. The batches and the free particles have it done in one go. For the others it is a sequence of
 * stages, each of which moves the particles of a part, forms equations K x = b for one unknown or two, and has them solved. A part
 * of whole clusters goes through all stages at once; pieces of a cut cluster wait at the end of each for their joints, which have
 * equations and no particles.
 */
struct ConstraintSolver::Pass {
    /** What K x = b is solved for, b at first; the second may be null. */
    struct Unknowns {
        vector<double>*first, *second;
        /** task(x, channel) */
        template <class Task> void forEach(const Task& task) const {
            task(*first, 0);
            if (second != nullptr)
                task(*second, 1);
        }
    };
    explicit Pass(ConstraintSolver& solver, Observer* observer = nullptr) :
            solver(solver), system(solver.system), observer(observer) {
    }
    int numStages() const {
        return 1;
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
    /** Before everything else, and for joints before all pieces. */
    void prepare(const Part&) const {
    }
    /** Whether no more is to be solved for, which the largest errors of this stage and the one before tell. */
    bool isLast(int, double, double) const {
        return false;
    }
    /** Whether there is certainly something to solve for, even before the errors of other pieces are known. */
    bool isCertain(int, double) const {
        return true;
    }
    /** When the unknowns have been found. */
    void update(const Part&) const {
    }
    /** When those of the last stage have, for all that has particles. */
    void complete(const Part&) const {
    }
    ConstraintSolver& solver;
    const ConstraintSystem& system;
    Observer* const observer;
};

// The chord iteration for (3.11), A = -kick drift K(q); each stage is an iteration.
struct ConstraintSolver::ChordPass : Pass {
    ChordPass(ConstraintSolver& solver, const Trial& trial, const Guess& guess) :
            ChordPass(solver, trial, guess, *solver.q, solver.force->data()) {
    }
    ChordPass(ConstraintSolver& solver, const Trial& trial, const Guess& guess, const Vectors& q, const Vec3* force) :
            Pass(solver), trial(trial), guess(guess), arrays(solver.arraysOf(trial, q, force)),
            iteration{guess.margin * solver.tolerance} {
    }
    int numStages() const {
        return ChordIteration::MAX_UPDATES + 1;
    }
    void prepare(const Part& part) const {
        solver.guess(trial, guess, part.first, part.end);
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        solver.guess(trial, guess, batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
        share.addError(batch.solvePositions(arrays, begin, end, iteration, share.iterations));
    }
    void runFree(int particle) const {
        solver.moveFreeParticle(arrays, particle);
    }
    void move(int stage, const Part& part) const {
        solver.moveParticles(trial, part, stage > 0); // there is at least one update
    }
    double form(int, const Part& part) const {
        return system.evaluate(trial.positions, trial.parameters, solver.correction, solver.jacobian, part);
    }
    bool isLast(int stage, double error, double previous) const {
        return iteration.isOver(stage, error, previous);
    }
    bool isCertain(int stage, double error) const {
        return stage == 0 || error > iteration.aim;
    }
    Unknowns unknowns(int) const {
        return {&solver.correction, nullptr};
    }
    void update(const Part& part) const {
        for (int k = part.first; k < part.end; k++)
            trial.multipliers[k] += solver.correction[k] / (trial.kick * trial.drift);
    }
    const Trial& trial;
    const Guess& guess;
    const StepArrays arrays;
    const ChordIteration iteration;
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

// One chord iteration with Lambda(q,p+), its only stage.
struct ConstraintSolver::CoupledPass : Pass {
    CoupledPass(ConstraintSolver& solver, const Trial& trial, const Coupled& coupled, const Guess* guess,
                Observer* observer) :
            Pass(solver, observer), trial(trial), coupled(coupled), guess(guess),
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
        for (int k = part.first; k < part.end; k++)
            trial.multipliers[k] += solver.correction[k];
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        start(batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
        share.addError(batch.coupledPass(arrays, begin, end));
    }
    void runFree(int particle) const {
        solver.moveFreeParticle(arrays, particle);
    }
    void move(int, const Part& part) const {
        solver.moveParticles(trial, part, true);
    }
    double form(int, const Part& part) const {
        vector<double>& correction = solver.correction;
        const double error = system.evaluate(trial.positions, trial.parameters, correction, solver.jacobian, part);
        system.evaluateCurvature(*solver.q, trial.velocities, coupled.parameters, coupled.rightSide, part);
        for (int k = part.first; k < part.end; k++) {
            coupled.multipliers[k] = coupled.rightSide[k] += solver.appliedTerm[k];
            correction[k] /= trial.kick * trial.drift;
        }
        return error;
    }
    Unknowns unknowns(int) const {
        return {&coupled.multipliers, &solver.correction};
    }
    const Trial& trial;
    const Coupled& coupled;
    const Guess* guess;
    StepArrays arrays;
};

// The end of a step. Stages: (3.13), and (4.3) at one or two velocities.
struct ConstraintSolver::FinishPass : Pass {
    FinishPass(ConstraintSolver& solver, const OnStep& state, Observer* observer) :
            Pass(solver, observer), state(state), half(state.atHalfStep), jacobian(solver.jacobianNext),
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
    int numStages() const {
        return 2;
    }
    const ConstraintSystem::Jacobian* toFactorize() const {
        return &jacobian;
    }
    void prepare(const Part& part) const { // the joints' rows are in the columns of pieces
        system.evaluateJacobian(state.positions, state.parameters, jacobian, part);
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        share.addPivot(batch.finish(arrays, begin, end));
    }
    void runFree(int i) const {
        const Vec3 acceleration = state.forces[i] * system.getInverseMasses()[i];
        state.velocities[i] = state.halfStep[i] + acceleration * state.kick;
        if (state.accelerations != nullptr)
            (*state.accelerations)[i] = acceleration;
    }
    void move(int stage, const Part& part) const {
        const vector<int>& particles = system.getGeneralParticles();
        if (stage == 0) // (3.12)
            for (int p = part.firstParticle; p < part.endParticle; p++)
                runFree(particles[p]);
        else
            system.addTransposedOverMass(jacobian, solver.correction, -1.0, state.velocities, part);
    }
    double form(int stage, const Part& part) const {
        if (stage == 0) { // (3.13)
            system.multiply(jacobian, state.velocities, solver.correction, part);
            system.addParameterMotion(state.positions, state.parameters, solver.correction, part);
        }
        else { // K Lambda = g''(v,v) + G M^-1 F (4.3), at the on-step and the half-step velocities
            system.multiplyOverMass(jacobian, state.forces, solver.appliedTermNext, part);
            formMultiplierEquation(state.velocities, state.rightSide, state.multipliers, part);
            if (half != nullptr)
                formMultiplierEquation(state.halfStep, half->rightSide, half->multipliers, part);
        }
        return 0;
    }
    void formMultiplierEquation(const Vectors& velocities, vector<double>& rightSide, vector<double>& multipliers,
                                const Part& part) const {
        system.evaluateCurvature(state.positions, velocities, state.parameters, rightSide, part);
        for (int k = part.first; k < part.end; k++)
            multipliers[k] = rightSide[k] += solver.appliedTermNext[k];
    }
    Unknowns unknowns(int stage) const {
        if (stage == 0)
            return {&solver.correction, nullptr};
        return {&state.multipliers, half != nullptr ? &half->multipliers : nullptr};
    }
    void complete(const Part& part) const {
        if (state.accelerations != nullptr)
            system.addTransposedOverMass(jacobian, state.multipliers, -1.0, *state.accelerations, part);
    }
    const OnStep& state;
    HalfStep* half;
    ConstraintSystem::Jacobian& jacobian;
    const OnStepArrays arrays;
};

template <class Each> SharedWork::Result ConstraintSolver::run(const Each& pass) {
    work.runOnJoints([&](const CutCluster& cluster) { pass.prepare(cluster.joints); });
    Result result = work.run(
        [&](int block) { pass.seeBlock(block); },
        [&](const ClusterBatch& batch, int begin, int end, Result& share) { pass.runBatch(batch, begin, end, share); },
        [&](int particle) { pass.runFree(particle); },
        [&](const Part& part, Result& share) { runWhole(pass, part, share); },
        [&](const Part& piece, Result& share) {
            pass.prepare(piece);
            if (pass.toFactorize() != nullptr)
                share.addFailed(matrix.tryToFactorize(*pass.toFactorize(), piece));
            if (share.failed == ConstraintMatrix::REGULAR)
                share.addPieceError(beginStage(pass, 0, piece));
        });
    if (!system.getPieces().empty() && result.failed == ConstraintMatrix::REGULAR)
        runCut(pass, result);
    return result;
}

// All stages for a part of whole clusters.
template <class Each> void ConstraintSolver::runWhole(const Each& pass, const Part& part, Result& share) {
    pass.prepare(part);
    if (pass.toFactorize() != nullptr) {
        const int failed = matrix.tryToFactorize(*pass.toFactorize(), part);
        share.addFailed(failed);
        if (failed != ConstraintMatrix::REGULAR)
            return;
    }
    double error = 0, previous = std::numeric_limits<double>::infinity();
    for (int stage = 0; stage < pass.numStages(); stage++) {
        pass.move(stage, part);
        error = pass.form(stage, part);
        if (pass.isLast(stage, error, previous)) {
            share.addIterations(stage);
            break;
        }
        previous = error;
        pass.unknowns(stage).forEach([&](vector<double>& x, int) { matrix.solve(x, part); });
        pass.update(part);
    }
    pass.complete(part);
    pass.seePart(part);
    share.addError(error);
}

// A piece's part of a stage, up to where it waits for its joints; returns the largest error.
template <class Each> double ConstraintSolver::beginStage(const Each& pass, int stage, const Part& piece) {
    pass.move(stage, piece);
    const double error = pass.form(stage, piece);
    isPieceEliminated[piece.piece] = pass.isCertain(stage, error);
    if (isPieceEliminated[piece.piece])
        eliminate(pass.unknowns(stage), piece);
    return error;
}

// The rest for cut clusters, when all pieces have begun the first stage.
template <class Each> void ConstraintSolver::runCut(const Each& pass, Result& result) {
    double error = result.pieceError, previous = std::numeric_limits<double>::infinity();
    for (int stage = 0; stage < pass.numStages(); stage++) {
        work.runOnJoints([&](const CutCluster& cluster) {
            if (stage == 0 && pass.toFactorize() != nullptr)
                result.addFailed(matrix.tryToFactorizeJoints(*pass.toFactorize(), cluster));
            error = largerOf(error, pass.form(stage, cluster.joints));
        });
        if (result.failed != ConstraintMatrix::REGULAR)
            return;
        if (pass.isLast(stage, error, previous)) {
            result.addIterations(stage);
            break;
        }
        previous = error;
        const auto unknowns = pass.unknowns(stage);
        if (std::count(isPieceEliminated.begin(), isPieceEliminated.end(), false) > 0)
            work.runOnPieces([&](const Part& piece, Result&) {
                if (!isPieceEliminated[piece.piece])
                    eliminate(unknowns, piece);
            });
        work.runOnJoints([&](const CutCluster& cluster) {
            unknowns.forEach([&](vector<double>& x, int channel) { matrix.solveJoints(x, cluster, channel); });
            pass.update(cluster.joints);
            if (stage + 1 == pass.numStages())
                pass.seePart(cluster.joints);
        });
        const bool isMore = stage + 1 < pass.numStages();
        const Result pieces = work.runOnPieces([&](const Part& piece, Result& share) {
            unknowns.forEach([&](vector<double>& x, int) { matrix.substitute(x, piece); });
            pass.update(piece);
            if (isMore)
                share.addError(beginStage(pass, stage + 1, piece));
            else {
                pass.complete(piece);
                pass.seePart(piece);
            }
        });
        if (isMore)
            error = pieces.error;
    }
    result.addError(error);
}

template <class Unknowns> void ConstraintSolver::eliminate(const Unknowns& unknowns, const Part& piece) {
    unknowns.forEach([&](vector<double>& x, int channel) { matrix.eliminate(x, piece, channel); });
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
