// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_FORCEACTIONS_H_
#define OPENMMVRATTLE_FORCEACTIONS_H_

#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include "openmm/internal/ContextImpl.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * Lets the Forces act that do so between steps, as ContextImpl::updateContextState() does, but without waiting for the device: it
 * knows which updates are those in which a barostat tries another box, for which one has to wait, and AndersenThermostat, which asks
 * the integrator for the size of the last step, has a kernel here that reads it where it is.
 */
class ForceActions {
public:
    /** Every update of the Context must be one of this object, or it cannot know when a barostat acts. */
    ForceActions(OpenMM::ContextImpl& context, OpenMM::ComputeContext& compute);
    /** Whether a barostat tries another box in the next update. */
    bool isTrialNext() const;
    /**
     * Let all Forces act.
     *
     * @param control    the control block of the last step, if that is on the device; else null, and the integrator is asked
     * @return whether one of them says that forces are others
     */
    bool update(OpenMM::ComputeArray* control);
    /** Let those act once more that change velocities and nothing else, since what they have done last has been undone. */
    void repeat();

private:
    void initializeThermostat();
    void collide(OpenMM::ComputeArray& control);
    OpenMM::ContextImpl& context;
    OpenMM::ComputeContext& compute;
    std::vector<long long> updatesSinceTrial; // of each Force
    OpenMM::ComputeKernel thermostat; // made when it is needed
    OpenMM::ComputeArray groups;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_FORCEACTIONS_H_
