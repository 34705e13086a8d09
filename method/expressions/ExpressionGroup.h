// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONGROUP_H_
#define OPENMMVRATTLE_EXPRESSIONGROUP_H_

#include "expressions/ArrayExpression.h"
#include "expressions/ExpressionDerivatives.h"
#include "openmm/Vec3.h"
#include <memory>
#include <vector>

namespace OpenMMVRattle {

/**
 * The parameters theta of all expressions of a system, in the order that ConstraintSystem gives them, and their rates of change
 * in time. A parameter that changes is a coordinate whose motion is prescribed: it has a part in the derivatives of g along the
 * motion.
 */
struct ExpressionParameters {
    std::vector<double> values, rates;
    bool isMoving = false; // whether a rate is not zero
};

/**
 * The constraints that share an expression, a number of particles and the names of their parameters. The expression is parsed
 * and differentiated once, and evaluated for those that were added as the first-th, ..., (end - 1)-th together. Several threads may
 * evaluate different ones at the same time.
 *
 * A constraint has neighbouring entries in a Jacobian, one for each particle with mass, in the constraint's order.
 */
class ExpressionGroup {
public:
    /** @param example    a constraint of the group */
    explicit ExpressionGroup(const ExpressionConstraint& example);
    /**
     * Add a constraint, all of them before compile().
     *
     * @param constraint        the constraint
     * @param index             its place in arrays of constraints
     * @param firstEntry        the place of its first entry in a Jacobian
     * @param firstParameter    the place of its first parameter in ExpressionParameters; they are in the order of their names
     * @param inverseMasses     1/mass of every particle of the system; 0 for one that does not move
     */
    void add(const ExpressionConstraint& constraint, int index, int firstEntry, int firstParameter,
             const std::vector<double>& inverseMasses);
    /** Make the programs that evaluate what there is, when all have been added. */
    void compile();
    int getNumConstraints() const {
        return (int) indices.size();
    }

    /** g(q) */
    void evaluate(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta, std::vector<double>& g,
                  int first, int end) const;
    /** The rows of G(q) = dg/dq. */
    void evaluateJacobian(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta,
                          std::vector<OpenMM::Vec3>& jacobian, int first, int end) const;
    /** result += dg/dtheta . rates, the change of g in time at fixed q. */
    void addParameterMotion(const std::vector<OpenMM::Vec3>& q, const ExpressionParameters& theta,
                            std::vector<double>& result, int first, int end) const;
    /** g''(v,v) at q, the second derivative of g along the motion of the particles and of the parameters. */
    void evaluateCurvature(const std::vector<OpenMM::Vec3>& q, const std::vector<OpenMM::Vec3>& v,
                           const ExpressionParameters& theta, std::vector<double>& result, int first, int end) const;
    /** The rows (d^2g/dq^2 v)^T at q, the derivative of G along the motion of the particles and of the parameters. */
    void evaluateVelocityJacobian(const std::vector<OpenMM::Vec3>& q, const std::vector<OpenMM::Vec3>& v,
                                  const ExpressionParameters& theta, std::vector<OpenMM::Vec3>& jacobian, int first,
                                  int end) const;

private:
    /**
     * How many constraints are evaluated at once: enough to pay for going through the operations, and few enough that what they
     * work on stays in the processor's nearest memory.
     */
    static constexpr int MAX_BLOCK_SIZE = 64, NO_ENTRY = -1;
    typedef std::unique_ptr<const ArrayExpression> Program;
    /** What a program works on: positions, perhaps velocities, parameters, and the constraints first, ..., end - 1. */
    struct Range {
        const std::vector<OpenMM::Vec3>& q;
        const std::vector<OpenMM::Vec3>* v;
        const ExpressionParameters& theta;
        int first, end;
    };
    Program make(const std::vector<int>& outputs) const;
    template <class Store> void run(const ArrayExpression& program, const Range& range, const Store& store) const;
    void runValues(const ArrayExpression& program, const Range& range, std::vector<double>& result, bool mustAdd) const;
    void runRows(const ArrayExpression& program, const Range& range, std::vector<OpenMM::Vec3>& jacobian) const;
    int numParticles;
    ExpressionDerivatives nodes;
    std::vector<int> inputs; // of all programs: coordinates, velocities, parameters and their rates
    Program valueProgram, jacobianProgram, motionProgram, curvaturePrograms[2], velocityJacobianPrograms[2];
    std::vector<int> indices, firstParameters, particles, entries; // NO_ENTRY for a particle without mass
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONGROUP_H_
