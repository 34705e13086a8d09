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

// A relative change of u that starts no oscillation to speak of: the density is not scaled for it, which would cost reversibility.
const double SMALL_JUMP = 0.01;

// The smooth sequence's value half a step after the start, from the values at the start, one step ahead and one back.
double startValue(double start, double ahead, const double* back) {
    const double value = back != nullptr ? start + 0.25 * (ahead - *back) : 0.5 * (start + ahead);
    // What changes by its own size within the first step is not resolved: take it as it is.
    return value > 0.5 * start && value < 2 * start ? value : start;
}

} // namespace

MonitorControl::MonitorControl(ConstraintSolver& constraints, StepSolver& solver, const StepState& now) :
        StepControl(constraints, solver, now), monitor(constraints), mustForget(false), isMonitorCurrent(false),
        numRescues(0), seenForces(nullptr), seenMultipliers(nullptr), seenRightSide(nullptr), seenHalf(nullptr),
        sums(monitor.makeSums()), halfSums(sums), densityScale(1), isRescued(false), isStart(false), hasBack(false),
        isCalm(false), firstDensity(0) {
    const ConstraintSystem& system = constraints.getSystem();
    for (vector<double>* numbers : {&multiplierTrial, &rightSideTrial, &back.lambda, &back.rightSide})
        numbers->resize(system.getNumConstraints());
    for (vector<Vec3>* vectors : {&back.q, &back.w, &back.v, &back.force})
        vectors->resize(system.getNumParticles());
}

// -------------------------------------------------------------------------------------------------------- the settings

bool MonitorControl::setSettings(const StepSettings& next, bool isInForce) {
    const bool isOther =
        !isInForce || next.isFixedStep != settings.isFixedStep ||
        !std::equal(next.terms.begin(), next.terms.end(), settings.terms.begin(), settings.terms.end(),
                    [](const StepMonitor::Term& a, const StepMonitor::Term& b) { return a.isLike(b); });
    vector<StepMonitor::Term> terms = next.terms;
    bool areReferencesSame = true;
    mustForget = isOther;
    for (size_t k = 0; k < terms.size() && !isOther; k++) {
        const double given = settings.terms[k].reference, inForce = monitor.getTerms()[k].reference;
        if (terms[k].reference == 0 && given == 0)
            terms[k].reference = inForce; // taken at the first step, and so it stays
        else if (terms[k].reference == 0)
            mustForget = true;
        areReferencesSame = areReferencesSame && terms[k].reference == inForce;
    }
    const bool goesOn = !mustForget && areReferencesSame && next.stepSize == settings.stepSize &&
                        next.minimumStep == settings.minimumStep && next.maximumStep == settings.maximumStep &&
                        next.update == settings.update;
    applySettings(next, terms);
    return goesOn;
}

void MonitorControl::applySettings(const StepSettings& newSettings, const vector<StepMonitor::Term>& terms) {
    settings = newSettings;
    monitor.setTerms(terms);
    density = StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep);
}

void MonitorControl::changeSettings() {
    isMonitorCurrent = false;
    look();
    rate = 0; // only the speed of convergence of the next step depends on it
    if (mustForget)
        forget();
    else
        rescaleDensity(u);
}

vector<double> MonitorControl::getReferences() const {
    vector<double> references;
    for (const StepMonitor::Term& term : monitor.getTerms())
        references.push_back(term.reference);
    return references;
}

void MonitorControl::setReferences(const vector<double>& references) {
    for (size_t k = 0; k < references.size(); k++)
        monitor.setReference((int) k, references[k]);
}

void MonitorControl::getMemory(StepMemory& memory) const {
    static_cast<MonitorMemory&>(memory) = *this;
    memory.hasDensity = hasDensity;
    memory.density = rho;
    memory.references = getReferences();
    memory.monitorValues = values;
}

void MonitorControl::setMemory(const StepSettings& newSettings, const StepMemory& memory) {
    static_cast<MonitorMemory&>(*this) = memory;
    applySettings(newSettings, newSettings.terms);
    setReferences(memory.references);
    hasDensity = memory.hasDensity;
    rho = memory.density;
    values = memory.monitorValues;
    firstDensity = 0;
    isMonitorCurrent = false;
}

// -------------------------------------------------------------------------------------------- u, and between two steps

void MonitorControl::ensureMonitor() {
    if (!isMonitorCurrent)
        monitor.setForces(now.force, now.groupEnergy);
    isMonitorCurrent = true;
}

// U_k at the present state
void MonitorControl::look() {
    ensureMonitor();
    sums = monitor.sum(now.lambda, now.rightSide);
    monitor.evaluate(now.v, now.lambda, sums, values);
    hasHalfStepValue = false;
}

