// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Large clusters of distance constraints g = (|r|^2 - L^2)/2, in pieces: a work group eliminates the constraints within a piece, and
// what is left are the joints, the constraints between pieces of one cluster (LargeClusters.h). K = G M^-1 G^T = L D L^T is that of
// the on-step positions; finish makes it, and the steps from there use it again.
//
// All that is done is a sequence of stages, each with one solution K x = b: the velocities' projection, Lambda, Lambda at the
// half-step velocities, or an iteration for the positions. In a stage a group sets up its right-hand sides, eliminates, and sends to
// the others what its joints need; in the next one it takes what the others have sent, solves for the joints, and substitutes. So
// groups meet once in a stage. Either each waits for the others, with all stages in one launch, or each stage is a launch of its own.
//
// NUM_THREADS threads have a piece. MEMORY is where a piece has its numbers and tables: local memory, or global memory if they do not fit, or if they must
// outlive a launch.

#define LARGE_MEMORY LOCAL mixed buffer[PIECE_SUMS]; LOCAL uint4 memory[SHARED_SIZE]; LOCAL int flags[2];

#define FINISH 0
#define ADVANCE 1
#define TRY 2

// What the solution under way is for.
#define POSITIONS 0
#define VELOCITIES 1
#define MULTIPLIERS 2
#define HALF_MULTIPLIERS 3
#define COMPLETE 4
// In Langevin dynamics the noise has been added, and the second half of the drift is on its way.
#define AFTER_NOISE 5
#define SECOND_POSITIONS 6
#define NUM_PHASES 7
#define IS_OF_POSITIONS(phase) ((phase) == POSITIONS || (phase) >= AFTER_NOISE)

#define FACTORIZE 0
#define FORWARD 1
#define BACKWARD 2

// 16-byte words of the tables and numbers of the factor that a thread loads while it waits for others.
#define AHEAD 8
#define KEPT_AHEAD 6
// Threads that add up what the joints do to a border.
#define SPLIT 8

#define IS_OWN(row) ((row).z >= 0)
#define NUMBER_OF(row) ((row).z & 0x7fffffff)
#define LOW(word) ((int) ((word) & 65535u))
#define HIGH(word) ((int) ((word) >> 16))
#define WORDS_PER_VALUE ((int) (sizeof(mixed)/4))

#if USE_RECORDS
typedef unsigned short index_t;
#else
typedef unsigned int index_t;
#endif
typedef union {
    mixed value;
    word_t words[2];
} SentValue;

#if USE_RECORDS

// An elimination by levels from records of 16 bytes, one for each number that a level changes. All levels of a pass are in one list.
// Entries of L are A[numRows], ...; its diagonal is D at first, then 1/D.

/** One record. Values of no use are loaded all the same: of record 0, so that no load waits for a condition. */
inline DEVICE void applyRecord(const int pass, uint4 record, MEMORY const index_t* more, MEMORY real* A, MEMORY real* x) {
    const int target = LOW(record.x), count = HIGH(record.x);
    if (pass == FACTORIZE) { // A[t] -= A[a] A[b]/A[k]
        const word_t last = (count == 2 ? record.w : 0);
        const int a = LOW(record.y), b = HIGH(record.y), k = LOW(record.z), c = HIGH(record.z), d = LOW(last), l = HIGH(last);
        real value = A[target], first = A[a]*A[b]/A[k], second = A[c]*A[d]/A[l];
        value -= first;
        if (count == 2)
            value -= second;
        int at = (int) record.w;
        KEEP_LOOP for (int i = 1; i < (count > 2 ? count : 0); i++, at += 3)
            value -= A[more[at]]*A[more[at+1]]/A[more[at+2]];
        A[target] = value;
    }
    else if (pass == FORWARD) { // x[t] -= A[a] x[k]
        real value = x[target];
        const real first = A[LOW(record.y)]*x[HIGH(record.y)], second = A[LOW(record.z)]*x[HIGH(record.z)];
        value -= first;
        if (count > 1)
            value -= second;
        if (count > 2) { // few
            if (count == 3)
                value -= A[LOW(record.w)]*x[HIGH(record.w)];
            int at = (int) record.w;
            KEEP_LOOP for (int i = 2; i < (count > 3 ? count : 0); i++, at += 2)
                value -= A[more[at]]*x[more[at+1]];
        }
        x[target] = value;
    }
    else { // x[k] = x[k]/D[k] - sum A[a + i] x[rows[i]]
        const int a = LOW(record.y);
        real value = x[target]*A[target];
        const real first = A[a]*x[HIGH(record.y)], second = A[a+1]*x[LOW(record.z)], third = A[a+2]*x[HIGH(record.z)];
        if (count > 0)
            value -= first;
        if (count > 1)
            value -= second;
        if (count > 2)
            value -= third;
        if (count > 3) { // few
            if (count <= 5)
                value -= A[a+3]*x[LOW(record.w)];
            if (count == 5)
                value -= A[a+4]*x[HIGH(record.w)];
            const int at = (int) record.w;
            KEEP_LOOP for (int i = 3; i < (count > 5 ? count : 0); i++)
                value -= A[a+i]*x[more[at+i-3]];
        }
        x[target] = value;
    }
}

/** Some levels of a pass, by so many threads: few need no barrier of the whole group. */
#define RUN_LEVELS(FIRST, END, LANES, SYNCHRONIZE) { \
        int begin = (FIRST < END ? starts[FIRST] : 0), end = (FIRST < END ? starts[FIRST+1] : 0); \
        uint4 record = records[begin + THREAD]; \
        KEEP_LOOP for (int level = FIRST; level < END; level++) { \
            const int next = starts[level+2]; \
            const uint4 nextRecord = records[end + THREAD]; \
            KEEP_LOOP for (int i = begin + THREAD; i < (THREAD < LANES ? end : 0); i += LANES) \
                applyRecord(pass, i < begin + LANES ? record : records[i], more, A, x); \
            record = nextRecord; \
            begin = end; \
            end = next; \
            SYNCHRONIZE; \
        } \
    }

inline DEVICE void runLevels(const int pass, int numLevels, int numWide, MEMORY const int* starts, MEMORY const uint4* records,
        MEMORY const index_t* more, MEMORY real* A, MEMORY real* x) {
    if (pass == BACKWARD) {
        const int numNarrow = (numLevels > numWide ? numLevels - numWide : 0);
        RUN_LEVELS(0, numNarrow, NARROW, SYNC_NARROW)
        SYNC_PIECE;
        RUN_LEVELS(numNarrow, numLevels, NUM_THREADS, SYNC_PIECE)
    }
    else {
        const int last = (numWide < numLevels ? numWide : numLevels);
        RUN_LEVELS(0, last, NUM_THREADS, SYNC_PIECE)
        RUN_LEVELS(last, numLevels, NARROW, SYNC_NARROW)
        SYNC_PIECE;
    }
}

