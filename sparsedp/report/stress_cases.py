"""The stress cases of a scene: extreme values of its parameters, and what has to come out of each.

CASES is the table: for each group the parameters it applies to, the values to try, and the judge of what comes out.
A judge gives (word, figure, note); the words are PASSED, REFUSED, DEGRADED and FAILED.
"""

import math
import re
import warnings
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from sparsedp.check.point import Point
from sparsedp.derivative import value_and_grad
from sparsedp.errors import SparsedpError
from sparsedp.ledger import thread
from sparsedp.report.certificate import distance
from sparsedp.report.stability import SEED, STEADY, growth_of
from sparsedp.tape import is_variable
from sparsedp.tree import copied, flatten, norm

__all__ = ["FAILED", "GROUPS", "WORDS", "Scene", "cases", "run"]

WORDS = PASSED, REFUSED, DEGRADED, FAILED = "passed", "refused correctly", "degraded", "FAILED"
NAMES = {"time step": ("dt", "time_step", "tau"), "viscosity": ("nu", "viscosity", "diffusivity", "kappa", "mu")}
EPS = np.finfo(float).eps
DIFFERENCES = (1e-4, 1e-5, 1e-3, 1e-6, 1e-2, 1e-7)  # their steps, in units of x; those that mostly serve come first
GOOD, BAD = 1e-5, 1e-2  # gaps between gradient and differences
UNSEEN = 100 * EPS  # changes of the value, relative, that no difference sees
ROUNDING = 8 * EPS  # change of x in its last digits
WEAK, LOST = 1e-8, 1e-5  # changes of the result by that: allowed, and too large
FINER = 8.0  # of the time step, to tell physics that grows from a step that does
LARGEST = 960  # power of 2 up to which a value is sure to be representable

# Group -> why it may have no case in a scene.
GROUPS = {
    "as given": "",
    "scaling": "every parameter is 0, or its range leaves no room",
    "legal range": "no ranges were given; write ranges={'name': (low, high)}",
    "zeros and signs": "outside the legal ranges",
    "jumps": "no array of positive numbers without a range (arrays with a range jump between its ends)",
    "constant added": "no array that is not 0",
    "not finite": "the loss depends on no parameter",
    "kinds of arrays": "no arrays",
    "time step and viscosity": "no parameter has such a name; write time_step='name', viscosity='name'",
}


# ---------------------------------------------------------------- a scene and its parameters


class Scene:
    """A loss at a point, its named parameters, their legal ranges, and which are time step and viscosity.

    Attributes
    ----------
    leaves : dict
        Name -> array or float: the floating leaves of x.
    ranges : dict
        Name -> (low, high).
    named : dict
        "time step", "viscosity" -> name of the parameter, or None.
    base : Outcome
        Value and gradient as given.
    growth : Growth or None
    """

    def __init__(self, loss, x, ranges, step, time_step, viscosity):
        self.loss, self.step = loss, step
        point = Point(x)
        self._found, self._rebuild = flatten(x)
        names = [re.sub(r"^\['?([^\[\]']*)'?\]$", r"\1", name.removeprefix("x") or "x") for name in point.names]
        self._places = dict(zip(names, point.places, strict=True))
        self.leaves = {name: self._found[place] for name, place in self._places.items()}
        if isinstance(ranges, (tuple, list)) and len(names) == 1:
            ranges = {names[0]: ranges}
        self.ranges = {name: self._limits(name, limits) for name, limits in (ranges or {}).items()}
        self.named = {
            kind: self._known(name) if name else next((word for word in words if word in names), None)
            for (kind, words), name in zip(NAMES.items(), (time_step, viscosity), strict=True)
        }
        self.base = run(loss, self.at())
        self.growth = growth_of(loss, self.at(), step)

    def at(self, other=None):
        """The tree x with other values of some parameters; always fresh copies."""
        leaves = copied(self._found)
        for name, value in (other or {}).items():
            plain = isinstance(self.leaves[name], float) and np.asarray(value).dtype.kind == "f"
            leaves[self._places[name]] = float(value) if plain else value
        return self._rebuild(leaves)

    def _limits(self, name, limits):
        self._known(name)
        low, high = map(float, limits) if np.size(limits) == 2 else (math.nan, math.nan)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"stress needs ranges of two finite numbers, low < high, got {limits!r} for {name}")
        return low, high

    def _known(self, name):
        if name not in self.leaves:
            raise ValueError(f"stress knows the parameters {', '.join(self.leaves)}, got {name!r}; write one of them")
        return name


