"""Convert the floating leaves of a tree to one float64 vector and back, for minimisation and gradient checks."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.pytree import TreeStructure, copied, leaves
from sparsedp._utils.validation import check_finite, check_leaves, check_native, check_shape
from sparsedp.autodiff.tape import cast, is_variable, isbox
from sparsedp.errors import DerivativeError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["FINITE", "Packing", "flatten", "joined"]

FINITE = "must be finite (dp.check.gradient(loss, x) shows where it comes from)"


def flatten(tree: Any) -> tuple[np.ndarray, Callable]:
    """Convert a tree of arrays to one float64 vector, and return a function that converts such a vector to a tree.

    Use it with libraries that accept only flat vectors, such as SciPy's minimize with ``jac=True``.

    Parameters
    ----------
    tree : any nesting of tuple, list, dict and dataclass
        Its floating leaves, arrays and numbers, form the vector; a complex value takes two entries, the real and the
        imaginary part. Other leaves (int, bool, None, str) are not part of the vector.

    Returns
    -------
    vector : array, shape (n,)
    unflatten : callable
        ``unflatten(vector)`` returns a tree with the structure, shapes and dtypes of `tree`, and with its leaves that
        are not floating. It is differentiable to every order.

    Raises
    ------
    DerivativeError
        If the tree has no floating leaf.
    ShapeError
        When `unflatten` is called with a vector of another length.

    See Also
    --------
    minimize

    Notes
    -----
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> vector, unflatten = flatten({"u": np.array([1.0, 2.0]), "k": 3.0})
    >>> vector
    array([1., 2., 3.])
    >>> unflatten(vector)
    {'u': array([1., 2.]), 'k': 3.0}

    >>> from scipy.optimize import minimize
    >>> from sparsedp import value_and_grad
    >>> loss = lambda p: (p["u"][0] - p["k"]) ** 2 + (p["u"][1] - 5.0) ** 2
    >>> best = minimize(value_and_grad(lambda x: loss(unflatten(x))), vector, jac=True)
    >>> unflatten(best.x)["u"]
    array([2., 5.])
    """
    tree = copied(tree)
    packing = Packing(tree, "tree")
    shape = (packing.size,)

    def unflatten(vector):
        check_shape("the vector of this tree", vector, shape, "; write one from dp.flatten of a tree like it")
        if not isbox(vector):
            return packing.unpack(np.asarray(vector, dtype=float))
        return packing.tree(map(_traced_leaf, packing.split(vector), packing.values))

    return packing.pack(tree), ReconstructibleFunction(unflatten, _unflatten, tree)


def _unflatten(tree):
    return flatten(tree)[1]


def _traced_leaf(part, value):
    """Convert a part of a traced vector to the shape and dtype of a leaf with this value."""
    numbers = part
    if np.iscomplexobj(value):
        numbers = part[::2] + 1j * part[1::2]
    return cast(anp.reshape(numbers, value.shape), value.dtype)


class Packing(TreeStructure):
    """The order of the floating leaves of a tree in one float64 vector.

    Leaves that are not floating (int, bool, None, str) are stored here and are not part of the vector. Each entry of a
    complex leaf takes two entries of the vector, the real and the imaginary part.

    Parameters
    ----------
    tree : tree of arrays
    root : str
        Name of the tree in messages.

    Attributes
    ----------
    values : list of arrays
        The floating leaves.
    complex : bool
        Whether one of the floating leaves is complex.
    eps : float
        Largest machine epsilon of the dtypes.
    size : int
        Length of the vector.

    Raises
    ------
    DerivativeError
        If the tree has no floating leaf.

    Examples
    --------
    >>> packing = Packing({"a": 2.0, "n": 3, "z": 1.0 + 4.0j})
    >>> packing.pack({"a": 2.0, "n": 3, "z": 1.0 + 4.0j})
    array([2., 1., 4.])
    >>> packing.unpack(np.array([5.0, 6.0, 7.0]))
    {'a': 5.0, 'n': 3, 'z': (6+7j)}
    """

    def __init__(self, tree: Any, root: str = "x"):
        check_native(root, *leaves(tree))
        check_leaves(root, tree)
        super().__init__(tree, root, is_variable)
        self._originals = self.variables(tree)
        self.values = [np.asarray(leaf) for leaf in self._originals]
        if not self.values:
            raise DerivativeError(f"floating values are needed, and {root} holds none; write np.asarray({root}, float)")
        self.complex = any(map(np.iscomplexobj, self.values))
        self.eps = max(float(np.finfo(x.dtype).eps) for x in self.values)
        ends = [0, *accumulate(joined([x]).size for x in self.values)]
        self.size = ends[-1]
        self._parts = [slice(start, end) for start, end in zip(ends, ends[1:])]

    def pack(self, tree: Any) -> np.ndarray:
        """Convert a tree of the same structure to a float64 vector."""
        return joined(self.variables(tree))

    def slopes(self, gradient: Any) -> list[np.ndarray]:
        """Return the floating leaves of a gradient, with dL/dRe + i dL/dIm for complex leaves.

        The tape returns the conjugate, dL/dRe - i dL/dIm. Joined to one vector, the leaves are the gradient with
        respect to the packed vector.

        Parameters
        ----------
        gradient : tree
            A tree of the same structure.

        Raises
        ------
        DerivativeError
            If a leaf has another shape or is not numeric.
        """
        advice = f"; return a tree like {self.root}"
        derivatives = self.variables(gradient, "gradient", advice=advice, error=DerivativeError)
        slopes = []
        for name, derivative, x in zip(self.names_under("gradient"), derivatives, self.values):
            g = np.asarray(derivative)
            if g.shape != x.shape:
                raise DerivativeError(f"{name}: expected shape {x.shape}, got {g.shape}{advice}")
            if g.dtype.kind not in "biufc":
                raise DerivativeError(f"{name}: expected numbers, got dtype {g.dtype}{advice}")
            if np.iscomplexobj(x):
                slopes.append(np.conj(g).astype(complex))
            else:
                slopes.append(g.real)
        return slopes

    def pack_gradient(self, gradient: Any) -> np.ndarray:
        """Convert a gradient tree to the gradient with respect to the packed vector; raise an error if not finite."""
        slopes = self.slopes(gradient)
        for name, g in zip(self.names, slopes):
            check_finite(f"the gradient of {name}", g, FINITE)
        return joined(slopes)

    def traced(self, tree: Any) -> Any:
        """Join the floating leaves of a tree, which may be traced, to one vector; differentiable."""
        return anp.concatenate([anp.reshape(leaf, (-1,)) for leaf in self.variables(tree)])

    def split(self, vector: Any) -> list:
        """Return for each floating leaf the view of its part of a flat vector."""
        return [vector[part] for part in self._parts]

    def arrays(self, vector: np.ndarray) -> list[np.ndarray]:
        """Convert a vector to new arrays of the shapes and dtypes of the floating leaves, rounded to these dtypes."""
        arrays = []
        for part, x in zip(self.split(vector), self.values):
            numbers = part.view(np.result_type(x.dtype, float))
            arrays.append(numbers.astype(x.dtype).reshape(x.shape))
        return arrays

    def tree(self, arrays: Any) -> Any:
        """Build the tree with these floating leaves; a leaf that is a number in the original becomes a number."""
        return self.build(list(map(_like, self._originals, arrays)))

    def unpack(self, vector: np.ndarray) -> Any:
        """Convert a flat vector to a new tree, whose leaves have the types, shapes and dtypes of the originals."""
        return self.tree(self.arrays(vector))


def joined(arrays: Sequence) -> np.ndarray:
    """Join arrays to one float64 vector, with complex entries as pairs (real, imaginary)."""
    return np.concatenate([_doubles(x) for x in arrays])


def _doubles(array):
    """Convert an array of any precision to a float64 vector."""
    kind = complex if np.iscomplexobj(array) else float
    return np.ravel(array).astype(kind).view(float)


def _like(leaf, value):
    """Convert a value to the type of a leaf if the leaf is a number; return it unchanged if it is an array."""
    if isinstance(leaf, np.ndarray) or isbox(value):
        return value
    if isinstance(leaf, np.generic):
        return np.asarray(value)[()]
    return type(leaf)(value)
