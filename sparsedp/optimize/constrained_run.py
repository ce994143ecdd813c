"""A run of `minimize` with constraints: the history, the best point, the convergence test and the checkpoints."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.progress import shown_steps
from sparsedp._utils.pytree import norm
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.checkpoint import Checkpoint
from sparsedp.optimize.constrained_problem import ConstrainedProblem, Point, Violation
from sparsedp.optimize.constraints import Constraints
from sparsedp.optimize.lbfgs import LBFGS
from sparsedp.optimize.objective import Objective
from sparsedp.optimize.result import Evaluation, Minimum, NoStepFound, Record

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["ConstrainedMethod", "ConstrainedRun", "RunEnded", "minimize_constrained"]

NEARLY_CONVERGED = 1e-6  # feasibility and optimality that count as converged if the method finds no better point
ROUNDINGS = 30  # the same for the feasibility in single precision, in multiples of its machine epsilon
MOST_RESTORATION_STEPS = 100  # largest number of steps that reduce the violation after a run without a feasible point


class RunEnded(Exception):
    """Internal exception: the run has stopped; its message says why. `minimize` catches it."""


class Best(NamedTuple):
    """The best point of a run so far, with its multipliers, feasibility and optimality."""

    point: Point
    multipliers: np.ndarray
    optimality: float

    @property
    def residual(self) -> float:
        """The larger of the feasibility and the optimality."""
        return max(self.point.violation, self.optimality)


class ConstrainedRun:
    """The history, the best point and the convergence test of a run.

    Parameters
    ----------
    problem : ConstrainedProblem
    method : str
    maxiter : int
    tolerance : float or callable
    callback : callable or None
    progress : progress bar or range
        An iterable with one entry for each iteration; a progress bar is advanced.

    Attributes
    ----------
    history : list of Record
    message : str
    converged : bool
    stopped_by_user : bool
        Whether the callback or Ctrl-C has ended the run.
    best : Best
    closest : Best
        The point with the smallest residual so far.
    last : Point
        The point of the last record.
    """

    best: Best
    closest: Best
    last: Point

    def __init__(
        self,
        problem: ConstrainedProblem,
        method: str,
        maxiter: int,
        tolerance: Any,
        callback: Callable[[Record, Any], Any] | None,
        steps: Any,
    ):
        self.problem = problem
        self.method = method
        self.maxiter = maxiter
        self._tolerance = tolerance
        self._callback = callback
        self._steps = None if isinstance(steps, range) else steps
        self._first_second = time.perf_counter()
        self._first_solve = thread.solves
        self.history: list[Record] = []
        self.message = ""
        self.converged = False
        self.stopped_by_user = False
        self._nearly = max(NEARLY_CONVERGED, ROUNDINGS * problem.packing.eps)

    @property
    def feasible(self) -> float:
        """The largest violation that counts as feasible."""
        if callable(self._tolerance):
            return self._nearly
        return max(self._tolerance, self._nearly)

    def record(self, point: Point, multipliers: NDArray[np.float64] | None = None) -> None:
        """Record a point as one iteration. The default of `multipliers` is a least-squares estimate.

        Raises
        ------
        RunEnded
            If the run has converged, or is ended by the callback or by maxiter.
        """
        problem = self.problem
        if multipliers is None:
            multipliers = problem.estimated_multipliers(point)
        optimality = problem.optimality(point, multipliers)
        record = Record(
            len(self.history),
            point.evaluation.value,
            norm(problem.gradient_in_x(point, multipliers)),
            time.perf_counter() - self._first_second,
            problem.objective.count,
            problem.objective.pop_failures(),
            thread.solves - self._first_solve,
            point.violation,
            optimality,
        )
        self.history.append(record)
        self.last = point
        candidate = Best(point, multipliers, optimality)
        if record.iteration == 0 or self._is_better(point, self.best.point):
            self.best = candidate
        if record.iteration == 0 or candidate.residual < self.closest.residual:
            self.closest = candidate
        if self._steps is not None and record.iteration:
            self._steps.update()
            self._steps.set_postfix_str(record.summary())
        self._test_end(candidate)
        if not self.converged and self._callback is not None and record.iteration > 0:
            if self._callback(record, problem.packing.unpack(point.evaluation.point)):
                self.message = "stopped by the callback"
                self.stopped_by_user = True
        if self.message:
            raise RunEnded(self.message)

    def _test_end(self, candidate):
        """Set the message if the point of the last record meets the tolerance, or if maxiter is reached."""
        if self._meets_tolerance(self.history[-1]):
            self.best = candidate
            self.converged = True
            self.message = (
                f"converged: feasibility {candidate.point.violation:.1e}, optimality {candidate.optimality:.1e}"
            )
        elif self.iteration >= self.maxiter:
            self.message = f"stopped after {self.iteration} iterations, the limit maxiter"

    def _meets_tolerance(self, record):
        """Return whether a record is feasible and optimal."""
        if callable(self._tolerance):
            return record.feasibility <= self._nearly and bool(self._tolerance(record, self.history[0]))
        return max(record.feasibility, record.optimality) <= self._tolerance

    def _is_better(self, point, other):
        """Return whether a point is better: feasible first, then the lower loss, or else the smaller violation."""
        if max(point.violation, other.violation) <= self.feasible:
            return point.value < other.value
        return point.violation < other.violation

    @property
    def iteration(self) -> int:
        """Number of the last recorded iteration."""
        return len(self.history) - 1

    def resume(self, history: list[Record], first: Evaluation, last: Evaluation) -> None:
        """Continue from the history of a checkpoint; see `Monitor.resume`."""
        self.history = history
        self._first_second -= history[-1].seconds
        self._first_solve -= history[-1].solves
        if self._steps is not None:
            self._steps.update(self.iteration)

    def resume_from(self, last: Best, best: Best, closest: Best) -> None:
        """Continue from the points of a checkpoint.

        Raises
        ------
        RunEnded
            If the last point meets the tolerance, or if maxiter is reached.
        """
        self.last = last.point
        self.best = best
        self.closest = closest
        self._test_end(last)
        if self.message:
            raise RunEnded(self.message)

    def close(self) -> None:
        """Close the progress bar."""
        if self._steps is not None:
            self._steps.close()

    def library_ended(self, reason: str) -> None:
        """Set the message after a method has ended by itself, without meeting the tolerance."""
        best = self.closest
        failures = self.problem.objective.pop_failures()
        if failures:
            last = failures[-1]
            reason = f"{reason}, {len(failures)} points refused ({last.error}: {last.message})"
        self.message = f"stopped: {reason}; dp.check.gradient(loss, x) tells whether the gradient is right"
        # Rounding errors of the loss hide smaller gradients.
        stationary = max(NEARLY_CONVERGED, np.sqrt(self.problem.packing.eps))
        if best.point.violation <= self._nearly and best.optimality <= stationary:
            self.best = best
            self.converged = True
            self.message = (
                f"converged to rounding: feasibility {best.point.violation:.1e}, optimality {best.optimality:.1e} "
                f"({reason})"
            )

    def _least_violation(self, best):
        """Return the result of a run without a feasible point, and its message.

        Unless the user has stopped the run, the sum of the squares of the violations is minimized from the best point.
        """
        problem = self.problem
        message = f"{self.message}; the constraints are violated by up to {best.point.violation:.1e} of their units"
        if self.stopped_by_user:
            return best, message
        violation: Any = Violation(problem)
        lbfgs = LBFGS()
        state = lbfgs.begin(violation.of_point(best.point))
        point = best.point
        for _ in range(min(self.maxiter, MOST_RESTORATION_STEPS)):
            try:
                state = lbfgs.advance(state, violation)
            except NoStepFound:
                break
            point = problem.at(state.current.point)
            if point.violation <= self.feasible:
                return best, f"{message}; there are feasible points: try another start, method or maxiter"
        if not problem.derive(point, lambda: problem.violation_is_stationary(point)):
            return best, message
        message = (
            "infeasible: near x no step reduces the violation of the constraints, which is "
            f"{point.violation:.1e} of their units; {self.message}"
        )
        return Best(point, best.multipliers, problem.optimality(point, best.multipliers)), message

    def explain_violation(self) -> None:
        """Complete the message of a run that has ended without a feasible point."""
        if not self.converged and self.best.point.violation > self.feasible:
            self.best, self.message = self._least_violation(self.best)

    def minimum(self, resumed: str) -> Minimum:
        """Return the result of the run; `resumed` says whether it continued from a checkpoint."""
        problem = self.problem
        best = self.best
        constraints = problem.constraints
        return Minimum(
            x=problem.packing.unpack(best.point.evaluation.point),
            value=best.point.evaluation.value,
            history=tuple(self.history),
            method=self.method,
            message=self.message,
            converged=self.converged,
            evaluations=problem.objective.count,
            multipliers=constraints.multipliers(best.multipliers * problem.loss_unit),
            constraint_values=best.point.constraint_values(constraints),
            feasibility=best.point.violation,
            optimality=best.optimality,
            resumed=resumed,
        )


class _Stored(NamedTuple):
    """The state of a run in a checkpoint, in addition to its history and its best point.

    Attributes
    ----------
    current : Evaluation
        The last point; see `CheckpointFunctions.of_point`.
    state : state
        The state of the method at this point.
    best_multipliers : (m,) array
        The multipliers of the best point.
    closest : (n,) array
        The point of the smallest residual.
    closest_multipliers : (m,) array
    """

    current: Evaluation
    state: Any
    best_multipliers: np.ndarray
    closest: np.ndarray
    closest_multipliers: np.ndarray


class CheckpointFunctions:
    """The problem as the objective that `Checkpoint` compares with the stored run.

    The gradients of its evaluations contain the constraints too: a run with other constraints is refused.

    Attributes
    ----------
    batches : Batches
    iteration : int
    count : int
        Number of evaluations.
    best : Evaluation
        The best point.
    """

    best: Evaluation

    def __init__(self, problem: ConstrainedProblem, first_multipliers: NDArray[np.float64]):
        self._problem = problem
        self._first_multipliers = first_multipliers
        self.batches = Batches(None)
        self.iteration = 0
        self.count = 0
        self.residual_scale = None

    def of_point(self, point: Point) -> Evaluation:
        """Return the loss, and its gradient joined with the constraints."""
        evaluation = point.evaluation
        return evaluation._replace(gradient=np.concatenate([evaluation.gradient, point.rows]))

    def __call__(self, vector: NDArray[np.float64]) -> Evaluation:
        """Return the evaluation at x."""
        return self.of_point(self._problem.at(vector / self._problem.x_unit))

    def in_units_of_loss(self, number: float) -> float:
        """Return the number; see `Objective.in_units_of_loss`."""
        return number

    def projected_gradient(self, evaluation: Evaluation) -> NDArray[np.float64]:
        """Return the projected gradient of the Lagrangian at the start."""
        return self._problem.gradient_in_x(self._problem.start, self._first_multipliers)

    def gradient_norm(self, evaluation: Evaluation) -> float:
        """Return the norm of this gradient."""
        return norm(self.projected_gradient(evaluation))


class ConstrainedMethod(ABC):
    """Base class of the methods of `minimize` that take constraints. A method is a dataclass of its options.

    Attributes
    ----------
    name : str
        The value of the argument `method` of `minimize`.
    takes_equalities : bool
    """

    name: ClassVar[str]
    takes_equalities: ClassVar[bool] = True

    @property
    def resumable(self) -> bool:
        """Whether `begin` returns a state that checkpoints can store."""
        return False

    def begin(self, problem: ConstrainedProblem) -> Any:
        """Return the state at the start; None if it is inside of a library."""
        return None

    def check_available(self) -> None:  # noqa: B027 most methods need no library
        """Raise ImportError if the library of the method is not installed."""

    def multipliers_of(self, state: Any, problem: ConstrainedProblem) -> NDArray[np.float64]:
        """Return the multipliers that belong to a state; default: a least-squares estimate at the start."""
        return problem.estimated_multipliers(problem.start)

    @abstractmethod
    def run(self, problem: ConstrainedProblem, run: ConstrainedRun, state: Any, save: Callable[[Any], None]) -> str:
        """Iterate and call ``run.record`` with the point of each iteration.

        Parameters
        ----------
        problem : ConstrainedProblem
        run : ConstrainedRun
        state : state or None
            The state at the start, or the last state of a checkpoint.
        save : callable
            ``save(state)`` stores the state of the last record in the checkpoint.

        Returns
        -------
        str
            Why the method has ended by itself.
        """


def minimize_constrained(
    loss: Callable[[Any], Any],
    start: Any,
    method: Any,
    maxiter: int,
    tolerance: Any,
    callback: Callable[[Record, Any], Any] | None,
    bounds: Any,
    other_arguments: dict[str, Any],
) -> Minimum:
    """Minimize a loss under constraints.

    Parameters
    ----------
    loss, start, maxiter, tolerance, callback, bounds
        As for `minimize`.
    method : ConstrainedMethod
    other_arguments : dict
        The arguments constraints, gradient, progress, project, batches and checkpoint of `minimize`.

    Returns
    -------
    Minimum
    """
    _check_arguments(method, tolerance, other_arguments)
    method.check_available()
    packing = Packing(start, "start")
    box = Box(bounds, packing)
    constraints = Constraints(other_arguments["constraints"], packing)
    objective = Objective(loss, other_arguments["gradient"], packing, box, Batches(None))
    problem = ConstrainedProblem(objective, constraints, packing)
    settings = {
        "method": method.name,
        "set of options": [(field.name, getattr(method, field.name)) for field in fields(method)],
        "pair of bounds": (box.lower, box.upper),
        "set of constraints": other_arguments["constraints"],
        "start": start,
    }
    checkpoints = Checkpoint(other_arguments["checkpoint"], settings)
    steps = shown_steps(other_arguments["progress"], range(maxiter), "minimize")
    run = ConstrainedRun(problem, method.name, maxiter, tolerance, callback, steps)
    try:
        problem.begin(box.nearest(packing.pack(start)))
        if problem.equality.any() and not method.takes_equalities:
            raise ValueError(
                f"{method.name} takes inequalities only, and there are equalities; write method='augmented_lagrangian'"
            )
        _run(problem, method, run, checkpoints)
    except KeyboardInterrupt:
        if not run.history:
            raise
        run.message = "interrupted"
        run.converged = False
    finally:
        run.close()
        checkpoints.write(run.history)
    return run.minimum(checkpoints.resumed)


def _check_arguments(method, tolerance, other_arguments):
    """Raise TypeError for arguments that methods with constraints do not use."""
    for name in ("project", "batches"):
        if other_arguments[name] is not None:
            raise TypeError(f"{method.name} does not use {name}; leave it out")
    if other_arguments["checkpoint"] is not None and not method.resumable:
        raise TypeError(
            f"{method.name} cannot store its state, which is inside of a library; leave checkpoint out, or write "
            "method='augmented_lagrangian'"
        )
    if hasattr(tolerance, "inside"):
        raise TypeError(f"{method.name} does not use the tolerance dp.certified; write a number")


def _run(problem, method, run, checkpoints):
    """Start or resume a run, and iterate until it has ended."""
    state = method.begin(problem)
    multipliers = method.multipliers_of(state, problem)
    functions = CheckpointFunctions(problem, multipliers)
    template = None
    if state is not None:
        start = functions.of_point(problem.start)
        template = _Stored(start, state, multipliers, problem.start.evaluation.point, multipliers)
    resumed = checkpoints.resume(template, functions, run)

    def save(state):
        functions.count = problem.objective.count
        functions.best = run.best.point.evaluation
        stored = _Stored(
            current=functions.of_point(run.last),
            state=state,
            best_multipliers=run.best.multipliers,
            closest=run.closest.point.evaluation.point,
            closest_multipliers=run.closest.multipliers,
        )
        checkpoints.save(stored, functions, run)

    try:
        if resumed is None:
            run.record(problem.start, multipliers)
        else:
            state = resumed.state
            best = _best(problem, functions.best.point, resumed.best_multipliers)
            closest = _best(problem, resumed.closest, resumed.closest_multipliers)
            last = _best(problem, resumed.current.point, method.multipliers_of(state, problem))
            problem.objective.count = functions.count
            run.resume_from(last, best, closest)
        run.library_ended(method.run(problem, run, state, save))
    except RunEnded:
        pass
    run.explain_violation()


def _best(problem, vector, multipliers):
    """Return the point at x with its multipliers and optimality."""
    point = problem.at(vector / problem.x_unit)
    return Best(point, multipliers, problem.optimality(point, multipliers))
