"""Discretization of div(K grad u) with a full tensor K in every cell, by gradients at the corners of cells.

At each of the 2^dim corners of a cell, one face for each axis meets. The slopes on these faces form the gradient g at
the corner, and the flux there is K g. The flux through a face is the volume-weighted mean over the corners of its two
cells that touch the face:

    div(K grad u) = D Q diag(K) S G,    S: slopes from faces to corners,    Q: fluxes from corners to faces.

The energy is the sum over all corners of volume / 2^dim times g.K g. Therefore, if K is positive (semi)definite or
symmetric, so is the operator after multiplication by the cell volumes. Through a closed face (a closed wall or a face
of a solid cell) the flux must be 0. This determines the slope on the face, which is eliminated from K at the adjacent
corners.

References
----------
M. Shashkov, S. Steinberg, J. Comput. Phys. 129, 1996 (symmetric discretisations with one gradient for each corner).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import EPS, check_finite, check_shape, place
from sparsedp.grid.space import Space
from sparsedp.operators.given import from_matrix
from sparsedp.operators.stencils import along, pick
from sparsedp.operators.structure.kronecker import Kronecker

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.operator import Operator

__all__ = ["check_tensor", "corners"]

PIVOT_ROUNDING = 64 * EPS  # pivots below this multiple of the original diagonal entry count as 0


def corners(grid: Grid, closed: NDArray) -> tuple[Operator, Operator, Callable]:
    """Return the operators S and Q of the module docstring, and the function that computes the tensors at the corners.

    Parameters
    ----------
    grid : Grid
    closed : bool array, a field on the faces
        True for faces through which the flux is 0.

    Returns
    -------
    S : Operator, faces -> (2^dim, dim, dim, *cells)
        Computes, at each corner and for each entry K_ij, the slope along axis j.
    Q : Operator, (2^dim, dim, dim, *cells) -> faces
        Computes the flux through each face, from the products of the entries K_ij and the slopes.
    at_corners : callable
        ``at_corners(K)`` takes K of shape (dim, dim, *cells) and returns the tensors at the corners. Differentiable.
    """
    dim = grid.dim
    volumes = grid.volumes.reshape(-1)
    beside = [[_adjacent_face(grid, axis, upper) for upper in (0, 1)] for axis in range(dim)]
    sides = list(product((0, 1), repeat=dim))
    at_faces = sum(face.T @ volumes for faces in beside for face in faces)
    shares = 2.0 ** (1 - dim) / np.where(at_faces > 0, at_faces, 1.0)  # 1 / (total volume of the corners at a face)
    picks = {(side, i, j): (beside[i][side[i]], beside[j][side[j]]) for side in sides for i, j in np.ndindex(dim, dim)}
    slopes = sp.vstack([other for _, other in picks.values()])
    fluxes = sp.hstack([one.T * volumes for one, _ in picks.values()])
    space = Space((len(sides), dim, dim, *grid.shape))
    S = from_matrix(slopes, grid.faces, space, name="to corners")
    Q = from_matrix(sp.diags_array(np.where(closed, 0.0, shares)) @ fluxes, space, grid.faces, name="from corners")
    shut = [[(beside[a][side[a]] @ closed > 0).reshape(grid.shape) for a in range(dim)] for side in sides]

    def at_corners(K):
        return anp.array([_eliminated(K, faces) for faces in shut])

    return S, Q, at_corners


def _adjacent_face(grid, axis, upper):
    """Return the matrix from faces to cells that takes the upper (or lower) face of each cell along an axis."""
    blocks = {(0, axis): along(axis, grid.dim, pick(grid, axis, upper))}
    return Kronecker(grid.cells.parts, grid.faces.parts, blocks).explicit()


def _eliminated(K, closed):
    """Return K after elimination of the slopes on closed faces.

    `closed` has one boolean cell field for each axis, which is True where the flux along this axis is 0.
    """
    for axis, shut in enumerate(closed):
        if np.any(shut):
            K = K - anp.where(shut, K[:, axis, None] * (K[None, axis] / K[axis, axis]), 0.0)
    return K


def check_tensor(name: str, K: Any, grid: Grid) -> None:
    """Raise ValueError if the symmetric real part of a tensor is not positive definite in every cell."""
    values = np.asarray(K)
    check_shape(f"{name}, a tensor for each cell,", values, (grid.dim, grid.dim, *grid.shape))
    check_finite(name, values)
    rest = 0.5 * (values + values.swapaxes(0, 1)).real
    for axis in range(grid.dim):  # a symmetric matrix is positive definite if and only if all pivots are positive
        pivot = rest[axis, axis]
        bad = ~(pivot > PIVOT_ROUNDING * np.abs(values[axis, axis]))
        if np.any(bad):
            number = int(np.argmax(bad))
            matrix = values.reshape(grid.dim, grid.dim, -1)[..., number].tolist()
            raise ValueError(
                f"{name} must be positive definite in every cell, but in cell {place(number, grid.shape)} it is "
                f"{matrix}; give it eigenvalues > 0"
            )
        rest = rest - rest[:, axis, None] * (rest[None, axis] / pivot)