/** The same for several right-hand sides. */
inline DEVICE void runForAll(const int pass, int numLevels, MEMORY const int* starts, MEMORY const uint4* records, MEMORY const index_t* more,
        MEMORY real* A, MEMORY real* X, int count, int stride) {
    // A power of two of neighbouring threads has one record.
    int shift = 0;
    KEEP_LOOP while ((1 << shift) < count && (2 << shift) <= NUM_THREADS)
        shift++;
    KEEP_LOOP for (int level = 0; level < numLevels; level++) {
        const int end = starts[level+1];
        KEEP_LOOP for (int i = starts[level] + (THREAD >> shift); i < end; i += NUM_THREADS >> shift)
            KEEP_LOOP for (int k = THREAD & ((1 << shift) - 1); k < count; k += 1 << shift)
                applyRecord(pass, records[i], more, A, X + k*stride);
        SYNC_PIECE;
    }
}

/** From entries L D and D to L and 1/D. Returns false if a pivot is too small a fraction of the diagonal of K. */
inline DEVICE bool scaleFactor(int numLevels, MEMORY const int* starts, MEMORY const uint4* records, MEMORY real* A, MEMORY const real* diagonal) {
    bool isRegular = true;
    const int begin = (numLevels > 0 ? starts[0] : 0), end = (numLevels > 0 ? starts[numLevels] : 0);
    KEEP_LOOP for (int i = begin + THREAD; i < end; i += NUM_THREADS) {
        const uint4 record = records[i];
        const int k = LOW(record.x), count = HIGH(record.x), a = LOW(record.y);
        const real pivot = A[k], inverse = 1/pivot;
        isRegular = isRegular && pivot > (real) MIN_LARGE_PIVOT*diagonal[k];
        KEEP_LOOP for (int j = a; j < a + count; j++)
            A[j] *= inverse;
        A[k] = inverse;
    }
    return isRegular;
}

#else

// An elimination by levels from the rows and columns of L: what is too dense for lists of products.

/** sum L[i][k] L[j][k]/D[k] over the entries that two rows have both. */
inline DEVICE real multiplyRows(MEMORY const int* rowStart, MEMORY const int* rowEntry, MEMORY const int* rowColumn, MEMORY const real* A, int i, int j) {
    real sum = 0;
    int p = rowStart[i], q = rowStart[j];
    const int endP = rowStart[i+1], endQ = rowStart[j+1];
    KEEP_LOOP for (int n = endP - p + endQ - q; n > 0; n--) {
        const bool areLeft = (p < endP && q < endQ);
        const int k = (areLeft ? rowColumn[p] : 0), l = (areLeft ? rowColumn[q] : 1);
        if (areLeft && k == l)
            sum += A[rowEntry[p]]*A[rowEntry[q]]/A[k];
        p += (areLeft && k <= l ? 1 : 0);
        q += (areLeft && l <= k ? 1 : 0);
    }
    return sum;
}

inline DEVICE void runRows(const int pass, int numRows, int numLevels, MEMORY const int* starts, MEMORY const int* columnStart, MEMORY const int* entryRow,
        MEMORY const int* entryColumn, MEMORY const int* rowStart, MEMORY const int* rowEntry, MEMORY const int* rowColumn, MEMORY real* A, MEMORY real* x) {
    KEEP_LOOP for (int number = 0; number < numLevels; number++) {
        const int level = (pass == BACKWARD ? numLevels - 1 - number : number), begin = starts[level], end = starts[level+1];
        KEEP_LOOP for (int j = begin + THREAD; j < end; j += NUM_THREADS) {
            if (pass == FACTORIZE)
                A[j] -= multiplyRows(rowStart, rowEntry, rowColumn, A, j, j);
            else if (pass == FORWARD) {
                real value = x[j];
                KEEP_LOOP for (int p = rowStart[j]; p < rowStart[j+1]; p++)
                    value -= A[rowEntry[p]]*x[rowColumn[p]];
                x[j] = value;
            }
            else {
                real value = x[j]*A[j];
                KEEP_LOOP for (int p = columnStart[j]; p < columnStart[j+1]; p++)
                    value -= A[numRows+p]*x[entryRow[p]];
                x[j] = value;
            }
        }
        const int firstEntry = (pass == FACTORIZE ? columnStart[begin] : 0), endEntry = (pass == FACTORIZE ? columnStart[end] : 0);
        KEEP_LOOP for (int p = firstEntry + THREAD; p < endEntry; p += NUM_THREADS)
            A[numRows+p] -= multiplyRows(rowStart, rowEntry, rowColumn, A, entryRow[p], entryColumn[p]);
        SYNC_PIECE;
    }
}

/** From entries L D and D to L and 1/D. Returns false if a pivot is too small a fraction of the diagonal of K. */
inline DEVICE bool scaleFactor(int numRows, MEMORY const int* columnStart, MEMORY real* entries, MEMORY real* A, MEMORY const real* diagonal) {
    bool isRegular = true;
    KEEP_LOOP for (int k = THREAD; k < numRows; k += NUM_THREADS) {
        const real pivot = A[k], inverse = 1/pivot;
        isRegular = isRegular && pivot > (real) MIN_LARGE_PIVOT*diagonal[k];
        KEEP_LOOP for (int p = columnStart[k]; p < columnStart[k+1]; p++)
            entries[p] *= inverse;
        A[k] = inverse;
    }
    return isRegular;
}

#endif

// What a group sends to the others of its cluster: each value in words of 64 bits, whose upper half is a stamp of the stage. So a
// value is there when its stamp is, with no fence and no atomic operation. The highest bit of a stamp says that the sender has not
// converged. There are two sets of words, for even and odd stages: nobody is two stages ahead.

inline DEVICE void sendValue(GLOBAL volatile mm_ulong* words, int stride, mixed value, word_t stamp) {
    SentValue sent;
    sent.value = value;
    UNROLL for (int i = 0; i < WORDS_PER_VALUE; i++)
        words[i*stride] = (mm_ulong) stamp << 32 | sent.words[i];
}

/** Wait for some values; returns whether their sender has converged, which it has not if they do not come. */
inline DEVICE bool receiveValues(const int count, GLOBAL volatile const mm_ulong* words, int valueStride, int stride, word_t stamp, mixed* values) {
    mm_ulong word[8*WORDS_PER_VALUE];
    bool isComplete = false;
    KEEP_LOOP for (int poll = 0; poll < MAX_POLLS && !isComplete; poll++) {
        isComplete = true;
        UNROLL for (int i = 0; i < count*WORDS_PER_VALUE; i++)
            word[i] = words[(i/WORDS_PER_VALUE)*valueStride + (i%WORDS_PER_VALUE)*stride];
        UNROLL for (int i = 0; i < count*WORDS_PER_VALUE; i++)
            isComplete = isComplete && ((word_t) (word[i] >> 32) & 0x7fffffffu) == stamp;
    }
    bool isConverged = isComplete;
    UNROLL for (int i = 0; i < count; i++) {
        SentValue received;
        UNROLL for (int j = 0; j < WORDS_PER_VALUE; j++) {
            received.words[j] = (word_t) word[i*WORDS_PER_VALUE+j];
            isConverged = isConverged && (word[i*WORDS_PER_VALUE+j] >> 63) == 0;
        }
        values[i] = received.value;
    }
    return isConverged;
}

