// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/AutomaticControl.h"
#include "constraints/StepFailure.h"
#include <algorithm>
#include <cmath>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// The powers of u_A and u_B, the length l (nm), where the dead zone ends, and the largest density that is asked for.
const double POWERS[] = {2.0 / 3.0, 0.8};
const double LENGTH = 0.0125;
const double DEAD_ZONE = 2, LARGEST = 1000;
// a in f(x) = (x - a) - (1 - a)^2/(x - a): no step is longer than the nominal one divided by a.
const double SMALLEST = 0.75;
// Accelerations below this fraction of |v|^2/l are rounding.
const double ROUNDING = 1e-12;

double f(double x) {
    const double one = 1 - SMALLEST;
    return (x - SMALLEST) - one * one / (x - SMALLEST);
}

// Without cancellation for y < 0.
double inverseOfF(double y) {
    const double one = 1 - SMALLEST;
    const double root = std::sqrt(y * y + 4 * one * one);
    return SMALLEST + (y > 0 ? 0.5 * (y + root) : 2 * one * one / (root - y));
}

double sixteenthPower(double x) {
    for (int i = 0; i < 4; i++)
        x *= x;
    return x;
}

double sixteenthRoot(double x) {
    for (int i = 0; i < 4; i++)
        x = std::sqrt(x);
    return x;
}

// phi(u): 1 to 1e-6 for u below 0.4 DEAD_ZONE, u/DEAD_ZONE far above it, and never above LARGEST.
double applyDeadZone(double u) {
    const double x = std::min(u / DEAD_ZONE, 1e15); // whose sixteenth power does not overflow
    const double raised = sixteenthRoot(1 + sixteenthPower(x));
    return raised / sixteenthRoot(1 + sixteenthPower(raised / LARGEST));
}

// (sum x^4)^(1/8)
double eighthRootOfFourthPowers(const vector<double>& x) {
    double sum = 0;
    for (double each : x)
        sum += (each * each) * (each * each);
    return std::sqrt(std::sqrt(std::sqrt(sum)));
}

void requireFinite(double value, const char* name) {
    if (!std::isfinite(value))
        throw StepFailure(std::string("the monitor ") + name +
                          " of the automatic step control became infinite or not a number");
}

} // namespace

AutomaticControl::AutomaticControl(const ConstraintSystem& system) :
        system(system), numClusters((int) system.getClusters().size()), references(), memory(), measured() {
    vector<int> clusters(system.getNumParticles(), -1);
    for (int c = 0; c < numClusters; c++)
        for (int i : system.getClusterParticles(c))
            clusters[i] = c;
    for (int i = 0; i < system.getNumParticles(); i++) {
        if (system.getInverseMasses()[i] == 0)
            continue;
        if (clusters[i] < 0)
            clusters[i] = numClusters++;
        movingParticles.push_back(i);
        clusterOfParticle.push_back(clusters[i]);
    }
    for (vector<double>* numbers : {&memory.forceSquares, &measuredSquares, &scratch})
        numbers->resize(numClusters);
}

// S_c = (Lambda^T K Lambda)_c + sum_{i in c} |F_i|^2/m_i
void AutomaticControl::sumForceSquares(const vector<Vec3>& force, const vector<double>& multipliers,
                                       const vector<double>& rightSides, vector<double>& squares) const {
    std::fill(squares.begin(), squares.end(), 0.0);
    const vector<ConstraintSystem::Cluster>& clusters = system.getClusters();
    for (size_t c = 0; c < clusters.size(); c++) {
        double sum = 0;
        for (int k = clusters[c].first; k < clusters[c].first + clusters[c].size; k++)
            sum += multipliers[k] * rightSides[k];
        squares[c] = std::isnan(sum) ? sum : std::max(sum, 0.0); // rounding could make it negative where it vanishes
    }
    const vector<double>& inverseMasses = system.getInverseMasses();
    for (size_t p = 0; p < movingParticles.size(); p++) {
        const int i = movingParticles[p];
        squares[clusterOfParticle[p]] += force[i].dot(force[i]) * inverseMasses[i];
    }
}

// U_A from S_c
double AutomaticControl::evaluateOnStep(const vector<Vec3>& v, const vector<Vec3>& force,
                                        const vector<double>& squares) {
    scratch = squares;
    for (size_t p = 0; p < movingParticles.size(); p++) {
        const int i = movingParticles[p];
        scratch[clusterOfParticle[p]] += std::sqrt(force[i].dot(force[i])) * v[i].dot(v[i]) / LENGTH;
    }
    return eighthRootOfFourthPowers(scratch);
}

void AutomaticControl::begin(const vector<Vec3>& v, const vector<Vec3>& force, const vector<double>& multipliers,
                             const vector<double>& rightSides) {
    sumForceSquares(force, multipliers, rightSides, memory.forceSquares);
    memory.values[OnStep] = evaluateOnStep(v, force, memory.forceSquares);
    memory.values[HalfStep] = 0;
}

