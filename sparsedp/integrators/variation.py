"""Derivatives over error-controlled steps: lengths that move with the solution, and a shadow that measures the error.

Where something fast happens at a time that depends on the parameters (a jump, an ignition), the derivative of the state
at a fixed time is its speed there times the derivative of that time: huge for a while, and small again when it is over.
Steps of fixed lengths lose what is left. So lengths move. With the speed f and the weights of the error norm, a half
step of length h from the state u gets h + d,

    d = -q <f, u - u*> / <f, f>,     q = a / (a + SLACK),     a = h |f|,

where u* is the same state as data: d is 0, and its derivative takes the state back to the plane through u* across the
flow. The sum of all d so far is given back, in proportion to the lengths, over a last stretch of the interval that is
as long as its speed allows. No choice of d changes what the derivative converges to.

The shadow takes the same states with the derivative of f + (w - e) (f - w), a little less extrapolated than the steps
that count (f two halves, w whole, see adaptive.py). Tangents start in both, and cotangents arrive from both; where they
meet, their difference is e times what extrapolation took away. The derivative is judged by it, and that of the steps
that count goes on. `spread` and `judge` are each other's transposes in this sense, so it holds in every mode and order.
What enters the shadow also gets errors of the size of the tolerance: where terms cancel so that they matter, the
derivative is refused, too.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import DerivativeError
from sparsedp.tape import Rule, cast, dtype_of, is_variable, isbox, linear, plain
from sparsedp.tree import flatten, leaves

__all__ = ["Variation"]

SLACK = 0.05  # relative change of the state in a half step that has it follow the flow by half
EPSILON = 1e-3  # share of the shadow
MOST = 6.0  # error of a derivative without extrapolation, in units of tolerance^(p / (p + 1)), that is taken
TIMES = 10.0  # error of a derivative in units of the tolerance: aim with extrapolation, limit without
SHARE = 1e-4  # of what goes in: derivatives that are smaller are judged by it


class Variation:
    """One interval, crossed again on a tape.

    Parameters
    ----------
    control : Adaptive
    path : list of (share of the interval, share done, state, state between the halves)
    given : (u, params, t, h)
        What the interval starts with, plain.
    new : tree
        The state at its end.
    """

    def __init__(self, control, path, given, new):
        self.control, self.path, self.given, self.new = control, path, given, new
        _, _, t, h = given
        spans = [(done * h, 0.5 * share * h) for share, done, _, _ in path]
        sections = []
        for (_, _, *states), (start, half) in zip(path, spans, strict=True):
            times = (None, None) if t is None else (t + start, t + start + half)
            sections.append([self._section(state, at, half) for state, at in zip(states, times, strict=True)])
        self.rows = [[row for row, _ in both] for both in sections]
        speeds = np.array([both[0][1] for both in sections])
        rest = h - np.array([start for start, _ in spans])
        later = np.maximum.accumulate(speeds[::-1])[::-1]
        self.turn = int(np.argmin(later + 1 / rest))  # from this step on the shift is given back
        self.rest = float(rest[self.turn])

    def _section(self, u, t, half):
        """The derivative of d for each array of the state, and the speed, as a share of the state's size by time."""
        rates = leaves(self.control.scheme.problem(u, self.given[1], t))
        sizes = [np.where(size > 0, size, np.inf) for size in self.control.sizes(u, u)]
        count = max(sum(size.size for size in sizes), 1)
        rows = [np.conj(rate) / size**2 / count for rate, size in zip(rates, sizes, strict=True)]
        square = float(sum(np.sum(np.real(row * rate)) for row, rate in zip(rows, rates, strict=True)))
        speed = np.sqrt(square)
        pace = speed * half / (speed * half + SLACK)
        return [-pace / square * row if square > 0 else 0.0 * row for row in rows], speed

    def follow(self, u, params, t, h):
        """The state after the interval, with a derivative that is judged."""
        found, rebuild = flatten((u, params, t, h))
        places = [place for place, leaf in enumerate(found) if isbox(leaf)]
        given = [found[place] for place in places]
        ends, rebuild_end = flatten(self.new)
        moving = [place for place, leaf in enumerate(ends) if is_variable(leaf)]
        start, end = self._doors([plain(leaf) for leaf in given], places, [ends[place] for place in moving])
        both, arrived = start(_packed(given)), []
        for number in (0, 1):
            for place, part in zip(places, _unpacked(both[number], given), strict=True):
                found[place] = part
            u, params, t, h = rebuild(found)
            new = leaves(self._run(u, params, t, h, EPSILON * number))
            arrived.append(_packed([new[place] for place in moving]))
        judged = end(anp.reshape(anp.concatenate(arrived), (2, -1)))
        for place, part in zip(moving, _unpacked(judged, [ends[place] for place in moving]), strict=True):
            ends[place] = part
        return rebuild_end(ends)

    def _run(self, u, params, t, h, share):
        """The steps that were taken; the new state of each has the value that is known."""
        scheme, joined, weight = self.control.scheme, self.control.joined, self.control.weight
        states = [u for _, _, u, _ in self.path[1:]] + [self.new]
        shift = back = 0.0
        for number, ((part, done, *known), new) in enumerate(zip(self.path, states, strict=True)):
            half = 0.5 * part * h
            if number == self.turn:
                back = shift / self.rest
            bend = self._bend(number, 0, u, back, half)
            at = t if t is None else t + done * h + shift
            middle = _at(scheme(u, params, at, half + bend), known[1])
            other = self._bend(number, 1, middle, back, half)
            fine = scheme(middle, params, at if t is None else at + half + bend, half + other)
            whole = scheme(u, params, at, half + bend + (half + other))
            u, shift = _at(joined(fine, whole, weight - share), new), shift + bend + other
        return u

    def _bend(self, number, place, u, back, half):
        """d: 0, with its derivative."""
        if number >= self.turn:
            return -back * plain(half)
        total = 0.0
        for leaf, row in zip(leaves(u), self.rows[number][place], strict=True):
            if isbox(leaf):
                off = leaf - plain(leaf)
                total = total + anp.sum(anp.real(row * cast(off, np.result_type(dtype_of(off), float))))
        return total

    def _doors(self, given, places, ends):
        """Where the two runs part, and where they meet."""
        sizes = self.control.sizes(self.given[0], self.given[0])
        wide = [sizes[n] if n < len(sizes) else _size(leaf) for n, leaf in zip(places, given, strict=True)]
        far = self.control.sizes(self.given[0], self.new)
        scale = [0.0]
        enter, leave = self._pair(_packed_sizes(given, map(_size, given)), 1 / _packed_sizes(given, wide), scale)
        split, meet = self._pair(1 / _packed_sizes(ends, far), _packed_sizes(ends, map(_size, ends)), scale)
        name = f"{self.control.name}.variation"
        start = Rule(
            name,
            lambda x: np.stack([x, x]),
            lambda nums, ans, x: lambda g: (leave(g),),
            lambda nums, tangents, ans, x: enter(tangents[0]),
        )
        end = Rule(
            name,
            lambda both: both[0].copy(),
            lambda nums, ans, both: lambda g: (split(g),),
            lambda nums, tangents, ans, both: meet(tangents[0]),
        )
        return start, end

    def _pair(self, outward, inward, scale):
        """(spread, judge): what goes in is weighed by `inward`, what comes out by `outward`."""
        control = self.control
        limit = MOST * control.tolerance ** (control.order / (control.order + 1))
        limit = limit if control.weight else TIMES * control.tolerance
        unit = EPSILON * (2**control.order - 1)
        noise = 1 + unit * limit / TIMES * np.random.default_rng(0).uniform(-1, 1, inward.size)

        def spread(x):
            scale[0] = np.max(np.abs(x * inward), initial=0.0)
            return np.stack([x, x * noise])

        def judge(both):
            size = max(np.max(np.abs(both[0] * outward), initial=0.0), SHARE * scale[0])
            error = np.max(np.abs((both[1] - both[0]) * outward), initial=0.0) / unit
            if not error <= limit * size and np.all(np.isfinite(both[0])):
                self._refuse(error / size, limit)
            return both[0].copy()

        return linear(f"{control.name}.variation", spread, judge)

    def _refuse(self, error, limit):
        # Without extrapolation errors fall more slowly than the tolerance: a smaller one is refused all the more.
        cure = "give a smaller floor or tolerance" if self.control.weight else "take tr_bdf2, which extrapolates"
        raise DerivativeError(
            f"the derivative of {self.control.name} over {len(self.path)} steps is uncertain by {error:.1e} of its "
            f"size, more than the {limit:.1e} that its tolerance {self.control.tolerance:g} allows; {cure}, end no "
            "interval in the middle of a fast change, or take fixed steps"
        )


