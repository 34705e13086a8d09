// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ClusterCut.h"
#include <algorithm>

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

// The particles in the order of a breadth-first walk.
vector<int> walkBreadthFirst(int start, const vector<vector<int>>& particlesOf, const Incidence& incidence) {
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
                    queue.push_back(i);
                }
        }
    return queue;
}

} // namespace

ClusterCut cutCluster(const vector<vector<int>>& given, int pieceSize) {
    const int numPieces = (int) given.size() / pieceSize;
    if (numPieces < 2)
        return ClusterCut();
    vector<int> particles;
    for (const auto& list : given)
        particles.insert(particles.end(), list.begin(), list.end());
    std::sort(particles.begin(), particles.end());
    particles.erase(std::unique(particles.begin(), particles.end()), particles.end());
    vector<vector<int>> particlesOf = given;
    for (auto& list : particlesOf)
        for (int& i : list)
            i = (int) (std::lower_bound(particles.begin(), particles.end(), i) - particles.begin());

    // From one end to the other, cut where enough particles have been passed.
    const int numParticles = (int) particles.size();
    const Incidence incidence = findIncidence(particlesOf, numParticles);
    const int end = walkBreadthFirst(0, particlesOf, incidence).back();
    const vector<int> order = walkBreadthFirst(end, particlesOf, incidence);
    ClusterCut result;
    result.pieces.resize(numPieces);
    vector<int> pieceOf(numParticles);
    for (size_t place = 0; place < order.size(); place++) {
        const int piece = (int) (place * numPieces / order.size());
        pieceOf[order[place]] = piece;
        result.pieces[piece].particles.push_back(particles[order[place]]);
    }
    for (size_t k = 0; k < particlesOf.size(); k++) {
        const int piece = pieceOf[particlesOf[k][0]];
        const bool isWithin =
            std::all_of(particlesOf[k].begin(), particlesOf[k].end(), [&](int i) { return pieceOf[i] == piece; });
        (isWithin ? result.pieces[piece].constraints : result.joints).push_back((int) k);
    }
    if ((double) result.joints.size() > MAX_JOINTS * (double) given.size())
        return ClusterCut();
    for (ClusterCut::Piece& piece : result.pieces)
        std::sort(piece.particles.begin(), piece.particles.end());
    return result;
}

} // namespace OpenMMVRattle
