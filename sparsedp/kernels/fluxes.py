"""Upwind fluxes: a stage of an Eulerian transport scheme along all axes, its pullback, and the limiters.

A component of the field is one flat array with up to three axes. The loops go through it row by row along its last
axis, at most TILE cells at a time, and look at the sides of these cells in two pieces: the cells that have a neighbour
beyond the side, and those at the end of an axis. All cells of a piece find what is beyond the same number of places
away: round the end of a periodic axis, and at a wall the cell itself stands for the ghost cell, which a share of 0
takes away where inflow is given. So one inner loop serves all boundaries and dimensions. Lengths and obstacles are in
a line of factors, 0 on sides that are closed. With Courant numbers C on the lower and upper side of a cell,
p = max(C, 0), m = min(C, 0),

    u'     = (1 - leaves) u + enters
    leaves = p_lower - m_upper  [+ C_upper - C_lower in flux form],   enters = p_lower x_below - m_upper x_above.

x_below = u_below + ahead_below is the value at the side as the cell below has it, x_above = u_above - behind_above as
the cell above has it; with a scheme of higher order p_upper ahead + m_lower behind leaves the cell too. A scheme is one
function, such as `van_leer`: from the differences a, b to the cells below and above and from c, e, the distances to
them over half the width (2 between equal cells), to

    ahead, behind, d ahead/da, d ahead/db, d behind/da, d behind/db,

with numbers or arrays, and one line of SCHEMES.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from sparsedp.kernels.team import Kernel, kernel

__all__ = [
    "SCHEMES",
    "TILE",
    "Scheme",
    "jumps",
    "pull",
    "slopes",
    "slopes_of",
    "stage",
]

TILE = 256  # cells that are worked on at a time: what one loop leaves in a line, the next finds in the cache
LINE = TILE + 72  # of lines that start a power of 2 apart the cache keeps few


# Columns of `axes`, which has a row for each axis of a component: its cells; the distance of neighbours in the field;
# whether rows go along it; whether it is periodic; whether the velocity stands on sides, not in cells; where it starts,
# and how many numbers a block of the cells along this axis and the later ones has beyond one a cell; where the lower
# and the upper wall start in the inflow, and whether inflow is given there; where its rows in `table` start, and end.
N, STRIDE, ALONG, PERIODIC, ON_SIDES, SPEED, EXTRA, WALL, _, GIVEN, _, ROWS = range(12)

# Rows of an axis in `table`, a number for each place along it, or one for all: 1 over the length for the lower and for
# the upper side of a cell, as the cell has it (OWN) and as the cell beyond has it (THEIRS); c and e (DISTANCE).
OWN, THEIRS, DISTANCE = 0, 2, 4


def van_leer(a, b, c, e):
    """The limiter of van Leer, for cells of any width; see `sparsedp.advection.eulerian` for the formula.

    With q = a / (a + b), p = 1 - q, E = q e^2, C = p c^2, m = (c + e - 2) c e it is (a + b) R, R = N / D,
    N = q p (E + C), D = q E + m q p + p C; d/da = (p (2 E + C) - R (2 E + m p)) / D, d/db likewise.
    """
    same = ((a > 0.0) & (b > 0.0)) | ((a < 0.0) & (b < 0.0))
    mine = a * same
    both = mine + (b * same + (1.0 - same))  # not 0
    q = mine / both
    p = 1.0 - q
    mixed = (c + e) * (c * e) - c * e * 2.0
    high, low = q * (e * e), p * (c * c)
    inverse = 1.0 / (q * (high + mixed * p) + p * low)  # divisions take most of the time
    ratio = q * p * (high + low) * inverse
    slope = both * ratio
    scale = same * inverse
    # where one of a, b is 0 the derivative is the mean of both sides
    da = (p * (2.0 * high + low) - ratio * (2.0 * high + mixed * p)) * scale + 0.5 * ((a == 0.0) & (b != 0.0))
    db = (q * (high + 2.0 * low) - ratio * (2.0 * low + mixed * q)) * scale + 0.5 * ((b == 0.0) & (a != 0.0))
    return slope, slope, da, db, da, db


class Scheme(NamedTuple):
    """A scheme: its limiter, its stages, the largest sum of Courant numbers, whether ahead and behind are the same."""

    limiter: Any = None
    stages: tuple = (0.0,)  # a: the next field is a times the first one + (1 - a) times a step from the last one
    most: float = 1.0
    symmetric: bool = False


SCHEMES = {"upwind": Scheme(), "van_leer": Scheme(van_leer, stages=(0.0, 0.5), most=0.5, symmetric=True)}


# ---- pieces ----------------------------------------------------------------------------------------------------------
#
# The loops work on tiles: at most TILE cells of a row along the last axis. They look at one side of the cells after the
# other; `upper` is 0 for the lower one along an axis, 1 for the upper one. Places are unsigned numbers: nobody asks
# then whether they are negative, and the loops fill the vector units.


class Piece(NamedTuple):
    """Cells of a tile that find what is on one side of them the same number of places away; all places unsigned."""

    begin: int  # to `end`: the cells, counted in the tile
    end: int
    beyond: int  # where the cell on the other side of the side of the first cell of the tile is, in the field
    speed: int  # where the velocity on that side is
    wall: int  # where the inflow there is; only where `closed` is 1
    closed: int  # 1 where nothing but a wall is on that side: `beyond` is then the cell itself
    given: int  # 1 where inflow is given at that wall


def cells_of(axes, part):
    """The first cell of a tile, and how many there are."""
    length = axes[-1, N]
    tiles = -(-length // TILE)
    left = part % tiles * TILE
    return part // tiles * length + left, min(length - left, TILE)


def place_of(axes, a, first):
    """Where a cell stands along an axis; how many lines of cells along it come before its own, in blocks and in one."""
    through = first // axes[a, STRIDE]
    block = through // axes[a, N]
    return through - block * axes[a, N], block, first - through * axes[a, STRIDE]


def piece_of(axes, a, upper, last, first, size, where):
    """Of a tile, the cells that have a neighbour on a side along axis a, or the last ones before its end."""
    place, block, rest = where
    n, stride, walls = axes[a, N], axes[a, STRIDE], 1 - axes[a, PERIODIC]
    places, cells = (size, 1) if axes[a, ALONG] else (1, size)  # the tile is at so many, with so many cells at each
    ends = cells if place == (n - places) * upper else 0
    begin, end = (size - ends) * upper, size if upper else ends
    if not last:
        begin, end = (0, begin) if upper else (end, size)
    step = (2 * upper - 1) * stride
    if last:
        step = 0 if walls else (1 - n) * step
    speed = axes[a, SPEED] + first + block * axes[a, EXTRA] + upper * axes[a, ON_SIDES] * (stride if walls else step)
    wall, closed = axes[a, WALL + upper] + block * stride + rest - begin, last * walls
    places = uint64(begin), uint64(end), uint64(first + step), uint64(speed), uint64(wall)
    return Piece(*places, closed, closed * axes[a, GIVEN + upper])


def scale(line, fresh, ratio, table, axes, a, row, place, size, free, base):
    """The line gets the ratio times the number of each place in a row of an axis; 0 on closed sides.

    A line that is the same in all tiles is filled in the first one (fresh).
    """
    begin, many = axes[a, ROWS + row], axes[a, ROWS + row + 1] - axes[a, ROWS + row]
    start = uint64(begin + (place if many > 1 else 0))
    if axes[a, ALONG] and many > 1:
        for j in range(size):
            line[j] = ratio * table[start + j]
    elif fresh or many > 1 or free.size:
        for j in range(size if many > 1 or free.size else uint64(TILE)):
            line[j] = ratio * table[start]
    for j in range(size if free.size else uint64(0)):
        line[j] *= free[base + j]


def share(flow):
    """How much of the value at a side is that of the cell beyond it, by the velocity into the cell; at rest half."""
    return 1.0 if flow > 0.0 else (0.5 if flow == 0.0 else 0.0)


def slope_places(a, upper, many, cells):
    """Where the numbers for a side along axis a start that cells have, and those that the cells beyond have for it."""
    return uint64((a * many + upper % many) * cells), uint64((a * many + (1 - upper) % many) * cells)


def to_differences(steep, a, by, many, cells, c, low, high, line, size):
    """What is asked of the slopes on both sides -> the cotangent of a (by = 0) or b (1), left in `steep`."""
    one = uint64((2 * a * many + by) * cells) + c
    two = uint64((2 * (a + 1) * many - 2 + by) * cells) + c  # the derivative of behind; that of ahead if it is the same
    for j in range(size):
        line[j] = steep[one + j] * high[j] - steep[two + j] * low[j]
    for j in range(size):
        steep[one + j] = line[j]


limiter = van_leer  # in the loop over slopes: stands for the function of the scheme it is compiled for
HELPERS = cells_of, place_of, piece_of, share, scale, slope_places, to_differences
USES: dict[str, Any] = {function.__name__: function for function in HELPERS}
FUSED: dict[str, Any] = {"fastmath": {"contract"}}  # a product and a sum are one instruction: the same bits everywhere

# ---- the loops -------------------------------------------------------------------------------------------------------
#
# Arguments that the loops share:
#
# u, g        flat arrays of the cells: the field, a cotangent
# inflow      flat array, one number for each place at a wall
# w           flat array, axis by axis: the velocity on the sides or in the cells
# free        flat array, for each axis and side whether those of the cells are open; empty where all are
# slopes      flat array, for each axis behind and ahead, or (many = 1) what both are; empty for the first order
# dt          the time step
# table, axes see N
# flux        1 in flux form, 0 in advective form
# start, stop which tiles


@kernel("read1 read1 read1 mask1 read1 int real read1 index2 real real read1 real write1 write1", uses=USES, **FUSED)
def stage(u, inflow, w, free, slopes, many, dt, table, axes, flux, least, u0, keep, out, wrong, start, stop):
    """out = keep u0 + (1 - keep) u', and for each tile how many weights are less than `least`, or results infinite."""
    memory = np.empty((8, LINE))
    leaves, enters = memory[0], memory[1]
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size, bad = uint64(first), uint64(length), 0
        for j in range(size):
            leaves[j] = enters[j] = 0.0
        for a in range(axes.shape[0]):
            where = place_of(axes, a, first)
            for upper in range(2):
                sign, side = 1.0 - 2.0 * upper, uint64((2 * a + upper) * u.size) + c
                factor = memory[2 + 2 * a + upper]
                scale(factor, part == start, sign * dt, table, axes, a, OWN + upper, where[0], size, free, side)
                own, theirs = slope_places(a, upper, many, u.size)
                for last in range(2):
                    b, e, i, m, q, closed, given = piece_of(axes, a, upper, last, first, length, where)
                    if b == e:
                        continue
                    shown = 1.0 - given
                    for j in range(b, e):
                        flow = factor[j] * w[m + j]  # into the cell
                        leaves[j] += max(flow, 0.0) - flux * flow
                        enters[j] += max(flow, 0.0) * (shown * u[i + j])
                    for j in range(b, e if given else b):
                        enters[j] += max(factor[j] * w[m + j], 0.0) * inflow[q + j]
                    shown = sign * (1.0 - closed)
                    for j in range(b, e if slopes.size else b):
                        flow = factor[j] * w[m + j]
                        enters[j] += shown * max(flow, 0.0) * slopes[theirs + i + j]
                        enters[j] += sign * max(-flow, 0.0) * slopes[own + c + j]
        for j in range(size):
            weight = 1.0 - leaves[j]
            new = keep * u0[c + j] + (1.0 - keep) * (weight * u[c + j] + enters[j])
            bad += (not weight >= least) + (not abs(new) < np.inf)
            out[c + j] = new
        wrong[part] = bad


