// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Automatic step control (docs/automatic_method.md). finishStep adds up S_c, A_c and B_c of each cluster, and the fourth powers of
// the latter two; the recursions, whose text the host has too, run where the density of the next step is found.

AUTOMATIC_RECURSIONS

// The sums are those of fourth powers, and the last three terms below.

// What is added up over the particles of a cluster, or of a piece of one, before that.
#define TERM_SQUARES 0 // S_c
#define TERM_FLIGHT 1  // A_c - S_c
#define TERM_WORK 2    // w[n-1/2].(F[n] - F[n-1])
#define TERM_KINETIC 3
#define TERM_CHANGE 4  // the square of what others have changed velocities or forces by, in the mass metric
#define TERM_SCALE 5   // that of the velocities or forces
// Behind the sums of a piece: of how many pieces its cluster is, if it is the first of them, else 0.
#define PIECE_COUNT NUM_TERMS

/** What is known of the state before. */
typedef struct {
    GLOBAL mm_long* forces;           // F[n-1] of each particle, in the order in which the Context began: OpenMM reorders its own arrays
    GLOBAL mixed* squares;            // S_c[n-1], likewise, at the place of the first particle of a cluster or piece
    GLOBAL const int* order;          // the place of each particle there
    GLOBAL const mixed4* velocities;  // of each particle, before others have changed them
    int change;                       // what others have changed
    mixed rate;                       // 6/dt of the step that leads here; 0 if none does
} LastState;

#define LAST_STATE_PARAMETERS , GLOBAL mm_long* RESTRICT lastForces, GLOBAL mixed* RESTRICT lastSquares, GLOBAL const int* RESTRICT firstOrder, \
        GLOBAL const mixed4* RESTRICT lastVelocities
#define LAST_STATE_PARAMETER , LastState last
#define LAST_STATE_ARGUMENT , last
#define MAKE_LAST_STATE(kick, dt, change) const LastState last = makeLastState(kick, dt, change, lastForces, lastSquares, firstOrder, lastVelocities);

inline DEVICE LastState makeLastState(mixed kick, mixed dt, int change LAST_STATE_PARAMETERS) {
    LastState last;
    last.forces = lastForces;
    last.squares = lastSquares;
    last.order = firstOrder;
    last.velocities = lastVelocities;
    last.change = change;
    last.rate = (kick > 0 ? (mixed) CHANGE_WEIGHT/dt : (mixed) 0);
    return last;
}

/** F[n-1] of a particle, and where it is kept. */
typedef struct {
    int place;
    mm_long sums[3];
} LastForce;

inline DEVICE LastForce loadLastForce(LastState last, int paddedNumAtoms, int atom) {
    LastForce result;
    result.place = last.order[atom];
    UNROLL for (int d = 0; d < 3; d++)
        result.sums[d] = last.forces[result.place + d*paddedNumAtoms];
    return result;
}

/** The terms of a particle with inverse mass w and half-step velocity v that compare forces; then F[n] takes the place of F[n-1]. */
inline DEVICE void followForce(mixed* terms, LastState last, LastForce lastForce, GLOBAL const mm_long* RESTRICT force, int paddedNumAtoms, int atom, mixed w, const mixed* v) {
    const mixed scale = 1/(mixed) 0x100000000;
    mixed change[3], now[3], before[3];
    UNROLL for (int d = 0; d < 3; d++) {
        const mm_long sum = force[atom + d*paddedNumAtoms], lastSum = lastForce.sums[d];
        change[d] = scale*(sum - lastSum);
        now[d] = scale*sum;
        before[d] = scale*lastSum;
        last.forces[lastForce.place + d*paddedNumAtoms] = sum;
    }
    terms[TERM_WORK] += dot3(v, change);
    if (last.change == FORCES_CHANGED) {
        terms[TERM_CHANGE] += w*dot3(change, change);
        terms[TERM_SCALE] += w*max(dot3(now, now), dot3(before, before));
    }
}

inline DEVICE void addFlight(mixed* terms, mixed forceSquared, const mixed* v) {
    terms[TERM_FLIGHT] += sqrt(max(forceSquared, (mixed) 0))*dot3(v, v)*(mixed) LENGTH_WEIGHT;
}

