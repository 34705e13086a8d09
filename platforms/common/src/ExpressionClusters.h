// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_EXPRESSIONCLUSTERS_H_
#define OPENMMVRATTLE_EXPRESSIONCLUSTERS_H_

#include "constraints/ClusterLayout.h"
#include "expressions/ExpressionDerivatives.h"
#include <cstddef>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * The clusters with a constraint that is given as an expression, for kernels/expression.cc: in parts, each of one large cluster or of as
 * many small ones as keep the threads of a work group busy. A part has one sparse matrix K; which of its rows do not depend on
 * each other, and are eliminated at once, is in tables that are worked out here, once.
 *
 * The distances of such a cluster are rows like others, of the expression (|r|^2 - L^2)/2.
 */
class ExpressionClusters {
public:
    /** A part has about so many constraints, or one cluster. */
    static const int PART_SIZE = 128;
    /** There is room for so many numbers of each particle, which are added up over its cluster. */
    static constexpr int NUM_TERMS = 6;

    ExpressionClusters(const ClusterLayout& layout, const std::vector<ExpressionConstraint>& expressions);
    /**
     * The large clusters of distances, each a part of its own. The parameter of a row is the length of its constraint, by the number that
     * this has in LargeClusters.
     */
    explicit ExpressionClusters(const ClusterLayout& layout);
    bool isEmpty() const {
        return parts.empty();
    }
    /** The functions of all expressions (ExpressionCode), and those that choose among them by the kind of a row. */
    std::string writeFunctions() const;
    /** The operations in the functions of all expressions together. */
    static size_t findSize(const std::vector<ExpressionConstraint>& expressions);
    /** Where the table of each part begins. */
    const std::vector<int>& getParts() const {
        return parts;
    }
    const std::vector<int>& getTables() const {
        return tables;
    }
    /** The particle of each place; a massless one may be in several parts. */
    const std::vector<int>& getPlaces() const {
        return places;
    }
    /** Of all expressions; as many numbers follow, which are their changes in a step, and then the lengths of distances. */
    int getNumParameters() const {
        return numParameters;
    }
    /** The places among these of those that users know, in the order in which they were given; the others never move. */
    const std::vector<int>& getGivenParameters() const {
        return givenParameters;
    }
    /** All of these: parameters as they were given, and no changes. */
    const std::vector<double>& getParameters() const {
        return parameters;
    }
    /** Write the parameters of an expression, by the number that it was given, into those of all. */
    void writeParameters(int expression, const std::map<std::string, double>& values, std::vector<double>& all) const;
    int getNumConstraints() const {
        return numConstraints;
    }
    /** The row of each expression, in the order in which they were given, among those of all parts. */
    const std::vector<int>& getRows() const {
        return rowOfExpression;
    }
    /** Of each row of all parts: its constraint, as it was given. */
    const std::vector<int>& getConstraints() const {
        return constraints;
    }
    /** Numbers that the parts work with. */
    size_t getNumWork() const {
        return numWork;
    }
    /** The largest numbers among the parts: levels, and entries of the factor below the diagonal. */
    int getNumLevels() const {
        return numLevels;
    }
    size_t getNumFactorEntries() const {
        return numFactorEntries;
    }

private:
    struct Row;
    struct Part;
    void addPart(const Part& part, const std::vector<double>& inverseMasses);
    int kindOf(const ExpressionConstraint& constraint);
    std::vector<std::unique_ptr<ExpressionDerivatives>> kinds; // the first is that of distances
    typedef std::pair<std::string, std::vector<std::string>>
        Kind; // the expression, the number of particles, names of parameters
    static Kind nameKind(const ExpressionConstraint& constraint);
    std::map<Kind, int> numberOfKind;
    std::vector<int> parts, tables, places;
    std::vector<int> firstParameters, rowOfExpression; // of each expression
    std::vector<int> givenParameters, constraints;
    std::vector<double> parameters;
    int numParameters, numConstraints, numLevels;
    size_t numWork, numFactorEntries;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_EXPRESSIONCLUSTERS_H_
