// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_FINGERPRINT_H_
#define OPENMMVRATTLE_FINGERPRINT_H_

#include "openmm/System.h"
#include "openmm/Vec3.h"
#include <cstddef>
#include <cstring>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

struct ExpressionConstraint;

/**
 * A 64 bit number made from data (the hash FNV-1a), by which a saved run knows again the System and the state it
 * belongs to. Different data have the same fingerprint only by a rare accident.
 */
class Fingerprint {
public:
    void addBytes(const char* bytes, size_t count) {
        for (size_t i = 0; i < count; i++)
            value = (value ^ (unsigned char) bytes[i]) * 1099511628211ULL;
    }
    void add(double number) {
        const double comparable = number + 0.0; // -0 and 0 are the same number
        char bytes[sizeof(double)];
        std::memcpy(bytes, &comparable, sizeof(double));
        addBytes(bytes, sizeof(double));
    }
    void add(const OpenMM::Vec3& vector) {
        for (int i = 0; i < 3; i++)
            add(vector[i]);
    }
    unsigned long long get() const {
        return value;
    }

private:
    unsigned long long value = 14695981039346656037ULL;
};

/** Of bytes. */
unsigned long long fingerprintOf(const std::string& data);
/** Of the masses and the constraints, but for the values of the parameters of expressions. */
unsigned long long fingerprintOf(const OpenMM::System& system, const std::vector<ExpressionConstraint>& expressions);
/**
 * Of the state of a Context, for the particles that move: of velocities in the digits that every platform keeps, so that it knows a
 * state again that comes from another one. Positions change by rounding where they are wrapped into the box: see sumPositions().
 */
unsigned long long fingerprintOf(const std::vector<OpenMM::Vec3>& velocities, const std::vector<double>& masses,
                                 const OpenMM::Vec3* boxVectors);
/** Of the parameters of a Context. */
unsigned long long fingerprintOf(const std::map<std::string, double>& parameters);
/** Some sums of the positions of all that moves, with signs by chance, the same everywhere: whoever moves particles changes them. */
std::vector<double> sumPositions(const std::vector<OpenMM::Vec3>& positions, const std::vector<double>& masses);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_FINGERPRINT_H_
