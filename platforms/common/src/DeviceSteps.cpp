// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "DeviceSteps.h"
#include "openmm/common/ContextSelector.h"
#include <algorithm>
#include <cmath>
#include <numeric>

using namespace OpenMMVRattle;
using OpenMM::ComputeKernel;
using std::vector;

namespace {

// Of a density for (3.14). Those that are not needed cost a launch that returns at once; where they do not suffice the host takes the
// step. So there is one more than were needed of late.
const int FEWEST_TRIALS = 3, MOST_TRIALS = 6;
// Stands for no limit of a step, in single precision too (ps).
const double NO_LIMIT = 1e30;
// A step that is none: the state was changed by others.
const int NO_STEP = -1;
// For how many steps ago one has failed; a change of the state after the last step has -1.
const int NO_FAILURE = -2;
// What rounding allows: of the constraints and of (3.14).
const double SINGLE_TOLERANCE = 1e-5, MIXED_TOLERANCE = 1e-12, DOUBLE_TOLERANCE = 1e-13;
const double SINGLE_DENSITY_TOLERANCE = 3e-6, DENSITY_TOLERANCE = 1e-12;
const double SINGLE_DENSITY_ROUNDING = 1e-4, DENSITY_ROUNDING = 1e-8;
const double MARGIN = 0.1;
// In each launch the stages of large clusters have stamps of their own.
const int STAMPS = 64;
static_assert(StepProgram::getMaxStages(StepProgram::Langevin, false) < STAMPS,
              "stages of two launches would have the same stamp");
// A factor in single precision leaves about 1e-7 of what a projection changes in velocities, 1e-10 nm in a step: where more than that
// is asked for they are projected twice.
const double SINGLE_PROJECTION = 2e-9;

// Of all expressions and their derivatives: compilers take their time.
const size_t MOST_OPERATIONS = 20000;

// Local memory of a work group, of which every device of OpenCL has 32 kB, every GPU of NVIDIA 48.
LargeClusters::Limits findLimits(OpenMM::ComputeContext& context) {
    const bool isCUDA = context.getContextImpl()->getPlatform().getName() == "CUDA";
    LargeClusters::Limits limits;
    limits.numThreads = context.getIsCPU() ? 1 : StepProgram::getGroupSize(true);
    limits.localMemory = (isCUDA ? 48 : 32) * 1024 - 8 * 1024; // the rest is for sums
    // OpenMM counts six groups for each processor, and one has room in any case.
    limits.numResident = isCUDA ? context.getNumThreadBlocks() / 6 : 0;
    limits.narrow = isCUDA ? 32 : 0;
    limits.numGroups = context.getNumThreadBlocks();
    limits.mixedSize = context.getUseMixedPrecision() || context.getUseDoublePrecision() ? 8 : 4;
    limits.realSize = context.getUseDoublePrecision() ? 8 : 4;
    limits.pieceSize = 64;
    return limits;
}

// Outside mixed precision there are no corrections, and nothing reads the argument.
OpenMM::ArrayInterface& correctionsOf(OpenMM::ComputeContext& context) {
    return context.getUseMixedPrecision() ? context.getPosqCorrection() : context.getPosq();
}

// For arguments that change from launch to launch.
void addEmpty(ComputeKernel& kernel, int count) {
    for (int i = 0; i < count; i++)
        kernel->addArg();
}

} // namespace

DeviceSteps::DeviceSteps(OpenMM::ComputeContext& context, const ClusterLayout& layout,
                         const vector<ExpressionConstraint>& someExpressions) :
        context(context),
        expressions(someExpressions.empty() ? nullptr
                                            : std::make_unique<ExpressionSteps>(context, layout, someExpressions)),
        layout(layout), large(layout, findLimits(context)), settings(),
        isMixed(context.getUseMixedPrecision() || context.getUseDoublePrecision()),
        isWide(context.getSupportsDoublePrecision()),
        groupSize(StepProgram::getGroupSize(!large.isEmpty() || expressions)), numGroups(0), numPartials(0),
        numFused(0), numLargeLaunches(0), numLaunches(0), half(0), stepNumber(0), numTrials(MOST_TRIALS), seed(0),
        numDrawn(0), groupEnergy(0), elapsedRead(0), numStepsRead(0), numRescuesRead(0), stepSizeRead(0),
        areVelocitiesKept(false) {
}

bool DeviceSteps::canTake(const vector<ExpressionConstraint>& expressions) {
    return ExpressionClusters::findSize(expressions) <= MOST_OPERATIONS;
}

double DeviceSteps::tolerableTolerance(const OpenMM::ComputeContext& context, double tolerance) {
    const double least = context.getUseDoublePrecision()  ? DOUBLE_TOLERANCE
                         : context.getUseMixedPrecision() ? MIXED_TOLERANCE
                                                          : SINGLE_TOLERANCE;
    return std::max(tolerance, least);
}

