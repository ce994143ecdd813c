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

from sparsedp.kernels.multigrid_boxes import boxes, galerkin
from sparsedp.kernels.multigrid_pack import padded, repeat
from sparsedp.kernels.multigrid_rows import entry, inner
from sparsedp.kernels.multigrid_setup import WEAK

__all__ = ["coarsen", "weights"]

FINE_STEPS = [(0, 0, 1), (1, 0, 0), (0, 1, 0)]
STEPS = [(0, 0, 1)] + [(d0, d1, d2) for d0, d1 in ((0, 1), (1, -1), (1, 0), (1, 1)) for d2 in (-1, 0, 1)]
KINDS = sorted(product((0, 1), repeat=3), key=sum)[1:]
FIRST: dict[tuple[int, ...], int] = dict(zip(KINDS, np.cumsum([0, *(2 ** sum(kind) for kind in KINDS)]).tolist()))
ONE = sum(2 ** sum(kind) for kind in KINDS)  # number of the weight of a coarse cell on itself
NONE = ONE + 1  # and of 0


def _offsets(steps):
    """Rows: shift to a neighbour, number of the link, 1 if the link is the neighbour's."""
    forward = [(*step, m, 0) for m, step in enumerate(steps)]
    return np.array(forward + [(-d0, -d1, -d2, m, 1) for d0, d1, d2, m, _ in forward])


OFFSETS = {False: _offsets(FINE_STEPS), True: _offsets(STEPS)}
BOXES = {nine: boxes((1, 1, 1), STEPS if nine else FINE_STEPS, STEPS, FIRST, ONE, NONE) for nine in (False, True)}
FIRST_OF = np.array([FIRST.get(kind, ONE) for kind in product((0, 1), repeat=3)])  # by kind as a binary number


@inner
def _neighbours(kind, offsets):
    """Offsets along odd axes, as numbers in a cube of 27, of which a cell of a kind has neighbours."""
    found = np.zeros(27, np.int64)
    for m in range(offsets.shape[0]):
        found[9 * offsets[m, 0] * kind[0] + 3 * offsets[m, 1] * kind[1] + offsets[m, 2] * kind[2] + 13] = 1
    found[13] = 0
    return np.flatnonzero(found)


@inner
def _shares(shares, used, i, j, kind, links, extra, root, offsets):
    """The links of every second cell of a line, those along even axes summed up, as shares of their sum."""
    n, first, total = shares.shape[1], 1 + kind[2], shares[13]
    for m in used:
        shares[m] = 0.0
    line = extra[i, j]
    for c in range(n):
        total[c] = line[first + 2 * c]
    for m in range(offsets.shape[0]):
        d0, d1, d2, which, back = offsets[m]
        place = 9 * d0 * kind[0] + 3 * d1 * kind[1] + d2 * kind[2] + 13
        if place != 13:
            out, line = shares[place], links[which, i + back * d0, j + back * d1]
            for c in range(n):
                value = line[first + back * d2 + 2 * c]
                out[c] += value
                total[c] += value
    line = root[i, j]
    for c in range(n):
        size = line[first + 2 * c]
        total[c] = 1.0 / total[c] if total[c] > WEAK * size * size else 0.0
    for m in used:
        out = shares[m]
        for c in range(n):
            out[c] *= total[c]


@inner
def _through(share, o, kind, i, j, first, found, lines):
    """Add to the weights of a line of cells those of the neighbours at the offset o, `share` times."""
    f0, f1, f2 = kind[0] * (o[0] == 0), kind[1] * (o[1] == 0), kind[2] * (o[2] == 0)
    number, n = first[4 * f0 + 2 * f1 + f2], share.size
    a, b, c0 = (i + o[0] + 1) // 2, (j + o[1] + 1) // 2, (2 + kind[2] + o[2]) // 2
    for s0 in range(1 + f0):
        for s1 in range(1 + f1):
            for s2 in range(1 + f2):
                corner = s0 if o[0] == 0 else (o[0] + 1) // 2
                if kind[1]:
                    corner = 2 * corner + (s1 if o[1] == 0 else (o[1] + 1) // 2)
                if kind[2]:
                    corner = 2 * corner + (s2 if o[2] == 0 else (o[2] + 1) // 2)
                weight, out = found[number, a, b, c0 : c0 + n], lines[corner]
                for c in range(n):
                    out[c] += share[c] * weight[c]
                number += 1


@entry
def _weights_of_kind(kind, links, extra, root, offsets, first, found):
    """Weights of the cells of a kind, from their equations and the weights of the cells between, line by line."""
    n = (extra.shape[2] - 2 - kind[2]) // 2
    shares, lines, used = np.zeros((27, n)), np.zeros((8, n)), _neighbours(kind, offsets)
    start, count = first[4 * kind[0] + 2 * kind[1] + kind[2]], 2 ** (kind[0] + kind[1] + kind[2])
    for i in range(1 + kind[0], extra.shape[0] - 2, 2):
        for j in range(1 + kind[1], extra.shape[1] - 2, 2):
            _shares(shares, used, i, j, kind, links, extra, root, offsets)
            lines[:] = 0.0
            for m in used:
                o = m // 9 - 1, m // 3 % 3 - 1, m % 3 - 1
                _through(shares[m], o, kind, i, j, first, found, lines)
            for m in range(count):
                found[start + m, (i + 1 - kind[0]) // 2, (j + 1 - kind[1]) // 2, 1 : 1 + n] = lines[m]


def weights(links, extra, scale, root, shape, periodic, nine):
    """Parities of a cell -> its weights on the coarse corners around, an array for each corner."""
    coarse = tuple((n + 1) // 2 for n in shape)
    found = padded(coarse, NONE + 1)
    found[ONE] = 1.0
    views: dict[tuple[int, ...], np.ndarray] = {(0, 0, 0): found[ONE:NONE]}
    for kind in KINDS:
        _weights_of_kind(kind, links, extra, root, OFFSETS[nine], FIRST_OF, found)
        views[kind] = found[FIRST[kind] : FIRST[kind] + 2 ** sum(kind)]
        for array in views[kind]:
            repeat(array, coarse, periodic)
    return views


def coarsen(links, extra, found, coarse, rest, periodic, nine):
    """Fill the coarse links and extras."""
    galerkin(links, extra[None], found[KINDS[0]].base, coarse, rest, periodic, 1, *BOXES[nine])
