"""Which states of a rollout to keep: binomial checkpointing, optimal for a known number of steps.

The backward pass needs every state once, from the last to the first. States that are not kept are computed again. With
s kept states (the first one included) and each step run at most r times without a tape, a backward pass over

    beta(s, r) = (s + r)! / (s! r!)

steps is possible. For n steps with beta(s, r-1) < n <= beta(s, r) the least number of step evaluations without a tape,
including the n - 1 evaluations of the first run, is

    t(n, s) = r n - beta(s + 1, r - 1).

This minimum is attained if the next kept state lies m steps ahead, with beta(s, r-2) <= m <= beta(s, r-1) and
beta(s-1, r-1) <= n - m <= beta(s-1, r).

References
----------
A. Griewank, A. Walther, ACM Trans. Math. Softw. 26 (2000) 19-45.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from dataclasses import dataclass, replace
from math import ceil, comb
from typing import TYPE_CHECKING

from sparsedp._utils.validation import is_number

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = [
    "CheckpointPlan",
    "advances",
    "budget_within_reach",
    "bytes_of",
    "checkpoints",
    "slots_within",
    "stride",
    "tape_bytes_within",
]

UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
WORKING = 4  # arrays of the size of a state beside the kept ones: current state, two cotangents, result
OWN = 5  # number of states whose memory is reserved for the temporary arrays of a step, if there is enough memory
SLOW = 3  # warn if at most twice the memory would divide the number of step evaluations by this factor


@dataclass(frozen=True)
class CheckpointPlan:
    """Which states a rollout keeps for its backward pass, and which steps keep their tape.

    Parameters
    ----------
    n : int
        Number of steps.
    slots : int or None
        Largest number of states that may be kept; None if all states are kept.
    tape_bytes : int
        Memory in bytes for the tapes of steps that the forward pass keeps.
    is_reversing : bool
        Whether only the last state is kept, and the backward pass computes the others by reversed steps.
    disk_slots : int
        Number of states that are kept in files beside the `slots` in memory.
    """

    n: int
    slots: int | None
    tape_bytes: int
    is_reversing: bool = False
    disk_slots: int = 0

    def with_files(self, most: int) -> CheckpointPlan:
        """Return a plan that keeps states in files if they do not fit into the memory; `most` states fit there."""
        assert self.slots is not None
        return replace(self, disk_slots=max(min(most, self.n - self.slots), 0))

    def disk_indices(self) -> range:
        """Return the indices of the states in files: at equal distances, up to the last steps.

        The memory is used for the last steps in the forward pass, and for the steps between two files in the backward
        pass, so that each file is written and read once.
        """
        if not self.disk_slots:
            return range(0)
        assert self.slots is not None
        steps = self.n - self.slots
        distance = ceil(steps / self.disk_slots)
        return range(distance, steps + distance, distance)

    def stored_indices(self) -> set[int]:
        """Return the indices of the states that the forward pass keeps, the last one included."""
        if self.is_reversing:
            return {self.n}
        if not self.disk_slots and self.slots is None:
            return set(range(self.n + 1))
        if not self.disk_slots:
            return {*checkpoints(self.n, self.slots), self.n}
        in_files = self.disk_indices()
        first = in_files[-1]
        in_memory = {first + i for i in checkpoints(self.n - first, self.slots)}
        return {0, *in_files, *in_memory, self.n}

    def next_index(self, start: int, stop: int, kept: int) -> int:
        """Return the index of the next state to keep while states from `start` to `stop` are computed again.

        Parameters
        ----------
        start, stop : int
            Index of the current state, and of the state that the backward pass needs.
        kept : int
            Number of states that are kept in memory at present.
        """
        if self.slots is None:
            free = 1
        else:
            free = max(self.slots - kept + 1, 1)
        return start + stride(stop + 1 - start, free)


def beta(s: int, r: int) -> int:
    """Return the largest number of steps for s kept states and at most r runs of each; 0 if r or s is negative."""
    if s >= 0 <= r:
        return comb(s + r, r)
    return 0


def repetitions(n: int, s: int) -> int:
    """Return the least r with beta(s, r) >= n."""
    if s == 1:
        return n - 1
    r = 0
    reach = 1
    while reach < n:
        r += 1
        reach = reach * (s + r) // r
    return r


def advances(n: int, s: int) -> int:
    """Return the least number of step evaluations without a tape for a gradient over n steps with s kept states.

    The n - 1 evaluations of the first run are included.
    """
    if n <= 1:
        return 0
    r = repetitions(n, s)
    return r * n - beta(s + 1, r - 1)


def stride(n: int, s: int) -> int:
    """Return the number of steps to the next kept state, if n > 1 steps remain and s states may be kept."""
    if s == 1:
        return n - 1  # no further state can be kept, so run up to the last state that is needed
    r = repetitions(n, s)
    return min(beta(s, r - 1), n - beta(s - 1, r - 1))


def checkpoints(n: int, s: int | None) -> Iterator[int]:
    """Yield the indices of the states that the forward pass keeps if s states may be kept (None: all states)."""
    i = 0
    kept = 0
    while i < n:
        yield i
        kept += 1
        if s is None or n - i == 1:
            i += 1
        else:
            i += stride(n - i, s - kept + 1)


def slots_within(memory: float | str, state_bytes: int, n: int, beside: int = 0) -> int:
    """Return the number of states, at most n, that can be kept in a memory beside the arrays in use.

    Parameters
    ----------
    memory : number of bytes, or text such as "200 MB"
    state_bytes : int
    n : int
        Number of steps.
    beside : int
        Bytes of params and inputs and their gradients.

    Raises
    ------
    ValueError
        If not even the first state fits, or memory is not a positive number of bytes.
    """
    size = max(state_bytes, 1)
    slots = (bytes_of(memory) - beside) // size - WORKING
    if slots < 1:
        raise ValueError(
            f"rollout cannot work within memory={memory!r}: {WORKING + 1} states of {size} bytes and {beside} bytes "
            f"for params and inputs are needed; write memory={(WORKING + 1) * size + beside}"
        )
    slots -= min(OWN, slots // 16)
    return min(slots, max(n, 1))


def budget_within_reach(memory: float | str, state_bytes: int, n: int, beside: int = 0) -> int | None:
    """Return the least memory that divides the number of step evaluations by `SLOW`.

    Return None if that takes more than twice the given memory.

    Examples
    --------
    >>> budget_within_reach(500, 100, 100), budget_within_reach(5000, 100, 100)
    (600, None)
    """
    runs = advances(n, slots_within(memory, state_bytes, n, beside)) + 1
    slots = bisect_left(range(n), True, lo=1, key=lambda s: SLOW * (advances(n, s) + 1) <= runs)
    budget = beside + (slots + min(OWN, slots // 15) + WORKING) * state_bytes
    if slots < n and budget <= 2 * bytes_of(memory):
        return budget
    return None


def tape_bytes_within(memory: float | str, state_bytes: int, n: int, beside: int = 0) -> int:
    """Return the bytes that remain for tapes of steps if all n states are kept; negative if these do not fit."""
    return bytes_of(memory) - beside - (n + WORKING + OWN) * state_bytes


def bytes_of(memory: float | str, name: str = "memory") -> int:
    """Return the number of bytes of a memory given as a number or as a string such as "200 MB".

    `name` is the argument of `rollout` that error messages refer to.
    """
    if isinstance(memory, str):
        match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*([A-Za-z]+)\s*", memory)
        if match and match[2].upper() in UNITS:
            return int(float(match[1]) * UNITS[match[2].upper()])
    elif is_number(memory) and 0 < memory < float("inf"):
        return int(memory)
    raise ValueError(f'rollout needs {name} as bytes > 0 or a text, got {memory!r}; write for example "200 MB"')
