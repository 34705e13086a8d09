// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_PACK_H_
#define OPENMMVRATTLE_PACK_H_

namespace OpenMMVRattle {

/** The number of clusters that are worked on at once: what the baseline instruction sets (SSE2, NEON) hold. */
const int PACK_SIZE = 2;

/**
 * PACK_SIZE numbers, one of each of as many clusters, with the arithmetic of one. Compilers that know vector types use
 * the processor's; the library is built for the baseline instruction set, so that it runs on every processor.
 */
#if defined(__GNUC__)
typedef double Pack __attribute__((vector_size(PACK_SIZE * sizeof(double))));

inline Pack packOf(double x) {
    return Pack{x, x};
}
#else
struct Pack {
    double x[PACK_SIZE];
    double& operator[](int i) {
        return x[i];
    }
    double operator[](int i) const {
        return x[i];
    }
};

inline Pack packOf(double x) {
    return Pack{{x, x}};
}
inline Pack operator+(Pack a, Pack b) {
    return Pack{{a[0] + b[0], a[1] + b[1]}};
}
inline Pack operator-(Pack a, Pack b) {
    return Pack{{a[0] - b[0], a[1] - b[1]}};
}
inline Pack operator*(Pack a, Pack b) {
    return Pack{{a[0] * b[0], a[1] * b[1]}};
}
inline Pack operator/(Pack a, Pack b) {
    return Pack{{a[0] / b[0], a[1] / b[1]}};
}
inline Pack& operator+=(Pack& a, Pack b) {
    return a = a + b;
}
inline Pack& operator-=(Pack& a, Pack b) {
    return a = a - b;
}
#endif

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_PACK_H_
