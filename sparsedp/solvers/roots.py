"""Roots of nonlinear systems, differentiable in their parameters by the implicit function theorem.

x(p) with F(x, p) = 0 has, with J = dF/dx,

    J x' = -F_p p',                 so for a cotangent g of x, with J^T y = g,   p_bar = -F_p^T y.

Both linear solves are rules of their own, of b, x and p: see adjoint.py.
"""

from contextlib import contextmanager
from threading import get_ident

import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.counters import note, thread
from sparsedp._utils.pytree import mapped, power_of_two
from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import check_function, check_takes, check_whole
from sparsedp.autodiff.backend import collectively, replicated
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import Rule, plain
from sparsedp.errors import DerivativeError
from sparsedp.solvers.adjoint import solve_rule, vary
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.jacobian import Jacobians
from sparsedp.solvers.newton import Equation, Layout, Newton
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.scaling import largest, length
from sparsedp.solvers.solve import Run

__all__ = ["Root", "implicit", "steady"]

CHANGED = 1e-4  # relative change of a root by one more Newton step, from which on the residual must be another one
CANCELS = 1e-12  # residual in units of its terms that is rounding
LOOSE = 1e4  # the same in units of the tolerance, which is that of the residual
MORE = 2.0  # times the residual that a solve left: the residual of the same root, with other rounding


def implicit(
    residual, jacobian=None, method="auto", rtol=1e-10, maxiter=50, sparsity=None, nullspace="raise", **options
):
    """Residual -> root(guess, *params): x of residual(x, *params) = 0, differentiable in the parameters.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)``: as many real numbers as x has, written with autograd.numpy, Operators
        and other rules. It uses only its arguments and constants; the backward pass runs it again, so arrays that are
        no arguments must stay as they are until then.
    jacobian : callable, optional
        ``jacobian(x, *params)``: the derivative of the residual in x as a sparse matrix, 2-D array or
        Operator, rows and columns in the order of the flat x. Default: from derivatives of the residual.
    method : str
        How Newton steps are solved. "auto": the Jacobian is assembled when it is sparse or small, and
        `inverse` chooses. "krylov": products with the Jacobian only. Else as in `inverse`.
    rtol : float
        Relative tolerance of the nonlinear residual, and of each adjoint solve.
    maxiter : int
        Most Newton steps, those in pseudo-time too.
    sparsity : sparse matrix or 2-D array, optional
        Where the Jacobian may have entries. Default: found by probing.
    nullspace : "raise" or "project"
        Where the Jacobian is singular at the root: refuse a derivative, or take the one without a part
        along the null space.
    **options
        Of the method, as in `inverse`.

    Returns
    -------
    Root
        in: guess, a number, an array, or a tree of arrays; params, any trees of arrays. out: x, of the
        shape and dtype of the guess. The derivative in the guess is 0. `root.info` holds the records.

    Raises
    ------
    TypeError
        If `residual` or `jacobian` is not a function, and on use, if the guess does not hold numbers.
    ValueError
        If a setting is out of range.
    ConvergenceError
        On use, if Newton's method fails; `error.best` is the best iterate, `error.info` the record. Also
        if a derivative is asked where the Jacobian is singular.
    NonFiniteError
        On use, if the guess, a parameter or the residual at the guess holds NaN or infinity.
    ShapeError
        On use, if the residual does not have as many numbers as x.
    DerivativeError
        On use, if the residual uses a traced value that is not an argument, or if `jacobian` or
        `sparsity` does not fit the residual at a root whose derivative is asked, or what else it uses has changed.

    Notes
    -----
    Formula: J x' = -F_p p'; one adjoint solve with J^T serves all parameters. Derivatives of every order.
    Tolerance: see newton.py; the residual may be scaled by any power of two, and each field of a tree is judged by
    itself. Where steps stall, pseudo-time steps from the guess (not in `stepper`). A trial point where the
    residual raises UnstableStepError, NonFiniteError or ConvergenceError, or is not finite, is not taken.
    Cost: per Jacobian one product per colour (3 for three points in 1-D, 5 in 2-D, 7 in 3-D) and one set-up: one
    for each Newton step, or for several while they contract (more than 64 unknowns, steps of `stepper`); one for
    each adjoint solve. Products with J^T share one tape. The first call also searches the pattern. J is set up on
    the grid of the Operators in the residual where it is symmetric there; up to 64 unknowns by dense LU.
    Ranks: fields in blocks too (`distribute`), where each number meets few, near ones; no pseudo-time, no `sparsity`.

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
    check_whole("maxiter", maxiter, 1, "; the default is 50")
    return Root(residual, jacobian, sparsity, settings.pop("maxiter"), settings)


def steady(residual, guess, *params, **options):
    """Residual, guess, parameters -> the steady state: x of residual(x, *params) = 0, never by a loop over time.

    It is ``implicit(residual, **options)(guess, *params)``. Where there are many solves, in a descent say, make the
    root once: ``root = implicit(residual)`` keeps what it learned of the Jacobian, and its records.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)``: the rate of change of each field, or any equation for it, as a tree like x; entries of
        dicts are paired by name.
    guess : number, array, or tree of arrays
        The state at rest, or that for nearby parameters: ``{"v": faces, "p": cells}`` of a flow.
    *params : trees of arrays
    **options
        As of `implicit`: method, rtol, maxiter, jacobian, sparsity, nullspace.

    Returns
    -------
    x, like the guess
        Differentiable in the parameters; the derivative in the guess is 0. Whether it is stable is not asked.

    Raises
    ------
    TypeError, ValueError, ShapeError, DerivativeError
        As `implicit`.
    ConvergenceError
        If Newton's method and pseudo-time fail, or the Jacobian is singular: at a fold, or where a constant is free.
    NonFiniteError
        If the guess, a parameter or the residual at the guess holds NaN or infinity.

    Notes
    -----
    Newton's method with a line search; where it stalls, pseudo-time steps from the guess (see newton.py), then Newton
    again. Each field of a tree meets the tolerance by itself. A field that is known up to a constant needs one value
    in its equation: ``"p": D(v) + pin * p`` with ``pin`` 1 in one cell and 0 elsewhere, which leaves D(v) = 0 in all
    cells. Faces in walls need an equation: ``inside(rate) + v - inside(v)``. Differences of states from a near guess
    (`check.gradient`) see the tolerance: write rtol=1e-13.
    Cost: sparse LU of the Jacobian; from 10 000 unknowns on one for several steps: GMRES with the LU of a step before
    does for the next. For a gradient one LU more, kept for each further one.
    Ranks: fields in blocks too (`distribute`), within the limits of `implicit`: no pseudo-time, no `sparsity`.
    Source: Kelley and Keyes, SIAM J. Numer. Anal. 35 (1998).

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


