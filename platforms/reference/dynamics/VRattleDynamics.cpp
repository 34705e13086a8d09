// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "VRattleDynamics.h"
#include "Pack.h"
#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

const int MAX_CHORD_ITERATIONS = 12, MAX_NEWTON_ITERATIONS = 50;
// Threads may share the work from this number of constraints on. A pass costs 10 to 25 ns a constraint, and a call of the thread
// pool 5 us at the least.
const int MIN_PARALLEL_CONSTRAINTS = 2000;
// If an iteration leaves more than this fraction of the error, something else is tried, or it is rounding.
const double SLOW_CONVERGENCE = 0.25, SLOW_COUPLED_CONVERGENCE = 0.5;
// The iteration of a regular step goes on to this fraction of the tolerance, that of a step from the on-step state, whose
// starting value is worse by a power of h, to this. What is left is not the same forwards and backwards, and so limits
// how closely a run can be retraced; where rounding does not allow the fraction, the tolerance itself counts.
const double REGULAR_MARGIN = 0.1, ON_STEP_MARGIN = 1e-4;
// The density equation (3.14) is solved to the tolerance of the constraints, but not closer than rounding of U allows; and
// where strained, badly scaled constraints make that rounding larger, the second number counts.
const double DENSITY_ROUNDING = 1e-12, STRAINED_DENSITY_ROUNDING = 1e-8;
// Differences of the velocities of particles that are the same but for the rounding of both.
const double FRAME_ROUNDING = 4 * std::numeric_limits<double>::epsilon();
// A step asked to end at a given time may be longer than the density says by this fraction, so that no sliver is left.
const double SLIVER = 1e-6;

// The larger of two numbers, or a NaN if one is.
double larger(double a, double b) {
    return a >= b || std::isnan(a) ? a : b;
}

double dot(const vector<double>& a, const vector<double>& b) {
    double sum = 0;
    for (size_t i = 0; i < a.size(); i++)
        sum += a[i] * b[i];
    return sum;
}

} // namespace

VRattleDynamics::VRattleDynamics(const vector<double>& masses, const vector<DistanceConstraint>& constraints,
                                 const vector<ExpressionConstraint>& expressions) :
        system(masses, constraints, expressions), matrix(system), newtonMatrix(system), monitor(system),
        automatic(system), settings(), sharedSeconds(0), groupEnergy(0), rho(1), u(1), hasDensity(false),
        hasHalfStepValue(false), halfStepValue(0), rate(0), densityOffset(0), firstDensity(0), factorScope(NoFactor),
        isMonitorCurrent(false), stepKind(First), rhoNext(1), stepNext(0), kickNext(0), numIterations(0), numRescues(0),
        lastError(0) {
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    for (int i = 0; i < numParticles; i++)
        if (masses[i] > 0)
            movingParticles.push_back(i);
    for (vector<Vec3>* vectors :
         {&w, &qNext, &wNext, &vNext, &acceleration, &gradient, &halfStepChange, &qBack, &wBack, &vBack, &forceBack})
        vectors->resize(numParticles);
    for (vector<double>* numbers :
         {&lambda, &rightSide, &multiplierOffset, &appliedTerm, &lambdaNext, &rightSideNext, &appliedTermNext,
          &lambdaHalf, &rightSideHalf, &lambdaRate, &multiplierTrial, &rightSideTrial, &residual, &correction,
          &coupling, &response, &lambdaOnStep, &lambdaBack, &rightSideBack})
        numbers->resize(numConstraints);
    isPieceEliminated.resize(system.getPieces().size());
    for (ConstraintSystem::Jacobian* rows : {&jacobian, &jacobianNext, &velocityJacobian})
        rows->resize(system.getNumEntries());
}

void VRattleDynamics::setParallel(const Parallel& newParallel, int numThreads) {
    parallel = numThreads > 1 ? newParallel : Parallel();
    threadResults.resize(numThreads);
}

