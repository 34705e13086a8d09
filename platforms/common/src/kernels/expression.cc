// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Clusters with constraints that are given as expressions, in parts (ExpressionClusters.h): a work group has a part, whose rows are
// those of any number of whole clusters. (So has Newton's iteration of large clusters of distances, newton.cc.)
// A row of G has an entry, a vector, for each particle of its expression. K = G M^-1 G^T = L D L^T
// is that of the on-step positions; finish makes it, and the step from there uses it again. Where that chord iteration does
// not contract, Newton's follows, with A = G(q+) M^-1 G(q)^T = L D U in place of K, which has the same pattern.
//
// Positions are those that users see: whole molecules may be moved by box vectors on the device, and expressions are not periodic. All numbers
// are in the type of positions and in global memory.

EXPRESSION_FUNCTIONS

typedef struct {
    int numRows, numParticles, numEntries, numSlots, numLevels, numCoupled, numClusters;
    GLOBAL const int *atoms, *order, *kinds, *rowEntry, *rowParameter, *places, *incidenceStart, *incidence;
    GLOBAL const int *coupledSlots, *productStart, *products, *levels, *columnStart, *slotRow, *slotColumn, *rowStart, *rowSlot, *rowColumn, *clusterStart;
    GLOBAL const mixed* shifts;
    GLOBAL mixed *multipliers;
    GLOBAL mixed *position, *base, *moved, *acceleration, *before, *inverseMass, *terms; // of each particle
    GLOBAL mixed *G, *nextG;                                                     // entries
    GLOBAL mixed *solution, *gamma, *right, *diagonal, *scale;                   // of each row
    GLOBAL mixed *pivots, *lower;                                                // the factor of K
    GLOBAL mixed *newtonPivots, *newtonLower, *newtonUpper;
} Part;

/** The parameters of all rows at the positions of G and at those to come, and the change of those that may change on the way there. */
typedef struct {
    GLOBAL const mixed *here, *next, *changes;
    int areMoving;
} Parameters;

#define EXPRESSION_PARAMETERS int numParts, int firstPartial, int numPartials, int paddedNumAtoms, GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, \
        GLOBAL mixed4* RESTRICT velm, GLOBAL const mm_long* RESTRICT force, GLOBAL int* RESTRICT failure, GLOBAL const int* RESTRICT parts, GLOBAL const int* RESTRICT partTables, \
        GLOBAL mixed* partWork, GLOBAL const mixed* RESTRICT partShifts, GLOBAL mixed* partMultipliers, GLOBAL int* RESTRICT partIterations, \
        GLOBAL const mixed* parametersHere, GLOBAL const mixed* nextParameters, int numParameters, int areParametersMoving
// In Langevin dynamics those in the middle of the step follow.
#if UPDATE == LANGEVIN
#define MIDDLE_PARAMETERS , GLOBAL const mixed* middleParameters
#else
#define MIDDLE_PARAMETERS
#endif
#define EXPRESSION_STATE_PARAMETERS int paddedNumAtoms, GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection, GLOBAL mixed4* RESTRICT velm, GLOBAL const mm_long* RESTRICT force
#define EXPRESSION_STATE_ARGUMENTS paddedNumAtoms, posq, posqCorrection, velm, force
#define OPEN_PART openPart(partTables + parts[i], partWork, partShifts, partMultipliers)
#define OPEN_PARAMETERS Parameters theta; theta.here = parametersHere; theta.next = nextParameters; theta.changes = nextParameters + numParameters; theta.areMoving = areParametersMoving;

inline DEVICE Part openPart(GLOBAL const int* table, GLOBAL mixed* work, GLOBAL const mixed* shifts, GLOBAL mixed* multipliers) {
    Part part;
    part.numRows = table[0];
    part.numParticles = table[1];
    part.numEntries = table[2];
    part.numSlots = table[3];
    part.numLevels = table[4];
    part.numCoupled = table[5];
    part.multipliers = multipliers + table[6];
    part.shifts = shifts + 3*table[7];
    GLOBAL mixed* next = work + table[8];
    part.atoms = table + table[9];
    part.order = table + table[10];
    part.kinds = table + table[11];
    part.rowEntry = table + table[12];
    part.rowParameter = table + table[13];
    part.places = table + table[14];
    part.incidenceStart = table + table[15];
    part.incidence = table + table[16];
    part.coupledSlots = table + table[17];
    part.productStart = table + table[18];
    part.products = table + table[19];
    part.levels = table + table[20];
    part.columnStart = table + table[21];
    part.slotRow = table + table[22];
    part.slotColumn = table + table[23];
    part.rowStart = table + table[24];
    part.rowSlot = table + table[25];
    part.rowColumn = table + table[26];
    part.numClusters = table[27];
    part.clusterStart = table + table[28];
#define TAKE(name, size) part.name = next; next += (size);
    TAKE(position, 3*part.numParticles)
    TAKE(base, 3*part.numParticles)
    TAKE(moved, 3*part.numParticles)
    TAKE(acceleration, 3*part.numParticles)
    TAKE(before, 3*part.numParticles)
    TAKE(inverseMass, part.numParticles)
    TAKE(terms, PART_TERMS*part.numParticles)
    TAKE(G, 3*part.numEntries)
    TAKE(nextG, 3*part.numEntries)
    TAKE(solution, part.numRows)
    TAKE(gamma, part.numRows)
    TAKE(right, part.numRows)
    TAKE(diagonal, part.numRows)
    TAKE(scale, part.numRows)
    TAKE(pivots, part.numRows)
    TAKE(newtonPivots, part.numRows)
    TAKE(lower, part.numSlots)
    TAKE(newtonLower, part.numSlots)
    TAKE(newtonUpper, part.numSlots)
    return part;
}