/** The other terms, with the acceleration a by the net force F - G^T Lambda. */
inline DEVICE void addAutomaticTerms(mixed* terms, LastState last, int atom, mixed w, const mixed* v, const mixed* a) {
    const mixed mass = 1/w, speedSquared = dot3(v, v), momentum = mass*speedSquared;
    terms[TERM_SQUARES] += mass*dot3(a, a) + momentum*speedSquared*(mixed) FLIGHT_WEIGHT;
    terms[TERM_KINETIC] += momentum;
    if (last.change == VELOCITIES_CHANGED) {
        const mixed4 before = last.velocities[atom];
        const mixed change[3] = {v[0] - before.x, v[1] - before.y, v[2] - before.z};
        terms[TERM_CHANGE] += mass*dot3(change, change);
        terms[TERM_SCALE] += momentum;
    }
}

/** What all particles of a cluster together add to the sums; work is rate |sum of TERM_WORK|. */
inline DEVICE void addHardness(mixed* sums, mixed onStep, mixed work, mixed meanSquares, const mixed* terms) {
    addFourthPower(sums + SUM_ON_STEP, onStep);
    addFourthPower(sums + SUM_HALF_STEP, work + meanSquares);
    sums[SUM_KINETIC] += terms[TERM_KINETIC];
    sums[SUM_CHANGE] += terms[TERM_CHANGE];
    sums[SUM_SCALE] += terms[TERM_SCALE];
}

/** S_c[n] takes the place of S_c[n-1]; returns their mean over the step. */
inline DEVICE mixed followSquares(LastState last, int firstAtom, mixed squares) {
    const int place = last.order[firstAtom];
    const mixed before = last.squares[place];
    last.squares[place] = squares;
    return last.rate > 0 ? (squares + before)/2 : squares;
}

inline DEVICE void addCluster(mixed* sums, const mixed* terms, LastState last, int firstAtom) {
    addHardness(sums, terms[TERM_SQUARES] + terms[TERM_FLIGHT], last.rate*fabs(terms[TERM_WORK]),
            followSquares(last, firstAtom, terms[TERM_SQUARES]), terms);
}

#if NUM_PIECES > 0

// What a piece leaves in the place of sums is what is added up over the pieces of its cluster: A_c, w.(F[n] - F[n-1]) times the rate,
// the mean of S_c, and the others.

inline DEVICE void closePiece(mixed* terms, LastState last, int firstAtom, int numPieces) {
    const mixed squares = terms[TERM_SQUARES];
    terms[0] = squares + terms[TERM_FLIGHT];
    terms[1] = followSquares(last, firstAtom, squares);
    terms[TERM_WORK] *= last.rate;
    terms[PIECE_COUNT] = numPieces;
}

/** Add the clusters of pieces, each by the thread that has its first piece. */
inline DEVICE void addClustersOfPieces(int numPartials, GLOBAL const mixed* RESTRICT partials, mixed* sums) {
    const int first = numPartials - NUM_PIECES;
    for (int i = first + LOCAL_ID; i < numPartials; i += GROUP_SIZE) {
        const int count = (int) partials[PIECE_COUNT*numPartials + i];
        mixed terms[NUM_TERMS];
        for (int j = 0; j < NUM_TERMS; j++)
            terms[j] = 0;
        for (int k = i; k < i + count; k++)
            for (int j = 0; j < NUM_TERMS; j++)
                terms[j] += partials[j*numPartials + k];
        if (count > 0)
            addHardness(sums, terms[0], fabs(terms[TERM_WORK]), terms[1], terms);
    }
}

#endif

// ------------------------------------------------------------------------------------- the numbers in the control block

inline DEVICE AutomaticChoice loadChoice(GLOBAL const wide* RESTRICT settings) {
    AutomaticChoice choice;
    UNROLL for (int i = 0; i < NUM_CHOICES; i++)
        ((wide*) &choice)[i] = settings[FIRST_TERM + i];
    return choice;
}

inline DEVICE wide temperatureOf(const mixed* sums, GLOBAL const wide* RESTRICT settings) {
    return (wide) sums[SUM_KINETIC]*settings[FIRST_TERM + NUM_CHOICES];
}