double MonitorControl::limit(const vector<double>& monitorValues) const {
    return settings.isFixedStep ? 1.0 : density.limit(monitor.combine(monitorValues));
}

// u(q,p) with Lambda(q,p) (4.3)
double MonitorControl::evaluateU(const vector<Vec3>& velocities, const ExpressionParameters& theta) {
    constraints.findMultipliers(velocities, theta, multiplierTrial, rightSideTrial);
    sums = monitor.sum(multiplierTrial, rightSideTrial);
    return evaluate(velocities, multiplierTrial);
}

double MonitorControl::evaluate(const vector<Vec3>& w, const vector<double>& multipliers) {
    ensureMonitor();
    monitor.evaluate(w, multipliers, sums, valuesTrial);
    return limit(valuesTrial);
}

void MonitorControl::begin() {
    forget();
    densityOffset = 0;
    seenForces = nullptr;
    measureAt(now, now.force, now.groupEnergy, values);
    isMonitorCurrent = true;
    back.q = now.q; // for the sake of particles without mass, which stay as they are
    back.w = back.v = now.v;
}

void MonitorControl::change(ChangeKind kind, double) {
    if (!hasDensity)
        forget();
    if (kind == Everything && !hasDensity) {
        begin();
        return;
    }
    if (kind == Frame && !monitor.usesVelocities())
        return;
    if (kind == Everything || kind == Forces)
        isMonitorCurrent = false;
    const double oldU = u;
    look();
    if (kind == Everything || kind == Forces)
        monitor.requireValid(values);
    if (kind == Everything)
        densityOffset = 0;
    rescaleDensity(oldU);
}

// After a jump of the state: rho keeps its ratio to u, so that it starts no oscillation.
void MonitorControl::rescaleDensity(double oldU) {
    if (!hasDensity)
        return;
    u = limit(values);
    if (u > 0 && oldU > 0)
        rho *= u / oldU;
    else
        forget();
}

void MonitorControl::forget() {
    forgetDensity();
    firstDensity = 0;
}

void MonitorControl::adopt(double newDensity, const double* value, double offset) {
    hasDensity = true;
    rho = newDensity;
    if (value != nullptr)
        halfStepValue = *value;
    densityOffset = offset;
}

void MonitorControl::reverse() {
    densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    rho = rhoNext;
    rate = -rate;
    numRescues -= isRescued;
    isRescued = false;
    hasHalfStepValue = needsHalfStep();
    if (hasHalfStepValue) // it is of the step that would have come, and even in p and the rates
        halfStepValue = evaluateU(now.w, solver.parametersAtRateOf(settings.stepSize / rhoNext));
}

// ------------------------------------------------------------------------------------------------------------- a step

void MonitorControl::prepare() {
    densityScale = 1;
    isRescued = false;
    ensureMonitor(); // after a step that has failed it may have the forces still
    if (!hasDensity && firstDensity == 0)
        referencesBefore = getReferences();
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
    auto solveWith = [&](double next) {
        rhoNext = next;
        return solver.solve(rho, rhoNext);
    };
    const double explicitNext = densityScale * StepDensity::sumUpdate(u, rho);
    const double bounded = isConstant() ? 1.0 : density.boundedUpdate(densityScale * u, densityScale * rho);
    if (!isConstant() && settings.update != StepDensity::Bounded) {
        bool isSolved;
        if (needsHalfStep()) {
            const double known = densityScale * (rho - findHalfStepValue());
            isSolved = solver.solve(*this, {rho, known, explicitNext, densityOffset, rate, bounded}, rhoNext);
        }
        else
            isSolved = explicitNext > 0 && solveWith(explicitNext);
        if (isSolved && !density.isFarBelowBound(rhoNext))
            return;
        isRescued = true; // the sum gave no step, or one far above the maximum
    }
    if (!solveWith(bounded)) {
        isRescued = false;
        throwNotConverged();
    }
    numRescues += isRescued;
}

ConstraintSolver::Observer* MonitorControl::observeTrial(const vector<double>& multipliers,
                                                         const vector<double>& rightSide) {
    seenForces = nullptr;
    seenMultipliers = &multipliers;
    seenRightSide = &rightSide;
    seenHalf = nullptr;
    return this;
}

void MonitorControl::findGradient(const vector<Vec3>& w, const ExpressionParameters& theta,
                                  const vector<double>& multipliers, vector<Vec3>& gradient) {
    monitor.evaluateGradient(theta, w, multipliers, valuesTrial, gradient);
    const double derivative = density.limitDerivative(monitor.combine(valuesTrial));
    for (Vec3& each : gradient)
        each *= derivative;
}

