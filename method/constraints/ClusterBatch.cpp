// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterBatch.h"
#include "constraints/ClusterStages.h"
#include "constraints/Pack.h"
#include "constraints/Sum.h"
#include "constraints/Wide.h"
#include <algorithm>
#include <array>
#include <limits>
#include <map>
#include <tuple>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

/** Bonds from particle 0 to each of the others: a diatomic, or CH_n. */
template <int NumBonds> struct Star {
    static constexpr int numBonds = NumBonds;
    static constexpr int numParticles = NumBonds + 1;
    static constexpr int first(int) {
        return 0;
    }
    static constexpr int second(int bond) {
        return bond + 1;
    }
};

/** All three distances of three particles, such as a rigid water. */
struct Triangle {
    static constexpr int numBonds = 3;
    static constexpr int numParticles = 3;
    static constexpr int first(int bond) {
        return bond == 2 ? 1 : 0;
    }
    static constexpr int second(int bond) {
        return bond == 0 ? 1 : 2;
    }
};

/** The sign with which a particle stands in a bond: 1 first, -1 second, 0 not at all. */
template <class Topology> constexpr int signOf(int particle, int bond) {
    return Topology::first(bond) == particle ? 1 : Topology::second(bond) == particle ? -1 : 0;
}

struct PackVector {
    Pack x, y, z;
};

