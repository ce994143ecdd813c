"""explain: what one run of a loss and its gradient computed, and what it skipped. Counted, not estimated."""

import sys
from importlib.util import find_spec
from time import perf_counter

from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function
from sparsedp.autodiff.derivative import unwarned, value_and_grad, witnessed
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.evaluations import solvers_of
from sparsedp.check.nodes import bytes_held
from sparsedp.check.summary import Result
from sparsedp.check.table import table_of
from sparsedp.operators.operator import Operator

__all__ = ["Plan", "explain", "total"]

EXTRAS = {"numba": "compiled kernels", "pyamg": "multigrid", "matplotlib": "pictures", "tqdm": "bars"}
COLUMNS = ("forward", "vjp", "jvp", "solve", "adjoint", "setup", "reused", "iterations", "assembled")
TOTALS = {
    "applications": "forward vjp jvp",
    "forward solves": "solve",
    "adjoint solves": "adjoint",
    "set-ups built": "setup",
    "set-ups reused": "reused",
    "hierarchies built": "hierarchy",
    "matrices assembled": "assembled",
    "solves skipped": "skipped",
    "steps recomputed": "recomputed",
    "exchanges between ranks": "exchange",
    "bytes in them": "sent",
    "reductions": "reduction",
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
        `.totals`: dict of their sums in words; `.skipped`: list of sentences; `.rows`: one dict for each
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
    On ranks: exchanges are those of fields and between neighbours, their bytes those of all ranks together, reductions
    the numbers that all ranks agree on; what PETSc sends inside a solve is not counted. Every rank has the same counts.

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
    nodes: list = []
    forward: list = []  # what is known when the forward pass ends: time, nodes, bytes, calls, time after counting

    def watched(tree):
        value = loss(tree)
        forward[:] = perf_counter(), len(nodes), bytes_held(nodes), calls.copy(), perf_counter()
        nodes.clear()
        return value

    start = perf_counter()
    with recording() as calls, witnessed(lambda node, *_: nodes.append(node)), unwarned():
        value = value_and_grad(watched)(x)[0] if gradient else watched(x)
    end, tape_nodes, tape_bytes, before, begin = forward
    seconds = end - start, perf_counter() - begin
    totals = {word: total(calls, *kinds.split()) for word, kinds in TOTALS.items()}
    steps = sum(calls[name, "forward"] for name, kind in list(calls) if kind == "recomputed")
    return Plan(
        value=float(value), counts=calls, totals=totals, rows=_rows(calls), seconds=seconds, tape_nodes=tape_nodes,
        skipped=list(dict.fromkeys([*_gradient(x, gradient), *_skipped(calls, before, gradient), *_extras()])),
        tape_bytes=tape_bytes + total(calls, "bytes"),
        recomputation=1.0 + totals["steps recomputed"] / steps if steps else 1.0,
    )  # fmt: skip


def total(calls, *kinds):
    """Calls (or their seconds) by (name, kind) -> the sum of these kinds, whoever was called."""
    return sum(many for (_, kind), many in calls.items() if kind in kinds)


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

    def to_dict(self):
        """The plan as plain numbers, strings, lists and dicts; counts nested by name and kind."""
        counts: dict = {}
        for (name, kind), many in self.counts.items():
            counts.setdefault(name, {})[kind] = many
        return super().to_dict() | {"counts": counts}

    def parts(self):
        """The sums, a row for each name, and what was left out."""
        forward, backward = self.seconds
        rows = [{name: value or None for name, value in row.items()} for row in self.rows]
        sums = ", ".join(f"{many} {word}" for word, many in self.totals.items() if many)
        return [
            f"value {self.value:.6g}: {forward:.2g} s forward, {backward:.2g} s backward; tape: {self.tape_nodes} "
            f"calls that keep {self.tape_bytes} bytes, recomputation factor {self.recomputation:.2f}",
            table_of(rows, ("name", *COLUMNS, "seconds", "how")),
            *self.omissions(),
            f"totals: {sums or 'nothing was called'}",
        ]


def _rows(calls):
    """One dict for each name that was called, in the order of first use."""
    rows = []
    for name in dict.fromkeys(name for name, _ in calls):
        kinds = {kind: calls[name, kind] for kind in COLUMNS}
        if any(kinds.values()):
            seconds = sum(spent for (other, _), spent in calls.seconds.items() if other == name)
            rows.append({"name": name, **kinds, "seconds": seconds, "how": _how(calls, name)})
    return rows


def _how(calls, name):
    """Form or method, and why."""
    words = list(calls.notes.get((name, "method"), ()))
    for actor in calls.actors.get(name, {}).values():
        if hasattr(actor, "engine"):
            words.append(f"{actor.engine.method}: {actor.reason}")
        elif _applied(actor):
            words.append(actor.form)
    return "; ".join(dict.fromkeys(words)) or "rule"


def _applied(actor):
    """Whether it is an operator that is applied and not solved with."""
    return isinstance(actor, Operator) and not hasattr(actor, "solver")


# ---------------------------------------------------------------- skipped work, in sentences


def _gradient(x, asked):
    fixed = sum(not is_variable(leaf) for leaf in leaves(x))
    if not asked:
        yield "the gradient: not asked, nothing taped"
    elif fixed:
        yield f"derivatives in {fixed} leaves of x, which are not floating"


def _skipped(calls, forward, gradient):
    """Derivatives, matrices, hierarchies and solves that nobody needed."""
    for (name, what), facts in calls.notes.items():
        if what == "not asked":
            yield f"derivative of {name} in {', '.join(map(str, facts))}: not asked"
        if what == "skipped":
            yield from (f"{name}: {reason} ({many} times)" for reason, many in facts.items())
    for name, kind in forward if gradient else ():
        back = calls[name, "vjp"] + calls[name, "jvp"] + calls[f"{name}.T", "forward"]  # the last: without a tape
        if kind == "forward" and not back:
            yield f"VJP of {name}: never called, its argument does not depend on x ({calls[name, kind]} calls)"
    if gradient and not total(calls, "jvp"):
        yield "JVPs: forward mode was not asked"
    for name, actors in calls.actors.items():
        for actor in actors.values():
            yield from (_solver(calls, name, actor) if hasattr(actor, "engine") else _operator(calls, name, actor))
    if not solvers_of(calls):
        yield "solves: none, so no hierarchy, no factors, no set-up"
    for (name, kind), many in calls.items():
        if kind == "skipped":
            yield f"{many} solves of {name}: the right-hand side is 0, so is the solution"


def _operator(calls, name, actor):
    if _applied(actor) and actor.form == "matrix-free" and not calls[name, "assembled"]:
        yield f"matrix of {name}: not assembled, applied without one"
    if _applied(actor) and actor.structure.is_identity:
        yield f"arithmetic of {name}: an identity, {calls[name, 'forward']} copies"


def _solver(calls, name, actor):
    """What it did not build or solve."""
    if not actor.engine.hierarchical:
        yield f"multigrid hierarchy for {name}: not built, {actor.engine.method} needs none"
    if not calls[name, "setup"]:
        yield f"set-up of {name}: made before, {calls[name, 'reused']} solves reuse it"
    if calls[name, "solve"] > 0 == calls[name, "adjoint"]:
        yield f"adjoint solve of {name}: nothing asks for it"


def _extras():
    """Extras that this process has not loaded."""
    for name, use in EXTRAS.items():
        if name not in sys.modules:
            yield f"not imported: {name} ({use}){'' if find_spec(name) else ', which is not installed'}"
