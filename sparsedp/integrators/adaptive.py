"""Error control: as many steps as the tolerance needs, each compared with two of half its length.

A trial of length h is taken once whole, w, and once in two halves, f. Their difference is 2^p - 1 times the error of f;
what is kept is f + (f - w) / (2^p - 1), one order better (local extrapolation). Crank-Nicolson keeps f: where its
steps ring, w has the opposite sign. The next length is the smaller of what the last error allows and what the trend of
the last two predicts.
Sources: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (1993), II.4; Gustafsson, ACM Trans. Math.
Software 20 (1994).

Derivatives: where something fast happens at a time that depends on the parameters (a jump, an ignition), the derivative
of the state at a fixed time is its speed there times the derivative of that time: huge for a while, and small again
when it is over. Steps of fixed lengths lose what is left. So lengths move. With the speed f and the weights of the
error norm, a half step of length h from the state u gets h + d,

    d = -q <f, u - u*> / <f, f>,     q = a / (a + SLACK),     a = h |f|,

where u* is the same state as data: d is 0, and its derivative takes the state back to the plane through u* across the
flow. The sum of all d so far is given back, in proportion to the lengths, over a last stretch of the interval that is
as long as its speed allows. No choice of d changes what the derivative converges to.

The shadow takes the same states with the derivative of f + (w - e) (f - w), a little less extrapolated than the steps
that count. Tangents start in both, and cotangents arrive from both; where they meet, their difference is e times what
extrapolation took away. The derivative is judged by it, and that of the steps that count goes on. `spread` and `judge`
are each other's transposes in this sense, so it holds in every mode and order. What enters the shadow also gets errors
of the size of the tolerance: where terms cancel so that they matter, the derivative is refused, too.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp.constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, UnstableStepError
from sparsedp.integrators.problem import combine, later, untraced
from sparsedp.tape import Rule, cast, dtype_of, is_variable, isbox, linear, plain
from sparsedp.tree import flatten, leaves

__all__ = ["Adaptive", "Variation"]

SAFETY, SMALLEST, LARGEST = 0.9, 0.2, 5.0  # of one change of the length
QUIET = 1e-2  # share of the tolerance below which an error shows no trend
FLOOR = 0.1  # share of the largest entry of an array to which errors of small entries are compared
LEAST = 1e-15  # share of the interval below which no step is tried
MOST = 100_000  # trials in one interval
WINDOW, FAR = 1000, 10  # trials at a pace that would need FAR * MOST for the rest: no use to go on

SLACK = 0.05  # relative change of the state in a half step that has it follow the flow by half
EPSILON = 1e-3  # share of the shadow
UNCERTAIN = 6.0  # error of a derivative without extrapolation, in units of tolerance^(p / (p + 1)), that is taken
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
            times = later(t, start), later(later(t, start), half)
            sections.append([self._section(state, at, half) for state, at in zip(states, times, strict=True)])
        self.rows = [[row for row, _ in both] for both in sections]
        speeds = np.array([both[0][1] for both in sections])
        rest = h - np.array([start for start, _ in spans])
        fastest = np.maximum.accumulate(speeds[::-1])[::-1]  # from each step on
        self.turn = int(np.argmin(fastest + 1 / rest))  # from this step on the shift is given back
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
            at = later(later(t, done * h), shift)
            middle = _at(scheme(u, params, at, half + bend), known[1])
            other = self._bend(number, 1, middle, back, half)
            fine = scheme(middle, params, later(later(at, half), bend), half + other)
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
        limit = UNCERTAIN * control.tolerance ** (control.order / (control.order + 1))
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


class Adaptive:
    """A scheme with error control over each interval.

    Parameters
    ----------
    scheme : callable
        ``scheme(u, params, t, h)``, with `order`, `problem` and `dyadic`: then lengths are halves of
        halves of the interval, so that few set-ups are needed.
    tolerance : float
        Of the error of two half steps, relative to |u| + floor, root mean square over all entries.
    floor : None, number, or tree like the state
        None: for each array of the state a tenth of its largest entry.
    name : str

    Attributes
    ----------
    taken : list of float
        Lengths of the accepted steps in the last interval, as shares of it.
    weight : float
        Of the extrapolation, 1 / (2^p - 1), or 0.
    """

    def __init__(self, scheme, tolerance, floor, name):
        self.scheme, self.tolerance, self.floor, self.name = scheme, tolerance, constant(floor), name
        self.order, self.dyadic, self.taken = scheme.order, scheme.dyadic, []
        self.weight = 0.0 if getattr(scheme, "name", "") == "crank_nicolson" else 1 / (2**self.order - 1)

    @property
    def info(self):
        return getattr(self.scheme, "info", None)

    def __call__(self, u, params, t, h):
        """The state after the interval h."""
        self._check_tolerance(u)
        traced = any(map(isbox, leaves((u, params, t, h))))
        path: list | None = [] if traced else None
        given = untraced(u), untraced(params), untraced(t), plain(h)
        new = self._cross(given, path)
        return Variation(self, path, given, new).follow(u, params, t, h) if traced else new

    def _cross(self, given, path):
        """The state after the interval; steps go to `path` as (share, share done, state, state between its halves)."""
        u, params, t, h = given
        length, done, taken, mark = self._first(u, params, t, h), 0.0, [], 0.0
        trend, most = None, LARGEST
        for trial in range(1, MOST + 1):
            left = 1.0 - done
            length = self._allowed(length, left)
            middle, new, error = self._trial(u, params, later(t, done * h), length, h)
            change = SAFETY * max(error, 1e-10) ** (-1 / (self.order + 1))
            if error <= 1:
                if path is not None:
                    path.append((length, done, u, middle))
                u, done = new, done + length if length < left else 1.0
                taken.append(length)
                change, trend = self._foreseen(change, length, error, trend)
            if done >= 1.0:
                self.taken = taken
                return u
            length *= float(np.clip(change, SMALLEST, most))
            most = LARGEST if error <= 1 else 1.0  # the step after a refused one is not made longer
            if trial % WINDOW == 0:
                if (1.0 - done) * WINDOW > FAR * MOST * (done - mark):
                    break
                mark = done
            if length < LEAST:
                break
        raise ConvergenceError(
            f"{self.name} found no step that meets the tolerance {self.tolerance:g} at {done:.3g} of its interval "
            f"after {len(taken)} steps; take a larger tolerance, a method for stiff problems, or an interval "
            "that ends before the solution does"
        )

    def _foreseen(self, change, length, error, trend):
        """The change of length where errors go on growing as they did, and the trend from here."""
        error = max(error, QUIET)
        if trend is not None:
            before, other = trend
            change = min(change, change * length / before * (other / error) ** (1 / (self.order + 1)))
        return change, (length, error)

    def _check_tolerance(self, u):
        """Steps of a state that cannot hold the digits asked for would shrink to nothing."""
        for leaf in leaves(u):
            rounding = np.finfo(dtype_of(leaf)).eps if is_variable(leaf) else 0.0
            if self.tolerance < 4 * rounding:
                raise ValueError(
                    f"{self.name} cannot meet the tolerance {self.tolerance:g} with a state of {dtype_of(leaf)}, whose "
                    f"rounding is {rounding:.1e}; take a larger tolerance or write u.astype(float)"
                )

    def _allowed(self, length, left):
        """At most what is left, and not just short of it."""
        if not self.dyadic:
            return left if length > 0.99 * left else min(length, 0.5 * left) if length > 0.5 * left else length
        return 2.0 ** float(np.floor(np.log2(min(length, left))))

    def _trial(self, u, params, t, length, h):
        """The state between two half steps, the new state, and the error of the halves in units of the tolerance."""
        half = 0.5 * length * h
        try:
            with np.errstate(all="ignore"):  # a step that is too long is refused, whatever it gave
                middle = self.scheme(u, params, t, half)
                fine = self.scheme(middle, params, later(t, half), half)
                whole = self.scheme(u, params, t, half + half)
                error = self._error(u, fine, whole)
                new = self.joined(fine, whole, self.weight)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            if length * SMALLEST < LEAST:
                raise
            return None, None, np.inf
        return middle, new, error if np.isfinite(error) else np.inf

    @staticmethod
    def joined(fine, whole, weight):
        """fine + weight (fine - whole)."""
        return combine(fine, (weight, fine), (-weight, whole)) if weight else fine

    def sizes(self, u, new):
        """For each array of the state |u| + floor, to which its errors are compared."""
        found = []
        for floor, *parts in self._floors(u, new):
            size = np.maximum(*(np.abs(np.asarray(plain(part))) for part in parts))
            found.append(size + (FLOOR * np.max(size, initial=0.0) if floor is None else floor))
        return found

    def _error(self, u, new, whole):
        total, count = 0.0, 0
        for size, one, other in zip(self.sizes(u, new), leaves(new), leaves(whole), strict=True):
            with np.errstate(all="ignore"):
                share = np.abs(np.asarray(one) - other) / (self.tolerance * size)
            share = np.where(one == other, 0.0, share)
            total, count = total + np.sum(share**2), count + share.size
        return float(np.sqrt(total / max(count, 1))) / (2**self.order - 1)

    def _floors(self, *trees):
        parts = [leaves(tree) for tree in trees]
        floors = leaves(self.floor)
        floors = floors if len(floors) == len(parts[0]) else [self.floor] * len(parts[0])
        return zip(floors, *parts, strict=True)

    def _first(self, u, params, t, h):
        """A first length from the size of the rate: one that changes the state by a hundredth."""
        rate = leaves(self.scheme.problem(u, params, t))
        if not all(np.all(np.isfinite(leaf)) for leaf in rate if leaf is not None):
            raise NonFiniteError(
                f"the rate of {self.name} must be finite at the state given; take a state in its domain"
            )
        size = max((float(np.max(np.abs(leaf), initial=0.0)) for leaf in leaves(u)), default=0.0)
        speed = max((float(np.max(np.abs(leaf), initial=0.0)) for leaf in rate), default=0.0)
        length = 0.01 * (size or 1.0) / (speed * float(h)) if speed > 0 else 1.0
        return min(max(length, 1e3 * LEAST), 1.0) if np.isfinite(length) else 1e-6
