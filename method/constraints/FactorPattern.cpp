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

void sortUnique(vector<int>& rows) {
    std::sort(rows.begin(), rows.end());
    rows.erase(std::unique(rows.begin(), rows.end()), rows.end());
}

} // namespace

FactorPattern::FactorPattern(int numColumns, int numOuter, const MatrixEntries& entries) :
        numColumns(numColumns), numOuter(numOuter), firstOuterValue(0) {
    const EliminationTree tree = findEliminationTree(numColumns + numOuter, entries);
    const auto wide = std::find_if(tree.counts.begin(), tree.counts.begin() + numColumns,
                                   [](int count) { return count >= EliminationOrder::WIDE; });
    numNarrow = (int) (wide - tree.counts.begin());
    vector<vector<int>> own(numColumns); // the matrix's entries of each column
    for (const auto& entry : entries)
        own[entry.second].push_back(entry.first);
    findNarrowColumns(tree, own);
    findPanels(tree, own);
    findSources();
    findUpdates();
}

void FactorPattern::findNarrowColumns(const EliminationTree& tree, const vector<vector<int>>& own) {
    vector<vector<int>> children(numNarrow);
    columnStart.assign(1, 0);
    for (int column = 0; column < numNarrow; column++) {
        // What the columns below it in the elimination tree leave, beside the matrix's own entries.
        vector<int> list = own[column];
        for (int child : children[column])
            list.insert(list.end(), rows.begin() + columnStart[child] + 1, rows.begin() + columnStart[child + 1]);
        sortUnique(list);
        rows.insert(rows.end(), list.begin(), list.end());
        columnStart.push_back(rows.size());
        numOuterEntries.push_back((int) (list.end() - std::lower_bound(list.begin(), list.end(), numColumns)));
        const int parent = tree.parent[column];
        if (parent != EliminationTree::NONE && parent < numNarrow)
            children[parent].push_back(column);
    }
}

void FactorPattern::findPanels(const EliminationTree& tree, const vector<vector<int>>& own) {
    size_t numValues = rows.size() + numNarrow;
    panelOf.assign(numColumns - numNarrow, 0);
    vector<vector<int>> narrowChildren(numColumns - numNarrow), panelChildren(numColumns - numNarrow);
    for (int column = 0; column < numNarrow; column++) {
        const int parent = tree.parent[column];
        if (parent >= numNarrow && parent < numColumns)
            narrowChildren[parent - numNarrow].push_back(column);
    }
    for (int first = numNarrow; first < numColumns;) {
        Panel panel = {first, first + 1, panelRows.size(), 0, numValues};
        size_t needed = 1 + (size_t) tree.counts[first];
        while (panel.end < numColumns && tree.parent[panel.end - 1] == panel.end) {
            const size_t width = (size_t) panel.getWidth() + 1, count = (size_t) tree.counts[panel.end];
            const size_t stored = width * (width + 1) / 2 + width * count, used = needed + count + 1;
            if (stored - used > std::max(FEW_ZEROS, (size_t) (MAX_ZEROS * (double) stored)))
                break;
            needed = used;
            panel.end++;
        }
        vector<int> list;
        auto addBelow = [&](auto begin, auto end) {
            list.insert(list.end(), std::lower_bound(begin, end, panel.end), end);
        };
        for (int column = panel.first; column < panel.end; column++) {
            panelOf[column - numNarrow] = (int) panels.size();
            std::copy_if(own[column].begin(), own[column].end(), std::back_inserter(list),
                         [&](int row) { return row >= panel.end; });
            for (int child : narrowChildren[column - numNarrow])
                addBelow(rows.begin() + columnStart[child], rows.begin() + columnStart[child + 1]);
            for (int child : panelChildren[column - numNarrow])
                addBelow(panelRows.begin() + panels[child].firstRow, panelRows.begin() + panels[child].endRow);
        }
        sortUnique(list);
        panelRows.insert(panelRows.end(), list.begin(), list.end());
        panel.endRow = panelRows.size();
        if (!list.empty() && list[0] < numColumns)
            panelChildren[list[0] - numNarrow].push_back((int) panels.size());
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
