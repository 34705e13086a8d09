// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// XML, checkpoints, States and reinitialization. Each platform's tests/ includes this file and its own setup.

#include "TestVariableStepRattleIntegrator.h"
#include "openmm/CompoundIntegrator.h"
#include "openmm/VariableVerletIntegrator.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmm/serialization/XmlSerializer.h"
#include "openmmvrattle/VariableStepRattleIntegratorProxy.h"
#include <memory>
#include <sstream>

namespace OpenMMVRattle {

const Integrator_::UpdateMethod ALL_UPDATES[] = {Integrator_::SemiExplicit, Integrator_::Explicit,
                                                 Integrator_::Bounded};

inline std::string toXml(const Integrator_& integrator) {
    std::stringstream stream;
    XmlSerializer::serialize<Integrator>(&integrator, "Integrator", stream);
    return stream.str();
}

inline std::unique_ptr<Integrator_> fromXml(const std::string& xml) {
    std::stringstream stream(xml);
    std::unique_ptr<Integrator> result(XmlSerializer::deserialize<Integrator>(stream));
    Integrator_* ours = dynamic_cast<Integrator_*>(result.get());
    ASSERT(ours != nullptr);
    result.release();
    return std::unique_ptr<Integrator_>(ours);
}

inline std::string replaced(std::string text, const std::string& from, const std::string& to) {
    const size_t position = text.find(from);
    ASSERT(position != std::string::npos);
    return text.replace(position, from.size(), to);
}

inline std::string checkpointOf(Context& context) {
    std::stringstream stream;
    context.createCheckpoint(stream);
    return stream.str();
}

inline void loadCheckpoint(Context& context, const std::string& checkpoint) {
    std::stringstream stream(checkpoint);
    context.loadCheckpoint(stream);
}

// Everything that can be seen of a run after some more steps.
struct Trace {
    Trace(Context& context, Integrator_& integrator, int steps) {
        if (isOnGpu())
            steps = std::min(steps, 50); // rounding grows
        for (int i = 0; i < steps; i++) {
            integrator.step(1);
            numbers.push_back(integrator.getStepSize());
            numbers.push_back(integrator.getStepDensity());
        }
        State state = context.getState(State::Positions | State::Velocities);
        for (const vector<Vec3>& vectors : {state.getPositions(), state.getVelocities()})
            for (const Vec3& v : vectors)
                for (int j = 0; j < 3; j++)
                    numbers.push_back(v[j]);
        for (int k = 0; k < (integrator.isAutomatic() ? 2 : integrator.getNumMonitors()); k++) {
            numbers.push_back(integrator.getReferenceMonitorValue(k));
            numbers.push_back(integrator.getMonitorValue(k));
        }
        numbers.push_back(context.getTime());
        numbers.push_back(context.getStepCount());
    }
    vector<double> numbers;
};

inline void assertSame(const Trace& expected, const Trace& found, double tolerance = 0) {
    tolerance = std::max(tolerance, sameRunTolerance());
    ASSERT_EQUAL(expected.numbers.size(), found.numbers.size());
    for (size_t i = 0; i < expected.numbers.size(); i++) {
        if (tolerance == 0)
            ASSERT_EQUAL(expected.numbers[i], found.numbers[i]);
        ASSERT_EQUAL_TOL(expected.numbers[i], found.numbers[i], tolerance);
    }
}

// XML is made of all settings, among them what has no function to read it (whether a bound or a reference value was set).
inline void assertSameSettings(const Integrator_& expected, const Integrator_& found) {
    ASSERT_EQUAL(toXml(expected), toXml(found));
    ASSERT_EQUAL(expected.getNominalStepSize(), found.getNominalStepSize());
    ASSERT_EQUAL(expected.getMinimumStepSize(), found.getMinimumStepSize());
    ASSERT_EQUAL(expected.getMaximumStepSize(), found.getMaximumStepSize());
    ASSERT_EQUAL(expected.getUpdateMethod(), found.getUpdateMethod());
    ASSERT_EQUAL(expected.getConstraintTolerance(), found.getConstraintTolerance());
    ASSERT_EQUAL(expected.getIntegrationForceGroups(), found.getIntegrationForceGroups());
    ASSERT_EQUAL(expected.getMonitorForceGroup(), found.getMonitorForceGroup());
    ASSERT_EQUAL(expected.getNumMonitors(), found.getNumMonitors());
    ASSERT_EQUAL(expected.isAutomatic(), found.isAutomatic());
    ASSERT_EQUAL(expected.getCalibrationSteps(), found.getCalibrationSteps());
    for (int i = 0; i < expected.getNumMonitors(); i++) {
        Integrator_::MonitorKind kind1, kind2;
        double weight1, weight2, power1, power2;
        expected.getMonitor(i, kind1, weight1, power1);
        found.getMonitor(i, kind2, weight2, power2);
        ASSERT_EQUAL(kind1, kind2);
        ASSERT_EQUAL(weight1, weight2);
        ASSERT_EQUAL(power1, power2);
        ASSERT_EQUAL(expected.getMonitorNormOrder(i), found.getMonitorNormOrder(i));
    }
}

// An integrator none of whose settings has its default.
inline void changeAllSettings(Integrator_& integrator) {
    integrator.setNominalStepSize(0.0012345678901234567);
    integrator.setMinimumStepSize(1e-5 / 3);
    integrator.setMaximumStepSize(0.01 / 3);
    integrator.setUpdateMethod(Integrator_::Bounded);
    integrator.setConstraintTolerance(1e-9 / 7);
    integrator.setIntegrationForceGroups(0x80000005);
    integrator.setNormOrder(5.5);
    integrator.setMonitorForceGroup(7);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::MultiplierPNorm, 0.1, 1.0 / 3);
    integrator.addMonitor(Integrator_::AppliedForce, 2, 2);
    integrator.addMonitor(Integrator_::ForcePNorm, 1, 1, 3.5);
    integrator.setReferenceMonitorValue(1e5 / 7, 1);
}

