// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The steps on a device against VRattleRun, from the same state in the middle of a run.

#include "DeviceSteps.h"
#include "ExpressionCode.h"
#include "ExpressionTexts.h"
#include "TestSupport.h"
#include "expressions/ExpressionGroup.h"
#include "openmm/Context.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/Integrator.h"
#include "openmm/internal/ContextImpl.h"
#include "openmm/opencl/OpenCLPlatform.h"
#include "run/VRattleRun.h"
#include "step/LangevinDynamics.h"
#include <cmath>
#include <memory>
#include <random>
#include <set>

using namespace OpenMMVRattle;
using OpenMM::Context;
using OpenMM::ContextImpl;
using OpenMM::System;
using OpenMM::Vec3;
using std::vector;

namespace {

// An integrator that lends its Context.
class Lender : public OpenMM::Integrator {
public:
    ContextImpl& getContext() {
        return *context;
    }
    OpenMM::ComputeContext& getDevice() {
        auto* data = static_cast<OpenMM::OpenCLPlatform::PlatformData*>(context->getPlatformData());
        return *reinterpret_cast<OpenMM::ComputeContext*>(data->contexts[0]);
    }
    void step(int) override {
    }

protected:
    void initialize(ContextImpl& contextRef) override {
        context = &contextRef;
        owner = &contextRef.getOwner();
        getDevice().initializeContexts();
    }
    vector<std::string> getKernelNames() override {
        return {};
    }
    double computeKineticEnergy() override {
        return 0;
    }
};

// Clusters of many graphs, and free particles, in a field that ties them together.
struct Molecules {
    System system;
    vector<Vec3> positions, velocities;
    vector<double> masses;
    vector<DistanceConstraint> constraints;
    vector<ExpressionConstraint> expressions;
    std::mt19937 random;

    OpenMM::CustomExternalForce* field;

    explicit Molecules(int copies) : random(7) {
        field = new OpenMM::CustomExternalForce("strength*(200*(x^2+y^2+z^2)+80*cos(9*x)*sin(7*y+5*z))");
        field->addGlobalParameter("strength", 1);
        auto* bonds = new OpenMM::HarmonicBondForce();
        const vector<vector<std::pair<int, int>>> graphs = {
            {{0, 1}, {0, 2}, {1, 2}},                                                         // water
            {{0, 1}},                                                                         // X-H
            {{0, 1}, {0, 2}, {0, 3}},                                                         // XH3
            {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 6}, {6, 7}, {7, 8}},                 // a chain
            {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}},                                 // a rigid tetrahedron
            {{0, 1}, {1, 2}, {2, 3}, {3, 0}, {0, 4}, {1, 5}},                                 // a ring with tails
            {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}, {3, 4}, {4, 5}},                 // with a tail
            {}};
        std::uniform_real_distribution<double> uniform(-1, 1);
        for (int copy = 0; copy < copies; copy++)
            for (const auto& graph : graphs) {
                int numAtoms = 1;
                for (const auto& pair : graph)
                    numAtoms = std::max(numAtoms, std::max(pair.first, pair.second) + 1);
                const int first = system.getNumParticles();
                const Vec3 centre(uniform(random), uniform(random), uniform(random));
                for (int i = 0; i < numAtoms; i++) {
                    // On a coil, so that no set of bonds is flat.
                    const Vec3 place(0.1 * std::cos(1.9 * i), 0.1 * std::sin(1.9 * i), 0.04 * i + 0.02 * (i % 3));
                    addParticle(i % 3 == 1 ? 1.0 : 12.0 + i, centre + place);
                    field->addParticle(first + i);
                }
                for (const auto& pair : graph)
                    addConstraint(first + pair.first, first + pair.second);
                if (first > 0)
                    bonds->addBond(first - 1, first, 0.5, 500);
            }
        addParticle(0, Vec3(0.1, 0.2, 0.3)); // does not move
        auto* wells = new OpenMM::CustomExternalForce("0.01*x^2");
        wells->addParticle(0);
        wells->setForceGroup(1); // of the monitor
        for (OpenMM::Force* force : std::initializer_list<OpenMM::Force*>{field, bonds, wells})
            system.addForce(force);
    }
    // A molecule of many bonds, each particle beside one to which it is bound, or where it is given.
    void addLarge(const vector<std::pair<int, int>>& bonds, double lightest = 1, const vector<Vec3>& places = {}) {
        int numAtoms = 0;
        for (const auto& bond : bonds)
            numAtoms = std::max(numAtoms, std::max(bond.first, bond.second) + 1);
        const int first = system.getNumParticles();
        std::uniform_real_distribution<double> uniform(-1, 1);
        for (int i = 0; i < numAtoms; i++) {
            Vec3 place = places.empty() ? Vec3() : places[i];
            for (const auto& bond : bonds)
                if (places.empty() && std::max(bond.first, bond.second) == i) {
                    const Vec3 other = positions[first + std::min(bond.first, bond.second)];
                    Vec3 step;
                    do {
                        step = Vec3(uniform(random), uniform(random), uniform(random));
                        step *= 0.13 / std::sqrt(step.dot(step));
                        place = other + step;
                    } while (place.dot(place) > 1);
                    break;
                }
            addParticle(i % 3 == 1 ? lightest : 12.0 + i % 10, place);
            field->addParticle(first + i);
        }
        for (const auto& bond : bonds)
            addConstraint(first + bond.first, first + bond.second);
    }
    void addParticle(double mass, const Vec3& position) {
        std::normal_distribution<double> normal(0, mass > 0 ? std::sqrt(2.5 / mass) : 0.0);
        system.addParticle(mass);
        masses.push_back(mass);
        positions.push_back(position);
        velocities.push_back(Vec3(normal(random), normal(random), normal(random)));
    }
    // An expression is held at what it is.
    void addExpression(const std::string& expression, const vector<int>& particles) {
        ExpressionConstraint constraint = {"-held + " + expression, particles, {{"held", 0.0}}};
        ExpressionGroup group(constraint);
        group.add(constraint, 0, 0, 0, vector<double>(masses.size(), 1.0));
        group.compile();
        vector<double> value(1);
        ExpressionParameters atRest;
        atRest.values = atRest.rates = {0.0};
        group.evaluate(positions, atRest, value, 0, 1);
        constraint.parameters["held"] = value[0];
        expressions.push_back(constraint);
    }
    ClusterLayout findLayout() const {
        return ClusterLayout(masses, constraints, expressions);
    }
    void addConstraint(int i, int j) {
        const Vec3 r = positions[i] - positions[j];
        system.addConstraint(i, j, std::sqrt(r.dot(r)));
        constraints.push_back({i, j, std::sqrt(r.dot(r))});
    }
};

const double NO_LIMIT = std::numeric_limits<double>::infinity();

// VRattleRun and DeviceSteps side by side; both get their forces from one Context on OpenCL.
struct Both {
    Lender lender;
    Context context;
    VRattleRun dynamics;
    DeviceSteps device;
    vector<ExpressionConstraint> expressions; // with the parameters that the next step leads to
    StepSettings settings;

