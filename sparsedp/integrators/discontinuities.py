"""Detection of jumps, pulses and steep layers of a rate inside a step with error control.

An error estimate compares evaluations of the rate at a few times, and misses changes between them. For example,
backward Euler never evaluates the rate at the start of a step. So the rate is also evaluated at both ends and in the
middle of each step and, if it depends on the time, at more times in between. If nearly all of its change lies in a
small part of the step, this part is divided into eight parts. The one with the largest deviation from a uniform change
is divided again, and so on. Each division reduces this deviation by a factor of 64 for a smooth rate, by 8 at a kink,
and by 1 at a jump.

A step across a jump of size J is rejected until length * J is less than the tolerance, and a step across a steep layer
until the layer is resolved. Values then meet the tolerance. The derivative of steps across a jump lacks a term for
every choice of steps, namely J times the derivative of the time of the jump, so that a DerivativeError is raised.

Between the known states of a step, states are interpolated linearly. The interpolant is not the solution, but a
continuous rate is continuous along it.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.pytree import flatten, leaves
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["RateInspector"]

# Fractions of a step, of the interval, or of a change of the rate are plain numbers between 0 and 1.
LARGEST_HALF_RATIO = 3.0  # search a half of a step if the rate changes more by this factor than in the other half
CONCENTRATED = 0.5  # continue the search if one of eight parts has at least this fraction of the change
NEGLIGIBLE = 1e-6  # changes below this fraction of the rate are ignored
JUMP_SHARE = 0.5  # there may be a jump if a division leaves at least this fraction of the deviation
PARTS = 8  # number of parts in each division
DIVISIONS = 9  # a change that persists after this number of divisions (8^-9 of a step) is regarded as a jump
UNREDUCED_DIVISIONS = 4  # number of successive divisions that do not reduce the deviation, in a search for small jumps
RESOLVED = 4.0  # largest ratio of the length of a step to that of a layer in it
GAP = 1 / 200  # largest fraction of the interval between two evaluations of a rate that depends on the time
PROBE_RATIO = 2.0  # largest ratio of these evaluations to the evaluations that the steps need
EVALUATIONS = 12  # approximate number of evaluations of the rate in a step
PULSE_STEP_SHARE = 0.3  # a step that missed a smooth pulse is shortened to this fraction of its length
LARGEST_PULSE_ERROR = 10.0  # reject a step that missed a smooth pulse if its error (in tolerances) is larger
NEARBY = 1e-4  # fraction of a step for finite differences of the rate
WINDOW = 7  # number of successive steps over which errors are compared with changes of the rate
COARSE = 0.005  # the rate is not resolved if the relative error of its change by quadrature is larger
ROUNDING = 1e-15  # relative perturbation of the state to estimate the effect of rounding on the rate
NOISE = 30.0  # changes of the rate below this multiple of that effect may be rounding
LARGEST_FOURTH_DIFFERENCE = 0.02  # search more closely if fourth differences exceed this fraction of the change
EVALUATION_ERRORS = UnstableStepError, NonFiniteError, ConvergenceError


class RateInspector:
    """Searches for jumps, pulses and steep layers of the rate inside the steps over one interval.

    Parameters
    ----------
    scheme : Adaptive
    params, t, h
        Params, start and length of the interval; plain values.

    Attributes
    ----------
    jumps : list of pairs
        For each jump in an accepted step its time, and whether the rate jumps in time (not with the state).
    resolution : list of pairs
        For each step that was searched the change of the rate, second, and the error, first, with which the quadrature
        formula of the scheme integrates the derivative of the rate.
    """

    def __init__(self, scheme: Any, params: Any, t: Any, h: Any) -> None:
        self.scheme = scheme
        self.problem = scheme.problem
        self.params = params
        self.t = t
        self.h = h
        self.evaluations = 0
        self.probes = 0
        self.recent: deque = deque(maxlen=3)  # states, and their rates
        self.jumps: list[tuple[float, bool]] = []
        self.resolution: list[tuple[float, float]] = []

    def rate(self, u: Any, share: float) -> list[np.ndarray]:
        """Return the rate at a share of the interval, as a list of arrays."""
        if self.t is None:
            time = None
        else:
            time = self.t + share * self.h
        return [np.asarray(leaf) for leaf in leaves(self.problem(u, self.params, time))]

    def rate_at_state(self, u: Any, time: Any) -> Any:
        """Return the rate at a state of a step; cached for the last three states."""
        for state, rate in self.recent:
            if state is u:
                return rate
        rate = self.problem(u, self.params, time)
        self.recent.append((u, rate))
        return rate

    # ------------------------------------------------------------ steps before they are accepted

    def shorter_share(self, step: Any) -> float | None:
        """Return the fraction of its length to which a step must be shortened, or None if it is accepted."""
        self.evaluations += EVALUATIONS
        try:
            with np.errstate(all="ignore"):
                path = _StepPath(self, step)
                if not np.isfinite(path.scale):
                    return None
                return self._share_by_changes(path)
        except EVALUATION_ERRORS:  # the straight path leaves the domain of the rate
            return None

    def _share_by_changes(self, path: _StepPath) -> float | None:
        """Search the half of the step in which the rate changes more, then evaluate the rate at further times."""
        first, last = path.norms(path.changes)
        if max(first, last) > LARGEST_HALF_RATIO * min(first, last) and max(first, last) > NEGLIGIBLE * path.scale:
            start, stop = (0.0, path.between) if first > last else (path.between, 1.0)
            share = self._share_by_search(path, start, stop)
            if share is not None:
                return share
        return self._share_by_probes(path, first + last)

    def _share_by_probes(self, path: _StepPath, change: float) -> float | None:
        """Evaluate a rate that depends on the time at further times inside a step, to detect pulses."""
        if not self.scheme.takes_time:
            return None
        count = int(min(np.ceil(path.length / GAP), PROBE_RATIO * self.evaluations - self.probes))
        if count < 3:
            return None
        self.probes += count
        shares = np.sort([0.0, path.between, 1.0, *((np.arange(count) + 0.5) / count)])
        rates = path.rates(shares)
        steps = path.norms([np.diff(rate, axis=0) for rate in rates])
        scale = float(np.max(path.norms(rates)))
        if not np.isfinite(scale) or np.sum(steps) <= LARGEST_HALF_RATIO * change + NEGLIGIBLE * scale:
            return None
        place = int(np.argmax(steps))
        share = self._share_by_search(path, float(shares[place]), float(shares[place + 1]))
        if share is not None or not self.scheme.follows_path:
            return share
        widths = np.diff(shares)
        missed = []
        for rate, moved in zip(rates, path.displacement(), strict=True):
            mean = np.tensordot(widths, 0.5 * (rate[1:] + rate[:-1]), 1)
            missed.append(path.length * self.h * mean - moved)
        if path.norm(missed) > LARGEST_PULSE_ERROR * self.scheme.tolerance:
            return PULSE_STEP_SHARE
        return None

    def _share_by_search(self, path: _StepPath, start: float, stop: float) -> float | None:
        """Locate the change of the rate between two positions in a step; return the fraction that resolves it."""
        change = steepest_change(path, start, stop)
        if change is None or change.size <= self._rounding(path):
            return None
        if not change.is_jump:
            width = RESOLVED * (change.stop - change.start)
            if width < 0.5:
                return max(0.999 * change.start, width)
            return None
        kick = change.size * path.length * self.h / self.scheme.tolerance
        if kick > 1:
            return max(0.999 * change.start, 0.5 / kick)
        self._record_jump(path, change)
        return None

    def _rounding(self, path: _StepPath) -> float:
        """Return a bound on the effect of rounding of the state on the rate, at both ends of a step."""
        largest = 0.0
        for share in (0.0, 1.0):
            signs = np.random.default_rng(0)
            rounded = []
            for leaf in leaves(path.state(share)):
                if leaf is not None:
                    leaf = leaf * (1 + ROUNDING * signs.choice([-1.0, 1.0], np.shape(leaf)))
                rounded.append(leaf)
            rate = self.rate(path.rebuild(rounded), path.done + share * path.length)
            largest = max(largest, path.norm([a - b for a, b in zip(rate, path.rate(share), strict=True)]))
        return NOISE * largest

    def _record_jump(self, path: _StepPath, change: _RateChange) -> None:
        """Record the time of a jump, and whether the rate also jumps in time if the state is constant."""
        start, stop = change.start, change.stop
        is_in_time = False
        if self.scheme.takes_time:
            u = path.state(start)
            after = self.rate(u, path.done + (stop + 1e-3 * (stop - start)) * path.length)
            before = self.rate(u, path.done + start * path.length)
            held = [a - b for a, b in zip(after, before, strict=True)]
            along_path = [a - b for a, b in zip(path.rate(stop), path.rate(start), strict=True)]
            is_in_time = path.norm(held) > 0.5 * path.norm(along_path)
        time = (path.done + stop * path.length) * self.h + (self.t or 0.0)
        self.jumps.append((time, is_in_time))

    # ------------------------------------------------------------ steps with a derivative

    def search(self, step: Any) -> None:
        """Search an accepted step for smaller jumps, and for steep layers that the steps do not resolve."""
        self.resolution.append((0.0, 0.0))
        try:
            with np.errstate(all="ignore"):
                path = _StepPath(self, step, is_straight=True)
                rates = path.rates(np.linspace(0.0, 1.0, PARTS + 1))
                change = float(np.sum(path.norms([np.diff(rate, axis=0) for rate in rates])))
                rough = float(np.max(path.norms([np.diff(rate, 4, axis=0) for rate in rates])))
                self.resolution[-1] = 0.0, change
                if rough <= max(LARGEST_FOURTH_DIFFERENCE * change, NEGLIGIBLE * path.scale):
                    return
                jump = steepest_change(path, 0.0, 1.0, is_thorough=True)
                if jump is not None and jump.size > self._rounding(path):
                    self._record_jump(path, jump)
                self.resolution[-1] = self._quadrature_error(path)
        except EVALUATION_ERRORS:
            pass

    def _quadrature_error(self, path: _StepPath) -> tuple[float, float]:
        """Return the error of the quadrature of the derivative of the rate in a step, and the change of the rate."""
        nodes, weights = map(np.array, self.scheme.quadrature)
        before = np.maximum(nodes - NEARBY, 0.0)
        after = np.minimum(nodes + NEARBY, 1.0)
        shares = np.concatenate([before, after, [0.0, 1.0]])
        order = np.argsort(shares)
        rates = path.rates(shares)
        n = len(nodes)
        weights = weights / (after - before)
        errors = []
        differences = []
        for rate in rates:
            errors.append(rate[-1] - rate[-2] - np.tensordot(weights, rate[n : 2 * n] - rate[:n], 1))
            differences.append(np.diff(rate[order], axis=0))
        change = float(np.sum(path.norms(differences)))
        if change > NEGLIGIBLE * np.max(path.norms(rates)):
            return path.norm(errors), change
        return 0.0, 0.0

    def unresolved_step(self) -> int | None:
        """Return the index of a step in which the rate changes faster than the steps resolve, or None."""
        errors, changes = np.array(self.resolution).T
        window = np.ones(min(WINDOW, len(errors)))
        total = np.convolve(changes, window, "same")
        shares = np.convolve(errors, window, "same") / np.where(total > 0, total, 1.0)
        worst = int(np.argmax(shares))
        if shares[worst] > COARSE:
            return worst
        return None


class _StepPath:
    """Linear interpolation of the states of a step, and the rates at the interpolated states.

    Parameters
    ----------
    inspector : RateInspector
    step : AcceptedStep
    is_straight : bool
        Whether the path does not pass through the state inside the step.

    Attributes
    ----------
    length, done : float
        Length of the step and time before it, as fractions of the interval.
    between : float
        Position of the known state inside the step, as a fraction of the step.
    changes : list of arrays
        Changes of the rate between successive known states, along the first axis.
    scale : float
        Largest norm of the rates at the known states.
    """

    def __init__(self, inspector: RateInspector, step: Any, is_straight: bool = False) -> None:
        self.inspector = inspector
        self.length = step.length
        self.done = step.done
        middle, self.between = inspector.scheme.inner_state(step)
        self.trees = {0.0: step.u, 1.0: step.new}
        if not is_straight:
            self.trees = {0.0: step.u, self.between: middle, 1.0: step.new}
        self.places = list(self.trees)
        self.states = [leaves(u) for u in self.trees.values()]
        self.rebuild = flatten(step.u)[1]
        self.sizes = [np.where(size > 0, size, 1.0) for size in inspector.scheme.sizes(step.u, step.new)]
        self.count = max(sum(size.size for size in self.sizes), 1)
        self._rates: dict[float, list] = {}
        rates = [self.rate(share) for share in self.places]
        stacks = [np.stack(row) for row in zip(*rates, strict=True)]
        self.changes = [np.diff(row, axis=0) for row in stacks]
        self.scale = float(np.max(self.norms(stacks)))

    def norms(self, rates: Sequence) -> np.ndarray:
        """Return the sizes of rates along a first axis, relative to the state: root mean squares."""
        total: Any = 0.0
        for rate, size in zip(rates, self.sizes, strict=True):
            shares = np.abs(rate / size).reshape(len(rate), -1)
            total = total + np.einsum("ij,ij->i", shares, shares)
        return np.sqrt(total / self.count)

    def norm(self, rate: Sequence) -> float:
        """Return the size of one rate."""
        return float(self.norms([row[None] for row in rate])[0])

    def state(self, share: float) -> Any:
        """Return the state at a fraction of the step, by linear interpolation of the known states."""
        if share in self.trees:
            return self.trees[share]
        late = int(len(self.places) > 2 and share > self.between)
        start, stop = self.places[late : late + 2]
        weight = (share - start) / (stop - start)
        pairs = zip(*self.states[late : late + 2], strict=True)
        return self.rebuild([a if a is None else a + weight * (b - a) for a, b in pairs])

    def rate(self, share: float) -> list[np.ndarray]:
        """Return the rate at a share."""
        place = self.done + share * self.length
        if share not in self.trees:
            return self.inspector.rate(self.state(share), place)
        if share not in self._rates:
            inspector = self.inspector
            if inspector.t is None:
                time = None
            else:
                time = inspector.t + place * inspector.h
            rate = inspector.rate_at_state(self.trees[share], time)
            self._rates[share] = [np.asarray(leaf) for leaf in leaves(rate)]
        return self._rates[share]

    def rates(self, shares: Sequence | np.ndarray) -> list[np.ndarray]:
        """Return the rates at several shares, along a first axis."""
        return [np.stack(row) for row in zip(*(self.rate(float(share)) for share in shares), strict=True)]

    def displacement(self) -> list:
        """Return the change of the state in the step."""
        return [b - a for a, b in zip(self.states[0], self.states[-1], strict=True)]


class _RateChange(NamedTuple):
    """A change of a rate: its size, its start and stop as fractions of the step, and whether it is a jump."""

    size: float
    start: float
    stop: float
    is_jump: bool


def steepest_change(path: _StepPath, start: float, stop: float, is_thorough: bool = False) -> _RateChange | None:
    """Locate the steepest change of a rate between two positions in a step (fractions of the step).

    Parameters
    ----------
    path : _StepPath
    start, stop : float
    is_thorough : bool
        Also search for jumps that are smaller than the smooth change between the two positions.

    Returns
    -------
    _RateChange or None
        A jump or a steep layer; None if the rate is smooth there.
    """
    last_size = 0.0
    steady = 0
    first = path.rate(start)
    last = path.rate(stop)
    for division in range(DIVISIONS + UNREDUCED_DIVISIONS):
        shares = np.linspace(start, stop, PARTS + 1)
        if not start < shares[1] < shares[-2] < stop:
            break
        inside = path.rates(shares[1:-1])
        rates = [np.concatenate([a[None], b, c[None]]) for a, b, c in zip(first, inside, last, strict=True)]
        steps = [np.diff(rate, axis=0) for rate in rates]
        deviations = path.norms([row - (np.sum(row, axis=0) - row) / (PARTS - 1) for row in steps])
        variation = path.norms(steps)
        place = int(np.argmax(deviations))
        size = float(deviations[place])
        if not size > NEGLIGIBLE * path.scale:
            return None
        if division == 0 and not is_thorough and size < CONCENTRATED * np.sum(variation):
            return None
        if division > 0 and size < JUMP_SHARE * last_size:
            if not is_thorough and division == 1:
                return None
            if not is_thorough or steady >= 2:
                return _RateChange(last_size, start, stop, False)
            steady = 0
            if division >= DIVISIONS - UNREDUCED_DIVISIONS:
                return None
        elif division > 0:
            steady += 1
        last_size = size
        start = float(shares[place])
        stop = float(shares[place + 1])
        first = [rate[place] for rate in rates]
        last = [rate[place + 1] for rate in rates]
        if division + 1 >= DIVISIONS and steady >= UNREDUCED_DIVISIONS:
            is_isolated = np.sum(variation) - variation[place] < 0.2 * size
            if is_isolated:
                return _RateChange(size, start, stop, True)
            return None
    if steady >= UNREDUCED_DIVISIONS:
        return _RateChange(last_size, start, stop, True)
    return None
