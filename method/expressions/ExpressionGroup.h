// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONGROUP_H_
#define OPENMMVRATTLE_EXPRESSIONGROUP_H_

#include "expressions/ArrayExpression.h"
#include "openmm/Vec3.h"
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** A constraint g(x1, y1, z1, x2, ...) = 0 of the positions of some particles (nm), given as an expression. */
struct ExpressionConstraint {
    std::string expression;
    std::vector<int> particles;
    std::map<std::string, double> parameters;
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
     * Add a constraint, all of them before the first evaluation.
     *
     * @param constraint        the constraint
     * @param index             its place in arrays of constraints
     * @param firstEntry        the place of its first entry in a Jacobian
     * @param inverseMasses     1/mass of every particle of the system; 0 for one that does not move
     */
    void add(const ExpressionConstraint& constraint, int index, int firstEntry,
             const std::vector<double>& inverseMasses);
    int getNumConstraints() const {
        return (int) indices.size();
    }
    /** Change the parameters of the constraint that was added as the n-th. */
    void setParameters(int n, const std::map<std::string, double>& parameters);

    /** g(q) */
    void evaluate(const std::vector<OpenMM::Vec3>& q, std::vector<double>& g, int first, int end);
    /** The rows of G(q) = dg/dq. */
    void evaluateJacobian(const std::vector<OpenMM::Vec3>& q, std::vector<OpenMM::Vec3>& jacobian, int first, int end);
    /** g''(v,v) at q. */
    void evaluateCurvature(const std::vector<OpenMM::Vec3>& q, const std::vector<OpenMM::Vec3>& v,
                           std::vector<double>& result, int first, int end);
    /** The rows (d^2g/dq^2 v)^T at q. */
    void evaluateVelocityJacobian(const std::vector<OpenMM::Vec3>& q, const std::vector<OpenMM::Vec3>& v,
                                  std::vector<OpenMM::Vec3>& jacobian, int first, int end);

private:
    /**
     * How many constraints are evaluated at once: enough to pay for going through the operations, and few enough that what they
     * work on stays in the processor's nearest memory.
     */
    static constexpr int MAX_BLOCK_SIZE = 64, NO_ENTRY = -1;
    typedef std::unique_ptr<ArrayExpression> Program;
    /** What a program works on: positions, perhaps velocities, and the constraints first, ..., end - 1. */
    struct Range {
        const std::vector<OpenMM::Vec3>& q;
        const std::vector<OpenMM::Vec3>* v;
        int first, end;
    };
    const ArrayExpression& require(Program& program, const std::function<std::vector<int>()>& findOutputs);
    template <class Store> void run(const ArrayExpression& program, const Range& range, const Store& store) const;
    void runValues(const ArrayExpression& program, const Range& range, std::vector<double>& result) const;
    void runRows(const ArrayExpression& program, const Range& range, std::vector<OpenMM::Vec3>& jacobian) const;
    int numParticles;
    ExpressionGraph graph;
    std::vector<int> coordinates, velocities,
        parameters; // variables of the graph, in this order the inputs of all programs
    std::vector<std::string> parameterNames;
    int value, rate, curvature; // nodes: g, its derivative along v, and the derivative of this along v
    Program valueProgram, jacobianProgram, curvatureProgram, velocityJacobianProgram; // made when they are first needed
    std::vector<int> indices, particles, entries; // NO_ENTRY for a particle without mass
    std::vector<double> parameterValues;
    std::mutex mutex; // of the making of programs
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONGROUP_H_
