// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ConstraintSolver.h"
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Differences of the velocities of particles that are the same but for the rounding of both.
const double FRAME_ROUNDING = 4 * std::numeric_limits<double>::epsilon();

const int MAX_CHORD_ITERATIONS = 12, MAX_NEWTON_ITERATIONS = 50;
// If an iteration leaves more than this fraction of the error, something else is tried, or it is rounding.
const double SLOW_CONVERGENCE = 0.25;
// What Newton's iteration for a step aims at, in tolerances; and what is aimed at where positions are projected. Where rounding does not
// allow the fraction, the tolerance itself counts.
const double NEWTON_MARGIN = 0.1, PROJECTION_MARGIN = 1e-4;
// Newton's iteration takes the largest part 1, 1/2, 1/4, ... of its update that brings the error down by this fraction of what it
// would were the constraints linear; below the smallest it gives up.
const double SUFFICIENT_DECREASE = 0.25, SMALLEST_PART = 1e-4;

/** Move by a part of an update, as moveBy(part) does, which returns the error there; returns whether a part has been found. */
template <class Move> bool takeDampedUpdate(double error, const Move& moveBy) {
    for (double part = 1; part >= SMALLEST_PART; part *= 0.5)
        if (moveBy(part) <= (1 - SUFFICIENT_DECREASE * part) * error)
            return true;
    return false;
}

} // namespace

ConstraintSolver::ConstraintSolver(const vector<double>& masses, const vector<DistanceConstraint>& constraints,
                                   const vector<ExpressionConstraint>& expressions) :
        system(masses, constraints, expressions), matrix(system), newtonMatrix(system), work(system), tolerance(1e-8),
        numIterations(0), lastError(0), q(nullptr), force(nullptr), theta(nullptr), factorScope(NoFactor),
        acceleration(masses.size()), isPieceEliminated(system.getPieces().size()) {
    for (int i = 0; i < system.getNumParticles(); i++)
        if (masses[i] > 0)
            movingParticles.push_back(i);
    for (vector<double>* numbers : {&appliedTerm, &appliedTermNext, &residual, &correction, &before})
        numbers->resize(system.getNumConstraints());
    rangeResults.resize(SharedWork::getNumRanges(std::max(system.getNumParticles(), system.getNumConstraints())));
    for (ConstraintSystem::Jacobian* rows : {&jacobian, &jacobianNext, &velocityJacobian})
        rows->resize(system.getNumEntries());
}

// ------------------------------------------------------------------------------------------------------------- the passes

/*
 * A pass does the same to all clusters. The batches and the free particles have it done in one go. For the others it is a sequence of
 * stages, each of which moves the particles of a part, forms equations K x = b for one unknown or two, and has them solved. A part
 * of whole clusters goes through all stages at once; pieces of a cut cluster wait at the end of each for their joints, which have
 * equations and no particles.
 */
