// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONGRAPH_H_
#define OPENMMVRATTLE_EXPRESSIONGRAPH_H_

#include "lepton/ExpressionTreeNode.h"
#include "lepton/Operation.h"
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * Expressions as one graph, in which every subexpression is there once, with symbolic derivatives.
 *
 * Nodes are numbered such that the arguments of an operation have smaller numbers than itself. What can be computed
 * when a node is made is: an operation on constants is a constant, and 0 x = 0, 0 + x = x, 1 x = x and the like.
 *
 * The derivative of each operation with respect to its arguments is Lepton's; only the order in which the chain rule
 * puts them together is ours: the derivative along a direction goes forwards through the graph, and a gradient with
 * respect to many variables backwards, so that its cost does not grow with their number.
 */
class ExpressionGraph {
public:
    /**
     * The kinds of operation. Other stands for all that Lepton has and that are not frequent enough to be named here.
     * GuardedMultiply is x y, but 0 where x is 0 even if y is not finite: the gradient of select(c, a, b) must not be spoilt
     * by the branch that was not chosen.
     */
    enum Kind {
        Constant,
        Variable,
        Add,
        Subtract,
        Multiply,
        Divide,
        Negate,
        SquareRoot,
        Select,
        GuardedMultiply,
        Other
    };
    struct Node {
        Kind kind;
        std::vector<int> arguments;
        double value;                                 // of a constant
        std::shared_ptr<const Lepton::Operation> operation; // of kind Other
    };

    /** Add a variable, of a name that is not there yet. */
    int addVariable(const std::string& name);
    int addConstant(double value);
    /**
     * Add an expression.
     *
     * @throws OpenMMException    if it contains a variable that has not been added
     */
    int addExpression(const Lepton::ExpressionTreeNode& tree);
    /** a*b */
    int multiply(int a, int b);
    /** a+b */
    int add(int a, int b);
    /**
     * Add the derivative of a node along a direction.
     *
     * @param node     the node
     * @param rates    the rate of change of each variable that changes: pairs of a variable and any node
     */
    int differentiate(int node, const std::vector<std::pair<int, int>>& rates);
    /** Add the derivatives of a node with respect to some variables. */
    std::vector<int> findGradient(int node, const std::vector<int>& variables);

    const std::vector<Node>& getNodes() const {
        return nodes;
    }
    /** Whether each of the nodes 0, ..., last is needed to compute some nodes. */
    std::vector<char> findNeeded(const std::vector<int>& outputs) const;

private:
    typedef std::tuple<int, std::vector<int>, std::uint64_t, std::string> Key;
    int makeNode(Kind kind, const std::vector<int>& arguments, double value = 0,
                 const std::shared_ptr<const Lepton::Operation>& operation = nullptr);
    int makeOther(const Lepton::Operation& operation, const std::vector<int>& arguments);
    int addOperation(const Lepton::Operation& operation, const std::vector<int>& arguments);
    int addTree(const Lepton::ExpressionTreeNode& tree, const std::map<std::string, int>& variables);
    int subtract(int a, int b);
    int divide(int a, int b);
    int negate(int a);
    int squareRoot(int a);
    int select(int condition, int a, int b);
    int power(int a, double exponent);
    int partialDerivative(int node, size_t argument);
    int guardedMultiply(int a, int b);
    bool isConstant(int node, double value) const;
    bool areConstant(const std::vector<int>& arguments) const;
    std::vector<char> findDependent(const std::vector<int>& variables, int last) const;
    std::vector<Node> nodes;
    std::map<Key, int> known;
    std::map<std::string, int> variables;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONGRAPH_H_
