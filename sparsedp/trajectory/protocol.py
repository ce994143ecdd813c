"""Steps that carry plain forms of their own: no tape, and arrays that are used again.

A step may have, beside its call,

    step.forward(state, params, out=None) -> state       `out`: a tree like the result, whose arrays it may overwrite
    step.backward(state, params, g, into=None) -> (g_state, g_params)
                                                         `into`: a tree like params; the gradient is added to its
                                                         arrays in place, and it is returned as g_params

both on plain trees. Transport, linear steppers, nonlinear implicit ones of one stage, and flow_step do. Where
`step.sparing` is true, backward also takes `new`, the result of the step when it is still known, or None, and `wanted`,
whether params want a cotangent. Where `step.solves` is true, backward finds the result again unless it gets it as
`new`, and takes `met`: a function that it calls with that result, and that refuses another one than before.
Where the state is one array, and params another, it may have a time loop of its own as well, for small states:

    step.march(states, params)                           fills the rows of `states`, one step from each to the next
    step.retreat(states, params, g, into=None) -> (g_state, into)    backward over all of them; into=None: for g_state
"""

import numpy as np

from sparsedp.errors import DerivativeError
from sparsedp.tape import dtype_of
from sparsedp.trajectory.keep import Last
from sparsedp.trajectory.layout import NOTHING, fingerprint
from sparsedp.trajectory.linked import Linked
from sparsedp.trajectory.steps import Taped

__all__ = ["PLAIN", "Protocol", "carries", "engine_of"]

SMALL = 2**16  # bytes of a state up to which calling Python for every step would be felt
PLAIN, WHOLE = ("forward", "backward"), ("march", "retreat")
FLOAT = np.dtype(float)
CHUNK = 2**20  # bytes of states that are run at once


def carries(step, *names):
    """Whether a step has methods of these names."""
    return all(callable(getattr(step, name, None)) for name in names)


def engine_of(run, args, wanted=(), recording=False):
    """What runs the steps of a run: the step's own plain forms where it has both, else the tape."""
    if run.engine is None:
        plain = run.inputs is None and carries(run.step, *PLAIN)
        run.engine = (Whole if _is_small(run) else Protocol) if plain else Linked if _is_chain(run) else Taped
    return run.engine(run, args, wanted, recording)


def _is_small(run):
    """Whether the time loop of the step itself does what is asked for."""
    return _is_chain(run) and _is_field(run.params) and run.state.nbytes <= SMALL and carries(run.step, *WHOLE)


def _is_chain(run):
    """Whether one array is handed from step to step, and nothing is to be done in between."""
    plain = run.slots is None and run.truncate is None and not (run.progress or run.silenced)
    return plain and _is_field(run.state) and type(run.keep) is Last and run.inputs is None


def _is_field(form):
    """Whether a tree is one array of float64."""
    return form.bare and form.shapes[0] != () and form.dtypes[0] == FLOAT


