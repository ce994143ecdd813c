"""Audit of a gradient: finite differences at many step sizes, Taylor orders, determinism, forward and reverse mode."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from math import isinf, isnan
from typing import Any

import numpy as np

from sparsedp._utils.progress import bar
from sparsedp._utils.validation import check_function, check_whole
from sparsedp.autodiff.derivative import grad, unwarned
from sparsedp.check.culprit import culprit_of
from sparsedp.check.direction_evidence import CONFIRMING_WORDS, DirectionEvidence
from sparsedp.check.directions import RANDOM_DIRECTIONS, examine_directions, reclassify_kinks
from sparsedp.check.entries import MOST_ENTRIES, gaps_along_entries, listed, spaces_of
from sparsedp.check.evaluations import Evaluations
from sparsedp.check.loss_noise import POINTS
from sparsedp.check.other_derivatives import check_complex_step, check_hessian_product, compare_modes
from sparsedp.check.overall_verdict import overall_verdict
from sparsedp.check.point import QUICK_DIRECTIONS, Point, audit_generator, is_random
from sparsedp.check.step_sizes import checked_steps
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of
from sparsedp.check.thresholds import THRESHOLDS

__all__ = ["Audit", "gradient"]

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
    """Audit the gradient of a loss at x: compare it with finite differences and with other ways to differentiate.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. A function written with this library or with autograd, or any other function if
        `gradient` is given.
    x : array, number, or any nesting of them in tuples, lists and dicts
        At least one leaf must have a floating dtype: real or complex, in single or double precision. `x` is not
        modified.
    gradient : callable or tree, optional
        The gradient to check: a function of `x`, or its value at `x`, with the same tree structure as `x`. For a
        complex leaf it is dL/dRe - i dL/dIm, as in autograd. Default: reverse mode of this library.
    steps : sequence of float, optional
        At least eight step sizes, relative to the root mean square of each leaf. Default: ten steps over eight
        decades; for a direction in which these give no decision, more steps are added.
    directions : int
        Number of random directions. The audit also examines a random direction in each leaf, a constant direction,
        the gradient itself, and the entry with the largest gradient.
    rng : None, int or numpy Generator
        Seed or generator of the random directions. Default: a fixed seed.
    quick : bool
        If True, examine only one random direction and the gradient direction. Use it for a loss that takes minutes.
        A note lists what a quick audit omits: other directions, single leaves and entries, complex steps and the
        Hessian product. If the gradient agrees, `.reason` repeats this list.

    Returns
    -------
    Audit
        `.verdict` is "agrees", "disagrees" or "inconclusive". `.digits` is the number of digits that agree, and
        `.reason` explains the other verdicts. bool(audit) is True only for "agrees", so that
        ``assert dp.check.gradient(loss, x)`` works. `.lines` has the result for each direction, `.rows` the values
        for each direction and step, str() returns a table, and `.to_dict()` returns plain Python data.

    Raises
    ------
    ValueError
        If `steps` has fewer than eight different values or a value that is not positive and finite, or if
        `directions` is negative or not an integer.
    DerivativeError
        If `x` has no floating leaf, or the gradient does not have the same structure as `x`.
    NonFiniteError
        If `x` contains NaN or infinity.

    See Also
    --------
    value_and_grad, differentiable, certify, stress, v_curve, check.vjp, check.order,
    check.jit, testing.assert_gradient

    Notes
    -----
    **Conditions for agreement.** They must hold along every direction. The gap between the finite difference and the
    gradient is at most 1e-8 of the derivative, or at most the error bar of the sweep if that is larger. If the loss
    contains an iterative solve, or has measured noise of 1e-10, the limit is 1e-6 instead of 1e-8. The Taylor
    remainder f(x + t d) - f(x) has order 1 +- 0.05 in t. With the gradient term subtracted, the remainder has order
    1.95 or more on every pair of steps, from at least three steps at which it is 100 times the noise. With fewer such
    steps, or with a lower order, the verdict is "inconclusive", however small the gap. In two cases there is no order,
    and the gap alone decides: if the remainder is noise at all steps (a linear loss; order 2 is shown as "exact"), or
    if the slope is so small that the quadratic term dominates at all steps (near a minimum, or in the kernel of a
    Laplacian; there is no order 1). Forward and reverse mode differ by at most 1e-10, or by at most 1e-6 with an
    iterative solve or with noise. All thresholds are in `sparsedp.check.thresholds`.

    **Noise.** It is measured by a table of differences of neighbouring values. If the noise is larger than rounding,
    agreement needs six digits; with fewer digits the verdict is "inconclusive", and the reason says how many digits
    agree. A ripple (a small part of the loss with a derivative that is not small) also gives "inconclusive". It is
    detected if fine steps show another derivative than coarse steps, or if the gradient itself varies within steps
    that are below the noise. A ripple that is below the rounding of the loss and is also missing from the gradient
    cannot be detected. If both the loss and the gradient are 0 up to rounding, the verdict is "inconclusive".

    **Hessian product.** It is examined along the first direction by the third Taylor remainder, which should have order
    2.9 or more. `.hessian` and a note give the result. The verdict on the gradient does not depend on it.

    **Cost.** The audit takes two evaluations of the loss for each step and direction, and a few gradients. If the
    gradient agrees, these are about 150 evaluations for an array, 200 for several arrays, 60 in a quick audit, and 35
    for one number. Noise and kinks need up to twice as many. On a terminal, standard error shows how many evaluations
    are expected, with a progress bar if tqdm is installed. If the verdict is "disagrees", about 40 more evaluations
    for each direction that disagrees exclude a kink (an audit of an array then takes 350 to 450 evaluations, a quick
    one 150 to 180). Bisection finds the three entries with the largest gaps (one entry in a quick audit), with about 2
    log2(n) evaluations for each. The recorded calls are then examined one by one to find the culprit. This takes
    seconds for most losses, and minutes for a loss with a thousand implicit time steps.

    **Adaptive time steps.** A `stepper` with a `tolerance` is differentiable only up to this tolerance: its gradient
    differs from the derivative of the value that it returns by a few tolerances. If the gap is at most ten tolerances,
    and no other call is at fault, the verdict is "inconclusive", and the reason says so. Check such a loss with a
    fixed dt, or with a tolerance of 1e-9.

    **Detection limits.** An error in all entries of the gradient is detected if its relative size is above 1e-8 for a
    smooth loss, 1e-6 with an iterative solve or with noise, 1e-4 in single precision, and ten tolerances for adaptive
    time steps if no call is at fault. A single wrong entry is detected if its share of the derivative along an examined
    direction is above the same limit. The entry with the largest gradient has a direction of its own.

    All conditions are relative, so that a loss multiplied by 1e-200 or 1e200 has the same verdict. If the loss raises
    an exception at a trial point (unstable step, no convergence, NaN or infinity; ValueError, ArithmeticError,
    RuntimeError), this step is not used. Every other exception is raised.
    At a kink the central difference does not converge to the gradient, and the verdict is "inconclusive".

    For complex leaves see docs/guides/complex_numbers.md.

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
    chosen_steps = checked_steps(steps)
    point = Point(x)
    is_wanted = None
    if quick:
        count = min(count, 1)
        is_wanted = QUICK_DIRECTIONS.__contains__
    evaluations = Evaluations(loss, point, grad(loss) if gradient is None else gradient, chosen_steps)
    lines = len(point.directions(point.vector, count, audit_generator(0), is_wanted))
    ticks = _progress_notice(3 + POINTS * min(lines, 2) + 2 * len(evaluations.steps) * lines)
    evaluations.tick = lambda: next(ticks, None)
    with unwarned(), closing(ticks):  # a gradient that is not finite affects the verdict and needs no warning
        return _Auditor(evaluations, gradient is None, count, audit_generator(rng), quick).audit()


