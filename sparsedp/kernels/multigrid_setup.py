"""Compiled set-up of the structured multigrid in 2-D: black-box interpolation and Galerkin coarsening.

Arrays are in natural order (see `multigrid_pack`). The matrix is given by its links a >= 0 from a cell to
the cells in front of it, east (i, j + 1), south-west, south (i + 1, j) and south-east, and by `extra`, what
remains of its diagonal:
x.A x = sum of a (x_i - x_j)^2 + sum of extra x_i^2. On the finest level the diagonal links are missing.

Coarse cells sit on the cells with even indices. Source: J. E. Dendy, Black box multigrid, J. Comput.
Phys. 48 (1982) 366-386.
"""

from sparsedp.kernels.multigrid_boxes import boxes, galerkin
from sparsedp.kernels.multigrid_pack import padded, repeat
from sparsedp.kernels.multigrid_rows import entry, inner

__all__ = ["coarsen", "weights"]

FINE_STEPS = [(0, 0, 1), (1, 0, 0)]
STEPS = [(0, 0, 1), (1, 0, -1), (1, 0, 0), (1, 0, 1)]
ONE, NONE = 11, 12  # numbers of the weight of a coarse cell on itself, and of 0
NUMBERS = {(0, 0, 1): 0, (1, 0, 0): 3, (1, 0, 1): 6}, ONE, NONE, {(0, 0, 1): 2, (1, 0, 0): 5, (1, 0, 1): 10}
BOXES = {nine: boxes((1, 0, 1), STEPS if nine else FINE_STEPS, STEPS, *NUMBERS) for nine in (False, True)}
WEAK = 1e-10  # a cell held by less than this share of its diagonal is not interpolated


def _four(links, nine):
    """Links with stand-ins for those that the finest level does not have: they are not read."""
    return tuple(links) if nine else (links[0], links[0], links[1], links[0])


@inner
def _set_line(out, a, b, extra, weak, i, j):
    """Two weights and their sum: exactly 1 where nothing is left of the diagonal, so that no rounding adds up."""
    total = a + b + extra
    scale = 1.0 / total if total > weak else 0.0
    out[0, i, j], out[1, i, j] = a * scale, b * scale
    out[2, i, j] = 1.0 if extra == 0.0 and scale > 0.0 else (a + b) * scale


@entry
def _line_weights(links, extra, root, horizontal, vertical, nine):
    """Weights of cells between two coarse cells: the other axis summed up."""
    east, sw, south, se = links
    n0, n1 = root.shape[0] - 3, root.shape[1] - 3
    for i in range(1, n0 + 1, 2):
        for k in range(2, n1 + 1, 2):
            a, b = east[i, k - 1], east[i, k]
            if nine:
                a += se[i - 1, k - 1] + sw[i, k]
                b += sw[i - 1, k + 1] + se[i, k]
            _set_line(horizontal, a, b, extra[i, k], WEAK * root[i, k] ** 2, (i + 1) // 2, k // 2)
    for k in range(2, n0 + 1, 2):
        for j in range(1, n1 + 1, 2):
            a, b = south[k - 1, j], south[k, j]
            if nine:
                a += se[k - 1, j - 1] + sw[k - 1, j + 1]
                b += sw[k, j] + se[k, j]
            _set_line(vertical, a, b, extra[k, j], WEAK * root[k, j] ** 2, k // 2, (j + 1) // 2)


@entry
def _inner_weights(links, extra, scales, horizontal, vertical, inside, nine):
    """Weights of cells between four coarse cells, from their own equation, and their sum."""
    east, sw, south, se = links
    for i in range(2, scales.shape[0] - 2, 2):
        for j in range(2, scales.shape[1] - 2, 2):
            scale, a, b = scales[i, j] ** 2, i // 2, j // 2
            n, s, w, e = south[i - 1, j] * scale, south[i, j] * scale, east[i, j - 1] * scale, east[i, j] * scale
            p, q, r, t = n * horizontal[0, a, b], n * horizontal[1, a, b], s * horizontal[0, a + 1, b], 0.0
            t = s * horizontal[1, a + 1, b] + e * vertical[1, a, b + 1]
            p, q, r = p + w * vertical[0, a, b], q + e * vertical[0, a, b + 1], r + w * vertical[1, a, b]
            corners = 0.0
            if nine:
                c, d, f, g = se[i - 1, j - 1] * scale, sw[i - 1, j + 1] * scale, sw[i, j] * scale, se[i, j] * scale
                p, q, r, t, corners = p + c, q + d, r + f, t + g, c + d + f + g
            up, down = horizontal[2, a, b], horizontal[2, a + 1, b]
            left, right = vertical[2, a, b], vertical[2, a, b + 1]
            whole = (up == 1.0 or n == 0.0) and (down == 1.0 or s == 0.0) and (left == 1.0 or w == 0.0)
            whole = whole and (right == 1.0 or e == 0.0) and extra[i, j] == 0.0 and scale > 0.0
            inside[0, a, b], inside[1, a, b], inside[2, a, b], inside[3, a, b] = p, q, r, t
            inside[4, a, b] = 1.0 if whole else n * up + s * down + w * left + e * right + corners


def weights(links, extra, scale, root, shape, periodic, nine):
    """Parities of a cell -> its weights on the coarse corners around, an array for each corner, and their sum."""
    coarse = tuple((n + 1) // 2 for n in shape)
    found = padded(coarse, NONE + 1)
    found[ONE] = 1.0
    horizontal, vertical, inside = found[0:3], found[3:6], found[6:ONE]
    links = _four(links, nine)
    _line_weights(links, extra, root, horizontal, vertical, nine)
    for line in (*horizontal, *vertical):
        repeat(line, coarse, periodic)
    _inner_weights(links, extra, scale, horizontal, vertical, inside, nine)
    for line in inside:
        repeat(line, coarse, periodic)
    return {(0, 0): found[ONE:NONE], (0, 1): horizontal, (1, 0): vertical, (1, 1): inside}


def coarsen(links, extra, found, coarse, rest, periodic, nine):
    """Fill the coarse links and extras."""
    flat = [
        array.reshape(*array.shape[:-1], 1, array.shape[-1]) for array in (links, extra[None], found[0, 1].base, coarse)
    ]
    galerkin(*flat, rest[:, None], (periodic[0], False, periodic[1]), 0, *BOXES[nine])
