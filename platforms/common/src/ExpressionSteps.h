// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONSTEPS_H_
#define OPENMMVRATTLE_EXPRESSIONSTEPS_H_

#include "ExpressionClusters.h"
#include "expressions/ExpressionGroup.h"
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
        OpenMM::ComputeKernel finish, trial, advance, move, judge;
        bool hasMiddle = false; // advance wants the parameters in the middle of the step
    };
    /** Where parts leave their sums, and what failures and settings are in; other sums are those of velocities that jump. */
    struct Arrays {
        OpenMM::ComputeArray &settings, &partials, &jumpPartials, &failure, &oldPositions, &oldVelocities;
        int firstPartial, numPartials;
    };
    ExpressionSteps(OpenMM::ComputeContext& context, const ClusterLayout& layout,
                    const std::vector<ExpressionConstraint>& expressions);
    /** Lambda of all rows of all parts. */
    OpenMM::ComputeArray& getMultiplierArray() {
        return multipliers;
    }
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
    Kernels create(OpenMM::ComputeProgram program, bool hasHalfSums, bool hasJumps, bool hasMiddle,
                   const Arrays& arrays);

    /** Take over theta[n] and the rates of the step that has led there, as of one of that size. */
    void setParameters(const ExpressionParameters& parameters, double stepSize);
    /** Take note of what the next step leads to. */
    void moveParameters(const std::vector<ExpressionConstraint>& expressions);
    /** A step is coming. Those who move parameters let the steps end that were asked for, see endSteps(). */
    void beginStep();
    /** So many of the steps since the last call are complete; the others have not happened. */
    void endSteps(int numCompleted);
    /** theta[n], and the rates of a last step of that size. Waits for the device if they are not zero. */
    ExpressionParameters getParameters(double stepSize);
    /** Whether they move in the step that has begun, */
    bool areParametersMoving() const {
        return place.isMoving;
    }
    /** or have moved in the one before. */
    bool haveParametersMoved() const {
        return wereMoving;
    }
    /** The number of times that parameters have been uploaded. */
    long long getNumUploads() const {
        return numUploads;
    }
    void launchMove(Kernels& kernels, int step, OpenMM::ComputeArray& control);
    void launchJudge(Kernels& kernels, int step, OpenMM::ComputeArray& control, double groupEnergy, bool isWide);
    void launchFinish(Kernels& kernels, int step, double kick, int change, bool isStored,
                      OpenMM::ComputeArray& control);
    void launchTrial(Kernels& kernels, int step, double tolerance, OpenMM::ComputeArray& nextTrial,
                     OpenMM::ComputeArray& nextPartials);
    void launchAdvance(Kernels& kernels, int step, double tolerance, OpenMM::ComputeArray& nextControl);
    /** Lambda of each expression, in the order in which they were given. */
    std::vector<double> getMultipliers();
    /** The iterations of each part, since the beginning. */
    std::vector<int> getNumIterations();

private:
    /** Which array has the parameters at the end of a step, and whether they have moved in it. */
    struct Place {
        int side;
        bool isMoving;
    };
    void addParts(OpenMM::ComputeKernel& kernel, const Arrays& arrays);
    void setMixed(OpenMM::ComputeKernel& kernel, int index, double value);
    void setPlaces(OpenMM::ComputeKernel& kernel, int numOwnArguments, int from);
    void uploadParameters(const std::vector<double>& changes);
    void launch(OpenMM::ComputeKernel& kernel);
    void updateShifts();
    OpenMM::ComputeContext& context;
    ExpressionClusters clusters;
    bool isMixed;
    int numThreads;
    std::vector<int> cells; // by which each place's particle is offset
    OpenMM::Vec3 box[3];
    Place place; // of the step that was begun last
    int from; // the array with the parameters at its beginning
    bool wereMoving; // in the step before
    std::vector<double> values, target; // of the parameters at its end, and of the next step's
    // Before the steps since the last endSteps(), of which only the first may have moved parameters.
    Place endedPlace;
    std::vector<double> endedValues;
    int numBegun;
    bool hasMoved;
    long long numUploads;
    OpenMM::ComputeArray parts, tables, work, shifts, multipliers, iterations, parameters[2], middle, jumpRates,
        hasJumped;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONSTEPS_H_
