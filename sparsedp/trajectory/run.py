"""A rollout as a value: the step, the form of its arguments, how far, and what is kept."""

from contextlib import nullcontext
from typing import Any

import numpy as np

from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.fields import place, surely_finite
from sparsedp.ledger import active, count
from sparsedp.trajectory.layout import fingerprint
from sparsedp.trajectory.progress import shown_steps
from sparsedp.trajectory.protocol import engine_of
from sparsedp.trajectory.record import Record
from sparsedp.trajectory.schedule import stride
from sparsedp.trajectory.tapes import Tapes
from sparsedp.trajectory.way import Way

__all__ = ["Run"]


class Run:
    """What is fixed in a rollout; the variables are passed in.

    Parameters
    ----------
    step : callable
    state, params : Layout
    inputs : Layout or None
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

    def __init__(
        self, step, state, params, inputs, n, keep, slots=None, truncate=None, store=False, progress=False, record=None
    ):
        self.step, self.state, self.params, self.inputs = step, state, params, inputs
        state.rounds = any(any(form.floats) for form in (state, params, inputs) if form is not None)
        self.n, self.keep, self.truncate, self.store = n, keep, truncate, store
        self.budget, self.slots = slots, None if keep.whole else slots
        self.progress, self.record = progress, record
        self.tapes: Tapes | None = None  # of single steps, kept from the way forward
        self.place_of: dict = {}  # in a dual run: number of an argument of the run -> its number here
        self.silenced: tuple = ()  # variables that are zero for the step after a cut: tangents
        self.origin: Run | None = None  # of a dual run: the one whose states it goes through again
        self.engine: Any = None  # what runs the steps, once that is known
        self.outcome = None  # what the user's tree holds beside the variables
        self._kept: Any = None
        self._final: tuple = ()
        self._end: list | None = None  # fingerprint of the last state
        self._before: dict = {}  # number of a kept state -> fingerprint of the state before it, where that is not kept

    # ------------------------------------------------------------ arguments

    def split(self, args):
        """Variables of all arguments -> those of state, params and inputs."""
        first = len(self.state.places)
        second = first + len(self.params.places)
        return list(args[:first]), list(args[first:second]), list(args[second:])

    def input_at(self, i, x, traced=list):
        """The inputs of step i, in a list; empty when there are none. `traced` makes traced values of the variables."""
        if self.inputs is None:
            return []
        statics = [leaf[i] if isinstance(leaf, np.ndarray) else leaf for leaf in self.inputs.statics]
        return [self.inputs.build(traced([_at(block, i) for block in x]), statics)]

    # ------------------------------------------------------------ forward

    def forward(self, args):
        """Run all steps; return the arrays to hand out."""
        tapes = self.tapes if self.store else None
        engine = engine_of(self, args, tapes.wanted if tapes else (), tapes is not None)
        collector = self.keep.collector(self)
        with engine.guarded(), tapes.fresh() if tapes else nullcontext():
            state, statics, kept = self._advance(engine, collector, args)
        engine.check_params()
        self._check_end(args, state)
        if self.origin:
            self.origin.agree(self.n, state, statics)
        if self.store:
            end = fingerprint(state, statics)
            self.compare(end, self._end or end)
            self._end = end
            self._kept, self._final = kept, (state if collector.shared else engine.store(state), statics)
        if active:
            count("rollout.step", "forward", self.n)
            count("rollout", "bytes", len(kept) * self.state.nbytes if self.store else 0)
        if self.record is not None:
            self.record(Record("forward", self.n, len(kept), 0))
        outputs, self.outcome = collector.finish(self.store)
        return outputs

    def _advance(self, engine, collector, args):
        """(last state, its statics, kept states) after all steps."""
        state, statics = self.split(args)[0], self.state.statics
        state, along = collector.see(0, state, statics), self.keep.along
        first, state, kept = engine.link(state, statics)
        stop, last = first if self.store else -1, self.n - 1
        origin = self.origin if self.origin and self.origin.keep.whole else None
        if 0 < first == self.n:
            state = collector.see(first, state, statics)
        for i in shown_steps(self.progress, range(first, self.n), "forward"):
            stored = i == stop or (stop >= 0 and i == last)
            if stored:
                kept.append((i, state if collector.shared or i == 0 else engine.store(state), statics))
                stop = self._next(i, len(kept)) if i == stop else stop
            elif stop >= 0 and i + 1 in (stop, last):
                self._before[i + 1] = fingerprint(state, statics)
            if origin:
                origin.agree(i, state, statics)
            before = state
            state, statics = engine.forward(i, state, statics, collector.room(i + 1) if along else None)
            if along or i == last:
                state = collector.see(i + 1, state, statics)
            if not stored and i:
                engine.release(before)
        return state, statics, kept

    def _next(self, i, used):
        """Index of the state to be kept after state i."""
        if self.slots is None:
            return i + 1
        return i + stride(self.n - i, self.slots - used + 1) if self.n - i > 1 else self.n

    def _check_end(self, args, state):
        """Refuse a last state that is not finite: NaN stays, so one look tells, and a second run finds the step."""
        if self.state.is_finite(state):
            return
        engine = engine_of(self, args)
        state, statics = self.split(args)[0], self.state.statics
        for i in range(self.n):
            state, statics = engine.forward(i, state, statics)
            for name, value in zip(self.state.names, state, strict=True):
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

    def agree(self, i, values, statics):
        """Refuse a state that a dual run goes through where it is not the one that was handed out."""
        if self.engine.called:
            found = fingerprint(values[: len(self.state.places)], statics[: len(self.state.statics)])
            self.compare(found, self._end if i == self.n else fingerprint(*self._kept[i][1:]))

    def backward(self, args, wanted, g):
        """Cotangents of the outputs -> those of the arguments in `wanted`, in that order."""
        if self._kept is None:
            self.store = True
            self.forward(args)
        engine = engine_of(self, args, frozenset(wanted))
        with engine.guarded("on the way back through step"):
            state = Way(self, engine, self.wants(0, wanted)).back(g)
        found = [*(state or [None] * len(self.state.places)), *engine.gradients()]
        for number in wanted:
            self._check_gradient(number, found[number], g)
        return tuple(_or_zeros(found[number], args[number]) for number in wanted)

    def _check_gradient(self, number, slope, g):
        """Refuse a gradient that is not finite, unless the cotangents given were not."""
        if slope is None or surely_finite(slope) or np.all(np.isfinite(slope)):
            return
        if all(np.all(np.isfinite(leaf)) for leaf in g):
            name = [*self.state.names, *self.params.names, *(self.inputs.names if self.inputs else ())][number]
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

    def take_kept(self):
        """The kept states, the last one, and `_before`.

        Under a budget they are handed over: freed as they are used, run again if asked again.
        """
        found = self._kept, self._final, self._before
        if self.slots is not None:
            self._kept, self._final, self._before = None, (), {}
        return *found, self._end


def _at(block, i):
    row = block[i]
    if type(row) is np.ndarray:
        row.flags.writeable = False
    return row


def _or_zeros(g, value):
    return np.zeros_like(value) if g is None else g
