"""Upwind fluxes: a stage of an Eulerian transport scheme along all axes, its pullback, and the limiters.

A component of the field is one flat array with up to three axes. The loops go through it row by row along its last
axis, at most TILE cells at a time, and look at a row as three pieces along it: the cell at the lower end, what is
between, the cell at the upper end (across it a row is one piece). All cells of a piece find what is beyond their sides
the same number of places away: round the end of a periodic axis, and at a wall the cell itself stands for the ghost
cell, which a share of 0 takes away where inflow is given. So one inner loop serves all boundaries and dimensions. Where
lengths differ or sides are closed the velocity, or the cotangent, is first multiplied into lines, with 0 on closed
sides. With Courant numbers C on the lower and upper side of a cell,
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
from numpy import int64, uint64

from sparsedp.kernels.team import Kernel, kernel

__all__ = [
    "SCHEMES",
    "TILE",
    "Scheme",
    "jumps",
    "vjp",
    "slopes",
    "slopes_of",
    "stage",
]

TILE = 512  # cells that are worked on at a time: what one loop leaves in a line, the next finds in the cache
LINE = TILE + 72  # of lines that start a power of 2 apart the cache keeps few
NONE, ONE, TWO, THREE = (uint64(k * LINE) for k in range(4))  # where lines start


# Columns of `axes`, which has a row for each axis of a component: its cells; the distance of neighbours in the field;
# whether the velocity stands on sides, not in cells; where it starts, and how many numbers a block of the cells along
# this axis and the later ones has beyond one a cell; where the lower and the upper wall start in the inflow, or ITSELF
# or ROUND; the first of its columns in `table`, and whether it has one for each place along it; whether factors differ
# in the rows of the component.
N, STRIDE, ON_SIDES, SPEED, EXTRA, WALL, _, COLUMN, VARIES, UNEVEN = range(10)
ITSELF, ROUND = -1, -2  # beyond the end of an axis is the value of the cell itself; the other end

# Rows of `table`: 1 over the length for the lower and for the upper side of a cell, as the cell has it (OWN) and as the
# cell beyond has it (THEIRS); c and e (DISTANCE).
OWN, THEIRS, DISTANCE = int64(0), int64(2), int64(4)  # one type: `weigh` is compiled once


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
# The loops work on tiles: at most TILE cells of a row along the last axis. Places are unsigned numbers: nobody asks
# then whether they are negative, and the loops fill the vector units.


class Side(NamedTuple):
    """One side of the cells of a piece; all places for the first cell of the tile, unsigned."""

    begin: Any  # the cells of the tile from here
    end: Any  # to here
    beyond: Any  # where the cell on the other side is, in the field
    speed: Any  # where the velocity is
    wall: Any  # where the inflow is
    column: Any  # of the table
    inner: float  # 0.0 where nothing but a wall is there: `beyond` is then the cell itself
    shown: float  # 0.0 where inflow is given at that wall


def tile_of(axes, part):
    """Of a tile the row, the first cell, and how many there are; these two as unsigned numbers once more."""
    length = axes[-1, N]
    tiles = -(-length // TILE)
    row, left = part // tiles, part % tiles * TILE
    first, size = row * length + left, min(length - left, TILE)
    return row, first, size, uint64(first), uint64(size)


def side_of(axes, a, number, upper, tile):
    """The lower or the upper side of the cells of a tile.

    Those of the last axis are three pieces: between the ends of a row (0), the lower (1), the upper end (2).
    """
    n, stride, wall, (block, first, size, _, _) = axes[a, N], axes[a, STRIDE], axes[a, WALL + upper], tile
    through = first
    if a < len(axes) - 1:  # divisions take most of the time here
        through = first // stride
        block = through // n
    place, begin, end = through - block * n, 0, size
    at_end = place == (n - 1) * upper
    if a == len(axes) - 1:
        start = 1 if place == 0 else 0
        stop = max(size - 1, start) if place + size == n else size
        begin = 0 if number == 1 else stop if number == 2 else start
        end = start if number == 1 else size if number == 2 else stop
        at_end = number == 1 + upper or number * n == 1
    walls, step = wall != ROUND, (2 * upper - 1) * stride
    closed = at_end and walls
    if at_end:
        step *= 0 if walls else 1 - n
    speed = axes[a, SPEED] + first + block * axes[a, EXTRA] + upper * axes[a, ON_SIDES] * (stride if walls else step)
    where = wall + (block - through) * stride + first - begin
    column, shown = axes[a, COLUMN] + axes[a, VARIES] * place, 1.0 - (closed and wall >= 0)
    low, high, beyond = uint64(begin), uint64(end), uint64(first + step)
    return Side(low, high, beyond, uint64(speed), uint64(where), uint64(column), 1.0 - closed, shown)


def share(flow):
    """How much of the value at a side is that of the cell beyond it, by the velocity into the cell; at rest half."""
    return 0.5 * (flow > 0.0) + 0.5 * (flow >= 0.0)


def weigh(lines, line, x, start, table, row, axes, a, side, free, c):
    """A line gets x times what a row of the table holds for the cells of a piece; 0 on closed sides."""
    b, e, at = side.begin, side.end, side.column
    if a == len(axes) - 1 and axes[a, VARIES]:
        for j in range(b, e):
            lines[line + j] = x[start + j] * table[row, at + j]
    else:
        for j in range(b, e):
            lines[line + j] = x[start + j] * table[row, at]
    for j in range(b, e if free.size else b):
        lines[line + j] *= free[2 * a + row % 2, c + j]


def to_velocity(w, gw, fresh, u, inflow, slopes, given, ratio, flux, a, on_sides, c, sides, places):
    """The cotangent of w for the sides of a piece; `given` holds that of the cells and of those beyond, at `places`.

    The value at a side is that of the cell it comes from, at rest the mean. Returns how many of them are not finite.
    """
    (below, above), rest, many, bad = sides, 1.0 - flux, slopes.shape[1], 0
    m, q = below.speed, above.beyond
    for j in range(below.begin, below.begin if on_sides else below.end):  # in a cell w is that of both its sides
        near = share(w[m + j])
        low = (below.shown * u[below.beyond + j] - u[c + j]) * given[places[0] + j]
        high = (above.shown * u[q + j] - u[c + j]) * given[places[1] + j]
        total = ratio * (near * low - (1.0 - near) * high)
        total = total if fresh else total + gw[m + j]
        bad += not abs(total) < np.inf
        gw[m + j] = total
    for upper in range(2):
        (b, e, z, m, wall, _, inner, shown), x, i = sides[upper], places[upper], places[2 + upper]
        if upper and on_sides and inner:
            continue  # the velocity on an upper side is that on the lower side of the cell beyond
        sign, back = 1.0 - 2.0 * upper, on_sides * inner
        for j in range(b, e if on_sides else b):
            near = share(sign * w[m + j])
            value = near * (shown * u[z + j]) + (1.0 - near) * u[c + j]
            mine, theirs = value - rest * u[c + j], value - rest * u[z + j]
            total = sign * ratio * (mine * given[x + j] - back * given[i + j] * theirs)
            total = total if fresh else total + gw[m + j]
            bad += not abs(total) < np.inf
            gw[m + j] = total
        for j in range(b, b if shown else e):
            gw[m + j] += sign * ratio * given[x + j] * (share(sign * w[m + j]) * inflow[wall + j])
            bad += not abs(gw[m + j]) < np.inf
        for j in range(b, e if slopes.size else b):
            near = share(sign * w[m + j])
            slope = near * inner * slopes[a, (1 - upper) % many, z + j] - (1.0 - near) * slopes[a, upper % many, c + j]
            gw[m + j] += ratio * (given[x + j] - back * given[i + j]) * slope
            bad += not abs(gw[m + j]) < np.inf
    return bad


limiter = van_leer  # in the loop over slopes: stands for the function of the scheme it is compiled for
# A product and a sum are one instruction: the same bits everywhere.
OPTIONS: dict[str, Any] = {
    "uses": (tile_of, side_of, weigh, share, to_velocity),
    "fastmath": {"contract"},
}

# ---- the loops -------------------------------------------------------------------------------------------------------
#
# Arguments that the loops share:
#
# u, g        flat arrays of the cells: the field, a cotangent
# inflow      flat array, one number for each place at a wall
# w           flat array, axis by axis: the velocity on the sides or in the cells
# free        for each side (lower, upper, axis by axis) whether those of the cells are open; no cells where all are
# slopes      for each axis behind and ahead, or (many = 1) what both are; no cells for the first order
# partials       for each of the slopes its derivatives in a and b
# dt          the time step
# table, axes see N
# flux        1 in flux form, 0 in advective form
# start, stop which tiles


@kernel("read1 read1 read1 mask2 read3 real read2 index2 real real read1 real write1 write1", **OPTIONS)
def stage(u, inflow, w, free, slopes, dt, table, axes, flux, least, u0, keep, out, wrong, start, stop):
    """out = keep u0 + (1 - keep) u', and for each tile how many weights are less than `least`, or results infinite."""
    memory, lines, uneven, many = np.empty((2, LINE)), np.empty(2 * LINE), axes[0, UNEVEN], slopes.shape[1]
    leaves, enters, speed = memory[0], memory[1], lines if uneven else w
    for part in range(start, stop):
        tile = _, _, _, c, size = tile_of(axes, part)
        bad = 0
        for j in range(size):
            leaves[j] = 0.0
            enters[j] = 0.0
        for a in range(len(axes)):
            ratio = dt if uneven else dt * table[OWN, axes[a, COLUMN]]
            for number in range(3 if a == len(axes) - 1 else 1):
                below = side_of(axes, a, number, int64(0), tile)  # of one type: compiled once
                above = side_of(axes, a, number, int64(1), tile)
                b, e, i, k, m, h = below.begin, below.end, below.beyond, above.beyond, below.speed, above.speed
                if b == e:
                    continue
                if uneven:
                    weigh(lines, NONE, w, m, table, OWN, axes, a, below, free, c)
                    weigh(lines, ONE, w, h, table, OWN + 1, axes, a, above, free, c)
                    m, h = NONE, ONE
                for j in range(b, e):
                    low, high = ratio * speed[m + j], -ratio * speed[h + j]  # into the cells
                    leaves[j] += max(low, 0.0) + max(high, 0.0) - flux * (low + high)
                    enters[j] += max(low, 0.0) * (below.shown * u[i + j]) + max(high, 0.0) * (above.shown * u[k + j])
                for upper in range(2 if slopes.size or below.shown * above.shown == 0.0 else 0):
                    (_, _, i, _, wall, _, inner, shown), m, sign = (above, h, -ratio) if upper else (below, m, ratio)
                    for j in range(b, b if shown else e):
                        enters[j] += max(sign * speed[m + j], 0.0) * inflow[wall + j]
                    for j in range(b, e if slopes.size else b):
                        into, own = sign * speed[m + j], slopes[a, upper % many, c + j]
                        theirs = inner * slopes[a, (1 - upper) % many, i + j]
                        enters[j] += (1.0 - 2.0 * upper) * (max(into, 0.0) * theirs + max(-into, 0.0) * own)
        for j in range(size):
            weight = 1.0 - leaves[j]
            new = keep * u0[c + j] + (1.0 - keep) * (weight * u[c + j] + enters[j])
            bad += (not weight >= least) + (not abs(new) < np.inf)
            out[c + j] = new
        wrong[part] = bad


