// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "VRattleDynamics.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

const int MAX_ITERATIONS = 50;
// If an iteration leaves more than this fraction of the error, the chord matrix K(q) is a poor one: use full Newton.
const double SLOW_CONVERGENCE = 0.25;
// The density equation (3.14) is solved to this relative accuracy; rounding of U allows little more.
const double DENSITY_TOLERANCE = 1e-12;
// The iteration of a regular step goes on to this fraction of the tolerance, that of a step from the on-step state, whose
// starting value is worse by a power of h, to this. What is left is not the same forwards and backwards, and so limits
// how closely a run can be retraced; where rounding does not allow the fraction, the tolerance itself counts.
const double REGULAR_MARGIN = 0.1, ON_STEP_MARGIN = 1e-4;
// What is accepted where rounding in U (strained, badly scaled constraints) keeps the iteration from going on.
const double DENSITY_ROUNDING = 1e-8;
// A step asked to end at a given time may be longer than the density says by this fraction, so that no sliver is left.
const double SLIVER = 1e-6;

double dot(const vector<double>& a, const vector<double>& b) {
    double sum = 0;
    for (size_t i = 0; i < a.size(); i++)
        sum += a[i] * b[i];
    return sum;
}

bool isFinite(const vector<Vec3>& vectors) {
    double sum = 0;
    for (const Vec3& x : vectors)
        sum += 0 * (x[0] + x[1] + x[2]); // a NaN or an infinity gives a NaN
    return sum == 0;
}

} // namespace

VRattleDynamics::VRattleDynamics(const vector<double>& masses, const vector<DistanceConstraint>& constraints) :
        system(masses, constraints), matrix(system), newtonMatrix(system), monitor(system), settings(), groupEnergy(0),
        rho(1), u(1), hasDensity(false), isFactorCurrent(false), firstDensity(0), stepKind(First), rhoNext(1),
        stepNext(0), kickNext(0), numIterations(0), numRescues(0), lastError(0) {
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    for (vector<Vec3>* vectors : {&qNext, &wNext, &vNext, &forceNext, &acceleration, &gradient, &halfStepChange, &qBack,
                                  &wBack, &vBack, &forceBack, &w})
        vectors->resize(numParticles);
    for (vector<double>* numbers : {&lambda, &appliedTerm, &lambdaNext, &multiplierTrial, &residual, &correction,
                                    &coupling, &response, &lambdaBack, &multiplierOffset})
        numbers->resize(numConstraints);
    jacobian.resize(numConstraints);
    jacobianNext.resize(numConstraints);
}

void VRattleDynamics::setSettings(const Settings& newSettings) {
    bool sameTerms = newSettings.terms.size() == settings.terms.size() && newSettings.normOrder == settings.normOrder &&
                     newSettings.isFixedStep == settings.isFixedStep;
    bool retakeReference = false;
    vector<StepMonitor::Term> terms = newSettings.terms;
    for (size_t i = 0; i < terms.size() && sameTerms; i++) {
        const StepMonitor::Term& old = settings.terms[i];
        sameTerms = terms[i].kind == old.kind && terms[i].weight == old.weight && terms[i].power == old.power;
        if (terms[i].reference == 0 && old.reference == 0)
            terms[i].reference = monitor.getTerms()[i].reference; // taken at the first step, and still in force
        else if (terms[i].reference == 0)
            retakeReference = true;
    }
    if (!sameTerms)
        terms = newSettings.terms;
    bool sameDensity = sameTerms && !retakeReference && newSettings.stepSize == settings.stepSize &&
                       newSettings.minimumStep == settings.minimumStep &&
                       newSettings.maximumStep == settings.maximumStep && newSettings.update == settings.update;
    for (size_t i = 0; i < terms.size() && sameDensity; i++)
        sameDensity = terms[i].reference == monitor.getTerms()[i].reference;
    settings = newSettings;
    monitor.setTerms(terms, settings.normOrder);
    requireConstraintsForMonitors();
    density = StepDensity(settings.update, settings.stepSize, settings.minimumStep, settings.maximumStep);
    if (q.empty() || sameDensity)
        return;
    restoreFactor();
    monitor.setForces(force, groupEnergy);
    monitor.evaluate(v, lambda, jacobian, values);
    if (!sameTerms || retakeReference)
        forgetDensity();
    else
        rescaleDensity(u);
    if (hasDensity)
        formHalfStepVelocities();
}

