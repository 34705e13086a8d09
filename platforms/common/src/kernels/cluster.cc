// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Clusters of NUM_CONSTRAINTS distance constraints between NUM_ATOMS particles, all with the same constraint graph. The host writes
// this text once for each graph; all loops unroll and all indices are constants, so that everything is in registers. What the graph
// decides (which entries of K = G M^-1 G^T there are) is written out by the host in the functions of CLUSTER_ALGEBRA:
//
//     factorize_KIND(r, w, L): K = L D L^T; false if it is not positive definite (docs/method.md, section 8)
//     solve_KIND(L, b):        b <- K^-1 b
//     newton_KIND(s, r, w, b): b <- A^-1 b with the rows s[k] on the left: A[k][l] = s[k] . M^-1 r[l]
//     move_KIND(r, w, x, s):   s[k] += (the change of the distance vector of k by the displacements M^-1 G^T x)
//
// Constraints are g = (|r|^2 - L^2)/2, so that a row of G is r on the first particle and -r on the second.

CLUSTER_ALGEBRA

/** Lambda(q,v) (4.3), and the terms of the monitors there. */
inline DEVICE void measure_KIND(mixed (*r)[3], mixed* L, mixed (*v)[3], mixed (*a)[3], mixed* w, mixed* forceSquared, mixed* lambda, mixed* sums) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed rightSide[NUM_CONSTRAINTS];
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        mixed y = 0;
        UNROLL for (int d = 0; d < 3; d++) {
            const mixed u = v[first[k]][d] - v[second[k]][d];
            y += u*u + r[k][d]*(a[first[k]][d] - a[second[k]][d]);
        }
        rightSide[k] = lambda[k] = y;
    }
    solve_KIND(L, lambda);
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        addConstraintTerms(sums, lambda[k], rightSide[k]);
    UNROLL for (int i = 0; i < NUM_ATOMS; i++)
        addParticleTerms(sums, forceSquared[i], w[i], v[i]);
}

/** v += factor M^-1 G^T x */
inline DEVICE void push_KIND(mixed (*r)[3], mixed* w, mixed* x, mixed factor, mixed (*v)[3]) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        UNROLL for (int d = 0; d < 3; d++) {
            const mixed impulse = factor*x[k]*r[k][d];
            v[first[k]][d] += w[first[k]]*impulse;
            v[second[k]][d] -= w[second[k]]*impulse;
        }
}

/** (3.12)-(3.13) and Lambda; returns false if the constraints depend on each other or a force is no number. */
inline DEVICE bool finish_KIND(CLUSTER_PARAMETERS, mixed kick, mixed halfKick, bool formHalf, bool isStored, mixed* sums, mixed* halfSums LAST_STATE_PARAMETER) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed x[NUM_ATOMS][3], v[NUM_ATOMS][3], a[NUM_ATOMS][3], w[NUM_ATOMS], forceSquared[NUM_ATOMS];
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        loadPosition(posq, posqCorrection, atom, x[i]);
        w[i] = loadVelocity(velm, atom, v[i]);
        forceSquared[i] = loadAcceleration(force, paddedNumAtoms, atom, w[i], a[i]);
    }
#if UPDATE == AUTOMATIC
    mixed terms[NUM_TERMS] = {0, 0, 0, 0, 0, 0};
    UNROLL for (int i = 0; i < NUM_ATOMS; i++)
        followForce(terms, last, force, paddedNumAtoms, atoms[ATOM_BASE + i*NUM_CLUSTERS + c], w[i], v[i][0], v[i][1], v[i][2]);
#endif
#if HALF_SUMS
    mixed before[NUM_ATOMS][3];
#endif
    UNROLL for (int i = 0; i < NUM_ATOMS; i++)
        UNROLL for (int d = 0; d < 3; d++) {
#if HALF_SUMS
            before[i][d] = v[i][d];
#endif
            v[i][d] += kick*a[i][d];
        }
    mixed r[NUM_CONSTRAINTS][3], L[NUM_ENTRIES], x1[NUM_CONSTRAINTS];
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        x1[k] = 0;
        UNROLL for (int d = 0; d < 3; d++) {
            r[k][d] = x[first[k]][d] - x[second[k]][d];
            x1[k] += r[k][d]*(v[first[k]][d] - v[second[k]][d]);
        }
    }
    bool isRegular = factorize_KIND(r, w, L);
    UNROLL for (int i = 0; i < NUM_ATOMS; i++)
        isRegular = isRegular && forceSquared[i] >= 0;
    solve_KIND(L, x1);
    push_KIND(r, w, x1, -1, v);
    if (isStored)
        UNROLL for (int i = 0; i < NUM_ATOMS; i++)
            velm[atoms[ATOM_BASE + i*NUM_CLUSTERS + c]] = make_mixed4(v[i][0], v[i][1], v[i][2], w[i]);
    measure_KIND(r, L, v, a, w, forceSquared, x1, sums);
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        multipliers[LENGTH_BASE + k*NUM_CLUSTERS + c] = x1[k];
#if HALF_SUMS
    if (formHalf) {
        UNROLL for (int i = 0; i < NUM_ATOMS; i++)
            UNROLL for (int d = 0; d < 3; d++)
                before[i][d] = v[i][d] - halfKick*a[i][d];
        push_KIND(r, w, x1, halfKick, before);
    }
    measure_KIND(r, L, before, a, w, forceSquared, x1, halfSums);
#endif
#if UPDATE == AUTOMATIC
    push_KIND(r, w, x1, -1, a); // F - G^T Lambda
    UNROLL for (int i = 0; i < NUM_ATOMS; i++)
        addAutomaticTerms(terms, last, atoms[ATOM_BASE + i*NUM_CLUSTERS + c], forceSquared[i], w[i], v[i], a[i]);
    addCluster(sums, terms, last, atoms[ATOM_BASE + c]);
