// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/VRattleDynamics.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Differences of the velocities of particles that are the same but for the rounding of both.
const double FRAME_ROUNDING = 4 * std::numeric_limits<double>::epsilon();
// A step asked to end at a given time may be longer than the density says by this fraction, so that no sliver is left.
const double SLIVER = 1e-6;
// A relative change of u, or of the velocities, that starts no oscillation to speak of: the density is not scaled for it, which would
// cost reversibility.
const double SMALL_JUMP = 0.01;

} // namespace

VRattleDynamics::VRattleDynamics(const vector<double>& masses, const vector<DistanceConstraint>& constraints,
                                 const vector<ExpressionConstraint>& expressions) :
        solver(masses, constraints, expressions), system(solver.getSystem()),
        movingParticles(solver.getMovingParticles()), monitor(solver), automatic(solver), settings(), groupEnergy(0),
        rho(1), u(1), hasDensity(false), hasHalfStepValue(false), halfStepValue(0), rate(0), densityOffset(0),
        firstDensity(0), isStartedNow(false), isCalm(false), isMonitorCurrent(false), stepKind(First), rhoNext(1),
        stepNext(0), kickNext(0), areParametersChanging(false), densityScale(1), isJump(false), isRescued(false),
        numNewtonIterations(0), numRescues(0) {
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    for (vector<Vec3>* vectors :
         {&w, &qNext, &wNext, &vNext, &acceleration, &gradient, &halfStepChange, &qBack, &wBack, &vBack, &forceBack})
        vectors->resize(numParticles);
    for (vector<double>* numbers :
         {&lambda, &rightSide, &multiplierOffset, &lambdaNext, &rightSideNext, &atHalfStep.multipliers,
          &atHalfStep.rightSide, &atHalfStep.rate, &multiplierTrial, &rightSideTrial, &correction, &coupling, &response,
          &lambdaOnStep, &lambdaBack, &rightSideBack})
        numbers->resize(numConstraints);
    theta = thetaNext = thetaHalf = thetaBack = system.getGivenParameters();
    target = parameterChange = theta.values;
    solver.moveTo(q, theta, force);
}

void VRattleDynamics::setParallel(const Parallel& newParallel, int numThreads) {
    solver.setParallel(newParallel, numThreads);
}

void VRattleDynamics::setSettings(const Settings& newSettings) {
    requireConstraintsFor(newSettings.terms);
    const bool sameControl = takeAutomaticReferences(newSettings) && newSettings.isAutomatic == settings.isAutomatic;
    bool sameTerms =
        newSettings.terms.size() == settings.terms.size() && newSettings.isFixedStep == settings.isFixedStep;
    bool retakeReference = false;
    vector<StepMonitor::Term> terms = newSettings.terms;
    for (size_t i = 0; i < terms.size() && sameTerms; i++) {
        const StepMonitor::Term& old = settings.terms[i];
        sameTerms = terms[i].kind == old.kind && terms[i].weight == old.weight && terms[i].power == old.power &&
                    terms[i].order == old.order;
        if (terms[i].reference == 0 && old.reference == 0)
            terms[i].reference = monitor.getTerms()[i].reference; // taken at the first step, and still in force
        else if (terms[i].reference == 0)
            retakeReference = true;
    }
    if (!sameTerms)
        terms = newSettings.terms;
    bool sameDensity = sameTerms && sameControl && !retakeReference && newSettings.stepSize == settings.stepSize &&
                       newSettings.minimumStep == settings.minimumStep &&
                       newSettings.maximumStep == settings.maximumStep && newSettings.update == settings.update;
    for (size_t i = 0; i < terms.size() && sameDensity; i++)
        sameDensity = terms[i].reference == monitor.getTerms()[i].reference;
    settings = newSettings;
    solver.setTolerance(settings.tolerance);
    setControlSettings();
    monitor.setTerms(terms);
    density = StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep);
    if (q.empty() || sameDensity)
        return;
    monitor.setForces(force, groupEnergy);
    monitor.evaluate(v, lambda, rightSide, values);
    rate = 0; // only the speed of convergence of the next step depends on it
    if (settings.isAutomatic && !sameControl)
        automatic.begin({q, theta, v, force, lambda});
    if (!sameTerms || !sameControl || retakeReference)
        forgetDensity();
    else
        rescaleDensity(u);
    if (hasDensity && settings.isAutomatic)
        rho = automatic.getLast(); // which the bound may have changed
    if (hasDensity)
        formHalfStepVelocities();
}

