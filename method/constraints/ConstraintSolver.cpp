// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ConstraintSolver.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Differences of the velocities of particles that are the same but for the rounding of both.
const double FRAME_ROUNDING = 4 * std::numeric_limits<double>::epsilon();

const int MAX_NEWTON_ITERATIONS = 50;
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

/** How an iteration gets on, which aims at a fraction of the tolerance. */
struct Progress {
    double previous = std::numeric_limits<double>::infinity();
    bool isSlow = false;
    /** Whether the error that is left now is small enough. */
    bool isEnough(double error, double tolerance, double margin) {
        isSlow = !(error <= SLOW_CONVERGENCE * previous);
        previous = error;
        return error <= tolerance * (isSlow ? 1.0 : margin);
    }
};

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

// ------------------------------------------------------------------------------------------------- Newton's iteration

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
    evaluate(trial);
    Progress progress;
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS && std::isfinite(lastError); iteration++) {
        const bool isEnough = progress.isEnough(lastError, tolerance, NEWTON_MARGIN);
        if (iteration > 0 && isEnough) // there is at least one update
            return true;
        if (!linearize(trial))
            return false;
        findUpdate(trial, correction);
        before = trial.multipliers;
        auto moveBy = [&](double part) {
            for (size_t k = 0; k < before.size(); k++)
                trial.multipliers[k] = before[k] + part * correction[k];
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
    solveLinearized(x, trial.kick * trial.drift);
}

void ConstraintSolver::solveLinearized(vector<double>& x, double scale) const {
    newtonMatrix.solve(x);
    for (double& each : x)
        each /= scale;
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
    Progress progress;
    while (true) {
        lastError = system.evaluate(positions, parameters, residual, jacobian);
        if (progress.isEnough(lastError, tolerance, PROJECTION_MARGIN))
            return true;
        if (progress.isSlow)
            return false;
        matrix.solve(residual);
        system.addTransposedOverMass(jacobian, residual, -1.0, positions);
        numIterations++;
    }
}

// Damped Newton's iteration, each step of it along M^-1 G^T of where it has come to.
bool ConstraintSolver::projectByNewton(const ExpressionParameters& parameters, Vectors& positions) {
    Vectors next;
    Progress progress;
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        system.evaluateJacobian(positions, parameters, jacobian);
        lastError = system.evaluate(positions, parameters, residual, jacobian);
        if (progress.isEnough(lastError, tolerance, PROJECTION_MARGIN))
            return true;
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