void DeviceSteps::initialize() {
    const int mixedSize = isMixed ? 8 : 4, wideSize = isWide ? 8 : 4;
    // An array has at least one element.
    vector<int> atomData;
    vector<double> lengthData;
    smallConstraints.clear();
    for (const ClusterKind* kind : StepProgram::findSmallKinds(layout)) {
        for (int i = 0; i < kind->numParticles; i++)
            for (int cluster = 0; cluster < kind->getNumClusters(); cluster++)
                atomData.push_back(kind->getParticle(cluster, i));
        for (int k = 0; k < kind->getNumConstraints(); k++)
            for (int cluster = 0; cluster < kind->getNumClusters(); cluster++) {
                smallConstraints.push_back(kind->getConstraint(cluster, k));
                lengthData.push_back(layout.distances[smallConstraints.back()].length);
            }
    }
    atomData.resize(std::max<size_t>(1, atomData.size()));
    lengthData.resize(std::max<size_t>(1, lengthData.size()));
    atoms.initialize<int>(context, atomData.size(), "vrattleAtoms");
    atoms.upload(atomData);
    lengths.initialize(context, lengthData.size(), mixedSize, "vrattleLengths");
    lengths.upload(lengthData, true);
    multipliers.initialize(context, lengthData.size(), mixedSize, "vrattleMultipliers");
    context.clearBuffer(multipliers);
    const int needed = (program->getNumSlots() + groupSize - 1) / groupSize;
    const int numPieces = (int) large.getPieces().size();
    numFused = large.getForm().isFused ? numPieces : 0;
    numGroups = std::max(1, std::min(needed, context.getNumThreadBlocks() - numFused));
    numPartials = numGroups + (expressions ? expressions->getNumParts() : 0) + numPieces;
    oldPositions.initialize(context, context.getPaddedNumAtoms(), 4 * mixedSize, "vrattleOldPositions");
    oldVelocities.initialize(context, context.getPaddedNumAtoms(), 4 * mixedSize, "vrattleOldVelocities");
    for (OpenMM::ComputeArray& array : trials)
        array.initialize(context, Control::TrialSize, wideSize, "vrattleTrial");
    failure.initialize<int>(context, 3, "vrattleFailure");
    failure.upload(vector<int>{0, 0, 0});
    iterationCounts.initialize<int>(context, numGroups * groupSize, "vrattleIterations");
    context.clearBuffer(iterationCounts);
    noise.initialize<int>(context, 5, "vrattleNoise");
    if (!large.isEmpty())
        initializeLarge();
    if (expressions)
        expressions->initialize(isMixed);
}

void DeviceSteps::initializeLarge() {
    const int mixedSize = isMixed ? 8 : 4, realSize = context.getUseDoublePrecision() ? 8 : 4;
    const int numPieces = (int) large.getPieces().size();
    // An array of vectors from structures, and an array that has at least one element.
    auto upload = [&](OpenMM::ComputeArray& array, const auto& data, int elementSize, const char* name) {
        array.initialize(context, std::max<size_t>(1, data.size() * sizeof(data[0]) / elementSize), elementSize, name);
        if (!data.empty())
            array.upload(data.data());
    };
    auto uploadMixed = [&](OpenMM::ComputeArray& array, vector<double> data, const char* name) {
        data.resize(std::max<size_t>(1, data.size()));
        array.initialize(context, data.size(), mixedSize, name);
        array.upload(data, true);
    };
    auto clear = [&](OpenMM::ComputeArray& array, size_t size, int elementSize, const char* name) {
        array.initialize(context, std::max<size_t>(1, size), elementSize, name);
        context.clearBuffer(array);
    };
    upload(largeTables, large.getTables(), 16, "vrattleTables");
    upload(largePieces, large.getPieces(), 16, "vrattlePieces");
    upload(largeRows, large.getRows(), 16, "vrattleRows");
    upload(largeAtoms, large.getAtoms(), 4, "vrattleLargeAtoms");
    upload(largeJoints, large.getJoints(), 16, "vrattleJoints");
    uploadMixed(largeRowLengths, large.getRowLengths(), "vrattleRowLengths");
    uploadMixed(largeJointLengths, large.getJointLengths(), "vrattleJointLengths");
    clear(largeMultipliers, large.getNumConstraints(), mixedSize, "vrattleLargeMultipliers");
    clear(largeFactors, large.getNumFactors(), realSize, "vrattleFactors");
    clear(largeWork, large.getNumWork(), mixedSize, "vrattleWork");
    clear(largeExchange, large.getNumWords(), 8, "vrattleExchange");
    clear(largePhases, numPieces, 4, "vrattlePhases");
    clear(largeIterations, numPieces, 4, "vrattleLargeIterations");
}

