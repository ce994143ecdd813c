"""A rollout as a value: the step, the form of its arguments, how far, and what is kept."""

from typing import Any

import numpy as np

from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.fields import place, surely_finite
from sparsedp.ledger import active, count, thread
from sparsedp.trajectory.backward_pass import BackwardPass
from sparsedp.trajectory.keep import Last
from sparsedp.trajectory.layout import fingerprint, owned
from sparsedp.trajectory.pieces import Scale
from sparsedp.trajectory.progress import shown_steps
from sparsedp.trajectory.record import Record, looked_at
from sparsedp.trajectory.schedule import stride
from sparsedp.trajectory.steps import Steps, carries

__all__ = ["Run"]

HELD = 2**16  # bytes of cotangents of params that may wait until a piece has been gone through


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
        self.room: float = 0  # bytes for tapes that are kept from the way forward
        self.traced: frozenset = frozenset()  # the arguments that those tapes lead to
        self.pieces: list = []  # the tapes, from the first step on
        self.place_of: dict = {}  # in a dual run: number of an argument of the run -> its number here
        self.silenced: tuple = ()  # variables that are zero for the step after a cut: tangents
        self.origin: Run | None = None  # of a dual run: the one whose states it goes through again
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
        steps, collector = Steps(self, args, self.traced), self.keep.collector(self)
        with steps.guarded():
            state, statics, kept = self._advance(steps, collector, args)
        steps.check_params()
        self._check_end(args, state)
        if self.origin:
            self.origin.agree(self.n, state, statics)
        if self.store:
            end = fingerprint(state, statics)
            self.compare(end, self._end or end)
            self._end = end
            self._kept, self._final = kept, (state if collector.shared else list(map(owned, state)), statics)
        if active:
            count("rollout.step", "forward", self.n)
            count("rollout", "bytes", len(kept) * self.state.nbytes if self.store else 0)
        if self.record is not None:
            self.record(Record("forward", self.n, len(kept), 0))
        outputs, self.outcome = collector.finish(self.store)
        return outputs

    def _advance(self, steps, collector, args):
        """(last state, its statics, kept states) after all steps."""
        state, statics = self.split(args)[0], self.state.statics
        state, shown = collector.see(0, state, statics), iter(shown_steps(self.progress, range(self.n), "forward"))
        state, statics, kept = self._on_tapes(steps, collector, shown, state, statics)
        stop, last = len(kept) if self.store else -1, self.n - 1
        for i in shown:
            if i == stop or (stop >= 0 and i == last):
                kept.append((i, state if collector.shared or i == 0 else list(map(owned, state)), statics))
                stop = self._next(i, len(kept)) if i == stop else stop
            elif stop >= 0 and i + 1 in (stop, last):
                self._before[i + 1] = fingerprint(state, statics)
            self._agree(i, state, statics)
            state, statics = steps.forward(i, state, statics)
            state = collector.see(i + 1, state, statics)
        return state, statics, kept

    def _on_tapes(self, steps, collector, shown, state, statics):
        """As many steps as there is room for, on tapes that are kept: (state, statics, the states before each step)."""
        kept: list = []
        self.pieces = []
        if not (self.store and self.room):
            return state, statics, kept
        scale, outer = Scale(self.room, self.state.nbytes), thread.scale
        many, most = looked_at(self.n), max(HELD // max(self.params.nbytes, 1), 1)
        linked = len(state) == 1 and type(self.keep) is Last  # one tape for several steps, to the same bits

        def goes_on(i, values, others, same):
            scale.step()
            more = linked and same and 1 < i < self.n and i % many and i - first < most and not self.is_cut(i)
            if more and scale.has_room:
                kept.append((i, values, others))
                return True
            return False

        steps.recording = True
        try:
            while len(kept) < self.n and scale.has_room:
                first = len(kept)
                kept.append((first, state, statics))
                self._agree(first, state, statics)
                scale.begin()
                piece, state, statics = steps.taped(first, state, statics, self.wants(first, self.traced), goes_on)
                if scale.fits:
                    self.pieces.append(piece)
                state = collector.see(piece.stop, state, statics)
                for _ in range(first, piece.stop):
                    next(shown)
        finally:
            thread.scale = outer
        return state, statics, kept

    def _agree(self, i, state, statics):
        """A dual run goes through the states of its origin, where those are all at hand."""
        if self.origin and self.origin.keep.whole:
            self.origin.agree(i, state, statics)

    def _next(self, i, used):
        """Index of the state to be kept after state i."""
        if self.slots is None:
            return i + 1
        return i + stride(self.n - i, self.slots - used + 1) if self.n - i > 1 else self.n

    def _check_end(self, args, state):
        """Refuse a last state that is not finite: NaN stays, so one look tells, and a second run finds the step."""
        if self.state.is_finite(state):
            return
        steps = Steps(self, args)
        state, statics = self.split(args)[0], self.state.statics
        for i in range(self.n):
            state, statics = steps.forward(i, state, statics)
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
        if carries(self.step):  # the dual run calls the step, whose own form may round otherwise
            return
        found = fingerprint(values[: len(self.state.places)], statics[: len(self.state.statics)])
        self.compare(found, self._end if i == self.n else fingerprint(*self._kept[i][1:]))

    def backward(self, args, wanted, g):
        """Cotangents of the outputs -> those of the arguments in `wanted`, in that order."""
        if self._kept is None:
            self.store = True
            self.forward(args)
        steps = Steps(self, args, frozenset(wanted))
        with steps.guarded("on the way back through step"):
            state = BackwardPass(self, steps, frozenset(wanted)).back(g)
        found = [*(state or [None] * len(self.state.places)), *steps.gradients()]
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

    def take_kept(self, wanted):
        """The kept states, the last one, `_before`, the mark of the end, and the tapes to the arguments `wanted`.

        Under a budget they are handed over: freed as they are used, run again if asked again.
        """
        pieces = list(self.pieces) if wanted == self.traced else []
        found = self._kept, self._final, self._before, self._end, pieces
        if self.slots is not None:
            self._kept, self._final, self._before, self.pieces = None, (), {}, []
        return found


def _at(block, i):
    row = block[i]
    if type(row) is np.ndarray:
        row.flags.writeable = False
    return row


def _or_zeros(g, value):
    return np.zeros_like(value) if g is None else g
