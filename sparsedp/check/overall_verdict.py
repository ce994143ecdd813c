"""From the words of all directions, and further findings, to the verdict on a gradient."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from sparsedp.check.direction_evidence import PROVED, DirectionEvidence
from sparsedp.check.thresholds import THRESHOLDS

__all__ = ["overall_verdict"]

# The first group with a member decides, by the member with the largest gap.
VERDICTS = (
    (("unsound",), "inconclusive"),
    (("broken",), "disagrees"),
    (("ripple",), "inconclusive"),
    (("disagrees", "outside"), "disagrees"),
    (("open", "hidden modes", "kink", "rough", "noise", "masked", "few", "loose steps"), "inconclusive"),
)


def overall_verdict(directions: Sequence[DirectionEvidence], findings: Sequence[tuple[str, str]]) -> tuple[str, str]:
    """Return the verdict on a gradient and its reason.

    Parameters
    ----------
    directions : sequence of DirectionEvidence
    findings : sequence of (str, str)
        Word and reason of what was found beside the directions.

    Returns
    -------
    (str, str)
        "agrees", "disagrees" or "inconclusive"; the reason is empty where the gradient simply agrees.
    """
    largest = max((direction.scale for direction in directions), default=0.0)
    evidence = [(word, reason, inf) for word, reason in findings]
    for direction in directions:
        if not _is_negligible(direction, largest):
            reason = f"along {direction.direction}: {direction.note}"
            evidence.append((direction.word, reason, direction.share if direction.is_wrong else 0.0))
    for words, verdict in VERDICTS:
        members = [(reason, share) for word, reason, share in evidence if word in words]
        if members:
            reason, _ = max(members, key=lambda member: member[1])
            return verdict, reason
    proved = {direction.word for direction in directions} & set(PROVED)
    if not proved:
        return "inconclusive", "the loss is constant to rounding"
    if "agrees" in proved:
        return "agrees", ""
    return "agrees", "the gradient is 0 to rounding, beside the curvature"


def _is_negligible(direction: DirectionEvidence, largest: float) -> bool:
    """Return whether an undecided direction has a small derivative by gradient and differences beside the largest."""
    if direction.word not in ("noise", "masked", "few"):
        return False
    if abs(direction.gap) > THRESHOLDS.bars_agree * direction.bar:
        return False
    if direction.scale + direction.bar <= THRESHOLDS.negligible_share * largest:
        return True
    has_one_digit = direction.word == "noise" and direction.resolution <= 0.1
    return has_one_digit and direction.bar <= THRESHOLDS.small_share * largest