void VRattleDynamics::forgetDensity() {
    hasDensity = false;
    firstDensity = 0;
    rho = 1;
}

// After a jump of the state: rho keeps its ratio to u, so that it starts no oscillation.
void VRattleDynamics::rescaleDensity(double oldU) {
    if (!hasDensity)
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

void VRattleDynamics::requireConstraintsForMonitors() const {
    if (system.getNumConstraints() == 0 && monitor.needsConstraints())
        throw StepFailure("a monitor of the constraint forces is set (ConstraintMultipliers is the default) and the "
                          "System has no constraints; choose a monitor of the applied forces, such as AppliedForce or "
                          "ForcePNorm, with clearMonitors() and addMonitor(), or call clearMonitors() for fixed steps");
}

// ---------------------------------------------------------------------------------------------- the on-step state

void VRattleDynamics::factorizeAt(const vector<Vec3>& positions) {
    isFactorCurrent = false;
    system.evaluateJacobian(positions, jacobianNext);
    matrix.factorize(jacobianNext);
}

// After a step that was not completed the factor may belong to its end.
void VRattleDynamics::restoreFactor() {
    if (isFactorCurrent)
        return;
    factorizeAt(q);
    jacobian.swap(jacobianNext);
    isFactorCurrent = true;
    monitor.setForces(force, groupEnergy);
    system.multiplyOverMass(jacobian, force, appliedTerm);
}

// Lambda = K^-1 (g''(v,v) + G M^-1 F)   (4.3)
void VRattleDynamics::computeMultipliers(const vector<Vec3>& velocities, vector<double>& result) const {
    system.evaluateCurvature(velocities, result);
    for (size_t k = 0; k < result.size(); k++)
        result[k] += appliedTerm[k];
    matrix.solve(result);
}

// v - M^-1 G^T K^-1 G v, with the G to which the factor belongs (jacobianNext before it is taken over).
void VRattleDynamics::projectVelocities(vector<Vec3>& velocities) const {
    const ConstraintSystem::Jacobian& g = isFactorCurrent ? jacobian : jacobianNext;
    vector<double>& x = const_cast<vector<double>&>(correction);
    system.multiply(g, velocities, x);
    matrix.solve(x);
    system.addTransposedOverMass(g, x, -1.0, velocities);
}

double VRattleDynamics::evaluateU(const vector<Vec3>& velocities) {
    if (monitor.needsMultipliers())
        computeMultipliers(velocities, multiplierTrial);
    monitor.evaluate(velocities, multiplierTrial, jacobian, valuesNext);
    return combineAndLimit(valuesNext);
}

// The on-step quantities at a position: (3.12)-(3.13) from the half-step velocities, then Lambda and the monitors.
void VRattleDynamics::evaluateOnStep(const vector<Vec3>& positions, const vector<Vec3>& halfStep,
                                     const vector<Vec3>& forces, double energy, double kick, vector<Vec3>& velocities,
                                     vector<double>& multipliers, vector<double>& monitorValues) {
    factorizeAt(positions);
    const vector<double>& inverseMasses = system.getInverseMasses();
    for (int i = 0; i < system.getNumParticles(); i++)
        velocities[i] = halfStep[i] + forces[i] * (kick * inverseMasses[i]);
    projectVelocities(velocities);
    system.multiplyOverMass(jacobianNext, forces, appliedTerm);
    computeMultipliers(velocities, multipliers);
    monitor.setForces(forces, energy);
    monitor.evaluate(velocities, multipliers, jacobianNext, monitorValues);
    monitor.requireValid(monitorValues);
}

bool VRattleDynamics::projectPositions(vector<Vec3>& positions) {
    if (system.getNumConstraints() == 0 || system.evaluate(positions, residual) <= settings.tolerance)
        return false;
    // Newton's iteration for g(q + M^-1 G(q)^T x) = 0 with the chord matrix K(q), then with the full one.
    factorizeAt(positions);
    qNext = positions;
    bool isNewton = false;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_ITERATIONS; iteration++) {
        lastError = system.evaluate(qNext, residual);
        if (!std::isfinite(lastError))
            break;
        const bool isSlow = lastError > SLOW_CONVERGENCE * previous;
        if (lastError <= settings.tolerance * (isSlow ? 1.0 : ON_STEP_MARGIN)) {
            positions = qNext;
            return true;
        }
        isNewton = isNewton || isSlow;
        previous = lastError;
        correction = residual;
        if (isNewton) {
            system.evaluateJacobian(qNext, jacobian);
            if (!newtonMatrix.factorize(jacobian, jacobianNext))
                break;
            newtonMatrix.solve(correction);
        }
        else
            matrix.solve(correction);
        system.addTransposedOverMass(jacobianNext, correction, -1.0, qNext);
        numIterations++;
    }
    throwNotConverged();
}