inline void testXml() {
    Integrator_ plain(0.002), changed(1), bounded(0.002), unlimited(0.002), fixed(0.002), automatic(0.002);
    changeAllSettings(changed);
    bounded.setMaximumStepSize(0.003);
    unlimited.setMinimumStepSize(0);
    unlimited.setMaximumStepSize(0);
    fixed.clearMonitors();
    automatic.useAutomaticStepControl(77);
    automatic.setReferenceMonitorValue(1e3 / 7, 1);
    for (Integrator_* integrator : {&plain, &changed, &bounded, &unlimited, &fixed, &automatic}) {
        std::unique_ptr<Integrator_> copy = fromXml(toXml(*integrator));
        assertSameSettings(*integrator, *copy);
        std::unique_ptr<Integrator> clone(XmlSerializer::clone<Integrator>(*integrator));
        assertSameSettings(*integrator, dynamic_cast<Integrator_&>(*clone));
    }
    ASSERT_EQUAL(5.5, fromXml(toXml(changed))->getMonitorNormOrder(0));
    ASSERT_EQUAL(3.5, fromXml(toXml(changed))->getMonitorNormOrder(2));
    // A bound that was not set goes on following the nominal step size; one that was set does not.
    std::unique_ptr<Integrator_> copy = fromXml(toXml(bounded));
    copy->setNominalStepSize(0.001);
    ASSERT_EQUAL_TOL(0.001 / 50, copy->getMinimumStepSize(), 1e-14);
    ASSERT_EQUAL(0.003, copy->getMaximumStepSize());

    // The settings of an integrator in use, without its Context and without what it has found by itself.
    TestSystem t;
    makeChain(t, 5);
    Integrator_ used(0.002);
    Run run(t, used);
    used.step(5);
    ASSERT(used.getReferenceMonitorValue() > 0);
    copy = fromXml(toXml(used));
    ASSERT_EQUAL(0.0, copy->getReferenceMonitorValue());
    ASSERT_EQUAL(0.002, copy->getStepSize());
    assertThrows("not bound", [&] { copy->step(1); });
}

