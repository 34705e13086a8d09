// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include "openmm/internal/ContextImpl.h"
#include "run/IntegratorRun.h"
#include <cmath>

using namespace OpenMMVRattle;
using std::string;
using std::vector;

namespace {

void requireOrder(const IntegratorSettings& settings, double order) {
    settings.require(order >= 1 && std::isfinite(order), "the order of a norm must be a finite number, at least 1");
}

} // namespace

VariableStepRattleIntegrator::VariableStepRattleIntegrator(double stepSize) :
        ConstrainedIntegrator(IntegratorSettings(stepSize)) {
}

VariableStepRattleIntegrator::VariableStepRattleIntegrator(const VariableStepRattleIntegrator& other) :
        ConstrainedIntegrator(*other.settings) {
}

VariableStepRattleIntegrator::~VariableStepRattleIntegrator() = default;

// -------------------------------------------------------------------------------------------------------- the settings

double VariableStepRattleIntegrator::getNominalStepSize() const {
    return settings->stepSize;
}

void VariableStepRattleIntegrator::setNominalStepSize(double size) {
    takeStepSize(size);
}

double VariableStepRattleIntegrator::getStepSize() const {
    return run == nullptr ? settings->stepSize : run->getStepSize();
}

void VariableStepRattleIntegrator::setStepSize(double size) {
    setNominalStepSize(size);
}

double VariableStepRattleIntegrator::getMinimumStepSize() const {
    return settings->getMinimumStep();
}

void VariableStepRattleIntegrator::setMinimumStepSize(double size) {
    requirePositiveOrZero(size, "minimum step size", "for no bound");
    settings->minimumStep = size;
    settingsChanged();
}

double VariableStepRattleIntegrator::getMaximumStepSize() const {
    return settings->getMaximumStep();
}

void VariableStepRattleIntegrator::setMaximumStepSize(double size) {
    requirePositiveOrZero(size, "maximum step size", "for no bound");
    settings->maximumStep = size;
    settingsChanged();
}

VariableStepRattleIntegrator::UpdateMethod VariableStepRattleIntegrator::getUpdateMethod() const {
    return (UpdateMethod) settings->update;
}

void VariableStepRattleIntegrator::setUpdateMethod(UpdateMethod method) {
    settings->require(method >= SemiExplicit && method <= Bounded,
                      "the update method must be SemiExplicit, Explicit or Bounded");
    settings->update = (StepDensity::Update) method;
    settingsChanged();
}

int VariableStepRattleIntegrator::addMonitor(MonitorKind kind, double weight, double power, double order) {
    settings->require(kind >= ConstraintMultipliers && kind <= ForceGroupEnergy, "there is no monitor of kind ",
                      (int) kind);
    requirePositive(weight, "weight of a monitor");
    requirePositive(power, "power of a monitor");
    if (order != 0)
        requireOrder(*settings, order);
    settings->isAutomatic = settings->isDefaultMonitor = false;
    settings->terms.push_back({(StepMonitor::Kind) kind, weight, power, 0.0, order == 0 ? settings->normOrder : order});
    settingsChanged();
    return (int) settings->terms.size() - 1;
}

void VariableStepRattleIntegrator::clearMonitors() {
    settings->isAutomatic = settings->isDefaultMonitor = false;
    settings->terms.clear();
    settingsChanged();
}

void VariableStepRattleIntegrator::useAutomaticStepControl(int steps) {
    settings->require(steps >= 1, "automatic step control needs at least one calibration step, not ", steps);
    clearMonitors();
    settings->isAutomatic = true;
    settings->calibrationSteps = steps;
    settings->automaticRequest++;
    for (double& reference : settings->automaticReferences)
        reference = 0;
}

bool VariableStepRattleIntegrator::isAutomatic() const {
    return settings->isAutomatic;
}

int VariableStepRattleIntegrator::getCalibrationSteps() const {
    return settings->calibrationSteps;
}

int VariableStepRattleIntegrator::getNumMonitors() const {
    return (int) settings->terms.size();
}

void VariableStepRattleIntegrator::getMonitor(int index, MonitorKind& kind, double& weight, double& power) const {
    checkMonitorIndex(index);
    kind = (MonitorKind) settings->terms[index].kind;
    weight = settings->terms[index].weight;
    power = settings->terms[index].power;
}

