// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ForceActions.h"
#include "DeviceSources.h"
#include "StepProgram.h"
#include "openmm/AndersenThermostat.h"
#include "openmm/CMMotionRemover.h"
#include "openmm/MonteCarloAnisotropicBarostat.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/MonteCarloFlexibleBarostat.h"
#include "openmm/MonteCarloMembraneBarostat.h"
#include "openmm/common/ContextSelector.h"
#include "openmm/internal/AndersenThermostatImpl.h"
#include "openmm/internal/ForceImpl.h"
#include "openmm/reference/SimTKOpenMMRealType.h"

using namespace OpenMMVRattle;
using OpenMM::AndersenThermostat;
using OpenMM::ForceImpl;
using std::vector;

namespace {

template <class Barostat> int frequencyOf(const OpenMM::Force& force) {
    const auto* barostat = dynamic_cast<const Barostat*>(&force);
    return barostat == nullptr ? 0 : barostat->getFrequency();
}

// In how many updates a Force tries another box once; 0 if it is no barostat, or does nothing.
int findFrequency(const OpenMM::Force& force) {
    return frequencyOf<OpenMM::MonteCarloBarostat>(force) + frequencyOf<OpenMM::MonteCarloAnisotropicBarostat>(force) +
           frequencyOf<OpenMM::MonteCarloFlexibleBarostat>(force) +
           frequencyOf<OpenMM::MonteCarloMembraneBarostat>(force);
}

bool isThermostat(const ForceImpl& impl) {
    return dynamic_cast<const OpenMM::AndersenThermostatImpl*>(&impl) != nullptr;
}

} // namespace

ForceActions::ForceActions(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute) :
        context(context), compute(compute), updatesSinceTrial(context.getForceImpls().size(), 0) {
}

// Barostats count updates, those in which the frequency is 0 too.
bool ForceActions::isTrialNext() const {
    const vector<ForceImpl*>& impls = context.getForceImpls();
    for (size_t i = 0; i < impls.size(); i++) {
        const int frequency = findFrequency(impls[i]->getOwner());
        if (frequency > 0 && updatesSinceTrial[i] + 1 >= frequency)
            return true;
    }
    return false;
}

bool ForceActions::update(OpenMM::ComputeArray* control) {
    const vector<ForceImpl*>& impls = context.getForceImpls();
    bool areForcesInvalid = false;
    for (size_t i = 0; i < impls.size(); i++) {
        const int frequency = findFrequency(impls[i]->getOwner());
        updatesSinceTrial[i]++;
        if (frequency > 0 && updatesSinceTrial[i] >= frequency)
            updatesSinceTrial[i] = 0;
        if (control != nullptr && isThermostat(*impls[i]))
            collide(*control);
        else
            impls[i]->updateContextState(context, areForcesInvalid);
    }
    return areForcesInvalid;
}

void ForceActions::repeat() {
    bool isIgnored = false;
    for (ForceImpl* impl : context.getForceImpls())
        if (isThermostat(*impl) || dynamic_cast<const OpenMM::CMMotionRemover*>(&impl->getOwner()) != nullptr)
            impl->updateContextState(context, isIgnored);
}

void ForceActions::initializeThermostat() {
    const bool isWide = compute.getSupportsDoublePrecision();
    OpenMM::ComputeProgram program =
        compute.compileProgram(DeviceSources::thermostat, {{"WIDE", isWide ? "double" : "float"},
                                                           {"STEP_SIZE", std::to_string(Control::StepSize)}});
    vector<int> groupOf(compute.getNumAtoms(), 0);
    const vector<vector<int>> members = OpenMM::AndersenThermostatImpl::calcParticleGroups(context.getSystem());
    for (size_t i = 0; i < members.size(); i++)
        for (int particle : members[i])
            groupOf[particle] = (int) i;
    groups.initialize<int>(compute, groupOf.size(), "vrattleCollidingGroups");
    groups.upload(groupOf);
    thermostat = program->createKernel("collide");
    thermostat->addArg(compute.getNumAtoms());
    thermostat->addArg(compute.getPaddedNumAtoms());
    for (int i = 0; i < 2; i++)
        thermostat->addArg(); // frequency, kT
    thermostat->addArg(compute.getVelm());
    thermostat->addArg(); // control
    thermostat->addArg(compute.getIntegrationUtilities().getRandom());
    thermostat->addArg(); // firstNormal
    thermostat->addArg(groups);
}

// The numbers are drawn from OpenMM's generator, with the Force's seed.
void ForceActions::collide(OpenMM::ComputeArray& control) {
    OpenMM::ContextSelector selector(compute);
    if (!thermostat)
        initializeThermostat();
    const auto setReal = [&](int index, double value) {
        if (compute.getUseDoublePrecision())
            thermostat->setArg(index, value);
        else
            thermostat->setArg(index, (float) value);
    };
    setReal(2, context.getParameter(AndersenThermostat::CollisionFrequency()));
    setReal(3, BOLTZ * context.getParameter(AndersenThermostat::Temperature()));
    thermostat->setArg(5, control);
    thermostat->setArg(7, compute.getIntegrationUtilities().prepareRandomNumbers(2 * compute.getPaddedNumAtoms()));
    thermostat->execute(compute.getNumAtoms());
}
