// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What a run with a constraint that moves asks of the device: all that goes to it and comes from it, OpenMM's part included. This
// program has the functions of OpenCL that do it under their own names, which come before those of the driver.

#include "GpuTests.h"

#include "TestMovingParameters.h"
#include <cstddef>
#include <dlfcn.h>

using namespace OpenMMVRattle;

namespace {

struct Traffic {
    int downloads = 0, uploads = 0, launches = 0;
    size_t bytes = 0; // of both ways
};
Traffic traffic;

template <class Function> Function* findNext(const char* name) {
    static void* const driver = dlopen("libOpenCL.so.1", RTLD_LAZY | RTLD_NOLOAD);
    void* found = driver == nullptr ? nullptr : dlsym(driver, name);
    if (found == nullptr)
        throw OpenMMException(std::string("there is no ") + name);
    return reinterpret_cast<Function*>(found);
}

} // namespace

extern "C" {

typedef int ReadOrWrite(void*, void*, unsigned, size_t, size_t, void*, unsigned, const void*, void*);
typedef int Launch(void*, void*, unsigned, const size_t*, const size_t*, const size_t*, unsigned, const void*, void*);

int clEnqueueReadBuffer(void* queue, void* buffer, unsigned isBlocking, size_t offset, size_t size, void* to,
                        unsigned numEvents, const void* events, void* event) {
    static ReadOrWrite* const next = findNext<ReadOrWrite>("clEnqueueReadBuffer");
    traffic.downloads++;
    traffic.bytes += size;
    return next(queue, buffer, isBlocking, offset, size, to, numEvents, events, event);
}

int clEnqueueWriteBuffer(void* queue, void* buffer, unsigned isBlocking, size_t offset, size_t size, void* from,
                         unsigned numEvents, const void* events, void* event) {
    static ReadOrWrite* const next = findNext<ReadOrWrite>("clEnqueueWriteBuffer");
    traffic.uploads++;
    traffic.bytes += size;
    return next(queue, buffer, isBlocking, offset, size, from, numEvents, events, event);
}

int clEnqueueNDRangeKernel(void* queue, void* kernel, unsigned dimensions, const size_t* offset, const size_t* size,
                           const size_t* groupSize, unsigned numEvents, const void* events, void* event) {
    static Launch* const next = findNext<Launch>("clEnqueueNDRangeKernel");
    traffic.launches++;
    return next(queue, kernel, dimensions, offset, size, groupSize, numEvents, events, event);
}
}

namespace {

Traffic trafficOf(const std::function<void()>& task) {
    traffic = Traffic();
    task();
    return traffic;
}

// Each step that moves a constraint, one after the other: one upload more than at rest, of 16 bytes, and a launch or two. Its multiplier is
// one small download.
void testTraffic() {
    for (const auto& choice : allChoices()) {
        if (choice.first == "automatic")
            continue;
        MovingRun run(choice.second);
        run.step(1);
        const int count = 20;
        auto go = [&](bool isMoving) {
            return trafficOf([&] {
                for (int i = 0; i < count; i++) {
                    if (isMoving)
                        run.moveConstraint();
                    run.integrator.step(1);
                }
            });
        };
        go(false);
        const Traffic atRest = go(false);
        run.moveConstraint();
        run.integrator.step(1);
        const Traffic moving = go(true);
        ASSERT(run.integrator.isOnDevice());
        ASSERT_EQUAL(count, atRest.downloads); // the report at the end of step(1)
        ASSERT_EQUAL(atRest.downloads, moving.downloads);
        ASSERT_EQUAL(atRest.uploads + count, moving.uploads);
        ASSERT_EQUAL(atRest.bytes + 16 * count, moving.bytes);
        ASSERT_EQUAL(atRest.launches + (choice.first == "fixed" ? 1 : 2) * count, moving.launches);
        const Traffic multiplier = trafficOf([&] { run.integrator.getExpressionConstraintMultiplier(0); });
        ASSERT_EQUAL(1, multiplier.downloads);
        ASSERT_EQUAL(0, multiplier.uploads);
        ASSERT_EQUAL(8, multiplier.bytes);
    }
}

} // namespace

int main(int argc, char** argv) {
    return runOnPlatform({{"traffic of a constraint that moves", testTraffic}}, argc, argv);
}
