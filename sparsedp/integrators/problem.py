"""What is integrated: u' = c L u + rate(u, params, t) + source(params, t), the checks of its numbers, and arithmetic on
states: an array, or any tree of arrays, plus multiples of others.
"""

import inspect

import numpy as np

from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.fields import check_takes, is_number
from sparsedp.fields import frozen as frozen_array
from sparsedp.operator import Operator
from sparsedp.space import fits
from sparsedp.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.tree import copied, flatten, leaves

__all__ = ["Problem", "combine", "frozen", "later", "like", "posed", "positive", "untraced"]


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
    factors = tuple(factor for factor, _ in pairs)
    if not isinstance(u, (tuple, list, dict)):
        rates = [tree for _, tree in pairs]
        if not all(_matches(u, rate) for rate in rates):
            rates = [_checked([u], tree)[0] for tree in rates]
        return _sum(u, factors, rates)
    found, rebuild = flatten(u)
    columns = [_checked(found, tree) for _, tree in pairs]
    return rebuild(_sum(leaf, factors, [rates[n] for rates in columns]) for n, leaf in enumerate(found))


def _matches(leaf, rate):
    """The common case: one array, and a rate of its shape."""
    shape = getattr(leaf, "shape", None)
    return shape is not None and getattr(rate, "shape", None) == shape


def _checked(found, tree):
    """The leaves of a rate. Broadcasting it into a state would hide a mistake."""
    others = leaves(tree)
    shapes = [np.shape(plain(leaf)) for leaf in found]
    theirs = [np.shape(plain(leaf)) for leaf in others]
    if shapes != theirs:
        raise ShapeError(f"a rate must have the shape of the state, {_words(shapes)}, got {_words(theirs)}")
    return others


def _sum(leaf, factors, rates):
    """leaf + the sum of factor * rate."""
    if leaf is None:
        return None
    for factor, rate in zip(factors, rates, strict=True):
        leaf = leaf + factor * rate
    return leaf


def _words(shapes):
    return ", ".join(map(str, shapes)) or "nothing"


def like(new, u):
    """The new state in the dtypes of the old one: rates in double precision do not widen a float32 state."""
    if not isinstance(new, (tuple, list, dict)):
        return new if dtype_of(new) == dtype_of(u) else _rounded(new, u)
    found, rebuild = flatten(new)
    return rebuild(_rounded(leaf, old) for leaf, old in zip(found, leaves(u), strict=True))


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


def frozen(tree):
    """The same tree with arrays that nobody can write into: a rate must not change the state."""
    if not isinstance(tree, (tuple, list, dict)):
        return frozen_array(tree)
    found, rebuild = flatten(tree)
    return rebuild(map(frozen_array, found))


def untraced(tree):
    """The same tree without a trace."""
    found, rebuild = flatten(tree)
    return rebuild(map(plain, found))


class Problem:
    """The right-hand side of u' = c L u + rate + source, each part optional.

    Parameters
    ----------
    rate : callable or None
    op : Operator or None
    coefficient : callable
        ``coefficient(params)``: the number c.
    source : callable or None
    timed : bool
        Whether the state is the pair (u, t).
    whole : bool
        Whether the params are the coefficient itself.

    Attributes
    ----------
    linear : bool
        Whether the right-hand side is c L u + source: a step is a linear solve.
    driven, moving : bool
        Whether the rate, and whether the source, takes the time.
    """

    def __init__(self, rate, op, coefficient, source, timed, whole=False):
        self.rate, self.op, self.source, self.timed, self.whole = rate, op, source, timed, whole
        self._coefficient = coefficient
        self.driven, self.moving = (f is not None and _takes(f, least) for f, least in ((rate, 3), (source, 2)))
        self.linear = op is not None and rate is None

    def coefficient(self, params):
        """The number c >= 0, traced or not."""
        c = self._coefficient(params)
        name = f"the coefficient of {self.op.name}"
        value = _number(c, name)
        if value < 0:
            raise ValueError(f"{name} must be >= 0, got {value:g}; put the sign into the operator")
        return c if isbox(c) else value

    def rest(self, u, params, t):
        """rate + source, or None when there is neither."""
        parts = [part for part in (self.explicit(u, params, t), self.given(params, t)) if part is not None]
        return combine(parts[0], (1.0, parts[1])) if len(parts) == 2 else parts[0] if parts else None

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
        rest = self.rest(u, params, t)
        if self.op is None:
            return rest
        c = self.coefficient(params)
        grown = self.op(u) * c
        return grown if rest is None else grown + rest


