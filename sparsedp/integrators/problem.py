"""The right-hand side of a problem, checks of its arguments, and arithmetic on states.

A problem is u' = c L u + rate(u, params, t) + source(params, t). A state is an array, or any tree of arrays. In a tree
each field has its own coefficient c and operator L, or no such term.

If a rate jumps, at a time or on a surface of the state, it has two values there. A step that ends at the jump needs the
value before it, a step that begins there the value after it. So the stepper passes the params as `SidedParams`, and
`Problem` evaluates the rate at a time inside the interval, shifted by a rounding error, and at a state on the side of
the surface where the step began. The shifts are constants without a derivative. So if a Runge-Kutta stage lies beyond
a surface, its derivative is the derivative of the smooth continuation of the rate, up to an error of the size of the
shift.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.pytree import branches_mapped, child, copied, flatten, keys, leaves, mapped, paired, subscript
from sparsedp._utils.validation import check_function, check_number, check_takes
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import ShapeError
from sparsedp.grid.space import fits
from sparsedp.operators.operator import Operator

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = [
    "Problem",
    "Side",
    "SidedParams",
    "check_pair",
    "combine",
    "field_leaves",
    "time_after",
    "like",
    "real_number",
    "takes_arguments",
    "without_side",
    "untraced",
]


# ---- arithmetic on states --------------------------------------------------------------------------------------------


def combine(u: Any, *pairs: tuple) -> Any:
    """Return u plus the sum of factor * tree over the pairs (factor, tree), computed for each leaf.

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
    if shape is not None and all(getattr(rate, "shape", None) == shape for _, rate in pairs):  # fast path for one array
        for factor, rate in pairs:
            u = u + factor * rate
        return u
    entries, rebuild = flatten(u)
    for factor, tree in pairs:
        rates = field_leaves(tree, u)
        entries = [leaf if leaf is None else leaf + factor * rate for leaf, rate in zip(entries, rates, strict=True)]
    return rebuild(entries)


def field_leaves(tree: Any, u: Any, name: str = "rate") -> list:
    """Return the leaves of a rate in the order of the leaves of the state u.

    Shapes must be equal, because broadcasting one field to the shape of another would hide a mistake.
    """
    return paired(tree, u, name, advice="; return a tree like the state", shapes=True)


def like(new: Any, u: Any) -> Any:
    """Convert a new state to the dtypes of the old one, so that float64 rates do not widen a float32 state."""
    return mapped(_rounded, new, u)


def _rounded(leaf: Any, old: Any) -> Any:
    dtype = dtype_of(old)
    if not is_variable(old) or dtype_of(leaf) == dtype:
        return leaf
    if dtype_of(leaf).kind == "c" != dtype.kind:
        raise TypeError(f"a rate of complex numbers needs a complex state, got {dtype}; write u.astype(complex)")
    return cast(leaf, dtype)


def time_after(t: Any, h: Any) -> Any:
    """Return the time t + h, or None if t is None because nothing depends on the time."""
    if t is None:
        return t
    return t + h


def untraced(tree: Any) -> Any:
    """Return the tree of the plain values of traced leaves."""
    return mapped(plain, tree)


# ---- checks ----------------------------------------------------------------------------------------------------------


def check_pair(name: str, value: Any, example: str) -> Any:
    """Return the value if it is a tuple or list of two entries; raise TypeError otherwise."""
    if not (isinstance(value, (tuple, list)) and len(value) == 2):
        raise TypeError(f"{name} must be a pair, got {type(value).__name__}; write {example}")
    return value


def real_number(value: Any, name: str, sign: str = "", advice: str = "", kind: str = "") -> Any:
    """Check that a value is one finite real number; return it if traced, else as a Python float.

    A Python float does not widen a float32 state to float64. For the last three arguments see `check_number`.
    """

    def check(number: Any) -> None:
        check_number(name, number, sign, advice, kind)

    check_values(check, value)
    if isbox(value):
        return value
    return float(value)


def takes_arguments(fun: Callable | None, least: int) -> bool:
    """Return whether a function has at least this number of required arguments, the last of which is the time."""
    if fun is None:
        return False
    try:
        parameters = inspect.signature(fun).parameters.values()
    except (TypeError, ValueError):  # the function has no signature
        return False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required = [p for p in parameters if p.kind in kinds and p.default is p.empty]
    return len(required) >= least


# ---- sides of switching times and surfaces ---------------------------------------------------------------------------