    Both(const Molecules& molecules, const std::string& precision) :
            context(molecules.system, lender, OpenMM::Platform::getPlatform("OpenCL"), {{"Precision", precision}}),
            dynamics(molecules.masses, molecules.constraints, molecules.expressions),
            device(lender.getDevice(), dynamics.getConstraintSystem().getLayout(), molecules.expressions),
            expressions(molecules.expressions), settings() {
    }
    void move(int expression, const std::string& name, double change) {
        std::map<std::string, double>& parameters = expressions[expression].parameters;
        parameters.at(name) += change;
        dynamics.setParameters(expression, parameters);
        device.moveParameters(expressions);
    }
    ExpressionParameters getHostParameters() const {
        return dynamics.getConstraintSystem().toGivenOrder(dynamics.getParameters());
    }
    // theta[n], its rates, and the multipliers of expressions.
    void requireParametersToAgree(double fraction) {
        const ExpressionParameters expected = getHostParameters(), found = device.getParameters();
        ASSERT_EQUAL(expected.isMoving, found.isMoving);
        ASSERT(expected.values == found.values);
        vector<double> multipliers;
        dynamics.getConstraintSystem().getGivenMultipliers(dynamics.getMultipliers(), multipliers);
        multipliers.erase(multipliers.begin(), multipliers.end() - expressions.size());
        requireNumbersToAgree(expected.rates, found.rates, fraction, "rate");
        requireNumbersToAgree(multipliers, device.getExpressionMultipliers(), fraction, "multiplier");
    }
    // To a fraction of the largest.
    static void requireNumbersToAgree(const vector<double>& expected, const vector<double>& found, double fraction,
                                      const std::string& name) {
        double largest = 0;
        ASSERT_EQUAL(expected.size(), found.size());
        for (double value : expected)
            largest = std::max(largest, std::fabs(value));
        for (size_t k = 0; k < expected.size(); k++)
            requireAtMost(fraction * largest, std::fabs(expected[k] - found[k]), name + " " + std::to_string(k));
    }
    // Some steps on the host, then the state goes to the device.
    void start(const Molecules& molecules, StepDensity::Update update, const vector<StepMonitor::Term>& terms) {
        const double h = 0.001;
        settings = {h, h / 50, 2 * h, DeviceSteps::tolerableTolerance(lender.getDevice(), 1e-12), update, terms, false};
        dynamics.setSettings(settings);
        vector<Vec3> forces = forcesAt(molecules.positions);
        dynamics.begin(molecules.positions, molecules.velocities, forces, groupEnergy());
        for (int i = 0; i < 5; i++)
            stepOnHost();
        handOver();
    }
    // The same with automatic step control; references of 0 are to be found, in so many steps.
    void startAutomatic(const Molecules& molecules, int learningSteps, double onStep, double halfStep) {
        start(molecules, StepDensity::Explicit, {});
        settings.isAutomatic = true;
        settings.automaticReferences[0] = onStep;
        settings.automaticReferences[1] = halfStep;
        settings.calibrationSteps = learningSteps;
        settings.automaticRequest++;
        dynamics.setSettings(settings);
        vector<Vec3> forces = forcesAt(molecules.positions);
        dynamics.begin(molecules.positions, molecules.velocities, forces, 0);
        for (int i = 0; i < 5; i++)
            stepOnHost();
        handOver();
    }
    void handOver() {
        const VRattleRun::Memory memory = dynamics.getMemory();
        const double energy = groupEnergyAt(dynamics.getPositions());
        computeForces();
        context.setVelocities(dynamics.getVelocities());
        DeviceSteps::Settings to = {settings};
        if (settings.isAutomatic) {
            to.choice = dynamics.getAutomaticControl().getChoice();
            to.numDegreesOfFreedom = dynamics.getAutomaticControl().getNumDegreesOfFreedom();
            device.setSettings(to);
            DeviceSteps::State state = {memory.rho, 0, false, 0, memory.automatic};
            std::copy(memory.references.begin(), memory.references.end(), state.references);
            ASSERT(device.begin(state, energy));
            return;
        }
        for (size_t k = 0; k < to.terms.size(); k++)
            to.terms[k].reference = memory.references[k];
        device.setSettings(to);
        const ExpressionParameters theta = getHostParameters();
        ASSERT(device.begin({memory.rho, memory.densityOffset, memory.hasHalfStepValue, memory.halfStepValue}, energy,
                            &theta));
    }
    // To be asked for before the forces, which it overwrites.
    double groupEnergy() {
        return 2.5 + lender.getContext().calcForcesAndEnergy(false, true, 2);
    }
    double groupEnergyAt(const vector<Vec3>& positions) {
        context.setPositions(positions);
        return groupEnergy();
    }
    void computeForces() {
        lender.getContext().calcForcesAndEnergy(true, false, 1);
    }
    vector<Vec3> forcesAt(const vector<Vec3>& positions) {
        context.setPositions(positions);
        computeForces();
        vector<Vec3> forces;
        lender.getContext().getForces(forces);
        return forces;
    }
    void stepOnHost(double maxStep = NO_LIMIT) {
        vector<Vec3> forces;
        do {
            dynamics.step(maxStep);
            forces = forcesAt(dynamics.getNextPositions());
        } while (!dynamics.finish(forces, groupEnergyAt(dynamics.getNextPositions())));
    }
    void stepOnDevice(double maxStep = NO_LIMIT) {
        device.advance(maxStep);
        const double energy = groupEnergy();
        computeForces();
        device.finish(energy);
    }
    vector<Vec3> positions() {
        return context.getState(OpenMM::State::Positions).getPositions();
    }
    vector<Vec3> velocities() {
        return context.getState(OpenMM::State::Velocities).getVelocities();
    }
    // The states of both are the same: to a distance (nm) and velocity (nm/ps), monitors and density to a fraction.
    void requireAgreement(const DeviceSteps::Report& report, double distance, double speed, double fraction) {
        ASSERT(!report.hasFailed);
        ASSERT_EQUAL(0, report.numRescues);
        requireAtMost(distance, largestDifference(positions(), dynamics.getPositions()), "positions");
        requireAtMost(speed, largestDifference(velocities(), dynamics.getVelocities()), "velocities");
        ASSERT_EQUAL(dynamics.getMonitorValues().size(), report.values.size());
        for (size_t k = 0; k < report.values.size(); k++)
            ASSERT_EQUAL_TOL(dynamics.getMonitorValues()[k], report.values[k], fraction);
        ASSERT_EQUAL_TOL(dynamics.getDensity(), report.state.density, fraction);
        vector<double> expected;
        dynamics.getConstraintSystem().getGivenMultipliers(dynamics.getMultipliers(), expected);
        // In mixed precision those of large clusters have a factor of floats, and residuals of doubles.
        const double closer = lender.getDevice().getUseMixedPrecision() ? 1 : 0.1;
        requireNumbersToAgree(expected, device.getMultipliers(), closer * fraction, "multiplier");
        if (settings.isAutomatic)
            requireAutomaticAgreement(report.state, fraction);
    }
    void requireAutomaticAgreement(const DeviceSteps::State& found, double fraction) {
        const AutomaticControl::Memory expected = dynamics.getMemory().automatic;
        const auto agree = [&](double a, double b) {
            ASSERT(std::fabs(a - b) <= fraction * std::max(1.0, std::fabs(a)));
        };
        for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++) {
            agree(expected.behind[k], found.automatic.behind[k]);
            agree(expected.ahead[k], found.automatic.ahead[k]);
            agree(expected.logarithms[k], found.automatic.logarithms[k]);
            ASSERT_EQUAL_TOL(dynamics.getReferences()[k], found.references[k], fraction);
        }
        ASSERT_EQUAL(expected.stepsSinceStart, found.automatic.stepsSinceStart);
        ASSERT_EQUAL(expected.numLearnt, found.automatic.numLearnt);
        agree(expected.temperature, found.automatic.temperature);
        ASSERT_EQUAL(expected.following, found.automatic.following);
        ASSERT_EQUAL(expected.shortSteps, found.automatic.shortSteps);
        ASSERT_EQUAL(expected.mostShortSteps, found.automatic.mostShortSteps);
    }
    // Steps of both, and the device's state is put back into the Context.
    void requireStepsToAgree(int count, double maxStep, double distance, double fraction) {
        for (int i = 0; i < count; i++)
            stepOnDevice(i == count - 1 ? maxStep : NO_LIMIT);
        const DeviceSteps::Report report = device.read();
        ASSERT_EQUAL(count, report.numSteps);
        const vector<Vec3> after = positions(), velocitiesAfter = velocities();
        for (int i = 0; i < count; i++)
            stepOnHost(i == count - 1 ? maxStep : NO_LIMIT);
        context.setPositions(after);
        context.setVelocities(velocitiesAfter);
        computeForces();
        requireAgreement(report, distance, 1000 * distance, fraction);
    }
};

vector<StepMonitor::Term> allMonitors() {
    vector<StepMonitor::Term> terms;
    for (int kind = StepMonitor::ConstraintMultipliers; kind <= StepMonitor::ForceGroupEnergy; kind++)
        terms.push_back({(StepMonitor::Kind) kind, 1 + 0.1 * kind, kind % 2 == 0 ? 1.0 : 0.7, 0.0, 8.0});
    terms.push_back({StepMonitor::ForcePNorm, 1.0, 1.0, 0.0, 2.5});
    return terms;
}

// From a state in the middle of a run: the first step, and 20, of which the last is cut short.
void testStepsAgree(const Molecules& molecules, const std::string& precision,
                    const vector<StepDensity::Update>& updates, double distance, double fraction) {
    Both both(molecules, precision);
    for (StepDensity::Update update : updates) {
        both.start(molecules, update, allMonitors());
        for (int i = 0; i < 20; i++) {
            both.stepOnDevice(i == 18 ? 0.0004 : NO_LIMIT);
            if (i == 0 || i == 18 || i == 19) {
                const DeviceSteps::Report report = both.device.read();
                ASSERT_EQUAL(i == 0 ? 1 : i == 18 ? 18 : 1, report.numSteps);
                const vector<Vec3> positions = both.positions(), velocities = both.velocities();
                for (int j = 0; j < report.numSteps; j++)
                    both.stepOnHost(i == 18 && j == report.numSteps - 1 ? 0.0004 : NO_LIMIT);
                both.context.setPositions(positions);
                both.context.setVelocities(velocities);
                both.computeForces();
                const double growth = i == 0 ? 1 : 100;
                both.requireAgreement(report, growth * distance, 1000 * growth * distance, growth * fraction);
            }
        }
        ASSERT(both.device.getNumIterations() >= 20);
    }
}

typedef vector<std::pair<int, int>> Bonds;

Bonds makeChain(int length) {
    Bonds bonds;
    for (int i = 0; i < length; i++)
        bonds.emplace_back(i, i + 1);
    return bonds;
}

Bonds makeRing(int length) {
    Bonds bonds = makeChain(length - 1);
    bonds.emplace_back(length - 1, 0);
    return bonds;
}

Bonds makeStar(int numArms, int length) {
    Bonds bonds;
    for (int i = 0; i < numArms * length; i++)
        bonds.emplace_back(i % length == 0 ? 0 : i, i + 1);
    return bonds;
}

// A chain whose next neighbours are bonded too.
Bonds makeStiffChain(int length) {
    Bonds bonds = makeChain(length);
    for (int i = 2; i <= length; i++)
        bonds.emplace_back(i - 2, i);
    return bonds;
}

// Tetrahedra in a row, each with a corner of the next.
Bonds makeTetrahedra(int count) {
    Bonds bonds;
    for (int i = 0; i < 3 * count; i += 3)
        for (int j = i; j < i + 4; j++)
            for (int k = i; k < j; k++)
                bonds.emplace_back(k, j);
    return bonds;
}

