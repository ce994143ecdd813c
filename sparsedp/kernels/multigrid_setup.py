"""Compiled set-up of the structured multigrid in 2-D: black-box interpolation and Galerkin coarsening.

Arrays are in natural order (see `multigrid_pack`). The matrix is given by its links a >= 0 from a cell to
the cells in front of it, east (i, j + 1), south-west, south (i + 1, j) and south-east, and by `extra`, what
remains of its diagonal:
x.A x = sum of a (x_i - x_j)^2 + sum of extra x_i^2. On the finest level the diagonal links are missing.

Coarse cells sit on the cells with even indices. Source: J. E. Dendy, Black box multigrid, J. Comput.
Phys. 48 (1982) 366-386.
"""

import numpy as np

from sparsedp.kernels.multigrid import inner
from sparsedp.kernels.multigrid_pack import padded, repeat

__all__ = ["galerkin", "scales", "weights"]

WEAK = 1e-10  # a cell held by less than this share of its diagonal is not interpolated


def _four(links, nine):
    """Links with stand-ins for those that the finest level does not have: they are not read."""
    return tuple(links) if nine else (links[0], links[0], links[1], links[0])


@inner
def _scales(links, extra, scale, root, nine):
    """One over the root of the diagonal, and the root; 0 where there is no unknown."""
    east, sw, south, se = links
    n0, n1 = scale.shape[0] - 3, scale.shape[1] - 3
    for i in range(1, n0 + 1):
        line = root[i]
        for j in range(1, n1 + 1):
            line[j] = extra[i, j] + east[i, j] + east[i, j - 1] + south[i, j] + south[i - 1, j]
        if nine:
            for j in range(1, n1 + 1):
                line[j] += se[i, j] + se[i - 1, j - 1] + sw[i, j] + sw[i - 1, j + 1]
        for j in range(1, n1 + 1):
            line[j] = np.sqrt(max(line[j], 0.0))
            scale[i, j] = 1.0 / line[j] if line[j] > 0.0 else 0.0


@inner
def _set_line(out, a, b, extra, weak, i, j):
    """Two weights and their sum: exactly 1 where nothing is left of the diagonal, so that no rounding adds up."""
    total = a + b + extra
    scale = 1.0 / total if total > weak else 0.0
    out[0, i, j], out[1, i, j] = a * scale, b * scale
    out[2, i, j] = 1.0 if extra == 0.0 and scale > 0.0 else (a + b) * scale


@inner
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


@inner
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


@inner
def _linked(k, a, u, v):
    """Add the link a between cells with weights u and v on the four corners, and their sum: six links, four extras."""
    p, q, r, s = u[0] - v[0], u[1] - v[1], u[2] - v[2], u[3] - v[3]
    ap, aq, ar, rest = a * p, a * q, a * r, a * (u[4] - v[4])
    return (
        k[0] - ap * q, k[1] - ap * r, k[2] - ap * s, k[3] - aq * r, k[4] - aq * s, k[5] - ar * s,
        k[6] + p * rest, k[7] + q * rest, k[8] + r * rest, k[9] + s * rest
    )  # fmt: skip


@inner
def _on_line(k, a, u, v):
    """The same for cells between the first two corners."""
    p, q, rest = u[0] - v[0], u[1] - v[1], a * (u[4] - v[4])
    return (k[0] - a * p * q,) + k[1:6] + (k[6] + p * rest, k[7] + q * rest) + k[8:]


@inner
def _on_column(k, a, u, v):
    """The same for cells between the first and the third corner."""
    p, q, rest = u[0] - v[0], u[2] - v[2], a * (u[4] - v[4])
    return (k[0], k[1] - a * p * q) + k[2:6] + (k[6] + p * rest, k[7], k[8] + q * rest, k[9])


@inner
def _held(k, a, u):
    """Add the extra a of a cell with the weights u."""
    rest = a * u[4]
    return k[:6] + (k[6] + u[0] * rest, k[7] + u[1] * rest, k[8] + u[2] * rest, k[9] + u[3] * rest)


