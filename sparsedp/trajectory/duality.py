"""The dual of a run: its step carries a tangent beside every state."""

import numpy as np

from sparsedp.derivative import zero_like
from sparsedp.direction import push
from sparsedp.tape import is_variable
from sparsedp.trajectory.carried import carries
from sparsedp.trajectory.keep import Each, marked
from sparsedp.trajectory.layout import Layout
from sparsedp.tree import leaves

__all__ = ["dual"]


def dual(run, args, moving):
    """A run and the numbers of the arguments that move -> its dual, and a function that arranges its arguments.

    Every state variable of the dual has a tangent; params and inputs have one where they move.

    Returns
    -------
    twin : Run
        Its outputs are the tangents of those of `run`; `twin.place_of[k]` is the place of argument k.
    arrange : callable
        ``arrange(args, tangents) -> arguments of the dual``, the tangents in the order of `moving`.
    """
    first = len(run.state.places)
    second = first + len(run.params.places)
    p = [number for number in moving if first <= number < second]
    x = [number for number in moving if number >= second]
    step = DualStep(run, [number - first for number in p], [number - second for number in x])
    names = "the dual state", "params", "inputs"
    parts = zip(run.layouts, (range(first), step.p, step.x), names, strict=False)
    layouts = [Layout(step.joined(layout, places), name) for layout, places, name in parts]
    twin = type(run)(step, layouts, run.n, _keep(run.keep, layouts[0], step), run.budget, run.truncate)
    twin.origin = run
    twin.silenced = (*run.silenced, *range(first, 2 * first))
    twin.place_of = {k: k + first * (k >= first) + len(p) * (k >= second) for k in range(len(args))}

    def arrange(args, tangents):
        moved = dict(zip(moving, tangents, strict=True))
        ds = [moved[k] if k in moved else zero_like(args[k]) for k in range(first)]
        return [
            *args[:first],
            *ds,
            *args[first:second],
            *(moved[k] for k in p),
            *args[second:],
            *(moved[k] for k in x),
        ]

    return twin, arrange


def _keep(keep, layout, step):
    """Hand out the tangents of what the run hands out."""
    if isinstance(keep, Each):
        return Each(layout, step.of_keep(keep.function))
    many = len(layout.places) // 2
    start, stop, _ = keep.shown.indices(many)
    return type(keep)(layout, slice(many + start, many + stop))


class DualStep:
    """step(state, params) -> the same of pairs (tree, list of tangents).

    Parameters
    ----------
    run : Run
    p, x : lists of int
        Which variables of params and inputs have a tangent.
    """

    def __init__(self, run, p, x):
        self.run, self.p, self.x = run, p, x

    @staticmethod
    def joined(layout, places):
        """An example of the pair, without memory of its own."""
        kinds = zip(layout.shapes, layout.dtypes, layout.floats, strict=True)
        examples = [0.0 if bare else np.broadcast_to(dtype.type(0), shape)[()] for shape, dtype, bare in kinds]
        return layout.build(examples), tuple(examples[place] for place in places)

    def __call__(self, *pairs):
        run = self.run
        chosen = [range(len(run.state.places)), self.p, self.x]
        directions = []
        for layout, (_, tangents), places in zip(run.layouts, pairs, chosen, strict=False):
            spread = [None] * len(layout.places)
            for place, tangent in zip(places, tangents, strict=True):
                spread[place] = tangent
            directions += layout.spread(spread)
        value, tangent = push(lambda parts: run.step(*parts), [tree for tree, _ in pairs], directions)
        return value, tuple(run.state.take(tangent, "the step")[0])

    def of_keep(self, function):
        """What keep makes of a state -> the tangents of it."""
        run = self.run

        def tangents(i, pair):
            state, directions = pair
            value, slopes = push(lambda tree: function(i, tree), state, run.state.spread(directions))
            if not carries(run.step):
                run.keep.compare(i, [marked(leaf) for leaf in leaves(value) if is_variable(leaf)])
            return [slope for slope in leaves(slopes) if slope is not None]

        return tangents
