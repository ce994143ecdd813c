"""Where compiled loops look: index coordinates, samples and weights along one axis.

The tuples `like` say with their lengths how many weights there are (1: no axis, 2: linear, 4: cubic).
"""

from math import floor

from numba import njit
from numba.extending import overload

__all__ = ["both", "cubic_place", "inside", "slope", "value"]


@njit(error_model="numpy")
def _clamped(p, n, wraps, low, high):
    """Index coordinate -> [0, n] on a periodic axis, else [low, high]; NaN goes to the lower end."""
    if wraps:
        if not 0.0 <= p < n:
            p -= n * floor(p / n)
        low, high = 0.0, float(n)
    if not p >= low:
        p = low
    return min(p, high)


@njit(error_model="numpy")
def inside(p, n, wraps):
    """Index coordinate -> [0, n] on a periodic axis, else [-3/2, n + 1/2]; NaN goes to the lower end."""
    return _clamped(p, n, wraps, -1.5, n + 0.5)


def value(p, n, wraps, like):
    """First sample (with two or three in front of the domain) and the weights of the value."""


def slope(p, n, wraps, like):
    """First sample and the weights of the slope."""


def both(p, n, wraps, like):
    """First sample, the weights of the value and of the slope, and whether the slope has a kink there."""


@overload(value)
def _value_of(p, n, wraps, like):
    def absent(p, n, wraps, like):
        return 0, (1.0,)

    def linear(p, n, wraps, like):
        p = inside(p, n, wraps)
        i = floor(p)
        t = p - i
        return int(i) + 2, (1.0 - t, t)

    def cubic(p, n, wraps, like):
        i, t = cubic_place(p, n, wraps)
        s = 1.0 - t
        return i + 2, (-0.5 * t * s * s, s * (1.0 + t - 1.5 * t * t), t * (1.0 + s - 1.5 * s * s), -0.5 * s * t * t)

    return {1: absent, 2: linear, 4: cubic}[len(like)]


@overload(slope)
def _slope_of(p, n, wraps, like):
    def absent(p, n, wraps, like):
        return 0, (0.0,)

    def linear(p, n, wraps, like):
        p = inside(p, n, wraps)
        i = floor(p)
        if p == i:  # a kink: the mean of both sides
            return int(i) + 1, (-0.5, 0.0, 0.5)
        if i < -1.0:  # nothing is read in front of the samples
            return int(i) + 2, (-1.0, 1.0, 0.0)
        return int(i) + 1, (0.0, -1.0, 1.0)

    def cubic(p, n, wraps, like):
        i, t = cubic_place(p, n, wraps)
        s = 1.0 - t
        return i + 2, (s * (1.5 * t - 0.5), t * (4.5 * t - 5.0), s * (5.0 - 4.5 * s), t * (0.5 - 1.5 * s))

    return {1: absent, 2: linear, 4: cubic}[len(like)]


@overload(both)
def _both_of(p, n, wraps, like):
    def absent(p, n, wraps, like):
        return 0, (1.0,), (0.0,), False

    def linear(p, n, wraps, like):
        first, weights = value(p, n, wraps, like)
        return first, weights, (-1.0, 1.0), weights[1] == 0.0

    def cubic(p, n, wraps, like):
        first, weights = value(p, n, wraps, like)
        return first, weights, slope(p, n, wraps, like)[1], False

    return {1: absent, 2: linear, 4: cubic}[len(like)]


@njit(error_model="numpy")
def cubic_place(p, n, wraps):
    p = _clamped(p, n, wraps, -2.0, n + 1.0)
    i = min(floor(p), n)
    return int(i), p - i
