// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "GpuTests.h"

#include "TestMovingParameters.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include <algorithm>

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
            {"of positions", monitor(Integrator_::AppliedForce, Integrator_::SemiExplicit)},
            {"automatic", [](Integrator_& integrator) {
                 integrator.useAutomaticStepControl(10);
                 for (int k = 0; k < 2; k++)
                     integrator.setReferenceMonitorValue(2, k);
             }}};
}

// On Reference and here, 250 steps: at rest, and moving; where the pivot begins to move, turns or stops u jumps. Perhaps in the first of
// several steps.
void testAgreement() {
    for (const auto& choice : choicesOfPivot()) {
        PivotRun here(choice.second, getTestPlatform()), there(choice.second, Platform::getPlatform("Reference"));
        int numOnHost = 0;
        double largestDensity = 0;
        auto step = [&](const std::map<std::string, double>& changes, int steps = 1) {
            here.step(changes, steps);
            there.step(changes, steps);
            numOnHost += !here.integrator.isOnDevice();
            largestDensity = std::max(largestDensity, there.integrator.getStepDensity());
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
        const double change = std::fabs(there.integrator.getStepDensity() / before - 1);
        const bool follows = choice.first.find("licit") != std::string::npos || choice.first == "Bounded";
        ASSERT(change > 0.1 || !follows);
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
        // Where the density is more than the device finds in its trials the host finds it.
        ASSERT(numOnHost <= (choice.first == "SemiExplicit" ? 5 : 0));
        ASSERT_EQUAL(there.integrator.getNumRescues(), here.integrator.getNumRescues());
        ASSERT(choice.first != "automatic" || largestDensity > 1.2);
    }
}

// A pivot that is torn away: (3.14) has the solution of method/tests/TestDynamicsParameters.cpp, on the device or, where its trials do not
// suffice, on the host. The bead is ahead of the pivot by less than the way of that at last, so that g changes by its curvature.
void testSuddenStart() {
    auto choose = [](Integrator_& integrator) {
        integrator.clearMonitors();
        integrator.addMonitor(Integrator_::ConstraintForce);
    };
    for (double way : {0.006, 0.02, 0.1}) {
        PivotRun here(choose, getTestPlatform()), there(choose, Platform::getPlatform("Reference"));
        for (PivotRun* each : {&here, &there}) {
            each->step({}, 4);
            each->step({{"py", way}});
        }
        ASSERT(way < 0.1 || there.integrator.getStepDensity() > 40);
        ASSERT_EQUAL_TOL(there.integrator.getStepDensity(), here.integrator.getStepDensity(), 1e-9);
        requireAtMost(1e-9, largestDifference(here.positions(), there.positions()), "positions");
        ASSERT_EQUAL_TOL(there.integrator.getMonitorValue(), here.integrator.getMonitorValue(), 1e-7);
        ASSERT_EQUAL(0, here.integrator.getNumRescues());
        ASSERT_EQUAL(0, there.integrator.getNumRescues());
    }
}

// Two beads at the ends of a bar, one of them held by a pivot that moves, in a bath: in calm steps the half of the way is in the middle of
// each; the host takes over where a step ends with velocities that need substeps, and goes the rest of the way in these.
void testLangevin() {
    const std::string rod = "sqrt((x1-px)^2+(y1-py)^2+(z1-pz)^2)-r";
    struct Run {
        VariableStepRattleLangevinIntegrator integrator{300, 5, 0.004};
        std::unique_ptr<Context> context;
        State state() const {
            return context->getState(State::Positions | State::Velocities | State::Energy);
        }
    };
    System system;
    for (double mass : {2.0, 3.0, 20.0})
        system.addParticle(mass);
    system.addConstraint(0, 1, 0.15);
    auto* field = new CustomExternalForce("200*(x^2+y^2+2*z^2)");
    for (int i = 0; i < 3; i++)
        field->addParticle(i);
    system.addForce(field);
    Run here, there;
    double place = 0.1;
    auto placeOfPivot = [&] {
        return std::map<std::string, double>{{"px", place}, {"py", 0.0}, {"pz", 0.0}, {"r", 0.1}};
    };
    for (Run* each : {&here, &there}) {
        each->integrator.setRandomNumberSeed(5);
        each->integrator.setConstraintTolerance(1e-12);
        each->integrator.addConstraint(rod, {0}, placeOfPivot());
        Platform& platform = each == &here ? getTestPlatform() : Platform::getPlatform("Reference");
        each->context.reset(new Context(system, each->integrator, platform));
        each->context->setPositions({Vec3(), Vec3(0, 0.15, 0), Vec3(0.3, 0, 0)});
        each->context->setVelocities({Vec3(), Vec3(1, 0, 0.5), Vec3()});
        each->integrator.step(1);
    }
    auto step = [&](double way, bool isOnDevice, double tolerance) {
        place += way;
        for (Run* each : {&here, &there}) {
            if (way != 0)
                each->integrator.setExpressionConstraintParameters(0, rod, {0}, placeOfPivot());
            each->integrator.step(1);
        }
        ASSERT_EQUAL(isOnDevice, here.integrator.isOnDevice());
        const State found = here.state(), expected = there.state();
        requireAtMost(tolerance, largestDifference(found.getPositions(), expected.getPositions()), "positions");
        requireAtMost(1e3 * tolerance, largestDifference(found.getVelocities(), expected.getVelocities()),
                      "velocities");
        ASSERT_EQUAL_TOL(expected.getKineticEnergy(), found.getKineticEnergy(), 1e3 * tolerance);
        ASSERT_EQUAL_TOL(there.integrator.getExpressionConstraintMultiplier(0),
                         here.integrator.getExpressionConstraintMultiplier(0), 1e3 * tolerance);
        ASSERT_EQUAL_TOL(there.integrator.getReferenceMonitorValue(), here.integrator.getReferenceMonitorValue(), 1e-9);
        // On the constraint, and with its velocity.
        const Vec3 r = found.getPositions()[0] - Vec3(place, 0, 0);
        requireAtMost(1e-10, std::fabs(std::sqrt(r.dot(r)) - 0.1), "the constraint");
    };
    step(0, true, 1e-12);
    for (int i = 0; i < 20; i++)
        step(0.001 + 1e-5 * i, true, 1e-11);
    for (int i = 0; i < 5; i++)
        step(0, true, 1e-11);
    ASSERT_EQUAL(0, there.integrator.getNumSubstepped());
    step(0.08, false, 1e-9); // 20 nm/ps
    ASSERT(there.integrator.getNumSubstepped() > 0);
    ASSERT_EQUAL(there.integrator.getNumSubstepped(), here.integrator.getNumSubstepped());
    ASSERT_EQUAL(there.integrator.getLargestSubsteps(), here.integrator.getLargestSubsteps());
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
        vector<double> after[2];
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
            ASSERT(k == 0 || run.integrator.isOnDevice());
            // The jump that was not made leaves nothing behind, wherever the next begin.
            for (int i = 0; i < 5; i++) {
                run.moveConstraint();
                run.integrator.step(1);
            }
            after[k] = run.trace().numbers;
        }
        ASSERT_EQUAL(after[0].size(), after[1].size());
        for (size_t i = 0; i < after[0].size(); i++)
            ASSERT_EQUAL_TOL(after[0][i], after[1][i], 1e-7);
        ASSERT(messages[0].find("move them by less at a time") != std::string::npos);
        ASSERT_EQUAL(withoutNumbers(messages[0]), withoutNumbers(messages[1]));
    }
}

