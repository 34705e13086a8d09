// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/IntegratorRun.h"
#include "constraints/StepFailure.h"
#include "openmm/OpenMMException.h"
#include <algorithm>
#include <cmath>
#include <iomanip>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using std::vector;

namespace {

// How often the trial steps of automatic step control are made shorter.
const int MAX_HALVINGS = 8;

const double NO_LIMIT = std::numeric_limits<double>::infinity();

} // namespace

IntegratorRun::IntegratorRun(RunDevice& device, const IntegratorSettings& settings, int numParticles,
                             unsigned long long system) :
        device(device), settings(settings), applied(settings), numParticles(numParticles), system(system),
        areSettingsChanged(true), isAtStart(false), areParametersNew(false), areForcesChanged(false),
        task(Task::Start) {
    if (canTakeSettings())
        takeSettings();
}

// ------------------------------------------------------------------------------------------------------- what has changed

void IntegratorRun::settingsChanged() {
    areSettingsChanged = true;
}

void IntegratorRun::parametersChanged() {
    areValuesChanged = true;
}

void IntegratorRun::nominalStepChanged() {
    settingsChanged();
    toldSize = 0.0;
}

void IntegratorRun::stateChanged() {
    // OpenMM announces what it has loaded as a change of the user's; whether it is one, the fingerprint will tell.
    if (saved == nullptr)
        task = Task::Start;
}

void IntegratorRun::forcesChanged() {
    areForcesChanged = areForcesChanged || saved == nullptr;
}

void IntegratorRun::requireStepSize() const {
    settings.require(settings.stepSize != 0,
                     "the step size is 0, with which a Context computes energies and takes no steps; set one with "
                     "setStepSize()");
}

void IntegratorRun::fail(const std::string& what, const StepFailure& failure, const std::string& wayOut) const {
    settings.refuse(std::setprecision(10), what, " at t = ", device.getTime(), " ps failed because ", failure.what(),
                    wayOut);
}

bool IntegratorRun::areConstraintsOthers() const {
    return areSettingsChanged && !settings.hasSameConstraints(applied);
}

bool IntegratorRun::canTakeSettings() const {
    return settings.isConsistent() && !areConstraintsOthers();
}

// A run whose constraints move goes through here in each step.
void IntegratorRun::takeSettings() {
    if (!areSettingsChanged && !areValuesChanged)
        return;
    if (areSettingsChanged) {
        settings.requireConsistent();
        settings.require(!areConstraintsOthers(),
                         "constraints have been added or replaced since the Context was created; call "
                         "reinitialize(preserveState=True) of the Context to use them");
    }
    try {
        takeForcesOfOthers();
        if (areSettingsChanged)
            device.setSettings(settings);
        areParametersNew = device.setParameters(settings.expressions) || areParametersNew;
    }
    catch (const StepFailure& failure) {
        settings.refuse(failure.what());
    }
    areValuesChanged = false;
    if (!areSettingsChanged)
        return;
    // A start has met the tolerance that there was.
    if (settings.getActingForceGroups() != applied.getActingForceGroups() ||
        settings.getEnergyGroup() != applied.getEnergyGroup() || (isAtStart && settings.tolerance != applied.tolerance))
        task = Task::Start;
    applied = settings;
    areSettingsChanged = false;
}

// A device that has no forces but those that were computed last may have those of new parameters already: before anything else is
// made of them, the density takes note.
void IntegratorRun::takeForcesOfOthers() {
    if (task != Task::None || !areForcesChanged || !device.usesForcesOfOthers())
        return;
    device.changeForces();
    areForcesChanged = false;
}

// Go on from a saved run, unless the Context is in another state.
void IntegratorRun::takeSaved() {
    if (saved == nullptr)
        return;
    try {
        areForcesChanged = saved->areForcesOutdated || saved->parameters != device.getParameterFingerprint();
        const bool goesOn =
            saved->context == device.getFingerprint() && device.resume(*saved, applied, areForcesChanged);
        task = goesOn ? Task::None : Task::Start;
        isAtStart = isAtStart && !goesOn;
    }
    catch (const StepFailure& failure) {
        fail("going on from a saved run", failure);
    }
    saved.reset();
}

// Bring the method's state in line with the Context, which may have been changed in between.
void IntegratorRun::prepare(bool areForcesInvalid, bool isForStep) {
    findTask(areForcesInvalid, isForStep);
    fulfilTask();
}

