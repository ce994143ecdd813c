"""Compiled passes over the finest grid of the structured multigrid, after the black cells are eliminated.

Cells are red and black like a chess board (red: the sum of the indices is even). The matrix, scaled
to a unit diagonal, is 1 - c with c >= 0 between cells of different colours, so that the equation for
the red cells alone is (1 - c c) x = b_red + c b_black: conjugate gradients run on that, with half of
the numbers. A red-black sweep from zero is then z = r, and its residual c c r. The cycle goes further, z = over r,
which leaves (1 - over) r + over c c r: of rough fields c c leaves between 0 and 1/4 (3-D: 4/9), and with over = 1.2
that is at most 1/5 (1/3) in size. Source: I. Yavneh, On red-black SOR smoothing in multigrid, SIAM J. Sci.
Comput. 17 (1996) 180-192.

A field of one colour is an array (rows, width). Row 0 is zero and stands for everything outside a
bounded grid; row 1 + i * shape[1] + j holds the cells of one colour of line (i, j), in column 2 k or
2 k + 1. In 2-D shape[1] is 1. Functions take (address, step) of arrays, see `multigrid_rows`. The
links, an array (directions, rows, width), hold c for the red cells: before and after along the line,
then along axis 0, then along axis 1.

`grid` is (shape, periodic, cells in a row). Every pass goes through slabs i in order and keeps three slabs of
red and of black values in `ring`, addresses of which are `place`d modulo 3. A member of a team of
threads does a share of the slabs. Sums are kept chunk by chunk, and the chunks depend on the grid only,
so that the bits do not depend on the number of threads.
"""

from sparsedp.kernels.multigrid_rows import (
    PAD,
    advance,
    blend,
    clear,
    descend,
    ends,
    inner,
    mix,
    narrow,
    rest,
    rows,
    split,
    sum_up,
    vectors,
    weigh,
    weigh_onto,
)
from sparsedp.kernels.pointers import get, pointer

__all__ = ["NO", "black_slab", "coarser", "correct", "direction", "place", "red_row", "restrict", "slot", "update"]

NO = (0.0,)
AHEAD = (0.0, 0.0)  # rows are short in 3-D: weights are fetched ahead, which the processor does not do across rows


@inner
def place(i, j, grid):
    """Row of line (i, j); 0 outside."""
    shape, periodic, _ = grid
    if i < 0 or i >= shape[0]:
        if not periodic[0]:
            return 0
        i = (i + shape[0]) % shape[0]
    if j < 0 or j >= shape[1]:
        if not periodic[1]:
            return 0
        j = (j + shape[1]) % shape[1]
    return 1 + i * shape[1] + j


@inner
def slot(ring, i, j, grid):
    """Row j of slab i in a ring of three slabs."""
    lines = grid[0][1]
    return ring[0] + ((i + 3) % 3 * lines + (j + lines) % lines) * ring[1]


@inner
def _black_row(links, red, black, i, j, grid, like, size):
    """Row j of slab i: c times red."""
    n, row = vectors(grid[2]), place(i, j, grid)
    first, step = links
    plane = step * (grid[0][0] * grid[0][1] + 1)
    left = -((i + j) & 1) * size
    right, own, out, at = left + size, first + row * step, slot(black, i, j, grid), slot(red, i, j, grid)
    above, below = first + place(i - 1, j, grid) * step, first + place(i + 1, j, grid) * step
    line = out, own + plane + left, at + left, own + right, at + right
    across = above + 3 * plane, slot(red, i - 1, j, grid), below + 2 * plane, slot(red, i + 1, j, grid)
    if grid[0][1] > 1:
        above, below = first + place(i, j - 1, grid) * step, first + place(i, j + 1, grid) * step
        up, down = slot(red, i, j - 1, grid), slot(red, i, j + 1, grid)
        weigh(like, n, line + across + (above + 5 * plane, up, below + 4 * plane, down), AHEAD)
    else:
        weigh(like, n, line + across, NO)
    ends(out, grid[2], like, grid[1][2])


