// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/MonitorControl.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// What changes by more than this factor within the first step, or where the reference would be others by more, is not resolved.
const double LARGEST_CHANGE = 2;
// What grows by more than this factor was all but zero before; what starts at rest is four times larger after two steps than after one.
const double LARGEST_GROWTH = 5;
// A density that differs by no more is the same.
const double DENSITY_ROUNDING = 1e-12;
// Of the scale of references: the other one to begin with, and what is left of the mismatch where it is found, or will do.
const double FIRST_SCALE = 1.001, SCALE_ROUNDING = 1e-14, SCALE_TOLERANCE = 1e-6;
const int MAX_SCALES = 20;

bool isResolved(double value, double start) {
    return value > start / LARGEST_CHANGE && value < start * LARGEST_CHANGE;
}

// The smooth sequence's value half a step after the start, from the values at the start, one step ahead and one back.
double startValue(double start, double ahead, const double* back) {
    const double value = back != nullptr ? start + 0.25 * (ahead - *back) : 0.5 * (start + ahead);
    return isResolved(value, start) ? value : start;
}

} // namespace

MonitorControl::MonitorControl(ConstraintSolver& constraints, StepSolver& solver, StepState& now) :
        StepControl(constraints, solver, now), monitor(constraints), numRescues(0), u(1), densityScale(1),
        isRescued(false), isCalm(false), firstDensity(0), hasBack(false), back(constraints.getSystem()) {
}

// -------------------------------------------------------------------------------------------------------- the settings

void MonitorControl::changeSettings(const StepSettings& newSettings, const vector<double>& references,
                                    SettingsChange change) {
    const bool isAtState = change != Nothing && !now.q.empty();
    const double oldU = isAtState && hasDensity ? monitor.combine(now.values) : 0.0;
    settings = newSettings;
    recursion = settings.getDensity();
    monitor.setTerms(settings.terms, recursion);
    monitor.references = references;
    if (!isAtState)
        return;
    monitor.look(now, true);
    hasHalfStepValue = false;
    rate = 0;
    if (change == Monitors || std::count(references.begin(), references.end(), 0.0) > 0)
        forgetDensity();
    else
        rescaleDensity(oldU);
}

// ------------------------------------------------------------------------------------------------- between two steps

void MonitorControl::change(ChangeKind kind, double) {
    if (kind == Frame && !StepMonitor::useVelocities(settings.terms))
        return;
    const bool isPlace = kind == Everything || kind == Forces;
    const double oldU = hasDensity ? monitor.combine(now.values) : 0.0;
    monitor.look(now, isPlace);
    hasHalfStepValue = false;
    if (isPlace)
        monitor.requireValid(now.values);
    if (kind == Everything)
        densityOffset = 0;
    rescaleDensity(oldU);
}

// After a jump of the state: rho keeps its ratio to u, so that it starts no oscillation.
void MonitorControl::rescaleDensity(double oldU) {
    if (!hasDensity)
        return;
    const double newU = monitor.combine(now.values);
    if (newU > 0 && oldU > 0)
        rho *= newU / oldU;
    else
        forgetDensity();
}

void MonitorControl::reverse() {
    densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    rho = rhoNext;
    rate = -rate;
    hasHalfStepValue = needsHalfStep();
    if (hasHalfStepValue) // it is of the step that would have come, and even in p and the rates
        halfStepValue =
            monitor.combine(monitor.evaluateAt(now, now.w, solver.motion.atStart(settings.stepSize / rhoNext)));
}

// ------------------------------------------------------------------------------------------------------------- a step

// Whether the density is solved for together with the constraints, which takes u at half-step momenta.
bool MonitorControl::needsHalfStep() const {
    return settings.update == StepDensity::SemiExplicit && !settings.isFixedStep &&
           StepMonitor::dependOnVelocities(settings.terms);
}

bool MonitorControl::seesHalfStep() const {
    return needsHalfStep() && solver.kind != StepSolver::Shortened;
}

double MonitorControl::findHalfStepValue() {
    if (needsHalfStep() && !hasHalfStepValue) {
        halfStepValue = monitor.combine(monitor.evaluateAt(now, now.w, now.theta));
        hasHalfStepValue = true;
    }
    return halfStepValue;
}

