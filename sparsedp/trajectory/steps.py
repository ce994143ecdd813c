"""The steps of a run, on plain values or on a tape."""

from contextlib import contextmanager
from typing import Any

import numpy as np

from sparsedp.derivative import zero_like
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.fields import frozen
from sparsedp.traces import boxed, reverse_root, split_box
from sparsedp.trajectory.carried import Carried, carries
from sparsedp.trajectory.layout import owned
from sparsedp.trajectory.recorder import State, Tape
from sparsedp.tree import copied, flatten, leaves

__all__ = ["Steps"]


_REMEDY = {
    "state": "return another dict or list",
    "params": "make what changes a part of the state",
    "inputs": "make what changes a part of the state",
}


class Steps:
    """The steps of a run.

    Parameters
    ----------
    run : Run
    args : tuple of plain arrays
        Variables of state, params and inputs.
    trace : Trace

    Attributes
    ----------
    roots : list
        Of params, the same for all steps; None where no cotangent is wanted.
    wants_input : list
        For each variable of inputs a root or None.
    """

    def __init__(self, run, args, trace):
        self.run, self.trace = run, trace
        self.step: Any = Carried(run) if run.inputs is None and carries(run.step) else run.step
        self._open = any(layout.open for layout in run.layouts)
        _, self.p, self.x = run.split(args)
        _, self.roots, self.wants_input = run.split(trace.roots)
        given = [frozen(value) for value in self.p]
        self.params = run.params.build(given)
        self._traced_params = run.params.build(boxed(given, self.roots, trace.number))
        self._precise = all(dtype.char == "d" for dtype in run.state.dtypes)  # no cotangent is rounded between steps
        self.last: State | None = None  # the state that the step under way begins with

    def forward(self, state):
        """The state after this one."""
        rows = self.run.rows(state.i, self.x)
        values, statics = self._called(state, self._given(state), self.params, rows)
        return State(state.i + 1, self.run.state.check(values, "the step"), statics)

    def taped(self, state, want_state, tape=None, given=None):
        """The same on a tape: (Tape, the state after this one, its traced variables).

        The last where the next step may begin with them, to the same bits as with roots of its own, else None. Handed
        in as `given`, with the tape that they are on, they make one tape of both steps.
        """
        _, number, recorder, _ = self.trace
        if given is None:
            values = self._given(state)
            roots = [reverse_root(recorder) if want_state else None for _ in values]
            given, tape = boxed(values, roots, number), Tape(state.i, roots, [], [], [], [])
        inputs = [root and reverse_root(recorder) for root in self.wants_input]
        rows = boxed(self.run.rows(state.i, self.x), inputs, number)
        tape.starts.append(len(tape.nodes))
        tape.inputs.append(inputs)
        try:
            found, statics = self._called(state, given, self._traced_params, rows)
        finally:
            tape.nodes.extend(recorder.taken())
        values, tape.ends[:] = [], []
        for value in found:
            value, node = split_box(value, number)
            values.append(value)
            tape.ends.append(node)
        self.run.state.check(values, "the step")
        links = self._precise and _are_new(tape.ends)
        if None in tape.ends:  # perhaps an array that the step uses again
            values = [value if node else owned(value) for value, node in zip(values, tape.ends, strict=True)]
        # As read-only as the values of a root: a rule that writes into its argument would change this very state.
        given = boxed(map(frozen, values), tape.ends, number) if links else None
        return tape, State(state.i + 1, values, statics), given

    def _given(self, state):
        """The variables that a step gets: a dual run has no tangents where the derivative is cut."""
        values, silenced = state.values, self.run.silenced
        if silenced and self.run.is_cut(state.i):
            values = [zero_like(value) if number in silenced else value for number, value in enumerate(values)]
        return list(map(frozen, values))

    def _called(self, state, values, params, rows):
        """The step on variables that may be traced -> those of the next state, and its statics."""
        run = self.run
        self.last = state
        parts = [run.state.build(values, state.statics), params]
        if run.inputs is not None:
            parts.append(run.input_at(state.i, rows))
        given = [leaves(part) for part in parts] if self._open else None
        result = self.step(*parts)
        if given is not None:
            _check_entries(parts, given)
        return run.state.take(result, "the step")

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
                raise
            raise ValueError(f"{changes} in place; write u = u + du instead of u += du, or work on a copy") from (
                error if refused else None
            )

    def _culprit(self):
        """Which array the step writes into, if it does: the one that stops it when all others may be written.

        Asked of plain values: a traced one stops a step with other words.
        """
        run, state = self.run, self.last
        if state is None:
            return None
        parts = [run.state.build(state.values, state.statics), self.params]
        if run.inputs is not None:
            parts.append(run.input_at(state.i, run.rows(state.i, self.x)))
        found, rebuild = flatten(parts)
        for number, name in enumerate(label for layout in run.layouts for label in layout.labels):
            if isinstance(found[number], np.ndarray):
                copies = copied(found)
                copies[number].flags.writeable = False
                try:
                    run.step(*rebuild(copies))
                except Exception as error:
                    if _refuses_writing(error):
                        return f"the step changes {name}"
        return None


def _refuses_writing(error):
    return isinstance(error, (ValueError, TypeError)) and ("read-only" in str(error) or "readonly" in str(error))


def _check_entries(parts, given):
    """Refuse a step that changes the dicts and lists it is given, which a tape would not see."""
    for name, part, before in zip(_REMEDY, parts, given, strict=False):
        found = leaves(part)
        if len(found) != len(before) or any(a is not b for a, b in zip(found, before, strict=True)):
            raise ValueError(f"the step changes the entries of {name}; {_REMEDY[name]}")


def _are_new(nodes):
    """Whether all results come from calls, each from another one."""
    return None not in nodes and all(node.parents for node in nodes) and len(set(nodes)) == len(nodes)
