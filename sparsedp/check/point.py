"""A point in a tree of arrays, and directions to leave it. The tree itself is never touched."""

import numpy as np

from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.tape import is_variable
from sparsedp.tree import copied, flatten, norm

__all__ = ["Point"]

MOST_LEAVES = 8  # with more leaves than this, none gets a direction of its own


class Point:
    """Where a loss is examined.

    Each leaf has a unit: the root mean square of its values (1 if they are all 0). A step of size t
    moves every leaf by t times its unit, so that leaves of different physical size are all examined.

    Parameters
    ----------
    x : tree of arrays
    """

    def __init__(self, x):
        self._found, self._rebuild = flatten(x)
        self.places = [place for place, leaf in enumerate(self._found) if is_variable(leaf)]
        if not self.places:
            raise DerivativeError("a gradient is checked at floating values, and x holds none; write x.astype(float)")
        self.values = [np.array(self._found[place]) for place in self.places]
        paths = list(_paths(x))
        self.names = [paths[place] or "x" for place in self.places]
        for name, values in zip(self.names, self.values, strict=True):
            if not np.all(np.isfinite(values)):
                raise NonFiniteError(f"a gradient is checked at finite values, and {name} holds NaN or infinity")
        self.units = [_rms(values) or 1.0 for values in self.values]
        self.size = sum(values.size for values in self.values)
        self.eps = max(float(np.finfo(values.dtype).eps) for values in self.values)

    def tree(self, values=None, exact=True):
        """The tree with other floating leaves, of the types of the originals if `exact`; always fresh copies."""
        leaves = copied(self._found)
        for place, value in zip(self.places, self.values if values is None else values, strict=True):
            leaves[place] = _like(self._found[place], value) if exact else value
        return self._rebuild(leaves)

    def moved(self, direction, step):
        """Values at x + step * direction, rounded to the dtype of each leaf."""
        return [(x + step * d).astype(x.dtype) for x, d in zip(self.values, direction, strict=True)]

    def away(self, values):
        """Displacement from x to other values, in double precision: what the rounding left of the step."""
        return [y.astype(_wide(y)) - x for x, y in zip(self.values, values, strict=True)]

    def leaves_of(self, tree):
        """The floating leaves of a tree of the same structure, such as a gradient."""
        leaves = flatten(tree)[0]
        if len(leaves) != len(self._found):
            raise DerivativeError(f"the gradient has {len(leaves)} leaves where x has {len(self._found)}")
        found = [np.asarray(leaves[place]) for place in self.places]
        for name, x, g in zip(self.names, self.values, found, strict=True):
            if g.shape != x.shape:
                raise DerivativeError(f"the gradient of {name} has shape {g.shape} where {x.shape} is needed")
        return [g.astype(_wide(g)) for g in found]

    def directions(self, gradient, count, rng):
        """Names and displacements: random ones, and structured ones that see what random ones average away."""
        if self.size == 0:
            return
        pairs = list(zip(self.units, self.values, strict=True))
        for number in range(count):
            yield f"random {number + 1}", [unit * _normal(rng, x) for unit, x in pairs]
        if 1 < len(self.places) <= MOST_LEAVES:
            for chosen, name in enumerate(self.names):
                alone = [unit * _normal(rng, x) * (place == chosen) for place, (unit, x) in enumerate(pairs)]
                if alone[chosen].size:
                    yield f"random in {name}", alone
        if self.size == 1:
            return
        yield "constant", [unit * np.ones_like(x, _wide(x)) for unit, x in zip(self.units, self.values, strict=True)]
        slopes = [unit * np.where(np.isfinite(g), g, 0.0) for unit, g in zip(self.units, gradient, strict=True)]
        largest = [np.max(np.abs(s), initial=0.0) for s in slopes]
        if max(largest) > 0:
            yield "gradient", self._steepest(slopes, max(largest))
            yield "largest entry", self._single(slopes, int(np.argmax(largest)))

    def _steepest(self, slopes, largest):
        """Along the gradient, as the units measure it; no entry moves more than 4 units."""
        slopes = [np.conj(s / largest) for s in slopes]
        rms = np.sqrt(sum(np.sum(np.abs(s) ** 2) for s in slopes) / self.size)
        return [unit * s / max(rms, 0.25) for unit, s in zip(self.units, slopes, strict=True)]

    def _single(self, slopes, chosen):
        moves = [np.zeros(x.shape, _wide(x)) for x in self.values]
        place = np.unravel_index(int(np.argmax(np.abs(slopes[chosen]))), slopes[chosen].shape)
        moves[chosen][place] = self.units[chosen]
        return moves


def _rms(values):
    return norm(values.astype(_wide(values))) / np.sqrt(max(values.size, 1))


def _wide(values):
    return np.complex128 if values.dtype.kind == "c" else np.float64


def _normal(rng, x):
    """Random values of root mean square 1."""
    values = np.asarray(rng.standard_normal(x.shape))
    if x.dtype.kind == "c":
        values = values + 1j * rng.standard_normal(x.shape)
    return values / (_rms(values) or 1.0)


def _like(leaf, value):
    if isinstance(leaf, (float, complex)) and not isinstance(leaf, np.generic):
        return type(leaf)(value)
    return np.array(value) if isinstance(leaf, np.ndarray) else value.dtype.type(value)


def _paths(tree, prefix=""):
    """How each leaf is reached, in the order of flatten."""
    if isinstance(tree, dict):
        for key, branch in tree.items():
            yield from _paths(branch, f"{prefix}[{key!r}]")
    elif isinstance(tree, (tuple, list)):
        names = getattr(tree, "_fields", None)
        for place, branch in enumerate(tree):
            yield from _paths(branch, f"{prefix}.{names[place]}" if names else f"{prefix}[{place}]")
    else:
        yield f"x{prefix}" if prefix else ""
