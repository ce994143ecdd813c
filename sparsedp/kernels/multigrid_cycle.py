"""Compiled cycle over the coarse levels of the structured multigrid.

One thread goes through the slabs once down and once up, all tasks in step, so that a level is read from
memory twice; a team does task after task. The bits are the same.
"""

from numba import njit, prange, types

from sparsedp.kernels.multigrid_levels import (
    again,
    cells,
    correct,
    order,
    relax,
    residual,
    restrict,
    sum_both,
    sweep,
)
from sparsedp.kernels.multigrid_rows import PAD, ends, inner, rows
from sparsedp.kernels.pointers import address, get, pointer, put

__all__ = ["AGAIN", "DENSE", "DOWN", "SUM", "UP", "cycle"]

PARALLEL = 100_000  # cells below which a level is not worth a team of threads
SWEEP, RESIDUAL, RESTRICT, CORRECT, RELAX, ORDER, AGAIN, SUM = range(8)
DOWN, UP, DENSE = -1, -2, -3


@inner
def _dense(matrix, b, natural, grid, vector, like):
    """The coarsest level: natural = matrix b, the matrix being symmetric."""
    n = grid[0][2]
    vector[:] = 0.0
    for i in range(grid[0][0] * grid[0][1]):
        for k in range(n):
            value, column = get(pointer(cells(b, 1 + i, k & 1), like), k // 2), matrix[i * n + k]
            for m in range(vector.size):
                vector[m] += value * column[m]
    for i in range(grid[0][0] * grid[0][1]):
        out = natural[0] + (1 + i) * natural[1]
        for k in range(n):
            put(pointer(out, like), k, vector[i * n + k])
        ends(out, n, like, grid[1][2])


@inner
def _level(k, levels, x, b, r, kept, links, weights, starts, natural):
    """The arrays of level k, as addresses in the arrays that hold all levels."""
    size, height, width, first = x.itemsize, levels[k, 3], levels[k, 4], levels[k, 5]
    step, own = width * size, (first + PAD) * size
    matrix = address(links) + (levels[k, 14] + PAD) * size, step, 2 * height * step
    weight, begin = address(weights) + (levels[k, 6] + PAD) * size, address(starts) + levels[k, 7] * 8
    order = address(natural) + (levels[k, 8] + PAD) * size, levels[k, 9] * size
    fields = (address(x) + own, step), (address(b) + own, step), (address(r) + own, step), (address(kept) + own, step)
    return fields + (matrix, (weight, step), begin, order)


@inner
def _grid(levels, k):
    shape = levels[k, 0], levels[k, 1], levels[k, 2]
    return shape, (levels[k, 11] > 0, levels[k, 12] > 0, levels[k, 13] > 0), (shape[2] + 1) // 2


@inner
def _bundle(k, levels, x, b, r, kept, links, weights, starts, natural, around):
    """What the tasks on level k need."""
    there = _level(k + 1, levels, x, b, r, kept, links, weights, starts, natural)
    here = _level(k, levels, x, b, r, kept, links, weights, starts, natural)
    return here, there[1], there[7], _grid(levels, k), around, x.dtype.type(0.0), x.itemsize


@inner
def _do(task, group, first, last, bundle, line):
    """Do a task for the rows of a group, or of all groups, in slabs first <= i < last."""
    (x, b, r, kept, c, w, begin, own), target, there, grid, around, like, size = bundle
    final, all_rows = 2 if around == 1 else 3, task in (CORRECT, ORDER, AGAIN, SUM)
    for i in range(first, min(last, grid[0][0])):
        if not all_rows and i & 1 != group >> 1:
            continue
        for j in range(0 if all_rows else group & 1, grid[0][1], 1 if all_rows else 2):
            if task == SWEEP:
                sweep(i, j, x, b, c, around, grid, like, size)
            elif task == RELAX:
                relax(i, j, x, b, c, around, grid, like, size)
            elif task == RESIDUAL:
                residual(i, j, r, x, c, around, grid, like, size, final)
            elif task == RESTRICT:
                restrict(i // 2, j // 2, target, r, w, begin, grid, like, size, final, line)
            elif task == CORRECT:
                correct(i, j, x, there, w, begin, grid, like, size, final)
            elif task == ORDER:
                order(i, j, x, own, grid, like)
            elif task == AGAIN:
                again(i, j, x, b, kept, c, around, grid, like, size)
            else:
                sum_both(i, j, x, kept, own, grid, like)


@inner
def _plain_zero(bundle):
    """0, not known when compiled: numba would compile `_do` anew for every constant that it is called with."""
    return bundle[3][0][0] * 0


@inner
def _down(bundle, line):
    """Sweep, residual and restriction in step: what slab i needs is done just before."""
    o = _plain_zero(bundle)
    n, first = bundle[3][0][0], 2 if bundle[3][1][0] else 0
    _do(SWEEP + o, o, o, 1 + o, bundle, line)
    _do(SWEEP + o, 1 + o, o, 1 + o, bundle, line)
    for i in range(0, n, 2):
        _do(SWEEP + o, o, i + 2, i + 3, bundle, line)
        _do(SWEEP + o, 1 + o, i + 2, i + 3, bundle, line)
        for group in (2, 3):
            _do(SWEEP + o, group, i + 1, i + 2, bundle, line)
        for group in (2, 3):
            _do(RESIDUAL + o, group, i + 1, i + 2, bundle, line)
        if i >= first:
            _finish_down(i, bundle, line)
    if first:
        _finish_down(0, bundle, line)


@inner
def _finish_down(i, bundle, line):
    o = _plain_zero(bundle)
    _do(RESIDUAL + o, o, i, i + 1, bundle, line)
    _do(RESIDUAL + o, 1 + o, i, i + 1, bundle, line)
    _do(RESTRICT + o, o, i, i + 1, bundle, line)


@inner
def _up(bundle, line):
    """Correction, relaxation and natural order in step."""
    o = _plain_zero(bundle)
    n, first = bundle[3][0][0], 2 if bundle[3][1][0] else 0
    _do(CORRECT + o, o, o, 1 + o, bundle, line)
    for i in range(0, n, 2):
        _do(CORRECT + o, o, i + 1, i + 3, bundle, line)
        _do(RELAX + o, 3 + o, i + 1, i + 2, bundle, line)
        _do(RELAX + o, 2 + o, i + 1, i + 2, bundle, line)
        _do(ORDER + o, o, i + 1, i + 2, bundle, line)
        if i >= first:
            _finish_up(i, bundle, line)
    if first:
        _finish_up(0, bundle, line)


@inner
def _finish_up(i, bundle, line):
    o = _plain_zero(bundle)
    _do(RELAX + o, 1 + o, i, i + 1, bundle, line)
    _do(RELAX + o, o, i, i + 1, bundle, line)
    _do(ORDER + o, o, i, i + 1, bundle, line)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _team(task, group, teams, k, levels, x, b, r, kept, links, weights, starts, natural, around, lines):
    for member in prange(teams):
        team, n = types.int64(member), levels[k, 0]
        bundle = _bundle(k, levels, x, b, r, kept, links, weights, starts, natural, around)
        _do(task, group, n * team // teams, n * (team + 1) // teams, bundle, rows(lines[team])[0])


@njit(nogil=True, cache=True, error_model="numpy")
def cycle(schedule, levels, x, b, r, kept, links, weights, starts, natural, around, matrix, vector, lines, teams):
    """One cycle: b of the first level -> its correction in natural order.

    A row of `schedule`: what to do, on which level. A row of `levels`: n0, n1, n2, rows, width; where its vectors,
    weights, starts and natural order begin; width of the latter, number of weights, the three flags of periodic
    axes, where its links begin.
    """
    like, line = x.dtype.type(0.0), rows(lines[0])[0]
    for m in range(schedule.shape[0]):
        task, k = schedule[m]
        if task == DENSE:
            here = _level(k, levels, x, b, r, kept, links, weights, starts, natural)
            _dense(matrix, here[1], here[7], _grid(levels, k), vector, like)
            continue
        rest = teams, k, levels, x, b, r, kept, links, weights, starts, natural, around, lines
        if teams == 1 or levels[k, 0] * levels[k, 1] * levels[k, 2] < PARALLEL:
            bundle = _bundle(k, levels, x, b, r, kept, links, weights, starts, natural, around)
            if task == DOWN:
                _down(bundle, line)
            elif task == UP:
                _up(bundle, line)
            else:
                _do(task, k * 0, k * 0, levels[k, 0], bundle, line)
        elif task == DOWN:
            for group in range(4):
                _team(SWEEP, group, *rest)
            for group in range(4):
                _team(RESIDUAL, group, *rest)
            _team(RESTRICT, 0, *rest)
        elif task == UP:
            _team(CORRECT, 0, *rest)
            for group in range(3, -1, -1):
                _team(RELAX, group, *rest)
            _team(ORDER, 0, *rest)
        else:
            _team(task, 0, *rest)
