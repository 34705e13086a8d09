// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "GpuTests.h"

#include "TestMovingParameters.h"

using namespace OpenMMVRattle;

namespace {

// The pendulum on a pivot that moves, and a length.
struct PivotRun {
    TestSystem system;
    Integrator_ integrator;
    std::unique_ptr<Context> context;
    std::map<std::string, double> place = {{"px", 0.1}, {"py", 0.2}, {"pz", 0.3}, {"r", 1.0}};

    PivotRun(const std::function<void(Integrator_&)>& choose, Platform& platform) : integrator(0.004) {
        makePendulumInField(system);
        integrator.setConstraintTolerance(1e-12);
        integrator.addConstraint("sqrt((x1-px)^2+(y1-py)^2+(z1-pz)^2)-r", {1}, place);
        choose(integrator);
        context.reset(new Context(system.system, integrator, platform));
        start(*context, system);
        integrator.step(1);
    }
    void step(const std::map<std::string, double>& changes, int steps = 1) {
        for (const auto& change : changes)
            place[change.first] += change.second;
        std::string expression;
        vector<int> particles;
        std::map<std::string, double> before;
        integrator.getExpressionConstraintParameters(0, expression, particles, before);
        integrator.setExpressionConstraintParameters(0, expression, particles, place);
        integrator.step(steps);
    }
    vector<Vec3> positions() const {
        return context->getState(State::Positions).getPositions();
    }
};

std::vector<std::pair<std::string, std::function<void(Integrator_&)>>> choicesOfPivot() {
    auto monitor = [](Integrator_::MonitorKind kind, Integrator_::UpdateMethod update) {
        return [=](Integrator_& integrator) {
            integrator.clearMonitors();
            integrator.addMonitor(kind);
            integrator.setUpdateMethod(update);
        };
    };
    return {{"fixed", allChoices()[0].second},
            {"SemiExplicit", monitor(Integrator_::ConstraintForce, Integrator_::SemiExplicit)},
            {"Explicit", monitor(Integrator_::ConstraintForce, Integrator_::Explicit)},
            {"Bounded", monitor(Integrator_::ConstraintForce, Integrator_::Bounded)},
            {"of positions", monitor(Integrator_::AppliedForce, Integrator_::SemiExplicit)}};
}

// On Reference and here, 250 steps: at rest, and moving; where the pivot begins to move, turns or stops u jumps. Perhaps in the first of
// several steps.
void testAgreement() {
    for (const auto& choice : choicesOfPivot()) {
        PivotRun here(choice.second, getTestPlatform()), there(choice.second, Platform::getPlatform("Reference"));
        auto step = [&](const std::map<std::string, double>& changes, int steps = 1) {
            here.step(changes, steps);
            there.step(changes, steps);
            ASSERT(here.integrator.isOnDevice());
        };
        auto requireAgreement = [&](double distance) {
            const double density = there.integrator.getStepDensity();
            requireAtMost(1e3 * distance, std::fabs(here.integrator.getStepDensity() - density), choice.first);
            requireAtMost(distance, largestDifference(here.positions(), there.positions()), choice.first);
            ASSERT_EQUAL_TOL(there.context->getTime(), here.context->getTime(), distance);
            ASSERT_EQUAL_TOL(there.integrator.getExpressionConstraintMultiplier(0),
                             here.integrator.getExpressionConstraintMultiplier(0), 1e3 * distance);
            ASSERT_EQUAL_TOL(totalEnergy(*there.context), totalEnergy(*here.context), 1e3 * distance);
        };
        step({});
        const double before = there.integrator.getStepDensity();
        step({{"py", -0.004}});
        requireAgreement(1e-10);
        const bool jumps = choice.first != "fixed" && choice.first != "of positions";
        ASSERT(!jumps || there.integrator.getStepDensity() < 0.9 * before);
        for (int i = 0; i < 60; i++)
            step({{"py", -0.004 - 1e-5 * i}, {"r", 1e-4 * i}});
        requireAgreement(1e-8);
        step({});
        requireAgreement(1e-8);
        for (int i = 0; i < 20; i++)
            step({});
        for (int i = 0; i < 30; i++)
            step({{"px", 0.003}, {"r", -0.002}});
        step({{"px", -0.002}});
        requireAgreement(1e-8);
        for (int i = 0; i < 20; i++)
            step({{"pz", 0.002}}, 5);
        requireAgreement(1e-7);
        here.context->setParameter("field", 6.0);
        there.context->setParameter("field", 6.0);
        for (int i = 0; i < 20; i++)
            step({{"pz", 0.001}});
        requireAgreement(1e-7);
    }
}

// There and back: 100 steps of a constraint that moves, and the same way again.
void testReversal() {
    for (const auto& choice : allChoices()) {
        if (choice.first != "fixed" && choice.first != "SemiExplicit")
            continue; // the others take the rate of the last step for that of the next
        MovingRun run(choice.second);
        run.integrator.setConstraintTolerance(1e-13);
        auto move = [&](int count) {
            for (int i = 0; i < std::abs(count); i++) {
                run.count += count > 0 ? 1 : -1;
                run.integrator.setExpressionConstraintParameter(0, "r", run.radius());
                run.integrator.step(1);
                ASSERT(run.integrator.isOnDevice());
            }
        };
        move(10);
        const vector<Vec3> before = run.positions();
        move(100);
        ASSERT(largestDifference(before, run.positions()) > 0.1);
        run.integrator.reverse();
        move(-100);
        ASSERT(largestDifference(before, run.positions()) <= 1e-10);
    }
}

// What a script says of a jump that is too large, in the midst of a motion.
void testMessages() {
    for (const auto& choice : allChoices()) {
        std::string messages[2];
        for (int k = 0; k < 2; k++) {
            MovingRun run(choice.second, k == 0 ? Platform::getPlatform("Reference") : getTestPlatform());
            for (int i = 0; i < 5; i++) {
                run.moveConstraint();
                run.integrator.step(2);
            }
            const Trace before = run.trace();
            run.integrator.setExpressionConstraintParameter(0, "r", -0.5);
            try {
                run.integrator.step(4);
            }
            catch (const OpenMMException& e) {
                messages[k] = e.what();
            }
            assertSame(before, run.trace());
            run.moveConstraint();
            run.integrator.step(1);
            ASSERT(k == 0 || choice.first == "automatic" || run.integrator.isOnDevice());
        }
        ASSERT(messages[0].find("move them by less at a time") != std::string::npos);
        ASSERT_EQUAL(withoutNumbers(messages[0]), withoutNumbers(messages[1]));
    }
}

} // namespace

int main(int argc, char** argv) {
    TestList tests = getMovingParameterTests();
    tests.push_back({"agreement with Reference", testAgreement});
    tests.push_back({"reversal while moving", testReversal});
    tests.push_back({"what is said of a failure", testMessages});
    return runOnPlatform(tests, argc, argv);
}
