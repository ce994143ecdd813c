"""The formulas of van Leer transport for one point; see `formulas` for the names and `sparsedp.advection.van_leer`.

`s` is the limited difference from a point to its face (`sm`, `sp` of the points below and above), `c` and `e`
the distances to both neighbours over half the width. A stage is R = dt L(u). Its cotangent goes to the field directly
and through the slopes: `a` and `b` are what each slope hands on to the differences A and B. They stand where
ds/dA and ds/dB stood, `da` and `db`, which are found together with the slopes.
"""

from functools import reduce
from operator import add

from sparsedp.kernels.formulas import ADVECTIVE, FLUX, FORMULAS, POINTS, ROUNDING, Formula, Stream, parts, spoiled

__all__ = ["FIRST", "FORMULAS", "JUMPS", "LAST", "PULL", "PULL_ADDED", "SECOND", "SLOPES", "STEEP"]
__all__ += ["limited_number", "limited_streams"]

SLOPES, STEEP, FIRST, SECOND, PULL, PULL_ADDED, JUMPS, LAST = range(
    8
)  # jumps: less half of g; the last ones: and half of g
SHARED = SLOPES, STEEP, JUMPS, LAST
START = len(FORMULAS)


def limited_number(dim, mode, task):
    """Place in FORMULAS; slopes and jumps are the same in all modes."""
    return START + ((dim - 1) * 3 + (FLUX if task in SHARED else mode)) * 8 + task


def limited_streams(dim, mode, task):
    """Streams of one formula."""
    found, speeds = [Stream("u")], ["c", "cl", "cu"] if mode == POINTS else ["wl", "wu"]
    if task in (JUMPS, LAST):
        found = [Stream("gu", True, True), Stream("g")]
    elif task in (PULL, PULL_ADDED):
        found += [Stream("g"), Stream("gu", False, True)]
    elif task not in (SLOPES, STEEP):
        found += [Stream("out", False, True)] + ([Stream("u0")] if task == SECOND else [])
    for a in range(dim):
        names = ["um", "up", "sm", "s", "sp", *speeds]
        if task in SHARED:
            names = ["um", "up", "ratio", "ahead"] if task in (SLOPES, STEEP) else ["al", "bu", "ap", "bm"]
        if task in (PULL, PULL_ADDED):
            names = [*names, "gm", "gp", "da", "db"] + (["cm", "cp"] if mode == POINTS else [])
            found += [Stream(f"gw{a}", task == PULL_ADDED, True)]
        if task in (PULL, PULL_ADDED, STEEP):
            found += [Stream(f"{name}{a}", False, True) for name in "ab"]
        found += [Stream(f"{name}{a}", fixed=name in ("ratio", "ahead") and a < dim - 1) for name in names]
        if task in (SLOPES, STEEP):
            found += [Stream(f"s{a}", False, True)]
        elif task not in SHARED:
            factors = ["r", "rm", "rp"] if task in (PULL, PULL_ADDED) else ["r"]
            found += [Stream(f"{name}{a}", fixed=a < dim - 1) for name in factors]
    return tuple(found)


def _axis(s, a):
    return {name[:-1]: value for name, value in s.items() if name[-1] == str(a)}


class _Share:
    """What s and its derivatives have in common; with E = q e^2, C = p c^2, p = 1 - q, m = (c + e - 2) c e

    R = N / D,   N = q p (E + C),   D = q E + m q p + p C,   s = (A + B) R,
    ds/dA = (p (2 E + C) - R (2 E + m p)) / D,   ds/dB = (q (E + 2 C) - R (2 C + m q)) / D.
    """

    def __init__(self, u, x):
        self.a, self.b, c, e = u - x["um"], x["up"] - u, x["ratio"], x["ahead"]
        self.same = same = self.a.alike(self.b)
        mine = self.a * same
        self.both = mine + (self.b * same + (same * -1.0 + 1.0))  # not 0
        self.q = q = mine / self.both
        self.p = p = q * -1.0 + 1.0
        ce = c * e
        mixed = (c + e) * ce - ce * 2.0
        self.ahead, self.behind, self.of_p, self.of_q = q * (e * e), p * (c * c), mixed * p, mixed * q
        under = q * (self.ahead + self.of_p) + p * self.behind
        self.inverse = (under * 0.0 + 1.0) / under  # divisions take most of the time
        self.ratio = q * p * (self.ahead + self.behind) * self.inverse

    def slope(self):
        """s, and 0 where A and B differ in sign."""
        return self.both * self.ratio

    def steepness(self):
        """ds/dA and ds/dB; where one of A, B is 0 the mean of both sides."""
        ahead, behind, zero_a, zero_b = self.ahead * 2.0, self.behind * 2.0, self.a.zero(), self.b.zero()
        da = self.p * (ahead + self.behind) - self.ratio * (ahead + self.of_p)
        db = self.q * (self.ahead + behind) - self.ratio * (behind + self.of_q)
        scale, none = self.same * self.inverse, zero_a * zero_b
        return da * scale + (zero_a - none) * 0.5, db * scale + (zero_b - none) * 0.5


def _slopes(dim, steep):
    def body(s):
        found = {}
        for a in range(dim):
            share = _Share(s["u"], _axis(s, a))
            found[f"s{a}"] = share.slope()
            if steep:
                found[f"a{a}"], found[f"b{a}"] = share.steepness()
        return found, (s["u"] * 0.0,)

    return body


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
            found[f"a{a}"], found[f"b{a}"] = x["da"] * to_s, x["db"] * to_s
            found[f"gw{a}"] = x["gw"] + to_w if task == PULL_ADDED else to_w
            gu = gu + to_u
            totals.append(to_dt)
        found["gu"] = gu
        return found, (reduce(add, totals), spoiled([found[f"gw{a}"] for a in range(dim)]))

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


def _jumps(dim, last):
    def body(s):
        new = s["gu"] + s["g"] * (0.5 if last else -0.5)
        for a in range(dim):
            x = _axis(s, a)
            new = new + (x["al"] - x["bu"]) + (x["bm"] - x["ap"])
        return {"gu": new}, (spoiled([new]),)

    return body


def _formula(dim, mode, task):
    if task in (SLOPES, STEEP):
        body = _slopes(dim, task == STEEP)
    elif task in (JUMPS, LAST):
        body = _jumps(dim, task == LAST)
    else:
        body = (_stage if task in (FIRST, SECOND) else _pull)(dim, mode, task)
    return Formula(limited_streams(dim, mode, task), body, 2 if task in (PULL, PULL_ADDED) else 1)


FORMULAS += [_formula(dim, mode, task) for dim in (1, 2, 3) for mode in range(3) for task in range(8)]
