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
// Constraints are g = (|r|^2 - L^2)/2, so that a row of G is r on the first particle and -r on the second. r[(3*k + d)*STRIDE] are the
// components of r[k], in registers, or in local memory where there are more constraints than registers have room for; behind them are
// the multipliers gamma while they are found.

inline DEVICE mixed dotVector_KIND(VECTORS r, int k, const mixed* a) {
    return r[3*k*STRIDE]*a[0] + r[(3*k + 1)*STRIDE]*a[1] + r[(3*k + 2)*STRIDE]*a[2];
}

inline DEVICE mixed dotEachOther_KIND(VECTORS r, int k, int l) {
    const mixed a[3] = {r[3*l*STRIDE], r[(3*l + 1)*STRIDE], r[(3*l + 2)*STRIDE]};
    return dotVector_KIND(r, k, a);
}

CLUSTER_ALGEBRA

/** The distance vectors of the constraints. */
inline DEVICE void loadVectors_KIND(int c, GLOBAL const int* RESTRICT atoms, GLOBAL const real4* RESTRICT posq, GLOBAL const real4* RESTRICT posqCorrection, VECTORS r) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed x[NUM_ATOMS][3];
    UNROLL for (int i = 0; i < NUM_ATOMS; i++)
        loadPosition(posq, posqCorrection, atoms[ATOM_BASE + i*NUM_CLUSTERS + c], x[i]);
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        UNROLL for (int d = 0; d < 3; d++)
            r[(3*k + d)*STRIDE] = x[first[k]][d] - x[second[k]][d];
}

/** Lambda(q,v) (4.3), and the terms of the monitors there. */
inline DEVICE void measure_KIND(int c, int paddedNumAtoms, GLOBAL const int* RESTRICT atoms, GLOBAL const mm_long* force, VECTORS r, mixed* L, mixed (*v)[3], mixed* w,
        mixed* lambda, mixed* sums) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        mixed u[3];
        UNROLL for (int d = 0; d < 3; d++)
            u[d] = v[first[k]][d] - v[second[k]][d];
        lambda[k] = dot3(u, u);
    }
    mixed forceSquared = 1;
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        mixed a[3];
        forceSquared = loadAcceleration(AGAIN(NUM_CONSTRAINTS > 4 && forceSquared > 0, force), paddedNumAtoms, atoms[ATOM_BASE + i*NUM_CLUSTERS + c], w[i], a);
        addParticleTerms(sums, forceSquared, w[i], v[i]);
        UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
            if (first[k] == i)
                lambda[k] += dotVector_KIND(r, k, a);
            if (second[k] == i)
                lambda[k] -= dotVector_KIND(r, k, a);
        }
    }
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        r[(3*NUM_CONSTRAINTS + k)*STRIDE] = lambda[k];
    solve_KIND(L, lambda);
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        addConstraintTerms(sums, lambda[k], r[(3*NUM_CONSTRAINTS + k)*STRIDE]);
}

/** v += factor M^-1 G^T x */
inline DEVICE void push_KIND(VECTORS r, mixed* w, mixed* x, mixed factor, mixed (*v)[3]) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        UNROLL for (int d = 0; d < 3; d++) {
            const mixed impulse = factor*x[k]*r[(3*k + d)*STRIDE];
            v[first[k]][d] += w[first[k]]*impulse;
            v[second[k]][d] -= w[second[k]]*impulse;
        }
}

/** M^-1 (F - G^T Lambda) of a particle; returns what loadAcceleration() does. */
inline DEVICE mixed loadNetAcceleration_KIND(int i, GLOBAL const mm_long* force, int paddedNumAtoms, int atom, VECTORS r, mixed w, const mixed* lambda, mixed* a) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, atom, w, a);
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        if (first[k] == i || second[k] == i)
            UNROLL for (int d = 0; d < 3; d++)
                a[d] += (first[k] == i ? -w : w)*lambda[k]*r[(3*k + d)*STRIDE];
    return forceSquared;
}

// Registers are what clusters of many constraints lack. So what is needed again after a solution is read AGAIN and not kept, and those of
// five and more constraints, in which that saves nothing else, read one particle after the other and not all at once.