class Parameter:
    """One parameter of a scene; without a name all of them, whose value is a dict."""

    def __init__(self, scene, name="", leaf=None):
        self.scene, self.name, self.leaf = scene, name, leaf
        self.low, self.high = scene.ranges.get(name, (-math.inf, math.inf))
        self.ranged, self.many = name in scene.ranges, np.size(leaf) > 1
        self.kind = next((kind for kind, other in scene.named.items() if other == name), None)

    def point(self, value):
        """The point of the scene with another value of this parameter."""
        return self.scene.at({self.name: value} if self.name else value)

    def run(self, value):
        """What the loss gives at that point."""
        return run(self.scene.loss, self.point(value))

    def legal(self, value):
        """Whether a value lies in the range of the parameter; without a range everything does."""
        return bool(np.all(value >= self.low) and np.all(value <= self.high))

    def fault(self, value):
        """The word for a wrong number: FAILED as given, in a stated range, and without viscosity."""
        inviscid = self.kind == "viscosity" and not np.any(value)
        return FAILED if not self.name or inviscid or (self.ranged and self.legal(value)) else DEGRADED

    def filled(self, value):
        """The same number everywhere."""
        return np.full_like(self.leaf, value) if np.ndim(self.leaf) else float(value)

    @cached_property
    def size(self):
        """Root mean square of an array; 0 for a single number."""
        return float(np.sqrt(np.mean(np.square(self.leaf)))) if self.many else 0.0

    @cached_property
    def steepest(self):
        """Index of the entry with the largest derivative; None where the loss does not depend on the parameter."""
        if not self.name or not self.scene.base.gradient:
            return None
        g = np.abs(self.scene.base.gradient[list(self.scene.leaves).index(self.name)])
        return np.unravel_index(int(np.argmax(g)), g.shape) if np.max(g, initial=0.0) > 0 else None

    @cached_property
    def degree(self):
        """d, where the loss is a monomial s^d in the scale s of the parameter; None where it is not."""
        outcomes = [self.run(s * self.leaf) for s in (0.5, 1.0, 2.0)]
        if not all(out.finite and out.value for out in outcomes):
            return None
        half, one, two = (math.log2(abs(out.value)) for out in outcomes)
        degree = round(two - one)
        return degree if degree and abs(two - one - degree) + abs(one - half - degree) < 1e-12 else None


# ---------------------------------------------------------------- runs


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
    def refusal(self):
        """What a judge says of the error: one that the library raises on purpose is right."""
        chance = isinstance(self.error, (np.linalg.LinAlgError, UnicodeError))
        typed = isinstance(self.error, (SparsedpError, ValueError, TypeError)) and not chance
        words = " ".join(f"{type(self.error).__name__}: {self.error}".split())
        return (REFUSED if typed else DEGRADED), math.nan, words


def run(loss, x):
    """Value and gradient of a loss at x -> Outcome; whatever it raises is part of it."""
    grown = thread.grown
    result = _attempt(value_and_grad(loss), x)
    if isinstance(result, Exception):
        return Outcome(math.nan, [], result)
    gradient = [np.asarray(g) for g in flatten(result[1])[0] if g is not None]
    return Outcome(float(result[0]), gradient, None, thread.grown > grown)