void VRattleDynamics::setSettings(const Settings& newSettings) {
    const bool sameControl = takeAutomaticReferences(newSettings) && newSettings.isAutomatic == settings.isAutomatic;
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
    bool sameDensity = sameTerms && sameControl && !retakeReference && newSettings.stepSize == settings.stepSize &&
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
    monitor.setForces(force, groupEnergy);
    monitor.evaluate(v, lambda, rightSide, values);
    rate = 0; // only the speed of convergence of the next step depends on it
    if (settings.isAutomatic && !sameControl)
        automatic.begin(v, force, lambda, rightSide);
    if (!sameTerms || !sameControl || retakeReference)
        forgetDensity();
    else
        rescaleDensity(u);
    if (hasDensity)
        formHalfStepVelocities();
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

void VRattleDynamics::requireConstraintsForMonitors() const {
    if (system.getNumConstraints() == 0 && monitor.needsConstraints())
        throw StepFailure("a monitor of the constraint forces is set (ConstraintMultipliers is the default) and the "
                          "System has no constraints; choose a monitor of the applied forces, such as AppliedForce or "
                          "ForcePNorm, with clearMonitors() and addMonitor(), or call clearMonitors() for fixed steps");
}

// ---------------------------------------------------------------------------------------------- the on-step state

// G(q), G M^-1 F and the factor of K, of the general clusters or of all. The batches form their own in each pass.
void VRattleDynamics::ensureFactor(FactorScope scope) {
    if (!isMonitorCurrent) {
        monitor.setForces(force, groupEnergy);
        isMonitorCurrent = true;
    }
    if (factorScope >= scope)
        return;
    ConstraintSystem::Part part = ConstraintSystem::ALL;
    if (scope == GeneralFactor)
        part.first = system.getFirstGeneral();
    system.evaluateJacobian(q, jacobian, part);
    const int failed = matrix.tryToFactorize(jacobian, part);
    if (failed != ConstraintMatrix::REGULAR)
        matrix.throwDependent(failed, jacobian);
    system.multiplyOverMass(jacobian, force, appliedTerm, part);
    factorScope = scope;
}

// v - M^-1 G^T K^-1 G v
void VRattleDynamics::projectVelocities(vector<Vec3>& velocities) {
    ensureFactor(FullFactor);
    system.multiply(jacobian, velocities, correction);
    matrix.solve(correction);
    system.addTransposedOverMass(jacobian, correction, -1.0, velocities);
}

// u(q,p) with Lambda = K^-1 (g''(v,v) + G M^-1 F)   (4.3)
double VRattleDynamics::evaluateU(const vector<Vec3>& velocities) {
    ensureFactor(FullFactor);
    system.evaluateCurvature(q, velocities, rightSideTrial);
    for (size_t k = 0; k < rightSideTrial.size(); k++)
        rightSideTrial[k] += appliedTerm[k];
    multiplierTrial = rightSideTrial;
    matrix.solve(multiplierTrial);
    monitor.evaluate(velocities, multiplierTrial, rightSideTrial, valuesTrial);
    return combineAndLimit(valuesTrial);
}

// The on-step quantities at a position: (3.12)-(3.13) from the half-step velocities, then Lambda and the monitors.
void VRattleDynamics::evaluateOnStep(const vector<Vec3>& positions, const vector<Vec3>& halfStep,
                                     const vector<Vec3>& forces, double energy, double kick, vector<Vec3>& velocities,
                                     vector<double>& multipliers, vector<double>& rightSides,
                                     vector<double>& monitorValues, bool withHalfStep) {
    factorScope = NoFactor;
    isMonitorCurrent = false;
    const OnStepArrays arrays = {positions.data(),
                                 halfStep.data(),
                                 forces.data(),
                                 velocities.data(),
                                 multipliers.data(),
                                 rightSides.data(),
                                 withHalfStep ? lambdaHalf.data() : nullptr,
                                 rightSideHalf.data(),
                                 lambdaRate.data(),
                                 kick};
    const OnStep state = {positions, halfStep, forces, velocities, multipliers, rightSides, kick, withHalfStep};
    const vector<double>& inverseMasses = system.getInverseMasses();
    forJoints([&](const ConstraintSystem::CutCluster& cluster) {
        system.evaluateJacobian(positions, jacobianNext, cluster.joints); // their rows are in the columns of pieces
    });
    ShareResult result = runShared([&](int block) { monitor.sumForces(forces, block); },
                                   [&](const ClusterBatch& batch, int begin, int end, ShareResult& share) {
                                       share.pivot = -larger(-share.pivot, -batch.finish(arrays, begin, end));
                                   },
                                   [&](int i) { velocities[i] = halfStep[i] + forces[i] * (kick * inverseMasses[i]); },
                                   [&](const ConstraintSystem::Part& part, ShareResult& share) {
                                       share.failed = std::max(share.failed, evaluateOnStepGeneral(state, part));
                                   },
                                   [&](const ConstraintSystem::Part& piece, ShareResult& share) {
                                       share.failed = std::max(share.failed, beginVelocities(state, piece));
                                   });
    if (result.failed == ConstraintMatrix::REGULAR)
        result.failed = evaluateOnStepPieces(state);
    if (result.failed != ConstraintMatrix::REGULAR)
        matrix.throwDependent(result.failed, jacobianNext);
    if (!(result.pivot > ConstraintMatrix::MIN_RELATIVE_PIVOT)) {
        // The general way knows how to name the cluster.
        system.evaluateJacobian(positions, jacobianNext);
        matrix.factorize(jacobianNext);
    }
    monitor.finishForces(forces, energy);
    if (!monitor.hasFiniteForces())
        throw StepFailure("the force on a particle is infinite or not a number");
    monitor.evaluate(velocities, multipliers, rightSides, monitorValues);
    monitor.requireValid(monitorValues);
    if (withHalfStep)
        monitor.evaluate(halfStep, lambdaHalf, rightSideHalf, valuesHalf);
}

// The same for clusters that are in no batch and not cut; returns what ConstraintMatrix::tryToFactorize() does.
int VRattleDynamics::evaluateOnStepGeneral(const OnStep& state, const ConstraintSystem::Part& part) {
    const int failed = beginVelocities(state, part);
    if (failed != ConstraintMatrix::REGULAR)
        return failed;
    beginMultipliers(state, part);
    matrix.substitute(state.multipliers, part);
    if (state.withHalfStep) {
        matrix.substitute(lambdaHalf, part);
        beginRates(state, part);
        matrix.substitute(lambdaRate, part);
    }
    return ConstraintMatrix::REGULAR;
}

// And for those that are cut, after beginVelocities() for all pieces.
int VRattleDynamics::evaluateOnStepPieces(const OnStep& state) {
    int failed = ConstraintMatrix::REGULAR;
    forJoints([&](const ConstraintSystem::CutCluster& cluster) {
        failed = std::max(failed, matrix.tryToFactorizeJoints(jacobianNext, cluster));
        system.multiply(jacobianNext, state.velocities, correction, cluster.joints);
        matrix.solveJoints(correction, cluster);
    });
    if (failed != ConstraintMatrix::REGULAR)
        return failed;
    runOnPieces([&](const ConstraintSystem::Part& piece, ShareResult&) { beginMultipliers(state, piece); });
    forJoints([&](const ConstraintSystem::CutCluster& cluster) {
        formMultiplierEquations(state, cluster.joints);
        matrix.solveJoints(state.multipliers, cluster, 0);
        if (state.withHalfStep)
            matrix.solveJoints(lambdaHalf, cluster, 1);
    });
    runOnPieces([&](const ConstraintSystem::Part& piece, ShareResult&) {
        matrix.substitute(state.multipliers, piece);
        if (state.withHalfStep) {
            matrix.substitute(lambdaHalf, piece);
            beginRates(state, piece);
        }
    });
    if (!state.withHalfStep)
        return ConstraintMatrix::REGULAR;
    forJoints([&](const ConstraintSystem::CutCluster& cluster) {
        formRateEquations(state, cluster.joints);
        matrix.solveJoints(lambdaRate, cluster);
    });
    runOnPieces([&](const ConstraintSystem::Part& piece, ShareResult&) { matrix.substitute(lambdaRate, piece); });
    return ConstraintMatrix::REGULAR;
}

// Kick the velocities of a part, and begin to solve for their projection.
int VRattleDynamics::beginVelocities(const OnStep& state, const ConstraintSystem::Part& part) {
    system.evaluateJacobian(state.positions, jacobianNext, part);
    const int failed = matrix.tryToFactorize(jacobianNext, part);
    if (failed != ConstraintMatrix::REGULAR)
        return failed;
    const vector<double>& inverseMasses = system.getInverseMasses();
    const vector<int>& particles = system.getGeneralParticles();
    for (int p = part.firstParticle; p < part.endParticle; p++) {
        const int i = particles[p];
        state.velocities[i] = state.halfStep[i] + state.forces[i] * (state.kick * inverseMasses[i]);
    }
    system.multiply(jacobianNext, state.velocities, correction, part);
    matrix.eliminate(correction, part);
    return ConstraintMatrix::REGULAR;
}

// Project the velocities of a part, and begin to solve for the multipliers.
void VRattleDynamics::beginMultipliers(const OnStep& state, const ConstraintSystem::Part& part) {
    matrix.substitute(correction, part);
    system.addTransposedOverMass(jacobianNext, correction, -1.0, state.velocities, part);
    formMultiplierEquations(state, part);
    matrix.eliminate(state.multipliers, part, 0);
    if (state.withHalfStep)
        matrix.eliminate(lambdaHalf, part, 1);
}

// K Lambda = g''(v,v) + G M^-1 F (4.3), at the on-step and the half-step velocities.
void VRattleDynamics::formMultiplierEquations(const OnStep& state, const ConstraintSystem::Part& part) {
    system.multiplyOverMass(jacobianNext, state.forces, appliedTermNext, part);
    auto form = [&](const vector<Vec3>& velocities, vector<double>& rightSides, vector<double>& multipliers) {
        system.evaluateCurvature(state.positions, velocities, rightSides, part);
        for (int k = part.first; k < part.end; k++)
            multipliers[k] = rightSides[k] += appliedTermNext[k];
    };
    form(state.velocities, state.rightSides, state.multipliers);
    if (state.withHalfStep)
        form(state.halfStep, rightSideHalf, lambdaHalf);
}

// Begin to solve for the change of the multipliers along dv = M^-1 (F - G^T Lambda), dLambda = 2 K^-1 G(v) dv.
void VRattleDynamics::beginRates(const OnStep& state, const ConstraintSystem::Part& part) {
    const vector<double>& inverseMasses = system.getInverseMasses();
    const vector<int>& particles = system.getGeneralParticles();
    for (int p = part.firstParticle; p < part.endParticle; p++)
        acceleration[particles[p]] = state.forces[particles[p]] * inverseMasses[particles[p]];
    system.addTransposedOverMass(jacobianNext, state.multipliers, -1.0, acceleration, part);
    formRateEquations(state, part);
    matrix.eliminate(lambdaRate, part);
}

void VRattleDynamics::formRateEquations(const OnStep& state, const ConstraintSystem::Part& part) {
    system.evaluateVelocityJacobian(state.positions, state.velocities, velocityJacobian, part);
    system.multiply(velocityJacobian, acceleration, lambdaRate, part);
    for (int k = part.first; k < part.end; k++)
        lambdaRate[k] *= 2;
}

// The change of u along F - G^T Lambda, of the on-step state that is about to be taken over.
double VRattleDynamics::evaluateRate() {
    if (monitor.usesVelocities()) {
        const vector<double>& inverseMasses = system.getInverseMasses();
        for (int i : movingParticles)
            acceleration[i] = monitor.getForces()[i] * inverseMasses[i];
        system.evaluateJacobian(qNext, velocityJacobian);
        system.addTransposedOverMass(velocityJacobian, lambdaOnStep, -1.0, acceleration);
    }
    return density.limitDerivative(monitor.combine(valuesNext)) *
           monitor.evaluateRate(vNext, lambdaOnStep, rightSideNext, valuesNext, acceleration, lambdaRate);
}

bool VRattleDynamics::projectPositions(vector<Vec3>& positions) {
    if (system.getNumConstraints() == 0)
        return false;
    factorScope = NoFactor;
    system.evaluateJacobian(positions, jacobian);
    if (system.evaluate(positions, residual, jacobian) <= settings.tolerance)
        return false;
    // Newton's iteration for g(q + M^-1 G(q)^T x) = 0 with the chord matrix K(q), then with the full one.
    matrix.factorize(jacobian);
    qNext = positions;
    bool isNewton = false;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        lastError = system.evaluate(qNext, residual, jacobian);
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
            system.evaluateJacobian(qNext, jacobianNext);
            if (!newtonMatrix.factorize(jacobianNext, jacobian))
                break;
            newtonMatrix.solve(correction);
        }
        else
            matrix.solve(correction);
        system.addTransposedOverMass(jacobian, correction, -1.0, qNext);
        numIterations++;
    }
    throwNotConverged();
}

