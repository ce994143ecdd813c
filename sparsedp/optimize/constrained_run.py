"""A run of `minimize` with constraints: the problem in units of size 1, the history and the convergence test."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from functools import cached_property
from math import hypot
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.progress import shown_steps
from sparsedp._utils.pytree import norm, power_of_two
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.constraints import Constraints
from sparsedp.optimize.lbfgs import LBFGS
from sparsedp.optimize.objective import REFUSALS, Objective
from sparsedp.optimize.result import Evaluation, Failure, Minimum, NoStepFound, Record

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.optimize.constraints import ConstraintValues

__all__ = ["ConstrainedMethod", "ConstrainedProblem", "ConstrainedRun", "Point", "RunEnded", "minimize_constrained"]

FEASIBLE = 1e-6  # largest violation, in units of the constraints, that counts as feasible if tolerance is a function
NEARLY = 1e-6  # feasibility and optimality that count as converged if the method finds no better point
ROUNDINGS = 30  # the same for single precision, in multiples of its machine epsilon
REFUSED_VALUE = 1e30  # the loss at a refused point, for libraries that cannot use infinity
NEAR_ACTIVE = 0.1  # rows below minus this number are inactive when multipliers are estimated
NEAR_BOUND = 1e-4  # entries of z that are closer to a bound are first assumed to be held there, for the same purpose
REFINEMENTS = 5  # number of corrections of the set of entries at bounds when multipliers are estimated
STORED_POINTS = 2
LARGEST_ROWS = 20  # number of rows, those with the largest violations, with which the gradient of all is compared
MOST_RESTORING = 100  # largest number of steps that reduce the violation after a run without a feasible point
INFEASIBLE = 1e-3  # ratio of |J^T c| to |J| |c| below which the violation cannot be reduced to first order


class RunEnded(Exception):
    """Internal exception: the run has stopped; its message says why. `minimize` catches it."""


class Point:
    """A point with the loss, its gradient and the constraints, all in units of size 1.

    Attributes
    ----------
    z : (n,) array
        The unknowns x divided by their units.
    evaluation : Evaluation
        The point x and its loss, in the units of the user.
    value : float
        The loss; infinite if the point was refused.
    gradient : (n,) array
    constraints : ConstraintValues or None
    rows : (m,) array
        The constraints; NaN if the point was refused.
    signed_violations : (m,) array
        The rows, with 0 for inequalities that are satisfied.
    violations : (m,) array
        Their absolute values.
    violation : float
        The largest of them.
    """

    def __init__(self, problem: ConstrainedProblem, evaluation: Evaluation, constraints: ConstraintValues | None):
        self._x_unit = problem.x_unit
        self.evaluation = evaluation
        self.constraints = constraints
        self.z = evaluation.point / problem.x_unit
        self.value = evaluation.value / problem.loss_unit
        self.gradient = evaluation.gradient * (problem.x_unit / problem.loss_unit)
        self.rows = np.full(problem.constraints.count, np.nan)
        if constraints is not None:
            self.rows = constraints.rows
        self.signed_violations = np.where(problem.constraints.equality, self.rows, np.maximum(self.rows, 0.0))
        self.violations = np.abs(self.signed_violations)
        self.violation = float(np.max(self.violations, initial=0.0))

    @property
    def refused(self) -> bool:
        """Whether the loss or a constraint raised an error or was not finite."""
        return self.evaluation.refused or self.constraints is None

    def vjp(self, v: NDArray[np.float64]) -> Any:
        """Return J^T v, where J is the Jacobian of the rows."""
        assert self.constraints is not None
        return self._x_unit * self.constraints.vjp(v)

    def constraint_values(self, constraints: Constraints) -> Any:
        """Return the values of the constraint functions, in the structure and the units of the user."""
        assert self.constraints is not None
        return constraints.values(self.constraints)

    @cached_property
    def jacobian(self) -> NDArray[np.float64]:
        """The Jacobian of the rows, of shape (m, n)."""
        if not self.rows.size:
            return np.zeros((0, self.z.size))
        assert self.constraints is not None
        return self.constraints.jacobian * self._x_unit


class Functions(NamedTuple):
    """The functions at a point as finite numbers; see `ConstrainedProblem.functions`."""

    value: float
    gradient: np.ndarray
    rows: np.ndarray
    usable: Point

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """The Jacobian of the rows, of shape (m, n)."""
        return self.usable.jacobian


class ConstrainedProblem:
    """The loss, the constraints and the bounds as functions of z = x / x_unit.

    Parameters
    ----------
    objective : Objective
        The loss of the user.
    constraints : Constraints
    packing : Packing

    Attributes
    ----------
    x_unit : (n,) array
        A power of two for each leaf of the unknowns: the root mean square of its entries at the start. If they are 0:
        the largest finite bound; without bounds, the length |loss| / |gradient|; else 1.
    loss_unit : float
        A power of two: the norm of the gradient in z at the start.
    box : Box
        The bounds of z.
    equality : (m,) array of bool
        Which rows are equalities.
    start : Point
    """

    start: Point
    _last_usable: Point
    equality: NDArray[np.bool_]

    def __init__(self, objective: Objective, constraints: Constraints, packing: Packing):
        self.objective = objective
        self.constraints = constraints
        self.packing = packing
        self.x_unit: Any = 1.0
        self.loss_unit = 1.0
        self.box = Box()
        self._points: list[tuple[np.ndarray, Point]] = []  # the points that were asked for last, and their evaluations

    def begin(self, vector: NDArray[np.float64]) -> Point:
        """Evaluate the start, choose the units and return the start. Exceptions of the functions are not caught."""
        first = self.objective.evaluate_start(vector)
        self.x_unit = self._units_of_x(first)
        self.loss_unit = power_of_two(norm(first.gradient * self.x_unit) or abs(first.value))
        self.constraints.begin(first.point, self.x_unit)
        self.equality = self.constraints.equality
        self.box.lower = self.objective.box.lower / self.x_unit
        self.box.upper = self.objective.box.upper / self.x_unit
        self.start = Point(self, first, self.constraints.at(first.point))
        self._last_usable = self.start
        self._points = [(self.start.z, self.start)]
        return self.start

    def at(self, z: NDArray[np.float64]) -> Point:
        """Return the point at z, which is clipped to the bounds. The last points are stored."""
        z = self.box.nearest(z)
        for asked, stored in self._points:
            if np.array_equal(asked, z):
                return stored
        vector = self.objective.box.nearest(z * self.x_unit)
        evaluation = self.objective(vector)
        values = None
        if not evaluation.refused:
            try:
                values = self.constraints.at(evaluation.point)
            except REFUSALS as error:
                self.objective.failures.append(Failure(type(error).__name__, str(error)))
        point = Point(self, evaluation, values)
        self._points = [(np.array(z), point), *self._points[: STORED_POINTS - 1]]
        return point

    def functions(self, z: NDArray[np.float64]) -> Functions:
        """Return the functions at z as finite numbers, for libraries that cannot use infinity and NaN.

        A refused point has a very large loss, and the rows and derivatives of the last point that was not refused.
        """
        point = self.at(z)
        if point.refused:
            usable = self._last_usable
            return Functions(REFUSED_VALUE, usable.gradient, usable.rows, usable)
        self._last_usable = point
        return Functions(point.value, point.gradient, point.rows, point)

    def _units_of_x(self, first):
        """Return the unit of each entry of x."""
        gradient_norm = norm(first.gradient)
        length = abs(first.value) / gradient_norm if gradient_norm else 0.0
        lower = np.broadcast_to(self.objective.box.lower, first.point.shape)
        upper = np.broadcast_to(self.objective.box.upper, first.point.shape)
        units = []
        for x, low, high in zip(*(self.packing.split(vector) for vector in (first.point, lower, upper))):
            limits = np.abs(np.concatenate([low[np.isfinite(low)], high[np.isfinite(high)]]))
            sizes = [norm(x) / np.sqrt(max(x.size, 1)), float(np.max(limits, initial=0.0)), length]
            usable = [size for size in sizes if 0 < size < np.inf]
            units.append(np.full(x.shape, power_of_two(usable[0]) if usable else 1.0))
        return np.concatenate(units)

    def projected_step(self, point: Point, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return z minus the projection of z - gradient onto the bounds: the gradient where no bound is near."""
        return point.z - self.box.nearest(point.z - gradient)

    def optimality(self, point: Point, multipliers: NDArray[np.float64]) -> float:
        """Return the norm of the residuals of the optimality conditions, relative to the gradient of the loss.

        The residuals are the projected gradient of the Lagrangian and the products of inequalities with their
        multipliers. They are divided by the larger of the norms of the gradients at the start and at the point.
        """
        residual = self.projected_step(point, point.gradient + point.vjp(multipliers))
        products = np.where(self.equality, 0.0, multipliers * np.minimum(point.rows, 0.0))
        size = max(norm(self.start.gradient), norm(point.gradient)) or 1.0
        return hypot(norm(residual), norm(products)) / size

    def gradient_norm(self, point: Point, multipliers: NDArray[np.float64]) -> float:
        """Return the norm of the projected gradient of the Lagrangian, in the units of the user."""
        residual = self.projected_step(point, point.gradient + point.vjp(multipliers))
        return norm(residual * (self.loss_unit / self.x_unit))

    def estimated_multipliers(self, point: Point) -> NDArray[np.float64]:
        """Return the multipliers that minimize the sum of the squares of the residuals of the optimality conditions.

        Multipliers of inequalities are >= 0. The set of bounds that are active is found by iteration.
        """
        from scipy.optimize import lsq_linear

        multipliers = np.zeros(point.rows.size)
        near = np.flatnonzero(self.equality | (point.rows >= -NEAR_ACTIVE))
        if not near.size:
            return multipliers
        jacobian = point.jacobian[near]
        slack = np.where(self.equality, 0.0, np.minimum(point.rows, 0.0))[near]
        least = np.where(self.equality[near], -np.inf, 0.0)
        distance = np.minimum(point.z - self.box.lower, self.box.upper - point.z)
        free = distance > NEAR_BOUND
        for _ in range(REFINEMENTS):
            matrix = np.concatenate([jacobian[:, free].T, np.diag(slack)])
            target = np.concatenate([-point.gradient[free], np.zeros(near.size)])
            orthogonal, triangular = np.linalg.qr(matrix)
            found = lsq_linear(triangular, orthogonal.T @ target, (least, np.inf), method="bvls", tol=1e-15)
            multipliers[near] = found.x
            lagrangian_gradient = point.gradient + multipliers[near] @ jacobian
            held = self.projected_step(point, lagrangian_gradient) != lagrangian_gradient
            wrong = ~free & ~held
            if not wrong.any():
                break
            free = free | wrong
        return multipliers

    def violation_is_stationary(self, point: Point) -> bool:
        """Return whether no small step reduces the sum of the squares of the violations."""
        signed = point.signed_violations
        gradient = self.projected_step(point, point.vjp(signed))
        by_row = []
        for row in np.argsort(-point.violations, kind="stable")[:LARGEST_ROWS]:
            of_row = np.zeros(signed.size)
            of_row[row] = signed[row]
            by_row.append(norm(point.vjp(of_row)))
        return norm(gradient) <= INFEASIBLE * max(by_row, default=0.0)


