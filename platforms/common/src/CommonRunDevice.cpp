// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonRunDevice.h"
#include "ComputeVectors.h"
#include "ExpressionInfo.h"
#include "constraints/StepFailure.h"
#include "openmm/common/ContextSelector.h"
#include "run/IntegratorSettings.h"
#include "run/LangevinRun.h"
#include "run/VRattleRun.h"
#include <algorithm>
#include <cmath>
#include <iostream>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::ContextSelector;
using std::vector;

namespace {

const double NO_LIMIT = std::numeric_limits<double>::infinity();
// OpenMM sorts the particles anew after so many steps, once somebody asks for it.
const int STEPS_BETWEEN_REORDERINGS = 250;
const int MANY_STEPS = 1 << 20;

// Counts how often forces and particles may have got into another order. Nothing else of ours depends on it: only identical molecules
// change places, and they have identical clusters.
class ReorderingNote : public OpenMM::ComputeContext::ReorderListener {
public:
    explicit ReorderingNote(int& count) : count(count) {
    }
    void execute() override {
        count++;
    }

private:
    int& count;
};

} // namespace

template <class Method>
CommonRunDevice<Method>::CommonRunDevice(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute,
                                         const OpenMM::Integrator& integrator, const IntegratorSettings& settings) :
        Host(std::make_unique<ComputeVectors>(context, integrator), context.getSystem(), settings), context(context),
        compute(compute), actions(context, compute), expressionInfo(nullptr), state(), lastReport(), isOnDevice(false),
        hasBegun(false), isOnHost(true), areSettingsOnDevice(false), hasReport(false), numAsked(0),
        stepsUntilLook(MANY_STEPS), lastMaxTime(NO_LIMIT), settledTime(0), settledCount(0), groupEnergy(0),
        hasForces(false), writeCount(0), numReorderings(0), orderReorderings(-1), reorderedStep(0),
        numDeviceRescues(0) {
    // Too late where the Context's other integrators have initialized it already: then molecules that differ in expressions alone may
    // change places on the device, and the host takes the steps.
    const bool areKnown = settings.expressions.empty() || !compute.getEnergyBuffer().isInitialized();
    if (!settings.expressions.empty() && areKnown) {
        knownExpressions = settings.expressions;
        expressionInfo = new ExpressionInfo(knownExpressions);
        compute.addForce(expressionInfo); // to which it belongs from now on
    }
    compute.initializeContexts();
    if (areKnown && DeviceSteps::canTake(settings.expressions))
        steps = std::make_unique<DeviceSteps>(compute, method.getConstraintSystem().getLayout(), settings.expressions);
    ContextSelector selector(compute);
    compute.addReorderListener(new ReorderingNote(numReorderings)); // which belongs to the Context
}

// ------------------------------------------------------------------------------------------------ from one to the other

template <class Method> int CommonRunDevice<Method>::getNumWrites() const {
    return static_cast<const ComputeVectors&>(*vectors).getNumWrites();
}

template <class Method> double CommonRunDevice<Method>::computeForces() {
    groupEnergy = Host::computeForces();
    hasForces = true;
    writeCount = getNumWrites();
    if (areAtomsReordered())
        order = compute.getAtomIndex();
    orderReorderings = numReorderings;
    return groupEnergy;
}

// OpenMM has the inverse masses beside the velocities, and Context::reinitialize() brings old ones back with these.
template <class Method> void CommonRunDevice<Method>::correctMasses() {
    ContextSelector selector(compute);
    auto correct = [&](auto& velocities) {
        compute.getVelm().download(velocities);
        bool areOthers = false;
        for (size_t i = 0; i < masses.size(); i++) {
            auto& inverse = velocities[i].w;
            const double mass = masses[compute.getAtomIndex()[i]], expected = mass == 0 ? 0.0 : 1 / mass;
            areOthers = areOthers || std::fabs(inverse - expected) > 1e-6 * expected;
            if (areOthers)
                inverse = expected;
        }
        if (areOthers)
            compute.getVelm().upload(velocities);
    };
    if (compute.getUseDoublePrecision() || compute.getUseMixedPrecision()) {
        vector<OpenMM::mm_double4> velocities;
        correct(velocities);
    }
    else {
        vector<OpenMM::mm_float4> velocities;
        correct(velocities);
    }
}

// Whether the forces are those of the present state. Others may have computed them again, with an energy. A barostat that rejects a
// move puts forces and the order of the atoms back.
template <class Method> bool CommonRunDevice<Method>::areForcesValid() {
    return hasForces && writeCount == getNumWrites() && context.getLastForceGroups() == forceGroups &&
           (!areAtomsReordered() || compute.getAtomIndex() == order);
}

