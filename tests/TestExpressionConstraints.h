// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Constraints given as expressions, from C++. Each platform's tests/ includes this file and its own setup.

#include "TestSerialization.h"
#include <map>
#include <string>

namespace OpenMMVRattle {

const char SPHERE[] = "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-r";

// A particle on a sphere about a fixed one, in gravity.
inline void makeSphericalPendulum(TestSystem& t) {
    t.system.addParticle(0);
    t.system.addParticle(2);
    CustomExternalForce* gravity = new CustomExternalForce("20*z");
    gravity->addParticle(1);
    t.system.addForce(gravity);
    t.positions = {Vec3(0.1, 0.2, 0.3), Vec3(0.9, 0.2, 0.9)};
    t.velocities = {Vec3(), Vec3(0, 1.5, 0)};
}

inline Integrator_ makePendulumIntegrator() {
    Integrator_ integrator(0.005);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ConstraintForce);
    integrator.setConstraintTolerance(1e-11);
    return integrator;
}

inline void start(Context& context, const TestSystem& t) {
    context.setPositions(t.positions);
    context.setVelocities(t.velocities);
}

inline void testTension() {
    TestSystem t;
    makeSphericalPendulum(t);
    Integrator_ integrator = makePendulumIntegrator();
    ASSERT_EQUAL(0, integrator.addConstraint(SPHERE, {1, 0}, {{"r", 1.0}}));
    Context context(t.system, integrator, getTestPlatform());
    start(context, t);
    double first = 0;
    for (int i = 0; i < 200; i++) {
        integrator.step(1);
        const State state = context.getState(State::Positions | State::Velocities | State::Energy);
        const Vec3 r = state.getPositions()[1] - state.getPositions()[0], v = state.getVelocities()[1];
        ASSERT_EQUAL_TOL(1.0, std::sqrt(r.dot(r)), 1e-11);
        ASSERT(std::fabs(r.dot(v)) < 1e-10);
        // The force towards the centre: centripetal, and the part of the weight.
        ASSERT_EQUAL_TOL(2 * v.dot(v) - 20 * r[2], integrator.getExpressionConstraintMultiplier(0), 1e-9);
        ASSERT_EQUAL(integrator.getMultipliers()[0], integrator.getExpressionConstraintMultiplier(0));
        const double energy = state.getKineticEnergy() + state.getPotentialEnergy();
        if (i == 0)
            first = energy;
        ASSERT_EQUAL_TOL(first, energy, 1e-4);
    }
    ASSERT_EQUAL(201, integrator.getNumForceEvaluations());
}

inline void testSettersAndGetters() {
    Integrator_ integrator(0.001);
    ASSERT_EQUAL(0, integrator.addConstraint("x1-k", {3}, {{"k", 2.0}}));
    ASSERT_EQUAL(1, integrator.addConstraint("x1-x2", {3, 5}));
    integrator.setExpressionConstraintParameter(0, "k", 3.0);
    std::string expression;
    vector<int> particles;
    std::map<std::string, double> parameters;
    integrator.getExpressionConstraintParameters(0, expression, particles, parameters);
    ASSERT_EQUAL(std::string("x1-k"), expression);
    ASSERT(particles == vector<int>{3});
    ASSERT_EQUAL(3.0, parameters.at("k"));
    integrator.setExpressionConstraintParameters(1, "x1+y1", {4}, {});
    std::unique_ptr<Integrator_> copy = fromXml(toXml(integrator));
    ASSERT_EQUAL(2, copy->getNumExpressionConstraints());
    copy->getExpressionConstraintParameters(1, expression, particles, parameters);
    ASSERT_EQUAL(std::string("x1+y1"), expression);
    ASSERT(particles == vector<int>{4} && parameters.empty());
    assertThrows("which is neither a coordinate", [&] { integrator.addConstraint("x1-q", {0}); });
    assertThrows("no expression constraint with index 2",
                 [&] { integrator.getExpressionConstraintParameters(2, expression, particles, parameters); });
}

inline void testRunsWithExpressionsGoOn() {
    TestSystem t;
    makeSphericalPendulum(t);
    Integrator_ integrator = makePendulumIntegrator(), other = makePendulumIntegrator();
    integrator.addConstraint(SPHERE, {1, 0}, {{"r", 1.0}});
    other.addConstraint(SPHERE, {1, 0}, {{"r", 1.4}});
    Context context(t.system, integrator, getTestPlatform()), otherContext(t.system, other, getTestPlatform());
    start(context, t);
    start(otherContext, t);
    integrator.step(20);
    other.step(5);
    loadCheckpoint(otherContext, checkpointOf(context));
    assertSame(Trace(context, integrator, 20), Trace(otherContext, other, 20));
    Integrator_ bare = makePendulumIntegrator();
    bare.clearMonitors();
    Context bareContext(t.system, bare, getTestPlatform());
    start(bareContext, t);
    assertThrows("masses or constraints are not those of this one",
                 [&] { loadCheckpoint(bareContext, checkpointOf(context)); });
}

inline TestList getExpressionTests() {
    return {{"the tension of a spherical pendulum", testTension},
            {"setters, getters and XML", testSettersAndGetters},
            {"runs with expressions go on from checkpoints", testRunsWithExpressionsGoOn}};
}

} // namespace OpenMMVRattle
