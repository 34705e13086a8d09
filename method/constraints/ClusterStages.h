// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CLUSTERSTAGES_H_
#define OPENMMVRATTLE_CLUSTERSTAGES_H_

#include <limits>

namespace OpenMMVRattle {

/*
 * The passes of a step, each written once for all clusters: for those of a batch, a pack at a time in registers (ClusterBatch.cpp), and
 * for general ones, a part at a time in arrays (ConstraintPasses.cpp). A pass is a sequence of stages. Each moves the particles, forms
 * equations K x = b for one unknown or two, x being b at first, has them solved, and makes use of x. Stages keep nothing; what they
 * work on are clusters c, which hold what the pass computes with, under the names below, and know its algebra:
 *
 *     forParticles(task), forConstraints(task)    go through the indices of vectors, and of numbers
 *     multiply(w, x)                              x = G w
 *     addTransposedOverMass(x, scale, w)          w += scale M^-1 G^T x
 *     solve(x)                                    x = K^-1 x; not for the pieces of a cut cluster, which wait for their joints
 */

/** What most passes have nothing to do in. */
struct ClusterStages {
    /** Before everything else; also for joints. */
    template <class Clusters> void prepare(Clusters&) const {
    }
    /** Whether no more is to be solved for, which the largest errors of this stage and the one before tell. */
    bool isLast(int, double, double) const {
        return false;
    }
    /** Whether there is certainly something to solve for, even before the errors of others are known. */
    bool isCertain(int, double) const {
        return true;
    }
    /** When the unknowns have been found. */
    template <class Clusters> void update(Clusters&) const {
    }
    /** When those of the last stage have, for all that has particles. */
    template <class Clusters> void complete(Clusters&) const {
    }
};

/** The chord iteration for (3.11); each stage is an iteration. What it has not solved in the end is left to Newton's. */
struct ChordStages : ClusterStages {
    static constexpr int MAX_UPDATES = 12;
    double aim; // the largest error that is small enough
    explicit ChordStages(double aim) : aim(aim) {
    }
    int getCount() const {
        return MAX_UPDATES + 1;
    }
    template <class Clusters> void move(int stage, Clusters& c) const {
        c.move(stage > 0); // there is at least one update
    }
    /** Returns the largest error. */
    template <class Clusters> double form(int, Clusters& c) const {
        return c.evaluate(c.change);
    }
    // When there has been at least one update, since Lambda itself, unrefined, costs accuracy even where it meets the tolerance, and the
    // error is small enough, or no longer reduced, so that it is rounding, or Newton's to deal with.
    bool isLast(int stage, double error, double previous) const {
        return stage > 0 && (error <= aim || !(error < 0.5 * previous) || stage == MAX_UPDATES);
    }
    bool isCertain(int stage, double error) const {
        return stage == 0 || error > aim;
    }
    /** task(unknown, number): the update of lambda, but for a factor. */
    template <class Clusters, class Task> void forUnknowns(int, Clusters& c, const Task& task) const {
        task(c.change, 0);
    }
    template <class Clusters> void update(Clusters& c) const {
        c.forConstraints([&](int k) { c.lambda[k] += c.toUpdate(c.change[k]); });
    }
};

/** K Lambda = g''(v,v) + G M^-1 F (4.3), the first of which is in the right side. */
template <class Clusters, class Applied, class Numbers>
void formMultiplierEquation(Clusters& c, const Applied& applied, Numbers& rightSide, Numbers& multipliers) {
    c.forConstraints([&](int k) { multipliers[k] = rightSide[k] = rightSide[k] + applied[k]; });
}

/** One such iteration, of which the multipliers get the update only in the next pass, with Lambda(q,p+). */
struct CoupledStages : ClusterStages {
    int getCount() const {
        return 1;
    }
    template <class Clusters> void prepare(Clusters& c) const {
        c.forConstraints([&](int k) { c.lambda[k] += c.change[k]; });
    }
    template <class Clusters> void move(int, Clusters& c) const {
        c.move(true);
    }
    template <class Clusters> double form(int, Clusters& c) const {
        const double error = c.evaluate(c.change);
        c.evaluateCurvature(c.rightSide);
        formMultiplierEquation(c, c.applied, c.rightSide, c.multipliers);
        return error;
    }
    template <class Clusters, class Task> void forUnknowns(int, Clusters& c, const Task& task) const {
        task(c.multipliers, 0);
        task(c.change, 1);
    }
};

/** The end of a step: (3.12), (3.13), and (4.3) at one or two velocities. */
struct FinishStages : ClusterStages {
    int getCount() const {
        return 2;
    }
    /** (3.12) */
    template <class Clusters> static void kick(Clusters& c, int i) {
        c.v[i] = c.w[i] + c.getAcceleration(i) * c.kick;
    }
    template <class Clusters> void move(int stage, Clusters& c) const {
        if (stage == 0)
            c.forParticles([&](int i) { kick(c, i); });
        else
            c.addTransposedOverMass(c.change, -1.0, c.v);
    }
    template <class Clusters> double form(int stage, Clusters& c) const {
        if (stage == 0) { // (3.13)
            c.multiply(c.v, c.change);
            c.addParameterMotion(c.change);
            return 0;
        }
        c.multiplyAccelerations(c.applied);
        c.evaluateCurvature(c.v, c.rightSide);
        formMultiplierEquation(c, c.applied, c.rightSide, c.multipliers);
        if (c.hasHalfStep) {
            c.evaluateCurvature(c.w, c.halfRightSide);
            formMultiplierEquation(c, c.applied, c.halfRightSide, c.halfMultipliers);
        }
        return 0;
    }
    template <class Clusters, class Task> void forUnknowns(int stage, Clusters& c, const Task& task) const {
        stage == 0 ? task(c.change, 0) : task(c.multipliers, 0);
        if (stage > 0 && c.hasHalfStep)
            task(c.halfMultipliers, 1);
    }
    template <class Clusters> void complete(Clusters& c) const {
        if (c.hasNetAccelerations)
            c.addTransposedOverMass(c.multipliers, -1.0, c.netAccelerations);
    }
};

/** What has come of all stages: the error left, and the stage that was the last. */
struct StagesResult {
    double error;
    int stage;
};

/** Go through all stages with clusters that are prepared, and solved for at once. */
template <class Stages, class Clusters> StagesResult runStages(const Stages& stages, Clusters& c) {
    StagesResult result = {0, 0};
    double previous = std::numeric_limits<double>::infinity();
    for (; result.stage < stages.getCount(); result.stage++) {
        stages.move(result.stage, c);
        result.error = stages.form(result.stage, c);
        if (stages.isLast(result.stage, result.error, previous))
            break;
        previous = result.error;
        stages.forUnknowns(result.stage, c, [&](auto& x, int) { c.solve(x); });
        stages.update(c);
    }
    stages.complete(c);
    return result;
}

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CLUSTERSTAGES_H_
