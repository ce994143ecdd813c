"""The error that solves leave in value and gradient: estimated (`certify`), or as large as allowed (`certified`).

A run of the loss records its solves, forward and adjoint. A second run starts each from its recorded solution x. With
r = b - A x its residual, A^-1 r is its error; solved to the share s, it takes all but s of that error away. Data b'
that have changed a little are followed by solving for b' - A x; to follow the data and keep the error, the old
residual is taken off first: b' - A x - r. The difference of two such runs is the error of the first, up to s.

The value inside `minimize` is corrected by the sum of y . r over all solves, with r the forward residual that is left
and y the adjoint solution: the adjoint says what a residual does to the loss.

Source: N. A. Pierce and M. B. Giles, SIAM Review 42, 2000.
"""

from collections import Counter
from functools import partial
from math import inf
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.counters import recording, thread
from sparsedp._utils.pytree import leaves, norm, paired
from sparsedp._utils.validation import check_number, is_number
from sparsedp.autodiff.derivative import unwarned, value_and_grad
from sparsedp.check.summary import Result
from sparsedp.check.table import table_of
from sparsedp.report.explain import total
from sparsedp.solvers.scaling import length

__all__ = ["Certificate", "Certified", "certified", "certify", "distance"]

TARGET = 0.01  # error of the gradient that the advice is about
SHARE = 0.01  # of its error that a corrected solution keeps
EXACT = 1e-13  # relative errors below this are those of rounding, not of solves
LOOSEST = 0.1  # tolerance that is advised
SHOWN = ("solver", "rtol", "forward", "forward residual", "adjoint", "adjoint residual", "error")
SHARES = 0.05, 0.5  # least and largest relative tolerance of a correction inside minimize
CORRECTIONS = 20  # of one evaluation, at most
ROUNDING = 1e-14  # of the value


def distance(one, other, unit=None):
    """Euclidean distance of two trees, relative to a third: by default the second; None counts for nothing."""
    advice = "; give compare=function(result, exact)"
    pairs = zip(
        paired(one, other, "result", " of work_precision", advice, shapes=True, error=ValueError), leaves(other)
    )
    gaps = [np.subtract(a, b) for a, b in pairs if a is not None]
    return norm(gaps) / (norm(other if unit is None else unit) or 1.0)


# ---------------------------------------------------------------- recorded solves


class RecordedSolve(NamedTuple):
    """One solve: its solution, residual and right-hand side (flat), and the tolerance it was asked for."""

    x: np.ndarray
    r: np.ndarray
    size: float  # of the right-hand side
    rtol: float
    iterative: bool


