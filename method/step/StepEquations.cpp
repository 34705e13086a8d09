// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What VRattleDynamics solves: the on-step state at given positions, and the equations of a step.

#include "step/VRattleDynamics.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

typedef ConstraintSystem::Part Part;
typedef ConstraintSystem::CutCluster CutCluster;
typedef SharedWork::Result Result;

namespace {

const int MAX_CHORD_ITERATIONS = 12, MAX_NEWTON_ITERATIONS = 50;
// If an iteration leaves more than this fraction of the error, something else is tried, or it is rounding.
const double SLOW_CONVERGENCE = 0.25, SLOW_COUPLED_CONVERGENCE = 0.5;
// The iteration of a regular step goes on to this fraction of the tolerance, that of a step from the on-step state, whose
// starting value is worse by a power of h, to this. What is left is not the same forwards and backwards, and so limits
// how closely a run can be retraced; where rounding does not allow the fraction, the tolerance itself counts.
const double REGULAR_MARGIN = 0.1, ON_STEP_MARGIN = 1e-4;
// The density equation (3.14) is solved to the tolerance of the constraints, but not closer than rounding of U allows; and
// where strained, badly scaled constraints make that rounding larger, the second number counts.
const double DENSITY_ROUNDING = 1e-12, STRAINED_DENSITY_ROUNDING = 1e-8;

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

double dot(const vector<double>& a, const vector<double>& b) {
    double sum = 0;
    for (size_t i = 0; i < a.size(); i++)
        sum += a[i] * b[i];
    return sum;
}

} // namespace

// ---------------------------------------------------------------------------------------------- the on-step state

// G(q), G M^-1 F and the factor of K, of the general clusters or of all. The batches form their own in each pass.
void VRattleDynamics::ensureFactor(FactorScope scope) {
    if (!isMonitorCurrent) {
        monitor.setForces(force, groupEnergy);
        isMonitorCurrent = true;
    }
    if (factorScope >= scope)
        return;
    Part part = ConstraintSystem::ALL;
    if (scope == GeneralFactor)
        part.first = system.getFirstGeneral();
    system.evaluateJacobian(q, theta, jacobian, part);
    const int failed = matrix.tryToFactorize(jacobian, part);
    if (failed != ConstraintMatrix::REGULAR)
        matrix.throwDependent(failed, jacobian);
    system.multiplyOverMass(jacobian, force, appliedTerm, part);
    factorScope = scope;
}

// v - M^-1 G^T K^-1 G v
void VRattleDynamics::projectVelocities(vector<Vec3>& velocities) {
    ensureFactor(FullFactor);
    system.multiply(jacobian, velocities, correction);
    matrix.solve(correction);
    system.addTransposedOverMass(jacobian, correction, -1.0, velocities);
}

// u(q,p) with Lambda = K^-1 (g''(v,v) + G M^-1 F)   (4.3)
double VRattleDynamics::evaluateU(const vector<Vec3>& velocities, const ExpressionParameters& parameters) {
    ensureFactor(FullFactor);
    system.evaluateCurvature(q, velocities, parameters, rightSideTrial);
    for (size_t k = 0; k < rightSideTrial.size(); k++)
        rightSideTrial[k] += appliedTerm[k];
    multiplierTrial = rightSideTrial;
    matrix.solve(multiplierTrial);
    monitor.evaluate(velocities, multiplierTrial, rightSideTrial, valuesTrial);
    return combineAndLimit(valuesTrial);
}

