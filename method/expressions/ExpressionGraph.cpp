// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "expressions/ExpressionGraph.h"
#include "lepton/ParsedExpression.h"
#include "openmm/OpenMMException.h"
#include <algorithm>
#include <cmath>
#include <cstring>

using namespace OpenMMVRattle;
using Lepton::ExpressionTreeNode;
using Lepton::Operation;
using std::map;
using std::string;
using std::vector;

namespace {

const int NONE = -1;
// An integer power up to this is written as multiplications.
const int MAX_EXPANDED_POWER = 16;
// The names of the arguments of an operation whose derivative is asked for; no name that can be written is like these.
const char* const ARGUMENT_NAMES[] = {"argument 1", "argument 2", "argument 3"};

double evaluateOperation(const Operation& operation, double* arguments) {
    static const map<string, double> noVariables;
    return operation.evaluate(arguments, noVariables);
}

} // namespace

// ------------------------------------------------------------------------------------------------------ making nodes

int ExpressionGraph::makeNode(Kind kind, const vector<int>& arguments, double value,
                              const std::shared_ptr<const Operation>& operation) {
    std::uint64_t bits;
    std::memcpy(&bits, &value, sizeof(bits));
    // An operation of Lepton is known by its name, but for a constant exponent, whose name has too few digits.
    string name = operation ? operation->getName() : "";
    if (const auto* constantPower = dynamic_cast<const Operation::PowerConstant*>(operation.get())) {
        name = "power";
        const double exponent = constantPower->getValue();
        std::memcpy(&bits, &exponent, sizeof(bits));
    }
    const auto found = known.emplace(Key(kind, arguments, bits, name), (int) nodes.size());
    if (found.second)
        nodes.push_back({kind, arguments, value, operation});
    return found.first->second;
}

int ExpressionGraph::addVariable(const string& name) {
    nodes.push_back({Variable, {}, 0, nullptr});
    return variables[name] = (int) nodes.size() - 1;
}

int ExpressionGraph::addConstant(double value) {
    return makeNode(Constant, {}, value);
}

bool ExpressionGraph::isConstant(int node, double value) const {
    return nodes[node].kind == Constant && nodes[node].value == value;
}

bool ExpressionGraph::areConstant(const vector<int>& arguments) const {
    return std::all_of(arguments.begin(), arguments.end(), [&](int i) { return nodes[i].kind == Constant; });
}

int ExpressionGraph::add(int a, int b) {
    if (areConstant({a, b}))
        return addConstant(nodes[a].value + nodes[b].value);
    if (isConstant(a, 0))
        return b;
    if (isConstant(b, 0))
        return a;
    if (nodes[b].kind == Negate)
        return subtract(a, nodes[b].arguments[0]);
    if (nodes[a].kind == Negate)
        return subtract(b, nodes[a].arguments[0]);
    return makeNode(Add, {std::min(a, b), std::max(a, b)});
}

int ExpressionGraph::subtract(int a, int b) {
    if (areConstant({a, b}))
        return addConstant(nodes[a].value - nodes[b].value);
    if (isConstant(b, 0))
        return a;
    if (isConstant(a, 0))
        return negate(b);
    if (nodes[b].kind == Negate)
        return add(a, nodes[b].arguments[0]);
    return makeNode(Subtract, {a, b});
}

int ExpressionGraph::negate(int a) {
    if (nodes[a].kind == Constant)
        return addConstant(-nodes[a].value);
    if (nodes[a].kind == Negate)
        return nodes[a].arguments[0];
    return makeNode(Negate, {a});
}

int ExpressionGraph::multiply(int a, int b) {
    if (areConstant({a, b}))
        return addConstant(nodes[a].value * nodes[b].value);
    if (nodes[b].kind == Constant)
        std::swap(a, b);
    if (isConstant(a, 0))
        return a;
    if (isConstant(a, 1))
        return b;
    if (isConstant(a, -1))
        return negate(b);
    if (nodes[a].kind == Negate)
        return negate(multiply(nodes[a].arguments[0], b));
    if (nodes[b].kind == Negate)
        return negate(multiply(a, nodes[b].arguments[0]));
    return makeNode(Multiply, {std::min(a, b), std::max(a, b)});
}

int ExpressionGraph::guardedMultiply(int a, int b) {
    if (areConstant({a, b}) || nodes[a].kind == Constant || nodes[b].kind == Constant)
        return multiply(a, b);
    return makeNode(GuardedMultiply, {a, b});
}

int ExpressionGraph::divide(int a, int b) {
    if (areConstant({a, b}))
        return addConstant(nodes[a].value / nodes[b].value);
    if (isConstant(a, 0) || isConstant(b, 1))
        return a;
    if (nodes[a].kind == Negate)
        return negate(divide(nodes[a].arguments[0], b));
    return makeNode(Divide, {a, b});
}

