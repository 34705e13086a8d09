// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_INTEGRATORSETTINGS_H_
#define OPENMMVRATTLE_INTEGRATORSETTINGS_H_

#include "expressions/ExpressionGroup.h"
#include "step/AutomaticControl.h"
#include "step/LangevinSettings.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <optional>
#include <vector>

namespace OpenMMVRattle {

/**
 * Everything that a user has chosen of one of the integrators, as one value: what XML stores, copies share, saved runs
 * bring back and devices are given. Numbers that the run finds by itself are not in it.
 */
struct IntegratorSettings {
    static constexpr double USE_DEFAULT = -1;
    static constexpr double DEFAULT_NORM_ORDER = 8;
    static constexpr int DEFAULT_CALIBRATION_STEPS = 30;

    double stepSize = 0;               // the nominal step (ps); 0 where no step is to be taken
    double minimumStep = USE_DEFAULT;  // bounds (ps), 0 for none; see getMinimumStep()
    double maximumStep = USE_DEFAULT;
    double constraintTolerance = 1e-8; // relative
    StepDensity::Update update = StepDensity::SemiExplicit;
    int forceGroups = -1;              // a bit for each group that acts, the monitor's perhaps among them

    // A reference of 0 is taken at the first step. Nobody has chosen the default monitor, so it is made to fit the System.
    std::vector<StepMonitor::Term> monitors;
    bool isDefaultMonitor = true;
    int monitorForceGroup = 31;
    double normOrder = DEFAULT_NORM_ORDER; // of monitors that are added without one

    // Automatic step control, in place of monitors, update and maximum. A reference of 0 stands for the one in force.
    bool isAutomatic = false;
    int calibrationSteps = DEFAULT_CALIBRATION_STEPS;
    double automaticReferences[AutomaticControl::NUM_MONITORS] = {};
    int automaticRequest = 0; // changes when references in force are to be forgotten

    // Constant temperature, in place of all that varies the step.
    std::optional<LangevinSettings> langevin;

    std::vector<ExpressionConstraint> expressions;

    /** @param stepSize    the nominal step (ps) */
    explicit IntegratorSettings(double stepSize);
    /** @param langevin    at which temperature, and how */
    IntegratorSettings(double stepSize, const LangevinSettings& langevin);
    /** The class of the integrator that has such settings, which is what messages begin with. */
    const char* getIntegratorName() const {
        return langevin ? "VariableStepRattleLangevinIntegrator" : "VariableStepRattleIntegrator";
    }
    /** The seed of random numbers; 0 where there is none, or each Context has another one. */
    int getRandomSeed() const {
        return langevin ? langevin->randomSeed : 0;
    }
    void setRandomSeed(int seed) {
        if (langevin)
            langevin->randomSeed = seed;
    }
    /** The bounds in force (ps), 0 for none; those that were not set follow the nominal step. */
    double getMinimumStep() const;
    double getMaximumStep() const;
    /** The number of values and references: of the monitors, of automatic step control, or U_ref at constant temperature. */
    int getNumReferences() const {
        return langevin ? 1 : isAutomatic ? AutomaticControl::NUM_MONITORS : (int) monitors.size();
    }
    /** The reference value that was set; 0 if there is none. */
    double& reference(int index) {
        return langevin ? langevin->reference : isAutomatic ? automaticReferences[index] : monitors[index].reference;
    }
    double getReference(int index) const {
        return const_cast<IntegratorSettings*>(this)->reference(index);
    }
    /** Whether a monitor is the energy of a force group. */
    bool usesMonitorForceGroup() const;
    /** A bit for each force group that acts: those that were chosen, without the monitor's. */
    int getActingForceGroups() const;
    /** Give the default monitor the kind that the System can have, unless the user has chosen monitors. */
    void fitDefaultMonitor(bool hasConstraints);
    /** Whether the bounds lie on either side of the nominal step, where there is one and they have an effect. */
    bool isConsistent() const;
    /** Throw an OpenMMException unless isConsistent(). */
    void requireConsistent() const;
    /** Whether both have the same constraints by expressions, but for the values of their parameters. */
    bool hasSameConstraints(const IntegratorSettings& other) const;
};

/** Whether two constraints are the same but for the values of their parameters. */
bool haveSameParts(const ExpressionConstraint& a, const ExpressionConstraint& b);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_INTEGRATORSETTINGS_H_
