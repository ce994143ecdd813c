"""Upwind fluxes: a stage of an Eulerian transport scheme along all axes, its transpose, and the limiters.

A component of the field is one flat array with up to three axes. The loops run over tiles: at most TILE consecutive
cells of a row along the last axis. For the fluxes along the last axis a tile is divided into three pieces: the cell at
the lower end of the row, the inner cells, and the cell at the upper end. For the other axes a tile is one piece. All
cells of a piece have the same offset in memory to their neighbour beyond a side, also across the end of a periodic
axis. At a wall the cell itself stands for the ghost cell, multiplied by 0 if an inflow value is given. One inner loop
therefore handles all boundary conditions and dimensions. If lengths differ or sides are closed, the velocity or the
cotangent is first multiplied by the inverse lengths into a line buffer, with 0 on closed sides.

With Courant numbers C on the lower and upper side of a cell, p = max(C, 0), m = min(C, 0),

    u'     = (1 - leaves) u + enters
    leaves = p_lower - m_upper  [+ C_upper - C_lower in flux form],   enters = p_lower x_below - m_upper x_above.

x_below = u_below + ahead_below is the value at the lower side, computed from the cell below, and x_above = u_above -
behind_above the value at the upper side, computed from the cell above. With slopes, p_upper ahead + m_lower behind is
also subtracted from u'. A scheme is one limiter function, such as `van_leer`, and one entry of SCHEMES. The arguments
of the limiter are the differences a and b of u to the cells below and above, and the distances c and e to these cells
divided by half the width (2 between equal cells). All are numbers or arrays. It returns

    ahead, behind, d ahead/da, d ahead/db, d behind/da, d behind/db.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy import int64, uint64

from sparsedp.kernels.team import Kernel, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "SCHEMES",
    "TILE",
    "Scheme",
    "slope_loop",
    "slope_loops",
    "slope_vjp",
    "stage",
    "vjp",
]

TILE = 512  # number of cells processed at a time: a line buffer stays in the cache from one loop to the next
# Length of a line buffer. It is not a power of 2: buffers at such distances would evict each other from the cache.
LINE = TILE + 72
NONE = uint64(0)  # the starts of the first four line buffers
ONE = uint64(LINE)
TWO = uint64(2 * LINE)
THREE = uint64(3 * LINE)

# Columns of `axes`, which has one row of properties for each axis of a component.
N = 0  # number of cells along the axis
STRIDE = 1  # offset between neighbours in the flat field
ON_SIDES = 2  # whether the velocity is given on sides, not in cells
SPEED = 3  # start of the velocities of this axis
EXTRA = 4  # by how many the velocities outnumber the cells, in a block of the cells along this axis and the later ones
WALL = 5  # starts of the inflow values of the lower and of the upper wall (two columns), or SAME_AS_CELL or ROUND
COLUMN = 7  # first column of the axis in `table`
HAS_COLUMNS = 8  # whether `table` has a column for each position along the axis
IS_UNEVEN = 9  # whether lengths differ, or sides are closed, anywhere in the component
PROPERTIES = 10
SAME_AS_CELL = -1  # the ghost cell beyond the wall has the value of the cell itself
ROUND = -2  # the axis is periodic

# Rows of `table`; int64, so that `weigh` is compiled for one type.
INVERSE_LENGTH = int64(0)  # of the cell itself, for its lower and for its upper side (two rows)
INVERSE_LENGTH_BEYOND = int64(2)  # of the cells beyond these sides (two rows)
DISTANCE = int64(4)  # c and e of the limiter (two rows)


def van_leer(a: Any, b: Any, c: Any, e: Any) -> tuple[Any, ...]:
    """Return the limited slope of van Leer and its derivatives, for cells of any width.

    Notes
    -----
    With q = a / (a + b), p = 1 - q, E = q e^2, C = p c^2, m = (c + e - 2) c e the slope is (a + b) R, R = N / D,
    N = q p (E + C), D = q E + m q p + p C. Its derivative in a is (p (2 E + C) - R (2 E + m p)) / D; exchange p with q
    and E with C for the derivative in b. The slope is 0 if the signs of a and b differ. For equal
    cells it is a b / (a + b). See `sparsedp.advection.eulerian`.

    References
    ----------
    B. van Leer, J. Comput. Phys. 32 (1979) 101-136.
    A. Mignone, J. Comput. Phys. 270 (2014) 784-814.
    """
    same_sign = ((a > 0.0) & (b > 0.0)) | ((a < 0.0) & (b < 0.0))
    limited_a = a * same_sign
    total = limited_a + (b * same_sign + (1.0 - same_sign))  # a + b, or 1 where the signs differ
    q = limited_a / total
    p = 1.0 - q
    m = (c + e) * (c * e) - c * e * 2.0
    high = q * (e * e)
    low = p * (c * c)
    inverse = 1.0 / (q * (high + m * p) + p * low)  # a single division, because divisions take most of the time
    ratio = q * p * (high + low) * inverse
    slope = total * ratio
    scale = same_sign * inverse
    # If one of a and b is 0, the derivative is the mean of both one-sided derivatives.
    da = (p * (2.0 * high + low) - ratio * (2.0 * high + m * p)) * scale + 0.5 * ((a == 0.0) & (b != 0.0))
    db = (q * (high + 2.0 * low) - ratio * (2.0 * low + m * q)) * scale + 0.5 * ((b == 0.0) & (a != 0.0))
    return slope, slope, da, db, da, db


class Scheme(NamedTuple):
    """An Eulerian transport scheme.

    Attributes
    ----------
    limiter : callable or None
        ``limiter(a, b, c, e)`` as in the module docstring; None for a first-order scheme.
    stages : tuple of float
        For each stage a weight s: the stage returns s times the field at the beginning of the step plus (1 - s) times
        an Euler step from the result of the stage before.
    max_courant : float
        Largest stable CFL number of a cell.
    symmetric : bool
        Whether `ahead` and `behind` are equal.
    """

    limiter: Callable[..., tuple[Any, ...]] | None = None
    stages: tuple[float, ...] = (0.0,)
    max_courant: float = 1.0
    symmetric: bool = False


SCHEMES = {"upwind": Scheme(), "van_leer": Scheme(van_leer, stages=(0.0, 0.5), max_courant=0.5, symmetric=True)}


# ---- pieces of a tile ------------------------------------------------------------------------------------------------
#
# Indices are unsigned: numba tests whether signed indices are negative, and a loop with such tests is not vectorised.


class Side(NamedTuple):
    """The lower or the upper side of the cells of a piece.

    All indices are unsigned. Those of arrays are for the first cell of the tile: add j for cell j of the tile.
    """

    begin: Any  # first cell of the piece, as a position in the tile
    end: Any  # one after the last cell of the piece
    beyond: Any  # index in the field of the neighbour beyond the side
    speed: Any  # index of the velocity
    wall: Any  # index of the inflow value
    column: Any  # column of the table
    inner: float  # 0.0 at a wall, where `beyond` is the cell itself; else 1.0
    shown: float  # factor of the value at `beyond`: 0.0 at a wall with an inflow value; else 1.0


def tile_of(axes: NDArray, part: int) -> tuple[Any, ...]:
    """Return the row of a tile, its first cell and its number of cells, and the latter two as unsigned integers."""
    length = axes[-1, N]
    tiles = -(-length // TILE)
    row = part // tiles
    left = part % tiles * TILE
    first = row * length + left
    size = min(length - left, TILE)
    return row, first, size, uint64(first), uint64(size)


def side_of(axes: NDArray, a: int, piece: int, upper: Any, tile: tuple[Any, ...]) -> Side:
    """Return the lower or the upper side of the cells of a piece of a tile along axis `a`.

    Along the last axis the pieces are the inner cells (0), the lower end (1) and the upper end (2) of a row.
    """
    n = axes[a, N]
    stride = axes[a, STRIDE]
    wall = axes[a, WALL + upper]
    block, first, size, _, _ = tile
    line = first
    if a < len(axes) - 1:  # not on the last axis, because divisions take most of the time here
        line = first // stride
        block = line // n
    position = line - block * n
    begin = 0
    end = size
    at_end = position == (n - 1) * upper
    if a == len(axes) - 1:
        if position == 0:
            start = 1
        else:
            start = 0
        if position + size == n:
            stop = max(size - 1, start)
        else:
            stop = size
        if piece == 0:
            begin = start
            end = stop
        elif piece == 1:
            begin = 0
            end = start
        else:
            begin = stop
            end = size
        at_end = piece == 1 + upper or piece * n == 1
    walls = wall != ROUND
    step = (2 * upper - 1) * stride
    closed = at_end and walls
    if at_end and walls:
        step = 0
    elif at_end:
        step *= 1 - n
    if walls:
        to_next_side = stride
    else:
        to_next_side = step
    speed = axes[a, SPEED] + first + block * axes[a, EXTRA] + upper * axes[a, ON_SIDES] * to_next_side
    wall_value = wall + (block - line) * stride + first - begin
    column = axes[a, COLUMN] + axes[a, HAS_COLUMNS] * position
    shown = 1.0 - (closed and wall >= 0)
    return Side(
        uint64(begin),
        uint64(end),
        uint64(first + step),
        uint64(speed),
        uint64(wall_value),
        uint64(column),
        1.0 - closed,
        shown,
    )


def share(flow: float) -> float:
    """Return the weight of the cell beyond a side in the upwind value at the side: 1, 1/2 or 0 for flow >, = or < 0.

    `flow` is the velocity through the side into the cell.
    """
    return 0.5 * (flow > 0.0) + 0.5 * (flow >= 0.0)


def weigh(
    lines: NDArray,
    line: Any,
    x: NDArray,
    start: Any,
    table: NDArray,
    row: Any,
    axes: NDArray,
    a: int,
    side: Side,
    free: NDArray,
    c: Any,
) -> None:
    """For the cells of a piece, set a line buffer to x times a row of the table, and to 0 if the side is closed."""
    b = side.begin
    e = side.end
    at = side.column
    if a == len(axes) - 1 and axes[a, HAS_COLUMNS]:
        for j in range(b, e):
            lines[line + j] = x[start + j] * table[row, at + j]
    else:
        for j in range(b, e):
            lines[line + j] = x[start + j] * table[row, at]
    if free.size:
        for j in range(b, e):
            lines[line + j] *= free[2 * a + row % 2, c + j]


def to_velocity(
    w: NDArray,
    gw: NDArray,
    fresh: bool,
    u: NDArray,
    inflow: NDArray,
    slopes: NDArray,
    cotangents: NDArray,
    ratio: float,
    flux: float,
    a: int,
    on_sides: Any,
    c: Any,
    sides: tuple[Side, Side],
    places: tuple[Any, ...],
) -> Any:
    """Compute the cotangent of w on the sides of a piece, and return how many of its values are not finite.

    It is written to `gw` if `fresh`, else added to `gw`. `cotangents` contains the cotangents of cells, which start at
    the four indices `places`: of the cells themselves, weighted for their lower and for their upper sides, and of the
    cells beyond these sides. The value at a side is the value of the upstream cell, or the mean of both cells where w
    is 0.
    """
    below, above = sides
    rest = 1.0 - flux
    slopes_per_axis = slopes.shape[1]
    bad = 0
    m = below.speed
    q = above.beyond
    if not on_sides:  # the velocity of a cell applies to both its sides
        for j in range(below.begin, below.end):
            near = share(w[m + j])
            low = (below.shown * u[below.beyond + j] - u[c + j]) * cotangents[places[0] + j]
            high = (above.shown * u[q + j] - u[c + j]) * cotangents[places[1] + j]
            total = ratio * (near * low - (1.0 - near) * high)
            total = total if fresh else total + gw[m + j]
            bad += not abs(total) < np.inf
            gw[m + j] = total
    for upper in range(2):
        b, e, z, m, wall, _, inner, shown = sides[upper]
        x = places[upper]
        i = places[2 + upper]
        if upper and on_sides and inner:
            continue  # it is the lower side of the next cell
        sign = 1.0 - 2.0 * upper
        back = on_sides * inner
        if on_sides:
            for j in range(b, e):
                near = share(sign * w[m + j])
                value = near * (shown * u[z + j]) + (1.0 - near) * u[c + j]
                mine = value - rest * u[c + j]
                theirs = value - rest * u[z + j]
                total = sign * ratio * (mine * cotangents[x + j] - back * cotangents[i + j] * theirs)
                total = total if fresh else total + gw[m + j]
                bad += not abs(total) < np.inf
                gw[m + j] = total
        if not shown:
            for j in range(b, e):
                gw[m + j] += sign * ratio * cotangents[x + j] * (share(sign * w[m + j]) * inflow[wall + j])
                bad += not abs(gw[m + j]) < np.inf
        if slopes.size:
            for j in range(b, e):
                near = share(sign * w[m + j])
                theirs = inner * slopes[a, (1 - upper) % slopes_per_axis, z + j]
                slope = near * theirs - (1.0 - near) * slopes[a, upper % slopes_per_axis, c + j]
                gw[m + j] += ratio * (cotangents[x + j] - back * cotangents[i + j]) * slope
                bad += not abs(gw[m + j]) < np.inf
    return bad


limiter = van_leer  # called by `_slopes`; `slope_loop` replaces it by the limiter of a scheme
# "contract": a product and a sum become one instruction (fused multiply-add), so that all machines get the same bits.
OPTIONS: dict[str, Any] = {
    "uses": (tile_of, side_of, weigh, share, to_velocity),
    "fastmath": {"contract"},
}

# ---- the loops -------------------------------------------------------------------------------------------------------
#
# Arguments that the loops share:
#
# u, g        flat arrays over the cells: the field, a cotangent
# inflow      flat array, one value for each point at a wall
# w           flat array, axis by axis: the velocity on the sides or in the cells
# free        whether sides are open: rows for lower and upper sides of each axis; no columns if all are
# slopes      for each axis `behind` and `ahead`, or one array if both are equal; empty for a first-order scheme
# partials    the derivatives of each of the slopes in a and b
# dt          the time step
# table, axes see above
# flux        1 in flux form, 0 in advective form
# start, stop range of tiles


@kernel("read1 read1 read1 mask2 read3 real read2 index2 real real read1 real write1 write1", **OPTIONS)
def stage(
    u: NDArray,
    inflow: NDArray,
    w: NDArray,
    free: NDArray,
    slopes: NDArray,
    dt: float,
    table: NDArray,
    axes: NDArray,
    flux: float,
    least: float,
    u0: NDArray,
    keep: float,
    out: NDArray,
    wrong: NDArray,
    start: int,
    stop: int,
) -> None:
    """Set out = keep u0 + (1 - keep) u'.

    `wrong` is set, for each tile, to the number of weights below `least` plus the number of non-finite results.
    """
    memory = np.empty((2, LINE))
    lines = np.empty(2 * LINE)
    leaves = memory[0]
    enters = memory[1]
    uneven = axes[0, IS_UNEVEN]
    if uneven:
        speed = lines
    else:
        speed = w
    slopes_per_axis = slopes.shape[1]
    for part in range(start, stop):
        tile = _, _, _, c, size = tile_of(axes, part)
        bad = 0
        for j in range(size):
            leaves[j] = 0.0
            enters[j] = 0.0
        for a in range(len(axes)):
            if uneven:
                ratio = dt
            else:
                ratio = dt * table[INVERSE_LENGTH, axes[a, COLUMN]]
            pieces = 1
            if a == len(axes) - 1:
                pieces = 3
            for piece in range(pieces):
                below = side_of(axes, a, piece, int64(0), tile)  # int64, so that it is compiled for one type
                above = side_of(axes, a, piece, int64(1), tile)
                b = below.begin
                e = below.end
                i = below.beyond
                k = above.beyond
                m = below.speed
                h = above.speed
                if b == e:
                    continue
                if uneven:
                    weigh(lines, NONE, w, m, table, INVERSE_LENGTH, axes, a, below, free, c)
                    weigh(lines, ONE, w, h, table, INVERSE_LENGTH + 1, axes, a, above, free, c)
                    m = NONE
                    h = ONE
                for j in range(b, e):
                    low = ratio * speed[m + j]  # Courant numbers into the cells
                    high = -ratio * speed[h + j]
                    leaves[j] += max(low, 0.0) + max(high, 0.0) - flux * (low + high)
                    enters[j] += max(low, 0.0) * (below.shown * u[i + j]) + max(high, 0.0) * (above.shown * u[k + j])
                sides = 0
                if slopes.size or below.shown * above.shown == 0.0:
                    sides = 2
                for upper in range(sides):
                    if upper:
                        _, _, i, _, wall, _, inner, shown = above
                        m = h
                        sign = -ratio
                    else:
                        _, _, i, _, wall, _, inner, shown = below
                        sign = ratio
                    if not shown:
                        for j in range(b, e):
                            enters[j] += max(sign * speed[m + j], 0.0) * inflow[wall + j]
                    if slopes.size:
                        for j in range(b, e):
                            into = sign * speed[m + j]
                            mine = slopes[a, upper % slopes_per_axis, c + j]
                            theirs = inner * slopes[a, (1 - upper) % slopes_per_axis, i + j]
                            enters[j] += (1.0 - 2.0 * upper) * (max(into, 0.0) * theirs + max(-into, 0.0) * mine)
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
def vjp(
    g: NDArray,
    u: NDArray,
    inflow: NDArray,
    w: NDArray,
    free: NDArray,
    slopes: NDArray,
    dt: float,
    table: NDArray,
    axes: NDArray,
    flux: float,
    gu: NDArray,
    ginflow: NDArray,
    gw: NDArray,
    fresh: bool,
    partials: NDArray,
    wrong: NDArray,
    start: int,
    stop: int,
) -> None:
    """Compute the cotangents of u (for constant slopes), of the inflow and of w from the cotangent g of u'.

    `gu` is set to the cotangent of u. The cotangent of the inflow is added to `ginflow`. `gw` is set to the cotangent
    of w if `fresh`; otherwise the cotangent is added to it. An empty `gu` or `gw` is not computed. The cotangents of a
    and b overwrite the last slope's derivatives in `partials`; `slope_vjp` reads them there. `wrong` is set, for each
    tile, to the number of cotangents of u and w that are not finite.
    """
    memory = np.empty((3, LINE))
    lines = np.empty(4 * LINE)
    field = memory[0]
    of_slopes = memory[1:]
    uneven = axes[0, IS_UNEVEN]
    if uneven:
        cotangents = lines
    else:
        cotangents = g
    last = slopes.shape[1] - 1
    for part in range(start, stop):
        tile = _, _, _, c, size = tile_of(axes, part)
        bad = 0
        for j in range(size):
            field[j] = g[c + j]
        for a in range(len(axes)):
            on_sides = axes[a, ON_SIDES]
            cells = uint64(axes[a, SPEED])
            if uneven:
                ratio = dt
            else:
                ratio = dt * table[INVERSE_LENGTH, axes[a, COLUMN]]
            pieces = 1
            if a == len(axes) - 1:
                pieces = 3
            for piece in range(pieces):
                below = side_of(axes, a, piece, int64(0), tile)
                above = side_of(axes, a, piece, int64(1), tile)
                b = below.begin
                e = below.end
                m = below.speed
                h = above.speed
                sides = (below, above)
                if b == e:
                    continue
                # Starts in `cotangents` of the cells (x, y: for lower and upper sides) and of the cells
                # beyond these sides (i, k).
                x = c
                y = c
                i = below.beyond
                k = above.beyond
                if on_sides:
                    o = m
                    p = h
                else:
                    o = cells + i
                    p = cells + k
                if uneven:
                    weigh(lines, NONE, g, c, table, INVERSE_LENGTH, axes, a, below, free, c)
                    weigh(lines, ONE, g, c, table, INVERSE_LENGTH + 1, axes, a, above, free, c)
                    weigh(lines, TWO, g, i, table, INVERSE_LENGTH_BEYOND, axes, a, below, free, c)
                    weigh(lines, THREE, g, k, table, INVERSE_LENGTH_BEYOND + 1, axes, a, above, free, c)
                    x = NONE
                    y = ONE
                    i = TWO
                    k = THREE
                places = x, y, i, k
                if gu.size:
                    for j in range(b, e):
                        low = ratio * w[m + j]  # Courant numbers into the cells
                        high = -ratio * w[h + j]
                        more = below.inner * max(-ratio * w[o + j], 0.0) * cotangents[i + j]
                        more += above.inner * max(ratio * w[p + j], 0.0) * cotangents[k + j]
                        less = (max(low, 0.0) - flux * low) * cotangents[x + j]
                        less += (max(high, 0.0) - flux * high) * cotangents[y + j]
                        field[j] += more - less
                for upper in range(2):
                    if upper:
                        _, _, _, m, wall, _, inner, shown = above
                        sign = -1.0
                    else:
                        _, _, _, m, wall, _, inner, shown = below
                        sign = 1.0
                    if upper:
                        x = y
                        i = k
                        o = p
                        into = -ratio
                    else:
                        x = x
                        i = i
                        o = o
                        into = ratio
                    if shown:
                        target = field
                        at = NONE
                    else:
                        target = ginflow
                        at = wall
                    if gu.size and not inner:
                        for j in range(b, e):
                            target[at + j] += max(into * w[m + j], 0.0) * cotangents[x + j]
                    if partials.size:
                        for j in range(b, e):
                            more = inner * max(-into * w[o + j], 0.0) * cotangents[i + j]
                            of_slopes[upper, j] = sign * (max(-into * w[m + j], 0.0) * cotangents[x + j] - more)
                if gw.size:
                    bad += to_velocity(
                        w, gw, fresh, u, inflow, slopes, cotangents, ratio, flux, a, on_sides, c, sides, places
                    )
            if partials.size:  # cotangents of a and b from those of `behind` and `ahead`
                for difference in range(2):
                    for j in range(size):
                        total = partials[a, 0, difference, c + j] * of_slopes[0, j]
                        partials[a, last, difference, c + j] = (
                            total + partials[a, last, difference, c + j] * of_slopes[1, j]
                        )
        if gu.size:
            for j in range(size):
                bad += not abs(field[j]) < np.inf
                gu[c + j] = field[j]
        wrong[part] = bad


@kernel("read4 mask2 index2 write1 write1", **OPTIONS)
def slope_vjp(
    partials: NDArray, free: NDArray, axes: NDArray, gu: NDArray, ginflow: NDArray, start: int, stop: int
) -> None:
    """Add the contributions of the slopes to the cotangents of u and of the inflow.

    They follow from the cotangents of a and b, the differences to the cells below and above, in `partials`.
    """
    line = np.empty(LINE)
    last = partials.shape[1] - 1
    for part in range(start, stop):
        tile = _, _, _, c, _ = tile_of(axes, part)
        for a in range(len(axes)):
            sides = 2
            if a == len(axes) - 1:
                sides = 6
            for number in range(sides):
                upper = number % 2
                sign = 1.0 - 2.0 * (number % 2)
                b, e, i, _, wall, _, inner, shown = side_of(axes, a, number // 2, upper, tile)
                if shown and not inner:
                    continue  # the difference to a ghost cell that repeats the cell is 0
                for j in range(b, e):
                    line[j] = sign * (partials[a, last, upper, c + j] + inner * partials[a, last, 1 - upper, i + j])
                if free.size:
                    for j in range(b, e):
                        line[j] *= free[2 * a + upper, c + j]
                for j in range(b, e):
                    gu[c + j] += line[j]
                if not shown:
                    for j in range(b, e):
                        ginflow[wall + j] -= line[j]


def _slopes(u, inflow, free, table, axes, slopes, partials, start, stop):
    """Set `slopes` to the results of `limiter` and, if `partials` is not empty, `partials` to their derivatives."""
    memory = np.empty((2, LINE))
    limited = np.empty((6, LINE))  # behind, ahead, and the derivatives of both in a and b
    lines = np.ones(3 * LINE)
    slopes_per_axis = slopes.shape[1]
    all_open = free[:, :0]
    for part in range(start, stop):
        tile = _, _, _, c, size = tile_of(axes, part)
        for a in range(len(axes)):
            sides = 2
            if a == len(axes) - 1:
                sides = 6
            for number in range(sides):
                upper = number % 2
                sign = 1.0 - 2.0 * (number % 2)
                side = side_of(axes, a, number // 2, upper, tile)
                b, e, i, _, wall, _, _, shown = side
                for j in range(b, e):
                    memory[upper, j] = sign * (u[c + j] - (u[i + j] if shown else inflow[wall + j]))
                if free.size:
                    for j in range(b, e):
                        memory[upper, j] *= free[2 * a + upper, c + j]
                weigh(lines, uint64(upper * LINE), lines, TWO, table, DISTANCE + upper, axes, a, side, all_open, c)
            if partials.size:
                for j in range(size):
                    results = limiter(memory[0, j], memory[1, j], lines[j], lines[ONE + j])
                    limited[1, j], limited[0, j], limited[4, j], limited[5, j], limited[2, j], limited[3, j] = results
            else:
                for j in range(size):
                    limited[1, j], limited[0, j] = limiter(memory[0, j], memory[1, j], lines[j], lines[ONE + j])[:2]
            for k in range(2 - slopes_per_axis, 2):  # behind, ahead
                for j in range(size):
                    slopes[a, k % slopes_per_axis, c + j] = limited[k, j]
                if partials.size:
                    for j in range(size):
                        partials[a, k % slopes_per_axis, 0, c + j] = limited[2 + 2 * k, j]
                        partials[a, k % slopes_per_axis, 1, c + j] = limited[3 + 2 * k, j]


def slope_loop(name: str, function: Callable[..., tuple[Any, ...]], **options: Any) -> Kernel:
    """Return the loop `_slopes` for a limiter as a `Kernel`, to which `options` are passed."""
    words = "read1 read1 mask2 read2 index2 write3 write4"
    return Kernel(_slopes, words, functions={"limiter": function}, name=f"slopes_{name}", **{**OPTIONS, **options})


slope_loops = {name: slope_loop(name, scheme.limiter) for name, scheme in SCHEMES.items() if scheme.limiter is not None}
