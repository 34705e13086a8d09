// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/StepMonitor.h"
#include <algorithm>
#include <cmath>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

enum Norm { Square, Power, Largest, Energy };
/** How the square of a particle's force or velocity counts. */
enum Weight { No, One, Mass, OverMass };

/** What a monitor is the norm of, with d_k Lambda_k the multipliers in users' units. */
struct Parts {
    Norm norm;
    bool constraintForce, multipliers; // Lambda^T K Lambda; (d_k Lambda_k)^2
    Weight force, velocity;            // |F_i|^2; |v_i|^2
    bool ofConstraints() const {
        return constraintForce || multipliers;
    }
};

// In the order of StepMonitor::Kind.
const Parts PARTS[] = {
    {Square, false, true, No, No},        // ConstraintMultipliers (4.4)
    {Square, true, false, No, No},        // ConstraintForce
    {Square, false, false, OverMass, No}, // AppliedForce
    {Square, true, false, OverMass, No},  // ConstraintAndAppliedForce
    {Power, false, true, No, No},         // MultiplierPNorm
    {Power, false, false, One, No},       // ForcePNorm
    {Square, false, false, One, Mass},    // VectorField (4.1)
    {Largest, false, false, One, No},     // MaxForce
    {Square, false, false, One, One},     // ArcLength
    {Largest, false, false, One, One},    // MaxParticleArcLength
    {Energy, false, false, No, No},       // ForceGroupEnergy
};

bool anyOf(const vector<StepMonitor::Term>& terms, bool (*isWanted)(const Parts&)) {
    return std::any_of(terms.begin(), terms.end(),
                       [&](const StepMonitor::Term& term) { return isWanted(PARTS[term.kind]); });
}

double total(const vector<double>& parts) {
    return sumOf((int) parts.size(), [&](int k) { return parts[k]; });
}

} // namespace

StepMonitor::StepMonitor(ConstraintSolver& solver) :
        solver(solver), system(solver.getSystem()), forces(nullptr), groupEnergy(0), forceSquared(0),
        appliedForceSquared(0), seenForces(nullptr), seenMultipliers(nullptr), seenRightSide(nullptr),
        seenHalf(nullptr), blockSums(system.getBlocks().size() - 1), blockAppliedSums(blockSums),
        sums{vector<double>(solver.getNumRanges()), vector<double>(solver.getNumRanges())}, halfSums(sums),
        toSolve(system.getNumConstraints()), solved(toSolve) {
    trial = {toSolve, toSolve};
}

void StepMonitor::setTerms(const vector<Term>& newTerms, const StepDensity& newBounds) {
    terms = newTerms;
    bounds = newBounds;
    forceNorms.assign(terms.size(), 0.0);
    forgetForces();
}

vector<double> StepMonitor::getReferences() const {
    vector<double> references;
    for (const Term& term : terms)
        references.push_back(term.reference);
    return references;
}

void StepMonitor::setReferences(const vector<double>& references) {
    for (size_t k = 0; k < references.size(); k++)
        setReference((int) k, references[k]);
}

bool StepMonitor::needConstraints(const vector<Term>& terms) {
    return anyOf(terms, [](const Parts& parts) { return parts.ofConstraints() && parts.force == No; });
}

bool StepMonitor::dependsOnVelocities() const {
    return anyOf(terms, [](const Parts& parts) { return parts.ofConstraints() || parts.velocity != No; });
}

bool StepMonitor::usesVelocities() const {
    return anyOf(terms, [](const Parts& parts) { return parts.velocity != No; });
}

// ------------------------------------------------------------------------------------------------------------ the sums

// The force on a particle that does not move is of no interest, even if it is not a number.
double StepMonitor::squareOf(const Vec3& force, int particle) const {
    return system.getInverseMasses()[particle] > 0 ? force.dot(force) : 0.0;
}

