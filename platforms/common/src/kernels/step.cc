// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The steps of VRATTLE on a device (docs/method.md). From the on-step state (q[n], v[n], F[n], rho[n-1/2]) a step is plain RATTLE
// with the step size h/rho[n+1/2]: what the half-step momentum differs by lies in the range of G^T and is absorbed by lambda.
//
// Words in capitals that are no macros of OpenMM come from the host (StepProgram.cpp). `mixed` is OpenMM's type for positions and
// velocities; `wide` is double where the device has it.

#define UNROLL _Pragma("unroll")
// Loops that a compiler might write out many times over: what does not fit into the instruction cache costs more.
#define KEEP_LOOP _Pragma("unroll 1")
// The same for functions.
#define SELDOM __attribute__((noinline))

typedef WIDE wide;
typedef unsigned int word_t;

inline DEVICE mixed dot3(const mixed* a, const mixed* b) {
    return a[0]*b[0] + a[1]*b[1] + a[2]*b[2];
}

/** The position of a particle; returns its charge, which lies beside it. */
inline DEVICE real loadPosition(GLOBAL const real4* RESTRICT posq, GLOBAL const real4* RESTRICT posqCorrection, int i, mixed* x) {
    real4 p = posq[i];
#ifdef USE_MIXED_PRECISION
    real4 d = posqCorrection[i];
    x[0] = p.x + (mixed) d.x;
    x[1] = p.y + (mixed) d.y;
    x[2] = p.z + (mixed) d.z;
#else
    x[0] = p.x;
    x[1] = p.y;
    x[2] = p.z;
#endif
    return p.w;
}

inline DEVICE void storePosition(GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, int i, mixed x, mixed y, mixed z, real q) {
    posq[i] = make_real4((real) x, (real) y, (real) z, q);
#ifdef USE_MIXED_PRECISION
    posqCorrection[i] = make_real4((real) (x - (real) x), (real) (y - (real) y), (real) (z - (real) z), 0);
#endif
}

/** The velocity of a particle; returns its inverse mass, which lies beside it. */
inline DEVICE mixed loadVelocity(GLOBAL const mixed4* RESTRICT velm, int i, mixed* v) {
    mixed4 p = velm[i];
    v[0] = p.x;
    v[1] = p.y;
    v[2] = p.z;
    return p.w;
}

/**
 * The acceleration M^-1 F of a particle of inverse mass w; returns |F|^2, or -1 if F is beyond what may be the sum of numbers
 * (ComputeVectors.cpp).
 */
inline DEVICE mixed loadAcceleration(GLOBAL const mm_long* RESTRICT force, int paddedNumAtoms, int i, mixed w, mixed* a) {
    const mixed scale = 1/(mixed) 0x100000000;
    mixed square = 0;
    bool isNumber = true;
    UNROLL for (int d = 0; d < 3; d++) {
        const mm_long sum = force[i + d*paddedNumAtoms];
        const mixed f = scale*sum;
        a[d] = w*f;
        square += f*f;
        isNumber = isNumber && sum < 0x4000000000000000 && sum > -0x4000000000000000;
    }
    return isNumber ? square : (mixed) -1;
}

/** f(rho) = (rho - a) - (1 - a)^2/(rho - a) and its inverse (docs/method.md, section 3). */
inline DEVICE wide stretch(wide rho, wide a) {
    return rho - a - (1 - a)*(1 - a)/(rho - a);
}

inline DEVICE wide unstretch(wide y, wide a) {
    const wide c = 1 - a, root = sqrt(y*y + 4*c*c);
    return a + (y > 0 ? (y + root)/2 : 2*c*c/(root - y));
}

// ---------------------------------------------------------------------------------------------------------------- the monitors

POWER_FUNCTIONS

/**
 * Sums of the fourth powers of A_c, of 2^-16 of it, so that they have room in a float: from 6e-6 to 20,000 thermal units (section 5 of
 * docs/automatic_method.md) for U at 2 fs. Above that nothing is added but the largest power; what is no number stays so.
 */
inline DEVICE void addFourthPower(mixed* sum, mixed x) {
    const mixed scaled = x/65536, square = scaled*scaled;
    *sum += (scaled > LARGEST_OF_FOURTH_POWERS && x < (mixed) 1e37f ? LARGEST_FOURTH_POWER : square*square);
}

