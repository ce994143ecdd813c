"""The audit of a gradient: differences over many step sizes, Taylor orders, determinism, forward against reverse."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from math import inf, isinf, isnan
from typing import Any

import numpy as np

from sparsedp._utils.progress import bar
from sparsedp._utils.validation import check_function, check_whole
from sparsedp.autodiff.derivative import grad, unwarned
from sparsedp.check.audit_thresholds import THRESHOLDS
from sparsedp.check.culprit import culprit_of
from sparsedp.check.direction_evidence import PROVED, DirectionEvidence
from sparsedp.check.directions import RANDOM_DIRECTIONS, examine_directions, excuse_kinks
from sparsedp.check.entries import MOST_ENTRIES, gaps_along_entries, listed, spaces_of
from sparsedp.check.evaluations import Evaluations
from sparsedp.check.loss_noise import POINTS
from sparsedp.check.other_derivatives import check_complex_step, check_hessian_product, compare_modes
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import QUICK_DIRECTIONS, Point, audit_generator
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of

__all__ = ["Audit", "gradient"]

FEWEST_STEPS = 8
NOT_EXAMINED = "other directions, single leaves and entries, complex steps and the Hessian product were not looked at"


def gradient(
    loss: Callable[[Any], Any],
    x: Any,
    gradient: Any = None,
    steps: Sequence[float] | None = None,
    directions: int = RANDOM_DIRECTIONS,
    rng: int | np.random.Generator | None = None,
    quick: bool = False,
) -> Audit:
    """Audit the gradient of a loss at x: compare it with differences of the loss and with other derivatives.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. Any function: of this library, of autograd, or foreign (then give `gradient`).
    x : array, number, or any nesting of them in tuples, lists and dicts
        At least one floating leaf, real or complex, float32 or float64. Never modified.
    gradient : callable or tree, optional
        ``gradient(x)``, or its value, with the structure of `x`. Default: reverse mode through the tape. For a
        complex leaf it is dL/dRe - i dL/dIm, as on the tape.
    steps : sequence of float, optional
        Step sizes in units of x (the root mean square of each leaf), at least eight. Default: ten over
        eight decades, and more on a line where they leave the derivative undecided.
    directions : int
        Number of random directions. Structured ones are added: each leaf alone, constant, the gradient itself,
        its largest entry.
    rng : None, int or numpy Generator
        Source of the directions; default: a fixed seed.
    quick : bool
        One random direction and the gradient itself, for a loss that takes minutes. The reason lists what was not
        examined, also where the gradient agrees: other random directions, single leaves and entries, complex steps,
        the Hessian product.

    Returns
    -------
    Audit
        `.verdict` is "agrees" (with `.digits`), "disagrees" or "inconclusive" (with `.reason`); true only
        for "agrees", so that ``assert dp.check.gradient(loss, x)`` works. `.rows` are the numbers,
        `.lines` the result for each direction, str() the table, `.to_dict()` plain data.

    Raises
    ------
    ValueError
        If `steps` are fewer than eight, or not positive, or `directions` is no whole number >= 0.
    DerivativeError
        If x has no floating leaf, or the gradient does not have the structure of x.
    NonFiniteError
        If x holds NaN or infinity.

    See Also
    --------
    value_and_grad, differentiable, certify, stress, v_curve, check.order

    Notes
    -----
    Conditions for agreement along every direction. The gap between differences and gradient is at most 1e-8 of the
    derivative, or the error bar of the sweep where that is larger (1e-6 behind a solve, or in measured noise of
    1e-10). Taylor remainders: f(x + t d) - f has order 1 +- 0.05 in t; with the gradient subtracted, the order is
    1.95 or more on every pair of steps, from at least three steps at which the remainder is 100 times the noise. With
    one or two, or with a lower order, the verdict is inconclusive, however small the gap. Two cases have no order,
    and the gap alone decides: the remainder is noise on all steps (a linear loss: order 2 is "exact"), and a slope so
    small that the loss bends before it climbs (near a minimum, or in the kernel of a Laplacian: no order 1).
    Forward and reverse mode differ by at most 1e-10, and 1e-6 behind a solve or in noise. All thresholds are in
    `sparsedp.check.audit_thresholds`.

    Noise is measured by a table of differences of neighbouring values. Where it is more than rounding, agreement
    needs six digits; with fewer the verdict is inconclusive and says how many there are. A ripple (a part of the loss
    that is small, with a derivative that is not) is inconclusive too: where fine steps show another derivative than
    coarse ones, or the gradient itself varies within steps that the noise hides. A ripple below the rounding of the
    loss that the gradient does not contain either cannot be detected. A loss that is 0 to rounding, with a gradient
    that is rounding, is inconclusive.

    The Hessian product along the first direction is examined by the third Taylor remainder, of order 2.9 or more:
    `.hessian` and a note give the result. The verdict, which is about the gradient, does not depend on it.

    Cost: two evaluations of the loss for each step and direction (100 to 200 in all, about 60 in a quick audit), and
    a few gradients. On a terminal, standard error shows how many evaluations are expected, with a bar if tqdm is
    installed. Where the verdict is "disagrees", the entries with the largest gaps are found by bisection, with about
    2 log2(n) more evaluations for each of three (one in a quick audit), and the calls on the tape are examined one by
    one for the culprit: seconds for most losses, minutes where a loss takes a thousand implicit steps.

    A `stepper` with a `tolerance` is differentiable to that tolerance, not to rounding: its gradient differs from that
    of the value it returns by a few tolerances. Where the gap is at most ten tolerances, and no other call is at
    fault, the verdict is "inconclusive" and says so. Check such a loss with a fixed dt, or with a tolerance of 1e-9.

    Detection limits, as shares of the gradient. An error in all entries: 1e-8 or less where the loss is smooth, 1e-6
    behind an iterative solve or in noise, ten tolerances of time steps with error control where no call is at fault,
    1e-4 in single precision. A single wrong entry of n counts by its share of the derivative along the examined
    directions, which include its own where it is the largest.

    Everything is relative: a loss times 1e-200 or 1e200 has the same verdict. A loss that refuses a trial
    point (unstable step, no convergence, not finite, a ValueError) makes that step unusable. At a kink
    central differences prove nothing, and the verdict is inconclusive.

    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> x = np.array([1.0, 2.0])
    >>> gradient(lambda u: anp.sum(u**3), x).verdict
    'agrees'
    >>> gradient(lambda u: np.sum(u**3), x, gradient=lambda u: 3.003 * u**2).verdict
    'disagrees'
    """
    check_function("check.gradient", loss, "lambda x: np.sum(x**2)")
    count = check_whole("directions of check.gradient", directions, 0, "; the default is 3")
    chosen_steps: tuple[float, ...] = ()
    if steps is not None:
        chosen_steps = tuple(map(float, steps))
        is_positive = all(0 < step < inf for step in chosen_steps)
        if len(set(chosen_steps)) < FEWEST_STEPS or not is_positive:
            raise ValueError(f"a sweep needs at least {FEWEST_STEPS} different positive steps, got {chosen_steps}")
    point = Point(x)
    is_wanted = None
    if quick:
        count = min(count, 1)
        is_wanted = QUICK_DIRECTIONS.__contains__
    evaluations = Evaluations(loss, point, grad(loss) if gradient is None else gradient, chosen_steps)
    lines = len(point.directions(point.vector, count, audit_generator(0), is_wanted))
    ticks = _announced(3 + POINTS * min(lines, 2) + 2 * len(evaluations.steps) * lines)
    evaluations.tick = lambda: next(ticks, None)
    with unwarned(), closing(ticks):  # a gradient that is not finite is a verdict
        return _Auditor(evaluations, gradient is None, count, audit_generator(rng), quick).audit()


def _announced(total: int) -> Generator[Any, None, None]:
    """Tell those who watch a terminal how many evaluations are expected, and yield as many ticks of a bar.

    The bar disappears when the generator is closed; an open one would push later bars of the caller down a line.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"check.gradient: about {total} evaluations of the loss to come\n")
        yield from bar(range(total), needed=False, desc="check.gradient", unit="evaluation", leave=False)


