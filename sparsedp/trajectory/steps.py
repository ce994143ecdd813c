"""The steps of a run, forward on plain values or on a tape, and backward along the tape."""

from contextlib import contextmanager

import numpy as np

from sparsedp.constants import constant
from sparsedp.derivative import zero_like
from sparsedp.direction import pull_ends
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.fields import frozen
from sparsedp.tape import Rule, fit, plain
from sparsedp.traces import inside, new_box, reverse_root, split_box
from sparsedp.trajectory.layout import NOTHING, fingerprint, owned
from sparsedp.trajectory.pieces import Piece
from sparsedp.tree import copied, flatten, leaves

__all__ = ["Steps", "carries"]


_REMEDY = {
    "state": "return another dict or list",
    "params": "make what changes a part of the state",
    "inputs": "make what changes a part of the state",
}


class Steps:
    """The steps of a run: plain going forward, on tapes going backward.

    Parameters
    ----------
    run : Run
    args : tuple of plain arrays
        Variables of state, params and inputs.
    wanted : set of int
        Which of them want a cotangent.
    """

    def __init__(self, run, args, wanted=()):
        self.run = run
        _, self.p, self.x = run.split(args)
        self.plain = run.inputs is None and carries(run.step)
        self._frozen, self._statics = [frozen(value) for value in self.p], run.params.statics
        self.params = run.params.build(self._frozen, self._statics)
        self._given = leaves(self.params)
        self._last: tuple = ()
        self._open = any(layout is not None and layout.open for layout in (run.state, run.params, run.inputs))
        first, second = len(run.state.places), len(run.state.places) + len(self.p)
        self._p = [place for place in range(len(self.p)) if first + place in wanted]
        self._x = [place for place in range(len(self.x)) if second + place in wanted]
        self._none, self._no_inputs = [None] * len(self.p), [None] * len(self.x)
        self.recording = False  # whether tapes are kept
        self.gp: list = [None] * len(self.p)
        self.gx: list = [np.zeros_like(x) if place in self._x else None for place, x in enumerate(self.x)]

    # ------------------------------------------------------------ forward

    def forward(self, i, values, statics):
        """Variables and statics of state i -> those of state i + 1."""
        run = self.run
        if run.silenced:
            values = self._silenced(i, values)
        self._last = i, values, statics
        if run.state.bare:
            result = self._moved(frozen(values[0]), *run.input_at(i, self.x))
            if run.state.is_one(result):
                return [result], statics
        else:
            state = run.state.build([frozen(value) for value in values], statics)
            result = self._moved(state, *run.input_at(i, self.x))
        values, statics = run.state.take(result, "the step")
        return run.state.check(values, "the step"), constant(statics)

    def taped(self, i, values, statics, want_state, goes_on=None):
        """State i and the steps from there on a tape -> (Piece, variables and statics of the last state).

        `goes_on`: asked with the number, the variables and statics of every new state, and whether its numbers are
        those on the tape (not rounded, not made contiguous), whether another step follows on the same tape; default:
        none does.
        """
        run = self.run
        if run.silenced:
            values = self._silenced(i, values)
        roots = [reverse_root() if want_state else None for _ in values]
        piece = Piece(i, roots, statics)

        def steps(number):
            state, others = boxed([frozen(value) for value in values], roots, number), statics
            while True:
                found, others = self._next(piece, state, others, number)
                pairs = [split_box(value, number) for value in found]
                new = run.state.check([value for value, _ in pairs], "the step")
                piece.ends = [node for _, node in pairs]
                same = all(value is known for (value, _), known in zip(pairs, new, strict=True))
                if not (goes_on and goes_on(piece.stop, new, others, same)):
                    return new, others
                state = [value if node else frozen(owned(known)) for value, (known, node) in zip(found, pairs)]

        (values, statics), _ = inside(steps)
        return piece, values, statics

    def _next(self, piece, state, statics, number):
        """One more step of a piece, from traced variables: those of its result, and its statics."""
        run, i, params, inputs, x = self.run, piece.stop, self._frozen, (), self._no_inputs
        self._last = i, state, statics
        p = [reverse_root() if place in self._p else None for place in range(len(self.p))] if self._p else self._none
        if run.inputs is not None:
            x = [reverse_root() if place in self._x else None for place in range(len(self.x))]
            inputs = run.input_at(i, self.x, lambda rows: boxed(rows, x, number))
        piece.params.append(p)
        piece.inputs.append(x)
        if self._p:
            params = boxed(params, p, number)
        if self.plain:
            self._others = statics
            found = plain_step(self, *state, *params)
            return ([found] if len(state) == 1 else [found[k] for k in range(len(state))]), self._others
        tree = run.params.build(params, self._statics) if self._p else self.params
        found, others = run.state.take(self._applied(run.state.build(state, statics), tree, *inputs), "the step")
        return found, others if others is NOTHING else constant(others)

    def _moved(self, state, *inputs):
        """A step of plain values."""
        return self.run.step.forward(state, self.params) if self.plain else self._applied(state, self.params, *inputs)

    def moved(self, values):
        """Variables of a state, whose other leaves stand in `_others` -> those of the next, by the step's own form."""
        layout, self.before = self.run.state, self._others
        result = self._moved(layout.build([frozen(value) for value in values], self._others))
        values, others = layout.take(result, "the step")
        self._others = constant(others)
        return layout.check(values, "the step")

    def taken(self, tree):
        """A state that the step made -> its variables."""
        return self.run.state.check(self.run.state.take(tree, "the step")[0], "the step")

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
        run, values = self.run, [plain(value) for value in values]
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
        state = self.run.state.build([frozen(plain(value)) for value in values], statics)
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

    # ------------------------------------------------------------ backward

    def pull(self, piece, values, g):
        """Cotangents of the last state of a piece -> those of its first; those of params and inputs are added up.

        `values`: the variables of the first state.
        """
        self._last = piece.first, values, piece.statics
        pairs = [(node, slope) for node, slope in zip(piece.ends, g, strict=True) if node and slope is not None]
        backs = iter(pull_ends([node for node, _ in pairs], [slope for _, slope in pairs], piece.roots))
        state = [fitted(next(backs), value) if root else None for root, value in zip(piece.state, values, strict=True)]
        lines = [[[next(backs) if root else None for root in line] for line in pair] for pair in piece.steps]
        for i, (p, x) in reversed(list(enumerate(lines, piece.first))):
            for place, back in enumerate(p):
                if back is not None:
                    self._add(place, back)
            for place, back in enumerate(x):
                if back is not None:
                    self.gx[place][i] = back
        return state if any(piece.state) else None

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


