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
// Where parameters move: slopes of (3.14) that are believed, and how much of the density they must be seen over.
const double SMALLEST_SLOPE = 0.1, LARGEST_SLOPE = 10, SLOPE_ROUNDING = 1e-11;

double dot(const vector<double>& a, const vector<double>& b) {
    double sum = 0;
    for (size_t i = 0; i < a.size(); i++)
        sum += a[i] * b[i];
    return sum;
}

} // namespace

StepSolver::StepSolver(ConstraintSolver& constraints, const StepState& now) :
        motion(constraints.getSystem()), jump(-1), next(constraints.getSystem()), kind(First), size(0),
        constraints(constraints), now(now), h(0), tolerance(0), isFromOnStep(false), lastDrift(0),
        correction(next.lambda), coupling(next.lambda), response(next.lambda), gradient(next.q), halfStepChange(next.q),
        numNewtonIterations(0) {
}

void StepSolver::setSettings(double stepSize, double newTolerance) {
    h = stepSize;
    tolerance = newTolerance;
    constraints.setTolerance(tolerance);
}

void StepSolver::prepare() {
    motion.prepare(now.q, now.theta);
    next.theta.values = motion.target;
    jump = -1;
}

void StepSolver::findJump(double rho) {
    jump = motion.findJump(constraints, now.v, now.theta, h / rho, next.v);
}

ConstraintSolver::Trial StepSolver::trialTo(double kick, double drift, const vector<Vec3>& start) {
    lastDrift = drift;
    isFromOnStep = &start == &now.v;
    return {start, kick, drift, next.theta, next.q, next.w, next.offset.found};
}

// Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes that O(h^3).
ConstraintSolver::Guess StepSolver::regularGuess() const {
    return {now.lambda, &now.offset, REGULAR_MARGIN};
}

bool StepSolver::solve(double rho, double rhoNext) {
    return constraints.solvePositions(trialTo(0.5 * (h / rho + h / rhoNext), h / rhoNext, now.w), regularGuess());
}

bool StepSolver::solveFromOnStep(double stepSize) {
    return constraints.solvePositions(trialTo(0.5 * stepSize, stepSize, now.v), {now.lambda, nullptr, ON_STEP_MARGIN});
}

bool StepSolver::solveBackwards(double stepSize, StepState& back) {
    motion.goBack(stepSize, back.theta);
    return constraints.solvePositions(
        {now.v, -0.5 * stepSize, -stepSize, back.theta, back.q, back.w, back.offset.found},
        {now.lambda, nullptr, ON_STEP_MARGIN});
}

std::string StepSolver::explainFailure() {
    const vector<Vec3>& start = isFromOnStep ? now.v : now.w;
    std::string reason = constraints.explainFailure(trialTo(0.0, lastDrift, start));
    if (motion.isMoving())
        reason += "; parameters of constraints have been changed for this step, so move them by less at a time";
    return reason;
}

// The state at its end takes the place of the one before.
void StepSolver::accept(StepState& last) {
    if (kind == Regular)
        next.offset.expected.swap(last.lambda);
    else
        std::swap(next.offset, last.offset);
    std::swap(next, last);
}

bool StepSolver::solve(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext) {
    return solveByChord(monitor, equation, rhoNext) || solveByNewton(monitor, equation, rhoNext);
}

/*
 * In each pass lambda gets its chord update and rho+ that of Newton's iteration on F = rho+ + rho - u(q,p+) - u(q,p-), whose
 * derivative is 1 + (h/(2 rho+^2)) du/dp (F - G^T Lambda) along the constraints; what either update does to the other's equation is
 * of higher order in h and left to the next pass. Where parameters move, their rates are those of a step of rho+, which u may depend on as
 * much as on anything; then the derivative is that between two passes, once lambda is known well enough.
 */