inline PackVector operator+(const PackVector& a, const PackVector& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
inline PackVector operator-(const PackVector& a, const PackVector& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
inline PackVector operator*(const PackVector& a, Pack s) {
    return {a.x * s, a.y * s, a.z * s};
}
inline Pack dot(const PackVector& a, const PackVector& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class Topology> class BatchOf : public ClusterBatch {
public:
    static constexpr int B = Topology::numBonds;
    static constexpr int P = Topology::numParticles;

    BatchOf(const ClusterLayout& layout, const ClusterKind& kind, int firstConstraint) :
            particles(kind.particles), firstConstraint(firstConstraint), numClusters(kind.getNumClusters()) {
        // Few packs differ in most systems: then their shapes stay in the processor's cache.
        vector<ClusterShape> given;
        std::map<ClusterShape, int> numberOf;
        vector<int> numbers;
        for (int cluster = 0; cluster < numClusters; cluster++) {
            ClusterShape shape;
            for (int i = 0; i < P; i++)
                shape.inverseMasses[i] = layout.inverseMasses[kind.getParticle(cluster, i)];
            for (int k = 0; k < B; k++)
                shape.lengths[k] = layout.distances[kind.getConstraint(cluster, k)].length;
            const auto found = numberOf.emplace(shape, (int) given.size());
            if (found.second)
                given.push_back(shape);
            numbers.push_back(found.first->second);
        }
        std::map<std::array<int, PACK_SIZE>, int> placeOf;
        for (int first = 0; first < numClusters; first += PACK_SIZE) {
            std::array<int, PACK_SIZE> pack;
            for (int lane = 0; lane < PACK_SIZE; lane++)
                pack[lane] = numbers[std::min(first + lane, numClusters - 1)];
            const auto found = placeOf.emplace(pack, (int) shapes.size());
            if (found.second) {
                shapes.emplace_back();
                for (int lane = 0; lane < PACK_SIZE; lane++)
                    fill(shapes.back(), lane, given[pack[lane]]);
            }
            shapeOfPack.push_back(found.first->second);
        }
    }

    int getSize() const override {
        return numClusters;
    }
    int findCluster(int particle) const override {
        int first = 0, end = numClusters; // by bisection
        while (first < end) {
            const int middle = (first + end) / 2;
            if (particles[(size_t) middle * P] < particle)
                first = middle + 1;
            else
                end = middle;
        }
        return std::min(numClusters, (first + PACK_SIZE - 1) / PACK_SIZE * PACK_SIZE);
    }
    const int* getParticles(int cluster) const override {
        return particles.data() + (size_t) cluster * P;
    }
    int getFirstConstraint(int cluster) const override {
        return firstConstraint + cluster * B;
    }
    double solvePositions(const StepArrays& step, int first, int end, const ChordStages& stages,
                          int& numUpdates) const override {
        return hasWideVectors() ? solveWide(step, first, end, stages, numUpdates)
                                : solve(step, first, end, stages, numUpdates);
    }
    double coupledPass(const StepArrays& step, int first, int end) const override {
        return hasWideVectors() ? passWide(step, first, end) : pass(step, first, end);
    }
    double finish(const OnStepArrays& step, int first, int end) const override {
        return hasWideVectors() ? completeWide(step, first, end) : complete(step, first, end);
    }

private:
    double solve(const StepArrays& step, int first, int end, const ChordStages& stages, int& numUpdates) const;
    OPENMMVRATTLE_WIDE double solveWide(const StepArrays& step, int first, int end, const ChordStages& stages,
                                        int& numUpdates) const {
        return solve(step, first, end, stages, numUpdates);
    }
    double pass(const StepArrays& step, int first, int end) const;
    OPENMMVRATTLE_WIDE double passWide(const StepArrays& step, int first, int end) const {
        return pass(step, first, end);
    }
    double complete(const OnStepArrays& step, int first, int end) const;
    OPENMMVRATTLE_WIDE double completeWide(const OnStepArrays& step, int first, int end) const {
        return complete(step, first, end);
    }
    /** What clusters of one topology may differ in. */
    struct ClusterShape {
        std::array<double, P> inverseMasses;
        std::array<double, B> lengths;
        bool operator<(const ClusterShape& other) const {
            return std::tie(inverseMasses, lengths) < std::tie(other.inverseMasses, other.lengths);
        }
    };
    /** Which clusters a pack holds. Where the last pack is not full its last cluster stands in all the lanes left. */
    struct Lanes {
        const int* particle[PACK_SIZE];
        int constraint[PACK_SIZE];
    };
    /** Masses and lengths of the clusters of a pack. */
    struct Shape {
        Pack inverseMass[P], squareLength[B], inverseSquareLength[B];
        Pack massCoupling[B][B]; // C of K_kl = C_kl (row_k . row_l)
    };
    /** G(q), by bonds, and K = L D L^T. */
    struct Factor {
        PackVector row[B];
        Pack lower[B][B];
        Pack inversePivot[B];
    };

    struct Clusters;
    struct FinishClusters;
    struct TrialClusters;
    struct ChordClusters;
    struct CoupledClusters;

    static void fill(Shape& shape, int lane, const ClusterShape& cluster) {
        for (int i = 0; i < P; i++)
            shape.inverseMass[i][lane] = cluster.inverseMasses[i];
        for (int k = 0; k < B; k++) {
            const double square = cluster.lengths[k] * cluster.lengths[k];
            shape.squareLength[k][lane] = square;
            shape.inverseSquareLength[k][lane] = 1 / square;
            for (int l = 0; l < B; l++) {
                double sum = 0;
                for (int i = 0; i < P; i++)
                    sum += signOf<Topology>(i, k) * signOf<Topology>(i, l) * cluster.inverseMasses[i];
                shape.massCoupling[k][l][lane] = sum;
            }
        }
    }
    const Shape& shapeOf(int cluster) const {
        return shapes[shapeOfPack[cluster / PACK_SIZE]];
    }
    Lanes lanesOf(int cluster, int end) const {
        Lanes lanes;
        for (int lane = 0; lane < PACK_SIZE; lane++) {
            int c = std::min(cluster + lane, end - 1);
            lanes.particle[lane] = &particles[(size_t) c * P];
            lanes.constraint[lane] = getFirstConstraint(c);
        }
        return lanes;
    }
    static PackVector load(const Lanes& lanes, int i, const Vec3* from) {
        const Vec3 &a = from[lanes.particle[0][i]], &b = from[lanes.particle[1][i]], &c = from[lanes.particle[2][i]],
                   &d = from[lanes.particle[3][i]];
        return {Pack{a[0], b[0], c[0], d[0]}, Pack{a[1], b[1], c[1], d[1]}, Pack{a[2], b[2], c[2], d[2]}};
    }
    static void store(const Lanes& lanes, int i, const PackVector& x, Vec3* to) {
        for (int lane = 0; lane < PACK_SIZE; lane++)
            to[lanes.particle[lane][i]] = Vec3(x.x[lane], x.y[lane], x.z[lane]);
    }
    static Pack load(const Lanes& lanes, int k, const double* from) {
        return Pack{from[lanes.constraint[0] + k], from[lanes.constraint[1] + k], from[lanes.constraint[2] + k],
                    from[lanes.constraint[3] + k]};
    }
    static void store(const Lanes& lanes, int k, Pack x, double* to) {
        for (int lane = 0; lane < PACK_SIZE; lane++)
            to[lanes.constraint[lane] + k] = x[lane];
    }
    static PackVector bondOf(const PackVector* x, int k) {
        return x[Topology::first(k)] - x[Topology::second(k)];
    }
    /** The largest size of some numbers, or a NaN if there is one. */
    static double largestOf(const Pack* x) {
        Pack largest = packOf(0);
        for (int k = 0; k < B; k++)
            largest = largerSize(largest, x[k]);
        double result = 0;
        for (int lane = 0; lane < PACK_SIZE; lane++)
            result = largerOf(result, largest[lane]);
        return result;
    }

    /** Rows and factor of K at bond vectors r. */
    static void factorize(const Shape& shape, const PackVector* r, Factor& factor);
    /** The smallest D_k/K_kk of a factor. */
    static void keepSmallestPivot(const Shape& shape, const Factor& factor, double& smallest);
    static void solve(const Factor& factor, Pack* x);
    /** J_kl = C_kl (G(q+)_k . G(q)_l), the matrix of Newton's iteration at the bond vectors next, as L U. */
    struct NewtonFactor {
        Pack lower[B][B], upper[B][B], inversePivot[B];
    };
    static void factorizeNewton(const Shape& shape, const PackVector* next, const Factor& rows, NewtonFactor& factor);
    static void solve(const NewtonFactor& factor, Pack* x);
    /** result_k = bonds_k + scale sum_l C_kl x_l row_l: what the motion M^-1 G^T x adds to bond vectors. */
    static void addConstraintBonds(const Shape& shape, const Factor& factor, const Pack* x, Pack scale,
                                   const PackVector* bonds, PackVector* result);
    /** x_i += scale / mass * (G^T x)_i */
    static void addConstraintForces(const Shape& shape, const Factor& factor, const Pack* x, Pack scale,
                                    PackVector* particleVectors);
    /** g = (|r|^2 - L^2)/(2 L^2). */
    static void evaluate(const Shape& shape, const PackVector* r, Pack* g) {
        for (int k = 0; k < B; k++)
            g[k] = packOf(0.5) * (dot(r[k], r[k]) - shape.squareLength[k]) * shape.inverseSquareLength[k];
    }

    vector<int> particles;
    int firstConstraint, numClusters;
    vector<Shape> shapes; // that occur
    vector<int> shapeOfPack;
};

template <class Topology> void BatchOf<Topology>::factorize(const Shape& shape, const PackVector* r, Factor& factor) {
    for (int k = 0; k < B; k++)
        factor.row[k] = r[k] * shape.inverseSquareLength[k];
    for (int j = 0; j < B; j++) {
        Pack scaled[B]; // L_jk D_k
        Pack pivot = shape.massCoupling[j][j] * dot(factor.row[j], factor.row[j]);
        for (int k = 0; k < j; k++) {
            scaled[k] = shape.massCoupling[j][k] * dot(factor.row[j], factor.row[k]);
            for (int l = 0; l < k; l++)
                scaled[k] -= scaled[l] * factor.lower[k][l];
        }
        for (int k = 0; k < j; k++) {
            factor.lower[j][k] = scaled[k] * factor.inversePivot[k];
            pivot -= scaled[k] * factor.lower[j][k];
        }
        factor.inversePivot[j] = packOf(1) / pivot;
    }
}

template <class Topology>
void BatchOf<Topology>::keepSmallestPivot(const Shape& shape, const Factor& factor, double& smallest) {
    for (int k = 0; k < B; k++) {
        Pack inverse = factor.inversePivot[k] * shape.massCoupling[k][k] * dot(factor.row[k], factor.row[k]);
        for (int lane = 0; lane < PACK_SIZE; lane++)
            smallest = smallerOf(smallest, 1 / inverse[lane]);
    }
}

template <class Topology> void BatchOf<Topology>::solve(const Factor& factor, Pack* x) {
    for (int i = 1; i < B; i++)
        for (int k = 0; k < i; k++)
            x[i] -= factor.lower[i][k] * x[k];
    for (int i = 0; i < B; i++)
        x[i] = x[i] * factor.inversePivot[i];
    for (int i = B - 1; i > 0; i--)
        for (int k = 0; k < i; k++)
            x[k] -= factor.lower[i][k] * x[i];
}

template <class Topology>
void BatchOf<Topology>::factorizeNewton(const Shape& shape, const PackVector* next, const Factor& rows,
                                        NewtonFactor& factor) {
    Pack a[B][B];
    for (int k = 0; k < B; k++)
        for (int l = 0; l < B; l++)
            a[k][l] = shape.massCoupling[k][l] * shape.inverseSquareLength[k] * dot(next[k], rows.row[l]);
    for (int j = 0; j < B; j++) {
        factor.inversePivot[j] = packOf(1) / a[j][j];
        for (int k = j + 1; k < B; k++) {
            factor.upper[j][k] = a[j][k];
            factor.lower[k][j] = a[k][j] * factor.inversePivot[j];
            for (int l = j + 1; l < B; l++)
                a[k][l] -= factor.lower[k][j] * a[j][l];
        }
    }
}

template <class Topology> void BatchOf<Topology>::solve(const NewtonFactor& factor, Pack* x) {
    for (int i = 1; i < B; i++)
        for (int k = 0; k < i; k++)
            x[i] -= factor.lower[i][k] * x[k];
    for (int i = B - 1; i >= 0; i--) {
        for (int k = i + 1; k < B; k++)
            x[i] -= factor.upper[i][k] * x[k];
        x[i] = x[i] * factor.inversePivot[i];
    }
}

template <class Topology>
void BatchOf<Topology>::addConstraintBonds(const Shape& shape, const Factor& factor, const Pack* x, Pack scale,
                                           const PackVector* bonds, PackVector* result) {
    PackVector force[B];
    for (int l = 0; l < B; l++)
        force[l] = factor.row[l] * (scale * x[l]);
    for (int k = 0; k < B; k++) {
        PackVector sum = bonds[k];
        for (int l = 0; l < B; l++)
            sum = sum + force[l] * shape.massCoupling[k][l];
        result[k] = sum;
    }
}

template <class Topology>
void BatchOf<Topology>::addConstraintForces(const Shape& shape, const Factor& factor, const Pack* x, Pack scale,
                                            PackVector* particleVectors) {
    for (int k = 0; k < B; k++) {
        const PackVector force = factor.row[k] * (scale * x[k]);
        const int i = Topology::first(k), j = Topology::second(k);
        particleVectors[i] = particleVectors[i] + force * shape.inverseMass[i];
        particleVectors[j] = particleVectors[j] - force * shape.inverseMass[j];
    }
}

/** A pack of clusters with the algebra of their constraints, in registers; what the stages of a pass work on. */
template <class Topology> struct BatchOf<Topology>::Clusters {
    Clusters(const BatchOf& batch, int first, int end, const Vec3* positions) :
            lanes(batch.lanesOf(first, end)), shape(batch.shapeOf(first)) {
        load(positions, q);
        forConstraints([&](int k) { r[k] = bondOf(q, k); });
    }
    template <class Task> static void forParticles(const Task& task) {
        for (int i = 0; i < P; i++)
            task(i);
    }
    template <class Task> static void forConstraints(const Task& task) {
        for (int k = 0; k < B; k++)
            task(k);
    }
    void load(const Vec3* from, PackVector* to) const {
        forParticles([&](int i) { to[i] = BatchOf::load(lanes, i, from); });
    }
    void load(const double* from, Pack* to) const {
        forConstraints([&](int k) { to[k] = BatchOf::load(lanes, k, from); });
    }
    void store(const PackVector* from, Vec3* to) const {
        forParticles([&](int i) { BatchOf::store(lanes, i, from[i], to); });
    }
    void store(const Pack* from, double* to) const {
        forConstraints([&](int k) { BatchOf::store(lanes, k, from[k], to); });
    }
    void multiply(const PackVector* w, Pack* x) const {
        forConstraints([&](int k) { x[k] = dot(factor.row[k], bondOf(w, k)); });
    }
    void addTransposedOverMass(const Pack* x, double scale, PackVector* result) const {
        addConstraintForces(shape, factor, x, packOf(scale), result);
    }
    void solve(Pack* x) const {
        BatchOf::solve(factor, x);
    }
    const Lanes lanes;
    const Shape& shape;
    Factor factor;
    PackVector q[P], r[B];
};

template <class Topology> struct BatchOf<Topology>::FinishClusters : Clusters {
    FinishClusters(const BatchOf& batch, int first, int end, const OnStepArrays& step) :
            Clusters(batch, first, end, step.q), kick(packOf(step.kick)), hasHalfStep(step.lambdaHalf != nullptr),
            hasNetAccelerations(step.acceleration != nullptr) {
        this->load(step.w, w);
        this->load(step.force, netAccelerations);
        this->forParticles([&](int i) { netAccelerations[i] = netAccelerations[i] * this->shape.inverseMass[i]; });
        factorize(this->shape, this->r, this->factor);
    }
    const PackVector& getAcceleration(int i) const {
        return netAccelerations[i]; // until the constraints' are added, in the end
    }
    void multiplyAccelerations(Pack* x) const {
        this->multiply(netAccelerations, x);
    }
    void addParameterMotion(Pack*) const { // distances have no parameters that move
    }
    void evaluateCurvature(const PackVector* velocities, Pack* x) const {
        this->forConstraints([&](int k) {
            const PackVector velocity = bondOf(velocities, k);
            x[k] = dot(velocity, velocity) * this->shape.inverseSquareLength[k];
        });
    }
    void store(const OnStepArrays& step) const {
        Clusters::store(v, step.v);
        Clusters::store(rightSide, step.rightSide);
        Clusters::store(multipliers, step.lambda);
        if (hasNetAccelerations)
            Clusters::store(netAccelerations, step.acceleration);
        if (hasHalfStep) {
            Clusters::store(halfRightSide, step.rightSideHalf);
            Clusters::store(halfMultipliers, step.lambdaHalf);
        }
    }
    const Pack kick;
    const bool hasHalfStep, hasNetAccelerations;
    PackVector w[P], v[P], netAccelerations[P];
    Pack change[B], applied[B], rightSide[B], multipliers[B], halfRightSide[B], halfMultipliers[B];
};

/** The numbers of a trial, the same for all packs. */
struct Scales {
    explicit Scales(const StepArrays& step) :
            kick(packOf(step.kick)), drift(packOf(step.drift)), inverseDrift(packOf(1 / step.drift)),
            forward(packOf(-step.kick * step.drift)), backward(packOf(1 / (step.kick * step.drift))) {
    }
    const Pack kick, drift, inverseDrift;
    const Pack forward, backward; // from a change of lambda to that of g, and back
};

/** Those of a trial, which is followed bond by bond: next is where it leads. */
template <class Topology> struct BatchOf<Topology>::TrialClusters : Clusters {
    TrialClusters(const BatchOf& batch, int first, int end, const StepArrays& step, const Scales& scales) :
            Clusters(batch, first, end, step.q), scales(scales) {
        this->load(step.start, w);
        this->load(step.lambda, lambda);
    }
    /** When w is what it is without constraints. */
    void beginBonds() {
        this->forConstraints([&](int k) { unconstrained[k] = this->r[k] + bondOf(w, k) * scales.drift; });
    }
    void move(bool) {
        addConstraintBonds(this->shape, this->factor, lambda, scales.forward, unconstrained, next);
    }
    double evaluate(Pack* g) const {
        BatchOf::evaluate(this->shape, next, g);
        return largestOf(g);
    }
    Pack toUpdate(Pack x) const {
        return x * scales.backward;
    }
    void store(const StepArrays& step) {
        addConstraintForces(this->shape, this->factor, lambda, -scales.kick, w);
        Clusters::store(w, step.wNext);
        this->forParticles(
            [&](int i) { BatchOf::store(this->lanes, i, this->q[i] + w[i] * scales.drift, step.qNext); });
        Clusters::store(lambda, step.lambda);
    }
    const Scales& scales;
    PackVector w[P], unconstrained[B], next[B];
    Pack lambda[B], change[B];
};

/** Their matrix is Newton's at the guess. */
template <class Topology> struct BatchOf<Topology>::ChordClusters : TrialClusters {
    ChordClusters(const BatchOf& batch, int first, int end, const StepArrays& step, const Scales& scales) :
            TrialClusters(batch, first, end, step, scales), isFactorized(false) {
        if (step.force != nullptr)
            this->forParticles([&](int i) {
                this->w[i] =
                    this->w[i] + BatchOf::load(this->lanes, i, step.force) * (scales.kick * this->shape.inverseMass[i]);
            });
        this->forConstraints([&](int k) { this->factor.row[k] = this->r[k] * this->shape.inverseSquareLength[k]; });
        this->beginBonds();
    }
    void solve(Pack* x) {
        if (!isFactorized)
            factorizeNewton(this->shape, this->next, this->factor, newtonFactor);
        isFactorized = true;
        BatchOf::solve(newtonFactor, x);
    }
    NewtonFactor newtonFactor;
    bool isFactorized;
};

template <class Topology> struct BatchOf<Topology>::CoupledClusters : TrialClusters {
    CoupledClusters(const BatchOf& batch, int first, int end, const StepArrays& step, const Scales& scales) :
            TrialClusters(batch, first, end, step, scales) {
        PackVector accelerations[P];
        this->load(step.force, accelerations);
        this->forParticles([&](int i) {
            accelerations[i] = accelerations[i] * this->shape.inverseMass[i];
            this->w[i] = this->w[i] + accelerations[i] * scales.kick;
        });
        this->beginBonds();
        factorize(this->shape, this->r, this->factor);
        this->multiply(accelerations, applied);
        this->load(step.change, this->change);
    }
    // Of w+, which is known by its bonds.
    void evaluateCurvature(Pack* x) const {
        this->forConstraints([&](int k) {
            const PackVector velocity = (this->next[k] - this->r[k]) * this->scales.inverseDrift;
            x[k] = dot(velocity, velocity) * this->shape.inverseSquareLength[k];
        });
    }
    void store(const StepArrays& step) {
        TrialClusters::store(step);
        Clusters::store(rightSide, step.rightSidePlus);
        Clusters::store(multipliers, step.lambdaPlus);
        this->forConstraints([&](int k) { this->change[k] = this->toUpdate(this->change[k]); });
        Clusters::store(this->change, step.change);
    }
    Pack applied[B], rightSide[B], multipliers[B];
};

template <class Topology>
double BatchOf<Topology>::solve(const StepArrays& step, int first, int end, const ChordStages& stages,
                                int& numUpdates) const {
    const Scales scales(step);
    double worst = 0;
    for (int cluster = first; cluster < end; cluster += PACK_SIZE) {
        ChordClusters clusters(*this, cluster, end, step, scales);
        const StagesResult result = runStages(stages, clusters);
        worst = largerOf(worst, result.error);
        numUpdates = std::max(numUpdates, result.stage);
        clusters.store(step);
    }
    return worst;
}

template <class Topology> double BatchOf<Topology>::pass(const StepArrays& step, int first, int end) const {
    const Scales scales(step);
    const CoupledStages stages;
    double worst = 0;
    for (int cluster = first; cluster < end; cluster += PACK_SIZE) {
        CoupledClusters clusters(*this, cluster, end, step, scales);
        stages.prepare(clusters);
        worst = largerOf(worst, runStages(stages, clusters).error);
        clusters.store(step);
    }
    return worst;
}

template <class Topology> double BatchOf<Topology>::complete(const OnStepArrays& step, int first, int end) const {
    double smallestPivot = std::numeric_limits<double>::infinity();
    for (int cluster = first; cluster < end; cluster += PACK_SIZE) {
        FinishClusters clusters(*this, cluster, end, step);
        keepSmallestPivot(clusters.shape, clusters.factor, smallestPivot);
        runStages(FinishStages(), clusters);
        clusters.store(step);
    }
    return smallestPivot;
}

/** The batch, where the topology is that of the kind: pairs of particles, the first one the earlier place. */
template <class Topology>
std::unique_ptr<ClusterBatch> createIf(const ClusterLayout& layout, const ClusterKind& kind, int firstConstraint) {
    vector<vector<int>> pairs;
    for (int k = 0; k < Topology::numBonds; k++)
        pairs.push_back({Topology::first(k), Topology::second(k)});
    if (kind.hasExpressions || kind.particlesOf != pairs)
        return nullptr;
    return std::unique_ptr<ClusterBatch>(new BatchOf<Topology>(layout, kind, firstConstraint));
}

} // namespace

std::unique_ptr<ClusterBatch> ClusterBatch::create(const ClusterLayout& layout, const ClusterKind& kind,
                                                   int firstConstraint) {
    for (auto create : {createIf<Star<1>>, createIf<Star<2>>, createIf<Star<3>>, createIf<Star<4>>, createIf<Triangle>})
        if (auto batch = create(layout, kind, firstConstraint))
            return batch;
    return nullptr;
}
