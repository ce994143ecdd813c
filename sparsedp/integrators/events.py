"""Events and breaks of `stepper`, and the side of the surface of an event on which a rate is evaluated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.calls import wrapped_functions
from sparsedp._utils.pytree import flatten, leaves
from sparsedp._utils.validation import EPS, check_function, check_number, check_takes
from sparsedp.autodiff.derivative import pullback
from sparsedp.autodiff.tape import dtype_of, is_variable, isbox, plain
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError
from sparsedp.integrators.problem import field_leaves, takes_arguments, untraced

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Event", "Surface", "break_times", "event_list", "times_of"]

SHIFTS = 12  # number of attempts to move a state to the required side of a surface
MARGIN = 4 * EPS  # distance from the surface in the first attempt, relative to the size of the state


class Event:
    """A function whose zeros end a step.

    Parameters
    ----------
    function : callable
        ``function(u, params)`` or ``function(u, params, t)`` returns a real number.
    jump : callable or None
        ``jump(u, params)`` or ``jump(u, params, t)`` returns the state with which the integration continues.
    position : int
        Position in the list of events, for error messages.

    Attributes
    ----------
    terminal : bool
        Whether the interval ends at the event.
    direction : float
        As in SciPy's `solve_ivp`: > 0 locates only zeros from negative to positive, < 0 only from positive to negative,
        and 0 both.
    """

    def __init__(self, function: Callable, jump: Callable | None, position: int) -> None:
        self.name = f"events[{position}]"
        self.function = function
        self.jump = jump
        self.takes_time = _takes_time(self.name, function)
        self.jump_takes_time = jump is not None and _takes_time(f"the jump of {self.name}", jump)
        terminal = _attribute(function, "terminal", False)
        if np.ndim(terminal) or terminal not in (False, True):
            raise ValueError(f"the attribute terminal of {self.name} must be True or False, got {terminal!r}")
        self.terminal = bool(terminal)
        self.direction = check_number(f"the direction of {self.name}", _attribute(function, "direction", 0))

    def value(self, u: Any, params: Any, t: Any) -> Any:
        """Return the value of the event function, traced or not."""
        if self.takes_time:
            result = self.function(u, params, t)
        else:
            result = self.function(u, params)
        if np.size(plain(result)) != 1 or dtype_of(result).kind not in "fiu":
            raise ShapeError(
                f"{self.name} must return one real number, got {dtype_of(result)} of shape {np.shape(plain(result))}"
            )
        if np.ndim(plain(result)) == 0:
            return result
        return result.reshape(())

    def plain_value(self, u: Any, params: Any, t: float) -> float:
        """Return the value of the event function as a float; raise NonFiniteError if it is not finite."""
        value = float(plain(self.value(u, params, t)))
        if not np.isfinite(value):
            raise NonFiniteError(f"{self.name} must be finite, got {value} at t = {t:.6g}")
        return value

    def gradient(self, u: Any, params: Any, t: float) -> tuple[Any, float]:
        """Return the derivatives with respect to the state and to the time, for plain arguments."""
        if isbox(self.value(u, params, t)):
            raise DerivativeError(f"{self.name} uses a traced value that is not an argument; put it into params")
        back = pullback(lambda point: 1.0 * self.value(point[0], params, point[1]), (u, float(t)))[1]
        return back(np.float64(1.0))

    def is_located(self, sign: float) -> bool:
        """Return whether zeros before which the event function has this sign are located, as `direction` asks."""
        return sign != 0 and sign * self.direction <= 0

    def state_after(self, u: Any, params: Any, t: Any) -> Any:
        """Return the state with which the integration continues after the event."""
        if self.jump is None:
            return u
        if self.jump_takes_time:
            new = self.jump(u, params, t)
        else:
            new = self.jump(u, params)
        return flatten(u)[1](field_leaves(new, u, f"the jump of {self.name}"))


def _takes_time(name: str, function: Callable) -> bool:
    """Check that a function takes (u, params) or (u, params, t); return whether it takes the time."""
    example = "lambda u, params, t: ..."
    check_function(f"stepper, as {name},", function, example)
    takes_time = takes_arguments(function, 3)
    check_takes("stepper", function, 3 if takes_time else 2, example)
    return takes_time


def event_list(events: Any) -> list[Event]:
    """Convert the argument `events` of `stepper` (function, pair (function, jump), or list) to a list of Event."""
    if callable(events) or _is_pair(events):
        events = [events]
    if not isinstance(events, (list, tuple)):
        raise TypeError(
            f"events takes functions, or pairs (function, jump), got {type(events).__name__}; "
            "write events=[lambda u, params, t: ...]"
        )
    result = []
    for position, entry in enumerate(events):
        function = entry
        jump = None
        if isinstance(entry, (tuple, list)) and len(entry) == 2:
            function, jump = entry
        result.append(Event(function, jump, position))
    return result


def _is_pair(events: Any) -> bool:
    """Return True for a tuple of an event function and its jump, which may be None."""
    if not isinstance(events, tuple) or len(events) != 2:
        return False
    function, jump = events
    return callable(function) and (jump is None or callable(jump))


def break_times(breaks: Any) -> Any:
    """Convert the argument `breaks` of `stepper` to a sorted array of times; return a function of params unchanged."""
    if callable(breaks):
        check_takes("stepper", breaks, 1, "breaks=lambda params: [params['off']]")
        return breaks
    return np.unique([float(time) for time in times_of(breaks)])


def times_of(breaks: Any) -> list:
    """Return the times in a sequence or tree, traced or not."""
    times: list = []
    for leaf in leaves(breaks):
        value = np.asarray(plain(leaf))
        if value.dtype.kind not in "fiu":
            raise TypeError(
                f"breaks takes times, or a function of params that returns times, got {type(plain(leaf)).__name__}; "
                "write breaks=[0.5, 1.0]"
            )
        if value.ndim > 1:
            raise ShapeError(f"breaks must be a sequence of times, got an array of shape {value.shape}")
        if value.ndim == 1:
            times += [leaf[place] for place in range(value.size)]
        else:
            times.append(leaf)
    for place, time in enumerate(times):
        if not np.isfinite(plain(time)):
            raise NonFiniteError(f"breaks must be finite, got {float(plain(time))} at place {place}")
    return times


def _attribute(function, name, default):
    """Return an attribute of a function, or of the function inside `jit`, functools.partial or another wrapper."""
    for layer in wrapped_functions(function):
        if hasattr(layer, name):
            return getattr(layer, name)
    return default


class Surface:
    """The surface on which an event is 0, and the side of it on which a rate is evaluated.

    Parameters
    ----------
    event : Event
    sign : float
        Sign of the event function on this side.
    """

    __slots__ = ("event", "sign")

    def __init__(self, event: Event, sign: float) -> None:
        self.event = event
        self.sign = sign

    def inside(self, u: Any, params: Any, t: Any) -> tuple:
        """Return (u, t) or, if it lies on the other side, a point near it on this side; derivatives do not change."""
        state, plain_params, time = untraced((u, params, t))
        value = self.event.plain_value(state, plain_params, time)
        if value * self.sign > 0:
            return u, t
        of_state, of_time = self.event.gradient(state, plain_params, time)
        weights = [_weight(leaf) for leaf in leaves(state)]
        rows = [0.0 if row is None else row for row in leaves(of_state)]
        square = 0.0
        for weight, row in zip(weights, rows, strict=True):
            square += np.sum(np.abs(weight * row) ** 2)
        square = float(square)
        by_time = 0.0
        if square == 0.0:
            if of_time == 0.0:
                return u, t
            by_time = 1.0 / of_time
        directions = []
        for row, weight in zip(rows, weights, strict=True):
            if square:
                directions.append(np.conj(row) * weight**2 / square)
            else:
                directions.append(0.0 * weight)
        margin = MARGIN * (np.sqrt(square) + abs(of_time * time))
        shift = 0.0
        for _ in range(SHIFTS):
            shift += self.sign * margin - value
            moved = _moved(state, directions, shift)
            value = self.event.plain_value(moved, plain_params, time + shift * by_time)
            if value * self.sign > 0:
                break
            margin *= 4
        return _moved(u, directions, shift), t + shift * by_time


def _moved(u: Any, directions: list, shift: float) -> Any:
    """Return u + shift * direction, computed for each leaf."""
    entries, rebuild = flatten(u)
    pairs = zip(entries, directions, strict=True)
    return rebuild([leaf if leaf is None else leaf + shift * direction for leaf, direction in pairs])


def _weight(leaf: Any) -> Any:
    """Return |u| + floor with the default floor of errors for an array of the state; zeros for a constant leaf."""
    if leaf is None:
        return np.zeros(())
    if not is_variable(leaf):
        return np.zeros(np.shape(leaf))
    size = np.abs(leaf)
    largest = np.max(size, initial=0.0)
    return size + (0.1 * largest or 1.0)
