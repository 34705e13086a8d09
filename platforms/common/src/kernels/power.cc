// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// A p-norm (sum |x|^p)^(1/p); written once for each order p. Its sum is two numbers, so that no power overflows: the largest |x|
// so far, and the sum of (|x|/largest)^p.

/** x^p for x >= 0. */
inline DEVICE mixed raise_ORDER(mixed x) {
    RAISE
}

inline DEVICE void addPower_ORDER(mixed* sum, mixed x) {
    if (x > sum[0]) {
        sum[1] = sum[1]*raise_ORDER(sum[0]/x) + 1;
        sum[0] = x;
    }
    else if (sum[0] > 0)
        sum[1] += raise_ORDER(x/sum[0]);
}

inline DEVICE void mergePower_ORDER(mixed* sum, const mixed* other) {
    const mixed largest = max(sum[0], other[0]);
    if (largest > 0)
        sum[1] = sum[1]*raise_ORDER(sum[0]/largest) + other[1]*raise_ORDER(other[0]/largest);
    sum[0] = largest;
}
