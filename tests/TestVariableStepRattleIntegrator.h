// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What VariableStepRattleIntegrator does in a Context. Each platform's tests/ includes this file and its own setup.

#include "TestSupport.h"
#include "openmm/AndersenThermostat.h"
#include "openmm/CMMotionRemover.h"
#include "openmm/Context.h"
#include "openmm/CustomBondForce.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/HarmonicAngleForce.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/NonbondedForce.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmm/VerletIntegrator.h"
#include "openmm/VirtualSite.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <sstream>

namespace OpenMMVRattle {

using namespace OpenMM;
using std::vector;

typedef VariableStepRattleIntegrator Integrator_;

/** The platform under test; set by the platform's own file. */
Platform& getTestPlatform();

/** Whether that is a GPU. */
inline bool isOnGpu() {
    const std::string name = getTestPlatform().getName();
    return name != "Reference" && name != "CPU";
}

/** What two runs that are to be the same may differ by: on GPUs rounding, since the host takes over where a run is cut in two. */
inline double sameRunTolerance() {
    return isOnGpu() ? 1e-7 : 0.0;
}

struct TestSystem {
    System system;
    vector<Vec3> positions, velocities;
};

// A double pendulum in gravity 1 nm/ps^2: pivot, light inner bob, heavy outer bob.
inline void makePendulum(TestSystem& t) {
    t.system.addParticle(1e15);
    t.system.addParticle(1);
    t.system.addParticle(1000);
    t.system.addConstraint(0, 1, 1);
    t.system.addConstraint(1, 2, 1);
    CustomExternalForce* gravity = new CustomExternalForce("w*y");
    gravity->addPerParticleParameter("w");
    gravity->addParticle(1, {1});
    gravity->addParticle(2, {1000});
    t.system.addForce(gravity);
    const double a = 2.2, b = 0.5;
    t.positions = {Vec3(), Vec3(sin(a), -cos(a), 0), Vec3(sin(a) + sin(b), -cos(a) - cos(b), 0)};
    t.velocities.resize(3);
}

// A zigzag chain with bond angles and a repulsion between its distant members.
inline void makeChain(TestSystem& t, int length, double speed = 1.0) {
    std::mt19937 random(5);
    std::normal_distribution<double> normal;
    HarmonicAngleForce* angles = new HarmonicAngleForce();
    CustomBondForce* repulsion = new CustomBondForce("0.5*(0.25/r)^6");
    for (int i = 0; i < length; i++) {
        t.system.addParticle(10 + 5 * (i % 4));
        t.positions.push_back(Vec3(0.12 * i, 0.05 * (i % 2), 0.02 * ((i / 2) % 2)));
        t.velocities.push_back(Vec3(normal(random), normal(random), normal(random)) * speed);
        if (i > 0) {
            Vec3 r = t.positions[i] - t.positions[i - 1];
            t.system.addConstraint(i - 1, i, sqrt(r.dot(r)));
        }
        if (i > 1)
            angles->addAngle(i - 2, i - 1, i, 2.0, 100.0);
        for (int j = std::max(0, i - 6); j < i - 2; j++)
            repulsion->addBond(j, i);
    }
    t.system.addForce(angles);
    t.system.addForce(repulsion);
}

inline double totalEnergy(Context& context) {
    State state = context.getState(State::Energy);
    return state.getKineticEnergy() + state.getPotentialEnergy();
}

inline double largestConstraintError(Context& context) {
    vector<Vec3> q = context.getState(State::Positions).getPositions();
    double largest = 0;
    for (int k = 0; k < context.getSystem().getNumConstraints(); k++) {
        int i, j;
        double length;
        context.getSystem().getConstraintParameters(k, i, j, length);
        Vec3 r = q[i] - q[j];
        largest = std::max(largest, std::fabs(sqrt(r.dot(r)) / length - 1));
    }
    return largest;
}

// One context of a test system on the platform under test. The integrator projects the velocities itself, but the energies
// before and after that cannot be compared.
struct Run {
    Run(const TestSystem& t, VariableStepRattleIntegrator& integrator, bool projectVelocities = true) :
            integrator(integrator), context(t.system, integrator, getTestPlatform()) {
        context.setPositions(t.positions);
        context.setVelocities(t.velocities);
        if (projectVelocities)
            context.applyVelocityConstraints(1e-6);
    }
    vector<Vec3> positions() {
        return context.getState(State::Positions).getPositions();
    }
    vector<Vec3> velocities() {
        return context.getState(State::Velocities).getVelocities();
    }
    VariableStepRattleIntegrator& integrator;
    Context context;
};

inline void testSettings() {
    VariableStepRattleIntegrator integrator(0.002);
    ASSERT_EQUAL(0.002, integrator.getStepSize());
    ASSERT_EQUAL_TOL(0.002 / 50, integrator.getMinimumStepSize(), 1e-14);
    ASSERT_EQUAL_TOL(0.004, integrator.getMaximumStepSize(), 1e-14);
    integrator.setStepSize(0.001); // the defaults follow
    ASSERT_EQUAL_TOL(0.002, integrator.getMaximumStepSize(), 1e-14);
    ASSERT_EQUAL(1e-8, integrator.getConstraintTolerance());
    ASSERT_EQUAL(1, integrator.getNumMonitors());
    ASSERT_EQUAL(0.0, integrator.getReferenceMonitorValue());
    const double nan = std::numeric_limits<double>::quiet_NaN(), inf = std::numeric_limits<double>::infinity();
    for (double bad : {-0.001, nan, inf}) {
        assertThrows("step size", [&] { VariableStepRattleIntegrator bad_(bad); });
        assertThrows("step size", [&] { integrator.setNominalStepSize(bad); });
        assertThrows("minimum step size", [&] { integrator.setMinimumStepSize(bad); });
        assertThrows("maximum step size", [&] { integrator.setMaximumStepSize(bad); });
    }
    for (double bad : {0.0, -0.001, nan, inf}) {
        assertThrows("tolerance", [&] { integrator.setConstraintTolerance(bad); });
        assertThrows("weight", [&] { integrator.addMonitor(Integrator_::MaxForce, bad); });
        assertThrows("power", [&] { integrator.addMonitor(Integrator_::MaxForce, 1.0, bad); });
    }
    assertThrows("no monitor with index 1", [&] { integrator.getReferenceMonitorValue(1); });
    assertThrows("reference", [&] { integrator.setReferenceMonitorValue(-1); });
    assertThrows("order", [&] { integrator.setNormOrder(0.5); });
    assertThrows("force group", [&] { integrator.setMonitorForceGroup(32); });
    assertThrows("not bound", [&] { integrator.step(1); });
}

inline void testForceEvaluationsAndTime() {
    TestSystem t;
    makeChain(t, 8);
    VariableStepRattleIntegrator integrator(0.002);
    Run run(t, integrator);
    double time = 0, smallest = 1, largest = 0;
    for (int i = 0; i < 300; i++) {
        integrator.step(1);
        ASSERT_EQUAL_TOL(0.002 / integrator.getStepDensity(), integrator.getStepSize(), 1e-14);
        time += integrator.getStepSize();
        smallest = std::min(smallest, integrator.getStepSize());
        largest = std::max(largest, integrator.getStepSize());
    }
    ASSERT_EQUAL(301, integrator.getNumForceEvaluations());
    ASSERT_EQUAL_TOL(time, run.context.getTime(), 1e-12);
    ASSERT_EQUAL(300, run.context.getStepCount());
    ASSERT(largest > 1.3 * smallest);
    ASSERT(integrator.getNumSolverIterations() >= 300); // at least one update a step
    ASSERT_EQUAL(0, integrator.getNumRescues());
    ASSERT(integrator.getReferenceMonitorValue() > 0);
}

inline void testEnergyAndConstraints() {
    for (double tolerance : {1e-5, 1e-8, 1e-12})
        for (auto update : {Integrator_::SemiExplicit, Integrator_::Explicit, Integrator_::Bounded}) {
            TestSystem t;
            makeChain(t, 20);
            VariableStepRattleIntegrator integrator(0.002);
            integrator.setUpdateMethod(update);
            integrator.setConstraintTolerance(tolerance);
            Run run(t, integrator);
            integrator.step(1);
            double energy = totalEnergy(run.context);
            for (int i = 0; i < 500; i++) {
                integrator.step(1);
                ASSERT(largestConstraintError(run.context) <= tolerance);
                // The velocities belong to the positions, so there is no half-step error of first order.
                ASSERT(std::fabs(totalEnergy(run.context) - energy) < 2e-3 * std::fabs(energy));
            }
        }
}

inline void testReversibility() {
    for (auto update : {Integrator_::SemiExplicit, Integrator_::Explicit, Integrator_::Bounded}) {
        TestSystem t;
        makePendulum(t);
        VariableStepRattleIntegrator integrator(0.01);
        integrator.setUpdateMethod(update);
        integrator.setMinimumStepSize(1e-6);
        integrator.setMaximumStepSize(0.02);
        integrator.setConstraintTolerance(1e-12);
        Run run(t, integrator);
        integrator.step(1000);
        vector<Vec3> there = run.velocities();
        long long evaluations = integrator.getNumForceEvaluations();
        integrator.reverse();
        ASSERT_EQUAL(evaluations, integrator.getNumForceEvaluations());
        vector<Vec3> turned = run.velocities();
        for (size_t i = 0; i < there.size(); i++)
            ASSERT_EQUAL_VEC(-there[i], turned[i], 0.0);
        integrator.step(1000);
        ASSERT(largestDifference(run.positions(), t.positions) < 1e-8);
        ASSERT_EQUAL(0, integrator.getNumRescues());
    }
}

// U2 against plain RATTLE on the double pendulum, over the first whips (the full run is a test in Python).
inline void testPendulumEnergy() {
    TestSystem t;
    makePendulum(t);
    double errors[2];
    int numSteps = 0;
    for (int plain = 0; plain < 2; plain++) {
        VariableStepRattleIntegrator integrator(plain ? 4.0 / numSteps : 0.01);
        if (plain)
            integrator.clearMonitors();
        else {
            integrator.setMinimumStepSize(1e-6);
            integrator.setMaximumStepSize(0.02);
        }
        Run run(t, integrator);
        double energy = totalEnergy(run.context);
        errors[plain] = 0;
        for (int i = 0; plain ? i < numSteps : run.context.getTime() < 4.0; i++) {
            integrator.step(1);
            errors[plain] = std::max(errors[plain], std::fabs(totalEnergy(run.context) - energy));
            numSteps += !plain;
        }
    }
    ASSERT(errors[1] > 1000 * errors[0]);
}

// The sequence of densities starts without an oscillation about u; docs/method.md, section 7.
inline void testStartWithoutOscillation() {
    double amplitude[2];
    for (int refine = 0; refine < 2; refine++) {
        TestSystem t;
        makeChain(t, 8);
        const double h = refine ? 0.00025 : 0.0005;
        VariableStepRattleIntegrator integrator(h);
        integrator.setMinimumStepSize(0);
        integrator.setMaximumStepSize(0);
        integrator.setConstraintTolerance(1e-12);
        Run run(t, integrator);
        integrator.step(1);
        double reference = integrator.getReferenceMonitorValue();
        double before = integrator.getMonitorValue() / reference, density[3] = {0, 0, integrator.getStepDensity()};
        (void) before;
        amplitude[refine] = 0;
        for (int i = 0; i < 40; i++) {
            integrator.step(1);
            density[0] = density[1];
            density[1] = density[2];
            density[2] = integrator.getStepDensity();
            // The second difference sees an oscillation of amplitude A as 4 A, and a smooth sequence as O(h^2).
            if (i > 0)
                amplitude[refine] =
                    std::max(amplitude[refine], std::fabs(density[0] - 2 * density[1] + density[2]) / (4 * density[1]));
        }
    }
    ASSERT(amplitude[0] < 1e-2);
    ASSERT(amplitude[0] / amplitude[1] > 3); // O(h^2): 4
}

inline void testGivenReferenceValue() {
    // A start with a given reference value takes its first step again once its density is known: one evaluation more.
    TestSystem t;
    makeChain(t, 8);
    VariableStepRattleIntegrator first(0.001), second(0.001);
    Run a(t, first);
    first.step(1);
    second.setReferenceMonitorValue(first.getReferenceMonitorValue());
    Run b(t, second);
    second.step(1);
    ASSERT_EQUAL(3, second.getNumForceEvaluations());
    // The same start, but that the one takes its values over steps of h, the other of h/u.
    ASSERT_EQUAL_TOL(first.getStepDensity(), second.getStepDensity(), 1e-3);
    first.step(200);
    second.step(200);
    ASSERT_EQUAL_TOL(a.context.getTime(), b.context.getTime(), 1e-3);
}

inline void testPlainRattle() {
    // With no monitor every step is the nominal one, and the trajectory that of velocity Verlet.
    System system;
    system.addParticle(2);
    system.addParticle(3);
    HarmonicBondForce* bond = new HarmonicBondForce();
    bond->addBond(0, 1, 1.5, 1);
    system.addForce(bond);
    VariableStepRattleIntegrator integrator(0.01);
    integrator.clearMonitors();
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(-1, 0, 0), Vec3(1, 0, 0)});
    const double reducedMass = 2.0 * 3.0 / 5.0, frequency = sqrt(1 / reducedMass);
    for (int i = 0; i < 1000; i++) {
        integrator.step(1);
        ASSERT_EQUAL(0.01, integrator.getStepSize());
        State state = context.getState(State::Positions | State::Velocities);
        double t = state.getTime();
        Vec3 r = state.getPositions()[1] - state.getPositions()[0];
        Vec3 v = state.getVelocities()[1] - state.getVelocities()[0];
        ASSERT_EQUAL_TOL(1.5 + 0.5 * cos(frequency * t), r[0], 1e-4);
        ASSERT_EQUAL_TOL(-0.5 * frequency * sin(frequency * t), v[0], 1e-4);
    }
    ASSERT_EQUAL_TOL(10.0, context.getTime(), 1e-10);
    assertThrows("needs a monitor", [&] { integrator.calibrate(10); });
}