class _Auditor:
    """One audit, step by step.

    Parameters
    ----------
    evaluations : Evaluations
    is_taped : bool
        Whether the tape gives the gradient.
    count : int
        Number of random directions.
    rng : Generator
    quick : bool
    """

    def __init__(
        self, evaluations: Evaluations, is_taped: bool, count: int, rng: np.random.Generator, quick: bool
    ) -> None:
        self.evaluations = evaluations
        self.loss = evaluations.loss
        self.point = evaluations.point
        self.is_taped = is_taped
        self.count = count
        self.rng = rng
        self.quick = quick
        self.directions: list[DirectionEvidence] = []
        self.findings: list[tuple[str, str]] = []
        self.notes: list[str] = []
        self.verdict = ""
        self.reason = ""
        self.hessian: str | None = None
        self.culprit: str | None = None
        self.gaps: tuple[str, ...] = ()

    def audit(self) -> Audit:
        """Run the audit and return its result."""
        self.examine()
        self.verdict, self.reason = overall_verdict(self.directions, self.findings)
        self.notes = [note for word, note in self.findings if word == "note"]
        self.find_fault()
        if self.quick:
            self.say_what_was_not_examined()
        return self.result()

    def examine(self) -> None:
        """Examine the gradient along all directions and by other derivatives."""
        if self.quick:
            is_wanted = QUICK_DIRECTIONS.__contains__
        else:
            is_wanted = None
        self.directions, self.findings = examine_directions(self.evaluations, self.count, self.rng, is_wanted)
        excuse_kinks(self.evaluations, self.directions)
        random = self.directions[: self.count]
        if random and self.is_taped:
            modes = compare_modes(self.loss, random)
            if modes is None:
                self.findings.append(("note", "forward mode: not available, a rule has no JVP"))
            else:
                self.findings.append(modes.finding(self.evaluations.tolerance))
        if random and not self.quick:
            self.examine_first(random[0])
        if self.directions and self.evaluations.value(self.point.fresh()) != self.evaluations.base:
            self.findings.append(("unsound", "the loss gives another value after the audit: it keeps a state"))

    def examine_first(self, first: DirectionEvidence) -> None:
        """Examine a complex step and a Hessian product along the first direction."""
        if not self.point.complex:
            note = check_complex_step(self.loss, self.point, first, self.evaluations.base)
            if note is not None:
                self.findings.append(("note", note))
        if self.is_taped and first.word in PROVED:
            self.hessian, note = check_hessian_product(self.loss, self.point, first)
            self.findings.append(("note", note))

    def find_fault(self) -> None:
        """Find the call at fault and the entries with the largest gaps, where something speaks against the gradient.

        Where loose time steps or rounding may explain a gap, the calls on the tape decide.
        """
        words = {direction.word for direction in self.directions} | {word for word, _ in self.findings}
        is_excused = bool(words & {"loose steps", "hidden modes"})
        spaces: list[Any] = []
        if self.verdict == "disagrees" or is_excused:
            spaces = spaces_of(self.loss, self.point.fresh())
            if self.is_taped:
                self.find_culprit(is_excused, spaces)
        if self.verdict == "disagrees":
            if self.quick:
                most = 1
            else:
                most = MOST_ENTRIES
            found = gaps_along_entries(self.evaluations, self.directions, most)
            self.gaps = tuple(listed(found, self.point, self.evaluations.slopes, spaces))
        if self.gaps:
            self.notes.append(f"largest gaps: {'; '.join(self.gaps)}")

    def find_culprit(self, is_excused: bool, spaces: list[Any]) -> None:
        """Find the call on the tape that is at fault, which may change the verdict."""
        self.culprit, why = culprit_of(self.loss, self.point, spaces)
        if self.culprit or self.verdict == "disagrees":
            self.notes.append(f"culprit: {why}")
        tolerance = self.evaluations.tolerance
        if self.culprit and is_excused and self.verdict == "inconclusive":
            self.verdict = "disagrees"
            self.reason += f"; but {why}"
        elif not self.culprit and self.verdict == "disagrees" and tolerance > THRESHOLDS.loose_tolerance:
            self.verdict = "inconclusive"
            self.reason += f"; no call is at fault, but solves stop at rtol {tolerance:g}: tighten them"

    def say_what_was_not_examined(self) -> None:
        """Say along which directions a quick audit looked, and what it omitted."""
        names = " and ".join(direction.direction for direction in self.directions) or "no direction"
        note = f"quick: looked at along {names}; {NOT_EXAMINED}"
        self.notes.append(note)
        if self.verdict == "agrees":
            self.reason = note

    def result(self) -> Audit:
        """Return the result."""
        digits = None
        if self.verdict == "agrees":
            digits = min(int(direction.digits) for direction in self.directions if direction.word in PROVED)
        return Audit(
            verdict=self.verdict,
            reason=self.reason,
            digits=digits,
            culprit=self.culprit,
            hessian=self.hessian,
            gaps=self.gaps,
            value=self.evaluations.base,
            evaluations=self.evaluations.count,
            size=self.point.entries,
            notes=tuple(self.notes),
            lines=tuple(direction.result() for direction in self.directions),
        )


