"""L-BFGS that steps past refused points and inside bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from scipy.optimize import LbfgsInvHessProduct

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_whole
from sparsedp.optimize.first_order import first_length
from sparsedp.optimize.line_search import line_search
from sparsedp.optimize.method import Method
from sparsedp.optimize.objective import ROUNDINGS
from sparsedp.optimize.result import Evaluation, NoStepFound, RoundingReached

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.optimize.objective import Objective

__all__ = ["LBFGS", "LBFGSState", "quasi_newton_step"]

LEAST_CURVATURE = 1e-12  # a pair of step s and change y is used where s.y is more than this share of |s| |y|
NO_LOWER_POINT = "the line search found no lower point"


class LBFGSState(NamedTuple):
    """State of L-BFGS.

    Attributes
    ----------
    current : Evaluation
    steps, changes : (k, n) array
        The last k steps and changes of the gradient, oldest first; the changes in units of `gradient_unit`.
    gradient_unit : float
        A power of two set at the start, so that no product of two changes leaves the range of floating-point numbers.
    """

    current: Evaluation
    steps: np.ndarray
    changes: np.ndarray
    gradient_unit: float

    def without_memory(self) -> LBFGSState:
        """Return the state with no steps to take the curvature from."""
        return self._replace(steps=self.steps[:0], changes=self.changes[:0])


@dataclass
class LBFGS(Method):
    """Limited-memory BFGS with a line search for the weak Wolfe conditions.

    Parameters
    ----------
    memory : int
        Number of steps that the curvature is taken from.
    line_search : int
        Most trial points in one line search.

    Notes
    -----
    x <- x - t H g, with H from the two-loop recursion of Nocedal over the last steps. The first step is |f| / |g| long,
    which brings a linear loss to 0, but not longer than x. Nothing is absolute: a loss or an x times a power of two
    takes the same steps.

    An entry that the gradient presses against a bound stays; the step of the others is computed from their part of the
    memory alone, and the line search follows the bounds.

    References
    ----------
    J. Nocedal, Updating quasi-Newton matrices with limited storage, Math. Comp. 35, 1980; D. P. Bertsekas, Projected
    Newton methods for optimization problems with simple constraints, SIAM J. Control Optim. 20, 1982.
    """

    name: ClassVar[str] = "lbfgs"
    memory: int = 10
    line_search: int = 20

    def __post_init__(self) -> None:
        self.memory = check_whole("memory of lbfgs", self.memory, 1, "; the default is 10")
        self.line_search = check_whole("line_search of lbfgs", self.line_search, 2, "; the default is 20")

    def begin(self, first: Evaluation) -> LBFGSState:
        """Return the state at the start."""
        no_steps = np.zeros((0, first.point.size))
        return LBFGSState(first, no_steps, no_steps, power_of_two(norm(first.gradient)))

    def advance(self, state: LBFGSState, objective: Objective) -> LBFGSState:
        """Return the state after one iteration; a line search that fails is repeated without the memory.

        Raises
        ------
        NoStepFound
            If there is no lower point along the gradient either.
        """
        following, lost_in_rounding = self._searched(state, objective)
        if following is None and len(state.steps):
            following, _ = self._searched(state.without_memory(), objective)
        if following is not None:
            return following
        if lost_in_rounding:
            raise RoundingReached(NO_LOWER_POINT)
        raise NoStepFound(NO_LOWER_POINT)

    def _searched(self, state, objective):
        """Return the state after a line search, or None, and whether the predicted decrease is lost in rounding."""
        current = state.current
        step = _step_inside(state, objective.box)
        predicted = -float(np.dot(current.gradient, step))
        lost_in_rounding = abs(predicted / 2) <= ROUNDINGS * current.rounding
        if not predicted > 0:
            return None, lost_in_rounding
        evaluation = line_search(current, step, objective, self.line_search)
        if evaluation is None:
            return None, lost_in_rounding
        return self._remembering(state, evaluation), lost_in_rounding

    def _remembering(self, state, evaluation):
        """Return the state at a new point, with the last step and change of the gradient appended to the memory."""
        step = evaluation.point - state.current.point
        change = evaluation.gradient / state.gradient_unit - state.current.gradient / state.gradient_unit
        steps = np.vstack([state.steps, step])[-self.memory :]
        changes = np.vstack([state.changes, change])[-self.memory :]
        return state._replace(current=evaluation, steps=steps, changes=changes)


def _step_inside(state, box):
    """Return the quasi-Newton step in the entries that the bounds leave free, 0 in the others."""
    current = state.current
    free = box.free(current.point, current.gradient)
    if free.all():
        free = slice(None)
    gradient = current.gradient / state.gradient_unit
    initial_scale = first_length(current) / (norm(gradient) or 1.0)
    step = np.zeros_like(current.point)
    step[free] = quasi_newton_step(gradient[free], state.steps[:, free], state.changes[:, free], initial_scale)
    return step


def quasi_newton_step(
    gradient: NDArray[np.float64], steps: NDArray[np.float64], changes: NDArray[np.float64], initial_scale: float
) -> NDArray[np.float64]:
    """Return -H g with the inverse Hessian H of L-BFGS.

    Parameters
    ----------
    gradient : (n,) array
    steps, changes : (k, n) array
        The memory, oldest first. Pairs with too little curvature are ignored.
    initial_scale : float
        H without a memory is this number times the identity.

    Returns
    -------
    (n,) array
    """
    curvatures = np.einsum("ij,ij->i", steps, changes)
    usable = [
        curvature > LEAST_CURVATURE * norm(step) * norm(change)
        for step, change, curvature in zip(steps, changes, curvatures)
    ]
    if not all(usable):
        steps = steps[usable]
        changes = changes[usable]
        curvatures = curvatures[usable]
    scale = initial_scale
    if len(steps):
        scale = curvatures[-1] / np.dot(changes[-1], changes[-1])
    return -scale * LbfgsInvHessProduct(steps / scale, changes).matvec(gradient)
