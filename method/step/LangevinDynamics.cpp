// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/LangevinDynamics.h"
#include "constraints/StepFailure.h"
#include "openmm/internal/OSRngSeed.h"
#include "step/RandomNumbers.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

const double BOLTZMANN = 0.00831446261815324; // kJ/mol/K

// k is the smallest number with 2^k >= (U/U_ref)^POWER/TRIGGER.
const double POWER = 2.0 / 3.0, TRIGGER = 2.2;
// U_ref is no less than this change of momentum a step, in units of the thermal one, or this part of the size of the system (see
// findFloor()), and begins with no more than the multiple of that. It changes by the rate in each step.
const double FLOOR = 0.5, FLOOR_PART = 0.2, LARGEST_START = 4, FOLLOWING_RATE = 0.002;
// What is thermal in a bath that is colder than this (K).
const double COLDEST = 10;
// A step of substeps whose U is more than this multiple of the floor, of a bath of these K or the one there is, teaches nothing.
const double LARGEST_THERMAL = 16, ROOM_TEMPERATURE = 300;
// A change of all velocities by less than this part of their mean size leaves U what it is.
const double SMALL_SHIFT = 0.05;
// The drifts are solved to this fraction of the tolerance: what is left is not the same forwards and backwards.
const double MARGIN = 0.1;
const int NO_LIMIT = std::numeric_limits<int>::max();

bool isFinite(const Vec3& x) {
    return std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]);
}

} // namespace

LangevinDynamics::LangevinDynamics(const vector<double>& masses, const vector<DistanceConstraint>& constraints,
                                   const vector<ExpressionConstraint>& expressions) :
        solver(masses, constraints, expressions), motion(solver.getSystem()), clusterForces(solver), groupEnergy(0),
        values(1, 0.0), reference(0), lastSubstep(0), seed(0), numDrawn(0), numSubstepped(0), largestSubsteps(1),
        isInProgress(false), isAtStart(false), doublings(0), substep(0), systemSize(0) {
    settings.langevin.emplace();
    for (vector<double>* numbers : {&lambda, &lambdaNow, &lambdaNext, &multipliers, &noMultipliers, &rightSide})
        numbers->resize(getConstraintSystem().getNumConstraints());
    noForce.resize(getConstraintSystem().getNumParticles());
    netAccelerations.resize(getConstraintSystem().getNumParticles());
    vector<char> isTied(getConstraintSystem().getNumParticles(), false);
    for (int k = 0; k < getConstraintSystem().getNumConstraints(); k++)
        if (!getConstraintSystem().isExpression(k))
            isTied[getConstraintSystem().getConstraint(k).particle1] =
                isTied[getConstraintSystem().getConstraint(k).particle2] = true;
    for (int i : solver.getMovingParticles())
        if (!isTied[i])
            loose.push_back(i);
    theta = thetaNow = thetaMiddle = thetaNext = getConstraintSystem().getGivenParameters();
    clusterSums.resize(clusterForces.getNumClusters());
    clusterForces.sumOverClusters([](int) { return 1.0; }, clusterSums);
    systemSize = clusterForces.eighthRootOfFourthPowers(clusterSums);
}

void LangevinDynamics::setParallel(const Parallel& parallel, int numThreads) {
    solver.setParallel(parallel, numThreads);
}

void LangevinDynamics::setSettings(const Settings& newSettings) {
    if (newSettings.langevin->randomSeed != settings.langevin->randomSeed || seed == 0) {
        seed = newSettings.langevin->randomSeed;
        while (seed == 0)
            seed = osrngseed();
        seed += (int64_t) newSettings.langevin->randomStream << 32;
        numDrawn = 0;
    }
    const bool isStepNew = newSettings.stepSize != settings.stepSize;
    settings = newSettings;
    solver.setTolerance(settings.tolerance);
    if (settings.langevin->reference > 0)
        reference = settings.langevin->reference;
    else if (reference > 0 && !settings.langevin->isReferenceFrozen) {
        // The floor of smaller steps is no reference for large ones, which would be blind until it has fallen.
        if (isStepNew)
            reference = std::min(reference, std::max(LARGEST_START * findFloor(), values[0]));
        reference = std::max(reference, findFloor());
    }
}

void LangevinDynamics::setRandomState(const vector<double>& state) {
    seed = (int64_t) state.at(0);
    numDrawn = (int64_t) state.at(1);
}

