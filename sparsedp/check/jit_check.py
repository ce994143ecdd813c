"""Comparison of a function with the programs that `jit` records of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import copied, labels, leaves, mapped
from sparsedp._utils.validation import check_function
from sparsedp.autodiff.derivative import pullback, unwarned, value_and_grad
from sparsedp.autodiff.jit import VALUE_TOLERANCE, Jitted, is_watched, tree_form
from sparsedp.autodiff.jit import gap as largest_gap
from sparsedp.autodiff.jit import jit as record
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.summary import Row, Summary, error_text
from sparsedp.errors import JitError

__all__ = ["JitSummary", "jit"]

LIMIT = VALUE_TOLERANCE  # largest accepted gap, in units of eps
PERTURBATION = 0.05  # relative change of the arguments
PLACES = ("the given arguments", "perturbed arguments 1", "perturbed arguments 2")
NO_PROGRAM = "no program was recorded: a field is distributed, or calls are counted or observed"


def jit(function: Callable[..., Any], *args: Any, **options: Any) -> JitSummary:
    """Compare a function with the program that `jit` records of it, at the given and at perturbed arguments.

    Parameters
    ----------
    function : callable
        A function, or the result of ``dp.jit(function)``, whose own programs are then compared.
    *args, **options
        Its arguments: trees of arrays, as for `jit`. They are not modified.

    Returns
    -------
    JitSummary
        `.verdict` is "agrees" or "disagrees". It is "inconclusive" if the function raises an exception at all perturbed
        arguments, or if `jit` does not record it: for distributed fields, and while calls are counted or observed.
        `.leaf` and `.gap` name the leaf with the largest gap, and `.reason` explains the verdict. If `jit` refuses the
        function, the verdict is "disagrees", and `.reason` is the message of the JitError. bool() is True only for
        "agrees", and str() returns a table.

    Raises
    ------
    TypeError
        If `function` is not callable.

    See Also
    --------
    jit, check.gradient

    Notes
    -----
    **What is compared.** The result, and derivatives in all floating leaves of the arguments: the gradient with respect
    to each argument if the result is a scalar, otherwise the pullback of random cotangents. They are compared at three
    places: at `args`, at ``x * (1 + 0.05 r)`` with random numbers r between -1 and 1 for each floating leaf x, and at
    the same with ``0.05 r`` times the largest entry of x added, so that entries equal to 0 change, too.

    **Gap.** The largest difference in a leaf, relative to its largest entry, in units of the machine epsilon of its
    dtype. A gap of at most 1e4 is accepted. Values are usually equal bit for bit, and derivatives differ by rounding.

    **Detection limits.** A value that the recording has frozen is detected only if it is different at the perturbed
    arguments: a branch that is taken far away from `args` is not seen. Call the check at arguments of each kind.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import sparsedp as dp
    >>> dp.check.jit(lambda u: anp.sum(u**3), np.array([1.0, 2.0])).verdict
    'agrees'
    >>> rng = np.random.default_rng(0)
    >>> dp.check.jit(lambda u: u + rng.random(), np.array([1.0, 2.0])).verdict
    'disagrees'
    """
    check_function("check.jit", function, "lambda u: ...")
    if isinstance(function, Jitted):
        jitted = function
        plain = function.function
    else:
        jitted = record(function, check=False)
        plain = function
    title = f"jit of {getattr(plain, '__name__', type(plain).__name__)}"
    if tree_form((args, options), []) is None or is_watched():
        return JitSummary(title, (), NO_PROGRAM)
    comparison = _Comparison(plain, jitted)
    rng = np.random.default_rng(0)
    rows: list[Row] = []
    refusal = ""
    with unwarned():  # a derivative that is not finite is compared and needs no warning
        for place, shift in zip(PLACES, (None, 0.0, PERTURBATION), strict=True):
            arguments = (args, options)
            if shift is not None:
                arguments = _perturbed(arguments, rng, shift)
            try:
                rows += comparison.rows(place, *arguments)
            except JitError as error:
                refusal = str(error)
                rows.append(Row(f"program at {place}", ok=False, note="refused"))
                break
    if not refusal and not any(row.ok is not None for row in rows if row.name.endswith(PLACES[1:])):
        # A frozen value cannot be noticed at the arguments of the recording.
        rows = [row if row.ok is False else row._replace(ok=None) for row in rows]
    return JitSummary(title, rows, refusal)


def _perturbed(tree: Any, rng: np.random.Generator, shift: float) -> Any:
    """Return a tree with other numbers: relative changes of all entries, plus `shift` of the largest entry."""

    def changed(leaf: Any) -> Any:
        if not is_variable(leaf):
            return leaf
        factor = 1.0 + PERTURBATION * rng.uniform(-1.0, 1.0, np.shape(leaf))
        size = np.max(np.abs(leaf), initial=0.0) or 1.0
        values = leaf * factor + shift * size * rng.uniform(-1.0, 1.0, np.shape(leaf))
        if isinstance(leaf, np.ndarray):
            return values.astype(leaf.dtype)
        return type(leaf)(values)

    return mapped(changed, tree)


class _Comparison:
    """The comparison of a function with its programs.

    Parameters
    ----------
    plain : callable
        The function.
    jitted : Jitted
    """

    def __init__(self, plain: Callable[..., Any], jitted: Jitted) -> None:
        self.plain = plain
        self.jitted = jitted

    def rows(self, place: str, args: tuple[Any, ...], options: dict[str, Any]) -> list[Row]:
        """Compare results and derivatives at some arguments; raise JitError if `jit` refuses the function."""
        try:
            expected = self.plain(*copied(args), **options)
        except Exception as error:
            if place == PLACES[0]:
                raise
            return [Row(f"result at {place}", note=f"not compared, the function raised {error_text(error)}")]
        actual = self.jitted(*copied(args), **options)
        rows = [_row(f"result at {place}", "result", expected, actual)]
        for name, derivative in _derivatives(expected, args, options).items():
            rows.append(_row(f"gradient at {place}", name, derivative(self.plain), derivative(self.jitted)))
        return rows


def _derivatives(
    result: Any, args: tuple[Any, ...], options: dict[str, Any]
) -> dict[str, Callable[[Callable[..., Any]], Any]]:
    """Return functions that compute derivatives of a function, plain or jitted, by the names of their results.

    Parameters
    ----------
    result : tree
        Result of the function at these arguments.
    """
    floating = [any(map(is_variable, leaves(argument))) for argument in args]
    outputs = [leaf for leaf in leaves(result) if is_variable(leaf)]
    if not any(floating) or not outputs:
        return {}
    is_loss = is_variable(result) and np.ndim(result) == 0 and np.asarray(result).dtype.kind == "f"
    if is_loss and not options:
        places = [place for place in range(len(args)) if floating[place]]
        return {f"gradient in args[{place}]": partial(_gradient, args, place) for place in places}
    rng = np.random.default_rng(0)
    weights = [rng.uniform(0.5, 1.5, np.shape(output)) for output in outputs]

    def pulled(function: Callable[..., Any]) -> Any:
        def weighted(parts: tuple[Any, ...]) -> Any:
            ends = [leaf for leaf in leaves(function(*parts, **options)) if is_variable(leaf)]
            return sum(anp.sum(weight * anp.real(end)) for weight, end in zip(weights, ends, strict=True))

        return pullback(weighted, copied(args))[1](1.0)

    return {"gradient in args": pulled}


def _gradient(args: tuple[Any, ...], place: int, function: Callable[..., Any]) -> Any:
    """Return the gradient of a loss with respect to one argument."""
    _, gradient = value_and_grad(function, place)(*copied(args))
    return gradient


def _row(name: str, root: str, expected: Any, actual: Any) -> Row:
    """Return the row of two trees: the largest gap of their leaves, with the name of the leaf as a note."""
    names = labels(expected, root)
    leaf = root
    gap = 0.0
    if names != labels(actual, root):
        gap = inf
    else:
        gaps = list(map(largest_gap, leaves(expected), leaves(actual)))
        if gaps:
            largest = int(np.argmax(gaps))
            leaf = names[largest]
            gap = gaps[largest]
    return Row(name, gap, LIMIT, gap <= LIMIT, leaf)


class JitSummary(Summary):
    """The result of `check.jit`. bool(summary) is True only if the program agrees with the function everywhere.

    Attributes
    ----------
    leaf : str
        Name of the leaf with the largest gap, such as ``result['u'][0]``; empty if nothing was compared.
    gap : float
        The largest gap, relative to the largest entry of its leaf, in units of machine epsilon.
    reason : str
        Explanation of a verdict other than "agrees".
    """

    _plain: tuple[str, ...] = ("title", "verdict", "reason", "leaf", "gap", "limit", "rows")

    limit = LIMIT

    def __init__(self, title: str, rows: Sequence[Row], reason: str) -> None:
        compared = [row for row in rows if row.figure is not None]
        leaf = ""
        gap = 0.0
        if compared:
            largest = max(compared, key=lambda row: row.figure or 0.0)
            leaf = largest.note
            gap = largest.figure or 0.0
        super().__init__(title, rows, leaf=leaf, gap=gap, reason=reason or _reason(rows, leaf, gap))

    def parts(self) -> list[Any]:
        """Return the title line with the verdict, the reason, and the table of rows."""
        head, table = super().parts()
        if self.reason:
            return [f"{head} ({self.reason})", table]
        return [head, table]


def _reason(rows: Sequence[Row], leaf: str, gap: float) -> str:
    """Return the explanation of the verdict of some rows."""
    failed = [row.name for row in rows if row.ok is False]
    if failed:
        return f"{leaf} differs by {gap:.2g} eps, at most {LIMIT:g} is accepted; first in the {failed[0]}"
    if not any(row.ok for row in rows):
        return "the function raised an exception at all perturbed arguments"
    return ""
