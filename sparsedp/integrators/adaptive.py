"""Error control: as many steps as the tolerance needs, each compared with two of half its length.

A trial of length h is taken once whole (without a trace) and once in two halves; the halves are kept. Their
error is about the difference divided by 2^p - 1. The lengths that were accepted are data: the derivative of
the interval is that of the steps that were taken, their lengths in fixed proportion to the interval.
Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (1993), II.4.
"""

import numpy as np

from sparsedp.constants import constant
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.integrators.combination import untraced
from sparsedp.tape import dtype_of, is_variable, plain
from sparsedp.tree import leaves

__all__ = ["Adaptive"]

SAFETY, SMALLEST, LARGEST = 0.9, 0.2, 5.0  # of one change of the length
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
        Of the error of one step, relative to |u| + floor, root mean square over all entries.
    floor : None, number, or tree like the state
        None: for each array of the state its largest entry.
    name : str

    Attributes
    ----------
    taken : list of float
        Lengths of the accepted steps in the last interval, as shares of it.
    """

    def __init__(self, scheme, tolerance, floor, name):
        self.scheme, self.tolerance, self.floor, self.name = scheme, tolerance, constant(floor), name
        self.order, self.dyadic, self.taken = scheme.order, scheme.dyadic, []

    @property
    def info(self):
        return getattr(self.scheme, "info", None)

    def __call__(self, u, params, t, h):
        """The state after the interval h."""
        self._check_tolerance(u)
        length, done, taken, mark = self._first(u, params, t, h), 0.0, [], 0.0
        for trial in range(1, MOST + 1):
            left = 1.0 - done
            length = self._allowed(length, left)
            at = t if t is None else t + done * h
            new, error = self._trial(u, params, at, length, h)
            if error <= 1:
                u, done = new, done + length if length < left else 1.0
                taken.append(length)
            if done >= 1.0:
                self.taken = taken
                return u
            length *= float(np.clip(SAFETY * max(error, 1e-10) ** (-1 / (self.order + 1)), SMALLEST, LARGEST))
            if trial % WINDOW == 0:
                if (1.0 - done) * WINDOW > FAR * MOST * (done - mark):
                    break
                mark = done
            if length < LEAST:
                break
        raise ConvergenceError(
            f"{self.name} found no step that meets the tolerance {self.tolerance:g} at {done:.3g} of its interval "
            f"after {len(taken)} steps; take a larger tolerance or a method for stiff problems"
        )

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
        """Two half steps, and their error in units of the tolerance."""
        half = 0.5 * length * h
        try:
            with np.errstate(all="ignore"):  # a step that is too long is refused, whatever it gave
                middle = self.scheme(u, params, t, half)
                new = self.scheme(middle, params, t if t is None else t + half, half)
                bare = [untraced(tree) for tree in (u, params, t)]
                whole = self.scheme(*bare, 2 * plain(half))
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            if length * SMALLEST < LEAST:
                raise
            return None, np.inf
        error = self._error(u, new, whole)
        return new, error if np.isfinite(error) else np.inf

    def _error(self, u, new, whole):
        total, count = 0.0, 0
        for floor, *parts in self._floors(u, new, whole):
            old, one, other = (np.asarray(plain(part), float) for part in parts)
            size = np.maximum(np.abs(old), np.abs(one))
            floor = np.max(size, initial=0.0) if floor is None else floor
            with np.errstate(all="ignore"):
                share = np.abs(one - other) / (self.tolerance * (size + floor))
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
        bare, of_params, at = (untraced(tree) for tree in (u, params, t))
        rate = leaves(self.scheme.problem(bare, of_params, at))
        if not all(np.all(np.isfinite(plain(leaf))) for leaf in rate if leaf is not None):
            raise NonFiniteError(
                f"the rate of {self.name} must be finite at the state given; take a state in its domain"
            )
        size = max((float(np.max(np.abs(leaf), initial=0.0)) for leaf in leaves(bare)), default=0.0)
        speed = max((float(np.max(np.abs(plain(leaf)), initial=0.0)) for leaf in rate), default=0.0)
        length = 0.01 * (size or 1.0) / (speed * float(plain(h))) if speed > 0 else 1.0
        return min(max(length, 1e3 * LEAST), 1.0) if np.isfinite(length) else 1e-6