class Violation:
    """Half the sum of the squares of the violations, as an objective for L-BFGS; it is infinite at refused points.

    Attributes
    ----------
    box : Box
    """

    def __init__(self, problem: ConstrainedProblem):
        self._problem = problem
        self.box = problem.box

    def of_point(self, point: Point) -> Evaluation:
        """Return the value and the gradient at a point."""
        if point.refused:
            return Evaluation(point.z, np.inf, np.full_like(point.z, np.nan))
        signed = point.signed_violations
        value = 0.5 * float(np.dot(signed, signed))
        return Evaluation(point.z, value, point.vjp(signed), self._problem.packing.eps * value)

    def __call__(self, z: NDArray[np.float64], below: float = np.inf) -> Evaluation:
        """Return the value and the gradient at z."""
        return self.of_point(self._problem.at(z))


class Best(NamedTuple):
    """The best point of a run so far, with its multipliers, feasibility and optimality."""

    point: Point
    multipliers: np.ndarray
    optimality: float


class ConstrainedRun:
    """The history, the best point and the convergence test of a run.

    Parameters
    ----------
    problem : ConstrainedProblem
    method : str
    maxiter : int
    tolerance : float or callable
    callback : callable or None
    progress : progress bar or range
        An iterable with one entry for each iteration; a progress bar is advanced.

    Attributes
    ----------
    history : list of Record
    message : str
    converged : bool
    stopped_by_user : bool
        Whether the callback or Ctrl-C has ended the run.
    best : Best
    last : Point
        The point of the last record.
    """

    best: Best
    last: Point

    def __init__(
        self,
        problem: ConstrainedProblem,
        method: str,
        maxiter: int,
        tolerance: Any,
        callback: Callable[[Record, Any], Any] | None,
        steps: Any,
    ):
        self.problem = problem
        self.method = method
        self.maxiter = maxiter
        self._tolerance = tolerance
        self._callback = callback
        self._steps = None if isinstance(steps, range) else steps
        self._first_second = time.perf_counter()
        self._first_solve = thread.solves
        self.history: list[Record] = []
        self.message = ""
        self.converged = False
        self.stopped_by_user = False
        self._nearly = max(NEARLY, ROUNDINGS * problem.packing.eps if problem.packing.eps > 1e-10 else 0.0)

    @property
    def feasible(self) -> float:
        """The largest violation that counts as feasible."""
        if callable(self._tolerance):
            return FEASIBLE
        return max(self._tolerance, FEASIBLE)

    def record(self, point: Point, multipliers: NDArray[np.float64] | None = None) -> None:
        """Record a point as one iteration. The default of `multipliers` is a least-squares estimate.

        Raises
        ------
        RunEnded
            If the run has converged, or is ended by the callback or by maxiter.
        """
        problem = self.problem
        if multipliers is None:
            multipliers = problem.estimated_multipliers(point)
        optimality = problem.optimality(point, multipliers)
        record = Record(
            len(self.history),
            point.evaluation.value,
            problem.gradient_norm(point, multipliers),
            time.perf_counter() - self._first_second,
            problem.objective.count,
            problem.objective.pop_failures(),
            thread.solves - self._first_solve,
            point.violation,
            optimality,
        )
        self.history.append(record)
        self.last = point
        candidate = Best(point, multipliers, optimality)
        if record.iteration == 0 or self._is_better(point, self.best.point):
            self.best = candidate
        if self._steps is not None and record.iteration:
            self._steps.update()
            self._steps.set_postfix_str(record.summary())
        if self._meets_tolerance(record):
            self.best = candidate
            self.converged = True
            self.message = f"converged: feasibility {point.violation:.1e}, optimality {optimality:.1e}"
        elif self._callback is not None and record.iteration > 0:
            if self._callback(record, problem.packing.unpack(point.evaluation.point)):
                self.message = "stopped by the callback"
                self.stopped_by_user = True
        if not self.message and record.iteration >= self.maxiter:
            self.message = f"stopped after {self.maxiter} iterations, the limit maxiter"
        if self.message:
            raise RunEnded(self.message)

    def _meets_tolerance(self, record):
        """Return whether a record is feasible and optimal."""
        if callable(self._tolerance):
            return record.feasibility <= FEASIBLE and bool(self._tolerance(record, self.history[0]))
        return max(record.feasibility, record.optimality) <= self._tolerance

    def _is_better(self, point, other):
        """Return whether a point is better: feasible first, then the lower loss, or else the smaller violation."""
        if max(point.violation, other.violation) <= self.feasible:
            return point.value < other.value
        return point.violation < other.violation

    def close(self) -> None:
        """Close the progress bar."""
        if self._steps is not None:
            self._steps.close()

    def library_ended(self, reason: str) -> None:
        """Set the message after a method has ended by itself, without meeting the tolerance."""
        best = self.best
        self.message = f"stopped: {reason}"
        if max(best.point.violation, best.optimality) <= self._nearly:
            self.converged = True
            self.message = (
                f"converged to rounding: feasibility {best.point.violation:.1e}, optimality {best.optimality:.1e} "
                f"({reason})"
            )

    def _explained_violation(self, best):
        """Return the result of a run without a feasible point, and its message.

        Unless the user has stopped the run, the sum of the squares of the violations is minimized from the best point.
        """
        problem = self.problem
        message = f"{self.message}; the constraints are violated by up to {best.point.violation:.1e} of their units"
        if self.stopped_by_user:
            return best, message
        violation: Any = Violation(problem)
        lbfgs = LBFGS()
        state = lbfgs.begin(violation.of_point(best.point))
        point = best.point
        for _ in range(min(self.maxiter, MOST_RESTORING)):
            try:
                state = lbfgs.advance(state, violation)
            except NoStepFound:
                break
            point = problem.at(state.current.point)
            if point.violation <= self.feasible:
                return best, f"{message}; there are feasible points: write a larger maxiter or another start"
        if not problem.violation_is_stationary(point):
            return best, message
        message = (
            "infeasible: near x no step reduces the violation of the constraints, which is "
            f"{point.violation:.1e} of their units; {self.message}"
        )
        return Best(point, best.multipliers, problem.optimality(point, best.multipliers)), message

    def minimum(self) -> Minimum:
        """Return the result of the run."""
        problem = self.problem
        best = self.best
        message = self.message
        if not self.converged and best.point.violation > self.feasible:
            best, message = self._explained_violation(best)
        constraints = problem.constraints
        return Minimum(
            x=problem.packing.unpack(best.point.evaluation.point),
            value=best.point.evaluation.value,
            history=tuple(self.history),
            method=self.method,
            message=message,
            converged=self.converged,
            evaluations=problem.objective.count,
            multipliers=constraints.multipliers(best.multipliers * problem.loss_unit),
            constraint_values=best.point.constraint_values(constraints),
            feasibility=best.point.violation,
            optimality=best.optimality,
        )


