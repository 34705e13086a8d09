// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Parameters of constraints and of Forces that change from step to step. Each platform's tests/ includes this file and its own setup.

#include "TestExpressionConstraints.h"
#include "openmm/CompoundIntegrator.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/VerletIntegrator.h"

namespace OpenMMVRattle {

// The pendulum, with a field whose strength is a parameter.
inline void makePendulumInField(TestSystem& t) {
    makeSphericalPendulum(t);
    CustomExternalForce* field = new CustomExternalForce("field*x^2");
    field->addGlobalParameter("field", 5.0);
    field->addParticle(1);
    t.system.addForce(field);
}

struct MovingRun {
    TestSystem system;
    Integrator_ integrator;
    std::unique_ptr<Context> context;
    int count = 0;

    explicit MovingRun(const std::function<void(Integrator_&)>& choose, Platform& platform = getTestPlatform()) :
            integrator(0.004) {
        makePendulumInField(system);
        integrator.setConstraintTolerance(1e-11);
        integrator.addConstraint(SPHERE, {1, 0}, {{"r", 1.0}});
        choose(integrator);
        context.reset(new Context(system.system, integrator, platform));
        start(*context, system);
        integrator.step(1);
    }
    double radius() const {
        return 1 - 0.002 * count;
    }
    void moveConstraint() {
        count++;
        integrator.setExpressionConstraintParameter(0, "r", radius());
    }
    void moveField() {
        context->setParameter("field", 5 + std::sin(0.1 * count));
    }
    void step(int steps) {
        for (int i = 0; i < steps; i++) {
            moveConstraint();
            moveField();
            integrator.step(1);
        }
    }
    double energy() const {
        const State state = context->getState(State::Energy);
        return state.getKineticEnergy() + state.getPotentialEnergy();
    }
    double potential() const {
        return context->getState(State::Energy).getPotentialEnergy();
    }
    vector<Vec3> positions() const {
        return context->getState(State::Positions).getPositions();
    }
    Trace trace() {
        return Trace(*context, integrator, 0);
    }
};

inline std::vector<std::pair<std::string, std::function<void(Integrator_&)>>> allChoices() {
    auto monitor = [](Integrator_::UpdateMethod update) {
        return [update](Integrator_& integrator) {
            integrator.clearMonitors();
            integrator.addMonitor(Integrator_::ConstraintAndAppliedForce);
            integrator.setUpdateMethod(update);
        };
    };
    return {{"fixed", [](Integrator_& integrator) { integrator.clearMonitors(); }},
            {"SemiExplicit", monitor(Integrator_::SemiExplicit)},
            {"Explicit", monitor(Integrator_::Explicit)},
            {"Bounded", monitor(Integrator_::Bounded)},
            {"automatic", [](Integrator_& integrator) { integrator.useAutomaticStepControl(50); }}};
}

// Both change in each step: what it costs, and that energy is what was put in.
inline void testCostAndBalance() {
    for (const auto& choice : allChoices()) {
        MovingRun run(choice.second);
        long long evaluations = run.integrator.getNumForceEvaluations();
        for (int i = 0; i < 50; i++) {
            run.moveConstraint();
            run.integrator.step(1);
        }
        ASSERT_EQUAL(evaluations + 50, run.integrator.getNumForceEvaluations());
        evaluations += 50;
        // What the multiplier does not pay for is the kinetic energy along the constraint, where the rate changes: it is the
        // same number of nm a step, whatever the size of the step.
        auto energyWithout = [&] {
            const double rate = 0.002 / run.integrator.getStepSize();
            return run.energy() - rate * rate;
        };
        const double first = energyWithout();
        double work = 0;
        for (int i = 0; i < 100; i++) {
            const double radius = run.radius(), force = -run.integrator.getExpressionConstraintMultiplier(0);
            const double before = run.potential();
            run.moveField();
            work += run.potential() - before;
            run.moveConstraint();
            run.integrator.step(1);
            work += 0.5 * (force - run.integrator.getExpressionConstraintMultiplier(0)) * (run.radius() - radius);
            // On the constraint, and with its velocity.
            const State state = run.context->getState(State::Positions | State::Velocities);
            const Vec3 r = state.getPositions()[1] - state.getPositions()[0], v = state.getVelocities()[1];
            ASSERT_EQUAL_TOL(run.radius(), std::sqrt(r.dot(r)), 1e-9);
            ASSERT(std::fabs(r.dot(v) / run.radius() + 0.002 / run.integrator.getStepSize()) < 1e-5);
        }
        ASSERT_EQUAL(evaluations + 200, run.integrator.getNumForceEvaluations());
        ASSERT(std::fabs(energyWithout() - first - work) < 0.01 * std::fabs(work));
        ASSERT(std::fabs(work) > 1);
    }
}

// The monitor of half steps of automatic step control is of the forces as they are along the step.
inline void testMonitorAfterJumpOfForce() {
    System system;
    system.addParticle(10);
    CustomExternalForce* pull = new CustomExternalForce("f*x");
    pull->addGlobalParameter("f", 1.0);
    pull->addParticle(0);
    system.addForce(pull);
    Integrator_ integrator(0.002);
    integrator.useAutomaticStepControl(10);
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3()});
    context.setVelocities({Vec3(0.01, 0, 0)}); // slow enough for its flight not to count
    integrator.step(10);
    ASSERT_EQUAL_TOL(1 / std::sqrt(10.0), integrator.getMonitorValue(1), 1e-4);
    context.setParameter("f", 3.0);
    integrator.step(1);
    ASSERT_EQUAL_TOL(3 / std::sqrt(10.0), integrator.getMonitorValue(1), 1e-4);
}