void LangevinDynamics::setReferences(const vector<double>& references) {
    if (settings.langevin->reference == 0)
        reference = references.at(0);
}

// ------------------------------------------------------------------------------------------- the monitor and its reference

// In thermal motion each A_c is as large as its number of particles N_c, and U as S = (sum_c N_c^4)^(1/8): 24 for a protein of 580 atoms
// that is one cluster, 2 for eight rigid waters, times what a particle has for itself.
double LangevinDynamics::findFloor(double coldest) const {
    const double kT = BOLTZMANN * std::max(settings.langevin->temperature, coldest);
    return settings.stepSize > 0 ? std::max(FLOOR, FLOOR_PART * systemSize) * std::sqrt(kT) / settings.stepSize : 0.0;
}

void LangevinDynamics::startReference() {
    if (reference == 0)
        reference = std::max(findFloor(), std::min(values[0], LARGEST_START * findFloor()));
}

double LangevinDynamics::getFollowingFactor() const {
    return settings.langevin->reference > 0 || settings.langevin->isReferenceFrozen ? 1.0 : std::exp(FOLLOWING_RATE);
}

// A running median. The heat of a clash must not teach it what is calm: where it leaves by less than the rate in a step, through a low
// friction or small steps, U_ref would meet U at a temperature that steps without substeps keep up by their own errors.
void LangevinDynamics::followReference() {
    const double factor = getFollowingFactor();
    if (factor == 1)
        return;
    if (doublings > 0 && values[0] > std::max(reference, LARGEST_THERMAL * findFloor(ROOM_TEMPERATURE)))
        return;
    reference *= values[0] > reference ? factor : values[0] < reference ? 1 / factor : 1.0;
    reference = std::max(findFloor(), reference);
}

double LangevinDynamics::findFloor() const {
    return findFloor(COLDEST);
}

double LangevinDynamics::findLargestCalm() const {
    return settings.langevin->maxDoublings > 0 ? std::pow(TRIGGER, 1 / POWER) : std::numeric_limits<double>::max();
}

// k, without its bound.
int LangevinDynamics::findDoublings(double u) const {
    const double asked = std::pow(u / reference, POWER) / TRIGGER;
    if (!std::isfinite(asked))
        return NO_LIMIT;
    int result = 0;
    for (double reached = 1; reached < asked; reached *= 2)
        result++;
    return result;
}

double LangevinDynamics::evaluateMonitor(const Vectors& accelerations, const Vectors& velocities) {
    const vector<double>& masses = getConstraintSystem().getMasses();
    clusterForces.sumOverClusters(
        [&](int i) {
            const double square = accelerations[i].dot(accelerations[i]),
                         speedSquared = velocities[i].dot(velocities[i]);
            return masses[i] * (square + std::sqrt(square) * speedSquared * (1 / FLIGHT_LENGTH));
        },
        clusterSums);
    return clusterForces.eighthRootOfFourthPowers(clusterSums);
}

// The same for the state between two steps.
double LangevinDynamics::evaluateMonitorOfState() {
    const Vectors& netForces = clusterForces.findNetForces(q, theta, force, lambda);
    for (int i : solver.getMovingParticles())
        netAccelerations[i] = netForces[i] * getConstraintSystem().getInverseMasses()[i];
    return evaluateMonitor(netAccelerations, v);
}

// The first of some particles whose vector is no number, or -1.
int LangevinDynamics::findNotFinite(const Vectors& x, const vector<int>& particles) {
    const double sum = solver.sum((int) particles.size(), [&](int p) { // of zeros, or a NaN
        const Vec3& each = x[particles[p]];
        return (each[0] - each[0]) + (each[1] - each[1]) + (each[2] - each[2]);
    });
    if (sum == 0)
        return -1;
    return *std::find_if(particles.begin(), particles.end(), [&](int i) { return !isFinite(x[i]); });
}

// ------------------------------------------------------------------------------------------------- between two steps

bool LangevinDynamics::projectPositions(Vectors& positions, const ExpressionParameters& parameters) {
    isAtStart = false;
    return solver.projectPositions(positions, parameters);
}

void LangevinDynamics::adoptParameters() {
    theta.values = motion.target;
    motion.rest(theta);
}

void LangevinDynamics::begin(const Vectors& positions, const Vectors& velocities, const Vectors& forces,
                             double energy) {
    motion.rest(theta);
    takeState(positions, velocities, forces, energy);
}

