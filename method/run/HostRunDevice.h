// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTRUNDEVICE_H_
#define OPENMMVRATTLE_HOSTRUNDEVICE_H_

#include "constraints/SharedWork.h"
#include "expressions/ExpressionGroup.h"
#include "openmm/System.h"
#include "run/ContextVectors.h"
#include "run/Fingerprint.h"
#include "run/ForceReach.h"
#include "run/RunDevice.h"
#include <limits>
#include <memory>
#include <optional>
#include <vector>

namespace OpenMMVRattle {

/**
 * A device that computes on the host: it moves data between the vectors of a Context and a method of integration, VRattleRun or
 * LangevinRun, and asks for the forces. It is all that a run needs on Reference and the platforms derived from it; on a GPU it does
 * what is rare, such as starts.
 *
 * A method computes no forces. A step of it is one or more passes of two halves, around an evaluation of the forces each:
 *
 *     do {
 *         method.step(maxStep);                              // new positions, getNextPositions()
 *         ... compute the forces there ...
 *     } while (!method.finish(forces, groupEnergy));         // the step is complete: new positions, velocities, forces
 *
 * Until finish() has returned true, the state before the step is untouched.
 */
template <class Method> class HostRunDevice : public RunDevice {
public:
    /**
     * @param system      must live as long as this
     * @param parallel    runs a task on so many threads, which share the work where that is faster
     */
    HostRunDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                  const IntegratorSettings& settings, const SharedWork::Parallel& parallel = {}, int numThreads = 1);
    void setSettings(const IntegratorSettings& settings) override;
    bool setParameters(const std::vector<ExpressionConstraint>& given) override;
    Findings getFindings() override {
        return method.getFindings();
    }
    void setFindings(const Findings& findings) override {
        method.setFindings(findings);
    }
    bool updateState() override {
        return vectors->updateState();
    }
    Change findChange() override;
    unsigned long long getFingerprint() override {
        return fingerprintOf(vectors->getVelocities(), masses, vectors->getBoxVectors());
    }
    unsigned long long getParameterFingerprint() override {
        return fingerprintOf(vectors->getParameters());
    }
    void start() override;
    void changeState() override;
    void changeVelocities() override;
    void writeVelocities() override;
    void changeForces() override;
    void step(double maxTime) override;
    void reverse() override;
    void tryOut(double stepSize, int count, const std::function<void(const std::vector<double>&)>& look) override;
    LastStep getLastStep() override {
        return lastStep;
    }
    double getTime() override {
        return vectors->getTime();
    }
    long long getStepCount() override {
        return vectors->getStepCount();
    }
    std::vector<double> getMonitorValues() override {
        return method.getMonitorValues();
    }
    std::vector<double> getMultipliers() override;
    double getExpressionMultiplier(int index) override;
    double computeKineticEnergy() override;
    double computeHalfStepKineticEnergy() override;
    double getNegligibleValue() override {
        return method.getNegligibleValue();
    }
    long long getNumForceEvaluations() override {
        return numForceEvaluations;
    }
    long long getNumSolverIterations() override {
        return method.getNumIterations();
    }
    StepCounts getCounts() override {
        return method.getCounts();
    }
    void save(RunState& run) override;
    bool canResume(const RunState& run, const IntegratorSettings& saved) override {
        return method.canResume(run, saved);
    }
    bool resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) override;

protected:
    typedef ContextVectors::Vectors Vectors;
    /** The Context, where it is not in the method's state: as the user or a Force has left it, until a step is complete. */
    struct Ahead {
        Vectors positions, velocities;
    };
    /** Compute the forces at the Context's positions; returns the energy of the monitor's group there. */
    virtual double computeForces();
    double computeForcesAt(const Vectors& positions, Vectors& forces);
    double advance(double maxTime);
    void putBack();
    void takeContext(bool isStart);
    void noteContext();
    bool isOtherBox();
    /** A number that is another one when any integrator has taken a step. */
    virtual long long getStepMark() {
        return vectors->getStepCount();
    }
    /** Whether another integrator (of a CompoundIntegrator) has taken steps. */
    bool haveOthersStepped() {
        return vectors->isSharedByIntegrators() && getStepMark() != stepMark;
    }
    static constexpr long long NO_MARK = std::numeric_limits<long long>::min();
    /** How far a position that is loaded may be from the one that was saved (nm). */
    virtual double getPositionRounding() const {
        return 0;
    }
    bool differ(const Vectors& a, const Vectors& b);
    void moveContext(const Vectors& positions);
    ContextVectors::Writer writerOf(const Vectors& from);
    std::unique_ptr<ContextVectors> vectors;
    const OpenMM::System& system;
    std::vector<double> masses;
    std::vector<ExpressionConstraint> expressions;
    Method method;
    int forceGroups = 0, energyGroup = -1;
    bool hasMassless;
    ForceReach reach;
    std::optional<Ahead> ahead;
    OpenMM::Vec3 boxVectors[3]; // when they were last looked at
    LastStep lastStep = {0, 1};
    long long stepMark = NO_MARK; // of the last step, or NO_MARK if others have taken some
    long long numForceEvaluations = 0;
};

/** The device for the method that the settings ask for. */
std::unique_ptr<RunDevice> makeHostRunDevice(std::unique_ptr<ContextVectors> vectors, const OpenMM::System& system,
                                             const IntegratorSettings& settings, const SharedWork::Parallel& parallel,
                                             int numThreads);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTRUNDEVICE_H_
