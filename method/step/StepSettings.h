// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPSETTINGS_H_
#define OPENMMVRATTLE_STEPSETTINGS_H_

#include "step/AutomaticControl.h"
#include "step/LangevinSettings.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <optional>
#include <vector>

namespace OpenMMVRattle {

/** What a user can choose of steps, variable ones or those of Langevin dynamics: all that a method takes, as one value. */
struct StepSettings {
    static constexpr double USE_DEFAULT = -1;

    double stepSize = 0; // the nominal step h (ps); 0 where no step is to be taken
    // The bounds (ps): 0 for none, and USE_DEFAULT for those that follow the nominal step.
    double minimumStep = 0, maximumStep = 0;
    double tolerance = 1e-8; // of the constraints, relative
    StepDensity::Update update = StepDensity::SemiExplicit;
    std::vector<StepMonitor::Term> terms; // the monitors; a reference of 0 is taken at the first step
    bool isFixedStep = false;             // rho = 1 whatever the monitors say (a trial run)
    // Automatic step control, in place of monitors, update and maximum. A reference of 0 stands for the one in force.
    bool isAutomatic = false;
    double automaticReferences[AutomaticControl::NUM_MONITORS] = {};
    int automaticRequest = 0; // changes when references in force are to be forgotten
    int calibrationSteps = 1; // how many steps the references are found from
    // Constant temperature, in place of all that varies the step.
    std::optional<LangevinSettings> langevin = {};

    /** The bounds in force (ps), 0 for none. */
    double getMinimumStep() const {
        const double factor = isAutomatic ? 1e-3 : 1.0 / 50;
        return minimumStep == USE_DEFAULT ? factor * stepSize : minimumStep;
    }
    double getMaximumStep() const {
        return maximumStep == USE_DEFAULT ? 2 * stepSize : maximumStep;
    }
    /** The recursion of the density of monitors. */
    StepDensity getDensity() const {
        return stepSize > 0 ? StepDensity(update, stepSize, getMinimumStep(), getMaximumStep()) : StepDensity();
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPSETTINGS_H_
