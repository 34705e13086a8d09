// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/RandomNumbers.h"
#include "constraints/Wide.h"
#include <algorithm>
#include <cmath>
#include <cstring>

using namespace OpenMMVRattle;
using OpenMM::Vec3;

namespace {

const int NUM_ROUNDS = 10;
const uint32_t FACTORS[2] = {0xD2511F53U, 0xCD9E8D57U}, WEYL[2] = {0x9E3779B9U, 0xBB67AE85U};

const double PI = 3.14159265358979323846, LOG_2 = 0.69314718055994530942, UNIT = 1.0 / 4294967296.0;
// The double 2^52 and the exponents of doubles, in bits.
const double SHIFT = 4503599627370496.0;
const uint64_t SHIFT_BITS = 0x4330000000000000ULL, ROOT_HALF_BITS = 0x3FE6A09E667F3BCDULL; // sqrt(1/2)
const int NUM_MANTISSA_BITS = 52, EXPONENT_OFFSET = 64;

uint64_t bitsOf(double x) {
    uint64_t bits;
    std::memcpy(&bits, &x, sizeof(bits));
    return bits;
}

double ofBits(uint64_t bits) {
    double x;
    std::memcpy(&x, &bits, sizeof(x));
    return x;
}

/** sqrt(-2 log x) with x = (word + 1/2)/2^32 */
inline double radius(uint64_t word) {
    const double y = (ofBits(SHIFT_BITS | word) - SHIFT) + 0.5;
    // y = 2^e m with m from sqrt(1/2) to sqrt(2)
    const uint64_t exponent =
        (bitsOf(y) - ROOT_HALF_BITS + ((uint64_t) EXPONENT_OFFSET << NUM_MANTISSA_BITS)) >> NUM_MANTISSA_BITS;
    const double m = ofBits(bitsOf(y) - ((exponent - EXPONENT_OFFSET) << NUM_MANTISSA_BITS));
    const double e = (ofBits(SHIFT_BITS | exponent) - SHIFT) - (EXPONENT_OFFSET + 32);
    // log m = 2 artanh s
    const double s = (m - 1) / (m + 1), z = s * s;
    double series = 1.0 / 21;
    for (double n : {1.0 / 19, 1.0 / 17, 1.0 / 15, 1.0 / 13, 1.0 / 11, 1.0 / 9, 1.0 / 7, 1.0 / 5, 1.0 / 3})
        series = series * z + n;
    return std::sqrt(-2 * ((2 * s + 2 * s * z * series) + e * LOG_2));
}

/** The cosine of 2 pi word/2^32, as the sine of pi/2 less the size of the angle. */
inline double cosine(uint32_t word) {
    const uint32_t quarter = 1U << 30, size = word >> 31 != 0 ? 0U - word : word;
    const double x = (int32_t) (quarter - size) * (2 * PI * UNIT), z = x * x;
    double series = 1.0 / 51090942171709440000.0; // 1/21!
    for (double n : {-1.0 / 121645100408832000.0, 1.0 / 355687428096000.0, -1.0 / 1307674368000.0, 1.0 / 6227020800.0,
                     -1.0 / 39916800, 1.0 / 362880, -1.0 / 5040, 1.0 / 120, -1.0 / 6})
        series = series * z + n;
    return x + x * z * series;
}

inline double sine(uint32_t word) {
    return cosine(word - (1U << 30));
}

inline void findNormal(uint64_t seed, uint64_t step, const int* particles, int count, Vec3* numbers) {
    const int BLOCK = RandomNumbers::BLOCK;
    // Loops over a block have no branches, so that compilers make vector instructions of them.
    for (int first = 0; first < count; first += BLOCK) {
        const int size = std::min(BLOCK, count - first);
        uint64_t words[4][BLOCK]; // each has 32 bits
        for (int i = 0; i < BLOCK; i++) {
            words[0][i] = (uint32_t) step;
            words[1][i] = step >> 32;
            words[2][i] = (uint32_t) particles[first + std::min(i, size - 1)];
            words[3][i] = 0;
        }
        uint32_t key[2] = {(uint32_t) seed, (uint32_t) (seed >> 32)};
        for (int round = 0; round < NUM_ROUNDS; round++) {
            for (int i = 0; i < BLOCK; i++) {
                const uint64_t a = (uint64_t) FACTORS[0] * (uint32_t) words[0][i],
                               b = (uint64_t) FACTORS[1] * (uint32_t) words[2][i];
                words[0][i] = (b >> 32) ^ words[1][i] ^ key[0];
                words[1][i] = (uint32_t) b;
                words[2][i] = (a >> 32) ^ words[3][i] ^ key[1];
                words[3][i] = (uint32_t) a;
            }
            key[0] += WEYL[0];
            key[1] += WEYL[1];
        }
        double x[BLOCK], y[BLOCK], z[BLOCK];
        for (int i = 0; i < BLOCK; i++) {
            const double length = radius(words[0][i]);
            x[i] = length * cosine((uint32_t) words[1][i]);
            y[i] = length * sine((uint32_t) words[1][i]);
        }
        for (int i = 0; i < BLOCK; i++)
            z[i] = radius(words[2][i]) * cosine((uint32_t) words[3][i]);
        for (int i = 0; i < size; i++)
            numbers[first + i] = Vec3(x[i], y[i], z[i]);
    }
}

OPENMMVRATTLE_WIDE void findNormalWide(uint64_t seed, uint64_t step, const int* particles, int count, Vec3* numbers) {
    findNormal(seed, step, particles, count, numbers);
}

} // namespace

RandomNumbers::Words RandomNumbers::philox(Words counter, std::array<uint32_t, 2> key) {
    for (int round = 0; round < NUM_ROUNDS; round++) {
        const uint64_t a = (uint64_t) FACTORS[0] * counter[0], b = (uint64_t) FACTORS[1] * counter[2];
        counter = {(uint32_t) (b >> 32) ^ counter[1] ^ key[0], (uint32_t) b, (uint32_t) (a >> 32) ^ counter[3] ^ key[1],
                   (uint32_t) a};
        key[0] += WEYL[0];
        key[1] += WEYL[1];
    }
    return counter;
}

void RandomNumbers::normal(uint64_t seed, uint64_t step, const int* particles, int count, Vec3* numbers) {
    (hasWideVectors() ? findNormalWide : findNormal)(seed, step, particles, count, numbers);
}
