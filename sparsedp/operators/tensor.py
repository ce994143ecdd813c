"""Full tensors: slopes and fluxes at the corners of cells, for div(K grad u) with a matrix K in every cell.

At each of its 2^dim corners a cell has one face across each axis, with the slopes g on these faces. With the flux
K g of every corner, the flux through a face is the mean over the corners at its two sides, weighted with volumes:

    div(K grad u) = D Q diag(K) S G,    S: slopes from faces to corners,    Q: fluxes from corners to faces.

The sum over all corners of volume / 2^dim times g.K g is the energy, so that the operator is positive where K is, and,
up to the factor of the volumes, symmetric where K is. On a face without a slope (a closed wall, a solid) the flux is 0,
and the slope there is the one for which it is 0: the axis is eliminated from K at the corners beside the face.

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
from sparsedp.autodiff.tape import plain
from sparsedp.grid.space import Space
from sparsedp.operators.given import from_matrix
from sparsedp.operators.stencils import along, pick
from sparsedp.operators.structure.kronecker import Kronecker

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.operator import Operator

__all__ = ["check_tensor", "corners"]

PIVOT_ROUNDING = 64 * EPS  # share of an entry below which a pivot is rounding


def corners(grid: Grid, closed: NDArray) -> tuple[Operator, Operator, Callable]:
    """Return the operators S and Q, and the function from a tensor to tensors at corners: see the module.

    Parameters
    ----------
    grid : Grid
    closed : bool array, a field on the faces
        The faces without slope and flux.

    Returns
    -------
    S : Operator, faces -> (2^dim, dim, dim, *cells)
        At each corner, for each entry K_ij, the slope along axis j.
    Q : Operator, (2^dim, dim, dim, *cells) -> faces
    at_corners : callable
        ``at_corners(K)``, K of shape (dim, dim, *cells): the tensors at the corners, differentiable.
    """
    dim = grid.dim
    volumes = grid.volumes.reshape(-1)
    beside = [[_face_beside(grid, axis, upper) for upper in (0, 1)] for axis in range(dim)]
    sides = list(product((0, 1), repeat=dim))
    at_faces = sum(face.T @ volumes for faces in beside for face in faces)
    shares = 2.0 ** (1 - dim) / np.where(at_faces > 0, at_faces, 1.0)  # of the volume at a face
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


def _face_beside(grid, axis, upper):
    """Return the matrix from faces to cells that takes the lower (upper) face across an axis."""
    blocks = {(0, axis): along(axis, grid.dim, pick(grid, axis, upper))}
    return Kronecker(grid.cells.parts, grid.faces.parts, blocks).explicit()


def _eliminated(K, closed):
    """Return K after elimination of each axis in the cells where its flux is 0; `closed`: a field for each axis."""
    for axis, shut in enumerate(closed):
        if np.any(shut):
            K = K - anp.where(shut, K[:, axis, None] * (K[None, axis] / K[axis, axis]), 0.0)
    return K


def check_tensor(name: str, K: Any, grid: Grid) -> None:
    """Raise ValueError if the symmetric real part of a tensor is not positive definite in every cell."""
    values = np.asarray(plain(K))
    check_shape(f"{name}, a tensor for each cell,", values, (grid.dim, grid.dim, *grid.shape))
    check_finite(name, values)
    rest = 0.5 * (values + values.swapaxes(0, 1)).real
    for axis in range(grid.dim):  # the pivots of an elimination are positive where the matrix is
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