void MonitorControl::solve() {
    isRescued = isCalm = false;
    densityScale = 1;
    if (!hasDensity) {
        rhoNext = isConstant() ? 1.0 : findFirstDensity();
        return;
    }
    u = monitor.combine(now.values);
    double bounded = 1;
    if (!isConstant()) {
        // As after any other jump of the state the density keeps its ratio to u: in this update u[n], rho[n-1/2] and
        // u(q[n],p[n-1/2]) are all scaled with what u becomes with the new velocities.
        if (solver.jump >= 0) {
            const double scale = monitor.combine(monitor.evaluateAt(now, solver.next.v, solver.motion.getJump())) / u;
            if (std::isfinite(scale) && scale > 0 && std::fabs(scale - 1) > SMALL_CHANGE)
                densityScale = scale;
        }
        bounded = recursion.boundedUpdate(densityScale * u, densityScale * rho);
        isRescued = settings.update != StepDensity::Bounded && !solveSum(bounded);
        if (settings.update != StepDensity::Bounded && !isRescued)
            return;
    }
    rhoNext = bounded;
    if (!solver.solve(rho, rhoNext))
        throwNotConverged();
}

// Returns whether it has given a step that is not far above the maximum.
bool MonitorControl::solveSum(double bounded) {
    rhoNext = densityScale * StepDensity::sumUpdate(u, rho); // (3.15)
    bool isSolved;
    if (needsHalfStep()) { // (3.14)
        const double known = densityScale * (rho - findHalfStepValue()), explicitValue = rhoNext;
        isSolved = solver.solve(monitor, {rho, known, explicitValue, densityOffset, rate, bounded}, rhoNext);
    }
    else
        isSolved = rhoNext > 0 && solver.solve(rho, rhoNext);
    return isSolved && rhoNext >= 0.5 * recursion.smallest;
}

std::string MonitorControl::explainStep() const {
    if (!hasDensity || settings.terms.empty())
        return "";
    std::stringstream text;
    text << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
         << settings.stepSize / rhoNext << " ps";
    return text.str();
}

bool MonitorControl::finish() {
    const bool isStart = solver.kind == StepSolver::First && !isConstant() && !isCalm && firstDensity == 0;
    if (isStart)
        lookBack();
    monitor.finish(solver.next, 0.5 * solver.size, seesHalfStep());
    return !isStart || findSmoothStart();
}

void MonitorControl::accept() {
    numRescues += isRescued;
    firstDensity = 0;
    if (solver.kind == StepSolver::First) {
        hasDensity = !isCalm;
        for (size_t k = 0; k < now.values.size() && isCalm; k++)
            if (monitor.references[k] == 0 && !isNegligible[k])
                monitor.references[k] = solver.next.values[k]; // of the state before the step
    }
    else if (solver.kind == StepSolver::Regular)
        densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    else if (hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, solver.size / (settings.stepSize / rhoNext));
    hasHalfStepValue = seesHalfStep();
    if (hasHalfStepValue) {
        halfStepValue = monitor.combine(now.halfStepValues);
        // Along F - G^T Lambda, which the last half of the kick has gone along.
        rate = (monitor.combine(now.values) - halfStepValue) / (0.5 * solver.size);
    }
    if (hasDensity || solver.kind == StepSolver::First)
        rho = rhoNext;
}

void MonitorControl::abandon() {
    if (firstDensity > 0)
        monitor.references = referencesBefore;
    firstDensity = 0;
}

// ------------------------------------------------------------------------------------------------------ the first step

// rho[1/2] to be tried.
double MonitorControl::findFirstDensity() {
    if (firstDensity > 0)
        return firstDensity;
    const vector<double>& references = monitor.references;
    double farthest = 0;
    for (int i : constraints.getMovingParticles())
        farthest = std::max(farthest, std::sqrt(now.q[i].dot(now.q[i])));
    const double speed = std::numeric_limits<double>::epsilon() * farthest / settings.stepSize;
    size_t numNegligible = 0, numKnown = 0;
    isNegligible.resize(references.size());
    for (size_t k = 0; k < references.size(); k++) {
        const bool isKnown = references[k] > 0;
        isNegligible[k] = monitor.isNegligible(k, now, speed, speed / settings.stepSize);
        isCalm = isCalm || (isNegligible[k] && !isKnown);
        numNegligible += isNegligible[k];
        numKnown += isKnown;
    }
    const bool areAllNegligible = numNegligible == references.size();
    isCalm = isCalm || areAllNegligible;
    const bool isGiven = !areAllNegligible && numKnown > 0 && (numKnown == references.size() || isCalm);
    return isGiven ? monitor.combine(now.values) : 1.0;
}