void DeviceSteps::setSettings(const Settings& newSettings) {
    OpenMM::ContextSelector selector(context);
    settings = newSettings;
    if (isLangevin())
        settings.terms = {{StepMonitor::ConstraintAndAppliedForce, 1, 1, 1}}; // stands for its own monitor
    compile();
    vector<double> numbers(program->getNumSettings());
    const StepDensity density = settings.getDensity();
    numbers[Control::Nominal] = settings.stepSize;
    numbers[Control::Smallest] = density.smallest;
    numbers[Control::Lower] = density.lower;
    numbers[Control::Slope] = density.upperSlope;
    numbers[Control::Curve] = density.curve;
    numbers[Control::DensityTolerance] =
        std::max(MARGIN * settings.tolerance, isMixed ? DENSITY_TOLERANCE : SINGLE_DENSITY_TOLERANCE);
    numbers[Control::DensityRounding] = isMixed ? DENSITY_ROUNDING : SINGLE_DENSITY_ROUNDING;
    if (isLangevin()) {
        numbers[Control::Damping] = settings.atTemperature.damping;
        numbers[Control::NoiseSize] = settings.atTemperature.noise;
        numbers[Control::ReferenceFloor] = settings.atTemperature.floor;
        numbers[Control::Following] = settings.atTemperature.growth;
        numbers[Control::LargestCalm] = settings.atTemperature.largestCalm;
    }
    for (size_t k = 0; k < settings.terms.size(); k++) {
        numbers[Control::FirstTerm + 3 * k] = settings.terms[k].weight;
        numbers[Control::FirstTerm + 3 * k + 1] = settings.terms[k].power;
        numbers[Control::FirstTerm + 3 * k + 2] = settings.terms[k].reference;
    }
    if (settings.isAutomatic) {
        const double* choice = reinterpret_cast<const double*>(&settings.choice);
        std::copy(choice, choice + Control::NumAutomaticChoices, &numbers[Control::FirstTerm]);
        numbers.back() = 1 / settings.numDegreesOfFreedom;
    }
    settingsArray.upload(numbers, true);
}

StepProgram::Update DeviceSteps::findUpdate() const {
    return settings.isAutomatic ? StepProgram::Automatic
           : isLangevin()       ? StepProgram::Langevin
                                : StepProgram::updateOf(settings.terms, settings.isFixedStep, settings.update);
}

bool DeviceSteps::prepareNewton() {
    if (newton || !NewtonSteps::canTake(large))
        return false;
    OpenMM::ContextSelector selector(context);
    newton = std::make_unique<NewtonSteps>(context, layout, large, isMixed);
    compile();
    return true;
}

void DeviceSteps::compile() {
    const StepProgram::Update update = findUpdate();
    std::unique_ptr<StepProgram> next(new StepProgram(
        layout, large, expressions ? &expressions->getClusters() : nullptr, newton ? &newton->getClusters() : nullptr,
        large.getNumThreads(), settings.terms, update, isMixed, isWide));
    const bool isFirst = program == nullptr;
    program.swap(next);
    if (isFirst)
        initialize();
    // What depends on the program. The kernels know arrays by their objects, whose size may change.
    const int mixedSize = isMixed ? 8 : 4, wideSize = isWide ? 8 : 4, numSums = program->getNumSums();
    auto resize = [&](OpenMM::ComputeArray& array, size_t size, int elementSize, const char* name) {
        if (!array.isInitialized())
            array.initialize(context, size, elementSize, name);
        else if (array.getSize() != size)
            array.resize(size);
    };
    resize(settingsArray, program->getNumSettings(), wideSize, "vrattleSettings");
    for (OpenMM::ComputeArray& array : control)
        resize(array, program->getControlSize(), wideSize, "vrattleControl");
    resize(reportArray, program->getControlSize() + 2, wideSize, "vrattleReport");
    if (update == StepProgram::Automatic && !lastForces.isInitialized()) {
        const int numAtoms = context.getPaddedNumAtoms();
        lastForces.initialize(context, 3 * numAtoms, 8, "vrattleLastForces");
        lastSquares.initialize(context, numAtoms, mixedSize, "vrattleLastSquares");
        lastVelocities.initialize(context, numAtoms, 4 * mixedSize, "vrattleLastVelocities");
        context.clearBuffer(lastForces);
        context.clearBuffer(lastSquares);
    }
    resize(partials, (program->hasHalfSums() ? 2 : 1) * numSums * numPartials, mixedSize, "vrattlePartials");
    for (OpenMM::ComputeArray& array : trialPartials)
        resize(array, numSums * numPartials, mixedSize, "vrattleTrialPartials");
    if (expressions)
        resize(jumpPartials, numSums * numPartials, mixedSize, "vrattleJumpPartials");
    std::string key = program->getSource();
    for (const auto& define : program->getDefines())
        key += define.first + "=" + define.second + "\n";
    auto found = compiled.find(key);
    if (found == compiled.end()) {
        OpenMM::ComputeProgram text = context.compileProgram(program->getSource(), program->getDefines());
        Kernels created;
        created.finish = text->createKernel("finishStep");
        created.evaluate = text->createKernel("evaluateState");
        if (program->hasHalfSums())
            created.trial = text->createKernel("tryStep");
        created.advance = text->createKernel("advanceStep");
        created.restore = text->createKernel("restoreState");
        if (!large.isEmpty() && numFused == 0) {
            created.finishLarge = text->createKernel("finishLarge");
            if (program->hasHalfSums())
                created.tryLarge = text->createKernel("tryLarge");
            created.advanceLarge = text->createKernel("advanceLarge");
        }
        setArguments(created);
        if (!large.isEmpty() && numFused == 0)
            setLargeArguments(created);
        if (expressions) {
            created.expressions = expressions->create(
                text, program->hasHalfSums(), program->hasJumps(), program->hasMiddle(),
                {settingsArray, partials, jumpPartials, failure, oldPositions, oldVelocities, numGroups, numPartials});
            addLastState(created.expressions.finish);
            addNoiseState(created.expressions.advance);
        }
        if (newton) {
            created.newton = newton->create(text, program->hasHalfSums(),
                                            {settingsArray, failure, oldPositions, oldVelocities, largePhases,
                                             largeMultipliers, largeIterations, numPartials});
            addNoiseState(created.newton.advance);
        }
        found = compiled.insert({key, created}).first;
    }
    kernels = found->second;
}

