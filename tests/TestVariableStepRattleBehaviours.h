// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The behaviours that OpenMM's own tests check of VerletIntegrator and VariableVerletIntegrator, checked of
// VariableStepRattleIntegrator. OpenMM allows the energy an error of 1e-2 (5e-2 for the single bond with variable steps);
// here it is 1e-4, a hundredth of that, or less, unless a test says why not. Each platform's tests/ includes this file.

#include "BehaviourSystems.h"
#include "TestSupport.h"
#include "openmm/AndersenThermostat.h"
#include "openmm/Context.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/NonbondedForce.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include <algorithm>
#include <cmath>
#include <functional>
#include <random>
#include <string>

namespace OpenMMVRattle {

using namespace OpenMM;
using std::vector;

typedef VariableStepRattleIntegrator Integrator_;

/** The platform under test; set by the platform's own file. */
Platform& getTestPlatform();

// CPU needs about a millisecond for any step, however small the system.
inline bool isSlowPerStep() {
    return getTestPlatform().getName() == "CPU";
}

const vector<Integrator_::UpdateMethod> UPDATES = {Integrator_::SemiExplicit, Integrator_::Explicit,
                                                   Integrator_::Bounded};

inline void useMonitor(VariableStepRattleIntegrator& integrator, Integrator_::MonitorKind kind) {
    integrator.clearMonitors();
    integrator.addMonitor(kind);
}

inline double totalEnergy(Context& context) {
    State state = context.getState(State::Energy);
    return state.getKineticEnergy() + state.getPotentialEnergy();
}

// The largest relative error of a constrained distance, and the largest relative speed along one in nm/ps.
inline void measureConstraints(Context& context, double& distanceError, double& speed) {
    State state = context.getState(State::Positions | State::Velocities);
    const vector<Vec3>& q = state.getPositions();
    const vector<Vec3>& v = state.getVelocities();
    distanceError = speed = 0;
    for (int k = 0; k < context.getSystem().getNumConstraints(); k++) {
        int i, j;
        double length;
        context.getSystem().getConstraintParameters(k, i, j, length);
        Vec3 r = q[i] - q[j];
        const double distance = std::sqrt(r.dot(r));
        distanceError = std::max(distanceError, std::fabs(distance / length - 1));
        speed = std::max(speed, std::fabs(r.dot(v[i] - v[j])) / distance);
    }
}

// Steps, and after each checks that the constraints hold; returns the largest error of the energy.
inline double runAndCheck(Context& context, VariableStepRattleIntegrator& integrator, int numSteps) {
    integrator.step(1);
    const double start = totalEnergy(context);
    double worst = 0;
    for (int i = 0; i < numSteps; i++) {
        double distanceError, speed;
        measureConstraints(context, distanceError, speed);
        // OpenMM's tests allow 1e-4 and 2e-5, and do not look at the velocities.
        ASSERT(distanceError <= integrator.getConstraintTolerance() + 1e-14);
        ASSERT(speed < 1e-9); // solved directly, so to rounding of velocities of up to 1e2
        worst = std::max(worst, std::fabs(totalEnergy(context) - start));
        integrator.step(1);
    }
    return worst;
}

// Two particles on a spring: known in closed form.
inline void testSingleBond(Integrator_::UpdateMethod update) {
    System system;
    system.addParticle(2.0);
    system.addParticle(2.0);
    HarmonicBondForce* force = new HarmonicBondForce();
    force->addBond(0, 1, 1.5, 1.0);
    system.addForce(force);
    VariableStepRattleIntegrator integrator(0.01);
    integrator.setUpdateMethod(update);
    // The force vanishes twice in a period of 2 pi, the vector field never.
    useMonitor(integrator, Integrator_::VectorField);
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(-1, 0, 0), Vec3(1, 0, 0)});
    const double start = totalEnergy(context);
    const int numSteps = 1000;
    for (int i = 0; i < numSteps; i++) {
        State state = context.getState(State::Positions | State::Velocities | State::Energy);
        const double time = state.getTime(), distance = 1.5 + 0.5 * std::cos(time), speed = -0.5 * std::sin(time);
        // OpenMM allows 2e-2. The phase error of steps h is h^2/24 a radian: 1e-4 after 10 radians with h of up to 0.02.
        for (int k = 0; k < 2; k++) {
            const double sign = k == 0 ? -0.5 : 0.5;
            ASSERT_EQUAL_VEC(Vec3(sign * distance, 0, 0), state.getPositions()[k], 2e-4);
            ASSERT_EQUAL_VEC(Vec3(sign * speed, 0, 0), state.getVelocities()[k], 2e-4);
        }
        ASSERT_EQUAL_TOL(start, state.getKineticEnergy() + state.getPotentialEnergy(), 1e-4);
        integrator.step(1);
    }
    ASSERT(context.getTime() > 5.0);
}

