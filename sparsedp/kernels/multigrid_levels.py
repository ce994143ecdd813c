"""Tasks on one row of a coarse level of the structured multigrid: 9-point in 2-D, 27-point in 3-D.

The matrix of a level is 1 - c, scaled to a unit diagonal. A vector is an array (rows, 2, width), rows as
in `multigrid`, the middle index being the parity of the column. Of c every cell holds the part to cells
in front of it: `links[0]` along the row, then three for each of the rows in front, `around` of them: to
the column before, the same, the column after.

A colour is a group of rows, 2 * (parity of i) + parity of j, and a parity of the column; cells of one
colour are not linked. The first sweep starts from zero, so it reads earlier colours only, and its
residual later ones. Of the last group (2 in 2-D, 3 in 3-D) the odd columns are relaxed last going down and
first going up: they have no residual, need no correction, and no weights.

Arrays of a level are given as (address, step), see `multigrid_rows`; `like` and `size` are their type.
"""

from sparsedp.kernels.multigrid import NO, coarser, place
from sparsedp.kernels.multigrid_rows import (
    clear,
    copy,
    ends,
    inner,
    merge,
    plus,
    split,
    vectors,
    weigh_onto,
)
from sparsedp.kernels.pointers import get, pointer

__all__ = ["again", "cells", "correct", "order", "relax", "residual", "restrict", "sum_both", "sweep"]


@inner
def cells(field, row, p):
    return field[0] + (2 * row + p) * field[1]


@inner
def _along(out, base, row, p, links, x, n, like, size):
    """out = base + c times the neighbours in the same row."""
    there = cells(x, row, 1 - p)
    before = cells(links, row, 1 - p) + (p - 1) * size
    weigh_onto(like, n, (out, base, before, there + (p - 1) * size, cells(links, row, p), there + p * size), NO)


@inner
def _across(out, i, j, p, links, x, around, grid, like, size, lowest, highest):
    """Add c times the neighbours in the rows around whose group is from `lowest` to `highest`."""
    row, n, plane, west, east = place(i, j, grid), vectors(grid[2]), links[2], (p - 1) * size, p * size
    for d in range(around):
        for sign in (1, -1):
            di, dj = (1, 0) if around == 1 else (0, 1) if d == 0 else (1, d - 2)
            i1, j1 = i + sign * di, j + sign * dj
            there = place(i1, j1, grid)
            if there == 0 or not lowest <= 2 * (i1 & 1) + (j1 & 1) <= highest:
                continue
            same, other = cells(x, there, p), cells(x, there, 1 - p)
            if sign > 0:
                a = cells(links, row, p) + (1 + 3 * d) * plane
                b, c = a + plane, a + 2 * plane
            else:
                b = cells(links, there, p) + (2 + 3 * d) * plane
                a = cells(links, there, 1 - p) + (3 + 3 * d) * plane + west
                c = cells(links, there, 1 - p) + (1 + 3 * d) * plane + east
            weigh_onto(like, n, (out, out, a, other + west, b, same, c, other + east), NO)


@inner
def sweep(i, j, x, b, links, around, grid, like, size):
    row, group = place(i, j, grid), 2 * (i & 1) + (j & 1)
    for p in range(2):
        out = cells(x, row, p)
        if p == 0:
            copy(like, vectors(grid[2]), (out, cells(b, row, p)), NO)
        else:
            _along(out, cells(b, row, p), row, p, links, x, vectors(grid[2]), like, size)
        _across(out, i, j, p, links, x, around, grid, like, size, 0, group - 1)
        ends(out, grid[2], like, grid[1][2])


@inner
def relax(i, j, x, b, links, around, grid, like, size):
    row = place(i, j, grid)
    for p in (1, 0):
        out = cells(x, row, p)
        _along(out, cells(b, row, p), row, p, links, x, vectors(grid[2]), like, size)
        _across(out, i, j, p, links, x, around, grid, like, size, 0, 3)
        ends(out, grid[2], like, grid[1][2])