void VRattleDynamics::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy) {
    if (!isFinite(forces))
        throw StepFailure("the force on a particle is not a number or infinite");
    q = positions;
    v = velocities;
    force = forces;
    groupEnergy = energy;
    forgetDensity();
    std::fill(multiplierOffset.begin(), multiplierOffset.end(), 0.0);
    isFactorCurrent = false;
    restoreFactor();
    projectVelocities(v);
    computeMultipliers(v, lambda);
    monitor.evaluate(v, lambda, jacobian, values);
    monitor.requireValid(values);
}

VRattleDynamics::Memory VRattleDynamics::getMemory() const {
    Memory memory = {hasDensity, rho, w, multiplierOffset, {}};
    for (const StepMonitor::Term& term : monitor.getTerms())
        memory.references.push_back(term.reference);
    return memory;
}

void VRattleDynamics::resume(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                             double energy, const Memory& memory) {
    begin(positions, velocities, forces, energy);
    v = velocities; // begin() has projected them, which changes the last bits
    computeMultipliers(v, lambda);
    monitor.evaluate(v, lambda, jacobian, values);
    for (size_t k = 0; k < memory.references.size(); k++)
        monitor.setReference((int) k, memory.references[k]);
    if (!memory.hasDensity)
        return;
    hasDensity = true;
    rho = memory.density;
    w = memory.halfStepVelocities;
    multiplierOffset = memory.multiplierOffset;
    u = combineAndLimit(values);
}

void VRattleDynamics::changeState(const vector<Vec3>& positions, const vector<Vec3>& velocities,
                                  const vector<Vec3>& forces, double energy) {
    const bool hadDensity = hasDensity;
    const double oldRho = rho, oldU = u;
    begin(positions, velocities, forces, energy);
    if (!hadDensity)
        return;
    hasDensity = true;
    rho = oldRho;
    rescaleDensity(oldU);
    if (hasDensity)
        formHalfStepVelocities();
}

void VRattleDynamics::changeVelocities(const vector<Vec3>& velocities) {
    restoreFactor();
    vector<Vec3>& change = vNext;
    for (int i = 0; i < system.getNumParticles(); i++)
        change[i] = velocities[i] - v[i];
    projectVelocities(change);
    for (int i = 0; i < system.getNumParticles(); i++) {
        v[i] += change[i];
        w[i] += change[i];
    }
    computeMultipliers(v, lambda);
    monitor.evaluate(v, lambda, jacobian, values);
    rescaleDensity(u);
}

