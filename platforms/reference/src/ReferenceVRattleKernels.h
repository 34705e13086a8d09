// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
#define OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_

#include "HostRunDevice.h"
#include "ReferenceVectors.h"
#include "openmmvrattle/VRattleKernels.h"
#include <functional>
#include <memory>

namespace OpenMMVRattle {

/** The kernel for the Reference platform and those derived from it (CPU). */
class ReferenceIntegrateVRattleStepKernel : public IntegrateVRattleStepKernel {
public:
    ReferenceIntegrateVRattleStepKernel(const std::string& name, const OpenMM::Platform& platform,
                                        OpenMM::ReferencePlatform::PlatformData& data) :
            IntegrateVRattleStepKernel(name, platform), data(data) {
    }
    RunDevice& initialize(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                          const IntegratorSettings& settings) override {
        device = makeHostRunDevice(context, std::make_unique<ReferenceVectors>(data), integrator, settings);
        if (getPlatform().getName() != "Reference") { // which does everything on one thread
            // This thread is awake and takes the share of the pool's first.
            auto runOnThreads = [this](const std::function<void(int)>& task) {
                data.threads.execute([&task](OpenMM::ThreadPool&, int thread) {
                    if (thread > 0)
                        task(thread);
                });
                task(0);
                data.threads.waitForThreads();
            };
            device->setParallel(runOnThreads, data.threads.getNumThreads());
        }
        return *device;
    }

private:
    OpenMM::ReferencePlatform::PlatformData& data;
    std::unique_ptr<HostRunDevice> device;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
