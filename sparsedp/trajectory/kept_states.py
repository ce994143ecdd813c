"""What a rollout hands out: the last state, some or all states, or what a function makes of each.

Each kind takes the states of a run as they come (`start`, `see`, `finish`), builds the user's tree from the arrays of
the last run (`tree`), and going backward says which cotangent enters at which state (`source`).
"""

from itertools import pairwise
from typing import Any

import numpy as np

from sparsedp._utils.pytree import flatten, leaves, mapped, paired
from sparsedp._utils.validation import is_whole
from sparsedp.autodiff.backend import as_field, is_distributed
from sparsedp.autodiff.derivative import linearised
from sparsedp.autodiff.tape import dtype_of, is_variable, isbox, plain, split_boxes, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import DerivativeError
from sparsedp.trajectory.layout import fingerprint, owned, refuse_mask, stacked

__all__ = ["All", "Each", "Last", "Some", "kind"]


def kind(keep, layout, n):
    """What `keep` of a rollout of n steps says -> one of these kinds; anything else is refused."""
    if callable(keep):
        return Each(layout, keep)
    if isinstance(keep, (list, tuple, range, np.ndarray)):
        numbers = list(keep)
        if not numbers or not all(is_whole(number, 0) for number in numbers):
            raise ValueError(f"keep needs at least one state, numbers from 0 on, got {keep!r}")
        if numbers[-1] > n or any(later <= number for number, later in pairwise(numbers)):
            raise ValueError(f"keep needs rising numbers of states from 0 to n = {n}, got {keep!r}")
        return Some(layout, numbers)
    if not isinstance(keep, str) or keep not in ("last", "all"):
        raise ValueError(f'keep must be "last", "all", a list of states or a function of (index, state), got {keep!r}')
    return All(layout, range(n + 1)) if keep == "all" else Last(layout)


AGAIN = "keep returns something else when it is called again; it must depend on its arguments only"


class Last:
    """The last state.

    Parameters
    ----------
    layout : Layout
    """

    along = False  # cotangents enter at the end only
    exact = True  # states on the way back are those of the way forward, to the last bit
    whole = False  # every state is handed out, and thereby kept

    def __init__(self, layout):
        self.layout = layout
        self._statics: Any = None

    def start(self, steps):
        """A run begins."""

    def see(self, state):
        """A state of the run -> the same, perhaps in other memory."""
        return state

    def finish(self, last):
        """The last state -> the arrays to hand out."""
        self._statics = last.statics
        return tuple(map(owned, last.values))

    def tree(self, outputs):
        """Outputs of the rule -> what the user gets."""
        pairs = zip(outputs, self.layout.floats, strict=True)
        return self.layout.build([float(v) if bare and not isbox(v) else v for v, bare in pairs], self._statics)

    def source(self, n, g):
        """Cotangents of the outputs -> function from a state to cotangents of a state, or None."""
        if len(g) > 1:  # nothing goes back from a field that nobody uses
            g = [None if type(back) is np.ndarray and not back.any() else back for back in g]
        return lambda state: g if state.i == n else None


class Some(Last):
    """The states of these numbers, stacked along a new first axis; on ranks a tuple of them.

    Parameters
    ----------
    layout : Layout
    numbers : sequence of int
        Rising.
    """

    along = True

    def __init__(self, layout, numbers):
        super().__init__(layout)
        self._rows = {number: row for row, number in enumerate(numbers)}
        self._places: list = []  # of the variables: of their states among the outputs, or of their stack

    def start(self, steps):
        """One block for each variable, or a list where its states are traced, or lie elsewhere."""
        n, lines = len(self._rows), zip(self.layout.shapes, self.layout.dtypes, steps.first.values, strict=True)
        self._blocks: list = [
            [None] * n if steps.outer or is_distributed(value) else np.empty((n, *shape), kind)
            for shape, kind, value in lines
        ]
        self._statics, self._stored = [], bool(steps.loop.wanted)

    def see(self, state):
        """A state of the run -> the same; where all are handed out, in that memory."""
        row = self._rows.get(state.i)
        if row is None:
            return state
        self._statics.append(state.statics)
        values = list(state.values)
        for number, block in enumerate(self._blocks):
            if is_distributed(values[number]) and not isinstance(block, list):  # the first state was known to all
                block = self._blocks[number] = [*block]
            block[row] = owned(values[number]) if isinstance(block, list) else values[number]
            if np.ndim(values[number]) and self.whole:
                values[number] = block[row]
        return state.moved(values)

    def finish(self, last):
        """The blocks; where all are handed out, the way back uses these very arrays."""
        blocks, self._blocks, self._places = self._blocks, [], []
        found: list = []
        for block in blocks:
            apart = isinstance(block, list) and is_distributed(block[-1])
            found += block if apart else [stacked(block) if isinstance(block, list) else block]
            self._places.append(slice(len(found) - len(block), len(found)) if apart else len(found) - 1)
        for block in found:
            if type(block) is np.ndarray:
                block.flags.writeable = not (self.whole and self._stored)
        return tuple(found)

    def _grouped(self, outputs):
        """Outputs -> for each variable its stack, or the tuple of its states."""
        return [outputs[place] if isinstance(place, int) else tuple(outputs[place]) for place in self._places]

    def tree(self, outputs):
        """Outputs of the rule -> what the user gets."""
        return self.layout.build(self._grouped(outputs), [_stacked(line) for line in zip(*self._statics, strict=True)])

    def source(self, n, g):
        """Cotangents of the outputs -> function from a state to cotangents of a state, or None."""
        rows = self._grouped(g)
        return lambda state: [block[self._rows[state.i]] for block in rows] if state.i in self._rows else None


