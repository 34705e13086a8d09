// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include "CheckpointBlock.h"
#include "ExpressionCheck.h"
#include "openmm/OpenMMException.h"
#include "openmm/Platform.h"
#include "openmm/internal/ContextImpl.h"
#include "openmm/internal/ForceImpl.h"
#include "openmm/reference/ReferencePlatform.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmm/serialization/XmlSerializer.h"
#include "openmmvrattle/VRattleKernels.h"
#include <algorithm>
#include <cmath>
#include <limits>
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

// The bounds' defaults as fractions of the nominal step size (API: nominal/50 and 2 nominal).
const double DEFAULT_MINIMUM_FACTOR = 1.0 / 50.0;
const double DEFAULT_MAXIMUM_FACTOR = 2.0;
const double USE_DEFAULT = -1.0;
const int DEFAULT_CALIBRATION_STEPS = 300;
const int NUM_AUTOMATIC_MONITORS = 2;

// Of the parameters that States hold; the settings among them have a version of their own.
const int PARAMETERS_VERSION = 1;
const char TYPE_NAME[] = "VariableStepRattleIntegrator";

// The changes that Context::loadCheckpoint() announces after our loadCheckpoint(), in this order.
const State::DataType CHANGES_AFTER_LOADING[] = {State::Positions, State::Velocities, State::Parameters, State::Energy};
const int NUM_CHANGES_AFTER_LOADING = 4;

void requirePositive(double value, const string& name) {
    if (!(value > 0) || !std::isfinite(value)) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the " << name << " must be a positive finite number, not " << value;
        throw OpenMMException(message.str());
    }
}

void requireBound(double value, const string& name) {
    if (!(value >= 0) || !std::isfinite(value)) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the " << name
                << " must be a positive finite number, or 0 for no bound, not " << value;
        throw OpenMMException(message.str());
    }
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

// A Drude particle moved like any other would take up heat from the rest. The class DrudeForce is in a library of its
// own, which we do not link with, so it is recognised by its kernel.
void refuseDrudeParticles(ContextImpl& context) {
    for (OpenMM::ForceImpl* force : context.getForceImpls()) {
        const vector<string> names = force->getKernelNames();
        if (std::find(names.begin(), names.end(), "CalcDrudeForce") != names.end())
            throw OpenMMException("VariableStepRattleIntegrator: the System has a DrudeForce and Drude particles need "
                                  "an integrator made for them; use DrudeSCFIntegrator, DrudeNoseHooverIntegrator or "
                                  "DrudeLangevinIntegrator, or a force field without Drude particles");
    }
}

bool haveSameNames(const std::map<string, double>& a, const std::map<string, double>& b) {
    return a.size() == b.size() &&
           std::equal(a.begin(), a.end(), b.begin(), [](const auto& x, const auto& y) { return x.first == y.first; });
}

} // namespace

VariableStepRattleIntegrator::VariableStepRattleIntegrator(double stepSize) :
        nominalStepSize(0), lastStepSize(0), minimumStepSize(USE_DEFAULT), maximumStepSize(USE_DEFAULT),
        updateMethod(SemiExplicit), monitorForceGroup(31), normOrder(8), automatic(false),
        calibrationSteps(DEFAULT_CALIBRATION_STEPS), numAutomaticRequests(0), automaticReferences(),
        reinitializationPhase(None), numChangesAfterLoading(NUM_CHANGES_AFTER_LOADING) {
    monitors.push_back({ConstraintMultipliers, 1.0, 1.0, 0.0});
    setNominalStepSize(stepSize);
    setConstraintTolerance(1e-8);
}

double VariableStepRattleIntegrator::getNominalStepSize() const {
    return nominalStepSize;
}

void VariableStepRattleIntegrator::setNominalStepSize(double size) {
    requirePositive(size, "step size");
    checkBounds(size, minimumStepSize, maximumStepSize);
    nominalStepSize = size;
    Integrator::setStepSize(size);
    settingsChanged();
}

double VariableStepRattleIntegrator::getStepSize() const {
    return lastStepSize > 0 ? lastStepSize : nominalStepSize;
}

void VariableStepRattleIntegrator::setStepSize(double size) {
    setNominalStepSize(size);
}

