"""The method of multipliers (augmented Lagrangian) around L-BFGS, for many unknowns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm
from sparsedp._utils.validation import check_number, check_whole
from sparsedp.optimize.constrained_run import ConstrainedMethod
from sparsedp.optimize.lbfgs import LBFGS, LBFGSState
from sparsedp.optimize.result import Evaluation, Failure, NoStepFound

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.optimize.box import Box
    from sparsedp.optimize.constrained_problem import ConstrainedProblem, Point
    from sparsedp.optimize.constrained_run import ConstrainedRun

__all__ = ["AugmentedLagrangian", "AugmentedState"]

FIRST_ACCURACY = 0.1  # relative gradient norm at which the first inner minimization ends
ACCURACY_FACTOR = 0.1  # factor of that accuracy after each update of the multipliers
LEAST_ACCURACY = 1e-12
SUFFICIENT_DECREASE = 0.25  # the penalty grows unless the violation falls to this fraction
LARGEST_PENALTY = 1e12
LARGEST_MULTIPLIER = 1e12
LARGEST_VIOLATION = 10.0  # in units of 1 or of that at the start, whichever is larger; beyond it, the penalty grows
MOST_FRUITLESS = 3  # successive inner minimizations without a step after which the method ends


class AugmentedState(NamedTuple):
    """State of the method.

    Attributes
    ----------
    inner : LBFGSState
        The state of L-BFGS for the augmented Lagrangian; its points are in units.
    multipliers : (m,) array
        The multipliers of the current augmented Lagrangian.
    penalty : float
    accuracy : float
        Relative gradient norm at which the current inner minimization ends.
    violation : float
        The violation at the last update of the multipliers.
    steps : int
        Number of steps of the current inner minimization.
    fruitless : int
        Number of successive inner minimizations that took no step.
    anchor : (n,) array
        The point at which the current inner minimization began, in units.
    """

    inner: LBFGSState
    multipliers: np.ndarray
    penalty: float
    accuracy: float
    violation: float
    steps: int
    fruitless: int
    anchor: np.ndarray


class AugmentedFunction:
    """The augmented Lagrangian as an objective for L-BFGS, for fixed multipliers and penalty.

    Parameters
    ----------
    problem : ConstrainedProblem
    multipliers : (m,) array
    penalty : float

    Attributes
    ----------
    box : Box
    failures : list of Failure

    Notes
    -----
    With the estimates t = y + p c, set to 0 where they are negative for inequalities, the function is the loss plus the
    sum of (t^2 - y^2) / (2 p), and its gradient is that of the loss plus J^T t.
    """

    def __init__(self, problem: ConstrainedProblem, multipliers: NDArray[np.float64], penalty: float):
        self._problem = problem
        self._multipliers = multipliers
        self._penalty = penalty
        self.box: Box = problem.box

    @property
    def failures(self) -> list[Failure]:
        """The refused points since the last record."""
        return self._problem.objective.failures

    def estimates(self, point: Point) -> NDArray[np.float64]:
        """Return the multipliers t that belong to a point."""
        shifted = self._multipliers + self._penalty * point.rows
        return np.where(self._problem.equality, shifted, np.maximum(shifted, 0.0))

    def of_point(self, point: Point) -> Evaluation:
        """Return the augmented Lagrangian and its gradient at a point."""
        estimates = self.estimates(point)
        slope = self._problem.derive(point, lambda: point.vjp(estimates))
        if point.refused:
            return Evaluation(point.z, np.inf, np.full_like(point.z, np.nan))
        # (t - y) (t + y) / (2 p), where t - y has no cancellation unless t is 0
        added = (estimates - self._multipliers) * (estimates + self._multipliers) / (2.0 * self._penalty)
        value = point.value + float(np.sum(added))
        rounding = self._problem.packing.eps * max(abs(point.value), float(np.sum(np.abs(added))))
        return Evaluation(point.z, value, point.gradient + slope, rounding)

    def __call__(self, z: NDArray[np.float64], below: float = np.inf) -> Evaluation:
        """Return the augmented Lagrangian at z; infinity if the loss or a constraint cannot be evaluated."""
        return self.of_point(self._problem.at(z))


@dataclass
class AugmentedLagrangian(ConstrainedMethod):
    """The method of multipliers: L-BFGS minimizes augmented Lagrangians whose multipliers are updated.

    Parameters
    ----------
    penalty : float
        Initial penalty parameter, in units of the loss and of the constraints.
    growth : float
        Factor of the penalty if the violation has not fallen enough from one minimizer to the next.
    inner : int
        Maximum number of steps between two updates of the multipliers.
    memory, line_search
        As for lbfgs.
    multipliers : tree, optional
        Multipliers with which the run begins, in the structure of `Minimum.multipliers`. Default: 0.

    Notes
    -----
    The augmented Lagrangian of the multipliers y and the penalty p is the loss plus, for each constraint,

        y c + p c^2 / 2  for  c == 0,    (max(0, y + p c)^2 - y^2) / (2 p)  for  c <= 0.

    Its gradient is that of the Lagrangian, g + J^T t with the gradient g of the loss, the Jacobian J of the constraints
    and the multipliers t = y + p c (at least 0 for inequalities). L-BFGS with bounds minimizes it to an accuracy that
    increases; then y is set to t. An iteration is one step of L-BFGS. It takes one gradient of the loss and one
    backward pass for each constraint function, which returns its part of J^T t for an array of any length.

    References
    ----------
    M. R. Hestenes, Multiplier and gradient methods, J. Optim. Theory Appl. 4, 1969; J. Nocedal, S. J. Wright, Numerical
    Optimization, Springer, 2006, chapter 17; R. Andreani, E. G. Birgin, J. M. Martinez, M. L. Schuverdt, On augmented
    Lagrangian methods with general lower-level constraints, SIAM J. Optim. 18, 2007; A. R. Conn, N. I. M. Gould, P. L.
    Toint, A globally convergent augmented Lagrangian algorithm for optimization with general constraints and simple
    bounds, SIAM J. Numer. Anal. 28, 1991.
    """

    name: ClassVar[str] = "augmented_lagrangian"
    penalty: float = 1.0
    growth: float = 10.0
    inner: int = 50
    memory: int = 10
    line_search: int = 20
    multipliers: Any = None

    def __post_init__(self) -> None:
        check_number("penalty of augmented_lagrangian", self.penalty, "> 0", "; the default is 1")
        check_number("growth of augmented_lagrangian", self.growth, "> 1", "; the default is 10")
        self.inner = check_whole("inner of augmented_lagrangian", self.inner, 1, "; the default is 50")
        self.memory = check_whole("memory of augmented_lagrangian", self.memory, 1, "; the default is 10")
        line_search = check_whole("line_search of augmented_lagrangian", self.line_search, 2, "; the default is 20")
        self.line_search = line_search
        self._lbfgs = LBFGS(self.memory, line_search)

    @property
    def resumable(self) -> bool:
        """True: the state is a named tuple of arrays and numbers."""
        return True

    def run(
        self, problem: ConstrainedProblem, run: ConstrainedRun, state: AugmentedState, save: Callable[[Any], None]
    ) -> str:
        """Iterate until no step is found; see `ConstrainedMethod`."""
        while True:
            try:
                state = self.advance(state, problem)
            except NoStepFound as error:
                return str(error)
            try:
                run.record(problem.at(state.inner.current.point), self.multipliers_of(state, problem))
            finally:
                save(state)

    def multipliers_of(self, state: AugmentedState, problem: ConstrainedProblem) -> NDArray[np.float64]:
        """Return the estimates of the multipliers at the current point, for which no Jacobian is formed."""
        return self.function(state, problem).estimates(problem.at(state.inner.current.point))

    def function(self, state: AugmentedState, problem: ConstrainedProblem) -> AugmentedFunction:
        """Return the current augmented Lagrangian."""
        return AugmentedFunction(problem, state.multipliers, state.penalty)

    def begin(self, problem: ConstrainedProblem) -> AugmentedState:
        """Return the state at the start."""
        multipliers = np.zeros(problem.start.rows.size)
        if self.multipliers is not None:
            multipliers = problem.constraints.rows_of_multipliers(self.multipliers) / problem.loss_unit
        first = AugmentedFunction(problem, multipliers, self.penalty).of_point(problem.start)
        inner = self._lbfgs.begin(first)
        return AugmentedState(inner, multipliers, self.penalty, FIRST_ACCURACY, np.inf, 0, 0, first.point)

    def advance(self, state: AugmentedState, problem: ConstrainedProblem) -> AugmentedState:
        """Return the state after one step of L-BFGS, with updates of the multipliers before it where they are due.

        Raises
        ------
        NoStepFound
            If several updates in succession allow no step.
        """
        while True:
            function: Any = self.function(state, problem)
            if self._inaccuracy(state, problem) <= state.accuracy or state.steps >= self.inner:
                state = self._updated(state, problem)
                if state.fruitless > MOST_FRUITLESS:
                    raise NoStepFound("updates of the multipliers allow no further step")
                continue
            try:
                inner = self._lbfgs.advance(state.inner, function)
            except NoStepFound:
                if state.fruitless >= MOST_FRUITLESS:
                    raise
                state = self._updated(state, problem)
                continue
            if problem.at(inner.current.point).violation > LARGEST_VIOLATION * max(1.0, problem.start.violation):
                state = self._restarted(state, problem)
                continue
            return state._replace(inner=inner, steps=state.steps + 1, fruitless=0)

    def _inaccuracy(self, state, problem):
        """Return the norm of the projected gradient of the augmented Lagrangian, relative to that of the loss."""
        current = state.inner.current
        step = problem.projected_step(problem.at(current.point), current.gradient)
        return norm(step) / (norm(problem.start.gradient) or 1.0)

    def _restarted(self, state, problem):
        """Return the state at the begin of the inner minimization, with a larger penalty.

        If the loss falls faster outside of the feasible set than the penalty grows, the augmented Lagrangian has no
        minimum, and the steps lead far away.
        """
        penalty = state.penalty * self.growth
        if penalty > LARGEST_PENALTY:
            raise NoStepFound("the loss falls without limit outside of the feasible set; write bounds")
        first = AugmentedFunction(problem, state.multipliers, penalty).of_point(problem.at(state.anchor))
        return state._replace(inner=self._lbfgs.begin(first), penalty=penalty, steps=0)

    def _updated(self, state, problem):
        """Return the state with updated multipliers, and with a larger penalty if the violation has not fallen.

        The penalty grows only if two minimizers of augmented Lagrangians, the last with a violation, differ too little.
        It stays

        - if the step limit has ended the inner minimization, because further steps may reduce the violation,
        - after the first violation: before, no constraint was active, and their multipliers were 0,
        - if the violation is below the inaccuracy of the inner minimization, which a larger one would make slower.
        """
        point = problem.at(state.inner.current.point)
        estimates = np.clip(self.function(state, problem).estimates(point), -LARGEST_MULTIPLIER, LARGEST_MULTIPLIER)
        # The change of the multipliers over the penalty: c for equalities, max(c, -y / p) for inequalities.
        violation = float(np.max(np.abs(estimates - state.multipliers), initial=0.0)) / state.penalty
        penalty = state.penalty
        inner = state.inner
        inaccuracy = self._inaccuracy(state, problem)
        is_solved = inaccuracy <= state.accuracy or state.steps < self.inner
        has_not_fallen = violation > SUFFICIENT_DECREASE * state.violation
        if is_solved and has_not_fallen and violation > inaccuracy and penalty < LARGEST_PENALTY:
            penalty *= self.growth
            inner = inner.without_memory()
        last_violation = state.violation
        if is_solved and (violation > 0.0 or np.isfinite(last_violation)):
            last_violation = violation
        accuracy = state.accuracy
        if inaccuracy <= accuracy:
            accuracy = max(ACCURACY_FACTOR * accuracy, LEAST_ACCURACY)
        fruitless = state.fruitless + 1
        state = AugmentedState(inner, estimates, penalty, accuracy, last_violation, 0, fruitless, point.z)
        current = self.function(state, problem).of_point(point)
        return state._replace(inner=inner._replace(current=current))
