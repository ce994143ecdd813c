"""certified: solves as loose as an optimiser's gradient allows, measured at every step.

An evaluation starts from the answers of the last one and corrects them by loose solves, forward and adjoint,
until value and gradient move by less than is asked. What it returns is the last corrected one: its error is about
the looseness times the last move. To the value y . r is added (certificate.py), which leaves an error of second
order: a line search compares values that differ by little.
"""

from sparsedp.fields import is_number
from sparsedp.report.answers import Answers, run
from sparsedp.report.certificate import distance, products_of
from sparsedp.tree import norm

__all__ = ["Certified", "certified"]

SHARES = 0.05, 0.5  # least and largest relative tolerance of a correction
MOST = 20  # corrections of one evaluation
ROUNDING = 1e-14  # of the value


def certified(fraction=0.1, tolerance=1e-8):
    """Fraction of the gradient -> tolerance for `minimise` that also chooses how far solves go.

    Parameters
    ----------
    fraction : float
        Largest error of the gradient relative to itself, and of the value relative to its change
        since the last step, 0 < fraction < 1.
    tolerance : float
        As in `minimise`: converged when the norm of the gradient has fallen by this factor.

    Returns
    -------
    Certified
        For one run: ``minimise(loss, start, tolerance=dp.certified(0.1))``. Afterwards `.saved` is the share of
        iterations saved, `.iterations`, `.full_iterations` and `.evaluations` are the counts, str() says it all.

    Raises
    ------
    ValueError
        If `fraction` or `tolerance` is out of range, or a gradient is given to `minimise`: its solves are not seen.

    Notes
    -----
    The tolerances of the solvers themselves are not used, but for one evaluation at the second point: it counts
    what an evaluation costs with them. Methods that ask for more than value and gradient are not served.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> from sparsedp import Grid, dirichlet, inverse, laplacian, minimise
    >>> solve = inverse(-laplacian(Grid((8, 8)), dirichlet), "krylov")
    >>> loose = certified(0.1, tolerance=1e-4)
    >>> best = minimise(lambda b: anp.sum((solve(b) - 1.0) ** 2), np.zeros((8, 8)), tolerance=loose)
    >>> best.converged, loose.saved > 0
    (True, True)
    """
    if not (is_number(fraction) and 0 < fraction < 1 and is_number(tolerance) and tolerance >= 0):
        raise ValueError(
            f"certified needs 0 < fraction < 1 and a tolerance >= 0, got {fraction!r} and {tolerance!r}; "
            "write for example certified(0.1)"
        )
    return Certified(float(fraction), float(tolerance))


class Certified:
    """A tolerance that takes part in the evaluations of `minimise`. Made by `certified`, for one run."""

    def __init__(self, fraction, tolerance):
        self.fraction, self.tolerance = fraction, tolerance
        self.share = min(max(fraction, SHARES[0]), SHARES[1])
        self.evaluations = self.iterations = self.passes = 0
        self.full_iterations = 0  # of one evaluation with the tolerances of the solvers
        self._answers, self._values, self._gradient = None, [], None

    def __call__(self, record, first):
        """Whether the run has converged."""
        self._values.append(record.value)
        return record.gradient_norm <= self.tolerance * first.gradient_norm

    def inside(self, loss, gradient):
        """The loss and the gradient that `minimise` is to use, in this order at every point."""
        if gradient is not None:
            raise ValueError("certified sees the solves of the loss, not of a gradient that is given; leave it out")

        def value(x):
            found, self._gradient = self._settled(loss, x)
            return found

        return value, lambda x: self._gradient

    def _settled(self, loss, x):
        if self.evaluations == 1:  # the start may be a special point: zero, without anything to solve
            start = Answers()
            run(loss, x, start)
            self.full_iterations = _iterations(start)
        # Without a correction first, which takes no solve: what the next one moves tells how far off it was.
        answers = Answers(self._answers, share=None, fresh=self.share)
        value, gradient = self._pass(loss, x, answers)
        self.evaluations += 1
        for _ in range(MOST if any(answer.iterative for answer in answers.found.values()) else 0):
            before = value, gradient
            answers = Answers(answers.found, share=self.share)
            value, gradient = self._pass(loss, x, answers)
            if self._close(*before, value, gradient):
                break
        self._answers = answers.found
        return value, gradient

    def _pass(self, loss, x, answers):
        value, gradient = run(loss, x, answers)
        self.passes += 1
        self.iterations += _iterations(answers)
        return value + sum(products_of(answers.found) or ()), gradient

    def _close(self, value, gradient, new_value, new_gradient):
        """Whether the error of the new value and gradient, share / (1 - share) times the last move, is allowed."""
        size = norm(new_gradient)
        change = abs(self._values[-1] - new_value) if self._values else abs(new_value)
        allowed = max(self.fraction * change, ROUNDING * abs(new_value))
        left = self.share / (1.0 - self.share)
        return (
            left * distance(gradient, new_gradient) <= self.fraction * size and left * abs(value - new_value) <= allowed
        )

    @property
    def saved(self):
        """Share of the iterations saved, beside the same evaluations with the tolerances of the solvers."""
        full = self.full_iterations * self.evaluations
        return 1.0 - self.iterations / full if full else 0.0

    def __str__(self):
        full = self.full_iterations * self.evaluations
        return (
            f"certified to {100 * self.fraction:g} % of the gradient: {self.iterations} iterations in "
            f"{self.evaluations} evaluations ({self.passes} passes), {full} with the tolerances of the solvers: "
            f"{100 * self.saved:.0f} % saved"
        )

    __repr__ = __str__


def _iterations(answers):
    return sum(many for (_, kind), many in answers.calls.items() if kind == "iterations")
