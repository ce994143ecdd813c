"""The first event in a step, located by Brent's method.

After each accepted step the sign of every event is compared with the sign at the start of the segment. If it changed,
the length l of the step is found by Brent's method with the scheme itself: with the step map S,
g(S(u, l), params, t + l) = 0. So the time of an event, like the state there, belongs to the discrete solution.

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

DIP = 0.3  # share of the values of an event in a step up to which a minimum between them is located
HALVINGS = 60  # of a step, to find a point before the crossing
SAME_TIME = 64 * EPS  # difference of two times, relative to the time, that counts as rounding


class Crossing(NamedTuple):
    """An event in a step: the step up to there, the event, and its sign before."""

    step: AcceptedStep
    event: Event
    sign: float


class EventDetector:
    """The signs of all events while a segment is crossed.

    Parameters
    ----------
    events : list of Event
    problem : Problem
    u, params, t, h
        Start of an interval, and its length; plain.

    Attributes
    ----------
    signs : list of float
        Of each event in the present segment.
    last_sign : float
        Of the last event that was located, before it.
    simultaneous : list of (Event, float)
        Other events at the time of the last one, and their signs before it.
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
        """Return the surfaces beyond which the rate must not be evaluated."""
        pairs = zip(self.events, self.signs, strict=True)
        return tuple(Surface(event, sign) for event, sign in pairs if event.is_located(sign))

    def _sign_after(self, event: Event, u: Any, t: float, rounding: float = 0.0) -> float:
        """Return the sign right after (u, t): on the surface itself, the sign of the rate of change."""
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
            The states before and after its jump.
        t : float

        Returns
        -------
        list of Event
            Those at the same time that the next step would not find: beyond the jump they do not change their sign.
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
        """Return an event at the end of an interval whose zero the next interval would take for its start, or None."""
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
            (u, params, t, h) with which the scheme began the segment, plain.
        """
        t, h = start[2:]
        t = t + step.done * h
        crossings = []
        unlocated = []  # events whose sign changes without a crossing that counts
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
        for place in unlocated:  # the signs where the next step begins
            value = self.events[place].plain_value(scheme.tree(last.new), self.params, t + last.length * h)
            self.signs[place] = float(np.sign(value)) or self.signs[place]
        if first is not None:
            self.last_sign = first.sign
            # Times that differ by rounding; where the first of them jumps, the others might not be found again.
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
        """Return the first crossing of an event in a step, and whether the sign changes without counting before."""
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
        # Only a crossing back, later in this step, counts.
        if upper == step.length or inside[2] < 0:
            return None, True
        return self._located(scheme, step, start, event, -sign, upper, step.length), True

    def _value(self, scheme: Adaptive, step: AcceptedStep, start: tuple, event: Event, length: float) -> float:
        """Return the event after a part of a step."""
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
        """Return a length after which the event has the other sign, where it crosses zero twice in a step; else None.

        The parabola through the values at the start, inside and at the end decides whether to search.
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
        """Return the crossing of an event between two lengths of a step; None where there is none."""
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