// The on-step quantities at a position: (3.12)-(3.13) from the half-step velocities, then Lambda and the monitors.
void VRattleDynamics::evaluateOnStep(const vector<Vec3>& positions, const ExpressionParameters& parameters,
                                     const vector<Vec3>& halfStep, const vector<Vec3>& forces, double energy,
                                     double kick, vector<Vec3>& velocities, vector<double>& multipliers,
                                     vector<double>& rightSides, vector<double>& monitorValues, bool withHalfStep) {
    factorScope = NoFactor;
    isMonitorCurrent = false;
    const OnStepArrays arrays = {positions.data(),
                                 halfStep.data(),
                                 forces.data(),
                                 velocities.data(),
                                 multipliers.data(),
                                 rightSides.data(),
                                 withHalfStep ? lambdaHalf.data() : nullptr,
                                 rightSideHalf.data(),
                                 lambdaRate.data(),
                                 kick};
    const OnStep state = {positions,   halfStep,   forces, parameters,  velocities,
                          multipliers, rightSides, kick,   withHalfStep};
    const vector<double>& inverseMasses = system.getInverseMasses();
    work.runOnJoints([&](const CutCluster& cluster) {
        system.evaluateJacobian(positions, parameters, jacobianNext,
                                cluster.joints); // their rows are in the columns of pieces
    });
    Result result =
        work.run([&](int block) { monitor.sumForces(forces, block); },
                 [&](const ClusterBatch& batch, int begin, int end, Result& share) {
                     share.addPivot(batch.finish(arrays, begin, end));
                 },
                 [&](int i) { velocities[i] = halfStep[i] + forces[i] * (kick * inverseMasses[i]); },
                 [&](const Part& part, Result& share) { share.addFailed(evaluateOnStepGeneral(state, part)); },
                 [&](const Part& piece, Result& share) { share.addFailed(beginVelocities(state, piece)); });
    if (result.failed == ConstraintMatrix::REGULAR)
        result.failed = evaluateOnStepPieces(state);
    if (result.failed != ConstraintMatrix::REGULAR)
        matrix.throwDependent(result.failed, jacobianNext);
    if (!(result.pivot > ConstraintMatrix::MIN_RELATIVE_PIVOT)) {
        // The general way knows how to name the cluster.
        system.evaluateJacobian(positions, parameters, jacobianNext);
        matrix.factorize(jacobianNext);
    }
    monitor.finishForces(forces, energy);
    if (!monitor.hasFiniteForces())
        throw StepFailure("the force on a particle is infinite or not a number");
    monitor.evaluate(velocities, multipliers, rightSides, monitorValues);
    monitor.requireValid(monitorValues);
    if (withHalfStep)
        monitor.evaluate(halfStep, lambdaHalf, rightSideHalf, valuesHalf);
}

// The same for clusters that are in no batch and not cut; returns what ConstraintMatrix::tryToFactorize() does.
int VRattleDynamics::evaluateOnStepGeneral(const OnStep& state, const Part& part) {
    const int failed = beginVelocities(state, part);
    if (failed != ConstraintMatrix::REGULAR)
        return failed;
    beginMultipliers(state, part);
    matrix.substitute(state.multipliers, part);
    if (state.withHalfStep) {
        matrix.substitute(lambdaHalf, part);
        beginRates(state, part);
        matrix.substitute(lambdaRate, part);
    }
    return ConstraintMatrix::REGULAR;
}

// And for those that are cut, after beginVelocities() for all pieces.
int VRattleDynamics::evaluateOnStepPieces(const OnStep& state) {
    int failed = ConstraintMatrix::REGULAR;
    work.runOnJoints([&](const CutCluster& cluster) {
        failed = std::max(failed, matrix.tryToFactorizeJoints(jacobianNext, cluster));
        system.multiply(jacobianNext, state.velocities, correction, cluster.joints);
        system.addParameterMotion(state.positions, state.parameters, correction, cluster.joints);
        matrix.solveJoints(correction, cluster);
    });
    if (failed != ConstraintMatrix::REGULAR)
        return failed;
    work.runOnPieces([&](const Part& piece, Result&) { beginMultipliers(state, piece); });
    work.runOnJoints([&](const CutCluster& cluster) {
        formMultiplierEquations(state, cluster.joints);
        matrix.solveJoints(state.multipliers, cluster, 0);
        if (state.withHalfStep)
            matrix.solveJoints(lambdaHalf, cluster, 1);
    });
    work.runOnPieces([&](const Part& piece, Result&) {
        matrix.substitute(state.multipliers, piece);
        if (state.withHalfStep) {
            matrix.substitute(lambdaHalf, piece);
            beginRates(state, piece);
        }
    });
    if (!state.withHalfStep)
        return ConstraintMatrix::REGULAR;
    work.runOnJoints([&](const CutCluster& cluster) {
        formRateEquations(state, cluster.joints);
        matrix.solveJoints(lambdaRate, cluster);
    });
    work.runOnPieces([&](const Part& piece, Result&) { matrix.substitute(lambdaRate, piece); });
    return ConstraintMatrix::REGULAR;
}

// Kick the velocities of a part, and begin to solve for their projection.
int VRattleDynamics::beginVelocities(const OnStep& state, const Part& part) {
    system.evaluateJacobian(state.positions, state.parameters, jacobianNext, part);
    const int failed = matrix.tryToFactorize(jacobianNext, part);
    if (failed != ConstraintMatrix::REGULAR)
        return failed;
    const vector<double>& inverseMasses = system.getInverseMasses();
    const vector<int>& particles = system.getGeneralParticles();
    for (int p = part.firstParticle; p < part.endParticle; p++) {
        const int i = particles[p];
        state.velocities[i] = state.halfStep[i] + state.forces[i] * (state.kick * inverseMasses[i]);
    }
    system.multiply(jacobianNext, state.velocities, correction, part);
    system.addParameterMotion(state.positions, state.parameters, correction, part);
    matrix.eliminate(correction, part);
    return ConstraintMatrix::REGULAR;
}

