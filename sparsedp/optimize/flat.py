"""A tree of arrays as one flat vector of doubles, and back."""

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import DerivativeError
from sparsedp.fields import check_finite
from sparsedp.tape import is_variable
from sparsedp.tree import flatten

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
        self._places = [place for place, leaf in enumerate(self._found) if is_variable(leaf)]
        if not self._places:
            raise DerivativeError("minimize needs floating values in start, and found none; write start.astype(float)")
        leaves = [np.asarray(self._found[place]) for place in self._places]
        self.complex = any(map(np.iscomplexobj, leaves))
        self.eps = max(float(np.finfo(leaf.dtype).eps) for leaf in leaves)
        self._ends = np.cumsum([_numbers(leaf).size for leaf in leaves])
        self.size = int(self._ends[-1])

    def pack(self, tree):
        """Tree of the same structure -> flat vector of doubles."""
        return self.pack_leaves(flatten(tree)[0])

    def pack_leaves(self, leaves):
        """Leaves of a tree of the same structure -> flat vector of doubles."""
        return np.concatenate([_numbers(leaves[place]) for place in self._places])

    def pack_gradient(self, tree):
        """Gradient of the same structure -> flat gradient with respect to the packed vector.

        For a complex leaf the tape gives dL/dRe - i dL/dIm, so its imaginary part changes sign.
        """
        leaves = flatten(tree)[0]
        if len(leaves) != len(self._found):
            raise DerivativeError(
                f"the gradient has {len(leaves)} leaves where start has {len(self._found)}; return a tree like start"
            )
        parts = {}
        for place in self._places:
            g, leaf = np.asarray(leaves[place]), self._found[place]
            if g.shape != np.shape(leaf):
                wanted = f"{np.shape(leaf)} is needed; return a tree like start"
                raise DerivativeError(f"a leaf of the gradient has shape {g.shape} where {wanted}")
            check_finite("the gradient" if len(leaves) == 1 else f"leaf {place} of the gradient", g, FINITE)
            parts[place] = np.conj(g).astype(complex) if np.iscomplexobj(leaf) else g.real
        return self.pack_leaves(parts)

    def unpack(self, vector):
        """Flat vector -> fresh tree; every leaf has the type, shape and dtype of its original."""
        leaves = list(self._found)
        for place, numbers in zip(self._places, np.split(vector, self._ends)):  # one empty part is left over
            leaves[place] = _leaf(leaves[place], numbers)
        return self._rebuild(leaves)

    def join(self, tree):
        """The floating leaves of a tree that may be traced, as one traced vector."""
        leaves = flatten(tree)[0]
        return anp.concatenate([anp.reshape(leaves[place], (-1,)) for place in self._places])

    def copies(self, tree, count):
        """Every floating leaf with a new leading axis of so many copies of itself; read-only, they share memory."""
        leaves = list(flatten(tree)[0])
        for place in self._places:
            leaves[place] = np.broadcast_to(leaves[place], (count, *np.shape(leaves[place])))
        return self._rebuild(leaves)

    def pack_copies(self, tree, count):
        """Tree as `copies` gives it -> one packed row for each copy."""
        leaves = flatten(tree)[0]
        return np.concatenate([np.reshape(leaves[place], (count, -1)) for place in self._places], axis=1)


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
