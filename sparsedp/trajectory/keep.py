"""What a rollout hands out: the last state, all states, or what a function makes of each.

Each kind takes the states of a run as they come (`start`, `see`, `finish`), builds the user's tree from the arrays of
the last run (`tree`), and going backward says which cotangent enters at which state (`source`).
"""

from typing import Any

import numpy as np

from sparsedp.constants import constant
from sparsedp.direction import pull_ends
from sparsedp.errors import DerivativeError
from sparsedp.fields import frozen
from sparsedp.tape import dtype_of, is_variable, isbox, plain
from sparsedp.traces import reverse_root, split_box, trace
from sparsedp.trajectory.layout import fingerprint, owned, refuse_mask
from sparsedp.tree import flatten, leaves

__all__ = ["All", "Each", "Last", "marked"]


class Last:
    """The last state.

    Parameters
    ----------
    layout : Layout
    shown : slice
        Which of the variables are handed out.
    """

    along = False  # cotangents enter at the end only
    whole = False  # every state is handed out, and thereby kept

    def __init__(self, layout, shown=slice(None)):
        self.layout, self.shown = layout, shown
        self._last: Any = None

    def start(self, run):
        """A run begins."""

    def see(self, state):
        """A state of the run -> the same, perhaps in other memory."""
        self._last = state
        return state

    def finish(self, stored):
        """The arrays to hand out."""
        last, self._last = self._last, self._last.statics
        return tuple(owned(value) for value in last.values[self.shown])

    def tree(self, outputs):
        """Outputs of the rule -> what the user gets."""
        pairs = zip(outputs, self.layout.floats, strict=True)
        return self.layout.build([float(v) if bare and not isbox(v) else v for v, bare in pairs], self._last)

    def source(self, n, g):
        """Cotangents of the outputs -> function (index, variables, statics) -> cotangents of a state, or None."""
        entering = [None] * len(self.layout.places)
        entering[self.shown] = g
        return lambda i, values, statics: entering if i == n else None


class All:
    """All n + 1 states, stacked along a new first axis."""

    along = True

    def __init__(self, layout, shown=slice(None)):
        self.layout, self.shown = layout, shown
        self.whole = layout.places[shown] == layout.places
        self._blocks: list = []
        self._statics: list = []

    def start(self, run):
        """A run begins."""
        pairs = list(zip(self.layout.shapes, self.layout.dtypes, strict=True))[self.shown]
        self._blocks = [np.empty((run.n + 1, *shape), dtype) for shape, dtype in pairs]
        self._statics = []

    def see(self, state):
        """A state of the run -> the same; where all of it is handed out, in that memory."""
        self._statics.append(state.statics)
        for block, value in zip(self._blocks, state.values[self.shown], strict=True):
            block[state.i] = value
        if not self.whole:
            return state
        rows = zip((block[state.i] for block in self._blocks), state.values, strict=True)
        return state._replace(values=[row if type(row) is np.ndarray else value for row, value in rows])

    def finish(self, stored):
        """The arrays to hand out."""
        blocks, self._blocks = self._blocks, []
        for block in blocks:
            block.flags.writeable = not stored  # the way back uses these very arrays
        return tuple(blocks)

    def tree(self, outputs):
        """Outputs of the rule -> what the user gets."""
        return self.layout.build(outputs, [_stacked(line) for line in zip(*self._statics, strict=True)])

    def source(self, n, g):
        """Cotangents of the outputs -> function (index, variables, statics) -> cotangents of a state."""
        count, shown = len(self.layout.places), self.shown

        def at(i, values, statics):
            entering = [None] * count
            entering[shown] = [block[i] for block in g]
            return entering

        return at


def _stacked(line):
    """A leaf that is no variable, along the trajectory: numbers are stacked, the rest is taken once."""
    return np.stack(line) if isinstance(line[0], (bool, int, np.ndarray, np.generic)) else line[0]


class Each:
    """What function(index, state) makes of each state; floating results of one shape are kept in one stack."""

    along, whole = True, False

    def __init__(self, layout, function):
        self.layout, self.function = layout, function
        self._stacks: dict = {}
        self._trees: list = []
        self._groups: dict = {}
        self._marks: list = []  # of what the function returned, where it will be called again
        self._compared = False

    def start(self, run):
        """A run begins."""
        self._stacks, self._trees, self._compared = {}, [], run.store

    def see(self, state):
        """A state of the run -> the same."""
        given = self.layout.build([frozen(value) for value in state.values], state.statics)
        found, rebuild = flatten(self.function(state.i, given))
        for leaf in found:
            refuse_mask("keep returned a masked array", leaf)
        places = [self._store(leaf) if is_variable(leaf) else None for leaf in found]
        if self._compared:
            self.compare(state.i, [marked(leaf) for leaf, place in zip(found, places, strict=True) if place])
        others = constant([None if place else leaf for leaf, place in zip(found, places, strict=True)])
        self._trees.append((flatten(rebuild(others))[1], others, places))
        return state

    def _store(self, leaf):
        """Where a floating result is kept: (number of the stack, place in it)."""
        if isbox(leaf):
            raise DerivativeError(
                "keep uses a traced value that is not part of the state, and its derivative would be lost; "
                "return what it needs of the state, and combine the two outside of rollout"
            )
        key = _sort(leaf)
        stack = self._stacks.setdefault(key, [])
        stack.append(owned(leaf))
        return list(self._stacks).index(key), len(stack) - 1

    def compare(self, i, marks):
        """Refuse a function that returns something else for a state than it did before."""
        if i == len(self._marks):
            self._marks.append(marks)
        elif self._marks[i] != marks:
            raise DerivativeError(
                "keep returns something else when it is called again; it must depend on its arguments only"
            )

    def finish(self, stored):
        """The arrays to hand out: one for each shape and dtype."""
        stacks, self._stacks = self._stacks, {}
        self._groups = {key: number for number, key in enumerate(stacks)}
        return tuple(np.stack(stack) for stack in stacks.values())

    def tree(self, outputs):
        """Outputs of the rule -> the tuple of what the function returned."""
        return tuple(
            rebuild([outputs[place[0]][place[1]] if place else leaf for leaf, place in zip(found, places, strict=True)])
            for rebuild, found, places in self._trees
        )

    def source(self, n, g):
        """Cotangents of the stacks -> function (index, variables, statics) -> cotangents of a state."""
        counters = [len(stack) for stack in g]

        def at(i, values, statics):
            return self._pull(i, values, statics, g, counters)

        return at

    def _pull(self, i, values, statics, g, counters):
        roots = [reverse_root() for _ in values]
        state = self.layout.build(values, statics)
        result, number = trace(lambda tree: self.function(i, tree), state, self.layout.spread(roots))
        nodes, slopes = [], []
        ends = [split_box(leaf, number) for leaf in leaves(result) if is_variable(leaf)]
        self.compare(i, [marked(value) for value, _ in ends])
        for value, node in reversed(ends):
            group = self._groups[_sort(value)]
            counters[group] -= 1
            if node is not None:
                nodes.append(node)
                slopes.append(g[group][counters[group]])
        return pull_ends(nodes, slopes, roots)


def _sort(value):
    return np.shape(value), dtype_of(value).char


def marked(value):
    """Array or number, plain or traced -> its shape and dtype, and its bits."""
    value = np.asarray(plain(value))
    return value.shape, value.dtype.char, fingerprint([value])