void VRattleDynamics::setControlSettings() {
    AutomaticControl::Settings control;
    control.stepSize = settings.stepSize;
    control.minimumStep = settings.minimumStep;
    control.learningSteps = settings.calibrationSteps;
    std::copy(std::begin(settings.automaticReferences), std::end(settings.automaticReferences), control.given);
    automatic.setSettings(control);
}

// Returns whether automatic step control has the references that it had.
bool VRattleDynamics::takeAutomaticReferences(const Settings& newSettings) {
    bool areSame = true;
    for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++) {
        const double given = newSettings.automaticReferences[k], old = automatic.getReference(k);
        const bool isKept = newSettings.isAutomatic && settings.isAutomatic && settings.automaticReferences[k] == 0 &&
                            newSettings.automaticRequest == settings.automaticRequest;
        const double reference = given == 0 && isKept ? old : given;
        areSame = areSame && reference == old;
        automatic.setReference(k, reference);
    }
    return areSame;
}

void VRattleDynamics::setReferences(const vector<double>& references) {
    for (size_t k = 0; k < references.size(); k++)
        if (settings.isAutomatic)
            automatic.setReference((int) k, references[k]);
        else
            monitor.setReference((int) k, references[k]);
}

// Whether the density is solved for together with the constraints, which takes u at half-step momenta.
bool VRattleDynamics::needsHalfStepValue() const {
    return settings.update == StepDensity::SemiExplicit && !settings.isFixedStep && monitor.dependsOnVelocities();
}

void VRattleDynamics::forgetDensity() {
    hasDensity = false;
    firstDensity = 0;
    rho = 1;
}

// After a jump of the state: rho keeps its ratio to u, so that it starts no oscillation.
void VRattleDynamics::rescaleDensity(double oldU) {
    if (!hasDensity || settings.isAutomatic)
        return;
    u = combineAndLimit(values);
    if (u > 0 && oldU > 0)
        rho *= u / oldU;
    else
        forgetDensity();
}

double VRattleDynamics::combineAndLimit(const vector<double>& monitorValues) const {
    return settings.isFixedStep ? 1.0 : density.limit(monitor.combine(monitorValues));
}

void VRattleDynamics::requireConstraintsFor(const vector<StepMonitor::Term>& terms) const {
    if (system.getNumConstraints() == 0 && StepMonitor::needConstraints(terms))
        throw StepFailure("a monitor of the constraint forces is set (ConstraintMultipliers is the default) and the "
                          "System has no constraints; choose a monitor of the applied forces, such as AppliedForce or "
                          "ForcePNorm, with clearMonitors() and addMonitor(), or call clearMonitors() for fixed steps");
}

// ------------------------------------------------------------------------------------------- between two steps

void VRattleDynamics::adoptParameters() {
    theta.values = target;
    areParametersChanging = false;
    solver.moveTo(q, theta, force);
}

void VRattleDynamics::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy) {
    const Kept before = keep();
    target = theta.values;
    std::fill(theta.rates.begin(), theta.rates.end(), 0.0);
    theta.isMoving = false;
    beginAt(positions, velocities, forces, energy, before);
}

void VRattleDynamics::beginAt(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                              double energy, const Kept& before) {
    q = positions;
    v = velocities;
    force = forces;
    groupEnergy = energy;
    // Particles without mass stay as they are, in whatever array is written.
    qNext = qBack = positions;
    w = wNext = wBack = vNext = vBack = velocities;
    forgetDensity();
    densityOffset = 0;
    std::fill(multiplierOffset.begin(), multiplierOffset.end(), 0.0);
    try {
        evaluateOnStep({q, velocities, force, theta, 0.0, v, lambda, rightSide, nullptr}, groupEnergy, values);
    }
    catch (...) {
        putBack(before);
        throw;
    }
    isMonitorCurrent = true;
    if (settings.isAutomatic)
        automatic.begin({q, theta, v, force, lambda});
}

