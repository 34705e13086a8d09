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

AutomaticSteps::AutomaticSteps(ConstraintSolver& constraints, StepSolver& solver, const StepState& now) :
        StepControl(constraints, solver, now), control(constraints), mustForget(false), mustBegin(false),
        isStartedNow(false), isJump(false), memoryBefore(), forcesAhead(nullptr),
        blockSums(constraints.getSystem().getBlocks().size() - 1) {
}

AutomaticControl::State AutomaticSteps::stateOf(const StepState& state, const vector<Vec3>& forces) const {
    return {state.q, state.theta, state.v, forces, state.lambda};
}

// A reference of 0 stands for the one in force, if it is still.
bool AutomaticSteps::setSettings(const StepSettings& next, bool isInForce) {
    mustBegin = false;
    for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++) {
        const double given = next.automaticReferences[k], old = control.getReference(k);
        const bool isKept =
            isInForce && settings.automaticReferences[k] == 0 && next.automaticRequest == settings.automaticRequest;
        const double reference = given == 0 && isKept ? old : given;
        mustBegin = mustBegin || reference != old;
        control.setReference(k, reference);
    }
    mustBegin = mustBegin || !isInForce;
    mustForget = mustBegin || next.isFixedStep != settings.isFixedStep;
    const bool goesOn = !mustForget && next.stepSize == settings.stepSize && next.minimumStep == settings.minimumStep;
    applySettings(next);
    return goesOn;
}

void AutomaticSteps::applySettings(const StepSettings& newSettings) {
    settings = newSettings;
    AutomaticControl::Settings own;
    own.stepSize = settings.stepSize;
    own.minimumStep = settings.minimumStep;
    own.learningSteps = settings.calibrationSteps;
    std::copy(std::begin(settings.automaticReferences), std::end(settings.automaticReferences), own.given);
    control.setSettings(own);
}

void AutomaticSteps::changeSettings() {
    if (mustBegin)
        control.begin(stateOf(now, now.force));
    takeValues();
    if (mustForget)
        forgetDensity();
    if (hasDensity)
        rho = control.getLast(); // which the bound may have changed
}

vector<double> AutomaticSteps::getReferences() const {
    vector<double> references;
    for (int k = 0; k < AutomaticControl::NUM_MONITORS; k++)
        references.push_back(control.getReference(k));
    return references;
}

void AutomaticSteps::setReferences(const vector<double>& references) {
    for (size_t k = 0; k < references.size(); k++)
        control.setReference((int) k, references[k]);
}

void AutomaticSteps::getMemory(StepMemory& memory) const {
    memory.hasDensity = hasDensity;
    memory.density = rho;
    memory.references = getReferences();
    memory.u = 1;
    memory.automatic = control.getMemory();
}

void AutomaticSteps::setMemory(const StepSettings& newSettings, const StepMemory& memory) {
    applySettings(newSettings);
    setReferences(memory.references);
    control.setMemory(memory.automatic);
    takeValues();
    hasDensity = memory.hasDensity;
    rho = memory.density;
}

void AutomaticSteps::takeValues() {
    values.assign(std::begin(control.getMemory().values), std::end(control.getMemory().values));
}

// ------------------------------------------------------------------------------------------------- between two steps

void AutomaticSteps::begin() {
    forgetDensity();
    requireFiniteForces(now.force);
    control.begin(stateOf(now, now.force));
    takeValues();
}

void AutomaticSteps::adopt(double density, const AutomaticRecursions::AutomaticNumbers& numbers,
                           const vector<double>& references) {
    AutomaticControl::Memory memory = control.getMemory(); // with S_c
    static_cast<AutomaticRecursions::AutomaticNumbers&>(memory) = numbers;
    control.setMemory(memory);
    setReferences(references);
    takeValues();
    hasDensity = true;
    rho = density;
}

void AutomaticSteps::change(ChangeKind kind, double part) {
    const bool isPlace = kind == Everything || kind == Forces;
    if (isPlace && !hasDensity) {
        begin();
        return;
    }
    if (isPlace)
        requireFiniteForces(now.force);
    control.change(stateOf(now, now.force), part);
    takeValues();
    if (isPlace) // else the kick of the last step is in the half-step momentum
        rho = control.getLast();
}

void AutomaticSteps::reverse() {
    rho = rhoNext;
    control.reverse();
}

// ------------------------------------------------------------------------------------------------------------- a step

void AutomaticSteps::prepare() {
    isStartedNow = isJump = false;
    if (!hasDensity)
        referencesBefore = getReferences();
}

bool AutomaticSteps::isVariable() const {
    return hasDensity && !settings.isFixedStep;
}

// The densities start from their monitors at the end of the step.
void AutomaticSteps::jump(const vector<Vec3>&, const ExpressionParameters&, bool isLarge) {
    isJump = isLarge;
}

bool AutomaticSteps::start() {
    if (settings.isFixedStep)
        return false;
    memoryBefore = control.getMemory();
    isStartedNow = true;
    control.start();
    hasDensity = true;
    rho = control.getLast();
    return true;
}

void AutomaticSteps::findFirstDensity() {
    rhoNext = 1;
}

void AutomaticSteps::solve() {
    rhoNext = settings.isFixedStep ? 1.0 : control.getNext();
    if (!solver.solve(rho, rhoNext))
        throwNotConverged();
}

std::string AutomaticSteps::explainStep() const {
    if (!hasDensity)
        return "";
    std::stringstream text;
    text << "; the step tried was of " << settings.stepSize / rhoNext << " ps";
    return text.str();
}

ConstraintSolver::Observer* AutomaticSteps::observe(const ConstraintSolver::OnStep& end) {
    forcesAhead = &end.forces;
    return this;
}

// The force on a particle that does not move is of no interest, even if it is not a number.
void AutomaticSteps::seeParticles(int block) {
    const ConstraintSystem& system = constraints.getSystem();
    double sum = 0;
    for (int i = system.getBlocks()[block].particle; i < system.getBlocks()[block + 1].particle; i++)
        if (system.getInverseMasses()[i] > 0)
            sum += (*forcesAhead)[i].dot((*forcesAhead)[i]);
    blockSums[block] = sum;
}

void AutomaticSteps::requireFiniteForces(const vector<Vec3>& forces) {
    if (forcesAhead != &forces) {
        forcesAhead = &forces;
        for (size_t block = 0; block < blockSums.size(); block++)
            seeParticles((int) block);
    }
    forcesAhead = nullptr;
    for (double sum : blockSums)
        if (!std::isfinite(sum))
            throw StepFailure("the force on a particle is infinite or not a number");
}

bool AutomaticSteps::measure(const End& end) {
    requireFiniteForces(end.forces);
    control.measure(stateOf(end.state, end.forces), end.state.w, end.size, now.force);
    return true;
}

void AutomaticSteps::accept(const End& end) {
    if (settings.isFixedStep || !hasDensity)
        control.acceptMeasured();
    else if (end.kind == Regular)
        control.acceptStep();
    else {
        control.acceptPartOfStep(std::min(1.0, end.size * control.getNext() / settings.stepSize));
        rhoNext = control.getLast();
    }
}

void AutomaticSteps::settle(StepKind kind) {
    hasDensity = hasDensity || kind == First;
    if (hasDensity)
        rho = rhoNext;
    if (hasDensity && isJump)
        control.change(stateOf(now, now.force), 1.0);
    takeValues();
}

void AutomaticSteps::abandon() {
    if (isStartedNow) {
        control.setMemory(memoryBefore);
        forgetDensity();
    }
    isStartedNow = false;
    if (!hasDensity)
        setReferences(referencesBefore);
}
