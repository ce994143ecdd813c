"""The audit of a gradient: differences over many step sizes, Taylor rates, determinism, forward against reverse."""

import math
from contextlib import suppress

import numpy as np

from sparsedp.check.culprit import culprit_of
from sparsedp.check.extension import measured
from sparsedp.check.modes import complex_step, forward_mode, hessian
from sparsedp.check.noise import POINTS, noise_of
from sparsedp.check.point import Point
from sparsedp.check.probes import generator
from sparsedp.check.progress import shown
from sparsedp.check.ripple import hidden
from sparsedp.check.sweep import REFUSALS, Line, Trials, default_steps, dot
from sparsedp.check.verdict import Audit, decide
from sparsedp.derivative import value_and_grad
from sparsedp.fields import check_function, is_whole

__all__ = ["gradient"]

FEWEST_STEPS = 8
BESIDE = 7  # seed of the place where a kinked loss is looked at again
LOOSE = 1e-8  # a tolerance of solves above this may explain any gap that no call is to blame for
QUICK = ("random 1", "gradient")  # the directions of a quick audit
LEFT_OUT = "other directions, single leaves and entries, complex steps and the Hessian product were not looked at"
UNDERFLOW = 1e-303  # differences of a loss that changes by less are not normal numbers


def gradient(loss, x, gradient=None, steps=None, directions=3, rng=None, quick=False):
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
        Source of the directions; default a fixed seed of its own.
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
    point = Point(x)
    chosen = _checked(steps, directions) or default_steps(point.eps)
    directions = min(directions, 1) if quick else directions
    ways = sum(1 for _ in _ways(point, point.values, directions, generator(0), quick))
    with shown(3 + POINTS * min(ways, 2) + 2 * len(chosen) * ways) as told:
        return _audit(Trials(loss, told), point, gradient, chosen, steps is None, directions, rng, quick)


def _audit(trials, point, gradient, steps, extend, directions, rng, quick, beside=False):
    loss = trials.loss
    base = trials.value(point.tree())
    evaluate = (lambda tree: value_and_grad(loss)(tree)[1]) if gradient is None else gradient
    leaves, doubts = _own_gradient(point, trials, base, evaluate)
    lines, judged, bend = [], [], None
    if math.isfinite(base) and all(np.all(np.isfinite(g)) for g in leaves):
        lines = _lines(point, _ways(point, leaves, directions, generator(rng), quick), leaves, trials, base)
        judged = [measured(line, steps, point, trials, extend) for line in lines]
        if callable(evaluate):
            judged = [_once_more(*pair, evaluate, trials, point) for pair in zip(lines, judged, strict=True)]
        if _at_kinks(judged) and callable(evaluate) and not beside:
            judged = _beside(trials, point, gradient, directions, judged)
        if gradient is None:
            doubts += forward_mode(loss, point, lines[:directions], judged)
        doubts += [] if quick else complex_step(loss, point, lines[:directions], base)
        if gradient is None and directions and not quick and judged[0].word in ("agrees", "vanishes"):
            bend = hessian(loss, point, lines[0], judged[0], trials, extend)
            judged[0] = judged[0]._replace(bend=bend.value, rate3=bend.rate)
            doubts.append(("", bend.note))
        if _bits(trials.value(point.tree())) != _bits(base):
            doubts.append(("inconclusive", "the loss gives another value after the audit: it keeps a state"))
    verdict, reason = decide(judged, doubts)
    notes = [reason for word, reason in doubts if not word]
    culprit = None
    if verdict == "disagrees" and gradient is None:
        culprit, why = _culprit(loss, point)
        notes.append(why)
        if culprit is None and trials.tolerance > LOOSE:
            verdict = "inconclusive"
            reason += f"; no call is at fault, but solves stop at rtol {trials.tolerance:g}: tighten them"
    if quick:
        names = " and ".join(line.name for line in lines) or "no direction"
        notes.append(f"quick: looked at along {names}; {LEFT_OUT}")
        reason = notes[-1] if verdict == "agrees" else reason
    word = bend.word if bend else None
    return Audit(verdict, reason, judged, lines, base, trials.count, point.size, notes, culprit, word)


