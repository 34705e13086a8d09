// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_HOSTCONTEXT_H_
#define OPENMMVRATTLE_HOSTCONTEXT_H_

#include "openmm/Integrator.h"
#include "openmm/internal/ContextImpl.h"
#include "run/ContextVectors.h"

namespace OpenMMVRattle {

/** What a Context computes, the same way on every platform; where it has its state is for the derived classes. */
class HostContext : public ContextVectors {
public:
    /** @param integrator    whose steps are taken; that of the Context may be a CompoundIntegrator to which it belongs */
    HostContext(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator) :
            context(context), integrator(integrator) {
    }
    const std::map<std::string, double>& getParameters() override {
        return context.getParameters();
    }
    bool isSharedByIntegrators() override {
        return &context.getIntegrator() != &integrator;
    }
    bool updateState() override {
        return context.updateContextState();
    }
    void requirePositions() override {
        context.calcForcesAndEnergy(false, false, 0); // of no group, which computes nothing
    }
    void invalidateForces() override {
        context.getLastForceGroups() = 0; // they are of no group, as everybody sees who would use them
    }
    void computeVirtualSites() override {
        context.computeVirtualSites();
    }
    double computeForces(int groups, int energyGroup) override {
        // The energy first: some platforms use up the forces for it.
        const double energy = energyGroup < 0 ? 0.0 : context.calcForcesAndEnergy(false, true, 1 << energyGroup);
        context.calcForcesAndEnergy(true, false, groups);
        return energy;
    }

protected:
    OpenMM::ContextImpl& context;

private:
    const OpenMM::Integrator& integrator;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_HOSTCONTEXT_H_
