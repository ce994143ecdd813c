"""The formulas of van Leer transport for one point; see `formulas` for the names and `sparsedp.advection.van_leer`.

`s` is the limited difference from a point to its face (`sm`, `sp` of the points below and above), `c` and `e`
the distances to both neighbours over half the width. A stage is R = dt L(u). Its cotangent goes to the field directly
and through the slopes: `a` and `b` are what each slope hands on to the differences A and B.
"""

from functools import reduce
from operator import add

from sparsedp.kernels.formulas import ADVECTIVE, FLUX, FORMULAS, POINTS, ROUNDING, Formula, Stream, parts

__all__ = ["FIRST", "FORMULAS", "JUMPS", "PULL", "PULL_ADDED", "SECOND", "SLOPES", "limited_number", "limited_streams"]

SLOPES, FIRST, SECOND, PULL, PULL_ADDED, JUMPS = range(6)
START = len(FORMULAS)


def limited_number(dim, mode, task):
    """Place in FORMULAS; slopes and jumps are the same in all modes."""
    return START + ((dim - 1) * 3 + (FLUX if task in (SLOPES, JUMPS) else mode)) * 6 + task


def limited_streams(dim, mode, task):
    """Streams of one formula."""
    found, speeds = [Stream("u")], ["c", "cl", "cu"] if mode == POINTS else ["wl", "wu"]
    if task == JUMPS:
        found = [Stream("gu", True, True)]
    elif task in (PULL, PULL_ADDED):
        found += [Stream("g"), Stream("gu", False, True)]
    elif task != SLOPES:
        found += [Stream("out", False, True)] + ([Stream("u0")] if task == SECOND else [])
    for a in range(dim):
        names = {SLOPES: ["um", "up", "ratio", "ahead"], JUMPS: ["al", "bu", "ap", "bm"]}.get(task)
        names = names or ["um", "up", "sm", "s", "sp", *speeds]
        if task in (PULL, PULL_ADDED):
            names = [*names, "gm", "gp", "ratio", "ahead"] + (["cm", "cp"] if mode == POINTS else [])
            found += [Stream(f"{name}{a}", False, True) for name in "ab"]
            found += [Stream(f"gw{a}", task == PULL_ADDED, True)]
        found += [Stream(f"{name}{a}", fixed=name in ("ratio", "ahead") and a < dim - 1) for name in names]
        if task == SLOPES:
            found += [Stream(f"s{a}", False, True)]
        elif task != JUMPS:
            factors = ["r", "rm", "rp"] if task in (PULL, PULL_ADDED) else ["r"]
            found += [Stream(f"{name}{a}", fixed=a < dim - 1) for name in factors]
    return tuple(found)


def _axis(s, a):
    return {name[:-1]: value for name, value in s.items() if name[-1] == str(a)}


def _share(a, b, c, e):
    """1 where A and B agree in sign, else 0; A + B, q, R and what its slope needs."""
    same = a.above() * b.above() + (a * -1.0).above() * (b * -1.0).above()
    other = same * -1.0 + 1.0
    a, b = a * same + other, b * same + other
    both = a + b
    q, p = a / both, b / both
    cc, ee, mixed = c * c, e * e, (c + e - 2.0) * c * e
    top = q * p * (q * ee + p * cc)
    under = q * q * ee + mixed * q * p + p * p * cc
    return same, both, q, p, top / under, under, cc, ee, mixed


def _slopes(dim):
    def body(s):
        found = {}
        for a in range(dim):
            x = _axis(s, a)
            same, both, _, _, ratio, *_ = _share(s["u"] - x["um"], x["up"] - s["u"], x["ratio"], x["ahead"])
            found[f"s{a}"] = same * (both * ratio)
        return found, (s["u"] * 0.0,)

    return body


def _hands_on(u, x):
    """ds/dA and ds/dB; where one of A, B is 0 the mean of both sides."""
    a, b = u - x["um"], x["up"] - u
    same, _, q, p, ratio, under, cc, ee, mixed = _share(a, b, x["ratio"], x["ahead"])
    slope = ee * (q * 2.0 - q * q * 3.0) + cc * (p * p - q * p * 2.0)
    slope = (slope - ratio * (q * ee * 2.0 + mixed * (p - q) - p * cc * 2.0)) / under
    zero_a, zero_b = a.zero(), b.zero()
    da = same * (ratio + p * slope) + zero_a * (zero_b * -1.0 + 1.0) * 0.5
    db = same * (ratio - q * slope) + zero_b * (zero_a * -1.0 + 1.0) * 0.5
    return da, db


