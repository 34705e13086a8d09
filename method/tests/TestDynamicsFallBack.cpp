// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What is done where chord iterations fail: Newton's matrix, its damped iteration, the search for a density that solves (3.14), and what is
// said where that fails too.

#include "Examples.h"
#include "Steps.h"
#include "TestSupport.h"
#include "constraints/NewtonMatrix.h"
#include "run/VRattleRun.h"
#include <Eigen/Dense>
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::string;
using std::vector;

namespace {

const string DISTANCE = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)";

VRattleRun::Settings fixedSteps(double stepSize) {
    return {stepSize, 0, 0, 1e-8, StepDensity::Explicit, {}, false};
}

// A zigzag of bonds given as expressions; its particles stand where noise has moved them.
Example makeChain(int bonds, const string& scale, double noise, int seed) {
    Example e;
    e.generator.seed(seed);
    for (int i = 0; i <= bonds; i++) {
        e.add(12, Vec3(0.12 * i, 0.09 * (i % 2), 0) + e.randomVector(noise));
        if (i > 0)
            e.expressions.push_back({scale + "*(" + DISTANCE + "^2-0.0225)", {i - 1, i}, {}});
    }
    return e;
}

} // namespace

// Positions far off come back from every start, however the constraints are scaled, and by the same way.
void testProjectionOfChain(int bonds) {
    for (double noise : {0.02, 0.05, 0.2})
        for (int seed = 0; seed < 8; seed++) {
            vector<Vec3> reference;
            for (const char* scale : {"1", "1e-8", "1e12"}) {
                const Example e = makeChain(bonds, scale, noise, seed);
                VRattleRun dynamics(e.masses, {}, e.expressions);
                dynamics.setSettings(fixedSteps(1e-3));
                vector<Vec3> positions = e.positions;
                ASSERT(dynamics.projectPositions(positions, dynamics.getParameters()));
                for (int i = 0; i < bonds; i++) {
                    const Vec3 r = positions[i] - positions[i + 1];
                    ASSERT_EQUAL_TOL(0.15, std::sqrt(r.dot(r)), 1e-8);
                }
                if (reference.empty())
                    reference = positions;
                for (size_t i = 0; i < positions.size(); i++)
                    ASSERT_EQUAL_VEC(reference[i], positions[i], 1e-6);
            }
        }
}

// Newton's matrix is regular or singular whatever the scale of its rows, and solves as a dense one does.
void testScalesOfNewtonMatrix(int bonds) {
    for (const char* scale : {"1", "1e-15", "1e20"}) {
        const Example e = makeChain(bonds, scale, 0.02, 5);
        const ConstraintSystem system(e.masses, {}, e.expressions);
        vector<Vec3> ahead = e.positions;
        for (Vec3& position : ahead)
            position += Vec3(std::sin(90 * position[0]), std::cos(80 * position[0]), std::sin(70 * position[0])) * 0.01;
        ConstraintSystem::Jacobian current(system.getNumEntries()), next = current;
        system.evaluateJacobian(e.positions, system.getGivenParameters(), current);
        system.evaluateJacobian(ahead, system.getGivenParameters(), next);
        auto dense = [&](const ConstraintSystem::Jacobian& jacobian) {
            Eigen::MatrixXd result = Eigen::MatrixXd::Zero(bonds, 3 * (bonds + 1));
            for (const auto& row : system.getExpressionRows())
                for (int entry = row.first; entry < row.end; entry++)
                    for (int j = 0; j < 3; j++)
                        result(row.constraint, 3 * system.getParticleOf(entry) + j) = jacobian[entry][j];
            return result;
        };
        const Eigen::MatrixXd matrix = dense(next) * dense(current).transpose() / 12;
        NewtonMatrix newton(system);
        ASSERT(newton.factorize(next, current));
        const Eigen::VectorXd solution = Eigen::VectorXd::LinSpaced(bonds, -1, 2), right = matrix * solution;
        vector<double> x(right.data(), right.data() + bonds);
        newton.solve(x);
        ASSERT((Eigen::VectorXd::Map(x.data(), bonds) - solution).norm() <= 1e-9 * solution.norm());
        // Two rows that are the same but for a factor.
        Example doubled = e;
        doubled.expressions.push_back({"7*" + e.expressions[3].expression, e.expressions[3].particles, {}});
        const ConstraintSystem dependent(e.masses, {}, doubled.expressions);
        ConstraintSystem::Jacobian rows(dependent.getNumEntries());
        dependent.evaluateJacobian(e.positions, dependent.getGivenParameters(), rows);
        NewtonMatrix singular(dependent);
        ASSERT(!singular.factorize(rows, rows));
    }
}

