// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// ConstraintSolver without a step or a density, against Eigen's factorisations: dense for what is small, and sparse.

#include "Examples.h"
#include "TestSupport.h"
#include "constraints/ConstraintSolver.h"
#include <Eigen/Dense>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <Eigen/SparseLU>
#include <cmath>
#include <set>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

typedef Eigen::SparseMatrix<double> SparseMatrix;
typedef Eigen::VectorXd Vector;
typedef ConstraintSolver::Vectors Vectors;

const double TOLERANCE = 1e-10;

Vector flatten(const Vectors& x) {
    Vector result(3 * x.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = x[i / 3][i % 3];
    return result;
}

Eigen::Map<const Vector> numbers(const vector<double>& x) {
    return Eigen::Map<const Vector>(x.data(), (Eigen::Index) x.size());
}

void assertNear(const Vector& expected, const Vector& found, double fraction) {
    ASSERT((found - expected).norm() <= fraction * (1 + expected.norm()));
}

// Small clusters of all kinds, free particles and a fixed one.
Example makeSmallClusters(int count) {
    Example e;
    for (int i = 0; i < count; i++) {
        e.addWater(Vec3(0.5 * i, 0, 0));
        e.addCluster({12, 1, 1, 1}, {{0, 1}, {0, 2}, {0, 3}},
                     {Vec3(), Vec3(0.1, 0, 0.01), Vec3(-0.05, 0.09, 0), Vec3(-0.05, -0.09, 0.02)});
        e.add(40, Vec3(0, 5, 0.3 * i));
    }
    e.add(0, Vec3(9, 9, 9));
    e.shuffleDistances();
    return e;
}

// Many bonds on one bead: all are coupled, and the factor is a dense panel.
Example makeStar(int bonds) {
    Example e;
    e.add(5000, Vec3());
    for (int i = 0; i < bonds; i++) {
        const Vec3 r = e.randomVector(1);
        e.join(0, e.add(50, r * (1 / std::sqrt(r.dot(r)))));
    }
    return e;
}

/** A solver at the positions of an example, and the same statements with Eigen. */
struct Pair {
    Pair(const Example& e, bool isDense, int numThreads) :
            e(e), solver(e.masses, e.distances, e.expressions), system(solver.getSystem()),
            theta(system.getGivenParameters()), q(e.positions), force(forcesAt(e.positions)), isDense(isDense) {
        solver.setParallel(runInReverse(numThreads, calls), numThreads);
        solver.setTolerance(TOLERANCE);
        solver.projectPositions(q, theta);
        solver.moveTo(q, theta, force);
        solver.beginStep();
        vector<Eigen::Triplet<double>> triplets;
        for (int i = 0; i < 3 * system.getNumParticles(); i++)
            triplets.emplace_back(i, i, e.masses[i / 3] > 0 ? 1 / e.masses[i / 3] : 0.0);
        inverseMasses.resize(triplets.size(), triplets.size());
        inverseMasses.setFromTriplets(triplets.begin(), triplets.end());
        g = jacobianAt(q);
        k = g * inverseMasses * g.transpose();
        if (isDense)
            dense.compute(Eigen::MatrixXd(k));
        else
            sparse.compute(k);
    }
    // By the definition of g, and for expressions by differences of it.
    SparseMatrix jacobianAt(const Vectors& x) const {
        vector<Eigen::Triplet<double>> triplets;
        auto add = [&](int row, int particle, const Vec3& entry) {
            for (int j = 0; j < 3; j++)
                if (e.masses[particle] > 0)
                    triplets.emplace_back(row, 3 * particle + j, entry[j]);
        };
        ConstraintSystem::Jacobian rows(system.getNumEntries());
        system.evaluateJacobian(x, theta, rows); // which other tests compare with differences
        for (int c = 0; c < system.getNumConstraints(); c++)
            if (!system.isExpression(c)) {
                const DistanceConstraint& d = system.getConstraint(c);
                const Vec3 entry = (x[d.particle1] - x[d.particle2]) / (d.length * d.length);
                add(c, d.particle1, entry);
                add(c, d.particle2, entry * -1.0);
            }
        for (const auto& row : system.getExpressionRows())
            for (int entry = row.first; entry < row.end; entry++)
                add(row.constraint, system.getParticleOf(entry), rows[entry]);
        SparseMatrix result(system.getNumConstraints(), 3 * system.getNumParticles());
        result.setFromTriplets(triplets.begin(), triplets.end());
        return result;
    }
    Vector solve(const Vector& b) const {
        if (isDense)
            return dense.solve(b);
        return sparse.solve(b);
    }
    // The velocities of particles without mass are none.
    Vector moving(const Vectors& v) const {
        Vector result = flatten(v);
        for (int i = 0; i < result.size(); i++)
            if (e.masses[i / 3] == 0)
                result[i] = 0;
        return result;
    }
    // g''(v,v), by differences of G along v, exact but for rounding where g is quadratic.
    Vector curvature(const Vectors& v) const {
        const double h = 1e-5;
        Vectors ahead = q, back = q;
        for (size_t i = 0; i < q.size(); i++)
            if (e.masses[i] > 0) {
                ahead[i] += v[i] * h;
                back[i] -= v[i] * h;
            }
        return (jacobianAt(ahead) * moving(v) - jacobianAt(back) * moving(v)) / (2 * h);
    }
    Vector multipliers(const Vectors& v) const {
        return solve(curvature(v) + g * (inverseMasses * flatten(force)));
    }
    double largestError(const Vectors& x) const {
        double largest = 0;
        for (int c = 0; c < system.getNumConstraints(); c++)
            if (!system.isExpression(c)) {
                const DistanceConstraint& d = system.getConstraint(c);
                const Vec3 r = x[d.particle1] - x[d.particle2];
                largest = std::max(largest, std::fabs(std::sqrt(r.dot(r)) / d.length - 1));
            }
        vector<double> values(system.getNumConstraints());
        ConstraintSystem::Jacobian rows(system.getNumEntries());
        system.evaluateJacobian(x, theta, rows);
        system.evaluate(x, theta, values, rows);
        for (const auto& row : system.getExpressionRows())
            largest = std::max(largest, system.findErrorOf(row, values, rows));
        return largest;
    }
    const Example& e;
    ConstraintSolver solver;
    const ConstraintSystem& system;
    ExpressionParameters theta;
    Vectors q, force;
    bool isDense;
    int calls = 0;
    SparseMatrix inverseMasses, g, k;
    Eigen::LDLT<Eigen::MatrixXd> dense;
    Eigen::SimplicialLDLT<SparseMatrix> sparse;
};

} // namespace