void VRattleDynamics::adopt(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy, double newDensity, const double* newHalfStepValue, double offset) {
    begin(positions, velocities, forces, energy);
    hasDensity = true;
    rho = newDensity;
    formHalfStepVelocities();
    // What a step that has led here would have found.
    qNext = q;
    wNext = w;
    rhoNext = rho;
    kickNext = 0.5 * settings.stepSize / rho;
    stepKind = Regular;
    lambdaNext = lambda;
    vector<Vec3> copy = forces;
    finish(copy, energy);
    v = velocities; // which have been projected, and so changed in the last bits
    if (newHalfStepValue != nullptr)
        halfStepValue = *newHalfStepValue;
    densityOffset = offset;
}

double VRattleDynamics::findHalfStepValue() {
    if (needsHalfStepValue() && !hasHalfStepValue) {
        halfStepValue = evaluateU(w, theta);
        hasHalfStepValue = true;
    }
    return halfStepValue;
}

void VRattleDynamics::startAutomatic() {
    controlBefore = automatic.getMemory();
    isStartedNow = true;
    automatic.start();
    hasDensity = true;
    rho = automatic.getLast();
    formHalfStepVelocities();
}

VRattleDynamics::Memory VRattleDynamics::getMemory() const {
    Memory memory = {hasDensity,
                     rho,
                     w,
                     theta.values,
                     theta.rates,
                     multiplierOffset,
                     {},
                     lambda,
                     values,
                     hasHalfStepValue,
                     u,
                     halfStepValue,
                     rate,
                     densityOffset,
                     automatic.getMemory()};
    memory.references = getReferences();
    return memory;
}

vector<double> VRattleDynamics::getReferences() const {
    vector<double> references;
    if (settings.isAutomatic)
        for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
            references.push_back(automatic.getReference(k));
    else
        for (const StepMonitor::Term& term : monitor.getTerms())
            references.push_back(term.reference);
    return references;
}

VRattleDynamics::Kept VRattleDynamics::keep() const {
    return {settings, q, v, force, groupEnergy, target, getMemory(), rightSide};
}

void VRattleDynamics::putBack(const Kept& kept) {
    settings = kept.settings;
    solver.setTolerance(settings.tolerance);
    setControlSettings();
    monitor.setTerms(settings.terms);
    density = StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep);
    q = kept.positions;
    v = kept.velocities;
    force = kept.forces;
    groupEnergy = kept.groupEnergy;
    target = kept.target;
    rightSide = kept.rightSide;
    setMemory(kept.memory);
    solver.moveTo(q, theta, force);
    isMonitorCurrent = false;
}

void VRattleDynamics::setMemory(const Memory& memory) {
    theta.values = memory.parameters;
    theta.rates = memory.parameterRates;
    theta.isMoving = std::any_of(theta.rates.begin(), theta.rates.end(), [](double rate) { return rate != 0; });
    lambda = memory.multipliers;
    values = memory.monitorValues;
    setReferences(memory.references);
    if (settings.isAutomatic)
        automatic.setMemory(memory.automatic);
    hasDensity = memory.hasDensity;
    rho = memory.density;
    w = memory.halfStepVelocities;
    multiplierOffset = memory.multiplierOffset;
    hasHalfStepValue = memory.hasHalfStepValue;
    u = memory.u;
    halfStepValue = memory.halfStepValue;
    rate = memory.rate;
    densityOffset = memory.densityOffset;
    firstDensity = 0;
}

void VRattleDynamics::resume(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                             double energy, const Memory& memory) {
    const Kept before = keep();
    setMemory(memory); // with the parameters
    beginAt(positions, velocities, forces, energy, before);
    v = velocities; // this has projected them, which changes the last bits
    setMemory(memory);
}

void VRattleDynamics::changeState(const vector<Vec3>& positions, const vector<Vec3>& velocities,
                                  const vector<Vec3>& forces, double energy) {
    const bool hadDensity = hasDensity;
    const double oldRho = rho, oldU = u;
    const AutomaticControl::Memory oldControl = automatic.getMemory();
    beginAt(positions, velocities, forces, energy, keep());
    if (!hadDensity)
        return;
    hasDensity = true;
    rho = oldRho;
    rescaleDensity(oldU);
    if (settings.isAutomatic) {
        automatic.setMemory(oldControl);
        automatic.change({q, theta, v, force, lambda}, 1.0);
        rho = automatic.getLast();
    }
    if (hasDensity)
        formHalfStepVelocities();
}

