"""Ripples: features so fine that a sweep of differences steps over them, though the derivative at x knows them."""

import numpy as np

from sparsedp.check.plateau import NOISY

__all__ = ["hidden", "rippled"]

FINEST = tuple(2.0**-k for k in range(27, 46))
RIPPLE = 3  # finer levels that agree with the gradient
SMOOTH = 30.0  # roundings that the loss of a smooth function varies by at most
WITHIN = (1.0, 10.0, 100.0)  # multiples of the step over which a gap moves the loss by its noise
SEES = 0.1  # rounding of the loss, as a share of the gap, up to which a level tells


def rippled(line, found, eps, extend):
    """A plateau of coarse steps is no proof where fine steps, that rounding does not hide, see another derivative.

    Then the loss has a ripple: its derivative at x is one thing, the slope of the whole another. Fine steps that
    agree with the gradient speak against a gap; fine steps that agree with each other on a gap, against agreement.
    """
    wrong = found.word in ("disagrees", "outside")
    if not (wrong or (line.close and found.word in ("agrees", "masked"))) or not extend or not found.jitter > SMOOTH:
        return found
    known = {level.step for level in line.levels}
    line.sweep([step for step in FINEST if step not in known])
    fine = [level for level in line.usable if level.step < found.step]
    rounding = np.array([4 * eps * max(abs(le.plus), abs(le.minus), abs(line.base)) / le.step for le in fine])
    gaps = np.array([level.difference - level.slope for level in fine])
    if wrong:
        sees = rounding <= SEES * abs(found.gap)
        near = np.abs(gaps) <= np.maximum(rounding, SEES**2 * abs(found.gap))
        if np.count_nonzero(sees & near) < RIPPLE:
            return found
        note = f"a ripple: steps below {found.step:.0e} agree with the gradient, coarser ones are off by "
        return found._replace(word="ripple", note=f"{note}{abs(found.gap) / found.scale:.1e}")
    gap = _coherent(gaps, rounding, max(NOISY * found.scale, 10 * found.bar))
    if not gap:
        return found
    note = f"a ripple: steps above {found.step:.0e} agree with the gradient, fine ones are off by "
    return found._replace(word="ripple", note=f"{note}{abs(gap) / found.scale:.1e}")


def _coherent(gaps, rounding, least):
    """A gap that RIPPLE neighbouring steps agree on, to a tenth; 0 if there is none, as in noise."""
    for first in range(len(gaps) - RIPPLE + 1):
        some, near = gaps[first : first + RIPPLE], rounding[first : first + RIPPLE]
        middle = float(np.median(some))
        if abs(middle) > max(least, np.max(near) / SEES) and np.all(np.abs(some - middle) <= SEES * abs(middle)):
            return middle
    return 0.0


def hidden(line, found, slope_at, eps, point):
    """A gap that a ripple below the noise of the loss would explain, as the gradient itself has one -> ripple.

    A gradient that varies by as much as the gap, within steps over which the gap does not move the loss beyond its
    noise, belongs to a loss whose ripple no difference can see.
    """
    noise = max(2.0, found.jitter) * eps * abs(line.base)
    if found.word != "disagrees" or not abs(found.gap) > 0 or not noise > 0:
        return found
    coarse = sorted((level for level in line.usable if level.step >= found.step), key=lambda level: level.step)
    usual = np.median([abs(le.plus + le.minus - 2 * line.base) / le.step**2 for le in coarse[:3]])  # far out it is 0
    for times in WITHIN:
        step = times * noise / abs(found.gap)
        if step >= found.step:
            break
        change = abs(slope_at(point.tree(point.moved(line.direction, step))) - line.slope)
        if change > max(SEES * abs(found.gap), 10 * usual * step):
            note = f"the gradient varies by {change / found.scale:.1e} of itself within a step of {step:.0e}: "
            return found._replace(word="ripple", note=f"{note}a ripple below the noise of the loss may explain the gap")
    return found