#define LARGE_PARAMETERS GLOBAL const uint4* RESTRICT allTables, GLOBAL const int4* RESTRICT pieces, GLOBAL const int4* RESTRICT rows, GLOBAL const mixed* RESTRICT rowLengths, \
        GLOBAL const int* RESTRICT pieceAtoms, GLOBAL const int4* RESTRICT joints, GLOBAL const mixed* RESTRICT jointLengths, \
        GLOBAL mixed* RESTRICT largeMultipliers, GLOBAL real* RESTRICT factors, GLOBAL mixed* RESTRICT work, GLOBAL volatile mm_ulong* RESTRICT exchange, GLOBAL int* RESTRICT phases, \
        GLOBAL int* RESTRICT largeIterations
#define LARGE_ARGUMENTS allTables, pieces, rows, rowLengths, pieceAtoms, joints, jointLengths, largeMultipliers, factors, work, exchange, phases, largeIterations
#define LARGE_STATE_PARAMETERS int paddedNumAtoms, GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, GLOBAL mixed4* RESTRICT velm, \
        GLOBAL const mm_long* RESTRICT force, GLOBAL int* RESTRICT failure
#define LARGE_STATE_ARGUMENTS paddedNumAtoms, posq, posqCorrection, velm, force, failure

/** The entries of K between rows of a piece; its diagonal is there. */
inline DEVICE void coupleRows(int numCouplings, MEMORY const int* couplings, MEMORY const mixed* W, MEMORY const real* R, MEMORY real* A) {
    KEEP_LOOP for (int i = THREAD; i < numCouplings; i += NUM_THREADS) {
        MEMORY const int* coupling = couplings + 5*i;
        const int k = coupling[1], l = coupling[2];
        real weight = 0;
        UNROLL for (int shared = 3; shared < 5; shared++) {
            const int code = coupling[shared]; // twice the particle, + 1 where the signs differ; -1 for none
            const mixed w = W[code < 0 ? 0 : code>>1];
            weight += (real) (code < 0 ? 0 : (code & 1) != 0 ? -w : w);
        }
        A[coupling[0]] = weight*(R[3*k]*R[3*l] + R[3*k+1]*R[3*l+1] + R[3*k+2]*R[3*l+2]);
    }
}

/** What a launch does with a piece. */
typedef struct {
    int step, firstStage, endStage;
    int numProjections;  // solutions for the velocities
    word_t stamp;        // of stage 0
    mixed kick, dt;      // the times of the kick and of the drift
    mixed halfKick;      // to the half-step velocities, where they are formed from the on-step ones
    int formHalf;
    int isWritten;       // positions and velocities are changed
    int canFail;         // failures are written down
    mixed tolerance;
#if UPDATE == AUTOMATIC
    LastState last;
#endif
} LargeTask;

/**
 * Stages of a piece. Returns what has been completed: 1 if sums are those of the piece, + 2 if halfSums are, + 4 if the iteration has
 * not converged in all stages there are.
 */
