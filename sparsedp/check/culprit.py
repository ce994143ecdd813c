"""Who is at fault when a gradient is wrong: each call on the tape, audited alone at the values it met.

The loss of a call f is <g, f(x)> with a fixed random g. Its gradient by the rule's own VJP is judged as that of
any loss. An Operator is linear: <A u, g> - <u, A^T g> and A (u + v) - A u - A v tell all, without differences.
"""

from typing import Any, NamedTuple

import numpy as np

from sparsedp.check.extension import measured
from sparsedp.check.point import Point
from sparsedp.check.probes import field, generator, unit
from sparsedp.check.sweep import Line, Trials, default_steps, dot
from sparsedp.check.visits import witnessed
from sparsedp.derivative import NO_JVP, pullback, pushforward, value_and_grad
from sparsedp.errors import DerivativeError
from sparsedp.ledger import recording
from sparsedp.operator import Operator
from sparsedp.solvers.solution import Inverse

__all__ = ["Fault", "culprit_of"]

MOST = 6  # calls of one rule that are audited, spread over its calls
DIRECTIONS = 2
LINEAR = 1e3  # roundings of an application, or tolerances of its solve, that two linear forms may differ by
APART = 1e-9  # JVP and VJP of a rule
SOLVED = 1e-6  # the same where there is a solve inside


class Fault(NamedTuple):
    """A call whose derivative is wrong: how it is called, and what is wrong with it."""

    name: str
    reason: str


def culprit_of(loss, point, rng=None):
    """Loss and point -> the first call on the tape whose own derivative is at fault, or None.

    Parameters
    ----------
    loss : callable
    point : Point
    rng : None, int or numpy Generator

    Returns
    -------
    Fault or None
        In the order of the calls. A call that others are made inside of (a time loop, a root) is named
        only when none of those is at fault.
    """
    with np.errstate(all="ignore"), witnessed() as found:
        value_and_grad(loss)(point.tree())
    audit = Audits(found, generator(rng))
    return audit.first([visit for visit in found if visit.inside is None])


class Audits:
    """Audits of calls; of many calls of one rule some, spread over all."""

    def __init__(self, found, rng):
        self.found, self.rng = found, rng
        groups: dict[Any, list] = {}
        for visit in found:
            groups.setdefault(id(visit.subject), []).append(visit)
        chosen = [calls[place] for calls in groups.values() for place in _spread(calls)]
        self.chosen = set(map(id, chosen))
        self.cleared: set[int] = set()  # Operators that were found right

    def first(self, calls):
        """The first fault among calls, or inside of one."""
        for visit in calls:
            inner = [other for other in self.found if other.inside is visit]
            known = visit.plain and not isinstance(visit.value, tuple)  # else only what is inside can be judged
            fault = self._fault(visit) if known and id(visit) in self.chosen else None
            if fault or (inner and not known):
                fault = self.first(inner) or fault
            if fault:
                return fault
        return None

    def _fault(self, visit):
        if isinstance(visit.subject, Operator):
            return self._of_operator(visit.subject)
        with np.errstate(all="ignore"), recording() as calls:
            fault = _of_rule(visit, self.rng)
        if fault is None:
            return None
        actors = [actor for found in calls.actors.values() for actor in found.values()]
        inner = (self._of_operator(actor) for actor in actors if isinstance(actor, Operator))
        return next((found for found in inner if found), fault)

    def _of_operator(self, op):
        """A fault of an Operator; of an inverse, rather of the operator that it inverts."""
        if id(op) in self.cleared:
            return None
        self.cleared.add(id(op))
        with np.errstate(all="ignore"):
            reason = _wrong_operator(op, self.rng)
        if not reason:
            return None
        name = op.T.name if op.name.endswith(".T") else op.name  # it and its transpose are one operator
        if isinstance(op, Inverse) and _wrong_operator(op.solver.system.given, self.rng):
            reason += f"; so is that of {op.solver.system.given.name}, which it inverts"
        return Fault(name, reason)


def _spread(calls):
    """Places of at most MOST calls, the first and the last among them."""
    return {round(place) for place in np.linspace(0, len(calls) - 1, min(MOST, len(calls)))}


# ------------------------------------------------------------ operators


def _wrong_operator(op, rng):
    """What is wrong with the transpose, the tangent or the linearity of an Operator; "" if nothing."""
    op = op.tangent
    kind = op.dtype if op.dtype.kind == "c" else np.dtype(float)
    allowed = LINEAR * unit(op.structure, float)
    worst, words = 0.0, ""
    for _ in range(DIRECTIONS + 1):
        u, v, g = (field(rng, space.shape, kind) for space in (op.domain, op.domain, op.codomain))
        try:
            there, along, both, back = op.apply(u), op.apply(v), op.apply(u + v), pullback(op, u)[1](g)
        except DerivativeError as error:
            return str(error)
        size = np.linalg.norm
        gaps = (
            ("its transpose", abs(np.sum(there * g) - np.sum(u * back)), size(there) * size(g) + size(u) * size(back)),
            ("its linearity", size(both - there - along), size(there) + size(along)),
        )
        for what, gap, scale in gaps:
            share = gap / scale * np.sqrt(g.size if what == "its transpose" else 1) if gap else 0.0
            worst, words = max((worst, words), (share if np.isfinite(share) else np.inf, what))
    return f"{words} is off by about {worst:.0e}" if worst > allowed * np.sqrt(max(op.shape)) else ""


# ------------------------------------------------------------ rules and functions


def _of_rule(visit, rng):
    """Fault of the VJP by differences of the call's own forward; of the JVP, by the VJP."""
    try:
        point = Point(visit.values)
    except Exception:  # no values that could be moved: nothing to be judged here
        return None
    g = field(rng, np.shape(visit.value), np.asarray(visit.value).dtype)
    trials = Trials(lambda values: np.sum((g * visit.again(values)).real))
    base = trials.value(point.tree())
    if not np.isfinite(base):
        return None
    pulled = point.leaves_of(pullback(visit.again, point.tree())[1](g))
    lines = [Line(name, d, point, pulled, trials, base) for name, d in _directions(point, pulled, rng)]
    steps = default_steps(point.eps)
    for line in lines:
        found = measured(line, steps, point, trials, extend=True)
        if found.word == "disagrees":
            return Fault(visit.name, f"its VJP is {found.note}" if found.gap == found.gap else found.note)
    return _wrong_jvp(visit, point, lines, g, trials)


def _directions(point, pulled, rng):
    """Random ones, in each argument alone, and the largest entry: a loss of many entries hides single ones."""
    chosen = point.directions(pulled, DIRECTIONS, rng)
    return [(name, d) for name, d in chosen if name not in ("constant", "gradient")]


def _wrong_jvp(visit, point, lines, g, trials):
    allowed = max(SOLVED if trials.solved else APART, 300 * point.eps)
    for line in lines[:DIRECTIONS]:
        tangent = [d.astype(x.dtype) for d, x in zip(line.direction, point.values, strict=True)]
        try:
            _, slope = pushforward(visit.again, point.tree(), point.tree(tangent))
        except NO_JVP:
            return None
        there, back = float(np.sum((g * slope).real)), dot(line.gradient, tangent)
        gap = abs(there - back) / max(abs(there), abs(back), line.typical, np.finfo(float).tiny)
        if not gap <= allowed:
            return Fault(visit.name, f"its JVP differs from its VJP by {gap:.1e}, and its VJP is right")
    return None