inline void testBadXml() {
    Integrator_ integrator(0.002);
    const std::string xml = toXml(integrator);
    assertThrows("version 7 of their format and this plugin reads version 3",
                 [&] { fromXml(replaced(xml, "version=\"3\"", "version=\"7\"")); });
    assertThrows("version 0", [&] { fromXml(replaced(xml, "version=\"3\"", "version=\"0\"")); });
    assertThrows("step size", [&] { fromXml(replaced(xml, "stepSize=\"", "stepSize=\"-")); });
    assertThrows("stepSize", [&] { fromXml(replaced(xml, "stepSize", "size")); });
    assertThrows("no monitor of kind 99", [&] { fromXml(replaced(xml, "kind=\"0\"", "kind=\"99\"")); });
    assertThrows("update method", [&] { fromXml(replaced(xml, "updateMethod=\"0\"", "updateMethod=\"3\"")); });
    assertThrows("weight", [&] { fromXml(replaced(xml, "weight=\"1\"", "weight=\"0\"")); });
}

// A way to bring a run into a state worth saving.
struct Situation {
    std::string name;
    std::function<void(Run&)> make;
};

inline vector<Situation> getSituations() {
    return {
        {"never stepped", [](Run&) {}},
        {"never stepped, but looked at", [](Run& run) { run.integrator.getMonitorValue(); }},
        {"after steps", [](Run& run) { run.integrator.step(50); }},
        {"after stepTo",
         [](Run& run) {
             run.integrator.step(20);
             run.integrator.stepTo(run.context.getTime() + 0.0093);
         }},
        {"after reverse",
         [](Run& run) {
             run.integrator.step(30);
             run.integrator.reverse();
         }},
        {"after velocities were set",
         [](Run& run) {
             run.integrator.step(30);
             vector<Vec3> velocities = run.velocities();
             for (Vec3& v : velocities)
                 v *= 1.1;
             run.context.setVelocities(velocities);
         }},
        {"ahead of the method",
         [](Run& run) {
             run.integrator.step(30);
             vector<Vec3> positions = run.positions(), velocities = run.velocities();
             positions[1] += Vec3(1e-4, 2e-4, 3e-4);
             velocities[0] += Vec3(0.1, 0.2, 0.3);
             run.context.setPositions(positions);
             run.context.setVelocities(velocities);
             run.integrator.getMultipliers();
         }},
        {"ahead of the method, and changed again",
         [](Run& run) {
             run.integrator.step(30);
             vector<Vec3> velocities = run.velocities();
             velocities[0] += Vec3(0.1, 0.2, 0.3);
             run.context.setVelocities(velocities);
             run.integrator.getMultipliers();
             run.context.applyVelocityConstraints(1e-3);
         }},
        {"after settings were changed",
         [](Run& run) {
             run.integrator.step(30);
             run.integrator.setNominalStepSize(0.9 * run.integrator.getNominalStepSize());
             run.integrator.setReferenceMonitorValue(1.2 * run.integrator.getReferenceMonitorValue());
         }},
        {"after calibrate",
         [](Run& run) {
             run.integrator.step(10);
             run.integrator.calibrate(5);
         }},
    };
}