std::string MonitorControl::explainStep() const {
    if (!hasDensity || monitor.getTerms().empty())
        return "";
    std::stringstream text;
    text << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
         << settings.stepSize / rhoNext << " ps";
    return text.str();
}

ConstraintSolver::Observer* MonitorControl::observe(const ConstraintSolver::OnStep& end) {
    isMonitorCurrent = false;
    observeTrial(end.multipliers, end.rightSide);
    seenForces = &end.forces;
    seenHalf = end.atHalfStep;
    return this;
}

void MonitorControl::seeParticles(int block) {
    if (seenForces != nullptr)
        monitor.sumForces(*seenForces, block);
}

void MonitorControl::seeConstraints(int range, int first, int end) {
    monitor.sumRange(*seenMultipliers, *seenRightSide, range, first, end, sums);
    if (seenHalf != nullptr)
        monitor.sumRange(seenHalf->multipliers, seenHalf->rightSide, range, first, end, halfSums);
}

// The monitors at a state that has been observed, or has not.
void MonitorControl::measureAt(const StepState& state, const vector<Vec3>& forces, double energy,
                               vector<double>& monitorValues) {
    const bool isSeen = seenForces == &forces;
    monitor.setForces(forces, energy, isSeen);
    if (!isSeen)
        sums = monitor.sum(state.lambda, state.rightSide);
    seenForces = nullptr;
    if (!monitor.hasFiniteForces())
        throw StepFailure("the force on a particle is infinite or not a number");
    monitor.evaluate(state.v, state.lambda, sums, monitorValues);
    monitor.requireValid(monitorValues);
}

bool MonitorControl::measure(const End& end) {
    measureAt(end.state, end.forces, end.groupEnergy, valuesNext);
    if (end.atHalfStep != nullptr)
        monitor.evaluate(end.state.w, end.atHalfStep->multipliers, halfSums, valuesHalf);
    return !isStart || startDensity();
}

void MonitorControl::accept(const End& end) {
    if (end.kind == First && isCalm)
        for (size_t k = 0; k < values.size(); k++)
            if (monitor.getTerms()[k].reference == 0 && !isNegligible[k])
                monitor.setReference((int) k, values[k]);
    if (end.kind == Regular)
        densityOffset = rhoNext - densityScale * StepDensity::sumUpdate(u, rho);
    if (end.kind == Shortened && hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, end.size / (settings.stepSize / rhoNext));
    hasHalfStepValue = end.atHalfStep != nullptr;
    if (hasHalfStepValue) {
        halfStepValue = limit(valuesHalf);
        // Along F - G^T Lambda, which the last half of the kick has gone along.
        rate = (limit(valuesNext) - halfStepValue) / (0.5 * end.size);
    }
}

void MonitorControl::settle(StepKind kind) {
    values.swap(valuesNext);
    monitor.forcesMoved(now.force);
    isMonitorCurrent = true;
    if (kind == First) {
        hasDensity = !isCalm;
        firstDensity = 0;
        rho = rhoNext;
    }
    if (hasDensity) {
        rho = rhoNext;
        u = limit(values);
    }
}

void MonitorControl::abandon() {
    numRescues -= isRescued;
    isRescued = false;
    if (!hasDensity)
        setReferences(referencesBefore);
    firstDensity = 0;
}

// ------------------------------------------------------------------------------------------------------- the start

/*
 * The recursion of the density keeps an oscillation of rho about u for ever, so it must start without one. The smooth
 * solution is rho[1/2] = u0 + (u1 - u-1)/4 + O(h^3), u0 being u(q0,p0), or for (3.14) the mean of u(q0,p1/2) and
 * u(q0,p-1/2); which follows from docs/method.md, section 7. The first step is a step of
 * plain RATTLE from the on-step state, which gives u1 with the one force evaluation that the step costs anyway; u-1
 * comes from a step backwards, whose forces are extrapolated along the path from those at q0 and q1, exactly so where
 * the motion starts at rest (and then q-1 = q1) or the forces are constant.
 *
 * Where no reference value is given, rho[1/2] = 1 and it is the reference value that is chosen such that this is the
 * smooth start: no force evaluation is spent on it. Where one is given, rho[1/2] follows, and the first step is taken
 * again with it.
 *
 * A monitor that is zero at the start, but for rounding, asks for nothing and is no measure of what comes. As long as all are so, or
 * one that has no reference value, steps are single ones of plain RATTLE, and the sequence of densities starts after them.
 */
