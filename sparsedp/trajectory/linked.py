"""Neighbouring steps on one tape: what a step of few numbers costs beside its own calls.

The tape of a step ends where that of the next one begins, so a piece of many steps is run, and gone back through, as
a whole. Each step has roots of its own for params, whose cotangents are added up in the order of single steps: the
bits are the same. A piece ends where the cotangent is looked at, and before and after a step that is weighed.
"""

from typing import Any, NamedTuple

from sparsedp.fields import frozen
from sparsedp.traces import backward, inside, new_box, reverse_root, split_box
from sparsedp.trajectory.layout import owned
from sparsedp.trajectory.record import looked_at
from sparsedp.trajectory.steps import Taped, boxed, fitted

__all__ = ["Linked"]


HELD = 2**16  # bytes of cotangents of params that may wait until a piece has been gone through


class Piece(NamedTuple):
    """Some steps on one tape."""

    first: int
    stop: int
    root: Any  # of the state at its start, or None
    params: list  # for each step the roots of all params, None where a constant is
    end: Any  # the node of the state at its end, or None


class Linked(Taped):
    """A step from one array to one array, without inputs, for as long as its tapes may be kept."""

    def link(self, state, statics):
        """Run as many steps as can be linked: (how many, the state after them, the states before each of them)."""
        if not self.recording:
            return super().link(state, statics)
        value, tapes, kept, first = state[0], self.run.tapes, [], 0  # type: Any, Any, list, int
        while first < self.run.n and tapes.fit and tapes.steps_left():
            before, weighed = tapes.bytes, tapes.weighs(first)
            piece, value = self._piece(first, self._stop(first, weighed), weighed, value, kept)
            for _ in range(first, piece.stop):
                tapes.add(weighed, before)
            tapes.pieces.append(piece)
            first = piece.stop
        return first, [value], [(i, [known], statics) for i, known in enumerate(kept)]

    def _stop(self, first, weighed):
        """Where a piece ends that begins at a state."""
        n, tapes = self.run.n, self.run.tapes
        if weighed:
            return first + 1
        every, held = looked_at(n), sum(self.p[place].nbytes for place in self._p)
        most = min(tapes.steps_left(), max(HELD // max(held, 1), 1))
        return min(n, first + most, tapes.next_weighed(first), (first // every + 1) * every)

    def _piece(self, first, stop, weighed, value, kept):
        """Steps on one tape, up to one whose result is rearranged, or of nothing that is asked for."""
        run, start = self.run, self.run.tapes.root if weighed else reverse_root
        root, params, ends = start() if run.wants(first, self.wanted) else None, [], [None]

        def steps(number, value=value):
            state = frozen(value) if root is None else new_box(frozen(value), number, root)
            for i in range(first, stop):
                p = [start() if place in self._p else None for place in range(len(self.p))]
                tree = run.params.build(boxed(self._frozen, p, number), self._statics) if self._p else self.params
                self._last = i, [value], run.state.statics
                state, before = self._applied(state, tree), value
                value, node = split_box(run.state.take(state, "the step")[0][0], number)
                kept.append(owned(before) if i else before)
                params.append(p)
                ends.append(node)
                if node is None or not run.state.is_one(value):
                    return run.state.check([value], "the step")[0]
            return value

        value, _ = inside(steps)
        return Piece(first, first + len(params), root, params, ends[-1]), value

    def linked(self):
        """How many steps from the first on are linked, for the cotangents that are wanted."""
        return self.run.tapes.linked(self.wanted) if self.run.tapes else 0

    def unlink(self, g, stack, growth):
        """Cotangents of the state at the end of the pieces -> those of the first state, and of params."""
        ((value,),) = stack[0][1:2]
        for piece in reversed(self.run.tapes.pieces):
            found = {} if g[0] is None or piece.end is None else backward(piece.end, g[0])
            for roots in reversed(piece.params):
                for place in self._p:
                    if (back := found.pop(roots[place], None)) is not None:
                        self._add(place, back)
            back = found.pop(piece.root, None)
            if piece.root is None:
                return None
            g = [None if back is None else fitted(back, value)]
            if piece.first % growth.every == 0:
                growth.see(piece.first, g)
        return g
