"""Newton's method with a line search on flat unknowns, accepted by a test that does not depend on scaling.

Notes
-----
With F and J at the last iterate, b = J x - F is the right-hand side of the linearised system J y = b. As for linear
systems (see solve.py), x is accepted when

    |F| <= rtol |b|,    or    |F| <= 8 eps (|J| |x| + |b|)    (converged_at_roundoff).

Except in time steps, a root that meets this must also meet it with the Jacobian at the root, because terms of F may
shrink by many orders of magnitude in the last step.

|J| |x| is taken entry by entry: otherwise unknowns of different sizes (species of 1 and 1e-10 with rates of 1e7) would
be accepted with errors that accumulate over many steps. Each field of a tree must pass the test by itself, because
pressures of 1e6 would hide a temperature that is no solution. A step must decrease the sum of all fields in these
units.

A Jacobian is reused for further steps (simplified Newton) while each leaves at most a tenth of the residual and few
steps remain. Such steps gain digits at a fixed rate, whereas a Newton step doubles them and usually ends far below the
tolerance. They continue to rtol / 1000, so that roots found either way are equally accurate.

Where no step decreases the residual, F may be rounding of terms that cancel (the 1 in exp(x) - 1). It counts as
rounding, and x as converged_at_roundoff, when |F| <= 64 eps (|J| |x| + |b| + the largest |F| so far + |F_p p|) and J
predicts F a thousand steps further: then neither J nor a kink is the reason.

Where Newton steps stall, far from a root, the solve starts again from the guess in **pseudo-time**: implicit Euler
steps of x' = -F / sign(D), linearised once each, in units of the time in which each unknown relaxes by itself,

    (J + D / tau) s = -F,        tau <- tau |F| / |F_next|      (switched evolution relaxation).

This follows a flow from the guess to its steady state, on which the residual may rise for a while. An equation without
a rate of its own, such as div v = 0 for a pressure, has D = 0. Once tau is large, Newton's method continues.

References
----------
C. T. Kelley, D. E. Keyes, Convergence analysis of pseudo-transient continuation, SIAM J. Numer. Anal. 35 (1998)
508-523.
T. S. Coffey, C. T. Kelley, D. E. Keyes, Pseudotransient continuation and differential-algebraic equations, SIAM J.
Sci. Comput. 25 (2003) 553-569.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from sparsedp._utils.counters import note
from sparsedp._utils.pytree import TreeStructure, keys, leaves
from sparsedp._utils.validation import check_finite, check_leaves, check_plain, check_precision, number_beside
from sparsedp.autodiff.backend import as_field, backend_of
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.grid.space import Space
from sparsedp.solvers.direct import DENSE_UP_TO
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.scaling import length

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sparsedp.solvers.solve import Run

__all__ = ["Equation", "Newton", "Unknowns"]

KINDS = "biuf"  # dtype kinds of numbers that unknowns and residuals may hold
HALVINGS = 30  # of a step in the line search
SUFFICIENT_DECREASE = 1e-4  # share of the decrease that a linear residual would show
SLOW = 0.25  # a step that leaves more than this share of the residual makes its Jacobian suspect
FAR_STEP = 1024.0  # in units of a Newton step: rounding is negligible there
LOOSEST_FORCING = 1e-2  # relative residual of the linear solve of a first step
REUSE_RATIO = 0.1  # a Jacobian is reused while a step leaves at most this share of the residual
MOST_REUSES = 8  # and while at most this number of steps remains
REUSE_TOLERANCE = 1e-3  # factor on the tolerance for steps with a reused Jacobian
STALL_RATIO = 0.9  # a step that leaves more than this share of the residual stalls
STALLS = 2  # consecutive steps that stall before pseudo-time is tried
# Pseudo-time steps. Of first steps of 1, 10 and 100, 10 takes the fewest steps in driven cavities.
SHORTEST_TIME, FIRST_TIME, LONGEST_TIME = 1e-3, 10.0, 1e4
TIME_GROWTH = 10.0  # largest growth of a pseudo-time step; growing 1.5 times faster loses the cavity at Re 1000
RESIDUAL_RISE = 2.0  # a pseudo-time step to more than this times the residual at the guess is not taken
TIME_REDUCTION = 0.25  # then the time step is reduced by this factor
REUSE_LU_FROM = 10_000  # unknowns: LU factors of a smaller Jacobian are no gain as a preconditioner of the next one
TINY = 1e-8  # an iterate that shrinks to less than this share of the last one may be converging to 0


# ---- the residual as a function of flat unknowns ---------------------------------------------------------------------


class Unknowns(TreeStructure):
    """The unknowns, an array or a tree of arrays, and how they lie in one flat float64 array or distributed field.

    Parameters
    ----------
    guess : number, array, or tree of arrays
        Only its structure, shapes and dtypes are used; it may be traced.
    name : str
        For messages.

    Attributes
    ----------
    shapes : list of tuples of int
    dtypes : list of dtype
        Of the solution.
    size : int
        Number of unknowns.
    space : Space
        One component for each array of the tree.
    backend : Backend
        Where the unknowns are stored.
    """

    def __init__(self, guess: Any, name: str) -> None:
        super().__init__(guess, "x")
        arrays = [plain(leaf) for leaf in leaves(guess)]
        for leaf in arrays:
            _check_unknown(leaf, name)
        self.shapes = [np.shape(leaf) for leaf in arrays]
        self.dtypes = [_solution_dtype(leaf) for leaf in arrays]
        self.is_scalar = isinstance(guess, (int, float)) and not isinstance(guess, np.generic)
        self.backend = backend_of(arrays)
        self.space = self.backend.implementation(space_of_unknowns)(name, arrays)
        self.size = self.space.size

    def flat(self, guess: Any) -> Any:
        """Return the numbers of a guess, without its trace, in one fresh float64 array."""
        arrays = [plain(leaf) for leaf in leaves(guess)]
        return self.backend.join(self.space, arrays).astype(float)

    def split(self, x: Any) -> Any:
        """Return the tree of unknowns of a flat array, which may be traced."""
        return self.build(self._fields(x))

    def _fields(self, x):
        return self.backend.split(self.space, x)

    def norms(self, x: Any) -> NDArray[Any]:
        """Return the 2-norm of each field of plain flat unknowns."""
        return np.array([length(self.backend.flat(field)) for field in self._fields(x)])

    def spread(self, numbers: NDArray[Any]) -> Any:
        """Return flat unknowns in which each field has the value given for it."""
        return self.backend.join(self.space, numbers)

    def distribute(self, x: NDArray[Any]) -> Any:
        """Return the flat unknowns of an array that every process has."""
        return self.backend.field(self.space, x)

    def attempt(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function whose errors the caller handles, and which all processes must see."""
        return self.backend.attempt(function, *args)

    def rounded(self, x: Any) -> Any:
        """Return the tree of unknowns in the dtypes of the guess; copies, because derivative rules still use x."""
        if self.is_scalar and not isbox(x):
            return float(x[0])
        convert = np.array if type(x) is np.ndarray else cast
        return self.build(list(map(convert, self._fields(x), self.dtypes)))


