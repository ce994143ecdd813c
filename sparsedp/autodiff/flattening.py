"""The floating leaves of a tree as one vector of doubles, and back: what a search moves and a check examines."""

from functools import cached_property
from itertools import accumulate, compress

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import copied, labels, paired
from sparsedp._utils.pytree import flatten as taken_apart
from sparsedp._utils.reconstruction import Made
from sparsedp._utils.validation import check_finite, check_leaves, check_native, check_shape
from sparsedp.autodiff.tape import cast, is_variable, isbox
from sparsedp.errors import DerivativeError

__all__ = ["FINITE", "Packing", "flatten", "joined"]

FINITE = "must be finite (dp.check.gradient(loss, x) shows where it comes from)"


def flatten(tree):
    """Tree of arrays -> its numbers as one vector of doubles, and the function from such a vector to a tree.

    For libraries that know flat vectors alone, such as SciPy's minimize with ``jac=True``.

    Parameters
    ----------
    tree : any nesting of tuple, list and dict
        Of arrays and numbers, floating or complex (a complex number takes two). What is not floating (int, bool, None,
        str) is left out of the vector.

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

    def unflatten(vector):
        check_shape("the vector of this tree", vector, (packing.size,), "; write one from dp.flatten of a tree like it")
        if not isbox(vector):
            return packing.unpack(np.asarray(vector, dtype=float))
        return packing.tree(map(_traced, packing.split(vector), packing.values))

    return packing.pack(tree), Made(unflatten, _unflatten, tree)


def _unflatten(tree):
    return flatten(tree)[1]


def _traced(part, value):
    """Part of a traced vector -> a leaf of the shape and dtype of a value."""
    numbers = part[::2] + 1j * part[1::2] if np.iscomplexobj(value) else part
    return cast(anp.reshape(numbers, value.shape), value.dtype)


class Packing:
    """How the floating leaves of a tree lie in one vector.

    Leaves that are not floating (int, bool, None, str) are kept as they are. A complex leaf takes two
    numbers for each entry, the real and the imaginary part.

    Parameters
    ----------
    tree : tree of arrays
    root : str
        What messages call it.

    Attributes
    ----------
    values : list of arrays
        The floating leaves.
    complex : bool
        Whether one of them is.
    eps : float
        Rounding of the coarsest dtype.
    count, size : int
        Of leaves, and of numbers in the vector.
    form : tree
        Of the same structure, the number of each leaf in its place; other trees are paired with it.

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

    def __init__(self, tree, root="x"):
        self.root = root
        self._leaves, self._rebuild = taken_apart(tree)
        self.count = len(self._leaves)
        check_native(root, *self._leaves)
        check_leaves(root, tree)
        self.form = self._rebuild(range(self.count))
        self._floating = list(map(is_variable, self._leaves))
        self.values = [np.asarray(leaf) for leaf in compress(self._leaves, self._floating)]
        if not self.values:
            raise DerivativeError(f"floating values are needed, and {root} holds none; write np.asarray({root}, float)")
        self.complex = any(map(np.iscomplexobj, self.values))
        self.eps = max(float(np.finfo(x.dtype).eps) for x in self.values)
        ends = [0, *accumulate(joined([x]).size for x in self.values)]
        self._parts, self.size = list(map(slice, ends, ends[1:])), ends[-1]

    @cached_property
    def names(self):
        """Of the floating leaves, as one would write them: ``x['u'][0]``."""
        return self.names_under(self.root)

    def names_under(self, root):
        """Return the names of the floating leaves of a tree of the same structure with another name."""
        return list(compress(labels(self.form, root), self._floating))

    def floating(self, tree, name="tree", **options):
        """Return the leaves of a tree of the same structure in the places of the floating ones, see `paired`."""
        return list(compress(paired(tree, self.form, name, **options), self._floating))

    def pack(self, tree):
        """Return a tree of the same structure as a flat vector of doubles."""
        return joined(self.floating(tree))

    def slopes(self, gradient):
        """Gradient of the same structure -> its floating leaves, dL/dRe + i dL/dIm of complex ones.

        The tape gives dL/dRe - i dL/dIm there. Joined, they are the gradient with respect to the packed vector.
        """
        advice = f"; return a tree like {self.root}"
        given = list(map(np.asarray, self.floating(gradient, "gradient", advice=advice, error=DerivativeError)))
        for name, g, x in zip(self.names_under("gradient"), given, self.values):
            if g.shape != x.shape:
                raise DerivativeError(f"{name}: expected shape {x.shape}, got {g.shape}{advice}")
            if g.dtype.kind not in "biufc":
                raise DerivativeError(f"{name}: expected numbers, got dtype {g.dtype}{advice}")
        return [np.conj(g).astype(complex) if np.iscomplexobj(x) else g.real for g, x in zip(given, self.values)]

    def pack_gradient(self, gradient):
        """Finite gradient of the same structure -> flat gradient with respect to the packed vector."""
        slopes = self.slopes(gradient)
        for name, g in zip(self.names, slopes):
            check_finite(f"the gradient of {name}", g, FINITE)
        return joined(slopes)

    def traced(self, tree):
        """The floating leaves of a tree that may be traced, as one traced vector."""
        return anp.concatenate([anp.reshape(leaf, (-1,)) for leaf in self.floating(tree)])

    def split(self, vector):
        """Flat vector -> views of what belongs to each floating leaf."""
        return [vector[part] for part in self._parts]

    def arrays(self, vector):
        """Flat vector -> fresh arrays of the shapes and dtypes of the floating leaves; this rounds."""
        pairs = zip(self.split(vector), self.values)
        return [part.view(np.result_type(x.dtype, float)).astype(x.dtype).reshape(x.shape) for part, x in pairs]

    def tree(self, arrays):
        """Arrays -> the tree with these floating leaves, numbers where the original has numbers."""
        values = iter(arrays)
        pairs = zip(self._leaves, self._floating)
        return self._rebuild(_like(leaf, next(values)) if floating else leaf for leaf, floating in pairs)

    def unpack(self, vector):
        """Flat vector -> fresh tree; every leaf has the type, shape and dtype of its original."""
        return self.tree(self.arrays(vector))


def joined(arrays):
    """Arrays -> one vector of doubles, complex numbers as pairs."""
    return np.concatenate([_doubles(x) for x in arrays])


def _doubles(array):
    """An array of any precision as one vector of doubles."""
    kind = complex if np.iscomplexobj(array) else float
    return np.ravel(array).astype(kind).view(float)


def _like(leaf, value):
    if isinstance(leaf, np.ndarray) or isbox(value):
        return value
    return np.asarray(value)[()] if isinstance(leaf, np.generic) else type(leaf)(value)
