"""Examine a gradient along all directions of an audit, with more steps along directions without a decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.validation import place
from sparsedp.check.direction_evidence import WRONG_WORDS, DirectionEvidence, weigh
from sparsedp.check.evaluations import EVALUATION_ERRORS, Evaluations, Line
from sparsedp.check.loss_noise import measure_noise
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import Point, audit_generator
from sparsedp.check.step_sizes import FINER_STEPS, RIPPLE_STEPS, STEPS_BETWEEN
from sparsedp.check.thresholds import THRESHOLDS

__all__ = [
    "RANDOM_DIRECTIONS",
    "SHIFT",
    "SHIFT_SEED",
    "examine_directions",
    "examine_line",
    "first_non_finite",
    "reclassify_kinks",
]

RANDOM_DIRECTIONS = 3
# A loss with kinks is examined again at a point at this distance from x (in units of x), in a random direction.
SHIFT = 2.0**-6
SHIFT_SEED = 7


def examine_directions(
    evaluations: Evaluations,
    count: int,
    rng: np.random.Generator,
    is_wanted: Callable[[str], bool] | None = None,
) -> tuple[list[DirectionEvidence], list[tuple[str, str]]]:
    """Examine a gradient along all directions.

    Parameters
    ----------
    evaluations : Evaluations
    count, rng, is_wanted
        See `Point.directions`.

    Returns
    -------
    directions : list of DirectionEvidence
        Empty if loss or gradient is not finite.
    findings : list of (str, str)
        (word, reason) of each problem with the values of loss and gradient at the point.

    Notes
    -----
    The noise is a property of the loss. It is measured along the first and the last direction, and the larger value is
    used for all directions.
    """
    point = evaluations.point
    evaluations.start()
    with np.errstate(all="ignore"):
        slopes = evaluations.gradient_at(point.fresh())
        again = evaluations.gradient_at(point.fresh())
    evaluations.slopes = slopes
    findings = _find_unsound_values(evaluations, slopes, again)
    if not (isfinite(evaluations.base) and np.all(np.isfinite(slopes))):
        return [], findings
    lines = [
        Line(name, displacement, evaluations) for name, displacement in point.directions(slopes, count, rng, is_wanted)
    ]
    for line in lines[:1] + lines[1:][-1:]:
        noise, deviation = measure_noise(line)
        evaluations.noise = max(evaluations.noise, noise)
        evaluations.deviation = max(evaluations.deviation, deviation)
    directions = [examine_line(line, search_ripples=line is lines[0]) for line in lines]
    if callable(evaluations.gradient):
        for direction in directions:
            if direction.word == "disagrees":
                _reclassify_hidden_ripple(direction)
    return directions, findings


def _find_unsound_values(evaluations: Evaluations, slopes: NDArray[Any], again: NDArray[Any]) -> list[tuple[str, str]]:
    """Return findings about values at the point that are not finite, not deterministic or too small."""
    point = evaluations.point
    base = evaluations.base
    findings = []
    if not isfinite(base):
        findings.append(("unsound", f"the loss is {base} at x"))
    elif evaluations.value(point.fresh()) != base:
        findings.append(("unsound", "two evaluations of the loss differ: it is not deterministic"))
    if not np.array_equal(slopes, again, equal_nan=True):
        findings.append(("unsound", "two evaluations of the gradient differ: it is not deterministic"))
    with np.errstate(all="ignore"):
        change = np.max(np.abs(slopes * point.units), initial=0.0)
    smallest = THRESHOLDS.smallest_loss_change
    if 0 < change < smallest:
        findings.append(("unsound", f"the loss changes by less than {smallest:g}: it underflows, scale it"))
    for name, values in zip(point.names, point.arrays(slopes)):
        if not np.all(np.isfinite(values)):
            where = first_non_finite(values)
            findings.append(("broken", f"the gradient of {name} holds NaN or infinity{where}"))
    return findings


def first_non_finite(values: NDArray[Any]) -> str:
    """Return a phrase with the position of the first NaN or infinity in an array; "" for a scalar."""
    is_finite = np.isfinite(values)
    if not is_finite.ndim:
        return ""
    return f", the first at {place(int(np.argmin(is_finite)), is_finite.shape)}"


def examine_line(line: Line, search_ripples: bool = False) -> DirectionEvidence:
    """Evaluate the loss along a line and return the evidence. Add more steps if there is no decision.

    Parameters
    ----------
    line : Line
    search_ripples : bool
        If True, and the loss has noise, also try steps far below the plateau when gradient and differences agree.
    """
    line.sweep(line.evaluations.steps)
    evidence = weigh(line)
    if not line.evaluations.may_extend:
        return evidence
    if evidence.word in ("few", "rough") and evidence.step > 0:
        line.sweep(evidence.step * STEPS_BETWEEN)
        evidence = weigh(line)
    if evidence.word != "vanishes" and evidence.resolution > max(THRESHOLDS.extension_bar, 1e4 * line.point.eps):
        if not evidence.jitter <= THRESHOLDS.rounding_noise:
            line.sweep(FINER_STEPS)
        if not evidence.jitter > THRESHOLDS.rounding_noise:
            line.sweep(line.evaluations.coarser_steps)
        extended = weigh(line)
        if not evidence.resolution < extended.resolution:
            evidence = extended
    if search_ripples and evidence.is_close and evidence.jitter > THRESHOLDS.smooth_noise:
        line.sweep(RIPPLE_STEPS)
        _note_ripple(evidence, weigh(line))
    return evidence


def _note_ripple(evidence: DirectionEvidence, finer: DirectionEvidence) -> None:
    """Change the word to "ripple" if several fine steps agree on another derivative than the coarse steps.

    Only steps at which rounding cannot explain the difference are used. The plateau at coarse steps then does not show
    the derivative at x.
    """
    run = THRESHOLDS.ripple_run
    agreement = THRESHOLDS.ripple_agreement
    first_finer = np.flatnonzero(finer.steps < evidence.step)[0]
    for start in range(first_finer, finer.steps.size - run + 1):
        levels = slice(start, start + run)
        gap = float(np.median(finer.gaps[levels]))
        rounding = np.max(4 * finer.rounding[levels] / finer.steps[levels])
        visible = max(
            THRESHOLDS.noisy_agreement_share * evidence.scale,
            THRESHOLDS.bars_disagree * evidence.bar,
            rounding / agreement,
        )
        if abs(gap) > visible and np.max(np.abs(finer.gaps[levels] - gap)) <= agreement * abs(gap):
            evidence.word = "ripple"
            off = abs(gap) / evidence.scale
            evidence.note = f"a ripple: steps below {evidence.step:.0e} are off by {off:.1e}, others agree"


@np.errstate(all="ignore")
def _reclassify_hidden_ripple(evidence: DirectionEvidence) -> None:
    """Change the word to "ripple" if a ripple below the noise of the loss may explain a gap.

    This is the case if the gradient itself varies by about as much as the gap over a step that is so short that the gap
    changes the loss by less than its noise. Finite differences cannot detect such a ripple.
    """
    line = evidence.line
    noise = max(2.0, evidence.jitter) * line.evaluations.eps * abs(line.base)
    visible = THRESHOLDS.ripple_agreement * evidence.size
    for multiple in THRESHOLDS.ripple_reaches:
        step = multiple * (noise / evidence.size)
        if not step < THRESHOLDS.ripple_range * evidence.step:
            continue
        with suppress(*EVALUATION_ERRORS):
            bend = _bend_of_gradient(line, step)
            if not bend > visible:
                continue
            # At a kink the gradient also varies over a much shorter step.
            if bend > 2 * _bend_of_gradient(line, THRESHOLDS.ripple_smoothness * step):
                evidence.word = "ripple"
                evidence.note = (
                    f"{line.evaluations.gradient_name} bends by {bend / evidence.scale:.1e} of itself "
                    f"within a step of {step:.0e}: "
                    f"a ripple below the noise of {line.evaluations.loss_name} may explain the gap"
                )
                return


def _bend_of_gradient(line: Line, step: float) -> float:
    """Return |g(x + t d) . d + g(x - t d) . d - 2 g(x) . d| for the step t."""
    total = 0.0
    for side in (step, -step):
        end = line.point.unpack(line.point.vector + side * line.direction)
        total += line.evaluations.gradient_at(end) @ line.direction
    return abs(total - 2 * line.slope)


# ------------------------------------------------------------ kinks


def reclassify_kinks(evaluations: Evaluations, directions: Sequence[DirectionEvidence]) -> None:
    """Change the word of directions that disagree to "kink" if the gradient does not disagree at a nearby point.

    Where several kinks meet, a gradient may be outside the one-sided derivatives and still be acceptable. It is wrong
    only if it also disagrees at a nearby point without kinks. This needs evidence of kinks, and the gradient as a
    function; otherwise nothing is changed.
    """
    if not callable(evaluations.gradient) or not _may_be_kinks(directions):
        return
    point = evaluations.point
    with suppress(*EVALUATION_ERRORS):
        shift = SHIFT * point.random(audit_generator(SHIFT_SEED))
        beside = Point(point.unpack(point.vector + shift))
        evaluations_beside = evaluations.at(beside)
        evidence = examine_directions(evaluations_beside, RANDOM_DIRECTIONS, audit_generator(None))
        if overall_verdict(*evidence)[0] == "disagrees":
            return
        for direction in directions:
            if direction.word in WRONG_WORDS:
                direction.word = "kink"
                direction.note = "kinks, or parts of a direction that do not add up; beside x all agrees"


def _may_be_kinks(directions: Sequence[DirectionEvidence]) -> bool:
    """Return whether kinks may be the reason why a gradient disagrees."""
    words = {direction.word for direction in directions}
    if "outside" in words or {"disagrees", "kink"} <= words:
        return True
    return any(_is_not_additive(direction) for direction in directions if direction.word == "disagrees")


def _is_not_additive(evidence: DirectionEvidence) -> bool:
    """Return True if the derivatives along two parts of a direction do not add up to that along the direction.

    Then the loss is not differentiable at x, even if it has a derivative along every line. Examples are
    x^3 / (x^2 + y^2) at 0, and a limited slope where neighbouring values are equal.
    """
    line = evidence.line
    entries = np.flatnonzero(line.direction)
    if entries.size < 2:
        return False
    first = line.direction.copy()
    first[entries[::2]] = 0.0
    difference = 0.0
    bar = evidence.bar
    for part in (first, line.direction - first):
        part_evidence = examine_line(Line(line.name, part, line.evaluations), search_ripples=False)
        difference += part_evidence.difference
        bar += part_evidence.bar
    gap = evidence.difference - difference
    visible = max(THRESHOLDS.ripple_agreement * evidence.size, THRESHOLDS.bars_disagree * bar)
    return abs(gap) > visible
