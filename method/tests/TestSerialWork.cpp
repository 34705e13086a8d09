// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// How much of a step one thread does alone. No time is measured: arrays as long as the system lie in pages that nobody may touch; the
// first touch of each page, in a task that is shared or outside of all, is noticed, counted and allowed.

#include "Examples.h"
#include "TestSupport.h"
#include "openmm/System.h"
#include "run/HostRunDevice.h"
#include "run/IntegratorRun.h"
#include <cstdlib>
#include <iostream>
#include <memory>
#include <new>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

// Sanitizers have operators of their own.
#if defined(__unix__) && !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
    #include <csignal>
    #include <sys/mman.h>
    #include <unistd.h>

namespace {

struct Area {
    char* begin;
    size_t size;
};
const size_t LARGE = 100000; // bytes
const int MAX_AREAS = 4096;
Area areas[MAX_AREAS];
int numAreas = 0;
volatile size_t numTouched = 0; // pages, since it was set to zero
size_t pageSize = 0;

void protectAll(int protection) {
    for (int k = 0; k < numAreas; k++)
        mprotect(areas[k].begin, areas[k].size, protection);
}

void allowPage(int signal, siginfo_t* info, void*) {
    char* address = static_cast<char*>(info->si_addr);
    for (int k = 0; k < numAreas; k++)
        if (address >= areas[k].begin && address < areas[k].begin + areas[k].size) {
            mprotect(areas[k].begin + (address - areas[k].begin) / pageSize * pageSize, pageSize,
                     PROT_READ | PROT_WRITE);
            numTouched = numTouched + 1;
            return;
        }
    std::signal(signal, SIG_DFL); // a fault like any other
}

} // namespace