/** U = (sum A_c^4)^(1/8) */
inline DEVICE wide eighthRoot(mixed sum) {
    return 256*sqrt(sqrt(sqrt((wide) sum)));
}

/** Add what one constraint gives to the sums of the monitors: lambda is that of g = (|r|^2 - L^2)/2, rightSide is K lambda. */
inline DEVICE void addConstraintTerms(mixed* sums, mixed lambda, mixed rightSide) {
    CONSTRAINT_TERMS
}

/** The same for a particle with inverse mass w. */
inline DEVICE void addParticleTerms(mixed* sums, mixed forceSquared, mixed w, const mixed* v) {
    PARTICLE_TERMS
}

#if CLUSTER_SUMS

/** What a particle with inverse mass w and the net acceleration, applied and of constraints, gives to the sum A_c of its cluster. */
inline DEVICE mixed shareOf(mixed netSquared, mixed w, const mixed* v) {
    return SHARE_TERM;
}

/** Add a whole cluster; returns false if its sum is no number. */
inline DEVICE bool addCluster(mixed* sums, mixed share) {
    CLUSTER_TERMS
    return share < (mixed) 1e37f;
}

#endif

inline DEVICE void mergeSums(mixed* sums, const mixed* other) {
    MERGE_TERMS
}

AUTOMATIC_CONTROL

/** u = B(combination of U_k/U_k,ref) (docs/method.md, sections 4 and 6) from the sums; -1 if a monitor is no number. */
inline DEVICE wide evaluateMonitors(const mixed* sums, wide groupEnergy, GLOBAL const wide* RESTRICT settings, wide* values) {
    MONITOR_VALUES
    wide sum = 0, weights = 0;
    bool valid = true;
    for (int k = 0; k < NUM_MONITORS; k++) {
        GLOBAL const wide* term = settings + FIRST_TERM + 3*k;
        const wide ratio = values[k]/term[2];
        const wide t = term[0]*(term[1] == 1 ? ratio : pow(ratio, term[1]));
        sum += t*t;
        weights += term[0]*term[0];
        valid = valid && values[k] >= 0 && values[k] < (wide) 1e37f;
    }
    const wide u = (NUM_MONITORS > 0 ? sqrt(sum/weights) : (wide) 1);
    return valid ? (settings[LOWER] + settings[SLOPE]*u)/(1 + settings[CURVE]*u) : (wide) -1;
}

#if HALF_SUMS // where a loop that is kept costs the largest clusters their last register
#define MERGE_LOOP
#else
#define MERGE_LOOP KEEP_LOOP
#endif

/** Merge the sums of all threads of a work group; thread 0 gets the result. */
inline DEVICE void mergeInGroup(mixed* sums, LOCAL_ARG mixed* buffer) {
    for (int j = 0; j < NUM_SUMS; j++)
        buffer[j*GROUP_SIZE + LOCAL_ID] = sums[j];
    MERGE_LOOP for (int width = GROUP_SIZE/2; width > 0; width /= 2) {
        SYNC_THREADS;
        if (LOCAL_ID < width) {
            mixed other[NUM_SUMS];
            for (int j = 0; j < NUM_SUMS; j++)
                other[j] = buffer[j*GROUP_SIZE + LOCAL_ID + width];
            mergeSums(sums, other);
            for (int j = 0; j < NUM_SUMS; j++)
                buffer[j*GROUP_SIZE + LOCAL_ID] = sums[j];
        }
    }
    SYNC_THREADS;
}

/** Merge the sums that the work groups have left: the same in every work group, bit by bit. */
inline DEVICE void gatherSums(int numPartials, GLOBAL const mixed* RESTRICT partials, mixed* sums, LOCAL_ARG mixed* buffer) {
    for (int j = 0; j < NUM_SUMS; j++)
        sums[j] = 0;
    for (int i = LOCAL_ID; i < numPartials - NUM_APART; i += GROUP_SIZE) {
        mixed other[NUM_SUMS];
        for (int j = 0; j < NUM_SUMS; j++)
            other[j] = partials[j*numPartials + i];
#if CLUSTER_SUMS && NUM_PIECES > 0
        // The pieces of large clusters come last, one cluster after the other. The first of each knows how many there are.
        if (i >= numPartials - NUM_PIECES) {
            mixed share = 0;
            const int end = i + (int) other[PIECE_COUNT];
            for (int piece = i; piece < end; piece++)
                share += partials[PIECE_SHARE*numPartials + piece];
            for (int j = 0; j < NUM_SUMS; j++)
                other[j] = 0;
            if (end > i && !addCluster(other, share))
                other[PIECE_SHARE] = 1; // which it is not otherwise
        }
#endif
        mergeSums(sums, other);
    }
#if NUM_APART > 0
    addClustersOfPieces(numPartials, partials, sums);
#endif
    mergeInGroup(sums, buffer);
}

