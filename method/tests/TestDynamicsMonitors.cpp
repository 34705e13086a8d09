// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// StepMonitor: what each monitor takes, and their combination. StepDensity: the recursions and the bounds.

#include "TestSupport.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <cmath>
#include <random>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

// A zigzag chain of five particles with a branch, forces and velocities at random.
struct Example {
    Example() : masses({12, 1, 16, 14, 1, 32}), positions(6), velocities(6), forces(6) {
        std::mt19937 random(3);
        std::normal_distribution<double> normal;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 3; j++) {
                positions[i][j] = 0.1 * i * (j == 0) + 0.05 * normal(random);
                velocities[i][j] = normal(random);
                forces[i][j] = 3 * normal(random); // comparable to the momenta, or differences drown in rounding
            }
        for (auto pair : {std::make_pair(0, 1), {1, 2}, {2, 3}, {3, 4}, {2, 5}}) {
            Vec3 r = positions[pair.first] - positions[pair.second];
            constraints.push_back({pair.first, pair.second, std::sqrt(r.dot(r))});
        }
    }
    vector<double> masses;
    vector<DistanceConstraint> constraints;
    vector<ExpressionConstraint> expressions;
    vector<Vec3> positions, velocities, forces;
};

// u(q,v) as a function of the velocities alone, as the dynamics evaluates it.
class Evaluation {
public:
    Evaluation(const Example& e, vector<StepMonitor::Term> terms, double order, const StepDensity& bounds = {}) :
            solver(e.masses, e.constraints, e.expressions), state(solver.getSystem()), monitor(solver) {
        state.q = e.positions;
        state.v = e.velocities;
        state.force = e.forces;
        state.groupEnergy = 4.2;
        solver.moveTo(state.q, state.theta, state.force);
        for (StepMonitor::Term& term : terms)
            term.order = order;
        monitor.setTerms(terms, bounds);
        look();
    }
    void look() {
        solver.findMultipliers(state.v, state.theta, state.lambda, state.rightSide);
        monitor.look(state, true);
    }
    double u(const vector<Vec3>& v) {
        values = monitor.evaluateAt(state, v, state.theta);
        return monitor.combine(values);
    }
    ConstraintSolver solver;
    StepState state;
    StepMonitor monitor;
    vector<double> values;
};

// What is said of a monitor, such as which density equation it needs, is what its values do.
void testWhatMonitorsDependOn() {
    const vector<ExpressionConstraint> expressions = {
        {"sin(3*d*x1)*y2+z1*z2^2-d^2+e*y1", {5, 0}, {{"d", 0.8}, {"e", 0.3}}},
        {"exp(c*x1)*sqrt(1+y1^2)-z1", {4}, {{"c", 1.1}}}};
    for (bool hasExpressions : {false, true})
        for (int kind = StepMonitor::ConstraintMultipliers; kind <= StepMonitor::ForceGroupEnergy; kind++) {
            Example e;
            if (hasExpressions)
                e.expressions = expressions;
            const vector<StepMonitor::Term> terms = {{(StepMonitor::Kind) kind, 1.0, 1.0, 1.0}};
            Evaluation evaluation(e, terms, 8);
            const double u = evaluation.u(e.velocities);
            ASSERT(u > 0);
            vector<Vec3> others = e.velocities, moving = e.velocities;
            for (int i = 0; i < 6; i++) {
                others[i] *= 1 + 0.1 * (i + 1);
                moving[i] += Vec3(1, 2, 3);
            }
            ASSERT_EQUAL(StepMonitor::dependOnVelocities(terms), evaluation.u(others) != u);
            // Distances know nothing of the frame, so what still sees it takes the velocities themselves.
            if (!hasExpressions)
                ASSERT_EQUAL(StepMonitor::useVelocities(terms), std::fabs(evaluation.u(moving) - u) > 1e-8 * u);
            // The rates of parameters count as velocities do.
            evaluation.state.theta.isMoving = hasExpressions;
            for (double& rate : evaluation.state.theta.rates)
                rate = 4;
            const bool isOfConstraints = StepMonitor::dependOnVelocities(terms) &&
                                         !(kind == StepMonitor::VectorField || kind == StepMonitor::ArcLength ||
                                           kind == StepMonitor::MaxParticleArcLength);
            ASSERT_EQUAL(hasExpressions && isOfConstraints, evaluation.u(e.velocities) != u);
        }
}

