// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONTEXTS_H_
#define OPENMMVRATTLE_EXPRESSIONTEXTS_H_

#include "expressions/ExpressionDerivatives.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * The same constraints in fewer texts: in those that differ in numbers alone these are parameters, so that a device needs one set of
 * functions for them all. They come behind all given parameters in the order of names. Zeros stay, with which derivatives are simpler, and
 * exponents, with which they are others.
 */
std::vector<ExpressionConstraint> shareTexts(const std::vector<ExpressionConstraint>& expressions);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONTEXTS_H_