template <class Method> void CommonRunDevice<Method>::ensureForces() {
    if (!areForcesValid())
        computeForces();
}

// Whether the next step is one in the middle of a run, all of whose numbers are known.
template <class Method> bool CommonRunDevice<Method>::canStepOnDevice() {
    return steps != nullptr && !reach.isUnknown && !ahead && canGoOnDevice();
}

// Where parameters of expressions are others now molecules may be so too, that were identical; then OpenMM puts all atoms into another
// order, for which nothing on the device is prepared between two steps.
template <class Method> void CommonRunDevice<Method>::tellOfParameters() {
    areParametersNew = true;
    if (steps == nullptr)
        return;
    ContextSelector selector(compute);
    expressionInfo->setParameters(expressions);
    if (compute.invalidateMolecules(expressionInfo, false, true) && isOnDevice)
        takeToHost();
}

// The state goes to the device, where positions, velocities and forces are.
template <class Method> void CommonRunDevice<Method>::beginOnDevice() {
    ensureForces();
    if (!areSettingsOnDevice)
        steps->setSettings(makeDeviceSettings());
    areSettingsOnDevice = true;
    const ExpressionParameters theta = method.getConstraintSystem().toGivenOrder(method.getParameters());
    hasBegun = steps->begin(state, groupEnergy, &theta);
    hasReport = false;
    areParametersNew = true;
}

template <class Method> ExpressionParameters CommonRunDevice<Method>::getDeviceParameters() {
    return expressions.empty() ? method.getParameters()
                               : method.getConstraintSystem().fromGivenOrder(steps->getParameters());
}

// The host gets the device's state as well.
template <class Method> void CommonRunDevice<Method>::bringToHost() {
    settle();
    if (isOnHost)
        return;
    ensureForces();
    adopt(vectors->getPositions(), vectors->getVelocities(), vectors->getForces(), groupEnergy, state);
    isOnHost = true;
}

// And goes on with it.
template <class Method> void CommonRunDevice<Method>::takeToHost() {
    bringToHost();
    isOnDevice = false;
}

// ----------------------------------------------------------------------------------------------------------- the steps

template <class Method> void CommonRunDevice<Method>::step(double maxTime) {
    if (maxTime < NO_LIMIT)
        settle();
    if (isOnDevice && !hasBegun && !expressions.empty())
        takeToHost(); // which knows how parameters move
    if (!isOnDevice && canStepOnDevice()) {
        state = makeDeviceState();
        isOnDevice = true;
        hasBegun = false;
    }
    if (isOnDevice && !hasBegun) {
        beginOnDevice();
        isOnDevice = hasBegun || !isOnHost;
        if (!hasBegun)
            takeToHost(); // which says what is wrong
    }
    if (isOnDevice)
        stepOnDevice(maxTime);
    else
        Host::step(maxTime);
    hasStepped = isOnDevice;
    stepMark = getStepMark();
}

template <class Method> void CommonRunDevice<Method>::stepOnDevice(double maxTime) {
    if (numAsked == 0) {
        settledTime = vectors->getTime();
        settledCount = vectors->getStepCount();
    }
    ensureForces();
    isOnHost = hasReport = isChangePending = false;
    lastMaxTime = maxTime;
    if (areParametersNew)
        steps->moveParameters(expressions);
    areParametersNew = false;
    steps->advance(maxTime - vectors->getTime());
    numAsked++;
    try {
        context.computeVirtualSites();
        vectors->setStepCount(settledCount + numAsked);
        reorderAtoms();
        computeForces();
    }
    catch (...) {
        accept(steps->putBack());
        context.computeVirtualSites();
        throw;
    }
    steps->finish(groupEnergy);
    if (numAsked >= std::min(stepsUntilLook, getMostStepsUntilLook()))
        settle();
}

// After the positions of a step. The state before it is kept in the order that there was.
template <class Method> void CommonRunDevice<Method>::reorderAtoms() {
    ContextSelector selector(compute);
    // Where no Force has a cutoff they stay in their order, and OpenMM counts on.
    const bool isDue = compute.getNonbondedUtilities().getUseCutoff() &&
                       (numAsked == 1 || compute.getStepsSinceReorder() >= STEPS_BETWEEN_REORDERINGS);
    if (isDue && numAsked > 1 && steps->hasFailed())
        return; // an earlier state is to be put back
    if (isDue)
        lastOffsets = compute.getPosCellOffsets();
    compute.reorderAtoms();
    if (areAtomsReordered()) {
        reorderedStep = numAsked;
        lastOrder = order;
    }
}

