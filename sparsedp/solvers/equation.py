"""A residual as a function of flat unknowns: what Newton's method and the derivative rules work on."""

from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp.constants import constant
from sparsedp.derivative import pullback, push
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.fields import check_finite, check_plain
from sparsedp.space import Space
from sparsedp.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.tree import flatten, leaves

__all__ = ["Equation", "Layout", "vary"]

KINDS = "biuf"


class Layout:
    """How the unknowns, an array or a tree of arrays, lie in one flat float64 array.

    Parameters
    ----------
    guess : number, array, or tree of arrays
        Its shapes and dtypes count, and where it is traced, nothing else of the trace.
    name : str
        For messages.
    """

    def __init__(self, guess, name):
        found, rebuild = flatten(guess)
        found = [plain(leaf) for leaf in found]
        for leaf in found:
            _check_unknown(leaf, name)
        # Rebuilt without values: a kept layout must not hold a trace or a large array.
        _, self.rebuild = flatten(rebuild([None] * len(found)))
        self.shapes = [np.shape(leaf) for leaf in found]
        kinds = [np.asarray(leaf).dtype for leaf in found]
        self.dtypes = [kind if kind.kind == "f" else np.dtype(float) for kind in kinds]
        self.scalar = isinstance(guess, (int, float)) and not isinstance(guess, np.generic)
        self.space = Space(sum(map(np.size, found)), "unknowns", None, self.shapes)
        self.size = self.space.size

    def flat(self, guess):
        """The numbers of the guess, without a trace, as one fresh float64 array."""
        parts = [np.asarray(plain(leaf), float).reshape(-1) for leaf in leaves(guess)]
        return np.concatenate([np.zeros(0), *parts])

    def split(self, x):
        """Flat unknowns, traced or not -> the tree of unknowns."""
        whole = len(self.shapes) == 1
        return self.rebuild([anp.reshape(x, self.shapes[0])] if whole else self.space.split(x))

    def rounded(self, x):
        """The tree of unknowns in the dtypes of the guess; copies, for the rules go on using x."""
        if self.scalar and not isbox(x):
            return float(x[0])
        take = cast if isbox(x) else np.array
        return self.rebuild(map(take, self.space.split(x), self.dtypes))


def _check_unknown(leaf, name):
    check_plain(name, leaf)
    kind = np.asarray(leaf).dtype.kind
    if kind == "c":
        raise TypeError(f"{name} solves for real unknowns; give real and imaginary part as two fields")
    if kind not in KINDS:
        raise TypeError(f"{name} takes a guess of numbers, got {type(leaf).__name__}")


class Equation:
    """The residual as a function of the flat unknowns and the floating leaves of the parameters.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)``.
    layout : Layout
    params : tuple of trees
        What is not floating (int, bool, None, str) is part of the equation.
    name : str

    Attributes
    ----------
    statics : list
        The leaves of the parameters, None in place of those that are floating.
    left : (int, float) or None
        Check sum and norm of the residual at the root, once Newton's method has found it.
    """

    left: Any = None

    def __init__(self, residual, layout, params, name):
        self.residual, self.layout, self.name = residual, layout, name
        found, rebuild = flatten(params)
        self._places = [place for place, leaf in enumerate(found) if is_variable(leaf)]
        self.statics = [None if is_variable(leaf) else constant(leaf) for leaf in found]
        _, self._rebuild = flatten(rebuild(self.statics))  # of what is not traced only: equations are kept

    @property
    def size(self):
        """Number of unknowns."""
        return self.layout.size

    def variables(self, params):
        """The floating leaves of parameters of this structure, traced or not."""
        found = leaves(params)
        return [found[place] for place in self._places]

    def check_finite(self, values):
        """Refuse NaN and infinity in plain parameters."""
        for number, param in enumerate(self.params(values)):
            for leaf in leaves(param):
                if is_variable(leaf):
                    check_finite(f"parameter {number + 1} of {self.name}", np.asarray(leaf))

    def params(self, values):
        """Floating leaves -> the tuple of parameters."""
        found = list(self.statics)
        for place, value in zip(self._places, values, strict=True):
            found[place] = value
        return self._rebuild(found)

    def __call__(self, x, *values):
        """The flat residual; differentiable in x and the leaves."""
        return self._flat(self.residual(self.layout.split(x), *self.params(values)))

    def value(self, x, values):
        """The flat residual of plain values."""
        with np.errstate(all="ignore"):
            result = self(x, *values)
        if isbox(result):
            raise DerivativeError(
                f"the residual of {self.name} uses a traced value that is not an argument; "
                "make it a parameter of the residual and pass it to the root"
            )
        return result

    def _flat(self, result):
        parts = leaves(result)
        size = sum(int(np.size(plain(part))) for part in parts)
        if size != self.size:
            raise ShapeError(f"the residual of {self.name} must hold {self.size} numbers, as many as x, got {size}")
        if any(dtype_of(part).kind not in KINDS for part in parts):
            raise TypeError(f"the residual of {self.name} must be real; give real and imaginary part as two fields")
        lines = [anp.reshape(part, (-1,)) for part in parts]
        flat = lines[0] if len(lines) == 1 else anp.concatenate(lines) if lines else np.zeros(0)
        return flat if dtype_of(flat) == np.float64 else flat + np.zeros(self.size)

    # ------------------------------------------------------------ products with J = dF/dx

    def tangent(self, x, values):
        """The function v -> J v."""
        return lambda v: push(lambda y: self(y, *values), x, [v])[1]

    def transposed(self, x, values):
        """The function g -> J^T g."""
        return pullback(lambda y: self(y, *values), x)[1]


def vary(fun, args, places):
    """fun(*args) -> (function of the list of the arguments at `places`, that list)."""

    def varied(chosen):
        values = list(args)
        for place, value in zip(places, chosen, strict=True):
            values[place] = value
        return fun(*values)

    return varied, [args[place] for place in places]
