"""Bounds on the unknowns, as flat vectors."""

from reprlib import repr as shortened

import numpy as np

from sparsedp._utils.pytree import is_uniform
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.flattening import joined
from sparsedp.errors import ShapeError

__all__ = ["Box"]

ULPS = 4 * float(EPS)


class Box:
    """Lower and upper bounds of a flat vector; without any it changes nothing.

    Parameters
    ----------
    bounds : (lower, upper) or None
        As for `minimize`.
    packing : Packing

    Attributes
    ----------
    lower, upper : (n,) array, or a number where there are no bounds

    Raises
    ------
    ValueError
        If bounds is not a pair, is NaN, or a lower bound is above an upper.
    ShapeError
        If a side has another structure than start, or a bound another shape than its array.
    """

    def __init__(self, bounds=None, packing=None):
        self.lower, self.upper = -np.inf, np.inf
        if bounds is None:
            return
        if not isinstance(bounds, (tuple, list)) or len(bounds) != 2:
            raise ValueError(
                "bounds must be a pair (lower, upper), each a number, None or a tree like start, "
                f"got {shortened(bounds)}; write (0.0, None) for x >= 0"
            )
        lower, upper = bounds
        self.lower = _side(lower, -np.inf, packing, "bounds[0]")
        self.upper = _side(upper, np.inf, packing, "bounds[1]")
        if not np.all((self.lower <= self.upper) & (self.lower < np.inf) & (self.upper > -np.inf)):  # nor NaN
            lower, upper = np.broadcast_arrays(self.lower, self.upper)
            first = np.argmin((lower <= upper) & (lower < np.inf) & (upper > -np.inf))
            raise ValueError(
                f"bounds must be numbers with lower <= upper, got {float(lower.flat[first])} and "
                f"{float(upper.flat[first])}; write None for a side without a bound"
            )

    @property
    def bounded(self):
        """Whether there are any bounds."""
        return bool(np.any(self.lower > -np.inf) or np.any(self.upper < np.inf))

    def inside(self, vector):
        """The nearest point of the box."""
        return np.clip(vector, self.lower, self.upper)

    def moved(self, vector, step):
        """Return the point of the box nearest to vector + step, on a bound where it differs from it by rounding."""
        point = self.inside(vector + step)
        rounding = ULPS * np.abs(vector)
        point = np.where(point - self.lower <= rounding, self.lower, point)
        return np.where(self.upper - point <= rounding, self.upper, point)

    def free(self, vector, slope):
        """Which entries can go downhill: not those at which the gradient pushes against a bound."""
        near = ULPS * np.abs(vector)  # a step that ends on a bound may miss it by rounding
        return ~(((vector - near <= self.lower) & (slope > 0)) | ((vector + near >= self.upper) & (slope < 0)))


def _side(side, without, packing, name):
    """One side of the bounds as a flat vector; a number or None may stand for a whole branch of start."""
    advice = "; write one number, None, or a tree like start"
    given = packing.floating(side, name, advice=advice, prefix=is_uniform)
    labels = zip(packing.names_under(name), packing.names)
    full = [_full(x, without if b is None else b, *label) for label, x, b in zip(labels, packing.values, given)]
    return joined(full)


def _full(x, bound, name, place):
    """A bound for every entry of x; a real one bounds both parts of a complex entry."""
    kind = np.asarray(bound).dtype
    if kind.kind not in "biufc":
        raise TypeError(f"{name}: expected numbers, got dtype {kind}; write -np.inf or np.inf for none")
    if np.iscomplexobj(x) and not np.iscomplexobj(bound):
        bound = bound * (1 + 1j)
    try:
        return np.full(np.shape(x), bound)
    except ValueError:
        raise ShapeError(f"{name}: shape {np.shape(bound)} does not fit {place}, of shape {np.shape(x)}") from None
