// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include "run/IntegratorRun.h"
#include <cmath>

using namespace OpenMMVRattle;

VariableStepRattleLangevinIntegrator::VariableStepRattleLangevinIntegrator(double temperature, double frictionCoeff,
                                                                           double stepSize) :
        ConstrainedIntegrator(IntegratorSettings(stepSize, LangevinSettings())) {
    setTemperature(temperature);
    setFriction(frictionCoeff);
}

VariableStepRattleLangevinIntegrator::VariableStepRattleLangevinIntegrator(
    const VariableStepRattleLangevinIntegrator& other) : ConstrainedIntegrator(*other.settings) {
}

VariableStepRattleLangevinIntegrator::~VariableStepRattleLangevinIntegrator() = default;

double VariableStepRattleLangevinIntegrator::getTemperature() const {
    return settings->langevin->temperature;
}

void VariableStepRattleLangevinIntegrator::setTemperature(double temp) {
    requirePositiveOrZero(temp, "temperature", "for no noise");
    settings->langevin->temperature = temp;
    settingsChanged();
}

double VariableStepRattleLangevinIntegrator::getFriction() const {
    return settings->langevin->friction;
}

void VariableStepRattleLangevinIntegrator::setFriction(double coeff) {
    requirePositiveOrZero(coeff, "friction coefficient", "for dynamics at constant energy");
    settings->langevin->friction = coeff;
    settingsChanged();
}

int VariableStepRattleLangevinIntegrator::getRandomNumberSeed() const {
    return settings->langevin->randomSeed;
}

void VariableStepRattleLangevinIntegrator::setRandomNumberSeed(int seed) {
    settings->langevin->randomSeed = seed;
    settingsChanged();
}

void VariableStepRattleLangevinIntegrator::setStepSize(double size) {
    takeStepSize(size);
}

int VariableStepRattleLangevinIntegrator::getMaximumSubsteps() const {
    return settings->langevin->getMaximumSubsteps();
}

void VariableStepRattleLangevinIntegrator::setMaximumSubsteps(int substeps) {
    LangevinSettings changed = *settings->langevin;
    for (changed.maxDoublings = 0; changed.maxDoublings <= LangevinSettings::MAX_DOUBLINGS; changed.maxDoublings++)
        if (changed.getMaximumSubsteps() == substeps) {
            *settings->langevin = changed;
            settingsChanged();
            return;
        }
    settings->refuse("the maximum number of substeps must be 1, or 2^k + 1 with k between 1 and ",
                     LangevinSettings::MAX_DOUBLINGS, " (3, 5, 9, 17, ...), not ", substeps);
}

long long VariableStepRattleLangevinIntegrator::getNumSubstepped() const {
    return run == nullptr ? 0 : run->getDevice().getCounts().substepped;
}

int VariableStepRattleLangevinIntegrator::getLargestSubsteps() const {
    return run == nullptr ? 1 : run->getDevice().getCounts().largestSubsteps;
}

double VariableStepRattleLangevinIntegrator::getReferenceMonitorValue() const {
    const double given = settings->langevin->reference;
    return run == nullptr || given > 0 ? given : run->getReference(0);
}

void VariableStepRattleLangevinIntegrator::setReferenceMonitorValue(double value) {
    requirePositiveOrZero(value, "reference value of the monitor", "to let it follow the run");
    settings->langevin->reference = value;
    settingsChanged();
}

void VariableStepRattleLangevinIntegrator::freezeReference(bool frozen) {
    settings->langevin->isReferenceFrozen = frozen;
    settingsChanged();
}

bool VariableStepRattleLangevinIntegrator::isReferenceFrozen() const {
    return settings->langevin->isReferenceFrozen;
}

double VariableStepRattleLangevinIntegrator::getMonitorValue() const {
    return requireRun().getMonitorValue(0);
}
