// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLEKERNELS_H_
#define OPENMMVRATTLE_VRATTLEKERNELS_H_

#include "openmm/Integrator.h"
#include "openmm/KernelImpl.h"
#include "openmm/Platform.h"
#include <string>

namespace OpenMMVRattle {

class RunDevice;
struct IntegratorSettings;

/**
 * The kernel that a platform provides for VariableStepRattleIntegrator: all of it is a RunDevice (method/run), which does
 * what the run asks for. The integrator holds the settings, the device the state.
 */
class IntegrateVRattleStepKernel : public OpenMM::KernelImpl {
public:
    static std::string Name() {
        return "IntegrateVRattleStep";
    }
    IntegrateVRattleStepKernel(const std::string& name, const OpenMM::Platform& platform) :
            OpenMM::KernelImpl(name, platform) {
    }
    /**
     * Make the device, from the System of a Context and the constraints by expressions among the settings.
     *
     * @param context       the context in which it works
     * @param integrator    the integrator; that of the Context may be a CompoundIntegrator to which it belongs
     * @param settings      its settings
     * @return the device, which belongs to the kernel
     */
    virtual RunDevice& initialize(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                                  const IntegratorSettings& settings) = 0;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLEKERNELS_H_