bool VariableStepRattleIntegrator::hasMinimumStepSize() const {
    return minimumStepSize >= 0;
}

bool VariableStepRattleIntegrator::hasMaximumStepSize() const {
    return maximumStepSize >= 0;
}

double VariableStepRattleIntegrator::getMinimumStepSize() const {
    return minimumStepSize < 0 ? DEFAULT_MINIMUM_FACTOR * nominalStepSize : minimumStepSize;
}

void VariableStepRattleIntegrator::setMinimumStepSize(double size) {
    requireBound(size, "minimum step size");
    checkBounds(nominalStepSize, size, maximumStepSize);
    minimumStepSize = size;
    settingsChanged();
}

double VariableStepRattleIntegrator::getMaximumStepSize() const {
    return maximumStepSize < 0 ? DEFAULT_MAXIMUM_FACTOR * nominalStepSize : maximumStepSize;
}

void VariableStepRattleIntegrator::setMaximumStepSize(double size) {
    requireBound(size, "maximum step size");
    checkBounds(nominalStepSize, minimumStepSize, size);
    maximumStepSize = size;
    settingsChanged();
}

VariableStepRattleIntegrator::UpdateMethod VariableStepRattleIntegrator::getUpdateMethod() const {
    return updateMethod;
}

void VariableStepRattleIntegrator::setUpdateMethod(UpdateMethod method) {
    if (method < SemiExplicit || method > Bounded)
        throw OpenMMException(
            "VariableStepRattleIntegrator: the update method must be SemiExplicit, Explicit or Bounded");
    updateMethod = method;
    settingsChanged();
}

int VariableStepRattleIntegrator::addMonitor(MonitorKind kind, double weight, double power) {
    if (kind < ConstraintMultipliers || kind > ForceGroupEnergy)
        throw OpenMMException("VariableStepRattleIntegrator: there is no monitor of kind " + std::to_string(kind));
    requirePositive(weight, "weight of a monitor");
    requirePositive(power, "power of a monitor");
    automatic = false;
    monitors.push_back({kind, weight, power, 0.0});
    settingsChanged();
    return (int) monitors.size() - 1;
}

void VariableStepRattleIntegrator::clearMonitors() {
    automatic = false;
    monitors.clear();
    settingsChanged();
}

void VariableStepRattleIntegrator::useAutomaticStepControl(int steps) {
    if (steps < 1)
        throw OpenMMException("VariableStepRattleIntegrator: automatic step control needs at least one calibration "
                              "step, not " +
                              std::to_string(steps));
    automatic = true;
    calibrationSteps = steps;
    numAutomaticRequests++;
    for (double& reference : automaticReferences)
        reference = 0;
    monitors.clear();
    settingsChanged();
}

bool VariableStepRattleIntegrator::isAutomatic() const {
    return automatic;
}

int VariableStepRattleIntegrator::getCalibrationSteps() const {
    return calibrationSteps;
}

int VariableStepRattleIntegrator::getNumAutomaticRequests() const {
    return numAutomaticRequests;
}

int VariableStepRattleIntegrator::getNumMonitors() const {
    return (int) monitors.size();
}

void VariableStepRattleIntegrator::getMonitor(int index, MonitorKind& kind, double& weight, double& power) const {
    checkMonitorIndex(index);
    kind = monitors[index].kind;
    weight = monitors[index].weight;
    power = monitors[index].power;
}

int VariableStepRattleIntegrator::getMonitorForceGroup() const {
    return monitorForceGroup;
}

void VariableStepRattleIntegrator::setMonitorForceGroup(int group) {
    if (group < 0 || group > 31)
        throw OpenMMException("VariableStepRattleIntegrator: the force group of the monitor must lie between 0 and 31, "
                              "not " +
                              std::to_string(group));
    monitorForceGroup = group;
    settingsChanged();
}

double VariableStepRattleIntegrator::getNormOrder() const {
    return normOrder;
}

void VariableStepRattleIntegrator::setNormOrder(double order) {
    if (!(order >= 1) || !std::isfinite(order))
        throw OpenMMException("VariableStepRattleIntegrator: the order of a norm must be a finite number, at least 1");
    normOrder = order;
    settingsChanged();
}

