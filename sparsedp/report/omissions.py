"""What a run did not compute, in sentences: derivatives, matrices, hierarchies, solves that nobody needed."""

from sparsedp.operator import Operator
from sparsedp.structure.explicit import Matrix

__all__ = ["omitted"]


def omitted(calls, totals, forward, fixed, gradient):
    """Ledger of a run -> list of sentences.

    Parameters
    ----------
    calls : Calls
    totals : dict
        Sums in words, as in `Plan.totals`.
    forward : set of str
        What the forward pass called.
    fixed : int
        Leaves of x that have no derivative.
    gradient : bool
    """
    sentences = []
    if not gradient:
        sentences.append("the gradient: not asked, nothing taped")
    elif fixed:
        sentences.append(f"derivatives in {fixed} leaves of x, which are not floating")
    sentences += _derivatives(calls, forward, gradient) + _matrices(calls)
    sentences += _hierarchies(calls, totals) + _skipped(calls)
    return sentences


def _derivatives(calls, forward, gradient):
    """Arguments without gradient, and calls whose VJP nobody asked for."""
    found = []
    for (name, what), arguments in calls.told.items():
        if what == "not asked":
            found.append(f"derivative of {name} in {', '.join(map(str, arguments))}: not asked")
    for (name, kind), many in calls.items():
        backward = calls[name, "vjp"] + calls[name, "jvp"] + calls[f"{name}.T", "forward"]  # the last: without a tape
        if gradient and kind == "forward" and name in forward and not backward:
            found.append(f"VJP of {name}: never called, its argument does not depend on x ({many} calls)")
    if gradient and not any(kind == "jvp" for _, kind in calls):
        found.append("JVPs: forward mode was not asked")
    return found


def _matrices(calls):
    found = []
    for name, actors in calls.actors.items():
        given = [op for op in actors.values() if isinstance(op, Operator) and not hasattr(op, "solver")]
        if not calls[name, "assembled"] and any(op.form == "matrix-free" for op in given):
            known = all(op.structure.has_entries for op in given)
            found.append(f"matrix of {name}: not assembled, {'applied' if known else 'known only'} without one")
        if any(isinstance(op.structure, Matrix) for op in given):
            found.append(f"assembly of {name}: it was given as a matrix")
    return found


def _hierarchies(calls, totals):
    found = []
    solvers = {
        name: [actor for actor in actors.values() if hasattr(actor, "engine")] for name, actors in calls.actors.items()
    }
    for name, actors in solvers.items():
        for solver in actors:
            if not solver.engine.hierarchical:
                found.append(f"multigrid hierarchy for {name}: not built, {solver.engine.method} needs none")
        if actors and not calls[name, "setup"]:
            found.append(f"set-up of {name}: made before, {calls[name, 'reused']} solves reuse it")
        if actors and calls[name, "solve"] and not calls[name, "adjoint"]:
            found.append(f"adjoint solve of {name}: nothing asks for it")
    if not any(solvers.values()):
        found.append("solves: none, so no hierarchy, no factors, no set-up")
    elif not totals["hierarchies built"] and len(found) == 0:
        found.append("multigrid hierarchies: none built in this run")
    return list(dict.fromkeys(found))


def _skipped(calls):
    found = [
        f"{many} solves of {name}: the right-hand side is 0, so is the solution"
        for (name, kind), many in calls.items()
        if kind == "skipped"
    ]
    for (name, what), reasons in calls.told.items():
        if what == "skipped":
            found += [f"{name}: {reason} ({many} times)" for reason, many in reasons.items()]
    for name, actors in calls.actors.items():
        if any(isinstance(op, Operator) and op.structure.is_identity for op in actors.values()):
            found.append(f"arithmetic of {name}: an identity, {calls[name, 'forward']} copies")
    return found
