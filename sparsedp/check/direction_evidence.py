"""The evidence about a gradient along one direction, and the result (a word such as "agrees") that follows from it.

The central quantity is the gap m(t) = (f(x + t d) - f(x - t d)) / 2t - g . d, in which the displacement t d is that
after rounding of x + t d. For a correct gradient m(t) = c t^2 + noise / t; for a wrong gradient m(t) has a plateau.

The height of the plateau is estimated by each m(t), and by each Richardson extrapolation of two neighbouring steps.
The error bar of an estimate is its largest distance from the two neighbouring estimates, plus the noise of the loss
divided by the step. The estimate with the smallest error bar is used.

Taylor orders: R1(t) is the size of f(x +- t d) - f(x), and must decrease like t. R2(t) is the size of
f(x +- t d) - f(x) -+ t g . d, and must decrease like t^2 or faster. Each size is the root mean square over both signs,
so that the t^2 and t^3 terms of a smooth loss cannot cancel.

References
----------
C. J. F. Ridders, Accurate computation of F'(x) and F'(x) F''(x), Advances in Engineering Software 4, 1982.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp.check.evaluations import Line
from sparsedp.check.summary import Result
from sparsedp.check.thresholds import THRESHOLDS

__all__ = [
    "CONFIRMING_WORDS",
    "UNDECIDED_WORDS",
    "WRONG_WORDS",
    "DirectionEvidence",
    "DirectionResult",
    "pairwise_orders",
    "rms_of_both_sides",
    "weigh",
]

CONFIRMING_WORDS = ("agrees", "vanishes")  # results that confirm the gradient
WRONG_WORDS = ("disagrees", "outside")  # results that show an error of the gradient
UNDECIDED_WORDS = ("few", "noise", "rough", "masked")  # results that more or other steps may change
FEW_EPS = 8.0  # assumed rounding error of x, in units of eps, in the error bar
SINGLE_PRECISION_EPS = 300.0  # smallest detectable gap in units of the eps of x; matters in single precision


@dataclass
class DirectionEvidence:
    """The measured values along one direction, and the conclusions from them.

    Arrays have an entry for each usable level (step size), from coarse to fine. If there are too few usable levels,
    the attributes keep their defaults (NaN or infinity).

    Attributes
    ----------
    line : Line
    word, note : str
        See `DirectionResult`.
    slope, difference : float
        g . d, and the best estimate of the derivative from differences.
    gap, bar, scale : float
        difference - slope; its error bar; and the size of the derivative, relative to which both are measured.
    silent : float
        The largest step if no step changes the loss, else 0.
    smallest_change : float
        If no step changes the loss: the largest change that rounding or noise of the loss can hide.
    refusals : str
        Why some levels cannot be used, as text.
    steps, changes, remainders, gaps, kinks, rounding, noise : ndarray
        The step t; f(x +- t d) - f(x); the same minus +- t g . d; the gap m(t); the difference of the one-sided
        difference quotients; rounding error and noise of the loss.
    jitter : float
        Noise of the loss in units of its rounding.
    curvature : float
        Size of the second derivative at the coarsest steps.
    step : float
        The step of the estimate that is used.
    split, split_bar : float
        Difference of the one-sided derivatives near this step, 0 if it is not significant; and its error bar.
    floor : float
        Part of the error bar that is due to the rounding of x.
    agreement : float
        A gap below this share of the derivative counts as agreement.
    size, share, beyond : float
        Absolute value of the gap; the same divided by `scale`; and, at a kink, by how much the slope is outside the
        interval between the one-sided derivatives.
    is_resolved, is_close, is_wrong, is_zero, is_flat : bool
        True if, in this order: the error bar is small; gap and error bar are small; the gap is significant; slope and
        error bar are negligible relative to the curvature; the first-order term is too small to measure order 1.
    solve_remainder, step_remainder : float
        Largest gaps that may be due to the tolerance of solves and of time steps.
    digits : float
        Number of digits in which gradient and difference agree.
    first_levels, first_order, second_levels, second_order, third_levels, third_order
        Numbers of levels from which Taylor orders are measured, and the orders; see `DirectionResult`.
    bend : float
        d . H d, if a Hessian product was examined.
    hessian_gap : float
        Relative error of d . H d.
    hessian_jumps : bool
        Whether the third Taylor remainder differs between the two signs of the step (the Hessian jumps at x).
    """

    line: Line
    slope: float
    scale: float
    silent: float
    smallest_change: float
    refusals: str
    word: str = ""
    note: str = ""
    steps: NDArray[Any] = field(default_factory=lambda: np.empty(0))
    changes: NDArray[Any] = field(default_factory=lambda: np.empty((2, 0)))
    remainders: NDArray[Any] = field(default_factory=lambda: np.empty((2, 0)))
    gaps: NDArray[Any] = field(default_factory=lambda: np.empty(0))
    kinks: NDArray[Any] = field(default_factory=lambda: np.empty(0))
    rounding: NDArray[Any] = field(default_factory=lambda: np.empty(0))
    noise: NDArray[Any] = field(default_factory=lambda: np.empty(0))
    jitter: float = nan
    curvature: float = nan
    step: float = nan
    gap: float = nan
    bar: float = inf
    split: float = nan
    split_bar: float = nan
    floor: float = nan
    agreement: float = nan
    size: float = nan
    share: float = nan
    beyond: float = nan
    is_resolved: bool = False
    is_close: bool = False
    is_wrong: bool = False
    is_zero: bool = False
    is_flat: bool = False
    solve_remainder: float = nan
    step_remainder: float = nan
    digits: float = 0.0
    first_levels: int = 0
    first_order: float = nan
    second_levels: int = 0
    second_order: float = nan
    third_levels: int = 0
    third_order: float = nan
    bend: float = nan
    hessian_gap: float = nan
    hessian_jumps: bool = False

    @property
    def direction(self) -> str:
        """Name of the direction."""
        return self.line.name

    @property
    def difference(self) -> float:
        """Best estimate of the derivative by finite differences."""
        return self.slope + self.gap

    @property
    @np.errstate(all="ignore")
    def resolution(self) -> float:
        """Error bar as a share of the derivative."""
        return self.bar / self.scale

    @property
    def difference_step(self) -> float:
        """The step whose central difference is closest to the best estimate; NaN if there is no estimate.

        The estimate may be an extrapolation from coarser steps.
        """
        if not self.step > 0:
            return nan
        errors = np.abs(self.gaps - self.gap) + self.noise / self.steps
        return float(self.steps[np.argmin(errors)])

    def result(self) -> DirectionResult:
        """Return the public result."""
        return DirectionResult(
            direction=self.direction,
            word=self.word,
            difference=self.difference,
            slope=self.slope,
            gap=self.gap,
            bar=self.bar,
            scale=self.scale,
            share=self.share,
            resolution=self.resolution,
            step=self.step,
            rate1=self.first_order,
            rate2=self.second_order,
            rate3=self.third_order,
            bend=self.bend,
            digits=self.digits,
            jitter=self.jitter,
            note=self.note,
            line=self.line,
        )


class DirectionResult(Result):
    """The result of an audit along one direction: a word, and the evidence for it.

    Attributes
    ----------
    direction : str
    word : str
        "agrees" or "disagrees". "vanishes": both derivatives are 0 up to rounding. "constant": the loss does not
        change, and g . d is 0. "kink": the one-sided derivatives differ. "outside": they differ, and g . d is not
        between them. "rough": a Taylor remainder has the wrong order. "noise": noise hides the derivative. "few": there
        are too few usable steps. "loose steps": the gap is at most a few tolerances of time steps. "masked": gap and
        error bar are small, but noise other than rounding leaves too few digits. "ripple": coarse and fine steps show
        different derivatives.
    difference, slope : float
        Best estimate of the derivative by finite differences; and g . d.
    gap, bar, scale : float
        difference - slope; its error bar; and the size of the derivative.
    share, resolution : float
        Gap and error bar, divided by the scale.
    step : float
        Step of the best estimate.
    rate1, rate2, rate3 : float
        Taylor orders. rate1 is the order of f(x + t d) - f(x) that is farthest from 1, or NaN if there is none. rate2
        is the lowest order after t g . d is subtracted, or infinite if the remainder is noise on all levels. rate3 is
        the lowest order after t^2 / 2 d . H d is subtracted as well, if a Hessian product was examined.
    bend : float
        d . H d.
    digits : float
    jitter : float
        Noise of the loss, in units of its rounding.
    note : str
    line : Line
    """

    _plain = (
        "direction",
        "word",
        "difference",
        "slope",
        "gap",
        "bar",
        "scale",
        "step",
        "rate1",
        "rate2",
        "digits",
        "jitter",
        "note",
        "bend",
        "rate3",
    )

    __str__ = __repr__ = object.__repr__


@np.errstate(all="ignore")  # losses near overflow or underflow are treated like others
def weigh(line: Line) -> DirectionEvidence:
    """Return the evidence from all levels of a line, with the resulting word."""
    unchanged = max(line.unchanged_steps, default=0.0)
    evidence = DirectionEvidence(
        line=line,
        slope=line.slope,
        scale=np.float64(max(abs(line.slope), line.typical)),
        silent=unchanged,
        smallest_change=_smallest_visible_change(line, unchanged),
        refusals="; ".join(sorted({level.note for level in line.levels} - {""})) or "the sweep has too few steps",
    )
    if len(line.usable) >= THRESHOLDS.fewest_levels:
        _read_levels(evidence)
        _estimate_plateau(evidence)
        _compare_gap_and_bar(evidence)
        _measure_taylor_orders(evidence)
    evidence.word, evidence.note = _word_and_reason(evidence)
    return evidence


def _smallest_visible_change(line: Line, largest_step: float) -> float:
    """Return the largest change of the loss that rounding or noise can hide.

    It is the rounding error of the loss. If the loss is 0 up to rounding, its measured noise is used instead.
    """
    deviation = line.evaluations.deviation
    if abs(line.base) <= THRESHOLDS.bars_disagree * deviation:
        return deviation * max(1.0, largest_step)
    return line.evaluations.eps * abs(line.base)


def _read_levels(evidence: DirectionEvidence) -> None:
    """Compute gaps, remainders and noise of all usable levels."""
    line = evidence.line
    usable = line.usable
    steps = np.array([level.step for level in usable])
    losses = np.array([[level.plus for level in usable], [level.minus for level in usable]])
    predicted = np.array([[level.ahead for level in usable], [level.behind for level in usable]])
    changes = losses - line.base
    remainders = changes - predicted
    gaps = (remainders[0] - remainders[1]) / (2 * steps)
    # The difference of the one-sided quotients, without the effect of unequal rounding of both displacements.
    kinks = (remainders[0] + remainders[1]) / steps
    rounding = line.rounding(steps, losses)
    # Variation between the finest levels, in roundings of the loss. It is due to rounding or to an inexact solve.
    variation = np.abs(np.diff(gaps)) * steps[1:] / rounding[1:]
    finest = variation[1 - THRESHOLDS.noise_levels :]
    evidence.steps = steps
    evidence.changes = changes
    evidence.remainders = remainders
    evidence.gaps = gaps
    evidence.kinks = kinks
    evidence.rounding = rounding
    evidence.jitter = 2 * line.evaluations.noise
    if not line.is_short:
        evidence.jitter = max(float(np.max(finest)), evidence.jitter)
    evidence.noise = max(2.0, evidence.jitter) * rounding
    evidence.curvature = float(np.median(np.abs(kinks / steps)[:3]))


@dataclass
class _Plateau:
    """A candidate for the estimate of the derivative."""

    gap: float
    bar: float
    step: float
    scale: float
    split: float
    split_bar: float
    is_doubtful: bool
    is_passing: bool  # True if a finer level contradicts it


def _estimate_plateau(evidence: DirectionEvidence) -> None:
    """Choose the estimate with the smallest error bar that no finer level contradicts, if possible without a kink."""
    line = evidence.line
    eps = line.point.eps
    if line.evaluations.solved:
        least = THRESHOLDS.noisy_agreement_share
    else:
        least = THRESHOLDS.agreement_share
    by_noise = THRESHOLDS.agreement_per_noise * line.evaluations.eps * evidence.jitter
    by_noise = float(np.clip(by_noise, least, THRESHOLDS.noisy_agreement_share))
    evidence.agreement = max(by_noise, SINGLE_PRECISION_EPS * eps)
    evidence.floor = FEW_EPS * eps * evidence.curvature + 0.5 * FEW_EPS * eps * line.typical
    jumps = _extrapolated(evidence.steps, evidence.kinks, 1, 2 * evidence.noise)
    plateaus = []
    for gap, bar, index in _extrapolated(evidence.steps, evidence.gaps, 2, evidence.noise):
        # The difference of the one-sided derivatives near this level, 0 if there is no estimate.
        jump = jump_bar = 0.0
        for value, value_bar, value_index in jumps:
            if abs(value_index - index) <= 1:
                jump = value
                jump_bar = value_bar
                break
        scale = max(evidence.scale, abs(evidence.slope + gap))
        is_jump = abs(jump) > max(THRESHOLDS.bars_disagree * jump_bar, evidence.agreement * scale)
        split = abs(jump) * is_jump
        # The derivative is the limit t -> 0, so all finer levels must agree with it.
        distances = np.abs(evidence.gaps - gap)[index + 1 :]
        allowed = (bar + 6 * evidence.noise / evidence.steps)[index + 1 :]
        plateaus.append(
            _Plateau(
                gap=gap,
                bar=bar + evidence.floor,
                step=float(evidence.steps[index]),
                scale=scale,
                split=split,
                split_bar=jump_bar,
                is_doubtful=bool(split) or bar > THRESHOLDS.resolved_share * scale,
                is_passing=bool(np.any(distances > allowed)),
            )
        )
    lasting = [plateau for plateau in plateaus if not plateau.is_passing] or plateaus[-1:]
    best = min(lasting, key=lambda plateau: plateau.is_doubtful)  # the first one has the smallest bar
    evidence.gap = best.gap
    evidence.bar = best.bar
    evidence.step = best.step
    evidence.scale = best.scale
    evidence.split = best.split
    evidence.split_bar = best.split_bar


def _extrapolated(
    steps: NDArray[Any], values: NDArray[Any], power: int, noise: NDArray[Any]
) -> list[tuple[float, float, int]]:
    """Estimate v0 in values(t) = v0 + c t^power. Return a list (estimate, bar, index of finest level), best first."""
    ratio = (steps[:-1] / steps[1:]) ** power
    richardson = (ratio * values[1:] - values[:-1]) / (ratio - 1)
    estimates: list[tuple[float, float, int]] = []
    for series in (values, richardson):
        distances = np.abs(np.diff(series))
        start = values.size - series.size + 1
        bars = np.maximum(distances[:-1], distances[1:]) + 2 * (noise / steps)[start:-1]
        estimates += zip(series[1:-1], bars, range(start, values.size - 1))
    return sorted(estimates, key=lambda estimate: estimate[1])


def _compare_gap_and_bar(evidence: DirectionEvidence) -> None:
    """Classify the gap by comparing it with error bar, scale and noise."""
    evaluations = evidence.line.evaluations
    base = abs(evidence.line.base)
    gap = evidence.gap
    bar = evidence.bar
    scale = evidence.scale
    agreement = evidence.agreement
    size = abs(gap)
    significant = bar * THRESHOLDS.bars_disagree
    if not evidence.jitter < THRESHOLDS.rounding_noise:
        significant *= 3
    evidence.size = size
    evidence.share = size / scale
    evidence.beyond = (size - evidence.split / 2) * (evidence.split > 0)
    evidence.is_resolved = bool(bar <= THRESHOLDS.resolved_share * scale)
    evidence.is_wrong = bool(size > max(significant, agreement * scale, agreement * 1e-4 * evidence.curvature))
    evidence.is_zero = bool(
        not evidence.is_resolved
        and size <= THRESHOLDS.bars_agree * bar
        and scale + bar <= max(THRESHOLDS.vanishing_share, agreement) * evidence.curvature
    )
    close = min(THRESHOLDS.bars_agree * bar, THRESHOLDS.resolved_share * scale - bar)
    evidence.is_close = bool(evidence.is_resolved and size <= max(close, agreement * scale))
    by_tolerance = THRESHOLDS.solve_remainder_tolerances * evaluations.tolerance * max(base, scale)
    evidence.solve_remainder = max(THRESHOLDS.solve_remainder_share * base, by_tolerance) * evaluations.solved
    evidence.step_remainder = THRESHOLDS.step_remainder_tolerances * evaluations.step_tolerance * scale
    if evidence.is_zero:
        reference = evidence.curvature
    else:
        reference = scale
    evidence.digits = float(np.clip(-np.log10(max(size, bar) / reference), 0, 16))


def _measure_taylor_orders(evidence: DirectionEvidence) -> None:
    """Measure the orders of the Taylor remainders on levels near the plateau.

    For order 2, a level is usable if R2 >= clear_of_noise * (noise + t |gap|). If there are fewer than fewest_orders
    such levels, the even part of R2 is used instead, because a gap does not contribute to it; if there are still too
    few, levels far from the plateau are used, too. If there is no usable level at all, the loss is linear up to noise,
    and there is no order 2.

    For order 1, a level is usable if R1 >= clear_of_noise * noise, and if t |g . d| is at least linear_share times the
    even part (f(x + t d) + f(x - t d)) / 2 - f(x). If the slope is so small that the even part dominates (near a
    minimum), the order cannot be 1; the direction is then called flat, and order 1 is not measured. The same applies
    if neither the change of the loss nor t g . d exceeds the noise at any level (in the kernel of a Laplacian), while
    gap and error bar are far below the individual terms of g . d.
    """
    steps = evidence.steps
    clear = THRESHOLDS.clear_of_noise * evidence.noise
    is_near = steps <= THRESHOLDS.nearby_steps * evidence.step
    is_any = steps > 0
    even = np.abs(evidence.kinks * steps) / 2
    climb = abs(evidence.slope) * steps
    change = rms_of_both_sides(evidence.changes)
    remainder = rms_of_both_sides(evidence.remainders)
    known_gap = evidence.size * (evidence.is_close or evidence.is_zero)
    clear_remainder = remainder >= clear + THRESHOLDS.clear_of_noise * steps * known_gap
    clear_even = even >= clear
    evidence.second_levels = 0
    for values, is_usable in (
        (remainder, clear_remainder & is_near),
        (even, clear_even & is_near),
        (remainder, clear_remainder & is_any),
        (even, clear_even & is_any),
    ):
        levels, orders = pairwise_orders(steps, values, is_usable)
        if min(levels, THRESHOLDS.fewest_orders) > min(evidence.second_levels, THRESHOLDS.fewest_orders):
            evidence.second_levels = levels
            evidence.second_order = min(orders, default=nan)
    if not evidence.second_levels:
        evidence.second_order = inf
    is_seen = is_near & (change >= clear)
    is_climb = climb >= THRESHOLDS.linear_share * even
    evidence.first_levels, orders = pairwise_orders(steps, change, is_seen & is_climb)
    evidence.first_order = max(orders, key=lambda order: abs(order - 1), default=nan)
    is_small = evidence.bar + evidence.size <= THRESHOLDS.vanishing_share * evidence.scale
    is_still = is_small and not np.any(is_seen | (climb >= clear))
    evidence.is_flat = bool(is_still or np.any(is_seen & ~is_climb))


def rms_of_both_sides(sides: NDArray[Any]) -> NDArray[Any]:
    """Return the root mean square over both signs of a step."""
    return np.hypot(*sides) / np.sqrt(2)


def pairwise_orders(
    steps: NDArray[Any], remainder: NDArray[Any], is_usable: NDArray[Any], most: int = THRESHOLDS.most_orders
) -> tuple[int, list[float]]:
    """Return the number of usable levels (at most `most`), and the orders of pairs with step ratio >= pair_ratio."""
    levels = np.flatnonzero(is_usable)[-most:]
    orders = []
    for coarse in levels:
        finer = levels[steps[levels] * THRESHOLDS.pair_ratio <= steps[coarse]]
        if finer.size:
            fine = finer[0]
            order = np.log(remainder[coarse] / remainder[fine]) / np.log(steps[coarse] / steps[fine])
            orders.append(float(order))
    return len(levels), orders


# ------------------------------------------------------------ the word that follows from the evidence


def _word_and_reason(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return the word for one direction, and the reason. The first rule that applies decides."""
    if evidence.silent:
        return _without_any_change(evidence)
    usable = len(evidence.line.usable)
    if usable < THRESHOLDS.fewest_levels:
        return "few", (f"{usable} usable steps, at least {THRESHOLDS.fewest_levels} are needed ({evidence.refusals})")
    # At a kink every value between the one-sided derivatives is acceptable.
    significant = THRESHOLDS.bars_disagree * (evidence.bar + evidence.split_bar)
    if evidence.beyond > significant and evidence.beyond > THRESHOLDS.resolved_share * evidence.scale:
        return "outside", f"outside the one-sided derivatives, off by {evidence.share:.1e}"
    if evidence.split:
        jump = f"differ by {evidence.split:.1e}, of {evidence.scale:.1e}"
        return "kink", f"a kink: the one-sided derivatives {jump}"
    if evidence.is_wrong:
        return _with_a_significant_gap(evidence)
    if evidence.is_resolved and not evidence.is_close:
        reason = f"off by {evidence.share:.1e}, with error bars of {evidence.resolution:.1e}: not enough to tell"
        return "noise", reason
    if evidence.is_close or evidence.is_zero:
        return _with_a_small_gap(evidence)
    return "noise", f"the noise is {evidence.resolution:.1e} of the derivative: not enough to tell"


