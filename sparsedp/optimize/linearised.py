"""The Jacobian of a function of a tree at one point: products with it, and all of it when it fits."""

import numpy as np
from scipy.linalg.lapack import dtrtri

from sparsedp.derivative import pullback
from sparsedp.direction import push
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.fields import check_finite
from sparsedp.tape import is_variable
from sparsedp.tree import leaves

__all__ = ["Linearised", "Restricted"]

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
    forward : bool
        No tape is made before J^T is asked for.

    Raises
    ------
    DerivativeError
        If the outputs are complex or a scalar.
    NonFiniteError
        If an output is NaN or infinite.
    """

    def __init__(self, outputs, packing, vector, rest=(), forward=False):
        self._outputs, self._packing = lambda x: outputs(x, *rest), packing
        self._tree, self._pull, self._jacobian = packing.unpack(vector), None, None
        if forward:
            self.value = self._outputs(self._tree)
        else:
            self.value, self._pull = pullback(self._outputs, self._tree)
        if np.ndim(self.value) == 0:
            raise DerivativeError("the outputs are one number; return the residuals as an array, do not sum them")
        if np.iscomplexobj(self.value) or packing.complex:
            raise DerivativeError("this method takes real numbers, got complex ones; split them into two real arrays")
        check_finite("an output", self.value)
        self.flat = self.value.reshape(-1).astype(float)
        self.shape = (self.flat.size, packing.size)

    def like(self, g):
        """A cotangent of the outputs, flat."""
        if np.shape(g) != self.value.shape:
            raise ShapeError(f"the cotangent must have the shape {self.value.shape} of the outputs, got {np.shape(g)}")
        check_finite("the cotangent", g)
        return np.asarray(g, dtype=float).reshape(-1)

    def pull(self, w):
        """(m,) -> J^T w, (n,)."""
        if self._pull is None:
            self._pull = pullback(self._outputs, self._tree)[1]
        return self._packing.pack_gradient(self._pull(w.reshape(self.value.shape).astype(self.value.dtype)))

    def push(self, v):
        """(n,) -> J v, (m,)."""
        tangents = [leaf if is_variable(leaf) else None for leaf in leaves(self._packing.unpack(v))]
        return push(self._outputs, self._tree, tangents)[1].reshape(-1).astype(float)

    def slope(self, formed):
        """J^T times the outputs, (n,); `formed`: from J itself."""
        return self.flat @ self.rows() if formed else self.pull(self.flat)

    def rows(self, apart=False):
        """J, m x n, by a product for each column or for each row, whichever are fewer.

        `apart`: the outputs along axis 0 depend on nothing but their own copy of x. Then x is handed over with a
        leading axis of copies, one for each of the s samples, and m / s products with J^T give all rows.
        """
        if self._jacobian is None:
            rows, columns = self.shape
            if apart:
                self._jacobian = self._rows_apart()
            elif columns < rows:
                self._jacobian = _by_products(self.push, columns, rows).T
            else:
                self._jacobian = _by_products(self.pull, rows, columns)
        return self._jacobian

    def covariance(self, apart=False):
        """s^2 (J^T J)^(-1), n x n, with s^2 = |outputs|^2 / (m - n); infinite where J has not the rank n."""
        jacobian, (rows, columns) = self.rows(apart), self.shape
        sizes = np.linalg.norm(jacobian, axis=0)  # in units of its columns no unknown is small beside another
        r = np.linalg.qr(np.divide(jacobian, sizes, out=np.zeros(self.shape), where=sizes > 0), mode="r")
        with np.errstate(all="ignore"):
            inverse = dtrtri(r)[0] / sizes[:, None]
            if not np.linalg.norm(r) * np.linalg.norm(inverse * sizes[:, None]) < 1 / (rows * np.finfo(float).eps):
                return np.full((columns, columns), np.inf)
        return float(np.dot(self.flat, self.flat)) / (rows - columns) * (inverse @ inverse.T)

    def _rows_apart(self):
        samples = len(self.value)
        copies = self._packing.copies(self._tree, samples)
        value, pull = pullback(self._outputs, copies)
        if value.shape != self.value.shape:
            raise ShapeError(NOT_APART.format(samples))
        width = value.size // samples if samples else 0
        jacobian = np.empty((samples, width, self.shape[1]))
        weight = np.zeros((samples, width))
        for column in range(width):
            weight[:, column] = 1.0
            self._packing.pack_copies(pull(weight.reshape(value.shape)), jacobian[:, column])
            weight[:, column] = 0.0
        jacobian = jacobian.reshape(self.shape)
        # A function that looks at one copy alone gives outputs of the right shape and wrong rows.
        probe = np.cos(np.arange(self.shape[0]))
        found, known = probe @ jacobian, self.pull(probe)
        if not np.linalg.norm(found - known) <= 1e-6 * np.linalg.norm(known):
            raise ShapeError(NOT_APART.format(samples))
        return jacobian


def _by_products(product, many, size):
    """The products with each unit vector, (many, size)."""
    found, unit = np.empty((many, size)), np.zeros(many)
    for row in range(many):
        unit[row] = 1.0
        found[row] = product(unit)
        unit[row] = 0.0
    return found


class Restricted:
    """A linearisation in which some unknowns stand still: their columns of J are 0.

    A step that counts on unknowns which a bound then holds back is no descent for the others.

    Parameters
    ----------
    whole : Linearised
    free : (n,) bool array
    """

    def __init__(self, whole, free):
        self._whole, self._free = whole, free
        self.flat, self.shape = whole.flat, whole.shape

    def pull(self, w):
        """(m,) -> J^T w, (n,)."""
        return np.where(self._free, self._whole.pull(w), 0.0)

    def push(self, v):
        """(n,) -> J v, (m,)."""
        return self._whole.push(np.where(self._free, v, 0.0))

    def rows(self, apart=False):
        """J, m x n."""
        return np.where(self._free, self._whole.rows(apart), 0.0)