// From each situation, the run that is saved, the same Context after other steps, and a Context that never stepped.
inline void testCheckpoints(bool isAutomatic) {
    for (Integrator_::UpdateMethod update : ALL_UPDATES) {
        if (isAutomatic && update != Integrator_::SemiExplicit)
            break; // it has an update of its own
        for (const Situation& situation : getSituations()) {
            try {
                TestSystem t;
                makeChain(t, 6, 3.0);
                Integrator_ integrator(0.002), fresh(0.001);
                integrator.setUpdateMethod(update);
                integrator.addMonitor(Integrator_::AppliedForce);
                if (isAutomatic)
                    integrator.useAutomaticStepControl(20);
                Run run(t, integrator);
                situation.make(run);
                const double size = integrator.getStepSize(), density = integrator.getStepDensity();
                const double reference = integrator.getReferenceMonitorValue(1);
                const std::string checkpoint = checkpointOf(run.context);
                const Trace uninterrupted(run.context, integrator, 500);

                integrator.setNominalStepSize(0.0005); // a checkpoint brings back the settings as well
                integrator.step(3);
                loadCheckpoint(run.context, checkpoint);
                ASSERT_EQUAL(size, integrator.getStepSize());
                ASSERT_EQUAL(density, integrator.getStepDensity());
                ASSERT_EQUAL(reference, integrator.getReferenceMonitorValue(1));
                assertSame(uninterrupted, Trace(run.context, integrator, 500));

                Context other(t.system, fresh, getTestPlatform());
                loadCheckpoint(other, checkpoint);
                assertSameSettings(integrator, fresh);
                ASSERT_EQUAL(size, fresh.getStepSize());
                ASSERT_EQUAL(density, fresh.getStepDensity());
                ASSERT_EQUAL(reference, fresh.getReferenceMonitorValue(1));
                // Saved again at once, it is still the same.
                loadCheckpoint(other, checkpointOf(other));
                assertSame(uninterrupted, Trace(other, fresh, 500));
            }
            catch (const std::exception& e) {
                throw OpenMMException(situation.name + ", update " + std::to_string(update) + ": " + e.what());
            }
        }
    }
}

inline void testCheckpointOfRescuedStep() {
    // Steps too large for the double pendulum, without bounds: the sum update runs out of positive densities at once.
    TestSystem t;
    makePendulum(t);
    Integrator_ integrator(0.355), fresh(0.001);
    integrator.setUpdateMethod(Integrator_::Explicit);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ConstraintMultipliers, 1, 2);
    integrator.setMinimumStepSize(0);
    integrator.setMaximumStepSize(0);
    Run run(t, integrator);
    for (int i = 0; i < 100 && integrator.getNumRescues() == 0; i++)
        integrator.step(1);
    ASSERT(integrator.getNumRescues() > 0);
    const std::string checkpoint = checkpointOf(run.context);
    const Trace uninterrupted(run.context, integrator, 20);
    Context other(t.system, fresh, getTestPlatform());
    loadCheckpoint(other, checkpoint);
    assertSame(uninterrupted, Trace(other, fresh, 20));
}

inline void testCheckpointOfForceGroupMonitor() {
    // Virtual sites, a massless particle, a Force that changes the velocities, and a monitor that is an energy.
    TestSystem t;
    makeChain(t, 4);
    t.system.addParticle(0);
    t.system.addParticle(0);
    t.system.setVirtualSite(4, new TwoParticleAverageSite(0, 1, 0.3, 0.7));
    t.positions.push_back(t.positions[0] * 0.3 + t.positions[1] * 0.7);
    t.positions.push_back(Vec3(0, 0.5, 0));
    t.velocities.resize(6);
    HarmonicBondForce* bond = new HarmonicBondForce();
    bond->addBond(4, 5, 0.3, 1000);
    t.system.addForce(bond);
    CustomExternalForce* monitor = new CustomExternalForce("1+10*x^2");
    monitor->addParticle(3);
    monitor->setForceGroup(31);
    t.system.addForce(monitor);
    t.system.addForce(new CMMotionRemover());
    Integrator_ integrator(0.002), fresh(0.001);
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ForceGroupEnergy);
    Run run(t, integrator);
    integrator.step(40);
    const std::string checkpoint = checkpointOf(run.context);
    const Trace uninterrupted(run.context, integrator, 500);
    Context other(t.system, fresh, getTestPlatform());
    loadCheckpoint(other, checkpoint);
    assertSame(uninterrupted, Trace(other, fresh, 500));
}

