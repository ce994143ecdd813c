"""The error of value and gradient due to inexact solves: `certify` estimates it, and `certified` controls it.

A first run of the loss records all forward and adjoint solves. A second run corrects each recorded solution x. The
error of x is A^-1 r with the residual r = b - A x. To solve this equation with relative tolerance s, and to add the
result to x, reduces the error by the factor s. If the right-hand side has changed a little, to b', the correction
solves for b' - A x instead. To keep the error of a solve and only update its right-hand side, the old residual is
subtracted, so that the correction solves for b' - A x - r. The difference between a run with corrected errors and a
run with kept errors is the error of the first run, up to the relative tolerance s.

Inside `minimize`, the value is also corrected by the sum of y . r over all solves. Here r is the remaining forward
residual, and y is the adjoint solution, which is the derivative of the loss with respect to the residual.

References
----------
N. A. Pierce and M. B. Giles, Adjoint recovery of superconvergent functionals from PDE approximations, SIAM Review 42,
2000.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import recording, thread
from sparsedp._utils.pytree import leaves, norm, paired
from sparsedp._utils.validation import check_number, is_number
from sparsedp.autodiff.derivative import unwarned, value_and_grad
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of
from sparsedp.report.explain import total
from sparsedp.solvers.scaling import length

__all__ = ["Certificate", "Certified", "certified", "certify", "distance"]

ON_RANKS = "an estimate of the error of solves (certify, certified)"  # in the message if fields are distributed
TARGET = 0.01  # default target of `certify`: relative error of the gradient
SHARE = 0.01  # relative tolerance of a correction
ROUNDING_ERROR = 1e-13  # relative errors below this are due to rounding, not to solves
LOOSEST_ADVICE = 0.1  # largest tolerance that the advice suggests
COLUMNS = ("solver", "rtol", "forward", "forward residual", "adjoint", "adjoint residual", "error")
SMALLEST_SHARE = 0.05  # relative tolerance of a correction inside minimize
LARGEST_SHARE = 0.5
MOST_CORRECTIONS = 20  # for one evaluation
ROUNDING_OF_VALUE = 1e-14


def distance(one: Any, other: Any, unit: Any = None) -> float:
    """Return the Euclidean distance of two trees, divided by the norm of `unit` (default: of the second tree).

    Leaves that are None are ignored.
    """
    advice = "; give compare=function(result, exact)"
    matched = paired(one, other, "result", " of work_precision", advice, shapes=True, error=ValueError)
    gaps = [np.subtract(a, b) for a, b in zip(matched, leaves(other)) if a is not None]
    return norm(gaps) / (norm(other if unit is None else unit) or 1.0)


# ---------------------------------------------------------------- recorded solves

SolveKey = tuple[str, str, int]  # solver name, "forward" or "adjoint", and number of the solve


class RecordedSolve(NamedTuple):
    """The solution and the residual of one solve.

    Attributes
    ----------
    x, residual : ndarray
        Flat solution and residual.
    size : float
        Norm of the right-hand side.
    rtol : float
        The requested relative tolerance.
    iterative : bool
    """

    x: NDArray[Any]
    residual: NDArray[Any]
    size: float
    rtol: float
    iterative: bool


def _every_solve(key: SolveKey) -> bool:
    """Correct each solve."""
    return True


class RecordedSolves(dict[SolveKey, RecordedSolve]):
    """A dict of the recorded solves of a run. During the run, solvers call its methods to compute their solutions.

    A nonlinear solve and the solves with its Jacobian are recorded under the same name.

    Parameters
    ----------
    earlier : dict, optional
        Solves of an earlier run. Each solve starts from the earlier solution with the same key.
    correct : callable or None
        ``correct(key)`` returns True if the error of the earlier solution is to be corrected, and False if it is to be
        kept. By default all solutions are corrected. With None, earlier solutions are reused without a solve, and all
        other solves are done with relative tolerance `share`.
    share : float
        Relative tolerance of each correction.

    Attributes
    ----------
    iterations : int
        Number of iterations of all solves of the run.
    """

    def __init__(
        self,
        earlier: dict[SolveKey, RecordedSolve] | None = None,
        correct: Callable[[SolveKey], bool] | None = _every_solve,
        share: float = SHARE,
    ) -> None:
        super().__init__()
        self.earlier = earlier or {}
        self.correct = correct
        self.share = share
        self.iterations = 0
        self._numbers: Counter[tuple[str, str]] = Counter()

    def run(self, function: Callable[[Any], Any], x: Any) -> Any:
        """Return function(x), with its solves recorded."""
        thread.solve_hooks.append(self)
        try:
            with recording() as calls, unwarned():  # unwarned: its second run would record the solves twice
                return function(x)
        finally:
            thread.solve_hooks.pop()
            self.iterations = total(calls, "iterations")

    def linear(self, solver: Any, b: NDArray[Any], transposed: bool, checked: bool, start: Any) -> NDArray[Any]:
        """Return the flat solution of a linear solve. The solver calls this in place of its own `solve`."""
        solver.system.unscaled.backend.check(ON_RANKS)
        if transposed:
            operator = solver.system.unscaled.T
        else:
            operator = solver.system.unscaled
        product = operator._flat.apply

        def solve() -> NDArray[Any]:
            if self.correct is None:
                return solver.approximate(b, self.share, transposed)
            return solver.solve(b, transposed, checked, start, observed=False)

        def residual(x: NDArray[Any]) -> NDArray[Any]:
            return b - product(x)

        def corrected(x: NDArray[Any], kept: Any) -> NDArray[Any]:
            return x + solver.approximate(residual(x) - kept, self.share, transposed)

        key = self._next_key(solver.name.removesuffix(".jacobian"), "adjoint" if transposed else "forward")
        x = self._solution(key, b.size, solve, corrected)
        self[key] = RecordedSolve(x, residual(x), length(b), solver.system.rtol, solver.engine.iterative)
        return x

    def root(self, root: Any, equation: Any, guess: NDArray[Any], leaves: Any) -> NDArray[Any]:
        """Return the flat solution of a nonlinear solve."""
        equation.unknowns.backend.check(ON_RANKS)

        def corrected(x: NDArray[Any], kept: Any) -> NDArray[Any]:
            return root.newton_correction(equation, x, leaves, self.share, -kept)

        key = self._next_key(root.name, "forward")
        x = self._solution(key, guess.size, partial(root.newton_solve, equation, guess, leaves), corrected)
        self[key] = RecordedSolve(x, -equation.value(x, leaves), 0.0, root.rtol, True)
        return x

    def _next_key(self, name: str, kind: str) -> SolveKey:
        """Return the key of the next solve, and count it."""
        number = self._numbers[name, kind]
        self._numbers[name, kind] += 1
        return name, kind, number

    def _solution(
        self,
        key: SolveKey,
        size: int,
        solve: Callable[[], NDArray[Any]],
        corrected: Callable[[NDArray[Any], Any], NDArray[Any]],
    ) -> NDArray[Any]:
        """Return ``solve()`` if there is no earlier solution, else the earlier one, corrected as `correct` decides."""
        earlier = self.earlier.get(key)
        if earlier is None or earlier.x.size != size:
            return solve()
        if self.correct is None:
            return earlier.x
        if self.correct(key):
            return corrected(earlier.x, 0.0)
        return corrected(earlier.x, earlier.residual)

    def correction(self) -> float:
        """Return the sum of y . r over all forward solves; 0 if a forward solve has no adjoint solve.

        Solves are paired by their order: the last solve of the forward pass is the first one of the backward pass.
        """
        products = [0.0]
        for (name, kind, number), solve in self.items():
            if kind == "forward":
                last = self._numbers[name, kind] - 1
                adjoint = self.get((name, "adjoint", last - number))
                if adjoint is None or adjoint.x.size != solve.residual.size:
                    return 0.0
                products.append(float(np.sum(adjoint.x * solve.residual).real))
        return sum(products)


# ---------------------------------------------------------------- certify


def certify(loss: Callable[[Any], Any], x: Any, target: float = TARGET) -> Certificate:
    """Estimate the errors of value and gradient that are due to inexact solves.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. It must be deterministic, and may contain any number of solves by `inverse`,
        `elliptic_solver`, `matrix_solver` or `implicit`.
    x : array, number, or any nesting of them in tuples, lists and dicts
    target : float
        Relative error of the gradient for which the advice is given, 0 < target < 1.

    Returns
    -------
    Certificate
        It has the attributes `.value` and `.gradient`; their estimated errors `.value_error` (absolute, with sign) and
        `.gradient_error` (relative to the norm of the gradient); `.corrected_value` and `.corrected_gradient`;
        `.causes`, the relative errors of the gradient due to forward and due to adjoint solves; `.solves`, one dict for
        each solver; and `.advice`, one sentence. str() returns a table.

    Raises
    ------
    ValueError
        If `target` is not between 0 and 1. Exceptions of the loss are not caught.
    TypeError
        If the loss solves systems of fields that are distributed over MPI ranks.

    See Also
    --------
    certified, explain, check.gradient

    Notes
    -----
    **Cost.** One gradient without corrections; then one run of the gradient, in which each solve is corrected with
    relative tolerance 1e-2, and one such run to separate the causes; if there are several solvers, one such run for
    each of them; and one run of the loss for the corrected value.

    **Limits.** The norm is Euclidean over all leaves. The estimate does not contain errors of discretisation or of
    rounding, and an estimate below 1e-13 is itself due to rounding. Wrong derivatives and wrong transposes are not
    detected; use `check.gradient` for them. A solve whose iterations are recorded on the tape counts as exact.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> from sparsedp import Grid, dirichlet, inverse, laplacian
    >>> solve = inverse(-laplacian(Grid((16, 16)), dirichlet), "krylov", rtol=1e-3)
    >>> b = np.ones((16, 16))
    >>> certificate = certify(lambda b: anp.sum(solve(b) ** 2), b)
    >>> bool(1e-6 < certificate.gradient_error < 1e-2), list(certificate.causes)
    (True, ['forward solves', 'adjoint solves'])
    """
    check_number("target of certify", target, "between 0 and 1", "; write for example target=0.01")
    value_and_gradient = value_and_grad(loss)
    solves = RecordedSolves()
    value, gradient = solves.run(value_and_gradient, x)

    def corrected_gradient(correct: Callable[[SolveKey], bool]) -> Any:
        return RecordedSolves(solves, correct).run(value_and_gradient, x)[1]

    corrected_solves = RecordedSolves(solves)
    _, best_gradient = corrected_solves.run(value_and_gradient, x)
    adjoint_corrected = corrected_gradient(lambda key: key[1] == "adjoint")
    causes = {
        "forward solves": distance(best_gradient, adjoint_corrected, gradient),
        "adjoint solves": distance(adjoint_corrected, gradient),
    }
    error = distance(best_gradient, gradient)
    names = list(dict.fromkeys(name for name, *_ in solves))
    rows = []
    for name in names:
        share = error
        if len(names) > 1:
            share = distance(corrected_gradient(partial(_is_of_solver, name)), gradient)
        rows.append(_row(name, share, solves))
    # The corrected value comes from a second correction, which also reduces the error that the first one left.
    best_value = RecordedSolves(corrected_solves).run(loss, x)
    return Certificate(
        value=value,
        gradient=gradient,
        corrected_value=best_value,
        corrected_gradient=best_gradient,
        gradient_error=error,
        value_error=best_value - value,
        causes=causes,
        solves=rows,
        rows=rows,
        advice=_advice(error, causes, rows, target),
    )


def _is_of_solver(name: str, key: SolveKey) -> bool:
    """Return whether a key belongs to the solver with this name."""
    return key[0] == name


def _row(name: str, error: float, solves: RecordedSolves) -> dict[str, Any]:
    """Return the row of one solver: numbers of forward and adjoint solves, their largest residuals, and the error."""
    own = [solve for key, solve in solves.items() if key[0] == name]
    row: dict[str, Any] = {
        "solver": name,
        "rtol": max(solve.rtol for solve in own),
        "error": error,
        "iterative": any(solve.iterative for solve in own),
    }
    for kind in ("forward", "adjoint"):
        of_kind = [solve for key, solve in solves.items() if key[:2] == (name, kind)]
        row[kind] = len(of_kind)
        residuals = [length(solve.residual) / (solve.size or inf) for solve in of_kind]
        row[f"{kind} residual"] = float(max(residuals, default=0.0))
    return row


def _advice(error: float, causes: dict[str, float], rows: list[dict[str, Any]], target: float) -> str:
    """Return a sentence that says which tolerance to change to reach the target."""
    iterative = [row for row in rows if row["iterative"]]
    if not iterative:
        return "all solves are direct: nothing to change"
    if error <= ROUNDING_ERROR:
        return "solves are exact to rounding"
    worst = max(iterative, key=lambda row: row["error"])
    if causes["adjoint solves"] > causes["forward solves"]:
        side = "adjoint"
    else:
        side = "forward solve"
    name = worst["solver"]
    rtol = worst["rtol"]
    goal = f"for {100 * target:g} %"
    advised = min(rtol * target / error, LOOSEST_ADVICE) / 2
    if error > target:
        return f"tighten the {side} of {name} from {rtol:.0e} to {advised:.0e} {goal}"
    if advised > rtol:
        return f"{name} may stop at {advised:.0e} in place of {rtol:.0e} {goal}"
    return f"the tolerances are as they should be {goal}"


class Certificate(Result):
    """The result of `certify`. Frozen.

    Attributes
    ----------
    value, corrected_value : float
    value_error : float
        Estimated, absolute, with a sign: corrected value less value.
    gradient, corrected_gradient : trees
    gradient_error : float
        Estimated, relative to the norm of the gradient, Euclidean over all leaves.
    causes : dict
        Relative error of the gradient from forward and from adjoint solves.
    solves, rows : list of dict
        One dict for each solver: name, rtol, relative error of the gradient due to this solver, whether it is
        iterative, numbers of forward and adjoint solves, and their largest relative residuals.
    advice : str
        Which tolerance to change.
    """

    _plain = ("value", "corrected_value", "value_error", "gradient_error", "causes", "solves", "advice")

    def parts(self) -> list[str | Table]:
        """Return the errors of value and gradient, the table of solvers, and the advice."""
        causes = ", ".join(f"{error:.1e} from {name}" for name, error in self.causes.items())
        return [
            f"value {self.value:.9g}, off by about {self.value_error:.1e} (absolute); "
            f"corrected {self.corrected_value:.12g}",
            f"gradient off by about {self.gradient_error:.1e} of itself: {causes}",
            table_of(self.solves, COLUMNS),
            f"advice: {self.advice}",
        ]


# ---------------------------------------------------------------- adaptive tolerances for minimize


def certified(fraction: float = 0.1, tolerance: float = 1e-8) -> Certified:
    """Return a tolerance for `minimize` that also controls the accuracy of the solves in the loss.

    Parameters
    ----------
    fraction : float
        Largest relative error of the gradient, and largest error of the value relative to its change since the last
        step, 0 < fraction < 1.
    tolerance : float
        As in `minimize`: the run has converged when the norm of the gradient has decreased by this factor.

    Returns
    -------
    Certified
        Use it for one run only: ``minimize(loss, start, tolerance=dp.certified(0.1))``. After the run, `.iterations`,
        `.evaluations` and `.passes` are the counts of work, and str() summarizes them.

    Raises
    ------
    ValueError
        If `fraction` or `tolerance` is out of range. `minimize` raises it if it is called with a gradient, because the
        solves of a given gradient cannot be controlled.

    See Also
    --------
    minimize, certify

    Notes
    -----
    The tolerances of the solvers themselves are ignored. Methods of `minimize` that need more than value and gradient
    are not supported.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> from sparsedp import Grid, dirichlet, inverse, laplacian, minimize
    >>> solve = inverse(-laplacian(Grid((8, 8)), dirichlet), "krylov")
    >>> loose = certified(0.1, tolerance=1e-4)
    >>> best = minimize(lambda b: anp.sum((solve(b) - 1.0) ** 2), np.zeros((8, 8)), tolerance=loose)
    >>> best.converged, loose.evaluations == best.evaluations
    (True, True)
    """
    fraction = check_number("fraction of certified", fraction, "between 0 and 1", "; write for example certified(0.1)")
    if not (is_number(tolerance) and tolerance == np.inf):  # infinity is allowed, as in minimize
        check_number("tolerance of certified", tolerance, ">= 0", "; the default is 1e-8")
    return Certified(fraction, float(tolerance))


class Certified:
    """A tolerance for one run of `minimize` that controls the solves in each evaluation. Returned by `certified`.

    Each evaluation starts from the solutions of the previous evaluation. It corrects them by solves with a loose
    tolerance until value and gradient change by less than the allowed error. The error of the last correction is about
    the tolerance of the correction times the last change. The value is also corrected by y . r, so that its error is of
    second order. This is necessary because a line search compares values that differ only a little.

    Attributes
    ----------
    evaluations, iterations, passes : int
        Numbers of evaluations, of iterations of all solves, and of runs of the loss.
    """

    def __init__(self, fraction: float, tolerance: float) -> None:
        self.fraction = fraction
        self.tolerance = tolerance
        self.share = float(np.clip(fraction, SMALLEST_SHARE, LARGEST_SHARE))
        self.evaluations = 0
        self.iterations = 0
        self.passes = 0
        self._last_value: float | None = None  # value at the last step
        self._gradient: Any = None
        self._solves: dict[SolveKey, RecordedSolve] = {}  # solves of the last evaluation

    def __call__(self, record: Any, first: Any) -> bool:
        """Return whether the run has converged."""
        self._last_value = record.value
        return record.gradient_norm <= self.tolerance * first.gradient_norm

    def inside(self, loss: Callable[[Any], Any], gradient: Any) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """Return the loss and the gradient for `minimize`, which must call them in this order at every point."""
        if gradient is not None:
            raise ValueError("certified sees the solves of the loss, not of a gradient that is given; leave it out")
        value_and_gradient = value_and_grad(loss)

        def value(x: Any) -> float:
            value, self._gradient = self._evaluate(value_and_gradient, x)
            return value

        return value, lambda x: self._gradient

    def _evaluate(self, value_and_gradient: Callable[[Any], Any], x: Any) -> tuple[float, Any]:
        """Return value and gradient, with solves corrected until both are accurate enough."""
        # The first pass reuses the solutions of the last evaluation without solves. The change from this pass to the
        # next one shows the error. If all solvers are direct, the first pass solves, and no other pass is needed.
        earlier = self._solves
        if not self._any_iterative():
            earlier = {}
        value, gradient = self._pass(value_and_gradient, x, RecordedSolves(earlier, None, self.share))
        self.evaluations += 1
        if not self._any_iterative():
            return value, gradient
        for _ in range(MOST_CORRECTIONS):
            new_value, new_gradient = self._pass(value_and_gradient, x, RecordedSolves(self._solves, share=self.share))
            is_close = self._is_close(value, gradient, new_value, new_gradient)
            value = new_value
            gradient = new_gradient
            if is_close:
                break
        return value, gradient

    def _any_iterative(self) -> bool:
        """Return whether a solve of the last pass was iterative."""
        return any(solve.iterative for solve in self._solves.values())

    def _pass(self, value_and_gradient: Callable[[Any], Any], x: Any, solves: RecordedSolves) -> tuple[float, Any]:
        """Run value and gradient once with `solves`, and keep them. The value is corrected by y . r."""
        value, gradient = solves.run(value_and_gradient, x)
        self._solves = dict(solves)
        self.passes += 1
        self.iterations += solves.iterations
        return value + solves.correction(), gradient

    def _is_close(self, value: float, gradient: Any, new_value: float, new_gradient: Any) -> bool:
        """Return whether the error of the new value and gradient is small enough.

        The error is estimated by share / (1 - share) times the change by the last correction.
        """
        remainder = self.share / (1.0 - self.share)
        if self._last_value is None:
            progress = abs(new_value)
        else:
            progress = abs(self._last_value - new_value)
        allowed = max(self.fraction * progress, ROUNDING_OF_VALUE * abs(new_value))
        if not remainder * distance(gradient, new_gradient) <= self.fraction:
            return False
        return remainder * abs(value - new_value) <= allowed

    def __str__(self) -> str:
        return (
            f"certified to {100 * self.fraction:g} % of the gradient: {self.iterations} iterations in "
            f"{self.evaluations} evaluations ({self.passes} passes)"
        )

    __repr__ = __str__
