// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_WIDE_H_
#define OPENMMVRATTLE_WIDE_H_

namespace OpenMMVRattle {

/*
 * Some functions are compiled a second time, with all that the compiler has inlined into them (GCC: whatever they call; Clang:
 * what it sees fit), for processors with wide vectors. The numbers are the same to the last bit, since nothing is contracted (-ffp-contract=off):
 *
 *     OPENMMVRATTLE_WIDE void workWide(...) { work(...); }
 *
 * is to be called in place of work() where hasWideVectors().
 */
#if defined(__x86_64__) && defined(__GNUC__)
    #define OPENMMVRATTLE_WIDE __attribute__((target("avx2"), flatten))
inline bool hasWideVectors() {
    static const bool result = __builtin_cpu_supports("avx2") > 0;
    return result;
}
#else
    #define OPENMMVRATTLE_WIDE
inline bool hasWideVectors() {
    return false;
}
#endif

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_WIDE_H_