// p[n-1/2] = p[n] + (h/(2 rho)) (grad V + G^T Lambda)   (METHOD section 7)
void VRattleDynamics::formHalfStepVelocities() {
    const double kick = 0.5 * settings.stepSize / rho;
    const vector<double>& inverseMasses = system.getInverseMasses();
    for (int i = 0; i < system.getNumParticles(); i++)
        w[i] = v[i] - force[i] * (kick * inverseMasses[i]);
    system.addTransposedOverMass(jacobian, lambda, kick, w);
}

// ------------------------------------------------------------------------------------------ the equations of a step

// acceleration = M^-1 (F - G^T lambda), w+ = start + kick acceleration (3.10), q+ = q + drift w+ (3.9)
void VRattleDynamics::computeTrial(const vector<Vec3>& start, double kick, double drift) {
    const vector<double>& inverseMasses = system.getInverseMasses();
    const int numParticles = system.getNumParticles();
    for (int i = 0; i < numParticles; i++)
        acceleration[i] = force[i] * inverseMasses[i];
    system.addTransposedOverMass(jacobian, lambdaNext, -1.0, acceleration);
    for (int i = 0; i < numParticles; i++) {
        if (inverseMasses[i] > 0) {
            wNext[i] = start[i] + acceleration[i] * kick;
            qNext[i] = q[i] + wNext[i] * drift;
        }
        else {
            wNext[i] = start[i];
            qNext[i] = q[i];
        }
    }
}

// Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes that O(h^3).
void VRattleDynamics::addMultiplierOffset() {
    for (size_t k = 0; k < lambdaNext.size(); k++)
        lambdaNext[k] += multiplierOffset[k];
}

void VRattleDynamics::keepMultiplierOffset() {
    for (size_t k = 0; k < lambdaNext.size(); k++)
        multiplierOffset[k] = lambdaNext[k] - lambda[k];
}

// Newton's iteration on lambda for g(q+) = 0 (3.11), with A = -kick drift K(q), or G(q+) M^-1 G(q)^T in place of K.
bool VRattleDynamics::solvePositions(const vector<Vec3>& start, double kick, double drift, double margin) {
    lambdaNext = lambda;
    if (margin == REGULAR_MARGIN)
        addMultiplierOffset();
    bool isNewton = false;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_ITERATIONS; iteration++) {
        computeTrial(start, kick, drift);
        if (system.getNumConstraints() == 0)
            return true;
        lastError = system.evaluate(qNext, residual);
        if (!std::isfinite(lastError))
            return false;
        const bool isSlow = lastError > SLOW_CONVERGENCE * previous;
        // At least one update: Lambda itself, unrefined, costs accuracy even where it meets the tolerance.
        if (iteration > 0 && lastError <= settings.tolerance * (isSlow ? 1.0 : margin))
            return true;
        isNewton = isNewton || isSlow;
        previous = lastError;
        correction = residual;
        if (isNewton) {
            system.evaluateJacobian(qNext, jacobianNext);
            if (!newtonMatrix.factorize(jacobianNext, jacobian))
                return false;
            newtonMatrix.solve(correction);
        }
        else
            matrix.solve(correction);
        for (size_t k = 0; k < lambdaNext.size(); k++)
            lambdaNext[k] += correction[k] / (kick * drift);
        numIterations++;
    }
    return false;
}

