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
as long as its speed allows. For a rate that is continuous no choice of d changes what the derivative converges to.
Where it jumps, at a time or with the state, all of them converge to a derivative without the term of the jump: see
discontinuities.py, which refuses these, and interruptions.py, which has the term.

Two shadows take the same states. The first has the derivative of f + (w - e) (f - w), a little less extrapolated than
the steps that count: where both meet, their difference is e times what extrapolation took away. What enters the second
gets errors of the size of the tolerance: where terms cancel so that they matter, their difference is large. Tangents
start in all three, and cotangents arrive from all three. The derivative is judged by the sum of both sizes, and that of
the steps that count goes on. `spread` and `judge` are each other's transposes in this sense, so it holds in every mode
and order. One shadow with both changes would be cheaper, but near a change of sign either hides the other: where two
intervals met in the middle of a jump, derivatives that were wrong by 69 % passed.

The values of all states are known by then. So what goes on the tape is how far they are off, which is 0 and has the
derivative.
"""

from collections import deque
from functools import reduce
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import note, thread
from sparsedp._utils.pytree import flatten, is_uniform, labels, leaves, mapped, paired
from sparsedp._utils.validation import number_beside
from sparsedp.autodiff.backend import NUMPY, backend_of, replicated
from sparsedp.autodiff.derivative import push
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, linear, plain, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.grid.space import Space
from sparsedp.integrators.discontinuities import Inspector
from sparsedp.integrators.problem import combine, later, unsided, untraced
from sparsedp.integrators.runge_kutta import Explicit, Scheme

__all__ = ["Adaptive", "Moving", "Taken", "inner", "relative"]

FITTING = "; give one number, or a tree like the state"  # advice about a floor
SAFETY, SMALLEST, LARGEST = 0.9, 0.2, 5.0  # of one change of the length
QUIET = 1e-2  # share of the tolerance below which an error shows no trend
FLOOR = 0.1  # share of the largest entry of an array to which errors of small entries are compared
LEAST = 1e-15  # share of the time so far below which no step is tried: its end would be rounded to its start
TINY = 1e-25  # share of the interval, for the first step
CAREFUL = 1e-3  # most that is tried first where the rate takes the time: it may be at rest at the start alone
MOST = 100_000  # trials in one interval
WINDOW, FAR = 1000, 10  # trials at a pace that would need FAR * MOST for the rest: no use to go on

QUADRATURE = {  # by order
    1: ((0.5,), (1.0,)),
    2: ((0.0, 0.5, 1.0), (1 / 6, 4 / 6, 1 / 6)),
    3: ((0.0, 0.25, 0.5, 0.75, 1.0), (3 / 42, 16 / 42, 4 / 42, 16 / 42, 3 / 42)),
    4: ((0.0, 0.25, 0.5, 0.75, 1.0), (7 / 90, 32 / 90, 12 / 90, 32 / 90, 7 / 90)),
}
SLACK = 0.05  # relative change of the state in a half step that has it follow the flow by half
EPSILON = 1e-3  # share of the shadows
LESS = 0.0, EPSILON, 0.0  # how much less the steps that count and both shadows are extrapolated
UNCERTAIN = 6.0  # error of a derivative without extrapolation, in units of tolerance^(p / (p + 1)), that is taken
TIMES = 10.0  # error of a derivative in units of the tolerance: aim with extrapolation, limit without
STEEP = 0.1  # relative uncertainty of the rate of change of an event, from which on it grazes its surface
ROUNDING = 1e-12  # of the largest first derivative, below which a second one is 0 to rounding
SHARE = 1e-4  # of what goes in: derivatives that are smaller are judged by it


class Taken(NamedTuple):
    """A step: its share of the interval, the share done before, the state, that between its halves, and the new one."""

    length: float
    done: float
    u: Any
    middle: Any
    new: Any


class Adaptive(Scheme):
    """A scheme with error control over each interval.

    Parameters
    ----------
    scheme : Scheme
    tolerance : float
        Of the error of two half steps, relative to |u| + floor, root mean square over all entries.
    floor : None, number, or tree like the state
        None: for each array of the state a tenth of its largest entry.
    max_step : float, optional
        Longest step.

    Attributes
    ----------
    compared : int
        Order of the error that is controlled.
    taken : list of float
        Lengths of the accepted steps in the last interval, as shares of it.
    weight : float
        Of the extrapolation, 1 / (2^p - 1), or 0.
    """

    window = WINDOW

    def __init__(self, scheme, tolerance, floor, max_step=None):
        super().__init__(scheme.problem, f"stepper({scheme.name})", scheme.order)
        self.max_step = np.inf if max_step is None else float(max_step)
        self.scheme, self.tolerance, self.floor, self.info = scheme, tolerance, constant(floor), scheme.info
        self.taken, self.ratio, self.compared, self.dyadic = [], 2**self.order - 1, self.order, scheme.dyadic
        self.weight = 0.0 if scheme.name == "crank_nicolson" else 1 / self.ratio

    def __call__(self, *given):
        """(u, params, t, h) -> the state after the interval h."""
        self.check_tolerance(given[0])
        return self._crossed(given, isbox)

    def _crossed(self, given, moves):
        """The state after the interval; `moves`: which leaves of what is given have a derivative."""
        traced = any(map(isbox, leaves(given)))
        path, _, self.taken = self.path(untraced(given), traced)
        return self._followed(path, given, moves) if traced else path[-1].new

    def path(self, known, whole, watch=None):
        """The steps over an interval, or up to the first event in it.

        Parameters
        ----------
        known : tuple
            (u, params, t, h), plain.
        whole : bool
            Whether all steps are wanted; else the last one alone.
        watch : Watch, optional
            Looks for events in each step.

        Returns
        -------
        (list of Taken, Event or None, list of the lengths of all steps)
        """
        crossing, taken = None, []
        path: deque = deque(maxlen=None if whole else 1)
        inspector = self.inspector(known)
        u, params, t, h = known
        for step in self._steps(u, params, t, h, inspector):
            crossing = watch and watch.crossing(self, step, known)
            path.append(crossing.step if crossing else step)
            if whole and inspector:  # beyond an event the rate is that at its surface
                inspector.search(path[-1])
            taken.append(path[-1].length)
            if crossing:
                break
        if whole and inspector:
            if inspector.found:
                self._refuse_jump(*inspector.found[0])
            place = inspector.unresolved()
            if place is not None:
                self._refuse_layer(path[place], known)
        return [*path], crossing and crossing.event, taken

    @property
    def timed(self):
        """Whether the right-hand side depends on the time."""
        return self.scheme.problem.driven or self.scheme.problem.moving

    @property
    def quadrature(self):
        """Nodes and weights that an extrapolated step gives to a rate that depends on the time alone."""
        if not self.weight:
            return (0.0, 0.5, 1.0), (0.25, 0.5, 0.25)
        return QUADRATURE[self.compared]

    def _refuse_layer(self, step, known):
        time = (known[2] or 0.0) + (step.done + 0.5 * step.length) * known[3]
        raise DerivativeError(
            f"the rate of {self.name} changes near t = {time:.6g} faster than steps with the tolerance "
            f"{self.tolerance:g} resolve, and the derivative would miss a part of it; give a smaller tolerance or "
            "max_step, or breaks= where it jumps"
        )

    @property
    def follows_path(self):
        """Whether the rate along the steps tells how far they go: not where it is stiff."""
        return isinstance(self.scheme, Explicit)

    def inspector(self, known):
        """What looks for jumps of the rate; None where it has none: an operator, and a source that is constant.

        Also on ranks, whose fields it would have to gather.
        """
        problem = self.scheme.problem
        smooth = problem.rate is None and not problem.moving
        return None if smooth or backend_of(leaves(known[0])) is not NUMPY else Inspector(self, *known[1:])

    def inner_state(self, step):
        """Return a state inside a step, in the form that steps have, and the share of the step at which it is."""
        return step.middle, 0.5

    def _refuse_jump(self, time, in_time):
        cure = f"breaks=[{time:.6g}], or breaks=lambda params: [...] where it moves"
        if not in_time:
            cure = "events=lambda u, params, t: ... with a function that is 0 there"
            if self.timed:  # close to a state of 0 the two are hard to tell apart
                cure += f", or breaks=[{time:.6g}] if it jumps at that time in every state"
        raise DerivativeError(
            f"the rate of {self.name} jumps at t = {time:.9g}, and the derivative of steps across it lacks the term of "
            f"the jump; write {cure}"
        )

    def interval(self, u, params, t, h):
        """What crosses an interval: a scheme, and what it is given."""
        return self, (u, params, t, h)

    def rerun(self, path, given, event):
        """The ends of the steps that were taken: (state, time of the event or None) for each run.

        Parameters
        ----------
        path : list of Taken
        given : list of tuples
            (u, params, t, h) of each run: of equal value, with derivatives of their own.
        event : Event or None
            What ended the path.
        """
        _, params, t, h = untraced(given[0])
        slopes = self._slopes(path, params, t, h, event)
        return [self._again(path, slopes, less, event, *start) for less, start in zip(LESS, given, strict=True)]

    def tree(self, u):
        """The state of a step as the user knows it."""
        return u

    def rounded(self, u):
        """The state at the end of an interval."""
        return u

    def rate(self, u, params, t):
        """The rate at a state of a step."""
        return self.problem(u, params, t)

    def partial(self, step, known, length):
        """The step from the same state with another length, as a share of the interval; None where there is none."""
        _, params, t, h = known
        middle, new, _ = self._trial(step.u, params, later(t, step.done * h), length, h)
        return None if new is None else Taken(length, step.done, step.u, middle, new)

    def check_tolerance(self, u):
        """Refuse a floor that does not fit the state, and digits that it cannot hold: steps would shrink to nothing.

        The ledger learns the tolerance: a check of a gradient compares its gap with it.
        """
        thread.controlled += 1
        note(self.name, "tolerance", self.tolerance)
        for place, floor, leaf in zip(labels(u, "floor"), self._floors(u), leaves(u), strict=True):
            try:
                np.broadcast_to(floor, np.shape(plain(leaf)))
            except ValueError:
                raise ShapeError(
                    f"{place}: shape {np.shape(floor)} does not fit the state there, of shape {np.shape(plain(leaf))}"
                    f"{FITTING}"
                ) from None
        for leaf in filter(is_variable, leaves(u)):
            rounding = np.finfo(dtype_of(leaf)).eps
            if self.tolerance < 4 * rounding:
                raise ValueError(
                    f"{self.name} cannot meet the tolerance {self.tolerance:g} with a state of {dtype_of(leaf)}, whose "
                    f"rounding is {rounding:.1e}; take a larger tolerance or write u.astype(float)"
                )

    def _steps(self, u, params, t, h, inspector):
        """The steps over the interval, one after the other."""
        length, done, count, mark = self._first(u, params, t, h), 0.0, 0, 0.0
        before, most, power = None, LARGEST, -1 / (self.compared + 1)
        longest = self.max_step / h
        left_zero = None  # the place at which a step that was refused would have changed an array that is 0
        for trial in range(1, MOST + 1):
            left = 1.0 - done
            length = self._allowed(min(length, longest), left)
            middle, new, error = self._trial(u, params, later(t, done * h), length, h, inspector)
            change = SAFETY * max(error, 1e-10) ** power
            accepted = error <= 1
            if accepted and inspector:
                shorter = inspector.shortened(Taken(length, done, u, middle, new))
                if shorter is not None:
                    accepted, change = False, shorter
            if not accepted and new is not None and self._leaves_zero(u, new):
                left_zero = done
            if accepted:
                yield Taken(length, done, u, middle, new)
                count += 1
                u, done, error = new, done + length if length < left else 1.0, max(error, QUIET)
                if done == 1.0:
                    return
                if before is not None:  # errors go on growing as they did
                    change = min(change, change * length / before[0] * (error / before[1]) ** power)
                before = length, error
            length *= float(np.clip(change, SMALLEST if accepted or error > 1 else 0.0, most))
            most = LARGEST if accepted else 1.0  # the step after a refused one is not made longer
            turn = trial % self.window == 0
            if length < max(LEAST * done, TINY) or turn and (1.0 - done) * self.window > FAR * MOST * (done - mark):
                break
            mark = done if turn else mark
        cure = "take a larger tolerance, a method for stiff problems, or an interval that ends before the solution does"
        if left_zero is not None and done - left_zero < 1e-3:
            cure = (
                "an array of the state is 0 there, and errors are relative to it; write floor=, the size below which "
                "it does not matter, or breaks= with the times at which its rate sets in"
            )
        raise ConvergenceError(
            f"{self.name} found no step that meets the tolerance {self.tolerance:g} at {done:.3g} of its interval "
            f"after {count} steps; {cure}"
        )

    def _leaves_zero(self, u, new):
        """Whether a step starts to change an array that is 0, whose errors are relative to its size alone."""
        arrays = zip(leaves(u), leaves(new), self._floors(u), strict=True)
        for before, after, floor in arrays:
            still, moved = (np.max(np.abs(leaf), initial=0.0) for leaf in (before, after))
            if floor is None and still == 0 and moved != 0:
                return True
        return False

    def _first(self, u, params, t, h):
        """A first length from the size of the rate: one that changes the state by a hundredth."""
        size, speed = (
            float(np.max([np.max(np.abs(leaf), initial=0.0) for leaf in leaves(tree)], initial=0.0))
            for tree in (u, self.problem(u, params, t))
        )
        if not np.isfinite(speed):
            raise NonFiniteError(
                f"the rate of {self.name} must be finite at the state given; take a state in its domain"
            )
        length = 0.01 * (size or 1.0) / (speed * float(h)) if speed > 0 else 1.0
        return min(max(1e3 * TINY, length), CAREFUL if self.problem.timed else 1.0)

    def _allowed(self, length, left):
        """At most what is left, and not just short of it."""
        if not self.dyadic:
            return left if length > 0.99 * left else min(length, 0.5 * left) if length > 0.5 * left else length
        return 2.0 ** float(np.floor(np.log2(min(length, left))))

    def _trial(self, u, params, t, length, h, inspector=None):
        """The state between two half steps, the new state, and the error of the halves in units of the tolerance."""
        half = 0.5 * length * h
        scheme = self.scheme
        # An inspector needs the rates at the start and in the middle, too: explicit steps begin with them.
        shared = inspector is not None and isinstance(scheme, Explicit)
        try:
            with np.errstate(all="ignore"):  # a step that is too long is refused, whatever it gave
                if shared:
                    first = inspector.once(u, t)
                    middle = scheme(u, params, t, half, first)
                    fine = scheme(middle, params, later(t, half), half, inspector.once(middle, later(t, half)))
                    whole = scheme(u, params, t, half + half, first)
                else:
                    middle = scheme(u, params, t, half)
                    fine = scheme(middle, params, later(t, half), half)
                    whole = scheme(u, params, t, half + half)
                error = self._error(u, fine, whole)
                new = self.joined(fine, whole, self.weight)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            if length * SMALLEST < TINY:
                raise
            return None, None, np.inf
        return middle, new, error if np.isfinite(error) else np.inf

    @staticmethod
    def joined(fine, whole, weight):
        """fine + weight (fine - whole)."""
        return combine(fine, (weight, fine), (-weight, whole)) if weight else fine

    def _floors(self, u):
        """A floor for each array of the state; a number or None may stand for a whole branch."""
        return paired(self.floor, u, "floor", advice=FITTING, prefix=is_uniform)

    def sizes(self, *states):
        """For each array of the state |u| + floor, to which its errors are compared."""
        columns = list(zip(*map(leaves, states), strict=True))
        sizes = [reduce(np.maximum, map(np.abs, parts)) for parts in columns]
        pairs = zip(sizes, self._floors(states[0]), strict=True)
        return [size + (FLOOR * np.max(size, initial=0.0) if floor is None else floor) for size, floor in pairs]

    def _error(self, u, new, whole):
        rows = zip(self.sizes(u, new), leaves(new), leaves(whole), strict=True)
        shares = [np.where(one == other, 0.0, np.abs(one - other) / size) for size, one, other in rows]
        count = sum(share.size for share in shares)
        return float(np.linalg.norm([*map(np.linalg.norm, shares)])) / (
            max(count, 1) ** 0.5 * self.tolerance * self.ratio
        )

    def _followed(self, path, given, moves):
        """The state at the end of the path, with a derivative that is judged."""
        known = untraced(given)
        start = Moving(given, moves, [*self.sizes(path[0].u), *map(relative, leaves(known[1:]))])
        end = Moving(path[-1].new, is_variable, self.sizes(path[0].u, path[-1].new))
        spread, judge = linear(f"{self.name}.variation", *self.doors(len(path)))
        return end.at(judge(self._runs(path, known, start, end, spread(start.off(given)))))

    def _runs(self, path, known, start, end, entered):
        """How far the ends of the three runs are off, from how far their starts are."""
        ends = self.rerun(path, [start.at(x) for x in entered], None)
        return anp.array([end.off(new) for new, _ in ends])

    def section(self, u, rates, half):
        """The derivative of d for each array of the state, and the speed, as a share of the state's size by time."""
        sizes = [np.where(size > 0, size, np.inf) for size in self.sizes(u)]
        count = max(sum(size.size for size in sizes), 1)
        rows = [np.conj(rate / size) / size / count for rate, size in zip(rates, sizes, strict=True)]
        square = float(sum(np.sum(np.real(row * rate)) for row, rate in zip(rows, rates, strict=True)))
        speed = np.sqrt(square)
        return [-half / (speed * half + SLACK) / (speed or 1.0) * row for row in rows], speed

    def _slopes(self, path, params, t, h, event):
        """(for each step the derivatives of d at both halves, None where the shift is given back; its time)."""
        rows, speeds = [], []
        for step in path[:-1] if event else path:
            half, at = 0.5 * step.length * h, later(t, step.done * h)
            places = (step.u, at), (step.middle, later(at, half))
            (first, speed), (second, _) = (self.section(u, leaves(self.problem(u, params, t)), half) for u, t in places)
            rows.append((first, second))
            speeds.append(speed)
        if event:  # its time is free: nothing is given back
            return [*rows, None], np.inf
        rest = h * (1.0 - np.array([step.done for step in path]))
        turn = int(np.argmin(np.maximum.accumulate(speeds[::-1])[::-1] + 1 / rest))  # the fastest from each step on
        return rows[:turn] + [None] * (len(path) - turn), rest[turn]

    def _again(self, path, slopes, share, event, u, params, t, h):
        """The steps that were taken; the new state of each has the value that is known. And the time of an event."""
        rows, rest = slopes
        shift = back = 0.0
        for step, row in zip(path, rows, strict=True):
            half, at = 0.5 * step.length * h, later(later(t, step.done * h), shift)
            if event and step is path[-1]:
                return self._until(event, step, share, u, params, at, half)
            bend = _bend(u, row[0]) if row else -back * plain(half)
            middle = _at(self.scheme(u, params, at, half + bend), step.middle)
            other = _bend(middle, row[1]) if row else -back * plain(half)
            fine = self.scheme(middle, params, later(later(at, half), bend), half + other)
            whole = self.scheme(u, params, at, half + bend + (half + other))
            u, shift = _at(self.joined(fine, whole, self.weight - share), step.new), shift + bend + other
            back = shift / rest if row else back
        return u, None

    def _until(self, event, step, share, u, params, t, half):
        """The state and the time at the end of a step that an event ends."""
        weight = self.weight - share

        def ahead(point, bend):
            """The state after a step of length 2 half + bend, and the time."""
            u, params, t = point
            length = half + 0.5 * bend
            middle = _at(self.scheme(u, params, t, length), step.middle)
            fine = self.scheme(middle, params, t + length, length)
            whole = self.scheme(u, params, t, length + length)
            return _at(self.joined(fine, whole, weight), step.new), t + (length + length)

        def value(point, bend):
            new, time = ahead(point, bend)
            return event.value(new, unsided(point[1]), time)

        point = u, params, t
        known = untraced(point)
        change = float(push(lambda bend: 1.0 * value(known, bend), 0.0, [1.0])[1])
        if not share:
            self._check_transversal(event, step, known, change, 2.0 * half)
        bend = 0.0
        for _ in traces_of(leaves(point)):  # each one makes the derivative of one more order exact
            found = value(point, bend)
            bend = bend - (found - plain(found)) / change
        return ahead(point, bend)

    def _check_transversal(self, event, step, known, change, length):
        """Refuse the derivative of an event where the solution, to the tolerance, only touches the surface."""
        _, params, t = known
        u, new = self.tree(step.u), self.tree(step.new)
        of_state, of_time = event.gradient(u, unsided(params), t)
        before = of_time + inner(of_state, self.tree(self.rate(step.u, params, t)))
        self.check_steep(event, new, params, t + length, change, (change - before) / length)

    def check_steep(self, event, u, params, t, change, bend):
        """Refuse an event whose rate of change, with the derivative `bend`, is zero to the tolerance."""
        of_state, _ = event.gradient(u, unsided(params), t)
        sizes = flatten(u)[1](Adaptive.sizes(self, u))
        uncertain = self.tolerance * inner(mapped(_magnitude, of_state), sizes)
        if change == 0 or abs(bend) * uncertain > STEEP * change**2:
            raise DerivativeError(
                f"{event.name} of {self.name} grazes its surface at t = {t:.9g}: its rate of change there, "
                f"{change:.3g}, is zero to the tolerance {self.tolerance:g}, so that its time has no derivative; "
                "give another event or parameter, or a smaller tolerance"
            )

    def doors(self, count):
        """(spread, judge): where the three runs part, and where they meet; on plain arrays."""
        share = self.compared / (self.compared + 1)
        limit = UNCERTAIN * self.tolerance**share if self.weight else TIMES * self.tolerance
        unit, scale, largest = EPSILON * self.ratio, [0.0], [0.0]  # of the last values, and of all

        def spread(x):
            scale[0] = np.max(np.abs(x), initial=0.0)
            largest[0] = max(largest[0], scale[0])
            return np.stack([x, x, x * (1 + unit * limit / TIMES * np.random.default_rng(0).uniform(-1, 1, x.size))])

        def judge(arrived):
            derivative, *shadows = arrived
            size = max(np.max(np.abs(derivative), initial=0.0), SHARE * scale[0])
            error = np.max(sum(np.abs(shadow - derivative) for shadow in shadows), initial=0.0) / unit
            # What comes in not finite was named where it came up.
            if error <= limit * size or not np.isfinite(scale[0]):
                return derivative.copy()
            # Without extrapolation errors fall more slowly than the tolerance: a smaller one is refused all the more.
            cure = "give a smaller floor or tolerance" if self.weight else "take tr_bdf2, which extrapolates"
            if size < ROUNDING * largest[0]:
                raise DerivativeError(
                    f"a second derivative of {self.name} over {count} steps is 0 to rounding, which error control "
                    "cannot tell from an error: the result does not depend on it to second order, as that of a ball "
                    "before its first bounce; leave it out, or take fixed steps"
                )
            share = number_beside(error / size, limit, float(f"{limit:.1e}"), digits=1, style="e")
            raise DerivativeError(
                f"the derivative of {self.name} over {count} steps is uncertain by {share} of its "
                f"size, more than the {limit:.1e} that its tolerance {self.tolerance:g} allows; {cure}, end no "
                "interval in the middle of a fast change, or take fixed steps"
            )

        return spread, judge


