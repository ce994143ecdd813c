"""One run over all steps of a rollout: forward, and back, under a budget of kept states.

It is one node on the tape of the innermost trace that leads to it, if that is a reverse-mode one. Every other trace
goes through the steps themselves, forward and back: a derivative forward is the loop with tangents, and derivatives of
higher order are those of the calls that the run makes.
"""

from typing import Any

import numpy as np

from sparsedp.derivative import zero_like
from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.fields import place, surely_finite
from sparsedp.ledger import active, count, thread
from sparsedp.progress import shown_steps
from sparsedp.tape import Rule, plain
from sparsedp.trajectory.backward_pass import BackwardPass
from sparsedp.trajectory.layout import dense
from sparsedp.trajectory.record import Record
from sparsedp.trajectory.schedule import checkpoints
from sparsedp.trajectory.steps import Scale, Steps

__all__ = ["Run", "rollout_rule"]


class Run:
    """How a loop is run.

    Parameters
    ----------
    loop : Loop
    keep : Last, All or Each
    slots : int or None
        How many states may be kept for the way back; None: all.
    rooms : (int, int)
        Bytes for tapes that are kept from the way forward; and where a step solves systems.
    progress : bool or str
    record : callable or None
    """

    def __init__(self, loop, keep, slots, rooms, progress, record):
        self.loop, self.keep, self.rooms, self.progress, self.record = loop, keep, rooms, progress, record
        self.slots = None if keep.whole else slots
        self.stored: Any = None  # for the way back: (steps, states with the last one, tapes from the first step on)
        self._end: list = []  # fingerprint of the last state

    def forward(self, args):
        """Run all steps; return the arrays to hand out."""
        loop, args = self.loop, list(map(dense, args))
        steps = Steps(loop, args)
        self.keep.start(loop.n, steps.outer, bool(loop.wanted))
        with steps.guarded():
            state, kept, tapes = self._advance(steps)
        if not loop.state.is_finite(state.values):
            self._refuse(steps)
        if loop.wanted:
            self._end = state.marks()
            self.stored = steps, [*kept, state if self.keep.whole else state.owned()], tapes
        if active:
            count("rollout.step", "forward", loop.n)
            count("rollout", "bytes", len(kept) * loop.state.nbytes)
        if self.record is not None:
            self.record(Record("forward", loop.n, len(kept), 0))
        return self.keep.finish()

    def _advance(self, steps):
        """(last state, the states kept, the tapes kept) after all steps from the first state."""
        n, recorder, kept, tapes = self.loop.n, steps.recorder, [], []  # type: Any, Any, list, list
        state, stops = self.keep.see(steps.first), set(checkpoints(n, self.slots) if self.loop.wanted else ())
        # How many tapes there is room for: the first two tell. What goes in besides may be constants, which all
        # steps share: the second one tells. The first shows traced values that the step keeps, too.
        fit, solves, scale = 2 if self.loop.wanted else 0, thread.solves, Scale()
        for i in shown_steps(self.progress, range(n), "forward"):
            if i in stops:
                own = self.keep.whole or i <= fit  # nobody else has the result of a step on its tape
                kept.append(state if own else state.owned())
            if i < fit:
                scale.bytes, scale.beside, recorder.weigh = 0, 0, scale if i < 2 else None
                tape, state = steps.taped(state, tapes[-1] if tapes else None)
                tapes.append(tape)
                if i < 2:
                    weight = scale.bytes - self.loop.state.nbytes + i * scale.beside
                    fit = min(self.rooms[thread.solves > solves] // max(weight, 1), n if i else 2)
                    del tapes[int(fit) :]
            else:
                state = steps.forward(state)
            state = self.keep.see(state)
        return state, kept, tapes

    def _refuse(self, steps):
        """Refuse a run that is not finite at its end: NaN stays, so one look tells, and a second run finds the step."""
        state, layout = steps.first, self.loop.state
        for i in range(self.loop.n):
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
            layout = self.loop.state
            names = [*layout.names, *[layout.root] * len(marks)]
            name = next(name for name, a, b in zip(names, marks, known, strict=False) if a != b)
            raise DerivativeError(
                f"the step gives another {name} when it is run again; it must depend on its arguments only"
            )

    def backward(self, args, g):
        """Cotangents of the outputs -> those of the arguments that want one, in that order."""
        if self.stored is None:
            end = self._end
            self.forward(args)
            self.compare(self._end, end)
        steps, kept, tapes = self.stored
        if self.slots is not None:  # under a budget they are freed as they are used, and made again if asked again
            self.stored = None
        with steps.guarded("on the way back through step"):
            found = BackwardPass(self, steps, list(kept) if self.stored else kept, list(tapes)).back(g)
        for number in self.loop.wanted:
            self._check_gradient(number, found[number], g)
        backs = ((found[number], args[number]) for number in self.loop.wanted)
        return tuple(zero_like(value) if back is None else back for back, value in backs)

    def _check_gradient(self, number, slope, g):
        """Refuse a gradient that is not finite, unless the cotangents given were not."""
        slope = plain(slope)
        if slope is None or surely_finite(slope) or np.all(np.isfinite(slope)):
            return
        if all(np.all(np.isfinite(plain(leaf))) for leaf in g):
            name = [name for layout in self.loop.layouts for name in layout.names][number]
            raise NonFiniteError(
                f"the way back through {self.loop.n} steps of rollout makes the gradient in {name} NaN or infinite; "
                "take fewer steps, or cut it with truncate"
            )


def _one(values):
    """A rule with one result returns the array, with several a tuple."""
    return values[0] if len(values) == 1 else values


def _vjp(nums, ans, run, *args):
    many = len(ans) if isinstance(ans, tuple) else None
    return lambda g: run.backward(args, [g] if many is None else [g[k] for k in range(many)])


rollout_rule = Rule("rollout", lambda run, *args: _one(run.forward(args)), _vjp)