class RecordedSolves(dict):
    """The solves of a run, by (name, "forward" or "adjoint", turn); while it runs, their observer.

    A root and its Jacobian have one name.

    Parameters
    ----------
    before : RecordedSolves, optional
        Of an earlier run: each is the start of the same solve.
    correct : callable or None
        ``correct(key)``: whether the error of the solution is taken away, or kept. Default: always taken away.
        None: the solutions are taken as they are, without a solve, and what was not recorded is solved to `share`.
    share : float
        Relative tolerance of each correction.
    """

    def __init__(self, before=None, correct: Any = lambda key: True, share=SHARE):
        super().__init__()
        self.before, self.correct, self.share = before or {}, correct, share
        self.iterations = 0
        self._turns: Counter = Counter()

    def run(self, function, x):
        """function(x), with its solves recorded."""
        thread.solve_hooks.append(self)
        try:
            with recording() as calls, unwarned():  # a second run would mix its solves with the recorded ones
                return function(x)
        finally:
            thread.solve_hooks.pop()
            self.iterations = total(calls, "iterations")

    def linear(self, solver, b, transposed, checked, start):
        """The solution of one linear solve, flat. The solver calls this in place of its own `solved`."""
        product = (solver.system.unscaled.T if transposed else solver.system.unscaled)._flat.apply
        first = partial(solver.solve, b, transposed, checked, start, observed=False)
        if self.correct is None:
            first = partial(solver.approximate, b, self.share, transposed)

        def residual(x):
            return b - product(x)

        def corrected(x, left):
            return x + solver.approximate(residual(x) - left, self.share, transposed)

        name = solver.name.removesuffix(".jacobian"), "adjoint" if transposed else "forward"
        facts = length(b), solver.system.rtol, solver.engine.iterative
        return self._solved(name, b.size, first, corrected, residual, facts)

    def root(self, root, equation, guess, leaves):
        """The solution of one nonlinear solve, flat."""
        first = partial(root.solved, equation, guess, leaves)

        def corrected(x, left):
            return root.corrected(equation, x, leaves, self.share, -left)

        facts, residual = (0.0, root.rtol, True), lambda x: -equation.value(x, leaves)
        return self._solved((root.name, "forward"), guess.size, first, corrected, residual, facts)

    def _solved(self, name, size, first, corrected, residual, facts):
        """A solution: of the first solve, or that of the earlier run, ``corrected(x, residual that stays)``."""
        key = *name, self._turns[name]
        self._turns[name] += 1
        solve = self.before.get(key)
        if solve is None or solve.x.size != size:
            x = first()
        else:
            x = solve.x if self.correct is None else corrected(solve.x, 0.0 if self.correct(key) else solve.r)
        self[key] = RecordedSolve(x, residual(x), *facts)
        return x

    def correction(self):
        """The sum of y . r over the forward solves; 0 when there is one without its adjoint solve.

        They are paired by order: the last solve forward is the first one back.
        """
        products = [0.0]
        for (name, kind, turn), solve in self.items():
            if kind == "forward":
                adjoint = self.get((name, "adjoint", self._turns[name, kind] - 1 - turn))
                if adjoint is None or adjoint.x.size != solve.r.size:
                    return 0.0
                products.append(float(np.sum(adjoint.x * solve.r).real))
        return sum(products)


# ---------------------------------------------------------------- certify


def certify(loss, x, target=TARGET):
    """Loss and point -> certificate: the errors of value and gradient that inexact solves leave.

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
    gradient_of, solves = value_and_grad(loss), RecordedSolves()
    value, gradient = solves.run(gradient_of, x)

    def corrected(correct):
        return RecordedSolves(solves, correct).run(gradient_of, x)[1]

    left = RecordedSolves(solves)
    slope, half = left.run(gradient_of, x)[1], corrected(lambda key: key[1] == "adjoint")
    causes = {"forward solves": distance(slope, half, gradient), "adjoint solves": distance(half, gradient)}
    error, names = distance(slope, gradient), dict.fromkeys(name for name, *_ in solves)
    rows = []
    for name in names:
        alone = slope if len(names) == 1 else corrected(lambda key, name=name: key[0] == name)
        sides = {way: [solves[key] for key in solves if key[:2] == (name, way)] for way in ("forward", "adjoint")}
        rows.append(_row(name, distance(alone, gradient), sides))
    best = RecordedSolves(left).run(loss, x)  # once more: a value tells its own error, and that of the correction
    return Certificate(
        value=value, gradient=gradient, corrected_value=best, corrected_gradient=slope, gradient_error=error,
        value_error=best - value, causes=causes, solves=rows, rows=rows, advice=_advice(error, causes, rows, target),
    )  # fmt: skip


def _row(name, error, sides):
    """What is known about one solver, from its solves forward and adjoint."""
    solves = [*sides["forward"], *sides["adjoint"]]
    row = {"solver": name, "rtol": max(solve.rtol for solve in solves), "error": error}
    row["iterative"] = any(solve.iterative for solve in solves)
    for kind, some in sides.items():
        largest = max((length(solve.r) / (solve.size or inf) for solve in some), default=0.0)
        row |= {kind: len(some), f"{kind} residual": float(largest)}
    return row


def _advice(total, causes, solves, target):
    """One line: what to change for the target."""
    open_to = [row for row in solves if row["iterative"]]
    if not open_to:
        return "all solves are direct: nothing to change"
    if total <= EXACT:
        return "solves are exact to rounding"
    worst = max(open_to, key=lambda row: row["error"])
    side = "adjoint" if causes["adjoint solves"] > causes["forward solves"] else "forward solve"
    name, now, goal = worst["solver"], worst["rtol"], f"for {100 * target:g} %"
    wanted = min(now * target / total, LOOSEST) / 2
    if total > target:
        return f"tighten the {side} of {name} from {now:.0e} to {wanted:.0e} {goal}"
    if wanted > now:
        return f"{name} may stop at {wanted:.0e} in place of {now:.0e} {goal}"
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

    def parts(self):
        """Errors of value and gradient, a row for each solver, the advice."""
        causes = ", ".join(f"{error:.1e} from {name}" for name, error in self.causes.items())
        return [
            f"value {self.value:.9g}, off by about {self.value_error:.1e} (absolute); "
            f"corrected {self.corrected_value:.12g}",
            f"gradient off by about {self.gradient_error:.1e} of itself: {causes}",
            table_of(self.solves, SHOWN),
            f"advice: {self.advice}",
        ]


# ---------------------------------------------------------------- adaptive tolerances for minimize


def certified(fraction=0.1, tolerance=1e-8):
    """Fraction of the gradient -> tolerance for `minimize` that also chooses how far solves go.

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

    Notes
    -----
    The tolerances of the solvers themselves are not used. Methods that ask for more than value and gradient are not
    served.

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
    if not (is_number(tolerance) and tolerance == np.inf):  # as minimize: any gradient will do
        check_number("tolerance of certified", tolerance, ">= 0", "; the default is 1e-8")
    return Certified(fraction, float(tolerance))


