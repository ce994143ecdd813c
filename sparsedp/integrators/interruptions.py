"""Steps with error control that stop at given times (breaks) and at zero crossings (events).

The interval of a step is cut into pieces. A piece ends at the next break, at the next event, or at the end of the
interval. Inside a piece the rate is smooth, and at both ends it is evaluated on the side of the piece: see
`Side` in problem.py.

The derivative with respect to a break b follows from the lengths of both pieces, which are traced: with the rate f_- at
the end of the first piece and f_+ at the start of the second,

    du/db = f_- - f_+,

and its propagation to the end. Nothing else is needed for derivatives of any order.

An event is a function g(u, params, t). After each accepted step its sign is compared with that at the start of the
piece. Where it changed, the length l of this step is found by Brent's method with the scheme itself: with the step map
S, g(S(u, l), params, t + l) = 0. So the time of an event, like the state there, is that of the discrete solution, and
its derivative is that of the implicit function theorem for this equation,

    dl = -(g_u dS + g_p dp + g_t dt) / (g_u S_l + g_t).

On the tape it is one iteration l <- l - g / (g_u S_l + g_t) with a constant denominator for each order of
differentiation: each one makes the next order exact.

An event within rounding of the end of an interval belongs to this interval: the next one would take its zero for one
that it starts from.

References: Brent, Algorithms for Minimization without Derivatives (1973), ch. 4; Hairer, Norsett, Wanner, Solving
Ordinary Differential Equations I (1993), II.6.
"""

from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np
from scipy.optimize import brentq, minimize_scalar

from sparsedp._utils.pytree import flatten, leaves
from sparsedp._utils.validation import EPS, check_function, check_number, check_takes
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import dtype_of, is_variable, isbox, linear, plain, traces_of
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError
from sparsedp.integrators.adaptive import Adaptive, Moving, inner, relative
from sparsedp.integrators.problem import Side, Sided, combine, of_fields, takes, unsided, untraced
from sparsedp.integrators.runge_kutta import Scheme

__all__ = ["Crossing", "Event", "Interrupted", "break_times", "event_list"]

MOST_EVENTS = 10_000  # in one interval
REPEATS = 8  # of one event within rounding of the time: it never ends
SHIFTS = 12  # attempts to move a state to the right side of a surface
DIP = 0.3  # share of the values of an event in a step to which a minimum between them is followed
SAME = 1e-9  # difference of two states, relative to their size, that is taken for rounding
HALVINGS = 60  # of a step, to find a point before the crossing


# ---- what the user gives ---------------------------------------------------------------------------------------------


class Event:
    """A function whose zero stops a step.

    Parameters
    ----------
    function : callable
        ``function(u, params)`` or ``function(u, params, t)``: a real number.
    jump : callable or None
        The same arguments: the state with which the step goes on.
    number : int
        Its place in the list, for messages.

    Attributes
    ----------
    terminal : bool
        Whether the step ends there.
    direction : float
        As of SciPy's `solve_ivp`: > 0 only from negative to positive, < 0 only from positive to negative, 0 both.
    """

    def __init__(self, function, jump, number):
        self.name = f"events[{number}]"
        self.function = check_event_function(self.name, function)
        self.jump = None if jump is None else check_event_function(f"the jump of {self.name}", jump)
        self.terminal = _terminal(self.name, getattr(function, "terminal", False))
        direction = getattr(function, "direction", 0)
        self.direction = check_number(f"the direction of {self.name}", direction)
        self.driven = takes(function, 3)
        self.jump_driven = jump is not None and takes(jump, 3)

    def value(self, u, params, t):
        """The number whose zero is looked for, traced or not."""
        result = self.function(u, params, t) if self.driven else self.function(u, params)
        if np.size(plain(result)) != 1 or dtype_of(result).kind not in "fiu":
            raise ShapeError(
                f"{self.name} must return one real number, got {dtype_of(result)} of shape {np.shape(plain(result))}"
            )
        return result if np.ndim(plain(result)) == 0 else result.reshape(())

    def number(self, u, params, t):
        """The same as a plain number."""
        value = float(plain(self.value(u, params, t)))
        if not np.isfinite(value):
            raise NonFiniteError(f"{self.name} must be finite, got {value} at t = {t:.6g}")
        return value

    def gradient(self, u, params, t):
        """The derivatives in the state and in the time, on plain arguments."""
        if isbox(self.value(u, params, t)):
            raise DerivativeError(f"{self.name} uses a traced value that is not an argument; put it into params")
        back = pullback(lambda point: 1.0 * self.value(point[0], params, point[1]), (u, float(t)))[1]
        return back(np.float64(1.0))

    def located(self, sign):
        """Whether a crossing is located that begins where the event has this sign."""
        return sign != 0 and sign * self.direction <= 0

    def after(self, u, params, t):
        """The state with which the step goes on."""
        if self.jump is None:
            return u
        new = self.jump(u, params, t) if self.jump_driven else self.jump(u, params)
        entries = of_fields(new, u, f"the jump of {self.name}")
        return flatten(u)[1](entries)


