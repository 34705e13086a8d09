// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/IntegratorSettings.h"
#include <algorithm>

using namespace OpenMMVRattle;

IntegratorSettings::IntegratorSettings(double size) {
    stepSize = size;
    minimumStep = maximumStep = USE_DEFAULT;
    calibrationSteps = DEFAULT_CALIBRATION_STEPS;
    terms.push_back({StepMonitor::ConstraintMultipliers, 1.0, 1.0, 0.0});
}

IntegratorSettings::IntegratorSettings(double size, const LangevinSettings& settings) : isDefaultMonitor(false) {
    stepSize = size;
    langevin = settings;
}

bool IntegratorSettings::usesMonitorForceGroup() const {
    return std::any_of(terms.begin(), terms.end(),
                       [](const StepMonitor::Term& term) { return term.kind == StepMonitor::ForceGroupEnergy; });
}

int IntegratorSettings::getActingForceGroups() const {
    return usesMonitorForceGroup() ? forceGroups & ~(1 << monitorForceGroup) : forceGroups;
}

void IntegratorSettings::fitDefaultMonitor(bool hasConstraints) {
    if (isDefaultMonitor)
        terms[0].kind = hasConstraints ? StepMonitor::ConstraintMultipliers : StepMonitor::ConstraintAndAppliedForce;
}

bool IntegratorSettings::isConsistent() const {
    const double minimum = getMinimumStep(), maximum = getMaximumStep();
    return langevin || stepSize == 0 || (minimum < stepSize && (isAutomatic || maximum == 0 || stepSize < maximum));
}

void IntegratorSettings::requireConsistent() const {
    std::ostringstream maximum;
    if (!isAutomatic)
        maximum << ", and the maximum step size (" << getMaximumStep()
                << " ps) larger than the nominal one, or 0 for no bound";
    require(isConsistent(), "the minimum step size (", getMinimumStep(), " ps) must be smaller than the nominal one (",
            stepSize, " ps)", maximum.str());
}

bool OpenMMVRattle::haveSameParts(const ExpressionConstraint& a, const ExpressionConstraint& b) {
    auto haveSameNames = [](const auto& x, const auto& y) { return x.first == y.first; };
    return a.expression == b.expression && a.particles == b.particles &&
           std::equal(a.parameters.begin(), a.parameters.end(), b.parameters.begin(), b.parameters.end(),
                      haveSameNames);
}

bool IntegratorSettings::hasSameConstraints(const IntegratorSettings& other) const {
    return std::equal(expressions.begin(), expressions.end(), other.expressions.begin(), other.expressions.end(),
                      haveSameParts);
}