// ------------------------------------------------------------------------------------------------------------- linear algebra

inline DEVICE mixed dotEntries(GLOBAL const mixed* a, GLOBAL const mixed* b) {
    return a[0]*b[0] + a[1]*b[1] + a[2]*b[2];
}

/** Entries of a matrix with the pattern of K, left M^-1 right^T; the upper ones where they are others. */
inline DEVICE void formMatrix(const Part* part, GLOBAL const mixed* left, GLOBAL const mixed* right, bool isSymmetric, GLOBAL mixed* pivots, GLOBAL mixed* lower, GLOBAL mixed* upper) {
    KEEP_LOOP for (int i = THREAD; i < part->numSlots; i += NUM_THREADS) {
        lower[i] = 0;
        if (!isSymmetric)
            upper[i] = 0;
    }
    SYNC_PIECE;
    KEEP_LOOP for (int i = THREAD; i < part->numCoupled; i += NUM_THREADS) {
        const int slot = part->coupledSlots[i];
        mixed below = 0, above = 0;
        KEEP_LOOP for (int j = part->productStart[i]; j < part->productStart[i+1]; j++) {
            const int a = part->products[2*j], b = part->products[2*j+1];
            const mixed w = part->inverseMass[part->places[a]];
            below += w*dotEntries(left + 3*a, right + 3*b);
            above += w*dotEntries(left + 3*b, right + 3*a);
        }
        if (slot < part->numRows)
            pivots[slot] = below;
        else {
            lower[slot - part->numRows] = below;
            if (!isSymmetric)
                upper[slot - part->numRows] = above;
        }
    }
    SYNC_PIECE;
}

/** sum first[i][k] second[j][k]/D[k] over the columns k that two rows have both: those of the shorter are looked for in the other. */
inline DEVICE mixed multiplySparse(const Part* part, GLOBAL const mixed* pivots, GLOBAL const mixed* first, GLOBAL const mixed* second, int i, int j) {
    const int sizeI = part->rowStart[i+1] - part->rowStart[i], sizeJ = part->rowStart[j+1] - part->rowStart[j];
    const bool areSwapped = (sizeI > sizeJ);
    const int shorter = (areSwapped ? j : i), longer = (areSwapped ? i : j);
    mixed sum = 0;
    int from = part->rowStart[longer];
    const int end = part->rowStart[longer+1];
    KEEP_LOOP for (int p = part->rowStart[shorter]; p < part->rowStart[shorter+1]; p++) {
        const int k = part->rowColumn[p];
        int past = end; // the first column not before k is in from, ..., past
        KEEP_LOOP while (from < past) {
            const int middle = (from + past)/2;
            if (part->rowColumn[middle] < k)
                from = middle + 1;
            else
                past = middle;
        }
        if (from < end && part->rowColumn[from] == k) {
            const int own = part->rowSlot[p], other = part->rowSlot[from];
            sum += (areSwapped ? first[other]*second[own] : first[own]*second[other])/pivots[k];
        }
    }
    return sum;
}

/** The factors of such a matrix in its place, with 1/D. Returns false if a pivot is too small a fraction of the diagonal. */
inline DEVICE bool factorizePart(const Part* part, bool isSymmetric, GLOBAL mixed* pivots, GLOBAL mixed* lower, GLOBAL mixed* upper) {
    KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS)
        part->diagonal[k] = pivots[k];
    KEEP_LOOP for (int level = 0; level < part->numLevels; level++) {
        const int begin = part->levels[level], end = part->levels[level+1];
        KEEP_LOOP for (int k = begin + THREAD; k < end; k += NUM_THREADS) {
            mixed sum = 0;
            KEEP_LOOP for (int p = part->rowStart[k]; p < part->rowStart[k+1]; p++)
                sum += lower[part->rowSlot[p]]*upper[part->rowSlot[p]]/pivots[part->rowColumn[p]];
            pivots[k] -= sum;
        }
        KEEP_LOOP for (int slot = part->columnStart[begin] + THREAD; slot < part->columnStart[end]; slot += NUM_THREADS) {
            const int i = part->slotRow[slot], j = part->slotColumn[slot];
            const mixed below = multiplySparse(part, pivots, lower, upper, i, j);
            if (!isSymmetric)
                upper[slot] -= multiplySparse(part, pivots, upper, lower, i, j);
            lower[slot] -= below;
        }
        SYNC_PIECE;
    }
    bool isRegular = true;
    KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS) {
        const mixed pivot = pivots[k], inverse = 1/pivot;
        isRegular = isRegular && pivot > (mixed) MIN_PIVOT*part->diagonal[k];
        KEEP_LOOP for (int slot = part->columnStart[k]; slot < part->columnStart[k+1]; slot++) {
            lower[slot] *= inverse;
            if (!isSymmetric)
                upper[slot] *= inverse;
        }
        pivots[k] = inverse;
    }
    SYNC_PIECE;
    return isRegular;
}

