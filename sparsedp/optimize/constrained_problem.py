"""A problem with constraints in units of size 1: points, functions for the libraries, optimality and multipliers."""

from __future__ import annotations

from functools import cached_property
from math import hypot
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.pytree import norm, power_of_two
from sparsedp.optimize.box import Box
from sparsedp.optimize.objective import TRIAL_ERRORS, Objective
from sparsedp.optimize.result import Evaluation, Failure
from sparsedp.solvers.cache import Cache

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing
    from sparsedp.optimize.constraints import Constraints, ConstraintValues

__all__ = ["ConstrainedProblem", "Point", "Violation"]

REFUSED_VALUE = 1e30  # the loss at a refused point, for libraries that cannot use infinity
NEAR_ACTIVE = 0.1  # rows below minus this number are inactive when multipliers are estimated
NEAR_BOUND = 1e-4  # entries of z that are closer to a bound are first assumed to be held there, for the same purpose
REFINEMENTS = 5  # number of corrections of the set of entries at bounds when multipliers are estimated
STORED_POINTS = 2
LARGEST_ROWS = 20  # number of rows, those with the largest violations, with which the gradient of all is compared
STATIONARY_VIOLATION = 1e-3  # ratio of |J^T c| to the largest |J_i c_i| below which no step reduces the violation


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
        self._failed = False
        self._products = Cache(1)
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
        return self.evaluation.refused or self.constraints is None or self._failed

    def refuse(self) -> None:
        """Mark the point as refused, because a derivative of a constraint could not be computed."""
        self._failed = True

    def vjp(self, v: NDArray[np.float64]) -> Any:
        """Return J^T v, where J is the Jacobian of the rows: by J if it is known, else by a stored backward pass."""
        assert self.constraints is not None
        if "jacobian" in vars(self):
            return v @ self.jacobian
        product = self._products.find((v,))
        if product is None:
            product = self._products.put((v,), self._x_unit * self.constraints.vjp(v))
        return product

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

    @property
    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lower and the upper bounds of z as arrays of shape (n,), infinite where there are none."""
        shape = self.start.z.shape
        return np.broadcast_to(self.box.lower, shape), np.broadcast_to(self.box.upper, shape)

    @property
    def least_rows(self) -> NDArray[np.float64]:
        """The lower limits of the rows, shape (m,): 0 for equalities, minus infinity for inequalities."""
        return np.where(self.equality, 0.0, -np.inf)

    def at(self, z: NDArray[np.float64]) -> Point:
        """Return the point at z, which is clipped to the bounds. The last points are stored."""
        z = self.box.nearest(z)
        for asked, stored in self._points:
            if np.array_equal(asked, z) or np.array_equal(stored.z, z):
                return stored
        vector = self.objective.box.nearest(z * self.x_unit)
        evaluation = self.objective(vector)
        values = None
        if not evaluation.refused:
            try:
                values = self.constraints.at(evaluation.point)
            except TRIAL_ERRORS as error:
                self.objective.failures.append(Failure(type(error).__name__, str(error)))
        point = Point(self, evaluation, values)
        self._points = [(np.array(z), point), *self._points[: STORED_POINTS - 1]]
        return point

    def derive(self, point: Point, derivative: Callable[[], Any]) -> Any:
        """Return a derivative of the constraints at a point.

        If it cannot be computed, the point is refused, and None is returned. At the start the exception is raised.
        """
        if point.refused:
            return None
        try:
            return derivative()
        except TRIAL_ERRORS as error:
            if point is self.start:
                raise
            self.objective.failures.append(Failure(type(error).__name__, str(error)))
            point.refuse()
            return None

    def functions(self, z: NDArray[np.float64]) -> Functions:
        """Return the functions at z as finite numbers, for libraries that cannot use infinity and NaN.

        A refused point has a very large loss, and the rows and derivatives of the last point that was not refused.
        """
        point = self.at(z)
        self.derive(point, lambda: point.jacobian)
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
        return np.clip(gradient, point.z - self.box.upper, point.z - self.box.lower)  # without cancellation for large z

    def optimality(self, point: Point, multipliers: NDArray[np.float64]) -> float:
        """Return the norm of the residuals of the optimality conditions, relative to the gradient of the loss.

        The residuals are the projected gradient of the Lagrangian and the products of inequalities with their
        multipliers. They are divided by the larger of the norms of the gradients at the start and at the point.
        """
        residual = self.projected_step(point, point.gradient + point.vjp(multipliers))
        products = np.where(self.equality, 0.0, multipliers * np.minimum(point.rows, 0.0))
        size = max(norm(self.start.gradient), norm(point.gradient)) or 1.0
        return hypot(norm(residual), norm(products)) / size

    def gradient_in_x(self, point: Point, multipliers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the projected gradient of the Lagrangian, in the units of the user."""
        residual = self.projected_step(point, point.gradient + point.vjp(multipliers))
        return residual * (self.loss_unit / self.x_unit)

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
            solution = lsq_linear(triangular, orthogonal.T @ target, (least, np.inf), method="bvls", tol=1e-15)
            multipliers[near] = solution.x
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
        return norm(gradient) <= STATIONARY_VIOLATION * max(by_row, default=0.0)


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
        signed = point.signed_violations
        gradient = self._problem.derive(point, lambda: point.vjp(signed))
        if point.refused:
            return Evaluation(point.z, np.inf, np.full_like(point.z, np.nan))
        value = 0.5 * float(np.dot(signed, signed))
        return Evaluation(point.z, value, gradient, self._problem.packing.eps * value)

    def __call__(self, z: NDArray[np.float64], below: float = np.inf) -> Evaluation:
        """Return the value and the gradient at z."""
        return self.of_point(self._problem.at(z))