void VRattleDynamics::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy) {
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
    evaluateOnStep(q, velocities, force, groupEnergy, 0.0, v, lambda, rightSide, values, false);
    isMonitorCurrent = true;
    if (settings.isAutomatic)
        automatic.begin(v, force, lambda, rightSide);
}

void VRattleDynamics::startAutomatic(const double (&back)[AutomaticControl::NUM_MONITORS],
                                     const double (&secondBack)[AutomaticControl::NUM_MONITORS]) {
    automatic.start(back, secondBack);
    hasDensity = true;
    rho = automatic.getLast();
    formHalfStepVelocities();
}

VRattleDynamics::Memory VRattleDynamics::getMemory() const {
    Memory memory = {hasDensity,
                     rho,
                     w,
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
    const size_t numReferences = settings.isAutomatic ? AutomaticControl::NUM_MONITORS : monitor.getTerms().size();
    for (size_t k = 0; k < numReferences; k++)
        memory.references.push_back(getReference((int) k));
    return memory;
}

void VRattleDynamics::resume(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                             double energy, const Memory& memory) {
    begin(positions, velocities, forces, energy);
    v = velocities; // begin() has projected them, which changes the last bits
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
}

void VRattleDynamics::changeState(const vector<Vec3>& positions, const vector<Vec3>& velocities,
                                  const vector<Vec3>& forces, double energy) {
    const bool hadDensity = hasDensity;
    const double oldRho = rho, oldU = u;
    const AutomaticControl::Memory oldControl = automatic.getMemory();
    begin(positions, velocities, forces, energy);
    if (!hadDensity)
        return;
    hasDensity = true;
    rho = oldRho;
    rescaleDensity(oldU);
    if (settings.isAutomatic) {
        automatic.setMemory(oldControl);
        automatic.change(v, force, lambda, rightSide, 1.0);
        rho = automatic.getLast();
    }
    if (hasDensity)
        formHalfStepVelocities();
}

bool VRattleDynamics::changeFrame(const vector<Vec3>& velocities) {
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
        automatic.change(v, force, lambda, rightSide, 0.0);
    return true;
}

void VRattleDynamics::changeVelocities(const vector<Vec3>& velocities) {
    vector<Vec3>& change = vNext;
    for (int i : movingParticles)
        change[i] = velocities[i] - v[i];
    projectVelocities(change);
    double changeSquared = 0, speedSquared = 1e-100; // in the mass metric
    for (int i : movingParticles) {
        changeSquared += system.getMasses()[i] * change[i].dot(change[i]);
        v[i] += change[i];
        speedSquared += system.getMasses()[i] * v[i].dot(v[i]);
        w[i] += change[i];
    }
    evaluateU(v);
    lambda = multiplierTrial;
    rightSide = rightSideTrial;
    values = valuesTrial;
    hasHalfStepValue = false;
    rescaleDensity(u);
    // The density of the last step stays, for its kick is in w.
    if (settings.isAutomatic)
        automatic.change(v, force, lambda, rightSide, std::min(1.0, std::sqrt(changeSquared / speedSquared)));
}

// p[n-1/2] = p[n] + (h/(2 rho)) (grad V + G^T Lambda)   (docs/method.md, section 7)
void VRattleDynamics::formHalfStepVelocities() {
    ensureFactor(FullFactor);
    const double kick = 0.5 * settings.stepSize / rho;
    const vector<double>& inverseMasses = system.getInverseMasses();
    for (int i : movingParticles)
        w[i] = v[i] - force[i] * (kick * inverseMasses[i]);
    system.addTransposedOverMass(jacobian, lambda, kick, w);
    hasHalfStepValue = false;
}

// ------------------------------------------------------------------------------------------ the equations of a step

void VRattleDynamics::ShareResult::merge(const ShareResult& other) {
    error = larger(error, other.error);
    pieceError = larger(pieceError, other.pieceError);
    pivot = -larger(-pivot, -other.pivot);
    iterations = std::max(iterations, other.iterations);
    failed = std::max(failed, other.failed);
}

// Go through all particles block by block, calling blockTask(block), a task for its part of each batch, task(batch, first cluster,
// end, result), and one for particles without constraints, freeTask(particle); then through the parts of whole clusters,
// partTask(part, result), and the pieces of those that are cut, pieceTask(piece, result). Each thread takes its share. A cluster is
// worked on in the same lane of a pack whatever the number of threads, since blocks begin at whole packs.
template <class BlockTask, class Task, class FreeTask, class PartTask, class PieceTask>
VRattleDynamics::ShareResult VRattleDynamics::runShared(const BlockTask& blockTask, const Task& task,
                                                        const FreeTask& freeTask, const PartTask& partTask,
                                                        const PieceTask& pieceTask) {
    const auto& batches = system.getBatches();
    const auto& blocks = system.getBlocks();
    const auto& parts = system.getGeneralParts();
    const auto& pieces = system.getPieces();
    const vector<int>& freeParticles = system.getFreeParticles();
    return runOnThreads([&](int thread, int numThreads, ShareResult& result) {
        const size_t numBlocks = blocks.size() - 1, endBlock = numBlocks * (thread + 1) / numThreads;
        for (size_t b = numBlocks * thread / numThreads; b < endBlock; b++) {
            blockTask((int) b);
            for (size_t k = 0; k < batches.size(); k++) {
                const int first = blocks[b].clusters[k], end = blocks[b + 1].clusters[k];
                if (first < end)
                    task(*batches[k], first, end, result);
            }
            for (int k = blocks[b].freeParticle; k < blocks[b + 1].freeParticle; k++)
                freeTask(freeParticles[k]);
        }
        const size_t endPart = parts.size() * (thread + 1) / numThreads;
        for (size_t k = parts.size() * thread / numThreads; k < endPart; k++)
            partTask(parts[k], result);
        const size_t endPiece = pieces.size() * (thread + 1) / numThreads;
        for (size_t k = pieces.size() * thread / numThreads; k < endPiece; k++)
            pieceTask(pieces[k], result);
    });
}

// Run a task on the pieces of cut clusters: task(piece, result).
template <class PieceTask> VRattleDynamics::ShareResult VRattleDynamics::runOnPieces(const PieceTask& task) {
    const auto& pieces = system.getPieces();
    if (pieces.empty())
        return ShareResult();
    return runOnThreads([&](int thread, int numThreads, ShareResult& result) {
        const size_t endPiece = pieces.size() * (thread + 1) / numThreads;
        for (size_t k = pieces.size() * thread / numThreads; k < endPiece; k++)
            task(pieces[k], result);
    });
}

// Call share(thread, number of threads, result) on each thread, or once if that is faster.
template <class Share> VRattleDynamics::ShareResult VRattleDynamics::runOnThreads(const Share& share) {
    if (!parallel || system.getNumConstraints() < MIN_PARALLEL_CONSTRAINTS) {
        ShareResult result;
        share(0, 1, result);
        return result;
    }
    typedef std::chrono::steady_clock Clock;
    const Clock::time_point start = Clock::now();
    ShareResult result;
    if (threadChoice.isParallel()) {
        const int numThreads = (int) threadResults.size();
        parallel([&](int thread) {
            ShareResult own; // on the thread's own stack, away from those of others
            share(thread, numThreads, own);
            threadResults[thread] = own;
        });
        for (const ShareResult& each : threadResults)
            result.merge(each);
    }
    else
        share(0, 1, result);
    sharedSeconds += std::chrono::duration<double>(Clock::now() - start).count();
    return result;
}

// Run a task on the joints of each cut cluster, when that on the pieces has ended.
template <class JointTask> void VRattleDynamics::forJoints(const JointTask& task) {
    for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
        task(cluster);
}

// Where the iteration starts. Lambda(q,p) agrees with lambda to O(h^2); what they differed by in the last step makes
// that O(h^3).
void VRattleDynamics::startMultipliers(bool withOffset, int first, int end) {
    for (int k = first; k < end; k++)
        lambdaNext[k] = withOffset ? lambda[k] + multiplierOffset[k] : lambda[k];
}

void VRattleDynamics::startMultipliers(bool withOffset) {
    startMultipliers(withOffset, 0, system.getNumConstraints());
}

void VRattleDynamics::keepOffsets() {
    densityOffset = rhoNext - StepDensity::sumUpdate(u, rho);
    for (size_t k = 0; k < lambdaNext.size(); k++)
        multiplierOffset[k] = lambdaNext[k] - lambda[k];
}

StepArrays VRattleDynamics::stepArrays(const Trial& trial) {
    return {q.data(),          trial.start.data(), force.data(),           qNext.data(),          wNext.data(),
            lambdaNext.data(), correction.data(),  multiplierTrial.data(), rightSideTrial.data(), trial.kick,
            trial.drift};
}

// w+ = start + kick M^-1 (F - G^T lambda) (3.10), q+ = q + drift w+ (3.9); w+ is kept if it is asked for.
void VRattleDynamics::computeTrial(const Trial& trial, const int* firstParticle, const int* endParticle,
                                   const ConstraintSystem::Part& part, bool withVelocities) {
    const vector<double>& inverseMasses = system.getInverseMasses();
    vector<Vec3>& acceleration = withVelocities ? wNext : qNext; // until these are known
    for (const int* i = firstParticle; i < endParticle; i++)
        acceleration[*i] = force[*i] * inverseMasses[*i];
    system.addTransposedOverMass(jacobian, lambdaNext, -1.0, acceleration, part);
    for (const int* i = firstParticle; i < endParticle; i++) {
        const Vec3 velocity = trial.start[*i] + acceleration[*i] * trial.kick;
        if (withVelocities)
            wNext[*i] = velocity;
        qNext[*i] = q[*i] + velocity * trial.drift;
    }
}

void VRattleDynamics::computeTrial(const Trial& trial) {
    computeTrial(trial, movingParticles.data(), movingParticles.data() + movingParticles.size(), ConstraintSystem::ALL,
                 true);
}

void VRattleDynamics::computeTrial(const Trial& trial, const ConstraintSystem::Part& part, bool withVelocities) {
    const int* particles = system.getGeneralParticles().data();
    computeTrial(trial, particles + part.firstParticle, particles + part.endParticle, part, withVelocities);
}

void VRattleDynamics::moveFreeParticle(int i, const Trial& trial) {
    wNext[i] = trial.start[i] + force[i] * (trial.kick * system.getInverseMasses()[i]);
    qNext[i] = q[i] + wNext[i] * trial.drift;
}

// Solve g(q+) = 0 (3.11) for lambda, with given kick and drift, by chord iterations with A = -kick drift K(q).
bool VRattleDynamics::solvePositions(const Trial& trial, double margin) {
    const bool withOffset = margin == REGULAR_MARGIN;
    forJoints([&](const ConstraintSystem::CutCluster& cluster) {
        startMultipliers(withOffset, cluster.joints.first, cluster.joints.end);
    });
    if (system.getFirstGeneral() < system.getNumConstraints())
        ensureFactor(GeneralFactor);
    const StepArrays arrays = stepArrays(trial);
    const double tolerance = margin * settings.tolerance;
    ShareResult result =
        runShared([](int) {},
                  [&](const ClusterBatch& batch, int begin, int end, ShareResult& share) {
                      startMultipliers(withOffset, batch.getFirstConstraint(begin), batch.getFirstConstraint(end));
                      share.error =
                          larger(share.error, batch.solvePositions(arrays, begin, end, tolerance, share.iterations));
                  },
                  [&](int i) { moveFreeParticle(i, trial); },
                  [&](const ConstraintSystem::Part& part, ShareResult& share) {
                      startMultipliers(withOffset, part.first, part.end);
                      share.error = larger(share.error, solveGeneral(part, trial, tolerance, share.iterations));
                  },
                  [&](const ConstraintSystem::Part& piece, ShareResult& share) {
                      startMultipliers(withOffset, piece.first, piece.end);
                      share.pieceError = larger(share.pieceError, evaluatePiece(piece, trial, tolerance, true));
                  });
    if (!system.getPieces().empty())
        result.error = larger(result.error, solvePieces(trial, result.pieceError, tolerance, result.iterations));
    lastError = result.error;
    numIterations += result.iterations;
    return lastError <= settings.tolerance || solvePositionsByNewton(trial);
}

// Whether an iteration is to end: when there has been at least one update, since Lambda itself, unrefined, costs accuracy even where
// it meets the tolerance, and the error is small enough, or no longer reduced, so that it is rounding, or Newton's to deal with.
bool VRattleDynamics::isLastIteration(int iteration, double error, double previous, double tolerance) {
    return iteration > 0 && (error <= tolerance || !(error < 0.5 * previous) || iteration == MAX_CHORD_ITERATIONS);
}

// The same for clusters that are in no batch and not cut; returns the largest |g| left.
double VRattleDynamics::solveGeneral(const ConstraintSystem::Part& part, const Trial& trial, double tolerance,
                                     int& iterations) {
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0;; iteration++) {
        computeTrial(trial, part, iteration > 0); // there is at least one update
        const double error = system.evaluate(qNext, correction, jacobian, part);
        if (isLastIteration(iteration, error, previous, tolerance)) {
            iterations = std::max(iterations, iteration);
            return error;
        }
        previous = error;
        matrix.solve(correction, part);
        updateMultipliers(trial, part.first, part.end);
    }
}