@kernel(
    "read1 read1 read1 read1 mask2 read3 real read2 index2 real write1 write1 write1 flag write4 write1",
    **OPTIONS,
)
def vjp(g, u, inflow, w, free, slopes, dt, table, axes, flux, gu, ginflow, gw, fresh, partials, wrong, start, stop):
    """The cotangent of u' -> those of u with constant slopes, of the inflow (added) and of w (added or, fresh, set).

    wrong: for each tile how many of u and w are not finite. gu, gw: empty where they are not wanted. The cotangents of
    a and b are left in the last slopes of `partials`.
    """
    memory, lines, uneven = np.empty((3, LINE)), np.empty(4 * LINE), axes[0, UNEVEN]
    field, asked, given, many = memory[0], memory[1:], lines if uneven else g, slopes.shape[1]
    for part in range(start, stop):
        tile = _, _, _, c, size = tile_of(axes, part)
        bad = 0
        for j in range(size):
            field[j] = g[c + j]
        for a in range(len(axes)):
            on_sides, cells = axes[a, ON_SIDES], uint64(axes[a, SPEED])
            ratio = dt if uneven else dt * table[OWN, axes[a, COLUMN]]
            for number in range(3 if a == len(axes) - 1 else 1):
                below = side_of(axes, a, number, int64(0), tile)
                above = side_of(axes, a, number, int64(1), tile)
                b, e, m, h, sides = below.begin, below.end, below.speed, above.speed, (below, above)
                if b == e:
                    continue
                x, y, i, k = c, c, below.beyond, above.beyond  # what cells and those beyond want of a flow of 1
                o, p = (m, h) if on_sides else (cells + i, cells + k)
                if uneven:
                    weigh(lines, NONE, g, c, table, OWN, axes, a, below, free, c)
                    weigh(lines, ONE, g, c, table, OWN + 1, axes, a, above, free, c)
                    weigh(lines, TWO, g, i, table, THEIRS, axes, a, below, free, c)
                    weigh(lines, THREE, g, k, table, THEIRS + 1, axes, a, above, free, c)
                    x, y, i, k = NONE, ONE, TWO, THREE
                places = x, y, i, k
                for j in range(b, e if gu.size else b):
                    low, high = ratio * w[m + j], -ratio * w[h + j]  # into the cells
                    more = below.inner * max(-ratio * w[o + j], 0.0) * given[i + j]
                    more += above.inner * max(ratio * w[p + j], 0.0) * given[k + j]
                    less = (max(low, 0.0) - flux * low) * given[x + j] + (max(high, 0.0) - flux * high) * given[y + j]
                    field[j] += more - less
                for upper in range(2):
                    (_, _, _, m, wall, _, inner, shown), sign = (above, -1.0) if upper else (below, 1.0)
                    x, i, o, into = (y, k, p, -ratio) if upper else (x, i, o, ratio)
                    target, at = (field, NONE) if shown else (ginflow, wall)
                    for j in range(b, b if inner or not gu.size else e):
                        target[at + j] += max(into * w[m + j], 0.0) * given[x + j]
                    for j in range(b, e if partials.size else b):
                        more = inner * max(-into * w[o + j], 0.0) * given[i + j]
                        asked[upper, j] = sign * (max(-into * w[m + j], 0.0) * given[x + j] - more)
                if gw.size:
                    bad += to_velocity(
                        w, gw, fresh, u, inflow, slopes, given, ratio, flux, a, on_sides, c, sides, places
                    )
            for by in range(2 if partials.size else 0):  # what is asked of behind and ahead -> cotangents of a and b
                for j in range(size):
                    total = partials[a, 0, by, c + j] * asked[0, j]
                    partials[a, many - 1, by, c + j] = total + partials[a, many - 1, by, c + j] * asked[1, j]
        for j in range(size if gu.size else NONE):
            bad += not abs(field[j]) < np.inf
            gu[c + j] = field[j]
        wrong[part] = bad


