"""What is integrated: u' = c L u + rate(u, params, t) + source(params, t), the checks of its numbers, and arithmetic on
states: an array, or any tree of arrays, plus multiples of others. Each field of a tree has a c L of its own, or none.

Where a rate switches, at a time or on a surface of the state, it has two values. Steps that end there need the value
before, steps that begin there the value after. The stepper then passes the params of the rate as `Sided`, and `Problem`
evaluates the rate a rounding error inside the interval, and on the side of the surface where the step began. The shifts
are constants: they have no derivative. So the derivative of a Runge-Kutta stage beyond a surface is that of the smooth
continuation of the rate, to an error of the size of the shift.
"""

import inspect
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.pytree import branches_mapped, copied, flatten, keys, leaves, mapped, paired, subscript
from sparsedp._utils.validation import check_function, check_number, check_takes
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import ShapeError
from sparsedp.grid.space import fits
from sparsedp.operators.operator import Operator

__all__ = [
    "Problem", "Side", "Sided", "combine", "later", "like", "number", "of_fields", "pair", "takes", "unsided",
    "untraced",
]  # fmt: skip


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
    for factor, tree in pairs:
        rates = of_fields(tree, u)
        found = [leaf if leaf is None else leaf + factor * rate for leaf, rate in zip(found, rates, strict=True)]
    return rebuild(found)


def of_fields(tree, u, name="rate"):
    """The leaves of a rate, one for each of the state; broadcasting one into another would hide a mistake."""
    return paired(tree, u, name, advice="; return a tree like the state", shapes=True)


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


def pair(what, value, example):
    """Two things, as they were given."""
    if not (isinstance(value, (tuple, list)) and len(value) == 2):
        raise TypeError(f"{what} must be a pair, got {type(value).__name__}; write {example}")
    return value


def later(t, h):
    """The time t + h, or None where nothing takes a time."""
    return t if t is None else t + h


def untraced(tree):
    """The same tree without a trace."""
    return mapped(plain, tree)


# ---- sides of switching times and surfaces ---------------------------------------------------------------------------


class Side:
    """An interval of time, and the sides of event surfaces, in which a rate is evaluated.

    Parameters
    ----------
    earliest, latest : float
        First and last time at which the rate may be evaluated.
    surfaces : tuple of objects
        ``surface.inside(u, params, t)`` returns the state and time on the right side of it.
    """

    __slots__ = ("earliest", "latest", "surfaces")

    def __init__(self, earliest=-np.inf, latest=np.inf, surfaces=()):
        # Between adjacent numbers there is none: the later one is after both.
        self.earliest, self.latest, self.surfaces = earliest, max(earliest, latest), surfaces

    def time(self, t):
        """The time, clipped to the interval; its derivative is 1."""
        if t is None:
            return None
        known = plain(t)
        inside = min(max(known, self.earliest), self.latest)
        return t if inside == known else t + (inside - known)

    def inside(self, u, params, t):
        """The state and time at which the rate is evaluated in the place of (u, t)."""
        t = self.time(t)
        for surface in self.surfaces:
            u, t = surface.inside(u, params, t)
        return u, t


class Sided(NamedTuple):
    """Params of a rate, and the side of switching times and surfaces on which it is evaluated."""

    params: Any
    side: Side


def unsided(params):
    """The params as the user knows them."""
    return params.params if type(params) is Sided else params


# ---- the right-hand side ---------------------------------------------------------------------------------------------


class Stiff:
    """c L of one field.

    Parameters
    ----------
    op : Operator
        L.
    coefficient : number, or function of params
    place : str
        Where it was given, for messages.
    """

    described = "one operator"

    def __init__(self, op, coefficient, place):
        self.op, self._coefficient = op, coefficient
        self.name = f"the coefficient of {op.name}{place.removeprefix('linear')}"
        if not fits(op.domain, op.codomain):
            raise ShapeError(
                f"stepper needs an operator from a space to itself, {op.name} maps {op.domain} to {op.codomain}"
            )

    def coefficient(self, params):
        """The number c >= 0, traced or not."""
        given = self._coefficient
        given = given(unsided(params)) if callable(given) else given
        return number(given, self.name, ">= 0", "; write a number >= 0, the sign is that of the operator")