bool VRattleDynamics::changeFrame(const vector<Vec3>& velocities) {
    ensureMonitor();
    if (!system.isTranslationInvariant() || movingParticles.empty())
        return false;
    const Vec3 shift = velocities[movingParticles[0]] - v[movingParticles[0]];
    auto sizeOf = [](const Vec3& x) { return std::fabs(x[0]) + std::fabs(x[1]) + std::fabs(x[2]); };
    const double reference = sizeOf(shift) + sizeOf(v[movingParticles[0]]);
    for (int i : movingParticles)
        if (!(sizeOf(velocities[i] - v[i] - shift) <= FRAME_ROUNDING * (reference + sizeOf(v[i]))))
            return false;
    for (int i : movingParticles) {
        v[i] = velocities[i];
        w[i] += shift;
    }
    if (monitor.usesVelocities()) {
        monitor.evaluate(v, lambda, rightSide, values);
        hasHalfStepValue = false;
        rescaleDensity(u);
    }
    if (settings.isAutomatic)
        automatic.change({q, theta, v, force, lambda}, 0.0);
    return true;
}

void VRattleDynamics::changeVelocities(const vector<Vec3>& velocities) {
    vector<Vec3>& change = vNext;
    for (int i : movingParticles)
        change[i] = velocities[i] - v[i];
    solver.projectVelocities(change);
    double changeSquared = 0, speedSquared = 1e-100; // in the mass metric
    for (int i : movingParticles) {
        changeSquared += system.getMasses()[i] * change[i].dot(change[i]);
        v[i] += change[i];
        speedSquared += system.getMasses()[i] * v[i].dot(v[i]);
        w[i] += change[i];
    }
    evaluateU(v, theta);
    takeTrialValues();
    rescaleDensity(u);
    // The density of the last step stays, for its kick is in w.
    if (settings.isAutomatic)
        automatic.change({q, theta, v, force, lambda}, std::min(1.0, std::sqrt(changeSquared / speedSquared)));
}

void VRattleDynamics::changeForces(vector<Vec3>& forces, double energy) {
    double changeSquared = 0, forceSquared = 1e-100; // in the mass metric
    for (int i : movingParticles) {
        const Vec3 change = forces[i] - force[i];
        changeSquared += system.getInverseMasses()[i] * change.dot(change);
        forceSquared += system.getInverseMasses()[i] * std::max(forces[i].dot(forces[i]), force[i].dot(force[i]));
    }
    if (!std::isfinite(changeSquared))
        throw StepFailure("the force on a particle is infinite or not a number");
    auto exchange = [&] {
        force.swap(forces);
        std::swap(groupEnergy, energy);
        solver.moveTo(q, theta, force);
        isMonitorCurrent = false;
    };
    exchange();
    try {
        evaluateU(v, theta);
        monitor.requireValid(valuesTrial);
    }
    catch (const StepFailure&) {
        exchange();
        throw;
    }
    takeTrialValues();
    if (!hasDensity) {
        forgetDensity();
        if (settings.isAutomatic)
            automatic.begin({q, theta, v, force, lambda});
        return;
    }
    rescaleDensity(u);
    if (settings.isAutomatic) {
        automatic.change({q, theta, v, force, lambda}, std::min(1.0, std::sqrt(changeSquared / forceSquared)));
        rho = automatic.getLast();
    }
    if (hasDensity)
        formHalfStepVelocities();
}

// What evaluateU() has found at (q[n],p[n]) is Lambda and U_k there.
void VRattleDynamics::takeTrialValues() {
    lambda = multiplierTrial;
    rightSide = rightSideTrial;
    values = valuesTrial;
    hasHalfStepValue = false;
}

// p[n-1/2] = p[n] + (h/(2 rho)) (grad V + G^T Lambda)   (docs/method.md, section 7)
void VRattleDynamics::formHalfStepVelocities() {
    const double kick = 0.5 * settings.stepSize / rho;
    const vector<double>& inverseMasses = system.getInverseMasses();
    for (int i : movingParticles)
        w[i] = v[i] - force[i] * (kick * inverseMasses[i]);
    solver.addTransposedOverMass(lambda, kick, w);
    hasHalfStepValue = false;
}

// ------------------------------------------------------------------------------------------------------- the steps

