"""Who is at fault when a gradient is wrong: each call on the tape, examined alone at the values it met.

The loss of a call f is <g, f(x)> with a fixed random g. Its gradient by the rule's VJP is judged as that of
any loss. An Operator is linear: <A u, g> - <u, A^T g> and A (u + v) - A u - A v tell all, without differences.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp.check.judge import forward_mode, looked_at
from sparsedp.check.nodes import calls_seen, in_order
from sparsedp.check.operators import fault_of, field
from sparsedp.check.summary import error_text
from sparsedp.check.sweep import Point, Trials, generator
from sparsedp.derivative import grad
from sparsedp.errors import DerivativeError
from sparsedp.ledger import recording
from sparsedp.operator import Operator
from sparsedp.solvers.choose_method import Inverse
from sparsedp.tape import is_variable

__all__ = ["culprit_of"]

MOST = 6  # calls of one rule that are examined, spread over its calls
DIRECTIONS = 2
SKIPPED = "constant", "gradient"
JUDGES = ".variation"  # in error control: with its transpose it is right along one of three runs, and refuses
NOBODY = "every call on the tape is right or refused at the values it met; a value may bypass the tape"


def culprit_of(loss, point):
    """Loss and point -> (name of the first call on the tape whose derivative is at fault or None, sentence).

    Parameters
    ----------
    loss : callable
    point : Point

    Returns
    -------
    (str or None, str)
        In the order of the calls. A call that others are made inside of (a time loop, a root) is named
        only when none of those is at fault.
    """
    rng = generator(None)
    cleared: set[int] = set()  # Operators that are right
    refused: dict[str, str] = {}  # calls that cannot be examined alone, and the error
    with np.errstate(all="ignore"):
        with calls_seen() as nodes:
            grad(loss)(point.fresh())
        for node in _examined(nodes):
            try:
                fault = _fault(node, cleared, rng)
            except DerivativeError:  # the call refuses the cotangents that were tried
                continue
            except Exception as error:  # a function of the user may raise anything; the verdict does not need it
                refused.setdefault(node.name, error_text(error))
                continue
            if fault:
                return fault[0], ", ".join(fault)
    return None, NOBODY + "".join(f"; {name} was not examined ({words})" for name, words in refused.items())


def _examined(nodes):
    """Calls that can be judged alone, those inside of a call before it; of many calls of one rule some."""
    groups: dict[int, list] = {}
    nodes = [node for node in in_order(nodes) if JUDGES not in node.name]
    for node in nodes:
        groups.setdefault(id(node.subject), []).append(node)
    chosen = {id(node) for calls in groups.values() for node in calls[:: -(-len(calls) // MOST)]}
    return [node for node in nodes if id(node) in chosen and node.plain]


def _fault(node, cleared, rng):
    """(name, reason) of what is wrong with a call: its Operator, an Operator that it applies, or its rule; or None."""
    if isinstance(node.subject, Operator):
        return _of_operator(node.subject, cleared, rng)
    reason = _wrong_rule(node, rng)
    if not reason:
        return None
    if getattr(node.subject, "truncate", None):
        reason += f"; its derivative is cut by truncate={node.subject.truncate}"
    with recording() as calls:
        grad(_functional(node, None))(node.values)
    actors = [actor for group in calls.actors.values() for actor in group.values() if isinstance(actor, Operator)]
    return next(filter(None, (_of_operator(op, cleared, rng) for op in actors)), (node.name, reason))


def _of_operator(op, cleared, rng):
    """A fault of an Operator that is not cleared yet; of an inverse, rather of the operator that it inverts."""
    if id(op) in cleared:
        return None
    cleared.add(id(op))
    reason = fault_of(op, rng)
    if reason and isinstance(op, Inverse) and fault_of(op.solver.system.given, rng):
        reason += f"; so is that of {op.solver.system.given.name}, which it inverts"
    return (op.name.removesuffix(".T"), reason) if reason else None  # it and its transpose are one operator


def _functional(node, rng):
    """Return ``loss(values)``, the sum of random weights (ones without `rng`) times the results of a call."""
    several = isinstance(node.value, tuple)
    results = node.value if several else (node.value,)
    weights = {
        k: field(rng, np.shape(result), np.asarray(result).dtype) if rng else np.ones_like(result)
        for k, result in enumerate(results)
        if is_variable(result)
    }

    def loss(values):
        again = node.again(values)
        parts = [(weight, again[k] if several else again) for k, weight in weights.items()]
        return sum(anp.sum(anp.real(weight * part)) for weight, part in parts)

    return loss


def _wrong_rule(node, rng):
    """What differences say against the VJP of a call, or its VJP against its JVP; "" if nothing."""
    try:
        point = Point(node.values)
    except Exception:  # no values that could be moved: nothing to be judged here
        return ""
    loss = _functional(node, rng)
    # In each argument alone, and the largest entry: a loss of many entries hides single ones.
    trials = Trials(loss, point, grad(loss))
    judged, doubts = looked_at(trials, DIRECTIONS, rng, lambda name: name not in SKIPPED)
    if "broken" in dict(doubts):
        return "its VJP gives NaN or infinity"
    for one in judged:
        if one.word == "disagrees":
            return f"its VJP is {one.note}" if one.note.startswith("off") else one.note
    gap, allowed = forward_mode(loss, judged[:DIRECTIONS]) or (0.0, 0.0)
    return "" if gap <= allowed else f"its JVP differs from its VJP by {gap:.1e}, and its VJP is right"
