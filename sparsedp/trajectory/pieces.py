"""Pieces of a run that stand on a tape: one step, or neighbouring steps of one array on one tape.

A piece is made on the way forward while its tape fits, and kept for the backward pass: no step runs twice. Else it is
made on the backward pass, from a state that was kept. Each step has roots of its own for params and inputs, and their
cotangents are added up in the order of single steps: the bits do not depend on how many steps a piece has.
"""

import numpy as np

from sparsedp.ledger import thread

__all__ = ["Piece", "Scale"]

CALL = 800  # bytes of a node, its closures and tuples: 350 to 1200 were measured


class Piece:
    """Some steps on one tape.

    Attributes
    ----------
    first : int
    state : list
        The roots of the first state, None where a constant is.
    statics : tuple
        Its other leaves.
    params, inputs : lists of lists
        For each step its roots.
    ends : list
        The nodes of the last state, None where it does not depend on anything traced.
    """

    def __init__(self, first, state, statics):
        self.first, self.state, self.statics = first, state, statics
        self.params: list = []
        self.inputs: list = []
        self.ends: list = []

    @property
    def stop(self):
        """The number of the state it leads to."""
        return self.first + len(self.params)

    @property
    def roots(self):
        """All roots in one list: those of the state, then of params and inputs, step by step."""
        lines = [self.state, *(line for pair in self.steps for line in pair)]
        return [root for line in lines for root in line if root is not None]

    @property
    def steps(self):
        """For each step the roots of params, and those of inputs."""
        return list(zip(self.params, self.inputs, strict=True))


class Scale:
    """Adds up the bytes of tapes: every result, and every array that goes in beside traced values.

    One step of a piece is weighed call by call, the others are taken to be as heavy. An array that many calls use is
    counted once. It knows no node: a circle would keep a tape for long.

    Parameters
    ----------
    room : float
        Bytes that the tapes may take beside the states on them.
    state : int
        Bytes of a state: one on a tape is not kept apart from it.
    """

    def __init__(self, room, state):
        self.room, self.state = room, state
        self.bytes = self.last = self._before = 0
        self._seen: set[int] = set()

    def add(self, value, args, nums):
        """Count one call."""
        self.bytes += CALL + getattr(value, "nbytes", 0)
        for number, arg in enumerate(args):
            if number not in nums:
                self._add(arg)

    def _add(self, arg):
        if isinstance(arg, (tuple, list)):  # of indices
            for one in arg:
                self._add(one)
        elif isinstance(arg, np.ndarray) and id(arg) not in self._seen:
            self._seen.add(id(arg))
            self.bytes += arg.nbytes

    def begin(self):
        """Weigh what comes."""
        self._before, thread.scale = self.bytes, self

    def step(self):
        """One step has been taped."""
        if thread.scale is self:
            thread.scale, self.last = None, self.bytes - self._before - self.state
            self.bytes = self._before
        self.bytes += self.last

    @property
    def fits(self):
        """Whether all that was counted fits."""
        return self.bytes <= self.room

    @property
    def has_room(self):
        """Whether there is room for one more step."""
        return self.bytes + self.last <= self.room
