// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/MonitorStart.h"
#include <algorithm>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// What changes by more than this factor within the first step, or where the reference would be others by more, is not resolved.
const double LARGEST_CHANGE = 2;
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

MonitorStart::MonitorStart(ConstraintSolver& constraints, StepSolver& solver, StepMonitor& monitor,
                           const StepState& now) :
        constraints(constraints), solver(solver), monitor(monitor), now(now), back(constraints.getSystem()),
        hasBack(false), isCalm(false), triedDensity(1), firstDensity(0) {
}

double MonitorStart::findDensity(double stepSize) {
    isCalm = false;
    if (firstDensity > 0)
        return firstDensity;
    const vector<double>& references = monitor.references;
    double farthest = 0;
    for (int i : constraints.getMovingParticles())
        farthest = std::max(farthest, std::sqrt(now.q[i].dot(now.q[i])));
    const double speed = std::numeric_limits<double>::epsilon() * farthest / stepSize;
    size_t numNegligible = 0, numKnown = 0;
    isNegligible.resize(references.size());
    for (size_t k = 0; k < references.size(); k++) {
        const bool isKnown = references[k] > 0;
        isNegligible[k] = monitor.isNegligible(k, now, speed, speed / stepSize);
        isCalm = isCalm || (isNegligible[k] && !isKnown);
        numNegligible += isNegligible[k];
        numKnown += isKnown;
    }
    const bool areAllNegligible = numNegligible == references.size();
    isCalm = isCalm || areAllNegligible;
    const bool isGiven = !areAllNegligible && numKnown > 0 && (numKnown == references.size() || isCalm);
    return triedDensity = isGiven ? monitor.combine(now.values) : 1.0;
}

void MonitorStart::lookBack(bool withHalfStep) {
    if (isCalm)
        return;
    hasBack = lookBehind();
    startValues = now.values;
    if (!hasBack || !withHalfStep)
        return;
    // The mean of U_k(q0,p) over the half-step momenta on either side of the start, which is what (3.14) takes.
    const ExpressionParameters& theta = solver.motion.atStart(solver.size);
    startValues = monitor.evaluateAt(now, solver.next.w, theta);
    const vector<double>& behind = monitor.evaluateAt(now, back.w, theta);
    for (size_t k = 0; k < startValues.size(); k++)
        startValues[k] = 0.5 * (startValues[k] + behind[k]);
}

// The state a step behind the start, if there is one.
bool MonitorStart::lookBehind() {
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
        const ConstraintSolver::OnStep end = {back.q, back.w,      back.force,     back.theta, -0.5 * solver.size,
                                              back.v, back.lambda, back.rightSide, nullptr};
        monitor.observe(end);
        constraints.finish(end, &monitor);
        monitor.evaluate(back);
        monitor.requireValid(back.values);
    }
    catch (const StepFailure&) {
        return false;
    }
    return true;
}

bool MonitorStart::measure() {
    if (isCalm || firstDensity > 0)
        return true;
    const vector<double>& ahead = solver.next.values;
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
    return std::fabs(firstDensity - triedDensity) <= DENSITY_ROUNDING * triedDensity;
}

bool MonitorStart::accept() {
    firstDensity = 0;
    const vector<double>& values = solver.next.values; // of the state before the step
    for (size_t k = 0; k < values.size() && isCalm; k++)
        if (monitor.references[k] == 0 && !isNegligible[k])
            monitor.references[k] = values[k];
    return !isCalm;
}

void MonitorStart::abandon() {
    if (firstDensity > 0)
        monitor.references = referencesBefore;
    firstDensity = 0;
}

// With rho[1/2] = 1 the steps to either side have the size h, and not h/u0, so that the change of u over a step of the
// sequence is theirs over u0. Scale the references such that u0 + (u1 - u-1)/(4 u0) = 1.
void MonitorStart::scaleReferences() {
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
