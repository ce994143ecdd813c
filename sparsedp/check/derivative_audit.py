"""Audit of a VJP or JVP of any program by finite differences, with few runs of the program.

For random weights w the loss <w, f(x)> is a scalar function, whose gradient is J^T w. Its derivative along d is
<J^T w, d> by a VJP, and <w, J d> by a JVP. Along each direction one sweep of steps serves all weights, so that a right
derivative takes about 40 runs of the program and its derivative.

Two directions and two weights are used. In random ones, large entries hide errors of small ones. In balanced ones all
entries have about the same share. The second direction starts at a point beside x: there a derivative is wrong that
uses a stored value of another point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf, isfinite, isnan, log10
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import norm
from sparsedp.autodiff.derivative import unwarned
from sparsedp.check.balanced_directions import (
    balanced_direction,
    has_wide_leaves,
    hidden_entries,
)
from sparsedp.check.derivative_places import Places, diagnosis_of, places_of
from sparsedp.check.derivative_review import review, rounds_in_single_precision
from sparsedp.check.direction_evidence import CONFIRMING_WORDS, UNDECIDED_WORDS, WRONG_WORDS, DirectionEvidence, weigh
from sparsedp.check.directions import SHIFT, SHIFT_SEED, examine_line, first_non_finite
from sparsedp.check.evaluations import EVALUATION_ERRORS, Evaluations, Line
from sparsedp.check.functionals import FunctionalEvaluations, Functionals, Pullback, balanced_weights, leaf_weights
from sparsedp.check.loss_noise import measure_noise, noise_of_entries, noise_steps
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import MOST_LEAVES, Point, audit_generator
from sparsedp.check.programs import Program, WrongResult
from sparsedp.check.rounding_modes import ROUNDING_FACTOR, UNBOUNDED_ERROR, rounding_error
from sparsedp.check.step_sizes import STEPS_BETWEEN, default_steps
from sparsedp.check.summary import Row
from sparsedp.check.thresholds import REVIEW

__all__ = ["DerivativeAudit", "Group", "Options", "accept"]

SINGLE_EPS = float(np.finfo(np.float32).eps)
# Nine steps over eight decades. Single precision has the default steps.
STEPS = tuple(2.0**-exponent for exponent in (2, 6, 10, 14, 17, 20, 23, 26, 29))
FIRST_STEP = 2.0**-10  # step of the first difference
SHORT_SWEEP = (16.0, 4.0, 1.0, 0.25)  # multiples of the best step of the first sweep
NOISE_POINTS = 6
COMBINATION = 0.75, -1.25  # factors of the test of linearity
LINEAR_EPS = 1e4  # allowed relative gap of an identity in units of machine epsilon; matters in single precision
REPEATED_EPS = 1e3  # two runs of f may differ by this multiple of machine epsilon, if threads add in another order
REPEATED_SHARE = 1e-6  # a larger relative difference of two equal calls is an error
DUALITY_SHARE = 1e-6  # a larger gap between VJP and JVP is an error
HIDDEN_EPS = 1e3  # a derivative that changes f(x) by less than this multiple of its rounding error is not examined
ACCEPTED_SHARE = 1e-4  # an undecided direction is accepted if gap and error bar are below this share of the derivative
MOST_HIDDEN_PARTS = 3
SMALL_SHARE = 1e-6  # a gap below this share may be the rounding error of an ill-conditioned solve,
SMALL_ENTRY_SHARE = 1e-5  # if it is spread over x and no entry is off by more than this share


def examined(line: Line, search_ripples: bool = False) -> DirectionEvidence:
    """Return the evidence along a line, with more steps around the plateau if there is no decision.

    A kink near x, or noise, leaves no Taylor order. A gap that is small on several neighbouring steps is accepted.
    """
    evidence = examine_line(line, search_ripples)
    if evidence.word in UNDECIDED_WORDS and evidence.step > 0 and line.evaluations.may_extend:
        line.sweep(evidence.step * STEPS_BETWEEN)
        finer = weigh(line)
        if finer.resolution < evidence.resolution or finer.word not in UNDECIDED_WORDS:
            evidence = finer
    accept(evidence)
    return evidence


def accept(evidence: DirectionEvidence) -> None:
    """Accept a direction without a Taylor order if its gap is small on several neighbouring steps."""
    if evidence.word in UNDECIDED_WORDS and evidence.is_close:
        if evidence.size + evidence.bar <= ACCEPTED_SHARE * evidence.scale:
            evidence.note = f"accepted with {evidence.digits:.1f} digits, although {evidence.note}"
            evidence.word = "agrees"


@dataclass
class Options:
    """Options of an audit of a derivative.

    Attributes
    ----------
    directions : int
        Number of random directions at x.
    steps : tuple of float
        Step sizes; empty for the default ones.
    rng : Generator
    spaces : sequence of Space
        Grid spaces that give the coordinates of entries.
    noise : float
        Relative noise of f that the caller knows of.
    beside : bool
        Whether the derivative is examined at a second point.
    """

    directions: int = 1
    steps: tuple[float, ...] = ()
    rng: np.random.Generator = field(default_factory=lambda: audit_generator(None))
    spaces: Sequence[Any] = ()
    noise: float = 0.0
    beside: bool = True


@dataclass
class Group:
    """One functional at one point, with the evidence along all directions examined there."""

    evaluations: FunctionalEvaluations
    weights: NDArray[Any]
    directions: list[DirectionEvidence] = field(default_factory=list)


class DerivativeAudit:
    """The state of an audit; its methods are the steps of the audit.

    Parameters
    ----------
    program : Program
    options : Options
    kind : "vjp" or "jvp"
        The derivative under test.
    both : bool
        Whether VJP and JVP are also compared with each other.
    title : str
        Name of the derivative in sentences. Default: its kind.

    Attributes
    ----------
    groups : list of Group
    findings : list of (str, str)
        (word, reason) of each problem that does not belong to a direction.
    rows : list of Row
        The tested identities.
    has_wide_leaves : bool
        Whether the sizes of the entries of a leaf differ much, so that balanced directions move them by relative steps.
    covered : float
        Share of the entries of x that contribute to the derivative along a balanced direction.
    verdict, reason : str
    gaps, result_gaps : tuple of str
        The wrong entries of x and of f(x). Empty unless the verdict is "disagrees".
    culprit : str or None
        The kind of the mistake if it is known.
    worst : (Group, DirectionEvidence) or None
        The direction with the largest gap, and its functional.
    base : ndarray
        f(x) as a vector.
    pairs : list of (ndarray, ndarray)
        Two vectors with their derivatives, see `derivative`.
    point : Point
    like : Evaluations
        The steps, tolerances, precision and names of all functionals.
    linear_gap : float
        Relative gap between the derivative of a linear combination of them and the combination of the derivatives.
    is_repeatable : bool
        Whether the derivative under test returns the same numbers for equal arguments.
    """

    def __init__(self, program: Program, options: Options, kind: str, both: bool = False, title: str = "") -> None:
        self.program = program
        self.options = options
        self.kind = kind
        self.title = title or kind
        self.both = both
        self.groups: list[Group] = []
        self.findings: list[tuple[str, str]] = []
        self.rows: list[Row] = []
        self.verdict = ""
        self.reason = ""
        self.gaps: tuple[str, ...] = ()
        self.result_gaps: tuple[str, ...] = ()
        self.culprit: str | None = None
        self.worst: tuple[Group, DirectionEvidence] | None = None
        self.base: NDArray[Any] = np.empty(0)
        self.pairs: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self.linear_gap = 0.0
        self.is_repeatable = True
        self.point = program.point  # `run` may replace it, for functions of NumPy arrays that use another library
        self.like = Evaluations(program.value, program.point, None)
        self._products: Any = None
        self.has_wide_leaves = False
        self.covered = 1.0

    # ---------------------------------------------------------------- the audit

    def run(self) -> None:
        """Run the audit."""
        with unwarned(), np.errstate(all="ignore"):
            solves = thread.solves
            controlled = thread.controlled
            self.base = self.program.start()
            self.point = self.program.point
            if not self.point.size or not self.base.size:
                empty = self.program.value_name if self.point.size else "x"
                self.findings.append(("unsound", f"{empty} has no entries, so there is no derivative to check"))
            elif not np.all(np.isfinite(self.base)):
                self.findings.append(("unsound", self._non_finite(self.program.value_name, self.base)))
            else:
                self.like = Evaluations(self.program.value, self.point, None, self._steps())
                self.like.loss_name = self.program.value_name
                self.like.gradient_name = self.title
                self.like.digits_needed = round(-log10(ACCEPTED_SHARE))
                self.like.may_extend = not self.options.steps
                self.like.eps = max(self.like.eps, self.program.result.eps)
                self.like.find_tolerances(self.program.value, solves, controlled)
                try:
                    self.examine()
                except WrongResult as error:
                    self.findings.append(("broken", str(error)))
            self.decide()
            if self.verdict == "disagrees" and self.worst is not None:
                self.find_places()

    def _steps(self) -> tuple[float, ...]:
        """Return the step sizes of a sweep."""
        if self.options.steps:
            return self.options.steps
        eps = max(self.point.eps, self.program.result.eps)
        if eps < 1e-10:
            return STEPS
        return default_steps(eps)

    def _non_finite(self, name: str, vector: NDArray[Any]) -> str:
        """Return a sentence about the first NaN or infinity of a vector in the structure of f(x)."""
        result = self.program.result
        for leaf, values in zip(result.names_under(name), result.arrays(vector)):
            if not np.all(np.isfinite(values)):
                return f"{leaf} holds NaN or infinity{first_non_finite(values)}"
        return f"{name} holds NaN or infinity"

    def examine(self) -> None:
        """Examine the derivative at x and beside x, and test its identities."""
        rng = self.options.rng
        point = self.point
        first = point.random(rng)
        directions = {"random 1": first}
        self.has_wide_leaves = has_wide_leaves(point)
        if self.has_wide_leaves:
            directions = {"random 1": balanced_direction(point, None, rng), "absolute": first}
            first = directions["random 1"]
        ends = self._values(point, first, (FIRST_STEP, -FIRST_STEP))
        change = np.zeros_like(self.base)
        if ends:
            change = (ends[0][1] - ends[1][1]) / (2 * FIRST_STEP)
        neighbours = self._values(point, first, noise_steps(point, NOISE_POINTS))
        noise = noise_of_entries([value for _, value in neighbours], self.base)
        weights = [leaf_weights(self.program, self.base, change, rng)]
        if self.base.size > 1:
            weights.append(balanced_weights(self.program, self.base, change, noise, rng))
        functionals = Functionals(self.program, point, self.base, weights)
        for tree, value in ends + neighbours:
            functionals.store(tree, value)
        for number in range(2, self.options.directions + 1):
            directions[f"random {number}"] = point.random(rng)
        step = self._examine_at(functionals, directions)
        if step is None:
            return
        self._examine_second_direction(weights[-1], step)
        self._test_repetition(weights[0], first)
        if self.both:
            self._test_duality(weights[0], first)

    def _values(self, point: Point, direction: NDArray[Any], steps: Sequence[float]) -> list[tuple[Any, NDArray[Any]]]:
        """Return the trees x + step d with the values of the program; empty if one of them has no finite value."""
        values = []
        with suppress(*EVALUATION_ERRORS):
            for step in steps:
                tree = point.unpack(point.vector + step * direction)
                value = self.program.value(tree)
                if not np.all(np.isfinite(value)):
                    return []
                values.append((tree, value))
            return values
        return []

    def _examine_at(self, functionals: Functionals, directions: dict[str, NDArray[Any]]) -> float | None:
        """Examine all functionals along directions at x. Return the best step, or None if there are no slopes."""
        slopes = self._slopes(functionals, directions)
        if slopes is None:
            return None
        self._products = slopes
        self._test_linearity(functionals, directions, slopes)
        for number, weights in enumerate(functionals.weights):
            group = Group(self._evaluations(functionals, number, slopes), weights)
            self.groups.append(group)
            for name, direction in directions.items():
                line = self._line(f"{name}, w {number + 1}", direction, group, slopes)
                if name == "random 1":
                    self._measure_noise(line)
                group.directions.append(examined(line, search_ripples=name == "random 1" and number == 0))
        step = self.groups[0].directions[0].step
        if step > 0:
            return step
        return FIRST_STEP

    def _slopes(self, functionals: Functionals, directions: dict[str, NDArray[Any]]) -> Any:
        """Return J^T w for each functional by the VJP, or J d for each direction by the JVP; None if not finite."""
        tree = functionals.point.fresh()
        slopes: list[NDArray[Any]] = []
        if self.kind == "vjp":
            for weights in functionals.weights:
                slope = self.program.pull(tree, weights)
                if not np.all(np.isfinite(slope)):
                    self._note_non_finite_cotangent(slope)
                    return None
                slopes.append(slope)
            return slopes
        for direction in directions.values():
            slope = self.program.push(tree, self.tangent(direction))
            if not np.all(np.isfinite(slope)):
                self._note_non_finite_product(slope)
                return None
            slopes.append(slope)
        return dict(zip(directions, slopes))

    def _note_non_finite_cotangent(self, slope: NDArray[Any]) -> None:
        """Add a finding about the first NaN or infinity of a cotangent of x."""
        for name, values in zip(self.point.names, self.point.arrays(slope)):
            if not np.all(np.isfinite(values)):
                where = first_non_finite(values)
                self.findings.append(("broken", f"{self.program.vjp_name} holds NaN or infinity in {name}{where}"))

    def _note_non_finite_product(self, product: NDArray[Any]) -> None:
        """Add a finding about the first NaN or infinity of a JVP."""
        self.findings.append(("broken", self._non_finite(self.program.jvp_name, product)))

    def tangent(self, direction: NDArray[Any]) -> NDArray[Any]:
        """Return a direction, rounded to the dtypes of x."""
        return np.concatenate([np.ravel(part).astype(float) for part in self._real_parts(direction)])

    def _real_parts(self, direction: NDArray[Any]) -> list[NDArray[Any]]:
        """Return the leaves of a direction as real arrays, rounded to the dtypes of x."""
        return [np.ravel(part).view(part.real.dtype) for part in self.point.arrays(direction)]

    def _evaluations(self, functionals: Functionals, number: int, slopes: Any) -> FunctionalEvaluations:
        """Return the evaluations of a functional, with the gradient under test if there is a VJP."""
        if self.kind == "jvp":
            return functionals.evaluations(number, np.zeros(self.point.size), None, self.like)
        gradient = Pullback(self.program, functionals.weights[number])
        return functionals.evaluations(number, slopes[number], gradient, self.like)

    def _line(self, name: str, direction: NDArray[Any], group: Group, slopes: Any) -> Line:
        """Return the line of a functional along a direction.

        With a JVP only the derivative along the direction is known. The line then has the vector in the direction of d
        (in units of x) whose product with d is this derivative.
        """
        if self.kind == "vjp":
            return Line(name, direction, group.evaluations)
        product = slopes[name.partition(",")[0]]
        line = Line(name, direction, group.evaluations)
        line.slope = float(group.weights @ product)
        line.gradient = self._gradient_along(direction, line.slope)
        line.typical = norm(group.weights * product)
        return line

    def _gradient_along(self, direction: NDArray[Any], slope: float) -> NDArray[Any]:
        """Return a vector whose product with a direction is `slope`."""
        units = np.where(self.point.units > 0, self.point.units, 1.0)
        shares = direction / units
        return slope * (shares / (shares @ shares)) / units

    def _measure_noise(self, line: Line) -> None:
        """Measure the noise of a functional along a line. It is not smaller than that along other lines."""
        noise, deviation = measure_noise(line, NOISE_POINTS)
        evaluations = line.evaluations
        evaluations.noise = max(evaluations.noise, noise, self.options.noise / evaluations.eps)
        evaluations.deviation = max(evaluations.deviation, deviation, self.options.noise * abs(line.base))

    # ---------------------------------------------------------------- the second direction

    def _examine_second_direction(self, weights: NDArray[Any], step: float) -> None:
        """Examine a balanced direction at a point beside x, or at x if the program has no value there.

        Entries whose errors are hidden along this direction are examined along a direction of their own.
        """
        point, base = self.beside()
        functionals = Functionals(self.program, point, base, [weights])
        suffix = "" if point is self.point else ", beside x"
        slope = None
        if self.kind == "vjp":
            slope = self.program.pull(point.fresh(), weights)
            if not np.all(np.isfinite(slope)):
                self._note_non_finite_cotangent(slope)
                return
        group = Group(self._evaluations(functionals, 0, [slope]), weights)
        first = self.groups[0].evaluations
        group.evaluations.noise = first.noise
        group.evaluations.deviation = first.deviation
        self.groups.append(group)
        direction = balanced_direction(point, slope, self.options.rng)
        group.directions.append(self._short_evidence(f"balanced{suffix}", direction, group, step))
        if slope is None:
            parts = self._leaf_directions(point)
        else:
            parts = self._hidden_parts(point, slope, direction)
        for name, part in parts.items():
            group.directions.append(self._short_evidence(f"{name}{suffix}", part, group, step))

    def _short_evidence(self, name: str, direction: NDArray[Any], group: Group, step: float) -> DirectionEvidence:
        """Return the evidence from a few steps around the best step of the first sweep; from more if needed."""
        slopes: Any = None
        if self.kind == "jvp":
            product = self.program.push(group.evaluations.point.fresh(), self.tangent(direction))
            if not np.all(np.isfinite(product)):
                self._note_non_finite_product(product)
            slopes = {name.partition(",")[0]: product}
        line = self._line(name, direction, group, slopes)
        line.sweep([factor * step for factor in SHORT_SWEEP])
        line.is_short = True
        evidence = weigh(line)
        if evidence.word not in CONFIRMING_WORDS:
            line.is_short = False
            self._measure_noise(line)
            evidence = examined(line)
        return evidence

    def _leaf_directions(self, point: Point) -> dict[str, NDArray[Any]]:
        """Return a direction in each leaf, by name, if there are several. By a JVP the shares are not known."""
        if not 1 < len(point.values) <= MOST_LEAVES:
            return {}
        random = point.random(self.options.rng)
        leaf = np.repeat(np.arange(len(point.values)), [part.size for part in point.split(random)])
        directions = {}
        for number, name in enumerate(point.names):
            if np.any(random[leaf == number]):
                directions[f"random in {name}"] = random * (leaf == number)
        return directions

    def _hidden_parts(self, point: Point, slope: NDArray[Any], direction: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return directions, by name, in the entries whose errors are hidden along a direction."""
        parts: dict[str, NDArray[Any]] = {}
        hidden = hidden_entries(point, slope, direction)
        for group in self.groups[:-1]:  # with other weights: a small entry of J^T w is often small by chance
            hidden &= hidden_entries(point, group.evaluations.slopes, direction)
        while np.any(hidden) and len(parts) < MOST_HIDDEN_PARTS:
            part = np.zeros(direction.size)
            part[hidden] = balanced_direction(point, np.where(hidden, slope, 0.0), self.options.rng)[hidden]
            parts[f"hidden entries {len(parts) + 1}"] = part
            hidden = hidden & hidden_entries(point, slope, part) & (slope != 0)
        self.covered = 1.0 - float(np.mean(hidden))
        return parts

    def beside(self) -> tuple[Point, NDArray[Any]]:
        """Return a point beside x with the value of the program; x itself if there is none."""
        if self.options.beside:
            with suppress(*EVALUATION_ERRORS):
                shifted = self.point.vector + SHIFT * balanced_direction(self.point, None, audit_generator(SHIFT_SEED))
                point = Point(self.point.unpack(shifted))
                value = self.program.value(point.fresh())
                if np.all(np.isfinite(value)):
                    return point, value
        return self.point, self.base

    # ---------------------------------------------------------------- identities

    def allowed(self, share: float, eps_factor: float = LINEAR_EPS) -> float:
        """Return the allowed relative gap of an identity, for the precision of x and f(x) and the noise."""
        tolerance = max(self.like.tolerance, self.options.noise)
        return max(share, eps_factor * max(self.point.eps, self.program.result.eps), 10 * tolerance)

    def derivative(self, vector: NDArray[Any]) -> NDArray[Any]:
        """Return the derivative under test of a vector at x: J^T vector in units of x, or J vector."""
        tree = self.point.fresh()
        if self.kind == "vjp":
            slope = self.program.pull(tree, vector)
            if not np.all(np.isfinite(slope)):
                self._note_non_finite_cotangent(slope)
            return slope * self.point.units
        product = self.program.push(tree, vector)
        if not np.all(np.isfinite(product)):
            self._note_non_finite_product(product)
        return product

    def difference_along(self, group: Group, evidence: DirectionEvidence, step: float) -> float:
        """Return the central difference quotient of a functional along a direction. The program runs anew."""
        line = evidence.line
        ends = [
            self.program.value(line.point.unpack(line.point.vector + side * line.direction)) for side in (step, -step)
        ]
        return float(group.weights @ (ends[0] - ends[1])) / (2 * step)

    def functional(self, group: Group, evidence: DirectionEvidence) -> float:
        """Return a functional at the point of a direction. The program runs anew."""
        change = self.program.value(evidence.line.point.fresh()) - self.base
        return float(group.weights @ change)

    def slope_along(self, group: Group, evidence: DirectionEvidence) -> float:
        """Return the derivative of a functional along a direction by the derivative under test. It runs anew."""
        line = evidence.line
        tree = line.point.fresh()
        if self.kind == "vjp":
            return float(self.program.pull(tree, group.weights) @ line.direction)
        return float(group.weights @ self.program.push(tree, self.tangent(line.direction)))

    def hidden_sizes(self, vector: NDArray[Any]) -> list[float]:
        """Return for each leaf the size below which an error of `derivative` is hidden by the rounding of f."""
        eps = HIDDEN_EPS * self.like.eps
        if self.kind == "vjp":
            return [eps * norm(vector * self.base)] * len(self.point.values)
        return [eps * norm(part) for part in self.program.result.split(self.base)]

    def relative_gap(self, result: NDArray[Any], terms: Sequence[NDArray[Any]], vector: NDArray[Any]) -> float:
        """Return the largest relative gap between a result of `derivative` and a sum of others, over all leaves.

        It is infinite if the result contains NaN.
        """
        split = self.point.split if self.kind == "vjp" else self.program.result.split
        parts = zip(split(result), *(split(term) for term in terms))
        gap = 0.0
        for hidden, (value, *leaf_terms) in zip(self.hidden_sizes(vector), parts):
            size = sum(norm(term) for term in leaf_terms)
            difference = norm(value - sum(leaf_terms))
            if isnan(difference):
                return inf
            if difference > hidden:
                gap = max(gap, difference / size if size else inf)
        return gap

    def _test_linearity(self, functionals: Functionals, directions: dict[str, NDArray[Any]], slopes: Any) -> None:
        """Compare the derivative of a linear combination with the combination of the derivatives."""
        a, b = COMBINATION
        if self.kind == "vjp":
            vectors = [weights / norm(weights) for weights in functionals.weights]
            results = [slope * self.point.units / norm(weights) for slope, weights in zip(slopes, functionals.weights)]
            if len(vectors) == 1:  # f(x) is one number
                vectors += vectors
                results += results
            combined = self.program.rounded(a * vectors[0] + b * vectors[1])
        else:
            (name, direction), *_ = directions.items()
            vectors = [self.tangent(direction), self.tangent(self.point.random(self.options.rng))]
            results = [slopes[name], self.derivative(vectors[1])]
            combined = self.tangent(a * vectors[0] + b * vectors[1])
        self.pairs = list(zip(vectors, results))
        result = self.derivative(combined)
        self.linear_gap = self.relative_gap(result, [a * results[0], b * results[1]], combined)
        allowed = self.allowed(REVIEW.linear_share)
        name = f"linear in {self.program.argument_of(self.kind)}"
        self.rows.append(Row(name, self.linear_gap, allowed, self.linear_gap <= allowed))

    def _test_repetition(self, weights: NDArray[Any], direction: NDArray[Any]) -> None:
        """Compare f(x) and its derivative with their first results, after runs at other points.

        The derivative comes first: if it uses a state of the last run of f, that was a run at another point.
        """
        vector = weights if self.kind == "vjp" else self.tangent(direction)
        first = self.groups[0].evaluations.slopes * self.point.units if self.kind == "vjp" else self._first_product
        gap = self.relative_gap(self.derivative(vector), [first], vector)
        allowed = self.allowed(REPEATED_SHARE)
        self.rows.append(Row(f"{self.title} twice", gap, allowed, gap <= allowed))
        self.is_repeatable = gap <= allowed
        if not self.is_repeatable:
            reason = f"two runs of {self.title} at x differ by {gap:.1e}: it keeps a state of other runs, or is random"
            self.findings.insert(0, ("broken", reason))  # it explains why the VJP is not linear either
        again = self.program.value(self.point.fresh())
        size = norm(self.base)
        gap = norm(again - self.base) / (size or 1.0)
        allowed = REPEATED_EPS * self.program.result.eps
        self.rows.append(Row(f"{self.program.value_name} twice", gap, allowed, gap <= allowed))
        if not gap <= allowed:
            reason = f"two runs of {self.program.value_name} differ by {gap:.1e}: it is random or keeps a state"
            self.findings.append(("unsound", reason))
        calls = {"f": self.program.value_name, "vjp": self.program.vjp_name, "jvp": self.program.jvp_name}
        for name, what in self.program.changed.items():
            self.findings.append(("broken", f"{calls[name]} changes {what} in place"))

    def _test_duality(self, weights: NDArray[Any], direction: NDArray[Any]) -> None:
        """Compare <w, J d> by the JVP with <J^T w, d> by the VJP."""
        tangent = self.tangent(direction)
        tree = self.point.fresh()
        if self.kind == "vjp":
            slope = self.groups[0].evaluations.slopes
            product = self.program.push(tree, tangent)
            if not np.all(np.isfinite(product)):
                self._note_non_finite_product(product)
                return
        else:
            slope = self.program.pull(tree, weights)
            product = self._first_product
            if not np.all(np.isfinite(slope)):
                self._note_non_finite_cotangent(slope)
                return

        def difference() -> float:
            tree = self.point.fresh()
            forward = float(weights @ self.program.push(tree, tangent))
            return forward - float(self.program.pull(tree, weights) @ tangent)

        gap = abs(float(weights @ product) - float(slope @ tangent))
        size = max(norm(weights * product), norm(slope * direction))
        if gap <= HIDDEN_EPS * self.like.eps * norm(weights * self.base):
            gap = 0.0
        allowed = self.allowed(DUALITY_SHARE, LINEAR_EPS)
        if gap:
            gap = gap / size
        reason = f"vjp is not the transpose of jvp: they differ by {gap:.1e}"
        self.compare("<g, jvp(t)> = <vjp(g), t>", gap, allowed, difference, size, reason)

    def compare(
        self, name: str, gap: float, allowed: float, difference: Callable[[], float], size: float, reason: str
    ) -> None:
        """Add the row of an identity, and a finding if the gap is larger than allowed and than rounding errors.

        Parameters
        ----------
        name : str
            The identity.
        gap, allowed : float
            Relative to `size`.
        difference : callable
            Computes the gap anew, not divided by `size`.
        size : float
        reason : str
            Of the finding.
        """
        error = 0.0
        if gap > allowed:
            error = self.rounding_error(difference)
            if isfinite(error):
                allowed = max(allowed, ROUNDING_FACTOR * error / size)
        self.rows.append(Row(name, gap, allowed, gap <= allowed))
        if gap <= allowed:
            return
        if isfinite(error):
            self.findings.append(("broken", reason))
        else:
            self.findings.append(("unsound", f"{reason}, but {UNBOUNDED_ERROR}"))

    def rounding_error(self, function: Callable[[], float]) -> float:
        """Return the largest change of a number that the program computes in other rounding modes."""
        return rounding_error(function, self.in_single_precision)

    @property
    def in_single_precision(self) -> bool:
        """Whether x or f(x) is in single precision."""
        return max(self.point.eps, self.program.result.eps) > SINGLE_EPS / 2

    @property
    def _first_product(self) -> NDArray[Any]:
        """J d along the first direction by the JVP under test."""
        return self._products["random 1"]

    # ---------------------------------------------------------------- the verdict

    def decide(self) -> None:
        """Combine the verdicts of all functionals."""
        review(self)
        with_directions = [group for group in self.groups if group.directions]
        verdicts = [
            overall_verdict(directions, self.findings, self.program.value_name, self.title)
            for directions in [group.directions for group in with_directions] or [[]]
        ]
        for severest in ("disagrees", "inconclusive", "agrees"):
            for verdict, reason in verdicts:
                if verdict == severest:
                    self.verdict = verdict
                    self.reason = reason
                    break
            if self.verdict:
                break
        for group in self.groups:
            for direction in group.directions:
                if direction.word in WRONG_WORDS:
                    share = direction.share if isfinite(direction.share) else inf
                    if self.worst is None or share > self.worst[1].share:
                        self.worst = group, direction

    def find_places(self) -> None:
        """Find the entries in which the derivative is wrong, and the kind of the mistake."""
        self.culprit = diagnosis_of(self)
        places = self.places()
        self.gaps = tuple(places.in_argument)
        self.result_gaps = tuple(places.in_result)
        assert self.worst is not None
        is_small = self.worst[1].share <= SMALL_SHARE and places.relative_gap <= SMALL_ENTRY_SHARE
        is_explained = self.culprit is not None or self.findings or not places.is_spread
        if self.kind == "vjp" and is_small and not is_explained and rounds_in_single_precision(self):
            self.culprit = "it rounds values to single precision"
        elif self.kind == "vjp" and is_small and not is_explained:
            self.verdict = "inconclusive"
            self.reason += ": all entries are off by so little that rounding errors of an ill-conditioned f may do it"

    def places(self) -> Places:
        """Return the entries in which the derivative is wrong."""
        return places_of(self)
