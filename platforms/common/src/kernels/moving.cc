// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Parameters of expressions that move (docs/method.md, section 9): what comes before a step in which they do, or in which they stop.

#define HAS_JUMPS (UPDATE == SUM || UPDATE == BOUNDED || UPDATE == SEMI_EXPLICIT || UPDATE == AUTOMATIC)

/**
 * How far parameters move: what is left of a change by whole periods of g. Where a rate changes suddenly the velocities along the
 * constraints jump in the step that comes, and the monitors with them; the sums of these are left for judgeJump(): those of monitors, or
 * with automatic step control what is needed of the kinetic energy. In Langevin dynamics half of the way is in the middle of the step.
 */
KERNEL void moveExpressions(int step, int wereMoving, GLOBAL const wide* RESTRICT control, GLOBAL const wide* RESTRICT settings, GLOBAL const mixed* RESTRICT partials,
        GLOBAL mixed* RESTRICT jumpPartials, GLOBAL mixed* RESTRICT jumpRates, GLOBAL int* RESTRICT hasJumped, GLOBAL mixed* changedParameters, GLOBAL mixed* middleParameters, EXPRESSION_PARAMETERS) {
    EXPRESSION_MEMORY
    OPEN_PARAMETERS
    const bool isFrozen = IS_FROZEN(failure, step);
    GLOBAL mixed* changes = changedParameters + numParameters;
    GLOBAL const mixed* lastChanges = parametersHere + numParameters;
    // At the rate of a step of the density that there is.
    const mixed lastRate = (mixed) (1/control[STEP_SIZE]), rate = (mixed) (control[DENSITY]/settings[NOMINAL]);
    mixed sums[NUM_SUMS];
    KEEP_LOOP for (int i = (isFrozen ? numParts : GROUP_ID); i < numParts; i += NUM_GROUPS) {
        const Part part = OPEN_PART;
        loadPart(&part, 1, 0, EXPRESSION_STATE_ARGUMENTS);
        bool isSudden = false;
        KEEP_LOOP for (int j = THREAD; j < part.numRows; j += NUM_THREADS) {
            const int k = part.order[j], kind = part.kinds[k], first = part.rowParameter[k];
            const int end = first + countMovable(kind);
            GLOBAL const int* at = part.places + part.rowEntry[k];
            if (theta.areMoving && end > first) {
                const mixed change = findValue(kind, part.position, at, theta.next + first) - findValue(kind, part.position, at, theta.here + first);
                const mixed linear = findMotion(kind, part.position, at, theta.here + first, theta.changes + first, 1);
                const mixed linearThere = findMotion(kind, part.position, at, theta.next + first, theta.changes + first, 1);
                // A period, after which g changes as before; the mere curvature of g would make it change the other way.
                if (linear != 0 && change/linear < (mixed) 0.5f && linearThere/linear > (mixed) 0.5f)
                    KEEP_LOOP for (int p = first; p < end; p++)
                        changes[p] *= change/linear;
            }
#if UPDATE == LANGEVIN
            KEEP_LOOP for (int p = first; p < end; p++)
                middleParameters[p] = theta.here[p] + changes[p]/2;
#endif
#if HAS_JUMPS
            KEEP_LOOP for (int p = first; p < end; p++) {
                const mixed before = (wereMoving ? lastRate*lastChanges[p] : (mixed) 0), after = (theta.areMoving ? rate*changes[p] : (mixed) 0);
                const bool isJump = (fabs(after - before) > (mixed) SUDDEN_CHANGE*max(fabs(after), fabs(before)));
                jumpRates[p] = (isJump ? after : before);
                isSudden = isSudden || isJump;
            }
#endif
        }
#if HAS_JUMPS
        if (isSudden)
            hasJumped[0] = 1;
        SYNC_PIECE;
        findRows(&part, part.position, theta.here, part.G);
        KEEP_LOOP for (int j = THREAD; j < part.numRows; j += NUM_THREADS) {
            const int k = part.order[j], first = part.rowParameter[k];
            part.solution[k] = multiplyRow(&part, k, part.base) +
                    findMotion(part.kinds[k], part.position, part.places + part.rowEntry[k], theta.here + first, jumpRates + first, 1);
        }
        SYNC_PIECE;
        solveWithFactor(&part, part.pivots, part.lower, part.lower, part.solution);
        pushParticles(&part, part.solution, -1, part.base, part.moved);
        for (int j = 0; j < NUM_SUMS; j++)
            sums[j] = 0;
#if UPDATE == AUTOMATIC
        mixed energies[2] = {0, 0}; // twice those of the change and, without it, of what it adds
        KEEP_LOOP for (int j = THREAD; j < part.numParticles; j += NUM_THREADS)
            if (part.inverseMass[j] > 0)
                UNROLL for (int d = 0; d < 3; d++) {
                    const mixed before = part.base[3*j+d], after = part.moved[3*j+d];
                    energies[0] += (after - before)*(after - before)/part.inverseMass[j];
                    energies[1] += (after*after - before*before)/part.inverseMass[j];
                }
        ADD_IN_GROUP(energies, 2);
        sums[SUM_CHANGE] = energies[0];
        sums[SUM_KINETIC] = energies[1];
#else
        Parameters jump = theta;
        jump.changes = jumpRates;
        jump.areMoving = 1;
        measurePart(&part, part.moved, &jump, theta.here, 1, force, paddedNumAtoms, sums);
        MERGE_PART_SUMS(sums);
#endif
        if (THREAD == 0)
            for (int j = 0; j < NUM_SUMS; j++)
                jumpPartials[j*numPartials + firstPartial + i] = sums[j];
#endif
        SYNC_PIECE;
    }
#if HAS_JUMPS
    // All others stay as they are.
    KEEP_LOOP for (int i = (GROUP_ID == 0 ? THREAD : numPartials); i < numPartials; i += NUM_THREADS)
        if (i < firstPartial || i >= firstPartial + numParts)
            for (int j = 0; j < NUM_SUMS; j++)
                jumpPartials[j*numPartials + i] = (UPDATE == AUTOMATIC ? (mixed) 0 : partials[j*numPartials + i]);
#endif
}