void LangevinDynamics::changeState(const Vectors& positions, const Vectors& velocities, const Vectors& forces,
                                   double energy) {
    takeState(positions, velocities, forces, energy);
}

void LangevinDynamics::takeState(const Vectors& positions, const Vectors& velocities, const Vectors& forces,
                                 double energy) {
    auto take = [&] {
        q = positions;
        v = velocities;
        force = forces;
        groupEnergy = energy;
        lastSubstep = 0;
        settle();
        evaluateOnStep();
    };
    attempt(take, remember());
}

// A state has been put in place of the one there was.
void LangevinDynamics::settle() {
    isInProgress = isAtStart = false;
    doublings = 0; // for whoever takes steps elsewhere, and lets U_ref follow here
    // Particles without mass stay as they are, in whatever array is written.
    qNow = qMiddle = qNext = q;
    vNow = wMiddle = wNext = vNext = v;
}

// P v, Lambda and U at q.
void LangevinDynamics::evaluateOnStep() {
    if (findNotFinite(force, solver.getMovingParticles()) >= 0)
        throw solver.explainForces(force);
    wNext = v;
    solver.moveTo(q, theta, force);
    solver.finish({q, wNext, force, theta, 0.0, v, lambda, rightSide, nullptr, &netAccelerations});
    solver.moveToEnd();
    isAtStart = true;
    values[0] = evaluateMonitor(netAccelerations, v);
}

std::function<void()> LangevinDynamics::remember() {
    return [this, positions = q, velocities = v, forces = force, energy = groupEnergy, nextParameters = motion.target,
            memory = getMemory()] {
        resume(positions, velocities, forces, energy, memory);
        motion.target = nextParameters;
    };
}

void LangevinDynamics::adopt(const Vectors& positions, const Vectors& velocities, const Vectors& forces, double energy,
                             const ExpressionParameters& parameters, double newReference, bool isFollowed,
                             int64_t drawn) {
    auto take = [&] {
        theta = parameters;
        takeState(positions, velocities, forces, energy);
    };
    attempt(take, [&, before = theta] { theta = before; });
    v = velocities; // which have been projected, and so changed in the last bits
    lastSubstep = settings.stepSize;
    reference = newReference;
    numDrawn = drawn;
    if (!isFollowed)
        followReference();
}

LangevinDynamics::Memory LangevinDynamics::getMemory() const {
    return {theta.values, theta.rates, lambda, values[0], lastSubstep};
}

void LangevinDynamics::resume(const Vectors& positions, const Vectors& velocities, const Vectors& forces, double energy,
                              const Memory& memory) {
    theta.values = memory.parameters;
    theta.rates = memory.parameterRates;
    theta.isMoving = std::any_of(theta.rates.begin(), theta.rates.end(), [](double rate) { return rate != 0; });
    q = positions;
    v = velocities;
    force = forces;
    groupEnergy = energy;
    lambda = memory.multipliers;
    values[0] = memory.monitorValue;
    lastSubstep = memory.lastSubstep;
    settle();
}

bool LangevinDynamics::changeFrame(const Vectors& before, const Vectors& velocities) {
    const bool areOwn = &before == &v;
    Vec3 shift;
    if (!solver.findFrameShift(before, velocities, shift))
        return false;
    const vector<int>& particles = solver.getMovingParticles();
    const double count = (double) particles.size(), square = shift.dot(shift);
    const double squares =
        solver.sum((int) particles.size(), [&](int p) { return v[particles[p]].dot(v[particles[p]]); });
    solver.share((int) particles.size(), [&](int first, int end) {
        for (int p = first; p < end; p++)
            v[particles[p]] = areOwn ? velocities[particles[p]] : v[particles[p]] + shift;
    });
    // What is removed in each step is less than U is known to.
    if (square * count > SMALL_SHIFT * SMALL_SHIFT * squares)
        values[0] = evaluateMonitorOfState();
    return true;
}

void LangevinDynamics::changeVelocities(const Vectors& velocities) {
    takeState(Vectors(q), velocities, Vectors(force), groupEnergy);
}

void LangevinDynamics::changeForces(Vectors& forces, double energy) {
    takeState(Vectors(q), Vectors(v), forces, energy);
}

void LangevinDynamics::reverse() {
    for (int i : solver.getMovingParticles())
        v[i] = -v[i];
    for (double& each : theta.rates)
        each = -each;
}

