// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include "ExpressionCheck.h"
#include "MaxwellVelocities.h"
#include "SystemCheck.h"
#include "openmm/OpenMMException.h"
#include "openmm/Platform.h"
#include "openmm/internal/ContextImpl.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmm/serialization/XmlSerializer.h"
#include "openmmvrattle/VRattleKernels.h"
#include "run/CheckpointBlock.h"
#include "run/IntegratorRun.h"
#include <algorithm>
#include <cmath>
#include <memory>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::ContextImpl;
using OpenMM::OpenMMException;
using OpenMM::Platform;
using OpenMM::SerializationNode;
using OpenMM::State;
using OpenMM::XmlSerializer;
using std::string;
using std::vector;

namespace {

// Of the parameters that States hold; the settings among them have a version of their own.
const int PARAMETERS_VERSION = 2;
// Its square, by which multipliers act on positions, must not vanish.
const double SMALLEST_STEP_SIZE = 1e-100;
const char TYPE_NAME[] = "VariableStepRattleIntegrator";

void requirePositive(double value, const string& name) {
    if (!(value > 0) || !std::isfinite(value)) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the " << name << " must be a positive finite number, not " << value;
        throw OpenMMException(message.str());
    }
}

// What 0 stands for belongs to the message.
void requirePositiveOrZero(double value, const string& name, const string& zero) {
    if (!(value >= 0) || !std::isfinite(value)) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the " << name << " must be a positive finite number, or 0 " << zero
                << ", not " << value;
        throw OpenMMException(message.str());
    }
}

void requireOrder(double order) {
    if (!(order >= 1) || !std::isfinite(order))
        throw OpenMMException("VariableStepRattleIntegrator: the order of a norm must be a finite number, at least 1");
}

string majorMinor(const string& version) {
    size_t first = version.find('.');
    if (first == string::npos)
        return version;
    size_t second = version.find_first_not_of("0123456789", first + 1);
    return version.substr(0, second);
}

// An OpenMM plugin depends on the binary interface of the OpenMM it was built against.
void checkOpenMMVersion() {
    const string built = OPENMMVRATTLE_OPENMM_VERSION;
    const string running = Platform::getOpenMMVersion();
    if (majorMinor(running) != built)
        throw OpenMMException("VariableStepRattleIntegrator: this plugin was built for OpenMM " + built +
                              " and cannot run with OpenMM " + running + "; install openmm==" + built +
                              ".* or rebuild the plugin");
}

// Whether a System has a constraint that could move anything, of its own or by expression.
bool hasConstraints(const OpenMM::System& system, const IntegratorSettings& settings) {
    for (int i = 0; i < system.getNumConstraints(); i++) {
        int particle1, particle2;
        double distance;
        system.getConstraintParameters(i, particle1, particle2, distance);
        if (system.getParticleMass(particle1) > 0 || system.getParticleMass(particle2) > 0)
            return true;
    }
    return !settings.expressions.empty();
}

} // namespace

VariableStepRattleIntegrator::VariableStepRattleIntegrator(double stepSize) :
        settings(std::make_unique<IntegratorSettings>(stepSize)), lastSaved(0) {
    setNominalStepSize(stepSize);
    Integrator::setConstraintTolerance(settings->constraintTolerance);
    Integrator::setIntegrationForceGroups(settings->forceGroups);
}

VariableStepRattleIntegrator::VariableStepRattleIntegrator(const VariableStepRattleIntegrator& other) :
        Integrator(), settings(std::make_unique<IntegratorSettings>(*other.settings)), lastSaved(0),
        checkedExpressions(other.checkedExpressions) {
    takeOver(*other.settings);
}

VariableStepRattleIntegrator::~VariableStepRattleIntegrator() = default;

// -------------------------------------------------------------------------------------------------------- the settings

void VariableStepRattleIntegrator::settingsChanged() {
    if (run != nullptr)
        run->settingsChanged();
}

// Replace all settings, those that the base class keeps as well.
void VariableStepRattleIntegrator::takeOver(const IntegratorSettings& newSettings) {
    *settings = newSettings;
    Integrator::setStepSize(settings->stepSize);
    Integrator::setConstraintTolerance(settings->constraintTolerance);
    Integrator::setIntegrationForceGroups(settings->forceGroups);
    settingsChanged();
}

double VariableStepRattleIntegrator::getNominalStepSize() const {
    return settings->stepSize;
}