[[gnu::noinline]] void* operator new(std::size_t size) {
    if (pageSize == 0)
        pageSize = (size_t) sysconf(_SC_PAGESIZE);
    if (size < LARGE || numAreas == MAX_AREAS) {
        void* memory = std::malloc(size);
        if (memory == nullptr)
            throw std::bad_alloc();
        return memory;
    }
    const size_t whole = (size + pageSize - 1) / pageSize * pageSize;
    void* memory = mmap(nullptr, whole, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (memory == MAP_FAILED)
        throw std::bad_alloc();
    areas[numAreas++] = {static_cast<char*>(memory), whole};
    return memory;
}

void operator delete(void* memory) noexcept {
    for (int k = 0; k < numAreas; k++)
        if (areas[k].begin == memory) {
            munmap(memory, areas[k].size);
            areas[k] = areas[--numAreas];
            return;
        }
    std::free(memory);
}

void operator delete(void* memory, std::size_t) noexcept {
    operator delete(memory);
}

namespace {

const int NUM_THREADS = 16;

/** Counts pages of large arrays: those touched outside of shared tasks, and within by all threads and by the busiest ones. */
class Watch {
public:
    size_t alone = 0, shared = 0, busiest = 0;
    bool isOn = false;
    void begin() {
        isOn = true;
        next();
    }
    void end() {
        alone += next();
        isOn = false;
        protectAll(PROT_READ | PROT_WRITE);
    }
    void run(const std::function<void(int)>& task) {
        if (!isOn) {
            for (int thread = 0; thread < NUM_THREADS; thread++)
                task(thread);
            return;
        }
        alone += next();
        size_t most = 0;
        for (int thread = 0; thread < NUM_THREADS; thread++) {
            task(thread);
            const size_t touched = next();
            shared += touched;
            most = std::max(most, touched);
        }
        busiest += most;
    }

private:
    // From here on each page counts again.
    static size_t next() {
        protectAll(PROT_NONE);
        const size_t touched = numTouched;
        numTouched = 0;
        return touched;
    }
};

Watch watch;

/** A Context of vectors, whose forces nobody counts. */
class Field : public ContextVectors {
public:
    Vectors positions, velocities, forces;
    explicit Field(const Example& e) :
            positions(e.positions), velocities(e.velocities), forces(positions.size()), places(positions) {
    }
    const Vectors& getPositions() override {
        return positions;
    }
    const Vectors& getVelocities() override {
        return velocities;
    }
    Vectors& getForces() override {
        return forces;
    }
    void writePositions(const Writer& write, bool) override {
        write(positions);
    }
    void writeVelocities(const Writer& write, bool) override {
        write(velocities);
    }
    const Vec3* getBoxVectors() override {
        return box;
    }
    double getTime() override {
        return time;
    }
    void setTime(double t) override {
        time = t;
    }
    long long getStepCount() override {
        return count;
    }
    void setStepCount(long long n) override {
        count = n;
    }
    const std::map<std::string, double>& getParameters() override {
        return parameters;
    }
    bool isSharedByIntegrators() override {
        return false;
    }
    bool updateState() override {
        return false;
    }
    void requirePositions() override {
    }
    void invalidateForces() override {
    }
    void computeVirtualSites() override {
    }
    double computeForces(int, int) override {
        const bool isOn = watch.isOn;
        if (isOn)
            watch.end();
        for (size_t i = 0; i < positions.size(); i++)
            forces[i] =
                (places[i] - positions[i]) * 500 + Vec3(30 * std::sin(20 * positions[i][1]), 0, (double) (i % 7));
        if (isOn)
            watch.begin();
        return 1;
    }

private:
    const Vectors places;
    const Vec3 box[3] = {Vec3(2, 0, 0), Vec3(0, 2, 0), Vec3(0, 0, 2)};
    double time = 0;
    long long count = 0;
    std::map<std::string, double> parameters;
};

/**
 * Two steps in the middle of a run.
 *
 * @param maxAlone    how often one thread may pass over the vectors of all atoms, by itself, in a step
 */
void testSteps(const std::string& name, const Example& e, const IntegratorSettings& settings, double maxAlone) {
    OpenMM::System system;
    for (double mass : e.masses)
        system.addParticle(mass);
    for (const DistanceConstraint& c : e.distances)
        system.addConstraint(c.particle1, c.particle2, c.length);
    auto field = std::make_unique<Field>(e);
    const std::unique_ptr<RunDevice> device = makeHostRunDevice(
        std::move(field), system, settings, [](const std::function<void(int)>& task) { watch.run(task); }, NUM_THREADS);
    IntegratorRun run(*device, settings, system.getNumParticles(), 0);
    run.step(4);
    const int numSteps = 2;
    watch = Watch();
    watch.begin();
    run.step(numSteps);
    watch.end();
    const double pass = (double) (numSteps * e.masses.size() * sizeof(Vec3)) / (double) pageSize;
    const double alone = (double) watch.alone / pass, shared = (double) watch.shared / pass;
    const double busiest = (double) watch.busiest / pass;
    if (!(alone <= maxAlone) || !(shared > 5) || !(busiest <= 1.5 * shared / NUM_THREADS)) {
        std::cout << name << ": passes over the atoms on one thread " << alone << ", shared " << shared
                  << ", of which the busiest of " << NUM_THREADS << " threads did " << busiest << std::endl;
        ASSERT(false);
    }
}

Example makeWaters() {
    Example e;
    for (int i = 0; i < 10000; i++)
        e.addWater(Vec3(0.3 * (i % 30), 0.3 * (i / 30 % 30), 0.3 * (i / 900)));
    return e;
}

Example makeArgon() {
    Example e;
    for (int i = 0; i < 30000; i++)
        e.add(40, Vec3(0.3 * (i % 40), 0.3 * (i / 40 % 40), 0.3 * (i / 1600)));
    return e;
}

// Cut into pieces.
Example makeLongChain() {
    Example e;
    int last = e.add(14, Vec3());
    for (int i = 1; i < 30000; i++) {
        const int next = e.add(14, Vec3(0.12 * i, 0.05 * (i % 2), 0));
        e.join(last, next);
        last = next;
    }
    return e;
}

// Clusters that are in no batch.
Example makeShortChains() {
    Example e;
    for (int chain = 0; chain < 1000; chain++) {
        int last = e.add(14, Vec3(0, chain, 0));
        for (int i = 1; i < 30; i++) {
            const int next = e.add(14, Vec3(0.12 * i, chain + 0.05 * (i % 2), 0));
            e.join(last, next);
            last = next;
        }
    }
    return e;
}

void testMonitors(const std::string& name, const Example& e, const vector<StepMonitor::Kind>& kinds,
                  double maxAlone = 1) {
    for (StepMonitor::Kind kind : kinds)
        for (StepDensity::Update update : {StepDensity::SemiExplicit, StepDensity::Explicit, StepDensity::Bounded}) {
            IntegratorSettings settings(0.001);
            settings.update = update;
            settings.isDefaultMonitor = false;
            settings.terms = {{kind, 1, 1, 0}};
            testSteps(name + ", monitor " + std::to_string(kind) + ", update " + std::to_string(update), e, settings,
                      maxAlone);
        }
}

void testAutomatic(const std::string& name, const Example& e, double maxAlone = 1) {
    IntegratorSettings settings(0.001);
    settings.isAutomatic = true;
    settings.automaticReferences[0] = settings.automaticReferences[1] = 1e5;
    testSteps(name + ", automatic", e, settings, maxAlone);
}

void testLangevin(const std::string& name, const Example& e, double maxAlone = 1) {
    LangevinSettings langevin;
    langevin.temperature = 300;
    langevin.friction = 1;
    langevin.randomSeed = 1;
    testSteps(name + ", Langevin", e, IntegratorSettings(0.001, langevin), maxAlone);
}

} // namespace

int main() {
    if (sysconf(_SC_PAGESIZE) > 4096) {
        std::cout << "not on this system: its pages are too large to tell what is touched" << std::endl;
        return 0;
    }
    struct sigaction action = {};
    action.sa_sigaction = allowPage;
    action.sa_flags = SA_SIGINFO;
    for (int signal : {SIGSEGV, SIGBUS})
        sigaction(signal, &action, nullptr);
    const vector<StepMonitor::Kind> some = {StepMonitor::ConstraintMultipliers, StepMonitor::ConstraintAndAppliedForce};
    vector<StepMonitor::Kind> all, ofForces = {StepMonitor::AppliedForce, StepMonitor::ForcePNorm};
    for (int kind = StepMonitor::ConstraintMultipliers; kind <= StepMonitor::ForceGroupEnergy; kind++)
        all.push_back((StepMonitor::Kind) kind);
    const Example waters = makeWaters(), argon = makeArgon(), chain = makeLongChain(), chains = makeShortChains();
    // The joints between the pieces are one thread's; each of them is on pages of its own, which count as if all were used.
    const double forJoints = 4;
    return runTests({
        {"waters", [&] { testMonitors("waters", waters, all); }},
        {"free particles", [&] { testMonitors("free particles", argon, ofForces); }},
        {"a long chain", [&] { testMonitors("a long chain", chain, some, forJoints); }},
        {"short chains", [&] { testMonitors("short chains", chains, some); }},
        {"waters, automatic", [&] { testAutomatic("waters", waters); }},
        {"a long chain, automatic", [&] { testAutomatic("a long chain", chain, forJoints); }},
        {"waters, Langevin", [&] { testLangevin("waters", waters); }},
        {"a long chain, Langevin", [&] { testLangevin("a long chain", chain, forJoints); }},
    });
}

#else

int main() {
    std::cout << "not with this compiler: it has operators of its own" << std::endl;
    return 0;
}

#endif
