// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONVRATTLEKERNELFACTORY_H_
#define OPENMMVRATTLE_COMMONVRATTLEKERNELFACTORY_H_

#include "CommonLangevinDevice.h"
#include "CommonVRattleDevice.h"
#include "openmmvrattle/VRattleKernels.h"
#include "run/IntegratorSettings.h"
#include <memory>
#include <string>

namespace OpenMMVRattle {

/**
 * Makes the device for one of the platforms OpenCL, CUDA and HIP. Its own kind of ComputeContext is not needed, nor are its headers:
 * ComputeContext is the first and only base of each, so that both have the same address.
 */
template <class OpenMMPlatform>
std::shared_ptr<RunDevice> makeCommonDevice(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                                            const IntegratorSettings& settings) {
    auto* data = static_cast<typename OpenMMPlatform::PlatformData*>(context.getPlatformData());
    auto& compute = *reinterpret_cast<OpenMM::ComputeContext*>(data->contexts[0]);
    if (settings.langevin)
        return std::make_shared<CommonLangevinDevice>(context, compute, integrator, settings);
    return std::make_shared<CommonVRattleDevice>(context, compute, integrator, settings);
}

/** Register the kernels for a platform; nothing happens where this OpenMM does not have it. */
template <class OpenMMPlatform> void registerFactories(const std::string& platform) {
    for (int i = 0; i < OpenMM::Platform::getNumPlatforms(); i++)
        if (OpenMM::Platform::getPlatform(i).getName() == platform)
            OpenMM::Platform::getPlatform(i).registerKernelFactory(
                IntegrateVRattleStepKernel::Name(), new VRattleKernelFactory(makeCommonDevice<OpenMMPlatform>));
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONVRATTLEKERNELFACTORY_H_
