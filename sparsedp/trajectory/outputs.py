"""What a rollout returns: the last state, selected states, all states, or the results of a function of each state.

Each class receives the states of a forward pass one by one (`start`, `see`, `finish`), and `tree` builds the result for
the user from the arrays of the last run. In the backward pass `sources` returns the cotangents of the result that are
added to the cotangent of a state.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import flatten, leaves, mapped, paired
from sparsedp._utils.validation import is_whole
from sparsedp.autodiff.backend import as_field
from sparsedp.autodiff.derivative import taped
from sparsedp.autodiff.tape import dtype_of, is_variable, isbox, plain, split_boxes, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import DerivativeError
from sparsedp.trajectory.specification import fingerprint, is_array, owned, refuse_mask, stacked

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.trajectory.specification import ArgumentForm
    from sparsedp.trajectory.step_runner import State, StepRunner

__all__ = ["AllStates", "FunctionOfStates", "LastState", "SelectedStates", "make_outputs"]

NOT_REPEATABLE = "keep returns something else when it is called again; it must depend on its arguments only"


def make_outputs(keep: Any, form: ArgumentForm, n: int) -> LastState:
    """Return the output object for the argument `keep` of a rollout of n steps; raise ValueError if it is invalid."""
    if isinstance(keep, str) and keep == "last":
        return LastState(form)
    if isinstance(keep, str) and keep == "all":
        return AllStates(form, range(n + 1))
    if callable(keep):
        return FunctionOfStates(form, keep)
    if not isinstance(keep, (list, tuple, range, np.ndarray)):
        raise ValueError(f'keep must be "last", "all", a list of states or a function of (index, state), got {keep!r}')
    numbers = list(keep)
    if not numbers or not all(is_whole(number, 0) for number in numbers):
        raise ValueError(f"keep needs at least one state, numbers from 0 on, got {keep!r}")
    if numbers[-1] > n or any(later <= number for number, later in pairwise(numbers)):
        raise ValueError(f"keep needs rising numbers of states from 0 to n = {n}, got {keep!r}")
    return SelectedStates(form, numbers)


class LastState:
    """The last state.

    Parameters
    ----------
    form : ArgumentForm
    """

    enters_everywhere = False  # whether the result depends directly on other states than the last one
    is_exact = True  # whether the states of the backward pass equal those of the forward pass bit for bit
    takes_trajectories = True  # whether states may be given all at once, by `take`
    holds_all_states = False  # whether the result contains every state, so that none has to be computed again

    def __init__(self, form: ArgumentForm) -> None:
        self.form = form
        self._statics: Any = None

    def start(self, runner: StepRunner) -> None:
        """Begin a run."""

    def see(self, state: State) -> State:
        """Process the next state of the run; return the same state, possibly stored in other arrays."""
        return state

    def take(self, trajectories: list, last: State) -> None:
        """Process all states of a run, which are the rows of an array for each variable."""

    def entering(self, n: int, cotangents: list) -> list | None:
        """Return for each variable the cotangents of the result at states 0 to n; None if only the last has one."""
        return None

    def finish(self, last: State) -> tuple:
        """End a run; return the arrays of the result."""
        self._statics = last.statics
        return tuple(map(owned, last.values))

    def tree(self, arrays: Sequence) -> Any:
        """Build the result for the user from arrays as `finish` returns them."""
        values = []
        for value, is_python_float in zip(arrays, self.form.is_float, strict=True):
            if is_python_float and not isbox(value):
                values.append(float(value))
            else:
                values.append(value)
        return self.form.build(values, self._statics)

    def sources(self, n: int, cotangents: list) -> Callable[[State], list | None]:
        """Return a function that maps a state to the cotangents of the result at this state, or to None.

        The index of the last state is n.
        """
        if len(cotangents) > 1:
            cotangents = [None if _is_zero(g) else g for g in cotangents]

        def source(state: State) -> list | None:
            if state.i == n:
                return cotangents
            return None

        return source


def _is_zero(back: Any) -> bool:
    """Return True for an array of zeros, so that nothing is propagated from a field that the result does not use."""
    return type(back) is np.ndarray and not back.any()


class SelectedStates(LastState):
    """The states with given indices, stacked along a new first axis; fields that cannot be stacked form a tuple.

    Parameters
    ----------
    form : ArgumentForm
    numbers : sequence of int
        Indices of states, in increasing order.
    """

    enters_everywhere = True

    def __init__(self, form: ArgumentForm, numbers: Sequence[int]) -> None:
        super().__init__(form)
        self._rows = {number: row for row, number in enumerate(numbers)}
        # For each variable the position of its stack in the list of arrays, or the slice of its separate states.
        self._places: list = []

    def start(self, runner: StepRunner) -> None:
        """Begin a run: allocate an array for each variable, or a list if its states are traced or distributed."""
        n = len(self._rows)
        self._blocks: list = []
        self._statics = []
        self._is_stored = bool(runner.specification.differentiated)
        for shape, dtype, value in zip(self.form.shapes, self.form.dtypes, runner.first.values, strict=True):
            if is_array(value) and not runner.outer:
                self._blocks.append(np.empty((n, *shape), dtype))
            else:
                self._blocks.append([None] * n)

    def see(self, state: State) -> State:
        """Store a state if it is selected; if all states are returned, the run continues from the stored arrays."""
        row = self._rows.get(state.i)
        if row is None:
            return state
        self._statics.append(state.statics)
        values = list(state.values)
        for k, block in enumerate(self._blocks):
            if not isinstance(block, list) and not is_array(values[k]):
                block = self._blocks[k] = [*block]  # the first state was a NumPy array, this one is another field
            if isinstance(block, list):
                block[row] = owned(values[k])
            else:
                block[row] = values[k]
            if np.ndim(values[k]) and self.holds_all_states:
                values[k] = block[row]
        return state.with_values(values)

    def take(self, trajectories: list, last: State) -> None:
        """Store the selected states of a run, which are rows of an array for each variable."""
        self._statics = [last.statics] * len(self._rows)
        if self.holds_all_states:
            self._blocks = list(trajectories)
        else:
            self._blocks = [block[list(self._rows)] for block in trajectories]

    def entering(self, n: int, cotangents: list) -> list | None:
        """Return for each variable an array of the cotangents of the result at states 0 to n."""
        arrays = []
        for block, shape, dtype in zip(self._grouped(cotangents), self.form.shapes, self.form.dtypes, strict=True):
            if self.holds_all_states:
                arrays.append(np.ascontiguousarray(block, dtype))
            else:
                array = np.zeros((n + 1, *shape), dtype)
                array[list(self._rows)] = block
                arrays.append(array)
        return arrays

    def finish(self, last: State) -> tuple:
        """End a run; return the arrays of the result.

        If all states are returned, the backward pass reads these arrays, which are therefore read-only.
        """
        arrays: list = []
        self._places = []
        for block in self._blocks:
            if isinstance(block, list):
                block = stacked(block)
            if isinstance(block, tuple):
                self._places.append(slice(len(arrays), len(arrays) + len(block)))
                arrays += block
            else:
                self._places.append(len(arrays))
                arrays.append(block)
        self._blocks = []
        for block in arrays:
            if type(block) is np.ndarray:
                block.flags.writeable = not (self.holds_all_states and self._is_stored)
        return tuple(arrays)

    def _grouped(self, arrays: Sequence) -> list:
        """Return for each variable the stack of its states, or their tuple."""
        groups: list = []
        for place in self._places:
            if isinstance(place, int):
                groups.append(arrays[place])
            else:
                groups.append(tuple(arrays[place]))
        return groups

    def tree(self, arrays: Sequence) -> Any:
        """Build the result for the user from arrays as `finish` returns them."""
        statics = [_along_trajectory(leaf) for leaf in zip(*self._statics, strict=True)]
        return self.form.build(self._grouped(arrays), statics)

    def sources(self, n: int, cotangents: list) -> Callable[[State], list | None]:
        """Return a function that maps a state to the cotangents of the result at this state, or to None."""
        blocks = self._grouped(cotangents)

        def source(state: State) -> list | None:
            row = self._rows.get(state.i)
            if row is None:
                return None
            return [block[row] for block in blocks]

        return source


class AllStates(SelectedStates):
    """All n + 1 states."""

    holds_all_states = True


def _along_trajectory(leaf: tuple) -> Any:
    """Stack a static leaf over all states if it is a number or array; otherwise return its value in the first state."""
    if isinstance(leaf[0], (bool, int, np.ndarray, np.generic)):
        return np.stack(leaf)
    return leaf[0]


class _StackedResult:
    """Placeholder for a floating result in a tree: the index of its stack and its row, None for a result alone."""

    def __init__(self, stack: int, row: int | None) -> None:
        self.stack = stack
        self.row = row

    def of(self, stacks: Sequence) -> Any:
        """Return the result itself, or its cotangent."""
        stack = stacks[self.stack]
        if self.row is None:
            return stack
        return stack[self.row]


class FunctionOfStates(LastState):
    """The results of function(index, state) for each state; floating results of equal shape share one stack.

    Parameters
    ----------
    form : ArgumentForm
    function : callable
    """

    enters_everywhere = True
    takes_trajectories = False

    def __init__(self, form: ArgumentForm, function: Callable) -> None:
        super().__init__(form)
        self.function = function
        self._fingerprints: list = []  # fingerprints of the results, to detect other results in a later call
        self._trees: list = []  # the results, with a _StackedResult in place of each floating leaf
        self._first_trees: list = []  # the trees of the first run; later results get the same order of entries

    def start(self, runner: StepRunner) -> None:
        """Begin a run."""
        self._stacks: dict = {}
        self._first_trees = self._first_trees or self._trees
        self._trees = []
        self._runner = runner

    def see(self, state: State) -> State:
        """Call the function; return the same state."""
        result = self.function(state.i, self._runner.state_tree(state))
        if state.i < len(self._first_trees):
            first = self._first_trees[state.i]
            result = flatten(first)[1](self._paired(result, first, state.i))
        self._trees.append(mapped(self._stored, result))
        if self._runner.specification.differentiated:
            self._compare(state.i, leaves(result))
        return state

    def _paired(self, result: Any, first: Any, i: int) -> list:
        """Return the leaves of a result in the order of the leaves of an earlier result."""
        return paired(result, first, f"keep({i}, state)", advice=f"; {NOT_REPEATABLE}", error=DerivativeError)

    def _stored(self, leaf: Any) -> Any:
        """Store a floating result and return its placeholder; return a constant copy of anything else."""
        refuse_mask("keep returned a masked array", plain(leaf))
        if not is_variable(leaf):
            return constant(leaf)
        (leaf,), _ = split_boxes([leaf], self._runner.number)
        if not traces_of([leaf]) <= self._runner.outer:
            raise DerivativeError(
                "keep uses a traced value that is not part of the state, and its derivative would be lost; "
                "return what it needs of the state, and combine the two outside of rollout"
            )
        if not is_array(plain(leaf)):  # a field that cannot be stacked has a stack of its own
            place = len(self._stacks)
            self._stacks[place] = [owned(leaf)]
            return _StackedResult(place, None)
        key = (np.shape(leaf), dtype_of(leaf).char)
        stack = self._stacks.setdefault(key, [])
        stack.append(owned(leaf))
        return _StackedResult(list(self._stacks).index(key), len(stack) - 1)

    def _compare(self, i: int, results: Sequence) -> None:
        """Raise DerivativeError if the function returns other values for a state than in an earlier call."""
        values = [as_field(plain(leaf)) for leaf in results if is_variable(leaf)]
        fingerprints = [(value.shape, value.dtype, fingerprint([value])) for value in values]
        if i == len(self._fingerprints):
            self._fingerprints.append(fingerprints)
        elif self.is_exact and self._fingerprints[i] != fingerprints:
            raise DerivativeError(NOT_REPEATABLE)

    def finish(self, last: State) -> tuple:
        """End a run; return one array for each shape and dtype."""
        arrays = []
        for key, stack in self._stacks.items():
            if isinstance(key, int):
                arrays.append(stack[0])
            else:
                arrays.append(stacked(stack))
        self._stacks = {}
        return tuple(arrays)

    def tree(self, arrays: Sequence) -> tuple:
        """Return the tuple of the results of the function."""

        def take(leaf: Any) -> Any:
            if isinstance(leaf, _StackedResult):
                return leaf.of(arrays)
            return leaf

        return tuple(mapped(take, tree) for tree in self._trees)

    def sources(self, n: int, cotangents: list) -> Callable[[State], list | None]:
        """Return a function from a state to the cotangents that enter there."""

        def source(state: State) -> list:
            tree = self.form.build(state.values, state.statics)
            first = self._trees[state.i]

            def function(tree: Any) -> list:
                return self._paired(self.function(state.i, tree), first, state.i)

            tape = taped(function, tree, map(is_variable, leaves(tree)))
            self._compare(state.i, tape.values)
            entering = []
            for leaf in leaves(first):
                if isinstance(leaf, _StackedResult):
                    entering.append(leaf.of(cotangents))
                else:
                    entering.append(None)
            pulled = tape.pull(entering)
            return [pulled[place] for place in self.form.places]

        return source