void StepMonitor::sumForces(const vector<Vec3>& newForces, int block) {
    const int first = system.getBlocks()[block].particle, end = system.getBlocks()[block + 1].particle;
    const double* inverseMasses = system.getInverseMasses().data() + first;
    auto square = [&](int i) { return squareOf(newForces[first + i], first + i); };
    blockSums[block] = sumOf(end - first, square);
    if (anyOf(terms, [](const Parts& parts) { return parts.force == OverMass; }))
        blockAppliedSums[block] = sumOf(end - first, [&](int i) { return square(i) * inverseMasses[i]; });
}

void StepMonitor::takeForces(const StepState& state, bool areSummed) {
    const vector<Vec3>& newForces = state.force;
    for (size_t block = 0; block < blockSums.size() && !areSummed; block++)
        sumForces(newForces, (int) block);
    forces = &newForces;
    groupEnergy = state.groupEnergy;
    forceSquared = total(blockSums);
    appliedForceSquared = total(blockAppliedSums);
    const int numParticles = system.getNumParticles();
    auto square = [&](int i) { return squareOf(newForces[i], i); };
    for (size_t k = 0; k < terms.size(); k++) {
        const Parts parts = PARTS[terms[k].kind];
        if (parts.norm == Power && parts.force == One)
            forceNorms[k] = pNorm(numParticles, terms[k].order, [&](int i) { return std::sqrt(square(i)); });
        else if (parts.norm == Largest && parts.velocity == No)
            forceNorms[k] = std::sqrt(solver.largest(numParticles, square));
    }
}

// (sum |x|^p)^(1/p), scaled by the largest |x| so that no power overflows.
template <class Size> double StepMonitor::pNorm(int count, double order, const Size& size) const {
    const double largest = solver.largest(count, size);
    if (largest == 0)
        return 0;
    return largest * std::pow(solver.sum(count, [&](int i) { return std::pow(size(i) / largest, order); }), 1 / order);
}

void StepMonitor::sumRange(const vector<double>& multipliers, const vector<double>& rightSide, int range, int first,
                           int end, Sums& to) const {
    const double *lambda = multipliers.data() + first, *right = rightSide.data() + first;
    to.forces[range] = sumOf(end - first, [&](int k) { return lambda[k] * right[k]; });
    if (anyOf(terms, [](const Parts& parts) { return parts.multipliers && parts.norm == Square; }))
        to.multipliers[range] = sumOf(end - first, [&](int k) {
            const double given = system.toGivenMultiplier(first + k) * lambda[k];
            return given * given;
        });
}

void StepMonitor::sum(const vector<double>& multipliers, const vector<double>& rightSide) {
    solver.forRanges([&](int range, int first, int end) { sumRange(multipliers, rightSide, range, first, end, sums); });
}

void StepMonitor::see(const vector<double>& multipliers, const vector<double>& rightSide) {
    seenForces = nullptr;
    seenMultipliers = &multipliers;
    seenRightSide = &rightSide;
    seenHalf = nullptr;
}

ConstraintSolver::Coupled StepMonitor::observeTrial(const ExpressionParameters& theta) {
    see(trial.multipliers, trial.rightSide);
    return {theta, trial.multipliers, trial.rightSide};
}

void StepMonitor::observe(const ConstraintSolver::OnStep& end) {
    see(end.multipliers, end.rightSide);
    forces = nullptr;
    seenForces = &end.forces;
    seenHalf = end.atHalfStep;
}

void StepMonitor::seeParticles(int block) {
    if (seenForces != nullptr)
        sumForces(*seenForces, block);
}

void StepMonitor::seeConstraints(int range, int first, int end) {
    sumRange(*seenMultipliers, *seenRightSide, range, first, end, sums);
    if (seenHalf != nullptr)
        sumRange(seenHalf->multipliers, seenHalf->rightSide, range, first, end, halfSums);
}

// ---------------------------------------------------------------------------------------------------------- the values

double StepMonitor::sumOfForces(Kind kind) const {
    const Weight weight = PARTS[kind].force;
    return weight == One ? forceSquared : weight == OverMass ? appliedForceSquared : 0.0;
}

