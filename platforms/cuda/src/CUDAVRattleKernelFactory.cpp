// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "CommonVRattleKernelFactory.h"
#include "openmm/cuda/CudaPlatform.h"

extern "C" void registerPlatforms() {
}

extern "C" void registerKernelFactories() {
    OpenMMVRattle::registerFactories<OpenMM::CudaPlatform>("CUDA");
}
