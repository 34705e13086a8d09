// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionSteps.h"
#include "StepProgram.h"
#include <algorithm>

using namespace OpenMMVRattle;
using OpenMM::ComputeArray;
using OpenMM::ComputeKernel;
using OpenMM::Vec3;
using std::vector;

// Of each kernel that has EXPRESSION_PARAMETERS, at the end.
static const int NUM_PART_ARGUMENTS = 19;

ExpressionSteps::ExpressionSteps(OpenMM::ComputeContext& context, const ClusterLayout& layout,
                                 const vector<ExpressionConstraint>& expressions) :
        context(context), clusters(layout, expressions), isMixed(false),
        numThreads(context.getIsCPU() ? 1 : StepProgram::getGroupSize(true)), cells(3 * clusters.getPlaces().size(), 0),
        place{0, false}, from(0), wereMoving(false), endedPlace(place), numBegun(0), hasMoved(false), numUploads(0) {
    const vector<double>& all = clusters.getParameters();
    values = target = vector<double>(all.begin(), all.begin() + clusters.getNumParameters());
}

void ExpressionSteps::initialize(bool isMixedPrecision) {
    isMixed = isMixedPrecision;
    const int mixedSize = isMixed ? 8 : 4;
    auto uploadInts = [&](ComputeArray& array, const vector<int>& data, const char* name) {
        array.initialize<int>(context, data.size(), name);
        array.upload(data);
    };
    auto clear = [&](ComputeArray& array, size_t size, int elementSize, const char* name) {
        array.initialize(context, std::max<size_t>(1, size), elementSize, name);
        context.clearBuffer(array);
    };
    uploadInts(parts, clusters.getParts(), "vrattleParts");
    uploadInts(tables, clusters.getTables(), "vrattlePartTables");
    clear(work, clusters.getNumWork(), mixedSize, "vrattlePartWork");
    clear(shifts, cells.size(), mixedSize, "vrattleShifts");
    clear(multipliers, clusters.getNumConstraints(), mixedSize, "vrattlePartMultipliers");
    clear(iterations, getNumParts(), 4, "vrattlePartIterations");
    for (ComputeArray* array : {&parameters[0], &parameters[1], &middle}) {
        clear(*array, clusters.getParameters().size(), mixedSize, "vrattleParameters");
        if (!clusters.getParameters().empty())
            array->upload(clusters.getParameters(), true);
    }
    clear(jumpRates, clusters.getNumParameters(), mixedSize, "vrattleJumpRates");
    clear(hasJumped, 1, 4, "vrattleHasJumped");
}

ExpressionSteps::Kernels ExpressionSteps::create(OpenMM::ComputeProgram program, bool hasHalfSums, bool hasJumps,
                                                 bool hasMiddle, const Arrays& arrays) {
    // The arguments in the order of kernels/expression.cc; empty ones change from launch to launch.
    auto addEmpty = [](ComputeKernel& kernel, int count) {
        for (int i = 0; i < count; i++)
            kernel->addArg();
    };
    Kernels kernels;
    kernels.finish = program->createKernel("finishExpressions");
    addEmpty(kernels.finish, 5); // step, kick, isFormed, isStored, control
    kernels.finish->addArg(arrays.settings);
    kernels.finish->addArg(arrays.partials);
    addParts(kernels.finish, arrays);
    if (hasHalfSums) {
        kernels.trial = program->createKernel("tryExpressions");
        addEmpty(kernels.trial, 2); // step, tolerance
        kernels.trial->addArg(arrays.settings);
        addEmpty(kernels.trial, 2); // the next trial and its sums
        addParts(kernels.trial, arrays);
    }
    kernels.advance = program->createKernel("advanceExpressions");
    addEmpty(kernels.advance, 3); // step, tolerance, nextControl
    kernels.advance->addArg(arrays.oldPositions);
    kernels.advance->addArg(arrays.oldVelocities);
    addParts(kernels.advance, arrays);
    kernels.hasMiddle = hasMiddle;
    addEmpty(kernels.advance, hasMiddle ? 1 : 0); // the parameters there
    kernels.move = program->createKernel("moveExpressions");
    addEmpty(kernels.move, 3); // step, wereMoving, control
    kernels.move->addArg(arrays.settings);
    kernels.move->addArg(arrays.partials);
    kernels.move->addArg(arrays.jumpPartials);
    kernels.move->addArg(jumpRates);
    kernels.move->addArg(hasJumped);
    addEmpty(kernels.move, 1); // changedParameters
    kernels.move->addArg(middle);
    addParts(kernels.move, arrays);
    if (!hasJumps)
        return kernels;
    kernels.judge = program->createKernel("judgeJump");
    addEmpty(kernels.judge, 2); // step, groupEnergy
    kernels.judge->addArg(arrays.numPartials);
    addEmpty(kernels.judge, 1); // control
    kernels.judge->addArg(arrays.settings);
    kernels.judge->addArg(arrays.partials);
    kernels.judge->addArg(arrays.jumpPartials);
    kernels.judge->addArg(hasJumped);
    kernels.judge->addArg(arrays.failure);
    return kernels;
}

