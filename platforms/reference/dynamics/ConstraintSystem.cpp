// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ConstraintSystem.h"
#include <algorithm>
#include <cmath>
#include <numeric>
#include <set>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

ConstraintSystem::ConstraintSystem(const vector<double>& masses, const vector<DistanceConstraint>& given) :
        numGivenConstraints((int) given.size()), masses(masses), inverseMasses(masses.size()) {
    for (size_t i = 0; i < masses.size(); i++)
        inverseMasses[i] = masses[i] > 0 ? 1.0 / masses[i] : 0.0;
    vector<int> active;
    for (int k = 0; k < (int) given.size(); k++)
        if (inverseMasses[given[k].particle1] + inverseMasses[given[k].particle2] > 0)
            active.push_back(k);
    findClusters(given, active);
    findCouplings();
    for (const DistanceConstraint& c : constraints) {
        inverseSquareLengths.push_back(1.0 / (c.length * c.length));
        distanceMultiplierFactors.push_back(0.5 / (c.length * c.length));
    }
}

// Constraints that share a moving particle belong to one cluster (union-find over the particles).
void ConstraintSystem::findClusters(const vector<DistanceConstraint>& given, const vector<int>& active) {
    vector<int> parent(masses.size());
    std::iota(parent.begin(), parent.end(), 0);
    auto find = [&](int i) {
        while (parent[i] != i) {
            parent[i] = parent[parent[i]];
            i = parent[i];
        }
        return i;
    };
    auto movingParticle = [&](int k) {
        return inverseMasses[given[k].particle1] > 0 ? given[k].particle1 : given[k].particle2;
    };
    for (int k : active)
        if (inverseMasses[given[k].particle1] > 0 && inverseMasses[given[k].particle2] > 0)
            parent[find(given[k].particle1)] = find(given[k].particle2);
    vector<int> clusterOfRoot(masses.size(), -1), clusterOfConstraint(given.size(), -1);
    for (int k : active) {
        int root = find(movingParticle(k));
        if (clusterOfRoot[root] < 0) {
            clusterOfRoot[root] = (int) clusters.size();
            clusters.push_back({0, 0});
        }
        clusterOfConstraint[k] = clusterOfRoot[root];
        clusters[clusterOfRoot[root]].size++;
    }
    for (size_t c = 1; c < clusters.size(); c++)
        clusters[c].first = clusters[c - 1].first + clusters[c - 1].size;
    vector<int> next;
    for (const Cluster& cluster : clusters)
        next.push_back(cluster.first);
    constraints.resize(active.size());
    givenIndex.resize(active.size());
    for (int k : active) {
        int position = next[clusterOfConstraint[k]]++;
        constraints[position] = given[k];
        givenIndex[position] = k;
    }
}

void ConstraintSystem::findCouplings() {
    struct End {
        int constraint, sign;
    };
    vector<vector<End>> ends(masses.size());
    for (int k = 0; k < getNumConstraints(); k++) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        couplings.push_back({k, k, inverseMasses[i] + inverseMasses[j]});
        if (inverseMasses[i] > 0)
            ends[i].push_back({k, 1});
        if (inverseMasses[j] > 0)
            ends[j].push_back({k, -1});
    }
    for (size_t p = 0; p < ends.size(); p++)
        for (size_t a = 0; a < ends[p].size(); a++)
            for (size_t b = 0; b < a; b++) {
                int row = std::max(ends[p][a].constraint, ends[p][b].constraint);
                int column = std::min(ends[p][a].constraint, ends[p][b].constraint);
                couplings.push_back({row, column, ends[p][a].sign * ends[p][b].sign * inverseMasses[p]});
            }
    std::stable_sort(couplings.begin(), couplings.end(), [](const Coupling& a, const Coupling& b) {
        return a.row != b.row ? a.row < b.row : a.column < b.column;
    });
}

vector<int> ConstraintSystem::getClusterParticles(int cluster) const {
    std::set<int> particles;
    for (int k = clusters[cluster].first; k < clusters[cluster].first + clusters[cluster].size; k++) {
        particles.insert(constraints[k].particle1);
        particles.insert(constraints[k].particle2);
    }
    return vector<int>(particles.begin(), particles.end());
}

double ConstraintSystem::evaluate(const vector<Vec3>& q, vector<double>& g) const {
    double largest = 0;
    for (int k = 0; k < getNumConstraints(); k++) {
        Vec3 r = q[constraints[k].particle1] - q[constraints[k].particle2];
        double length = constraints[k].length;
        g[k] = 0.5 * (r.dot(r) - length * length) * inverseSquareLengths[k];
        double size = std::fabs(g[k]);
        if (std::isnan(size))
            return size;
        largest = std::max(largest, size);
    }
    return largest;
}

int ConstraintSystem::findLargest(const vector<double>& g) const {
    int largest = 0;
    for (int k = 1; k < getNumConstraints(); k++)
        if (!(std::fabs(g[k]) <= std::fabs(g[largest])))
            largest = k;
    return largest;
}

void ConstraintSystem::evaluateJacobian(const vector<Vec3>& x, Jacobian& jacobian) const {
    for (int k = 0; k < getNumConstraints(); k++)
        jacobian[k] = (x[constraints[k].particle1] - x[constraints[k].particle2]) * inverseSquareLengths[k];
}

void ConstraintSystem::multiply(const Jacobian& jacobian, const vector<Vec3>& w, vector<double>& result) const {
    for (int k = 0; k < getNumConstraints(); k++)
        result[k] = jacobian[k].dot(w[constraints[k].particle1] - w[constraints[k].particle2]);
}

void ConstraintSystem::multiplyOverMass(const Jacobian& jacobian, const vector<Vec3>& f, vector<double>& result) const {
    for (int k = 0; k < getNumConstraints(); k++) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        result[k] = jacobian[k].dot(f[i] * inverseMasses[i] - f[j] * inverseMasses[j]);
    }
}

void ConstraintSystem::addTransposed(const Jacobian& jacobian, const vector<double>& x, vector<Vec3>& result) const {
    for (int k = 0; k < getNumConstraints(); k++) {
        Vec3 force = jacobian[k] * x[k];
        result[constraints[k].particle1] += force;
        result[constraints[k].particle2] -= force;
    }
}

void ConstraintSystem::addTransposedOverMass(const Jacobian& jacobian, const vector<double>& x, double scale,
                                             vector<Vec3>& result) const {
    for (int k = 0; k < getNumConstraints(); k++) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        Vec3 force = jacobian[k] * (scale * x[k]);
        result[i] += force * inverseMasses[i];
        result[j] -= force * inverseMasses[j];
    }
}

void ConstraintSystem::evaluateCurvature(const vector<Vec3>& v, vector<double>& result) const {
    for (int k = 0; k < getNumConstraints(); k++) {
        Vec3 w = v[constraints[k].particle1] - v[constraints[k].particle2];
        result[k] = w.dot(w) * inverseSquareLengths[k];
    }
}

void ConstraintSystem::getDistanceMultipliers(const vector<double>& multipliers, vector<double>& result) const {
    result.assign(numGivenConstraints, 0.0);
    for (int k = 0; k < getNumConstraints(); k++)
        result[givenIndex[k]] = multipliers[k] * distanceMultiplierFactors[k];
}
