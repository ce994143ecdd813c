"""explain: the work of one run of a loss and its gradient, and the work it skipped. Counted, not estimated."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from time import perf_counter
from typing import Any

from sparsedp._utils.counters import Calls, recording
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function
from sparsedp.autodiff.derivative import unwarned, value_and_grad, witnessed
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.evaluations import solvers_of
from sparsedp.check.nodes import bytes_held
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of
from sparsedp.operators.operator import Operator

__all__ = ["Plan", "explain", "total"]

EXTRAS = {"numba": "compiled kernels", "pyamg": "multigrid", "matplotlib": "pictures", "tqdm": "bars"}
COLUMNS = ("forward", "vjp", "jvp", "solve", "adjoint", "setup", "reused", "iterations", "assembled")
TOTALS = {  # name of a sum: kinds of calls
    "applications": ("forward", "vjp", "jvp"),
    "forward solves": ("solve",),
    "adjoint solves": ("adjoint",),
    "set-ups built": ("setup",),
    "set-ups reused": ("reused",),
    "hierarchies built": ("hierarchy",),
    "matrices assembled": ("assembled",),
    "solves skipped": ("skipped",),
    "steps recomputed": ("recomputed",),
    "exchanges between ranks": ("exchange",),
    "bytes in them": ("sent",),
    "reductions": ("reduction",),
}


@dataclass
class _ForwardPass:
    """What is known at the end of the forward pass."""

    end: float  # when it ended [s]
    nodes: int
    tape_bytes: int
    calls: Calls
    resumed: float  # when the bytes were counted [s]


def explain(loss: Callable[[Any], Any], x: Any, gradient: bool = True) -> Plan:
    """Count the calls of one run of a loss and its gradient, and list the work that it skips.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. It is called once, and its gradient is taken once.
    x : array, number, or any nesting of them in tuples, lists and dicts
    gradient : bool
        False: only the value is computed, and nothing is taped.

    Returns
    -------
    Plan
        str() is the plan. `.counts`: dict of calls by (name, kind), a kind that never happened counts 0;
        `.totals`: dict of their sums in words; `.skipped`: list of sentences; `.rows`: one dict for each
        operator, rule and solve; `.to_dict()`: all of it as plain data.

    Raises
    ------
    DerivativeError
        If x has no floating leaf. All that the loss raises passes through.
    ShapeError
        If the loss is not a scalar.

    See Also
    --------
    rollout, certify, work_precision

    Notes
    -----
    Kinds: forward, vjp, jvp (applications of operators and rules); solve, adjoint (each solve), iterations,
    setup, reused (solves that found their set-up ready), hierarchy, assembled (matrices that were built),
    skipped (solves with nothing to solve); recomputed (steps of time loops). What was set up before the
    loss ran is not counted: it is reused. Seconds are without those of the calls inside. What other threads do
    meanwhile is not counted either, those that the loss starts included.
    Bytes on the tape: all arrays that its nodes keep between the forward and the backward pass, each once.
    Of distributed fields, exchanges between blocks and reductions to one number are counted, and the bytes of the
    exchanges of all processes together; messages inside a linear solve are not. All processes have the same counts.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> from sparsedp import Grid, laplacian
    >>> L = laplacian(Grid(8))
    >>> plan = explain(lambda u: anp.sum(L(u) ** 2), np.arange(8.0))
    >>> plan.counts["laplacian", "forward"], plan.counts["laplacian", "vjp"], plan.tape_bytes
    (1, 1, 64)
    """
    check_function("explain", loss, "lambda x: np.sum(x**2)")
    nodes: list[Any] = []
    passes: list[_ForwardPass] = []

    def watched_loss(tree: Any) -> Any:
        value = loss(tree)
        end = perf_counter()
        passes.append(_ForwardPass(end, len(nodes), bytes_held(nodes), calls.copy(), perf_counter()))
        nodes.clear()
        return value

    start = perf_counter()
    with recording() as calls, witnessed(lambda node, *_: nodes.append(node)), unwarned():
        if gradient:
            value, _ = value_and_grad(watched_loss)(x)
        else:
            value = watched_loss(x)
    forward = passes[-1]
    seconds = (forward.end - start, perf_counter() - forward.resumed)
    totals = {name: total(calls, *kinds) for name, kinds in TOTALS.items()}
    steps = sum(calls[name, "forward"] for name, kind in list(calls) if kind == "recomputed")
    skipped = [
        *_skipped_derivatives_of_x(x, gradient),
        *_skipped_work(calls, forward.calls, gradient),
        *_skipped_extras(),
    ]
    return Plan(
        value=float(value),
        counts=calls,
        totals=totals,
        rows=_rows(calls),
        seconds=seconds,
        tape_nodes=forward.nodes,
        skipped=list(dict.fromkeys(skipped)),
        tape_bytes=forward.tape_bytes + total(calls, "bytes"),
        recomputation=1.0 + totals["steps recomputed"] / steps if steps else 1.0,
    )


def total(calls: Any, *kinds: str) -> Any:
    """Return the sum of the counts (or seconds) of these kinds over all names."""
    return sum(count for (_, kind), count in calls.items() if kind in kinds)


class Plan(Result):
    """The result of `explain`. Frozen.

    Attributes
    ----------
    value : float
        The loss.
    counts : dict
        Calls by (name, kind).
    totals : dict
        Their sums in words.
    skipped : list of str
    rows : list of dict
        name, form or method, counts and seconds of each operator, rule and solve, in the order of first use.
    tape_nodes, tape_bytes : int
        Calls that the tape holds after the forward pass, and bytes of the arrays they keep.
    recomputation : float
        Steps that ran, those run again included, over steps; 1.0 without time loops.
    seconds : (float, float)
        Forward with taping, backward.
    """

    _plain = ("value", "totals", "skipped", "rows", "tape_nodes", "tape_bytes", "recomputation", "seconds")

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain numbers, strings, lists and dicts; counts nested by name and kind."""
        counts: dict[str, dict[str, int]] = {}
        for (name, kind), count in self.counts.items():
            counts.setdefault(name, {})[kind] = count
        return super().to_dict() | {"counts": counts}

    def parts(self) -> list[str | Table]:
        """Return the sums, a row for each name, and what was skipped."""
        forward, backward = self.seconds
        rows = [{name: value or None for name, value in row.items()} for row in self.rows]
        sums = ", ".join(f"{count} {name}" for name, count in self.totals.items() if count)
        return [
            f"value {self.value:.6g}: {forward:.2g} s forward, {backward:.2g} s backward; tape: {self.tape_nodes} "
            f"calls that keep {self.tape_bytes} bytes, recomputation factor {self.recomputation:.2f}",
            table_of(rows, ("name", *COLUMNS, "seconds", "how")),
            *self.omissions(),
            f"totals: {sums or 'nothing was called'}",
        ]


