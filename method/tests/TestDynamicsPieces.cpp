// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Clusters so large that they are cut into pieces: the cut, K and the steps against Eigen's sparse factorisation of the same
// matrix.

#include "Steps.h"
#include "TestSupport.h"
#include "constraints/ClusterCut.h"
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <cmath>
#include <random>
#include <set>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::string;
using std::vector;

typedef Eigen::SparseMatrix<double> SparseMatrix;

static std::mt19937 generator(11);

static double uniform(double from, double to) {
    return std::uniform_real_distribution<double>(from, to)(generator);
}

static Vec3 randomVector(double scale) {
    std::normal_distribution<double> normal;
    return Vec3(normal(generator), normal(generator), normal(generator)) * scale;
}

static SparseMatrix sparseJacobian(const ConstraintSystem& system, const vector<Vec3>& q) {
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    const ExpressionParameters theta = system.getGivenParameters();
    system.evaluateJacobian(q, theta, jacobian);
    vector<Eigen::Triplet<double>> triplets;
    auto add = [&](int k, int particle, const Vec3& row) {
        for (int j = 0; j < 3; j++)
            triplets.emplace_back(k, 3 * particle + j, row[j]);
    };
    for (int k = 0; k < system.getNumConstraints(); k++)
        if (!system.isExpression(k)) {
            add(k, system.getConstraint(k).particle1, jacobian[k]);
            add(k, system.getConstraint(k).particle2, jacobian[k] * -1.0);
        }
    for (const auto& row : system.getExpressionRows())
        for (int entry = row.first; entry < row.end; entry++)
            add(row.constraint, system.getParticleOf(entry), jacobian[entry]);
    SparseMatrix result(system.getNumConstraints(), 3 * system.getNumParticles());
    result.setFromTriplets(triplets.begin(), triplets.end());
    return result;
}

