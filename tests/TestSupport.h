// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_TESTSUPPORT_H_
#define OPENMMVRATTLE_TESTSUPPORT_H_

#include "openmm/OpenMMException.h"
#include "openmm/Vec3.h"
#include "openmm/internal/AssertionUtilities.h"
#include <algorithm>
#include <cmath>
#include <functional>
#include <iostream>
#include <sstream>
#include <string>
#include <utility>
#include <vector>
#ifdef __SANITIZE_ADDRESS__
    #include <sanitizer/lsan_interface.h>
#endif

namespace OpenMMVRattle {

using OpenMM::throwException; // which OpenMM's ASSERT macros name without its namespace

const double BOLTZMANN = 8.31446261815324e-3; // kJ/mol/K

typedef std::vector<std::pair<std::string, std::function<void()>>> TestList;

/** Run tests, report each that fails, and return the exit status of the program. */
inline int runTests(const TestList& tests) {
    int numFailed = 0;
    for (const auto& test : tests) {
        try {
            test.second();
            std::cout << "passed: " << test.first << std::endl;
        }
        catch (const std::exception& e) {
            numFailed++;
            std::cout << "FAILED: " << test.first << ": " << e.what() << std::endl;
        }
    }
    std::cout << tests.size() - numFailed << " passed, " << numFailed << " failed" << std::endl;
    return numFailed == 0 ? 0 : 1;
}

/** The largest difference between coordinates of two sets of vectors. */
inline double largestDifference(const std::vector<OpenMM::Vec3>& a, const std::vector<OpenMM::Vec3>& b) {
    double largest = 0;
    for (size_t i = 0; i < a.size(); i++)
        for (int j = 0; j < 3; j++)
            largest = std::max(largest, std::fabs(a[i][j] - b[i][j]));
    return largest;
}

/**
 * In place of a pool of threads: what they would do at once is done one after the other, the last thread's share first, since
 * the order must not matter.
 *
 * @param numThreads    the number of threads
 * @param calls         counts how often the pool is asked; it must live as long as the result
 */
inline std::function<void(const std::function<void(int)>&)> runInReverse(int numThreads, int& calls) {
    return [numThreads, &calls](const std::function<void(int)>& task) {
        calls++;
        for (int thread = numThreads - 1; thread >= 0; thread--)
            task(thread);
    };
}

/** Assert that something is no more than that; the message has both numbers. */
inline void requireAtMost(double largest, double found, const std::string& what) {
    std::stringstream message;
    message << what << ": " << found << ", more than " << largest;
    if (!(found <= largest))
        throw OpenMM::OpenMMException(message.str());
}

/** Assert that an action throws an exception whose text contains something. */
template <class Action> void assertThrows(const std::string& text, Action action) {
#ifdef __SANITIZE_ADDRESS__
    // The constructor of OpenMM's Context forgets what it has allocated when an integrator refuses a System.
    __lsan::ScopedDisabler disabler;
#endif
    try {
        action();
    }
    catch (const std::exception& e) {
        if (std::string(e.what()).find(text) == std::string::npos)
            throw OpenMM::OpenMMException("expected an exception with \"" + text + "\", got \"" + e.what() + "\"");
        return;
    }
    throw OpenMM::OpenMMException("expected an exception with \"" + text + "\", got none");
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_TESTSUPPORT_H_
