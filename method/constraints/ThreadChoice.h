// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_THREADCHOICE_H_
#define OPENMMVRATTLE_THREADCHOICE_H_

#include <algorithm>

namespace OpenMMVRattle {

/**
 * Whether a step takes less time with several threads than with one, found out by measuring both in the course of a run. What a call
 * of a thread pool costs depends on the machine and on what the threads did before, from 5 us to half a millisecond, so that no
 * fixed number of constraints could tell. The results of steps must not depend on the number of threads.
 */
class ThreadChoice {
public:
    /** Now and then there is a trial: so many runs of so many steps, every other of them with several threads. */
    static constexpr int NUM_RUNS = 4, RUN_LENGTH = 12, TRIAL_LENGTH = NUM_RUNS * RUN_LENGTH;
    /** The steps from the beginning of one trial to that of the next. */
    static constexpr int PERIOD = 1000;
    /** Whether the next step is to use several threads. */
    bool isParallel() const {
        return place < TRIAL_LENGTH ? place / RUN_LENGTH % 2 == 0 : isParallelFaster;
    }
    /** Tell how long (s) a step took that did as isParallel() said. */
    void add(double seconds) {
        if (place == 0)
            counts[false] = counts[true] = 0;
        // The first steps of a run bear the cost of the change: threads that have slept wake up slowly.
        if (place < TRIAL_LENGTH && place % RUN_LENGTH >= RUN_LENGTH / 2)
            trial[isParallel()][counts[isParallel()]++] = seconds;
        place = (place + 1) % PERIOD;
        if (place == TRIAL_LENGTH)
            isParallelFaster = findMedian(true) < findMedian(false);
    }

private:
    static constexpr int NUM_MEASURED = NUM_RUNS / 2 * (RUN_LENGTH / 2); // each way
    double findMedian(bool parallel) {
        std::nth_element(trial[parallel], trial[parallel] + NUM_MEASURED / 2, trial[parallel] + NUM_MEASURED);
        return trial[parallel][NUM_MEASURED / 2];
    }
    int place = 0; // in the period
    double trial[2][NUM_MEASURED] = {};
    int counts[2] = {0, 0};
    bool isParallelFaster = true;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_THREADCHOICE_H_