inline void testStepTo() {
    TestSystem t;
    makeChain(t, 8);
    VariableStepRattleIntegrator integrator(0.002), other(0.002);
    Run run(t, integrator), reference(t, other);
    double energy = totalEnergy(run.context);
    for (double time : {0.0005, 0.01, 0.0101, 0.25, 0.5}) {
        integrator.stepTo(time);
        ASSERT_EQUAL(time, run.context.getTime());
        long long count = run.context.getStepCount();
        integrator.stepTo(time);
        integrator.stepTo(time - 0.1);
        ASSERT_EQUAL(count, run.context.getStepCount());
    }
    ASSERT(std::fabs(totalEnergy(run.context) - energy) < 2e-3 * std::fabs(energy));
    // The interruptions do not move the later steps.
    other.stepTo(0.5);
    ASSERT_EQUAL_TOL(other.getStepDensity(), integrator.getStepDensity(), 1e-2);
    ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-3);
    assertThrows("finite time", [&] { integrator.stepTo(std::numeric_limits<double>::infinity()); });
}

inline void testFailedStep() {
    TestSystem t;
    makePendulum(t);
    VariableStepRattleIntegrator integrator(0.01);
    integrator.clearMonitors();
    Run run(t, integrator);
    integrator.step(20);
    State before = run.context.getState(State::Positions | State::Velocities);
    long long count = run.context.getStepCount();
    integrator.setStepSize(5.0);
    assertThrows("failed because", [&] { integrator.step(1); });
    State after = run.context.getState(State::Positions | State::Velocities);
    ASSERT_EQUAL(0.0, largestDifference(before.getPositions(), after.getPositions()));
    ASSERT_EQUAL(0.0, largestDifference(before.getVelocities(), after.getVelocities()));
    ASSERT_EQUAL(before.getTime(), after.getTime());
    ASSERT_EQUAL(count, run.context.getStepCount());
    double energy = totalEnergy(run.context);
    integrator.setStepSize(0.001);
    integrator.step(20);
    ASSERT_EQUAL_TOL(before.getTime() + 0.02, run.context.getTime(), 1e-10);
    ASSERT_EQUAL_TOL(energy, totalEnergy(run.context), 1e-4);
}