// -------------------------------------------------------------------------------------------------------------- the step density

inline DEVICE wide boundedUpdate(wide u, wide rho, wide a) {
    const wide least = a + (wide) BOUND_MARGIN*(1 - a);
    return unstretch(2*stretch(max(u, least), a) - stretch(max(rho, least), a), a);
}

/** The density of the next step where it follows from what is known on the step: the updates Explicit (3.15) and Bounded. */
inline DEVICE wide nextDensity(wide u, const wide* now, GLOBAL const wide* RESTRICT settings) {
    const wide scale = now[DENSITY_SCALE];
#if UPDATE == FIXED || UPDATE == LANGEVIN
    return 1;
#elif UPDATE == BOUNDED
    return boundedUpdate(scale*u, scale*now[DENSITY], settings[SMALLEST]);
#else
    return scale*(2*u - now[DENSITY]);
#endif
}

/** Enter a step with the density rho into a control block. */
inline DEVICE void enterStep(wide rho, wide u, wide maxStep, wide* now, GLOBAL const wide* RESTRICT settings) {
    const wide previous = now[DENSITY], full = settings[NOMINAL]/rho;
    const bool isShortened = (full > maxStep || fabs(full - maxStep) <= (wide) SLIVER*full);
    now[STEP_SIZE] = (isShortened ? maxStep : full);
    now[DENSITY] = (isShortened ? previous + (rho - previous)*min((wide) 1, maxStep/full) : rho);
    now[DENSITY_OFFSET] = (isShortened ? now[DENSITY_OFFSET] : rho - now[DENSITY_SCALE]*(2*u - previous));
    now[DENSITY_SCALE] = 1;
    now[IS_SHORTENED] = (isShortened ? 1 : 0);
    now[IS_HALF_KNOWN] = 0;
#if UPDATE == AUTOMATIC
    now[IS_ACCEPTED] = 0;
    now[IS_JUMP] = now[IS_JUMP_AHEAD];
    now[IS_JUMP_AHEAD] = 0;
#endif
    now[STEPS] += 1;
    // The time in two numbers, so that a float loses none of it.
    const wide step = now[STEP_SIZE] + now[ELAPSED_REST], sum = now[ELAPSED] + step;
    now[ELAPSED_REST] = step - (sum - now[ELAPSED]);
    now[ELAPSED] = sum;
}

// A failure is written down as the number of its step and a code, and from then on no launch of a later step does anything. The
// launches of the same step may see it come or not: what they write is put back. Of two the first counts.
#define IS_FROZEN(failure, step) ((failure)[0] != 0 && (failure)[0] != (step))
// The same behind advanceStep(), which may have found that there is no such step. Only what earlier launches have written may decide, or
// groups would not agree.
#define HAS_NO_STEP(failure, step) (IS_FROZEN(failure, step) || ((failure)[0] == (step) && (failure)[1]%NUM_CODES == UNSOLVED_DENSITY))

inline DEVICE void fail(GLOBAL int* RESTRICT failure, int step, int code) {
    if (failure[0] == 0) {
        failure[0] = step;
        failure[1] = code;
    }
}

#define STATE_PARAMETERS int numSlots, int paddedNumAtoms, GLOBAL const int* RESTRICT atoms, GLOBAL const mixed* RESTRICT lengths, \
        GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, GLOBAL mixed4* RESTRICT velm, GLOBAL const mm_long* RESTRICT force, \
        GLOBAL mixed* RESTRICT multipliers, GLOBAL int* RESTRICT failure
#define CLUSTER_PARAMETERS int c, int paddedNumAtoms, GLOBAL const int* RESTRICT atoms, GLOBAL const mixed* RESTRICT lengths, \
        GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, GLOBAL mixed4* RESTRICT velm, GLOBAL const mm_long* RESTRICT force, \
        GLOBAL mixed* RESTRICT multipliers KEPT_PARAMETER