double VariableStepRattleIntegrator::getReferenceMonitorValue(int index) const {
    const double given = getSetReferenceMonitorValue(index);
    if (context == NULL || given > 0)
        return given;
    OpenMM::Kernel& stateful = const_cast<OpenMM::Kernel&>(kernel);
    return stateful.getAs<IntegrateVRattleStepKernel>().getReferenceMonitorValue(*context, *this, index);
}

void VariableStepRattleIntegrator::setReferenceMonitorValue(double value, int index) {
    checkReferenceIndex(index);
    if (!(value >= 0) || !std::isfinite(value))
        throw OpenMMException(
            "VariableStepRattleIntegrator: the reference value of a monitor must be a positive finite "
            "number, or 0 to take it at the first step");
    (automatic ? automaticReferences[index] : monitors[index].reference) = value;
    settingsChanged();
}

double VariableStepRattleIntegrator::getSetReferenceMonitorValue(int index) const {
    checkReferenceIndex(index);
    return automatic ? automaticReferences[index] : monitors[index].reference;
}

void VariableStepRattleIntegrator::calibrate(int steps) {
    requireContext();
    if (steps < 1)
        throw OpenMMException("VariableStepRattleIntegrator: calibrate() needs at least one trial step");
    if (monitors.empty() && !automatic)
        throw OpenMMException("VariableStepRattleIntegrator: calibrate() needs a monitor; add one with addMonitor()");
    vector<double> means = kernel.getAs<IntegrateVRattleStepKernel>().calibrate(*context, *this, steps);
    for (size_t i = 0; i < means.size(); i++)
        (automatic ? automaticReferences[i] : monitors[i].reference) = means[i];
    settingsChanged();
}

double VariableStepRattleIntegrator::getStepDensity() const {
    return context == NULL ? 1.0 : kernel.getAs<IntegrateVRattleStepKernel>().getStepDensity();
}

double VariableStepRattleIntegrator::getMonitorValue(int index) const {
    requireContext();
    checkReferenceIndex(index);
    OpenMM::Kernel& stateful = const_cast<OpenMM::Kernel&>(kernel);
    return stateful.getAs<IntegrateVRattleStepKernel>().getMonitorValue(*context, *this, index);
}

vector<double> VariableStepRattleIntegrator::getMultipliers() const {
    requireContext();
    OpenMM::Kernel& stateful = const_cast<OpenMM::Kernel&>(kernel);
    return stateful.getAs<IntegrateVRattleStepKernel>().getMultipliers(*context, *this);
}

long long VariableStepRattleIntegrator::getNumForceEvaluations() const {
    return context == NULL ? 0 : kernel.getAs<IntegrateVRattleStepKernel>().getNumForceEvaluations();
}

long long VariableStepRattleIntegrator::getNumSolverIterations() const {
    return context == NULL ? 0 : kernel.getAs<IntegrateVRattleStepKernel>().getNumSolverIterations();
}

long long VariableStepRattleIntegrator::getNumRescues() const {
    return context == NULL ? 0 : kernel.getAs<IntegrateVRattleStepKernel>().getNumRescues();
}

void VariableStepRattleIntegrator::setConstraintTolerance(double tol) {
    requirePositive(tol, "constraint tolerance");
    Integrator::setConstraintTolerance(tol);
    settingsChanged();
}

// ------------------------------------------------------------------------------------------ constraints by expressions

VariableStepRattleIntegrator::ExpressionConstraint
VariableStepRattleIntegrator::checkConstraint(const string& expression, const vector<int>& particles,
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
    return {expression, particles, parameters};
}

int VariableStepRattleIntegrator::addConstraint(const string& expression, const vector<int>& particles,
                                                const std::map<string, double>& parameters) {
    expressionConstraints.push_back(checkConstraint(expression, particles, parameters));
    settingsChanged();
    return (int) expressionConstraints.size() - 1;
}

int VariableStepRattleIntegrator::getNumExpressionConstraints() const {
    return (int) expressionConstraints.size();
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
    expression = expressionConstraints[index].expression;
    particles = expressionConstraints[index].particles;
    parameters = expressionConstraints[index].parameters;
}

void VariableStepRattleIntegrator::setExpressionConstraintParameters(int index, const string& expression,
                                                                     const vector<int>& particles,
                                                                     const std::map<string, double>& parameters) {
    checkExpressionConstraintIndex(index);
    expressionConstraints[index] = checkConstraint(expression, particles, parameters);
    settingsChanged();
}

