// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_DEVICESTEPS_H_
#define OPENMMVRATTLE_DEVICESTEPS_H_

#include "ExpressionSteps.h"
#include "LargeClusters.h"
#include "NewtonSteps.h"
#include "StepProgram.h"
#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include "step/StepSettings.h"
#include <cstdint>
#include <map>
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * The regular steps of VRATTLE, or those of Langevin dynamics that need no substeps, on a device: what is launched, and what the host
 * reads. The state between two steps is on the device alone: positions and velocities in OpenMM's arrays, the density and what goes with
 * it in a control block. Forces are somebody else's to compute between advance() and finish().
 *
 * A step of Langevin dynamics whose end asks for substeps has failed, which the next one notices.
 *
 * Nothing here waits for the device but begin(), read(), putBack() and what changes settings.
 */
class DeviceSteps {
public:
    /** The numbers that Langevin dynamics goes by. */
    struct Langevin {
        double damping, noise; // a and sqrt(kT (1 - a^2))
        double floor, growth;  // U_ref is no less, and follows U by this factor
        double largestCalm;    // steps that end with a larger U/U_ref need substeps
    };
    /** What has been chosen, with the references in force among the monitors, and what the method on the host makes of it. */
    struct Settings : StepSettings {
        /** With automatic step control: its choices, and the degrees of freedom. */
        AutomaticRecursions::AutomaticChoice choice = {};
        double numDegreesOfFreedom = 1;
        Langevin atTemperature = {};
    };
    /** What of the state is in the control block. */
    struct State {
        double density; // rho[n-1/2]
        double densityOffset; // what (3.14) and (3.15) differed by in the last step
        bool hasHalfStepValue;
        double halfStepValue; // u(q[n],p[n-1/2])
        /** With automatic step control: its numbers and references. */
        AutomaticRecursions::AutomaticNumbers automatic = {};
        double references[AutomaticControl::NUM_MONITORS] = {};
        // Of Langevin dynamics:
        double reference = 0; // U_ref
        bool isFollowed = true; // it has followed U(q[n],p[n])
        int64_t seed = 0, numDrawn = 0;
    };
    struct Report {
        State state;
        double stepSize, elapsed; // of the last step, and since the last read() (ps)
        int numSteps, numRescues; // since the last read()
        double u;
        std::vector<double> values; // u(q[n],p[n]) and U_k; with automatic step control U_A[n] and U_B[n-1/2]
        bool isShortened; // the last step was cut short
        bool hasFailed;
        bool isForNewton; // in a large cluster whose chord iteration has not converged, see prepareNewton()
    };

    /** Whether all constraints are of those that the device can solve. */
    static bool canTake(const std::vector<ExpressionConstraint>& expressions);
    /**
     * @param layout         the clusters, which must live as long as this
     * @param expressions    the constraints among them that are given so
     */
    DeviceSteps(OpenMM::ComputeContext& context, const ClusterLayout& layout,
                const std::vector<ExpressionConstraint>& expressions = {});
    /** Take over settings, after which begin() is due. */
    void setSettings(const Settings& settings);
    /** The tolerance that is in force where another is asked for: rounding allows none below a certain one. */
    static double tolerableTolerance(const OpenMM::ComputeContext& context, double tolerance);

    /**
     * Take over a state: the positions and velocities that are on the device, where the forces have been computed. The velocities
     * are left as they are.
     *
     * @param groupEnergy    the energy of the monitor's force group there
     * @param theta          the parameters of expressions, in the order in which these were given, with the rates of the last step; or null
     *                       if there are none, or they are those that were given, and at rest
     * @return false if the constraints depend on each other or a monitor is no number
     */
    bool begin(const State& state, double groupEnergy, const ExpressionParameters* theta = nullptr);
    /** Put such parameters of expressions in force. The steps before must have been read. */
    void setParameters(const ExpressionParameters& theta);
    /** The next step leads to these parameters of expressions, all that were given. The steps before it must have been read. */
    void moveParameters(const std::vector<ExpressionConstraint>& given);
    /** In that order the parameters of expressions in the state that was read last, with the rates of the step that has led there. */
    ExpressionParameters getParameters();
    /**
     * Go on from positions, velocities and forces that are others now, or some of them: velocities are projected, the density is
     * scaled with u. With automatic step control it matters what the velocities were, see keepVelocities(). Does not wait for the
     * device: where it fails the next step does, and where read() comes before that it says so, and begin() is due.
     */
    void change(double groupEnergy, Control::Change change);
    /** Remember the velocities, which others are about to change. Does nothing where it does not matter. */
    void keepVelocities();

