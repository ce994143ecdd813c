"""Tapes of steps: their calls in order, made on the way forward while the tapes fit, or on the backward pass.

The calls of one trace are recorded as they come, so the backward pass goes through them from the last to the first and
need not sort a graph: the bits of a gradient do not depend on which tapes were kept. Params have one root for all
steps.
"""

from typing import NamedTuple

import numpy as np

from sparsedp.traces import new_trace, reverse_root
from sparsedp.trajectory.layout import owned

__all__ = ["Recorder", "State", "Tape", "Trace"]

CALL = 800  # bytes of a node, its closures and tuples: 350 to 1200 were measured


class State(NamedTuple):
    """State i of a run: its variables, and its other leaves."""

    i: int
    values: list
    statics: tuple

    def owned(self):
        """The same in memory of its own: a step may use the arrays again that it has returned."""
        return self._replace(values=list(map(owned, self.values)))


class Tape(NamedTuple):
    """One step, or several of which each begins with the very values that the one before ends with.

    Attributes
    ----------
    first : int
        Number of the first step.
    state : list
        The roots of its state, None where a constant is.
    inputs : list of lists
        For each step the roots of its inputs.
    nodes : list
        All calls.
    starts : list of int
        How many calls there are before each step.
    ends : list
        The nodes of the last state, None where that does not depend on anything traced.
    """

    first: int
    state: list
    inputs: list
    nodes: list
    starts: list
    ends: list

    @property
    def stop(self):
        """Number of the state it leads to."""
        return self.first + len(self.starts)


class Trace(NamedTuple):
    """What all tapes of a run begin with.

    Attributes
    ----------
    wanted : frozenset of int
        The arguments that want a cotangent.
    number : int
    recorder : Recorder
    roots : list
        Of the arguments, None where no cotangent is wanted.
    """

    wanted: frozenset
    number: int
    recorder: "Recorder"
    roots: list

    @classmethod
    def begun(cls, many, wanted):
        """A new trace of so many arguments."""
        recorder = Recorder()
        roots = [reverse_root(recorder) if number in wanted else None for number in range(many)]
        return cls(frozenset(wanted), new_trace(), recorder, roots)


class Recorder:
    """Takes down the calls of a trace; and weighs them while `weighs` is true.

    Counted are the results (`bytes`), and apart from them every array that goes in beside traced values (`beside`); one
    that many calls use counts once.
    """

    def __init__(self):
        self.weighs, self.bytes, self.beside = False, 0, 0
        self.nodes: list = []
        self._seen: set[int] = set()

    def weigh(self, value, args, nums):
        """One call that depends on its arguments `nums`."""
        self.bytes += CALL + getattr(value, "nbytes", 0)
        self._weigh([arg for number, arg in enumerate(args) if number not in nums])

    def _weigh(self, args):
        for arg in args:
            if isinstance(arg, (tuple, list)):  # of indices
                self._weigh(arg)
            elif isinstance(arg, np.ndarray) and id(arg) not in self._seen:
                self._seen.add(id(arg))
                self.beside += arg.nbytes

    def taken(self):
        """The calls since it was asked last: it forgets them, for they know it, and a circle is freed late."""
        nodes, self.nodes = self.nodes, []
        return nodes
