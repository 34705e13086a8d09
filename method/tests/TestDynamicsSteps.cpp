// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// VRattleRun with forces of its own: clusters of every shape that has kernels, in odd and even numbers, beside
// general ones, against a dense statement of the multipliers.

#include "Examples.h"
#include "TestSupport.h"
#include "run/VRattleRun.h"
#include <Eigen/Dense>
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

static const vector<Vec3> SHAPE = {Vec3(), Vec3(0.1, 0, 0.01), Vec3(-0.03, 0.11, 0), Vec3(-0.02, -0.05, 0.09),
                                   Vec3(-0.04, -0.05, -0.1)};

static void makeExample(Example& e, int copies) {
    for (int copy = 0; copy < copies; copy++) {
        e.addCluster({12, 1}, {{0, 1}}, SHAPE);
        e.addCluster({1, 16, 2}, {{1, 0}, {1, 2}}, {SHAPE[1], SHAPE[0], SHAPE[2]});
        e.addCluster({12, 1, 1, 1}, {{0, 1}, {2, 0}, {0, 3}}, SHAPE);
        e.addCluster({12, 1, 2, 3, 4}, {{0, 1}, {0, 2}, {0, 3}, {4, 0}}, SHAPE);
        e.addCluster({16, 1, 1}, {{1, 2}, {0, 1}, {2, 0}}, {Vec3(), Vec3(0.08, 0.06, 0), Vec3(-0.08, 0.06, 0)});
    }
    // In no batch: a ring with a tail, and a free particle.
    e.addCluster({12, 14, 16, 12, 1}, {{0, 1}, {1, 2}, {2, 3}, {3, 0}, {3, 4}}, SHAPE);
    e.addCluster({40}, {}, SHAPE);
}

// Springs to the origin, one stiffness each, and a pull along the velocity-free direction (1, 2, -1).
static vector<Vec3> springsAt(const vector<Vec3>& positions) {
    vector<Vec3> forces;
    for (size_t i = 0; i < positions.size(); i++)
        forces.push_back(positions[i] * (-20.0 - (double) (i % 7)) + Vec3(1, 2, -1) * (double) (i % 5));
    return forces;
}

static StepSettings makeSettings(StepDensity::Update update) {
    return {0.002, 0.002 / 50, 0.004, 1e-10, update, {{StepMonitor::ConstraintMultipliers, 1.0, 1.0, 0.0}}, false};
}

// Both halves of a step; returns whether it is complete.
static bool takeStep(VRattleRun& dynamics) {
    dynamics.step(INFINITY);
    vector<Vec3> forces = springsAt(dynamics.getNextPositions());
    return dynamics.finish(forces, 0);
}

static void run(VRattleRun& dynamics, const Example& e, int steps) {
    vector<Vec3> positions = e.positions;
    dynamics.begin(positions, e.velocities, springsAt(positions), 0);
    for (int i = 0; i < steps; i++)
        while (!takeStep(dynamics)) {
        }
}

// Lambda = K^-1 (g''(v,v) + G M^-1 F) for g = |r|^2 - d^2, in the order of the constraints.
static Eigen::VectorXd denseMultipliers(const Example& e, const VRattleRun& dynamics) {
    const int m = (int) e.distances.size(), n = 3 * (int) e.masses.size();
    Eigen::MatrixXd g = Eigen::MatrixXd::Zero(m, n);
    Eigen::VectorXd curvature(m), force(n), inverseMass(n);
    const vector<Vec3>&q = dynamics.getPositions(), &v = dynamics.getVelocities(), &f = dynamics.getForces();
    for (int i = 0; i < n; i++) {
        force[i] = f[i / 3][i % 3];
        inverseMass[i] = 1 / e.masses[i / 3];
    }
    for (int k = 0; k < m; k++) {
        const int a = e.distances[k].particle1, b = e.distances[k].particle2;
        Vec3 r = q[a] - q[b], w = v[a] - v[b];
        for (int j = 0; j < 3; j++) {
            g(k, 3 * a + j) = 2 * r[j];
            g(k, 3 * b + j) = -2 * r[j];
        }
        curvature[k] = 2 * w.dot(w);
        ASSERT(std::fabs(std::sqrt(r.dot(r)) / e.distances[k].length - 1) <= 1e-10);
        ASSERT(std::fabs(r.dot(w)) < 1e-11); // the velocities are tangent
    }
    Eigen::MatrixXd k = g * inverseMass.asDiagonal() * g.transpose();
    return k.ldlt().solve(curvature + g * inverseMass.cwiseProduct(force));
}

