// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "TestExpressionConstraints.h"
#include "ReferenceTests.h"
#include "openmm/kernels.h"
#include "openmm/reference/ReferenceKernelFactory.h"
#include "openmm/reference/ReferencePlatform.h"
#include "openmmvrattle/VRattleKernels.h"

using namespace OpenMMVRattle;

namespace {

// A platform that is not derived from Reference, though its kernels are the same.
class OtherPlatform : public OpenMM::Platform {
public:
    OtherPlatform() {
        for (const std::string& name :
             {OpenMM::UpdateStateDataKernel::Name(), OpenMM::CalcForcesAndEnergyKernel::Name(),
              OpenMM::ApplyConstraintsKernel::Name(), OpenMM::VirtualSitesKernel::Name(),
              OpenMM::MinimizeKernel::Name(), OpenMM::CalcCustomExternalForceKernel::Name()})
            registerKernelFactory(name, new OpenMM::ReferenceKernelFactory());
        registerKernelFactory(IntegrateVRattleStepKernel::Name(), new ReferenceVRattleKernelFactory());
    }
    const std::string& getName() const override {
        static const std::string name = "Other";
        return name;
    }
    double getSpeed() const override {
        return 0;
    }
    bool supportsDoublePrecision() const override {
        return true;
    }
    void contextCreated(OpenMM::ContextImpl& context,
                        const std::map<std::string, std::string>& properties) const override {
        reference.contextCreated(context, properties);
    }
    void contextDestroyed(OpenMM::ContextImpl& context) const override {
        reference.contextDestroyed(context);
    }

private:
    OpenMM::ReferencePlatform reference;
};

void testOtherPlatformsAreRefused() {
    TestSystem t;
    makeSphericalPendulum(t);
    OtherPlatform platform;
    {
        Integrator_ integrator(0.001);
        integrator.clearMonitors();
        Context context(t.system, integrator, platform);
        start(context, t);
        integrator.step(1);
    }
    Integrator_ integrator(0.001);
    integrator.addConstraint(SPHERE, {1, 0}, {{"r", 1.0}});
    assertThrows("work on the platforms Reference and CPU, and this Context is on Other",
                 [&] { Context context(t.system, integrator, platform); });
}

} // namespace

int main(int argc, char** argv) {
    return runOnPlatform({{"the tension of a spherical pendulum", testTension},
                          {"setters, getters and XML", testSettersAndGetters},
                          {"runs with expressions go on from checkpoints", testRunsWithExpressionsGoOn},
                          {"other platforms are refused", testOtherPlatformsAreRefused}},
                         argc, argv);
}