void StepMonitor::evaluate(const StepState& state, vector<double>& values) {
    const bool isSeen = seenForces == &state.force;
    if (!isSeen)
        sum(state.lambda, state.rightSide);
    if (forces != &state.force)
        takeForces(state, isSeen);
    seenForces = nullptr;
    evaluate(state.v, state.lambda, sums, values);
}

void StepMonitor::evaluateHalfStep(const StepState& state, const ConstraintSolver::HalfStep& half,
                                   vector<double>& values) {
    evaluate(state.w, half.multipliers, halfSums, values);
}

void StepMonitor::evaluateTrial(const StepState& state, const vector<Vec3>& v, vector<double>& values) {
    if (forces != &state.force)
        takeForces(state, false);
    evaluate(v, trial.multipliers, sums, values);
}

void StepMonitor::evaluateAt(const StepState& state, const vector<Vec3>& v, const ExpressionParameters& theta,
                             vector<double>& values) {
    solver.findMultipliers(v, theta, trial.multipliers, trial.rightSide); // (4.3)
    sum(trial.multipliers, trial.rightSide);
    evaluateTrial(state, v, values);
}

void StepMonitor::evaluate(const vector<Vec3>& v, const vector<double>& multipliers, const Sums& from,
                           vector<double>& values) {
    // Lambda^T K Lambda; rounding could make it negative where it vanishes.
    const double sum = total(from.forces);
    const double constraintForceSquared = std::isnan(sum) ? sum : std::max(sum, 0.0);
    const double multipliersSquared = total(from.multipliers);
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    const vector<double>& masses = system.getMasses();
    values.resize(terms.size());
    for (size_t k = 0; k < terms.size(); k++) {
        const Parts parts = PARTS[terms[k].kind];
        auto square = [&](int i) {
            return masses[i] > 0 ? (parts.velocity == Mass ? masses[i] : 1.0) * v[i].dot(v[i]) : 0.0;
        };
        if (parts.norm == Square)
            values[k] = std::sqrt((parts.constraintForce ? constraintForceSquared : 0.0) +
                                  (parts.multipliers ? multipliersSquared : 0.0) + sumOfForces(terms[k].kind) +
                                  (parts.velocity != No ? solver.sum(numParticles, square) : 0.0));
        else if (parts.norm == Power && parts.multipliers)
            values[k] = pNorm(numConstraints, terms[k].order,
                              [&](int j) { return std::fabs(system.toGivenMultiplier(j) * multipliers[j]); });
        else if (parts.norm == Largest && parts.velocity != No)
            values[k] =
                std::sqrt(solver.largest(numParticles, [&](int i) { return square(i) + squareOf((*forces)[i], i); }));
        else
            values[k] = parts.norm == Energy ? groupEnergy : forceNorms[k];
    }
}

void StepMonitor::requireValid(const vector<double>& values) const {
    if (!std::isfinite(forceSquared))
        throw StepFailure(solver.explainForces(*forces));
    for (size_t k = 0; k < terms.size(); k++) {
        if (values[k] >= 0 && std::isfinite(values[k]))
            continue;
        std::stringstream reason;
        reason << "monitor " << k << " became ";
        if (std::isfinite(values[k]))
            reason << values[k];
        else
            reason << "infinite or not a number";
        reason << (terms[k].kind == ForceGroupEnergy
                       ? ", while the energy of the monitor's force group must stay positive"
                       : ", while a monitor must stay positive and finite");
        throw StepFailure(reason.str());
    }
}

