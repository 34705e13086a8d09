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

ExpressionSteps::ExpressionSteps(OpenMM::ComputeContext& context, const OpenMM::System& system,
                                 const vector<ExpressionConstraint>& expressions) :
        context(context), clusters(system, expressions), isMixed(false),
        numThreads(context.getIsCPU() ? 1 : StepProgram::getGroupSize(true)), cells(3 * clusters.getPlaces().size(), 0),
        values(clusters.getParameters()) {
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
    for (ComputeArray& array : parameters)
        clear(array, clusters.getParameters().size(), mixedSize, "vrattleParameters");
    clear(changes, clusters.getParameters().size(), mixedSize, "vrattleParameterChanges");
    if (!values.empty())
        parameters[0].upload(values, true);
}

ExpressionSteps::Kernels ExpressionSteps::create(OpenMM::ComputeProgram program, bool hasHalfSums,
                                                 const Arrays& arrays) {
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
    kernel->addArg(parameters[0]);
    kernel->addArg(parameters[0]);
    kernel->addArg(changes);
    kernel->addArg(0); // areParametersMoving
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

bool ExpressionSteps::setParameters(const vector<ExpressionConstraint>& expressions) {
    vector<double> next = values;
    for (size_t i = 0; i < expressions.size(); i++)
        clusters.writeParameters((int) i, expressions[i].parameters, next);
    if (next == values)
        return false;
    values.swap(next);
    if (parameters[0].isInitialized()) // else it comes
        parameters[0].upload(values, true);
    return true;
}

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
    launch(kernels.finish);
}

void ExpressionSteps::launchTrial(Kernels& kernels, int step, double tolerance, ComputeArray& nextTrial,
                                  ComputeArray& nextPartials) {
    updateShifts();
    kernels.trial->setArg(0, step);
    setMixed(kernels.trial, 1, tolerance);
    kernels.trial->setArg(3, nextTrial);
    kernels.trial->setArg(4, nextPartials);
    launch(kernels.trial);
}

void ExpressionSteps::launchAdvance(Kernels& kernels, int step, double tolerance, ComputeArray& nextControl) {
    updateShifts();
    kernels.advance->setArg(0, step);
    setMixed(kernels.advance, 1, tolerance);
    kernels.advance->setArg(2, nextControl);
    launch(kernels.advance);
}

vector<int> ExpressionSteps::getNumIterations() {
    vector<int> counts;
    iterations.download(counts);
    return counts;
}