// A molecule like a protein: a backbone with side groups, each with a ring of five, and hydrogens.
Bonds makeProtein(int numResidues) {
    Bonds bonds;
    int next = 1, last = 0;
    auto add = [&](int to) {
        bonds.emplace_back(to, next);
        return next++;
    };
    for (int i = 0; i < numResidues; i++) {
        const int alpha = add(last), carbonyl = add(alpha);
        add(alpha);
        add(carbonyl);
        const int first = add(alpha), second = add(first), third = add(second), fourth = add(third),
                  fifth = add(fourth);
        bonds.emplace_back(first, fifth);
        for (int atom : {second, third, fourth})
            add(atom);
        last = add(carbonyl);
    }
    return bonds;
}

// The lattice of diamond, of so many cells along each edge.
Bonds makeDiamond(int edge, vector<Vec3>& places) {
    const double a = 0.3567;
    places.clear();
    for (int x = 0; x < 4 * edge; x++)
        for (int y = 0; y < 4 * edge; y++)
            for (int z = 0; z < 4 * edge; z++)
                if ((x % 2 == y % 2 && y % 2 == z % 2) && (x + y + z) % 4 < 2)
                    places.push_back(Vec3(x, y, z) * (a / 4));
    Bonds bonds;
    for (int i = 0; i < (int) places.size(); i++)
        for (int j = 0; j < i; j++) {
            const Vec3 r = places[i] - places[j];
            if (r.dot(r) < 0.2 * a * a)
                bonds.emplace_back(i, j);
        }
    return bonds;
}

Molecules makeMolecules(const vector<Bonds>& large) {
    Molecules molecules(1);
    for (const Bonds& bonds : large)
        molecules.addLarge(bonds);
    return molecules;
}

const char ANGLE[] = "acos(d/sqrt(a*b)); a=(x1-x2)^2+(y1-y2)^2+(z1-z2)^2; b=(x3-x2)^2+(y3-y2)^2+(z3-z2)^2;"
                     " d=(x1-x2)*(x3-x2)+(y1-y2)*(y3-y2)+(z1-z2)*(z3-z2)";
const char DISTANCE[] = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)";
const char DIFFERENCE[] = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2) - sqrt((x3-x4)^2+(y3-y4)^2+(z3-z4)^2)";

// Expressions of many kinds: alone, with distances, with a particle that has no mass, of many particles, and in a large cluster.
Molecules makeExpressions() {
    Molecules molecules(0);
    const int fixed = (int) molecules.masses.size() - 1; // has no mass
    auto addCoil = [&](int length) {
        const int first = (int) molecules.masses.size();
        molecules.addLarge(makeChain(length));
        return first;
    };
    auto addFree = [&](int count) {
        const int first = (int) molecules.masses.size();
        for (int i = 0; i < count; i++) {
            molecules.addParticle(3 + i, Vec3(0.3 * std::cos(1.7 * i) - 0.2, 0.3 * std::sin(1.7 * i), 0.05 * i));
            molecules.field->addParticle(first + i);
        }
        return first;
    };
    const int pendulum = addFree(3);
    molecules.addExpression(DISTANCE, {pendulum, fixed});
    molecules.addExpression(DISTANCE, {fixed, pendulum + 1});
    molecules.addExpression("x1^2+0.3*y1*z1", {pendulum + 2});
    molecules.addExpression("x1^2+0.7*y1*z1", {addFree(1)});
    molecules.addExpression("select(step(x1-5), log(-1-x1^2), tanh(x1+2*z1)*erf(y1)^3)", {pendulum + 2});
    const int angle = addFree(3);
    molecules.addExpression(ANGLE, {angle, angle + 1, angle + 2});
    const int rigid = addCoil(3);
    molecules.addExpression(ANGLE, {rigid, rigid + 1, rigid + 2});
    molecules.addExpression(DIFFERENCE, {rigid, rigid + 2, rigid + 1, rigid + 3});
    const int chain = addCoil(60);
    for (int i = 0; i < 58; i += 4)
        molecules.addExpression(ANGLE, {chain + i, chain + i + 1, chain + i + 2});
    molecules.addExpression(DIFFERENCE, {chain, chain + 60, chain + 20, chain + 40});
    const int cloud = addFree(40);
    std::string sum = "0";
    vector<int> members;
    for (int i = 0; i < 40; i++) {
        sum += "+x" + std::to_string(i + 1);
        members.push_back(cloud + i);
    }
    molecules.addExpression(sum, members);
    molecules.addLarge(makeChain(2)); // without
    return molecules;
}

const vector<StepDensity::Update> UPDATES = {StepDensity::SemiExplicit, StepDensity::Explicit, StepDensity::Bounded};

void testDiamond() {
    vector<Vec3> places;
    const Bonds bonds = makeDiamond(2, places);
    Molecules molecules(1);
    molecules.addLarge(bonds, 12, places);
    testStepsAgree(molecules, "double", {StepDensity::Explicit}, 1e-12, 1e-9);
}

// How the work is divided, which no result shows.
void testDivision() {
    const Molecules molecules = makeMolecules({makeProtein(60), makeChain(130), makeChain(1500)});
    LargeClusters::Limits limits = {128, 40 * 1024, 132, 32, 8, 4, 792, 64};
    const ClusterLayout layout = molecules.findLayout();
    const LargeClusters waiting(layout, limits);
    ASSERT(waiting.getForm().areRecords && waiting.getForm().isInLocalMemory && waiting.getForm().hasJoints);
    ASSERT(!waiting.getForm().isStaged);
    ASSERT(waiting.getNumLevels() <= 9);
    ASSERT(waiting.getNumJointLevels() <= 6);
    ASSERT(waiting.getNumJoints() <= 25); // about one for each piece
    ASSERT(16 * waiting.getLocalSize() <= 30 * 1024);
    // Each constraint is counted by one piece, each particle belongs to one.
    vector<int> counts(waiting.getNumConstraints(), 0), owners(molecules.masses.size(), 0);
    for (const LargeClusters::Row& row : waiting.getRows())
        if (row.number >= 0)
            counts[row.number]++;
    for (int atom : waiting.getAtoms())
        owners[atom]++;
    ASSERT(std::all_of(counts.begin(), counts.end(), [](int count) { return count == 1; }));
    for (const LargeClusters::Row& row : waiting.getRows())
        ASSERT(owners[row.atom1] == 1 && owners[row.atom2] == 1);
    limits.numResident = 0;
    const LargeClusters staged(layout, limits);
    ASSERT(staged.getForm().isStaged && !staged.getForm().isInLocalMemory && staged.getForm().areRecords);
    // Little memory gets smaller pieces.
    limits.numResident = 132;
    limits.localMemory = 20 * 1024;
    const LargeClusters little(layout, limits);
    ASSERT(little.getForm().isInLocalMemory && 16 * little.getLocalSize() <= limits.localMemory);
    ASSERT(little.getPieces().size() > waiting.getPieces().size());
    // Few processors get larger pieces.
    limits.localMemory = 40 * 1024;
    limits.numResident = 14;
    const LargeClusters few(layout, limits);
    ASSERT(!few.getForm().isStaged && few.getPieces().size() <= 15);
    // What is dense is left whole.
    const Molecules star = makeMolecules({makeStar(60, 1)});
    const LargeClusters dense(star.findLayout(), limits);
    ASSERT(!dense.getForm().areRecords && !dense.getForm().hasJoints && !dense.getForm().isInLocalMemory);
}

// The launches of a step, and the iterations.
void testNumLaunches() {
    for (int length : {20, 400}) {
        const Molecules molecules = makeMolecules({makeChain(length)});
        Both both(molecules, "double");
        both.start(molecules, StepDensity::Explicit, allMonitors());
        const bool isStaged = length == 400;
        ASSERT_EQUAL(isStaged, both.device.getLargeClusters().getForm().isStaged);
        const long long before = both.device.getNumLaunches(), iterations = both.device.getNumIterations();
        for (int i = 0; i < 10; i++)
            both.stepOnDevice();
        ASSERT_EQUAL(10 * (2 + (isStaged ? 3 + 16 : 2)), both.device.getNumLaunches() - before);
        ASSERT(!both.device.read().hasFailed);
        const double perStep = (double) (both.device.getNumIterations() - iterations) / 10;
        ASSERT(perStep >= 1 && perStep <= 8);
    }
}