@inner
def _square(i, j, a, b, links, extra, horizontal, vertical, inside, nine):
    """Links and extras among the corners of one coarse square, from the four cells that it owns."""
    east, sw, south, se = links
    c, c1 = (1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.0, 1.0)
    c2, c3 = (0.0, 0.0, 1.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0, 1.0)
    h = horizontal[0, a, b], horizontal[1, a, b], 0.0, 0.0, horizontal[2, a, b]
    h1 = 0.0, 0.0, horizontal[0, a + 1, b], horizontal[1, a + 1, b], horizontal[2, a + 1, b]
    v = vertical[0, a, b], 0.0, vertical[1, a, b], 0.0, vertical[2, a, b]
    v1 = 0.0, vertical[0, a, b + 1], 0.0, vertical[1, a, b + 1], vertical[2, a, b + 1]
    f = inside[0, a, b], inside[1, a, b], inside[2, a, b], inside[3, a, b], inside[4, a, b]
    k = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, extra[i, j], 0.0, 0.0, 0.0)
    k = _held(_held(_held(k, extra[i, j + 1], h), extra[i + 1, j], v), extra[i + 1, j + 1], f)
    k = _on_line(_on_line(k, east[i, j], c, h), east[i, j + 1], h, c1)
    k = _on_column(_on_column(k, south[i, j], c, v), south[i + 1, j], v, c2)
    k = _linked(_linked(k, east[i + 1, j], v, f), east[i + 1, j + 1], f, v1)
    k = _linked(_linked(k, south[i, j + 1], h, f), south[i + 1, j + 1], f, h1)
    if nine:
        k = _linked(_linked(k, se[i, j], c, f), se[i + 1, j + 1], f, c3)
        k = _linked(_linked(k, sw[i, j + 2], c1, f), sw[i + 1, j + 1], f, c2)
        k = _linked(_linked(k, se[i, j + 1], h, v1), se[i + 1, j], v, h1)
        k = _linked(_linked(k, sw[i, j + 1], h, v), sw[i + 1, j + 2], v1, h1)
    return k


@inner
def _galerkin(links, extra, horizontal, vertical, inside, coarse, rest, periodic, nine):
    """Add up the coarse links and extras (`rest`), square by square. Corners outside are added and ignored."""
    east, sw, south, se = coarse
    n0, n1 = rest.shape[0] - 3, rest.shape[1] - 3
    for a in range(1, n0 + 1):
        a1 = 1 if periodic[0] and a == n0 else a + 1
        for b in range(1, n1 + 1):
            b1 = 1 if periodic[1] and b == n1 else b + 1
            k = _square(2 * a - 1, 2 * b - 1, a, b, links, extra, horizontal, vertical, inside, nine)
            east[a, b] += k[0]
            east[a1, b] += k[5]
            south[a, b] += k[1]
            south[a, b1] += k[4]
            se[a, b] += k[2]
            sw[a, b1] += k[3]
            rest[a, b] += k[6]
            rest[a, b1] += k[7]
            rest[a1, b] += k[8]
            rest[a1, b1] += k[9]


def scales(links, extra, scale, root, nine):
    """Fill one over the root of the diagonal, and the root; 0 where there is no unknown."""
    _scales(_four(links, nine), extra, scale, root, nine)


def weights(links, extra, scale, root, shape, periodic, nine):
    """Parities of a cell -> its weights on the coarse corners around, an array for each corner, and their sum."""
    coarse = tuple((n + 1) // 2 for n in shape)
    horizontal, vertical, inside = (padded(coarse, corners + 1) for corners in (2, 2, 4))
    links = _four(links, nine)
    _line_weights(links, extra, root, horizontal, vertical, nine)
    for line in (*horizontal, *vertical):
        repeat(line, coarse, periodic)
    _inner_weights(links, extra, scale, horizontal, vertical, inside, nine)
    for line in inside:
        repeat(line, coarse, periodic)
    return {(0, 0): np.ones((1, *horizontal.shape[1:])), (0, 1): horizontal, (1, 0): vertical, (1, 1): inside}


def galerkin(links, extra, found, coarse, rest, periodic, nine):
    """Fill the coarse links and extras."""
    arrays = found[0, 1], found[1, 0], found[1, 1], tuple(coarse)
    _galerkin(_four(links, nine), extra, *arrays, rest, periodic, nine)
