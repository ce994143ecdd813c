"""Compiled set-up of the structured multigrid in 3-D: black-box interpolation and Galerkin coarsening.

As `multigrid_setup`, with 13 links from a cell to the cells in front of it: `STEPS`, the first three of
which the finest level has as `FINE_STEPS`. A coarse cell sits on each cell with even indices; between eight
of them is a box of 3 x 3 x 3 cells. Weights of all cells but the coarse ones are in one array, kind by kind:
the kind says along which axes the index is odd.

Source: J. E. Dendy, Two multigrid methods for three-dimensional problems with discontinuous and anisotropic
coefficients, SIAM J. Sci. Stat. Comput. 8 (1987) 673-685.
"""

from itertools import product

import numpy as np

from sparsedp.kernels.multigrid import inner
from sparsedp.kernels.multigrid_pack import inside, padded, repeat
from sparsedp.kernels.multigrid_setup import WEAK

__all__ = ["FINE_STEPS", "STEPS", "galerkin", "scales", "weights"]

FINE_STEPS = [(0, 0, 1), (1, 0, 0), (0, 1, 0)]
STEPS = [(0, 0, 1)] + [(d0, d1, d2) for d0, d1 in ((0, 1), (1, -1), (1, 0), (1, 1)) for d2 in (-1, 0, 1)]
KINDS = sorted(product((0, 1), repeat=3), key=sum)[1:]
FIRST: dict[tuple[int, ...], int] = dict(zip(KINDS, np.cumsum([0, *(2 ** sum(kind) for kind in KINDS)]).tolist()))
CORNERS: list[tuple[int, ...]] = list(product((0, 1), repeat=3))
LOCAL = list(product((0, 1, 2), repeat=3))


def _sides(kind):
    """The corners around a cell of a kind, as shifts along the axes."""
    return list(product(*(range(1 + odd) for odd in kind)))


def _offsets(steps):
    """Rows: shift to a neighbour, number of the link, 1 if the link is the neighbour's."""
    forward = [(*step, m, 0) for m, step in enumerate(steps)]
    return np.array(forward + [(-d0, -d1, -d2, m, 1) for d0, d1, d2, m, _ in forward])


