"""Upwind fluxes: a stage of an Eulerian transport scheme along all axes, its pullback, and the limiters.

A component of the field is one flat array with up to three axes. The loops go through it row by row along its last
axis, at most TILE cells at a time, and look at a row as three pieces along each axis: the cell at the lower end, what
is between, the cell at the upper end (across an axis a row is one piece). All cells of a piece find their neighbours
the same number of places away: round the end of a periodic axis, and at a wall the cell itself stands for the ghost
cell, which a share of 0 takes away where inflow is given. So one inner loop serves all boundaries and dimensions.
Obstacles are in the velocity: it is 0 on a side that is closed. With Courant numbers C on the lower and upper side of
a cell, p = max(C, 0), m = min(C, 0),

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
    "COLUMNS",
    "SCHEMES",
    "TILE",
    "Scheme",
    "jumps",
    "pull_field",
    "pull_slopes",
    "pull_velocity",
    "slopes",
    "slopes_of",
    "stage",
]

TILE = 1024  # cells that are worked on at a time: what one loop leaves in a line, the next finds in the cache
# Lines are rows of one array, a little longer than a tile: of lines that start a power of 2 apart the cache keeps few.
SECOND, THIRD, FOURTH = (np.uint64(k * (TILE + 72)) for k in (1, 2, 3))
LINES = 4 * (TILE + 72)

# Columns of `axes`, which has a row for each axis of a component: its cells, the numbers that the velocity has along it
# (n, or n + 1 with walls), the distance of neighbours in the field, whether it is the last one, whether it is periodic;
# where its velocity starts, its lower and its upper wall in the inflow; whether inflow is given there.
COLUMNS = 10
N, COUNT, STRIDE, LAST, PERIODIC, SPEED, WALL, OTHER_WALL, GIVEN, OTHER_GIVEN = range(COLUMNS)


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


# ---- the loops -------------------------------------------------------------------------------------------------------
#
# Places are unsigned numbers: nobody asks then whether they are negative, and the loops fill the vector units.
# Arguments that the loops share:
#
# u, g           flat arrays of the cells: the field, a cotangent
# inflow         flat array, one number for each place at a wall
# low, high      flat arrays, axis by axis: the velocity on the lower and on the upper side of the cells. With lift = 1
#                they are one array, on all sides; with lift = 0 each has one number for a cell
# ahead, behind  flat arrays, axis by axis one number for a cell: see above; empty for a scheme of first order
# ratios         dt over length, for each axis
# axes           see COLUMNS
# flux           1 in flux form, 0 in advective form
# start, stop    which parts of rows


def reach(axis, lift, first, size, number):
    """Where the cells of piece 0, 1 or 2 of the row from `first` find what is beside them; `axis` as in COLUMNS.

    Returns the first cell of the piece and its end; the places, counted from the start of the row, of the cells below
    and above and of the lower and upper side in the velocity; the place in a wall; whether these walls are there.
    """
    n, count, stride, last, periodic, speed = axis
    through = first // stride
    block = through // n
    place, rest = through - block * n, first - through * stride
    begin, end = 0, (size if number == 1 else 0)
    if last:
        low = 1 if place == 0 else 0
        high = max(size - 1, low) if place + size == n else size
        begin, end = (0, low) if number == 0 else (low, high) if number == 1 else (high, size)
    at_low, at_high, around = place + begin == 0, place + (end if last else 1) == n, (n - 1) * stride * periodic
    under, over = first + (around if at_low else -stride), first + (-around if at_high else stride)
    side = speed + (block * count + place) * stride + rest
    beyond = side + lift * (-around if at_high and periodic else stride)
    wall, walls = block * stride + rest - begin, not periodic
    places = uint64(begin), uint64(end), uint64(under), uint64(over), uint64(side), uint64(beyond)
    return places, wall, at_low and walls, at_high and walls


def cells_of(axes, part):
    """The first cell of a part of a row, and how many there are."""
    length = axes[-1, N]
    tiles = -(-length // TILE)
    left = part % tiles * TILE
    return part // tiles * length + left, min(length - left, TILE)


def share(number):
    """How much of the value at a side is that of the cell below, by the velocity there; at rest half."""
    return 1.0 if number > 0.0 else (0.5 if number == 0.0 else 0.0)


def between(number, below, above):
    """The value at a side: that of the cell the velocity there comes from; at rest the mean."""
    return below if number > 0.0 else (above if number < 0.0 else 0.5 * (below + above))


def along(axes, a):
    return axes[a, N], axes[a, COUNT], axes[a, STRIDE], axes[a, LAST], axes[a, PERIODIC], axes[a, SPEED]


USES = {"cells_of": cells_of, "reach": reach, "share": share, "between": between, "along": along}
limiter = van_leer  # in the loop over slopes: stands for the function of the scheme it is compiled for
FUSED: dict[str, Any] = {"fastmath": {"contract"}}  # a product and a sum are one instruction: the same bits everywhere


@kernel("read1 read1 read1 read1 read1 read1 read1 index2 int real real read1 real write1 write1", uses=USES, **FUSED)
def stage(u, inflow, low, high, ahead, behind, ratios, axes, lift, flux, least, u0, keep, out, wrong, start, stop):
    """out = keep u0 + (1 - keep) u', and for each part how many weights are less than `least`, or results infinite."""
    line = np.empty(LINES)
    for part in range(start, stop):
        first, size = cells_of(axes, part)
        c, cells, bad = uint64(first), uint64(size), 0
        for j in range(cells):
            line[j] = 0.0  # what leaves
            line[SECOND + j] = 0.0  # what enters
        for a in range(axes.shape[0]):
            axis, ratio = along(axes, a), ratios[a]
            for number in range(3):
                (b, e, i, k, m, h), wall, low_wall, high_wall = reach(axis, lift, first, size, number)
                given, given_above = low_wall and axes[a, GIVEN], high_wall and axes[a, OTHER_GIVEN]
                if given or given_above:
                    place, place_above = uint64(axes[a, WALL] + wall), uint64(axes[a, OTHER_WALL] + wall)
                    for j in range(b, e):
                        below = inflow[place + j] if given else u[i + j]
                        above = inflow[place_above + j] if given_above else u[k + j]
                        p, q = max(ratio * low[m + j], 0.0), min(ratio * high[h + j], 0.0)
                        line[j] += p - q + flux * (ratio * high[h + j] - ratio * low[m + j])
                        line[SECOND + j] += p * below - q * above
                else:
                    for j in range(b, e):
                        p, q = max(ratio * low[m + j], 0.0), min(ratio * high[h + j], 0.0)
                        line[j] += p - q + flux * (ratio * high[h + j] - ratio * low[m + j])
                        line[SECOND + j] += p * u[i + j] - q * u[k + j]
                if ahead.size:
                    s = uint64(a * u.size)
                    below, above = 0.0 if low_wall else 1.0, 0.0 if high_wall else 1.0
                    for j in range(b, e):
                        into = (
                            below * max(low[m + j], 0.0) * ahead[s + i + j] - max(high[h + j], 0.0) * ahead[s + c + j]
                        )
                        line[SECOND + j] += ratio * into
                    for j in range(b, e):
                        into = (
                            above * min(high[h + j], 0.0) * behind[s + k + j] - min(low[m + j], 0.0) * behind[s + c + j]
                        )
                        line[SECOND + j] += ratio * into
        for j in range(cells):
            weight = 1.0 - line[j]
            new = keep * u0[c + j] + (1.0 - keep) * (weight * u[c + j] + line[SECOND + j])
            bad += (not weight >= least) + (not abs(new) < np.inf)
            out[c + j] = new
        wrong[part] = bad


