"""Evaluations of a loss, the history of a run, and its result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.html import curves, facts
from sparsedp._utils.reconstruction import Frozen

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Evaluation", "Failure", "Minimum", "NoStepFound", "Record", "RoundingReached"]

NO_RESIDUALS = "only least-squares problems have one; return the residuals and write method='levenberg_marquardt'"
SHOWN = 6  # lines of the history that are printed at each end


class NoStepFound(Exception):
    """Signals that a method found no acceptable point; the message says why. Never reaches the user."""


class RoundingReached(NoStepFound):
    """Signals that a method found no lower point because the predicted decrease is lost in the rounding of the loss."""


class Evaluation(NamedTuple):
    """A point with the loss and its gradient, as flat vectors of doubles.

    A refused point has the value infinity and a gradient of NaN. The gradient of residuals is None where the loss is
    not below the bound that the caller gave.
    """

    point: np.ndarray
    value: float
    gradient: Any
    rounding: float = 0.0  # smallest visible change of the loss
    iteration: int = 0  # selects the batch that the loss was given

    @property
    def refused(self) -> bool:
        """Whether the loss has no value here."""
        return self.value == np.inf


class Failure(NamedTuple):
    """A trial point that the loss refused."""

    error: str
    message: str


class Record(NamedTuple):
    """One iteration; number 0 is the start.

    Attributes
    ----------
    iteration : int
    value : float
        The loss; infinite or 0 where it leaves the range of floating-point numbers.
    gradient_norm : float
        Euclidean norm of the gradient; with bounds of the projected gradient, which is 0 in entries that bounds hold.
        Infinite or 0 where it leaves the range of floating-point numbers.
    seconds : float
        Since the start of the run.
    evaluations : int
        Of the loss, since the start of the run.
    failed : tuple of Failure
        The trial points that the loss refused in this iteration, as (error, message).
    solves : int
        Forward and adjoint solves of every inverse in this thread, since the start of the run.
    """

    iteration: int
    value: float
    gradient_norm: float
    seconds: float
    evaluations: int
    failed: tuple[Failure, ...] = ()
    solves: int = 0

    def summary(self) -> str:
        """Return a few words for a progress bar."""
        words = f"loss {self.value:.6g}, gradient {self.gradient_norm:.1e}"
        if self.failed:
            words += f", {len(self.failed)} refused"
        return words


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
        Why the run stopped.
    converged : bool
        Whether the tolerance was met, or the loss cannot fall further in floating-point numbers.
    evaluations : int
        Evaluations of loss and gradient, including refused ones.
    resumed : str
        Whether the run continued from the checkpoint folder; empty without one.
    covariance : (n, n) array
        Of the n unknowns of a least-squares problem, in the order of the leaves of x. With the m residuals r and
        their Jacobian J at x it is

            s^2 (J^T J)^(-1)  with  s^2 = |r|^2 / (m - n),    or  (J^T J)^(-1)  with absolute_sigma=True.

        The first form estimates the variance of the data from the residuals. The second is for residuals that were
        divided by known standard deviations; it is the posterior covariance for a flat prior. Infinite where J has
        a rank below n; bounds are ignored. Access raises ValueError with the reason where it is not known: for other
        methods, with batches, where J is not formed, when n > 4000, and when m <= n without absolute_sigma.
    """

    x: Any
    value: float
    history: tuple[Record, ...]
    method: str
    message: str
    converged: bool
    evaluations: int
    resumed: str = ""
    _covariance: Any = NO_RESIDUALS  # the array, or the reason why it is not known
    meant = {
        "fun": "best.value",
        "point": "best.x",
        "nit": "best.history[-1].iteration",
        "nfev": "best.evaluations",
        "success": "best.converged",
        "status": "best.message",
    }

    @property
    def covariance(self) -> NDArray[np.float64]:
        """The covariance of the unknowns."""
        if isinstance(self._covariance, str):
            raise ValueError(f"the covariance is not known: {self._covariance}")
        return self._covariance

    def __str__(self):
        last = self.history[-1]
        head = f"{self.method}: loss {self.value:.6g} after {last.iteration} iterations, {self.evaluations} evaluations"
        lines = [f"{'n':>6}  {'loss':>13}  {'gradient':>9}  {'seconds':>8}  evaluations  solves"]
        lines += [_history_line(record) for record in self.history]
        if len(self.history) > 2 * SHOWN + 1:
            lines[SHOWN + 1 : -SHOWN] = [f"{'...':>6}"]
        return "\n".join(filter(None, [head, *lines, self.message, self.resumed]))

    __repr__ = __str__

    def _repr_html_(self):
        """Return a table of how the run ended and a curve of the loss, for notebooks."""
        losses = [(record.iteration, record.value) for record in self.history]
        converged = "yes" if self.converged else "no"
        entries = {
            "loss": f"{self.value:.6g}",
            "converged": converged,
            "why it stopped": self.message,
            "iterations": self.history[-1].iteration,
            "evaluations": self.evaluations,
            "resumed": self.resumed or None,
            "convergence": curves({"loss": losses}, "iteration", "loss") or None,
        }
        return facts(self.method, entries)


def _history_line(record):
    """Return the line of a record in the table of a result."""
    line = (
        f"{record.iteration:6d}  {record.value:13.6e}  {record.gradient_norm:9.2e}  {record.seconds:8.2f}  "
        f"{record.evaluations:11d}  {record.solves:6d}"
    )
    if record.failed:
        errors = sorted({failure.error for failure in record.failed})
        line += f"  {len(record.failed)} refused: {', '.join(errors)}"
    return line