inline DEVICE int runPiece(const int mode, int piece, LargeTask task, LARGE_PARAMETERS, LARGE_STATE_PARAMETERS,
        GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities, mixed* sums, mixed* halfSums, LOCAL_ARG uint4* memory, LOCAL_ARG int* flags NOISE_PARAMETERS) {
    const int4 first = pieces[4*piece], second = pieces[4*piece+1], third = pieces[4*piece+2], fourth = pieces[4*piece+3];
    const int firstRow = first.z, numInner = first.w, numBorders = second.x, firstAtom = second.y, numAtoms = second.z, firstJoint = second.w, numJoints = third.x;
    const int numRows = numInner + numBorders, numKept = third.z;
    const bool isBeginning = (task.firstStage == 0);
    GLOBAL real* kept = factors + third.y;
    GLOBAL volatile mm_ulong* channel = exchange + fourth.x;
#if IN_LOCAL_MEMORY
    // On their way while the state is loaded.
    uint4 tablesAhead[AHEAD];
    real keptAhead[KEPT_AHEAD];
    UNROLL for (int j = 0; j < AHEAD; j++)
        tablesAhead[j] = allTables[first.x + (THREAD + j*NUM_THREADS < first.y ? THREAD + j*NUM_THREADS : 0)];
    if (mode != FINISH)
        UNROLL for (int j = 0; j < KEPT_AHEAD; j++)
            keptAhead[j] = kept[THREAD + j*NUM_THREADS < numKept ? THREAD + j*NUM_THREADS : 0];
    MEMORY const uint4* tables = memory;
    MEMORY mixed* M = (MEMORY mixed*) (memory + fourth.y);
    MEMORY real* A = (MEMORY real*) (memory + fourth.z);
#else
    MEMORY const uint4* tables = allTables + first.x;
    MEMORY mixed* M = work + third.w;
    MEMORY real* A = kept;
#endif
    const int lastPhase = (isBeginning ? 0 : phases[piece]);
    if (THREAD == 0)
        flags[0] = flags[1] = lastPhase/NUM_PHASES;
    int phase = (!isBeginning ? lastPhase%NUM_PHASES : mode == FINISH ? VELOCITIES : POSITIONS);

    // Numbers: the factor A and what the joints need of it, the right-hand side or solution x, the vectors R of the constraints.
    MEMORY real* x = A + numKept;
    MEMORY real* R = x + numRows;
    MEMORY real* jointWeights = R + 3*numRows;
    // In the type of positions: vectors, constants of the right-hand sides, displacements or velocities D, multipliers.
    MEMORY mixed* vectors = M;
    MEMORY mixed* constants = vectors + 3*numInner;
    MEMORY mixed* pulls = constants + numInner;
    MEMORY mixed* gamma = pulls + numInner;
    MEMORY mixed* D = gamma + numRows;
    MEMORY mixed* W = D + 3*numAtoms;
    MEMORY mixed* jointVectors = W + numAtoms;
    MEMORY mixed* jointConstants = jointVectors + 3*numJoints;
    MEMORY mixed* jointPulls = jointConstants + numJoints;
    MEMORY mixed* jointRight = jointPulls + numJoints;
    MEMORY mixed* jointSums = jointRight + numJoints;
    MEMORY mixed* before = jointSums + numJoints; // velocities before the kick, or positions before the step
    MEMORY real* charges = jointWeights + numJoints;

    // ---------------------------------------------------------------------------------------- the state at the beginning
    bool isRegular = true; // no constraints that depend on each other, no force that is no number
    KEEP_LOOP for (int k = THREAD; k < (isBeginning ? numRows : 0); k += NUM_THREADS) {
        const int4 row = rows[firstRow+k];
        const mixed length = rowLengths[firstRow+k];
        mixed x1[3], x2[3], v[3], a1[3], a2[3], r[3], pull = 0;
        loadPosition(posq, posqCorrection, row.x, x1);
        loadPosition(posq, posqCorrection, row.y, x2);
        UNROLL for (int d = 0; d < 3; d++) {
            r[d] = x1[d] - x2[d];
            R[3*k+d] = (real) r[d];
        }
        const mixed square = dot3(r, r);
        if (mode != ADVANCE) {
            const mixed w1 = loadVelocity(velm, row.x, v), w2 = loadVelocity(velm, row.y, v);
            loadAcceleration(force, paddedNumAtoms, row.x, w1, a1);
            loadAcceleration(force, paddedNumAtoms, row.y, w2, a2);
            pull = dot3(r, a1) - dot3(r, a2);
            if (mode == FINISH) {
                const mixed own = ((row.w & 1) != 0 ? w1 : (mixed) 0) + ((row.w & 2) != 0 ? w2 : (mixed) 0);
                A[k] = (real) (own*square);
                x[k] = A[k];
            }
        }
        if (mode != FINISH) {
            gamma[k] = -task.kick*task.dt*largeMultipliers[NUMBER_OF(row)];
            x[k] = (real) gamma[k];
        }
        if (k < numInner) {
            UNROLL for (int d = 0; d < 3; d++)
                vectors[3*k+d] = r[d];
            constants[k] = (square - length*length)/2;
            pulls[k] = pull;
        }
    }
    // Other threads begin than above, so that not all is loaded one after the other.
    KEEP_LOOP for (int j = NUM_THREADS - 1 - THREAD; j < (isBeginning ? numJoints : 0); j += NUM_THREADS) {
        const int4 joint = joints[firstJoint+j];
        const mixed length = jointLengths[firstJoint+j];
        mixed x1[3], x2[3], v[3], a1[3], a2[3], r[3];
        loadPosition(posq, posqCorrection, joint.x, x1);
        loadPosition(posq, posqCorrection, joint.y, x2);
        UNROLL for (int d = 0; d < 3; d++)
            jointVectors[3*j+d] = r[d] = x1[d] - x2[d];
        const mixed square = dot3(r, r);
        jointConstants[j] = (square - length*length)/2;
        if (mode != ADVANCE) {
            const mixed w1 = loadVelocity(velm, joint.x, v), w2 = loadVelocity(velm, joint.y, v);
            loadAcceleration(force, paddedNumAtoms, joint.x, w1, a1);
            loadAcceleration(force, paddedNumAtoms, joint.y, w2, a2);
            jointPulls[j] = dot3(r, a1) - dot3(r, a2);
            jointWeights[j] = (real) ((w1 + w2)*square);
        }
    }
    KEEP_LOOP for (int i = (THREAD + NUM_THREADS/2)%NUM_THREADS; i < (isBeginning ? numAtoms : 0); i += NUM_THREADS) {
        const int atom = pieceAtoms[firstAtom+i];
        mixed v[3], a[3];
        W[i] = loadVelocity(velm, atom, v);
        isRegular = loadAcceleration(force, paddedNumAtoms, atom, W[i], a) >= 0 && isRegular;
        if (mode == ADVANCE) {
            mixed p[3];
            const real charge = loadPosition(posq, posqCorrection, atom, p);
            oldPositions[atom] = make_mixed4(p[0], p[1], p[2], charge);
            charges[i] = charge;
            UNROLL for (int d = 0; d < 3; d++)
                before[3*i+d] = p[d];
            oldVelocities[atom] = make_mixed4(v[0], v[1], v[2], W[i]);
        }
        UNROLL for (int d = 0; d < 3; d++) {
            D[3*i+d] = (mode == FINISH ? v[d] + task.kick*a[d] : task.dt*(v[d] + task.kick*a[d]));
#if HALF_SUMS || UPDATE == AUTOMATIC
            if (mode == FINISH)
                before[3*i+d] = v[d];
#endif
        }
    }
    if (mode == FINISH)
        KEEP_LOOP for (int i = numRows + THREAD; i < (isBeginning ? numKept : 0); i += NUM_THREADS)
            A[i] = 0;
#if IN_LOCAL_MEMORY
    UNROLL for (int j = 0; j < AHEAD; j++)
        if (THREAD + j*NUM_THREADS < first.y)
            memory[THREAD + j*NUM_THREADS] = tablesAhead[j];
    KEEP_LOOP for (int i = THREAD + AHEAD*NUM_THREADS; i < first.y; i += NUM_THREADS)
        memory[i] = allTables[first.x+i];
    if (mode != FINISH) {
        UNROLL for (int j = 0; j < KEPT_AHEAD; j++)
            if (THREAD + j*NUM_THREADS < numKept)
                A[THREAD + j*NUM_THREADS] = keptAhead[j];
        KEEP_LOOP for (int i = THREAD + KEPT_AHEAD*NUM_THREADS; i < numKept; i += NUM_THREADS)
            A[i] = kept[i];
    }
#endif
    SYNC_PIECE;
    MEMORY const int* header = (MEMORY const int*) tables;
    MEMORY const index_t* indices = (MEMORY const index_t*) tables;
    const int numLevels = header[0], numWide = header[1], numCouplings = header[2];
    MEMORY const int* ends = header + header[18];
    MEMORY const index_t* incidenceStart = indices + header[4];
    MEMORY const index_t* incidence = indices + header[5];
    MEMORY const int* couplings = header + header[3];
#if USE_RECORDS
    MEMORY const index_t* more = indices + header[7];
    MEMORY const int* starts = header + header[6];
    #define RUN_FACTORIZE(LEVELS) runLevels(FACTORIZE, LEVELS, numWide, starts, tables, more, A, x)
    #define RUN_FORWARD(LEVELS) runLevels(FORWARD, LEVELS, numWide, starts + numLevels + 2, tables, more, A, x)
    #define RUN_BACKWARD(LEVELS) runLevels(BACKWARD, LEVELS, numWide, starts + 2*(numLevels + 2), tables, more, A, x)
    #define SCALE_FACTOR(LEVELS) scaleFactor(LEVELS, starts + 2*(numLevels + 2), tables, A, x)
#else
    MEMORY const int* starts = header + header[6];
    MEMORY const int* columnStart = header + header[7];
    MEMORY const int* entryRow = header + header[8];
    MEMORY const int* entryColumn = header + header[9];
    MEMORY const int* rowStart = header + header[10];
    MEMORY const int* rowEntry = header + header[11];
    MEMORY const int* rowColumn = header + header[12];
    #define RUN_ROWS(PASS, LEVELS) runRows(PASS, numRows, LEVELS, starts, columnStart, entryRow, entryColumn, rowStart, rowEntry, rowColumn, A, x)
    #define RUN_FACTORIZE(LEVELS) RUN_ROWS(FACTORIZE, LEVELS)
    #define RUN_FORWARD(LEVELS) RUN_ROWS(FORWARD, LEVELS)
    #define RUN_BACKWARD(LEVELS) RUN_ROWS(BACKWARD, LEVELS)
    #define SCALE_FACTOR(LEVELS) scaleFactor((LEVELS) > 0 ? numRows : 0, columnStart, A + numRows, A, x)
#endif
    // The factor of a matrix that is new, and what the joints need of it.
    #define FACTORIZE_FRESH(LEVELS) { \
        RUN_FACTORIZE(LEVELS); \
        isRegular = SCALE_FACTOR(LEVELS) && isRegular; \
    }
