// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/MonitorControl.h"
#include <algorithm>
#include <cmath>
#include <sstream>

using namespace OpenMMVRattle;
using std::vector;

MonitorControl::MonitorControl(ConstraintSolver& constraints, StepSolver& solver, StepState& now) :
        StepControl(constraints, solver, now), monitor(constraints), firstStep(constraints, solver, monitor, now),
        numRescues(0), u(1), densityScale(1), isRescued(false), atHalfStep{now.lambda, now.lambda} {
}

// -------------------------------------------------------------------------------------------------------- the settings

void MonitorControl::applySettings(const StepSettings& newSettings) {
    settings = newSettings;
    recursion = settings.getDensity();
    monitor.setTerms(settings.terms, recursion);
}

void MonitorControl::changeSettings(const StepSettings& newSettings, const vector<double>& references,
                                    SettingsChange change) {
    const double oldU = hasDensity ? monitor.combine(now.values) : 0.0;
    applySettings(newSettings);
    monitor.references = references;
    if (change == Nothing || now.q.empty())
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
    isRescued = false;
    densityScale = 1;
    if (!hasDensity) {
        rhoNext = isConstant() ? 1.0 : firstStep.findDensity(settings.stepSize);
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

ConstraintSolver::Observer* MonitorControl::observe(ConstraintSolver::OnStep& end) {
    if (solver.kind == StepSolver::First && !isConstant())
        firstStep.lookBack(needsHalfStep());
    end.atHalfStep = seesHalfStep() ? &atHalfStep : nullptr;
    monitor.observe(end);
    return &monitor;
}

bool MonitorControl::measure() {
    monitor.evaluate(solver.next);
    monitor.requireValid(solver.next.values);
    return solver.kind != StepSolver::First || isConstant() || firstStep.measure();
}

void MonitorControl::accept() {
    numRescues += isRescued;
    if (solver.kind == StepSolver::First)
        hasDensity = isConstant() || firstStep.accept();
    else if (solver.kind == StepSolver::Regular)
        densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    else if (hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, solver.size / (settings.stepSize / rhoNext));
    hasHalfStepValue = seesHalfStep();
    if (hasHalfStepValue) {
        halfStepValue = monitor.combine(monitor.evaluateHalfStep(now));
        // Along F - G^T Lambda, which the last half of the kick has gone along.
        rate = (monitor.combine(now.values) - halfStepValue) / (0.5 * solver.size);
    }
    if (hasDensity || solver.kind == StepSolver::First)
        rho = rhoNext;
}