static Eigen::VectorXd flatten(const vector<Vec3>& x) {
    Eigen::VectorXd result(3 * x.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = x[i / 3][i % 3];
    return result;
}

static SparseMatrix sparseInverseMasses(const ConstraintSystem& system) {
    vector<Eigen::Triplet<double>> triplets;
    for (int i = 0; i < 3 * system.getNumParticles(); i++)
        triplets.emplace_back(i, i, system.getInverseMasses()[i / 3]);
    SparseMatrix result(triplets.size(), triplets.size());
    result.setFromTriplets(triplets.begin(), triplets.end());
    return result;
}

static Eigen::Map<const Eigen::VectorXd> numbers(const vector<double>& x) {
    return Eigen::Map<const Eigen::VectorXd>(x.data(), (Eigen::Index) x.size());
}

// Every constraint and every particle once, and no particle of a piece in another piece's constraints.
void testCut() {
    vector<vector<int>> chain;
    for (int i = 0; i < 5000; i++)
        chain.push_back({1000 + (i * 3) % 5000, 1000 + (i * 3 + 3) % 5000}); // a ring, its particles in no order
    const ClusterCut cut = cutCluster(chain, 500);
    ASSERT_EQUAL(10, (int) cut.pieces.size());
    ASSERT(cut.joints.size() <= 4 * cut.pieces.size()); // two ends, each way round the ring
    std::set<int> constraints(cut.joints.begin(), cut.joints.end()), particles;
    size_t numConstraints = cut.joints.size(), numParticles = 0;
    for (const ClusterCut::Piece& piece : cut.pieces) {
        const std::set<int> own(piece.particles.begin(), piece.particles.end());
        for (int k : piece.constraints)
            ASSERT(own.count(chain[k][0]) == 1 && own.count(chain[k][1]) == 1);
        constraints.insert(piece.constraints.begin(), piece.constraints.end());
        particles.insert(own.begin(), own.end());
        numConstraints += piece.constraints.size();
        numParticles += piece.particles.size();
    }
    ASSERT_EQUAL(chain.size(), numConstraints);
    ASSERT_EQUAL(chain.size(), constraints.size());
    ASSERT_EQUAL(5000, (int) numParticles);
    ASSERT_EQUAL(5000, (int) particles.size());
    // A sheet has no short cut, and a small cluster needs none.
    vector<vector<int>> sheet;
    const int edge = 70;
    for (int i = 0; i < edge; i++)
        for (int j = 0; j < edge; j++) {
            if (i > 0)
                sheet.push_back({edge * i + j, edge * (i - 1) + j});
            if (j > 0)
                sheet.push_back({edge * i + j, edge * i + j - 1});
        }
    ASSERT(cutCluster(sheet, 500).pieces.empty());
    chain.resize(900);
    ASSERT(cutCluster(chain, 500).pieces.empty());
}

// Along a tree: pieces hang together, are mostly not much larger than asked for, and have about one joint each.
void testCutAlongTree() {
    const int backbone = 600, arm = 3;
    vector<vector<int>> comb;
    for (int i = 0; i < backbone; i++) {
        const int first = i * (arm + 1);
        if (i > 0)
            comb.push_back({first - arm - 1, first});
        for (int k = 0; k < arm; k++)
            comb.push_back({first + k, first + k + 1});
    }
    const ClusterCut cut = cutClusterAlongTree(comb, 64);
    ASSERT(cut.pieces.size() >= 30 && cut.pieces.size() <= comb.size() / 64 + 1);
    ASSERT_EQUAL(cut.pieces.size() - 1, cut.joints.size()); // there is no ring
    std::set<int> constraints(cut.joints.begin(), cut.joints.end()), particles;
    size_t numConstraints = cut.joints.size();
    for (const ClusterCut::Piece& piece : cut.pieces) {
        const std::set<int> own(piece.particles.begin(), piece.particles.end());
        ASSERT_EQUAL(own.size() - 1, piece.constraints.size()); // it hangs together
        ASSERT(own.size() >= 32 && own.size() <= 64 + 64);
        for (int k : piece.constraints)
            ASSERT(own.count(comb[k][0]) == 1 && own.count(comb[k][1]) == 1);
        constraints.insert(piece.constraints.begin(), piece.constraints.end());
        particles.insert(own.begin(), own.end());
        numConstraints += piece.constraints.size();
    }
    ASSERT_EQUAL(comb.size(), numConstraints);
    ASSERT_EQUAL(comb.size(), constraints.size());
    ASSERT_EQUAL((size_t) backbone * (arm + 1), particles.size());
    // The ring gets one joint more, and what is smaller than a piece is one.
    comb.push_back({0, (backbone - 1) * (arm + 1)});
    const ClusterCut ring = cutClusterAlongTree(comb, 64);
    ASSERT(ring.joints.size() >= ring.pieces.size() - 1 && ring.joints.size() <= ring.pieces.size());
    comb.resize(40);
    ASSERT_EQUAL(1, (int) cutClusterAlongTree(comb, 64).pieces.size());
}

void testMatrix(const Example& e) {
    ConstraintSystem system(e.masses, e.distances, e.expressions);
    const ExpressionParameters theta = system.getGivenParameters();
    ASSERT_EQUAL(1, (int) system.getCutClusters().size());
    ASSERT(system.getPieces().size() > 10);
    ConstraintMatrix matrix(system);
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    system.evaluateJacobian(e.positions, theta, jacobian);
    const SparseMatrix g = sparseJacobian(system, e.positions);
    const SparseMatrix k = g * sparseInverseMasses(system) * g.transpose();
    vector<double> b(system.getNumConstraints());
    for (double& x : b)
        x = uniform(-1, 1);
    vector<double> all = b, inSteps = b;
    for (int repeat = 0; repeat < 2; repeat++) { // the second time on top of the first
        all = inSteps = b;
        matrix.factorize(jacobian);
        matrix.solve(all);
        ASSERT((k * numbers(all) - numbers(b)).norm() <= 1e-9 * numbers(b).norm());
        // As a step does it, the pieces in any order.
        const ConstraintSystem::CutCluster& cluster = system.getCutClusters()[0];
        for (auto piece = system.getPieces().rbegin(); piece != system.getPieces().rend(); ++piece) {
            ASSERT_EQUAL(ConstraintMatrix::REGULAR, matrix.tryToFactorize(jacobian, *piece));
            matrix.eliminate(inSteps, *piece, 1);
        }
        ASSERT_EQUAL(ConstraintMatrix::REGULAR, matrix.tryToFactorizeJoints(jacobian, cluster));
        matrix.solveJoints(inSteps, cluster, 1);
        for (const ConstraintSystem::Part& piece : system.getPieces())
            matrix.substitute(inSteps, piece);
        for (int c = system.getPieces()[0].first; c < cluster.joints.end; c++)
            ASSERT_EQUAL(all[c], inSteps[c]);
    }
    // Products with G^T, piece by piece.
    vector<Vec3> forces(e.masses.size()), byPieces = forces;
    system.addTransposedOverMass(jacobian, b, 0.5, forces);
    for (const ConstraintSystem::Part& piece : system.getPieces())
        system.addTransposedOverMass(jacobian, b, 0.5, byPieces, piece);
    for (const ConstraintSystem::Part& piece : system.getPieces())
        for (int p = piece.firstParticle; p < piece.endParticle; p++) {
            const int i = system.getGeneralParticles()[p];
            ASSERT_EQUAL_VEC(forces[i], byPieces[i], 1e-12);
        }
}

// The matrix of Newton's iteration, which takes a cut cluster as a whole.
void testNewtonMatrix(const Example& e) {
    ConstraintSystem system(e.masses, e.distances, e.expressions);
    const ExpressionParameters theta = system.getGivenParameters();
    vector<Vec3> ahead = e.positions;
    for (size_t i = 0; i < ahead.size(); i++)
        ahead[i] += e.velocities[i] * 0.02;
    ConstraintSystem::Jacobian current(system.getNumEntries()), next = current;
    system.evaluateJacobian(e.positions, theta, current);
    system.evaluateJacobian(ahead, theta, next);
    const SparseMatrix a =
        sparseJacobian(system, ahead) * sparseInverseMasses(system) * sparseJacobian(system, e.positions).transpose();
    vector<double> b(system.getNumConstraints());
    for (double& x : b)
        x = uniform(-1, 1);
    vector<double> x = b;
    NewtonMatrix matrix(system);
    ASSERT(matrix.factorize(next, current));
    matrix.solve(x);
    ASSERT((a * numbers(x) - numbers(b)).norm() <= 1e-9 * numbers(b).norm());
}

static VRattleRun::Settings makeSettings(StepDensity::Update update) {
    return {0.002, 0.002 / 50, 0.004, 1e-10, update, {{StepMonitor::ConstraintForce, 1.0, 1.0, 0.0}}, false};
}

void testSteps(const Example& e, StepDensity::Update update) {
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    dynamics.setSettings(makeSettings(update));
    vector<Vec3> start = e.positions;
    dynamics.begin(start, e.velocities, forcesAt(start), 0);
    takeSteps(dynamics, 1);
    const vector<Vec3> after = dynamics.getPositions();
    const ConstraintSystem& system = dynamics.getConstraintSystem();
    const ExpressionParameters theta = system.getGivenParameters();
    const double reference = dynamics.getReferences()[0];
    vector<double> g(system.getNumConstraints()), curvature(system.getNumConstraints());
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    for (int i = 0; i < 6; i++) {
        const double before = dynamics.getDensity(), u = dynamics.getMonitorValues()[0] / reference;
        takeSteps(dynamics, 1);
        const vector<Vec3>&q = dynamics.getPositions(), &v = dynamics.getVelocities();
        system.evaluateJacobian(q, theta, jacobian);
        ASSERT(system.evaluate(q, theta, g, jacobian) <= 1e-10);
        system.evaluateCurvature(q, v, theta, curvature);
        const SparseMatrix rows = sparseJacobian(system, q), inverseMasses = sparseInverseMasses(system);
        ASSERT((rows * flatten(v)).cwiseAbs().maxCoeff() < 1e-10); // the velocities are tangent
        const SparseMatrix k = rows * inverseMasses * rows.transpose();
        Eigen::SimplicialLDLT<SparseMatrix> factor(k);
        const Eigen::VectorXd right = numbers(curvature) + rows * (inverseMasses * flatten(dynamics.getForces()));
        const Eigen::VectorXd expected = factor.solve(right);
        ASSERT((expected - numbers(dynamics.getMultipliers())).norm() <= 1e-8 * expected.norm());
        ASSERT_EQUAL_TOL(std::sqrt(expected.dot(right)), dynamics.getMonitorValues()[0], 1e-9);
        if (update == StepDensity::Explicit) { // (3.15)
            StepDensity density(update, 0.002, 0.002 / 50, 0.004);
            ASSERT_EQUAL_TOL(2 * density.limit(u) - before, dynamics.getDensity(), 1e-12);
        }
    }
    ASSERT_EQUAL(0, dynamics.getNumRescues());
    dynamics.reverse();
    takeSteps(dynamics, 6);
    for (size_t i = 0; i < after.size(); i++)
        ASSERT_EQUAL_VEC(after[i], dynamics.getPositions()[i], 1e-9);
}

// Positions that are off by up to a hundredth of a bond come back.
void testProjection(const Example& e) {
    VRattleRun dynamics(e.masses, e.distances, e.expressions);
    dynamics.setSettings(makeSettings(StepDensity::Explicit));
    const ConstraintSystem& system = dynamics.getConstraintSystem();
    const ExpressionParameters theta = system.getGivenParameters();
    vector<Vec3> positions = e.positions;
    for (size_t i = 0; i < positions.size(); i++)
        if (e.masses[i] > 0)
            positions[i] += randomVector(0.0002);
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    vector<double> g(system.getNumConstraints());
    system.evaluateJacobian(positions, theta, jacobian);
    ASSERT(system.evaluate(positions, theta, g, jacobian) > 0.003);
    ASSERT(dynamics.projectPositions(positions, dynamics.getParameters()));
    system.evaluateJacobian(positions, theta, jacobian);
    ASSERT(system.evaluate(positions, theta, g, jacobian) <= 1e-10);
}

// A doubled bond is found within a piece and among the joints.
void testDependentConstraints(const Example& e) {
    const ConstraintSystem whole(e.masses, e.distances, e.expressions);
    for (int k : {whole.getPieces()[1].first, whole.getCutClusters()[0].joints.first}) {
        vector<DistanceConstraint> distances = e.distances;
        distances.push_back(whole.getConstraint(k));
        VRattleRun dynamics(e.masses, distances, e.expressions);
        ASSERT(!dynamics.getConstraintSystem().getPieces().empty());
        dynamics.setSettings(makeSettings(StepDensity::Explicit));
        assertThrows("redundant", [&] { dynamics.begin(e.positions, e.velocities, vector<Vec3>(e.masses.size()), 0); });
    }
}

int main() {
    const Example comb = makeComb(15500), rod = makeRod(3600);
    return runTests({
        {"the cut", testCut},
        {"the cut along a tree", testCutAlongTree},
        {"K and its factor, a comb", [&] { testMatrix(comb); }},
        {"K and its factor, a rod", [&] { testMatrix(rod); }},
        {"Newton's matrix, a comb", [&] { testNewtonMatrix(comb); }},
        {"Newton's matrix, a rod", [&] { testNewtonMatrix(rod); }},
        {"projection of a comb", [&] { testProjection(comb); }},
        {"projection of a rod", [&] { testProjection(rod); }},
        {"steps of a comb, SemiExplicit", [&] { testSteps(comb, StepDensity::SemiExplicit); }},
        {"steps of a comb, Explicit", [&] { testSteps(comb, StepDensity::Explicit); }},
        {"steps of a comb, Bounded", [&] { testSteps(comb, StepDensity::Bounded); }},
        {"steps of a rod, SemiExplicit", [&] { testSteps(rod, StepDensity::SemiExplicit); }},
        {"steps of a rod, Explicit", [&] { testSteps(rod, StepDensity::Explicit); }},
        {"dependent constraints", [&] { testDependentConstraints(comb); }},
    });
}
