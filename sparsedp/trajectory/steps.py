"""One step, forward on plain values and backward on a tape of its own."""

from contextlib import contextmanager

import numpy as np

from sparsedp.constants import constant
from sparsedp.direction import pull_ends, zero_like
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.fields import frozen
from sparsedp.tape import fit
from sparsedp.traces import inside, new_box, reverse_root, split_box
from sparsedp.trajectory.layout import fingerprint, owned
from sparsedp.tree import copied, flatten, leaves

__all__ = ["Taped", "boxed", "fitted"]


_REMEDY = {
    "state": "return another dict or list",
    "params": "make what changes a part of the state",
    "inputs": "make what changes a part of the state",
}


class Taped:
    """A step that is a plain function: run as it is going forward, put on a tape of its own going backward.

    Parameters
    ----------
    run : Run
    args : tuple of plain arrays
        Variables of state, params and inputs.
    wanted : set of int
        Which of them want a cotangent.
    """

    known = None  # going back: variables of the state after this step, where every state is kept
    after = None  # its fingerprint
    called = True  # the states are those that the call of the step makes, bit by bit

    def __init__(self, run, args, wanted=(), recording=False):
        self.run, self.recording = run, recording
        _, self.p, self.x = run.split(args)
        self._frozen, self._statics = [frozen(value) for value in self.p], run.params.statics
        self.params = run.params.build(self._frozen, self._statics)
        self._given = leaves(self.params)
        self._last: tuple = ()
        self._open = any(layout is not None and layout.open for layout in (run.state, run.params, run.inputs))
        self.wanted = frozenset(wanted)
        first, second = len(run.state.places), len(run.state.places) + len(self.p)
        self._p = [place for place in range(len(self.p)) if first + place in wanted]
        self._x = [place for place in range(len(self.x)) if second + place in wanted]
        self.gp: list = [None] * len(self.p)
        self.gx: list = [np.zeros_like(x) if place in self._x else None for place, x in enumerate(self.x)]
        self._roots: dict = {}

    # ------------------------------------------------------------ forward

    def link(self, state, statics):
        """Steps that are run in one piece: (how many, the state after them, the states before each of them)."""
        return 0, state, []

    def linked(self):
        """How many steps, from the first on, `unlink` goes back through in one piece."""
        return 0

    def forward(self, i, values, statics, room=None):
        """Variables and statics of state i -> those of state i + 1. `room` is for steps that can use it."""
        run = self.run
        if run.silenced:
            values = self._silenced(i, values)
        self._last = i, values, statics
        if self.recording and run.tapes.fit:
            return self._recorded(i, values, statics)
        if run.state.bare:
            result = self._applied(frozen(values[0]), self.params, *run.input_at(i, self.x))
            if run.state.is_one(result):
                return [result], statics
        else:
            state = run.state.build([frozen(value) for value in values], statics)
            result = self._applied(state, self.params, *run.input_at(i, self.x))
        values, statics = run.state.take(result, "the step")
        return run.state.check(values, "the step"), constant(statics)

    def _silenced(self, i, values):
        """A dual run has no tangents where the derivative is cut."""
        if not self.run.is_cut(i):
            return values
        return [zero_like(value) if number in self.run.silenced else value for number, value in enumerate(values)]

    @contextmanager
    def guarded(self, way="in step"):
        """Say in which step an error arose; turn NumPy's refusal to write into an argument into one that names it."""
        try:
            yield
        except (ConvergenceError, NonFiniteError, UnstableStepError) as error:
            if self._last:
                error.args = f"{way} {self._last[0]} of rollout: {error}", *error.args[1:]
            raise
        except (ValueError, TypeError) as error:
            if not _refuses_writing(error) and not self._writes():
                raise
            raise ValueError(
                f"{self._culprit()} in place; write u = u + du instead of u += du, or work on a copy"
            ) from (error if _refuses_writing(error) else None)

    def _culprit(self):
        """Which array the step writes into: the one that stops it when all others may be written."""
        if not self._last:
            return "keep changes the state"
        i, values, statics = self._last
        run = self.run
        parts = [run.state.build(values, statics), self.params, *run.input_at(i, self.x)]
        found, rebuild = flatten(parts)
        layouts = [run.state, run.params, run.inputs][: len(parts)]
        for number, name in enumerate(label for layout in layouts for label in layout.labels):
            if isinstance(found[number], np.ndarray):
                copies = copied(found)
                copies[number].flags.writeable = False
                try:
                    run.step(*rebuild(copies))
                except (ValueError, TypeError):
                    return f"the step changes {name}"
        return "keep changes the state"

    def _writes(self):
        """Whether the step, on plain values, writes into an argument: a traced value stops it with other words."""
        if not self._last:
            return False
        i, values, statics = self._last
        state = self.run.state.build([frozen(value) for value in values], statics)
        try:
            self.run.step(state, self.params, *self.run.input_at(i, self.x))
        except Exception as error:
            return _refuses_writing(error)
        return False

    def _applied(self, *parts):
        """The step; refused if it changes the dicts and lists it is given, which a tape would not see."""
        if not self._open:
            return self.run.step(*parts)
        given = [leaves(part) for part in parts]
        result = self.run.step(*parts)
        for name, part, before in zip(("state", "params", "inputs"), parts, given, strict=False):
            if not _same(leaves(part), before):
                raise ValueError(f"the step changes the entries of {name}; {_REMEDY[name]}")
        return result

    def check_params(self):
        """Refuse a step that puts other things into the dicts and lists of params."""
        if not _same(leaves(self.params), self._given):
            raise ValueError(f"the step changes the entries of params; {_REMEDY['params']}")

    def store(self, values):
        """A copy that nobody else can write into."""
        return [owned(value) for value in values]

    def release(self, values):
        """The state is not needed any more."""

    def trim(self):
        """As many states are kept as may be: let go of arrays that nothing is in."""

    # ------------------------------------------------------------ backward

    def backward(self, i, values, statics, g, want_state):
        """Cotangents of state i + 1 -> those of state i; those of params and inputs are added up."""
        run = self.run
        if run.silenced:
            values = self._silenced(i, values)
        self._last = i, values, statics
        ends = run.tapes and run.tapes.take(i, self.wanted)
        if not ends:
            pairs, roots, others = self._taped(i, values, statics, want_state)
            run.compare(fingerprint(run.state.check([value for value, _ in pairs], "the step"), others), self.after)
            ends = [node for _, node in pairs], roots
            del pairs  # the result itself is not needed any more
        nodes, slopes = [], []
        for node, slope in zip(ends[0], g, strict=True):
            if node is not None and slope is not None:
                nodes.append(node)
                slopes.append(slope)
        return self._sorted(i, values, pull_ends(nodes, slopes, ends[1]), want_state)

    def _taped(self, i, values, statics, want_state, weighed=False):
        """A step on a tape of its own: (value, node) of each variable, the roots, the other leaves."""
        run = self.run
        if (want_state, weighed) not in self._roots:
            self._roots[want_state, weighed] = self._plan_roots(want_state, weighed)
        state, p, x, roots = self._roots[want_state, weighed]

        def step(number):
            tree = run.state.build(boxed([frozen(value) for value in values], state, number), statics)
            params = run.params.build(boxed(self._frozen, p, number), self._statics) if self._p else self.params
            if run.inputs is None:
                return self._applied(tree, params)
            return self._applied(tree, params, *run.input_at(i, self.x, lambda rows: boxed(rows, x, number)))

        result, number = inside(step)
        ends, others = run.state.take(result, "the step")
        return [split_box(end, number) for end in ends], roots, others

    def _recorded(self, i, values, statics):
        """The same as `forward`, on a tape that is kept for the way back."""
        run, before = self.run, self.run.tapes.bytes
        pairs, roots, statics = self._taped(i, values, statics, run.wants(i, self.wanted), run.tapes.weighs(i))
        run.tapes.keep(i, ([node for _, node in pairs], roots), before)
        return run.state.check([value for value, _ in pairs], "the step"), constant(statics)

    def _plan_roots(self, want_state, weighed):
        """A root for each variable that is traced, else None. They hold nothing: every step uses them again."""
        root = self.run.tapes.root if weighed else reverse_root
        state = [root() if want_state else None for _ in self.run.state.places]
        p = [root() if place in self._p else None for place in range(len(self.p))]
        x = [root() if place in self._x else None for place in range(len(self.x))]
        return state, p, x, [root for root in (*state, *p, *x) if root is not None]

    def _sorted(self, i, values, backs, want_state):
        split = len(values) if want_state else 0
        for place, back in zip(self._p, backs[split:], strict=False):
            if back is not None:
                self._add(place, back)
        for place, back in zip(self._x, backs[split + len(self._p) :], strict=True):
            if back is not None:
                self.gx[place][i] = back
        if not want_state:
            return None
        return [back if back is None else fitted(back, value) for back, value in zip(backs, values, strict=False)]

    def _add(self, place, back):
        back, total = fitted(back, self.p[place]), self.gp[place]
        if total is None:
            self.gp[place] = owned(back)
        elif type(total) is np.ndarray:
            np.add(total, back, out=total)
        else:
            self.gp[place] = total + back

    def gradients(self):
        """What has been added up for params and inputs."""
        return [*self.gp, *self.gx]


def _refuses_writing(error):
    return "read-only" in str(error) or "readonly" in str(error)


def _same(found, given):
    return len(found) == len(given) and all(a is b for a, b in zip(found, given, strict=True))


def boxed(values, roots, number):
    """Values -> the same, those with a root on the trace of this number."""
    return [x if root is None else new_box(x, number, root) for x, root in zip(values, roots, strict=True)]


def fitted(back, value):
    """A cotangent in the dtype of its value."""
    if type(back) is type(value) and type(back) is not float and (back.dtype, back.shape) == (value.dtype, value.shape):
        return back
    return fit("the step", value, back, back)
