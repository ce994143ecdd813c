"""Steps with error control that stop at given times (breaks) and at zero crossings (events).

The interval of a step is divided into segments. A segment ends at the next break, at the next event, or at the end of
the interval. Inside a segment the rate is smooth, and at both ends of the segment the rate is evaluated on its inner
side: see `Side` in problem.py.

The lengths of the segments are traced. This is sufficient for derivatives of all orders with respect to a break b:
differentiation of the two segments at b gives

    du/db = f_- - f_+,

where f_- is the rate at the end of the first segment and f_+ the rate at the start of the second one.

At an event g(u, params, t) = 0 a step of length l ends for which g(S(u, l), params, t + l) = 0, where S(u, l) is the
state after a step of length l: see event_detection.py. The implicit function theorem gives its derivative,

    dl = -(g_u dS + g_p dp + g_t dt) / (g_u S_l + g_t).

On the tape this is the iteration l <- l - g / (g_u S_l + g_t) with a constant denominator. One iteration is recorded
for each order of differentiation, because each iteration makes the derivatives of one more order exact.

An event at the end of an interval, up to rounding, belongs to this interval. The next interval would not find it, since
an event at the start of an interval is ignored.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import is_variable, isbox, linear, plain, traces_of
from sparsedp.errors import ConvergenceError, DerivativeError
from sparsedp.integrators.adaptive import Adaptive, FlatDeviation, inner_product, relative_sizes
from sparsedp.integrators.event_detection import EventDetector
from sparsedp.integrators.events import Event, times_of
from sparsedp.integrators.problem import Side, SidedParams, combine, untraced, without_side
from sparsedp.integrators.runge_kutta import Scheme

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.integrators.adaptive import AcceptedStep
    from sparsedp.integrators.problem import Problem

__all__ = ["Interrupted"]

MOST_EVENTS = 10_000  # largest number of events in one interval
REPEATS = 8  # raise an error if events occur more often than this (times their number) at the same time
SAME_STATE = 1e-9  # two states with a smaller relative difference are regarded as equal
SAME_DERIVATIVE = 1e-6  # derivatives of two times with a smaller relative difference are regarded as equal
ROUNDING = 64 * EPS  # relative rounding error of times and rates


class Segment(NamedTuple):
    """A part of an interval.

    Attributes
    ----------
    path : list of AcceptedStep
        The steps; empty if the length of the segment is zero up to rounding.
    side : Side
        Restricts the times and states at which the rate is evaluated.
    stop : int
        Position of the next break in the list of breaks, -1 for the end of the interval.
    event : Event or None
        The event that ended the segment before this stop.
    length : float
        Length of the time from the start of the segment to the stop.
    end, time : tree, float
        State and time at the end of the segment, if it ends at the stop.
    """

    path: list[AcceptedStep]
    side: Side
    stop: int
    event: Event | None
    length: float
    end: Any = None
    time: float = 0.0


class Interrupted(Scheme):
    """A scheme with error control that stops at breaks and events.

    Parameters
    ----------
    scheme : Adaptive
    breaks : callable or array
        The result of `break_times`.
    events : list of Event

    Attributes
    ----------
    taken : list of float
        Lengths of the accepted steps in the last interval, as fractions of the interval.
    t_events : list of arrays
        For each event its times in the last interval.
    """

    def __init__(self, scheme: Adaptive, breaks: Any, events: list[Event]) -> None:
        super().__init__(scheme.problem, scheme.name, scheme.order)
        self.scheme = scheme
        self.info = scheme.info
        self.breaks = breaks
        self.events = events
        self.taken: list[float] = []
        self.t_events: list[np.ndarray] = [np.zeros(0) for _ in events]

    def __call__(self, u: Any, params: Any, t: Any, h: Any) -> tuple:
        """Return the state and the time after the interval h, or at a terminal event."""
        self.scheme.check_tolerance(u)
        arguments = u, params, t, h
        is_traced = any(map(isbox, leaves(arguments)))
        run = _IntervalRun(self, untraced(arguments), is_traced)
        self.taken = run.taken
        self.t_events = [np.array(times) for times in run.event_times]
        if is_traced:
            return self._differentiable_end(run.segments, arguments, run.u, run.t)
        return run.u, run.t

    def breaks_within(self, params: Any, t: float, end: float) -> tuple[list[tuple[int, float]], bool]:
        """Return the positions and times of the breaks in (t, end], in order, and whether there is a break at t."""
        if callable(self.breaks):
            times = np.array(self.break_times(params), float)
        else:
            times = self.breaks
        order = np.argsort(times, kind="stable")
        first, last = np.searchsorted(times[order], [t, end], "right")
        places: list[int] = []
        for place in order[first:last]:
            if not places or times[place] != times[places[-1]]:
                places.append(place)
        return [(place, float(times[place])) for place in places], bool(np.any(times == t))

    def break_times(self, params: Any) -> Any:
        """Return the breaks, traced or not."""
        if callable(self.breaks):
            return times_of(self.breaks(params))
        return self.breaks

    # ------------------------------------------------------------ derivatives

    def _differentiable_end(self, segments: list[Segment], arguments: tuple, new: Any, time: float) -> tuple:
        """Return the state and the time at the end of all segments, with a derivative whose error is checked."""
        scheme = self.scheme
        plain_arguments = untraced(arguments)
        u, _, _, h = plain_arguments
        sizes = [*Adaptive.sizes(scheme, u), *map(relative_sizes, leaves(plain_arguments[1:]))]
        start = FlatDeviation(arguments, isbox, sizes)
        end = FlatDeviation((new, time), is_variable, [*Adaptive.sizes(scheme, u, new), h])
        count = sum(len(segment.path) for segment in segments)
        perturb, evaluate = linear(f"{self.name}.variation", *scheme.perturbed_solutions(count, arguments))
        initial_deviations = perturb(start.deviation(arguments))
        runs = [start.tree(initial_deviations[number]) for number in range(len(initial_deviations))]
        continuous: set[int] = set()
        if callable(self.breaks) and len(traces_of(leaves(arguments))) == 1:
            continuous = self._continuous_breaks(segments, plain_arguments[1], h)
        stops = []
        for _, params, t, length in runs:
            times = self._traced_breaks(params, segments, continuous)
            stops.append((*times, t + length))
        states = [(u, t) for u, _, t, _ in runs]
        params = [run[1] for run in runs]
        for segment in segments:
            states = self._replayed(segment, states, params, [times[segment.stop] for times in stops])
        return end.tree(evaluate(anp.array([*map(end.deviation, states)])))

    def _continuous_breaks(self, segments: list[Segment], params: Any, length: float) -> set[int]:
        """Return the positions of the breaks at which the rate does not jump.

        The exact derivative of the state with respect to such a time is 0, so that the time can be a constant. The
        derivative of the discrete steps would be an error of the size of the tolerance. Second derivatives need not be
        0; therefore this is used for first derivatives only.
        """
        continuous = set()
        for segment, following in pairwise(segments):
            if segment.stop < 0 or segment.event or segment.end is None:
                continue
            before = self.problem(segment.end, SidedParams(params, segment.side), segment.time)
            after = self.problem(segment.end, SidedParams(params, following.side), segment.time)
            rows = zip(leaves(before), leaves(after), leaves(segment.end), strict=True)
            if all(leaf is None or _is_continuous(one, other, leaf / length) for one, other, leaf in rows):
                continuous.add(segment.stop)
        return continuous

    def _traced_breaks(self, params: Any, segments: list[Segment], continuous: set[int]) -> Any:
        """Return the traced breaks; raise DerivativeError if two coincide, as the derivative depends on their order."""
        if not callable(self.breaks):
            return self.breaks
        times = self.break_times(params)
        times = [plain(time) if place in continuous else time for place, time in enumerate(times)]
        for place in [segment.stop for segment in segments if segment.stop >= 0]:
            for other, time in enumerate(times):
                # Between two adjacent floats there is no time at which the rate could be evaluated.
                coincide = abs(plain(time) - plain(times[place])) <= np.spacing(abs(plain(times[place])))
                if other != place and coincide and (isbox(time) or isbox(times[place])):
                    raise DerivativeError(
                        f"two breaks of {self.name} coincide at t = {float(plain(time)):.12g}, where the derivative "
                        "depends on their order; return each time once"
                    )
        return times

    def _replayed(self, segment: Segment, states: Sequence, params: Sequence, stops: Sequence) -> list[tuple]:
        """Return the states and times after a segment, for the solution and the perturbed solutions."""
        event = segment.event
        starts = []
        for (u, t), run_params, stop in zip(states, params, stops, strict=True):
            if event:
                length = segment.length
            else:
                length = stop - t
            starts.append((u, SidedParams(run_params, segment.side), t, length))
        if not segment.path and event:
            return [self._event_at_start(event, *start[:3]) for start in starts]
        if not segment.path:
            return [(_short_step(self.problem, *start), stop) for start, stop in zip(starts, stops, strict=True)]
        ends = self.scheme.replay(segment.path, starts, event)
        if not event:
            return [(new, stop) for (new, _), stop in zip(ends, stops, strict=True)]
        pairs = zip(ends, params, strict=True)
        return [(event.state_after(new, run_params, time), time) for (new, time), run_params in pairs]

    def _event_at_start(self, event: Event, u: Any, params: Any, t: Any) -> tuple:
        """Return the state and the time after an event at the start of a segment, up to rounding."""

        def value(point: tuple, length: Any) -> Any:
            u, params, t = point
            return event.value(_short_step(self.problem, u, params, t, length), without_side(params), t + length)

        point = u, params, t
        plain_point = untraced(point)

        def slope(length: Any) -> Any:
            return push(lambda more: 1.0 * value(plain_point, more), length, [1.0])[1]

        change, bend = (float(number) for number in push(slope, 0.0, [1.0]))
        self.scheme.check_steep(event, plain_point[0], plain_point[1], plain_point[2], change, bend)
        length: Any = 0.0
        for _ in traces_of(leaves(point)):  # as for an event at the end of a step
            residual = value(point, length)
            length = length - (residual - plain(residual)) / change
        time = t + length
        new = _short_step(self.problem, u, params, t, length)
        return event.state_after(new, without_side(params), time), time


def _is_continuous(before: Any, after: Any, slow: Any) -> bool:
    """Return True if the rates on both sides of a break are equal up to rounding.

    The difference is compared with the larger rate, and with `slow`, the state divided by the length of the interval.
    """
    size = max(np.max(np.abs(rate), initial=0.0) for rate in (before, after, slow))
    return np.max(np.abs(np.subtract(before, after)), initial=0.0) <= ROUNDING * size


def _short_step(problem: Problem, u: Any, params: Any, t: Any, length: Any) -> Any:
    """Take a step of zero length (up to rounding) by the midpoint rule, whose first two derivatives are exact."""
    half = 0.5 * length
    middle = combine(u, (half, problem(u, params, t)))
    return combine(u, (length, problem(middle, params, t + half)))


class _IntervalRun:
    """Computes the segments of one interval for plain values.

    Attributes
    ----------
    u, t : tree, float
        State and time at the end.
    segments : list of Segment
    taken : list of float
        See `Interrupted`.
    event_times : list of lists
        For each event its times.
    """

    def __init__(self, parent: Interrupted, arguments: tuple, is_traced: bool) -> None:
        self.parent = parent
        self.is_traced = is_traced
        self.u, self.params, self.t, self.h = arguments
        self.segments: list[Segment] = []
        self.taken: list[float] = []
        self.event_times: list[list] = [[] for _ in parent.events]
        self.detector: Any = None
        if parent.events:
            self.detector = EventDetector(parent.events, parent.problem, *arguments)
        end = self.t + self.h
        breaks, is_after_break = parent.breaks_within(self.params, self.t, end)
        for place, stop in breaks:
            if self._ends_before(place, stop, is_after_break, np.nextafter(stop, -np.inf)):
                return
            is_after_break = True
        self._ends_before(-1, end, is_after_break, np.inf)

    def _ends_before(self, place: int, stop: float, is_after_break: bool, latest: float) -> bool:
        """Integrate up to a stop; return whether a terminal event occurred before it."""
        events = self.parent.events
        if is_after_break:
            earliest = np.nextafter(self.t, np.inf)
        else:
            earliest = -np.inf
        count = 0
        repeats = 0
        while True:
            side = Side(earliest, latest, self.detector.surfaces() if self.detector else ())
            start = self.t
            event = self._cross_segment(place, side, stop)
            if event is None and place < 0 and self.detector:
                event = self.detector.event_at_end(self.u, stop)
                if event is not None:
                    self.t = self.t + (stop - self.t)
                    self.segments.append(Segment([], side, -1, event, 0.0))
            if event is None:
                self.t = stop
                self.segments[-1] = self.segments[-1]._replace(end=self.u, time=stop)
                return False
            count += 1
            is_repeated = self.t - start <= ROUNDING * max(abs(self.t), self.h)
            if is_repeated:
                repeats = repeats + 1
            else:
                repeats = 0
            if count > MOST_EVENTS or repeats > REPEATS * len(events):
                raise ConvergenceError(
                    f"{event.name} of {self.parent.name} occurs again and again at t = {self.t:.12g}; let it be "
                    "terminal, or return from its jump a state that leaves the surface"
                )
            if self._apply_events(event, side):
                return True

    def _cross_segment(self, place: int, side: Side, stop: float) -> Event | None:
        """Integrate up to a stop or to the first event before it; return the event or None."""
        length = stop - self.t
        start = self.u, SidedParams(self.params, side), self.t, length
        is_empty = not any(np.size(leaf) for leaf in leaves(self.u))
        if is_empty or length <= ROUNDING * max(abs(self.t), abs(self.t + length), self.h):
            self.u = _short_step(self.parent.problem, *start)
            self.segments.append(Segment([], side, place, None, length))
            return None
        scheme, flat_start = self.parent.scheme.interval(*start)
        path, event, taken = scheme.steps_over(flat_start, self.is_traced, self.detector)
        last = path[-1]
        self.u = scheme.rounded(last.new)
        self.taken += [part * length / self.h for part in taken]
        self.segments.append(Segment(path, side, place, event, length))
        if event is not None:
            self.t = self.t + (last.done + last.length) * length
        return event

    def _apply_events(self, event: Event, side: Side) -> bool:
        """Record an event and others at the same time, apply their jumps in order; return whether one is terminal."""
        self.event_times[self.parent.events.index(event)].append(self.t)
        before = self.u
        self.u = event.state_after(before, self.params, self.t)
        hidden = self.detector.update_signs(event, before, self.u, self.t)
        if event.terminal:
            hidden = [other for other, _ in self.detector.simultaneous]
        is_terminal = event.terminal
        for other in hidden:
            self._check_order(event, other, before)
            self.event_times[self.parent.events.index(other)].append(self.t)
            self.segments.append(Segment([], side, -1, other, 0.0))
            self.u = other.state_after(self.u, self.params, self.t)
            self.detector.update_simultaneous(other, self.u, self.t)
            is_terminal = is_terminal or other.terminal
        return is_terminal

    def _check_order(self, first: Event, second: Event, u: Any) -> None:
        """Raise an error if the state after two simultaneous events, or its derivative, depends on their order."""
        params = self.params
        t = self.t
        forward = second.state_after(first.state_after(u, params, t), params, t)
        reverse = first.state_after(second.state_after(u, params, t), params, t)
        sizes = Adaptive.sizes(self.parent.scheme, u, forward)
        names = f"{first.name} and {second.name} of {self.parent.name}"
        for a, b, size in zip(leaves(forward), leaves(reverse), sizes, strict=True):
            if a is not None and np.any(np.abs(a - b) > SAME_STATE * size):
                raise ValueError(
                    f"{names} occur at the same time t = {t:.12g}, and the state after their jumps depends on their "
                    "order; write one event for both"
                )
        if self.is_traced and not self._have_the_same_derivative(first, second, u):
            raise DerivativeError(
                f"{names} occur at the same time t = {t:.12g}, and the derivative of the state depends on their "
                "order; write one event for both"
            )

    def _have_the_same_derivative(self, first: Event, second: Event, u: Any) -> bool:
        """Return True if the times of two events have equal derivatives with respect to state, params and time."""
        rates = self.parent.problem(u, self.params, self.t)
        point = (u, self.params, float(self.t))
        rows = []
        for event in (first, second):
            of_state, of_params, of_time = pullback(_value_of(event), point)[1](np.float64(1.0))
            change = inner_product(of_state, rates) + of_time
            entries = [*leaves(of_state), *leaves(of_params), of_time]
            row = np.concatenate([np.ravel(leaf) for leaf in entries if leaf is not None])
            rows.append(row / (change or 1.0))
        one, other = rows
        return one.shape == other.shape and np.allclose(one, other, rtol=SAME_DERIVATIVE, atol=0.0)


def _value_of(event: Event) -> Callable:
    """Return the value of an event as a function of one point (u, params, t)."""

    def value(point: tuple) -> Any:
        return 1.0 * event.value(*point)

    return value
