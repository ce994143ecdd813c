"""The harmonic average of a coefficient: nonlinear, therefore a differentiable rule and not an Operator.

On the face between cells l and r, with the shares w_l = h_l / (h_l + h_r), w_r = 1 - w_l:

    k_f = k_l k_r / (w_l k_r + w_r k_l),   dk_f/dk_l = w_l (k_r / den)^2,   dk_f/dk_r = w_r (k_l / den)^2.

This is the flux-exact conductivity of two layers in series (Patankar, Numerical Heat Transfer and
Fluid Flow, 1980). Where both are 0 the ratios are taken as 1, their value on k_l = k_r.
"""

from __future__ import annotations

from collections.abc import Callable

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.reconstruction import ReconstructibleFunction
from sparsedp._utils.validation import check_finite, check_kind, check_native, check_on
from sparsedp.autodiff.backend import as_field
from sparsedp.autodiff.derivative import entrywise
from sparsedp.autodiff.tape import plain
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.operators.stencils import cell_beside, to_faces

__all__ = ["harmonic_average"]


def harmonic_average(grid: Grid) -> Callable:
    """Return the function from a cell coefficient to its harmonic average on faces, differentiable.

    Parameters
    ----------
    grid : Grid

    Returns
    -------
    callable
        in: k on cells, finite and >= 0 [unit]; out: faces [unit]. A wall face takes the value of its cell.

    Raises
    ------
    ShapeError
        On use, if the coefficient has another shape.
    TypeError
        On use, if a coefficient is complex.
    ValueError
        On use, if a coefficient is negative.
    NonFiniteError
        On use, if a coefficient is NaN or infinite.

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
    below = to_faces("cell below", grid, [cell_beside(grid, axis, False) for axis in axes])
    above = to_faces("cell above", grid, [cell_beside(grid, axis, True) for axis in axes])
    pair = _pair_rule(grid.join(*(_lower_share(grid, axis) for axis in range(grid.dim))))

    def average(k):
        check_native("harmonic_average", k)
        values = as_field(plain(k))
        check_on("harmonic_average", values, grid.cells)
        check_kind("k of harmonic_average", values.dtype, "real numbers", "; write k.real")
        check_finite("harmonic_average", values, "takes a finite coefficient")
        if np.any(np.less(values, 0)):
            raise ValueError(f"harmonic_average needs a coefficient >= 0, got {np.min(values):g}")
        return pair(below(k), above(k))

    return ReconstructibleFunction(average, harmonic_average, grid)


def _lower_share(grid, axis):
    """Return w_l of the module on the faces across an axis, in a shape that broadcasts."""
    low = cell_beside(grid, axis, False).matrix @ grid.widths[axis]
    high = cell_beside(grid, axis, True).matrix @ grid.widths[axis]
    shape = [1] * grid.dim
    shape[axis] = -1
    return (low / (low + high)).reshape(shape)


def _pair_rule(share):
    """Return the differentiable rule of the formula of the module, for fixed shares of the lower cell."""

    def ratios(low, high):
        total = share * high + (1 - share) * low
        empty = plain(total) == 0
        total = anp.where(empty, 1.0, total)
        return anp.where(empty, 1.0, low / total), anp.where(empty, 1.0, high / total)

    def forward(low, high):
        return low * ratios(low, high)[1]

    def slopes(low, high):
        from_low, from_high = ratios(low, high)
        return share * from_high**2, (1 - share) * from_low**2

    return entrywise("harmonic_average", forward, slopes)
