// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLEKERNELS_H_
#define OPENMMVRATTLE_VRATTLEKERNELS_H_

#include "openmm/Integrator.h"
#include "openmm/KernelFactory.h"
#include "openmm/KernelImpl.h"
#include "openmm/OpenMMException.h"
#include "openmm/Platform.h"
#include <memory>
#include <string>

namespace OpenMMVRattle {

class RunDevice;
struct IntegratorSettings;

/**
 * The kernel of the integrators: all of it is a RunDevice (method/run), which does what the run asks for. The integrator holds the
 * settings, the device the state.
 */
class IntegrateVRattleStepKernel : public OpenMM::KernelImpl {
public:
    /**
     * What a platform provides: makes the device, from the System of a Context and the constraints by expressions among the settings.
     *
     * @param context       the context in which it works
     * @param integrator    the integrator; that of the Context may be a CompoundIntegrator to which it belongs
     * @param settings      its settings
     */
    typedef std::shared_ptr<RunDevice> (*MakeDevice)(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                                                     const IntegratorSettings& settings);
    static std::string Name() {
        return "IntegrateVRattleStep";
    }
    IntegrateVRattleStepKernel(const std::string& name, const OpenMM::Platform& platform, MakeDevice makeDevice) :
            OpenMM::KernelImpl(name, platform), makeDevice(makeDevice) {
    }
    /** Make the device, which belongs to the kernel. */
    RunDevice& initialize(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                          const IntegratorSettings& settings) {
        device = makeDevice(context, integrator, settings);
        return *device;
    }

private:
    MakeDevice makeDevice;
    std::shared_ptr<RunDevice> device;
};

/** Creates these kernels for a platform. */
class VRattleKernelFactory : public OpenMM::KernelFactory {
public:
    explicit VRattleKernelFactory(IntegrateVRattleStepKernel::MakeDevice makeDevice) : makeDevice(makeDevice) {
    }
    OpenMM::KernelImpl* createKernelImpl(std::string name, const OpenMM::Platform& platform,
                                         OpenMM::ContextImpl&) const override {
        if (name == IntegrateVRattleStepKernel::Name())
            return new IntegrateVRattleStepKernel(name, platform, makeDevice);
        throw OpenMM::OpenMMException("Tried to create kernel with illegal kernel name '" + name + "'");
    }

private:
    IntegrateVRattleStepKernel::MakeDevice makeDevice;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLEKERNELS_H_