// The arguments in the order of kernels/step.cc; those that change from launch to launch come first and are set there.
void DeviceSteps::setArguments(Kernels& created) {
    OpenMM::ArrayInterface& corrections = correctionsOf(context);
    auto addState = [&](ComputeKernel& kernel) {
        kernel->addArg(program->getNumSlots());
        kernel->addArg(context.getPaddedNumAtoms());
        kernel->addArg(atoms);
        kernel->addArg(lengths);
        kernel->addArg(context.getPosq());
        kernel->addArg(corrections);
        kernel->addArg(context.getVelm());
        kernel->addArg(context.getLongForceBuffer());
        kernel->addArg(multipliers);
        kernel->addArg(failure);
        if (numFused > 0) {
            addEmpty(kernel, 2); // stamp, numProjections
            addLargeTables(kernel);
        }
    };
    addEmpty(created.finish, 5); // step, kick, isFormed, isStored, control
    created.finish->addArg(settingsArray);
    created.finish->addArg(partials);
    created.finish->addArg(numPartials);
    addState(created.finish);
    addLastState(created.finish);

    addEmpty(created.evaluate, 6); // step, change, isReported, groupEnergy, numPartials, control
    created.evaluate->addArg(settingsArray);
    created.evaluate->addArg(partials);
    created.evaluate->addArg(failure);
    created.evaluate->addArg(reportArray);

    if (created.trial) {
        addEmpty(created.trial, 6); // step, index, groupEnergy, tolerance, numPartials, control
        created.trial->addArg(settingsArray);
        created.trial->addArg(partials);
        addEmpty(created.trial, 4); // the last trial and its sums, the next one and its sums
        addState(created.trial);
    }

    addEmpty(created.advance, 7); // step, groupEnergy, maxStep, tolerance, numPartials, control, nextControl
    created.advance->addArg(settingsArray);
    created.advance->addArg(partials);
    addEmpty(created.advance, 2); // the last trial and its sums
    created.advance->addArg(oldPositions);
    created.advance->addArg(oldVelocities);
    created.advance->addArg(iterationCounts);
    addState(created.advance);
    if (isLangevin()) {
        created.advance->addArg(noise);
        created.advance->addArg(context.getAtomIndexArray());
    }

    created.restore->addArg(context.getNumAtoms());
    created.restore->addArg(context.getPosq());
    created.restore->addArg(corrections);
    created.restore->addArg(context.getVelm());
    created.restore->addArg(oldPositions);
    created.restore->addArg(oldVelocities);
}

void DeviceSteps::addLargeTables(ComputeKernel& kernel) {
    for (OpenMM::ComputeArray* array :
         {&largeTables, &largePieces, &largeRows, &largeRowLengths, &largeAtoms, &largeJoints, &largeJointLengths,
          &largeMultipliers, &largeFactors, &largeWork, &largeExchange, &largePhases, &largeIterations})
        kernel->addArg(*array);
}

void DeviceSteps::addLastState(ComputeKernel& kernel) {
    if (!settings.isAutomatic)
        return;
    kernel->addArg(lastForces);
    kernel->addArg(lastSquares);
    kernel->addArg(context.getAtomIndexArray());
    kernel->addArg(lastVelocities);
}

// For kernels that do not have the settings already.
void DeviceSteps::addNoiseState(ComputeKernel& kernel) {
    if (!isLangevin())
        return;
    kernel->addArg(settingsArray);
    kernel->addArg(noise);
    kernel->addArg(context.getAtomIndexArray());
}

// The same for kernels/large.cc.
void DeviceSteps::setLargeArguments(Kernels& created) {
    OpenMM::ArrayInterface& corrections = correctionsOf(context);
    auto addState = [&](ComputeKernel& kernel) {
        kernel->addArg((int) large.getPieces().size());
        kernel->addArg(context.getPaddedNumAtoms());
        kernel->addArg(context.getPosq());
        kernel->addArg(corrections);
        kernel->addArg(context.getVelm());
        kernel->addArg(context.getLongForceBuffer());
        kernel->addArg(failure);
        addLargeTables(kernel);
    };
    addEmpty(created.finishLarge,
             9); // step, firstStage, endStage, isLast, stamp, kick, isFormed, isStored, numProjections
    addEmpty(created.finishLarge, 1); // control
    created.finishLarge->addArg(settingsArray);
    created.finishLarge->addArg(partials);
    created.finishLarge->addArg(numPartials);
    addState(created.finishLarge);
    addLastState(created.finishLarge);

    if (created.tryLarge) {
        addEmpty(created.tryLarge, 6); // step, firstStage, endStage, isLast, stamp, tolerance
        created.tryLarge->addArg(settingsArray);
        addEmpty(created.tryLarge, 2); // the next trial and its sums
        created.tryLarge->addArg(numPartials);
        addState(created.tryLarge);
    }

    addEmpty(created.advanceLarge, 7); // step, firstStage, endStage, isLast, stamp, tolerance, nextControl
    created.advanceLarge->addArg(oldPositions);
    created.advanceLarge->addArg(oldVelocities);
    addState(created.advanceLarge);
    addNoiseState(created.advanceLarge);
}