bool StepMonitor::isNegligible(int index, double value, const StepState& state, double speed, double acceleration) {
    if (!(value > 0))
        return true;
    const vector<Vec3>& v = state.v;
    const Parts parts = PARTS[terms[index].kind];
    if (parts.norm == Energy)
        return false;
    if (forces != &state.force)
        takeForces(state, false);
    if (parts.ofConstraints() && value * value - sumOfForces(terms[index].kind) >
                                     std::pow(solver.findMultiplierRounding(parts.constraintForce, v, acceleration), 2))
        return false;
    for (int i = 0; i < system.getNumParticles(); i++)
        if ((parts.force != No && squareOf(state.force[i], i) > std::pow(system.getMasses()[i] * acceleration, 2)) ||
            (parts.velocity != No && system.getMasses()[i] > 0 && !(v[i].dot(v[i]) <= speed * speed)))
            return false;
    return true;
}

double StepMonitor::combine(const vector<double>& values) const {
    return bounds.limit(combineUnbounded(values));
}

double StepMonitor::combineUnbounded(const vector<double>& values) const {
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

// -------------------------------------------------------------------------------------------------------- the gradient

// du/dU_k
double StepMonitor::derivativeOfU(size_t index, const vector<double>& values, double u) const {
    const Term& term = terms[index];
    // U is not differentiable at zero; any value serves, since it only guides the iteration.
    if (!(values[index] > 0) || !(u > 0) || term.reference == 0)
        return 0;
    double sumOfWeights = 0;
    for (const Term& each : terms)
        sumOfWeights += each.weight * each.weight;
    const double t = term.weight * std::pow(values[index] / term.reference, term.power);
    return t * t * term.power / (values[index] * u * sumOfWeights);
}

void StepMonitor::evaluateGradient(const ExpressionParameters& theta, const vector<Vec3>& v,
                                   const vector<double>& values, vector<Vec3>& gradient) {
    const vector<double>& multipliers = trial.multipliers;
    const vector<double>& masses = system.getMasses();
    const int numParticles = system.getNumParticles(), numConstraints = system.getNumConstraints();
    std::fill(gradient.begin(), gradient.end(), Vec3());
    // du/dLambda is collected in two parts: y, which needs a product with K^-1, and x, which is K^-1 du/dLambda already.
    std::fill(toSolve.begin(), toSolve.end(), 0.0);
    std::fill(solved.begin(), solved.end(), 0.0);
    const double u = combineUnbounded(values);
    for (size_t k = 0; k < terms.size(); k++) {
        const Parts parts = PARTS[terms[k].kind];
        const double value = values[k], factor = derivativeOfU(k, values, u);
        if (factor == 0)
            continue;
        if (parts.multipliers)
            for (int j = 0; j < numConstraints; j++) {
                const double d = system.toGivenMultiplier(j), x = d * multipliers[j] / value;
                const double order = parts.norm == Power ? terms[k].order : 2.0;
                toSolve[j] += factor * d * std::copysign(std::pow(std::fabs(x), order - 1), x);
            }
        if (parts.constraintForce) // dU/dLambda = K Lambda/U
            for (int j = 0; j < numConstraints; j++)
                solved[j] += factor / value * multipliers[j];
        if (parts.velocity == No)
            continue;
        int first = 0, end = numParticles;
        if (parts.norm == Largest) {
            auto size = [&](int i) { return masses[i] > 0 ? v[i].dot(v[i]) + (*forces)[i].dot((*forces)[i]) : -1.0; };
            for (int i = 1; i < numParticles; i++)
                if (size(i) > size(first))
                    first = i;
            end = first + 1;
        }
        for (int i = first; i < end; i++)
            if (masses[i] > 0)
                gradient[i] += v[i] * (factor / value * (parts.velocity == Mass ? masses[i] : 1.0));
    }
    if (anyOf(terms, [](const Parts& parts) { return parts.ofConstraints(); })) {
        // dLambda/dv = 2 K^-1 G(v), so du/dv = 2 G(v)^T K^-1 du/dLambda
        solver.solveMatrix(toSolve);
        for (int j = 0; j < numConstraints; j++)
            solved[j] = 2 * (solved[j] + toSolve[j]);
        solver.addVelocityJacobianTransposed(v, theta, solved, gradient);
    }
    const double slope = bounds.limitDerivative(u);
    for (Vec3& each : gradient)
        each *= slope;
}
