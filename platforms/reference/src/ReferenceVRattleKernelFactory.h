// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVRATTLEKERNELFACTORY_H_
#define OPENMMVRATTLE_REFERENCEVRATTLEKERNELFACTORY_H_

#include "openmm/KernelFactory.h"

namespace OpenMMVRattle {

/** Creates the kernels of this plugin for the Reference platform and the platforms derived from it. */
class ReferenceVRattleKernelFactory : public OpenMM::KernelFactory {
public:
    OpenMM::KernelImpl* createKernelImpl(std::string name, const OpenMM::Platform& platform,
                                         OpenMM::ContextImpl& context) const override;
};

} // namespace OpenMMVRattle

/** Register the kernels without loading the plugin library by hand (for programs that link with it). */
extern "C" void registerVRattleReferenceKernelFactories();

#endif // OPENMMVRATTLE_REFERENCEVRATTLEKERNELFACTORY_H_
