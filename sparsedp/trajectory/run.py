"""All steps of a rollout: forward, and back, under a budget of kept states.

It is one node on the tape of the innermost trace that leads to it, if that is a reverse-mode one. Every other trace
goes through the steps themselves, forward and back: a derivative forward is the loop with tangents, and derivatives of
higher order are those of the calls that the run makes.
"""

from copy import copy
from operator import is_

import numpy as np

from sparsedp._utils.counters import count
from sparsedp._utils.progress import shown_steps
from sparsedp.autodiff.derivative import is_finite, judged, zero_like
from sparsedp.autodiff.tape import Rule, innermost, through
from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.trajectory.backward_pass import go_back
from sparsedp.trajectory.memory_budget import checkpoints
from sparsedp.trajectory.record import APART, SAMPLES, Record
from sparsedp.trajectory.steps import Steps

__all__ = ["Loop"]

CALL = 800  # bytes of a node, its closures and tuples: 350 to 1200 were measured


class Loop(Rule):
    """A rollout as a rule of its variables, and what it keeps for the way back.

    Parameters
    ----------
    step : callable
    layouts : list of Layout
        Of state, params and, where there are any, inputs.
    n : int
    truncate : int or None
    wanted : list of int
        The arguments that want a cotangent.
    keep : Last, Some, All or Each
    slots : int or None
        How many states may be kept for the way back; None: all; 0: the last one, steps are reversed.
    room : int
        Bytes for tapes that are kept from the way forward.
    progress : bool or str
    record : callable or None

    Attributes
    ----------
    cuts : range
        The states that truncation makes constants for the steps after them.
    moving : int
        The first state that is traced.
    open : bool
        Whether a step gets dicts or lists, whose entries it could change.
    outputs : int
        How many arrays are handed out.
    """

    name, jvp, keywords = "rollout", None, ()

    def __init__(self, step, layouts, n, truncate, wanted, keep, slots, room, progress, record):
        self.step, self.layouts, self.n, self.wanted = step, layouts, n, wanted
        self.truncate = truncate
        self.state, self.params, self.inputs = [*layouts, None][:3]
        self.state.rounds = any(any(form.floats) for form in layouts)
        self.open = any(layout.open for layout in layouts)
        self.keep, self.room, self.progress, self.record = keep, room, progress, record
        self.every = max(n // SAMPLES, APART)
        self.slots = None if keep.whole else slots
        self.reverse = slots == 0  # no state is kept: steps are turned round
        if self.reverse:
            keep.exact = False
        self.cuts = range(n - truncate, 0, -truncate) if truncate else range(0)
        self.moving = n + 1 if not wanted else 0 if wanted[0] < len(self.state.places) else 1
        self._stops = (
            {*(() if self.reverse else checkpoints(n, self.slots)), n} if wanted else {0}
        )  # numbers of the states that are kept, and n
        self.kept = len(self._stops) - 1
        self._runs: list = []  # for the way back: (steps, states with the last one)
        self._end: list = []  # fingerprint of the last state

    @property
    def names(self):
        """Of all variables, as one would write them."""
        return [name for layout in self.layouts for name in layout.names]

    def split(self, args):
        """Variables of all arguments -> those of state, params and inputs."""
        first = len(self.state.places)
        second = first + len(self.params.places)
        return list(args[:first]), list(args[first:second]), list(args[second:])

    def forward(self, *args):
        """Run all steps; return the array or the arrays to hand out."""
        steps = Steps(self, args)
        self.keep.start(steps)
        with steps.guarded():
            state, kept = self._advance(steps)
        if not all(map(is_finite, state.values)):
            self._refuse(steps)
        steps.recorder.ended = True
        if self.wanted:
            self._end = state.marks()
            self._runs = [(steps, kept)]
        count("rollout.step", "forward", self.n)
        count("rollout", "bytes", self.kept * self.state.nbytes)
        if self.record is not None:
            self.record(Record("forward", self.n, self.kept, 0))
        results = self.keep.finish(state)
        self.outputs = len(results)
        return results if self.outputs != 1 else results[0]

    def again(self, *args):
        """Run the same steps from other values, which may be on any trace, without `progress` and `record`."""
        keep, wanted = copy(self.keep), innermost(args)
        loop = Loop(self.step, self.layouts, self.n, self.truncate, wanted, keep, self.slots, self.room, False, None)
        return through(loop, loop.wanted, *args)

    def parts(self, values):
        """The results of `forward`, or their cotangents, as a list."""
        return [values] if self.outputs == 1 else [values[k] for k in range(self.outputs)]

    def _advance(self, steps):
        """(last state, the states kept) after all steps from the first state."""
        see, along, recorder = self.keep.see, self.keep.along, steps.recorder
        state, room, weight = see(steps.first), self.room, 0
        kept = [state]
        for i in shown_steps(self.progress, range(self.n), "forward"):
            before, taped = state, bool(self.wanted) and (i == 0 or weight <= room)
            recorder.bytes = 0 if i < 2 else None
            state = steps.after(before, taped)
            if True in map(is_, state.values, before.values) and not steps.copies and _shared(state, before):
                steps.copies = True  # once more from the start: this step may have read what it wrote
                self.keep.start(steps)
                return self._advance(steps)
            if taped:
                if i < 2:  # the first two tapes tell what a step takes
                    weight = max(recorder.bytes + len(before.tape[1]) * CALL - self.state.nbytes, 0)
                room -= weight
                if i == 0 and room < 0:
                    before.tape = state.boxes = None
            if along:
                state = see(state)
            if i + 1 in self._stops:
                state = state if taped or self.keep.whole else state.owned()
                kept.append(state)
        return state, kept

    def _refuse(self, steps):
        """Refuse a run that is not finite at its end: NaN stays, so one look tells, and a second run finds the step."""
        state = steps.first
        for i in range(self.n):
            state = steps.after(state, False)
            self.state.check_finite(state.values, f"step {i} of rollout", "needs a smaller time step")

    def vjp(self, nums, ans, *args):
        """From the cotangents of what was handed out to those of the arguments that want one, in that order."""
        runs = self._taken()
        return lambda g: self._backward(args, self.parts(g), runs)

    def _taken(self):
        """The last run, in a list: it is not held here, for its steps hold the loop, and a circle is freed late."""
        runs, self._runs = self._runs, []
        return runs

    def _backward(self, args, g, runs):
        backs = self._back(args, g, runs)
        broken = [self.names[number] for number, back in zip(self.wanted, backs, strict=True) if not is_finite(back)]
        if broken and all(map(is_finite, g)):
            with judged():  # a second run tells the call that is to blame, if one is
                self._back(args, g, [])
            raise NonFiniteError(
                f"the way back through {self.n} steps of rollout makes the gradient in {broken[0]} NaN or infinite; "
                "take fewer steps, or cut it with truncate"
            )
        return backs

    def _back(self, args, g, runs):
        """The same, finite or not. Under a budget a run is freed as it is used, and made again if asked again."""
        if not runs:
            end = self._end
            self.forward(*args)
            self.compare(self._end, end)
            runs.extend(self._taken())
        steps, kept = runs[0] if self.slots is None else runs.pop()
        steps.recorder.ended = False
        with steps.guarded("on the way back through step"):
            cotangents = go_back(self, steps, list(kept) if runs else kept, g)
        steps.recorder.ended = True
        backs = ((cotangents[number], args[number]) for number in self.wanted)
        return tuple(zero_like(value) if back is None else back for back, value in backs)

    def compare(self, marks, earlier):
        """Refuse a state that is another one than before; both as fingerprints."""
        if marks != earlier:
            layout = self.state
            names = [*layout.names, *[layout.root] * len(marks)]
            name = next(name for name, a, b in zip(names, marks, earlier, strict=False) if a != b)
            raise DerivativeError(
                f"the step gives another {name} when it is run again; it must depend on its arguments only"
            )


def _shared(state, before):
    """Whether an array of a state is one of the state before."""
    return any(a is b and isinstance(a, np.ndarray) for a, b in zip(state.values, before.values, strict=True))
