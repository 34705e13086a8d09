// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/FactorPattern.h"
#include <algorithm>

using namespace OpenMMVRattle;
using std::vector;

namespace {

// A panel may have this fraction of zeros in it, or so many, since the fewer panels there are the denser is the arithmetic.
const double MAX_ZEROS = 0.15;
const size_t FEW_ZEROS = 64;

} // namespace

FactorPattern::FactorPattern(const FactorColumns& columns, int numOuter) :
        numColumns(columns.getNumColumns()), numOuter(numOuter), numNarrow(0), firstOuterValue(0) {
    while (numNarrow < numColumns && columns.getCount(numNarrow) < (size_t) EliminationOrder::WIDE)
        numNarrow++;
    columnStart.assign(columns.start.begin(), columns.start.begin() + numNarrow + 1);
    rows.assign(columns.rows.begin(), columns.rows.begin() + columnStart.back());
    for (int column = 0; column < numNarrow; column++)
        numOuterEntries.push_back(
            (int) (columns.end(column) - std::lower_bound(columns.begin(column), columns.end(column), numColumns)));
    findPanels(columns);
    findSources();
    findUpdates();
}

void FactorPattern::findPanels(const FactorColumns& columns) {
    size_t numValues = rows.size() + numNarrow;
    for (int first = numNarrow; first < numColumns;) {
        Panel panel = {first, first + 1, panelRows.size(), 0, numValues};
        size_t needed = 1 + columns.getCount(first);
        while (panel.end < numColumns && columns.getParent(panel.end - 1) == panel.end) {
            const size_t width = (size_t) panel.getWidth() + 1, count = columns.getCount(panel.end);
            const size_t stored = width * (width + 1) / 2 + width * count, used = needed + count + 1;
            if (stored - used > std::max(FEW_ZEROS, (size_t) (MAX_ZEROS * (double) stored)))
                break;
            needed = used;
            panel.end++;
        }
        panelOf.insert(panelOf.end(), panel.getWidth(), (int) panels.size());
        // The last column has the rows of those before it too, whose elimination has gone through it.
        panelRows.insert(panelRows.end(), columns.begin(panel.end - 1), columns.end(panel.end - 1));
        panel.endRow = panelRows.size();
        numValues += (size_t) panel.getWidth() * panel.getHeight();
        panels.push_back(panel);
        first = panel.end;
    }
    firstOuterValue = numValues;
}

void FactorPattern::findSources() {
    sources.resize(panels.size() + 1);
    for (size_t p = 0; p < panels.size(); p++) {
        const int* row = panelRows.data() + panels[p].firstRow;
        const int count = (int) (panels[p].endRow - panels[p].firstRow);
        auto targetOf = [&](int k) { return row[k] < numColumns ? panelOf[row[k] - numNarrow] : (int) panels.size(); };
        for (int begin = 0; begin < count;) {
            int end = begin;
            const int target = targetOf(begin);
            while (end < count && targetOf(end) == target)
                end++;
            sources[target].push_back({(int) p, begin, end});
            begin = end;
        }
    }
}

unsigned FactorPattern::findSlot(int row, int column) const {
    if (column >= numColumns) {
        const size_t outer = (size_t) (column - numColumns);
        return (unsigned) (firstOuterValue + outer * numOuter + (row - numColumns));
    }
    if (column < numNarrow) {
        if (row == column)
            return (unsigned) (rows.size() + row);
        const auto begin = rows.begin() + columnStart[column], end = rows.begin() + columnStart[column + 1];
        return (unsigned) (std::lower_bound(begin, end, row) - rows.begin());
    }
    const Panel& panel = panels[panelOf[column - numNarrow]];
    size_t place = (size_t) (row - panel.first);
    if (row >= panel.end) {
        const auto begin = panelRows.begin() + panel.firstRow, end = panelRows.begin() + panel.endRow;
        place = (size_t) (panel.getWidth() + (std::lower_bound(begin, end, row) - begin));
    }
    return (unsigned) (panel.firstValue + (size_t) (column - panel.first) * panel.getHeight() + place);
}

void FactorPattern::findUpdates() {
    for (int column = 0; column < numNarrow; column++)
        for (size_t b = columnStart[column]; b < columnStart[column + 1]; b++)
            for (size_t a = b; a < columnStart[column + 1]; a++)
                updates.push_back(findSlot(rows[a], rows[b]));
}

int FactorPattern::getLargestHeight() const {
    size_t largest = 0;
    for (const Panel& panel : panels)
        largest = std::max(largest, panel.endRow - panel.firstRow);
    return (int) largest;
}
