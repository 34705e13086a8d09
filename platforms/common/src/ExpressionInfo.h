// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONINFO_H_
#define OPENMMVRATTLE_EXPRESSIONINFO_H_

#include "expressions/ExpressionDerivatives.h"
#include "openmm/common/ComputeForceInfo.h"
#include <vector>

namespace OpenMMVRattle {

/**
 * Tells OpenMM of constraints that are given as expressions, which it knows nothing of and which make molecules differ: only identical ones
 * may change places on a device. To be added to the Context's ComputeContext before that is initialized. Owns nothing: OpenMM 8.6 deletes
 * it as a ComputeForceInfo, whose destructor is not virtual.
 */
class ExpressionInfo : public OpenMM::ComputeForceInfo {
public:
    /** @param expressions what it tells of; they must exist as long as the Context asks, and their parameters are changed */
    explicit ExpressionInfo(std::vector<ExpressionConstraint>& expressions) : expressions(expressions) {
    }
    /** Take note of other values of the parameters; ComputeContext::invalidateMolecules() is to be called then. */
    void setParameters(const std::vector<ExpressionConstraint>& others) {
        for (size_t i = 0; i < expressions.size(); i++)
            expressions[i].parameters = others[i].parameters;
    }
    bool areParticlesIdentical(int, int) override {
        return true;
    }
    int getNumParticleGroups() override {
        return (int) expressions.size();
    }
    void getParticlesInGroup(int index, std::vector<int>& particles) override {
        particles = expressions[index].particles;
    }
    bool areGroupsIdentical(int group1, int group2) override {
        const ExpressionConstraint &a = expressions[group1], &b = expressions[group2];
        return a.expression == b.expression && a.parameters == b.parameters;
    }

private:
    std::vector<ExpressionConstraint>& expressions;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONINFO_H_