void VRattleDynamics::updateMultipliers(const Trial& trial, int first, int end) {
    for (int k = first; k < end; k++)
        lambdaNext[k] += correction[k] / (trial.kick * trial.drift);
}

// Evaluate a piece for the present multipliers, and begin to solve for their next correction if there will be one for certain;
// returns the largest |g|.
double VRattleDynamics::evaluatePiece(const ConstraintSystem::Part& piece, const Trial& trial, double tolerance,
                                      bool isFirst) {
    computeTrial(trial, piece, !isFirst);
    const double error = system.evaluate(qNext, correction, jacobian, piece);
    isPieceEliminated[piece.piece] = isFirst || error > tolerance;
    if (isPieceEliminated[piece.piece])
        matrix.eliminate(correction, piece);
    return error;
}

// The iteration for cut clusters, after evaluatePiece() for all pieces, which found the error.
double VRattleDynamics::solvePieces(const Trial& trial, double error, double tolerance, int& iterations) {
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0;; iteration++) {
        forJoints([&](const ConstraintSystem::CutCluster& cluster) {
            error = larger(error, system.evaluate(qNext, correction, jacobian, cluster.joints));
        });
        if (isLastIteration(iteration, error, previous, tolerance)) {
            iterations = std::max(iterations, iteration);
            return error;
        }
        previous = error;
        if (std::count(isPieceEliminated.begin(), isPieceEliminated.end(), false) > 0)
            runOnPieces([&](const ConstraintSystem::Part& piece, ShareResult&) {
                if (!isPieceEliminated[piece.piece])
                    matrix.eliminate(correction, piece);
            });
        forJoints([&](const ConstraintSystem::CutCluster& cluster) {
            matrix.solveJoints(correction, cluster);
            updateMultipliers(trial, cluster.joints.first, cluster.joints.end);
        });
        error = runOnPieces([&](const ConstraintSystem::Part& piece, ShareResult& share) {
                    matrix.substitute(correction, piece);
                    updateMultipliers(trial, piece.first, piece.end);
                    share.error = larger(share.error, evaluatePiece(piece, trial, tolerance, false));
                }).error;
    }
}

