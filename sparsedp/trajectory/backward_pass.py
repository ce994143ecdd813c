"""The backward pass over all steps of a run."""

from sparsedp.errors import DerivativeError
from sparsedp.ledger import active, count
from sparsedp.trajectory.layout import fingerprint, owned
from sparsedp.trajectory.progress import shown_steps
from sparsedp.trajectory.record import LIMIT, Growth
from sparsedp.trajectory.schedule import stride

__all__ = ["BackwardPass"]


class BackwardPass:
    """One backward pass over all steps.

    Parameters
    ----------
    run : Run
    steps : Steps
    wanted : frozenset of int
        The arguments that want a cotangent.
    """

    def __init__(self, run, steps, wanted):
        self.run, self.steps, self.want_state = run, steps, run.wants(0, wanted)
        self.stack, self.final, self.before, self.after, self.pieces = run.take_kept(wanted)
        self.recomputed = 0

    def back(self, g):
        """Cotangents of the outputs -> cotangents of the first state; the rest is added up in `steps`."""
        run = self.run
        growth, many = Growth(run.n, run.truncate), len(self.stack)
        source = run.keep.source(run.n, g)
        total = source(run.n, *self.final)
        if run.slots is not None:
            self.final = ()  # not needed any more
        growth.see(run.n, total)
        i = run.n
        for k in shown_steps(run.progress, range(run.n - 1, -1, -1), "backward"):
            if k >= i:
                continue  # part of a piece that has been gone through
            if total is None and not run.keep.along:
                break  # cut by truncation
            i, total = self._through(i, total)
            if i % growth.every == 0:
                growth.see(i, total)
            if run.keep.along and (i > 0 or self.want_state):
                total = _sum(total, source(i, *self.state[1:]))
        if active:
            count("rollout.step", "vjp", run.n)
            count("rollout.step", "recomputed", self.recomputed)
        if run.record is not None:
            run.record(growth.record(many, self.recomputed))
        elif growth.grown() > LIMIT:
            growth.record(many, self.recomputed)
        return total

    def _through(self, i, total):
        """Back from state i through one piece: the number of the state it starts from, and its cotangents."""
        run = self.run
        piece = self.pieces.pop() if self.pieces and self.pieces[-1].stop == i else None
        first = piece.first if piece else i - 1
        self.state = first, *self._state_at(first)
        before, kept = self.before.pop(i, None), bool(self.pieces) and self.pieces[-1].stop == first
        mark = fingerprint(*self.state[1:]) if before or not kept else None  # what is on a tape is not run again
        if before:
            run.compare(mark, before)
        if total is not None:
            if piece is None:
                wants = run.wants(first, ()) if first else self.want_state
                piece, values, statics = self.steps.taped(*self.state, wants)
                run.compare(fingerprint(values, statics), self.after)
                del values
            total = self._pulled(piece, total)
        self.after = mark
        return first, total

    def _pulled(self, piece, total):
        """Through a piece; where that fails, step by step, so that `guarded` can name the step."""
        try:
            return self.steps.pull(piece, self.state[1], total)
        except DerivativeError:
            raise
        except Exception:
            if piece.stop - piece.first == 1:
                raise
            states = [self.state[1:]]
            for i in range(piece.first, piece.stop - 1):
                values, statics = self.steps.forward(i, *states[-1])
                states.append((list(map(owned, values)), statics))
            for i in range(piece.stop - 1, piece.first - 1, -1):
                values, statics = states.pop()
                one, _, _ = self.steps.taped(i, values, statics, True)
                total = self.steps.pull(one, values, total)
            raise

    def _state_at(self, i):
        """State i, from the nearest kept state; states on the way are kept by the binomial rule."""
        run, stack = self.run, self.stack
        if run.slots is None:
            return stack[i][1:]
        while stack[-1][0] > i:  # those of a piece are gone through at once
            stack.pop()
        start, values, statics = stack[-1]
        while start < i:
            free = run.slots - len(stack) + 1
            stop = start + (stride(i + 1 - start, free) if free > 1 else i - start)
            values, statics = self._again(start, stop, values, statics)
            start = stop
            if start < i:
                stack.append((start, values, statics))
        if stack[-1][0] == i:
            stack.pop()
        return values, statics

    def _again(self, start, stop, values, statics):
        """Run from a kept state on."""
        self.recomputed += stop - start
        for k in range(start, stop):
            if k == stop - 1 > start:
                self.before[stop] = fingerprint(values, statics)
            values, statics = self.steps.forward(k, values, statics)
        return list(map(owned, values)), statics  # the last one may be an array that the step uses again


def _sum(total, entering):
    """Two lists of cotangents, or None, added leaf by leaf."""
    if total is None or entering is None:
        return entering if total is None else total
    return [b if a is None else a if b is None else a + b for a, b in zip(total, entering, strict=True)]
