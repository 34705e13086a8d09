// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONSTEPS_H_
#define OPENMMVRATTLE_EXPRESSIONSTEPS_H_

#include "ExpressionClusters.h"
#include "openmm/Vec3.h"
#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The launches for the clusters with constraints given as expressions, beside those of DeviceSteps: what they work with on the device,
 * and what the host keeps up to date there.
 */
class ExpressionSteps {
public:
    struct Kernels {
        OpenMM::ComputeKernel finish, trial, advance;
    };
    /** Where parts leave their sums, and what failures and settings are in. */
    struct Arrays {
        OpenMM::ComputeArray &settings, &partials, &failure, &oldPositions, &oldVelocities;
        int firstPartial, numPartials;
    };
    ExpressionSteps(OpenMM::ComputeContext& context, const OpenMM::System& system,
                    const std::vector<ExpressionConstraint>& expressions);
    const ExpressionClusters& getClusters() const {
        return clusters;
    }
    int getNumParts() const {
        return (int) clusters.getParts().size();
    }
    /** The threads that a part has. */
    int getNumThreads() const {
        return numThreads;
    }
    void initialize(bool isMixed);
    Kernels create(OpenMM::ComputeProgram program, bool hasHalfSums, const Arrays& arrays);

    /** Take over the parameters of all expressions; returns whether they are others. */
    bool setParameters(const std::vector<ExpressionConstraint>& expressions);
    void launchFinish(Kernels& kernels, int step, double kick, int change, bool isStored,
                      OpenMM::ComputeArray& control);
    void launchTrial(Kernels& kernels, int step, double tolerance, OpenMM::ComputeArray& nextTrial,
                     OpenMM::ComputeArray& nextPartials);
    void launchAdvance(Kernels& kernels, int step, double tolerance, OpenMM::ComputeArray& nextControl);
    /** The iterations of each part, since the beginning. */
    std::vector<int> getNumIterations();

private:
    void addParts(OpenMM::ComputeKernel& kernel, const Arrays& arrays);
    void setMixed(OpenMM::ComputeKernel& kernel, int index, double value);
    void launch(OpenMM::ComputeKernel& kernel);
    void updateShifts();
    OpenMM::ComputeContext& context;
    ExpressionClusters clusters;
    bool isMixed;
    int numThreads;
    std::vector<int> cells; // by which each place's particle is offset
    OpenMM::Vec3 box[3];
    std::vector<double> values; // of the parameters
    OpenMM::ComputeArray parts, tables, work, shifts, multipliers, iterations, parameters[2], changes;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONSTEPS_H_