void testShapes(StepDensity::Update update) {
    for (int copies : {1, 2, 3}) {
        Example e;
        makeExample(e, copies);
        VRattleRun dynamics(e.masses, e.distances);
        ASSERT(dynamics.getConstraintSystem().getBatches().size() == 5);
        ASSERT_EQUAL((int) e.distances.size() - 5, dynamics.getConstraintSystem().getFirstGeneral());
        dynamics.setSettings(makeSettings(update));
        run(dynamics, e, 1);
        const double reference = dynamics.getReferences()[0];
        for (int i = 0; i < 50; i++) {
            const double before = dynamics.getDensity(), u = dynamics.getMonitorValues()[0] / reference;
            ASSERT(takeStep(dynamics));
            Eigen::VectorXd expected = denseMultipliers(e, dynamics);
            vector<double> found;
            dynamics.getConstraintSystem().getGivenMultipliers(dynamics.getMultipliers(), found);
            for (int k = 0; k < expected.size(); k++)
                ASSERT(std::fabs(found[k] - expected[k]) <= 1e-9 * expected.norm());
            ASSERT_EQUAL_TOL(expected.norm(), dynamics.getMonitorValues()[0], 1e-10);
            if (update == StepDensity::Explicit) { // (3.15)
                StepDensity density(update, 0.002, 0.002 / 50, 0.004);
                ASSERT_EQUAL_TOL(2 * density.limit(u) - before, dynamics.getDensity(), 1e-12);
            }
        }
        ASSERT_EQUAL(0, dynamics.getNumRescues());
    }
}

// Without forces, all motion is the same in a frame that moves.
void testChangedFrame() {
    Example e;
    makeExample(e, 2);
    const vector<Vec3> noForces(e.masses.size());
    auto takeFreeSteps = [&](VRattleRun& dynamics, int steps) {
        double time = 0;
        for (int i = 0; i < steps;) {
            const double size = dynamics.step(INFINITY);
            vector<Vec3> forces = noForces;
            if (dynamics.finish(forces, 0)) {
                time += size;
                i++;
            }
        }
        return time;
    };
    const Vec3 shift(0.3, -2, 0.7);
    for (auto kind : {StepMonitor::ConstraintMultipliers, StepMonitor::VectorField}) {
        VRattleRun resting(e.masses, e.distances), moving(e.masses, e.distances);
        for (VRattleRun* dynamics : {&resting, &moving}) {
            StepSettings settings = makeSettings(StepDensity::SemiExplicit);
            settings.terms[0].kind = kind;
            settings.tolerance = 1e-12;
            dynamics->setSettings(settings);
            dynamics->begin(e.positions, e.velocities, noForces, 0);
            takeFreeSteps(*dynamics, 20);
        }
        vector<Vec3> velocities = moving.getVelocities();
        for (Vec3& v : velocities)
            v += shift;
        vector<Vec3> others = velocities;
        others.back() += Vec3(0, 1e-9, 0);
        ASSERT(!moving.changeFrame(moving.getVelocities(), others));
        ASSERT_EQUAL_VEC(resting.getVelocities()[0], moving.getVelocities()[0], 0.0);
        ASSERT(moving.changeFrame(moving.getVelocities(), velocities));
        if (kind == StepMonitor::VectorField) { // which sees the frame
            double square = 0;
            for (size_t i = 0; i < velocities.size(); i++)
                square += e.masses[i] * velocities[i].dot(velocities[i]);
            ASSERT_EQUAL_TOL(std::sqrt(square), moving.getMonitorValues()[0], 1e-12);
            continue;
        }
        const double time = takeFreeSteps(resting, 20);
        ASSERT_EQUAL_TOL(time, takeFreeSteps(moving, 20), 1e-12);
        ASSERT_EQUAL_TOL(resting.getDensity(), moving.getDensity(), 1e-10);
        for (size_t i = 0; i < velocities.size(); i++)
            ASSERT_EQUAL_VEC(resting.getPositions()[i] + shift * time, moving.getPositions()[i], 1e-11);
    }
}

