"""Linear least squares inside a box, by block principal pivoting."""

import numpy as np

from sparsedp._utils.pytree import norm

__all__ = ["BoundedProblem"]

ROUNDS = 40  # most solves with one set of free unknowns
FULL_EXCHANGES = 3  # rounds without progress in which all unknowns on the wrong side are still exchanged
TOLERANCE = 1e-12  # share of the largest multiplier below which one is taken for 0


class BoundedProblem:
    """Minimize |J d + r|^2 + damping |unit d|^2 with lower <= x + d <= upper.

    Parameters
    ----------
    here : Trial
        The point x.
    linearised : Linearised
        r and J.
    box : Box
    damping, unit : float

    Notes
    -----
    Each unknown is free or at one of its bounds. The free ones are solved for; those that leave the box are put on the
    bound, and those on a bound whose multiplier has the wrong sign are freed, until none is left. Exchanging all of
    them at once takes few rounds; where their number stops falling, one at a time is exchanged. The result has no
    larger model value than the projected gradient step, so that it is a direction of descent in any case.

    References
    ----------
    J. Kim, H. Park, Fast nonnegative matrix factorization: an active-set-like method and comparisons, SIAM J. Sci.
    Comput. 33, 2011; L. F. Portugal, J. J. Judice, L. N. Vicente, Math. Comp. 63, 1994.
    """

    def __init__(self, here, linearised, box, damping, unit):
        x = here.vector
        self.lower = np.broadcast_to(np.minimum(box.lower - x, 0.0), x.shape)
        self.upper = np.broadcast_to(np.maximum(box.upper - x, 0.0), x.shape)
        self.fixed = self.lower == self.upper
        self.linearised, self.slope, self.damping, self.unit = linearised, here.slope, damping, unit

    def solved(self, solve, free):
        """Return the minimum d.

        Parameters
        ----------
        solve : callable
            ``solve(linearised, r)``, the minimum without bounds; columns of J that are 0 give entries of 0.
        free : bool array
            The unknowns to begin with as free ones; the others are at the bound that the gradient points to.
        """
        side = np.where(free & ~self.fixed, 0, np.where(self.slope > 0, -1, 1))
        fewest, full_exchanges = side.size + 1, FULL_EXCHANGES
        for _ in range(ROUNDS):
            step, image = self._with_sides(solve, side)
            wrong = self._wrong(side, step, image)
            count = int(np.count_nonzero(wrong))
            if count == 0:
                return self._clipped(step)
            if count < fewest:
                fewest, full_exchanges = count, FULL_EXCHANGES
            elif full_exchanges > 0:
                full_exchanges -= 1
            else:  # the last one alone: this rule does not cycle
                wrong[: np.flatnonzero(wrong)[-1]] = False
            left_below = wrong & (side == 0) & (step < self.lower)
            left_above = wrong & (side == 0) & (step > self.upper)
            side = np.where(wrong, 0, side)
            side[left_below], side[left_above] = -1, 1
        return min((self._clipped(step), self.downhill()), key=self.model)

    def downhill(self):
        """Return the minimum of the model along the projected gradient."""
        held = ((self.lower == 0) & (self.slope > 0)) | ((self.upper == 0) & (self.slope < 0))
        direction = -np.where(held, 0.0, self.slope)
        image = self.linearised.push(direction / (norm(direction) or 1.0))
        length = norm(direction) / (norm(image) or 1.0) / (norm(image) or 1.0)
        step = self._clipped(direction / (norm(direction) or 1.0) * length)
        image = self.linearised.push(step)
        bend = float(np.dot(image, image))
        fall = -float(np.dot(image, self.linearised.flat))
        return step * min(1.0, fall / bend) if bend > 0 else step

    def model(self, step):
        """Return half of what is minimized, without its value at d = 0."""
        image, damped = self.linearised.push(step), self.unit * step
        return float(np.dot(image, self.linearised.flat + 0.5 * image)) + 0.5 * self.damping * float(damped @ damped)

    def _with_sides(self, solve, side):
        """Return the minimum over the free unknowns, the others at their bounds, and J times it."""
        free = side == 0
        held = np.where(side < 0, self.lower, np.where(side > 0, self.upper, 0.0))
        r = self.linearised.flat + self.linearised.push(held) if held.any() else self.linearised.flat
        if not free.any():
            return held, r - self.linearised.flat
        step = np.where(free, solve(self.linearised.among(free), r), held)
        return step, self.linearised.push(step)

    def _wrong(self, side, step, image):
        """Return which free unknowns are outside of the box and which others have a multiplier of the wrong sign."""
        outside = (side == 0) & ((step < self.lower) | (step > self.upper))
        held = (side != 0) & ~self.fixed
        if not held.any():
            return outside
        multipliers = self.linearised.pull(image + self.linearised.flat) + self.damping * self.unit * (self.unit * step)
        least = TOLERANCE * float(np.max(np.abs(self.slope), initial=0.0))
        return outside | (held & (side * multipliers > least))

    def _clipped(self, step):
        return np.clip(step, self.lower, self.upper)