bool StepSolver::solveByChord(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext) {
    const double rho = equation.rho;
    rhoNext = equation.explicitValue + equation.offset;
    if (!(rhoNext > 0))
        return false;
    double previous = std::numeric_limits<double>::infinity(), lastDensity = 0, lastMismatch = 0;
    const double densityTolerance = std::max(REGULAR_MARGIN * tolerance, DENSITY_ROUNDING);
    for (int pass = 0; pass <= MAX_COUPLED_PASSES; pass++) {
        const ConstraintSolver::Trial trial = trialTo(0.5 * h * (1 / rho + 1 / rhoNext), h / rhoNext, now.w);
        const ConstraintSolver::Guess start = regularGuess();
        const double constraintError = constraints.coupledPass(trial, monitor.observeTrial(motion.atStart(trial.drift)),
                                                               pass == 0 ? &start : nullptr, &monitor);
        const double mismatch = rhoNext - monitor.combine(monitor.evaluateTrial(now, next.w)) + equation.known;
        const double error = std::max(constraintError / (REGULAR_MARGIN * tolerance),
                                      std::fabs(mismatch) / ((rhoNext + rho) * densityTolerance));
        if (pass > 0 && error <= 1)
            return true;
        if (!std::isfinite(error) || error > SLOW_COUPLED_CONVERGENCE * previous)
            return false;
        previous = error;
        double slope = 1 + 0.5 * h * equation.rate / (rhoNext * rhoNext);
        const double last = rhoNext;
        if (motion.isMoving() && pass > 1 && std::fabs(rhoNext - lastDensity) > SLOPE_ROUNDING * rhoNext) {
            const double secant = (mismatch - lastMismatch) / (rhoNext - lastDensity);
            if (secant > SMALLEST_SLOPE && secant < LARGEST_SLOPE)
                slope = secant;
        }
        rhoNext -= mismatch / slope;
        lastDensity = last;
        lastMismatch = mismatch;
        if (!(rhoNext > 0))
            return false;
    }
    return false;
}

// Newton's iteration on (lambda, rho+) by the Schur complement (docs/method.md, section 8), for all constraints.
bool StepSolver::solveByNewton(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext) {
    const double rho = equation.rho;
    rhoNext = equation.explicitValue > 0 ? equation.explicitValue : equation.fallBack;
    int numCuts = 0;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        const double kick = 0.5 * h * (1 / rho + 1 / rhoNext), drift = h / rhoNext;
        const ConstraintSolver::Trial trial = trialTo(kick, drift, now.w);
        if (iteration == 0)
            constraints.guess(trial, regularGuess());
        const double constraintError = constraints.evaluate(trial);
        const ExpressionParameters& theta = motion.atStart(drift);
        // F_rho of docs/method.md, section 8
        const double mismatch = rhoNext - monitor.combine(monitor.evaluateAt(now, next.w, theta)) + equation.known;
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
        const double changeWithRates = monitor.evaluateGradient(now, next.w, theta, gradient);
        constraints.multiplyOverMass(gradient, coupling);
        for (double& a : coupling)
            a *= kick;
        double d = 1 - changeWithRates / rhoNext; // the rates are those of a step of this density
        const double kickChange = -0.5 * h / (rhoNext * rhoNext); // d(kick)/d(rho+)
        for (int i : constraints.getMovingParticles()) {
            const Vec3 kickPart = (next.w[i] - now.w[i]) * (kickChange / kick); // of dw+/drho+
            d -= gradient[i].dot(kickPart);
            halfStepChange[i] = kickPart * drift - next.w[i] * (drift / rhoNext);
        }
        constraints.findResponse(trial, halfStepChange, response);
        constraints.findUpdate(trial, correction); // x1 = -A^-1 g
        double slope = d - dot(coupling, response);
        // Where rates grow with the density u can do so faster than the density. Then the mismatch says where to go, as on GPUs.
        if (theta.isMoving && !(slope > SMALLEST_SLOPE))
            slope = 1;
        double change = (-mismatch - dot(coupling, correction)) / slope;
        if (!std::isfinite(change))
            return false;
        // Within a factor of 4 at a time: far away (3.14) has solutions of no meaning.
        if (!(rhoNext + change > 0) || change > 3 * rhoNext) {
            if (++numCuts > MAX_CUTS)
                return false;
            change = change > 0 ? 3 * rhoNext : -0.75 * rhoNext;
        }
        rhoNext += change;
        for (size_t k = 0; k < correction.size(); k++)
            trial.multipliers[k] += correction[k] - response[k] * change;
        numNewtonIterations++;
    }
    return false;
}
