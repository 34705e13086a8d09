// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/AutomaticSteps.h"
#include <algorithm>
#include <cmath>
#include <iterator>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

AutomaticSteps::AutomaticSteps(ConstraintSolver& constraints, StepSolver& solver, StepState& now) :
        StepControl(constraints, solver, now), control(constraints), isStartedNow(false), isJump(false), memoryBefore(),
        forceSquares(constraints) {
}

AutomaticControl::State AutomaticSteps::stateOf(const StepState& state) {
    return {state.q, state.theta, state.v, state.force, state.lambda};
}

void AutomaticSteps::changeSettings(const StepSettings& newSettings, const vector<double>& references,
                                    SettingsChange change) {
    setReferences(references);
    applySettings(newSettings);
    if (change == Nothing || now.q.empty())
        return;
    if (change != Sizes) {
        control.begin(stateOf(now));
        forgetDensity();
    }
    if (hasDensity)
        rho = control.getLast(); // which the bound may have changed
}

void AutomaticSteps::applySettings(const StepSettings& newSettings) {
    settings = newSettings;
    AutomaticControl::Settings own;
    own.stepSize = settings.stepSize;
    own.minimumStep = settings.stepSize > 0 ? settings.getMinimumStep() : 0.0;
    own.learningSteps = settings.calibrationSteps;
    std::copy(std::begin(settings.automaticReferences), std::end(settings.automaticReferences), own.given);
    control.setSettings(own);
}

vector<double> AutomaticSteps::getValues() const {
    return {std::begin(control.getMemory().values), std::end(control.getMemory().values)};
}

vector<double> AutomaticSteps::getReferences() const {
    vector<double> inForce;
    for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
        inForce.push_back(control.getReference(k));
    return inForce;
}

void AutomaticSteps::setReferences(const vector<double>& newReferences) {
    for (size_t k = 0; k < newReferences.size(); k++)
        control.setReference((int) k, newReferences[k]);
}

// ------------------------------------------------------------------------------------------------- between two steps

void AutomaticSteps::change(ChangeKind kind, double part) {
    const bool isPlace = kind == Everything || kind == Forces;
    if (isPlace)
        forceSquares.find(now.force);
    if (isPlace && !hasDensity) {
        control.begin(stateOf(now));
        return;
    }
    control.change(stateOf(now), part);
    if (isPlace) // else the kick of the last step is in the half-step momentum
        rho = control.getLast();
}

void AutomaticSteps::reverse() {
    rho = rhoNext;
    control.reverse();
}

// ------------------------------------------------------------------------------------------------------------- a step

bool AutomaticSteps::start() {
    if (settings.isFixedStep)
        return false;
    memoryBefore = control.getMemory();
    referencesBefore = getReferences();
    isStartedNow = true;
    control.start();
    hasDensity = true;
    rho = control.getLast();
    return true;
}

void AutomaticSteps::solve() {
    // The densities start from their monitors at the end of the step.
    isJump = solver.jump > ParameterMotion::SMALL_JUMP && !settings.isFixedStep;
    rhoNext = settings.isFixedStep || !hasDensity ? 1.0 : control.getNext();
    if (hasDensity && !solver.solve(rho, rhoNext))
        throwNotConverged();
}

std::string AutomaticSteps::explainStep() const {
    if (!hasDensity)
        return "";
    std::stringstream text;
    text << "; the step tried was of " << settings.stepSize / rhoNext << " ps";
    return text.str();
}

bool AutomaticSteps::finish() {
    StepState& next = solver.next;
    forceSquares.observe(next.force);
    constraints.finish(next.end(0.5 * solver.size), &forceSquares);
    forceSquares.find(next.force);
    control.measure(stateOf(next), next.w, solver.size, now.force);
    return true;
}

void AutomaticSteps::accept() {
    if (settings.isFixedStep || !hasDensity)
        control.acceptMeasured();
    else if (solver.kind == StepSolver::Regular)
        control.acceptStep();
    else {
        control.acceptPartOfStep(std::min(1.0, solver.size * control.getNext() / settings.stepSize));
        rhoNext = control.getLast();
    }
    hasDensity = hasDensity || solver.kind == StepSolver::First;
    if (hasDensity)
        rho = rhoNext;
    if (hasDensity && isJump)
        control.change(stateOf(now), 1.0);
    isStartedNow = false;
}

void AutomaticSteps::abandon() {
    if (isStartedNow) {
        control.setMemory(memoryBefore);
        setReferences(referencesBefore);
        forgetDensity();
    }
    isStartedNow = false;
}
