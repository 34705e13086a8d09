// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_ARRAYEXPRESSION_H_
#define OPENMMVRATTLE_ARRAYEXPRESSION_H_

#include "expressions/ExpressionGraph.h"
#include <cstddef>
#include <memory>
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * Computes some nodes of an ExpressionGraph for a block of values of its variables at once: the list of operations is gone
 * through once a block, and each operation is a loop over arrays.
 *
 * Lepton's own CompiledExpression is no choice here: in the OpenMM of the package index it has another size than its header
 * says, since the headers of the assembler it uses are not shipped.
 */
class ArrayExpression {
public:
    /**
     * @param graph        the graph; it is not needed afterwards
     * @param inputs       the variables
     * @param outputs      the nodes to compute
     * @param blockSize    the largest number of values in a block
     */
    ArrayExpression(const ExpressionGraph& graph, const std::vector<int>& inputs, const std::vector<int>& outputs,
                    int blockSize);
    /** The number of numbers that a computation works on. Each thread has its own. */
    size_t getWorkSize() const {
        return (size_t) numRegisters * blockSize;
    }
    /** Write what is the same for all blocks. */
    void prepare(double* work) const;
    /** Whether an input is needed. */
    bool usesInput(int index) const {
        return inputRegisters[index] >= 0;
    }
    /** Where the values of an input that is needed are to be written. */
    double* getInput(double* work, int index) const {
        return work + (size_t) inputRegisters[index] * blockSize;
    }
    /** Compute the outputs for the first values of the block. */
    void evaluate(double* work, int count) const;
    /** The values of an output, until the next evaluation. */
    const double* getOutput(const double* work, int index) const {
        return work + (size_t) outputRegisters[index] * blockSize;
    }
    /** The number of operations for each value of a block. */
    int getNumOperations() const {
        return (int) instructions.size();
    }

private:
    struct Instruction {
        ExpressionGraph::Kind kind;
        int result, arguments[3]; // registers
        std::shared_ptr<const Lepton::Operation> operation;
    };
    int blockSize, numRegisters;
    std::vector<Instruction> instructions;
    std::vector<int> inputRegisters, outputRegisters;
    std::vector<std::pair<int, double>> constants; // registers and what they hold
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_ARRAYEXPRESSION_H_
