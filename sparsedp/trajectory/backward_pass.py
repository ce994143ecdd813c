"""The backward pass over all steps of a loop."""

from sparsedp.derivative import zero_like
from sparsedp.ledger import active, count
from sparsedp.progress import shown_steps
from sparsedp.tape import backward, fit
from sparsedp.trajectory.layout import refuse_lost, stacked
from sparsedp.trajectory.record import growth, largest
from sparsedp.trajectory.schedule import stride
from sparsedp.trajectory.steps import State

__all__ = ["BackwardPass"]

NONE = None, False  # no cotangent so far


class BackwardPass:
    """One backward pass over all steps.

    Parameters
    ----------
    loop : Loop
    steps : Steps
    kept : list of State
        The last one included.
    """

    def __init__(self, loop, steps, kept):
        self.loop, self.steps, self.kept = loop, steps, kept
        self.recomputed = 0
        self.sums: dict = {}  # of params: root -> (sum so far, whether it may be written to)
        self.known = set(steps.roots)
        pairs = zip(steps.x, steps.input_roots, strict=True)  # of inputs: for each row
        self.inputs = [list(zero_like(block)) if root else [] for block, root in pairs]

    def back(self, g):
        """Cotangents of the outputs -> those of all arguments, None where there is none."""
        loop, steps, n = self.loop, self.steps, self.loop.n
        source, along = loop.keep.source(n, g), loop.keep.along
        state = self.kept.pop()
        last = state if loop.reverse else None
        total = source(state)
        norms = [] if total is None else [(n, largest(total))]
        for i in shown_steps(loop.progress, range(n - 1, -1, -1), "backward"):
            if total is None and not along:
                break  # cut by truncation
            taped = self.kept and self.kept[-1].tape  # what is on a tape is not run again
            end = None if taped else state.marks()
            state = steps.back(state) if loop.reverse else self._state_at(i)
            if total is not None:
                if not taped:
                    state = State(i, state.values, state.statics)  # the tape goes with it
                    after = steps.after(state, True)
                    if not loop.reverse:
                        loop.compare(after.marks(), end)
                    del after
                total = self._pull(state, total)
                if not taped:
                    state.tape = None
            if i % loop.every == 0 and total is not None:  # before anything enters here
                norms.append((i, largest(total)))
            if along and i >= loop.moving:
                total = _sum(total, source(state))
        if loop.reverse and state.i == 0:
            steps.check_start(state, last)
        if active:
            count("rollout.step", "vjp", n)
            count("rollout.step", "recomputed", self.recomputed)
        record = growth(loop, norms, self.recomputed)
        if loop.record is not None:
            loop.record(record)
        params = [self.sums.get(root, NONE)[0] for root in steps.roots]
        inputs = [stacked(rows) if rows else None for rows in self.inputs]
        return [*(total or [None] * len(loop.state.places)), *_fitted(params, steps.p), *inputs]

    def _pull(self, state, g):
        """Cotangents of the state after one -> those of the state itself, None if those are not wanted."""
        sums, (roots, nodes, ends) = self.sums, state.tape
        self.steps.last = state
        backward(nodes, ends, g, sums)
        backs = [sums.pop(root, NONE)[0] for root in roots]
        for rows, back in zip(self.inputs, backs[len(state.values) :], strict=True):
            if back is not None:
                rows[state.i] = back
        if not sums.keys() <= self.known:
            refuse_lost("the step")  # in a call of another step
        return _fitted(backs, state.values) if roots[0] else None

    def _state_at(self, i):
        """State i, from the nearest kept state; states on the way are kept by the binomial rule."""
        loop, kept = self.loop, self.kept
        state = kept.pop()
        while state.i > i:
            state = kept.pop()
        while state.i < i:
            kept.append(state)
            free = max(loop.slots - len(kept) + 1, 1)
            stop = state.i + stride(i + 1 - state.i, free)
            self.recomputed += stop - state.i
            while state.i < stop:
                state = self.steps.after(state, False)
            state = state.owned()
        return state


def _fitted(backs, values):
    """Cotangents in the dtypes of their values; None where there is none."""
    pairs = zip(backs, values)
    return [None if back is None else fit("the step", value, back, back) for back, value in pairs]


def _sum(total, entering):
    """Two lists of cotangents, or None, added leaf by leaf."""
    if total is None or entering is None:
        return entering if total is None else total
    return [b if a is None else a if b is None else a + b for a, b in zip(total, entering, strict=True)]