// Eight particles with Lennard-Jones and charges, a chain of four and two pairs.
inline void makePairsAndChain(System& system, vector<Vec3>& positions, vector<Vec3>& velocities) {
    std::mt19937 random(1);
    NonbondedForce* force = new NonbondedForce();
    for (int i = 0; i < 8; i++) {
        system.addParticle(i % 2 == 0 ? 5.0 : 10.0);
        force->addParticle(i % 2 == 0 ? 0.2 : -0.2, 0.5, 5.0);
        positions.push_back(Vec3(i / 2, (i + 1) / 2, 0));
        velocities.push_back(randomVec(random));
    }
    for (int i : {0, 1, 2, 4, 6})
        system.addConstraint(i, i + 1, 1.0);
    system.addForce(force);
}

inline void testConstraints(Integrator_::UpdateMethod update) {
    System system;
    vector<Vec3> positions, velocities;
    makePairsAndChain(system, positions, velocities);
    VariableStepRattleIntegrator integrator(0.001);
    integrator.setUpdateMethod(update);
    useMonitor(integrator, Integrator_::ConstraintAndAppliedForce);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocities(velocities);
    const double worst = runAndCheck(context, integrator, isSlowPerStep() ? 300 : 1000);
    ASSERT(worst < 1e-4 * std::fabs(totalEnergy(context)));
    // stepTo, over a longer time.
    const double end = context.getTime() + 0.5;
    integrator.stepTo(end);
    ASSERT_EQUAL(end, context.getTime());
}

// A particle with four rigid neighbours, one of which has two more: more constraints than any special case knows.
inline void testConstrainedClusters(Integrator_::UpdateMethod update) {
    System system;
    std::mt19937 random(2);
    NonbondedForce* force = new NonbondedForce();
    vector<Vec3> velocities;
    for (int i = 0; i < 7; i++) {
        system.addParticle(i > 1 ? 1.0 : 10.0);
        force->addParticle(i % 2 == 0 ? 0.2 : -0.2, 0.5, 5.0);
        velocities.push_back(randomVec(random));
    }
    for (int i = 1; i <= 4; i++)
        system.addConstraint(0, i, 1.0);
    for (int i : {5, 6})
        system.addConstraint(1, i, 1.0);
    const double diagonal = std::sqrt(2.0);
    system.addConstraint(2, 3, diagonal);
    system.addConstraint(2, 4, diagonal);
    system.addConstraint(3, 4, diagonal);
    system.addConstraint(5, 6, diagonal);
    system.addForce(force);
    // With the nominal step of 1 fs of OpenMM's test the error is 1.4e-4.
    VariableStepRattleIntegrator integrator(0.0007);
    integrator.setUpdateMethod(update);
    useMonitor(integrator, Integrator_::ConstraintAndAppliedForce);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(
        {Vec3(0, 0, 0), Vec3(1, 0, 0), Vec3(-1, 0, 0), Vec3(0, 1, 0), Vec3(0, 0, 1), Vec3(2, 0, 0), Vec3(1, 1, 0)});
    context.setVelocities(velocities);
    const double worst = runAndCheck(context, integrator, isSlowPerStep() ? 300 : 1000);
    ASSERT(worst < 1e-4 * std::fabs(totalEnergy(context)));
    ASSERT(context.getTime() > 0.1);
}