@inner
def red_row(out, links, black, i, j, grid, like, size):
    """Row j of slab i: c times black, to the row at `out`."""
    n, row = vectors(grid[2]), place(i, j, grid)
    first, step = links
    plane = step * (grid[0][0] * grid[0][1] + 1)
    right = ((i + j) & 1) * size
    left, own, at = right - size, first + row * step, slot(black, i, j, grid)
    line = out, own, at + left, own + plane, at + right
    across = own + 2 * plane, slot(black, i - 1, j, grid), own + 3 * plane, slot(black, i + 1, j, grid)
    if grid[0][1] > 1:
        up, down = slot(black, i, j - 1, grid), slot(black, i, j + 1, grid)
        weigh(like, n, line + across + (own + 4 * plane, up, own + 5 * plane, down), AHEAD)
    else:
        weigh(like, n, line + across, NO)


@inner
def black_slab(i, links, red, black, grid, like, size):
    """Slab i: c times red; 0 outside."""
    for j in range(grid[0][1]):
        if place(i, j, grid) == 0:
            clear(like, vectors(grid[2]), (slot(black, i, j, grid),), NO)
        else:
            _black_row(links, red, black, i, j, grid, like, size)


@inner
def _flushed(sums, m, column, total, i, n):
    """After slab i: keep the sum of chunk m if that was its last slab -> number of the chunk that goes on."""
    if i + 1 < n * (m + 1) // sums.shape[0]:
        return m
    sums[m, column] = total.sum()
    total[:] = 0.0
    return m + 1


# ---------------------------------------------------------------- conjugate gradients


@inner
def direction(share, links, x, new, old, z, q, beta, steps, grid, like, ring, total, sums):
    """new = z + beta old; q = (1 - c c) new; new . q to sums. `like` is the type of z, new and old.

    If steps[0] is not 0, x += steps[0] old + steps[1] new first: two steps at once, to read x half as often.
    """
    n, m, count, red, black = grid[0][0], share[0], vectors(grid[2]), rows(ring[0]), rows(ring[1])
    first, last = n * share[0] // sums.shape[0], n * share[1] // sums.shape[0]
    total[:] = 0.0
    products = rows(total)[0] - PAD * 8
    for i in range(first - 2, last + 2):
        for j in range(grid[0][1]):
            row, p = place(i, j, grid), slot(red, i, j, grid)
            blend(like, count, (p, z[0] + row * z[1], old[0] + row * old[1]), (beta,))
            ends(p, grid[2], 1.0, grid[1][2])
        if i >= first:
            black_slab(i - 1, links, red, black, grid, 1.0, 8)
        if i < first + 2:
            continue
        for j in range(grid[0][1]):
            row, p = 1 + (i - 2) * grid[0][1] + j, slot(red, i - 2, j, grid)
            out, there, at = q[0] + row * q[1], new[0] + row * new[1], x[0] + row * x[1]
            if steps[0] != 0.0:
                advance(like, count, (at, at, old[0] + row * old[1], there), steps)
            red_row(out, links, black, i - 2, j, grid, 1.0, 8)
            rest(like, count, (out, p, there, products), NO)
        m = _flushed(sums, m, 0, total[0, : grid[2]], i - 2, n)