inline void testCountsAfterLoading() {
    TestSystem t;
    makeChain(t, 6);
    Integrator_ integrator(0.002);
    Run run(t, integrator);
    integrator.step(10);
    const std::string checkpoint = checkpointOf(run.context);
    integrator.step(10);
    ASSERT_EQUAL(21, integrator.getNumForceEvaluations());
    loadCheckpoint(run.context, checkpoint);
    ASSERT_EQUAL(21, integrator.getNumForceEvaluations());
    integrator.step(10);
    ASSERT_EQUAL(32, integrator.getNumForceEvaluations()); // one more, to see whether the forces are the same
    ASSERT_EQUAL(20, run.context.getStepCount());
}

inline void testRefusedCheckpoints() {
    TestSystem t, longer, heavier;
    makeChain(t, 6);
    Integrator_ integrator(0.002);
    Run run(t, integrator);
    integrator.step(20);
    const std::string checkpoint = checkpointOf(run.context);

    // Another System.
    makeChain(longer, 6);
    longer.system.setConstraintParameters(2, 2, 3, 0.15);
    makeChain(heavier, 6);
    heavier.system.setParticleMass(3, 20);
    for (TestSystem* system : {&longer, &heavier}) {
        Integrator_ other(0.001);
        Context context(system->system, other, getTestPlatform());
        assertThrows("another System", [&] { loadCheckpoint(context, checkpoint); });
        ASSERT_EQUAL(0.001, other.getNominalStepSize());
    }
    // Another version, damage, and every place where it can be cut off.
    const size_t start = checkpoint.find("VRATTLE\n");
    ASSERT(start != std::string::npos);
    std::string newer = checkpoint, damaged = checkpoint;
    newer[start + 8] = 9;
    assertThrows("version 9 of its format and this plugin reads version 6",
                 [&] { loadCheckpoint(run.context, newer); });
    damaged[damaged.size() - 100] ^= 1;
    assertThrows("damaged", [&] { loadCheckpoint(run.context, damaged); });
    for (size_t length = start + 1; length < checkpoint.size(); length++)
        assertThrows("OpenMM-VRATTLE: this checkpoint",
                     [&] { loadCheckpoint(run.context, checkpoint.substr(0, length)); });
    std::string endless = checkpoint;
    endless[start + 12 + 6] = 1; // the length
    assertThrows("cut short", [&] { loadCheckpoint(run.context, endless); });

    // The Context has the positions by now, and goes on from them afresh.
    Integrator_ fresh(0.002);
    fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue());
    TestSystem again;
    makeChain(again, 6);
    again.positions = run.positions();
    again.velocities = run.velocities();
    Run reference(again, fresh, false);
    integrator.step(10);
    fresh.step(10);
    ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-12);
    // And nothing has been lost.
    loadCheckpoint(run.context, checkpoint);
    ASSERT_EQUAL(20, run.context.getStepCount());
}

inline void testChangesAfterLoading() {
    // What the user changes after loading a checkpoint is a change, though OpenMM announces it just as its own.
    TestSystem t;
    makeChain(t, 6);
    Integrator_ integrator(0.002);
    Run run(t, integrator);
    integrator.step(20);
    const std::string checkpoint = checkpointOf(run.context);
    const vector<Vec3> here = run.positions();
    for (int i = 0; i < 3; i++) {
        loadCheckpoint(run.context, checkpoint);
        TestSystem changed;
        makeChain(changed, 6);
        changed.positions = here;
        changed.velocities = run.velocities();
        if (i == 0) {
            changed.positions = t.positions;
            run.context.setPositions(t.positions);
        }
        else if (i == 1) {
            for (Vec3& v : changed.velocities)
                v *= 0.5;
            run.context.setVelocities(changed.velocities);
        }
        else { // a Force is changed in the Context
            for (System* system : {&t.system, &changed.system}) {
                auto& angles = dynamic_cast<HarmonicAngleForce&>(system->getForce(0));
                for (int k = 0; k < angles.getNumAngles(); k++)
                    angles.setAngleParameters(k, k, k + 1, k + 2, 2.0, 150.0);
            }
            dynamic_cast<HarmonicAngleForce&>(t.system.getForce(0)).updateParametersInContext(run.context);
        }
        Integrator_ fresh(0.002);
        fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue());
        Run reference(changed, fresh, false);
        integrator.step(20);
        fresh.step(20);
        ASSERT_EQUAL_TOL(fresh.getStepDensity(), integrator.getStepDensity(), 1e-11);
        ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-12);
    }
    // A Force that has been changed in between: its parameters are not in the checkpoint, which is thus of another run.
    Integrator_ fresh(0.002);
    loadCheckpoint(run.context, checkpoint);
    fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue());
    t.positions = run.positions();
    t.velocities = run.velocities();
    Run reference(t, fresh, false);
    integrator.step(20);
    fresh.step(20);
    ASSERT_EQUAL_TOL(fresh.getStepDensity(), integrator.getStepDensity(), 1e-11);
    ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-12);
}

