// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_PACK_H_
#define OPENMMVRATTLE_PACK_H_

namespace OpenMMVRattle {

/** The number of clusters that are worked on at once: a register of AVX2, or two of the baseline instruction sets (SSE2, NEON). */
const int PACK_SIZE = 4;

/**
 * PACK_SIZE numbers, one of each of as many clusters, with the arithmetic of one. The library is built for the baseline instruction set,
 * so that it runs on every processor, and what is done with packs for wide registers as well (Wide.h).
 */
#ifdef __x86_64__
// Aligned for AVX2, whichever instruction set the code that has one on its stack is compiled for.
typedef double Pack __attribute__((vector_size(PACK_SIZE * sizeof(double)), aligned(PACK_SIZE * sizeof(double))));
#else
typedef double Pack __attribute__((vector_size(PACK_SIZE * sizeof(double))));
#endif

inline Pack packOf(double x) {
    return Pack{x, x, x, x};
}
/** The larger one of a, which is not negative, and the size of b; or a NaN if one is. */
inline Pack largerSize(Pack a, Pack b) {
    const Pack size = b < packOf(0) ? -b : b;
    return a >= size || a != a ? a : size;
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_PACK_H_
