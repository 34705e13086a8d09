// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// ConstraintSystem, ConstraintMatrix and NewtonMatrix against dense statements of the same formulas.

#include "TestSupport.h"
#include "constraints/ConstraintMatrix.h"
#include "constraints/NewtonMatrix.h"
#include "run/VRattleRun.h"
#include <Eigen/Dense>
#include <random>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

struct Example {
    vector<double> masses;
    vector<DistanceConstraint> constraints;
    vector<Vec3> positions, velocities;
};

static Vec3 randomVector(std::mt19937& random) {
    std::normal_distribution<double> normal;
    return Vec3(normal(random), normal(random), normal(random));
}

// Water molecules, a ring, a chain of the given length and a star, with the constraints in mixed order.
static Example makeExample(int chainLength) {
    Example e;
    std::mt19937 random(7);
    std::uniform_real_distribution<double> uniform(1, 150);
    auto addParticles = [&](int count) {
        for (int i = 0; i < count; i++) {
            e.masses.push_back(uniform(random));
            e.positions.push_back(randomVector(random));
            e.velocities.push_back(randomVector(random));
        }
        return (int) e.masses.size() - count;
    };
    auto constrain = [&](int i, int j) {
        Vec3 r = e.positions[i] - e.positions[j];
        e.constraints.push_back({i, j, std::sqrt(r.dot(r))});
    };
    for (int molecule = 0; molecule < 3; molecule++) {
        int first = addParticles(3);
        constrain(first, first + 1);
        constrain(first, first + 2);
        constrain(first + 1, first + 2);
    }
    int ring = addParticles(6);
    for (int i = 0; i < 6; i++)
        constrain(ring + i, ring + (i + 1) % 6);
    int chain = addParticles(chainLength);
    for (int i = 1; i < chainLength; i++)
        constrain(chain + i - 1, chain + i);
    int star = addParticles(4);
    for (int i = 1; i < 4; i++)
        constrain(star + i, star);
    addParticles(2); // unconstrained
    std::shuffle(e.constraints.begin(), e.constraints.end(), random);
    return e;
}

// The dense Jacobian of the relative form, by its definition.
static Eigen::MatrixXd denseJacobian(const ConstraintSystem& system, const vector<Vec3>& x) {
    Eigen::MatrixXd g = Eigen::MatrixXd::Zero(system.getNumConstraints(), 3 * system.getNumParticles());
    for (int k = 0; k < system.getNumConstraints(); k++) {
        const DistanceConstraint& c = system.getConstraint(k);
        for (int j = 0; j < 3; j++) {
            double row = (x[c.particle1][j] - x[c.particle2][j]) / (c.length * c.length);
            g(k, 3 * c.particle1 + j) = row;
            g(k, 3 * c.particle2 + j) = -row;
        }
    }
    return g;
}