// The type must be that of the kernel's parameter.
void DeviceSteps::setMixed(ComputeKernel& kernel, int index, double value) {
    if (isMixed)
        kernel->setArg(index, value);
    else
        kernel->setArg(index, (float) value);
}

void DeviceSteps::setWide(ComputeKernel& kernel, int index, double value) {
    if (isWide)
        kernel->setArg(index, value);
    else
        kernel->setArg(index, (float) value);
}

void DeviceSteps::launch(ComputeKernel& kernel, int numOwnArguments) {
    if (numFused > 0) {
        kernel->setArg(numOwnArguments, nextStamp());
        kernel->setArg(numOwnArguments + 1, getNumProjections());
    }
    kernel->execute((numFused + numGroups) * groupSize, groupSize);
    numLaunches++;
}

int DeviceSteps::nextStamp() {
    numLargeLaunches++;
    return (int) (numLargeLaunches * STAMPS & 0x7fffffffu);
}

int DeviceSteps::getMaxStages() const {
    return StepProgram::getMaxStages(isLangevin() ? StepProgram::Langevin : StepProgram::Fixed,
                                     large.getForm().isStaged);
}

int DeviceSteps::getNumProjections() const {
    const bool isFactorCoarser = isMixed && !context.getUseDoublePrecision();
    return isFactorCoarser && settings.tolerance < SINGLE_PROJECTION ? 2 : 1;
}

// All stages of the large clusters: in one launch, or one after the other.
void DeviceSteps::launchLarge(ComputeKernel& kernel, int step, int numStages) {
    const int numPieces = (int) large.getPieces().size();
    const int numAtOnce = large.getForm().isStaged ? 1 : numStages;
    kernel->setArg(0, step);
    kernel->setArg(4, nextStamp());
    for (int stage = 0; stage < numStages; stage += numAtOnce) {
        kernel->setArg(1, stage);
        kernel->setArg(2, stage + numAtOnce);
        kernel->setArg(3, (int) (stage + numAtOnce == numStages));
        kernel->execute(std::min(numPieces, context.getNumThreadBlocks()) * large.getNumThreads(),
                        large.getNumThreads());
        numLaunches++;
    }
}

void DeviceSteps::launchFinish(int step, double kick, Control::Change change, bool isStored) {
    kernels.finish->setArg(0, step);
    setMixed(kernels.finish, 1, kick);
    kernels.finish->setArg(2, (int) change);
    kernels.finish->setArg(3, (int) isStored);
    kernels.finish->setArg(4, control[half]);
    launch(kernels.finish, 18);
    if (expressions) {
        expressions->launchFinish(kernels.expressions, step, kick, change, isStored, control[half]);
        numLaunches++;
    }
    if (!kernels.finishLarge)
        return;
    const int numProjections = getNumProjections();
    setMixed(kernels.finishLarge, 5, kick);
    kernels.finishLarge->setArg(6, (int) change);
    kernels.finishLarge->setArg(7, (int) isStored);
    kernels.finishLarge->setArg(8, numProjections);
    kernels.finishLarge->setArg(9, control[half]);
    launchLarge(kernels.finishLarge, step, numProjections + (program->hasHalfSums() ? 3 : 2));
}

void DeviceSteps::launchEvaluate(int step, Control::Change change, bool isReported) {
    kernels.evaluate->setArg(0, step);
    kernels.evaluate->setArg(1, (int) change);
    kernels.evaluate->setArg(2, (int) isReported);
    setWide(kernels.evaluate, 3, groupEnergy);
    kernels.evaluate->setArg(4, numPartials);
    kernels.evaluate->setArg(5, control[half]);
    kernels.evaluate->execute(groupSize, groupSize);
    numLaunches++;
}

void DeviceSteps::setParameters(const ExpressionParameters& theta) {
    OpenMM::ContextSelector selector(context);
    expressions->setParameters(theta, stepSizeRead);
}

void DeviceSteps::moveParameters(const vector<ExpressionConstraint>& given) {
    if (expressions)
        expressions->moveParameters(given);
}

ExpressionParameters DeviceSteps::getParameters() {
    OpenMM::ContextSelector selector(context);
    return expressions ? expressions->getParameters(stepSizeRead) : ExpressionParameters();
}

// OpenMM lets molecules that are alike change places on the device, and their constraints with them.
const vector<int>& DeviceSteps::findConstraintsInPlace() {
    const vector<int>& order = context.getAtomIndex();
    if (order == constraintOrder)
        return constraintInPlace;
    // Two constraints of the same particles are told apart by their order, which is that of all molecules that are alike.
    typedef std::pair<vector<int>, int> Place;
    std::map<vector<int>, vector<int>> numbers;
    vector<Place> places;
    for (const ClusterKind& kind : layout.kinds)
        for (int c = 0; c < (kind.getNumConstraints() > 0 ? kind.getNumClusters() : 0); c++)
            for (int k = 0; k < kind.getNumConstraints(); k++) {
                vector<int> particles;
                for (int i : kind.particlesOf[k])
                    particles.push_back(kind.getParticle(c, i));
                std::sort(particles.begin(), particles.end());
                numbers[particles].push_back(kind.getConstraint(c, k));
                places.emplace_back(particles, kind.getConstraint(c, k));
            }
    for (auto& same : numbers)
        std::sort(same.second.begin(), same.second.end());
    constraintInPlace.resize(layout.distances.size() + (expressions ? expressions->getClusters().getRows().size() : 0));
    std::iota(constraintInPlace.begin(), constraintInPlace.end(), 0);
    for (const Place& place : places) {
        const vector<int>& here = numbers.at(place.first);
        vector<int> particles;
        for (int i : place.first)
            particles.push_back(order[i]);
        std::sort(particles.begin(), particles.end());
        constraintInPlace[place.second] =
            numbers.at(particles).at(std::lower_bound(here.begin(), here.end(), place.second) - here.begin());
    }
    constraintOrder = order;
    return constraintInPlace;
}