inline void testForceThatBecomesInfinite() {
    // The force is not a number beyond x = 0.1: the step that goes there fails, and the state before it stays.
    System system;
    system.addParticle(1);
    CustomExternalForce* force = new CustomExternalForce("sqrt(0.1-x)");
    force->addParticle(0);
    system.addForce(force);
    VariableStepRattleIntegrator integrator(0.01);
    integrator.clearMonitors();
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(0, 0, 0)});
    context.setVelocities({Vec3(1, 0, 0)});
    assertThrows("not a number", [&] { integrator.step(100); });
    State state = context.getState(State::Positions | State::Velocities);
    ASSERT(state.getPositions()[0][0] < 0.1 && state.getPositions()[0][0] > 0.05);
    ASSERT(std::isfinite(state.getVelocities()[0][0]));
    ASSERT(state.getTime() > 0.04);
}

inline void testBadSystems() {
    TestSystem line;
    for (int i = 0; i < 4; i++) {
        line.system.addParticle(12);
        line.positions.push_back(Vec3(0.1 * i, 0, 0));
        line.velocities.push_back(Vec3(0, i, 0));
    }
    line.system.addConstraint(1, 2, 0.1);
    line.system.addConstraint(2, 3, 0.1);
    line.system.addConstraint(1, 3, 0.2);
    VariableStepRattleIntegrator dependent(0.001);
    Run run(line, dependent, false);
    assertThrows("particles 1, 2 and 3", [&] { dependent.step(1); });

    System free;
    free.addParticle(1);
    VariableStepRattleIntegrator noConstraints(0.001);
    noConstraints.clearMonitors();
    noConstraints.addMonitor(Integrator_::ConstraintMultipliers);
    assertThrows("has no constraints", [&] { Context context(free, noConstraints, getTestPlatform()); });

    TestSystem chain;
    makeChain(chain, 4);
    VariableStepRattleIntegrator integrator(0.001);
    Run chainRun(chain, integrator);
    chainRun.context.setPositions({Vec3(), Vec3(std::nan(""), 0, 0), Vec3(), Vec3()});
    assertThrows("position of particle 1", [&] { integrator.step(1); });
}

