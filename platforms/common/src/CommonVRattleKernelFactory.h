// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMMONVRATTLEKERNELFACTORY_H_
#define OPENMMVRATTLE_COMMONVRATTLEKERNELFACTORY_H_

#include "CommonLangevinDevice.h"
#include "CommonVRattleDevice.h"
#include "openmm/KernelFactory.h"
#include "openmm/OpenMMException.h"
#include "openmmvrattle/VRattleKernels.h"
#include "run/IntegratorSettings.h"
#include <memory>
#include <string>

namespace OpenMMVRattle {

/** The kernel for the platforms OpenCL, CUDA and HIP. */
class CommonIntegrateVRattleStepKernel : public IntegrateVRattleStepKernel {
public:
    CommonIntegrateVRattleStepKernel(const std::string& name, const OpenMM::Platform& platform,
                                     OpenMM::ComputeContext& compute) :
            IntegrateVRattleStepKernel(name, platform), compute(compute) {
    }
    RunDevice& initialize(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                          const IntegratorSettings& settings) override {
        if (settings.langevin)
            device = std::make_unique<CommonLangevinDevice>(context, compute, integrator, settings);
        else
            device = std::make_unique<CommonVRattleDevice>(context, compute, integrator, settings);
        return *device;
    }

private:
    OpenMM::ComputeContext& compute;
    std::unique_ptr<RunDevice> device;
};

/**
 * Creates the kernels of this plugin for one of these platforms. Its own kind of ComputeContext is not needed, nor are its headers:
 * ComputeContext is the first and only base of each, so that both have the same address.
 */
template <class OpenMMPlatform> class CommonVRattleKernelFactory : public OpenMM::KernelFactory {
public:
    OpenMM::KernelImpl* createKernelImpl(std::string name, const OpenMM::Platform& platform,
                                         OpenMM::ContextImpl& context) const override {
        auto* data = static_cast<typename OpenMMPlatform::PlatformData*>(context.getPlatformData());
        auto& compute = *reinterpret_cast<OpenMM::ComputeContext*>(data->contexts[0]);
        if (name == IntegrateVRattleStepKernel::Name())
            return new CommonIntegrateVRattleStepKernel(name, platform, compute);
        throw OpenMM::OpenMMException("Tried to create kernel with illegal kernel name '" + name + "'");
    }
};

/** Register the kernels for a platform; nothing happens where this OpenMM does not have it. */
template <class OpenMMPlatform> void registerFactories(const std::string& platform) {
    for (int i = 0; i < OpenMM::Platform::getNumPlatforms(); i++)
        if (OpenMM::Platform::getPlatform(i).getName() == platform)
            OpenMM::Platform::getPlatform(i).registerKernelFactory(IntegrateVRattleStepKernel::Name(),
                                                                   new CommonVRattleKernelFactory<OpenMMPlatform>());
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMMONVRATTLEKERNELFACTORY_H_
