"""Where and why a derivative of a program is wrong: the entries of x and of f(x), and the kind of the mistake."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from math import inf, isnan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.pytree import norm
from sparsedp.check.balanced_directions import entry_units
from sparsedp.check.direction_evidence import WRONG_WORDS, DirectionEvidence
from sparsedp.check.entries import MOST_ENTRIES, EntryGap, gaps_along_entries, largest_gaps, listed
from sparsedp.check.evaluations import EVALUATION_ERRORS

__all__ = ["Places", "diagnosis_of", "places_of"]

STEP = 2.0**-10  # used if a sweep found no plateau
EXPLAINED_SHARE = 1e-4  # a mistake is recognized if the repaired derivative is off by at most this share
MUCH_LESS = 0.02
CLEAR_OF_NOISE = 8.0  # a gap has to be this many times the rounding error of its measurement
CONJUGATES = {
    (True, True): "it follows the convention {other!r} for complex numbers; write convention={other!r}",
    (True, False): "it agrees if its cotangent is conjugated: a conjugate is missing, or one too many",
    (False, True): "it agrees if its result is conjugated: a conjugate is missing, or one too many",
}


class Places(NamedTuple):
    """Where a derivative is wrong.

    Attributes
    ----------
    in_argument, in_result : list of str
        A sentence for each entry or region of x, and of f(x).
    is_spread : bool
        Whether the gaps are at separate entries of x, without a region or a common factor.
    relative_gap : float
        The largest gap of these entries relative to the derivative there.
    """

    in_argument: list[str]
    in_result: list[str]
    is_spread: bool
    relative_gap: float


def places_of(audit: Any) -> Places:
    """Find the entries or regions of x, and of f(x), in which the derivative is wrong.

    Parameters
    ----------
    audit : DerivativeAudit
        `audit.worst` has the direction with the largest gap.
    """
    group, worst = audit.worst
    in_argument: list[EntryGap] = []
    in_result: list[EntryGap] = []
    with suppress(*EVALUATION_ERRORS):
        in_argument = _clear(_gaps_in_argument(audit, group))
    with suppress(*EVALUATION_ERRORS):
        in_result = _clear(_gaps_in_result(audit, group, worst))
    point = group.evaluations.point
    slopes = None
    if audit.kind == "vjp":
        slopes = group.evaluations.slopes
    argument_sentences = listed(in_argument, point, slopes, audit.options.spaces, audit.title)
    result_sentences = listed(in_result, audit.program.result, None, audit.options.spaces, audit.title)
    is_spread = len(in_argument) > 1 and all(entry.region is None for entry in in_argument)
    relative_gap = 0.0
    if is_spread and slopes is not None:
        for entry in in_argument:
            slope = np.reshape(point.split(slopes)[entry.leaf], -1)
            size = float(np.max(np.abs(slope), initial=0.0))
            relative_gap = max(relative_gap, abs(entry.gap) / size if size else inf)
    return Places(argument_sentences, result_sentences, is_spread, relative_gap)


def _clear(entries: list[EntryGap]) -> list[EntryGap]:
    """Return the gaps without those that noise has hidden before the bisection ended, unless there is no other."""
    clear = [entry for entry in entries if entry.region is not None or not isnan(entry.gap)]
    return clear or entries[:1]


def _gaps_in_argument(audit: Any, group: Any) -> list[EntryGap]:
    """Return the largest gaps in entries of x."""
    evaluations = group.evaluations
    point = evaluations.point
    slope_along = None
    if audit.kind == "jvp":

        def slope_along(direction: NDArray[Any]) -> float:
            product = audit.program.push(point.fresh(), audit.tangent(direction))
            return float(group.weights @ product)

    return gaps_along_entries(evaluations, group.directions, MOST_ENTRIES, slope_along, entry_units(point))


def _gaps_in_result(audit: Any, group: Any, worst: DirectionEvidence) -> list[EntryGap]:
    """Return the largest gaps in entries of f(x), for the direction in x along which the gap is largest."""
    result = audit.program.result
    if audit.base.size < 2:
        return []
    point = group.evaluations.point
    direction = worst.line.direction
    step = worst.difference_step if worst.step > 0 else STEP
    ends = [audit.program.value(point.unpack(point.vector + side * direction)) for side in (step, -step)]
    change = (ends[0] - ends[1]) / (2 * step)
    product = None
    if audit.kind == "jvp":
        product = audit.program.push(point.fresh(), audit.tangent(direction))

    def weights_of(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        vectors = []
        for part, y in zip(parts, result.values, strict=True):
            if np.iscomplexobj(y):
                part = part * (1 + 1j)
            vectors.append(np.ravel(part).view(float))
        return audit.program.rounded(np.abs(group.weights) * np.concatenate(vectors))

    def slope_along(parts: Sequence[NDArray[Any]]) -> float:
        weights = weights_of(parts)
        if product is not None:
            return float(weights @ product)
        if not np.any(weights):
            return 0.0
        return float(audit.program.pull(point.fresh(), weights) @ direction)

    def gap_along(parts: Sequence[NDArray[Any]]) -> float:
        return float(weights_of(parts) @ change) - slope_along(parts)

    noise = CLEAR_OF_NOISE * max(2.0, worst.jitter) * audit.like.eps * norm(group.weights * audit.base) / step
    noise = max(noise, CLEAR_OF_NOISE * worst.bar if np.isfinite(worst.bar) else 0.0)
    return largest_gaps(gap_along, [y.shape for y in result.values], MOST_ENTRIES, noise, slope_along)


# ------------------------------------------------------------ mistakes with a name


def diagnosis_of(audit: Any) -> str | None:
    """Return a phrase about the mistake in a derivative if it is one of a few frequent ones."""
    if audit.kind != "vjp" or not audit.groups or audit.worst is None:
        return None
    group = audit.groups[0]
    if not group.directions or not any(direction.bar < np.inf for direction in group.directions):
        return None
    with suppress(*EVALUATION_ERRORS):
        return _conjugate(audit, group) or _transpose(audit, group) or _stored_value(audit)
    return None


def _is_explained(group: Any, slopes: NDArray[Any]) -> bool:
    """Return whether other slopes agree with the differences along all directions at x."""
    for direction in group.directions:
        gap = abs(direction.difference - float(slopes @ direction.line.direction))
        if not gap <= EXPLAINED_SHARE * direction.scale + direction.bar:
            return False
    return True


def _conjugate(audit: Any, group: Any) -> str | None:
    """Return a phrase if the VJP is right except for complex conjugates."""
    if not (audit.point.complex or audit.program.result.complex):
        return None
    tree = audit.point.fresh()
    for (argument, result), words in CONJUGATES.items():
        if _is_explained(group, audit.program.pull(tree, group.weights, argument, result)):
            other = {"transpose": "adjoint", "adjoint": "transpose"}[audit.program.convention]
            return words.format(other=other)
    return None


def _transpose(audit: Any, group: Any) -> str | None:
    """Return a phrase if the VJP multiplies by the Jacobian instead of its transpose."""
    point = audit.point
    shapes = [[values.shape for values in packing.values] for packing in (point, audit.program.result)]
    if shapes[0] != shapes[1] or point.vector.size != audit.base.size:
        return None
    wrong = [direction.share for direction in group.directions if direction.word in WRONG_WORDS]
    if not wrong:
        return None
    scale = norm(point.units) / norm(group.weights)
    ends = [audit.program.value(point.unpack(point.vector + side * scale * group.weights)) for side in (STEP, -STEP)]
    product = (ends[0] - ends[1]) / (2 * STEP * scale)
    slopes = group.evaluations.slopes
    if norm(product - slopes) <= MUCH_LESS * max(wrong) * norm(slopes):
        return "it multiplies by the Jacobian instead of its transpose"
    return None


def _is_curved(direction: DirectionEvidence) -> bool:
    """Return whether f has a second derivative along a direction, at coarse steps and near the best step."""
    if not direction.steps.size or not direction.curvature > MUCH_LESS * direction.scale:
        return False
    nearest = int(np.argmin(np.abs(np.log(direction.steps / direction.step))))
    bend = abs(direction.kinks[nearest]) / direction.steps[nearest]
    return bool(bend > 0.3 * direction.curvature)


def _stored_value(audit: Any) -> str | None:
    """Return a phrase if the VJP returns the same cotangent at x and beside x, although f is not linear."""
    *groups, last = audit.groups
    if last.evaluations.point is audit.point:
        return None
    for group in groups:
        first = group.directions[0] if group.directions else None
        if group.weights is last.weights and first is not None:
            slopes = group.evaluations.slopes
            if _is_curved(first) and np.any(slopes) and np.array_equal(slopes, last.evaluations.slopes):
                return "it returns the same cotangent at x and beside x: it uses a stored value, or a term is missing"
    return None
