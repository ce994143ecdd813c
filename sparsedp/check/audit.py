"""The audit of a gradient: differences over many step sizes, Taylor rates, determinism, forward against reverse."""

import math
import warnings

import numpy as np

from sparsedp.check.culprit import culprit_of
from sparsedp.check.extension import measured
from sparsedp.check.plateau import ROUNDING
from sparsedp.check.point import Point
from sparsedp.check.probes import generator
from sparsedp.check.sweep import Line, Trials, default_steps, dot
from sparsedp.check.verdict import Audit, decide
from sparsedp.derivative import NO_JVP, pushforward, value_and_grad

__all__ = ["gradient"]

FEWEST_STEPS = 8
TINY_STEP = 2.0**-100  # of a complex step, in units of x: its square is lost beside x
APART = 1e-10  # forward and reverse mode differ by rounding
SOLVED = 1e-6  # by more, when there are solves inside: each mode ends at its own residual
FORGIVEN = 1e3  # tolerances of the solves inside; beyond, no solve is to blame
LOOSE = 1e-8  # a tolerance of solves above this may explain any gap that no call is to blame for
UNDERFLOW = 1e-303  # differences of a loss that changes by less are not normal numbers


def gradient(loss, x, gradient=None, steps=None, directions=3, rng=None):
    """Audit the gradient of a loss at x: does it agree with what the loss does?

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``. Any function: of this library, of autograd, or foreign.
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

    Returns
    -------
    Audit
        `.verdict` is "agrees" (with `.digits`), "disagrees" or "inconclusive" (with `.reason`); true only
        for "agrees", so that ``assert dp.check.gradient(loss, x)`` works. `.rows` are the numbers,
        `.lines` the judgement of each direction, str() the table, `.to_dict()` plain data.

    Raises
    ------
    ValueError
        If `steps` are fewer than eight, or not positive.
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
    point, trials = Point(x), Trials(loss)
    chosen = default_steps(point.eps) if steps is None else _checked(steps)
    base = trials.value(point.tree())
    leaves, doubts = _own_gradient(loss, point, trials, base, gradient)
    lines, judged = [], []
    if math.isfinite(base) and all(np.all(np.isfinite(g)) for g in leaves):
        for name, direction in point.directions(leaves, directions, generator(rng)):
            lines.append(Line(name, direction, point, leaves, trials, base))
            judged.append(measured(lines[-1], chosen, point, trials, extend=steps is None))
        if gradient is None:
            doubts += _forward_mode(loss, point, lines[:directions], judged)
        doubts += _complex_step(loss, point, lines[:directions], base)
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
    return Audit(verdict, reason, judged, lines, base, trials.count, point.size, notes, culprit)


def _culprit(loss, point):
    """(name, sentence) of the first call at fault."""
    fault = culprit_of(loss, point)
    if fault is None:
        return None, "culprit: every call on the tape is right at the values it met; a value may bypass the tape"
    return fault.name, f"culprit: {fault.name}, {fault.reason}"


def _checked(steps):
    steps = tuple(float(step) for step in steps)
    if len(set(steps)) < FEWEST_STEPS or not all(0 < step < math.inf for step in steps):
        raise ValueError(f"a sweep needs at least {FEWEST_STEPS} different positive steps, got {steps}")
    return steps


def _own_gradient(loss, point, trials, base, given):
    """Leaves of the gradient, and the doubts that come before any difference."""
    doubts = []
    if not math.isfinite(base):
        doubts.append(("inconclusive", f"the loss is {base} at x"))
    elif _bits(trials.value(point.tree())) != _bits(base):
        doubts.append(("inconclusive", "two evaluations of the loss differ: it is not deterministic"))
    if given is not None and not callable(given):
        return point.leaves_of(given), doubts
    evaluate = (lambda x: value_and_grad(loss)(x)[1]) if given is None else given
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


def _forward_mode(loss, point, lines, judged):
    """Forward mode against reverse mode along the random directions, where every rule has a JVP.

    They may differ by APART of the derivative, by SOLVED where the ledger shows a solve or the loss is noisy.
    """
    worst, text, allowed = 0.0, "", max(APART, 300 * point.eps)
    for line, found in zip(lines, judged, strict=False):
        tangent = [d.astype(x.dtype) for d, x in zip(line.direction, point.values, strict=True)]
        try:
            with np.errstate(all="ignore"):
                _, slope = pushforward(loss, point.tree(), point.tree(tangent))
        except NO_JVP:
            return [("", "forward mode: not available, a rule has no JVP")]
        wanted = dot(line.gradient, tangent)
        if found.jitter > ROUNDING or line.solved:
            allowed = max(allowed, SOLVED)
        scale = max(found.scale, abs(wanted), line.typical)
        gap = 0.0 if slope == wanted else abs(float(slope) - wanted) / scale
        if not gap <= worst:
            worst, text = gap, f"{float(slope):.9g} beside {wanted:.9g} along {line.name}"
    loosest = max((line.tolerance for line in lines), default=0.0)
    if not worst <= allowed and worst <= FORGIVEN * loosest:
        reason = f"forward and reverse mode differ by {worst:.0e}, which solves to rtol {loosest:g} may leave"
        return [("open", f"{reason}; tighten them")]
    if not worst <= allowed:
        return [("disagrees", f"forward and reverse mode differ: {text}; the JVP or the VJP of a rule is wrong")]
    return [("", f"forward mode: agrees with reverse mode to {worst:.0e}")]


def _complex_step(loss, point, lines, base):
    """Im f(x + i t d) / t beside g . d: exact to rounding where the code is analytic, and else only a note.

    Source: W. Squire and G. Trapp, SIAM Review 40, 1998.
    """
    worst = 0.0
    for line in lines if not any(x.dtype.kind == "c" for x in point.values) else ():
        moved = [x + 1j * TINY_STEP * d for x, d in zip(point.values, line.direction, strict=True)]
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a discarded imaginary part shows in the figure
                value = complex(loss(point.tree(moved, exact=False)))
        except Exception:  # a loss of real numbers may refuse complex ones in any way
            return []
        scale = max(abs(line.slope), line.typical)
        if value.imag == 0 or not abs(value.real - base) <= 1e-9 * abs(base) or not scale:
            return []
        worst = max(worst, abs(value.imag / TINY_STEP - line.slope) / scale)
    return [("", f"complex step: agrees to {worst:.0e}")] if lines and worst <= APART else []


def _bits(value):
    return np.float64(value).tobytes()
