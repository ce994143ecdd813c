"""The error that solves leave in value and gradient: estimated (`certify`), or as large as allowed (`certified`).

A run of the loss records its solves, forward and adjoint. A second run starts each from its recorded solution x. With
r = b - A x its residual, A^-1 r is its error; solved to the share s, it removes all but s of that error. Data b' that
have changed a little are followed by solving for b' - A x; to follow the data and keep the error, the old residual is
subtracted first: b' - A x - r. The difference of two such runs is the error of the first, up to s.

The value inside `minimize` is corrected by the sum of y . r over all solves, with the remaining forward residual r
and the adjoint solution y, which is the derivative of the loss with respect to a residual.

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

TARGET = 0.01  # error of the gradient that the advice is about
SHARE = 0.01  # of its error that a corrected solution keeps
ROUNDING_ERROR = 1e-13  # relative errors below this are those of rounding, not of solves
LOOSEST_ADVICE = 0.1  # tolerance that is advised
COLUMNS = ("solver", "rtol", "forward", "forward residual", "adjoint", "adjoint residual", "error")
SMALLEST_SHARE = 0.05  # relative tolerance of a correction inside minimize
LARGEST_SHARE = 0.5
MOST_CORRECTIONS = 20  # of one evaluation
ROUNDING_OF_VALUE = 1e-14


def distance(one: Any, other: Any, unit: Any = None) -> float:
    """Return the Euclidean distance of two trees, relative to `unit`, by default the second tree.

    Leaves that are None count for nothing.
    """
    advice = "; give compare=function(result, exact)"
    matched = paired(one, other, "result", " of work_precision", advice, shapes=True, error=ValueError)
    gaps = [np.subtract(a, b) for a, b in zip(matched, leaves(other)) if a is not None]
    return norm(gaps) / (norm(other if unit is None else unit) or 1.0)


# ---------------------------------------------------------------- recorded solves

SolveKey = tuple[str, str, int]  # name of the solver, "forward" or "adjoint", and the number of the solve among these


class RecordedSolve(NamedTuple):
    """One solve.

    Attributes
    ----------
    x, residual : ndarray
        Flat solution and residual.
    size : float
        Norm of the right-hand side.
    rtol : float
        The tolerance it was asked for.
    iterative : bool
    """

    x: NDArray[Any]
    residual: NDArray[Any]
    size: float
    rtol: float
    iterative: bool


def _always(key: SolveKey) -> bool:
    """Correct each solve."""
    return True


class RecordedSolves(dict[SolveKey, RecordedSolve]):
    """The solves of a run by key; during the run, their observer.

    A root and its Jacobian have one name.

    Parameters
    ----------
    earlier : dict, optional
        Solves of an earlier run: each is the start of the same solve.
    correct : callable or None
        ``correct(key)``: whether the error of the solution is removed, or kept. Default: always removed.
        None: the solutions are taken as they are, without a solve, and what was not recorded is solved to `share`.
    share : float
        Relative tolerance of each correction.

    Attributes
    ----------
    iterations : int
        Of all solves of the run.
    """

    def __init__(
        self,
        earlier: dict[SolveKey, RecordedSolve] | None = None,
        correct: Callable[[SolveKey], bool] | None = _always,
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
            with recording() as calls, unwarned():  # a second run would mix its solves with the recorded ones
                return function(x)
        finally:
            thread.solve_hooks.pop()
            self.iterations = total(calls, "iterations")

    def linear(self, solver: Any, b: NDArray[Any], transposed: bool, checked: bool, start: Any) -> NDArray[Any]:
        """Return the flat solution of a linear solve. The solver calls this in place of its own `solve`."""
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

        def corrected(x: NDArray[Any], kept: Any) -> NDArray[Any]:
            return root.newton_correction(equation, x, leaves, self.share, -kept)

        key = self._next_key(root.name, "forward")
        x = self._solution(key, guess.size, partial(root.newton_solve, equation, guess, leaves), corrected)
        self[key] = RecordedSolve(x, -equation.value(x, leaves), 0.0, root.rtol, True)
        return x

    def _next_key(self, name: str, kind: str) -> SolveKey:
        """Return the key of a solve that begins."""
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
        """Return the solution of ``solve()``, or the earlier one, ``corrected(x, residual to keep)``."""
        earlier = self.earlier.get(key)
        if earlier is None or earlier.x.size != size:
            return solve()
        if self.correct is None:
            return earlier.x
        if self.correct(key):
            return corrected(earlier.x, 0.0)
        return corrected(earlier.x, earlier.residual)

    def correction(self) -> float:
        """Return the sum of y . r over the forward solves; 0 when there is one without its adjoint solve.

        They are paired by order: the last solve of the forward pass is the first one of the backward pass.
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
    """Estimate the errors of value and gradient that inexact solves leave.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``, with any number of solves: `inverse`, `elliptic_solver`, `matrix_solver`,
        `implicit`. Deterministic.
    x : array, number, or any nesting of them in tuples, lists and dicts
    target : float
        Relative error of the gradient that the advice is about, 0 < target < 1.

    Returns
    -------
    Certificate
        `.value`, `.gradient` as the loss gives them; their estimated errors `.value_error` (absolute, with a sign) and
        `.gradient_error` (relative to the norm of the gradient); `.corrected_value`, `.corrected_gradient`; `.causes`:
        relative error of the gradient from the forward and from the adjoint solves; `.solves`: one dict for each
        solver; `.advice`: one line. str() is the table.

    Raises
    ------
    ValueError
        If `target` is not between 0 and 1. All that the loss raises passes through.

    See Also
    --------
    certified, explain, check.gradient

    Notes
    -----
    Cost: one gradient, two loose correction solves (relative residual 1e-2) for each pair of solves, one more
    forward correction for the value, one more adjoint correction for the split by cause, and for the split by solve
    as many again where there are several solvers. Norm: Euclidean over all leaves. Errors of discretisation and of
    rounding are not seen; below 1e-13 the estimate is rounding. A derivative or transpose that is wrong is not seen
    either: `check.gradient` looks for those. A solve that is unrolled on the tape is exact by its own definition.

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
    # A value needs a second correction: the first one shows its error, the second one the error of the correction.
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
    """Return whether a solve is one of a solver."""
    return key[0] == name


def _row(name: str, error: float, solves: RecordedSolves) -> dict[str, Any]:
    """Return what is known about one solver, from its solves forward and adjoint."""
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
    """Return one line: what to change for the target."""
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
    wanted = min(rtol * target / error, LOOSEST_ADVICE) / 2
    if error > target:
        return f"tighten the {side} of {name} from {rtol:.0e} to {wanted:.0e} {goal}"
    if wanted > rtol:
        return f"{name} may stop at {wanted:.0e} in place of {rtol:.0e} {goal}"
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
        solver, rtol, error (its share), iterative, forward and adjoint (numbers of solves), their largest
        relative residuals.
    advice : str
    """

    _plain = ("value", "corrected_value", "value_error", "gradient_error", "causes", "solves", "advice")

    def parts(self) -> list[str | Table]:
        """Return errors of value and gradient, a row for each solver, the advice."""
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
    """Return a tolerance for `minimize` that also chooses how far solves go.

    Parameters
    ----------
    fraction : float
        Largest error of the gradient relative to itself, and of the value relative to its change
        since the last step, 0 < fraction < 1.
    tolerance : float
        As in `minimize`: converged when the norm of the gradient has fallen by this factor.

    Returns
    -------
    Certified
        For one run: ``minimize(loss, start, tolerance=dp.certified(0.1))``. Afterwards `.iterations`, `.evaluations`
        and `.passes` are the counts, str() says it all.

    Raises
    ------
    ValueError
        If `fraction` or `tolerance` is out of range, or a gradient is given to `minimize`: its solves are not seen.

    See Also
    --------
    minimize, certify

    Notes
    -----
    The tolerances of the solvers themselves are not used. Methods that need more than value and gradient are not
    supported.

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
    if not (is_number(tolerance) and tolerance == np.inf):  # as in minimize: any gradient meets an infinite one
        check_number("tolerance of certified", tolerance, ">= 0", "; the default is 1e-8")
    return Certified(fraction, float(tolerance))


class Certified:
    """A tolerance that takes part in the evaluations of `minimize`. Returned by `certified`, for one run.

    An evaluation starts from the solutions of the last one and corrects them by loose solves until value and
    gradient change by less than the allowed error. What it returns is the last corrected one: its error is about the
    share that corrections leave, times the last change. The value is corrected by y . r, which leaves an error of
    second order: a line search compares values that differ by little.

    Attributes
    ----------
    evaluations, iterations, passes : int
        Evaluations, iterations of all solves, and runs of the loss.
    """

    def __init__(self, fraction: float, tolerance: float) -> None:
        self.fraction = fraction
        self.tolerance = tolerance
        self.share = float(np.clip(fraction, SMALLEST_SHARE, LARGEST_SHARE))
        self.evaluations = 0
        self.iterations = 0
        self.passes = 0
        self._last_value: float | None = None  # of the last step
        self._gradient: Any = None
        self._solves: dict[SolveKey, RecordedSolve] = {}  # of the last evaluation

    def __call__(self, record: Any, first: Any) -> bool:
        """Return whether the run has converged."""
        self._last_value = record.value
        return record.gradient_norm <= self.tolerance * first.gradient_norm

    def inside(self, loss: Callable[[Any], Any], gradient: Any) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """Return the loss and the gradient that `minimize` is to use, in this order at every point."""
        if gradient is not None:
            raise ValueError("certified sees the solves of the loss, not of a gradient that is given; leave it out")
        value_and_gradient = value_and_grad(loss)

        def value(x: Any) -> float:
            value, self._gradient = self._evaluate(value_and_gradient, x)
            return value

        return value, lambda x: self._gradient

    def _evaluate(self, value_and_gradient: Callable[[Any], Any], x: Any) -> tuple[float, Any]:
        """Return value and gradient with corrected solves."""
        # The first pass has no correction and takes no solve: the change by the next one tells its error.
        value, gradient = self._pass(value_and_gradient, x, RecordedSolves(self._solves, None, self.share))
        self.evaluations += 1
        if not any(solve.iterative for solve in self._solves.values()):
            return value, gradient
        for _ in range(MOST_CORRECTIONS):
            new_value, new_gradient = self._pass(value_and_gradient, x, RecordedSolves(self._solves, share=self.share))
            is_close = self._is_close(value, gradient, new_value, new_gradient)
            value = new_value
            gradient = new_gradient
            if is_close:
                break
        return value, gradient

    def _pass(self, value_and_gradient: Callable[[Any], Any], x: Any, solves: RecordedSolves) -> tuple[float, Any]:
        """Run the loss once with these solves."""
        value, gradient = solves.run(value_and_gradient, x)
        self._solves = dict(solves)
        self.passes += 1
        self.iterations += solves.iterations
        return value + solves.correction(), gradient

    def _is_close(self, value: float, gradient: Any, new_value: float, new_gradient: Any) -> bool:
        """Return whether the error of the new value and gradient, share / (1 - share) times the change, is allowed."""
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
