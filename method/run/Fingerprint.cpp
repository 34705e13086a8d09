// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/Fingerprint.h"
#include "expressions/ExpressionGroup.h"
#include <random>

using OpenMM::Vec3;
using std::vector;

namespace OpenMMVRattle {

namespace {

const int NUM_POSITION_SUMS = 8;

} // namespace

unsigned long long fingerprintOf(const std::string& data) {
    Fingerprint fingerprint;
    fingerprint.addBytes(data.data(), data.size());
    return fingerprint.get();
}

unsigned long long fingerprintOf(const OpenMM::System& system, const vector<ExpressionConstraint>& expressions) {
    Fingerprint fingerprint;
    for (int i = 0; i < system.getNumParticles(); i++)
        fingerprint.add(system.getParticleMass(i));
    for (int i = 0; i < system.getNumConstraints(); i++) {
        int particle1, particle2;
        double distance;
        system.getConstraintParameters(i, particle1, particle2, distance);
        fingerprint.add(Vec3(particle1, particle2, distance));
    }
    for (const ExpressionConstraint& constraint : expressions) {
        fingerprint.addBytes(constraint.expression.c_str(), constraint.expression.size() + 1);
        for (int particle : constraint.particles)
            fingerprint.add(particle);
        for (const auto& parameter : constraint.parameters)
            fingerprint.addBytes(parameter.first.c_str(), parameter.first.size() + 1);
    }
    return fingerprint.get();
}

unsigned long long fingerprintOf(const vector<Vec3>& velocities, const vector<double>& masses, const Vec3* boxVectors) {
    Fingerprint fingerprint;
    for (size_t i = 0; i < masses.size(); i++)
        if (masses[i] > 0)
            for (int d = 0; d < 3; d++)
                fingerprint.add((double) (float) velocities[i][d]);
    for (int i = 0; i < 3; i++)
        fingerprint.add(boxVectors[i]);
    return fingerprint.get();
}

unsigned long long fingerprintOf(const std::map<std::string, double>& parameters) {
    Fingerprint fingerprint;
    for (const auto& parameter : parameters) {
        fingerprint.addBytes(parameter.first.c_str(), parameter.first.size() + 1);
        fingerprint.add(parameter.second);
    }
    return fingerprint.get();
}

vector<double> sumPositions(const vector<Vec3>& positions, const vector<double>& masses) {
    vector<double> sums(NUM_POSITION_SUMS, 0.0);
    std::minstd_rand random;
    for (size_t i = 0; i < masses.size(); i++)
        for (int d = 0; d < 3; d++) {
            const unsigned signs = (unsigned) random() >> 8;
            for (int k = 0; k < NUM_POSITION_SUMS && masses[i] > 0; k++)
                sums[k] += (signs >> k & 1) != 0 ? positions[i][d] : -positions[i][d];
        }
    return sums;
}

} // namespace OpenMMVRattle
