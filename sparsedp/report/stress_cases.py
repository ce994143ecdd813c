"""The stress cases of a scene: extreme values of its parameters, and functions that grade the results.

GROUPS lists the groups of cases. Each group has a function that yields its cases. A case has the values to try and the
function that grades the result.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import inf, isfinite, ldexp, log, log2, nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import copied, leaves, norm
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.check.directions import examine_directions, reclassify_kinks
from sparsedp.check.evaluations import Evaluations, Line
from sparsedp.check.operators import layouts
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import Point, audit_generator, root_mean_square
from sparsedp.check.summary import error_text
from sparsedp.check.thresholds import THRESHOLDS
from sparsedp.errors import SparsedpError
from sparsedp.report.certificate import distance
from sparsedp.report.stability import LARGEST_STEADY_GROWTH, SEED, Growth, growth_of

__all__ = ["FAILED", "GROUPS", "WORDS", "Scene", "cases", "run"]

PASSED = "passed"
REFUSED = "refused correctly"
DEGRADED = "degraded"
FAILED = "FAILED"
WORDS = (PASSED, REFUSED, DEGRADED, FAILED)
TIME_STEPS = ("dt", "time_step", "tau")
VISCOSITIES = ("nu", "viscosity", "diffusivity", "kappa", "mu")
DIFFERENCE_STEPS = (1e-4, 1e-5, 1e-3, 1e-6, 1e-2, 1e-7)  # in units of x, tried in this order
GOOD_GAP = 1e-5  # relative gap between gradient and differences up to which a case passes
INVISIBLE_CHANGE = 100 * EPS  # relative change of the value that finite differences cannot detect
ROUNDING_OF_X = 8 * EPS  # relative change of x by rounding
GOOD_CHANGE = 1e-8  # relative change of the result up to which the case passes
LARGEST_CHANGE = 1e-5  # relative change above which the case has FAILED
FINER_STEP = 8.0  # divisor of the time step, to distinguish growing physics from an unstable step
LARGEST_EXPONENT = 960  # a value up to this power of 2 can be represented

Values = Mapping[str, Any]  # changed values of some parameters, by name
Grade = tuple[str, float, str]  # word, figure, note


# ---------------------------------------------------------------- a scene, and a run of it


class Scene:
    """A loss at a point, with names and legal ranges of its parameters, and the names of time step and viscosity.

    Attributes
    ----------
    leaves : dict
        The floating leaves of x, by name.
    ranges : dict
        Legal range (low, high), by name.
    time_step, viscosity : str or None
        Names of these parameters.
    base : Outcome
        Value and gradient at x.
    growth : Growth or None
    """

    def __init__(
        self,
        loss: Callable[[Any], Any],
        x: Any,
        ranges: Any,
        step: Callable[[Any], Any] | None,
        time_step: str | None,
        viscosity: str | None,
    ) -> None:
        self.loss = loss
        self.step = step
        self.point = Point(x)
        names = [re.sub(r"^x\['?([^\[\]']*)'?\]$", r"\1", name) for name in self.point.names]  # x['dt'] is called dt
        self.leaves: dict[str, NDArray[Any]] = dict(zip(names, self.point.values))
        if isinstance(ranges, dict):
            self.ranges = ranges
        else:
            if ranges:
                self.ranges = {"x": ranges}
            else:
                self.ranges = {}
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

    def at(self, changed: Values) -> Any:
        """Return the tree x with changed values of some parameters, and copies of all others."""
        return self.point.tree(list((copied(self.leaves) | dict(changed)).values()))

    def value_or_nan(self, x: Any) -> Any:
        """Return the loss at x, or NaN if it raises an exception."""
        try:
            return self.loss(x)
        except Exception:  # a scene may raise anything
            return nan

    def growth_at(self, changed: Values) -> Growth | None:
        """Return the growth of a step with changed values of some parameters."""
        return growth_of(self.loss, self.at(changed), self.step)

    def is_legal(self, name: str, value: Any) -> bool:
        """Return whether a value is in the range of a parameter. Without a range, all values are."""
        low, high = self.ranges.get(name, (-inf, inf))
        return bool(np.all((low <= value) & (value <= high)))

    def grade_of_fault(self, changed: Values) -> str:
        """Return the grade of a wrong result: FAILED at x, within given ranges, and for viscosity 0, else DEGRADED."""
        is_stated = all(name in self.ranges and self.is_legal(name, value) for name, value in changed.items())
        is_inviscid = self.viscosity is not None and not np.any(changed.get(self.viscosity, 1.0))
        if is_stated or is_inviscid:
            return FAILED
        return DEGRADED


class Outcome(NamedTuple):
    """The result of one evaluation of value and gradient.

    Attributes
    ----------
    value : float
    gradient : tree or None
    refusal : tuple
        Grade of the exception; empty if there was none. It is REFUSED for an exception of this library, ValueError or
        TypeError, and DEGRADED for all others.
    has_grown : bool
        Whether the gradient grew without bound in the backward pass.
    """

    value: float
    gradient: Any
    refusal: Any = ()
    has_grown: bool = False


def run(loss: Callable[[Any], Any], x: Any) -> Outcome:
    """Return value and gradient of a loss. An exception is caught and becomes part of the outcome."""
    grown = thread.grown
    try:
        value, gradient = value_and_grad(loss)(x)
    except Exception as error:  # a scene may raise any exception; its row shows it
        is_accidental = isinstance(error, (np.linalg.LinAlgError, UnicodeError))
        is_typed = isinstance(error, (SparsedpError, ValueError, TypeError)) and not is_accidental
        return Outcome(nan, None, (REFUSED if is_typed else DEGRADED, nan, error_text(error)))
    return Outcome(float(value), gradient, (), thread.grown > grown)


# ---------------------------------------------------------------- grades of results


def graded_run(grade: Callable[..., Grade], scene: Scene, changed: Values) -> Grade:
    """Run a scene with changed parameters and grade the outcome. It has FAILED if the run modified its input."""
    x = scene.at(changed)
    before = _bits(x)
    outcome = run(scene.loss, x)
    if not outcome.refusal and _bits(x) != before:
        return FAILED, nan, "the input was modified"
    return grade(scene, changed, outcome)


def _bits(x: Any) -> list[bytes]:
    """Return the bits of all arrays of a tree."""
    return [leaf.tobytes() for leaf in leaves(x) if isinstance(leaf, np.ndarray)]


def grade_soundness(scene: Scene, changed: Values, outcome: Outcome) -> Grade:
    """Grade whether results are finite, the gradient agrees with differences, and the time step is stable.

    At x itself an exception counts as FAILED. The growth at x is a separate case.
    """
    if outcome.refusal:
        word, figure, note = outcome.refusal
        if word == REFUSED and not changed:
            word = FAILED
        return word, figure, note
    if not isfinite(outcome.value):
        return scene.grade_of_fault(changed), nan, f"value {outcome.value:g}, and no error"
    if not isfinite(norm(outcome.gradient)):
        return scene.grade_of_fault(changed), nan, "the gradient is not finite, and no error"
    grade = _compare_with_differences(scene, changed, outcome)
    if changed and scene.growth and grade[0] == PASSED:
        growth = scene.growth_at(changed)
        if growth and growth.factor > LARGEST_STEADY_GROWTH and growth.flips:
            note = "growth factor of a step: unstable, and no error"
            return scene.grade_of_fault(changed), growth.factor, note
    return grade


def grade_nearness(
    scene: Scene,
    changed: Values,
    outcome: Outcome,
    good: float = 0.0,
    bad: float = 1e-10,
    note: str = "differs from the plain case",
    unit: float = 1.0,
) -> Grade:
    """Grade the difference of value and gradient to those at x: passed up to `good`, degraded up to `bad`."""
    base = scene.base
    refusal = outcome.refusal or base.refusal
    if refusal:
        word, figure, reason = refusal
        return (word if good else FAILED), figure, reason
    gap = max(distance(outcome.value, base.value), distance(outcome.gradient, base.gradient))
    return _grade_gap(gap, good, bad, note, unit)


def _grade_gap(gap: float, good: float, bad: float, note: str, unit: float = 1.0) -> Grade:
    """Grade a gap. The note may contain the gap, divided by `unit`."""
    if gap <= good:
        return PASSED, gap, ""
    return (DEGRADED if gap <= bad else FAILED), gap, note.format(gap / unit)


def grade_scaling(scene: Scene, changed: Values, outcome: Outcome, power: int) -> Grade:
    """Grade whether the value is 2^power times the value at x."""
    if outcome.refusal:
        return outcome.refusal
    base = scene.base.value
    if abs(log2(abs(base)) + power) > LARGEST_EXPONENT:
        return DEGRADED, nan, f"the value is {outcome.value:g}: not representable"
    gap = abs(outcome.value / ldexp(base, power) - 1.0)
    return _grade_gap(gap, 1e-12, 1e-3, f"is not 2^{power} times the plain value")


def grade_refusal(scene: Scene, changed: Values, outcome: Outcome, located: bool = False) -> Grade:
    """Grade whether the run raises an exception of this library, ValueError or TypeError.

    Parameters
    ----------
    scene, changed, outcome
    located : bool
        If True, the message must also contain the wrong value, its position, or the name of the parameter.
    """
    if outcome.refusal:
        word, figure, note = outcome.refusal
        name = re.escape(next(iter(changed)))
        place = rf"the first at|got -?(nan|inf)\b|\b{name}\b"
        if word == REFUSED and located and not re.search(place, note):
            return DEGRADED, figure, f"refused without a name or a place: {note}"
        return word, figure, note
    if located and isfinite(norm([outcome.value, outcome.gradient])):
        return FAILED, outcome.value, "swallowed: the value and the gradient are finite"
    return DEGRADED, nan, f"taken without an error; value {outcome.value:g}"


def grade_growth(scene: Scene, changed: Values, outcome: Outcome) -> Grade:
    """Grade the growth factor of a step. A factor above 1 passes only if a smaller step shows similar growth."""
    growth: Any = scene.growth
    if growth.refusal:
        return REFUSED, nan, growth.refusal
    if growth.factor <= LARGEST_STEADY_GROWTH:
        return PASSED, growth.factor, ""
    if growth.flips:
        return FAILED, growth.factor, "grows and changes its sign from step to step: the step is too large"
    name = scene.time_step
    if name is None:
        return DEGRADED, growth.factor, "grows; name the time step, to distinguish physics and step"
    finer: Any = scene.growth_at({name: scene.leaves[name] / FINER_STEP})
    if finer.factor > 1 and log(growth.factor) <= 4 * FINER_STEP * log(finer.factor):
        return PASSED, growth.factor, "grows as the physics does"
    return FAILED, growth.factor, "grows, and does not with a smaller step"


def _compare_with_differences(scene: Scene, changed: Values, outcome: Outcome) -> Grade:
    """Compare the gradient with central differences along a random direction in each leaf, and along the gradient.

    One difference that agrees is sufficient in each direction. If none agrees in some direction, and always at x
    itself, the gradient is examined as in `check.gradient`.
    """
    point = Point(scene.at(changed))
    first_look = Evaluations(scene.value_or_nan, point, outcome.gradient)
    first_look.base = outcome.value
    first_look.slopes = point.gradient(outcome.gradient)
    lines = [Line(name, direction, first_look) for name, direction in _directions(point, first_look.slopes)]
    largest = max((abs(line.slope) for line in lines), default=0.0)
    gap = max((_smallest_gap(line, largest) for line in lines), default=0.0)
    is_met = gap <= GOOD_GAP
    if is_met and changed:
        return PASSED, gap, ""
    evaluations = Evaluations(scene.value_or_nan, point, lambda tree: value_and_grad(scene.loss)(tree)[1])
    try:
        directions, findings = examine_directions(evaluations, 1, audit_generator(SEED), None)
        reclassify_kinks(evaluations, directions)
    except Exception as error:  # a scene may raise any exception near the point
        return DEGRADED, gap, f"the gradient cannot be compared with differences: {error_text(error)}"
    verdict, reason = overall_verdict(directions, findings)
    if verdict == "disagrees":
        return _grade_disagreement(point, outcome, evaluations, gap, reason)
    if largest <= INVISIBLE_CHANGE * abs(outcome.value):
        return PASSED, 0.0, "the gradient is smaller than differences can see"
    if verdict == "agrees" or is_met:
        return PASSED, gap, ""
    return DEGRADED, gap, f"the differences do not settle on the gradient: {reason}"


def _grade_disagreement(point: Point, outcome: Outcome, evaluations: Evaluations, gap: float, reason: str) -> Grade:
    """Grade a gradient that disagrees with the differences."""
    if outcome.has_grown:
        return DEGRADED, gap, "the gradient grows without bound in the backward pass"
    if _underflows(point, outcome.value):
        return DEGRADED, gap, "the gradient is below the smallest numbers of its precision"
    if not np.any(evaluations.slopes):
        return FAILED, gap, "the gradient is 0, the differences are not"
    return FAILED, gap, f"the differences settle on another gradient, {reason}"


def _underflows(point: Point, value: float) -> bool:
    """Return whether the gradient of some leaf may be so small that it is inaccurate due to underflow.

    The derivative with respect to a leaf of size s is about value / s, and is rounded to a multiple of the smallest
    subnormal number. This is inaccurate if s times this number is not small relative to the value.
    """
    for leaf in point.values:
        largest = float(np.max(np.abs(leaf), initial=0.0))
        if float(np.finfo(leaf.dtype).smallest_subnormal) * largest > GOOD_GAP * abs(value):
            return True
    return False


def _directions(point: Point, gradient: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """Return names and displacements: a random direction in each leaf (or one in all leaves), and the gradient."""

    def is_wanted(name: str) -> bool:
        return name.startswith("random in") or name == "gradient"

    directions = point.directions(gradient, 0, audit_generator(SEED), is_wanted)
    if any(name != "gradient" for name, _ in directions):
        return directions
    return [("random", point.random(audit_generator(SEED))), *directions]


def _smallest_gap(line: Line, largest: float) -> float:
    """Return the relative gap between gradient and differences: the first good one, or that at the last step.

    The gap is relative to the derivative, but at least to a small share of the largest derivative, because rounding of
    the loss hides smaller ones.
    """
    scale = max(abs(line.slope), THRESHOLDS.negligible_share * largest)
    gap = inf
    for step in DIFFERENCE_STEPS:
        line.sweep([step])
        gaps = [abs(level.difference - level.slope) / (scale or 1.0) for level in line.usable]
        gap = min(gaps, default=inf)
        if gap <= GOOD_GAP and scale:
            return gap
    if line.unchanged_steps and abs(line.slope) <= INVISIBLE_CHANGE * abs(line.base):
        return 0.0  # rounding of the loss hides the derivative
    if scale:
        return gap
    return inf


# ---------------------------------------------------------------- cases of a parameter: (case, other value, grade)

Case = tuple[str, Any, Callable[..., Grade]]


def as_given(scene: Scene, *_: Any) -> Iterator[Case]:
    """List the cases of the scene as a whole."""
    rng = np.random.default_rng(SEED)
    in_last_digits = {}
    for name, x in scene.leaves.items():
        in_last_digits[name] = x * (1 + rng.choice([-1.0, 1.0], x.shape) * ROUNDING_OF_X)
    amplification = partial(
        grade_nearness,
        good=GOOD_CHANGE,
        bad=LARGEST_CHANGE,
        note="rounding is amplified by {:.0e}",
        unit=ROUNDING_OF_X,
    )
    yield "value and gradient", {}, grade_soundness
    yield "two runs", {}, grade_nearness
    yield "all integers", {name: x.astype(int) for name, x in scene.leaves.items()}, grade_refusal
    yield "last digits of x changed", in_last_digits, amplification
    if scene.growth:
        yield "growth in one step", {}, grade_growth


def scalings(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List scalings by powers of two. A loss that is a monomial in the parameter must scale exactly."""
    degree = _degree(scene, name, x)
    if not np.any(x):
        return
    for exponent in (1, -1, 10, -10, 100, -100, 900, -900):
        grade: Callable[..., Grade] = grade_soundness
        if degree:
            grade = partial(grade_scaling, power=degree * exponent)
        yield f"times 2^{exponent}", x * 2.0**exponent, grade