@kernel(
    "read1 read1 read1 read1 mask1 read1 int real read1 index2 real write1 write1 write1 flag write1 write1",
    uses=USES,
    **FUSED,
)
def pull(g, u, inflow, w, free, slopes, many, dt, table, axes, flux, gu, ginflow, gw, fresh, steep, wrong, start, stop):
    """The cotangent of u' -> those of u with constant slopes, of the inflow (added) and of w (added or, fresh, set).

    gu, gw: empty where they are not wanted. steep: for each axis the derivatives of ahead in a and b and (many = 2)
    those of behind; the cotangents of a and b are left in the first two.
    """
    memory, rest = np.empty((16, LINE)), 1.0 - flux
    field, gain = memory[0], memory[1]
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size, bad = uint64(first), uint64(length), 0
        for j in range(size):
            field[j] = g[c + j]
        for a in range(axes.shape[0]):
            where = place_of(axes, a, first)
            for upper in range(2):
                sign, side, asked = 1.0 - 2.0 * upper, uint64((2 * a + upper) * u.size) + c, memory[2 + upper]
                # what the cells, and those beyond the side, want of a flow of 1 through it is g times these
                factor, beyond = memory[4 + 4 * a + OWN + upper], memory[4 + 4 * a + THEIRS + upper]
                scale(factor, part == start, dt, table, axes, a, OWN + upper, where[0], size, free, side)
                scale(beyond, part == start, dt, table, axes, a, THEIRS + upper, where[0], size, free, side)
                own, theirs = slope_places(a, upper, many, u.size)
                for last in range(2):
                    b, e, i, m, q, closed, given = piece_of(axes, a, upper, last, first, length, where)
                    if b == e:
                        continue
                    inner, shown = 1.0 - closed, 1.0 - given
                    shared = axes[a, ON_SIDES] * inner
                    o = m if axes[a, ON_SIDES] else uint64(axes[a, SPEED]) + i  # their velocity on the side
                    for j in range(b, e if slopes.size else b):
                        asked[j] = inner * max(-sign * w[o + j], 0.0) * (beyond[j] * g[i + j])
                        asked[j] -= max(-sign * w[m + j], 0.0) * (factor[j] * g[c + j])
                    for j in range(b, e if gu.size else b):
                        more = inner * max(-sign * w[o + j], 0.0) * (beyond[j] * g[i + j])
                        less = max(-sign * w[m + j], 0.0) + rest * sign * w[m + j]
                        field[j] += more - less * (factor[j] * g[c + j])
                    for j in range(b, e if closed and gu.size else b):
                        more = max(sign * w[m + j], 0.0) * (factor[j] * g[c + j])
                        if given:
                            ginflow[q + j] += more
                        else:
                            field[j] += more
                    if not gw.size or upper and axes[a, ON_SIDES] and not closed:
                        continue  # the velocity on an upper side is that on the lower side of the cell beyond
                    for j in range(b, e):  # the value at the side is that of the cell it comes from
                        part_of = share(sign * w[m + j])
                        value = part_of * (shown * u[i + j]) + (1.0 - part_of) * u[c + j]
                        more = shared * (beyond[j] * g[i + j]) * (value - rest * u[i + j])
                        gain[j] = sign * ((factor[j] * g[c + j]) * (value - rest * u[c + j]) - more)
                    for j in range(b, e if given else b):
                        gain[j] += sign * (factor[j] * g[c + j]) * (share(sign * w[m + j]) * inflow[q + j])
                    for j in range(b, e if slopes.size else b):
                        part_of = share(sign * w[m + j])
                        slope = inner * part_of * slopes[theirs + i + j] - (1.0 - part_of) * slopes[own + c + j]
                        gain[j] += (factor[j] * g[c + j] - shared * (beyond[j] * g[i + j])) * slope
                    empty = fresh and (axes[a, ON_SIDES] or not upper)
                    for j in range(b, e):
                        new = gain[j] if empty else gain[j] + gw[m + j]
                        gw[m + j] = new
                        bad += not abs(new) < np.inf
            for by in range(2 if steep.size else 0):
                to_differences(steep, a, by, many, u.size, c, memory[2], memory[3], gain, size)
        for j in range(size if gu.size else uint64(0)):
            gu[c + j] = field[j]
            bad += not abs(field[j]) < np.inf
        wrong[part] = bad


