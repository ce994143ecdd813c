"""Continuation: the curve of steady states x(p) with F(x, p) = 0, followed in a parameter p, around its folds.

Notes
-----
z = (x, p) is one vector. From a point z_0 with the unit tangent t, a predictor z_0 + s t is corrected by Newton's
method on the bordered system

    F(x, p) = 0,        c . (z - z_0) = s.

c is the tangent in units of the arc length (pseudo-arclength), or c = (0, 1), which fixes p (natural continuation).
At a fold J = dF/dx is singular, but the bordered matrix [[J, F_p], [c_x, c_p]] is not. Its solves take one solve with
J^T and two with J, in an order that loses no digits where J is nearly singular (mixed block elimination). So the
Jacobians, their pattern and the linear solvers are those of `implicit`.

At a fold, the component of the tangent along p changes its sign. The fold is the zero of this component as a function
of s, which is found by regula falsi. Two folds may lie within one step. The cubic through both ends of a step with
their slopes dp/ds shows where the slope is least between them. If it is small there, the point there is computed, and
both parts are tested in the same way.

References
----------
H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, in: P. Rabinowitz (ed.), Applications
of Bifurcation Theory, Academic Press, 1977, 359-384.
W. Govaerts, J. D. Pryce, Mixed block elimination for linear systems with wider borders, IMA J. Numer. Anal. 13 (1993)
161-180.
E. L. Allgower, K. Georg, Numerical Continuation Methods, Springer, 1990.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.pytree import leaves, mapped
from sparsedp._utils.validation import (
    EPS,
    check_choice,
    check_function,
    check_integer,
    check_number,
    check_takes,
    check_whole,
)
from sparsedp.autodiff.backend import require_arrays
from sparsedp.autodiff.derivative import push
from sparsedp.autodiff.program_trace import opaque, recording_trace
from sparsedp.autodiff.tape import isbox, plain
from sparsedp.errors import ConvergenceError, DerivativeError, JitError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.solvers.newton import Equation, Newton, Unknowns
from sparsedp.solvers.roots import Root, implicit
from sparsedp.solvers.scaling import length
from sparsedp.solvers.solve import Run

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sparsedp.solvers.jacobian import Jacobians, Linearisation

__all__ = ["Branch", "Fold", "continuation"]

METHODS = ("arclength", "natural")
FIRST_STEP = 0.05  # of the range of the parameter, if none is given
LARGEST_STEP = 0.1  # the same of the largest step
SMALLEST_STEP = 1e-7  # share of the largest step; a shorter one has failed
CORRECTOR_STEPS = 15  # largest number of Newton steps of a corrector
NEWTON_STEPS_AT_EQUAL_LENGTH = 7.0  # Newton steps of a corrector after which the next step has the same length
ANGLE_AT_EQUAL_LENGTH = 0.15  # angle between successive tangents after which the next step has the same length
LARGEST_ANGLE = 0.5  # a step that turns the tangent by more is repeated with half its length
GROWTH = 2.0  # largest factor from one step to the next
NUDGE = 1e-7  # arc length by which the point of a singular Jacobian is moved
FOLD_TOLERANCE = 1e-8  # component along p of the unit tangent at a fold; the error of p is of the order of its square
FOLD_STEPS = 40  # largest number of steps towards a fold
SLOPE_NOISE = 1e-13  # component along p of a unit tangent below which its sign is rounding
RECHECKS = 3  # solves of a corrector, each of which starts with the Jacobian at the end of the one before
FOLD_ACCURACY = 1e-6  # factor on the tolerance for points near a fold, whose parameter becomes the one of the fold
SMALL_SLOPE = 0.25  # share of the larger slope at the ends of a step: a smaller slope between them is computed
SLOPE_TOLERANCE = 0.5  # largest relative error of a predicted slope for which the search for folds ends
SLOPE_STEPS = 10  # largest depth of the search for two folds within a step
SHORTEST_RANGE = 1e4 * EPS  # of the parameter, as a share of its values
FOLD_MARGIN = 10.0  # in units of the square root of rtol: component along p below which a state has no derivative


def continuation(
    residual: Callable[..., Any],
    guess: Any,
    start: float,
    stop: float,
    *params: Any,
    method: str = "arclength",
    step: float | None = None,
    largest_step: float | None = None,
    maxsteps: int = 200,
    **options: Any,
) -> Branch:
    """Follow the steady states of residual(x, p, *params) = 0 in the parameter p from `start` to `stop`.

    Parameters
    ----------
    residual : callable
        ``residual(x, p, *params)`` as in `steady`; p is a number.
    guess : number, array, or tree of arrays
        Initial guess of the steady state at p = `start`.
    start, stop : float
        Range of the parameter. `stop` may be less than `start`.
    *params : trees of arrays
        Other parameters of the residual, which are constant along the branch.
    method : "arclength" or "natural"
        "arclength" follows the branch around folds, where p turns back (pseudo-arclength continuation). "natural"
        gives p a new value in each step; it raises ConvergenceError at a fold.
    step : float, optional
        Length of the first step, in units of p: see Notes; at most `largest_step`. Default: a twentieth of the range.
    largest_step : float, optional
        Largest length of a step, in units of p; at most the range. Default: a tenth of the range, or `step` if that is
        longer.
    maxsteps : int
        Largest number of steps.
    **options
        Options of `implicit`: rtol, maxiter (of the first point), jacobian, sparsity, and options of the linear solves.

    Returns
    -------
    Branch
        `.parameter` and `.states` are the points in their order along the branch, `.folds` its folds.
        ``branch.solve(i, p, *params)`` returns the steady state near point i, with derivatives.

    Raises
    ------
    TypeError
        If an argument has another type, or a field is distributed over ranks.
    ValueError
        If `stop` equals `start` up to rounding, their distance overflows, or a setting is out of range.
    ConvergenceError
        If there is no steady state at `start` near the guess: `error.best` is the best iterate of Newton's method. Or
        if steps become too short, as where a branch ends or goes to infinity: `error.branch` is the branch up to there,
        with the status "stopped", and `error.best` its last steady state.
    NonFiniteError, ShapeError, DerivativeError
        As `steady`. Also DerivativeError if an argument is traced by a derivative: see `Branch.solve`.
    JitError
        While `dp.jit` records: the number of steps depends on the values.

    See Also
    --------
    steady, implicit, eigenpairs

    Notes
    -----
    **End.** The branch ends at p = `stop` (`branch.status` is "reached_stop"), or, after a fold, where it returns to
    p = `start` ("returned_to_start"), or after `maxsteps` steps ("max_steps"). The last point is exactly at `stop` or
    `start` in the first two cases. A fold whose parameter is `stop` or `start` within `rtol` of the range ends it too.
    A branch that goes to infinity, as x = p exp(x) does for p -> 0, ends after `maxsteps` steps or with
    ConvergenceError.

    **Steps.** The length of a step combines the changes of p, in units of the range, and of x, each field in units of
    its largest norm so far, or of its change over the range at the rate at `start` if that is larger. A step is
    repeated with half its length if Newton's method fails, or if the tangents at its ends differ by more than half a
    radian from each other or from the straight line between these points. The next one is up to twice as long if
    Newton's method was fast and the tangent turned little.

    **Folds.** A fold lies between two points at which p moves in opposite directions. Where p nearly stops within a
    step, further points are computed, so that two folds within one step are found as well. A fold is located so that p
    is exact up to rounding and `rtol`, and is inserted as a point of the branch. At a fold the Jacobian is singular:
    the steady state there has no derivative in the parameters.

    **Branch points.** The branch is continued straight on where another one crosses it, as at a pitchfork. To follow
    the other one, add a small multiple of the null vector of the Jacobian to a state, and start again.

    **Cost.** A step takes one or two Jacobians, and three solves and two tangent solves with each. Points are stored.

    References
    ----------
    H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, in: P. Rabinowitz (ed.),
    Applications of Bifurcation Theory, Academic Press, 1977, 359-384.

    Examples
    --------
    The steady states of x' = p + 3 x - x^3 have folds at p = 2, x = -1 and at p = -2, x = 1:

    >>> from sparsedp import grad
    >>> branch = continuation(lambda x, p: p + 3 * x - x**3, -3.0, -4.0, 4.0)
    >>> branch.status
    'reached_stop'
    >>> [round(fold.parameter, 12) for fold in branch.folds]
    [2.0, -2.0]
    >>> round(grad(lambda p: branch.solve(-1, p))(4.0), 12) == round(1 / (3 * branch.states[-1] ** 2 - 3), 12)
    True
    """
    check_function("continuation", residual, "lambda x, p: ...")
    arguments = [guess, start, stop, params, step, largest_step]
    if recording_trace(leaves(arguments)) is not None:
        raise JitError("dp.jit cannot record continuation, whose steps depend on values; call it without dp.jit")
    if any(map(isbox, leaves(arguments))):
        raise DerivativeError(
            "continuation returns plain numbers; differentiate branch.solve(index, p, *params), which solves for the "
            "steady state near a point"
        )
    require_arrays("continuation", map(plain, leaves((guess, params))))
    check_choice("method of continuation", method, METHODS)
    start = check_number("start", start)
    stop = check_number("stop", stop)
    if abs(0.5 * stop - 0.5 * start) <= 0.5 * SHORTEST_RANGE * max(abs(start), abs(stop)):
        raise ValueError(
            "continuation needs a range of the parameter that is long beside rounding errors, "
            f"got start = {start!r} and stop = {stop!r}"
        )
    span = abs(stop - start)
    if not np.isfinite(span):
        raise ValueError(
            f"the range of continuation must be finite, got start = {start!r} and stop = {stop!r}; give the parameter "
            "in other units"
        )
    step = FIRST_STEP * span if step is None else check_number("step", step, "> 0")
    if largest_step is None:
        largest_step = max(LARGEST_STEP * span, step)
    else:
        largest_step = check_number("largest_step", largest_step, "> 0")
    largest_step = min(largest_step, span)
    maxsteps = check_whole("maxsteps", maxsteps, 1)
    root = BranchRoot(*implicit(residual, **options).recipe()[1])
    names = ["p", *(f"param_{number}" for number in range(len(params)))]
    check_takes("continuation", residual, 2 + len(params), f"lambda x, {', '.join(names)}: ...")
    curve = Curve(root, guess, params)
    if not curve.unknowns.size:
        raise ShapeError("continuation needs a guess with at least one number, got none")
    steps = Steps(start, stop, min(step, largest_step) / span, largest_step / span, maxsteps)
    return Follower(curve, steps, method == "natural").follow(root, guess, params)


@dataclass(frozen=True)
class Fold:
    """A fold of a branch: the parameter turns back there.

    Attributes
    ----------
    index : int
        Its place among the points of the branch.
    parameter : float
    state : tree
        The steady state.
    null_vector : tree
        The direction in which the state moves there, of norm 1; the Jacobian maps it to 0.
    """

    index: int
    parameter: float
    state: Any
    null_vector: Any


class Branch(Frozen):
    """The steady states along a branch, returned by `continuation`.

    Attributes
    ----------
    parameter : array, shape (n,)
        The values of the parameter, in the order of the points along the branch.
    states : list of trees
        The steady states.
    folds : list of Fold
    status : "reached_stop", "returned_to_start", "max_steps" or "stopped"
        "stopped" only for the `branch` of a ConvergenceError.
    rejected : int
        Number of steps that were repeated with half their length.
    iterations : int
        Number of Newton steps.
    seconds : float
    root : Root
        The function root(guess, p, *params) of `implicit`, with the sparsity pattern of the Jacobian.
    param_count : int
        Number of other parameters.
    """

    parameter: NDArray[Any]
    states: list[Any]
    folds: list[Fold]
    status: str
    rejected: int
    iterations: int
    seconds: float
    root: Root
    param_count: int

    @property
    def params(self) -> int:
        """The same as `param_count`."""
        return self.param_count

    @opaque
    def solve(self, index: int, p: Any, *params: Any) -> Any:
        """Solve for the steady state at the parameter p, starting from point `index`.

        Parameters
        ----------
        index : int
            A point whose parameter is near p.
        p : float
        *params : trees of arrays
            The other parameters.

        Returns
        -------
        tree, like the states
            Differentiable in p and in `params`, by the rule of `implicit`: one adjoint solve.

        Raises
        ------
        ConvergenceError
            If Newton's method fails; also for a derivative at a fold up to the tolerance, where there is none.
        IndexError
            If there is no such point.
        TypeError
            If the index is not an integer, p not a number, or the number of parameters another one.
        """
        number = check_integer("index of branch.solve", index, -sys.maxsize)
        count = len(self)
        if not -count <= number < count:
            raise IndexError(f"index of branch.solve must be from {-count} to {count - 1}, got {number}")
        check_number("p of branch.solve", plain(p))
        if len(params) != self.param_count:
            raise TypeError(
                f"branch.solve takes an index, p and {self.param_count} other parameters, as many as continuation got, "
                f"got {len(params)}"
            )
        return self.root(self.states[number], p if isbox(p) else float(p), *params)

    def __len__(self) -> int:
        return len(self.states)

    def __repr__(self) -> str:
        return (
            f"<branch of {len(self)} steady states, parameter {self.parameter[0]:g} to {self.parameter[-1]:g}, "
            f"{len(self.folds)} folds, {self.status}>"
        )


class BranchRoot(Root):
    """The function of `implicit` for points of a branch, which refuses derivatives at folds.

    Attributes
    ----------
    units : array, shape (n + 1,), or None
        Arc length of a unit of each unknown and of the parameter; taken from `Curve` once there is a branch.

    Notes
    -----
    Up to the tolerance, p is known to rtol times its range. At the distance d from a fold, dx/dp varies by the share
    rtol / (2 d) within this tolerance, and the component of the tangent along p has the size of sqrt(d).
    """

    units: NDArray[Any] | None = None

    def recipe(self) -> tuple[type[Root], tuple[Any, ...]]:
        """Return the call that reconstructs this object: see _utils/base_classes.py."""
        return BranchRoot, super().recipe()[1]

    def _vjp(self, nums, ans, equation, guess, *leaves):
        self._check_slope(plain(ans), equation, leaves)
        return super()._vjp(nums, ans, equation, guess, *leaves)

    def _jvp(self, nums, tangents, ans, equation, guess, *leaves):
        self._check_slope(plain(ans), equation, leaves)
        return super()._jvp(nums, tangents, ans, equation, guess, *leaves)

    def _check_slope(self, x, equation, leaves):
        """Raise ConvergenceError if the branch is a fold up to the tolerance."""
        if self.units is None:
            return
        p, *others = map(plain, leaves)

        def of_parameter(p):
            return equation(x, p, *others)

        column = push(of_parameter, p, [1.0])[1]
        rate = self._solve(False, True, column, equation, x, p, *others)
        if self.units[-1] <= FOLD_MARGIN * np.sqrt(self.rtol) * length(self.units[:-1] * rate):
            raise ConvergenceError(
                f"the steady state at parameter {float(p):.8g} is a fold up to the tolerance, where it has no "
                "derivative; differentiate at another parameter, or write a smaller rtol"
            )


# ---- the bordered system ---------------------------------------------------------------------------------------------


class BorderedUnknowns:
    """The unknowns z = (x, p), as Newton's method uses them.

    Parameters
    ----------
    unknowns : Unknowns
        Those of x.
    """

    def __init__(self, unknowns: Unknowns) -> None:
        self.inner = unknowns
        self.shapes = [*unknowns.shapes, ()]

    def attempt(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function whose errors the caller handles."""
        return self.inner.attempt(function, *args)

    def norms(self, z: NDArray[Any]) -> NDArray[Any]:
        """Return the 2-norm of each field, and the magnitude of the last number."""
        return np.append(self.inner.norms(z[:-1]), np.abs(z[-1]))

    def spread(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return flat unknowns in which each field, and the last number, has the value given for it."""
        return np.append(self.inner.spread(numbers[:-1]), numbers[-1])

    def rounded(self, z: NDArray[Any]) -> Any:
        """Return the tree of x in the dtypes of the guess."""
        return self.inner.rounded(z[:-1])


class BorderedEquation:
    """F(x, p) = 0 and row . z = level, as a function of z and of the leaves of the other parameters.

    Parameters
    ----------
    equation : Equation
        F, with p as its first parameter.
    unknowns : BorderedUnknowns
    row : array, shape (n + 1,)
    level : float
    nudge : array, shape (n + 1,)
        By which a point is moved if its Jacobian is singular.
    """

    def __init__(
        self,
        equation: Equation,
        unknowns: BorderedUnknowns,
        row: NDArray[Any],
        level: float,
        nudge: NDArray[Any],
    ) -> None:
        self.inner = equation
        self.unknowns = unknowns
        self.row = row
        self.level = level
        self.nudge = nudge
        self.name = "continuation"
        self.needs_confirmation = False  # see Curve.point
        self.advice = ""  # a corrector that fails is repeated with a shorter step
        self.size = row.size

    def check_finite(self, values: Sequence[Any]) -> None:
        """Do nothing: the parameters were checked at the first point."""

    def __call__(self, z: Any, *values: Any) -> Any:
        """Return the residual of the bordered system."""
        F = self.inner(z[:-1], z[-1], *values)
        return anp.append(F, anp.dot(self.row, z) - self.level)

    def value(self, z: NDArray[Any], values: Sequence[Any]) -> NDArray[Any]:
        """Return the residual at plain values."""
        F = self.inner.value(z[:-1], [z[-1], *values])
        return np.append(F, self.row @ z - self.level)


class BorderedLinearisation:
    """The bordered matrix [[J, F_p], [row]] at a point.

    Parameters
    ----------
    inner : Linearisation
        J.
    column : array, shape (n,)
        F_p.
    row : array, shape (n + 1,)
    """

    singular = False

    def __init__(self, inner: Linearisation, column: NDArray[Any], row: NDArray[Any]) -> None:
        self.inner = inner
        self.column = column
        self.row = row

    @property
    def solver(self) -> Any:
        """The solver of J."""
        return self.inner.solver

    def with_row(self, row: NDArray[Any]) -> BorderedLinearisation:
        """Return the matrix with another last row."""
        return BorderedLinearisation(self.inner, self.column, row)

    def product(self, z: NDArray[Any]) -> NDArray[Any]:
        """Return the product with z."""
        return np.append(self.inner.product(z[:-1]) + self.column * z[-1], self.row @ z)

    def magnitude(self, z: NDArray[Any]) -> NDArray[Any]:
        """Return the product of the magnitudes of the entries with z >= 0."""
        top = self.inner.magnitude(z[:-1]) + np.abs(self.column) * z[-1]
        return np.append(top, np.abs(self.row) @ z)

    def step(self, F: NDArray[Any], forcing: float) -> NDArray[Any]:
        """Return the Newton step."""
        return self.solve(-F)

    @cached_property
    def _right(self) -> NDArray[Any]:
        """J^-1 F_p."""
        return self.inner.approximate(self.column)

    @cached_property
    def _left(self) -> NDArray[Any]:
        """J^-T row_x."""
        return self.inner.approximate(self.row[:-1], transposed=True)

    def solve(self, b: NDArray[Any]) -> NDArray[Any]:
        """Solve the bordered system by mixed block elimination."""
        f = b[:-1]
        g = b[-1]
        row_x = self.row[:-1]
        row_p = self.row[-1]
        with np.errstate(all="ignore"):  # a bordered matrix that is singular gives infinity, which no caller accepts
            first = (g - self._left @ f) / (row_p - self._left @ self.column)
            f = f - first * self.column
            g = g - first * row_p
            x = np.zeros_like(f)
            if np.all(np.isfinite(f)):
                x = self.inner.approximate(f)
            second = (g - row_x @ x) / (row_p - row_x @ self._right)
            return np.append(x - second * self._right, first + second)

    def tangent(self) -> NDArray[Any]:
        """Return the vector t with J t_x + F_p t_p = 0 and row . t = 1."""
        e = np.zeros(self.row.size)
        e[-1] = 1.0
        return self.solve(e)


class BorderedJacobians:
    """The source of bordered matrices, for Newton's method.

    Parameters
    ----------
    jacobians : Jacobians
        Those of F.
    """

    can_relax = False

    def __init__(self, jacobians: Jacobians) -> None:
        self.inner = jacobians

    def evaluate(
        self, equation: BorderedEquation, z: NDArray[Any], values: Sequence[Any], near: Any = None
    ) -> BorderedLinearisation:
        """Return the bordered matrix at a point, or a little further along the branch if J is singular there.

        J is singular at folds and branch points. Newton's method and the tangent need it only approximately.
        """
        try:
            linearisation = self._at(equation, z, values, near)
        except ConvergenceError:
            return self._at(equation, z + equation.nudge, values, near)
        if linearisation.inner.singular:
            return self._at(equation, z + equation.nudge, values, near)
        return linearisation

    def _at(self, equation, z, values, near):
        F = equation.inner
        x = z[:-1]
        p = z[-1]

        def of_parameter(p):
            return F(x, p, *values)

        with np.errstate(all="ignore"):
            column = push(of_parameter, p, [1.0])[1]
        return BorderedLinearisation(self.inner.evaluate(F, x, [p, *values], near), column, equation.row)

    def check_after_slow_step(self, linearisation: BorderedLinearisation) -> bool:
        """Complete the pattern of J, if entries are missing; return whether there were any."""
        return self.inner.check_after_slow_step(linearisation.inner)

    def hint(self, linearisation: BorderedLinearisation) -> str:
        """Return what the message of a failed solve should say about a Jacobian that the user supplied."""
        return self.inner.hint(linearisation.inner)


class CurvePoint(NamedTuple):
    """A point of the branch.

    Attributes
    ----------
    z : array, shape (n + 1,)
    tangent : array, shape (n + 1,)
        Of arc length 1.
    jacobian : BorderedLinearisation
        At z.
    iterations : int
        Newton steps to it.
    """

    z: NDArray[Any]
    tangent: NDArray[Any]
    jacobian: BorderedLinearisation
    iterations: int


class Curve:
    """The solutions z of F(x, p) = 0.

    Parameters
    ----------
    root : Root
    guess : tree
    params : tuple of trees

    Attributes
    ----------
    units : array, shape (n + 1,)
        Arc length of a unit of each unknown; set by the first point.
    """

    def __init__(self, root: Root, guess: Any, params: Sequence[Any]) -> None:
        self.root = root
        self.unknowns = Unknowns(guess, "continuation")
        params = mapped(self.unknowns.backend.combinable, tuple(params))
        self.equation = Equation(root.residual, self.unknowns, (0.0, *params), "continuation")
        self.values = self.equation.variables((0.0, *params))[1:]
        self.bordered = BorderedUnknowns(self.unknowns)
        self.jacobians = BorderedJacobians(root.jacobians_of(self.equation))
        self.units = np.ones(self.unknowns.size + 1)

    @property
    def parameter_row(self) -> NDArray[Any]:
        """The last row that fixes p."""
        row = np.zeros(self.units.size)
        row[-1] = 1.0
        return row

    def first_point(self, state: Any, p: float, stop: float) -> CurvePoint:
        """Return the point at p, with the tangent towards `stop`, and set the units."""
        z = np.append(self.unknowns.flat(state), p)
        try:
            jacobian = self._jacobian(z, self.parameter_row, 0.0 * z)
            is_singular = jacobian.inner.singular
        except ConvergenceError:
            is_singular = True
        if is_singular:
            raise ConvergenceError(
                f"continuation cannot start at parameter {p:g}, where the Jacobian is singular; start at another one, "
                "or fix what is free by a constant",
                best=state,
            )
        rate = jacobian.tangent()
        span = abs(stop - p)
        sizes = np.maximum(self.unknowns.norms(z[:-1]), span * self.unknowns.norms(rate[:-1]))
        sizes[sizes == 0] = np.max(sizes, initial=0.0) or 1.0
        self._sizes = sizes
        self._set_units(1.0 / span)
        return CurvePoint(z, self._unit(np.sign(stop - p) * rate), jacobian, 0)

    def _set_units(self, unit):
        self.units = np.append(self.unknowns.spread(1 / self._sizes), unit)

    def rescaled(self, point: CurvePoint) -> CurvePoint:
        """Return a point with its tangent in units of the largest norms of the fields so far."""
        sizes = np.maximum(self._sizes, self.unknowns.norms(point.z[:-1]))
        if np.all(sizes == self._sizes):
            return point
        self._sizes = sizes
        self._set_units(self.units[-1])
        return point._replace(tangent=self._unit(point.tangent))

    def _jacobian(self, z, row, nudge):
        equation = BorderedEquation(self.equation, self.bordered, row, 0.0, nudge)
        return self.jacobians.evaluate(equation, z, self.values)

    def _unit(self, t):
        return t / length(self.units * t)

    def row_along(self, tangent: NDArray[Any]) -> NDArray[Any]:
        """Return the row whose product with a step is the arc length along a unit tangent."""
        return self.units * (self.units * tangent)

    def cosine(self, one: NDArray[Any], other: NDArray[Any]) -> float:
        """Return the cosine of the angle between two unit tangents."""
        return float((self.units * one) @ (self.units * other))

    def turning(self, point: CurvePoint, following: CurvePoint) -> float:
        """Return the largest angle between the tangents at two points and the straight line between them."""
        chord = following.z - point.z
        size = length(self.units * chord)
        cosines = [self.cosine(point.tangent, following.tangent)]
        if size > 0:
            cosines += [self.cosine(chord / size, end.tangent) for end in (point, following)]
        return float(np.arccos(np.clip(min(cosines), -1.0, 1.0)))

    def point(self, near: CurvePoint, prediction: NDArray[Any], row: NDArray[Any], accuracy: float = 1.0) -> CurvePoint:
        """Return the point with row . z = row . prediction, by Newton's method from the prediction.

        `accuracy` is a factor on the tolerance.

        Raises
        ------
        ConvergenceError, NonFiniteError, UnstableStepError

        Notes
        -----
        Newton's method accepts a point by the Jacobian of its last step. If terms of the residual shrink by many orders
        of magnitude within this step, those of the Jacobian at the point itself are much smaller. So the point is
        tested again with that one, and corrected further if it fails.
        """
        nudge = NUDGE * near.tangent
        equation = BorderedEquation(self.equation, self.bordered, row, float(row @ prediction), nudge)
        run = Run()
        rtol = accuracy * self.root.rtol
        z = prediction
        jacobian = near.jacobian
        for _ in range(RECHECKS):
            iterations = run.iterations
            newton: Any = Newton(equation, self.values, self.jacobians, rtol, CORRECTOR_STEPS, run)  # type: ignore[arg-type]
            z = newton.solve(z, jacobian.with_row(row))
            if run.iterations == iterations and jacobian is not near.jacobian:
                return CurvePoint(z, self._unit(jacobian.tangent()), jacobian, run.iterations)
            jacobian = self._jacobian(z, self.row_along(near.tangent), nudge)
        raise ConvergenceError(
            f"the residual at parameter {z[-1]:.8g} is small only beside the terms of an earlier iterate",
            best=self.unknowns.rounded(z[:-1]),
        )


# ---- steps -----------------------------------------------------------------------------------------------------------


class Steps(NamedTuple):
    """The range of the parameter, and the lengths of steps in units of it."""

    start: float
    stop: float
    first: float
    largest: float
    maxsteps: int


class PathPoint(NamedTuple):
    """A point of a step, and whether it is a fold."""

    point: CurvePoint
    is_fold: bool


class Follower:
    """Steps along a curve.

    Parameters
    ----------
    curve : Curve
    steps : Steps
    is_natural : bool
        Whether each step fixes the parameter.
    """

    def __init__(self, curve: Curve, steps: Steps, is_natural: bool) -> None:
        self.curve = curve
        self.steps = steps
        self.is_natural = is_natural
        self.points: list[CurvePoint] = []
        self.folds: list[Fold] = []
        self.rejected = 0
        self.iterations = 0
        self.parameters: list[float] = []
        self.states: list[Any] = []

    def follow(self, root: BranchRoot, guess: Any, params: Sequence[Any]) -> Branch:
        """Return the branch."""
        start_time = perf_counter()
        steps = self.steps
        state = root(guess, steps.start, *params)
        self.iterations += root.info.forward.iterations if root.info.forward else 0
        point = self.curve.first_point(state, steps.start, steps.stop)
        self._append(point)
        size = steps.first
        if not self.is_natural:
            size = min(steps.first / self._speed(point), steps.largest)
        status = ""
        failure = None
        for _ in range(steps.maxsteps):
            try:
                path, status, size = self._step(point, size)
            except ConvergenceError as error:
                failure = error
                status = "stopped"
                break
            self._add(path)
            if status:
                break
            point = self.curve.rescaled(path[-1].point)
        root.units = self.curve.units
        branch = Branch(
            parameter=np.array(self.parameters),
            states=self.states,
            folds=self.folds,
            status=status or "max_steps",
            rejected=self.rejected,
            iterations=self.iterations,
            seconds=perf_counter() - start_time,
            root=root,
            param_count=len(params),
        )
        if failure is not None:
            failure.branch = branch
            raise failure
        return branch

    def _speed(self, point):
        """Return by how much p changes for a unit of arc length, in units of its range."""
        return abs(point.tangent[-1]) / abs(self.steps.stop - self.steps.start)

    def _append(self, point):
        self.iterations += point.iterations
        self.parameters.append(float(point.z[-1]))
        self.states.append(self.curve.unknowns.rounded(point.z[:-1]))

    # ------------------------------------------------------------ one step

    def _step(self, point, size):
        """Take a step.

        Returns
        -------
        path : list of PathPoint
        status : str
            The status word if the branch ends with these points, else "".
        size : float
            Length of the next step.
        """
        reason = ""
        smallest = SMALLEST_STEP * self.steps.largest
        size = max(size, smallest)
        while size >= smallest:
            try:
                following = self._point_at(point, size)
                angle = self.curve.turning(point, following)
                if angle > LARGEST_ANGLE:
                    raise ConvergenceError(f"the branch turns by {angle:.2g} radians in a step of {size:.1e}")
                path = self._path(point, following)
                if self.is_natural and len(path) > 1:
                    raise ConvergenceError(f"there are two folds in a step of {size:.1e}")
                full_path, status = self._with_folds_and_end(point, path)
                return full_path, status, min(size * _growth(following.iterations, angle), self.steps.largest)
            except (ConvergenceError, NonFiniteError, UnstableStepError) as error:
                reason = str(error)
            self.rejected += 1
            size *= 0.5
        advice = "the branch may end or go to infinity there, or the residual may have a kink"
        if self.is_natural:
            advice = "a fold may be near, write method='arclength'"
        raise ConvergenceError(
            f"continuation stopped at parameter {point.z[-1]:.8g} after {len(self.parameters) - 1} steps, as shorter "
            f"steps fail as well: {advice}; error.branch is the branch up to there; the last failure was: {reason}",
            best=self.states[-1],
        )

    def _point_at(self, point, size, accuracy=1.0):
        """Return the point at a distance along the tangent, or with the parameter that the tangent has there."""
        row = self.curve.row_along(point.tangent)
        if self.is_natural:
            row = self.curve.parameter_row
            size = size / self._speed(point)
        prediction = point.z + size * point.tangent
        return self.curve.point(point, prediction, row, accuracy)

    # ------------------------------------------------------------ folds and ends

    def _add(self, path):
        """Append points and folds to those of the branch."""
        for point, is_fold in path:
            self._append(point)
            if is_fold:
                null_vector = self.curve.unknowns.rounded(point.tangent[:-1] / length(point.tangent[:-1]))
                self.folds.append(Fold(len(self.states) - 1, self.parameters[-1], self.states[-1], null_vector))

    def _with_folds_and_end(self, point, path):
        """Return the points of a path with the folds between them, up to the end of the range, and the status word."""
        full_path: list[PathPoint] = []
        for following in path:
            if self._turns_back(point, following):
                fold = self._fold(point, following)
                status = self._end_at(fold)
                last = None
                if not status:
                    last, status = self._end(point, fold)
                full_path.append(PathPoint(fold, True) if last is None else PathPoint(last, False))
                if status:
                    return full_path, status
                point = fold
            last, status = self._end(point, following)
            full_path.append(PathPoint(following if last is None else last, False))
            if status:
                return full_path, status
            point = following
        return full_path, ""

    def _turns_back(self, point, following):
        """Return whether p turns back between two points."""
        slopes = np.array([self._slope(point.tangent), self._slope(following.tangent)])
        if self.is_natural or not np.sign(slopes[0]) * np.sign(slopes[1]) < 0:
            return False
        return bool(np.max(np.abs(slopes)) > SLOPE_NOISE)

    def _path(self, point, following, depth=0):
        """Return the points after `point` up to `following`, such that at most one fold is between neighbours."""
        slopes = self._slopes(point, following)
        if np.sign(slopes[1]) * np.sign(slopes[2]) <= 0:
            return [following]
        share, least = _smallest_slope(*slopes)
        if depth == SLOPE_STEPS or not 0 < share < 1 or least > SMALL_SLOPE * max(map(abs, slopes[1:])):
            return [following]
        row = self.curve.row_along(point.tangent)
        prediction = point.z + share * (following.z - point.z)
        middle = self.curve.point(point, prediction, row)
        self.iterations += middle.iterations
        middle = middle._replace(iterations=0)
        slope = self._slope(middle.tangent) / (row @ middle.tangent) * np.sign(slopes[1])
        if slope <= 0:
            return [middle, following]
        if abs(slope - least) <= SLOPE_TOLERANCE * slope or slope <= FOLD_TOLERANCE:
            return [following]
        before = self._path(point, middle, depth + 1)
        after = self._path(middle, following, depth + 1)
        if len(before) == len(after) == 1:
            return [following]
        return [*before, *after]

    def _slopes(self, point, following):
        """Return the mean slope dp/ds between two points, and those at both; s is the way along the first tangent.

        p is in units of its range.
        """
        row = self.curve.row_along(point.tangent)
        change = following.z - point.z
        return [self._slope(t) / (row @ t) for t in (change, point.tangent, following.tangent)]

    def _slope(self, t):
        """Return the component of a vector along p, in units of the range, so that products do not underflow."""
        return self.curve.units[-1] * t[-1]

    def _end_at(self, fold):
        """Return the status word if the parameter of a fold is an end of the range up to the tolerance."""
        start, stop = self.steps.start, self.steps.stop
        tolerance = self.curve.root.rtol * abs(stop - start)
        for limit, status in ((stop, "reached_stop"), (start, "returned_to_start")):
            if abs(fold.z[-1] - limit) <= tolerance:
                fold.z[-1] = limit
                return status
        return ""

    def _end(self, point, following):
        """Return the point between two others at which the range ends, and the status word; or None and ""."""
        start, stop = self.steps.start, self.steps.stop
        direction = np.sign(stop - start)
        tolerance = self.curve.root.rtol * abs(stop - start)
        if direction * (following.z[-1] - stop) >= -tolerance:
            limit, status = stop, "reached_stop"
        elif direction * (following.z[-1] - start) <= 0:
            limit, status = start, "returned_to_start"
        else:
            return None, ""
        share = (limit - point.z[-1]) / (following.z[-1] - point.z[-1])
        prediction = point.z + share * (following.z - point.z)
        prediction[-1] = limit
        last = self.curve.point(following, prediction, self.curve.parameter_row)
        units = self.curve.units
        if not length(units * (last.z - prediction)) <= length(units * (following.z - point.z)):
            raise ConvergenceError(f"there is no point of this branch at parameter {limit:g}")
        last.z[-1] = limit
        return last, status

    def _fold(self, point, following):
        """Return the point between two others at which the tangent has no component along p: regula falsi."""
        row = self.curve.row_along(point.tangent)
        low, high = 0.0, float(row @ (following.z - point.z))
        low_slope, high_slope = self._slope(point.tangent), self._slope(following.tangent)
        fold = following
        slope = 0.0
        for _ in range(FOLD_STEPS):
            size = (low * high_slope - high * low_slope) / (high_slope - low_slope)
            last_slope = slope
            fold = self._point_at(point, size, FOLD_ACCURACY)
            self.iterations += fold.iterations
            slope = self._slope(fold.tangent)
            if abs(slope) <= FOLD_TOLERANCE:
                return fold._replace(iterations=0)
            if not low < size < high:
                break
            if slope * high_slope > 0:
                high, high_slope = size, slope
                if slope * last_slope > 0:
                    low_slope *= 0.5  # Illinois: an end that stays loses weight
            else:
                low, low_slope = size, slope
                if slope * last_slope > 0:
                    high_slope *= 0.5
        if abs(slope) * (high - low) <= self.curve.root.rtol:
            return fold._replace(iterations=0)  # p turns back at a kink
        raise ConvergenceError(f"the fold near parameter {fold.z[-1]:.8g} is not located")


def _smallest_slope(mean, first, last):
    """Return where the slope of a cubic on [0, 1] is smallest in magnitude, given its mean and those at both ends.

    Returns
    -------
    share : float
        The place; NaN if the slope has no extreme value.
    slope : float
        The slope there, positive if it has the sign of the first one.
    """
    bend = 3 * (first + last - 2 * mean)  # the slope is first + linear t + bend t^2
    linear = 6 * mean - 4 * first - 2 * last
    if not bend * first > 0:
        return np.nan, np.nan
    share = -0.5 * linear / bend
    return share, (first + 0.5 * linear * share) * np.sign(first)


def _growth(iterations, angle):
    """Return the length of the next step divided by the length of this one."""
    by_iterations = NEWTON_STEPS_AT_EQUAL_LENGTH / max(iterations, 1)
    by_angle = ANGLE_AT_EQUAL_LENGTH / max(angle, 1e-12)
    return float(np.clip(min(by_iterations, by_angle), 1 / GROWTH, GROWTH))