class ConstrainedMethod(ABC):
    """Base class of the methods of `minimize` that take constraints. A method is a dataclass of its options.

    Attributes
    ----------
    name : str
        The value of the argument `method` of `minimize`.
    takes_equalities : bool
    """

    name: ClassVar[str]
    takes_equalities: ClassVar[bool] = True

    def check_available(self) -> None:  # noqa: B027 most methods need no library
        """Raise ImportError if the library of the method is not installed."""

    def first_multipliers(self, problem: ConstrainedProblem) -> NDArray[np.float64] | None:
        """Return the multipliers of the record of the start; None: a least-squares estimate."""
        return None

    @abstractmethod
    def run(self, problem: ConstrainedProblem, run: ConstrainedRun) -> str:
        """Iterate from ``problem.start`` and call ``run.record`` with the point of each iteration.

        Returns
        -------
        str
            Why the method has ended by itself.
        """


def minimize_constrained(
    loss: Callable[[Any], Any],
    start: Any,
    method: ConstrainedMethod,
    maxiter: int,
    tolerance: Any,
    callback: Callable[[Record, Any], Any] | None,
    bounds: Any,
    other_arguments: dict[str, Any],
) -> Minimum:
    """Minimize a loss under constraints.

    Parameters
    ----------
    loss, start, maxiter, tolerance, callback, bounds
        As for `minimize`.
    method : ConstrainedMethod
    other_arguments : dict
        The arguments constraints, gradient, progress, project, batches and checkpoint of `minimize`.

    Returns
    -------
    Minimum
    """
    for name in ("project", "batches", "checkpoint"):
        if other_arguments[name] is not None:
            raise TypeError(f"{method.name} does not use {name}; leave it out")
    if hasattr(tolerance, "inside"):
        raise TypeError(f"{method.name} does not use the tolerance dp.certified; write a number")
    method.check_available()
    packing = Packing(start, "start")
    box = Box(bounds, packing)
    constraints = Constraints(other_arguments["constraints"], packing)
    objective = Objective(loss, other_arguments["gradient"], packing, box, Batches(None))
    problem = ConstrainedProblem(objective, constraints, packing)
    steps = shown_steps(other_arguments["progress"], range(maxiter), "minimize")
    run = ConstrainedRun(problem, method.name, maxiter, tolerance, callback, steps)
    try:
        first = problem.begin(box.nearest(packing.pack(start)))
        if problem.equality.any() and not method.takes_equalities:
            raise ValueError(
                f"{method.name} takes inequalities only, and there are equalities; write method='augmented_lagrangian'"
            )
        run.record(first, method.first_multipliers(problem))
        run.library_ended(method.run(problem, run))
    except RunEnded:
        pass
    except KeyboardInterrupt:
        if not run.history:
            raise
        run.message = "interrupted"
        run.stopped_by_user = True
    finally:
        run.close()
    return run.minimum()