// Velocities that do not satisfy the constraints are projected by the first step, and by applyVelocityConstraints before
// it, onto the same ones.
inline void testVelocityConstraints(Integrator_::UpdateMethod update) {
    System system;
    vector<Vec3> positions, velocities;
    makePairsAndChain(system, positions, velocities);
    VariableStepRattleIntegrator projecting(0.001), projected(0.001);
    vector<Vec3> ends[2];
    int run = 0;
    for (VariableStepRattleIntegrator* integrator : {&projecting, &projected}) {
        integrator->setUpdateMethod(update);
        useMonitor(*integrator, Integrator_::ConstraintAndAppliedForce);
        Context context(system, *integrator, getTestPlatform());
        context.setPositions(positions);
        context.setVelocities(velocities);
        double distanceError, speed;
        measureConstraints(context, distanceError, speed);
        ASSERT(speed > 0.1);
        if (run == 1) {
            context.applyVelocityConstraints(1e-10);
            measureConstraints(context, distanceError, speed);
            ASSERT(speed < 1e-8);
        }
        for (int i = 0; i < 20; i++) {
            integrator->step(1);
            measureConstraints(context, distanceError, speed);
            ASSERT(speed < 1e-12);
        }
        ends[run++] = context.getState(State::Positions).getPositions();
    }
    // To the tolerance of OpenMM's projection, along 0.02 ps. Elsewhere than on Reference nonbonded forces are of single precision
    // and change, by as much as 1e-5, where positions do by rounding: 2e-8 nm at 10 nm/ps^2, and the bar well above.
    for (size_t i = 0; i < positions.size(); i++)
        ASSERT_EQUAL_VEC(ends[0][i], ends[1][i], getTestPlatform().getName() == "Reference" ? 1e-9 : 1e-6);
}

inline void testConstrainedMasslessParticles() {
    System system;
    system.addParticle(0.0);
    system.addParticle(1.0);
    system.addConstraint(0, 1, 1.5);
    VariableStepRattleIntegrator refused(0.01), integrator(0.01);
    assertThrows("massless", [&] { Context context(system, refused, getTestPlatform()); });
    // Both massless is no constraint at all.
    system.setParticleMass(1, 0.0);
    integrator.clearMonitors();
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(-1, 0, 0), Vec3(1, 0, 0)});
    context.setVelocitiesToTemperature(300.0, 5);
    integrator.step(1);
    State state = context.getState(State::Positions | State::Velocities);
    for (int i = 0; i < 2; i++) {
        ASSERT_EQUAL_VEC(Vec3(0, 0, 0), state.getVelocities()[i], 0.0);
        ASSERT_EQUAL_VEC(Vec3(2 * i - 1, 0, 0), state.getPositions()[i], 0.0);
    }
}

// A chain of random directions with every distance constrained and no force, at 300 K: long chains couple all links.
inline void testConstrainedChain(int numParticles, int numSteps, Integrator_::UpdateMethod update) {
    System system;
    std::mt19937 random(3);
    vector<Vec3> positions(numParticles);
    for (int i = 0; i < numParticles; i++) {
        system.addParticle(1.0);
        if (i > 0) {
            system.addConstraint(i - 1, i, 1.0);
            Vec3 direction = randomVec(random);
            positions[i] = positions[i - 1] + direction / std::sqrt(direction.dot(direction));
        }
    }
    VariableStepRattleIntegrator integrator(0.001);
    integrator.setUpdateMethod(update);
    useMonitor(integrator, Integrator_::ConstraintForce);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocitiesToTemperature(300.0, 7);
    const double worst = runAndCheck(context, integrator, numSteps);
    ASSERT(worst < 1e-5 * totalEnergy(context)); // a thousandth of what OpenMM's test allows
    ASSERT(totalEnergy(context) > 0.5 * (2 * numParticles + 1) * BOLTZMANN * 300 * 0.3);
}

