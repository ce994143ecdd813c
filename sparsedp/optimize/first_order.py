"""Gradient descent and Adam, as steps from one state to the next.

A state is a named tuple of plain arrays and numbers: everything that the next step depends on.
"""

from typing import NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_choice, check_number, is_number
from sparsedp.optimize.result import Stuck, Trial
from sparsedp.solvers.scaling import largest

__all__ = ["Adam", "AdamState", "Descent", "DescentState"]

HALVINGS = 60


class DescentState(NamedTuple):
    """State of gradient descent: the point, the last step, the rate of the next one and the share to try first.

    The rate belongs to the gradient divided by `height`: a power of two where the rate is searched for, so that the
    quotient of a length and a gradient is a float at any scale of x and the loss; 1 where the rate is given.
    """

    trial: Trial
    velocity: np.ndarray
    rate: float
    share: float
    height: float


class Descent:
    """Gradient descent: v <- momentum v - rate g, x <- x + v.

    Parameters
    ----------
    rate : float or None
        Step per gradient. None: found by backtracking.
    momentum : float
        In [0, 1).
    line_search : None or "backtracking"
        Halve the step until the loss falls (Armijo), and try twice the length next time.
    """

    residuals = False

    def __init__(self, rate=None, momentum=0.0, line_search=None):
        if rate is not None:
            check_number("rate of gd", rate, "> 0", "; leave it out and it is searched for")
        check_number("momentum of gd", momentum, "from 0 to below 1", "; leave it out for none")
        check_choice("line_search of gd", line_search, (None, "backtracking"), "; leave it out for none")
        self.rate, self.momentum = rate, momentum
        self.searches = line_search is not None or rate is None

    def begin(self, first):
        """State at the start."""
        height, rate = 1.0, self.rate
        if rate is None:
            height = power_of_two(norm(first.slope))
            rate = first_length(first) / (norm(first.slope / height) or 1.0)
        return DescentState(first, np.zeros_like(first.vector), rate, 1.0, height)

    def advance(self, state, trials):
        """One iteration. Raises Stuck when no admissible point is found."""
        slope = trials.downhill(state.trial) / state.height
        step = self.momentum * state.velocity - state.rate * slope
        if not self.searches:
            trial, share, larger = admissible(state.trial.vector, step, state.share, trials)
            return state._replace(trial=trial, velocity=share * step, share=larger)
        if np.dot(step, slope) >= 0:
            step = -state.rate * slope  # momentum that goes uphill is dropped
        # Halve the step until the loss falls; a full step that does is tried at twice the length next time.
        along = "the projected gradient" if trials.box.bounded else "the gradient"
        trial, share, _ = backtracked(state.trial, step, trials, along)
        factor = share if share < 1 else 2.0
        return state._replace(trial=trial, velocity=share * step, rate=state.rate * factor)


def first_length(first):
    """Length of the first step: |f| / |g|, which brings a linear loss to 0, at most |x|, whichever is known."""
    slope, size = norm(first.slope), norm(first.vector)
    lengths = abs(first.value) / slope if slope else 0.0, size
    return min((length for length in lengths if 0 < length < np.inf), default=1.0)


def backtracked(here, step, trials, along, most=HALVINGS):
    """Return the first trial along a step, halved again and again, that is lower by enough.

    Also the share of the step, and the share of the fall that the gradient predicted, which is 1/2 at the minimum of a
    parabola. `most` is the number of lengths that are tried.

    Raises
    ------
    Stuck
        When there is none; `along` names the step.
    """

    def halved():
        for count in range(most):
            share = 0.5**count
            point = trials.box.moved(here.vector, share * step)
            yield point, float(np.dot(here.vector - point, here.slope)), share

    trial, gain, share = trials.lower(here, halved(), f"no lower point along {along}")
    return trial, share, gain


def admissible(point, step, share, trials):
    """The trial at point + share * step, and the share; halved until the loss has a value there.

    Also the share for the next iteration, twice as large, so that a wall does not cost all halvings every time.
    """
    for _ in range(HALVINGS):
        trial = trials(trials.box.inside(point + share * step))
        if not trial.refused:
            return trial, share, min(1.0, 2 * share)
        share *= 0.5
    raise Stuck("no admissible point along the step")


class AdamState(NamedTuple):
    """State of Adam: point, the two means, count of steps, size of the first gradient, share to try first."""

    trial: Trial
    mean: np.ndarray
    square: np.ndarray
    steps: int
    scale: float
    share: float


class Adam:
    """Adam: steps of about `rate` in every entry, from running means of the gradient and its square.

    Parameters
    ----------
    rate : float
    betas : pair of float
        Memory of the mean and of the square.
    epsilon : float
        Smallest root mean square that divides, relative to the first gradient, so that a loss times
        1e-12 takes the same steps.

    Notes
    -----
    Source: D. P. Kingma, J. Ba, Adam: a method for stochastic optimization, ICLR 2015.
    """

    residuals, searches = False, False

    def __init__(self, rate=1e-3, betas=(0.9, 0.999), epsilon=1e-8):
        check_number("rate of adam", rate, "> 0", "; the default is 1e-3")
        if np.shape(betas) != (2,) or not all(is_number(beta) and 0 <= beta < 1 for beta in betas):
            raise ValueError(f"adam needs two betas from 0 to below 1, got {betas}; the default is (0.9, 0.999)")
        check_number("epsilon of adam", epsilon, "> 0", "; the default is 1e-8")
        self.rate, self.betas, self.epsilon = rate, tuple(betas), epsilon

    def begin(self, first):
        """State at the start."""
        zero = np.zeros_like(first.vector)
        return AdamState(first, zero, zero, 0, power_of_two(largest(first.slope)), 1.0)

    def advance(self, state, trials):
        """One iteration. A step to a refused point is halved until the loss has a value."""
        (b1, b2), count = self.betas, state.steps + 1
        slope = state.trial.slope / state.scale
        mean = b1 * state.mean + (1 - b1) * slope
        square = b2 * state.square + (1 - b2) * slope**2
        step = -self.rate * (mean / (1 - b1**count)) / (np.sqrt(square / (1 - b2**count)) + self.epsilon)
        trial, _, larger = admissible(state.trial.vector, step, state.share, trials)
        return AdamState(trial, mean, square, count, state.scale, larger)
