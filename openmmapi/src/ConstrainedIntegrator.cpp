// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/ConstrainedIntegrator.h"
#include "ExpressionCheck.h"
#include "MaxwellVelocities.h"
#include "SystemCheck.h"
#include "constraints/StepFailure.h"
#include "openmm/CompoundIntegrator.h"
#include "openmm/OpenMMException.h"
#include "openmm/Platform.h"
#include "openmm/internal/ContextImpl.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmm/serialization/XmlSerializer.h"
#include "openmmvrattle/VRattleKernels.h"
#include "run/CheckpointBlock.h"
#include "run/Fingerprint.h"
#include "run/IntegratorRun.h"
#include <algorithm>
#include <cmath>
#include <functional>
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

// Of the parameters that States hold, among them the saved run (see CheckpointBlock); the settings have a version of their own.
const int PARAMETERS_VERSION = 3;
// Its square, by which multipliers act on positions, must not vanish.
const double SMALLEST_STEP_SIZE = 1e-100;

string majorMinor(const string& version) {
    size_t first = version.find('.');
    if (first == string::npos)
        return version;
    size_t second = version.find_first_not_of("0123456789", first + 1);
    return version.substr(0, second);
}

// An OpenMM plugin depends on the binary interface of the OpenMM it was built against.
void requireOpenMMVersion(const IntegratorSettings& settings) {
    const string built = OPENMMVRATTLE_OPENMM_VERSION;
    const string running = Platform::getOpenMMVersion();
    settings.require(majorMinor(running) == built, "this plugin was built for OpenMM ", built,
                     " and cannot run with OpenMM ", running, "; install openmm==", built, ".* or rebuild the plugin");
}

