"""A rollout as a value: the step, the form of its arguments, how far, and what is kept."""

from typing import Any

import numpy as np

from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.fields import frozen, place, surely_finite
from sparsedp.ledger import active, count, thread
from sparsedp.trajectory.backward_pass import BackwardPass
from sparsedp.trajectory.carried import carries
from sparsedp.trajectory.layout import fingerprint
from sparsedp.trajectory.progress import shown_steps
from sparsedp.trajectory.record import Record, looked_at
from sparsedp.trajectory.recorder import State, Trace
from sparsedp.trajectory.schedule import checkpoints
from sparsedp.trajectory.steps import Steps

__all__ = ["Run"]


class Run:
    """What is fixed in a rollout; the variables are passed in.

    Parameters
    ----------
    step : callable
    layouts : list of Layout
        Of state, params and, where there are any, inputs.
    n : int
    keep : Last, All or Each
    slots : int or None
        How many states may be kept for the way back; None: all.
    truncate : int or None
    store : bool
        Whether a way back will follow the first run.
    progress : bool or str
    record : callable or None
    """

    def __init__(self, step, layouts, n, keep, slots=None, truncate=None, store=False, progress=False, record=None):
        self.step, self.layouts, self.n, self.keep = step, layouts, n, keep
        self.state, self.params, self.inputs = [*layouts, None][:3]
        self.state.rounds = any(any(form.floats) for form in layouts)
        self.truncate, self.store = truncate, store
        self.budget, self.slots = slots, None if keep.whole else slots
        self.progress, self.record = progress, record
        self.room: float = 0  # bytes for tapes that are kept from the way forward
        self.room_of_solves: float = 0  # the same where a step solves systems
        self.traced: frozenset = frozenset()  # the arguments that those tapes lead to
        self.place_of: dict = {}  # in a dual run: number of an argument of the run -> its number here
        self.silenced: tuple = ()  # variables that are zero for the step after a cut: tangents
        self.origin: Run | None = None  # of a dual run: the one whose states it goes through again
        self._kept: list = []  # states, the last one included; none where they have been handed over
        self._tapes: list = []  # of the steps from the first one on
        self._trace: Any = None  # of the tapes
        self._end: list | None = None  # fingerprint of the last state

    # ------------------------------------------------------------ arguments

    def split(self, args):
        """Variables of all arguments -> those of state, params and inputs."""
        first = len(self.state.places)
        second = first + len(self.params.places)
        return list(args[:first]), list(args[first:second]), list(args[second:])

    def rows(self, i, x):
        """The variables of all inputs -> those of step i."""
        return [frozen(block[i]) for block in x]

    def input_at(self, i, rows):
        """The inputs of step i, of its variables."""
        return self.inputs.build(
            rows, [leaf[i] if isinstance(leaf, np.ndarray) else leaf for leaf in self.inputs.statics]
        )

    # ------------------------------------------------------------ forward

    def forward(self, args):
        """Run all steps; return the arrays to hand out."""
        trace = Trace.begun(len(args), self.traced)
        steps = Steps(self, args, trace)
        self.keep.start(self)
        with steps.guarded():
            state, kept, tapes = self._advance(steps, self._start(args))
        self._check_end(args, state)
        if self.origin:
            self.origin.agree(state)
        if self.store:
            end = fingerprint(*state[1:])
            self.compare(end, self._end or end)
            last = state if self.keep.whole else state.owned()
            self._end, self._kept, self._tapes, self._trace = end, [*kept, last], tapes, trace
        if active:
            count("rollout.step", "forward", self.n)
            count("rollout", "bytes", len(kept) * self.state.nbytes)
        if self.record is not None:
            self.record(Record("forward", self.n, len(kept), 0))
        return self.keep.finish(self.store)

    def _start(self, args):
        return State(0, self.split(args)[0], self.state.statics)

    def _advance(self, steps, state):
        """(last state, the states kept, the tapes kept) after all steps from the first state."""
        kept: list = []
        tapes: list = []
        recorder = steps.trace.recorder
        state, stops = self.keep.see(state), checkpoints(self.n if self.store else 0, self.slots)
        stop = next(stops, None)
        origin = self.origin if self.origin and self.origin.keep.whole else None  # whose states are all at hand
        many, traced = looked_at(self.n), None
        # How many tapes there is room for: the first two tell. The first shows traced values that the step keeps, too.
        fit = 2 if self.store and self.traced else 0
        solves = thread.solves
        for i in shown_steps(self.progress, range(self.n), "forward"):
            if i == stop:
                own = self.keep.whole or i <= fit  # nobody else has the result of a step on its tape
                kept.append(state if own else state.owned())
                stop = next(stops, None)
            if origin:
                origin.agree(state)
            if i < fit:
                recorder.weighs, before = i < 2, (recorder.bytes, recorder.beside)
                if i < 2 or i % many == 0 or self.keep.along or self.is_cut(i):
                    traced = None  # the cotangent of this state is asked for
                known = tapes[-1] if traced else None
                tape, state, traced = steps.taped(state, self.wants(i, self.traced), known, traced)
                if i < 2:  # what goes in besides may be constants, which all steps share: the second one tells
                    room = self.room if thread.solves == solves else self.room_of_solves
                    results, beside = recorder.bytes - before[0], recorder.beside - before[1]
                    weight = results - self.state.nbytes + i * beside
                    fit = min(room // max(weight, 1), self.n if i else 2)
                    del tapes[int(fit) :]
                if i < fit and tape is not known:
                    tapes.append(tape)
            else:
                state = steps.forward(state)
            state = self.keep.see(state)
        return state, kept, tapes

    def _check_end(self, args, state):
        """Refuse a last state that is not finite: NaN stays, so one look tells, and a second run finds the step."""
        if self.state.is_finite(state.values):
            return
        steps, state = Steps(self, args, Trace.begun(len(args), ())), self._start(args)
        for i in range(self.n):
            state = steps.forward(state)
            for name, value in zip(self.state.names, state.values, strict=True):
                finite = np.isfinite(value)
                if not np.all(finite):
                    many = finite.size - np.count_nonzero(finite)
                    where = place(int(np.argmin(finite)), finite.shape) if finite.ndim else 0
                    raise NonFiniteError(
                        f"step {i} of rollout made {many} values of {name} NaN or infinite, the first at {where}; "
                        "take a smaller time step"
                    )

    # ------------------------------------------------------------ backward

    def compare(self, marks, known):
        """Refuse a state that is another one than before; both as fingerprints.

        Of a dual run only the states count. Its tangents may differ in their last bit: NumPy 1.26 squares in x**2 and
        not in power(x, 2), which autograd calls when x is traced.
        """
        most, run = len(marks), self
        while run.origin:
            run = run.origin
            most = len(run.state.places)
        if marks[:most] != known[:most]:
            names = [*self.state.names, *[self.state.root] * len(marks)]
            name = next(name for name, a, b in zip(names, marks, known, strict=False) if a != b)
            raise DerivativeError(
                f"the step gives another {name} when it is run again; it must depend on its arguments only"
            )

    def agree(self, state):
        """Refuse a state that a dual run goes through where it is not the one that was handed out."""
        if carries(self.step):  # the dual run calls the step, whose own form may round otherwise
            return
        i, values, statics = state
        found = fingerprint(values[: len(self.state.places)], statics[: len(self.state.statics)])
        self.compare(found, self._end if i == self.n else fingerprint(*self._kept[i][1:]))

    def backward(self, args, wanted, g):
        """Cotangents of the outputs -> those of the arguments in `wanted`, in that order."""
        if not self._kept:
            self.store = True
            self.forward(args)
        steps, kept, tapes = self._handed_over(args, frozenset(wanted))
        with steps.guarded("on the way back through step"):
            found = BackwardPass(self, steps, kept, tapes).back(g)
        for number in wanted:
            self._check_gradient(number, found[number], g)
        return tuple(_or_zeros(found[number], args[number]) for number in wanted)

    def _check_gradient(self, number, slope, g):
        """Refuse a gradient that is not finite, unless the cotangents given were not."""
        if slope is None or surely_finite(slope) or np.all(np.isfinite(slope)):
            return
        if all(np.all(np.isfinite(leaf)) for leaf in g):
            name = [name for layout in self.layouts for name in layout.names][number]
            raise NonFiniteError(
                f"the way back through {self.n} steps of rollout makes the gradient in {name} NaN or infinite; "
                "take fewer steps, or cut it with truncate"
            )

    def wants(self, i, wanted):
        """Whether step i hands a cotangent on to its state, when the arguments in `wanted` want theirs."""
        return not self.is_cut(i) if i else any(number < len(self.state.places) for number in wanted)

    def is_cut(self, i):
        """Whether truncation makes state i a constant for the steps after it."""
        return self.truncate is not None and 0 < i < self.n and (self.n - i) % self.truncate == 0

    def _handed_over(self, args, wanted):
        """The steps, the kept states, and the tapes that lead to the arguments `wanted`.

        Under a budget the run keeps them no longer: they are freed as they are used, and made again if asked again.
        """
        kept, tapes, trace = list(self._kept), list(self._tapes), self._trace
        if trace.wanted != wanted:
            trace, tapes = Trace.begun(len(args), wanted), []
        if self.slots is not None:
            self._kept, self._tapes = [], []
        return Steps(self, args, trace), kept, tapes


def _or_zeros(g, value):
    return np.zeros_like(value) if g is None else g
