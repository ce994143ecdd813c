"""Jumps, pulses and steep layers of a rate inside a step with error control.

An error estimate compares evaluations of the rate at a few times. What happens between them it does not see: backward
Euler, whole and in halves, never looks at the start of a step. So the rate is also evaluated at both ends and in the
middle of each step, and where it depends on the time at further times in between. Where nearly all of its change lies
in a small part of the step, this part is cut into eight, the one with the largest deviation from an even change is cut
again, and so on. Along the way the deviation falls by 64 in each cut for a smooth rate, by 8 at a kink, and not at all
at a jump.

A step across a jump of size J is refused until length * J is below the tolerance, a step across a layer until it is
resolved. Values then meet the tolerance. The derivative of steps across a jump lacks a term, J times the derivative of
the time of the jump, that no choice of steps brings back: it is refused.

Between the states of a step that are known the path is a straight line. It is not the solution; but a continuous rate
is continuous along it, too.
"""

from collections import deque

import numpy as np

from sparsedp._utils.pytree import flatten, leaves
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError

__all__ = ["Inspector"]

UNEVEN = 3.0  # ratio of the changes of a rate in both halves of a step, from which on the larger one is looked at
CONCENTRATED = 0.5  # share of the change in one of eight parts, from which on it is followed further
NEGLIGIBLE = 1e-6  # share of the rate below which changes do not count
PERSISTS = 0.5  # share of a deviation that a cut leaves, from which on it may be a jump
PARTS = 8
CUTS = 9  # until a jump is a jump: to 8^-9 of a step
STEADY = 4  # cuts on end that leave the deviation, in a search for small jumps
RESOLVED = 4.0  # lengths of a layer that a step across it may have
GAP = 1 / 200  # largest share of the interval between two evaluations of a rate that depends on the time
EFFORT = 2.0  # times the evaluations that the steps take, at most, for that
EVALUATIONS = 12  # of the rate in a step, about
MISSED = 0.3  # of its length, to which a step that missed a smooth pulse is shortened
UNSEEN = 10.0  # error, in units of the tolerance, of a step that missed a smooth pulse, from which on it is refused
NEARBY = 1e-4  # share of a step for differences of the rate
WINDOW = 7  # steps on end, over which errors are compared with the change of the rate
COARSE = 0.005  # error of the change of the rate by the quadrature of a scheme, from which on it is not resolved
ROUNDING = 1e-15  # relative change of the state
NOISE = 30.0  # times its effect on the rate: what may be rounding
ROUGH = 0.02  # fourth difference of the rate over eighths of a step, as a share of its change, of a closer look
REFUSALS = UnstableStepError, NonFiniteError, ConvergenceError


