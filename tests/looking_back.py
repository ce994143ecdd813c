"""Semi-Lagrangian and MacCormack transport written out in autograd.numpy: slow, on its own."""

from itertools import product

import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval


def look(u, places, sides, inflow, cubic=False):
    """Values of u between its points. sides: "wrap", "edge" or "in" for each axis; inflow a number."""
    axes = [_weights(p, n, side, cubic) for p, n, side in zip(places, u.shape, sides)]
    total = 0.0
    for corner in product(*(range(len(weights)) for _, weights in axes)):
        share, index, inside = 1.0, [], True
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
    return p - n * np.floor(p / n) if side == "wrap" else np.clip(p, -1.5, n + 0.5)


def down(part, axis, wraps):
    """Mean of neighbours along an axis: faces -> cells."""
    if wraps:
        return 0.5 * (part + anp.roll(part, -1, axis))
    n = part.shape[axis] - 1
    return 0.5 * (_cut(part, axis, 0, n) + _cut(part, axis, 1, n + 1))


def up(part, axis, wraps):
    """Mean of neighbours along an axis: cells -> faces, at a wall the only cell."""
    if wraps:
        return 0.5 * (part + anp.roll(part, 1, axis))
    n = part.shape[axis]
    first, last = _cut(part, axis, 0, 1), _cut(part, axis, n - 1, n)
    return 0.5 * (anp.concatenate([first, part], axis) + anp.concatenate([part, last], axis))


def _cut(part, axis, start, stop):
    return part[(slice(None),) * axis + (slice(start, stop),)]


def speeds(move, v):
    """For each component of the field the velocity at its points, one array for each axis."""
    setting = move.setting
    grid = setting.grid
    parts = grid.split(v) if setting.velocity == "faces" else [v[a] for a in range(grid.dim)]
    if setting.of == "cells":
        on_faces = setting.velocity == "faces"
        return [[down(p, a, grid.periodic[a]) if on_faces else p for a, p in enumerate(parts)]]
    found = []
    for own in range(grid.dim):
        line = []
        for axis, part in enumerate(parts):
            if setting.velocity == "faces" and axis == own:
                line.append(part)
                continue
            part = down(part, axis, grid.periodic[axis]) if setting.velocity == "faces" else part
            line.append(up(part, own, grid.periodic[own]))
        found.append(line)
    return found


def moved(move, u, v, dt, inflow):
    """The whole step; inflow a number."""
    setting = move.setting
    grid = setting.grid
    parts = [u] if setting.of == "cells" else grid.split(u)
    letters = ["wrap" if pair is None else "edge" if repr(pair[0]) == "neumann" else "in" for pair in setting.sides]
    step = [dt / widths[0] for widths in grid.widths]
    results = [_component(move, part, w, step, letters, inflow) for part, w in zip(parts, speeds(move, v))]
    return results[0] if setting.of == "cells" else grid.join(*results)


def _component(move, u, w, step, sides, inflow):
    setting = move.setting
    cubic, midpoint = setting.interpolation == "cubic", setting.form.endswith("midpoint")
    own = np.meshgrid(*(np.arange(n) for n in u.shape), indexing="ij")

    def places(sign):
        used = w
        if midpoint:
            half = [i - 0.5 * sign * s * x for i, s, x in zip(own, step, w)]
            closed = ["wrap" if side == "wrap" else "edge" for side in sides]
            used = [look(x, half, closed, 0.0) for x in w]
        return [i - sign * s * x for i, s, x in zip(own, step, used)]

    there = places(1.0)
    f = look(u, there, sides, inflow, cubic)
    if setting.scheme == "semi_lagrangian":
        return f
    new = f + 0.5 * (u - look(f, places(-1.0), sides, inflow, cubic))
    if setting.form.startswith("unclamped"):
        return new
    low = high = None
    for value in cell(u, there, sides, inflow):
        low = value if low is None else anp.minimum(low, value)
        high = value if high is None else anp.maximum(high, value)
    return anp.minimum(anp.maximum(new, low), high)
