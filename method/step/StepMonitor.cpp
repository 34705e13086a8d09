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

} // namespace

bool StepMonitor::needConstraints(const vector<Term>& terms) {
    return anyOf(terms, [](const Parts& parts) { return parts.ofConstraints() && parts.force == No; });
}

bool StepMonitor::dependOnVelocities(const vector<Term>& terms) {
    return anyOf(terms, [](const Parts& parts) { return parts.ofConstraints() || parts.velocity != No; });
}

bool StepMonitor::useVelocities(const vector<Term>& terms) {
    return anyOf(terms, [](const Parts& parts) { return parts.velocity != No; });
}

StepMonitor::StepMonitor(ConstraintSolver& solver) :
        solver(solver), system(solver.getSystem()), forceSquares(solver), seen(solver), seenHalf(solver),
        atHalfStep{Values(system.getNumConstraints()), Values(system.getNumConstraints())} {
}

void StepMonitor::setTerms(const vector<Term>& newTerms, const StepDensity& newBounds) {
    terms = newTerms;
    bounds = newBounds;
    references.clear();
    for (const Term& term : terms)
        references.push_back(term.reference);
    forceSquares.setOverMassWanted(anyOf(terms, [](const Parts& parts) { return parts.force == OverMass; }));
    const bool areSquaresWanted =
        anyOf(terms, [](const Parts& parts) { return parts.multipliers && parts.norm == Square; });
    seen.setSquaresWanted(areSquaresWanted);
    seenHalf.setSquaresWanted(areSquaresWanted);
}

// The square of what is a sum of squares, and else the norm itself, unless that takes velocities too.
void StepMonitor::takeForces(StepState& state) {
    forceSquares.find(state.force);
    const int numParticles = system.getNumParticles();
    auto square = [&](int i) { return forceSquares.squareOf(state.force[i], i); };
    state.forceParts.assign(terms.size(), 0.0);
    for (size_t k = 0; k < terms.size(); k++) {
        const Parts parts = PARTS[terms[k].kind];
        double& part = state.forceParts[k];
        if (parts.norm == Energy)
            part = state.groupEnergy;
        else if (parts.norm == Square && parts.force != No)
            part = parts.force == One ? forceSquares.getSum() : forceSquares.getSumOverMass();
        else if (parts.norm == Power && parts.force == One)
            part = solver.pNorm(numParticles, terms[k].order, [&](int i) { return std::sqrt(square(i)); });
        else if (parts.norm == Largest && parts.velocity == No)
            part = std::sqrt(solver.largest(numParticles, square));
    }
}

void StepMonitor::finish(StepState& end, double kick, bool withHalfStep) {
    forceSquares.observe(end.force);
    seen.observe(end.lambda, end.rightSide);
    if (withHalfStep)
        seenHalf.observe(atHalfStep.multipliers, atHalfStep.rightSide);
    else
        seenHalf.ignore();
    solver.finish(end.end(kick, withHalfStep ? &atHalfStep : nullptr), this);
    takeForces(end);
    evaluate(end, end.v, seen, end.values);
    if (withHalfStep)
        evaluate(end, end.w, seenHalf, end.halfStepValues);
    requireValid(end.values);
}

void StepMonitor::look(StepState& state, bool areForcesOthers) {
    seen.look(state.lambda, state.rightSide);
    if (areForcesOthers)
        takeForces(state);
    evaluate(state, state.v, seen, state.values);
}

const vector<double>& StepMonitor::evaluateAt(const StepState& state, const Vectors& v,
                                              const ExpressionParameters& theta) {
    solver.findMultipliers(v, theta, atHalfStep.multipliers, atHalfStep.rightSide); // (4.3)
    seen.look(atHalfStep.multipliers, atHalfStep.rightSide);
    evaluate(state, v, seen, trialValues);
    return trialValues;
}