// A step that turns bonds by 50 degrees is beyond the chord iteration.
void testLargeStep() {
    for (const char* scale : {"1", "1e-8", "1e12"}) {
        const Example e = makeChain(24, scale, 0.0, 1);
        VRattleRun dynamics(e.masses, {}, e.expressions);
        dynamics.setSettings(fixedSteps(0.05));
        vector<Vec3> velocities(e.masses.size());
        for (size_t i = 0; i < velocities.size(); i++)
            velocities[i] = Vec3(0, 0, i % 4 < 2 ? 1.2 : -1.2);
        vector<Vec3> forces(e.masses.size());
        dynamics.begin(e.positions, velocities, forces, 0);
        dynamics.step(INFINITY);
        const vector<Vec3>& q = dynamics.getNextPositions();
        for (int i = 0; i < 24; i++) {
            const Vec3 r = q[i] - q[i + 1];
            ASSERT_EQUAL_TOL(0.15, std::sqrt(r.dot(r)), 1e-7);
        }
    }
}

// Light beads among heavy ones, whose bonds turn by 40 degrees in a step: no chord iteration finds the density of (3.14), which is stated
// here with dense matrices.
void testDensityOfLargeSteps() {
    for (StepMonitor::Kind kind : {StepMonitor::ConstraintForce, StepMonitor::ConstraintMultipliers}) {
        Example e;
        const int beads = 8;
        for (int i = 0; i < beads; i++) {
            e.add(i % 2 == 0 ? 1000 : 1, Vec3(0.12 * i, 0.09 * (i % 2), 0));
            e.velocities[i] = Vec3(0.2 * i, 0.5, i % 2 == 0 ? 0.1 : 6.0);
            if (i > 0)
                e.join(i - 1, i);
        }
        const auto uOf = [&](const vector<Vec3>& q, const Eigen::VectorXd& w, const vector<Vec3>& force) {
            Eigen::MatrixXd g = Eigen::MatrixXd::Zero(beads - 1, 3 * beads);
            Eigen::VectorXd curvature(beads - 1), acceleration(3 * beads);
            Eigen::VectorXd inverseMasses(3 * beads);
            for (int i = 0; i < 3 * beads; i++) {
                inverseMasses[i] = 1 / e.masses[i / 3];
                acceleration[i] = force[i / 3][i % 3] * inverseMasses[i];
            }
            for (int k = 0; k < beads - 1; k++) { // g = |r|^2 - L^2
                for (int j = 0; j < 3; j++) {
                    g(k, 3 * k + j) = 2 * (q[k][j] - q[k + 1][j]);
                    g(k, 3 * k + 3 + j) = -g(k, 3 * k + j);
                }
                curvature[k] = 2 * (w.segment<3>(3 * k) - w.segment<3>(3 * k + 3)).squaredNorm();
            }
            const Eigen::MatrixXd matrix = g * inverseMasses.asDiagonal() * g.transpose();
            const Eigen::VectorXd lambda = matrix.ldlt().solve(curvature + g * acceleration); // (4.3)
            return kind == StepMonitor::ConstraintMultipliers ? lambda.norm() : std::sqrt(lambda.dot(matrix * lambda));
        };
        const auto flatten = [](const vector<Vec3>& x) {
            Eigen::VectorXd result(3 * x.size());
            for (int i = 0; i < result.size(); i++)
                result[i] = x[i / 3][i % 3];
            return result;
        };
        VRattleRun dynamics(e.masses, e.distances);
        dynamics.setSettings({0.01, 0, 0, 1e-10, StepDensity::SemiExplicit, {{kind, 1.0, 1.0, 0.0}}, false});
        dynamics.begin(e.positions, e.velocities, forcesAt(e.positions), 0);
        takeSteps(dynamics, 1);
        long long most = 0;
        for (int step = 0; step < 10; step++) {
            const vector<Vec3> q = dynamics.getPositions(), force = dynamics.getForces();
            const Eigen::VectorXd before = flatten(dynamics.keep().state.w);
            const double rho = dynamics.getDensity(), reference = dynamics.getReferences()[0];
            const long long iterations = dynamics.getNumIterations();
            takeSteps(dynamics, 1);
            most = std::max(most, dynamics.getNumIterations() - iterations);
            const double size = 0.01 / dynamics.getDensity();
            const Eigen::VectorXd after = (flatten(dynamics.getPositions()) - flatten(q)) / size;
            const double expected = (uOf(q, after, force) + uOf(q, before, force)) / reference;
            ASSERT_EQUAL_TOL(expected, dynamics.getDensity() + rho, 1e-7);
        }
        ASSERT_EQUAL(0, dynamics.getNumRescues());
        ASSERT(most > 12); // which are more than the chord iteration has
    }
}