// The same with expressions, how they are divided, and in how many levels they are eliminated.
void testDivisionOfExpressions() {
    const Molecules molecules = makeExpressions();
    Both both(molecules, "double");
    both.start(molecules, StepDensity::Explicit, allMonitors());
    const long long before = both.device.getNumLaunches(), iterations = both.device.getNumIterations();
    for (int i = 0; i < 10; i++)
        both.stepOnDevice();
    ASSERT_EQUAL(10 * 4, both.device.getNumLaunches() - before);
    ASSERT(!both.device.read().hasFailed);
    const double perStep = (double) (both.device.getNumIterations() - iterations) / 10;
    ASSERT(perStep >= 1 && perStep <= 8);
    const ExpressionClusters& clusters = both.device.getExpressionClusters();
    ASSERT_EQUAL(1, clusters.getParts().size()); // of 89 constraints
    // A ladder: sections of two particles that a distance joins, each joined to the next by two expressions. As a chain it halves in
    // each round, of up to three constraints that are coupled.
    vector<DistanceConstraint> ladder;
    vector<ExpressionConstraint> rungs;
    const int length = 1000;
    for (int i = 0; i < length; i++) {
        ladder.push_back({2 * i, 2 * i + 1, 0.1});
        for (int k = 0; k < (i > 0 ? 2 : 0); k++)
            rungs.push_back({"x1-x2-z3*y4+shift", {2 * i - 2, 2 * i - 1, 2 * i, 2 * i + 1}, {{"shift", 0.1 * k}}});
    }
    const ExpressionClusters chain(ClusterLayout(vector<double>(2 * length, 1.0), ladder, rungs), rungs);
    ASSERT_EQUAL(1, chain.getParts().size());
    ASSERT_EQUAL(3 * length - 2, chain.getNumConstraints());
    ASSERT(chain.getNumLevels() <= 60);
    ASSERT(chain.getNumFactorEntries() <= (size_t) 40 * length);
    // Small clusters share a work group.
    vector<ExpressionConstraint> spheres;
    for (int i = 0; i < 1000; i++)
        spheres.push_back({"x1^2+y1^2+z1^2-1", {i}, {}});
    const ExpressionClusters many(ClusterLayout(vector<double>(1000, 1.0), {}, spheres), spheres);
    ASSERT_EQUAL(8, many.getParts().size());
    ASSERT_EQUAL(1, many.getNumLevels());
}

// Parameters that begin to move, go on, turn back and stop, some of them, with steps that are cut short and several at once; and an angle
// that is set back by a full turn.
void testMovingParameters(const std::string& precision, const vector<StepDensity::Update>& updates, double distance,
                          double fraction) {
    Molecules molecules = makeExpressions();
    const int turning = (int) molecules.masses.size(), turn = (int) molecules.expressions.size();
    molecules.addParticle(3, Vec3(-0.4, 0.1, 0.2));
    molecules.field->addParticle(turning);
    molecules.expressions.push_back({"atan2(y1*cos(angle)-x1*sin(angle), x1*cos(angle)+y1*sin(angle))",
                                     {turning},
                                     {{"angle", std::atan2(0.1, -0.4)}}});
    Both both(molecules, precision);
    for (StepDensity::Update update : updates) {
        both.expressions = molecules.expressions;
        for (int i = 0; i <= turn; i++)
            both.dynamics.setParameters(i, both.expressions[i].parameters);
        both.dynamics.adoptParameters();
        both.start(molecules, update,
                   {{StepMonitor::ConstraintForce, 1.0, 1.0, 0.0}, {StepMonitor::VectorField, 0.5, 0.7, 0.0}});
        const long long uploads = both.device.getNumParameterUploads();
        int numMoves = 0;
        const auto moveAll = [&](double by) {
            for (int i = 0; i < turn; i++)
                if (i % 3 != 2 && i != 4) // whose gradient is small
                    both.move(i, "held", by * (1 + 0.1 * (i % 5)));
            both.move(turn, "angle", 10 * by);
            numMoves++;
        };
        const auto step = [&](int count, double maxStep, double growth) {
            try {
                both.requireStepsToAgree(count, maxStep, growth * distance, growth * fraction);
                both.requireParametersToAgree(100 * growth * fraction);
                ASSERT_EQUAL(0, both.dynamics.getNumRescues()); // which has no secant for (3.14), and gives up first
            }
            catch (const std::exception& e) {
                throw OpenMM::OpenMMException("update " + std::to_string(update) + ", after " +
                                              std::to_string(numMoves) + " moves: " + e.what());
            }
        };
        moveAll(8.5e-4);
        step(1, NO_LIMIT, 1);
        for (int i = 0; i < 5; i++) {
            moveAll(8.5e-4 + 1e-5 * i);
            const long long before = both.device.getNumLaunches();
            step(1, NO_LIMIT, 10);
            const int numTrials = update == StepDensity::SemiExplicit ? 3 : 0; // at least
            ASSERT(both.device.getNumLaunches() - before >= 2 + 4 + 2 * numTrials + 1);
            ASSERT(both.device.getNumLaunches() - before <= 2 + 4 + 4 * numTrials + 1);
        }
        moveAll(8.5e-4);
        both.move(turn, "angle", 8 * std::atan(1.0));
        step(1, NO_LIMIT, 10);
        moveAll(-3e-4);
        step(3, 0.0002, 100); // of which the first moves, and the last is cut short
        step(1, NO_LIMIT, 100);
        moveAll(2e-4);
        step(1, 0.0003, 100); // after which the rates are those of another step size
        moveAll(2e-4);
        step(1, NO_LIMIT, 100);
        // Not all at once: what stops and what goes on.
        both.move(0, "held", 3e-4);
        numMoves++;
        step(1, NO_LIMIT, 100);
        ASSERT_EQUAL(numMoves, both.device.getNumParameterUploads() - uploads);
        // A jump that no step can make leaves nothing behind, nor do the steps after it.
        const vector<Vec3> positions = both.positions(), velocities = both.velocities();
        both.move(0, "held", -5);
        for (int i = 0; i < 3; i++)
            both.stepOnDevice();
        const DeviceSteps::Report report = both.device.read();
        ASSERT(report.hasFailed);
        ASSERT_EQUAL(0, report.numSteps);
        ASSERT(both.positions() == positions);
        ASSERT(both.velocities() == velocities);
        ASSERT(both.device.getParameters().values == both.getHostParameters().values);
        ASSERT(both.device.getParameters().isMoving);
        both.expressions[0].parameters["held"] += 5;
        both.dynamics.setParameters(0, both.expressions[0].parameters);
        both.handOver();
        moveAll(2e-4);
        step(2, NO_LIMIT, 1000);
        // Where a later one fails the first has moved.
        moveAll(2e-4);
        both.stepOnDevice();
        both.context.setParameter("strength", 1e8); // of forces that are no numbers
        both.stepOnDevice();
        both.context.setParameter("strength", 1);
        both.stepOnDevice();
        const DeviceSteps::Report second = both.device.read();
        ASSERT(second.hasFailed);
        ASSERT_EQUAL(1, second.numSteps);
        both.computeForces();
        const vector<Vec3> after = both.positions();
        both.stepOnHost();
        ASSERT(largestDifference(after, both.dynamics.getPositions()) <= 1000 * distance);
        ASSERT(both.device.getParameters().values == both.getHostParameters().values);
        ASSERT(both.device.getParameters().isMoving);
    }
}

// Where the chord iteration does not contract Newton's follows; in a cluster of distances alone from the first time that it is needed. A
// long chain that is nearly straight moves across itself.
Molecules makeStraightChain() {
    Molecules molecules(0);
    const int length = 150;
    vector<Vec3> straight;
    for (int i = 0; i <= length; i++)
        straight.push_back(Vec3(0.13 * (i - length / 2), 1e-3 * std::sin(i), 1e-3 * std::cos(2 * i)));
    molecules.addLarge(makeChain(length), 12, straight);
    for (size_t i = molecules.masses.size() - length - 1; i < molecules.masses.size(); i++)
        molecules.velocities[i] *= 3;
    return molecules;
}

// The velocities of a zigzag whose bonds are turned by some 50 degrees in a drift of 1/(20 speed) ps.
vector<Vec3> turningVelocities(const Molecules& molecules, double speed) {
    vector<Vec3> velocities(molecules.masses.size());
    for (size_t i = 1; i < velocities.size(); i++) // the first does not move
        velocities[i] = Vec3(0, 0, i % 4 < 2 ? 1.2 : -1.2) * speed;
    return velocities;
}

Molecules makeZigzag() {
    Molecules molecules(0);
    vector<Vec3> places;
    for (int i = 0; i <= 24; i++)
        places.push_back(Vec3(0.12 * (i - 12), 0.09 * (i % 2), 0));
    molecules.addLarge(makeChain(24), 12, places);
    return molecules;
}

// One step, which is taken again where it is found that Newton's iteration is needed.
void requireNewton(DeviceSteps& device, bool isExpected, const std::function<void()>& stepOnDevice,
                   const std::function<void(const DeviceSteps::State&)>& begin) {
    stepOnDevice();
    const DeviceSteps::Report report = device.read();
    ASSERT_EQUAL(isExpected, report.hasFailed);
    ASSERT_EQUAL(isExpected, report.isForNewton);
    if (!isExpected)
        return;
    ASSERT(device.prepareNewton());
    ASSERT(!device.prepareNewton());
    begin(report.state);
    stepOnDevice();
    ASSERT(!device.read().hasFailed);
}

void testNewton(bool hasExpression) {
    Molecules molecules = makeStraightChain();
    if (hasExpression)
        molecules.addExpression("x1*y1", {(int) molecules.masses.size() - 1});
    Both both(molecules, "double");
    both.settings = {0.001, 0, 0, 1e-10, StepDensity::Explicit, {}, false};
    both.dynamics.setSettings(both.settings);
    const vector<Vec3> forces = both.forcesAt(molecules.positions);
    both.dynamics.begin(molecules.positions, molecules.velocities, forces, 0);
    both.handOver();
    requireNewton(
        both.device, !hasExpression, [&] { both.stepOnDevice(); },
        [&](const DeviceSteps::State& state) {
            both.computeForces();
            ASSERT(both.device.begin(state, 0));
        });
    ASSERT(both.device.getNumIterations() >= 3);
    const vector<Vec3> positions = both.positions(), velocities = both.velocities();
    both.stepOnHost();
    ASSERT(largestDifference(positions, both.dynamics.getPositions()) <= 1e-9);
    ASSERT(largestDifference(velocities, both.dynamics.getVelocities()) <= 1e-6);
    if (hasExpression)
        return;
    // A launch more.
    const long long launches = both.device.getNumLaunches();
    both.stepOnDevice();
    ASSERT_EQUAL(2 + (both.device.getLargeClusters().getForm().isStaged ? 3 + 16 : 2) + 1,
                 both.device.getNumLaunches() - launches);
}