class All(Some):
    """All n + 1 states."""

    whole = True


def _stacked(line):
    """A leaf that is no variable, along the trajectory: numbers are stacked, the rest is taken once."""
    return np.stack(line) if isinstance(line[0], (bool, int, np.ndarray, np.generic)) else line[0]


class Row:
    """Stands for a floating result: the number of its stack, and its row there; None where it is alone."""

    def __init__(self, stack, row):
        self.stack, self.row = stack, row

    def of(self, stacks):
        """The result itself, or its cotangent."""
        return stacks[self.stack] if self.row is None else stacks[self.stack][self.row]


class Each(Last):
    """What function(index, state) makes of each state; floating results of one shape are kept in one stack."""

    along = True

    def __init__(self, layout, function):
        super().__init__(layout)
        self.function = function
        self._marks: list = []  # of what the function returned, where it will be called again
        self._trees: list = []  # what the function returned, rows in place of floating results
        self._forms: list = []  # those of the first run: the order of entries is theirs

    def start(self, steps):
        """A run begins."""
        self._stacks: dict = {}
        self._forms = self._forms or self._trees
        self._trees = []
        self._steps = steps

    def see(self, state):
        """A state of the run -> the same."""
        result = self.function(state.i, self._steps.shown(state))
        if state.i < len(self._forms):
            form = self._forms[state.i]
            result = flatten(form)[1](self._paired(result, form, state.i))
        self._trees.append(mapped(self._kept, result))
        if self._steps.loop.wanted:
            self._compare(state.i, leaves(result))
        return state

    def _paired(self, result, form, i):
        """The leaves of a result in the order of one of another call."""
        words = f"; {AGAIN}"
        return paired(result, form, f"keep({i}, state)", advice=words, error=DerivativeError)

    def _kept(self, leaf):
        """A result -> where it is kept, or a constant."""
        refuse_mask("keep returned a masked array", plain(leaf))
        if not is_variable(leaf):
            return constant(leaf)
        (leaf,), _ = split_boxes([leaf], self._steps.number)
        if not traces_of([leaf]) <= self._steps.outer:
            raise DerivativeError(
                "keep uses a traced value that is not part of the state, and its derivative would be lost; "
                "return what it needs of the state, and combine the two outside of rollout"
            )
        apart = is_distributed(leaf)  # a field on ranks is kept by itself
        key = len(self._stacks) if apart else (np.shape(leaf), dtype_of(leaf).char)
        stack = self._stacks.setdefault(key, [])
        stack.append(owned(leaf))
        return Row(list(self._stacks).index(key), None if apart else len(stack) - 1)

    def _compare(self, i, results):
        """Refuse a function that returns something else for a state than it did before."""
        values = [as_field(plain(leaf)) for leaf in results if is_variable(leaf)]
        marks = [(value.shape, value.dtype, fingerprint([value])) for value in values]
        if i == len(self._marks):
            self._marks.append(marks)
        elif self.exact and self._marks[i] != marks:
            raise DerivativeError(AGAIN)

    def finish(self, last):
        """One array for each shape and dtype."""
        stacks, self._stacks = self._stacks, {}
        return tuple(stack[0] if isinstance(key, int) else stacked(stack) for key, stack in stacks.items())

    def tree(self, outputs):
        """Outputs of the rule -> the tuple of what the function returned."""
        take = lambda leaf: leaf.of(outputs) if isinstance(leaf, Row) else leaf
        return tuple(mapped(take, tree) for tree in self._trees)

    def source(self, n, g):
        """Cotangents of the stacks -> function from a state to cotangents of a state."""

        def at(state):
            given = self.layout.build(state.values, state.statics)
            form = self._trees[state.i]

            def function(tree):
                return self._paired(self.function(state.i, tree), form, state.i)

            results, _, pull = linearised(function, given, map(is_variable, leaves(given)))
            self._compare(state.i, results)
            cotangents = pull([leaf.of(g) if isinstance(leaf, Row) else None for leaf in leaves(form)])
            return [cotangents[place] for place in self.layout.places]

        return at
