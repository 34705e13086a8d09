// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/IntegratorSettings.h"
#include "openmm/OpenMMException.h"
#include <algorithm>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;

namespace {

// The bounds' defaults as fractions of the nominal step size.
const double DEFAULT_MINIMUM_FACTOR = 1.0 / 50.0;
const double DEFAULT_MAXIMUM_FACTOR = 2.0;
const double AUTOMATIC_MINIMUM_FACTOR = 1e-3; // of automatic step control

} // namespace

IntegratorSettings::IntegratorSettings(double stepSize) : stepSize(stepSize) {
    monitors.push_back({StepMonitor::ConstraintMultipliers, 1.0, 1.0, 0.0});
}

IntegratorSettings::IntegratorSettings(double stepSize, const LangevinSettings& langevin) :
        stepSize(stepSize), isDefaultMonitor(false), langevin(langevin) {
}

double IntegratorSettings::getMinimumStep() const {
    const double factor = isAutomatic ? AUTOMATIC_MINIMUM_FACTOR : DEFAULT_MINIMUM_FACTOR;
    return minimumStep == USE_DEFAULT ? factor * stepSize : minimumStep;
}

double IntegratorSettings::getMaximumStep() const {
    return maximumStep == USE_DEFAULT ? DEFAULT_MAXIMUM_FACTOR * stepSize : maximumStep;
}

bool IntegratorSettings::usesMonitorForceGroup() const {
    return std::any_of(monitors.begin(), monitors.end(),
                       [](const StepMonitor::Term& term) { return term.kind == StepMonitor::ForceGroupEnergy; });
}

int IntegratorSettings::getActingForceGroups() const {
    return usesMonitorForceGroup() ? forceGroups & ~(1 << monitorForceGroup) : forceGroups;
}

void IntegratorSettings::fitDefaultMonitor(bool hasConstraints) {
    if (isDefaultMonitor)
        monitors[0].kind = hasConstraints ? StepMonitor::ConstraintMultipliers : StepMonitor::ConstraintAndAppliedForce;
}

bool IntegratorSettings::isConsistent() const {
    const double minimum = getMinimumStep(), maximum = getMaximumStep();
    return langevin || stepSize == 0 || (minimum < stepSize && (isAutomatic || maximum == 0 || stepSize < maximum));
}

void IntegratorSettings::requireConsistent() const {
    if (isConsistent())
        return;
    std::stringstream message;
    message << getIntegratorName() << ": the minimum step size (" << getMinimumStep()
            << " ps) must be smaller than the nominal one (" << stepSize << " ps)";
    if (!isAutomatic)
        message << ", and the maximum step size (" << getMaximumStep()
                << " ps) larger than the nominal one, or 0 for no bound";
    throw OpenMMException(message.str());
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
