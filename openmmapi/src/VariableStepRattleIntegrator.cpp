// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include "openmm/OpenMMException.h"
#include "openmm/internal/ContextImpl.h"
#include "run/IntegratorRun.h"
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using std::string;
using std::vector;

namespace {

void requireOrder(double order) {
    if (!(order >= 1) || !std::isfinite(order))
        throw OpenMMException("VariableStepRattleIntegrator: the order of a norm must be a finite number, at least 1");
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
    if (method < SemiExplicit || method > Bounded)
        throw OpenMMException(
            "VariableStepRattleIntegrator: the update method must be SemiExplicit, Explicit or Bounded");
    settings->update = (StepDensity::Update) method;
    settingsChanged();
}

int VariableStepRattleIntegrator::addMonitor(MonitorKind kind, double weight, double power, double order) {
    if (kind < ConstraintMultipliers || kind > ForceGroupEnergy)
        throw OpenMMException("VariableStepRattleIntegrator: there is no monitor of kind " + std::to_string(kind));
    requirePositive(weight, "weight of a monitor");
    requirePositive(power, "power of a monitor");
    if (order != 0)
        requireOrder(order);
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
    if (steps < 1)
        throw OpenMMException("VariableStepRattleIntegrator: automatic step control needs at least one calibration "
                              "step, not " +
                              std::to_string(steps));
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
    if (group < 0 || group > 31)
        throw OpenMMException("VariableStepRattleIntegrator: the force group of the monitor must lie between 0 and 31, "
                              "not " +
                              std::to_string(group));
    settings->monitorForceGroup = group;
    settingsChanged();
}

double VariableStepRattleIntegrator::getNormOrder() const {
    return settings->normOrder;
}

void VariableStepRattleIntegrator::setNormOrder(double order) {
    requireOrder(order);
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
    if (!(value >= 0) || !std::isfinite(value))
        throw OpenMMException(
            "VariableStepRattleIntegrator: the reference value of a monitor must be a positive finite "
            "number, or 0 to take it at the first step");
    settings->reference(index) = value;
    if (value > 0) // it is of this kind of monitor and no other
        settings->isDefaultMonitor = false;
    settingsChanged();
}

void VariableStepRattleIntegrator::calibrate(int steps) {
    IntegratorRun& here = requireRun();
    if (steps < 1)
        throw OpenMMException("VariableStepRattleIntegrator: calibrate() needs at least one trial step");
    if (settings->getNumReferences() == 0)
        throw OpenMMException("VariableStepRattleIntegrator: calibrate() needs a monitor; add one with addMonitor()");
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
    if (!std::isfinite(time))
        throw OpenMMException("VariableStepRattleIntegrator: stepTo() needs a finite time");
    here.stepTo(time);
}

void VariableStepRattleIntegrator::reverse() {
    requireRun().reverse();
}

void VariableStepRattleIntegrator::checkMonitorIndex(int index) const {
    if (index < 0 || index >= getNumMonitors())
        throw OpenMMException("VariableStepRattleIntegrator: there is no monitor with index " + std::to_string(index) +
                              "; the integrator has " + std::to_string(getNumMonitors()));
}

// Of what has a value and a reference value: the monitors, or the two of automatic step control.
void VariableStepRattleIntegrator::checkReferenceIndex(int index) const {
    if (!settings->isAutomatic)
        checkMonitorIndex(index);
    else if (index < 0 || index >= settings->getNumReferences())
        throw OpenMMException("VariableStepRattleIntegrator: there is no monitor with index " + std::to_string(index) +
                              "; automatic step control has two, 0 and 1");
}