/** Whether the monitors are numbers, and particles as fast as they can be. */
inline DEVICE bool areMonitorsValid(const mixed* sums, GLOBAL const wide* RESTRICT settings) {
    const wide largest = (wide) 1e30f;
    const AutomaticChoice choice = loadChoice(settings);
    return eighthRoot(sums[SUM_ON_STEP]) < largest && eighthRoot(sums[SUM_HALF_STEP]) < largest &&
           temperatureOf(sums, settings) <= choice.hottest;
}

/** Take over the end of the last step, if that has not been done. */
inline DEVICE void acceptAutomaticStep(const mixed* sums, wide* now, GLOBAL const wide* RESTRICT settings) {
    if (now[IS_ACCEPTED] != 0)
        return;
    const AutomaticChoice choice = loadChoice(settings);
    const wide kT = temperatureOf(sums, settings);
    wide* references = now + FIRST_REFERENCE;
    AutomaticNumbers numbers;
    UNROLL for (int i = 0; i < NUM_NUMBERS; i++)
        ((wide*) &numbers)[i] = now[FIRST_NUMBER + i];
    numbers.values[0] = eighthRoot(sums[SUM_ON_STEP]);
    numbers.values[1] = eighthRoot(sums[SUM_HALF_STEP]);
    if (now[IS_SHORTENED] == 0)
        automaticMoveOn(&numbers, references, &choice, kT);
    else {
        automaticMoveOnPart(&numbers, references, &choice, kT, min((wide) 1, now[STEP_SIZE]*automaticDensity(&choice, numbers.ahead)/choice.stepSize));
        now[DENSITY] = automaticDensity(&choice, numbers.behind);
    }
    if (now[IS_JUMP] != 0)
        automaticChange(&numbers, references, &choice, kT, numbers.values[0], 1);
    now[IS_ACCEPTED] = 1;
    UNROLL for (int i = 0; i < NUM_NUMBERS; i++)
        now[FIRST_NUMBER + i] = ((wide*) &numbers)[i];
}

/** Go on after others have changed the state. */
inline DEVICE void changeAutomaticState(const mixed* sums, int change, wide* now, GLOBAL const wide* RESTRICT settings) {
    const AutomaticChoice choice = loadChoice(settings);
    const wide kT = temperatureOf(sums, settings);
    const wide part = (change == ALL_CHANGED ? (wide) 1 : min((wide) 1, sqrt((wide) sums[SUM_CHANGE]/max((wide) sums[SUM_SCALE], (wide) 1e-30f))));
    AutomaticNumbers numbers;
    UNROLL for (int i = 0; i < NUM_NUMBERS; i++)
        ((wide*) &numbers)[i] = now[FIRST_NUMBER + i];
    automaticChange(&numbers, now + FIRST_REFERENCE, &choice, kT, eighthRoot(sums[SUM_ON_STEP]), part);
    if (change != VELOCITIES_CHANGED) // else the kick of the last step is in the half-step momentum
        now[DENSITY] = automaticDensity(&choice, numbers.behind);
    UNROLL for (int i = 0; i < NUM_NUMBERS; i++)
        now[FIRST_NUMBER + i] = ((wide*) &numbers)[i];
}

/** The density of the step that comes, once the last one is accepted. */
inline DEVICE wide nextAutomaticDensity(const wide* now, GLOBAL const wide* RESTRICT settings) {
    const AutomaticChoice choice = loadChoice(settings);
    const wide ahead[2] = {now[FIRST_NUMBER + 2], now[FIRST_NUMBER + 3]};
    return automaticDensity(&choice, ahead);
}

/** For evaluateState; false if a monitor is no number. */
inline DEVICE bool evaluateAutomaticState(const mixed* sums, int change, GLOBAL wide* RESTRICT control, GLOBAL const wide* RESTRICT settings) {
    if (!areMonitorsValid(sums, settings))
        return false;
    wide now[CONTROL_SIZE];
    for (int i = 0; i < CONTROL_SIZE; i++)
        now[i] = control[i];
    if (change == 0)
        acceptAutomaticStep(sums, now, settings);
    else
        changeAutomaticState(sums, change, now, settings);
    for (int i = 0; i < CONTROL_SIZE; i++)
        control[i] = now[i];
    return true;
}
