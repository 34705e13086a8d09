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

namespace {

const int MAX_COUPLED_PASSES = 12, MAX_NEWTON_ITERATIONS = 50;
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

/** Sums the forces of a step for the monitors. */
struct ForceSums : ConstraintSolver::Observer {
    ForceSums(StepMonitor& monitor, const vector<Vec3>& forces) : monitor(monitor), forces(forces) {
    }
    void see(int block) override {
        monitor.sumForces(forces, block);
    }
    StepMonitor& monitor;
    const vector<Vec3>& forces;
};

} // namespace

// ---------------------------------------------------------------------------------------------- the on-step state

void VRattleDynamics::ensureMonitor() {
    if (!isMonitorCurrent) {
        monitor.setForces(force, groupEnergy);
        isMonitorCurrent = true;
    }
}

// u(q,p) with Lambda(q,p) (4.3)
double VRattleDynamics::evaluateU(const vector<Vec3>& velocities, const ExpressionParameters& parameters) {
    ensureMonitor();
    solver.findMultipliers(velocities, parameters, multiplierTrial, rightSideTrial);
    monitor.evaluate(velocities, multiplierTrial, rightSideTrial, valuesTrial);
    return combineAndLimit(valuesTrial);
}

// The on-step quantities at a position: (3.12)-(3.13) from the half-step velocities, then Lambda and the monitors.
void VRattleDynamics::evaluateOnStep(const ConstraintSolver::OnStep& state, double energy,
                                     vector<double>& monitorValues) {
    isMonitorCurrent = false;
    ForceSums sums(monitor, state.forces);
    solver.finish(state, &sums);
    monitor.finishForces(state.forces, energy);
    if (!monitor.hasFiniteForces())
        throw StepFailure("the force on a particle is infinite or not a number");
    monitor.evaluate(state.velocities, state.multipliers, state.rightSide, monitorValues);
    monitor.requireValid(monitorValues);
    if (state.atHalfStep != nullptr)
        monitor.evaluate(state.halfStep, atHalfStep.multipliers, atHalfStep.rightSide, valuesHalf);
}

// The change of u along F - G^T Lambda, of the on-step state that is about to be taken over.
double VRattleDynamics::evaluateRate() {
    if (monitor.usesVelocities()) {
        const vector<double>& inverseMasses = system.getInverseMasses();
        for (int i : movingParticles)
            acceleration[i] = monitor.getForces()[i] * inverseMasses[i];
        solver.subtractConstraintAccelerations(qNext, thetaNext, lambdaOnStep, acceleration);
    }
    return density.limitDerivative(monitor.combine(valuesNext)) *
           monitor.evaluateRate(vNext, lambdaOnStep, rightSideNext, valuesNext, acceleration, atHalfStep.rate);
}

bool VRattleDynamics::projectPositions(vector<Vec3>& positions) {
    areParametersChanging = false;
    return solver.projectPositions(positions, theta);
}

// ------------------------------------------------------------------------------------------ the equations of a step

ConstraintSolver::Trial VRattleDynamics::trialTo(double kick, double drift, const vector<Vec3>& start) {
    return {start, kick, drift, thetaNext, qNext, wNext, lambdaNext};
}

// Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes that O(h^3).
bool VRattleDynamics::solvePositions(const ConstraintSolver::Trial& trial, bool isFromOnStep) {
    if (isFromOnStep)
        return solver.solvePositions(trial, {lambda, nullptr, ON_STEP_MARGIN});
    return solver.solvePositions(trial, {lambda, &multiplierOffset, REGULAR_MARGIN});
}

void VRattleDynamics::keepOffsets() {
    densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    for (size_t k = 0; k < lambdaNext.size(); k++)
        multiplierOffset[k] = lambdaNext[k] - lambda[k];
}

/*
 * Solve (3.11) and (3.14) for lambda and rho+ together. In each pass lambda gets its chord update and rho+ that of
 * Newton's iteration on F = rho+ + rho - u(q,p+) - u(q,p-), whose derivative is 1 + (h/(2 rho+^2)) du/dp (F - G^T Lambda)
 * along the constraints; what either update does to the other's equation is of higher order in h and left to the next pass.
 */
bool VRattleDynamics::solveCoupled() {
    const double h = settings.stepSize;
    findHalfStepValue();
    rhoNext = densityScale * StepDensity::sumUpdate(u, rho) + densityOffset;
    if (!(rhoNext > 0))
        return false;
    double previous = std::numeric_limits<double>::infinity();
    const double densityTolerance = std::max(REGULAR_MARGIN * settings.tolerance, DENSITY_ROUNDING);
    for (int pass = 0; pass <= MAX_COUPLED_PASSES; pass++) {
        const ConstraintSolver::Trial trial = trialTo(0.5 * h * (1 / rho + 1 / rhoNext), h / rhoNext, w);
        setRates(thetaHalf, trial.drift);
        if (pass == 0)
            solver.beginCoupled(trial, {lambda, &multiplierOffset, REGULAR_MARGIN});
        const double constraintError = solver.coupledPass(trial, {thetaHalf, multiplierTrial, rightSideTrial});
        monitor.evaluate(wNext, multiplierTrial, rightSideTrial, valuesTrial);
        const double mismatch = rhoNext - combineAndLimit(valuesTrial) + densityScale * (rho - halfStepValue);
        const double error = std::max(constraintError / (REGULAR_MARGIN * settings.tolerance),
                                      std::fabs(mismatch) / ((rhoNext + rho) * densityTolerance));
        if (pass > 0 && error <= 1)
            return true;
        if (!std::isfinite(error) || error > SLOW_COUPLED_CONVERGENCE * previous)
            return false;
        previous = error;
        rhoNext -= mismatch / (1 + 0.5 * h * rate / (rhoNext * rhoNext));
        if (!(rhoNext > 0))
            return false;
    }
    return false;
}