def _rows(calls: Calls) -> list[dict[str, Any]]:
    """Return one dict for each name that was called, in the order of first use."""
    rows = []
    for name in dict.fromkeys(name for name, _ in calls):
        counts = {kind: calls[name, kind] for kind in COLUMNS}
        if any(counts.values()):
            seconds = sum(spent for (other, _), spent in calls.seconds.items() if other == name)
            rows.append({"name": name, **counts, "seconds": seconds, "how": _form_or_method(calls, name)})
    return rows


def _form_or_method(calls: Calls, name: str) -> str:
    """Return the form of an operator, or the method of a solve with its reason."""
    words = list(calls.notes.get((name, "method"), ()))
    for actor in calls.actors.get(name, {}).values():
        if hasattr(actor, "engine"):
            words.append(f"{actor.engine.method}: {actor.reason}")
        elif _is_applied(actor):
            words.append(actor.form)
    return "; ".join(dict.fromkeys(words)) or "rule"


def _is_applied(actor: Any) -> bool:
    """Return whether an actor is an operator that is applied, not solved with."""
    return isinstance(actor, Operator) and not hasattr(actor, "solver")


# ---------------------------------------------------------------- skipped work, in sentences


def _skipped_derivatives_of_x(x: Any, gradient: bool) -> Iterator[str]:
    """Say which derivatives of the loss were not computed."""
    constants = sum(not is_variable(leaf) for leaf in leaves(x))
    if not gradient:
        yield "the gradient: not asked, nothing taped"
    elif constants:
        yield f"derivatives in {constants} leaves of x, which are not floating"


def _skipped_work(calls: Calls, forward_calls: Calls, gradient: bool) -> Iterator[str]:
    """Say which derivatives, matrices, hierarchies and solves were not needed."""
    for (name, what), facts in calls.notes.items():
        if what == "not asked":
            yield f"derivative of {name} in {', '.join(map(str, facts))}: not asked"
        elif what == "skipped":
            for reason, count in facts.items():
                yield f"{name}: {reason} ({count} times)"
    if gradient:
        yield from _skipped_pullbacks(calls, forward_calls)
        if not total(calls, "jvp"):
            yield "JVPs: forward mode was not asked"
    for name, actors in calls.actors.items():
        for actor in actors.values():
            if hasattr(actor, "engine"):
                yield from _skipped_by_solver(calls, name, actor)
            elif _is_applied(actor):
                yield from _skipped_by_operator(calls, name, actor)
    if not solvers_of(calls):
        yield "solves: none, so no hierarchy, no factors, no set-up"
    for (name, kind), count in calls.items():
        if kind == "skipped":
            yield f"{count} solves of {name}: the right-hand side is 0, so is the solution"


def _skipped_pullbacks(calls: Calls, forward_calls: Calls) -> Iterator[str]:
    """Say whose VJP was never called."""
    for name, kind in forward_calls:
        transposed = calls[f"{name}.T", "forward"]  # a VJP of an operator that is not on a tape
        if kind == "forward" and not calls[name, "vjp"] + calls[name, "jvp"] + transposed:
            yield f"VJP of {name}: never called, its argument does not depend on x ({calls[name, kind]} calls)"


def _skipped_by_operator(calls: Calls, name: str, operator: Operator) -> Iterator[str]:
    """Say what an operator did not assemble or compute."""
    if operator.form == "matrix-free" and not calls[name, "assembled"]:
        yield f"matrix of {name}: not assembled, applied without one"
    if operator.structure.is_identity:
        yield f"arithmetic of {name}: an identity, {calls[name, 'forward']} copies"


def _skipped_by_solver(calls: Calls, name: str, solver: Any) -> Iterator[str]:
    """Say what a solver did not build or solve."""
    if not solver.engine.hierarchical:
        yield f"multigrid hierarchy for {name}: not built, {solver.engine.method} needs none"
    if not calls[name, "setup"]:
        yield f"set-up of {name}: built before, {calls[name, 'reused']} solves reuse it"
    if calls[name, "solve"] > 0 == calls[name, "adjoint"]:
        yield f"adjoint solve of {name}: nothing asks for it"


def _skipped_extras() -> Iterator[str]:
    """Say which extras this process has not imported."""
    for name, use in EXTRAS.items():
        if name not in sys.modules:
            if find_spec(name):
                missing = ""
            else:
                missing = ", which is not installed"
            yield f"not imported: {name} ({use}){missing}"