/** x <- (L D U)^-1 x */
inline DEVICE void solveWithFactor(const Part* part, GLOBAL const mixed* pivots, GLOBAL const mixed* lower, GLOBAL const mixed* upper, GLOBAL mixed* x) {
    KEEP_LOOP for (int level = 1; level < part->numLevels; level++) {
        KEEP_LOOP for (int k = part->levels[level] + THREAD; k < part->levels[level+1]; k += NUM_THREADS) {
            mixed value = x[k];
            KEEP_LOOP for (int p = part->rowStart[k]; p < part->rowStart[k+1]; p++)
                value -= lower[part->rowSlot[p]]*x[part->rowColumn[p]];
            x[k] = value;
        }
        SYNC_PIECE;
    }
    KEEP_LOOP for (int level = part->numLevels - 1; level >= 0; level--) {
        KEEP_LOOP for (int k = part->levels[level] + THREAD; k < part->levels[level+1]; k += NUM_THREADS) {
            mixed value = x[k]*pivots[k];
            KEEP_LOOP for (int slot = part->columnStart[k]; slot < part->columnStart[k+1]; slot++)
                value -= upper[slot]*x[part->slotRow[slot]];
            x[k] = value;
        }
        SYNC_PIECE;
    }
}

// ------------------------------------------------------------------------------------------------------------- rows and particles

inline DEVICE void findRows(const Part* part, GLOBAL const mixed* x, GLOBAL const mixed* theta, GLOBAL mixed* G) {
    KEEP_LOOP for (int i = THREAD; i < part->numRows; i += NUM_THREADS) {
        const int k = part->order[i];
        findGradient(part->kinds[k], x, part->places + part->rowEntry[k], theta + part->rowParameter[k], G + 3*part->rowEntry[k]);
    }
    SYNC_PIECE;
}

/** What makes of g a relative error: that of a distance, or of a way of 0.1 nm along the gradient. */
inline DEVICE void findScales(const Part* part, GLOBAL const mixed* theta) {
    KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS) {
        mixed square = 0;
        KEEP_LOOP for (int e = part->rowEntry[k]; e < part->rowEntry[k+1]; e++)
            if (part->inverseMass[part->places[e]] > 0)
                square += dotEntries(part->G + 3*e, part->G + 3*e);
        const mixed length = theta[part->rowParameter[k]];
        part->scale[k] = (part->kinds[k] == 0 ? 1/(length*length) : 1/((mixed) EXPRESSION_LENGTH*sqrt(square)));
    }
}

inline DEVICE mixed multiplyRow(const Part* part, int k, GLOBAL const mixed* v) {
    mixed sum = 0;
    KEEP_LOOP for (int e = part->rowEntry[k]; e < part->rowEntry[k+1]; e++)
        sum += dotEntries(part->G + 3*e, v + 3*part->places[e]);
    return sum;
}

/** result = start + factor M^-1 G^T x */
inline DEVICE void pushParticles(const Part* part, GLOBAL const mixed* x, mixed factor, GLOBAL const mixed* start, GLOBAL mixed* result) {
    KEEP_LOOP for (int i = THREAD; i < part->numParticles; i += NUM_THREADS) {
        mixed push[3] = {0, 0, 0};
        KEEP_LOOP for (int at = part->incidenceStart[i]; at < part->incidenceStart[i+1]; at++) {
            const int e = part->incidence[2*at], k = part->incidence[2*at+1];
            UNROLL for (int d = 0; d < 3; d++)
                push[d] += x[k]*part->G[3*e+d];
        }
        const mixed w = factor*part->inverseMass[i];
        UNROLL for (int d = 0; d < 3; d++)
            result[3*i+d] = start[3*i+d] + w*push[d];
    }
    SYNC_PIECE;
}