double VariableStepRattleIntegrator::getMonitorNormOrder(int index) const {
    checkMonitorIndex(index);
    return settings->terms[index].order;
}

int VariableStepRattleIntegrator::getMonitorForceGroup() const {
    return settings->monitorForceGroup;
}

void VariableStepRattleIntegrator::setMonitorForceGroup(int group) {
    settings->require(group >= 0 && group <= 31, "the force group of the monitor must lie between 0 and 31, not ",
                      group);
    settings->monitorForceGroup = group;
    settingsChanged();
}

double VariableStepRattleIntegrator::getNormOrder() const {
    return settings->normOrder;
}

void VariableStepRattleIntegrator::setNormOrder(double order) {
    requireOrder(*settings, order);
    settings->normOrder = order;
    for (StepMonitor::Term& monitor : settings->terms)
        monitor.order = order;
    settingsChanged();
}

double VariableStepRattleIntegrator::getReferenceMonitorValue(int index) const {
    checkReferenceIndex(index);
    const double given = settings->getReference(index);
    return run == nullptr || given > 0 ? given : run->getReference(index);
}

void VariableStepRattleIntegrator::setReferenceMonitorValue(double value, int index) {
    checkReferenceIndex(index);
    requirePositiveOrZero(value, "reference value of a monitor", "to take it at the first step");
    settings->reference(index) = value;
    if (value > 0) // it is of this kind of monitor and no other
        settings->isDefaultMonitor = false;
    settingsChanged();
}

void VariableStepRattleIntegrator::calibrate(int steps) {
    IntegratorRun& here = requireRun();
    settings->require(steps >= 1, "calibrate() needs at least one trial step");
    settings->require(settings->getNumReferences() > 0, "calibrate() needs a monitor; add one with addMonitor()");
    const vector<double> means = here.calibrate(steps);
    for (size_t i = 0; i < means.size(); i++)
        setReferenceMonitorValue(means[i], (int) i);
}

double VariableStepRattleIntegrator::getStepDensity() const {
    return run == nullptr ? 1.0 : run->getStepDensity();
}

double VariableStepRattleIntegrator::getMonitorValue(int index) const {
    IntegratorRun& here = requireRun();
    checkReferenceIndex(index);
    return here.getMonitorValue(index);
}

long long VariableStepRattleIntegrator::getNumRescues() const {
    return run == nullptr ? 0 : run->getDevice().getCounts().rescues;
}

long long VariableStepRattleIntegrator::getNumShortSteps() const {
    return run == nullptr ? 0 : run->getDevice().getCounts().shortSteps;
}

double VariableStepRattleIntegrator::getUsualStepSize() const {
    if (run == nullptr)
        return 0;
    const OpenMM::System& system = context->getSystem();
    double lightest = 0;
    for (int i = 0; i < system.getNumParticles(); i++) {
        const double mass = system.getParticleMass(i);
        if (mass > 0 && (lightest == 0 || mass < lightest))
            lightest = mass;
    }
    return 0.001 * std::sqrt(lightest);
}

void VariableStepRattleIntegrator::setExpressionConstraintParameter(int index, const string& name, double value) {
    setExpressionParameterValue(index, name, value);
}

void VariableStepRattleIntegrator::stepTo(double time) {
    IntegratorRun& here = requireRunForStep();
    settings->require(std::isfinite(time), "stepTo() needs a finite time");
    here.stepTo(time);
}

void VariableStepRattleIntegrator::reverse() {
    requireRun().reverse();
}

void VariableStepRattleIntegrator::checkMonitorIndex(int index) const {
    requireIndex(index, getNumMonitors(), "monitor");
}

// Of what has a value and a reference value: the monitors, or the two of automatic step control.
void VariableStepRattleIntegrator::checkReferenceIndex(int index) const {
    if (!settings->isAutomatic)
        checkMonitorIndex(index);
    else
        settings->require(index >= 0 && index < settings->getNumReferences(), "there is no monitor with index ", index,
                          "; automatic step control has two, 0 and 1");
}
