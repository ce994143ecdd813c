"""The Jacobian of a function of a tree at one point: products with it, and all of it when it fits."""

from copy import copy
from functools import cached_property

import numpy as np
import scipy.linalg

from sparsedp._utils.pytree import leaves, mapped, power_of_two
from sparsedp._utils.validation import EPS, check_finite
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import is_variable
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.solvers.scaling import largest

__all__ = ["Linearised", "singular"]

DENSE, DENSE_SIDE = 3e7, 4000  # entries of a Jacobian (240 MB), and its shorter side, above which it is not formed
MOST = 4000  # unknowns of which the covariance is found, 128 MB
GRADE = 1e-4  # singular values below this share of the largest wait for a Gram matrix of their own

NOT_FORMED = (
    "{}; the product of its inverse with v is dp.vjp(residuals, x)[1](dp.jvp(residuals, x, v)[1]), and "
    "scipy.sparse.linalg.cg finds columns of it"
)
NOT_APART = (
    "with apart=True every leaf of x gets a leading axis of {} copies, one for each sample, and the outputs do not "
    "follow them; let the function broadcast over it"
)


class Linearised:
    """Outputs y(x) of m numbers at a flat point of n numbers, and their Jacobian J, m x n.

    Parameters
    ----------
    outputs : callable
        ``outputs(x, *rest) -> array``, of any shape.
    packing : Packing
    vector : (n,) array
    rest : tuple
        What `outputs` is given after x.
    apart : bool
        The outputs along axis 0 depend on nothing but their own copy of x. Then x is handed over with a leading axis
        of copies, one for each of the s samples, and m / s products with J^T give all rows.
    dense : bool or None
        Whether J is formed; None: when it is small.

    Attributes
    ----------
    value : array
        The outputs.
    flat : (m,) array
        The outputs divided by `scale`. J, and the products with it, are those of these m numbers.
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

    def __init__(self, outputs, packing, vector, rest=(), apart=False, dense=None):
        self._outputs, self._packing, self._apart = lambda x: outputs(x, *rest), packing, apart
        self._tree, self._free, self.scale = packing.unpack(vector), True, 1.0
        # With samples a product with J^T is sure to come.
        self.value = self._taped[0] if apart else np.asarray(self._outputs(packing.unpack(vector)))
        if np.ndim(self.value) == 0:
            raise DerivativeError("the outputs are one number; return the residuals as an array, do not sum them")
        if np.iscomplexobj(self.value) or packing.complex:
            raise DerivativeError("this method takes real numbers, got complex ones; split them into two real arrays")
        check_finite("an output", self.value)
        self.flat = self.value.reshape(-1).astype(float)
        self.shape = rows, columns = self.flat.size, packing.size
        small = rows * columns <= DENSE and min(rows, columns) <= DENSE_SIDE
        self.dense = small if dense is None else dense
        self._forward = columns < rows and not apart  # fewer products give the columns than the rows

    @cached_property
    def _taped(self):
        return pullback(self._outputs, self._tree)

    def among(self, free):
        """Return the same with columns of J set to 0 where the unknowns are not free."""
        if free.all():
            return self
        other = copy(self)
        other._free = free
        return other

    def rescaled(self, scale):
        """Return the same with the outputs, and so J, divided by a power of two. To be called before J is formed."""
        other = copy(self)
        other.scale, other.flat = scale, self.flat / scale
        return other

    def pull(self, w):
        """(m,) -> J^T w, (n,). Columns that are formed anyway spare the tape."""
        if self.dense and self._forward:
            return w @ self.rows()
        g = w.reshape(self.value.shape).astype(self.value.dtype)
        return self._free * (self._packing.pack_gradient(self._taped[1](g)) / self.scale)

    def push(self, v):
        """(n,) -> J v, (m,)."""
        if "_jacobian" in vars(self):
            return self._jacobian @ (self._free * v)
        tangents = [leaf if is_variable(leaf) else None for leaf in leaves(self._packing.unpack(self._free * v))]
        return push(self._outputs, self._tree, tangents)[1].reshape(-1).astype(float) / self.scale

    def rows(self):
        """J, m x n."""
        return self._jacobian if self._free is True else self._jacobian * self._free

    @cached_property
    def _jacobian(self):
        """By a product for each column or for each row, whichever are fewer; apart: for each of a sample."""
        rows, columns = self.shape
        if self._apart:
            return self._rows_apart()
        if self._forward:
            return np.array([self.push(unit) for unit in np.eye(columns)]).reshape(columns, rows).T
        return np.array([self.pull(unit) for unit in np.eye(rows)]).reshape(self.shape)

    def covariance(self, absolute_sigma):
        """Return the covariance of the n unknowns as an n x n array, or a sentence that says why it is not formed.

        (J^T J)^(-1) with absolute_sigma, else s^2 (J^T J)^(-1) with s^2 = |outputs|^2 / (m - n). Infinite where J has
        a rank below n.
        """
        rows, columns = self.shape
        if columns > MOST:
            return NOT_FORMED.format(f"there are {columns} unknowns, and it is formed for up to {MOST}")
        if not self.dense:
            reason = "the Jacobian is not formed (dense=False, or it is large)"
            return NOT_FORMED.format(reason) + "; dense=True forms it"
        if rows <= columns and not absolute_sigma:
            return (
                f"{rows} residuals of {columns} unknowns leave none to estimate their variance from; write "
                "absolute_sigma=True where the residuals have variance 1"
            )
        jacobian = self.rows()
        largest_entries = np.max(np.abs(jacobian), axis=0, initial=0.0)
        largest_entries[largest_entries == 0] = 1.0
        # In units of the norms of its columns no unknown is small beside another.
        sizes = largest_entries * np.linalg.norm(jacobian / largest_entries, axis=0)
        if rows < columns or not np.all(sizes > 0):
            return np.full((columns, columns), np.inf)
        vectors, s = singular((jacobian / sizes).T)
        if not s[-1] > rows * EPS * s[0]:
            return np.full((columns, columns), np.inf)
        inverse = vectors / s
        if absolute_sigma:
            spread = 1 / self.scale
        else:
            spread = np.linalg.norm(self.flat) / np.sqrt(rows - columns)
        inverse = inverse * spread / sizes[:, None]
        with np.errstate(over="ignore"):  # the square of a large x may be infinite
            return inverse @ inverse.T

    def _rows_apart(self):
        samples = len(self.value)
        copies = mapped(
            lambda leaf: np.broadcast_to(leaf, (samples, *np.shape(leaf))) if is_variable(leaf) else leaf, self._tree
        )
        value, pull = pullback(self._outputs, copies)
        if value.shape != self.value.shape:
            raise ShapeError(NOT_APART.format(samples))
        width = value.size // max(samples, 1)
        jacobian = np.empty((samples, width, self.shape[1]))
        for column, unit in enumerate(np.eye(width)):
            one_each = np.broadcast_to(unit, (samples, width)).reshape(value.shape)
            slopes = [np.reshape(slope, (samples, -1)) for slope in leaves(pull(one_each)) if slope is not None]
            np.concatenate(slopes, axis=1, out=jacobian[:, column])
        jacobian = jacobian.reshape(self.shape) / self.scale
        # A function that looks at one copy alone gives outputs of the right shape and wrong rows.
        probe = np.cos(np.arange(self.shape[0]))
        by_rows, by_tape = self._free * (probe @ jacobian), self.pull(probe)
        if not np.linalg.norm(by_rows - by_tape) <= 1e-6 * np.linalg.norm(by_tape):
            raise ShapeError(NOT_APART.format(samples))
        return jacobian


def singular(matrix):
    r"""Wide matrix W (k, n), k <= n -> its left singular vectors (k, k) as columns, and its singular values, falling.

    The Gram matrix W W^T squares the singular values: what is above 1e-4 of the largest keeps eight digits and more,
    what is below 1e-8 is lost in rounding. So those above are taken, and the others get a Gram matrix of their own.
    With the eigenvectors E1 (squares q1) and E2 of the two groups, rounding has left a part of E1 in E2,

        C = q1^-1 E1^T W (E2^T W)^T,    E2 <- E2 - E1 C,    E1 <- E1 + E2 C^T,

    and without it E2^T W has no more of the first group than after Householder's reflections. The same again for
    W <- E2^T W, until no group is left: one to four times, for an SVD of W that costs five times as much.
    Raises NonFiniteError if W is not finite.
    """
    scale = power_of_two(largest(matrix))  # no square overflows
    rows = matrix / scale
    with np.errstate(invalid="ignore"):
        gram = rows @ rows.T
    check_finite("products of the Jacobian", gram, advice="; start where every output has a finite derivative")
    squares, vectors = scipy.linalg.eigh(gram.T, driver="evd", overwrite_a=True, check_finite=False)
    few = int(np.count_nonzero(squares <= GRADE**2 * np.max(squares, initial=0.0)))  # for later; they come first
    few = 0 if few == len(squares) else few
    small, large = vectors[:, :few], vectors[:, few:]
    s = scale * np.sqrt(np.maximum(squares[few:], 0.0))
    if few:
        leak = (large.T @ (rows @ (small.T @ rows).T)) / squares[few:, None]
        small, large = small - large @ leak, large + small @ leak.T
        rest, rest_s = singular(small.T @ rows)
        return np.hstack([large[:, ::-1], small @ rest]), np.concatenate([s[::-1], scale * rest_s])
    return large[:, ::-1], s[::-1]