int ExpressionGraph::squareRoot(int a) {
    return nodes[a].kind == Constant ? addConstant(std::sqrt(nodes[a].value)) : makeNode(SquareRoot, {a});
}

int ExpressionGraph::select(int condition, int a, int b) {
    if (nodes[condition].kind == Constant)
        return nodes[condition].value != 0 ? a : b;
    return a == b ? a : makeNode(Select, {condition, a, b});
}

// Lepton multiplies where the exponent is an integer, in this order.
int ExpressionGraph::power(int a, double exponent) {
    if (std::fabs(exponent) > MAX_EXPANDED_POWER || exponent != (int) exponent)
        return makeOther(Operation::PowerConstant(exponent), {a});
    int base = exponent < 0 ? divide(addConstant(1), a) : a, result = addConstant(1);
    for (int rest = std::abs((int) exponent); rest != 0; rest >>= 1) {
        if (rest & 1)
            result = multiply(result, base);
        if (rest > 1)
            base = multiply(base, base);
    }
    return result;
}

int ExpressionGraph::makeOther(const Operation& operation, const vector<int>& arguments) {
    if (areConstant(arguments)) {
        vector<double> values;
        for (int i : arguments)
            values.push_back(nodes[i].value);
        return addConstant(evaluateOperation(operation, values.data()));
    }
    return makeNode(Other, arguments, 0, std::shared_ptr<const Operation>(operation.clone()));
}

int ExpressionGraph::addOperation(const Operation& operation, const vector<int>& a) {
    switch (operation.getId()) {
    case Operation::CONSTANT:
        return addConstant(static_cast<const Operation::Constant&>(operation).getValue());
    case Operation::ADD:
        return add(a[0], a[1]);
    case Operation::SUBTRACT:
        return subtract(a[0], a[1]);
    case Operation::MULTIPLY:
        return multiply(a[0], a[1]);
    case Operation::DIVIDE:
        return divide(a[0], a[1]);
    case Operation::NEGATE:
        return negate(a[0]);
    case Operation::SQRT:
        return squareRoot(a[0]);
    case Operation::SELECT:
        return select(a[0], a[1], a[2]);
    case Operation::SQUARE:
        return power(a[0], 2);
    case Operation::CUBE:
        return power(a[0], 3);
    case Operation::RECIPROCAL:
        return power(a[0], -1);
    case Operation::ADD_CONSTANT:
        return add(a[0], addConstant(static_cast<const Operation::AddConstant&>(operation).getValue()));
    case Operation::MULTIPLY_CONSTANT:
        return multiply(a[0], addConstant(static_cast<const Operation::MultiplyConstant&>(operation).getValue()));
    case Operation::POWER_CONSTANT:
        return power(a[0], static_cast<const Operation::PowerConstant&>(operation).getValue());
    case Operation::POWER:
        if (nodes[a[1]].kind == Constant)
            return power(a[0], nodes[a[1]].value);
        return makeOther(operation, a);
    default:
        return makeOther(operation, a);
    }
}

int ExpressionGraph::addTree(const ExpressionTreeNode& tree, const map<string, int>& names) {
    const Operation& operation = tree.getOperation();
    if (operation.getId() == Operation::VARIABLE) {
        const auto found = names.find(operation.getName());
        if (found == names.end())
            throw OpenMM::OpenMMException("there is no variable " + operation.getName());
        return found->second;
    }
    vector<int> arguments;
    for (const ExpressionTreeNode& child : tree.getChildren())
        arguments.push_back(addTree(child, names));
    return addOperation(operation, arguments);
}

int ExpressionGraph::addExpression(const ExpressionTreeNode& tree) {
    return addTree(tree, variables);
}

// ------------------------------------------------------------------------------------------------------- derivatives

vector<char> ExpressionGraph::findNeeded(const vector<int>& outputs) const {
    vector<char> needed(outputs.empty() ? 0 : *std::max_element(outputs.begin(), outputs.end()) + 1, false);
    for (int output : outputs)
        needed[output] = true;
    for (int i = (int) needed.size() - 1; i >= 0; i--)
        if (needed[i])
            for (int argument : nodes[i].arguments)
                needed[argument] = true;
    return needed;
}

vector<char> ExpressionGraph::findDependent(const vector<int>& changing, int last) const {
    vector<char> dependent(last + 1, false);
    for (int variable : changing)
        if (variable <= last)
            dependent[variable] = true;
    for (int i = 0; i <= last; i++)
        for (int argument : nodes[i].arguments)
            dependent[i] |= dependent[argument];
    return dependent;
}