class Root(Remade):
    """root(guess, *params), made by `implicit`.

    Attributes
    ----------
    info : SolveLog
        `.forward`: the last Newton solve (iterations: Newton steps); `.adjoint`: the last adjoint solve.
    """

    def __init__(self, residual, jacobian, sparsity, maxiter, settings):
        self.residual, self.rtol, self.maxiter = residual, settings["rtol"], maxiter
        self.name = f"implicit({getattr(residual, '__name__', type(residual).__name__)})"
        self.info, self._settings = SolveLog(), settings
        self._series: dict = {}  # by thread, inside `series`: size -> Jacobian of the last solve
        self._jacobians = Jacobians(self.name, jacobian, sparsity, dict(settings, maxiter=None))
        self._solution = Rule(self.name, self._newton, self._vjp, self._jvp)

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        given, sparsity = self._jacobians.given, self._jacobians.sparsity
        return Root, (self.residual, given, sparsity, self.maxiter, self._settings)

    @contextmanager
    def series(self):
        """Solves inside have nearly the same Jacobian: each starts with that of the one before."""
        self._series[get_ident()] = {}
        try:
            yield
        finally:
            del self._series[get_ident()]

    @public("dp.implicit(residual)")
    def __call__(self, guess, *params):
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
        layout = Layout(guess, self.name)
        params = mapped(replicated, params) if layout.backend.whole_fields else params
        equation = Equation(self.residual, layout, params, self.name)
        given = layout.flat(guess), *equation.variables(params)
        return layout.rounded(collectively(self.name, (guess, *params), self._solution, equation, *given))

    # ------------------------------------------------------------ the root as a rule of the parameters

    def _newton(self, equation, guess, *leaves):
        solved = thread.solve_hooks[-1].root if thread.solve_hooks else Root.solved
        x = solved(self, equation, guess, leaves)
        note(self.name, "method", f"Newton's method, Jacobian {self._jacobians.way or 'not needed'}")
        return x

    def corrected(self, equation, x, leaves, share, kept=0.0):
        """One more Newton step from x, to the residual `kept`; its linear solve to the relative residual `share`."""
        F = equation.value(x, leaves) - kept
        return x + self._jacobians.fresh(equation, x, leaves).step(F, share) if np.any(F) else x

    def solved(self, equation, guess, leaves):
        """Newton's method on flat arrays, recorded in the log."""
        run, series = Run(), self._series.get(get_ident())
        newton = Newton(equation, leaves, self._jacobians, self.rtol, self.maxiter, run, series is not None)
        try:
            return newton.solve(guess, (series or {}).get(equation.size))
        finally:
            if newton.F is not None:
                equation.left = length(newton.F)
            if run.status:  # else it is an error of the residual
                self.info.note(run.info(), False)
            if newton.J is not None:
                self._note_setup(newton.J)
                if series is not None:
                    series[equation.size] = newton.J

    def _note_setup(self, known):
        log = known.solver.log
        self.info.setup_seconds, self.info.hierarchy = log.setup_seconds, log.hierarchy

    def _vjp(self, nums, ans, equation, guess, *leaves):
        places = [num - 2 for num in nums]
        varied, chosen = vary(lambda *values: equation(ans, *values), leaves, places)

        def pull(g):
            y = self._linear(True)(g, equation, ans, *leaves)
            F, back = pullback(varied, chosen)
            self._check_root(equation, plain(ans), plain(g), plain(y), plain(F), [plain(leaf) for leaf in leaves])
            return tuple(back(-y))

        return pull

    def _check_root(self, equation, x, g, y, F, leaves):
        """Refuse a derivative where x is no root any more: the residual uses something that has changed since."""
        if equation.left is None:  # somebody else gave the root, and answers for it
            return
        changed = max(CHANGED, LOOSE * self.rtol)
        if length(F) <= MORE * equation.left:  # as it was left, at a loose tolerance too
            return
        units = power_of_two(largest(g)), power_of_two(largest(x))  # the products may underflow
        gap, size = (np.vdot(np.abs(a / units[0]), np.abs(b / units[1])) for a, b in ((y, F), (g, x)))
        if not gap > changed * size:
            return
        terms = push(lambda leaves: equation(x, *leaves), leaves, leaves)[1] if leaves else np.zeros(0)
        if length(F) <= CANCELS * length(terms):  # a root near 0, where what it is made of cancels
            return
        step = self._solve(False, False, F, equation, x, *leaves)
        if length(step) > changed * length(x):
            raise DerivativeError(
                f"{self.name} is not solved any more by what it was: its residual uses something that has changed "
                "since, such as an array that was written into; make what changes a parameter"
            )

    def _jvp(self, nums, tangents, ans, equation, guess, *leaves):
        varied, chosen = vary(lambda *values: equation(ans, *values), leaves, [num - 2 for num in nums])
        return self._linear(False)(-push(varied, chosen, tangents)[1], equation, ans, *leaves)

    # ------------------------------------------------------------ solves with J and J^T, as rules of x, b and p

    def _linear(self, transposed):
        """The Rule of (b, equation, x, *leaves): s of J s = b or J^T s = b."""
        return solve_rule(self.name, self._solve, _back, _product, transposed)

    def _solve(self, transposed, checked, b, equation, x, *leaves):
        known = self._jacobians.cached(equation, x, leaves)
        self._note_setup(known)
        s, info = known.solve(b, transposed)
        if transposed:
            self.info.note(info, True)
        return s

    # ------------------------------------------------------------ words

    def __repr__(self):
        return f"<{self.name}: Jacobian {self._jacobians.way or 'not needed yet'}>"

    def __str__(self):
        return f"{self!r}\n{self._jacobians}"


def _back(point, places, y, s):
    """-grad <y, J s> = -grad <s, J^T y>: the pullback of (x, p) -> J^T y."""
    varied, chosen = vary(lambda *point: _product(True, y, *point), point, places)
    return pullback(varied, chosen)[1](-s)


def _product(transposed, s, equation, x, *leaves):
    """J s or J^T s."""
    return (equation.transposed if transposed else equation.tangent)(x, leaves)(s)