// Of the state that has been put back.
template <class Method> void CommonRunDevice<Method>::restoreOrder() {
    const Vectors positions = vectors->getPositions(); // of what does not move, in the new order
    compute.setAtomIndex(lastOrder);
    compute.setPosCellOffsets(lastOffsets);
    if (!hasMassless)
        return;
    auto write = [&](Vectors& all) {
        for (size_t i = 0; i < masses.size(); i++)
            if (masses[i] == 0)
                all[i] = positions[i];
    };
    vectors->writePositions(write, false);
}

// Take note of what has become of the steps that were asked for.
template <class Method> void CommonRunDevice<Method>::accept(const DeviceSteps::Report& report) {
    const bool areAllComplete = report.numSteps == numAsked;
    if (report.numSteps + 1 == reorderedStep)
        restoreOrder();
    reorderedStep = 0;
    state = report.state;
    if (report.numSteps > 0)
        lastStep = {report.stepSize, report.state.density};
    numDeviceRescues += report.numRescues;
    vectors->setTime(report.isShortened && areAllComplete ? lastMaxTime : settledTime + report.elapsed);
    vectors->setStepCount(settledCount + report.numSteps);
    numAsked = 0;
    lastReport = report;
    hasReport = areAllComplete;
    hasBegun = areAllComplete;
    if (!areAllComplete)
        hasForces = false;
    stepMark = getStepMark();
}

template <class Method> void CommonRunDevice<Method>::settle() {
    while (numAsked > 0) {
        const int asked = numAsked;
        const DeviceSteps::Report report = steps->read();
        const bool hasChangeFailed = report.hasFailed && report.numSteps == asked; // after the last step
        isChangePending = false;
        accept(report);
        if (hasChangeFailed)
            hasBegun = hasReport = false;
        // What follows a step that has failed is done in vain, so where steps fail often the device is looked at often.
        stepsUntilLook = report.hasFailed ? 1 : std::min(2 * stepsUntilLook, MANY_STEPS);
        if (!report.hasFailed || hasChangeFailed)
            break;
        // The step that failed is left to the host, which has other means, and says what is wrong if they fail too; unless the device can
        // do more from now on.
        context.computeVirtualSites();
        if (report.isForNewton && steps->prepareNewton())
            step(lastMaxTime);
        else {
            takeToHost();
            Host::step(lastMaxTime);
            hasStepped = false;
        }
        for (int i = report.numSteps + 1; i < asked; i++) {
            repeatActions();
            step(NO_LIMIT);
        }
    }
    if (isChangePending)
        resolveChange();
}

// What Forces have done before a step that has not happened.
template <class Method> void CommonRunDevice<Method>::repeatActions() {
    if (!reach.hasThermostat && !reach.movesFrame)
        return;
    actions.repeat();
    haveActed = true;
    if (findChange() == RunDevice::Change::Velocities)
        changeVelocities();
}

// ------------------------------------------------------------------------------------------------------ what has changed

template <class Method> void CommonRunDevice<Method>::setSettings(const IntegratorSettings& from) {
    if (isOnDevice)
        takeToHost();
    IntegratorSettings possible = from;
    possible.tolerance = DeviceSteps::tolerableTolerance(compute, from.tolerance);
    static bool hasWarned = false;
    if (possible.tolerance > from.tolerance && !hasWarned) {
        hasWarned = true;
        std::cerr << from.getIntegratorName() << ": the constraint tolerance " << from.tolerance
                  << " is below what the precision of this Context allows; " << possible.tolerance << " is used"
                  << std::endl;
    }
    Host::setSettings(possible);
    areSettingsOnDevice = false;
}

// The steps go on where they were.
template <class Method> bool CommonRunDevice<Method>::setParameters(const vector<ExpressionConstraint>& given) {
    settle();
    const bool areOthers = Host::setParameters(given);
    if (areOthers)
        tellOfParameters();
    return areOthers;
}

template <class Method> void CommonRunDevice<Method>::setFindings(const Findings& findings) {
    if (isOnDevice)
        takeToHost();
    Host::setFindings(findings);
    areSettingsOnDevice = false;
}

