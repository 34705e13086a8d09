// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/MonitorControl.h"
#include <algorithm>
#include <cmath>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

MonitorControl::MonitorControl(ConstraintSolver& constraints, StepSolver& solver, const StepState& now) :
        StepControl(constraints, solver, now), monitor(constraints), firstStep(constraints, solver, monitor, now),
        numRescues(0), densityScale(1), isRescued(false), atHalfStep{solver.next.lambda, solver.next.lambda} {
}

// -------------------------------------------------------------------------------------------------------- the settings

bool MonitorControl::setSettings(const StepSettings& newSettings, bool isInForce) {
    vector<StepMonitor::Term> terms = newSettings.terms;
    const bool isOther =
        !isInForce || newSettings.isFixedStep != settings.isFixedStep ||
        !std::equal(terms.begin(), terms.end(), settings.terms.begin(), settings.terms.end(),
                    [](const StepMonitor::Term& a, const StepMonitor::Term& b) { return a.isLike(b); });
    bool mustForget = isOther, areReferencesSame = true;
    for (size_t k = 0; k < terms.size() && !isOther; k++) {
        const double given = settings.terms[k].reference, inForce = monitor.getTerms()[k].reference;
        if (terms[k].reference == 0 && given == 0)
            terms[k].reference = inForce; // taken at the first step, and so it stays
        else if (terms[k].reference == 0)
            mustForget = true;
        areReferencesSame = areReferencesSame && terms[k].reference == inForce;
    }
    const bool goesOn = !mustForget && areReferencesSame && newSettings.stepSize == settings.stepSize &&
                        newSettings.minimumStep == settings.minimumStep &&
                        newSettings.maximumStep == settings.maximumStep && newSettings.update == settings.update;
    applySettings(newSettings, terms);
    if (goesOn || now.q.empty())
        return true;
    look();
    rate = 0;
    if (mustForget)
        forget();
    else
        rescaleDensity();
    return false;
}

void MonitorControl::applySettings(const StepSettings& newSettings, const vector<StepMonitor::Term>& terms) {
    settings = newSettings;
    recursion = StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep);
    monitor.setTerms(terms, recursion);
}

StepMemory MonitorControl::getMemory() const {
    StepMemory memory = *this;
    memory.references = getReferences();
    return memory;
}

void MonitorControl::setMemory(const StepSettings& newSettings, const StepMemory& memory) {
    static_cast<StepMemory&>(*this) = memory;
    applySettings(newSettings, newSettings.terms);
    setReferences(memory.references);
    firstStep.forget();
}

// -------------------------------------------------------------------------------------------- u, and between two steps

// U_k at the present state
void MonitorControl::look() {
    monitor.evaluate(now, values);
    hasHalfStepValue = false;
}

double MonitorControl::limit(const vector<double>& monitorValues) const {
    return settings.isFixedStep ? 1.0 : monitor.combine(monitorValues);
}

double MonitorControl::evaluateU(const vector<Vec3>& velocities, const ExpressionParameters& theta) {
    monitor.evaluateAt(now, velocities, theta, valuesTrial);
    return limit(valuesTrial);
}

void MonitorControl::begin() {
    forget();
    densityOffset = 0;
    monitor.forgetForces();
    monitor.evaluate(now, values);
    monitor.requireValid(values);
}

void MonitorControl::adopt(const StepMemory& memory) {
    hasDensity = true;
    rho = memory.rho;
    u = limit(values);
    hasHalfStepValue = memory.hasHalfStepValue;
    halfStepValue = memory.halfStepValue;
    densityOffset = memory.densityOffset;
}

void MonitorControl::change(ChangeKind kind, double) {
    if (kind == Everything && !hasDensity) {
        begin();
        return;
    }
    if (!hasDensity)
        forget();
    if (kind == Frame && !monitor.usesVelocities())
        return;
    const bool isPlace = kind == Everything || kind == Forces;
    if (isPlace)
        monitor.forgetForces();
    look();
    if (isPlace)
        monitor.requireValid(values);
    if (kind == Everything)
        densityOffset = 0;
    rescaleDensity();
}

// After a jump of the state: rho keeps its ratio to u, so that it starts no oscillation.
void MonitorControl::rescaleDensity() {
    if (!hasDensity)
        return;
    const double oldU = u;
    u = limit(values);
    if (u > 0 && oldU > 0)
        rho *= u / oldU;
    else
        forget();
}

void MonitorControl::forget() {
    forgetDensity();
    firstStep.forget();
}