# ------------------------------------------------------------ the result


class Audit(Result):
    """The result of `check.gradient`. Frozen; true only when the gradient agrees.

    Attributes
    ----------
    verdict : "agrees", "disagrees" or "inconclusive"
    reason : str
        Why, when it does not simply agree.
    digits : int or None
        Digits that are proved, in the worst direction; None unless it agrees.
    culprit : str or None
        Name of the first operator, rule or function of autograd on the tape whose VJP or JVP is at
        fault, when the verdict is "disagrees"; a note says what is wrong with it. None when each is right:
        then a value bypasses the tape, or `gradient` was an argument.
    gaps : tuple of str
        Entries of x where gradient and differences are farthest apart, when the verdict is "disagrees": both
        derivatives, the place where the loss uses Operators on a grid, and the region that holds the whole gap.
    hessian : "agrees", "disagrees", "inconclusive" or None
        Result of the third Taylor remainder for a Hessian product along the first direction; the verdict on the
        gradient does not depend on it. None where there is no product: no second derivatives, or a `gradient` argument.
    lines : tuple of DirectionResult
        One for each direction: word, difference, slope, gap, bar, scale, step, rates, digits, note, bend.
    value : float
        The loss at x.
    evaluations : int
        How often the loss was evaluated.
    """

    _plain = (
        "verdict",
        "reason",
        "digits",
        "culprit",
        "gaps",
        "hessian",
        "value",
        "evaluations",
        "size",
        "notes",
        "lines",
        "rows",
    )

    @property
    @np.errstate(all="ignore")
    def rows(self) -> tuple[dict[str, Any], ...]:
        """One dict for each direction and step: the numbers of the table and of the V-curve."""
        rows = []
        for direction in self.lines:
            for level in direction.line.levels:
                row = {"direction": direction.direction, **level._asdict()}
                row["difference"] = level.difference
                row["slope"] = level.slope
                row["gap"] = (level.difference - level.slope) / direction.scale
                rows.append(row)
        return tuple(rows)

    def parts(self) -> list[str | Table]:
        """Gaps over steps and directions, one line for each direction, notes, the verdict."""
        parts: list[str | Table] = [
            f"gradient at {self.size} values, loss {self.value:.6g}, {self.evaluations} evaluations"
        ]
        if self.lines:
            parts += [self._table_of_gaps(), self._table_of_directions()]
        parts += [f"  {note}" for note in self.notes if note != self.reason]
        verdict = f"verdict: {self.verdict}"
        if self.digits is not None:
            verdict += f" to {self.digits} digits"
        if self.reason:
            verdict += f": {self.reason}"
        return [*parts, verdict]

    def curves(self) -> tuple[dict[str, list[tuple[float, float]]], str, str]:
        """|difference - gradient| of the derivative over the step, a curve for each direction."""
        curves: dict[str, list[tuple[float, float]]] = {direction.direction: [] for direction in self.lines}
        for row in self.rows:
            if not row["note"]:
                curves[row["direction"]].append((row["step"], abs(row["gap"])))
        return curves, "step", "|difference - gradient| / |derivative|"

    def __repr__(self) -> str:
        """One line, which is what pytest shows of an assertion that fails."""
        if self.reason:
            details = [self.reason]
        else:
            details = []
        details += [note for note in self.notes if note.startswith(("culprit", "largest gaps"))]
        return f"<gradient {self.verdict}: {'; '.join(details) or f'{self.digits} digits'}>"

    def _table_of_gaps(self) -> Table:
        """Return the table of |difference - g . d| relative to the derivative, over steps (down) and directions.

        A step that fewer than half of the directions were evaluated at is omitted, unless one of them relies on it.
        """
        cells: dict[float, dict[str, Any]] = {}
        for row in self.rows:
            if row["note"]:
                gap = "-"
            else:
                gap = abs(row["gap"])
            cells.setdefault(row["step"], {})[row["direction"]] = gap
        essential = {direction.step for direction in self.lines}
        shown = [step for step in cells if 2 * len(cells[step]) >= len(self.lines) or step in essential]
        rows = [{"step": step, **cells[step]} for step in sorted(shown, reverse=True)]
        return table_of(rows, ["step", *(direction.direction for direction in self.lines)])

    def _table_of_directions(self) -> Table:
        """Return the table with one line for each direction."""
        rows = []
        for direction in self.lines:
            orders = [_order_in_words(order) for order in (direction.rate1, direction.rate2, direction.rate3)]
            slopes = f"{direction.slope:.9g}", f"{direction.difference:.9g}"
            gap_and_bar = direction.share, direction.resolution
            rows.append((direction.direction, *slopes, *gap_and_bar, *orders, direction.word, direction.note))
        names = ("direction", "g . d", "differences", "gap", "bar", "order 1", "order 2", "order 3", "", "")
        return Table(names, rows)


def _order_in_words(order: float) -> str:
    """Return an order in a cell: "-" without one, "exact" where the remainder is noise."""
    if isnan(order):
        return "-"
    if isinf(order):
        return "exact"
    return f"{order:.2f}"