#if HAS_JOINTS
    #define SEND_CONTRIBUTIONS(CONDITION, STAMP) { \
        KEEP_LOOP for (int i = THREAD; i < ((CONDITION) ? numBorders + numBorderEntries : 0); i += NUM_THREADS) \
            sendValue(channel + WORDS_PER_VALUE*(16*numJoints + firstContribution + i), 1, A[i < numBorders ? numInner + i : firstBorderEntry + i - numBorders], STAMP); \
    }
#else
    #define SEND_CONTRIBUTIONS(CONDITION, STAMP)
#endif
#if HAS_JOINTS
    MEMORY const int* borders = header + header[8];
    MEMORY const int* jointStarts = header + header[9];
    MEMORY const index_t* jointMore = indices + header[10];
    MEMORY const index_t* sourceStart = indices + header[11];
    MEMORY const index_t* sources = indices + header[12];
    const int numJointLevels = header[13], numJointEntries = header[14], numBorderEntries = header[15], firstContribution = header[16];
    const int firstBorderEntry = header[17];
    MEMORY real* Z = A + firstBorderEntry + numBorderEntries; // this piece's rows of the inverse of the joints' matrix
    MEMORY real* partSums = charges + numAtoms;
    MEMORY real* J = partSums + SPLIT*numBorders; // the joints' matrix
