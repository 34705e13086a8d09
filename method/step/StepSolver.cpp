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

const int MAX_COUPLED_PASSES = 12, MAX_SEARCH_TRIALS = 20;
// If an iteration leaves more than this fraction of the error, something else is tried, or it is rounding.
const double SLOW_CONVERGENCE = 0.25, SLOW_COUPLED_CONVERGENCE = 0.5;
// The iteration of a regular step goes on to this fraction of the tolerance, that of a step from the on-step state, whose
// starting value is worse by a power of h, to this. What is left is not the same forwards and backwards, and so limits
// how closely a run can be retraced; where rounding does not allow the fraction, the tolerance itself counts.
const double REGULAR_MARGIN = 0.1, ON_STEP_MARGIN = 1e-4;
// The density equation (3.14) is solved to the tolerance of the constraints, but not closer than rounding of U allows; and
// where strained, badly scaled constraints make that rounding larger, the second number counts.
const double DENSITY_ROUNDING = 1e-12, STRAINED_DENSITY_ROUNDING = 1e-8;
// In the search for a density: the slopes of (3.14) that are believed, and the factors that it may change by in a trial and grow by in all.
const double SMALLEST_SLOPE = 0.1, LARGEST_FACTOR = 4, FARTHEST = 100;

} // namespace

StepSolver::StepSolver(ConstraintSolver& constraints, const StepState& now) :
        motion(constraints.getSystem()), jump(-1), next(constraints.getSystem()), kind(First), size(0),
        constraints(constraints), now(now), h(0), tolerance(0), densityTolerance(0), lastSolved(next.lambda) {
}

void StepSolver::setSettings(double stepSize, double newTolerance) {
    h = stepSize;
    tolerance = newTolerance;
    densityTolerance = std::max(REGULAR_MARGIN * tolerance, DENSITY_ROUNDING);
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

ConstraintSolver::Trial StepSolver::trialOf(Kind newKind, double kick, double drift) {
    kind = newKind;
    size = drift;
    return {kind == Regular ? now.w : now.v, kick, drift, next.theta, next.q, next.w, next.offset.found};
}

ConstraintSolver::Trial StepSolver::regularTrial(double rho, double rhoNext) {
    return trialOf(Regular, 0.5 * (h / rho + h / rhoNext), h / rhoNext);
}

// Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes that O(h^3).
ConstraintSolver::Guess StepSolver::regularGuess() const {
    return {now.lambda, &now.offset, REGULAR_MARGIN};
}

bool StepSolver::solve(double rho, double rhoNext) {
    return constraints.solvePositions(regularTrial(rho, rhoNext), regularGuess());
}

bool StepSolver::solveFromOnStep(Kind newKind, double stepSize) {
    return constraints.solvePositions(trialOf(newKind, 0.5 * stepSize, stepSize),
                                      {now.lambda, nullptr, ON_STEP_MARGIN});
}

bool StepSolver::solveBackwards(double stepSize, StepState& back) {
    motion.goBack(stepSize, back.theta);
    return constraints.solvePositions(
        {now.v, -0.5 * stepSize, -stepSize, back.theta, back.q, back.w, back.offset.found},
        {now.lambda, nullptr, ON_STEP_MARGIN});
}

std::string StepSolver::explainFailure() {
    std::string reason = constraints.explainFailure(trialOf(kind, 0.0, size));
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
    return solveByChord(monitor, equation, rhoNext) || searchDensity(monitor, equation, rhoNext);
}

/*
 * In each pass lambda gets its chord update and rho+ that of Newton's iteration on F = rho+ + rho - u(q,p+) - u(q,p-), whose
 * derivative is 1 + (h/(2 rho+^2)) du/dp (F - G^T Lambda) along the constraints; what either update does to the other's equation is
 * of higher order in h and left to the next pass.
 */
bool StepSolver::solveByChord(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext) {
    rhoNext = equation.explicitValue + equation.offset;
    double previous = std::numeric_limits<double>::infinity();
    for (int pass = 0; pass <= MAX_COUPLED_PASSES && rhoNext > 0; pass++) {
        const ConstraintSolver::Trial trial = regularTrial(equation.rho, rhoNext);
        const ConstraintSolver::Guess start = regularGuess();
        double constraintError;
        const double u =
            monitor.coupledPass(now, trial, motion.atStart(size), pass == 0 ? &start : nullptr, constraintError);
        const double mismatch = rhoNext - u + equation.known;
        const double error = std::max(constraintError / (REGULAR_MARGIN * tolerance),
                                      std::fabs(mismatch) / (densityTolerance * (rhoNext + equation.rho)));
        if (pass > 0 && error <= 1)
            return true;
        if (!std::isfinite(error) || error > SLOW_COUPLED_CONVERGENCE * previous)
            return false;
        previous = error;
        rhoNext -= mismatch / (1 + 0.5 * h * equation.rate / (rhoNext * rhoNext));
    }
    return false;
}

/*
 * Where the two do not converge together: rho+ is searched for alone, with all constraints solved at each trial, by the secant method
 * from the density of (3.15) and in the direction of F there. A step that cannot be taken is too large.
 */
bool StepSolver::searchDensity(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext) {
    const double infinity = std::numeric_limits<double>::infinity();
    rhoNext = equation.explicitValue > 0 ? equation.explicitValue : equation.fallBack;
    const double farthest = FARTHEST * rhoNext;
    double low = 0, high = infinity; // F < 0 and F > 0
    double lastDensity = 0, lastMismatch = -infinity, slope = 1 + 0.5 * h * equation.rate / (rhoNext * rhoNext);
    bool isSolved = false;
    for (int trial = 0; trial < MAX_SEARCH_TRIALS; trial++) {
        const ConstraintSolver::Guess start =
            isSolved ? ConstraintSolver::Guess{lastSolved, nullptr, REGULAR_MARGIN} : regularGuess();
        double mismatch = -infinity, aim = infinity;
        if (constraints.solvePositions(regularTrial(equation.rho, rhoNext), start)) {
            isSolved = true;
            lastSolved = next.offset.found;
            const vector<double>& values = monitor.evaluateAt(now, next.w, motion.atStart(size));
            mismatch = rhoNext - monitor.combine(values) + equation.known;
            const double error = std::fabs(mismatch) / (rhoNext + equation.rho);
            const bool isSlow = !(std::fabs(mismatch) < SLOW_CONVERGENCE * std::fabs(lastMismatch));
            if (error <= (isSlow ? STRAINED_DENSITY_ROUNDING : densityTolerance))
                return true;
            const double secant = (mismatch - lastMismatch) / (rhoNext - lastDensity);
            slope = std::isfinite(secant) ? secant : slope;
            aim = rhoNext - mismatch / (slope > SMALLEST_SLOPE ? slope : 1.0);
        }
        if (std::isnan(mismatch))
            return false;
        (mismatch > 0 ? high : low) = lastDensity = rhoNext;
        lastMismatch = mismatch;
        if (!(aim > low && aim < high))
            aim = 0.5 * (low + high);
        rhoNext = std::min(std::max(aim, rhoNext / LARGEST_FACTOR), rhoNext * LARGEST_FACTOR);
        // Where the step size is far too large there are solutions of no meaning.
        if (rhoNext > farthest)
            return false;
    }
    return false;
}