double LangevinDynamics::computeHalfStepKineticEnergy() {
    const vector<int>& particles = solver.getMovingParticles();
    const double kick = 0.5 * (lastSubstep > 0 ? lastSubstep : settings.stepSize);
    for (int i : particles)
        wNext[i] = vNext[i] = v[i] - force[i] * (kick * getConstraintSystem().getInverseMasses()[i]);
    if (!isAtStart)
        solver.moveTo(q, theta, force);
    isAtStart = true;
    solver.addProjection(wNext, theta, vNext);
    double sum = 0;
    for (int i : particles)
        sum += getConstraintSystem().getMasses()[i] * vNext[i].dot(vNext[i]);
    return 0.5 * sum;
}

// ---------------------------------------------------------------------------------------------------------- a step

LangevinDynamics::Noise LangevinDynamics::findNoise() const {
    const double damping = settings.langevin->friction * settings.stepSize;
    const double kT = BOLTZMANN * settings.langevin->temperature;
    return {std::exp(-damping), std::sqrt(-kT * std::expm1(-2 * damping))};
}

// v <- a v + sqrt(kT (1 - a^2)) M^-1/2 xi. The numbers xi are those of the step, whatever attempt asks for them.
void LangevinDynamics::addNoise(const int* particles, int count, Vectors& velocities) const {
    const Noise noise = findNoise();
    const double a = noise.damping, s = noise.size;
    const vector<double>& inverseMasses = getConstraintSystem().getInverseMasses();
    Vec3 numbers[RandomNumbers::BLOCK];
    for (int first = 0; first < count && a != 1; first += RandomNumbers::BLOCK) {
        const int size = std::min(RandomNumbers::BLOCK, count - first);
        if (s > 0 && givenNoise.empty())
            RandomNumbers::normal((uint64_t) seed, (uint64_t) numDrawn, particles + first, size, numbers);
        for (int k = 0; k < size; k++) {
            const int i = particles[first + k];
            velocities[i] *= a;
            if (s > 0)
                velocities[i] += (givenNoise.empty() ? numbers[k] : givenNoise[i]) * (s * std::sqrt(inverseMasses[i]));
        }
    }
}

double LangevinDynamics::step(double) {
    if (!isInProgress) {
        solver.beginStep();
        startReference();
        motion.prepare(q, theta);
        doublings = std::min(findDoublings(values[0]), settings.langevin->maxDoublings);
        startAttempt();
    }
    std::string reason;
    while (!trySubstep(reason))
        raise(reason);
    const int substeps = LangevinSettings::getSubsteps(doublings);
    return substep + 1 == substeps ? settings.stepSize : (substep + 1) * findSubstep();
}

// From the state before the step, with the present k.
void LangevinDynamics::startAttempt() {
    isInProgress = true;
    substep = 0;
    if (!isAtStart)
        solver.moveTo(q, theta, force);
    isAtStart = true;
}

// The attempt has failed.
void LangevinDynamics::raise(const std::string& reason) {
    if (doublings == settings.langevin->maxDoublings) {
        evaluateMonitorOfState();
        const auto hardest = std::max_element(clusterSums.begin(), clusterSums.end());
        std::stringstream message;
        message << reason << ", in a step of " << LangevinSettings::getSubsteps(doublings)
                << " substeps (k = " << doublings << "); before it the monitor U was " << values[0] / reference
                << " times its reference value";
        if (hardest != clusterSums.end())
            message << ", the hardest being " << clusterForces.describe((int) (hardest - clusterSums.begin()));
        throw StepFailure(message.str());
    }
    doublings++;
    startAttempt();
}

// The first half of a substep, to qNext and wNext. Returns whether its equations have been solved.
bool LangevinDynamics::trySubstep(std::string& reason) {
    const bool isFirst = substep == 0;
    const Vectors& start = isFirst ? v : vNow;
    const vector<double>& guess = isFirst ? lambda : lambdaNow;
    const int substeps = LangevinSettings::getSubsteps(doublings);
    const double d = findSubstep(), end = substep + 1 == substeps ? settings.stepSize : (substep + 1) * d;
    motion.follow(end, settings.stepSize, thetaNext);
    if (2 * substep + 1 != substeps)
        return tryDrift({start, 0.5 * d, d, thetaNext, qNext, wNext, multipliers}, guess, reason);

    return tryCentralDrift(start, d, guess, reason);
}