class Side:
    """The time interval, and the sides of the surfaces of events, to which evaluations of a rate are restricted.

    Parameters
    ----------
    earliest, latest : float
        First and last time at which the rate may be evaluated.
    surfaces : tuple of objects
        ``surface.inside(u, params, t)`` moves the state and time to the required side of the surface.
    """

    __slots__ = ("earliest", "latest", "surfaces")

    def __init__(self, earliest: float = -np.inf, latest: float = np.inf, surfaces: tuple = ()) -> None:
        self.earliest = earliest
        self.latest = max(earliest, latest)  # if two breaks are adjacent floats, no time lies between them
        self.surfaces = surfaces

    def time(self, t: Any) -> Any:
        """Return the time clipped to the interval, with the derivative 1 also if it is clipped."""
        if t is None:
            return None
        value = plain(t)
        clipped = min(max(value, self.earliest), self.latest)
        if clipped == value:
            return t
        return t + (clipped - value)

    def inside(self, u: Any, params: Any, t: Any) -> tuple:
        """Return the state and time at which the rate is evaluated in place of (u, t)."""
        t = self.time(t)
        for surface in self.surfaces:
            u, t = surface.inside(u, params, t)
        return u, t


class SidedParams(NamedTuple):
    """Params of a rate, and the side of breaks and event surfaces on which it is evaluated."""

    params: Any
    side: Side


def without_side(params: Any) -> Any:
    """Return the params as the user passed them."""
    if type(params) is SidedParams:
        return params.params
    return params


# ---- the right-hand side ---------------------------------------------------------------------------------------------


class StiffTerm:
    """The term c L u of one field.

    Parameters
    ----------
    op : Operator
        L.
    coefficient : number, or function of params
    place : str
        Path of the term in the option `linear`, for error messages.
    """

    described = "one operator"

    def __init__(self, op: Operator, coefficient: Any, place: str) -> None:
        self.op = op
        self.name = f"the coefficient of {op.name}{place.removeprefix('linear')}"
        self._coefficient = coefficient
        if not fits(op.domain, op.codomain):
            raise ShapeError(
                f"stepper needs an operator from a space to itself, {op.name} maps {op.domain} to {op.codomain}"
            )

    def coefficient(self, params: Any) -> Any:
        """Return the number c >= 0, traced or not."""
        value = self._coefficient
        if callable(value):
            value = value(without_side(params))
        sign_advice = "; write a number >= 0, the sign belongs to the operator"
        kind_advice = "; write linear=(op, lambda params: ...) with a function that returns the number"
        return real_number(value, self.name, ">= 0", sign_advice, kind_advice)


def _stiff_terms(linear: Any, place: str) -> Any:
    """Convert the option `linear` to a tree with a StiffTerm in place of each operator, and None for no term."""
    if linear is None or (isinstance(linear, (int, float)) and linear == 0):
        return None
    op = linear
    coefficient: Any = 1.0
    if isinstance(linear, tuple) and len(linear) == 2 and not hasattr(linear, "_fields"):
        op, coefficient = linear
    if isinstance(op, Operator) and not isinstance(coefficient, (Operator, tuple, list, dict, type(None))):
        return StiffTerm(op, coefficient, place)
    if keys(linear) is None:
        raise TypeError(f"{place} takes an Operator or a pair (Operator, coefficient), got {type(linear).__name__}")
    return branches_mapped(lambda name: _stiff_terms(child(linear, name), place + subscript(linear, name)), linear)


def _is_none(term: Any) -> bool:
    """Return True for None, which stands for a whole branch without a stiff part."""
    return term is None


def _coefficient_from_params(params: Any) -> Any:
    """Return the coefficient c of a rate that is an Operator: the params, or 1 if they are None."""
    if params is None:
        return 1.0
    return params


