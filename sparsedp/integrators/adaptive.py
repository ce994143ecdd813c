"""Error control: choose step lengths so that the error of each step, estimated by step doubling, meets the tolerance.

A trial of length h is computed once by one whole step, with the result w, and once by two half steps, with the result
f. The difference f - w is about 2^p - 1 times the error of f. The trial returns f + (f - w) / (2^p - 1), which is one
order more accurate (local extrapolation). For Crank-Nicolson it returns f, because stiff components change their sign
in each step and w has the wrong sign. The next length is the smaller one of two: the length that the last error allows,
and the length predicted from the last two errors.

Derivatives. Let a fast change of the state (a jump, an ignition) occur at a time that depends on the parameters. The
derivative of the state at a fixed time during this change is the product of its rate of change and the derivative of
the time of the change. It is very large during the change and small afterwards, and with constant step lengths the
small value is lost in the errors of the large one. Therefore step lengths get a derivative with respect to the state.
With the rate f and the weights of the error norm, a half step of length h from the state u gets the length h + d,

    d = -q <f, u - u*> / <f, f>,     q = a / (a + SLACK),     a = h |f|,

where u* is the value of u treated as a constant. So d is 0, but has a derivative, which moves the perturbed state back
to the plane through u* perpendicular to f. To end at the same time, the sum of all d is subtracted again over the last
part of the interval, in proportion to the step lengths. This part starts where it is long and the rate in it is small.
If the rate is continuous, the choice of d does not change the limit of the derivative for small tolerances. If it
jumps, at a time or on a surface of the state, the limit lacks the contribution of the jump for every choice of d:
discontinuities.py detects jumps and raises an error, interruptions.py computes the contribution.

The error of a derivative is estimated by two perturbed solutions. Their states equal those of the solution, only their
derivatives differ. The first one has the derivative of f + (weight - EPSILON) (f - w), a slightly smaller
extrapolation; at the end it differs from the solution by EPSILON times the contribution of the extrapolation. In the
second one the input is perturbed by relative errors of the size of the tolerance; the difference is large if terms
cancel so that these errors matter. The error estimate is the sum of both differences. The derivative of the solution
itself is returned. `perturb` and `evaluate` are used in forward mode and, with their roles exchanged as transposes of
each other, in reverse mode, and thus for derivatives of every order. One perturbed solution with both changes would be
cheaper, but one change could cancel the other: at the boundary of two intervals in the middle of a jump, derivatives
with an error of 69 % were accepted.

The values of all states are known when the derivative is computed. So the tape records only their deviations from
these values, which are 0 and have a derivative.

References
----------
E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993), II.4; K. Gustafsson, ACM Trans.
Math. Software 20 (1994).
"""

from __future__ import annotations

from collections import deque
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import note, thread
from sparsedp._utils.pytree import TreeStructure, flatten, is_uniform, labels, leaves, mapped, paired
from sparsedp._utils.validation import number_beside
from sparsedp.autodiff.backend import NUMPY, backend_of, replicated
from sparsedp.autodiff.derivative import push
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, linear, plain, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.grid.space import Space
from sparsedp.integrators.discontinuities import RateInspector
from sparsedp.integrators.problem import combine, time_after, untraced, without_side
from sparsedp.integrators.runge_kutta import Explicit, Scheme

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sparsedp.integrators.events import Event

__all__ = [
    "AcceptedStep",
    "Adaptive",
    "FlatDeviation",
    "inner_product",
    "length_shift",
    "relative_sizes",
    "with_values",
]

FLOOR_ADVICE = "; give one number, or a tree like the state"  # advice about a floor
# Safety factor, least and largest ratio of successive step lengths.
SAFETY = 0.9
SMALLEST = 0.2
LARGEST = 5.0
# Lengths and times are fractions of the interval.
LEAST_ERROR = 1e-2  # smaller errors (in units of the tolerance) are replaced by this value to predict the next length
FLOOR = 0.1  # default floor of errors: this fraction of the largest entry of an array
LEAST = 1e-15  # least length of a step relative to the time so far; a shorter step would be lost to rounding
TINY = 1e-25  # least length of the first step
LONGEST_FIRST_STEP = 1e-3  # longest first step if the rate depends on the time, as it may be small at the start only
MOST_TRIALS = 100_000  # largest number of trials in one interval
WINDOW = 1000  # number of trials after which the progress is checked
# Stop with an error if at the present progress the remainder would need this many times MOST_TRIALS trials.
LARGEST_FORECAST = 10

