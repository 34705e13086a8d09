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
        forceSquared(0), maxForce(0), constraintForceSquared(0), multipliersSquared(0),
        blockSums(system.getBlocks().size() - 1), blockAppliedSums(blockSums.size()), blockLargest(blockSums.size()),
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

bool StepMonitor::isWanted(std::initializer_list<Kind> kinds) const {
    return std::any_of(terms.begin(), terms.end(), [&](const Term& term) {
        return std::find(kinds.begin(), kinds.end(), term.kind) != kinds.end();
    });
}

void StepMonitor::sumForces(const vector<Vec3>& newForces, int block) {
    const int first = system.getBlocks()[block].particle, end = system.getBlocks()[block + 1].particle;
    const vector<double>& inverseMasses = system.getInverseMasses();
    auto square = [&](int i) { return squareOf(newForces[first + i], first + i); };
    blockSums[block] = sumOf(end - first, square);
    if (isWanted({AppliedForce, ConstraintAndAppliedForce}))
        blockAppliedSums[block] = sumOf(end - first, [&](int i) { return square(i) * inverseMasses[first + i]; });
    if (isWanted({MaxForce})) {
        blockLargest[block] = 0;
        for (int i = 0; i < end - first; i++)
            blockLargest[block] = std::max(blockLargest[block], square(i));
    }
}

void StepMonitor::finishForces(const vector<Vec3>& newForces, double energy) {
    forces = &newForces;
    groupEnergy = energy;
    const int numBlocks = (int) blockSums.size();
    forceSquared = sumOf(numBlocks, [&](int block) { return blockSums[block]; });
    appliedForceSquared = sumOf(numBlocks, [&](int block) { return blockAppliedSums[block]; });
    maxForce = 0;
    for (double square : blockLargest)
        maxForce = std::max(maxForce, square);
    maxForce = std::sqrt(maxForce);
    for (size_t k = 0; k < terms.size(); k++)
        if (terms[k].kind == ForcePNorm)
            forcePNorms[k] = pNorm(system.getNumParticles(), terms[k].order,
                                   [&](int i) { return std::sqrt(squareOf(newForces[i], i)); });
}

// (sum |x|^p)^(1/p), scaled by the largest |x| so that no power overflows.
template <class Size> double StepMonitor::pNorm(int count, double order, const Size& size) const {
    const double largest = solver.largest(count, size);
    if (largest == 0)
        return 0;
    return largest * std::pow(solver.sum(count, [&](int i) { return std::pow(size(i) / largest, order); }), 1 / order);
}

StepMonitor::Sums StepMonitor::makeSums() const {
    const vector<double> zeros(solver.getNumRanges(), 0.0);
    return {zeros, zeros, zeros, zeros};
}

void StepMonitor::sumRange(const Multipliers& at, int range, int first, int end, Sums& sums) const {
    const double *lambda = at.multipliers.data() + first, *right = at.rightSide.data() + first;
    sums.forces[range] = sumOf(end - first, [&](int k) { return lambda[k] * right[k]; });
    const double* rate = at.rate != nullptr ? at.rate->data() + first : nullptr;
    if (rate != nullptr)
        sums.forceRates[range] = sumOf(end - first, [&](int k) { return right[k] * rate[k]; });
    if (!isWanted({ConstraintMultipliers}))
        return;
    auto given = [&](int k, double x) { return system.toGivenMultiplier(first + k) * x; };
    sums.multipliers[range] = sumOf(end - first, [&](int k) { return given(k, lambda[k]) * given(k, lambda[k]); });
    if (rate != nullptr)
        sums.multiplierRates[range] =
            sumOf(end - first, [&](int k) { return given(k, lambda[k]) * given(k, rate[k]); });
}

StepMonitor::Sums StepMonitor::sum(const Multipliers& at) const {
    Sums sums = makeSums();
    solver.forRanges([&](int range, int first, int end) { sumRange(at, range, first, end, sums); });
    return sums;
}

void StepMonitor::evaluate(const vector<Vec3>& v, const vector<double>& multipliers, const Sums& sums,
                           vector<double>& values) {
    auto add = [](const vector<double>& parts) {
        return sumOf((int) parts.size(), [&](int range) { return parts[range]; });
    };
    // Lambda^T K Lambda; rounding could make it negative where it vanishes.
    const double sum = add(sums.forces);
    constraintForceSquared = std::isnan(sum) ? sum : std::max(sum, 0.0);
    multipliersSquared = add(sums.multipliers);
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

double StepMonitor::evaluateRate(const vector<Vec3>& v, const Multipliers& at, const Sums& sums,
                                 const vector<double>& values, const vector<Vec3>& velocityRate) const {
    const int numParticles = system.getNumParticles();
    auto add = [](const vector<double>& parts) {
        return sumOf((int) parts.size(), [&](int range) { return parts[range]; });
    };
    const double u = combine(values);
    double rate = 0;
    for (size_t i = 0; i < terms.size(); i++) {
        const double factor = derivativeOfU(i, values, u), value = values[i];
        if (factor == 0)
            continue;
        switch (terms[i].kind) {
        case ConstraintMultipliers:
            rate += factor * add(sums.multiplierRates) / value;
            break;
        case MultiplierPNorm:
            rate += factor * solver.sum(system.getNumConstraints(), [&](int k) {
                const double x = system.toGivenMultiplier(k) * at.multipliers[k];
                return std::copysign(std::pow(std::fabs(x) / value, terms[i].order - 1), x) *
                       system.toGivenMultiplier(k) * (*at.rate)[k];
            });
            break;
        case ConstraintForce:
        case ConstraintAndAppliedForce:
            rate += factor * add(sums.forceRates) / value;
            break;
        case VectorField:
            rate += factor / value * solver.sum(numParticles, [&](int p) {
                return system.getMasses()[p] > 0 ? system.getMasses()[p] * v[p].dot(velocityRate[p]) : 0.0;
            });
            break;
        case ArcLength:
            rate += factor / value * solver.sum(numParticles, [&](int p) {
                return system.getMasses()[p] > 0 ? v[p].dot(velocityRate[p]) : 0.0;
            });
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
        return std::sqrt(multipliersSquared);
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
        return std::sqrt(forceSquared + solver.sum(numParticles, [&](int i) {
            return masses[i] > 0 ? masses[i] * v[i].dot(v[i]) : 0.0;
        }));
    case MaxForce:
        return maxForce;
    case ArcLength:
        return std::sqrt(forceSquared +
                         solver.sum(numParticles, [&](int i) { return masses[i] > 0 ? v[i].dot(v[i]) : 0.0; }));
    case MaxParticleArcLength:
        return std::sqrt(solver.largest(numParticles, [&](int i) {
            return masses[i] > 0 ? v[i].dot(v[i]) + (*forces)[i].dot((*forces)[i]) : 0.0;
        }));
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