def check_event_function(name, function):
    """A function of (u, params) or (u, params, t)."""
    example = "lambda u, params, t: ..."
    check_function(f"stepper, as {name},", function, example)
    check_takes("stepper", function, 3 if takes(function, 3) else 2, example)
    return function


def _terminal(name, value):
    if np.ndim(value) or value not in (False, True):
        raise ValueError(f"the attribute terminal of {name} must be True or False, got {value!r}")
    return bool(value)


def event_list(events):
    """The list of Event that `stepper` was given: a function, a pair (function, jump), or a list of these."""
    if callable(events) or (isinstance(events, tuple) and len(events) == 2 and _is_pair(events)):
        events = [events]
    if not isinstance(events, (list, tuple)):
        raise TypeError(
            f"events takes functions, or pairs (function, jump), got {type(events).__name__}; "
            "write events=[lambda u, params, t: ...]"
        )
    found = []
    for number, entry in enumerate(events):
        function, jump = entry if isinstance(entry, (tuple, list)) and len(entry) == 2 else (entry, None)
        found.append(Event(function, jump, number))
    return found


def _is_pair(events):
    """Return whether two entries are an event function and its jump, which may be None."""
    function, jump = events
    return callable(function) and (jump is None or callable(jump))


def break_times(breaks):
    """The breaks that `stepper` was given: a function of params, or a sorted array of times."""
    if callable(breaks):
        check_takes("stepper", breaks, 1, "breaks=lambda params: [params['off']]")
        return breaks
    return np.unique([float(time) for time in _entries(breaks)])


def _entries(breaks):
    """The times in a sequence, traced or not."""
    found: list = []
    for leaf in leaves(breaks):
        known = np.asarray(plain(leaf))
        if known.dtype.kind not in "fiu":
            raise TypeError(
                f"breaks takes times, or a function of params that returns times, got {type(plain(leaf)).__name__}; "
                "write breaks=[0.5, 1.0]"
            )
        if known.ndim > 1:
            raise ShapeError(f"breaks must be a sequence of times, got an array of shape {known.shape}")
        found += [leaf[place] for place in range(known.size)] if known.ndim else [leaf]
    for place, time in enumerate(found):
        if not np.isfinite(plain(time)):
            raise NonFiniteError(f"breaks must be finite, got {float(plain(time))} at place {place}")
    return found


# ---- surfaces --------------------------------------------------------------------------------------------------------


