"""Run the steps of a rollout, with or without a tape, and add the number of the step to error messages."""

from __future__ import annotations

from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import copied, flatten, leaves
from sparsedp._utils.validation import advise
from sparsedp.autodiff.tape import (
    Recorder,
    backward,
    boxed,
    dtype_of,
    fit,
    isbox,
    new_trace,
    plain,
    traces_of,
    untaped_root,
)
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, UnstableStepError
from sparsedp.trajectory.record import largest
from sparsedp.trajectory.specification import fingerprint, owned, refuse_foreign_trace

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sparsedp.trajectory.specification import RolloutSpecification

__all__ = ["State", "StepRunner"]

NODE_BYTES = 800  # memory of a node with its closures and tuples; measured values lie between 350 and 1200
# Largest accepted error of the first state after reversed steps, relative to the size of each field, in double and in
# single precision. The gradient by reversed steps has about the same relative error.
DRIFT = 1e-8
SINGLE_DRIFT = 1e-4
REMEDIES = {
    "state": "return another dict or list",
    "params": "make what changes a part of the state",
    "inputs": "make what changes a part of the state",
}


class State:
    """One state of a run.

    Attributes
    ----------
    i : int
        Number of steps before this state.
    values : list
        Values of the variables (floating leaves).
    statics : tuple
        The other leaves.
    depends : list or None
        For each variable True if it depends on a traced value, else None. None instead of the list if all depend.
    boxes : (variables, nodes) or None
        The traced variables as the step returned them, and their nodes, if the next step can use these without new
        roots. Cleared when the next step begins.
    tape : (roots, nodes, ends) or None
        Tape of the step that begins at this state. `roots`: the roots of the variables of state and inputs, None for
        a constant. `nodes`: all recorded calls in order, so that the backward pass need not sort a graph. `ends`: the
        nodes of the variables of the next state, None for one that does not depend on a traced value.
    """

    __slots__ = ("boxes", "depends", "i", "statics", "tape", "values")

    def __init__(self, i: int, values: list, statics: Sequence, depends: list | None = None) -> None:
        self.i = i
        self.values = values
        self.statics = statics
        self.depends = depends
        self.tape: Any = None
        self.boxes: Any = None

    def with_values(self, values: list) -> State:
        """Return the state with the given arrays as variables, and without a tape."""
        return State(self.i, values, self.statics, self.depends)

    def owned(self) -> State:
        """Return a copy of the state, because a step may later write into arrays that it has returned."""
        return self.with_values(list(map(owned, self.values)))

    def fingerprint(self) -> list:
        """Return the fingerprints of the leaves, to compare states of two runs."""
        return fingerprint(self.values, self.statics)


