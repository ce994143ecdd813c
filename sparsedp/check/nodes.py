"""Every node of a reverse-mode tape, seen while it is recorded: what was called, with which values, inside what."""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import CellType, FunctionType, MethodType
from typing import Any

import numpy as np

from sparsedp.autodiff.backend import array_types
from sparsedp.autodiff.derivative import name_of, witnessed
from sparsedp.autodiff.tape import called, isbox, through

__all__ = ["Node", "bytes_held", "calls_seen", "in_order"]

HOLDERS = (tuple, list, set, dict, MethodType, CellType, partial)
DEEPEST = 36  # holders inside each other; deeper ones do not belong to the tape. A function with its closure is three


class Node:
    """One call that the tape holds.

    Attributes
    ----------
    subject : Rule, Operator, or a function of autograd
    name : str
        The name that the user knows.
    value
        Its result.
    values : list
        The arguments that are differentiated.
    places : list of int
        Their positions among the arguments that the user passes.
    plain : bool
        Whether no argument belongs to an outer trace.
    inner : list of Node
        The calls that its derivative recorded, as a time loop does that runs its steps again; the steps of a loop that
        keeps its tape stand before the loop.
    again : callable
        ``again(values)`` is the same call with other values of these arguments.
    """

    def __init__(
        self, function: Any, value: Any, args: Sequence[Any], options: dict[str, Any], numbers: Sequence[int]
    ) -> None:
        self.subject = called(function, args)
        self.name: str = name_of(self.subject)
        self.value = value
        self.values = [args[number] for number in numbers]
        self.plain = not any(map(isbox, args))
        self.inner: list[Node] = []
        is_rule = self.subject is not function  # a rule is the first argument of its call
        self.places = [number - is_rule for number in numbers]

        def again(values: Sequence[Any]) -> Any:
            new = dict(zip(numbers, values, strict=True))
            everything = [new.get(number, _as_new(arg)) for number, arg in enumerate(args)]
            if function is through:  # the rule of a time loop knows which of its arguments have a derivative
                loop, *arguments = everything
                return loop.again(*arguments)
            return function(*everything, **options)

        self.again = again


def _as_new(argument: Any) -> Any:
    """Return an argument for another run of a call; one that keeps the results of its run has `as_new`."""
    if hasattr(argument, "as_new"):
        return argument.as_new()
    return argument


@contextmanager
def calls_seen() -> Iterator[list[Node]]:
    """Yield the list of the calls that the `with` block records, each with those inside of it."""
    calls: list[Node] = []
    running: list[Node] = []  # calls whose derivative is running, the innermost last

    def see(tape_node: Any, *call: Any) -> None:
        node = Node(*call)
        pull = tape_node.vjp
        if running:
            outer = running[-1].inner
        else:
            outer = calls
        outer.append(node)

        def watched(*cotangents: Any) -> Any:
            running.append(node)
            try:
                return pull(*cotangents)
            finally:
                running.pop()

        tape_node.vjp = watched

    with witnessed(see):
        yield calls


def in_order(nodes: Iterable[Node]) -> Iterator[Node]:
    """Yield all calls, those inside of a call before it."""
    for node in nodes:
        yield from in_order(node.inner)
        yield node


def bytes_held(nodes: Iterable[Any]) -> int:
    """Return the bytes of all arrays that nodes of a tape keep alive, each buffer once.

    The arrays are below functions (their closures and defaults) and containers.
    """
    buffers: dict[int, int] = {}
    seen: set[int] = set()
    waiting: list[tuple[Any, int]] = []
    for node in nodes:
        waiting += [(node.vjp, 0), (node.held, 0)]
    while waiting:
        thing, depth = waiting.pop()
        if isinstance(thing, array_types()):
            owner = _owner(thing)
            buffers[id(owner)] = owner.nbytes
        elif depth <= DEEPEST and id(thing) not in seen:
            seen.add(id(thing))
            waiting += [(part, depth + 1) for part in _parts(thing)]
    return sum(buffers.values())


def _owner(array: Any) -> Any:
    """Return the array that owns the memory of a view; a distributed field has no views."""
    base = getattr(array, "base", None)
    while isinstance(base, np.ndarray):
        array = base
        base = array.base
    return array


def _parts(thing: Any) -> Any:
    """Return what a box, a function or a container refers to."""
    if isbox(thing):
        return (thing._value,)
    if isinstance(thing, FunctionType):  # not the names of its module
        return (thing.__closure__, thing.__defaults__)
    if isinstance(thing, HOLDERS):
        return gc.get_referents(thing)
    return ()