double VRattleDynamics::step(double maxStep) {
    solver.beginStep();
    isRescued = false;
    ensureMonitor(); // of a step before that has failed, the monitor may have the forces still
    isStartedNow = false;
    prepareParameters();
    findJump();
    double full;
    if (!hasDensity)
        referencesBefore = firstDensity == 0 ? getReferences() : referencesBefore;
    if (!hasDensity && settings.isAutomatic && !settings.isFixedStep)
        startAutomatic();
    if (hasDensity) {
        stepKind = Regular;
        full = solveRegular();
    }
    else {
        stepKind = First;
        rhoNext = firstDensity > 0 ? firstDensity : findFirstDensity();
        full = settings.stepSize / rhoNext;
        if (!std::isfinite(full))
            throw StepFailure("the monitor is zero and there is no maximum step size; set one");
    }
    const bool isShortened = full > maxStep || std::fabs(full - maxStep) <= SLIVER * full;
    stepNext = isShortened ? maxStep : full;
    if (stepKind == First || isShortened) {
        // A step of plain RATTLE from the on-step state.
        if (isShortened)
            stepKind = Shortened;
        const ConstraintSolver::Trial trial = trialTo(0.5 * stepNext, stepNext, v);
        if (!solvePositions(trial, true))
            throwNotConverged(trial);
    }
    setRates(thetaNext, stepNext);
    if (isShortened && hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, stepNext / full);
    kickNext = 0.5 * stepNext;
    return stepNext;
}

// theta[n+1] and the way to it.
void VRattleDynamics::prepareParameters() {
    densityScale = 1;
    isJump = false;
    areParametersChanging = target != theta.values;
    thetaNext.values = target;
    thetaHalf.values = theta.values;
    if (areParametersChanging)
        system.findParameterChange(q, theta, target, parameterChange);
    else
        std::fill(parameterChange.begin(), parameterChange.end(), 0.0);
}

// The rates of parameters that move in a step of that size.
void VRattleDynamics::setRates(ExpressionParameters& parameters, double size) const {
    parameters.isMoving = areParametersChanging;
    for (size_t k = 0; k < parameterChange.size(); k++)
        parameters.rates[k] = parameterChange[k] / size;
}

/*
 * Where parameters begin to move, or stop, the velocities along the constraints jump in the step that comes, and u with them. As
 * after any other jump of the state the density keeps its ratio to u: in the next update u[n], rho[n-1/2] and u(q[n],p[n-1/2]) are
 * all scaled with what u becomes with the new velocities; the densities of automatic step control start from their monitors at the
 * end of the step. Where rates change little by little u follows, and nothing is done.
 */
void VRattleDynamics::findJump() {
    const bool isVariable = hasDensity && !settings.isFixedStep && (settings.isAutomatic || !monitor.isEmpty());
    if (!isVariable || !(areParametersChanging || theta.isMoving))
        return;
    setRates(thetaHalf, settings.stepSize / rho);
    bool isSudden = false;
    for (size_t k = 0; k < parameterChange.size(); k++) {
        const double before = theta.rates[k];
        double& rate = thetaHalf.rates[k];
        if (std::fabs(rate - before) > 0.5 * std::max(std::fabs(rate), std::fabs(before)))
            isSudden = true;
        else
            rate = before;
    }
    if (!isSudden)
        return;
    double changeSquared = 0, speedSquared = 1e-100; // in the mass metric
    for (int i : movingParticles)
        vNext[i] = Vec3();
    solver.addProjection(v, thetaHalf, vNext);
    for (int i : movingParticles) {
        changeSquared += system.getMasses()[i] * vNext[i].dot(vNext[i]);
        vNext[i] += v[i];
        speedSquared += system.getMasses()[i] * std::max(vNext[i].dot(vNext[i]), v[i].dot(v[i]));
    }
    isJump = changeSquared > SMALL_JUMP * SMALL_JUMP * speedSquared;
    const double scale = evaluateU(vNext, thetaHalf) / u;
    if (std::isfinite(scale) && scale > 0 && std::fabs(scale - 1) > SMALL_JUMP)
        densityScale = scale;
}