class StepRunner:
    """Runs the steps of a rollout from given arguments.

    Parameters
    ----------
    specification : RolloutSpecification
    args : list of arrays
        Variables of state, params and inputs. Those that are traced belong to outer traces, which also record the
        operations of every step.

    Attributes
    ----------
    first : State
    params, inputs : lists
        Variables of params and of inputs.
    param_roots, input_roots : lists
        A root for each variable of params and of inputs; None if it needs no cotangent. The roots of params are the
        same in all steps.
    outer : set of int
        Numbers of the traces of the arguments.
    current : State or None
        The state from which the last step began, for error messages.
    copies : bool
        Whether the state after each step is copied, because the step writes into arrays that it has returned.
    """

    copies = False

    def __init__(self, specification: RolloutSpecification, args: Sequence) -> None:
        self.specification = specification
        self.recorder = Recorder()
        self.number = new_trace()
        self.outer = traces_of(args)
        self.current: State | None = None
        self.continues = not (specification.cuts or specification.inputs)
        values, self.params, self.inputs = specification.split(args)
        self.first = State(0, values, specification.state.statics)
        roots: list = [None] * len(args)
        for position in specification.differentiated:
            roots[position] = self.recorder.root()
        _, self.param_roots, self.input_roots = specification.split(roots)
        self.lasting_nodes = {None, *self.param_roots}

    @cached_property
    def _taped_params(self) -> Any:
        return self._build_params(self.param_roots)

    @cached_property
    def _untaped_params(self) -> Any:
        return self._build_params([root and self._untaped for root in self.param_roots])

    @cached_property
    def _untaped(self) -> Any:
        """The root of variables in steps without a tape, which makes a value that a step stores detectable."""
        return untaped_root(self.recorder)

    def step(self, state: State, is_taped: bool) -> State:
        """Return the state after one step; if `is_taped`, store the tape of the step in the given state."""
        specification = self.specification
        number = self.number
        boxes = state.boxes
        self.current = state
        state.boxes = None
        if is_taped and boxes:
            values, roots = boxes
        else:
            values = self._step_values(state)
            roots = ()
            if specification.differentiated:
                roots = self._new_roots(state, is_taped)
                values = boxed(values, roots, number)
        if is_taped:
            params = self._taped_params
        else:
            params = self._untaped_params
        arguments = self._arguments(state, values, params)
        if specification.is_open:
            entries = [leaves(argument) for argument in arguments]
        else:
            entries = None
        result = specification.step(*arguments)
        if entries is not None:
            _check_entries(arguments, entries)
        variables, values, nodes, statics = specification.state.take(result, "the step", number, self.outer)
        following = State(state.i + 1, values, statics)
        if None in nodes:
            following.depends = [node and True for node in nodes]
        if is_taped:
            state.tape = roots, self.recorder.taken(), nodes
            if self.continues and variables and self._are_separate(nodes):
                following.boxes = variables, nodes
                for value in values:
                    if type(value) is np.ndarray:
                        value.flags.writeable = False
        # A variable that does not depend on traced values may be an array that the step writes into again.
        if self.copies or (is_taped and following.depends):
            return following.owned()
        return following

    def tape_size(self, state: State) -> int:
        """Return an estimate of the bytes that the tape of a state takes beside the state."""
        nodes = state.tape[1]
        size = (self.recorder.bytes or 0) + len(nodes) * NODE_BYTES - self.specification.state.nbytes
        return max(size, 0)

    def pulled_back(self, g: list, state: State, sums: dict, rows: list[list]) -> list | None:
        """Return the cotangents of a state with a tape, given those of the next state; None if no variable has one.

        Parameters
        ----------
        g : list
            For each variable of the next state its cotangent, or None.
        state : State
        sums : dict
            For each root of params the pair (sum of its cotangents, whether it may be modified in place). The
            cotangents of the step are added.
        rows : list of lists
            For each array of inputs the cotangents of its rows. The row of the step is replaced.
        """
        roots, nodes, ends = state.tape
        self.current = state
        backward(nodes, ends, g, sums)
        backs: list = []
        is_reached = False
        for root, value in zip(roots, state.values):
            if root in sums:
                back = sums.pop(root)[0]
            else:
                back = None
            if back is not None:
                back = fit("the step", value, back, back)
                is_reached = True
            backs.append(back)
        for row, root in zip(rows, roots[len(backs) :]):
            if root in sums:
                row[state.i] = sums.pop(root)[0]
        if not sums.keys() <= self.lasting_nodes:  # the step used a value that another step recorded
            refuse_foreign_trace("the step")
        if is_reached:
            return backs
        return None

    def _are_separate(self, nodes: list) -> bool:
        """Return True if no two variables of a state, and no variable and a parameter, share a node."""
        if len(nodes) == 1:  # without building a set
            return nodes[0] not in self.lasting_nodes
        return len({*nodes}) == len(nodes) and self.lasting_nodes.isdisjoint(nodes)

    def reversed_step(self, state: State) -> State:
        """Return the previous state, computed by the reversed step and thus equal up to rounding."""
        earlier = State(state.i - 1, state.values, state.statics)
        self.current = earlier
        result = self.specification.step.back(*self._plain_arguments(earlier))  # type: ignore[attr-defined]
        form = self.specification.state
        _, values, _, statics = form.take(result, "the reversed step", self.number, self.outer)
        return State(earlier.i, values, statics)

    def state_tree(self, state: State) -> Any:
        """Return the tree of a state for the function `keep`, with traced variables if they have a derivative."""
        if state.i >= self.specification.first_traced:
            root = self._untaped
        else:
            root = None
        values = boxed(map(frozen, state.values), [root] * len(state.values), self.number)
        return self.specification.state.build(values, state.statics)

    def _new_roots(self, state: State, is_taped: bool) -> list:
        """Return a list with a root for each variable of state and inputs, and None for each constant."""
        specification = self.specification
        if state.i < specification.first_traced or state.i in specification.cuts:
            depends: list = [None] * len(state.values)
        else:
            depends = state.depends or [True] * len(state.values)
        roots: list = []
        for is_traced in (*depends, *self.input_roots):
            if not is_traced:
                roots.append(None)
            elif is_taped:
                roots.append(self.recorder.root())
            else:
                roots.append(self._untaped)
        return roots

    def _build_params(self, roots: list) -> Any:
        """Return the params of a step.

        Python floats are not converted to NumPy float64, which would widen a float32 state to float64.
        """
        form = self.specification.params
        values = []
        for value, is_python_float in zip(self.params, form.is_float, strict=True):
            if is_python_float and not isbox(value):
                values.append(float(value))
            else:
                values.append(frozen(value))
        return form.build(boxed(values, roots, self.number))

    def _step_values(self, state: State) -> list:
        """Return the variables of state and inputs for a step; at a cut of `truncate` the state is a constant."""
        values = state.values
        if state.i in self.specification.cuts:
            values = list(map(plain, values))
        values = list(map(frozen, values))
        for block in self.inputs:
            values.append(frozen(block[state.i]))
        return values

    def _arguments(self, state: State, values: Sequence, params: Any) -> tuple:
        """Build the arguments of a step from the variables of state and inputs."""
        form = self.specification.state
        inputs = self.specification.inputs
        if inputs is None:
            return form.build(values, state.statics), params
        n = len(state.values)
        statics = [leaf[state.i] if isinstance(leaf, np.ndarray) else leaf for leaf in inputs.statics]
        return form.build(values[:n], state.statics), params, inputs.build(values[n:], statics)

    def _plain_arguments(self, state: State) -> tuple:
        """Return the arguments of the step that begins at a state, without boxes of the trace of the rollout."""
        return self._arguments(state, self._step_values(state), self._build_params([None] * len(self.params)))

    def check_drift(self, state: State, last: State) -> None:
        """Raise DerivativeError if reversed steps from the last state end too far from the first state."""
        drift = DRIFT
        for value in self.first.values:
            if np.finfo(dtype_of(plain(value))).eps > np.finfo(float).eps:
                drift = SINGLE_DRIFT
        for values in zip(state.values, self.first.values, last.values, strict=True):  # each field by itself
            back, first, end = map(plain, values)
            error = largest([back - first])
            size = largest([first, end])
            if not error <= drift * size:
                raise DerivativeError(
                    f"reversed steps end {error:.1e} away from the first state, beside states of size {size:.1e}: "
                    "rounding grew on the way; give rollout a memory in bytes"
                )

    @contextmanager
    def errors_named(self, place: str = "in step") -> Iterator[None]:
        """Add the number of the step to error messages; name the argument if the step wrote into a read-only array."""
        try:
            yield
        except (ConvergenceError, NonFiniteError, UnstableStepError) as error:
            if self.current:
                error.args = f"{place} {self.current.i} of rollout: {error}", *error.args[1:]
            raise
        except (ValueError, TypeError) as error:
            refuses = _refuses_writing(error)
            change = self._changed_argument()
            if change is None and refuses:
                change = "keep changes the state"
            if change is None:
                advise(error, self.current and self._plain_arguments(self.current)[1])
                raise
            raise ValueError(f"{change} in place; write u = u + du instead of u += du, or work on a copy") from (
                error if refuses else None
            )
        finally:
            self.recorder.taken()  # discard the recorded calls of a step that raised an exception

    def _changed_argument(self) -> str | None:
        """Return the message that names the array which the step writes into, or None if there is none.

        The step is run once for each array, with this array read-only and all others writeable, until NumPy raises.
        It is run on plain values, because writing into a traced value raises another exception.
        """
        if self.current is None:
            return None
        entries, rebuild = flatten(self._plain_arguments(self.current))
        names = [name for form in self.specification.forms for name in form.labels]
        for position, name in enumerate(names):
            if not isinstance(entries[position], np.ndarray):
                continue
            copies = copied(list(map(plain, entries)))
            copies[position].flags.writeable = False
            try:
                self.specification.step(*rebuild(copies))
            except Exception as error:
                if _refuses_writing(error):
                    return f"the step changes {name}"
        return None


def _refuses_writing(error: Exception) -> bool:
    message = str(error)
    return isinstance(error, (ValueError, TypeError)) and ("read-only" in message or "readonly" in message)


def _check_entries(arguments: tuple, entries: list) -> None:
    """Raise ValueError if a step has modified a dict or list among its arguments, which no tape records."""
    for name, argument, earlier in zip(REMEDIES, arguments, entries, strict=False):
        after = leaves(argument)
        if len(after) != len(earlier) or any(a is not b for a, b in zip(after, earlier, strict=True)):
            raise ValueError(f"the step changes the entries of {name}; {REMEDIES[name]}")
