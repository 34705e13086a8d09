// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_FORCEREACH_H_
#define OPENMMVRATTLE_FORCEREACH_H_

#include "openmm/Force.h"

namespace OpenMMVRattle {

/**
 * What the Forces of a System may change between steps (ForceImpl::updateContextState) and read beside positions. Of OpenMM's own
 * Forces that are mere functions of the positions we know that they change nothing, of some others what they change; of all
 * others we know nothing.
 */
struct ForceReach {
    bool hasBarostat = false;   // positions and box, which it announces
    bool hasThermostat = false; // velocities, without a word
    bool movesFrame = false;    // all velocities by the same
    bool isUnknown = false;     // anything, and reads the time
    void add(const OpenMM::Force& force);
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_FORCEREACH_H_