void testAtPositions(Pair& p) {
    ASSERT(p.largestError(p.q) <= TOLERANCE);
    const int m = p.system.getNumConstraints();
    vector<double> x(m), right(m);
    p.solver.findMultipliers(p.e.velocities, p.theta, x, right);
    assertNear(p.multipliers(p.e.velocities), numbers(x), 1e-6);
    assertNear(p.k * numbers(x), numbers(right), 1e-9);
    Vectors v = p.e.velocities;
    p.solver.projectVelocities(v);
    const Vector w = p.moving(p.e.velocities);
    assertNear(w - p.inverseMasses * (p.g.transpose() * p.solve(p.g * w)), p.moving(v), 1e-10);
    Vectors forces = p.force;
    p.solver.subtractConstraintForces(p.q, p.theta, x, forces);
    assertNear(flatten(p.force) - p.g.transpose() * numbers(x), flatten(forces), 1e-12);
}

void testSolvePositions(Pair& p) {
    const int m = p.system.getNumConstraints();
    Vectors q = p.q, w = p.e.velocities;
    vector<double> lambda(m), guess(m, 0.0);
    const ConstraintSolver::Offset offset = {vector<double>(m, 3e-3), vector<double>(m, 2e-3)};
    const double kick = 0.7e-3, drift = 1.3e-3;
    const ConstraintSolver::Trial trial = {p.e.velocities, kick, drift, p.theta, q, w, lambda};
    for (const ConstraintSolver::Offset* extra : {(const ConstraintSolver::Offset*) nullptr, &offset}) {
        ASSERT(p.solver.solvePositions(trial, {guess, extra, 0.1}));
        ASSERT(p.largestError(q) <= TOLERANCE);
        const Vector expected = p.moving(p.e.velocities) +
                                kick * (p.inverseMasses * (flatten(p.force) - p.g.transpose() * numbers(lambda)));
        assertNear(expected, p.moving(w), 1e-12);
        assertNear(flatten(p.q) + drift * expected, flatten(q), 1e-13);
    }
}

