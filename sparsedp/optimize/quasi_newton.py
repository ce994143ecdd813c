"""L-BFGS as steps from one state to the next, past trial points that the loss refuses, inside bounds."""

from typing import NamedTuple

import numpy as np

from sparsedp.fields import is_whole
from sparsedp.optimize.quadratic import Quadratic
from sparsedp.optimize.trials import Stuck, Trial, power_of_two
from sparsedp.optimize.wolfe import line_search
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
    Each step ends at the minimum of the quadratic model inside the bounds, on the face of the box that the model's
    path of steepest descent leads to. Source: R. H. Byrd, P. Lu, J. Nocedal, C. Zhu, A limited memory algorithm for
    bound constrained optimization, SIAM J. Sci. Comput. 16, 1995.
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
        here = state.trial
        for kept in (state, self._forgetful(state)):
            step = _step(kept, trials.box)
            promised = -float(np.dot(here.slope, step))
            trial = line_search(here, step, trials, self.line_search, trials.box) if promised > 0 else None
            if trial is not None:
                return self._remember(kept, trial)
            if not len(state.steps):
                break
        # What the quasi-Newton step promises is lost in the rounding of the loss.
        hopeless = abs(np.dot(_step(state, trials.box), here.slope / 2)) <= 100 * here.rounding
        raise Stuck("rounding" if hopeless else "the line search found no lower point")

    @staticmethod
    def _forgetful(state):
        return state._replace(steps=state.steps[:0], changes=state.changes[:0])

    def _remember(self, state, trial):
        step = (trial.vector - state.trial.vector) / state.length
        change = trial.slope / state.height - state.trial.slope / state.height
        state = state._replace(trial=trial)
        if not np.dot(step, change) > CURVED * norm(step) * norm(change):
            return state
        steps = np.concatenate([state.steps, step[None]])[-self.memory :]
        return state._replace(steps=steps, changes=np.concatenate([state.changes, change[None]])[-self.memory :])


def _step(state, box):
    """From the point of a state to the minimum of its model."""
    here, g = state.trial, state.trial.slope / state.height
    bend = norm(g) * state.length / _first_length(here)  # without a memory the step is this long
    lower, upper = (side / state.length for side in box.room(here.vector))
    try:
        model = Quadratic(state.steps, state.changes, bend)
        return state.length * model.minimum(g, lower, upper, box.free_mask(here.vector, here.slope))
    except np.linalg.LinAlgError:  # steps that depend on each other; the memory is given up
        return np.zeros_like(g)


def _first_length(first):
    """Length of the first step: |f| / |g|, at most |x|, whichever is known."""
    slope, size = norm(first.slope), norm(first.vector)
    known = [length for length in (abs(first.value) / slope if slope else 0.0, size) if 0 < length < np.inf]
    return min(known, default=1.0)