/** Positions and accelerations, and a way or velocities in base = factor (v + kick a). Returns false if a force is no number. */
inline DEVICE bool loadPart(const Part* part, mixed factor, mixed kick, EXPRESSION_STATE_PARAMETERS) {
    bool isRegular = true;
    KEEP_LOOP for (int i = THREAD; i < part->numParticles; i += NUM_THREADS) {
        const int atom = part->atoms[i];
        mixed x[3], v[3], a[3];
        loadPosition(posq, posqCorrection, atom, x);
        const mixed w = loadVelocity(velm, atom, v);
        const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, atom, w, a);
        const bool isMoving = (w > 0); // else it stays, whatever its velocity
        isRegular = isRegular && (forceSquared >= 0 || !isMoving);
        part->inverseMass[i] = w;
        UNROLL for (int d = 0; d < 3; d++) {
            part->position[3*i+d] = x[d] + part->shifts[3*i+d];
            part->acceleration[3*i+d] = (isMoving ? a[d] : (mixed) 0);
            part->before[3*i+d] = (isMoving ? v[d] : (mixed) 0);
            part->base[3*i+d] = (isMoving ? factor*(v[d] + kick*a[d]) : (mixed) 0);
        }
    }
    SYNC_PIECE;
    return isRegular;
}

/** Lambda(q,v) (4.3) into solution, and the terms of the monitors there; rates are those of the parameters' changes in a time 1/rate. */
inline DEVICE void measurePart(const Part* part, GLOBAL const mixed* v, const Parameters* theta, GLOBAL const mixed* parameters, mixed rate, GLOBAL const mm_long* RESTRICT force,
        int paddedNumAtoms, mixed* sums) {
    KEEP_LOOP for (int i = THREAD; i < part->numRows; i += NUM_THREADS) {
        const int k = part->order[i], first = part->rowParameter[k];
        GLOBAL const int* at = part->places + part->rowEntry[k];
        const mixed curvature = (theta->areMoving ? findMovingCurvature(part->kinds[k], part->position, v, at, parameters + first, theta->changes + first, rate) :
                findCurvature(part->kinds[k], part->position, v, at, parameters + first));
        part->right[k] = part->solution[k] = curvature + multiplyRow(part, k, part->acceleration);
    }
    SYNC_PIECE;
    solveWithFactor(part, part->pivots, part->lower, part->lower, part->solution);
    KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS) {
        // The terms are those of a distance, whose multiplier is half as large in the form that users see, |r|^2 - L^2.
        const mixed factor = (part->kinds[k] == 0 ? (mixed) 1 : (mixed) 2);
        addConstraintTerms(sums, factor*part->solution[k], part->right[k]/factor);
    }
    KEEP_LOOP for (int i = THREAD; i < part->numParticles; i += NUM_THREADS) {
        const mixed w = part->inverseMass[i];
        if (w > 0) {
            mixed a[3], u[3];
            const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, part->atoms[i], w, a);
            UNROLL for (int d = 0; d < 3; d++)
                u[d] = v[3*i+d];
            addParticleTerms(sums, forceSquared, w, u);
        }
    }
}

#if UPDATE == AUTOMATIC
#define CLUSTER_TERM_COUNT NUM_TERMS
#define ADD_CLUSTER_OF_PART(terms, firstAtom) (addCluster(sums, terms, last, firstAtom), true)
#elif CLUSTER_SUMS
#define CLUSTER_TERM_COUNT 1
#define ADD_CLUSTER_OF_PART(terms, firstAtom) addCluster(sums, (terms)[0])
#endif

#ifdef CLUSTER_TERM_COUNT

#if CLUSTER_TERM_COUNT > PART_TERMS
#error the parts have no room for the terms
#endif

/**
 * What the clusters of a part add to the sums, where solution is Lambda(q,v): first the terms of each particle, then a thread
 * adds up those of a cluster, or all threads those of the only one. Returns false if one is no number.
 */