template <class Method> bool CommonRunDevice<Method>::updateState() {
    // What changes positions must not find those of a step that has failed. Another integrator may have let barostats act.
    if (reach.hasBarostat && (vectors->isSharedByIntegrators() || actions.isTrialNext()))
        settle();
    if (reach.hasThermostat && isOnDevice)
        steps->keepVelocities();
    haveActed = true;
    const long long mark = getStepMark();
    try {
        const bool areForcesInvalid = actions.update(isOnDevice && hasBegun ? &steps->getControl() : nullptr);
        stepMark += getStepMark() - mark; // a barostat that puts the order of the atoms back is no integrator
        return areForcesInvalid;
    }
    catch (...) {
        settle();
        throw;
    }
}

template <class Method> RunDevice::Change CommonRunDevice<Method>::findChange() {
    if (!isOnDevice || reach.isUnknown)
        return Host::findChange();
    const bool mayBeOthers = haveActed;
    haveActed = false;
    if (Host::isOtherBox())
        return RunDevice::Change::Box;
    if (haveOthersStepped())
        return RunDevice::Change::State;
    // A uniform motion is of no concern to constraints and their forces.
    const bool isOtherFrame = reach.movesFrame && doesFrameMatter();
    return mayBeOthers && (reach.hasThermostat || isOtherFrame) ? RunDevice::Change::Velocities
                                                                : RunDevice::Change::None;
}

// The Context keeps fewer digits than the host, and OpenMM loses some more when it wraps molecules into the box, in single precision.
template <class Method> double CommonRunDevice<Method>::getPositionRounding() const {
    return compute.getUseDoublePrecision() ? 1e-12 : compute.getUseMixedPrecision() ? 1e-6 : 1e-5;
}

// Each integrator has OpenMM reorder the atoms in each of its steps, or count that step among those since they were; the step count of the
// Context is the user's to set.
template <class Method> long long CommonRunDevice<Method>::getStepMark() {
    return ((long long) numReorderings << 32) + compute.getStepsSinceReorder();
}

template <class Method> unsigned long long CommonRunDevice<Method>::getFingerprint() {
    settle();
    return Host::getFingerprint();
}

template <class Method> void CommonRunDevice<Method>::start() {
    settle();
    const bool wasOnDevice = isOnDevice, wasOnHost = isOnHost;
    if (!isOnHost)
        carryOn(state);
    isOnDevice = false;
    isOnHost = true;
    hasForces = false;
    correctMasses();
    try {
        Host::start();
    }
    catch (...) {
        isOnDevice = wasOnDevice;
        isOnHost = wasOnHost;
        throw;
    }
}

template <class Method> void CommonRunDevice<Method>::changeState() {
    settle();
    if (!isOnDevice || !hasBegun) {
        takeToHost();
        hasForces = false;
        Host::changeState();
        return;
    }
    if (!expressions.empty() && haveOthersStepped()) {
        takeTurn();
        return;
    }
    computeForces();
    changeOnDevice(Control::AllChanged);
    settle();
}

// Others know nothing of expressions, and may have left particles far from where these hold. The device finds the density, for it alone
// has u before the change; then the state is the host's, for the Context keeps what others have left until a step is complete.
template <class Method> void CommonRunDevice<Method>::takeTurn() {
    const typename Host::Ahead left = {vectors->getPositions(), vectors->getVelocities()};
    auto putBack = [&] {
        vectors->setPositions(left.positions);
        vectors->writeVelocities([&](Vectors& to) { to = left.velocities; }, true);
        vectors->invalidateForces();
    };
    auto take = [&] {
        method.adoptParameters();
        const ExpressionParameters theta = method.getParameters();
        Vectors positions = left.positions;
        if (method.projectPositions(positions, theta))
            Host::moveContext(positions);
        steps->setParameters(method.getConstraintSystem().toGivenOrder(theta));
        computeForces();
        changeOnDevice(Control::AllChanged);
        takeToHost();
    };
    isOnHost = false;
    attempt(take, putBack);
    putBack();
    ahead = left;
}

template <class Method> void CommonRunDevice<Method>::changeForces() {
    settle();
    if (!isOnDevice || !hasBegun) {
        try {
            takeToHost();
        }
        catch (const StepFailure&) { // the forces before were no numbers: there is nothing to compare with
            hasForces = false;
            takeToHost();
            return;
        }
        hasForces = false;
        Host::changeForces();
        return;
    }
    computeForces();
    changeOnDevice(Control::ForcesChanged);
    settle();
    if (!hasBegun)
        takeToHost(); // which says what is wrong
}