def space_of_unknowns(name: str, fields: Sequence[Any]) -> Space:
    """Return the space of some arrays one after the other."""
    return Space(None, "unknowns", None, [np.shape(field) for field in fields])


def _check_unknown(leaf, name):
    check_plain(name, leaf)
    check_precision(f"the guess of {name}", leaf)
    kind = dtype_of(leaf).kind
    if kind == "c":
        raise TypeError(f"{name} solves for real unknowns; give real and imaginary part as two fields")
    if kind not in KINDS:
        raise TypeError(f"{name} takes a guess of numbers, got {type(leaf).__name__}")


def _solution_dtype(leaf):
    dtype = dtype_of(leaf)
    if dtype.kind == "f":
        return dtype
    return np.dtype(float)


class Equation:
    """The residual as a function of the flat unknowns and of the floating leaves of the parameters.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)``.
    unknowns : Unknowns
    params : tuple of trees
        Leaves that are not floating (int, bool, None, str) are part of the equation.
    name : str

    Attributes
    ----------
    parameters : TreeStructure
        Of the parameters; their floating leaves are its variables.
    root_residual : float or None
        Norm of the residual at the root, once Newton's method has found it.
    """

    root_residual: float | None = None
    needs_confirmation = True  # whether a root must be tested with the Jacobian there
    advice = "; start from the solution for nearby parameters, or raise maxiter"  # in the message of a failed solve

    def __init__(self, residual: Callable[..., Any], unknowns: Unknowns, params: Sequence[Any], name: str) -> None:
        self.residual = residual
        self.unknowns = unknowns
        self.name = name
        check_leaves(f"parameters of {name}", params, containers=False)
        self.parameters = TreeStructure(params, "params", is_variable, constant)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.unknowns.size

    def variables(self, params: Sequence[Any]) -> list[Any]:
        """Return the floating leaves of parameters of this structure, traced or not."""
        return self.parameters.variables(params)

    def check_finite(self, values: Sequence[Any]) -> None:
        """Raise NonFiniteError if a plain parameter holds NaN or infinity."""
        for number, param in enumerate(self.params(values)):
            for leaf in leaves(param):
                if is_variable(leaf):
                    check_finite(f"parameter {number + 1} of {self.name}", as_field(leaf))

    def params(self, values: Sequence[Any]) -> tuple[Any, ...]:
        """Return the tuple of parameters with these floating leaves."""
        return self.parameters.build(values)

    def __call__(self, x: Any, *values: Any) -> Any:
        """Return the flat residual; differentiable in x and in the leaves."""
        return self._flat(self.residual(self.unknowns.split(x), *self.params(values)))

    def value(self, x: Any, values: Sequence[Any]) -> Any:
        """Return the flat residual of plain values."""
        with np.errstate(all="ignore"):
            result = self(x, *values)
        if isbox(result):
            raise DerivativeError(
                f"the residual of {self.name} uses a traced value that is not an argument; "
                "make it a parameter of the residual and pass it to the root"
            )
        return result

    def _residual_leaves(self, result):
        """Return the leaves of a residual; leaves of dicts and named tuples are in the order of the unknowns.

        A residual of another structure than the unknowns, such as one array or a list, is taken in its own order.
        """
        tree = self.unknowns.template
        if keys(result) is None or keys(tree) is None or isinstance(result, dict) != isinstance(tree, dict):
            return leaves(result)
        if isinstance(result, (tuple, list)) != isinstance(tree, (tuple, list)):
            return leaves(result)
        if isinstance(result, (tuple, list)) and len(result) != len(tree):
            return leaves(result)
        return self.unknowns.variables(result, "residual", owner=f" of {self.name}", advice="; return a tree like x")

    def _flat(self, result):
        parts = self._residual_leaves(result)
        size = sum(int(np.size(plain(part))) for part in parts)
        if size != self.size:
            raise ShapeError(f"the residual of {self.name} must hold {self.size} numbers, as many as x, got {size}")
        if any(dtype_of(part).kind not in KINDS for part in parts):
            raise TypeError(f"the residual of {self.name} must be real; give real and imaginary part as two fields")
        return cast(self.unknowns.backend.concatenate(self.unknowns.space, parts), np.float64)

    # ------------------------------------------------------------ products with J = dF/dx

    def tangent(self, x: Any, values: Sequence[Any]) -> Callable[[Any], Any]:
        """Return the function that maps v to J v."""

        def residual(y):
            return self(y, *values)

        def product(v):
            return push(residual, x, [v])[1]

        return product

    def transposed(self, x: Any, values: Sequence[Any]) -> Callable[[Any], Any]:
        """Return the function that maps g to J^T g."""

        def residual(y):
            return self(y, *values)

        return pullback(residual, x)[1]


