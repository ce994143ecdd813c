"""Bounds on the unknowns, as flat vectors."""

from __future__ import annotations

from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import branches_mapped, child, is_branch, is_uniform
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.flattening import joined
from sparsedp.errors import ShapeError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["Box", "pair_of_bounds"]

RELATIVE_ROUNDING = 4 * float(EPS)  # x + (bound - x) may differ from the bound by this multiple of |x|
WITHOUT_BOUND = -np.inf, np.inf  # a lower and an upper bound that allow every value
INFINITE = "with -np.inf or np.inf in place of None"
FROM_PAIRS = f"tuple(map(np.array, zip(*bounds))), {INFINITE}"


def pair_of_bounds(bounds: Any) -> Any:
    """Return the argument `bounds` of `minimize` as a pair (lower, upper), or None.

    Parameters
    ----------
    bounds : (lower, upper), scipy.optimize.Bounds or None

    Raises
    ------
    ValueError
        If bounds is something else. The message says how to convert SciPy's sequence of pairs and a dict of pairs.

    Examples
    --------
    >>> from scipy.optimize import Bounds
    >>> pair_of_bounds(Bounds([0.0, 2.0], [1.0, 3.0]))
    (array([0., 2.]), array([1., 3.]))
    """
    if bounds is None or (isinstance(bounds, (tuple, list)) and len(bounds) == 2):
        return bounds
    if hasattr(bounds, "lb") and hasattr(bounds, "ub"):  # scipy.optimize.Bounds
        return tuple(side.item() if np.size(side) == 1 else side for side in (bounds.lb, bounds.ub))
    advice = "(0.0, None) for x >= 0"
    if isinstance(bounds, dict):
        advice = "a dict of lower and a dict of upper bounds"
    elif isinstance(bounds, np.ndarray) and np.shape(bounds)[:1] == (2,):
        advice = "tuple(bounds) if its rows are the lower and the upper bounds"
    elif np.iterable(bounds) and all(map(_is_pair, bounds)):
        advice = FROM_PAIRS
    raise ValueError(
        "bounds must be a pair (lower, upper), each a number, None or a tree like start, "
        f"got {shortened(bounds)}; write {advice}"
    )


def _is_pair(entry):
    """Return whether an entry of SciPy's sequence of bounds may be a pair of one lower and one upper bound."""
    return isinstance(entry, (tuple, list, np.ndarray)) and len(entry) == 2


class Box:
    """Lower and upper bounds of the flat vector of unknowns; infinite if no bounds are given.

    Parameters
    ----------
    bounds : (lower, upper) or None
        As returned by `pair_of_bounds`.
    packing : Packing, optional
        The map between trees like the start and flat vectors. Required if bounds are given.

    Attributes
    ----------
    lower, upper : (n,) array, or float
        -inf and inf if no bounds are given.

    Raises
    ------
    ValueError
        If a bound is NaN, a lower bound is above an upper bound, or bounds could also be pairs of one lower and one
        upper bound for each entry of start.
    ShapeError
        If `lower` or `upper` has another tree structure than start, or a bound has another shape than its array.
    """

    def __init__(self, bounds: Any = None, packing: Packing | None = None):
        self.lower: Any = -np.inf
        self.upper: Any = np.inf
        if bounds is None:
            return
        if any(map(is_branch, bounds)):
            _check_reading(bounds, packing)
        self.lower, self.upper = _vectors(bounds, packing)

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


def _check_reading(bounds, packing):
    """Raise ValueError if bounds may be read as pairs (lower, upper), one for each entry of start, as SciPy does."""
    documented = _possible(bounds, packing)
    by_entry = _possible([_side_by_entry(bounds, index) for index in (0, 1)], packing)
    if by_entry is not None and documented is None:
        raise ValueError(
            f"bounds must be (lower, upper), got one pair for each entry of start, {shortened(bounds)}; write "
            f"{FROM_PAIRS}"
        )
    if by_entry is not None and not np.array_equal(documented, by_entry) and not np.array_equal(*by_entry):
        raise ValueError(
            f"bounds is ambiguous: {shortened(bounds)} may be two pairs (lower, upper), or all lower and all upper "
            "bounds; write tuple(map(np.array, zip(*bounds))) for the former and tuple(map(np.array, bounds)) for "
            f"the latter, {INFINITE}"
        )


def _side_by_entry(bounds, index):
    """Return a tree of pairs (lower, upper) with the lower (index 0) or the upper bound in place of each pair.

    A leaf that is not in a pair is replaced by NaN, which is no bound.
    """
    if not is_branch(bounds):
        return np.nan
    if isinstance(bounds, (tuple, list)) and len(bounds) == 2 and not any(map(is_branch, bounds)):
        return WITHOUT_BOUND[index] if bounds[index] is None else bounds[index]
    return branches_mapped(lambda key: _side_by_entry(child(bounds, key), index), bounds)


def _possible(sides, packing):
    """Return the flat lower and upper bounds, or None if these are no bounds; lists stand for arrays here."""
    try:
        if packing.is_leaf:
            sides = [np.array(side) if is_branch(side) else side for side in sides]
        return _vectors(sides, packing)
    except (ShapeError, TypeError, ValueError):
        return None


def _vectors(sides, packing):
    """Return the flat lower and upper bounds; raise an error if they are not a box."""
    lower = _flat_side(sides[0], WITHOUT_BOUND[0], packing, "bounds[0]")
    upper = _flat_side(sides[1], WITHOUT_BOUND[1], packing, "bounds[1]")
    possible = (lower <= upper) & (lower < np.inf) & (upper > -np.inf)  # False for NaN
    if not np.all(possible):
        first = np.argmin(possible)
        raise ValueError(
            f"bounds must be numbers with lower <= upper, got {float(lower[first])} and "
            f"{float(upper[first])}; write None for a side without a bound"
        )
    return lower, upper


def _flat_side(side, without_bound, packing, name):
    """Return the lower or the upper bounds as a flat vector.

    A number or None in `side` may replace a subtree of start; it then applies to all entries of that subtree. If start
    is a tuple or a list, `side` may be an array with one bound for each entry.
    """
    if isinstance(side, np.ndarray) and side.ndim and isinstance(packing.template, (tuple, list)):
        side = list(side)
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
