"""A line swept and judged; where the first steps leave it open, more steps are taken."""

import math

import numpy as np

from sparsedp.check.plateau import ROUNDING, judge

__all__ = ["measured"]

GOAL = 1e-5  # error bar, relative, above which a sweep is extended
COARSER = tuple(2.0**k for k in range(1, 38, 3))
BETWEEN = 2.0 ** np.arange(-9, 7)  # steps around that of the plateau
FINER = tuple(2.0**-k for k in range(33, 46, 3))
FINEST = tuple(2.0**-k for k in range(27, 46))
RIPPLE = 3  # finer levels that agree with the gradient
SMOOTH = 30.0  # roundings that the loss of a smooth function varies by at most
SEES = 0.1  # rounding of the loss, as a share of the gap, up to which a level tells


def measured(line, steps, point, trials, extend):
    """Sweep, judge, and where the derivative stays open go on: finer if there may be finer features.

    Noise at the level of rounding asks for coarser steps: x may be small beside the scale of the loss.
    """
    line.sweep(steps)
    found = judge(line, trials.eps, point.eps)
    if extend and found.word in ("few", "rough") and found.step > 0:  # more levels between those there are
        line.sweep([step for step in found.step * BETWEEN if step not in {level.step for level in line.levels}])
        found = judge(line, trials.eps, point.eps)
    if extend and found.word != "vanishes" and found.resolution > max(GOAL, 1e4 * point.eps):
        unknown = math.isnan(found.jitter) and not line.silent
        line.sweep(COARSER + FINER if unknown else FINER if found.jitter > ROUNDING else COARSER)
        found = min(judge(line, trials.eps, point.eps), found, key=lambda one: one.resolution)
    return _rippled(line, found, trials.eps, extend)


def _rippled(line, found, eps, extend):
    """A plateau of coarse steps is no proof where fine steps, that rounding does not hide, see the gradient.

    Then the loss has a ripple: its derivative at x is one thing, the slope of the whole another.
    """
    if found.word != "disagrees" or not extend or not found.jitter > SMOOTH:
        return found
    known = {level.step for level in line.levels}
    line.sweep([step for step in FINEST if step not in known])
    agreeing = 0
    for level in line.usable:
        rounding = 4 * eps * max(abs(level.plus), abs(level.minus), abs(line.base)) / level.step
        if level.step >= found.step or rounding > SEES * abs(found.gap):
            continue
        agreeing += abs(level.difference - level.slope) <= max(rounding, SEES**2 * abs(found.gap))
    if agreeing < RIPPLE:
        return found
    note = f"a ripple: steps below {found.step:.0e} agree with the gradient, coarser ones are off by "
    return found._replace(word="ripple", note=f"{note}{abs(found.gap) / found.scale:.1e}")
