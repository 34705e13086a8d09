// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// All that threads share, on threads in truth: the same bits as on one thread, and exceptions that reach the caller. Under
// ThreadSanitizer (make sanitize-threads) these tests also find accesses without order.

#include "Steps.h"
#include "TestSupport.h"
#include "constraints/SharedWork.h"
#include "run/VRattleRun.h"
#include <atomic>
#include <new>
#include <thread>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Threads in truth: each call starts them, and returns when all have ended. The calling thread does the share of the first, as on the
// CPU platform. An exception that a task lets out of a thread ends the program, as it does in OpenMM's pool.
std::function<void(const std::function<void(int)>&)> runAtOnce(int numThreads) {
    return [numThreads](const std::function<void(int)>& task) {
        vector<std::thread> threads;
        for (int thread = 1; thread < numThreads; thread++)
            threads.emplace_back([&task, thread] { task(thread); });
        task(0);
        for (std::thread& thread : threads)
            thread.join();
    };
}

Example makeWaters() {
    Example e;
    for (int i = 0; i < 1001; i++)
        e.addWater(Vec3(0.5 * (i % 11), 0.5 * (i / 11 % 11), 0.5 * (i / 121)));
    return e;
}

// Many clusters in no batch that one fixed particle holds together, by expressions.
Example makeTethered() {
    Example e;
    const int anchor = e.add(0, Vec3());
    for (int i = 0; i < 500; i++) {
        const Vec3 place = e.randomVector(3);
        const int a = e.add(12, place), b = e.add(14, place + Vec3(0.15, 0, 0)),
                  c = e.add(16, place + Vec3(0.15, 0.1, 0)), d = e.add(1, place + Vec3(0, 0.12, 0));
        for (const auto& pair : {std::make_pair(a, b), {b, c}, {c, d}, {d, a}})
            e.join(pair.first, pair.second);
        e.expressions.push_back({"(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-r2", {a, anchor}, {{"r2", place.dot(place)}}});
    }
    return e;
}

StepSettings makeSettings(StepDensity::Update update, StepMonitor::Kind kind) {
    return {0.002, 0.002 / 50, 0.004, 1e-10, update, {{kind, 1.0, 1.0, 0.0}}, false};
}

struct Outcome {
    vector<Vec3> positions, velocities;
    vector<double> multipliers;
    double density;
    bool operator==(const Outcome& other) const {
        return positions == other.positions && velocities == other.velocities && multipliers == other.multipliers &&
               density == other.density;
    }
};

// All that a run does: a projection, a start, steps (so many first), time turned around, and changed velocities.
Outcome run(const Example& e, const StepSettings& settings, int steps, const VRattleRun::Parallel& parallel,
            int numThreads) {
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    dynamics.setParallel(parallel, numThreads);
    dynamics.setSettings(settings);
    vector<Vec3> positions = e.positions;
    for (size_t i = 0; i < positions.size(); i++)
        if (e.masses[i] > 0)
            positions[i] += Vec3(1e-4 * std::sin(i), 1e-4 * std::cos(3 * i), 0);
    ASSERT(dynamics.projectPositions(positions, dynamics.getParameters()));
    dynamics.begin(positions, e.velocities, forcesAt(positions), 0);
    takeSteps(dynamics, steps);
    dynamics.reverse();
    takeSteps(dynamics, 2);
    vector<Vec3> velocities = dynamics.getVelocities();
    for (size_t i = 0; i < velocities.size(); i++)
        if (e.masses[i] > 0)
            velocities[i] += Vec3(0.1 * std::sin(i), 0, 0);
    dynamics.changeVelocities(velocities);
    takeSteps(dynamics, 2);
    ASSERT(dynamics.getDensity() != 1);
    return {dynamics.getPositions(), dynamics.getVelocities(), dynamics.getMultipliers(), dynamics.getDensity()};
}

// Whatever the number of threads and whichever is first.
void testSameBits(const Example& e, const vector<StepSettings>& all, int steps, bool isCut) {
    ASSERT_EQUAL(isCut, !ConstraintSystem(e.masses, e.distances, e.expressions).getPieces().empty());
    for (const StepSettings& settings : all) {
        const Outcome expected = run(e, settings, steps, {}, 1);
        ASSERT(run(e, settings, steps, runAtOnce(3), 3) == expected);
        int calls = 0;
        ASSERT(run(e, settings, steps, runInReverse(8, calls), 8) == expected);
        ASSERT(calls > 0);
    }
}

// A share that cannot be done ends as its exception on the caller, when all others have ended, whichever thread it was on.
void testExceptions() {
    const Example e = makeWaters();
    const ConstraintSystem system(e.masses, e.distances);
    const int numBlocks = (int) system.getBlocks().size() - 1;
    ASSERT(numBlocks >= 3);
    SharedWork work(system);
    work.setParallel(runAtOnce(3), 3);
    work.beginStep();
    for (int bad : {0, numBlocks - 1, -1}) {
        std::atomic<int> numRunning(0);
        bool hasThrown = false;
        try {
            work.run(
                [&](int block) {
                    numRunning++;
                    if (block == bad || bad < 0) { // -1: every block
                        numRunning--;
                        throw std::bad_alloc();
                    }
                    numRunning--;
                },
                [](const ClusterBatch&, int, int, SharedWork::Result&) {}, [](int) {},
                [](const ConstraintSystem::Part&, SharedWork::Result&) {},
                [](const ConstraintSystem::Part&, SharedWork::Result&) {});
        }
        catch (const std::bad_alloc&) {
            hasThrown = true;
            ASSERT_EQUAL(0, (int) numRunning);
        }
        ASSERT(hasThrown);
        // And the work goes on.
        std::atomic<int> numDone(0);
        work.run([&](int) { numDone++; }, [](const ClusterBatch&, int, int, SharedWork::Result&) {}, [](int) {},
                 [](const ConstraintSystem::Part&, SharedWork::Result&) {},
                 [](const ConstraintSystem::Part&, SharedWork::Result&) {});
        ASSERT_EQUAL(numBlocks, (int) numDone);
    }
}

} // namespace

int main() {
    const vector<StepSettings> some = {makeSettings(StepDensity::SemiExplicit, StepMonitor::ConstraintForce),
                                       makeSettings(StepDensity::Explicit, StepMonitor::ConstraintMultipliers)},
                               all = {some[0],
                                      some[1],
                                      makeSettings(StepDensity::Bounded, StepMonitor::ConstraintAndAppliedForce),
                                      {0.002, 0, 0, 1e-10, StepDensity::SemiExplicit, {}, false, true, {1, 1}, 0}};
    const int untilOneThread = ThreadChoice::RUN_LENGTH; // so that the last steps are on one thread
    return runTests({
        {"waters", [&] { testSameBits(makeWaters(), all, untilOneThread, false); }},
        {"clusters that share a fixed particle", [&] { testSameBits(makeTethered(), all, untilOneThread, false); }},
        {"a comb in pieces", [&] { testSameBits(makeComb(15500), some, 2, true); }},
        {"a rod in pieces", [&] { testSameBits(makeRod(3600), some, 2, true); }},
        {"exceptions in shared tasks", testExceptions},
    });
}
