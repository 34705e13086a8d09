// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXAMPLES_H_
#define OPENMMVRATTLE_EXAMPLES_H_

#include "constraints/DistanceConstraint.h"
#include "expressions/ExpressionGroup.h"
#include "openmm/Vec3.h"
#include <cmath>
#include <functional>
#include <random>
#include <string>
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/** Particles and constraints that the tests of the method make up, the same ones on every machine. */
struct Example {
    std::vector<double> masses;
    std::vector<DistanceConstraint> distances;
    std::vector<ExpressionConstraint> expressions;
    std::vector<OpenMM::Vec3> positions, velocities;
    std::mt19937 generator{11};

    double uniform(double from, double to) {
        return from + (to - from) * ((double) generator() / 4294967296.0);
    }
    OpenMM::Vec3 randomVector(double scale) {
        const double x = uniform(-1, 1), y = uniform(-1, 1);
        return OpenMM::Vec3(x, y, uniform(-1, 1)) * scale;
    }
    int add(double mass, const OpenMM::Vec3& position) {
        masses.push_back(mass);
        positions.push_back(position);
        velocities.push_back(mass == 0 ? OpenMM::Vec3() : randomVector(0.5));
        return (int) masses.size() - 1;
    }
    /** A constraint as long as the distance happens to be. */
    void join(int i, int j) {
        const OpenMM::Vec3 r = positions[i] - positions[j];
        distances.push_back({i, j, std::sqrt(r.dot(r))});
    }
    /** Particles about a random place, joined as the pairs say. */
    void addCluster(const std::vector<double>& clusterMasses, const std::vector<std::pair<int, int>>& pairs,
                    const std::vector<OpenMM::Vec3>& shape) {
        const int first = (int) masses.size();
        const OpenMM::Vec3 place = randomVector(3);
        for (size_t i = 0; i < clusterMasses.size(); i++)
            add(clusterMasses[i], place + shape[i]);
        for (const auto& pair : pairs)
            join(first + pair.first, first + pair.second);
    }
    void addWater(const OpenMM::Vec3& place) {
        const int oxygen = add(16, place), one = add(1, place + OpenMM::Vec3(0.08, 0.06, 0)),
                  other = add(1, place + OpenMM::Vec3(-0.08, 0.06, 0));
        join(oxygen, one);
        join(oxygen, other);
        join(one, other);
    }
    void shuffleDistances() {
        for (size_t i = distances.size(); i > 1; i--)
            std::swap(distances[i - 1], distances[generator() % i]);
    }
};

/**
 * A backbone with a side group at each third particle and a triangle at each seventh, beside some waters and free particles. The
 * constraints stand in no order.
 */
inline Example makeComb(int backbone) {
    using OpenMM::Vec3;
    Example e;
    int last = e.add(20, Vec3());
    for (int i = 1; i < backbone; i++) {
        const Vec3 place = Vec3(0.12 * i, 0.05 * (i % 2), 0) + e.randomVector(0.03);
        const int next = e.add(e.uniform(10, 40), place);
        e.join(last, next);
        if (i % 3 == 0)
            e.join(next, e.add(1, place + Vec3(0, 0.1, 0.03)));
        if (i % 7 == 0) {
            const int a = e.add(2, place + Vec3(0.02, 0, 0.1)), b = e.add(3, place - Vec3(0.03, 0, 0.1));
            e.join(next, a);
            e.join(next, b);
            e.join(a, b);
        }
        last = next;
    }
    for (int i = 0; i < 50; i++) {
        e.addWater(Vec3(0, 3, 0.3 * i));
        e.add(40, Vec3(0, 4, 0.3 * i));
    }
    e.shuffleDistances();
    return e;
}

/**
 * Rigid sections of three particles, whose centres are held together by three expressions of both; the first is held to a fixed
 * particle.
 */
inline Example makeRod(int sections) {
    using OpenMM::Vec3;
    using std::string;
    Example e;
    for (int i = 0; i < sections; i++) {
        const Vec3 centre(0.1 * i, 0, 0);
        for (const Vec3& corner : {Vec3(0.01, 0.1, 0), Vec3(0, -0.05, 0.08), Vec3(-0.01, -0.05, -0.08)})
            e.add(5, centre + corner);
        for (const auto& pair : {std::make_pair(0, 1), {0, 2}, {1, 2}})
            e.join(3 * i + pair.first, 3 * i + pair.second);
        if (i == 0)
            continue;
        std::vector<int> particles;
        for (int p = 3 * i - 3; p < 3 * i + 3; p++)
            particles.push_back(p);
        for (const string& expression :
             {string("(x4+x5+x6-x1-x2-x3)/3-length"), string("(y4+y5+y6-y1-y2-y3)/3+2*(z4-z1)*(x1-x2)"),
              string("(z4+z5+z6-z1-z2-z3)/3+(y4-y1)*(x1-x2)")})
            e.expressions.push_back({expression, particles, {}});
        e.expressions[e.expressions.size() - 3].parameters["length"] = 0.1;
    }
    const int fixed = e.add(0, Vec3(0, 0, 0.1));
    const Vec3 r = e.positions[0] - e.positions[fixed];
    e.expressions.push_back({"(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-square", {0, fixed}, {{"square", r.dot(r)}}});
    return e;
}

/** A field that differs from particle to particle. */
inline std::vector<OpenMM::Vec3> forcesAt(const std::vector<OpenMM::Vec3>& positions) {
    std::vector<OpenMM::Vec3> forces;
    for (size_t i = 0; i < positions.size(); i++)
        forces.push_back(OpenMM::Vec3(5 * std::sin(positions[i][0]), -10 * positions[i][1], 3.0 - (double) (i % 7)));
    return forces;
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXAMPLES_H_
