// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/StepMonitor.h"
#include <algorithm>
#include <cmath>
#include <initializer_list>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// The sum of term(0), ..., term(count - 1) in four interleaved parts: a processor waits for each addition to one number, and
// adds to several at a time.
template <class Term> double sumOf(int count, Term term) {
    double part[4] = {0, 0, 0, 0};
    int i = 0;
    for (; i + 4 <= count; i += 4)
        for (int j = 0; j < 4; j++)
            part[j] += term(i + j);
    for (; i < count; i++)
        part[0] += term(i);
    return (part[0] + part[1]) + (part[2] + part[3]);
}

// (sum |x|^p)^(1/p), scaled by the largest |x| so that no power overflows.
template <class Size> double pNorm(int count, double order, Size size) {
    double largest = 0;
    for (int i = 0; i < count; i++)
        largest = std::max(largest, size(i));
    if (largest == 0)
        return 0;
    return largest * std::pow(sumOf(count, [&](int i) { return std::pow(size(i) / largest, order); }), 1 / order);
}

bool usesConstraintsOnly(StepMonitor::Kind kind) {
    return kind == StepMonitor::ConstraintMultipliers || kind == StepMonitor::ConstraintForce ||
           kind == StepMonitor::MultiplierPNorm;
}

bool usesMultipliers(StepMonitor::Kind kind) {
    return usesConstraintsOnly(kind) || kind == StepMonitor::ConstraintAndAppliedForce;
}

bool isOfVelocities(StepMonitor::Kind kind) {
    return kind == StepMonitor::VectorField || kind == StepMonitor::ArcLength ||
           kind == StepMonitor::MaxParticleArcLength;
}

} // namespace

StepMonitor::StepMonitor(ConstraintSolver& solver) :
        solver(solver), system(solver.getSystem()), forces(nullptr), groupEnergy(0), appliedForceSquared(0),
        forceSquared(0), maxForce(0), constraintForceSquared(0), blockSums(system.getBlocks().size() - 1),
        toSolve(system.getNumConstraints()), solved(system.getNumConstraints()) {
}

void StepMonitor::setTerms(const vector<Term>& newTerms) {
    terms = newTerms;
    forcePNorms.assign(terms.size(), 0.0);
}

bool StepMonitor::needsMultipliers() const {
    return std::any_of(terms.begin(), terms.end(), [](const Term& term) { return usesMultipliers(term.kind); });
}

bool StepMonitor::needConstraints(const vector<Term>& terms) {
    return std::any_of(terms.begin(), terms.end(), [](const Term& term) { return usesConstraintsOnly(term.kind); });
}

void StepMonitor::requireValid(const vector<double>& values) const {
    for (size_t k = 0; k < terms.size(); k++)
        if (!(values[k] >= 0) || !std::isfinite(values[k]))
            throw StepFailure("monitor " + std::to_string(k) + " became " + std::to_string(values[k]) +
                              (terms[k].kind == ForceGroupEnergy
                                   ? ", while the energy of the monitor's force group must stay positive"
                                   : ", while a monitor must stay positive and finite"));
}

bool StepMonitor::dependsOnVelocities() const {
    return std::any_of(terms.begin(), terms.end(),
                       [](const Term& term) { return usesMultipliers(term.kind) || isOfVelocities(term.kind); });
}

bool StepMonitor::usesVelocities() const {
    return std::any_of(terms.begin(), terms.end(), [](const Term& term) { return isOfVelocities(term.kind); });
}

void StepMonitor::setForces(const vector<Vec3>& newForces, double energy) {
    for (size_t block = 0; block < blockSums.size(); block++)
        sumForces(newForces, (int) block);
    finishForces(newForces, energy);
}

// The force on a particle that does not move is of no interest, even if it is not a number.
double StepMonitor::squareOf(const Vec3& force, int particle) const {
    return system.getInverseMasses()[particle] > 0 ? force.dot(force) : 0.0;
}