vector<double> DeviceSteps::getMultipliers() {
    OpenMM::ContextSelector selector(context);
    const vector<int>& inPlace = findConstraintsInPlace();
    const int numDistances = (int) layout.distances.size();
    vector<double> result(inPlace.size());
    auto take = [&](OpenMM::ComputeArray& array, const vector<int>& constraints) {
        if (constraints.empty())
            return;
        vector<double> found;
        array.download(found, true);
        for (size_t i = 0; i < constraints.size(); i++)
            result[inPlace[constraints[i]]] = found[i] * (constraints[i] < numDistances ? 0.5 : 1.0);
    };
    take(multipliers, smallConstraints);
    take(largeMultipliers, large.getConstraints());
    if (expressions)
        take(expressions->getMultiplierArray(), expressions->getClusters().getConstraints());
    return result;
}

vector<double> DeviceSteps::getExpressionMultipliers() {
    OpenMM::ContextSelector selector(context);
    const vector<int>& inPlace = findConstraintsInPlace();
    const int numDistances = (int) layout.distances.size();
    const vector<double> found = expressions->getMultipliers();
    vector<double> result(found.size());
    for (size_t i = 0; i < found.size(); i++)
        result[inPlace[numDistances + i] - numDistances] = found[i];
    return result;
}

// P (v - h/2 M^-1 F) is what finishStep makes of half a kick backwards, along with numbers of a state that nobody is in.
double DeviceSteps::computeHalfStepKineticEnergy() {
    OpenMM::ContextSelector selector(context);
    vector<OpenMM::ArrayInterface*> written = {&context.getVelm(), &partials, &multipliers, &largeMultipliers};
    if (expressions)
        written.push_back(&expressions->getMultiplierArray());
    auto forWritten = [&](auto copy) {
        for (size_t i = 0; i < written.size(); i++)
            if (written[i]->isInitialized())
                copy(*written[i], beforeLook[i]);
    };
    forWritten([&](OpenMM::ArrayInterface& array, OpenMM::ComputeArray& kept) {
        if (!kept.isInitialized())
            kept.initialize(context, array.getSize(), array.getElementSize(), "vrattleBeforeLook");
        else if (kept.getSize() != array.getSize())
            kept.resize(array.getSize());
        array.copyTo(kept);
    });
    launchFinish(stepNumber, -0.5, Control::NothingChanged, true);
    const double energy = context.getIntegrationUtilities().computeKineticEnergy(0);
    forWritten([](OpenMM::ArrayInterface& array, OpenMM::ComputeArray& kept) { kept.copyTo(array); });
    return energy;
}

bool DeviceSteps::begin(const State& state, double energy, const ExpressionParameters* theta) {
    OpenMM::ContextSelector selector(context);
    vector<double> block(program->getControlSize(), 0.0);
    block[Control::Density] = state.density;
    block[Control::StepSize] = settings.stepSize / state.density;
    block[Control::DensityOffset] = state.densityOffset;
    block[Control::DensityScale] = 1;
    block[Control::IsHalfKnown] = state.hasHalfStepValue;
    block[Control::HalfU] = state.halfStepValue;
    block[Control::MismatchSlope] = 1;
    if (settings.isAutomatic) {
        const double* numbers = reinterpret_cast<const double*>(&state.automatic);
        std::copy(numbers, numbers + Control::NumAutomaticNumbers, &block[Control::FirstNumber]);
        std::copy(std::begin(state.references), std::end(state.references), &block[Control::FirstReference]);
        block[Control::IsAccepted] = 1;
    }
    block[Control::Reference] = state.reference;
    block[Control::IsFollowed] = state.isFollowed;
    control[half].upload(block, true);
    seed = state.seed;
    numDrawn = state.numDrawn;
    // The words of the numbers, the lower ones first, and the step that is the next to draw.
    noise.upload(vector<int>{(int) seed, (int) (seed >> 32), (int) numDrawn, (int) (numDrawn >> 32), stepNumber + 1});
    numStepsRead = numRescuesRead = 0;
    elapsedRead = 0;
    stepSizeRead = block[Control::StepSize];
    if (expressions && theta != nullptr)
        setParameters(*theta);
    groupEnergy = energy;
    launchFinish(NO_STEP, 0, Control::AllChanged, false);
    launchEvaluate(NO_STEP, Control::NothingChanged, true);
    // Such a failure leaves nothing to put back.
    if (readReport()[program->getControlSize()] == NO_FAILURE)
        return true;
    clearFailure();
    return false;
}

