"""What an optimization hands around and gives back: trials, the history, the best point and why it stopped."""

from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.html import curves, facts
from sparsedp._utils.reconstruction import Frozen

__all__ = ["Failure", "Minimum", "Record", "Stuck", "Trial"]

NO_RESIDUALS = "it is that of least-squares problems; give minimize the residuals and method='levenberg_marquardt'"
SHOWN = 6  # lines of the history at each end


class Stuck(Exception):
    """No admissible point was found; the message says why."""


class Trial(NamedTuple):
    """A point, the loss and the flat gradient there. A refused point has the value infinity, and the gradient NaN.

    A point that is not low enough for whoever asked may have no gradient.
    """

    vector: np.ndarray
    value: float
    slope: Any
    rounding: float = 0.0  # a smaller change of the loss is not seen
    iteration: int = 0  # whose batch the loss was given

    @property
    def refused(self):
        """Whether the loss has no value here."""
        return self.value == np.inf


class Failure(NamedTuple):
    """A trial point that the loss refused."""

    error: str
    message: str


class Record(NamedTuple):
    """One iteration; number 0 is the start.

    `gradient_norm` is that of the gradient; with bounds of the projected gradient, which is 0 in entries that bounds
    hold. It and `value` are infinite or 0 where they leave the range of floating-point numbers.
    `seconds`, `evaluations` and `solves` (forward and adjoint, of every inverse, in this thread) count from the start
    of the run; `failed` lists the trial points that the loss refused in this iteration, as (error, message).
    """

    iteration: int
    value: float
    gradient_norm: float
    seconds: float
    evaluations: int
    failed: tuple[Failure, ...] = ()
    solves: int = 0

    def summary(self):
        """A few words for a progress bar."""
        refused = f", {len(self.failed)} refused" if self.failed else ""
        return f"loss {self.value:.6g}, gradient {self.gradient_norm:.1e}{refused}"


class Minimum(Frozen):
    """The result of `minimize`. Frozen.

    Attributes
    ----------
    x : tree
        The best point seen, with the structure, shapes and dtypes of the start.
    value : float
        The loss there.
    history : tuple of Record
    method : str
    message : str
        Why it stopped.
    converged : bool
        Whether the tolerance was met, or the loss cannot fall further in floating point numbers.
    evaluations : int
        Evaluations of loss and gradient, refused ones included.
    resumed : str
        What was found in the checkpoint folder; empty without one.
    covariance : (n, n) array
        Of the n unknowns of a least-squares problem, in the order of the leaves of x. Of m residuals r with the
        Jacobian J at x it is

            s^2 (J^T J)^(-1)  with  s^2 = |r|^2 / (m - n),    or  (J^T J)^(-1)  with absolute_sigma=True.

        The first form estimates the variance of the data from the residuals; the second takes residuals that were
        divided by known standard deviations, and is the posterior covariance for a flat prior. Infinite where J has
        a rank below n; bounds are ignored. Access raises ValueError where it is not known, and says what to write:
        for other methods, with batches, where J is not formed, when n > 4000, and when m <= n without absolute_sigma.
    """

    x: Any
    value: float
    history: tuple[Record, ...]
    method: str
    message: str
    converged: bool
    evaluations: int
    resumed: str = ""
    _covariance: Any = NO_RESIDUALS  # the array, or why there is none
    meant = {
        "fun": "best.value",
        "point": "best.x",
        "nit": "best.history[-1].iteration",
        "nfev": "best.evaluations",
        "success": "best.converged",
        "status": "best.message",
    }

    @property
    def covariance(self):
        """The covariance of the unknowns."""
        if isinstance(self._covariance, str):
            raise ValueError(f"the covariance is not known: {self._covariance}")
        return self._covariance

    def __str__(self):
        last = self.history[-1]
        head = f"{self.method}: loss {self.value:.6g} after {last.iteration} iterations, {self.evaluations} evaluations"
        lines = [f"{'n':>6}  {'loss':>13}  {'gradient':>9}  {'seconds':>8}  evaluations  solves"]
        lines += map(_line, self.history)
        if len(self.history) > 2 * SHOWN + 1:
            lines[SHOWN + 1 : -SHOWN] = [f"{'...':>6}"]
        return "\n".join(filter(None, [head, *lines, self.message, self.resumed]))

    __repr__ = __str__

    def _repr_html_(self):
        """For a notebook: how it ended, and how the loss fell."""
        path = [(one.iteration, one.value) for one in self.history]
        entries = {
            "loss": f"{self.value:.6g}",
            "converged": "yes" if self.converged else "no",
            "why it stopped": self.message,
            "iterations": self.history[-1].iteration,
            "evaluations": self.evaluations,
            "resumed": self.resumed or None,
            "convergence": curves({"loss": path}, "iteration", "loss") or None,
        }
        return facts(self.method, entries)


def _line(record):
    text = f"{record.iteration:6d}  {record.value:13.6e}  {record.gradient_norm:9.2e}  {record.seconds:8.2f}"
    words = sorted({failure.error for failure in record.failed})
    refused = f"  {len(record.failed)} refused: {', '.join(words)}" if record.failed else ""
    return f"{text}  {record.evaluations:11d}  {record.solves:6d}{refused}"
