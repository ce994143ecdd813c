"""Every node of a reverse-mode tape, seen while it is made: what was called, with which values, inside what."""

from contextlib import contextmanager
from types import CellType
from typing import Any

import numpy as np

from sparsedp.ledger import thread
from sparsedp.tape import called, isbox
from sparsedp.traces import ReverseNode, untraced

__all__ = ["Visit", "bytes_held", "witnessed"]

EMPTY = CellType()
DEEPEST = 12  # levels of containers inside each other; deeper ones are not the tape's


class Visit:
    """One call that the tape holds.

    Attributes
    ----------
    subject : Rule, Operator, or a function of autograd
    fun : callable
        ``fun(*args, **options)`` is the call.
    nums : tuple of int
        Places of the arguments that are differentiated.
    inside : Visit or None
        The call whose derivative made this one, as a time loop does that runs its steps again.
    """

    __slots__ = ("args", "fun", "inside", "nums", "options", "subject", "value")

    def __init__(self, fun, value, args, options, nums, inside):
        self.fun, self.value, self.args, self.options, self.nums = fun, value, args, options, nums
        self.inside, self.subject = inside, called(fun, args)

    @property
    def name(self):
        """How the user knows it."""
        return getattr(self.subject, "name", None) or getattr(self.subject, "__name__", type(self.subject).__name__)

    @property
    def values(self):
        """The arguments that are differentiated."""
        return [self.args[num] for num in self.nums]

    @property
    def plain(self):
        """Whether no argument belongs to an outer trace."""
        return not any(map(isbox, self.args))

    def again(self, values):
        """The same call with other values of these arguments."""
        args = list(self.args)
        for num, value in zip(self.nums, values, strict=True):
            args[num] = value
        return self.fun(*args, **self.options)


@contextmanager
def witnessed(nodes=None):
    """A `with` block in which every node of every reverse-mode trace is seen.

    Parameters
    ----------
    nodes : list, optional
        Gets the nodes themselves; then no values are kept, and nothing is yielded.

    Yields
    ------
    list of Visit
        In the order of the calls.
    """
    found: list[Visit] = []
    running: list[Visit] = []  # calls whose derivative is under way, the innermost last

    class Witness(ReverseNode):
        """A node that reports itself."""

        vjp: Any
        asks_again = nodes is None  # calls inside a loop are looked for on its way back

        def __init__(self, value, fun, args, options, nums, parents):
            super().__init__(value, fun, args, options, nums, parents)
            if nodes is not None:
                nodes.append(self)
                return
            visit = Visit(fun, value, args, options, nums, running[-1] if running else None)
            found.append(visit)
            pull = self.vjp

            def watched(g):
                running.append(visit)
                try:
                    return pull(g)
                finally:
                    running.pop()

            self.vjp = watched

    untraced[Witness] = untraced[ReverseNode]  # comparisons, shapes, rounding: plain values for this kind too
    thread.witnesses.append(Witness)
    try:
        yield found
    finally:
        thread.witnesses.remove(Witness)
        del untraced[Witness]


def bytes_held(nodes):
    """Bytes of all arrays that nodes of a tape keep alive, each buffer once."""
    buffers: dict[int, int] = {}
    seen: set[int] = set()
    for node in nodes:
        _collect(node.vjp, buffers, seen, 0)
    return sum(buffers.values())


def _collect(thing, buffers, seen, depth):
    """Arrays below functions (what they close over, their defaults), containers and boxes."""
    if isinstance(thing, np.ndarray):
        while isinstance(thing.base, np.ndarray):
            thing = thing.base
        buffers[id(thing)] = thing.nbytes
        return
    if depth > DEEPEST or id(thing) in seen:
        return
    seen.add(id(thing))
    for part in _parts(thing):
        _collect(part, buffers, seen, depth + 1)


def _parts(thing):
    if isinstance(thing, (tuple, list, set)):
        return thing
    if isinstance(thing, dict):
        return thing.values()
    if isbox(thing):
        return (thing._value,)
    if hasattr(thing, "func") and hasattr(thing, "keywords"):  # functools.partial
        return (thing.func, thing.args, thing.keywords)
    held = [cell.cell_contents for cell in getattr(thing, "__closure__", None) or () if cell != EMPTY]
    return (*held, *(getattr(thing, "__defaults__", None) or ()))
