"""Traces: programs run on traced values, and the way back from their results to where they began."""

import gc
import threading
from contextlib import contextmanager
from itertools import count
from typing import Any

import autograd.numpy as anp
import numpy as np
from autograd.core import JVPNode, VJPNode, add_outgrads, primitive_vjps
from autograd.tracer import box_types, isbox, new_box, notrace_primitives, toposort, trace_stack

from sparsedp.constants import constant, constant_args, sparing
from sparsedp.ledger import thread
from sparsedp.shortcuts import ARRAY, COPY, ITEM, NUMBERS, Part, added, along, arithmetic, install

__all__ = [
    "ReverseNode",
    "accumulate",
    "backward",
    "boxed",
    "forward_root",
    "growing",
    "new_trace",
    "reverse_root",
    "split_box",
    "traces_of",
    "untraced",
]


class ReverseNode(VJPNode):
    """A call on a reverse-mode trace. Its pullback sees the constants of the call as they are now.

    `recorder`: takes down every call that depends on a root, see `trajectory.recorder`; or None.
    """

    __slots__ = ("recorder",)
    parents: Any
    vjp: Any

    def initialize_root(self, recorder=None):
        """Begin a trace."""
        self.parents, self.vjp, self.recorder = (), None, recorder

    def __init__(self, value, fun, args, options, nums, parents):
        self.parents = parents
        recorder = self.recorder = parents[0].recorder
        if len(nums) < len(args) and fun not in sparing:
            args = constant_args(args, nums)
        if options:
            options = constant(options)
        self.vjp = None if options else arithmetic(fun, value, args, nums)
        if self.vjp is None:
            super().__init__(value, fun, args, options, nums, parents)
        if recorder is not None:
            recorder.nodes.append(self)
            if recorder.weighs:
                recorder.weigh(value, args, nums)


class ForwardNode(JVPNode):
    """A call on a forward-mode trace."""

    __slots__ = ()
    g: Any

    def __init__(self, value, fun, args, options, nums, parents):
        self.g = None if options else along(fun, value, args, nums, [parent.g for parent in parents])
        if self.g is None:
            super().__init__(value, fun, args, options, nums, parents)


sparing.update((anp.add, anp.subtract, anp.concatenate_args, ARRAY, COPY))  # shapes are all they need
install(box_types, new_box)
untraced = notrace_primitives  # by kind of node, functions that leave the tape
untraced[ReverseNode], untraced[ForwardNode] = untraced[VJPNode], untraced[JVPNode]
forward_root = ForwardNode.new_root  # a fresh start of a forward-mode trace, with its tangent


def reverse_root(recorder=None):
    """A fresh start of a reverse-mode trace; its calls are told to the recorder, see `ReverseNode`."""
    return (thread.witnesses[-1] if thread.witnesses else ReverseNode).new_root(recorder)


_numbers = count(trace_stack.top + 1)


@contextmanager
def _new_trace():
    """For autograd's own traces: a number larger than those of the traces it is nested in, and never given twice.

    autograd counts up and down, for all threads together: of two nested traces the inner one could get the smaller
    number, and its derivative be that of the other.
    """
    yield next(_numbers)


trace_stack.new_trace = _new_trace


SELDOM = 100_000  # new containers before Python looks for cyclic garbage, while a tape grows
_lock = threading.Lock()
_growing: list[tuple] = []  # thresholds to go back to, one for each tape that grows


@contextmanager
def growing():
    """While a tape grows: it has no cycles, and every search for cyclic garbage would walk all of it."""
    with _lock:
        before = gc.get_threshold()
        _growing.append(before if not _growing else _growing[0])
        if 0 < before[0] < SELDOM:
            gc.set_threshold(SELDOM, *before[1:])
    try:
        yield
    finally:
        with _lock:
            before = _growing.pop()
            if not _growing:
                gc.set_threshold(*before)


def new_trace():
    """The number of a trace that begins: larger than those of the traces it is nested in."""
    return next(_numbers)


def traces_of(values):
    """The numbers of all traces that lead to some values."""
    numbers = set()
    for value in values:
        while isbox(value):
            numbers.add(value._trace)
            value = value._value
    return numbers


def boxed(values, roots, number):
    """Values -> the same, those with a root on the trace of this number."""
    return [x if root is None else new_box(x, number, root) for x, root in zip(values, roots, strict=True)]


def split_box(value, number):
    """The value below the box of this trace, and its node (None when it does not depend on x)."""
    return (value._value, value._node) if isbox(value) and value._trace == number else (value, None)


class _Ends:
    """Stands for the last node of a graph with several results: hands each its cotangent."""

    def __init__(self, pairs):
        self.parents, self._cotangents = [node for node, _ in pairs], [g for _, g in pairs]

    def vjp(self, g):
        """The cotangents, in the order of the results."""
        return self._cotangents


def backward(nodes, cotangents):
    """Accumulate cotangents from nodes to the roots, where neither is None; return {root: cotangent}."""
    pairs = zip(nodes, cotangents, strict=True)
    end = _Ends([(node, g) for node, g in pairs if node is not None and g is not None])
    found = {end: (None, False)}
    accumulate(found, toposort(end))
    return {root: g for root, (g, _) in found.items()}


def accumulate(cotangents, nodes):
    """Hand cotangents on through nodes, each after those that use it.

    `cotangents`: {node: (sum so far, whether it may be written to)}, in the end those of roots, and of nodes elsewhere.
    """
    for node in nodes:
        if node not in cotangents or not node.parents:
            continue
        for parent, back in zip(node.parents, node.vjp(cotangents.pop(node)[0]), strict=True):
            known = cotangents.get(parent)
            if known is None and type(back) in NUMBERS:
                cotangents[parent] = back, False
            else:
                cotangents[parent] = added(known, back) or add_outgrads(known, _sparse(back))


def _sparse(back):
    """A part of a cotangent that is traced itself: autograd's form of it."""
    if type(back) is not Part:
        return back
    example = np.broadcast_to(0.0, back.shape)
    (whole,) = primitive_vjps[ITEM]((0,), None, (example, back.index), {})(back.g)
    return whole
