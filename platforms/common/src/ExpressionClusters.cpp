// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionClusters.h"
#include "ExpressionCode.h"
#include "ExpressionTexts.h"
#include "constraints/EliminationOrder.h"
#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <utility>

using namespace OpenMMVRattle;
using std::pair;
using std::string;
using std::vector;

namespace {

// The numbers at the beginning of a part's table; kernels/expression.cc has the same. The lists are given by where they begin in
// the table.
enum Header {
    NumRows,
    NumParticles,
    NumEntries, // of G
    NumSlots,   // entries of L below the diagonal
    NumLevels,
    NumCoupled, // entries of K, the diagonal included
    FirstRow,   // among those of all parts
    FirstPlace, // likewise
    FirstWork,
    Atoms,
    Order, // rows of one kind after each other
    Kinds,
    RowEntry, // the first entry of G of each row
    RowParameter,
    EntryPlaces,    // the place in the part of each entry's particle
    IncidenceStart, // for each particle, entries of G and their rows
    Incidence,
    CoupledSlots, // for each entry of K where it goes, and pairs of entries of G
    ProductStart,
    Products,
    Levels,
    ColumnStart, // L by columns, and by rows
    SlotRow,
    SlotColumn,
    RowStart,
    RowSlot,
    RowColumn,
    NumClusters,
    ClusterStart, // by places; behind the last of them are particles that do not move
    HEADER_SIZE
};

const int DISTANCE = 0, NONE = -1;
// What has more is not compiled anew in each of the five or so places from which it is called, and keeps its registers to itself.
const size_t MANY_OPERATIONS = 2000;
const char INLINE[] = "inline ";
const char DISTANCE_EXPRESSION[] = "0.5*((x1-x2)^2 + (y1-y2)^2 + (z1-z2)^2 - length^2)";

int findRoot(vector<int>& parents, int i) {
    while (parents[i] != i)
        i = parents[i] = parents[parents[i]];
    return i;
}

} // namespace

struct ExpressionClusters::Row {
    int kind, firstParameter, expression; // the last is NONE for a distance
    vector<int> particles;
};

ExpressionClusters::ExpressionClusters(const OpenMM::System& system, const vector<ExpressionConstraint>& given) :
        isMember(system.getNumParticles(), false), numParameters(0), numConstraints(0), numLevels(0), numWork(0),
        numFactorEntries(0) {
    if (given.empty())
        return;
    const vector<ExpressionConstraint> expressions = shareTexts(given);
    kindOf({DISTANCE_EXPRESSION, {0, 1}, {{"length", 1.0}}});
    const int numParticles = system.getNumParticles();
    vector<double> masses(numParticles);
    for (int i = 0; i < numParticles; i++)
        masses[i] = system.getParticleMass(i);
    vector<int> parents(numParticles);
    std::iota(parents.begin(), parents.end(), 0);
    vector<Row> rows;
    auto add = [&](const Row& row) {
        int first = -1;
        for (int i : row.particles)
            if (masses[i] > 0) {
                first = first < 0 ? i : first;
                parents[findRoot(parents, i)] = findRoot(parents, first);
            }
        rows.push_back(row);
    };
    for (const ExpressionConstraint& constraint : expressions) {
        const int expression = (int) firstParameters.size();
        firstParameters.push_back((int) parameters.size());
        add({kindOf(constraint), (int) parameters.size(), expression, constraint.particles});
        for (size_t i = 0; i < given[expression].parameters.size(); i++) // numbers of the text come behind them
            givenParameters.push_back((int) (parameters.size() + i));
        for (const auto& parameter : constraint.parameters)
            parameters.push_back(parameter.second);
    }
    rowOfExpression.resize(expressions.size());
    numParameters = (int) parameters.size();
    parameters.resize(2 * numParameters, 0.0);
    for (int k = 0; k < system.getNumConstraints(); k++) {
        int i, j;
        double length;
        system.getConstraintParameters(k, i, j, length);
        if (masses[i] == 0 && masses[j] == 0)
            continue;
        add({DISTANCE, (int) parameters.size(), NONE, {i, j}});
        parameters.push_back(length); // of no use to those that are in no such cluster
    }
    auto rootOf = [&](const Row& row) {
        for (int i : row.particles)
            if (masses[i] > 0)
                return findRoot(parents, i);
        return -1; // refused when the constraint was checked
    };
    std::set<int> roots;
    for (size_t e = 0; e < expressions.size(); e++)
        roots.insert(rootOf(rows[e]));
    for (int i = 0; i < numParticles; i++)
        isMember[i] = masses[i] > 0 && roots.count(findRoot(parents, i)) > 0;
    std::map<int, vector<Row>> clusters;
    for (const Row& row : rows)
        if (roots.count(rootOf(row)) > 0)
            clusters[rootOf(row)].push_back(row);
    vector<Row> open;
    vector<int> firstRows; // of each cluster
    for (const auto& cluster : clusters) {
        if (!open.empty() && open.size() + cluster.second.size() > (size_t) PART_SIZE) {
            addPart(open, firstRows, masses);
            open.clear();
            firstRows.clear();
        }
        firstRows.push_back((int) open.size());
        open.insert(open.end(), cluster.second.begin(), cluster.second.end());
    }
    addPart(open, firstRows, masses);
}

