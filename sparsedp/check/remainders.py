"""The Taylor gates along one direction: how fast the remainders fall with the step.

R1(t), the size of f(x +- t d) - f without the gradient, must fall like t; R2(t), that of
f(x +- t d) - f -+ t g . d, like t^2 or faster. Each is the root mean square over both signs, so that
the t^2 and t^3 parts of a smooth loss cannot cancel.
"""

from typing import NamedTuple

import numpy as np

__all__ = ["CLEAR", "FEWEST", "FIRST", "SECOND", "Taylor", "rates", "taylor"]

FIRST = 0.05  # order 1 is 1 to within this
SECOND = 1.95  # the least order with the gradient
FEWEST = 3  # usable levels
CLEAR = 100.0  # a usable remainder stands this far above the noise: the noise then moves an order by 0.03 at most
LINEAR = 5.0  # a level serves for order 1 where t |g . d| is this often the even part: it moves it by 0.03 at most
NEARBY = 70.0  # levels up to this multiple of the step of the plateau: coarser ones are no limit t -> 0
APART = 4.0  # least ratio of the two steps of a pair
MOST = 5  # usable levels that are read, the finest ones


class Taylor(NamedTuple):
    """Orders of the remainders along one direction, and what they prove.

    word: "" when no gate is missed, "rough" when an order is wrong, "few" when too few levels are usable.
    """

    rate1: float  # the order without the gradient that is farthest from 1; NaN when not judged
    rate2: float  # the lowest order with the gradient; infinite when the remainder is noise on all levels
    word: str
    note: str


def taylor(gaps, slope, gap, index, sharp):
    """Gaps of a line whose gradient agrees -> Taylor.

    Usable for order 2: levels near the plateau with R2 >= CLEAR (noise + t |gap|), the MOST finest ones.
    At least FEWEST, and every pair >= SECOND. Where they are fewer, the even part of R2 is judged, which
    no gap can hide, and then the same on all levels; with no usable level at all the loss is linear to
    its noise, and there is no order to judge. Usable for order 1: R1 >= CLEAR noise, and t |g . d| >= LINEAR times the
    even part (f(x + t d) + f(x - t d)) / 2 - f. Where the slope is so small that f bends before it climbs
    (near a minimum), order 1 cannot be 1: the direction is flat and order 1 is not judged. So it is where
    neither the loss nor t g . d ever leaves the noise (the kernel of a Laplacian), if the sweep is `sharp`:
    gap and bar far below the terms of g . d.
    """
    near = gaps.t <= NEARBY * gaps.t[index]
    rates2 = _second(gaps, gap, near)
    seen = near & (gaps.first >= CLEAR * gaps.noise)
    climbs = np.abs(slope) * gaps.t >= LINEAR * np.abs(gaps.kinks * gaps.t) / 2
    rates1 = rates(gaps.t, gaps.first, seen & climbs)
    still = sharp and not np.any(seen) and bool(np.all(np.abs(slope) * gaps.t < CLEAR * gaps.noise))
    flat = rates1.used < FEWEST and (still or bool(np.any(seen & ~climbs)))
    rate1 = max(rates1.orders, key=lambda rate: abs(rate - 1), default=np.nan)
    rate2 = np.inf if not rates2.used else min(rates2.orders, default=np.nan)
    return Taylor(rate1, rate2, *_gates(rates1, rates2, flat, rate1, rate2))


def _second(gaps, gap, near):
    even = np.abs(gaps.kinks * gaps.t) / 2
    whole = gaps.second >= CLEAR * (gaps.noise + gaps.t * abs(gap))
    found = []
    for place in (near, np.ones_like(near)):
        found.append(rates(gaps.t, gaps.second, place & whole))
        found.append(rates(gaps.t, even, place & (even >= CLEAR * gaps.noise)))
    return next((rates for rates in found if rates.used >= FEWEST), max(found, key=lambda rates: rates.used))


def _gates(rates1, rates2, flat, rate1, rate2):
    if rates2.used >= FEWEST and not rate2 >= SECOND:
        return "rough", f"the second Taylor remainder is of order {rate2:.2f}: not twice differentiable here"
    if rates1.used >= FEWEST and not abs(rate1 - 1) <= FIRST:
        return "rough", f"the loss changes with order {rate1:.2f} in the step, not 1"
    if 0 < rates2.used < FEWEST:
        return "few", f"the second Taylor remainder stands out of the noise on {rates2.used} steps, {FEWEST} are needed"
    if rates1.used < FEWEST and not flat:
        return "few", f"the change of the loss stands out of the noise on {rates1.used} steps, {FEWEST} are needed"
    return "", "flat: there is no climb to judge order 1 by" if flat else ""


class _Rates(NamedTuple):
    used: int
    orders: list


def rates(t, remainder, usable):
    """Orders of the finest usable levels; the two levels of a pair are at least a factor APART."""
    levels = np.flatnonzero(usable)[-MOST:]
    orders = []
    for place, coarse in enumerate(levels):
        fine = next((j for j in levels[place + 1 :] if t[coarse] >= APART * t[j]), None)
        if fine is not None:
            orders.append(float(np.log(remainder[coarse] / remainder[fine]) / np.log(t[coarse] / t[fine])))
    return _Rates(len(levels), orders)
