"""The steps of a rollout, on plain values or on a tape, and in which of them an error arose."""

from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np

from sparsedp._utils.pytree import copied, flatten, leaves
from sparsedp._utils.validation import advise
from sparsedp.autodiff.tape import Recorder, boxed, dtype_of, isbox, new_trace, plain, traces_of, untaped_root
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, UnstableStepError
from sparsedp.trajectory.layout import fingerprint, owned
from sparsedp.trajectory.record import largest

__all__ = ["State", "Steps"]

# Of the size of each field, in double and in single precision: a gradient by reversed steps has about as many digits.
DRIFT, SINGLE_DRIFT = 1e-8, 1e-4
_REMEDY = {
    "state": "return another dict or list",
    "params": "make what changes a part of the state",
    "inputs": "make what changes a part of the state",
}


class State:
    """State i of a run.

    Attributes
    ----------
    i : int
    values : list
        Its variables.
    statics : tuple
        Its other leaves.
    moves : list or None
        True where a variable depends on something traced, None where not; None in place of the list: all do.
    boxes : (variables, nodes) or None
        Its variables as they were returned, and their nodes, where the step from it can go on from those; until it
        begins.
    tape : (roots, nodes, ends) or None
        Of the step from it: the roots of the variables of state and inputs, None where a constant is; all calls, in
        order, so that the backward pass need not sort a graph; the nodes of the state after it, None where that does
        not depend on anything traced.
    """

    __slots__ = ("boxes", "i", "moves", "statics", "tape", "values")

    def __init__(self, i, values, statics, moves=None):
        self.i, self.values, self.statics, self.moves = i, values, statics, moves
        self.tape: Any = None
        self.boxes: Any = None

    def moved(self, values):
        """The same in other memory."""
        return State(self.i, values, self.statics, self.moves)

    def owned(self):
        """The same in memory of its own: a step may use the arrays again that it has returned."""
        return self.moved(list(map(owned, self.values)))

    def marks(self):
        """Fingerprints of all of it."""
        return fingerprint(self.values, self.statics)