#endif

    coupleRows(mode == FINISH && isBeginning ? numCouplings : 0, couplings, W, R, A);
    SYNC_PIECE;

    FACTORIZE_FRESH(mode == FINISH && isBeginning ? numLevels : 0)
    SEND_CONTRIBUTIONS(mode == FINISH && isBeginning, task.stamp)

    // --------------------------------------------------------------------------------------------------------- the stages
    int completed = 0;
    KEEP_LOOP for (int stage = task.firstStage; stage < task.endStage && phase != COMPLETE; stage++) {
        const int now = stage & 1;
        const bool isUnderWay = (stage > 0);
        if (THREAD == 0)
            flags[now] = 0;
#if HAS_JOINTS
        // What the others have sent.
        const word_t lastStamp = task.stamp + (word_t) stage - 1;
        GLOBAL volatile const mm_ulong* inbox = channel + (now ^ 1)*8*WORDS_PER_VALUE*numJoints;
        KEEP_LOOP for (int j = THREAD; j < (isUnderWay ? numJoints : 0); j += NUM_THREADS) {
            mixed sent[8], r[3], s[3];
            bool isConverged = receiveValues(8, inbox + j, WORDS_PER_VALUE*numJoints, numJoints, lastStamp, sent);
            UNROLL for (int d = 0; d < 3; d++) {
                r[d] = jointVectors[3*j+d];
                s[d] = sent[1+d] - sent[5+d];
            }
            const mixed square = dot3(s, s), product = dot3(r, s);
            const mixed right = (IS_OF_POSITIONS(phase) ? -(jointConstants[j] + product + square/2) : phase == VELOCITIES ? -product : square + jointPulls[j]);
            jointRight[j] = right;
            jointSums[j] = right + sent[0] + sent[4];
            if (!isConverged || !(fabs(right) <= task.tolerance*dot3(r, r)))
                flags[now^1] = 1;
        }
        SYNC_PIECE;
        // The joints' matrix, at first.
        if (((mode == FINISH && stage == 1) || phase == AFTER_NOISE) && numJoints > 0) {
            GLOBAL volatile const mm_ulong* contributions = channel + 16*WORDS_PER_VALUE*numJoints;
            KEEP_LOOP for (int i = THREAD; i < numJoints + numJointEntries; i += NUM_THREADS) {
                mixed sum = 0;
                // Two at once: a constraint has two ends.
                const int end = sourceStart[i+1];
                KEEP_LOOP for (int at = sourceStart[i]; at < end; at += 2) {
                    const bool isPair = (at + 1 < end);
                    mixed values[2];
                    receiveValues(2, contributions + WORDS_PER_VALUE*sources[at], WORDS_PER_VALUE*((int) sources[isPair ? at + 1 : at] - (int) sources[at]),
                            1, lastStamp, values);
                    sum += values[0] + (isPair ? values[1] : (mixed) 0);
                }
                J[i] = (real) sum;
            }
            KEEP_LOOP for (int i = THREAD; i < numBorders*numJoints; i += NUM_THREADS)
                Z[i] = 0;
            SYNC_PIECE;
            KEEP_LOOP for (int b = THREAD; b < numBorders; b += NUM_THREADS)
                Z[b*numJoints + (borders[b] >> 1)] = 1;
            runLevels(FACTORIZE, numJointLevels, numJointLevels, jointStarts, tables, jointMore, J, J);
            isRegular = scaleFactor(numJointLevels, jointStarts + 2*(numJointLevels + 2), tables, J, jointWeights) && isRegular;
            SYNC_PIECE;
            runForAll(FORWARD, numJointLevels, jointStarts + numJointLevels + 2, tables, jointMore, J, Z, numBorders, numJoints);
            runForAll(BACKWARD, numJointLevels, jointStarts + 2*(numJointLevels + 2), tables, jointMore, J, Z, numBorders, numJoints);
        }
#else
        SYNC_PIECE;
#endif
        const bool isOfPositions = IS_OF_POSITIONS(phase);
        const bool isConverged = ((phase == POSITIONS ? stage > 1 : phase == SECOND_POSITIONS) && flags[now^1] == 0);
        const bool isSolved = (isUnderWay && !isConverged);
        // In the middle of the drift noise is added, and the constraints are those there.
        const bool isTurning = (UPDATE == LANGEVIN && mode == ADVANCE && phase == POSITIONS && isConverged), isAtEnd = (mode == ADVANCE && isConverged && !isTurning);
#if HAS_JOINTS && UPDATE == LANGEVIN
        KEEP_LOOP for (int j = THREAD; j < (isTurning ? numJoints : 0); j += NUM_THREADS) {
            mixed sent[8], r[3], s[3];
            receiveValues(8, inbox + j, WORDS_PER_VALUE*numJoints, numJoints, lastStamp, sent);
            UNROLL for (int d = 0; d < 3; d++) {
                r[d] = jointVectors[3*j+d];
                s[d] = sent[1+d] - sent[5+d];
                jointVectors[3*j+d] = r[d] + s[d];
            }
            jointConstants[j] += dot3(r, s) + dot3(s, s)/2;
        }
#endif
#if HAS_JOINTS
        // For each border by a few threads.
        KEEP_LOOP for (int i = THREAD; i < (isSolved ? SPLIT*numBorders : 0); i += NUM_THREADS) {
            const int b = i/SPLIT;
            real sum = 0;
            for (int j = i%SPLIT; j < numJoints; j += SPLIT)
                sum += Z[b*numJoints+j]*(real) jointSums[j];
            partSums[i] = sum;
        }
        SYNC_PIECE;
        KEEP_LOOP for (int b = THREAD; b < (isSolved ? numBorders : 0); b += NUM_THREADS) {
            real sum = 0;
            UNROLL for (int i = 0; i < SPLIT; i++)
                sum += partSums[SPLIT*b+i];
            x[numInner+b] = sum;
        }
        SYNC_PIECE;
#endif
        RUN_BACKWARD(isSolved ? numLevels : 0);
        const bool isLastProjection = (phase == VELOCITIES && stage >= task.numProjections);
        const int nextPhase = (!isUnderWay ? phase :
                phase == POSITIONS ? (!isConverged ? POSITIONS : mode == TRY ? MULTIPLIERS : isTurning ? AFTER_NOISE : COMPLETE) :
                isOfPositions ? (isConverged ? COMPLETE : SECOND_POSITIONS) :
                phase == VELOCITIES ? (isLastProjection ? MULTIPLIERS : VELOCITIES) :
                phase == MULTIPLIERS && mode == FINISH && HALF_SUMS ? HALF_MULTIPLIERS : COMPLETE);
        const bool isMeasured = (phase == MULTIPLIERS || phase == HALF_MULTIPLIERS);
        KEEP_LOOP for (int k = THREAD; k < (isUnderWay ? numRows : 0); k += NUM_THREADS) {
            if (isOfPositions && !isConverged)
                gamma[k] += x[k];
            if (mode == TRY && isConverged) {
                const int4 row = rows[firstRow+k];
                if (IS_OWN(row)) // where the next trial starts
                    largeMultipliers[NUMBER_OF(row)] = -2*gamma[k]/(task.dt*task.dt);
            }
            if (mode != ADVANCE && isMeasured) {
                const int4 row = rows[firstRow+k];
#if HAS_JOINTS
                const mixed right = (k < numInner ? constants[k < numInner ? k : 0] : jointRight[k < numInner ? 0 : borders[k-numInner]>>1]);
#else
                const mixed right = constants[k];
#endif
                if (IS_OWN(row)) {
                    if (phase == MULTIPLIERS)
                        addConstraintTerms(sums, (mixed) x[k], right);
                    else
                        addConstraintTerms(halfSums, (mixed) x[k], right);
                    if (mode == FINISH && phase == MULTIPLIERS && task.canFail)
                        largeMultipliers[NUMBER_OF(row)] = x[k];
                }
            }
        }
        const bool isMoved = (phase == VELOCITIES ? isUnderWay : isOfPositions && !isConverged);
        KEEP_LOOP for (int i = THREAD; i < numAtoms; i += NUM_THREADS) {
            real push[3] = {0, 0, 0};
            const int begin = incidenceStart[i], end = (isMoved || isMeasured ? incidenceStart[i+1] : begin);
            // Four at once, which are mostly all.
            KEEP_LOOP for (int at = begin; at < end; at += 4)
                UNROLL for (int j = 0; j < 4; j++) {
                    const bool isThere = (at + j < end);
                    const int code = (int) incidence[isThere ? at + j : at], k = code>>1; // of the second particle where it is odd
                    const real factor = ((code & 1) != 0 ? -x[k] : x[k]);
                    UNROLL for (int d = 0; d < 3; d++)
                        push[d] += (isThere ? factor : (real) 0)*R[3*k+d];
                }
            mixed v[3];
            const mixed w = W[i];
            UNROLL for (int d = 0; d < 3; d++)
                v[d] = D[3*i+d] + (isMoved ? w*push[d] : (mixed) 0);
            if (mode != ADVANCE && isMeasured) {
                mixed a[3];
                const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, pieceAtoms[firstAtom+i], w, a);
                if (phase == MULTIPLIERS)
                    addParticleTerms(sums, forceSquared, w, v);
                else
                    addParticleTerms(halfSums, forceSquared, w, v);
#if UPDATE == AUTOMATIC
                if (mode == FINISH && task.canFail) { // what the task adds up are terms
                    const int atom = pieceAtoms[firstAtom+i];
                    UNROLL for (int d = 0; d < 3; d++)
                        a[d] -= w*push[d];
                    const mixed halfStep[3] = {before[3*i], before[3*i+1], before[3*i+2]};
                    followForce(sums, task.last, loadLastForce(task.last, paddedNumAtoms, atom), force, paddedNumAtoms, atom, w, halfStep);
                    addFlight(sums, forceSquared, v);
                    addAutomaticTerms(sums, task.last, atom, w, v, a);
                }
#endif
#if CLUSTER_SUMS
                UNROLL for (int d = 0; d < 3; d++)
                    a[d] -= w*push[d];
                sums[PIECE_SHARE] += shareOf(dot3(a, a), w, v);
#endif
#if HALF_SUMS
                if (mode == FINISH)
                    UNROLL for (int d = 0; d < 3; d++)
                        v[d] = (task.formHalf ? v[d] + task.halfKick*(w*push[d] - a[d]) : before[3*i+d]);
#endif
            }
            if (mode == FINISH && isLastProjection && isUnderWay && task.isWritten)
                velm[pieceAtoms[firstAtom+i]] = make_mixed4(v[0], v[1], v[2], w);
#if UPDATE == LANGEVIN
            if (isTurning) {
                const mixed inverse = 1/task.dt;
                UNROLL for (int d = 0; d < 3; d++) {
                    before[3*i+d] += v[d];
                    v[d] *= inverse;
                }
                addNoise(makeNoise(step, noiseState, settings), atomIndex[pieceAtoms[firstAtom+i]], w, v);
                UNROLL for (int d = 0; d < 3; d++)
                    v[d] *= task.dt;
            }
#endif
            if (isAtEnd && task.dt > 0) {
                const int atom = pieceAtoms[firstAtom+i];
                storePosition(posq, posqCorrection, atom, before[3*i] + v[0], before[3*i+1] + v[1], before[3*i+2] + v[2], charges[i]);
                const mixed inverse = 1/task.dt;
                velm[atom] = make_mixed4(v[0]*inverse, v[1]*inverse, v[2]*inverse, w);
            }
            UNROLL for (int d = 0; d < 3; d++)
                D[3*i+d] = (mode == TRY && isConverged ? v[d]/task.dt : v[d]);
        }
        if (isAtEnd && THREAD == 0)
            largeIterations[piece] += stage - 1;
        if (mode != ADVANCE && isMeasured)
            completed |= (phase == MULTIPLIERS ? 1 : 2);
        phase = nextPhase;
        SYNC_PIECE;

