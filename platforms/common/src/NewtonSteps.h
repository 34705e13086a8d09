// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_NEWTONSTEPS_H_
#define OPENMMVRATTLE_NEWTONSTEPS_H_

#include "ExpressionClusters.h"
#include "LargeClusters.h"
#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The launches of Newton's iteration for large clusters of distances (kernels/newton.cc), one behind each that may leave some unsolved.
 * They are there from the first time that one was, so that runs without such steps know nothing of them.
 */
class NewtonSteps {
public:
    struct Kernels {
        OpenMM::ComputeKernel trial, advance;
    };
    /** What the launches before them know. */
    struct Arrays {
        OpenMM::ComputeArray &settings, &failure, &oldPositions, &oldVelocities, &phases, &multipliers, &iterations;
        int numPartials;
    };
    /** Whether there is something to be solved, and the memory for it is not too much. */
    static bool canTake(const LargeClusters& large);
    NewtonSteps(OpenMM::ComputeContext& context, const ClusterLayout& layout, const LargeClusters& large, bool isMixed);
    const ExpressionClusters& getClusters() const {
        return clusters;
    }
    Kernels create(OpenMM::ComputeProgram program, bool hasHalfSums, const Arrays& arrays);
    void launchTrial(Kernels& kernels, int step, double tolerance, OpenMM::ComputeArray& nextTrial,
                     OpenMM::ComputeArray& nextPartials);
    void launchAdvance(Kernels& kernels, int step, double tolerance, OpenMM::ComputeArray& nextControl);

private:
    void addClusters(OpenMM::ComputeKernel& kernel, const Arrays& arrays);
    void launch(OpenMM::ComputeKernel& kernel, int step, double tolerance);
    OpenMM::ComputeContext& context;
    ExpressionClusters clusters;
    bool isMixed;
    int numThreads;
    OpenMM::ComputeArray parts, tables, work, shifts, rowMultipliers, lengths, firstPieces;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_NEWTONSTEPS_H_
