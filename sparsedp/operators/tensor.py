"""Full tensors: slopes and fluxes at the corners of cells, for div(K grad u) with a matrix K in every cell.

At each of its 2^dim corners a cell sees one face across each axis, and there the slopes g on these faces. With the flux
K g of every corner, the flux through a face is the mean over the corners at its two sides, weighted with volumes:

    div(K grad u) = D Q diag(K) S G,    S: slopes from faces to corners,    Q: fluxes from corners to faces.

The sum over all corners of volume / 2^dim times g.K g is the energy, so that the operator is positive where K is, and,
volumes left aside, symmetric where K is. On a face without a slope (a closed wall, a solid) the flux is 0, and the
slope there is the one that makes it so: it is eliminated from K at the corners beside it.
Source: symmetric discretisations with one gradient a corner, as in Shashkov and Steinberg, J. Comput. Phys. 129, 1996.
"""

from itertools import product

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.validation import EPS, check_finite, check_shape, place
from sparsedp.autodiff.tape import plain
from sparsedp.grid.space import Space
from sparsedp.operators.given import from_matrix
from sparsedp.operators.stencils import along, pick
from sparsedp.operators.structure.kronecker import Kronecker

__all__ = ["check_tensor", "corners"]

NO_DIGITS = 64 * EPS  # share of an entry below which a pivot is rounding


def corners(grid, closed):
    """Grid -> (Operator S, Operator Q, at_corners): see the module.

    Parameters
    ----------
    grid : Grid
    closed : bool array, a field on the faces
        Where there is no slope and no flux.

    Returns
    -------
    S : Operator, faces -> (2^dim, dim, dim, *cells)
        At each corner, for each entry K_ij, the slope along axis j.
    Q : Operator, (2^dim, dim, dim, *cells) -> faces
    at_corners : callable
        K of shape (dim, dim, *cells) -> K at the corners, differentiable.
    """
    dim, volumes = grid.dim, grid.volumes.reshape(-1)
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
    return S, Q, lambda K: anp.array([_eliminated(K, faces) for faces in shut])


def _face_beside(grid, axis, upper):
    """Sparse matrix: faces -> cells, the lower (upper) face across an axis."""
    blocks = {(0, axis): along(axis, grid.dim, pick(grid, axis, upper))}
    return Kronecker(grid.cells.parts, grid.faces.parts, blocks).explicit()


def _eliminated(K, closed):
    """K without the axes whose flux is 0 where `closed` (one field for each axis) says so."""
    for axis, shut in enumerate(closed):
        if np.any(shut):
            K = K - anp.where(shut, K[:, axis, None] * (K[None, axis] / K[axis, axis]), 0.0)
    return K


def check_tensor(name, K, grid):
    """Refuse what is not a positive definite matrix (its symmetric, real part) in every cell."""
    values, shape = np.asarray(plain(K)), (grid.dim, grid.dim, *grid.shape)
    check_shape(f"{name}, a tensor for each cell,", values, shape)
    check_finite(name, values)
    rest = 0.5 * (values + values.swapaxes(0, 1)).real
    for axis in range(grid.dim):  # the pivots of an elimination are positive where the matrix is
        pivot = rest[axis, axis]
        bad = ~(pivot > NO_DIGITS * np.abs(values[axis, axis]))
        if np.any(bad):
            number = int(np.argmax(bad))
            matrix = values.reshape(grid.dim, grid.dim, -1)[..., number].tolist()
            raise ValueError(
                f"{name} must be positive definite in every cell, but in cell {place(number, grid.shape)} it is "
                f"{matrix}; give it eigenvalues > 0"
            )
        rest = rest - rest[:, axis, None] * (rest[None, axis] / pivot)