#if HAS_JUMPS

/** By how much u, and the density with it, changes in such a jump, or whether automatic step control counts it; of one work group. */
KERNEL void judgeJump(int step, wide groupEnergy, int numPartials, GLOBAL wide* RESTRICT control, GLOBAL const wide* RESTRICT settings, GLOBAL const mixed* RESTRICT partials,
        GLOBAL const mixed* RESTRICT jumpPartials, GLOBAL int* RESTRICT hasJumped, GLOBAL const int* RESTRICT failure) {
    LOCAL mixed buffer[NUM_SUMS*GROUP_SIZE];
    mixed sums[NUM_SUMS], jumpSums[NUM_SUMS];
#if UPDATE != AUTOMATIC
    wide values[NUM_VALUES];
#endif
    gatherSums(numPartials, partials, sums, buffer);
    SYNC_THREADS;
    gatherSums(numPartials, jumpPartials, jumpSums, buffer);
    if (LOCAL_ID == 0) {
#if UPDATE == AUTOMATIC
        const wide before = sums[SUM_KINETIC], after = before + (wide) jumpSums[SUM_KINETIC];
        control[IS_JUMP_AHEAD] = (!IS_FROZEN(failure, step) && hasJumped[0] != 0 && jumpSums[SUM_CHANGE] > (wide) SMALL_JUMP*max(before, after) ? 1 : 0);
#else
        const wide u = evaluateMonitors(sums, groupEnergy, settings, values), next = evaluateMonitors(jumpSums, groupEnergy, settings, values);
        if (!IS_FROZEN(failure, step) && hasJumped[0] != 0 && u > 0 && next > 0 && next < (wide) 1e37f && fabs(next/u - 1) > (wide) SMALL_CHANGE)
            control[DENSITY_SCALE] = next/u;
#endif
        hasJumped[0] = 0;
    }
}

#endif
