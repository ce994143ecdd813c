"""Error control: as many steps as the tolerance needs, each compared with two of half its length.

A trial of length h is taken once whole, w, and once in two halves, f. Their difference is 2^p - 1 times the error of f;
what is kept is f + (f - w) / (2^p - 1), one order better (local extrapolation). Crank-Nicolson keeps f: where its
steps ring, w has the opposite sign. The next length is the smaller of what the last error allows and what the trend of
the last two predicts. Derivatives: see variation.py.
Sources: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (1993), II.4; Gustafsson, ACM Trans. Math.
Software 20 (1994).
"""

import numpy as np

from sparsedp.constants import constant
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.integrators.combination import combine, untraced
from sparsedp.integrators.variation import Variation
from sparsedp.tape import dtype_of, is_variable, isbox, plain
from sparsedp.tree import leaves

__all__ = ["Adaptive"]

SAFETY, SMALLEST, LARGEST = 0.9, 0.2, 5.0  # of one change of the length
QUIET = 1e-2  # share of the tolerance below which an error shows no trend
FLOOR = 0.1  # share of the largest entry of an array to which errors of small entries are compared
LEAST = 1e-15  # share of the interval below which no step is tried
MOST = 100_000  # trials in one interval
WINDOW, FAR = 1000, 10  # trials at a pace that would need FAR * MOST for the rest: no use to go on