void AutomaticControl::measure(const vector<Vec3>& v, const vector<Vec3>& force, const vector<double>& multipliers,
                               const vector<double>& rightSides, const vector<Vec3>& w, double size,
                               const vector<Vec3>& oldForce) {
    sumForceSquares(force, multipliers, rightSides, measuredSquares);
    measured[OnStep] = evaluateOnStep(v, force, measuredSquares);
    requireFinite(measured[OnStep], "U_A");
    std::fill(scratch.begin(), scratch.end(), 0.0);
    for (size_t p = 0; p < movingParticles.size(); p++) {
        const int i = movingParticles[p];
        scratch[clusterOfParticle[p]] += w[i].dot(force[i] - oldForce[i]);
    }
    for (int c = 0; c < numClusters; c++)
        scratch[c] = 2 / size * std::fabs(scratch[c]) + 0.5 * (measuredSquares[c] + memory.forceSquares[c]);
    measured[HalfStep] = eighthRootOfFourthPowers(scratch);
    requireFinite(measured[HalfStep], "U_B");
}

// f(phi(u))
double AutomaticControl::target(int monitor, double value) const {
    return f(applyDeadZone(std::pow(value / references[monitor], POWERS[monitor])));
}

double AutomaticControl::combine(const double (&transformed)[NUM_MONITORS]) {
    const double a = inverseOfF(transformed[OnStep]), b = inverseOfF(transformed[HalfStep]);
    return std::sqrt(0.5 * (a * a + b * b));
}

double AutomaticControl::densityOf(const double (&values)[NUM_MONITORS]) const {
    return combine({target(OnStep, values[OnStep]), target(HalfStep, values[HalfStep])});
}

void AutomaticControl::acceptMeasured() {
    std::copy(measured, measured + NUM_MONITORS, memory.values);
    memory.forceSquares.swap(measuredSquares);
}

void AutomaticControl::acceptStep() {
    acceptMeasured();
    for (int k = 0; k < NUM_MONITORS; k++) {
        const double last = memory.behind[k];
        memory.behind[k] = memory.ahead[k];
        // A joins its two neighbours of step n, B those of half step n-1/2.
        memory.ahead[k] = 2 * target(k, measured[k]) - (k == OnStep ? memory.ahead[k] : last);
    }
}

// The densities move on by that part of what they would in a full step. U_B of a short step is spoiled by the rounding of the
// forces, and counts only if the step is at least half a full one.
void AutomaticControl::acceptPartOfStep(double part) {
    acceptMeasured();
    for (int k = 0; k < NUM_MONITORS; k++) {
        const double behind = memory.behind[k], ahead = memory.ahead[k];
        memory.behind[k] += part * (ahead - behind);
        if (k == OnStep)
            memory.ahead[k] = 2 * target(k, measured[k]) - memory.behind[k];
        else {
            const double afterNext = (part < 0.5 ? 2 * ahead : 2 * target(k, measured[k])) - behind;
            memory.ahead[k] += part * (afterNext - ahead);
        }
    }
}

// As in docs/method.md, section 7, the smooth solution of x[n+1/2] + x[n-1/2] = 2 a[n] is, half a step before n = 0,
// (a[-1] + a[0])/2 - (a[-2] - 2 a[-1] + a[0])/4, and that of y[n+1/2] + y[n-3/2] = 2 b[n-1/2] is b to second order.
void AutomaticControl::start(const double (&back)[NUM_MONITORS], const double (&secondBack)[NUM_MONITORS]) {
    const double a0 = target(OnStep, memory.values[OnStep]), a1 = target(OnStep, back[OnStep]),
                 a2 = target(OnStep, secondBack[OnStep]);
    const double smooth = 0.5 * (a0 + a1) - 0.25 * (a0 - 2 * a1 + a2);
    memory.behind[OnStep] = std::min(std::max(smooth, std::min(a0, a1)), std::max(a0, a1));
    memory.ahead[OnStep] = 2 * a0 - memory.behind[OnStep];
    const double b1 = target(HalfStep, back[HalfStep]), b3 = target(HalfStep, secondBack[HalfStep]);
    memory.values[HalfStep] = back[HalfStep];
    memory.behind[HalfStep] = b1;
    memory.ahead[HalfStep] = 2 * b1 - b3;
}

void AutomaticControl::change(const vector<Vec3>& v, const vector<Vec3>& force, const vector<double>& multipliers,
                              const vector<double>& rightSides, double part) {
    const double before = target(OnStep, memory.values[OnStep]), halfStepValue = memory.values[HalfStep];
    begin(v, force, multipliers, rightSides);
    memory.values[HalfStep] = halfStepValue;
    const double shift = target(OnStep, memory.values[OnStep]) - before;
    memory.behind[OnStep] += shift;
    memory.ahead[OnStep] += shift;
    for (int k = 0; k < NUM_MONITORS; k++)
        for (double* each : {&memory.behind[k], &memory.ahead[k]})
            *each += part * (target(k, memory.values[k]) - *each);
}

void AutomaticControl::reverse() {
    std::swap_ranges(memory.behind, memory.behind + NUM_MONITORS, memory.ahead);
}

double AutomaticControl::getNegligibleValue(const vector<Vec3>& v) const {
    vector<double> largest(numClusters, 0.0);
    for (size_t p = 0; p < movingParticles.size(); p++) {
        const int i = movingParticles[p];
        const double acceleration = ROUNDING * v[i].dot(v[i]) / LENGTH;
        largest[clusterOfParticle[p]] += system.getMasses()[i] * acceleration * acceleration;
    }
    return eighthRootOfFourthPowers(largest);
}