// Newton's iteration on (lambda, rho+) for (3.11) and (3.14) by the Schur complement (docs/method.md, section 8), for
// all constraints. Where the coupled chord iteration fails.
bool VRattleDynamics::solveCoupledByNewton() {
    const double h = settings.stepSize;
    const double uMinus = densityScale * findHalfStepValue();
    rhoNext = densityScale * StepDensity::sumUpdate(u, rho);
    if (!(rhoNext > 0))
        rhoNext = density.boundedUpdate(densityScale * u, densityScale * rho);
    int numCuts = 0;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        const double kick = 0.5 * h * (1 / rho + 1 / rhoNext), drift = h / rhoNext;
        const ConstraintSolver::Trial trial = trialTo(kick, drift, w);
        if (iteration == 0)
            solver.guess(trial, {lambda, &multiplierOffset, REGULAR_MARGIN});
        setRates(thetaHalf, drift);
        const double constraintError = solver.evaluate(trial);
        const double uPlus = evaluateU(wNext, thetaHalf);
        // F_rho of docs/method.md, section 8
        const double mismatch = rhoNext - uPlus + densityScale * rho - uMinus;
        const double relativeMismatch = std::fabs(mismatch) / (rhoNext + rho);
        const double error =
            std::max(constraintError / (REGULAR_MARGIN * settings.tolerance),
                     relativeMismatch / std::max(REGULAR_MARGIN * settings.tolerance, DENSITY_ROUNDING));
        if (!std::isfinite(error))
            return false;
        const bool isSlow = error > SLOW_CONVERGENCE * previous;
        const bool isGoodEnough =
            constraintError <= settings.tolerance && relativeMismatch <= STRAINED_DENSITY_ROUNDING;
        if (iteration > 0 && (error <= 1 || (isSlow && isGoodEnough)))
            return true;
        previous = error;
        if (!solver.linearize(trial))
            return false;
        // a = dF/dlambda, d = dF/drho+, and response = x2 = A^-1 dg/drho+
        monitor.evaluateGradient(thetaHalf, wNext, multiplierTrial, valuesTrial, gradient);
        const double derivative = density.limitDerivative(monitor.combine(valuesTrial));
        solver.multiplyOverMass(gradient, coupling);
        for (double& a : coupling)
            a *= kick * derivative;
        double d = 1;
        const double kickChange = -0.5 * h / (rhoNext * rhoNext); // d(kick)/d(rho+)
        for (int i : movingParticles) {
            const Vec3 kickPart = (wNext[i] - w[i]) * (kickChange / kick); // of dw+/drho+
            d -= derivative * gradient[i].dot(kickPart);
            halfStepChange[i] = kickPart * drift - wNext[i] * (drift / rhoNext);
        }
        solver.findResponse(trial, halfStepChange, response);
        solver.findUpdate(trial, correction); // x1 = -A^-1 g
        double change = (-mismatch - dot(coupling, correction)) / (d - dot(coupling, response));
        if (!std::isfinite(change))
            return false;
        if (!(rhoNext + change > 0)) {
            if (++numCuts > 8)
                return false;
            change = -0.75 * rhoNext;
        }
        rhoNext += change;
        for (size_t k = 0; k < lambdaNext.size(); k++)
            lambdaNext[k] += correction[k] - response[k] * change;
        numNewtonIterations++;
    }
    return false;
}

// Solve for rho+, lambda, w+ and q+ of a regular step; returns its size.
double VRattleDynamics::solveRegular() {
    const double h = settings.stepSize;
    auto trialWith = [&](double next) {
        rhoNext = next;
        return trialTo(0.5 * (h / rho + h / rhoNext), h / rhoNext, w);
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
        isSolved = solveCoupled() || solveCoupledByNewton();
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

void VRattleDynamics::throwNotConverged(const ConstraintSolver::Trial& trial) {
    std::stringstream reason;
    reason << solver.explainFailure(trial);
    if (areParametersChanging)
        reason << "; parameters of constraints have been changed for this step, so move them by less at a time";
    if (hasDensity && settings.isAutomatic)
        reason << "; the step tried was of " << settings.stepSize / rhoNext << " ps";
    else if (hasDensity && !monitor.isEmpty())
        reason << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
               << settings.stepSize / rhoNext << " ps";
    throw StepFailure(reason.str());
}