// Newton's iteration on (lambda, rho+) for (3.11) and (3.14) by the Schur complement (METHOD section 8).
VRattleDynamics::SolveResult VRattleDynamics::solveCoupled() {
    const double h = settings.stepSize;
    const double uMinus = evaluateU(w);
    lambdaNext = lambda;
    addMultiplierOffset();
    rhoNext = StepDensity::sumUpdate(u, rho);
    if (!(rhoNext > 0))
        rhoNext = density.boundedUpdate(u, rho);
    bool isNewton = false;
    int numCuts = 0;
    double previous = std::numeric_limits<double>::infinity(), d = 0;
    for (int iteration = 0; iteration < MAX_ITERATIONS; iteration++) {
        const double kick = 0.5 * h * (1 / rho + 1 / rhoNext), drift = h / rhoNext;
        computeTrial(w, kick, drift);
        lastError = system.evaluate(qNext, residual);
        const double uPlus = evaluateU(wNext);
        const double mismatch = rhoNext + rho - uPlus - uMinus; // F of METHOD section 8
        const double relativeMismatch = std::fabs(mismatch) / (rhoNext + rho);
        const double error =
            std::max(lastError / (REGULAR_MARGIN * settings.tolerance), relativeMismatch / DENSITY_TOLERANCE);
        if (!std::isfinite(error))
            return NotConverged;
        const bool isSlow = error > SLOW_CONVERGENCE * previous;
        const bool isGoodEnough = lastError <= settings.tolerance && relativeMismatch <= DENSITY_ROUNDING;
        if (iteration > 0 && (error <= 1 || (isNewton && isSlow && isGoodEnough)))
            return Converged;
        isNewton = isNewton || isSlow;
        previous = error;
        if (isNewton) {
            system.evaluateJacobian(qNext, jacobianNext);
            if (!newtonMatrix.factorize(jacobianNext, jacobian))
                return NotConverged;
        }
        if (isNewton || iteration == 0) {
            // a = dF/dlambda, d = dF/drho+, and response = x2 = A^-1 dg/drho+
            monitor.evaluateGradient(wNext, multiplierTrial, valuesNext, matrix, gradient);
            const double derivative = density.limitDerivative(monitor.combine(valuesNext));
            system.multiplyOverMass(jacobian, gradient, coupling);
            for (double& a : coupling)
                a *= kick * derivative;
            d = 1;
            const double kickChange = -0.5 * h / (rhoNext * rhoNext); // d(kick)/d(rho+)
            for (int i = 0; i < system.getNumParticles(); i++) {
                d -= derivative * kickChange * gradient[i].dot(acceleration[i]);
                halfStepChange[i] = system.getInverseMasses()[i] == 0
                                        ? Vec3()
                                        : acceleration[i] * (drift * kickChange) - wNext[i] * (drift / rhoNext);
            }
            if (!isNewton)
                system.evaluateJacobian(qNext, jacobianNext);
            system.multiply(jacobianNext, halfStepChange, response);
            if (isNewton)
                newtonMatrix.solve(response);
            else
                matrix.solve(response);
            for (double& x : response)
                x /= -kick * drift;
        }
        correction = residual; // x1 = -A^-1 g
        if (isNewton)
            newtonMatrix.solve(correction);
        else
            matrix.solve(correction);
        for (double& x : correction)
            x /= kick * drift;
        double change = (-mismatch - dot(coupling, correction)) / (d - dot(coupling, response));
        if (!std::isfinite(change))
            return NotConverged;
        if (!(rhoNext + change > 0)) {
            if (++numCuts > 8)
                return NotPositive;
            change = -0.75 * rhoNext;
        }
        rhoNext += change;
        for (size_t k = 0; k < lambdaNext.size(); k++)
            lambdaNext[k] += correction[k] - response[k] * change;
        numIterations++;
    }
    return NotConverged;
}

// Solve for rho+, lambda, w+ and q+ of a regular step; returns its size.
double VRattleDynamics::solveRegular() {
    restoreFactor();
    bool isRescue = false;
    if (settings.isFixedStep || monitor.isEmpty())
        rhoNext = 1;
    else if (settings.update == StepDensity::Bounded)
        rhoNext = density.boundedUpdate(u, rho);
    else if (settings.update == StepDensity::SemiExplicit && monitor.dependsOnVelocities()) {
        if (solveCoupled() == Converged)
            return settings.stepSize / rhoNext;
        isRescue = true;
    }
    else {
        rhoNext = StepDensity::sumUpdate(u, rho);
        isRescue = !(rhoNext > 0);
    }
    if (isRescue)
        rhoNext = density.boundedUpdate(u, rho);
    const double drift = settings.stepSize / rhoNext;
    if (!solvePositions(w, 0.5 * (settings.stepSize / rho + drift), drift, REGULAR_MARGIN))
        throwNotConverged();
    numRescues += isRescue;
    return drift;
}