void testNewtonForDensity() {
    const Molecules molecules = makeZigzag();
    Both both(molecules, "double");
    both.start(molecules, StepDensity::SemiExplicit, {{StepMonitor::VectorField, 1, 0.1, 0}});
    const vector<Vec3> turning = turningVelocities(molecules, 40);
    const vector<Vec3> forces = both.forcesAt(both.dynamics.getPositions());
    both.dynamics.changeState(both.dynamics.getPositions(), turning, forces, both.groupEnergy());
    both.handOver();
    requireNewton(
        both.device, true, [&] { both.stepOnDevice(); },
        [&](const DeviceSteps::State& state) {
            both.computeForces();
            ASSERT(both.device.begin(state, 0));
        });
    const vector<Vec3> positions = both.positions(), velocities = both.velocities();
    both.stepOnHost();
    ASSERT(largestDifference(positions, both.dynamics.getPositions()) <= 1e-9);
    ASSERT(largestDifference(velocities, both.dynamics.getVelocities()) <= 1e-6);
}

// A chain of light and heavy particles, bent and straight: to the tolerance.
void testLightAndHeavy(const std::string& precision) {
    Molecules molecules(1);
    const size_t first = molecules.masses.size();
    molecules.addLarge(makeChain(300));
    vector<Vec3> straight;
    for (int i = 0; i <= 30; i++)
        straight.push_back(Vec3(0.13 * i - 2, 0.01 * std::sin(i), 0.01 * std::cos(2 * i)));
    molecules.addLarge(makeChain(30), 1, straight);
    for (size_t i = first; i < molecules.masses.size(); i++) {
        molecules.masses[i] = i % 2 == 0 ? 126 : 1;
        molecules.system.setParticleMass((int) i, molecules.masses[i]);
        molecules.velocities[i] *= 0.2;
    }
    Both both(molecules, precision);
    both.start(molecules, StepDensity::Explicit, allMonitors());
    both.settings.tolerance = 1e-8;
    both.handOver();
    for (int i = 0; i < 20; i++)
        both.stepOnDevice();
    ASSERT(!both.device.read().hasFailed);
    const vector<Vec3> positions = both.positions(), velocities = both.velocities();
    for (const DistanceConstraint& constraint : molecules.constraints) {
        const Vec3 r = positions[constraint.particle1] - positions[constraint.particle2];
        const Vec3 v = velocities[constraint.particle1] - velocities[constraint.particle2];
        ASSERT_EQUAL_TOL(constraint.length, std::sqrt(r.dot(r)), 1e-8);
        ASSERT(std::fabs(r.dot(v)) <= 1e-6 * constraint.length);
    }
}

// Constraints that depend on each other are noticed, as are those of small clusters.
void testDependentConstraints(const std::string& precision) {
    Molecules molecules = makeMolecules({makeChain(400)});
    const int first = (int) molecules.masses.size() - 401;
    // Three particles on a line, all distances given.
    molecules.positions[first + 399] = (molecules.positions[first + 398] + molecules.positions[first + 400]) * 0.5;
    molecules.addConstraint(first + 398, first + 400);
    for (int k : {398, 399}) {
        const Vec3 r = molecules.positions[first + k] - molecules.positions[first + k + 1];
        const int constraint = molecules.system.getNumConstraints() - 401 + k;
        molecules.constraints[constraint].length = std::sqrt(r.dot(r));
        molecules.system.setConstraintParameters(constraint, first + k, first + k + 1, std::sqrt(r.dot(r)));
    }
    Lender lender;
    Context context(molecules.system, lender, OpenMM::Platform::getPlatform("OpenCL"), {{"Precision", precision}});
    const ClusterLayout layout = molecules.findLayout();
    DeviceSteps device(lender.getDevice(), layout);
    StepSettings settings;
    settings.stepSize = 0.001;
    settings.tolerance = 1e-6;
    device.setSettings({settings});
    context.setPositions(molecules.positions);
    context.setVelocities(molecules.velocities);
    lender.getContext().calcForcesAndEnergy(true, false, 1);
    ASSERT(!device.begin({1, 0, false, 0}, 0));
}

// Velocities that have been changed are projected, and the density keeps its ratio to u.
void testChangedVelocities() {
    const Molecules molecules(2);
    Both both(molecules, "double");
    for (StepDensity::Update update : {StepDensity::SemiExplicit, StepDensity::Explicit}) {
        both.start(molecules, update, allMonitors());
        vector<Vec3> velocities = both.velocities();
        for (size_t i = 0; i < velocities.size(); i++)
            if (molecules.masses[i] > 0)
                velocities[i] += Vec3(0.1 * std::sin(i), 0.2 * std::cos(i), -0.1);
        both.dynamics.changeVelocities(velocities);
        both.context.setVelocities(velocities);
        const double energy = both.groupEnergy();
        both.computeForces();
        both.device.change(energy, Control::VelocitiesChanged);
        both.requireAgreement(both.device.read(), 1e-13, 1e-10, 1e-9);
        both.stepOnDevice();
        const DeviceSteps::Report report = both.device.read();
        const vector<Vec3> positions = both.positions(), after = both.velocities();
        both.stepOnHost();
        both.context.setPositions(positions);
        both.context.setVelocities(after);
        // The device forms the half-step momentum anew; the host changes its own.
        both.requireAgreement(report, 1e-6, 1e-4, 1e-4);
    }
}

// Automatic step control: references that are found and given, steps that are short or cut short, changes of all kinds, and the number
// of launches.
void testAutomaticControl(const Molecules& molecules, const std::string& precision, double distance, double fraction) {
    Both both(molecules, precision);
    ContextImpl& context = both.lender.getContext();
    const auto changeVelocities = [&](double size) {
        vector<Vec3> velocities = both.velocities();
        for (size_t i = 0; i < velocities.size(); i++)
            if (molecules.masses[i] > 0)
                velocities[i] += Vec3(std::sin(i), std::cos(2 * i), 1) * size;
        both.device.keepVelocities();
        both.dynamics.changeVelocities(velocities);
        both.context.setVelocities(velocities);
        both.computeForces();
        both.device.change(0, Control::VelocitiesChanged);
        both.requireAgreement(both.device.read(), distance, 1000 * distance, fraction);
    };
    both.startAutomatic(molecules, 8, 0, 0);
    both.requireStepsToAgree(1, NO_LIMIT, distance, fraction);
    ASSERT_EQUAL(0.0, both.dynamics.getReferences()[0]);
    both.requireStepsToAgree(5, NO_LIMIT, distance, 10 * fraction);
    const vector<double> references = both.dynamics.getReferences();
    ASSERT(references[0] > 0);
    // Far outside the dead zone.
    both.startAutomatic(molecules, 8, references[0] / 20, references[1] / 30);
    const long long before = both.device.getNumLaunches();
    both.requireStepsToAgree(20, NO_LIMIT, 100 * distance, 100 * fraction);
    // As many launches as the update Explicit, and one to read.
    const LargeClusters& large = both.device.getLargeClusters();
    const int numLarge = large.isEmpty() ? 0 : large.getForm().isStaged ? 3 + 16 : 2;
    const int numExpressions = molecules.expressions.empty() ? 0 : 2;
    ASSERT_EQUAL(20 * (2 + numLarge + numExpressions) + 1, both.device.getNumLaunches() - before);
    ASSERT(both.dynamics.getDensity() > 3);
    both.requireStepsToAgree(3, 0.0001, 100 * distance, 100 * fraction);
    both.requireStepsToAgree(3, 0.00001, 100 * distance, 100 * fraction);
    // References that follow.
    both.startAutomatic(molecules, 2, 0, 0);
    changeVelocities(1e-9);
    ASSERT_EQUAL(0.0, both.dynamics.getMemory().automatic.following);
    changeVelocities(0.5);
    ASSERT_EQUAL(1000.0, both.dynamics.getMemory().automatic.following);
    both.requireStepsToAgree(5, NO_LIMIT, 10 * distance, 100 * fraction);
    context.setParameter("strength", 1.3);
    vector<Vec3> forces = both.forcesAt(both.positions());
    both.dynamics.changeForces(forces, 0);
    both.computeForces();
    both.device.change(0, Control::ForcesChanged);
    both.requireAgreement(both.device.read(), 10 * distance, 10000 * distance, 100 * fraction);
    both.requireStepsToAgree(5, NO_LIMIT, 100 * distance, 100 * fraction);
    vector<Vec3> positions = both.positions();
    for (Vec3& position : positions)
        position += Vec3(0.02, 0.01, -0.03);
    forces = both.forcesAt(positions);
    both.dynamics.changeState(positions, both.velocities(), forces, 0);
    both.computeForces();
    both.device.change(0, Control::AllChanged);
    both.requireAgreement(both.device.read(), 100 * distance, 100000 * distance, 100 * fraction);
    both.requireStepsToAgree(5, NO_LIMIT, 100 * distance, 100 * fraction);
    context.setParameter("strength", 1);
}

