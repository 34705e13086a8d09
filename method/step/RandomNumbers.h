// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_RANDOMNUMBERS_H_
#define OPENMMVRATTLE_RANDOMNUMBERS_H_

#include "openmm/Vec3.h"
#include <array>
#include <cstdint>

namespace OpenMMVRattle {

/**
 * Random numbers that have an index instead of an order: those of a particle in a step are a function of the seed, the number of the
 * step and the particle alone. So they are the same however often a step is tried, on however many threads, and after a restart.
 *
 * The function is Philox4x32-10 of J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, "Parallel random numbers: as easy as 1, 2,
 * 3" (SC11, 2011). All numbers are the same bits on every processor: logarithms, sines and cosines are series, not those of a library.
 */
class RandomNumbers {
public:
    typedef std::array<uint32_t, 4> Words;
    /** So many particles at once take the least time. */
    static constexpr int BLOCK = 64;

    /** Four words of 32 random bits. */
    static Words philox(Words counter, std::array<uint32_t, 2> key);
    /** Three independent numbers of the normal distribution with mean 0 and variance 1 (Box and Muller) for each of some particles. */
    static void normal(uint64_t seed, uint64_t step, const int* particles, int count, OpenMM::Vec3* numbers);
    /** The same for one. */
    static OpenMM::Vec3 normal(uint64_t seed, uint64_t step, int particle) {
        OpenMM::Vec3 numbers;
        normal(seed, step, &particle, 1, &numbers);
        return numbers;
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_RANDOMNUMBERS_H_
