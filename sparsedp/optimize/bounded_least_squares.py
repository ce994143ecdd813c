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

MOST_ROUNDS = 40  # maximum number of pivoting iterations, each with one least-squares solve
FULL_EXCHANGES = 3  # iterations without progress after which unknowns are exchanged one at a time
TOLERANCE = 1e-12  # multipliers below this fraction of the largest gradient entry count as 0
FREE, AT_LOWER, AT_UPPER = 0, -1, 1  # state of an unknown


class BoundedLeastSquares:
    """Minimize |J d + r|^2 + damping |unit d|^2 over d, subject to lower <= x + d <= upper.

    Parameters
    ----------
    current : Evaluation
        The point x and its gradient.
    linearization : Linearization
        The residuals r and their Jacobian J at x.
    box : Box
        The bounds on x.
    damping, unit : float

    Attributes
    ----------
    lower, upper : (n,) array
        Bounds on d.
    fixed : (n,) bool array
        True for unknowns whose lower and upper bounds are equal.

    Notes
    -----
    Each unknown is either free or at one of its bounds. Each iteration solves for the free unknowns. Free unknowns that
    violate a bound are then set to that bound, and unknowns at a bound whose multiplier has the wrong sign become free.
    The iteration ends when no unknown has to be exchanged. Exchanging all of them at once usually takes few iterations
    but can cycle; if their number stops decreasing, only one is exchanged per iteration, which cannot cycle. If the
    limit of iterations is reached, the better of the clipped step and the projected gradient step is returned.

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
        """Return the minimizer d.

        Parameters
        ----------
        solve : callable
            ``solve(linearization, r)`` returns the minimizer without bounds. Its entries must be 0 where the columns of
            J are 0.
        free : (n,) bool array
            The unknowns that are free initially. The others start at the bound to which the negative gradient points.
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
            else:  # exchange only the unknown with the largest index: this rule cannot cycle
                wrong[: np.flatnonzero(wrong)[-1]] = False
            below = wrong & (side == FREE) & (step < self.lower)
            above = wrong & (side == FREE) & (step > self.upper)
            side = np.where(wrong, FREE, side)
            side[below] = AT_LOWER
            side[above] = AT_UPPER
        return min((self._clipped(step), self.gradient_step()), key=self._model)

    def gradient_step(self) -> NDArray[np.float64]:
        """Return the minimizer of |J d + r|^2 along the projected negative gradient, clipped to the bounds."""
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
        """Return half of the minimized function at d = step, minus half of its value at d = 0."""
        image = self._linearization.jvp(step)
        damped = self._unit * step
        change = float(np.dot(image, self._linearization.flat + 0.5 * image))
        return change + 0.5 * self._damping * float(damped @ damped)

    def _minimum_over_free(self, solve, side):
        """Return the step d that is optimal in the free unknowns while the others stay at their bounds, and J d."""
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
        """Return True for free unknowns that violate a bound and for bound unknowns with a multiplier of wrong sign."""
        outside = (side == FREE) & ((step < self.lower) | (step > self.upper))
        held = (side != FREE) & ~self.fixed
        if not held.any():
            return outside
        multipliers = self._linearization.vjp(image + self._linearization.flat)
        multipliers = multipliers + self._damping * self._unit * (self._unit * step)
        least = TOLERANCE * float(np.max(np.abs(self._gradient), initial=0.0))
        return outside | (held & (side * multipliers > least))

    def _clipped(self, step):
        """Return the step with each entry clipped to its bounds."""
        return np.clip(step, self.lower, self.upper)
