// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What is refused before it goes wrong without a word, and velocities to start with. Each platform's tests/ includes this file.

#include "TestVariableStepRattleIntegrator.h"
#include "openmm/MonteCarloAnisotropicBarostat.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/MonteCarloFlexibleBarostat.h"
#include "openmm/MonteCarloMembraneBarostat.h"
#include <functional>
#include <map>
#include <memory>
#include <string>

namespace OpenMMVRattle {

const double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();
const char DISTANCE[] = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-d";

// Particles of 10 amu in a cubic box, with a Force that is periodic and does nothing.
inline void makeBox(TestSystem& t, const vector<Vec3>& positions, double side, bool isPeriodic = true) {
    CustomBondForce* force = new CustomBondForce("0*r");
    force->setUsesPeriodicBoundaryConditions(isPeriodic);
    force->setName("bonds");
    t.system.addForce(force);
    t.system.setDefaultPeriodicBoxVectors(Vec3(side, 0, 0), Vec3(0, side, 0), Vec3(0, 0, side));
    t.positions = positions;
    t.velocities.resize(positions.size());
    for (size_t i = 0; i < positions.size(); i++)
        t.system.addParticle(10);
}

inline Integrator_ makeFixedStepIntegrator() {
    Integrator_ integrator(0.001);
    integrator.clearMonitors();
    return integrator;
}

inline void tryToCreate(const System& system, Integrator_ integrator = makeFixedStepIntegrator()) {
    Context context(system, integrator, getTestPlatform());
}

inline void tryToStep(const TestSystem& t, Integrator_ integrator = makeFixedStepIntegrator()) {
    Context context(t.system, integrator, getTestPlatform());
    context.setPositions(t.positions);
    context.setVelocities(t.velocities);
    integrator.step(1);
}

// ------------------------------------------------------------------------------------------- when the Context is made

inline void testMasses() {
    for (double mass : {-1.00795, NOT_A_NUMBER, std::numeric_limits<double>::infinity()}) {
        TestSystem t;
        makeBox(t, {Vec3(), Vec3(1, 0, 0)}, 5);
        t.system.setParticleMass(1, mass);
        std::stringstream text;
        text << "the mass of particle 1 is " << mass << " amu";
        assertThrows(text.str(), [&] { tryToCreate(t.system); });
    }
}

inline void testLengths() {
    for (double length : {0.0, -0.1, NOT_A_NUMBER}) {
        TestSystem t;
        makeBox(t, {Vec3(), Vec3(0.1, 0, 0)}, 5);
        t.system.addConstraint(0, 1, length);
        std::stringstream text;
        text << "constraint 0 of the System, of the particles 0 and 1, has a length of " << length << " nm";
        assertThrows(text.str(), [&] { tryToCreate(t.system); });
    }
}

inline void testConstrainedSites() {
    TestSystem t;
    makeBox(t, {Vec3(), Vec3(0.1, 0, 0), Vec3(), Vec3(), Vec3(1, 1, 1), Vec3(1, 1, 1.1)}, 5);
    for (int i = 2; i < 6; i++)
        t.system.setParticleMass(i, 0);
    t.system.addConstraint(0, 1, 0.1);
    t.system.addConstraint(4, 5, 0.1); // of a molecule that has been frozen
    t.system.setVirtualSite(2, new TwoParticleAverageSite(0, 1, 0.25, 0.75));
    t.system.setVirtualSite(3, new TwoParticleAverageSite(0, 1, 0.75, 0.25));
    t.positions[2] = t.positions[3] = Vec3(NOT_A_NUMBER, 0, 0); // they are computed
    tryToStep(t);
    t.system.addConstraint(2, 3, 0.05);
    assertThrows("constraint 2 of the System, of the particles 2 and 3, is of the virtual site 2",
                 [&] { tryToCreate(t.system); });
}

// The particles 0, 1 | 2, 3 are two dumbbells of the System, 4 and 5 have a bond of a Force, 6 is fixed.
struct EnsembleExample : TestSystem {
    EnsembleExample() {
        makeBox(*this, vector<Vec3>(7), 3);
        system.setParticleMass(6, 0);
        system.addConstraint(0, 1, 0.1);
        system.addConstraint(2, 3, 0.1);
        dynamic_cast<CustomBondForce&>(system.getForce(0)).addBond(4, 5);
    }
    // Whether a Context can be made with a Force and an expression of some particles; if not, the message.
    std::string refusalOf(Force* force, const vector<int>& particles) {
        system.addForce(force);
        const std::string name = force->getName();
        Integrator_ integrator = makeFixedStepIntegrator();
        integrator.addConstraint("x1-0.1", {0}); // which is nobody's business
        integrator.addConstraint(particles.size() == 1 ? "x1-1" : DISTANCE, particles, {{"d", 0.2}});
        std::string message;
        try {
            tryToCreate(system, integrator);
        }
        catch (const OpenMMException& e) {
            message = e.what();
            for (const std::string& part : {std::string("expression constraint 1 ("), ", which " + name + " ",
                                            "or remove " + name, std::string(" would be wrong")})
                if (message.find(part) == std::string::npos)
                    throw OpenMMException("\"" + part + "\" is not in \"" + message + "\"");
        }
        system.removeForce(system.getNumForces() - 1);
        return message;
    }
};

inline void testThermostats() {
    EnsembleExample example;
    auto isRefused = [&](const vector<int>& particles) {
        AndersenThermostat* thermostat = new AndersenThermostat(300, 1);
        return !example.refusalOf(thermostat, particles).empty();
    };
    ASSERT(isRefused({0, 2}));
    ASSERT(isRefused({4, 5})); // a bond does not make it one group
    ASSERT(!isRefused({0, 1})); // a constraint does
    ASSERT(!isRefused({3}));
    ASSERT(!isRefused({3, 6}));
    // Without an expression, or with one and no thermostat, there is nothing to refuse.
    example.system.addForce(new AndersenThermostat(300, 1));
    tryToCreate(example.system);
}

inline void testBarostats() {
    const std::map<std::string, std::function<Force*(bool)>> barostats = {
        {"MonteCarloBarostat", [](bool rigid) { return new MonteCarloBarostat(1, 300, 25, rigid); }},
        {"MonteCarloAnisotropicBarostat",
         [](bool rigid) { return new MonteCarloAnisotropicBarostat(Vec3(1, 1, 1), 300, true, true, true, 25, rigid); }},
        {"MonteCarloMembraneBarostat",
         [](bool rigid) {
             return new MonteCarloMembraneBarostat(1, 0, 300, MonteCarloMembraneBarostat::XYIsotropic,
                                                   MonteCarloMembraneBarostat::ZFree, 25, rigid);
         }},
        {"MonteCarloFlexibleBarostat", [](bool rigid) { return new MonteCarloFlexibleBarostat(1, 300, 25, rigid); }}};
    for (const auto& barostat : barostats) {
        EnsembleExample example;
        auto isRefused = [&](const vector<int>& particles, bool rigid = true) {
            Force* force = barostat.second(rigid);
            ASSERT_EQUAL(barostat.first, force->getName());
            return !example.refusalOf(force, particles).empty();
        };
        ASSERT(isRefused({0, 2}));
        ASSERT(isRefused({1, 4}));
        ASSERT(!isRefused({0, 1})); // one molecule
        ASSERT(!isRefused({4, 5}));
        ASSERT(!isRefused({3}));
        ASSERT(!isRefused({3, 6}));
        ASSERT(isRefused({4, 5}, false)); // which it then moves each by itself
        ASSERT(!isRefused({3}, false));
    }
}

// ------------------------------------------------------------------------------------------------- molecules in pieces

const Vec3 ZIGZAG[] = {Vec3(2.6, 1.5, 1.5), Vec3(2.85, 1.66583, 1.5), Vec3(3.1, 1.5, 1.5), Vec3(3.35, 1.66583, 1.5)};

// A chain of bonds of 0.3 nm, with members moved by box vectors, and with its bonds as constraints of either kind.
struct ChainInBox : TestSystem {
    ChainInBox(const Vec3& b, const Vec3& c, const vector<Vec3>& shifts, bool areExpressions, bool isPeriodic = true,
               double side = 3) : integrator(makeFixedStepIntegrator()) {
        makeBox(*this, {std::begin(ZIGZAG), std::end(ZIGZAG)}, side, isPeriodic);
        const Vec3 box[] = {Vec3(side, 0, 0), b, c};
        system.setDefaultPeriodicBoxVectors(box[0], box[1], box[2]);
        for (size_t i = 0; i < shifts.size(); i++)
            for (int j = 0; j < 3; j++)
                positions[i] += box[j] * shifts[i][j];
        for (int i = 0; i < 3; i++) {
            if (areExpressions)
                integrator.addConstraint(DISTANCE, {i + 1, i}, {{"d", 0.3}});
            else
                system.addConstraint(i, i + 1, 0.3);
        }
    }
    Integrator_ integrator;
};

inline void testWrappedPositions() {
    const vector<std::pair<Vec3, Vec3>> boxes = {{Vec3(0, 3, 0), Vec3(0, 0, 3)},
                                                 {Vec3(1.4, 2.9, 0), Vec3(-1.45, 1.4, 2.8)}};
    for (const auto& box : boxes)
        for (bool areExpressions : {false, true}) {
            const std::string pair = areExpressions ? "of the particles 2 and 1 does not hold"
                                                    : "distance between the particles 1 and 2 is ";
            auto attempt = [&](const vector<Vec3>& shifts) {
                ChainInBox chain(box.first, box.second, shifts, areExpressions);
                tryToStep(chain, chain.integrator);
            };
            attempt({});
            attempt(vector<Vec3>(4, Vec3(-1, 2, 5))); // whole, in another box
            for (const Vec3& shift : {Vec3(-1, 0, 0), Vec3(0, 1, 0), Vec3(0, 0, -1), Vec3(1, -1, 1), Vec3(0, 7, -5)}) {
                const vector<Vec3> torn = {Vec3(), Vec3(), shift, shift};
                assertThrows(pair, [&] { attempt(torn); });
                assertThrows("molecules must be whole", [&] { attempt(torn); });
            }
        }
}

// In a skewed box the nearest image of a long bond need not be within half a box in each direction.
inline void testLongBondInSkewedBox() {
    for (const Vec3& shift : {Vec3(), Vec3(1, 0, 0), Vec3(0, 0, 1), Vec3(-2, 1, -1)}) {
        TestSystem t;
        makeBox(t, {Vec3(), Vec3(0, 0, 1.45)}, 3);
        const Vec3 box[] = {Vec3(3, 0, 0), Vec3(1.4, 2.9, 0), Vec3(-1.45, 1.4, 2.8)};
        t.system.setDefaultPeriodicBoxVectors(box[0], box[1], box[2]);
        t.system.addConstraint(0, 1, 1.45);
        t.positions[1] += box[0] * shift[0] + box[1] * shift[1] + box[2] * shift[2];
        if (shift == Vec3())
            tryToStep(t);
        else
            assertThrows("and to the nearest periodic image 1.45 nm", [&] { tryToStep(t); });
    }
}

inline void testPositionsFromFiles() {
    for (bool areExpressions : {false, true}) {
        ChainInBox chain(Vec3(0, 3, 0), Vec3(0, 0, 3), {Vec3(), Vec3(), Vec3(-1, 0, 0), Vec3(-1, 0, 0)},
                         areExpressions);
        for (Vec3& x : chain.positions)
            for (int j = 0; j < 3; j++)
                x[j] = std::round(x[j] * 100) / 100; // two digits, in nm
        assertThrows("molecules must be whole", [&] { tryToStep(chain, chain.integrator); });
    }
}

// A start far off that no image meets is for the projection, and so is one in a box that nobody has asked for.
inline void testStartsFarOff() {
    for (bool isExpression : {false, true})
        for (bool isPeriodic : {false, true}) {
            const double side = isPeriodic ? 3 : 2;
            TestSystem t;
            makeBox(t, {Vec3(), Vec3(1.75, 0, 0)}, side, isPeriodic);
            Integrator_ integrator = makeFixedStepIntegrator();
            if (isExpression)
                integrator.addConstraint(DISTANCE, {0, 1}, {{"d", 0.25}});
            else
                t.system.addConstraint(0, 1, 0.25);
            tryToStep(t, integrator);
            t.positions[1] = Vec3(side - 0.25, 0, 0);
            if (isPeriodic)
                assertThrows("molecules must be whole", [&] { tryToStep(t, integrator); });
        }
}

// A ring that is closed through the box has no whole form; an expression with the box vector in it holds it.
inline void testRingThroughTheBox() {
    const int size = 8;
    vector<Vec3> positions;
    for (int i = 0; i < size; i++)
        positions.push_back(Vec3(3.0 * i / size, i % 2 == 0 ? 0.05 : -0.05, 0));
    const Vec3 bond = positions[1] - positions[0];
    const double length = std::sqrt(bond.dot(bond));
    for (bool isExpression : {false, true}) {
        TestSystem t;
        makeBox(t, positions, 3);
        Integrator_ integrator = makeFixedStepIntegrator();
        for (int i = 0; i < size - 1; i++)
            t.system.addConstraint(i, i + 1, length);
        if (isExpression) {
            integrator.addConstraint("sqrt((x1+side-x2)^2+(y1-y2)^2+(z1-z2)^2)-d", {0, size - 1},
                                     {{"side", 3.0}, {"d", length}});
            tryToStep(t, integrator);
        }
        else {
            t.system.addConstraint(size - 1, 0, length);
            assertThrows("if it is bonded to its own image", [&] { tryToStep(t, integrator); });
        }
    }
}

// What an expression holds in space may be meant in the box beside.
inline void testWrappedParticleOnSphere() {
    TestSystem t;
    makeBox(t, {Vec3(-0.3, 0, 0)}, 3);
    Integrator_ integrator = makeFixedStepIntegrator();
    integrator.addConstraint("sqrt(x1^2+y1^2+z1^2)-0.3", {0});
    tryToStep(t, integrator);
    t.positions[0] = Vec3(2.7, 0, 0);
    assertThrows("expression constraint 0 (sqrt(x1^2+y1^2+z1^2)-0.3 = 0) of particle 0 does not hold",
                 [&] { tryToStep(t, integrator); });
    t.positions[0] = Vec3(1.2, 0, 0);
    tryToStep(t, integrator);
}

// ----------------------------------------------------------------------------------------------- positions, velocities

inline void testPositions() {
    for (double x : {NOT_A_NUMBER, std::numeric_limits<double>::infinity()}) {
        TestSystem t;
        makeBox(t, {Vec3(), Vec3(0.1, 0, 0), Vec3(0, x, 0)}, 5);
        t.system.addConstraint(0, 1, 0.1);
        assertThrows("the position of particle 2 is not a finite number", [&] { tryToStep(t); });
        t.system.setParticleMass(2, 0);
        assertThrows("the position of particle 2 is not a finite number", [&] { tryToStep(t); });
        t.positions[2] = Vec3(0.1, 0, 0);
        tryToStep(t);
    }
    TestSystem t;
    makeBox(t, {Vec3(1, 1, 1), Vec3(1, 1, 1)}, 5);
    t.system.addConstraint(0, 1, 0.1);
    assertThrows("the particles 0 and 1 are at the same position", [&] { tryToStep(t); });
}

// Positions whose rounding is larger than the tolerance of a constraint, which a larger tolerance allows.
inline void testPositionsFarOut() {
    for (bool isExpression : {false, true}) {
        TestSystem t;
        makeBox(t, {Vec3(1e8, 1e8, 1e8), Vec3(1e8 + 0.1, 1e8, 1e8)}, 5);
        Integrator_ integrator = makeFixedStepIntegrator();
        if (isExpression)
            integrator.addConstraint(DISTANCE, {0, 1}, {{"d", 0.1}});
        else
            t.system.addConstraint(0, 1, 0.1);
        assertThrows("by positions as large as 1e+08 nm, which are rounded to 2.22045e-08 nm",
                     [&] { tryToStep(t, integrator); });
        integrator.setConstraintTolerance(1e-5);
        tryToStep(t, integrator);
    }
}

inline void testSmallestStep() {
    TestSystem t;
    makeChain(t, 4);
    Integrator_ integrator(1e-100);
    tryToStep(t, integrator);
    assertThrows("a step size of 1e-300 ps is too small to compute with", [&] { integrator.setStepSize(1e-300); });
}

inline void testConstraintsThatContradictEachOther() {
    TestSystem t;
    makeBox(t, {Vec3(), Vec3(0.1, 0, 0), Vec3(0.1, 0.1, 0)}, 5);
    t.system.addConstraint(0, 1, 0.1);
    t.system.addConstraint(1, 2, 0.1);
    t.system.addConstraint(0, 2, 0.3);
    assertThrows("constraints that contradict each other have none", [&] { tryToStep(t); });
}

inline void testFastVelocities() {
    TestSystem t;
    makeBox(t, {Vec3(), Vec3(0.1, 0, 0), Vec3(1, 1, 1)}, 5);
    t.system.addConstraint(0, 1, 0.1);
    t.velocities[2] = Vec3(0, 9e5, 0);
    tryToStep(t);
    t.velocities[2] = Vec3(0, 0, -2e7);
    for (const char* text : {"the velocity of particle 2 is 2e+07 nm/ps", "setVelocitiesToTemperature()"}) {
        assertThrows(text, [&] { tryToStep(t); });
        Integrator_ integrator(0.001);
        integrator.useAutomaticStepControl(10);
        assertThrows(text, [&] { tryToStep(t, integrator); });
    }
    t.velocities[2] = Vec3(0, 0, NOT_A_NUMBER);
    assertThrows("the velocity of particle 2 is not a finite number", [&] { tryToStep(t); });
    t.system.setParticleMass(2, 0); // its velocity means nothing
    Integrator_ integrator = makeFixedStepIntegrator();
    Context context(t.system, integrator, getTestPlatform());
    context.setPositions(t.positions);
    context.setVelocities(t.velocities);
    integrator.step(1);
    ASSERT_EQUAL(0.0, context.getState(State::Energy).getKineticEnergy());
}

// A triangulated flat ring, from whose constraints OpenMM's solver makes velocities of more than 1e100 nm/ps.
inline void makeFlatRing(TestSystem& t) {
    vector<Vec3> positions;
    for (int i = 0; i < 6; i++)
        positions.push_back(Vec3(0.14 * std::cos(i * M_PI / 3), 0.14 * std::sin(i * M_PI / 3), 0));
    makeBox(t, positions, 2, false);
    for (auto pair :
         vector<std::pair<int, int>>{{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 0}, {0, 2}, {0, 3}, {0, 4}}) {
        const Vec3 r = positions[pair.first] - positions[pair.second];
        t.system.addConstraint(pair.first, pair.second, std::sqrt(r.dot(r)));
    }
}

inline void testVelocitiesOfCoupledConstraints() {
    TestSystem t;
    makeFlatRing(t);
    Integrator_ integrator = makeFixedStepIntegrator();
    Context context(t.system, integrator, getTestPlatform());
    context.setPositions(t.positions);
    vector<Vec3> fast(6, Vec3(1e126, 0, 0));
    context.setVelocities(fast);
    assertThrows("the velocity of particle 0 is 1e+126 nm/ps", [&] { integrator.step(1); });
    // The way out that the message names. It leaves the force for the step to use.
    integrator.setVelocitiesToTemperature(300, 1);
    ASSERT_EQUAL(1, integrator.getNumForceEvaluations());
    integrator.step(1);
    ASSERT_EQUAL(2, integrator.getNumForceEvaluations());
    double sum = 0;
    const int numSamples = 400;
    for (int seed = 1; seed <= numSamples; seed++) {
        integrator.setVelocitiesToTemperature(300, seed);
        sum += context.getState(State::Energy).getKineticEnergy() / numSamples;
    }
    // 9 degrees of freedom: the mean of n samples has a relative standard deviation of sqrt(2/(9 n)).
    ASSERT_EQUAL_TOL(0.5 * 9 * BOLTZMANN * 300, sum, 4 * std::sqrt(2.0 / (9 * numSamples)));
}

/*
 * A dumbbell of unlike masses whose bond is of the System, with one end on a plane by an expression, and a free particle. Known
 * energies: kT/2 for each of the three directions of the free particle and for each of the 6 - 2 of the dumbbell. And where the
 * bond lies in the plane, its rotation about the plane's normal and out of the plane, and the sum of momenta along the plane,
 * are independent, with kT/2 each.
 */
inline void testMaxwellVelocities() {
    TestSystem t;
    makeBox(t, {Vec3(0, 0, 0.5), Vec3(0.1, 0, 0.5), Vec3(1, 1, 1)}, 5);
    const double m1 = 1, m2 = 12, m3 = 3, kT = BOLTZMANN * 250;
    const vector<double> masses = {m1, m2, m3};
    for (int i = 0; i < 3; i++)
        t.system.setParticleMass(i, masses[i]);
    t.system.addConstraint(0, 1, 0.1);
    Integrator_ integrator = makeFixedStepIntegrator();
    integrator.addConstraint("3*(z1-0.5)", {0});
    Context context(t.system, integrator, getTestPlatform());
    context.setPositions(t.positions);
    const int numSamples = 2000;
    double along[2] = {}, rotation = 0, outOfPlane = 0, free[3] = {};
    for (int seed = 0; seed < numSamples; seed++) {
        integrator.setVelocitiesToTemperature(250, seed - 1000);
        const vector<Vec3> v = context.getState(State::Velocities).getVelocities();
        ASSERT(std::fabs(v[0][2]) < 1e-15);
        ASSERT(std::fabs(v[1][0] - v[0][0]) < 1e-14);
        for (int j = 0; j < 2; j++) {
            const double momentum = m1 * v[0][j] + m2 * v[1][j];
            along[j] += momentum * momentum / (m1 + m2) / numSamples;
        }
        rotation += m1 * m2 / (m1 + m2) * std::pow(v[1][1] - v[0][1], 2) / numSamples;
        outOfPlane += m2 * v[1][2] * v[1][2] / numSamples;
        for (int j = 0; j < 3; j++)
            free[j] += m3 * v[2][j] * v[2][j] / numSamples;
    }
    // The squares of normally distributed numbers have a variance of 2.
    for (double energy : {along[0], along[1], rotation, outOfPlane, free[0], free[1], free[2]})
        ASSERT_EQUAL_TOL(kT, energy, 4 * std::sqrt(2.0 / numSamples));
}

inline void testSeedsAndErrorsOfVelocities() {
    TestSystem t;
    makeChain(t, 10);
    Integrator_ integrator = makeFixedStepIntegrator();
    assertThrows("not bound to a context", [&] { integrator.setVelocitiesToTemperature(300, 1); });
    Context context(t.system, integrator, getTestPlatform());
    assertThrows("positions have not been set", [&] { integrator.setVelocitiesToTemperature(300, 1); });
    context.setPositions(t.positions);
    auto velocities = [&] { return context.getState(State::Velocities).getVelocities(); };
    integrator.setVelocitiesToTemperature(300, 5);
    const vector<Vec3> first = velocities();
    integrator.setVelocitiesToTemperature(300, 6);
    ASSERT(velocities() != first);
    integrator.setVelocitiesToTemperature(300, 5);
    ASSERT(velocities() == first);
    for (double temperature : {-1.0, NOT_A_NUMBER})
        assertThrows("the temperature must be a finite number",
                     [&] { integrator.setVelocitiesToTemperature(temperature, 7); });
    ASSERT(velocities() == first);
    integrator.setVelocitiesToTemperature(300);
    const vector<Vec3> other = velocities();
    integrator.setVelocitiesToTemperature(300);
    ASSERT(velocities() != other);
    integrator.setVelocitiesToTemperature(0, 1);
    ASSERT(velocities() == vector<Vec3>(10));
    // Positions that are no start leave the velocities, and a later call finds the way back.
    context.setVelocities(first);
    vector<Vec3> positions = t.positions;
    positions[4] = positions[3];
    context.setPositions(positions);
    assertThrows("at the same position", [&] { integrator.setVelocitiesToTemperature(300, 1); });
    ASSERT(velocities() == first);
    context.setPositions(t.positions);
    integrator.setVelocitiesToTemperature(300, 5);
    ASSERT(velocities() == first);
    integrator.step(10);
}

// Positions off the constraints stay where they are until the next step, and the velocities fit where that starts from.
inline void testVelocitiesOffTheConstraints() {
    TestSystem t;
    makeBox(t, {Vec3(), Vec3(0.12, 0.01, 0)}, 5);
    t.system.addConstraint(0, 1, 0.1);
    Integrator_ integrator = makeFixedStepIntegrator();
    Context context(t.system, integrator, getTestPlatform());
    context.setPositions(t.positions);
    integrator.setVelocitiesToTemperature(300, 1);
    State state = context.getState(State::Positions | State::Energy);
    ASSERT(state.getPositions() == t.positions);
    const double energy = state.getKineticEnergy();
    integrator.step(50);
    state = context.getState(State::Positions | State::Energy);
    const Vec3 r = state.getPositions()[1] - state.getPositions()[0];
    ASSERT_EQUAL_TOL(0.1, std::sqrt(r.dot(r)), 1e-8);
    ASSERT_EQUAL_TOL(energy, state.getKineticEnergy(), 1e-9); // nothing acts on a rigid body
}

inline TestList getCheckTests() {
    return {{"masses", testMasses},
            {"lengths", testLengths},
            {"constraints on virtual sites", testConstrainedSites},
            {"thermostats and expressions", testThermostats},
            {"barostats and expressions", testBarostats},
            {"wrapped positions", testWrappedPositions},
            {"a long bond in a skewed box", testLongBondInSkewedBox},
            {"wrapped positions with few digits", testPositionsFromFiles},
            {"starts far off", testStartsFarOff},
            {"a ring through the box", testRingThroughTheBox},
            {"a wrapped particle on a sphere", testWrappedParticleOnSphere},
            {"positions", testPositions},
            {"positions far out", testPositionsFarOut},
            {"the smallest step", testSmallestStep},
            {"constraints that contradict each other", testConstraintsThatContradictEachOther},
            {"velocities that are too fast", testFastVelocities},
            {"velocities of coupled constraints", testVelocitiesOfCoupledConstraints},
            {"the distribution of velocities", testMaxwellVelocities},
            {"seeds and errors of velocities", testSeedsAndErrorsOfVelocities},
            {"velocities off the constraints", testVelocitiesOffTheConstraints}};
}

} // namespace OpenMMVRattle