// 512 atoms of argon: energy over 1 ps, the mean step, and a maximum step size set in the course of the run.
inline void testArgonBox(Integrator_::UpdateMethod update) {
    const int gridSize = isSlowPerStep() ? 8 : 6;
    const double temperature = 120.0, epsilon = BOLTZMANN * temperature, sigma = 0.34, density = 0.8;
    const double cell = sigma / std::cbrt(density), box = gridSize * cell;
    System system;
    system.setDefaultPeriodicBoxVectors(Vec3(box, 0, 0), Vec3(0, box, 0), Vec3(0, 0, box));
    NonbondedForce* force = new NonbondedForce();
    force->setNonbondedMethod(NonbondedForce::CutoffPeriodic);
    force->setCutoffDistance(2.4 * sigma);
    // OpenMM's test has a bare cutoff, at which atoms cross jumps of the energy of 1e-3: smoothly here, so that it is
    // the integrator that is tested.
    force->setUseSwitchingFunction(true);
    force->setSwitchingDistance(1.9 * sigma);
    std::mt19937 random(4);
    vector<Vec3> positions;
    for (int i = 0; i < gridSize * gridSize * gridSize; i++) {
        system.addParticle(40.0);
        force->addParticle(0, sigma, epsilon);
        Vec3 site(i / (gridSize * gridSize), i / gridSize % gridSize, i % gridSize);
        positions.push_back((site + Vec3(0.5, 0.5, 0.5) + randomVec(random) * 0.1) * cell);
    }
    system.addForce(force);
    VariableStepRattleIntegrator integrator(0.002);
    integrator.setUpdateMethod(update);
    // Argon has no constraints: a monitor of the forces.
    useMonitor(integrator, Integrator_::AppliedForce);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocitiesToTemperature(temperature, 8);
    integrator.calibrate(20);
    integrator.stepTo(0.2);
    const double start = totalEnergy(context);
    const double kinetic = 1.5 * system.getNumParticles() * BOLTZMANN * temperature;
    for (int i = 1; i <= 10; i++) {
        integrator.stepTo(0.2 + 0.04 * i);
        ASSERT_EQUAL(0.2 + 0.04 * i, context.getTime());
        // Relative to the kinetic energy; the total one is several times larger.
        ASSERT(std::fabs(totalEnergy(context) - start) < 1e-4 * kinetic);
    }
    double mean = 0, largest = 0;
    for (int i = 0; i < 50; i++) {
        integrator.step(1);
        mean += integrator.getStepSize() / 50;
        largest = std::max(largest, integrator.getStepSize());
    }
    ASSERT(largest < 2 * mean);
    // A limit of half the step that it takes. (The nominal step must lie below the limit, so it goes down first.)
    const double maximum = 0.5 * mean;
    integrator.setNominalStepSize(0.8 * maximum);
    integrator.setMaximumStepSize(maximum);
    for (int i = 0; i < 50; i++) {
        integrator.step(1);
        // The sum updates oscillate a little about the limit, the bounded one never passes it.
        ASSERT(integrator.getStepSize() <= maximum * (update == Integrator_::Bounded ? 1.0 : 1.001));
        ASSERT(integrator.getStepSize() > 0.2 * maximum);
    }
}

inline void testInitialTemperature() {
    const int numParticles = 50000;
    const double temperature = 300.0;
    System system;
    const vector<Vec3> positions = addFreeParticles(system, numParticles);
    VariableStepRattleIntegrator integrator(0.001);
    integrator.clearMonitors();
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocitiesToTemperature(temperature, 5);
    const double kinetic = kineticEnergyOf(context);
    // 150,000 freedoms: standard error of 0.4 %, as in OpenMM's test.
    ASSERT_USUALLY_EQUAL_TOL(temperature, 2 * kinetic / (3 * numParticles * BOLTZMANN), 0.01);
    ASSERT_EQUAL_TOL(kinetic, context.getState(State::Energy).getKineticEnergy(), 1e-6);
    // Velocities are on-step: nothing moves them by half a step, and without a force nothing at all.
    integrator.step(2);
    ASSERT_EQUAL_TOL(kinetic, context.getState(State::Energy).getKineticEnergy(), 1e-6);
}

inline void testForceGroups() {
    System system;
    addPulledParticle(system);
    VariableStepRattleIntegrator integrator(0.01);
    integrator.clearMonitors();
    integrator.setIntegrationForceGroups(1 << 1);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(vector<Vec3>(1));
    integrator.step(1);
    ASSERT_EQUAL_VEC(Vec3(-0.5e-4, 0, 0), context.getState(State::Positions).getPositions()[0], 1e-12);
    // The other group from here on: the velocity along x stays.
    integrator.setIntegrationForceGroups(1 << 2);
    integrator.step(1);
    ASSERT_EQUAL_VEC(Vec3(-1.5e-4, -0.5e-4, 0), context.getState(State::Positions).getPositions()[0], 1e-12);
}

