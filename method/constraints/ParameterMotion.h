// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_PARAMETERMOTION_H_
#define OPENMMVRATTLE_PARAMETERMOTION_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include <vector>

namespace OpenMMVRattle {

/** How the parameters theta of expressions move in a step: at constant rates, from theta[n] to those that have been set for its end. */
class ParameterMotion {
public:
    /** A rate of a parameter that changes by more than this part of itself is a sudden one; one that doubles is not. */
    static constexpr double SUDDEN_CHANGE = 0.51;
    /** The part of the kinetic energy in a jump of the velocities that starts no oscillation to speak of: 1% of their size. */
    static constexpr double SMALL_JUMP = 1e-4;
    explicit ParameterMotion(const ConstraintSystem& system);
    /** theta[n+1], what the next step leads to. */
    std::vector<double> target;
    /** Let theta be at rest, now and until another target is set. */
    void rest(ExpressionParameters& theta);

    /** A step goes from positions and parameters there to the target. */
    void prepare(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta);
    /** Whether its end has other parameters. */
    bool isMoving() const {
        return isInMotion;
    }
    /** Write the rates of the step, which has this size (ps). */
    void setRates(ExpressionParameters& theta, double size) const;
    /** theta at a time of the step, which has this size, and its rates. */
    void follow(double time, double size, ExpressionParameters& theta) const;
    /** theta[n] with the rates of a step of that size. */
    const ExpressionParameters& atStart(double size);
    /** Where a step of that size has come from that moves parameters as this one. */
    void goBack(double size, ExpressionParameters& theta) const;
    /**
     * Where parameters begin to move in a step of that size, or stop, the velocities along the constraints jump in it. Where rates
     * change little by little, nothing does.
     *
     * @param v             the velocities before it
     * @param theta         the parameters, with the rates of the step before
     * @param[out] after    the velocities after the jump
     * @return the part of the kinetic energy that is in it; negative where there is no jump, and nothing has been written
     */
    double findJump(ConstraintSolver& solver, const std::vector<OpenMM::Vec3>& v, const ExpressionParameters& theta,
                    double size, std::vector<OpenMM::Vec3>& after);
    /** The parameters of the last jump, after it. */
    const ExpressionParameters& getJump() const {
        return jumped;
    }

private:
    const ConstraintSystem& system;
    bool isInMotion;
    std::vector<double> change; // theta[n+1] - theta[n]
    ExpressionParameters start, jumped;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_PARAMETERMOTION_H_