@kernel("read1 read1 read1 read1 index2 int real write1 write1 write1", uses=USES, **FUSED)
def pull_field(g, low, high, ratios, axes, lift, flux, gu, ginflow, wrong, start, stop):
    """The cotangent of u' -> that of u, with x = u; that of the inflow is added to ginflow."""
    line = np.empty(LINES)
    for part in range(start, stop):
        first, size = cells_of(axes, part)
        c, cells, bad = uint64(first), uint64(size), 0
        for j in range(cells):
            line[j] = g[c + j]
        for a in range(axes.shape[0]):
            axis, ratio, speed = along(axes, a), ratios[a], uint64(axes[a, SPEED])
            for number in range(3):
                (b, e, i, k, m, h), wall, low_wall, high_wall = reach(axis, lift, first, size, number)
                # the lower side of the cell above, the upper side of the cell below
                far, near = (h, m) if lift else (k + speed, i + speed)
                below, above = 0.0 if low_wall else 1.0, 0.0 if high_wall else 1.0
                for j in range(b, e):
                    gone = max(low[m + j], 0.0) - min(high[h + j], 0.0) + flux * (high[h + j] - low[m + j])
                    came = above * max(low[far + j], 0.0) * g[k + j] - below * min(high[near + j], 0.0) * g[i + j]
                    line[j] += ratio * (came - gone * g[c + j])
                place = uint64(axes[a, WALL] + wall)
                for j in range(b, e if low_wall else b):
                    if axes[a, GIVEN]:
                        ginflow[place + j] += ratio * max(low[m + j], 0.0) * g[c + j]
                    else:
                        line[j] += ratio * max(low[m + j], 0.0) * g[c + j]
                place = uint64(axes[a, OTHER_WALL] + wall)
                for j in range(b, e if high_wall else b):
                    if axes[a, OTHER_GIVEN]:
                        ginflow[place + j] -= ratio * min(high[h + j], 0.0) * g[c + j]
                    else:
                        line[j] -= ratio * min(high[h + j], 0.0) * g[c + j]
        for j in range(cells):
            bad += not abs(line[j]) < np.inf
            gu[c + j] = line[j]
        wrong[part] = bad