// Project the velocities of a part, and begin to solve for the multipliers.
void VRattleDynamics::beginMultipliers(const OnStep& state, const Part& part) {
    matrix.substitute(correction, part);
    system.addTransposedOverMass(jacobianNext, correction, -1.0, state.velocities, part);
    formMultiplierEquations(state, part);
    matrix.eliminate(state.multipliers, part, 0);
    if (state.withHalfStep)
        matrix.eliminate(lambdaHalf, part, 1);
}

// K Lambda = g''(v,v) + G M^-1 F (4.3), at the on-step and the half-step velocities.
void VRattleDynamics::formMultiplierEquations(const OnStep& state, const Part& part) {
    system.multiplyOverMass(jacobianNext, state.forces, appliedTermNext, part);
    auto form = [&](const vector<Vec3>& velocities, vector<double>& rightSides, vector<double>& multipliers) {
        system.evaluateCurvature(state.positions, velocities, state.parameters, rightSides, part);
        for (int k = part.first; k < part.end; k++)
            multipliers[k] = rightSides[k] += appliedTermNext[k];
    };
    form(state.velocities, state.rightSides, state.multipliers);
    if (state.withHalfStep)
        form(state.halfStep, rightSideHalf, lambdaHalf);
}

// Begin to solve for the change of the multipliers along dv = M^-1 (F - G^T Lambda), dLambda = 2 K^-1 G(v) dv.
void VRattleDynamics::beginRates(const OnStep& state, const Part& part) {
    const vector<double>& inverseMasses = system.getInverseMasses();
    const vector<int>& particles = system.getGeneralParticles();
    for (int p = part.firstParticle; p < part.endParticle; p++)
        acceleration[particles[p]] = state.forces[particles[p]] * inverseMasses[particles[p]];
    system.addTransposedOverMass(jacobianNext, state.multipliers, -1.0, acceleration, part);
    formRateEquations(state, part);
    matrix.eliminate(lambdaRate, part);
}

void VRattleDynamics::formRateEquations(const OnStep& state, const Part& part) {
    system.evaluateVelocityJacobian(state.positions, state.velocities, state.parameters, velocityJacobian, part);
    system.multiply(velocityJacobian, acceleration, lambdaRate, part);
    for (int k = part.first; k < part.end; k++)
        lambdaRate[k] *= 2;
}

// The change of u along F - G^T Lambda, of the on-step state that is about to be taken over.
double VRattleDynamics::evaluateRate() {
    if (monitor.usesVelocities()) {
        const vector<double>& inverseMasses = system.getInverseMasses();
        for (int i : movingParticles)
            acceleration[i] = monitor.getForces()[i] * inverseMasses[i];
        system.evaluateJacobian(qNext, thetaNext, velocityJacobian);
        system.addTransposedOverMass(velocityJacobian, lambdaOnStep, -1.0, acceleration);
    }
    return density.limitDerivative(monitor.combine(valuesNext)) *
           monitor.evaluateRate(vNext, lambdaOnStep, rightSideNext, valuesNext, acceleration, lambdaRate);
}

bool VRattleDynamics::projectPositions(vector<Vec3>& positions) {
    if (system.getNumConstraints() == 0)
        return false;
    areParametersChanging = false;
    factorScope = NoFactor;
    system.evaluateJacobian(positions, theta, jacobian);
    if (system.evaluate(positions, theta, residual, jacobian) <= settings.tolerance)
        return false;
    if (!projectByChord(positions) && !projectByNewton(positions)) {
        for (int i : movingParticles)
            acceleration[i] = qNext[i] - positions[i];
        system.evaluateJacobian(positions, theta, jacobian);
        throw StepFailure(explainNotConverged(
            positions, acceleration,
            "; set positions that are nearer to where the constraints hold, if there are such: constraints that "
            "contradict each other have none"));
    }
    positions = qNext;
    return true;
}

