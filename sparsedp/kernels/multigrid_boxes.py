"""Compiled Galerkin coarsening of the structured multigrid, a line of boxes at a time, in 2-D and 3-D.

Coarse cells sit on the cells with even indices. Between their corners is a box of 3 x 3 x 3 cells (2-D: 3 x 1 x 3).
The matrix is given by links a >= 0 from a cell to cells in front of it and by `extra`, what remains of its diagonal:
x.A x = sum of a (x_i - x_j)^2 + sum of extra x_i^2. So is the coarse one: a link between cells with weights u and v
on the corners adds -a (u_p - v_p) (u_q - v_q) to the link between the corners p and q, and to the extra of p what
is left of its row: a (u_p - v_p) (sum of u - sum of v).

Arrays are natural and deep, see `multigrid_pack`; `found` holds the weights, an array for each number.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from sparsedp.kernels.multigrid_rows import entry, inner

__all__ = ["Boxes", "boxes", "galerkin", "sides"]


class Boxes(NamedTuple):
    """Tables of the links of a box. All but `corners` in the order in which the kernel takes them.

    Rows of `links`: number of the link, place of its first cell, first and last of its terms; `own`: the same
    for the cells of a box with their extras. A term: corner, and for both cells the number of its weight and the
    shift of its place; if `summed` a last one is for the sums of the weights. `between`: two corners, number
    of the coarse link, place of the first one.
    """

    links: np.ndarray
    own: np.ndarray
    terms: np.ndarray
    between: np.ndarray
    pairs: np.ndarray
    corners: np.ndarray
    summed: bool


def sides(kind):
    """The corners around a cell of a kind, as shifts along the axes."""
    return list(product(*(range(1 + odd) for odd in kind)))


def boxes(axes, fine, coarse, first, one, none, sums=None):
    """Tables for a grid.

    Parameters
    ----------
    axes : three of 0 and 1
        1 where the grid has cells.
    fine, coarse : lists of steps
        Where links lead to.
    first : dict
        Kind of a cell (along which axes its index is odd) -> number of its first weight.
    one, none : int
        Numbers of the weights 1 and 0.
    sums : dict, optional
        Kind of a cell -> number of the sum of its weights. Default: it is added up.
    """
    corners, cells = sides(axes), list(product(*(range(1 + 2 * axis) for axis in axes)))
    first = {(0, 0, 0): one, **first}
    terms: list[tuple[int, ...]] = []

    def add(cell, other):
        nothing, both = (none, 0, 0, 0), [_sources(place, corners, first) for place in (cell, other)]
        terms.extend((p, *both[0].get(p, nothing), *both[1].get(p, nothing)) for p in sorted({*both[0], *both[1]}))
        end = len(terms)
        if sums:
            terms.append((0, *(_sum(cell, sums, one) or nothing), *(_sum(other, sums, one) or nothing)))
        return end

    links = []
    for cell in cells:
        for m, step in enumerate(fine):
            other = tuple(n + d for n, d in zip(cell, step))
            if other in cells and all(max(n, o) < 2 or min(n, o) < 2 for n, o in zip(cell, other)):
                links.append((m, *cell, len(terms), add(cell, other)))
    own = [(0, *cell, len(terms), add(cell, None)) for cell in cells if max(cell) < 2]
    between, pairs = _between(corners, coarse)
    tables = np.array(links), np.array(own), np.array(terms), np.array(between)
    return Boxes(*tables, pairs, np.array(corners), bool(sums))


def _sources(cell, corners, first):
    """Corner -> its weight on a cell of the box: number, shift of its place."""
    if cell is None:
        return {}
    kind, found = tuple(n % 2 for n in cell), {}
    for which, shift in enumerate(sides(kind)):
        corner = tuple(side if odd else n // 2 for odd, side, n in zip(kind, shift, cell))
        found[corners.index(corner)] = (first[kind] + which, *(n // 2 for n in cell))
    return found


def _sum(cell, sums, one):
    return cell and (sums.get(tuple(n % 2 for n in cell), one), *(n // 2 for n in cell))


def _between(corners, steps):
    rows: list[tuple[int, ...]] = []
    pairs = np.zeros((len(corners),) * 2, int)
    for p, one in enumerate(corners):
        for q in range(p + 1, len(corners)):
            pairs[p, q] = len(rows)
            rows.append((p, q, steps.index(tuple(b - a for a, b in zip(one, corners[q]))), *one))
    return rows, pairs


@inner
def _differences(d, total, a, b, deep, found, terms, begin, end, summed):
    """Differences of the weights of two linked cells, corner by corner, for a line of boxes; and of their sums."""
    n = total.size
    total[:] = 0.0
    for t in range(begin, end + 1 if summed else end):
        _, one, u0, u1, u2, two, v0, v1, v2 = terms[t]
        left = found[one, a + u0, deep * (b + u1), 1 + u2 : 1 + u2 + n]
        right = found[two, a + v0, deep * (b + v1), 1 + v2 : 1 + v2 + n]
        out = total if t == end else d[t - begin]
        for c in range(n):
            out[c] = left[c] - right[c]
    if not summed:
        for t in range(end - begin):
            out = d[t]
            for c in range(n):
                total[c] += out[c]


@inner
def _line_of_boxes(k, d, work, a, b, deep, links, found, table, terms, pairs, summed, held):
    """Add the links of a line of boxes: to the links between their corners, and to the extras behind them in k."""
    value, share, total = work
    n, first = total.size, k.shape[0] - pairs.shape[0]
    for m in range(table.shape[0]):
        which, s0, s1, s2, begin, end = table[m]
        line = links[which, 2 * a - 1 + s0, deep * (2 * b - 1 + s1)]
        for c in range(n):
            value[c] = line[1 + s2 + 2 * c]
        _differences(d, total, a, b, deep, found, terms, begin, end, summed)
        for s in range(begin, end):
            p, one, out = terms[s, 0], d[s - begin], k[first + terms[s, 0]]
            for c in range(n):
                share[c] = value[c] * one[c]
                out[c] += share[c] * total[c]
            for t in range(s + 1, s if held else end):
                other, out = d[t - begin], k[pairs[p, terms[t, 0]]]
                for c in range(n):
                    out[c] += share[c] * other[c]


@inner
def _add_line(out, line, sign, shift, periodic):
    """Add a line of boxes to a line of coarse cells, the corner `shift` columns on."""
    n = line.size
    own = out[1 + shift : 1 + shift + n]
    for c in range(n):
        own[c] += sign * line[c]
    if shift and periodic:
        out[1] += sign * line[n - 1]


@entry
def galerkin(links, extra, found, coarse, rest, periodic, deep, table, own, terms, between, pairs, corners, summed):
    """Add up the coarse links and extras (`rest`), line by line. Corners outside are added and ignored."""
    n0, n1, n2 = rest.shape[0] - 3, rest.shape[1] - 3 * deep, rest.shape[2] - 3
    many = corners.shape[0]
    k, d = np.zeros((between.shape[0] + many, n2)), np.zeros((many, n2))
    work = np.zeros(n2), np.zeros(n2), np.zeros(n2)
    for a in range(1, n0 + 1):
        a1 = 1 if periodic[0] and a == n0 else a + 1
        for b in range(1, n1 + 1):
            b1 = 1 if periodic[1] and b == n1 else b + 1
            k[:] = 0.0
            _line_of_boxes(k, d, work, a, b, deep, links, found, table, terms, pairs, summed, False)
            _line_of_boxes(k, d, work, a, b, deep, extra, found, own, terms, pairs, summed, True)
            for m in range(between.shape[0]):
                p, q, which, s0, s1, s2 = between[m]
                _add_line(coarse[which, a1 if s0 else a, deep * (b1 if s1 else b)], k[m], -1.0, s2, periodic[2])
            for p in range(many):
                s0, s1, s2 = corners[p]
                line = k[between.shape[0] + p]
                _add_line(rest[a1 if s0 else a, deep * (b1 if s1 else b)], line, 1.0, s2, periodic[2])
