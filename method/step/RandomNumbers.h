// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_RANDOMNUMBERS_H_
#define OPENMMVRATTLE_RANDOMNUMBERS_H_

#include "openmm/Vec3.h"
#include <array>
#include <cmath>
#include <cstdint>

namespace OpenMMVRattle {

/**
 * Random numbers that have an index instead of an order: those of a particle in a step are a function of the seed, the number of the
 * step and the particle alone. So they are the same however often a step is tried, on however many threads, and after a restart.
 *
 * The function is Philox4x32-10 of J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, "Parallel random numbers: as easy as 1, 2,
 * 3" (SC11, 2011).
 */
class RandomNumbers {
public:
    typedef std::array<uint32_t, 4> Words;

    /** Four words of 32 random bits. */
    static Words philox(Words counter, std::array<uint32_t, 2> key) {
        const int rounds = 10;
        for (int round = 0; round < rounds; round++) {
            const uint64_t a = 0xD2511F53ULL * counter[0], b = 0xCD9E8D57ULL * counter[2];
            counter = {(uint32_t) (b >> 32) ^ counter[1] ^ key[0], (uint32_t) b,
                       (uint32_t) (a >> 32) ^ counter[3] ^ key[1], (uint32_t) a};
            key[0] += 0x9E3779B9U;
            key[1] += 0xBB67AE85U;
        }
        return counter;
    }
    /** Three independent numbers of the normal distribution with mean 0 and variance 1 (Box and Muller). */
    static OpenMM::Vec3 normal(uint64_t seed, uint64_t step, uint32_t particle) {
        const Words words =
            philox({(uint32_t) step, (uint32_t) (step >> 32), particle, 0}, {(uint32_t) seed, (uint32_t) (seed >> 32)});
        const double first = radius(words[0]), angle = TURN * words[1];
        return OpenMM::Vec3(first * std::cos(angle), first * std::sin(angle),
                            radius(words[2]) * std::cos(TURN * words[3]));
    }

private:
    static constexpr double UNIT = 1.0 / 4294967296.0, TURN = 6.283185307179586477 * UNIT;
    static double radius(uint32_t word) {
        return std::sqrt(-2 * std::log((word + 0.5) * UNIT));
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_RANDOMNUMBERS_H_
