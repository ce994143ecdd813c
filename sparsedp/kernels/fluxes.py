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

TILE = 512  # cells that are worked on at a time: what one loop leaves in a line, the next finds in the cache
LINE = TILE + 72  # of lines that start a power of 2 apart the cache keeps few
ZERO, ONE, TWO, THREE = (uint64(k * LINE) for k in range(4))  # where lines start


# Columns of `axes`, which has a row for each axis of a component: its cells; the distance of neighbours in the field;
# whether rows go along it; whether it is periodic; whether the velocity stands on sides, not in cells; whether factors
# differ in the rows of the component; where the velocity starts, and how many numbers a block of the cells along this
# axis and the later ones has beyond one a cell; where the lower and the upper wall start in the inflow, and whether
# inflow is given there; the first of its columns in `table`, and whether it has one for each place along it.
N, STRIDE, ALONG, PERIODIC, ON_SIDES, UNEVEN, SPEED, EXTRA, WALL, _, GIVEN, _, COLUMN, VARIES = range(14)

# Rows of `table`: 1 over the length for the lower and for the upper side of a cell, as the cell has it (OWN) and as the
# cell beyond has it (THEIRS); c and e (DISTANCE).
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
# The loops work on tiles: at most TILE cells of a row along the last axis. Places are unsigned numbers: nobody asks
# then whether they are negative, and the loops fill the vector units.


class Side(NamedTuple):
    """One side of the cells of a piece; all places for the first cell of the tile, unsigned."""

    beyond: Any  # where the cell on the other side is, in the field
    speed: Any  # where the velocity is
    wall: Any  # where the inflow is
    inner: float  # 0.0 where nothing but a wall is there: `beyond` is then the cell itself
    shown: float  # 0.0 where inflow is given at that wall


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


def side_of(axes, a, upper, piece, first, where):
    """What is beyond the lower or the upper side of the cells of a piece."""
    (place, block, rest), (begin, end), n, stride = where, piece, axes[a, N], axes[a, STRIDE]
    last = place + (end - 1 if upper else begin) * axes[a, ALONG] == (n - 1) * upper
    walls, step = 1 - axes[a, PERIODIC], (2 * upper - 1) * stride
    if last:
        step = 0 if walls else (1 - n) * step
    speed = axes[a, SPEED] + first + block * axes[a, EXTRA] + upper * axes[a, ON_SIDES] * (stride if walls else step)
    wall, closed = axes[a, WALL + upper] + block * stride + rest - begin, last * walls
    beyond, speed, wall = uint64(first + step), uint64(speed), uint64(wall)
    return Side(beyond, speed, wall, 1.0 - closed, 1.0 - closed * axes[a, GIVEN + upper])


def sides_of(axes, a, number, first, size, where):
    """Of a tile, the cells between the ends of a row, that at the lower (1), at the upper end (2), and their sides.

    Across rows it is one piece.
    """
    piece = 0, size
    if axes[a, ALONG]:
        start = 1 if where[0] == 0 else 0
        stop = max(size - 1, start) if where[0] + size == axes[a, N] else size
        piece = (start, stop) if number == 0 else (0, start) if number == 1 else (stop, size)
    below, above = side_of(axes, a, 0, piece, first, where), side_of(axes, a, 1, piece, first, where)
    return uint64(piece[0]), uint64(piece[1]), below, above


def weigh(lines, line, x, start, table, row, axes, a, place, free, side, b, e):
    """A line gets x times what a row of the table holds for the cells of a piece; 0 on closed sides."""
    at = uint64(axes[a, COLUMN] + axes[a, VARIES] * place)
    if axes[a, ALONG] * axes[a, VARIES]:
        for j in range(b, e):
            lines[line + j] = x[start + j] * table[row, at + j]
    else:
        for j in range(b, e):
            lines[line + j] = x[start + j] * table[row, at]
    for j in range(b, e if free.size else b):
        lines[line + j] *= free[side + j]


def share(flow):
    """How much of the value at a side is that of the cell beyond it, by the velocity into the cell; at rest half."""
    return 0.5 * (flow > 0.0) + 0.5 * (flow >= 0.0)