# ---------------------------------------------------------------- steps with a backward form of their own


def carries(step):
    """Whether a step has plain forms of its own: one node on the tape, whatever it is made of.

    It has, beside its call,

        step.forward(state, params) -> state
        step.backward(state, params, g) -> (g_state, g_params)

    both on plain trees. Linear steppers, nonlinear implicit ones of one stage, and flow_step do. Where `step.sparing`
    is true, backward also takes `new`, the result of the step when it is one array, and `wanted`, whether params want
    a cotangent. Where `step.solves` is true, it takes `met`: a function to be called with the result that it finds
    again, which refuses another one than before.
    """
    return callable(getattr(step, "forward", None)) and callable(getattr(step, "backward", None))


def _plain_forward(steps, *values):
    found = steps.moved(values[: len(steps.run.state.places)])
    if steps.recording:  # the step may use these arrays again
        found = list(map(owned, found))
    return found[0] if len(found) == 1 else tuple(found)


def _plain_vjp(nums, ans, steps, *values):
    run, many, wanted = steps.run, len(steps.run.state.places), max(nums) > len(steps.run.state.places)
    state = run.state.build([frozen(value) for value in values[:many]], steps.before)
    more = {}  # what is not used is not held
    if getattr(run.step, "sparing", False):
        more = {"new": plain(ans) if run.state.bare else None, "wanted": wanted}
    if getattr(run.step, "solves", False):
        ends = [plain(ans)] if many == 1 else list(plain(ans))
        more["met"] = lambda result: run.compare(*(fingerprint(found) for found in (steps.taken(result), ends)))

    def pull(g):
        slopes = run.state.build([g] if many == 1 else [g[k] for k in range(many)])
        of_state, of_params = run.step.backward(state, steps.params, slopes, **more)
        what = "the backward form of the step"
        backs = run.state.check(run.state.take(of_state, what)[0], what)
        if wanted:
            found = [None] * len(steps.p) if of_params is None else run.params.take(of_params, what)[0]
            backs += [np.zeros_like(p) if back is None else back for back, p in zip(found, steps.p, strict=True)]
        return tuple(backs[num - 1] for num in nums)

    return pull


plain_step = Rule("the step", _plain_forward, _plain_vjp)


def _refuses_writing(error):
    return "read-only" in str(error) or "readonly" in str(error)


def _same(found, given):
    return len(found) == len(given) and all(a is b for a, b in zip(found, given, strict=True))


def boxed(values, roots, number):
    """Values -> the same, those with a root on the trace of this number."""
    return [x if root is None else new_box(x, number, root) for x, root in zip(values, roots, strict=True)]


def fitted(back, value):
    """A cotangent in the dtype of its value; None where there is none."""
    if back is None:
        return None
    if type(back) is type(value) and type(back) is not float and (back.dtype, back.shape) == (value.dtype, value.shape):
        return back
    return fit("the step", value, back, back)