// A cluster that cannot be solved in step 31 of 60, beside others that can: a dumbbell, or a zigzag, that flies into a wall.
void testFailureLeavesTheStateBefore(const std::string& precision, int length = 1) {
    Molecules molecules(1);
    const int first = molecules.system.getNumParticles();
    for (int i = 0; i <= length; i++) {
        molecules.addParticle(12, Vec3(3, 0.1 * i, 0.05 * (i % 2)));
        if (i > 0)
            molecules.addConstraint(first + i - 1, first + i);
        molecules.velocities[first + i] = Vec3(1, 0, 0);
    }
    // The wall is reached in the 30th step of 0.001 ps, and pushes in the next one.
    auto* wall = new OpenMM::CustomExternalForce("1e9*x*step(x-3.0295)");
    wall->addParticle(first);
    molecules.system.addForce(wall);
    Both both(molecules, precision);
    both.settings = {0.001, 0, 0, 1e-5, StepDensity::Explicit, {}, false};
    both.dynamics.setSettings(both.settings);
    vector<Vec3> forces = both.forcesAt(molecules.positions);
    both.dynamics.begin(molecules.positions, molecules.velocities, forces, 0);
    vector<Vec3> positions[2], velocities[2];
    for (int attempt = 0; attempt < 2; attempt++) {
        both.context.setPositions(both.dynamics.getPositions());
        both.context.setVelocities(both.dynamics.getVelocities());
        both.computeForces();
        both.device.setSettings({both.settings});
        ASSERT(both.device.begin({1, 0, false, 0}, 0));
        for (int i = 0; i < (attempt == 0 ? 30 : 60); i++)
            both.stepOnDevice();
        const DeviceSteps::Report report = both.device.read();
        ASSERT_EQUAL(attempt == 1, report.hasFailed);
        ASSERT_EQUAL(30, report.numSteps);
        ASSERT_EQUAL_TOL(0.030, report.elapsed, 1e-6);
        positions[attempt] = both.positions();
        velocities[attempt] = both.velocities();
    }
    ASSERT_EQUAL(0.0, largestDifference(positions[0], positions[1]));
    ASSERT_EQUAL(0.0, largestDifference(velocities[0], velocities[1]));
    // And it goes on from there where there is no wall, which has pushed already.
    for (int i = first; i <= first + length; i++) {
        positions[1][i] -= Vec3(1, 0, 0);
        velocities[1][i] = Vec3(1, 0, 0);
    }
    both.context.setPositions(positions[1]);
    both.context.setVelocities(velocities[1]);
    both.computeForces();
    ASSERT(both.device.begin({1, 0, false, 0}, 0));
    for (int i = 0; i < 10; i++)
        both.stepOnDevice();
    const DeviceSteps::Report report = both.device.read();
    ASSERT(!report.hasFailed);
    ASSERT_EQUAL(10, report.numSteps);
}

// The same with automatic step control, whose numbers are those of the state before too: a wall that is too hard, or whose force is no
// number, which is noticed a step earlier and when all sums are others already. The dumbbell is a distance or an expression.
void testFailureOfAutomaticControl(const std::string& precision, bool hasExpression) {
    Molecules molecules(1);
    const int first = molecules.system.getNumParticles();
    for (int i = 0; i < 2; i++) {
        molecules.addParticle(12, Vec3(3, 0.1 * i, 0));
        molecules.velocities[first + i] = Vec3(1, 0, 0);
    }
    if (hasExpression)
        molecules.addExpression(DISTANCE, {first, first + 1});
    else
        molecules.addConstraint(first, first + 1);
    auto* wall = new OpenMM::CustomExternalForce("select(step(x-3.0295), select(isBad, sqrt(3.0295-x), 1e9*x), 0)");
    wall->addGlobalParameter("isBad", 0);
    wall->addParticle(first);
    molecules.system.addForce(wall);
    Both both(molecules, precision);
    both.settings = {0.001, 0.00095, 0, 1e-5, StepDensity::Explicit, {}, false, true, {}, 0, 8};
    both.dynamics.setSettings(both.settings);
    vector<Vec3> forces = both.forcesAt(molecules.positions);
    both.dynamics.begin(molecules.positions, molecules.velocities, forces, 0);
    both.stepOnHost(); // which starts the sequence
    for (const bool isBad : {false, true}) {
        const int numGood = isBad ? 28 : 29;
        both.context.setParameter("isBad", isBad);
        DeviceSteps::Report reports[2];
        vector<Vec3> positions[2];
        for (int attempt = 0; attempt < 2; attempt++) {
            both.handOver();
            for (int i = 0; i < (attempt == 0 ? numGood : 60); i++)
                both.stepOnDevice();
            reports[attempt] = both.device.read();
            ASSERT_EQUAL(attempt == 1, reports[attempt].hasFailed);
            ASSERT_EQUAL(numGood, reports[attempt].numSteps);
            positions[attempt] = both.positions();
        }
        ASSERT_EQUAL(0.0, largestDifference(positions[0], positions[1]));
        ASSERT(reports[0].state.automatic.numLearnt == 8);
        const auto* expected = reinterpret_cast<const double*>(&reports[0].state.automatic);
        const auto* found = reinterpret_cast<const double*>(&reports[1].state.automatic);
        for (int i = 0; i < Control::NumAutomaticNumbers; i++)
            ASSERT_EQUAL_TOL(expected[i], found[i], 1e-6);
        for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
            ASSERT_EQUAL_TOL(reports[0].state.references[k], reports[1].state.references[k], 1e-6);
        ASSERT_EQUAL_TOL(reports[0].state.density, reports[1].state.density, 1e-6);
        // And it goes on from there, where sums of what was no number are of no consequence.
        both.handOver();
        for (int i = 0; i < 5; i++)
            both.stepOnDevice();
        ASSERT(!both.device.read().hasFailed);
    }
}

// What is written for the device against what the host evaluates: every operation, and all derivatives.
void testExpressionCode() {
    const vector<std::string> texts = {"x1^2.5+x1^y2+k^x1+x1^21+x1^(-3)",
                                       "exp(x1)*log(y2)-sin(x1*z2)*cos(y2+k)",
                                       "sec(x1)+csc(y2)+tan(x1*y2)+cot(y2)+asin(0.3*x1)+acos(0.4*y2)",
                                       "atan(x1*y2)+atan2(x1,y2)*atan2(k,z2)",
                                       "sinh(x1)*cosh(y2)/tanh(z2+k)+erf(x1)*erfc(y2)",
                                       "step(x1-y2)*x1+delta(x1-x1)*y2^3+min(x1,y2)*max(y2,k)*abs(-z2)",
                                       "floor(5*x1)*y2+ceil(5*y2)*x1^3",
                                       "select(step(-x1), sqrt(-x1), x1^2*y2) + select(x1, y2^3, 1/(y2-y2))",
                                       "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-k*shift^2",
                                       "x1*y1*z1*x2*y2*z2*k*shift-1e-3/(1/0)"};
    const vector<Vec3> q = {Vec3(0.7, 0.3, -0.4), Vec3(0, 0, 0), Vec3(0.5, 0.9, 1.3)},
                       v = {Vec3(0.2, -0.6, 1.1), Vec3(0, 0, 0), Vec3(-0.8, 0.5, 0.3)};
    const ExpressionParameters theta = {{0.8, 0.6}, {0.3, -0.2}, true}, atRest = {theta.values, {0, 0}, false};
    const int numResults = 10, numTexts = (int) texts.size();
    std::string source, calls;
    vector<double> expected;
    for (int i = 0; i < numTexts; i++) {
        const ExpressionConstraint constraint = {texts[i], {0, 2}, {{"k", 0.8}, {"shift", 0.6}}};
        const std::string kind = "_E" + std::to_string(i), result = "results+" + std::to_string(numResults * i);
        source += ExpressionCode(ExpressionDerivatives(constraint)).write(kind);
        calls += "*(" + result + ") = value" + kind + "(x, at, theta);\n*(" + result + "+1) = motion" + kind +
                 "(x, at, theta, rates, 0.5);\n*(" + result + "+2) = curvature" + kind + "(x, v, at, theta);\n*(" +
                 result + "+3) = movingCurvature" + kind + "(x, v, at, theta, rates, 0.5);\ngradient" + kind +
                 "(x, at, theta, " + result + "+4);\n";
        ExpressionGroup group(constraint);
        group.add(constraint, 0, 0, 0, {1, 1, 1});
        group.compile();
        vector<double> value(1), motion(1, 0.0), curvature(1), moving(1);
        vector<Vec3> gradient(2);
        group.evaluate(q, atRest, value, 0, 1);
        group.addParameterMotion(q, theta, motion, 0, 1);
        group.evaluateCurvature(q, v, atRest, curvature, 0, 1);
        group.evaluateCurvature(q, v, theta, moving, 0, 1);
        group.evaluateJacobian(q, atRest, gradient, 0, 1);
        expected.insert(expected.end(), {value[0], motion[0], curvature[0], moving[0]});
        for (const Vec3& entry : gradient)
            expected.insert(expected.end(), {entry[0], entry[1], entry[2]});
    }
    source += "KERNEL void evaluate(GLOBAL const mixed* x, GLOBAL const mixed* v, GLOBAL const int* at, GLOBAL const "
              "mixed* theta, GLOBAL const mixed* rates, GLOBAL mixed* results) {\n" +
              calls + "}\n";
    System system;
    system.addParticle(1);
    Lender lender;
    Context context(system, lender, OpenMM::Platform::getPlatform("OpenCL"), {{"Precision", "double"}});
    OpenMM::ComputeContext& device = lender.getDevice();
    OpenMM::ComputeKernel kernel = device.compileProgram(source)->createKernel("evaluate");
    auto flatten = [](const vector<Vec3>& vectors) {
        vector<double> numbers;
        for (const Vec3& each : vectors)
            numbers.insert(numbers.end(), {each[0], each[1], each[2]});
        return numbers;
    };
    OpenMM::ComputeArray arrays[6];
    const vector<double> inputs[] = {flatten(q), flatten(v), {}, theta.values, {0.6, -0.4}, expected};
    for (int i = 0; i < 6; i++)
        if (i == 2) {
            arrays[i].initialize<int>(device, 2, "places");
            arrays[i].upload(vector<int>{0, 2});
        }
        else {
            arrays[i].initialize<double>(device, inputs[i].size(), "numbers");
            arrays[i].upload(inputs[i]);
        }
    for (OpenMM::ComputeArray& array : arrays)
        kernel->addArg(array);
    device.clearBuffer(arrays[5]);
    kernel->execute(1, 1);
    vector<double> found;
    arrays[5].download(found);
    for (size_t i = 0; i < expected.size(); i++)
        if (!(std::fabs(found[i] - expected[i]) <= 1e-12 * (1 + std::fabs(expected[i]))))
            throw OpenMM::OpenMMException(texts[i / numResults] + ": number " + std::to_string(i % numResults) +
                                          " is " + std::to_string(found[i]) + " in place of " +
                                          std::to_string(expected[i]));
}