QUADRATURE = {  # nodes and weights by order
    1: ((0.5,), (1.0,)),
    2: ((0.0, 0.5, 1.0), (1 / 6, 4 / 6, 1 / 6)),
    3: ((0.0, 0.25, 0.5, 0.75, 1.0), (3 / 42, 16 / 42, 4 / 42, 16 / 42, 3 / 42)),
    4: ((0.0, 0.25, 0.5, 0.75, 1.0), (7 / 90, 32 / 90, 12 / 90, 32 / 90, 7 / 90)),
}
SLACK = 0.05  # relative change of the state in a half step for which the factor q of d is 1/2
EPSILON = 1e-3  # reduction of the weight of the extrapolation in the first perturbed solution
WEIGHT_REDUCTIONS = (0.0, EPSILON, 0.0)  # for the solution and for both perturbed solutions
LARGEST_DERIVATIVE_ERROR = 6.0  # with extrapolation: largest error of a derivative, in units of tolerance^(p / (p + 1))
TIMES = 10.0  # ratio of the largest error of a derivative to the relative perturbation of the input
# The time of an event has no derivative above this relative uncertainty of the rate of change of the event.
LARGEST_RATE_UNCERTAINTY = 0.1
ROUNDING = 1e-12  # a second derivative below this fraction of the largest first derivative is rounding
SHARE = 1e-4  # errors of derivatives smaller than this fraction of the input are relative to the fraction


class AcceptedStep(NamedTuple):
    """An accepted step.

    Attributes
    ----------
    length, done : float
        Length of the step, and the time from the start of the interval to the step, as fractions of the interval.
    u, middle, new : tree
        The states before the step, between its halves, and after it. For radau `u` and `new` are flat arrays, and
        `middle` holds the stages.
    """

    length: float
    done: float
    u: Any
    middle: Any
    new: Any


