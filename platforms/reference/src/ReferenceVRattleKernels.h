// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
#define OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_

#include "openmm/reference/ReferencePlatform.h"
#include "openmmvrattle/VRattleKernels.h"
#include "step/VRattleDynamics.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * The kernel for the Reference platform and those derived from it (CPU). It moves data between the Context and
 * VRattleDynamics and asks for the forces.
 */
class ReferenceIntegrateVRattleStepKernel : public IntegrateVRattleStepKernel {
public:
    ReferenceIntegrateVRattleStepKernel(const std::string& name, const OpenMM::Platform& platform,
                                        OpenMM::ReferencePlatform::PlatformData& data) :
            IntegrateVRattleStepKernel(name, platform), data(data) {
    }
    void initialize(const OpenMM::System& system, const VariableStepRattleIntegrator& integrator) override;
    void settingsChanged() override;
    void stateChanged() override;
    double execute(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator, bool forcesInvalid,
                   double maxTime) override;
    void reverse(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator) override;
    std::vector<double> calibrate(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                                  int steps) override;
    unsigned long long getSystemFingerprint() const override;
    VRattleRunState saveRun(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator) override;
    void resumeRun(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                   const VRattleRunState& run) override;
    double computeKineticEnergy(OpenMM::ContextImpl& context) override;
    double getStepDensity() const override;
    double getReferenceMonitorValue(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                                    int index) override;
    double getMonitorValue(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator,
                           int index) override;
    std::vector<double> getMultipliers(OpenMM::ContextImpl& context,
                                       const VariableStepRattleIntegrator& integrator) override;
    long long getNumForceEvaluations() const override;
    long long getNumSolverIterations() const override;
    long long getNumRescues() const override;

private:
    void readSettings(const VariableStepRattleIntegrator& integrator);
    void readParametersOfExpressions(const VariableStepRattleIntegrator& integrator);
    void prepare(OpenMM::ContextImpl& context, const VariableStepRattleIntegrator& integrator, bool forcesInvalid);
    void startAfresh(OpenMM::ContextImpl& context);
    double computeForcesOnConstraints(OpenMM::ContextImpl& context, std::vector<OpenMM::Vec3>& positions,
                                      std::vector<OpenMM::Vec3>& forces);
    VRattleDynamics::Memory memoryOf(const VRattleRunState& run, bool isAutomatic) const;
    void takeRestored(OpenMM::ContextImpl& context);
    void startAutomatic(OpenMM::ContextImpl& context);
    VRattleDynamics& beginTrial(const VRattleDynamics::Settings& trialSettings, double direction);
    void takeTrialStep(OpenMM::ContextImpl& context, VRattleDynamics& method);
    std::vector<double> findAutomaticReferences(OpenMM::ContextImpl& context, int steps);
    void startFromTrialSteps(OpenMM::ContextImpl& context);
    bool areForcesAsRestored(OpenMM::ContextImpl& context);
    unsigned long long fingerprintOfContext() const;
    void noteContext();
    const std::vector<OpenMM::Vec3>& knownPositions() const;
    const std::vector<OpenMM::Vec3>& knownVelocities() const;
    double advance(OpenMM::ContextImpl& context, VRattleDynamics& method, double maxStep);
    void putBack(OpenMM::ContextImpl& context);
    double computeForces(OpenMM::ContextImpl& context);
    bool haveBoxVectorsChanged();
    bool differ(const std::vector<OpenMM::Vec3>& a, const std::vector<OpenMM::Vec3>& b) const;
    void writeMoving(const std::vector<OpenMM::Vec3>& from, std::vector<OpenMM::Vec3>& to) const;
    OpenMM::ReferencePlatform::PlatformData& data;
    std::vector<double> masses;
    std::vector<DistanceConstraint> constraints;
    std::vector<ExpressionConstraint> expressions;
    bool areExpressionsOutdated; // the integrator's are others by now
    unsigned long long systemFingerprint;
    std::unique_ptr<VRattleDynamics> dynamics;
    VRattleDynamics::Settings settings;
    int calibrationSteps; // of automatic step control
    std::unique_ptr<VRattleDynamics> trial; // takes trial steps, once they are needed
    OpenMM::Vec3 boxVectors[3];
    int forceGroups, monitorForceGroup;
    bool areSettingsChanged, isStateChanged;
    bool hasMassless, mayForcesChangePositions, mayForcesChangeVelocities;
    // The method's state is on the constraints; the Context's may not be, and is left as the user or a Force has made it
    // until the next step is complete. Then these hold what the Context has.
    bool isContextAhead;
    std::vector<OpenMM::Vec3> contextPositions, contextVelocities;
    // A run to go on from, until it is needed: only then can the forces be compared with its own.
    std::unique_ptr<VRattleRunState> restored;
    VRattleDynamics::Memory restoredMemory;
    double lastDensity;
    long long numForceEvaluations;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