void DeviceSteps::keepVelocities() {
    if (!settings.isAutomatic)
        return;
    OpenMM::ContextSelector selector(context);
    context.getVelm().copyTo(lastVelocities);
    areVelocitiesKept = true;
}

// A failure is one of the next step, whose advanceStep copies the state and is then put back.
void DeviceSteps::change(double energy, Control::Change change) {
    OpenMM::ContextSelector selector(context);
    if (!areVelocitiesKept)
        keepVelocities();
    areVelocitiesKept = false;
    launchEvaluate(stepNumber, Control::NothingChanged, false); // u before the change
    groupEnergy = energy;
    launchFinish(stepNumber + 1, 0, change, true);
    launchEvaluate(stepNumber + 1, change, false);
    if (!program->hasHalfSums() || change == Control::VelocitiesChanged)
        return;
    // At other positions or forces p[n-1/2] is formed anew, with the density that is known by now.
    launchFinish(stepNumber + 1, 0, change, true);
    launchEvaluate(stepNumber + 1, Control::NothingChanged, false);
}

vector<double> DeviceSteps::readReport() {
    vector<double> block;
    reportArray.download(block, true);
    return block;
}

// Returns whether a large cluster was not solved.
bool DeviceSteps::clearFailure() {
    vector<int> codes;
    failure.download(codes);
    failure.upload(vector<int>{0, 0, 0});
    return codes[2] != 0;
}

// Parameters that move, or have moved and stop, come first.
void DeviceSteps::beginExpressionStep() {
    expressions->beginStep();
    const bool areJumpsDue = expressions->haveParametersMoved() && kernels.expressions.judge;
    if (!expressions->areParametersMoving() && !areJumpsDue)
        return;
    expressions->launchMove(kernels.expressions, stepNumber, control[half]);
    numLaunches++;
    if (!kernels.expressions.judge)
        return;
    expressions->launchJudge(kernels.expressions, stepNumber, control[half], groupEnergy, isWide);
    numLaunches++;
}

void DeviceSteps::advance(double maxStep) {
    OpenMM::ContextSelector selector(context);
    stepNumber++;
    areVelocitiesKept = false;
    if (expressions)
        beginExpressionStep();
    if (kernels.trial)
        for (int i = 0; i < numTrials; i++) {
            kernels.trial->setArg(0, stepNumber);
            kernels.trial->setArg(1, i);
            setWide(kernels.trial, 2, groupEnergy);
            setMixed(kernels.trial, 3, settings.tolerance);
            kernels.trial->setArg(4, numPartials);
            kernels.trial->setArg(5, control[half]);
            kernels.trial->setArg(8, trials[i % 2]);
            kernels.trial->setArg(9, trialPartials[i % 2]);
            kernels.trial->setArg(10, trials[(i + 1) % 2]);
            kernels.trial->setArg(11, trialPartials[(i + 1) % 2]);
            launch(kernels.trial, 22);
            if (expressions) {
                expressions->launchTrial(kernels.expressions, stepNumber, settings.tolerance, trials[(i + 1) % 2],
                                         trialPartials[(i + 1) % 2]);
                numLaunches++;
            }
            if (kernels.tryLarge) {
                setMixed(kernels.tryLarge, 5, settings.tolerance);
                kernels.tryLarge->setArg(7, trials[(i + 1) % 2]);
                kernels.tryLarge->setArg(8, trialPartials[(i + 1) % 2]);
                launchLarge(kernels.tryLarge, stepNumber, getMaxStages());
            }
            if (newton) {
                newton->launchTrial(kernels.newton, stepNumber, settings.tolerance, trials[(i + 1) % 2],
                                    trialPartials[(i + 1) % 2]);
                numLaunches++;
            }
        }
    kernels.advance->setArg(0, stepNumber);
    setWide(kernels.advance, 1, groupEnergy);
    setWide(kernels.advance, 2, std::min(maxStep, NO_LIMIT));
    setMixed(kernels.advance, 3, settings.tolerance);
    kernels.advance->setArg(4, numPartials);
    kernels.advance->setArg(5, control[half]);
    kernels.advance->setArg(6, control[1 - half]);
    kernels.advance->setArg(9, trials[numTrials % 2]);
    kernels.advance->setArg(10, trialPartials[numTrials % 2]);
    launch(kernels.advance, 24);
    half = 1 - half;
    if (expressions) {
        expressions->launchAdvance(kernels.expressions, stepNumber, settings.tolerance, control[half]);
        numLaunches++;
    }
    if (kernels.advanceLarge) {
        setMixed(kernels.advanceLarge, 5, settings.tolerance);
        kernels.advanceLarge->setArg(6, control[half]);
        launchLarge(kernels.advanceLarge, stepNumber, getMaxStages());
    }
    if (newton) {
        newton->launchAdvance(kernels.newton, stepNumber, settings.tolerance, control[half]);
        numLaunches++;
    }
}

void DeviceSteps::finish(double energy) {
    OpenMM::ContextSelector selector(context);
    groupEnergy = energy;
    launchFinish(stepNumber, 0.5, Control::NothingChanged, true);
}

