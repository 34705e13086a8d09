// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "expressions/ArrayExpression.h"
#include <algorithm>
#include <cmath>
#include <map>
#include <string>

using namespace OpenMMVRattle;
using std::vector;

ArrayExpression::ArrayExpression(const ExpressionGraph& graph, const vector<int>& inputs, const vector<int>& outputs,
                                 int blockSize) : blockSize(blockSize), numRegisters(0) {
    const vector<ExpressionGraph::Node>& nodes = graph.getNodes();
    const vector<char> needed = graph.findNeeded(outputs);
    const int numNodes = (int) needed.size(), noRegister = -1;
    // When a node is used for the last time; those that must stay, never.
    vector<int> lastUse(numNodes, -1), registerOf(numNodes, noRegister), freeRegisters;
    for (int i = 0; i < numNodes; i++)
        if (needed[i])
            for (int argument : nodes[i].arguments)
                lastUse[argument] = i;
    for (int output : outputs)
        lastUse[output] = numNodes;
    for (int input : inputs) {
        const bool isUsed = input < numNodes && needed[input];
        inputRegisters.push_back(isUsed ? numRegisters : noRegister);
        if (isUsed)
            registerOf[input] = numRegisters++;
    }
    for (int i = 0; i < numNodes; i++)
        if (needed[i] && nodes[i].kind == ExpressionGraph::Constant) {
            constants.emplace_back(numRegisters, nodes[i].value);
            registerOf[i] = numRegisters++;
        }
    for (int i = 0; i < numNodes; i++) {
        if (!needed[i] || nodes[i].kind == ExpressionGraph::Constant || nodes[i].kind == ExpressionGraph::Variable)
            continue;
        // The result goes where none of the arguments is, so that the loops have no overlaps.
        if (freeRegisters.empty())
            freeRegisters.push_back(numRegisters++);
        registerOf[i] = freeRegisters.back();
        freeRegisters.pop_back();
        const vector<int>& arguments = nodes[i].arguments;
        Instruction instruction = {nodes[i].kind, registerOf[i], {0, 0, 0}, nodes[i].operation};
        for (size_t k = 0; k < arguments.size(); k++) {
            const int argument = arguments[k];
            instruction.arguments[k] = registerOf[argument];
            const bool isTemporary = !nodes[argument].arguments.empty();
            const bool isFirst = std::find(arguments.begin(), arguments.begin() + k, argument) == arguments.begin() + k;
            if (isTemporary && isFirst && lastUse[argument] == i)
                freeRegisters.push_back(registerOf[argument]);
        }
        instructions.push_back(instruction);
    }
    for (int output : outputs)
        outputRegisters.push_back(registerOf[output]);
}

void ArrayExpression::prepare(double* work) const {
    for (const auto& constant : constants)
        std::fill_n(work + (size_t) constant.first * blockSize, blockSize, constant.second);
}

void ArrayExpression::evaluate(double* work, int count) const {
    static const std::map<std::string, double> noVariables;
    for (const Instruction& instruction : instructions) {
        double* __restrict result = work + (size_t) instruction.result * blockSize;
        const double* a = work + (size_t) instruction.arguments[0] * blockSize;
        const double* b = work + (size_t) instruction.arguments[1] * blockSize;
        const double* c = work + (size_t) instruction.arguments[2] * blockSize;
        switch (instruction.kind) {
        case ExpressionGraph::Add:
            for (int i = 0; i < count; i++)
                result[i] = a[i] + b[i];
            break;
        case ExpressionGraph::Subtract:
            for (int i = 0; i < count; i++)
                result[i] = a[i] - b[i];
            break;
        case ExpressionGraph::Multiply:
            for (int i = 0; i < count; i++)
                result[i] = a[i] * b[i];
            break;
        case ExpressionGraph::Divide:
            for (int i = 0; i < count; i++)
                result[i] = a[i] / b[i];
            break;
        case ExpressionGraph::Negate:
            for (int i = 0; i < count; i++)
                result[i] = -a[i];
            break;
        case ExpressionGraph::SquareRoot:
            for (int i = 0; i < count; i++)
                result[i] = std::sqrt(a[i]);
            break;
        case ExpressionGraph::Select:
            for (int i = 0; i < count; i++)
                result[i] = a[i] != 0 ? b[i] : c[i];
            break;
        case ExpressionGraph::GuardedMultiply:
            for (int i = 0; i < count; i++)
                result[i] = a[i] != 0 ? a[i] * b[i] : 0;
            break;
        case ExpressionGraph::Other:
            for (int i = 0; i < count; i++) {
                double arguments[] = {a[i], b[i], c[i]};
                result[i] = instruction.operation->evaluate(arguments, noVariables);
            }
            break;
        case ExpressionGraph::Constant:
        case ExpressionGraph::Variable:
            break; // have been written before
        }
    }
}
