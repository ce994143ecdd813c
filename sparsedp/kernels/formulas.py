"""The formulas of upwind transport for one point: from streams of numbers to streams and sums.

For axis a: `um`, `up` the field below and above, `wl`, `wu` the velocity on the interfaces below and above,
`r` = dt / width (`rm`, `rp` that of the points below and above), `g` the cotangent. A point owns the
interface below it: the cotangent of its velocity goes to `gw`. See `sparsedp.advection.upwind`.

The weight of the point itself is 1 - d, and d is summed up first: with a CFL number of exactly 1 the weight is 0
and the step an exact shift.
"""

from functools import reduce
from operator import add
from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "ADVECTIVE",
    "BOTH",
    "BOTH_ADDED",
    "FIELD",
    "FLUX",
    "FORMULAS",
    "FORWARD",
    "POINTS",
    "VELOCITY",
    "VELOCITY_ADDED",
    "number_of",
    "parts",
    "spoiled",
    "streams_of",
]

ROUNDING = 8 * np.finfo(float).eps  # a CFL number of exactly 1 leaves a weight of about -1e-16
FLUX, ADVECTIVE, POINTS = range(3)
FORWARD, FIELD, VELOCITY, BOTH, VELOCITY_ADDED, BOTH_ADDED = range(6)  # added: to what is in gw already


class Stream(NamedTuple):
    """One stream of a formula."""

    name: str
    read: bool = True
    write: bool = False
    fixed: bool = False  # one number for the whole segment


class Formula(NamedTuple):
    """streams, body(given) -> (dict of results, tuple of sums), and the number of sums."""

    streams: tuple
    body: Any
    sums: int


def number_of(dim, mode, task):
    """Place in FORMULAS."""
    return ((dim - 1) * 3 + mode) * 6 + task


def streams_of(dim, mode, task):
    """Streams of one formula, in the order of a row of the table."""
    found = [Stream("u")]
    if task == FORWARD:
        found += [Stream("out", False, True)]
        names = ["um", "up", "cl", "cu"] if mode == POINTS else ["um", "up", "wl", "wu"]
        factors = ["rl", "ru"] if mode == POINTS else ["r"]
    else:
        found += [Stream("g")] + ([] if task in (VELOCITY, VELOCITY_ADDED) else [Stream("gu", False, True)])
        names = ["gm", "gp", "um", "wl", "wu"]
        if mode == POINTS:
            names = ["gm", "gp", "um", "up", "c", "cl", "cu", "cm", "cp"]
        factors = ["rl", "ru"] if mode == POINTS else ["r", "rm", "rp"]
    for axis in range(dim):
        found += [Stream(f"{name}{axis}") for name in names]
        found += [Stream(f"{name}{axis}", fixed=axis < dim - 1) for name in factors]
        if task not in (FORWARD, FIELD):
            found += [Stream(f"gw{axis}", task >= VELOCITY_ADDED, True)]
    return tuple(found)


def parts(w):
    """max(w, 0), min(w, 0) and the derivative of the first; NaN and infinity stay what they are."""
    step = w.step()
    positive = w * step
    return positive, w - positive, step


def spoiled(values):
    """0, or NaN where one of the values is NaN or infinite."""
    return reduce(add, [value - value for value in values])


def _forward(dim, mode):
    def body(s):
        u, leaves, enters = s["u"], [], []
        for a in range(dim):
            low, high = (s[f"{'c' if mode == POINTS else 'w'}{side}{a}"] for side in "lu")
            (pl, ml, _), (pu, mu, _) = parts(low), parts(high)
            rl, ru = (s[f"rl{a}"], s[f"ru{a}"]) if mode == POINTS else (s[f"r{a}"],) * 2
            pl, mu = rl * pl, ru * mu
            out = ru * pu - rl * ml if mode == FLUX else pl - mu
            into = pl * s[f"um{a}"] - mu * s[f"up{a}"]
            leaves.append(out)
            enters.append(into)
        weight = reduce(add, leaves) * -1.0 + 1.0
        new = weight * u + reduce(add, enters)
        return {"out": new}, (weight.short_of(-ROUNDING) + new.infinite(),)

    return body


def _pull(dim, mode, task):
    axis_of = {FLUX: _pull_flux, ADVECTIVE: _pull_advective, POINTS: _pull_points}[mode]
    stored = [stream.name for stream in streams_of(dim, mode, task) if stream.write]

    def body(s):
        found, gu, totals = {}, s["g"], []
        for a in range(dim):
            to_u, to_w, to_dt = axis_of({k[:-1]: x for k, x in s.items() if k[-1] == str(a)}, s["u"], s["g"])
            gu = gu + to_u
            totals.append(to_dt)
            found[f"gw{a}"] = s[f"gw{a}"] + to_w if task >= VELOCITY_ADDED else to_w
        found["gu"] = gu
        return found, (reduce(add, totals), spoiled([found[name] for name in stored]))

    return body


def _pull_flux(s, u, g):
    own = s["r"] * g
    low, high = own - s["rm"] * s["gm"], s["rp"] * s["gp"] - own
    pl, ml, step = parts(s["wl"])
    pu, _, _ = parts(s["wu"])
    upwind = u + step * (s["um"] - u)
    return pu * high + ml * low, low * upwind, low * (pl * s["um"] + ml * u)


def _pull_advective(s, u, g):
    own, below, above = s["r"] * g, s["rm"] * s["gm"], s["rp"] * s["gp"]
    pl, ml, step = parts(s["wl"])
    pu, mu, _ = parts(s["wu"])
    low, high = pl * own + ml * below, pu * above + mu * own
    down = s["um"] - u
    return high - low, down * (below + step * (own - below)), down * low


def _pull_points(s, u, g):
    (pl, _, _), (_, mu, _) = parts(s["cl"]), parts(s["cu"])
    _, m, _ = parts(s["cm"])
    p, _, _ = parts(s["cp"])
    low, high = s["rl"] * (pl * g + m * s["gm"]), s["ru"] * (p * s["gp"] + mu * g)
    step = s["c"].step()
    down, up = s["rl"] * (s["um"] - u), s["ru"] * (u - s["up"])
    return high - low, g * (up + step * (down - up)), g * (pl * down + mu * up)


def _formula(dim, mode, task):
    body = _forward(dim, mode) if task == FORWARD else _pull(dim, mode, task)
    return Formula(streams_of(dim, mode, task), body, 1 if task == FORWARD else 2)


FORMULAS = [_formula(dim, mode, task) for dim in (1, 2, 3) for mode in range(3) for task in range(6)]