bool VRattleDynamics::finish(vector<Vec3>& forces, double energy) {
    const bool isStart = stepKind == First && !isCalm && !settings.isFixedStep && !monitor.isEmpty();
    vector<double> backValues, startValues;
    bool hasBack = false;
    if (isStart) {
        hasBack = evaluateBackwards(forces, energy, backValues);
        startValues = hasBack && needsHalfStepValue() ? evaluateHalfSteps() : values;
    }
    const bool withHalfStep = needsHalfStepValue() && stepKind != Shortened;
    evaluateOnStep({qNext, wNext, forces, thetaNext, kickNext, vNext, lambdaOnStep, rightSideNext,
                    withHalfStep ? &atHalfStep : nullptr},
                   energy, valuesNext);
    if (isStart && !startDensityFrom(startValues, backValues, hasBack))
        return false;
    if (settings.isAutomatic)
        automatic.measure({qNext, thetaNext, vNext, forces, lambdaOnStep}, wNext, stepNext, force);
    // From here on nothing fails.
    solver.endStep();
    if (stepKind == First && isCalm)
        for (size_t k = 0; k < values.size(); k++)
            if (monitor.getTerms()[k].reference == 0 && !isNegligible[k])
                monitor.setReference((int) k, values[k]);
    if (settings.isAutomatic)
        acceptAutomatic();
    if (stepKind == Regular)
        keepOffsets();
    hasHalfStepValue = withHalfStep;
    if (withHalfStep) {
        halfStepValue = combineAndLimit(valuesHalf);
        rate = evaluateRate();
    }

    q.swap(qNext);
    std::swap(theta, thetaNext);
    v.swap(vNext);
    w.swap(wNext);
    force.swap(forces);
    groupEnergy = energy;
    lambda.swap(lambdaOnStep);
    rightSide.swap(rightSideNext);
    values.swap(valuesNext);
    solver.moveToEnd();
    monitor.forcesMoved(force);
    isMonitorCurrent = true;
    if (stepKind == First) {
        hasDensity = !isCalm;
        firstDensity = 0;
        rho = rhoNext;
    }
    if (hasDensity) {
        rho = rhoNext;
        u = combineAndLimit(values);
    }
    if (settings.isAutomatic && hasDensity && isJump)
        automatic.change({q, theta, v, force, lambda}, 1.0);
    if (hasDensity && stepKind == Shortened)
        formHalfStepVelocities();
    return true;
}

void VRattleDynamics::abandonStep() {
    numRescues -= isRescued;
    isRescued = false;
    if (isStartedNow) {
        automatic.setMemory(controlBefore);
        forgetDensity();
    }
    if (!hasDensity)
        setReferences(referencesBefore);
    firstDensity = 0;
}

void VRattleDynamics::acceptAutomatic() {
    if (settings.isFixedStep || !hasDensity)
        automatic.acceptMeasured();
    else if (stepKind == Regular)
        automatic.acceptStep();
    else {
        automatic.acceptPartOfStep(std::min(1.0, stepNext * automatic.getNext() / settings.stepSize));
        rhoNext = automatic.getLast();
    }
}

