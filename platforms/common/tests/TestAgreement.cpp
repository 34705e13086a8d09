// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// A GPU against Reference, from one state in the middle of a run; and what happens between steps there.

#include "GpuTests.h"

#include "TestVariableStepRattleIntegrator.h"
#include "openmm/AndersenThermostat.h"
#include "openmm/CMMotionRemover.h"
#include "openmm/CompoundIntegrator.h"
#include "openmm/CustomCompoundBondForce.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/serialization/XmlSerializer.h"

using namespace OpenMMVRattle;

namespace {

const int WHOLE_STATE = State::Positions | State::Velocities | State::Parameters | State::IntegratorParameters;

std::string precision() {
    return getTestPlatform().getPropertyDefaultValue("Precision");
}

// One of three numbers, for double, mixed and single precision.
double choose(double inDouble, double inMixed, double inSingle) {
    return precision() == "double" ? inDouble : precision() == "mixed" ? inMixed : inSingle;
}

// The bounds are those of OpenMM's nonbonded forces, which differ by 3e-7 between Reference and OpenCL in double precision;
// TestDeviceSteps compares the method itself.

// Water, a massless wall particle and a site in a triclinic box, in which molecules that leave it are wrapped.
struct Box : TestSystem {
    explicit Box(int waters, bool isBarostatted = false) {
        const double edge = 2.4;
        system.setDefaultPeriodicBoxVectors(Vec3(edge, 0, 0), Vec3(0.3, edge, 0), Vec3(-0.2, 0.4, edge));
        auto* nonbonded = new NonbondedForce();
        nonbonded->setNonbondedMethod(NonbondedForce::CutoffPeriodic);
        nonbonded->setCutoffDistance(0.88); // at 0.9 nm are pairs that rounding decides about
        nonbonded->setUseSwitchingFunction(true);
        nonbonded->setSwitchingDistance(0.7);
        std::mt19937 random(11);
        std::normal_distribution<double> normal;
        const double charges[] = {-0.834, 0.417, 0.417};
        for (int i = 0; i < waters; i++) {
            const int first = system.getNumParticles();
            const Vec3 centre(edge / 4 * (i % 4) + 0.05, edge / 4 * (i / 4 % 4), edge / 4 * (i / 16) - 0.02);
            for (int j = 0; j < 3; j++) {
                const double mass = j == 0 ? 16.0 : 1.0;
                system.addParticle(mass);
                nonbonded->addParticle(charges[j], j == 0 ? 0.3125 : 1.0, j == 0 ? 0.5625 : 0.0);
                velocities.push_back(Vec3(normal(random), normal(random), normal(random)) * std::sqrt(2.5 / mass));
            }
            positions.push_back(centre);
            positions.push_back(centre + Vec3(0.0957, 0, 0));
            positions.push_back(centre + Vec3(-0.024, 0.0927, 0));
            for (const auto& bond : {std::pair<int, int>{0, 1}, {0, 2}, {1, 2}}) {
                const Vec3 r = positions[first + bond.first] - positions[first + bond.second];
                system.addConstraint(first + bond.first, first + bond.second, std::sqrt(r.dot(r)));
                nonbonded->addException(first + bond.first, first + bond.second, 0, 1, 0);
            }
        }
        const int site = system.addParticle(0), fixed = system.addParticle(0);
        system.setVirtualSite(site, new TwoParticleAverageSite(0, 4, 0.3, 0.7));
        nonbonded->addParticle(0.1, 1, 0);
        nonbonded->addParticle(-0.1, 0.25, 0.25);
        for (int i : {0, 1, 2, 3, 4, 5})
            nonbonded->addException(i, site, 0, 1, 0);
        positions.push_back(Vec3());
        positions.push_back(Vec3(1.2, 1.1, 2.25));
        velocities.resize(fixed + 1);
        system.addForce(nonbonded);
        if (isBarostatted) {
            auto* barostat = new MonteCarloBarostat(1.0, 300.0, 4);
            barostat->setRandomNumberSeed(3);
            system.addForce(barostat);
        }
    }
};

typedef vector<std::pair<std::string, vector<int>>> Expressions; // and their particles; the parameters are those of all

struct On {
    Integrator_ integrator;
    Context context;
    On(const TestSystem& t, Platform& platform, const Expressions& expressions = {},
       const vector<std::map<std::string, double>>& parameters = {}) :
            integrator(makeIntegrator(expressions, parameters)), context(t.system, integrator, platform) {
    }
    static Integrator_ makeIntegrator(const Expressions& expressions,
                                      const vector<std::map<std::string, double>>& parameters) {
        Integrator_ result(0.001);
        for (size_t i = 0; i < expressions.size(); i++)
            result.addConstraint(expressions[i].first, expressions[i].second, parameters[i]);
        return result;
    }
    vector<Vec3> positions() {
        return context.getState(State::Positions).getPositions();
    }
};

Platform& reference() {
    return Platform::getPlatform("Reference");
}

// The state of a run on Reference after some steps, as XML.
std::string stateInMidRun(const TestSystem& t, Integrator_::UpdateMethod update, bool isAutomatic = false) {
    On run(t, reference());
    run.integrator.setUpdateMethod(update);
    run.integrator.addMonitor(Integrator_::AppliedForce);
    if (isAutomatic)
        run.integrator.useAutomaticStepControl(15);
    run.integrator.setConstraintTolerance(1e-10);
    run.context.setPositions(t.positions);
    run.context.setVelocities(t.velocities);
    run.integrator.step(20);
    const State state = run.context.getState(WHOLE_STATE);
    std::stringstream text;
    XmlSerializer::serialize<State>(&state, "State", text);
    return text.str();
}

void load(Context& context, const std::string& xml) {
    std::stringstream text(xml);
    std::unique_ptr<State> state(XmlSerializer::deserialize<State>(text));
    context.setState(*state);
}

std::string save(Context& context) {
    const State state = context.getState(WHOLE_STATE);
    std::stringstream text;
    XmlSerializer::serialize<State>(&state, "State", text);
    return text.str();
}

double largestOf(const vector<double>& values) {
    double largest = 0;
    for (double value : values)
        largest = std::max(largest, std::fabs(value));
    return largest;
}

void testAgreement() {
    const Box t(48);
    for (int update = 0; update < 4; update++) {
        const bool isAutomatic = update == 3;
        const std::string xml = stateInMidRun(t, (Integrator_::UpdateMethod) (update % 3), isAutomatic);
        On here(t, getTestPlatform()), there(t, reference());
        load(here.context, xml);
        load(there.context, xml);
        const double density = there.integrator.getStepDensity();
        ASSERT_EQUAL_TOL(density, here.integrator.getStepDensity(), 1e-12);
        for (int steps : {1, 199}) {
            here.integrator.step(steps);
            there.integrator.step(steps);
            // Chaos multiplies the rounding of forces a thousandfold in so many steps, and hides it in single precision.
            const double bound = steps == 1 ? choose(1e-9, 1e-6, 1e-5) : choose(1e-5, 1e-3, 1e-1);
            ASSERT(largestDifference(there.positions(), here.positions()) <= bound);
            ASSERT_EQUAL_TOL(there.integrator.getStepDensity(), here.integrator.getStepDensity(),
                             choose(1e-4, 1e-2, 1e-1));
            ASSERT_EQUAL_TOL(there.context.getTime(), here.context.getTime(), choose(1e-7, 1e-4, 1e-3));
            if (steps == 1) {
                vector<double> expected = there.integrator.getMultipliers(), found = here.integrator.getMultipliers();
                const double scale = largestOf(expected);
                for (size_t k = 0; k < expected.size(); k++)
                    ASSERT(std::fabs(found[k] - expected[k]) <= choose(1e-7, 1e-5, 1e-4) * scale);
            }
            // The particles have been sorted anew in the first step. In the monitor of half steps is a difference of forces.
            for (int k = 0; k < (isAutomatic ? 2 : 0); k++) {
                ASSERT_EQUAL_TOL(there.integrator.getReferenceMonitorValue(k),
                                 here.integrator.getReferenceMonitorValue(k), 1e-10);
                ASSERT_EQUAL_TOL(there.integrator.getMonitorValue(k), here.integrator.getMonitorValue(k),
                                 steps == 1 ? choose(1e-4, 1e-2, 1e-1) : choose(1e-2, 1, 1));
            }
        }
        ASSERT_EQUAL(there.context.getStepCount(), here.context.getStepCount());
        ASSERT_EQUAL(there.integrator.getNumForceEvaluations(), here.integrator.getNumForceEvaluations());
        ASSERT(largestConstraintError(here.context) <= choose(1e-9, 1e-7, 1e-4));
    }
}

// A State goes from Reference to the GPU, on, and back, and the run goes on all the way: no start gives its density away.
void testStatesMove() {
    const Box t(27);
    const std::string xml = stateInMidRun(t, Integrator_::SemiExplicit);
    On first(t, reference()), second(t, getTestPlatform()), third(t, reference()), fourth(t, getTestPlatform()),
        all(t, reference());
    load(all.context, xml);
    all.integrator.step(20);
    load(second.context, xml);
    second.integrator.step(5);
    load(third.context, save(second.context));
    third.integrator.step(5);
    load(fourth.context, save(third.context));
    fourth.integrator.step(5);
    load(first.context, save(fourth.context));
    first.integrator.step(5);
    // Each went on with the one evaluation that compares forces, and one a step.
    for (On* each : {&first, &second, &third, &fourth})
        ASSERT_EQUAL(6, each->integrator.getNumForceEvaluations());
    ASSERT(largestDifference(all.positions(), first.positions()) <= choose(1e-8, 1e-5, 1e-4));
    ASSERT_EQUAL_TOL(all.integrator.getStepDensity(), first.integrator.getStepDensity(), choose(1e-7, 1e-4, 1e-2));
    ASSERT_EQUAL_TOL(all.context.getTime(), first.context.getTime(), choose(1e-9, 1e-6, 1e-4));
}

void testReversal() {
    Box t(27);
    On run(t, getTestPlatform());
    run.integrator.setConstraintTolerance(choose(1e-13, 1e-12, 1e-5));
    run.context.setPositions(t.positions);
    run.context.setVelocities(t.velocities);
    run.integrator.step(20);
    const vector<Vec3> there = run.positions();
    run.integrator.step(100);
    run.integrator.reverse();
    run.integrator.step(100);
    ASSERT(largestDifference(there, run.positions()) <= choose(1e-11, 1e-5, 1e-3));
}

// Energies asked for between steps cost no evaluation of ours and change nothing.
void testEnergiesInBetween() {
    const Box t(27);
    On often(t, getTestPlatform()), once(t, getTestPlatform());
    for (On* each : {&often, &once}) {
        each->context.setPositions(t.positions);
        each->context.setVelocities(t.velocities);
        each->integrator.step(1);
    }
    for (int i = 0; i < 30; i++) {
        totalEnergy(often.context);
        often.integrator.step(1);
    }
    once.integrator.step(30);
    ASSERT_EQUAL(once.integrator.getNumForceEvaluations(), often.integrator.getNumForceEvaluations());
    ASSERT(largestDifference(once.positions(), often.positions()) <= choose(1e-12, 1e-6, 1e-4));
}

// A barostat changes the state by itself; the constraints hold, and rejected moves leave no trace.
void testBarostat(bool isAutomatic) {
    const Box t(27, true);
    On run(t, getTestPlatform());
    if (isAutomatic)
        run.integrator.useAutomaticStepControl(10);
    run.integrator.setConstraintTolerance(choose(1e-10, 1e-8, 1e-5));
    run.context.setPositions(t.positions);
    run.context.setVelocities(t.velocities);
    Vec3 box[3];
    run.context.getState(State::Positions).getPeriodicBoxVectors(box[0], box[1], box[2]);
    const double before = box[0][0];
    for (int i = 0; i < 10; i++) {
        run.integrator.step(10);
        ASSERT(largestConstraintError(run.context) <= choose(2e-10, 1e-6, 1e-4));
        ASSERT(std::isfinite(totalEnergy(run.context)));
    }
    run.context.getState(State::Positions).getPeriodicBoxVectors(box[0], box[1], box[2]);
    ASSERT(box[0][0] != before);
    if (isAutomatic)
        ASSERT(run.integrator.getReferenceMonitorValue(1) > 0);
    ASSERT_EQUAL(100, run.context.getStepCount());
    ASSERT(run.integrator.getNumForceEvaluations() >= 101);
    ASSERT(run.integrator.getNumForceEvaluations() <= 101 + 25); // one for each accepted move at most
}

// Automatic step control where Forces change the state: references follow what they change, and nothing else.
void testAutomaticControlUnderThermostats() {
    for (const bool isWarm : {false, true}) {
        Box t(27);
        auto* thermostat = new AndersenThermostat(600.0, isWarm ? 100.0 : 1e-9);
        thermostat->setRandomNumberSeed(5);
        t.system.addForce(thermostat);
        if (isWarm)
            t.system.addForce(new CMMotionRemover(1));
        On run(t, getTestPlatform());
        run.integrator.setConstraintTolerance(choose(1e-10, 1e-8, 1e-5));
        run.integrator.useAutomaticStepControl(10);
        run.context.setPositions(t.positions);
        run.context.setVelocities(t.velocities);
        run.integrator.step(15);
        double before[2];
        for (int k = 0; k < 2; k++)
            before[k] = run.integrator.getReferenceMonitorValue(k);
        ASSERT(before[0] > 0 && before[1] > 0);
        for (int i = 0; i < 20; i++) {
            run.integrator.step(2);
            ASSERT(run.integrator.getMonitorValue(0) > 0); // which looks at the state in between
        }
        for (int k = 0; k < 2; k++) {
            const double after = run.integrator.getReferenceMonitorValue(k);
            const double change = std::fabs(after / before[k] - 1);
            ASSERT(isWarm ? change > 0.01 : change <= 1e-12);
        }
        ASSERT_EQUAL(55, run.context.getStepCount());
        ASSERT(largestConstraintError(run.context) <= choose(2e-10, 1e-6, 1e-4));
        ASSERT(run.integrator.getNumForceEvaluations() <= 57);
    }
}

// A dumbbell beside others flies into a wall that no step can take, in step 31 of 60.
void testFailureInTheMiddle() {
    TestSystem t;
    for (int i = 0; i < 20; i++) {
        t.system.addParticle(12);
        t.positions.push_back(Vec3(1 + 0.3 * (i / 2), 0.1 * (i % 2), 0));
        t.velocities.push_back(Vec3(1, 0, 0));
        if (i % 2 == 1)
            t.system.addConstraint(i - 1, i, 0.1);
    }
    auto* wall = new CustomExternalForce("1e9*x*step(x-1.0295)");
    wall->addParticle(0);
    t.system.addForce(wall);
    t.system.addForce(new AndersenThermostat(300, 1e-9)); // which has nobody look before the end
    std::string messages[2];
    for (int k = 0; k < 2; k++) {
        On run(t, k == 0 ? reference() : getTestPlatform()), stopped(t, k == 0 ? reference() : getTestPlatform());
        for (On* each : {&run, &stopped}) {
            each->integrator.clearMonitors();
            each->integrator.setConstraintTolerance(1e-5);
            each->context.setPositions(t.positions);
            each->context.setVelocities(t.velocities);
        }
        stopped.integrator.step(30);
        try {
            run.integrator.step(60);
        }
        catch (const std::exception& e) {
            messages[k] = e.what();
        }
        ASSERT_EQUAL(30, run.context.getStepCount());
        ASSERT_EQUAL_TOL(0.030, run.context.getTime(), choose(1e-12, 1e-12, 1e-6));
        ASSERT_EQUAL_TOL(0.001, run.integrator.getStepSize(), choose(1e-12, 1e-12, 1e-6));
        const double rounding = choose(1e-12, 1e-12, 1e-6);
        ASSERT(largestDifference(stopped.positions(), run.positions()) <= rounding);
        ASSERT(largestDifference(stopped.context.getState(State::Velocities).getVelocities(),
                                 run.context.getState(State::Velocities).getVelocities()) <= rounding);
        // And it goes on where there is no wall.
        vector<Vec3> elsewhere = run.positions();
        elsewhere[0] -= Vec3(0.5, 0, 0);
        elsewhere[1] -= Vec3(0.5, 0, 0);
        run.context.setPositions(elsewhere);
        run.context.setVelocities(t.velocities);
        run.integrator.step(5);
        ASSERT_EQUAL(35, run.context.getStepCount());
    }
    ASSERT(!messages[0].empty());
    ASSERT_EQUAL(withoutNumbers(messages[0]), withoutNumbers(messages[1]));
}

// A rod as in section 5 of the paper, of sections of three particles that distances keep rigid, joined to their neighbours by three
// expressions, which bends and twists: K is block tridiagonal. The first section does not move.
struct Rod : TestSystem {
    Expressions expressions;
    vector<std::map<std::string, double>> parameters;