def _ways(point, leaves, directions, rng, quick):
    """Names and displacements of all directions, or of those of a quick audit."""
    found = point.directions(leaves, directions, rng)
    return (way for way in found if way[0] in QUICK) if quick else found


def _lines(point, ways, leaves, trials, base):
    """One line for each direction. The noise of the loss is that along the first and the last of them."""
    lines = [Line(name, direction, point, leaves, trials, base) for name, direction in ways]
    noise = noise_of([*lines[:1], *lines[1:][-1:]], point, trials, base)
    for place, line in enumerate(lines):
        line.noise, line.close = noise, place == 0
    return lines


def _once_more(line, found, evaluate, trials, point):
    """A gap that a ripple of the gradient may explain is none that differences prove."""

    def slope_at(tree):
        try:
            return dot(point.leaves_of(evaluate(tree)), line.direction)
        except REFUSALS:
            return line.slope

    with np.errstate(all="ignore"):
        return hidden(line, found, slope_at, trials.eps, point)


def _at_kinks(judged):
    """Whether kinks may explain what speaks against a gradient; one that is far in one direction is seen in others."""
    words = {one.word for one in judged}
    return "outside" in words or {"disagrees", "kink"} <= words


def _beside(trials, point, gradient, directions, judged):
    """At several kinks at once a derivative may lie outside the one-sided ones and follow a convention all the same.

    What is wrong beside the kinks as well is wrong.
    """
    moved = point.moved(next(point.directions(point.values, 1, generator(BESIDE)))[1], 2.0**-6)
    with suppress(*REFUSALS):
        other, again = Point(point.tree(moved)), Trials(trials.loss, trials.told)
        found = _audit(again, other, gradient, default_steps(other.eps), True, directions, None, False, beside=True)
        if found.verdict != "disagrees":
            note = "several kinks; beside them nothing speaks against the gradient"
            doubtful = ("outside", "disagrees")
            return [one._replace(word="kink", note=note) if one.word in doubtful else one for one in judged]
    return judged


def _culprit(loss, point):
    """(name, sentence) of the first call at fault."""
    fault = culprit_of(loss, point)
    if fault is None:
        return None, "culprit: every call on the tape is right at the values it met; a value may bypass the tape"
    return fault.name, f"culprit: {fault.name}, {fault.reason}"


def _checked(steps, directions):
    if not is_whole(directions, 0):
        raise ValueError(f"a sweep needs directions >= 0, a whole number, got {directions!r}; the default is 3")
    if steps is None:
        return None
    steps = tuple(float(step) for step in steps)
    if len(set(steps)) < FEWEST_STEPS or not all(0 < step < math.inf for step in steps):
        raise ValueError(f"a sweep needs at least {FEWEST_STEPS} different positive steps, got {steps}")
    return steps


def _own_gradient(point, trials, base, evaluate):
    """Leaves of the gradient, and the doubts that come before any difference."""
    doubts = []
    if not math.isfinite(base):
        doubts.append(("inconclusive", f"the loss is {base} at x"))
    elif _bits(trials.value(point.tree())) != _bits(base):
        doubts.append(("inconclusive", "two evaluations of the loss differ: it is not deterministic"))
    if not callable(evaluate):
        return point.leaves_of(evaluate), doubts
    with np.errstate(all="ignore"):
        first, second = (point.leaves_of(evaluate(point.tree())) for _ in range(2))
    if any(a.tobytes() != b.tobytes() for a, b in zip(first, second, strict=True)):
        doubts.append(("inconclusive", "two evaluations of the gradient differ: it is not deterministic"))
    largest = max(np.max(np.abs(g), initial=0.0) * unit for g, unit in zip(first, point.units, strict=True))
    if 0 < largest < UNDERFLOW:
        doubts.append(("inconclusive", f"the loss changes by less than {UNDERFLOW:g}: it underflows, scale it"))
    for name, g in zip(point.names, first, strict=True):
        if not np.all(np.isfinite(g)):
            doubts.append(("disagrees", f"the gradient of {name} holds NaN or infinity"))
    return first, doubts


def _bits(value):
    return np.float64(value).tobytes()
