"""Geometric hierarchies: linear interpolation between the centres of pairs of cells, axis by axis.

Two neighbours along each axis become one cell of the next grid. P is the Kronecker product of linear
interpolations along the axes, R = P^T, and the next matrix is R A P. P keeps constants, so a null space
of constants goes down all levels.
"""

from functools import reduce

import numpy as np
import scipy.sparse as sp

__all__ = ["geometric_levels"]


def geometric_levels(matrix, grid, levels, coarsest):
    """Matrix on the cells of a grid -> [(A, P, R), ...]; P and R are None on the last level.

    Parameters
    ----------
    matrix : csr_array
    grid : Grid
    levels : int
        Most levels.
    coarsest : int
        Unknowns from which on no next level is made.
    """
    widths: list = list(grid.widths)
    built: list = []
    while len(built) < levels - 1 and matrix.shape[0] > coarsest:
        lines = [_interpolation(h, periodic) for h, periodic in zip(widths, grid.periodic, strict=True)]
        P = sp.csr_array(reduce(lambda a, b: sp.kron(a, b, format="csr"), lines))
        R = sp.csr_array(P.T)
        built.append((matrix, P, R))
        matrix = _short(R @ matrix @ P)
        widths = [np.add.reduceat(h, np.arange(0, h.size, 2)) for h in widths]
    return [*((_short(A), _short(P), _short(R)) for A, P, R in built), (_short(matrix), None, None)]


def _interpolation(widths, periodic):
    """The 1-D matrix: a cell takes from the pair it is in and from the pair next to it, by the distance of centres."""
    n = widths.size
    pairs = (n + 1) // 2
    ends = np.concatenate([[0.0], np.cumsum(widths)])
    fine = 0.5 * (ends[1:] + ends[:-1])
    coarse = 0.5 * (ends[np.minimum(2 * np.arange(pairs) + 2, n)] + ends[2 * np.arange(pairs)])
    cell, own = np.arange(n), np.arange(n) // 2
    other = own + np.where(cell % 2, 1, -1)
    wrapped = other % pairs
    reach = coarse[wrapped] - coarse[own] + ends[-1] * ((other >= pairs).astype(float) - (other < 0))
    inside = (other == wrapped) | (periodic and pairs > 2)
    share = np.where(inside, (fine - coarse[own]) / np.where(inside, reach, 1.0), 0.0)
    share = np.clip(share, 0.0, 1.0)  # a pair of one cell has its own centre
    entries = np.concatenate([1.0 - share, share]), (np.tile(cell, 2), np.concatenate([own, wrapped]))
    line = sp.csr_array(sp.coo_array(entries, shape=(n, pairs)))
    line.eliminate_zeros()
    return line


def _short(matrix):
    """With sorted 32-bit indices, which PyAMG's sweeps ask for."""
    matrix = sp.csr_array(matrix)
    matrix.sort_indices()
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    return matrix