inline std::string toXml(const State& state) {
    std::stringstream stream;
    XmlSerializer::serialize<State>(&state, "State", stream);
    return stream.str();
}

inline State stateFromXml(const std::string& xml) {
    std::stringstream stream(xml);
    std::unique_ptr<State> state(XmlSerializer::deserialize<State>(stream));
    return *state;
}

const int WHOLE_STATE = State::Positions | State::Velocities | State::Parameters | State::IntegratorParameters;

inline void testStates() {
    for (Integrator_::UpdateMethod update : ALL_UPDATES) {
        for (const Situation& situation : getSituations()) {
            try {
                TestSystem t;
                makeChain(t, 6, 3.0);
                Integrator_ integrator(0.002), fresh(0.001);
                integrator.setUpdateMethod(update);
                integrator.setMaximumStepSize(0.005);
                Run run(t, integrator);
                situation.make(run);
                const double size = integrator.getStepSize(), density = integrator.getStepDensity();
                const double reference = integrator.getReferenceMonitorValue();
                const std::string xml = toXml(run.context.getState(WHOLE_STATE));
                const Trace uninterrupted(run.context, integrator, 50);
                Context other(t.system, fresh, getTestPlatform());
                other.setState(stateFromXml(xml));
                assertSameSettings(integrator, fresh);
                ASSERT_EQUAL(size, fresh.getStepSize());
                ASSERT_EQUAL(density, fresh.getStepDensity());
                ASSERT_EQUAL(reference, fresh.getReferenceMonitorValue());
                assertSame(uninterrupted, Trace(other, fresh, 50), 1e-12);
            }
            catch (const std::exception& e) {
                throw OpenMMException(situation.name + ", update " + std::to_string(update) + ": " + e.what());
            }
        }
    }
}

inline void testStatesElsewhere() {
    TestSystem t;
    makeChain(t, 6);
    Integrator_ integrator(0.002);
    Run run(t, integrator);
    integrator.step(20);
    const State state = run.context.getState(WHOLE_STATE);

    // Other forces, other constraints, or other velocities: a fresh start with the same reference value.
    for (int i = 0; i < 3; i++) {
        TestSystem other;
        makeChain(other, 6);
        if (i == 0) {
            HarmonicBondForce* restraint = new HarmonicBondForce();
            restraint->addBond(0, 5, 0.6, 1000);
            other.system.addForce(restraint);
        }
        if (i == 1)
            other.system.removeConstraint(4);
        other.positions = state.getPositions();
        other.velocities = state.getVelocities();
        Integrator_ restored(0.001), fresh(0.002);
        Run run(other, restored, false);
        run.context.setState(state);
        if (i == 2) {
            other.velocities[0] += Vec3(0, 0, 0.1);
            run.context.setVelocities(other.velocities);
            run.context.setState(run.context.getState(State::Velocities)); // one that has no parameters
        }
        fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue());
        Run reference(other, fresh, false);
        restored.step(20);
        fresh.step(20);
        ASSERT_EQUAL(integrator.getReferenceMonitorValue(), restored.getReferenceMonitorValue());
        ASSERT_EQUAL_TOL(fresh.getStepDensity(), restored.getStepDensity(), 1e-11);
        ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-12);
    }

    // Parameters without the positions they belong to.
    const State parameters = run.context.getState(State::IntegratorParameters);
    Integrator_ restored(0.001), fresh(0.002);
    Run alone(t, restored);
    alone.context.setState(parameters);
    fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue());
    Run reference(t, fresh);
    restored.step(20);
    fresh.step(20);
    ASSERT(largestDifference(alone.positions(), reference.positions()) < 1e-12);
}

