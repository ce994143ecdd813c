"""What a stencil tells about its matrix: the connected components, and which of them are singular."""

import numpy as np
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sparsedp.solvers.nullspace import NullSpace, assembled

__all__ = ["components_of_stencil", "null_space_of_stencil"]


def components_of_stencil(stencil, active):
    """(labels, count) of the connected components of the active cells; labels None: one, everywhere.

    Parameters
    ----------
    stencil : Stencil
    active : bool array, shape (cells,), or None
    """
    inner, grid = stencil.inner, stencil.grid
    if active is None and all(np.all(c > 0) for c in inner) and grid.cells.size:
        return None, 1
    cells = np.ones(grid.shape, bool) if active is None else active.reshape(grid.shape)
    pairs = [_sides(cells, grid, axis) for axis in range(grid.dim)]
    if all(np.array_equal(c > 0, one & two) for c, (one, two) in zip(inner, pairs)):
        labels, count = label(cells)
        edges = _around(labels, stencil)
    else:
        labels, count = np.arange(1, cells.size + 1).reshape(grid.shape) * cells, cells.size
        edges = _linked(labels, stencil)
    if edges[0].size or count == cells.size:
        labels, count = _merged(labels, edges, count, cells)
    labels = labels.reshape(-1) - 1
    return (None, 1) if count == 1 and active is None else (labels, count)


def _sides(values, grid, axis):
    """Values of the cells below and above each face, walls left out."""
    lines = np.moveaxis(values, axis, 0)
    below, above = (np.roll(lines, 1, 0), lines) if grid.periodic[axis] else (lines[:-1], lines[1:])
    return np.moveaxis(below, 0, axis), np.moveaxis(above, 0, axis)


def _around(labels, stencil):
    """Pairs of labels that are linked across a periodic side."""
    pairs = []
    for axis, c in enumerate(stencil.links):
        if stencil.grid.periodic[axis]:
            lines = np.moveaxis(labels, axis, 0)
            linked = np.moveaxis(c, axis, 0)[0] > 0
            pairs.append((lines[-1][linked], lines[0][linked]))
    return _joined(pairs)


def _linked(labels, stencil):
    """Pairs of labels on the two sides of each face with a link."""
    pairs = []
    for axis, c in enumerate(stencil.inner):
        below, above = _sides(labels, stencil.grid, axis)
        pairs.append((below[c > 0], above[c > 0]))
    return _joined(pairs)


def _joined(pairs):
    return tuple(np.concatenate(side) if pairs else np.zeros(0, int) for side in (list(zip(*pairs)) or [(), ()]))


def _merged(labels, edges, count, cells):
    """Labels from 1 on, those of linked ones made equal; 0 on what is not active."""
    one, two = (side - 1 for side in edges)
    graph = coo_array((np.ones(one.size), (one, two)), shape=(count, count))
    _, number = connected_components(graph, directed=False)
    found = np.where(cells, number[np.maximum(labels, 1) - 1], -1)
    used, place = np.unique(found[cells], return_inverse=True)
    out = np.zeros(labels.shape, int)
    out[cells] = place + 1
    return out, used.size


def null_space_of_stencil(stencil, labels, count, active):
    """NullSpace: ones on the right and volumes on the left, on each component that nothing holds.

    Labels are those of `components_of_stencil`.
    """
    size, volumes = stencil.grid.cells.size, stencil.grid.volumes.reshape(-1)
    held = stencil.extra.reshape(-1) > 0
    if size and labels is None and held.any():
        return NullSpace(None, np.zeros(size), np.zeros(size), 0)
    if labels is None:
        singular = np.array([size > 0])
        chosen = np.full(size, singular[0])
    else:
        labels = labels if active is None else np.where(active, labels, count)
        singular = np.bincount(labels, held, count + 1)[:count] == 0
        chosen = np.append(singular, False)[labels]
    left = volumes if np.any(volumes != volumes[:1]) else np.ones(size)
    return assembled(labels, np.where(chosen, 1.0, 0.0), np.where(chosen, left, 0.0), singular)
