"""Roots of nonlinear systems, differentiable in their parameters by the implicit function theorem.

Notes
-----
x(p) with F(x, p) = 0 has, with J = dF/dx,

    J x' = -F_p p',                 so for a cotangent g of x, with J^T y = g,   p_bar = -F_p^T y.

Both linear solves are derivative rules themselves, of b, x and p: see adjoint.py.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from threading import get_ident
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.counters import note, thread
from sparsedp._utils.pytree import mapped, power_of_two
from sparsedp._utils.validation import check_function, check_takes, check_whole
from sparsedp.autodiff.backend import NUMPY, collectively
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.program_trace import opaque
from sparsedp.autodiff.tape import Rule, plain
from sparsedp.errors import DerivativeError
from sparsedp.solvers.adjoint import solve_rule, vary
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.jacobian import Jacobians
from sparsedp.solvers.newton import Equation, Newton, Unknowns
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.scaling import largest, length
from sparsedp.solvers.solve import Run

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from sparsedp.solvers.choose_method import SolveSettings
    from sparsedp.solvers.jacobian import Linearisation

__all__ = ["Root", "implicit", "negative_gradient", "product_with", "steady"]

CHANGED_ROOT = 1e-4  # relative change of a root by one more Newton step that shows that its residual has changed
CHANGED_ROOT_TOLERANCES = 1e4  # the same in units of the tolerance
CANCELLATION = 1e-12  # a residual below this share of its terms is rounding
SAME_RESIDUAL = 2.0  # a residual up to this times the first one is one of the same root, with other rounding


def implicit(
    residual: Callable[..., Any],
    jacobian: Callable[..., Any] | None = None,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int = 50,
    sparsity: Any = None,
    nullspace: str = "raise",
    **options: Any,
) -> Root:
    """Return a function root(guess, *params) that solves residual(x, *params) = 0; it is differentiable in `params`.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)`` returns as many real numbers as x has. It must be written with autograd.numpy,
        Operators and other differentiable functions. Apart from its arguments it may use constants only: the backward
        pass calls it again, so these constants must not change until then.
    jacobian : callable, optional
        ``jacobian(x, *params)`` returns the derivative of the residual in x as a sparse matrix, 2-D array or
        Operator, rows and columns in the order of the flat x. Default: computed from derivatives of
        the residual.
    method : str
        Method of the linear solves. "auto": the Jacobian is assembled if it is sparse or small, and `inverse` chooses
        the method. "krylov": only products with the Jacobian are computed. The other methods are those of `inverse`.
    rtol : float
        Relative tolerance of the nonlinear residual, and of each adjoint solve.
    maxiter : int
        Largest number of Newton steps and pseudo-time steps together.
    sparsity : sparse matrix or 2-D array, optional
        A matrix whose nonzero entries show where the Jacobian may be nonzero. Default: found by probing.
    nullspace : "raise" or "project"
        What to do if a derivative is requested and the Jacobian is singular at the root: raise ConvergenceError, or
        return the derivative without its component along the null space.
    **options
        Options of the method, as in `inverse`.

    Returns
    -------
    Root
        Call it as ``root(guess, *params)``. The guess is a number, an array or a pytree of arrays; each parameter is a
        pytree of arrays. The result x has the shapes and dtypes of the guess. The derivative with respect to the guess
        is 0. `root.info` holds the records of the last solves.

    Raises
    ------
    TypeError
        If `residual` or `jacobian` is not a function, and on use, if the guess does not hold numbers.
    ValueError
        If a setting is out of range.
    ConvergenceError
        On use, if Newton's method fails; `error.best` is the best iterate, `error.info` the record. Also
        if a derivative is requested where the Jacobian is singular.
    NonFiniteError
        On use, if the guess, a parameter or the residual at the guess holds NaN or infinity.
    ShapeError
        On use, if the residual does not have as many numbers as x.
    DerivativeError
        On use, if the residual uses a traced value that is not an argument. When a derivative is requested, also if
        `jacobian` or `sparsity` does not fit the residual at the root, or if something else that the residual uses
        has changed since the solve.

    See Also
    --------
    inverse, steady, continuation, differentiable, stepper, cut_flow

    Notes
    -----
    **Derivative.** J x' = -F_p p'. For a cotangent g of x: J^T y = g and p_bar = -F_p^T y, one adjoint solve for all
    parameters. Derivatives of every order exist.

    **Tolerance.** See newton.py. The residual may be scaled by any power of two, and each field of a tree meets the
    tolerance by itself. If Newton steps stall, the solve starts again from the guess with pseudo-time steps (except in
    `stepper`). The line search rejects a trial point at which the residual is not finite or raises UnstableStepError,
    NonFiniteError or ConvergenceError.

    **Cost.** Each Jacobian costs one Jacobian-vector product per colour, and one set-up of the linear solver. For a
    nearest-neighbour stencil there are 3 colours in 1-D, 5 in 2-D and 7 in 3-D. A Jacobian is used for one Newton step.
    With more than 64 unknowns, and in `stepper`, it is used for several steps while these converge fast. Each adjoint
    solve uses the Jacobian at the root, and all products with its transpose share one recording. The first call also
    searches the sparsity pattern. Jacobians of up to 64 unknowns are solved by dense LU. For a larger Jacobian, the
    linear solver uses the grid of the Operators in the residual if the Jacobian is symmetric on that grid.

    **Ranks.** Fields may be distributed (see `distribute`) if the residual has local coupling. Pseudo-time steps and
    `sparsity` are then not available.

    Examples
    --------
    >>> from sparsedp import value_and_grad
    >>> root = implicit(lambda x, p: x**2 - p)
    >>> root(1.0, 9.0)
    3.0
    >>> value_and_grad(lambda p: root(1.0, p))(9.0)[1]
    0.16666666666666666
    """
    check_function("implicit, as residual,", residual, "lambda x: ...")
    if jacobian is not None:
        check_function("implicit, as jacobian,", jacobian, "lambda x: ...")
    settings = check_settings(method, rtol, maxiter, nullspace, options)
    maxiter = check_whole("maxiter", maxiter, 1, "; the default is 50")
    return Root(residual, jacobian, sparsity, maxiter, replace(settings, maxiter=None))


def steady(residual: Callable[..., Any], guess: Any, *params: Any, **options: Any) -> Any:
    """Find a steady state x, for which residual(x, *params) = 0, without time integration.

    This is ``implicit(residual, **options)(guess, *params)``. For many solves, as in an optimisation, call
    ``root = implicit(residual)`` once, because `root` stores the sparsity pattern of the Jacobian.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)`` returns a pytree with the structure of x. For each field it holds the rate of change,
        or the residual of any other equation for this field. Entries of dicts are matched by name.
    guess : number, array, or tree of arrays
        Initial guess, such as the state at rest or the solution for nearby parameters. For a flow it may be
        ``{"v": faces, "p": cells}``.
    *params : trees of arrays
    **options
        Options of `implicit`: method, rtol, maxiter, jacobian, sparsity, nullspace.

    Returns
    -------
    x, like the guess
        The steady state. It is differentiable in the parameters; the derivative with respect to the guess is 0. Its
        stability is not tested.

    Raises
    ------
    TypeError, ValueError, ShapeError, DerivativeError
        As `implicit`.
    ConvergenceError
        If Newton's method and pseudo-time steps fail. Also if the Jacobian is singular, as at a fold, or if a field is
        determined only up to a constant.
    NonFiniteError
        If the guess, a parameter or the residual at the guess holds NaN or infinity.

    See Also
    --------
    implicit, continuation, eigenpairs

    Notes
    -----
    Newton's method with a line search. If it stalls, pseudo-time steps start again from the guess (see newton.py), and
    Newton's method continues from their result. Each field of a pytree meets the tolerance by itself.

    If a field is determined only up to a constant, its equation must fix one value: for a pressure p write
    ``"p": D(v) + pin * p`` with ``pin`` 1 in one cell and 0 elsewhere. D(v) = 0 then still holds in all cells.
    Velocities on faces in walls need an equation too: ``inside(rate) + v - inside(v)``. Finite differences of steady
    states, as in `check.gradient`, contain the error of the solves: write rtol=1e-13.

    **Flows in 3-D** of more than 34 000 unknowns are solved by method="schur": GMRES with a multigrid cycle for each
    component of the velocity. The number of iterations depends little on the grid, but grows with the Reynolds number;
    follow large ones by `continuation`, or write method="direct" in 2-D.

    **Cost.** Sparse LU of the Jacobian. From 10 000 unknowns on, one factorisation is used for several Newton steps: it
    is the preconditioner of GMRES for the next Jacobians. A gradient takes one more factorisation, which is stored for
    further gradients at the same root.

    **Ranks.** As for `implicit`: pseudo-time steps and `sparsity` are not available for distributed fields.

    References
    ----------
    C. T. Kelley, D. E. Keyes, Convergence analysis of pseudo-transient continuation, SIAM J. Numer. Anal. 35 (1998)
    508-523.

    Examples
    --------
    >>> from sparsedp import value_and_grad
    >>> flow = lambda x, p: {"u": x["w"] - x["u"], "w": p - x["u"] * x["w"]}
    >>> state = steady(flow, {"u": 1.0, "w": 1.0}, 9.0)
    >>> float(state["u"]), float(state["w"])
    (3.0, 3.0)
    >>> round(value_and_grad(lambda p: steady(flow, {"u": 1.0, "w": 1.0}, p)["u"])(9.0)[1], 12)
    0.166666666667
    """
    check_function("steady", residual, "lambda x: ...")
    return implicit(residual, **options)(guess, *params)


class Root(Reconstructible):
    """The differentiable function root(guess, *params) that `implicit` returns.

    Parameters
    ----------
    residual, jacobian, sparsity, maxiter
        As in `implicit`.
    settings : SolveSettings
        Settings of the linear solves.

    Attributes
    ----------
    info : SolveLog
        `.forward`: the last Newton solve (iterations: Newton steps); `.adjoint`: the last adjoint solve.
    """

    def __init__(
        self,
        residual: Callable[..., Any],
        jacobian: Callable[..., Any] | None,
        sparsity: Any,
        maxiter: int,
        settings: SolveSettings,
    ) -> None:
        self.residual = residual
        self.rtol: float = settings.rtol
        self.maxiter = maxiter
        self.name = f"implicit({getattr(residual, '__name__', type(residual).__name__)})"
        self.info = SolveLog()
        self._settings = settings
        # For each thread inside `series`: number of unknowns -> Jacobian of the last solve.
        self._series: dict[int, dict[int, Linearisation]] = {}
        self._default_jacobians = Jacobians(self.name, jacobian, sparsity, settings)
        self._jacobians = {NUMPY: self._default_jacobians}
        self._solution = Rule(self.name, self._forward, self._vjp, self._jvp)

    def recipe(self) -> tuple[type[Root], tuple[Any, ...]]:
        """Return the call that reconstructs this object: see _utils/base_classes.py."""
        jacobians = self._default_jacobians
        return Root, (self.residual, jacobians.user_jacobian, jacobians.sparsity, self.maxiter, self._settings)

    @contextmanager
    def series(self) -> Iterator[None]:
        """Return a context in which each solve starts with the Jacobian of the previous one, as in a time loop."""
        self._series[get_ident()] = {}
        try:
            yield
        finally:
            del self._series[get_ident()]

    @opaque
    @public("dp.implicit(residual)")
    def __call__(self, guess: Any, *params: Any) -> Any:
        """Solve residual(x, *params) = 0 from a guess.

        Parameters
        ----------
        guess : number, array, or tree of arrays
        *params : trees of arrays

        Returns
        -------
        x, like the guess
        """
        check_takes(self.name, self.residual, 1 + len(params), "lambda x, p: ..., and root(guess, p)")
        unknowns = Unknowns(guess, self.name)
        params = mapped(unknowns.backend.combinable, params)
        equation = Equation(self.residual, unknowns, params, self.name)
        arguments = (equation, unknowns.flat(guess), *equation.variables(params))
        return unknowns.rounded(collectively(self.name, (guess, *params), self._solution, *arguments))

    # ------------------------------------------------------------ the root as a rule of the parameters

    def _forward(self, equation, guess, *leaves):
        if thread.solve_hooks:
            x = thread.solve_hooks[-1].root(self, equation, guess, leaves)
        else:
            x = self.newton_solve(equation, guess, leaves)
        description = self.jacobians_of(equation).description or "not needed"
        note(self.name, "method", f"Newton's method, Jacobian {description}")
        return x

    def jacobians_of(self, equation: Equation) -> Jacobians:
        """Return the Jacobians object for the backend that stores the unknowns of this equation."""
        backend = equation.unknowns.backend
        jacobians = self._jacobians.get(backend)
        if jacobians is None:
            default = self._default_jacobians
            build = backend.implementation(Jacobians)
            jacobians = build(self.name, default.user_jacobian, default.sparsity, default.settings)
            self._jacobians[backend] = jacobians
        return jacobians

    def newton_correction(
        self, equation: Equation, x: Any, leaves: Sequence[Any], forcing: float, residual: Any = 0.0
    ) -> Any:
        """Return x after one Newton step towards F(x) = residual; the linear solve has the tolerance `forcing`."""
        F = equation.value(x, leaves) - residual
        if not np.any(F):
            return x
        return x + self.jacobians_of(equation).evaluate(equation, x, leaves).step(F, forcing)

    def newton_solve(self, equation: Equation, guess: Any, leaves: Sequence[Any]) -> Any:
        """Solve by Newton's method on flat unknowns, and record the solve."""
        run = Run()
        series = self._series.get(get_ident())
        is_time_step = series is not None
        jacobians = self.jacobians_of(equation)
        newton = Newton(equation, leaves, jacobians, self.rtol, self.maxiter, run, is_time_step)
        try:
            return newton.solve(guess, (series or {}).get(equation.size))
        finally:
            if newton.F is not None:
                equation.root_residual = length(newton.F)
            if run.status:  # otherwise the residual raised an error
                self.info.note(run.info(), False)
            if newton.J is not None:
                self._note_setup(newton.J)
                if series is not None:
                    series[equation.size] = newton.J

    def _note_setup(self, linearisation):
        log = linearisation.solver.log
        self.info.setup_seconds = log.setup_seconds
        self.info.hierarchy = log.hierarchy

    def _vjp(self, nums, ans, equation, guess, *leaves):
        varied, chosen = self._residual_of_leaves(nums, ans, equation, leaves)

        def pull(g):
            y = self._linear_solve(True)(g, equation, ans, *leaves)
            F, back = pullback(varied, chosen)
            self._check_root(equation, plain(ans), plain(g), plain(y), plain(F), [plain(leaf) for leaf in leaves])
            return tuple(back(-y))

        return pull

    @staticmethod
    def _residual_of_leaves(nums, x, equation, leaves):
        """Return the residual at x as a function of the leaves with argument numbers `nums`, and their values."""

        def residual(*values):
            return equation(x, *values)

        return vary(residual, leaves, [num - 2 for num in nums])

    def _check_root(self, equation, x, g, y, F, leaves):
        """Raise DerivativeError if x is no longer a root, because something that the residual uses has changed.

        To first order, the root has moved by y.F in the direction of g. If this estimate is too large, one more Newton
        step is computed to confirm it.
        """
        if equation.root_residual is None:  # not set, because x was not computed by newton_solve
            return
        if length(F) <= SAME_RESIDUAL * equation.root_residual:
            return
        tolerance = max(CHANGED_ROOT, CHANGED_ROOT_TOLERANCES * self.rtol)
        g_unit = power_of_two(largest(g))  # otherwise the products may underflow
        x_unit = power_of_two(largest(x))
        change = np.vdot(np.abs(y / g_unit), np.abs(F / x_unit))
        size = np.vdot(np.abs(g / g_unit), np.abs(x / x_unit))
        if not change > tolerance * size:
            return
        terms = np.zeros(0)
        if leaves:

            def residual(leaves):
                return equation(x, *leaves)

            terms = push(residual, leaves, leaves)[1]
        if length(F) <= CANCELLATION * length(terms):  # a root near 0, where the terms of the residual cancel
            return
        step = self._solve(False, False, F, equation, x, *leaves)
        if length(step) > tolerance * length(x):
            raise DerivativeError(
                f"the root of {self.name} no longer solves its residual: the residual uses something that has changed "
                "since the solve, such as an array that was written into; make what changes a parameter"
            )

    def _jvp(self, nums, tangents, ans, equation, guess, *leaves):
        varied, chosen = self._residual_of_leaves(nums, ans, equation, leaves)
        return self._linear_solve(False)(-push(varied, chosen, tangents)[1], equation, ans, *leaves)

    # ------------------------------------------------------------ solves with J and J^T, as rules of x, b and p

    def _linear_solve(self, transposed):
        """Return the Rule of (b, equation, x, *leaves) for s with J s = b or J^T s = b."""
        return solve_rule(self.name, self._solve, negative_gradient, product_with, transposed)

    def _solve(self, transposed, checked, b, equation, x, *leaves):
        linearisation = self.jacobians_of(equation).cached(equation, x, leaves)
        self._note_setup(linearisation)
        s, info = linearisation.solve(b, transposed)
        if transposed and info is not None:
            self.info.note(info, True)
        return s

    # ------------------------------------------------------------ words

    def __repr__(self) -> str:
        descriptions = [jacobians.description for jacobians in self._jacobians.values() if jacobians.description]
        return f"<{self.name}: Jacobian {'; '.join(descriptions) or 'not needed yet'}>"

    def __str__(self) -> str:
        used = [jacobians for jacobians in self._jacobians.values() if jacobians.description]
        return "\n".join([repr(self), *map(str, used or [self._default_jacobians])])


def negative_gradient(point: Sequence[Any], places: Sequence[int], y: Any, s: Any) -> Any:
    """Return -grad <y, J s> = -grad <s, J^T y> in the arguments of J at these places."""

    def product(*point):
        return product_with(True, y, *point)

    varied, chosen = vary(product, point, places)
    return pullback(varied, chosen)[1](-s)


def product_with(transposed: bool, s: Any, equation: Equation, x: Any, *leaves: Any) -> Any:
    """Return J s or J^T s."""
    if transposed:
        return equation.transposed(x, leaves)(s)
    return equation.tangent(x, leaves)(s)