def _box_weights():
    """Rows: cell of the box, corner, number of the weight, shift of its place."""
    rows = []
    for number, cell in enumerate(LOCAL):
        kind = tuple(n % 2 for n in cell)
        for which, sides in enumerate(_sides(kind) if any(kind) else []):
            corner = tuple(side if odd else n // 2 for odd, side, n in zip(kind, sides, cell))
            rows.append((number, CORNERS.index(corner), FIRST[kind] + which, *(n // 2 for n in cell)))
    return np.array(rows)


def _box_links(steps):
    """Rows: two linked cells of the box, number of the link, place of the first cell. Each link is in one box."""
    rows = []
    for number, cell in enumerate(LOCAL):
        for m, step in enumerate(steps):
            other = tuple(n + d for n, d in zip(cell, step))
            if other in LOCAL and all(max(n, o) < 2 or min(n, o) < 2 for n, o in zip(cell, other)):
                rows.append((number, LOCAL.index(other), m, *cell))
    return np.array(rows)


def _corner_links():
    """Rows: two corners, number of the coarse link between them, place of the first one."""
    pairs = [(p, q) for p in range(8) for q in range(p + 1, 8)]
    steps = [tuple(b - a for a, b in zip(CORNERS[p], CORNERS[q])) for p, q in pairs]
    return np.array(
        [(p, q, STEPS.index((step[0], step[1], step[2])), *CORNERS[p]) for (p, q), step in zip(pairs, steps)]
    )


OFFSETS = {False: _offsets(FINE_STEPS), True: _offsets(STEPS)}
BOX_LINKS = {False: _box_links(FINE_STEPS), True: _box_links(STEPS)}
BOX_WEIGHTS, CORNER_LINKS = _box_weights(), _corner_links()
OWN = np.array([(number, *cell) for number, cell in enumerate(LOCAL) if max(cell) < 2])
CORNER_PLACES = np.array(CORNERS)
FIRST_OF = np.array([FIRST.get(kind, -1) for kind in CORNERS])  # by kind as a binary number


@inner
def _stencil(stencil, i, j, k, kind, links, offsets):
    """The links of a cell, those along its even axes summed up -> their sum."""
    stencil[:] = 0.0
    total = 0.0
    for m in range(offsets.shape[0]):
        d0, d1, d2, which, back = offsets[m]
        o0, o1, o2 = d0 * kind[0], d1 * kind[1], d2 * kind[2]
        if o0 != 0 or o1 != 0 or o2 != 0:
            a = links[which, i + back * d0, j + back * d1, k + back * d2]
            stencil[9 * o0 + 3 * o1 + o2 + 13] += a
            total += a
    return total


@inner
def _through(share, o, kind, place, first, found, row):
    """Add to the weights of a cell those of its neighbour at the offset o, `share` times."""
    f0, f1, f2 = kind[0] * (o[0] == 0), kind[1] * (o[1] == 0), kind[2] * (o[2] == 0)
    start, number = first[4 * f0 + 2 * f1 + f2], 0
    a, b, c = (place[0] + o[0] + 1) // 2, (place[1] + o[1] + 1) // 2, (place[2] + o[2] + 1) // 2
    for s0 in range(1 + f0):
        for s1 in range(1 + f1):
            for s2 in range(1 + f2):
                side0 = s0 if o[0] == 0 else (o[0] + 1) // 2
                side1 = s1 if o[1] == 0 else (o[1] + 1) // 2
                side2 = s2 if o[2] == 0 else (o[2] + 1) // 2
                corner = side0
                if kind[1]:
                    corner = 2 * corner + side1
                if kind[2]:
                    corner = 2 * corner + side2
                row[corner] += share * (found[start + number, a, b, c] if start >= 0 else 1.0)
                number += 1


@inner
def _weights_of_kind(kind, links, extra, root, offsets, first, found):
    """Weights of the cells of a kind, from their equations and the weights of the cells between."""
    stencil, row = np.zeros(27), np.zeros(8)
    start, count = first[4 * kind[0] + 2 * kind[1] + kind[2]], 2 ** (kind[0] + kind[1] + kind[2])
    for i in range(1 + kind[0], extra.shape[0] - 2, 2):
        for j in range(1 + kind[1], extra.shape[1] - 2, 2):
            for k in range(1 + kind[2], extra.shape[2] - 2, 2):
                total = _stencil(stencil, i, j, k, kind, links, offsets) + extra[i, j, k]
                row[:] = 0.0
                if total > WEAK * root[i, j, k] ** 2:
                    for m in range(27):
                        if stencil[m] != 0.0:
                            o = m // 9 - 1, m // 3 % 3 - 1, m % 3 - 1
                            _through(stencil[m] / total, o, kind, (i, j, k), first, found, row)
                for m in range(count):
                    found[start + m, (i + 1 - kind[0]) // 2, (j + 1 - kind[1]) // 2, (k + 1 - kind[2]) // 2] = row[m]


@inner
def _matrix_of_box(k, w, a, b, c, links, extra, found, box_weights, box_links, own):
    """The 8 x 8 matrix on the corners of a box, and what its extras add to the diagonal."""
    for m in range(box_weights.shape[0]):
        cell, corner, which, s0, s1, s2 = box_weights[m]
        w[cell, corner] = found[which, a + s0, b + s1, c + s2]
    k[:] = 0.0
    for m in range(box_links.shape[0]):
        u, v, which, s0, s1, s2 = box_links[m]
        value = links[which, 2 * a - 1 + s0, 2 * b - 1 + s1, 2 * c - 1 + s2]
        if value != 0.0:
            for p in range(8):
                share = value * (w[u, p] - w[v, p])
                for q in range(8):
                    k[p, q] += share * (w[u, q] - w[v, q])
    for p in range(8):
        k[8, p] = k[p].sum()
    for m in range(own.shape[0]):
        cell, s0, s1, s2 = own[m]
        value = extra[2 * a - 1 + s0, 2 * b - 1 + s1, 2 * c - 1 + s2]
        if value != 0.0:
            value *= w[cell].sum()
            for p in range(8):
                k[8, p] += value * w[cell, p]


@inner
def _galerkin(links, extra, found, coarse, rest, periodic, box_weights, box_links, own, corner_links, corners):
    """Add up the coarse links and extras (`rest`), box by box. Corners outside are added and ignored."""
    n0, n1, n2 = rest.shape[0] - 3, rest.shape[1] - 3, rest.shape[2] - 3
    k, w = np.zeros((9, 8)), np.zeros((27, 8))
    for p in range(8):
        w[18 * corners[p, 0] + 6 * corners[p, 1] + 2 * corners[p, 2], p] = 1.0
    for a in range(1, n0 + 1):
        a1 = 1 if periodic[0] and a == n0 else a + 1
        for b in range(1, n1 + 1):
            b1 = 1 if periodic[1] and b == n1 else b + 1
            for c in range(1, n2 + 1):
                c1 = 1 if periodic[2] and c == n2 else c + 1
                _matrix_of_box(k, w, a, b, c, links, extra, found, box_weights, box_links, own)
                for m in range(corner_links.shape[0]):
                    p, q, which, s0, s1, s2 = corner_links[m]
                    coarse[which, a1 if s0 else a, b1 if s1 else b, c1 if s2 else c] -= k[p, q]
                for p in range(8):
                    s0, s1, s2 = corners[p]
                    rest[a1 if s0 else a, b1 if s1 else b, c1 if s2 else c] += k[8, p]


def scales(links, extra, scale, root, nine):
    """Fill one over the root of the diagonal, and the root; 0 where there is no unknown."""
    shape = tuple(n - 3 for n in extra.shape)
    own = inside(shape)
    total = extra[own].copy()
    for step, a in zip(STEPS if nine else FINE_STEPS, links):
        total += a[own]
        total += a[tuple(slice(1 - d, 1 - d + n) for d, n in zip(step, shape))]
    root[own] = np.sqrt(np.maximum(total, 0.0, out=total))
    np.divide(1.0, root[own], out=scale[own], where=root[own] > 0)


def weights(links, extra, scale, root, shape, periodic, nine):
    """Parities of a cell -> its weights on the coarse corners around, an array for each corner."""
    coarse = tuple((n + 1) // 2 for n in shape)
    found = padded(coarse, sum(2 ** sum(kind) for kind in KINDS))
    views: dict[tuple[int, ...], np.ndarray] = {(0, 0, 0): np.ones((1, *found.shape[1:]))}
    for kind in KINDS:
        _weights_of_kind(kind, links, extra, root, OFFSETS[nine], FIRST_OF, found)
        views[kind] = found[FIRST[kind] : FIRST[kind] + 2 ** sum(kind)]
        for array in views[kind]:
            repeat(array, coarse, periodic)
    return views


def galerkin(links, extra, found, coarse, rest, periodic, nine):
    """Fill the coarse links and extras."""
    whole = found[KINDS[0]].base
    tables = BOX_WEIGHTS, BOX_LINKS[nine], OWN, CORNER_LINKS, CORNER_PLACES
    _galerkin(links, extra, whole, coarse, rest, periodic, *tables)
