// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ClusterAlgebra.h"
#include <algorithm>

using namespace OpenMMVRattle;
using std::string;
using std::to_string;
using std::vector;

namespace {

string at(const char* array, int i) {
    return string(array) + "[" + to_string(i) + "]";
}

string at(const char* array, int i, int j) {
    return string(array) + to_string(i) + "_" + to_string(j);
}

} // namespace

// The entries are those of the kind's elimination. Of the orders that have the same ones, one along a chain rather than from both ends lets
// fewer numbers wait in registers: maximum cardinality search (Tarjan and Yannakakis, SIAM J. Comput. 13, 1984) from the last constraint.
ClusterAlgebra::ClusterAlgebra(const ClusterKind& kind) : pairs(kind.particlesOf), order(kind.getNumConstraints()) {
    const ClusterElimination::Piece& piece = kind.elimination.pieces[0];
    const int n = kind.getNumConstraints();
    vector<int> columnOf(n), weights(n, 0);
    for (int column = 0; column < n; column++)
        columnOf[piece.constraints[column]] = column;
    auto isCoupled = [&](int k, int l) {
        const int row = std::max(columnOf[k], columnOf[l]), column = std::min(columnOf[k], columnOf[l]);
        return k == l || std::binary_search(piece.columns.begin(column), piece.columns.end(column), row);
    };
    for (int p = n - 1; p >= 0; p--) {
        order[p] = (int) (weights.rend() - std::max_element(weights.rbegin(), weights.rend())) - 1;
        for (int k = 0; k < n; k++)
            weights[k] += isCoupled(k, order[p]) && weights[k] >= 0 ? 1 : 0;
        weights[order[p]] = -1;
    }
    entries.assign(n, vector<int>(n, -1));
    int count = 0;
    for (int p = 0; p < n; p++)
        for (int i = p; i < n; i++)
            if (isCoupled(order[i], order[p]))
                entries[i][p] = entries[p][i] = count++;
}

int ClusterAlgebra::getNumEntries() const {
    int largest = -1;
    for (const vector<int>& row : entries)
        largest = std::max(largest, *std::max_element(row.begin(), row.end()));
    return largest + 1;
}

// How much a multiplier of l moves the distance vector of k along r[l]: the sum of the inverse masses of the particles that they
// share, with the sign of their ends; empty if there are none.
string ClusterAlgebra::weight(int k, int l) const {
    string sum;
    for (int endK = 0; endK < 2; endK++)
        for (int endL = 0; endL < 2; endL++) {
            if (pairs[k][endK] == pairs[l][endL])
                sum +=
                    (endK == endL ? (sum.empty() ? "" : " + ") : (sum.empty() ? "-" : " - ")) + at("w", pairs[k][endK]);
        }
    return sum.empty() ? sum : "(" + sum + ")";
}

string ClusterAlgebra::lower(int i, int j) const {
    return at("L", entries[i][j]);
}

string ClusterAlgebra::writeFactorize() const {
    const int n = (int) pairs.size();
    string text = "inline DEVICE bool factorize_KIND(VECTORS r, mixed* w, mixed* L) {\n    bool isRegular = true;\n";
    auto product = [&](int i, int j) {
        const string w = weight(order[i], order[j]);
        return w.empty() ? string("0")
                         : w + "*dotEachOther_KIND(r, " + to_string(order[i]) + ", " + to_string(order[j]) + ")";
    };
    for (int p = 0; p < n; p++)
        for (int i = p; i < n; i++)
            if (isEntry(i, p))
                text += "    " + lower(i, p) + " = " + product(i, p) + ";\n";
    for (int p = 0; p < n; p++) {
        text += "    isRegular = isRegular && " + lower(p, p) + " > (mixed) MIN_PIVOT*" + product(p, p) + ";\n";
        text += "    " + lower(p, p) + " = 1/" + lower(p, p) + ";\n";
        for (int i = n - 1; i > p; i--) { // a column's own entries are divided last
            if (!isEntry(i, p))
                continue;
            text += "    {\n        const mixed f = " + lower(i, p) + "*" + lower(p, p) + ";\n";
            for (int j = p + 1; j <= i; j++)
                if (isEntry(j, p))
                    text += "        " + lower(i, j) + " -= f*" + lower(j, p) + ";\n";
            text += "        " + lower(i, p) + " = f;\n    }\n";
        }
    }
    return text + "    return isRegular;\n}\n\n";
}

string ClusterAlgebra::writeSolve() const {
    const int n = (int) pairs.size();
    string text = "inline DEVICE void solve_KIND(mixed* L, mixed* b) {\n";
    for (int p = 0; p < n; p++)
        for (int i = p + 1; i < n; i++)
            if (isEntry(i, p))
                text += "    " + at("b", order[i]) + " -= " + lower(i, p) + "*" + at("b", order[p]) + ";\n";
    for (int p = n - 1; p >= 0; p--) {
        text += "    " + at("b", order[p]) + " *= " + lower(p, p) + ";\n";
        for (int i = p + 1; i < n; i++)
            if (isEntry(i, p))
                text += "    " + at("b", order[p]) + " -= " + lower(i, p) + "*" + at("b", order[i]) + ";\n";
    }
    return text + "}\n\n";
}

string ClusterAlgebra::writeNewton() const {
    const int n = (int) pairs.size();
    string text = "inline DEVICE void newton_KIND(mixed (*s)[3], VECTORS r, mixed* w, mixed* b) {\n";
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            if (isEntry(i, j)) {
                const string w = weight(order[i], order[j]);
                text += "    FACTOR " + at("A", i, j) + " = " +
                        (w.empty() ? string("0")
                                   : "(FACTOR) (" + w + "*dotVector_KIND(r, " + to_string(order[j]) + ", " +
                                         at("s", order[i]) + "))") +
                        ";\n";
            }
    for (int p = 0; p < n; p++) {
        text += "    " + at("A", p, p) + " = 1/" + at("A", p, p) + ";\n";
        for (int i = p + 1; i < n; i++) {
            if (!isEntry(i, p))
                continue;
            text += "    {\n        const FACTOR f = " + at("A", i, p) + "*" + at("A", p, p) + ";\n";
            for (int j = p + 1; j < n; j++)
                if (isEntry(p, j))
                    text += "        " + at("A", i, j) + " -= f*" + at("A", p, j) + ";\n";
            text += "        " + at("b", order[i]) + " -= f*" + at("b", order[p]) + ";\n    }\n";
        }
    }
    for (int p = n - 1; p >= 0; p--) {
        for (int j = p + 1; j < n; j++)
            if (isEntry(p, j))
                text += "    " + at("b", order[p]) + " -= " + at("A", p, j) + "*" + at("b", order[j]) + ";\n";
        text += "    " + at("b", order[p]) + " *= " + at("A", p, p) + ";\n";
    }
    return text + "}\n\n";
}

string ClusterAlgebra::writeMove() const {
    const int n = (int) pairs.size();
    string text = "inline DEVICE void move_KIND(VECTORS r, mixed* w, mixed* x, mixed (*s)[3]) {\n";
    for (int k = 0; k < n; k++)
        for (int l = 0; l < n; l++) {
            const string w = weight(k, l);
            if (!w.empty())
                text += "    UNROLL for (int d = 0; d < 3; d++)\n        " + at("s", k) + "[d] += " + w + "*" +
                        at("x", l) + "*r[(" + to_string(3 * l) + " + d)*STRIDE];\n";
        }
    return text + "}\n";
}

string ClusterAlgebra::write() const {
    return writeFactorize() + writeSolve() + writeNewton() + writeMove();
}
