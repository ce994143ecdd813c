"""Regularization of cell fields: total variation and smoothness. Slopes at walls and obstacles do not contribute."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.pytree import power_of_two
from sparsedp._utils.validation import check_finite, check_kind, check_native, is_number
from sparsedp.autodiff.program_trace import check_values, opaque
from sparsedp.autodiff.tape import dtype_of, plain
from sparsedp.autodiff.tape_constants import constant
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.given import from_matrix
from sparsedp.operators.masks_and_lift import interior
from sparsedp.solvers.scaling import largest

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["smoothness", "total_variation"]

SAFE_SHARE = 2.0**-500  # slopes are divided by at least this multiple of the largest one, so that squares are finite


def total_variation(grid: Grid, eps: float, solid: ArrayLike | None = None) -> Callable[[Any], Any]:
    """Return a function that computes the smoothed total variation of a cell field, the integral of |grad u|.

    As a penalty it removes oscillations and preserves edges.

    Parameters
    ----------
    grid : Grid
    eps : float
        Smoothing parameter, > 0 [unit / length]. The integrand is close to |grad u| where |grad u| is much larger than
        eps, and close to |grad u|^2 / (2 eps) where it is much smaller. For jumps of height J between cells of width
        h, 0.01 J / h is a good first choice: with a larger eps jumps are smoothed, with a smaller one `minimize` needs
        more iterations.
    solid : bool array, shape `grid.shape`, optional
        True for cells that are excluded. Slopes on their faces do not contribute.

    Returns
    -------
    callable
        ``tv(u)`` takes u of shape `grid.shape` [unit] and returns a number [unit length^(dim - 1)]. It can be
        differentiated to any order.

    Raises
    ------
    ValueError
        If eps is not a number between 1e-150 and 1e150.
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        When the function is called, if u is complex.
    NonFiniteError
        When the function is called, if a slope is NaN or infinite.

    See Also
    --------
    smoothness, minimize

    Notes
    -----
    The value is the sum over cells of volume (sqrt(g^2 + eps^2) - eps). Here g^2 is the sum over the axes of the mean
    squared slope on those faces of the cell that are neither walls nor faces of a solid cell. Therefore a linear field
    has the same g^2 in all cells, also next to walls. A jump across one face contributes to g^2 in both cells of the
    face, each time as a mean of two faces; in total it counts sqrt(2) times its height.

    References
    ----------
    L. I. Rudin, S. Osher, E. Fatemi, Nonlinear total variation based noise removal algorithms, Physica D 60, 1992.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> tv = total_variation(Grid(4, size=1.0), 1e-6)
    >>> print(f"{tv(np.array([0.0, 0.0, 3.0, 3.0])):.3f}")
    4.243
    """
    if not (is_number(eps) and 1e-150 < eps < 1e150):  # so that eps^2 neither underflows nor overflows
        raise ValueError(f"total_variation needs eps > 0, a slope that counts as small, got {eps!r}")
    squared_slope, volumes = _squared_slope(grid, "total_variation", solid)

    def integral(u):
        square, unit = squared_slope(u, eps)
        scaled_eps = eps / unit
        # This quotient equals sqrt(g^2 + eps^2) - eps, but avoids cancellation.
        return unit * anp.sum(volumes * square / (anp.sqrt(square + scaled_eps**2) + scaled_eps))

    integral.__name__ = "total_variation"
    return ReconstructibleFunction(
        opaque(integral), total_variation, grid, eps, constant(solid)
    )  # the unit is a decision


def smoothness(grid: Grid, solid: ArrayLike | None = None) -> Callable[[Any], Any]:
    """Return a function that computes half the integral of |grad u|^2 of a cell field, the squared H1 seminorm / 2.

    As a penalty it favours smooth fields.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, optional
        True for cells that are excluded. Slopes on their faces do not contribute.

    Returns
    -------
    callable
        ``h1(u)`` takes u of shape `grid.shape` [unit] and returns a number [unit^2 length^(dim - 2)]. It can be
        differentiated to any order.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        When the function is called, if u is complex.
    NonFiniteError
        When the function is called, if a squared slope is NaN or overflows.

    See Also
    --------
    total_variation, minimize

    Notes
    -----
    The value is 1/2 times the sum over cells of volume g^2, with g^2 as in `total_variation`.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> print(smoothness(Grid(4, size=1.0))(np.array([0.0, 1.0, 2.0, 3.0])))
    8.0
    """
    squared_slope, volumes = _squared_slope(grid, "smoothness", solid)

    def integral(u):
        square, _ = squared_slope(u)
        return 0.5 * anp.sum(volumes * square)

    return ReconstructibleFunction(integral, smoothness, grid, constant(solid))


def _squared_slope(grid, name, solid):
    """Return a function that computes the squared slope g^2 of a field in each cell, and the volumes of the cells.

    Solid cells get volume 0. The function ``squared_slope(u, small=None)`` returns g^2 / unit^2 and `unit`. If `small`
    is given, `unit` is a power of two near `small`, or larger if the squares would overflow; otherwise it is 1.
    """
    check_grid(name, grid)
    slope = gradient(grid)
    open_faces = interior(grid, solid)
    cell_and_face = sp.coo_array(abs(divergence(grid).matrix) @ open_faces.matrix != 0)  # open faces of each cell
    cells = cell_and_face.row
    faces = cell_and_face.col
    axis_of_face = np.repeat(np.arange(grid.dim), np.diff(grid.faces.offsets))
    cell_and_axis = grid.dim * cells + axis_of_face[faces]
    weights = 1 / np.bincount(cell_and_axis)[cell_and_axis]  # weights of the mean over the open faces along an axis
    matrix = sp.csr_array((weights, (cells, faces)), cell_and_face.shape)
    mean = from_matrix(matrix, grid.faces, grid.cells, name="mean over faces")
    volumes = grid.volumes
    if solid is not None:
        volumes = np.where(solid, 0.0, grid.volumes)

    def squared_slope(u, small=None):
        check_native(name, u)
        check_kind(f"u of {name}", dtype_of(u), "real numbers", "; add the values of u.real and u.imag")
        slopes = open_faces(slope(u))
        unit = 1.0
        if small is not None:
            largest_slope = largest(np.asarray(plain(slopes)))
            if not np.isfinite(largest_slope):
                largest_slope = 0.0
            unit = power_of_two(max(small, largest_slope * SAFE_SHARE))
        if unit != 1:
            slopes = slopes / unit
        square = mean(slopes**2)
        check_values(partial(check_finite, f"the squared slope in {name}"), square)
        return square, unit

    return squared_slope, volumes