def _attempt(function, x):
    """function(x) or what it raises, without warnings."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return function(x)
        except Exception as error:  # a scene may raise anything: its row shows it
            return error


# ---------------------------------------------------------------- judges: (parameter, value) -> (word, figure, note)


def finite(p, value):
    """The run ends with finite numbers, and the gradient agrees with differences. As given, it may not be refused."""
    out = p.run(value)
    if out.error is not None:
        word, *rest = out.refusal
        return FAILED if word == REFUSED and not p.name else word, *rest
    if not out.finite:
        what = f"value {out.value:g}" if not math.isfinite(out.value) else "the gradient is not finite"
        return p.fault(value), math.nan, f"{what}, and no error"
    return _against_differences(p.scene.loss, p.point(value), out)


def steady(p, value):
    """As `finite`, and the step at that point does not grow by the fault of the scheme."""
    verdict = finite(p, value)
    growth = verdict[0] == PASSED and p.scene.growth and growth_of(p.scene.loss, p.point(value), p.scene.step)
    if growth and growth.factor > STEADY and growth.flips:
        return p.fault(value), growth.factor, "growth factor of a step: unstable, and no error"
    return verdict


def near(p, value, good=0.0, bad=1e-10, note="differs from the plain case", unit=1.0):
    """Value and gradient are those of the plain case to `good` (0: to the last bit), or to `bad`, which is degraded."""
    x, base = p.point(value), p.scene.base
    before = _bits(x)
    out = run(p.scene.loss, x)
    if out.error is not None or base.error is not None:
        word, *rest = (base if out.error is None else out).refusal
        return word if good else FAILED, *rest
    if _bits(x) != before:
        return FAILED, math.nan, "the input was modified"
    pairs = (out.value, base.value), (out.gradient, base.gradient)
    return _graded(max(distance(*pair) / (norm(pair[1]) or 1.0) for pair in pairs), good, bad, note, unit)


def _bits(x):
    return [leaf.tobytes() if isinstance(leaf, np.ndarray) else leaf for leaf in flatten(x)[0]]


def _graded(gap, good, bad, note, unit=1.0):
    word = PASSED if gap <= good else DEGRADED if gap <= bad else FAILED
    return word, gap, "" if word == PASSED else note.format(gap / unit)


def shifted(p, value, share):
    """Incompatible data of a singular system: projected or refused, never amplified."""
    if share == 1:
        return finite(p, value)
    note = "amplified by {:.0e}: is a null space left in?"
    return near(p, value, max(1e4 * share, WEAK), max(1e6 * share, LOST), note, share)


def scaled(p, value, exponent):
    """A monomial scales exactly; another loss is judged at the new point as it is."""
    if p.degree is None:
        return steady(p, value)
    out, power = p.run(value), p.degree * exponent
    if out.error is not None:
        return out.refusal
    if abs(math.log2(abs(p.scene.base.value)) + power) > LARGEST:
        return DEGRADED, math.nan, f"the value is {out.value:g}: not representable"
    gap = abs(out.value / math.ldexp(p.scene.base.value, power) - 1.0)
    return _graded(gap, 1e-12, 1e-3, f"is not 2^{power} times the plain value")


def refused(p, value, located=False):
    """The run ends with a typed error.

    located: it has to say which number is wrong, or where the first one stands (a loss may have moved it on the
    way), or to name the parameter.
    """
    out = p.run(value)
    if out.error is not None:
        word, figure, words = out.refusal
        place = rf"the first at|got -?(nan|inf)\b|\b{re.escape(p.name)}\b"
        if word == REFUSED and located and not re.search(place, words):
            return DEGRADED, figure, f"refused without a name or a place: {words}"
        return word, figure, words
    if located and out.finite:
        return FAILED, out.value, "swallowed: the value and the gradient are finite"
    return DEGRADED, math.nan, f"taken without an error; value {out.value:g}"


def growing(p, _):
    """The growth factor of a step: above 1 is right only if the physics grows."""
    scene, growth, dt = p.scene, p.scene.growth, p.scene.named["time step"]
    if growth is None:
        return None, math.nan, "no rollout in the loss; give step=lambda x: (advance, state)"
    if growth.refusal:
        return REFUSED, math.nan, growth.refusal
    if growth.factor <= STEADY:
        return PASSED, growth.factor, ""
    if growth.flips:
        return FAILED, growth.factor, "grows and changes its sign from step to step: the step is too large"
    if dt is None:
        return DEGRADED, growth.factor, "grows; name the time step, so that physics and step can be told apart"
    finer = growth_of(scene.loss, scene.at({dt: scene.leaves[dt] / FINER}), scene.step).factor
    if finer > 1 and math.log(growth.factor) <= 4 * FINER * math.log(finer):
        return PASSED, growth.factor, "grows as the physics does"
    return FAILED, growth.factor, "grows, and does not with a smaller step"


def _against_differences(loss, x, out):
    """The gradient against central differences along itself, in units of each leaf: its root mean square."""
    found, rebuild = flatten(x)
    units = [norm(leaf) / math.sqrt(max(np.size(leaf), 1)) or 1.0 for leaf in found if is_variable(leaf)]
    slopes = [unit * g for unit, g in zip(units, out.gradient, strict=True)]
    size = norm(slopes)
    if size == 0:
        return PASSED, 0.0, "gradient 0"
    stretch = math.sqrt(sum(map(np.size, slopes)))  # of a direction of norm 1, so that entries move by t
    wanted = size * stretch  # the derivative along it
    if wanted <= UNSEEN * abs(out.value):
        return PASSED, 0.0, "the gradient is smaller than differences can see"

    def value(t):
        moves = (t * stretch * unit * np.conj(s / size) for unit, s in zip(units, slopes, strict=True))
        moved = rebuild(leaf + next(moves) if is_variable(leaf) else leaf for leaf in found)
        result = _attempt(lambda x: float(loss(x)), moved)
        return math.nan if isinstance(result, Exception) else result  # the step is of no use, whatever was raised

    gaps = []
    for t in DIFFERENCES:
        gap = abs(value(t) / (2 * t) - value(-t) / (2 * t) - wanted) / wanted
        gaps.append(gap if math.isfinite(gap) else math.inf)
        if gap <= GOOD:
            return PASSED, gap, ""
    best, _, third, *_ = sorted(gaps)
    if not math.isfinite(best):
        return DEGRADED, math.nan, "no difference could be taken beside it"
    if out.flagged:
        return DEGRADED, best, "the gradient grows without bound on its way back"
    noise = 10 * EPS * abs(out.value) / (max(DIFFERENCES) * wanted)  # of the coarsest difference
    if best <= BAD or noise > BAD:
        return DEGRADED, best, "gradient against differences"
    if third - best <= 0.1 * best:
        return FAILED, best, "the differences settle on another gradient"
    return DEGRADED, best, "the differences do not settle: a kink, noise or a steep change"


# ---------------------------------------------------------------- the table


class Group(NamedTuple):
    """Cases of one kind: whom they apply to, and for each judge the values it sees, by the name of the case."""

    name: str
    applies: Any  # (parameter) -> bool
    rows: tuple  # of pairs: (parameter) -> {case: value}, judge(parameter, value)
    legal: bool = False  # values outside the range of a parameter are left out


def _random():
    return np.random.default_rng(SEED)


def _points(p):
    spread = np.geomspace if p.low > 0 and p.high > 10 * p.low else np.linspace
    return {f"all {value:.3g}": p.filled(value) for value in spread(p.low, p.high, 5)}


def _within(p):
    odd = np.arange(np.size(p.leaf)).reshape(np.shape(p.leaf)) % 2
    spread = p.low + (p.high - p.low) * _random().random(np.shape(p.leaf))
    jump = {f"jumps {p.low:.3g} to {p.high:.3g}": np.where(odd, p.high, p.low)}
    return jump | {"random in its range": spread} if p.many else {}


def _outside(p):
    ends = {"below its range": 2 * p.low - p.high, "above its range": 2 * p.high - p.low}
    return {case: p.filled(value) for case, value in ends.items() if math.isfinite(value)}


def _jumps(p):
    half = np.where(np.arange(p.leaf.size) < p.leaf.size // 2, 1e-4, 1e4)
    sizes = {"jump of 1e8": half, "random over 8 decades": 10.0 ** _random().uniform(-4, 4, p.leaf.size)}
    return {case: p.leaf * size.reshape(p.leaf.shape) for case, size in sizes.items()}


def _spoilt(p):
    hole = np.zeros(np.shape(p.leaf))
    hole[p.steepest] = 1.0
    return {f"one {bad}": np.where(hole, bad, p.leaf) if np.ndim(p.leaf) else bad for bad in (math.nan, math.inf)}


def _copies(p):
    fixed = p.leaf.copy()
    fixed.flags.writeable = False
    wide = np.repeat(p.leaf, 2, axis=-1)
    kinds = {
        "Fortran order": np.asfortranarray(p.leaf),
        "strided": wide[..., ::2],
        "reversed": p.leaf[::-1].copy()[::-1],
    }
    return {"read-only": fixed, **kinds}


def _longer(p):
    shape = (len(p.leaf) + 1, *p.leaf.shape[1:])
    return {f"shape {shape}": np.resize(p.leaf, shape), "complex": p.leaf + 1j * p.leaf}


def _last_digits(p):
    rng = _random()
    return {"last digits of x changed": {
        name: leaf * (1 + ROUNDING * rng.choice([-1.0, 1.0], np.shape(leaf))) for name, leaf in p.scene.leaves.items()
    }}  # fmt: skip


def _integers(p):
    return {"all integers": {name: np.asarray(leaf).astype(int) for name, leaf in p.scene.leaves.items()}}


def _wrong_signs(p):
    values = (0.0 * p.leaf, -p.leaf) if p.kind == "time step" else (-p.leaf,)
    return {f"{np.min(value):g}": value for value in values}


def _all(p):
    return not p.name


ROUNDED = partial(near, good=WEAK, bad=LOST, note="rounding is amplified by {:.0e}", unit=ROUNDING)
CASES = (
    Group("as given", _all, (
        (lambda p: {"value and gradient": {}}, finite),
        (lambda p: {"two runs": {}}, near),
        (_last_digits, ROUNDED),
        (lambda p: {"growth in one step": {}}, growing),
    )),
    Group("scaling", lambda p: p.name and np.any(p.leaf), tuple(
        (lambda p, e=e: {f"times 2^{e}": p.leaf * 2.0**e}, partial(scaled, exponent=e))
        for e in (1, -1, 10, -10, 100, -100, 900, -900)
    ), legal=True),
    Group("legal range", lambda p: p.ranged, ((_points, steady), (_within, steady), (_outside, steady))),
    Group("zeros and signs", lambda p: p.name and not p.kind, (
        (lambda p: {"all 0": 0.0 * p.leaf, "sign changed": -1.0 * p.leaf}, finite),
    ), legal=True),
    Group("jumps", lambda p: p.many and np.all(p.leaf > 0) and not p.ranged, ((_jumps, finite),)),
    Group("constant added", lambda p: p.size, tuple(
        (lambda p, s=s: {f"plus {s:g} of itself": p.leaf + s * p.size}, partial(shifted, share=s))
        for s in (1e-14, 1e-7, 1.0)
    ), legal=True),
    Group("not finite", lambda p: p.steepest is not None, ((_spoilt, partial(refused, located=True)),)),
    Group("kinds of arrays", lambda p: isinstance(p.leaf, np.ndarray) and p.leaf.ndim, (
        (_copies, near),
        (lambda p: {"float32": p.leaf.astype(np.float32)}, partial(near, good=1e-4, bad=1e-2)),
        (_longer, refused),
    )),
    Group("kinds of arrays", _all, ((_integers, refused),)),
    Group("time step and viscosity", lambda p: p.kind, (
        (lambda p: {f"times {f:g}": p.leaf * f for f in (1e-8, 1e-4, 1e-2, 1e-1, 1e1, 1e2, 1e4, 1e8)}, steady),
        (lambda p: {"0": 0.0 * p.leaf} if p.kind == "viscosity" else {}, finite),
    ), legal=True),
    Group("time step and viscosity", lambda p: p.kind, ((_wrong_signs, refused),)),
)  # fmt: skip


def cases(scene, groups):
    """Scene and names of groups -> (group, parameter, case, function that gives (word, figure, note))."""
    parameters = [Parameter(scene), *(Parameter(scene, name, leaf) for name, leaf in scene.leaves.items())]
    for group in CASES:
        for p in filter(group.applies, parameters if group.name in groups else ()):
            for values, judge in group.rows:
                for case, value in values(p).items():
                    if not group.legal or p.legal(value):
                        yield group.name, p.name, case, partial(judge, p, value)