// The same for all constraints with Newton's iteration: G(q+) M^-1 G(q)^T in place of K. Where the chord iteration fails.
bool VRattleDynamics::solvePositionsByNewton(const Trial& trial) {
    ensureFactor(FullFactor);
    // From where the chord iteration has come to, and if that was too far off, from Lambda.
    if (iterateNewton(trial))
        return true;
    startMultipliers(false);
    return iterateNewton(trial);
}

bool VRattleDynamics::iterateNewton(const Trial& trial) {
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        computeTrial(trial);
        lastError = system.evaluate(qNext, residual, jacobian);
        if (!std::isfinite(lastError))
            return false;
        const bool isSlow = lastError > SLOW_CONVERGENCE * previous;
        if (iteration > 0 && lastError <= settings.tolerance * (isSlow ? 1.0 : REGULAR_MARGIN))
            return true;
        previous = lastError;
        correction = residual;
        system.evaluateJacobian(qNext, jacobianNext);
        if (!newtonMatrix.factorize(jacobianNext, jacobian))
            return false;
        newtonMatrix.solve(correction);
        updateMultipliers(trial, 0, system.getNumConstraints());
        numIterations++;
    }
    return false;
}

/*
 * Solve (3.11) and (3.14) for lambda and rho+ together. In each pass lambda gets its chord update and rho+ that of
 * Newton's iteration on F = rho+ + rho - u(q,p+) - u(q,p-), whose derivative is 1 + (h/(2 rho+^2)) du/dp (F - G^T Lambda)
 * along the constraints; what either update does to the other's equation is of higher order in h and left to the next pass.
 */
