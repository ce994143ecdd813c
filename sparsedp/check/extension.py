"""A line swept and judged; where the first steps leave it open, more steps are taken."""

import math

import numpy as np

from sparsedp.check.plateau import ROUNDING, judge
from sparsedp.check.ripple import rippled

__all__ = ["measured"]

GOAL = 1e-5  # error bar, relative, above which a sweep is extended
COARSER = tuple(2.0**k for k in range(1, 38, 3))
BETWEEN = 2.0 ** np.arange(-9, 7)  # steps around that of the plateau
FINER = tuple(2.0**-k for k in range(33, 46, 3))


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
    return rippled(line, found, trials.eps, extend)