// The same address, which a compiler does not know, and not before the condition: it loads anew what it would else have to keep.
#define AGAIN(condition, pointer) ((pointer) + ((condition) && paddedNumAtoms < 0 ? 1 : 0))
#define CLUSTER_ARGUMENTS paddedNumAtoms, atoms, lengths, posq, posqCorrection, velm, force, multipliers KEPT_ARGUMENT

// Local memory for what clusters of many constraints keep: NUM_KEPT numbers for each thread.
#if NUM_KEPT == 0
#define KEPT_PARAMETER
#define KEPT_ARGUMENT
#define KEPT_MEMORY
#else
#define KEPT_PARAMETER , LOCAL_ARG mixed* kept
#define KEPT_ARGUMENT , kept
#if IS_FUSED
#define KEPT_MEMORY LOCAL_ARG mixed* kept = (LOCAL_ARG mixed*) memory;
#else
#define KEPT_MEMORY LOCAL mixed kept[NUM_KEPT*GROUP_SIZE];
#endif
#endif

LANGEVIN_FUNCTIONS

CLUSTER_FUNCTIONS

// Work groups that work together on what one thread cannot have. Where a processor is the device, one thread has it all.
#ifdef NUM_THREADS
#if NUM_THREADS == 1
#define THREAD 0
#define SYNC_PIECE
#define ADD_IN_GROUP(numbers, count)
#define MERGE_SUMS(sums)
#define PIECE_SUMS 1
#else
#define THREAD LOCAL_ID
#define SYNC_PIECE SYNC_THREADS
#define ADD_IN_GROUP(numbers, count) addInGroup(numbers, count, buffer)

/** Add up numbers of all threads of a work group, each of which gets the results. */
inline DEVICE void addInGroup(mixed* numbers, const int count, LOCAL_ARG mixed* buffer) {
    for (int j = 0; j < count; j++)
        buffer[j*GROUP_SIZE + LOCAL_ID] = numbers[j];
    KEEP_LOOP for (int width = GROUP_SIZE/2; width > 0; width /= 2) {
        SYNC_THREADS;
        if (LOCAL_ID < width)
            for (int j = 0; j < count; j++)
                buffer[j*GROUP_SIZE + LOCAL_ID] += buffer[j*GROUP_SIZE + LOCAL_ID + width];
    }
    SYNC_THREADS;
    for (int j = 0; j < count; j++)
        numbers[j] = buffer[j*GROUP_SIZE];
}

#if UPDATE == AUTOMATIC
#define MERGE_SUMS(sums) addInGroup(sums, NUM_TERMS, buffer)
#else
#define MERGE_SUMS(sums) mergeInGroup(sums, buffer)
#endif
#define PIECE_SUMS (NUM_SUMS*GROUP_SIZE)
#endif
#endif

LARGE_CLUSTERS

EXPRESSION_CLUSTERS

// The work groups that have clusters in single threads, which come behind those that have a piece of a large one.
#define SMALL_GROUP ((int) GROUP_ID - NUM_FUSED)
#define SMALL_SLOT (SMALL_GROUP*GROUP_SIZE + (int) LOCAL_ID)
#define NUM_SMALL_SLOTS (((int) NUM_GROUPS - NUM_FUSED)*GROUP_SIZE)

// ------------------------------------------------------------------------------------------------------------------- the kernels

/**
 * The second half of a step, after its forces (3.12)-(3.13): on-step velocities, Lambda, and the sums of the monitors there; where
 * the update needs them also those at the half-step velocities, behind the others.
 *
 * kick is 1/2 for a step. A state changed by others takes 0, and isFormed, which says what: the half-step velocities are then formed
 * from the on-step ones. Without isStored the velocities are left as they are.
 */
