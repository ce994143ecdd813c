"""Methods with an embedded error formula, for states that are flat arrays inside an interval.

An interval with all its steps is one rule on the tape, so that the tape holds states and no matrices. A method gives
the trial of a step with its error, the derivatives of accepted steps, and a record of a step for derivatives of higher
order. The derivative of the step lengths and the two perturbed solutions are those of adaptive.py. There are two
differences. The first perturbed solution has the derivative of the new state + EPSILON e with the error e of the
embedded formula. The sum of all d is subtracted in the last step only, by means of the derivative of this step; the
rate at its end is not used, as it contains large errors of stiff components.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from functools import partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import flatten, leaves
from sparsedp.autodiff.backend import require_arrays
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.integrators.adaptive import (
    WEIGHT_REDUCTIONS,
    WINDOW,
    AcceptedStep,
    Adaptive,
    FlatDeviation,
    length_shift,
    relative_sizes,
    with_values,
)
from sparsedp.integrators.discontinuities import RateInspector
from sparsedp.integrators.jacobians import jacobians_of
from sparsedp.integrators.problem import combine, like, untraced
from sparsedp.integrators.runge_kutta import Scheme
from sparsedp.solvers.newton import Unknowns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sparsedp.integrators.events import Event
    from sparsedp.integrators.problem import Problem

__all__ = ["EVALUATION_ERRORS", "Embedded", "FlatProblem", "RecordedStep", "norm"]

EVALUATION_ERRORS = UnstableStepError, NonFiniteError, ConvergenceError  # exceptions of a rate outside its domain


class FlatProblem:
    """A problem whose state is one flat array, and its derivatives.

    Parameters
    ----------
    problem : Problem
    u : tree
        A state; only the shapes and dtypes of its leaves are used.
    name : str
        Name in error messages.
    """

    def __init__(self, problem: Problem, u: Any, name: str) -> None:
        require_arrays(name, map(plain, leaves(u)))
        self.problem = problem
        self.timed = problem.timed
        self.unknowns = Unknowns(u, name)
        self.size = self.unknowns.size
        self.is_vector = self.unknowns.shapes == [(self.size,)]

    def state(self, v: Any) -> Any:
        """Convert a flat array to the tree of the user's state."""
        if self.is_vector:
            return v
        return self.unknowns.split(v)

    def flat(self, tree: Any) -> Any:
        """Convert a tree like the state, traced or not, to a flat array of floats."""
        return self.unknowns.space.join(*(cast(leaf, float) for leaf in leaves(tree)))

    def __call__(self, v: Any, params: Any, t: Any) -> Any:
        """Return the rate as a flat array."""
        rate = self.problem(self.state(v), params, t)
        if self.is_vector:
            return rate
        if any(map(isbox, leaves(rate))):
            return self.flat(rate)
        return self.unknowns.flat(rate)

    def rows(self, points: Iterable[tuple], params: Any, moving: Sequence[bool]) -> tuple[np.ndarray, np.ndarray]:
        """Return the rates at points (v, t), and their derivatives with respect to state, moving params and time."""
        trees = [(self.state(v), params, t) for v, t in points]
        is_differentiated = [*[True] * len(self.unknowns.shapes), *moving, True]
        return jacobians_of(lambda tree: self.problem(*tree), trees, is_differentiated)


