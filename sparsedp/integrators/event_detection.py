"""Locate the first event in a step by Brent's method.

After each accepted step the sign of every event function g is compared with its sign at the start of the segment. If it
has changed, the step is repeated with a length l for which g(S(u, l), params, t + l) = 0, where S(u, l) is the state
after a step of the scheme of length l. Brent's method computes l. So the time and the state of an event belong to the
discrete solution, not to an interpolant.

References
----------
R. P. Brent, Algorithms for Minimization without Derivatives (1973), ch. 4; E. Hairer, S. P. Norsett, G. Wanner, Solving
Ordinary Differential Equations I (1993), II.6.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.tape import dtype_of, is_variable
from sparsedp.errors import ConvergenceError
from sparsedp.integrators.events import Event, Surface

if TYPE_CHECKING:
    from sparsedp.integrators.adaptive import AcceptedStep, Adaptive
    from sparsedp.integrators.problem import Problem

__all__ = ["Crossing", "EventDetector"]

DIP = 0.3  # search for two zeros in a step if a parabola predicts a minimum below this fraction of the values
HALVINGS = 60  # number of halvings of a step to find a point before the zero
SAME_TIME = 64 * EPS  # two times with a smaller relative difference are regarded as equal


class Crossing(NamedTuple):
    """An event in a step: the step that ends at the event, the event, and the sign of its function before it."""

    step: AcceptedStep
    event: Event
    sign: float


class EventDetector:
    """Locates events in successive steps, and stores the sign of each event function between events.

    Parameters
    ----------
    events : list of Event
    problem : Problem
    u, params, t, h
        State, params and time at the start of an interval, and its length; plain values.

    Attributes
    ----------
    signs : list of float
        Sign of each event function in the current segment.
    last_sign : float
        Sign of the function of the last located event before this event.
    simultaneous : list of (Event, float)
        Other events at the time of the last event, with the signs of their functions before it.
    """

    def __init__(self, events: list[Event], problem: Problem, u: Any, params: Any, t: float, h: float) -> None:
        self.events = events
        self.problem = problem
        self.params = params
        self.h = h
        self.eps = float(EPS)
        for leaf in leaves(u):
            if is_variable(leaf):
                self.eps = max(self.eps, float(np.finfo(dtype_of(leaf)).eps))
        self.signs = [self._sign_after(event, u, t) for event in events]
        self.last_sign = 0.0
        self.simultaneous: list[tuple[Event, float]] = []

    def surfaces(self) -> tuple[Surface, ...]:
        """Return the surfaces of events, with the side on which the rate may be evaluated."""
        pairs = zip(self.events, self.signs, strict=True)
        return tuple(Surface(event, sign) for event, sign in pairs if event.is_located(sign))

    def _sign_after(self, event: Event, u: Any, t: float, rounding: float = 0.0) -> float:
        """Return the sign of an event function just after (u, t); if it is 0 there, the sign of its time derivative."""
        value = event.plain_value(u, self.params, t)
        of_state, of_time = event.gradient(u, self.params, t)
        rates = leaves(self.problem(u, self.params, t))
        change = of_time
        scale = abs(of_time) * (abs(t) + self.h)
        for row, leaf, rate in zip(leaves(of_state), leaves(u), rates, strict=True):
            if row is not None:
                change = change + float(np.sum(np.real(row * rate)))
                scale = scale + float(np.sum(np.abs(row) * (np.abs(leaf) + self.h * np.abs(rate))))
        if abs(value) > rounding + 64 * self.eps * scale:
            return float(np.sign(value))
        return float(np.sign(change))

    def update_signs(self, event: Event, before: Any, after: Any, t: float) -> list[Event]:
        """Update the signs after the last event that was located.

        Parameters
        ----------
        event : Event
        before, after : tree
            The states before and after the jump of the event.
        t : float

        Returns
        -------
        list of Event
            Events at the same time that the next step would not find, because their functions have the new sign from
            the start of this step.
        """
        residual = abs(event.plain_value(before, self.params, t))
        for place, other in enumerate(self.events):
            if other is event and event.jump is None:
                self.signs[place] = -self.last_sign
            elif other is event:
                self.signs[place] = self._sign_after(other, after, t, 4 * residual)
            elif event.jump is not None:
                value = other.plain_value(before, self.params, t)
                new_value = other.plain_value(after, self.params, t)
                if value != new_value and np.sign(new_value) != self.signs[place]:
                    self.signs[place] = self._sign_after(other, after, t)
        return [other for other, sign in self.simultaneous if self._sign_after(other, after, t) != -sign]

    def update_simultaneous(self, event: Event, after: Any, t: float) -> None:
        """Update the sign of an event at the same time as the last one."""
        self.signs[self.events.index(event)] = self._sign_after(event, after, t)

    def event_at_end(self, u: Any, t: float) -> Event | None:
        """Return an event at the end of an interval, or None.

        The next interval would not find such an event, since it determines the signs after its start.
        """
        crossed = []
        for event, sign in zip(self.events, self.signs):
            if event.is_located(sign) and self._sign_after(event, u, t) == -sign:
                crossed.append((event, sign))
        if not crossed:
            return None
        event, self.last_sign = crossed[0]
        self.simultaneous = crossed[1:]
        return event

    def first_crossing(self, scheme: Adaptive, step: AcceptedStep, start: tuple) -> Crossing | None:
        """Return the first event in a step, or None.

        Parameters
        ----------
        scheme : Adaptive
        step : AcceptedStep
        start : tuple
            Plain arguments (u, params, t, h) of the scheme for the current segment.
        """
        t, h = start[2:]
        t = t + step.done * h
        crossings = []
        unlocated = []  # positions of events whose sign changes without a zero that is located
        for place, event in enumerate(self.events):
            if self.signs[place] == 0:
                unlocated.append(place)
                continue
            crossing, changes_sign = self._crossing(scheme, step, start, event, self.signs[place])
            if changes_sign:
                unlocated.append(place)
            if crossing is not None:
                crossings.append(crossing)
        first = min(crossings, key=_length, default=None)
        if first is None:
            last = step
        else:
            last = first.step
        for place in unlocated:  # update the signs at the start of the next step
            value = self.events[place].plain_value(scheme.tree(last.new), self.params, t + last.length * h)
            self.signs[place] = float(np.sign(value)) or self.signs[place]
        if first is not None:
            self.last_sign = first.sign
            # Events at the same time up to rounding. After the jump of the first one the others might not be found.
            latest = first.step.length + SAME_TIME * max(abs(t), h) / h
            self.simultaneous = [
                (crossing.event, crossing.sign)
                for crossing in crossings
                if crossing is not first and crossing.step.length <= latest
            ]
        return first

    def _crossing(
        self, scheme: Adaptive, step: AcceptedStep, start: tuple, event: Event, sign: float
    ) -> tuple[Crossing | None, bool]:
        """Return the first located zero of an event in a step, and whether a zero before it was not located."""
        t, h = start[2:]
        t = t + step.done * h
        middle, share = scheme.inner_state(step)
        values = [
            event.plain_value(scheme.tree(step.u), self.params, t),
            event.plain_value(scheme.tree(middle), self.params, t + share * step.length * h),
            event.plain_value(scheme.tree(step.new), self.params, t + step.length * h),
        ]
        inside = sign * np.array(values)  # positive before the crossing
        if inside[1] < 0:
            upper = share * step.length
        elif inside[2] <= 0:
            upper = step.length
        else:
            dip = self._dip(scheme, step, start, event, sign, share, inside)
            if dip is None:
                return None, False
            upper = dip
        if event.is_located(sign):
            return self._located(scheme, step, start, event, sign, 0.0, upper), False
        # The first zero has the wrong direction; a second zero in this step has the other one.
        if upper == step.length or inside[2] < 0:
            return None, True
        return self._located(scheme, step, start, event, -sign, upper, step.length), True

    def _value(self, scheme: Adaptive, step: AcceptedStep, start: tuple, event: Event, length: float) -> float:
        """Return the value of an event function after a step of another length."""
        t, h = start[2:]
        t = t + step.done * h
        part = scheme.partial_step(step, start, length)
        if part is None:
            raise ConvergenceError(f"{scheme.name}: no step leads to {event.name} near t = {t:.6g}")
        return event.plain_value(scheme.tree(part.new), self.params, t + length * h)

    def _dip(
        self,
        scheme: Adaptive,
        step: AcceptedStep,
        start: tuple,
        event: Event,
        sign: float,
        share: float,
        values: np.ndarray,
    ) -> float | None:
        """Return a length between two zeros of an event in a step; None if there are none.

        The minimum is searched only if the parabola through the values at the start, inside and at the end of the step
        has a small minimum in it.
        """
        quadratic, linear_part, constant_part = np.polyfit([0.0, share, 1.0], values, 2)
        if quadratic <= 0 or not 0 < -linear_part < 2 * quadratic:
            return None
        if constant_part - linear_part**2 / (4 * quadratic) > DIP * min(values[1:]):
            return None

        def distance(part: float) -> float:
            return sign * self._value(scheme, step, start, event, part * step.length)

        lowest = minimize_scalar(distance, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-6})
        if lowest.fun < 0:
            return lowest.x * step.length
        return None

    def _located(
        self,
        scheme: Adaptive,
        step: AcceptedStep,
        start: tuple,
        event: Event,
        sign: float,
        lower: float,
        upper: float,
    ) -> Crossing | None:
        """Return the zero of an event between two lengths of a step; None if there is none."""
        t, h = start[2:]
        t = t + step.done * h
        value = partial(self._value, scheme, step, start, event)
        if value(upper) * sign > 0:  # the state in the middle of a step is less accurate than the state at its end
            upper = step.length
            if value(upper) * sign > 0:
                return None
        shortest = 4 * EPS * max(abs(t), abs(h)) / h
        lower = lower or 0.5 * upper
        for _ in range(HALVINGS):
            if lower <= shortest or value(lower) * sign > 0:
                break
            upper = lower
            lower = 0.5 * lower
        root = shortest
        if lower > shortest:
            root = brentq(value, lower, upper, xtol=EPS * shortest, rtol=4 * EPS)
        part = scheme.partial_step(step, start, root)
        if part is None:
            raise ConvergenceError(f"{scheme.name}: no step leads to {event.name} near t = {t:.6g}")
        return Crossing(part, event, sign)


def _length(crossing: Crossing) -> float:
    return crossing.step.length
