// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_MONITORSTART_H_
#define OPENMMVRATTLE_MONITORSTART_H_

#include "constraints/ConstraintSolver.h"
#include "step/StepMonitor.h"
#include "step/StepSolver.h"
#include "step/StepState.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The first step of a sequence of densities, and the references that are not given. The recursion of the density keeps an oscillation
 * of rho about u for ever, so it must start without one. The smooth solution is rho[1/2] = u0 + (u1 - u-1)/4 + O(h^3), u0 being
 * u(q0,p0), or for (3.14) the mean of u(q0,p1/2) and u(q0,p-1/2); which follows from docs/method.md, section 7. The first step is a
 * step of plain RATTLE from the on-step state, which gives u1 with the one force evaluation that the step costs anyway; u-1 comes
 * from a step backwards, whose forces are extrapolated along the path from those at q0 and q1, exactly so where the motion starts at
 * rest (and then q-1 = q1) or the forces are constant.
 *
 * Where no reference value is given, rho[1/2] = 1 and it is the reference value that is chosen such that this is the smooth start:
 * no force evaluation is spent on it. Where one is given, rho[1/2] follows, and the first step is taken again with it.
 *
 * A monitor that is zero at the start, but for rounding, asks for nothing and is no measure of what comes. As long as all are so, or
 * one that has no reference value, steps are single ones of plain RATTLE, and the sequence of densities starts after them.
 */
class MonitorStart {
public:
    MonitorStart(ConstraintSolver& constraints, StepSolver& solver, StepMonitor& monitor, const StepState& now);
    /** rho[1/2] to be tried. */
    double findDensity(double stepSize);
    /**
     * The end of the step that was tried is known, but for the velocities there.
     *
     * @param withHalfStep    whether the density is that of (3.14)
     */
    void lookBack(bool withHalfStep);
    /** The values there are known too. Returns whether the step stands; if not, it is to be taken again. */
    bool measure();
    /** It stands; returns whether a sequence has started. */
    bool accept();
    /** It has failed: the references are those before it. */
    void abandon();

private:
    bool lookBehind();
    void scaleReferences();
    ConstraintSolver& constraints;
    StepSolver& solver;
    StepMonitor& monitor;
    const StepState& now;
    StepState back; // a step behind the start
    bool hasBack;
    bool isCalm; // whether the first step is one that starts no sequence
    double triedDensity, firstDensity; // the latter once it is known; else 0
    std::vector<char> isNegligible; // each monitor
    std::vector<double> referencesBefore, startValues;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_MONITORSTART_H_
