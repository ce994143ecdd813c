"""Review of an audit of a derivative: what looks like an error, but is a property of the program or of its solves."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from math import inf
from typing import Any

import numpy as np

from sparsedp._utils.pytree import norm
from sparsedp.check.direction_evidence import CONFIRMING_WORDS, DirectionEvidence
from sparsedp.check.directions import reclassify_kinks
from sparsedp.check.evaluations import EVALUATION_ERRORS
from sparsedp.check.rounding_modes import ROUNDING_FACTOR, rounding_error

__all__ = ["review", "rounds_in_single_precision"]

WRONG = ("disagrees", "outside")
UNDECIDED = ("few", "noise", "rough", "masked", "constant")
ABSOLUTE = "absolute"  # name of directions with steps relative to a whole leaf, if there are relative ones too
NOT_LINEAR = 1e-2  # a larger gap of a linear combination is an error; a smaller one may be that of an inexact solve
INEXACT_SHARES = 1e3  # a gap up to this multiple of the gap of linearity may be due to the same inexact solve
LEAST_SINGLE = 1e-9  # a smaller gap of linearity is not due to single precision
RESOLVED_SHARE = 0.01
COARSE = 2.0**-6  # steps from here on are coarse
EXACT_SHARE = 1e-3  # f is exact if the differences with coarse steps differ by at most this share of the gap
LEAST_INEXACT = 1e-13  # gaps of linearity below this value are rounding errors
SINGLE_EPS = float(np.finfo(np.float32).eps)
NUDGE = 1e-10  # relative change of a vector, far below the rounding of single precision
ROUGH_SHARE = 0.3  # a larger second difference of the derivative is due to rounding
LONG_SCALE = 2.0**6  # ratio of two steps over which the change of a differentiable function decreases clearly
CHANGE_SHARE = 0.1
SMOOTH_NOISE = 1e3  # noise of f in units of rounding, above which the roughness of a VJP shows nothing
LARGER_NUDGE = 1e-6  # relative change of x, above the rounding of single precision
SINGLE_SHARE = 2e-3  # a larger second difference of a VJP shows the rounding of single precision
LEAST_CHANGE = 1e-4  # a smaller change of a VJP, relative to that of x, is due to rounding in double precision
ROUNDING_STEP = 2.0**-27  # rounding of intermediate values may be visible in steps below this one
FAR_STEPS = 2.0**9  # steps from this multiple on are far above the best one
STEEP_SHARE = 0.05
STAIRS = 2  # number of steps at which a staircase does not change although it should
CLEAR_OF_ROUNDING = 100.0
LEAST_AMPLIFIED_SHARE = 1 / 30
SAME_GAP_SHARE = 0.1


def review(audit: Any) -> None:
    """Change words of directions and add findings, if what looks like an error has another explanation.

    Parameters
    ----------
    audit : DerivativeAudit
        Its groups and findings are changed.
    """
    for group in audit.groups:
        for direction in group.directions:
            if direction.word in WRONG:
                _find_other_scales(direction)
    if audit.base.size and np.all(np.isfinite(audit.base)) and audit.pairs:
        _review_linearity(audit)
    _review_rounding(audit)
    for group in audit.groups:
        if group.evaluations.gradient is not None:
            reclassify_kinks(group.evaluations, group.directions)
    _drop(audit, "hidden entries", UNDECIDED)  # no difference can show a derivative that changes f so little
    if audit.has_wide_leaves:
        _drop_absolute_steps(audit)


def _find_other_scales(direction: DirectionEvidence) -> None:
    """Change the word to "noise" if the function varies on a finer scale than the steps, or is a staircase."""
    line = direction.line
    levels = [level for level in line.levels if not level.note and level.step <= direction.step]
    if len(levels) > 1 and levels[0].step >= LONG_SCALE * levels[-1].step:
        changes = [max(abs(level.plus - line.base), abs(level.minus - line.base)) for level in levels]
        if changes[-1] >= CHANGE_SHARE * changes[0] > 0:
            direction.word = "noise"
            direction.note = "f varies on a scale below the smallest step: differences see no derivative"
            return
    larger = [level for level in line.levels if not level.note and level.step >= FAR_STEPS * direction.step]
    steepest = max((abs(level.difference) for level in larger), default=inf)
    if direction.step < ROUNDING_STEP and steepest <= STEEP_SHARE * abs(direction.difference):
        direction.word = "noise"
        direction.note = (
            f"steps below {direction.step:.0e} show a much steeper f than all others: rounding inside f may do it"
        )
        return
    rounding = CLEAR_OF_ROUNDING * line.evaluations.eps * abs(line.base)
    expected = abs(direction.difference)
    unchanged = line.evaluations.unchanged
    stairs = [level for level in line.levels if level.note == unchanged and level.step * expected > rounding]
    if len(stairs) >= STAIRS:
        direction.word = "noise"
        direction.note = f"f does not change at all for steps up to {stairs[0].step:.0e}: it is a staircase"


def _review_linearity(audit: Any) -> None:
    """Decide whether a gap of linearity is an error, an inexact solve, or rounding errors.

    If it is an inexact solve or rounding errors, then gaps of the same size along directions are no errors either.
    """
    gap = audit.linear_gap
    if gap <= max(LEAST_INEXACT, 100 * max(audit.point.eps, audit.program.result.eps)):
        return
    allowed = audit.allowed(1e-5)
    suspects = [
        direction
        for group in audit.groups
        for direction in group.directions
        if direction.word in WRONG and direction.share <= INEXACT_SHARES * gap
    ]
    name = audit.kind
    argument = {"vjp": "g", "jvp": "t"}[name]
    if gap <= allowed and not suspects:
        is_smooth = audit.groups[0].evaluations.noise <= SMOOTH_NOISE
        if gap > LEAST_SINGLE and is_smooth and _roughness(audit) is None:
            reason = f"{name} rounds its numbers to single precision: it is linear in {argument} only to {gap:.0e}"
            audit.findings.append(("broken", reason))
        return
    vector, _ = audit.pairs[0]
    zero = norm(audit.derivative(0 * vector))
    if zero:
        audit.findings.append(("broken", f"{name} is not linear: for a vector of zeros it does not return zeros"))
        return
    roughness = _roughness(audit)
    if roughness is None and gap > NOT_LINEAR:
        audit.findings.append(
            ("broken", f"{name} is a staircase of {argument}: some of its numbers are rounded, maybe to integers")
        )
        return
    if roughness is None or roughness > ROUGH_SHARE:
        if gap > allowed:
            reason = f"{name} has rounding errors of {gap:.1e}: the problem is too ill-conditioned to tell"
            audit.findings.append(("unsound", reason))
        elif suspects:
            audit.findings.append(("note", f"{name} has the rounding errors of single precision, {gap:.0e}"))
        return
    if gap > max(NOT_LINEAR, allowed):
        audit.findings.append(("broken", f"{name} is not linear in {argument}: it is off by {gap:.1e}"))
        return
    if gap > allowed and (any(map(_is_exact, suspects)) or (not suspects and _is_resolved(audit, gap))):
        reason = (
            f"{name} is linear in {argument} only to {gap:.0e}, although f is exact: tighten the tolerance of its solve"
        )
        audit.findings.append(("broken", reason))
        return
    for direction in suspects:
        direction.word = "noise"
        direction.note = (
            f"off by {direction.share:.1e}, and {name} is linear only to {gap:.0e}: "
            "a solve in it may be inexact, tighten its tolerance"
        )
    if gap > allowed and not suspects:
        audit.findings.append(("note", f"{name} is linear only to {gap:.0e}: a solve in it may be inexact"))


def _is_resolved(audit: Any, gap: float) -> bool:
    """Return whether all differences at x have much smaller error bars than a gap: then f has smaller errors, too."""
    lines = [direction for group in audit.groups for direction in group.directions]
    return all(direction.resolution <= RESOLVED_SHARE * gap for direction in lines)


def _is_exact(direction: DirectionEvidence) -> bool:
    """Return whether coarse steps show the same derivative: then a solve in f has a smaller error than the gap.

    An inexact solve is a nonlinear function of its right-hand side, with a relative error of its tolerance.
    """
    coarse = [level for level in direction.line.levels if not level.note and level.step >= COARSE]
    allowed = EXACT_SHARE * abs(direction.gap)
    return len(coarse) > 1 and all(abs(level.difference - direction.difference) <= allowed for level in coarse)


def _roughness(audit: Any) -> float | None:
    """Return the relative size of the second difference of the derivative for a tiny change of its vector.

    It is about 0 for a smooth function of the vector, and about 1 if the results are rounding errors. It is None if
    the results do not change.
    """
    if max(audit.point.eps, audit.program.result.eps) > SINGLE_EPS / 2:
        return 0.0  # every change is rounded
    vector, _ = audit.pairs[0]
    change = NUDGE * vector * np.random.default_rng(0).uniform(-1.0, 1.0, vector.size)
    middle = audit.derivative(vector)
    ahead = audit.derivative(vector + change) - middle
    behind = audit.derivative(vector - change) - middle
    size = max(norm(ahead), norm(behind))
    return norm(ahead + behind) / size if size else None


def rounds_in_single_precision(audit: Any) -> bool:
    """Return whether a VJP in double precision is a rough function of x, although f is smooth.

    Then it rounds values that depend on x.
    """
    group = audit.groups[0]
    if max(audit.point.eps, audit.program.result.eps) > SINGLE_EPS / 2 or group.evaluations.noise > SMOOTH_NOISE:
        return False
    point = audit.point
    change = LARGER_NUDGE * point.units * np.random.default_rng(1).uniform(-1.0, 1.0, point.size)
    slopes = [
        audit.program.pull(point.unpack(point.vector + side * change), group.weights) * point.units
        for side in (0.0, 1.0, -1.0)
    ]
    ahead = slopes[1] - slopes[0]
    behind = slopes[2] - slopes[0]
    size = max(norm(ahead), norm(behind))
    if size <= LEAST_CHANGE * LARGER_NUDGE * norm(slopes[0]):
        return False
    return norm(ahead + behind) > SINGLE_SHARE * size


def _review_rounding(audit: Any) -> None:
    """Change the words of directions to "noise" if rounding errors of f or of its derivative may be the reason.

    The verdict is "disagrees" as soon as one gap has another reason, so that the largest gaps are examined first.
    """
    if any(word in ("broken", "unsound") for word, _ in audit.findings):
        return
    wrong = [(group, direction) for group in audit.groups for direction in group.directions if direction.word in WRONG]
    for group, direction in sorted(wrong, key=lambda pair: -pair[1].share):
        reason = None
        with suppress(*EVALUATION_ERRORS):
            reason = _rounding_reason(audit, group, direction)
        if reason is None:
            return
        direction.word = "noise"
        direction.note = f"off by {direction.share:.1e}, and {reason}"


def _rounding_reason(audit: Any, group: Any, direction: DirectionEvidence) -> str | None:
    """Return how rounding errors of f explain a gap, or None if they do not.

    The function runs in other rounding modes. Its difference quotient changes if rounding errors have changed its
    Jacobian, as those of the factorization of an ill-conditioned matrix do. If the gap is visible at fine steps only,
    and changes f there by no more than its rounding error, f may be a staircase at these steps.
    """
    step = _coarsest_step(direction)
    if step is None:
        return None
    in_f = rounding_error(partial(audit.difference_along, group, direction, step))
    in_derivative = rounding_error(partial(audit.slope_along, group, direction))
    if in_f < LEAST_AMPLIFIED_SHARE * in_derivative:  # only the derivative under test has errors: it is at fault
        in_derivative = 0.0
    error = in_f + in_derivative
    if direction.size <= ROUNDING_FACTOR * error:
        return (
            f"in another rounding mode the derivatives of f change by {error / direction.scale:.1e}: "
            "f amplifies rounding errors, the problem is too ill-conditioned to tell"
        )
    error = rounding_error(partial(audit.functional, group, direction))
    is_contradicted = step < direction.steps[0]
    if is_contradicted and direction.size * step <= ROUNDING_FACTOR * error:
        return f"only at steps up to {step:.0e}, at which rounding errors of f hide its derivative"
    return None


def _coarsest_step(direction: DirectionEvidence) -> float | None:
    """Return the coarsest step that, like all steps down to the best one, shows its gap; None if there is none."""
    coarsest = None
    for step, gap in zip(direction.steps[::-1], direction.gaps[::-1]):
        if step < direction.step:
            continue
        if abs(gap - direction.gap) > SAME_GAP_SHARE * direction.size:
            break
        coarsest = float(step)
    return coarsest


def _drop_absolute_steps(audit: Any) -> None:
    """Turn directions with steps relative to a whole leaf into notes, if relative steps decide.

    Where the entries of a leaf differ by many orders of magnitude, a step relative to the largest ones is too large for
    the small ones. Relative steps decide if they examine all entries.
    """
    relative = []
    for group in audit.groups:
        relative += [direction for direction in group.directions if not direction.direction.startswith(ABSOLUTE)]
    if audit.covered == 1 and all(direction.word in CONFIRMING_WORDS for direction in relative):
        _drop(audit, ABSOLUTE, (*UNDECIDED, *WRONG))


def _drop(audit: Any, name: str, words: Sequence[str]) -> None:
    """Turn directions whose names start with `name` into notes if they have one of some words."""
    for group in audit.groups:
        kept = []
        for direction in group.directions:
            if direction.direction.startswith(name) and direction.word in words:
                audit.findings.append(("note", f"along {direction.direction}, not used: {direction.note}"))
            else:
                kept.append(direction)
        group.directions = kept
