// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/SparseFactor.h"
#include <Eigen/Core>
#include <algorithm>
#include <cmath>

using namespace OpenMMVRattle;
using std::vector;

typedef FactorPattern::Panel Panel;
typedef FactorPattern::Source Source;

namespace {

typedef Eigen::Map<Eigen::MatrixXd, 0, Eigen::OuterStride<>> Block;
typedef Eigen::Map<const Eigen::MatrixXd, 0, Eigen::OuterStride<>> ConstBlock;

// The number of columns that are factorised before their products are subtracted from the next ones as a matrix product.
const int BLOCK_WIDTH = 32;

} // namespace

SparseFactor::SparseFactor(const FactorPattern& pattern) :
        pattern(pattern), values(pattern.getNumValues()), diagonal(pattern.getNumColumns()),
        placeOf(pattern.getPanels().empty() ? 0 : pattern.getNumColumns() + pattern.getNumOuter()),
        work(pattern.getLargestHeight()) {
    for (int column = pattern.getNumNarrow(); column < pattern.getNumColumns(); column++)
        diagonalSlots.push_back(pattern.getDiagonal(column));
    size_t largest = 0;
    for (const auto& list : pattern.getSources())
        for (const Source& source : list) {
            const Panel& from = pattern.getPanels()[source.panel];
            largest = std::max(largest, (from.endRow - from.firstRow - source.begin) * (source.end - source.begin));
        }
    product.resize(largest);
}

void SparseFactor::clear() {
    std::fill(values.begin(), values.end(), 0.0);
}

void SparseFactor::keepDiagonal() {
    const auto narrow = values.begin() + pattern.getRows().size();
    std::copy(narrow, narrow + pattern.getNumNarrow(), diagonal.begin());
    for (size_t k = 0; k < diagonalSlots.size(); k++)
        diagonal[pattern.getNumNarrow() + k] = values[diagonalSlots[k]];
}

int SparseFactor::factorize(double minPivot) {
    const int failed = eliminateNarrow(minPivot);
    if (failed != REGULAR)
        return failed;
    const vector<Panel>& panels = pattern.getPanels();
    for (size_t p = 0; p < panels.size(); p++) {
        const Panel& panel = panels[p];
        if (!pattern.getSources()[p].empty()) {
            for (int column = panel.first; column < panel.end; column++)
                placeOf[column] = column - panel.first;
            for (size_t k = panel.firstRow; k < panel.endRow; k++)
                placeOf[pattern.getPanelRows()[k]] = panel.getWidth() + (int) (k - panel.firstRow);
            update(pattern.getSources()[p], values.data() + panel.firstValue, panel.getHeight());
        }
        const int failedColumn = factorizePanel(panel, minPivot);
        if (failedColumn != REGULAR)
            return failedColumn;
    }
    if (!panels.empty() && pattern.getNumOuter() > 0) {
        for (int row = 0; row < pattern.getNumOuter(); row++)
            placeOf[pattern.getNumColumns() + row] = row;
        update(pattern.getSources().back(), values.data() + pattern.getFirstOuterValue(), pattern.getNumOuter());
    }
    return REGULAR;
}

int SparseFactor::eliminateNarrow(double minPivot) {
    const vector<size_t>& columnStart = pattern.getColumnStart();
    const double* pivots = values.data() + pattern.getRows().size();
    const unsigned* update = pattern.getUpdates().data();
    double* const all = values.data();
    for (int column = 0; column < pattern.getNumNarrow(); column++) {
        const double pivot = pivots[column];
        if (!(pivot > minPivot * diagonal[column]))
            return column;
        const double inverse = 1 / pivot;
        diagonal[column] = inverse;
        const int count = (int) (columnStart[column + 1] - columnStart[column]);
        double* entry = all + columnStart[column];
        for (int b = 0; b < count; b++) {
            const double scaled = entry[b] * inverse;
            for (int a = b; a < count; a++)
                all[*update++] -= entry[a] * scaled;
            entry[b] = scaled;
        }
    }
    return REGULAR;
}

// Subtract the products of finished panels from one whose rows have the places placeOf.
void SparseFactor::update(const vector<Source>& sources, double* target, int height) {
    for (const Source& source : sources) {
        const Panel& from = pattern.getPanels()[source.panel];
        const int* row = pattern.getPanelRows().data() + from.firstRow;
        const int count = (int) (from.endRow - from.firstRow) - source.begin, columns = source.end - source.begin;
        const ConstBlock left(values.data() + from.firstValue + from.getWidth() + source.begin, count, from.getWidth(),
                              Eigen::OuterStride<>(from.getHeight()));
        Eigen::Map<Eigen::MatrixXd> result(product.data(), count, columns);
        result.noalias() = left * left.topRows(columns).transpose();
        for (int b = 0; b < columns; b++) {
            double* column = target + (size_t) placeOf[row[source.begin + b]] * height;
            for (int a = b; a < count; a++)
                column[placeOf[row[source.begin + a]]] -= result(a, b);
        }
    }
}

