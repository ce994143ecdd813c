"""Steps with a backward form of their own: one node on the tape, whatever they are made of."""

import numpy as np

from sparsedp.fields import frozen
from sparsedp.tape import Rule, isbox, plain
from sparsedp.trajectory.layout import owned

__all__ = ["carries", "in_plain_forms"]


def carries(step):
    """Whether a step has plain forms of its own.

    It has, beside its call,

        step.forward(state, params) -> state
        step.backward(state, params, g) -> (g_state, g_params)

    both on plain trees. Steps of the library have one form only; these are for steps that users write: an adjoint of
    their own, or a simulator that brings one.
    """
    return callable(getattr(step, "forward", None)) and callable(getattr(step, "backward", None))


def in_plain_forms(loop):
    """The step of a loop that has plain forms of its own -> the same as a function that may be traced."""
    step, state, params, many = loop.step, loop.state, loop.params, len(loop.state.places)

    def taken(tree, what):
        """A state that the step made -> its variables, and its other leaves."""
        values, statics = state.take(tree, what)
        return state.check(values, what), statics

    def call(tree, given):
        (values, statics), (others, constants) = state.take(tree, "the step"), params.take(given, "the step")
        values, after = [*values, *others], []
        if not any(map(isbox, values)):
            return step.forward(tree, given)

        def parts(args):
            args = list(map(frozen, args))
            return state.build(args[:many], statics), params.build(args[many:], constants)

        def forward(*args):
            found, fixed = taken(step.forward(*parts(args)), "the step")
            after.extend(fixed)
            return _one(list(map(owned, found)))  # the step may use its arrays again

        def vjp(nums, ans, *args):
            def pull(g):
                what = "the backward form of the step"
                slopes = state.build([g] if many == 1 else [g[k] for k in range(many)])
                of_state, of_params = step.backward(*parts(args), slopes)
                backs = taken(of_state, what)[0]
                if max(nums) >= many:
                    rest = args[many:]
                    found = [None] * len(rest) if of_params is None else params.take(of_params, what)[0]
                    backs += [np.zeros_like(plain(p)) if b is None else b for b, p in zip(found, rest, strict=True)]
                return tuple(backs[num] for num in nums)

            return pull

        new = Rule("the step", forward, vjp)(*values)
        return state.build([new] if many == 1 else [new[k] for k in range(many)], after)

    return call


def _one(values):
    return values[0] if len(values) == 1 else tuple(values)