VRattleDynamics::SolveResult VRattleDynamics::solveCoupled() {
    const double h = settings.stepSize;
    if (!hasHalfStepValue) {
        halfStepValue = evaluateU(w);
        hasHalfStepValue = true;
    }
    if (system.getFirstGeneral() < system.getNumConstraints())
        ensureFactor(GeneralFactor);
    rhoNext = StepDensity::sumUpdate(u, rho) + densityOffset;
    if (!(rhoNext > 0))
        return TooSlow;
    startMultipliers(true);
    std::fill(correction.begin(), correction.end(), 0.0);
    double previous = std::numeric_limits<double>::infinity();
    const double densityTolerance = std::max(REGULAR_MARGIN * settings.tolerance, DENSITY_ROUNDING);
    for (int pass = 0; pass <= MAX_CHORD_ITERATIONS; pass++) {
        const Trial trial = {w, 0.5 * h * (1 / rho + 1 / rhoNext), h / rhoNext};
        const StepArrays arrays = stepArrays(trial);
        const ShareResult result = runShared([](int) {},
                                             [&](const ClusterBatch& batch, int begin, int end, ShareResult& share) {
                                                 share.error =
                                                     larger(share.error, batch.coupledPass(arrays, begin, end));
                                             },
                                             [&](int i) { moveFreeParticle(i, trial); },
                                             [&](const ConstraintSystem::Part& part, ShareResult& share) {
                                                 share.error = larger(share.error, coupledPassGeneral(part, trial));
                                             },
                                             [&](const ConstraintSystem::Part& piece, ShareResult& share) {
                                                 share.error = larger(share.error, beginCoupledPass(piece, trial));
                                             });
        lastError = larger(result.error, finishCoupledPassOfPieces(trial));
        monitor.evaluate(wNext, multiplierTrial, rightSideTrial, valuesTrial);
        const double mismatch = rhoNext + rho - combineAndLimit(valuesTrial) - halfStepValue;
        const double error = std::max(lastError / (REGULAR_MARGIN * settings.tolerance),
                                      std::fabs(mismatch) / ((rhoNext + rho) * densityTolerance));
        if (pass > 0 && error <= 1)
            return Converged;
        if (!std::isfinite(error) || error > SLOW_COUPLED_CONVERGENCE * previous)
            return TooSlow;
        previous = error;
        rhoNext -= mismatch / (1 + 0.5 * h * rate / (rhoNext * rhoNext));
        if (!(rhoNext > 0))
            return TooSlow;
        numIterations++;
    }
    return TooSlow;
}

