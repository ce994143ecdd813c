"""The Jacobian of a function of a tree at one point: products with it, and its rows when they fit."""

import numpy as np

from sparsedp.derivative import pullback, pushforward
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.fields import check_finite

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

    Raises
    ------
    DerivativeError
        If the outputs are complex or a scalar.
    NonFiniteError
        If an output is NaN or infinite.
    """

    def __init__(self, outputs, packing, vector, rest=()):
        self._outputs, self._packing = outputs, packing
        self._tree, self._rest = packing.unpack(vector), rest
        self.value, self._pull = pullback(lambda x: outputs(x, *rest), self._tree)
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
        return self._packing.pack_gradient(self._pull(w.reshape(self.value.shape).astype(self.value.dtype)))

    def push(self, v):
        """(n,) -> J v, (m,)."""
        direction = self._packing.unpack(v)
        return pushforward(lambda x: self._outputs(x, *self._rest), self._tree, direction)[1].reshape(-1).astype(float)

    def rows(self, apart=False):
        """J, m x n. `apart`: the outputs along axis 0 depend on nothing but their own copy of x.

        Then x is handed over with a leading axis of copies, one for each of the s samples, and m / s products with
        J^T give all rows.
        """
        return self._rows_apart() if apart else self._rows_one_by_one()

    def _rows_one_by_one(self):
        jacobian, unit = np.empty(self.shape), np.zeros(self.shape[0])
        for row in range(self.shape[0]):
            unit[row] = 1.0
            jacobian[row] = self.pull(unit)
            unit[row] = 0.0
        return jacobian

    def _rows_apart(self):
        samples = len(self.value)
        copies = self._packing.copies(self._tree, samples)
        value, pull = pullback(lambda x: self._outputs(x, *self._rest), copies)
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