ExpressionClusters::Kind ExpressionClusters::nameKind(const ExpressionConstraint& constraint) {
    Kind kind(constraint.expression, {std::to_string(constraint.particles.size())});
    for (const auto& parameter : constraint.parameters)
        kind.second.push_back(parameter.first);
    return kind;
}

size_t ExpressionClusters::findSize(const vector<ExpressionConstraint>& expressions) {
    std::set<Kind> known;
    size_t size = 0;
    for (const ExpressionConstraint& constraint : shareTexts(expressions))
        if (known.insert(nameKind(constraint)).second)
            size += ExpressionCode(ExpressionDerivatives(constraint)).getSize();
    return size;
}

int ExpressionClusters::kindOf(const ExpressionConstraint& constraint) {
    const auto found = numberOfKind.emplace(nameKind(constraint), (int) kinds.size());
    if (found.second)
        kinds.emplace_back(new ExpressionDerivatives(constraint));
    return found.first->second;
}

void ExpressionClusters::writeParameters(int expression, const std::map<string, double>& values,
                                         vector<double>& all) const {
    int place = firstParameters[expression];
    for (const auto& value : values) // in the order of their names
        all[place++] = value.second;
}

void ExpressionClusters::addPart(const vector<Row>& rows, const vector<int>& firstRows, const vector<double>& masses) {
    const int numRows = (int) rows.size();
    // The particles of one cluster after those of another; what does not move may be in several, and comes last.
    vector<int> atoms, clusterStart;
    std::map<int, int> placeOf;
    for (const bool isMoving : {true, false}) {
        auto nextCluster = firstRows.begin();
        for (int k = 0; k < numRows; k++) {
            if (isMoving && nextCluster != firstRows.end() && *nextCluster == k) {
                clusterStart.push_back((int) atoms.size());
                nextCluster++;
            }
            for (int i : rows[k].particles)
                if ((masses[i] > 0) == isMoving && placeOf.emplace(i, (int) atoms.size()).second)
                    atoms.push_back(i);
        }
        if (isMoving)
            clusterStart.push_back((int) atoms.size());
    }
    const int numParticles = (int) atoms.size();

    // An order of elimination.
    vector<vector<int>> rowsOf(numParticles);
    for (int k = 0; k < numRows; k++)
        for (int i : rows[k].particles)
            if (masses[i] > 0)
                rowsOf[placeOf[i]].push_back(k);
    std::set<pair<int, int>> coupled;
    for (const vector<int>& list : rowsOf)
        for (int a : list)
            for (int b : list)
                if (a > b)
                    coupled.insert({a, b});
    const EliminationOrder elimination = findEliminationRounds(numRows, MatrixEntries(coupled.begin(), coupled.end()));
    vector<int> placeOfRow(numRows), levels;
    for (int place = 0; place < numRows; place++) {
        placeOfRow[elimination.rows[place]] = place;
        while ((int) levels.size() <= elimination.levels[place])
            levels.push_back(place);
    }
    levels.push_back(numRows);

    // The columns of L: what the matrix has, and what eliminations fill in.
    vector<vector<int>> columns(numRows);
    for (const auto& entry : coupled) {
        const int a = placeOfRow[entry.first], b = placeOfRow[entry.second];
        columns[std::min(a, b)].push_back(std::max(a, b));
    }
    vector<int> columnStart(1, 0), slotRow, slotColumn;
    vector<vector<pair<int, int>>> slotsOf(numRows); // of each row of L: columns and slots
    for (int k = 0; k < numRows; k++) {
        vector<int>& column = columns[k];
        std::sort(column.begin(), column.end());
        column.erase(std::unique(column.begin(), column.end()), column.end());
        if (!column.empty())
            columns[column[0]].insert(columns[column[0]].end(), column.begin() + 1, column.end());
        for (int row : column) {
            slotsOf[row].push_back({k, (int) slotRow.size()});
            slotRow.push_back(row);
            slotColumn.push_back(k);
        }
        columnStart.push_back((int) slotRow.size());
    }
    vector<int> rowStart(1, 0), rowSlot, rowColumn;
    for (const auto& list : slotsOf) {
        for (const auto& slot : list) {
            rowColumn.push_back(slot.first);
            rowSlot.push_back(slot.second);
        }
        rowStart.push_back((int) rowSlot.size());
    }

    // The rows of G in that order.
    vector<int> kindOfRow, rowEntry, rowParameter, entryPlaces, order(numRows);
    vector<vector<pair<int, int>>> entriesOf(numParticles); // and their rows
    for (int place = 0; place < numRows; place++) {
        const Row& row = rows[elimination.rows[place]];
        kindOfRow.push_back(row.kind);
        rowParameter.push_back(row.firstParameter);
        rowEntry.push_back((int) entryPlaces.size());
        if (row.expression != NONE)
            rowOfExpression[row.expression] = numConstraints + place;
        for (int i : row.particles) {
            if (masses[i] > 0)
                entriesOf[placeOf[i]].push_back({(int) entryPlaces.size(), place});
            entryPlaces.push_back(placeOf[i]);
        }
    }
    rowEntry.push_back((int) entryPlaces.size());
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return kindOfRow[a] < kindOfRow[b]; });

    // K as sums of products of entries of G, that of the later row first.
    std::map<int, vector<int>> products;
    for (const auto& list : entriesOf)
        for (const auto& a : list)
            for (const auto& b : list)
                if (a.second >= b.second) {
                    const auto& row = slotsOf[a.second];
                    const int slot =
                        a.second == b.second
                            ? a.second
                            : numRows + std::lower_bound(row.begin(), row.end(), pair<int, int>(b.second, 0))->second;
                    products[slot].insert(products[slot].end(), {a.first, b.first});
                }
    vector<int> coupledSlots, productStart(1, 0), productList, incidenceStart(1, 0), incidence;
    for (const auto& slot : products) {
        coupledSlots.push_back(slot.first);
        productList.insert(productList.end(), slot.second.begin(), slot.second.end());
        productStart.push_back((int) productList.size() / 2);
    }
    for (const auto& list : entriesOf) {
        for (const auto& entry : list)
            incidence.insert(incidence.end(), {entry.first, entry.second});
        incidenceStart.push_back((int) incidence.size() / 2);
    }

    vector<int> table(HEADER_SIZE, 0);
    auto addList = [&](Header field, const vector<int>& list) {
        table[field] = (int) table.size();
        table.insert(table.end(), list.begin(), list.end());
    };
    const int numEntries = (int) entryPlaces.size(), numSlots = (int) slotRow.size();
    table[NumRows] = numRows;
    table[NumParticles] = numParticles;
    table[NumEntries] = numEntries;
    table[NumSlots] = numSlots;
    table[NumLevels] = elimination.numLevels;
    table[NumCoupled] = (int) coupledSlots.size();
    table[FirstRow] = numConstraints;
    table[FirstPlace] = (int) places.size();
    table[FirstWork] = (int) numWork;
    addList(Atoms, atoms);
    addList(Order, order);
    addList(Kinds, kindOfRow);
    addList(RowEntry, rowEntry);
    addList(RowParameter, rowParameter);
    addList(EntryPlaces, entryPlaces);
    addList(IncidenceStart, incidenceStart);
    addList(Incidence, incidence);
    addList(CoupledSlots, coupledSlots);
    addList(ProductStart, productStart);
    addList(Products, productList);
    addList(Levels, levels);
    addList(ColumnStart, columnStart);
    addList(SlotRow, slotRow);
    addList(SlotColumn, slotColumn);
    addList(RowStart, rowStart);
    addList(RowSlot, rowSlot);
    addList(RowColumn, rowColumn);
    table[NumClusters] = (int) firstRows.size();
    addList(ClusterStart, clusterStart);
    parts.push_back((int) tables.size());
    tables.insert(tables.end(), table.begin(), table.end());
    places.insert(places.end(), atoms.begin(), atoms.end());
    numConstraints += numRows;
    // Vectors and terms, G twice, numbers of the rows, the factors of K and of Newton's matrix; see openPart() in kernels/expression.cc.
    numWork += (16 + NUM_TERMS) * (size_t) numParticles + 6 * (size_t) numEntries + 7 * (size_t) numRows +
               3 * (size_t) numSlots;
    numLevels = std::max(numLevels, elimination.numLevels);
    numFactorEntries = std::max(numFactorEntries, (size_t) numSlots);
}

