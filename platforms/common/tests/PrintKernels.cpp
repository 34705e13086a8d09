// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Writes the text that devices are given, for compilers that need no device: PrintKernels <precision> <monitor> <update> <graphs>
// with the numbers of a monitor and an update (3 for automatic step control, 4 for Langevin dynamics), and graphs "common" (hydrogens
// on heavy atoms, rigid water), "large" (a long chain too, in pieces that wait for each other, and a short one), "newton" (the same with
// Newton's iteration), "dense" (many bonds on one particle), "expressions" (angles, and all functions), or "rare" with the number of a graph of up to
// eight constraints, for that alone.

#include "StepProgram.h"
#include "TestSupport.h"
#include <fstream>
#include <memory>

using namespace OpenMMVRattle;
using std::string;
using std::vector;

int main(int argc, char** argv) {
    if (argc != 5) {
        std::cerr << "PrintKernels <precision> <monitor> <update> common|large|newton|dense|expressions|rare<number>"
                  << std::endl;
        return 2;
    }
    const bool hasNewton = string(argv[4]) == "newton";
    const string precision = argv[1], graphs = hasNewton ? "large" : argv[4];
    vector<double> masses;
    vector<DistanceConstraint> distances;
    auto add = [&](const vector<std::pair<int, int>>& pairs) {
        const int first = (int) masses.size();
        int numAtoms = 1;
        for (const auto& pair : pairs)
            numAtoms = std::max(numAtoms, std::max(pair.first, pair.second) + 1);
        masses.resize(first + numAtoms, 12);
        for (const auto& pair : pairs)
            distances.push_back({first + pair.first, first + pair.second, 0.1});
    };
    const vector<vector<std::pair<int, int>>> common = {
        {}, {{0, 1}}, {{0, 1}, {0, 2}}, {{0, 1}, {0, 2}, {0, 3}}, {{0, 1}, {0, 2}, {1, 2}}};
    const vector<vector<std::pair<int, int>>> rare = {{{0, 1}, {1, 2}, {2, 3}}, // chains
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 4}},
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}},
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 6}},
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 6}, {6, 7}},
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 6}, {6, 7}, {7, 8}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {0, 4}}, // stars
                                                      {{0, 1}, {0, 2}, {0, 3}, {0, 4}, {0, 5}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {0, 4}, {0, 5}, {0, 6}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {0, 4}, {0, 5}, {0, 6}, {0, 7}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {0, 4}, {0, 5}, {0, 6}, {0, 7}, {0, 8}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}}, // a tetrahedron
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 0}, {0, 2}}, // rings
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 0}},
                                                      {{0, 1}, {1, 2}, {2, 3}, {3, 0}, {0, 4}, {1, 5}, {2, 6}, {3, 7}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}, {3, 4}, {4, 5}},
                                                      {{0, 1}, {0, 2}, {0, 3}, {0, 4}, {1, 2}, {2, 3}, {3, 4}, {4, 1}}};
    if (graphs.find("rare") == 0)
        add(rare.at(std::stoi(graphs.substr(4))));
    else
        for (const auto& pairs : common)
            add(pairs);
    vector<std::pair<int, int>> bonds;
    for (int i = 0; i < 400; i++)
        bonds.emplace_back(graphs == "large" ? i : 0, i + 1);
    if (graphs == "large" || graphs == "dense")
        add(bonds);
    const int updateNumber = std::stoi(argv[3]);
    const bool isAutomatic = updateNumber == 3, isLangevin = updateNumber == 4;
    if (graphs == "large")
        add(rare[5]); // whose vectors share the memory of pieces
    vector<StepMonitor::Term> terms;
    if (!isAutomatic)
        terms.push_back({(StepMonitor::Kind) std::stoi(argv[2]), 1, 1, 1});
    const StepProgram::Update update = isAutomatic ? StepProgram::Automatic
                                       : isLangevin
                                           ? StepProgram::Langevin
                                           : StepProgram::updateOf(terms, false, (StepDensity::Update) updateNumber);
    vector<ExpressionConstraint> expressions;
    if (graphs == "expressions") {
        expressions.push_back({"acos(d/sqrt(a*b))-angle; a=(x1-x2)^2+(y1-y2)^2+(z1-z2)^2;"
                               " b=(x3-x2)^2+(y3-y2)^2+(z3-z2)^2; d=(x1-x2)*(x3-x2)+(y1-y2)*(y3-y2)+(z1-z2)*(z3-z2)",
                               {3, 4, 5},
                               {{"angle", 1.9}}});
        expressions.push_back({"x1^2.5+x1^y1+exp(x1)+log(y1)+sin(x1)+cos(y1)+sec(x1)+csc(y1)+tan(x1)+cot(y1)+asin(x1)"
                               "+acos(y1)+atan(x1)+atan2(x1,y1)+sinh(x1)+cosh(y1)+tanh(x1)+erf(y1)+erfc(x1)+step(x1)"
                               "+delta(y1)+min(x1,y1)+max(x1,y1)+abs(z1)+floor(x1)+ceil(y1)+select(z1,x1,1/0+y1)",
                               {0},
                               {}});
    }
    const ClusterLayout layout(masses, distances, expressions);
    const std::unique_ptr<ExpressionClusters> clusters(
        expressions.empty() ? nullptr : new ExpressionClusters(layout, expressions));
    const int mixedSize = precision == "single" ? 4 : 8, realSize = precision == "double" ? 8 : 4;
    const LargeClusters large(layout,
                              {StepProgram::getGroupSize(true), 40 * 1024, 132, 32, mixedSize, realSize, 792, 64});
    const std::unique_ptr<ExpressionClusters> newton(hasNewton ? new ExpressionClusters(layout) : nullptr);
    const StepProgram program(layout, large, clusters.get(), newton.get(), StepProgram::getGroupSize(true), terms,
                              update, precision != "single", true);
    for (const auto& define : program.getDefines())
        std::cout << "#define " << define.first << " " << define.second << "\n";
    std::cout << program.getSource();
}
