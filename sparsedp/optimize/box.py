"""Bounds on the unknowns, as flat vectors."""

from __future__ import annotations

from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import is_uniform
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.flattening import joined
from sparsedp.errors import ShapeError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["Box"]

RELATIVE_ROUNDING = 4 * float(EPS)  # x + (bound - x) may differ from the bound by this multiple of |x|


class Box:
    """Lower and upper bounds of the flat vector of unknowns; infinite if no bounds are given.

    Parameters
    ----------
    bounds : (lower, upper) or None
        As for `minimize`.
    packing : Packing, optional
        The map between trees like the start and flat vectors. Required if bounds are given.

    Attributes
    ----------
    lower, upper : (n,) array, or float
        -inf and inf if no bounds are given.

    Raises
    ------
    ValueError
        If bounds is not a pair, is NaN, or a lower bound is above an upper bound.
    ShapeError
        If `lower` or `upper` has another tree structure than start, or a bound has another shape than its array.
    """

    def __init__(self, bounds: Any = None, packing: Packing | None = None):
        self.lower: Any = -np.inf
        self.upper: Any = np.inf
        if bounds is None:
            return
        if not isinstance(bounds, (tuple, list)) or len(bounds) != 2:
            raise ValueError(
                "bounds must be a pair (lower, upper), each a number, None or a tree like start, "
                f"got {shortened(bounds)}; write (0.0, None) for x >= 0"
            )
        self.lower = _flat_side(bounds[0], -np.inf, packing, "bounds[0]")
        self.upper = _flat_side(bounds[1], np.inf, packing, "bounds[1]")
        possible = (self.lower <= self.upper) & (self.lower < np.inf) & (self.upper > -np.inf)  # False for NaN
        if not np.all(possible):
            first = np.argmin(possible)
            raise ValueError(
                f"bounds must be numbers with lower <= upper, got {float(self.lower[first])} and "
                f"{float(self.upper[first])}; write None for a side without a bound"
            )

    @property
    def bounded(self) -> bool:
        """Whether there are any bounds."""
        return bool(np.any(self.lower > -np.inf) or np.any(self.upper < np.inf))

    def nearest(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the vector clipped to the bounds."""
        return np.clip(vector, self.lower, self.upper)

    def moved(self, vector: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return vector + step, clipped to the bounds. Entries within rounding of a bound are set exactly to it."""
        point = self.nearest(vector + step)
        rounding = RELATIVE_ROUNDING * np.abs(vector)
        point = np.where(point - self.lower <= rounding, self.lower, point)
        return np.where(self.upper - point <= rounding, self.upper, point)

    def free(self, vector: NDArray[np.float64], gradient: ArrayLike) -> NDArray[np.bool_]:
        """Return False for entries that are at a bound and that a step along the negative gradient would move out."""
        rounding = RELATIVE_ROUNDING * np.abs(vector)
        at_lower = (vector - rounding <= self.lower) & (np.asarray(gradient) > 0)
        at_upper = (vector + rounding >= self.upper) & (np.asarray(gradient) < 0)
        return ~(at_lower | at_upper)


def _flat_side(side, without_bound, packing, name):
    """Return the lower or the upper bounds as a flat vector.

    A number or None in `side` may replace a subtree of start; it then applies to all entries of that subtree.
    """
    bounds = packing.variables(side, name, advice="; write one number, None, or a tree like start", prefix=is_uniform)
    arrays = []
    for bound, x, bound_name, x_name in zip(bounds, packing.values, packing.names_under(name), packing.names):
        if bound is None:
            bound = without_bound
        arrays.append(_filled(x, bound, bound_name, x_name))
    return joined(arrays)


def _filled(x, bound, bound_name, x_name):
    """Return a bound for every entry of x; a real bound applies to the real and imaginary parts of complex entries."""
    dtype = np.asarray(bound).dtype
    if dtype.kind not in "biufc":
        raise TypeError(f"{bound_name}: expected numbers, got dtype {dtype}; write -np.inf or np.inf for none")
    if np.iscomplexobj(x) and not np.iscomplexobj(bound):
        bound = bound * (1 + 1j)
    try:
        return np.full(np.shape(x), bound)
    except ValueError:
        raise ShapeError(
            f"{bound_name}: shape {np.shape(bound)} does not fit {x_name}, of shape {np.shape(x)}"
        ) from None
