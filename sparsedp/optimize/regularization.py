"""Regularization: total_variation and smoothness of a cell field, walls and obstacles left out."""

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.pytree import power_of_two
from sparsedp._utils.reconstruction import Made
from sparsedp._utils.validation import check_finite, check_kind, check_native, is_number
from sparsedp.autodiff.fast_derivatives import ELSEWHERE
from sparsedp.autodiff.tape import dtype_of, plain
from sparsedp.autodiff.tape_constants import constant
from sparsedp.grid.grid import check_grid
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.given import from_matrix
from sparsedp.operators.masks_and_lift import interior
from sparsedp.solvers.scaling import largest

__all__ = ["smoothness", "total_variation"]

SQUARED = 2.0**-500  # share of the largest slope above which the square of a slope is far from the largest float


def total_variation(grid, eps, solid=None):
    """Grid -> tv(u): the integral of the size of the slope of a cell field. It keeps edges, and removes wiggles.

    Parameters
    ----------
    grid : Grid
    eps : float
        Slopes well above it count by their size, those below by their square: > 0 [unit / length].
    solid : bool array, shape `grid.shape`, optional
        Cells that are left out, with the jumps to them.

    Returns
    -------
    callable
        ``tv(u)``, u of shape `grid.shape` [unit] -> a number [unit length^(dim - 1)], differentiable to every order.

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

    Notes
    -----
    Formula: sum over cells of volume (sqrt(g^2 + eps^2) - eps). Along each axis g^2 is the mean of the squared slopes
    on the faces of a cell that are neither walls nor at a solid: a ramp counts the same in the corner. A jump across
    one face is seen by half from both of its cells, and counts sqrt(2) times its height.
    Source: L. I. Rudin, S. Osher, E. Fatemi, Physica D 60 (1992) 259-268.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> tv = total_variation(Grid(4, size=1.0), 1e-6)
    >>> print(f"{tv(np.array([0.0, 0.0, 3.0, 3.0])):.3f}")
    4.243
    """
    if not (is_number(eps) and 1e-150 < eps < 1e150):  # its square is a number
        raise ValueError(f"total_variation needs eps > 0, a slope that counts as small, got {eps!r}")
    square, volumes = _square(grid, "total_variation", solid)

    def integral(u):
        g, unit = square(u, eps)
        small = eps / unit
        # The quotient is the difference of the formula without its cancellation.
        return unit * anp.sum(volumes * g / (anp.sqrt(g + small**2) + small))

    return Made(integral, total_variation, grid, eps, constant(solid))


def smoothness(grid, solid=None):
    """Grid -> h1(u): half the integral of the squared slope of a cell field. It spreads what is rough.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, optional
        Cells that are left out, with the jumps to them.

    Returns
    -------
    callable
        ``h1(u)``, u of shape `grid.shape` [unit] -> a number [unit^2 length^(dim - 2)], differentiable to every order.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        On use, if u is complex.
    NonFiniteError
        On use, if a squared slope is NaN or beyond 1.8e308.

    Notes
    -----
    Formula: 1/2 sum over cells of volume g^2, g^2 as in `total_variation`.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> print(smoothness(Grid(4, size=1.0))(np.array([0.0, 1.0, 2.0, 3.0])))
    8.0
    """
    square, volumes = _square(grid, "smoothness", solid)
    return Made(lambda u: 0.5 * anp.sum(volumes * square(u)[0]), smoothness, grid, constant(solid))


def _square(grid, name, solid):
    """Return a function of a cell field to its squared slope in the cells, and the volumes of the cells that count.

    The function takes a slope that counts as small, or None, and also returns a power of two that the slopes are
    divided by before they are squared: near the small slope, or so much larger that no square overflows.
    """
    check_grid(name, grid)
    slope, inside = gradient(grid), interior(grid, solid)
    beside = sp.coo_array(abs(divergence(grid).matrix) @ inside.matrix != 0)  # the open faces of each cell
    across = np.repeat(np.arange(grid.dim), np.diff(grid.faces.offsets))[beside.col]
    pair = grid.dim * beside.row + across  # number of a cell and an axis
    matrix = sp.csr_array((1 / np.bincount(pair)[pair], (beside.row, beside.col)), beside.shape)
    mean = from_matrix(matrix, grid.faces, grid.cells, name="mean over faces")
    volumes = grid.volumes if solid is None else np.where(solid, 0.0, grid.volumes)

    def square(u, small=None):
        check_native(name, u)
        check_kind(f"u of {name}", dtype_of(u), "real numbers", "; add that of u.real and that of u.imag")
        slopes, unit = inside(slope(u)), 1.0
        if small is not None and type(plain(u)) not in ELSEWHERE:
            top = largest(np.asarray(plain(slopes)))
            unit = power_of_two(max(small, top * SQUARED if np.isfinite(top) else 0.0))
        g = mean((slopes / unit) ** 2) if unit != 1 else mean(slopes**2)
        check_finite(f"the squared slope in {name}", plain(g))
        return g, unit

    return square, volumes