/** The velocities after a kick for that time. */
inline DEVICE void loadKicked_KIND(int c, int paddedNumAtoms, GLOBAL const int* RESTRICT atoms, GLOBAL const mixed4* velm, GLOBAL const mm_long* force, mixed kick, mixed* w, mixed (*v)[3]) {
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        const bool isReady = (NUM_CONSTRAINTS > 4 && i > 0 && v[i == 0 ? 0 : i - 1][0] > 0);
        mixed a[3];
        w[i] = loadVelocity(AGAIN(isReady, velm), atom, v[i]);
        loadAcceleration(AGAIN(isReady, force), paddedNumAtoms, atom, w[i], a);
        UNROLL for (int d = 0; d < 3; d++)
            v[i][d] += kick*a[d];
    }
}

/** (3.12)-(3.13) and Lambda; returns false if the constraints depend on each other or a force is no number. */
inline DEVICE bool finish_KIND(CLUSTER_PARAMETERS, mixed kick, mixed halfKick, bool formHalf, bool isStored, mixed* sums, mixed* halfSums LAST_STATE_PARAMETER) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    MAKE_VECTORS
    mixed v[NUM_ATOMS][3], w[NUM_ATOMS], L[NUM_ENTRIES], x1[NUM_CONSTRAINTS];
    loadVectors_KIND(c, atoms, posq, posqCorrection, r);
    bool isRegular = true;
#if UPDATE == AUTOMATIC
    // All are read before the first is replaced, where registers suffice: a load waits for the stores before it.
    const bool areFew = (NUM_CONSTRAINTS < 5);
    mixed terms[NUM_TERMS] = {0, 0, 0, 0, 0, 0};
    LastForce lastForce[NUM_ATOMS];
    if (areFew)
        UNROLL for (int i = 0; i < NUM_ATOMS; i++)
            lastForce[i] = loadLastForce(last, paddedNumAtoms, atoms[ATOM_BASE + i*NUM_CLUSTERS + c]);
#endif
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        mixed a[3];
        const bool isReady = (NUM_CONSTRAINTS > 4 && (i == 0 ? (mixed) r[0] : v[i == 0 ? 0 : i - 1][0]) > 0);
        w[i] = loadVelocity(AGAIN(isReady, velm), atom, v[i]);
        isRegular = loadAcceleration(AGAIN(isReady, force), paddedNumAtoms, atom, w[i], a) >= 0 && isRegular;
#if UPDATE == AUTOMATIC
        if (areFew)
            followForce(terms, last, lastForce[i], force, paddedNumAtoms, atom, w[i], v[i]);
#endif
        UNROLL for (int d = 0; d < 3; d++)
            v[i][d] += kick*a[d];
    }
#if UPDATE == AUTOMATIC // here or behind the right-hand side, wherever registers suffice
    isRegular = factorize_KIND(r, w, L) && isRegular;
#endif
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        x1[k] = 0;
        UNROLL for (int d = 0; d < 3; d++)
            x1[k] += r[(3*k + d)*STRIDE]*(v[first[k]][d] - v[second[k]][d]);
    }
#if UPDATE != AUTOMATIC
    isRegular = factorize_KIND(r, w, L) && isRegular;
#endif
    solve_KIND(L, x1);
    push_KIND(r, w, x1, -1, v);
    const bool isPushed = (x1[0] > 0 && (UPDATE != AUTOMATIC || NUM_CONSTRAINTS > 4));
    measure_KIND(c, paddedNumAtoms, atoms, AGAIN(isPushed, force), r, L, v, w, x1, sums);
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        multipliers[LENGTH_BASE + k*NUM_CLUSTERS + c] = x1[k];
        if (NUM_ENTRIES > 30)
            r[(3*NUM_CONSTRAINTS + k)*STRIDE] = x1[k];
    }
#if CLUSTER_SUMS
    mixed net[3] = {x1[0], 0, 0}, share = 0;
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        loadNetAcceleration_KIND(i, AGAIN((NUM_CONSTRAINTS < 5 ? x1[0] : net[0]) > 0, force), paddedNumAtoms, atoms[ATOM_BASE + i*NUM_CLUSTERS + c], r, w[i], x1, net);
        share += shareOf(dot3(net, net), w[i], v[i]);
    }
    isRegular = addCluster(sums, share) && isRegular;
#endif
#if UPDATE == AUTOMATIC
    mixed net[3] = {x1[0], 0, 0};
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        if (!areFew) {
            mixed before[3];
            loadVelocity(AGAIN(net[0] > 0, velm), atom, before);
            followForce(terms, last, loadLastForce(last, paddedNumAtoms, atom), force, paddedNumAtoms, atom, w[i], before);
        }
        addFlight(terms, loadNetAcceleration_KIND(i, AGAIN(!areFew && net[0] > 0, force), paddedNumAtoms, atom, r, w[i], x1, net), v[i]);
        addAutomaticTerms(terms, last, atom, w[i], v[i], net);
    }
    addCluster(sums, terms, last, atoms[ATOM_BASE + c]);
