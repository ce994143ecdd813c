"""Observe the nodes of a reverse-mode tape while they are recorded: the functions, their arguments and nesting."""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import CellType, FunctionType, MethodType
from typing import Any

import numpy as np

from sparsedp.autodiff.backend import array_types
from sparsedp.autodiff.derivative import name_of, observed_nodes
from sparsedp.autodiff.tape import called, isbox, through

__all__ = ["Node", "bytes_held", "calls_seen", "in_order"]

CONTAINERS = (tuple, list, set, dict, MethodType, CellType, partial)
DEEPEST = 36  # largest nesting of containers that is searched; a function with its closure has three levels


class Node:
    """One call that is recorded on the tape.

    Attributes
    ----------
    subject : Rule, Operator, or a function of autograd
    name : str
        Name of the call for messages.
    value
        The result.
    values : list
        The differentiated arguments.
    places : list of int
        Their positions among the arguments that the user passes.
    plain : bool
        True if no argument is a traced value of an outer derivative.
    inner : list of Node
        The calls that were recorded while its VJP was running, for example the time steps that a loop recomputes. If a
        loop stores the tape of its steps, these calls come before the loop in the list of all calls.
    again : callable
        ``again(values)`` repeats the call with other values of the differentiated arguments.
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
    """Return an argument for a repeated call. Objects that store results have `as_new`, an unused copy."""
    if hasattr(argument, "as_new"):
        return argument.as_new()
    return argument


@contextmanager
def calls_seen() -> Iterator[list[Node]]:
    """Yield a list to which the calls recorded in the `with` block are appended, each with its inner calls."""
    calls: list[Node] = []
    running: list[Node] = []  # calls whose VJP is running, from outer to inner

    def add_node(tape_node: Any, *call: Any) -> None:
        node = Node(*call)
        pull = tape_node.vjp
        if running:
            outer = running[-1].inner
        else:
            outer = calls
        outer.append(node)

        def pull_and_nest(*cotangents: Any) -> Any:
            running.append(node)
            try:
                return pull(*cotangents)
            finally:
                running.pop()

        tape_node.vjp = pull_and_nest

    with observed_nodes(add_node):
        yield calls


def in_order(nodes: Iterable[Node]) -> Iterator[Node]:
    """Yield all calls. The inner calls of a call come before it."""
    for node in nodes:
        yield from in_order(node.inner)
        yield node


def bytes_held(nodes: Iterable[Any]) -> int:
    """Return the number of bytes of all arrays that are referenced by nodes of a tape. Each buffer counts once.

    The search follows the closures and defaults of functions, and containers.
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
    """Return the array that owns the memory of a view. For other objects (distributed fields), return the object."""
    base = getattr(array, "base", None)
    while isinstance(base, np.ndarray):
        array = base
        base = array.base
    return array


def _parts(thing: Any) -> Any:
    """Return the objects to which a box, a function or a container refers."""
    if isbox(thing):
        return (thing._value,)
    if isinstance(thing, FunctionType):  # without the globals of its module
        return (thing.__closure__, thing.__defaults__)
    if isinstance(thing, CONTAINERS):
        return gc.get_referents(thing)
    return ()
