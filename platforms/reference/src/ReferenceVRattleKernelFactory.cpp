// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ReferenceVRattleKernelFactory.h"
#include "ReferenceVectors.h"
#include "openmmvrattle/VRattleKernels.h"
#include "run/HostRunDevice.h"
#include <functional>
#include <memory>

using namespace OpenMMVRattle;
using OpenMM::Platform;
using OpenMM::ReferencePlatform;

namespace {

std::shared_ptr<RunDevice> makeDevice(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                                      const IntegratorSettings& settings) {
    auto& data = *static_cast<ReferencePlatform::PlatformData*>(context.getPlatformData());
    // This thread is awake and takes the share of the pool's first.
    auto runOnThreads = [&data](const std::function<void(int)>& task) {
        data.threads.execute([&task](OpenMM::ThreadPool&, int thread) {
            if (thread > 0)
                task(thread);
        });
        task(0);
        data.threads.waitForThreads();
    };
    const bool hasThreads = context.getPlatform().getName() != "Reference"; // which does everything on one
    return makeHostRunDevice(std::make_unique<ReferenceVectors>(context, integrator, data), context.getSystem(),
                             settings, runOnThreads, hasThreads ? data.threads.getNumThreads() : 1);
}

} // namespace

extern "C" void registerPlatforms() {
}

// Serves the Reference platform and every platform derived from it, such as CPU.
extern "C" void registerKernelFactories() {
    for (int i = 0; i < Platform::getNumPlatforms(); i++) {
        Platform& platform = Platform::getPlatform(i);
        if (dynamic_cast<ReferencePlatform*>(&platform) != nullptr)
            platform.registerKernelFactory(IntegrateVRattleStepKernel::Name(), new VRattleKernelFactory(makeDevice));
    }
}

extern "C" void registerVRattleReferenceKernelFactories() {
    registerKernelFactories();
}
