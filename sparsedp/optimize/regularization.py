"""Regularization of cell fields: total variation and smoothness, without walls and obstacles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.pytree import power_of_two
from sparsedp._utils.reconstruction import ReconstructibleFunction
from sparsedp._utils.validation import check_finite, check_kind, check_native, is_number
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

SAFE_SHARE = 2.0**-500  # of the largest slope: in units above it the square of the slope does not overflow


def total_variation(grid: Grid, eps: float, solid: ArrayLike | None = None) -> Callable[[Any], Any]:
    """Build the total variation of a cell field: the integral of the size of its slope.

    As a penalty it removes oscillations and keeps edges.

    Parameters
    ----------
    grid : Grid
    eps : float
        Slopes well above it count by their size, those below by their square: > 0 [unit / length].
    solid : bool array, shape `grid.shape`, optional
        Cells that are excluded, with the jumps to them.

    Returns
    -------
    callable
        ``tv(u)`` takes u of shape `grid.shape` [unit] and returns a number [unit length^(dim - 1)], differentiable to
        every order.

    Raises
    ------
    ValueError
        If eps is not a number > 0, from 1e-150 to 1e150.
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        On use, if u is complex.
    NonFiniteError
        On use, if a slope is NaN or infinite.

    See Also
    --------
    smoothness, minimize

    Notes
    -----
    The value is the sum over cells of volume (sqrt(g^2 + eps^2) - eps). g^2 is the sum over the axes of the mean of the
    squared slopes on the faces of a cell that are neither walls nor at a solid: a ramp counts the same in the corner.
    A jump across one face enters both of its cells by half, and counts sqrt(2) times its height.

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
    if not (is_number(eps) and 1e-150 < eps < 1e150):  # its square is a number
        raise ValueError(f"total_variation needs eps > 0, a slope that counts as small, got {eps!r}")
    squared_slope, volumes = _squared_slope(grid, "total_variation", solid)

    def integral(u):
        square, unit = squared_slope(u, eps)
        scaled_eps = eps / unit
        # The quotient equals sqrt(g^2 + eps^2) - eps and has no cancellation.
        return unit * anp.sum(volumes * square / (anp.sqrt(square + scaled_eps**2) + scaled_eps))

    return ReconstructibleFunction(integral, total_variation, grid, eps, constant(solid))


def smoothness(grid: Grid, solid: ArrayLike | None = None) -> Callable[[Any], Any]:
    """Build the smoothness of a cell field: half the integral of its squared slope.

    As a penalty it spreads rough features.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, optional
        Cells that are excluded, with the jumps to them.

    Returns
    -------
    callable
        ``h1(u)`` takes u of shape `grid.shape` [unit] and returns a number [unit^2 length^(dim - 2)], differentiable to
        every order.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        On use, if u is complex.
    NonFiniteError
        On use, if a squared slope is NaN or beyond 1.8e308.

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
    """Return a function that computes the squared slope of a field in each cell, and the volumes of the cells.

    The volume of a solid cell is 0. The function takes a field and optionally a slope that counts as small. It returns
    the squared slope divided by the square of a power of two, and that power: near the small slope, or larger where a
    square would overflow; 1 without a small slope.
    """
    check_grid(name, grid)
    slope = gradient(grid)
    open_faces = interior(grid, solid)
    cell_and_face = sp.coo_array(abs(divergence(grid).matrix) @ open_faces.matrix != 0)  # open faces of each cell
    cells = cell_and_face.row
    faces = cell_and_face.col
    axis_of_face = np.repeat(np.arange(grid.dim), np.diff(grid.faces.offsets))
    cell_and_axis = grid.dim * cells + axis_of_face[faces]
    weights = 1 / np.bincount(cell_and_axis)[cell_and_axis]  # of a mean over the faces of a cell along an axis
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
        check_finite(f"the squared slope in {name}", plain(square))
        return square, unit

    return squared_slope, volumes
