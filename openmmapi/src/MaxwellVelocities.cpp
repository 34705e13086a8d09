// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "MaxwellVelocities.h"
#include "openmm/reference/SimTKOpenMMRealType.h"
#include <cmath>
#include <random>

using OpenMM::Vec3;
using std::vector;

namespace {

// Normally distributed numbers in pairs, by Box and Muller; the standard library's are different ones with each compiler.
class NormalNumbers {
public:
    explicit NormalNumbers(int seed) : engine((unsigned) seed), hasSecond(false), second(0) {
    }
    double next() {
        hasSecond = !hasSecond;
        if (!hasSecond)
            return second;
        const double radius = std::sqrt(-2 * std::log(1 - uniform())), angle = 2 * M_PI * uniform();
        second = radius * std::sin(angle);
        return radius * std::cos(angle);
    }

private:
    // In [0, 1), from the 53 bits that a double has.
    double uniform() {
        return (double) (engine() >> 11) / 9007199254740992.0;
    }
    std::mt19937_64 engine;
    bool hasSecond;
    double second;
};

} // namespace

vector<Vec3> OpenMMVRattle::drawMaxwellVelocities(const OpenMM::System& system, double temperature, int seed) {
    NormalNumbers normal(seed);
    vector<Vec3> velocities(system.getNumParticles());
    for (int i = 0; i < system.getNumParticles(); i++) {
        const double mass = system.getParticleMass(i);
        if (mass == 0)
            continue;
        for (int axis = 0; axis < 3; axis++)
            velocities[i][axis] = normal.next() * std::sqrt(BOLTZ * temperature / mass);
    }
    return velocities;
}
