"""Order of accuracy: how the error falls when the grid is refined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf, isnan, nan
from statistics import linear_regression
from typing import Any

import numpy as np

from sparsedp._utils.validation import check_function, number_beside
from sparsedp.check.summary import Result
from sparsedp.check.table import Table

__all__ = ["Refinement", "order"]

MARGIN = 0.1  # tolerance on both sides of an expected order


def order(
    error_at: Callable[[int], float], sizes: Sequence[int] = (16, 32, 64, 128), expected: Any = None
) -> Refinement:
    """Measure the order of accuracy: how the error falls when the grid is refined.

    Parameters
    ----------
    error_at : callable
        ``error_at(n)`` solves the problem with n cells along an axis, and returns the norm of the difference to the
        exact solution as a float.
    sizes : sequence of int
        At least three increasing values of n. The mesh size is 1 / n.
    expected : float or (low, high), optional
        The expected order: an interval, or a number p, which stands for the interval (p - 0.1, p + 0.1).

    Returns
    -------
    Refinement
        `.order` is the least-squares slope of log(error) over log(1 / n) for the last three sizes, and `.orders` are
        the slopes between neighbouring sizes. `.verdict` is "agrees" or "disagrees" with `expected`. It is
        "inconclusive" if no order was expected, or if the slope is not finite because one of the last three errors is
        0, NaN or infinite. str() returns the table.

    Raises
    ------
    ValueError
        If there are fewer than three sizes, or they do not increase, or the first one is less than 1.

    See Also
    --------
    check.operator, check.gradient

    Examples
    --------
    >>> from math import cos, sin
    >>> result = order(lambda n: abs((sin(1 + 1 / n) - sin(1 - 1 / n)) * n / 2 - cos(1)), expected=2)
    >>> result.verdict, round(result.order, 2)
    ('agrees', 2.0)
    """
    check_function("check.order", error_at, "lambda n: error on n cells")
    sizes = tuple(int(n) for n in sizes)
    if len(sizes) < 3 or any(a >= b for a, b in zip(sizes, sizes[1:])) or sizes[0] < 1:
        raise ValueError(f"order needs at least three increasing sizes, got {sizes}")
    if expected is not None and np.ndim(expected) == 0:
        expected = (expected - MARGIN, expected + MARGIN)
    errors = tuple(float(error_at(n)) for n in sizes)
    rise = np.log([error if 0 < error < inf else nan for error in errors])
    run = -np.log(sizes)
    slope = float(linear_regression(run[-3:], rise[-3:]).slope)
    verdict = "inconclusive"
    reason = "no order was expected"
    if isnan(slope):
        reason = "an error is 0 or not finite: no slope"
    elif expected is not None:
        if expected[0] <= slope <= expected[1]:
            verdict = "agrees"
        else:
            verdict = "disagrees"
        reason = f"expected {expected[0]:g} to {expected[1]:g}"
        if verdict == "disagrees":
            reason += f", got {number_beside(slope, *expected, digits=3)}"
    orders = tuple((np.diff(rise) / np.diff(run)).tolist())
    return Refinement(
        sizes=sizes, errors=errors, orders=orders, order=slope, expected=expected, verdict=verdict, reason=reason
    )


class Refinement(Result):
    """The result of `check.order`: errors for several grid sizes, and the observed order. Immutable.

    Attributes
    ----------
    sizes, errors : tuples
    expected : (low, high) or None
    orders : tuple of float
        Observed order between neighbouring sizes; NaN if one of the two errors is 0 or not finite.
    order : float
        Least-squares slope through the last three sizes.
    verdict : "agrees", "disagrees" or "inconclusive"
    reason : str
        Explanation of the verdict.
    """

    def __float__(self) -> float:
        return self.order

    def parts(self) -> list[str | Table]:
        """Return the title line, and the table of errors with the order relative to the previous grid."""
        orders = ("", *(f"{slope:.2f}" for slope in self.orders))
        head = f"order {self.order:.2f} over the last three sizes: {self.verdict} ({self.reason})"
        return [head, Table(("n", "error", "order"), list(zip(self.sizes, self.errors, orders)))]