@kernel("read1 read1 read1 read1 read1 read1 index2 int real write1 write1 int int write1", uses=USES, **FUSED)
def pull_velocity(g, u, inflow, low, high, ratios, axes, lift, flux, glow, ghigh, apart, fresh, wrong, start, stop):
    """The cotangent of u' -> those of low and high with x = u, added to glow and ghigh or (fresh) set.

    apart: these are two arrays; else they are one, and so are low and high.
    """
    rest = 1.0 - flux
    for part in range(start, stop):
        first, size = cells_of(axes, part)
        c, bad = uint64(first), 0
        for a in range(axes.shape[0]):
            axis, ratio = along(axes, a), ratios[a]
            for number in range(3):
                (b, e, i, k, m, h), wall, low_wall, high_wall = reach(axis, lift, first, size, number)
                given, given_above = low_wall and axes[a, GIVEN], high_wall and axes[a, OTHER_GIVEN]
                place, place_above = uint64(axes[a, WALL] + wall), uint64(axes[a, OTHER_WALL] + wall)
                for j in range(b, e if fresh else b):
                    glow[m + j] = 0.0
                for j in range(b, e if fresh and (apart or high_wall) else b):
                    ghigh[h + j] = 0.0
                if low_wall or high_wall or apart:
                    back = 0.0 if low_wall or not lift else ratio
                    for j in range(b, e):
                        x = between(low[m + j], inflow[place + j] if given else u[i + j], u[c + j])
                        glow[m + j] += ratio * g[c + j] * (x - rest * u[c + j]) - back * g[i + j] * (
                            x - rest * u[i + j]
                        )
                    for j in range(b, e if high_wall or not lift else b):
                        x = between(high[h + j], u[c + j], inflow[place_above + j] if given_above else u[k + j])
                        ghigh[h + j] -= ratio * g[c + j] * (x - rest * u[c + j])
                        bad += not abs(ghigh[h + j]) < np.inf
                elif lift:
                    for j in range(b, e):
                        x = between(low[m + j], u[i + j], u[c + j])
                        glow[m + j] += ratio * (g[c + j] * (x - rest * u[c + j]) - g[i + j] * (x - rest * u[i + j]))
                else:
                    for j in range(b, e):
                        x = between(low[m + j], u[i + j], u[c + j]) - between(low[m + j], u[c + j], u[k + j])
                        glow[m + j] += ratio * g[c + j] * x
                for j in range(b, e):
                    bad += not abs(glow[m + j]) < np.inf
        wrong[part] = bad