void VariableStepRattleIntegrator::setExpressionConstraintParameter(int index, const string& name, double value) {
    checkExpressionConstraintIndex(index);
    ExpressionConstraint changed = expressionConstraints[index];
    if (changed.parameters.count(name) == 0)
        throw OpenMMException("VariableStepRattleIntegrator: the constraint \"" + changed.expression +
                              "\" has no parameter " + name);
    changed.parameters[name] = value;
    setExpressionConstraintParameters(index, changed.expression, changed.particles, changed.parameters);
}

double VariableStepRattleIntegrator::getExpressionConstraintMultiplier(int index) const {
    requireContext();
    checkExpressionConstraintIndex(index);
    const int numDistances = context->getSystem().getNumConstraints();
    return getMultipliers().at(numDistances + index);
}

// What can be known of the constraints without positions.
void VariableStepRattleIntegrator::checkExpressionConstraints(const ContextImpl& contextRef) const {
    if (expressionConstraints.empty())
        return;
    const Platform& platform = const_cast<ContextImpl&>(contextRef).getPlatform();
    if (dynamic_cast<const OpenMM::ReferencePlatform*>(&platform) == NULL)
        throw OpenMMException("VariableStepRattleIntegrator: constraints given as expressions work on the platforms "
                              "Reference and CPU, and this Context is on " +
                              platform.getName() + "; create it on one of those");
    const OpenMM::System& system = contextRef.getSystem();
    for (int i = 0; i < getNumExpressionConstraints(); i++) {
        const string constraint = "VariableStepRattleIntegrator: expression constraint " + std::to_string(i) + " (" +
                                  expressionConstraints[i].expression + ") ";
        bool canMove = false;
        for (int particle : expressionConstraints[i].particles) {
            if (particle >= system.getNumParticles())
                throw OpenMMException(constraint + "is of particle " + std::to_string(particle) +
                                      ", and the System has " + std::to_string(system.getNumParticles()));
            if (system.isVirtualSite(particle))
                throw OpenMMException(constraint + "is of particle " + std::to_string(particle) +
                                      ", which is a virtual site; write it with the particles that define the site");
            canMove |= system.getParticleMass(particle) > 0;
        }
        if (!canMove)
            throw OpenMMException(constraint + "has no particle with mass, and so nothing that it could move");
    }
}

// The values of the parameters of another integrator's constraints, where these are the same constraints.
void VariableStepRattleIntegrator::copyExpressionParameters(const VariableStepRattleIntegrator& other) {
    const auto areAlike = [](const ExpressionConstraint& a, const ExpressionConstraint& b) {
        return a.expression == b.expression && a.particles == b.particles && haveSameNames(a.parameters, b.parameters);
    };
    if (std::equal(expressionConstraints.begin(), expressionConstraints.end(), other.expressionConstraints.begin(),
                   other.expressionConstraints.end(), areAlike))
        expressionConstraints = other.expressionConstraints;
}

// ----------------------------------------------------------------------------------------------------------- the run

void VariableStepRattleIntegrator::step(int steps) {
    requireContext();
    for (int i = 0; i < steps; i++)
        lastStepSize = advance(std::numeric_limits<double>::infinity());
}

void VariableStepRattleIntegrator::stepTo(double time) {
    requireContext();
    if (!std::isfinite(time))
        throw OpenMMException("VariableStepRattleIntegrator: stepTo() needs a finite time");
    while (time > context->getTime())
        lastStepSize = advance(time);
}

double VariableStepRattleIntegrator::advance(double maxTime) {
    reinitializationPhase = None;
    bool forcesInvalid = context->updateContextState();
    return kernel.getAs<IntegrateVRattleStepKernel>().execute(*context, *this, forcesInvalid, maxTime);
}

void VariableStepRattleIntegrator::reverse() {
    requireContext();
    kernel.getAs<IntegrateVRattleStepKernel>().reverse(*context, *this);
}

