"""The backward pass over all steps of a run."""

from bisect import bisect
from operator import length_hint

import numpy as np

from sparsedp.ledger import active, count
from sparsedp.tape import fit
from sparsedp.traces import accumulate
from sparsedp.trajectory.layout import fingerprint, refuse_lost
from sparsedp.trajectory.progress import shown_steps
from sparsedp.trajectory.record import LIMIT, Growth
from sparsedp.trajectory.schedule import stride

__all__ = ["BackwardPass"]

NONE = None, False  # no cotangent so far


class BackwardPass:
    """One backward pass over all steps.

    Parameters
    ----------
    run : Run
    steps : Steps
    kept : list of State
        The last one included.
    tapes : list of Tape
        Of the steps from the first one on.
    """

    def __init__(self, run, steps, kept, tapes):
        self.run, self.steps, self.kept, self.tapes = run, steps, kept, tapes
        self.recomputed = 0
        self.cotangents: dict = {}  # of params: root -> (sum so far, whether it may be written to)
        pairs = zip(steps.x, steps.wants_input, strict=True)
        self.inputs: list = [np.zeros_like(block) if root else None for block, root in pairs]

    def back(self, g):
        """Cotangents of the outputs -> those of all arguments, None where there is none."""
        run, steps, tapes = self.run, self.steps, self.tapes
        growth, many = Growth(run.n, run.truncate), len(self.kept) - 1
        source = run.keep.source(run.n, g)
        state = self.kept.pop()
        total = source(*state)
        growth.see(run.n, total)
        for i in shown_steps(run.progress, range(run.n - 1, -1, -1), "backward"):
            if total is None and not run.keep.along:
                break  # cut by truncation
            if tapes and tapes[-1].first < i < tapes[-1].stop:
                continue  # the steps of a tape are gone through at once
            tape = tapes.pop() if tapes and tapes[-1].first == i else None
            end = None if tape else fingerprint(*state[1:])  # what is on a tape is not run again
            state = self._state_at(i)
            if total is not None:
                if tape is None:
                    tape, after = steps.taped(state, run.wants(i, steps.trace.wanted))[:2]
                    run.compare(fingerprint(*after[1:]), end)
                    del after
                total = self._pull(tape, state, total)
            del tape
            if i % growth.every == 0:
                growth.see(i, total)
            if run.keep.along and (i > 0 or run.wants(0, steps.trace.wanted)):
                total = _sum(total, source(*state))
        if active:
            count("rollout.step", "vjp", run.n)
            count("rollout.step", "recomputed", self.recomputed)
        if run.record is not None:
            run.record(growth.record(many, self.recomputed))
        elif growth.grown() > LIMIT:
            growth.record(many, self.recomputed)
        given = zip(steps.p, (self.cotangents.get(root, NONE)[0] for root in steps.roots), strict=True)
        return [*(total or [None] * len(run.state.places)), *(_fitted(back, p) for p, back in given), *self.inputs]

    def _pull(self, tape, state, g):
        """Cotangents of the state after a tape -> those of the state before, None if those are not wanted."""
        cotangents, calls = self.cotangents, reversed(tape.nodes)
        for node, back in zip(tape.ends, g, strict=True):
            if node is not None and back is not None:
                known = cotangents.get(node)
                cotangents[node] = (back if known is None else known[0] + back), False
        try:
            accumulate(cotangents, calls)
        finally:  # in which step it stopped
            self.steps.last = state._replace(i=state.i + max(bisect(tape.starts, length_hint(calls)) - 1, 0))
        for i, roots in enumerate(tape.inputs, state.i):
            for total, root in zip(self.inputs, roots, strict=True):
                if root in cotangents:
                    total[i] = cotangents.pop(root)[0]
        backs = []
        for value, root in zip(state.values, tape.state, strict=True):
            backs.append(_fitted(cotangents.pop(root, NONE)[0], value))
        for root, (back, own) in cotangents.items():
            if root not in self.steps.roots:
                refuse_lost("the step")  # in a call of another step
            if not own and type(back) is np.ndarray:
                cotangents[root] = back.copy(), True
        return backs if any(tape.state) else None

    def _state_at(self, i):
        """State i, from the nearest kept state; states on the way are kept by the binomial rule."""
        run, kept = self.run, self.kept
        state = kept.pop()
        while state.i > i:
            state = kept.pop()
        while state.i < i:
            kept.append(state)
            free = max(run.slots - len(kept) + 1, 1)
            state = self._again(state, state.i + stride(i + 1 - state.i, free))
        return state

    def _again(self, state, stop):
        """Run from a kept state on."""
        self.recomputed += stop - state.i
        while state.i < stop:
            state = self.steps.forward(state)
        return state.owned()


def _fitted(back, value):
    """A cotangent in the dtype of its value; None where there is none."""
    return None if back is None else fit("the step", value, back, back)


def _sum(total, entering):
    """Two lists of cotangents, or None, added leaf by leaf."""
    if total is None or entering is None:
        return entering if total is None else total
    return [b if a is None else a if b is None else a + b for a, b in zip(total, entering, strict=True)]