KERNEL void finishStep(int step, mixed kick, int isFormed, int isStored, GLOBAL const wide* RESTRICT control, GLOBAL const wide* RESTRICT settings,
        GLOBAL mixed* RESTRICT partials, int numPartials, STATE_PARAMETERS FUSED_PARAMETERS LAST_STATE_PARAMETERS) {
    LOCAL mixed buffer[NUM_SUMS*GROUP_SIZE];
    FUSED_MEMORY
    KEPT_MEMORY
    const mixed dt = (mixed) control[STEP_SIZE];
    MAKE_LAST_STATE(kick, dt, isFormed)
    // After a shortened step the half-step velocities are formed anew, as those of a step of the density that goes on.
    const bool formHalf = (isFormed || control[IS_SHORTENED] != 0);
    const mixed halfKick = (mixed) (settings[NOMINAL]/(2*control[DENSITY]));
    mixed sums[NUM_SUMS];
    for (int j = 0; j < NUM_SUMS; j++)
        sums[j] = 0;
#if HALF_SUMS
    mixed halfSums[NUM_SUMS];
    for (int j = 0; j < NUM_SUMS; j++)
        halfSums[j] = 0;
#else
    mixed* halfSums = 0;
#endif
    // After a failure the sums stay those of the state that is put back.
    const bool isFrozen = (failure[0] != 0);
#if IS_FUSED
    if (GROUP_ID < NUM_FUSED) {
        const LargeTask task = makeFinishingTask(step, 0, MAX_STAGES, stamp, numProjections, kick*dt, halfKick, formHalf, isStored != 0, isFrozen LAST_STATE_ARGUMENT);
        finishPieces(GROUP_ID, NUM_FUSED, NUM_FUSED, task, partials, numPartials, LARGE_STATE_ARGUMENTS, LARGE_ARGUMENTS, buffer, memory, flags);
        return;
    }
#endif
    const int end = (isFrozen ? 0 : numSlots);
    for (int slot = SMALL_SLOT; slot < end; slot += NUM_SMALL_SLOTS) {
        bool isRegular = true;
        FINISH_CASES
        if (!isRegular)
            fail(failure, step, IRREGULAR + NUM_CODES*slot);
    }
    mergeInGroup(sums, buffer);
    if (LOCAL_ID == 0 && !isFrozen)
        for (int j = 0; j < NUM_SUMS; j++)
            partials[j*numPartials + SMALL_GROUP] = sums[j];
#if HALF_SUMS
    SYNC_THREADS;
    mergeInGroup(halfSums, buffer);
    if (LOCAL_ID == 0 && !isFrozen)
        for (int j = 0; j < NUM_SUMS; j++)
            partials[(NUM_SUMS + j)*numPartials + SMALL_GROUP] = halfSums[j];
#endif
}

/**
 * Evaluate the monitors at the on-step state; of one work group. Where others have changed it (change is not 0) the density keeps its
 * ratio to u. A monitor that is no number makes this step fail: that which has led here, or if others have changed the state the next.
 * The report for the host is the control block and behind it how many steps ago one has failed (-2 for none) and why.
 */
KERNEL void evaluateState(int step, int change, int isReported, wide groupEnergy, int numPartials, GLOBAL wide* RESTRICT control, GLOBAL const wide* RESTRICT settings,
        GLOBAL const mixed* RESTRICT partials, GLOBAL int* RESTRICT failure, GLOBAL wide* RESTRICT report) {
    LOCAL mixed buffer[NUM_SUMS*GROUP_SIZE];
    mixed sums[NUM_SUMS], halfSums[NUM_SUMS];
    wide values[NUM_VALUES];
    gatherSums(numPartials, partials, sums, buffer);
#if HALF_SUMS
    SYNC_THREADS;
    gatherSums(numPartials, partials + NUM_SUMS*numPartials, halfSums, buffer);
#endif
#if UPDATE == AUTOMATIC
    if (LOCAL_ID == 0 && failure[0] == 0 && !evaluateAutomaticState(sums, change, control, settings))
        fail(failure, step, INVALID_MONITOR);
#else
    if (LOCAL_ID == 0 && failure[0] == 0) {
#if HALF_SUMS
        if (control[IS_HALF_KNOWN] == 0)
            control[HALF_U] = evaluateMonitors(halfSums, groupEnergy, settings, values);
#endif
        wide u = evaluateMonitors(sums, groupEnergy, settings, values);
#if UPDATE == LANGEVIN
        u = judgeCalm(u, control[REFERENCE], settings);
        if (u >= 0 && control[IS_FOLLOWED] == 0)
            control[REFERENCE] = followReference(u, control[REFERENCE], settings);
        control[IS_FOLLOWED] = 1;
#endif
        if (u < 0)
            fail(failure, step, INVALID_MONITOR);
        else {
            if (change != 0 && u > 0 && control[MONITOR_U] > 0)
                control[DENSITY] *= u/control[MONITOR_U];
            control[MONITOR_U] = u;
            for (int k = 0; k < NUM_MONITORS; k++)
                control[FIRST_VALUE + k] = values[k];
        }
    }
#endif
    if (LOCAL_ID == 0 && isReported != 0) {
        for (int i = 0; i < CONTROL_SIZE; i++)
            report[i] = control[i];
        report[CONTROL_SIZE] = (failure[0] != 0 ? step - failure[0] : -2);
        report[CONTROL_SIZE + 1] = failure[1] % NUM_CODES;
        control[MOST_TRIALS] = 0;
    }
}

