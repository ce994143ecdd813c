"""The evidence about a gradient along one direction, and the word that it leads to.

Everything is read from the gap m(t) = (f(x + t d) - f(x - t d)) / 2t - g . d, with the displacement that the rounding
of x leaves of t d. For a right gradient m(t) = c t^2 + noise / t; for a wrong one it has a plateau.

Estimates of the plateau are each m(t) and each Richardson extrapolation of two neighbours. The error bar of an
estimate is its largest distance from the two estimates beside it, plus the noise of the loss divided by the step. The
estimate with the smallest bar counts.

Taylor: R1(t), the size of f(x +- t d) - f without the gradient, must fall like t; R2(t), the size of
f(x +- t d) - f -+ t g . d, like t^2 or faster. Each is the root mean square over both signs, so that the t^2 and t^3
parts of a smooth loss cannot cancel.

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

__all__ = ["PROVED", "DirectionEvidence", "DirectionResult", "pairwise_orders", "rms_of_both_sides", "weigh"]

PROVED = ("agrees", "vanishes")  # words that speak for the gradient
FLOAT_TINY = np.finfo(float).tiny
FEW_EPS = 8.0  # roundings of x that change a difference through the curvature
SINGLE_PRECISION_EPS = 300.0  # roundings of x below which no gap of a coarse dtype is seen


@dataclass
class DirectionEvidence:
    """The numbers along one direction, and what follows from them.

    Arrays have an entry for each usable level, from coarse to fine. NaN and infinite defaults hold where there are too
    few levels.

    Attributes
    ----------
    line : Line
    word, note : str
        See `DirectionResult`.
    slope, difference : float
        g . d, and the best estimate of the derivative from differences.
    gap, bar, scale : float
        difference - slope, its error bar, and the size of the derivative that both are compared with.
    silent : float
        Largest step, if no step changes the loss; else 0.
    smallest_change : float
        Change of the loss that its rounding can hide, if no step changes it.
    refusals : str
        Why levels cannot be used.
    steps, changes, remainders, gaps, kinks, rounding, noise : ndarray
        Step t; f(x +- t d) - f; the same without the gradient; m(t); the jump of the one-sided differences; rounding
        and noise of the loss.
    jitter : float
        Noise of the loss in units of its rounding.
    curvature : float
        Size of the second derivative at the coarsest steps.
    step : float
        Where the plateau is.
    split, split_bar : float
        Jump of the one-sided derivatives there, 0 if it may be 0, and its error bar.
    floor : float
        Part of the bar that is the rounding of x.
    agreement : float
        Share of the derivative below which a gap is agreement.
    size, share, beyond : float
        Size of the gap; its share of the derivative; by how much the slope lies outside the one-sided derivatives.
    is_resolved, is_close, is_wrong, is_zero, is_flat : bool
        Whether the bar is small; gap and bar are small; the gap is significant; slope and bar are small beside the
        curvature; there is no climb to read order 1 from.
    left_by_solves, left_by_steps : float
        Gaps that solves and time steps with error control may leave.
    digits : float
        Digits that are proved.
    first_levels, first_order, second_levels, second_order, third_levels, third_order
        Numbers of levels that Taylor orders are read from, and the orders; see `DirectionResult`.
    bend : float
        d . H d, if a Hessian product was examined.
    hessian_gap : float
        By which share it is off.
    hessian_jumps : bool
        Whether the remainder changes its sign with the step.
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
    left_by_solves: float = nan
    left_by_steps: float = nan
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
        """Best estimate of the derivative from differences."""
        return self.slope + self.gap

    @property
    @np.errstate(all="ignore")
    def resolution(self) -> float:
        """Error bar as a share of the derivative."""
        return self.bar / self.scale

    def result(self) -> DirectionResult:
        """Return what a user sees of the evidence."""
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
    """What is proved along one direction, in a word, and the evidence for it.

    Attributes
    ----------
    direction : str
    word : str
        agrees, disagrees; vanishes: both derivatives are 0 to rounding; kink: the one-sided derivatives differ;
        outside: they differ, and the gradient is beyond both; rough: a Taylor remainder has the wrong order;
        noise, few: nothing is proved, because of noise or for want of usable steps;
        loose steps: the gap is a few tolerances of time steps with error control;
        masked: gap and bar are small, but noise that is no rounding leaves too few digits;
        constant: the loss does not change, as the gradient says; ripple: coarse and fine steps see two derivatives.
    difference, slope : float
        Best estimate of the derivative from differences; and g . d.
    gap, bar, scale : float
        Difference less slope, its error bar, and what both are compared with.
    share, resolution : float
        Gap and bar as shares of the scale.
    step : float
        Where the plateau is.
    rate1, rate2, rate3 : float
        Orders of f(x + t d) - f, the one farthest from 1, NaN when there is none; the lowest with t g . d subtracted,
        infinite when that is noise on all levels; and with t^2/2 d . H d too, where a Hessian product was examined.
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


@np.errstate(all="ignore")  # losses near the limits of the floating-point numbers are treated like others
def weigh(line: Line) -> DirectionEvidence:
    """Return the evidence that the levels of a line give, with its word."""
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
    """Return the change of a loss below which nothing need be seen.

    Where the loss is 0 to rounding, its noise along other directions, which grows with x, takes the place of its size.
    """
    deviation = line.evaluations.deviation
    if abs(line.base) <= THRESHOLDS.bars_disagree * deviation:
        return deviation * max(1.0, largest_step)
    return line.evaluations.eps * abs(line.base)


def _read_levels(evidence: DirectionEvidence) -> None:
    """Read gaps, remainders and noise from all levels."""
    line = evidence.line
    usable = line.usable
    steps = np.array([level.step for level in usable])
    losses = np.array([[level.plus for level in usable], [level.minus for level in usable]])
    predicted = np.array([[level.ahead for level in usable], [level.behind for level in usable]])
    changes = losses - line.base
    remainders = changes - predicted
    gaps = (remainders[0] - remainders[1]) / (2 * steps)
    # The jump of the one-sided differences, without the part that comes from unequal displacements.
    kinks = (remainders[0] + remainders[1]) / steps
    rounding = line.evaluations.eps * np.max(np.abs(losses), axis=0, initial=max(abs(line.base), FLOAT_TINY))
    # What the finest levels vary by in roundings of the loss: rounding does that, or a solve inside.
    variation = np.abs(np.diff(gaps)) * steps[1:] / rounding[1:]
    finest = variation[1 - THRESHOLDS.noise_levels :]
    evidence.steps = steps
    evidence.changes = changes
    evidence.remainders = remainders
    evidence.gaps = gaps
    evidence.kinks = kinks
    evidence.rounding = rounding
    evidence.jitter = max(float(np.max(finest)), 2 * line.evaluations.noise)
    evidence.noise = max(2.0, evidence.jitter) * rounding
    evidence.curvature = float(np.median(np.abs(kinks / steps)[:3]))


@dataclass
class _Plateau:
    """An estimate of the derivative that may be chosen."""

    gap: float
    bar: float
    step: float
    scale: float
    split: float
    split_bar: float
    is_doubtful: bool
    is_passing: bool  # a finer level contradicts it


def _estimate_plateau(evidence: DirectionEvidence) -> None:
    """Choose the estimate with the smallest bar that no finer level contradicts, away from kinks if there is one."""
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
        # The jump of the one-sided derivatives around the level, 0 if it may be 0.
        jump = jump_bar = 0.0
        for value, value_bar, value_index in jumps:
            if abs(value_index - index) <= 1:
                jump = value
                jump_bar = value_bar
                break
        scale = max(evidence.scale, abs(evidence.slope + gap))
        is_jump = abs(jump) > max(THRESHOLDS.bars_disagree * jump_bar, evidence.agreement * scale)
        split = abs(jump) * is_jump
        # A derivative is a limit, not a passing plateau: all finer levels agree with it.
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
    best = min(lasting, key=lambda plateau: plateau.is_doubtful)  # the first without doubt has the smallest bar
    evidence.gap = best.gap
    evidence.bar = best.bar
    evidence.step = best.step
    evidence.scale = best.scale
    evidence.split = best.split
    evidence.split_bar = best.split_bar


def _extrapolated(
    steps: NDArray[Any], values: NDArray[Any], power: int, noise: NDArray[Any]
) -> list[tuple[float, float, int]]:
    """Return estimates of v0 in values(t) = v0 + c t^power: (estimate, bar, index of its finest level), best first."""
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
    """Compare gap, bar, scale and noise."""
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
    evidence.left_by_solves = max(THRESHOLDS.solve_remainder_share * base, by_tolerance) * evaluations.solved
    evidence.left_by_steps = THRESHOLDS.step_remainder_tolerances * evaluations.step_tolerance * scale
    if evidence.is_zero:
        reference = evidence.curvature
    else:
        reference = scale
    evidence.digits = float(np.clip(-np.log10(max(size, bar) / reference), 0, 16))


def _measure_taylor_orders(evidence: DirectionEvidence) -> None:
    """Measure the orders of the Taylor remainders on levels near the plateau.

    Usable for order 2: R2 >= clear_of_noise (noise + t |gap|). Where these are fewer than fewest_orders, the even part
    of R2 is read, which no gap can hide, then the same on all levels; without any usable level the loss is linear to
    its noise, and has no order 2. Usable for order 1: R1 >= clear_of_noise noise, and t |g . d| >= linear_share times
    the even part (f(x + t d) + f(x - t d)) / 2 - f. Where the slope is so small that f bends before it climbs (near a
    minimum), order 1 cannot be 1: the direction is flat, and order 1 is not read. The same holds where neither the
    loss nor t g . d ever exceeds the noise (the kernel of a Laplacian), if gap and bar are far below the terms of
    g . d.
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
    """Return the number of the finest usable levels, and the orders of pairs at least a factor pair_ratio apart."""
    levels = np.flatnonzero(is_usable)[-most:]
    orders = []
    for coarse in levels:
        finer = levels[steps[levels] * THRESHOLDS.pair_ratio <= steps[coarse]]
        if finer.size:
            fine = finer[0]
            order = np.log(remainder[coarse] / remainder[fine]) / np.log(steps[coarse] / steps[fine])
            orders.append(float(order))
    return len(levels), orders