// An ideal gas, as in OpenMM's tests of thermostats and barostats: no constraint, forces that are zero, a fresh integrator. Steps are
// nominal, and the thermostat and the barostat find what they need.
inline void testIdealGas(bool isAtRest) {
    const int numParticles = 64;
    const double temperature = 300, pressure = 1.5,
                 volume = 1.2 * numParticles * BOLTZMANN * temperature / (pressure * 1e5 * 6.02214076e23 * 1e-30);
    const double box = std::cbrt(volume);
    System system;
    system.setDefaultPeriodicBoxVectors(Vec3(box, 0, 0), Vec3(0, box, 0), Vec3(0, 0, box));
    std::mt19937 random(9);
    vector<Vec3> positions;
    NonbondedForce* periodic =
        new NonbondedForce(); // a barostat wants a Force that is periodic, if it does nothing else
    periodic->setNonbondedMethod(NonbondedForce::CutoffPeriodic);
    for (int i = 0; i < numParticles; i++) {
        system.addParticle(20.0);
        periodic->addParticle(0.0, 1.0, 0.0);
        positions.push_back((randomVec(random) + Vec3(0.5, 0.5, 0.5)) * box);
    }
    system.addForce(periodic);
    AndersenThermostat* thermostat = new AndersenThermostat(temperature, 10.0);
    thermostat->setRandomNumberSeed(3);
    system.addForce(thermostat);
    MonteCarloBarostat* barostat = new MonteCarloBarostat(pressure, temperature, 5);
    barostat->setRandomNumberSeed(4);
    system.addForce(barostat);
    VariableStepRattleIntegrator integrator(0.01);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    if (!isAtRest)
        context.setVelocitiesToTemperature(temperature, 6);
    const int numSteps = isSlowPerStep() ? 400 : 4000;
    double kinetic = 0, meanVolume = 0;
    for (int i = 0; i < numSteps; i++) {
        integrator.step(1);
        ASSERT_EQUAL(0.01, integrator.getStepSize());
        const State state = context.getState(State::Energy);
        kinetic += state.getKineticEnergy() / numSteps;
        meanVolume += state.getPeriodicBoxVolume() / numSteps;
    }
    ASSERT_EQUAL_TOL(0.01 * numSteps, context.getTime(), 1e-10);
    ASSERT_EQUAL(0.0, integrator.getReferenceMonitorValue());
    if (isSlowPerStep())
        return;
    // <K> = 3/2 N k T, and <V> = (N + 1) k T/p; with these seeds within 5 and 10 %.
    ASSERT_EQUAL_TOL(1.5 * numParticles * BOLTZMANN * temperature, kinetic, 0.05);
    ASSERT_EQUAL_TOL(volume / 1.2 * (numParticles + 1) / numParticles, meanVolume, 0.1);
}

// A Context that computes energies alone needs no step size; no step is taken with it.
inline void testEnergiesAlone() {
    System system;
    for (int i = 0; i < 2; i++)
        system.addParticle(1.0);
    HarmonicBondForce* bond = new HarmonicBondForce();
    bond->addBond(0, 1, 1.5, 2.0);
    system.addForce(bond);
    VariableStepRattleIntegrator integrator(0);
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(), Vec3(2.5, 0, 0)});
    context.setVelocities({Vec3(0, 3, 0), Vec3()});
    const State state = context.getState(State::Energy | State::Forces);
    ASSERT_EQUAL_TOL(1.0, state.getPotentialEnergy(), 1e-6);
    ASSERT_EQUAL_TOL(4.5, state.getKineticEnergy(), 1e-12);
    ASSERT_EQUAL_VEC(Vec3(2, 0, 0), state.getForces()[0], 1e-6);
    context.reinitialize(true);
    for (int i = 0; i < 2; i++)
        assertThrows("the step size is 0", [&] { integrator.step(1); });
    ASSERT_EQUAL(0.0, context.getTime());
    integrator.setStepSize(0.001);
    integrator.step(10);
    ASSERT(context.getTime() > 0);
}

inline TestList getBehaviourTests() {
    TestList tests;
    const char* const names[] = {"SemiExplicit", "Explicit", "Bounded"};
    for (auto update : UPDATES) {
        const std::string suffix = std::string(", ") + names[update];
        tests.push_back({"single bond" + suffix, [=] { testSingleBond(update); }});
        tests.push_back({"constraints" + suffix, [=] { testConstraints(update); }});
        tests.push_back({"constrained clusters" + suffix, [=] { testConstrainedClusters(update); }});
        tests.push_back({"velocity constraints" + suffix, [=] { testVelocityConstraints(update); }});
        tests.push_back({"chain of 10" + suffix, [=] { testConstrainedChain(10, 1000, update); }});
        tests.push_back({"chain of 1500" + suffix, [=] { testConstrainedChain(1500, 300, update); }});
        tests.push_back({"argon box" + suffix, [=] { testArgonBox(update); }});
    }
    tests.push_back({"constrained massless particles", testConstrainedMasslessParticles});
    tests.push_back({"initial temperature", testInitialTemperature});
    tests.push_back({"ideal gas", [] { testIdealGas(false); }});
    tests.push_back({"ideal gas at rest", [] { testIdealGas(true); }});
    tests.push_back({"energies alone", testEnergiesAlone});
    tests.push_back({"force groups", testForceGroups});
    return tests;
}

} // namespace OpenMMVRattle