class Surface:
    """The zeros of an event, and the side of them on which a rate is evaluated.

    Parameters
    ----------
    event : Event
    sign : float
        Of the event on this side.
    """

    __slots__ = ("event", "sign")

    def __init__(self, event, sign):
        self.event, self.sign = event, sign

    def inside(self, u, params, t):
        """(u, t), or the nearest point on the side of the surface, with the derivative of (u, t)."""
        event, known = self.event, untraced((u, params, t))
        value = event.number(*known)
        if value * self.sign > 0:
            return u, t
        state, params, time = known
        weights = [_weight(leaf) for leaf in leaves(state)]
        of_state, of_time = event.gradient(*known)
        rows = [0.0 if row is None else row for row in leaves(of_state)]
        lengths = [np.sum(np.abs(weight * row) ** 2) for weight, row in zip(weights, rows, strict=True)]
        square, by_time = float(sum(lengths)), 0.0
        if square == 0.0:
            if of_time == 0.0:
                return u, t
            by_time = 1.0 / of_time
        directions = [
            np.conj(row) * weight**2 / square if square else 0.0 * weight
            for row, weight in zip(rows, weights, strict=True)
        ]
        margin = 4 * EPS * (np.sqrt(square) + abs(of_time * time))
        shift, rebuild = 0.0, flatten(state)[1]
        for _ in range(SHIFTS):
            shift += self.sign * margin - value
            moved = [leaf if leaf is None else leaf + shift * d for leaf, d in zip(leaves(state), directions)]
            value = event.number(rebuild(moved), params, time + shift * by_time)
            if value * self.sign > 0:
                break
            margin *= 4
        pairs = zip(leaves(u), directions, strict=True)
        return rebuild([leaf if leaf is None else leaf + shift * d for leaf, d in pairs]), t + shift * by_time


def _weight(leaf):
    """The size of each entry of an array of the state, as of the default floor of errors; 0 of what does not move."""
    if not is_variable(leaf):
        return np.zeros(np.shape(leaf) if leaf is not None else ())
    size = np.abs(leaf)
    largest = np.max(size, initial=0.0)
    return size + (0.1 * largest or 1.0)


class Crossing(NamedTuple):
    """An event in a step: the step up to there, the event, and its sign before."""

    step: Any
    event: Event
    sign: float