void VariableStepRattleIntegrator::initialize(ContextImpl& contextRef) {
    checkOpenMMVersion();
    if (owner != NULL && &contextRef.getOwner() != owner)
        throw OpenMMException("This Integrator is already bound to a context");
    refuseDrudeParticles(contextRef);
    checkExpressionConstraints(contextRef);
    OpenMM::Kernel created = contextRef.getPlatform().createKernel(IntegrateVRattleStepKernel::Name(), contextRef);
    created.getAs<IntegrateVRattleStepKernel>().initialize(contextRef.getSystem(), *this);
    context = &contextRef;
    owner = &contextRef.getOwner();
    kernel = created;
    lastStepSize = 0;
}

void VariableStepRattleIntegrator::cleanup() {
    kernel = OpenMM::Kernel();
    if (reinitializationPhase == CheckpointWritten)
        reinitializationPhase = CleanedUp;
}

vector<string> VariableStepRattleIntegrator::getKernelNames() {
    return {IntegrateVRattleStepKernel::Name()};
}

void VariableStepRattleIntegrator::stateChanged(State::DataType changed) {
    reinitializationPhase = None;
    // What is announced after loading a checkpoint has been read from it and is no change.
    if (numChangesAfterLoading < NUM_CHANGES_AFTER_LOADING &&
        changed == CHANGES_AFTER_LOADING[numChangesAfterLoading]) {
        numChangesAfterLoading++;
        return;
    }
    numChangesAfterLoading = NUM_CHANGES_AFTER_LOADING;
    kernel.getAs<IntegrateVRattleStepKernel>().stateChanged();
}

double VariableStepRattleIntegrator::computeKineticEnergy() {
    return kernel.getAs<IntegrateVRattleStepKernel>().computeKineticEnergy(*context);
}

bool VariableStepRattleIntegrator::kineticEnergyRequiresForce() const {
    return false;
}

// ---------------------------------------------------------------------------------------------- saving and restoring

VRattleRunState VariableStepRattleIntegrator::saveRun() const {
    OpenMM::Kernel& stateful = const_cast<OpenMM::Kernel&>(kernel);
    VRattleRunState run = stateful.getAs<IntegrateVRattleStepKernel>().saveRun(*context, *this);
    run.lastStepSize = lastStepSize;
    return run;
}

void VariableStepRattleIntegrator::copySettings(const VariableStepRattleIntegrator& other) {
    nominalStepSize = other.nominalStepSize;
    Integrator::setStepSize(nominalStepSize);
    minimumStepSize = other.minimumStepSize;
    maximumStepSize = other.maximumStepSize;
    updateMethod = other.updateMethod;
    monitors = other.monitors;
    monitorForceGroup = other.monitorForceGroup;
    normOrder = other.normOrder;
    automatic = other.automatic;
    calibrationSteps = other.calibrationSteps;
    std::copy(std::begin(other.automaticReferences), std::end(other.automaticReferences), automaticReferences);
    Integrator::setConstraintTolerance(other.getConstraintTolerance());
    setIntegrationForceGroups(other.getIntegrationForceGroups());
    settingsChanged();
}

void VariableStepRattleIntegrator::resumeRun(const VariableStepRattleIntegrator& saved, const VRattleRunState& run) {
    VariableStepRattleIntegrator previous(nominalStepSize);
    previous.copySettings(*this);
    const vector<ExpressionConstraint> previousConstraints = expressionConstraints;
    try {
        copyExpressionParameters(saved);
        copySettings(saved);
        kernel.getAs<IntegrateVRattleStepKernel>().resumeRun(*context, *this, run);
        lastStepSize = run.lastStepSize;
    }
    catch (...) {
        expressionConstraints = previousConstraints;
        copySettings(previous);
        throw;
    }
}

void VariableStepRattleIntegrator::createCheckpoint(std::ostream& stream) const {
    std::ostringstream settings, data;
    XmlSerializer::serialize(this, "Integrator", settings);
    const string text = settings.str();
    const long long length = (long long) text.size();
    data.write(reinterpret_cast<const char*>(&length), sizeof(length));
    data.write(text.data(), length);
    saveRun().write(data);
    CheckpointBlock::write(stream, data.str());
    reinitializationPhase = CheckpointWritten;
}