def slope_places(a, upper, many, cells):
    """Where the numbers for a side along axis a start that cells have, and those that the cells beyond have for it."""
    return uint64((a * many + upper % many) * cells), uint64((a * many + (1 - upper) % many) * cells)


def flow_to_speed(gain, w, m, sign, g, x, y, ratio, back, u, c, inflow, slopes, places, rest, side, b, e):
    """What is wanted of the velocity on a side; x, y: where g stands as the cells and as those beyond it have it."""
    i, _, wall, inner, shown = side
    for j in range(b, e):  # the value at the side is that of the cell it comes from
        part = share(sign * w[m + j])
        value = part * (shown * u[i + j]) + (1.0 - part) * u[c + j]
        gain[j] = ratio * g[x + j] * (value - rest * u[c + j]) - back * g[y + j] * (value - rest * u[i + j])
    for j in range(b, b if shown else e):
        gain[j] += ratio * g[x + j] * (share(sign * w[m + j]) * inflow[wall + j])
    for j in range(b, e if slopes.size else b):
        part = inner * share(sign * w[m + j]) * slopes[places[1] + i + j]
        slope = part - (1.0 - share(sign * w[m + j])) * slopes[places[0] + c + j]
        gain[j] += sign * (ratio * g[x + j] - back * g[y + j]) * slope


def to_differences(steep, a, by, many, cells, c, asked, line, size):
    """What is asked of the slopes on both sides -> the cotangent of a (by = 0) or b (1), left in `steep`."""
    one = uint64((2 * a * many + by) * cells) + c
    two = uint64((2 * (a + 1) * many - 2 + by) * cells) + c  # the derivative of behind; that of ahead if it is the same
    for j in range(size):
        line[j] = steep[one + j] * asked[1, j] - steep[two + j] * asked[0, j]
    for j in range(size):
        steep[one + j] = line[j]


limiter = van_leer  # in the loop over slopes: stands for the function of the scheme it is compiled for
HELPERS = cells_of, place_of, side_of, sides_of, weigh, share, slope_places, flow_to_speed, to_differences
USES: dict[str, Any] = {function.__name__: function for function in HELPERS}
# A product and a sum are one instruction: the same bits everywhere. What is called is put where it is called.
OPTIONS: dict[str, Any] = {"fastmath": {"contract"}, "forceinline": True}

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


@kernel("read1 read1 read1 mask1 read1 int real read2 index2 real real read1 real write1 write1", uses=USES, **OPTIONS)
def stage(u, inflow, w, free, slopes, many, dt, table, axes, flux, least, u0, keep, out, wrong, start, stop):
    """out = keep u0 + (1 - keep) u', and for each tile how many weights are less than `least`, or results infinite."""
    memory, lines, uneven = np.empty((2, LINE)), np.empty(2 * LINE), axes[0, UNEVEN]
    leaves, enters, speed = memory[0], memory[1], lines if uneven else w
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size, bad = uint64(first), uint64(length), 0
        for j in range(size):
            leaves[j] = 0.0
            enters[j] = 0.0
        for a in range(axes.shape[0]):
            where = place_of(axes, a, first)
            ratio = dt if uneven else dt * table[OWN, axes[a, COLUMN]]
            for number in range(3 if axes[a, ALONG] else 1):
                b, e, below, above = sides_of(axes, a, number, first, length, where)
                if b == e:
                    continue
                i, k, m, h = below.beyond, above.beyond, below.speed, above.speed
                if uneven:
                    lower, upper = uint64(2 * a * u.size) + c, uint64((2 * a + 1) * u.size) + c
                    weigh(lines, ZERO, w, m, table, OWN, axes, a, where[0], free, lower, b, e)
                    weigh(lines, ONE, w, h, table, OWN + 1, axes, a, where[0], free, upper, b, e)
                    m, h = ZERO, ONE
                for j in range(b, e):
                    low, high = ratio * speed[m + j], -ratio * speed[h + j]  # into the cells
                    leaves[j] += max(low, 0.0) + max(high, 0.0) - flux * (low + high)
                    enters[j] += max(low, 0.0) * (below.shown * u[i + j]) + max(high, 0.0) * (above.shown * u[k + j])
                for upper in range(2 if slopes.size or below.shown * above.shown == 0.0 else 0):  # type: ignore[assignment]
                    (i, _, wall, inner, shown), m, sign = (above, h, -1.0) if upper else (below, m, 1.0)
                    own, theirs = slope_places(a, upper, many, u.size)
                    for j in range(b, b if shown else e):
                        enters[j] += max(sign * ratio * speed[m + j], 0.0) * inflow[wall + j]
                    for j in range(b, e if slopes.size else b):
                        into = inner * max(sign * speed[m + j], 0.0) * slopes[theirs + i + j]
                        enters[j] += sign * ratio * (into + max(-sign * speed[m + j], 0.0) * slopes[own + c + j])
        for j in range(size):
            weight = 1.0 - leaves[j]
            new = keep * u0[c + j] + (1.0 - keep) * (weight * u[c + j] + enters[j])
            bad += (not weight >= least) + (not abs(new) < np.inf)
            out[c + j] = new
        wrong[part] = bad


