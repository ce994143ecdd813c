"""The stress cases of a scene: extreme values of its parameters, and what has to come out of each.

GROUPS is the table: for each group a function that lists its cases, the values to try and the judge of what comes out.
"""

import re
from functools import partial
from math import inf, isfinite, ldexp, log, log2, nan
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import copied, leaves, norm
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.check.audit_thresholds import THRESHOLDS
from sparsedp.check.directions import examine_directions, excuse_kinks
from sparsedp.check.evaluations import Evaluations, Line
from sparsedp.check.operators import layouts
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import Point, audit_generator, root_mean_square
from sparsedp.check.summary import error_text
from sparsedp.errors import SparsedpError
from sparsedp.report.certificate import distance
from sparsedp.report.stability import SEED, STEADY, growth_of

__all__ = ["FAILED", "GROUPS", "WORDS", "Scene", "cases", "run"]

WORDS = PASSED, REFUSED, DEGRADED, FAILED = "passed", "refused correctly", "degraded", "FAILED"
TIME_STEPS, VISCOSITIES = ("dt", "time_step", "tau"), ("nu", "viscosity", "diffusivity", "kappa", "mu")
DIFFERENCES = (1e-4, 1e-5, 1e-3, 1e-6, 1e-2, 1e-7)  # their steps, in units of x; the one that mostly serves comes first
GOOD = 1e-5  # gap between gradient and differences that needs no further look
WRONG = "the differences settle on another gradient,"
UNSEEN = 100 * EPS  # changes of the value, relative, that no difference sees
ROUNDING = 8 * EPS  # change of x in its last digits
DIGITS = {"good": 1e-8, "bad": 1e-5}  # changes of the result by a change in the last digits: allowed, and too large
FINER = 8.0  # of the time step, to tell physics that grows from a step that does
LARGEST = 960  # power of 2 up to which a value is sure to be representable


# ---------------------------------------------------------------- a scene, and a run of it


class Scene:
    """A loss at a point, its named parameters, their legal ranges, and which are time step and viscosity.

    Attributes
    ----------
    leaves : dict
        Name -> array: the floating leaves of x.
    ranges : dict
        Name -> (low, high).
    time_step, viscosity : str or None
        Names of these parameters.
    base : Outcome
        Value and gradient as given.
    growth : Growth or None
    """

    def __init__(self, loss, x, ranges, step, time_step, viscosity):
        self.loss, self.step, self.point = loss, step, Point(x)
        names = [re.sub(r"^x\['?([^\[\]']*)'?\]$", r"\1", name) for name in self.point.names]  # x['dt'] is called dt
        self.leaves = dict(zip(names, self.point.values))
        self.ranges = ranges if isinstance(ranges, dict) else {"x": ranges} if ranges else {}
        for name in (*self.ranges, time_step, viscosity):
            if name is not None and name not in names:
                raise ValueError(f"stress knows the parameters {', '.join(names)}, got {name!r}; write one of them")
        for name, limits in self.ranges.items():
            if np.size(limits) != 2 or not -inf < limits[0] < limits[1] < inf:
                raise ValueError(f"stress needs ranges of two finite numbers, low < high, got {limits!r} for {name}")
        self.time_step = time_step or next((name for name in TIME_STEPS if name in names), None)
        self.viscosity = viscosity or next((name for name in VISCOSITIES if name in names), None)
        self.base = run(loss, self.at({}))
        self.growth = self.growth_at({})

    def at(self, other):
        """The tree x with other values of some parameters; the rest are fresh copies."""
        return self.point.tree(list((copied(self.leaves) | other).values()))

    def sheltered(self, x):
        """The loss there, NaN whatever it raises."""
        try:
            return self.loss(x)
        except Exception:  # a scene may raise anything
            return nan

    def growth_at(self, other):
        """How a step grows there."""
        return growth_of(self.loss, self.at(other), self.step)

    def legal(self, name, value):
        """Whether a value lies in the range of a parameter; without a range everything does."""
        low, high = self.ranges.get(name, (-inf, inf))
        return np.all((low <= value) & (value <= high))

    def fault(self, other):
        """The word for a wrong number: FAILED as given, in stated ranges, and without viscosity."""
        stated = all(name in self.ranges and self.legal(name, value) for name, value in other.items())
        inviscid = not np.any(other.get(self.viscosity, 1.0))
        return FAILED if stated or inviscid else DEGRADED


