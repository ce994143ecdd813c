"""Small linear systems whose entries are arrays, traced or not: one system for each entry of the arrays."""

from __future__ import annotations

from functools import reduce

__all__ = ["solve_definite"]


def solve_definite(matrix: list[list], right: list) -> list:
    """Return the solution of symmetric positive definite systems with arrays as entries, by an LDL^T factorization.

    Parameters
    ----------
    matrix : list of lists
        The lower triangle.
    right : list

    Returns
    -------
    list
        The solution, one array for each unknown.
    """
    size = len(right)
    lower: list[list] = []
    pivots: list = []
    x: list = []
    for i in range(size):
        row: list = []
        for j in range(i):
            products = [row[p] * lower[j][p] * pivots[p] for p in range(j)]
            row.append(reduce(lambda value, term: value - term, products, matrix[i][j]) / pivots[j])
        pivots.append(reduce(lambda value, p: value - row[p] ** 2 * pivots[p], range(i), matrix[i][i]))
        x.append(reduce(lambda value, p: value - row[p] * x[p], range(i), right[i]))
        lower.append(row)
    for i in reversed(range(size)):
        x[i] = reduce(lambda value, p: value - lower[p][i] * x[p], range(i + 1, size), x[i] / pivots[i])
    return x