class Steps:
    """The steps of a loop with given arguments.

    Parameters
    ----------
    loop : Loop
    args : list of arrays
        Variables of state, params and inputs; traced ones belong to outer traces, and every call is on those too.

    Attributes
    ----------
    first : State
    roots, input_roots : lists
        Of params, the same for all steps, and one for each variable of inputs; None where no cotangent is wanted.
    outer : set of int
        The traces of the arguments.
    last : State or None
        That which the step under way begins with.
    copies : bool
        Whether states get memory of their own: the step writes into arrays that it has handed out.
    """

    copies = False

    def __init__(self, loop, args):
        self.loop, self.recorder, self.number = loop, Recorder(), new_trace()
        self.outer, self.last = traces_of(args), None
        self.goes_on = not (loop.cuts or loop.inputs)
        values, self.p, self.x = loop.split(args)
        self.first = State(0, values, loop.state.statics)
        roots = [self.recorder.root() if number in loop.wanted else None for number in range(len(args))]
        _, self.roots, self.input_roots = loop.split(roots)
        self.known = {None, *self.roots}

    @cached_property
    def _taped_params(self):
        return self._params(self.roots)

    @cached_property
    def _untaped_params(self):
        return self._params([root and self._untaped for root in self.roots])

    @cached_property
    def _untaped(self):
        """The root of all values where there is no tape: what a step stores away is traced all the same."""
        return untaped_root(self.recorder)

    def after(self, state, taped):
        """The step from a state -> the state after it. Where it is taped, the first one gets the tape."""
        loop, number, boxes = self.loop, self.number, state.boxes
        self.last, state.boxes = state, None
        if taped and boxes:
            values, roots = boxes
        else:
            values, roots = self._given(state), ()
            if loop.wanted:
                roots = self._new_roots(state, self.recorder.root if taped else self._root)
                values = boxed(values, roots, number)
        parts = self._parts(state, values, self._taped_params if taped else self._untaped_params)
        given = [leaves(part) for part in parts] if loop.open else None
        result = loop.step(*parts)
        if given is not None:
            _check_entries(parts, given)
        variables, values, nodes, statics = loop.state.take(result, "the step", number, self.outer)
        after = State(state.i + 1, values, statics)
        if None in nodes:
            after.moves = [node and True for node in nodes]
        if taped:
            state.tape = roots, self.recorder.taken(), nodes
            # Each variable has a sum of its own, and so has each of params.
            if self.goes_on and variables and len({*nodes}) == len(nodes) and self.known.isdisjoint(nodes):
                after.boxes = variables, nodes
                for value in values:
                    if type(value) is np.ndarray:
                        value.flags.writeable = False
        if self.copies or (taped and after.moves):  # what is on no tape may be an array that the step uses again
            return after.owned()
        return after

    def back(self, state):
        """The state before this one, by the step turned round: the same to rounding."""
        self.last = earlier = State(state.i - 1, state.values, state.statics)
        result = self.loop.step.back(*self._plain_parts(earlier))
        _, values, _, statics = self.loop.state.take(result, "the step turned round", self.number, self.outer)
        return State(earlier.i, values, statics)

    def shown(self, state):
        """The tree of a state for a function that is called again on a tape."""
        root = self._untaped if state.i >= self.loop.moving else None
        values = boxed(map(frozen, state.values), [root] * len(state.values), self.number)
        return self.loop.state.build(values, state.statics)

    def _new_roots(self, state, new):
        """A new root for each variable of state and inputs, None of a constant."""
        moves = state.moves or [True] * len(state.values)
        if state.i < self.loop.moving or state.i in self.loop.cuts:
            moves = [None] * len(state.values)
        return [wanted and new() for wanted in (*moves, *self.input_roots)]

    def _root(self):
        return self._untaped

    def _params(self, roots):
        """Return the params of a step. Numbers of Python stay such: as float64 they would widen a state of float32."""
        layout = self.loop.params
        values = []
        for value, is_python_float in zip(self.p, layout.floats, strict=True):
            if is_python_float and not isbox(value):
                values.append(float(value))
            else:
                values.append(frozen(value))
        return layout.build(boxed(values, roots, self.number))

    def _given(self, state):
        """The variables of state and inputs that a step gets: constants where the derivative is cut."""
        values = map(plain, state.values) if state.i in self.loop.cuts else state.values
        given = list(map(frozen, values))
        return given + [frozen(block[state.i]) for block in self.x] if self.x else given

    def _parts(self, state, values, params):
        """The arguments of a step, of the variables of state and inputs."""
        layout, inputs = self.loop.state, self.loop.inputs
        first = layout.build(values, state.statics)
        if inputs is None:
            return first, params
        rest = [leaf[state.i] if isinstance(leaf, np.ndarray) else leaf for leaf in inputs.statics]
        return first, params, inputs.build(values[len(state.values) :], rest)

    def _plain_parts(self, state):
        """The same from a state, on no trace of the rollout."""
        return self._parts(state, self._given(state), self._params([None] * len(self.p)))

    def check_start(self, state, last):
        """Refuse a way back by reversed steps, from the last state, that did not end where the way forward began."""
        precisions = [np.finfo(dtype_of(plain(value))).eps for value in self.first.values]
        drift = SINGLE_DRIFT if max(precisions, default=0.0) > np.finfo(float).eps else DRIFT
        for values in zip(state.values, self.first.values, last.values, strict=True):  # a large one hides no other
            back, first, end = map(plain, values)
            off, size = largest([back - first]), largest([first, end])
            if not off <= drift * size:
                raise DerivativeError(
                    f"reversed steps end {off:.1e} away from the first state, beside states of size {size:.1e}: "
                    "rounding grew on the way; give rollout a memory in bytes"
                )

    @contextmanager
    def guarded(self, way="in step"):
        """Say in which step an error arose; turn NumPy's refusal to write into an argument into one that names it."""
        try:
            yield
        except (ConvergenceError, NonFiniteError, UnstableStepError) as error:
            if self.last:
                error.args = f"{way} {self.last.i} of rollout: {error}", *error.args[1:]
            raise
        except (ValueError, TypeError) as error:
            refused = _refuses_writing(error)
            changes = self._culprit() or ("keep changes the state" if refused else None)
            if changes is None:
                advise(error, self.last and self._plain_parts(self.last)[1])
                raise
            raise ValueError(f"{changes} in place; write u = u + du instead of u += du, or work on a copy") from (
                error if refused else None
            )
        finally:
            self.recorder.taken()  # what a step that raised has left

    def _culprit(self):
        """Which array the step writes into, if it does: the one that stops it when all others may be written.

        Asked of plain values: a traced one stops a step with other words.
        """
        state: Any = self.last
        if state is None:
            return None
        entries, rebuild = flatten(self._plain_parts(state))
        for number, name in enumerate(label for layout in self.loop.layouts for label in layout.labels):
            if isinstance(entries[number], np.ndarray):
                copies = copied(list(map(plain, entries)))
                copies[number].flags.writeable = False
                try:
                    self.loop.step(*rebuild(copies))
                except Exception as error:
                    if _refuses_writing(error):
                        return f"the step changes {name}"
        return None


def _refuses_writing(error):
    return isinstance(error, (ValueError, TypeError)) and ("read-only" in str(error) or "readonly" in str(error))


def _check_entries(parts, given):
    """Refuse a step that changes the dicts and lists it is given, which a tape would not see."""
    for name, part, before in zip(_REMEDY, parts, given, strict=False):
        after = leaves(part)
        if len(after) != len(before) or any(a is not b for a, b in zip(after, before, strict=True)):
            raise ValueError(f"the step changes the entries of {name}; {_REMEDY[name]}")