static Eigen::VectorXd denseInverseMasses(const vector<double>& masses) {
    Eigen::VectorXd result(3 * masses.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = masses[i / 3] > 0 ? 1 / masses[i / 3] : 0;
    return result;
}

static Eigen::VectorXd flatten(const vector<Vec3>& x) {
    Eigen::VectorXd result(3 * x.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = x[i / 3][i % 3];
    return result;
}

static void assertSmall(double error, double tolerance) {
    ASSERT(error <= tolerance);
}

void testJacobianIsDerivative() {
    Example e = makeExample(30);
    ConstraintSystem system(e.masses, e.constraints);
    const ExpressionParameters theta = system.getGivenParameters();
    const int m = system.getNumConstraints();
    vector<double> plus(m), minus(m), derivative(m), curvature(m), zero(m);
    ConstraintSystem::Jacobian jacobian(m);
    system.evaluateJacobian(e.positions, theta, jacobian);
    assertSmall(system.evaluate(e.positions, theta, zero, jacobian), 1e-14);
    const double h = 1e-4;
    vector<Vec3> ahead = e.positions, back = e.positions;
    for (size_t i = 0; i < ahead.size(); i++) {
        ahead[i] += e.velocities[i] * h;
        back[i] -= e.velocities[i] * h;
    }
    system.evaluate(ahead, theta, plus, jacobian);
    system.evaluate(back, theta, minus, jacobian);
    system.multiply(jacobian, e.velocities, derivative);
    system.evaluateCurvature(e.positions, e.velocities, theta, curvature);
    // A distance constraint is quadratic, so central differences are exact but for rounding.
    for (int k = 0; k < m; k++) {
        ASSERT_EQUAL_TOL((plus[k] - minus[k]) / (2 * h), derivative[k], 1e-8);
        ASSERT_EQUAL_TOL((plus[k] - 2 * zero[k] + minus[k]) / (h * h), curvature[k], 1e-6);
    }
}

void testMatrixAgainstDense(int chainLength) {
    Example e = makeExample(chainLength);
    ConstraintSystem system(e.masses, e.constraints);
    const ExpressionParameters theta = system.getGivenParameters();
    ConstraintMatrix matrix(system);
    const int m = system.getNumConstraints();
    ConstraintSystem::Jacobian jacobian(m);
    system.evaluateJacobian(e.positions, theta, jacobian);
    Eigen::MatrixXd g = denseJacobian(system, e.positions);
    Eigen::MatrixXd k = g * denseInverseMasses(e.masses).asDiagonal() * g.transpose();
    for (int repeat = 0; repeat < 2; repeat++) { // the second factorisation reuses the pattern
        matrix.factorize(jacobian);
        vector<double> x(m);
        Eigen::VectorXd b = Eigen::VectorXd::LinSpaced(m, -1, 2);
        Eigen::VectorXd::Map(x.data(), m) = b;
        matrix.solve(x);
        assertSmall((k * Eigen::VectorXd::Map(x.data(), m) - b).norm() / b.norm(), 1e-10);
    }
    // G^T x and G M^-1 f
    vector<double> x(m, 0.5), product(m);
    vector<Vec3> forces(e.masses.size());
    system.addTransposed(jacobian, x, forces);
    assertSmall((flatten(forces) - g.transpose() * Eigen::VectorXd::Constant(m, 0.5)).norm(), 1e-12);
    system.multiplyOverMass(jacobian, forces, product);
    Eigen::VectorXd expected = g * denseInverseMasses(e.masses).asDiagonal() * flatten(forces);
    assertSmall((Eigen::VectorXd::Map(product.data(), m) - expected).norm() / expected.norm(), 1e-12);
}

void testNewtonMatrixAgainstDense(int chainLength) {
    Example e = makeExample(chainLength);
    ConstraintSystem system(e.masses, e.constraints);
    const ExpressionParameters theta = system.getGivenParameters();
    NewtonMatrix matrix(system);
    const int m = system.getNumConstraints();
    vector<Vec3> ahead = e.positions;
    for (size_t i = 0; i < ahead.size(); i++)
        ahead[i] += e.velocities[i] * 0.05;
    ConstraintSystem::Jacobian current(m), next(m);
    system.evaluateJacobian(e.positions, theta, current);
    system.evaluateJacobian(ahead, theta, next);
    Eigen::MatrixXd a = denseJacobian(system, ahead) * denseInverseMasses(e.masses).asDiagonal() *
                        denseJacobian(system, e.positions).transpose();
    Eigen::VectorXd b = Eigen::VectorXd::LinSpaced(m, -1, 2);
    for (int repeat = 0; repeat < 2; repeat++) {
        ASSERT(matrix.factorize(next, current));
        vector<double> x(b.data(), b.data() + m);
        matrix.solve(x);
        assertSmall((a * Eigen::VectorXd::Map(x.data(), m) - b).norm() / b.norm(), 1e-10);
    }
}

void testMasslessParticles() {
    // As in OpenMM, a distance to what cannot move is refused, and one between two such particles is none.
    assertThrows("mass is zero, 2", [] { ConstraintSystem({1, 2, 0}, {{0, 1, 1.0}, {1, 2, 1.0}}); });
    const ConstraintSystem one({0, 2, 0, 1}, {{1, 3, 1.0}, {0, 2, 1.0}});
    ASSERT_EQUAL(1, one.getNumConstraints());
    vector<double> multipliers;
    one.getGivenMultipliers({3.0}, multipliers);
    ASSERT_EQUAL(2, multipliers.size());
    ASSERT_EQUAL_TOL(1.5, multipliers[0], 1e-15);
    ASSERT_EQUAL(0.0, multipliers[1]);
    // Expressions may hold a particle to it. It is never written to: a NaN from a trial stays a trial's, and threads that
    // share an anchor do not meet at it.
    const std::string distance = "(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-1";
    const ConstraintSystem system({0, 2, 3}, {}, {{distance, {0, 1}, {}}, {distance, {2, 0}, {}}});
    const ExpressionParameters theta = system.getGivenParameters();
    ASSERT_EQUAL(2 + 2, system.getNumEntries());
    const vector<Vec3> positions = {Vec3(), Vec3(1, 0, 0), Vec3(0, 1, 0)};
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    system.evaluateJacobian(positions, theta, jacobian);
    const double nan = std::nan("");
    vector<Vec3> x(3, Vec3(5, 6, 7));
    system.addTransposedOverMass(jacobian, {nan, nan}, 1.0, x);
    ASSERT_EQUAL_VEC(Vec3(5, 6, 7), x[0], 0.0);
    ASSERT(std::isnan(x[1][0]) && std::isnan(x[2][1]));
    system.addTransposed(jacobian, {nan, nan}, x);
    ASSERT_EQUAL_VEC(Vec3(5, 6, 7), x[0], 0.0);
    // Nor read where it would count as moving.
    const vector<Vec3> velocities = {Vec3(nan, nan, nan), Vec3(1, 2, 3), Vec3(1, 2, 3)};
    vector<double> result(2);
    system.multiply(jacobian, velocities, result);
    ASSERT_EQUAL_TOL(2.0, result[0], 1e-15);
    ASSERT_EQUAL_TOL(4.0, result[1], 1e-15);
    system.multiplyOverMass(jacobian, velocities, result);
    ASSERT_EQUAL_TOL(1.0, result[0], 1e-15);
    ASSERT_EQUAL_TOL(4.0 / 3, result[1], 1e-15);
}

// Lengths and masses are data of each cluster: clusters of one topology make one batch, and are solved with their own.
void testClustersOfDifferentLengths() {
    Example e;
    std::mt19937 random(3);
    std::uniform_real_distribution<double> uniform(1, 150);
    auto addMolecule = [&](const vector<std::pair<int, int>>& bonds, int size) {
        const int first = (int) e.masses.size();
        for (int i = 0; i < size; i++) {
            e.masses.push_back(uniform(random));
            e.positions.push_back(randomVector(random));
            e.velocities.push_back(randomVector(random));
        }
        for (const auto& bond : bonds) {
            const Vec3 r = e.positions[first + bond.first] - e.positions[first + bond.second];
            e.constraints.push_back({first + bond.first, first + bond.second, std::sqrt(r.dot(r))});
        }
    };
    for (int i = 0; i < 7; i++) {
        addMolecule({{0, 1}}, 2);
        addMolecule({{0, 1}, {0, 2}, {1, 2}}, 3);
        addMolecule({{0, 1}, {0, 2}, {0, 3}}, 4);
    }
    VRattleRun dynamics(e.masses, e.constraints);
    const ConstraintSystem& system = dynamics.getConstraintSystem();
    const ExpressionParameters theta = system.getGivenParameters();
    const int m = system.getNumConstraints();
    ASSERT_EQUAL(3, (int) system.getBatches().size());
    ASSERT_EQUAL(m, system.getFirstGeneral());
    dynamics.setSettings(
        {1e-3, 0, 0, 1e-10, StepDensity::SemiExplicit, {{StepMonitor::ConstraintForce, 1.0, 1.0, 0.0}}, false});
    vector<Vec3> forces(e.masses.size());
    for (Vec3& force : forces)
        force = randomVector(random);
    dynamics.begin(e.positions, e.velocities, forces, 0);
    vector<double> g(m), curvature(m);
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    for (int step = 0; step < 5; step++) {
        dynamics.step(INFINITY);
        ASSERT(system.evaluate(dynamics.getNextPositions(), theta, g, jacobian) <= 1e-10);
        vector<Vec3> sameForces = forces;
        ASSERT(dynamics.finish(sameForces, 0));
        const Eigen::MatrixXd rows = denseJacobian(system, dynamics.getPositions());
        const Eigen::VectorXd inverseMasses = denseInverseMasses(e.masses);
        assertSmall((rows * flatten(dynamics.getVelocities())).norm(), 1e-10);
        system.evaluateCurvature(dynamics.getPositions(), dynamics.getVelocities(), theta, curvature);
        const Eigen::VectorXd right =
            Eigen::VectorXd::Map(curvature.data(), m) + rows * inverseMasses.asDiagonal() * flatten(forces);
        const Eigen::VectorXd expected = (rows * inverseMasses.asDiagonal() * rows.transpose()).ldlt().solve(right);
        assertSmall((expected - Eigen::VectorXd::Map(dynamics.getMultipliers().data(), m)).norm(),
                    1e-9 * expected.norm());
    }
}

static void assertDependent(const vector<double>& masses, const vector<DistanceConstraint>& constraints,
                            const vector<Vec3>& positions, const std::string& particles) {
    ConstraintSystem system(masses, constraints);
    const ExpressionParameters theta = system.getGivenParameters();
    ConstraintMatrix matrix(system);
    ConstraintSystem::Jacobian jacobian(system.getNumConstraints());
    system.evaluateJacobian(positions, theta, jacobian);
    assertThrows(particles, [&] { matrix.factorize(jacobian); });
}

void testDependentConstraints() {
    vector<Vec3> line = {Vec3(9, 9, 9), Vec3(0, 0, 0), Vec3(0.1, 0.05, 0), Vec3(0.2, 0.1, 0)};
    double d = std::sqrt(0.0125);
    assertDependent({1, 12, 16, 12}, {{1, 2, d}, {2, 3, d}, {1, 3, 2 * d}}, line, "particles 1, 2 and 3");
    assertDependent({1, 12, 16, 12}, {{1, 2, d}, {2, 3, d}, {1, 3, 2 * d}}, line,
                    "the distances among the particles 1, 2 and 3 keep them in a line");
    // Two constraints of one pair must be added up, or they would hide each other.
    assertDependent({1, 12, 16, 12}, {{1, 2, d}, {2, 1, d}}, line, "particles 1 and 2");
    // A chain long enough for the sparse factorisation, with one bond doubled.
    Example e = makeExample(40);
    e.constraints.push_back(e.constraints[0]);
    for (const DistanceConstraint& c : vector<DistanceConstraint>(e.constraints))
        if (c.particle1 == 20 && c.particle2 == 21)
            e.constraints.push_back(c);
    assertDependent(e.masses, e.constraints, e.positions, "redundant");
    // A heavy-light-heavy line is strongly coupled and legitimate.
    ConstraintSystem system({1000, 1, 1000}, {{0, 1, 0.1}, {1, 2, 0.1}});
    const ExpressionParameters theta = system.getGivenParameters();
    ConstraintMatrix matrix(system);
    ConstraintSystem::Jacobian jacobian(2);
    system.evaluateJacobian({Vec3(0, 0, 0), Vec3(0.1, 0, 0), Vec3(0.2, 0, 0)}, theta, jacobian);
    matrix.factorize(jacobian);
}

int main() {
    return runTests({
        {"the Jacobian and the curvature are derivatives of g", testJacobianIsDerivative},
        {"K and its factor, dense blocks", [] { testMatrixAgainstDense(5); }},
        {"K and its factor, with a sparse block", [] { testMatrixAgainstDense(60); }},
        {"Newton's matrix, dense blocks", [] { testNewtonMatrixAgainstDense(5); }},
        {"Newton's matrix, with a sparse block", [] { testNewtonMatrixAgainstDense(60); }},
        {"massless particles", testMasslessParticles},
        {"clusters of different lengths and masses", testClustersOfDifferentLengths},
        {"dependent constraints are named", testDependentConstraints},
    });
}