#if UPDATE == LANGEVIN
        // The vectors and K in the middle.
        KEEP_LOOP for (int k = THREAD; k < (isTurning ? numRows : 0); k += NUM_THREADS) {
            const int i = ends[2*k], j = ends[2*k+1]; // of another piece where they are less than zero
            mixed r[3], last[3];
            UNROLL for (int d = 0; d < 3; d++) {
#if HAS_JOINTS
                r[d] = (k < numInner ? before[3*(i < 0 ? 0 : i)+d] - before[3*(j < 0 ? 0 : j)+d] : jointVectors[3*(k < numInner ? 0 : borders[k-numInner]>>1)+d]);
#else
                r[d] = before[3*i+d] - before[3*j+d];
#endif
                R[3*k+d] = (real) r[d];
            }
            const mixed own = (i < 0 ? (mixed) 0 : W[i < 0 ? 0 : i]) + (j < 0 ? (mixed) 0 : W[j < 0 ? 0 : j]);
            x[k] = A[k] = (real) (own*dot3(r, r));
            if (k < numInner) {
                UNROLL for (int d = 0; d < 3; d++) {
                    last[d] = vectors[3*k+d];
                    vectors[3*k+d] = r[d];
                }
                constants[k] += (dot3(r, r) - dot3(last, last))/2;
            }
        }
        KEEP_LOOP for (int i = numRows + THREAD; i < (isTurning ? numKept : 0); i += NUM_THREADS)
            A[i] = 0;
        SYNC_PIECE;
        coupleRows(isTurning ? numCouplings : 0, couplings, W, R, A);
        SYNC_PIECE;
        FACTORIZE_FRESH(isTurning ? numLevels : 0)
        SEND_CONTRIBUTIONS(isTurning, task.stamp + (word_t) stage)
        SYNC_PIECE;
#endif
        // The next right-hand sides.
        KEEP_LOOP for (int k = THREAD; k < (phase != COMPLETE ? numRows : 0); k += NUM_THREADS) {
            mixed right = 0;
            if (k < numInner) {
                const int i = ends[2*k], j = ends[2*k+1];
                mixed r[3], s[3];
                UNROLL for (int d = 0; d < 3; d++) {
                    r[d] = vectors[3*k+d];
                    s[d] = D[3*i+d] - D[3*j+d];
                }
                const mixed square = dot3(s, s), product = dot3(r, s);
                if (IS_OF_POSITIONS(phase)) {
                    right = -(constants[k] + product + square/2);
                    if (!(fabs(right) <= task.tolerance*dot3(r, r)))
                        flags[now] = 1;
                }
                else {
                    right = (phase == VELOCITIES ? -product : square + pulls[k]);
                    constants[k] = right;
                }
            }
            x[k] = (real) right;
        }
        SYNC_PIECE;
        // At least one solution, since the multipliers of the state at the beginning are not those of the step.
        const bool isFine = ((phase == POSITIONS ? stage > 0 : phase == SECOND_POSITIONS) && flags[now] == 0);
        KEEP_LOOP for (int k = THREAD; k < (isFine ? numInner : 0); k += NUM_THREADS)
            x[k] = 0;
#if HAS_JOINTS
        // The particles of the joints are sent first, since they are known.
        const word_t stamp = (task.stamp + (word_t) stage) | (IS_OF_POSITIONS(phase) && !isFine ? 0x80000000u : 0u);
        const int numSent = (phase != COMPLETE ? numBorders : 0), stride = WORDS_PER_VALUE*numJoints;
        GLOBAL volatile mm_ulong* outbox = channel + now*8*stride;
        KEEP_LOOP for (int b = THREAD; b < numSent; b += NUM_THREADS) {
            const int joint = borders[b]>>1, side = borders[b] & 1, i = ends[2*(numInner+b)+side];
            UNROLL for (int d = 0; d < 3; d++)
                sendValue(outbox + (4*side + d + 1)*stride + joint, numJoints, D[3*i+d], stamp);
        }
#endif
        RUN_FORWARD(phase == COMPLETE || isFine ? 0 : numLevels);
#if HAS_JOINTS
        KEEP_LOOP for (int b = THREAD; b < numSent; b += NUM_THREADS)
            sendValue(outbox + 4*(borders[b] & 1)*stride + (borders[b]>>1), numJoints, x[numInner+b], stamp);
#endif
    }
    if (mode == FINISH && !isRegular && task.canFail)
        fail(failure, task.step, IRREGULAR + NUM_CODES*piece);
#if IN_LOCAL_MEMORY
    if (mode == FINISH)
        KEEP_LOOP for (int i = THREAD; i < numKept; i += NUM_THREADS)
            kept[i] = A[i];
    SYNC_PIECE;
#endif
#if HAS_NEWTON || !IN_LOCAL_MEMORY
    if (THREAD == 0)
        phases[piece] = phase + NUM_PHASES*flags[(task.endStage - 1) & 1];
#endif
    return completed | (mode != FINISH && phase != COMPLETE ? 4 : 0);
}

// A cluster whose chord iteration fails is left to Newton's (newton.cc), which is there once the host has seen that there are such.
#define NOTE_UNSOLVED failure[2] = 1;

/** The second half of a step for every stride-th piece; see finishStep. */
inline DEVICE void finishPieces(int piece, int numPieces, int stride, LargeTask task, GLOBAL mixed* RESTRICT partials, int numPartials, LARGE_STATE_PARAMETERS, LARGE_PARAMETERS,
        LOCAL_ARG mixed* buffer, LOCAL_ARG uint4* memory, LOCAL_ARG int* flags) {
    mixed sums[NUM_SUMS], halfSums[NUM_SUMS];
    KEEP_LOOP for (; piece < numPieces; piece += stride) {
        for (int j = 0; j < NUM_SUMS; j++)
            sums[j] = halfSums[j] = 0;
        const int completed = runPiece(FINISH, piece, task, LARGE_ARGUMENTS, LARGE_STATE_ARGUMENTS, 0, 0, sums, halfSums, memory, flags NO_NOISE);
        MERGE_SUMS(sums);
#if UPDATE == AUTOMATIC
        if (THREAD == 0 && task.canFail && (completed & 1) != 0)
            closePiece(sums, task.last, pieceAtoms[pieces[4*piece+1].y], pieces[4*piece+3].w);
#endif
#if CLUSTER_SUMS
        sums[PIECE_COUNT] = pieces[4*piece+3].w;
#endif
        if (THREAD == 0 && task.canFail && (completed & 1) != 0)
            for (int j = 0; j < NUM_SUMS; j++)
                partials[j*numPartials + numPartials - numPieces + piece] = sums[j];
#if HALF_SUMS
        MERGE_SUMS(halfSums);
        if (THREAD == 0 && task.canFail && (completed & 2) != 0)
            for (int j = 0; j < NUM_SUMS; j++)
                partials[(NUM_SUMS + j)*numPartials + numPartials - numPieces + piece] = halfSums[j];
#endif
    }
}

#if HALF_SUMS