void VRattleDynamics::throwNotConverged() const {
    std::stringstream reason;
    if (std::isfinite(lastError)) {
        const DistanceConstraint& worst = system.getConstraint(system.findLargest(residual));
        reason << "the constrained distance between the particles " << worst.particle1 << " and " << worst.particle2
               << " could not be solved for (relative error " << lastError << " left)";
    }
    else
        reason << "the constraints could not be solved for (the iteration diverged)";
    if (hasDensity && !monitor.isEmpty())
        reason << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
               << settings.stepSize / rhoNext << " ps";
    throw StepFailure(reason.str());
}

// ------------------------------------------------------------------------------------------------------- the steps

double VRattleDynamics::step(double maxStep) {
    double full;
    if (hasDensity) {
        stepKind = Regular;
        full = solveRegular();
    }
    else {
        stepKind = First;
        rhoNext = 1;
        const vector<StepMonitor::Term>& terms = monitor.getTerms();
        bool hasReferences =
            std::all_of(terms.begin(), terms.end(), [](const StepMonitor::Term& term) { return term.reference > 0; });
        if (firstDensity > 0)
            rhoNext = firstDensity;
        else if (hasReferences)
            rhoNext = combineAndLimit(values);
        full = settings.stepSize / rhoNext;
        if (!std::isfinite(full))
            throw StepFailure("the monitor is zero and there is no maximum step size; set one");
    }
    const bool isShortened = full > maxStep || std::fabs(full - maxStep) <= SLIVER * full;
    stepNext = isShortened ? maxStep : full;
    if (stepKind == First || isShortened) {
        // A step of plain RATTLE from the on-step state.
        restoreFactor();
        if (isShortened)
            stepKind = Shortened;
        if (!solvePositions(v, 0.5 * stepNext, stepNext, ON_STEP_MARGIN))
            throwNotConverged();
    }
    if (isShortened && hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, stepNext / full);
    kickNext = 0.5 * stepNext;
    return stepNext;
}

bool VRattleDynamics::finish(const vector<Vec3>& forces, double energy) {
    if (!isFinite(forces))
        throw StepFailure("the force on a particle became infinite or not a number at the end of the step");
    if (stepKind == Regular)
        keepMultiplierOffset();
    vector<double> backValues;
    bool hasBack = false;
    const bool isStart = stepKind == First && !settings.isFixedStep && !monitor.isEmpty();
    if (isStart)
        hasBack = evaluateBackwards(forces, energy, backValues);
    evaluateOnStep(qNext, wNext, forces, energy, kickNext, vNext, lambdaNext, valuesNext);
    if (isStart && !startDensityFrom(backValues, hasBack))
        return false;

    q.swap(qNext);
    v.swap(vNext);
    w.swap(wNext);
    force = forces;
    groupEnergy = energy;
    lambda.swap(lambdaNext);
    values.swap(valuesNext);
    jacobian.swap(jacobianNext);
    isFactorCurrent = true;
    monitor.forcesMoved(force);
    if (stepKind == First) {
        hasDensity = true;
        firstDensity = 0;
    }
    if (hasDensity) {
        rho = rhoNext;
        u = combineAndLimit(values);
    }
    if (hasDensity && stepKind == Shortened)
        formHalfStepVelocities();
    return true;
}