class Embedded(Adaptive):
    """Steps with an embedded error formula, for states that are trees of real arrays, and their derivatives.

    Parameters
    ----------
    problem : Problem
    name : str
    order, embedded_order : int
        Orders of the steps, and of the formula that estimates their error.
    tolerance : float or None
        See `Adaptive`; None: one step without error control.
    floor : None, number, or tree like the state
    max_step : float, optional

    Attributes
    ----------
    params, moving : tree, list of bool
        Plain params of an interval, and for each leaf whether it is traced. Each interval uses a copy of this object.
    record : callable
        ``record(step, t, h)`` returns the `RecordedStep` of an accepted step of the interval.
    """

    window = 10 * WINDOW  # a jump with a small tolerance takes thousands of steps
    # The embedded formula overestimates errors of steps of a higher order, by more in higher derivatives: second
    # derivatives of radau with errors of 1e-8 had estimates of up to twice the limit of first ones.
    allowance = 10.0
    follows_path = False
    largest_size: int | None = None
    params: Any
    moving: Any
    record: Any

    def __init__(
        self,
        problem: Problem,
        name: str,
        order: int,
        embedded_order: int,
        tolerance: Any,
        floor: Any,
        max_step: float | None = None,
    ) -> None:
        super().__init__(Scheme(problem, name, order), tolerance, floor, max_step)
        self.taken = [1.0]
        self.compared = embedded_order
        self.ratio = 1.0
        self.weight = 1.0

    def __call__(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the state after the interval h."""
        run, arguments = self.interval(u, params, t, h)
        if not run.problem.size:
            return u
        new = run._state_after(arguments, is_variable)
        self.taken = run.taken
        return run.rounded(new)

    def interval(self, u: Any, params: Any, t: Any, h: Any) -> tuple[Any, tuple]:
        """Return a copy of this object for one time interval, and the arguments to call it with.

        The arguments are the flat state, the traced params, the start time and the length of the interval.
        """
        run = copy(self)
        run.problem = FlatProblem(self.problem, u, self.name)
        size = run.problem.size
        if self.largest_size is not None and size > self.largest_size:
            raise ShapeError(
                f"{self.name} solves full systems of at most {self.largest_size} unknowns, got {size}; take rodas5p"
            )
        run.params = constant(untraced(params))
        run.moving = [isbox(leaf) for leaf in leaves(params)]
        v = run.problem.flat(u)
        if v.size:
            run.check(u, params, t, h)
        moving = [leaf for leaf in leaves(params) if isbox(leaf)]
        return run, (v, moving, 0.0 if t is None else t + 0.0, h)

    def replay(self, path: list[AcceptedStep], starts: Sequence[tuple], event: Event | None) -> list[tuple]:
        """Return the ends of accepted steps: (state, time of the event or None) for each perturbed solution."""
        runs, flat_starts = zip(*(self.interval(*start) for start in starts), strict=True)
        run = runs[0]
        arguments = untraced(flat_starts[0])
        sizes = [*run.sizes(path[0].u), *map(relative_sizes, leaves(arguments[1:]))]
        start = FlatDeviation(flat_starts[0], is_variable, sizes)
        last = path[-1]
        sizes = run.sizes(path[0].u, last.new)
        if event:
            time = arguments[2] + (last.done + last.length) * arguments[3]
            end = FlatDeviation((last.new, time), is_variable, [*sizes, arguments[3]])
        else:
            end = FlatDeviation(last.new, is_variable, sizes)
        initial_deviations = anp.array([start.deviation(one) for one in flat_starts])
        deviations = run._deviations_at_end(path, arguments, start, end, initial_deviations, event)
        ends = []
        for number in range(len(starts)):
            new = end.tree(deviations[number])
            time = None
            if event:
                new, time = new
            ends.append((run.rounded(new), time))
        return ends

    def tree(self, v: Any) -> Any:
        """Convert the flat state of a step to the tree of the user's state."""
        return self.problem.state(v)

    def rounded(self, v: Any) -> Any:
        """Convert the flat state at the end of an interval to a tree with the dtypes of the user's state."""
        return self.problem.unknowns.rounded(v)

    def check(self, *arguments: Any) -> None:
        """Raise an error for a state, a rate, or derivatives that the method does not support."""
        u, _, t, h = untraced(arguments)
        rate = self.problem.problem(u, self.params, t)
        require_arrays(self.name, leaves(rate))
        like(combine(u, (0.0, rate)), u)  # raise an error for a wrong shape or a complex rate
        if any(map(isbox, leaves(rate))):
            raise DerivativeError(
                f"the rate of {self.name} uses a traced value that is not an argument; put it into params"
            )
        if any(dtype_of(leaf).kind == "c" for leaf in leaves(arguments) if isbox(leaf)):
            raise DerivativeError(f"{self.name} has derivatives in real params; give real and imaginary part as two")
        if self.tolerance is not None:
            self.check_tolerance(u)

    def inspector(self, arguments: tuple) -> RateInspector | None:
        """Return an object that detects jumps of the rate; None without error control or if the rate cannot jump."""
        problem = self.problem.problem
        if self.tolerance is None or (problem.rate is None and not problem.source_takes_time):
            return None
        return RateInspector(self, self.params, *arguments[2:])

    def _leaves_zero(self, u: Any, new: Any) -> bool:
        """Return True if a step changes an array that is 0 and has no floor: see `Adaptive`."""
        return super()._leaves_zero(self.problem.state(u), self.problem.state(new))

    def sizes(self, *states: Any) -> list:
        """Return |u| + floor, the unit of errors, as a flat array; |u| is the largest of several states."""
        return [np.concatenate([*map(np.ravel, super().sizes(*map(self.problem.state, states)))])]

    def units(self, v: Any, w: Any) -> np.ndarray:
        """Return |v| + floor, the unit of errors, with the larger of two states; 1 in place of 0."""
        (size,) = self.sizes(v, w)
        return np.where(size > 0, size, 1.0)

    def perturbed_solutions(self, count: int, arguments: tuple) -> tuple[Callable, Callable]:
        """Return the functions `perturb` and `evaluate`; without error control there are no perturbed solutions."""
        if self.tolerance:
            return super().perturbed_solutions(count, arguments)
        return (lambda x: x[None]), (lambda x: x[0])

    # ------------------------------------------------------------ derivatives of higher order

    def _recorded_deviations(
        self,
        path: list,
        arguments: tuple,
        start: FlatDeviation,
        end: FlatDeviation,
        initial_deviations: Any,
        event: Event | None,
    ) -> Any:
        """Return what `_deviations_at_end` returns, with a record of each step, for derivatives of every order."""
        *_, t, h = arguments
        records = [self.record(step, t, h) for step in path]
        ends = []
        # There is one solution without error control.
        for error_weight, deviation in zip(WEIGHT_REDUCTIONS, initial_deviations, strict=False):
            v, moving, *times = start.tree(deviation)
            new, time = self._recorded_end(records, error_weight, event, v, moving, *times)
            ends.append(end.deviation((new, time) if event else new))
        return anp.array(ends)

    def with_moving(self, moving: Sequence) -> Any:
        """Return the params with these leaves in place of the moving ones."""
        entries, rebuild = flatten(self.params)
        replacements = iter(moving)
        is_moving = [*self.moving, *[False] * (len(entries) - len(self.moving))]
        return rebuild([next(replacements) if moves else leaf for leaf, moves in zip(entries, is_moving, strict=True)])

    def _recorded_end(
        self, records: list[RecordedStep], error_weight: float, event: Event | None, v: Any, moving: Any, t: Any, h: Any
    ) -> tuple[Any, Any]:
        """Record the accepted steps; return the last state and the time of the event or None.

        `error_weight` is the weight of the error in the derivative of each new state.
        """
        shift: Any = 0.0  # the sum of all d
        for record in records[:-1]:
            v, shift = record.after((v, moving, t, h, shift), error_weight)
        point = v, moving, t, h, shift
        if event:
            return records[-1].until_event(event, error_weight, point)
        return records[-1].after_last(point, error_weight)[0], None


class RecordedStep(ABC):
    """Records an accepted step of a method on the tape.

    Its functions `after`, `after_last` and `until_event` take one point (u, moving params, t, h, sum of all d).

    Parameters
    ----------
    parent : Embedded
        For one interval.
    step : AcceptedStep
    t, h : float
        Start and length of the interval.

    Attributes
    ----------
    section : array
        The derivative of the change d of the step length.
    """

    section: Any

    def __init__(self, parent: Any, step: AcceptedStep, t: float, h: float) -> None:
        self.parent = parent
        self.step = step

    @abstractmethod
    def stages(self, v: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the stages of the step, with derivatives."""

    @abstractmethod
    def new_state(self, v: Any, stages: Any) -> Any:
        """Return the state after the step."""

    @abstractmethod
    def embedded_error(self, v: Any, params: Any, t: Any, h: Any, stages: Any) -> Any:
        """Return the error of the embedded formula."""

    def state_after(self, error_weight: float, v: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the state after the step. Its derivative contains the weighted error of the embedded formula."""
        stages = self.stages(v, params, t, h)
        new = self.new_state(v, stages)
        if error_weight:
            new = new + error_weight * self.embedded_error(v, params, t, h, stages)
        return with_values(new, self.step.new)

    def after(self, point: tuple, error_weight: float = 0.0) -> tuple:
        """Return the state after the step, and the sum of all d."""
        v, moving, t, h, shift = point
        change = length_shift(v, [self.section])
        start = t + self.step.done * h + shift
        length = self.step.length * h + change
        return self.state_after(error_weight, v, self.parent.with_moving(moving), start, length), shift + change

    def after_last(self, point: tuple, error_weight: float = 0.0) -> tuple:
        """Return the same for the last step, which subtracts the sum of all d."""
        v, moving, t, h, shift = point
        start = t + self.step.done * h + shift
        length = self.step.length * h - shift
        return self.state_after(error_weight, v, self.parent.with_moving(moving), start, length), 0.0 * shift

    def until_event(self, event: Event, error_weight: float, point: tuple) -> tuple:
        """Return the state and the time at the end of a step that an event ends."""
        v, moving, t, h, shift = point
        start = t + self.step.done * h + shift
        half = 0.5 * plain(self.step.length * h)
        params = self.parent.with_moving(moving)
        advance = partial(self.state_after, error_weight)
        return self.parent._state_at_event(event, self.step, error_weight, v, params, start, half, advance)


def norm(x: np.ndarray) -> float:
    """Return the root mean square of a vector; for an array of stages, the root of the sum of their mean squares."""
    return float(np.sqrt(np.vdot(x, x) / x.shape[-1]))
