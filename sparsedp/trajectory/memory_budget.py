"""Which states to keep: binomial checkpointing, optimal for a known number of steps.

With s kept states (the first one included) and at most r runs over any step,

    beta(s, r) = (s + r)! / (s! r!)

steps can be reversed. For n steps with beta(s, r-1) < n <= beta(s, r) the least number of plain steps is

    t(n, s) = r n - beta(s + 1, r - 1),

the first run over n - 1 steps included. It is reached by any rule that puts the next kept state m steps
further on, where both parts stay in the range of their own r: beta(s, r-2) <= m <= beta(s, r-1) and
beta(s-1, r-1) <= n - m <= beta(s-1, r).
"""

import re
from bisect import bisect_left
from math import comb

from sparsedp._utils.validation import is_number

__all__ = [
    "advances",
    "budget_within_reach",
    "checkpoints",
    "room_within",
    "slots_within",
    "stride",
]

UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
WORKING = 4  # states at work beside the kept ones: the present, its cotangent and the one before, the result
OWN = 5  # states left to what a step needs by itself, where there is room for that
SLOW = 3  # times as many steps run as with a budget up to twice as large: worth a warning


def beta(s, r):
    """Number of steps that s kept states and r runs can reverse; 0 where r or s is negative."""
    return comb(s + r, r) if s >= 0 <= r else 0


def repetitions(n, s):
    """The least r with beta(s, r) >= n."""
    if s == 1:
        return n - 1
    r, reach = 0, 1
    while reach < n:
        r += 1
        reach = reach * (s + r) // r
    return r


def advances(n, s):
    """Least number of plain steps that reversing n steps takes with s kept states, the first run included."""
    if n <= 1:
        return 0
    r = repetitions(n, s)
    return r * n - beta(s + 1, r - 1)


def stride(n, s):
    """How many steps further on the next state is kept, when n > 1 steps lie ahead and s states may be kept."""
    if s == 1:
        return n - 1  # nothing is kept: on to the last state
    r = repetitions(n, s)
    return min(beta(s, r - 1), n - beta(s - 1, r - 1))


def checkpoints(n, s):
    """Indices of the states to keep on the way forward, when s states may be kept; None: all."""
    i, kept = 0, 0
    while i < n:
        yield i
        kept += 1
        i += 1 if s is None or n - i == 1 else stride(n - i, s - kept + 1)


def slots_within(memory, state_bytes, n, beside=0):
    """Memory and bytes of a state -> how many states may be kept beside those at work, at most n.

    `beside`: bytes of what is there once, params and inputs and their gradients.

    Raises
    ------
    ValueError
        If not even the first state fits, or memory is no positive number of bytes.
    """
    allowed, size = _bytes(memory), max(state_bytes, 1)
    slots = (allowed - beside) // size - WORKING
    if slots < 1:
        raise ValueError(
            f"rollout cannot work within memory={memory!r}: {WORKING + 1} states of {size} bytes and {beside} bytes "
            f"for params and inputs are needed; write memory={(WORKING + 1) * size + beside}"
        )
    slots -= min(OWN, slots // 16)
    return min(slots, max(n, 1))


def budget_within_reach(memory, state_bytes, n, beside=0):
    """The least number of bytes with which n steps take a third of the runs, where twice the memory is enough; or None.

    Examples
    --------
    >>> budget_within_reach(500, 100, 100), budget_within_reach(5000, 100, 100)
    (600, None)
    """
    runs = advances(n, slots_within(memory, state_bytes, n, beside)) + 1
    slots = bisect_left(range(n), True, lo=1, key=lambda s: SLOW * (advances(n, s) + 1) <= runs)
    budget = beside + (slots + min(OWN, slots // 15) + WORKING) * state_bytes
    return budget if slots < n and budget <= 2 * _bytes(memory) else None


def room_within(memory, state_bytes, n, beside=0):
    """Bytes left for other things where all n states and those at work are kept; less than 0 when there are none."""
    return _bytes(memory) - beside - (n + WORKING + OWN) * state_bytes


def _bytes(memory):
    """Bytes, or a text such as "200 MB" -> bytes."""
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*([A-Za-z]+)\s*", memory) if isinstance(memory, str) else None
    if match and match[2].upper() in UNITS:
        return int(float(match[1]) * UNITS[match[2].upper()])
    if not is_number(memory) or not 0 < memory < float("inf"):
        raise ValueError(f'rollout needs memory as bytes > 0 or a text, got {memory!r}; write for example "200 MB"')
    return int(memory)