class Watch:
    """The signs of all events while a piece is crossed.

    Parameters
    ----------
    events : list of Event
    problem : Problem
    u, params, t, h
        Where an interval begins, and its length; plain.
    """

    def __init__(self, events, problem, u, params, t, h):
        self.events, self.problem, self.params, self.h = events, problem, params, h
        self.eps = max([EPS, *(float(np.finfo(dtype_of(leaf)).eps) for leaf in leaves(u) if is_variable(leaf))])
        self.signs = [self._sign(event, u, t) for event in events]
        self.last = 0.0  # sign of the last event that was found, before it
        self.simultaneous: list = []  # other events at the time of the last one, and their signs before it

    def surfaces(self):
        """The surfaces that the rate must not see beyond."""
        pairs = zip(self.events, self.signs, strict=True)
        return tuple(Surface(event, sign) for event, sign in pairs if event.located(sign))

    def _sign(self, event, u, t, rounding=0.0):
        """The sign right after (u, t): on the surface itself, that of the rate of change."""
        value = event.number(u, self.params, t)
        of_state, of_time = event.gradient(u, self.params, t)
        rates = leaves(self.problem(u, self.params, t))
        change, scale = of_time, abs(of_time) * (abs(t) + self.h)
        for row, leaf, rate in zip(leaves(of_state), leaves(u), rates, strict=True):
            if row is not None:
                change = change + float(np.sum(np.real(row * rate)))
                scale = scale + float(np.sum(np.abs(row) * (np.abs(leaf) + self.h * np.abs(rate))))
        if abs(value) > rounding + 64 * self.eps * scale:
            return float(np.sign(value))
        return float(np.sign(change))

    def passed(self, event, before, after, t):
        """Note the new signs after the last event that was found: the states before and after its jump.

        Returns
        -------
        list of Event
                Those at the same time that the next step would not find: beyond the jump they do not change their sign.
        """
        residual = abs(event.number(before, self.params, t))
        for place, other in enumerate(self.events):
            if other is event and event.jump is None:
                self.signs[place] = -self.last
            elif other is event:
                self.signs[place] = self._sign(other, after, t, 4 * residual)
            elif event.jump is not None:
                values = [other.number(u, self.params, t) for u in (before, after)]
                if values[0] != values[1] and np.sign(values[1]) != self.signs[place]:
                    self.signs[place] = self._sign(other, after, t)
        return [other for other, sign in self.simultaneous if self._sign(other, after, t) != -sign]

    def passed_at_once(self, event, after, t):
        """Note the new sign of an event at the same time as the last one."""
        self.signs[self.events.index(event)] = self._sign(event, after, t)

    def pending(self, u, t):
        """An event at the end of an interval that the next interval would take for one before its start, or None."""
        pending = []
        for event, sign in zip(self.events, self.signs):
            if event.located(sign) and self._sign(event, u, t) == -sign:
                pending.append((event, sign))
        if not pending:
            return None
        event, self.last = pending[0]
        self.simultaneous = pending[1:]
        return event

    def crossing(self, scheme, step, known):
        """The first event in a step, or None; `known`: what the scheme was given, plain."""
        t, h = known[2:]
        start = t + step.done * h
        middle, share = scheme.inner_state(step)
        crossings, changed = [], []
        for place, event in enumerate(self.events):
            values = [
                event.number(scheme.tree(step.u), self.params, start),
                event.number(scheme.tree(middle), self.params, start + share * step.length * h),
                event.number(scheme.tree(step.new), self.params, start + step.length * h),
            ]
            sign = self.signs[place]
            if sign == 0:
                changed.append(place)
                continue
            inside = sign * np.array(values)
            if inside[1] < 0:
                length = share * step.length
            elif inside[2] <= 0:
                length = step.length
            else:
                length = self._dip(scheme, step, known, event, sign, share, inside)
            if length is None:
                continue
            lower = 0.0
            if not event.located(sign):  # only a crossing back, later in this step, counts
                changed.append(place)
                if length == step.length or inside[2] < 0:
                    continue
                sign, lower, length = -sign, length, step.length
            found = self._located(scheme, step, known, event, sign, lower, length)
            if found is not None:
                crossings.append(found)
        first = min(crossings, key=lambda crossing: crossing.step.length, default=None)
        last = step if first is None else first.step
        for place in changed:  # the signs where the next step begins
            value = self.events[place].number(scheme.tree(last.new), self.params, start + last.length * h)
            self.signs[place] = float(np.sign(value)) or self.signs[place]
        if first is not None:
            self.last = first.sign
            # Times that differ by rounding; where the first of them jumps, the others might not be found again.
            latest = first.step.length + 64 * EPS * max(abs(start), h) / h
            self.simultaneous = [
                (crossing.event, crossing.sign)
                for crossing in crossings
                if crossing is not first and crossing.step.length <= latest
            ]
        return first

    def _value(self, scheme, step, known, event, length):
        """The event after a part of a step."""
        t, h = known[2:]
        start = t + step.done * h
        part = scheme.partial(step, known, length)
        if part is None:
            raise ConvergenceError(f"{scheme.name}: no step leads to {event.name} near t = {start:.6g}")
        return event.number(scheme.tree(part.new), self.params, start + length * h)

    def _dip(self, scheme, step, known, event, sign, share, values):
        """A length after which the event has the other sign, where it crosses zero twice in a step; else None.

        The parabola through the values at the start, inside and at the end tells whether to look closer.
        """
        quadratic, linear_part, constant_part = np.polyfit([0.0, share, 1.0], values, 2)
        if quadratic <= 0 or not 0 < -linear_part < 2 * quadratic:
            return None
        if constant_part - linear_part**2 / (4 * quadratic) > DIP * min(values[1:]):
            return None

        def distance(part):
            return sign * self._value(scheme, step, known, event, part * step.length)

        lowest = minimize_scalar(distance, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-6})
        return lowest.x * step.length if lowest.fun < 0 else None

    def _located(self, scheme, step, known, event, sign, lower, upper):
        """The step up to the event between two lengths of it; None where it is not there."""
        t, h = known[2:]
        start = t + step.done * h
        value = partial(self._value, scheme, step, known, event)
        if value(upper) * sign > 0:  # the state in the middle of a step is less accurate than that at its end
            upper = step.length
            if value(upper) * sign > 0:
                return None
        shortest = 4 * EPS * max(abs(start), abs(h)) / h
        lower = lower or 0.5 * upper
        for _ in range(HALVINGS):
            if lower <= shortest or value(lower) * sign > 0:
                break
            upper, lower = lower, 0.5 * lower
        if lower <= shortest:
            root = shortest
        else:
            root = brentq(value, lower, upper, xtol=EPS * shortest, rtol=4 * EPS)
        return Crossing(scheme.partial(step, known, root), event, sign)


# ---- the scheme ------------------------------------------------------------------------------------------------------