void testCombination() {
    // Each term is 1 at its reference, and so is the combination, whatever the weights.
    Example e;
    vector<StepMonitor::Term> terms = {{StepMonitor::MaxForce, 3.0, 1.0, 1.0},
                                       {StepMonitor::VectorField, 0.5, 0.5, 1.0}};
    Evaluation evaluation(e, terms, 8);
    evaluation.u(e.velocities);
    vector<double> values = evaluation.values;
    for (int i = 0; i < 2; i++)
        evaluation.monitor.references[i] = values[i];
    ASSERT_EQUAL_TOL(1.0, evaluation.monitor.combine(values), 1e-14);
    double expected = std::sqrt((9 * 4.0 + 0.25 * 3.0) / 9.25); // U1 doubled; U2 trebled, to the power 1/2
    ASSERT_EQUAL_TOL(expected, evaluation.monitor.combine({2 * values[0], 3 * values[1]}), 1e-14);
    evaluation.monitor.setTerms({}, {});
    ASSERT_EQUAL(1.0, evaluation.monitor.combine({}));
}

void testNegligibleMultipliers() {
    // In free fall nothing pulls: the multipliers are rounding, and no measure.
    Example e;
    for (int i = 0; i < 6; i++) {
        e.forces[i] = Vec3(0, -9.8 * e.masses[i], 0);
        e.velocities[i] = Vec3(0.3, 0.4, 0);
    }
    Evaluation evaluation(
        e, {{StepMonitor::ConstraintMultipliers, 1.0, 1.0, 1.0}, {StepMonitor::ConstraintForce, 1.0, 1.0, 1.0}}, 8);
    for (bool isFalling : {true, false}) {
        evaluation.look();
        for (int k = 0; k < 2; k++)
            ASSERT_EQUAL(isFalling, evaluation.monitor.isNegligible(k, evaluation.state, 0.0, 0.0));
        evaluation.state.v[0] = Vec3(0.3, 0.4001, 0);
    }
}

void testBounds() {
    const double nominal = 0.002, minimum = 1e-4, maximum = 0.005;
    StepDensity density(StepDensity::SemiExplicit, nominal, minimum, maximum);
    ASSERT_EQUAL_TOL(nominal / maximum, density.limit(0), 1e-14);
    ASSERT_EQUAL_TOL(1.0, density.limit(1), 1e-14);
    ASSERT_EQUAL_TOL(nominal / minimum, density.limit(1e15), 1e-10);
    StepDensity unbounded(StepDensity::SemiExplicit, nominal, 0, 0);
    ASSERT_EQUAL_TOL(37.5, unbounded.limit(37.5), 1e-14);
    StepDensity onlyMaximum(StepDensity::SemiExplicit, nominal, 0, maximum);
    ASSERT_EQUAL_TOL(0.4 + 0.6 * 37.5, onlyMaximum.limit(37.5), 1e-14);
    // The update Bounded starts B a little higher, so that f(B) is finite: docs/method.md, section 3.
    StepDensity bounded(StepDensity::Bounded, nominal, minimum, maximum);
    ASSERT_EQUAL_TOL(std::min(4 * 0.4 / 3, (1 + 2 * 0.4) / 3), bounded.limit(0), 1e-14);
    ASSERT_EQUAL_TOL(1.0, bounded.limit(1), 1e-14);
}

void testRecursions() {
    const double nominal = 0.002, maximum = 0.004, a = 0.5;
    StepDensity density(StepDensity::Bounded, nominal, 0, maximum);
    auto f = [&](double rho) { return (rho - a) - (1 - a) * (1 - a) / (rho - a); };
    std::mt19937 random(11);
    std::uniform_real_distribution<double> exponent(-6, 6);
    double previous = 1;
    for (int i = 0; i < 10000; i++) {
        double u = density.limit(std::exp(exponent(random)));
        double next = density.boundedUpdate(u, previous);
        ASSERT(next > a); // every step is shorter than the maximum
        double scale = std::fabs(f(next)) + std::fabs(f(previous)) + std::fabs(f(u));
        ASSERT(std::fabs(f(next) + f(previous) - 2 * f(u)) <= 1e-9 * scale);
        // symmetric: the recursion backwards gives the density it came from
        if (next > a + 1e-3 * (1 - a) && previous > a + 1e-3 * (1 - a))
            ASSERT_EQUAL_TOL(previous, density.boundedUpdate(u, next), 1e-6);
        previous = next > a + 1e-2 && next < 100 ? next : 1.0;
    }
    ASSERT_EQUAL_TOL(0.3, StepDensity::sumUpdate(0.9, StepDensity::sumUpdate(0.9, 0.3)), 1e-14);
    // Where the density is large the bounded update is the paper's sum, nearly.
    ASSERT_EQUAL_TOL(StepDensity::sumUpdate(1000, 900), density.boundedUpdate(1000, 900), 1e-5);
}

int main() {
    return runTests({
        {"what monitors depend on", testWhatMonitorsDependOn},
        {"the combination is normalised term by term", testCombination},
        {"multipliers that are rounding are noticed", testNegligibleMultipliers},
        {"the bounds of the step", testBounds},
        {"the recursions of the density", testRecursions},
    });
}
