"""explain: count the work of one run of a loss and its gradient, and list the work that was skipped."""

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
from sparsedp.autodiff.derivative import observed_nodes, unwarned, value_and_grad
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.evaluations import solvers_of
from sparsedp.check.nodes import bytes_held
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of
from sparsedp.operators.operator import Operator

__all__ = ["Plan", "explain", "total"]

EXTRAS = {"numba": "compiled kernels", "pyamg": "multigrid", "matplotlib": "pictures", "tqdm": "bars"}
COLUMNS = ("forward", "vjp", "jvp", "solve", "adjoint", "setup", "reused", "iterations", "assembled")
TOTALS = {  # name of a total: the kinds of calls that it adds up
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
    """Counts and times at the end of the forward pass."""

    end: float  # time at the end of the loss [s]
    nodes: int
    tape_bytes: int
    calls: Calls
    resumed: float  # time after the bytes on the tape were counted [s]


def explain(loss: Callable[[Any], Any], x: Any, gradient: bool = True) -> Plan:
    """Count the work of one run of a loss and its gradient, and list the work that was skipped.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. It is called once, with one backward pass.
    x : array, number, or any nesting of them in tuples, lists and dicts
    gradient : bool
        If False, only the value is computed, and nothing is recorded on the tape.

    Returns
    -------
    Plan
        It has the attributes `.counts`, the numbers of calls by (name, kind), which are 0 for all other keys;
        `.totals`, their totals by name; `.skipped`, a list of sentences; and `.rows`, one dict for each operator, rule
        and solver. `.to_dict()` returns plain data, and str() returns a table.

    Raises
    ------
    DerivativeError
        If `x` has no floating leaf. Exceptions of the loss are not caught.
    ShapeError
        If the loss is not a scalar.

    See Also
    --------
    rollout, certify, work_precision

    Notes
    -----
    The kinds of calls are: forward, vjp and jvp (applications of operators and rules); solve and adjoint (forward and
    adjoint solves); iterations (of solvers); setup and reused (solves that computed or reused a set-up); hierarchy
    (multigrid hierarchies built); assembled (matrices built); skipped (solves with a zero right-hand side); recomputed
    (time steps run again in the backward pass).

    A set-up that was computed before the loss ran is counted as reused. The seconds of a call do not include the calls
    inside it. Calls in other threads are not counted, not even in threads that the loss starts. The bytes on the tape
    are those of all arrays that the tape keeps between the forward and the backward pass, each counted once. For
    distributed fields, the counts include exchanges between ranks, their bytes (the sum over all ranks), and
    reductions, but not the messages inside a linear solve. All ranks have the same counts.

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
    with recording() as calls, observed_nodes(lambda node, *_: nodes.append(node)), unwarned():
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
    """Return the sum of the counts (or seconds) of the given kinds over all names."""
    return sum(count for (_, kind), count in calls.items() if kind in kinds)


class Plan(Result):
    """The result of `explain`. Immutable.

    Attributes
    ----------
    value : float
        The loss.
    counts : dict
        Number of calls by (name, kind).
    totals : dict
        Sums of the counts, by name.
    skipped : list of str
        Sentences about work that was not needed.
    rows : list of dict
        One dict for each operator, derivative rule and solver, in the order of first use: its name, numbers of calls,
        seconds, and how the operator is stored or which method the solver uses.
    tape_nodes, tape_bytes : int
        Number of calls on the tape after the forward pass, and bytes of the arrays that they keep.
    recomputation : float
        Number of time steps that were run, including recomputed ones, divided by the number of time steps; 1.0 if there
        are no time loops.
    seconds : (float, float)
        Run times of the forward pass (with recording) and of the backward pass.
    """

    _plain = ("value", "totals", "skipped", "rows", "tape_nodes", "tape_bytes", "recomputation", "seconds")

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain numbers, strings, lists and dicts. Counts are nested by name and kind."""
        counts: dict[str, dict[str, int]] = {}
        for (name, kind), count in self.counts.items():
            counts.setdefault(name, {})[kind] = count
        return super().to_dict() | {"counts": counts}

    def parts(self) -> list[str | Table]:
        """Return the title line, the table with one row for each name, the skipped work, and the totals."""
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
    """Return one dict for each operator, rule and solver that was called, in the order of first use."""
    rows = []
    for name in dict.fromkeys(name for name, _ in calls):
        counts = {kind: calls[name, kind] for kind in COLUMNS}
        if any(counts.values()):
            seconds = sum(spent for (other, _), spent in calls.seconds.items() if other == name)
            rows.append({"name": name, **counts, "seconds": seconds, "how": _form_or_method(calls, name)})
    return rows


def _form_or_method(calls: Calls, name: str) -> str:
    """Return the form of an operator, or the method of a solver and why it was chosen."""
    words = list(calls.notes.get((name, "method"), ()))
    for method_object in calls.method_objects.get(name, {}).values():
        if hasattr(method_object, "engine"):
            words.append(f"{method_object.engine.method}: {method_object.reason}")
        elif _is_applied(method_object):
            words.append(method_object.form)
    return "; ".join(dict.fromkeys(words)) or "rule"


def _is_applied(method_object: Any) -> bool:
    """Return whether an object that was called is an operator, but not an inverse."""
    return isinstance(method_object, Operator) and not hasattr(method_object, "solver")


# ---------------------------------------------------------------- skipped work, in sentences


def _skipped_derivatives_of_x(x: Any, gradient: bool) -> Iterator[str]:
    """Yield sentences about derivatives of the loss that were not computed."""
    constants = sum(not is_variable(leaf) for leaf in leaves(x))
    if not gradient:
        yield "the gradient: not asked, nothing taped"
    elif constants:
        yield f"derivatives in {constants} leaves of x, which are not floating"


def _skipped_work(calls: Calls, forward_calls: Calls, gradient: bool) -> Iterator[str]:
    """Yield sentences about derivatives, matrices, hierarchies and solves that were not needed."""
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
    for name, method_objects in calls.method_objects.items():
        for method_object in method_objects.values():
            if hasattr(method_object, "engine"):
                yield from _skipped_by_solver(calls, name, method_object)
            elif _is_applied(method_object):
                yield from _skipped_by_operator(calls, name, method_object)
    if not solvers_of(calls):
        yield "solves: none, so no hierarchy, no factors, no set-up"
    for (name, kind), count in calls.items():
        if kind == "skipped":
            yield f"{count} solves of {name}: the right-hand side is 0, so is the solution"


def _skipped_pullbacks(calls: Calls, forward_calls: Calls) -> Iterator[str]:
    """Yield a sentence about each operator or rule whose VJP was never called."""
    for name, kind in forward_calls:
        transposed = calls[f"{name}.T", "forward"]  # counts transposes applied outside the tape
        if kind == "forward" and not calls[name, "vjp"] + calls[name, "jvp"] + transposed:
            yield f"VJP of {name}: never called, its argument does not depend on x ({calls[name, kind]} calls)"


def _skipped_by_operator(calls: Calls, name: str, operator: Operator) -> Iterator[str]:
    """Yield sentences about matrices that were not assembled and applications that were mere copies."""
    if operator.form == "matrix-free" and not calls[name, "assembled"]:
        yield f"matrix of {name}: not assembled, applied without one"
    if operator.structure.is_identity:
        yield f"arithmetic of {name}: an identity, {calls[name, 'forward']} copies"


def _skipped_by_solver(calls: Calls, name: str, solver: Any) -> Iterator[str]:
    """Yield sentences about hierarchies, set-ups and adjoint solves that a solver did not need."""
    if not solver.engine.hierarchical:
        yield f"multigrid hierarchy for {name}: not built, {solver.engine.method} needs none"
    if not calls[name, "setup"]:
        yield f"set-up of {name}: built before, {calls[name, 'reused']} solves reuse it"
    if calls[name, "solve"] > 0 == calls[name, "adjoint"]:
        yield f"adjoint solve of {name}: nothing asks for it"


def _skipped_extras() -> Iterator[str]:
    """Yield a sentence about each optional library that this process has not imported."""
    for name, use in EXTRAS.items():
        if name not in sys.modules:
            if find_spec(name):
                missing = ""
            else:
                missing = ", which is not installed"
            yield f"not imported: {name} ({use}){missing}"
