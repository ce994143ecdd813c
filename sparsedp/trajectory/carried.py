"""Steps with a backward form of their own: one node on the tape, whatever they are made of."""

import numpy as np

from sparsedp.fields import frozen
from sparsedp.tape import Rule, isbox, plain
from sparsedp.trajectory.layout import owned

__all__ = ["Carried", "carries"]


def carries(step):
    """Whether a step has plain forms of its own.

    It has, beside its call,

        step.forward(state, params) -> state
        step.backward(state, params, g) -> (g_state, g_params)

    both on plain trees. Steps of the library have one form only; these are for steps that users write: an adjoint of
    their own, or a simulator that brings one.
    """
    return callable(getattr(step, "forward", None)) and callable(getattr(step, "backward", None))


class Carried:
    """Such a step of a run, as a function that may be traced."""

    def __init__(self, run):
        self.run = run

    def __call__(self, state, params):
        """The next state."""
        values, statics = self.run.state.take(state, "the step")
        given, constants = self.run.params.take(params, "the step")
        if not any(map(isbox, values + given)):
            return self.run.step.forward(state, params)
        call = _Call(self.run, statics, constants)
        new = _carried_step(call, *values, *given)
        return self.run.state.build([new] if len(values) == 1 else [new[k] for k in range(len(values))], call.new)


class _Call:
    """What is not floating in one call, on plain values."""

    def __init__(self, run, statics, constants):
        self.run, self.statics, self.constants = run, statics, constants
        self.many = len(run.state.places)
        self.new: tuple = ()  # what is not floating in the next state

    def parts(self, values):
        """Variables -> state and params."""
        run, values = self.run, [frozen(value) for value in values]
        state = run.state.build(values[: self.many], self.statics)
        return state, run.params.build(values[self.many :], self.constants)

    def taken(self, tree, what="the step"):
        """A state that the step made -> its variables, and its other leaves."""
        values, statics = self.run.state.take(tree, what)
        return self.run.state.check(values, what), statics


def _forward(call, *values):
    found, call.new = call.taken(call.run.step.forward(*call.parts(values)))
    found = [owned(value) for value in found]  # the step may use its arrays again
    return found[0] if call.many == 1 else tuple(found)


def _vjp(nums, ans, call, *values):
    run, many, wanted = call.run, call.many, max(nums) > call.many
    state, params = call.parts(values)

    def pull(g):
        slopes = run.state.build([g] if many == 1 else [g[k] for k in range(many)])
        of_state, of_params = run.step.backward(state, params, slopes)
        what = "the backward form of the step"
        backs = call.taken(of_state, what)[0]
        if wanted:
            given = values[many:]
            found = [None] * len(given) if of_params is None else run.params.take(of_params, what)[0]
            backs += [np.zeros_like(plain(p)) if back is None else back for back, p in zip(found, given, strict=True)]
        return tuple(backs[num - 1] for num in nums)

    return pull


_carried_step = Rule("the step", _forward, _vjp)
