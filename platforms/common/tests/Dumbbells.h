// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_DUMBBELLS_H_
#define OPENMMVRATTLE_DUMBBELLS_H_

#include "openmm/AndersenThermostat.h"
#include "openmm/Context.h"
#include "openmm/CustomExternalForce.h"
#include <random>
#include <string>
#include <vector>

namespace OpenMMVRattle {

using OpenMM::Vec3;

// Dumbbells in a field. Nothing of OpenMM waits for the device to compute such forces.
struct Dumbbells {
    OpenMM::System system;
    std::vector<Vec3> positions, velocities;
    explicit Dumbbells(int count, const std::string& energy = "100*(x^2+y^2+z^2)+20*cos(9*x)*sin(7*y+5*z)") {
        auto* field = new OpenMM::CustomExternalForce(energy);
        std::mt19937 random(5);
        std::uniform_real_distribution<double> uniform(-1, 1);
        for (int i = 0; i < 2 * count; i++) {
            system.addParticle(12);
            field->addParticle(i);
            velocities.push_back(Vec3(uniform(random), uniform(random), uniform(random)) * 0.5);
            const Vec3 place(uniform(random), uniform(random), uniform(random));
            positions.push_back(i % 2 == 0 ? place : positions.back() + Vec3(0.1, 0, 0));
            if (i % 2 == 1)
                system.addConstraint(i - 1, i, 0.1);
        }
        system.addForce(field);
    }
    void addThermostat(double temperature, double frequency) {
        auto* thermostat = new OpenMM::AndersenThermostat(temperature, frequency);
        thermostat->setRandomNumberSeed(3);
        system.addForce(thermostat);
    }
    void begin(OpenMM::Context& context) const {
        context.setPositions(positions);
        context.setVelocities(velocities);
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_DUMBBELLS_H_
