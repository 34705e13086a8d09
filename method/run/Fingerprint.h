// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_FINGERPRINT_H_
#define OPENMMVRATTLE_FINGERPRINT_H_

#include "openmm/Vec3.h"
#include <cstddef>
#include <cstring>

namespace OpenMMVRattle {

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

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_FINGERPRINT_H_