class Outcome(NamedTuple):
    """What one run gave: value and gradient; and what a judge says of the error, if there was one."""

    value: float
    gradient: Any
    refusal: tuple = ()  # the word is right for an error that the library raises on purpose
    flagged: bool = False  # the gradient grew without bound on its way back


def run(loss, x):
    """Value and gradient of a loss at x -> Outcome; whatever it raises is part of it."""
    grown = thread.grown
    try:
        value, gradient = value_and_grad(loss)(x)
    except Exception as error:  # a scene may raise anything: its row shows it
        chance = isinstance(error, (np.linalg.LinAlgError, UnicodeError))
        typed = isinstance(error, (SparsedpError, ValueError, TypeError)) and not chance
        return Outcome(nan, None, (REFUSED if typed else DEGRADED, nan, error_text(error)))
    return Outcome(float(value), gradient, (), thread.grown > grown)


# ---------------------------------------------------------------- judges: what came out -> (word, figure, note)


def judged(judge, scene, other):
    """The verdict on a run with other values of some parameters, which it may not change."""
    x = scene.at(other)
    before = _bits(x)
    out = run(scene.loss, x)
    if not out.refusal and _bits(x) != before:
        return FAILED, nan, "the input was modified"
    return judge(scene, other, out)


def _bits(x):
    return [leaf.tobytes() for leaf in leaves(x) if isinstance(leaf, np.ndarray)]


def sound(scene, other, out):
    """The run ends with finite numbers, the gradient agrees with differences, and no step grows by fault of the scheme.

    As given it may not be refused; its growth is a case of its own.
    """
    if out.refusal:
        word, *rest = out.refusal
        return FAILED if word == REFUSED and not other else word, *rest
    if not isfinite(out.value):
        return scene.fault(other), nan, f"value {out.value:g}, and no error"
    if not isfinite(norm(out.gradient)):
        return scene.fault(other), nan, "the gradient is not finite, and no error"
    verdict = _against_differences(scene, other, out)
    growth = scene.growth_at(other) if other and scene.growth and verdict[0] == PASSED else None
    if growth and growth.factor > STEADY and growth.flips:
        return scene.fault(other), growth.factor, "growth factor of a step: unstable, and no error"
    return verdict


def near(scene, other, out, good=0.0, bad=1e-10, note="differs from the plain case", unit=1.0):
    """Value and gradient are those of the plain case to `good` (0: to the last bit), or to `bad`, which is degraded."""
    base = scene.base
    refusal = out.refusal or base.refusal
    if refusal:
        return refusal[0] if good else FAILED, *refusal[1:]
    gaps = distance(out.value, base.value), distance(out.gradient, base.gradient)
    return _graded(max(gaps), good, bad, note, unit)


def _graded(gap, good, bad, note, unit=1.0):
    word = PASSED if gap <= good else DEGRADED if gap <= bad else FAILED
    return word, gap, "" if word == PASSED else note.format(gap / unit)


def scaled(scene, other, out, power):
    """The value is 2^power times the plain one, exactly."""
    if out.refusal:
        return out.refusal
    if abs(log2(abs(scene.base.value)) + power) > LARGEST:
        return DEGRADED, nan, f"the value is {out.value:g}: not representable"
    gap = abs(out.value / ldexp(scene.base.value, power) - 1.0)
    return _graded(gap, 1e-12, 1e-3, f"is not 2^{power} times the plain value")


