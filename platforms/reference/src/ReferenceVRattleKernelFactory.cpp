// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ReferenceVRattleKernelFactory.h"
#include "ReferenceVRattleKernels.h"
#include "openmm/OpenMMException.h"
#include "openmm/internal/ContextImpl.h"
#include "openmm/reference/ReferencePlatform.h"

using namespace OpenMMVRattle;
using OpenMM::ContextImpl;
using OpenMM::KernelImpl;
using OpenMM::OpenMMException;
using OpenMM::Platform;
using OpenMM::ReferencePlatform;

extern "C" void registerPlatforms() {
}

// Serves the Reference platform and every platform derived from it, such as CPU.
extern "C" void registerKernelFactories() {
    for (int i = 0; i < Platform::getNumPlatforms(); i++) {
        Platform& platform = Platform::getPlatform(i);
        if (dynamic_cast<ReferencePlatform*>(&platform) != nullptr)
            platform.registerKernelFactory(IntegrateVRattleStepKernel::Name(), new ReferenceVRattleKernelFactory());
    }
}

extern "C" void registerVRattleReferenceKernelFactories() {
    registerKernelFactories();
}

KernelImpl* ReferenceVRattleKernelFactory::createKernelImpl(std::string name, const Platform& platform,
                                                            ContextImpl& context) const {
    if (name == IntegrateVRattleStepKernel::Name()) {
        auto* data = static_cast<ReferencePlatform::PlatformData*>(context.getPlatformData());
        return new ReferenceIntegrateVRattleStepKernel(name, platform, *data);
    }
    throw OpenMMException("Tried to create kernel with illegal kernel name '" + name + "'");
}
