// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ParameterMotion.h"
#include <algorithm>
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

ParameterMotion::ParameterMotion(const ConstraintSystem& system) :
        target(system.getGivenParameters().values), system(system), isInMotion(false), change(target.size()),
        start(system.getGivenParameters()), jumped(start) {
}

void ParameterMotion::rest(ExpressionParameters& theta) {
    target = theta.values;
    std::fill(theta.rates.begin(), theta.rates.end(), 0.0);
    theta.isMoving = false;
}

void ParameterMotion::prepare(const vector<Vec3>& q, const ExpressionParameters& theta) {
    isInMotion = target != theta.values;
    start.values = theta.values;
    if (isInMotion)
        system.findParameterChange(q, theta, target, change);
    else
        std::fill(change.begin(), change.end(), 0.0);
}

void ParameterMotion::setRates(ExpressionParameters& theta, double size) const {
    theta.isMoving = isInMotion;
    for (size_t k = 0; k < change.size(); k++)
        theta.rates[k] = change[k] / size;
}

// On a straight way, which ends at the target to the last bit.
void ParameterMotion::follow(double time, double size, ExpressionParameters& theta) const {
    setRates(theta, size);
    for (size_t k = 0; k < change.size(); k++)
        theta.values[k] = time < size ? start.values[k] + time / size * change[k] : target[k];
}

const ExpressionParameters& ParameterMotion::atStart(double size) {
    setRates(start, size);
    return start;
}

void ParameterMotion::goBack(double size, ExpressionParameters& theta) const {
    theta = start;
    setRates(theta, size);
    for (size_t k = 0; k < change.size(); k++)
        theta.values[k] = start.values[k] - change[k];
}

double ParameterMotion::findJump(ConstraintSolver& solver, const vector<Vec3>& v, const ExpressionParameters& theta,
                                 double size, vector<Vec3>& after) {
    if (!isInMotion && !theta.isMoving)
        return -1;
    jumped = atStart(size);
    bool isSudden = false;
    for (size_t k = 0; k < change.size(); k++) {
        const double before = theta.rates[k];
        double& rate = jumped.rates[k];
        if (std::fabs(rate - before) > SUDDEN_CHANGE * std::max(std::fabs(rate), std::fabs(before)))
            isSudden = true;
        else
            rate = before;
    }
    if (!isSudden)
        return -1;
    const vector<double>& masses = system.getMasses();
    for (int i : solver.getMovingParticles())
        after[i] = Vec3();
    solver.addProjection(v, jumped, after);
    const double changeSquared = solver.sumOfSquares(after, masses);
    for (int i : solver.getMovingParticles())
        after[i] += v[i];
    const double speedSquared = std::max(solver.sumOfSquares(after, masses), solver.sumOfSquares(v, masses));
    return changeSquared > 0 ? changeSquared / speedSquared : 0.0;
}
