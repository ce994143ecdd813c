"""Bounds on the unknowns, as flat vectors."""

from reprlib import repr as shortened

import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.fields import EPS, is_number
from sparsedp.packing import joined
from sparsedp.tree import leaves

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
        If bounds is not a pair, has another structure than start, is NaN, or a lower bound is above an upper.
    ShapeError
        If a bound has another shape than its array.
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
        self.lower = _side(lower, -np.inf, packing)
        self.upper = _side(upper, np.inf, packing)
        if not np.all((self.lower <= self.upper) & (self.lower < np.inf) & (self.upper > -np.inf)):  # nor NaN
            raise ValueError("bounds must be numbers with lower <= upper; write None for a side without a bound")

    def inside(self, vector):
        """The nearest point of the box."""
        return np.clip(vector, self.lower, self.upper)

    def free(self, vector, slope):
        """Which entries can go downhill: not those at which the gradient pushes against a bound."""
        near = ULPS * np.abs(vector)  # a step that ends on a bound may miss it by rounding
        return ~(((vector - near <= self.lower) & (slope > 0)) | ((vector + near >= self.upper) & (slope < 0)))


def _side(side, without, packing):
    given = leaves(side)
    if side is None or (not isinstance(side, (tuple, list, dict)) and is_number(side)):
        given *= packing.count
    if len(given) != packing.count:
        raise ValueError(
            f"a bound must be a number or have the structure of start, got {len(given)} leaves where start has "
            f"{packing.count}; write one number, or a tree like start"
        )
    pairs = zip(packing.values, packing.floating(given))
    return joined([_full(x, without if b is None else b) for x, b in pairs])


def _full(x, bound):
    """A bound for every entry of x; a real one bounds both parts of a complex entry."""
    if np.iscomplexobj(x) and not np.iscomplexobj(bound):
        bound = bound * (1 + 1j)
    try:
        return np.full(np.shape(x), bound)
    except ValueError:
        raise ShapeError(f"a bound of shape {np.shape(bound)} does not fit start, of shape {np.shape(x)}") from None
