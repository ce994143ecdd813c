"""A guess at the pattern of a matrix on a grid: what a few cells touch, moved over the whole grid.

A guess takes as many products as cells are tried, whatever the size of the grid. It is a guess: the caller checks it.
"""

from itertools import product as combinations

import numpy as np

from sparsedp.solvers.sparsity import pattern_of

__all__ = ["translated_pattern"]

SHORT = 8  # an axis that is not longer counts kinds of values, u and v of a reaction, and no places
SMALLEST = 256  # unknowns below which a guess saves nothing
WIDEST = 64  # cells touched by one; more is no stencil


def translated_pattern(products, shape):
    """Products with one matrix at several points, on fields of a shape -> csr_array of ones, or None.

    Parameters
    ----------
    products : list of callables
        ``product(v) -> A v``, flat.
    shape : tuple of int
        Of the fields on both sides.

    Returns
    -------
    csr_array or None
        None when the fields are small, or a cell touches too many.
    """
    places = [axis for axis, n in enumerate(shape) if n > SHORT]
    kinds = [axis for axis, n in enumerate(shape) if n <= SHORT]
    lengths, counts = [shape[axis] for axis in places], [shape[axis] for axis in kinds]
    if not places or not products or np.prod(shape) < SMALLEST or np.prod(counts) > SHORT:
        return None
    index = np.arange(np.prod(shape)).reshape(shape).transpose(kinds + places).reshape(-1, *lengths)
    rng = np.random.default_rng(0)
    touched = [_touched(products, index, kind, rng) for kind in range(len(index))]
    if any(found is None for found in touched):
        return None
    wraps = np.any([around for _, around in touched], axis=0)
    columns, rows = zip(
        *(_moved(index, kind, move, wraps) for kind, (moves, _) in enumerate(touched) for move in moves)
    )
    return pattern_of(np.concatenate(rows), np.concatenate(columns), (index.size, index.size))


def _touched(products, index, kind, rng):
    """What three cells of a kind touch: {(kind, steps along the places)}, and along which axes one went round."""
    lengths, moves, around = np.array(index.shape[1:]), set(), np.zeros(index.ndim - 1, dtype=bool)
    where = np.empty((index.size, index.ndim), dtype=int)
    where[index.reshape(-1)] = np.stack(np.unravel_index(np.arange(index.size), index.shape), axis=1)
    for product, cell in combinations(products, (0 * lengths, lengths // 2, lengths - 1)):
        v = np.zeros(index.size)
        v[index[(kind, *cell)]] = rng.uniform(0.5, 1.5) * rng.choice((-1.0, 1.0))
        hit = where[np.flatnonzero(product(v))]
        if len(hit) > WIDEST:
            return None
        steps = (hit[:, 1:] - cell + lengths // 2) % lengths - lengths // 2  # the short way
        around |= np.any(steps != hit[:, 1:] - cell, axis=0)
        moves |= set(map(tuple, np.column_stack([hit[:, :1], steps]).tolist()))
    return sorted(moves), around


def _moved(index, kind, move, wraps):
    """Columns and rows of one step from every cell; steps over an edge count where the field goes round."""
    other, *steps = move
    rows = np.roll(index[other], [-step for step in steps], tuple(range(len(steps))))
    inside = np.ones(rows.shape, dtype=bool)
    for axis, (step, round_) in enumerate(zip(steps, wraps)):
        to = np.arange(rows.shape[axis]) + step
        fits = round_ | ((to >= 0) & (to < rows.shape[axis]))
        inside &= fits.reshape([-1 if a == axis else 1 for a in range(rows.ndim)])
    return index[kind][inside], rows[inside]