// Which one of a CompoundIntegrator it is; 0 where it is alone.
int findPlace(const OpenMM::Integrator& integrator, OpenMM::Integrator& all) {
    auto* compound = dynamic_cast<OpenMM::CompoundIntegrator*>(&all);
    for (int i = 0; compound != nullptr && i < compound->getNumIntegrators(); i++)
        if (&compound->getIntegrator(i) == &integrator)
            return i;
    return 0;
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

ConstrainedIntegrator::ConstrainedIntegrator(const IntegratorSettings& given) :
        settings(std::make_unique<IntegratorSettings>(given)), lastSaved(0) {
    takeStepSize(given.stepSize);
    Integrator::setConstraintTolerance(given.tolerance);
    Integrator::setIntegrationForceGroups(given.forceGroups);
}

ConstrainedIntegrator::~ConstrainedIntegrator() = default;

// -------------------------------------------------------------------------------------------------------- the settings

string ConstrainedIntegrator::getName() const {
    return settings->getIntegratorName();
}

void ConstrainedIntegrator::requirePositive(double value, const string& name) const {
    settings->require(value > 0 && std::isfinite(value), "the ", name, " must be a positive finite number, not ",
                      value);
}

// What 0 stands for belongs to the message.
void ConstrainedIntegrator::requirePositiveOrZero(double value, const string& name, const string& zero) const {
    settings->require(value >= 0 && std::isfinite(value), "the ", name, " must be a positive finite number, or 0 ",
                      zero, ", not ", value);
}

void ConstrainedIntegrator::requireIndex(int index, int count, const string& what) const {
    settings->require(index >= 0 && index < count, "there is no ", what, " with index ", index, "; the integrator has ",
                      count);
}

void ConstrainedIntegrator::settingsChanged() {
    if (run != nullptr)
        run->settingsChanged();
}

// Replace all settings, those that the base class keeps as well.
void ConstrainedIntegrator::takeOver(const IntegratorSettings& newSettings) {
    *settings = newSettings;
    Integrator::setStepSize(settings->stepSize);
    Integrator::setConstraintTolerance(settings->tolerance);
    Integrator::setIntegrationForceGroups(settings->forceGroups);
    settingsChanged();
}

void ConstrainedIntegrator::takeStepSize(double size) {
    requirePositiveOrZero(size, "step size", "where no step is to be taken");
    settings->require(size == 0 || size >= SMALLEST_STEP_SIZE, "a step size of ", size,
                      " ps is too small to compute with; set one of ", SMALLEST_STEP_SIZE, " ps or more");
    settings->stepSize = size;
    Integrator::setStepSize(size);
    if (run != nullptr)
        run->nominalStepChanged();
}

void ConstrainedIntegrator::setConstraintTolerance(double tol) {
    requirePositive(tol, "constraint tolerance");
    Integrator::setConstraintTolerance(tol);
    settings->tolerance = tol;
    settingsChanged();
}

int ConstrainedIntegrator::getIntegrationForceGroups() const {
    return settings->getActingForceGroups();
}

void ConstrainedIntegrator::setIntegrationForceGroups(int groups) {
    Integrator::setIntegrationForceGroups(groups);
    settings->forceGroups = groups;
    settingsChanged();
}

// -------------------------------------------------------------------------------------------------- numbers of the run

vector<double> ConstrainedIntegrator::getMultipliers() const {
    return requireRun().getMultipliers();
}

long long ConstrainedIntegrator::getNumForceEvaluations() const {
    return run == nullptr ? 0 : run->getDevice().getNumForceEvaluations();
}

bool ConstrainedIntegrator::isOnDevice() const {
    return run != nullptr && run->getDevice().hasSteppedOnDevice();
}

long long ConstrainedIntegrator::getNumSolverIterations() const {
    return run == nullptr ? 0 : run->getDevice().getNumSolverIterations();
}

// ------------------------------------------------------------------------------------------ constraints by expressions

void ConstrainedIntegrator::requireFiniteParameter(const string& expression, const string& name, double value) const {
    settings->require(std::isfinite(value), "the constraint \"", expression, "\" has the parameter ", name,
                      ", whose value is not a finite number");
}

void ConstrainedIntegrator::checkConstraint(const string& expression, const vector<int>& particles,
                                            const std::map<string, double>& parameters) {
    vector<string> names;
    for (const auto& parameter : parameters) {
        names.push_back(parameter.first);
        requireFiniteParameter(expression, parameter.first, parameter.second);
    }
    vector<int> sorted = particles;
    std::sort(sorted.begin(), sorted.end());
    if (!sorted.empty() && sorted[0] < 0)
        settings->refuse("the constraint \"", expression, "\" is of particle ", sorted[0],
                         ", and the index of a particle cannot be negative");
    const auto twice = std::adjacent_find(sorted.begin(), sorted.end());
    if (twice != sorted.end())
        settings->refuse("the constraint \"", expression, "\" names particle ", *twice,
                         " twice; name each particle once");
    const auto key = std::make_tuple(expression, particles.size(), names);
    if (checkedExpressions.count(key) == 0) {
        requireValidExpression(expression, (int) particles.size(), parameters, *settings);
        checkedExpressions.insert(key);
    }
}

int ConstrainedIntegrator::addConstraint(const string& expression, const vector<int>& particles,
                                         const std::map<string, double>& parameters) {
    checkConstraint(expression, particles, parameters);
    settings->expressions.push_back({expression, particles, parameters});
    settingsChanged();
    return (int) settings->expressions.size() - 1;
}

int ConstrainedIntegrator::getNumExpressionConstraints() const {
    return (int) settings->expressions.size();
}

void ConstrainedIntegrator::checkExpressionConstraintIndex(int index) const {
    requireIndex(index, getNumExpressionConstraints(), "expression constraint");
}

void ConstrainedIntegrator::getExpressionConstraintParameters(int index, string& expression, vector<int>& particles,
                                                              std::map<string, double>& parameters) const {
    checkExpressionConstraintIndex(index);
    expression = settings->expressions[index].expression;
    particles = settings->expressions[index].particles;
    parameters = settings->expressions[index].parameters;
}

void ConstrainedIntegrator::setExpressionConstraintParameters(int index, const string& expression,
                                                              const vector<int>& particles,
                                                              const std::map<string, double>& parameters) {
    checkExpressionConstraintIndex(index);
    checkConstraint(expression, particles, parameters);
    ExpressionConstraint changed = {expression, particles, parameters};
    std::swap(settings->expressions[index], changed);
    if (!haveSameParts(settings->expressions[index], changed))
        settingsChanged();
    else if (run != nullptr)
        run->parametersChanged();
}

void ConstrainedIntegrator::setExpressionParameterValue(int index, const string& name, double value) {
    checkExpressionConstraintIndex(index);
    ExpressionConstraint& constraint = settings->expressions[index];
    const auto parameter = constraint.parameters.find(name);
    settings->require(parameter != constraint.parameters.end(), "the constraint \"", constraint.expression,
                      "\" has no parameter ", name);
    requireFiniteParameter(constraint.expression, name, value);
    parameter->second = value;
    if (run != nullptr)
        run->parametersChanged();
}

double ConstrainedIntegrator::getExpressionConstraintMultiplier(int index) const {
    IntegratorRun& inContext = requireRun();
    checkExpressionConstraintIndex(index);
    return inContext.getExpressionMultiplier(index);
}

// ----------------------------------------------------------------------------------------------------------- the run

IntegratorRun& ConstrainedIntegrator::requireRun() const {
    if (run == nullptr)
        throw OpenMMException("This Integrator is not bound to a context!");
    return *run;
}

vector<IntegratorRun*> ConstrainedIntegrator::getOtherRuns() const {
    vector<IntegratorRun*> runs;
    auto* all = dynamic_cast<OpenMM::CompoundIntegrator*>(&context->getIntegrator());
    for (int i = 0; all != nullptr && i < all->getNumIntegrators(); i++) {
        auto* other = dynamic_cast<ConstrainedIntegrator*>(&all->getIntegrator(i));
        if (other != nullptr && other != this && other->run != nullptr)
            runs.push_back(other->run.get());
    }
    return runs;
}

// Others that have loaded a saved run know it by the particles' places, which are about to change.
IntegratorRun& ConstrainedIntegrator::requireRunForStep() {
    IntegratorRun& own = requireRun();
    for (IntegratorRun* other : getOtherRuns())
        other->takeSaved();
    return own;
}

void ConstrainedIntegrator::step(int steps) {
    requireRunForStep().step(steps);
}

void ConstrainedIntegrator::setVelocitiesToTemperature(double temperature, int randomSeed) {
    IntegratorRun& inContext = requireRun();
    settings->require(temperature >= 0 && std::isfinite(temperature),
                      "the temperature must be a finite number of kelvins that is not negative, not ", temperature);
    vector<OpenMM::Vec3> before;
    context->getVelocities(before);
    vector<std::function<void()>> takeBack;
    for (IntegratorRun* other : getOtherRuns())
        takeBack.push_back(other->keepTask());
    inContext.replaceVelocities(
        [&] { context->setVelocities(drawMaxwellVelocities(context->getSystem(), temperature, randomSeed)); },
        [&] {
            context->setVelocities(before);
            for (const auto& each : takeBack)
                each();
        });
}

void ConstrainedIntegrator::initialize(ContextImpl& contextRef) {
    requireOpenMMVersion(*settings);
    if (owner != NULL && &contextRef.getOwner() != owner)
        throw OpenMMException("This Integrator is already bound to a context");
    requireSuitableSystem(contextRef, *settings);
    const OpenMM::System& system = contextRef.getSystem();
    settings->fitDefaultMonitor(hasConstraints(system, *settings));
    if (settings->langevin)
        settings->langevin->randomStream = findPlace(*this, contextRef.getIntegrator());
    OpenMM::Kernel created = contextRef.getPlatform().createKernel(IntegrateVRattleStepKernel::Name(), contextRef);
    RunDevice& device = created.getAs<IntegrateVRattleStepKernel>().initialize(contextRef, *this, *settings);
    run = std::make_unique<IntegratorRun>(device, *settings, system.getNumParticles(),
                                          fingerprintOf(system, settings->expressions));
    kernel = created;
    context = &contextRef;
    owner = &contextRef.getOwner();
}

void ConstrainedIntegrator::cleanup() {
    run.reset();
    kernel = OpenMM::Kernel();
}

vector<string> ConstrainedIntegrator::getKernelNames() {
    return {IntegrateVRattleStepKernel::Name()};
}

void ConstrainedIntegrator::stateChanged(State::DataType changed) {
    if (run == nullptr) // where Context::reinitialize() has failed
        return;
    // OpenMM announces Context::setParameter() as Parameters, and a Force's updateParametersInContext() as Energy.
    if (changed == State::Parameters || changed == State::Energy)
        run->forcesChanged();
    else
        run->stateChanged();
}

double ConstrainedIntegrator::computeKineticEnergy() {
    IntegratorRun& here = requireRun();
    const long long evaluations = here.getDevice().getNumForceEvaluations();
    const int groups = context->getLastForceGroups();
    const double energy = here.computeKineticEnergy();
    // Whoever asks for it, as Context::getState() does, goes on to read the forces that it has had computed before.
    if (here.getDevice().getNumForceEvaluations() != evaluations)
        context->calcForcesAndEnergy(true, true, groups);
    return energy;
}

// Nothing of ours does; but on GPUs energies without forces would leave none for the next step.
bool ConstrainedIntegrator::kineticEnergyRequiresForce() const {
    return run != nullptr && run->getDevice().usesForcesOfOthers();
}

// ---------------------------------------------------------------------------------------------- saving and restoring

void ConstrainedIntegrator::resume(const IntegratorSettings& saved, RunState& state) {
    const IntegratorSettings previous = *settings;
    IntegratorSettings next = saved;
    next.automaticRequest = previous.automaticRequest;
    if (next.langevin)
        next.langevin->randomStream = previous.langevin->randomStream;
    if (!next.hasSameConstraints(previous)) // the constraints are those of the Context, their parameters the saved ones
        next.expressions = previous.expressions;
    next.fitDefaultMonitor(hasConstraints(context->getSystem(), next));
    if (next.isDefaultMonitor && next.terms[0].kind != saved.terms[0].kind)
        state.findings.references.clear();
    run->requireUsable(state, next);
    takeOver(next);
    attempt([&] { run->resume(state); }, [&] { takeOver(previous); });
}

void ConstrainedIntegrator::createCheckpoint(std::ostream& stream) const {
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

void ConstrainedIntegrator::loadCheckpoint(std::istream& stream) {
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
    std::unique_ptr<ConstrainedIntegrator> saved(XmlSerializer::deserialize<ConstrainedIntegrator>(xml));
    if (saved->getName() != getName())
        return;
    RunState state;
    state.read(data);
    // Whoever has changed the masses or constraints calls Context::reinitialize(), which loads what was saved just before.
    settings->require(state.system == run->getSystemFingerprint() || state.context == lastSaved,
                      "this checkpoint was made with another System, whose masses or constraints are not those of this "
                      "one; load it into a Context of that System");
    resume(*saved->settings, state);
}

void ConstrainedIntegrator::serializeParameters(SerializationNode& node) const {
    node.setIntProperty("version", PARAMETERS_VERSION);
    node.setStringProperty("integrator", getName());
    node.createChildNode("Settings", this);
    requireRun().save().write(node.createChildNode("Run"));
}

void ConstrainedIntegrator::deserializeParameters(const SerializationNode& node) {
    if (node.getStringProperty("integrator", "") != getName())
        return; // they are another integrator's, or there are none
    const int version = node.getIntProperty("version");
    settings->require(version == PARAMETERS_VERSION, "the State holds parameters in version ", version,
                      " of their format and this plugin reads version ", PARAMETERS_VERSION,
                      "; use the version of the plugin that wrote them");
    std::unique_ptr<ConstrainedIntegrator> saved(node.getChildNode("Settings").decodeObject<ConstrainedIntegrator>());
    RunState state;
    state.read(node.getChildNode("Run"));
    // States are copied about: several Contexts go on from one, and one Context goes on from one after the other (replica exchange).
    // So each keeps its seed, and no random number is drawn twice.
    saved->settings->setRandomSeed(settings->getRandomSeed());
    const vector<double> own = run->getRandomState();
    vector<double>& random = state.findings.random;
    if (!own.empty() && own.size() == random.size())
        random = {own[0], std::max(own[1], random[1])};
    resume(*saved->settings, state);
}