/** A trial of a step; see tryStep. */
inline DEVICE void tryPieces(int piece, int numPieces, int stride, LargeTask task, int isLast, GLOBAL mixed* RESTRICT nextPartials, int numPartials,
        LARGE_STATE_PARAMETERS, LARGE_PARAMETERS, LOCAL_ARG mixed* buffer, LOCAL_ARG uint4* memory, LOCAL_ARG int* flags) {
    mixed sums[NUM_SUMS], halfSums[NUM_SUMS];
    KEEP_LOOP for (; piece < numPieces; piece += stride) {
        for (int j = 0; j < NUM_SUMS; j++)
            sums[j] = halfSums[j] = 0;
        const int completed = runPiece(TRY, piece, task, LARGE_ARGUMENTS, LARGE_STATE_ARGUMENTS, 0, 0, sums, halfSums, memory, flags);
        const bool hasFailed = (isLast && (completed & 4) != 0);
        if (THREAD == 0 && hasFailed) {
            sums[FAILURES] += 1;
            NOTE_UNSOLVED
        }
        MERGE_SUMS(sums);
        if (THREAD == 0 && ((completed & 1) != 0 || hasFailed))
            for (int j = 0; j < NUM_SUMS; j++)
                nextPartials[j*numPartials + numPartials - numPieces + piece] = sums[j];
    }
}

#endif

/** The first half of a step; see advanceStep. */
inline DEVICE void advancePieces(int piece, int numPieces, int stride, LargeTask task, int isLast, GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities,
        LARGE_STATE_PARAMETERS, LARGE_PARAMETERS, LOCAL_ARG uint4* memory, LOCAL_ARG int* flags NOISE_PARAMETERS) {
    mixed sums[NUM_SUMS], halfSums[NUM_SUMS];
    KEEP_LOOP for (; piece < numPieces; piece += stride) {
        const int completed = runPiece(ADVANCE, piece, task, LARGE_ARGUMENTS, LARGE_STATE_ARGUMENTS, oldPositions, oldVelocities, sums, halfSums, memory, flags NOISE_ARGUMENTS);
        if (THREAD == 0 && isLast && (completed & 4) != 0) {
            NOTE_UNSOLVED
            if (!HAS_NEWTON)
                fail(failure, task.step, NOT_CONVERGED + NUM_CODES*piece);
        }
    }
}

inline DEVICE LargeTask makeTask(int step, int firstStage, int endStage, int stamp, mixed kick, mixed dt, mixed tolerance) {
    LargeTask task;
    task.step = step;
    task.firstStage = firstStage;
    task.endStage = endStage;
    task.numProjections = 0;
    task.stamp = (word_t) stamp;
    task.kick = kick;
    task.dt = dt;
    task.halfKick = 0;
    task.formHalf = 0;
    task.isWritten = task.canFail = 1;
    task.tolerance = tolerance;
    return task;
}

inline DEVICE LargeTask makeFinishingTask(int step, int firstStage, int endStage, int stamp, int numProjections, mixed kick, mixed halfKick, bool formHalf, bool isStored, bool isFrozen LAST_STATE_PARAMETER) {
    LargeTask task = makeTask(step, firstStage, endStage, stamp, kick, 0, 0);
    task.numProjections = numProjections;
    task.halfKick = halfKick;
    task.formHalf = formHalf;
    task.isWritten = (isStored && !isFrozen);
    task.canFail = !isFrozen;
#if UPDATE == AUTOMATIC
    task.last = last;
#endif
    return task;
}

#if IS_FUSED

// The pieces are the first work groups of the launches of the small clusters, which hide behind each other.
#define FUSED_PARAMETERS , int stamp, int numProjections, LARGE_PARAMETERS
#define FUSED_MEMORY LOCAL uint4 memory[SHARED_SIZE]; LOCAL int flags[2];

#else

#define FUSED_PARAMETERS
#define FUSED_MEMORY

/** finishStep for the pieces. */
KERNEL void finishLarge(int step, int firstStage, int endStage, int isLast, int stamp, mixed kick, int isFormed, int isStored, int numProjections,
        GLOBAL const wide* RESTRICT control, GLOBAL const wide* RESTRICT settings, GLOBAL mixed* RESTRICT partials, int numPartials, int numPieces,
        LARGE_STATE_PARAMETERS, LARGE_PARAMETERS LAST_STATE_PARAMETERS) {
    LARGE_MEMORY
    MAKE_LAST_STATE(kick, (mixed) control[STEP_SIZE], isFormed)
    const LargeTask task = makeFinishingTask(step, firstStage, endStage, stamp, numProjections, kick*(mixed) control[STEP_SIZE],
            (mixed) (settings[NOMINAL]/(2*control[DENSITY])), isFormed || control[IS_SHORTENED] != 0, isStored != 0, failure[0] != 0 LAST_STATE_ARGUMENT);
    finishPieces(GROUP_ID, numPieces, NUM_GROUPS, task, partials, numPartials, LARGE_STATE_ARGUMENTS, LARGE_ARGUMENTS, buffer, memory, flags);
}

#if HALF_SUMS

/** tryStep for the pieces, which takes what that has found of the next trial. */
KERNEL void tryLarge(int step, int firstStage, int endStage, int isLast, int stamp, mixed tolerance, GLOBAL const wide* RESTRICT settings, GLOBAL const wide* RESTRICT nextTrial,
        GLOBAL mixed* RESTRICT nextPartials, int numPartials, int numPieces, LARGE_STATE_PARAMETERS, LARGE_PARAMETERS) {
    LARGE_MEMORY
    const bool isTrying = (nextTrial[TRIAL_STATUS] == TRYING && !IS_FROZEN(failure, step));
    const mixed dt = (mixed) (settings[NOMINAL]/nextTrial[TRIAL_DENSITY]);
    const LargeTask task = makeTask(step, firstStage, endStage, stamp, dt/2, dt, tolerance);
    tryPieces(isTrying ? GROUP_ID : numPieces, numPieces, NUM_GROUPS, task, isLast, nextPartials, numPartials, LARGE_STATE_ARGUMENTS, LARGE_ARGUMENTS, buffer, memory, flags);
}

#endif

/** advanceStep for the pieces, which takes the step size that that has found. */
KERNEL void advanceLarge(int step, int firstStage, int endStage, int isLast, int stamp, mixed tolerance, GLOBAL const wide* RESTRICT nextControl, GLOBAL mixed4* RESTRICT oldPositions,
        GLOBAL mixed4* RESTRICT oldVelocities, int numPieces, LARGE_STATE_PARAMETERS, LARGE_PARAMETERS LARGE_NOISE_STATE) {
    LARGE_MEMORY
    const mixed dt = (mixed) nextControl[STEP_SIZE];
    const LargeTask task = makeTask(step, firstStage, endStage, stamp, dt/2, UPDATE == LANGEVIN ? dt/2 : dt, tolerance);
    advancePieces(HAS_NO_STEP(failure, step) ? numPieces : GROUP_ID, numPieces, NUM_GROUPS, task, isLast, oldPositions, oldVelocities, LARGE_STATE_ARGUMENTS, LARGE_ARGUMENTS, memory, flags NOISE_ARGUMENTS);
}

#endif