void MonitorControl::findFirstDensity() {
    isCalm = false;
    rhoNext = 1;
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    if (isConstant())
        return;
    if (firstDensity > 0) {
        rhoNext = firstDensity;
        return;
    }
    double farthest = 0;
    for (int i : constraints.getMovingParticles())
        farthest = std::max(farthest, std::sqrt(now.q[i].dot(now.q[i])));
    const double speed = std::numeric_limits<double>::epsilon() * farthest / settings.stepSize;
    isNegligible.resize(terms.size());
    bool areAllNegligible = true, areAllUnknown = true, areAllKnown = true;
    for (size_t k = 0; k < terms.size(); k++) {
        isNegligible[k] = monitor.isNegligible((int) k, values[k], now.v, speed, speed / settings.stepSize);
        areAllNegligible = areAllNegligible && isNegligible[k];
        const bool isKnown = terms[k].reference > 0;
        areAllUnknown = areAllUnknown && !isKnown;
        areAllKnown = areAllKnown && isKnown;
        isCalm = isCalm || (isNegligible[k] && !isKnown);
    }
    isCalm = isCalm || areAllNegligible;
    if (!areAllNegligible && !areAllUnknown && (areAllKnown || isCalm))
        rhoNext = limit(values);
}

void MonitorControl::lookBack(const vector<Vec3>& forces, double energy, StepKind kind, double size) {
    isStart = kind == First && !isCalm && !isConstant();
    if (!isStart)
        return;
    hasBack = lookBehind(forces, energy, size);
    startValues = values;
    if (!hasBack || !needsHalfStep())
        return;
    // The mean of U_k(q0,p) over the half-step momenta on either side of the start, which is what (3.14) takes.
    const ExpressionParameters& theta = solver.parametersAtRateOf(size);
    isMonitorCurrent = false; // it has the forces behind
    evaluateU(solver.next.w, theta);
    startValues = valuesTrial;
    evaluateU(back.w, theta);
    for (size_t k = 0; k < startValues.size(); k++)
        startValues[k] = 0.5 * (startValues[k] + valuesTrial[k]);
}

// The state a step behind the start, if there is one.
bool MonitorControl::lookBehind(const vector<Vec3>& forces, double energy, double size) {
    if (!solver.solveBackwards(size, back))
        return false;
    const ConstraintSystem& system = constraints.getSystem();
    double product = 0, square = 0;
    for (int i : constraints.getMovingParticles()) {
        const Vec3 forward = solver.next.q[i] - now.q[i];
        product += system.getMasses()[i] * forward.dot(back.q[i] - now.q[i]);
        square += system.getMasses()[i] * forward.dot(forward);
    }
    const double alpha = square > 0 ? product / square : 0.0;
    for (int i = 0; i < system.getNumParticles(); i++)
        back.force[i] = now.force[i] + (forces[i] - now.force[i]) * alpha;
    try {
        const ConstraintSolver::OnStep end = {back.q, back.w,      back.force,     back.theta, -0.5 * size,
                                              back.v, back.lambda, back.rightSide, nullptr};
        constraints.finish(end, observe(end));
        measureAt(back, back.force, now.groupEnergy + alpha * (energy - now.groupEnergy), backValues);
    }
    catch (const StepFailure&) {
        return false;
    }
    return true;
}

// Returns whether the first step stands; if not, firstDensity says with which density to take it again.
bool MonitorControl::startDensity() {
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    const bool areAllTaken =
        std::all_of(terms.begin(), terms.end(), [](const StepMonitor::Term& term) { return term.reference == 0; });
    for (size_t k = 0; k < terms.size(); k++)
        if (terms[k].reference == 0)
            monitor.setReference((int) k,
                                 startValue(startValues[k], valuesNext[k], hasBack ? &backValues[k] : nullptr));
    if (areAllTaken) {
        if (hasBack)
            scaleReferences();
        return true;
    }
    if (firstDensity > 0)
        return true;
    const double back = hasBack ? limit(backValues) : 0.0;
    firstDensity = startValue(limit(startValues), limit(valuesNext), hasBack ? &back : nullptr);
    return std::fabs(firstDensity - rhoNext) <= 1e-12 * rhoNext;
}

// With rho[1/2] = 1 the steps to either side have the size h, and not h/u0, so that the change of u over a step of the
// sequence is theirs over u0. Scale the references such that u0 + (u1 - u-1)/(4 u0) = 1.
void MonitorControl::scaleReferences() {
    const vector<double> references = getReferences();
    auto mismatchOf = [&](double scale) {
        for (size_t k = 0; k < references.size(); k++)
            monitor.setReference((int) k, scale * references[k]);
        const double start = limit(startValues);
        return start + 0.25 * (limit(valuesNext) - limit(backValues)) / start - 1;
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
