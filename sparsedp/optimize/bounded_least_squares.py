"""Linear least squares inside a box, by block principal pivoting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp._utils.pytree import norm

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.optimize.box import Box
    from sparsedp.optimize.linearization import Linearization
    from sparsedp.optimize.result import Evaluation

__all__ = ["BoundedLeastSquares"]

MOST_ROUNDS = 40  # solves with one set of free unknowns
FULL_EXCHANGES = 3  # rounds without progress in which all unknowns on the wrong side are still exchanged
TOLERANCE = 1e-12  # share of the largest entry of the gradient below which a multiplier is taken for 0
FREE, AT_LOWER, AT_UPPER = 0, -1, 1  # where an unknown is


class BoundedLeastSquares:
    """Minimize |J d + r|^2 + damping |unit d|^2 with lower <= x + d <= upper.

    Parameters
    ----------
    current : Evaluation
        The point x.
    linearization : Linearization
        r and J.
    box : Box
    damping, unit : float

    Attributes
    ----------
    lower, upper : (n,) array
        Bounds on d.
    fixed : (n,) bool array
        Unknowns with equal bounds.

    Notes
    -----
    Each unknown is free or at one of its bounds. The free ones are solved for. Then those that leave the box are set on
    their bound, and those on a bound whose multiplier has the wrong sign are freed, until no unknown is on the wrong
    side. Exchanging all of them at once takes few rounds; where their number stops falling, one at a time is exchanged.
    The result has no larger model value than the projected gradient step, so that it is a direction of descent.

    References
    ----------
    J. Kim, H. Park, Fast nonnegative matrix factorization: an active-set-like method and comparisons, SIAM J. Sci.
    Comput. 33, 2011; L. F. Portugal, J. J. Judice, L. N. Vicente, A comparison of block pivoting and interior-point
    algorithms for linear least squares problems with nonnegative variables, Math. Comp. 63, 1994.
    """

    def __init__(self, current: Evaluation, linearization: Linearization, box: Box, damping: float, unit: float):
        x = current.point
        self.lower = np.broadcast_to(np.minimum(box.lower - x, 0.0), x.shape)
        self.upper = np.broadcast_to(np.maximum(box.upper - x, 0.0), x.shape)
        self.fixed = self.lower == self.upper
        self._linearization = linearization
        self._gradient = current.gradient
        self._damping = damping
        self._unit = unit

    def minimum(
        self,
        solve: Callable[[Linearization, NDArray[np.float64]], NDArray[np.float64]],
        free: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Return the minimum d.

        Parameters
        ----------
        solve : callable
            ``solve(linearization, r)``, the minimum without bounds; columns of J that are 0 give entries of 0.
        free : (n,) bool array
            The unknowns that are free at first; the others are at the bound to which the negative gradient points.
        """
        bound = np.where(self._gradient > 0, AT_LOWER, AT_UPPER)
        side = np.where(free & ~self.fixed, FREE, bound)
        fewest = side.size + 1
        full_exchanges = FULL_EXCHANGES
        for _ in range(MOST_ROUNDS):
            step, image = self._minimum_over_free(solve, side)
            wrong = self._on_wrong_side(side, step, image)
            count = int(np.count_nonzero(wrong))
            if count == 0:
                return self._clipped(step)
            if count < fewest:
                fewest = count
                full_exchanges = FULL_EXCHANGES
            elif full_exchanges > 0:
                full_exchanges -= 1
            else:  # exchange the last one alone: this rule does not cycle
                wrong[: np.flatnonzero(wrong)[-1]] = False
            below = wrong & (side == FREE) & (step < self.lower)
            above = wrong & (side == FREE) & (step > self.upper)
            side = np.where(wrong, FREE, side)
            side[below] = AT_LOWER
            side[above] = AT_UPPER
        return min((self._clipped(step), self.gradient_step()), key=self._model)

    def gradient_step(self) -> NDArray[np.float64]:
        """Return the minimum of the model along the projected gradient."""
        gradient = self._gradient
        held = ((self.lower == 0) & (gradient > 0)) | ((self.upper == 0) & (gradient < 0))
        direction = -np.where(held, 0.0, gradient)
        size = norm(direction) or 1.0
        image_size = norm(self._linearization.jvp(direction / size)) or 1.0
        length = norm(direction) / image_size / image_size
        step = self._clipped(direction / size * length)
        image = self._linearization.jvp(step)
        curvature = float(np.dot(image, image))
        if not curvature > 0:
            return step
        decrease = -float(np.dot(image, self._linearization.flat))
        return step * min(1.0, decrease / curvature)

    def _model(self, step):
        """Return half of what is minimized, without its value at d = 0."""
        image = self._linearization.jvp(step)
        damped = self._unit * step
        change = float(np.dot(image, self._linearization.flat + 0.5 * image))
        return change + 0.5 * self._damping * float(damped @ damped)

    def _minimum_over_free(self, solve, side):
        """Return the minimum over the free unknowns, the others at their bounds, and J times it."""
        free = side == FREE
        held = np.where(side == AT_LOWER, self.lower, np.where(side == AT_UPPER, self.upper, 0.0))
        r = self._linearization.flat
        if held.any():
            r = r + self._linearization.jvp(held)
        if not free.any():
            return held, r - self._linearization.flat
        step = np.where(free, solve(self._linearization.restricted(free), r), held)
        return step, self._linearization.jvp(step)

    def _on_wrong_side(self, side, step, image):
        """Return which free unknowns are outside of the box and which others have a multiplier of the wrong sign."""
        outside = (side == FREE) & ((step < self.lower) | (step > self.upper))
        held = (side != FREE) & ~self.fixed
        if not held.any():
            return outside
        multipliers = self._linearization.vjp(image + self._linearization.flat)
        multipliers = multipliers + self._damping * self._unit * (self._unit * step)
        least = TOLERANCE * float(np.max(np.abs(self._gradient), initial=0.0))
        return outside | (held & (side * multipliers > least))

    def _clipped(self, step):
        """Return the nearest step inside the bounds."""
        return np.clip(step, self.lower, self.upper)
