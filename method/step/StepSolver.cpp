// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/StepSolver.h"
#include <algorithm>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

const int MAX_COUPLED_PASSES = 12, MAX_NEWTON_ITERATIONS = 50, MAX_CUTS = 8;
// If an iteration leaves more than this fraction of the error, something else is tried, or it is rounding.
const double SLOW_CONVERGENCE = 0.25, SLOW_COUPLED_CONVERGENCE = 0.5;
// The iteration of a regular step goes on to this fraction of the tolerance, that of a step from the on-step state, whose
// starting value is worse by a power of h, to this. What is left is not the same forwards and backwards, and so limits
// how closely a run can be retraced; where rounding does not allow the fraction, the tolerance itself counts.
const double REGULAR_MARGIN = 0.1, ON_STEP_MARGIN = 1e-4;
// The density equation (3.14) is solved to the tolerance of the constraints, but not closer than rounding of U allows; and
// where strained, badly scaled constraints make that rounding larger, the second number counts.
const double DENSITY_ROUNDING = 1e-12, STRAINED_DENSITY_ROUNDING = 1e-8;

double dot(const vector<double>& a, const vector<double>& b) {
    double sum = 0;
    for (size_t i = 0; i < a.size(); i++)
        sum += a[i] * b[i];
    return sum;
}

} // namespace

StepSolver::StepSolver(ConstraintSolver& constraints, const StepState& now) :
        constraints(constraints), now(now), h(0), tolerance(0), isMoving(false), isFromOnStep(false), lastDrift(0),
        offsetObserver(*this), numNewtonIterations(0) {
    const ConstraintSystem& system = constraints.getSystem();
    for (vector<Vec3>* vectors : {&next.q, &next.w, &next.v, &gradient, &halfStepChange})
        vectors->resize(system.getNumParticles());
    for (vector<double>* numbers : {&multiplierOffset, &offsetNext, &next.lambda, &next.rightSide, &lambdaNext,
                                    &multiplierTrial, &rightSideTrial, &correction, &coupling, &response})
        numbers->resize(system.getNumConstraints());
    next.theta = thetaHalf = system.getGivenParameters();
    parameterChange.resize(next.theta.values.size());
}

void StepSolver::setSettings(double stepSize, double newTolerance) {
    h = stepSize;
    tolerance = newTolerance;
    constraints.setTolerance(tolerance);
}

void StepSolver::prepare(const vector<double>& target) {
    isMoving = target != now.theta.values;
    next.theta.values = target;
    thetaHalf.values = now.theta.values;
    if (isMoving)
        constraints.getSystem().findParameterChange(now.q, now.theta, target, parameterChange);
    else
        std::fill(parameterChange.begin(), parameterChange.end(), 0.0);
}

void StepSolver::setRates(ExpressionParameters& theta, double size) const {
    theta.isMoving = isMoving;
    for (size_t k = 0; k < parameterChange.size(); k++)
        theta.rates[k] = parameterChange[k] / size;
}

const ExpressionParameters& StepSolver::parametersAtRateOf(double size) {
    setRates(thetaHalf, size);
    return thetaHalf;
}

ConstraintSolver::Trial StepSolver::trialTo(double kick, double drift, const vector<Vec3>& start) {
    lastDrift = drift;
    isFromOnStep = &start == &now.v;
    return {start, kick, drift, next.theta, next.q, next.w, lambdaNext};
}

// Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes that O(h^3).
ConstraintSolver::Guess StepSolver::regularGuess() const {
    return {now.lambda, &multiplierOffset, REGULAR_MARGIN};
}

bool StepSolver::solve(double rho, double rhoNext) {
    return constraints.solvePositions(trialTo(0.5 * (h / rho + h / rhoNext), h / rhoNext, now.w), regularGuess());
}

bool StepSolver::solveFromOnStep(double size) {
    return constraints.solvePositions(trialTo(0.5 * size, size, now.v), {now.lambda, nullptr, ON_STEP_MARGIN});
}

bool StepSolver::solveBackwards(double size, StepState& back) {
    back.theta = next.theta;
    setRates(back.theta, size);
    for (size_t k = 0; k < parameterChange.size(); k++)
        back.theta.values[k] = now.theta.values[k] - parameterChange[k];
    return constraints.solvePositions({now.v, -0.5 * size, -size, back.theta, back.q, back.w, lambdaNext},
                                      {now.lambda, nullptr, ON_STEP_MARGIN});
}

std::string StepSolver::explainFailure() {
    const vector<Vec3>& start = isFromOnStep ? now.v : now.w;
    std::string reason = constraints.explainFailure(trialTo(0.0, lastDrift, start));
    if (isMoving)
        reason += "; parameters of constraints have been changed for this step, so move them by less at a time";
    return reason;
}

void StepSolver::stay() {
    next.q = now.q;
    next.w = now.w;
    next.theta = now.theta;
    lambdaNext = now.lambda;
}

void StepSolver::keepOffset() {
    for (size_t k = 0; k < lambdaNext.size(); k++)
        multiplierOffset[k] = lambdaNext[k] - now.lambda[k];
}

ConstraintSolver::Observer* StepSolver::observeOffset(ConstraintSolver::Observer* observer) {
    offsetObserver.other = observer;
    return &offsetObserver;
}

void StepSolver::OffsetObserver::seeParticles(int block) {
    other->seeParticles(block);
}

void StepSolver::OffsetObserver::seeConstraints(int range, int first, int end) {
    const double *found = solver.lambdaNext.data(), *lambda = solver.now.lambda.data();
    double* offset = solver.offsetNext.data();
    for (int k = first; k < end; k++)
        offset[k] = found[k] - lambda[k];
    other->seeConstraints(range, first, end);
}