void IntegratorRun::findTask(bool areForcesInvalid, bool isForStep) {
    takeSaved();
    takeSettings();
    // Constraints with new parameters are met by the next step, which moves them there. Whoever asks for numbers before the first
    // step asks for those of a run that starts where they hold.
    if (isAtStart && areParametersNew && !isForStep)
        task = Task::Start;
    const RunDevice::Change change = device.findChange();
    if (areForcesInvalid || change == RunDevice::Change::State) // a barostat, say
        task = std::max(task, Task::ChangeState);
    else if (change == RunDevice::Change::Box) // a new box without a word of a Force is the user's
        task = Task::Start;
    else if (change == RunDevice::Change::Velocities)
        task = std::max(task, Task::ChangeVelocities);
}

void IntegratorRun::fulfilTask() {
    try {
        if (task == Task::Start)
            device.start();
        else if (task == Task::ChangeState)
            device.changeState();
        else {
            if (task == Task::ChangeVelocities)
                device.changeVelocities();
            task = Task::None;
            if (areForcesChanged)
                device.changeForces();
        }
        isAtStart = isAtStart || task == Task::Start;
        areParametersNew = areParametersNew && task != Task::Start;
        task = Task::None;
        areForcesChanged = false;
    }
    catch (const UselessForces& failure) {
        fail("the start", failure, "; set other positions or parameters, or minimise the energy first");
    }
    catch (const StepFailure& failure) {
        fail("the start", failure);
    }
}

// --------------------------------------------------------------------------------------------------------- the steps

// A step, which the device may not have taken when this returns.
void IntegratorRun::askForStep(double maxTime) {
    takeSaved(); // as long as no Force has changed the Context
    prepare(device.updateState(), true);
    device.step(maxTime);
    isAtStart = areParametersNew = false;
    toldSize.reset();
    toldDensity.reset();
}

template <class Ask> void IntegratorRun::takeSteps(Ask ask) {
    requireStepSize();
    const long long count = device.getStepCount();
    const std::optional<double> size = toldSize, density = toldDensity;
    try {
        ask();
        device.settle();
    }
    catch (const StepFailure& failure) {
        if (device.getStepCount() == count) { // then what was told is still true
            toldSize = size;
            toldDensity = density;
        }
        fail("the step", failure,
             settings.langevin
                 ? "; the Context is in the state before this step: move apart what overlaps, or allow more "
                   "substeps with setMaximumSubsteps()"
             : settings.isAutomatic ? "; the Context is in the state before this step: use a smaller step size"
                                    : "; the Context is in the state before this step: use a smaller step size, or "
                                      "another monitor");
    }
}

void IntegratorRun::step(int count) {
    if (count > 0)
        takeSteps([&] {
            for (int i = 0; i < count; i++)
                askForStep(NO_LIMIT);
        });
}

void IntegratorRun::stepTo(double time) {
    if (time > device.getTime())
        takeSteps([&] {
            for (double now = device.getTime(); time > now;) {
                askForStep(time);
                const double last = now;
                now = device.getTime();
                settings.require(now > last, "stepTo() makes no way at t = ", now,
                                 " ps, which is so large that a step is lost in its rounding; set the time back with "
                                 "setTime() of the Context");
            }
        });
}

void IntegratorRun::reverse() {
    requireStepSize();
    prepare(false);
    try {
        device.reverse();
    }
    catch (const StepFailure& failure) {
        fail("reverse()", failure, "; the Context is unchanged");
    }
    toldDensity.reset();
}

std::function<void()> IntegratorRun::keepTask() {
    return [this, before = task] { task = before; };
}

void IntegratorRun::replaceVelocities(const std::function<void()>& set, const std::function<void()>& putBack) {
    findTask(false, false);
    auto change = [&] {
        set();
        fulfilTask();
    };
    attempt(change, [&, takeBack = keepTask()] {
        putBack();
        takeBack();
    });
    device.writeVelocities();
}

// ----------------------------------------------------------------------------------------------------------- trial runs

// With automatic step control geometric means of its two, and where steps of the nominal size fail, shorter ones must do.
vector<double> IntegratorRun::calibrate(int steps) {
    requireStepSize();
    prepare(false);
    const bool isAutomatic = settings.isAutomatic;
    const double negligible = device.getNegligibleValue();
    double stepSize = settings.stepSize;
    for (int halvings = 0;; halvings++) {
        vector<double> means(settings.getNumReferences(), 0.0);
        try {
            device.tryOut(stepSize, steps, [&](const vector<double>& values) {
                for (size_t k = 0; k < means.size(); k++)
                    means[k] += (isAutomatic ? std::log(std::max(values[k], negligible)) : values[k]) / steps;
            });
        }
        catch (const StepFailure& failure) {
            if (!isAutomatic || halvings == MAX_HALVINGS)
                fail("calibrate()", failure, "; the Context is unchanged: use a smaller step size");
            stepSize *= 0.5;
            continue;
        }
        for (size_t k = 0; k < means.size(); k++) {
            if (isAutomatic)
                means[k] = std::exp(means[k]);
            settings.require(
                !isAutomatic || means[k] > 2 * negligible,
                "in the trial run of calibrate() there is no force and nothing moves, so there is nothing to "
                "measure steps by; leave it to the run, which finds the reference values as soon as there "
                "is something");
            settings.require(means[k] > 0, "monitor ", k,
                             " is zero all along the trial run of calibrate(); choose another monitor");
        }
        return means;
    }
}