class Protocol(Taped):
    """A step with plain forms. States are arrays of this engine: handed out to the step, taken back, used again."""

    called = False  # rounded otherwise

    def __init__(self, run, args, wanted=(), recording=False):
        super().__init__(run, args, wanted, recording)
        self._pool: list = []
        self.called = getattr(run.step, "solves", False) and not (run.state.bare and run.slots is None)
        self._arrays = bool(run.state.shapes) and all(run.state.shapes)
        self._recycles = run.keep.recycles
        self._sparing = run.state.bare and getattr(run.step, "sparing", False)
        self._into = run.params.build([np.zeros(np.shape(v), dtype_of(v)) for v in self.p]) if self._p else None

    def forward(self, i, values, statics, room=None):
        """Variables and statics of state i -> those of state i + 1."""
        layout, self._last = self.run.state, (i, values, statics)
        if room is None and self._arrays:
            room = self._pool.pop() if self._pool else self._fresh()
        if layout.bare:
            new = self.run.step.forward(values[0], self.params, None if room is None else room[0])
            return (room if room and new is room[0] else self._settled([new], room)), statics
        out = None if room is None else layout.build(room, statics)
        result = self.run.step.forward(layout.build(values, statics), self.params, out)
        values, statics = layout.take(result, "the step")
        return self._settled(values, room), statics

    def _settled(self, values, room):
        """Results in arrays of this engine: a step may return its argument, or an array that it will use again."""
        values = self.run.state.check(values, "the step")
        if not self._arrays:
            return values
        for value, own in zip(values, room, strict=True):
            if not np.may_share_memory(value, own):
                own[...] = value
        return room

    def _fresh(self):
        return [np.empty(s, d) for s, d in zip(self.run.state.shapes, self.run.state.dtypes, strict=True)]

    def store(self, values):
        """Nobody else writes into arrays of this engine: they are kept as they are."""
        return values if self._arrays else super().store(values)

    def release(self, values):
        """The arrays of a state that is not needed any more."""
        if self._arrays and self._recycles:
            self._pool.append(values)

    def trim(self):
        """Let go of arrays that nothing is in."""
        self._pool.clear()

    def backward(self, i, values, statics, g, want_state):
        """Cotangents of state i + 1 -> those of state i; those of params are added up."""
        layout, step, self._last = self.run.state, self.run.step, (i, values, statics)
        if layout.bare:
            more = {"new": self.known and self.known[0], "wanted": bool(self._p)} if self._sparing else {}
            more.update(self._compared(statics))
            back, self._into = step.backward(values[0], self.params, g[0], self._into, **more)
            if not want_state:
                return None
            return [back] if layout.is_one(back) else layout.check([back], "the backward form of the step")
        g = [np.zeros_like(v) if slope is None else slope for slope, v in zip(g, values, strict=True)]
        g, more = layout.build(g), self._compared(statics)
        back, self._into = step.backward(layout.build(values, statics), self.params, g, self._into, **more)
        return layout.check(layout.take(back, "the backward form of the step")[0], "the backward form of the step")

    def _compared(self, statics):
        """For a step that solves again on the way back: what compares its result with the state after it."""
        if not (self.called and self.after):
            return {}

        def met(result):
            layout = self.run.state
            values, others = ([result], statics) if layout.bare else layout.take(result, "the step")
            self.run.compare(fingerprint(layout.check(values, "the step"), others), self.after)

        return {"met": met}

    def gradients(self):
        """What has been added up for params."""
        if not self._p:
            return [None] * len(self.p)
        found = self.run.params.take(self._into, "the backward form of the step")[0]
        return [np.asarray(value)[()] for value in found]


class Whole(Protocol):
    """A step with a time loop of its own: all states are rows of one array."""

    def link(self, state, statics):
        """All steps in one piece."""
        run, many = self.run, max(CHUNK // max(self.run.state.nbytes, 1), 1)
        states = np.empty(((run.n if run.store else min(run.n, many)) + 1, *run.state.shapes[0]))
        states[0], rows = state[0], states[:1]
        for done in range(0, run.n, many):  # in pieces, also for Ctrl-C
            if done and not run.store:
                states[0] = rows[-1]
            first = done if run.store else 0
            rows = states[first : first + min(many, run.n - done) + 1]
            self._march(done, rows)
        return run.n, [rows[-1]], Rows(states) if run.store else []

    def _march(self, first, rows):
        """Fill the rows; where that fails, step by step, so that `guarded` can name the step."""
        try:
            self.run.step.march(rows, self.params)
        except Exception:
            for i in range(len(rows) - 1):
                self._last = first + i, [rows[i]], NOTHING
                self.run.step.march(rows[i : i + 2], self.params)
            raise

    def linked(self):
        """All of them."""
        return self.run.n

    def unlink(self, g, stack, growth):
        """Cotangents of the last state -> those of the first."""
        i, (g,), states = self.run.n, g, stack.states
        while i:
            first = (i - 1) // growth.every * growth.every
            g, into = self.run.step.retreat(states[first : i + 1], self.params, g, self._into)
            if into is not self._into:
                raise DerivativeError(
                    "the backward form of the step returned another array for params than the one it was given; add "
                    "to `into` and return it"
                )
            i = first
            growth.see(i, [g])
        return [g]


class Rows:
    """The states of a run as they are kept otherwise: (number, variables, other leaves)."""

    def __init__(self, states):
        self.states = states

    def __len__(self):
        return len(self.states) - 1

    def __getitem__(self, i):
        return i, [self.states[i]], NOTHING