def posed(rate, linear, source, timed):
    """The arguments of `stepper` -> Problem."""
    whole = isinstance(rate, Operator)
    if whole and linear is not None:
        raise TypeError("give the operator once: as rate, or as linear with the rest as rate")
    op, coefficient = _linear(rate if whole else linear, whole)
    rate = None if whole else rate
    for name, fun in (("rate", rate), ("source", source)):
        if fun is not None and not callable(fun):
            raise TypeError(
                f"{name} must be a function{' or an Operator' * (name == 'rate')}, got {type(fun).__name__}"
            )
    if rate is not None:
        check_takes("stepper", rate, 3 if _takes(rate, 3) else 2, "lambda u, params: ... or lambda u, params, t: ...")
    if rate is None and op is None:
        raise TypeError("stepper needs a rate, a function rate(u, params) or an Operator, or the option linear")
    if timed is None:
        timed = any(fun is not None and _takes(fun, least) for fun, least in ((rate, 3), (source, 2)))
    return Problem(rate, op, coefficient, source, timed, whole)


def _linear(given, whole):
    """(Operator or None, function params -> coefficient)."""
    if given is None:
        return None, None
    op, coefficient = given if isinstance(given, tuple) and len(given) == 2 else (given, 1.0)
    if not isinstance(op, Operator):
        raise TypeError(f"linear takes an Operator or a pair (Operator, coefficient), got {type(op).__name__}")
    if not fits(op.domain, op.codomain):
        raise ShapeError(
            f"stepper needs an operator from a space to itself, {op.name} maps {op.domain} to {op.codomain}"
        )
    if whole:
        return op, lambda params: 1.0 if params is None else params
    return op, coefficient if callable(coefficient) else lambda params: coefficient


def _takes(fun, least):
    """Whether a function takes this many arguments: then the last one is the time."""
    try:
        found = inspect.signature(fun).parameters.values()
    except (TypeError, ValueError):
        return False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is p.empty for p in found) >= least


def positive(value, name):
    """A number > 0, traced or not; plain ones as float, so that a float32 state stays one."""
    number = _number(value, name)
    if number <= 0:
        raise ValueError(f"{name} must be > 0, got {number:g}")
    return value if isbox(value) else number


def _unchanged(rate, u, args):
    """The rate, which must not write into the state."""
    try:
        return rate(frozen(u), *args)
    except (TypeError, ValueError) as error:
        refused = "read-only" in str(error)
        if not refused and not _writes(rate, u, args):
            raise
        raise ValueError(
            "the rate changes the state in place; write u = u + du instead of u += du, or work on a copy"
        ) from (error if refused else None)


def _writes(rate, u, args):
    """Whether a rate that fails on traced values writes into the state: on plain ones NumPy says so."""
    found, rebuild = flatten((u, args))
    if not any(map(isbox, found)):
        return False
    u, args = rebuild([plain(leaf) for leaf in found])
    try:
        rate(frozen(u), *args)
    except Exception as error:
        return "read-only" in str(error)
    return False


def _number(value, name):
    value = plain(value)
    if not is_number(value):
        given = f"an array of shape {np.shape(value)}" if isinstance(value, np.ndarray) else repr(value)
        raise TypeError(f"{name} must be one real number, got {given}")
    if not np.isfinite(value):
        raise NonFiniteError(f"{name} must be finite, got {value}")
    return float(value)