class Adaptive:
    """A scheme with error control over each interval.

    Parameters
    ----------
    scheme : callable
        ``scheme(u, params, t, h)``, with `order`, `problem` and `dyadic`: then lengths are halves of
        halves of the interval, so that few set-ups are needed.
    tolerance : float
        Of the error of two half steps, relative to |u| + floor, root mean square over all entries.
    floor : None, number, or tree like the state
        None: for each array of the state a tenth of its largest entry.
    name : str

    Attributes
    ----------
    taken : list of float
        Lengths of the accepted steps in the last interval, as shares of it.
    weight : float
        Of the extrapolation, 1 / (2^p - 1), or 0.
    """

    def __init__(self, scheme, tolerance, floor, name):
        self.scheme, self.tolerance, self.floor, self.name = scheme, tolerance, constant(floor), name
        self.order, self.dyadic, self.taken = scheme.order, scheme.dyadic, []
        self.weight = 0.0 if getattr(scheme, "name", "") == "crank_nicolson" else 1 / (2**self.order - 1)

    @property
    def info(self):
        return getattr(self.scheme, "info", None)

    def __call__(self, u, params, t, h):
        """The state after the interval h."""
        self._check_tolerance(u)
        traced = any(map(isbox, leaves((u, params, t, h))))
        path: list | None = [] if traced else None
        given = untraced(u), untraced(params), untraced(t), plain(h)
        new = self._cross(given, path)
        return Variation(self, path, given, new).follow(u, params, t, h) if traced else new

    def _cross(self, given, path):
        """The state after the interval; steps go to `path` as (share, share done, state, state between its halves)."""
        u, params, t, h = given
        length, done, taken, mark = self._first(u, params, t, h), 0.0, [], 0.0
        trend, most = None, LARGEST
        for trial in range(1, MOST + 1):
            left = 1.0 - done
            length = self._allowed(length, left)
            middle, new, error = self._trial(u, params, t if t is None else t + done * h, length, h)
            change = SAFETY * max(error, 1e-10) ** (-1 / (self.order + 1))
            if error <= 1:
                if path is not None:
                    path.append((length, done, u, middle))
                u, done = new, done + length if length < left else 1.0
                taken.append(length)
                change, trend = self._foreseen(change, length, error, trend)
            if done >= 1.0:
                self.taken = taken
                return u
            length *= float(np.clip(change, SMALLEST, most))
            most = LARGEST if error <= 1 else 1.0  # the step after a refused one is not made longer
            if trial % WINDOW == 0:
                if (1.0 - done) * WINDOW > FAR * MOST * (done - mark):
                    break
                mark = done
            if length < LEAST:
                break
        raise ConvergenceError(
            f"{self.name} found no step that meets the tolerance {self.tolerance:g} at {done:.3g} of its interval "
            f"after {len(taken)} steps; take a larger tolerance, a method for stiff problems, or an interval "
            "that ends before the solution does"
        )

    def _foreseen(self, change, length, error, trend):
        """The change of length where errors go on growing as they did, and the trend from here."""
        error = max(error, QUIET)
        if trend is not None:
            before, other = trend
            change = min(change, change * length / before * (other / error) ** (1 / (self.order + 1)))
        return change, (length, error)

    def _check_tolerance(self, u):
        """Steps of a state that cannot hold the digits asked for would shrink to nothing."""
        for leaf in leaves(u):
            rounding = np.finfo(dtype_of(leaf)).eps if is_variable(leaf) else 0.0
            if self.tolerance < 4 * rounding:
                raise ValueError(
                    f"{self.name} cannot meet the tolerance {self.tolerance:g} with a state of {dtype_of(leaf)}, whose "
                    f"rounding is {rounding:.1e}; take a larger tolerance or write u.astype(float)"
                )

    def _allowed(self, length, left):
        """At most what is left, and not just short of it."""
        if not self.dyadic:
            return left if length > 0.99 * left else min(length, 0.5 * left) if length > 0.5 * left else length
        return 2.0 ** float(np.floor(np.log2(min(length, left))))

    def _trial(self, u, params, t, length, h):
        """The state between two half steps, the new state, and the error of the halves in units of the tolerance."""
        half = 0.5 * length * h
        try:
            with np.errstate(all="ignore"):  # a step that is too long is refused, whatever it gave
                middle = self.scheme(u, params, t, half)
                fine = self.scheme(middle, params, t if t is None else t + half, half)
                whole = self.scheme(u, params, t, half + half)
                error = self._error(u, fine, whole)
                new = self.joined(fine, whole, self.weight)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            if length * SMALLEST < LEAST:
                raise
            return None, None, np.inf
        return middle, new, error if np.isfinite(error) else np.inf

    @staticmethod
    def joined(fine, whole, weight):
        """fine + weight (fine - whole)."""
        return combine(fine, (weight, fine), (-weight, whole)) if weight else fine

    def sizes(self, u, new):
        """For each array of the state |u| + floor, to which its errors are compared."""
        found = []
        for floor, *parts in self._floors(u, new):
            size = np.maximum(*(np.abs(np.asarray(plain(part))) for part in parts))
            found.append(size + (FLOOR * np.max(size, initial=0.0) if floor is None else floor))
        return found

    def _error(self, u, new, whole):
        total, count = 0.0, 0
        for size, one, other in zip(self.sizes(u, new), leaves(new), leaves(whole), strict=True):
            with np.errstate(all="ignore"):
                share = np.abs(np.asarray(one) - other) / (self.tolerance * size)
            share = np.where(one == other, 0.0, share)
            total, count = total + np.sum(share**2), count + share.size
        return float(np.sqrt(total / max(count, 1))) / (2**self.order - 1)

    def _floors(self, *trees):
        parts = [leaves(tree) for tree in trees]
        floors = leaves(self.floor)
        floors = floors if len(floors) == len(parts[0]) else [self.floor] * len(parts[0])
        return zip(floors, *parts, strict=True)

    def _first(self, u, params, t, h):
        """A first length from the size of the rate: one that changes the state by a hundredth."""
        rate = leaves(self.scheme.problem(u, params, t))
        if not all(np.all(np.isfinite(leaf)) for leaf in rate if leaf is not None):
            raise NonFiniteError(
                f"the rate of {self.name} must be finite at the state given; take a state in its domain"
            )
        size = max((float(np.max(np.abs(leaf), initial=0.0)) for leaf in leaves(u)), default=0.0)
        speed = max((float(np.max(np.abs(leaf), initial=0.0)) for leaf in rate), default=0.0)
        length = 0.01 * (size or 1.0) / (speed * float(h)) if speed > 0 else 1.0
        return min(max(length, 1e3 * LEAST), 1.0) if np.isfinite(length) else 1e-6