void VRattleDynamics::reverse() {
    ensureMonitor();
    if (hasDensity) {
        const long long rescuesBefore = numRescues;
        prepareParameters();
        const double size = solveRegular();
        keepOffsets();
        numRescues = rescuesBefore;
        for (int i : movingParticles)
            w[i] = -wNext[i];
        rho = rhoNext;
        automatic.reverse();
        rate = -rate;
        hasHalfStepValue = needsHalfStepValue();
        if (hasHalfStepValue) { // it is of the step that would have come, and even in p and the rates
            setRates(thetaHalf, size);
            halfStepValue = evaluateU(w, thetaHalf);
        }
    }
    for (int i : movingParticles)
        v[i] = -v[i];
    for (double& each : theta.rates)
        each = -each;
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
double VRattleDynamics::findFirstDensity() {
    isCalm = false;
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    if (settings.isFixedStep || terms.empty())
        return 1;
    double farthest = 0;
    for (int i : movingParticles)
        farthest = std::max(farthest, std::sqrt(q[i].dot(q[i])));
    const double speed = std::numeric_limits<double>::epsilon() * farthest / settings.stepSize;
    isNegligible.resize(terms.size());
    bool areAllNegligible = true, areAllUnknown = true, areAllKnown = true;
    for (size_t k = 0; k < terms.size(); k++) {
        isNegligible[k] = monitor.isNegligible((int) k, values[k], v, speed, speed / settings.stepSize);
        areAllNegligible = areAllNegligible && isNegligible[k];
        const bool isKnown = terms[k].reference > 0;
        areAllUnknown = areAllUnknown && !isKnown;
        areAllKnown = areAllKnown && isKnown;
        isCalm = isCalm || (isNegligible[k] && !isKnown);
    }
    isCalm = isCalm || areAllNegligible;
    if (areAllNegligible || areAllUnknown)
        return 1;
    return areAllKnown || isCalm ? combineAndLimit(values) : 1.0;
}

bool VRattleDynamics::evaluateBackwards(const vector<Vec3>& forces, double energy, vector<double>& backValues) {
    // Where the parameters are moving they come from where they would be at the same rate.
    setRates(thetaBack, stepNext);
    for (size_t k = 0; k < target.size(); k++)
        thetaBack.values[k] = theta.values[k] - parameterChange[k];
    if (!solvePositions({v, -0.5 * stepNext, -stepNext, thetaBack, qBack, wBack, lambdaNext}, true))
        return false;
    double product = 0, square = 0;
    for (int i : movingParticles) {
        Vec3 forward = qNext[i] - q[i];
        product += system.getMasses()[i] * forward.dot(qBack[i] - q[i]);
        square += system.getMasses()[i] * forward.dot(forward);
    }
    const double alpha = square > 0 ? product / square : 0.0;
    for (int i = 0; i < system.getNumParticles(); i++)
        forceBack[i] = force[i] + (forces[i] - force[i]) * alpha;
    try {
        evaluateOnStep({qBack, wBack, forceBack, thetaBack, -kickNext, vBack, lambdaBack, rightSideBack, nullptr},
                       groupEnergy + alpha * (energy - groupEnergy), backValues);
    }
    catch (const StepFailure&) {
        return false; // no state to look back at
    }
    return true;
}

// The mean of U_k(q0,p) over the half-step momenta on either side of the start, which is what (3.14) takes.
vector<double> VRattleDynamics::evaluateHalfSteps() {
    setRates(thetaHalf, stepNext);
    evaluateU(wNext, thetaHalf);
    vector<double> result = valuesTrial;
    evaluateU(wBack, thetaHalf);
    for (size_t k = 0; k < result.size(); k++)
        result[k] = 0.5 * (result[k] + valuesTrial[k]);
    return result;
}

// Returns whether the first step stands; if not, firstDensity says with which density to take it again.
bool VRattleDynamics::startDensityFrom(const vector<double>& startValues, const vector<double>& backValues,
                                       bool hasBack) {
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    const bool areAllTaken =
        std::all_of(terms.begin(), terms.end(), [](const StepMonitor::Term& term) { return term.reference == 0; });
    for (size_t k = 0; k < terms.size(); k++)
        if (terms[k].reference == 0)
            monitor.setReference((int) k,
                                 startValue(startValues[k], valuesNext[k], hasBack ? &backValues[k] : nullptr));
    if (areAllTaken) {
        if (hasBack)
            scaleReferences(startValues, backValues);
        return true;
    }
    if (firstDensity > 0)
        return true;
    const double back = hasBack ? combineAndLimit(backValues) : 0.0;
    firstDensity = startValue(combineAndLimit(startValues), combineAndLimit(valuesNext), hasBack ? &back : nullptr);
    return std::fabs(firstDensity - rhoNext) <= 1e-12 * rhoNext;
}

// With rho[1/2] = 1 the steps to either side have the size h, and not h/u0, so that the change of u over a step of the
// sequence is theirs over u0. Scale the references such that u0 + (u1 - u-1)/(4 u0) = 1.
void VRattleDynamics::scaleReferences(const vector<double>& startValues, const vector<double>& backValues) {
    vector<double> references;
    for (const StepMonitor::Term& term : monitor.getTerms())
        references.push_back(term.reference);
    auto mismatchOf = [&](double scale) {
        for (size_t k = 0; k < references.size(); k++)
            monitor.setReference((int) k, scale * references[k]);
        const double start = combineAndLimit(startValues);
        return start + 0.25 * (combineAndLimit(valuesNext) - combineAndLimit(backValues)) / start - 1;
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

// The smooth sequence's value half a step after the start, from the values at the start, one step ahead and one back.
double VRattleDynamics::startValue(double start, double ahead, const double* back) {
    const double value = back != nullptr ? start + 0.25 * (ahead - *back) : 0.5 * (start + ahead);
    // What changes by its own size within the first step is not resolved: take it as it is.
    return value > 0.5 * start && value < 2 * start ? value : start;
}
