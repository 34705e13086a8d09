// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Constraints whose parameters change from step to step, and forces that do: against analytic motions, and against the equations of a
// step with all derivatives taken by differences.

#include "TestSupport.h"
#include "run/VRattleRun.h"
#include <Eigen/Dense>
#include <cmath>
#include <random>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::string;
using std::vector;

namespace {

typedef vector<Vec3> Vectors;
typedef std::map<string, double> Parameters;

const string DISTANCE = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-d";
const string SPHERE = "(x1-px)^2+(y1-py)^2+(z1-pz)^2-r^2";
const string ANGLE =
    "atan2(sqrt(cx^2+cy^2+cz^2), ax*bx+ay*by+az*bz)-angle; cx=ay*bz-az*by; cy=az*bx-ax*bz; cz=ax*by-ay*bx;"
    "ax=x1-x2; ay=y1-y2; az=z1-z2; bx=x3-x2; by=y3-y2; bz=z3-z2";
// The turn about the z axis, as openmmvrattle.constraints writes dihedral angles.
const string TURN = "atan2(y1*cos(angle)-x1*sin(angle), x1*cos(angle)+y1*sin(angle))";

typedef std::function<Vectors(const Vectors&)> ForceField;

Vectors noForce(const Vectors& q) {
    return Vectors(q.size());
}

StepSettings fixedSteps(double size) {
    return {size, 0, 0, 1e-12, StepDensity::SemiExplicit, {}, false};
}

StepSettings variableSteps(double size, StepDensity::Update update, StepMonitor::Kind kind) {
    return {size, 0, update == StepDensity::Bounded ? 2 * size : 0.0, 1e-12, update, {{kind, 1.0, 1.0, 0.0}}, false};
}

double takeStep(VRattleRun& dynamics, const ForceField& field, double maxStep = INFINITY) {
    while (true) {
        const double size = dynamics.step(maxStep);
        Vectors forces = field(dynamics.getNextPositions());
        if (dynamics.finish(forces, 0))
            return size;
    }
}

double kineticEnergy(const VRattleRun& dynamics) {
    double sum = 0;
    const vector<double>& masses = dynamics.getConstraintSystem().getMasses();
    for (size_t i = 0; i < masses.size(); i++)
        sum += 0.5 * masses[i] * dynamics.getVelocities()[i].dot(dynamics.getVelocities()[i]);
    return sum;
}

Eigen::VectorXd flatten(const Vectors& x) {
    Eigen::VectorXd result(3 * x.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = x[i / 3][i % 3];
    return result;
}

Vectors moved(const Vectors& q, const Eigen::VectorXd& by) {
    Vectors result = q;
    for (int i = 0; i < by.size(); i++)
        result[i / 3][i % 3] += by[i];
    return result;
}

void assertNear(double expected, double found, double tolerance, const string& what) {
    if (!(std::fabs(expected - found) <= tolerance))
        throw OpenMM::OpenMMException(what + ": expected " + std::to_string(expected) + ", found " +
                                      std::to_string(found) + ", difference " + std::to_string(found - expected));
}

// ------------------------------------------------------------------------------------------ motions that are known

// A bead at rest on a plane that is lifted has the plane's velocity in the first step, and none in the first in which it stands.
void testPlane() {
    const double mass = 12, dt = 0.002, weight = 3;
    VRattleRun dynamics({mass}, {}, {{"z1-height", {0}, {{"height", 0}}}});
    dynamics.setSettings(fixedSteps(dt));
    const ForceField field = [&](const Vectors&) { return Vectors{Vec3(0, 0, -weight)}; };
    dynamics.begin({Vec3()}, {Vec3(0.3, 0, 0)}, field({}), 0);
    takeStep(dynamics, field);
    for (int step = 1; step <= 10; step++) {
        dynamics.setParameters(0, {{"height", 0.001 * step}});
        takeStep(dynamics, field);
        ASSERT_EQUAL_VEC(Vec3(0.3, 0, 0.5), dynamics.getVelocities()[0], 1e-9);
        assertNear(0.001 * step, dynamics.getPositions()[0][2], 1e-12, "height");
        assertNear(-weight, dynamics.getMultipliers()[0], 1e-9, "multiplier"); // of the steady motion
    }
    takeStep(dynamics, field);
    ASSERT_EQUAL_VEC(Vec3(0.3, 0, 0), dynamics.getVelocities()[0], 1e-9);
    assertNear(0.01, dynamics.getPositions()[0][2], 1e-12, "height");
}

// A spinning dumbbell that is shortened: angular momentum and energy, and the work of its multiplier.
struct Dumbbell {
    double mass1 = 3, mass2 = 5, length = 0.4, rate = -0.05, spin = 4;
    double reduced() const {
        return mass1 * mass2 / (mass1 + mass2);
    }
    // d energy/dt of the exact motion is -multiplier rate.
    double energyAt(double d) const {
        const double momentum = reduced() * length * length * spin;
        return 0.5 * (momentum * momentum / (reduced() * d * d) + reduced() * rate * rate);
    }
    ExpressionConstraint constraint(bool isSquared) const {
        return {isSquared ? "(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-d^2" : DISTANCE, {0, 1}, {{"d", length}}};
    }
    void begin(VRattleRun& dynamics, const StepSettings& settings) const {
        dynamics.setSettings(settings);
        const double total = mass1 + mass2;
        dynamics.begin({Vec3(length * mass2 / total, 0, 0), Vec3(-length * mass1 / total, 0, 0)},
                       {Vec3(0, spin * length * mass2 / total, 0), Vec3(0, -spin * length * mass1 / total, 0)},
                       Vectors(2), 0);
    }
    double angularMomentum(const VRattleRun& dynamics) const {
        const Vectors &q = dynamics.getPositions(), &v = dynamics.getVelocities();
        return mass1 * q[0].cross(v[0])[2] + mass2 * q[1].cross(v[1])[2];
    }
};

void testDumbbell(const StepSettings& settings) {
    const Dumbbell dumbbell;
    for (bool isSquared : {false, true}) {
        VRattleRun dynamics({dumbbell.mass1, dumbbell.mass2}, {}, {dumbbell.constraint(isSquared)});
        dumbbell.begin(dynamics, settings);
        const double momentum = dumbbell.angularMomentum(dynamics);
        double length = dumbbell.length, work = 0, startEnergy = 0;
        int steps = 0;
        for (; length > 0.21 && steps < 20000; steps++) {
            // The size of a variable step is not known before; it is nearly that of the last one.
            const double next = length + dumbbell.rate * settings.stepSize / dynamics.getDensity();
            const double force = dynamics.getMultipliers()[0] * (isSquared ? -2 * length : -1);
            dynamics.setParameters(0, {{"d", next}});
            takeStep(dynamics, noForce);
            const double forceAfter = dynamics.getMultipliers()[0] * (isSquared ? -2 * next : -1);
            if (steps == 0)
                startEnergy = kineticEnergy(dynamics);
            else
                work += 0.5 * (force + forceAfter) * (next - length);
            length = next;
        }
        ASSERT(steps >= 3500 && steps < 20000);
        assertNear(momentum, dumbbell.angularMomentum(dynamics), 1e-3 * momentum, "angular momentum");
        const double energy = kineticEnergy(dynamics);
        assertNear(dumbbell.energyAt(length), energy, 1e-3 * energy, "energy");
        assertNear(energy - startEnergy, work, 1e-3 * (energy - startEnergy), "work");
        // It stops.
        takeStep(dynamics, noForce);
        const Vec3 r = dynamics.getPositions()[0] - dynamics.getPositions()[1],
                   v = dynamics.getVelocities()[0] - dynamics.getVelocities()[1];
        assertNear(0, r.dot(v) / length, 1e-9, "velocity along the distance");
        const double left = energy - kineticEnergy(dynamics),
                     expected = 0.5 * dumbbell.reduced() * dumbbell.rate * dumbbell.rate;
        assertNear(expected, left, 0.01 * expected + 1e-4 * energy, "energy of the motion along the distance");
    }
}

// A pendulum whose length changes smoothly: errors of energy, and of the work, are of second order.
void testOrder() {
    const double mass = 2, gravity = 9.81, total = 0.5;
    auto lengthAt = [&](double t) { return 1 - 0.3 * std::pow(std::sin(M_PI * t / total), 2); };
    const ForceField field = [&](const Vectors&) { return Vectors{Vec3(0, 0, -mass * gravity)}; };
    double energies[3], works[3];
    for (int level = 0; level < 3; level++) {
        const int steps = 100 << level;
        const double dt = total / steps;
        VRattleRun dynamics({mass}, {}, {{SPHERE, {0}, {{"px", 0}, {"py", 0}, {"pz", 0}, {"r", 1}}}});
        dynamics.setSettings(fixedSteps(dt));
        dynamics.begin({Vec3(1, 0, 0)}, {Vec3(0, 0.2, -1)}, field({}), 0);
        auto energy = [&] { return kineticEnergy(dynamics) + mass * gravity * dynamics.getPositions()[0][2]; };
        const double start = energy();
        double work = 0, length = 1;
        for (int step = 1; step <= steps; step++) {
            const double next = lengthAt(step * dt), before = -2 * length * dynamics.getMultipliers()[0];
            dynamics.setParameters(0, {{"px", 0}, {"py", 0}, {"pz", 0}, {"r", next}});
            takeStep(dynamics, field);
            work += 0.5 * (before - 2 * next * dynamics.getMultipliers()[0]) * (next - length);
            length = next;
        }
        energies[level] = energy() - start;
        works[level] = work - energies[level];
    }
    assertNear(4, (energies[0] - energies[1]) / (energies[1] - energies[2]), 0.4, "order of the energy");
    assertNear(4, works[0] / works[1], 0.4, "order of the work");
    assertNear(4, works[1] / works[2], 0.4, "order of the work");
}

// An angle that is set back by a full turn goes on as if it had not been.
void testFullTurn() {
    double ends[2];
    for (int wrapped = 0; wrapped < 2; wrapped++) {
        VRattleRun dynamics({2.0}, {}, {{TURN, {0}, {{"angle", 3.1}}}});
        dynamics.setSettings(variableSteps(0.002, StepDensity::SemiExplicit, StepMonitor::ConstraintForce));
        const double start = 3.1;
        const ForceField field = [](const Vectors&) { return Vectors{Vec3(0, 0.5, 0)}; };
        dynamics.begin({Vec3(std::cos(start), std::sin(start), 0)},
                       {Vec3(0.3 * std::cos(start), 0.3 * std::sin(start), 0.1)}, field({}), 0);
        double angle = start;
        for (int step = 0; step < 300; step++) {
            dynamics.setParameters(0, {{"angle", wrapped && angle > M_PI ? angle - 2 * M_PI : angle}});
            takeStep(dynamics, field);
            angle += 0.2 * 0.002 / dynamics.getDensity();
        }
        ASSERT(angle > M_PI + 0.01);
        ends[wrapped] = dynamics.getPositions()[0][0] + dynamics.getVelocities()[0][1];
        ASSERT(kineticEnergy(dynamics) < 10);
    }
    assertNear(ends[0], ends[1], 1e-9, "with and without full turn");
}

// -------------------------------------------------------------------------------------------- the equations of a step

struct Example {
    vector<double> masses;
    vector<DistanceConstraint> distances;
    vector<ExpressionConstraint> expressions;
    Vectors positions, velocities;
    std::mt19937 random{7};
    std::normal_distribution<double> normal;

    Vec3 randomVector(double scale) {
        return Vec3(normal(random), normal(random), normal(random)) * scale;
    }
    void addParticle(double mass, const Vec3& place) {
        masses.push_back(mass);
        positions.push_back(place);
        velocities.push_back(randomVector(0.5));
    }
    double distance(int i, int j) const {
        const Vec3 r = positions[i] - positions[j];
        return std::sqrt(r.dot(r));
    }
    void addWater(const Vec3& place) {
        const int first = (int) masses.size();
        addParticle(16, place);
        addParticle(1, place + Vec3(0.08, 0.06, 0));
        addParticle(1, place + Vec3(-0.08, 0.06, 0));
        for (auto pair : {std::make_pair(0, 1), {0, 2}, {1, 2}})
            distances.push_back(
                {first + pair.first, first + pair.second, distance(first + pair.first, first + pair.second)});
    }
    // Beads in a zigzag, joined by distances of the System and by expressions in turn.
    void addChain(int length) {
        const int first = (int) masses.size();
        for (int i = 0; i < length; i++)
            addParticle(i % 2 ? 14 : 12,
                        Vec3(0.11 * std::abs(i % 200 - 100), 0.001 * i + (i % 2 ? 0.06 : 0), 0.02 * (i % 3)));
        for (int i = first + 1; i < first + length; i++)
            if (i % 2)
                distances.push_back({i - 1, i, distance(i - 1, i)});
            else
                expressions.push_back({DISTANCE, {i, i - 1}, {{"d", distance(i, i - 1)}}});
    }
    // The parameters of expression e at a step, on smooth ways of their own.
    Parameters parametersAt(int e, double step) const {
        Parameters result = expressions[e].parameters;
        int k = 0;
        for (auto& parameter : result)
            parameter.second += 0.005 * std::sin(0.01 * (1 + (e + 2 * k++) % 7) * step);
        return result;
    }
    void setParameters(VRattleRun& dynamics, int step) const {
        for (size_t e = 0; e < expressions.size(); e++)
            dynamics.setParameters((int) e, parametersAt((int) e, step));
    }
    ExpressionParameters parametersOfAll(const ConstraintSystem& system, int step, double size) const {
        ExpressionParameters theta = system.getGivenParameters(), last = theta;
        for (size_t e = 0; e < expressions.size(); e++) {
            system.writeParameters((int) e, parametersAt((int) e, step), theta.values);
            system.writeParameters((int) e, parametersAt((int) e, step - 1), last.values);
        }
        for (size_t k = 0; k < theta.values.size(); k++)
            theta.rates[k] = step == 0 ? 0 : (theta.values[k] - last.values[k]) / size;
        return theta;
    }
};

Vectors springs(const Vectors& positions) {
    Vectors forces;
    for (size_t i = 0; i < positions.size(); i++)
        forces.push_back((positions[i] - Vec3(0.1 * (i % 50), 0, 0)) * (-20.0 - (double) (i % 7)) +
                         Vec3(1, 2, -1) * (double) (i % 5));
    return forces;
}

Example makeSmall() {
    Example e;
    e.addWater(Vec3(0, 0, 1));
    e.addChain(5);
    const int chain = 3;
    const Vec3 a = e.positions[chain + 2] - e.positions[chain + 3], b = e.positions[chain + 4] - e.positions[chain + 3];
    const Vec3 cross = a.cross(b);
    e.expressions.push_back(
        {ANGLE, {chain + 2, chain + 3, chain + 4}, {{"angle", std::atan2(std::sqrt(cross.dot(cross)), a.dot(b))}}});
    e.expressions.push_back({SPHERE, {chain}, {{"px", 0.1}, {"py", 0.2}, {"pz", 0.3}, {"r", 0}}});
    const Vec3 r = e.positions[chain] - Vec3(0.1, 0.2, 0.3);
    e.expressions.back().parameters["r"] = std::sqrt(r.dot(r));
    e.addParticle(40, Vec3(1, 1, 1));
    return e;
}

// What the equations say, with the derivatives of g by differences of g.
struct Statement {
    const Example& example;
    const ConstraintSystem& system;
    Eigen::VectorXd inverseMasses;

    Statement(const Example& e, const ConstraintSystem& s) : example(e), system(s), inverseMasses(3 * e.masses.size()) {
        for (int i = 0; i < inverseMasses.size(); i++)
            inverseMasses[i] = 1 / e.masses[i / 3];
    }
    Eigen::VectorXd g(const Vectors& q, const ExpressionParameters& theta, const Eigen::VectorXd& by,
                      double time) const {
        ExpressionParameters there = theta;
        for (size_t k = 0; k < theta.values.size(); k++)
            there.values[k] += theta.rates[k] * time;
        vector<double> result(system.getNumConstraints());
        ConstraintSystem::Jacobian nearby(system.getNumEntries());
        system.evaluate(moved(q, by), there, result, nearby);
        return Eigen::VectorXd::Map(result.data(), (Eigen::Index) result.size());
    }
    Eigen::MatrixXd jacobian(const Vectors& q, const ExpressionParameters& theta) const {
        const double h = 1e-6;
        Eigen::MatrixXd result(system.getNumConstraints(), inverseMasses.size());
        for (int i = 0; i < inverseMasses.size(); i++) {
            const Eigen::VectorXd by = h * Eigen::VectorXd::Unit(inverseMasses.size(), i);
            result.col(i) = (g(q, theta, by, 0) - g(q, theta, -by, 0)) / (2 * h);
        }
        return result;
    }
    // dg/dt along v and the motion of the parameters, and its derivative.
    Eigen::VectorXd rate(const Vectors& q, const ExpressionParameters& theta, const Eigen::VectorXd& v) const {
        const double h = 1e-5;
        return (g(q, theta, h * v, h) - g(q, theta, -h * v, -h)) / (2 * h);
    }
    Eigen::VectorXd curvature(const Vectors& q, const ExpressionParameters& theta, const Eigen::VectorXd& v) const {
        const double h = 2e-4;
        return (g(q, theta, h * v, h) - 2 * g(q, theta, 0 * v, 0) + g(q, theta, -h * v, -h)) / (h * h);
    }
    Eigen::VectorXd multipliers(const Vectors& q, const ExpressionParameters& theta, const Eigen::VectorXd& v,
                                const Vectors& force) const {
        const Eigen::MatrixXd rows = jacobian(q, theta), k = rows * inverseMasses.asDiagonal() * rows.transpose();
        return k.ldlt().solve(curvature(q, theta, v) + rows * inverseMasses.cwiseProduct(flatten(force)));
    }
    // The monitor ConstraintForce.
    double monitor(const Vectors& q, const ExpressionParameters& theta, const Eigen::VectorXd& v,
                   const Vectors& force) const {
        const Eigen::MatrixXd rows = jacobian(q, theta), k = rows * inverseMasses.asDiagonal() * rows.transpose();
        const Eigen::VectorXd lambda = multipliers(q, theta, v, force);
        return std::sqrt(lambda.dot(k * lambda));
    }
};

void testEquations(StepDensity::Update update) {
    const Example e = makeSmall();
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    const ConstraintSystem& system = dynamics.getConstraintSystem();
    const Statement statement(e, system);
    ASSERT(system.getFirstGeneral() == 3); // the water is in a batch
    dynamics.setSettings(variableSteps(0.002, update, StepMonitor::ConstraintForce));
    dynamics.begin(e.positions, e.velocities, springs(e.positions), 0);
    takeStep(dynamics, springs); // the first step, with parameters at rest
    double lastSize = 0;
    Vectors lastPositions;
    ExpressionParameters lastTheta;
    for (int step = 1; step < 20; step++) {
        const Vectors q = dynamics.getPositions(), v = dynamics.getVelocities(), force = dynamics.getForces();
        const double u = dynamics.getMonitorValues()[0] / dynamics.getReferences()[0], rho = dynamics.getDensity();
        e.setParameters(dynamics, step);
        const double size = takeStep(dynamics, springs);
        const ExpressionParameters theta = e.parametersOfAll(system, step, size);
        const Vectors& next = dynamics.getPositions();
        const Eigen::VectorXd velocities = flatten(dynamics.getVelocities()), none = 0 * velocities;
        // (3.11), (3.13)
        ASSERT(statement.g(next, theta, none, 0).norm() < 1e-11);
        ASSERT(statement.rate(next, theta, velocities).norm() < 1e-8);
        // The acceleration with Lambda keeps to the constraints.
        const Eigen::VectorXd lambda =
            Eigen::VectorXd::Map(dynamics.getMultipliers().data(), system.getNumConstraints());
        const Eigen::VectorXd expected = statement.multipliers(next, theta, velocities, dynamics.getForces());
        ASSERT((expected - lambda).norm() < 1e-5 * expected.norm());
        if (step > 2) {
            // (3.10): the kick is the force's, and along G(q[n]; theta[n])^T beside.
            const Eigen::VectorXd after = (flatten(next) - flatten(q)) / size,
                                  before = (flatten(q) - flatten(lastPositions)) / lastSize;
            const Eigen::VectorXd kick =
                after - before - 0.5 * (size + lastSize) * statement.inverseMasses.cwiseProduct(flatten(force));
            const Eigen::MatrixXd rows = statement.jacobian(q, lastTheta),
                                  over = statement.inverseMasses.asDiagonal() * rows.transpose();
            const Eigen::VectorXd rest = kick - over * (rows * over).ldlt().solve(rows * kick);
            ASSERT(rest.norm() < 1e-7 * kick.norm());
            // (3.14), (3.15), with the rates of the two steps
            ExpressionParameters ahead = lastTheta;
            ahead.rates = theta.rates;
            const double reference = dynamics.getReferences()[0];
            if (update == StepDensity::SemiExplicit)
                assertNear(
                    (statement.monitor(q, ahead, after, force) + statement.monitor(q, lastTheta, before, force)) /
                        reference,
                    dynamics.getDensity() + rho, 1e-5 * rho, "(3.14)");
            else if (update == StepDensity::Explicit)
                assertNear(2 * u, dynamics.getDensity() + rho, 1e-9 * rho, "(3.15)");
        }
        lastSize = size;
        lastPositions = q;
        lastTheta = theta;
    }
}

// The step in which a pivot begins to move, gently and so fast that u grows 600 times: (3.14) stated for this bead alone, with (3.11) solved
// by a square root. Its solution is the next one from the density of (3.15), in the direction of the mismatch there.
void testSuddenStart() {
    const double mass = 2, h = 0.004, radius = 1;
    const Vec3 weight(0, 0, -9.8 * mass);
    const StepDensity bounds(StepDensity::SemiExplicit, h, h / 50, 2 * h);
    for (double way : {0.001, -0.004, 0.006, -0.01, 0.02, -0.03, 0.1}) {
        VRattleRun dynamics({mass}, {}, {{SPHERE, {0}, {{"px", 0}, {"py", 0}, {"pz", 0}, {"r", radius}}}});
        StepSettings settings = variableSteps(h, StepDensity::SemiExplicit, StepMonitor::ConstraintForce);
        settings.minimumStep = h / 50;
        settings.maximumStep = 2 * h;
        dynamics.setSettings(settings);
        const ForceField field = [&](const Vectors&) { return Vectors{weight}; };
        dynamics.begin({Vec3(0.8, 0, -0.6)}, {Vec3(0.3, 1, 0.4)}, field({}), 0);
        for (int step = 0; step < 5; step++)
            takeStep(dynamics, field);
        const Vec3 q = dynamics.getPositions()[0], v = dynamics.getVelocities()[0], pivot(0, way, 0);
        const Vec3 w = dynamics.keep().state.w[0];
        const double rho = dynamics.getDensity(), reference = dynamics.getReferences()[0];
        auto uOf = [&](const Vec3& velocity, const Vec3& rate) { // B(|Lambda^T K Lambda|^(1/2)/U_ref)
            const Vec3 relative = velocity - rate;
            const double acceleration = relative.dot(relative) / radius + weight.dot(q) / (mass * radius);
            return bounds.limit(std::fabs(acceleration) * std::sqrt(mass) / reference);
        };
        const Vec3 startRate = pivot * (rho / h);
        const double u = uOf(v, Vec3()), jump = uOf(v + q * (startRate.dot(q)), startRate) / u;
        const double scale = std::fabs(jump - 1) > MonitorControl::SMALL_CHANGE ? jump : 1;
        auto mismatch = [&](double next) {
            const double kick = 0.5 * h * (1 / rho + 1 / next), drift = h / next;
            const Vec3 free = w + weight * (kick / mass), from = q + free * drift - pivot;
            const double along = from.dot(q);
            const double push = along - std::sqrt(along * along - from.dot(from) + radius * radius);
            return next - uOf(free - q * (push / drift), pivot / drift) + scale * (rho - uOf(w, Vec3()));
        };
        double expected = scale * StepDensity::sumUpdate(u, rho);
        const double direction = mismatch(expected) > 0 ? -1 : 1, stride = 1e-3 * expected;
        while (mismatch(expected + direction * stride) * direction < 0)
            expected += direction * stride;
        double low = expected, high = expected + direction * stride;
        for (int i = 0; i < 60; i++)
            (mismatch(0.5 * (low + high)) * direction < 0 ? low : high) = 0.5 * (low + high);
        dynamics.setParameters(0, {{"px", 0}, {"py", way}, {"pz", 0}, {"r", radius}});
        takeStep(dynamics, field);
        assertNear(low, dynamics.getDensity(), 1e-9 * low, "density after a way of " + std::to_string(way));
        ASSERT_EQUAL(0, dynamics.getNumRescues());
    }
}

// A cut cluster beside batches, and any number of threads.
void testManyThreads() {
    Example e;
    for (int i = 0; i < 41; i++)
        e.addWater(Vec3(0.3 * i, 0, 1));
    e.addChain(20004);
    for (StepDensity::Update update : {StepDensity::SemiExplicit, StepDensity::Bounded}) {
        Vectors alone;
        for (int threads : {1, 3}) {
            VRattleRun dynamics(e.masses, e.distances, e.expressions);
            int calls = 0;
            if (threads > 1)
                dynamics.setParallel(runInReverse(threads, calls), threads);
            const ConstraintSystem& system = dynamics.getConstraintSystem();
            ASSERT(!system.getCutClusters().empty() && system.getFirstGeneral() == 123);
            dynamics.setSettings(variableSteps(0.002, update, StepMonitor::ConstraintForce));
            dynamics.begin(e.positions, e.velocities, Vectors(e.masses.size()), 0);
            takeStep(dynamics, noForce);
            const Statement statement(e, system);
            for (int step = 1; step < 8; step++) {
                e.setParameters(dynamics, step);
                const double size = takeStep(dynamics, noForce);
                const ExpressionParameters theta = e.parametersOfAll(system, step, size);
                const Eigen::VectorXd v = flatten(dynamics.getVelocities());
                ASSERT(statement.g(dynamics.getPositions(), theta, 0 * v, 0).lpNorm<Eigen::Infinity>() < 1e-10);
                ASSERT(statement.rate(dynamics.getPositions(), theta, v).lpNorm<Eigen::Infinity>() < 1e-8);
            }
            if (threads == 1)
                alone = dynamics.getVelocities();
            else
                ASSERT(alone == dynamics.getVelocities());
        }
    }
}

// --------------------------------------------------------------------------------- what else happens between steps

// Forward and back, with parameters that go back the way they came, or that stand after they have moved.
void testReverse(bool isMoving) {
    const Example e = makeSmall();
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    dynamics.setSettings(variableSteps(0.002, StepDensity::SemiExplicit, StepMonitor::ConstraintForce));
    dynamics.begin(e.positions, e.velocities, springs(e.positions), 0);
    takeStep(dynamics, springs);
    auto stepOf = [&](int step) { return isMoving ? step + 100 : std::min(step, 20) + 100; };
    for (int step = 0; step < 25; step++) { // a way to the middle of the motion
        e.setParameters(dynamics, std::min(4 * step, 100));
        takeStep(dynamics, springs);
    }
    vector<Vectors> way;
    const int numSteps = 40, first = isMoving ? 5 : 23; // those before are not retraced
    for (int step = 0; step <= numSteps; step++) {
        e.setParameters(dynamics, stepOf(step));
        takeStep(dynamics, springs);
        way.push_back(dynamics.getPositions());
    }
    dynamics.reverse();
    for (int step = numSteps - 1; step >= first; step--) {
        e.setParameters(dynamics, stepOf(step));
        takeStep(dynamics, springs);
        const double error = (flatten(way[step]) - flatten(dynamics.getPositions())).norm();
        ASSERT(error < 1e-8);
    }
}

// A run goes on from what is saved of it in the middle of a motion, to the last bit.
void testResume() {
    const Example e = makeSmall();
    for (bool isAutomatic : {false, true}) {
        StepSettings settings = variableSteps(0.002, StepDensity::SemiExplicit, StepMonitor::ConstraintForce);
        if (isAutomatic)
            settings = {0.002, 0, 0, 1e-12, StepDensity::SemiExplicit, {}, false, true, {30, 20}, 0};
        VRattleRun dynamics(e.masses, e.distances, e.expressions), other(e.masses, e.distances, e.expressions);
        for (VRattleRun* each : {&dynamics, &other})
            each->setSettings(settings);
        dynamics.begin(e.positions, e.velocities, springs(e.positions), 0);
        for (int step = 0; step < 10; step++) {
            e.setParameters(dynamics, step);
            takeStep(dynamics, springs);
        }
        const VRattleRun::Kept kept = dynamics.keep();
        other.resume(kept.state, kept.memory);
        for (int step = 10; step < 20; step++)
            for (VRattleRun* each : {&dynamics, &other}) {
                e.setParameters(*each, step);
                takeStep(*each, springs);
            }
        ASSERT(dynamics.getPositions() == other.getPositions());
        ASSERT(dynamics.getVelocities() == other.getVelocities());
        ASSERT_EQUAL(dynamics.getDensity(), other.getDensity());
    }
}

// A jump that no step can make: nothing has happened, and the run goes on as one that never tried.
void testTooLargeJump() {
    const Example e = makeSmall();
    Vectors ends[2];
    for (int tries = 0; tries < 2; tries++) {
        VRattleRun dynamics(e.masses, e.distances, e.expressions);
        dynamics.setSettings(variableSteps(0.002, StepDensity::SemiExplicit, StepMonitor::ConstraintForce));
        dynamics.begin(e.positions, e.velocities, springs(e.positions), 0);
        for (int step = 0; step < 20; step++) {
            e.setParameters(dynamics, step);
            if (tries && step % 5 == 4) {
                Parameters parameters = e.parametersAt(0, step);
                parameters["d"] = -0.5;
                dynamics.setParameters(0, parameters);
                assertThrows("parameters of constraints have been changed", [&] { dynamics.step(INFINITY); });
                e.setParameters(dynamics, step);
            }
            takeStep(dynamics, springs);
        }
        ends[tries] = dynamics.getPositions();
    }
    ASSERT(ends[0] == ends[1]);
}

// A step that ends at a given time.
void testShortenedStep() {
    const Dumbbell dumbbell;
    VRattleRun dynamics({dumbbell.mass1, dumbbell.mass2}, {}, {dumbbell.constraint(false)});
    dumbbell.begin(dynamics, variableSteps(0.002, StepDensity::SemiExplicit, StepMonitor::ConstraintForce));
    const double momentum = dumbbell.angularMomentum(dynamics);
    double time = 0;
    for (int stop = 1; stop <= 400; stop++) {
        // What is left to the next of the times that are 3.3 nominal steps apart, at a constant rate.
        while (time < 0.0066 * stop - 1e-12) {
            const double size = std::min(0.0066 * stop - time, 0.002 / dynamics.getDensity());
            dynamics.setParameters(0, {{"d", dumbbell.length + dumbbell.rate * (time + size)}});
            time += takeStep(dynamics, noForce, 0.0066 * stop - time);
        }
    }
    const double length = dynamics.getPositions().empty()
                              ? 0
                              : std::sqrt((dynamics.getPositions()[0] - dynamics.getPositions()[1])
                                              .dot(dynamics.getPositions()[0] - dynamics.getPositions()[1]));
    assertNear(dumbbell.length + dumbbell.rate * time, length, 1e-3 * dumbbell.length, "length");
    assertNear(momentum, dumbbell.angularMomentum(dynamics), 1e-3 * momentum, "angular momentum");
    assertNear(dumbbell.energyAt(length), kineticEnergy(dynamics), 2e-3 * kineticEnergy(dynamics), "energy");
}

// The start of a motion, and its end, leave no oscillation of the density behind.
void testDensityAtStartOfMotion(const StepSettings& settings) {
    // A bead runs around a ring, whose plane then moves along: |v| and with it the force change at once.
    VRattleRun dynamics({2.0}, {}, {{"x1^2+y1^2-1", {0}, {}}, {"z1-tilt*x1", {0}, {{"tilt", 0.3}}}});
    dynamics.setSettings(settings);
    dynamics.begin({Vec3(1, 0, 0.3)}, {Vec3(0, 2, 0)}, Vectors(1), 0);
    if (settings.isAutomatic) { // without a force its two monitors are the same
        const double value = dynamics.getAutomaticControl().getMemory().values[0];
        dynamics.setReferences({value / 4, value / 4});
    }
    double tilt = 0.3, largest = 0;
    for (int step = 0; step < 300; step++) {
        if (step >= 100 && step < 200)
            dynamics.setParameters(1, {{"tilt", tilt += 0.6 * 0.002 / dynamics.getDensity()}});
        const double before = dynamics.getDensity();
        takeStep(dynamics, noForce);
        const bool isCalm = step > 10 && std::abs(step - 100) > 3 && std::abs(step - 200) > 3;
        if (isCalm) // from step to step, with no oscillation, it changes little
            largest = std::max(largest, std::fabs(dynamics.getDensity() / before - 1));
    }
    // Where users set steps by the last one's size, variable steps are a little uneven themselves.
    assertNear(0, largest, settings.isAutomatic ? 0.15 : 0.03, "change of the density from step to step");
}

// Forces whose parameter changes: the energy balance of a spring that is wound up, step by step, and no density lost.
void testChangedForces(const StepSettings& settings) {
    double errors[2];
    for (int level = 0; level < 2; level++) {
        StepSettings finer = settings;
        finer.stepSize /= 1 << level;
        finer.maximumStep /= 1 << level;
        const Example e = makeSmall();
        VRattleRun dynamics(e.masses, e.distances, e.expressions);
        dynamics.setSettings(finer);
        double scale = 1;
        auto potential = [&] {
            double sum = 0;
            for (size_t i = 0; i < e.masses.size(); i++)
                sum += 25 * scale * dynamics.getPositions()[i].dot(dynamics.getPositions()[i]);
            return sum;
        };
        const ForceField field = [&](const Vectors& q) {
            Vectors forces;
            for (const Vec3& x : q)
                forces.push_back(x * (-50 * scale));
            return forces;
        };
        dynamics.begin(e.positions, e.velocities, field(e.positions), 0);
        takeStep(dynamics, field);
        double time = 0, work = 0;
        const double start = kineticEnergy(dynamics) + potential();
        while (time < 0.4) {
            const double before = potential();
            scale = 1 + time * time;
            work += potential() - before;
            Vectors forces = field(dynamics.getPositions());
            const Vectors v = dynamics.getVelocities();
            dynamics.changeForces(forces, 0);
            ASSERT(v == dynamics.getVelocities());
            ASSERT(dynamics.hasStarted());
            time += takeStep(dynamics, field);
        }
        errors[level] = std::fabs(kineticEnergy(dynamics) + potential() - start - work);
        ASSERT(work > 1);
        ASSERT(errors[level] < 0.01 * work);
    }
    ASSERT(errors[1] < 0.4 * errors[0] + 1e-4);
    // Those that are no numbers are refused, and leave no trace.
    const Example e = makeSmall();
    Vectors ends[2];
    for (int tries = 0; tries < 2; tries++) {
        VRattleRun dynamics(e.masses, e.distances, e.expressions);
        dynamics.setSettings(settings);
        dynamics.begin(e.positions, e.velocities, springs(e.positions), 0);
        for (int step = 0; step < 5; step++) {
            takeStep(dynamics, springs);
            if (tries) {
                Vectors forces(e.masses.size(), Vec3(NAN, 0, 0));
                assertThrows("not a number", [&] { dynamics.changeForces(forces, 0); });
            }
        }
        ends[tries] = dynamics.getPositions();
    }
    ASSERT(ends[0] == ends[1]);
}

} // namespace

int main() {
    StepSettings automatic = {0.002, 0, 0, 1e-12, StepDensity::SemiExplicit, {}, false, true, {30, 20}, 0};
    StepSettings automaticRing = automatic;
    automaticRing.automaticReferences[0] = automaticRing.automaticReferences[1] = 1;
    TestList tests = {{"plane", testPlane}, {"order", testOrder}, {"full turn", testFullTurn}};
    tests.emplace_back("dumbbell, fixed", [] { testDumbbell(fixedSteps(0.001)); });
    const std::pair<string, StepDensity::Update> updates[] = {{"SemiExplicit", StepDensity::SemiExplicit},
                                                              {"Explicit", StepDensity::Explicit},
                                                              {"Bounded", StepDensity::Bounded}};
    for (const auto& update : updates) {
        const StepSettings settings = variableSteps(0.001, update.second, StepMonitor::ConstraintMultipliers);
        tests.emplace_back("dumbbell, " + update.first, [=] { testDumbbell(settings); });
        tests.emplace_back("equations, " + update.first, [=] { testEquations(update.second); });
        tests.emplace_back("start of motion, " + update.first, [=] {
            testDensityAtStartOfMotion(variableSteps(0.002, update.second, StepMonitor::ConstraintForce));
        });
        tests.emplace_back("changed forces, " + update.first, [=] {
            testChangedForces(variableSteps(0.002, update.second, StepMonitor::ConstraintAndAppliedForce));
        });
    }
    tests.emplace_back("start of motion, automatic", [=] { testDensityAtStartOfMotion(automaticRing); });
    tests.emplace_back("changed forces, fixed", [] { testChangedForces(fixedSteps(0.002)); });
    tests.emplace_back("changed forces, automatic", [=] { testChangedForces(automatic); });
    tests.emplace_back("sudden start", testSuddenStart);
    tests.emplace_back("threads", testManyThreads);
    tests.emplace_back("reverse, moving", [] { testReverse(true); });
    tests.emplace_back("reverse, standing", [] { testReverse(false); });
    tests.emplace_back("resume", testResume);
    tests.emplace_back("too large jump", testTooLargeJump);
    tests.emplace_back("shortened step", testShortenedStep);
    return runTests(tests);
}