class Certified:
    """A tolerance that takes part in the evaluations of `minimize`. Made by `certified`, for one run.

    An evaluation starts from the solutions of the last one and corrects them by loose solves until value and
    gradient move by less than is asked. What it returns is the last corrected one: its error is about the share that
    corrections leave, times the last move. The value is corrected by y . r, which leaves an error of second order: a
    line search compares values that differ by little.
    """

    def __init__(self, fraction, tolerance):
        self.fraction, self.tolerance = fraction, tolerance
        self.share = float(np.clip(fraction, *SHARES))
        self.evaluations = self.iterations = self.passes = 0
        self._value: Any = None  # of the last step
        self._gradient: Any = None
        self._solves: dict = {}  # of the last evaluation

    def __call__(self, record, first):
        """Whether the run has converged."""
        self._value = record.value
        return record.gradient_norm <= self.tolerance * first.gradient_norm

    def inside(self, loss, gradient):
        """The loss and the gradient that `minimize` is to use, in this order at every point."""
        if gradient is not None:
            raise ValueError("certified sees the solves of the loss, not of a gradient that is given; leave it out")

        def value(x):
            value, self._gradient = self._settled(value_and_grad(loss), x)
            return value

        return value, lambda x: self._gradient

    def _settled(self, gradient_of, x):
        # Without a correction first, which takes no solve: what the next one moves tells how far off it was.
        value, gradient = self._pass(gradient_of, x, RecordedSolves(self._solves, None, self.share))
        self.evaluations += 1
        for _ in range(CORRECTIONS if any(solve.iterative for solve in self._solves.values()) else 0):
            before = value, gradient
            value, gradient = self._pass(gradient_of, x, RecordedSolves(self._solves, share=self.share))
            if self._close(*before, value, gradient):
                break
        return value, gradient

    def _pass(self, gradient_of, x, solves):
        value, gradient = solves.run(gradient_of, x)
        self._solves = dict(solves)
        self.passes += 1
        self.iterations += solves.iterations
        return value + solves.correction(), gradient

    def _close(self, value, gradient, new_value, new_gradient):
        """Whether the error of the new value and gradient, share / (1 - share) times the last move, is allowed."""
        left = self.share / (1.0 - self.share)
        change = abs(new_value if self._value is None else self._value - new_value)
        allowed = max(self.fraction * change, ROUNDING * abs(new_value))
        exact = left * distance(gradient, new_gradient) <= self.fraction
        return exact and left * abs(value - new_value) <= allowed

    def __str__(self):
        return (
            f"certified to {100 * self.fraction:g} % of the gradient: {self.iterations} iterations in "
            f"{self.evaluations} evaluations ({self.passes} passes)"
        )

    __repr__ = __str__