@kernel(
    "read1 read1 read1 read1 read1 read1 index2 int write1 write1 write1 write1 read1 read1 write1", uses=USES, **FUSED
)
def pull_slopes(g, low, high, ahead, behind, ratios, axes, lift, glow, ghigh, a1, b1, a2, b2, wrong, start, stop):
    """The cotangent of u' -> what ahead and behind add to those of low and high, and the cotangents of a and b.

    a1, b1, a2, b2: the derivatives of ahead and behind; in a1 and b1 the cotangents of a and b are left. a2 and b2 are
    empty where ahead and behind are the same.
    """
    line = np.empty(LINES)
    for part in range(start, stop):
        first, size = cells_of(axes, part)
        c, bad = uint64(first), 0
        for a in range(axes.shape[0]):
            axis, ratio, speed, s = along(axes, a), ratios[a], uint64(axes[a, SPEED]), uint64(a * g.size)
            for number in range(3):
                (b, e, i, k, m, h), _, low_wall, high_wall = reach(axis, lift, first, size, number)
                far, near = (h, m) if lift else (k + speed, i + speed)
                below, above = 0.0 if low_wall else ratio, 0.0 if high_wall else ratio
                for j in range(b, e):  # what is asked of ahead
                    p, q = max(low[far + j], 0.0), max(high[h + j], 0.0)
                    line[j] = above * p * g[k + j] - ratio * q * g[c + j]
                for j in range(b, e):  # and of behind
                    p, q = min(high[near + j], 0.0), min(low[m + j], 0.0)
                    line[SECOND + j] = below * p * g[i + j] - ratio * q * g[c + j]
                if a2.size:
                    for j in range(b, e):
                        a1[s + c + j] = a1[s + c + j] * line[j] + a2[s + c + j] * line[SECOND + j]
                        b1[s + c + j] = b1[s + c + j] * line[j] + b2[s + c + j] * line[SECOND + j]
                else:
                    for j in range(b, e):
                        a1[s + c + j] *= line[j] + line[SECOND + j]
                        b1[s + c + j] *= line[j] + line[SECOND + j]
                shown, back = 0.0 if low_wall else 1.0, lift * below
                for j in range(b, e):
                    part_below = share(low[m + j])
                    line[j] = shown * part_below * ahead[s + i + j] - (1.0 - part_below) * behind[s + c + j]
                for j in range(b, e):
                    glow[m + j] += (ratio * g[c + j] - back * g[i + j]) * line[j]
                for j in range(b, e):
                    bad += not abs(glow[m + j]) < np.inf
                if lift and not high_wall:
                    continue
                shown = 0.0 if high_wall else 1.0
                for j in range(b, e):
                    part_below = share(high[h + j])
                    line[j] = part_below * ahead[s + c + j] - shown * (1.0 - part_below) * behind[s + k + j]
                for j in range(b, e):
                    ghigh[h + j] -= ratio * g[c + j] * line[j]
                for j in range(b, e):
                    bad += not abs(ghigh[h + j]) < np.inf
        wrong[part] = bad


@kernel("read1 read1 mask1 index2 write1 write1 write1", uses=USES, **FUSED)
def jumps(a1, b1, free, axes, gu, ginflow, wrong, start, stop):
    """The cotangents of a and b, the differences to the cells below and above, are added to those of u and inflow."""
    line = np.empty(LINES)
    for part in range(start, stop):
        first, size = cells_of(axes, part)
        c, cells, bad = uint64(first), uint64(size), 0
        for a in range(axes.shape[0]):
            axis, s = along(axes, a), uint64(a * gu.size)
            for number in range(3):
                (b, e, i, k, _, _), wall, low_wall, high_wall = reach(axis, 0, first, size, number)
                # at a wall without inflow there is no difference
                mine, other = 0.0 if low_wall and not axes[a, GIVEN] else 1.0, 0.0 if low_wall else 1.0
                for j in range(b, e):
                    line[j] = mine * (a1[s + c + j] + other * b1[s + i + j])
                mine, other = 0.0 if high_wall and not axes[a, OTHER_GIVEN] else 1.0, 0.0 if high_wall else 1.0
                for j in range(b, e):
                    line[SECOND + j] = mine * (b1[s + c + j] + other * a1[s + k + j])
                if free.size:
                    lower, upper = uint64(2 * a * gu.size) + c, uint64((2 * a + 1) * gu.size) + c
                    for j in range(b, e):
                        line[j] *= free[lower + j]
                    for j in range(b, e):
                        line[SECOND + j] *= free[upper + j]
                for j in range(b, e):
                    gu[c + j] += line[j] - line[SECOND + j]
                place = uint64(axes[a, WALL] + wall)
                for j in range(b, e if low_wall and axes[a, GIVEN] else b):
                    ginflow[place + j] -= line[j]
                place = uint64(axes[a, OTHER_WALL] + wall)
                for j in range(b, e if high_wall and axes[a, OTHER_GIVEN] else b):
                    ginflow[place + j] += line[SECOND + j]
        for j in range(cells):
            bad += not abs(gu[c + j]) < np.inf
        wrong[part] = bad