inline DEVICE bool addClustersOfPart(const Part* part, GLOBAL const mixed* v, GLOBAL const mm_long* RESTRICT force, int paddedNumAtoms, mixed* sums,
        LOCAL_ARG mixed* buffer LAST_STATE_PARAMETER) {
    const int numMoving = part->clusterStart[part->numClusters];
    pushParticles(part, part->solution, -1, part->acceleration, part->base); // by the net force
    KEEP_LOOP for (int i = THREAD; i < numMoving; i += NUM_THREADS) {
        mixed terms[CLUSTER_TERM_COUNT], u[3], a[3];
        UNROLL for (int d = 0; d < 3; d++) {
            u[d] = v[3*i+d];
            a[d] = part->base[3*i+d];
        }
        const mixed w = part->inverseMass[i];
#if UPDATE == AUTOMATIC
        const int atom = part->atoms[i];
        mixed applied[3];
        const mixed forceSquared = loadAcceleration(force, paddedNumAtoms, atom, w, applied);
        for (int j = 0; j < CLUSTER_TERM_COUNT; j++)
            terms[j] = 0;
        const mixed halfStep[3] = {part->before[3*i], part->before[3*i+1], part->before[3*i+2]};
        followForce(terms, last, loadLastForce(last, paddedNumAtoms, atom), force, paddedNumAtoms, atom, w, halfStep);
        addFlight(terms, forceSquared, u);
        addAutomaticTerms(terms, last, atom, w, u, a);
#else
        terms[0] = shareOf(dot3(a, a), w, u);
#endif
        for (int j = 0; j < CLUSTER_TERM_COUNT; j++)
            part->terms[j*part->numParticles + i] = terms[j];
    }
    SYNC_PIECE;
    const bool isOnly = (part->numClusters == 1);
    const int first = (isOnly ? THREAD : 0), stride = (isOnly ? NUM_THREADS : 1);
    mixed terms[CLUSTER_TERM_COUNT];
    bool isRegular = true;
    KEEP_LOOP for (int c = (isOnly ? 0 : THREAD); c < part->numClusters; c += (isOnly ? 1 : NUM_THREADS)) {
        for (int j = 0; j < CLUSTER_TERM_COUNT; j++)
            terms[j] = 0;
        KEEP_LOOP for (int i = part->clusterStart[c] + first; i < part->clusterStart[c+1]; i += stride)
            for (int j = 0; j < CLUSTER_TERM_COUNT; j++)
                terms[j] += part->terms[j*part->numParticles + i];
        if (!isOnly)
            isRegular = ADD_CLUSTER_OF_PART(terms, part->atoms[part->clusterStart[c]]) && isRegular;
    }
    if (isOnly) {
        ADD_IN_GROUP(terms, CLUSTER_TERM_COUNT);
        if (THREAD == 0)
            isRegular = ADD_CLUSTER_OF_PART(terms, part->atoms[0]);
    }
    SYNC_PIECE;
    return isRegular;
}

#endif

/** The largest of a number that each thread has; what is none counts as very large. */
inline DEVICE mixed findLargest(mixed value, LOCAL_ARG mixed* buffer) {
    mixed largest = (value < (mixed) 1e30f ? value : (mixed) 1e30f);
#if NUM_THREADS > 1
    buffer[THREAD] = largest;
    KEEP_LOOP for (int width = NUM_THREADS/2; width > 0; width /= 2) {
        SYNC_PIECE;
        if (THREAD < width)
            buffer[THREAD] = max(buffer[THREAD], buffer[THREAD+width]);
    }
    SYNC_PIECE;
    largest = buffer[0];
    SYNC_PIECE;
#endif
    return largest;
}

/**
 * Solve g(q + base + M^-1 G^T gamma) = 0 from gamma = -guess lambda; moved is the way there, and acceleration what it leads to. G and the
 * factor of K, of no use where it is Newton's iteration from the first, are those of q. Returns the number of iterations, or -1 if they
 * do not converge. There is at least one, since lambda itself, unrefined, costs accuracy even where it meets the tolerance.
 */
inline DEVICE int solvePart(const Part* part, bool isNewton, mixed guess, mixed tolerance, const Parameters* theta, LOCAL_ARG mixed* buffer) {
    findScales(part, theta->next);
    int iterations = 0, sinceGuess = 0, result = -1;
    bool isGuess = true;
    mixed previous = 1e30f, share = 1; // of Newton's update, which right keeps
    KEEP_LOOP for (int i = 0; i < MAX_PART_ITERATIONS && result < 0; i++) {
        if (isGuess)
            KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS)
                part->gamma[k] = -guess*part->multipliers[k];
        isGuess = false;
        SYNC_PIECE;
        pushParticles(part, part->gamma, 1, part->base, part->moved);
        // The positions there, in the place of what nobody needs any more.
        KEEP_LOOP for (int j = THREAD; j < 3*part->numParticles; j += NUM_THREADS)
            part->acceleration[j] = part->position[j] + part->moved[j];
        SYNC_PIECE;
        mixed error = 0;
        KEEP_LOOP for (int j = THREAD; j < part->numRows; j += NUM_THREADS) {
            const int k = part->order[j];
            const mixed g = findValue(part->kinds[k], part->acceleration, part->places + part->rowEntry[k], theta->next + part->rowParameter[k]);
            const mixed e = fabs(g)*part->scale[k];
            error = (e <= error ? error : e < (mixed) 1e30f ? e : (mixed) 1e30f);
            part->solution[k] = -g;
        }
        error = findLargest(error, buffer);
        const bool isSlow = !(error < previous*SLOW_CONVERGENCE);
        // To a fraction of the tolerance, or as far as rounding allows.
        if (sinceGuess > 0 && (error <= tolerance*MARGIN || (error <= tolerance && isSlow)))
            result = iterations;
        else if (isNewton && sinceGuess > 0 && error > tolerance && share > (mixed) SMALLEST_SHARE && !(error <= (1 - share/4)*previous)) {
            share /= 2; // it was too long
            KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS)
                part->gamma[k] -= share*part->right[k];
        }
        else if (!isNewton && sinceGuess > 0 && (!(error < previous/2) || sinceGuess == MAX_CHORD_ITERATIONS)) {
            isNewton = isGuess = true;
            sinceGuess = 0;
            previous = 1e30f;
        }
        else {
            if (isNewton) {
                findRows(part, part->acceleration, theta->next, part->nextG);
                formMatrix(part, part->nextG, part->G, false, part->newtonPivots, part->newtonLower, part->newtonUpper);
                factorizePart(part, false, part->newtonPivots, part->newtonLower, part->newtonUpper);
            }
            SYNC_PIECE;
            solveWithFactor(part, isNewton ? part->newtonPivots : part->pivots, isNewton ? part->newtonLower : part->lower,
                    isNewton ? part->newtonUpper : part->lower, part->solution);
            KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS)
                part->gamma[k] += part->right[k] = part->solution[k];
            previous = error;
            share = 1;
            iterations++;
            sinceGuess++;
        }
        SYNC_PIECE;
    }
    return result;
}

