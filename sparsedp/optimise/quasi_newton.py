"""L-BFGS as steps from one state to the next, past trial points that the loss refuses, inside bounds."""

from typing import NamedTuple

import numpy as np

from sparsedp.fields import is_whole
from sparsedp.optimise.trials import Stuck, Trial, power_of_two
from sparsedp.optimise.wolfe import line_search
from sparsedp.tree import norm

__all__ = ["Quasi", "QuasiState"]

CURVED = 1e-12  # a step enters the memory when s.y is more than this share of |s| |y|


class QuasiState(NamedTuple):
    """State of L-BFGS: the point, and the last steps and changes of the gradient, oldest first.

    The changes are kept as the gradient in units of `height`, the steps in units of `length` (powers of two, set
    at the start), so that no product of two of them leaves the range of floating point numbers.
    """

    trial: Trial
    steps: np.ndarray
    changes: np.ndarray
    length: float
    height: float


class Quasi:
    """Limited-memory BFGS with a line search for the weak Wolfe conditions.

    The first step is |f| / |g| long, which would bring a linear loss to 0, but not longer than x. Nothing is
    absolute: a loss or an x times a power of two takes the same steps.

    Parameters
    ----------
    memory : int
        Number of steps that the curvature is taken from.
    line_search : int
        Largest number of trial points in one line search.

    Notes
    -----
    Source: D. C. Liu, J. Nocedal, On the limited memory BFGS method, Math. Program. 45, 1989. With bounds the
    entries at which the gradient pushes against a bound are left out of the step: D. P. Bertsekas, SIAM J.
    Control Optim. 20, 1982.
    """

    residuals, searches = False, True

    def __init__(self, memory=10, line_search=20):
        if not (is_whole(memory, 1) and is_whole(line_search, 2)):
            raise ValueError(
                f"lbfgs needs memory >= 1 and line_search >= 2, got {memory} and {line_search}; write whole numbers"
            )
        self.memory, self.line_search = int(memory), int(line_search)

    def begin(self, first):
        """State at the start."""
        length = power_of_two(_first_length(first))
        nothing = np.zeros((0, first.vector.size))
        return QuasiState(first, nothing, nothing, length, power_of_two(norm(first.slope)))

    def advance(self, state, trials):
        """One iteration; a line search that fails is tried once more without the memory.

        Raises
        ------
        Stuck
            When there is no lower point along the gradient either.
        """
        for kept in (state, self._forgetful(state)):
            trial = self._search(kept, trials)
            if trial is not None:
                return self._remember(kept, trial)
            if not len(state.steps):
                break
        raise Stuck(
            "rounding" if _at_rounding(state, trials.downhill(state.trial)) else "the line search found no lower point"
        )

    @staticmethod
    def _forgetful(state):
        return state._replace(steps=state.steps[:0], changes=state.changes[:0])

    def _search(self, state, trials):
        """A lower trial along the quasi-Newton direction, or None."""
        here, box = state.trial, trials.box
        slope = trials.downhill(here)
        step = -box.free(here.vector, _product(state, slope))
        if not np.dot(step, slope) < 0:
            return None
        return line_search(here, step, trials, self.line_search, box)

    def _remember(self, state, trial):
        step = (trial.vector - state.trial.vector) / state.length
        change = trial.slope / state.height - state.trial.slope / state.height
        state = state._replace(trial=trial)
        if not np.dot(step, change) > CURVED * norm(step) * norm(change):
            return state
        steps = np.concatenate([state.steps, step[None]])[-self.memory :]
        return state._replace(steps=steps, changes=np.concatenate([state.changes, change[None]])[-self.memory :])


def _product(state, slope):
    """Inverse Hessian of the memory times a gradient, by the two loops."""
    g = slope / state.height
    if not len(state.steps):
        size = norm(g)
        return (_first_length(state.trial) / size if size else 1.0) * g
    weights = [1.0 / float(np.dot(s, y)) for s, y in zip(state.steps, state.changes)]
    shares = []
    for s, y, weight in reversed(list(zip(state.steps, state.changes, weights))):
        shares.append(weight * float(np.dot(s, g)))
        g = g - shares[-1] * y
    last = state.changes[-1]
    g = g / (weights[-1] * float(np.dot(last, last)))
    for s, y, weight, share in zip(state.steps, state.changes, weights, reversed(shares)):
        g = g + (share - weight * float(np.dot(y, g))) * s
    return state.length * g


def _at_rounding(state, slope):
    """Whether the fall that the quasi-Newton step promises is lost in the rounding of the loss."""
    return abs(float(np.dot(_product(state, slope), slope / 2))) <= 100 * state.trial.rounding


def _first_length(first):
    """Length of the first step: |f| / |g|, at most |x|, whichever is known."""
    slope, size = norm(first.slope), norm(first.vector)
    known = [length for length in (abs(first.value) / slope if slope else 0.0, size) if 0 < length < np.inf]
    return min(known, default=1.0)