#if HALF_SUMS

/**
 * What the trial of a density tells: the mismatch of (3.14) at it, and the next density to try by the secant method. Returns
 * false if there is none.
 */
inline DEVICE bool judgeTrial(wide uTrial, wide* trial, GLOBAL const wide* RESTRICT settings) {
    const wide rho = trial[TRIAL_DENSITY], mismatch = rho + trial[TRIAL_PREVIOUS] - uTrial - trial[TRIAL_HALF_U];
    const wide change = rho - trial[TRIAL_LAST_DENSITY], last = trial[TRIAL_LAST_MISMATCH];
    // The slope by the secant, unless rounding hides it; at first that of the last step.
    const wide secant = (trial[TRIAL_COUNT] > 0 && fabs(change) > (wide) SLOPE_ROUNDING*rho ? (mismatch - last)/change : (wide) 0);
    if (secant > (wide) 0.1f && secant < 10)
        trial[TRIAL_SLOPE] = secant;
    // What the next density will leave: a secant step gains as much again, as far as the mismatch is straight on that scale.
    const wide left = fabs(mismatch)*(trial[TRIAL_COUNT] > 0 ? max(fabs(mismatch/last), fabs(last)/rho) : (wide) 1);
    const wide tolerance = settings[DENSITY_TOLERANCE]*(rho + trial[TRIAL_PREVIOUS]);
    trial[TRIAL_LAST_DENSITY] = rho;
    trial[TRIAL_LAST_MISMATCH] = mismatch;
    trial[TRIAL_COUNT] += 1;
    if (!(uTrial >= 0))
        return false;
    // Or as far as rounding allows.
    const bool isRounding = (trial[TRIAL_COUNT] > 1 && !(fabs(mismatch) < fabs(last)/2) &&
            fabs(mismatch) <= settings[DENSITY_ROUNDING]*(rho + trial[TRIAL_PREVIOUS]));
    if (fabs(mismatch) <= tolerance || left <= tolerance || isRounding)
        trial[TRIAL_STATUS] = CONVERGED;
    trial[TRIAL_DENSITY] = rho - mismatch/trial[TRIAL_SLOPE];
    return trial[TRIAL_DENSITY] > 0;
}

/**
 * One iteration for (3.14), rho[n+1/2] + rho[n-1/2] = u(q[n],p[n+1/2]) + u(q[n],p[n-1/2]): judge the last trial, and solve the
 * constraints for the next density. Once it has converged nothing is done.
 */