void VariableStepRattleIntegrator::setNominalStepSize(double size) {
    requirePositiveOrZero(size, "step size", "where no step is to be taken");
    if (size > 0 && size < SMALLEST_STEP_SIZE) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: a step size of " << size
                << " ps is too small to compute with; set one of " << SMALLEST_STEP_SIZE << " ps or more";
        throw OpenMMException(message.str());
    }
    settings->stepSize = size;
    Integrator::setStepSize(size);
    if (run != nullptr)
        run->nominalStepChanged();
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
    settings->monitors.push_back(
        {(StepMonitor::Kind) kind, weight, power, 0.0, order == 0 ? settings->normOrder : order});
    settingsChanged();
    return (int) settings->monitors.size() - 1;
}

void VariableStepRattleIntegrator::clearMonitors() {
    settings->isAutomatic = settings->isDefaultMonitor = false;
    settings->monitors.clear();
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
    return (int) settings->monitors.size();
}

void VariableStepRattleIntegrator::getMonitor(int index, MonitorKind& kind, double& weight, double& power) const {
    checkMonitorIndex(index);
    kind = (MonitorKind) settings->monitors[index].kind;
    weight = settings->monitors[index].weight;
    power = settings->monitors[index].power;
}

double VariableStepRattleIntegrator::getMonitorNormOrder(int index) const {
    checkMonitorIndex(index);
    return settings->monitors[index].order;
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
    for (StepMonitor::Term& monitor : settings->monitors)
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

vector<double> VariableStepRattleIntegrator::getMultipliers() const {
    return requireRun().getMultipliers();
}

long long VariableStepRattleIntegrator::getNumForceEvaluations() const {
    return run == nullptr ? 0 : run->getDevice().getNumForceEvaluations();
}

long long VariableStepRattleIntegrator::getNumSolverIterations() const {
    return run == nullptr ? 0 : run->getDevice().getNumSolverIterations();
}

long long VariableStepRattleIntegrator::getNumRescues() const {
    return run == nullptr ? 0 : run->getDevice().getNumRescues();
}

long long VariableStepRattleIntegrator::getNumShortSteps() const {
    return run == nullptr ? 0 : run->getDevice().getNumShortSteps();
}

void VariableStepRattleIntegrator::setConstraintTolerance(double tol) {
    requirePositive(tol, "constraint tolerance");
    Integrator::setConstraintTolerance(tol);
    settings->constraintTolerance = tol;
    settingsChanged();
}

int VariableStepRattleIntegrator::getIntegrationForceGroups() const {
    return settings->getActingForceGroups();
}

void VariableStepRattleIntegrator::setIntegrationForceGroups(int groups) {
    Integrator::setIntegrationForceGroups(groups);
    settings->forceGroups = groups;
    settingsChanged();
}

// ------------------------------------------------------------------------------------------ constraints by expressions

void VariableStepRattleIntegrator::checkConstraint(const string& expression, const vector<int>& particles,
                                                   const std::map<string, double>& parameters) {
    const string constraint = "VariableStepRattleIntegrator: the constraint \"" + expression + "\" ";
    vector<string> names;
    for (const auto& parameter : parameters) {
        names.push_back(parameter.first);
        if (!std::isfinite(parameter.second))
            throw OpenMMException(constraint + "has the parameter " + parameter.first +
                                  ", whose value is not a finite number");
    }
    vector<int> sorted = particles;
    std::sort(sorted.begin(), sorted.end());
    if (!sorted.empty() && sorted[0] < 0)
        throw OpenMMException(constraint + "is of particle " + std::to_string(sorted[0]) +
                              ", and the index of a particle cannot be negative");
    const auto twice = std::adjacent_find(sorted.begin(), sorted.end());
    if (twice != sorted.end())
        throw OpenMMException(constraint + "names particle " + std::to_string(*twice) +
                              " twice; name each particle once");
    const auto key = std::make_tuple(expression, particles.size(), names);
    if (checkedExpressions.count(key) == 0) {
        requireValidExpression(expression, (int) particles.size(), parameters);
        checkedExpressions.insert(key);
    }
}

int VariableStepRattleIntegrator::addConstraint(const string& expression, const vector<int>& particles,
                                                const std::map<string, double>& parameters) {
    checkConstraint(expression, particles, parameters);
    settings->expressions.push_back({expression, particles, parameters});
    settingsChanged();
    return (int) settings->expressions.size() - 1;
}

int VariableStepRattleIntegrator::getNumExpressionConstraints() const {
    return (int) settings->expressions.size();
}

void VariableStepRattleIntegrator::checkExpressionConstraintIndex(int index) const {
    if (index < 0 || index >= getNumExpressionConstraints())
        throw OpenMMException("VariableStepRattleIntegrator: there is no expression constraint with index " +
                              std::to_string(index) + "; the integrator has " +
                              std::to_string(getNumExpressionConstraints()));
}

void VariableStepRattleIntegrator::getExpressionConstraintParameters(int index, string& expression,
                                                                     vector<int>& particles,
                                                                     std::map<string, double>& parameters) const {
    checkExpressionConstraintIndex(index);
    expression = settings->expressions[index].expression;
    particles = settings->expressions[index].particles;
    parameters = settings->expressions[index].parameters;
}

void VariableStepRattleIntegrator::setExpressionConstraintParameters(int index, const string& expression,
                                                                     const vector<int>& particles,
                                                                     const std::map<string, double>& parameters) {
    checkExpressionConstraintIndex(index);
    checkConstraint(expression, particles, parameters);
    settings->expressions[index] = {expression, particles, parameters};
    settingsChanged();
}

void VariableStepRattleIntegrator::setExpressionParameterValue(int index, const string& name, double value) {
    checkExpressionConstraintIndex(index);
    OpenMMVRattle::ExpressionConstraint changed = settings->expressions[index];
    if (changed.parameters.count(name) == 0)
        throw OpenMMException("VariableStepRattleIntegrator: the constraint \"" + changed.expression +
                              "\" has no parameter " + name);
    changed.parameters[name] = value;
    setExpressionConstraintParameters(index, changed.expression, changed.particles, changed.parameters);
}

void VariableStepRattleIntegrator::setExpressionConstraintParameter(int index, const string& name, double value) {
    setExpressionParameterValue(index, name, value);
}

double VariableStepRattleIntegrator::getExpressionConstraintMultiplier(int index) const {
    requireRun();
    checkExpressionConstraintIndex(index);
    const int numDistances = context->getSystem().getNumConstraints();
    return getMultipliers().at(numDistances + index);
}

// ----------------------------------------------------------------------------------------------------------- the run

IntegratorRun& VariableStepRattleIntegrator::requireRun() const {
    if (run == nullptr)
        throw OpenMMException("This Integrator is not bound to a context!");
    return *run;
}

void VariableStepRattleIntegrator::step(int steps) {
    requireRun().step(steps);
}

void VariableStepRattleIntegrator::stepTo(double time) {
    IntegratorRun& here = requireRun();
    if (!std::isfinite(time))
        throw OpenMMException("VariableStepRattleIntegrator: stepTo() needs a finite time");
    here.stepTo(time);
}

void VariableStepRattleIntegrator::setVelocitiesToTemperature(double temperature, int randomSeed) {
    IntegratorRun& inContext = requireRun();
    if (!(temperature >= 0) || !std::isfinite(temperature)) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the temperature must be a finite number of kelvins that is not "
                   "negative, not "
                << temperature;
        throw OpenMMException(message.str());
    }
    vector<OpenMM::Vec3> before;
    context->getVelocities(before);
    context->setVelocities(drawMaxwellVelocities(context->getSystem(), temperature, randomSeed));
    try {
        inContext.projectVelocities();
    }
    catch (...) {
        context->setVelocities(before);
        throw;
    }
}