class Adaptive(Scheme):
    """A scheme with error control over each interval.

    Parameters
    ----------
    scheme : Scheme
    tolerance : float
        Largest error of two half steps, relative to |u| + floor, as root mean square over all entries.
    floor : None, number, or tree like the state
        None: a tenth of the largest entry of each array of the state.
    max_step : float, optional
        Longest step.

    Attributes
    ----------
    compared : int
        Order of the error that is controlled.
    taken : list of float
        Lengths of the accepted steps in the last interval, as fractions of the interval.
    weight : float
        Weight of the extrapolation: 1 / (2^p - 1), or 0 for none.
    allowance : float
        Factor by which the estimated error of a derivative may be larger for each order above the first.
    overestimate : float
        Factor by which the estimated error of a derivative may be larger because it exceeds the error.
    """

    window = WINDOW
    allowance = 1.0
    overestimate = 1.0

    def __init__(self, scheme: Scheme, tolerance: Any, floor: Any, max_step: float | None = None) -> None:
        super().__init__(scheme.problem, f"stepper({scheme.name})", scheme.order)
        self.scheme: Any = scheme
        self.info = scheme.info
        self.dyadic = scheme.dyadic
        self.tolerance = tolerance
        self.floor = constant(floor)
        if max_step is None:
            self.max_step = np.inf
        else:
            self.max_step = float(max_step)
        self.taken: list[float] = []
        self.compared = self.order
        self.ratio: float = 2**self.order - 1
        if scheme.name == "crank_nicolson":
            self.weight = 0.0
        else:
            self.weight = 1 / self.ratio

    def __call__(self, *arguments: Any) -> Any:
        """Return the state after the interval h, from (u, params, t, h)."""
        self.check_tolerance(arguments[0])
        return self._state_after(arguments, isbox)

    def _state_after(self, arguments: tuple, has_derivative: Callable[[Any], bool]) -> Any:
        """Return the state after the interval; ``has_derivative(leaf)`` is True for differentiated arguments."""
        is_traced = any(map(isbox, leaves(arguments)))
        path, _, self.taken = self.steps_over(untraced(arguments), is_traced)
        if is_traced:
            return self._differentiable_end(path, arguments, has_derivative)
        return path[-1].new

    def steps_over(
        self, arguments: tuple, keeps_all: bool, detector: Any = None
    ) -> tuple[list[AcceptedStep], Event | None, list[float]]:
        """Run the steps over an interval, or up to the first event in it.

        Parameters
        ----------
        arguments : tuple
            (u, params, t, h), plain.
        keeps_all : bool
            Whether all steps are returned; otherwise only the last one.
        detector : EventDetector, optional
            Locates events in each step.

        Returns
        -------
        path : list of AcceptedStep
        event : Event or None
            The event at the end of the path.
        lengths : list of float
            The lengths of all steps.
        """
        path: deque = deque(maxlen=None if keeps_all else 1)
        lengths = []
        event = None
        inspector = self.inspector(arguments)
        u, params, t, h = arguments
        for step in self._steps(u, params, t, h, inspector):
            if detector:
                crossing = detector.first_crossing(self, step, arguments)
            else:
                crossing = None
            if crossing:
                step = crossing.step
                event = crossing.event
            path.append(step)
            lengths.append(step.length)
            if keeps_all and inspector:
                inspector.search(step)
            if event:
                break
        if keeps_all and inspector:
            if inspector.jumps:
                self._refuse_jump(*inspector.jumps[0])
            place = inspector.unresolved_step()
            if place is not None:
                self._refuse_layer(path[place], arguments)
        return [*path], event, lengths

    # ------------------------------------------------------------ discontinuities of the rate

    @property
    def takes_time(self) -> bool:
        """Return whether the right-hand side depends on the time."""
        return self.scheme.problem.rate_takes_time or self.scheme.problem.source_takes_time

    @property
    def quadrature(self) -> tuple[Sequence[float], Sequence[float]]:
        """Return nodes and weights of the quadrature formula that a step is for a rate that depends on time only."""
        if not self.weight:
            return (0.0, 0.5, 1.0), (0.25, 0.5, 0.25)
        return QUADRATURE[self.compared]

    @property
    def follows_path(self) -> bool:
        """Return whether the integral of the rate along the path approximates the step, as for explicit schemes."""
        return isinstance(self.scheme, Explicit)

    def inspector(self, arguments: tuple) -> RateInspector | None:
        """Return an object that detects jumps of the rate.

        Return None if the rate cannot jump (an operator and a constant source), and for distributed fields, which the
        detection would have to gather.
        """
        problem = self.scheme.problem
        if problem.rate is None and not problem.source_takes_time:
            return None
        if backend_of(leaves(arguments[0])) is not NUMPY:
            return None
        return RateInspector(self, *arguments[1:])

    def inner_state(self, step: AcceptedStep) -> tuple[Any, float]:
        """Return a state inside a step, in the form of `AcceptedStep.u`, and its position as a fraction of the step."""
        return step.middle, 0.5

    def _refuse_jump(self, time: float, is_in_time: bool) -> None:
        cure = f"breaks=[{time:.6g}], or breaks=lambda params: [...] where it moves"
        if not is_in_time:
            cure = "events=lambda u, params, t: ... with a function that is 0 there"
            if self.takes_time:  # for states close to 0 a jump in time may be mistaken for a jump with the state
                cure += f", or breaks=[{time:.6g}] if it jumps at that time in every state"
        raise DerivativeError(
            f"the rate of {self.name} jumps at t = {time:.9g}, and the derivative of steps across it lacks the term of "
            f"the jump; write {cure}"
        )

    def _refuse_layer(self, step: AcceptedStep, arguments: tuple) -> None:
        time = (arguments[2] or 0.0) + (step.done + 0.5 * step.length) * arguments[3]
        raise DerivativeError(
            f"the rate of {self.name} changes near t = {time:.6g} faster than steps with the tolerance "
            f"{self.tolerance:g} resolve, and the derivative would miss a part of it; give a smaller tolerance or "
            "max_step, or breaks= where it jumps"
        )

    # ------------------------------------------------------------ for steps that stop at breaks and events

    def interval(self, u: Any, params: Any, t: Any, h: Any) -> tuple[Adaptive, tuple]:
        """Return the scheme that crosses an interval, and its arguments."""
        return self, (u, params, t, h)

    def replay(self, path: list[AcceptedStep], starts: Sequence[tuple], event: Event | None) -> list[tuple]:
        """Return the ends of accepted steps: (state, time of the event or None) for each perturbed solution.

        Parameters
        ----------
        path : list of AcceptedStep
        starts : list of tuples
            (u, params, t, h) of each solution. Their values are equal, their derivatives differ.
        event : Event or None
            The event at the end of the path.
        """
        _, params, t, h = untraced(starts[0])
        slopes = self._length_slopes(path, params, t, h, event)
        return [
            self._replayed(path, slopes, weight_reduction, event, *start)
            for weight_reduction, start in zip(WEIGHT_REDUCTIONS, starts, strict=True)
        ]

    def tree(self, u: Any) -> Any:
        """Convert a state of a step to the tree that the user passes and gets."""
        return u

    def rounded(self, u: Any) -> Any:
        """Convert the state at the end of an interval to the dtypes of the user's state."""
        return u

    def rate(self, u: Any, params: Any, t: Any) -> Any:
        """Return the rate at a state of a step."""
        return self.problem(u, params, t)

    def partial_step(self, step: AcceptedStep, arguments: tuple, length: float) -> AcceptedStep | None:
        """Repeat a step with another length (a fraction of the interval); return None if the trial fails."""
        _, params, t, h = arguments
        middle, new, _ = self._trial(step.u, params, time_after(t, step.done * h), length, h)
        if new is None:
            return None
        return AcceptedStep(length, step.done, step.u, middle, new)

    # ------------------------------------------------------------ error control

    def check_tolerance(self, u: Any) -> None:
        """Raise an error for a floor that does not fit the state, and for a tolerance below the rounding of its dtype.

        With such a tolerance step lengths would shrink to zero. The tolerance is also recorded in the counters, as
        `check.gradient` compares the difference that it finds with the tolerance.
        """
        thread.controlled += 1
        note(self.name, "tolerance", self.tolerance)
        for place, floor, leaf in zip(labels(u, "floor"), self._floors(u), leaves(u), strict=True):
            try:
                np.broadcast_to(floor, np.shape(plain(leaf)))
            except ValueError:
                raise ShapeError(
                    f"{place}: shape {np.shape(floor)} does not fit the state there, of shape {np.shape(plain(leaf))}"
                    f"{FLOOR_ADVICE}"
                ) from None
        for leaf in filter(is_variable, leaves(u)):
            rounding = np.finfo(dtype_of(leaf)).eps
            if self.tolerance < 4 * rounding:
                raise ValueError(
                    f"{self.name} cannot meet the tolerance {self.tolerance:g} with a state of {dtype_of(leaf)}, whose "
                    f"rounding is {rounding:.1e}; take a larger tolerance or write u.astype(float)"
                )

    def _steps(self, u: Any, params: Any, t: Any, h: Any, inspector: RateInspector | None) -> Iterable[AcceptedStep]:
        """Yield the accepted steps over the interval."""
        length = self._first_length(u, params, t, h)
        longest = self.max_step / h
        done = 0.0
        done_at_window = 0.0  # value of `done` at the last check of the progress
        count = 0
        last = None  # length and error of the last accepted step
        most = LARGEST
        power = -1 / (self.compared + 1)
        left_zero = None  # value of `done` at which a rejected step would have changed an array that is 0
        for trial in range(1, MOST_TRIALS + 1):
            rest = 1.0 - done
            length = self._allowed(min(length, longest), rest)
            middle, new, error = self._trial(u, params, time_after(t, done * h), length, h, inspector)
            change = SAFETY * max(error, 1e-10) ** power
            is_accepted = error <= 1
            if is_accepted and inspector:
                shorter = inspector.shorter_share(AcceptedStep(length, done, u, middle, new))
                if shorter is not None:
                    is_accepted = False
                    change = shorter
            if not is_accepted and new is not None and self._leaves_zero(u, new):
                left_zero = done
            if is_accepted:
                yield AcceptedStep(length, done, u, middle, new)
                count += 1
                u = new
                if length < rest:
                    done = done + length
                else:
                    done = 1.0
                error = max(error, LEAST_ERROR)
                if done == 1.0:
                    return
                if last is not None:  # assume that errors continue to grow at the same rate
                    last_length, last_error = last
                    change = min(change, change * length / last_length * (error / last_error) ** power)
                last = length, error
            if is_accepted or error > 1:
                least = SMALLEST
            else:
                least = 0.0
            length *= float(np.clip(change, least, most))
            # The step after a rejected one must not be longer than this one.
            if is_accepted:
                most = LARGEST
            else:
                most = 1.0
            if length < max(LEAST * done, TINY):
                break
            if trial % self.window == 0:
                if (1.0 - done) * self.window > LARGEST_FORECAST * MOST_TRIALS * (done - done_at_window):
                    break
                done_at_window = done
        cure = "take a larger tolerance, a method for stiff problems, or an interval that ends before the solution does"
        if left_zero is not None and done - left_zero < 1e-3:
            cure = (
                "an array of the state is 0 there, and errors are relative to it; write floor=, the size below which "
                "it does not matter, or breaks= with the times at which its rate sets in"
            )
        raise ConvergenceError(
            f"{self.name} found no step that meets the tolerance {self.tolerance:g} at {done:.3g} of its interval "
            f"after {count} steps; {cure}"
        )

    def _leaves_zero(self, u: Any, new: Any) -> bool:
        """Return True if a step changes an array that is 0 and has no floor: its errors are relative to this change."""
        for before, after, floor in zip(leaves(u), leaves(new), self._floors(u), strict=True):
            is_zero = np.max(np.abs(before), initial=0.0) == 0
            if floor is None and is_zero and np.max(np.abs(after), initial=0.0) != 0:
                return True
        return False

    def _first_length(self, u: Any, params: Any, t: Any, h: Any) -> float:
        """Return the first step length, which changes the state by about a hundredth of its size."""
        size = _largest_entry(u)
        speed = _largest_entry(self.problem(u, params, t))
        if not np.isfinite(speed):
            raise NonFiniteError(
                f"the rate of {self.name} must be finite at the state given; take a state in its domain"
            )
        if speed > 0:
            length = 0.01 * (size or 1.0) / (speed * float(h))
        else:
            length = 1.0
        return min(max(1e3 * TINY, length), LONGEST_FIRST_STEP if self.problem.timed else 1.0)

    def _allowed(self, length: float, rest: float) -> float:
        """Limit a length to the rest of the interval, and avoid a very short last step."""
        if self.dyadic:
            return 2.0 ** float(np.floor(np.log2(min(length, rest))))
        if length > 0.99 * rest:
            return rest
        if length > 0.5 * rest:
            return min(length, 0.5 * rest)
        return length

    def _trial(
        self, u: Any, params: Any, t: Any, length: float, h: Any, inspector: RateInspector | None = None
    ) -> tuple[Any, Any, float]:
        """Return the state between two half steps, the new state, and the error in units of the tolerance."""
        half = 0.5 * length * h
        scheme = self.scheme
        middle_time = time_after(t, half)
        try:
            with np.errstate(all="ignore"):  # overflow in a step that is too long leads to its rejection below
                # The inspector also needs the rates at the start and in the middle, which explicit steps evaluate.
                if inspector is not None and isinstance(scheme, Explicit):
                    first = inspector.rate_at_state(u, t)
                    middle = scheme(u, params, t, half, first)
                    second = inspector.rate_at_state(middle, middle_time)
                    fine = scheme(middle, params, middle_time, half, second)
                    whole = scheme(u, params, t, half + half, first)
                else:
                    middle = scheme(u, params, t, half)
                    fine = scheme(middle, params, middle_time, half)
                    whole = scheme(u, params, t, half + half)
                error = self._error(u, fine, whole)
                new = self.extrapolated(fine, whole, self.weight)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            if length * SMALLEST < TINY:
                raise
            return None, None, np.inf
        return middle, new, error if np.isfinite(error) else np.inf

    @staticmethod
    def extrapolated(fine: Any, whole: Any, weight: float) -> Any:
        """Return fine + weight (fine - whole)."""
        if weight:
            return combine(fine, (weight, fine), (-weight, whole))
        return fine

    def _floors(self, u: Any) -> list:
        """Return the floor of each array of the state; a number or None may stand for a whole branch."""
        return paired(self.floor, u, "floor", advice=FLOOR_ADVICE, prefix=is_uniform)

    def sizes(self, *states: Any) -> list:
        """Return for each array |u| + floor, the unit of errors, where |u| is the largest of several states."""
        columns = zip(*map(leaves, states), strict=True)
        sizes = []
        for column, floor in zip(columns, self._floors(states[0]), strict=True):
            size = reduce(np.maximum, map(np.abs, column))
            sizes.append(size + (FLOOR * np.max(size, initial=0.0) if floor is None else floor))
        return sizes

    def _error(self, u: Any, new: Any, whole: Any) -> float:
        """Return the error of two half steps in units of the tolerance."""
        norms = []
        count = 0
        for size, fine, coarse in zip(self.sizes(u, new), leaves(new), leaves(whole), strict=True):
            share = np.where(fine == coarse, 0.0, np.abs(fine - coarse) / size)
            norms.append(np.linalg.norm(share))
            count += share.size
        return float(np.linalg.norm(norms)) / (max(count, 1) ** 0.5 * self.tolerance * self.ratio)

    # ------------------------------------------------------------ derivatives of the accepted steps

    def _differentiable_end(self, path: list, arguments: tuple, has_derivative: Callable[[Any], bool]) -> Any:
        """Return the state at the end of the path, with a derivative whose error is checked."""
        plain_arguments = untraced(arguments)
        sizes = [*self.sizes(path[0].u), *map(relative_sizes, leaves(plain_arguments[1:]))]
        start = FlatDeviation(arguments, has_derivative, sizes)
        end = FlatDeviation(path[-1].new, is_variable, self.sizes(path[0].u, path[-1].new))
        perturb, evaluate = linear(f"{self.name}.variation", *self.perturbed_solutions(len(path), arguments))
        initial_deviations = perturb(start.deviation(arguments))
        return end.tree(evaluate(self._deviations_at_end(path, plain_arguments, start, end, initial_deviations)))

    def _deviations_at_end(
        self, path: list, arguments: tuple, start: FlatDeviation, end: FlatDeviation, initial_deviations: Any
    ) -> Any:
        """Return the deviations of the three solutions at the end, from those at the start."""
        ends = self.replay(path, [start.tree(x) for x in initial_deviations], None)
        return anp.array([end.deviation(new) for new, _ in ends])

    def section(self, u: Any, rates: Sequence, half: float) -> tuple[list, float]:
        """Return the derivative of d with respect to each array of the state, and the relative speed |f|."""
        sizes = [np.where(size > 0, size, np.inf) for size in self.sizes(u)]
        count = max(sum(size.size for size in sizes), 1)
        rows = [np.conj(rate / size) / size / count for rate, size in zip(rates, sizes, strict=True)]
        square = float(sum(np.sum(np.real(row * rate)) for row, rate in zip(rows, rates, strict=True)))
        speed = np.sqrt(square)
        return [-half / (speed * half + SLACK) / (speed or 1.0) * row for row in rows], speed

    def _length_slopes(self, path: list, params: Any, t: Any, h: Any, event: Event | None) -> tuple[list, float]:
        """Return the derivatives of the changes d of the step lengths.

        Returns
        -------
        rows : list
            For each step the derivatives of d in both halves; None for the last steps, in which the sum of all d is
            subtracted again.
        rest : float
            Total length of these last steps.
        """
        rows: list = []
        speeds = []
        for step in path[:-1] if event else path:
            half = 0.5 * step.length * h
            start = time_after(t, step.done * h)
            rates = leaves(self.problem(step.u, params, start))
            first, speed = self.section(step.u, rates, half)
            rates = leaves(self.problem(step.middle, params, time_after(start, half)))
            second, _ = self.section(step.middle, rates, half)
            rows.append((first, second))
            speeds.append(speed)
        if event:  # the time of an event is not fixed, so that the sum of all d is not subtracted
            return [*rows, None], np.inf
        rest = h * (1.0 - np.array([step.done for step in path]))
        fastest = np.maximum.accumulate(speeds[::-1])[::-1]  # from each step on
        turn = int(np.argmin(fastest + 1 / rest))
        return rows[:turn] + [None] * (len(path) - turn), rest[turn]

    def _replayed(
        self,
        path: list,
        slopes: tuple,
        weight_reduction: float,
        event: Event | None,
        u: Any,
        params: Any,
        t: Any,
        h: Any,
    ) -> tuple[Any, Any]:
        """Run the accepted steps again, with derivatives; return the last state and the time of the event or None.

        Each new state gets the value of the accepted step. `weight_reduction` reduces the weight of the extrapolation.
        """
        rows, rest = slopes
        shift: Any = 0.0  # the sum of all d
        returned: Any = 0.0  # in the last steps: the amount subtracted per unit of time
        for step, row in zip(path, rows, strict=True):
            half = 0.5 * step.length * h
            start = time_after(time_after(t, step.done * h), shift)
            if event and step is path[-1]:
                advance = partial(self._advanced, step, self.weight - weight_reduction)
                return self._state_at_event(event, step, weight_reduction, u, params, start, half, advance)
            if row:
                first = length_shift(u, row[0])
            else:
                first = -returned * plain(half)
            middle = with_values(self.scheme(u, params, start, half + first), step.middle)
            if row:
                second = length_shift(middle, row[1])
            else:
                second = -returned * plain(half)
            fine = self.scheme(middle, params, time_after(time_after(start, half), first), half + second)
            whole = self.scheme(u, params, start, half + first + (half + second))
            u = with_values(self.extrapolated(fine, whole, self.weight - weight_reduction), step.new)
            shift = shift + first + second
            if row:
                returned = shift / rest
        return u, None

    def _advanced(self, step: AcceptedStep, weight: float, u: Any, params: Any, t: Any, length: Any) -> Any:
        """Return the state after an accepted step with another length, with derivatives."""
        half = 0.5 * length
        middle = with_values(self.scheme(u, params, t, half), step.middle)
        fine = self.scheme(middle, params, t + half, half)
        whole = self.scheme(u, params, t, length)
        return with_values(self.extrapolated(fine, whole, weight), step.new)

    def _state_at_event(
        self,
        event: Event,
        step: AcceptedStep,
        weight_reduction: float,
        u: Any,
        params: Any,
        t: Any,
        half: Any,
        advance: Callable[[Any, Any, Any, Any], Any],
    ) -> tuple[Any, Any]:
        """Return the state and the time at the end of a step that an event ends.

        ``advance(u, params, t, length)`` returns the state after the step.
        """

        def advanced(point: tuple, change: Any) -> tuple[Any, Any]:
            """Return the state and the time after a step of length 2 half + change."""
            u, params, t = point
            length = 2.0 * (half + 0.5 * change)
            return advance(u, params, t, length), t + length

        def value(point: tuple, change: Any) -> Any:
            new, time = advanced(point, change)
            return event.value(self.tree(new), without_side(point[1]), time)

        point = u, params, t
        plain_point = untraced(point)
        slope = float(push(lambda change: 1.0 * value(plain_point, change), 0.0, [1.0])[1])
        if not weight_reduction:
            self._check_transversal(event, step, plain_point, slope, 2.0 * half)
        change: Any = 0.0
        for _ in traces_of(leaves(point)):  # each Newton iteration makes the derivatives of one more order exact
            residual = value(point, change)
            change = change - (residual - plain(residual)) / slope
        return advanced(point, change)

    def _check_transversal(self, event: Event, step: AcceptedStep, start: tuple, slope: float, length: Any) -> None:
        """Raise DerivativeError if the solution only touches the surface of an event, up to the tolerance."""
        _, params, t = start
        u = self.tree(step.u)
        of_state, of_time = event.gradient(u, without_side(params), t)
        before = of_time + inner_product(of_state, self.tree(self.rate(step.u, params, t)))
        self.check_steep(event, self.tree(step.new), params, t + length, slope, (slope - before) / length)

    def check_steep(self, event: Event, u: Any, params: Any, t: Any, slope: float, curvature: Any) -> None:
        """Raise DerivativeError if the rate of change of an event is zero up to the tolerance.

        `slope` is the rate of change, and `curvature` its derivative with respect to time.
        """
        of_state, _ = event.gradient(u, without_side(params), t)
        sizes = flatten(u)[1](Adaptive.sizes(self, u))
        uncertain = self.tolerance * inner_product(mapped(_magnitude, of_state), sizes)
        if slope == 0 or abs(curvature) * uncertain > LARGEST_RATE_UNCERTAINTY * slope**2:
            raise DerivativeError(
                f"{event.name} of {self.name} grazes its surface at t = {t:.9g}: its rate of change there, "
                f"{slope:.3g}, is zero to the tolerance {self.tolerance:g}, so that its time has no derivative; "
                "give another event or parameter, or a smaller tolerance"
            )

    def perturbed_solutions(self, count: int, arguments: tuple) -> tuple[Callable, Callable]:
        """Return the functions `perturb` and `evaluate` of plain arrays, for a number of steps.

        `perturb` returns the initial deviations of the solution and of two perturbed solutions. `evaluate` returns the
        final deviation of the solution, and raises DerivativeError if those of the perturbed ones differ too much.
        """
        share = self.compared / (self.compared + 1)
        if self.weight:
            limit = self.overestimate * LARGEST_DERIVATIVE_ERROR * self.tolerance**share
            limit = limit * self.allowance ** (len(traces_of(leaves(arguments))) - 1)
        else:
            limit = TIMES * self.tolerance
        unit = EPSILON * self.ratio
        scale = 0.0  # largest magnitude of an entry of the last input
        largest = 0.0  # largest magnitude of an entry of all inputs so far

        def perturb(x: np.ndarray) -> np.ndarray:
            nonlocal scale, largest
            scale = np.max(np.abs(x), initial=0.0)
            largest = max(largest, scale)
            noise = np.random.default_rng(0).uniform(-1, 1, x.size)
            return np.stack([x, x, x * (1 + unit * limit / TIMES * noise)])

        def evaluate(ends: np.ndarray) -> np.ndarray:
            derivative, *perturbed = ends
            size = max(np.max(np.abs(derivative), initial=0.0), SHARE * scale)
            error = np.max(sum(np.abs(other - derivative) for other in perturbed), initial=0.0) / unit
            # If the input is not finite, another check names the call that produced it.
            if error <= limit * size or not np.isfinite(scale):
                return derivative.copy()
            if size < ROUNDING * largest:
                raise DerivativeError(
                    f"a second derivative of {self.name} over {count} steps is 0 to rounding, which error control "
                    "cannot tell from an error: the result does not depend on it to second order, as that of a ball "
                    "before its first bounce; leave it out, or take fixed steps"
                )
            # Without extrapolation the error decreases more slowly than the tolerance, so a smaller one does not help.
            if self.weight:
                cure = "give a smaller floor or tolerance"
            else:
                cure = "take tr_bdf2, which extrapolates"
            shown = number_beside(error / size, limit, float(f"{limit:.1e}"), digits=1, style="e")
            raise DerivativeError(
                f"the derivative of {self.name} over {count} steps is uncertain by {shown} of its "
                f"size, more than the {limit:.1e} that its tolerance {self.tolerance:g} allows; {cure}, end no "
                "interval in the middle of a fast change, or take fixed steps"
            )

        return perturb, evaluate