    /** The first half of a step, which is not to be longer than maxStep. */
    void advance(double maxStep);
    /** The second half, after the forces at the new positions. */
    void finish(double groupEnergy);
    /**
     * Wait for the steps, and evaluate the monitors where they have led. If one has failed, positions, velocities and density are
     * those before it, those after it have not happened, and begin() is due after the forces. numSteps counts those completed.
     */
    Report read();
    /**
     * From the next step on follow chord iterations that do not converge by Newton's. Compiles a program; begin() is due. Returns whether
     * that is new.
     */
    bool prepareNewton();
    /** Put back the state before the last step, whose finish() is not to come, or before an earlier one that has failed; as read(). */
    Report putBack();
    /**
     * Lambda(q[n],p[n]) where the steps have led that were read last, of all constraints in the order in which they were given: that
     * of a distance is the one of |r|^2 - L^2. Waits for the device, once for each of the sorts of clusters that there are.
     */
    std::vector<double> getMultipliers();
    /** The same of the expressions alone. */
    std::vector<double> getExpressionMultipliers();
    /**
     * In Langevin dynamics: the kinetic energy of the velocities half a step before the state that was read last, which must be the one
     * there is, with its forces. The state is the same afterwards, to the last bit. Waits for the device, once.
     */
    double computeHalfStepKineticEnergy();
    /** Whether a step has failed. Waits for the device. */
    bool hasFailed();
    /** The number of iterations of the cluster that has needed most, since the beginning. */
    long long getNumIterations();
    /** What is known on the device of the last step, in the order of Control::Field. */
    OpenMM::ComputeArray& getControl() {
        return control[half];
    }
    const LargeClusters& getLargeClusters() const {
        return large;
    }
    /** The clusters with expressions; there must be some. */
    const ExpressionClusters& getExpressionClusters() const {
        return expressions->getClusters();
    }
    /** How often parameters of expressions have been uploaded. */
    long long getNumParameterUploads() const {
        return expressions ? expressions->getNumUploads() : 0;
    }
    /** Launches since the beginning. */
    long long getNumLaunches() const {
        return numLaunches;
    }

private:
    const std::vector<int>& findConstraintsInPlace();
    struct Kernels {
        ExpressionSteps::Kernels expressions;
        OpenMM::ComputeKernel finish, evaluate, trial, advance, restore;
        OpenMM::ComputeKernel finishLarge, tryLarge, advanceLarge;
        NewtonSteps::Kernels newton;
    };
    void initialize();
    StepProgram::Update findUpdate() const;
    void compile();
    bool isLangevin() const {
        return settings.langevin.has_value();
    }
    void initializeLarge();
    void setArguments(Kernels& created);
    void setLargeArguments(Kernels& created);
    void setMixed(OpenMM::ComputeKernel& kernel, int index, double value);
    void setWide(OpenMM::ComputeKernel& kernel, int index, double value);
    void addLargeTables(OpenMM::ComputeKernel& kernel);
    void addLastState(OpenMM::ComputeKernel& kernel);
    void addNoiseState(OpenMM::ComputeKernel& kernel);
    void launch(OpenMM::ComputeKernel& kernel, int numOwnArguments);
    int nextStamp();
    int getMaxStages() const;
    int getNumProjections() const;
    void launchLarge(OpenMM::ComputeKernel& kernel, int step, int numStages);
    void launchFinish(int step, double kick, Control::Change change, bool isStored);
    void launchEvaluate(int step, Control::Change change, bool isReported);
    std::vector<double> readReport();
    bool clearFailure();
    void beginExpressionStep();
    Report undo(int numSteps, int code, bool hasSums);
    Report fill(const std::vector<double>& block);
    OpenMM::ComputeContext& context;
    std::unique_ptr<ExpressionSteps> expressions; // or null
    const ClusterLayout& layout;
    LargeClusters large;
    std::unique_ptr<NewtonSteps> newton; // or null, at first
    Settings settings;
    std::unique_ptr<StepProgram> program;
    bool isMixed, isWide; // mixed is double; there are doubles
    int groupSize;
    int numGroups; // of work, each of which leaves its sums
    int numPartials; // with the parts that have expressions and the pieces of large clusters, which leave theirs behind
    int numFused; // pieces among the work groups of the small clusters
    unsigned numLargeLaunches;
    long long numLaunches;
    std::vector<int> smallConstraints; // as they were given, in the order of lengths and multipliers
    // Which constraint, as given, is that of the molecule now in the place of another's; for that order of the atoms.
    std::vector<int> constraintInPlace, constraintOrder;
    int half; // the control block that is in force
    int stepNumber; // of the last advance()
    int numTrials; // launches for a density
    int64_t seed, numDrawn; // by the steps that the host knows of
    double groupEnergy;
    double elapsedRead, numStepsRead, numRescuesRead, stepSizeRead; // what the control block said when it was read last
    OpenMM::ComputeArray atoms, lengths, multipliers, settingsArray, control[2], trials[2], partials, trialPartials[2],
        jumpPartials, reportArray;
    OpenMM::ComputeArray oldPositions, oldVelocities, failure, iterationCounts, noise;
    OpenMM::ComputeArray lastForces, lastSquares, lastVelocities; // of automatic step control
    bool areVelocitiesKept;
    OpenMM::ComputeArray beforeLook[5]; // what computeHalfStepKineticEnergy() puts back
    OpenMM::ComputeArray largeTables, largePieces, largeRows, largeRowLengths, largeAtoms, largeJoints,
        largeJointLengths;
    OpenMM::ComputeArray largeMultipliers, largeFactors, largeWork, largeExchange, largePhases, largeIterations;
    std::map<std::string, Kernels> compiled; // by what the text depends on
    Kernels kernels;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_DEVICESTEPS_H_