def _progress_notice(total: int) -> Generator[Any, None, None]:
    """On a terminal, print how many evaluations are expected, and advance a progress bar at each `next`.

    Close the generator to remove the bar. Otherwise later progress bars of the caller would start one line below.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"check.gradient: about {total} evaluations of the loss to come\n")
        yield from bar(range(total), needed=False, desc="check.gradient", unit="evaluation", leave=False)


class _Auditor:
    """The state of one audit; its methods are the steps of the audit.

    Parameters
    ----------
    evaluations : Evaluations
    is_taped : bool
        Whether the gradient under test is computed by reverse mode (no `gradient` was given).
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
            self.note_omissions()
        return self.result()

    def examine(self) -> None:
        """Examine the gradient along all directions and by other derivatives."""
        if self.quick:
            is_wanted = QUICK_DIRECTIONS.__contains__
        else:
            is_wanted = None
        self.directions, self.findings = examine_directions(self.evaluations, self.count, self.rng, is_wanted)
        reclassify_kinks(self.evaluations, self.directions)
        random = [direction for direction in self.directions if is_random(direction.direction)]
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
        """Compare with a complex step, and check the Hessian product, along the first direction."""
        if not self.point.complex:
            note = check_complex_step(self.loss, self.point, first, self.evaluations.base)
            if note is not None:
                self.findings.append(("note", note))
        if self.is_taped and first.word in CONFIRMING_WORDS:
            self.hessian, note = check_hessian_product(self.loss, self.point, first)
            self.findings.append(("note", note))

    def find_fault(self) -> None:
        """Find the call at fault and the entries with the largest gaps, if there is evidence against the gradient.

        If the tolerance of time steps or rounding may explain a gap, the recorded calls are examined too. The verdict
        becomes "disagrees" if one of them is at fault.
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
            gaps = gaps_along_entries(self.evaluations, self.directions, most)
            self.gaps = tuple(listed(gaps, self.point, self.evaluations.slopes, spaces))
        if self.gaps:
            self.notes.append(f"largest gaps: {'; '.join(self.gaps)}")

    def find_culprit(self, is_excused: bool, spaces: list[Any]) -> None:
        """Find the recorded call that is at fault. The verdict may change."""
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

    def note_omissions(self) -> None:
        """Add a note with the directions that a quick audit examined, and with what it omitted."""
        names = " and ".join(direction.direction for direction in self.directions) or "no direction"
        note = f"quick: looked at along {names}; {NOT_EXAMINED}"
        self.notes.append(note)
        if self.verdict == "agrees":
            self.reason = note

    def result(self) -> Audit:
        """Return the result."""
        digits = None
        if self.verdict == "agrees":
            digits = min(int(direction.digits) for direction in self.directions if direction.word in CONFIRMING_WORDS)
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
    """The result of `check.gradient`. Immutable; bool(audit) is True only if the gradient agrees.

    Attributes
    ----------
    verdict : "agrees", "disagrees" or "inconclusive"
    reason : str
        Explanation of the verdict. Empty if the gradient agrees and there is nothing to add.
    digits : int or None
        Number of digits that agree in the worst direction. None if the verdict is not "agrees".
    culprit : str or None
        If the verdict is "disagrees": the name of the first recorded operator, rule or autograd function whose VJP or
        JVP is wrong. A note says what is wrong. None if all recorded calls are right (the loss then uses a value that
        was not recorded), or if the gradient was given as an argument.
    gaps : tuple of str
        If the verdict is "disagrees": the entries of `x` with the largest gaps between gradient and finite difference.
        Each string has both derivatives. If the loss applies Operators on a grid, it also has the coordinates of the
        entry. If all entries of a wall, a row or a leaf are wrong, it names this region, and the factor by which the
        gradient is wrong if it is the same in the whole region.
    hessian : "agrees", "disagrees", "inconclusive" or None
        Result of the third Taylor remainder for a Hessian product along the first direction. The verdict on the
        gradient does not depend on it. None if no Hessian product was computed: `gradient` was given, the audit was
        quick, `x` is complex, a rule has no second derivative, or the first direction does not agree.
    notes : tuple of str
        Further observations.
    lines : tuple of DirectionResult
        One for each direction: word, difference, slope, gap, bar, scale, step, rates, digits, note, bend.
    value : float
        The loss at `x`.
    evaluations : int
        Number of evaluations of the loss.
    size : int
        Number of entries of all floating leaves.
    """

    _plain: tuple[str, ...] = (
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
        """One dict for each direction and step, with the values in the table and in the V-curve."""
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
        """Return the tables of gaps and directions, the notes, and the verdict."""
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
        """Return the curves of the relative gap over the step, one for each direction, and the labels of the axes."""
        curves: dict[str, list[tuple[float, float]]] = {direction.direction: [] for direction in self.lines}
        for row in self.rows:
            if not row["note"]:
                curves[row["direction"]].append((row["step"], abs(row["gap"])))
        return curves, "step", "|difference - gradient| / |derivative|"

    def __repr__(self) -> str:
        """Return one line. It is what pytest shows for a failed assertion."""
        if self.reason:
            details = [self.reason]
        else:
            details = []
        details += [note for note in self.notes if note.startswith(("culprit", "largest gaps"))]
        return f"<gradient {self.verdict}: {'; '.join(details) or f'{self.digits} digits'}>"

    def _table_of_gaps(self) -> Table:
        """Return the table of |difference - g . d| relative to the derivative: rows are steps, columns are directions.

        A step is omitted if fewer than half of the directions were evaluated at it, unless it is the step with which
        one of the directions was decided.
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
    """Return the table cell for an order: "-" if there is none (NaN), "exact" if the remainder is noise (infinity)."""
    if isnan(order):
        return "-"
    if isinf(order):
        return "exact"
    return f"{order:.2f}"
