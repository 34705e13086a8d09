// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// AutomaticControl on two free particles, whose monitors are written down by hand.

#include "TestSupport.h"
#include "step/AutomaticControl.h"
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

const double STEP = 0.002, KT_300 = 300 * 0.00831446;
typedef vector<Vec3> Vectors;

struct Example {
    ConstraintSolver solver{{4.0, 1.0}, {}};
    AutomaticControl control{solver};
    const ExpressionParameters none = solver.getSystem().getGivenParameters();
    const vector<double> noMultipliers;
    Vectors positions = {Vec3(), Vec3(1, 0, 0)}, velocities = {Vec3(0.5, 0, 0), Vec3(0, 1.5, 0)};
    Vectors forces = {Vec3(), Vec3()};

    explicit Example(int learningSteps = 5, double minimumStep = STEP / 1000) {
        AutomaticControl::Settings settings;
        settings.stepSize = STEP;
        settings.minimumStep = minimumStep;
        settings.learningSteps = learningSteps;
        control.setSettings(settings);
    }
    AutomaticControl::State state() const {
        return {positions, none, velocities, forces, noMultipliers};
    }
    // A force on the first particle alone, across its velocity, so that it does no work.
    void pull(double force) {
        forces[0] = Vec3(0, force, 0);
    }
    void begin() {
        control.begin(state());
        control.start();
    }
    double step() {
        const double density = control.getNext();
        control.measure(state(), velocities, STEP / density, forces);
        control.acceptStep();
        return density;
    }
    // U_A, and U_B where the force has been the same at the start of the step.
    double value(int monitor) const {
        double sum = 0;
        for (int i = 0; i < 2; i++) {
            const double mass = i == 0 ? 4 : 1, force = std::sqrt(forces[i].dot(forces[i])),
                         speed = std::sqrt(velocities[i].dot(velocities[i]));
            double each = force * force / mass + mass * std::pow(speed, 4) / (0.4 * 0.4);
            if (monitor == 0)
                each += force * speed * speed / 0.0125;
            sum += std::pow(each, 4);
        }
        return std::pow(sum, 0.125);
    }
    // The value at which all momenta change by the thermal ones in a step.
    double thermal(double kT) const {
        return std::sqrt(kT) / STEP * std::pow(2.0, 0.125);
    }
};

void testReferencesAreLearnt() {
    Example e(5);
    double logarithms[2] = {};
    e.pull(10);
    e.begin();
    for (int i = 0; i < 5; i++) {
        for (int k = 0; k < 2; k++)
            ASSERT_EQUAL(0.0, e.control.getReference(k));
        e.pull(10);
        ASSERT_EQUAL(1.0, e.step());
        for (int k = 0; k < 2; k++) {
            ASSERT_EQUAL_TOL(e.value(k), e.control.getMemory().values[k], 1e-12);
            logarithms[k] += std::log(e.value(k)) / 5;
        }
        e.velocities[1] *= 1.1;
        e.control.begin(e.state()); // so that S_c is the same at both ends of the next step
    }
    for (int k = 0; k < 2; k++)
        ASSERT_EQUAL_TOL(std::exp(logarithms[k]), e.control.getReference(k), 1e-12);
    // And stay as they are.
    const double before = e.control.getReference(0);
    e.pull(50);
    for (int i = 0; i < 100; i++)
        e.step();
    ASSERT_EQUAL(before, e.control.getReference(0));
}

void testNothingIsNotLearntFrom() {
    Example e(3);
    e.velocities = {Vec3(), Vec3()};
    e.begin();
    for (int i = 0; i < 20; i++)
        ASSERT_EQUAL(1.0, e.step());
    ASSERT_EQUAL(0.0, e.control.getReference(0));
    e.pull(0.9e-6 * e.thermal(KT_300) * 2); // U is |F|/sqrt(m)
    ASSERT_EQUAL(1.0, e.step());
    ASSERT_EQUAL(0.0, e.control.getMemory().numLearnt);
    e.pull(10);
    for (int i = 0; i < 3; i++)
        ASSERT_EQUAL(1.0, e.step());
    ASSERT_EQUAL_TOL(5.0, e.control.getReference(0), 1e-12);
}

// At rest in units of 300 K, else in those of the velocities; at the start, and in the first steps.
void testHardStart() {
    for (const double speed : {0.0, 1.5, 20.0})
        for (const bool isLater : {false, true}) {
            Example e;
            e.velocities = {Vec3(), Vec3(speed, 0, 0)};
            const double unit = e.thermal(std::max(KT_300, speed * speed / 6));
            if (isLater) {
                e.begin();
                ASSERT_EQUAL(1.0, e.step());
            }
            e.pull(2 * 7.9 * unit);
            if (!isLater)
                e.begin();
            e.step();
            ASSERT_EQUAL(0.0, e.control.getReference(0));
            e.pull(2 * 8.1 * unit);
            if (!isLater)
                e.begin();
            else
                e.step();
            for (int k = 0; k < 2; k++)
                ASSERT_EQUAL_TOL(0.4 * unit, e.control.getReference(k), 1e-9);
            ASSERT(e.control.getNext() > 2);
        }
}