DeviceSteps::Report DeviceSteps::read() {
    OpenMM::ContextSelector selector(context);
    launchEvaluate(stepNumber, Control::NothingChanged, true);
    const vector<double> block = readReport();
    const int stepsSinceFailure = (int) std::lround(block[block.size() - 2]), code = (int) std::lround(block.back());
    // (The monitors of large clusters, whose factors are in single precision, scatter by more, and take what there is.)
    if (large.isEmpty())
        numTrials =
            std::min(MOST_TRIALS, std::max({FEWEST_TRIALS, numTrials - 1, (int) block[Control::MostTrials] + 1}));
    if (stepsSinceFailure < 0) { // of a change after the last step, that there is nothing to put back of
        Report report = fill(block);
        report.hasFailed = stepsSinceFailure != NO_FAILURE;
        if (report.hasFailed)
            clearFailure();
        return report;
    }
    // The sums are those of the state put back, unless its step got as far as to leave others.
    const bool hasSums = code == Control::NotConverged || code == Control::UnsolvedDensity;
    if (code == Control::UnsolvedDensity)
        numTrials = MOST_TRIALS;
    Report report = undo(stepsSinceFailure + 1, code, hasSums);
    report.hasFailed = true;
    return report;
}

DeviceSteps::Report DeviceSteps::putBack() {
    OpenMM::ContextSelector selector(context);
    vector<int> codes;
    failure.download(codes);
    if (codes[0] == 0)
        return undo(1, Control::NumCodes, true);
    const int code = codes[1] % Control::NumCodes;
    Report report =
        undo(stepNumber - codes[0] + 1, code, code == Control::NotConverged || code == Control::UnsolvedDensity);
    report.hasFailed = true;
    return report;
}

// Put back the state before the last steps, of which the first is the one whose copy there is: the others have done nothing. Nor has one
// that has found no density, which has left no copy either.
DeviceSteps::Report DeviceSteps::undo(int numSteps, int code, bool hasSums) {
    if (code != Control::UnsolvedDensity)
        kernels.restore->execute(context.getNumAtoms());
    if (numSteps % 2 == 1)
        half = 1 - half;
    const bool isForNewton = clearFailure();
    if (hasSums)
        launchEvaluate(NO_STEP, Control::NothingChanged, false);
    vector<double> block;
    control[half].download(block, true);
    // The end of the step before may have been looked at by the step that has failed alone, which leaves other sums.
    if (settings.isAutomatic && block[Control::IsAccepted] == 0) {
        vector<double> next;
        control[1 - half].download(next, true);
        std::copy(next.begin() + Control::FirstReference, next.end(), block.begin() + Control::FirstReference);
        if (block[Control::IsShortened] != 0)
            block[Control::Density] =
                AutomaticRecursions::automaticDensity(&settings.choice, &block[Control::FirstNumber]);
    }
    Report report = fill(block);
    report.state.hasHalfStepValue = report.state.hasHalfStepValue && hasSums;
    report.isForNewton = isForNewton && (code == Control::NotConverged || code == Control::UnsolvedDensity);
    return report;
}

DeviceSteps::Report DeviceSteps::fill(const vector<double>& block) {
    Report report = {};
    report.state = {block[Control::Density], block[Control::DensityOffset], program->hasHalfSums(),
                    block[Control::HalfU]};
    report.isShortened = block[Control::IsShortened] != 0;
    report.stepSize = block[Control::StepSize];
    report.u = block[Control::U];
    report.values.assign(block.begin() + Control::FirstValue,
                         block.begin() + Control::FirstValue + settings.terms.size());
    if (settings.isAutomatic) {
        std::copy_n(&block[Control::FirstNumber], Control::NumAutomaticNumbers,
                    reinterpret_cast<double*>(&report.state.automatic));
        std::copy_n(&block[Control::FirstReference], AutomaticControl::NUM_MONITORS, report.state.references);
        report.values.assign(std::begin(report.state.automatic.values), std::end(report.state.automatic.values));
    }
    report.elapsed = block[Control::Elapsed] - elapsedRead;
    report.numSteps = (int) std::lround(block[Control::Steps] - numStepsRead);
    report.numRescues = (int) std::lround(block[Control::Rescues] - numRescuesRead);
    numDrawn += report.numSteps;
    stepSizeRead = report.stepSize;
    if (expressions)
        expressions->endSteps(report.numSteps);
    report.state.reference = block[Control::Reference];
    report.state.isFollowed = block[Control::IsFollowed] != 0;
    report.state.seed = seed;
    report.state.numDrawn = numDrawn;
    elapsedRead = block[Control::Elapsed];
    numStepsRead = block[Control::Steps];
    numRescuesRead = block[Control::Rescues];
    return report;
}

bool DeviceSteps::hasFailed() {
    OpenMM::ContextSelector selector(context);
    vector<int> codes;
    failure.download(codes);
    return codes[0] != 0;
}

long long DeviceSteps::getNumIterations() {
    OpenMM::ContextSelector selector(context);
    if (!iterationCounts.isInitialized())
        return 0;
    vector<int> counts;
    iterationCounts.download(counts);
    if (!large.isEmpty()) {
        vector<int> largeCounts;
        largeIterations.download(largeCounts);
        counts.insert(counts.end(), largeCounts.begin(), largeCounts.end());
    }
    if (expressions) {
        const vector<int> partCounts = expressions->getNumIterations();
        counts.insert(counts.end(), partCounts.begin(), partCounts.end());
    }
    return *std::max_element(counts.begin(), counts.end());
}
