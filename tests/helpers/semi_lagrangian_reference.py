"""Semi-Lagrangian and MacCormack transport written out in autograd.numpy: slow, on its own."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
from autograd.tracer import getval

from sparsedp.autodiff.derivative import pullback, pushforward


def look(u, places, sides, inflow, cubic=False):
    """Values of u between its points. sides: "wrap", "edge" or "in" for each axis; inflow a number."""
    axes = [_weights(p, n, side, cubic) for p, n, side in zip(places, u.shape, sides)]
    total = 0.0
    for corner in product(*(range(len(weights)) for _, weights in axes)):
        share = 1.0
        index = []
        inside = True
        for (first, weights), k, n, side in zip(axes, corner, u.shape, sides):
            i = first + k
            share = share * weights[k]
            index.append(i % n if side == "wrap" else np.clip(i, 0, n - 1))
            inside = inside & ((side != "in") | ((i >= 0) & (i < n)))
        inside = 1.0 * np.array(inside)
        total = total + share * (inside * u[tuple(index)] + (1 - inside) * inflow)
    return total


def _weights(p, n, side, cubic):
    if side == "wrap":
        p = p - n * np.floor(getval(p) / n)
    else:
        p = anp.clip(p, -1.5, n + 0.5) if not cubic else anp.clip(p, -2.0, n + 1.0)
    i = np.floor(getval(p)).astype(int)
    t = p - i
    if not cubic:
        return i, (1 - t, t)
    return i - 1, (
        (-t + 2 * t**2 - t**3) / 2,
        (2 - 5 * t**2 + 3 * t**3) / 2,
        (t + 4 * t**2 - 3 * t**3) / 2,
        (-(t**2) + t**3) / 2,
    )


def cell(u, places, sides, inflow):
    """The samples around places, one array for each corner of the cell."""
    found = []
    for corner in product((0, 1), repeat=len(places)):
        index = [np.floor(_plain(p, n, s)).astype(int) + k for p, k, n, s in zip(places, corner, u.shape, sides)]
        found.append(look(u, [1.0 * i for i in index], sides, inflow))
    return found


def _plain(p, n, side):
    p = getval(p)
    if side == "wrap":
        return p - n * np.floor(p / n)
    return np.clip(p, -1.5, n + 0.5)


def down(part, axis, wraps):
    """Return the mean of neighbours along an axis, from faces to cells."""
    if wraps:
        return 0.5 * (part + anp.roll(part, -1, axis))
    n = part.shape[axis] - 1
    return 0.5 * (_cut(part, axis, 0, n) + _cut(part, axis, 1, n + 1))


def up(part, axis, wraps, widths):
    """Interpolate along an axis from cells to faces; at a wall the only cell counts."""
    n = part.shape[axis]
    line = [-1 if a == axis else 1 for a in range(part.ndim)]
    if wraps:
        before = np.roll(widths, 1)
        after = widths
        lower = anp.roll(part, 1, axis)
        upper = part
    else:
        before = np.append(widths[:1], widths)
        after = np.append(widths, widths[-1:])
        lower = anp.concatenate([_cut(part, axis, 0, 1), part], axis)
        upper = anp.concatenate([part, _cut(part, axis, n - 1, n)], axis)
    before = before.reshape(line)
    after = after.reshape(line)
    return (after * lower + before * upper) / (before + after)


def _cut(part, axis, start, stop):
    return part[(slice(None),) * axis + (slice(start, stop),)]


def speeds(move, v):
    """For each component of the field the velocity at its points, one array for each axis."""
    setting = move.settings
    grid = setting.grid
    parts = grid.split(v) if setting.velocity == "faces" else [v[a] for a in range(grid.dim)]
    if setting.of == "cells":
        if setting.velocity == "faces":
            parts = [down(p, a, grid.periodic[a]) for a, p in enumerate(parts)]
        return [parts]
    found = []
    for own in range(grid.dim):
        line = []
        for axis, part in enumerate(parts):
            if setting.velocity == "faces" and axis == own:
                line.append(part)
                continue
            if setting.velocity == "faces":
                part = down(part, axis, grid.periodic[axis])
            line.append(up(part, own, grid.periodic[own], grid.widths[own]))
        found.append(line)
    return found


def moved(move, u, v, dt, inflow):
    """The whole step; inflow a number."""
    setting = move.settings
    grid = setting.grid
    parts = [u] if setting.of == "cells" else grid.split(u)
    letters = ["wrap" if pair is None else "edge" if repr(pair[0]) == "neumann" else "in" for pair in setting.sides]
    results = [
        _component(move, part, w, _lines(grid, setting.of == "faces" and own), dt, letters, inflow)
        for own, (part, w) in enumerate(zip(parts, speeds(move, v)))
    ]
    if setting.of == "cells":
        return results[0]
    return grid.join(*results)


def _lines(grid, own):
    """For each axis what lies at the points -3 ... n + 2, the end cells repeated. own: the axis of faces, or False."""
    found = []
    for axis, (h, wraps) in enumerate(zip(grid.widths, grid.periodic)):
        wide = np.pad(h, 4, mode="wrap" if wraps else "edge")
        nodes = np.cumsum(wide) - wide - np.sum(wide[:4])
        on_faces = own is not False and axis == own
        line = nodes[1:] if on_faces else (nodes + 0.5 * wide)[1:-1]
        found.append(line[:-1] if on_faces and wraps else line)
    return found


def number(line, x, cubic, period):
    """Where among the points a place lies: the inverse of the curve through them, by bisection and a Newton step."""
    n = line.size - 6
    turns = 0.0
    if period:
        turns = np.floor((getval(x) - line[3]) / period)
        x = x - turns * period
    numbers = np.arange(-3.0, n + 3)
    if not cubic:
        i = np.clip(np.searchsorted(line, getval(x), "right") - 1, 0, line.size - 2)
        return numbers[i] + (x - line[i]) / (line[i + 1] - line[i]) + turns * n

    def curve(q):
        i = np.clip(np.floor(q).astype(int) + 3, 1, line.size - 3)
        t = q - numbers[i]
        a, b, c, d = (line[i + k] for k in (-1, 0, 1, 2))
        steep = (c - a) / 2, (2 * a - 5 * b + 4 * c - d) / 2, (3 * b - a - 3 * c + d) / 2
        return b + t * (steep[0] + t * (steep[1] + t * steep[2])), steep[0] + t * (2 * steep[1] + 3 * t * steep[2])

    low = np.full(np.shape(x), -2.0)
    high = np.full(np.shape(x), n + 1.0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = curve(middle)[0] > getval(x)
        low = np.where(above, low, middle)
        high = np.where(above, middle, high)
    value, slope = curve(low)
    return low + (x - value) / slope + turns * n


def _component(move, u, w, lines, dt, sides, inflow):
    setting = move.settings
    cubic = setting.interpolation == "cubic"
    midpoint = setting.backtrace == "midpoint"
    at = np.meshgrid(*(line[3 : 3 + n] for line, n in zip(lines, u.shape)), indexing="ij")
    periods = [np.sum(h) if side == "wrap" else None for h, side in zip(setting.grid.widths, sides)]

    def back(speed, step, curved):
        return [number(line, x - step * s, curved, p) for line, x, s, p in zip(lines, at, speed, periods)]

    def places(sign):
        used = w
        if midpoint:
            half = back(w, 0.5 * sign * dt, False)
            closed = ["wrap" if side == "wrap" else "edge" for side in sides]
            used = [look(x, half, closed, 0.0) for x in w]
        return back(used, sign * dt, cubic)

    there = places(1.0)
    f = look(u, there, sides, inflow, cubic)
    if setting.scheme == "semi_lagrangian":
        return f
    new = f + 0.5 * (u - look(f, places(-1.0), sides, inflow, cubic))
    if not setting.clamp:
        return new
    low = high = None
    for value in cell(u, there, sides, inflow):
        low = value if low is None else anp.minimum(low, value)
        high = value if high is None else anp.maximum(high, value)
    return anp.minimum(anp.maximum(new, low), high)


def against_twin(move, point, share):
    """Assert that value and cotangents of a transport are those of its twin, and that its tangent fits them."""
    step = move._rule  # move itself refuses an inflow that no side uses
    value, pull = pullback(lambda x: step(*x), point)
    wanted, wanted_pull = pullback(lambda x: moved(move, *x), point)
    assert value == pytest.approx(wanted, rel=share, abs=share)
    g = np.random.default_rng(6).standard_normal(value.shape)
    back = pull(g)
    for mine, twin in zip(back, wanted_pull(g)):
        assert mine == pytest.approx(twin, rel=10 * share, abs=10 * share)
    rng = np.random.default_rng(7)
    along = tuple(rng.standard_normal(np.shape(x)) if np.ndim(x) else 0.3 for x in point)
    tangent = pushforward(lambda x: step(*x), point, along)[1]
    forward = np.sum(g * tangent)
    backward = sum(np.sum(a * b) for a, b in zip(back, along))
    assert abs(forward - backward) <= 1e-12 * (1 + abs(forward))