// One pass of the coupled iteration for clusters that are in no batch and not cut; see ClusterBatch::coupledPass().
double VRattleDynamics::coupledPassGeneral(const ConstraintSystem::Part& part, const Trial& trial) {
    const double error = beginCoupledPass(part, trial);
    matrix.substitute(multiplierTrial, part);
    matrix.substitute(correction, part);
    return error;
}

// Its first half: evaluate a part for corrected multipliers, and begin to solve for Lambda there and for their next correction.
double VRattleDynamics::beginCoupledPass(const ConstraintSystem::Part& part, const Trial& trial) {
    for (int k = part.first; k < part.end; k++)
        lambdaNext[k] += correction[k];
    computeTrial(trial, part, true);
    const double error = formCoupledEquations(part, trial);
    matrix.eliminate(multiplierTrial, part, 0);
    matrix.eliminate(correction, part, 1);
    return error;
}

double VRattleDynamics::formCoupledEquations(const ConstraintSystem::Part& part, const Trial& trial) {
    const double error = system.evaluate(qNext, correction, jacobian, part);
    system.evaluateCurvature(q, wNext, rightSideTrial, part);
    for (int k = part.first; k < part.end; k++) {
        multiplierTrial[k] = rightSideTrial[k] += appliedTerm[k];
        correction[k] /= trial.kick * trial.drift;
    }
    return error;
}

// The rest for cut clusters, after beginCoupledPass() for all pieces; returns the largest |g| of the joints.
double VRattleDynamics::finishCoupledPassOfPieces(const Trial& trial) {
    double error = 0;
    forJoints([&](const ConstraintSystem::CutCluster& cluster) {
        error = larger(error, formCoupledEquations(cluster.joints, trial));
        matrix.solveJoints(multiplierTrial, cluster, 0);
        matrix.solveJoints(correction, cluster, 1);
    });
    runOnPieces([&](const ConstraintSystem::Part& piece, ShareResult&) {
        matrix.substitute(multiplierTrial, piece);
        matrix.substitute(correction, piece);
    });
    return error;
}

// Newton's iteration on (lambda, rho+) for (3.11) and (3.14) by the Schur complement (docs/method.md, section 8), for
// all constraints. Where the coupled chord iteration fails.
VRattleDynamics::SolveResult VRattleDynamics::solveCoupledByNewton() {
    ensureFactor(FullFactor);
    const double h = settings.stepSize;
    const double uMinus = evaluateU(w);
    startMultipliers(true);
    rhoNext = StepDensity::sumUpdate(u, rho);
    if (!(rhoNext > 0))
        rhoNext = density.boundedUpdate(u, rho);
    int numCuts = 0;
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < MAX_NEWTON_ITERATIONS; iteration++) {
        const double kick = 0.5 * h * (1 / rho + 1 / rhoNext), drift = h / rhoNext;
        computeTrial({w, kick, drift});
        lastError = system.evaluate(qNext, residual, jacobian);
        const double uPlus = evaluateU(wNext);
        const double mismatch = rhoNext + rho - uPlus - uMinus; // F_rho of docs/method.md, section 8
        const double relativeMismatch = std::fabs(mismatch) / (rhoNext + rho);
        const double error =
            std::max(lastError / (REGULAR_MARGIN * settings.tolerance),
                     relativeMismatch / std::max(REGULAR_MARGIN * settings.tolerance, DENSITY_ROUNDING));
        if (!std::isfinite(error))
            return NotConverged;
        const bool isSlow = error > SLOW_CONVERGENCE * previous;
        const bool isGoodEnough = lastError <= settings.tolerance && relativeMismatch <= STRAINED_DENSITY_ROUNDING;
        if (iteration > 0 && (error <= 1 || (isSlow && isGoodEnough)))
            return Converged;
        previous = error;
        system.evaluateJacobian(qNext, jacobianNext);
        if (!newtonMatrix.factorize(jacobianNext, jacobian))
            return NotConverged;
        // a = dF/dlambda, d = dF/drho+, and response = x2 = A^-1 dg/drho+
        monitor.evaluateGradient(q, wNext, multiplierTrial, valuesTrial, matrix, gradient);
        const double derivative = density.limitDerivative(monitor.combine(valuesTrial));
        system.multiplyOverMass(jacobian, gradient, coupling);
        for (double& a : coupling)
            a *= kick * derivative;
        double d = 1;
        const double kickChange = -0.5 * h / (rhoNext * rhoNext); // d(kick)/d(rho+)
        for (int i : movingParticles) {
            const Vec3 kickPart = (wNext[i] - w[i]) * (kickChange / kick); // of dw+/drho+
            d -= derivative * gradient[i].dot(kickPart);
            halfStepChange[i] = kickPart * drift - wNext[i] * (drift / rhoNext);
        }
        system.multiply(jacobianNext, halfStepChange, response);
        newtonMatrix.solve(response);
        for (double& x : response)
            x /= -kick * drift;
        correction = residual; // x1 = -A^-1 g
        newtonMatrix.solve(correction);
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
    const double h = settings.stepSize;
    auto solveWith = [&](double next) {
        rhoNext = next;
        return solvePositions({w, 0.5 * (h / rho + h / rhoNext), h / rhoNext}, REGULAR_MARGIN);
    };
    const bool isFixed = settings.isFixedStep || monitor.isEmpty();
    bool isSolved;
    if (isFixed)
        isSolved = solveWith(settings.isAutomatic && !settings.isFixedStep ? automatic.getNext() : 1);
    else if (settings.update == StepDensity::Bounded)
        isSolved = solveWith(density.boundedUpdate(u, rho));
    else if (needsHalfStepValue())
        isSolved = solveCoupled() == Converged || solveCoupledByNewton() == Converged;
    else {
        const double next = StepDensity::sumUpdate(u, rho);
        isSolved = next > 0 && solveWith(next);
    }
    if (isFixed || settings.update == StepDensity::Bounded) {
        if (!isSolved)
            throwNotConverged();
    }
    else if (!isSolved || density.isFarBelowBound(rhoNext)) {
        // A rescue: the sum gave no step, or one far above the maximum.
        if (!solveWith(density.boundedUpdate(u, rho)))
            throwNotConverged();
        numRescues++;
    }
    return h / rhoNext;
}