int SparseFactor::factorizePanel(const Panel& panel, double minPivot) {
    const int height = panel.getHeight(), width = panel.getWidth();
    Block all(values.data() + panel.firstValue, height, width, Eigen::OuterStride<>(height));
    for (int first = 0; first < width; first += BLOCK_WIDTH) {
        const int count = std::min(BLOCK_WIDTH, width - first), below = height - first - count;
        auto block = all.block(first, first, height - first, count);
        if (first > 0) {
            const auto left = all.block(first, 0, height - first, first);
            block.noalias() -= left * left.topRows(count).transpose();
        }
        for (int k = 0; k < count; k++) {
            double* column = &block(0, k);
            double pivot = column[k];
            if (!(pivot > minPivot * diagonal[panel.first + first + k]))
                return panel.first + first + k;
            pivot = std::sqrt(pivot);
            column[k] = pivot;
            for (int a = k + 1; a < count; a++)
                column[a] /= pivot;
            for (int b = k + 1; b < count; b++)
                for (int a = b; a < count; a++)
                    block(a, b) -= column[a] * column[b];
        }
        if (below > 0) {
            auto rest = block.bottomRows(below);
            block.topRows(count)
                .template triangularView<Eigen::Lower>()
                .transpose()
                .template solveInPlace<Eigen::OnTheRight>(rest);
        }
    }
    return REGULAR;
}

void SparseFactor::eliminate(double* x, double* outer) const {
    const vector<size_t>& columnStart = pattern.getColumnStart();
    const int* rows = pattern.getRows().data();
    const int numColumns = pattern.getNumColumns(), numNarrow = pattern.getNumNarrow();
    if (pattern.getNumOuter() == 0)
        for (int column = 0; column < numNarrow; column++) {
            const double value = x[column];
            for (size_t i = columnStart[column]; i < columnStart[column + 1]; i++)
                x[rows[i]] -= values[i] * value;
            x[column] = value * diagonal[column];
        }
    else
        for (int column = 0; column < numNarrow; column++) {
            const double value = x[column];
            const size_t end = columnStart[column + 1], firstOuter = end - pattern.getNumOuterEntries()[column];
            size_t i = columnStart[column];
            for (; i < firstOuter; i++)
                x[rows[i]] -= values[i] * value;
            for (; i < end; i++)
                outer[rows[i] - numColumns] -= values[i] * value;
            x[column] = value * diagonal[column];
        }
    for (const Panel& panel : pattern.getPanels()) {
        const int width = panel.getWidth(), below = panel.getHeight() - width;
        const ConstBlock all(values.data() + panel.firstValue, panel.getHeight(), width,
                             Eigen::OuterStride<>(panel.getHeight()));
        Eigen::Map<Eigen::VectorXd> own(x + panel.first, width), rest(work.data(), below);
        all.topRows(width).triangularView<Eigen::Lower>().solveInPlace(own);
        rest.noalias() = all.bottomRows(below) * own;
        const int* row = pattern.getPanelRows().data() + panel.firstRow;
        for (int k = 0; k < below; k++)
            (row[k] < numColumns ? x[row[k]] : outer[row[k] - numColumns]) -= rest[k];
    }
}

void SparseFactor::substitute(double* x, const double* outer) const {
    const vector<size_t>& columnStart = pattern.getColumnStart();
    const int* rows = pattern.getRows().data();
    const int numColumns = pattern.getNumColumns();
    for (auto panel = pattern.getPanels().rbegin(); panel != pattern.getPanels().rend(); ++panel) {
        const int width = panel->getWidth(), below = panel->getHeight() - width;
        const ConstBlock all(values.data() + panel->firstValue, panel->getHeight(), width,
                             Eigen::OuterStride<>(panel->getHeight()));
        Eigen::Map<Eigen::VectorXd> own(x + panel->first, width), rest(work.data(), below);
        const int* row = pattern.getPanelRows().data() + panel->firstRow;
        for (int k = 0; k < below; k++)
            rest[k] = row[k] < numColumns ? x[row[k]] : outer[row[k] - numColumns];
        own.noalias() -= all.bottomRows(below).transpose() * rest;
        all.topRows(width).triangularView<Eigen::Lower>().transpose().solveInPlace(own);
    }
    for (int column = pattern.getNumNarrow() - 1; column >= 0; column--) {
        double value = x[column];
        const size_t end = columnStart[column + 1];
        const size_t firstOuter = end - (pattern.getNumOuter() == 0 ? 0 : pattern.getNumOuterEntries()[column]);
        size_t i = columnStart[column];
        for (; i < firstOuter; i++)
            value -= values[i] * x[rows[i]];
        for (; i < end; i++)
            value -= values[i] * outer[rows[i] - numColumns];
        x[column] = value;
    }
}
