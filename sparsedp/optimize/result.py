"""Data classes of `minimize`: evaluations of the loss, records of iterations, and the result of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.html import curves, facts

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Evaluation", "Failure", "Minimum", "NoStepFound", "Record", "RoundingReached"]

NO_RESIDUALS = "only least-squares problems have one; return the residuals and write method='levenberg_marquardt'"
SHOWN = 6  # number of first and of last iterations that are printed from a long history


class NoStepFound(Exception):
    """Internal exception: a method found no acceptable point. `minimize` catches it and reports its message."""


class RoundingReached(NoStepFound):
    """Internal exception: no lower point was found, because rounding of the loss hides the predicted decrease."""


class Evaluation(NamedTuple):
    """A point with its loss and gradient; point and gradient are flat vectors in double precision.

    If the loss raised an error or was not finite, the point is called refused: its value is infinity and its gradient
    is NaN. For least-squares problems the gradient is None if the value is not below the bound that the caller gave,
    because the gradient of a rejected point is not needed.
    """

    point: np.ndarray
    value: float
    gradient: Any
    rounding: float = 0.0  # estimated rounding error of the loss
    iteration: int = 0  # the iteration, which determines the batch of the loss

    @property
    def refused(self) -> bool:
        """Whether the loss raised an error or was not finite at this point."""
        return self.value == np.inf


class Failure(NamedTuple):
    """A trial point at which the loss raised an error or was not finite."""

    error: str  # name of the exception class
    message: str


class Record(NamedTuple):
    """The record of one iteration. Iteration 0 is the start.

    Attributes
    ----------
    iteration : int
    value : float
        The loss. It is infinite if it overflows, and 0 if it underflows.
    gradient_norm : float
        Euclidean norm of the gradient, or, with bounds, of the projected gradient: its entries are 0 where a bound
        prevents a step along the negative gradient. With constraints, the same norm of the gradient of the Lagrangian;
        with a metric M, sqrt(g.M^-1 g) of this gradient g. Infinite on overflow, 0 on underflow.
    seconds : float
        Time since the start of the run.
    evaluations : int
        Number of evaluations of the loss since the start of the run.
    failed : tuple of Failure
        The trial points of this iteration at which the loss raised an error or was not finite, as (error, message).
    solves : int
        Number of linear solves, forward and adjoint, in this thread since the start of the run.
    feasibility : float
        With constraints: the largest violation, in the units of the constraints (see `Minimum`).
    optimality : float, optional
        With constraints: the relative residual of the optimality conditions (see `Minimum`).
    """

    iteration: int
    value: float
    gradient_norm: float
    seconds: float
    evaluations: int
    failed: tuple[Failure, ...] = ()
    solves: int = 0
    feasibility: float = 0.0
    optimality: float | None = None

    def summary(self) -> str:
        """Return a short text for a progress bar."""
        words = f"loss {self.value:.6g}, gradient {self.gradient_norm:.1e}"
        if self.optimality is not None:
            words = f"loss {self.value:.6g}, feasibility {self.feasibility:.1e}, optimality {self.optimality:.1e}"
        if self.failed:
            words += f", {len(self.failed)} refused"
        return words


class Minimum(Frozen):
    """The result of `minimize`. Immutable.

    Attributes
    ----------
    x : tree
        The best point found, with the structure, shapes and dtypes of the start.
    value : float
        The loss at x.
    history : tuple of Record
        One record for the start and one for each iteration.
    method : str
    message : str
        The reason why the run stopped.
    converged : bool
        True if the tolerance was met, or if rounding prevents a further decrease of the loss.
    evaluations : int
        Number of evaluations of the loss and its gradient, including those that failed.
    resumed : str
        A sentence that says whether the run continued from the checkpoint folder; empty if there is no such folder.
    multipliers : tree
        With constraints: the Lagrange multipliers, in the structure of the argument `constraints`; None for methods
        without constraints. See the notes.
    constraint_values : tree
        The values of the constraint functions at x, in the same structure.
    feasibility : float
        The largest violation of a constraint, divided by the unit of its function; 0 for methods without constraints.
        The unit is the larger of two numbers at the start: the largest absolute value of the constraint, and the change
        of the constraint if each unknown changes by its own size. It is rounded up to a power of two.
    optimality : float
        The residual of the optimality conditions (Karush-Kuhn-Tucker), relative to the larger of the norms of the
        gradient of the loss at the start and at x; None for methods without constraints. See the notes.
    covariance : (n, n) array
        Covariance of the n unknowns of a least-squares problem, in the order of the leaves of x. With the m residuals
        r and their Jacobian J at x it is

            s^2 (J^T J)^(-1)  with  s^2 = |r|^2 / (m - n),    or  (J^T J)^(-1)  with absolute_sigma=True.

        The first form estimates the variance of the data from the residuals. The second is for residuals that were
        divided by known standard deviations; it is the posterior covariance for a flat prior. Bounds are ignored. All
        entries are infinite if the rank of J is less than n. Access raises ValueError, with the reason in its message,
        if the covariance is not available: for methods other than least squares, with batches, if J is not formed, if
        n > 4000, or if m <= n without absolute_sigma. For many unknowns, or with a prior, see `laplace`.

    Notes
    -----
    The multipliers belong to the Lagrangian L = loss + sum(multiplier * constraint). They are >= 0 for constraints that
    are <= 0, and 0 for those that are not active; for equalities they have any sign. If a limit is relaxed, from
    constraint <= 0 to constraint <= b, the smallest loss changes by -multiplier * b to first order. The multiplier of a
    NonlinearConstraint with lower and upper limits has the shape of its value: it is > 0 where the upper limit is
    active, and < 0 where the lower limit is active.

    The optimality conditions are grad L = 0, except for entries of x at a bound that the negative gradient would move
    out, and multiplier * constraint = 0 for inequalities. Their residuals are measured after each leaf of x was divided
    by its size at the start, and the loss and the constraints by their units.
    """

    x: Any
    value: float
    history: tuple[Record, ...]
    method: str
    message: str
    converged: bool
    evaluations: int
    resumed: str = ""
    multipliers: Any = None
    constraint_values: Any = None
    feasibility: float = 0.0
    optimality: float | None = None
    _covariance: Any = NO_RESIDUALS  # the array, or a sentence that says why it is not available
    attribute_suggestions = {
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
        measures = f"{'gradient':>9}"
        if self.optimality is not None:
            measures = "feasibility  optimality"
        lines = [f"{'n':>6}  {'loss':>13}  {measures}  {'seconds':>8}  evaluations  solves"]
        lines += [_history_line(record) for record in self.history]
        if len(self.history) > 2 * SHOWN + 1:
            lines[SHOWN + 1 : -SHOWN] = [f"{'...':>6}"]
        return "\n".join(filter(None, [head, *lines, self.message, self.resumed]))

    __repr__ = __str__

    def _repr_html_(self):
        """Return HTML for notebooks: a table of the results and a plot of the loss."""
        losses = [(record.iteration, record.value) for record in self.history]
        converged = "yes" if self.converged else "no"
        entries = {
            "loss": f"{self.value:.6g}",
            "converged": converged,
            "why it stopped": self.message,
            "iterations": self.history[-1].iteration,
            "evaluations": self.evaluations,
            "feasibility": None if self.optimality is None else f"{self.feasibility:.2e}",
            "optimality": None if self.optimality is None else f"{self.optimality:.2e}",
            "resumed": self.resumed or None,
            "convergence": curves({"loss": losses}, "iteration", "loss") or None,
        }
        return facts(self.method, entries)


def _history_line(record):
    """Return the line of a record in the table of a result."""
    measures = f"{record.gradient_norm:9.2e}"
    if record.optimality is not None:
        measures = f"{record.feasibility:11.2e}  {record.optimality:10.2e}"
    line = (
        f"{record.iteration:6d}  {record.value:13.6e}  {measures}  {record.seconds:8.2f}  "
        f"{record.evaluations:11d}  {record.solves:6d}"
    )
    if record.failed:
        errors = sorted({failure.error for failure in record.failed})
        line += f"  {len(record.failed)} refused: {', '.join(errors)}"
    return line