class Moving:
    """The leaves of a tree that have a derivative, and how far they are off their values, as one flat array of floats.

    Parameters
    ----------
    tree : tree
    moves : callable
        Whether a leaf has a derivative.
    sizes : list
        For each leaf the unit of each entry; 1 for 0.
    """

    def __init__(self, tree, moves, sizes):
        self.found, self.rebuild = flatten(tree)
        self.form = self.rebuild(range(len(self.found)))
        rows = enumerate(zip(self.found, sizes, strict=True))
        self.moving = [(n, plain(leaf), np.where(size > 0, size, 1.0)) for n, (leaf, size) in rows if moves(leaf)]
        self.units = [size for *_, size in self.moving]
        shapes = [np.shape(leaf) for _, leaf, _ in self.moving for _ in range(1 + np.iscomplexobj(leaf))]
        self.space = Space(None, parts=shapes)

    def off(self, tree):
        """Tree -> flat."""
        found, parts = paired(tree, self.form, "rate"), []
        for place, leaf, size in self.moving:
            part = replicated(_off(found[place], leaf) / size)
            parts += [anp.real(part), anp.imag(part)] if np.iscomplexobj(leaf) else [part]
        return self.space.join(*parts)

    def at(self, flat):
        """Flat -> tree."""
        found, parts = list(self.found), iter(self.space.split(flat))
        for place, leaf, size in self.moving:
            part = next(parts) + 1j * next(parts) if np.iscomplexobj(leaf) else next(parts)
            found[place] = leaf + cast(size * part, dtype_of(leaf))
        return self.rebuild(found)


def _off(leaf, known):
    """0 with the derivative of a leaf, in double precision."""
    off = leaf - known
    return cast(off, np.result_type(dtype_of(off), float))


def _at(tree, known):
    """The same tree with the values of another, which are nearly the same, and its own derivative."""
    return mapped(lambda leaf, value: leaf - plain(leaf) + value if isbox(leaf) else value, tree, known)


def _bend(u, rows):
    """d: 0, with its derivative."""
    pairs = zip(leaves(u), rows, strict=True)
    return sum(anp.sum(anp.real(row * _off(leaf, plain(leaf)))) for leaf, row in pairs if isbox(leaf))


def _magnitude(leaf):
    return None if leaf is None else np.abs(leaf)


def inner(cotangent, tangent):
    """The real product of two trees; None in the first one counts for nothing."""
    pairs = zip(leaves(cotangent), leaves(tangent), strict=True)
    return float(sum(np.sum(np.real(row * rate)) for row, rate in pairs if row is not None))


def relative(leaf):
    """What a relative change is relative to: the entry itself, and where it is 0, the largest one."""
    size = np.abs(leaf) if is_variable(leaf) else 1.0
    return np.where(size > 0, size, np.max(size, initial=0.0))