def _size(leaf):
    """What a relative change is relative to: the entry itself, and where it is 0, the largest one."""
    size = np.abs(np.asarray(leaf, np.result_type(dtype_of(leaf), float)))
    return np.where(size > 0, size, np.max(size, initial=0.0) or 1.0)


def _packed_sizes(parts, sizes):
    """Sizes of arrays, in the order of `_packed`; 1 for 0."""
    flat = []
    for part, size in zip(parts, sizes, strict=True):
        flat += [np.ravel(size)] * (2 if dtype_of(part).kind == "c" else 1)
    size = np.concatenate([np.zeros(0), *flat])
    return np.where(size > 0, size, 1.0)


def _at(tree, known):
    """The same tree with the values of another, which are nearly the same, and its own derivative."""
    found, rebuild = flatten(tree)
    pairs = zip(found, leaves(known), strict=True)
    return rebuild(leaf - plain(leaf) + value if isbox(leaf) else value for leaf, value in pairs)


def _packed(parts):
    """Arrays -> one flat array of floats, traced or not."""
    flat = []
    for part in parts:
        halves = [anp.real(part), anp.imag(part)] if dtype_of(part).kind == "c" else [part]
        flat += [anp.reshape(cast(half, float), (-1,)) for half in halves]
    return anp.concatenate(flat) if flat else np.zeros(0)


def _unpacked(flat, like):
    """The arrays again, in the shapes and dtypes of `like`."""
    found, place = [], 0
    for leaf in like:
        kind, shape = dtype_of(leaf), np.shape(plain(leaf))
        count = int(np.prod(shape, dtype=int))
        part = flat[place : place + count]
        place += count
        if kind.kind == "c":
            part, place = part + 1j * flat[place : place + count], place + count
        found.append(cast(anp.reshape(part, shape), kind))
    return found