def refused(scene, other, out, located=False):
    """The run ends with a typed error.

    located: it has to say which number is wrong, or where the first one stands (a loss may have moved it on the
    way), or to name the parameter.
    """
    if out.refusal:
        word, figure, words = out.refusal
        place = rf"the first at|got -?(nan|inf)\b|\b{re.escape(next(iter(other)))}\b"
        if word == REFUSED and located and not re.search(place, words):
            return DEGRADED, figure, f"refused without a name or a place: {words}"
        return word, figure, words
    if located and isfinite(norm([out.value, out.gradient])):
        return FAILED, out.value, "swallowed: the value and the gradient are finite"
    return DEGRADED, nan, f"taken without an error; value {out.value:g}"


def growing(scene, *_):
    """The growth factor of a step: above 1 is right only if the physics grows."""
    growth, dt = scene.growth, scene.time_step
    if growth.refusal:
        return REFUSED, nan, growth.refusal
    if growth.factor <= STEADY:
        return PASSED, growth.factor, ""
    if growth.flips:
        return FAILED, growth.factor, "grows and changes its sign from step to step: the step is too large"
    if dt is None:
        return DEGRADED, growth.factor, "grows; name the time step, so that physics and step can be told apart"
    finer = scene.growth_at({dt: scene.leaves[dt] / FINER}).factor
    if finer > 1 and log(growth.factor) <= 4 * FINER * log(finer):
        return PASSED, growth.factor, "grows as the physics does"
    return FAILED, growth.factor, "grows, and does not with a smaller step"


def _against_differences(scene, other, out):
    """The gradient against central differences along random directions in every leaf, and along itself.

    One difference that meets the gradient is enough along each direction. Where one does not, and for the point as it
    is given, all evidence is gathered and judged as `check.gradient` does it.
    """
    point = Point(scene.at(other))
    trials = Evaluations(scene.sheltered, point, out.gradient)
    trials.base, trials.slopes = out.value, point.gradient(out.gradient)
    lines = [Line(name, direction, trials) for name, direction in _directions(point, trials.slopes)]
    largest = max((abs(line.slope) for line in lines), default=0.0)
    gap = max((_smallest_gap(line, largest) for line in lines), default=0.0)
    met = gap <= GOOD
    if met and other:
        return PASSED, gap, ""
    trials = Evaluations(scene.sheltered, point, lambda tree: value_and_grad(scene.loss)(tree)[1])
    try:
        judged, doubts = examine_directions(trials, 1, audit_generator(SEED), None)
        excuse_kinks(trials, judged)
    except Exception as error:  # a scene may raise anything beside the point
        return DEGRADED, gap, f"the gradient cannot be compared with differences: {error_text(error)}"
    word, reason = overall_verdict(judged, doubts)
    if word == "disagrees" and out.flagged:
        return DEGRADED, gap, "the gradient grows without bound on its way back"
    if word == "disagrees" and _underflows(point, out.value):
        return DEGRADED, gap, "the gradient is below the smallest numbers of its precision"
    if word == "disagrees":
        lost = not np.any(trials.slopes)
        return FAILED, gap, "the gradient is 0, the differences are not" if lost else f"{WRONG} {reason}"
    unseen = largest <= UNSEEN * abs(out.value)
    if unseen:
        return PASSED, 0.0, "the gradient is smaller than differences can see"
    if word == "agrees" or met:
        return PASSED, gap, ""
    return DEGRADED, gap, f"the differences do not settle on the gradient: {reason}"


def _underflows(point, value):
    """Whether the smallest positive numbers, to which a gradient is rounded, are no longer small for some leaf.

    A leaf of size s has a derivative of about value / s. It is rounded to a multiple of the smallest positive number,
    which changes the value by s times this number over a displacement of the size of the leaf.
    """
    for leaf in point.values:
        largest = float(np.max(np.abs(leaf), initial=0.0))
        if float(np.finfo(leaf.dtype).smallest_subnormal) * largest > GOOD * abs(value):
            return True
    return False


