// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The recursions of automatic step control (AutomaticControl.h, docs/automatic_method.md) as one text for hosts and devices, in what
// C++, OpenCL C and CUDA have in common: AutomaticControl.h includes it, and the program of a device has it word for word. What is
// around it defines
//
//     wide                          the type of all numbers
//     stretch(rho, a) and unstretch(y, a)    f(rho) = (rho - a) - (1 - a)^2/(rho - a) and its inverse
//     SELDOM                        before functions that calm steps do not call; a device shall not write them out where they are
//                                   called, for what does not fit into its instruction cache costs more than all the arithmetic
//
// Constants are quotients of whole numbers, since not all devices have literals in double precision. Monitor 0 is U_A, on steps;
// monitor 1 is U_B, on half steps.

/** What the following steps depend on, beside the references and what belongs to clusters and particles. */
typedef struct {
    wide behind[2], ahead[2]; // f(A), f(B) on the half steps n-1/2 and n+1/2
    wide values[2]; // U_A[n] and U_B[n-1/2], the latter 0 before the first step
    wide stepsSinceStart; // of this sequence, as far as they count
    wide numLearnt, logarithms[2]; // steps that have been learnt from, and the mean of ln U over them
    wide temperature; // 2K/f (kJ/mol) where the references were found
    wide following; // for how many steps the references follow the run
    wide shortSteps, mostShortSteps; // steps in a row below a tenth of the nominal one: now, and the most there were
} AutomaticNumbers;

/** What a user can choose, and what follows from the System. */
typedef struct {
    wide stepSize, minimumStep; // ps; no minimum if that is 0
    wide learningSteps; // how many steps the references are the mean of
    wide given[2]; // references that are not to be found; 0 for the others
    wide thermalUnit; // (sum_c max(1, N_c/12)^4)^(1/8)/stepSize with the number N_c of particles in a cluster
    wide hottest; // 2K/f (kJ/mol) beyond which nothing moves any more as a particle can
} AutomaticChoice;

/** The value of a monitor where the momenta of every cluster change by those of this 2K/f in a nominal step. */
inline DEVICE wide automaticThermalValue(const AutomaticChoice* choice, wide kT) {
    return sqrt(kT) * choice->thermalUnit;
}

/** 2K/f at 300 K: at rest things are measured as there (kJ/mol). */
inline DEVICE wide automaticRoomTemperature(void) {
    return (wide) 2494338 / 1000000;
}

/** What is nothing, but for rounding. */
inline DEVICE wide automaticNegligibleValue(const AutomaticChoice* choice) {
    return automaticThermalValue(choice, automaticRoomTemperature()) / 1000000;
}

SELDOM DEVICE wide automaticLogarithm(wide x) {
    return log(x);
}

SELDOM DEVICE wide automaticExponential(wide x) {
    return exp(x);
}

inline DEVICE wide automaticSixteenthPower(wide x) {
    const wide square = x * x, fourth = square * square, eighth = fourth * fourth;
    return eighth * eighth;
}

inline DEVICE wide automaticSixteenthRoot(wide x) {
    return sqrt(sqrt(sqrt(sqrt(x))));
}

/** phi(u) without its upper bound: exactly 1 for u up to 2, nearly u/2.5 far above it. */
inline DEVICE wide automaticDeadZone(wide u) {
    const wide end = (wide) 5 / 2, exactPart = (wide) 4 / 5;
    const wide x = min(u / end, (wide) 1000000000); // whose fourth power does not overflow
    const wide beyond = max((wide) 0, x * x * x * x - exactPart * exactPart * exactPart * exactPart);
    const wide squared = beyond * beyond;
    return beyond > 10000 ? sqrt(sqrt(beyond)) : automaticSixteenthRoot(1 + squared * squared);
}

/** No step is below the minimum, and a density of 1 stays what it is. */
inline DEVICE wide automaticLimit(wide stepSize, wide minimumStep, wide density) {
    if (!(density > 1) || minimumStep == 0)
        return density;
    const wide excess = density - 1, largest = stepSize / minimumStep - 1, ratio = excess / largest;
    return ratio > 10 ? 1 + largest : 1 + excess / automaticSixteenthRoot(1 + automaticSixteenthPower(ratio));
}

/** a: no step is longer than the nominal one divided by it. */
inline DEVICE wide automaticSmallest(void) {
    return (wide) 3 / 4;
}