# ---- the method ------------------------------------------------------------------------------------------------------


class FieldSizes(NamedTuple):
    """Norms of each field at an iterate.

    Attributes
    ----------
    residual : array
        |F|.
    data : array
        |b|, b = J x - F.
    terms : array
        |J| |x| + |b|.
    """

    residual: NDArray[Any]
    data: NDArray[Any]
    terms: NDArray[Any]


class Newton:
    """One solve of equation(x, *leaves) = 0.

    Parameters
    ----------
    equation : Equation
    leaves : sequence of plain arrays
    jacobians : Jacobians
    rtol : float
    maxiter : int
    run : Run
        The record; its figures are set here.
    is_time_step : bool
        Whether this is one of many solves of a time integration. Then the guess, the previous state, is accepted as
        the root only if it is one up to rounding, because small changes add up over many short steps. And a Jacobian
        may serve several Newton steps; for larger systems it always may.
    """

    def __init__(
        self,
        equation: Equation,
        leaves: Sequence[Any],
        jacobians: Any,
        rtol: float,
        maxiter: int,
        run: Run,
        is_time_step: bool = False,
    ) -> None:
        self.equation = equation
        self.leaves = leaves
        self.jacobians = jacobians
        self.rtol = rtol
        self.maxiter = maxiter
        self.run = run
        self.is_time_step = is_time_step
        self.may_reuse_jacobian = is_time_step or equation.size > DENSE_UP_TO
        self.x: Any = None
        self.F: Any = None
        self.units: Any = 1.0  # factors of F: of several fields each is in units of its terms
        self.size = 0.0  # |F| in these units
        self.J: Any = None
        self.is_stale = False  # whether J belongs to an earlier iterate
        self.largest_residual: Any = 0.0  # of each field, so far
        self.stalls = 0  # consecutive Newton steps that left nearly all of the residual
        self.near: Any = None  # the engine of the last Jacobian, if its LU factors can precondition the next one
        self.may_use_pseudo_time = jacobians.can_relax and not is_time_step  # it is tried once

    def solve(self, guess: Any, jacobian: Any = None) -> Any:
        """Find a root.

        Parameters
        ----------
        guess : flat unknowns
        jacobian : Linearisation, optional
            A Jacobian for the first steps. Default: that at the guess.

        Returns
        -------
        flat unknowns

        Raises
        ------
        ConvergenceError
            With the best iterate.
        """
        self.x = guess
        self.F = self._residual_at_guess(guess)
        self.start = (guess, self.F)
        self.size = self._measure(self.F)
        self.run.status = self._iterate(jacobian)
        return self.x

    def _iterate(self, jacobian):
        """Step until x is accepted, and return the status word."""
        if not np.any(self.F):
            return "converged"
        if jacobian is None:
            self._linearise()
        else:
            self.J = jacobian
            self.is_stale = True
        forcing = LOOSEST_FORCING
        if self.is_time_step:
            status = self._acceptance(0.0)
        else:
            status = self._acceptance()
        while not status:
            previous_size = self.size
            if self.run.iterations == self.maxiter:
                self._fail("max_iterations")
            step = self._newton_step(forcing)
            if self._line_search(step):
                self.run.iterations += 1
                status, forcing = self._after_step(self.size / previous_size)
            elif self.is_stale or self.jacobians.check_after_slow_step(self.J):
                self._linearise()
            else:
                status = self._status_at_rounding(step)
                if not status:
                    if not self._reach_by_pseudo_time():
                        self._fail("stagnated")
                    status = self._acceptance()
        return status

    def _after_step(self, ratio):
        """Decide what follows a step that left the share `ratio` of the residual.

        Returns
        -------
        status : str
            Empty while x is not accepted.
        forcing : float
            Relative residual to which the next step is solved for.
        """
        is_newton_step = not self.is_stale
        self.is_stale = True
        status = self._acceptance(1.0 if is_newton_step else REUSE_TOLERANCE)
        if status and not self._is_confirmed():
            self._linearise()
            return self._acceptance(), LOOSEST_FORCING
        if status or self._reuses_jacobian(ratio):
            return status, LOOSEST_FORCING
        if ratio > SLOW and is_newton_step:
            self.jacobians.check_after_slow_step(self.J)
        if ratio > STALL_RATIO and is_newton_step:
            self.stalls += 1
        else:
            self.stalls = 0
        if self.stalls >= STALLS and self._reach_by_pseudo_time():
            return self._acceptance(), LOOSEST_FORCING
        self._linearise()
        if not is_newton_step:
            return "", LOOSEST_FORCING
        return "", float(np.clip(0.9 * ratio**2, self.rtol, LOOSEST_FORCING))

    def _reuses_jacobian(self, ratio):
        """Whether the Jacobian is good enough for the remaining steps."""
        if not self.may_reuse_jacobian or ratio > REUSE_RATIO or not self.run.residual > 0:
            return False
        remaining_steps = np.log(REUSE_TOLERANCE * self.rtol / self.run.residual) / np.log(ratio)
        return bool(remaining_steps <= MOST_REUSES)

    def _residual_at_guess(self, guess):
        name = self.equation.name
        try:
            check_finite(f"the guess of {name}", guess)
            self.equation.check_finite(self.leaves)
            F = self.equation.unknowns.attempt(self.equation.value, guess, self.leaves)
            check_finite(f"the residual of {name} at the guess", F)
        except NonFiniteError:
            self.run.status = "nonfinite_input"
            raise
        return F

    # ------------------------------------------------------------ one step

    def _keep_factors(self, solver):
        """Let the LU factors of a large Jacobian precondition the solves with the next ones."""
        if self.is_time_step or solver.system.size < REUSE_LU_FROM or solver.engine.method != "direct":
            return
        solved_by_substitution = getattr(solver.engine, "inner", solver.engine) is None
        if not solved_by_substitution:
            self.near = solver.engine

    def _linearise(self):
        if self.J is not None and self.J.solver.engine.method == "schur":
            self.J = None  # two set-ups of a flow in 3-D do not fit into memory
        try:
            self.J = self.jacobians.evaluate(self.equation, self.x, self.leaves, self.near)
            self.is_stale = False
            self._keep_factors(self.J.solver)
            self._set_units()
        except ConvergenceError as error:
            self._fail(
                "setup_failed",
                f"its Jacobian has no inverse there: {error}; start from another guess, or fix a constant "
                "that is free (of a pressure p: add pin * p, pin 1 in one cell, to its equation)",
            )

    def _set_units(self):
        """Measure each of several fields in units of the size of its terms at this Jacobian."""
        if len(self.equation.unknowns.shapes) > 1:
            terms = self._field_sizes().terms
            terms[terms == 0] = np.max(terms) or 1.0  # a field that is 0 and solved: in the units of the others
            self.units = self.equation.unknowns.spread(1 / terms)
            self.size = self._measure(self.F)

    def _measure(self, F):
        return length(F * self.units)

    def _newton_step(self, forcing):
        try:
            return self.J.step(self.F, forcing)
        except ConvergenceError as error:
            self._fail("setup_failed", f"its Newton step cannot be found: {error}")

    def _line_search(self, step):
        """Take the step, or half of it, or a quarter, until the residual falls. Return whether it did."""
        share = 1.0
        for _ in range(HALVINGS):
            x = self.x + share * step
            if np.array_equal(x, self.x):
                return False
            F = self._residual_at_trial(x)
            if F is not None:
                size = self._measure(F)
                if size <= (1 - SUFFICIENT_DECREASE * share) * self.size:
                    self.x, self.F, self.size = self._zero_or(x, F, size)
                    return True
            share /= 2
        return False

    def _zero_or(self, x, F, size):
        """Return 0 in place of an iterate that shrinks to it, if 0 is a root: such iterates have no scale."""
        if size and length(x) <= TINY * length(self.x):
            zero = np.zeros_like(x)
            F_at_zero = self._residual_at_trial(zero)
            if F_at_zero is not None and not np.any(F_at_zero):
                return zero, F_at_zero, 0.0
        return x, F, size

    def _residual_at_trial(self, x):
        """Return the residual at a trial point, or None where it is not defined."""
        try:
            F = self.equation.unknowns.attempt(self.equation.value, x, self.leaves)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            return None
        if not np.all(np.isfinite(F)):
            return None
        return F

    # ------------------------------------------------------------ pseudo-time

    def _reach_by_pseudo_time(self):
        """Step in pseudo-time from the guess, once. Return whether that led near a root; else x is unchanged."""
        if not self.may_use_pseudo_time:
            return False
        self.may_use_pseudo_time = False
        note(self.equation.name, "method", "pseudo-time, as Newton steps stalled")
        stalled = (self.x, self.F, self.size)
        self.x, self.F = self.start
        self.size = self._measure(self.F)
        largest_size = RESIDUAL_RISE * self.size
        time_step = FIRST_TIME
        while SHORTEST_TIME <= time_step <= LONGEST_TIME and self.run.iterations < self.maxiter:
            self.run.iterations += 1
            time_step *= self._pseudo_time_step(time_step, largest_size)
        if time_step > LONGEST_TIME:
            self._linearise()
            return True
        self.x, self.F, self.size = stalled
        return False

    def _pseudo_time_step(self, time_step, largest_size):
        """Take one step in pseudo-time, and return the factor to the next time step; 0 if no step is possible."""
        try:
            solver = self.jacobians.relaxed_solver(self.equation, self.x, self.leaves, time_step, self.near)
            if solver is None:
                return 0.0
            self._keep_factors(solver)
            x = self.x + solver.approximate(-self.F, LOOSEST_FORCING)
        except ConvergenceError:
            return TIME_REDUCTION
        F = self._residual_at_trial(x)
        if F is None:
            return TIME_REDUCTION
        size = self._measure(F)
        if not size <= largest_size:
            return TIME_REDUCTION
        previous_size = self.size
        self.x = x
        self.F = F
        self.size = size
        if previous_size >= TIME_GROWTH * size:
            return TIME_GROWTH
        return max(previous_size / size, 0.5)

    # ------------------------------------------------------------ acceptance

    def _acceptance(self, share=1.0):
        """Return the status word if x meets this share of the tolerance or is exact up to rounding, else ""."""
        if not self.size:
            self.run.residual = 0.0
            self.run.backward_error = 0.0
            return "converged"
        residual, data, terms = self._field_sizes()
        data_norm = length(data)
        self.run.residual = length(residual) / data_norm if data_norm else 1.0
        self.run.backward_error = length(residual) / length(terms)
        self.largest_residual = np.maximum(self.largest_residual, residual)
        if not np.all(np.isfinite(terms)):
            return ""
        is_converged = residual <= share * self.rtol * data
        if is_converged.all():
            return "converged"
        is_exact = residual <= ROUNDING * terms
        if np.all(is_converged | is_exact):
            return "converged_at_roundoff"
        return ""

    def _is_confirmed(self):
        """Return whether |F| <= rtol |J x - F| also with the Jacobian at x, which takes one product.

        The one of the last iterate may be larger by many orders of magnitude, if an unknown shrinks in the last step.
        """
        if self.is_time_step or not (self.equation.needs_confirmation and self.size):
            return True
        norms = self.equation.unknowns.norms
        with np.errstate(all="ignore"):
            data = norms(self.equation.tangent(self.x, self.leaves)(self.x) - self.F)
            return bool(np.all(norms(self.F) <= self.rtol * data))

    def _field_sizes(self):
        norms = self.equation.unknowns.norms
        with np.errstate(over="ignore", invalid="ignore"):
            data = norms(self.J.product(self.x) - self.F)
            terms = norms(self.J.magnitude(np.abs(self.x))) + data
            return FieldSizes(norms(self.F), data, terms)

    def _status_at_rounding(self, step):
        """Return the status word if F, which no step decreases, is rounding, else ""."""
        residual, _, terms = self._field_sizes()
        terms = terms + self.largest_residual + self.equation.unknowns.norms(self._parameter_terms())
        far_residual = self._residual_at_trial(self.x + FAR_STEP * step)
        if far_residual is None or not np.all(residual <= 8 * ROUNDING * terms):
            return ""
        predicted = (1 - FAR_STEP) * self.F
        if length(far_residual - predicted) > 0.05 * length(predicted):
            return ""
        self.run.backward_error = length(residual) / length(terms)
        return "converged_at_roundoff"

    def _parameter_terms(self):
        """Return F_p p: the sum of the terms of F in its parameters, each as often as its degree."""
        if not self.leaves:
            return np.zeros_like(self.x)

        def residual(leaves):
            return self.equation(self.x, *leaves)

        return push(residual, list(self.leaves), self.leaves)[1]

    def _fail(self, status: str, reason: str = "") -> NoReturn:
        run = self.run
        run.status = status
        has_own_reason = bool(reason)
        if not has_own_reason:
            residual = number_beside(run.residual, self.rtol, digits=1, style="e")
            reason = f"relative residual {residual}, wanted {self.rtol:g} ({status})"
        hint = ""
        if self.J is not None:
            hint = self.jacobians.hint(self.J)
        if status == "stagnated" and self.J.singular:
            hint += "; its Jacobian is singular there, start from another guess or fix what is free by a constant"
        elif not (has_own_reason or hint or self.is_time_step):
            hint = self.equation.advice
        raise ConvergenceError(
            f"{self.equation.name} after {run.iterations} Newton steps: {reason}{hint}",
            info=run.info(),
            best=self.equation.unknowns.rounded(self.x),
        ) from None
