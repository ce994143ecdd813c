"""Nonlinear implicit steps in loops: going back, the end of a step is known, and nobody solves for it again.

The new state of backward_euler and crank_nicolson is the root x of F(x, u, p) = 0. A loop that keeps its states hands
it over; what is left of the step is one linear solve with J(x)^T (see `implicit`), on a tape of this step alone. Where
no state is handed over (under a budget) it is solved for again, from the same numbers: the same bits.
"""

import numpy as np

from sparsedp.direction import pull_ends
from sparsedp.integrators.steps import Step
from sparsedp.tape import fit, is_variable
from sparsedp.traces import reverse_root, split_box, trace
from sparsedp.tree import flatten, leaves

__all__ = ["NonlinearStep"]


class NonlinearStep(Step):
    """A Step of `Nonlinear` stages with plain forward and backward forms."""

    sparing = solves = True

    def forward(self, state, params):
        """The state after a step, of plain values."""
        return self(state, params)

    def backward(self, state, params, g, new=None, wanted=True, met=None):
        """Cotangents (of state, of params) of a step; plain. See LinearStep."""
        found, rebuild = flatten(state)
        roots = [reverse_root() if is_variable(leaf) else None for leaf in found]
        given, rebuild_params = flatten(params)
        others = [reverse_root() if wanted and is_variable(leaf) else None for leaf in given]
        with self.scheme.ending(new):
            result, number = trace(lambda both: self(*both), (state, params), roots + others)
        if met:
            ends, rebuild_end = flatten(result)
            met(rebuild_end([split_box(end, number)[0] for end in ends]))
        pairs = zip([split_box(end, number)[1] for end in leaves(result)], leaves(g), strict=True)
        nodes, slopes = zip(*((node, slope) for node, slope in pairs if node is not None), strict=True)
        backs = iter(pull_ends(list(nodes), list(slopes), [root for root in roots + others if root is not None]))
        of_state = rebuild([_cotangent(next(backs), leaf) if root else leaf for leaf, root in zip(found, roots)])
        of_params = [_cotangent(next(backs), leaf) if root else None for leaf, root in zip(given, others)]
        return of_state, rebuild_params(of_params) if wanted else None


def _cotangent(back, leaf):
    return np.zeros_like(leaf) if back is None else fit("the step", leaf, back, back)