class Inspector:
    """Looks at the rate inside the steps over one interval.

    Parameters
    ----------
    scheme : Adaptive
    params, t, h
        Of the interval, plain.

    Attributes
    ----------
    found : list of pairs
        (time, whether it jumps in time) for each jump in an accepted step.
    resolution : list of pairs
        For each step that was searched the error of the change of the rate by the quadrature of the scheme, and the
        change.
    """

    def __init__(self, scheme, params, t, h):
        self.scheme, self.problem, self.params, self.t, self.h = scheme, scheme.problem, params, t, h
        self.evaluations, self.probes = 0, 0
        self.known: deque = deque(maxlen=3)  # states, and their rates
        self.found: list = []
        self.resolution: list = []

    def rate(self, u, share):
        """The rate at a share of the interval, as a list of arrays."""
        time = None if self.t is None else self.t + share * self.h
        return [np.asarray(leaf) for leaf in leaves(self.problem(u, self.params, time))]

    def once(self, u, time):
        """The rate at one of the last states of the steps, evaluated once."""
        for state, rate in self.known:
            if state is u:
                return rate
        rate = self.problem(u, self.params, time)
        self.known.append((u, rate))
        return rate

    # ------------------------------------------------------------ steps that are about to be accepted

    def shortened(self, step):
        """The share of its length to which a step has to be shortened, or None: it is accepted."""
        self.evaluations += EVALUATIONS
        try:
            with np.errstate(all="ignore"):
                return self._shortened(_Part(self, step))
        except REFUSALS:  # the straight path leaves the domain of the rate
            return None

    def _shortened(self, part):
        first, last = part.norms(part.changes)
        smaller, larger = (first, last) if first < last else (last, first)
        if not np.isfinite(part.scale):
            return None
        if larger > UNEVEN * smaller and larger > NEGLIGIBLE * part.scale:
            ends = (0.0, part.between) if first > last else (part.between, 1.0)
            share = self._followed(part, *ends)
            if share is not None:
                return share
        return self._probed(part, first + last)

    def _probed(self, part, change):
        """Look between: a rate that depends on the time may have a pulse there."""
        if not self.scheme.timed:
            return None
        count = int(min(np.ceil(part.length / GAP), EFFORT * self.evaluations - self.probes))
        if count < 3:
            return None
        self.probes += count
        shares = np.sort([0.0, part.between, 1.0, *((np.arange(count) + 0.5) / count)])
        rates = part.rates(shares)
        steps = part.norms([np.diff(rate, axis=0) for rate in rates])
        scale = float(np.max(part.norms(rates)))
        if not np.isfinite(scale) or np.sum(steps) <= UNEVEN * change + NEGLIGIBLE * scale:
            return None
        place = int(np.argmax(steps))
        factor = self._followed(part, float(shares[place]), float(shares[place + 1]))
        if factor is None and self.scheme.follows_path:
            widths = np.diff(shares)
            mean = [np.tensordot(widths, 0.5 * (rate[1:] + rate[:-1]), 1) for rate in rates]
            missed = [part.length * self.h * a - b for a, b in zip(mean, part.moved(), strict=True)]
            return MISSED if part.norm(missed) > UNSEEN * self.scheme.tolerance else None
        return factor

    def _followed(self, part, start, stop):
        """Follow the change of the rate between two shares of a step to where it happens."""
        size, start, stop, is_jump = narrowed(part, start, stop)
        if size is None or size <= self._rounding(part):
            return None
        if not is_jump:
            width = RESOLVED * (stop - start)
            return max(0.999 * start, width) if width < 0.5 else None
        kick = size * part.length * self.h / self.scheme.tolerance
        if kick > 1:
            return max(0.999 * start, 0.5 / kick)
        self._note(part, start, stop)
        return None

    def _rounding(self, part):
        """A bound on what rounding of the state, at both ends of a step, changes in the rate."""
        found = [0.0]
        for share in (0.0, 1.0):
            signs = np.random.default_rng(0)
            moved = [
                leaf if leaf is None else leaf * (1 + ROUNDING * signs.choice([-1.0, 1.0], np.shape(leaf)))
                for leaf in leaves(part.state(share))
            ]
            rate = self.rate(part.rebuild(moved), part.done + share * part.length)
            found.append(part.norm([a - b for a, b in zip(rate, part.rate(share), strict=True)]))
        return NOISE * max(found)

    def _note(self, part, start, stop):
        """Keep the time of a jump, and whether the rate jumps in time with the state held."""
        place = part.done + stop * part.length
        in_time = False
        if self.scheme.timed:
            u, here = part.state(start), part.done + start * part.length
            later = part.done + (stop + 1e-3 * (stop - start)) * part.length
            held = [a - b for a, b in zip(self.rate(u, later), self.rate(u, here), strict=True)]
            both = [a - b for a, b in zip(part.rate(stop), part.rate(start), strict=True)]
            in_time = part.norm(held) > 0.5 * part.norm(both)
        self.found.append((place * self.h + (self.t or 0.0), in_time))

    # ------------------------------------------------------------ steps with a derivative

    def search(self, step):
        """Look for smaller jumps, and for layers that are not resolved, in an accepted step."""
        self.resolution.append((0.0, 0.0))
        try:
            with np.errstate(all="ignore"):
                part = _Part(self, step, straight=True)
                rates = part.rates(np.linspace(0.0, 1.0, PARTS + 1))
                change = float(np.sum(part.norms([np.diff(rate, axis=0) for rate in rates])))
                rough = float(np.max(part.norms([np.diff(rate, 4, axis=0) for rate in rates])))
                self.resolution[-1] = 0.0, change
                if rough <= max(ROUGH * change, NEGLIGIBLE * part.scale):
                    return
                size, *place, _ = narrowed(part, 0.0, 1.0, thorough=True)
                if size is not None and size > self._rounding(part):
                    self._note(part, *place)
                self.resolution[-1] = self._resolved(part)
        except REFUSALS:
            pass

    def _resolved(self, part):
        """(error of the quadrature of the derivative of the rate in a step, change of the rate)."""
        nodes, weights = map(np.array, self.scheme.quadrature)
        before, after = np.maximum(nodes - NEARBY, 0.0), np.minimum(nodes + NEARBY, 1.0)
        shares = np.concatenate([before, after, [0.0, 1.0]])
        rates = part.rates(shares)
        n = len(nodes)
        weights = weights / (after - before)
        error = [rate[-1] - rate[-2] - np.tensordot(weights, rate[n : 2 * n] - rate[:n], 1) for rate in rates]
        order = np.argsort(shares)
        change = float(np.sum(part.norms([np.diff(rate[order], axis=0) for rate in rates])))
        return (part.norm(error), change) if change > NEGLIGIBLE * np.max(part.norms(rates)) else (0.0, 0.0)

    def unresolved(self):
        """The number of the step where the rate changes faster than steps resolve; None where there is none."""
        errors, changes = np.array(self.resolution).T
        window = np.ones(min(WINDOW, len(errors)))
        total = np.convolve(changes, window, "same")
        shares = np.convolve(errors, window, "same") / np.where(total > 0, total, 1.0)
        worst = int(np.argmax(shares))
        return worst if shares[worst] > COARSE else None


