"""Review of an audit of a derivative: what looks like an error, but is a property of the program or of its solves."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from math import inf, isfinite
from typing import Any

import numpy as np

from sparsedp._utils.pytree import norm
from sparsedp.check.direction_evidence import CONFIRMING_WORDS, UNDECIDED_WORDS, WRONG_WORDS, DirectionEvidence
from sparsedp.check.directions import reclassify_kinks
from sparsedp.check.evaluations import EVALUATION_ERRORS
from sparsedp.check.rounding_modes import ROUNDING_FACTOR, UNBOUNDED_ERROR
from sparsedp.check.thresholds import REVIEW

__all__ = ["review", "rounds_in_single_precision"]

ABSOLUTE = "absolute"  # name of directions with steps relative to a whole leaf, if there are relative ones too


def review(audit: Any) -> None:
    """Change words of directions and add findings, if what looks like an error has another explanation.

    Parameters
    ----------
    audit : DerivativeAudit
        Its groups and findings are changed.
    """
    for group in audit.groups:
        for direction in group.directions:
            if direction.word in WRONG_WORDS:
                _find_other_scales(direction)
    if audit.base.size and np.all(np.isfinite(audit.base)) and audit.pairs:
        _review_linearity(audit)
    _review_rounding(audit)
    for group in audit.groups:
        if group.evaluations.gradient is not None:
            reclassify_kinks(group.evaluations, group.directions)
    _drop(
        audit, "hidden entries", (*UNDECIDED_WORDS, "constant")
    )  # no difference can show a derivative that changes f so little
    if audit.has_wide_leaves:
        _drop_absolute_steps(audit)


def _find_other_scales(direction: DirectionEvidence) -> None:
    """Change the word to "noise" if the function varies on a finer scale than the steps, or is a staircase."""
    line = direction.line
    levels = [level for level in line.levels if not level.note and level.step <= direction.step]
    if len(levels) > 1 and levels[0].step >= REVIEW.long_scale * levels[-1].step:
        changes = [max(abs(level.plus - line.base), abs(level.minus - line.base)) for level in levels]
        if changes[-1] >= REVIEW.unchanged_share * changes[0] > 0:
            direction.word = "noise"
            direction.note = "f varies on a scale below the smallest step: differences see no derivative"
            return
    larger = [level for level in line.levels if not level.note and level.step >= REVIEW.far_steps * direction.step]
    steepest = max((abs(level.difference) for level in larger), default=inf)
    if direction.step < REVIEW.rounding_step and steepest <= REVIEW.steep_share * abs(direction.difference):
        direction.word = "noise"
        direction.note = (
            f"steps below {direction.step:.0e} show a much steeper f than all others: rounding inside f may do it"
        )
        return
    rounding = REVIEW.clear_of_rounding * line.evaluations.eps * abs(line.base)
    expected = abs(direction.difference)
    unchanged = line.evaluations.unchanged
    stairs = [level for level in line.levels if level.note == unchanged and level.step * expected > rounding]
    if len(stairs) >= REVIEW.stairs:
        direction.word = "noise"
        direction.note = f"f does not change at all for steps up to {stairs[0].step:.0e}: it is a staircase"


def _review_linearity(audit: Any) -> None:
    """Decide whether a gap of linearity is an error, an inexact solve, or rounding errors.

    If it is an inexact solve or rounding errors, then gaps of the same size along directions are no errors either. A
    derivative that is random or keeps a state has a finding already, which explains the gap.
    """
    if not audit.is_repeatable:
        return
    gap = audit.linear_gap
    eps = max(audit.point.eps, audit.program.result.eps)
    if gap <= max(REVIEW.rounding_gap, REVIEW.rounding_gap_eps * eps):
        return
    suspects = [
        direction
        for group in audit.groups
        for direction in group.directions
        if direction.word in WRONG_WORDS and direction.share <= REVIEW.inexact_shares * gap
    ]
    if gap <= audit.allowed(REVIEW.linear_share) and not suspects:
        _review_small_gap(audit)
    elif not _is_not_linear(audit):
        _review_inexact_derivative(audit, suspects)


def _review_small_gap(audit: Any) -> None:
    """Add a finding if an allowed gap of linearity shows that a derivative rounds its numbers to single precision."""
    is_smooth = audit.groups[0].evaluations.noise <= REVIEW.smooth_noise
    if audit.linear_gap > REVIEW.single_precision_gap and is_smooth and _roughness(audit) is None:
        _find_broken(audit, f"rounds its numbers to single precision: it {_linear_only(audit)}")


def _is_not_linear(audit: Any) -> bool:
    """Return whether a gap of linearity is explained without an inexact solve, and add a finding then."""
    gap = audit.linear_gap
    allowed = audit.allowed(REVIEW.linear_share)
    argument = audit.program.argument_of(audit.kind)
    vector, _ = audit.pairs[0]
    if norm(audit.derivative(0 * vector)):
        return _find_broken(audit, "is not linear: for a vector of zeros it does not return zeros")
    roughness = _roughness(audit)
    if roughness is None and gap > REVIEW.nonlinear_gap:
        return _find_broken(audit, f"is a staircase of {argument}: some of its numbers are rounded, maybe to integers")
    if roughness is None or roughness > REVIEW.rough_share:
        if gap > allowed:
            reason = f"{audit.title} has rounding errors of {gap:.1e}: the problem is too ill-conditioned to tell"
            audit.findings.append(("unsound", reason))
        else:
            audit.findings.append(("note", f"{audit.title} has the rounding errors of single precision, {gap:.0e}"))
        return True
    if gap > max(REVIEW.nonlinear_gap, allowed):
        return _find_broken(audit, f"is not linear in {argument}: it is off by {gap:.1e}")
    return False


def _review_inexact_derivative(audit: Any, suspects: Sequence[DirectionEvidence]) -> None:
    """Decide whether a derivative with an inexact solve is wrong. It is, if f itself is exact.

    Parameters
    ----------
    audit : DerivativeAudit
    suspects : sequence of DirectionEvidence
        Directions with gaps that may be due to the same inexact solve. They are noise if f is not exact either.
    """
    gap = audit.linear_gap
    is_visible = gap > audit.allowed(REVIEW.linear_share)
    if suspects:
        is_exact = any(map(_is_exact, suspects))
    else:
        is_exact = _is_resolved(audit, gap)
    if is_visible and is_exact:
        _find_broken(audit, f"{_linear_only(audit)}, although f is exact: tighten the tolerance of its solve")
        return
    for direction in suspects:
        direction.word = "noise"
        direction.note = (
            f"off by {direction.share:.1e}, and {audit.title} is linear only to {gap:.0e}: "
            "a solve in it may be inexact, tighten its tolerance"
        )
    if is_visible and not suspects:
        audit.findings.append(("note", f"{audit.title} is linear only to {gap:.0e}: a solve in it may be inexact"))


def _linear_only(audit: Any) -> str:
    """Return a phrase with the gap of linearity."""
    return f"is linear in {audit.program.argument_of(audit.kind)} only to {audit.linear_gap:.0e}"


def _find_broken(audit: Any, words: str) -> bool:
    """Add the finding that the derivative is wrong. Return True."""
    audit.findings.append(("broken", f"{audit.title} {words}"))
    return True


def _is_resolved(audit: Any, gap: float) -> bool:
    """Return whether all differences at x have much smaller error bars than a gap: then f has smaller errors, too."""
    lines = [direction for group in audit.groups for direction in group.directions]
    return all(direction.resolution <= REVIEW.resolved_share * gap for direction in lines)


def _is_exact(direction: DirectionEvidence) -> bool:
    """Return whether coarse steps show the same derivative: then a solve in f has a smaller error than the gap.

    An inexact solve is a nonlinear function of its right-hand side, with a relative error of its tolerance.
    """
    coarse = [level for level in direction.line.levels if not level.note and level.step >= REVIEW.coarse_step]
    allowed = REVIEW.exact_share * abs(direction.gap)
    return len(coarse) > 1 and all(abs(level.difference - direction.difference) <= allowed for level in coarse)


def _roughness(audit: Any) -> float | None:
    """Return the relative size of the second difference of the derivative for a tiny change of its vector.

    It is about 0 for a smooth function of the vector, and about 1 if the results are rounding errors. It is None if
    the results do not change.
    """
    if audit.in_single_precision:
        return 0.0  # every change is rounded
    vector, _ = audit.pairs[0]
    change = REVIEW.nudge * vector * np.random.default_rng(0).uniform(-1.0, 1.0, vector.size)
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
    if audit.in_single_precision or group.evaluations.noise > REVIEW.smooth_noise:
        return False
    point = audit.point
    change = REVIEW.larger_nudge * point.units * np.random.default_rng(1).uniform(-1.0, 1.0, point.size)
    slopes = [
        audit.program.pull(point.unpack(point.vector + side * change), group.weights) * point.units
        for side in (0.0, 1.0, -1.0)
    ]
    ahead = slopes[1] - slopes[0]
    behind = slopes[2] - slopes[0]
    size = max(norm(ahead), norm(behind))
    if size <= REVIEW.least_change * REVIEW.larger_nudge * norm(slopes[0]):
        return False
    return norm(ahead + behind) > REVIEW.single_precision_share * size


def _review_rounding(audit: Any) -> None:
    """Change the words of directions to "noise" if rounding errors of f or of its derivative may be the reason.

    The verdict is "disagrees" as soon as one gap has another reason, so that the largest gaps are examined first.
    """
    if any(word in ("broken", "unsound") for word, _ in audit.findings):
        return
    wrong = [
        (group, direction) for group in audit.groups for direction in group.directions if direction.word in WRONG_WORDS
    ]
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
    if not step > 0:  # no step changes f
        return None
    in_f = audit.rounding_error(partial(audit.difference_along, group, direction, step))
    if not isfinite(in_f):
        return UNBOUNDED_ERROR
    in_derivative = audit.rounding_error(partial(audit.slope_along, group, direction))
    if in_f < REVIEW.amplified_share * in_derivative:  # only the derivative under test has errors: it is at fault
        in_derivative = 0.0
    error = in_f + in_derivative
    if direction.size <= ROUNDING_FACTOR * error:
        return (
            f"in another rounding mode the derivatives of f change by {error / direction.scale:.1e}: "
            "f amplifies rounding errors, the problem is too ill-conditioned to tell"
        )
    error = audit.rounding_error(partial(audit.functional, group, direction))
    is_contradicted = step < direction.steps[0]
    if is_contradicted and direction.size * step <= ROUNDING_FACTOR * error:
        return f"only at steps up to {step:.0e}, at which rounding errors of f hide its derivative"
    return None


def _coarsest_step(direction: DirectionEvidence) -> float:
    """Return the coarsest step that, like all steps down to the best one, shows its gap.

    If plain differences do not show it, because it is an extrapolation, this is the step that is closest to it.
    """
    coarsest = direction.difference_step
    for step, gap in zip(direction.steps[::-1], direction.gaps[::-1]):
        if step < coarsest:
            continue
        if abs(gap - direction.gap) > REVIEW.same_gap_share * direction.size:
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
        _drop(audit, ABSOLUTE, (*UNDECIDED_WORDS, "constant", *WRONG_WORDS))


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
