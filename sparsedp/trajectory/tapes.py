"""Tapes of single steps, made on the way forward and kept for the way back while they fit: no step runs twice.

The bytes of a tape are counted from above: every result, every array that went into a call, and CALL for the call.
A step may write into an array of its own again and again: its tape holds a copy of what was there.
"""

from contextlib import contextmanager
from typing import Any

import numpy as np

from sparsedp.traces import ReverseNode, reverse_root, untraced

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
            self.scale.bytes += CALL + getattr(value, "nbytes", 0)
            for number, arg in enumerate(args):
                if number not in nums:
                    self.scale.see(arg)

    return Weighed


PLAIN = weighed(ReverseNode)
untraced[PLAIN] = untraced[ReverseNode]  # comparisons, shapes, rounding: plain values for this kind too


class Scale:
    """What the nodes of a weighed tape add to. It knows no node: a circle would keep a tape for long."""

    def __init__(self):
        self.bytes = 0

    def see(self, arg):
        """Weigh what a tape holds beside traced values."""
        if type(arg) is np.ndarray:
            self.bytes += arg.nbytes
        elif isinstance(arg, (tuple, list)):  # of indices
            for one in arg:
                self.see(one)


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
        self.scale, self._last, self._open = Scale(), 0, True
        self._kept: dict = {}
        self.pieces: list = []  # tapes of several steps each, from the first step on
        self._kind: Any = PLAIN

    @property
    def bytes(self):
        """Bytes of the tapes so far."""
        return self.scale.bytes

    @contextmanager
    def fresh(self):
        """A `with` block on the way forward, from which tapes are kept; those of a run before are forgotten."""
        self.scale, self._last, self._kept, self.pieces = Scale(), 0, {}, []
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
        return self._open and self.scale.bytes < self.room

    def root(self):
        """A root whose tape is weighed here."""
        root = self._kind.new_root()
        root.scale = self.scale
        return root

    def keep(self, i, ends, before):
        """Keep the ends of the tape of step i, unless it was one too many; `before`: the bytes before this step."""
        self.add(self.weighs(i), before)
        if self.fit:
            self._kept[i] = ends

    def add(self, weighed, before):
        """Count the tape of one more step; `before`: the bytes before it, where it was weighed."""
        scale = self.scale
        if weighed:
            self._last = scale.bytes - before
        else:
            scale.bytes += self._last

    def next_weighed(self, i):
        """The next step after i that is weighed."""
        return next(k for k in range(i + 1, i + EVERY + 1) if self.weighs(k))

    def steps_left(self):
        """How many more steps like the last one there is room for."""
        return int((self.room - self.scale.bytes) // max(self._last, 1))

    def linked(self, wanted):
        """How many steps from the first on are linked; 0 where other cotangents are wanted."""
        if wanted != self.wanted:
            self.pieces = []
        return self.pieces[-1].stop if self.pieces else 0

    def take(self, i, wanted):
        """The ends of the tape of step i, or None."""
        if wanted != self.wanted:
            return None
        return self._kept.pop(i, None) if self.once else self._kept.get(i)