/** f(phi(u)) of a monitor k, this many times its reference. */
SELDOM DEVICE wide automaticHardTarget(wide stepSize, wide minimumStep, int k, wide ratio) {
    const wide u = pow(ratio, k == 0 ? (wide) 2 / 3 : (wide) 4 / 5);
    return stretch(automaticLimit(stepSize, minimumStep, automaticDeadZone(u)), automaticSmallest());
}

/** f(phi(u)) of a monitor k; f(1) = 0 while there is no reference, and in the dead zone. */
inline DEVICE wide automaticTarget(const wide* references, const AutomaticChoice* choice, int k, wide value) {
    const wide calm = (wide) 23 / 10; // whose powers are less than 2
    if (!(references[k] > 0) || value < calm * references[k])
        return 0;
    return automaticHardTarget(choice->stepSize, choice->minimumStep, k, value / references[k]);
}

/** rho of f(A) and f(B). */
SELDOM DEVICE wide automaticHardDensity(wide stepSize, wide minimumStep, wide transformedA, wide transformedB) {
    const wide a = unstretch(transformedA, automaticSmallest()), b = unstretch(transformedB, automaticSmallest());
    return automaticLimit(stepSize, minimumStep, sqrt((a * a + b * b) / 2));
}

/** The same, which is exactly 1 where both are 0. */
inline DEVICE wide automaticDensity(const AutomaticChoice* choice, const wide* transformed) {
    if (transformed[0] == 0 && transformed[1] == 0)
        return 1;
    return automaticHardDensity(choice->stepSize, choice->minimumStep, transformed[0], transformed[1]);
}

/** Draw both sequences towards their monitors by a part of their distance. */
inline DEVICE void automaticDraw(AutomaticNumbers* m, const wide* references, const AutomaticChoice* choice,
                                 wide part) {
    for (int k = 0; k < 2; k++)
        if (m->values[k] != 0) { // else it is not known yet, or there is nothing
            const wide target = automaticTarget(references, choice, k, m->values[k]);
            m->behind[k] += part * (target - m->behind[k]);
            m->ahead[k] += part * (target - m->ahead[k]);
        }
}

/** References that have been found; the user's stay. */
inline DEVICE void automaticSetFound(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide onStep,
                                     wide halfStep) {
    references[0] = (choice->given[0] > 0 ? choice->given[0] : onStep);
    references[1] = (choice->given[1] > 0 ? choice->given[1] : halfStep);
    m->stepsSinceStart = 0;
}

/** What is hard beyond doubt, in units of the thermal momentum a step, is not learnt from; returns whether it is. */
inline DEVICE bool automaticFindHard(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT) {
    const wide atLeast = max(kT, automaticRoomTemperature()), unit = automaticThermalValue(choice, atLeast);
    if (!(m->values[0] > 8 * unit))
        return false;
    automaticSetFound(m, references, choice, unit * 2 / 5, unit * 2 / 5);
    m->temperature = atLeast;
    return true;
}

/** Nor is a step in which nothing pulls and nothing moves. */
inline DEVICE void automaticLearn(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT) {
    if (automaticFindHard(m, references, choice, kT) ||
        min(m->values[0], m->values[1]) <= automaticNegligibleValue(choice))
        return;
    m->numLearnt += 1;
    m->temperature += (kT - m->temperature) / m->numLearnt;
    for (int k = 0; k < 2; k++)
        m->logarithms[k] += (automaticLogarithm(m->values[k]) - m->logarithms[k]) / m->numLearnt;
    if (m->numLearnt >= choice->learningSteps)
        automaticSetFound(m, references, choice, automaticExponential(m->logarithms[0]),
                          automaticExponential(m->logarithms[1]));
}

/** While they follow, references are not less than a fifth of the thermal value. */
inline DEVICE void automaticRaiseReferences(wide* references, const AutomaticChoice* choice, wide kT) {
    const wide least = max(automaticThermalValue(choice, kT) / 5, automaticNegligibleValue(choice));
    for (int k = 0; k < 2; k++)
        if (choice->given[k] == 0 && references[k] > 0)
            references[k] = max(references[k], least);
}

/**
 * The references follow the logarithms of the monitors, which count as no more than 2 above or below, in 100 nominal steps: a mean
 * over the last steps that nothing can capture.
 */