struct ConstraintSolver::Pass {
    /** The second may be null. */
    typedef std::array<vector<double>*, ConstraintMatrix::NUM_CHANNELS> Unknowns;
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
            aim(guess.margin * solver.tolerance) {
    }
    int numStages() const {
        return MAX_CHORD_ITERATIONS + 1;
    }
    void prepare(const Part& part) const {
        solver.guess(trial, guess, part.first, part.end);
    }
    void runBatch(const ClusterBatch& batch, int begin, int end, Result& share) const {
        solver.guess(trial, guess, batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
        share.addError(batch.solvePositions(arrays, begin, end, aim, share.iterations));
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
    // When there has been at least one update, since Lambda itself, unrefined, costs accuracy even where it meets the tolerance, and the
    // error is small enough, or no longer reduced, so that it is rounding, or Newton's to deal with.
    bool isLast(int stage, double error, double previous) const {
        return stage > 0 && (error <= aim || !(error < 0.5 * previous) || stage == MAX_CHORD_ITERATIONS);
    }
    bool isCertain(int stage, double error) const {
        return stage == 0 || error > aim;
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
    const double aim;
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
        for (vector<double>* x : pass.unknowns(stage))
            if (x != nullptr)
                matrix.solve(*x, part);
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
            error = SharedWork::larger(error, pass.form(stage, cluster.joints));
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
            for (size_t channel = 0; channel < unknowns.size() && unknowns[channel] != nullptr; channel++)
                matrix.solveJoints(*unknowns[channel], cluster, (int) channel);
            pass.update(cluster.joints);
            if (stage + 1 == pass.numStages())
                pass.seePart(cluster.joints);
        });
        const bool isMore = stage + 1 < pass.numStages();
        const Result pieces = work.runOnPieces([&](const Part& piece, Result& share) {
            for (vector<double>* x : unknowns)
                if (x != nullptr)
                    matrix.substitute(*x, piece);
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
    for (size_t channel = 0; channel < unknowns.size() && unknowns[channel] != nullptr; channel++)
        matrix.eliminate(*unknowns[channel], piece, (int) channel);
}

// --------------------------------------------------------------------------------------------- at the positions of a step

void ConstraintSolver::moveTo(const Vectors& positions, const ExpressionParameters& parameters, const Vectors& forces) {
    q = &positions;
    theta = &parameters;
    force = &forces;
    factorScope = NoFactor;
}

// G(q), G M^-1 F and the factor of K, of the general clusters or of all. The batches form their own in each pass.
void ConstraintSolver::ensureFactor(FactorScope scope) {
    if (factorScope >= scope)
        return;
    auto form = [&](const Part& part) {
        system.evaluateJacobian(*q, *theta, jacobian, part);
        system.multiplyOverMass(jacobian, *force, appliedTerm, part);
    };
    auto factorize = [&](const Part& part, Result& share) {
        form(part);
        share.addFailed(matrix.tryToFactorize(jacobian, part));
    };
    work.runOnJoints([&](const CutCluster& cluster) { form(cluster.joints); }); // which are in the columns of pieces
    Result result =
        work.run([](int) {}, [](const ClusterBatch&, int, int, Result&) {}, [](int) {}, factorize, factorize);
    if (scope == FullFactor && system.getFirstGeneral() > 0)
        factorize(system.getWholeParts()[0], result);
    work.runOnJoints([&](const CutCluster& cluster) {
        if (result.failed == ConstraintMatrix::REGULAR)
            result.addFailed(matrix.tryToFactorizeJoints(jacobian, cluster));
    });
    if (result.failed != ConstraintMatrix::REGULAR)
        matrix.throwDependent(result.failed, jacobian);
    factorScope = scope;
}

int ConstraintSolver::getNumRanges() const {
    int numParts = 0; // the batches may be one too
    for (const Part& part : system.getWholeParts())
        numParts = std::max(numParts, part.index + 1);
    for (const CutCluster& cluster : system.getCutClusters())
        numParts = std::max(numParts, cluster.joints.index + 1);
    return (int) ((system.getBlocks().size() - 1) * system.getBatches().size()) + numParts;
}

void ConstraintSolver::ensureGeneralFactor() {
    if (system.getFirstGeneral() < system.getNumConstraints())
        ensureFactor(GeneralFactor);
}

void ConstraintSolver::findMultipliers(const Vectors& v, const ExpressionParameters& parameters,
                                       vector<double>& multipliers, vector<double>& rightSide) {
    ensureFactor(FullFactor);
    system.evaluateCurvature(*q, v, parameters, rightSide);
    for (size_t k = 0; k < rightSide.size(); k++)
        rightSide[k] += appliedTerm[k];
    multipliers = rightSide;
    matrix.solve(multipliers);
}

// Half of what it has more with twice the rates than with none, since it is a square function of them.
void ConstraintSolver::findChangeWithRates(const Vectors& v, const ExpressionParameters& parameters,
                                           vector<double>& result) const {
    ExpressionParameters other = parameters;
    for (double& rate : other.rates)
        rate *= 2;
    system.evaluateCurvature(*q, v, other, result);
    other.isMoving = false;
    vector<double> atRest(result.size());
    system.evaluateCurvature(*q, v, other, atRest);
    for (size_t k = 0; k < result.size(); k++)
        result[k] = 0.5 * (result[k] - atRest[k]);
}

void ConstraintSolver::projectVelocities(Vectors& v) {
    ensureFactor(FullFactor);
    system.multiply(jacobian, v, correction);
    matrix.solve(correction);
    system.addTransposedOverMass(jacobian, correction, -1.0, v);
}

void ConstraintSolver::addProjection(const Vectors& v, const ExpressionParameters& parameters, Vectors& result) {
    ensureFactor(FullFactor);
    system.multiply(jacobian, v, correction);
    system.addParameterMotion(*q, parameters, correction);
    matrix.solve(correction);
    system.addTransposedOverMass(jacobian, correction, -1.0, result);
}

void ConstraintSolver::addTransposedOverMass(const vector<double>& x, double scale, Vectors& result) {
    ensureFactor(FullFactor);
    system.addTransposedOverMass(jacobian, x, scale, result);
}

void ConstraintSolver::multiplyOverMass(const Vectors& f, vector<double>& result) {
    ensureFactor(FullFactor);
    system.multiplyOverMass(jacobian, f, result);
}

void ConstraintSolver::solveMatrix(vector<double>& x) {
    ensureFactor(FullFactor);
    matrix.solve(x);
}

void ConstraintSolver::addVelocityJacobianTransposed(const Vectors& v, const ExpressionParameters& parameters,
                                                     const vector<double>& x, Vectors& result) {
    system.evaluateVelocityJacobian(*q, v, parameters, velocityJacobian);
    system.addTransposed(velocityJacobian, x, result);
}

// Multipliers are differences of accelerations; compare with the size of what cancels, in the multipliers' unit.
double ConstraintSolver::findMultiplierRounding(bool isMassWeighted, const Vectors& v, double smallAcceleration) {
    ensureGeneralFactor(); // for the Jacobian
    const double fraction = 1e-12;
    double largest = 0;
    const vector<double>& inverseMasses = system.getInverseMasses();
    auto forceOn = [&](int i, double length) {
        return fraction * (std::sqrt((*force)[i].dot((*force)[i])) + v[i].dot(v[i]) / (inverseMasses[i] * length));
    };
    for (int k = 0; k < system.getNumConstraints(); k++) {
        if (system.isExpression(k))
            continue;
        const DistanceConstraint& c = system.getConstraint(k);
        const double lighter = 1 / std::max(inverseMasses[c.particle1], inverseMasses[c.particle2]);
        for (int i : {c.particle1, c.particle2})
            if (inverseMasses[i] > 0) {
                const double size = forceOn(i, c.length) + lighter * smallAcceleration;
                largest =
                    std::max(largest, isMassWeighted ? size * std::sqrt(inverseMasses[i]) : size / (2 * c.length));
            }
    }
    for (const ConstraintSystem::ExpressionRow& row : system.getExpressionRows()) {
        double product = 0, square = 0; // G M^-1 F without cancellation, and the diagonal of K
        for (int entry = row.first; entry < row.end; entry++) {
            const int i = system.getParticleOf(entry);
            const double rowSquared = jacobian[entry].dot(jacobian[entry]);
            product += std::sqrt(rowSquared) *
                       (forceOn(i, ConstraintSystem::EXPRESSION_LENGTH) * inverseMasses[i] + smallAcceleration);
            square += rowSquared * inverseMasses[i];
        }
        largest = std::max(largest, product / (isMassWeighted ? std::sqrt(square) : square));
    }
    return largest;
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

// The same for all constraints with Newton's iteration: G(q+) M^-1 G(q)^T in place of K. Where the chord iteration fails.
bool ConstraintSolver::solveByNewton(const Trial& trial, const Guess& guess) {
    ensureFactor(FullFactor);
    // From where the chord iteration has come to, and if that was too far off, from the guess.
    if (iterateNewton(trial))
        return true;
    this->guess(trial, {guess.multipliers, nullptr, guess.margin});
    return iterateNewton(trial);
}

bool ConstraintSolver::iterateNewton(const Trial& trial) {
    lastError = evaluate(trial);
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS && std::isfinite(lastError); iteration++) {
        const bool isSlow = lastError > SLOW_CONVERGENCE * previous;
        if (iteration > 0 && lastError <= tolerance * (isSlow ? 1.0 : NEWTON_MARGIN))
            return true;
        previous = lastError;
        if (!linearize(trial))
            return false;
        correction = residual;
        newtonMatrix.solve(correction);
        before = trial.multipliers;
        auto moveBy = [&](double part) {
            for (size_t k = 0; k < before.size(); k++)
                trial.multipliers[k] = before[k] + part * correction[k] / (trial.kick * trial.drift);
            return evaluate(trial);
        };
        if (lastError <= tolerance)
            moveBy(1); // rounding may keep the error from becoming less
        else if (!takeDampedUpdate(lastError, moveBy))
            return false;
        numIterations++;
    }
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

double ConstraintSolver::evaluate(const Trial& trial) {
    ensureFactor(FullFactor);
    moveParticles(trial, movingParticles.data(), movingParticles.data() + movingParticles.size(), ConstraintSystem::ALL,
                  true);
    return lastError = system.evaluate(trial.positions, trial.parameters, residual, jacobian);
}

bool ConstraintSolver::linearize(const Trial& trial) {
    system.evaluateJacobian(trial.positions, trial.parameters, jacobianNext);
    return newtonMatrix.factorize(jacobianNext, jacobian);
}

void ConstraintSolver::findUpdate(const Trial& trial, vector<double>& x) {
    x = residual;
    newtonMatrix.solve(x);
    for (double& each : x)
        each /= trial.kick * trial.drift;
}

void ConstraintSolver::findResponse(const Trial& trial, const Vectors& dq, vector<double>& x) {
    system.multiply(jacobianNext, dq, x);
    newtonMatrix.solve(x);
    for (double& each : x)
        each /= -trial.kick * trial.drift;
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

// ------------------------------------------------------------------------------------------------------------- anywhere

bool ConstraintSolver::findFrameShift(const Vectors& before, const Vectors& after, Vec3& shift) {
    if (!system.isTranslationInvariant() || movingParticles.empty())
        return false;
    const int one = movingParticles[0];
    shift = after[one] - before[one];
    auto sizeOf = [](const Vec3& x) { return std::fabs(x[0]) + std::fabs(x[1]) + std::fabs(x[2]); };
    const double reference = sizeOf(shift) + sizeOf(before[one]);
    const double numOthers = largest((int) movingParticles.size(), [&](int p) {
        const int i = movingParticles[p];
        const bool isShifted = sizeOf(after[i] - before[i] - shift) <= FRAME_ROUNDING * (reference + sizeOf(before[i]));
        return isShifted ? 0.0 : 1.0;
    });
    return numOthers == 0;
}

bool ConstraintSolver::projectPositions(Vectors& positions, const ExpressionParameters& parameters) {
    if (system.getNumConstraints() == 0)
        return false;
    factorScope = NoFactor;
    system.evaluateJacobian(positions, parameters, jacobian);
    if (system.evaluate(positions, parameters, residual, jacobian) <= tolerance)
        return false;
    Vectors result = positions;
    if (!projectByChord(parameters, result)) {
        result = positions;
        if (!projectByNewton(parameters, result)) {
            for (int i : movingParticles)
                acceleration[i] = result[i] - positions[i];
            system.evaluateJacobian(positions, parameters, jacobian);
            throw StepFailure(explain(
                positions, parameters, acceleration,
                "; set positions that are nearer to where the constraints hold, if there are such: constraints that "
                "contradict each other have none"));
        }
    }
    positions.swap(result);
    return true;
}

// Chord iterations for g(q + M^-1 G(q)^T x) = 0 with K(q), which is enough where q is nearly right.
bool ConstraintSolver::projectByChord(const ExpressionParameters& parameters, Vectors& positions) {
    matrix.factorize(jacobian);
    double previous = std::numeric_limits<double>::infinity();
    while (true) {
        lastError = system.evaluate(positions, parameters, residual, jacobian);
        const bool isSlow = !(lastError <= SLOW_CONVERGENCE * previous);
        if (lastError <= tolerance * (isSlow ? 1.0 : PROJECTION_MARGIN))
            return true;
        if (isSlow)
            return false;
        previous = lastError;
        matrix.solve(residual);
        system.addTransposedOverMass(jacobian, residual, -1.0, positions);
        numIterations++;
    }
}

// Damped Newton's iteration, each step of it along M^-1 G^T of where it has come to.
bool ConstraintSolver::projectByNewton(const ExpressionParameters& parameters, Vectors& positions) {
    Vectors next;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        system.evaluateJacobian(positions, parameters, jacobian);
        lastError = system.evaluate(positions, parameters, residual, jacobian);
        const bool isSlow = !(lastError <= SLOW_CONVERGENCE * previous);
        if (lastError <= tolerance * (isSlow ? 1.0 : PROJECTION_MARGIN))
            return true;
        previous = lastError;
        if (!std::isfinite(lastError) ||
            matrix.tryToFactorize(jacobian, ConstraintSystem::ALL) != ConstraintMatrix::REGULAR)
            return false;
        correction = residual;
        matrix.solve(correction);
        const bool isFound = takeDampedUpdate(lastError, [&](double part) {
            next = positions;
            system.addTransposedOverMass(jacobian, correction, -part, next);
            return system.evaluate(next, parameters, residual, jacobian);
        });
        // Where the error is no more than the tolerance, rounding may keep it from becoming less.
        if (!isFound && lastError > tolerance)
            return false;
        positions.swap(next);
        numIterations++;
    }
    return false;
}

void ConstraintSolver::subtractConstraintForces(const Vectors& positions, const ExpressionParameters& parameters,
                                                const vector<double>& x, Vectors& forces) {
    auto subtract = [&](const Part& part) {
        system.evaluateJacobian(positions, parameters, velocityJacobian, part);
        for (int k = part.first; k < part.end; k++)
            before[k] = -x[k];
        system.addTransposed(velocityJacobian, before, forces, part);
    };
    work.run([](int) {},
             [&](const ClusterBatch& batch, int begin, int end, Result&) {
                 Part part = {};
                 part.first = batch.getFirstConstraint(begin);
                 part.end = batch.getFirstConstraint(end);
                 subtract(part);
             },
             [](int) {}, [&](const Part& part, Result&) { subtract(part); },
             [&](const Part& piece, Result&) { subtract(piece); });
    work.runOnJoints([&](const CutCluster& cluster) { subtract(cluster.joints); });
}

// --------------------------------------------------------------------------------------------------------- explanations

std::string ConstraintSolver::explainFailure(const Trial& trial) {
    for (int i : movingParticles)
        acceleration[i] = trial.start[i] * trial.drift;
    return explain(*q, *theta, acceleration, "");
}

UselessForces ConstraintSolver::explainForces(const Vectors& forces) const {
    auto square = [&](int i) { return forces[i].dot(forces[i]); };
    int worst = movingParticles[0];
    for (int i : movingParticles)
        if (std::isfinite(square(worst)) && !(square(i) <= square(worst)))
            worst = i;
    const bool isFinite = std::isfinite(forces[worst][0] + forces[worst][1] + forces[worst][2]);
    return UselessForces("the force on particle " + std::to_string(worst) +
                         (isFinite ? " is too large to compute with" : " is infinite or not a number"));
}

// The way out is for what has no explanation of its own.
std::string ConstraintSolver::explain(const Vectors& from, const ExpressionParameters& parameters,
                                      const Vectors& displacement, const std::string& wayOut) {
    std::stringstream reason;
    // What keeps an iteration from converging need not be what has the largest error in the end.
    const int worst = system.findLargest(residual, jacobian);
    const int singular = system.findSingular(from, parameters, displacement, jacobian, velocityJacobian);
    const std::string unresolved = system.explainResolution(worst, from, tolerance);
    if (singular != ConstraintSystem::NONE)
        reason << system.describe(singular)
               << " is close to a singular geometry, in which its gradient is infinite or zero (as that of a dihedral "
                  "angle over three particles in a line); keep the molecule away from there, or constrain something "
                  "else";
    else if (!unresolved.empty())
        reason << unresolved;
    else if (std::isfinite(lastError))
        reason << system.describe(worst) << " could not be solved for (relative error " << lastError << " left)"
               << wayOut;
    else if (system.isExpression(worst) && !std::isfinite(residual[worst]))
        reason << system.describe(worst) << " became infinite or not a number";
    else
        reason << "the constraints could not be solved for (the iteration diverged)" << wayOut;
    return reason.str();
}
