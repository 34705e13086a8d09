// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/ClusterForces.h"
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
    for (int i : solver.getMovingParticles()) {
        if (clusters[i] < 0)
            clusters[i] = numClusters++;
        clusterOfParticle.push_back(clusters[i]);
    }
    firstParticles.assign(numClusters + 1, 0);
    for (int c : clusterOfParticle)
        firstParticles[c + 1]++;
    std::partial_sum(firstParticles.begin(), firstParticles.end(), firstParticles.begin());
    particles.resize(clusterOfParticle.size() + 1); // one more, so that the end of all has an address
    vector<int> place = firstParticles;
    for (size_t p = 0; p < clusterOfParticle.size(); p++)
        particles[place[clusterOfParticle[p]]++] = solver.getMovingParticles()[p];
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
    const size_t maxListed = 4;
    vector<int> particles;
    for (size_t p = 0; p < clusterOfParticle.size(); p++)
        if (clusterOfParticle[p] == cluster)
            particles.push_back(solver.getMovingParticles()[p]);
    if (particles.size() == 1)
        return "particle " + std::to_string(particles[0]);
    std::string text = "the cluster of the particles ";
    for (size_t i = 0; i < particles.size() && i < maxListed; i++)
        text += (i == 0 ? "" : i + 1 == particles.size() ? " and " : ", ") + std::to_string(particles[i]);
    if (particles.size() > maxListed)
        text += ", ... (" + std::to_string(particles.size()) + " in all)";
    return text;
}

double ClusterForces::eighthRootOfFourthPowers(const vector<double>& x) const {
    const double sum = solver.sum((int) x.size(), [&](int c) { return (x[c] * x[c]) * (x[c] * x[c]); });
    return std::sqrt(std::sqrt(std::sqrt(sum)));
}