# ------------------------------------------------------------ from evidence to a word


def _word_and_reason(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return the word for the evidence along one direction and its reason; the first rule that applies decides."""
    if evidence.silent:
        return _without_any_change(evidence)
    usable = len(evidence.line.usable)
    if usable < THRESHOLDS.fewest_levels:
        return "few", (f"{usable} usable steps, at least {THRESHOLDS.fewest_levels} are needed ({evidence.refusals})")
    # Between two one-sided derivatives every value is a matter of convention.
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
    return "noise", f"noise of {evidence.resolution:.1e} of the derivative hides it"


def _without_any_change(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return word and reason where no step changes the loss."""
    if evidence.slope == 0:
        return "constant", "the loss does not change along this direction"
    predicted = abs(evidence.slope) * evidence.silent
    if predicted > 2 * THRESHOLDS.bars_disagree * evidence.smallest_change:
        return "disagrees", "the loss does not change along this direction, the gradient says it does"
    return "noise", "the rounding of the loss hides the derivative"


def _with_a_significant_gap(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return word and reason where the gap is beyond its bar."""
    off = f"off by {evidence.share:.1e}"
    if evidence.size <= evidence.left_by_solves:
        return "noise", f"{off}: solves may leave this in such a loss, tighten their rtol"
    if evidence.size <= evidence.left_by_steps:
        tolerance = evidence.line.evaluations.step_tolerance
        return "loose steps", f"{off}: the steps' tolerance of {tolerance:g} leaves this, tighten it"
    # Noise that exceeds the whole difference may be a chaotic loss with a right gradient.
    is_difference = abs(evidence.difference) > THRESHOLDS.bars_disagree * evidence.bar
    if evidence.jitter < THRESHOLDS.rounding_noise or is_difference:
        return "disagrees", f"{off}, with error bars of {evidence.resolution:.1e}"
    return "noise", "the loss is noisy or chaotic: differences see no derivative at all"


def _with_a_small_gap(evidence: DirectionEvidence) -> tuple[str, str]:
    """Return word and reason where the gap is within its bar, or both derivatives vanish."""
    fewest = THRESHOLDS.fewest_orders
    is_noisy = evidence.jitter > THRESHOLDS.rounding_noise
    if evidence.is_close and is_noisy and evidence.bar > THRESHOLDS.noisy_agreement_share * evidence.scale:
        loudness = evidence.jitter * evidence.line.evaluations.eps
        return "masked", f"noise of {loudness:.0e} of the loss leaves {evidence.digits:.1f} digits, 6 are needed"
    orders = (evidence.first_levels, evidence.first_order), (evidence.second_levels, evidence.second_order)
    if any(levels >= fewest and np.isnan(order) for levels, order in orders):
        return "few", f"no two usable steps are a factor {THRESHOLDS.pair_ratio:g} apart: orders cannot be read"
    if evidence.second_levels >= fewest and not evidence.second_order >= THRESHOLDS.second_order:
        reason = f"the second Taylor remainder is of order {evidence.second_order:.2f}: not twice differentiable here"
        return "rough", reason
    is_order_one = abs(evidence.first_order - 1) <= THRESHOLDS.first_order_margin
    if evidence.first_levels >= fewest and not is_order_one:
        return "rough", f"the loss changes with order {evidence.first_order:.2f} in the step, not 1"
    if not evidence.is_close:
        return "vanishes", "the derivative is 0 to rounding, beside the curvature"
    if 0 < evidence.second_levels < fewest:
        seen = f"stands out of the noise on {evidence.second_levels} steps, {fewest} are needed"
        return "few", f"the second Taylor remainder {seen}"
    if evidence.first_levels < fewest and not evidence.is_flat:
        seen = f"stands out of the noise on {evidence.first_levels} steps, {fewest} are needed"
        return "few", f"the change of the loss {seen}"
    if evidence.first_levels < fewest:
        return "agrees", "flat: the loss bends before it climbs, order 1 cannot be read"
    return "agrees", ""
