"""Compiled passes between fields of the user and the red cells of the structured multigrid (see `multigrid`).

The matrix S of the user's cells becomes 1 - c by S -> diag(scale) S diag(scale), scale being one over the
root of its diagonal (0 where there is no unknown), a natural array (see `multigrid_pack`) whose cell
(0, 0, 0) is at (1, 1). `widths` are three arrays whose outer product multiplies a field: the cell
volumes, or ones. The grid may have cells that the field has not: `found` gives, for axis 0 and 1, the index
in the field (-1: none), for axis 2 runs of columns: first in the field, first in the grid, how many. `line`
is scratch for one line in natural order.
"""

from sparsedp.kernels.multigrid import NO, black_slab, place, red_row, slot
from sparsedp.kernels.multigrid_rows import PAD, advance, combine, ends, inner, merge, rows, split, vectors

__all__ = ["finish", "load"]


@inner
def _lead(scale):
    """Index of cell 0 along axis 1: there is padding in 3-D only."""
    return 1 if scale.shape[1] > 1 else 0


@inner
def _scaled(out, a, b, c, factor):
    for k in range(out.size):
        out[k] = a[k] * b[k] * c[k] * factor


@inner
def _colours(even, odd, b, i, j, scale, widths, found, grid, line):
    """The cells of line (i, j) of a field, scaled, by the parity of their column."""
    i1, j1, runs = found[0][i], found[1][j], found[2]
    factor = widths[0][i] * widths[1][j]
    line[:] = 0.0
    for m in range(runs.shape[0] if i1 >= 0 and j1 >= 0 else 0):
        at, first, n = runs[m]
        size = scale[i + 1, j + _lead(scale), 1 + first : 1 + first + n]
        _scaled(line[PAD + first : PAD + first + n], b[i1, j1, at : at + n], size, widths[2][first : first + n], factor)
    split(1.0, vectors(grid[2]), (even, odd, rows(line)[0]), NO)


@inner
def _natural(out, i, j, scale, other, found, line):
    """The reverse: a scaled line to a field."""
    i1, j1, runs = found[0][i], found[1][j], found[2]
    factor = other[0][i] * other[1][j]
    for m in range(runs.shape[0] if i1 >= 0 and j1 >= 0 else 0):
        at, first, n = runs[m]
        size = scale[i + 1, j + _lead(scale), 1 + first : 1 + first + n]
        _scaled(
            out[i1, j1, at : at + n], line[PAD + first : PAD + first + n], size, other[2][first : first + n], factor
        )


@inner
def load(share, links, r, b, scale, widths, found, grid, ring, line):
    """Field b -> r = red + c black, of b scaled."""
    red, black, n = rows(ring[0]), rows(ring[1]), vectors(grid[2])
    for i in range(share[0] - 1, share[1] + 1):
        for j in range(grid[0][1]):
            row, one, two = place(i, j, grid), slot(red, i, j, grid), slot(black, i, j, grid)
            if row > 0:
                even, odd = (two, one) if (i + j) & 1 else (one, two)
                _colours(even, odd, b, (row - 1) // grid[0][1], j, scale, widths, found, grid, line)
                ends(two, grid[2], 1.0, grid[1][2])
            else:
                combine(1.0, n, (two, two, two), (-1.0,))
        for j in range(grid[0][1] if i > share[0] else 0):
            out = r[0] + (1 + (i - 1) * grid[0][1] + j) * r[1]
            red_row(out, links, black, i - 1, j, grid, 1.0, 8)
            combine(1.0, n, (out, out, slot(red, i - 1, j, grid)), (1.0,))


@inner
def finish(share, links, x, steps, p, old, like, b, out, scale, widths, other, found, grid, ring, line):
    """Field out: x + steps[0] p + steps[1] old on the red cells, the black ones from their own equations, unscaled."""
    red, black, n = rows(ring[0]), rows(ring[1]), vectors(grid[2])
    for i in range(share[0] - 1, share[1] + 1):
        for j in range(grid[0][1]):
            row, at = place(i, j, grid), slot(red, i, j, grid)
            advance(like, n, (at, x[0] + row * x[1], p[0] + row * p[1], old[0] + row * old[1]), steps)
            ends(at, grid[2], 1.0, grid[1][2])
        if i <= share[0]:
            continue
        black_slab(i - 1, links, red, black, grid, 1.0, 8)
        for j in range(grid[0][1]):
            one, two = slot(black, i, j, grid), slot(black, i + 1, j, grid)
            _colours(one, two, b, i - 1, j, scale, widths, found, grid, line)
            at, own = slot(red, i - 1, j, grid), slot(black, i - 1, j, grid)
            colour = (i - 1 + j) & 1
            combine(1.0, n, (own, own, one if colour else two), (1.0,))
            merge(1.0, n, (rows(line)[0], own if colour else at, at if colour else own), NO)
            _natural(out, i - 1, j, scale, other, found, line)