def _degree(scene: Scene, name: str, x: NDArray[Any]) -> int:
    """Return d if the loss is proportional to s^d when a parameter is multiplied by s, else 0."""
    values = [scene.value_or_nan(scene.at({name: scale * x})) for scale in (0.5, 1.0, 2.0)]
    low, high = np.diff(np.log2(np.abs(values)))
    is_monomial = abs(low - high) + abs(low - np.rint(low)) < 1e-12
    if is_monomial:
        return round(low)
    return 0


def legal_range(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List values within the range of a parameter, and one value outside on each side."""
    if name not in scene.ranges:
        return
    low, high = scene.ranges[name]
    values = np.linspace(low, high, 5)
    if _spans_decades(low, high):
        values = np.geomspace(low, high, 5)
    for value in values:
        yield f"all {value:.3g}", np.full_like(x, value), grade_soundness
    yield "below its range", np.full_like(x, 2 * low - high), grade_soundness
    yield "above its range", np.full_like(x, 2 * high - low), grade_soundness


def zeros_and_signs(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List 0 and the opposite sign. A time step must be positive; a viscosity may be 0."""
    yield "all 0", 0.0 * x, grade_refusal if name == scene.time_step else grade_soundness
    is_positive = name in (scene.time_step, scene.viscosity)
    yield "sign changed", -1.0 * x, grade_refusal if is_positive else grade_soundness


def jumps(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List arrays between the ends of their range, or over 8 decades around positive values."""
    has_range = name in scene.ranges
    if x.size <= 1 or not (has_range or np.all(x > 0)):
        return
    low, high = scene.ranges.get(name, (1e-4 * x, 1e4 * x))
    if has_range:
        words = f"{low:.3g} to {high:.3g}"
    else:
        words = "8 decades"
    share = np.random.default_rng(SEED).random(x.shape)
    if _spans_decades(low, high):
        between = low * (high / low) ** share
    else:
        between = low + (high - low) * share
    is_first_half = np.arange(x.size).reshape(x.shape) < x.size // 2
    yield f"jump, {words}", np.where(is_first_half, low, high), grade_soundness
    yield f"random, {words}", between, grade_soundness


def _spans_decades(low: Any, high: Any) -> bool:
    """Return whether values between two limits are spaced logarithmically: both are positive and far apart."""
    return bool(np.all(low > 0) and np.all(high > 10 * low))


def constants_added(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List added constants. Incompatible data of a singular system must not be amplified."""
    if x.size <= 1 or not np.any(x):
        return
    size = root_mean_square(x)
    amplification = partial(grade_nearness, note="amplified by {:.0e}: is a null space left in?")
    rounding = partial(amplification, good=GOOD_CHANGE, bad=LARGEST_CHANGE, unit=1e-14)
    yield "plus 1e-14 of itself", x + 1e-14 * size, rounding
    yield "plus 1e-07 of itself", x + 1e-7 * size, partial(amplification, good=1e-3, bad=0.1, unit=1e-7)
    yield "plus 1 of itself", x + size, grade_soundness


def not_finite(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List arrays in which the entry with the largest derivative is NaN or infinite."""
    if scene.base.refusal:
        return
    slopes = dict(zip(scene.leaves, scene.point.slopes(scene.base.gradient)))
    slope = np.abs(slopes.get(name, 0.0))
    if not np.max(slope, initial=0.0) > 0:
        return
    for bad in (nan, inf):
        with_bad_entry = np.array(x)
        with_bad_entry.flat[np.argmax(slope)] = bad
        yield f"one {bad}", with_bad_entry, partial(grade_refusal, located=True)


def kinds_of_arrays(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List the same values in other memory layouts and dtypes, and arrays for which an error is expected."""
    if not x.ndim:
        return
    for case, same in layouts(x).items():
        yield case, same, grade_nearness
    yield "float32", x.astype(np.float32), partial(grade_nearness, good=1e-4, bad=1e-2)
    for other in (np.resize(x, (len(x) + 1, *x.shape[1:])), x + 1j * x):
        yield f"shape {other.shape}, {other.dtype}", other, grade_refusal


def factors(scene: Scene, name: str, x: NDArray[Any]) -> Iterator[Case]:
    """List multiples of time step and viscosity."""
    if name not in (scene.time_step, scene.viscosity):
        return
    for factor in (1e-8, 1e-4, 1e-2, 1e-1, 1e1, 1e2, 1e4, 1e8):
        yield f"times {factor:g}", x * factor, grade_soundness


class Group(NamedTuple):
    """Cases of one kind.

    Attributes
    ----------
    cases : callable
        ``cases(scene, name, x)`` yields (case, changed value, grading function) for one parameter.
    reason : str
        Reason to report if the group has no case in a scene.
    only_legal : bool
        If True, values outside the range of a parameter are skipped, unless an error is expected for them.
    """

    cases: Callable[..., Iterator[Case]]
    reason: str
    only_legal: bool = False


WHOLE = "as given"  # the group for the whole scene: its cases change several parameters, given as a dict
GROUPS = {
    WHOLE: Group(as_given, ""),
    "scaling": Group(scalings, "every parameter is 0, or its range leaves no room", only_legal=True),
    "legal range": Group(legal_range, "no ranges were given; write ranges={'name': (low, high)}"),
    "zeros and signs": Group(zeros_and_signs, "outside the legal ranges", only_legal=True),
    "jumps": Group(jumps, "no array of positive numbers or with a range"),
    "constant added": Group(constants_added, "no array that is not 0", only_legal=True),
    "not finite": Group(not_finite, "the loss depends on no parameter"),
    "kinds of arrays": Group(kinds_of_arrays, "no arrays"),
    "time step and viscosity": Group(
        factors, "no parameter has such a name; write time_step='name', viscosity='name'", only_legal=True
    ),
}


def cases(scene: Scene, groups: Sequence[str]) -> Iterator[tuple[str, str, str, Callable[[], Grade]]]:
    """Yield (group, parameter, case, function that runs the case and returns its grade)."""
    for name in groups:
        group = GROUPS[name]
        if name == WHOLE:
            for case, changed, grade in group.cases(scene):
                yield name, "", case, partial(graded_run, grade, scene, changed)
            continue
        for parameter, x in scene.leaves.items():
            for case, value, grade in group.cases(scene, parameter, x):
                if not group.only_legal or grade is grade_refusal or scene.is_legal(parameter, value):
                    yield name, parameter, case, partial(graded_run, grade, scene, {parameter: value})
