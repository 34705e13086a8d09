// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Newton's iteration for the large clusters of distances whose chord iteration (large.cc) has not converged in the launch before. Each is taken whole,
// by one work group, as a part of expression.cc whose expressions are distances: slow, and rare. Where no cluster has failed the launch returns at once.

#define NEWTON_PARAMETERS int numClusters, GLOBAL const int* RESTRICT clusters, GLOBAL const int* RESTRICT clusterTables, GLOBAL mixed* clusterWork, GLOBAL const mixed* RESTRICT shifts, \
        GLOBAL mixed* rowMultipliers, GLOBAL const mixed* lengths, GLOBAL const int* RESTRICT firstPieces, GLOBAL const int* RESTRICT phases, GLOBAL mixed* RESTRICT largeMultipliers, \
        GLOBAL int* RESTRICT largeIterations, GLOBAL int* RESTRICT failure, EXPRESSION_STATE_PARAMETERS
// The pieces of a cluster agree.
#define IS_UNSOLVED(c) (phases[firstPieces[c]]%NUM_PHASES != COMPLETE)
#define OPEN_CLUSTER openPart(clusterTables + clusters[c], clusterWork, shifts, rowMultipliers)
#define OPEN_LENGTHS Parameters theta; theta.here = theta.next = theta.changes = lengths; theta.areMoving = 0;

/** Lambda, from the order of the large clusters' constraints. */
inline DEVICE void takeMultipliers(const Part* part, GLOBAL const mixed* RESTRICT largeMultipliers) {
    KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS)
        part->multipliers[k] = largeMultipliers[part->rowParameter[k]];
    SYNC_PIECE;
}

#if HALF_SUMS

/** For tryStep. The sums of the whole cluster take the place of those of its first piece. */
KERNEL void tryByNewton(int step, mixed tolerance, GLOBAL const wide* RESTRICT settings, GLOBAL const wide* RESTRICT nextTrial, GLOBAL mixed* RESTRICT nextPartials, int numPartials, NEWTON_PARAMETERS) {
    EXPRESSION_MEMORY
    OPEN_LENGTHS
    const bool isTrying = (nextTrial[TRIAL_STATUS] == TRYING && !IS_FROZEN(failure, step));
    const mixed dt = (mixed) (settings[NOMINAL]/nextTrial[TRIAL_DENSITY]);
    const int firstPartial = numPartials - firstPieces[numClusters];
    mixed sums[NUM_SUMS];
    KEEP_LOOP for (int c = (isTrying ? GROUP_ID : numClusters); c < numClusters; c += NUM_GROUPS)
        KEEP_LOOP for (int pass = 0; pass < (IS_UNSOLVED(c) ? 1 : 0); pass++) {
            const Part part = OPEN_CLUSTER;
            for (int j = 0; j < NUM_SUMS; j++)
                sums[j] = 0;
            takeMultipliers(&part, largeMultipliers);
            if (tryPart(&part, true, dt, tolerance, &theta, EXPRESSION_STATE_ARGUMENTS, sums, buffer) >= 0)
                KEEP_LOOP for (int k = THREAD; k < part.numRows; k += NUM_THREADS)
                    largeMultipliers[part.rowParameter[k]] = part.multipliers[k];
            if (THREAD == 0)
                for (int piece = firstPieces[c]; piece < firstPieces[c+1]; piece++)
                    for (int j = 0; j < NUM_SUMS; j++)
                        nextPartials[j*numPartials + firstPartial + piece] = (piece == firstPieces[c] ? sums[j] : (mixed) 0);
            SYNC_PIECE;
        }
}

#endif

/** For advanceStep, which has found the step size. */
KERNEL void advanceByNewton(int step, mixed tolerance, GLOBAL const wide* RESTRICT nextControl, GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities,
        NEWTON_PARAMETERS LARGE_NOISE_STATE) {
    EXPRESSION_MEMORY
    OPEN_LENGTHS
#if UPDATE == LANGEVIN
    const Noise noise = makeNoise(step, noiseState, settings);
#endif
    KEEP_LOOP for (int c = (HAS_NO_STEP(failure, step) ? numClusters : GROUP_ID); c < numClusters; c += NUM_GROUPS)
        KEEP_LOOP for (int pass = 0; pass < (IS_UNSOLVED(c) ? 1 : 0); pass++) {
            const Part part = OPEN_CLUSTER;
            takeMultipliers(&part, largeMultipliers);
            const int iterations = advancePart(&part, true, step, (mixed) nextControl[STEP_SIZE], tolerance, &theta, &theta, EXPRESSION_STATE_ARGUMENTS, failure,
                    oldPositions, oldVelocities, buffer NOISE_ARGUMENTS_OF_PART);
            if (THREAD == 0 && iterations >= 0)
                largeIterations[firstPieces[c]] += iterations;
            SYNC_PIECE;
        }
}
