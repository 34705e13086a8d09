// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterBatch.h"
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
    double solvePositions(const StepArrays& step, int first, int end, const ChordIteration& iteration,
                          int& numUpdates) const override {
        return hasWideVectors() ? solveWide(step, first, end, iteration, numUpdates)
                                : solve(step, first, end, iteration, numUpdates);
    }
    double coupledPass(const StepArrays& step, int first, int end) const override {
        return hasWideVectors() ? passWide(step, first, end) : pass(step, first, end);
    }
    double finish(const OnStepArrays& step, int first, int end) const override {
        return hasWideVectors() ? completeWide(step, first, end) : complete(step, first, end);
    }

private:
    double solve(const StepArrays& step, int first, int end, const ChordIteration& iteration, int& numUpdates) const;
    OPENMMVRATTLE_WIDE double solveWide(const StepArrays& step, int first, int end, const ChordIteration& iteration,
                                        int& numUpdates) const {
        return solve(step, first, end, iteration, numUpdates);
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
    /** result_k = sum_l C_kl x_l row_l: the bond vectors of M^-1 G^T x. */
    static void addConstraintBonds(const Shape& shape, const Factor& factor, const Pack* x, Pack scale,
                                   PackVector* bonds);
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
                                           PackVector* bonds) {
    PackVector force[B];
    for (int l = 0; l < B; l++)
        force[l] = factor.row[l] * (scale * x[l]);
    for (int k = 0; k < B; k++)
        for (int l = 0; l < B; l++)
            bonds[k] = bonds[k] + force[l] * shape.massCoupling[k][l];
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

template <class Topology>
double BatchOf<Topology>::solve(const StepArrays& step, int first, int end, const ChordIteration& iteration,
                                int& numUpdates) const {
    const Pack kick = packOf(step.kick), drift = packOf(step.drift);
    const Pack scale = packOf(-step.kick * step.drift), inverseScale = packOf(1 / (step.kick * step.drift));
    double worst = 0;
    for (int cluster = first; cluster < end; cluster += PACK_SIZE) {
        const Lanes lanes = lanesOf(cluster, end);
        const Shape& shape = shapeOf(cluster);
        PackVector q[P], w[P], r[B], unconstrained[B], next[B];
        for (int i = 0; i < P; i++) {
            q[i] = load(lanes, i, step.q);
            w[i] = load(lanes, i, step.start);
            if (step.force != nullptr)
                w[i] = w[i] + load(lanes, i, step.force) * (kick * shape.inverseMass[i]);
        }
        for (int k = 0; k < B; k++) {
            r[k] = bondOf(q, k);
            unconstrained[k] = r[k] + bondOf(w, k) * drift;
        }
        Factor rows;
        for (int k = 0; k < B; k++)
            rows.row[k] = r[k] * shape.inverseSquareLength[k];
        Pack lambda[B], g[B];
        for (int k = 0; k < B; k++)
            lambda[k] = load(lanes, k, step.lambda);
        NewtonFactor factor;
        double error = 0, previous = std::numeric_limits<double>::infinity();
        int updates = 0;
        while (true) {
            for (int k = 0; k < B; k++)
                next[k] = unconstrained[k];
            addConstraintBonds(shape, rows, lambda, scale, next);
            evaluate(shape, next, g);
            error = largestOf(g);
            if (iteration.isOver(updates, error, previous))
                break;
            if (updates == 0)
                factorizeNewton(shape, next, rows, factor);
            solve(factor, g);
            for (int k = 0; k < B; k++)
                lambda[k] += g[k] * inverseScale;
            previous = error;
            updates++;
        }
        numUpdates = std::max(numUpdates, updates);
        worst = largerOf(worst, error);
        addConstraintForces(shape, rows, lambda, -kick, w);
        for (int i = 0; i < P; i++) {
            store(lanes, i, w[i], step.wNext);
            store(lanes, i, q[i] + w[i] * drift, step.qNext);
        }
        for (int k = 0; k < B; k++)
            store(lanes, k, lambda[k], step.lambda);
    }
    return worst;
}

template <class Topology> double BatchOf<Topology>::pass(const StepArrays& step, int first, int end) const {
    const Pack kick = packOf(step.kick), drift = packOf(step.drift), inverseDrift = packOf(1 / step.drift);
    const Pack scale = packOf(-step.kick * step.drift), inverseScale = packOf(1 / (step.kick * step.drift));
    double worst = 0;
    for (int cluster = first; cluster < end; cluster += PACK_SIZE) {
        const Lanes lanes = lanesOf(cluster, end);
        const Shape& shape = shapeOf(cluster);
        PackVector q[P], w[P], acceleration[P], r[B], next[B];
        for (int i = 0; i < P; i++) {
            q[i] = load(lanes, i, step.q);
            acceleration[i] = load(lanes, i, step.force) * shape.inverseMass[i];
            w[i] = load(lanes, i, step.start) + acceleration[i] * kick;
        }
        for (int k = 0; k < B; k++) {
            r[k] = bondOf(q, k);
            next[k] = r[k] + bondOf(w, k) * drift;
        }
        Factor factor;
        factorize(shape, r, factor);
        Pack lambda[B], g[B], multipliers[B];
        for (int k = 0; k < B; k++) {
            lambda[k] = load(lanes, k, step.lambda) + load(lanes, k, step.change);
            store(lanes, k, lambda[k], step.lambda);
        }
        addConstraintBonds(shape, factor, lambda, scale, next);
        evaluate(shape, next, g);
        worst = largerOf(worst, largestOf(g));
        // Lambda(q, p+) = K^-1 (g''(w+,w+) + G M^-1 F)
        for (int k = 0; k < B; k++) {
            const PackVector velocity = (next[k] - r[k]) * inverseDrift;
            multipliers[k] =
                dot(velocity, velocity) * shape.inverseSquareLength[k] + dot(factor.row[k], bondOf(acceleration, k));
            store(lanes, k, multipliers[k], step.rightSidePlus);
        }
        solve(factor, multipliers);
        solve(factor, g);
        for (int k = 0; k < B; k++) {
            store(lanes, k, multipliers[k], step.lambdaPlus);
            store(lanes, k, g[k] * inverseScale, step.change);
        }
        addConstraintForces(shape, factor, lambda, -kick, w);
        for (int i = 0; i < P; i++) {
            store(lanes, i, w[i], step.wNext);
            store(lanes, i, q[i] + w[i] * drift, step.qNext);
        }
    }
    return worst;
}

template <class Topology> double BatchOf<Topology>::complete(const OnStepArrays& step, int first, int end) const {
    const Pack kick = packOf(step.kick);
    double smallestPivot = std::numeric_limits<double>::infinity();
    for (int cluster = first; cluster < end; cluster += PACK_SIZE) {
        const Lanes lanes = lanesOf(cluster, end);
        const Shape& shape = shapeOf(cluster);
        PackVector q[P], w[P], v[P], acceleration[P], r[B];
        for (int i = 0; i < P; i++) {
            q[i] = load(lanes, i, step.q);
            w[i] = load(lanes, i, step.w);
            acceleration[i] = load(lanes, i, step.force) * shape.inverseMass[i];
            v[i] = w[i] + acceleration[i] * kick;
        }
        for (int k = 0; k < B; k++)
            r[k] = bondOf(q, k);
        Factor factor;
        factorize(shape, r, factor);
        keepSmallestPivot(shape, factor, smallestPivot);
        Pack x[B], applied[B], multipliers[B];
        for (int k = 0; k < B; k++) {
            x[k] = dot(factor.row[k], bondOf(v, k));
            applied[k] = dot(factor.row[k], bondOf(acceleration, k));
        }
        solve(factor, x);
        addConstraintForces(shape, factor, x, packOf(-1), v);
        for (int i = 0; i < P; i++)
            store(lanes, i, v[i], step.v);
        for (int k = 0; k < B; k++) {
            const PackVector velocity = bondOf(v, k);
            multipliers[k] = dot(velocity, velocity) * shape.inverseSquareLength[k] + applied[k];
            store(lanes, k, multipliers[k], step.rightSide);
        }
        solve(factor, multipliers);
        for (int k = 0; k < B; k++)
            store(lanes, k, multipliers[k], step.lambda);
        if (step.acceleration != nullptr) {
            PackVector net[P];
            for (int i = 0; i < P; i++)
                net[i] = acceleration[i];
            addConstraintForces(shape, factor, multipliers, packOf(-1), net);
            for (int i = 0; i < P; i++)
                store(lanes, i, net[i], step.acceleration);
        }
        if (step.lambdaHalf == nullptr)
            continue;
        for (int k = 0; k < B; k++) {
            const PackVector velocity = bondOf(w, k);
            x[k] = dot(velocity, velocity) * shape.inverseSquareLength[k] + applied[k];
            store(lanes, k, x[k], step.rightSideHalf);
        }
        solve(factor, x);
        for (int k = 0; k < B; k++)
            store(lanes, k, x[k], step.lambdaHalf);
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
