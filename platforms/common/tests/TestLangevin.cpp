// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// VariableStepRattleLangevinIntegrator on a GPU against Reference: with the same noise, in calm phases and where there are substeps.

#include "GpuTests.h"

#include "openmm/CMMotionRemover.h"
#include "openmm/Context.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/NonbondedForce.h"
#include "openmm/VirtualSite.h"
#include "openmm/serialization/XmlSerializer.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include <cmath>
#include <random>

using namespace OpenMMVRattle;
using namespace OpenMM;
using std::vector;

namespace {

std::string precision() {
    return getTestPlatform().getPropertyDefaultValue("Precision");
}

double choose(double inDouble, double inMixed, double inSingle) {
    return precision() == "double" ? inDouble : precision() == "mixed" ? inMixed : inSingle;
}

// Rigid water in a triclinic box, a site in it, a particle that does not move, and a chain that is one large cluster.
struct Waters {
    System system;
    vector<Vec3> positions, velocities;
    NonbondedForce* nonbonded;
    int numWaters;

    explicit Waters(int numWaters, int chain = 0) : nonbonded(new NonbondedForce()), numWaters(numWaters) {
        const double edge = 2.4;
        system.setDefaultPeriodicBoxVectors(Vec3(edge, 0, 0), Vec3(0.3, edge, 0), Vec3(-0.2, 0.4, edge));
        nonbonded->setNonbondedMethod(NonbondedForce::CutoffPeriodic);
        nonbonded->setCutoffDistance(0.88); // at 0.9 nm are pairs that rounding decides about
        nonbonded->setUseSwitchingFunction(true);
        nonbonded->setSwitchingDistance(0.7);
        std::mt19937 random(11);
        std::normal_distribution<double> normal;
        const double charges[] = {-0.834, 0.417, 0.417};
        auto add = [&](double mass, const Vec3& position, double charge, double sigma, double epsilon) {
            nonbonded->addParticle(charge, sigma, epsilon);
            positions.push_back(position);
            velocities.push_back(
                mass == 0 ? Vec3() : Vec3(normal(random), normal(random), normal(random)) * std::sqrt(2.5 / mass));
            return system.addParticle(mass);
        };
        auto join = [&](int i, int j) {
            const Vec3 r = positions[i] - positions[j];
            system.addConstraint(i, j, std::sqrt(r.dot(r)));
            nonbonded->addException(i, j, 0, 1, 0);
        };
        for (int i = 0; i < numWaters; i++) {
            // In an order that has nothing to do with where they are.
            const int place = i * 29 % 64;
            const Vec3 centre(edge / 4 * (place % 4) + 0.05, edge / 4 * (place / 4 % 4),
                              edge / 4 * (place / 16) - 0.02);
            const Vec3 offsets[] = {Vec3(), Vec3(0.0957, 0, 0), Vec3(-0.024, 0.0927, 0)};
            const int first = (int) positions.size();
            for (int j = 0; j < 3; j++)
                add(j == 0 ? 16 : 1, centre + offsets[j], charges[j], j == 0 ? 0.3125 : 1.0, j == 0 ? 0.5625 : 0.0);
            join(first, first + 1);
            join(first, first + 2);
            join(first + 1, first + 2);
        }
        const int site = add(0, positions[0] * 0.3 + positions[4] * 0.7, 0.05, 0.3, 0.1);
        system.setVirtualSite(site, new TwoParticleAverageSite(0, 4, 0.3, 0.7));
        for (int i : {0, 1, 2, 3, 4, 5})
            nonbonded->addException(i, site, 0, 1, 0);
        add(0, Vec3(1.2, 1.1, 2.25), -0.1, 0.25, 0.25);
        for (int i = 0; i <= chain && chain > 0; i++) {
            const int particle = add(12, Vec3(0.3 + 0.1 * i, 0.3 + 0.05 * (i % 2), 0.3 + 0.02 * i), 0, 0.1, 0.1);
            if (i > 0)
                join(particle - 1, particle);
            if (i > 1)
                nonbonded->addException(particle - 2, particle, 0, 1, 0);
        }
        system.addForce(nonbonded);
    }
};

struct Run {
    VariableStepRattleLangevinIntegrator integrator;
    Context context;
    Run(const Waters& t, Platform& platform, double stepSize = 0.002, double friction = 2) :
            integrator(configured(stepSize, friction)), context(t.system, integrator, platform) {
    }
    static VariableStepRattleLangevinIntegrator configured(double stepSize, double friction) {
        VariableStepRattleLangevinIntegrator result(300, friction, stepSize);
        result.setRandomNumberSeed(5);
        result.setConstraintTolerance(choose(1e-10, 1e-8, 1e-5));
        return result;
    }
    void begin(const Waters& t) {
        context.setPositions(t.positions);
        context.setVelocities(t.velocities);
    }
    vector<Vec3> positions() {
        return context.getState(State::Positions).getPositions();
    }
    std::string save() {
        const State state =
            context.getState(State::Positions | State::Velocities | State::Parameters | State::IntegratorParameters);
        std::stringstream text;
        XmlSerializer::serialize<State>(&state, "State", text);
        return text.str();
    }
    void load(const std::string& xml) {
        std::stringstream text(xml);
        std::unique_ptr<State> state(XmlSerializer::deserialize<State>(text));
        context.setState(*state);
    }
    double kineticEnergy() {
        return context.getState(State::Energy).getKineticEnergy();
    }
};

Platform& reference() {
    return Platform::getPlatform("Reference");
}

// From one state in the middle of a run: one step, and a hundred, in which particles leave the box and the atoms are reordered.
void testAgreement() {
    for (int chain : {0, 12}) {
        const Waters t(chain == 0 ? 48 : 8, chain);
        Run there(t, reference()), here(t, getTestPlatform());
        for (Run* each : {&there, &here}) {
            each->begin(t);
            each->integrator.step(1); // which the host takes
        }
        ASSERT(largestDifference(there.positions(), here.positions()) <= choose(1e-9, 1e-6, 1e-5));
        there.integrator.step(99);
        const std::string xml = there.save();
        there.load(xml);
        here.load(xml);
        for (int steps : {1, 99}) {
            const long long substepped = here.integrator.getNumSubstepped();
            const long long before =
                there.integrator.getNumForceEvaluations() - here.integrator.getNumForceEvaluations();
            for (Run* each : {&there, &here})
                each->integrator.step(steps);
            ASSERT_EQUAL(substepped, here.integrator.getNumSubstepped());
            const double bound = steps == 1 ? choose(1e-9, 1e-6, 1e-5) : choose(1e-6, 1e-3, 1e-1);
            ASSERT(largestDifference(there.positions(), here.positions()) <= bound);
            const double fraction = steps == 1 ? choose(1e-6, 1e-5, 1e-4) : choose(1e-4, 1e-2, 1e-1);
            ASSERT_EQUAL_TOL(there.kineticEnergy(), here.kineticEnergy(), fraction);
            ASSERT_EQUAL_TOL(there.integrator.getMonitorValue(), here.integrator.getMonitorValue(), fraction);
            ASSERT_EQUAL_TOL(there.integrator.getReferenceMonitorValue(), here.integrator.getReferenceMonitorValue(),
                             1e-9);
            ASSERT_EQUAL_TOL(there.context.getTime(), here.context.getTime(), 1e-6);
            ASSERT_EQUAL(there.context.getStepCount(), here.context.getStepCount());
            ASSERT_EQUAL(before, there.integrator.getNumForceEvaluations() - here.integrator.getNumForceEvaluations());
        }
    }
}

// Two waters on top of each other: what is substepped is the same, and so is what becomes of it.
void testClash() {
    Waters t(27);
    for (int j = 0; j < 3; j++)
        t.positions[3 + j] = t.positions[j] + Vec3(0.02, 0.05, 0.19);
    Run there(t, reference()), here(t, getTestPlatform());
    for (Run* each : {&there, &here})
        each->begin(t);
    for (int steps : {1, 1, 1, 5, 12}) {
        for (Run* each : {&there, &here})
            each->integrator.step(steps);
        ASSERT_EQUAL(there.integrator.getNumSubstepped(), here.integrator.getNumSubstepped());
        ASSERT_EQUAL(there.integrator.getLargestSubsteps(), here.integrator.getLargestSubsteps());
        ASSERT_EQUAL_TOL(there.integrator.getReferenceMonitorValue(), here.integrator.getReferenceMonitorValue(), 1e-6);
        ASSERT(largestDifference(there.positions(), here.positions()) <= choose(1e-4, 1e-2, 1e-1));
    }
    ASSERT(here.integrator.getNumSubstepped() > 0);
    ASSERT(here.integrator.getNumSubstepped() < 20);
}

// Steps that turn out to need substeps when many more have been asked for, among them one after which the atoms were reordered: with the
// reference a little above U, that is so again and again.
void testSubstepsInBetween() {
    Waters t(27);
    t.system.addForce(new CMMotionRemover(1)); // what it does before steps that are taken again is done again
    Run there(t, reference()), here(t, getTestPlatform()), oneByOne(t, getTestPlatform());
    there.begin(t);
    there.integrator.step(20);
    const std::string xml = there.save();
    for (Run* each : {&there, &here, &oneByOne})
        each->load(xml);
    const double u = there.integrator.getMonitorValue();
    for (Run* each : {&there, &here, &oneByOne})
        each->integrator.setReferenceMonitorValue(u / 3.26);
    for (int steps : {1, 30}) {
        for (Run* each : {&there, &here})
            each->integrator.step(steps);
        for (int i = 0; i < steps; i++)
            oneByOne.integrator.step(1);
        ASSERT_EQUAL(there.integrator.getNumSubstepped(), here.integrator.getNumSubstepped());
        ASSERT_EQUAL(there.context.getStepCount(), here.context.getStepCount());
        ASSERT_EQUAL_TOL(there.context.getTime(), here.context.getTime(), 1e-6);
        ASSERT(largestDifference(there.positions(), here.positions()) <= choose(1e-6, 1e-3, 1e-1));
        // Whether many steps are asked for at once makes no difference but rounding.
        ASSERT_EQUAL(here.integrator.getNumSubstepped(), oneByOne.integrator.getNumSubstepped());
        ASSERT(largestDifference(here.positions(), oneByOne.positions()) <= choose(1e-10, 1e-3, 1e-1));
    }
    ASSERT(here.integrator.getNumSubstepped() > 5);
    ASSERT(here.integrator.getNumSubstepped() < 45);
}

// A State goes from Reference to the GPU, on, and back, and the noise goes on.
void testStatesMove() {
    const Waters t(27, 12);
    Run all(t, reference()), first(t, reference()), second(t, getTestPlatform()), third(t, reference());
    all.begin(t);
    all.integrator.step(100);
    const std::string xml = all.save();
    all.load(xml);
    all.integrator.step(15);
    second.load(xml);
    second.integrator.step(5);
    third.load(second.save());
    third.integrator.step(5);
    // A checkpoint in between changes nothing.
    std::stringstream checkpoint;
    second.load(third.save());
    second.integrator.step(2);
    second.context.createCheckpoint(checkpoint);
    second.integrator.step(3);
    const vector<Vec3> positions = second.positions();
    ASSERT(largestDifference(all.positions(), positions) <= choose(1e-8, 1e-5, 1e-3));
    second.context.loadCheckpoint(checkpoint);
    second.integrator.step(3);
    ASSERT(largestDifference(second.positions(), positions) <= choose(1e-10, 1e-7, 1e-4));
}

// A barostat changes the state by itself.
void testBarostat() {
    Waters t(27, 12);
    auto* barostat = new MonteCarloBarostat(1.0, 300.0, 4);
    barostat->setRandomNumberSeed(3);
    t.system.addForce(barostat);
    Run run(t, getTestPlatform());
    run.begin(t);
    Vec3 box[3];
    for (int i = 0; i < 10; i++) {
        run.integrator.step(10);
        const vector<Vec3> positions = run.positions();
        for (int k = 0; k < t.system.getNumConstraints(); k++) {
            int first, second;
            double length;
            t.system.getConstraintParameters(k, first, second, length);
            const Vec3 r = positions[first] - positions[second];
            ASSERT_EQUAL_TOL(length, std::sqrt(r.dot(r)), choose(1e-9, 1e-6, 1e-4));
        }
    }
    run.context.getState(State::Positions).getPeriodicBoxVectors(box[0], box[1], box[2]);
    ASSERT(box[0][0] != 2.4);
    ASSERT_EQUAL(100, run.context.getStepCount());
}

// The temperature of rigid water, within four of its standard errors (which blocks tell); a remover of the motion of the centre of mass
// acts in between.
void testTemperature() {
    Waters t(64);
    t.system.addForce(new CMMotionRemover(10));
    Run run(t, getTestPlatform(), 0.004, 20);
    run.begin(t);
    run.integrator.step(200);
    const int numBlocks = 20, numSamples = 10;
    const double degrees = 6.0 * t.numWaters - 3;
    double sum = 0, squares = 0;
    for (int block = 0; block < numBlocks; block++) {
        double mean = 0;
        for (int i = 0; i < numSamples; i++) {
            run.integrator.step(10);
            mean += 2 * run.kineticEnergy() / (degrees * BOLTZMANN * numSamples);
        }
        sum += mean / numBlocks;
        squares += mean * mean / numBlocks;
    }
    const double error = std::sqrt((squares - sum * sum) / (numBlocks - 1));
    std::cout << "temperature " << sum << " +- " << error << " K, " << run.integrator.getNumSubstepped()
              << " steps with substeps, " << run.integrator.getNumForceEvaluations() << " evaluations" << std::endl;
    ASSERT(error < 4);
    ASSERT(std::fabs(sum - 300) < 4 * error);
}

// Walls that no step goes through, in the middle of many: the state is that before the step, and the run goes on without them.
void testFailure() {
    Waters t(8);
    auto* wall = new CustomExternalForce("1e12*x*(step(x-middle-0.01)+step(middle-0.01-x))*isThere");
    wall->addGlobalParameter("middle", t.positions[0][0]);
    wall->addGlobalParameter("isThere", 0);
    wall->addParticle(0);
    t.system.addForce(wall);
    Run run(t, getTestPlatform()), stopped(t, getTestPlatform());
    for (Run* each : {&run, &stopped}) {
        each->integrator.setMaximumSubsteps(1);
        each->begin(t);
        each->integrator.step(20);
        each->context.setParameter("middle", each->positions()[0][0]);
        each->context.setParameter("isThere", 1);
    }
    assertThrows("the force on particle 0 became infinite or not a number", [&] { run.integrator.step(400); });
    const long long count = run.context.getStepCount();
    ASSERT(count > 21 && count < 400);
    stopped.integrator.step((int) count - 20);
    const double rounding = choose(1e-12, 1e-7, 1e-5);
    ASSERT(largestDifference(stopped.positions(), run.positions()) <= rounding);
    ASSERT_EQUAL_TOL(stopped.context.getTime(), run.context.getTime(), 1e-6);
    for (Run* each : {&run, &stopped}) {
        each->context.setParameter("isThere", 0);
        each->integrator.step(5);
    }
    ASSERT(largestDifference(stopped.positions(), run.positions()) <= 1000 * rounding);
}

// Dumbbells and chains of ten whose bonds are expressions, in a field: steps are taken by the device, agree with Reference, those with
// substeps in between as well; and the temperature, within four of its standard errors, along the bonds and across them.
void testExpressions() {
    const double masses[] = {14, 3}, length = 0.12, stepSize = 0.004;
    const char distance[] = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-r";
    const int numDumbbells = 150, numChains = 15, chainSize = 10;
    System system;
    vector<Vec3> positions;
    auto* field = new CustomExternalForce("20*(x^2+y^2+z^2)+3*cos(9*x)*sin(7*y+5*z)");
    VariableStepRattleLangevinIntegrator settings(300, 20, stepSize);
    settings.setRandomNumberSeed(5);
    settings.setConstraintTolerance(choose(1e-10, 1e-8, 1e-5));
    auto add = [&](const Vec3& position) {
        positions.push_back(position);
        const int index = system.addParticle(masses[positions.size() % 2]);
        field->addParticle(index);
        return index;
    };
    for (int i = 0; i < numDumbbells + numChains; i++) {
        Vec3 place(0.3 * std::cos(i), 0.3 * std::sin(2 * i), 0.3 * std::sin(i + 1));
        for (int j = 0; j < (i < numDumbbells ? 2 : chainSize); j++) {
            const int index = add(place);
            place += Vec3(j % 2 == 0 ? 0.8 : 0.6, j % 2 == 0 ? 0.6 : -0.8, 0) * length;
            if (j > 0)
                settings.addConstraint(distance, {index - 1, index}, {{"r", length}});
        }
    }
    system.addForce(field);
    VariableStepRattleLangevinIntegrator integrators[2] = {settings, settings};
    Context there(system, integrators[0], reference()), here(system, integrators[1], getTestPlatform());
    Context* contexts[] = {&there, &here};
    for (Context* context : contexts) {
        context->setPositions(positions);
        context->setVelocitiesToTemperature(300, 7);
    }
    const auto positionsOf = [](Context& context) { return context.getState(State::Positions).getPositions(); };
    const auto requireAgreement = [&](int steps, double distanceBound, double fraction) {
        for (auto& integrator : integrators)
            integrator.step(steps);
        ASSERT_EQUAL(integrators[0].getNumSubstepped(), integrators[1].getNumSubstepped());
        ASSERT(largestDifference(positionsOf(there), positionsOf(here)) <= distanceBound);
        ASSERT_EQUAL_TOL(there.getState(State::Energy).getKineticEnergy(),
                         here.getState(State::Energy).getKineticEnergy(), fraction);
        ASSERT_EQUAL_TOL(integrators[0].getMonitorValue(), integrators[1].getMonitorValue(), fraction);
    };
    requireAgreement(1, choose(1e-9, 1e-6, 1e-5), choose(1e-6, 1e-5, 1e-4));
    requireAgreement(60, choose(1e-8, 1e-4, 1e-2), choose(1e-5, 1e-2, 1e-1));
    ASSERT(integrators[1].isOnDevice());
    const long long before = integrators[0].getNumSubstepped();
    const double u = integrators[0].getMonitorValue();
    for (auto& integrator : integrators)
        integrator.setReferenceMonitorValue(u / 3.26);
    requireAgreement(20, choose(1e-8, 1e-3, 1e-1), choose(1e-5, 1e-2, 1e-1));
    ASSERT(integrators[0].getNumSubstepped() > before + 2);
    ASSERT(integrators[0].getNumSubstepped() < before + 20);
    for (auto& integrator : integrators)
        integrator.setReferenceMonitorValue(3 * u);
    // A bond that is pulled, and let go on the device.
    for (const double pulled : {1.01 * length, length}) {
        for (auto& integrator : integrators)
            integrator.setExpressionParameterValue(3, "r", pulled);
        requireAgreement(5, choose(1e-8, 1e-3, 1e-1), choose(1e-5, 1e-2, 1e-1));
        ASSERT(integrators[1].isOnDevice());
    }

    const int numBlocks = 20, numSamples = 15;
    const double degrees[] = {3.0 * numDumbbells, 2.0 * numDumbbells, (2.0 * chainSize + 1) * numChains};
    double sums[3] = {}, squares[3] = {};
    for (int block = 0; block < numBlocks; block++) {
        double means[3] = {}; // of the centres of dumbbells, of their rotation, and of chains
        for (int sample = 0; sample < numSamples; sample++) {
            integrators[1].step(10);
            const State state = here.getState(State::Positions | State::Velocities);
            const vector<Vec3>&q = state.getPositions(), &v = state.getVelocities();
            for (int i = 0; i < 2 * numDumbbells; i += 2) {
                const double m1 = system.getParticleMass(i), m2 = system.getParticleMass(i + 1);
                const Vec3 centre = (v[i] * m1 + v[i + 1] * m2) / (m1 + m2), relative = v[i] - v[i + 1],
                           r = q[i] - q[i + 1];
                means[0] += (m1 + m2) * centre.dot(centre);
                means[1] += m1 * m2 / (m1 + m2) * relative.dot(relative);
                ASSERT(std::fabs(r.dot(relative)) <= choose(1e-8, 1e-6, 1e-3)); // of some 0.1 nm^2/ps
                ASSERT_EQUAL_TOL(length, std::sqrt(r.dot(r)), choose(1e-9, 1e-6, 1e-4));
            }
            for (size_t i = 2 * numDumbbells; i < v.size(); i++)
                means[2] += system.getParticleMass((int) i) * v[i].dot(v[i]);
        }
        for (int k = 0; k < 3; k++) {
            const double temperature = means[k] / (numSamples * degrees[k] * BOLTZMANN);
            sums[k] += temperature / numBlocks;
            squares[k] += temperature * temperature / numBlocks;
        }
    }
    for (int k = 0; k < 3; k++) {
        const double error = std::sqrt((squares[k] - sums[k] * sums[k]) / (numBlocks - 1));
        std::cout << "temperature " << sums[k] << " +- " << error << " K" << std::endl;
        ASSERT(error < 3);
        ASSERT(std::fabs(sums[k] - 300) < 4 * error);
    }
    ASSERT(integrators[1].isOnDevice());
}

} // namespace

int main(int argc, char** argv) {
    return runOnPlatform({{"agreement with Reference", testAgreement},
                          {"a clash", testClash},
                          {"substeps in between", testSubstepsInBetween},
                          {"States move between platforms", testStatesMove},
                          {"a barostat", testBarostat},
                          {"temperature", testTemperature},
                          {"failure", testFailure},
                          {"constraints by expression", testExpressions}},
                         argc, argv);
}