void MonitorControl::reverse() {
    densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    rho = rhoNext;
    rate = -rate;
    numRescues -= isRescued;
    isRescued = false;
    hasHalfStepValue = needsHalfStep();
    if (hasHalfStepValue) // it is of the step that would have come, and even in p and the rates
        halfStepValue = evaluateU(now.w, solver.motion.atStart(settings.stepSize / rhoNext));
}

// ------------------------------------------------------------------------------------------------------------- a step

void MonitorControl::prepare() {
    densityScale = 1;
    isRescued = false;
    if (!hasDensity)
        firstStep.prepare();
}

/*
 * As after any other jump of the state the density keeps its ratio to u: in the next update u[n], rho[n-1/2] and u(q[n],p[n-1/2]) are
 * all scaled with what u becomes with the new velocities.
 */
void MonitorControl::jump(const vector<Vec3>& velocities, const ExpressionParameters& theta, bool) {
    const double scale = evaluateU(velocities, theta) / u;
    if (std::isfinite(scale) && scale > 0 && std::fabs(scale - 1) > SMALL_JUMP)
        densityScale = scale;
}

// Whether the density is solved for together with the constraints, which takes u at half-step momenta.
bool MonitorControl::needsHalfStep() const {
    return settings.update == StepDensity::SemiExplicit && !settings.isFixedStep && monitor.dependsOnVelocities();
}

double MonitorControl::findHalfStepValue() {
    if (needsHalfStep() && !hasHalfStepValue) {
        halfStepValue = evaluateU(now.w, now.theta);
        hasHalfStepValue = true;
    }
    return halfStepValue;
}

void MonitorControl::solve() {
    if (!hasDensity) {
        rhoNext = isConstant() ? 1.0 : firstStep.findDensity(values, settings.stepSize);
        return;
    }
    const double explicitNext = densityScale * StepDensity::sumUpdate(u, rho); // (3.15)
    const double bounded = isConstant() ? 1.0 : recursion.boundedUpdate(densityScale * u, densityScale * rho);
    if (!isConstant() && settings.update != StepDensity::Bounded) {
        rhoNext = explicitNext;
        bool isSolved;
        if (needsHalfStep()) {
            const double known = densityScale * (rho - findHalfStepValue());
            isSolved = solver.solve(monitor, {rho, known, explicitNext, densityOffset, rate, bounded}, rhoNext);
        }
        else
            isSolved = rhoNext > 0 && solver.solve(rho, rhoNext);
        if (isSolved && !recursion.isFarBelowBound(rhoNext))
            return;
        isRescued = true; // the sum gave no step, or one far above the maximum
    }
    rhoNext = bounded;
    if (!solver.solve(rho, rhoNext)) {
        isRescued = false;
        throwNotConverged();
    }
    numRescues += isRescued;
}

std::string MonitorControl::explainStep() const {
    if (!hasDensity || monitor.getTerms().empty())
        return "";
    std::stringstream text;
    text << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
         << settings.stepSize / rhoNext << " ps";
    return text.str();
}

bool MonitorControl::seesHalfStep() const {
    return needsHalfStep() && solver.kind != StepSolver::Shortened;
}

ConstraintSolver::HalfStep* MonitorControl::lookBack() {
    if (solver.kind == StepSolver::First && !isConstant())
        firstStep.lookBack(values, needsHalfStep());
    return seesHalfStep() ? &atHalfStep : nullptr;
}

ConstraintSolver::Observer* MonitorControl::observe(const ConstraintSolver::OnStep& end) {
    monitor.observe(end);
    return &monitor;
}

bool MonitorControl::measure() {
    monitor.evaluate(solver.next, valuesNext);
    monitor.requireValid(valuesNext);
    if (seesHalfStep())
        monitor.evaluateHalfStep(solver.next, atHalfStep, valuesHalf);
    return solver.kind != StepSolver::First || isConstant() || firstStep.measure(valuesNext);
}

void MonitorControl::accept() {
    if (solver.kind == StepSolver::First)
        hasDensity = isConstant() || firstStep.accept(values);
    else if (solver.kind == StepSolver::Regular)
        densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    else if (hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, solver.size / (settings.stepSize / rhoNext));
    const double uNext = limit(valuesNext);
    hasHalfStepValue = seesHalfStep();
    if (hasHalfStepValue) {
        halfStepValue = limit(valuesHalf);
        // Along F - G^T Lambda, which the last half of the kick has gone along.
        rate = (uNext - halfStepValue) / (0.5 * solver.size);
    }
    values.swap(valuesNext);
    monitor.movedTo(now);
    if (hasDensity || solver.kind == StepSolver::First)
        rho = rhoNext;
    if (hasDensity)
        u = uNext;
}

void MonitorControl::abandon() {
    numRescues -= isRescued;
    isRescued = false;
    if (!hasDensity)
        firstStep.abandon();
}
