// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// MonitorControl: the first step of a sequence of densities, and what it must not depend on.

#include "TestSupport.h"
#include "run/VRattleRun.h"
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

static const StepDensity::Update UPDATES[] = {StepDensity::SemiExplicit, StepDensity::Explicit, StepDensity::Bounded};

/** Two particles joined to each other, the first of them also to a fixed one by an expression, in springs to the origin. */
struct Tethered {
    vector<double> masses = {12, 1, 0};
    vector<DistanceConstraint> distances = {{0, 1, 0.1}};
    vector<ExpressionConstraint> expressions = {{"sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-d", {0, 2}, {{"d", 0.2}}}};
    vector<Vec3> positions = {Vec3(0.5, 0.3, 0), Vec3(0.5, 0.4, 0), Vec3(0.7, 0.3, 0)};
    vector<Vec3> velocities = {Vec3(0, 1, 0.5), Vec3(2, 1, -1), Vec3()};
    static vector<Vec3> forcesAt(const vector<Vec3>& positions) {
        return {positions[0] * -300, positions[1] * -50, Vec3()};
    }
    /** Takes a step, and returns how often its halves were done. */
    static int takeStep(VRattleRun& dynamics) {
        int count = 0;
        vector<Vec3> forces;
        do {
            dynamics.step(INFINITY);
            forces = forcesAt(dynamics.getNextPositions());
            count++;
        } while (!dynamics.finish(forces, 0));
        return count;
    }
};

static StepSettings makeSettings(double stepSize, StepDensity::Update update, double reference = 0) {
    return {stepSize, 0, 0, 1e-12, update, {{StepMonitor::ConstraintForce, 1.0, 1.0, reference}}, false};
}

// The oscillation of the density about its smooth course in the first steps: the alternating part, which the sixth difference is 64 times.
static double oscillation(StepDensity::Update update, double stepSize, double reference, bool isAtRest) {
    Tethered e;
    if (isAtRest)
        e.velocities = vector<Vec3>(3);
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    dynamics.setSettings(makeSettings(stepSize, update, reference));
    dynamics.begin(e.positions, e.velocities, Tethered::forcesAt(e.positions), 0);
    vector<double> densities;
    for (int i = 0; i < 7; i++) {
        const int attempts = Tethered::takeStep(dynamics);
        ASSERT(attempts == 1 || (attempts == 2 && i == 0 && reference > 0));
        densities.push_back(dynamics.getDensity());
    }
    const int weights[] = {1, -6, 15, -20, 15, -6, 1};
    double difference = 0;
    for (int i = 0; i < 7; i++)
        difference += weights[i] * densities[i];
    return std::fabs(difference) / 64;
}

// It falls with the square of the step, or faster from rest, where the forces behind the start are known, whether the reference is
// taken or given. A density that starts with u0 oscillates with the first power.
void testSmoothStart() {
    for (StepDensity::Update update : UPDATES)
        for (double reference : {0.0, 150.0})
            for (bool isAtRest : {false, true}) {
                const double coarse = oscillation(update, 0.001, reference, isAtRest),
                             fine = oscillation(update, 0.0005, reference, isAtRest);
                ASSERT(coarse < 1e-4);
                ASSERT(fine < coarse / (isAtRest ? 7 : 3.3));
            }
}

// Where nothing pulls there is no density and no reference, until something does.
void testCalmStart() {
    Tethered e;
    for (StepDensity::Update update : UPDATES) {
        VRattleRun dynamics(e.masses, e.distances);
        dynamics.setSettings(makeSettings(0.001, update));
        vector<Vec3> forces(3);
        dynamics.begin(e.positions, forces, forces, 0);
        for (int i = 0; i < 3; i++) {
            dynamics.step(INFINITY);
            ASSERT(dynamics.finish(forces, 0));
            ASSERT(!dynamics.hasStarted());
            ASSERT_EQUAL(0.0, dynamics.getReferences()[0]);
            forces = vector<Vec3>(3);
        }
        dynamics.step(INFINITY);
        forces = {Vec3(0, 100, 0), Vec3(), Vec3()};
        dynamics.finish(forces, 0);
        Tethered::takeStep(dynamics);
        ASSERT(dynamics.hasStarted());
        ASSERT(dynamics.getReferences()[0] > 0);
    }
}

