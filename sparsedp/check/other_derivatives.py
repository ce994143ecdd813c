"""Compare the gradient under test with forward mode, with complex steps, and with Hessian products."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from math import inf, isfinite, nan
from typing import Any, NamedTuple

import numpy as np

from sparsedp.autodiff.derivative import NO_JVP, hvp, pushforward
from sparsedp.check.direction_evidence import (
    CONFIRMING_WORDS,
    DirectionEvidence,
    pairwise_orders,
    rms_of_both_sides,
    weigh,
)
from sparsedp.check.point import Point
from sparsedp.check.thresholds import THRESHOLDS

__all__ = ["ModeComparison", "check_complex_step", "check_hessian_product", "compare_modes"]

COMPLEX_STEP = 2.0**-100  # in units of x; its square is negligible
SINGLE_PRECISION_EPS = 300.0  # the modes may differ by this multiple of the eps of x; matters in single precision


class ModeComparison(NamedTuple):
    """The difference between forward and reverse mode.

    Attributes
    ----------
    gap : float
        Largest difference of the two modes, relative to the derivative.
    allowed : float
        Largest difference due to rounding; it is larger for a loss with solves or with noise.
    is_hidden : bool
        True if all larger differences are along undecided directions and below the error bars of these directions. Then
        the derivative itself may be a rounding error, as in a loss whose terms cancel.
    """

    gap: float
    allowed: float
    is_hidden: bool

    @property
    def is_allowed(self) -> bool:
        """Whether the modes agree up to rounding."""
        return self.gap <= self.allowed

    def finding(self, tolerance: float) -> tuple[str, str]:
        """Return word and reason for the verdict on the gradient.

        Parameters
        ----------
        tolerance : float
            Largest tolerance of the solves in the loss.
        """
        if self.is_allowed:
            return "note", f"forward mode: agrees with reverse mode to {self.gap:.0e}"
        reason = f"forward and reverse mode differ by {self.gap:.1e}"
        if self.gap <= THRESHOLDS.mode_tolerances * tolerance:
            return "open", f"{reason}, which solves to rtol {tolerance:g} may leave; tighten them"
        if self.is_hidden:
            return "hidden modes", f"{reason}: not enough to tell which is right, both may be noise of the loss"
        return "broken", f"{reason}: the JVP or the VJP of a rule is wrong"


def compare_modes(loss: Callable[[Any], Any], directions: Sequence[DirectionEvidence]) -> ModeComparison | None:
    """Compare forward mode with reverse mode along some directions. Return None if a rule has no JVP."""
    largest_gap = 0.0
    allowed = THRESHOLDS.mode_gap
    gaps_are_hidden = []
    for direction in directions:
        line = direction.line
        point = line.point
        try:
            with np.errstate(all="ignore"):
                _, slope = pushforward(loss, point.fresh(), point.unpack(line.direction))
        except NO_JVP:
            return None
        is_noisy = direction.jitter > THRESHOLDS.rounding_noise or line.evaluations.solved
        allowed = max(allowed, SINGLE_PRECISION_EPS * point.eps, THRESHOLDS.noisy_mode_gap * is_noisy)
        difference = abs(float(slope) - direction.slope)
        if difference == 0:
            continue
        if direction.scale:
            gap = difference / direction.scale
        else:
            gap = inf
        largest_gap = float(np.maximum(largest_gap, gap))  # NaN stays NaN
        if not gap <= allowed:
            is_hidden = difference <= THRESHOLDS.bars_disagree * direction.bar
            gaps_are_hidden.append(direction.word not in CONFIRMING_WORDS and is_hidden)
    return ModeComparison(largest_gap, allowed, all(gaps_are_hidden))


@np.errstate(all="ignore")
def check_complex_step(
    loss: Callable[[Any], Any], point: Point, direction: DirectionEvidence, base: float
) -> str | None:
    """Compare Im f(x + i t d) / t with g . d. The quotient is exact up to rounding if the loss is analytic.

    Returns
    -------
    str or None
        A note on the agreement; None if the two differ, since the loss is then probably not analytic.

    References
    ----------
    W. Squire and G. Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 40, 1998.
    """
    displacements = point.arrays(direction.line.direction)
    complex_values = [x + 1j * COMPLEX_STEP * d for x, d in zip(point.values, displacements)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a discarded imaginary part is noticed by the gap
            value = complex(loss(point.tree(complex_values)))
    except Exception:  # the loss may raise any exception for complex numbers
        return None
    gap = abs(value.imag / COMPLEX_STEP - direction.slope) / direction.scale
    same_value = abs(value.real - base) <= 1e-9 * abs(base)
    if value.imag != 0 and same_value and gap <= THRESHOLDS.complex_step_gap:
        return f"complex step: agrees to {gap:.0e}"
    return None


# ------------------------------------------------------------ Hessian products


def check_hessian_product(
    loss: Callable[[Any], Any], point: Point, direction: DirectionEvidence
) -> tuple[str | None, str]:
    """Examine d . H d by the third Taylor remainder.

    The verdict on the gradient does not depend on the result. For example, a pullback that uses a captured value in
    place of a traced one gives a correct gradient and a wrong Hessian.

    Returns
    -------
    word : "agrees", "disagrees", "inconclusive" or None
        None if the Hessian product is not available.
    note : str
    """
    if point.complex:
        return None, "Hessian product: not looked at, x is complex"
    displacement = direction.line.direction
    try:
        with np.errstate(all="ignore"):
            product = point.gradient(hvp(loss, point.fresh(), point.unpack(displacement))) @ displacement
    except Exception as error:  # any exception: a rule may have no second derivative
        return None, f"Hessian product: not available ({type(error).__name__})"
    bend = float(product)
    _measure_third_order(direction, bend)
    word, order = _word_of_third_order(direction)
    remainder = f"d.Hd = {bend:.9g} along {direction.direction}, third Taylor remainder {order}"
    return word, f"Hessian product: {word}, {remainder}"


@np.errstate(all="ignore")
def _measure_third_order(direction: DirectionEvidence, bend: float) -> None:
    """Measure the order of the third Taylor remainder on the finest levels with negligible noise and rounding."""
    latest = weigh(direction.line)  # with all levels that were added later
    steps = latest.steps
    remainders = latest.remainders - steps**2 / 2 * bend
    size = rms_of_both_sides(remainders)
    hidden = latest.noise + steps * (direction.size + latest.floor)
    is_usable = size >= THRESHOLDS.clear_of_noise * hidden
    levels, orders = pairwise_orders(steps, size, is_usable, THRESHOLDS.fewest_orders)
    finest = np.max(np.flatnonzero(is_usable), initial=0)
    ahead, behind = remainders[:, finest]
    direction.bend = bend
    direction.third_levels = levels
    direction.third_order = min(orders, default=nan if levels else inf)
    direction.hessian_gap = abs(ahead + behind) / steps[finest] ** 2 / abs(bend)
    direction.hessian_jumps = bool(abs(ahead - behind) > THRESHOLDS.odd_share * abs(ahead + behind))


def _word_of_third_order(direction: DirectionEvidence) -> tuple[str, str]:
    """Return the word for a Hessian product, and a phrase about the order of its remainder."""
    order = direction.third_order
    fewest = THRESHOLDS.fewest_orders
    if not isfinite(direction.bend):
        return "disagrees", "cannot be told: it is not finite"
    if not direction.third_levels:
        return "agrees", "is noise"
    if direction.third_levels < fewest:
        return "inconclusive", f"stands out of the noise on {direction.third_levels} steps, {fewest} are needed"
    if order >= THRESHOLDS.third_order:
        return "agrees", f"of order {order:.2f}"
    if order > THRESHOLDS.wrong_hessian_order or direction.hessian_jumps:
        return "inconclusive", f"of order {order:.2f}: not three times differentiable"
    return "disagrees", f"of order {order:.2f}: it is off by {direction.hessian_gap:.1e}"
