"""Who is at fault when a gradient is wrong: each call on the tape, examined alone at the values it met.

The loss of a call f is <g, f(x)> with a fixed random g. Its gradient by the rule's VJP is judged as that of
any loss. An Operator is linear: <A u, g> - <u, A^T g> and A (u + v) - A u - A v tell all, without differences.
"""

import re
from math import prod

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import grad, linearised
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.directions import examine_directions
from sparsedp.check.entries import DEFAULT_STEP, gaps_along_entries, largest_gaps, listed, subscript, where
from sparsedp.check.evaluations import Evaluations
from sparsedp.check.nodes import calls_seen, in_order
from sparsedp.check.operators import fault_of, field
from sparsedp.check.other_derivatives import compare_modes
from sparsedp.check.point import Point, audit_generator
from sparsedp.check.summary import error_text
from sparsedp.errors import DerivativeError
from sparsedp.operators.operator import Operator
from sparsedp.solvers.inverse import Inverse

__all__ = ["culprit_of"]

MOST = 6  # calls of one rule that are examined, spread over its calls
DIRECTIONS = 2
SKIPPED = "constant", "gradient"
JUDGES = ".variation"  # in error control: with its transpose it is right along one of three runs, and refuses
NOBODY = "every call on the tape is right or refused at the values it met; a value may bypass the tape"


def culprit_of(loss, point, spaces=()):
    """Loss and point -> (name of the first call on the tape whose derivative is at fault or None, sentence).

    Parameters
    ----------
    loss : callable
    point : Point
    spaces : sequence of Space
        On which its fields may live, to name places.

    Returns
    -------
    (str or None, str)
        In the order of the calls. A call that others are made inside of (a time loop, a root) is named
        only when none of those is at fault.
    """
    rng = audit_generator(None)
    cleared: set[int] = set()  # Operators that are right
    refused: dict[str, str] = {}  # calls that cannot be examined alone, and the error
    with np.errstate(all="ignore"):
        with calls_seen() as nodes:
            grad(loss)(point.fresh())
        for node in _examined(nodes):
            try:
                fault = _fault(node, cleared, rng, spaces)
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


def _fault(node, cleared, rng, spaces):
    """(name, reason) of what is wrong with a call: its Operator, an Operator that it applies, or its rule; or None."""
    if isinstance(node.subject, Operator):
        return _of_operator(node.subject, cleared, rng)
    reason = _wrong_rule(node, rng, spaces)
    if not reason:
        return None
    if getattr(node.subject, "truncate", None):
        reason += f"; its derivative is cut by truncate={node.subject.truncate}"
    with recording() as calls:
        grad(_functional(node, _weights(node, None)))(node.values)
    actors = [actor for group in calls.actors.values() for actor in group.values() if isinstance(actor, Operator)]
    return next(filter(None, (_of_operator(op, cleared, rng) for op in actors)), (node.name, reason))


def _of_operator(op, cleared, rng):
    """A fault of an Operator that is not cleared yet; of an inverse, rather of the operator that it inverts."""
    if id(op) in cleared:
        return None
    cleared.add(id(op))
    reason = fault_of(op, rng)
    if reason and isinstance(op, Inverse) and fault_of(op.solver.system.unscaled, rng):
        reason += f"; so is that of {op.solver.system.unscaled.name}, which it inverts"
    if reason.startswith("its transpose is"):
        reason += _entries_of_operator(op, rng)
    return (op.name.removesuffix(".T"), reason) if reason else None  # it and its transpose are one operator


def _results(node, value):
    """Results of a call as a list, traced or not."""
    return [value[k] for k in range(len(node.value))] if isinstance(node.value, tuple) else [value]


def _weights(node, rng):
    """Random weights for each result that has a derivative, by its number; ones without `rng`."""
    return {
        k: field(rng, np.shape(result), np.asarray(result).dtype) if rng else np.ones_like(result)
        for k, result in enumerate(_results(node, node.value))
        if is_variable(result)
    }


def _functional(node, weights):
    """Return ``loss(values)``, the sum of weights times the results of a call."""

    def loss(values):
        results = _results(node, node.again(values))
        return sum(anp.sum(anp.real(weight * results[k])) for k, weight in weights.items())

    return loss


class Arguments(Point):
    """The differentiated arguments of a call, with the names that a user knows."""

    def __init__(self, node):
        super().__init__(node.values)

        def argument(match):
            return f"argument {node.places[int(match[1])]}" if len(node.places) > 1 else "argument"

        self.names = [re.sub(r"^x\[(\d+)\]", argument, name) for name in self.names]


