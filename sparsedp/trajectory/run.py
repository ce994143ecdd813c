"""One run over all steps of a rollout: forward, and back, under a budget of kept states.

It is one node on the tape of the innermost trace that leads to it, if that is a reverse-mode one. Every other trace
goes through the steps themselves, forward and back: a derivative forward is the loop with tangents, and derivatives of
higher order are those of the calls that the run makes.
"""

from typing import Any

import numpy as np

from sparsedp.derivative import zero_like
from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.fields import place
from sparsedp.ledger import active, count, thread
from sparsedp.progress import shown_steps
from sparsedp.tape import Rule, plain
from sparsedp.trajectory.backward_pass import BackwardPass
from sparsedp.trajectory.layout import dense, is_finite
from sparsedp.trajectory.record import Record
from sparsedp.trajectory.schedule import checkpoints
from sparsedp.trajectory.steps import Scale, Steps

__all__ = ["Loop", "Run", "rollout_rule"]


class Loop:
    """What is fixed in a rollout; the variables are passed in.

    Parameters
    ----------
    step : callable
    layouts : list of Layout
        Of state, params and, where there are any, inputs.
    n : int
    truncate : int or None
    wanted : list of int
        The arguments that want a cotangent.
    keep : Last, All or Each
    slots : int or None
        How many states may be kept for the way back; None: all.
    rooms : (int, int)
        Bytes for tapes that are kept from the way forward; and where a step solves systems.
    progress : bool or str
    record : callable or None
    """

    def __init__(self, step, layouts, n, truncate, wanted, keep, slots, rooms, progress, record):
        self.step, self.layouts, self.n, self.truncate, self.wanted = step, layouts, n, truncate, wanted
        self.state, self.params, self.inputs = [*layouts, None][:3]
        self.state.rounds = any(any(form.floats) for form in layouts)
        self.keep, self.rooms, self.progress, self.record = keep, rooms, progress, record
        self.slots = None if keep.whole else slots

    def split(self, args):
        """Variables of all arguments -> those of state, params and inputs."""
        first = len(self.state.places)
        second = first + len(self.params.places)
        return list(args[:first]), list(args[first:second]), list(args[second:])

    def wants(self, i):
        """Whether step i hands a cotangent on to its state."""
        return not self.is_cut(i) if i else any(number < len(self.state.places) for number in self.wanted)

    def is_cut(self, i):
        """Whether truncation makes state i a constant for the steps after it."""
        return self.truncate is not None and 0 < i < self.n and (self.n - i) % self.truncate == 0

    def advance(self, steps):
        """(last state, the states kept, the tapes kept) after all steps from the first state."""
        n, recorder, kept, tapes = self.n, steps.recorder, [], []  # type: Any, Any, list, list
        state, stops = self.keep.see(steps.first), set(checkpoints(n, self.slots) if self.wanted else ())
        # How many tapes there is room for: the first two tell. What goes in besides may be constants, which all
        # steps share: the second one tells. The first shows traced values that the step keeps, too.
        fit, solves, scale = 2 if self.wanted else 0, thread.solves, Scale()
        for i in shown_steps(self.progress, range(n), "forward"):
            if i in stops:
                own = self.keep.whole or i <= fit  # nobody else has the result of a step on its tape
                kept.append(state if own else state.owned())
            if i < fit:
                scale.bytes, scale.beside, recorder.weigh = 0, 0, scale if i < 2 else None
                tape, state = steps.taped(state)
                tapes.append(tape)
                if i < 2:
                    weight = scale.bytes - self.state.nbytes + i * scale.beside
                    fit = min(self.rooms[thread.solves > solves] // max(weight, 1), n if i else 2)
                    del tapes[int(fit) :]
            else:
                state = steps.forward(state)
            state = self.keep.see(state)
        return state, kept, tapes

    def refuse(self, steps):
        """Refuse a run that is not finite at its end: NaN stays, so one look tells, and a second run finds the step."""
        state, layout = steps.first, self.state
        for i in range(self.n):
            state = steps.forward(state)
            for name, value in zip(layout.names, state.values, strict=True):
                finite = np.isfinite(plain(value))
                if not np.all(finite):
                    many = finite.size - np.count_nonzero(finite)
                    where = place(int(np.argmin(finite)), finite.shape) if finite.ndim else 0
                    raise NonFiniteError(
                        f"step {i} of rollout made {many} values of {name} NaN or infinite, the first at {where}; "
                        "take a smaller time step"
                    )

    def compare(self, marks, known):
        """Refuse a state that is another one than before; both as fingerprints."""
        if marks != known:
            layout = self.state
            names = [*layout.names, *[layout.root] * len(marks)]
            name = next(name for name, a, b in zip(names, marks, known, strict=False) if a != b)
            raise DerivativeError(
                f"the step gives another {name} when it is run again; it must depend on its arguments only"
            )

    def check_gradient(self, number, slope, g):
        """Refuse a gradient that is not finite, unless the cotangents given were not."""
        if slope is not None and not is_finite(slope) and all(map(is_finite, g)):
            name = [name for layout in self.layouts for name in layout.names][number]
            raise NonFiniteError(
                f"the way back through {self.n} steps of rollout makes the gradient in {name} NaN or infinite; "
                "take fewer steps, or cut it with truncate"
            )


class Run:
    """A loop from given arguments, and what it keeps for the way back; steps know the loop, it knows none of them.

    Parameters
    ----------
    loop : Loop
    """

    def __init__(self, loop):
        self.loop = loop
        self._stored: Any = None  # for the way back: (steps, states with the last one, tapes from the first step on)
        self._end: list = []  # fingerprint of the last state

    def forward(self, args):
        """Run all steps; return the arrays to hand out."""
        loop, steps = self.loop, Steps(self.loop, list(map(dense, args)))
        loop.keep.start(loop.n, steps.outer, bool(loop.wanted))
        with steps.guarded():
            state, kept, tapes = loop.advance(steps)
        if not all(map(is_finite, state.values)):
            loop.refuse(steps)
        if loop.wanted:
            self._end = state.marks()
            self._stored = steps, [*kept, state if loop.keep.whole else state.owned()], tapes
        if active:
            count("rollout.step", "forward", loop.n)
            count("rollout", "bytes", len(kept) * loop.state.nbytes)
        if loop.record is not None:
            loop.record(Record("forward", loop.n, len(kept), 0))
        return loop.keep.finish(state)

    def backward(self, args, g):
        """Cotangents of the outputs -> those of the arguments that want one, in that order."""
        loop = self.loop
        if self._stored is None:
            end = self._end
            self.forward(args)
            loop.compare(self._end, end)
        steps, kept, tapes = self._stored
        if loop.slots is not None:  # under a budget they are freed as they are used, and made again if asked again
            self._stored = None
        with steps.guarded("on the way back through step"):
            found = BackwardPass(loop, steps, list(kept) if self._stored else kept, list(tapes)).back(g)
        for number in loop.wanted:
            loop.check_gradient(number, found[number], g)
        backs = ((found[number], args[number]) for number in loop.wanted)
        return tuple(zero_like(value) if back is None else back for back, value in backs)


def _one(values):
    """A rule with one result returns the array, with several a tuple."""
    return values[0] if len(values) == 1 else values


def _vjp(nums, ans, run, *args):
    many = len(ans) if isinstance(ans, tuple) else None
    return lambda g: run.backward(args, [g] if many is None else [g[k] for k in range(many)])


rollout_rule = Rule("rollout", lambda run, *args: _one(run.forward(args)), _vjp)
