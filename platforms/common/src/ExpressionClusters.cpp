// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionClusters.h"
#include "ExpressionCode.h"
#include "ExpressionTexts.h"
#include "LargeClusters.h"
#include <algorithm>
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

} // namespace

struct ExpressionClusters::Row {
    int kind, firstParameter, expression; // the last is NONE for a distance
    vector<int> particles;
    int constraint = NONE; // as it was given
};

// Clusters one after the other, each in its own order of elimination.
struct ExpressionClusters::Part {
    vector<Row> rows;
    vector<int> firstRows; // of each cluster
    vector<int> levels;    // of each row
    FactorColumns columns;
};

ExpressionClusters::ExpressionClusters(const ClusterLayout& layout, const vector<ExpressionConstraint>& given) :
        numParameters(0), numConstraints(0), numLevels(0), numWork(0), numFactorEntries(0) {
    if (given.empty())
        return;
    const vector<ExpressionConstraint> expressions = shareTexts(given);
    kindOf({DISTANCE_EXPRESSION, {0, 1}, {{"length", 1.0}}});
    vector<int> kindsOfExpressions;
    for (const ExpressionConstraint& constraint : expressions) {
        const size_t expression = firstParameters.size();
        firstParameters.push_back((int) parameters.size());
        kindsOfExpressions.push_back(kindOf(constraint));
        for (size_t i = 0; i < given[expression].parameters.size(); i++) // numbers of the text come behind them
            givenParameters.push_back((int) (parameters.size() + i));
        for (const auto& parameter : constraint.parameters)
            parameters.push_back(parameter.second);
    }
    rowOfExpression.resize(expressions.size());
    numParameters = (int) parameters.size();
    parameters.resize(2 * numParameters, 0.0);
    const int numDistances = (int) layout.distances.size();
    auto makeRow = [&](int k) {
        const int e = k - numDistances;
        if (e >= 0)
            return Row{kindsOfExpressions[e], firstParameters[e], e, expressions[e].particles, k};
        parameters.push_back(layout.distances[k].length);
        return Row{DISTANCE,
                   (int) parameters.size() - 1,
                   NONE,
                   {layout.distances[k].particle1, layout.distances[k].particle2},
                   k};
    };
    std::map<int, ClusterElimination> eliminations; // of each kind
    Part open;
    for (const ClusterLayout::Cluster& cluster : layout.clusters) {
        const ClusterKind& kind = layout.kinds[cluster.kind];
        if (!kind.hasExpressions)
            continue;
        if (eliminations.count(cluster.kind) == 0)
            eliminations[cluster.kind] = kind.eliminateInRounds();
        if (!open.rows.empty() && (int) open.rows.size() + kind.getNumConstraints() > PART_SIZE) {
            addPart(open, layout.inverseMasses);
            open = Part();
        }
        open.firstRows.push_back((int) open.rows.size());
        const ClusterElimination::Piece& piece = eliminations[cluster.kind].pieces[0];
        for (int place : piece.constraints)
            open.rows.push_back(makeRow(kind.getConstraint(cluster.number, place)));
        open.levels.insert(open.levels.end(), piece.levels.begin(), piece.levels.end());
        open.columns.append(piece.columns);
    }
    addPart(open, layout.inverseMasses);
}

ExpressionClusters::ExpressionClusters(const ClusterLayout& layout) :
        numParameters(0), numConstraints(0), numLevels(0), numWork(0), numFactorEntries(0) {
    kindOf({DISTANCE_EXPRESSION, {0, 1}, {{"length", 1.0}}});
    for (const ClusterKind* kind : LargeClusters::findKinds(layout)) {
        const ClusterElimination elimination = kind->eliminateInRounds();
        const ClusterElimination::Piece& whole = elimination.pieces[0];
        for (int c = 0; c < kind->getNumClusters(); c++) {
            const int first = (int) parameters.size();
            for (int k = 0; k < kind->getNumConstraints(); k++)
                parameters.push_back(layout.distances[kind->getConstraint(c, k)].length);
            Part part;
            for (int k : whole.constraints) {
                const vector<int>& ends = kind->particlesOf[k];
                part.rows.push_back(
                    {DISTANCE, first + k, NONE, {kind->getParticle(c, ends[0]), kind->getParticle(c, ends[1])}});
            }
            part.firstRows = {0};
            part.levels = whole.levels;
            part.columns = whole.columns;
            addPart(part, layout.inverseMasses);
        }
    }
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

void ExpressionClusters::addPart(const Part& part, const vector<double>& inverseMasses) {
    const vector<Row>& rows = part.rows;
    const vector<int>& firstRows = part.firstRows;
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
                if ((inverseMasses[i] > 0) == isMoving && placeOf.emplace(i, (int) atoms.size()).second)
                    atoms.push_back(i);
        }
        if (isMoving)
            clusterStart.push_back((int) atoms.size());
    }
    const int numParticles = (int) atoms.size();

    // All clusters are eliminated at once, level by level.
    vector<int> eliminated(numRows), placeOfRow(numRows), levels;
    std::iota(eliminated.begin(), eliminated.end(), 0);
    std::stable_sort(eliminated.begin(), eliminated.end(),
                     [&](int a, int b) { return part.levels[a] < part.levels[b]; });
    for (int place = 0; place < numRows; place++) {
        placeOfRow[eliminated[place]] = place;
        while ((int) levels.size() <= part.levels[eliminated[place]])
            levels.push_back(place);
    }
    const int numPartLevels = (int) levels.size();
    levels.push_back(numRows);

    vector<int> columnStart(1, 0), slotRow, slotColumn; // of L
    vector<vector<pair<int, int>>> slotsOf(numRows); // of each row of L: columns and slots
    for (int place = 0; place < numRows; place++) {
        const int column = eliminated[place];
        for (const int* row = part.columns.begin(column); row != part.columns.end(column); ++row) {
            slotsOf[placeOfRow[*row]].push_back({place, (int) slotRow.size()});
            slotRow.push_back(placeOfRow[*row]);
            slotColumn.push_back(place);
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
        const Row& row = rows[eliminated[place]];
        kindOfRow.push_back(row.kind);
        rowParameter.push_back(row.firstParameter);
        rowEntry.push_back((int) entryPlaces.size());
        constraints.push_back(row.constraint);
        if (row.expression != NONE)
            rowOfExpression[row.expression] = numConstraints + place;
        for (int i : row.particles) {
            if (inverseMasses[i] > 0)
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
    table[NumLevels] = numPartLevels;
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
    numLevels = std::max(numLevels, numPartLevels);
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