@kernel("read4 mask2 index2 write1 write1", **OPTIONS)
def jumps(partials, free, axes, gu, ginflow, start, stop):
    """The cotangents of a and b, the differences to the cells below and above, are added to those of u and inflow."""
    line, last = np.empty(LINE), partials.shape[1] - 1
    for part in range(start, stop):
        tile = _, _, _, c, _ = tile_of(axes, part)
        for a in range(len(axes)):
            for number in range(6 if a == len(axes) - 1 else 2):
                upper, sign = number % 2, 1.0 - 2.0 * (number % 2)
                b, e, i, _, wall, _, inner, shown = side_of(axes, a, number // 2, upper, tile)
                if shown and not inner:
                    continue  # the difference to a ghost cell that repeats the cell is 0
                for j in range(b, e):
                    line[j] = sign * (partials[a, last, upper, c + j] + inner * partials[a, last, 1 - upper, i + j])
                for j in range(b, e if free.size else b):
                    line[j] *= free[2 * a + upper, c + j]
                for j in range(b, e):
                    gu[c + j] += line[j]
                for j in range(b, b if shown else e):
                    ginflow[wall + j] -= line[j]


def _slopes(u, inflow, free, table, axes, slopes, partials, start, stop):
    """The slopes by `limiter` and, where partials is not empty, their derivatives."""
    memory, found, lines = np.empty((2, LINE)), np.empty((6, LINE)), np.ones(3 * LINE)
    many, every = slopes.shape[1], free[:, :0]
    for part in range(start, stop):
        tile = _, _, _, c, size = tile_of(axes, part)
        for a in range(len(axes)):
            for number in range(6 if a == len(axes) - 1 else 2):
                upper, sign = number % 2, 1.0 - 2.0 * (number % 2)
                side = side_of(axes, a, number // 2, upper, tile)
                b, e, i, _, wall, _, _, shown = side
                for j in range(b, e):
                    memory[upper, j] = sign * (u[c + j] - (u[i + j] if shown else inflow[wall + j]))
                for j in range(b, e if free.size else b):
                    memory[upper, j] *= free[2 * a + upper, c + j]
                weigh(lines, uint64(upper * LINE), lines, TWO, table, DISTANCE + upper, axes, a, side, every, c)
            for j in range(size if partials.size else NONE):
                results = limiter(memory[0, j], memory[1, j], lines[j], lines[ONE + j])
                found[1, j], found[0, j], found[4, j], found[5, j], found[2, j], found[3, j] = results
            for j in range(NONE if partials.size else size):
                found[1, j], found[0, j] = limiter(memory[0, j], memory[1, j], lines[j], lines[ONE + j])[:2]
            for k in range(2 - many, 2):  # behind, ahead
                for j in range(size):
                    slopes[a, k % many, c + j] = found[k, j]
                for j in range(size if partials.size else NONE):
                    partials[a, k % many, 0, c + j] = found[2 + 2 * k, j]
                    partials[a, k % many, 1, c + j] = found[3 + 2 * k, j]


def slopes_of(name, function, **options):
    """The loop over the slopes of a scheme."""
    words = "read1 read1 mask2 read2 index2 write3 write4"
    return Kernel(_slopes, words, given={"limiter": function}, name=f"slopes_{name}", **{**OPTIONS, **options})


slopes = {name: slopes_of(name, scheme.limiter) for name, scheme in SCHEMES.items() if scheme.limiter is not None}