// Texts that differ in numbers alone become one, of the same values and derivatives; others stay as they are.
void testSharedTexts() {
    struct Case {
        vector<std::string> texts;
        size_t numTexts;
    };
    const vector<Case> cases = {{{"x1*1.5-k/.25e-1*y2", "x1*2-k/3*y2", "x1*1.5-k/3*y2"}, 1},
                                {{"0*log(-1.5-x1^2)+z1", "1*log(-1.5-x1^2)+z1"}, 2}, // zeros simplify
                                {{"x1^2.5+y2", "x1^3.5+y2", "(x1-1)^3.5+y2", "(x1-2)^3.5+y2"}, 3},
                                {{"x1^n*3; n=2", "x1^n*4; n=3"}, 2},
                                {{"x1^(-3)+0.1*y2^-2", "x1^( -3 )+0.2*y2^-2", "x1^(-3)+0.3*y2^-2"}, 2},
                                {{"a2*2.5e+1+atan2(a2, 0.5); a2=x1*1.25", "a2*7+atan2(a2, 9); a2=x1*8."}, 1},
                                {{"select(step(x1-0.5), x1*2, y2*3)", "select(step(x1-0.75), x1*4, y2*3)"}, 1},
                                {{"k*x1-1", "k*x1-1"}, 1}};
    const vector<Vec3> q = {Vec3(0.7, 0.3, -0.4), Vec3(0.5, 0.9, 1.3)},
                       v = {Vec3(0.2, -0.6, 1.1), Vec3(-0.8, 0.5, 0.3)};
    const auto evaluate = [&](const ExpressionConstraint& constraint) {
        ExpressionGroup group(constraint);
        group.add(constraint, 0, 0, 0, {1, 1});
        group.compile();
        ExpressionParameters theta;
        for (const auto& parameter : constraint.parameters) {
            theta.values.push_back(parameter.second);
            theta.rates.push_back(0);
        }
        vector<double> numbers(2);
        vector<Vec3> gradient(2);
        vector<double> curvature(1);
        group.evaluate(q, theta, numbers, 0, 1);
        group.evaluateCurvature(q, v, theta, curvature, 0, 1);
        group.evaluateJacobian(q, theta, gradient, 0, 1);
        numbers[1] = curvature[0];
        for (const Vec3& each : gradient)
            numbers.insert(numbers.end(), {each[0], each[1], each[2]});
        return numbers;
    };
    for (const Case& each : cases) {
        vector<ExpressionConstraint> given;
        for (const std::string& text : each.texts)
            given.push_back({text, {0, 1}, {{"k", 0.8}}});
        const vector<ExpressionConstraint> shared = shareTexts(given);
        std::set<std::string> texts;
        for (size_t i = 0; i < given.size(); i++) {
            texts.insert(shared[i].expression);
            ASSERT_EQUAL(0.8, shared[i].parameters.begin()->second); // before all others
            const vector<double> expected = evaluate(given[i]), found = evaluate(shared[i]);
            for (size_t k = 0; k < expected.size(); k++)
                if (!std::isnan(expected[k]) || !std::isnan(found[k]))
                    ASSERT(std::fabs(found[k] - expected[k]) <= 1e-14 * (1 + std::fabs(expected[k])));
        }
        ASSERT_EQUAL(each.numTexts, texts.size());
    }
    ASSERT_EQUAL("k*x1-1", shareTexts({{"k*x1-1", {0}, {{"k", 1.0}}}})[0].expression);
    // Angles that are written into their texts.
    vector<ExpressionConstraint> angles;
    for (int i = 0; i < 200; i++)
        angles.push_back({std::to_string(1 + 0.001 * i) + "-" + ANGLE, {i, i + 1, i + 2}, {}});
    ASSERT(DeviceSteps::canTake(angles));
}

// LangevinDynamics and DeviceSteps side by side, with forces from one Context.
struct BothLangevin {
    Lender lender;
    Context context;
    LangevinDynamics dynamics;
    DeviceSteps device;
    const double stepSize = 0.001;

    BothLangevin(const Molecules& molecules, const std::string& precision) :
            context(molecules.system, lender, OpenMM::Platform::getPlatform("OpenCL"), {{"Precision", precision}}),
            dynamics(molecules.masses, molecules.constraints, molecules.expressions),
            device(lender.getDevice(), dynamics.getConstraintSystem().getLayout(), molecules.expressions) {
        StepSettings settings;
        settings.stepSize = stepSize;
        settings.tolerance = DeviceSteps::tolerableTolerance(lender.getDevice(), 1e-12);
        settings.langevin.emplace();
        settings.langevin->temperature = 300;
        settings.langevin->friction = 5;
        settings.langevin->randomSeed = -123456789;
        dynamics.setSettings(settings);
        dynamics.begin(molecules.positions, molecules.velocities, forcesAt(molecules.positions), 0);
        dynamics.setRandomState({-123456789, 4294967290.0}); // whose lower word is soon over
    }
    vector<Vec3> forcesAt(const vector<Vec3>& positions) {
        context.setPositions(positions);
        lender.getContext().calcForcesAndEnergy(true, false, 1);
        vector<Vec3> forces;
        lender.getContext().getForces(forces);
        return forces;
    }
    void stepOnHost() {
        vector<Vec3> forces;
        do {
            dynamics.step(NO_LIMIT);
            forces = forcesAt(dynamics.getNextPositions());
        } while (!dynamics.finish(forces, 0));
    }
    void handOver() {
        begin(dynamics.getPositions(), dynamics.getVelocities(), dynamics.findNoise());
    }
    // Let the device go on from a state with the host's random numbers, a and sqrt(kT (1 - a^2)) being given.
    void begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const LangevinDynamics::Noise& noise) {
        DeviceSteps::Settings settings = {dynamics.getSettings()};
        settings.atTemperature = {noise.damping, noise.size, dynamics.findFloor(), dynamics.getFollowingFactor(),
                                  dynamics.findLargestCalm()};
        forcesAt(positions);
        context.setVelocities(velocities);
        device.setSettings(settings);
        DeviceSteps::State state = {1, 0, false, 0};
        state.reference = dynamics.getReferences()[0];
        state.seed = (int64_t) dynamics.getRandomState()[0];
        state.numDrawn = (int64_t) dynamics.getRandomState()[1];
        ASSERT(device.begin(state, 0));
    }
    void stepOnDevice() {
        device.advance(NO_LIMIT);
        lender.getContext().calcForcesAndEnergy(true, false, 1);
        device.finish(0);
    }
    vector<Vec3> positions() {
        return context.getState(OpenMM::State::Positions).getPositions();
    }
    vector<Vec3> velocities() {
        return context.getState(OpenMM::State::Velocities).getVelocities();
    }
    // One step from the host's state, and back with the velocities and the noise turned around. The noise turns v into a v + s xi, and
    // the reversed one -(a v + s xi) into -v: that is the same numbers xi with 1/a and s/a in place of a and s.
    void requireRetracing(double distance) {
        handOver();
        const vector<Vec3> before = positions(), velocitiesBefore = velocities();
        stepOnDevice();
        ASSERT(!device.read().hasFailed);
        const vector<Vec3> after = positions();
        ASSERT(largestDifference(before, after) > 1e-3);
        vector<Vec3> turned = velocities();
        for (Vec3& each : turned)
            each = -each;
        const LangevinDynamics::Noise noise = dynamics.findNoise();
        begin(after, turned, {1 / noise.damping, noise.size / noise.damping});
        stepOnDevice();
        ASSERT(!device.read().hasFailed);
        ASSERT(largestDifference(before, positions()) <= distance);
        turned = velocities();
        for (size_t i = 0; i < turned.size(); i++)
            if (context.getSystem().getParticleMass((int) i) > 0)
                ASSERT(largestDifference({-turned[i]}, {velocitiesBefore[i]}) <= 1000 * distance);
    }
};

