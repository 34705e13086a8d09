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

// The smooth sequence's value half a step after the start, from the values at the start, one step ahead and one back.
double startValue(double start, double ahead, const double* back) {
    const double value = back != nullptr ? start + 0.25 * (ahead - *back) : 0.5 * (start + ahead);
    // What changes by its own size within the first step is not resolved: take it as it is.
    return value > 0.5 * start && value < 2 * start ? value : start;
}

} // namespace

MonitorStart::MonitorStart(ConstraintSolver& constraints, StepSolver& solver, StepMonitor& monitor,
                           const StepState& now) :
        constraints(constraints), solver(solver), monitor(monitor), now(now), back(constraints.getSystem()),
        hasBack(false), isCalm(false), triedDensity(1), firstDensity(0) {
}

void MonitorStart::prepare() {
    if (firstDensity == 0)
        referencesBefore = monitor.getReferences();
}

void MonitorStart::abandon() {
    monitor.setReferences(referencesBefore);
    forget();
}

double MonitorStart::findDensity(const vector<double>& values, double stepSize) {
    isCalm = false;
    if (firstDensity > 0)
        return firstDensity;
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    double farthest = 0;
    for (int i : constraints.getMovingParticles())
        farthest = std::max(farthest, std::sqrt(now.q[i].dot(now.q[i])));
    const double speed = std::numeric_limits<double>::epsilon() * farthest / stepSize;
    isNegligible.resize(terms.size());
    bool areAllNegligible = true, areAllUnknown = true, areAllKnown = true;
    for (size_t k = 0; k < terms.size(); k++) {
        isNegligible[k] = monitor.isNegligible((int) k, values[k], now, speed, speed / stepSize);
        areAllNegligible = areAllNegligible && isNegligible[k];
        const bool isKnown = terms[k].reference > 0;
        areAllUnknown = areAllUnknown && !isKnown;
        areAllKnown = areAllKnown && isKnown;
        isCalm = isCalm || (isNegligible[k] && !isKnown);
    }
    isCalm = isCalm || areAllNegligible;
    const bool isGiven = !areAllNegligible && !areAllUnknown && (areAllKnown || isCalm);
    return triedDensity = isGiven ? monitor.combine(values) : 1.0;
}

void MonitorStart::lookBack(const vector<double>& values, bool withHalfStep) {
    if (isCalm)
        return;
    hasBack = lookBehind();
    startValues = values;
    if (!hasBack || !withHalfStep)
        return;
    // The mean of U_k(q0,p) over the half-step momenta on either side of the start, which is what (3.14) takes.
    const ExpressionParameters& theta = solver.motion.atStart(solver.size);
    monitor.evaluateAt(now, solver.next.w, theta, startValues);
    monitor.evaluateAt(now, back.w, theta, halfValues);
    for (size_t k = 0; k < startValues.size(); k++)
        startValues[k] = 0.5 * (startValues[k] + halfValues[k]);
}

// The state a step behind the start, if there is one.
bool MonitorStart::lookBehind() {
    const StepState& next = solver.next;
    back.q = now.q; // for the sake of particles without mass, which stay as they are
    back.w = back.v = now.v;
    if (!solver.solveBackwards(solver.size, back))
        return false;
    const ConstraintSystem& system = constraints.getSystem();
    double product = 0, square = 0;
    for (int i : constraints.getMovingParticles()) {
        const Vec3 forward = next.q[i] - now.q[i];
        product += system.getMasses()[i] * forward.dot(back.q[i] - now.q[i]);
        square += system.getMasses()[i] * forward.dot(forward);
    }
    const double alpha = square > 0 ? product / square : 0.0;
    for (int i = 0; i < system.getNumParticles(); i++)
        back.force[i] = now.force[i] + (next.force[i] - now.force[i]) * alpha;
    back.groupEnergy = now.groupEnergy + alpha * (next.groupEnergy - now.groupEnergy);
    try {
        const ConstraintSolver::OnStep end = {back.q, back.w,      back.force,     back.theta, -0.5 * solver.size,
                                              back.v, back.lambda, back.rightSide, nullptr};
        monitor.observe(end);
        constraints.finish(end, &monitor);
        monitor.evaluate(back, backValues);
        monitor.requireValid(backValues);
    }
    catch (const StepFailure&) {
        return false;
    }
    return true;
}

bool MonitorStart::measure(const vector<double>& valuesNext) {
    if (isCalm)
        return true;
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    const bool areAllTaken =
        std::all_of(terms.begin(), terms.end(), [](const StepMonitor::Term& term) { return term.reference == 0; });
    for (size_t k = 0; k < terms.size(); k++)
        if (terms[k].reference == 0)
            monitor.setReference((int) k,
                                 startValue(startValues[k], valuesNext[k], hasBack ? &backValues[k] : nullptr));
    if (areAllTaken) {
        if (hasBack)
            scaleReferences(valuesNext);
        return true;
    }
    if (firstDensity > 0)
        return true;
    const double behind = hasBack ? monitor.combine(backValues) : 0.0;
    firstDensity = startValue(monitor.combine(startValues), monitor.combine(valuesNext), hasBack ? &behind : nullptr);
    return std::fabs(firstDensity - triedDensity) <= 1e-12 * triedDensity;
}

bool MonitorStart::accept(const vector<double>& values) {
    forget();
    for (size_t k = 0; k < values.size() && isCalm; k++)
        if (monitor.getTerms()[k].reference == 0 && !isNegligible[k])
            monitor.setReference((int) k, values[k]);
    return !isCalm;
}

// With rho[1/2] = 1 the steps to either side have the size h, and not h/u0, so that the change of u over a step of the
// sequence is theirs over u0. Scale the references such that u0 + (u1 - u-1)/(4 u0) = 1.
void MonitorStart::scaleReferences(const vector<double>& valuesNext) {
    const vector<double> references = monitor.getReferences();
    auto mismatchOf = [&](double scale) {
        for (size_t k = 0; k < references.size(); k++)
            monitor.setReference((int) k, scale * references[k]);
        const double start = monitor.combine(startValues);
        return start + 0.25 * (monitor.combine(valuesNext) - monitor.combine(backValues)) / start - 1;
    };
    double last = 1, scale = 1.001, lastMismatch = mismatchOf(last);
    for (int iteration = 0; iteration < 20; iteration++) { // the secant method
        const double mismatch = mismatchOf(scale);
        const double next = scale - mismatch * (scale - last) / (mismatch - lastMismatch);
        if (std::fabs(mismatch) < 1e-14 || !(next > 0.5 && next < 2))
            break;
        last = scale;
        lastMismatch = mismatch;
        scale = next;
    }
    // Where the monitor is not resolved the scale is left alone.
    if (!(std::fabs(mismatchOf(scale)) < 1e-6))
        mismatchOf(1);
}
