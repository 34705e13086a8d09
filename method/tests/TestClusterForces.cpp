// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Sums over clusters of all sizes against a plain walk through the constraints.

#include "Examples.h"
#include "TestSupport.h"
#include "step/ClusterForces.h"
#include <algorithm>
#include <numeric>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Each cluster's smallest particle, found by handing it on until nothing changes.
vector<int> findSmallest(const Example& e) {
    vector<int> smallest(e.masses.size());
    std::iota(smallest.begin(), smallest.end(), 0);
    for (bool isChanged = true; isChanged;) {
        isChanged = false;
        for (const DistanceConstraint& c : e.distances) {
            int &a = smallest[c.particle1], &b = smallest[c.particle2];
            isChanged = isChanged || a != b;
            a = b = std::min(a, b);
        }
    }
    return smallest;
}

void testSums() {
    // A chain over several ranges of particles, others that begin within one, waters and free particles; one that does not move.
    Example e;
    for (int bonds : {2500, 700, 1100, 3}) {
        int last = e.add(14, Vec3(0, (double) e.masses.size(), 0));
        for (int i = 1; i <= bonds; i++) {
            const int next = e.add(14, e.positions[last] + Vec3(0.12, 0.05 * (i % 2), 0));
            e.join(last, next);
            last = next;
        }
        for (int i = 0; i < 20; i++) {
            e.addWater(Vec3(i, -5, 0));
            e.add(i == 7 ? 0 : 40, Vec3(i, -20, 0));
        }
    }
    vector<double> terms;
    for (size_t i = 0; i < e.masses.size(); i++)
        terms.push_back(std::floor(e.uniform(0, 1000))); // sums of integers are exact in any order
    const vector<int> smallest = findSmallest(e);
    vector<double> expected(e.masses.size(), 0.0), sorted;
    for (size_t i = 0; i < e.masses.size(); i++)
        expected[smallest[i]] += e.masses[i] > 0 ? terms[i] : 0.0;
    for (size_t i = 0; i < e.masses.size(); i++)
        if (smallest[i] == (int) i && e.masses[i] > 0)
            sorted.push_back(expected[i]);
    std::sort(sorted.begin(), sorted.end());

    for (int numThreads : {1, 3}) {
        ConstraintSolver solver(e.masses, e.distances);
        int calls = 0;
        solver.setParallel(runInReverse(numThreads, calls), numThreads);
        ClusterForces clusters(solver);
        vector<double> sums(clusters.getNumClusters(), NAN);
        clusters.sumOverClusters([&](int i) { return terms[i]; }, sums);
        ASSERT((calls > 0) == (numThreads > 1));
        std::sort(sums.begin(), sums.end());
        ASSERT(sums == sorted);
    }
}

} // namespace

int main() {
    return runTests({{"sums over clusters", testSums}});
}