// Chord iterations for g(q + M^-1 G(q)^T x) = 0 with K(q), which is enough where q is nearly right.
bool VRattleDynamics::projectByChord(const vector<Vec3>& positions) {
    matrix.factorize(jacobian);
    qNext = positions;
    double previous = std::numeric_limits<double>::infinity();
    while (true) {
        lastError = system.evaluate(qNext, theta, residual, jacobian);
        const bool isSlow = !(lastError <= SLOW_CONVERGENCE * previous);
        if (lastError <= settings.tolerance * (isSlow ? 1.0 : ON_STEP_MARGIN))
            return true;
        if (isSlow)
            return false;
        previous = lastError;
        matrix.solve(residual);
        system.addTransposedOverMass(jacobian, residual, -1.0, qNext);
        numIterations++;
    }
}

// Damped Newton's iteration, each step of it along M^-1 G^T of where it has come to.
bool VRattleDynamics::projectByNewton(const vector<Vec3>& positions) {
    qNext = positions;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        system.evaluateJacobian(qNext, theta, jacobian);
        lastError = system.evaluate(qNext, theta, residual, jacobian);
        const bool isSlow = !(lastError <= SLOW_CONVERGENCE * previous);
        if (lastError <= settings.tolerance * (isSlow ? 1.0 : ON_STEP_MARGIN))
            return true;
        previous = lastError;
        if (!std::isfinite(lastError) ||
            matrix.tryToFactorize(jacobian, ConstraintSystem::ALL) != ConstraintMatrix::REGULAR)
            return false;
        correction = residual;
        matrix.solve(correction);
        const bool isFound = takeDampedUpdate(lastError, [&](double part) {
            wNext = qNext;
            system.addTransposedOverMass(jacobian, correction, -part, wNext);
            return system.evaluate(wNext, theta, residual, jacobian);
        });
        // Where the error is no more than the tolerance, rounding may keep it from becoming less.
        if (!isFound && lastError > settings.tolerance)
            return false;
        qNext.swap(wNext);
        numIterations++;
    }
    return false;
}

// ------------------------------------------------------------------------------------------ the equations of a step

// Where the iteration starts. Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes
// that O(h^3).
void VRattleDynamics::startMultipliers(bool withOffset, int first, int end) {
    for (int k = first; k < end; k++)
        lambdaNext[k] = withOffset ? lambda[k] + multiplierOffset[k] : lambda[k];
}

void VRattleDynamics::startMultipliers(bool withOffset) {
    startMultipliers(withOffset, 0, system.getNumConstraints());
}

void VRattleDynamics::keepOffsets() {
    densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    for (size_t k = 0; k < lambdaNext.size(); k++)
        multiplierOffset[k] = lambdaNext[k] - lambda[k];
}

StepArrays VRattleDynamics::stepArrays(const Trial& trial) {
    return {q.data(),          trial.start.data(), force.data(),           qNext.data(),          wNext.data(),
            lambdaNext.data(), correction.data(),  multiplierTrial.data(), rightSideTrial.data(), trial.kick,
            trial.drift};
}

// w+ = start + kick M^-1 (F - G^T lambda) (3.10), q+ = q + drift w+ (3.9); w+ is kept if it is asked for.
void VRattleDynamics::computeTrial(const Trial& trial, const int* firstParticle, const int* endParticle,
                                   const Part& part, bool withVelocities) {
    const vector<double>& inverseMasses = system.getInverseMasses();
    vector<Vec3>& acceleration = withVelocities ? wNext : qNext; // until these are known
    for (const int* i = firstParticle; i < endParticle; i++)
        acceleration[*i] = force[*i] * inverseMasses[*i];
    system.addTransposedOverMass(jacobian, lambdaNext, -1.0, acceleration, part);
    for (const int* i = firstParticle; i < endParticle; i++) {
        const Vec3 velocity = trial.start[*i] + acceleration[*i] * trial.kick;
        if (withVelocities)
            wNext[*i] = velocity;
        qNext[*i] = q[*i] + velocity * trial.drift;
    }
}

void VRattleDynamics::computeTrial(const Trial& trial) {
    computeTrial(trial, movingParticles.data(), movingParticles.data() + movingParticles.size(), ConstraintSystem::ALL,
                 true);
}

void VRattleDynamics::computeTrial(const Trial& trial, const Part& part, bool withVelocities) {
    const int* particles = system.getGeneralParticles().data();
    computeTrial(trial, particles + part.firstParticle, particles + part.endParticle, part, withVelocities);
}

void VRattleDynamics::moveFreeParticle(int i, const Trial& trial) {
    wNext[i] = trial.start[i] + force[i] * (trial.kick * system.getInverseMasses()[i]);
    qNext[i] = q[i] + wNext[i] * trial.drift;
}

