"""Other ways to a derivative beside reverse mode: forward mode, the complex step, Hessian products."""

import warnings
from typing import NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp.check.plateau import ROUNDING, Gaps
from sparsedp.check.remainders import CLEAR, FEWEST, rates
from sparsedp.check.sweep import dot
from sparsedp.derivative import NO_JVP, pullback, pushforward, value_and_grad
from sparsedp.tree import flatten

__all__ = ["Bend", "complex_step", "forward_mode", "hessian"]

TINY_STEP = 2.0**-100  # of a complex step, in units of x: its square is lost beside x
APART = 1e-10  # forward and reverse mode differ by rounding
SOLVED = 1e-6  # by more, when there are solves inside: each mode ends at its own residual
FORGIVEN = 1e3  # tolerances of the solves inside; beyond, no solve is to blame
THIRD = 2.9  # the least order with gradient and Hessian
SECOND = 2.1  # up to here an order is that of a wrong Hessian, above that of a loss without third derivatives
ODD = 0.1  # share of a remainder that changes its sign with the step: then the Hessian jumps at x
BETWEEN = 2.0 ** np.arange(-1, -21, -1)  # steps for a third order that the sweep leaves open


def forward_mode(loss, point, lines, judged):
    """Forward mode against reverse mode along the random directions, where every rule has a JVP.

    They may differ by APART of the derivative, by SOLVED where the ledger shows a solve or the loss is noisy.
    """
    worst, text, allowed = 0.0, "", max(APART, 300 * point.eps)
    for line, found in zip(lines, judged, strict=False):
        tangent = [d.astype(x.dtype) for d, x in zip(line.direction, point.values, strict=True)]
        try:
            with np.errstate(all="ignore"):
                _, slope = pushforward(loss, point.tree(), point.tree(tangent))
        except NO_JVP:
            return [("", "forward mode: not available, a rule has no JVP")]
        wanted = dot(line.gradient, tangent)
        if found.jitter > ROUNDING or line.solved:
            allowed = max(allowed, SOLVED)
        scale = max(found.scale, abs(wanted), line.typical)
        gap = 0.0 if slope == wanted else abs(float(slope) - wanted) / scale
        if not gap <= worst:
            worst, text = gap, f"{float(slope):.9g} beside {wanted:.9g} along {line.name}"
    loosest = max((line.tolerance for line in lines), default=0.0)
    if not worst <= allowed and worst <= FORGIVEN * loosest:
        reason = f"forward and reverse mode differ by {worst:.0e}, which solves to rtol {loosest:g} may leave"
        return [("open", f"{reason}; tighten them")]
    if not worst <= allowed:
        return [("disagrees", f"forward and reverse mode differ: {text}; the JVP or the VJP of a rule is wrong")]
    return [("", f"forward mode: agrees with reverse mode to {worst:.0e}")]


def complex_step(loss, point, lines, base):
    """Im f(x + i t d) / t beside g . d: exact to rounding where the code is analytic, and else only a note.

    Source: W. Squire and G. Trapp, SIAM Review 40, 1998.
    """
    worst = 0.0
    for line in lines if not any(x.dtype.kind == "c" for x in point.values) else ():
        moved = [x + 1j * TINY_STEP * d for x, d in zip(point.values, line.direction, strict=True)]
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a discarded imaginary part shows in the figure
                value = complex(loss(point.tree(moved, exact=False)))
        except Exception:  # a loss of real numbers may refuse complex ones in any way
            return []
        scale = max(abs(line.slope), line.typical)
        if value.imag == 0 or not abs(value.real - base) <= 1e-9 * abs(base) or not scale:
            return []
        worst = max(worst, abs(value.imag / TINY_STEP - line.slope) / scale)
    return [("", f"complex step: agrees to {worst:.0e}")] if lines and worst <= APART else []


# ------------------------------------------------------------ second derivatives


class Bend(NamedTuple):
    """What the Hessian product along one direction is worth.

    word: agrees, disagrees, inconclusive; None where there is no product. `rate` is the order of
    f(x + t d) - f - t g . d - t^2/2 d . H d, infinite when that is noise.
    """

    word: str | None
    value: float  # d . H d
    rate: float
    note: str


def hessian(loss, point, line, found, trials, extend):
    """d . H d by reverse mode over reverse mode, judged by the third Taylor remainder along one line.

    The gradient has its verdict without it: a pullback that uses a value it captured has a right gradient and a
    wrong Hessian.
    """
    if any(x.dtype.kind == "c" for x in point.values):
        return Bend(None, np.nan, np.nan, "Hessian product: not looked at, x is complex")
    try:
        with np.errstate(all="ignore"):
            bend = _product(loss, point, line.direction)
    except Exception as error:  # a rule, ours or not, may lack a second derivative and say so in any way
        return Bend(None, np.nan, np.nan, f"Hessian product: not available ({type(error).__name__})")
    if not np.isfinite(bend):
        return _judged("disagrees", bend, np.nan, f"it is {bend} along {line.name}")
    with np.errstate(all="ignore"):
        third = _orders(line, found, bend, trials.eps, point.eps)
        if extend and 0 < third.used < FEWEST:
            line.sweep([step for step in BETWEEN if step not in {level.step for level in line.levels}])
            third = _orders(line, found, bend, trials.eps, point.eps)
    return third.bend


def _product(loss, point, direction):
    def slope(tree):
        leaves = flatten(value_and_grad(loss)(tree)[1])[0]
        return sum(anp.sum(leaves[place] * d) for place, d in zip(point.places, direction, strict=True))

    return dot(point.leaves_of(pullback(slope, point.tree())[1](1.0)), direction)


class _Third(NamedTuple):
    used: int
    bend: Bend


def _orders(line, found, bend, eps, spread):
    """The order over the finest usable levels, those that stand out of noise, gap and the rounding of x."""
    gaps = Gaps(line, eps, spread)
    ahead, behind = (rest - gaps.t**2 / 2 * bend for rest in gaps.rests)
    remainder = np.hypot(ahead, behind) / np.sqrt(2)
    usable = remainder >= CLEAR * (gaps.noise + gaps.t * (abs(found.gap) + gaps.floor))
    usable &= np.cumsum(usable[::-1])[::-1] <= FEWEST  # the finest: coarse ones are no limit t -> 0
    used, orders = rates(gaps.t, remainder, usable)
    value = f"d.Hd = {bend:.9g} along {line.name}"
    if not used:
        return _Third(used, _judged("agrees", bend, np.inf, f"{value}, the third Taylor remainder is noise"))
    if used < FEWEST or not orders:
        few = f"the third Taylor remainder stands out of the noise on {used} steps, {FEWEST} are needed"
        return _Third(used, _judged("inconclusive", bend, np.nan, f"{value}; {few}"))
    rate = min(orders)
    last = int(np.flatnonzero(usable)[-1])
    text = f"{value}, third Taylor remainder of order {rate:.2f}"
    if rate >= THIRD:
        return _Third(used, _judged("agrees", bend, rate, text))
    if rate > SECOND or abs(ahead[last] - behind[last]) > ODD * abs(ahead[last] + behind[last]):
        return _Third(used, _judged("inconclusive", bend, rate, f"{text}: not three times differentiable"))
    off = abs(ahead[last] + behind[last]) / gaps.t[last] ** 2
    share = off / abs(bend) if bend else np.inf
    return _Third(used, _judged("disagrees", bend, rate, f"{text}: it is off by {share:.1e}"))


def _judged(word, bend, rate, reason):
    return Bend(word, bend, rate, f"Hessian product: {word}, {reason}")