bool StepSolver::solve(DensityEquation& equation, const DensityEquation::Given& given, double& rhoNext) {
    return solveByChord(equation, given, rhoNext) || solveByNewton(equation, given, rhoNext);
}

/*
 * In each pass lambda gets its chord update and rho+ that of Newton's iteration on F = rho+ + rho - u(q,p+) - u(q,p-), whose
 * derivative is 1 + (h/(2 rho+^2)) du/dp (F - G^T Lambda) along the constraints; what either update does to the other's equation is
 * of higher order in h and left to the next pass.
 */
bool StepSolver::solveByChord(DensityEquation& equation, const DensityEquation::Given& given, double& rhoNext) {
    const double rho = given.rho;
    rhoNext = given.explicitValue + given.offset;
    if (!(rhoNext > 0))
        return false;
    double previous = std::numeric_limits<double>::infinity();
    const double densityTolerance = std::max(REGULAR_MARGIN * tolerance, DENSITY_ROUNDING);
    for (int pass = 0; pass <= MAX_COUPLED_PASSES; pass++) {
        const ConstraintSolver::Trial trial = trialTo(0.5 * h * (1 / rho + 1 / rhoNext), h / rhoNext, now.w);
        const ConstraintSolver::Guess start = regularGuess();
        const double constraintError = constraints.coupledPass(
            trial, {parametersAtRateOf(trial.drift), multiplierTrial, rightSideTrial}, pass == 0 ? &start : nullptr,
            equation.observeTrial(multiplierTrial, rightSideTrial));
        const double uPlus = equation.evaluate(next.w, multiplierTrial);
        const double mismatch = rhoNext - uPlus + given.known;
        const double error = std::max(constraintError / (REGULAR_MARGIN * tolerance),
                                      std::fabs(mismatch) / ((rhoNext + rho) * densityTolerance));
        if (pass > 0 && error <= 1)
            return true;
        if (!std::isfinite(error) || error > SLOW_COUPLED_CONVERGENCE * previous)
            return false;
        previous = error;
        rhoNext -= mismatch / (1 + 0.5 * h * given.rate / (rhoNext * rhoNext));
        if (!(rhoNext > 0))
            return false;
    }
    return false;
}

// Newton's iteration on (lambda, rho+) by the Schur complement (docs/method.md, section 8), for all constraints.
bool StepSolver::solveByNewton(DensityEquation& equation, const DensityEquation::Given& given, double& rhoNext) {
    const double rho = given.rho;
    rhoNext = given.explicitValue > 0 ? given.explicitValue : given.fallBack;
    int numCuts = 0;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        const double kick = 0.5 * h * (1 / rho + 1 / rhoNext), drift = h / rhoNext;
        const ConstraintSolver::Trial trial = trialTo(kick, drift, now.w);
        if (iteration == 0)
            constraints.guess(trial, regularGuess());
        const double constraintError = constraints.evaluate(trial);
        constraints.findMultipliers(next.w, parametersAtRateOf(drift), multiplierTrial, rightSideTrial);
        ConstraintSolver::Observer* observer = equation.observeTrial(multiplierTrial, rightSideTrial);
        constraints.forRanges([&](int range, int first, int end) { observer->seeConstraints(range, first, end); });
        const double uPlus = equation.evaluate(next.w, multiplierTrial);
        // F_rho of docs/method.md, section 8
        const double mismatch = rhoNext - uPlus + given.known;
        const double relativeMismatch = std::fabs(mismatch) / (rhoNext + rho);
        const double error = std::max(constraintError / (REGULAR_MARGIN * tolerance),
                                      relativeMismatch / std::max(REGULAR_MARGIN * tolerance, DENSITY_ROUNDING));
        if (!std::isfinite(error))
            return false;
        const bool isSlow = error > SLOW_CONVERGENCE * previous;
        const bool isGoodEnough = constraintError <= tolerance && relativeMismatch <= STRAINED_DENSITY_ROUNDING;
        if (iteration > 0 && (error <= 1 || (isSlow && isGoodEnough)))
            return true;
        previous = error;
        if (!constraints.linearize(trial))
            return false;
        // a = dF/dlambda, d = dF/drho+, and response = x2 = A^-1 dg/drho+
        equation.findGradient(next.w, thetaHalf, multiplierTrial, gradient);
        constraints.multiplyOverMass(gradient, coupling);
        for (double& a : coupling)
            a *= kick;
        double d = 1;
        const double kickChange = -0.5 * h / (rhoNext * rhoNext); // d(kick)/d(rho+)
        for (int i : constraints.getMovingParticles()) {
            const Vec3 kickPart = (next.w[i] - now.w[i]) * (kickChange / kick); // of dw+/drho+
            d -= gradient[i].dot(kickPart);
            halfStepChange[i] = kickPart * drift - next.w[i] * (drift / rhoNext);
        }
        constraints.findResponse(trial, halfStepChange, response);
        constraints.findUpdate(trial, correction); // x1 = -A^-1 g
        double change = (-mismatch - dot(coupling, correction)) / (d - dot(coupling, response));
        if (!std::isfinite(change))
            return false;
        // Within a factor of 4 at a time: far away (3.14) has solutions of no meaning.
        if (!(rhoNext + change > 0) || change > 3 * rhoNext) {
            if (++numCuts > MAX_CUTS)
                return false;
            change = change > 0 ? 3 * rhoNext : -0.75 * rhoNext;
        }
        rhoNext += change;
        for (size_t k = 0; k < lambdaNext.size(); k++)
            lambdaNext[k] += correction[k] - response[k] * change;
        numNewtonIterations++;
    }
    return false;
}
