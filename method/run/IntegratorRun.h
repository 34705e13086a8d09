// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_INTEGRATORRUN_H_
#define OPENMMVRATTLE_INTEGRATORRUN_H_

#include "run/IntegratorSettings.h"
#include "run/RunDevice.h"
#include "run/RunState.h"
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace OpenMMVRattle {

class StepFailure;

/**
 * A run in a Context: takes note of changes, starts, steps, tries steps out, saves, goes on from what was saved, and says what failed.
 * It is the same for all platforms and does nothing itself; a RunDevice does.
 */
class IntegratorRun {
public:
    /**
     * @param device          does the work; must live as long as the run
     * @param settings        of the integrator, whose changes settingsChanged() announces; must live as long as the run
     * @param numParticles    of the System
     * @param system          fingerprintOf() the System (Fingerprint.h)
     */
    IntegratorRun(RunDevice& device, const IntegratorSettings& settings, int numParticles, unsigned long long system);

    /** Take note that the settings have changed; they are in force with the next step. */
    void settingsChanged();
    /** Take note that values of parameters of expressions have changed, which the next step leads to. */
    void parametersChanged();
    /** Take note that the nominal step has been set: it is what getStepSize() returns until a step is taken. */
    void nominalStepChanged();
    /** Take note that the user has changed the Context: unless it is in the state of a saved run, the next step starts afresh. */
    void stateChanged();
    /** Take note that parameters of Forces have changed: the next step goes on with their forces, which cost one more evaluation. */
    void forcesChanged();

    /** Go on from what resume() was given, if the Context is still in that state. Before a step this comes by itself. */
    void takeSaved();
    void step(int count);
    void stepTo(double time);
    void reverse();
    /** What takes back all that will have been announced since: for changes of the Context that are undone. */
    std::function<void()> keepTask();
    /**
     * Let the Context have other velocities, and move them onto the constraints as a start does. Where no run can start with them,
     * all is as before.
     */
    void replaceVelocities(const std::function<void()>& set, const std::function<void()>& putBack);
    /** The mean of each monitor over a trial run from the current state, which stays as it is. */
    std::vector<double> calibrate(int steps);

    /** Of the most recent step, or the nominal one. */
    double getStepSize();
    double getStepDensity();
    /** The reference value in force, 0 if there is none yet. */
    double getReference(int index);
    double getMonitorValue(int index);
    std::vector<double> getMultipliers();
    double getExpressionMultiplier(int index);
    /** As of the device, with a seed that has been set since the last step. */
    std::vector<double> getRandomState();
    /** What is reported as the kinetic energy of the Context; at constant temperature it is one of the method's state. */
    double computeKineticEnergy();
    RunDevice& getDevice() {
        return device;
    }
    unsigned long long getSystemFingerprint() const {
        return system;
    }

    RunState save();
    /**
     * Throw an OpenMMException if the parts of a saved run do not fit together, or its settings cannot be used here.
     *
     * @param saved    the settings that were saved with it
     */
    void requireUsable(const RunState& run, const IntegratorSettings& saved) const;
    /**
     * Go on from a saved run whose settings are those of the integrator by now. Where the Context is not in its state at the next step,
     * or the masses and constraints are others, or the forces turn out to be others, the run starts afresh with the saved
     * reference values.
     */
    void resume(const RunState& run);

private:
    /** What is to be done before the next step, from the least to the greatest. */
    enum class Task { None, ChangeVelocities, ChangeState, Start };
    void requireStepSize() const;
    [[noreturn]] void fail(const std::string& what, const StepFailure& failure, const std::string& wayOut = "") const;
    bool areConstraintsOthers() const;
    bool canTakeSettings() const;
    void takeSettings();
    void takeForcesOfOthers();
    void prepare(bool areForcesInvalid, bool isForStep = false);
    void findTask(bool areForcesInvalid, bool isForStep);
    void fulfilTask();
    Findings getFindings();
    void askForStep(double maxTime);
    template <class Ask> void takeSteps(Ask ask);
    RunDevice& device;
    const IntegratorSettings& settings;
    IntegratorSettings applied; // those that the device has
    const int numParticles;
    const unsigned long long system;
    bool areSettingsChanged;
    bool areValuesChanged = false; // of parameters of expressions
    bool isAtStart;        // no step has been taken since the last start
    bool areParametersNew; // those of expressions, since the last step or start
    bool areForcesChanged; // since the last step; of no interest where the task computes them anyway
    Task task;
    std::unique_ptr<RunState> saved; // to go on from, until it is known whether the Context is in its state
    // What is to be said of the last step, where the device does not know it.
    std::optional<double> toldSize, toldDensity;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_INTEGRATORRUN_H_
