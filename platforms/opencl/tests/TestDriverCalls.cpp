// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What a run asks of the device, OpenMM's part included: how often the host waits, what goes to and fro, and how many launches there are.
// The functions of OpenCL that do it are defined here once more, where the loader finds them before those of the driver; they count and
// go on to those.

#include "../../common/tests/Dumbbells.h"
#include "../../common/tests/GpuTests.h"

#include "TestMovingParameters.h"
#include "openmm/CMMotionRemover.h"
#include "openmm/Context.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/VariableVerletIntegrator.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"
#include <cstddef>
#include <cstdint>
#include <dlfcn.h>
#include <functional>

namespace {

struct Calls {
    int waits = 0, downloads = 0, uploads = 0, launches = 0;
    size_t bytes = 0; // of both ways
};
Calls calls;

template <class Function> Function* findInDriver(const char* name) {
    static void* const driver = dlopen("libOpenCL.so.1", RTLD_LAZY | RTLD_LOCAL);
    void* found = driver == nullptr ? nullptr : dlsym(driver, name);
    if (found == nullptr)
        throw OpenMM::OpenMMException(std::string("there is no ") + name);
    return reinterpret_cast<Function*>(found);
}

} // namespace

// With plain types in place of those of OpenCL's headers.
extern "C" {

int32_t clEnqueueReadBuffer(void* queue, void* buffer, uint32_t isBlocking, size_t offset, size_t size, void* to,
                            uint32_t numEvents, const void* events, void* event) {
    static auto* const original = findInDriver<decltype(clEnqueueReadBuffer)>("clEnqueueReadBuffer");
    calls.waits += isBlocking != 0;
    calls.downloads++;
    calls.bytes += size;
    return original(queue, buffer, isBlocking, offset, size, to, numEvents, events, event);
}

int32_t clEnqueueWriteBuffer(void* queue, void* buffer, uint32_t isBlocking, size_t offset, size_t size,
                             const void* from, uint32_t numEvents, const void* events, void* event) {
    static auto* const original = findInDriver<decltype(clEnqueueWriteBuffer)>("clEnqueueWriteBuffer");
    calls.waits += isBlocking != 0;
    calls.uploads++;
    calls.bytes += size;
    return original(queue, buffer, isBlocking, offset, size, from, numEvents, events, event);
}

void* clEnqueueMapBuffer(void* queue, void* buffer, uint32_t isBlocking, uint64_t flags, size_t offset, size_t size,
                         uint32_t numEvents, const void* events, void* event, int32_t* error) {
    static auto* const original = findInDriver<decltype(clEnqueueMapBuffer)>("clEnqueueMapBuffer");
    calls.waits += isBlocking != 0;
    return original(queue, buffer, isBlocking, flags, offset, size, numEvents, events, event, error);
}

int32_t clFinish(void* queue) {
    static auto* const original = findInDriver<decltype(clFinish)>("clFinish");
    calls.waits++;
    return original(queue);
}

int32_t clWaitForEvents(uint32_t numEvents, const void* events) {
    static auto* const original = findInDriver<decltype(clWaitForEvents)>("clWaitForEvents");
    calls.waits++;
    return original(numEvents, events);
}

int32_t clEnqueueNDRangeKernel(void* queue, void* kernel, uint32_t dimension, const size_t* offset, const size_t* size,
                               const size_t* groupSize, uint32_t numEvents, const void* events, void* event) {
    static auto* const original = findInDriver<decltype(clEnqueueNDRangeKernel)>("clEnqueueNDRangeKernel");
    calls.launches++;
    return original(queue, kernel, dimension, offset, size, groupSize, numEvents, events, event);
}
}

using namespace OpenMMVRattle;
using namespace OpenMM;
using std::vector;