def _entries_of_rule(node, evaluations, judged, worst, weights, spaces):
    """Return in words where in its arguments and results the VJP of a call is wrong."""
    point = evaluations.point
    in_arguments = gaps_along_entries(evaluations, judged, 1)
    words = [f"largest gap in its {one}" for one in listed(in_arguments, point, evaluations.slopes, spaces, "its VJP")]
    shapes = [np.shape(weight) for weight in weights.values()]
    is_complex = point.complex or any(map(np.iscomplexobj, weights.values()))
    if not is_complex and sum(map(prod, shapes)) > 1:
        for one in largest_gaps(_gap_of_results(node, point, worst, weights), shapes, 1):
            name = f"result {one.leaf}" if len(shapes) > 1 else "result"
            words.append(f"in its {_named(name, one, shapes[one.leaf], spaces)}")
    return "".join(f"; {word}" for word in words)


def _gap_of_results(node, point, worst, weights):
    """Return ``gap_along(parts)`` of a call, <w, J d> - <VJP(w), d> with w = weights * parts.

    d is the direction of the arguments in which the VJP is worst, J d a central difference. The gap is linear in parts.
    """
    direction = worst.line.direction
    step = worst.step if worst.step > 0 else DEFAULT_STEP

    def results_at(values):
        return _results(node, node.again(values))

    ahead = results_at(point.unpack(point.vector + step * direction))
    behind = results_at(point.unpack(point.vector - step * direction))
    slopes = [(np.asarray(ahead[k]) - np.asarray(behind[k])) / (2 * step) for k in weights]
    moving = [True] * len(leaves(node.values))
    values, _, pull = linearised(results_at, point.fresh(), moving)

    def gap_along(parts):
        cotangents: list = [None] * len(values)
        gap = 0.0
        for (k, weight), part, slope in zip(weights.items(), parts, slopes, strict=True):
            cotangents[k] = np.asarray(weight * part, np.asarray(values[k]).dtype)[()]
            gap += float(np.sum(cotangents[k] * slope))
        backs = [np.zeros(x.shape) if back is None else back for back, x in zip(pull(cotangents), point.values)]
        return gap - float(np.concatenate([np.ravel(back) for back in backs]) @ direction)

    return gap_along


def _entries_of_operator(op, rng):
    """Return in words where in its argument and result the transpose of a real Operator is wrong."""
    if op.dtype.kind == "c":
        return ""
    op = op.tangent
    u = field(rng, op.domain.shape, float)
    g = field(rng, op.codomain.shape, float)
    forward = op.apply(u)
    backward = op.T.apply(g)

    def gap_in_argument(parts):
        part = parts[0] * u
        return float(np.sum(op.apply(part) * g) - np.sum(part * backward))

    def gap_in_result(parts):
        part = parts[0] * g
        return float(np.sum(forward * part) - np.sum(u * op.T.apply(part)))

    in_argument = largest_gaps(gap_in_argument, [u.shape], 1)
    in_result = largest_gaps(gap_in_result, [g.shape], 1)
    words = ""
    for name, found, space in (("argument", in_argument, op.domain), ("result", in_result, op.codomain)):
        spaces = [space] if space.grid is not None and space.backend.whole_fields else []
        words += "".join(f"; largest gap in its {_named(name, one, space.shape, spaces)}" for one in found)
    return words


def _named(name, one, shape, spaces):
    """Return an entry, or the region that holds the whole gap, and its place in words."""
    block = one.block if one.region is None else one.region
    return f"{name}{subscript(block, shape)}{where(block, shape, spaces)}"


def _wrong_rule(node, rng, spaces):
    """What differences say against the VJP of a call, or its VJP against its JVP; "" if nothing."""
    try:
        point = Arguments(node)
    except Exception:  # no values that could be moved: nothing to be judged here
        return ""
    weights = _weights(node, rng)
    loss = _functional(node, weights)
    # In each argument alone, and the largest entry: a loss of many entries hides single ones.
    evaluations = Evaluations(loss, point, grad(loss))
    judged, doubts = examine_directions(evaluations, DIRECTIONS, rng, lambda name: name not in SKIPPED)
    if "broken" in dict(doubts):
        return "its VJP gives NaN or infinity"
    for one in judged:
        if one.word == "disagrees":
            words = f"its VJP is {one.note}" if one.note.startswith("off") else one.note
            return words + _entries_of_rule(node, evaluations, judged, one, weights, spaces)
    modes = compare_modes(loss, judged[:DIRECTIONS])
    if modes is None or modes.is_allowed or modes.is_hidden:
        return ""
    return f"its JVP differs from its VJP by {modes.gap:.1e}, and its VJP is right"