const Integrator_::MonitorKind ALL_MONITORS[] = {Integrator_::ConstraintMultipliers,
                                                 Integrator_::ConstraintForce,
                                                 Integrator_::AppliedForce,
                                                 Integrator_::ConstraintAndAppliedForce,
                                                 Integrator_::MultiplierPNorm,
                                                 Integrator_::ForcePNorm,
                                                 Integrator_::VectorField,
                                                 Integrator_::MaxForce,
                                                 Integrator_::ArcLength,
                                                 Integrator_::MaxParticleArcLength,
                                                 Integrator_::ForceGroupEnergy};

// A start where nothing pulls and nothing moves, with any monitor: steps have the nominal size until the monitor is more than
// rounding, and then it has a reference value.
inline void testCalmStarts() {
    for (const Integrator_::MonitorKind kind : ALL_MONITORS)
        for (const bool isGiven : {false, true})
            for (const bool isUnbounded : {false, true}) {
                TestSystem t;
                makeChain(t, 4);
                while (t.system.getNumForces() > 0)
                    t.system.removeForce(0);
                // No force before 0.01 ps, which the Context's parameter stands for.
                CustomExternalForce* field = new CustomExternalForce("on*(m*y^2 + 3*x*y)");
                field->addGlobalParameter("on", 0.0);
                field->addPerParticleParameter("m");
                for (int i = 0; i < 4; i++)
                    field->addParticle(i, {1000.0 * (i + 1)});
                t.system.addForce(field);
                if (kind == Integrator_::ForceGroupEnergy) {
                    CustomExternalForce* monitor = new CustomExternalForce("on*(1+x^2)");
                    monitor->addGlobalParameter("on", 0.0);
                    monitor->addParticle(2);
                    monitor->setForceGroup(31);
                    t.system.addForce(monitor);
                }
                t.velocities.assign(4, Vec3());
                Integrator_ integrator(0.001);
                integrator.clearMonitors();
                integrator.addMonitor(kind);
                if (isGiven)
                    integrator.setReferenceMonitorValue(10.0);
                if (isUnbounded) {
                    integrator.setMinimumStepSize(0);
                    integrator.setMaximumStepSize(0);
                }
                Run run(t, integrator);
                for (int i = 1; i <= 10; i++) {
                    integrator.step(1);
                    ASSERT_EQUAL(0.001, integrator.getStepSize());
                    ASSERT_EQUAL(1.0, integrator.getStepDensity());
                    ASSERT_EQUAL(i + 1, integrator.getNumForceEvaluations());
                    ASSERT_EQUAL(isGiven ? 10.0 : 0.0, integrator.getReferenceMonitorValue());
                }
                ASSERT(largestDifference(t.positions, run.positions()) < 1e-15);
                integrator.reverse();
                const std::string checkpoint = [&] {
                    std::stringstream stream;
                    run.context.createCheckpoint(stream);
                    return stream.str();
                }();
                std::stringstream stream(checkpoint);
                run.context.loadCheckpoint(stream);
                integrator.step(1);
                ASSERT_EQUAL(0.001, integrator.getStepSize());
                run.context.setParameter("on", 1.0);
                for (int i = 0; i < 10; i++)
                    integrator.step(1);
                if (!isGiven) {
                    ASSERT(integrator.getReferenceMonitorValue() > 0);
                    ASSERT(integrator.getStepDensity() != 1.0);
                }
            }
}

