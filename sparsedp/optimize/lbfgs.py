"""L-BFGS with bounds, and with a line search that avoids points at which the loss cannot be evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp._utils.validation import check_whole
from sparsedp.optimize.first_order import first_length
from sparsedp.optimize.line_search import line_search
from sparsedp.optimize.method import Method
from sparsedp.optimize.metric import EUCLIDEAN
from sparsedp.optimize.objective import ROUNDINGS
from sparsedp.optimize.result import Evaluation, NoStepFound, RoundingReached

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.optimize.metric import Euclidean
    from sparsedp.optimize.objective import Objective

__all__ = ["LBFGS", "LBFGSState", "quasi_newton_step"]

LEAST_CURVATURE = 1e-12  # a step s with gradient change y is used only if s.y exceeds this multiple of |s| |y|
NO_LOWER_POINT = "the line search found no lower point"


class LBFGSState(NamedTuple):
    """State of L-BFGS.

    Attributes
    ----------
    current : Evaluation
    steps, changes : (k, n) array
        The last k steps and the corresponding changes of the gradient divided by `gradient_unit`, oldest first.
    gradient_unit : float
        A power of two near the norm of the first gradient, so that products of two changes do not overflow or
        underflow.
    """

    current: Evaluation
    steps: np.ndarray
    changes: np.ndarray
    gradient_unit: float

    def without_memory(self) -> LBFGSState:
        """Return the state with empty memory, so that the next step follows the negative gradient."""
        return self._replace(steps=self.steps[:0], changes=self.changes[:0])


@dataclass
class LBFGS(Method):
    """Limited-memory BFGS with a line search for the weak Wolfe conditions.

    Parameters
    ----------
    memory : int
        Number of past steps that define the Hessian approximation.
    line_search : int
        Maximum number of trial points in one line search.

    Notes
    -----
    Each iteration computes x <- x - t H g, where H is the inverse Hessian approximation by Nocedal's two-loop recursion
    over the last steps. The recursion begins with M^-1, the inverse of the metric, times s.y / y.M^-1 y, with the last
    step s and change y of the gradient. The length of the first step is the smaller of |f| / |g|, with which a linear
    loss becomes 0, and |x|. No threshold is absolute: if the loss or x is multiplied by a power of two, the run takes
    the same steps.

    An entry that is at a bound, and that the negative gradient would move out of it, is held fixed. The step of the
    other entries uses only their components of the memory, and trial points of the line search are clipped to the
    bounds.

    References
    ----------
    J. Nocedal, Updating quasi-Newton matrices with limited storage, Math. Comp. 35, 1980; D. P. Bertsekas, Projected
    Newton methods for optimization problems with simple constraints, SIAM J. Control Optim. 20, 1982.
    """

    name: ClassVar[str] = "lbfgs"
    uses_metric: ClassVar[bool] = True
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
        """Return the state after one iteration. A failed line search is repeated along the negative gradient.

        Raises
        ------
        NoStepFound
            If this second line search fails too.
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
        """Return the state after a line search, None if it failed; and whether rounding hides the expected decrease."""
        current = state.current
        step = _step_inside(state, objective.box, self.metric)
        predicted = -float(np.dot(current.gradient, step))
        lost_in_rounding = abs(predicted / 2) <= ROUNDINGS * current.rounding
        if not predicted > 0:
            return None, lost_in_rounding
        evaluation = line_search(current, step, objective, self.line_search)
        if evaluation is None:
            return None, lost_in_rounding
        return self._remembering(state, evaluation), lost_in_rounding

    def _remembering(self, state, evaluation):
        """Return the state at a new point; the last step and its change of the gradient are appended to the memory."""
        step = evaluation.point - state.current.point
        change = evaluation.gradient / state.gradient_unit - state.current.gradient / state.gradient_unit
        steps = np.vstack([state.steps, step])[-self.memory :]
        changes = np.vstack([state.changes, change])[-self.memory :]
        return state._replace(current=evaluation, steps=steps, changes=changes)


def _step_inside(state, box, metric):
    """Return the quasi-Newton step of the free entries; entries held at a bound get 0."""
    current = state.current
    free = box.free(current.point, current.gradient)
    if free.all():
        free = slice(None)
        free_metric = metric
    else:
        free_metric = metric.restricted(free)
    gradient = current.gradient / state.gradient_unit
    initial_scale = first_length(current, metric) / (metric.dual_norm(gradient) or 1.0)
    step = np.zeros_like(current.point)
    steps, changes = state.steps[:, free], state.changes[:, free]
    step[free] = quasi_newton_step(gradient[free], steps, changes, initial_scale, free_metric)
    return step


def quasi_newton_step(
    gradient: NDArray[np.float64],
    steps: NDArray[np.float64],
    changes: NDArray[np.float64],
    initial_scale: float,
    metric: Euclidean = EUCLIDEAN,
) -> NDArray[np.float64]:
    """Return -H g, where H is the L-BFGS approximation of the inverse Hessian.

    Parameters
    ----------
    gradient : (n,) array
    steps, changes : (k, n) array
        The past steps and changes of the gradient, oldest first. Pairs with too little curvature are ignored.
    initial_scale : float
        If no pair is usable, H is this number times the inverse of the metric.
    metric : Euclidean or Metric

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
        scale = curvatures[-1] / metric.square(changes[-1], metric.representer(changes[-1]))
    # The two-loop recursion for H / scale, whose steps are divided by `scale`.
    steps = steps / scale
    weights = 1 / np.einsum("ij,ij->i", steps, changes)
    remainder = gradient
    shares = np.empty(len(steps))
    for i in reversed(range(len(steps))):
        shares[i] = weights[i] * np.dot(steps[i], remainder)
        remainder = remainder - shares[i] * changes[i]
    direction = metric.representer(remainder)
    for i in range(len(steps)):
        direction = direction + steps[i] * (shares[i] - weights[i] * np.dot(changes[i], direction))
    return -scale * direction