@inner
def update(share, r, q, gauge, alpha, grid, like, total, sums):
    """r -= alpha q; sum of (gauge r)^2 to sums. `like` is the type of gauge."""
    n, m, lines = grid[0][0], share[0], grid[0][1]
    total[:] = 0.0
    squares = rows(total)[0] - PAD * 8
    for i in range(n * share[0] // sums.shape[0], n * share[1] // sums.shape[0]):
        for row in range(1 + i * lines, 1 + (i + 1) * lines):
            at, there, weight = r[0] + row * r[1], q[0] + row * q[1], gauge[0] + row * gauge[1]
            descend(like, vectors(grid[2]), (at, there, weight, squares), (alpha,))
        m = _flushed(sums, m, 0, total[0, : grid[2]], i, n)


# ---------------------------------------------------------------- the cycle


@inner
def coarser(grid):
    shape, periodic, count = grid
    return ((shape[0] + 1) // 2, (shape[1] + 1) // 2, count), periodic, count


@inner
def _interpolate(out, coarse, weights, starts, i, j, grid, like, size):
    """Add what the coarse field (rows in natural order) says about the red cells of line (i, j)."""
    odd, n = (i + j) & 1, vectors(grid[2])
    weight = weights[0] + get(pointer(starts, 0), place(i, j, grid)) * weights[1]
    for a in range(1 + (i & 1)):
        for b in range(1 + (j & 1)):
            u = coarse[0] + place(i // 2 + a, j // 2 + b, coarser(grid)) * coarse[1]
            if odd:
                weigh_onto(like, n, (out, out, weight, u, weight + weights[1], u + size), NO)
            else:
                weigh_onto(like, n, (out, out, weight, u), NO)
            weight += (1 + odd) * weights[1]


@inner
def _collect(sums, r, weights, starts, i, j, owned, grid, like, size):
    """The transpose of `_interpolate`: add to the coarse slabs, `sums` holding slabs modulo 2."""
    odd, n, lines = (i + j) & 1, vectors(grid[2]), (grid[0][1] + 1) // 2
    weight = weights[0] + get(pointer(starts, 0), place(i, j, grid)) * weights[1]
    for a in range(1 + (i & 1)):
        for b in range(1 + (j & 1)):
            slab, line = i // 2 + a, place(0, j // 2 + b, coarser(grid)) - 1
            if line >= 0 and owned[0] <= slab < owned[1]:
                out = sums[0] + ((slab & 1) * lines + line) * sums[1]
                if odd:
                    weigh_onto(like, n, (out, out, weight, r, weight + weights[1] - size, r - size), NO)
                else:
                    weigh_onto(like, n, (out, out, weight, r), NO)
            weight += (1 + odd) * weights[1]


@inner
def restrict(share, links, r, coarse, weights, starts, over, grid, like, size, ring, sums):
    """r -> the right-hand side of coarse slabs share[0] <= i < share[1]: the residual that over r leaves."""
    count, wide, lines = vectors(grid[2]), vectors((grid[2] + 1) // 2), (grid[0][1] + 1) // 2
    red, black, first = rows(ring[0]), rows(ring[1]), 2 * share[0] - 1
    swept = sums[0] + 2 * lines * sums[1]
    for line in range(2 * lines):
        clear(like, count, (sums[0] + line * sums[1],), NO)
    for i in range(first - 2, 2 * share[1] + 2):
        for j in range(grid[0][1]):
            row, p = place(i, j, grid), slot(red, i, j, grid)
            narrow(like, count, (p, r[0] + row * r[1]), (1.0,))
            ends(p, grid[2], like, grid[1][2])
        if i >= first:
            black_slab(i - 1, links, red, black, grid, like, size)
        if i < first + 2:
            continue
        for j in range(grid[0][1]):
            out = slot(red, i - 2, j, grid)
            if place(i - 2, j, grid) > 0:
                red_row(swept, links, black, i - 2, j, grid, like, size)
                mix(like, count, (out, swept), (1.0 - over, over))
                ends(out, grid[2], like, grid[1][2])
                _collect(sums, out, weights, starts, i - 2, j, share, grid, like, size)
        slab = (i - 3) // 2
        for j in range(lines if i & 1 and slab >= share[0] else 0):
            line, out = sums[0] + ((slab & 1) * lines + j) * sums[1], coarse[0] + 2 * (1 + slab * lines + j) * coarse[1]
            split(like, wide, (out, out + coarse[1], line), NO)
            clear(like, count, (line,), NO)


@inner
def correct(share, links, r, z, coarse, weights, starts, over, grid, like, size, ring, total, sums):
    """z = what the cycle makes of r, given the coarse correction; r . z to sums."""
    n, m, red, black, count = grid[0][0], share[0], rows(ring[0]), rows(ring[1]), vectors(grid[2])
    first, last = n * share[0] // sums.shape[0], n * share[1] // sums.shape[0]
    total[:] = 0.0
    products = rows(total)[0] - PAD * 8
    for i in range(first - 2, last + 2):
        for j in range(grid[0][1]):
            row, p = place(i, j, grid), slot(red, i, j, grid)
            narrow(like, count, (p, r[0] + row * r[1]), (over,))
            if row > 0:
                slab = (row - 1) // grid[0][1]
                _interpolate(p, coarse, weights, starts, slab, j, grid, like, size)
            ends(p, grid[2], like, grid[1][2])
        if i >= first:
            black_slab(i - 1, links, red, black, grid, like, size)
        if i < first + 2:
            continue
        for j in range(grid[0][1]):
            row = 1 + (i - 2) * grid[0][1] + j
            out = z[0] + row * z[1]
            red_row(out, links, black, i - 2, j, grid, like, size)
            places = out, r[0] + row * r[1], slot(red, i - 2, j, grid), products
            sum_up(like, count, places, (1.0 - over, over))
        m = _flushed(sums, m, 0, total[0, : grid[2]], i - 2, n)
