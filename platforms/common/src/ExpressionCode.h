// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONCODE_H_
#define OPENMMVRATTLE_EXPRESSIONCODE_H_

#include "expressions/ExpressionDerivatives.h"
#include <string>

namespace OpenMMVRattle {

/**
 * Writes an expression and its derivatives as straight-line functions for a device, each subexpression once:
 *
 *     value_KIND(x, at, theta):               g
 *     gradient_KIND(x, at, theta, G):         G[3*i+d] = dg/dx of the i-th particle
 *     motion_KIND(x, at, theta, rates, f):    f dg/dtheta . rates
 *     curvature_KIND(x, v, at, theta):        g''(v,v)
 *     movingCurvature_KIND(x, v, at, theta, rates, f):    the same along the motion f rates of the parameters too
 *
 * Coordinates of the i-th particle are x[3*at[i]], ..., its velocity is likewise in v.
 */
class ExpressionCode {
public:
    explicit ExpressionCode(const ExpressionDerivatives& expression) : expression(expression) {
    }
    /** All functions; KIND in their names is the given word. */
    std::string write(const std::string& kind) const;
    /** The operations and numbers read in all functions together. */
    size_t getSize() const;

private:
    std::string writeNodes(const std::vector<int>& outputs) const;
    const ExpressionDerivatives& expression;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONCODE_H_
