"""The audit of a gradient: differences over many step sizes, Taylor rates, determinism, forward against reverse."""

import sys
import warnings
from contextlib import suppress
from math import inf, isinf, isnan

import numpy as np

from sparsedp._utils.progress import bar
from sparsedp._utils.validation import check_function, check_whole
from sparsedp.autodiff.derivative import grad, hvp, unwarned
from sparsedp.check.culprit import culprit_of
from sparsedp.check.entries import MOST_ENTRIES, gaps_along_entries, listed, spaces_of
from sparsedp.check.judge import (
    PROVED,
    at_kinks,
    curvature,
    forward_mode,
    looked_at,
    verdict,
)
from sparsedp.check.summary import Result
from sparsedp.check.sweep import POINTS, QUICK, REFUSALS, Point, Trials, generator
from sparsedp.check.table import Table, table_of

__all__ = ["Audit", "gradient", "look_beside"]

FEWEST_STEPS = 8
RANDOM = 3  # random directions
SHIFT, BESIDE = 2.0**-6, 7  # length and seed of the step to the point where a kinked loss is looked at again
LOOSE = 1e-8  # a tolerance of solves above this may explain any gap that no call is to blame for
LEFT_OUT = "other directions, single leaves and entries, complex steps and the Hessian product were not looked at"
FORGIVEN = 1e3  # tolerances of the solves inside that the modes may differ by; beyond, no solve is to blame
APART = 1e-10  # of the derivative: what rounding leaves of a complex step
TINY_STEP = 2.0**-100  # of a complex step, in units of x: its square is lost beside x


