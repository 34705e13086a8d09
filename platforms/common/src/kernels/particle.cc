// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// A particle that is in no constraint. The functions are those of cluster.cc.

inline DEVICE bool finish_KIND(CLUSTER_PARAMETERS, mixed kick, mixed halfKick, bool formHalf, bool isStored, mixed* sums, mixed* halfSums LAST_STATE_PARAMETER) {
    const int atom = atoms[ATOM_BASE + c];
    mixed w[3], v[3], a[3];
    const mixed inverseMass = loadVelocity(velm, atom, w);
    const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, atom, inverseMass, a);
    UNROLL for (int d = 0; d < 3; d++)
        v[d] = w[d] + kick*a[d];
    if (isStored)
        velm[atom] = make_mixed4(v[0], v[1], v[2], inverseMass);
    addParticleTerms(sums, forceSquared, inverseMass, v);
#if HALF_SUMS
    if (formHalf)
        UNROLL for (int d = 0; d < 3; d++)
            w[d] = v[d] - halfKick*a[d];
    addParticleTerms(halfSums, forceSquared, inverseMass, w);
#endif
#if UPDATE == AUTOMATIC
    mixed terms[NUM_TERMS] = {0, 0, 0, 0, 0, 0};
    followForce(terms, last, loadLastForce(last, paddedNumAtoms, atom), force, paddedNumAtoms, atom, inverseMass, w);
    addFlight(terms, forceSquared, v);
    addAutomaticTerms(terms, last, atom, inverseMass, v, a);
    addCluster(sums, terms, last, atom);
#endif
#if CLUSTER_SUMS
    return addCluster(sums, shareOf(dot3(a, a), inverseMass, v)) && forceSquared >= 0;
#else
    return forceSquared >= 0;
#endif
}

inline DEVICE bool try_KIND(CLUSTER_PARAMETERS, mixed dt, mixed tolerance, mixed* sums) {
    const int atom = atoms[ATOM_BASE + c];
    mixed v[3], a[3];
    const mixed inverseMass = loadVelocity(velm, atom, v);
    const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, atom, inverseMass, a);
    UNROLL for (int d = 0; d < 3; d++)
        v[d] += dt/2*a[d];
    addParticleTerms(sums, forceSquared, inverseMass, v);
    return true;
}

inline DEVICE int advance_KIND(CLUSTER_PARAMETERS, mixed kick, mixed dt, mixed tolerance, GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities NOISE_PARAMETERS) {
    const int atom = atoms[ATOM_BASE + c];
    mixed x[3], v[3], a[3];
    const real charge = loadPosition(posq, posqCorrection, atom, x);
    const mixed inverseMass = loadVelocity(velm, atom, v);
    loadAcceleration(force, paddedNumAtoms, atom, inverseMass, a);
    oldPositions[atom] = make_mixed4(x[0], x[1], x[2], charge);
    oldVelocities[atom] = make_mixed4(v[0], v[1], v[2], inverseMass);
    UNROLL for (int d = 0; d < 3; d++)
        v[d] += kick*a[d];
#if UPDATE == LANGEVIN
    UNROLL for (int d = 0; d < 3; d++)
        x[d] += dt*v[d];
    addNoise(makeNoise(step, noiseState, settings), atomIndex[atom], inverseMass, v);
#endif
    storePosition(posq, posqCorrection, atom, x[0] + dt*v[0], x[1] + dt*v[1], x[2] + dt*v[2], charge);
    velm[atom] = make_mixed4(v[0], v[1], v[2], inverseMass);
    return 0;
}
