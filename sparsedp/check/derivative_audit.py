"""Audit of a VJP or JVP of any program by finite differences, with few runs of the program.

For random weights w the loss <w, f(x)> is a scalar function, whose gradient is J^T w. Its derivative along d is
<J^T w, d> by a VJP, and <w, J d> by a JVP. Along each direction one sweep of steps serves all weights, so that a right
derivative takes about 40 runs of the program and its derivative.

Two directions and two weights are used. In random ones, large entries hide errors of small ones. In balanced ones all
entries have about the same share. The second direction starts at a point beside x: there a derivative is wrong that
uses a stored value of another point.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import norm
from sparsedp._utils.validation import place
from sparsedp.autodiff.derivative import unwarned
from sparsedp.check.direction_evidence import CONFIRMING_WORDS, DirectionEvidence, weigh
from sparsedp.check.directions import SHIFT, SHIFT_SEED, examine_line, reclassify_kinks
from sparsedp.check.entries import MOST_ENTRIES, gaps_along_entries, listed
from sparsedp.check.evaluations import EVALUATION_ERRORS, Evaluations, Line
from sparsedp.check.functionals import FunctionalEvaluations, Functionals, balanced_weights, leaf_weights
from sparsedp.check.loss_noise import measure_noise
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import LARGEST_SHARE, Point, audit_generator, root_mean_square
from sparsedp.check.programs import Program, WrongResult
from sparsedp.check.step_sizes import default_steps
from sparsedp.check.summary import Row

__all__ = ["DerivativeAudit", "Options"]

# Nine steps over eight decades. Single precision has the default steps.
STEPS = tuple(2.0**-exponent for exponent in (2, 6, 10, 14, 17, 20, 23, 26, 29))
FIRST_STEP = 2.0**-10  # step of the first difference
SHORT_SWEEP = (16.0, 4.0, 1.0, 0.25)  # multiples of the best step of the first sweep
NOISE_POINTS = 6
COMBINATION = 0.75, -1.25  # factors of the test of linearity
LINEAR_SHARE = 1e-5  # a larger relative gap of a linear combination is an error
LINEAR_EPS = 1e4  # the same in units of machine epsilon; matters in single precision
REPEATED_EPS = 1e3  # two runs of f may differ by this multiple of machine epsilon, if threads add in another order
REPEATED_SHARE = 1e-6  # a larger relative difference of two equal calls is an error
DUALITY_SHARE = 1e-6  # a larger gap between VJP and JVP is an error
RANGE = 1e3  # entries of a leaf are moved relative to their own size if their sizes differ by more than this factor
MOST_BALANCE = 1e4  # a balanced direction changes entries relative to each other by at most this factor


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

    Attributes
    ----------
    groups : list of Group
    findings : list of (str, str)
        (word, reason) of each problem that does not belong to a direction.
    rows : list of Row
        The tested identities.
    verdict, reason : str
    pairs : list of (ndarray, ndarray)
        Two tangents, and their products J t by the JVP.
    """

    def __init__(self, program: Program, options: Options, kind: str, both: bool = False) -> None:
        self.program = program
        self.options = options
        self.kind = kind
        self.both = both
        self.groups: list[Group] = []
        self.findings: list[tuple[str, str]] = []
        self.rows: list[Row] = []
        self.verdict = ""
        self.reason = ""
        self.gaps: tuple[str, ...] = ()
        self.worst: tuple[Group, DirectionEvidence] | None = None
        self.base: NDArray[Any] = np.empty(0)
        self.pairs: list[tuple[NDArray[Any], NDArray[Any]]] = []

    # ---------------------------------------------------------------- the audit

    def run(self) -> None:
        """Run the audit."""
        with unwarned(), np.errstate(all="ignore"):
            solves = thread.solves
            controlled = thread.controlled
            self.base = self.program.start()
            self.point = self.program.point
            if not np.all(np.isfinite(self.base)):
                self.findings.append(("unsound", self._non_finite("f(x)", self.base)))
            else:
                self.like = Evaluations(self.program.value, self.point, None, self._steps())
                self.like.may_extend = not self.options.steps
                self.like.eps = max(self.like.eps, self.program.result.eps)
                self.like.find_tolerances(self.program.value, solves, controlled)
                try:
                    self.examine()
                except WrongResult as error:
                    self.findings.append(("broken", str(error)))
            self.decide()
            if self.verdict == "disagrees" and self.worst is not None:
                self.find_entries()

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
        for leaf, values in zip(self.program.result.names, self.program.result.arrays(vector)):
            is_finite = np.isfinite(values)
            if not np.all(is_finite):
                where = ""
                if values.ndim:
                    where = f", the first at {place(int(np.argmin(is_finite)), values.shape)}"
                return f"{leaf.replace('f(x)', name, 1)} holds NaN or infinity{where}"
        return f"{name} holds NaN or infinity"

    def examine(self) -> None:
        """Examine the derivative at x and beside x, and test its identities."""
        rng = self.options.rng
        point = self.point
        first = point.random(rng)
        ends = self._ends(point, first, FIRST_STEP)
        change = np.zeros_like(self.base)
        if ends:
            change = (ends[0][1] - ends[1][1]) / (2 * FIRST_STEP)
        weights = [leaf_weights(self.program, self.base, change, rng)]
        if self.base.size > 1:
            weights.append(balanced_weights(self.program, self.base, change, rng))
        functionals = Functionals(self.program, point, self.base, weights)
        for tree, value in ends:
            functionals.store(tree, value)
        directions = {"random 1": first}
        for number in range(2, self.options.directions + 1):
            directions[f"random {number}"] = point.random(rng)
        step = self._examine_at(functionals, directions)
        if step is None:
            return
        self._examine_second_direction(weights[0], step)
        self._test_repetition(weights[0], first)
        if self.both:
            self._test_duality(weights[0], first)

    def _ends(self, point: Point, direction: NDArray[Any], step: float) -> list[tuple[Any, NDArray[Any]]]:
        """Return the trees on both sides of the point, with the values of the program; empty if one has no value."""
        ends = []
        with suppress(*EVALUATION_ERRORS):
            for side in (step, -step):
                tree = point.unpack(point.vector + side * direction)
                value = self.program.value(tree)
                if not np.all(np.isfinite(value)):
                    return []
                ends.append((tree, value))
            return ends
        return []

    def _examine_at(self, functionals: Functionals, directions: dict[str, NDArray[Any]]) -> float | None:
        """Examine all functionals along directions at x. Return the best step, or None if there are no slopes."""
        tree = self.point.fresh()
        slopes = self._slopes(functionals, directions)
        if slopes is None:
            return None
        self._products = slopes
        self._test_linearity(functionals, directions, slopes)
        for number, weights in enumerate(functionals.weights):
            group = Group(self._evaluations(functionals, number, slopes), weights)
            self.groups.append(group)
            for name, direction in directions.items():
                line = self._line(f"{name}, w {number + 1}", direction, group, slopes, tree)
                if name == "random 1":
                    self._measure_noise(line)
                group.directions.append(examine_line(line, search_ripples=name == "random 1" and number == 0))
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
                self.findings.append(("broken", self._non_finite("jvp(x, t)", slope)))
                return None
            slopes.append(slope)
        return dict(zip(directions, slopes))

    def _note_non_finite_cotangent(self, slope: NDArray[Any]) -> None:
        """Add a finding about the first NaN or infinity of a cotangent of x."""
        for name, values in zip(self.point.names, self.point.arrays(slope)):
            is_finite = np.isfinite(values)
            if not np.all(is_finite):
                where = ""
                if values.ndim:
                    where = f", the first at {place(int(np.argmin(is_finite)), values.shape)}"
                self.findings.append(("broken", f"vjp(x, g) holds NaN or infinity in {name}{where}"))

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
        weights = functionals.weights[number]

        def gradient(tree: Any) -> NDArray[Any]:
            return self.program.pull(tree, weights)

        return functionals.evaluations(number, slopes[number], gradient, self.like)

    def _line(self, name: str, direction: NDArray[Any], group: Group, slopes: Any, tree: Any) -> Line:
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
        """Measure the noise of a functional along a line."""
        noise, deviation = measure_noise(line, NOISE_POINTS)
        evaluations = line.evaluations
        evaluations.noise = max(noise, self.options.noise / evaluations.eps)
        evaluations.deviation = max(deviation, self.options.noise * abs(line.base))

    # ---------------------------------------------------------------- the second direction

    def _examine_second_direction(self, weights: NDArray[Any], step: float) -> None:
        """Examine a balanced direction at a point beside x, or at x if the program has no value there."""
        point, base = self.beside()
        functionals = Functionals(self.program, point, base, [weights])
        name = "balanced" if point is self.point else "balanced, beside x"
        if self.kind == "vjp":
            slope = self.program.pull(point.fresh(), weights)
            if not np.all(np.isfinite(slope)):
                self._note_non_finite_cotangent(slope)
                return
            direction = self.balanced(slope, None)
            slopes: Any = [slope]
        else:
            direction = self.balanced(np.zeros(self.point.size), None)
            slopes = {"balanced": self.program.push(point.fresh(), self.tangent(direction))}
        group = Group(self._evaluations(functionals, 0, slopes), weights)
        first = self.groups[0].evaluations
        group.evaluations.noise = first.noise
        group.evaluations.deviation = first.deviation
        self.groups.append(group)
        line = self._line(name, direction, group, slopes, point.fresh())
        line.sweep([factor * step for factor in SHORT_SWEEP])
        line.is_short = True
        evidence = weigh(line)
        if evidence.word not in CONFIRMING_WORDS:
            line.is_short = False
            evidence = examine_line(line)
        group.directions.append(evidence)

    def beside(self) -> tuple[Point, NDArray[Any]]:
        """Return a point beside x with the value of the program; x itself if there is none."""
        if self.options.beside:
            with suppress(*EVALUATION_ERRORS):
                shifted = self.point.vector + SHIFT * self.balanced(np.zeros(self.point.size), SHIFT_SEED)
                point = Point(self.point.unpack(shifted))
                value = self.program.value(point.fresh())
                if np.all(np.isfinite(value)):
                    return point, value
        return self.point, self.base

    def balanced(self, slopes: NDArray[Any], seed: int | None) -> NDArray[Any]:
        """Return a random direction along which all entries have about the same share of the derivative.

        An entry is moved by at most its unit. The unit of an entry is that of its leaf, or its own size if the sizes of
        the entries of the leaf differ much.
        """
        rng = self.options.rng if seed is None else audit_generator(seed)
        units = []
        for values, unit in zip(self.point.split(self.point.vector), self.point.split(self.point.units)):
            sizes = np.abs(values)
            known = sizes[sizes > 0]
            if known.size and np.quantile(known, 0.95) > RANGE * np.quantile(known, 0.05):
                sizes = np.where(sizes > 0, sizes, np.median(known))
                unit = np.minimum(sizes, unit)
            units.append(unit)
        unit = np.concatenate(units)
        shares = np.abs(slopes * unit)
        balance = np.ones(unit.size)
        if np.any(shares):
            smallest = max(float(np.min(shares[shares > 0])), float(np.max(shares)) / MOST_BALANCE)
            balance = smallest / np.maximum(shares, smallest)
        balance *= min(1 / root_mean_square(balance), LARGEST_SHARE)
        return unit * balance * rng.choice([-1.0, 1.0], unit.size) * rng.uniform(0.5, 1.5, unit.size)

    # ---------------------------------------------------------------- identities

    def allowed(self, share: float, eps_factor: float = LINEAR_EPS) -> float:
        """Return the allowed relative gap of an identity, for the precision of x and f(x) and the noise."""
        tolerance = max(self.like.tolerance, self.options.noise)
        return max(share, eps_factor * max(self.point.eps, self.program.result.eps), 10 * tolerance)

    def _test_linearity(self, functionals: Functionals, directions: dict[str, NDArray[Any]], slopes: Any) -> None:
        """Compare the derivative of a linear combination with the combination of the derivatives."""
        tree = self.point.fresh()
        a, b = COMBINATION
        if self.kind == "vjp":
            weights = functionals.weights
            if len(weights) > 1:
                combined = self.program.rounded(a * weights[0] / norm(weights[0]) + b * weights[1] / norm(weights[1]))
                terms = [a / norm(weights[0]) * slopes[0], b / norm(weights[1]) * slopes[1]]
            else:
                combined = self.program.rounded(b * weights[0])
                terms = [b * slopes[0]]
            found = self.program.pull(tree, combined)
            parts = [[self.point.split(term * self.point.units) for term in (*terms, found)]]
            argument = "g"
        else:
            (name, direction), *_ = directions.items()
            other = self.point.random(self.options.rng)
            product = self.program.push(tree, self.tangent(other))
            combined = self.tangent(a * direction + b * other)
            terms = [a * slopes[name], b * product]
            self.pairs = [(self.tangent(direction), slopes[name]), (self.tangent(other), product)]
            found = self.program.push(tree, combined)
            parts = [[self.program.result.split(term) for term in (*terms, found)]]
            argument = "t"
        gap = 0.0
        for leaf in zip(*parts[0]):
            *leaf_terms, value = leaf
            size = sum(norm(term) for term in leaf_terms)
            difference = norm(value - sum(leaf_terms))
            if difference:
                gap = max(gap, difference / size if size else inf)
        allowed = self.allowed(LINEAR_SHARE)
        self.rows.append(Row(f"linear in {argument}", gap, allowed, gap <= allowed))
        if not gap <= allowed:
            self.findings.append(("broken", f"{self.kind} is not linear in {argument}: it is off by {gap:.1e}"))

    def _test_repetition(self, weights: NDArray[Any], direction: NDArray[Any]) -> None:
        """Compare f(x) and its derivative with their first results, after runs at other points."""
        tree = self.point.fresh()
        again = self.program.value(tree)
        size = norm(self.base)
        gap = norm(again - self.base) / (size or 1.0)
        allowed = REPEATED_EPS * self.program.result.eps
        self.rows.append(Row("f(x) twice", gap, allowed, gap <= allowed))
        if not gap <= allowed:
            self.findings.append(("unsound", f"two runs of f(x) differ by {gap:.1e}: it is random or keeps a state"))
        for name, what in self.program.changed.items():
            call = {"f": "f(x)", "vjp": "vjp(x, g)", "jvp": "jvp(x, t)"}[name]
            self.findings.append(("broken", f"{call} changes {what} in place"))
        if self.kind == "vjp":
            first = self.groups[0].evaluations.slopes
            second = self.program.pull(tree, weights)
        else:
            first = self._first_product
            second = self.program.push(tree, self.tangent(direction))
        difference = norm(second - first)
        gap = 0.0
        if difference:
            gap = difference / max(norm(first), norm(second))
        allowed = self.allowed(REPEATED_SHARE)
        self.rows.append(Row(f"{self.kind} twice", gap, allowed, gap <= allowed))
        if not gap <= allowed:
            reason = f"two runs of {self.kind} at x differ by {gap:.1e}: it keeps a state of other runs, or is random"
            self.findings.insert(0, ("broken", reason))  # it explains why the VJP is not linear either

    def _test_duality(self, weights: NDArray[Any], direction: NDArray[Any]) -> None:
        """Compare <w, J d> by the JVP with <J^T w, d> by the VJP."""
        tree = self.point.fresh()
        if self.kind == "vjp":
            slope = self.groups[0].evaluations.slopes
            product = self.program.push(tree, self.tangent(direction))
        else:
            slope = self.program.pull(tree, weights)
            product = self._first_product
        forward = float(weights @ product)
        backward = float(slope @ self.tangent(direction))
        size = max(norm(weights * product), norm(slope * direction))
        gap = abs(forward - backward) / size if size else 0.0
        allowed = self.allowed(DUALITY_SHARE, LINEAR_EPS)
        self.rows.append(Row("<g, jvp(t)> = <vjp(g), t>", gap, allowed, gap <= allowed))
        if not gap <= allowed:
            self.findings.append(("broken", f"vjp is not the transpose of jvp: they differ by {gap:.1e}"))

    @property
    def _first_product(self) -> NDArray[Any]:
        """J d along the first direction by the JVP under test."""
        return self._products["random 1"]

    # ---------------------------------------------------------------- the verdict

    def decide(self) -> None:
        """Combine the verdicts of all functionals."""
        for group in self.groups:
            if group.evaluations.gradient is not None:
                reclassify_kinks(group.evaluations, group.directions)
        examined = [group for group in self.groups if group.directions]
        verdicts = [overall_verdict(group.directions, self.findings) for group in examined]
        if not verdicts:
            verdicts = [overall_verdict([], self.findings)]
        for wanted in ("disagrees", "inconclusive", "agrees"):
            for verdict, reason in verdicts:
                if verdict == wanted:
                    self.verdict = verdict
                    self.reason = reason
                    break
            if self.verdict:
                break
        for group in self.groups:
            for direction in group.directions:
                if direction.word in ("disagrees", "outside"):
                    share = direction.share if isfinite(direction.share) else inf
                    if self.worst is None or share > self.worst[1].share:
                        self.worst = group, direction

    # ---------------------------------------------------------------- places

    def find_entries(self) -> None:
        """Find the entries of x in which the derivative is wrong."""
        assert self.worst is not None
        group, _ = self.worst
        if self.kind == "vjp":
            found = gaps_along_entries(group.evaluations, group.directions, MOST_ENTRIES)
            point = group.evaluations.point
            self.gaps = tuple(listed(found, point, group.evaluations.slopes, self.options.spaces, self.kind))