    explicit Rod(int sections) {
        const double spacing = 0.1, offset = 0.3;
        const Vec3 shape[] = {Vec3(offset, 0, 0), Vec3(0, offset, 0), Vec3(-offset, -offset, 0)};
        std::string means;
        for (const char* axis : {"x", "y", "z"}) {
            const std::string a(axis), first = "c" + a + "a", second = "c" + a + "b";
            for (const char* k : {"1", "2"})
                means += "; m" + (k + a) + "=(" + a + k + "-" + first + "+" + a + std::to_string(std::stoi(k) + 3) +
                         "-" + second + ")/(2*offset)";
        }
        std::string centres;
        for (const char* axis : {"x", "y", "z"}) {
            const std::string a(axis);
            centres +=
                "; c" + a + "a=(" + a + "1+" + a + "2+" + a + "3)/3; c" + a + "b=(" + a + "4+" + a + "5+" + a + "6)/3";
        }
        const std::string rest = means + centres;
        auto* elasticity = new CustomCompoundBondForce(
            6, "0.05*(0.1*u1^2+0.1*u2^2+0.4*u3^2); u1=nx*e2x+ny*e2y+nz*e2z; u2=-(nx*e1x+ny*e1y+nz*e1z);"
               " u3=m2x*e1x+m2y*e1y+m2z*e1z; nx=m1y*m2z-m1z*m2y; ny=m1z*m2x-m1x*m2z; nz=m1x*m2y-m1y*m2x;"
               " e1x=(x4-cxb-x1+cxa)/d; e1y=(y4-cyb-y1+cya)/d; e1z=(z4-czb-z1+cza)/d;"
               " e2x=(x5-cxb-x2+cxa)/d; e2y=(y5-cyb-y2+cya)/d; e2z=(z5-czb-z2+cza)/d; d=0.03" +
                   rest + "; offset=0.3");
        for (int section = 0; section < sections; section++)
            for (int i = 0; i < 3; i++) {
                const double along = spacing * section, phase = 0.02 * section;
                system.addParticle(section == 0 ? 0.0 : spacing / 3);
                positions.push_back(shape[i] + Vec3(0, 0, along));
                velocities.push_back(
                    section == 0 ? Vec3()
                                 : Vec3(1.5 * (1 - std::cos(phase)), std::sin(3 * phase), 0.5 * std::sin(phase)));
                if (section == 0)
                    continue;
                const int first = 3 * section + i, second = 3 * section + (i + 1) % 3;
                const Vec3 r = shape[i] - shape[(i + 1) % 3];
                system.addConstraint(first, second, std::sqrt(r.dot(r)));
            }
        const std::string components[] = {"m1y*m2z-m1z*m2y", "m1z*m2x-m1x*m2z", "m1x*m2y-m1y*m2x"};
        for (int section = 0; section + 1 < sections; section++) {
            vector<int> particles;
            for (int i = 0; i < 6; i++)
                particles.push_back(3 * section + i);
            elasticity->addBond(particles, {});
            for (int d = 0; d < 3; d++) {
                const std::string a(1, (char) ('x' + d));
                expressions.emplace_back("(c" + a + "b-c" + a + "a)/spacing-(" + components[d] + ")" + rest, particles);
                parameters.push_back({{"spacing", spacing}, {"offset", offset}});
            }
        }
        system.addForce(elasticity);
    }
};

void testRod() {
    if (precision() !=
        "double") // forces are differences of positions as large as 100 nm, which a float gives no digits
        return;
    const Rod t(1000);
    On here(t, getTestPlatform(), t.expressions, t.parameters), there(t, reference(), t.expressions, t.parameters);
    for (On* each : {&here, &there}) {
        each->integrator.setUpdateMethod(Integrator_::Explicit);
        each->integrator.setStepSize(0.002);
        each->integrator.setConstraintTolerance(1e-12);
        each->context.setPositions(t.positions);
        each->context.setVelocities(t.velocities);
        each->integrator.step(100);
    }
    ASSERT(largestDifference(t.positions, there.positions()) > 0.01);
    ASSERT(largestDifference(there.positions(), here.positions()) <= 1e-9);
    ASSERT_EQUAL_TOL(there.integrator.getStepDensity(), here.integrator.getStepDensity(), 1e-8);
    const vector<double> expected = there.integrator.getMultipliers(), found = here.integrator.getMultipliers();
    for (size_t k = 0; k < expected.size(); k++)
        ASSERT(std::fabs(found[k] - expected[k]) <= 1e-6 * largestOf(expected));
}

// Molecules of expressions that leave a box.
struct Pearls : TestSystem {
    const double edge = 2.2;
    Expressions expressions;
    vector<std::map<std::string, double>> parameters;