void StepMonitor::sumForces(const vector<Vec3>& newForces, int block) {
    const int first = system.getBlocks()[block].particle, end = system.getBlocks()[block + 1].particle;
    blockSums[block] = sumOf(end - first, [&](int i) { return squareOf(newForces[first + i], first + i); });
}

void StepMonitor::finishForces(const vector<Vec3>& newForces, double energy) {
    forces = &newForces;
    groupEnergy = energy;
    appliedForceSquared = forceSquared = maxForce = 0;
    const vector<double>& inverseMasses = system.getInverseMasses();
    const int numParticles = system.getNumParticles();
    auto squareOf = [&](int i) { return this->squareOf(newForces[i], i); };
    auto isWanted = [&](std::initializer_list<Kind> kinds) {
        return std::any_of(terms.begin(), terms.end(), [&](const Term& term) {
            return std::find(kinds.begin(), kinds.end(), term.kind) != kinds.end();
        });
    };
    forceSquared = sumOf((int) blockSums.size(), [&](int block) { return blockSums[block]; });
    if (isWanted({AppliedForce, ConstraintAndAppliedForce}))
        appliedForceSquared = sumOf(numParticles, [&](int i) { return squareOf(i) * inverseMasses[i]; });
    if (isWanted({MaxForce}))
        for (int i = 0; i < numParticles; i++)
            maxForce = std::max(maxForce, squareOf(i));
    maxForce = std::sqrt(maxForce);
    for (size_t k = 0; k < terms.size(); k++)
        if (terms[k].kind == ForcePNorm)
            forcePNorms[k] = pNorm(numParticles, terms[k].order, [&](int i) { return std::sqrt(squareOf(i)); });
}

void StepMonitor::evaluate(const vector<Vec3>& v, const vector<double>& multipliers, const vector<double>& rightSide,
                           vector<double>& values) {
    // Lambda^T K Lambda; rounding could make it negative where it vanishes.
    const double sum = sumOf((int) multipliers.size(), [&](int k) { return multipliers[k] * rightSide[k]; });
    constraintForceSquared = std::isnan(sum) ? sum : std::max(sum, 0.0);
    values.resize(terms.size());
    for (size_t i = 0; i < terms.size(); i++)
        values[i] = evaluateTerm(i, v, multipliers);
}

// du/dU_k
double StepMonitor::derivativeOfU(size_t index, const vector<double>& values, double u) const {
    const Term& term = terms[index];
    // U is not differentiable at zero; any value serves, since it only guides the iteration.
    if (!(values[index] > 0) || !(u > 0) || term.reference == 0)
        return 0;
    double sumOfWeights = 0;
    for (const Term& each : terms)
        sumOfWeights += each.weight * each.weight;
    double t = term.weight * std::pow(values[index] / term.reference, term.power);
    return t * t * term.power / (values[index] * u * sumOfWeights);
}

int StepMonitor::findFastest(const vector<Vec3>& v) const {
    int fastest = 0;
    double largest = -1;
    for (int i = 0; i < system.getNumParticles(); i++) {
        double square = v[i].dot(v[i]) + (*forces)[i].dot((*forces)[i]);
        if (system.getInverseMasses()[i] > 0 && square > largest) {
            largest = square;
            fastest = i;
        }
    }
    return fastest;
}

