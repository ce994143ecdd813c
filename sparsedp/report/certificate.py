"""certify: how wrong are the value and the gradient of a loss because its solves stop early?

The loss is run once as it is. In a second run each solve, forward and adjoint, starts from its answer and is
corrected by one loose solve (answers.py). The difference of the two runs is the error, up to the looseness. The
part of the adjoint solves comes from a run that corrects only them.

The corrected value is that of the second run plus the sum of y . r over all solves, with r the forward residual
that is left and y the adjoint solution: the adjoint says what a residual does to the loss.

Source: N. A. Pierce and M. B. Giles, SIAM Review 42, 2000.
"""

from typing import Any

import numpy as np

from sparsedp.check.findings import table
from sparsedp.fields import is_number
from sparsedp.report.answers import Answers, run, seen
from sparsedp.tree import leaves, norm

__all__ = ["Certificate", "certify", "distance", "products_of"]

TARGET = 0.01  # error of the gradient that the advice is about
SHARE = 0.01  # of its error that a corrected answer keeps
CONSISTENT = 0.2  # of the terms of the sum of y . r, by which it may differ from the corrected run
ROUNDING = 1e-13  # relative; smaller errors are not those of solves
LOOSEST = 0.1


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
        `.value`, `.gradient` as the loss gives them; `.value_error`, `.gradient_error` (relative, estimated);
        `.corrected_value`, `.corrected_gradient`; `.causes`: relative error of the gradient from the forward
        and from the adjoint solves; `.solves`: one dict for each solver; `.advice`: one line. str() is the table.

    Raises
    ------
    ValueError
        If `target` is not between 0 and 1. All that the loss raises passes through.

    Notes
    -----
    Cost: one gradient, two loose correction solves (relative residual 1e-2) for each pair of solves, one more
    adjoint correction for the split by cause, and for the split by solve as many again where there are several
    solvers. Norm: Euclidean over all leaves. Errors of discretisation and of rounding are not seen; below 1e-13
    the estimate is rounding. A solve that is unrolled on the tape is exact by its own definition.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> from sparsedp import Grid, dirichlet, inverse, laplacian
    >>> solve = inverse(-laplacian(Grid((16, 16)), dirichlet), "krylov", rtol=1e-3)
    >>> b = np.ones((16, 16))
    >>> found = certify(lambda b: anp.sum(solve(b) ** 2), b)
    >>> bool(1e-6 < found.gradient_error < 1e-2), list(found.causes)
    (True, ['forward solves', 'adjoint solves'])
    """
    if not (is_number(target) and 0 < target < 1):
        raise ValueError(f"certify needs a target between 0 and 1, got {target!r}; write for example target=0.01")
    first = Answers()
    value, gradient = run(loss, x, first)
    again = Corrections(loss, x, first.found)
    *corrected, answers = again.run(lambda key: True)
    adjoint = again.run(lambda key: key[1] == "adjoint")[1]
    size = norm(gradient) or 1.0
    total = distance(corrected[1], gradient) / size
    causes = {
        "forward solves": distance(corrected[1], adjoint) / size,
        "adjoint solves": distance(adjoint, gradient) / size,
    }
    names = list(dict.fromkeys(_solver(key) for key in first.found))
    solves = [_row(name, first.found, again, gradient, size, total if len(names) == 1 else None) for name in names]
    best = _corrected_value(again, value, corrected[0], answers)
    advice = _advice(total, causes, solves, target)
    return Certificate(value, gradient, best, corrected[1], total, causes, solves, advice)


class Corrections:
    """Runs of a loss that start from known answers and correct some of them."""

    def __init__(self, loss, x, found):
        self.loss, self.x, self.found = loss, x, found

    def run(self, correct):
        """(value, gradient, answers) with the chosen answers corrected."""
        answers = Answers(self.found, correct, SHARE)
        return *run(self.loss, self.x, answers), answers.found


def distance(one, other):
    """Euclidean distance of two gradients."""
    pairs = zip(leaves(one), leaves(other), strict=True)
    return norm([np.asarray(a) - np.asarray(b) for a, b in pairs if a is not None])


def _solver(key):
    """A root and its Jacobian are one solver to the user."""
    return key[0].removesuffix(".jacobian")


def _row(name, found, again, gradient, size, error):
    """What is known about one solver; its share of the error from a run that corrects only its answers."""
    mine = {key: answer for key, answer in found.items() if _solver(key) == name}
    if error is None:
        error = distance(again.run(lambda key: _solver(key) == name)[1], gradient) / size
    row = {"solver": name, "rtol": max(a.rtol for a in mine.values()), "error": error}
    row["iterative"] = any(answer.iterative for answer in mine.values())
    for kind in ("forward", "adjoint"):
        shares = [np.linalg.norm(a.r) / a.size for key, a in mine.items() if key[1] == kind and a.size]
        row[kind] = sum(key[1] == kind for key in mine)
        row[f"{kind} residual"] = float(max(shares, default=0.0))
    return row


def _corrected_value(again, value, corrected, answers):
    """The value of the corrected run plus y . r of what is left, or, where they cannot be paired, of a third run.

    They are paired by order: the last solve forward is the first one back. Two runs tell whether that is so.
    """
    before, after = products_of(again.found), products_of(answers)
    if before is not None and after is not None:
        changed = abs(corrected - value) + sum(map(abs, before))
        if abs(value + sum(before) - corrected) <= CONSISTENT * changed + ROUNDING * abs(value):
            return corrected + sum(after)
    return seen(again.loss, again.x, Answers(answers, share=SHARE))


def products_of(found):
    """y . r for each forward solve, or None when there is one without its adjoint solve."""
    products = []
    for (name, kind, turn), answer in found.items():
        if kind != "forward":
            continue
        other = name if (name, "adjoint", 0) in found else f"{name}.jacobian"
        many = sum(key[:2] == (name, kind) for key in found)
        adjoint = found.get((other, "adjoint", many - 1 - turn))
        if adjoint is None or adjoint.x.size != answer.r.size:
            return None
        products.append(float(np.sum(adjoint.x * answer.r).real))
    return products


def _advice(total, causes, solves, target):
    """One line: what to change for the target."""
    open_to = [row for row in solves if row["iterative"]]
    if not open_to:
        return "all solves are direct: nothing to change"
    if total <= ROUNDING:
        return "solves are exact to rounding"
    worst = max(open_to, key=lambda row: row["error"])
    side = "adjoint" if causes["adjoint solves"] > causes["forward solves"] else "forward solve"
    wanted = min(worst["rtol"] * target / total, LOOSEST)
    name, now, goal = worst["solver"], worst["rtol"], f"for {100 * target:g} %"
    if total > target:
        return f"tighten the {side} of {name} from {now:.0e} to {wanted / 2:.0e} {goal}"
    if wanted > 2 * now:
        return f"{name} may stop at {wanted / 2:.0e} in place of {now:.0e} {goal}"
    return f"the tolerances are as they should be {goal}"


class Certificate:
    """The result of `certify`. Frozen.

    Attributes
    ----------
    value, corrected_value, value_error : float
        The error is estimated and has a sign: corrected value minus value.
    gradient, corrected_gradient : trees
    gradient_error : float
        Estimated, relative, Euclidean.
    causes : dict
        Relative error of the gradient from forward and from adjoint solves.
    solves : list of dict
        solver, rtol, error (its share), iterative, forward and adjoint (numbers of solves), their largest
        relative residuals.
    advice : str
    """

    value: float
    gradient: Any
    corrected_value: float
    corrected_gradient: Any
    gradient_error: float
    causes: dict
    solves: list
    advice: str

    def __init__(self, value, gradient, corrected_value, corrected_gradient, error, causes, solves, advice):
        self.__dict__.update(value=value, gradient=gradient, corrected_value=corrected_value, solves=solves)
        self.__dict__.update(corrected_gradient=corrected_gradient, gradient_error=error, causes=causes, advice=advice)

    def __setattr__(self, name, value):
        raise AttributeError(f"a certificate is frozen; {name} cannot be set")

    @property
    def value_error(self):
        """Estimated error of the value, with its sign."""
        return self.corrected_value - self.value

    def to_dict(self):
        """The certificate as plain numbers, strings and lists, without the gradients."""
        names = ("value", "corrected_value", "value_error", "gradient_error", "causes", "solves", "advice")
        return {name: getattr(self, name) for name in names}

    def __str__(self):
        lines = [
            (s["solver"], f"{s['rtol']:.0e}", s["forward"], f"{s['forward residual']:.1e}", s["adjoint"],
             f"{s['adjoint residual']:.1e}", f"{s['error']:.1e}") for s in self.solves
        ]  # fmt: skip
        head = ("solver", "rtol", "forward", "residual", "adjoint", "residual", "error of the gradient")
        causes = ", ".join(f"{error:.1e} from {name}" for name, error in self.causes.items())
        return "\n".join(
            [
                f"value {self.value:.9g}, off by about {self.value_error:.1e}; corrected {self.corrected_value:.12g}",
                f"gradient off by about {self.gradient_error:.1e} of itself: {causes}",
                table(lines, head),
                f"advice: {self.advice}",
            ]
        )

    __repr__ = __str__