def _values(u, x):
    """From below and above at the interface below, then at the one above."""
    return x["um"] + x["sm"], u - x["s"], u + x["s"], x["up"] - x["sp"]


def _rate(u, x, mode):
    """R along one axis, and what leaves the point in units of its own content."""
    low, high = (x["c"], x["c"]) if mode == POINTS else (x["wl"], x["wu"])
    (pl, ml, _), (pu, mu, _) = parts(low), parts(high)
    below_low, above_low, below_high, above_high = _values(u, x)
    rate = x["r"] * (pl * below_low + ml * above_low - (pu * below_high + mu * above_high))
    if mode == ADVECTIVE:
        rate = rate + u * (x["r"] * (high - low))
    if mode == POINTS:
        (pl, _, _), (_, mu, _) = parts(x["cl"]), parts(x["cu"])
    return rate, x["r"] * (pu - ml) if mode == FLUX else x["r"] * (pl - mu)


def _stage(dim, mode, task):
    def body(s):
        u = s["u"]
        along = [_rate(u, _axis(s, a), mode) for a in range(dim)]
        new = u + reduce(add, [rate for rate, _ in along])
        if task == SECOND:
            new = s["u0"] * 0.5 + new * 0.5
            return {"out": new}, (new.infinite(),)
        leaves = reduce(add, [out for _, out in along])
        return {"out": new}, ((leaves * -1.0 + 0.5).short_of(-ROUNDING) + new.infinite(),)

    return body


def _pull(dim, mode, task):
    axis_of = _pull_points if mode == POINTS else _pull_faces

    def body(s):
        found, gu, totals = {}, s["g"], []
        for a in range(dim):
            x = _axis(s, a)
            to_u, to_s, to_w, to_dt = axis_of(s["u"], s["g"], x, mode)
            da, db = _hands_on(s["u"], x)
            found[f"a{a}"], found[f"b{a}"] = da * to_s, db * to_s
            found[f"gw{a}"] = x["gw"] + to_w if task == PULL_ADDED else to_w
            gu = gu + to_u
            totals.append(to_dt)
        found["gu"] = gu
        return found, (reduce(add, totals),)

    return body


def _pull_faces(u, g, x, mode):
    own, below, above = x["r"] * g, x["rm"] * x["gm"], x["rp"] * x["gp"]
    low, high = own - below, above - own
    (pl, ml, step), (pu, _, _) = parts(x["wl"]), parts(x["wu"])
    from_below, from_above, _, _ = _values(u, x)
    to_w = low * (from_above + step * (from_below - from_above))
    to_u, to_s, to_dt = pu * high + ml * low, pu * high - ml * low, low * (pl * from_below + ml * from_above)
    if mode == ADVECTIVE:
        spread = own * (x["wu"] - x["wl"])
        to_w, to_u, to_dt = to_w + below * x["um"] - own * u, to_u + spread, to_dt + u * spread
    return to_u, to_s, to_w, to_dt


def _pull_points(u, g, x, mode):
    own = x["r"] * g
    (pl, _, _), (_, mu, _) = parts(x["cl"]), parts(x["cu"])
    from_above, from_below = x["rp"] * x["gp"] * parts(x["cp"])[0], x["rm"] * x["gm"] * parts(x["cm"])[1]
    below_low, above_low, below_high, above_high = _values(u, x)
    behind, ahead = below_high - below_low, above_high - above_low
    p, m, step = parts(x["c"])
    to_u = from_above - from_below - own * (pl - mu)
    to_s = from_above + from_below - own * (p + m)
    return to_u, to_s, own * -1.0 * (ahead + step * (behind - ahead)), own * -1.0 * (p * behind + m * ahead)


def _jumps(dim):
    def body(s):
        new = s["gu"]
        for a in range(dim):
            x = _axis(s, a)
            new = new + (x["al"] - x["bu"]) + (x["bm"] - x["ap"])
        return {"gu": new}, (s["gu"] * 0.0,)

    return body


def _formula(dim, mode, task):
    bodies = {SLOPES: _slopes, JUMPS: _jumps}
    if task in bodies:
        body = bodies[task](dim)
    else:
        body = (_stage if task in (FIRST, SECOND) else _pull)(dim, mode, task)
    return Formula(limited_streams(dim, mode, task), body, 1)


FORMULAS += [_formula(dim, mode, task) for dim in (1, 2, 3) for mode in range(3) for task in range(6)]