void VRattleDynamics::reverse() {
    if (hasDensity) {
        const long long rescuesBefore = numRescues;
        solveRegular();
        keepMultiplierOffset();
        numRescues = rescuesBefore;
        for (int i = 0; i < system.getNumParticles(); i++)
            w[i] = -wNext[i];
        rho = rhoNext;
    }
    for (Vec3& velocity : v)
        velocity = -velocity;
}

// ------------------------------------------------------------------------------------------------------- the start

/*
 * The recursion of the density keeps an oscillation of rho about u for ever, so it must start without one. The smooth
 * solution is rho[1/2] = u0 + (u1 - u-1)/4 + O(h^3), which follows from METHOD section 7. The first step is a step of
 * plain RATTLE from the on-step state, which gives u1 with the one force evaluation that the step costs anyway; u-1
 * comes from a step backwards, whose forces are extrapolated along the path from those at q0 and q1, exactly so where
 * the motion starts at rest (and then q-1 = q1) or the forces are constant.
 *
 * Where no reference value is given, rho[1/2] = 1 and it is the reference value that is chosen such that this is the
 * smooth start: no force evaluation is spent on it. Where one is given, rho[1/2] follows, and the first step is taken
 * again with it.
 */
bool VRattleDynamics::evaluateBackwards(const vector<Vec3>& forces, double energy, vector<double>& backValues) {
    qNext.swap(qBack);
    wNext.swap(wBack);
    bool isSolved = solvePositions(v, -0.5 * stepNext, -stepNext, ON_STEP_MARGIN);
    qNext.swap(qBack);
    wNext.swap(wBack);
    if (!isSolved)
        return false;
    double product = 0, square = 0;
    for (int i = 0; i < system.getNumParticles(); i++) {
        Vec3 forward = qNext[i] - q[i];
        product += system.getMasses()[i] * forward.dot(qBack[i] - q[i]);
        square += system.getMasses()[i] * forward.dot(forward);
    }
    const double alpha = square > 0 ? product / square : 0.0;
    for (int i = 0; i < system.getNumParticles(); i++)
        forceBack[i] = force[i] + (forces[i] - force[i]) * alpha;
    try {
        evaluateOnStep(qBack, wBack, forceBack, groupEnergy + alpha * (energy - groupEnergy), -kickNext, vBack,
                       lambdaBack, backValues);
    }
    catch (const StepFailure&) {
        return false; // no state to look back at
    }
    return true;
}

// Returns whether the first step stands; if not, firstDensity says with which density to take it again.
bool VRattleDynamics::startDensityFrom(const vector<double>& backValues, bool hasBack) {
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    bool areAllTaken = true;
    for (size_t k = 0; k < terms.size(); k++) {
        if (terms[k].reference > 0)
            areAllTaken = false;
        else if (monitor.isNegligible((int) k, values[k], v))
            throw StepFailure(
                "monitor " + std::to_string(k) +
                " is zero at the first step, which is then no measure for later ones; call calibrate() or "
                "setReferenceMonitorValue()");
    }
    for (size_t k = 0; k < terms.size(); k++)
        if (terms[k].reference == 0)
            monitor.setReference((int) k, startValue(values[k], valuesNext[k], hasBack ? &backValues[k] : nullptr));
    if (areAllTaken || firstDensity > 0)
        return true;
    const double back = hasBack ? combineAndLimit(backValues) : 0.0;
    firstDensity = startValue(combineAndLimit(values), combineAndLimit(valuesNext), hasBack ? &back : nullptr);
    return std::fabs(firstDensity - rhoNext) <= 1e-12 * rhoNext;
}

// The smooth sequence's value half a step after the start, from the values at the start, one step ahead and one back.
double VRattleDynamics::startValue(double start, double ahead, const double* back) {
    const double value = back != nullptr ? start + 0.25 * (ahead - *back) : 0.5 * (start + ahead);
    // What changes by its own size within the first step is not resolved: take it as it is.
    return value > 0.5 * start && value < 2 * start ? value : start;
}