@kernel(
    "read1 read1 read1 read1 mask1 read1 int real read2 index2 real write1 write1 write1 flag write1 write1",
    uses=USES,
    **OPTIONS,
)
def pull(g, u, inflow, w, free, slopes, many, dt, table, axes, flux, gu, ginflow, gw, fresh, steep, wrong, start, stop):
    """The cotangent of u' -> those of u with constant slopes, of the inflow (added) and of w (added or, fresh, set).

    gu, gw: empty where they are not wanted. steep: for each axis the derivatives of ahead in a and b and (many = 2)
    those of behind; the cotangents of a and b are left in the first two.
    """
    memory, lines, uneven = np.empty((4, LINE)), np.empty(4 * LINE), axes[0, UNEVEN]
    field, gain, asked, given = memory[0], memory[1], memory[2:], lines if uneven else g
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size, bad = uint64(first), uint64(length), 0
        for j in range(size):
            field[j] = g[c + j]
        for a in range(axes.shape[0]):
            where, sides = place_of(axes, a, first), axes[a, ON_SIDES]
            ratio = dt if uneven else dt * table[OWN, axes[a, COLUMN]]
            for number in range(3 if axes[a, ALONG] else 1):
                b, e, below, above = sides_of(axes, a, number, first, length, where)
                if b == e:
                    continue
                m, h, cells = below.speed, above.speed, uint64(axes[a, SPEED])
                o, far = (m, h) if sides else (cells + below.beyond, cells + above.beyond)
                # where the cells, those below and those above have what they want of a flow of 1
                x, y, i, k = c, c, below.beyond, above.beyond
                if uneven:
                    for row in range(4):
                        line, begin = uint64(row * LINE), (x if row < 2 else i if row == 2 else k)
                        side = uint64((2 * a + row % 2) * u.size) + c
                        weigh(lines, line, g, begin, table, OWN + row, axes, a, where[0], free, side, b, e)
                    x, y, i, k = ZERO, ONE, TWO, THREE
                for j in range(b, e if gu.size else b):
                    more = below.inner * max(-w[o + j], 0.0) * given[i + j]
                    more += above.inner * max(w[far + j], 0.0) * given[k + j]
                    less = (max(w[m + j], 0.0) - flux * w[m + j]) * given[x + j]
                    field[j] += ratio * (more - less - (max(-w[h + j], 0.0) + flux * w[h + j]) * given[y + j])
                closed = below.inner * above.inner == 0.0
                for upper in range(2 if slopes.size or closed or gw.size and not sides else gw.size > 0):
                    one, m, o, x, i, sign = (above, h, far, y, k, -1.0) if upper else (below, m, o, x, i, 1.0)
                    for j in range(b, b if one.inner or not gu.size else e):
                        more = ratio * max(sign * w[m + j], 0.0) * given[x + j]
                        if one.shown:
                            field[j] += more
                        else:
                            ginflow[one.wall + j] += more
                    for j in range(b, e if slopes.size else b):
                        more = one.inner * max(-sign * w[o + j], 0.0) * given[i + j]
                        asked[upper, j] = ratio * (more - max(-sign * w[m + j], 0.0) * given[x + j])
                    if not gw.size or upper and sides and one.inner:
                        continue  # the velocity on an upper side is that on the lower side of the cell beyond
                    values, places = (u, c, inflow, slopes), slope_places(a, upper, many, u.size)
                    ratios = sign * ratio, sign * ratio * sides * one.inner
                    flow_to_speed(gain, w, m, sign, given, x, i, *ratios, *values, places, 1.0 - flux, one, b, e)
                    empty = fresh and (sides or not upper)
                    for j in range(b, b if empty else e):
                        gain[j] += gw[m + j]
                    for j in range(b, e):
                        gw[m + j] = gain[j]
                        bad += not abs(gain[j]) < np.inf
            for by in range(2 if steep.size else 0):
                to_differences(steep, a, by, many, u.size, c, asked, gain, size)
        for j in range(size if gu.size else uint64(0)):
            gu[c + j] = field[j]
            bad += not abs(field[j]) < np.inf
        wrong[part] = bad


