// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT
//
// Steps of VRattleRun alone, without forces, a Context or a platform: OpenMM prepares its own constraint solver for
// every Context of the platforms Reference and CPU, which takes minutes for 200,000 coupled bonds. benchmarks/scaling.py
// writes the problem and reads the JSON line.
//
//     solver PROBLEM STEP STEPS REPEATS Explicit|SemiExplicit THREADS

#include "openmm/internal/ThreadPool.h"
#include "run/VRattleRun.h"
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <malloc.h>
#include <stdexcept>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

template <class T> vector<T> read(std::ifstream& file, size_t count) {
    vector<T> values(count);
    if (!file.read(reinterpret_cast<char*>(values.data()), (std::streamsize) (count * sizeof(T))))
        throw std::runtime_error("the problem ends too early");
    return values;
}

vector<Vec3> vectorsOf(const vector<double>& x) {
    vector<Vec3> result;
    for (size_t i = 0; i < x.size(); i += 3)
        result.emplace_back(x[i], x[i + 1], x[i + 2]);
    return result;
}

double seconds() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Memory in use, of the C library's allocator.
double kilobytes() {
    const struct mallinfo2 info = mallinfo2();
    return (double) (info.uordblks + info.hblkhd) / 1000;
}

} // namespace

int main(int argc, char** argv) {
    if (argc != 7)
        return 2;
    // Numbers of particles and constraints, masses, pairs, lengths, positions, velocities.
    std::ifstream file(argv[1], std::ios::binary);
    const vector<long long> counts = read<long long>(file, 2);
    const vector<double> masses = read<double>(file, counts[0]);
    const vector<int> pairs = read<int>(file, 2 * counts[1]);
    const vector<double> lengths = read<double>(file, counts[1]);
    const vector<Vec3> positions = vectorsOf(read<double>(file, 3 * counts[0]));
    const vector<Vec3> velocities = vectorsOf(read<double>(file, 3 * counts[0]));
    vector<DistanceConstraint> constraints;
    for (long long k = 0; k < counts[1]; k++)
        constraints.push_back({pairs[2 * k], pairs[2 * k + 1], lengths[k]});
    const double stepSize = std::stod(argv[2]);
    const int steps = std::stoi(argv[3]), repeats = std::stoi(argv[4]);
    const auto update = std::string(argv[5]) == "Explicit" ? StepDensity::Explicit : StepDensity::SemiExplicit;

    const double before = kilobytes();
    const double begin = seconds();
    VRattleRun dynamics(masses, constraints);
    const double constructed = seconds();
    OpenMM::ThreadPool threads(std::stoi(argv[6]));
    dynamics.setParallel(
        [&](const std::function<void(int)>& task) {
            threads.execute([&task](OpenMM::ThreadPool&, int thread) {
                if (thread > 0)
                    task(thread);
            });
            task(0);
            threads.waitForThreads();
        },
        threads.getNumThreads());
    VRattleRun::Settings settings = {};
    settings.stepSize = stepSize;
    settings.minimumStep = stepSize / 50;
    settings.maximumStep = 2 * stepSize;
    settings.tolerance = 1e-8;
    settings.update = update;
    settings.terms = {{StepMonitor::ConstraintForce, 1.0, 1.0, 0.0}};
    dynamics.setSettings(settings);
    vector<Vec3> forces(masses.size());
    dynamics.begin(positions, velocities, forces, 0);
    const double begun = seconds();
    auto takeSteps = [&](int count) {
        for (int i = 0; i < count; i++)
            do
                dynamics.step(std::numeric_limits<double>::infinity());
            while (!dynamics.finish(forces, 0));
    };
    takeSteps(2 + ThreadChoice::TRIAL_LENGTH); // until the number of threads has been chosen
    const long long iterationsBefore = dynamics.getNumIterations();
    double best = std::numeric_limits<double>::infinity();
    for (int repeat = 0; repeat < repeats; repeat++) {
        const double start = seconds();
        takeSteps(steps);
        best = std::min(best, (seconds() - start) / steps);
    }
    double error = 0;
    for (const DistanceConstraint& c : constraints) {
        const Vec3 r = dynamics.getPositions()[c.particle1] - dynamics.getPositions()[c.particle2];
        error = std::max(error, std::fabs(std::sqrt(r.dot(r)) / c.length - 1));
    }
    std::printf("{\"constraints\": %lld, \"step_seconds\": %.9g, \"setup_seconds\": %.6g, \"start_seconds\": %.6g, "
                "\"kilobytes\": %.1f, \"iterations_per_step\": %.3f, \"error\": %.3g}\n",
                counts[1], best, constructed - begin, begun - constructed, kilobytes() - before,
                (double) (dynamics.getNumIterations() - iterationsBefore) / steps / repeats, error);
    return 0;
}