def _directions(point, gradient):
    """Names and displacements: random in each leaf, or in all where they are many, and the gradient itself."""

    def is_wanted(name):
        return name.startswith("random in") or name == "gradient"

    directions = point.directions(gradient, 0, audit_generator(SEED), is_wanted)
    if any(name != "gradient" for name, _ in directions):
        return directions
    return [("random", point.random(audit_generator(SEED))), *directions]


def _smallest_gap(line, largest):
    """Smallest gap between gradient and differences, as a share of the derivative; steps are tried until it is GOOD.

    A derivative far below the largest one is compared with that: rounding of the loss hides the rest.
    """
    scale = max(abs(line.slope), THRESHOLDS.negligible_share * largest)
    gap = inf
    for step in DIFFERENCES:
        line.sweep([step])
        gaps = [abs(level.difference - level.slope) / (scale or 1.0) for level in line.usable]
        gap = min(gaps, default=inf)
        if gap <= GOOD and scale:
            return gap
    if line.unchanged_steps and abs(line.slope) <= UNSEEN * abs(line.base):
        return 0.0  # rounding of the loss hides the derivative
    return gap if scale else inf


# ---------------------------------------------------------------- cases: (scene, name, x) -> case, other x, judge


def as_given(scene, *_):
    rng = np.random.default_rng(SEED)
    moved = [(name, x, rng.choice([-1.0, 1.0], x.shape)) for name, x in scene.leaves.items()]
    yield "value and gradient", {}, sound
    yield "two runs", {}, near
    amplified = partial(near, note="rounding is amplified by {:.0e}", unit=ROUNDING, **DIGITS)
    yield "all integers", {name: x.astype(int) for name, x in scene.leaves.items()}, refused
    yield "last digits of x changed", {name: x * (1 + sign * ROUNDING) for name, x, sign in moved}, amplified
    if scene.growth:
        yield "growth in one step", {}, growing


def scalings(scene, name, x):
    """A monomial in a parameter scales exactly; another loss is judged at the new point as it is."""
    degree = _degree(scene, name, x)
    for exponent in (1, -1, 10, -10, 100, -100, 900, -900) if np.any(x) else ():
        judge = partial(scaled, power=degree * exponent) if degree else sound
        yield f"times 2^{exponent}", x * 2.0**exponent, judge


def _degree(scene, name, x):
    """d, where the loss is a monomial s^d in the scale s of a parameter, else 0."""
    values = [scene.sheltered(scene.at({name: s * x})) for s in (0.5, 1.0, 2.0)]  # NaN where it is refused
    low, high = np.diff(np.log2(np.abs(values)))
    return round(low) if abs(low - high) + abs(low - np.rint(low)) < 1e-12 else 0


def legal_range(scene, name, x):
    """Values over the range of a parameter, and as far outside as it is wide."""
    if name in scene.ranges:
        low, high = scene.ranges[name]
        spread = np.geomspace if _decades(low, high) else np.linspace
        values = {f"all {value:.3g}": value for value in spread(low, high, 5)}
        values |= {"below its range": 2 * low - high, "above its range": 2 * high - low}
        for case, value in values.items():
            yield case, np.full_like(x, value), sound


def zeros_and_signs(scene, name, x):
    """A time step has to be positive, a viscosity may be 0."""
    yield "all 0", 0.0 * x, refused if name == scene.time_step else sound
    yield "sign changed", -1.0 * x, refused if name in (scene.time_step, scene.viscosity) else sound


