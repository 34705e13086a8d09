// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The double pendulum of the README in C++: CMakeLists.txt beside this file says how to build it.

#include "OpenMM.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include <cmath>
#include <cstdio>
#include <map>
#include <string>
#include <vector>

using OpenMMVRattle::VariableStepRattleIntegrator;

int main(int argc, char** argv) {
    // pendulum [--platform NAME]; OpenMM itself has Reference, and its plugins bring the others.
    const std::string name = argc == 3 && std::string(argv[1]) == "--platform" ? argv[2] : "Reference";
    OpenMM::Platform::loadPluginsFromDirectory(OPENMM_PLUGIN_DIR);
    // A library of this plugin registers its kernels with a platform, that for Reference with CPU too.
    const std::string kernels = name == "CPU" ? "Reference" : name;
    OpenMM::Platform::loadPluginLibrary(VRATTLE_PLUGIN_DIR "/libOpenMMVRattle" + kernels + ".so");

    // A pivot that is as good as fixed, a light bob and a heavy one, on rods of 1 nm under gravity of 1 nm/ps^2.
    const std::vector<double> masses = {1e15, 1, 1000};
    OpenMM::System system;
    auto* weight = new OpenMM::CustomExternalForce("w*y"); // the System deletes it
    weight->addPerParticleParameter("w");
    for (size_t i = 0; i < masses.size(); i++) {
        system.addParticle(masses[i]);
        if (i > 0) {
            system.addConstraint(i - 1, i, 1);
            weight->addParticle(i, {masses[i]});
        }
    }
    system.addForce(weight);

    VariableStepRattleIntegrator integrator(0.01); // ps: the first step
    integrator.setMinimumStepSize(1e-6);
    integrator.setMaximumStepSize(0.02);
    // A whip with masses of 1 : 1000 needs double precision, which Reference has by itself.
    std::map<std::string, std::string> properties;
    if (kernels != "Reference")
        properties["Precision"] = "double";
    OpenMM::Context context(system, integrator, OpenMM::Platform::getPlatform(name), properties);
    const OpenMM::Vec3 inner(std::sin(2.2), -std::cos(2.2), 0), outer(std::sin(0.5), -std::cos(0.5), 0);
    context.setPositions({OpenMM::Vec3(), inner, inner + outer});

    for (int i = 0; i <= 12; i++) {
        integrator.stepTo(0.25 * i);
        const OpenMM::State state = context.getState(OpenMM::State::Energy);
        const double energy = state.getKineticEnergy() + state.getPotentialEnergy();
        std::printf("time %.2f ps   step %.1e ps   energy %.5f kJ/mol   tension of the inner rod %.3g kJ/mol/nm\n",
                    state.getTime(), integrator.getStepSize(), energy, 2 * integrator.getMultipliers()[0]);
    }
    return 0;
}