    Pearls() {
        system.setDefaultPeriodicBoxVectors(Vec3(edge, 0, 0), Vec3(0.4, edge, 0), Vec3(-0.3, 0.5, edge));
        auto* nonbonded = new NonbondedForce(); // with which OpenMM sorts molecules; they do not act on each other
        nonbonded->setNonbondedMethod(NonbondedForce::CutoffPeriodic);
        nonbonded->setCutoffDistance(1.0);
        auto* field = new CustomExternalForce("-3*x+2*z");
        auto add = [&](double mass, const Vec3& position, const Vec3& velocity) {
            positions.push_back(position);
            velocities.push_back(velocity);
            nonbonded->addParticle(0, 0.1, 0);
            const int index = system.addParticle(mass);
            field->addParticle(index);
            return index;
        };
        for (int i = 0; i < 24; i++) { // dumbbells, of which two have another length
            const double length = i == 5 || i == 17 ? 0.15 : 0.1;
            const Vec3 centre(0.37 * i, 0.21 * (i % 7), 0.33 * (i % 5)),
                velocity(2 - 0.3 * i, 1.5 * std::sin(i), 4 * std::cos(i));
            const int first = add(4, centre, velocity), second = add(4, centre + Vec3(0, length, 0), velocity * 0.8);
            expressions.emplace_back("sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-r", vector<int>{first, second});
            parameters.push_back({{"r", length}});
        }
        for (int i = 0; i < 6; i++) { // on rings that are wider than the box
            const double angle = i;
            expressions.emplace_back("x1^2+y1^2-r",
                                     vector<int>{add(3, Vec3(1.5 * std::cos(angle), 1.5 * std::sin(angle), 0),
                                                     Vec3(-5 * std::sin(angle), 5 * std::cos(angle), 2))});
            parameters.push_back({{"r", 2.25}});
        }
        // Two molecules with distances of their own, far from each other.
        const int one = add(4, Vec3(0, 0.05, 0.05), Vec3(3, 1, 0)),
                  other = add(2, Vec3(0.1, 0.05, 0.05), Vec3(3, 2, 0));
        const int far = add(4, Vec3(4, 0.3, 1), Vec3(2, 3, -5)), last = add(2, Vec3(4.1, 0.3, 1), Vec3(2, 3, -5));
        system.addConstraint(one, other, 0.1);
        system.addConstraint(far, last, 0.1);
        expressions.emplace_back("x1+y1+z1-x2-y2-z2+r", vector<int>{one, far});
        parameters.push_back({{"r", 5.2}});
        system.addForce(nonbonded);
        system.addForce(field);
    }
};

// Expressions are not periodic: where OpenMM moves molecules by box vectors, and changes the places of identical ones, they are of
// the positions that users see, and each stays with its own molecule.
void testExpressionsInABox() {
    const Pearls t;
    On here(t, getTestPlatform(), t.expressions, t.parameters), there(t, reference(), t.expressions, t.parameters);
    for (On* each : {&here, &there}) {
        each->integrator.setConstraintTolerance(choose(1e-11, 1e-10, 1e-5));
        each->context.setPositions(t.positions);
        each->context.setVelocities(t.velocities);
        each->integrator.step(900); // OpenMM sorts every 250 steps
    }
    ASSERT(largestDifference(t.positions, there.positions()) > 1.5 * t.edge);
    ASSERT(largestDifference(there.positions(), here.positions()) <= choose(1e-8, 1e-3, 1e-1));
    vector<double> expected = there.integrator.getMultipliers(), found = here.integrator.getMultipliers();
    const int numDistances = t.system.getNumConstraints();
    for (size_t k = 0; k < expected.size(); k++) {
        const double allowed = choose(1e-5, 1e-2, 1e-1) * largestOf(expected);
        ASSERT(std::fabs(found[k] - expected[k]) <= allowed);
        const int expression = (int) k - numDistances;
        if (expression >= 0)
            ASSERT(std::fabs(here.integrator.getExpressionConstraintMultiplier(expression) - expected[k]) <= allowed);
    }
    // Other lengths for molecules that were identical: what follows knows which is which.
    for (On* each : {&here, &there}) {
        for (int i : {2, 9})
            each->integrator.setExpressionConstraintParameter(i, "r", 0.1002 + 0.0001 * i);
        each->integrator.step(600);
    }
    ASSERT(largestDifference(there.positions(), here.positions()) <= choose(1e-7, 1e-2, 1));
}

// The same with automatic step control, which compares the forces of each particle with those before: with references below what the
// monitors are, so that steps are short and vary. A State goes to Reference and back.
void testAutomaticControlOfExpressions() {
    const Pearls t;
    On here(t, getTestPlatform(), t.expressions, t.parameters), there(t, reference(), t.expressions, t.parameters),
        next(t, reference(), t.expressions, t.parameters);
    const auto requireAgreement = [](On& one, On& other, double distance, double fraction) {
        ASSERT(largestDifference(one.positions(), other.positions()) <= distance);
        ASSERT_EQUAL_TOL(one.integrator.getStepDensity(), other.integrator.getStepDensity(), fraction);
        for (int k = 0; k < 2; k++) {
            ASSERT_EQUAL_TOL(one.integrator.getMonitorValue(k), other.integrator.getMonitorValue(k), fraction);
            ASSERT_EQUAL_TOL(one.integrator.getReferenceMonitorValue(k), other.integrator.getReferenceMonitorValue(k),
                             fraction);
        }
    };
    for (On* each : {&here, &there, &next}) {
        each->integrator.setConstraintTolerance(choose(1e-11, 1e-10, 1e-5));
        each->integrator.useAutomaticStepControl(10);
    }
    for (On* each : {&here, &there}) {
        each->context.setPositions(t.positions);
        each->context.setVelocities(t.velocities);
        each->integrator.step(15);
        ASSERT_EQUAL(each == &here, each->integrator.isOnDevice());
    }
    requireAgreement(there, here, choose(1e-10, 1e-5, 1e-2), choose(1e-7, 1e-2, 1e-1));
    const double values[] = {there.integrator.getReferenceMonitorValue(0) / 8,
                             there.integrator.getReferenceMonitorValue(1) / 8};
    for (On* each : {&here, &there})
        for (int k = 0; k < 2; k++)
            each->integrator.setReferenceMonitorValue(values[k], k);
    for (On* each : {&here, &there})
        each->integrator.step(900);
    ASSERT(there.integrator.getStepDensity() > 1.5);
    ASSERT_EQUAL(there.integrator.getNumForceEvaluations(), here.integrator.getNumForceEvaluations());
    requireAgreement(there, here, choose(1e-8, 1e-3, 1), choose(1e-6, 1e-1, 1));
    load(next.context, save(here.context));
    for (On* each : {&here, &next})
        each->integrator.step(20);
    requireAgreement(next, here, choose(1e-9, 1e-3, 1), choose(1e-6, 1e-1, 1));
    load(here.context, save(next.context));
    for (On* each : {&here, &next})
        each->integrator.step(20);
    ASSERT(here.integrator.isOnDevice());
    requireAgreement(next, here, choose(1e-9, 1e-3, 1), choose(1e-6, 1e-1, 1));
}

} // namespace

int main(int argc, char** argv) {
    return runOnPlatform(
        {{"agreement with Reference", testAgreement},
         {"States move between platforms", testStatesMove},
         {"reversal", testReversal},
         {"energies in between", testEnergiesInBetween},
         {"a barostat", [] { testBarostat(false); }},
         {"a barostat and automatic step control", [] { testBarostat(true); }},
         {"thermostats and automatic step control", testAutomaticControlUnderThermostats},
         {"a failure in the middle of a block", testFailureInTheMiddle},
         {"a rod of expressions and distances", testRod},
         {"expressions in a periodic box", testExpressionsInABox},
         {"automatic step control of expressions in a periodic box", testAutomaticControlOfExpressions}},
        argc, argv);
}
