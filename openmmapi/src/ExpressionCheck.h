// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONCHECK_H_
#define OPENMMVRATTLE_EXPRESSIONCHECK_H_

#include "run/IntegratorSettings.h"
#include <map>
#include <string>

namespace OpenMMVRattle {

/**
 * Throw an OpenMMException unless a constraint's expression can be parsed and contains nothing but x1, y1, z1, ... of its
 * particles, its parameters, and what it defines itself.
 *
 * @param expression      the expression
 * @param numParticles    the number of particles of the constraint
 * @param parameters      the parameters of the constraint
 * @param settings        whose messages these are
 */
void requireValidExpression(const std::string& expression, int numParticles,
                            const std::map<std::string, double>& parameters, const IntegratorSettings& settings);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONCHECK_H_