def gradient(loss, x, gradient=None, steps=None, directions=RANDOM, rng=None, quick=False):
    """Audit the gradient of a loss at x: does it agree with what the loss does?

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. Any function: of this library, of autograd, or foreign (then give `gradient`).
    x : array, number, or any nesting of them in tuples, lists and dicts
        At least one floating leaf, real or complex, float32 or float64. Never modified.
    gradient : callable or tree, optional
        ``gradient(x)``, or its value, with the structure of `x`. Default: reverse mode through the tape. For a
        complex leaf it is dL/dRe - i dL/dIm, as the tape has it.
    steps : sequence of float, optional
        Step sizes in units of x (the root mean square of each leaf), at least eight. Default: ten over
        eight decades, and more on a line where they leave the derivative open.
    directions : int
        Random directions. Structured ones come on top: each leaf alone, constant, the gradient itself,
        its largest entry.
    rng : None, int or numpy Generator
        Source of the directions; default: a fixed seed.
    quick : bool
        One random direction and the gradient itself, for a loss that takes minutes. What was not looked at stands
        in the reason, also where it agrees: other random directions, single leaves and entries, complex steps, the
        Hessian product.

    Returns
    -------
    Audit
        `.verdict` is "agrees" (with `.digits`), "disagrees" or "inconclusive" (with `.reason`); true only
        for "agrees", so that ``assert dp.check.gradient(loss, x)`` works. `.rows` are the numbers,
        `.lines` the judgement of each direction, str() the table, `.to_dict()` plain data.

    Raises
    ------
    ValueError
        If `steps` are fewer than eight, or not positive, or `directions` is no whole number >= 0.
    DerivativeError
        If x has no floating leaf, or the gradient does not have the structure of x.
    NonFiniteError
        If x holds NaN or infinity.

    Notes
    -----
    Gates, along every direction. The gap between differences and gradient: at most 1e-8 of the derivative,
    or the error bar of the sweep where that is larger (1e-6 behind a solve that the ledger shows, or in
    measured noise of 1e-10). Taylor: f(x + t d) - f of order 1 +- 0.05 in t, with the gradient taken off
    of order 1.95 or more on every pair of steps, at least three steps that stand 100 times above the noise;
    with one or two, or with a lower order, the verdict is inconclusive, however small the gap. Two cases
    have no order, and the gap alone judges them: the remainder is noise on all steps (a linear loss: order
    2 is "exact"), and a slope so small that the loss bends before it climbs (near a minimum,
    or in the kernel of a Laplacian: no order 1).
    Forward against reverse mode: 1e-10, and 1e-6 behind a solve or in noise.

    Noise is measured by a table of differences of neighbouring values. Where it is more than rounding, agreement
    needs six digits; with fewer the verdict is inconclusive and says how many there are. A ripple (a part of the loss
    that is small, with a derivative that is not) is inconclusive too: where fine steps see another derivative than
    coarse ones, or the gradient itself varies within steps that the noise hides. A ripple below the rounding of the
    loss that the gradient does not know either leaves no trace: no difference can see it.

    The Hessian product along the first direction is judged by the third Taylor remainder, of order 2.9 or more:
    `.hessian` and a note say how. It does not touch the verdict, which is about the gradient.

    Cost: two evaluations of the loss for each step and direction (a hundred or two in all, about 60 of a quick
    audit), and a few gradients. A terminal shows how many are to come on standard error, with a bar if tqdm is there.
    Where the verdict is "disagrees" the entries with the largest gaps are found by bisection, with about 2 log2(n) more
    evaluations for each of three (one of a quick audit), and the calls on the tape are looked at one by one for the
    culprit: seconds for most losses, minutes where a loss takes a thousand implicit steps.

    A `stepper` with a `tolerance` is differentiable to that tolerance, not to rounding: its gradient differs from that
    of the value it returns by a few tolerances. Where the gap is at most ten tolerances, and no other call is at
    fault, the verdict is "inconclusive" and says so. Check such a loss with a fixed dt, or with a tolerance of 1e-9.

    Detection limits, as shares of the gradient. An error in all entries: 1e-8 or less where the loss is smooth, 1e-6
    behind an iterative solve or in noise, ten tolerances of time steps with error control where no call is at fault,
    1e-4 in single precision. A single wrong entry of n counts by its share of the derivative along the directions
    looked at, its own among them where it is the largest.

    Everything is relative: a loss times 1e-200 or 1e200 is judged the same. A loss that refuses a trial
    point (unstable step, no convergence, not finite, a ValueError) makes that step unusable. At a kink
    central differences prove nothing, and the verdict is inconclusive.

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
    directions = check_whole("directions of check.gradient", directions, 0, "; the default is 3")
    chosen = tuple(map(float, () if steps is None else steps))
    if steps is not None and (len(set(chosen)) < FEWEST_STEPS or not all(0 < step < inf for step in chosen)):
        raise ValueError(f"a sweep needs at least {FEWEST_STEPS} different positive steps, got {chosen}")
    point, count = Point(x), min(directions, 1) if quick else directions
    trials = Trials(loss, point, grad(loss) if gradient is None else gradient, chosen)
    names = QUICK.__contains__ if quick else None
    lines = len(point.directions(point.vector, count, generator(0), names))
    ticks = _announced(3 + POINTS * min(lines, 2) + 2 * len(trials.steps) * lines)
    trials.tick = lambda: next(ticks, None)
    with unwarned():  # a gradient that is not finite is a verdict
        return _audit(trials, gradient is None, count, generator(rng), names)


def _announced(total):
    """How many evaluations are to come, about -> as many ticks; told to those who watch a terminal, with a bar."""
    if not sys.stderr.isatty():
        return iter(())
    sys.stderr.write(f"check.gradient: about {total} evaluations of the loss to come\n")
    return iter(bar(range(total), needed=False, desc="check.gradient", unit="evaluation", leave=False))


def _audit(trials, taped, count, rng, quick):
    """The audit; `quick`: names of its directions, or None for all."""
    loss, point, hessian, culprit = trials.loss, trials.point, None, None
    judged, doubts = looked_at(trials, count, rng, quick)
    look_beside(trials, judged)
    random = judged[:count]
    first = None if quick or not random else random[0]
    if taped and random:
        doubts.append(_modes(forward_mode(loss, random), trials.tolerance))
    if first and not point.complex:
        doubts += _complex_step(loss, point, first, trials.base)
    if first and taped and first.word in PROVED:
        hessian, note = _hessian(loss, point, first)
        doubts.append(("note", note))
    if judged and trials.value(point.fresh()) != trials.base:
        doubts.append(("unsound", "the loss gives another value after the audit: it keeps a state"))
    outcome, reason = verdict(judged, doubts)
    notes = [note for word, note in doubts if word == "note"]
    # Where such a gap is all that speaks against a gradient, the calls on the tape decide.
    excused = any(one.word == "loose steps" for one in judged) or "hidden modes" in dict(doubts)
    suspicious = outcome == "disagrees" or excused
    spaces = spaces_of(loss, point.fresh()) if suspicious else []
    if taped and suspicious:
        culprit, why = culprit_of(loss, point, spaces)
        if culprit or outcome == "disagrees":
            notes.append(f"culprit: {why}")
        if culprit and excused and outcome == "inconclusive":
            outcome, reason = "disagrees", f"{reason}; but {why}"
        if culprit is None and outcome == "disagrees" and trials.tolerance > LOOSE:
            outcome = "inconclusive"
            reason += f"; no call is at fault, but solves stop at rtol {trials.tolerance:g}: tighten them"
    gaps = ()
    if outcome == "disagrees":
        found = gaps_along_entries(trials, judged, 1 if quick else MOST_ENTRIES)
        gaps = tuple(listed(found, point, trials.gradient, spaces))
    if gaps:
        notes.append(f"largest gaps: {'; '.join(gaps)}")
    if quick:
        names = " and ".join(one.direction for one in judged) or "no direction"
        notes.append(f"quick: looked at along {names}; {LEFT_OUT}")
        reason = notes[-1] if outcome == "agrees" else reason
    digits = [int(one.digits) for one in judged if outcome == "agrees" and one.word in PROVED]
    return Audit(
        verdict=outcome, reason=reason, digits=min(digits, default=None), culprit=culprit, hessian=hessian,
        gaps=gaps, value=trials.base, evaluations=trials.count, size=point.entries, notes=tuple(notes),
        lines=tuple(judged),
    )  # fmt: skip


def look_beside(trials, judged):
    """Judge directions that look wrong at kinks once more, at a point beside the kinks.

    Where several kinks meet, a derivative may lie outside the one-sided ones and still follow a convention. It is wrong
    if it is wrong beside the kinks as well. Nothing is done without kinks or without a function for the gradient.
    """
    if not (at_kinks(judged) and callable(trials.slope)):
        return
    point = trials.point
    with suppress(*REFUSALS):
        beside = Point(point.unpack(point.vector + SHIFT * point.random(generator(BESIDE))))
        other = Trials(trials.loss, beside, trials.slope, tick=trials.tick)
        if verdict(*looked_at(other, RANDOM, generator(None)))[0] != "disagrees":
            for one in judged:
                if one.word in ("outside", "disagrees"):
                    one.learn(
                        word="kink", note="kinks, or parts of a direction that do not add up; beside x all agrees"
                    )


# ------------------------------------------------------------ other ways to a derivative


def _modes(modes, tolerance):
    """Gap of forward and reverse mode -> doubt, or a note."""
    if modes is None:
        return "note", "forward mode: not available, a rule has no JVP"
    gap, allowed, hidden = modes
    if gap <= allowed:
        return "note", f"forward mode: agrees with reverse mode to {gap:.0e}"
    reason = f"forward and reverse mode differ by {gap:.1e}"
    if gap <= FORGIVEN * tolerance:
        return "open", f"{reason}, which solves to rtol {tolerance:g} may leave; tighten them"
    if hidden:
        return (
            "hidden modes",
            f"{reason}, and the noise of the loss hides which is right: the derivative may be rounding",
        )
    return "broken", f"{reason}: the JVP or the VJP of a rule is wrong"


@np.errstate(all="ignore")
def _complex_step(loss, point, one, base):
    """Im f(x + i t d) / t beside g . d: exact to rounding where the code is analytic, and else no note.

    Source: W. Squire and G. Trapp, SIAM Review 40, 1998.
    """
    away = zip(point.values, point.arrays(one.line.direction))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a discarded imaginary part shows in the figure
            value = complex(loss(point.tree([x + 1j * TINY_STEP * d for x, d in away])))
    except Exception:  # a loss of real numbers may refuse complex ones in any way
        return []
    gap = abs(value.imag / TINY_STEP - one.slope) / one.scale
    analytic = value.imag != 0 and abs(value.real - base) <= 1e-9 * abs(base) and gap <= APART
    return [("note", f"complex step: agrees to {gap:.0e}")] if analytic else []


def _hessian(loss, point, one):
    """d . H d -> (word or None, note).

    The gradient has its verdict without it: a pullback that uses a value it captured has a right gradient and a
    wrong Hessian.
    """
    if point.complex:
        return None, "Hessian product: not looked at, x is complex"
    along = one.line.direction
    try:
        with np.errstate(all="ignore"):
            product = point.gradient(hvp(loss, point.fresh(), point.unpack(along))) @ along
    except Exception as error:  # a rule, ours or not, may lack a second derivative and say so in any way
        return None, f"Hessian product: not available ({type(error).__name__})"
    word, reason = curvature(one, float(product))
    return word, f"Hessian product: {word}, {reason}"


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
        then a value bypasses the tape, or the gradient was given.
    gaps : tuple of str
        Entries of x where gradient and differences are farthest apart, when the verdict is "disagrees": both
        derivatives, the place where the loss uses Operators on a grid, and the region that holds the whole gap.
    hessian : "agrees", "disagrees", "inconclusive" or None
        What the third Taylor remainder says of a Hessian product along the first direction; it does not touch the
        verdict on the gradient. None where there is no product: no second derivatives, or a gradient that was given.
    lines : tuple of Judgement
        One for each direction: word, difference, slope, gap, bar, scale, step, rates, digits, note, bend.
    value : float
        The loss at x.
    evaluations : int
        How often the loss was evaluated.
    """

    _plain = (*"verdict reason digits culprit gaps hessian value evaluations size notes lines rows".split(),)

    @property
    @np.errstate(all="ignore")
    def rows(self):
        """One dict for each direction and step: the numbers of the table and of the V-curve."""
        return tuple(
            {
                "direction": one.direction,
                **level._asdict(),
                "difference": level.difference,
                "slope": level.slope,
                "gap": (level.difference - level.slope) / one.scale,
            }
            for one in self.lines
            for level in one.line.levels
        )

    def parts(self):
        """Gaps over steps and directions, one line for each direction, notes, the verdict."""
        proved = f" to {self.digits} digits" if self.digits is not None else ""
        return [
            f"gradient at {self.size} values, loss {self.value:.6g}, {self.evaluations} evaluations",
            *([self._gaps(), self._directions()] if self.lines else []),
            *(f"  {note}" for note in self.notes if note != self.reason),
            f"verdict: {self.verdict}{proved}{': ' if self.reason else ''}{self.reason}",
        ]

    def curves(self):
        """|difference - gradient| of the derivative over the step, a curve for each direction."""
        lines: dict = {one.direction: [] for one in self.lines}
        for row in self.rows:
            if not row["note"]:
                lines[row["direction"]].append((row["step"], abs(row["gap"])))
        return lines, "step", "|difference - gradient| / |derivative|"

    def __repr__(self):
        """One line, which is what pytest shows of an assertion that fails."""
        words = [self.reason, *(note for note in self.notes if note.startswith(("culprit", "largest gaps")))]
        return f"<gradient {self.verdict}: {'; '.join(filter(None, words)) or f'{self.digits} digits'}>"

    def _gaps(self):
        """|difference - g . d| relative to the derivative, over the steps (down) and directions (across)."""
        cells: dict = {}
        for row in self.rows:
            cells.setdefault(row["step"], {})[row["direction"]] = "-" if row["note"] else abs(row["gap"])
        rows = [{"step": step, **cells[step]} for step in sorted(cells, reverse=True)]
        return table_of(rows, ["step", *(one.direction for one in self.lines)])

    def _directions(self):
        """One line for each direction."""
        lines = [
            (one.direction, f"{one.slope:.9g}", f"{one.difference:.9g}", one.share, one.resolution,
             *map(_order, (one.rate1, one.rate2, one.rate3)), one.word, one.note)
            for one in self.lines
        ]  # fmt: skip
        return Table(
            ("direction", "g . d", "differences", "gap", "bar", "order 1", "order 2", "order 3", "", ""), lines
        )


def _order(rate):
    return "-" if isnan(rate) else "exact" if isinf(rate) else f"{rate:.2f}"