void ExpressionSteps::addParts(ComputeKernel& kernel, const Arrays& arrays) {
    kernel->addArg(getNumParts());
    kernel->addArg(arrays.firstPartial);
    kernel->addArg(arrays.numPartials);
    kernel->addArg(context.getPaddedNumAtoms());
    kernel->addArg(context.getPosq());
    kernel->addArg(context.getUseMixedPrecision() ? context.getPosqCorrection() : context.getPosq());
    kernel->addArg(context.getVelm());
    kernel->addArg(context.getLongForceBuffer());
    kernel->addArg(arrays.failure);
    for (ComputeArray* array : {&parts, &tables, &work, &shifts, &multipliers, &iterations})
        kernel->addArg(*array);
    for (int i = 0; i < 2; i++)
        kernel->addArg(); // the parameters at the beginning of the step and at its end
    kernel->addArg(clusters.getNumParameters());
    kernel->addArg(); // areParametersMoving
}

// What addParts() has left empty.
void ExpressionSteps::setPlaces(ComputeKernel& kernel, int numOwnArguments, int from) {
    const int first = numOwnArguments + NUM_PART_ARGUMENTS - 4;
    kernel->setArg(first, parameters[from]);
    kernel->setArg(first + 1, parameters[place.side]);
    kernel->setArg(first + 3, (int) place.isMoving);
}

// The type must be that of the kernel's parameter.
void ExpressionSteps::setMixed(ComputeKernel& kernel, int index, double value) {
    if (isMixed)
        kernel->setArg(index, value);
    else
        kernel->setArg(index, (float) value);
}

void ExpressionSteps::launch(ComputeKernel& kernel) {
    kernel->execute(std::min(getNumParts(), context.getNumThreadBlocks()) * numThreads, numThreads);
}

// ------------------------------------------------------------------------------------------------------------- parameters

// Values and changes are all that changes from step to step.
void ExpressionSteps::uploadParameters(const vector<double>& changes) {
    vector<double> data = values;
    data.insert(data.end(), changes.begin(), changes.end());
    if (data.empty())
        return;
    ComputeArray& array = parameters[place.side];
    if (isMixed)
        array.uploadSubArray(data.data(), 0, (int) data.size());
    else
        array.uploadSubArray(vector<float>(data.begin(), data.end()).data(), 0, (int) data.size());
    numUploads++;
}

void ExpressionSteps::setParameters(const ExpressionParameters& theta, double stepSize) {
    vector<double> changes(values.size(), 0.0);
    const vector<int>& given = clusters.getGivenParameters();
    for (size_t k = 0; k < given.size(); k++) {
        values[given[k]] = theta.values[k];
        changes[given[k]] = theta.rates[k] * stepSize;
    }
    target = values;
    place.isMoving = theta.isMoving;
    from = place.side;
    numBegun = 0;
    hasMoved = false;
    uploadParameters(changes);
}

void ExpressionSteps::moveParameters(const vector<ExpressionConstraint>& expressions) {
    for (size_t i = 0; i < expressions.size(); i++)
        clusters.writeParameters((int) i, expressions[i].parameters, target);
}

void ExpressionSteps::beginStep() {
    if (numBegun++ == 0)
        endedPlace = place;
    wereMoving = place.isMoving;
    from = place.side;
    place.isMoving = target != values;
    if (!place.isMoving)
        return;
    vector<double> changes(values.size());
    for (size_t k = 0; k < values.size(); k++)
        changes[k] = target[k] - values[k];
    endedValues = values;
    values = target;
    hasMoved = true;
    place.side = 1 - from; // what was before stays, for the sake of a step that fails
    uploadParameters(changes);
}