inline DEVICE void automaticFollow(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT,
                                   wide part) {
    const wide weight = part / 100, largest = 2;
    m->following -= 1;
    m->temperature += min((wide) 1, weight) * (kT - m->temperature);
    for (int k = 0; k < 2; k++)
        if (choice->given[k] == 0) {
            const wide surprise = automaticLogarithm(m->values[k] / references[k]);
            references[k] *= automaticExponential(weight * min(max(surprise, -largest), largest));
        }
    automaticRaiseReferences(references, choice, kT);
}

/**
 * After a step that was this part of a nominal one, at whose end 2K/f is kT. With other references the sequences keep their distances
 * from the monitors. In the first steps of a sequence they are drawn towards these, for what the monitors were before is not known.
 */
inline DEVICE void automaticAdapt(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT,
                                  wide part) {
    const int settlingSteps = 30;
    const bool areKnown = (references[0] > 0 && references[1] > 0);
    if (!areKnown || m->following > 0) {
        wide before[2];
        for (int k = 0; k < 2; k++)
            before[k] = automaticTarget(references, choice, k, m->values[k]);
        if (areKnown)
            automaticFollow(m, references, choice, kT, part);
        else
            automaticLearn(m, references, choice, kT);
        for (int k = 0; k < 2; k++) {
            const wide shift = automaticTarget(references, choice, k, m->values[k]) - before[k];
            m->behind[k] += shift;
            m->ahead[k] += shift;
        }
    }
    if (m->stepsSinceStart < settlingSteps) {
        m->stepsSinceStart += 1;
        automaticDraw(m, references, choice, (wide) 1 / 10);
    }
}

/** Move on after a step of density automaticDensity(ahead), whose monitors are in m->values. */
inline DEVICE void automaticMoveOn(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT) {
    const wide density = automaticDensity(choice, m->ahead);
    m->shortSteps = (density > 10 ? m->shortSteps + 1 : 0);
    m->mostShortSteps = max(m->mostShortSteps, m->shortSteps);
    automaticAdapt(m, references, choice, kT, 1 / density);
    for (int k = 0; k < 2; k++) {
        const wide last = m->behind[k], target = automaticTarget(references, choice, k, m->values[k]);
        m->behind[k] = m->ahead[k];
        // A joins its two neighbours of step n, B those of half step n-1/2.
        m->ahead[k] = 2 * target - (k == 0 ? m->ahead[k] : last);
    }
}

/**
 * The same after a step that was this part of a full one: the densities move on by that part of what they would in a full step. U_B of
 * a short step is spoiled by the rounding of the forces, and counts only if the step is at least half a full one.
 */
inline DEVICE void automaticMoveOnPart(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT,
                                       wide part) {
    const bool counts = (part >= (wide) 1 / 2);
    if (counts)
        automaticAdapt(m, references, choice, kT, part / automaticDensity(choice, m->ahead));
    const wide onStep = automaticTarget(references, choice, 0, m->values[0]);
    const wide halfStep = (counts ? automaticTarget(references, choice, 1, m->values[1]) : m->ahead[1]);
    const wide afterNext = 2 * halfStep - m->behind[1];
    for (int k = 0; k < 2; k++)
        m->behind[k] += part * (m->ahead[k] - m->behind[k]);
    m->ahead[0] = 2 * onStep - m->behind[0];
    m->ahead[1] += part * (afterNext - m->ahead[1]);
}

/**
 * Go on at a changed on-step state, where U_A is onStep: A moves by as much as its monitor asks for, and so that changes again and
 * again do not add up to an oscillation, both sequences are drawn towards their monitors. Unless the change is mere rounding, the
 * references follow the run for the next steps.
 */
inline DEVICE void automaticChange(AutomaticNumbers* m, wide* references, const AutomaticChoice* choice, wide kT,
                                   wide onStep, wide part) {
    const wide before = automaticTarget(references, choice, 0, m->values[0]);
    m->values[0] = onStep;
    if (part > (wide) 1 / 1000000) {
        m->following = 1000;
        automaticRaiseReferences(references, choice, kT);
    }
    const wide shift = automaticTarget(references, choice, 0, onStep) - before;
    m->behind[0] += shift;
    m->ahead[0] += shift;
    automaticDraw(m, references, choice, part);
}