inline void testRefusedStates() {
    TestSystem t;
    makeChain(t, 6);
    Integrator_ integrator(0.002), other(0.001);
    Run run(t, integrator), target(t, other);
    integrator.step(20);
    const std::string xml = toXml(run.context.getState(WHOLE_STATE));
    auto load = [&](const std::string& from, const std::string& to) {
        target.context.setState(stateFromXml(replaced(xml, from, to)));
    };
    const std::string version = "integrator=\"VariableStepRattleIntegrator\" version=\"";
    assertThrows("version 4 of their format and this plugin reads version 3",
                 [&] { load(version + "3", version + "4"); });
    assertThrows("damaged", [&] { load("<Value v=", "<Value v=\"1\"/><Value v="); });
    assertThrows("damaged", [&] { load("<Forces>", "<Forces><Vector x=\"0\" y=\"0\" z=\"0\"/>"); });
    ASSERT_EQUAL(0.001, other.getNominalStepSize());
    other.step(5);
    // A monitor that was named and that the System cannot have.
    integrator.clearMonitors();
    integrator.addMonitor(Integrator_::ConstraintMultipliers);
    const std::string named = toXml(run.context.getState(WHOLE_STATE));
    TestSystem unconstrained;
    makeChain(unconstrained, 6);
    while (unconstrained.system.getNumConstraints() > 0)
        unconstrained.system.removeConstraint(0);
    Integrator_ free(0.001);
    free.clearMonitors();
    Run freeRun(unconstrained, free);
    assertThrows("no constraints", [&] { freeRun.context.setState(stateFromXml(named)); });
    ASSERT_EQUAL(0.001, free.getNominalStepSize());
    free.step(5);
    ASSERT_EQUAL(0.001, free.getStepSize());
    // The State of an integrator without parameters is no reason to refuse it.
    VerletIntegrator verlet(0.001);
    Context verletContext(t.system, verlet, getTestPlatform());
    verletContext.setPositions(t.positions);
    verletContext.setVelocities(t.velocities);
    target.context.setState(stateFromXml(toXml(verletContext.getState(WHOLE_STATE))));
    other.step(5);
    verletContext.setState(stateFromXml(xml));
    verlet.step(1);
}

inline void testReinitialize() {
    for (const Situation& situation : getSituations()) {
        try {
            TestSystem t;
            makeChain(t, 6, 3.0);
            Integrator_ integrator(0.002), undisturbed(0.002);
            Run run(t, integrator), reference(t, undisturbed);
            situation.make(run);
            situation.make(reference);
            run.context.reinitialize(true);
            assertSame(Trace(reference.context, undisturbed, 100), Trace(run.context, integrator, 100));
        }
        catch (const std::exception& e) {
            throw OpenMMException(situation.name + ": " + e.what());
        }
    }
    // After a change of the forces, the masses or the constraints it starts afresh from the state that was kept.
    for (int i = 0; i < 4; i++) {
        TestSystem t;
        makeChain(t, 6);
        Integrator_ integrator(0.002), fresh(0.002);
        Run run(t, integrator);
        integrator.step(20);
        if (i == 0) {
            HarmonicBondForce* bond = new HarmonicBondForce();
            bond->addBond(0, 5, 0.6, 1000);
            t.system.addForce(bond);
        }
        else if (i == 1)
            t.system.setParticleMass(2, 50);
        else if (i == 2)
            t.system.removeConstraint(4);
        const double referenceValue = integrator.getReferenceMonitorValue();
        t.positions = run.positions();
        t.velocities = run.velocities();
        run.context.reinitialize(i < 3);
        if (i == 3) { // nothing is kept
            ASSERT_EQUAL(0.0, run.context.getTime());
            ASSERT_EQUAL(0.002, integrator.getStepSize());
            ASSERT_EQUAL(1.0, integrator.getStepDensity());
            ASSERT_EQUAL(0.0, integrator.getReferenceMonitorValue());
            ASSERT_EQUAL(0, integrator.getNumForceEvaluations());
            run.context.setPositions(t.positions);
            run.context.setVelocities(t.velocities);
        }
        else {
            ASSERT_EQUAL(20, run.context.getStepCount());
            ASSERT_EQUAL(referenceValue, integrator.getReferenceMonitorValue());
            fresh.setReferenceMonitorValue(referenceValue);
        }
        Run reference(t, fresh, false);
        integrator.step(20);
        fresh.step(20);
        ASSERT_EQUAL_TOL(fresh.getStepDensity(), integrator.getStepDensity(), 1e-11);
        ASSERT(largestDifference(run.positions(), reference.positions()) < 1e-12);
    }
}