void testReferencesFollowChanges() {
    Example e(1);
    e.pull(400);
    e.begin();
    e.step();
    const double first = e.control.getReference(0), second = e.control.getReference(1);
    // A change that is rounding, and none: they stay.
    e.pull(4000);
    e.control.change(e.state(), 1e-9);
    e.step();
    ASSERT_EQUAL(first, e.control.getReference(0));
    // Upwards by no more than 2/100 of a logarithm in a nominal step, and to the value in the end.
    double last = second;
    for (int i = 0; i < 5000; i++) {
        e.control.change(e.state(), 0.5);
        const double part = 1 / e.control.getNext();
        e.step();
        ASSERT(e.control.getReference(1) <= last * std::exp(0.02 * part) * (1 + 1e-12));
        last = e.control.getReference(1);
    }
    ASSERT_EQUAL_TOL(e.value(1), last, 1e-3);
    // Never below 0.2 thermal units.
    e.pull(0);
    for (int i = 0; i < 5000; i++) {
        e.control.change(e.state(), 0.5);
        e.step();
    }
    const double kT = (4 * 0.25 + 2.25) / 6;
    ASSERT_EQUAL_TOL(0.2 * e.thermal(kT), e.control.getReference(1), 1e-9);
    // They stay again 1,000 steps after the last change.
    e.pull(4000);
    for (int i = 0; i < 1000; i++)
        e.step();
    last = e.control.getReference(1);
    e.step();
    ASSERT_EQUAL(last, e.control.getReference(1));
}

void testReferencesAreFoundAnewWhereItIsMuchHotter() {
    Example e(1);
    e.begin();
    e.step();
    ASSERT(e.control.getReference(0) > 0);
    for (Vec3& v : e.velocities)
        v *= 1.9;
    e.begin();
    ASSERT(e.control.getReference(0) > 0);
    for (Vec3& v : e.velocities)
        v *= 1.1;
    e.begin();
    ASSERT_EQUAL(0.0, e.control.getReference(0));
}

void testMinimumStep() {
    for (const double minimum : {STEP / 1000, 0.3 * STEP, 0.9 * STEP}) {
        Example e(1, minimum);
        e.begin();
        ASSERT_EQUAL(1.0, e.control.getNext());
        e.step();
        e.pull(1e12);
        double largest = 0;
        for (int i = 0; i < 100; i++)
            largest = std::max(largest, e.step());
        ASSERT(largest <= STEP / minimum * (1 + 1e-12));
        ASSERT(largest > 0.95 * STEP / minimum);
    }
    Example unlimited(1, 0);
    unlimited.begin();
    unlimited.step();
    unlimited.pull(1e12);
    for (int i = 0; i < 3; i++)
        unlimited.step();
    ASSERT(unlimited.control.getNext() > 2000);
}

void testShortStepsAreCounted() {
    Example e(1);
    e.begin();
    e.step();
    e.pull(1e8);
    for (int i = 0; i < 50; i++)
        e.step();
    const double most = e.control.getMemory().mostShortSteps;
    ASSERT(most >= 45 && most <= 50);
    e.pull(0);
    for (int i = 0; i < 200; i++)
        e.step();
    ASSERT_EQUAL(0.0, e.control.getMemory().shortSteps);
    ASSERT(e.control.getMemory().mostShortSteps < 200);
}

// The densities of a sequence of forces, there and back.
void testReversible() {
    Example e(1);
    e.begin();
    e.step();
    auto force = [](int i) { return 3000 * std::exp(-0.01 * (i - 60) * (i - 60)); };
    vector<double> densities;
    for (int i = 1; i <= 120; i++) {
        const Vectors before = e.forces;
        e.pull(force(i));
        densities.push_back(e.control.getNext());
        e.control.measure(e.state(), e.velocities, STEP / densities.back(), before);
        e.control.acceptStep();
    }
    e.control.reverse();
    for (int i = 119; i >= 35; i--) {
        const Vectors before = e.forces;
        e.pull(force(i));
        const double density = e.control.getNext();
        ASSERT_EQUAL_TOL(densities[i], density, 1e-9);
        e.control.measure(e.state(), e.velocities, STEP / density, before);
        e.control.acceptStep();
    }
    ASSERT(*std::max_element(densities.begin(), densities.end()) > 5);
}

} // namespace

int main() {
    return runTests({
        {"references are learnt", testReferencesAreLearnt},
        {"nothing is not learnt from", testNothingIsNotLearntFrom},
        {"a hard start", testHardStart},
        {"references follow changes", testReferencesFollowChanges},
        {"references are found anew where it is much hotter", testReferencesAreFoundAnewWhereItIsMuchHotter},
        {"the minimum step", testMinimumStep},
        {"short steps are counted", testShortStepsAreCounted},
        {"there and back", testReversible},
    });
}
