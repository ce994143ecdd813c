"""One run of a scene at an extreme point, and the word for what came out of it."""

import math
import re
import warnings
from typing import Any, NamedTuple

import numpy as np

from sparsedp.derivative import value_and_grad
from sparsedp.errors import SparsedpError
from sparsedp.ledger import thread
from sparsedp.tape import is_variable
from sparsedp.tree import flatten, norm

__all__ = ["DEGRADED", "FAILED", "PASSED", "REFUSED", "Outcome", "finite", "must_refuse", "run", "same"]

PASSED, REFUSED, DEGRADED, FAILED = "passed", "refused correctly", "degraded", "FAILED"
STEPS = (1e-4, 1e-5, 1e-3, 1e-6, 1e-2, 1e-7)  # of differences, in units of x; those that mostly serve come first
GOOD, BAD = 1e-5, 1e-2  # gaps between gradient and differences
EPS = np.finfo(float).eps
UNSEEN = 100 * EPS  # changes of the value, relative, that no difference sees


class Outcome(NamedTuple):
    """What one run gave: value and gradient leaves, or the error."""

    value: float
    gradient: Any
    error: Any = None
    flagged: bool = False  # the gradient grew without bound on its way back

    @property
    def finite(self):
        return math.isfinite(self.value) and all(np.all(np.isfinite(g)) for g in self.gradient)

    @property
    def typed(self):
        """Whether the error is one that the house raises on purpose."""
        chance = (np.linalg.LinAlgError, UnicodeError)
        return isinstance(self.error, (SparsedpError, ValueError, TypeError)) and not isinstance(self.error, chance)

    @property
    def words(self):
        return " ".join(f"{type(self.error).__name__}: {self.error}".split())


def run(loss, x):
    """Value and gradient of a loss at x -> Outcome; whatever it raises is part of it."""
    grown = thread.grown
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            value, gradient = value_and_grad(loss)(x)
        except Exception as error:  # a scene may raise anything: its row shows it
            return Outcome(math.nan, [], error)
    leaves = [np.asarray(g) for g in flatten(gradient)[0] if g is not None]
    return Outcome(float(value), leaves, None, thread.grown > grown)


def finite(loss, x, strict=True):
    """(word, figure, note): the run must end with finite numbers and the gradient agree with differences.

    strict: numbers that are not finite are a failure; otherwise they are shown, which is degraded.
    """
    out = run(loss, x)
    if out.error is not None:
        return (REFUSED if out.typed else DEGRADED), math.nan, out.words
    if not out.finite:
        what = f"value {out.value:g}" if not math.isfinite(out.value) else "the gradient is not finite"
        return (FAILED if strict else DEGRADED), math.nan, f"{what}, and no error"
    return _slope(loss, x, out)


def _slope(loss, x, out):
    """The gradient against central differences along itself."""
    found, rebuild = flatten(x)
    places = [i for i, leaf in enumerate(found) if is_variable(leaf)]
    units = [_unit(found[i]) for i in places]
    slopes = [unit * g for unit, g in zip(units, out.gradient, strict=True)]
    size = norm(slopes)
    if size == 0:
        return PASSED, 0.0, "gradient 0"
    many = math.sqrt(sum(np.size(s) for s in slopes))
    moves = [unit * np.conj(s / size) * many for unit, s in zip(units, slopes, strict=True)]
    wanted = sum(float(np.sum(g * d).real) for g, d in zip(out.gradient, moves, strict=True))
    if abs(wanted) <= UNSEEN * abs(out.value):
        return PASSED, 0.0, "the gradient is smaller than differences can see"
    gaps, noises = [], []
    for t in STEPS:
        ends = [_value(loss, _moved(found, rebuild, places, moves, sign * t)) for sign in (1, -1)]
        slope = ends[0] / (2 * t) - ends[1] / (2 * t)
        gaps.append(abs(slope - wanted) / abs(wanted) if math.isfinite(slope) else math.inf)
        noises.append(10 * EPS * abs(out.value) / (t * abs(wanted)))
        if gaps[-1] <= GOOD:
            return PASSED, gaps[-1], ""
    best = min(gaps)
    return _gap_word(best, gaps, min(noises), out.flagged)


def _gap_word(best, gaps, noise, flagged):
    if not math.isfinite(best):
        return DEGRADED, math.nan, "no difference could be taken beside it"
    if best <= BAD or noise > BAD or flagged:
        why = "the gradient grows without bound on its way back" if flagged else "gradient against differences"
        return DEGRADED, best, why
    settled = sorted(gaps)[:3]
    if settled[-1] - settled[0] <= 0.1 * settled[0]:
        return FAILED, best, "the differences settle on another gradient"
    return DEGRADED, best, "the differences do not settle: a kink, noise or a steep change"


def _unit(leaf):
    return norm(leaf) / math.sqrt(max(np.size(leaf), 1)) or 1.0


def _moved(found, rebuild, places, moves, t):
    leaves = list(found)
    for i, move in zip(places, moves, strict=True):
        leaves[i] = np.asarray(found[i] + t * move) if isinstance(found[i], np.ndarray) else float(found[i] + t * move)
    return rebuild(leaves)


def _value(loss, x):
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return float(loss(x))
        except Exception:  # the step is of no use, whatever it raised
            return math.nan


def must_refuse(loss, x, spoilt=None):
    """(word, figure, note): the run must end with a typed error.

    spoilt: name of the parameter that holds NaN or infinity. Then the error has to say which number it is, or where
    the first one stands (a loss may have moved it on the way), or to name the parameter.
    """
    out = run(loss, x)
    if out.error is not None and out.typed and spoilt is not None and not _located(out.words, spoilt):
        return DEGRADED, math.nan, f"refused without a name or a place: {out.words}"
    if out.error is not None:
        return (REFUSED if out.typed else DEGRADED), math.nan, out.words
    if spoilt is not None and out.finite:
        return FAILED, out.value, "swallowed: the value and the gradient are finite"
    return DEGRADED, math.nan, f"taken without an error; value {out.value:g}"


def _located(words, name):
    return re.search(rf"the first at|got -?(nan|inf)\b|\b{re.escape(name)}\b", words) is not None


def same(loss, x, base, tolerance=0.0):
    """(word, figure, note): value and gradient must be those of the plain case, to the last bit or a tolerance."""
    kept = [leaf.tobytes() if isinstance(leaf, np.ndarray) else leaf for leaf in flatten(x)[0]]
    out = run(loss, x)
    if out.error is not None:
        return (REFUSED if tolerance and out.typed else FAILED), math.nan, out.words
    if kept != [leaf.tobytes() if isinstance(leaf, np.ndarray) else leaf for leaf in flatten(x)[0]]:
        return FAILED, math.nan, "the input was modified"
    gap = apart(out, base)
    if gap <= tolerance:
        return PASSED, gap, ""
    return (DEGRADED if gap <= max(1e-10, 100 * tolerance) else FAILED), gap, "differs from the plain case"


def apart(out, base):
    """Largest relative distance of two outcomes, of value or gradient."""
    gaps = [abs(out.value - base.value) / abs(base.value) if base.value else abs(out.value)]
    size = norm(base.gradient)
    moved = norm([np.asarray(a, float) - b for a, b in zip(out.gradient, base.gradient, strict=True)])
    gap = max(*gaps, moved / size if size else moved)
    return gap if math.isfinite(gap) else math.inf
