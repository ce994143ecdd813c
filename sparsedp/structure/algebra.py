"""Products and sums of structures: kept as factors where that is exact, lazy elsewhere."""

from sparsedp.structure.kronecker import Kronecker
from sparsedp.structure.lazy import Chain, Diagonal, Mask, Sum

__all__ = ["compose", "total"]


def compose(a, b):
    """Structure of a @ b.

    Identities vanish, factor-defined maps stay factor-defined, diagonals meet in one diagonal;
    the rest becomes a chain, whose ends are tried first.
    """
    left = list(a.members) if isinstance(a, Chain) else [a]
    right = list(b.members) if isinstance(b, Chain) else [b]
    while left and right:
        joined = _joined(left[-1], right[0])
        if joined is None:
            break
        left, right = left[:-1], [joined, *right[1:]]
        if len(right) > 1 and (closer := _joined(right[0], right[1])) is not None:
            right = [closer, *right[2:]]
    members = left + right
    return members[0] if len(members) == 1 else Chain(members)


def _joined(a, b):
    """One structure for a @ b, or None when it has to stay a pair."""
    if b.is_identity:
        return a
    if a.is_identity:
        return b
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and a.in_parts == b.out_parts:
        return a.composed(b)
    if isinstance(a, Mask) and isinstance(b, Mask):
        return Mask(a.keep & b.keep)
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        return Diagonal(a.values * b.values)
    return None


def total(a, b):
    """Structure of a + b."""
    left = list(a.members) if isinstance(a, Sum) else [a]
    right = list(b.members) if isinstance(b, Sum) else [b]
    for member in right:
        for place, other in enumerate(left):
            joined = _added(other, member)
            if joined is not None:
                left[place] = joined
                break
        else:
            left.append(member)
    return left[0] if len(left) == 1 else Sum(left)


def _added(a, b):
    if isinstance(a, Kronecker) and isinstance(b, Kronecker) and (a.out_parts, a.in_parts) == (b.out_parts, b.in_parts):
        return a.added(b)
    if isinstance(a, Diagonal) and isinstance(b, Diagonal):
        return Diagonal(a.values + b.values)
    return None