@kernel("read1 int mask1 index2 write1 write1 write1", uses=USES, **FUSED)
def jumps(steep, many, free, axes, gu, ginflow, wrong, start, stop):
    """The cotangents of a and b, the differences to the cells below and above, are added to those of u and inflow."""
    memory = np.empty((2, LINE))
    field, line = memory[0], memory[1]
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size, bad = uint64(first), uint64(length), 0
        for j in range(size):
            field[j] = gu[c + j]
        for a in range(axes.shape[0]):
            where = place_of(axes, a, first)
            for upper in range(2):
                sign, side = 1.0 - 2.0 * upper, uint64((2 * a + upper) * gu.size) + c
                own, theirs = slope_places(a, upper, 2 * many, gu.size)
                for last in range(2):
                    b, e, i, _, q, closed, given = piece_of(axes, a, upper, last, first, length, where)
                    for j in range(b, e):
                        line[j] = sign * (steep[own + c + j] + (1.0 - closed) * steep[theirs + i + j])
                    for j in range(b, e if free.size else b):
                        line[j] *= free[side + j]
                    for j in range(b, e if given or not closed else b):
                        field[j] += line[j]
                    for j in range(b, e if given else b):
                        ginflow[q + j] -= line[j]
        for j in range(size):
            gu[c + j] = field[j]
            bad += not abs(field[j]) < np.inf
        wrong[part] = bad