// Solve g(q+) = 0 (3.11) for lambda, with given kick and drift, by chord iterations with A = -kick drift K(q).
bool VRattleDynamics::solvePositions(const Trial& trial, bool isFromOnStep) {
    const bool withOffset = !isFromOnStep;
    work.runOnJoints(
        [&](const CutCluster& cluster) { startMultipliers(withOffset, cluster.joints.first, cluster.joints.end); });
    if (system.getFirstGeneral() < system.getNumConstraints())
        ensureFactor(GeneralFactor);
    const StepArrays arrays = stepArrays(trial);
    const double tolerance = (isFromOnStep ? ON_STEP_MARGIN : REGULAR_MARGIN) * settings.tolerance;
    Result result =
        work.run([](int) {},
                 [&](const ClusterBatch& batch, int begin, int end, Result& share) {
                     startMultipliers(withOffset, batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
                     share.addError(batch.solvePositions(arrays, begin, end, tolerance, share.iterations));
                 },
                 [&](int i) { moveFreeParticle(i, trial); },
                 [&](const Part& part, Result& share) {
                     startMultipliers(withOffset, part.first, part.end);
                     share.addError(solveGeneral(part, trial, tolerance, share.iterations));
                 },
                 [&](const Part& piece, Result& share) {
                     startMultipliers(withOffset, piece.first, piece.end);
                     share.addPieceError(evaluatePiece(piece, trial, tolerance, true));
                 });
    if (!system.getPieces().empty())
        result.addError(solvePieces(trial, result.pieceError, tolerance, result.iterations));
    lastError = result.error;
    numIterations += result.iterations;
    return lastError <= settings.tolerance || solvePositionsByNewton(trial);
}

// Whether an iteration is to end: when there has been at least one update, since Lambda itself, unrefined, costs accuracy even where
// it meets the tolerance, and the error is small enough, or no longer reduced, so that it is rounding, or Newton's to deal with.
bool VRattleDynamics::isLastIteration(int iteration, double error, double previous, double tolerance) {
    return iteration > 0 && (error <= tolerance || !(error < 0.5 * previous) || iteration == MAX_CHORD_ITERATIONS);
}

// The same for clusters that are in no batch and not cut; returns the largest |g| left.
double VRattleDynamics::solveGeneral(const Part& part, const Trial& trial, double tolerance, int& iterations) {
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0;; iteration++) {
        computeTrial(trial, part, iteration > 0); // there is at least one update
        const double error = system.evaluate(qNext, thetaNext, correction, jacobian, part);
        if (isLastIteration(iteration, error, previous, tolerance)) {
            iterations = std::max(iterations, iteration);
            return error;
        }
        previous = error;
        matrix.solve(correction, part);
        updateMultipliers(trial, part.first, part.end);
    }
}

void VRattleDynamics::updateMultipliers(const Trial& trial, int first, int end) {
    for (int k = first; k < end; k++)
        lambdaNext[k] += correction[k] / (trial.kick * trial.drift);
}

// Evaluate a piece for the present multipliers, and begin to solve for their next correction if there will be one for certain;
// returns the largest |g|.
double VRattleDynamics::evaluatePiece(const Part& piece, const Trial& trial, double tolerance, bool isFirst) {
    computeTrial(trial, piece, !isFirst);
    const double error = system.evaluate(qNext, thetaNext, correction, jacobian, piece);
    isPieceEliminated[piece.piece] = isFirst || error > tolerance;
    if (isPieceEliminated[piece.piece])
        matrix.eliminate(correction, piece);
    return error;
}

// The iteration for cut clusters, after evaluatePiece() for all pieces, which found the error.
double VRattleDynamics::solvePieces(const Trial& trial, double error, double tolerance, int& iterations) {
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0;; iteration++) {
        work.runOnJoints([&](const CutCluster& cluster) {
            error = SharedWork::larger(error, system.evaluate(qNext, thetaNext, correction, jacobian, cluster.joints));
        });
        if (isLastIteration(iteration, error, previous, tolerance)) {
            iterations = std::max(iterations, iteration);
            return error;
        }
        previous = error;
        if (std::count(isPieceEliminated.begin(), isPieceEliminated.end(), false) > 0)
            work.runOnPieces([&](const Part& piece, Result&) {
                if (!isPieceEliminated[piece.piece])
                    matrix.eliminate(correction, piece);
            });
        work.runOnJoints([&](const CutCluster& cluster) {
            matrix.solveJoints(correction, cluster);
            updateMultipliers(trial, cluster.joints.first, cluster.joints.end);
        });
        error = work.runOnPieces([&](const Part& piece, Result& share) {
                        matrix.substitute(correction, piece);
                        updateMultipliers(trial, piece.first, piece.end);
                        share.addError(evaluatePiece(piece, trial, tolerance, false));
                    })
                    .error;
    }
}

