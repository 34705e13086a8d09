// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_SYSTEMCHECK_H_
#define OPENMMVRATTLE_SYSTEMCHECK_H_

#include "openmm/internal/ContextImpl.h"
#include "run/IntegratorSettings.h"

namespace OpenMMVRattle {

/**
 * Refuse what can be known to go wrong before there are positions: masses that are no masses, constraints on virtual sites, Forces
 * that need an integrator of their own, and Forces that would give a wrong ensemble since they know the System's constraints alone.
 *
 * @throws OpenMMException    which names what it is and the way out
 */
void requireSuitableSystem(OpenMM::ContextImpl& context, const IntegratorSettings& settings);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_SYSTEMCHECK_H_
