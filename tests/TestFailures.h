// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Whatever fails, and whatever the user does next: the run goes on as if nothing had been tried. And the time at which forces are
// computed. Each platform's tests/ includes this file.

#include "TestSerialization.h"
#include "WatchedForce.h"
#include <cmath>
#include <functional>
#include <memory>
#include <string>
#include <vector>

namespace OpenMMVRattle {

// A crooked chain of five with springs between next neighbours but one and an external field: all forces are computed by one Force
// in a fixed order, so that they are the same bits on every platform.
struct WatchedChain {
    explicit WatchedChain(const std::string& control) : watch(std::make_shared<Watch>()), integrator(0.002) {
        const int length = 5;
        for (int i = 0; i < length; i++) {
            system.addParticle(10 + 5 * (i % 3));
            positions.push_back(Vec3(0.12 * i, 0.05 * (i % 2), 0.02 * ((i / 2) % 2)));
            velocities.push_back(Vec3(std::sin(3.0 * i), std::cos(5.0 * i), std::sin(7.0 * i)) * 2.0);
            if (i > 0) {
                const Vec3 r = positions[i] - positions[i - 1];
                system.addConstraint(i - 1, i, std::sqrt(r.dot(r)));
            }
        }
        watch->compute = [](const Watch::Vectors& q, double, double strength, Watch::Vectors& forces) {
            double energy = 0;
            for (size_t i = 0; i < q.size(); i++) {
                energy += strength * 20 * q[i].dot(q[i]);
                forces[i] = q[i] * (-strength * 40);
            }
            for (size_t i = 0; i + 2 < q.size(); i++) {
                const Vec3 r = q[i + 2] - q[i];
                const double distance = std::sqrt(r.dot(r)), stretch = distance - 0.2;
                energy += 1000 * stretch * stretch;
                forces[i] += r * (2000 * stretch / distance);
                forces[i + 2] -= r * (2000 * stretch / distance);
            }
            return energy;
        };
        system.addForce(new WatchedForce(watch));
        CustomExternalForce* group = new CustomExternalForce("1+10*x^2");
        group->addParticle(3);
        group->setForceGroup(5);
        system.addForce(group);
        integrator.setMonitorForceGroup(5);
        integrator.setIntegrationForceGroups(-1 & ~(1 << 5));
        choose(control);
        context = std::make_unique<Context>(system, integrator, getTestPlatform());
        context->setPositions(positions);
        context->setVelocities(velocities);
    }
    void choose(const std::string& control) {
        if (control == "explicit")
            integrator.setUpdateMethod(Integrator_::Explicit);
        if (control == "bounded")
            integrator.setUpdateMethod(Integrator_::Bounded);
        if (control == "given reference")
            integrator.setReferenceMonitorValue(40.0);
        if (control == "mixed") { // one with a reference value, one without, one that costs an energy
            integrator.clearMonitors();
            integrator.addMonitor(Integrator_::ConstraintAndAppliedForce);
            integrator.addMonitor(Integrator_::VectorField, 2.0, 0.5);
            integrator.addMonitor(Integrator_::ForceGroupEnergy);
            integrator.setReferenceMonitorValue(70.0, 1);
        }
        if (control == "fixed")
            integrator.clearMonitors();
        if (control == "automatic")
            integrator.useAutomaticStepControl(4);
    }
    std::shared_ptr<Watch> watch;
    System system;
    vector<Vec3> positions, velocities;
    Integrator_ integrator;
    std::unique_ptr<Context> context;
};

struct Deed {
    std::string name;
    std::function<void(WatchedChain&)> act;
};

// How far a run has come when something fails.
inline vector<Deed> getStages() {
    vector<Deed> stages = {
        {"first step", [](WatchedChain&) {}},
        {"looked at", [](WatchedChain& c) { c.integrator.getMultipliers(); }},
        {"in the course", [](WatchedChain& c) { c.integrator.step(7); }},
        {"after new velocities",
         [](WatchedChain& c) {
             c.integrator.step(7);
             c.context->setVelocities(c.velocities);
         }},
        {"after reverse",
         [](WatchedChain& c) {
             c.integrator.step(7);
             c.integrator.reverse();
         }},
        {"after loading",
         [](WatchedChain& c) {
             c.integrator.step(7);
             loadCheckpoint(*c.context, checkpointOf(*c.context));
         }},
    };
    if (isOnGpu())
        stages = {stages[0], stages[2]};
    return stages;
}

// What fails; each computes forces somewhere on its way.
inline vector<Deed> getAttempts(int count) {
    vector<Deed> attempts = {
        {"step", [](WatchedChain& c) { c.integrator.step(1); }},
        {"setVelocitiesToTemperature", [](WatchedChain& c) { c.integrator.setVelocitiesToTemperature(300, 1); }},
        {"stepTo", [](WatchedChain& c) { c.integrator.stepTo(c.context->getTime() + 0.00002); }},
        {"calibrate",
         [](WatchedChain& c) {
             if (c.integrator.isAutomatic() || c.integrator.getNumMonitors() > 0)
                 c.integrator.calibrate(3);
         }},
        {"reverse", [](WatchedChain& c) { c.integrator.reverse(); }},
        {"getMultipliers", [](WatchedChain& c) { c.integrator.getMultipliers(); }},
    };
    attempts.resize(count);
    return attempts;
}

// What the user does next.
inline vector<Deed> getNextDeeds() {
    return {
        {"nothing", [](WatchedChain&) {}},
        {"another step size", [](WatchedChain& c) { c.integrator.setStepSize(0.0013); }},
        {"a minimum", [](WatchedChain& c) { c.integrator.setMinimumStepSize(0.0009); }},
        {"a maximum", [](WatchedChain& c) { c.integrator.setMaximumStepSize(0.0027); }},
        {"explicit", [](WatchedChain& c) { c.integrator.setUpdateMethod(Integrator_::Explicit); }},
        {"bounded", [](WatchedChain& c) { c.integrator.setUpdateMethod(Integrator_::Bounded); }},
        {"a tolerance", [](WatchedChain& c) { c.integrator.setConstraintTolerance(1e-10); }},
        {"a reference value",
         [](WatchedChain& c) {
             if (c.integrator.isAutomatic() || c.integrator.getNumMonitors() > 0)
                 c.integrator.setReferenceMonitorValue(55.0);
         }},
        {"no reference value",
         [](WatchedChain& c) {
             if (c.integrator.isAutomatic() || c.integrator.getNumMonitors() > 0)
                 c.integrator.setReferenceMonitorValue(0.0);
         }},
        {"other monitors", [](WatchedChain& c) { c.choose("mixed"); }},
        {"fixed steps", [](WatchedChain& c) { c.choose("fixed"); }},
        {"automatic", [](WatchedChain& c) { c.choose("automatic"); }},
        {"other force groups", [](WatchedChain& c) { c.integrator.setIntegrationForceGroups(-1); }},
        {"a parameter", [](WatchedChain& c) { c.context->setParameter("strength", 1.5); }},
        {"positions", [](WatchedChain& c) { c.context->setPositions(c.positions); }},
        {"velocities", [](WatchedChain& c) { c.context->setVelocities(c.velocities); }},
        {"reverse", [](WatchedChain& c) { c.integrator.reverse(); }},
        {"calibrate",
         [](WatchedChain& c) {
             if (c.integrator.isAutomatic() || c.integrator.getNumMonitors() > 0)
                 c.integrator.calibrate(3);
         }},
        {"stepTo", [](WatchedChain& c) { c.integrator.stepTo(c.context->getTime() + 0.00002); }},
        {"a checkpoint", [](WatchedChain& c) { loadCheckpoint(*c.context, checkpointOf(*c.context)); }},
        {"reinitialize", [](WatchedChain& c) { c.context->reinitialize(true); }},
    };
}

// What can be seen of the Context: nothing of it changes where something fails.
inline vector<double> lookAt(WatchedChain& c) {
    const State state = c.context->getState(State::Positions | State::Velocities | State::Parameters);
    vector<double> numbers = {state.getTime(), (double) state.getStepCount(), c.integrator.getStepSize(),
                              c.integrator.getStepDensity()};
    for (const vector<Vec3>& vectors : {state.getPositions(), state.getVelocities()})
        for (const Vec3& v : vectors)
            for (int j = 0; j < 3; j++)
                numbers.push_back(v[j]);
    return numbers;
}

inline double largestDifference(const vector<double>& a, const vector<double>& b) {
    ASSERT_EQUAL(a.size(), b.size());
    double largest = 0;
    for (size_t i = 0; i < a.size(); i++)
        largest = std::max(largest, std::fabs(a[i] - b[i]));
    return largest;
}

// On GPUs, where a Context takes long to create and the steps with this Force are taken by the same code, a few will do.
inline vector<const char*> getControls() {
    if (isOnGpu())
        return {"default"};
    return {"default", "explicit", "bounded", "given reference", "mixed", "fixed", "automatic"};
}

// Forces that fail at each of their evaluations, until none is left that an attempt computes.
inline void testForcesThatFail() {
    const vector<Deed> deeds = getNextDeeds();
    int numFailures = 0;
    size_t turn = 0; // not every deed follows every failure, but each comes in turn
    for (const char* control : getControls())
        for (const Deed& stage : getStages())
            for (const Deed& attempt : getAttempts(isOnGpu() ? 3 : 6))
                for (const auto failure : {Watch::Raises, Watch::NotANumber})
                    for (int evaluation = 1;; evaluation++) {
                        bool hasFailed = false;
                        for (const Deed& next : deeds) {
                            const bool isThorough = getTestPlatform().getName() == "Reference" &&
                                                    attempt.name == "step" && failure == Watch::Raises;
                            if (!isThorough && &next != &deeds[turn % deeds.size()])
                                continue;
                            const std::string name = std::string(control) + ", " + stage.name + ", " + attempt.name +
                                                     " fails in evaluation " + std::to_string(evaluation) +
                                                     (failure == Watch::Raises ? ", then " : " (NaN), then ") +
                                                     next.name;
                            try {
                                WatchedChain tried(control), untried(control);
                                stage.act(tried);
                                stage.act(untried);
                                const vector<double> before = lookAt(tried);
                                tried.watch->failAt(evaluation, failure);
                                bool isThrown = false;
                                try {
                                    attempt.act(tried);
                                }
                                catch (const OpenMMException&) {
                                    isThrown = true;
                                }
                                hasFailed = tried.watch->hasFailed();
                                if (!hasFailed)
                                    break;
                                tried.watch->recover();
                                // Trial steps of automatic control that fail are made shorter, and then the attempt succeeds.
                                if (!isThrown)
                                    continue;
                                ASSERT(largestDifference(before, lookAt(tried)) <= sameRunTolerance());
                                next.act(tried);
                                next.act(untried);
                                assertSame(Trace(*untried.context, untried.integrator, 8),
                                           Trace(*tried.context, tried.integrator, 8));
                                numFailures++;
                            }
                            catch (const std::exception& e) {
                                throw OpenMMException(name + ": " + e.what());
                            }
                        }
                        turn++;
                        if (!hasFailed)
                            break;
                    }
    ASSERT(numFailures > (getTestPlatform().getName() == "Reference" ? 1000 : isOnGpu() ? 10 : 200));
}

// Steps that are too large for the equations to be solved: at the first step with each control, in the course of a run, and in the
// second pass of a first step that is taken twice.
inline void testStepsThatAreTooLarge() {
    for (const char* control : getControls())
        for (const Deed& stage : getStages())
            for (const Deed& attempt : {Deed{"step", [](WatchedChain& c) { c.integrator.step(1); }},
                                        Deed{"calibrate", [](WatchedChain& c) { c.integrator.calibrate(3); }},
                                        Deed{"reverse", [](WatchedChain& c) { c.integrator.reverse(); }}})
                for (const double size : isOnGpu() ? vector<double>{0.3} : vector<double>{0.02, 0.05, 0.1, 0.3, 1.0}) {
                    WatchedChain tried(control), untried(control);
                    for (WatchedChain* each : {&tried, &untried}) {
                        stage.act(*each);
                        each->integrator.setStepSize(size);
                        each->integrator.getMultipliers(); // from here on the settings are in force
                    }
                    const vector<double> before = lookAt(tried);
                    try {
                        attempt.act(tried);
                        continue; // it was not too large
                    }
                    catch (const OpenMMException&) {
                    }
                    const std::string name = std::string(control) + ", " + stage.name + ", " + attempt.name + " of " +
                                             std::to_string(size) + " ps";
                    try {
                        ASSERT(largestDifference(before, lookAt(tried)) <= sameRunTolerance());
                        for (WatchedChain* each : {&tried, &untried})
                            each->integrator.setStepSize(0.002);
                        assertSame(Trace(*untried.context, untried.integrator, 12),
                                   Trace(*tried.context, tried.integrator, 12));
                    }
                    catch (const std::exception& e) {
                        throw OpenMMException(name + ": " + e.what());
                    }
                }
}

// A pull that makes everything faster by 220 nm/fs in each step, as what is far beyond the limit of stability becomes: the fifth would
// be faster than three times light. References out of reach keep automatic step control from shortening steps.
inline void testFasterThanLight() {
    const double size = 0.004;
    System system;
    auto* pull = new CustomExternalForce("-5.5e8*x");
    vector<Vec3> positions;
    for (int i = 0; i < 3; i++) {
        system.addParticle(10);
        pull->addParticle(i);
        positions.push_back(Vec3(0.1 * i, 0.2, 0.3));
    }
    system.addConstraint(0, 1, 0.1);
    system.addForce(pull);
    Integrator_ integrator(size);
    integrator.useAutomaticStepControl(30);
    for (int k = 0; k < 2; k++)
        integrator.setReferenceMonitorValue(1e20, k);
    Context context(system, integrator, getTestPlatform());
    context.setPositions(positions);
    for (int attempt = 0; attempt < 2; attempt++) {
        assertThrows("the particles have become faster than light", [&] { integrator.step(50); });
        ASSERT_EQUAL(4, context.getStepCount());
        ASSERT_EQUAL_TOL(4 * size, context.getTime(), 1e-12);
        const State state = context.getState(State::Velocities);
        for (const Vec3& v : state.getVelocities())
            ASSERT_EQUAL_TOL(8.8e5, v[0], 1e-5);
    }
    context.setPositions(positions);
    context.setVelocities(vector<Vec3>(3));
    integrator.step(4);
    ASSERT_EQUAL(8, context.getStepCount());
}

// A first step that is taken twice fails in either pass; whatever is chosen then, the density does not oscillate.
inline void testDensityAfterFailedFirstStep() {
    for (const int evaluation : {2, 3})
        for (const double reference : {40.0, 80.0, 160.0}) {
            WatchedChain c("given reference");
            c.watch->failAt(evaluation, Watch::Raises);
            assertThrows("out of order", [&] { c.integrator.step(1); });
            ASSERT(c.watch->hasFailed());
            c.watch->recover();
            c.integrator.setStepSize(0.0005);
            c.integrator.setReferenceMonitorValue(reference);
            c.integrator.step(1);
            double density[3] = {0, 0, c.integrator.getStepDensity()};
            for (int i = 0; i < 40; i++) {
                c.integrator.step(1);
                density[0] = density[1];
                density[1] = density[2];
                density[2] = c.integrator.getStepDensity();
                if (i > 0)
                    ASSERT(std::fabs(density[0] - 2 * density[1] + density[2]) < 0.02 * density[1]);
            }
        }
}

// Forces at the end of a step see its time and step count, and after a failure the clock is put back.
inline void testTimesOfForces() {
    for (const char* control : getControls()) {
        WatchedChain c(control);
        c.integrator.step(3);
        for (int i = 0; i < 20; i++) {
            c.watch->seen.clear();
            if (i % 5 == 4)
                c.integrator.stepTo(c.context->getTime() + 0.0013);
            else
                c.integrator.step(1);
            ASSERT_EQUAL(c.context->getTime(), c.watch->seen.back().time);
            ASSERT_EQUAL(c.context->getStepCount(), c.watch->seen.back().stepCount);
        }
        const double time = c.context->getTime();
        const long long count = c.context->getStepCount();
        for (const auto failure : {Watch::Raises, Watch::NotANumber}) {
            c.watch->failAt(1, failure);
            assertThrows("", [&] { c.integrator.step(1); });
            c.watch->recover();
            ASSERT_EQUAL(time, c.context->getTime());
            ASSERT_EQUAL(count, c.context->getStepCount());
        }
        // Trial steps have times of their own, and leave the clock as it was.
        if (c.integrator.getNumMonitors() > 0) {
            c.watch->seen.clear();
            c.integrator.calibrate(3);
            for (int i = 0; i < 3; i++)
                ASSERT_EQUAL_TOL(time + 0.002 * (i + 1), c.watch->seen[i].time, 1e-12);
            ASSERT_EQUAL(time, c.context->getTime());
            ASSERT_EQUAL(count, c.context->getStepCount());
        }
    }
}

// x'' = cos(2 t) from x = 0, x' = 1: x = t + (1 - cos(2 t))/4. The error falls with the square of the step size.
inline void testForceThatDependsOnTime() {
    for (const bool isVariable : {false, true}) {
        double errors[2];
        for (int refine = 0; refine < 2; refine++) {
            const auto watch = std::make_shared<Watch>();
            watch->compute = [](const Watch::Vectors&, double time, double, Watch::Vectors& forces) {
                forces[0] = Vec3(3 * std::cos(2 * time), 0, 0);
                return 0.0;
            };
            System system;
            system.addParticle(3);
            system.addForce(new WatchedForce(watch));
            Integrator_ integrator(refine == 0 ? 0.02 : 0.01);
            integrator.clearMonitors();
            if (isVariable)
                integrator.addMonitor(Integrator_::ArcLength);
            Context context(system, integrator, getTestPlatform());
            context.setPositions({Vec3()});
            context.setVelocities({Vec3(1, 0, 0)});
            errors[refine] = 0;
            while (context.getTime() < 5.0) {
                integrator.step(1);
                const State state = context.getState(State::Positions | State::Velocities);
                const double t = state.getTime();
                errors[refine] = std::max({errors[refine],
                                           std::fabs(state.getPositions()[0][0] - (t + 0.25 * (1 - std::cos(2 * t)))),
                                           std::fabs(state.getVelocities()[0][0] - (1 + 0.5 * std::sin(2 * t)))});
            }
        }
        ASSERT(errors[0] < 1e-3);
        ASSERT(errors[0] / errors[1] > 3.6 && errors[0] / errors[1] < 4.4);
    }
}

inline TestList getFailureTests() {
    return {
        {"forces that fail", testForcesThatFail},
        {"steps that are too large", testStepsThatAreTooLarge},
        {"faster than light", testFasterThanLight},
        {"the density after a failed first step", testDensityAfterFailedFirstStep},
        {"times of forces", testTimesOfForces},
        {"a force that depends on time", testForceThatDependsOnTime},
    };
}

} // namespace OpenMMVRattle