KERNEL void tryStep(int step, int index, wide groupEnergy, mixed tolerance, int numPartials, GLOBAL const wide* RESTRICT control, GLOBAL const wide* RESTRICT settings,
        GLOBAL const mixed* RESTRICT partials, GLOBAL const wide* RESTRICT lastTrial, GLOBAL const mixed* RESTRICT lastPartials,
        GLOBAL wide* RESTRICT nextTrial, GLOBAL mixed* RESTRICT nextPartials, STATE_PARAMETERS FUSED_PARAMETERS) {
    LOCAL mixed buffer[NUM_SUMS*GROUP_SIZE];
    FUSED_MEMORY
    KEPT_MEMORY
    LOCAL wide shared[2];
    mixed sums[NUM_SUMS], halfSums[NUM_SUMS];
    const bool isFrozen = IS_FROZEN(failure, step);
    // What is of no use is not read: the sums of half steps after the first trial, and none once the density is found.
    const bool isFirst = (index == 0), isOver = (!isFirst && lastTrial[TRIAL_STATUS] != TRYING);
    gatherSums(isOver ? 0 : numPartials, isFirst ? partials : lastPartials, sums, buffer);
    SYNC_THREADS;
    gatherSums(isFirst ? numPartials : 0, partials + NUM_SUMS*numPartials, halfSums, buffer);
    if (LOCAL_ID == 0) {
        wide trial[TRIAL_SIZE], values[NUM_VALUES];
        for (int i = 0; i < TRIAL_SIZE; i++)
            trial[i] = (index == 0 ? (wide) 0 : lastTrial[i]);
        if (index == 0) {
            const wide u = evaluateMonitors(sums, groupEnergy, settings, values), scale = control[DENSITY_SCALE];
            trial[TRIAL_U] = u;
            trial[TRIAL_PREVIOUS] = scale*control[DENSITY];
            trial[TRIAL_HALF_U] = scale*(control[IS_HALF_KNOWN] != 0 ? control[HALF_U] : evaluateMonitors(halfSums, groupEnergy, settings, values));
            trial[TRIAL_DENSITY] = scale*(2*u - control[DENSITY]) + control[DENSITY_OFFSET];
            trial[TRIAL_SLOPE] = control[MISMATCH_SLOPE];
            trial[TRIAL_STATUS] = (u >= 0 && trial[TRIAL_HALF_U] >= 0 && trial[TRIAL_DENSITY] > 0 ? TRYING : UNSOLVED);
        }
        else if (trial[TRIAL_STATUS] == TRYING && !judgeTrial(sums[FAILURES] > 0 ? (wide) -1 : evaluateMonitors(sums, groupEnergy, settings, values), trial, settings))
            trial[TRIAL_STATUS] = UNSOLVED;
        shared[0] = (trial[TRIAL_STATUS] == TRYING && !isFrozen ? settings[NOMINAL]/trial[TRIAL_DENSITY] : (wide) -1);
        if (GROUP_ID == 0)
            for (int i = 0; i < TRIAL_SIZE; i++)
                nextTrial[i] = trial[i];
    }
    SYNC_THREADS;
    const mixed dt = (mixed) shared[0];
#if IS_FUSED
    if (GROUP_ID < NUM_FUSED) {
        const LargeTask task = makeTask(step, 0, MAX_STAGES, stamp, dt/2, dt, tolerance);
        tryPieces(dt > 0 ? GROUP_ID : NUM_FUSED, NUM_FUSED, NUM_FUSED, task, 1, nextPartials, numPartials, LARGE_STATE_ARGUMENTS, LARGE_ARGUMENTS, buffer, memory, flags);
        return;
    }
#endif
    for (int j = 0; j < NUM_SUMS; j++)
        sums[j] = 0;
    const int end = (dt > 0 ? numSlots : 0);
    for (int slot = SMALL_SLOT; slot < end; slot += NUM_SMALL_SLOTS) {
        bool isSolved = true;
        TRIAL_CASES
        if (!isSolved)
            sums[FAILURES] += 1;
    }
    mergeInGroup(sums, buffer);
    if (LOCAL_ID == 0)
        for (int j = 0; j < NUM_SUMS; j++)
            nextPartials[j*numPartials + SMALL_GROUP] = sums[j];
}

#endif

/**
 * The first half of a step (3.9)-(3.11): every work group finds the density for itself, group 0 writes it into the other half of
 * the control block; then kick, drift and the constraints of the positions. The state before goes to a copy.
 */