// --------------------------------------------------------------------------------------------------- numbers of the run

double IntegratorRun::getStepSize() {
    const double size = toldSize ? *toldSize : device.getLastStep().size;
    return size > 0 ? size : settings.stepSize;
}

double IntegratorRun::getStepDensity() {
    return toldDensity ? *toldDensity : device.getLastStep().density;
}

double IntegratorRun::getReference(int index) {
    if (canTakeSettings() && areSettingsChanged) {
        takeSaved();
        takeSettings();
    }
    return getFindings().references[index];
}

// Of the settings that there are, though the device may have those before.
Findings IntegratorRun::getFindings() {
    Findings findings = device.getFindings();
    const bool haveSameUnits = std::equal(
        settings.terms.begin(), settings.terms.end(), applied.terms.begin(), applied.terms.end(),
        [](const StepMonitor::Term& a, const StepMonitor::Term& b) { return a.kind == b.kind && a.order == b.order; });
    if (!haveSameUnits || settings.isAutomatic != applied.isAutomatic)
        findings.references.assign(settings.getNumReferences(), 0.0);
    return findings;
}

double IntegratorRun::getMonitorValue(int index) {
    prepare(false);
    return device.getMonitorValues()[index];
}

vector<double> IntegratorRun::getMultipliers() {
    prepare(false);
    return device.getMultipliers();
}

double IntegratorRun::getExpressionMultiplier(int index) {
    prepare(false);
    return device.getExpressionMultiplier(index);
}

vector<double> IntegratorRun::getRandomState() {
    if (settings.langevin && canTakeSettings())
        takeSettings();
    return device.getFindings().random;
}

double IntegratorRun::computeKineticEnergy() {
    if (!settings.langevin || settings.stepSize == 0)
        return device.computeKineticEnergy();
    try {
        prepare(false);
    }
    catch (const OpenMMException&) {
        // No step could begin with the state of the Context: what its velocities have is all there is to say.
        return device.computeKineticEnergy();
    }
    return device.computeHalfStepKineticEnergy();
}

// ------------------------------------------------------------------------------------------------ saving and resuming

RunState IntegratorRun::save() {
    RunState run;
    run.system = system;
    // Settings that no step can be taken with: whatever becomes of them, the run will start afresh.
    if (canTakeSettings()) {
        takeSaved();
        bool areForcesValid = true;
        try {
            takeForcesOfOthers();
        }
        catch (const StepFailure&) {
            areForcesValid = false; // which is no reason not to save
        }
        if (areForcesValid)
            takeSettings();
        run.startsAfresh = !areForcesValid || task != Task::None;
    }
    run.context = device.getFingerprint();
    run.parameters = device.getParameterFingerprint();
    run.areForcesOutdated = areForcesChanged;
    run.lastStepSize = toldSize ? *toldSize : device.getLastStep().size;
    run.lastDensity = getStepDensity();
    run.findings = getFindings();
    if (!run.startsAfresh)
        device.save(run);
    return run;
}

void IntegratorRun::requireUsable(const RunState& run, const IntegratorSettings& other) const {
    if (run.system != system)
        return;
    run.requireSizes(numParticles, other.getNumReferences());
    if (!run.startsAfresh)
        device.canResume(run, other);
}

void IntegratorRun::resume(const RunState& run) {
    saved.reset();
    task = Task::Start;
    areForcesChanged = false;
    settingsChanged();
    toldSize = run.lastStepSize;
    toldDensity = run.lastDensity;
    if (!canTakeSettings())
        return;
    takeSettings();
    Findings findings = run.findings;
    const Findings own = device.getFindings();
    if ((int) findings.references.size() != settings.getNumReferences()) {
        findings.references = own.references;
        findings.referenceTemperature = own.referenceTemperature;
    }
    if (findings.random.empty())
        findings.random = own.random;
    device.setFindings(findings);
    if (run.system == system && !run.startsAfresh && device.canResume(run, settings))
        saved = std::make_unique<RunState>(run);
}
