// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// AndersenThermostat on a GPU, where it has a kernel of ours: how often particles collide, and what becomes of a failure.

#include "Dumbbells.h"
#include "GpuTests.h"

#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include <cmath>

using namespace OpenMMVRattle;
using namespace OpenMM;
using std::vector;

namespace {

typedef VariableStepRattleIntegrator Integrator_;

// Collisions come as often as they should, for the time that has passed, and to both particles of a dumbbell; at zero temperature they
// stop what flies freely.
void testCollisions() {
    const int count = 2000;
    Dumbbells t(count, "0*x");
    t.addThermostat(0, 0);
    Integrator_ integrator(0.002);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ConstraintMultipliers); // by which steps become longer as particles stop
    integrator.setMaximumStepSize(0.008);
    Context context(t.system, integrator, getTestPlatform());
    t.begin(context);
    integrator.step(5);
    const double begin = context.getTime(), frequency = 20;
    context.setParameter(AndersenThermostat::CollisionFrequency(), frequency);
    const double first = integrator.getStepSize();
    integrator.step(15);
    ASSERT(integrator.getStepSize() > 1.1 * first);
    // The last step has not had its collisions, and the one before the first has.
    const double time = context.getTime() - begin - integrator.getStepSize() + first;
    const vector<Vec3> velocities = context.getState(State::Velocities).getVelocities();
    int numFlying = 0;
    for (int i = 0; i < count; i++) {
        const bool isFlying = velocities[2 * i].dot(velocities[2 * i]) > 1e-20; // which is more than rounding
        ASSERT_EQUAL(isFlying, velocities[2 * i + 1].dot(velocities[2 * i + 1]) > 1e-20);
        numFlying += isFlying;
    }
    const double expected = std::exp(-frequency * time), scatter = std::sqrt(expected * (1 - expected) / count);
    ASSERT(std::fabs((double) numFlying / count - expected) < 4 * scatter);
}

// The temperature of what they leave.
void testTemperature() {
    const int count = 2000;
    Dumbbells t(count, "0*x");
    t.addThermostat(300, 1000);
    Integrator_ integrator(0.001);
    integrator.clearMonitors();
    Context context(t.system, integrator, getTestPlatform());
    t.begin(context);
    integrator.step(30);
    // Every dumbbell has collided; five degrees of freedom each.
    const double expected = 0.5 * 5 * count * BOLTZMANN * 300;
    ASSERT(std::fabs(context.getState(State::Energy).getKineticEnergy() / expected - 1) <
           4 * std::sqrt(2.0 / (5 * count)));
}

// Velocities that no step can begin with: the failure is found at the end of step(n), and the run is where it was.
void testFailureOfAChange() {
    Dumbbells t(20);
    t.addThermostat(300, 0);
    Integrator_ integrator(0.001);
    Context context(t.system, integrator, getTestPlatform());
    t.begin(context);
    for (const int before : {7, 5}) {
        integrator.step(before);
        const State state = context.getState(State::Positions | State::Velocities);
        context.setParameter(AndersenThermostat::Temperature(), 1e40);
        context.setParameter(AndersenThermostat::CollisionFrequency(), 1e9);
        std::string message;
        try {
            integrator.step(10);
        }
        catch (const OpenMMException& failure) {
            message = failure.what();
        }
        ASSERT(message.find("VariableStepRattleIntegrator: the step at t = ") == 0);
        ASSERT_EQUAL(state.getStepCount(), context.getStepCount());
        ASSERT_EQUAL_TOL(state.getTime(), context.getTime(), 1e-6);
        ASSERT(largestDifference(state.getPositions(), context.getState(State::Positions).getPositions()) <= 1e-6);
        context.setParameter(AndersenThermostat::Temperature(), 300);
        context.setParameter(AndersenThermostat::CollisionFrequency(), 0);
        context.setVelocities(state.getVelocities());
    }
    integrator.step(3);
    ASSERT_EQUAL(15, context.getStepCount());
}

} // namespace

int main(int argc, char** argv) {
    return runOnPlatform({{"collisions", testCollisions},
                          {"temperature", testTemperature},
                          {"failure of a change", testFailureOfAChange}},
                         argc, argv);
}
