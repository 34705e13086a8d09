// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
#define OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_

#include "ReferenceVectors.h"
#include "openmmvrattle/VRattleKernels.h"
#include "run/HostRunDevice.h"
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
        // This thread is awake and takes the share of the pool's first.
        auto runOnThreads = [this](const std::function<void(int)>& task) {
            data.threads.execute([&task](OpenMM::ThreadPool&, int thread) {
                if (thread > 0)
                    task(thread);
            });
            task(0);
            data.threads.waitForThreads();
        };
        const bool hasThreads = getPlatform().getName() != "Reference"; // which does everything on one
        device = makeHostRunDevice(std::make_unique<ReferenceVectors>(context, integrator, data), context.getSystem(),
                                   settings, runOnThreads, hasThreads ? data.threads.getNumThreads() : 1);
        return *device;
    }

private:
    OpenMM::ReferencePlatform::PlatformData& data;
    std::unique_ptr<RunDevice> device;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