#if UPDATE == LANGEVIN

/**
 * In the middle of a drift: the velocities that moved stands for get their noise, and what follows begins there. before is the way that
 * has been gone. Returns false if constraints depend on each other there.
 */
inline DEVICE bool turnPart(const Part* part, mixed drift, const Parameters* theta, Noise noise, GLOBAL const int* RESTRICT atomIndex) {
    KEEP_LOOP for (int i = THREAD; i < part->numParticles; i += NUM_THREADS) {
        const mixed w = part->inverseMass[i];
        mixed v[3];
        UNROLL for (int d = 0; d < 3; d++) {
            part->before[3*i+d] = part->moved[3*i+d];
            part->position[3*i+d] += part->moved[3*i+d];
            v[d] = part->moved[3*i+d]/drift;
        }
        if (w > 0)
            addNoise(noise, atomIndex[part->atoms[i]], w, v);
        UNROLL for (int d = 0; d < 3; d++)
            part->base[3*i+d] = drift*v[d];
    }
    SYNC_PIECE;
    findRows(part, part->position, theta->next, part->G);
    formMatrix(part, part->G, part->G, true, part->pivots, part->lower, part->lower);
    return factorizePart(part, true, part->pivots, part->lower, part->lower);
}

#endif

// The noise of Langevin dynamics, once for all particles.
#if UPDATE == LANGEVIN
#define NOISE_PARAMETERS_OF_PART , Noise noise, GLOBAL const int* RESTRICT atomIndex
#define NOISE_ARGUMENTS_OF_PART , noise, atomIndex
#else
#define NOISE_PARAMETERS_OF_PART
#define NOISE_ARGUMENTS_OF_PART
#endif

#define EXPRESSION_MEMORY LOCAL mixed buffer[PIECE_SUMS];
#if NUM_THREADS > 1
#define MERGE_PART_SUMS(sums) mergeInGroup(sums, buffer)
#else
#define MERGE_PART_SUMS(sums)
#endif

#if HALF_SUMS

/** A step of size dt and its monitors, for (3.14). Returns the number of iterations, or -1 if they do not converge. */
inline DEVICE int tryPart(const Part* part, bool isNewton, mixed dt, mixed tolerance, const Parameters* theta, EXPRESSION_STATE_PARAMETERS, mixed* sums, LOCAL_ARG mixed* buffer) {
    loadPart(part, dt, dt/2, EXPRESSION_STATE_ARGUMENTS);
    findRows(part, part->position, theta->here, part->G);
    if (isNewton) { // else there is a factor
        formMatrix(part, part->G, part->G, true, part->pivots, part->lower, part->lower);
        factorizePart(part, true, part->pivots, part->lower, part->lower);
    }
    const int iterations = solvePart(part, isNewton, dt*dt/2, tolerance, theta, buffer);
    if (iterations >= 0) // where the next trial starts
        KEEP_LOOP for (int k = THREAD; k < part->numRows; k += NUM_THREADS)
            part->multipliers[k] = -2*part->gamma[k]/(dt*dt);
    KEEP_LOOP for (int j = THREAD; j < part->numParticles; j += NUM_THREADS) {
        mixed a[3];
        loadAcceleration(force, paddedNumAtoms, part->atoms[j], part->inverseMass[j], a);
        UNROLL for (int d = 0; d < 3; d++) {
            part->acceleration[3*j+d] = a[d];
            part->moved[3*j+d] *= 1/dt;
        }
    }
    SYNC_PIECE;
    measurePart(part, part->moved, theta, theta->here, 1/dt, force, paddedNumAtoms, sums);
    if (iterations < 0 && THREAD == 0)
        sums[FAILURES] += 1;
    MERGE_PART_SUMS(sums);
    return iterations;
}