KERNEL void advanceStep(int step, wide groupEnergy, wide maxStep, mixed tolerance, int numPartials, GLOBAL const wide* RESTRICT control, GLOBAL wide* RESTRICT nextControl,
        GLOBAL const wide* RESTRICT settings, GLOBAL const mixed* RESTRICT partials, GLOBAL const wide* RESTRICT lastTrial, GLOBAL const mixed* RESTRICT lastPartials,
        GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities, GLOBAL int* RESTRICT iterationCounts, STATE_PARAMETERS FUSED_PARAMETERS NOISE_STATE) {
    LOCAL mixed buffer[NUM_SUMS*GROUP_SIZE];
    FUSED_MEMORY
    KEPT_MEMORY
    LOCAL wide shared[2];
    mixed sums[NUM_SUMS];
    const bool isFrozen = IS_FROZEN(failure, step);
#if HALF_SUMS
    gatherSums(numPartials, lastPartials, sums, buffer);
#else
    gatherSums(numPartials, partials, sums, buffer);
#endif
    if (LOCAL_ID == 0) {
        wide now[CONTROL_SIZE], values[NUM_VALUES];
        for (int i = 0; i < CONTROL_SIZE; i++)
            now[i] = control[i];
#if HALF_SUMS
        wide trial[TRIAL_SIZE];
        for (int i = 0; i < TRIAL_SIZE; i++)
            trial[i] = lastTrial[i];
        const wide u = trial[TRIAL_U];
        if (trial[TRIAL_STATUS] == TRYING)
            judgeTrial(sums[FAILURES] > 0 ? (wide) -1 : evaluateMonitors(sums, groupEnergy, settings, values), trial, settings);
        const bool isSolved = (trial[TRIAL_STATUS] == CONVERGED);
        wide rho = (isSolved ? trial[TRIAL_DENSITY] : (wide) 1);
        now[MISMATCH_SLOPE] = trial[TRIAL_SLOPE];
        now[MOST_TRIALS] = max(now[MOST_TRIALS], trial[TRIAL_COUNT]);
#elif UPDATE == AUTOMATIC
        const wide u = (areMonitorsValid(sums, settings) ? (wide) 1 : (wide) -1);
        const bool isSolved = true;
        acceptAutomaticStep(sums, now, settings);
        wide rho = nextAutomaticDensity(now, settings);
#else
        wide u = evaluateMonitors(sums, groupEnergy, settings, values);
        const bool isSolved = true;
        wide rho = nextDensity(u, now, settings);
#endif
#if UPDATE == LANGEVIN
        u = judgeCalm(u, now[REFERENCE], settings);
        if (now[IS_FOLLOWED] == 0)
            now[REFERENCE] = followReference(u, now[REFERENCE], settings);
        now[IS_FOLLOWED] = 0;
#elif UPDATE == SUM || UPDATE == SEMI_EXPLICIT
        // A rescue: the sum gave no step, or one far above the maximum.
        if (!(rho > 0) || rho < settings[SMALLEST]/2) {
            rho = boundedUpdate(now[DENSITY_SCALE]*u, now[DENSITY_SCALE]*now[DENSITY], settings[SMALLEST]);
            now[RESCUES] += 1;
        }
#endif
        enterStep(rho, u, maxStep, now, settings);
        const bool isMonitorValid = (u >= 0), isStep = (isSolved && now[STEP_SIZE] < (wide) 1e30f);
        shared[0] = (isMonitorValid && isStep && !isFrozen ? now[STEP_SIZE] : (wide) -1);
        if (GROUP_ID == 0 && !isFrozen) {
            if (!isMonitorValid) // the state at the end of the step before is no good
                fail(failure, step - 1, INVALID_MONITOR);
            else if (!isStep)
                fail(failure, step, UNSOLVED_DENSITY);
            else
                for (int i = 0; i < CONTROL_SIZE; i++)
                    nextControl[i] = now[i];
        }
    }
    SYNC_THREADS;
    const mixed dt = (mixed) shared[0], kick = dt/2, drift = (UPDATE == LANGEVIN ? dt/2 : dt);
#if IS_FUSED
    if (GROUP_ID < NUM_FUSED) {
        const LargeTask task = makeTask(step, 0, MAX_STAGES, stamp, kick, drift, tolerance);
        advancePieces(dt >= 0 ? GROUP_ID : NUM_FUSED, NUM_FUSED, NUM_FUSED, task, 1, oldPositions, oldVelocities, LARGE_STATE_ARGUMENTS, LARGE_ARGUMENTS, memory, flags NOISE_ARGUMENTS);
        return;
    }
#endif
    const int end = (dt >= 0 ? numSlots : 0);
    for (int slot = SMALL_SLOT; slot < end; slot += NUM_SMALL_SLOTS) {
        int iterations = 0;
        ADVANCE_CASES
        if (iterations < 0)
            fail(failure, step, NOT_CONVERGED + NUM_CODES*slot);
        iterationCounts[SMALL_SLOT] += iterations;
    }
}

/** Put the state before the last step back. */
KERNEL void restoreState(int numAtoms, GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, GLOBAL mixed4* RESTRICT velm,
        GLOBAL const mixed4* RESTRICT oldPositions, GLOBAL const mixed4* RESTRICT oldVelocities) {
    for (int i = GLOBAL_ID; i < numAtoms; i += GLOBAL_SIZE)
        if (velm[i].w != 0) {
            mixed4 p = oldPositions[i];
            storePosition(posq, posqCorrection, i, p.x, p.y, p.z, (real) p.w);
            velm[i] = oldVelocities[i];
        }
}