// The same for all constraints with Newton's iteration: G(q+) M^-1 G(q)^T in place of K. Where the chord iteration fails.
bool VRattleDynamics::solvePositionsByNewton(const Trial& trial) {
    ensureFactor(FullFactor);
    // From where the chord iteration has come to, and if that was too far off, from Lambda.
    if (iterateNewton(trial))
        return true;
    startMultipliers(false);
    return iterateNewton(trial);
}

bool VRattleDynamics::iterateNewton(const Trial& trial) {
    auto moveTo = [&](double part) {
        for (size_t k = 0; k < lambdaNext.size(); k++)
            lambdaNext[k] = response[k] + part * correction[k] / (trial.kick * trial.drift);
        computeTrial(trial);
        return system.evaluate(qNext, thetaNext, residual, jacobian);
    };
    computeTrial(trial);
    lastError = system.evaluate(qNext, thetaNext, residual, jacobian);
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS && std::isfinite(lastError); iteration++) {
        const bool isSlow = lastError > SLOW_CONVERGENCE * previous;
        if (iteration > 0 && lastError <= settings.tolerance * (isSlow ? 1.0 : REGULAR_MARGIN))
            return true;
        previous = lastError;
        correction = residual;
        response = lambdaNext; // where the update starts
        system.evaluateJacobian(qNext, thetaNext, jacobianNext);
        if (!newtonMatrix.factorize(jacobianNext, jacobian))
            return false;
        newtonMatrix.solve(correction);
        if (lastError <= settings.tolerance)
            lastError = moveTo(1); // rounding may keep the error from becoming less
        else if (!takeDampedUpdate(lastError, [&](double part) { return lastError = moveTo(part); }))
            return false;
        numIterations++;
    }
    return false;
}

/*
 * Solve (3.11) and (3.14) for lambda and rho+ together. In each pass lambda gets its chord update and rho+ that of
 * Newton's iteration on F = rho+ + rho - u(q,p+) - u(q,p-), whose derivative is 1 + (h/(2 rho+^2)) du/dp (F - G^T Lambda)
 * along the constraints; what either update does to the other's equation is of higher order in h and left to the next pass.
 */
VRattleDynamics::SolveResult VRattleDynamics::solveCoupled() {
    const double h = settings.stepSize;
    findHalfStepValue();
    if (system.getFirstGeneral() < system.getNumConstraints())
        ensureFactor(GeneralFactor);
    rhoNext = densityScale * StepDensity::sumUpdate(u, rho) + densityOffset;
    if (!(rhoNext > 0))
        return TooSlow;
    startMultipliers(true);
    std::fill(correction.begin(), correction.end(), 0.0);
    double previous = std::numeric_limits<double>::infinity();
    const double densityTolerance = std::max(REGULAR_MARGIN * settings.tolerance, DENSITY_ROUNDING);
    for (int pass = 0; pass <= MAX_CHORD_ITERATIONS; pass++) {
        const Trial trial = {w, 0.5 * h * (1 / rho + 1 / rhoNext), h / rhoNext};
        setRates(thetaHalf, trial.drift);
        const StepArrays arrays = stepArrays(trial);
        work.runOnJoints([&](const CutCluster& cluster) { // before the pieces, whose particles the joints pull at
            for (int k = cluster.joints.first; k < cluster.joints.end; k++)
                lambdaNext[k] += correction[k];
        });
        const Result result =
            work.run([](int) {},
                     [&](const ClusterBatch& batch, int begin, int end, Result& share) {
                         share.addError(batch.coupledPass(arrays, begin, end));
                     },
                     [&](int i) { moveFreeParticle(i, trial); },
                     [&](const Part& part, Result& share) { share.addError(coupledPassGeneral(part, trial)); },
                     [&](const Part& piece, Result& share) { share.addError(beginCoupledPass(piece, trial)); });
        lastError = SharedWork::larger(result.error, finishCoupledPassOfPieces(trial));
        monitor.evaluate(wNext, multiplierTrial, rightSideTrial, valuesTrial);
        const double mismatch = rhoNext - combineAndLimit(valuesTrial) + densityScale * (rho - halfStepValue);
        const double error = std::max(lastError / (REGULAR_MARGIN * settings.tolerance),
                                      std::fabs(mismatch) / ((rhoNext + rho) * densityTolerance));
        if (pass > 0 && error <= 1)
            return Converged;
        if (!std::isfinite(error) || error > SLOW_COUPLED_CONVERGENCE * previous)
            return TooSlow;
        previous = error;
        rhoNext -= mismatch / (1 + 0.5 * h * rate / (rhoNext * rhoNext));
        if (!(rhoNext > 0))
            return TooSlow;
        numIterations++;
    }
    return TooSlow;
}

