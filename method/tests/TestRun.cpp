// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// IntegratorRun over a device that does not look: it writes down what it is asked for, and reports at the end.

#include "TestSupport.h"
#include "constraints/StepFailure.h"
#include "run/IntegratorRun.h"
#include <algorithm>
#include <string>
#include <vector>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using std::string;
using std::vector;

namespace {

class Recorder : public RunDevice {
public:
    string calls;             // a letter for each, see below
    double parameter = 0;     // of an expression, if there is one
    int failingStep = 0;      // counted from 1; 0 for none
    bool failsToStart = false;
    Change change = Change::None;
    bool areForcesInvalid = false;
    unsigned long long fingerprint = 1, parameters = 1;
    long long numAsked = 0, numTaken = 0;
    int numLooks = 0; // at numbers that a device would have to wait for, while it has been asked for steps
    double lastSize = 0;

    void setSettings(const IntegratorSettings& settings) override {
        calls += 's';
        findings.references.assign(settings.getNumReferences(), 0.0);
    }
    bool setParameters(const vector<ExpressionConstraint>& given) override {
        const double before = parameter;
        parameter = given.empty() ? 0.0 : given[0].parameters.at("d");
        if (parameter != before)
            calls += 'p';
        return parameter != before;
    }
    Findings getFindings() override {
        look();
        return findings;
    }
    void setFindings(const Findings& newFindings) override {
        findings = newFindings;
    }
    bool updateState() override {
        return areForcesInvalid;
    }
    Change findChange() override {
        return change;
    }
    unsigned long long getFingerprint() override {
        return fingerprint;
    }
    unsigned long long getParameterFingerprint() override {
        return parameters;
    }
    void changeForces() override {
        calls += 'F';
        if (failsToStart)
            throw StepFailure("of this or that");
    }
    void start() override {
        calls += 'A';
        if (failsToStart)
            throw StepFailure("of this or that");
    }
    void changeState() override {
        calls += 'C';
        if (failsToStart)
            throw StepFailure("of this or that");
    }
    void changeVelocities() override {
        calls += 'V';
    }
    void writeVelocities() override {
    }
    void step(double) override {
        calls += '+';
        numAsked++;
    }
    void settle() override {
        calls += '.';
        const bool fails = failingStep > 0 && numAsked >= failingStep;
        numTaken = fails ? failingStep - 1 : numAsked;
        lastSize = numTaken > 0 ? 1e-3 * (double) numTaken : 0.0;
        numAsked = numTaken;
        if (fails)
            throw StepFailure("it was too large");
    }
    void reverse() override {
        calls += 'R';
    }
    LastStep getLastStep() override {
        look();
        return {lastSize, 1.0};
    }
    double getTime() override {
        look();
        return 0.5;
    }
    long long getStepCount() override {
        look();
        return numTaken;
    }
    void tryOut(double, int, const std::function<void(const vector<double>&)>&) override {
    }
    vector<double> getMonitorValues() override {
        look();
        return {1.0};
    }
    vector<double> getMultipliers() override {
        look();
        return {};
    }
    double getExpressionMultiplier(int) override {
        return 0;
    }
    double computeKineticEnergy() override {
        return 0;
    }
    long long getNumForceEvaluations() override {
        return 0;
    }
    long long getNumSolverIterations() override {
        return 0;
    }
    StepCounts getCounts() override {
        return {};
    }
    double computeHalfStepKineticEnergy() override {
        return 0;
    }
    double getNegligibleValue() override {
        return 0;
    }
    void save(RunState&) override {
        calls += 'w';
    }
    bool canResume(const RunState&, const IntegratorSettings&) override {
        return true;
    }
    bool resume(const RunState&, const IntegratorSettings&, bool areForcesOthers) override {
        calls += 'r';
        return areForcesAsSaved || areForcesOthers;
    }
    bool areForcesAsSaved = true;
    string takeCalls() {
        string result;
        result.swap(calls);
        return result;
    }

private:
    void look() {
        numLooks += numAsked > numTaken;
    }
    Findings findings;
};

const unsigned long long SYSTEM = 17;

struct Example {
    IntegratorSettings settings{0.002};
    Recorder device;
    IntegratorRun run{device, settings, 0, SYSTEM};
};

void testStepsAreAskedForWithoutALook() {
    Example e;
    e.run.step(5);
    ASSERT_EQUAL(string("sA+++++."), e.device.takeCalls());
    ASSERT_EQUAL(0, e.device.numLooks);
    e.run.step(1);
    e.run.step(0);
    ASSERT_EQUAL(string("+."), e.device.takeCalls());
    ASSERT_EQUAL(6e-3, e.run.getStepSize());
}

void testFailuresThatAreFoundLate() {
    for (const int failing : {1, 3}) {
        Example e;
        e.settings.stepSize = 0.07;
        e.run.nominalStepChanged();
        e.device.failingStep = failing;
        assertThrows("the step at t = 0.5 ps failed because it was too large", [&] { e.run.step(5); });
        ASSERT_EQUAL(string("ssA+++++."), e.device.takeCalls());
        // Nothing has been taken yet, or the size is that of the last that was.
        ASSERT_EQUAL(failing == 1 ? 0.07 : 2e-3, e.run.getStepSize());
        e.device.failingStep = 0;
        e.run.step(2);
        ASSERT_EQUAL(string("++."), e.device.takeCalls()); // the state before the failure is a state of the run
    }
}

void testChanges() {
    Example e;
    e.run.step(1);
    e.device.takeCalls();
    e.device.change = RunDevice::Change::Velocities;
    e.run.step(1);
    e.device.change = RunDevice::Change::State;
    e.run.step(1);
    e.device.change = RunDevice::Change::Box; // the user's
    e.run.step(1);
    e.device.areForcesInvalid = true; // a barostat's
    e.run.step(1);
    ASSERT_EQUAL(string("V+.C+.A+.C+."), e.device.takeCalls());
    e.device.change = RunDevice::Change::None;
    e.device.areForcesInvalid = false;
    e.run.stateChanged();
    e.run.getMultipliers();
    e.run.step(1);
    ASSERT_EQUAL(string("A+."), e.device.takeCalls());
    // What has not been done remains to be done, and a greater change takes the place of a smaller one.
    e.device.failsToStart = true;
    e.device.areForcesInvalid = true;
    assertThrows("the start at t = 0.5 ps failed because of this or that", [&] { e.run.step(1); });
    e.device.areForcesInvalid = false;
    assertThrows("the start", [&] { e.run.step(1); });
    e.device.change = RunDevice::Change::Box;
    assertThrows("the start", [&] { e.run.step(1); });
    e.device.change = RunDevice::Change::None;
    e.device.failsToStart = false;
    e.run.step(1);
    ASSERT_EQUAL(string("CCAA+."), e.device.takeCalls());
}

// Parameters of Forces and of constraints.
void testParameters() {
    Example e;
    e.settings.expressions = {{"x1-d", {0}, {{"d", 1.0}}}};
    IntegratorRun run(e.device, e.settings, 0, SYSTEM);
    e.device.takeCalls();
    auto setParameter = [&](double value) {
        e.settings.expressions[0].parameters["d"] = value;
        run.parametersChanged();
    };
    // Before the first step whoever asks for numbers asks for those where the constraint holds; a step goes there.
    run.getMultipliers();
    setParameter(2);
    run.getMultipliers();
    setParameter(3);
    run.step(1);
    setParameter(4);
    run.step(1);
    ASSERT_EQUAL(string("ApAp+.p+."), e.device.takeCalls());
    setParameter(4); // which it is
    run.step(1);
    setParameter(5);
    run.settingsChanged(); // all of them, then
    run.step(2);
    ASSERT_EQUAL(string("+.sp++."), e.device.takeCalls());
    run.forcesChanged();
    run.step(2);
    run.getMultipliers();
    ASSERT_EQUAL(string("F++."), e.device.takeCalls());
    run.forcesChanged();
    e.device.change = RunDevice::Change::Velocities;
    run.step(1);
    run.forcesChanged();
    e.device.change = RunDevice::Change::State; // computes the forces anyway
    run.step(1);
    e.device.change = RunDevice::Change::None;
    run.step(1);
    ASSERT_EQUAL(string("VF+.C+.+."), e.device.takeCalls());
    run.forcesChanged();
    e.device.failsToStart = true;
    assertThrows("of this or that", [&] { run.step(1); });
    e.device.failsToStart = false;
    run.step(1);
    ASSERT_EQUAL(string("FF+."), e.device.takeCalls());
    // Saved before the step that meets the change, and loaded where parameters are others.
    run.forcesChanged();
    const RunState state = run.save();
    e.device.areForcesAsSaved = false;
    run.resume(state);
    run.step(1);
    ASSERT_EQUAL(string("wsrF+."), e.device.takeCalls());
    RunState met = run.save();
    run.resume(met);
    e.device.parameters = 2;
    run.forcesChanged();
    run.step(1);
    ASSERT_EQUAL(string("wsrF+."), e.device.takeCalls());
    run.resume(met);
    e.device.parameters = 1;
    run.step(1);
    ASSERT_EQUAL(string("srA+."), e.device.takeCalls()); // other forces, without a word
}

void testSettings() {
    Example e;
    e.run.step(1);
    e.device.takeCalls();
    e.settings.tolerance = 1e-5;
    e.run.settingsChanged();
    e.run.step(1); // no restart: the positions meet the tolerance that there was
    ASSERT_EQUAL(string("s+."), e.device.takeCalls());
    e.settings.forceGroups = 3;
    e.run.settingsChanged();
    e.run.step(1);
    ASSERT_EQUAL(string("sA+."), e.device.takeCalls());
    e.settings.terms[0].kind = StepMonitor::ForceGroupEnergy;
    e.settings.monitorForceGroup = 4;
    e.run.settingsChanged();
    e.run.step(1);
    ASSERT_EQUAL(string("sA+."), e.device.takeCalls());
    e.settings.maximumStep = 0.001;
    e.run.settingsChanged();
    for (int i = 0; i < 2; i++)
        assertThrows("(0.001 ps) larger than the nominal one", [&] { e.run.step(1); });
    ASSERT(e.run.save().startsAfresh);
    ASSERT_EQUAL(string(), e.device.takeCalls());
    e.settings.stepSize = 0;
    e.run.nominalStepChanged();
    assertThrows("step size is 0", [&] { e.run.step(1); });
    e.run.getMultipliers();
    ASSERT_EQUAL(string("s"), e.device.takeCalls());
}

void testSavedRuns() {
    Example e;
    e.run.step(1);
    RunState state = e.run.save();
    ASSERT(!state.startsAfresh);
    ASSERT_EQUAL(SYSTEM, state.system);
    state.lastStepSize = 0.0123;
    e.device.takeCalls();
    // OpenMM announces what it has loaded as changes of the user's.
    e.run.resume(state);
    for (int i = 0; i < 4; i++)
        e.run.stateChanged();
    ASSERT_EQUAL(0.0123, e.run.getStepSize());
    e.run.step(2);
    ASSERT_EQUAL(string("sr++."), e.device.takeCalls());
    ASSERT_EQUAL(3e-3, e.run.getStepSize());
    // Another state of the Context, other forces, another System: a start.
    for (int i = 0; i < 3; i++) {
        RunState other = state;
        e.device.fingerprint = i == 0 ? 2 : 1;
        e.device.areForcesAsSaved = i != 1;
        other.system = i == 2 ? SYSTEM + 1 : SYSTEM;
        e.run.resume(other);
        e.run.step(1);
        ASSERT_EQUAL(string(i == 1 ? "srA+." : "sA+."), e.device.takeCalls());
    }
    // A Force that changes the Context before the step does so after it has been compared.
    e.run.resume(state);
    e.device.areForcesAsSaved = true;
    e.device.change = RunDevice::Change::Velocities;
    e.run.step(1);
    ASSERT_EQUAL(string("srV+."), e.device.takeCalls());
}

} // namespace

int main() {
    return runTests({
        {"steps are asked for without a look", testStepsAreAskedForWithoutALook},
        {"failures that are found late", testFailuresThatAreFoundLate},
        {"changes", testChanges},
        {"parameters", testParameters},
        {"settings", testSettings},
        {"saved runs", testSavedRuns},
    });
}