// A Force that is changed by updateParametersInContext().
inline void testUpdatedForce() {
    System system;
    for (int i = 0; i < 3; i++)
        system.addParticle(12);
    system.addConstraint(0, 1, 0.2);
    HarmonicBondForce* bond = new HarmonicBondForce();
    bond->addBond(1, 2, 0.2, 1000);
    system.addForce(bond);
    Integrator_ integrator(0.002);
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3(), Vec3(0.2, 0, 0), Vec3(0.25, 0.2, 0)});
    context.setVelocities({Vec3(), Vec3(0, 1, 0), Vec3(1, 0, 0)});
    integrator.step(1);
    const long long before = integrator.getNumForceEvaluations();
    for (int i = 0; i < 20; i++) {
        bond->setBondParameters(0, 1, 2, 0.2, 1000 + 10 * i);
        bond->updateParametersInContext(context);
        integrator.step(1);
    }
    ASSERT_EQUAL(before + 40, integrator.getNumForceEvaluations());
}

// Saved in the middle, with changes that have not been met yet or without.
inline void testSavedInTheMiddle() {
    for (const auto& choice : allChoices())
        for (int pending = 0; pending < 4; pending++) {
            MovingRun run(choice.second), byCheckpoint(choice.second), byState(choice.second);
            run.step(10);
            if (pending & 1)
                run.moveConstraint();
            if (pending & 2)
                run.moveField();
            const std::string checkpoint = checkpointOf(*run.context);
            const State state = run.context->getState(WHOLE_STATE);
            loadCheckpoint(*byCheckpoint.context, checkpoint);
            byState.context->setState(state);
            for (MovingRun* each : {&run, &byCheckpoint, &byState}) {
                each->count = run.count;
                if (pending != 0)
                    each->integrator.step(1);
            }
            for (MovingRun* each : {&run, &byCheckpoint, &byState})
                each->step(10);
            assertSame(run.trace(), byCheckpoint.trace());
            assertSame(run.trace(), byState.trace());
        }
}

// A trial run in between stands still, and leaves what is to come as it was.
inline void testTrialRunInBetween() {
    MovingRun run(allChoices()[0].second), other(allChoices()[0].second);
    run.step(10);
    other.step(10);
    run.moveConstraint();
    other.moveConstraint();
    other.integrator.useAutomaticStepControl(30);
    other.integrator.calibrate(20);
    allChoices()[0].second(other.integrator);
    run.integrator.step(3);
    other.integrator.step(3);
    const double expected = run.energy();
    ASSERT_EQUAL_TOL(expected, other.energy(), 1e-9);
    const Vec3 r = other.context->getState(State::Positions).getPositions()[1] - other.system.positions[0];
    ASSERT_EQUAL_TOL(other.radius(), std::sqrt(r.dot(r)), 1e-9);
}

// A jump that no step can make.
inline void testTooLargeJump() {
    for (const auto& choice : allChoices()) {
        MovingRun run(choice.second), other(choice.second);
        for (int i = 0; i < 5; i++) {
            run.step(3);
            other.step(3);
            const Trace before = other.trace();
            other.integrator.setExpressionConstraintParameter(0, "r", -0.5);
            for (int attempt = 0; attempt < 2; attempt++) {
                assertThrows("move them by less at a time", [&] { other.integrator.step(1); });
                assertSame(before, other.trace());
            }
            std::string expression;
            vector<int> particles;
            std::map<std::string, double> parameters;
            other.integrator.getExpressionConstraintParameters(0, expression, particles, parameters);
            ASSERT_EQUAL(-0.5, parameters.at("r"));
        }
        run.step(3);
        other.step(3);
        assertSame(run.trace(), other.trace());
    }
}

