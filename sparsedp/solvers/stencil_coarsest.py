"""The ends of coarsening: axes with one cell, and the dense inverse of the coarsest level."""

from math import prod

import numpy as np
from scipy.sparse.csgraph import connected_components

from sparsedp.kernels.multigrid_pack import inside, padded, repeat

__all__ = ["Natural", "dense_inverse", "merged", "own_steps", "steps"]

ACCURATE, RANK = 1e-3, 1e-14  # residual of an inverse that will do; eigenvalues below, of a diagonal of 1, are 0
FINE_STEPS = {2: [(0, 0, 1), (1, 0, 0)], 3: [(0, 0, 1), (1, 0, 0), (0, 1, 0)]}
ROWS_AHEAD = {2: [(1, 0)], 3: [(0, 1), (1, -1), (1, 0), (1, 1)]}


class Natural:
    """A matrix on a grid in natural order: links to the cells in front, and extras; see `kernels.multigrid_setup`.

    `free` says which cells are part of a singular component; their extras are 0, exactly.
    """

    def __init__(self, shape, periodic, links, extra, free):
        self.shape, self.periodic, self.links, self.extra, self.free = shape, periodic, links, extra, free
        extra[inside(shape)][free] = 0.0


def steps(dim, nine):
    """Directions of the links: (d0, d1, d2), d1 being 0 in 2-D."""
    if not nine:
        return FINE_STEPS[dim]
    return [(0, 0, 1)] + [(d0, d1, d2) for d0, d1 in ROWS_AHEAD[dim] for d2 in (-1, 0, 1)]


def merged(level):
    """Fill the padding; sum up what a periodic axis with one cell repeats, as a cell is not linked to itself."""
    dim, shape = len(level.shape), level.shape
    for array in level.links:
        repeat(array, shape, level.periodic)
    known = own_steps(dim, len(level.links) > dim)
    for axis in range(dim):
        if level.periodic[axis] and shape[axis] == 1:
            periodic = tuple(flag and other != axis for other, flag in enumerate(level.periodic))
            links = _without_axis(axis, level.links, known, shape)
            return merged(Natural(shape, periodic, links, level.extra, level.free))
    return level


def own_steps(dim, nine):
    """The same, with an entry for each axis."""
    return [step if dim == 3 else (step[0], step[2]) for step in steps(dim, nine)]


def _without_axis(axis, links, known, shape):
    """Links with their step along an axis of one cell left out."""
    kept = padded(shape, len(links))
    for step, a in zip(known, links):
        rest = tuple(0 if other == axis else d for other, d in enumerate(step))
        back = tuple(-d for d in rest)
        if rest in known:
            kept[known.index(rest)][inside(shape)] += a[inside(shape)]
        elif back in known:
            source = tuple(slice(1 - d, 1 - d + n) for d, n in zip(rest, shape))
            kept[known.index(back)][inside(shape)] += a[source]
    return kept


def dense_inverse(level, scale):
    """Inverse of the scaled matrix of the coarsest level; null vectors are mapped to 0."""
    matrix, free = _dense(level), level.free.reshape(-1)
    diagonal = matrix.diagonal()
    count, labels = connected_components(matrix != 0, directed=False)
    s = scale[inside(level.shape)].reshape(-1)
    matrix *= s[:, None] * s
    matrix[np.diag_indices_from(matrix)] = 1.0
    nothing = np.zeros_like(matrix)
    for label in np.unique(labels[free]):
        vector = np.where(labels == label, np.sqrt(np.maximum(diagonal, 0.0)), 0.0)
        if np.count_nonzero(vector) > 1 and np.all(free[vector > 0.0]):
            nothing += np.outer(vector, vector) / (vector @ vector)
    return _inverse(matrix + nothing) - nothing


def _inverse(matrix):
    """Inverse of a symmetric matrix; cells whose weights depend on each other give modes of 0, which are left out."""
    try:
        found = np.linalg.inv(matrix)
        if np.max(np.abs(matrix @ found - np.eye(len(matrix))), initial=0.0) < ACCURATE:
            return found
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(matrix)
    kept = np.abs(values) > RANK
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T


def _dense(level):
    """A level as a dense matrix."""
    shape, dim = level.shape, len(level.shape)
    number = np.arange(prod(shape)).reshape(shape)
    index = np.zeros(tuple(n + 3 for n in shape), int)
    index[inside(shape)] = number
    repeat(index, shape, level.periodic)
    matrix = np.diag(level.extra[inside(shape)].reshape(-1))
    for step, links in zip(own_steps(dim, True), level.links):
        a = links[inside(shape)].reshape(-1)
        there = index[tuple(slice(1 + d, 1 + d + n) for d, n in zip(step, shape))]
        i, j, a = number.reshape(-1)[a != 0], there.reshape(-1)[a != 0], a[a != 0]
        for one, two, value in ((i, j, -a), (j, i, -a), (i, i, a), (j, j, a)):
            np.add.at(matrix, (one, two), value)
    return matrix
