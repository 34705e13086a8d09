// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The behaviours that OpenMM's own tests check of LangevinMiddleIntegrator, case by case those of tests/TestLangevinMiddleIntegrator.h
// of OpenMM 8.6, checked of VariableStepRattleLangevinIntegrator. Random numbers depend on the seed and the step alone, so what is a
// sample here is the same one on all platforms. Each platform's tests/ includes this file.

#include "BehaviourSystems.h"
#include "TestSupport.h"
#include "openmm/Context.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/NonbondedForce.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include <algorithm>
#include <cmath>
#include <random>

namespace OpenMMVRattle {

using namespace OpenMM;
using std::vector;

typedef VariableStepRattleLangevinIntegrator Langevin;

/** The platform under test; set by the platform's own file. */
Platform& getTestPlatform();

// Two particles on a spring at a temperature of zero, from rest: known in closed form. Without friction the energy stays.
inline void testSingleBond() {
    System system;
    system.addParticle(2.0);
    system.addParticle(2.0);
    HarmonicBondForce* force = new HarmonicBondForce();
    force->addBond(0, 1, 1.5, 1.0);
    system.addForce(force);
    const double friction = 0.1, frequency = std::sqrt(1 - friction * friction / 4);
    Langevin integrator(0, friction, 0.01);
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(-1, 0, 0), Vec3(1, 0, 0)});
    for (int i = 0; i < 1000; i++) {
        const State state = context.getState(State::Positions | State::Velocities);
        const double t = state.getTime(), decay = 0.5 * std::exp(-friction * t / 2), phase = frequency * t;
        const double distance = 1.5 + decay * (std::cos(phase) + friction / (2 * frequency) * std::sin(phase));
        const double speed = -decay / frequency * std::sin(phase);
        for (int k = 0; k < 2; k++) {
            const double sign = k == 0 ? -0.5 : 0.5;
            // OpenMM allows 2e-2. The phase error of steps h is h^2/24 a radian, and there are ten.
            ASSERT_EQUAL_VEC(Vec3(sign * distance, 0, 0), state.getPositions()[k], 1e-4);
            ASSERT_EQUAL_VEC(Vec3(sign * speed, 0, 0), state.getVelocities()[k], 1e-4);
        }
        integrator.step(1);
    }
    integrator.setFriction(0);
    context.setPositions({Vec3(-1, 0, 0), Vec3(1, 0, 0)});
    const auto energyOf = [&] { // of the velocities on step
        const State state = context.getState(State::Energy | State::Velocities);
        const vector<Vec3>& v = state.getVelocities();
        return state.getPotentialEnergy() + v[0].dot(v[0]) + v[1].dot(v[1]);
    };
    const double start = energyOf();
    for (int i = 0; i < 1000; i++) {
        ASSERT_EQUAL_TOL(start, energyOf(), 1e-4);
        integrator.step(1);
    }
}

// Particles in harmonic traps, some joined in rigid pairs: the kinetic energy is that of the temperature, at two of them.
inline void testTemperature() {
    const int numPairs = 100;
    System system;
    CustomExternalForce* trap = new CustomExternalForce("500*(x^2+y^2+z^2)");
    vector<Vec3> positions;
    std::mt19937 random(1);
    for (int i = 0; i < 2 * numPairs; i++) {
        system.addParticle(i % 2 == 0 ? 10.0 : 3.0);
        trap->addParticle(i);
        positions.push_back(i % 2 == 0 ? randomVec(random) : positions.back() + Vec3(0.1, 0, 0));
        if (i % 2 == 1 && i < numPairs)
            system.addConstraint(i - 1, i, 0.1);
    }
    system.addForce(trap);
    const int numConstraints = system.getNumConstraints(), numSteps = 200;
    Langevin integrator(100, 20, 0.01);
    integrator.setRandomNumberSeed(3);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocitiesToTemperature(100, 4);
    for (double temperature : {100.0, 350.0}) {
        integrator.setTemperature(temperature);
        integrator.step(60); // twelve times 1/friction
        double kinetic = 0;
        for (int i = 0; i < numSteps / 5; i++) {
            integrator.step(5); // 1/friction
            kinetic += context.getState(State::Energy).getKineticEnergy() / (numSteps / 5);
        }
        const int freedoms = 3 * system.getNumParticles() - numConstraints;
        const double error = std::sqrt(2.0 / freedoms / (numSteps / 5)),
                     expected = 0.5 * freedoms * BOLTZMANN * temperature;
        std::cout << "at " << temperature << " K " << temperature * kinetic / expected << " +- " << temperature * error
                  << std::endl;
        ASSERT_EQUAL_TOL(expected, kinetic, 5 * error);
    }
}

