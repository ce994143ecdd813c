"""The Jacobian of a function of a tree at one point: products with it, its matrix if it is small, and covariances."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from sparsedp._utils.pytree import leaves, mapped, power_of_two
from sparsedp._utils.validation import EPS, check_finite
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import is_variable
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.solvers.scaling import largest

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["MOST_ENTRIES", "Linearization", "left_singular"]

MOST_ENTRIES = 3e7  # by default, a Jacobian with more entries (240 MB) is not formed
LONGEST_SIDE = 4000  # by default, a Jacobian whose shorter side is longer than this is not formed
MOST_UNKNOWNS = 4000  # the covariance of more unknowns (128 MB) is not computed
FIRST_GROUP = 1e-4  # singular values above this multiple of the largest are taken from the first Gram matrix
SEPARATION_TOLERANCE = 1e-6  # tolerated relative difference of a product with the Jacobian of samples from the VJP

NOT_FORMED = (
    "{}; the product of its inverse with v is dp.vjp(residuals, x)[1](dp.jvp(residuals, x, v)[1]), and "
    "scipy.sparse.linalg.cg finds columns of it"
)
NOT_SEPARATE = (
    "with apart=True every leaf of x gets a leading axis of {} copies, one for each sample, and the outputs do not "
    "follow them; write a function that broadcasts over it"
)


class Linearization:
    """The outputs y of a function at a point x, and their Jacobian J of shape m x n.

    Here m is the number of entries of y, and n the length of the flat vector x.

    Parameters
    ----------
    outputs : callable
        ``outputs(x, *batch)`` returns an array of any shape.
    packing : Packing
    vector : (n,) array
    batch : tuple
        Further arguments of `outputs` after x.
    apart : bool
        True if the outputs along axis 0 belong to s independent samples. `outputs` is then also called with a leading
        axis of s copies of x, one for each sample, so that m / s products with J^T give the whole matrix J.
    dense : bool or None
        Whether J is formed. None: only if it is small.

    Attributes
    ----------
    value : array
        The outputs.
    flat : (m,) array
        The outputs divided by `scale`, as a flat array. J is the Jacobian of this array.
    scale : float
        A power of two, initially 1: see `rescaled`.
    shape : (m, n)
    dense : bool
        Whether J is formed.

    Raises
    ------
    DerivativeError
        If the outputs are complex or a scalar, or if x is complex.
    NonFiniteError
        If an output is NaN or infinite.
    """

    def __init__(
        self,
        outputs: Callable[..., Any],
        packing: Packing,
        vector: NDArray[np.float64],
        batch: tuple[Any, ...] = (),
        apart: bool = False,
        dense: bool | None = None,
    ):
        self._outputs = lambda x: outputs(x, *batch)
        self._packing = packing
        self._apart = apart
        self._tree = packing.unpack(vector)
        self._free: Any = True  # which columns of J are kept
        self.scale = 1.0
        if apart:  # products with J^T will be needed, so record the computation of the outputs now
            self.value = self._recorded[0]
        else:
            self.value = np.asarray(self._outputs(packing.unpack(vector)))
        if np.ndim(self.value) == 0:
            raise DerivativeError("the outputs are one number; return the residuals as an array, do not sum them")
        if np.iscomplexobj(self.value) or packing.complex:
            raise DerivativeError("this method takes real numbers, got complex ones; split them into two real arrays")
        check_finite("an output", self.value)
        self.flat = self.value.reshape(-1).astype(float)
        rows = self.flat.size
        columns = packing.size
        self.shape = rows, columns
        if dense is None:
            dense = rows * columns <= MOST_ENTRIES and min(rows, columns) <= LONGEST_SIDE
        self.dense = dense
        self._by_columns = columns < rows and not apart  # J v for each column takes fewer products than J^T w for rows

    @cached_property
    def _recorded(self):
        """The outputs, and the VJP function from their cotangent to that of x."""
        return pullback(self._outputs, self._tree)

    def restricted(self, free: NDArray[np.bool_]) -> Linearization:
        """Return the same linearization with the columns of J set to 0 for unknowns that are not free."""
        if free.all():
            return self
        other = copy(self)
        other._free = free
        return other

    def rescaled(self, scale: float) -> Linearization:
        """Return the linearization with outputs and J divided by a power of two. Must be called before J is formed."""
        other = copy(self)
        other.scale = scale
        other.flat = self.flat / scale
        return other

    def vjp(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J^T w, an array of shape (n,), for w of shape (m,)."""
        if self.dense and self._by_columns:  # J is needed anyway, and it is computed without recording
            return w @ self.jacobian()
        cotangent = w.reshape(self.value.shape).astype(self.value.dtype)
        return self._free * (self._packing.pack_gradient(self._recorded[1](cotangent)) / self.scale)

    def jvp(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J v, an array of shape (m,), for v of shape (n,)."""
        if "_all_columns" in vars(self):
            return self._all_columns @ (self._free * v)
        tangents = [leaf if is_variable(leaf) else None for leaf in leaves(self._packing.unpack(self._free * v))]
        return push(self._outputs, self._tree, tangents)[1].reshape(-1).astype(float) / self.scale

    def jacobian(self) -> NDArray[np.float64]:
        """Return the matrix J of shape m x n."""
        if self._free is True:
            return self._all_columns
        return self._all_columns * self._free

    @cached_property
    def _all_columns(self):
        """J for all unknowns, free or not, computed by one product for each column or for each row."""
        rows, columns = self.shape
        if self._apart:
            return self._jacobian_of_samples()
        if self._by_columns:
            return np.array([self.jvp(unit) for unit in np.eye(columns)]).reshape(columns, rows).T
        return np.array([self.vjp(unit) for unit in np.eye(rows)]).reshape(self.shape)

    def _jacobian_of_samples(self):
        """Return J, computed by one product with J^T for each output of a sample.

        Raises
        ------
        ShapeError
            If the outputs of a sample depend on the copy of x of another sample.
        """
        samples = len(self.value)

        def copies(leaf):
            if not is_variable(leaf):
                return leaf
            return np.broadcast_to(leaf, (samples, *np.shape(leaf)))

        value, pull = pullback(self._outputs, mapped(copies, self._tree))
        if value.shape != self.value.shape:
            raise ShapeError(NOT_SEPARATE.format(samples))
        width = value.size // max(samples, 1)
        jacobian = np.empty((samples, width, self.shape[1]))
        for column, unit in enumerate(np.eye(width)):
            cotangent = np.broadcast_to(unit, (samples, width)).reshape(value.shape)
            gradients = [np.reshape(leaf, (samples, -1)) for leaf in leaves(pull(cotangent)) if leaf is not None]
            np.concatenate(gradients, axis=1, out=jacobian[:, column])
        jacobian = jacobian.reshape(self.shape) / self.scale
        # If the function uses the copy of one sample for all samples, shapes are right but J is wrong: compare a VJP.
        probe = np.cos(np.arange(self.shape[0]))
        by_rows = self._free * (probe @ jacobian)
        recorded = self.vjp(probe)
        if not np.linalg.norm(by_rows - recorded) <= SEPARATION_TOLERANCE * np.linalg.norm(recorded):
            raise ShapeError(NOT_SEPARATE.format(samples))
        return jacobian

    def covariance(self, absolute_sigma: bool) -> NDArray[np.float64] | str:
        """Return the (n, n) covariance of the unknowns, or a sentence that says why it is not computed.

        Parameters
        ----------
        absolute_sigma : bool
            True: (J^T J)^(-1). False: s^2 (J^T J)^(-1) with s^2 = |outputs|^2 / (m - n).

        Notes
        -----
        All entries are infinite if the rank of J is less than n.
        """
        rows, columns = self.shape
        if columns > MOST_UNKNOWNS:
            return NOT_FORMED.format(f"there are {columns} unknowns, and it is formed for up to {MOST_UNKNOWNS}")
        if not self.dense:
            reason = "the Jacobian is not formed (dense=False, or it is large)"
            return NOT_FORMED.format(reason) + "; dense=True forms it"
        if rows <= columns and not absolute_sigma:
            return (
                f"{rows} residuals of {columns} unknowns do not determine their variance; write absolute_sigma=True "
                "where the residuals have variance 1"
            )
        jacobian = self.jacobian()
        largest_entries = np.max(np.abs(jacobian), axis=0, initial=0.0)
        largest_entries[largest_entries == 0] = 1.0
        # Scale the columns to norm 1, so that the rank test does not depend on the units of the unknowns.
        column_norms = largest_entries * np.linalg.norm(jacobian / largest_entries, axis=0)
        if rows < columns or not np.all(column_norms > 0):
            return np.full((columns, columns), np.inf)
        vectors, s = left_singular((jacobian / column_norms).T)
        if not s[-1] > rows * EPS * s[0]:
            return np.full((columns, columns), np.inf)
        if absolute_sigma:
            sigma = 1 / self.scale
        else:
            sigma = np.linalg.norm(self.flat) / np.sqrt(rows - columns)
        root = vectors / s * sigma / column_norms[:, None]
        with np.errstate(over="ignore"):  # variances of very large unknowns may overflow to infinity
            return root @ root.T


def left_singular(matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r"""Return the left singular vectors and the singular values of a wide matrix, computed from Gram matrices.

    Parameters
    ----------
    matrix : (k, n) array
        The matrix W, with k <= n.

    Returns
    -------
    vectors : (k, k) array
        The left singular vectors, as columns.
    s : (k,) array
        The singular values in descending order.

    Raises
    ------
    NonFiniteError
        If W is not finite.

    Notes
    -----
    The eigenvalues of the Gram matrix W W^T are the squared singular values. Singular values above 1e-4 times the
    largest are obtained with at least eight digits; those below 1e-8 times the largest are lost in rounding. Therefore
    only the first group, above 1e-4, is taken from this matrix, and the others are computed from a second Gram matrix.
    Let E1 and E2 be the eigenvectors of the two groups, and q1 the diagonal matrix of the eigenvalues of the first.
    Rounding errors leave a component of E1 in E2. It is removed by

        C = q1^-1 E1^T W (E2^T W)^T,    E2 <- E2 - E1 C,    E1 <- E1 + E2 C^T,

    so that E2^T W contains no more of the first group than after Householder reflections. The algorithm is then applied
    to W <- E2^T W, and so on until the second group is empty, which takes one to four Gram matrices. An SVD of W is
    five times as expensive.
    """
    scale = power_of_two(largest(matrix))  # so that the squared entries do not overflow
    scaled = matrix / scale
    with np.errstate(invalid="ignore"):
        gram = scaled @ scaled.T
    check_finite("products of the Jacobian", gram, advice="; start where every output has a finite derivative")
    squares, vectors = scipy.linalg.eigh(gram.T, driver="evd", overwrite_a=True, check_finite=False)
    # The eigenvalues are in ascending order, so the second group (small values) comes first.
    second_count = int(np.count_nonzero(squares <= FIRST_GROUP**2 * np.max(squares, initial=0.0)))
    if second_count == len(squares):
        second_count = 0
    second = vectors[:, :second_count]
    first = vectors[:, second_count:]
    first_values = scale * np.sqrt(np.maximum(squares[second_count:], 0.0))
    if second_count == 0:
        return first[:, ::-1], first_values[::-1]
    leak = (first.T @ (scaled @ (second.T @ scaled).T)) / squares[second_count:, None]
    first, second = first + second @ leak.T, second - first @ leak
    rest, rest_values = left_singular(second.T @ scaled)
    return np.hstack([first[:, ::-1], second @ rest]), np.concatenate([first_values[::-1], scale * rest_values])
