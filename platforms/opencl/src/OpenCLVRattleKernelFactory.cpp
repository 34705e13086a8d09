// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonVRattleKernelFactory.h"
#include "openmm/opencl/OpenCLPlatform.h"

extern "C" OPENMMVRATTLE_EXPORT void registerPlatforms() {
}

extern "C" OPENMMVRATTLE_EXPORT void registerKernelFactories() {
    OpenMMVRattle::registerFactories<OpenMM::OpenCLPlatform>("OpenCL");
}