// A dihedral angle that is fixed over three particles that come into line is named, not what has the largest error in the end.
void testDihedralOverLine() {
    Example e;
    e.add(12, Vec3(-0.12, 0.001, 0));
    e.add(1e7, Vec3(0, 0, 0)); // so heavy that it is not the axis that turns
    e.add(1e7, Vec3(0.12, 0, 0));
    e.add(12, Vec3(0.2, 0.1, 0));
    for (int i = 0; i < 3; i++) {
        const Vec3 r = e.positions[i] - e.positions[i + 1];
        e.expressions.push_back({DISTANCE + "-length", {i, i + 1}, {{"length", std::sqrt(r.dot(r))}}});
    }
    e.expressions.push_back(
        {"atan2(sqrt(bx^2+by^2+bz^2)*(ax*nx+ay*ny+az*nz), mx*nx+my*ny+mz*nz);"
         "mx=ay*bz-az*by; my=az*bx-ax*bz; mz=ax*by-ay*bx; nx=by*cz-bz*cy; ny=bz*cx-bx*cz; nz=bx*cy-by*cx;"
         "ax=x2-x1; ay=y2-y1; az=z2-z1; bx=x3-x2; by=y3-y2; bz=z3-z2; cx=x4-x3; cy=y4-y3; cz=z4-z3",
         {0, 1, 2, 3},
         {}});
    // Through the line within one step: the angle, which is 0, would be pi behind it.
    const vector<Vec3> velocities = {Vec3(0, -1, 0), Vec3(), Vec3(), Vec3()};
    VRattleRun dynamics(e.masses, {}, e.expressions);
    dynamics.setSettings(fixedSteps(2e-3));
    dynamics.begin(e.positions, velocities, vector<Vec3>(4), 0);
    assertThrows("expression constraint 3 (atan2", [&] { dynamics.step(INFINITY); });
    assertThrows("singular geometry", [&] { dynamics.step(INFINITY); });
    // A step that is simply too large blames nobody's geometry.
    const Example chain = makeChain(3, "1", 0.0, 1);
    VRattleRun other(chain.masses, {}, chain.expressions);
    other.setSettings(fixedSteps(10.0));
    other.begin(chain.positions, {Vec3(0, 1, 0), Vec3(0, -1, 0), Vec3(0, 1, 2), Vec3(0, -1, 0)}, vector<Vec3>(4), 0);
    assertThrows("could not be solved for", [&] { other.step(INFINITY); });
}

// A step whose sum update gives no positive density is counted for good, whatever controls the steps afterwards.
void testCountOfRescues() {
    VRattleRun dynamics({10}, {});
    VRattleRun::Settings settings = {
        0.001, 0, 0, 1e-8, StepDensity::Explicit, {{StepMonitor::AppliedForce, 1.0, 1.0, 0.0}}, false};
    dynamics.setSettings(settings);
    dynamics.begin({Vec3()}, {Vec3(1, 0, 0)}, {Vec3(100, 0, 0)}, 0);
    for (double force : {100, 100, 1, 1}) { // u falls to 0.01, where 2u - rho is negative
        ASSERT_EQUAL(0, dynamics.getNumRescues());
        vector<Vec3> forces;
        do {
            dynamics.step(INFINITY);
            forces = {Vec3(force, 0, 0)};
        } while (!dynamics.finish(forces, 0));
    }
    ASSERT_EQUAL(1, dynamics.getNumRescues());
    settings.isAutomatic = true;
    settings.terms.clear();
    dynamics.setSettings(settings);
    ASSERT_EQUAL(1, dynamics.getNumRescues());
}

int main() {
    return runTests({
        {"projection of a chain, dense", [] { testProjectionOfChain(24); }},
        {"projection of a chain, sparse", [] { testProjectionOfChain(60); }},
        {"scales of Newton's matrix, dense", [] { testScalesOfNewtonMatrix(24); }},
        {"scales of Newton's matrix, sparse", [] { testScalesOfNewtonMatrix(60); }},
        {"a large step", testLargeStep},
        {"the density of large steps", testDensityOfLargeSteps},
        {"a dihedral angle over a line", testDihedralOverLine},
        {"the count of rescues", testCountOfRescues},
    });
}