#endif
    return isRegular;
}

/**
 * Solve g(q + dt (v + M^-1 G^T gamma/dt)) = 0 by Newton's iteration from gamma = -dt^2/2 lambda; v are the kicked velocities and
 * get the impulses. Returns the number of iterations, or -1 if they do not converge. There is at least one, since lambda itself,
 * unrefined, costs accuracy even where it meets the tolerance.
 */
inline DEVICE int constrain_KIND(int c, mixed dt, mixed tolerance, GLOBAL const mixed* RESTRICT lengths, GLOBAL const mixed* RESTRICT multipliers,
        mixed (*r)[3], mixed* w, mixed (*v)[3], mixed* gamma) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed s[NUM_CONSTRAINTS][3], squared[NUM_CONSTRAINTS];
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        const mixed length = lengths[LENGTH_BASE + k*NUM_CLUSTERS + c];
        squared[k] = length*length;
        gamma[k] = -dt*dt/2*multipliers[LENGTH_BASE + k*NUM_CLUSTERS + c];
        UNROLL for (int d = 0; d < 3; d++)
            s[k][d] = r[k][d] + dt*(v[first[k]][d] - v[second[k]][d]);
    }
    move_KIND(r, w, gamma, s);
    mixed previous = 1e30f;
    int iterations = -1;
    for (int iteration = 0; iteration <= MAX_ITERATIONS && iterations < 0; iteration++) {
        mixed g[NUM_CONSTRAINTS], error = 0;
        bool isNumber = true;
        UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
            g[k] = (squared[k] - dot3(s[k], s[k]))/2;
            const mixed e = fabs(g[k])/squared[k];
            error = max(error, e);
            isNumber = isNumber && e < (mixed) 1e30f;
        }
        // To a fraction of the tolerance, or as far as rounding allows.
        if (isNumber && iteration > 0 && (error <= tolerance*MARGIN || (error <= tolerance && !(error < previous*SLOW_CONVERGENCE))))
            iterations = iteration;
        else {
            previous = error;
            newton_KIND(s, r, w, g);
            UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
                gamma[k] += g[k];
            move_KIND(r, w, g, s);
        }
    }
    push_KIND(r, w, gamma, dt > 0 ? 1/dt : (mixed) 0, v);
    return iterations;
}

/** The monitors at the half-step velocities of a step of size dt; returns false if there is no such step. */
inline DEVICE bool try_KIND(CLUSTER_PARAMETERS, mixed dt, mixed tolerance, mixed* sums) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed x[NUM_ATOMS][3], v[NUM_ATOMS][3], a[NUM_ATOMS][3], w[NUM_ATOMS], forceSquared[NUM_ATOMS];
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        loadPosition(posq, posqCorrection, atom, x[i]);
        w[i] = loadVelocity(velm, atom, v[i]);
        forceSquared[i] = loadAcceleration(force, paddedNumAtoms, atom, w[i], a[i]);
        UNROLL for (int d = 0; d < 3; d++)
            v[i][d] += dt/2*a[i][d];
    }
    mixed r[NUM_CONSTRAINTS][3], L[NUM_ENTRIES], gamma[NUM_CONSTRAINTS];
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        UNROLL for (int d = 0; d < 3; d++)
            r[k][d] = x[first[k]][d] - x[second[k]][d];
    const int iterations = constrain_KIND(c, dt, tolerance, lengths, multipliers, r, w, v, gamma);
    if (iterations >= 0) // where the next trial starts
        UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
            multipliers[LENGTH_BASE + k*NUM_CLUSTERS + c] = -2*gamma[k]/(dt*dt);
    const bool isRegular = factorize_KIND(r, w, L);
    measure_KIND(r, L, v, a, w, forceSquared, gamma, sums);
    return isRegular && iterations >= 0;
}

/** (3.9)-(3.11); returns the number of iterations, or -1 if they do not converge. */
inline DEVICE int advance_KIND(CLUSTER_PARAMETERS, mixed dt, mixed tolerance, GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed x[NUM_ATOMS][3], v[NUM_ATOMS][3], w[NUM_ATOMS], gamma[NUM_CONSTRAINTS];
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        mixed a[3];
        const real charge = loadPosition(posq, posqCorrection, atom, x[i]);
        w[i] = loadVelocity(velm, atom, v[i]);
        loadAcceleration(force, paddedNumAtoms, atom, w[i], a);
        oldPositions[atom] = make_mixed4(x[i][0], x[i][1], x[i][2], charge);
        oldVelocities[atom] = make_mixed4(v[i][0], v[i][1], v[i][2], w[i]);
        UNROLL for (int d = 0; d < 3; d++)
            v[i][d] += dt/2*a[d];
    }
    mixed r[NUM_CONSTRAINTS][3];
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        UNROLL for (int d = 0; d < 3; d++)
            r[k][d] = x[first[k]][d] - x[second[k]][d];
    const int iterations = constrain_KIND(c, dt, tolerance, lengths, multipliers, r, w, v, gamma);
    if (iterations >= 0)
        UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
            const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
            // Read again rather than kept: registers are what large clusters lack.
            const mixed4 old = oldPositions[atom];
            storePosition(posq, posqCorrection, atom, old.x + dt*v[i][0], old.y + dt*v[i][1], old.z + dt*v[i][2], (real) old.w);
            velm[atom] = make_mixed4(v[i][0], v[i][1], v[i][2], w[i]);
        }
    return iterations;
}