// One pass of the coupled iteration for clusters that are in no batch and not cut; see ClusterBatch::coupledPass().
double VRattleDynamics::coupledPassGeneral(const Part& part, const Trial& trial) {
    const double error = beginCoupledPass(part, trial);
    matrix.substitute(multiplierTrial, part);
    matrix.substitute(correction, part);
    return error;
}

// Its first half: evaluate a part for corrected multipliers, and begin to solve for Lambda there and for their next correction.
double VRattleDynamics::beginCoupledPass(const Part& part, const Trial& trial) {
    for (int k = part.first; k < part.end; k++)
        lambdaNext[k] += correction[k];
    computeTrial(trial, part, true);
    const double error = formCoupledEquations(part, trial);
    matrix.eliminate(multiplierTrial, part, 0);
    matrix.eliminate(correction, part, 1);
    return error;
}

double VRattleDynamics::formCoupledEquations(const Part& part, const Trial& trial) {
    const double error = system.evaluate(qNext, thetaNext, correction, jacobian, part);
    system.evaluateCurvature(q, wNext, thetaHalf, rightSideTrial, part);
    for (int k = part.first; k < part.end; k++) {
        multiplierTrial[k] = rightSideTrial[k] += appliedTerm[k];
        correction[k] /= trial.kick * trial.drift;
    }
    return error;
}

// The rest for cut clusters, after beginCoupledPass() for all pieces; returns the largest |g| of the joints.
double VRattleDynamics::finishCoupledPassOfPieces(const Trial& trial) {
    double error = 0;
    work.runOnJoints([&](const CutCluster& cluster) {
        error = SharedWork::larger(error, formCoupledEquations(cluster.joints, trial));
        matrix.solveJoints(multiplierTrial, cluster, 0);
        matrix.solveJoints(correction, cluster, 1);
    });
    work.runOnPieces([&](const Part& piece, Result&) {
        matrix.substitute(multiplierTrial, piece);
        matrix.substitute(correction, piece);
    });
    return error;
}

// Newton's iteration on (lambda, rho+) for (3.11) and (3.14) by the Schur complement (docs/method.md, section 8), for
// all constraints. Where the coupled chord iteration fails.
VRattleDynamics::SolveResult VRattleDynamics::solveCoupledByNewton() {
    ensureFactor(FullFactor);
    const double h = settings.stepSize;
    const double uMinus = densityScale * findHalfStepValue();
    startMultipliers(true);
    rhoNext = densityScale * StepDensity::sumUpdate(u, rho);
    if (!(rhoNext > 0))
        rhoNext = density.boundedUpdate(densityScale * u, densityScale * rho);
    int numCuts = 0;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        const double kick = 0.5 * h * (1 / rho + 1 / rhoNext), drift = h / rhoNext;
        computeTrial({w, kick, drift});
        setRates(thetaHalf, drift);
        lastError = system.evaluate(qNext, thetaNext, residual, jacobian);
        const double uPlus = evaluateU(wNext, thetaHalf);
        // F_rho of docs/method.md, section 8
        const double mismatch = rhoNext - uPlus + densityScale * rho - uMinus;
        const double relativeMismatch = std::fabs(mismatch) / (rhoNext + rho);
        const double error =
            std::max(lastError / (REGULAR_MARGIN * settings.tolerance),
                     relativeMismatch / std::max(REGULAR_MARGIN * settings.tolerance, DENSITY_ROUNDING));
        if (!std::isfinite(error))
            return NotConverged;
        const bool isSlow = error > SLOW_CONVERGENCE * previous;
        const bool isGoodEnough = lastError <= settings.tolerance && relativeMismatch <= STRAINED_DENSITY_ROUNDING;
        if (iteration > 0 && (error <= 1 || (isSlow && isGoodEnough)))
            return Converged;
        previous = error;
        system.evaluateJacobian(qNext, thetaNext, jacobianNext);
        if (!newtonMatrix.factorize(jacobianNext, jacobian))
            return NotConverged;
        // a = dF/dlambda, d = dF/drho+, and response = x2 = A^-1 dg/drho+
        monitor.evaluateGradient(q, thetaHalf, wNext, multiplierTrial, valuesTrial, matrix, gradient);
        const double derivative = density.limitDerivative(monitor.combine(valuesTrial));
        system.multiplyOverMass(jacobian, gradient, coupling);
        for (double& a : coupling)
            a *= kick * derivative;
        double d = 1;
        const double kickChange = -0.5 * h / (rhoNext * rhoNext); // d(kick)/d(rho+)
        for (int i : movingParticles) {
            const Vec3 kickPart = (wNext[i] - w[i]) * (kickChange / kick); // of dw+/drho+
            d -= derivative * gradient[i].dot(kickPart);
            halfStepChange[i] = kickPart * drift - wNext[i] * (drift / rhoNext);
        }
        system.multiply(jacobianNext, halfStepChange, response);
        newtonMatrix.solve(response);
        for (double& x : response)
            x /= -kick * drift;
        correction = residual; // x1 = -A^-1 g
        newtonMatrix.solve(correction);
        for (double& x : correction)
            x /= kick * drift;
        double change = (-mismatch - dot(coupling, correction)) / (d - dot(coupling, response));
        if (!std::isfinite(change))
            return NotConverged;
        if (!(rhoNext + change > 0)) {
            if (++numCuts > 8)
                return NotPositive;
            change = -0.75 * rhoNext;
        }
        rhoNext += change;
        for (size_t k = 0; k < lambdaNext.size(); k++)
            lambdaNext[k] += correction[k] - response[k] * change;
        numIterations++;
    }
    return NotConverged;
}

