// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTRUNDEVICE_H_
#define OPENMMVRATTLE_HOSTRUNDEVICE_H_

#include "constraints/SharedWork.h"
#include "expressions/ExpressionGroup.h"
#include "openmm/System.h"
#include "run/ContextVectors.h"
#include "run/ForceReach.h"
#include "run/RunDevice.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * A device that computes on the host: it moves data between the vectors of a Context and a method of integration, and asks for the
 * forces. What is particular to a method is in the classes derived from this one, which are all that a run needs on Reference and
 * the platforms derived from it; on a GPU they do what is rare, such as starts.
 *
 * A method computes no forces. A step of it is one or more passes of two halves, around an evaluation of the forces each:
 *
 *     do {
 *         method.step(maxStep);                              // new positions, getNextPositions()
 *         ... compute the forces there ...
 *     } while (!method.finish(forces, groupEnergy));         // the step is complete: new positions, velocities, forces
 *
 * Until finish() has returned true, the state before the step is untouched. What else there is to a method: VRattleRun.
 */
template <class Method> class HostRunDevice : public RunDevice {
public:
    /** @param system    must live as long as this */
    HostRunDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                  const IntegratorSettings& settings);
    /** Let threads share the work where that is faster. */
    void setParallel(const SharedWork::Parallel& parallel, int numThreads) {
        method.setParallel(parallel, numThreads);
    }
    void setSettings(const IntegratorSettings& settings) override;
    bool setParameters(const std::vector<ExpressionConstraint>& given) override;
    std::vector<double> getReferences() override {
        return method.getReferences();
    }
    void setReferences(const std::vector<double>& references) override {
        method.setReferences(references);
    }
    bool updateState() override {
        return vectors->updateState();
    }
    Change findChange() override;
    unsigned long long getFingerprint() override;
    unsigned long long getParameterFingerprint() override;
    void start() override;
    void changeState() override;
    void changeVelocities() override;
    void writeVelocities() override;
    void changeForces() override;
    void step(double maxTime) override;
    void settle() override {
    }
    void reverse() override;
    LastStep getLastStep() override {
        return lastStep;
    }
    double getTime() override {
        return vectors->getTime();
    }
    long long getStepCount() override {
        return vectors->getStepCount();
    }
    std::vector<double> getMultipliers() override;
    double getExpressionMultiplier(int index) override;
    double computeKineticEnergy() override;
    long long getNumForceEvaluations() override {
        return numForceEvaluations;
    }
    long long getNumSolverIterations() override {
        return method.getNumIterations();
    }
    void save(RunState& run) override;
    bool resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) override;

protected:
    typedef ContextVectors::Vectors Vectors;
    /** An on-step state that satisfies the constraints. */
    struct State {
        const Vectors &positions, &velocities, &forces;
        double groupEnergy;
    };
    /** Give the method its settings, but for the parameters of expressions. */
    virtual void setMethod(const IntegratorSettings& settings) = 0;
    /** Write down what the method goes on with beside the state. */
    virtual void saveMethod(RunState& run) = 0;
    /** Let the method go on from a saved run. */
    virtual void resumeMethod(const State& state, const RunState& run, const IntegratorSettings& saved) = 0;
    /** The Context, where it is not in the method's state: as the user or a Force has left it, until a step is complete. */
    struct Ahead {
        Vectors positions, velocities;
    };
    /** Compute the forces at the Context's positions; returns the energy of the monitor's group there. */
    virtual double computeForces();
    double computeForcesAt(const Vectors& positions, Vectors& forces);
    double advance(double maxTime, double direction);
    void putBack();
    const Vectors& knownPositions() const;
    const Vectors& knownVelocities() const;
    /** How far a position that is loaded may be from the one that was saved (nm). */
    virtual double getPositionRounding() const {
        return 0;
    }
    std::vector<double> sumPositions();
    /** Whether two sets of positions or velocities are others, for the particles that move. */
    virtual bool differ(const Vectors& a, const Vectors& b);
    void writeMovingPositions(const Vectors& positions);
    void writeMovingVelocities(const Vectors& velocities);
    void copyMoving(const Vectors& from, Vectors& to);
    std::unique_ptr<ContextVectors> vectors;
    const OpenMM::System& system;
    std::vector<double> masses;
    std::vector<char> isVirtualSite;
    std::vector<ExpressionConstraint> expressions;
    Method method;
    int forceGroups, monitorForceGroup;
    bool hasMassless;
    ForceReach reach;
    std::unique_ptr<Ahead> ahead;
    OpenMM::Vec3 boxVectors[3]; // when they were last looked at
    LastStep lastStep;
    long long numForceEvaluations;
};

/**
 * The device for the method that the settings ask for.
 *
 * @param parallel    runs a task on several threads; or empty
 */
std::unique_ptr<RunDevice> makeHostRunDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                                             const IntegratorSettings& settings,
                                             const SharedWork::Parallel& parallel = {}, int numThreads = 1);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTRUNDEVICE_H_
