"""The harmonic average of a coefficient. It is nonlinear, so it is a differentiable function and not an Operator.

On the face between cells l and r of widths h_l and h_r, with w_l = h_l / (h_l + h_r) and w_r = 1 - w_l:

    k_f = k_l k_r / (w_l k_r + w_r k_l),   dk_f/dk_l = w_l (k_r / den)^2,   dk_f/dk_r = w_r (k_l / den)^2.

Here den is the denominator of k_f. This is the conductivity of two layers in series, with which the flux is exact for
a piecewise constant coefficient (Patankar, Numerical Heat Transfer and Fluid Flow, 1980). If k_l and k_r are both 0,
the ratios k_l / den and k_r / den are 0 / 0; they are set to 1, which is their value for all k_l = k_r > 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import autograd.numpy as anp
import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.validation import check_finite, check_kind, check_native, check_on
from sparsedp.autodiff.backend import as_field
from sparsedp.autodiff.derivative import entrywise
from sparsedp.autodiff.program_trace import check_values, sample
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.operators.stencils import adjacent_cell, to_faces

__all__ = ["harmonic_average", "harmonic_pair", "lower_share"]


def harmonic_average(grid: Grid) -> Callable:
    """Return a differentiable function that maps a coefficient on cells to its harmonic average on faces.

    Parameters
    ----------
    grid : Grid

    Returns
    -------
    callable
        A function of k on cells, finite and >= 0 [unit]; leading axes are a batch. It returns values on faces [unit]; a
        wall face has the value of its cell.

    Raises
    ------
    ShapeError
        When the function is called, if the coefficient has another shape than the grid.
    TypeError
        When the function is called, if the coefficient is complex.
    ValueError
        When the function is called, if a value is negative.
    NonFiniteError
        When the function is called, if a value is NaN or infinite.

    See Also
    --------
    average, elliptic_solver

    Examples
    --------
    >>> from sparsedp import Grid
    >>> harmonic_average(Grid(2))(np.array([1.0, 3.0]))
    array([1. , 1.5, 3. ])
    """
    check_grid("harmonic_average", grid)
    axes = range(grid.dim)
    below = to_faces("cell below", grid, [adjacent_cell(grid, axis, False) for axis in axes])
    above = to_faces("cell above", grid, [adjacent_cell(grid, axis, True) for axis in axes])
    pair = harmonic_pair(grid.join(*(lower_share(grid, axis) for axis in range(grid.dim))))

    def average(k):
        check_native("harmonic_average", k)
        values = as_field(sample(k))
        if np.shape(values)[-grid.dim :] != grid.shape:  # leading axes are a batch
            check_on("harmonic_average", values, grid.cells)
        check_kind("k of harmonic_average", values.dtype, "real numbers", "; write k.real")
        check_values(_check_coefficient, k)
        return pair(below(k), above(k))

    return ReconstructibleFunction(average, harmonic_average, grid)


def _check_coefficient(k):
    """Raise an error for a coefficient that is not finite or negative."""
    values = as_field(k)
    check_finite("harmonic_average", values, "takes a finite coefficient")
    if np.any(np.less(values, 0)):
        raise ValueError(f"harmonic_average needs a coefficient >= 0, got {np.min(values):g}")


def lower_share(grid: Grid, axis: int) -> NDArray:
    """Return w_l (see the module docstring) on the faces perpendicular to an axis, broadcastable to their shape."""
    low = adjacent_cell(grid, axis, False).matrix @ grid.widths[axis]
    high = adjacent_cell(grid, axis, True).matrix @ grid.widths[axis]
    shape = [1] * grid.dim
    shape[axis] = -1
    both = low + high
    return np.divide(low, both, out=np.zeros_like(low), where=both > 0).reshape(shape)  # 0: an axis without cells


def harmonic_pair(share: NDArray) -> Callable[[Any, Any], Any]:
    """Return the differentiable function k_f(k_l, k_r) of the module docstring, given w_l as `share`."""

    def ratios(low, high):
        total = share * high + (1 - share) * low
        empty = total == 0
        total = anp.where(empty, 1.0, total)
        return anp.where(empty, 1.0, low / total), anp.where(empty, 1.0, high / total)

    def forward(low, high):
        return low * ratios(low, high)[1]

    def slopes(low, high):
        from_low, from_high = ratios(low, high)
        return share * from_high**2, (1 - share) * from_low**2

    return entrywise("harmonic_average", forward, slopes)