#endif
    // The on-step velocities go out, and those of the half step take their place.
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
#if HALF_SUMS
        mixed before[3], a[3];
        const bool isReady = ((i == 0 || NUM_CONSTRAINTS < 5 ? x1[0] : v[i == 0 ? 0 : i - 1][0]) > 0);
        loadVelocity(AGAIN(isReady, velm), atom, before);
        loadAcceleration(AGAIN(isReady, force), paddedNumAtoms, atom, w[i], a);
#endif
        if (isStored)
            velm[atom] = make_mixed4(v[i][0], v[i][1], v[i][2], w[i]);
#if HALF_SUMS
        UNROLL for (int d = 0; d < 3; d++)
            v[i][d] = (formHalf ? v[i][d] - halfKick*a[d] : before[d]);
#endif
    }
#if HALF_SUMS
    if (NUM_ENTRIES > 30) { // made and read again, since registers do not suffice for keeping them
        factorize_KIND(r, w, L);
        UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
            x1[k] = r[(3*NUM_CONSTRAINTS + k)*STRIDE];
    }
    push_KIND(r, w, x1, formHalf ? halfKick : (mixed) 0, v);
    measure_KIND(c, paddedNumAtoms, atoms, AGAIN(v[0][0] > 0, force), r, L, v, w, x1, halfSums);
#endif
    return isRegular;
}

/**
 * Solve g(q + dt (v + M^-1 G^T gamma/dt)) = 0 by Newton's iteration from gamma = -kick dt lambda; v are the velocities after a
 * kick for that time. Returns
 * the number of iterations, or -1 if they do not converge. There is at least one, since lambda itself, unrefined, costs accuracy even
 * where it meets the tolerance.
 */
inline DEVICE int constrain_KIND(int c, mixed kick, mixed dt, mixed tolerance, GLOBAL const mixed* RESTRICT lengths, GLOBAL const mixed* RESTRICT multipliers,
        VECTORS r, mixed* w, mixed (*v)[3], mixed* gamma) {
    const int first[] = FIRST_ATOMS, second[] = SECOND_ATOMS;
    mixed s[NUM_CONSTRAINTS][3];
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
        gamma[k] = -kick*dt*multipliers[LENGTH_BASE + k*NUM_CLUSTERS + c];
        r[(3*NUM_CONSTRAINTS + k)*STRIDE] = gamma[k];
        UNROLL for (int d = 0; d < 3; d++)
            s[k][d] = r[(3*k + d)*STRIDE] + dt*(v[first[k]][d] - v[second[k]][d]);
    }
    move_KIND(r, w, gamma, s);
    mixed previous = 1e30f;
    int iterations = -1;
    for (int iteration = 0; iteration <= MAX_ITERATIONS && iterations < 0; iteration++) {
        mixed g[NUM_CONSTRAINTS], error = 0;
        bool isNumber = true;
        UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++) {
            const mixed length = lengths[LENGTH_BASE + k*NUM_CLUSTERS + c], squared = length*length;
            g[k] = (squared - dot3(s[k], s[k]))/2;
            const mixed e = fabs(g[k])/squared;
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
                r[(3*NUM_CONSTRAINTS + k)*STRIDE] += g[k];
            move_KIND(r, w, g, s);
        }
    }
    UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
        gamma[k] = r[(3*NUM_CONSTRAINTS + k)*STRIDE];
    return iterations;
}

/** The monitors at the half-step velocities of a step of size dt; returns false if there is no such step. */
inline DEVICE bool try_KIND(CLUSTER_PARAMETERS, mixed dt, mixed tolerance, mixed* sums) {
    MAKE_VECTORS
    mixed v[NUM_ATOMS][3], w[NUM_ATOMS], L[NUM_ENTRIES], gamma[NUM_CONSTRAINTS];
    loadVectors_KIND(c, atoms, posq, posqCorrection, r);
    const bool isLoaded = (NUM_CONSTRAINTS > 4 && r[0] > 0);
    loadKicked_KIND(c, paddedNumAtoms, atoms, AGAIN(isLoaded, velm), AGAIN(isLoaded, force), dt/2, w, v);
    const int iterations = constrain_KIND(c, dt/2, dt, tolerance, lengths, multipliers, r, w, v, gamma);
    if (iterations >= 0) // where the next trial starts
        UNROLL for (int k = 0; k < NUM_CONSTRAINTS; k++)
            multipliers[LENGTH_BASE + k*NUM_CLUSTERS + c] = -2*gamma[k]/(dt*dt);
    loadKicked_KIND(c, paddedNumAtoms, atoms, AGAIN(gamma[0] > 0, velm), AGAIN(gamma[0] > 0, force), dt/2, w, v);
    push_KIND(r, w, gamma, dt > 0 ? 1/dt : (mixed) 0, v);
    const bool isRegular = factorize_KIND(r, w, L);
    measure_KIND(c, paddedNumAtoms, atoms, AGAIN(isRegular, force), r, L, v, w, gamma, sums);
    return isRegular && iterations >= 0;
}

