// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionCheck.h"
#include "lepton/ExpressionTreeNode.h"
#include "lepton/Operation.h"
#include "lepton/ParsedExpression.h"
#include "lepton/Parser.h"
#include <cstdlib>
#include <set>

using Lepton::ExpressionTreeNode;
using Lepton::Operation;
using std::string;

namespace OpenMMVRattle {

namespace {

void findVariables(const ExpressionTreeNode& node, std::set<string>& variables) {
    if (node.getOperation().getId() == Operation::VARIABLE)
        variables.insert(node.getOperation().getName());
    for (const ExpressionTreeNode& child : node.getChildren())
        findVariables(child, variables);
}

// The number of the particle whose coordinate a name is (x1, y1, z1, x2, ...); 0 if it is no coordinate.
int particleOfCoordinate(const string& name) {
    if (name.size() < 2 || name.size() > 10 || name[0] < 'x' || name[0] > 'z' || name[1] == '0' ||
        name.find_first_not_of("0123456789", 1) != string::npos)
        return 0;
    return std::atoi(name.c_str() + 1);
}

} // namespace

void requireValidExpression(const string& expression, int numParticles, const std::map<string, double>& parameters,
                            const IntegratorSettings& settings) {
    const auto require = [&](bool holds, const auto&... parts) {
        settings.require(holds, "the constraint \"", expression, "\" ", parts...);
    };
    std::set<string> variables;
    try {
        findVariables(Lepton::Parser::parse(expression).getRootNode(), variables);
    }
    catch (const std::exception& e) {
        require(false, "cannot be understood: ", e.what());
    }
    for (const auto& parameter : parameters)
        require(particleOfCoordinate(parameter.first) == 0, "has a parameter ", parameter.first,
                ", which is the name of a coordinate; give it another name");
    bool hasCoordinate = false;
    for (const string& name : variables) {
        const int particle = particleOfCoordinate(name);
        require(particle <= numParticles, "contains ", name, " and is of ", numParticles,
                numParticles == 1 ? " particle" : " particles", " alone; name as many particles as it contains");
        require(particle > 0 || parameters.count(name) > 0, "contains the variable ", name,
                ", which is neither a coordinate (x1, y1, z1, x2, ...) nor one of its parameters");
        hasCoordinate |= particle > 0;
    }
    require(hasCoordinate, "contains no coordinate (x1, y1, z1, x2, ...) and so constrains nothing");
}

} // namespace OpenMMVRattle