void VRattleDynamics::throwNotConverged() const {
    std::stringstream reason;
    const int worst = system.findLargest(residual, jacobian);
    if (std::isfinite(lastError))
        reason << system.describe(worst) << " could not be solved for (relative error " << lastError << " left)";
    else if (system.isExpression(worst) && !std::isfinite(residual[worst]))
        reason << system.describe(worst) << " became " << residual[worst];
    else
        reason << "the constraints could not be solved for (the iteration diverged)";
    if (hasDensity && settings.isAutomatic)
        reason << "; the step tried was of " << settings.stepSize / rhoNext << " ps";
    else if (hasDensity && !monitor.isEmpty())
        reason << "; u = U/U_ref was " << u << " before the step and the last one tried was of "
               << settings.stepSize / rhoNext << " ps";
    throw StepFailure(reason.str());
}

// ------------------------------------------------------------------------------------------------------- the steps

double VRattleDynamics::step(double maxStep) {
    sharedSeconds = 0;
    double full;
    if (hasDensity) {
        stepKind = Regular;
        full = solveRegular();
    }
    else {
        if (settings.isAutomatic && !settings.isFixedStep)
            throw StepFailure("the automatic step control has not been started");
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
        if (isShortened)
            stepKind = Shortened;
        if (!solvePositions({v, 0.5 * stepNext, stepNext}, ON_STEP_MARGIN))
            throwNotConverged();
    }
    if (isShortened && hasDensity) // where the density would be at the end of the shortened step
        rhoNext = rho + (rhoNext - rho) * std::min(1.0, stepNext / full);
    kickNext = 0.5 * stepNext;
    return stepNext;
}

bool VRattleDynamics::finish(vector<Vec3>& forces, double energy) {
    const bool isStart = stepKind == First && !settings.isFixedStep && !monitor.isEmpty();
    vector<double> backValues;
    const bool hasBack = isStart && evaluateBackwards(forces, energy, backValues);
    const vector<double> startValues = hasBack && needsHalfStepValue() ? evaluateHalfSteps() : values;
    const bool withHalfStep = needsHalfStepValue() && stepKind != Shortened;
    evaluateOnStep(qNext, wNext, forces, energy, kickNext, vNext, lambdaOnStep, rightSideNext, valuesNext,
                   withHalfStep);
    if (isStart && !startDensityFrom(startValues, backValues, hasBack))
        return false;
    if (settings.isAutomatic)
        automatic.measure(vNext, forces, lambdaOnStep, rightSideNext, wNext, stepNext, force);
    // From here on nothing fails.
    threadChoice.add(sharedSeconds);
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
    v.swap(vNext);
    w.swap(wNext);
    force.swap(forces);
    groupEnergy = energy;
    lambda.swap(lambdaOnStep);
    rightSide.swap(rightSideNext);
    values.swap(valuesNext);
    jacobian.swap(jacobianNext);
    appliedTerm.swap(appliedTermNext);
    factorScope = GeneralFactor;
    monitor.forcesMoved(force);
    isMonitorCurrent = true;
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
    if (hasDensity) {
        const long long rescuesBefore = numRescues;
        solveRegular();
        keepOffsets();
        numRescues = rescuesBefore;
        for (int i : movingParticles)
            w[i] = -wNext[i];
        rho = rhoNext;
        automatic.reverse();
        rate = -rate;
        hasHalfStepValue = false;
    }
    for (int i : movingParticles)
        v[i] = -v[i];
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
 */
bool VRattleDynamics::evaluateBackwards(const vector<Vec3>& forces, double energy, vector<double>& backValues) {
    qNext.swap(qBack);
    wNext.swap(wBack);
    bool isSolved = solvePositions({v, -0.5 * stepNext, -stepNext}, ON_STEP_MARGIN);
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
                       lambdaBack, rightSideBack, backValues, false);
    }
    catch (const StepFailure&) {
        return false; // no state to look back at
    }
    return true;
}

// The mean of U_k(q0,p) over the half-step momenta on either side of the start, which is what (3.14) takes.
vector<double> VRattleDynamics::evaluateHalfSteps() {
    evaluateU(wNext);
    vector<double> result = valuesTrial;
    evaluateU(wBack);
    for (size_t k = 0; k < result.size(); k++)
        result[k] = 0.5 * (result[k] + valuesTrial[k]);
    return result;
}

// Returns whether the first step stands; if not, firstDensity says with which density to take it again.
bool VRattleDynamics::startDensityFrom(const vector<double>& startValues, const vector<double>& backValues,
                                       bool hasBack) {
    const vector<StepMonitor::Term>& terms = monitor.getTerms();
    bool areAllTaken = true;
    for (size_t k = 0; k < terms.size(); k++) {
        if (terms[k].reference > 0)
            areAllTaken = false;
        else if (monitor.isNegligible((int) k, values[k], v, jacobian))
            throw StepFailure(
                "monitor " + std::to_string(k) +
                " is zero at the first step, which is then no measure for later ones; call calibrate() or "
                "setReferenceMonitorValue()");
    }
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