// What the smooth start follows from, but for the values at the end of the step.
void MonitorControl::lookBack() {
    hasBack = stepBack();
    startValues = now.values;
    if (!hasBack || !needsHalfStep())
        return;
    // The mean of U_k(q0,p) over the half-step momenta on either side of the start, which is what (3.14) takes.
    const ExpressionParameters& theta = solver.motion.atStart(solver.size);
    startValues = monitor.evaluateAt(now, solver.next.w, theta);
    const vector<double>& behind = monitor.evaluateAt(now, back.w, theta);
    for (size_t k = 0; k < startValues.size(); k++)
        startValues[k] = 0.5 * (startValues[k] + behind[k]);
}

bool MonitorControl::stepBack() {
    const StepState& next = solver.next;
    const vector<double>& masses = constraints.getSystem().getMasses();
    back.q = now.q; // for the sake of particles without mass, which stay as they are
    back.w = back.v = now.v;
    if (!solver.solveBackwards(solver.size, back))
        return false;
    double product = 0, square = 0;
    for (int i : constraints.getMovingParticles()) {
        const Vec3 forward = next.q[i] - now.q[i];
        product += masses[i] * forward.dot(back.q[i] - now.q[i]);
        square += masses[i] * forward.dot(forward);
    }
    const double alpha = square > 0 ? product / square : 0.0;
    for (size_t i = 0; i < masses.size(); i++)
        back.force[i] = now.force[i] + (next.force[i] - now.force[i]) * alpha;
    back.groupEnergy = now.groupEnergy + alpha * (next.groupEnergy - now.groupEnergy);
    try {
        monitor.finish(back, -0.5 * solver.size, false);
    }
    catch (const StepFailure&) {
        return false;
    }
    return true;
}

// The step stands where it had the density of the smooth start, or the references are now such that it had.
bool MonitorControl::findSmoothStart() {
    const vector<double>& ahead = solver.next.values;
    for (size_t k = 0; k < ahead.size(); k++) {
        const bool isGrowing = monitor.references[k] == 0 && ahead[k] > LARGEST_GROWTH * startValues[k];
        isNegligible[k] = isNegligible[k] || isGrowing;
        isCalm = isCalm || isGrowing;
    }
    if (isCalm)
        return true;
    referencesBefore = monitor.references;
    for (size_t k = 0; k < ahead.size(); k++)
        if (referencesBefore[k] == 0)
            monitor.references[k] = startValue(startValues[k], ahead[k], hasBack ? &back.values[k] : nullptr);
    if (std::count(referencesBefore.begin(), referencesBefore.end(), 0.0) == (int) ahead.size()) {
        if (hasBack)
            scaleReferences();
        return true;
    }
    const double behind = hasBack ? monitor.combine(back.values) : 0.0;
    firstDensity = startValue(monitor.combine(startValues), monitor.combine(ahead), hasBack ? &behind : nullptr);
    return std::fabs(firstDensity - rhoNext) <= DENSITY_ROUNDING * rhoNext;
}

// With rho[1/2] = 1 the steps to either side have the size h, and not h/u0, so that the change of u over a step of the
// sequence is theirs over u0. Scale the references such that u0 + (u1 - u-1)/(4 u0) = 1.
void MonitorControl::scaleReferences() {
    const vector<double> smooth = monitor.references;
    auto mismatchOf = [&](double scale) {
        for (size_t k = 0; k < smooth.size(); k++)
            monitor.references[k] = scale * smooth[k];
        const double start = monitor.combine(startValues);
        return start + 0.25 * (monitor.combine(solver.next.values) - monitor.combine(back.values)) / start - 1;
    };
    double last = 1, scale = FIRST_SCALE, lastMismatch = mismatchOf(last);
    for (int iteration = 0; iteration < MAX_SCALES; iteration++) { // the secant method
        const double mismatch = mismatchOf(scale);
        const double next = scale - mismatch * (scale - last) / (mismatch - lastMismatch);
        if (std::fabs(mismatch) < SCALE_ROUNDING || !isResolved(next, 1))
            break;
        last = scale;
        lastMismatch = mismatch;
        scale = next;
    }
    // Where the monitor is not resolved the scale is left alone.
    if (!(std::fabs(mismatchOf(scale)) < SCALE_TOLERANCE))
        mismatchOf(1);
}
