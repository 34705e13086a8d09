// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ClusterKinds.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <string>

using namespace OpenMMVRattle;
using std::pair;
using std::vector;

namespace {

struct Bond {
    int particle1, particle2, constraint;
    double length;
};

// The root of a particle's cluster in a forest of particles, whose paths get shorter with use.
int findRoot(vector<int>& parents, int particle) {
    while (parents[particle] != particle)
        particle = parents[particle] = parents[parents[particle]];
    return particle;
}

} // namespace

ClusterKinds::ClusterKinds(const OpenMM::System& system, const vector<char>& areElsewhere) {
    const int numParticles = system.getNumParticles();
    auto isHere = [&](int i) { return system.getParticleMass(i) != 0 && (areElsewhere.empty() || !areElsewhere[i]); };
    vector<int> parents(numParticles), degrees(numParticles, 0);
    std::iota(parents.begin(), parents.end(), 0);
    vector<Bond> bonds;
    for (int k = 0; k < system.getNumConstraints(); k++) {
        Bond bond;
        bond.constraint = k;
        system.getConstraintParameters(k, bond.particle1, bond.particle2, bond.length);
        if (!isHere(bond.particle1) || !isHere(bond.particle2))
            continue; // OpenMM allows it between two massless particles, which nobody moves
        parents[findRoot(parents, bond.particle1)] = findRoot(parents, bond.particle2);
        degrees[bond.particle1]++;
        degrees[bond.particle2]++;
        bonds.push_back(bond);
    }
    std::map<int, pair<vector<int>, vector<Bond>>> clusters;
    for (int i = 0; i < numParticles; i++)
        if (isHere(i))
            clusters[findRoot(parents, i)].first.push_back(i);
    for (const Bond& bond : bonds)
        clusters[findRoot(parents, bond.particle1)].second.push_back(bond);

    std::map<pair<int, vector<pair<int, int>>>, ClusterKind> found;
    vector<int> places(numParticles); // in its cluster
    for (auto& entry : clusters) {
        vector<int>& atoms = entry.second.first;
        // Particles with more bonds first, so that equal molecules written in another order are mostly of one kind.
        std::stable_sort(atoms.begin(), atoms.end(), [&](int a, int b) { return degrees[a] > degrees[b]; });
        for (size_t i = 0; i < atoms.size(); i++)
            places[atoms[i]] = (int) i;
        vector<std::tuple<int, int, int, double>> sorted;
        for (const Bond& bond : entry.second.second) {
            const int a = places[bond.particle1], b = places[bond.particle2];
            sorted.emplace_back(std::min(a, b), std::max(a, b), bond.constraint, bond.length);
        }
        std::sort(sorted.begin(), sorted.end());
        vector<pair<int, int>> pairs;
        vector<double> lengths;
        vector<int> constraints;
        for (const auto& bond : sorted) {
            pairs.emplace_back(std::get<0>(bond), std::get<1>(bond));
            constraints.push_back(std::get<2>(bond));
            lengths.push_back(std::get<3>(bond));
        }
        ClusterKind& kind = found[{(int) atoms.size(), pairs}];
        kind.numAtoms = (int) atoms.size();
        kind.pairs = pairs;
        kind.atoms.push_back(atoms);
        kind.lengths.push_back(lengths);
        kind.constraints.push_back(constraints);
    }
    for (auto& entry : found)
        ((int) entry.second.pairs.size() > MAX_CONSTRAINTS ? large : small).push_back(std::move(entry.second));
    for (vector<ClusterKind>* kinds : {&small, &large})
        std::stable_sort(kinds->begin(), kinds->end(),
                         [](const ClusterKind& a, const ClusterKind& b) { return a.pairs.size() > b.pairs.size(); });
}