void VariableStepRattleIntegrator::reverse() {
    requireRun().reverse();
}

void VariableStepRattleIntegrator::initialize(ContextImpl& contextRef) {
    checkOpenMMVersion();
    if (owner != NULL && &contextRef.getOwner() != owner)
        throw OpenMMException("This Integrator is already bound to a context");
    requireSuitableSystem(contextRef, settings->expressions);
    const OpenMM::System& system = contextRef.getSystem();
    settings->fitDefaultMonitor(hasConstraints(system, *settings));
    OpenMM::Kernel created = contextRef.getPlatform().createKernel(IntegrateVRattleStepKernel::Name(), contextRef);
    RunDevice& device = created.getAs<IntegrateVRattleStepKernel>().initialize(contextRef, *this, *settings);
    run = std::make_unique<IntegratorRun>(device, *settings, system.getNumParticles(),
                                          RunState::fingerprintOf(system, *settings));
    kernel = created;
    context = &contextRef;
    owner = &contextRef.getOwner();
}

void VariableStepRattleIntegrator::cleanup() {
    run.reset();
    kernel = OpenMM::Kernel();
}

vector<string> VariableStepRattleIntegrator::getKernelNames() {
    return {IntegrateVRattleStepKernel::Name()};
}

void VariableStepRattleIntegrator::stateChanged(State::DataType changed) {
    if (run == nullptr) // where Context::reinitialize() has failed
        return;
    // OpenMM announces Context::setParameter() as Parameters, and a Force's updateParametersInContext() as Energy.
    if (changed == State::Parameters || changed == State::Energy)
        run->forcesChanged();
    else
        run->stateChanged();
}