inline void testCompoundIntegrator() {
    // The hooks are called by CompoundIntegrator as well, between those of other integrators.
    TestSystem t;
    makeChain(t, 6);
    auto makeCompound = [](CompoundIntegrator& compound) {
        compound.addIntegrator(new Integrator_(0.002));
        compound.addIntegrator(new VerletIntegrator(0.001));
        compound.addIntegrator(new Integrator_(0.001));
    };
    CompoundIntegrator compound, other;
    makeCompound(compound);
    makeCompound(other);
    Context context(t.system, compound, getTestPlatform()), restored(t.system, other, getTestPlatform());
    context.setPositions(t.positions);
    context.setVelocities(t.velocities);
    for (int index : {1, 0, 2}) {
        compound.setCurrentIntegrator(index);
        compound.step(10);
    }
    const std::string checkpoint = checkpointOf(context);
    const State state = context.getState(WHOLE_STATE);
    // The turn of a member comes when others have moved the particles, before the run is saved and after: its density is scaled with u.
    auto goOn = [](CompoundIntegrator& integrator, Context& its) {
        vector<double> densities;
        for (int index : {0, 2, 1, 0}) {
            integrator.setCurrentIntegrator(index);
            integrator.step(25);
            densities.push_back(dynamic_cast<Integrator_&>(integrator.getIntegrator(0)).getStepDensity());
            densities.push_back(dynamic_cast<Integrator_&>(integrator.getIntegrator(2)).getStepDensity());
        }
        return std::make_pair(its.getState(State::Positions).getPositions(), densities);
    };
    const auto expected = goOn(compound, context);
    for (const bool isState : {false, true}) {
        if (isState)
            restored.setState(state);
        else
            loadCheckpoint(restored, checkpoint);
        ASSERT(isState || other.getCurrentIntegrator() == 2);
        const auto found = goOn(other, restored);
        ASSERT(largestDifference(expected.first, found.first) <= std::max(1e-12, sameRunTolerance()));
        for (size_t i = 0; i < expected.second.size(); i++)
            ASSERT_EQUAL_TOL(expected.second[i], found.second[i], std::max(1e-11, sameRunTolerance()));
    }
}

inline TestList getSerializationTests() {
    return {
        {"XML", testXml},
        {"bad XML", testBadXml},
        {"checkpoints", [] { testCheckpoints(false); }},
        {"checkpoints with automatic step control", [] { testCheckpoints(true); }},
        {"checkpoint of a rescued step", testCheckpointOfRescuedStep},
        {"checkpoint with a force group as monitor", testCheckpointOfForceGroupMonitor},
        {"counts after loading", testCountsAfterLoading},
        {"refused checkpoints", testRefusedCheckpoints},
        {"changes after loading", testChangesAfterLoading},
        {"States", testStates},
        {"States elsewhere", testStatesElsewhere},
        {"refused States", testRefusedStates},
        {"reinitialize", testReinitialize},
        {"CompoundIntegrator", testCompoundIntegrator},
    };
}

} // namespace OpenMMVRattle
