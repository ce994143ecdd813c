"""From an operator to its stencil: read off factors, products with faces between, or entries; then checked."""

import numpy as np

from sparsedp.solvers import facts
from sparsedp.solvers.multigrid.lines import of_lines, read_lines
from sparsedp.solvers.multigrid.stencil import Stencil, Unfit, cleaned
from sparsedp.structure.base import Scaled
from sparsedp.structure.explicit import Matrix
from sparsedp.structure.kronecker import Kronecker
from sparsedp.structure.lazy import Chain, Diagonal, Sum

__all__ = ["stencil_of"]

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

    Notes
    -----
    Known are sums of multiples of: D diag(...) G with any D, G between cells and faces that reach over one
    face; Kronecker sums of three-point factors; diagonals; matrices. Where coefficients of faces are known the
    stencil is written down from them; else the result is compared with the operator on a random field.
    """
    if system.grid is None:
        raise Unfit("it does not act on the cells of a grid")
    if system.grid.dim == 1:
        raise Unfit("the grid is 1-D")
    if system.faces is not None:
        return system.faces.stencil()
    stencil = _read(system.op.structure, system.grid, system.grid.volumes).checked()
    _compare(stencil, system)
    return stencil


def _compare(stencil, system):
    x = np.random.default_rng(0).uniform(0.5, 1.5, stencil.grid.shape)
    active = np.ones(stencil.grid.shape, bool) if system.active is None else system.active.reshape(x.shape)
    x = np.where(active, x, 0.0)
    volumes = stencil.grid.volumes
    wanted = volumes * system.product(x.reshape(-1)).reshape(x.shape)
    size = 1.5 * volumes * system.sums[False].reshape(x.shape)
    if np.any(np.abs(stencil.apply(x) / stencil.scale - wanted)[active] > AGREES * size[active]):
        raise Unfit("it is not a symmetric 5- or 7-point stencil")


# ------------------------------------------------------------ structures


def _read(structure, grid, volumes):
    """The stencil of volumes times a structure, of any sign."""
    if isinstance(structure, Scaled):
        return _scaled(_read(structure.inner, grid, volumes), structure.factor)
    if isinstance(structure, Sum):
        return _added([_read(member, grid, volumes) for member in structure.members], grid)
    if isinstance(structure, Diagonal):
        return Stencil(grid, _no_links(grid), structure.values.reshape(grid.shape) * volumes)
    if facts.is_sum_of_factors(structure):
        return _of_factors(structure, grid)
    if isinstance(structure, Chain) and structure.members[0].shape == (grid.cells.size, grid.faces.size):
        return _through_faces(structure.members, grid, volumes)
    if hasattr(structure, "assembly"):  # shift - D diag(k) G
        D, G = structure.assembly.D.structure, structure.assembly.G.structure
        if structure.transposed:
            D, G = G.transpose(), D.transpose()
        product = _through_faces((D, Diagonal(-structure.k), G), grid, volumes)
        return product._replace(extra=product.extra + structure.shift * volumes)
    if isinstance(structure, Kronecker) or not structure.has_entries:
        raise Unfit("it is not made of differences over single faces")
    return _of_entries(structure.explicit() if not isinstance(structure, Matrix) else structure.matrix, grid, volumes)


def _no_links(grid):
    return tuple(np.zeros(grid.face_shape(axis)) for axis in range(grid.dim))


def _scaled(stencil, factor):
    return stencil._replace(links=tuple(factor * c for c in stencil.links), extra=factor * stencil.extra)


def _added(stencils, grid):
    links = tuple(sum(parts) for parts in zip(*(stencil.links for stencil in stencils)))
    return Stencil(grid, links, sum(stencil.extra for stencil in stencils))


def _of_factors(structure, grid):
    """Kronecker sum: link h_i lower_i between the cells i - 1 and i of an axis, times the widths of the others."""
    links, extra = list(_no_links(grid)), np.zeros(grid.shape)
    for term in structure.blocks.get((0, 0), ()):
        if not term.axes:
            extra += term.scale * grid.volumes
        for axis in term.axes:
            bands = term.factors[axis].scaled(term.scale).tridiagonal
            if bands is None:
                raise Unfit("a row reaches beyond the neighbours")
            h, line = grid.widths[axis], [1] * grid.dim
            line[axis] = -1
            area = np.expand_dims(np.take(grid.volumes, 0, axis) / h[0], axis) if h.size else 0.0
            lower, centre, upper = h * bands.lower, h * bands.centre, h * bands.upper
            if h.size <= 2:  # both neighbours are one cell
                lower, upper = (lower + upper) * (np.arange(h.size) > 0), 0.0 * upper
            total = np.abs(lower) + np.abs(centre) + np.abs(h * bands.upper)
            rest = cleaned(centre + h * (bands.lower + bands.upper), total)
            c = -lower if grid.periodic[axis] else np.append(-lower, 0.0)
            links[axis] = links[axis] + c.reshape(line) * area
            extra += rest.reshape(line) * area
    return Stencil(grid, tuple(links), extra)


# ------------------------------------------------------------ products with faces between


def _through_faces(members, grid, volumes):
    """V L ... R with R from cells to faces and L back."""
    found = read_lines(members[0], members[1:-1], members[-1], grid)
    if found is not None:
        lines, k = found
        return of_lines(lines, k, grid)
    return _probed(members[0], members[1] if len(members) == 2 else Chain(members[1:]), grid, volumes)


def _probed(left, right, grid, volumes):
    """V L R: both are probed with the colours of the cells."""
    colours, count = _colours(grid)
    masks = [(colours == colour).astype(float) for colour in range(count)]
    turned = left.transpose()
    slopes = [grid.split(right.product(mask.reshape(-1))) for mask in masks]
    areas = [grid.split(turned.product((mask * volumes).reshape(-1))) for mask in masks]
    links, extra = [], np.zeros(grid.shape)
    for axis in range(grid.dim):
        below, above = _beside(colours, grid, axis)
        g_below, g_above = (_chosen([part[axis] for part in slopes], side) for side in (below, above))
        d_below, d_above = (_chosen([part[axis] for part in areas], side) for side in (below, above))
        own_below, own_above = d_below * g_below, d_above * g_above
        linked = (g_below != 0) & (g_above != 0)
        c = np.where(linked, -0.5 * (d_below * g_above + d_above * g_below), 0.0)
        links.append(c)
        size = np.abs(c)
        _deposit(extra, cleaned(own_below - c, size), cleaned(own_above - c, size), grid, axis)
    return Stencil(grid, tuple(links), extra)


def _colours(grid):
    """A colour for each cell so that cells on two sides of a face differ, and the number of colours."""
    odd = [flag and n % 2 == 1 and n > 1 for n, flag in zip(grid.shape, grid.periodic)]
    total = np.zeros(grid.shape, int)
    for axis, n in enumerate(grid.shape):
        line = np.arange(n) % 2
        if odd[axis]:
            line[-1] = 2
        total += line.reshape([-1 if a == axis else 1 for a in range(grid.dim)])
    count = 3 if any(odd) else 2
    return total % count, count


def _beside(colours, grid, axis):
    """Colour of the cell below and above each face of an axis; -1 beyond a wall."""
    lines = np.moveaxis(colours, axis, 0)
    if grid.periodic[axis]:
        both = np.roll(lines, 1, 0), lines
    else:
        wall = np.full_like(lines[:1], -1)
        both = np.concatenate([wall, lines]), np.concatenate([lines, wall])
    return tuple(np.moveaxis(side, 0, axis) for side in both)


def _chosen(parts, colour):
    """From each face the value of the probe with the given colour; 0 beyond a wall."""
    found = np.zeros(colour.shape)
    for number, part in enumerate(parts):
        np.copyto(found, part, where=colour == number)
    return found


def _deposit(extra, below, above, grid, axis):
    """Add values of faces to the cells below and above them."""
    cells, below, above = (np.moveaxis(array, axis, 0) for array in (extra, below, above))
    n = cells.shape[0]
    if grid.periodic[axis]:
        cells += above
        cells += np.roll(below, -1, 0)
    else:
        cells += above[:n]
        cells += below[1:]


# ------------------------------------------------------------ entries


def _of_entries(matrix, grid, volumes):
    """A matrix: every entry off the diagonal belongs to a face. Entries behind are left to the comparison."""
    links, stride, known = [], grid.cells.size, {0}
    for axis, n in enumerate(grid.shape):
        stride //= n
        faces = np.zeros((grid.node_count(axis), *np.delete(grid.shape, axis)))
        if n > 1:
            ahead = _diagonal(matrix, stride, grid, axis)
            faces[1:n] = ahead[: n - 1]
            known |= {stride, -stride}
        if grid.periodic[axis] and n > 2:
            faces[0] = _diagonal(matrix, -(n - 1) * stride, grid, axis)[n - 1]
            known |= {(n - 1) * stride, -(n - 1) * stride}
        volume = np.moveaxis(volumes, axis, 0)
        faces[1:n] *= volume[: n - 1]
        faces[0] *= volume[n - 1]
        links.append(np.moveaxis(faces, 0, axis))
    if np.count_nonzero(matrix.data) != sum(np.count_nonzero(matrix.diagonal(k)) for k in known):
        raise Unfit("a row reaches beyond the neighbours")
    ones = np.ones(matrix.shape[0])
    sums, total = (volumes * (m @ ones).reshape(grid.shape) for m in (matrix, abs(matrix)))
    return Stencil(grid, tuple(links), cleaned(sums, total))


def _diagonal(matrix, k, grid, axis):
    """Minus the entries (i, i + k) at the cells i, as a field with one axis first."""
    field, values = np.zeros(grid.cells.size), matrix.diagonal(k)
    first = max(-k, 0)
    field[first : first + values.size] = -values
    return np.moveaxis(field.reshape(grid.shape), axis, 0)