// Of several monitors those that are more than rounding have their say at once.
inline void testCalmMonitorAmongOthers() {
    TestSystem t;
    makeChain(t, 2, 0.0);
    while (t.system.getNumForces() > 0)
        t.system.removeForce(0);
    // Two particles on a rigid rod that fall side by side into a wall: nothing pulls at the rod, ever.
    const Vec3 r = t.positions[1] - t.positions[0];
    t.system.setConstraintParameters(0, 0, 1, std::fabs(r[0]));
    t.positions = {Vec3(0, 0.5, 0), Vec3(r[0], 0.5, 0)};
    t.velocities = {Vec3(0, -1, 0), Vec3(0, -1, 0)};
    CustomExternalForce* wall = new CustomExternalForce("m*(0.3/y)^6");
    wall->addPerParticleParameter("m");
    for (int i = 0; i < 2; i++)
        wall->addParticle(i, {t.system.getParticleMass(i)});
    t.system.addForce(wall);
    Integrator_ integrator(0.002);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ConstraintForce);
    integrator.addMonitor(Integrator_::AppliedForce);
    integrator.setMinimumStepSize(0);
    Run run(t, integrator);
    const double energy = totalEnergy(run.context);
    double smallest = 1;
    for (int i = 0; i < 2000 && run.context.getTime() < 1.0; i++) {
        integrator.step(1);
        smallest = std::min(smallest, integrator.getStepSize());
        ASSERT_EQUAL_TOL(energy, totalEnergy(run.context), 1e-2);
    }
    ASSERT_EQUAL(0.0, integrator.getReferenceMonitorValue(0));
    ASSERT(integrator.getReferenceMonitorValue(1) > 0);
    ASSERT(smallest < 0.0005);
    ASSERT(run.velocities()[0][1] > 0.9); // it has bounced back
}