double StepMonitor::evaluateRate(const vector<Vec3>& v, const vector<double>& multipliers,
                                 const vector<double>& rightSide, const vector<double>& values,
                                 const vector<Vec3>& velocityRate, const vector<double>& multiplierRate) const {
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    const double u = combine(values);
    double rate = 0;
    for (size_t i = 0; i < terms.size(); i++) {
        const double factor = derivativeOfU(i, values, u), value = values[i];
        if (factor == 0)
            continue;
        double sum = 0;
        switch (terms[i].kind) {
        case ConstraintMultipliers:
            sum = sumOf(numConstraints, [&](int k) {
                double d = system.toGivenMultiplier(k);
                return d * d * multipliers[k] * multiplierRate[k];
            });
            rate += factor * sum / value;
            break;
        case MultiplierPNorm:
            for (int k = 0; k < numConstraints; k++) {
                double x = system.toGivenMultiplier(k) * multipliers[k];
                sum += std::copysign(std::pow(std::fabs(x) / value, terms[i].order - 1), x) *
                       system.toGivenMultiplier(k) * multiplierRate[k];
            }
            rate += factor * sum;
            break;
        case ConstraintForce:
        case ConstraintAndAppliedForce:
            sum = sumOf(numConstraints, [&](int k) { return rightSide[k] * multiplierRate[k]; });
            rate += factor * sum / value;
            break;
        case VectorField:
            for (int p = 0; p < numParticles; p++)
                if (system.getMasses()[p] > 0)
                    sum += system.getMasses()[p] * v[p].dot(velocityRate[p]);
            rate += factor * sum / value;
            break;
        case ArcLength:
            for (int p = 0; p < numParticles; p++)
                if (system.getMasses()[p] > 0)
                    sum += v[p].dot(velocityRate[p]);
            rate += factor * sum / value;
            break;
        case MaxParticleArcLength: {
            const int fastest = findFastest(v);
            rate += factor * v[fastest].dot(velocityRate[fastest]) / value;
            break;
        }
        case AppliedForce:
        case ForcePNorm:
        case MaxForce:
        case ForceGroupEnergy:
            break;
        }
    }
    return rate;
}

double StepMonitor::evaluateTerm(size_t index, const vector<Vec3>& v, const vector<double>& multipliers) const {
    const Term& term = terms[index];
    const vector<double>& masses = system.getMasses();
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    auto givenMultiplier = [&](int k) { return multipliers[k] * system.toGivenMultiplier(k); };
    switch (term.kind) {
    case ConstraintMultipliers: // (4.4)
        return std::sqrt(sumOf(numConstraints, [&](int k) { return givenMultiplier(k) * givenMultiplier(k); }));
    case ConstraintForce:
        return std::sqrt(constraintForceSquared);
    case AppliedForce:
        return std::sqrt(appliedForceSquared);
    case ConstraintAndAppliedForce:
        return std::sqrt(constraintForceSquared + appliedForceSquared);
    case MultiplierPNorm:
        return pNorm(numConstraints, term.order, [&](int k) { return std::fabs(givenMultiplier(k)); });
    case ForcePNorm:
        return forcePNorms[index];
    case VectorField: // (4.1)
        return std::sqrt(forceSquared +
                         sumOf(numParticles, [&](int i) { return masses[i] > 0 ? masses[i] * v[i].dot(v[i]) : 0.0; }));
    case MaxForce:
        return maxForce;
    case ArcLength:
        return std::sqrt(forceSquared +
                         sumOf(numParticles, [&](int i) { return masses[i] > 0 ? v[i].dot(v[i]) : 0.0; }));
    case MaxParticleArcLength: {
        double largest = 0;
        for (int i = 0; i < numParticles; i++)
            if (masses[i] > 0)
                largest = std::max(largest, v[i].dot(v[i]) + (*forces)[i].dot((*forces)[i]));
        return std::sqrt(largest);
    }
    case ForceGroupEnergy:
        return groupEnergy;
    }
    return 0;
}

bool StepMonitor::isNegligible(int index, double value, const vector<Vec3>& v, double speed,
                               double acceleration) const {
    if (!(value > 0))
        return true;
    switch (terms[index].kind) {
    case ConstraintMultipliers:
    case MultiplierPNorm:
        return value <= solver.findMultiplierRounding(false, v, acceleration);
    case ConstraintForce:
        return value <= solver.findMultiplierRounding(true, v, acceleration);
    case ConstraintAndAppliedForce:
        return areForcesNegligible(acceleration) &&
               value * value - appliedForceSquared <= std::pow(solver.findMultiplierRounding(true, v, acceleration), 2);
    case AppliedForce:
    case ForcePNorm:
    case MaxForce:
        return areForcesNegligible(acceleration);
    case VectorField:
    case ArcLength:
    case MaxParticleArcLength:
        return areForcesNegligible(acceleration) &&
               std::all_of(v.begin(), v.end(), [&](const Vec3& each) { return each.dot(each) <= speed * speed; });
    case ForceGroupEnergy:
        break;
    }
    return false;
}