class Interrupted(Scheme):
    """A scheme with error control that stops at breaks and events.

    Parameters
    ----------
    scheme : Adaptive
    breaks : callable or array
        As `break_times` returns it.
    events : list of Event

    Attributes
    ----------
    taken : list of float
        Lengths of the accepted steps in the last interval, as shares of it.
    t_events : list of arrays
        For each event its times in the last interval.
    """

    def __init__(self, scheme, breaks, events):
        super().__init__(scheme.problem, scheme.name, scheme.order)
        self.scheme, self.info = scheme, scheme.info
        self.breaks, self.events = breaks, events
        self.taken: list = []
        self.t_events: list = [np.zeros(0) for _ in events]

    def __call__(self, u, params, t, h):
        """(u, params, t, h) -> the state and the time after the interval h, or at a terminal event."""
        self.scheme.check_tolerance(u)
        given = u, params, t, h
        traced = any(map(isbox, leaves(given)))
        run = _Run(self, untraced(given), traced)
        self.taken = run.taken
        self.t_events = [np.array(times) for times in run.times]
        return self._followed(run.pieces, given, run.u, run.t) if traced else (run.u, run.t)

    def stops(self, params, t, end):
        """The places and times of the breaks in (t, end], in order, and whether one is at t; plain."""
        times = np.array(self.times(params), float) if callable(self.breaks) else self.breaks
        order = np.argsort(times, kind="stable")
        first, last = np.searchsorted(times[order], [t, end], "right")
        found: list = []
        for place in order[first:last]:
            if not found or times[place] != times[found[-1]]:
                found.append(place)
        return [(place, float(times[place])) for place in found], bool(np.any(times == t))

    def times(self, params):
        """The breaks, traced or not."""
        return _entries(self.breaks(params)) if callable(self.breaks) else self.breaks

    def _followed(self, pieces, given, new, time):
        """The state and the time at the end of all pieces, with a derivative that is judged."""
        scheme, known = self.scheme, untraced(given)
        sizes = [*Adaptive.sizes(scheme, known[0]), *map(relative, leaves(known[1:]))]
        start = Moving(given, isbox, sizes)
        end = Moving((new, time), is_variable, [*Adaptive.sizes(scheme, known[0], new), known[3]])
        count = sum(len(piece.path) for piece in pieces)
        spread, judge = linear(f"{self.name}.variation", *scheme.doors(count))
        entered = spread(start.off(given))
        runs = [start.at(entered[number]) for number in range(len(entered))]
        is_first_order = len(traces_of(leaves(given))) == 1
        smooth = self._smooth_breaks(pieces, known[1], known[3]) if is_first_order and callable(self.breaks) else set()
        stops = [(*self._traced_times(params, pieces, smooth), t + h) for _, params, t, h in runs]
        states = [(u, t) for u, _, t, _ in runs]
        for piece in pieces:
            states = self._again(piece, states, [run[1] for run in runs], [times[piece.stop] for times in stops])
        return end.at(judge(anp.array([*map(end.off, states)])))

    def _smooth_breaks(self, pieces, params, length):
        """The places of the breaks at which the rate does not jump: the state has the derivative 0 in these times.

        That of the discrete steps is an error, as large as the tolerance. Second derivatives need not be 0 there.
        """
        smooth = set()
        for piece, following in pairwise(pieces):
            if piece.stop < 0 or piece.event or piece.end is None:
                continue
            sides = [self.problem(piece.end, Sided(params, side), piece.time) for side in (piece.side, following.side)]
            rows = zip(*map(leaves, sides), leaves(piece.end), strict=True)
            if all(leaf is None or _is_continuous(before, after, leaf / length) for before, after, leaf in rows):
                smooth.add(piece.stop)
        return smooth

    def _traced_times(self, params, pieces, smooth):
        if not callable(self.breaks):
            return self.breaks
        times = self.times(params)
        times = [plain(time) if place in smooth else time for place, time in enumerate(times)]
        reached = [piece.stop for piece in pieces if piece.stop >= 0]
        for place in reached:
            for other, time in enumerate(times):
                # The rate cannot be evaluated between adjacent numbers.
                coincide = abs(plain(time) - plain(times[place])) <= np.spacing(abs(plain(times[place])))
                if other != place and coincide and (isbox(time) or isbox(times[place])):
                    raise DerivativeError(
                        f"two breaks of {self.name} coincide at t = {float(plain(time)):.12g}, where the derivative "
                        "depends on their order; return each time once"
                    )
        return times

    def _again(self, piece, states, params, stops):
        """The states and times after a piece, of all runs."""
        given = [
            (u, Sided(one, piece.side), t, piece.length if piece.event else stop - t)
            for (u, t), one, stop in zip(states, params, stops, strict=True)
        ]
        if not piece.path and piece.event:
            return [self._event_here(piece.event, *start) for start in given]
        if not piece.path:
            return [(_short(self.problem, *start), stop) for start, stop in zip(given, stops, strict=True)]
        ends = self.scheme.rerun(piece.path, given, piece.event)
        if not piece.event:
            return [(new, stop) for (new, _), stop in zip(ends, stops, strict=True)]
        return [(piece.event.after(new, one, time), time) for (new, time), one in zip(ends, params, strict=True)]

    def _event_here(self, event, u, params, t, _):
        """The state and the time after an event that occurs where a piece begins, to rounding."""

        def value(point, length):
            u, params, t = point
            return event.value(_short(self.problem, u, params, t, length), unsided(params), t + length)

        point = u, params, t
        known = untraced(point)

        def slope(length):
            return push(lambda more: 1.0 * value(known, more), length, [1.0])[1]

        change, bend = (float(number) for number in push(slope, 0.0, [1.0]))
        self.scheme.check_steep(event, known[0], known[1], known[2], change, bend)
        length = 0.0
        for _ in traces_of(leaves(point)):  # as for an event at the end of a step
            found = value(point, length)
            length = length - (found - plain(found)) / change
        time = t + length
        return event.after(_short(self.problem, u, params, t, length), unsided(params), time), time