// A fresh integrator runs on every System: without constraints its monitor is another one. One that was named is refused there.
inline void testDefaultMonitor() {
    Integrator_::MonitorKind kind;
    double weight, power;
    System free, massless, bound;
    for (System* system : {&free, &massless, &bound}) {
        system->addParticle(system == &massless ? 0.0 : 2.0);
        system->addParticle(system == &massless ? 0.0 : 2.0);
        HarmonicBondForce* bond = new HarmonicBondForce();
        bond->addBond(0, 1, 0.1, 1000);
        system->addForce(bond);
        if (system != &free)
            system->addConstraint(0, 1, 0.2);
        Integrator_ integrator(0.001);
        Context context(*system, integrator, getTestPlatform());
        context.setPositions({Vec3(), Vec3(0.2, 0, 0)});
        context.setVelocities({Vec3(0, 0.1, 0), Vec3()});
        integrator.step(20);
        integrator.getMonitor(0, kind, weight, power);
        ASSERT_EQUAL(system == &bound ? Integrator_::ConstraintMultipliers : Integrator_::ConstraintAndAppliedForce,
                     kind);
        ASSERT(system == &massless || integrator.getReferenceMonitorValue() > 0);
        // The same in a Context that has been made anew with or without the constraint.
        if (system == &bound)
            system->removeConstraint(0);
        else if (system == &free)
            system->addConstraint(0, 1, 0.2);
        if (system != &massless) {
            context.reinitialize(true);
            integrator.getMonitor(0, kind, weight, power);
            ASSERT_EQUAL(system == &free ? Integrator_::ConstraintMultipliers : Integrator_::ConstraintAndAppliedForce,
                         kind);
            ASSERT_EQUAL(0.0, integrator.getReferenceMonitorValue()); // that was of the other monitor
            integrator.step(5);
        }
    }
    // An expression is a constraint as well.
    Integrator_ withExpression(0.001);
    withExpression.addConstraint("x1-x2+0.2", {0, 1});
    System plain;
    plain.addParticle(1.0);
    plain.addParticle(1.0);
    Context context(plain, withExpression, getTestPlatform());
    withExpression.getMonitor(0, kind, weight, power);
    ASSERT_EQUAL(Integrator_::ConstraintMultipliers, kind);
    // A monitor is named by adding it, or by giving it a reference value.
    Integrator_ named(0.001), given(0.001);
    named.clearMonitors();
    named.addMonitor(Integrator_::ConstraintMultipliers);
    given.setReferenceMonitorValue(100.0);
    for (Integrator_* integrator : {&named, &given})
        assertThrows("has no constraints", [&] { Context refused(plain, *integrator, getTestPlatform()); });
}

inline void testMultipliers() {
    // Two weights hang from a heavy support: the tension 2 Lambda d of a bond is the weight below it.
    TestSystem t;
    for (double mass : {1e15, 3.0, 5.0})
        t.system.addParticle(mass);
    t.system.addConstraint(0, 1, 0.5);
    t.system.addConstraint(1, 2, 0.25);
    CustomExternalForce* gravity = new CustomExternalForce("m*9.8*z");
    gravity->addPerParticleParameter("m");
    gravity->addParticle(1, {3.0});
    gravity->addParticle(2, {5.0});
    t.system.addForce(gravity);
    t.positions = {Vec3(), Vec3(0, 0, -0.5), Vec3(0, 0, -0.75)};
    t.velocities.resize(3);
    VariableStepRattleIntegrator integrator(0.001);
    Run run(t, integrator);
    vector<double> multipliers = integrator.getMultipliers(); // before the first step
    ASSERT_EQUAL_TOL(8 * 9.8, 2 * multipliers[0] * 0.5, 1e-10);
    ASSERT_EQUAL_TOL(5 * 9.8, 2 * multipliers[1] * 0.25, 1e-10);
    ASSERT_EQUAL_TOL(sqrt(multipliers[0] * multipliers[0] + multipliers[1] * multipliers[1]),
                     integrator.getMonitorValue(), 1e-12);
    integrator.step(10);
    ASSERT_EQUAL(11, integrator.getNumForceEvaluations()); // reading was free
    ASSERT_EQUAL_TOL(8 * 9.8, 2 * integrator.getMultipliers()[0] * 0.5, 1e-8);
}

inline void testChangesOfState() {
    // After a change by the user the run is that of a new context with the same reference value.
    TestSystem t;
    makeChain(t, 8);
    VariableStepRattleIntegrator integrator(0.002);
    Run run(t, integrator);
    integrator.step(100);
    for (bool changePositions : {false, true}) {
        vector<Vec3> velocities = run.velocities(), positions = run.positions();
        if (changePositions) {
            positions = t.positions;
            run.context.setPositions(positions);
        }
        else {
            for (Vec3& v : velocities)
                v *= 1.5;
            run.context.setVelocities(velocities);
        }
        TestSystem fresh;
        makeChain(fresh, 8);
        fresh.positions = positions;
        fresh.velocities = velocities;
        VariableStepRattleIntegrator other(0.002);
        other.setReferenceMonitorValue(integrator.getReferenceMonitorValue());
        Run reference(fresh, other, false);
        integrator.step(20);
        other.step(20);
        ASSERT_EQUAL(other.getStepDensity(), integrator.getStepDensity());
        ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-12);
    }
}

