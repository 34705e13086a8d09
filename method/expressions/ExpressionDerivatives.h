// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONDERIVATIVES_H_
#define OPENMMVRATTLE_EXPRESSIONDERIVATIVES_H_

#include "expressions/ExpressionGraph.h"
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** A constraint g(x1, y1, z1, x2, ...) = 0 of the positions of some particles (nm), given as an expression. */
struct ExpressionConstraint {
    std::string expression;
    std::vector<int> particles;
    std::map<std::string, double> parameters;
};

/** An expression and the derivatives that a constraint needs, as nodes of one graph. */
struct ExpressionDerivatives {
    /** @param example    a constraint of this expression */
    explicit ExpressionDerivatives(const ExpressionConstraint& example);
    ExpressionGraph graph;
    // Variables: x1, y1, z1, x2, ..., their velocities, the parameters in the order of their names, and their rates of change.
    std::vector<int> coordinates, velocities, parameters, parameterRates;
    int value;           // g
    int parameterMotion; // its derivative along the motion of the parameters alone
    // The derivative of g along the motion of the particles, and the derivative of this along the same motion. Of two, the second is
    // along the motion of the parameters too.
    int rate[2], curvature[2];
    std::vector<int> gradient; // dg/dx1, dg/dy1, ...
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONDERIVATIVES_H_