// From a state in the middle of a run: a step there and back, then the first calm steps, one and a hundred.
void testLangevinAgrees(const Molecules& molecules, const std::string& precision, double distance, double fraction) {
    BothLangevin both(molecules, precision);
    for (int i = 0; i < 20; i++)
        both.stepOnHost();
    both.dynamics.setReferences({1.2 * both.dynamics.getMonitorValues()[0]});
    both.requireRetracing(distance);
    both.handOver();
    const long long substepped = both.dynamics.getNumSubstepped();
    for (int steps : {1, 99}) {
        const long long launches = both.device.getNumLaunches();
        for (int i = 0; i < steps; i++)
            both.stepOnDevice();
        const LargeClusters& large = both.device.getLargeClusters();
        const int numLarge = large.isEmpty() ? 0 : large.getForm().isStaged ? 3 + 28 : 2;
        const int perStep = 2 + numLarge + (molecules.expressions.empty() ? 0 : 2);
        ASSERT_EQUAL(perStep * steps, both.device.getNumLaunches() - launches);
        const DeviceSteps::Report report = both.device.read();
        const vector<Vec3> positions = both.positions(), velocities = both.velocities();
        for (int i = 0; i < steps; i++)
            both.stepOnHost();
        ASSERT_EQUAL(substepped, both.dynamics.getNumSubstepped());
        ASSERT(!report.hasFailed);
        ASSERT_EQUAL(steps, report.numSteps);
        ASSERT_EQUAL_TOL(steps * both.stepSize, report.elapsed, 1e-6);
        const double growth = steps == 1 ? 1 : 1000;
        ASSERT(largestDifference(positions, both.dynamics.getPositions()) <= growth * distance);
        ASSERT(largestDifference(velocities, both.dynamics.getVelocities()) <= 1000 * growth * distance);
        ASSERT_EQUAL_TOL(both.dynamics.getMonitorValues()[0], report.values[0], growth * fraction);
        ASSERT_EQUAL_TOL(both.dynamics.getReferences()[0], report.state.reference, fraction);
        ASSERT_EQUAL(both.dynamics.getRandomState()[1], (double) report.state.numDrawn);
        both.forcesAt(positions);
        both.context.setVelocities(velocities);
    }
}

void testNewtonOfLangevin() {
    Molecules molecules = makeZigzag();
    molecules.velocities = turningVelocities(molecules, 66);
    BothLangevin both(molecules, "double");
    both.dynamics.setReferences({100 * both.dynamics.getMonitorValues()[0]}); // no step needs substeps
    both.handOver();
    requireNewton(both.device, true, [&] { both.stepOnDevice(); }, [&](const DeviceSteps::State&) { both.handOver(); });
    const vector<Vec3> positions = both.positions(), velocities = both.velocities();
    both.stepOnHost();
    ASSERT_EQUAL(0, both.dynamics.getNumSubstepped());
    ASSERT(largestDifference(positions, both.dynamics.getPositions()) <= 1e-9);
    ASSERT(largestDifference(velocities, both.dynamics.getVelocities()) <= 1e-6);
}

// Which constraints the device solves, and which are left to the host.
void testWhatItTakes() {
    ASSERT(DeviceSteps::canTake({}));
    ASSERT(DeviceSteps::canTake({{"x1^2+y1^2+z1^2-1", {0}, {}}}));
    // Compilers would take minutes for what is as long as this.
    std::string sum = "x1";
    vector<int> particles = {0};
    for (int i = 1; i < 1500; i++) {
        sum += "+sin(x" + std::to_string(i + 1) + ")";
        particles.push_back(i);
    }
    ASSERT(!DeviceSteps::canTake({{sum, particles, {}}}));
}

} // namespace

int main(int argc, char** argv) {
    OpenMM::Platform::loadPluginsFromDirectory(OpenMM::Platform::getDefaultPluginsDirectory());
    TestList tests = {
        {"steps agree, double",
         [] {
             testStepsAgree(Molecules(2), "double",
                            {StepDensity::SemiExplicit, StepDensity::Explicit, StepDensity::Bounded}, 1e-12, 1e-9);
         }},
        {"steps agree, mixed", [] { testStepsAgree(Molecules(2), "mixed", {StepDensity::SemiExplicit}, 1e-9, 1e-6); }},
        {"steps agree, single",
         [] { testStepsAgree(Molecules(2), "single", {StepDensity::SemiExplicit}, 1e-6, 1e-4); }},
        {"large clusters agree, double",
         [] { testStepsAgree(makeMolecules({makeChain(20), makeProtein(8)}), "double", UPDATES, 1e-12, 1e-9); }},
        {"large clusters in pieces agree, double",
         [] {
             testStepsAgree(makeMolecules({makeRing(30), makeChain(400), makeRing(300), makeProtein(30),
                                           makeStar(4, 60), makeStiffChain(150), makeTetrahedra(40)}),
                            "double", UPDATES, 1e-12, 1e-9);
         }},
        {"large clusters in pieces agree, mixed",
         [] {
             testStepsAgree(makeMolecules({makeRing(30), makeProtein(30)}), "mixed", {StepDensity::SemiExplicit}, 1e-9,
                            1e-6);
         }},
        {"large clusters in pieces agree, single",
         [] {
             testStepsAgree(makeMolecules({makeRing(30), makeProtein(30)}), "single", {StepDensity::SemiExplicit}, 1e-6,
                            1e-4);
         }},
        {"stars agree, double",
         [] { testStepsAgree(makeMolecules({makeStar(40, 1), makeChain(20)}), "double", UPDATES, 1e-12, 1e-9); }},
        {"diamond agrees, double", testDiamond},
        {"light and heavy particles, double", [] { testLightAndHeavy("double"); }},
        {"light and heavy particles, mixed", [] { testLightAndHeavy("mixed"); }},
        {"dependent constraints, double", [] { testDependentConstraints("double"); }},
        {"dependent constraints, mixed", [] { testDependentConstraints("mixed"); }},
        {"division into pieces", testDivision},
        {"launches", testNumLaunches},
        {"expressions agree, double",
         [] {
             testStepsAgree(makeExpressions(), "double", {StepDensity::SemiExplicit, StepDensity::Explicit}, 1e-12,
                            1e-9);
         }},
        {"expressions agree, mixed",
         [] { testStepsAgree(makeExpressions(), "mixed", {StepDensity::Explicit}, 1e-9, 1e-6); }},
        {"division and launches of expressions", testDivisionOfExpressions},
        {"moving parameters, double",
         [] { testMovingParameters("double", {StepDensity::SemiExplicit, StepDensity::Explicit}, 1e-12, 1e-9); }},
        {"moving parameters, mixed", [] { testMovingParameters("mixed", {StepDensity::Explicit}, 1e-9, 1e-6); }},
        {"Newton's iteration with expressions", [] { testNewton(true); }},
        {"Newton's iteration of a large cluster", [] { testNewton(false); }},
        {"Newton's iteration of a large cluster for (3.14)", testNewtonForDensity},
        {"Newton's iteration of a large cluster in Langevin dynamics", testNewtonOfLangevin},
        {"changed velocities", testChangedVelocities},
        {"automatic step control, double", [] { testAutomaticControl(Molecules(2), "double", 1e-12, 1e-9); }},
        {"automatic step control of large clusters, double",
         [] { testAutomaticControl(makeMolecules({makeChain(20), makeProtein(30)}), "double", 1e-12, 1e-9); }},
        {"automatic step control with expressions, double",
         [] { testAutomaticControl(makeExpressions(), "double", 1e-12, 1e-9); }},
        {"automatic step control, single", [] { testAutomaticControl(Molecules(2), "single", 1e-6, 1e-3); }},
        {"a failure leaves the state before, double", [] { testFailureLeavesTheStateBefore("double"); }},
        {"a failure leaves the state before, single", [] { testFailureLeavesTheStateBefore("single"); }},
        {"a failure of a large cluster leaves the state before, double",
         [] { testFailureLeavesTheStateBefore("double", 30); }},
        {"a failure of a large cluster in pieces leaves the state before, mixed",
         [] { testFailureLeavesTheStateBefore("mixed", 400); }},
        {"a failure with automatic step control, double", [] { testFailureOfAutomaticControl("double", false); }},
        {"a failure with automatic step control and an expression, double",
         [] { testFailureOfAutomaticControl("double", true); }},
        {"expressions are written as they are evaluated", testExpressionCode},
        {"texts that differ in numbers", testSharedTexts},
        {"Langevin, double", [] { testLangevinAgrees(Molecules(2), "double", 1e-12, 1e-9); }},
        {"Langevin, mixed", [] { testLangevinAgrees(Molecules(2), "mixed", 1e-9, 1e-6); }},
        {"Langevin, single", [] { testLangevinAgrees(Molecules(2), "single", 1e-6, 1e-4); }},
        {"Langevin, large clusters, double",
         [] { testLangevinAgrees(makeMolecules({makeChain(20), makeProtein(8)}), "double", 1e-12, 1e-9); }},
        {"Langevin, large clusters in pieces, double",
         [] {
             testLangevinAgrees(makeMolecules({makeRing(30), makeChain(400), makeProtein(30), makeStar(4, 60)}),
                                "double", 1e-12, 1e-9);
         }},
        {"Langevin, expressions, double", [] { testLangevinAgrees(makeExpressions(), "double", 1e-12, 1e-9); }},
        {"Langevin, expressions, mixed", [] { testLangevinAgrees(makeExpressions(), "mixed", 1e-9, 1e-6); }},
        {"what it takes", testWhatItTakes}};
    if (argc > 1)
        tests = {tests.at(std::stoi(argv[1]))};
    return runTests(tests);
}
