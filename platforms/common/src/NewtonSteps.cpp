// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "NewtonSteps.h"
#include <algorithm>

using namespace OpenMMVRattle;
using OpenMM::ComputeArray;
using OpenMM::ComputeKernel;
using std::vector;

// Of all factors: about 100 bytes each.
static const size_t MOST_ENTRIES = 4000000;

bool NewtonSteps::canTake(const LargeClusters& large) {
    return !large.isEmpty() && large.getNumFactors() <= MOST_ENTRIES;
}

NewtonSteps::NewtonSteps(OpenMM::ComputeContext& context, const ClusterLayout& layout, const LargeClusters& large,
                         bool isMixed) :
        context(context), clusters(layout), isMixed(isMixed), numThreads(large.getNumThreads()) {
    const int mixedSize = isMixed ? 8 : 4;
    auto uploadInts = [&](ComputeArray& array, const vector<int>& data, const char* name) {
        array.initialize<int>(context, data.size(), name);
        array.upload(data);
    };
    auto clear = [&](ComputeArray& array, size_t size, const char* name) {
        array.initialize(context, size, mixedSize, name);
        context.clearBuffer(array);
    };
    vector<int> first;
    for (size_t piece = 0; piece < large.getPieces().size(); piece++)
        if (large.getPieces()[piece].numPieces > 0)
            first.push_back((int) piece);
    first.push_back((int) large.getPieces().size());
    uploadInts(parts, clusters.getParts(), "vrattleNewtonParts");
    uploadInts(tables, clusters.getTables(), "vrattleNewtonTables");
    uploadInts(firstPieces, first, "vrattleNewtonPieces");
    clear(work, clusters.getNumWork(), "vrattleNewtonWork");
    clear(shifts, 3 * clusters.getPlaces().size(), "vrattleNewtonShifts"); // distances know no shifts
    clear(rowMultipliers, clusters.getNumConstraints(), "vrattleNewtonMultipliers");
    clear(lengths, clusters.getParameters().size(), "vrattleNewtonLengths");
    lengths.upload(clusters.getParameters(), true);
}

// The arguments in the order of kernels/newton.cc; empty ones change from launch to launch.
NewtonSteps::Kernels NewtonSteps::create(OpenMM::ComputeProgram program, bool hasHalfSums, const Arrays& arrays) {
    auto addEmpty = [](ComputeKernel& kernel, int count) {
        for (int i = 0; i < count; i++)
            kernel->addArg();
    };
    Kernels kernels;
    if (hasHalfSums) {
        kernels.trial = program->createKernel("tryByNewton");
        addEmpty(kernels.trial, 2); // step, tolerance
        kernels.trial->addArg(arrays.settings);
        addEmpty(kernels.trial, 2); // the next trial and its sums
        kernels.trial->addArg(arrays.numPartials);
        addClusters(kernels.trial, arrays);
    }
    kernels.advance = program->createKernel("advanceByNewton");
    addEmpty(kernels.advance, 3); // step, tolerance, nextControl
    kernels.advance->addArg(arrays.oldPositions);
    kernels.advance->addArg(arrays.oldVelocities);
    addClusters(kernels.advance, arrays);
    return kernels;
}

void NewtonSteps::addClusters(ComputeKernel& kernel, const Arrays& arrays) {
    kernel->addArg((int) clusters.getParts().size());
    for (ComputeArray* array : {&parts, &tables, &work, &shifts, &rowMultipliers, &lengths, &firstPieces,
                                &arrays.phases, &arrays.multipliers, &arrays.iterations, &arrays.failure})
        kernel->addArg(*array);
    kernel->addArg(context.getPaddedNumAtoms());
    kernel->addArg(context.getPosq());
    kernel->addArg(context.getUseMixedPrecision() ? context.getPosqCorrection() : context.getPosq());
    kernel->addArg(context.getVelm());
    kernel->addArg(context.getLongForceBuffer());
}

void NewtonSteps::launch(ComputeKernel& kernel, int step, double tolerance) {
    kernel->setArg(0, step);
    if (isMixed)
        kernel->setArg(1, tolerance);
    else
        kernel->setArg(1, (float) tolerance);
    kernel->execute(std::min((int) clusters.getParts().size(), context.getNumThreadBlocks()) * numThreads, numThreads);
}

void NewtonSteps::launchTrial(Kernels& kernels, int step, double tolerance, ComputeArray& nextTrial,
                              ComputeArray& nextPartials) {
    kernels.trial->setArg(3, nextTrial);
    kernels.trial->setArg(4, nextPartials);
    launch(kernels.trial, step, tolerance);
}

void NewtonSteps::launchAdvance(Kernels& kernels, int step, double tolerance, ComputeArray& nextControl) {
    kernels.advance->setArg(2, nextControl);
    launch(kernels.advance, step, tolerance);
}