// Half of it, noise, and the other half.
bool LangevinDynamics::tryCentralDrift(const Vectors& start, double d, const vector<double>& guess,
                                       std::string& reason) {
    struct Noise : ConstraintSolver::Change {
        explicit Noise(LangevinDynamics& dynamics) : dynamics(dynamics) {
        }
        void changeVelocities(const int* particles, int count) override {
            dynamics.addNoise(particles, count, dynamics.wMiddle);
        }
        LangevinDynamics& dynamics;
    } noise(*this);
    motion.follow(0.5 * settings.stepSize, settings.stepSize, thetaMiddle);
    const ConstraintSolver::Trial toNoise{start, 0.5 * d, 0.5 * d, thetaMiddle, qMiddle, wMiddle, multipliers};
    const ConstraintSolver::Trial fromNoise{wMiddle, 0.5 * d, 0.5 * d, thetaNext, qNext, wNext, multipliers};
    if (solver.solveInTurn(toNoise, {guess, nullptr, MARGIN}, noise, fromNoise, {noMultipliers, nullptr, MARGIN},
                           noForce)) {
        isAtStart = false;
        return !isNowhere(qNext, reason);
    }
    if (!tryDrift(toNoise, guess, reason))
        return false;
    const vector<int>& particles = solver.getMovingParticles();
    solver.share((int) particles.size(),
                 [&](int first, int end) { noise.changeVelocities(particles.data() + first, end - first); });
    isAtStart = false;
    solver.moveTo(qMiddle, thetaMiddle, noForce);
    return tryDrift(fromNoise, noMultipliers, reason);
}

bool LangevinDynamics::tryDrift(const ConstraintSolver::Trial& trial, const vector<double>& guess,
                                std::string& reason) {
    try {
        if (!solver.solvePositions(trial, {guess, nullptr, MARGIN})) {
            reason = solver.explainFailure(trial);
            return false;
        }
    }
    catch (const StepFailure& failure) {
        reason = failure.what();
        return false;
    }
    return !isNowhere(trial.positions, reason);
}

// Whether a position is no number, where constraints have been solved for.
bool LangevinDynamics::isNowhere(const Vectors& positions, std::string& reason) {
    const int lost = findNotFinite(positions, loose);
    if (lost >= 0)
        reason = "the position of particle " + std::to_string(lost) + " became infinite or not a number";
    return lost >= 0;
}

bool LangevinDynamics::finish(Vectors& forces, double energy) {
    const int substeps = LangevinSettings::getSubsteps(doublings);
    isAtStart = false;
    const bool isLast = substep + 1 == substeps;
    auto isForceLost = [&] {
        const int lost = findNotFinite(forces, solver.getMovingParticles());
        if (lost >= 0)
            raise("the force on particle " + std::to_string(lost) + " became infinite or not a number");
        return lost >= 0;
    };
    if (!isLast && isForceLost()) // at the end U would tell
        return false;
    try {
        solver.finish({qNext, wNext, forces, thetaNext, 0.5 * findSubstep(), vNext, lambdaNext, rightSide, nullptr,
                       isLast ? &netAccelerations : nullptr});
    }
    catch (const StepFailure& failure) {
        raise(failure.what());
        return false;
    }
    substep++;
    if (!isLast) {
        qNow.swap(qNext);
        vNow.swap(vNext);
        std::swap(thetaNow, thetaNext);
        lambdaNow.swap(lambdaNext);
        forceNow = forces;
        solver.moveToEnd(qNow, thetaNow, forceNow);
        return false;
    }
    const double u = evaluateMonitor(netAccelerations, vNext);
    if (!std::isfinite(u)) {
        if (!isForceLost())
            raise("the monitor U became infinite or not a number");
        return false;
    }
    if (doublings < settings.langevin->maxDoublings && findDoublings(u) > doublings) {
        raise("");
        return false;
    }
    q.swap(qNext);
    v.swap(vNext);
    force.swap(forces);
    groupEnergy = energy;
    std::swap(theta, thetaNext);
    lambda.swap(lambdaNext);
    solver.moveToEnd(q, theta, force);
    solver.endStep();
    isAtStart = true;
    isInProgress = false;
    values[0] = u;
    lastSubstep = findSubstep();
    numDrawn++;
    numSubstepped += doublings > 0;
    largestSubsteps = std::max(largestSubsteps, substeps);
    followReference();
    return true;
}

void LangevinDynamics::abandonStep() {
    isInProgress = isAtStart = false;
}