// Context::reinitialize() in the midst of a motion.
void testReinitializeWhileMoving() {
    const auto choices = choicesOfPivot();
    for (const std::string name : {"SemiExplicit", "automatic"}) {
        const auto choice =
            std::find_if(choices.begin(), choices.end(), [&](const auto& c) { return c.first == name; });
        PivotRun here(choice->second, getTestPlatform()), there(choice->second, Platform::getPlatform("Reference"));
        for (PivotRun* each : {&here, &there}) {
            for (int i = 0; i < 20; i++) {
                if (i == 10)
                    each->context->reinitialize(true);
                each->step({{"py", -0.004}, {"r", 1e-4}});
            }
            ASSERT_EQUAL(each == &here, each->integrator.isOnDevice());
        }
        requireAtMost(1e-8, largestDifference(here.positions(), there.positions()), name);
        ASSERT_EQUAL_TOL(there.integrator.getStepDensity(), here.integrator.getStepDensity(), 1e-7);
        ASSERT_EQUAL_TOL(there.integrator.getMultipliers()[0], here.integrator.getMultipliers()[0], 1e-7);
    }
}

} // namespace

int main(int argc, char** argv) {
    TestList tests = getMovingParameterTests();
    tests.push_back({"agreement with Reference", testAgreement});
    tests.push_back({"a sudden start", testSuddenStart});
    tests.push_back({"Langevin dynamics", testLangevin});
    tests.push_back({"reversal while moving", testReversal});
    tests.push_back({"what is said of a failure", testMessages});
    tests.push_back({"reinitialize while moving", testReinitializeWhileMoving});
    return runOnPlatform(tests, argc, argv);
}
