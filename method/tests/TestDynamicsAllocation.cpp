// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Once a run is going, a step allocates no memory; so it does not fall back on Newton's full matrix, which would.

#include "Steps.h"
#include "TestSupport.h"
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <new>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

static std::atomic<long long> numAllocations(0);

#ifndef __SANITIZE_ADDRESS__ // which has an operator of its own
void* operator new(std::size_t size) {
    numAllocations++;
    void* memory = std::malloc(size);
    if (memory == nullptr)
        throw std::bad_alloc();
    return memory;
}

void operator delete(void* memory) noexcept {
    std::free(memory);
}

void operator delete(void* memory, std::size_t) noexcept {
    std::free(memory);
}
#endif

// Waters, zigzag chains of which one is cut into pieces, angles held by expressions, and free particles.
static Example makeExample() {
    Example e;
    for (int bonds : {20000, 300, 10, 10}) {
        const double height = (double) e.masses.size();
        int last = e.add(14, Vec3(0, height, 0));
        for (int i = 1; i <= bonds; i++) {
            const int next = e.add(14, Vec3(0.12 * i, height + 0.05 * (i % 2), 0));
            e.join(last, next);
            last = next;
        }
    }
    for (int n = 0; n < 200; n++) {
        e.addWater(Vec3(n, -5, 0));
        const Vec3 corner(n, -10, 0);
        const int a = e.add(12, corner + Vec3(0.1, 0, 0)), b = e.add(12, corner),
                  c = e.add(12, corner + Vec3(0, 0.1, 0));
        e.expressions.push_back({"(x1-x2)*(x3-x2)+(y1-y2)*(y3-y2)+(z1-z2)*(z3-z2)", {a, b, c}, {}});
        e.add(40, Vec3(n, -20, 0));
    }
    return e;
}

void testSteps(const Example& e, const VRattleRun::Settings& settings, int numThreads) {
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    ASSERT(!dynamics.getConstraintSystem().getPieces().empty());
    int calls = 0;
    dynamics.setParallel(runInReverse(numThreads, calls), numThreads);
    dynamics.setSettings(settings);
    vector<Vec3> forces(e.masses.size());
    dynamics.begin(e.positions, e.velocities, forces, 0);
    auto takeSteps = [&](int count) {
        for (int i = 0; i < count; i++)
            do
                dynamics.step(INFINITY);
            while (!dynamics.finish(forces, 0));
    };
    takeSteps(2); // what the first steps need is kept
    const long long before = numAllocations;
    takeSteps(20);
    ASSERT_EQUAL(before, (long long) numAllocations);
    ASSERT((calls > 0) == (numThreads > 1));
}

int main() {
    const Example e = makeExample();
    auto make = [](StepDensity::Update update) {
        return VRattleRun::Settings{
            0.001, 0.001 / 50, 0.002, 1e-8, update, {{StepMonitor::ConstraintForce, 1.0, 1.0, 0.0}}, false};
    };
    const VRattleRun::Settings automatic = {0.001, 0,     0,    1e-8,       StepDensity::SemiExplicit,
                                            {},    false, true, {1e4, 1e4}, 0};
    TestList tests;
    for (int numThreads : {1, 2}) {
        const std::string threads = std::to_string(numThreads) + (numThreads == 1 ? " thread" : " threads");
        tests.push_back({"SemiExplicit, " + threads,
                         [&, numThreads] { testSteps(e, make(StepDensity::SemiExplicit), numThreads); }});
        tests.push_back(
            {"Explicit, " + threads, [&, numThreads] { testSteps(e, make(StepDensity::Explicit), numThreads); }});
        tests.push_back(
            {"automatic step control, " + threads, [&, numThreads] { testSteps(e, automatic, numThreads); }});
    }
    return runTests(tests);
}
