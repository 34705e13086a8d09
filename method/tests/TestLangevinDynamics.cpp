// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// LangevinDynamics with forces and noise of the tests' own: it retraces steps, needs one projection alone, and tries a step again with
// the same noise.

#include "Examples.h"
#include "TestSupport.h"
#include "constraints/StepFailure.h"
#include "step/LangevinDynamics.h"
#include "step/RandomNumbers.h"
#include <Eigen/Dense>
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using OpenMM::Vec3;
using std::vector;

namespace {

typedef vector<Vec3> Vectors;

const vector<Vec3> SHAPE = {Vec3(), Vec3(0.1, 0, 0.01), Vec3(-0.03, 0.11, 0), Vec3(-0.02, -0.05, 0.09)};

// Molecules of several shapes that attract and repel each other softly, so that steps of all sizes have solutions.
Example makeExample() {
    Example e;
    e.addWater(Vec3());
    e.addCluster({12, 1, 1, 1}, {{0, 1}, {2, 0}, {0, 3}}, SHAPE);
    e.addCluster({12, 14, 16, 12}, {{0, 1}, {1, 2}, {2, 3}, {3, 0}}, SHAPE);
    e.add(40, Vec3(0.1, 0.2, 0.3));
    return e;
}

Vectors forceAt(const Vectors& positions) {
    Vectors forces(positions.size());
    for (size_t i = 0; i < positions.size(); i++) {
        forces[i] = positions[i] * (-30.0 - (double) (i % 3));
        for (size_t j = 0; j < positions.size(); j++) {
            const Vec3 r = positions[i] - positions[j];
            if (i != j)
                forces[i] += r * (400 * std::exp(-r.dot(r) / 0.02));
        }
    }
    return forces;
}

LangevinDynamics::Settings makeSettings() {
    LangevinDynamics::Settings settings;
    settings.langevin.emplace();
    settings.stepSize = 0.004;
    settings.tolerance = 1e-12;
    settings.langevin->temperature = 300;
    settings.langevin->friction = 5;
    settings.langevin->randomSeed = 17;
    return settings;
}

LangevinDynamics makeDynamics(const Example& e) {
    return LangevinDynamics(e.masses, e.distances, e.expressions);
}

int takeStep(LangevinDynamics& dynamics) {
    int passes = 0;
    bool isComplete;
    do {
        dynamics.step(INFINITY);
        passes++;
        Vectors forces = forceAt(dynamics.getNextPositions());
        isComplete = dynamics.finish(forces, 0);
    } while (!isComplete);
    return passes;
}

Vectors drawNoise(Example& e) {
    Vectors noise(e.masses.size());
    std::normal_distribution<double> normal;
    for (Vec3& each : noise)
        for (int i = 0; i < 3; i++)
            each[i] = normal(e.generator);
    return noise;
}

double largestDistance(const Vectors& a, const Vectors& b) {
    double largest = 0;
    for (size_t i = 0; i < a.size(); i++)
        largest = std::max(largest, std::sqrt((a[i] - b[i]).dot(a[i] - b[i])));
    return largest;
}

// Drifts and projections with dense matrices and Newton's iteration.
struct DenseSolver {
    const Example& e;
    Eigen::MatrixXd jacobianAt(const Vectors& q) const {
        Eigen::MatrixXd rows = Eigen::MatrixXd::Zero(e.distances.size(), 3 * q.size());
        for (size_t k = 0; k < e.distances.size(); k++) {
            const DistanceConstraint& c = e.distances[k];
            for (int i = 0; i < 3; i++) {
                const double r = (q[c.particle1][i] - q[c.particle2][i]) / (c.length * c.length);
                rows(k, 3 * c.particle1 + i) = r;
                rows(k, 3 * c.particle2 + i) = -r;
            }
        }
        return rows;
    }
    Eigen::MatrixXd overMass(Eigen::MatrixXd rows) const {
        for (int i = 0; i < rows.cols(); i++)
            rows.col(i) /= e.masses[i / 3];
        return rows;
    }
    void add(Vectors& v, const Eigen::VectorXd& change) const {
        for (size_t i = 0; i < v.size(); i++)
            v[i] += Vec3(change[3 * i], change[3 * i + 1], change[3 * i + 2]);
    }
    void project(const Vectors& q, Vectors& v) const {
        const Eigen::MatrixXd rows = jacobianAt(q), transposed = overMass(rows).transpose();
        const Eigen::Map<const Eigen::VectorXd> flat(&v[0][0], 3 * v.size());
        add(v, -transposed * (rows * transposed).lu().solve(rows * flat));
    }
    void drift(Vectors& q, Vectors& v, double size) const {
        const Eigen::MatrixXd transposed = overMass(jacobianAt(q)).transpose();
        Eigen::VectorXd g(e.distances.size());
        for (int iteration = 0; iteration < 50; iteration++) {
            Vectors end = q;
            for (size_t i = 0; i < q.size(); i++)
                end[i] += v[i] * size;
            for (size_t k = 0; k < e.distances.size(); k++) {
                const DistanceConstraint& c = e.distances[k];
                const Vec3 r = end[c.particle1] - end[c.particle2];
                g[k] = 0.5 * (r.dot(r) / (c.length * c.length) - 1);
            }
            add(v, -transposed * (jacobianAt(end) * transposed * size).lu().solve(g));
            if (g.cwiseAbs().maxCoeff() < 1e-14 || iteration == 49) {
                for (size_t i = 0; i < q.size(); i++)
                    q[i] += v[i] * size;
                return;
            }
        }
    }
};

// The step written down again, with projections where they are not needed.
struct PlainStep {
    Vectors q, v, before, after; // after it, and the velocities before and after the noise
    PlainStep(const Example& e, const LangevinDynamics::Settings& settings, const Vectors& start,
              const Vectors& velocities, const Vectors& noise, int k, bool projectsAlways) : q(start), v(velocities) {
        const DenseSolver solver{e};
        const int substeps = LangevinSettings::getSubsteps(k);
        const double d = settings.stepSize / substeps, damping = settings.langevin->friction * settings.stepSize;
        const double a = std::exp(-damping);
        auto project = [&](bool isNeeded) {
            if (isNeeded || projectsAlways)
                solver.project(q, v);
        };
        auto drift = [&](double size) { solver.drift(q, v, size); };
        auto kick = [&] {
            const Vectors forces = forceAt(q);
            for (size_t i = 0; i < q.size(); i++)
                v[i] += forces[i] * (0.5 * d / e.masses[i]);
        };
        for (int i = 0; i < substeps; i++) {
            kick();
            project(false);
            if (2 * i + 1 == substeps) {
                drift(0.5 * d);
                project(false);
                before = v;
                for (size_t p = 0; p < q.size(); p++)
                    v[p] = v[p] * a +
                           noise[p] * std::sqrt(BOLTZMANN * settings.langevin->temperature * (1 - a * a) / e.masses[p]);
                after = v;
                project(false);
                drift(0.5 * d);
            }
            else
                drift(d);
            kick();
            project(true);
        }
    }
};

// U_ref with which the first step takes this k.
double referenceFor(LangevinDynamics& dynamics, int k) {
    const double u = dynamics.getMonitorValues()[0], asked = k == 0 ? 0.5 : 0.9 * (1 << k);
    return u / std::pow(2.2 * asked, 1.5);
}

void begin(LangevinDynamics& dynamics, const Example& e) {
    Vectors positions = e.positions;
    dynamics.projectPositions(positions, dynamics.getParameters());
    dynamics.begin(positions, e.velocities, forceAt(positions), 0);
}

void testRetracesSteps() {
    for (int k : {0, 1, 3}) {
        Example e = makeExample();
        LangevinDynamics dynamics = makeDynamics(e);
        LangevinDynamics::Settings settings = makeSettings();
        settings.langevin->maxDoublings = k;
        dynamics.setSettings(settings);
        begin(dynamics, e);
        settings.langevin->reference =
            1e-6 * dynamics.getMonitorValues()[0]; // so that k is k_max, forwards and backwards
        dynamics.setSettings(settings);
        const Vectors start = dynamics.getPositions(), velocities = dynamics.getVelocities();
        const Vectors noise = drawNoise(e);
        dynamics.setNoise(noise);
        ASSERT_EQUAL(LangevinSettings::getSubsteps(k), takeStep(dynamics));
        const PlainStep plain(e, settings, start, velocities, noise, k, false);
        ASSERT(largestDistance(plain.q, dynamics.getPositions()) < 1e-13);
        ASSERT(largestDistance(plain.v, dynamics.getVelocities()) < 1e-10);
        ASSERT(largestDistance(start, dynamics.getPositions()) > 1e-3);

        const double damping = settings.langevin->friction * settings.stepSize;
        const double scale = std::sqrt(BOLTZMANN * settings.langevin->temperature * -std::expm1(-2 * damping));
        Vectors back(noise.size());
        for (size_t i = 0; i < back.size(); i++)
            back[i] = (plain.after[i] * std::exp(-damping) - plain.before[i]) * (std::sqrt(e.masses[i]) / scale);
        dynamics.setNoise(back);
        dynamics.reverse();
        takeStep(dynamics);
        ASSERT(largestDistance(start, dynamics.getPositions()) < 1e-12);
        dynamics.reverse();
        ASSERT(largestDistance(velocities, dynamics.getVelocities()) < 1e-9);
    }
}

void testNeedsOneProjection() {
    for (int k : {0, 1, 3}) {
        Example e = makeExample();
        LangevinDynamics dynamics = makeDynamics(e);
        LangevinDynamics::Settings settings = makeSettings();
        settings.langevin->maxDoublings = k;
        settings.langevin->reference = 1e-6;
        dynamics.setSettings(settings);
        begin(dynamics, e);
        for (int i = 0; i < 5; i++) {
            const Vectors start = dynamics.getPositions(), velocities = dynamics.getVelocities(), noise = drawNoise(e);
            dynamics.setNoise(noise);
            takeStep(dynamics);
            const PlainStep four(e, settings, start, velocities, noise, k, true);
            ASSERT(largestDistance(four.q, dynamics.getPositions()) < 1e-12);
            ASSERT(largestDistance(four.v, dynamics.getVelocities()) < 1e-9);
        }
    }
}

// The noise of each try is that of the step: where it is drawn, not given, the accepted try has that of the first index.
void testTriesAgainWithTheSameNoise() {
    int numRetried = 0;
    for (int seed = 1; seed <= 20; seed++) {
        Example e = makeExample();
        LangevinDynamics dynamics = makeDynamics(e);
        LangevinDynamics::Settings settings = makeSettings();
        settings.langevin->randomSeed = seed;
        settings.langevin->friction = 200; // so that the noise decides about the end of a step
        settings.langevin->temperature = 2000;
        dynamics.setSettings(settings);
        begin(dynamics, e);
        settings.langevin->reference = referenceFor(dynamics, 1);
        dynamics.setSettings(settings);
        const Vectors start = dynamics.getPositions(), velocities = dynamics.getVelocities();
        Vectors noise(start.size());
        for (size_t i = 0; i < noise.size(); i++)
            noise[i] = RandomNumbers::normal(seed, 0, (int) i);
        const int passes = takeStep(dynamics);
        const int substeps = dynamics.getLargestSubsteps();
        int k = 1;
        while (LangevinSettings::getSubsteps(k) < substeps)
            k++;
        numRetried += passes > substeps;
        const PlainStep plain(e, settings, start, velocities, noise, k, false);
        ASSERT(largestDistance(plain.q, dynamics.getPositions()) < 1e-11);
    }
    std::cout << numRetried << " of 20 steps were tried again" << std::endl;
    ASSERT(numRetried > 3);
}

// The numbers that the authors of Philox publish with it.
void testRandomNumbers() {
    typedef RandomNumbers::Words Words;
    const uint32_t ones = 0xffffffff;
    ASSERT((RandomNumbers::philox({0, 0, 0, 0}, {0, 0}) == Words{0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8}));
    ASSERT((RandomNumbers::philox({ones, ones, ones, ones}, {ones, ones}) ==
            Words{0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd}));
    ASSERT((RandomNumbers::philox({0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344}, {0xa4093822, 0x299f31d0}) ==
            Words{0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1}));
    // Those of many particles at once, in any order, are those of each; and what logarithms and cosines of the library make of the words.
    const uint64_t seed = 0x123456789abULL, step = 0x7654321fedcULL;
    const int numParticles = 3 * RandomNumbers::BLOCK / 2;
    vector<int> particles;
    for (int i = 0; i < numParticles; i++)
        particles.push_back(7 * (numParticles - i));
    Vectors numbers(numParticles);
    RandomNumbers::normal(seed, step, particles.data(), numParticles, numbers.data());
    for (int i = 0; i < numParticles; i++) {
        const Words words =
            RandomNumbers::philox({(uint32_t) step, (uint32_t) (step >> 32), (uint32_t) particles[i], 0},
                                  {(uint32_t) seed, (uint32_t) (seed >> 32)});
        const double unit = std::pow(2.0, -32), turn = 8 * std::atan(1.0);
        const double first = std::sqrt(-2 * std::log((words[0] + 0.5) * unit)), angle = turn * (words[1] * unit);
        const double second = std::sqrt(-2 * std::log((words[2] + 0.5) * unit)), other = turn * (words[3] * unit);
        const Vec3 expected(first * std::cos(angle), first * std::sin(angle), second * std::cos(other));
        ASSERT((numbers[i] - expected).dot(numbers[i] - expected) < 1e-28);
        ASSERT(numbers[i] == RandomNumbers::normal(seed, step, particles[i]));
    }
    // Moments of the normal distribution, to five standard errors.
    const int count = 100000;
    double moments[4] = {}, product = 0;
    for (int i = 0; i < count; i++) {
        const Vec3 x = RandomNumbers::normal(3, i, 7);
        for (int c = 0; c < 3; c++)
            for (int p = 0; p < 4; p++)
                moments[p] += std::pow(x[c], p + 1) / (3 * count);
        product += (x[0] * x[1] + x[1] * x[2] + x[2] * x[0]) / (3 * count);
    }
    const double error = 1 / std::sqrt(3.0 * count);
    ASSERT(std::fabs(moments[0]) < 5 * error);
    ASSERT(std::fabs(moments[1] - 1) < 5 * std::sqrt(2.0) * error);
    ASSERT(std::fabs(moments[2]) < 5 * std::sqrt(15.0) * error);
    ASSERT(std::fabs(moments[3] - 3) < 5 * std::sqrt(96.0) * error);
    ASSERT(std::fabs(product) < 5 * error);
}

// The kinetic energy is that of P (v - d/2 M^-1 F): d is that of the last step, and before one the step size that is set by now.
void testKineticEnergy() {
    Example e = makeExample();
    LangevinDynamics dynamics = makeDynamics(e);
    LangevinDynamics::Settings settings = makeSettings();
    auto expected = [&](double d) {
        Vectors w = dynamics.getVelocities();
        const Vectors forces = forceAt(dynamics.getPositions());
        for (size_t i = 0; i < w.size(); i++)
            w[i] -= forces[i] * (0.5 * d / e.masses[i]);
        DenseSolver{e}.project(dynamics.getPositions(), w);
        double sum = 0;
        for (size_t i = 0; i < w.size(); i++)
            sum += 0.5 * e.masses[i] * w[i].dot(w[i]);
        return sum;
    };
    dynamics.setSettings(settings);
    begin(dynamics, e);
    const double old = expected(settings.stepSize);
    ASSERT_EQUAL_TOL(old, dynamics.computeHalfStepKineticEnergy(), 1e-10);
    settings.stepSize /= 4;
    dynamics.setSettings(settings);
    ASSERT(std::fabs(expected(settings.stepSize) / old - 1) > 1e-6); // what is to be told apart
    ASSERT_EQUAL_TOL(expected(settings.stepSize), dynamics.computeHalfStepKineticEnergy(), 1e-10);
    takeStep(dynamics);
    const double d = settings.stepSize / dynamics.getLargestSubsteps();
    settings.stepSize *= 2;
    dynamics.setSettings(settings);
    ASSERT_EQUAL_TOL(expected(d), dynamics.computeHalfStepKineticEnergy(), 1e-10);
}

// A force that is no number, however small the substeps, ends the step; the state is that before it.
void testFailureLeavesTheState() {
    Example e = makeExample();
    LangevinDynamics dynamics = makeDynamics(e);
    LangevinDynamics::Settings settings = makeSettings();
    settings.langevin->maxDoublings = 3;
    dynamics.setSettings(settings);
    begin(dynamics, e);
    takeStep(dynamics);
    const Vectors start = dynamics.getPositions(), velocities = dynamics.getVelocities();
    const vector<double> random = dynamics.getRandomState(), references = dynamics.getReferences();
    int tries = 0;
    const std::string wanted =
        "the force on particle 4 became infinite or not a number, in a step of 9 substeps (k = 3)";
    assertThrows(wanted, [&] {
        while (true) {
            dynamics.step(INFINITY);
            tries++;
            Vectors forces = forceAt(dynamics.getNextPositions());
            forces[4][1] = std::numeric_limits<double>::quiet_NaN();
            dynamics.finish(forces, 0);
        }
    });
    ASSERT_EQUAL(4, tries); // k = 0, 1, 2, 3
    dynamics.abandonStep();
    ASSERT(start == dynamics.getPositions() && velocities == dynamics.getVelocities());
    ASSERT(random == dynamics.getRandomState() && references == dynamics.getReferences());
    // A force that recovers within the step does no harm, and the noise is what it would have been.
    LangevinDynamics other = makeDynamics(e);
    other.setSettings(settings);
    begin(other, e);
    takeStep(other);
    settings.langevin->reference = 1e-6;
    for (LangevinDynamics* each : {&dynamics, &other})
        each->setSettings(settings);
    takeStep(dynamics);
    takeStep(other);
    ASSERT(dynamics.getPositions() == other.getPositions());
}

// The reference begins within its bounds, moves by 0.2 % a step, and stays where it is told to.
void testReference() {
    Example e = makeExample();
    LangevinDynamics dynamics = makeDynamics(e);
    LangevinDynamics::Settings settings = makeSettings();
    dynamics.setSettings(settings);
    begin(dynamics, e);
    ASSERT_EQUAL(0.0, dynamics.getReferences()[0]);
    const double floor = 0.5 * std::sqrt(BOLTZMANN * 300) / settings.stepSize, u = dynamics.getMonitorValues()[0];
    double reference = std::max(floor, std::min(u, 4 * floor));
    for (int i = 0; i < 20; i++) {
        takeStep(dynamics);
        reference = std::max(floor, reference * std::exp(dynamics.getMonitorValues()[0] > reference ? 0.002 : -0.002));
        ASSERT_EQUAL_TOL(reference, dynamics.getReferences()[0], 1e-14);
    }
    settings.langevin->isReferenceFrozen = true;
    dynamics.setSettings(settings);
    takeStep(dynamics);
    ASSERT_EQUAL_TOL(reference, dynamics.getReferences()[0], 1e-14);
    settings.langevin->reference = 7;
    dynamics.setSettings(settings);
    takeStep(dynamics);
    ASSERT_EQUAL(7.0, dynamics.getReferences()[0]);
}

// The reference does not follow what is hotter than thermal motion in steps of substeps, and so is what it was when the heat of a
// clash has left, however slowly that is.
void testHeatDoesNotCaptureTheReference() {
    for (double temperature : {300.0, 10.0}) {
        Example e = makeExample();
        LangevinDynamics dynamics = makeDynamics(e);
        LangevinDynamics::Settings settings = makeSettings();
        settings.stepSize = 0.001;
        settings.tolerance = 1e-8;
        settings.langevin->temperature = temperature;
        dynamics.setSettings(settings);
        begin(dynamics, e);
        takeStep(dynamics);
        const double floor = 0.5 * std::sqrt(BOLTZMANN * temperature) / settings.stepSize;
        const double largest = 16 * 0.5 * std::sqrt(BOLTZMANN * 300) / settings.stepSize;
        Vectors hot = dynamics.getVelocities();
        for (Vec3& each : hot)
            each *= 40;
        dynamics.changeVelocities(hot);
        int numHot = 0, numWarm = 0;
        for (int i = 0; i < 2000; i++) {
            const double before = dynamics.getReferences()[0];
            const long long substepped = dynamics.getNumSubstepped();
            takeStep(dynamics);
            const double u = dynamics.getMonitorValues()[0], after = dynamics.getReferences()[0];
            const bool isHot = dynamics.getNumSubstepped() > substepped && u > largest;
            numHot += isHot && u > before;
            numWarm += !isHot && u > before;
            const double follows = std::max(floor, before * std::exp(u > before ? 0.002 : -0.002));
            ASSERT_EQUAL_TOL(isHot && u > before ? before : follows, after, 1e-12);
        }
        std::cout << temperature << " K: " << numHot << " steps were too hot to follow, " << numWarm << " were not"
                  << std::endl;
        ASSERT(numHot > 20 && numWarm > 20);
    }
}

// The same to the last bit on any number of threads.
void testThreads() {
    vector<Vectors> ends;
    for (int numThreads : {1, 2, 5}) {
        Example e = makeComb(6000);
        LangevinDynamics dynamics = makeDynamics(e);
        int calls = 0;
        dynamics.setParallel(runInReverse(numThreads, calls), numThreads);
        LangevinDynamics::Settings settings = makeSettings();
        settings.stepSize = 0.001;
        settings.tolerance = 1e-9; // for the comb is long
        dynamics.setSettings(settings);
        Vectors positions = e.positions;
        dynamics.projectPositions(positions, dynamics.getParameters());
        dynamics.begin(positions, e.velocities, forcesAt(positions), 0);
        for (int i = 0; i < 4; i++) {
            Vectors forces;
            do {
                dynamics.step(INFINITY);
                forces = forcesAt(dynamics.getNextPositions());
            } while (!dynamics.finish(forces, 0));
        }
        ASSERT((calls > 0) == (numThreads > 1));
        ends.push_back(dynamics.getPositions());
    }
    ASSERT(ends[0] == ends[1] && ends[0] == ends[2]);
    ASSERT(largestDistance(ends[0], makeComb(6000).positions) > 1e-4);
}

} // namespace

int main() {
    return runTests({
        {"RetracesSteps", testRetracesSteps},
        {"NeedsOneProjection", testNeedsOneProjection},
        {"TriesAgainWithTheSameNoise", testTriesAgainWithTheSameNoise},
        {"RandomNumbers", testRandomNumbers},
        {"KineticEnergy", testKineticEnergy},
        {"FailureLeavesTheState", testFailureLeavesTheState},
        {"Reference", testReference},
        {"HeatDoesNotCaptureTheReference", testHeatDoesNotCaptureTheReference},
        {"Threads", testThreads},
    });
}