namespace {

Calls callsOf(const std::function<void()>& task) {
    calls = Calls();
    task();
    return calls;
}

typedef VariableStepRattleIntegrator Integrator_;

int countWaits(Integrator& integrator, int steps) {
    return callsOf([&] { integrator.step(steps); }).waits;
}

// What Forces do to velocities in each step costs launches, and no look at the device but the one at the end.
void testThermostats() {
    Dumbbells t(20);
    t.addThermostat(300, 10);
    t.system.addForce(new CMMotionRemover(1));
    for (const bool isAutomatic : {false, true}) {
        Integrator_ integrator(0.001);
        integrator.addMonitor(Integrator_::ArcLength); // to which the frame of reference matters
        if (isAutomatic)
            integrator.useAutomaticStepControl(10);
        Context context(t.system, integrator, getTestPlatform());
        t.begin(context);
        integrator.step(5);
        ASSERT_EQUAL(1, countWaits(integrator, 1));
        const int launchesOfTen = callsOf([&] { integrator.step(10); }).launches;
        const Calls ofHundred = callsOf([&] { integrator.step(100); });
        ASSERT_EQUAL(1, ofHundred.waits);
        ASSERT(integrator.isOnDevice());
        // In each step the same, but for the numbers of a thermostat that are drawn for many steps at once.
        ASSERT(ofHundred.launches <= 10 * launchesOfTen + 10);
        ASSERT_EQUAL(116, context.getStepCount());
        // OpenMM's 250 steps from one order of the atoms to the next make no difference where there is no cutoff.
        integrator.step(150);
        ASSERT_EQUAL(1, countWaits(integrator, 100));
    }
    // The same with substeps where they are needed, which one looks for after 64 steps at the latest.
    VariableStepRattleLangevinIntegrator langevin(300, 1, 0.002);
    Context context(t.system, langevin, getTestPlatform());
    t.begin(context);
    langevin.step(5);
    ASSERT(countWaits(langevin, 100) <= 2);
    ASSERT_EQUAL(0, langevin.getNumSubstepped());
}

// OpenMM's own integrator of variable steps waits in each of them; if it no longer does, docs/gpu.md should say so.
void testOpenMM() {
    const Dumbbells t(20);
    VariableVerletIntegrator integrator(1e-3);
    Context context(t.system, integrator, getTestPlatform());
    t.begin(context);
    integrator.step(5);
    ASSERT_EQUAL(100, countWaits(integrator, 100));
}

// A barostat makes the host wait where it tries another box, and nowhere else.
void testBarostat() {
    Dumbbells t(20);
    t.system.setDefaultPeriodicBoxVectors(Vec3(4, 0, 0), Vec3(0, 4, 0), Vec3(0, 0, 4));
    auto* bonds = new HarmonicBondForce(); // without a cutoff, for which OpenMM waits too
    bonds->setUsesPeriodicBoundaryConditions(true);
    bonds->addBond(0, 2, 0.5, 100);
    t.system.addForce(bonds);
    auto* barostat = new MonteCarloBarostat(1, 300, 25);
    barostat->setRandomNumberSeed(2);
    t.system.addForce(barostat);
    Integrator_ integrator(0.001);
    Context context(t.system, integrator, getTestPlatform());
    t.begin(context);
    integrator.step(5);
    ASSERT_EQUAL(1, countWaits(integrator, 19));
    const int waits = countWaits(integrator, 1);
    ASSERT(waits > 1);
    ASSERT_EQUAL(1, countWaits(integrator, 24));
    barostat->setFrequency(10); // which it has reached
    ASSERT(countWaits(integrator, 1) > 1);
    ASSERT_EQUAL(1, countWaits(integrator, 9));
    ASSERT(countWaits(integrator, 100) <= 10 * (waits + 10) + 1);
    barostat->setFrequency(0);
    ASSERT_EQUAL(1, countWaits(integrator, 30));
}

// Each step that moves a constraint, one after the other: one upload more than at rest, of 16 bytes, and a launch or two. Its multiplier is
// one small download.
void testTraffic() {
    for (const auto& choice : allChoices()) {
        MovingRun run(choice.second);
        run.step(1);
        const int count = 20;
        auto go = [&](bool isMoving) {
            return callsOf([&] {
                for (int i = 0; i < count; i++) {
                    if (isMoving)
                        run.moveConstraint();
                    run.integrator.step(1);
                }
            });
        };
        go(false);
        const Calls atRest = go(false);
        run.moveConstraint();
        run.integrator.step(1);
        const Calls moving = go(true);
        ASSERT(run.integrator.isOnDevice());
        ASSERT_EQUAL(count, atRest.downloads); // the report at the end of step(1)
        ASSERT_EQUAL(atRest.downloads, moving.downloads);
        ASSERT_EQUAL(atRest.uploads + count, moving.uploads);
        ASSERT_EQUAL(atRest.bytes + 16 * count, moving.bytes);
        ASSERT_EQUAL(atRest.launches + (choice.first == "fixed" ? 1 : 2) * count, moving.launches);
        const Calls multiplier = callsOf([&] { run.integrator.getExpressionConstraintMultiplier(0); });
        ASSERT_EQUAL(1, multiplier.downloads);
        ASSERT_EQUAL(0, multiplier.uploads);
        ASSERT_EQUAL(8, multiplier.bytes);
    }
    // In Langevin dynamics too.
    System system;
    system.addParticle(20);
    VariableStepRattleLangevinIntegrator integrator(300, 1, 0.002);
    integrator.addConstraint("z1-height", {0}, {{"height", 0}});
    Context context(system, integrator, getTestPlatform());
    context.setPositions({Vec3()});
    double height = 0;
    auto step = [&](int steps, double rate) {
        for (int i = 0; i < steps; i++) {
            height += rate;
            if (rate != 0)
                integrator.setExpressionParameterValue(0, "height", height);
            integrator.step(1);
        }
    };
    step(5, 0);
    const Calls atRest = callsOf([&] { step(20, 0); });
    step(1, 1e-4);
    const Calls moving = callsOf([&] { step(20, 1e-4); });
    ASSERT(integrator.isOnDevice());
    ASSERT_EQUAL(0, integrator.getNumSubstepped());
    ASSERT_EQUAL(atRest.downloads, moving.downloads);
    ASSERT_EQUAL(atRest.waits + 20,
                 moving.waits); // the upload waits for what it takes from the host, as all of OpenMM's
    ASSERT_EQUAL(atRest.uploads + 20, moving.uploads);
    ASSERT_EQUAL(atRest.bytes + 16 * 20, moving.bytes);
    ASSERT_EQUAL(atRest.launches + 20, moving.launches);
}

// Automatic step control asks for no launch, no look and no byte more than the update Explicit.
void testAutomaticControl() {
    Dumbbells t(20);
    Calls found[2];
    for (const bool isAutomatic : {false, true}) {
        Integrator_ integrator(0.001);
        integrator.clearMonitors();
        integrator.addMonitor(Integrator_::ConstraintAndAppliedForce);
        integrator.setUpdateMethod(Integrator_::Explicit);
        if (isAutomatic)
            integrator.useAutomaticStepControl(10);
        Context context(t.system, integrator, getTestPlatform());
        t.begin(context);
        integrator.step(20);
        found[isAutomatic] = callsOf([&] { integrator.step(100); });
        ASSERT(integrator.isOnDevice());
    }
    ASSERT_EQUAL(found[0].launches, found[1].launches);
    ASSERT_EQUAL(found[0].waits, found[1].waits);
    ASSERT_EQUAL(found[0].uploads, found[1].uploads);
    ASSERT_EQUAL(found[0].downloads, found[1].downloads);
}

// What a reporter asks for after a step brings from the device what it returns, once, and nothing of the particles.
void testGetters() {
    const int count = 20;
    const Dumbbells t(count);
    const auto require = [](const std::string& name, int downloads, size_t bytes, const std::function<void()>& get) {
        const Calls found = callsOf(get);
        if (found.downloads != downloads || found.bytes > bytes || found.uploads != 0)
            throw OpenMMException(name + " takes " + std::to_string(found.downloads) + " downloads and " +
                                  std::to_string(found.bytes) + " bytes");
    };
    for (const bool isAutomatic : {false, true}) {
        Integrator_ integrator(0.001);
        if (isAutomatic)
            integrator.useAutomaticStepControl(3);
        Context context(t.system, integrator, getTestPlatform());
        t.begin(context);
        integrator.step(5);
        for (int i = 0; i < 2; i++) { // what has been asked for once may be known
            integrator.step(5);
            ASSERT(integrator.isOnDevice());
            require("getMultipliers()", 1, 8 * count, [&] { integrator.getMultipliers(); });
            require("getMonitorValue()", 0, 0, [&] { integrator.getMonitorValue(); });
            require("getReferenceMonitorValue()", 0, 0, [&] { integrator.getReferenceMonitorValue(); });
            require("getStepSize()", 0, 0, [&] { integrator.getStepSize(); });
            require("getStepDensity()", 0, 0, [&] { integrator.getStepDensity(); });
            require("getTime()", 0, 0, [&] { context.getTime(); });
            require("getStepCount()", 0, 0, [&] { context.getStepCount(); });
            require("getNumForceEvaluations()", 0, 0, [&] { integrator.getNumForceEvaluations(); });
            require("getNumSolverIterations()", 1, 1024, [&] { integrator.getNumSolverIterations(); });
            require("getNumRescues()", 0, 0, [&] { integrator.getNumRescues(); });
            require("getNumShortSteps()", 0, 0, [&] { integrator.getNumShortSteps(); });
        }
    }
    VariableStepRattleLangevinIntegrator langevin(300, 1, 0.002);
    Context context(t.system, langevin, getTestPlatform());
    t.begin(context);
    langevin.step(10);
    ASSERT(langevin.isOnDevice());
    require("getMultipliers()", 1, 8 * count, [&] { langevin.getMultipliers(); });
    require("getReferenceMonitorValue()", 0, 0, [&] { langevin.getReferenceMonitorValue(); });
    require("getNumForceEvaluations()", 0, 0, [&] { langevin.getNumForceEvaluations(); });
    require("getNumSolverIterations()", 1, 1024, [&] { langevin.getNumSolverIterations(); });
    // Two numbers for the energies, the kinetic one that of the half step, after which all is as it was.
    const vector<double> multipliers = langevin.getMultipliers();
    const State before = context.getState(State::Positions | State::Velocities);
    require("getState(Energy)", 2, 24, [&] { context.getState(State::Energy); });
    const State after = context.getState(State::Positions | State::Velocities);
    ASSERT(before.getPositions() == after.getPositions() && before.getVelocities() == after.getVelocities());
    ASSERT(multipliers == langevin.getMultipliers());
    require("getNumSubstepped()", 0, 0, [&] { langevin.getNumSubstepped(); });
    require("getLargestSubsteps()", 0, 0, [&] { langevin.getLargestSubsteps(); });
}

} // namespace

int main(int argc, char** argv) {
    return runOnPlatform({{"waits with thermostats", testThermostats},
                          {"waits of OpenMM's own", testOpenMM},
                          {"waits with a barostat", testBarostat},
                          {"traffic of a constraint that moves", testTraffic},
                          {"automatic step control", testAutomaticControl},
                          {"what reporters ask for", testGetters}},
                         argc, argv);
}
