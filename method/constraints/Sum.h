// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_SUM_H_
#define OPENMMVRATTLE_SUM_H_

#include <cmath>

namespace OpenMMVRattle {

/** The larger, or the smaller, of two numbers, or a NaN if one is. */
inline double largerOf(double a, double b) {
    return a >= b || std::isnan(a) ? a : b;
}
inline double smallerOf(double a, double b) {
    return a <= b || std::isnan(a) ? a : b;
}

/**
 * The sum of term(0), ..., term(count - 1) in four interleaved parts: a processor waits for each addition to one number, and adds to
 * several at a time.
 */
template <class Term> double sumOf(int count, const Term& term) {
    double part[4] = {0, 0, 0, 0};
    int i = 0;
    for (; i + 4 <= count; i += 4)
        for (int j = 0; j < 4; j++)
            part[j] += term(i + j);
    for (; i < count; i++)
        part[0] += term(i);
    return (part[0] + part[1]) + (part[2] + part[3]);
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_SUM_H_
