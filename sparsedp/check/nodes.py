"""Every node of a reverse-mode tape, seen while it is made: what was called, with which values, inside what."""

import gc
from contextlib import contextmanager
from functools import partial
from types import CellType, FunctionType, MethodType

import numpy as np

from sparsedp.autodiff.backend import array_types
from sparsedp.autodiff.derivative import name_of, witnessed
from sparsedp.autodiff.tape import called, isbox, through

__all__ = ["Node", "bytes_held", "calls_seen", "in_order"]

HOLDERS = tuple, list, set, dict, MethodType, CellType, partial
DEEPEST = 36  # holders inside each other; deeper ones are not the tape's. A function, its closure and a cell are three


class Node:
    """One call that the tape holds.

    Attributes
    ----------
    subject : Rule, Operator, or a function of autograd
    name : str
        How the user knows it.
    value
        Its result.
    values : list
        The arguments that are differentiated.
    places : list of int
        Their positions among the arguments that the user passes.
    plain : bool
        Whether no argument belongs to an outer trace.
    inner : list of Node
        The calls that its derivative made, as that of a time loop does that runs its steps again; the steps of a
        loop that keeps its tape stand before the loop.
    again : callable
        ``again(values)`` is the same call with other values of these arguments.
    """

    def __init__(self, fun, value, args, options, nums):
        self.subject, self.value = called(fun, args), value
        self.name, self.inner = name_of(self.subject), []  # type: str, list[Node]
        self.values, self.plain = [args[num] for num in nums], not any(map(isbox, args))
        self.places = [num - (self.subject is not fun) for num in nums]  # a rule is the first argument of its call

        def again(values):
            given = dict(zip(nums, values, strict=True))
            everything = [given.get(num, _as_new(arg)) for num, arg in enumerate(args)]
            if fun is through:  # the rule of a time loop knows which of its arguments have a derivative
                loop, *everything = everything
                return loop.again(*everything)
            return fun(*everything, **options)

        self.again = again


def _as_new(argument):
    """Return an argument for another run of a call; one that keeps the results of its run has `as_new`."""
    return argument.as_new() if hasattr(argument, "as_new") else argument


@contextmanager
def calls_seen():
    """A `with` block that yields the list of the calls made in it, each with those inside of it."""
    calls: list[Node] = []
    running: list[Node] = []  # calls whose derivative is under way, the innermost last

    def see(tape_node, *call):
        node, pull = Node(*call), tape_node.vjp
        (running[-1].inner if running else calls).append(node)

        def watched(*g):
            running.append(node)
            try:
                return pull(*g)
            finally:
                running.pop()

        tape_node.vjp = watched

    with witnessed(see):
        yield calls


def in_order(nodes):
    """All calls, those inside of a call before it."""
    for node in nodes:
        yield from in_order(node.inner)
        yield node


def bytes_held(nodes):
    """Bytes of all arrays that nodes of a tape keep alive, each buffer once.

    They are below functions (what they close over, their defaults) and containers.
    """
    buffers: dict[int, int] = {}
    seen: set[int] = set()
    waiting: list = [(part, 0) for node in nodes for part in (node.vjp, node.held)]
    while waiting:
        thing, depth = waiting.pop()
        if isinstance(thing, array_types()):
            while isinstance(base := getattr(thing, "base", None), np.ndarray):  # a field on ranks has none
                thing = base
            buffers[id(thing)] = thing.nbytes
        elif depth <= DEEPEST and id(thing) not in seen:
            seen.add(id(thing))
            waiting += [(part, depth + 1) for part in _parts(thing)]
    return sum(buffers.values())


def _parts(thing):
    """What a box, a function or a container refers to."""
    if isbox(thing):
        return (thing._value,)
    if isinstance(thing, FunctionType):  # not the names of its module
        return (thing.__closure__, thing.__defaults__)
    return gc.get_referents(thing) if isinstance(thing, HOLDERS) else ()