// A step that fails in its second half leaves nothing behind, whatever comes next: above all not the forces of where it failed.
void testFailedSteps() {
    for (const bool isGeneral : {false, true}) // small clusters in batches have no factor that is made anew
        for (const auto update : {StepDensity::SemiExplicit, StepDensity::Explicit, StepDensity::Bounded})
            for (const auto kind : {StepMonitor::VectorField, StepMonitor::ConstraintAndAppliedForce,
                                    StepMonitor::ArcLength, StepMonitor::ForcePNorm})
                for (int next = 0; next < 5; next++) {
                    Example e;
                    for (int i = 0; i < 3; i++)
                        e.addCluster({16, 1, 1}, {{0, 1}, {0, 2}, {1, 2}},
                                     {Vec3(), Vec3(0.08, 0.06, 0), Vec3(-0.08, 0.06, 0)});
                    if (isGeneral)
                        makeExample(e, 1);
                    VRattleRun tried(e.masses, e.distances), untried(e.masses, e.distances);
                    for (VRattleRun* dynamics : {&tried, &untried}) {
                        StepSettings settings = makeSettings(update);
                        settings.terms[0].kind = kind;
                        dynamics->setSettings(settings);
                        run(*dynamics, e, 5);
                        if (dynamics == &tried) {
                            dynamics->step(INFINITY);
                            vector<Vec3> forces = springsAt(dynamics->getNextPositions());
                            forces[0][1] = NAN;
                            assertThrows("not a number", [&] { dynamics->finish(forces, 0); });
                            dynamics->abandonStep();
                        }
                        vector<Vec3> velocities = dynamics->getVelocities();
                        for (size_t i = 0; i < velocities.size(); i++)
                            velocities[i] += next == 1 ? Vec3(0.3, -2, 0.7) : Vec3(0, 0.01 * (double) i, 0);
                        if (next == 1)
                            ASSERT(dynamics->changeFrame(dynamics->getVelocities(), velocities));
                        if (next == 2)
                            dynamics->changeVelocities(velocities);
                        if (next == 3)
                            dynamics->reverse();
                        if (next == 4) {
                            settings.stepSize *= 0.7;
                            dynamics->setSettings(settings);
                        }
                        ASSERT(std::isfinite(dynamics->getMonitorValues()[0]));
                        for (int i = 0; i < 5; i++)
                            takeStep(*dynamics);
                    }
                    ASSERT_EQUAL(untried.getDensity(), tried.getDensity());
                    ASSERT_EQUAL(untried.getMonitorValues()[0], tried.getMonitorValues()[0]);
                    for (size_t i = 0; i < e.masses.size(); i++)
                        ASSERT_EQUAL_VEC(untried.getPositions()[i], tried.getPositions()[i], 0.0);
                }
}

// Whichever way is faster is chosen, whatever single steps took, and found again when it changes.
void testThreadChoice() {
    ThreadChoice choice;
    for (double parallelTime : {0.5, 2.0, 0.7}) {
        int numParallel = 0, numSteps = 0;
        for (; numSteps < ThreadChoice::PERIOD; numSteps++) {
            const bool isParallel = choice.isParallel();
            numParallel += isParallel;
            choice.add((isParallel ? parallelTime : 1.0) *
                       (numSteps % 9 == 0 ? 20 : 1)); // now and then something else runs
        }
        const int inTrial = ThreadChoice::TRIAL_LENGTH / 2;
        ASSERT_EQUAL(parallelTime < 1 ? numSteps - inTrial : inTrial, numParallel);
    }
}

int main() {
    return runTests({
        {"clusters of every shape, SemiExplicit", [] { testShapes(StepDensity::SemiExplicit); }},
        {"clusters of every shape, Explicit", [] { testShapes(StepDensity::Explicit); }},
        {"clusters of every shape, Bounded", [] { testShapes(StepDensity::Bounded); }},
        {"another frame of reference", testChangedFrame},
        {"steps that fail", testFailedSteps},
        {"the choice of threads", testThreadChoice},
    });
}