void ExpressionSteps::endSteps(int numCompleted) {
    if (numCompleted < numBegun) {
        const bool areBefore = numCompleted == 0;
        place.isMoving = areBefore ? endedPlace.isMoving : numCompleted == 1 && hasMoved;
        if (areBefore && hasMoved) {
            place.side = endedPlace.side;
            values = endedValues;
        }
    }
    numBegun = 0;
    hasMoved = false;
}

ExpressionParameters ExpressionSteps::getParameters(double stepSize) {
    vector<double> all;
    if (place.isMoving)
        parameters[place.side].download(all, true);
    ExpressionParameters theta;
    theta.isMoving = place.isMoving;
    for (int k : clusters.getGivenParameters()) {
        theta.values.push_back(values[k]);
        theta.rates.push_back(place.isMoving ? all[values.size() + k] / stepSize : 0.0);
    }
    return theta;
}

// ------------------------------------------------------------------------------------------------------------------ launches

// OpenMM moves whole molecules by box vectors, and back where a barostat's move is rejected.
void ExpressionSteps::updateShifts() {
    const vector<OpenMM::mm_int4>& offsets = context.getPosCellOffsets();
    Vec3 next[3];
    context.getPeriodicBoxVectors(next[0], next[1], next[2]);
    bool areOthers = !std::equal(next, next + 3, box);
    size_t k = 0;
    for (int i : clusters.getPlaces())
        for (int cell : {offsets[i].x, offsets[i].y, offsets[i].z}) {
            areOthers = areOthers || cell != cells[k];
            cells[k++] = cell;
        }
    if (!areOthers)
        return;
    std::copy(next, next + 3, box);
    vector<double> data(cells.size());
    for (size_t i = 0; i < cells.size(); i += 3)
        for (int d = 0; d < 3; d++)
            data[i + d] = -(box[0][d] * cells[i] + box[1][d] * cells[i + 1] + box[2][d] * cells[i + 2]);
    shifts.upload(data, true);
}

void ExpressionSteps::launchFinish(Kernels& kernels, int step, double kick, int change, bool isStored,
                                   ComputeArray& control) {
    updateShifts();
    kernels.finish->setArg(0, step);
    setMixed(kernels.finish, 1, kick);
    kernels.finish->setArg(2, change);
    kernels.finish->setArg(3, (int) isStored);
    kernels.finish->setArg(4, control);
    setPlaces(kernels.finish, 7, place.side);
    launch(kernels.finish);
}

void ExpressionSteps::launchTrial(Kernels& kernels, int step, double tolerance, ComputeArray& nextTrial,
                                  ComputeArray& nextPartials) {
    updateShifts();
    kernels.trial->setArg(0, step);
    setMixed(kernels.trial, 1, tolerance);
    kernels.trial->setArg(3, nextTrial);
    kernels.trial->setArg(4, nextPartials);
    setPlaces(kernels.trial, 5, from);
    launch(kernels.trial);
}

void ExpressionSteps::launchAdvance(Kernels& kernels, int step, double tolerance, ComputeArray& nextControl) {
    updateShifts();
    kernels.advance->setArg(0, step);
    setMixed(kernels.advance, 1, tolerance);
    kernels.advance->setArg(2, nextControl);
    setPlaces(kernels.advance, 5, from);
    if (kernels.hasMiddle)
        kernels.advance->setArg(5 + NUM_PART_ARGUMENTS, place.isMoving ? middle : parameters[place.side]);
    launch(kernels.advance);
}

void ExpressionSteps::launchMove(Kernels& kernels, int step, ComputeArray& control) {
    updateShifts();
    kernels.move->setArg(0, step);
    kernels.move->setArg(1, (int) wereMoving);
    kernels.move->setArg(2, control);
    kernels.move->setArg(8, parameters[place.side]);
    setPlaces(kernels.move, 10, from);
    launch(kernels.move);
}

void ExpressionSteps::launchJudge(Kernels& kernels, int step, ComputeArray& control, double groupEnergy, bool isWide) {
    kernels.judge->setArg(0, step);
    if (isWide)
        kernels.judge->setArg(1, groupEnergy);
    else
        kernels.judge->setArg(1, (float) groupEnergy);
    kernels.judge->setArg(3, control);
    kernels.judge->execute(StepProgram::getGroupSize(true), StepProgram::getGroupSize(true));
}

vector<double> ExpressionSteps::getMultipliers() {
    vector<double> all, result;
    multipliers.download(all, true);
    for (int row : clusters.getRows())
        result.push_back(all[row]);
    return result;
}

vector<int> ExpressionSteps::getNumIterations() {
    vector<int> counts;
    iterations.download(counts);
    return counts;
}