def _slopes(u, inflow, free, distances, axes, steep, ahead, behind, a1, b1, a2, b2, start, stop):
    """ahead and behind by `limiter` and, if steep, their derivatives; behind, a2, b2 are empty where both are the same.

    `free` says which lower and upper sides are open, axis by axis; empty where all are. `distances` holds c of the
    cells along each axis, then e.
    """
    line = np.empty(LINES)
    for part in range(start, stop):
        first, size = cells_of(axes, part)
        c, cells, at = uint64(first), uint64(size), 0
        for a in range(axes.shape[0]):
            axis, n, s = along(axes, a), axes[a, N], uint64(a * u.size + first)
            for number in range(3):
                (b, e, i, k, _, _), wall, low_wall, high_wall = reach(axis, 0, first, size, number)
                for j in range(b, e):
                    line[j] = u[c + j] - u[i + j]
                    line[SECOND + j] = u[k + j] - u[c + j]
                place = uint64(axes[a, WALL] + wall)
                for j in range(b, e if low_wall and axes[a, GIVEN] else b):
                    line[j] = u[c + j] - inflow[place + j]
                place = uint64(axes[a, OTHER_WALL] + wall)
                for j in range(b, e if high_wall and axes[a, OTHER_GIVEN] else b):
                    line[SECOND + j] = inflow[place + j] - u[c + j]
            if free.size:
                lower, upper = uint64(2 * a * u.size) + c, uint64((2 * a + 1) * u.size) + c
                for j in range(cells):
                    line[j] *= free[lower + j]
                for j in range(cells):
                    line[SECOND + j] *= free[upper + j]
            place = uint64(at + first // axes[a, STRIDE] % n)
            other, at = place + uint64(n), at + 2 * n
            if axes[a, LAST]:
                for j in range(cells):
                    line[THIRD + j] = distances[place + j]
                for j in range(cells):
                    line[FOURTH + j] = distances[other + j]
            else:
                for j in range(cells):
                    line[THIRD + j] = distances[place]
                    line[FOURTH + j] = distances[other]
            for j in range(cells if behind.size else uint64(0)):
                found = limiter(line[j], line[SECOND + j], line[THIRD + j], line[FOURTH + j])
                behind[s + j] = found[1]
                if steep:
                    a2[s + j], b2[s + j] = found[4], found[5]
            if steep:
                for j in range(cells):
                    found = limiter(line[j], line[SECOND + j], line[THIRD + j], line[FOURTH + j])
                    line[j], line[SECOND + j], line[THIRD + j] = found[0], found[2], found[3]
                for j in range(cells):
                    a1[s + j] = line[SECOND + j]
                    b1[s + j] = line[THIRD + j]
                for j in range(cells):
                    ahead[s + j] = line[j]
            else:
                for j in range(cells):
                    ahead[s + j] = limiter(line[j], line[SECOND + j], line[THIRD + j], line[FOURTH + j])[0]


def slopes_of(name, function, **options):
    """The loop over the slopes of a scheme."""
    words = "read1 read1 mask1 read1 index2 flag write1 write1 write1 write1 write1 write1"
    return Kernel(_slopes, words, {**USES, "limiter": function}, f"slopes_{name}", **{**FUSED, **options})


slopes = {name: slopes_of(name, scheme.limiter) for name, scheme in SCHEMES.items() if scheme.limiter is not None}
