// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonVRattleKernelFactory.h"
#include "openmm/hip/HipPlatform.h"

extern "C" OPENMMVRATTLE_EXPORT void registerPlatforms() {
}

extern "C" OPENMMVRATTLE_EXPORT void registerKernelFactories() {
    OpenMMVRattle::registerFactories<OpenMM::HipPlatform>("HIP");
}