class Problem:
    """The right-hand side of u' = c L u + rate + source, each part optional.

    Parameters
    ----------
    rate, linear, source, timed
        Arguments of `stepper`.

    Attributes
    ----------
    stiff : list of StiffTerm
        The terms of all fields.
    operators : set of Operator
        The operators L of all terms.
    timed : bool
        Whether the state is the pair (u, t).
    rate_takes_time, source_takes_time : bool
    linear : bool
        Whether the right-hand side is c L u + source, so that an implicit step is a linear solve.
    """

    def __init__(self, rate: Any, linear: Any, source: Any, timed: bool | None) -> None:
        if isinstance(rate, Operator):
            if linear is not None:
                raise TypeError("give the operator once: as rate, or as linear with the rest as rate")
            linear = (rate, _coefficient_from_params)
            rate = None
        self.rate = rate
        self.source = source
        self._terms = _stiff_terms(linear, "linear")
        self.stiff = [term for term in leaves(self._terms) if term is not None]
        self.operators = {term.op for term in self.stiff}
        self.linear = rate is None
        self._check_functions()
        self.rate_takes_time = takes_arguments(rate, 3)
        self.source_takes_time = takes_arguments(source, 2)
        self.timed = timed
        if timed is None:
            self.timed = self.rate_takes_time or self.source_takes_time
        if rate is not None:
            example = "lambda u, params: ... or lambda u, params, t: ..."
            check_takes("stepper", rate, 3 if self.rate_takes_time else 2, example)

    def _check_functions(self) -> None:
        if self.rate is not None:
            check_function("stepper, as rate,", self.rate, "rate=lambda u, params: ...")
        if self.source is not None:
            check_function("stepper, as source,", self.source, "source=lambda params: ...")
        if self.rate is None and not self.stiff:
            raise TypeError("stepper needs a rate, a function rate(u, params) or an Operator, or the option linear")

    def terms(self, u: Any) -> list:
        """Return a list with the StiffTerm of each field of a state, or None for a field without one."""
        advice = "; write None for a field without a stiff part"
        return paired(self._terms, u, "linear", advice=advice, prefix=_is_none, error=TypeError)

    def on_fields(self, act: Callable, h: Any, params: Any, u: Any, *trees: Any) -> Any:
        """Return the tree of the results act(L, h c, leaf, ...), for the leaves of the state u and of trees like it.

        For a field without a stiff term the call is act(None, h, leaf, ...). A leaf None of the state stays None.
        """
        entries, rebuild = flatten(u)
        rows = zip(self.terms(u), entries, *(field_leaves(tree, u) for tree in trees), strict=True)
        results: list = []
        for term, leaf, *row in rows:
            if leaf is None:
                results.append(None)
            elif term:
                results.append(act(term.op, h * term.coefficient(params), leaf, *row))
            else:
                results.append(act(None, h, leaf, *row))
        return rebuild(results)

    def rate_value(self, u: Any, params: Any, t: Any) -> Any:
        """Return a copy of the value of the user's rate, which may reuse its result array; None without a rate."""
        if self.rate is None:
            return None
        if type(params) is SidedParams:
            u, t = params.side.inside(u, params.params, t)
            params = params.params
        if self.rate_takes_time:
            return copied(_call_rate(self.rate, u, (params, t)))
        return copied(_call_rate(self.rate, u, (params,)))

    def source_value(self, params: Any, t: Any) -> Any:
        """Return a copy of the value of the source; None without a source."""
        if self.source is None:
            return None
        if type(params) is SidedParams:
            t = params.side.time(t)
            params = params.params
        return copied(self.source(params, t) if self.source_takes_time else self.source(params))

    def __call__(self, u: Any, params: Any, t: Any) -> Any:
        """Return the whole right-hand side."""
        parts = []
        if self.stiff:
            parts.append(self.on_fields(_product, 1.0, params, u))
        parts.append(self.rate_value(u, params, t))
        parts.append(self.source_value(params, t))
        first, *others = [part for part in parts if part is not None]
        if keys(u) is not None:
            first = flatten(u)[1](field_leaves(first, u))
        return combine(first, *((1.0, part) for part in others))


def _product(op: Operator | None, coefficient: Any, leaf: Any) -> Any:
    """Return c L u of one field."""
    return (op(leaf) if op else 0.0 * leaf) * coefficient


def _call_rate(rate: Callable, u: Any, arguments: Sequence) -> Any:
    """Call a rate with a read-only state; raise ValueError if it writes into the state."""
    try:
        return rate(mapped(frozen, u), *arguments)
    except (TypeError, ValueError) as error:
        if "read-only" not in str(error) and "read-only" not in str(_error_without_trace(rate, u, arguments)):
            raise
        raise ValueError(
            "the rate changes the state in place; write u = u + du instead of u += du, or work on a copy"
        ) from None


def _error_without_trace(rate: Callable, u: Any, arguments: Sequence) -> Exception | None:
    """Return the error that a rate raises for plain values, whose message names a read-only array."""
    u, arguments = untraced((u, arguments))
    try:
        rate(mapped(frozen, u), *arguments)
    except Exception as error:
        return error
    return None