// Solve for rho+, lambda, w+ and q+ of a regular step; returns its size.
double VRattleDynamics::solveRegular() {
    const double h = settings.stepSize;
    auto trialWith = [&](double next) -> Trial {
        rhoNext = next;
        return {w, 0.5 * (h / rho + h / rhoNext), h / rhoNext};
    };
    auto solveWith = [&](double next) { return solvePositions(trialWith(next), false); };
    const bool isFixed = settings.isFixedStep || monitor.isEmpty();
    const double bounded = density.boundedUpdate(densityScale * u, densityScale * rho);
    bool isSolved;
    if (isFixed)
        isSolved = solveWith(settings.isAutomatic && !settings.isFixedStep ? automatic.getNext() : 1);
    else if (settings.update == StepDensity::Bounded)
        isSolved = solveWith(bounded);
    else if (needsHalfStepValue())
        isSolved = solveCoupled() == Converged || solveCoupledByNewton() == Converged;
    else {
        const double next = densityScale * StepDensity::sumUpdate(u, rho);
        isSolved = next > 0 && solveWith(next);
    }
    if (isFixed || settings.update == StepDensity::Bounded) {
        if (!isSolved)
            throwNotConverged(trialWith(rhoNext));
    }
    else if (!isSolved || density.isFarBelowBound(rhoNext)) {
        // A rescue: the sum gave no step, or one far above the maximum.
        if (!solveWith(bounded))
            throwNotConverged(trialWith(rhoNext));
        numRescues++;
        isRescued = true;
    }
    return h / rhoNext;
}

void VRattleDynamics::throwNotConverged(const Trial& trial) {
    for (int i : movingParticles)
        acceleration[i] = trial.start[i] * trial.drift;
    std::stringstream reason;
    reason << explainNotConverged(q, acceleration, "");
    if (areParametersChanging)
        reason << "; parameters of constraints have been changed for this step, so move them by less at a time";
    if (hasDensity && settings.isAutomatic)
        reason << "; the step tried was of " << settings.stepSize / rhoNext << " ps";
    else if (hasDensity && !monitor.isEmpty())
        reason << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
               << settings.stepSize / rhoNext << " ps";
    throw StepFailure(reason.str());
}

// The way out is for what has no explanation of its own.
std::string VRattleDynamics::explainNotConverged(const vector<Vec3>& from, const vector<Vec3>& displacement,
                                                 const std::string& wayOut) {
    std::stringstream reason;
    // What keeps an iteration from converging need not be what has the largest error in the end.
    const int worst = system.findLargest(residual, jacobian);
    const int singular = system.findSingular(from, theta, displacement, jacobian, velocityJacobian);
    const std::string unresolved = system.explainResolution(worst, from, settings.tolerance);
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
        reason << system.describe(worst) << " became " << residual[worst];
    else
        reason << "the constraints could not be solved for (the iteration diverged)" << wayOut;
    return reason.str();
}
