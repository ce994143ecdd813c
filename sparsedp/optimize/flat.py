"""A tree of arrays as one flat vector of doubles, and back."""

from itertools import compress

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import DerivativeError
from sparsedp.fields import check_finite
from sparsedp.tape import is_variable
from sparsedp.tree import flatten, leaves, mapped

__all__ = ["Packing", "power_of_two"]

FINITE = "must be finite (dp.check.gradient(loss, x) shows where it comes from)"


class Packing:
    """How the floating leaves of a tree lie in one vector.

    Leaves that are not floating (int, bool, None, str) are kept as they are. A complex leaf takes two
    numbers for each entry, the real and the imaginary part.

    Parameters
    ----------
    tree : tree of arrays

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

    def __init__(self, tree):
        self._found, self._rebuild = flatten(tree)
        self._floating = list(map(is_variable, self._found))
        originals = [np.asarray(leaf) for leaf in compress(self._found, self._floating)]
        if not originals:
            raise DerivativeError("minimize needs floating values in start, and found none; write start.astype(float)")
        self.complex = any(map(np.iscomplexobj, originals))
        self.eps = max(float(np.finfo(leaf.dtype).eps) for leaf in originals)
        self._ends = np.cumsum([_numbers(leaf).size for leaf in originals])
        self.size = int(self._ends[-1])

    def pack(self, tree):
        """Tree of the same structure -> flat vector of doubles."""
        return self.pack_leaves(leaves(tree))

    def pack_leaves(self, found):
        """Leaves of a tree of the same structure -> flat vector of doubles."""
        return np.concatenate([_numbers(leaf) for leaf in compress(found, self._floating)])

    def pack_gradient(self, tree):
        """Gradient of the same structure -> flat gradient with respect to the packed vector.

        For a complex leaf the tape gives dL/dRe - i dL/dIm, so its imaginary part changes sign.
        """
        found = leaves(tree)
        if len(found) != len(self._found):
            raise DerivativeError(
                f"the gradient has {len(found)} leaves where start has {len(self._found)}; return a tree like start"
            )
        for place in compress(range(len(found)), self._floating):
            g, leaf = np.asarray(found[place]), self._found[place]
            if g.shape != np.shape(leaf):
                wanted = f"{np.shape(leaf)} is needed; return a tree like start"
                raise DerivativeError(f"a leaf of the gradient has shape {g.shape} where {wanted}")
            check_finite("the gradient" if len(found) == 1 else f"leaf {place} of the gradient", g, FINITE)
            found[place] = np.conj(g).astype(complex) if np.iscomplexobj(leaf) else g.real
        return self.pack_leaves(found)

    def unpack(self, vector):
        """Flat vector -> fresh tree; every leaf has the type, shape and dtype of its original."""
        parts = iter(np.split(vector, self._ends))
        pairs = zip(self._found, self._floating)
        return self._rebuild(_leaf(leaf, next(parts)) if floating else leaf for leaf, floating in pairs)

    def join(self, tree):
        """The floating leaves of a tree that may be traced, as one traced vector."""
        return anp.concatenate([anp.reshape(leaf, (-1,)) for leaf in compress(leaves(tree), self._floating)])

    def copies(self, tree, count):
        """Every floating leaf with a new leading axis of so many copies of itself; read-only, they share memory."""
        return mapped(lambda x: np.broadcast_to(x, (count, *np.shape(x))) if is_variable(x) else x, tree)

    def pack_copies(self, tree, out):
        """Tree as `copies` gives it -> one packed row of `out` for each copy."""
        floating = compress(leaves(tree), self._floating)
        np.concatenate([np.reshape(leaf, (len(out), -1)) for leaf in floating], axis=1, out=out)


def _numbers(values):
    """Entries as doubles, of a complex one both parts."""
    values = np.asarray(values)
    return values.reshape(-1).astype(complex if np.iscomplexobj(values) else float).view(float)


def _leaf(leaf, numbers):
    like = np.asarray(leaf)
    values = numbers.view(complex if np.iscomplexobj(like) else float).reshape(like.shape).astype(like.dtype)
    if isinstance(leaf, (np.ndarray, np.generic)):
        return values if isinstance(leaf, np.ndarray) else values[()]
    return type(leaf)(values)


def power_of_two(value):
    """The power of two next above, so that dividing by it changes no digits."""
    return 2.0 ** float(np.clip(np.frexp(value)[1], -900, 900)) if value > 0 else 1.0
