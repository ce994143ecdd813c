"""explain: what one run of a loss and its gradient computed, and what it left out. Counted, not estimated."""

import sys
from importlib.util import find_spec
from time import perf_counter
from typing import Any

from sparsedp.check.findings import table
from sparsedp.check.visits import bytes_held, witnessed
from sparsedp.derivative import value_and_grad
from sparsedp.fields import check_function
from sparsedp.ledger import recording
from sparsedp.operator import Operator
from sparsedp.report.omissions import omitted
from sparsedp.tape import is_variable
from sparsedp.tree import leaves

__all__ = ["Plan", "explain"]

COLUMNS = ("forward", "vjp", "jvp", "solve", "adjoint", "setup", "reused", "iterations", "assembled")
TOTALS = {
    "applications": ("forward", "vjp", "jvp"),
    "forward solves": ("solve",),
    "adjoint solves": ("adjoint",),
    "set-ups built": ("setup",),
    "set-ups reused": ("reused",),
    "hierarchies built": ("hierarchy",),
    "matrices assembled": ("assembled",),
    "solves skipped": ("skipped",),
    "steps recomputed": ("recomputed",),
}


def explain(loss, x, gradient=True):
    """Loss and point -> the plan: what one run of value and gradient calls, and what it leaves out.

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
        `.totals`: dict of their sums in words; `.left_out`: list of sentences; `.rows`: one dict for each
        operator, rule and solve; `.to_dict()`: all of it as plain data.

    Raises
    ------
    DerivativeError
        If x has no floating leaf. All that the loss raises passes through.
    ShapeError
        If the loss is not a scalar.

    Notes
    -----
    Kinds: forward, vjp, jvp (applications of operators and rules); solve, adjoint (each solve), iterations,
    setup, reused (solves that found their set-up ready), hierarchy, assembled (matrices that were built),
    skipped (solves with nothing to solve); recomputed (steps of time loops). What was set up before the
    loss ran is not counted: it is reused. Seconds are without those of the calls inside. What other threads do
    meanwhile is not counted either, those that the loss starts included.
    Bytes on the tape: all arrays that its nodes keep between the forward and the backward pass, each once.

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
    clock = perf_counter()
    marks: dict[str, Any] = {"before": set(sys.modules), "nodes": 0, "bytes": 0}
    nodes: list = []

    def watched(tree):
        value = loss(tree)
        marks.update(forward=perf_counter() - clock, nodes=len(nodes), bytes=bytes_held(nodes))
        marks["names"] = {name for name, _ in calls}
        nodes.clear()
        marks["resumed"] = perf_counter()
        return value

    with recording() as calls, witnessed(nodes):
        value = value_and_grad(watched)(x)[0] if gradient else float(watched(x))
        backward = perf_counter() - marks["resumed"]
    return Plan(calls, value, (marks["forward"], backward), marks, leaves(x), gradient)


class Plan:
    """The result of `explain`. Frozen.

    Attributes
    ----------
    value : float
        The loss.
    counts : dict
        Calls by (name, kind).
    totals : dict
        Their sums in words.
    left_out : list of str
    rows : list of dict
        name, form or method, counts and seconds of each operator, rule and solve, in the order of first use.
    tape_nodes, tape_bytes : int
        Calls that the tape holds after the forward pass, and bytes of the arrays they keep.
    recomputation : float
        Steps that ran, those run again included, over steps; 1.0 without time loops.
    seconds : (float, float)
        Forward with taping, backward.
    """

    value: float
    counts: dict
    totals: dict
    left_out: list
    rows: list
    tape_nodes: int
    tape_bytes: int
    recomputation: float
    seconds: tuple

    def __init__(self, calls, value, seconds, marks, inputs, gradient):
        totals = {word: sum(n for (_, kind), n in calls.items() if kind in kinds) for word, kinds in TOTALS.items()}
        steps = sum(calls[name, "forward"] for name, kind in list(calls) if kind == "recomputed")
        factor = 1.0 + totals["steps recomputed"] / steps if steps else 1.0
        asked = sum(map(is_variable, inputs)) if gradient else 0
        extra = sum(n for (_, kind), n in calls.items() if kind == "bytes")
        left_out = omitted(calls, totals, marks["names"], len(inputs) - asked, gradient)
        left_out += _not_imported(marks["before"])
        self.__dict__.update(value=float(value), counts=calls, totals=totals, left_out=left_out, seconds=seconds)
        self.__dict__.update(tape_nodes=marks["nodes"], tape_bytes=marks["bytes"] + extra, recomputation=factor)
        self.__dict__.update(rows=_rows(calls))

    def __setattr__(self, name, value):
        raise AttributeError(f"a plan is frozen; {name} cannot be set")

    def to_dict(self):
        """The plan as plain numbers, strings, lists and dicts; counts nested by name and kind."""
        counts: dict = {}
        for (name, kind), many in self.counts.items():
            counts.setdefault(name, {})[kind] = many
        names = ("value", "totals", "left_out", "rows", "tape_nodes", "tape_bytes", "recomputation")
        return {**{name: getattr(self, name) for name in names}, "counts": counts, "seconds": list(self.seconds)}

    def __str__(self):
        forward, backward = self.seconds
        head = (
            f"value {self.value:.6g}: {forward:.2g} s forward, {backward:.2g} s backward; tape: {self.tape_nodes} "
            f"calls that keep {self.tape_bytes} bytes, recomputation factor {self.recomputation:.2f}"
        )
        used = [kind for kind in COLUMNS if any(row[kind] for row in self.rows)]
        names = ("what", *used, "seconds", "how")
        lines = [(r["name"], *(r[k] or "" for k in used), f"{r['seconds']:.1e}", r["how"]) for r in self.rows]
        sums = ", ".join(f"{many} {word}" for word, many in self.totals.items() if many)
        left = [f"  - {sentence}" for sentence in self.left_out]
        return "\n".join([head, table(lines, names), f"totals: {sums or 'nothing was called'}", "left out:", *left])

    __repr__ = __str__


def _rows(calls):
    """One dict for each name, in the order of first use."""
    rows = []
    for name in dict.fromkeys(name for name, _ in calls):
        kinds = {kind: calls[name, kind] for kind in COLUMNS}
        if not any(kinds.values()):
            continue
        seconds = sum(spent for (other, _), spent in calls.seconds.items() if other == name)
        rows.append({"name": name, **kinds, "seconds": seconds, "how": _how(calls, name)})
    return rows


def _how(calls, name):
    """Form or method, and why."""
    words = [f"{word} ({n} times)" if n > 1 else word for word, n in calls.told.get((name, "method"), {}).items()]
    for actor in calls.actors.get(name, {}).values():
        engine = getattr(actor, "engine", None)
        if engine is not None:
            kind = "iterative" if engine.iterative else "direct"
            method = engine.method if engine.method == kind else f"{engine.method} ({kind})"
            words.append(f"{method}: {actor.reason}")
        elif isinstance(actor, Operator) and not hasattr(actor, "solver"):
            words.append(actor.form)
    return "; ".join(dict.fromkeys(words)) or "rule"


def _not_imported(before):
    """Extras that this process has not loaded, and those that the run loaded."""
    sentences = []
    for name, use in (
        ("numba", "compiled kernels"),
        ("pyamg", "multigrid"),
        ("matplotlib", "pictures"),
        ("tqdm", "bars"),
    ):
        if name not in sys.modules:
            missing = "" if find_spec(name) else ", which is not installed"
            sentences.append(f"not imported: {name} ({use}){missing}")
        elif name not in before:
            sentences.append(f"{name} ({use}) was imported by this run, and not before")
    return sentences
