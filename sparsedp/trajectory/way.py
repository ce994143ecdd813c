"""The way back over all steps of a run."""

from sparsedp.errors import DerivativeError
from sparsedp.ledger import active, count
from sparsedp.trajectory.layout import fingerprint
from sparsedp.trajectory.progress import shown_steps
from sparsedp.trajectory.record import LIMIT, Growth
from sparsedp.trajectory.schedule import stride

__all__ = ["Way"]


class Way:
    """One way back over all steps.

    Parameters
    ----------
    run : Run
    engine : Taped or Protocol
    want_state : bool
        Whether the first state wants a cotangent.
    """

    def __init__(self, run, engine, want_state):
        self.run, self.engine, self.want_state = run, engine, want_state
        self.stack, self.final, self.before, self.after = run.take_kept()
        self.recomputed = 0

    def back(self, g):
        """Cotangents of the outputs -> cotangents of the first state; the rest is added up in the engine."""
        run = self.run
        growth, many = Growth(run.n, run.truncate), len(self.stack)
        source = run.keep.source(run.n, g)
        total = source(run.n, *self.final)
        if run.slots is not None:
            self.final = ()  # not needed any more
        growth.see(run.n, total)
        linked = self.engine.linked()
        for i in shown_steps(run.progress, range(run.n - 1, linked - 1, -1), "backward"):
            if total is None and not run.keep.along:
                break  # cut by truncation
            total = self._step(i, total, source, growth)
        if linked and total is not None:
            total = self._unlinked(linked, total, source, growth)
        if active:
            count("rollout.step", "vjp", run.n)
            count("rollout.step", "recomputed", self.recomputed)
        if run.record is not None:
            run.record(growth.record(many, self.recomputed))
        elif growth.grown() > LIMIT:
            growth.record(many, self.recomputed)
        return total

    def _unlinked(self, linked, total, source, growth):
        """Through the steps of one piece; where that fails, step by step, so that `guarded` can name the step."""
        try:
            return self.engine.unlink(total, self.stack, growth)
        except DerivativeError:
            raise
        except Exception:
            for i in range(linked - 1, -1, -1):
                total = self._step(i, total, source, growth)
            raise

    def _step(self, i, total, source, growth):
        run = self.run
        values, statics = self._state_at(i)
        before = self.before.pop(i + 1, None)
        mark = fingerprint(values, statics) if before or self.engine.called else None
        if before:
            run.compare(mark, before)
        wants = not run.is_cut(i) if i else self.want_state
        if total is not None:
            self.engine.known, self.engine.after = self._known(i + 1), self.after
            if run.slots == len(self.stack):
                self.engine.trim()
            total = self.engine.backward(i, values, statics, total, wants)
            if i % growth.every == 0:
                growth.see(i, total)
        if run.keep.along and (i > 0 or self.want_state):
            total = _sum(total, source(i, values, statics))
        if run.slots is not None and i:
            self.engine.release(values)
        self.after = mark
        return total

    def _known(self, i):
        """Variables of state i where every state is kept."""
        if self.run.slots is not None:
            return None
        return self.stack[i][1] if i < len(self.stack) else self.final[0]

    def _state_at(self, i):
        """State i, from the nearest kept state; states on the way are kept by the binomial rule."""
        run, stack = self.run, self.stack
        if run.slots is None:
            return stack[i][1:]
        start, values, statics = stack[-1]
        while start < i:
            free = run.slots - len(stack) + 1
            stop = start + (stride(i + 1 - start, free) if free > 1 else i - start)
            values, statics = self._again(start, stop, values, statics)
            start = stop
            if start < i:
                values = self.engine.store(values)
                stack.append((start, values, statics))
        if stack[-1][0] == i:
            stack.pop()
        return values, statics

    def _again(self, start, stop, values, statics):
        """Run from a kept state on."""
        self.recomputed += stop - start
        for k in range(start, stop):
            before = values
            if k == stop - 1 > start:
                self.before[stop] = fingerprint(values, statics)
            values, statics = self.engine.forward(k, values, statics)
            if k > start:
                self.engine.release(before)
        return values, statics


def _sum(total, entering):
    """Two lists of cotangents, or None, added leaf by leaf."""
    if total is None or entering is None:
        return entering if total is None else total
    return [b if a is None else a if b is None else a + b for a, b in zip(total, entering, strict=True)]
