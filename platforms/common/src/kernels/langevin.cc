// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What steps of Langevin dynamics have beside those of RATTLE (docs/langevin.md): a step that is calm, and so needs no substeps, is a
// half kick, half a drift, noise, and the other half of the drift. The numbers are those of method/step/RandomNumbers.h.

/** The noise of a step: v <- damping v + size M^-1/2 xi. */
typedef struct {
    word_t seed[2], step[2]; // the lower half first
    mixed damping, size;
} Noise;

#define NOISE_PARAMETERS , int step, GLOBAL const wide* RESTRICT settings, GLOBAL const int* RESTRICT noiseState, GLOBAL const int* RESTRICT atomIndex
#define NOISE_ARGUMENTS , step, settings, noiseState, atomIndex
#define NO_NOISE , 0, 0, 0, 0
#define NOISE_STATE , GLOBAL const int* RESTRICT noiseState, GLOBAL const int* RESTRICT atomIndex
#define LARGE_NOISE_STATE , GLOBAL const wide* RESTRICT settings NOISE_STATE

/**
 * noiseState is the seed, the number of a step among those that have drawn noise, and its number here. Made where it is used: loading it costs
 * nothing, keeping it registers.
 */
inline DEVICE Noise makeNoise(int step, GLOBAL const int* RESTRICT noiseState, GLOBAL const wide* RESTRICT settings) {
    Noise noise;
    noise.seed[0] = (word_t) noiseState[0];
    noise.seed[1] = (word_t) noiseState[1];
    const word_t low = (word_t) noiseState[2] + (word_t) (step - noiseState[4]);
    noise.step[0] = low;
    noise.step[1] = (word_t) noiseState[3] + (low < (word_t) noiseState[2] ? 1 : 0);
    noise.damping = (mixed) settings[DAMPING];
    noise.size = (mixed) settings[NOISE_SIZE];
    return noise;
}

/** sqrt(-2 log x) with x = (word + 1/2)/2^32 */
inline DEVICE real radiusOf(word_t word) {
    return sqrt(-2*log(((real) word + (real) 0.5f)*(real) 2.3283064365386963e-10f));
}

/** word/2^31, of which pi times is an angle */
inline DEVICE real angleOf(word_t word) {
    return (real) word*(real) 4.656612873077393e-10f;
}

/** Philox4x32-10; the normal numbers have the type of forces. */
inline DEVICE void addNoise(Noise noise, int particle, mixed w, mixed* v) {
    word_t counter[4] = {noise.step[0], noise.step[1], (word_t) particle, 0}, key[2] = {noise.seed[0], noise.seed[1]};
    for (int round = 0; round < 10; round++) {
        const mm_ulong a = (mm_ulong) 0xD2511F53u*counter[0], b = (mm_ulong) 0xCD9E8D57u*counter[2];
        counter[0] = (word_t) (b >> 32) ^ counter[1] ^ key[0];
        counter[1] = (word_t) b;
        counter[2] = (word_t) (a >> 32) ^ counter[3] ^ key[1];
        counter[3] = (word_t) a;
        key[0] += 0x9E3779B9u;
        key[1] += 0xBB67AE85u;
    }
    const real first = radiusOf(counter[0]), angle = angleOf(counter[1]);
    const mixed size = noise.size*sqrt(w);
    v[0] = noise.damping*v[0] + size*(mixed) (first*cospi(angle));
    v[1] = noise.damping*v[1] + size*(mixed) (first*sinpi(angle));
    v[2] = noise.damping*v[2] + size*(mixed) (radiusOf(counter[2])*cospi(angleOf(counter[3])));
}

/** U, or -1 if a step that ends with it needs substeps. */
inline DEVICE wide judgeCalm(wide u, wide reference, GLOBAL const wide* RESTRICT settings) {
    return u <= settings[LARGEST_CALM]*reference ? u : (wide) -1;
}

/** U_ref after a step that has ended with U. */
inline DEVICE wide followReference(wide u, wide reference, GLOBAL const wide* RESTRICT settings) {
    const wide growth = settings[FOLLOWING];
    return max(settings[REFERENCE_FLOOR], u > reference ? reference*growth : u < reference ? reference/growth : reference);
}