#endif

/**
 * (3.9)-(3.11) for a step of size dt; first are the parameters of the first drift in Langevin dynamics. Returns the number of iterations, or -1 if they do not
 * converge.
 */
inline DEVICE int advancePart(const Part* part, bool isNewton, int step, mixed dt, mixed tolerance, const Parameters* first, const Parameters* theta, EXPRESSION_STATE_PARAMETERS, GLOBAL int* RESTRICT failure,
        GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities, LOCAL_ARG mixed* buffer NOISE_PARAMETERS_OF_PART) {
    const mixed drift = (UPDATE == LANGEVIN ? dt/2 : dt), inverse = (drift > 0 ? 1/drift : (mixed) 0);
    loadPart(part, drift, dt/2, EXPRESSION_STATE_ARGUMENTS);
    KEEP_LOOP for (int j = THREAD; j < part->numParticles; j += NUM_THREADS)
        if (part->inverseMass[j] > 0) {
            const int atom = part->atoms[j];
            mixed x[3];
            const real charge = loadPosition(posq, posqCorrection, atom, x);
            oldPositions[atom] = make_mixed4(x[0], x[1], x[2], charge);
            oldVelocities[atom] = velm[atom];
        }
    findRows(part, part->position, theta->here, part->G);
    int iterations = solvePart(part, isNewton, dt/2*drift, tolerance, first, buffer);
#if UPDATE == LANGEVIN
    const bool isRegular = turnPart(part, drift, first, noise, atomIndex);
    const int more = solvePart(part, isNewton, 0, tolerance, theta, buffer);
    iterations = (iterations < 0 || more < 0 ? -1 : iterations + more);
    if (!isRegular)
        fail(failure, step, IRREGULAR);
#endif
    KEEP_LOOP for (int j = THREAD; j < (iterations >= 0 ? part->numParticles : 0); j += NUM_THREADS)
        if (part->inverseMass[j] > 0) {
            const int atom = part->atoms[j];
            const mixed4 old = oldPositions[atom];
            const mixed x = part->moved[3*j], y = part->moved[3*j+1], z = part->moved[3*j+2];
#if UPDATE == LANGEVIN
            storePosition(posq, posqCorrection, atom, old.x + (part->before[3*j] + x), old.y + (part->before[3*j+1] + y), old.z + (part->before[3*j+2] + z), (real) old.w);
#else
            storePosition(posq, posqCorrection, atom, old.x + x, old.y + y, old.z + z, (real) old.w);
#endif
            velm[atom] = make_mixed4(inverse*x, inverse*y, inverse*z, part->inverseMass[j]);
        }
    if (THREAD == 0 && iterations < 0)
        fail(failure, step, NOT_CONVERGED);
    return iterations;
}

// ------------------------------------------------------------------------------------------------------------------- the kernels

#if HAS_EXPRESSIONS

