"""From an operator to its stencil: written down from the coefficients of faces, or found by its action; then checked.

A cell and its neighbours have different colours. So the action on the cells of one colour shows, in every cell, the
entry of one neighbour: as many products as there are colours show all of them, whatever the operator is made of.
"""

import numpy as np

from sparsedp.solvers.multigrid.stencil import Stencil, Unfit, cleaned
from sparsedp.structure.explicit import Matrix

__all__ = ["numbered", "stencil_of"]

AGREES = 1e-12  # relative difference to the operator on a random field that is taken for rounding


def stencil_of(system):
    """System -> Stencil.

    Parameters
    ----------
    system : System

    Returns
    -------
    Stencil

    Raises
    ------
    Unfit
        With the reason in words.
    """
    grid, structure = system.grid, system.op.structure
    if grid is None:
        raise Unfit("it does not act on the cells of a grid")
    if grid.dim == 1:
        raise Unfit("the grid is 1-D")
    if system.faces is not None:
        return system.faces.stencil()
    if not structure.has_entries:
        raise Unfit("it is not made of differences over single faces")
    if isinstance(structure, Matrix) and _reaches_far(structure.matrix, grid):
        raise Unfit("a row reaches beyond the neighbours")
    found = _probed(system, grid)
    stencil = found.checked()
    _compare(stencil, system)
    return stencil


def _compare(stencil, system):
    """Refuse a stencil that does another thing than the operator on a random field."""
    x = np.random.default_rng(0).uniform(0.5, 1.5, stencil.grid.shape)
    active = np.ones(stencil.grid.shape, bool) if system.active is None else system.active.reshape(x.shape)
    x = np.where(active, x, 0.0)
    volumes = stencil.grid.volumes
    wanted = volumes * system.product(x.reshape(-1)).reshape(x.shape)
    size = 1.5 * volumes * system.sums[False].reshape(x.shape)
    if np.any(np.abs(stencil.apply(x) / stencil.scale - wanted)[active] > AGREES * size[active]):
        raise Unfit("it is not a symmetric 5- or 7-point stencil")


def _reaches_far(matrix, grid):
    """Whether a matrix links cells that are no neighbours."""
    entries = matrix.tocoo()
    used = entries.data != 0
    there, here = (np.unravel_index(index[used], grid.shape) for index in (entries.col, entries.row))
    steps = 0
    for one, two, n, flag in zip(there, here, grid.shape, grid.periodic):
        step = np.abs(one - two)
        steps = steps + (np.minimum(step, n - step) if flag else step)
    return np.any(steps > 1)


def _probed(system, grid):
    """The stencil of volumes times the operator, of any sign."""
    colours, count = _colours(grid)
    volumes = grid.volumes

    def image(field):
        return volumes * system.product(field.reshape(-1)).reshape(grid.shape)

    images = np.stack([image((colours == colour).astype(float)) for colour in range(count)])
    links = []
    for axis, n in enumerate(grid.shape):
        c = np.zeros(grid.face_shape(axis))
        lines, shades, faces = (
            np.moveaxis(array, at, 0) for array, at in ((images, axis + 1), (colours, axis), (c, axis))
        )
        pairs = [(slice(0, n - 1), slice(1, n), slice(1, n))]  # cells below and above, faces
        pairs += [(slice(n - 1, n), slice(0, 1), slice(0, 1))] if grid.periodic[axis] and n > 2 else []
        for below, above, between in pairs:
            entries = [
                np.take_along_axis(lines[here], shades[there][:, None], 1)[:, 0]
                for here, there in ((below, above), (above, below))
            ]
            faces[between] = -0.5 * (entries[0] + entries[1])
        links.append(c)
    total = volumes * system.sums[False].reshape(grid.shape)
    return Stencil(grid, tuple(links), cleaned(image(np.ones(grid.shape)), total))


def _colours(grid):
    """A colour for each cell so that a cell and its neighbours all differ, and the number of colours."""
    many = 2 * grid.dim + 1
    if all(n % many == 0 for n, flag in zip(grid.shape, grid.periodic) if flag):
        places = np.indices(grid.shape, sparse=True)
        return sum((axis + 1) * place for axis, place in enumerate(places)) % many, many
    total, count = np.zeros(grid.shape, int), 1
    for axis, (n, flag) in enumerate(zip(grid.shape, grid.periodic)):
        line = numbered(n, flag)
        total += count * line.reshape([-1 if a == axis else 1 for a in range(grid.dim)])
        count *= int(line.max(initial=0)) + 1
    return total, count


def numbered(n, periodic):
    """Numbers for the cells of an axis so that any three in a row differ, around the end of a periodic one too."""
    if not periodic or n % 3 == 0:
        return np.arange(n) % 3
    fours = 4 * (n % 3)
    if fours > n:
        return np.arange(n)
    return np.concatenate([np.arange(fours) % 4, np.arange(n - fours) % 3])
