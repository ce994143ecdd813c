"""From the velocity as the user gives it to the velocity where a scheme needs it: one sparse matrix.

Linear interpolation between centres; the mean of both ends inside a cell. The flow through the side of the
control volume of a face, which covers half of two cells, is the mean of both weighted with their
widths: then constants are kept by a flow without divergence, on stretched grids too.
"""

from functools import reduce

import numpy as np
import scipy.sparse as sp

from sparsedp.conditions import neumann
from sparsedp.operators.stencils import cell_beside, means

__all__ = ["interpolation"]


def interpolation(setting):
    """Setting -> csr_array from the given velocity to the needed one, flat; None where they are the same."""
    grid, on_points = setting.grid, setting.velocity == "cells" and setting.form == "advective"
    if setting.of == "cells" and (on_points or setting.velocity == "faces"):
        return None
    offsets = grid.faces.offsets if setting.velocity == "faces" else [b * grid.cells.size for b in range(grid.dim + 1)]
    components = [None] if setting.of == "cells" else range(grid.dim)
    blocks = []
    for own in components:
        for axis in range(grid.dim):
            lines = [_line(setting, own, axis, along, on_points) for along in range(grid.dim)]
            block = sp.csr_array(reduce(lambda x, y: sp.kron(x, y, "csr"), lines))
            before, after = offsets[axis], offsets[-1] - offsets[axis + 1]
            empty = [sp.csr_array((block.shape[0], n)) for n in (before, after)]
            blocks.append(sp.hstack([empty[0], block, empty[1]], "csr"))
    return sp.csr_array(sp.vstack(blocks, "csr"))


def _line(setting, own, axis, along, on_points):
    """The 1-D matrix along one axis, for velocity component `axis` and field component `own` (None: cells)."""
    grid = setting.grid
    given = grid.node_count(along) if setting.velocity == "faces" and along == axis else grid.shape[along]
    if on_points:
        return means(grid, along, _free(grid, along)).matrix if along == own else sp.eye_array(given)
    if along == own:
        if axis != own:
            return _shared(grid, along)
        return _inside(grid, along, setting.velocity == "faces")
    if along == axis and setting.velocity == "cells":
        return means(grid, along, _free(grid, along)).matrix
    return sp.eye_array(given)


def _free(grid, axis):
    return None if grid.periodic[axis] else (neumann, neumann)


def _shared(grid, axis):
    """Cells -> faces of an axis: the mean weighted with the widths."""
    lower, upper = (cell_beside(grid, axis, side).matrix for side in (False, True))
    h = grid.widths[axis]
    low, high = lower @ h, upper @ h
    total = np.maximum(low + high, np.finfo(float).tiny)
    return sp.diags_array(low / total) @ lower + sp.diags_array(high / total) @ upper


def _inside(grid, axis, from_faces):
    """Faces (or cells) of an axis -> the cell centres, as interfaces between faces, and the walls."""
    n, nodes = grid.shape[axis], grid.node_count(axis)
    cell = np.arange(n)
    if grid.periodic[axis]:  # interface f is cell f - 1
        row, last = (cell + 1) % max(n, 1), n
        ends = []
    else:
        row, last = cell + 1, n + 2
        ends = [(0, 0), (n + 1, nodes - 1 if from_faces else n - 1)]
    if from_faces:
        entries = [(row, cell, 0.5), (row, (cell + 1) % max(nodes, 1), 0.5)]
    else:
        entries = [(row, cell, 1.0)]
    columns = nodes if from_faces else n
    entries += [(np.array([r]), np.array([c]), 1.0) for r, c in ends if columns]
    rows, points, values = (np.concatenate([np.broadcast_to(e[k], e[0].shape) for e in entries]) for k in range(3))
    return sp.csr_array(sp.coo_array((values, (rows, points)), shape=(last if columns else 0, columns)))
