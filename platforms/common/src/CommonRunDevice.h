// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONRUNDEVICE_H_
#define OPENMMVRATTLE_COMMONRUNDEVICE_H_

#include "DeviceSteps.h"
#include "openmm/internal/ContextImpl.h"
#include "run/HostVRattleDevice.h"
#include <memory>

namespace OpenMMVRattle {

/**
 * The device for OpenCL, CUDA and HIP. The steps in the middle of a run are taken by the GPU (DeviceSteps), which nobody waits for
 * until the run settles. What is rare is done on the host with forces from the GPU: the start, the first step, a step that the GPU
 * could not complete, trial runs, turning around, saving. The two hand the state over to each other. What the GPU cannot do is
 * done on the host throughout: automatic step control, and constraints for which there are no kernels.
 */
class CommonRunDevice : public HostVRattleDevice {
public:
    CommonRunDevice(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute, const OpenMM::Integrator& integrator,
                    const IntegratorSettings& settings);
    void setSettings(const IntegratorSettings& settings) override;
    void setReferences(const std::vector<double>& references) override;
    bool updateState() override;
    Change findChange() override;
    unsigned long long getFingerprint() override;
    void start() override;
    void changeState() override;
    void changeVelocities() override;
    void changeForces() override;
    void writeVelocities() override;
    void step(double maxTime) override;
    void settle() override;
    void reverse() override;
    LastStep getLastStep() override;
    double getTime() override;
    void beginTrial(double stepSize, bool isBackwards) override;
    std::vector<double> getMonitorValues() override;
    std::vector<double> getMultipliers() override;
    double computeKineticEnergy() override;
    bool usesForcesOfOthers() override {
        return true;
    }
    long long getNumSolverIterations() override;
    long long getNumRescues() override;
    void save(RunState& run) override;
    bool resume(const RunState& run, const IntegratorSettings& saved, bool areForcesOthers) override;

protected:
    double computeForces() override;
    double getPositionRounding() const override;
    bool differ(const Vectors& a, const Vectors& b) override;

private:
    bool canStepOnDevice();
    void correctMasses();
    bool areForcesValid();
    void ensureForces();
    int getNumWrites() const;
    void readState();
    void beginOnDevice();
    void stepOnDevice(double maxTime);
    void accept(const DeviceSteps::Report& report);
    void bringToHost();
    void takeToHost();
    OpenMM::ContextImpl& context;
    OpenMM::ComputeContext& compute;
    std::unique_ptr<DeviceSteps> steps; // none where the host takes them all
    DeviceSteps::State state; // of the device when it was read last
    DeviceSteps::Report lastReport;
    bool isOnDevice;    // the state is that of the device, and goes on there
    bool hasBegun;      // the device has what it needs for the next step
    bool isOnHost;      // the host's state is the same
    bool areSettingsOnDevice, hasReport;
    int numAsked;       // steps since the last settle()
    int stepsUntilLook; // how many there may be
    double lastMaxTime; // of the last of them
    double settledTime;
    long long settledCount, knownCount;
    double groupEnergy; // of the last forces
    bool hasForces;     // of the state, unless what follows says otherwise
    int writeCount;     // of positions, when they were computed
    std::vector<int> order;  // of the atoms, likewise
    bool areAtomsReordered; // perhaps, since then
    long long numDeviceRescues;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONRUNDEVICE_H_