bool StepMonitor::areForcesNegligible(double acceleration) const {
    for (int i = 0; i < system.getNumParticles(); i++)
        if (squareOf((*forces)[i], i) > std::pow(system.getMasses()[i] * acceleration, 2))
            return false;
    return true;
}

double StepMonitor::combine(const vector<double>& values) const {
    if (terms.empty())
        return 1;
    double sum = 0, sumOfWeights = 0;
    for (size_t i = 0; i < terms.size(); i++) {
        const double ratio = terms[i].reference > 0 ? values[i] / terms[i].reference : 1.0;
        const double t = terms[i].weight * std::pow(ratio, terms[i].power);
        sum += t * t;
        sumOfWeights += terms[i].weight * terms[i].weight;
    }
    return std::sqrt(sum / sumOfWeights);
}

void StepMonitor::evaluateGradient(const ExpressionParameters& theta, const vector<Vec3>& v,
                                   const vector<double>& multipliers, const vector<double>& values,
                                   vector<Vec3>& gradient) {
    const vector<double>& masses = system.getMasses();
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    std::fill(gradient.begin(), gradient.end(), Vec3());
    // du/dLambda is collected in two parts: y, which needs a product with K^-1, and x, which is K^-1 du/dLambda already.
    std::fill(toSolve.begin(), toSolve.end(), 0.0);
    std::fill(solved.begin(), solved.end(), 0.0);
    bool mustSolve = false;
    const double u = combine(values);
    for (size_t i = 0; i < terms.size(); i++) {
        const Term& term = terms[i];
        const double value = values[i], factor = derivativeOfU(i, values, u);
        if (factor == 0)
            continue;
        switch (term.kind) {
        case ConstraintMultipliers:
            mustSolve = true;
            for (int k = 0; k < numConstraints; k++) {
                double d = system.toGivenMultiplier(k);
                toSolve[k] += factor / value * d * d * multipliers[k];
            }
            break;
        case MultiplierPNorm:
            mustSolve = true;
            for (int k = 0; k < numConstraints; k++) {
                double d = system.toGivenMultiplier(k), size = std::fabs(d * multipliers[k]);
                double derivative = d * std::pow(size / value, term.order - 1);
                toSolve[k] += factor * (multipliers[k] < 0 ? -derivative : derivative);
            }
            break;
        case ConstraintForce:
        case ConstraintAndAppliedForce:
            // dU/dLambda = K Lambda/U
            for (int k = 0; k < numConstraints; k++)
                solved[k] += factor / value * multipliers[k];
            break;
        case VectorField:
            for (int p = 0; p < numParticles; p++)
                if (masses[p] > 0)
                    gradient[p] += v[p] * (factor / value * masses[p]);
            break;
        case ArcLength:
            for (int p = 0; p < numParticles; p++)
                if (masses[p] > 0)
                    gradient[p] += v[p] * (factor / value);
            break;
        case MaxParticleArcLength: {
            const int fastest = findFastest(v);
            gradient[fastest] += v[fastest] * (factor / value);
            break;
        }
        case AppliedForce:
        case ForcePNorm:
        case MaxForce:
        case ForceGroupEnergy:
            break;
        }
    }
    if (!needsMultipliers())
        return;
    if (mustSolve) {
        solver.solveMatrix(toSolve);
        for (int k = 0; k < numConstraints; k++)
            solved[k] += toSolve[k];
    }
    // dLambda/dv = 2 K^-1 G(v), so du/dv = 2 G(v)^T K^-1 du/dLambda
    for (double& x : solved)
        x *= 2;
    solver.addVelocityJacobianTransposed(v, theta, solved, gradient);
}
