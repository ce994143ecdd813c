"""Teams of threads for the passes of `multigrid` and `multigrid_fields`.

Sums are kept chunk by chunk, and the number of chunks depends on the grid only. Each member of a team
takes some of them, and scratch of its own: `rings`, `totals`, `lines`. `grid` comes in
three arguments, because a thread takes no nested tuples.
"""

from numba import njit, prange, types

from sparsedp.kernels import multigrid, multigrid_fields
from sparsedp.kernels.multigrid_rows import inner, rows
from sparsedp.kernels.pointers import address

__all__ = ["correct", "direction", "finish", "load", "restrict", "update"]

_team = njit(parallel=True, nogil=True, cache=True, error_model="numpy")


@inner
def _share(n, team, teams):
    return n * team // teams, n * (team + 1) // teams


@inner
def _direction(team, n, links, x, new, old, z, q, beta, steps, shape, periodic, half, rings, totals, sums, teams):
    grid = shape, periodic, half
    first = _share(n, team, teams), rows(links), rows(x), rows(new), rows(old), rows(z), rows(q), beta, steps
    multigrid.direction(*first, grid, z.dtype.type(0.0), rings[team], totals[team], sums)


@_team
def direction(links, x, new, old, z, q, beta, steps, shape, periodic, half, rings, totals, sums, teams):
    """See `multigrid.direction`."""
    n = sums.shape[0]
    if teams == 1:
        _direction(n * 0, n, links, x, new, old, z, q, beta, steps, shape, periodic, half, rings, totals, sums, teams)
    else:
        for member in prange(teams):
            team = types.int64(member)
            _direction(
                team, n, links, x, new, old, z, q, beta, steps, shape, periodic, half, rings, totals, sums, teams
            )


@inner
def _update(team, n, r, q, gauge, alpha, shape, periodic, half, totals, sums, teams):
    grid = shape, periodic, half
    multigrid.update(
        _share(n, team, teams), rows(r), rows(q), rows(gauge), alpha, grid, gauge.dtype.type(0.0), totals[team], sums
    )


@_team
def update(r, q, gauge, alpha, shape, periodic, half, totals, sums, teams):
    """See `multigrid.update`."""
    n = sums.shape[0]
    if teams == 1:
        _update(n * 0, n, r, q, gauge, alpha, shape, periodic, half, totals, sums, teams)
    else:
        for member in prange(teams):
            team = types.int64(member)
            _update(team, n, r, q, gauge, alpha, shape, periodic, half, totals, sums, teams)


@inner
def _restrict(team, n, links, r, coarse, weights, starts, over, shape, periodic, half, rings, lines, teams):
    grid = shape, periodic, half
    first = _share(n, team, teams), rows(links), rows(r), rows(coarse), rows(weights), address(starts), over
    multigrid.restrict(*first, grid, links.dtype.type(0.0), links.itemsize, rings[team], rows(lines[team]))


@_team
def restrict(links, r, coarse, weights, starts, over, shape, periodic, half, rings, lines, teams):
    """See `multigrid.restrict`."""
    n = (shape[0] + 1) // 2
    if teams == 1:
        _restrict(n * 0, n, links, r, coarse, weights, starts, over, shape, periodic, half, rings, lines, teams)
    else:
        for member in prange(teams):
            team = types.int64(member)
            _restrict(team, n, links, r, coarse, weights, starts, over, shape, periodic, half, rings, lines, teams)


@inner
def _correct(team, n, links, r, z, coarse, weights, starts, over, shape, periodic, half, rings, totals, sums, teams):
    grid = shape, periodic, half
    first = _share(n, team, teams), rows(links), rows(r), rows(z), rows(coarse), rows(weights), address(starts), over
    multigrid.correct(*first, grid, links.dtype.type(0.0), links.itemsize, rings[team], totals[team], sums)


@_team
def correct(links, r, z, coarse, weights, starts, over, shape, periodic, half, rings, totals, sums, teams):
    """See `multigrid.correct`."""
    n = sums.shape[0]
    if teams == 1:
        _correct(
            n * 0, n, links, r, z, coarse, weights, starts, over, shape, periodic, half, rings, totals, sums, teams
        )
    else:
        for member in prange(teams):
            team = types.int64(member)
            _correct(
                team, n, links, r, z, coarse, weights, starts, over, shape, periodic, half, rings, totals, sums, teams
            )


@inner
def _load(team, n, links, r, b, scale, widths, found, shape, periodic, half, rings, lines, teams):
    grid = shape, periodic, half
    multigrid_fields.load(
        _share(n, team, teams), rows(links), rows(r), b, scale, widths, found, grid, rings[team], lines[team]
    )


@_team
def load(links, r, b, scale, widths, found, shape, periodic, half, rings, lines, teams):
    """See `multigrid_fields.load`."""
    n = shape[0]
    if teams == 1:
        _load(n * 0, n, links, r, b, scale, widths, found, shape, periodic, half, rings, lines, teams)
    else:
        for member in prange(teams):
            team = types.int64(member)
            _load(team, n, links, r, b, scale, widths, found, shape, periodic, half, rings, lines, teams)


@inner
def _finish(team, n, links, x, steps, p, old, b, y, scale, widths, found, shape, periodic, half, rings, lines, teams):
    grid = shape, periodic, half
    first = _share(n, team, teams), rows(links), rows(x), steps, rows(p), rows(old), p.dtype.type(0.0)
    multigrid_fields.finish(*first, b, y, scale, widths[:3], widths[3:], found, grid, rings[team], lines[team])


@_team
def finish(links, x, steps, p, old, b, y, scale, widths, found, shape, periodic, half, rings, lines, teams):
    """See `multigrid_fields.finish`."""
    n = shape[0]
    if teams == 1:
        _finish(
            n * 0, n, links, x, steps, p, old, b, y, scale, widths, found, shape, periodic, half, rings, lines, teams
        )
    else:
        for member in prange(teams):
            team = types.int64(member)
            _finish(
                team, n, links, x, steps, p, old, b, y, scale, widths, found, shape, periodic, half, rings, lines, teams
            )