// A coupled iteration in which the step changes from pass to pass ends where solvePositions() does, with Lambda(q,p+).
void testCoupledPasses(Pair& p) {
    const int m = p.system.getNumConstraints();
    Vectors q = p.q, w = p.e.velocities, qOther = q, wOther = w;
    vector<double> lambda(m), other(m), guess(m, 0.0), multipliers(m), right(m);
    double error = 1;
    int passes = 0;
    for (; passes < 12 && !(error <= 0.1 * TOLERANCE); passes++) {
        const double drift = 1e-3 * (1 + 0.1 * std::pow(1e-3, passes));
        const ConstraintSolver::Guess start = {guess, nullptr, 0.1};
        error = p.solver.coupledPass({p.e.velocities, 1e-3, drift, p.theta, q, w, lambda},
                                     {p.theta, multipliers, right}, passes == 0 ? &start : nullptr);
    }
    ASSERT(passes > 1 && passes < 12);
    ASSERT(p.largestError(q) <= TOLERANCE);
    assertNear(p.multipliers(w), numbers(multipliers), 1e-6);
    assertNear(p.k * numbers(multipliers), numbers(right), 1e-9);
    ASSERT(
        p.solver.solvePositions({p.e.velocities, 1e-3, 1e-3, p.theta, qOther, wOther, other}, {guess, nullptr, 0.1}));
    assertNear(flatten(qOther), flatten(q), 1e-9);
}

void testNewton(Pair& p) {
    const int m = p.system.getNumConstraints();
    Vectors q = p.q, w = p.e.velocities;
    vector<double> lambda(m, 0.0), update(m), values(m);
    const double kick = 1e-3, drift = 2e-3;
    const ConstraintSolver::Trial trial = {p.e.velocities, kick, drift, p.theta, q, w, lambda};
    ASSERT(p.solver.evaluate(trial) > TOLERANCE);
    ASSERT(p.solver.linearize(trial));
    const SparseMatrix next = p.jacobianAt(q);
    const SparseMatrix a = (-kick * drift) * (next * p.inverseMasses * p.g.transpose());
    p.solver.findUpdate(trial, update);
    ConstraintSystem::Jacobian rows(p.system.getNumEntries());
    p.system.evaluateJacobian(q, p.theta, rows);
    p.system.evaluate(q, p.theta, values, rows);
    ASSERT((a * numbers(update) + numbers(values)).norm() <= 1e-9 * numbers(values).norm());
}