@inner
def residual(i, j, r, x, links, around, grid, like, size, last):
    """What the sweep from zero left: c times what changed after a colour was relaxed."""
    row, group = place(i, j, grid), 2 * (i & 1) + (j & 1)
    for p in range(2 if group < last else 1):
        out = cells(r, row, p)
        clear(like, vectors(grid[2]), (out,), NO)
        if p == 0:
            _along(out, out, row, p, links, x, vectors(grid[2]), like, size)
        _across(out, i, j, p, links, x, around, grid, like, size, group + 1, 3)
        ends(out, grid[2], like, grid[1][2])


@inner
def restrict(i, j, coarse, r, weights, starts, grid, like, size, last, line):
    """Coarse row (i, j): the residuals of the fine rows around, weighted."""
    n = vectors(grid[2])
    clear(like, 2 * vectors((grid[2] + 1) // 2), (line,), NO)
    for a in range(2 * i - 1, 2 * i + 2):
        for b in range(2 * j - 1, 2 * j + 2):
            row, group = place(a, b, grid), 2 * (a & 1) + (b & 1)
            if row == 0:
                continue
            number = (i - a // 2) * (1 + (b & 1)) + j - b // 2
            step = weights[1]
            weight = weights[0] + (get(pointer(starts, 0), row) + number * (3 if group < last else 1)) * step
            weigh_onto(like, n, (line, line, weight, cells(r, row, 0)), NO)
            if group < last:
                odd, second = cells(r, row, 1), weight + 2 * step
                weigh_onto(like, n, (line, line, weight + step, odd, second - size, odd - size), NO)
    out = place(i, j, coarser(grid))
    split(like, vectors((grid[2] + 1) // 2), (cells(coarse, out, 0), cells(coarse, out, 1), line), NO)


@inner
def correct(i, j, x, coarse, weights, starts, grid, like, size, last):
    """Add the interpolated coarse correction."""
    row, group, n, step = place(i, j, grid), 2 * (i & 1) + (j & 1), vectors(grid[2]), weights[1]
    even, odd = cells(x, row, 0), cells(x, row, 1)
    weight = weights[0] + get(pointer(starts, 0), row) * step
    for a in range(1 + (i & 1)):
        for b in range(1 + (j & 1)):
            u = coarse[0] + place(i // 2 + a, j // 2 + b, coarser(grid)) * coarse[1]
            weigh_onto(like, n, (even, even, weight, u), NO)
            if group < last:
                weigh_onto(like, n, (odd, odd, weight + step, u, weight + 2 * step, u + size), NO)
            weight += (3 if group < last else 1) * step
    ends(even, grid[2], like, grid[1][2])
    ends(odd, grid[2], like, grid[1][2])


@inner
def order(i, j, x, own, grid, like):
    """Row (i, j) in natural order."""
    row = place(i, j, grid)
    line = own[0] + row * own[1]
    merge(like, vectors(grid[2]), (line, cells(x, row, 0), cells(x, row, 1)), NO)
    ends(line, grid[0][2], like, grid[1][2])


@inner
def again(i, j, x, b, kept, links, around, grid, like, size):
    """Keep x, and make b its residual, for a second cycle."""
    row, n = place(i, j, grid), vectors(grid[2])
    for p in range(2):
        out, own = cells(b, row, p), cells(x, row, p)
        copy(like, n, (cells(kept, row, p), own), NO)
        plus(like, n, (out, out, own), (-1.0,))
        _along(out, out, row, p, links, x, n, like, size)
        _across(out, i, j, p, links, x, around, grid, like, size, 0, 3)


@inner
def sum_both(i, j, x, kept, own, grid, like):
    """x of both cycles, in natural order."""
    row = place(i, j, grid)
    for p in range(2):
        out = cells(x, row, p)
        plus(like, vectors(grid[2]), (out, out, cells(kept, row, p)), (1.0,))
    order(i, j, x, own, grid, like)