def _slopes(u, inflow, free, table, axes, many, slopes, steep, wrong, start, stop):
    """The slopes by `limiter` and, where steep is not empty, their derivatives."""
    memory, all_open = np.empty((10, LINE)), free[:0]
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size = uint64(first), uint64(length)
        for a in range(axes.shape[0]):
            where = place_of(axes, a, first)
            for upper in range(2):
                sign, line, side = 1.0 - 2.0 * upper, memory[upper], uint64((2 * a + upper) * u.size) + c
                for last in range(2):
                    b, e, i, _, q, _, given = piece_of(axes, a, upper, last, first, length, where)
                    for j in range(b, e):
                        line[j] = sign * (u[c + j] - (inflow[q + j] if given else u[i + j]))
                for j in range(size if free.size else uint64(0)):
                    line[j] *= free[side + j]
                scale(memory[2 + upper], True, 1.0, table, axes, a, DISTANCE + upper, where[0], size, all_open, side)
            for j in range(size):
                found = limiter(memory[0, j], memory[1, j], memory[2, j], memory[3, j])
                memory[5, j], memory[4, j] = found[0], found[1]
                if steep.size:
                    memory[6, j], memory[7, j], memory[8, j], memory[9, j] = found[2], found[3], found[4], found[5]
            for k in range(many):  # ahead is the last one
                place = uint64((a * many + k) * u.size) + c
                for j in range(size):
                    slopes[place + j] = memory[6 - many + k, j]
            for k in range(2 * many if steep.size else 0):
                place = uint64((2 * a * many + k) * u.size) + c
                for j in range(size):
                    steep[place + j] = memory[6 + k, j]
        wrong[part] = 0.0


def slopes_of(name, function, **options):
    """The loop over the slopes of a scheme."""
    words = "read1 read1 mask1 read1 index2 int write1 write1 write1"
    return Kernel(_slopes, words, {**USES, "limiter": function}, f"slopes_{name}", **{**FUSED, **options})


slopes = {name: slopes_of(name, scheme.limiter) for name, scheme in SCHEMES.items() if scheme.limiter is not None}