def _without_any_change(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return word and reason if no step changes the loss."""
    evaluations = evidence.line.evaluations
    still = f"{evaluations.unchanged} along this direction"
    if evidence.slope == 0:
        return "constant", still
    predicted = abs(evidence.slope) * evidence.silent
    if predicted > 2 * THRESHOLDS.bars_disagree * evidence.smallest_change:
        return "disagrees", f"{still}, {evaluations.gradient_name} says it does"
    return "noise", f"the derivative is smaller than the rounding error of {evaluations.loss_name}"


def _with_a_significant_gap(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return word and reason if the gap is larger than its error bar."""
    off = f"off by {evidence.share:.1e}"
    if evidence.size <= evidence.solve_remainder:
        return "noise", f"{off}: solves may leave this in such a loss, tighten their rtol"
    if evidence.size <= evidence.step_remainder:
        tolerance = evidence.line.evaluations.step_tolerance
        return "loose steps", f"{off}: the steps' tolerance of {tolerance:g} leaves this, tighten it"
    # If the noise is larger than the difference itself, the loss may be chaotic and the gradient correct.
    is_difference = abs(evidence.difference) > THRESHOLDS.bars_disagree * evidence.bar
    if evidence.jitter < THRESHOLDS.rounding_noise or is_difference:
        return "disagrees", f"{off}, with error bars of {evidence.resolution:.1e}"
    loss = evidence.line.evaluations.loss_name
    return "noise", f"{loss} is noisy, chaotic, or curved below the smallest step: differences see no derivative at all"


def _with_a_small_gap(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return word and reason if the gap is within its error bar, or if both derivatives vanish."""
    evaluations = evidence.line.evaluations
    loss = evaluations.loss_name
    fewest = THRESHOLDS.fewest_orders
    is_noisy = evidence.jitter > THRESHOLDS.rounding_noise
    if evidence.is_close and is_noisy and evidence.bar > THRESHOLDS.noisy_agreement_share * evidence.scale:
        noise = f"noise of {evidence.jitter * evaluations.eps:.0e} of {loss}"
        return "masked", f"{noise} leaves {evidence.digits:.1f} digits, {evaluations.digits_needed} are needed"
    orders = (evidence.first_levels, evidence.first_order), (evidence.second_levels, evidence.second_order)
    if any(levels >= fewest and np.isnan(order) for levels, order in orders):
        return "few", f"no two usable steps are a factor {THRESHOLDS.pair_ratio:g} apart: orders cannot be read"
    if evidence.second_levels >= fewest and not evidence.second_order >= THRESHOLDS.second_order:
        reason = f"the second Taylor remainder is of order {evidence.second_order:.2f}: not twice differentiable here"
        return "rough", reason
    is_order_one = abs(evidence.first_order - 1) <= THRESHOLDS.first_order_margin
    if evidence.first_levels >= fewest and not is_order_one:
        return "rough", f"{loss} changes with order {evidence.first_order:.2f} in the step, not 1"
    if not evidence.is_close:
        return "vanishes", "the derivative is 0 to rounding, beside the curvature"
    if 0 < evidence.second_levels < fewest:
        seen = f"stands out of the noise on {evidence.second_levels} steps, {fewest} are needed"
        return "few", f"the second Taylor remainder {seen}"
    if evidence.first_levels < fewest and not evidence.is_flat:
        seen = f"stands out of the noise on {evidence.first_levels} steps, {fewest} are needed"
        return "few", f"the change of {loss} {seen}"
    if evidence.first_levels < fewest:
        return "agrees", f"flat: {loss} bends before it climbs, order 1 cannot be read"
    return "agrees", ""