// A chain of four and two pairs with charges: lengths hold to the tolerance in each step, velocities along them vanish, also where those
// at the start do not.
inline void testConstraints() {
    System system;
    vector<Vec3> positions, velocities;
    std::mt19937 random(1);
    NonbondedForce* force = new NonbondedForce();
    for (int i = 0; i < 8; i++) {
        system.addParticle(10.0);
        force->addParticle(i % 2 == 0 ? 0.2 : -0.2, 0.5, 5.0);
        positions.push_back(Vec3(i / 2, (i + 1) / 2, 0));
        velocities.push_back(randomVec(random));
    }
    for (int i : {0, 1, 2, 4, 6})
        system.addConstraint(i, i + 1, 1.0);
    system.addForce(force);
    Langevin integrator(100, 2, 0.01);
    integrator.setConstraintTolerance(1e-5);
    integrator.setRandomNumberSeed(2);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocities(velocities);
    for (int i = 0; i < 300; i++) {
        integrator.step(1);
        const State state = context.getState(State::Positions | State::Velocities);
        for (int k = 0; k < system.getNumConstraints(); k++) {
            int a, b;
            double length;
            system.getConstraintParameters(k, a, b, length);
            const Vec3 r = state.getPositions()[a] - state.getPositions()[b];
            const Vec3 w = state.getVelocities()[a] - state.getVelocities()[b];
            ASSERT(std::fabs(std::sqrt(r.dot(r)) / length - 1) <= 1e-5); // OpenMM's tests allow ten times the tolerance
            ASSERT(std::fabs(r.dot(w)) < 1e-9); // and do not look at the velocities
        }
    }
}

inline void testConstrainedMasslessParticles() {
    System system;
    system.addParticle(0.0);
    system.addParticle(1.0);
    system.addConstraint(0, 1, 1.5);
    Langevin refused(300, 2, 0.01), integrator(300, 2, 0.01);
    assertThrows("massless", [&] { Context context(system, refused, getTestPlatform()); });
    system.setParticleMass(1, 0.0); // both massless is no constraint at all
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(-1, 0, 0), Vec3(1, 0, 0)});
    context.setVelocitiesToTemperature(300.0, 5);
    integrator.step(1);
    const State state = context.getState(State::Positions | State::Velocities);
    for (int i = 0; i < 2; i++) {
        ASSERT_EQUAL_VEC(Vec3(0, 0, 0), state.getVelocities()[i], 0.0);
        ASSERT_EQUAL_VEC(Vec3(2 * i - 1, 0, 0), state.getPositions()[i], 0.0);
    }
}

// The same seed gives the same run, in a Context that is created again; another one, and going on, give another.
inline void testRandomSeed() {
    System system;
    NonbondedForce* force = new NonbondedForce();
    vector<Vec3> positions;
    for (int i = 0; i < 8; i++) {
        system.addParticle(2.0);
        force->addParticle(i % 2 == 0 ? 1.0 : -1.0, 1.0, 5.0);
        positions.push_back(Vec3(i % 2 == 0 ? 2 : -2, i % 4 < 2 ? 2 : -2, i < 4 ? 2 : -2));
    }
    system.addForce(force);
    Langevin integrator(100, 2, 0.01);
    integrator.setRandomNumberSeed(5);
    Context context(system, integrator, getTestPlatform());
    const auto run = [&](bool isNew) {
        if (isNew)
            context.reinitialize();
        context.setPositions(positions);
        context.setVelocities(vector<Vec3>(8));
        integrator.step(10);
        return context.getState(State::Positions).getPositions();
    };
    const vector<Vec3> first = run(false), again = run(true), goingOn = run(false);
    integrator.setRandomNumberSeed(10);
    const vector<Vec3> other = run(true), otherAgain = run(true);
    for (int i = 0; i < 8; i++) {
        ASSERT_EQUAL_VEC(first[i], again[i], 1e-6);
        ASSERT_EQUAL_VEC(other[i], otherAgain[i], 1e-6);
        for (int k = 0; k < 3; k++)
            ASSERT(std::fabs(first[i][k] - other[i][k]) > 1e-9 && std::fabs(first[i][k] - goingOn[i][k]) > 1e-9);
    }
}

inline void testInitialTemperature() {
    const int numParticles = 50000;
    System system;
    const vector<Vec3> positions = addFreeParticles(system, numParticles);
    Langevin integrator(300, 25, 0.001);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    context.setVelocitiesToTemperature(300, 5);
    const double kinetic = kineticEnergyOf(context);
    ASSERT_EQUAL_TOL(300, 2 * kinetic / (3 * numParticles * BOLTZMANN), 5 * std::sqrt(2.0 / (3 * numParticles)));
    // Without a force the velocities half a step before are the same.
    ASSERT_EQUAL_TOL(kinetic, context.getState(State::Energy).getKineticEnergy(), 1e-6);
}

// The forces of the integrator's groups alone act, and those of others where they are asked for.
inline void testForceGroups() {
    System system;
    addPulledParticle(system);
    const double friction = 1, h = 0.01, damping = std::exp(-friction * h);
    Langevin integrator(0, friction, h);
    integrator.setIntegrationForceGroups(1 << 1);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(vector<Vec3>(1));
    integrator.step(1);
    // Half a kick, half a drift, the friction, half a drift.
    ASSERT_EQUAL_VEC(Vec3(-0.25 * h * h * (1 + damping), 0, 0), context.getState(State::Positions).getPositions()[0],
                     1e-10);
    integrator.setIntegrationForceGroups(1 << 2);
    integrator.step(1);
    const Vec3 end = context.getState(State::Positions).getPositions()[0];
    ASSERT_EQUAL_TOL(-0.25 * h * h * (1 + damping), end[1], 1e-5);
    ASSERT(end[0] < -0.5 * h * h * (1 + damping));
}

inline TestList getLangevinTests() {
    return {{"single bond", testSingleBond},  {"temperature", testTemperature},
            {"constraints", testConstraints}, {"constrained massless particles", testConstrainedMasslessParticles},
            {"random seed", testRandomSeed},  {"initial temperature", testInitialTemperature},
            {"force groups", testForceGroups}};
}

} // namespace OpenMMVRattle
