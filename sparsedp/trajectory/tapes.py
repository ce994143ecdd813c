"""Tapes of single steps, made on the way forward and kept for the way back while they fit: no step runs twice.

The bytes of a tape are counted from above: every result, every array that went into a call, and CALL for the call.
"""

from contextlib import contextmanager
from typing import Any

import numpy as np

from sparsedp.tape import ReverseNode, reverse_root, untraced

__all__ = ["Tapes"]

CALL = 1500  # bytes of a node, its closures and tuples
EVERY = 8  # steps are weighed one by one at first, then one of so many, for all of them
SMALL = 2**22  # bytes for tapes where no budget is given


def weighed(kind: Any):
    """A kind of node -> the same, with a scale at its roots that adds up the bytes of the tape."""

    class Weighed(kind):
        __slots__ = ("scale",)
        scale: Any

        def __init__(self, value, fun, args, options, nums, parents):
            super().__init__(value, fun, args, options, nums, parents)
            self.scale = parents[0].scale
            arrays = [value, *(arg for number, arg in enumerate(args) if number not in nums)]
            self.scale.bytes += CALL + sum(array.nbytes for array in arrays if type(array) is np.ndarray)

    return Weighed


PLAIN = weighed(ReverseNode)
untraced[PLAIN] = untraced[ReverseNode]  # comparisons, shapes, rounding: plain values for this kind too


class Tapes:
    """The tapes of a run.

    Parameters
    ----------
    room : int or None
        Bytes they may take; None: SMALL.
    wanted : frozenset of int
        The arguments of the run that want a cotangent.
    once : bool
        Whether a tape goes when it is used: under a budget.
    """

    def __init__(self, room, wanted, once):
        self.room, self.wanted, self.once = SMALL if room is None else room, wanted, once
        self.bytes, self._last, self._open = 0, 0, True
        self._kept: dict = {}
        self._kind: Any = PLAIN

    @contextmanager
    def fresh(self):
        """A `with` block on the way forward, from which tapes are kept; those of a run before are forgotten."""
        self.bytes, self._last, self._kept = 0, 0, {}
        kind = type(reverse_root())
        self._open = not getattr(kind, "asks_again", False)
        self._kind = PLAIN if kind is ReverseNode else weighed(kind)
        untraced[self._kind] = untraced[ReverseNode]
        try:
            yield self
        finally:
            if self._kind is not PLAIN:
                del untraced[self._kind]

    def weighs(self, i):
        """Whether step i is weighed itself, not taken to be as heavy as the one before."""
        return i < 2 or i % EVERY == 0

    @property
    def fit(self):
        """Whether there is room for the tape of one more step."""
        return self._open and self.bytes < self.room

    def root(self):
        """A root whose tape is weighed here."""
        root = self._kind.new_root()
        root.scale = self
        return root

    def keep(self, i, ends, before):
        """Keep the ends of the tape of step i, unless it was one too many; `before`: the bytes before this step."""
        if self.weighs(i):
            self._last = self.bytes - before
        else:
            self.bytes += self._last
        if self.fit:
            self._kept[i] = ends

    def take(self, i, wanted):
        """The ends of the tape of step i, or None."""
        if wanted != self.wanted:
            return None
        return self._kept.pop(i, None) if self.once else self._kept.get(i)
