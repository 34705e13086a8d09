// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_FACTORPATTERN_H_
#define OPENMMVRATTLE_FACTORPATTERN_H_

#include "constraints/EliminationOrder.h"
#include <cstddef>
#include <vector>

namespace OpenMMVRattle {

/**
 * Where the numbers of the factor of a sparse symmetric matrix are kept, and how they are computed: worked out once, and the same
 * for every factorisation. Its memory is in proportion to the entries of the factor.
 *
 * The first columns are eliminated, in this order; what that leaves for the outer rows behind them, a dense matrix, is kept apart.
 * The first columns of all are narrow: each has a list of where the products of its entries go. Those after the first wide one are in
 * panels, neighbouring columns whose entries are stored as one dense block in the same rows.
 */
class FactorPattern {
public:
    /** The columns first, ..., end - 1 as a dense block: their own rows, and rows[firstRow], ..., rows[endRow - 1] below. */
    struct Panel {
        int first, end;
        size_t firstRow, endRow; // of getPanelRows()
        size_t firstValue;       // column by column
        int getWidth() const {
            return end - first;
        }
        int getHeight() const {
            return getWidth() + (int) (endRow - firstRow);
        }
    };
    /** The rows begin, ..., end - 1 below a panel are columns of another, or outer ones. */
    struct Source {
        int panel, begin, end;
    };

    FactorPattern() : numColumns(0), numOuter(0), numNarrow(0), firstOuterValue(0) {
    }
    /**
     * @param columns     the entries of the columns that are eliminated
     * @param numOuter    the number of rows behind them
     */
    explicit FactorPattern(const FactorColumns& columns, int numOuter = 0);

    int getNumColumns() const {
        return numColumns;
    }
    int getNumOuter() const {
        return numOuter;
    }
    int getNumNarrow() const {
        return numNarrow;
    }
    /** The number of values that a factor has. */
    size_t getNumValues() const {
        return firstOuterValue + (size_t) numOuter * numOuter;
    }
    /** Where an entry of the matrix is kept among the values. */
    unsigned findSlot(int row, int column) const;
    /** The entries of a narrow column below the diagonal: getColumnStart(column), ..., getColumnStart(column + 1) - 1. */
    const std::vector<size_t>& getColumnStart() const {
        return columnStart;
    }
    /** Their rows, outer ones last. */
    const std::vector<int>& getRows() const {
        return rows;
    }
    /** The number of outer rows in a narrow column. */
    const std::vector<int>& getNumOuterEntries() const {
        return numOuterEntries;
    }
    /** Where the products of the entries of the narrow columns go, column by column. */
    const std::vector<unsigned>& getUpdates() const {
        return updates;
    }
    /** The values of the diagonal entries. */
    size_t getDiagonal(int column) const {
        return findSlot(column, column);
    }
    const std::vector<Panel>& getPanels() const {
        return panels;
    }
    const std::vector<int>& getPanelRows() const {
        return panelRows;
    }
    /** What is subtracted from a panel; behind the last one, from what the outer rows are left. */
    const std::vector<std::vector<Source>>& getSources() const {
        return sources;
    }
    /** The largest number of entries in the rows of one panel below it. */
    int getLargestHeight() const;
    /** The first value of what is left for the outer rows, column by column. */
    size_t getFirstOuterValue() const {
        return firstOuterValue;
    }

private:
    void findPanels(const FactorColumns& columns);
    void findSources();
    void findUpdates();
    int numColumns, numOuter, numNarrow;
    std::vector<size_t> columnStart;
    std::vector<int> rows, numOuterEntries;
    std::vector<unsigned> updates;
    std::vector<Panel> panels;
    std::vector<int> panelRows, panelOf; // the panel of each wide column
    std::vector<std::vector<Source>> sources;
    size_t firstOuterValue;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_FACTORPATTERN_H_
