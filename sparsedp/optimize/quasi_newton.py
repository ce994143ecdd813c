"""L-BFGS as steps from one state to the next, past trial points that the loss refuses, inside bounds."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import LbfgsInvHessProduct

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_whole
from sparsedp.optimize.first_order import first_length
from sparsedp.optimize.result import Stuck, Trial
from sparsedp.optimize.wolfe import line_search

__all__ = ["Quasi", "QuasiState", "two_loops"]

CURVED = 1e-12  # a pair of step and change is used where s.y is more than this share of |s| |y|


class QuasiState(NamedTuple):
    """State of L-BFGS: the point, and the last steps and changes of the gradient, oldest first.

    The changes are kept as the gradient in units of `height`, a power of two set at the start, so that no product of
    two of them leaves the range of floating point numbers.
    """

    trial: Trial
    steps: np.ndarray
    changes: np.ndarray
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
    Where the gradient presses against a bound an entry stands still; the others take the step of a memory that has
    seen them alone, and the line search bends it along the bounds. Source: D. P. Bertsekas, Projected Newton methods
    for optimization problems with simple constraints, SIAM J. Control Optim. 20, 1982.
    """

    residuals, searches = False, True

    def __init__(self, memory=10, line_search=20):
        self.memory = check_whole("memory of lbfgs", memory, 1, "; the default is 10")
        self.line_search = check_whole("line_search of lbfgs", line_search, 2, "; the default is 20")

    def begin(self, first):
        """State at the start."""
        nothing = np.zeros((0, first.vector.size))
        return QuasiState(first, nothing, nothing, power_of_two(norm(first.slope)))

    def advance(self, state, trials):
        """One iteration; a line search that fails is tried once more without the memory.

        Raises
        ------
        Stuck
            When there is no lower point along the gradient either.
        """
        here, hopeless = state.trial, False
        for kept in (state, state._replace(steps=state.steps[:0], changes=state.changes[:0])):
            step = _step(kept, trials.box)
            promised = -float(np.dot(here.slope, step))
            trial = line_search(here, step, trials, self.line_search) if promised > 0 else None
            if trial is not None:
                return self._remember(kept, trial)
            # What the quasi-Newton step promises is lost in the rounding of the loss.
            hopeless |= kept is state and abs(promised / 2) <= 100 * here.rounding
            if not len(state.steps):
                break
        raise Stuck("rounding" if hopeless else "the line search found no lower point")

    def _remember(self, state, trial):
        step = trial.vector - state.trial.vector
        change = trial.slope / state.height - state.trial.slope / state.height
        steps, changes = np.vstack([state.steps, step]), np.vstack([state.changes, change])
        return state._replace(trial=trial, steps=steps[-self.memory :], changes=changes[-self.memory :])


def _step(state, box):
    """From the point of a state to the minimum of its model in the entries that the bounds leave free."""
    here = state.trial
    free = box.free(here.vector, here.slope)
    free = slice(None) if free.all() else free
    g, step = here.slope / state.height, np.zeros_like(here.vector)
    shortest = first_length(here) / (norm(g) or 1.0)
    step[free] = two_loops(g[free], state.steps[:, free], state.changes[:, free], shortest)
    return step


def two_loops(g, steps, changes, scale):
    """-H g with the H of L-BFGS; `scale` is H without a memory.

    Source: J. Nocedal, Updating quasi-Newton matrices with limited storage, Math. Comp. 35, 1980.
    """
    bends = np.einsum("ij,ij->i", steps, changes)
    curved = [bend > CURVED * norm(s) * norm(y) for s, y, bend in zip(steps, changes, bends)]
    if not all(curved):
        steps, changes, bends = steps[curved], changes[curved], bends[curved]
    if len(steps):
        scale = bends[-1] / np.dot(changes[-1], changes[-1])
    return -scale * LbfgsInvHessProduct(steps / scale, changes).matvec(g)
