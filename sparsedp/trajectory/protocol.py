"""Steps that carry plain forms of their own: no tape, and arrays that are used again.

A step may have, beside its call,

    step.forward(state, params, out=None) -> state       `out`: a tree like the result, whose arrays it may overwrite
    step.backward(state, params, g, into=None) -> (g_state, g_params)
                                                         `into`: a tree like params; the gradient is added to its
                                                         arrays in place, and it is returned as g_params

both on plain trees. Transport and the linear steppers do. Where `step.sparing` is true, backward also takes
`new`, the result of the step when it is still known, or None, and `wanted`, whether params want a cotangent.
"""

import numpy as np

from sparsedp.trajectory.steps import Taped

__all__ = ["Protocol", "engine_of"]


def engine_of(run, args, wanted=(), recording=False):
    """What runs the steps of a run: the step's own plain forms where it has both, else the tape."""
    plain = run.inputs is None and all(callable(getattr(run.step, name, None)) for name in ("forward", "backward"))
    return Protocol(run, args, wanted) if plain else Taped(run, args, wanted, recording)


class Protocol(Taped):
    """A step with plain forms. States are arrays of this engine: handed out to the step, taken back, used again."""

    def __init__(self, run, args, wanted=()):
        super().__init__(run, args, wanted)
        self._pool: list = []
        self._arrays = bool(run.state.shapes) and all(run.state.shapes)
        self._recycles = run.keep.recycles
        self._sparing = run.state.bare and getattr(run.step, "sparing", False)
        self._into = run.params.build([np.zeros(np.shape(v), v.dtype) for v in self.p]) if self._p else None

    def forward(self, i, values, statics, room=None):
        """Variables and statics of state i -> those of state i + 1."""
        layout = self.run.state
        if room is None and self._arrays and self._recycles:
            room = self._pool.pop() if self._pool else self._fresh()
        if layout.bare:
            new = self.run.step.forward(values[0], self.params, None if room is None else room[0])
            return [new] if layout.is_one(new) else layout.check([new], "the step"), statics
        out = None if room is None else layout.build(room, statics)
        result = self.run.step.forward(layout.build(values, statics), self.params, out)
        values, statics = layout.take(result, "the step")
        return layout.check(values, "the step"), statics

    def _fresh(self):
        return [np.empty(s, d) for s, d in zip(self.run.state.shapes, self.run.state.dtypes, strict=True)]

    def store(self, values):
        """Nobody else writes into these arrays: they are kept as they are."""
        return values

    def release(self, values):
        """The arrays of a state that is not needed any more."""
        if self._arrays and self._recycles:
            self._pool.append(values)

    def backward(self, i, values, statics, g, want_state):
        """Cotangents of state i + 1 -> those of state i; those of params are added up."""
        layout, step = self.run.state, self.run.step
        if layout.bare:
            more = {"new": self.known and self.known[0], "wanted": bool(self._p)} if self._sparing else {}
            back, self._into = step.backward(values[0], self.params, g[0], self._into, **more)
            if not want_state:
                return None
            return [back] if layout.is_one(back) else layout.check([back], "the backward form of the step")
        g = [np.zeros_like(v) if slope is None else slope for slope, v in zip(g, values, strict=True)]
        back, self._into = step.backward(layout.build(values, statics), self.params, layout.build(g), self._into)
        return layout.check(layout.take(back, "the backward form of the step")[0], "the backward form of the step")

    def gradients(self):
        """What has been added up for params."""
        if not self._p:
            return [None] * len(self.p)
        found = self.run.params.take(self._into, "the backward form of the step")[0]
        return [np.asarray(value)[()] for value in found]