// Where the motion goes through a place where the forces are all but zero, as after a minimisation, the sequence starts a few steps
// later: with that place for a reference the density would oscillate for ever between short steps and long ones.
void testStartAtMinimum() {
    const double offset = 1e-4;
    for (StepDensity::Update update : UPDATES) {
        VRattleRun dynamics({1.0}, {});
        StepSettings settings = makeSettings(0.005, update);
        settings.terms = {{StepMonitor::AppliedForce, 1.0, 1.0, 0.0}};
        dynamics.setSettings(settings);
        dynamics.begin({Vec3(offset, 0, 0)}, {Vec3(1, 0, 0)}, {Vec3(-50 * offset, 0, 0)}, 0);
        double last = 1;
        for (int i = 0; i < 500; i++) {
            dynamics.step(INFINITY);
            vector<Vec3> forces = {dynamics.getNextPositions()[0] * -50};
            ASSERT(dynamics.finish(forces, 0));
            ASSERT_EQUAL(i > 0, dynamics.hasStarted());
            ASSERT_EQUAL(i > 0, dynamics.getReferences()[0] > 0);
            ASSERT(dynamics.getDensity() < 2.5 * last && dynamics.getDensity() > last / 2.5);
            last = dynamics.getDensity();
        }
    }
}

// A first step that fails leaves no reference behind.
void testFailedStart() {
    Tethered e;
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    dynamics.setSettings(makeSettings(0.001, StepDensity::SemiExplicit));
    dynamics.begin(e.positions, e.velocities, Tethered::forcesAt(e.positions), 0);
    dynamics.step(INFINITY);
    vector<Vec3> forces = Tethered::forcesAt(dynamics.getNextPositions());
    forces[1][0] = NAN;
    assertThrows("not a number", [&] { dynamics.finish(forces, 0); });
    dynamics.abandonStep();
    ASSERT_EQUAL(0.0, dynamics.getReferences()[0]);
    ASSERT_EQUAL(1, Tethered::takeStep(dynamics));
    ASSERT(dynamics.hasStarted());
}

// The step backwards knows where fixed particles are, also where the run has begun with another control.
void testAfterAutomaticControl() {
    Tethered e;
    StepSettings automatic = makeSettings(0.001, StepDensity::SemiExplicit);
    automatic.isAutomatic = true;
    VRattleRun direct(e.masses, e.distances, e.expressions), later(e.masses, e.distances, e.expressions);
    direct.setSettings(makeSettings(0.001, StepDensity::SemiExplicit));
    later.setSettings(automatic);
    for (VRattleRun* dynamics : {&direct, &later})
        dynamics->begin(e.positions, e.velocities, Tethered::forcesAt(e.positions), 0);
    later.setSettings(makeSettings(0.001, StepDensity::SemiExplicit));
    for (VRattleRun* dynamics : {&direct, &later})
        Tethered::takeStep(*dynamics);
    ASSERT_EQUAL(direct.getReferences()[0], later.getReferences()[0]);
}

// Settings that are given once more change nothing, though the monitors are looked at again.
void testSameSettings() {
    Tethered e;
    VRattleRun told(e.masses, e.distances, e.expressions), untold(e.masses, e.distances, e.expressions);
    for (VRattleRun* dynamics : {&told, &untold}) {
        StepSettings settings = makeSettings(0.001, StepDensity::Explicit);
        settings.terms = {{StepMonitor::ForcePNorm, 1.0, 1.0, 0.0},
                          {StepMonitor::MaxForce, 1.0, 1.0, 0.0},
                          {StepMonitor::VectorField, 1.0, 1.0, 0.0}};
        dynamics->setSettings(settings);
        dynamics->begin(e.positions, e.velocities, Tethered::forcesAt(e.positions), 0);
        for (int i = 0; i < 3; i++)
            Tethered::takeStep(*dynamics);
        if (dynamics == &told)
            dynamics->setSettings(settings);
        vector<Vec3> velocities = dynamics->getVelocities();
        for (Vec3& v : velocities)
            v *= 1.01;
        dynamics->changeVelocities(velocities);
        Tethered::takeStep(*dynamics);
    }
    ASSERT_EQUAL(untold.getDensity(), told.getDensity());
    for (int k = 0; k < 3; k++)
        ASSERT_EQUAL(untold.getMonitorValues()[k], told.getMonitorValues()[k]);
}

int main() {
    return runTests({
        {"the density starts without oscillation", testSmoothStart},
        {"nothing pulls at the start", testCalmStart},
        {"a start at a minimum of the energy", testStartAtMinimum},
        {"a first step that fails", testFailedStart},
        {"a start after automatic control", testAfterAutomaticControl},
        {"settings given once more", testSameSettings},
    });
}
