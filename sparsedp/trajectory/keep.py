"""What a rollout hands out: the last state, all states, or what a function makes of each.

Each kind takes the states of a run as they come (`start`, `see`, `finish`), builds the user's tree from the arrays of
the last run (`tree`), and going backward says which cotangent enters at which state (`source`).
"""

from typing import Any

import numpy as np

from sparsedp.constants import constant
from sparsedp.derivative import linearised
from sparsedp.errors import DerivativeError
from sparsedp.fields import frozen
from sparsedp.tape import dtype_of, is_variable, isbox, plain, traces_of
from sparsedp.trajectory.layout import fingerprint, owned, refuse_mask, stacked
from sparsedp.tree import flatten, leaves

__all__ = ["All", "Each", "Last"]


class Last:
    """The last state.

    Parameters
    ----------
    layout : Layout
    """

    along = False  # cotangents enter at the end only
    whole = False  # every state is handed out, and thereby kept

    def __init__(self, layout):
        self.layout = layout
        self._last: Any = None

    def start(self, n, outer, stored):
        """A run of n steps begins, on values of the traces `outer`; `stored` for a way back."""

    def see(self, state):
        """A state of the run -> the same, perhaps in other memory."""
        self._last = state
        return state

    def finish(self):
        """The arrays to hand out."""
        last, self._last = self._last, self._last.statics
        return tuple(map(owned, last.values))

    def tree(self, outputs):
        """Outputs of the rule -> what the user gets."""
        pairs = zip(outputs, self.layout.floats, strict=True)
        return self.layout.build([float(v) if bare and not isbox(v) else v for v, bare in pairs], self._last)

    def source(self, n, g):
        """Cotangents of the outputs -> function from a state to cotangents of a state, or None."""
        return lambda state: g if state.i == n else None


class All:
    """All n + 1 states, stacked along a new first axis."""

    along = whole = True

    def __init__(self, layout):
        self.layout = layout
        self._blocks: list = []
        self._statics: list = []
        self._stored = False

    def start(self, n, outer, stored):
        """A run begins: one block for each variable, or a list where its states are traced."""
        pairs = zip(self.layout.shapes, self.layout.dtypes, strict=True)
        self._blocks = [[None] * (n + 1) if outer else np.empty((n + 1, *shape), dtype) for shape, dtype in pairs]
        self._statics, self._stored = [], stored

    def see(self, state):
        """A state of the run -> the same in the memory that is handed out."""
        self._statics.append(state.statics)
        values = list(state.values)
        for number, block in enumerate(self._blocks):
            block[state.i] = values[number]
            if np.ndim(values[number]):
                values[number] = block[state.i]
        return state._replace(values=values)

    def finish(self):
        """The arrays to hand out."""
        blocks, self._blocks = self._blocks, []
        return tuple(self._whole(block) for block in blocks)

    def _whole(self, block):
        if isinstance(block, list):
            return stacked(block)
        block.flags.writeable = not self._stored  # the way back uses these very arrays
        return block

    def tree(self, outputs):
        """Outputs of the rule -> what the user gets."""
        return self.layout.build(outputs, [_stacked(line) for line in zip(*self._statics, strict=True)])

    def source(self, n, g):
        """Cotangents of the outputs -> function from a state to cotangents of a state."""
        return lambda state: [block[state.i] for block in g]


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
        self.marks: list = []  # of what the function returned, where it will be called again
        self._outer, self._compared = set(), False

    def start(self, n, outer, stored):
        """A run begins."""
        self._stacks, self._trees, self._outer, self._compared = {}, [], outer, stored

    def see(self, state):
        """A state of the run -> the same."""
        given = self.layout.build([frozen(value) for value in state.values], state.statics)
        found, rebuild = flatten(self.function(state.i, given))
        for leaf in found:
            refuse_mask("keep returned a masked array", plain(leaf))
        places = [self._store(leaf) if is_variable(leaf) else None for leaf in found]
        if self._compared:
            self._compare(state.i, found)
        others = constant([None if place else leaf for leaf, place in zip(found, places, strict=True)])
        self._trees.append((flatten(rebuild(others))[1], others, places))
        return state

    def _store(self, leaf):
        """Where a floating result is kept: (number of the stack, place in it)."""
        if not traces_of([leaf]) <= self._outer:
            raise DerivativeError(
                "keep uses a traced value that is not part of the state, and its derivative would be lost; "
                "return what it needs of the state, and combine the two outside of rollout"
            )
        key = np.shape(leaf), dtype_of(leaf).char
        stack = self._stacks.setdefault(key, [])
        stack.append(owned(leaf))
        return list(self._stacks).index(key), len(stack) - 1

    def _compare(self, i, found):
        """Refuse a function that returns something else for a state than it did before."""
        marks = [_marked(leaf) for leaf in found if is_variable(leaf)]
        if i == len(self.marks):
            self.marks.append(marks)
        elif self.marks[i] != marks:
            raise DerivativeError(
                "keep returns something else when it is called again; it must depend on its arguments only"
            )

    def finish(self):
        """The arrays to hand out: one for each shape and dtype."""
        stacks, self._stacks = self._stacks, {}
        return tuple(map(stacked, stacks.values()))

    def tree(self, outputs):
        """Outputs of the rule -> the tuple of what the function returned."""
        return tuple(
            rebuild([outputs[place[0]][place[1]] if place else leaf for leaf, place in zip(found, places, strict=True)])
            for rebuild, found, places in self._trees
        )

    def source(self, n, g):
        """Cotangents of the stacks -> function from a state to cotangents of a state."""

        def at(state):
            given = self.layout.build(state.values, state.statics)
            ends, _, pull = linearised(
                lambda tree: self.function(state.i, tree), given, map(is_variable, leaves(given))
            )
            self._compare(state.i, ends)
            places = self._trees[state.i][2]
            found = pull([g[place[0]][place[1]] if place else None for place in places])
            return [found[place] for place in self.layout.places]

        return at


def _marked(value):
    """Array or number, plain or traced -> its shape and dtype, and its bits."""
    value = np.asarray(plain(value))
    return value.shape, value.dtype.char, fingerprint([value])