string ExpressionClusters::writeFunctions() const {
    string text;
    size_t size = 0;
    for (size_t i = 0; i < kinds.size(); i++) {
        const ExpressionCode code(*kinds[i]);
        text += code.write("_E" + std::to_string(i));
        size += code.getSize();
    }
    auto choose = [&](const string& type, const string& name, const string& function, const string& parameterList,
                      const string& arguments, const string& ofDistances = "") {
        text += "inline DEVICE " + type + " " + name + "(int kind, " + parameterList + ") {\n";
        const string call = type == "void" ? "" : "result = ";
        if (!call.empty())
            text += "    mixed result = 0;\n";
        for (size_t i = 0; i < kinds.size(); i++)
            text += string("    ") + (i == 0 ? "" : "else ") + "if (kind == " + std::to_string(i) + ")\n        " +
                    (i > 0 || ofDistances.empty() ? call + function + "_E" + std::to_string(i) + "(" + arguments + ")"
                                                  : "result = " + ofDistances) +
                    ";\n";
        text += (call.empty() ? string() : string("    return result;\n")) + "}\n\n";
    };
    const string x = "GLOBAL const mixed* x, ", v = "GLOBAL const mixed* v, ",
                 theta = "GLOBAL const int* at, GLOBAL const mixed* theta",
                 rates = ", GLOBAL const mixed* rates, mixed factor";
    choose("mixed", "findValue", "value", x + theta, "x, at, theta");
    choose("mixed", "findMotion", "motion", x + theta + rates, "x, at, theta, rates, factor", "0");
    choose("mixed", "findCurvature", "curvature", x + v + theta, "x, v, at, theta");
    choose("mixed", "findMovingCurvature", "movingCurvature", x + v + theta + rates, "x, v, at, theta, rates, factor",
           "curvature_E0(x, v, at, theta)");
    choose("void", "findGradient", "gradient", x + theta + ", GLOBAL mixed* G", "x, at, theta, G");
    text += "/** The number of its parameters that may move. */\ninline DEVICE int countMovable(int kind) {\n";
    for (size_t i = 1; i < kinds.size(); i++)
        text += "    if (kind == " + std::to_string(i) + ")\n        return " +
                std::to_string(kinds[i]->parameters.size()) + ";\n";
    text += "    return 0;\n}\n\n";
    if (size > MANY_OPERATIONS)
        for (size_t at = text.find(INLINE); at != string::npos; at = text.find(INLINE, at))
            text.replace(at, string(INLINE).size(), "__attribute__((noinline)) ");
    return text;
}
