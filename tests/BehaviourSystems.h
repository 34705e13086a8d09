// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_BEHAVIOURSYSTEMS_H_
#define OPENMMVRATTLE_BEHAVIOURSYSTEMS_H_

// Systems on which the behaviours of both integrators are checked.

#include "TestSupport.h"
#include "openmm/Context.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/State.h"
#include "openmm/System.h"
#include <random>
#include <vector>

namespace OpenMMVRattle {

/** A number in [-0.5, 0.5) for each coordinate, as OpenMM's tests choose velocities. */
inline OpenMM::Vec3 randomVec(std::mt19937& random) {
    std::uniform_real_distribution<double> uniform(-0.5, 0.5);
    const double x = uniform(random), y = uniform(random);
    return OpenMM::Vec3(x, y, uniform(random));
}

/** Particles of mass 1 without a force; returns their positions. */
inline std::vector<OpenMM::Vec3> addFreeParticles(OpenMM::System& system, int count) {
    std::mt19937 random(5);
    std::vector<OpenMM::Vec3> positions;
    for (int i = 0; i < count; i++) {
        system.addParticle(1.0);
        positions.push_back(randomVec(random));
    }
    return positions;
}

/** The kinetic energy that the velocities of particles of mass 1 have. */
inline double kineticEnergyOf(OpenMM::Context& context) {
    double kinetic = 0;
    const OpenMM::State state = context.getState(OpenMM::State::Velocities);
    for (const OpenMM::Vec3& v : state.getVelocities())
        kinetic += 0.5 * v.dot(v);
    return kinetic;
}

/** A particle of mass 1 that group 1 of the forces pulls along x, and group 2 along y. */
inline void addPulledParticle(OpenMM::System& system) {
    system.addParticle(1.0);
    const char* const expressions[2] = {"x", "y"};
    for (int i = 0; i < 2; i++) {
        OpenMM::CustomExternalForce* force = new OpenMM::CustomExternalForce(expressions[i]);
        force->addParticle(0);
        force->setForceGroup(i + 1);
        system.addForce(force);
    }
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_BEHAVIOURSYSTEMS_H_
