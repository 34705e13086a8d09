// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONRUNDEVICE_H_
#define OPENMMVRATTLE_COMMONRUNDEVICE_H_

#include "DeviceSteps.h"
#include "ExpressionInfo.h"
#include "ForceActions.h"
#include "openmm/internal/ContextImpl.h"
#include "run/HostRunDevice.h"
#include "run/RunState.h"
#include <limits>
#include <memory>

namespace OpenMMVRattle {

/**
 * The device for OpenCL, CUDA and HIP. The steps in the middle of a run are taken by the GPU (DeviceSteps), which nobody waits for
 * until the run settles. What is rare is done on the host with forces from the GPU: the start, the first step, a step that the GPU
 * could not complete, trial runs, turning around, saving. The two hand the state over to each other. What the GPU cannot do is
 * done on the host throughout, such as constraints for which there are no kernels.
 *
 * What is particular to a method is in the classes derived from this one.
 */
template <class Method> class CommonRunDevice : public HostRunDevice<Method> {
public:
    CommonRunDevice(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute, const OpenMM::Integrator& integrator,
                    const IntegratorSettings& settings);
    void setSettings(const IntegratorSettings& settings) override;
    bool setParameters(const std::vector<ExpressionConstraint>& given) override;
    void setFindings(const Findings& findings) override;
    bool updateState() override;
    RunDevice::Change findChange() override;
    unsigned long long getFingerprint() override;
    void start() override;
    void changeState() override;
    void changeVelocities() override;
    void changeForces() override;
    void writeVelocities() override;
    void step(double maxTime) override;
    void settle() override;
    void reverse() override;
    void tryOut(double stepSize, int count, const std::function<void(const std::vector<double>&)>& look) override;
    RunDevice::LastStep getLastStep() override;
    double getTime() override;
    std::vector<double> getMonitorValues() override;
    std::vector<double> getMultipliers() override;
    double getExpressionMultiplier(int index) override;
    double computeKineticEnergy() override;
    bool usesForcesOfOthers() override {
        return true;
    }
    double computeHalfStepKineticEnergy() override;
    long long getNumSolverIterations() override;
    StepCounts getCounts() override;
    bool hasSteppedOnDevice() override {
        return hasStepped;
    }
    void save(RunState& run) override;
    bool resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) override;

protected:
    typedef HostRunDevice<Method> Host;
    typedef typename Host::Vectors Vectors;
    using Host::ahead;
    using Host::expressions;
    using Host::forceGroups;
    using Host::hasMassless;
    using Host::haveOthersStepped;
    using Host::lastStep;
    using Host::masses;
    using Host::method;
    using Host::reach;
    using Host::stepMark;
    using Host::vectors;
    double computeForces() override;
    double getPositionRounding() const override;
    long long getStepMark() override;
    /** Whether the method's next step is one that the GPU can take: all of its numbers are known. */
    virtual bool canGoOnDevice() = 0;
    /** The settings in force, for the GPU. */
    virtual DeviceSteps::Settings makeDeviceSettings() = 0;
    /** What there is of the host's state beside positions, velocities and forces. */
    virtual DeviceSteps::State makeDeviceState() = 0;
    /** Let the host go on with the state of the GPU, an on-step state that satisfies the constraints. */
    virtual void adopt(const Vectors& positions, const Vectors& velocities, const Vectors& forces, double energy,
                       const DeviceSteps::State& others) = 0;
    /** Let the host know what a start depends on, though the state that it starts from is another. */
    virtual void carryOn(const DeviceSteps::State&) {
    }
    /** Whether it matters that all velocities have changed by the same. */
    virtual bool doesFrameMatter() = 0;
    /** theta[n] of the device's state. */
    ExpressionParameters getDeviceParameters();
    /** How many steps may be done in vain because one before them has failed. */
    virtual int getMostStepsUntilLook() const {
        return std::numeric_limits<int>::max();
    }
    /** What the GPU has beside the monitors, if it is there that the state is; else null. */
    const DeviceSteps::State* findDeviceState();
    void bringToHost();
    void takeToHost();

private:
    bool canStepOnDevice();
    bool areNumbersOnDevice();
    void correctMasses();
    bool areAtomsReordered() const {
        return numReorderings != orderReorderings;
    }
    bool areForcesValid();
    void ensureForces();
    int getNumWrites() const;
    void takeTurn();
    void changeOnDevice(Control::Change change);
    void resolveChange();
    void repeatActions();
    void tellOfParameters();
    void beginOnDevice();
    void stepOnDevice(double maxTime);
    void accept(const DeviceSteps::Report& report);
    void reorderAtoms();
    void restoreOrder();
    OpenMM::ContextImpl& context;
    OpenMM::ComputeContext& compute;
    ForceActions actions;
    std::vector<ExpressionConstraint> knownExpressions; // to the Context, by the next
    ExpressionInfo* expressionInfo;                     // of the Context, or null
    std::unique_ptr<DeviceSteps> steps; // none where the host takes them all
    DeviceSteps::State state; // of the device when it was read last
    DeviceSteps::Report lastReport;
    bool isOnDevice;    // the state is that of the device, and goes on there
    bool hasBegun;      // the device has what it needs for the next step
    bool isOnHost;      // the host's state is the same
    bool areSettingsOnDevice, hasReport;
    bool isChangePending = false; // since the last step; whether the device could go on with it nobody has looked at
    bool haveActed = false;       // Forces, since the last look for a change
    bool areParametersNew = false; // what the next step leads to may be others than the device knows
    bool hasStepped = false; // by the last step()
    int numAsked;       // steps since the last settle()
    int stepsUntilLook; // how many there may be
    double lastMaxTime; // of the last of them
    double settledTime;
    long long settledCount;
    double groupEnergy; // of the last forces
    bool hasForces;     // of the state, unless what follows says otherwise
    int writeCount;     // of positions, when they were computed
    int numReorderings;   // of the atoms, perhaps
    std::vector<int> order; // the last one, when forces were computed
    int orderReorderings;   // and their number then
    int reorderedStep; // of those asked for, the last after which the atoms were put into another order; 0 for none
    std::vector<int> lastOrder; // the one before
    std::vector<OpenMM::mm_int4> lastOffsets;
    long long numDeviceRescues;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONRUNDEVICE_H_