class _Part:
    """A step: its states along a path, and the rates there.

    Attributes
    ----------
    length, done : float
        As shares of the interval.
    between : float
        Share of the step at which a state inside it is known.
    changes : list of arrays
        Of the rate, up to there and from there on, along a first axis.
    scale : float
        The largest of the rates.
    """

    def __init__(self, inspector, step, straight=False):
        self.inspector, scheme = inspector, inspector.scheme
        self.length, self.done = step.length, step.done
        middle, self.between = scheme.inner_state(step)
        self.trees = {0.0: step.u, 1.0: step.new} if straight else {0.0: step.u, self.between: middle, 1.0: step.new}
        self.places = list(self.trees)
        self.states = [leaves(u) for u in self.trees.values()]
        self.rebuild = flatten(step.u)[1]
        self.sizes = [np.where(size > 0, size, 1.0) for size in scheme.sizes(step.u, step.new)]
        self.count = max(sum(size.size for size in self.sizes), 1)
        self.known: dict = {}
        rates = [self.rate(share) for share in self.places]
        stacked = [np.stack(row) for row in zip(*rates, strict=True)]
        self.changes = [np.diff(row, axis=0) for row in stacked]
        self.scale = float(np.max(self.norms(stacked)))

    def norms(self, rates):
        """The sizes of several rates, along a first axis, relative to the state: root mean squares."""
        total = 0.0
        for rate, size in zip(rates, self.sizes, strict=True):
            shares = np.abs(rate / size).reshape(len(rate), -1)
            total = total + np.einsum("ij,ij->i", shares, shares)
        return np.sqrt(total / self.count)

    def norm(self, rate):
        """The size of one."""
        return float(self.norms([row[None] for row in rate])[0])

    def state(self, share):
        """On straight lines between the states that are known."""
        if share in self.trees:
            return self.trees[share]
        late = int(len(self.places) > 2 and share > self.between)
        start, stop = self.places[late : late + 2]
        weight = (share - start) / (stop - start)
        pairs = zip(*self.states[late : late + 2], strict=True)
        return self.rebuild([a if a is None else a + weight * (b - a) for a, b in pairs])

    def rate(self, share):
        """The rate there."""
        place = self.done + share * self.length
        if share not in self.trees:
            return self.inspector.rate(self.state(share), place)
        if share not in self.known:
            time = None if self.inspector.t is None else self.inspector.t + place * self.inspector.h
            self.known[share] = [np.asarray(leaf) for leaf in leaves(self.inspector.once(self.trees[share], time))]
        return self.known[share]

    def rates(self, shares):
        """The rates at several shares, along a first axis."""
        return [np.stack(row) for row in zip(*(self.rate(float(share)) for share in shares), strict=True)]

    def moved(self):
        """What the step adds to the state."""
        return [b - a for a, b in zip(self.states[0], self.states[-1], strict=True)]


def narrowed(part, start, stop, thorough=False):
    """Where a rate changes most unevenly between two shares of a step.

    Parameters
    ----------
    part : _Part
    start, stop : float
    thorough : bool
        Look for jumps that are smaller than the smooth change in the part.

    Returns
    -------
    (size, start, stop, whether it is a jump)
        Size None: the rate is smooth there. Else the size of the jump, or of the change in a layer, and where it is.
    """
    nothing = None, start, stop, False
    before, steady = 0.0, 0
    first, last = part.rate(start), part.rate(stop)
    for cut in range(CUTS + STEADY):
        shares = np.linspace(start, stop, PARTS + 1)
        if not start < shares[1] < shares[-2] < stop:
            break
        inside = part.rates(shares[1:-1])
        rates = [np.concatenate([a[None], b, c[None]]) for a, b, c in zip(first, inside, last, strict=True)]
        steps = [np.diff(rate, axis=0) for rate in rates]
        uneven = [row - (np.sum(row, axis=0) - row) / (PARTS - 1) for row in steps]
        deviations = part.norms(uneven)
        place = int(np.argmax(deviations))
        size = float(deviations[place])
        if not size > NEGLIGIBLE * part.scale:
            return nothing
        variation = part.norms(steps)
        if cut == 0 and not thorough and size < CONCENTRATED * np.sum(variation):
            return nothing
        if cut and size < PERSISTS * before:
            if not thorough and cut == 1:
                return nothing
            if not thorough or steady >= 2:
                return before, start, stop, False
            steady = 0
            if cut >= CUTS - STEADY:
                return nothing
        elif cut:
            steady += 1
        before = size
        start, stop = float(shares[place]), float(shares[place + 1])
        first, last = [rate[place] for rate in rates], [rate[place + 1] for rate in rates]
        if cut + 1 >= CUTS and steady >= STEADY:
            isolated = np.sum(variation) - variation[place] < 0.2 * size
            return (size, start, stop, True) if isolated else nothing
    return (before, start, stop, True) if steady >= STEADY else nothing
