"""What is integrated: u' = c L u + rate(u, params, t) + source(params, t), the checks of its numbers, and arithmetic on
states: an array, or any tree of arrays, plus multiples of others.
"""

import inspect

import numpy as np

from sparsedp.constants import frozen
from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.fields import check_takes, is_number
from sparsedp.operator import Operator
from sparsedp.space import fits
from sparsedp.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.tree import copied, flatten, leaves, mapped

__all__ = ["Problem", "combine", "later", "like", "positive", "untraced"]


def combine(u, *pairs):
    """u + the sum of factor * tree over the pairs (factor, tree), leaf by leaf.

    Parameters
    ----------
    u : tree of arrays
    *pairs : (number or traced number, tree of arrays like u)

    Returns
    -------
    tree like u

    Examples
    --------
    >>> combine((1.0, 2.0), (0.5, (4.0, 8.0)))
    (3.0, 6.0)
    """
    shape = getattr(u, "shape", None)
    if shape is not None and all(getattr(rate, "shape", None) == shape for _, rate in pairs):  # one array: quickly
        for factor, rate in pairs:
            u = u + factor * rate
        return u
    found, rebuild = flatten(u)
    shapes = _shapes(found)
    for factor, tree in pairs:
        rates = leaves(tree)
        if _shapes(rates) != shapes:  # broadcasting a rate into a state would hide a mistake
            given, wanted = (", ".join(map(str, words)) or "nothing" for words in (_shapes(rates), shapes))
            raise ShapeError(f"a rate must have the shape of the state, {wanted}, got {given}")
        found = [leaf if leaf is None else leaf + factor * rate for leaf, rate in zip(found, rates, strict=True)]
    return rebuild(found)


def _shapes(found):
    return [np.shape(leaf) for leaf in found]


def like(new, u):
    """The new state in the dtypes of the old one: rates in double precision do not widen a float32 state."""
    return mapped(_rounded, new, u)


def _rounded(leaf, old):
    kind = dtype_of(old)
    if not is_variable(old) or dtype_of(leaf) == kind:
        return leaf
    if dtype_of(leaf).kind == "c" != kind.kind:
        raise TypeError(f"a rate of complex numbers needs a complex state, got {kind}; write u.astype(complex)")
    return cast(leaf, kind)


def later(t, h):
    """The time t + h, or None where nothing takes a time."""
    return t if t is None else t + h


def untraced(tree):
    """The same tree without a trace."""
    return mapped(plain, tree)


class Problem:
    """The right-hand side of u' = c L u + rate + source, each part optional.

    Parameters
    ----------
    rate, linear, source, timed
        As `stepper` takes them.

    Attributes
    ----------
    op : Operator or None
        L.
    timed : bool
        Whether the state is the pair (u, t).
    driven, moving : bool
        Whether the rate, and whether the source, takes the time.
    linear : bool
        Whether the right-hand side is c L u + source: a step is a linear solve.
    """

    def __init__(self, rate, linear, source, timed):
        if isinstance(rate, Operator):
            if linear is not None:
                raise TypeError("give the operator once: as rate, or as linear with the rest as rate")
            rate, linear = None, (rate, lambda params: 1.0 if params is None else params)
        self.rate, self.source = rate, source
        pair: tuple = linear if isinstance(linear, tuple) and len(linear) == 2 else (linear, 1.0)
        self.op, self._coefficient = pair
        self._check_functions()
        self.driven, self.moving = _takes(rate, 3), _takes(source, 2)
        self.timed = self.driven or self.moving if timed is None else timed
        self.linear = rate is None
        if rate is not None:
            example = "lambda u, params: ... or lambda u, params, t: ..."
            check_takes("stepper", rate, 3 if self.driven else 2, example)

    def _check_functions(self):
        op = self.op
        if op is not None and not isinstance(op, Operator):
            raise TypeError(f"linear takes an Operator or a pair (Operator, coefficient), got {type(op).__name__}")
        if op is not None and not fits(op.domain, op.codomain):
            raise ShapeError(
                f"stepper needs an operator from a space to itself, {op.name} maps {op.domain} to {op.codomain}"
            )
        for name, fun in (("rate", self.rate), ("source", self.source)):
            if fun is not None and not callable(fun):
                raise TypeError(
                    f"{name} must be a function{' or an Operator' * (name == 'rate')}, got {type(fun).__name__}"
                )
        if self.rate is None and op is None:
            raise TypeError("stepper needs a rate, a function rate(u, params) or an Operator, or the option linear")

    def coefficient(self, params):
        """The number c >= 0, traced or not."""
        c, name = self._coefficient, f"the coefficient of {self.op.name}"
        c = number(c(params) if callable(c) else c, name)
        if plain(c) < 0:
            raise ValueError(f"{name} must be >= 0, got {plain(c):g}; put the sign into the operator")
        return c

    def explicit(self, u, params, t):
        """The rate alone, or None; a copy: it may write into the array that it returned before."""
        if self.rate is None:
            return None
        return copied(_unchanged(self.rate, u, (params, t) if self.driven else (params,)))

    def given(self, params, t):
        """The source alone, or None."""
        return None if self.source is None else copied(self.source(*((params, t) if self.moving else (params,))))

    def __call__(self, u, params, t):
        """The whole right-hand side."""
        rest, source = self.explicit(u, params, t), self.given(params, t)
        if source is not None:
            rest = source if rest is None else combine(rest, (1.0, source))
        if self.op is None:
            return rest
        grown = self.op(u) * self.coefficient(params)
        return grown if rest is None else grown + rest


def _takes(fun, least):
    """Whether a function takes this many arguments: then the last one is the time."""
    try:
        found = inspect.signature(fun).parameters.values()
    except (TypeError, ValueError):  # there is none, or it does not tell
        return False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is p.empty for p in found) >= least


def _unchanged(rate, u, args):
    """The rate, which must not write into the state."""
    try:
        return rate(mapped(frozen, u), *args)
    except (TypeError, ValueError) as error:
        if not any("read-only" in str(found) for found in (error, _without_trace(rate, u, args))):
            raise
        raise ValueError(
            "the rate changes the state in place; write u = u + du instead of u += du, or work on a copy"
        ) from None


def _without_trace(rate, u, args):
    """What a rate that fails on traced values raises on plain ones: of a state that is written into NumPy says so."""
    u, args = untraced((u, args))
    try:
        rate(mapped(frozen, u), *args)
    except Exception as error:
        return error


def number(value, name):
    """One finite real number, traced, or as a float, so that a float32 state stays one."""
    known = plain(value)
    if not is_number(known):
        given = f"an array of shape {np.shape(known)}" if isinstance(known, np.ndarray) else repr(known)
        raise TypeError(f"{name} must be one real number, got {given}")
    if not np.isfinite(known):
        raise NonFiniteError(f"{name} must be finite, got {known}")
    return value if isbox(value) else float(known)


def positive(value, name):
    """A number > 0, traced or not."""
    value = number(value, name)
    if plain(value) <= 0:
        raise ValueError(f"{name} must be > 0, got {plain(value):g}")
    return value