/**
 * A kick and a drift (3.9)-(3.11), for these times; in Langevin dynamics noise follows, and the drift once more, from where the first
 * has left the state. Returns the number of iterations, or -1 if they do not converge.
 */
inline DEVICE int advance_KIND(CLUSTER_PARAMETERS, mixed kick, mixed dt, mixed tolerance, GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities NOISE_PARAMETERS) {
    MAKE_VECTORS
    mixed v[NUM_ATOMS][3], w[NUM_ATOMS], gamma[NUM_CONSTRAINTS];
    UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
        const int atom = atoms[ATOM_BASE + i*NUM_CLUSTERS + c];
        mixed x[3];
        const real charge = loadPosition(posq, posqCorrection, atom, x);
        oldPositions[atom] = make_mixed4(x[0], x[1], x[2], charge);
        oldVelocities[atom] = velm[atom];
    }
    int iterations = 0;
    KEEP_LOOP for (int drift = 0; drift < NUM_DRIFTS; drift++) {
        const mixed kickNow = (drift == 0 ? kick : (mixed) 0);
        // Kept through both drifts in mixed precision they would be too much for eight bonds on one particle.
        GLOBAL const int* RESTRICT particles = AGAIN(NUM_ENTRIES > 30 && sizeof(real) < sizeof(mixed) && iterations > 0, atoms);
        loadVectors_KIND(c, particles, posq, posqCorrection, r);
        const bool isLoaded = (NUM_CONSTRAINTS > 4 && r[0] > 0);
        loadKicked_KIND(c, paddedNumAtoms, particles, AGAIN(isLoaded, velm), AGAIN(isLoaded, force), kickNow, w, v);
        const int more = constrain_KIND(c, kickNow, dt, tolerance, lengths, multipliers, r, w, v, gamma);
        iterations = (iterations >= 0 && more >= 0 ? iterations + more : -1);
        if (more >= 0) {
            loadKicked_KIND(c, paddedNumAtoms, particles, AGAIN(gamma[0] > 0, velm), AGAIN(gamma[0] > 0, force), kickNow, w, v);
            push_KIND(r, w, gamma, dt > 0 ? 1/dt : (mixed) 0, v);
#if UPDATE == LANGEVIN
            const Noise noise = makeNoise(step, AGAIN(v[0][0] > 0, noiseState), AGAIN(v[0][0] > 0, settings));
#endif
            UNROLL for (int i = 0; i < NUM_ATOMS; i++) {
                const int atom = particles[ATOM_BASE + i*NUM_CLUSTERS + c];
                mixed x[3];
                const real charge = loadPosition(AGAIN(v[0][0] > 0, posq), AGAIN(v[0][0] > 0, posqCorrection), atom, x);
                storePosition(posq, posqCorrection, atom, x[0] + dt*v[i][0], x[1] + dt*v[i][1], x[2] + dt*v[i][2], charge);
#if UPDATE == LANGEVIN
                if (drift == 0 && NUM_CONSTRAINTS < 5)
                    addNoise(noise, atomIndex[atom], w[i], v[i]);
#endif
                velm[atom] = make_mixed4(v[i][0], v[i][1], v[i][2], w[i]);
            }
#if UPDATE == LANGEVIN
            KEEP_LOOP for (int i = 0; i < (drift == 0 && NUM_CONSTRAINTS > 4 ? NUM_ATOMS : 0); i++) {
                const int atom = particles[ATOM_BASE + i*NUM_CLUSTERS + c];
                mixed u[3];
                const mixed inverseMass = loadVelocity(velm, atom, u);
                addNoise(noise, atomIndex[atom], inverseMass, u);
                velm[atom] = make_mixed4(u[0], u[1], u[2], inverseMass);
            }
#endif
        }
    }
    return iterations;
}