def _terms(linear, place):
    """What `linear` holds, with a Stiff in place of each operator and None where there is none."""
    if linear is None or (isinstance(linear, (int, float)) and linear == 0):
        return None
    is_pair = isinstance(linear, tuple) and len(linear) == 2 and not hasattr(linear, "_fields")
    op, coefficient = linear if is_pair else (linear, 1.0)
    if isinstance(op, Operator) and not isinstance(coefficient, (Operator, tuple, list, dict, type(None))):
        return Stiff(op, coefficient, place)
    if keys(linear) is None:
        raise TypeError(f"{place} takes an Operator or a pair (Operator, coefficient), got {type(linear).__name__}")
    return branches_mapped(lambda name: _terms(linear[name], place + subscript(linear, name)), linear)


def _is_none(term):
    """Whether a term stands for a whole branch without a stiff part."""
    return term is None


class Problem:
    """The right-hand side of u' = c L u + rate + source, each part optional.

    Parameters
    ----------
    rate, linear, source, timed
        As `stepper` takes them.

    Attributes
    ----------
    stiff : list of Stiff
        Those of all fields.
    operators : set of Operator
        Every L there is.
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
        self.rate, self.source, self._terms = rate, source, _terms(linear, "linear")
        self.stiff = [term for term in leaves(self._terms) if term is not None]
        self.operators = {term.op for term in self.stiff}
        self._check_functions()
        self.driven, self.moving = takes(rate, 3), takes(source, 2)
        self.timed = self.driven or self.moving if timed is None else timed
        self.linear = rate is None
        if rate is not None:
            example = "lambda u, params: ... or lambda u, params, t: ..."
            check_takes("stepper", rate, 3 if self.driven else 2, example)

    def _check_functions(self):
        for name, fun in (("rate", self.rate), ("source", self.source)):
            if fun is not None:
                check_function(f"stepper, as {name},", fun, f"{name}=lambda {'u, ' * (name == 'rate')}params: ...")
        if self.rate is None and not self.stiff:
            raise TypeError("stepper needs a rate, a function rate(u, params) or an Operator, or the option linear")

    def terms(self, u):
        """The Stiff of each field of a state, None where there is none."""
        advice = "; write None for a field without a stiff part"
        return paired(self._terms, u, "linear", advice=advice, prefix=_is_none, error=TypeError)

    def on_fields(self, act, h, params, u, *trees):
        """act(L, h c, leaf, ...) for each field of the state u, and of trees like it -> a tree like u.

        L is None where nothing is stiff. Where the state holds None it stays.
        """
        found, rebuild = flatten(u)
        rows = zip(self.terms(u), found, *(of_fields(tree, u) for tree in trees), strict=True)

        def on(term, leaf, *row):
            L, z = (term.op, h * term.coefficient(params)) if term else (None, h)
            return leaf if leaf is None else act(L, z, leaf, *row)

        return rebuild([on(*row) for row in rows])

    def explicit(self, u, params, t):
        """The rate alone, or None; a copy: it may write into the array that it returned before."""
        if self.rate is None:
            return None
        if type(params) is Sided:
            u, t = params.side.inside(u, params.params, t)
            params = params.params
        return copied(_unchanged(self.rate, u, (params, t) if self.driven else (params,)))

    def given(self, params, t):
        """The source alone, or None."""
        if self.source is None:
            return None
        if type(params) is Sided:
            t = params.side.time(t)
            params = params.params
        return copied(self.source(*((params, t) if self.moving else (params,))))

    def __call__(self, u, params, t):
        """The whole right-hand side."""
        rest = [self.explicit(u, params, t), self.given(params, t)]
        if self.stiff:
            rest.insert(0, self.on_fields(lambda L, c, leaf: (L(leaf) if L else 0.0 * leaf) * c, 1.0, params, u))
        first, *others = [part for part in rest if part is not None]
        if keys(u) is not None:
            first = flatten(u)[1](of_fields(first, u))
        return combine(first, *((1.0, part) for part in others))


def takes(fun, least):
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


def number(value, name, sign="", advice=""):
    """One finite real number, traced, or as a float, so that a float32 state stays one."""
    check_number(name, plain(value), sign, advice)
    return value if isbox(value) else float(value)
