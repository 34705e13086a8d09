// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonVRattleKernelFactory.h"
#include "openmm/opencl/OpenCLPlatform.h"

extern "C" void registerPlatforms() {
}

extern "C" void registerKernelFactories() {
    OpenMMVRattle::registerFactories<OpenMM::OpenCLPlatform>("OpenCL");
}