double VariableStepRattleIntegrator::computeKineticEnergy() {
    return requireRun().getDevice().computeKineticEnergy();
}

// Nothing of ours does; but on GPUs energies without forces would leave none for the next step.
bool VariableStepRattleIntegrator::kineticEnergyRequiresForce() const {
    return run != nullptr && run->getDevice().usesForcesOfOthers();
}

// ---------------------------------------------------------------------------------------------- saving and restoring

void VariableStepRattleIntegrator::resume(const IntegratorSettings& saved, RunState& state) {
    const IntegratorSettings previous = *settings;
    IntegratorSettings next = saved;
    next.automaticRequest = previous.automaticRequest;
    if (!next.hasSameConstraints(previous)) // the constraints are those of the Context, their parameters the saved ones
        next.expressions = previous.expressions;
    next.fitDefaultMonitor(hasConstraints(context->getSystem(), next));
    if (next.isDefaultMonitor && next.monitors[0].kind != saved.monitors[0].kind)
        state.references.clear();
    run->requireUsable(state, next);
    takeOver(next);
    try {
        run->resume(state);
    }
    catch (...) {
        takeOver(previous);
        throw;
    }
}

void VariableStepRattleIntegrator::createCheckpoint(std::ostream& stream) const {
    std::ostringstream text, data;
    XmlSerializer::serialize(this, "Integrator", text);
    const long long length = (long long) text.str().size();
    data.write(reinterpret_cast<const char*>(&length), sizeof(length));
    data.write(text.str().data(), length);
    const RunState state = requireRun().save();
    state.write(data);
    CheckpointBlock::write(stream, data.str());
    lastSaved = state.context;
}

void VariableStepRattleIntegrator::loadCheckpoint(std::istream& stream) {
    run->stateChanged();
    string block;
    if (!CheckpointBlock::read(stream, block))
        return; // it was written under another integrator
    std::istringstream data(block);
    long long length = 0;
    data.read(reinterpret_cast<char*>(&length), sizeof(length));
    string text(length, ' ');
    data.read(&text[0], length);
    std::istringstream xml(text);
    std::unique_ptr<VariableStepRattleIntegrator> saved(XmlSerializer::deserialize<VariableStepRattleIntegrator>(xml));
    RunState state;
    state.read(data);
    // Whoever has changed the masses or constraints calls Context::reinitialize(), which loads what was saved just before.
    if (state.system != run->getSystemFingerprint() && state.context != lastSaved)
        throw OpenMMException("VariableStepRattleIntegrator: this checkpoint was made with another System, whose "
                              "masses or constraints are not those of this one; load it into a Context of that System");
    resume(*saved->settings, state);
}

void VariableStepRattleIntegrator::serializeParameters(SerializationNode& node) const {
    node.setIntProperty("version", PARAMETERS_VERSION);
    node.setStringProperty("integrator", TYPE_NAME);
    node.createChildNode("Settings", this);
    requireRun().save().write(node.createChildNode("Run"));
}

void VariableStepRattleIntegrator::deserializeParameters(const SerializationNode& node) {
    if (node.getStringProperty("integrator", "") != TYPE_NAME)
        return; // they are another integrator's, or there are none
    const int version = node.getIntProperty("version");
    if (version != PARAMETERS_VERSION)
        throw OpenMMException("VariableStepRattleIntegrator: the State holds parameters in version " +
                              std::to_string(version) + " of their format and this plugin reads version " +
                              std::to_string(PARAMETERS_VERSION) + "; use the version of the plugin that wrote them");
    std::unique_ptr<VariableStepRattleIntegrator> saved(
        node.getChildNode("Settings").decodeObject<VariableStepRattleIntegrator>());
    RunState state;
    state.read(node.getChildNode("Run"));
    resume(*saved->settings, state);
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