def _short(problem, u, params, t, length):
    """A step of rounding length, by the midpoint rule: its derivatives of two orders are exact."""
    half = 0.5 * length
    middle = combine(u, (half, problem(u, params, t)))
    return combine(u, (length, problem(middle, params, t + half)))


class Piece(NamedTuple):
    """A part of an interval.

    path: the steps, none where it is of rounding length. side: where the rate is evaluated. stop: the place of the
    break at its end, -1 for the end of the interval. event: what ended it before that, or None. length: of the piece
    up to its stop. end, time: the state and the time at a break.
    """

    path: list
    side: Side
    stop: int
    event: Event | None
    length: float
    end: Any = None
    time: float = 0.0


def _is_continuous(before, after, slow):
    """Whether a rate on both sides of a break differs by rounding, of its size or of that which moves the state."""
    size = max(np.max(np.abs(rate), initial=0.0) for rate in (before, after, slow))
    return np.max(np.abs(np.subtract(before, after)), initial=0.0) <= 64 * EPS * size


class _Run:
    """The pieces of one interval, on plain values.

    Attributes
    ----------
    u, t : tree, float
        At the end.
    pieces : list of Piece
    taken, times : list
        As of `Interrupted`.
    """

    def __init__(self, parent, given, traced):
        self.parent, self.traced = parent, traced
        self.u, self.params, self.t, self.h = given
        self.end = self.t + self.h
        self.pieces: list = []
        self.taken: list = []
        self.times: list = [[] for _ in parent.events]
        self.watch: Any = Watch(parent.events, parent.problem, *given) if parent.events else None
        stops, after_break = parent.stops(self.params, self.t, self.end)
        for place, stop in stops:
            if self._reached(place, stop, after_break, np.nextafter(stop, -np.inf)):
                return
            after_break = True
        self._reached(-1, self.end, after_break, np.inf)

    def _reached(self, place, stop, after_break, latest):
        """Go on to a stop; whether a terminal event came first."""
        earliest = np.nextafter(self.t, np.inf) if after_break else -np.inf
        count = repeats = 0
        while True:
            length = stop - self.t
            side = Side(earliest, latest, self.watch.surfaces() if self.watch else ())
            event = self._piece(place, side, length)
            if event is None and place < 0:
                event = self._at_the_end(side, stop)
            if event is None:
                self.t = stop
                self.pieces[-1] = self.pieces[-1]._replace(end=self.u, time=stop)
                return False
            count += 1
            before, self.t = self.t, self.t + self.crossed
            repeats = repeats + 1 if self.t - before <= 64 * EPS * max(abs(self.t), self.h) else 0
            if count > MOST_EVENTS or repeats > REPEATS * len(self.parent.events):
                raise ConvergenceError(
                    f"{event.name} of {self.parent.name} occurs again and again at t = {self.t:.12g}; let it be "
                    "terminal, or return from its jump a state that leaves the surface"
                )
            if self._passed(event, side):
                return True

    def _passed(self, event, side):
        """Record an event and others at the same time, with their jumps in order; whether one of them is terminal."""
        self.times[self.parent.events.index(event)].append(self.t)
        before, self.u = self.u, event.after(self.u, self.params, self.t)
        hidden = self.watch.passed(event, before, self.u, self.t)
        if event.terminal:
            hidden = [other for other, _ in self.watch.simultaneous]
        is_terminal = event.terminal
        for other in hidden:
            self._check_order(event, other, before)
            self.times[self.parent.events.index(other)].append(self.t)
            self.pieces.append(Piece([], side, -1, other, 0.0))
            self.u = other.after(self.u, self.params, self.t)
            self.watch.passed_at_once(other, self.u, self.t)
            is_terminal = is_terminal or other.terminal
        return is_terminal

    def _check_order(self, first, second, u):
        """Refuse two events at one time where the state after them, or its derivative, depends on their order."""
        params, t = self.params, self.t
        one = second.after(first.after(u, params, t), params, t)
        other = first.after(second.after(u, params, t), params, t)
        sizes = Adaptive.sizes(self.parent.scheme, u, one)
        words = f"{first.name} and {second.name} of {self.parent.name} occur at the same time t = {t:.12g}, and the "
        for a, b, size in zip(leaves(one), leaves(other), sizes, strict=True):
            if a is not None and np.any(np.abs(a - b) > SAME * size):
                raise ValueError(f"{words}state after their jumps depends on their order; write one event for both")
        if self.traced and not self._moves_alike(first, second, u):
            raise DerivativeError(f"{words}derivative of the state depends on their order; write one event for both")

    def _moves_alike(self, first, second, u):
        """Whether the times of two events have the same derivative in the state, the params and the time."""
        rates = self.parent.problem(u, self.params, self.t)
        rows = []
        for event in (first, second):
            point = (u, self.params, float(self.t))
            back = pullback(lambda point, event=event: 1.0 * event.value(*point), point)[1]
            of_state, of_params, of_time = back(np.float64(1.0))
            change = inner(of_state, rates) + of_time
            row = [np.ravel(leaf) for leaf in (*leaves(of_state), *leaves(of_params), of_time) if leaf is not None]
            rows.append(np.concatenate(row) / (change or 1.0))
        one, other = rows
        return one.shape == other.shape and np.allclose(one, other, rtol=1e-6, atol=0.0)

    def _at_the_end(self, side, stop):
        """An event within rounding of the end of the interval, or None."""
        event = self.watch.pending(self.u, stop) if self.watch else None
        if event is not None:
            self.crossed = stop - self.t
            self.pieces.append(Piece([], side, -1, event, 0.0))
        return event

    def _piece(self, place, side, length):
        """Cross a piece; the event that ended it, or None."""
        given = self.u, Sided(self.params, side), self.t, length
        empty = not any(np.size(leaf) for leaf in leaves(self.u))
        if empty or length <= 64 * EPS * max(abs(self.t), abs(self.t + length), self.h):
            self.u = _short(self.parent.problem, *given)
            self.pieces.append(Piece([], side, place, None, length))
            return None
        scheme, flat = self.parent.scheme.interval(*given)
        path, event, taken = scheme.path(flat, self.traced, self.watch)
        self.u = scheme.rounded(path[-1].new)
        self.crossed = (path[-1].done + path[-1].length) * length
        self.taken += [part * length / self.h for part in taken]
        self.pieces.append(Piece(path, side, place, event, length))
        return event