void VariableStepRattleIntegrator::loadCheckpoint(std::istream& stream) {
    const bool isReinitializing = reinitializationPhase == CleanedUp;
    reinitializationPhase = None;
    try {
        std::istringstream data(CheckpointBlock::read(stream));
        long long length = 0;
        data.read(reinterpret_cast<char*>(&length), sizeof(length));
        string text(length, ' ');
        data.read(&text[0], length);
        std::istringstream settings(text);
        std::unique_ptr<VariableStepRattleIntegrator> saved(
            XmlSerializer::deserialize<VariableStepRattleIntegrator>(settings));
        VRattleRunState run;
        run.read(data);
        // Whoever has changed the masses or constraints calls reinitialize(), and may keep the positions.
        const bool isSameSystem = run.system == kernel.getAs<IntegrateVRattleStepKernel>().getSystemFingerprint();
        if (!isSameSystem && !isReinitializing)
            throw OpenMMException(
                "VariableStepRattleIntegrator: this checkpoint was made with another System, whose "
                "masses or constraints are not those of this one; load it into a Context of that System");
        resumeRun(*saved, run);
        numChangesAfterLoading = 0;
    }
    catch (...) {
        // The positions of the Context are those of the checkpoint by now.
        kernel.getAs<IntegrateVRattleStepKernel>().stateChanged();
        throw;
    }
}

void VariableStepRattleIntegrator::serializeParameters(SerializationNode& node) const {
    node.setIntProperty("version", PARAMETERS_VERSION);
    node.setStringProperty("integrator", TYPE_NAME);
    node.createChildNode("Settings", this);
    saveRun().write(node.createChildNode("Run"));
}

void VariableStepRattleIntegrator::deserializeParameters(const SerializationNode& node) {
    if (node.getProperties().empty() && node.getChildren().empty())
        return; // of an integrator without parameters: there is nothing to go on from
    if (node.getStringProperty("integrator", "") != TYPE_NAME)
        throw OpenMMException("VariableStepRattleIntegrator: the State holds the parameters of another integrator; "
                              "make it without them, by getState(integratorParameters=False)");
    const int version = node.getIntProperty("version");
    if (version != PARAMETERS_VERSION)
        throw OpenMMException("VariableStepRattleIntegrator: the State holds parameters in version " +
                              std::to_string(version) + " of their format and this plugin reads version " +
                              std::to_string(PARAMETERS_VERSION) + "; use the version of the plugin that wrote them");
    std::unique_ptr<VariableStepRattleIntegrator> saved(
        node.getChildNode("Settings").decodeObject<VariableStepRattleIntegrator>());
    VRattleRunState run;
    run.read(node.getChildNode("Run"));
    resumeRun(*saved, run);
}

void VariableStepRattleIntegrator::settingsChanged() {
    if (context != NULL)
        kernel.getAs<IntegrateVRattleStepKernel>().settingsChanged();
}

void VariableStepRattleIntegrator::requireContext() const {
    if (context == NULL)
        throw OpenMMException("This Integrator is not bound to a context!");
}

void VariableStepRattleIntegrator::checkMonitorIndex(int index) const {
    if (index < 0 || index >= (int) monitors.size())
        throw OpenMMException("VariableStepRattleIntegrator: there is no monitor with index " + std::to_string(index) +
                              "; the integrator has " + std::to_string(monitors.size()));
}

// Of what has a value and a reference value: the monitors, or the two of automatic step control.
void VariableStepRattleIntegrator::checkReferenceIndex(int index) const {
    if (!automatic)
        checkMonitorIndex(index);
    else if (index < 0 || index >= NUM_AUTOMATIC_MONITORS)
        throw OpenMMException("VariableStepRattleIntegrator: there is no monitor with index " + std::to_string(index) +
                              "; automatic step control has two, 0 and 1");
}

void VariableStepRattleIntegrator::checkBounds(double nominal, double minimum, double maximum) const {
    if (minimum > 0 && minimum >= nominal) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the minimum step size (" << minimum
                << " ps) must be smaller than the nominal one (" << nominal << " ps)";
        throw OpenMMException(message.str());
    }
    if (maximum > 0 && maximum <= nominal) {
        std::stringstream message;
        message << "VariableStepRattleIntegrator: the maximum step size (" << maximum
                << " ps) must be larger than the nominal one (" << nominal << " ps)";
        throw OpenMMException(message.str());
    }
}