def jumps(scene, name, x):
    """Arrays between the ends of their range, or over 8 decades around positive values."""
    if x.size > 1 and (name in scene.ranges or np.all(x > 0)):
        low, high = scene.ranges.get(name, (1e-4 * x, 1e4 * x))
        over = f"{low:.3g} to {high:.3g}" if name in scene.ranges else "8 decades"
        share = np.random.default_rng(SEED).random(x.shape)
        between = low * (high / low) ** share if _decades(low, high) else low + (high - low) * share
        yield f"jump, {over}", np.where(np.arange(x.size).reshape(x.shape) < x.size // 2, low, high), sound
        yield f"random, {over}", between, sound


def _decades(low, high):
    """Whether steps between two limits are to be factors: both are positive, and far apart."""
    return np.all(low > 0) and np.all(high > 10 * low)


def constants_added(scene, name, x):
    """Incompatible data of a singular system are projected or refused, never amplified."""
    if x.size > 1 and np.any(x):
        amplified = partial(near, note="amplified by {:.0e}: is a null space left in?")
        yield "plus 1e-14 of itself", x + 1e-14 * root_mean_square(x), partial(amplified, unit=1e-14, **DIGITS)
        yield "plus 1e-07 of itself", x + 1e-7 * root_mean_square(x), partial(amplified, good=1e-3, bad=0.1, unit=1e-7)
        yield "plus 1 of itself", x + root_mean_square(x), sound


def not_finite(scene, name, x):
    """One entry, that with the largest derivative, where the loss depends on it."""
    slopes = [] if scene.base.refusal else scene.point.slopes(scene.base.gradient)
    slope = np.abs(dict(zip(scene.leaves, slopes)).get(name, 0.0))
    for bad in (nan, inf) if np.max(slope, initial=0.0) > 0 else ():
        spoilt = np.array(x)
        spoilt.flat[np.argmax(slope)] = bad
        yield f"one {bad}", spoilt, partial(refused, located=True)


def kinds_of_arrays(scene, name, x):
    if x.ndim:
        for case, same in layouts(x).items():
            yield case, same, near
        yield "float32", x.astype(np.float32), partial(near, good=1e-4, bad=1e-2)
        for other in (np.resize(x, (len(x) + 1, *x.shape[1:])), x + 1j * x):
            yield f"shape {other.shape}, {other.dtype}", other, refused


def factors(scene, name, x):
    for factor in (1e-8, 1e-4, 1e-2, 1e-1, 1e1, 1e2, 1e4, 1e8) if name in (scene.time_step, scene.viscosity) else ():
        yield f"times {factor:g}", x * factor, sound


class Group(NamedTuple):
    """Cases of one kind."""

    cases: Any  # (scene, name, x) of one parameter -> case, other x, judge
    reason: str  # why it may have no case in a scene
    legal: bool = False  # values outside the range of a parameter are left out, but those that have to be refused


WHOLE = "as given"  # of the scene as a whole: what stands for another x are the other values of all parameters
GROUPS = {
    WHOLE: Group(as_given, ""),
    "scaling": Group(scalings, "every parameter is 0, or its range leaves no room", legal=True),
    "legal range": Group(legal_range, "no ranges were given; write ranges={'name': (low, high)}"),
    "zeros and signs": Group(zeros_and_signs, "outside the legal ranges", legal=True),
    "jumps": Group(jumps, "no array of positive numbers or with a range"),
    "constant added": Group(constants_added, "no array that is not 0", legal=True),
    "not finite": Group(not_finite, "the loss depends on no parameter"),
    "kinds of arrays": Group(kinds_of_arrays, "no arrays"),
    "time step and viscosity": Group(
        factors, "no parameter has such a name; write time_step='name', viscosity='name'", legal=True
    ),
}


def cases(scene, groups):
    """Scene and names of groups -> (group, parameter, case, function that gives (word, figure, note))."""
    for group in groups:
        whole, legal = group == WHOLE, GROUPS[group].legal
        for name, x in [("", None)] if whole else scene.leaves.items():
            for case, value, judge in GROUPS[group].cases(scene, name, x):
                if not legal or judge is refused or scene.legal(name, value):
                    yield group, name, case, partial(judged, judge, scene, value if whole else {name: value})