inline void testForceGroups() {
    // A force group that is not integrated does not act; the energy of the monitor's group is U and does not act either.
    // (The second particle is there for PoCL 3.1, where OpenMM's kinetic energy of a single one crashes.)
    System system;
    system.addParticle(1);
    system.addParticle(1);
    CustomExternalForce* acting = new CustomExternalForce("2*x");
    acting->addParticle(0);
    system.addForce(acting);
    CustomExternalForce* left = new CustomExternalForce("100*y");
    left->addParticle(0);
    left->setForceGroup(3);
    system.addForce(left);
    CustomExternalForce* monitor = new CustomExternalForce("1+x^2");
    monitor->addParticle(0);
    monitor->setForceGroup(5);
    system.addForce(monitor);
    VariableStepRattleIntegrator integrator(0.01);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ForceGroupEnergy);
    ASSERT_EQUAL(-1 & ~(1 << 31), integrator.getIntegrationForceGroups());
    integrator.setMonitorForceGroup(5);
    ASSERT_EQUAL(-1 & ~(1 << 5), integrator.getIntegrationForceGroups());
    integrator.setIntegrationForceGroups(0xFFFFFFFF & ~(1 << 3));
    ASSERT_EQUAL(-1 & ~(1 << 3) & ~(1 << 5), integrator.getIntegrationForceGroups());
    integrator.setMinimumStepSize(0);
    integrator.setMaximumStepSize(0);
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(1, 0, 0), Vec3(5, 0, 0)});
    integrator.step(50);
    State state = context.getState(State::Positions);
    double t = state.getTime(), x = state.getPositions()[0][0];
    ASSERT_EQUAL_TOL(1 - t * t, x, 1e-6); // acceleration -2
    ASSERT_EQUAL(0.0, state.getPositions()[0][1]);
    ASSERT_EQUAL_TOL(1 + x * x, integrator.getMonitorValue(), 1e-6);
    ASSERT_EQUAL_TOL(2.0, integrator.getReferenceMonitorValue(), 1e-3);
    // The energy of the run, as reporters and the minimizer ask for it, is that of the acting forces alone.
    const double energy =
        context.getState(State::Energy, false, integrator.getIntegrationForceGroups()).getPotentialEnergy();
    ASSERT_EQUAL_TOL(2 * x, energy, 1e-6);
    // The group is there again when the monitor is not.
    integrator.clearMonitors();
    ASSERT_EQUAL(-1 & ~(1 << 3), integrator.getIntegrationForceGroups());
}

inline void testMasslessAndVirtual() {
    // A fixed particle holds two others by a spring; a virtual site rides between them.
    TestSystem t;
    for (double mass : {0.0, 12.0, 12.0, 0.0})
        t.system.addParticle(mass);
    t.system.setVirtualSite(3, new TwoParticleAverageSite(1, 2, 0.25, 0.75));
    t.system.addConstraint(1, 2, 0.2);
    HarmonicBondForce* bond = new HarmonicBondForce();
    bond->addBond(0, 1, 0.3, 500);
    bond->addBond(0, 3, 0.4, 100);
    t.system.addForce(bond);
    t.positions = {Vec3(0.1, 0.2, 0.3), Vec3(0.4, 0.2, 0.3), Vec3(0.6, 0.2, 0.3), Vec3(0.55, 0.2, 0.3)};
    t.velocities = {Vec3(), Vec3(0, 0.5, 0), Vec3(0, -0.5, 0.7), Vec3()};
    VariableStepRattleIntegrator integrator(0.002);
    Run run(t, integrator);
    double energy = totalEnergy(run.context);
    for (int i = 0; i < 200; i++) {
        integrator.step(1);
        vector<Vec3> q = run.positions();
        ASSERT_EQUAL_VEC(t.positions[0], q[0], 0.0);
        ASSERT_EQUAL_VEC(q[1] * 0.25 + q[2] * 0.75, q[3], 1e-6);
        ASSERT_EQUAL_TOL(energy, totalEnergy(run.context), 1e-3);
    }
}