@kernel("read1 int mask1 index2 write1 write1 write1", uses=USES, **OPTIONS)
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
            for number in range(6 if axes[a, ALONG] else 2):
                b, e, below, above = sides_of(axes, a, number // 2, first, length, where)
                upper, sign = number % 2, 1.0 - 2.0 * (number % 2)
                i, _, wall, inner, shown = above if upper else below
                own, theirs = slope_places(a, upper, 2 * many, gu.size)
                side = uint64((2 * a + upper) * gu.size) + c
                for j in range(b, e):
                    line[j] = sign * (steep[own + c + j] + inner * steep[theirs + i + j])
                for j in range(b, e if free.size else b):
                    line[j] *= free[side + j]
                for j in range(b, e if inner or not shown else b):
                    field[j] += line[j]
                for j in range(b, b if shown else e):
                    ginflow[wall + j] -= line[j]
        for j in range(size):
            gu[c + j] = field[j]
            bad += not abs(field[j]) < np.inf
        wrong[part] = bad


def _slopes(u, inflow, free, table, axes, many, slopes, steep, wrong, start, stop):
    """The slopes by `limiter` and, where steep is not empty, their derivatives."""
    memory, lines, all_open = np.empty((8, LINE)), np.ones(3 * LINE), free[:0]
    for part in range(start, stop):
        first, length = cells_of(axes, part)
        c, size = uint64(first), uint64(length)
        for a in range(axes.shape[0]):
            where = place_of(axes, a, first)
            for number in range(6 if axes[a, ALONG] else 2):
                b, e, below, above = sides_of(axes, a, number // 2, first, length, where)
                upper, sign = number % 2, 1.0 - 2.0 * (number % 2)
                i, _, wall, _, shown = above if upper else below
                side, line, row = uint64((2 * a + upper) * u.size) + c, memory[upper], DISTANCE + upper
                for j in range(b, e):
                    line[j] = sign * (u[c + j] - (u[i + j] if shown else inflow[wall + j]))
                for j in range(b, e if free.size else b):
                    line[j] *= free[side + j]
                weigh(lines, uint64(upper * LINE), lines, TWO, table, row, axes, a, where[0], all_open, side, b, e)
            for j in range(size if steep.size else uint64(0)):
                found = limiter(memory[0, j], memory[1, j], lines[j], lines[ONE + j])
                memory[3, j], memory[2, j] = found[0], found[1]
                memory[4, j], memory[5, j], memory[6, j], memory[7, j] = found[2], found[3], found[4], found[5]
            for j in range(uint64(0) if steep.size else size):
                memory[3, j], memory[2, j] = limiter(memory[0, j], memory[1, j], lines[j], lines[ONE + j])[:2]
            for k in range(many):  # ahead is the last one
                place = uint64((a * many + k) * u.size) + c
                for j in range(size):
                    slopes[place + j] = memory[4 - many + k, j]
            for k in range(2 * many if steep.size else 0):
                place = uint64((2 * a * many + k) * u.size) + c
                for j in range(size):
                    steep[place + j] = memory[4 + k, j]
        wrong[part] = 0.0


def slopes_of(name, function, **options):
    """The loop over the slopes of a scheme."""
    words = "read1 read1 mask1 read2 index2 int write1 write1 write1"
    return Kernel(_slopes, words, {**USES, "limiter": function}, f"slopes_{name}", **{**OPTIONS, **options})


slopes = {name: slopes_of(name, scheme.limiter) for name, scheme in SCHEMES.items() if scheme.limiter is not None}
