"""The floating leaves of a tree as one vector of doubles, and back: the unknowns of a search or of a check."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import TreeStructure, copied, leaves
from sparsedp._utils.reconstruction import ReconstructibleFunction
from sparsedp._utils.validation import check_finite, check_leaves, check_native, check_shape
from sparsedp.autodiff.tape import cast, is_variable, isbox
from sparsedp.errors import DerivativeError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["FINITE", "Packing", "flatten", "joined"]

FINITE = "must be finite (dp.check.gradient(loss, x) shows where it comes from)"


def flatten(tree: Any) -> tuple[np.ndarray, Callable]:
    """Return the numbers of a tree as one vector of doubles, and the function from such a vector to a tree.

    For libraries that accept only flat vectors, such as SciPy's minimize with ``jac=True``.

    Parameters
    ----------
    tree : any nesting of tuple, list, dict and dataclass
        Of arrays and numbers, floating or complex (a complex number takes two). Other leaves (int, bool, None, str)
        have no place in the vector.

    Returns
    -------
    vector : array, shape (n,)
    unflatten : callable
        ``unflatten(vector)``: a tree of the same structure, shapes and dtypes, and with the same leaves that are not
        floating. Differentiable, to every order.

    Raises
    ------
    DerivativeError
        If the tree holds no floating leaf.
    ShapeError
        On use, if a vector has another length.

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
    """Return a part of a traced vector as a leaf of the shape and dtype of a value."""
    numbers = part
    if np.iscomplexobj(value):
        numbers = part[::2] + 1j * part[1::2]
    return cast(anp.reshape(numbers, value.shape), value.dtype)


class Packing(TreeStructure):
    """How the floating leaves of a tree lie in one vector.

    Leaves that are not floating (int, bool, None, str) are kept as they are. A complex leaf takes two
    numbers for each entry, the real and the imaginary part.

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
        Whether one of them is complex.
    eps : float
        Rounding of the coarsest dtype.
    size : int
        Number of numbers in the vector.

    Raises
    ------
    DerivativeError
        If the tree holds no floating leaf.

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
        """Return a tree of the same structure as a flat vector of doubles."""
        return joined(self.variables(tree))

    def slopes(self, gradient: Any) -> list[np.ndarray]:
        """Return the floating leaves of a gradient, dL/dRe + i dL/dIm for complex ones.

        The tape gives dL/dRe - i dL/dIm there. Joined, the leaves are the gradient with respect to the packed vector.

        Parameters
        ----------
        gradient : tree
            Of the same structure.

        Raises
        ------
        DerivativeError
            If a leaf has another shape, or holds no numbers.
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
        """Return a finite gradient of the same structure as the gradient with respect to the packed vector."""
        slopes = self.slopes(gradient)
        for name, g in zip(self.names, slopes):
            check_finite(f"the gradient of {name}", g, FINITE)
        return joined(slopes)

    def traced(self, tree: Any) -> Any:
        """Return the floating leaves of a tree that may be traced as one traced vector."""
        return anp.concatenate([anp.reshape(leaf, (-1,)) for leaf in self.variables(tree)])

    def split(self, vector: Any) -> list:
        """Return the part of a flat vector that belongs to each floating leaf, as views."""
        return [vector[part] for part in self._parts]

    def arrays(self, vector: np.ndarray) -> list[np.ndarray]:
        """Return fresh arrays of the shapes and dtypes of the floating leaves; this rounds."""
        arrays = []
        for part, x in zip(self.split(vector), self.values):
            numbers = part.view(np.result_type(x.dtype, float))
            arrays.append(numbers.astype(x.dtype).reshape(x.shape))
        return arrays

    def tree(self, arrays: Any) -> Any:
        """Return the tree with these floating leaves, numbers where the original has numbers."""
        return self.build(list(map(_like, self._originals, arrays)))

    def unpack(self, vector: np.ndarray) -> Any:
        """Return a flat vector as a fresh tree; every leaf has the type, shape and dtype of its original."""
        return self.tree(self.arrays(vector))


def joined(arrays: Sequence) -> np.ndarray:
    """Return arrays as one vector of doubles, complex numbers as pairs."""
    return np.concatenate([_doubles(x) for x in arrays])


def _doubles(array):
    """Return an array of any precision as one vector of doubles."""
    kind = complex if np.iscomplexobj(array) else float
    return np.ravel(array).astype(kind).view(float)


def _like(leaf, value):
    """Return a value as a number of the type of a leaf, where the leaf is a number."""
    if isinstance(leaf, np.ndarray) or isbox(value):
        return value
    if isinstance(leaf, np.generic):
        return np.asarray(value)[()]
    return type(leaf)(value)