/** finishStep for the parts. */
KERNEL void finishExpressions(int step, mixed kick, int isFormed, int isStored, GLOBAL const wide* RESTRICT control, GLOBAL const wide* RESTRICT settings,
        GLOBAL mixed* RESTRICT partials, EXPRESSION_PARAMETERS LAST_STATE_PARAMETERS) {
    EXPRESSION_MEMORY
    OPEN_PARAMETERS
    const bool isFrozen = (failure[0] != 0), formHalf = (isFormed || control[IS_SHORTENED] != 0);
    const mixed dt = (mixed) control[STEP_SIZE], halfKick = (mixed) (settings[NOMINAL]/(2*control[DENSITY])), rate = 1/dt;
    MAKE_LAST_STATE(kick, dt, isFormed)
    mixed sums[NUM_SUMS], halfSums[NUM_SUMS];
    // A failure elsewhere in this launch may be seen by some threads of a group, so nothing but what is written depends on it.
    KEEP_LOOP for (int i = GROUP_ID; i < numParts; i += NUM_GROUPS) {
        const Part part = OPEN_PART;
        for (int j = 0; j < NUM_SUMS; j++)
            sums[j] = halfSums[j] = 0;
        bool isRegular = loadPart(&part, 1, kick*dt, EXPRESSION_STATE_ARGUMENTS);
        findRows(&part, part.position, theta.next, part.G);
        formMatrix(&part, part.G, part.G, true, part.pivots, part.lower, part.lower);
        isRegular = factorizePart(&part, true, part.pivots, part.lower, part.lower) && isRegular;
        KEEP_LOOP for (int j = THREAD; j < part.numRows; j += NUM_THREADS) { // (3.13)
            const int k = part.order[j], first = part.rowParameter[k];
            part.solution[k] = multiplyRow(&part, k, part.base);
            if (theta.areMoving)
                part.solution[k] += findMotion(part.kinds[k], part.position, part.places + part.rowEntry[k], theta.next + first, theta.changes + first, rate);
        }
        SYNC_PIECE;
        solveWithFactor(&part, part.pivots, part.lower, part.lower, part.solution);
        pushParticles(&part, part.solution, -1, part.base, part.moved);
        if (isStored && !isFrozen)
            KEEP_LOOP for (int j = THREAD; j < part.numParticles; j += NUM_THREADS)
                if (part.inverseMass[j] > 0)
                    velm[part.atoms[j]] = make_mixed4(part.moved[3*j], part.moved[3*j+1], part.moved[3*j+2], part.inverseMass[j]);
        measurePart(&part, part.moved, &theta, theta.next, rate, force, paddedNumAtoms, sums);
        SYNC_PIECE;
#ifdef CLUSTER_TERM_COUNT
        isRegular = addClustersOfPart(&part, part.moved, force, paddedNumAtoms, sums, buffer LAST_STATE_ARGUMENT) && isRegular;
#endif
        KEEP_LOOP for (int k = THREAD; k < (isFrozen ? 0 : part.numRows); k += NUM_THREADS)
            part.multipliers[k] = part.solution[k];
        MERGE_PART_SUMS(sums);
        if (THREAD == 0 && !isFrozen)
            for (int j = 0; j < NUM_SUMS; j++)
                partials[j*numPartials + firstPartial + i] = sums[j];
#if HALF_SUMS
        if (formHalf) {
            KEEP_LOOP for (int j = THREAD; j < 3*part.numParticles; j += NUM_THREADS)
                part.base[j] = part.moved[j] - halfKick*part.acceleration[j];
            SYNC_PIECE;
            pushParticles(&part, part.solution, halfKick, part.base, part.before);
        }
        SYNC_PIECE;
        measurePart(&part, part.before, &theta, theta.next, rate, force, paddedNumAtoms, halfSums);
        MERGE_PART_SUMS(halfSums);
        if (THREAD == 0 && !isFrozen)
            for (int j = 0; j < NUM_SUMS; j++)
                partials[(NUM_SUMS + j)*numPartials + firstPartial + i] = halfSums[j];
#endif
        if (!isRegular && !isFrozen)
            fail(failure, step, IRREGULAR + NUM_CODES*i);
        SYNC_PIECE;
    }
}

#if HALF_SUMS

/** tryStep for the parts, which takes what that has found of the next trial. */
KERNEL void tryExpressions(int step, mixed tolerance, GLOBAL const wide* RESTRICT settings, GLOBAL const wide* RESTRICT nextTrial, GLOBAL mixed* RESTRICT nextPartials, EXPRESSION_PARAMETERS) {
    EXPRESSION_MEMORY
    OPEN_PARAMETERS
    const bool isTrying = (nextTrial[TRIAL_STATUS] == TRYING && !IS_FROZEN(failure, step));
    const mixed dt = (mixed) (settings[NOMINAL]/nextTrial[TRIAL_DENSITY]);
    mixed sums[NUM_SUMS];
    KEEP_LOOP for (int i = (isTrying ? GROUP_ID : numParts); i < numParts; i += NUM_GROUPS) {
        const Part part = OPEN_PART;
        for (int j = 0; j < NUM_SUMS; j++)
            sums[j] = 0;
        tryPart(&part, false, dt, tolerance, &theta, EXPRESSION_STATE_ARGUMENTS, sums, buffer);
        if (THREAD == 0)
            for (int j = 0; j < NUM_SUMS; j++)
                nextPartials[j*numPartials + firstPartial + i] = sums[j];
        SYNC_PIECE;
    }
}

#endif

/** advanceStep for the parts, which takes the step size that that has found. */
KERNEL void advanceExpressions(int step, mixed tolerance, GLOBAL const wide* RESTRICT nextControl, GLOBAL mixed4* RESTRICT oldPositions, GLOBAL mixed4* RESTRICT oldVelocities,
        EXPRESSION_PARAMETERS MIDDLE_PARAMETERS LARGE_NOISE_STATE) {
    EXPRESSION_MEMORY
    OPEN_PARAMETERS
    Parameters first = theta; // of the first drift
#if UPDATE == LANGEVIN
    first.next = middleParameters;
#endif
#if UPDATE == LANGEVIN
    const Noise noise = makeNoise(step, noiseState, settings);
#endif
    KEEP_LOOP for (int i = (HAS_NO_STEP(failure, step) ? numParts : GROUP_ID); i < numParts; i += NUM_GROUPS) {
        const Part part = OPEN_PART;
        const int iterations = advancePart(&part, false, step, (mixed) nextControl[STEP_SIZE], tolerance, &first, &theta, EXPRESSION_STATE_ARGUMENTS, failure,
                oldPositions, oldVelocities, buffer NOISE_ARGUMENTS_OF_PART);
        if (THREAD == 0 && iterations >= 0)
            partIterations[i] += iterations;
        SYNC_PIECE;
    }
}

#endif