double StepMonitor::coupledPass(const StepState& state, const ConstraintSolver::Trial& trial,
                                const ExpressionParameters& theta, const ConstraintSolver::Guess* start,
                                double& constraintError) {
    seen.observe(atHalfStep.multipliers, atHalfStep.rightSide);
    seenHalf.ignore();
    constraintError = solver.coupledPass(trial, {theta, atHalfStep.multipliers, atHalfStep.rightSide}, start, this);
    evaluate(state, trial.velocities, seen, trialValues);
    return combine(trialValues);
}

void StepMonitor::evaluate(const StepState& state, const Vectors& v, const MultiplierSquares& squares, Values& found) {
    const double constraintForceSquared = squares.getWeightedSum(), multipliersSquared = squares.getSum();
    const int numParticles = system.getNumParticles();
    const vector<double>& masses = system.getMasses();
    found.resize(terms.size());
    for (size_t k = 0; k < terms.size(); k++) {
        const Parts parts = PARTS[terms[k].kind];
        const double forcePart = state.forceParts[k];
        auto square = [&](int i) {
            return masses[i] > 0 ? (parts.velocity == Mass ? masses[i] : 1.0) * v[i].dot(v[i]) : 0.0;
        };
        if (parts.norm == Square)
            found[k] = std::sqrt((parts.constraintForce ? constraintForceSquared : 0.0) +
                                 (parts.multipliers ? multipliersSquared : 0.0) + forcePart +
                                 (parts.velocity != No ? solver.sum(numParticles, square) : 0.0));
        else if (parts.norm == Power && parts.multipliers)
            found[k] =
                solver.pNorm(system.getNumConstraints(), terms[k].order, [&](int j) { return squares.sizeOf(j); });
        else if (parts.norm == Largest && parts.velocity != No)
            found[k] = std::sqrt(solver.largest(
                numParticles, [&](int i) { return square(i) + forceSquares.squareOf(state.force[i], i); }));
        else
            found[k] = forcePart;
    }
}

void StepMonitor::requireValid(const Values& checked) const {
    for (size_t k = 0; k < terms.size(); k++) {
        if (checked[k] >= 0 && std::isfinite(checked[k]))
            continue;
        std::stringstream reason;
        reason << "monitor " << k << " became ";
        if (std::isfinite(checked[k]))
            reason << checked[k];
        else
            reason << "infinite or not a number";
        reason << (terms[k].kind == ForceGroupEnergy
                       ? ", while the energy of the monitor's force group must stay positive"
                       : ", while a monitor must stay positive and finite");
        throw StepFailure(reason.str());
    }
}

bool StepMonitor::isNegligible(size_t index, const StepState& state, double speed, double acceleration) {
    const double value = state.values[index];
    const vector<double>& masses = system.getMasses();
    const Parts parts = PARTS[terms[index].kind];
    if (!(value > 0) || parts.norm == Energy)
        return !(value > 0);
    if (parts.ofConstraints() &&
        value * value - state.forceParts[index] >
            std::pow(solver.findMultiplierRounding(parts.constraintForce, state.v, acceleration), 2))
        return false;
    for (int i = 0; i < system.getNumParticles(); i++)
        if ((parts.force != No && forceSquares.squareOf(state.force[i], i) > std::pow(masses[i] * acceleration, 2)) ||
            (parts.velocity != No && masses[i] > 0 && !(state.v[i].dot(state.v[i]) <= speed * speed)))
            return false;
    return true;
}

double StepMonitor::combineUnbounded(const Values& of) const {
    if (terms.empty())
        return 1;
    double sum = 0, sumOfWeights = 0;
    for (size_t i = 0; i < terms.size(); i++) {
        const double ratio = references[i] > 0 ? of[i] / references[i] : 1.0;
        const double t = terms[i].weight * std::pow(ratio, terms[i].power);
        sum += t * t;
        sumOfWeights += terms[i].weight * terms[i].weight;
    }
    return std::sqrt(sum / sumOfWeights);
}
