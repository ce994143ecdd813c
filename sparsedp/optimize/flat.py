"""A tree of arrays as one flat vector of doubles, and back."""

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import DerivativeError
from sparsedp.fields import check_finite
from sparsedp.tape import is_variable
from sparsedp.tree import flatten

__all__ = ["Packing"]

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
        self.size = sum(map(self._width, leaves))
        self.complex = any(map(np.iscomplexobj, leaves))
        self.eps = max(float(np.finfo(leaf.dtype).eps) for leaf in leaves)

    @staticmethod
    def _width(leaf):
        return np.size(leaf) * (2 if np.iscomplexobj(leaf) else 1)

    def pack(self, tree):
        """Tree of the same structure -> flat vector of doubles."""
        return self.pack_leaves(flatten(tree)[0])

    def pack_leaves(self, leaves):
        """Leaves of a tree of the same structure -> flat vector of doubles."""
        return np.concatenate([_parts(np.asarray(leaves[place])) for place in self._places])

    def pack_gradient(self, tree):
        """Gradient of the same structure -> flat gradient with respect to the packed vector.

        For a complex leaf the tape gives dL/dRe - i dL/dIm, so its imaginary part changes sign.
        """
        leaves = flatten(tree)[0]
        if len(leaves) != len(self._found):
            raise DerivativeError(
                f"the gradient has {len(leaves)} leaves where start has {len(self._found)}; return a tree like start"
            )
        parts = []
        for place in self._places:
            g, leaf = np.asarray(leaves[place]), self._found[place]
            if g.shape != np.shape(leaf):
                wanted = f"{np.shape(leaf)} is needed; return a tree like start"
                raise DerivativeError(f"a leaf of the gradient has shape {g.shape} where {wanted}")
            check_finite(self._gradient_name(place), g, FINITE)
            parts.append(_parts(np.conj(g).astype(complex) if np.iscomplexobj(leaf) else g.real))
        return np.concatenate(parts)

    def _gradient_name(self, place):
        return "the gradient" if len(self._found) == 1 else f"leaf {place} of the gradient"

    def unpack(self, vector):
        """Flat vector -> fresh tree; every leaf has the type, shape and dtype of its original."""
        leaves, start = list(self._found), 0
        for place in self._places:
            leaf = self._found[place]
            stop = start + self._width(leaf)
            leaves[place] = _leaf(leaf, vector[start:stop])
            start = stop
        return self._rebuild(leaves)

    def join(self, tree):
        """The floating leaves of a tree that may be traced, as one traced vector."""
        leaves = flatten(tree)[0]
        return anp.concatenate([anp.reshape(leaves[place], (-1,)) for place in self._places])

    def copies(self, tree, count):
        """Every floating leaf with a new leading axis of so many copies of itself; read-only, they share memory."""
        leaves = list(flatten(tree)[0])
        for place in self._places:
            leaf = np.asarray(leaves[place])
            leaves[place] = np.broadcast_to(leaf, (count, *leaf.shape))
        return self._rebuild(leaves)

    def pack_copies(self, tree, out):
        """Tree as `copies` gives it -> one packed row of `out` for each copy."""
        leaves, start = flatten(tree)[0], 0
        for place in self._places:
            rows = np.asarray(leaves[place]).reshape(len(out), -1)
            out[:, start : start + rows.shape[1]] = rows
            start += rows.shape[1]


def _parts(values):
    if values.dtype.kind != "c":
        return values.reshape(-1).astype(float)
    return np.stack([values.real, values.imag], axis=-1).reshape(-1).astype(float)


def _leaf(leaf, numbers):
    shape, dtype = np.shape(leaf), np.asarray(leaf).dtype
    if dtype.kind == "c":
        numbers = numbers[0::2] + 1j * numbers[1::2]
    values = numbers.reshape(shape).astype(dtype)
    if isinstance(leaf, np.ndarray):
        return values
    return values.dtype.type(values) if isinstance(leaf, np.generic) else type(leaf)(values)
