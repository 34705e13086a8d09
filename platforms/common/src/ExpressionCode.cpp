// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionCode.h"
#include "openmm/OpenMMException.h"
#include <algorithm>
#include <cmath>
#include <map>
#include <sstream>

using namespace OpenMMVRattle;
using Lepton::Operation;
using std::string;
using std::to_string;
using std::vector;

namespace {

typedef ExpressionGraph::Node Node;

string writeNumber(double value) {
    if (std::isnan(value))
        return "(0/(mixed) 0)";
    if (std::isinf(value))
        return value > 0 ? "(1/(mixed) 0)" : "(-1/(mixed) 0)";
    std::stringstream text;
    text.precision(17);
    text << "((mixed) " << std::scientific << value << ")";
    return text.str();
}

string nameOf(int node) {
    return "n" + to_string(node);
}

// Operations that are a function of the same name in the language of devices, or another expression.
const std::map<Operation::Id, string> FUNCTIONS = {{Operation::POWER, "pow($0, $1)"},
                                                   {Operation::EXP, "exp($0)"},
                                                   {Operation::LOG, "log($0)"},
                                                   {Operation::SIN, "sin($0)"},
                                                   {Operation::COS, "cos($0)"},
                                                   {Operation::SEC, "1/cos($0)"},
                                                   {Operation::CSC, "1/sin($0)"},
                                                   {Operation::TAN, "tan($0)"},
                                                   {Operation::COT, "1/tan($0)"},
                                                   {Operation::ASIN, "asin($0)"},
                                                   {Operation::ACOS, "acos($0)"},
                                                   {Operation::ATAN, "atan($0)"},
                                                   {Operation::ATAN2, "atan2($0, $1)"},
                                                   {Operation::SINH, "sinh($0)"},
                                                   {Operation::COSH, "cosh($0)"},
                                                   {Operation::TANH, "tanh($0)"},
                                                   {Operation::ERF, "erf($0)"},
                                                   {Operation::ERFC, "erfc($0)"},
                                                   {Operation::STEP, "($0 >= 0 ? (mixed) 1 : (mixed) 0)"},
                                                   {Operation::DELTA, "($0 == 0 ? (mixed) 1 : (mixed) 0)"},
                                                   {Operation::MIN, "($1 < $0 ? $1 : $0)"},
                                                   {Operation::MAX, "($0 < $1 ? $1 : $0)"},
                                                   {Operation::ABS, "fabs($0)"},
                                                   {Operation::FLOOR, "floor($0)"},
                                                   {Operation::CEIL, "ceil($0)"}};

string textOf(const Node& node) {
    switch (node.kind) {
    case ExpressionGraph::Constant:
        return writeNumber(node.value);
    case ExpressionGraph::Add:
        return "$0 + $1";
    case ExpressionGraph::Subtract:
        return "$0 - $1";
    case ExpressionGraph::Multiply:
        return "$0*$1";
    case ExpressionGraph::Divide:
        return "$0/$1";
    case ExpressionGraph::Negate:
        return "-$0";
    case ExpressionGraph::SquareRoot:
        return "sqrt($0)";
    case ExpressionGraph::Select:
        return "($0 != 0 ? $1 : $2)";
    case ExpressionGraph::GuardedMultiply:
        return "($0 != 0 ? $0*$1 : (mixed) 0)";
    case ExpressionGraph::Other:
        break;
    case ExpressionGraph::Variable:
        throw OpenMM::OpenMMException("a variable is no operation");
    }
    if (const auto* power = dynamic_cast<const Operation::PowerConstant*>(node.operation.get()))
        return "pow($0, " + writeNumber(power->getValue()) + ")";
    return FUNCTIONS.at(node.operation->getId());
}

} // namespace

// The nodes that some outputs need, as constants of the function.
string ExpressionCode::writeNodes(const vector<int>& outputs) const {
    const vector<Node>& nodes = expression.graph.getNodes();
    const vector<char> needed = expression.graph.findNeeded(outputs);
    std::map<int, string> variables;
    auto addVectors = [&](const vector<int>& list, const string& array) {
        for (size_t i = 0; i < list.size(); i++)
            variables[list[i]] = array + "[3*at[" + to_string(i / 3) + "]+" + to_string(i % 3) + "]";
    };
    addVectors(expression.coordinates, "x");
    addVectors(expression.velocities, "v");
    for (size_t i = 0; i < expression.parameters.size(); i++) {
        variables[expression.parameters[i]] = "theta[" + to_string(i) + "]";
        variables[expression.parameterRates[i]] = "factor*rates[" + to_string(i) + "]";
    }
    string result;
    for (size_t i = 0; i < needed.size(); i++) {
        if (!needed[i])
            continue;
        string text = nodes[i].kind == ExpressionGraph::Variable ? variables.at((int) i) : textOf(nodes[i]);
        for (size_t k = 0; k < nodes[i].arguments.size(); k++) {
            const string word = "$" + to_string(k), name = nameOf(nodes[i].arguments[k]);
            for (size_t at = text.find(word); at != string::npos; at = text.find(word, at + name.size()))
                text.replace(at, word.size(), name);
        }
        result += "    const mixed " + nameOf((int) i) + " = " + text + ";\n";
    }
    return result;
}

string ExpressionCode::write(const string& kind) const {
    const string begin = "inline DEVICE ", x = "(GLOBAL const mixed* x, ", v = "GLOBAL const mixed* v, ",
                 theta = "GLOBAL const int* at, GLOBAL const mixed* theta",
                 rates = ", GLOBAL const mixed* rates, mixed factor";
    auto writeValue = [&](const string& head, int node) {
        return begin + "mixed " + head + ") {\n" + writeNodes({node}) + "    return " + nameOf(node) + ";\n}\n\n";
    };
    string text = writeValue("value" + kind + x + theta, expression.value) +
                  writeValue("motion" + kind + x + theta + rates, expression.parameterMotion) +
                  writeValue("curvature" + kind + x + v + theta, expression.curvature[0]) +
                  writeValue("movingCurvature" + kind + x + v + theta + rates, expression.curvature[1]);
    text += begin + "void gradient" + kind + x + theta + ", GLOBAL mixed* G) {\n" + writeNodes(expression.gradient);
    for (size_t i = 0; i < expression.gradient.size(); i++)
        text += "    G[" + to_string(i) + "] = " + nameOf(expression.gradient[i]) + ";\n";
    return text + "}\n\n";
}

size_t ExpressionCode::getSize() const {
    size_t size = 0;
    vector<vector<int>> functions = {{expression.value},
                                     {expression.parameterMotion},
                                     {expression.curvature[0]},
                                     {expression.curvature[1]},
                                     expression.gradient};
    for (const vector<int>& outputs : functions) {
        const vector<char> needed = expression.graph.findNeeded(outputs);
        size += std::count(needed.begin(), needed.end(), (char) true) + outputs.size();
    }
    return size;
}
