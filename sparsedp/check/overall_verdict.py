"""The verdict on a gradient, from the results along all directions and from further findings."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from sparsedp.check.direction_evidence import CONFIRMING_WORDS, WRONG_WORDS, DirectionEvidence
from sparsedp.check.thresholds import THRESHOLDS

__all__ = ["overall_verdict"]

# The first group that has a member decides the verdict. Its member with the largest gap gives the reason.
VERDICTS = (
    (("unsound",), "inconclusive"),
    (("broken",), "disagrees"),
    (("ripple",), "inconclusive"),
    (WRONG_WORDS, "disagrees"),
    (("open", "hidden modes", "kink", "rough", "noise", "masked", "few", "loose steps"), "inconclusive"),
)


def overall_verdict(
    directions: Sequence[DirectionEvidence],
    findings: Sequence[tuple[str, str]],
    loss: str = "the loss",
    gradient: str = "the gradient",
) -> tuple[str, str]:
    """Return the verdict on a gradient and its reason.

    Parameters
    ----------
    directions : sequence of DirectionEvidence
    findings : sequence of (str, str)
        (word, reason) of each finding that does not belong to a direction.
    loss, gradient : str
        Names of the loss and of the gradient under test in sentences.

    Returns
    -------
    (str, str)
        The verdict ("agrees", "disagrees" or "inconclusive") and its reason, which may be empty for "agrees".
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
    proved = {direction.word for direction in directions} & set(CONFIRMING_WORDS)
    if not proved:
        return "inconclusive", f"{loss} is constant to rounding"
    if "agrees" in proved:
        return "agrees", ""
    return "agrees", f"{gradient} is 0 to rounding, beside the curvature"


def _is_negligible(direction: DirectionEvidence, largest: float) -> bool:
    """Return True if a direction is undecided, but its derivative is negligible relative to the largest one."""
    if direction.word not in ("noise", "masked", "few"):
        return False
    if abs(direction.gap) > THRESHOLDS.bars_agree * direction.bar:
        return False
    if direction.scale + direction.bar <= THRESHOLDS.negligible_share * largest:
        return True
    has_one_digit = direction.word == "noise" and direction.resolution <= 0.1
    return has_one_digit and direction.bar <= THRESHOLDS.small_share * largest