// To equal times, with a parameter that changes at each.
inline void testStepToWhileMoving() {
    for (const auto& choice : allChoices()) {
        MovingRun run(choice.second);
        const double start = run.context->getTime();
        const Vec3 momentum = [&] {
            const State state = run.context->getState(State::Positions | State::Velocities);
            return (state.getPositions()[1] - state.getPositions()[0]).cross(state.getVelocities()[1]);
        }();
        run.context->setParameter("field", 0.0); // then the moment about the vertical axis is conserved
        for (int i = 1; i <= 200; i++) {
            run.moveConstraint();
            run.integrator.stepTo(start + 0.003 * i);
            ASSERT_EQUAL(start + 0.003 * i, run.context->getTime());
        }
        const State state = run.context->getState(State::Positions | State::Velocities);
        const Vec3 r = state.getPositions()[1] - state.getPositions()[0];
        ASSERT_EQUAL_TOL(run.radius(), std::sqrt(r.dot(r)), 1e-9);
        ASSERT_EQUAL_TOL(momentum[2], r.cross(state.getVelocities()[1])[2], 1e-3);
    }
}

// Members of a CompoundIntegrator that take turns while a pivot moves, against plain RATTLE of the pendulum: a member whose turn
// comes starts where its constraint is by then, and is led from there by its further steps. Whether others have taken steps is seen
// whatever the user makes of the clock.
inline void testMembersThatTakeTurns() {
    const double h = 0.004, mass = 2, way = 0.004;
    auto acceleration = [](const Vec3& q) { return Vec3(-40 * q[0], 0, -10); };
    for (const bool isOtherOurs : {true, false}) {
        System system;
        system.addParticle(mass);
        auto* field = new CustomExternalForce("20*z+40*x^2");
        field->addParticle(0);
        system.addForce(field);
        CompoundIntegrator compound;
        vector<Integrator_*> ours;
        for (int i = 0; i < 2; i++) {
            if (i == 1 && !isOtherOurs) {
                compound.addIntegrator(new VerletIntegrator(h));
                continue;
            }
            ours.push_back(new Integrator_(h));
            ours.back()->clearMonitors();
            ours.back()->setConstraintTolerance(1e-12);
            ours.back()->addConstraint("sqrt((x1-px)^2+y1^2+z1^2)-1", {0}, {{"px", 0.0}});
            compound.addIntegrator(ours.back());
        }
        Context context(system, compound, getTestPlatform());
        Vec3 q(0.6, 0, 0.8), v(0, 1, 0), pivot;
        context.setPositions({q});
        context.setVelocities({v});
        auto along = [](const Vec3& r) { return r / std::sqrt(r.dot(r)); };
        for (int turn = 0; turn < 4; turn++) {
            compound.setCurrentIntegrator(turn % 2);
            context.setStepCount(0);
            context.setTime(0);
            for (int i = 0; i < 2; i++) {
                const Vec3 before = pivot;
                pivot[0] += way;
                for (Integrator_* each : ours)
                    each->setExpressionParameterValue(0, "px", pivot[0]);
                compound.step(1);
                if (turn % 2 == 1 && !isOtherOurs) {
                    v += acceleration(q) * h;
                    q += v * h;
                }
                else {
                    Vec3 n = along(q - (i == 0 ? pivot : before));
                    if (i == 0) {
                        q = pivot + n;
                        v -= n * n.dot(v);
                    }
                    // |q + h (v - l n) - pivot| = 1, a quadratic equation for h l.
                    v += acceleration(q) * (h / 2);
                    const Vec3 to = q + v * h - pivot;
                    const double b = to.dot(n), change = b - std::sqrt(b * b - to.dot(to) + 1);
                    v -= n * (change / h);
                    q += v * h;
                    n = along(q - pivot);
                    v += acceleration(q) * (h / 2);
                    v -= n * n.dot(v - (i == 0 ? Vec3() : (pivot - before) / h));
                }
                const State state = context.getState(State::Positions | State::Velocities);
                const Vec3 error = state.getPositions()[0] - q, errorOfVelocity = state.getVelocities()[0] - v;
                ASSERT(std::sqrt(error.dot(error)) < 1e-10);
                ASSERT(std::sqrt(errorOfVelocity.dot(errorOfVelocity)) < 1e-8);
                if (i == 1)
                    continue;
                // Nobody is disturbed by a member that is asked while another has its turn, or by a save.
                ours[isOtherOurs ? 1 - turn % 2 : 0]->getMultipliers();
                loadCheckpoint(context, checkpointOf(context));
            }
        }
    }
}

inline TestList getMovingParameterTests() {
    return {{"cost and energy balance", testCostAndBalance},
            {"the monitor of half steps after a jump of the force", testMonitorAfterJumpOfForce},
            {"a force that is updated", testUpdatedForce},
            {"runs saved in the middle", testSavedInTheMiddle},
            {"a trial run in between", testTrialRunInBetween},
            {"a jump that is too large", testTooLargeJump},
            {"stepTo()", testStepToWhileMoving},
            {"members that take turns", testMembersThatTakeTurns}};
}

} // namespace OpenMMVRattle
