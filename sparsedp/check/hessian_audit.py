"""Audits of products with a Hessian: by differences of a gradient, or by second differences of the loss."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.pytree import mapped, norm
from sparsedp.check.balanced_directions import balanced_direction
from sparsedp.check.derivative_audit import DerivativeAudit, Group, Options, accept
from sparsedp.check.derivative_places import Places
from sparsedp.check.direction_evidence import DirectionEvidence
from sparsedp.check.directions import examine_line
from sparsedp.check.entries import MOST_ENTRIES, largest_gaps, listed
from sparsedp.check.evaluations import FLOAT_TINY, Evaluations, Level, Line
from sparsedp.check.functionals import FunctionalEvaluations
from sparsedp.check.point import Point, audit_generator
from sparsedp.check.programs import Program

__all__ = ["GradientHessianAudit", "LossHessianAudit"]

SYMMETRY_SHARE = 1e-8  # a larger relative gap between <u, H v> and <v, H u> is an error
STEPS = tuple(2.0**-exponent for exponent in range(1, 28, 2))  # second differences need more of the coarse steps
NEGLIGIBLE_BEND = 1e-6  # a second derivative counts as 0 if it and its error bar are below this share of the loss
NOISE_FACTOR = 10.0  # a gap of an entry has to be this many times the rounding error of its measurement
EVEN_EPS = 4.0  # rounding error of f(x + t d) + f(x - t d) - 2 f(x), in units of eps |f|
HESSIAN_VERDICTS = {
    "agrees": "the Hessian agrees",
    "disagrees": "the Hessian disagrees, too",
    "inconclusive": "the check of the Hessian is inconclusive",
}


class GradientHessianAudit(DerivativeAudit):
    """The audit of a Hessian as the JVP of a gradient. The program is the gradient.

    The gradient is compared with differences of the loss first. If it is wrong, the Hessian is compared with second
    differences of the loss instead, so that the reason says which of them is wrong.

    Parameters
    ----------
    program : Program
        The gradient, with the Hessian products as its JVP.
    options : Options
    loss : Program
        The loss, with the Hessian products as its JVP.
    """

    def __init__(self, program: Program, options: Options, loss: Program) -> None:
        super().__init__(program, options, "jvp", False, "the Hessian")
        self.loss = loss

    def run(self) -> None:
        """Run the audit."""
        gradient = self._audit_of_gradient()
        if gradient is None or gradient.verdict != "disagrees":
            super().run()
            return
        hessian = LossHessianAudit(self.loss, replace(self.options, rng=audit_generator(None)))
        hessian.run()
        self.verdict = "disagrees"
        self.reason = (
            f"gradient(x) is not the gradient of f, {gradient.reason}; "
            f"compared with second differences of f, {HESSIAN_VERDICTS[hessian.verdict]}"
        )
        self.culprit = "the gradient and the Hessian" if hessian.verdict == "disagrees" else "the gradient"
        self.base = gradient.base
        self.groups = gradient.groups
        self.rows = gradient.rows
        self.gaps = gradient.gaps

    def _audit_of_gradient(self) -> DerivativeAudit | None:
        """Compare the gradient with differences of the loss. Return None if f is not a loss."""
        with np.errstate(all="ignore"):
            value = self.loss.start()
        if value.size != 1 or self.loss.f is self.program.f:
            return None

        def pull(tree: Any, g: Any) -> Any:
            factor = g.reshape(())
            return mapped(lambda leaf: leaf * factor, self.program.f(tree))

        program = Program(self.loss.f, self.loss.point.fresh(), pull)
        program.vjp_name = "gradient(x)"
        audit = DerivativeAudit(program, replace(self.options, rng=audit_generator(None)), "vjp", title="gradient(x)")
        audit.run()
        self.program.runs["f"] += sum(program.runs.values())
        return audit

    def examine(self) -> None:
        """Examine the products, and their symmetry."""
        super().examine()
        test_symmetry(self)


def test_symmetry(audit: DerivativeAudit) -> None:
    """Compare <u, H v> with <v, H u>."""
    if len(audit.pairs) < 2:
        return
    (u, Hu), (v, Hv) = audit.pairs
    if not np.all(np.isfinite([*Hu, *Hv])):
        return  # the audit says so
    size = max(norm(u * Hv), norm(v * Hu))
    difference = abs(float(u @ Hv) - float(v @ Hu))
    gap = difference / size if size else 0.0
    allowed = audit.allowed(SYMMETRY_SHARE)

    def asymmetry() -> float:
        return float(u @ audit.derivative(v)) - float(v @ audit.derivative(u))

    reason = f"the Hessian is not symmetric: <u, H v> and <v, H u> differ by {gap:.1e}"
    audit.compare("<u, H v> = <v, H u>", gap, allowed, asymmetry, size, reason)


class SecondDifferences(Line):
    """The function (f(x + t d) + f(x - t d) - 2 f(x)) / t of t, whose derivative at 0 is d . H d.

    It is odd in t, so that its central difference quotient is the second difference quotient of f.
    """

    def __init__(self, name: str, direction: NDArray[Any], evaluations: Evaluations, product: NDArray[Any]) -> None:
        super().__init__(name, direction, evaluations)
        self.slope = float(direction @ product)
        self.typical = norm(direction * product)
        self.loss = self.base
        self.base = 0.0

    def level(self, step: float) -> Level:
        """Evaluate the loss at x + t d and x - t d."""
        plus, _, note_ahead = self.end(step)
        minus, _, note_behind = self.end(-step)
        change = ((plus - self.loss) + (minus - self.loss)) / step
        return Level(step, change, -change, step * self.slope, -step * self.slope, note_ahead or note_behind)

    def rounding(self, steps: NDArray[Any], losses: NDArray[Any]) -> NDArray[Any]:
        """Return the rounding error of the second differences divided by the step."""
        sizes = np.maximum(abs(self.loss) + steps * np.max(np.abs(losses), axis=0, initial=0.0), FLOAT_TINY)
        return EVEN_EPS * self.evaluations.eps * sizes / steps


class LossHessianAudit(DerivativeAudit):
    """The audit of a Hessian by second differences of the loss. The program is the loss."""

    def __init__(self, program: Program, options: Options) -> None:
        super().__init__(program, options, "jvp", False, "the Hessian")

    def _steps(self) -> tuple[float, ...]:
        """Return the step sizes of a sweep."""
        return self.options.steps or STEPS

    def examine(self) -> None:
        """Examine d . H d along random directions at x and beside x, and the symmetry of H."""
        program = self.program
        if self.base.size != 1:
            raise ValueError("check.hessian needs a loss f(x) with one value, got several; give gradient=f instead")
        program.jvp_result = program.point
        first = self.point.random(self.options.rng)
        other = self.point.random(self.options.rng)
        products = [self.products(self.point, direction) for direction in (first, other)]
        self.pairs = [(self.tangent(first), products[0]), (self.tangent(other), products[1])]
        test_symmetry(self)
        directions = {"random 1": (first, products[0]), "random 2": (other, products[1])}
        self._examine_lines(self.point, self.base, directions)
        balanced = balanced_direction(self.point, None, self.options.rng)
        point, base = self.beside()
        name = "balanced" if point is self.point else "balanced, beside x"
        self._examine_lines(point, base, {name: (balanced, self.products(point, balanced))})

    def _examine_lines(
        self, point: Point, base: NDArray[Any], directions: dict[str, tuple[NDArray[Any], NDArray[Any]]]
    ) -> None:
        """Examine d . H d along directions from a point. Each direction comes with its product H d."""
        evaluations = FunctionalEvaluations(self._loss, point, None, self.like.steps)
        evaluations.base = float(base[0])
        evaluations.slopes = np.zeros(point.size)
        evaluations.eps = self.like.eps
        evaluations.loss_name = self.like.loss_name
        evaluations.gradient_name = self.like.gradient_name
        evaluations.digits_needed = self.like.digits_needed
        evaluations.may_extend = False
        group = Group(evaluations, np.ones(1))
        self.groups.append(group)
        for name, (direction, product) in directions.items():
            if not np.all(np.isfinite(product)):
                self.findings.append(("broken", "the Hessian product holds NaN or infinity"))
                continue
            evidence = examine_line(SecondDifferences(name, direction, evaluations, product))
            accept(evidence)
            if evidence.word == "noise" and evidence.scale + evidence.bar <= NEGLIGIBLE_BEND * abs(evaluations.base):
                evidence.word = "vanishes"
                evidence.note = "the second derivative is 0 to rounding, beside the loss"
            group.directions.append(evidence)

    def _loss(self, tree: Any) -> float:
        """Return the loss."""
        return float(self.program.value(tree)[0])

    def products(self, point: Point, direction: NDArray[Any]) -> NDArray[Any]:
        """Return H d at a point by the products under test."""
        return self.program.push(point.fresh(), self.tangent(direction))

    def difference_along(self, group: Group, evidence: DirectionEvidence, step: float) -> float:
        """Return the second difference quotient of the loss along a direction. The loss runs anew."""
        line = evidence.line
        return (
            SecondDifferences(line.name, line.direction, group.evaluations, 0 * line.direction).level(step).difference
        )

    def slope_along(self, group: Group, evidence: DirectionEvidence) -> float:
        """Return d . H d along a direction by the products under test."""
        line = evidence.line
        return float(line.direction @ self.products(line.point, line.direction))

    def places(self) -> Places:
        """Return the entries in which the Hessian is wrong: those of v with the largest gaps of <u, H v>.

        By second differences, <u, H v> is a quarter of the difference between the second derivatives along u + v and
        u - v.
        """
        assert self.worst is not None
        group, worst = self.worst
        line = worst.line
        point = group.evaluations.point
        units = point.units
        step = worst.step
        product = self.products(point, line.direction)

        def gap_along(weights: Any) -> float:
            v = units * np.concatenate([np.ravel(weight) for weight in weights])
            bends = []
            for direction in (line.direction + v, line.direction - v):
                level = SecondDifferences("entries", direction, group.evaluations, product).level(step)
                bends.append(level.plus / step)
            return (bends[0] - bends[1]) / 4 - float(product @ v)

        noise = NOISE_FACTOR * float(line.rounding(np.array([step]), np.zeros((2, 1)))[0]) / step
        gaps = largest_gaps(gap_along, [x.shape for x in point.values], MOST_ENTRIES, noise)
        return Places(listed(gaps, point, None, self.options.spaces), [], False, 0.0)
