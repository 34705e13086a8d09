// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterCut.h"
#include <algorithm>
#include <numeric>

using std::vector;

namespace OpenMMVRattle {

namespace {

// With more joints than this fraction of the constraints, what they cost eats up the gain.
const double MAX_JOINTS = 0.02;

// The constraints of each particle, particles being counted from 0, in one array.
struct Incidence {
    vector<size_t> start;
    vector<int> constraints;
};

Incidence findIncidence(const vector<vector<int>>& particlesOf, int numParticles) {
    Incidence result;
    result.start.assign(numParticles + 1, 0);
    for (const auto& list : particlesOf)
        for (int i : list)
            result.start[i + 1]++;
    for (int i = 0; i < numParticles; i++)
        result.start[i + 1] += result.start[i];
    result.constraints.resize(result.start.back());
    vector<size_t> next = result.start;
    for (size_t k = 0; k < particlesOf.size(); k++)
        for (int i : particlesOf[k])
            result.constraints[next[i]++] = (int) k;
    return result;
}

// The particles in the order of a breadth-first walk; and from which each has been reached, if that is asked for.
vector<int> walkBreadthFirst(int start, const vector<vector<int>>& particlesOf, const Incidence& incidence,
                             vector<int>* parents = nullptr) {
    vector<char> seen(incidence.start.size() - 1, false), seenConstraints(particlesOf.size(), false);
    vector<int> queue = {start};
    seen[start] = true;
    for (size_t next = 0; next < queue.size(); next++)
        for (size_t n = incidence.start[queue[next]]; n < incidence.start[queue[next] + 1]; n++) {
            const int k = incidence.constraints[n];
            if (seenConstraints[k])
                continue;
            seenConstraints[k] = true;
            for (int i : particlesOf[k])
                if (!seen[i]) {
                    seen[i] = true;
                    if (parents != nullptr)
                        (*parents)[i] = queue[next];
                    queue.push_back(i);
                }
        }
    return queue;
}

// The particles of a cluster in order; afterwards the constraints have them by their places there.
vector<int> numberParticles(vector<vector<int>>& particlesOf) {
    vector<int> particles;
    for (const auto& list : particlesOf)
        particles.insert(particles.end(), list.begin(), list.end());
    std::sort(particles.begin(), particles.end());
    particles.erase(std::unique(particles.begin(), particles.end()), particles.end());
    for (auto& list : particlesOf)
        for (int& i : list)
            i = (int) (std::lower_bound(particles.begin(), particles.end(), i) - particles.begin());
    return particles;
}

// The pieces from those of the particles.
ClusterCut collect(const vector<int>& particles, const vector<vector<int>>& particlesOf, const vector<int>& pieceOf,
                   int numPieces) {
    ClusterCut result;
    result.pieces.resize(numPieces);
    for (size_t i = 0; i < particles.size(); i++)
        result.pieces[pieceOf[i]].particles.push_back(particles[i]);
    for (size_t k = 0; k < particlesOf.size(); k++) {
        const int piece = pieceOf[particlesOf[k][0]];
        const bool isWithin =
            std::all_of(particlesOf[k].begin(), particlesOf[k].end(), [&](int i) { return pieceOf[i] == piece; });
        (isWithin ? result.pieces[piece].constraints : result.joints).push_back((int) k);
    }
    return result;
}

} // namespace

ClusterCut leaveWhole(const vector<vector<int>>& given) {
    vector<vector<int>> particlesOf = given;
    ClusterCut result;
    result.pieces.resize(1);
    result.pieces[0].particles = numberParticles(particlesOf);
    result.pieces[0].constraints.resize(given.size());
    std::iota(result.pieces[0].constraints.begin(), result.pieces[0].constraints.end(), 0);
    return result;
}

ClusterCut cutCluster(const vector<vector<int>>& given, int pieceSize) {
    const int numPieces = (int) given.size() / pieceSize;
    if (numPieces < 2)
        return ClusterCut();
    vector<vector<int>> particlesOf = given;
    const vector<int> particles = numberParticles(particlesOf);

    // From one end to the other, cut where enough particles have been passed.
    const int numParticles = (int) particles.size();
    const Incidence incidence = findIncidence(particlesOf, numParticles);
    const int end = walkBreadthFirst(0, particlesOf, incidence).back();
    const vector<int> order = walkBreadthFirst(end, particlesOf, incidence);
    vector<int> pieceOf(numParticles);
    for (size_t place = 0; place < order.size(); place++)
        pieceOf[order[place]] = (int) (place * numPieces / order.size());
    ClusterCut result = collect(particles, particlesOf, pieceOf, numPieces);
    if ((double) result.joints.size() > MAX_JOINTS * (double) given.size())
        return ClusterCut();
    return result;
}

ClusterCut cutClusterAlongTree(const vector<vector<int>>& given, int pieceSize) {
    vector<vector<int>> particlesOf = given;
    const vector<int> particles = numberParticles(particlesOf);
    const int numParticles = (int) particles.size();
    const Incidence incidence = findIncidence(particlesOf, numParticles);
    vector<int> parents(numParticles, -1);
    const int end = walkBreadthFirst(0, particlesOf, incidence).back();
    const vector<int> order = walkBreadthFirst(end, particlesOf, incidence, &parents);
    // From the leaves on: a branch that is large enough is a piece.
    vector<int> weights(numParticles, 1), heads;
    for (auto i = order.rbegin(); i != order.rend(); ++i) {
        if (weights[*i] >= pieceSize || parents[*i] < 0)
            heads.push_back(*i);
        else
            weights[parents[*i]] += weights[*i];
    }
    // What is left at the root may be little: the last branch goes with it.
    if (heads.size() > 1 && weights[heads.back()] < pieceSize / 2)
        heads.erase(heads.end() - 2);
    vector<int> pieceOf(numParticles, -1);
    for (size_t piece = 0; piece < heads.size(); piece++)
        pieceOf[heads[piece]] = (int) piece;
    for (int i : order)
        if (pieceOf[i] < 0)
            pieceOf[i] = pieceOf[parents[i]];
    return collect(particles, particlesOf, pieceOf, (int) heads.size());
}

} // namespace OpenMMVRattle
