// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_INTEGRATORSETTINGS_H_
#define OPENMMVRATTLE_INTEGRATORSETTINGS_H_

#include "expressions/ExpressionGroup.h"
#include "openmm/OpenMMException.h"
#include "step/StepSettings.h"
#include <sstream>
#include <vector>

namespace OpenMMVRattle {

/**
 * Everything that a user has chosen of one of the integrators, as one value: what XML stores, copies share, saved runs
 * bring back and devices are given, the methods' own settings among it. Numbers that the run finds by itself are not in it.
 */
struct IntegratorSettings : StepSettings {
    static constexpr double DEFAULT_NORM_ORDER = 8;
    static constexpr int DEFAULT_CALIBRATION_STEPS = 30;
    static constexpr int NO_GROUP = -1;

    int forceGroups = -1;         // a bit for each group that acts, the monitor's perhaps among them
    bool isDefaultMonitor = true; // nobody has chosen it, so it is made to fit the System
    int monitorForceGroup = 31;
    double normOrder = DEFAULT_NORM_ORDER; // of monitors that are added without one

    std::vector<ExpressionConstraint> expressions;

    /** @param stepSize    the nominal step (ps) */
    explicit IntegratorSettings(double stepSize);
    /** @param langevin    at which temperature, and how */
    IntegratorSettings(double stepSize, const LangevinSettings& langevin);
    /** The class of the integrator that has such settings, which is what messages begin with. */
    const char* getIntegratorName() const {
        return langevin ? "VariableStepRattleLangevinIntegrator" : "VariableStepRattleIntegrator";
    }
    /** Throw an OpenMMException with a message that begins with that and goes on with these parts. */
    template <class... Parts> [[noreturn]] void refuse(const Parts&... parts) const {
        std::ostringstream message;
        message << getIntegratorName() << ": ";
        (message << ... << parts);
        throw OpenMM::OpenMMException(message.str());
    }
    /** The same unless something holds. */
    template <class... Parts> void require(bool holds, const Parts&... parts) const {
        if (!holds)
            refuse(parts...);
    }
    /** The seed of random numbers; 0 where there is none, or each Context has another one. */
    int getRandomSeed() const {
        return langevin ? langevin->randomSeed : 0;
    }
    void setRandomSeed(int seed) {
        if (langevin)
            langevin->randomSeed = seed;
    }
    /** The number of values and references: of the monitors, of automatic step control, or U_ref at constant temperature. */
    int getNumReferences() const {
        return langevin ? 1 : isAutomatic ? AutomaticControl::NUM_MONITORS : (int) terms.size();
    }
    /** The reference value that was set; 0 if there is none. */
    double& reference(int index) {
        return langevin ? langevin->reference : isAutomatic ? automaticReferences[index] : terms[index].reference;
    }
    double getReference(int index) const {
        return const_cast<IntegratorSettings*>(this)->reference(index);
    }
    /** Whether a monitor is the energy of a force group. */
    bool usesMonitorForceGroup() const;
    /** The force group of whose energy monitors need to know, or NO_GROUP. */
    int getEnergyGroup() const {
        return usesMonitorForceGroup() ? monitorForceGroup : NO_GROUP;
    }
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
