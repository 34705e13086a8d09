// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
#define OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_

#include "ReferenceRunDevice.h"
#include "openmmvrattle/VRattleKernels.h"
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
        device = std::make_unique<ReferenceRunDevice>(context, data, integrator, settings);
        return *device;
    }

private:
    OpenMM::ReferencePlatform::PlatformData& data;
    std::unique_ptr<ReferenceRunDevice> device;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_REFERENCEVRATTLEKERNELS_H_