class FlatDeviation(TreeStructure):
    """The deviations of the differentiated leaves of a tree from their values, as one flat array of floats.

    Parameters
    ----------
    tree : tree
    has_derivative : callable
        ``has_derivative(leaf)``: whether a leaf has a derivative.
    sizes : list
        For each leaf the units of its deviations; 1 is used in place of 0.
    """

    def __init__(self, tree: Any, has_derivative: Callable[[Any], bool], sizes: Sequence) -> None:
        super().__init__(tree, "rate", has_derivative)
        self.values = [plain(leaf) for leaf in self.variables(tree)]
        self.units = []
        shapes = []
        for place, value in zip(self.places, self.values, strict=True):
            self.units.append(np.where(sizes[place] > 0, sizes[place], 1.0))
            shapes.append(np.shape(value))
            if np.iscomplexobj(value):
                shapes.append(np.shape(value))
        self.space = Space(None, parts=shapes)

    def deviation(self, tree: Any) -> Any:
        """Return the deviations of a tree as a flat array."""
        parts = []
        for leaf, value, unit in zip(self.variables(tree, "rate"), self.values, self.units, strict=True):
            part = replicated(_deviation(leaf, value) / unit)
            if np.iscomplexobj(value):
                parts += [anp.real(part), anp.imag(part)]
            else:
                parts.append(part)
        return self.space.join(*parts)

    def tree(self, flat: Any) -> Any:
        """Return the tree with these deviations."""
        variables = []
        parts = iter(self.space.split(flat))
        for value, unit in zip(self.values, self.units, strict=True):
            part = next(parts)
            if np.iscomplexobj(value):
                part = part + 1j * next(parts)
            variables.append(value + cast(unit * part, dtype_of(value)))
        return self.build(variables)


