// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_ELIMINATIONORDER_H_
#define OPENMMVRATTLE_ELIMINATIONORDER_H_

#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * The pattern of the factor L of a sparse symmetric matrix L D L^T: for each column the rows below the diagonal, in increasing
 * order.
 *
 * @param size       the number of rows
 * @param entries    the entries (row, column) of the matrix below the diagonal, row > column
 */
std::vector<std::vector<int>> findFactorPattern(int size, const std::vector<std::pair<int, int>>& entries);

/**
 * Find an order of elimination with little fill, in which steps that do not depend on each other are neighbours.
 *
 * Of the given order and that of approximate minimum degree (Amestoy, Davis and Duff, SIAM J. Matrix Anal. Appl. 17, 1996) the one
 * with less fill is taken, and sorted by the level in its elimination tree; the fill stays the same, and a processor can work on
 * several eliminations of one level at once, on a chain from both ends.
 *
 * @param size       the number of rows
 * @param entries    the entries of the matrix below the diagonal
 * @return for each place in the new order the row that takes it
 */
std::vector<int> findEliminationOrder(int size, const std::vector<std::pair<int, int>>& entries);

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_ELIMINATIONORDER_H_