// Does not wait for the device where the next step is taken there.
template <class Method> void CommonRunDevice<Method>::changeVelocities() {
    if (!isOnDevice || !hasBegun) {
        takeToHost();
        Host::changeVelocities();
        return;
    }
    ensureForces();
    changeOnDevice(Control::VelocitiesChanged);
}

template <class Method> void CommonRunDevice<Method>::changeOnDevice(Control::Change change) {
    steps->change(groupEnergy, change);
    stepMark = getStepMark();
    isChangePending = true;
    isOnHost = hasReport = false;
}

// Of a change that no step has followed; where it has failed, the host will say why.
template <class Method> void CommonRunDevice<Method>::resolveChange() {
    isChangePending = false;
    const DeviceSteps::Report report = steps->read();
    hasBegun = hasReport = !report.hasFailed;
    if (!hasBegun)
        return;
    lastReport = report;
    state = lastReport.state;
}

template <class Method> void CommonRunDevice<Method>::writeVelocities() {
    settle();
    if (!isOnDevice)
        Host::writeVelocities();
}

template <class Method> void CommonRunDevice<Method>::reverse() {
    takeToHost();
    Host::reverse();
}

template <class Method>
void CommonRunDevice<Method>::tryOut(double stepSize, int count,
                                     const std::function<void(const vector<double>&)>& look) {
    takeToHost();
    Host::tryOut(stepSize, count, look);
}

// ------------------------------------------------------------------------------------------------------------- numbers

template <class Method> RunDevice::LastStep CommonRunDevice<Method>::getLastStep() {
    settle();
    return lastStep;
}

template <class Method> double CommonRunDevice<Method>::getTime() {
    settle();
    return Host::getTime();
}

template <class Method> vector<double> CommonRunDevice<Method>::getMonitorValues() {
    settle();
    if (!isOnDevice || !hasBegun) {
        bringToHost();
        return Host::getMonitorValues();
    }
    if (!hasReport)
        lastReport = steps->read();
    hasReport = true;
    return lastReport.values;
}

// Whether the GPU alone has the numbers of the state, all of them.
template <class Method> bool CommonRunDevice<Method>::areNumbersOnDevice() {
    settle();
    return isOnDevice && hasBegun && !isOnHost;
}

template <class Method> vector<double> CommonRunDevice<Method>::getMultipliers() {
    if (areNumbersOnDevice())
        return steps->getMultipliers();
    bringToHost();
    return Host::getMultipliers();
}

// Which a run that pulls asks for in each step.
template <class Method> double CommonRunDevice<Method>::getExpressionMultiplier(int index) {
    return areNumbersOnDevice() ? steps->getExpressionMultipliers()[index] : Host::getExpressionMultiplier(index);
}

template <class Method> double CommonRunDevice<Method>::computeKineticEnergy() {
    settle();
    ContextSelector selector(compute);
    return compute.getIntegrationUtilities().computeKineticEnergy(0);
}

// Which reporters ask for.
template <class Method> double CommonRunDevice<Method>::computeHalfStepKineticEnergy() {
    if (areNumbersOnDevice()) {
        ensureForces();
        return steps->computeHalfStepKineticEnergy();
    }
    bringToHost();
    return Host::computeHalfStepKineticEnergy();
}

template <class Method> long long CommonRunDevice<Method>::getNumSolverIterations() {
    settle();
    return Host::getNumSolverIterations() + (steps == nullptr ? 0 : steps->getNumIterations());
}

// Which Python asks for after each call of step(), to warn.
template <class Method> StepCounts CommonRunDevice<Method>::getCounts() {
    settle();
    StepCounts counts = Host::getCounts();
    counts.rescues += numDeviceRescues;
    return counts;
}

template <class Method> const DeviceSteps::State* CommonRunDevice<Method>::findDeviceState() {
    settle();
    return isOnHost ? nullptr : &state;
}

// What others have made of the Context since the last step is taken note of first: it is all there is to save, and the density belongs
// to the state before.
template <class Method> void CommonRunDevice<Method>::save(RunState& run) {
    settle();
    if (isOnDevice && !isOnHost && haveOthersStepped())
        changeState();
    bringToHost();
    Host::save(run);
}

template <class Method>
bool CommonRunDevice<Method>::resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) {
    settle();
    hasForces = false;
    correctMasses();
    if (!Host::resume(run, saved, areForcesOthers))
        return false;
    isOnDevice = false;
    isOnHost = true;
    return true;
}

template class OpenMMVRattle::CommonRunDevice<VRattleRun>;
template class OpenMMVRattle::CommonRunDevice<LangevinRun>;
