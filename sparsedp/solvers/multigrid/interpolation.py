"""Black-box interpolation: weights from the equations of the cells themselves, so that jumps of coefficients are met.

A cell between two coarse ones takes from them what its equation says when everything across the line between them is
summed up; a cell between four, when everything across the plane is; a cell between eight takes what its own equation
says, given the values of all cells around. Sources: J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982)
366-386; Two multigrid methods for three-dimensional problems with discontinuous and anisotropic coefficients, SIAM J.
Sci. Stat. Comput. 8 (1987) 673-685.
"""

from itertools import product

import numpy as np

__all__ = ["Transfer", "interpolated"]

WEAK = 1e-10  # a cell held by less than this share of its diagonal is not interpolated


class Transfer:
    """How the cells of some colours take from the coarse cells around.

    Attributes
    ----------
    rows : list of (colour, corner, distance)
        For each weight the cell and the coarse cell. The weight of a coarse cell on itself is kept as one half and
        used twice, so that all tables have an even number of rows.
    up, ends : int64 arrays
        Table of interpolation, and where it begins and ends for each of the colours.
    down : int64 array
        Table of restriction, its transpose.
    """

    def __init__(self, layout, colours):
        self.rows: list = []
        up: list = []
        ends: list = []
        down: list = []
        for m, colour in enumerate(colours):
            kind, first = layout.colours[colour], len(up)
            for corner in product(*(range(1 + p) for p in kind)):
                far = sum(s * pitch for s, pitch in zip(corner, layout.pitch))
                for _ in range(1 if any(kind) else 2):
                    up.append((len(self.rows), 0, 0, far))
                    down.append((len(self.rows), -far, m, -far))
                self.rows.append((colour, corner, far))
            ends.append((first, len(up)))
        self.up, self.ends, self.down = np.array(up), np.array(ends), np.array(down)

    def scaled(self, weights, level, coarse, stretch, dtype):
        """The weights of all colours -> those of these colours, of the levels scaled to a unit diagonal."""
        layout = level.layout
        numbers = {row: n for n, row in enumerate(Transfer(layout, range(len(layout.colours))).rows)}
        out = layout.zeros(len(self.rows), dtype=dtype)
        for row, (colour, corner, far) in zip(out, self.rows):
            value = layout.body(weights[numbers[colour, corner, far]]) * layout.body(coarse, far)
            value *= layout.body(level.root[colour])
            layout.body(row)[:] = value * (stretch if colour else 0.5 * stretch)
        return layout.wrap(out)


def interpolated(level):
    """Level -> weights of all cells on the coarse ones, and what their sums miss to 1: exactly 0 where nothing is held.

    Parameters
    ----------
    level : Level

    Returns
    -------
    array
        The weights, in the order of `Transfer.rows`; a row of 0; what is missing, a row for each colour.
    """
    layout = level.layout
    rows = Transfer(layout, range(len(layout.colours))).rows
    number = {(layout.colours[colour], corner): n for n, (colour, corner, _) in enumerate(rows)}
    weights = layout.zeros(len(rows) + 1 + len(layout.colours))
    missing = weights[len(rows) + 1 :]
    layout.cells(weights[0], 0)[...] = 1.0
    layout.wrap(weights[0])
    for colour in sorted(range(1, len(layout.colours)), key=lambda q: sum(layout.colours[q])):
        kind = layout.colours[colour]
        shares = _shares(level, colour)
        lost = layout.body(level.extra[colour])
        total = sum(shares.values(), lost)
        held = total > WEAK * layout.body(level.root[colour]) ** 2
        factor = np.divide(1.0, total, out=np.zeros_like(total), where=held)
        lost = np.where(held, lost * factor, 1.0)
        for offset, share in shares.items():
            share *= factor
            beside, far = layout.neighbour(colour, offset)
            other = layout.colours[beside]
            for corner in product(*(range(1 + p) for p in other)):
                own = tuple(s + (1 + d) // 2 if p else 0 for s, d, p in zip(corner, offset, kind))
                out, given = layout.body(weights[number[kind, own]]), layout.body(weights[number[other, corner]], far)
                out += share * given if any(other) else share
            lost += share * layout.body(missing[beside], far)
        layout.body(missing[colour])[:] = lost
        first = number[kind, (0,) * layout.dim]
        layout.wrap(weights[first : first + 2 ** sum(kind)])
        layout.wrap(missing[colour])
    return weights


def _shares(level, colour):
    """The links of the cells of a colour, those along even axes summed up: by the offset that is left."""
    layout, kind = level.layout, level.layout.colours[colour]
    shares: dict = {}
    first, _, last = level.ends[colour]
    for (link, shift, _, _), step in zip(level.near[first:last], level.steps[first:last]):
        offset = tuple(d * p for d, p in zip(step, kind))
        if any(offset):
            a = layout.body(level.links[link], shift)
            shares[offset] = shares[offset] + a if offset in shares else a.copy()
    return shares
