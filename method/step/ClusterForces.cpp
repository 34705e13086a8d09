// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/ClusterForces.h"
#include "constraints/StepFailure.h"
#include <algorithm>
#include <cmath>
#include <numeric>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

ClusterForces::ClusterForces(ConstraintSolver& solver) :
        solver(solver), numClusters((int) solver.getSystem().getClusters().size()) {
    const ConstraintSystem& system = solver.getSystem();
    vector<int> clusters(system.getNumParticles(), -1);
    for (int c = 0; c < numClusters; c++)
        for (int i : system.getClusterParticles(c))
            clusters[i] = c;
    for (int i : solver.getMovingParticles())
        if (clusters[i] < 0)
            clusters[i] = numClusters++;
    firstParticles.assign(numClusters + 1, 0);
    for (int i : solver.getMovingParticles())
        firstParticles[clusters[i] + 1]++;
    std::partial_sum(firstParticles.begin(), firstParticles.end(), firstParticles.begin());
    particles.resize(solver.getMovingParticles().size());
    vector<int> place = firstParticles;
    for (int i : solver.getMovingParticles())
        particles[place[clusters[i]]++] = i;
    heads.resize(SharedWork::getNumRanges((int) particles.size()));
    netForces.resize(system.getNumParticles());
}

const vector<Vec3>& ClusterForces::findNetForces(const vector<Vec3>& positions, const ExpressionParameters& parameters,
                                                 const vector<Vec3>& forces, const vector<double>& multipliers) {
    solver.share((int) forces.size(), [&](int first, int end) {
        std::copy(forces.begin() + first, forces.begin() + end, netForces.begin() + first);
    });
    solver.subtractConstraintForces(positions, parameters, multipliers, netForces);
    return netForces;
}

std::string ClusterForces::describe(int cluster) const {
    const vector<int> members(particles.begin() + firstParticles[cluster],
                              particles.begin() + firstParticles[cluster + 1]);
    return (members.size() == 1 ? "" : "the cluster of ") + listParticles(members, 4);
}

double ClusterForces::eighthRootOfFourthPowers(const vector<double>& x) const {
    const double sum = solver.sum((int) x.size(), [&](int c) { return (x[c] * x[c]) * (x[c] * x[c]); });
    return std::sqrt(std::sqrt(std::sqrt(sum)));
}