inline void testForcesThatChangeTheState() {
    // Removing the motion of the centre of mass changes the velocities by rounding alone: the run stays as it was.
    TestSystem t;
    makeChain(t, 8);
    Vec3 momentum;
    double mass = 0;
    for (int i = 0; i < 8; i++) {
        momentum += t.velocities[i] * t.system.getParticleMass(i);
        mass += t.system.getParticleMass(i);
    }
    for (Vec3& v : t.velocities)
        v -= momentum * (1 / mass);
    VariableStepRattleIntegrator plain(0.002), removing(0.002);
    Run reference(t, plain);
    t.system.addForce(new CMMotionRemover());
    Run run(t, removing);
    plain.step(200);
    removing.step(200);
    ASSERT_EQUAL(201, removing.getNumForceEvaluations());
    ASSERT(largestDifference(reference.positions(), run.positions()) < 1e-6);
    ASSERT_EQUAL_TOL(plain.getStepDensity(), removing.getStepDensity(), 1e-5);

    // With no monitor the multipliers are kept up to date as well: the solver starts from them, and needs no more updates.
    VariableStepRattleIntegrator fixed(0.001), fixedRemoving(0.001);
    fixed.clearMonitors();
    fixedRemoving.clearMonitors();
    TestSystem same;
    makeChain(same, 8);
    same.velocities = t.velocities;
    Run fixedRun(same, fixed), fixedRemovingRun(t, fixedRemoving);
    fixed.step(200);
    fixedRemoving.step(200);
    ASSERT(fixedRemoving.getNumSolverIterations() <= 1.2 * fixed.getNumSolverIterations());

    // A thermostat changes them for good; the constraints hold, and no density oscillates out of bounds.
    AndersenThermostat* thermostat = new AndersenThermostat(300, 20);
    thermostat->setRandomNumberSeed(5);
    t.system.addForce(thermostat);
    VariableStepRattleIntegrator integrator(0.002);
    Run thermal(t, integrator);
    integrator.step(200);
    double kinetic = 0;
    const int samples = 3000;
    for (int i = 0; i < samples; i++) {
        integrator.step(1);
        kinetic += thermal.context.getState(State::Energy).getKineticEnergy() / samples;
        ASSERT(largestConstraintError(thermal.context) <= 1e-8);
    }
    ASSERT_EQUAL(3201, integrator.getNumForceEvaluations());
    const double expected = 0.5 * (24 - 7 - 3) * 8.31446261815324e-3 * 300;
    ASSERT_USUALLY_EQUAL_TOL(expected, kinetic, 0.2);
}

inline void testCalibrate() {
    TestSystem t;
    makeChain(t, 8);
    VariableStepRattleIntegrator integrator(0.001), untouched(0.001);
    integrator.addMonitor(Integrator_::AppliedForce);
    untouched.addMonitor(Integrator_::AppliedForce);
    Run run(t, integrator), reference(t, untouched);
    State before = run.context.getState(State::Positions | State::Velocities);
    integrator.calibrate(50);
    State after = run.context.getState(State::Positions | State::Velocities);
    ASSERT_EQUAL(0.0, largestDifference(before.getPositions(), after.getPositions()));
    ASSERT_EQUAL(0.0, largestDifference(before.getVelocities(), after.getVelocities()));
    ASSERT_EQUAL(0.0, run.context.getTime());
    ASSERT_EQUAL(0, run.context.getStepCount());
    // The mean over a run of fixed steps, found again by hand.
    VariableStepRattleIntegrator fixed(0.001);
    fixed.setMinimumStepSize(0.001 - 1e-12);
    fixed.setMaximumStepSize(0.001 + 1e-12);
    fixed.addMonitor(Integrator_::AppliedForce);
    Run byHand(t, fixed);
    double mean[2] = {0, 0};
    for (int i = 0; i < 50; i++) {
        fixed.step(1);
        for (int k = 0; k < 2; k++)
            mean[k] += fixed.getMonitorValue(k) / 50;
    }
    for (int k = 0; k < 2; k++)
        ASSERT_EQUAL_TOL(mean[k], integrator.getReferenceMonitorValue(k), 1e-5);
    integrator.step(10);
    ASSERT(run.context.getTime() > 0);
    assertThrows("at least one", [&] { integrator.calibrate(0); });
}

inline TestList getIntegratorTests() {
    return {
        {"settings and their errors", testSettings},
        {"one force evaluation a step; time and step count", testForceEvaluationsAndTime},
        {"energy and constraints", testEnergyAndConstraints},
        {"reversibility", testReversibility},
        {"energy of the double pendulum", testPendulumEnergy},
        {"a start without oscillation", testStartWithoutOscillation},
        {"a start with a given reference value", testGivenReferenceValue},
        {"plain RATTLE", testPlainRattle},
        {"stepTo", testStepTo},
        {"a failed step leaves the state", testFailedStep},
        {"an infinite force leaves the state", testForceThatBecomesInfinite},
        {"bad systems", testBadSystems},
        {"calm starts", testCalmStarts},
        {"a calm monitor among others", testCalmMonitorAmongOthers},
        {"default monitor", testDefaultMonitor},
        {"multipliers", testMultipliers},
        {"changes by the user", testChangesOfState},
        {"force groups", testForceGroups},
        {"massless particles and virtual sites", testMasslessAndVirtual},
        {"forces that change the state", testForcesThatChangeTheState},
        {"calibrate", testCalibrate},
    };
}

} // namespace OpenMMVRattle