def _deviation(leaf: Any, value: Any) -> Any:
    """Return 0 with the derivative of a leaf, in double precision."""
    deviation = leaf - value
    return cast(deviation, np.result_type(dtype_of(deviation), float))


def with_values(tree: Any, values: Any) -> Any:
    """Replace the values of a tree by others that differ by rounding, and keep its derivatives."""
    return mapped(lambda leaf, value: leaf - plain(leaf) + value if isbox(leaf) else value, tree, values)


def length_shift(u: Any, rows: Sequence) -> Any:
    """Return d: 0, with its derivative."""
    pairs = zip(leaves(u), rows, strict=True)
    return sum(anp.sum(anp.real(row * _deviation(leaf, plain(leaf)))) for leaf, row in pairs if isbox(leaf))


def _magnitude(leaf: Any) -> Any:
    if leaf is None:
        return None
    return np.abs(leaf)


def _largest_entry(tree: Any) -> float:
    return float(np.max([np.max(np.abs(leaf), initial=0.0) for leaf in leaves(tree)], initial=0.0))


def inner_product(cotangent: Any, tangent: Any) -> float:
    """Return the real inner product of two trees; None in the first tree counts as 0."""
    pairs = zip(leaves(cotangent), leaves(tangent), strict=True)
    return float(sum(np.sum(np.real(row * rate)) for row, rate in pairs if row is not None))


def relative_sizes(leaf: Any) -> Any:
    """Return the unit of relative changes of each entry: its magnitude or, if this is 0, the largest magnitude."""
    if is_variable(leaf):
        size = np.abs(leaf)
    else:
        size = 1.0
    return np.where(size > 0, size, np.max(size, initial=0.0))
