"""The Jacobian of a function of a tree at one point: products with it, and its entries where it is small."""

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

__all__ = ["Linearization", "left_singular"]

MOST_ENTRIES = 3e7  # of a Jacobian that is formed by default (240 MB)
LONGEST_SIDE = 4000  # longest shorter side of a Jacobian that is formed by default
MOST_UNKNOWNS = 4000  # of which the covariance is computed (128 MB)
FIRST_GROUP = 1e-4  # singular values above this share of the largest come from the first Gram matrix
APART_ACCURACY = 1e-6  # relative difference of a row by row Jacobian from the recorded one

NOT_FORMED = (
    "{}; the product of its inverse with v is dp.vjp(residuals, x)[1](dp.jvp(residuals, x, v)[1]), and "
    "scipy.sparse.linalg.cg finds columns of it"
)
NOT_APART = (
    "with apart=True every leaf of x gets a leading axis of {} copies, one for each sample, and the outputs do not "
    "follow them; write a function that broadcasts over it"
)


class Linearization:
    """Outputs y(x) of m numbers at a flat point of n numbers, and their Jacobian J, m x n.

    Parameters
    ----------
    outputs : callable
        ``outputs(x, *batch)`` returns an array of any shape.
    packing : Packing
    vector : (n,) array
    batch : tuple
        The arguments of `outputs` after x.
    apart : bool
        The outputs along axis 0 depend on their own copy of x alone. Then x is given with a leading axis of copies, one
        for each of the s samples, and m / s products with J^T give all rows.
    dense : bool or None
        Whether J is formed; None: if it is small.

    Attributes
    ----------
    value : array
        The outputs.
    flat : (m,) array
        The outputs divided by `scale`. J, and the products with it, are of these m numbers.
    scale : float
        A power of two, 1 at first: see `rescaled`.
    shape : (m, n)
    dense : bool
        Whether J is formed.

    Raises
    ------
    DerivativeError
        If the outputs are complex or a scalar.
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
        if apart:  # products with J^T will be needed, so the outputs are recorded at once
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
        self._by_columns = columns < rows and not apart  # they take fewer products than the rows

    @cached_property
    def _recorded(self):
        """The outputs, and the function from a cotangent to that of x."""
        return pullback(self._outputs, self._tree)

    def restricted(self, free: NDArray[np.bool_]) -> Linearization:
        """Return the same linearization with the columns of J set to 0 where the unknowns are not free."""
        if free.all():
            return self
        other = copy(self)
        other._free = free
        return other

    def rescaled(self, scale: float) -> Linearization:
        """Return the same linearization with outputs and J divided by a power of two; call it before J is formed."""
        other = copy(self)
        other.scale = scale
        other.flat = self.flat / scale
        return other

    def vjp(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J^T w, (n,), of w, (m,)."""
        if self.dense and self._by_columns:  # the columns are formed anyway, and nothing needs to be recorded
            return w @ self.jacobian()
        cotangent = w.reshape(self.value.shape).astype(self.value.dtype)
        return self._free * (self._packing.pack_gradient(self._recorded[1](cotangent)) / self.scale)

    def jvp(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J v, (m,), of v, (n,)."""
        if "_all_columns" in vars(self):
            return self._all_columns @ (self._free * v)
        tangents = [leaf if is_variable(leaf) else None for leaf in leaves(self._packing.unpack(self._free * v))]
        return push(self._outputs, self._tree, tangents)[1].reshape(-1).astype(float) / self.scale

    def jacobian(self) -> NDArray[np.float64]:
        """Return J, m x n."""
        if self._free is True:
            return self._all_columns
        return self._all_columns * self._free

    @cached_property
    def _all_columns(self):
        """J without restriction, by one product for each column or each row, whichever are fewer."""
        rows, columns = self.shape
        if self._apart:
            return self._jacobian_of_samples()
        if self._by_columns:
            return np.array([self.jvp(unit) for unit in np.eye(columns)]).reshape(columns, rows).T
        return np.array([self.vjp(unit) for unit in np.eye(rows)]).reshape(self.shape)

    def _jacobian_of_samples(self):
        """Return J by one product for each output of a sample.

        Raises
        ------
        ShapeError
            If the outputs of a sample do not depend on their own copy of x alone.
        """
        samples = len(self.value)

        def copies(leaf):
            if not is_variable(leaf):
                return leaf
            return np.broadcast_to(leaf, (samples, *np.shape(leaf)))

        value, pull = pullback(self._outputs, mapped(copies, self._tree))
        if value.shape != self.value.shape:
            raise ShapeError(NOT_APART.format(samples))
        width = value.size // max(samples, 1)
        jacobian = np.empty((samples, width, self.shape[1]))
        for column, unit in enumerate(np.eye(width)):
            cotangent = np.broadcast_to(unit, (samples, width)).reshape(value.shape)
            gradients = [np.reshape(leaf, (samples, -1)) for leaf in leaves(pull(cotangent)) if leaf is not None]
            np.concatenate(gradients, axis=1, out=jacobian[:, column])
        jacobian = jacobian.reshape(self.shape) / self.scale
        # A function that uses one copy alone gives outputs of the right shape and wrong rows.
        probe = np.cos(np.arange(self.shape[0]))
        by_rows = self._free * (probe @ jacobian)
        recorded = self.vjp(probe)
        if not np.linalg.norm(by_rows - recorded) <= APART_ACCURACY * np.linalg.norm(recorded):
            raise ShapeError(NOT_APART.format(samples))
        return jacobian

    def covariance(self, absolute_sigma: bool) -> NDArray[np.float64] | str:
        """Return the covariance of the unknowns, (n, n), or a sentence that says why it is not computed.

        Parameters
        ----------
        absolute_sigma : bool
            True: (J^T J)^(-1). False: s^2 (J^T J)^(-1) with s^2 = |outputs|^2 / (m - n).

        Notes
        -----
        Infinite where J has a rank below n.
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
        # Columns of norm 1: then no unknown is small beside another.
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
        with np.errstate(over="ignore"):  # the square of a large x may be infinite
            return root @ root.T


def left_singular(matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r"""Return the left singular vectors and the singular values of a wide matrix, from Gram matrices.

    Parameters
    ----------
    matrix : (k, n) array
        W, with k <= n.

    Returns
    -------
    vectors : (k, k) array
        As columns.
    s : (k,) array
        Falling.

    Raises
    ------
    NonFiniteError
        If W is not finite.

    Notes
    -----
    The Gram matrix W W^T squares the singular values: those above 1e-4 of the largest keep at least eight digits, those
    below 1e-8 are lost in rounding. So the first group, above 1e-4, is taken from it, and the others get a Gram matrix
    of their own. With the eigenvectors E1 (squares q1) and E2 of the two groups, rounding leaves a part of E1 in E2;
    after

        C = q1^-1 E1^T W (E2^T W)^T,    E2 <- E2 - E1 C,    E1 <- E1 + E2 C^T,

    E2^T W has no more of the first group than after Householder's reflections. The same is repeated for W <- E2^T W
    until the second group is empty: one to four times. An SVD of W costs five times as much.
    """
    scale = power_of_two(largest(matrix))  # no square overflows
    scaled = matrix / scale
    with np.errstate(invalid="ignore"):
        gram = scaled @ scaled.T
    check_finite("products of the Jacobian", gram, advice="; start where every output has a finite derivative")
    squares, vectors = scipy.linalg.eigh(gram.T, driver="evd", overwrite_a=True, check_finite=False)
    # Eigenvalues rise, so the second group comes first.
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
