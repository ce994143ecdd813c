"""Find the call with a wrong derivative when a gradient is wrong: each recorded call is examined separately.

A call f is examined at the arguments x that it was called with, by the loss <g, f(x)> with a fixed random g. The
gradient of this loss by the VJP of the call is audited like the gradient of any other loss. For an Operator no finite
differences are needed: it is linear, so <A u, g> - <u, A^T g> and A (u + v) - A u - A v show all errors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import autograd.numpy as anp
import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import grad, taped
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.direction_evidence import DirectionEvidence
from sparsedp.check.directions import examine_directions
from sparsedp.check.entries import (
    DEFAULT_STEP,
    EVERY_ENTRY,
    EntryGap,
    gaps_along_entries,
    largest_gaps,
    listed,
    subscript,
    where,
)
from sparsedp.check.evaluations import Evaluations
from sparsedp.check.nodes import Node, calls_seen, in_order
from sparsedp.check.operators import fault_of, field
from sparsedp.check.other_derivatives import compare_modes
from sparsedp.check.point import Point, audit_generator
from sparsedp.check.summary import error_text
from sparsedp.errors import DerivativeError
from sparsedp.operators.operator import Operator
from sparsedp.solvers.inverse import Inverse

__all__ = ["culprit_of"]

MOST_CALLS = 6  # at most this many calls of one rule are examined, evenly spread over all its calls
RANDOM_DIRECTIONS = 2
OMITTED_DIRECTIONS = ("constant", "gradient")
# The rules that error control of time steps records are skipped: they are valid only as a pair, not separately.
ERROR_CONTROL = ".variation"
NO_CULPRIT = "every call on the tape is right or refused at the values it met; a value may bypass the tape"


def culprit_of(loss: Callable[[Any], Any], point: Point, spaces: Sequence[Any] = ()) -> tuple[str | None, str]:
    """Find the first recorded call whose derivative is wrong.

    Parameters
    ----------
    loss : callable
    point : Point
    spaces : sequence of Space
        Grid spaces in which arguments may live. They give the coordinates of wrong entries.

    Returns
    -------
    name : str or None
        Name of the call; None if no call is wrong. A call that contains other calls (a time loop, a root solve) is
        named only if none of the inner calls is wrong.
    sentence : str
        What is wrong with the call, or which calls could not be examined.
    """
    examination = _Examination(audit_generator(None), spaces)
    refused: dict[str, str] = {}  # errors of calls that cannot be examined, by name of the call
    with np.errstate(all="ignore"):
        with calls_seen() as nodes:
            grad(loss)(point.fresh())
        for node in _select(nodes):
            try:
                fault = examination.fault_of_call(node)
            except DerivativeError:  # the call does not accept the cotangents that were tried
                continue
            except Exception as error:  # a user's function may raise any exception; skip this call
                refused.setdefault(node.name, error_text(error))
                continue
            if fault is not None:
                return fault[0], ", ".join(fault)
    sentences = [NO_CULPRIT, *(f"{name} was not examined ({error})" for name, error in refused.items())]
    return None, "; ".join(sentences)


def _select(nodes: Sequence[Node]) -> list[Node]:
    """Return the calls to examine: inner calls before the call that contains them, and at most MOST_CALLS per rule."""
    ordered = [node for node in in_order(nodes) if ERROR_CONTROL not in node.name]
    groups: dict[int, list[Node]] = {}
    for node in ordered:
        groups.setdefault(id(node.subject), []).append(node)
    chosen: set[int] = set()
    for calls in groups.values():
        stride = -(-len(calls) // MOST_CALLS)
        chosen.update(id(node) for node in calls[::stride])
    return [node for node in ordered if id(node) in chosen and node.plain]


class _Examination:
    """The search for the call at fault.

    Parameters
    ----------
    rng : Generator
    spaces : sequence of Space
    """

    def __init__(self, rng: np.random.Generator, spaces: Sequence[Any]) -> None:
        self.rng = rng
        self.spaces = spaces
        self.examined_operators: set[int] = set()

    def fault_of_call(self, node: Node) -> tuple[str, str] | None:
        """Return (name, fault) of the Operator or rule of a call, or of an Operator that it applies; None if right."""
        if isinstance(node.subject, Operator):
            return self.fault_of_operator(node.subject)
        reason = self.fault_of_rule(node)
        if not reason:
            return None
        truncate = getattr(node.subject, "truncate", None)
        if truncate:
            reason += f"; its derivative is cut by truncate={truncate}"
        with recording() as calls:
            grad(_functional(node, _weights(node, None)))(node.values)
        for method_objects in calls.method_objects.values():
            for method_object in method_objects.values():
                if isinstance(method_object, Operator):
                    fault = self.fault_of_operator(method_object)
                    if fault is not None:
                        return fault
        return node.name, reason

    def fault_of_operator(self, op: Operator) -> tuple[str, str] | None:
        """Return (name, fault) of an Operator; None if it is right or was examined before."""
        if id(op) in self.examined_operators:
            return None
        self.examined_operators.add(id(op))
        reason = fault_of(op, self.rng)
        if not reason:
            return None
        if isinstance(op, Inverse):
            inverted = op.solver.system.unscaled
            if fault_of(inverted, self.rng):
                reason += f"; so is that of {inverted.name}, which it inverts"
        if reason.startswith("its transpose is"):
            reason += _entries_of_operator(op, self.rng)
        return op.name.removesuffix(".T"), reason  # report an operator and its transpose under one name

    def fault_of_rule(self, node: Node) -> str:
        """Return what is wrong with the VJP of a call by finite differences, or with its JVP; "" if nothing is."""
        try:
            point = Arguments(node)
        except Exception:  # the call has no floating arguments
            return ""
        weights = _weights(node, self.rng)
        loss = _functional(node, weights)
        # Directions in each argument, and in the entry with the largest gradient, show errors of single entries
        # that average out along random directions of many entries.
        evaluations = Evaluations(loss, point, grad(loss))
        directions, findings = examine_directions(
            evaluations, RANDOM_DIRECTIONS, self.rng, lambda name: name not in OMITTED_DIRECTIONS
        )
        if any(word == "broken" for word, _ in findings):
            return "its VJP gives NaN or infinity"
        for direction in directions:
            if direction.word == "disagrees":
                note = direction.note
                if note.startswith("off"):
                    words = f"its VJP is {note}"
                else:
                    words = note
                return words + _entries_of_rule(node, evaluations, directions, direction, weights, self.spaces)
        modes = compare_modes(loss, directions[:RANDOM_DIRECTIONS])
        if modes is None or modes.is_allowed or modes.is_hidden:
            return ""
        return f"its JVP differs from its VJP by {modes.gap:.1e}, and its VJP is right"


Weights = dict[int, Any]  # arrays, by number of the result


def _results(node: Node, value: Any) -> list[Any]:
    """Return the results of a call as a list. `value` may be traced."""
    if isinstance(node.value, tuple):
        return [value[number] for number in range(len(node.value))]
    return [value]


def _weights(node: Node, rng: np.random.Generator | None) -> Weights:
    """Return random weights for each differentiable result, by its number. Without `rng` all weights are 1."""
    weights: Weights = {}
    for number, result in enumerate(_results(node, node.value)):
        if not is_variable(result):
            continue
        if rng is None:
            weights[number] = np.ones_like(result)
        else:
            weights[number] = field(rng, np.shape(result), np.asarray(result).dtype)
    return weights


def _functional(node: Node, weights: Weights) -> Callable[[Any], Any]:
    """Return the function ``loss(values)``: the weighted sum of the results of a call with these arguments."""

    def loss(values: Any) -> Any:
        results = _results(node, node.again(values))
        return sum(anp.sum(anp.real(weight * results[number])) for number, weight in weights.items())

    return loss


class Arguments(Point):
    """The differentiated arguments of a call as a `Point`, with names such as "argument 0"."""

    def __init__(self, node: Node) -> None:
        super().__init__(node.values)

        def argument(match: re.Match[str]) -> str:
            if len(node.places) > 1:
                return f"argument {node.places[int(match[1])]}"
            return "argument"

        self.names = [re.sub(r"^x\[(\d+)\]", argument, name) for name in self.names]


# ------------------------------------------------------------ places, in words


def _entries_of_rule(
    node: Node,
    evaluations: Evaluations,
    directions: Sequence[DirectionEvidence],
    worst: DirectionEvidence,
    weights: Weights,
    spaces: Sequence[Any],
) -> str:
    """Return a phrase with the entries of arguments and results for which the VJP of a call is wrong."""
    point = evaluations.point
    in_arguments = gaps_along_entries(evaluations, directions, 1)
    sentences = listed(in_arguments, point, evaluations.slopes, spaces, "its VJP")
    words = []
    for sentence in sentences:
        if sentence.startswith(EVERY_ENTRY):
            words.append(sentence.replace(EVERY_ENTRY, f"{EVERY_ENTRY}its ", 1))
        else:
            words.append(f"largest gap in its {sentence}")
    shapes = [np.shape(weight) for weight in weights.values()]
    is_complex = point.complex or any(map(np.iscomplexobj, weights.values()))
    if not is_complex and sum(map(prod, shapes)) > 1:
        for entry in largest_gaps(_gap_of_results(node, point, worst, weights), shapes, 1):
            if len(shapes) > 1:
                name = f"result {entry.leaf}"
            else:
                name = "result"
            words.append(f"in its {_named(name, entry, shapes[entry.leaf], spaces)}")
    return "".join(f"; {word}" for word in words)


def _gap_of_results(
    node: Node, point: Point, worst: DirectionEvidence, weights: Weights
) -> Callable[[Sequence[Any]], float]:
    """Return the function ``gap_along(parts)``: <w, J d> - <VJP(w), d> with w = weights * parts.

    Here d is the direction in the arguments with the largest gap, and J d is a central difference. The gap is linear in
    `parts`.
    """
    direction = worst.line.direction
    if worst.step > 0:
        step = worst.step
    else:
        step = DEFAULT_STEP

    def results_at(values: Any) -> list[Any]:
        return _results(node, node.again(values))

    ahead = results_at(point.unpack(point.vector + step * direction))
    behind = results_at(point.unpack(point.vector - step * direction))
    slopes = [(np.asarray(ahead[number]) - np.asarray(behind[number])) / (2 * step) for number in weights]
    moving = [True] * len(leaves(node.values))
    tape = taped(results_at, point.fresh(), moving)

    def gap_along(parts: Sequence[Any]) -> float:
        cotangents: list = [None] * len(tape.values)
        gap = 0.0
        for (number, weight), part, slope in zip(weights.items(), parts, slopes, strict=True):
            cotangents[number] = np.asarray(weight * part, np.asarray(tape.values[number]).dtype)[()]
            gap += float(np.sum(cotangents[number] * slope))
        slopes_by_vjp = []
        for slope, x in zip(tape.pull(cotangents), point.values):
            slopes_by_vjp.append(np.zeros(x.size) if slope is None else np.ravel(slope))
        return gap - float(np.concatenate(slopes_by_vjp) @ direction)

    return gap_along


def _entries_of_operator(op: Operator, rng: np.random.Generator) -> str:
    """Return a phrase with the entries of argument and result for which the transpose of a real Operator is wrong."""
    if op.dtype.kind == "c":
        return ""
    op = op.tangent
    u = field(rng, op.domain.shape, float)
    g = field(rng, op.codomain.shape, float)
    forward = op.apply(u)
    backward = op.T.apply(g)

    def gap_in_argument(parts: Sequence[NDArray[Any]]) -> float:
        part = parts[0] * u
        return float(np.sum(op.apply(part) * g) - np.sum(part * backward))

    def gap_in_result(parts: Sequence[NDArray[Any]]) -> float:
        part = parts[0] * g
        return float(np.sum(forward * part) - np.sum(u * op.T.apply(part)))

    in_argument = largest_gaps(gap_in_argument, [u.shape], 1)
    in_result = largest_gaps(gap_in_result, [g.shape], 1)
    words = ""
    for name, entries, space in (("argument", in_argument, op.domain), ("result", in_result, op.codomain)):
        if space.grid is not None:
            spaces = [space]
        else:
            spaces = []
        words += "".join(f"; largest gap in its {_named(name, one, space.shape, spaces)}" for one in entries)
    return words


def _named(name: str, entry: EntryGap, shape: tuple[int, ...], spaces: Sequence[Any]) -> str:
    """Return an entry, or the region that contains the whole gap, as a subscript with its position on the grid."""
    if entry.region is None:
        block = entry.block
    else:
        block = entry.region
    return f"{name}{subscript(block, shape)}{where(block, shape, spaces)}"
