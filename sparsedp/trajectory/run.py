"""One run over all steps of a rollout: forward, and back, under a budget of kept states.

It is one node on the tape of the innermost trace that leads to it, if that is a reverse-mode one. Every other trace
goes through the steps themselves, forward and back: a derivative forward is the loop with tangents, and derivatives of
higher order are those of the calls that the run makes.
"""

from typing import Any

import numpy as np

from sparsedp.derivative import judged, zero_like
from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.fields import place
from sparsedp.ledger import active, count
from sparsedp.progress import shown_steps
from sparsedp.tape import Rule, plain
from sparsedp.trajectory.backward_pass import BackwardPass
from sparsedp.trajectory.layout import is_finite
from sparsedp.trajectory.record import APART, SAMPLES, Record
from sparsedp.trajectory.schedule import checkpoints
from sparsedp.trajectory.steps import Steps

__all__ = ["Loop", "Run", "count_of", "parts", "rollout_rule"]

CALL = 800  # bytes of a node, its closures and tuples: 350 to 1200 were measured


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
        How many states may be kept for the way back; None: all; 0: the last one, steps are reversed.
    room : int
        Bytes for tapes that are kept from the way forward.
    progress : bool or str
    record : callable or None
    """

    def __init__(self, step, layouts, n, truncate, wanted, keep, slots, room, progress, record):
        self.step, self.layouts, self.n, self.wanted = step, layouts, n, wanted
        self.truncate = truncate or n + 1
        self.state, self.params, self.inputs = [*layouts, None][:3]
        self.state.rounds = any(any(form.floats) for form in layouts)
        self.keep, self.room, self.progress, self.record = keep, room, progress, record
        self.every = max(n // SAMPLES, APART)
        self.slots = None if keep.whole else slots
        self.reverse = slots == 0  # no state is kept: steps are turned round
        if self.reverse:
            keep.exact = False
        self.stops = (
            {*(() if self.reverse else checkpoints(n, self.slots)), n} if wanted else {0}
        )  # numbers of the states that are kept, and n
        self.kept = len(self.stops) - 1

    @property
    def names(self):
        """Of all variables, as one would write them."""
        return [name for layout in self.layouts for name in layout.names]

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
        return 0 < i < self.n and (self.n - i) % self.truncate == 0

    def advance(self, steps):
        """(last state, the states kept, the tapes kept) after all steps from the first state."""
        wanted, room = self.wanted, self.room
        state, tapes, weight = self.keep.see(steps.first), [], 0  # type: Any, list, int
        kept = [state]
        for i in shown_steps(self.progress, range(self.n), "forward"):
            # The first two tapes tell what a step takes.
            taped = wanted and (i == 0 or weight <= room)
            if taped:
                steps.recorder.bytes = 0 if i < 2 else None
                tape, state = steps.taped(state)
                if i < 2:
                    weight = steps.recorder.bytes + len(tape.nodes) * CALL - self.state.nbytes
                room -= weight
                tapes += [tape] if i or room >= 0 else []
                del tape
            else:
                state = steps.forward(state)
            state = self.keep.see(state)
            if state.i in self.stops:
                state = state if taped or self.keep.whole else state.owned()
                kept.append(state)
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

    def compare(self, marks, earlier):
        """Refuse a state that is another one than before; both as fingerprints."""
        if marks != earlier:
            layout = self.state
            names = [*layout.names, *[layout.root] * len(marks)]
            name = next(name for name, a, b in zip(names, marks, earlier, strict=False) if a != b)
            raise DerivativeError(
                f"the step gives another {name} when it is run again; it must depend on its arguments only"
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
        loop, steps = self.loop, Steps(self.loop, args)
        loop.keep.start(steps)
        with steps.guarded():
            state, kept, tapes = loop.advance(steps)
        if not all(map(is_finite, state.values)):
            loop.refuse(steps)
        steps.recorder.ended = True
        if loop.wanted:
            self._end = state.marks()
            self._stored = steps, kept, tapes
        if active:
            count("rollout.step", "forward", loop.n)
            count("rollout", "bytes", loop.kept * loop.state.nbytes)
        if loop.record is not None:
            loop.record(Record("forward", loop.n, loop.kept, 0))
        return loop.keep.finish(state)

    def backward(self, args, g):
        """Cotangents of the outputs -> those of the arguments that want one, in that order."""
        backs, loop = self._back(args, g), self.loop
        broken = [loop.names[number] for number, back in zip(loop.wanted, backs, strict=True) if not is_finite(back)]
        if broken and all(map(is_finite, g)):
            with judged():  # a second run tells the call that is to blame, if one is
                self.forward(args)
                self._back(args, g)
            raise NonFiniteError(
                f"the way back through {loop.n} steps of rollout makes the gradient in {broken[0]} NaN or infinite; "
                "take fewer steps, or cut it with truncate"
            )
        return backs

    def _back(self, args, g):
        """The same, finite or not."""
        loop = self.loop
        if self._stored is None:
            end = self._end
            self.forward(args)
            loop.compare(self._end, end)
        steps, kept, tapes = self._stored
        if loop.slots is not None:  # under a budget they are freed as they are used, and made again if asked again
            self._stored = None
        steps.recorder.ended = False
        with steps.guarded("on the way back through step"):
            cotangents = BackwardPass(loop, steps, list(kept) if self._stored else kept, list(tapes)).back(g)
        steps.recorder.ended = True
        backs = ((cotangents[number], args[number]) for number in loop.wanted)
        return tuple(zero_like(value) if back is None else back for back, value in backs)


def count_of(ans):
    """How many results a rule has, None where it is one array and no tuple."""
    return len(ans) if isinstance(ans, tuple) else None


def parts(values, many):
    """The results of a rule or their cotangents as a list."""
    return [values] if many is None else [values[k] for k in range(many)]


def _forward(run, *args):
    results = run.forward(args)
    return results if len(results) != 1 else results[0]


def _vjp(nums, ans, run, *args):
    many = count_of(ans)
    return lambda g: run.backward(args, parts(g, many))


rollout_rule = Rule("rollout", _forward, _vjp)