// The derivative of an operation with respect to one of its arguments. Where it can share what is there already it is
// written out, and otherwise it is Lepton's.
int ExpressionGraph::partialDerivative(int node, size_t argument) {
    const Node n = nodes[node];
    const vector<int>& a = n.arguments;
    switch (n.kind) {
    case Add:
        return addConstant(1);
    case Subtract:
        return addConstant(argument == 0 ? 1 : -1);
    case Negate:
        return addConstant(-1);
    case Multiply:
        // x*x counts once for each argument
        return a[1 - argument];
    case Divide:
        return argument == 0 ? divide(addConstant(1), a[1]) : negate(divide(node, a[1]));
    case SquareRoot:
        return divide(addConstant(0.5), node);
    case Select:
        return argument == 0   ? addConstant(0)
               : argument == 1 ? select(a[0], addConstant(1), addConstant(0))
                               : select(a[0], addConstant(0), addConstant(1));
    case Other:
        break;
    case Constant:
    case Variable:
    case GuardedMultiply: // is made by findGradient() alone, whose results are not differentiated
        throw OpenMM::OpenMMException("an operation without a derivative in an expression");
    }
    if (const auto* constantPower = dynamic_cast<const Operation::PowerConstant*>(n.operation.get())) {
        const double exponent = constantPower->getValue();
        return multiply(addConstant(exponent), power(a[0], exponent - 1));
    }
    vector<ExpressionTreeNode> children;
    map<string, int> names;
    for (size_t i = 0; i < a.size(); i++) {
        children.emplace_back(new Operation::Variable(ARGUMENT_NAMES[i]));
        names[ARGUMENT_NAMES[i]] = a[i];
    }
    const Lepton::ParsedExpression expression(ExpressionTreeNode(n.operation->clone(), children));
    return addTree(expression.differentiate(ARGUMENT_NAMES[argument]).getRootNode(), names);
}

int ExpressionGraph::differentiate(int node, const vector<std::pair<int, int>>& rates) {
    vector<int> changing, rate(node + 1, NONE); // of each node; none is zero
    for (const auto& each : rates) {
        changing.push_back(each.first);
        if (each.first <= node)
            rate[each.first] = each.second;
    }
    const vector<char> needed = findNeeded({node}), dependent = findDependent(changing, node);
    for (int i = 0; i <= node; i++) {
        if (!needed[i] || !dependent[i] || nodes[i].kind == Variable)
            continue;
        const vector<int> arguments = nodes[i].arguments;
        if (nodes[i].kind == Select) {
            // The branch that is not chosen has no part in it, whatever its value.
            auto rateOf = [&](int argument) { return rate[argument] == NONE ? addConstant(0) : rate[argument]; };
            rate[i] = select(arguments[0], rateOf(arguments[1]), rateOf(arguments[2]));
            continue;
        }
        int sum = addConstant(0);
        for (size_t k = 0; k < arguments.size(); k++)
            if (rate[arguments[k]] != NONE)
                sum = add(sum, multiply(rate[arguments[k]], partialDerivative(i, k)));
        rate[i] = sum;
    }
    return rate[node] == NONE ? addConstant(0) : rate[node];
}

vector<int> ExpressionGraph::findGradient(int node, const vector<int>& wanted) {
    const vector<char> needed = findNeeded({node}), dependent = findDependent(wanted, node);
    bool hasSelect = false;
    for (int i = 0; i <= node; i++)
        hasSelect |= needed[i] && nodes[i].kind == Select;
    vector<int> adjoint(node + 1, NONE); // the derivative of the node with respect to each; none is zero
    adjoint[node] = addConstant(1);
    for (int i = node; i >= 0; i--) {
        if (adjoint[i] == NONE || !dependent[i] || nodes[i].kind == Variable)
            continue;
        const vector<int> arguments = nodes[i].arguments;
        const bool isSelect = nodes[i].kind == Select;
        for (size_t k = 0; k < arguments.size(); k++) {
            const int argument = arguments[k];
            if (!dependent[argument] || (isSelect && k == 0))
                continue;
            int term;
            if (isSelect)
                term = select(arguments[0], k == 1 ? adjoint[i] : addConstant(0), k == 2 ? adjoint[i] : addConstant(0));
            else if (hasSelect)
                term = guardedMultiply(adjoint[i], partialDerivative(i, k));
            else
                term = multiply(adjoint[i], partialDerivative(i, k));
            adjoint[argument] = adjoint[argument] == NONE ? term : add(adjoint[argument], term);
        }
    }
    vector<int> result;
    for (int variable : wanted)
        result.push_back(variable <= node && adjoint[variable] != NONE ? adjoint[variable] : addConstant(0));
    return result;
}