void testFinish(Pair& p) {
    struct Counter : ConstraintSolver::Observer {
        void seeParticles(int block) override {
            ASSERT(blocks.insert(block).second);
        }
        void seeConstraints(int range, int first, int end) override {
            if (first < end)
                ASSERT(ranges.insert(range).second);
            for (int k = first; k < end; k++) {
                ASSERT(constraints.insert(k).second);
                ASSERT(std::isfinite((*multipliers)[k]));
            }
        }
        std::set<int> blocks, ranges, constraints;
        const vector<double>* multipliers;
    };
    const int m = p.system.getNumConstraints();
    const double kick = 0.4e-3;
    Vectors v = p.e.velocities;
    vector<double> lambda(m), right(m);
    ConstraintSolver::HalfStep half = {vector<double>(m), vector<double>(m)};
    for (ConstraintSolver::HalfStep* atHalfStep : {(ConstraintSolver::HalfStep*) nullptr, &half}) {
        std::fill(lambda.begin(), lambda.end(), NAN);
        Counter counter;
        counter.multipliers = &lambda;
        p.solver.finish({p.q, p.e.velocities, p.force, p.theta, kick, v, lambda, right, atHalfStep}, &counter);
        ASSERT_EQUAL(p.system.getBlocks().size() - 1, counter.blocks.size());
        ASSERT_EQUAL((size_t) m, counter.constraints.size());
        ASSERT(*counter.ranges.rbegin() < p.solver.getNumRanges());
        const Vector w = p.moving(p.e.velocities) + kick * (p.inverseMasses * flatten(p.force));
        assertNear(w - p.inverseMasses * (p.g.transpose() * p.solve(p.g * w)), p.moving(v), 1e-10);
        assertNear(p.multipliers(v), numbers(lambda), 1e-6);
        assertNear(p.k * numbers(lambda), numbers(right), 1e-9);
    }
    assertNear(p.multipliers(p.e.velocities), numbers(half.multipliers), 1e-6);
    assertNear(p.k * numbers(half.multipliers), numbers(half.rightSide), 1e-9);
    // What it has found serves the next step, if the solver is told so.
    p.solver.moveToEnd();
    testSolvePositions(p);
}

void testAll(const Example& e, bool isDense, int numThreads) {
    Pair p(e, isDense, numThreads);
    testAtPositions(p);
    testSolvePositions(p);
    testCoupledPasses(p);
    testNewton(p);
    testFinish(p);
    ASSERT((p.calls > 0) == (numThreads > 1 && p.system.getNumConstraints() >= 2000));
}

// A sum over constraints or particles is the same to the last bit on one thread and on several, and so is the largest number.
void testSums() {
    const Example e = makeSmallClusters(500);
    int calls = 0;
    ConstraintSolver alone(e.masses, e.distances), shared(e.masses, e.distances);
    shared.setParallel(runInReverse(3, calls), 3);
    shared.beginStep();
    auto term = [](int i) { return std::sin(0.1 * i) + 1.0 / (i + 1); };
    for (int count : {0, 1, 1023, 1024, 1025, 3000}) {
        const double sum = alone.sum(count, term), largest = alone.largest(count, term);
        ASSERT_EQUAL(sum, shared.sum(count, term));
        ASSERT_EQUAL(largest, shared.largest(count, term));
        double expected = 0, expectedLargest = 0;
        for (int i = 0; i < count; i++) {
            expected += term(i);
            expectedLargest = std::max(expectedLargest, term(i));
        }
        ASSERT(std::fabs(sum - expected) <= 1e-11 * (1 + std::fabs(expected)));
        ASSERT_EQUAL(expectedLargest, largest);
    }
    ASSERT(calls > 0);
}

int main() {
    TestList tests;
    for (int numThreads : {1, 3}) {
        const std::string threads = numThreads == 1 ? "" : ", three threads";
        auto add = [&](const std::string& name, const Example& e, bool isDense) {
            tests.push_back({name + threads, [e, isDense, numThreads] { testAll(e, isDense, numThreads); }});
        };
        add("small clusters, dense", makeSmallClusters(20), true);
        add("small clusters", makeSmallClusters(500), false);
        add("a comb, dense", makeComb(60), true);
        add("a comb", makeComb(3000), false);
        add("a rod, dense", makeRod(15), true);
        add("a rod", makeRod(500), false);
        add("a star of bonds, dense", makeStar(400), true);
        add("a comb in pieces", makeComb(15500), false);
        add("a rod in pieces", makeRod(3600), false);
    }
    tests.push_back({"sums", testSums});
    return runTests(tests);
}
