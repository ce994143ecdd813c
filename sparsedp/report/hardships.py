"""The extreme cases that a scene is driven through: for each, the point, and what has to come out of it."""

import math
from functools import partial

import numpy as np

from sparsedp.check.probes import generator
from sparsedp.report.growth import STEADY, growth_of
from sparsedp.report.trial import (
    DEGRADED,
    FAILED,
    PASSED,
    REFUSED,
    Outcome,
    apart,
    finite,
    must_refuse,
    run,
    same,
)
from sparsedp.tape import is_variable

__all__ = ["GROUPS", "cases"]

EXPONENTS = (1, -1, 10, -10, 100, -100, 900, -900)
SWEEP = (1e-8, 1e-4, 1e-2, 1e-1, 1e1, 1e2, 1e4, 1e8)
SHIFTS = (1e-14, 1e-7, 1.0)
ROUNDING = 8 * np.finfo(float).eps
LOST, WEAK = 1e-5, 1e-8  # changes of the result by a change of x in its last digits
FINER = 8.0  # of the time step, to tell physics that grows from a step that does


def cases(scene):
    """Scene -> (group, parameter, case, function that gives (word, figure, note)), in the order of the table."""
    for make in GROUPS:
        for name, case, test in make(scene):
            yield make.__name__.strip("_").replace("_", " "), name, case, test


def _as_given(scene):
    yield "", "value and gradient", partial(_at_home, scene)
    yield "", "two runs", lambda: same(scene.loss, scene.at(), scene.base)
    yield "", "last digits of x changed", partial(_rounding, scene)
    yield "", "growth in one step", partial(_growth, scene)


def _at_home(scene):
    word, figure, note = finite(scene.loss, scene.at())
    return (FAILED if word == REFUSED else word), figure, note


def _rounding(scene):
    """A change of x by rounding must not change the result by more than rounding and solves can explain."""
    if scene.base.error is not None:
        return FAILED, math.nan, scene.base.words
    rng = generator(None)
    moved = {name: _signs(rng, leaf) for name, leaf in scene.leaves.items()}
    return _response(run(scene.loss, scene.at(moved)), scene.base)


def _signs(rng, leaf):
    return leaf * (1 + ROUNDING * rng.choice([-1.0, 1.0], np.shape(leaf)))


def _response(out, base):
    if out.error is not None:
        return (REFUSED if out.typed else DEGRADED), math.nan, out.words
    gap = apart(out, base)
    word = PASSED if gap <= WEAK else DEGRADED if gap <= LOST else FAILED
    return word, gap, "" if word == PASSED else f"rounding is amplified by {gap / ROUNDING:.0e}"


def _growth(scene):
    """The growth factor of a step: above 1 is right only if the physics grows."""
    found = scene.growth
    if found is None:
        return None, math.nan, "no rollout in the loss; give step=lambda x: (advance, state)"
    if found.refusal:
        return REFUSED, math.nan, found.refusal
    if found.factor <= STEADY:
        return PASSED, found.factor, ""
    if found.flips:
        return FAILED, found.factor, "grows and changes its sign from step to step: the step is too large"
    dt = scene.named["time step"]
    if dt is None:
        return DEGRADED, found.factor, "grows; name the time step, so that physics and step can be told apart"
    finer = growth_of(scene.loss, scene.at({dt: scene.leaves[dt] / FINER}), scene.step)
    if math.log(found.factor) <= 4 * FINER * abs(math.log(max(finer.factor, 1e-300))) and finer.factor > 1:
        return PASSED, found.factor, "grows as the physics does"
    return FAILED, found.factor, "grows, and does not with a smaller step"


def _scaling(scene):
    for name, leaf in scene.leaves.items():
        degree = _degree(scene, name) if np.any(leaf) else None
        for exponent in EXPONENTS if np.any(leaf) else ():
            if scene.legal(name, leaf * 2.0**exponent):
                yield name, f"times 2^{exponent}", partial(_scaled, scene, name, exponent, degree)


def _degree(scene, name):
    """d, where the loss is a monomial s^d in the scale s of a parameter; None where it is not."""
    values = [run(scene.loss, scene.at({name: s * scene.leaves[name]})) for s in (1.0, 2.0, 0.5)]
    if any(out.error is not None or not out.finite or out.value == 0 for out in values):
        return None
    one, two, half = (math.log2(abs(out.value)) for out in values)
    degree = round(two - one)
    return degree if degree and abs(two - one - degree) + abs(one - half - degree) < 1e-12 else None


def _steady(scene, other, strict=True):
    """As `finite`, and the step at that point must not grow by the fault of the scheme."""
    word, figure, note = finite(scene.loss, scene.at(other), strict)
    if word == PASSED and scene.growth is not None:
        found = growth_of(scene.loss, scene.at(other), scene.step)
        if found is not None and found.factor > STEADY and found.flips:
            return (FAILED if strict else DEGRADED), found.factor, "growth factor of a step: unstable, and no error"
    return word, figure, note


def _scaled(scene, name, exponent, degree):
    other = {name: scene.leaves[name] * 2.0**exponent}
    if degree is None:
        return _steady(scene, other, strict=name in scene.ranges)
    out = run(scene.loss, scene.at(other))
    if out.error is not None:
        return (REFUSED if out.typed else DEGRADED), math.nan, out.words
    beyond = abs(math.log2(abs(scene.base.value)) + degree * exponent) > 960
    if beyond:
        return DEGRADED, math.nan, f"the value is {out.value:g}: not representable"
    wanted = scene.base.value * 2.0 ** (degree * exponent)
    gap = apart(Outcome(out.value / wanted, []), Outcome(1.0, []))
    word = PASSED if gap <= 1e-12 else DEGRADED if gap <= 1e-3 else FAILED
    return word, gap, "" if word == PASSED else f"is not 2^{degree * exponent} times the plain value"


def _legal_range(scene):
    for name, (low, high) in scene.ranges.items():
        leaf = scene.leaves[name]
        for value in _points(low, high):
            yield name, f"all {value:.3g}", partial(_steady, scene, {name: _filled(leaf, value)})
        if np.size(leaf) > 1:
            jump = np.where(np.arange(np.size(leaf)).reshape(np.shape(leaf)) % 2, high, low)
            yield name, f"jumps {low:.3g} to {high:.3g}", partial(_steady, scene, {name: jump})
            spread = low + (high - low) * generator(None).random(np.shape(leaf))
            yield name, "random in its range", partial(_steady, scene, {name: spread})
        for case, value in (("below its range", low - (high - low)), ("above its range", high + (high - low))):
            if math.isfinite(value):
                yield name, case, partial(_outside, scene, {name: _filled(leaf, value)})


def _outside(scene, other):
    return _steady(scene, other, strict=False)


def _points(low, high):
    if low > 0 and high > 10 * low:
        return np.geomspace(low, high, 5)
    return np.linspace(low, high, 5)


def _filled(leaf, value):
    return np.full(np.shape(leaf), value, getattr(leaf, "dtype", float)) if np.ndim(leaf) else float(value)


def _zeros_and_signs(scene):
    for name, leaf in scene.leaves.items():
        if name in scene.named.values():
            continue
        for case, value in (("all 0", 0.0 * leaf), ("sign changed", -1.0 * leaf)):
            if scene.legal(name, value):
                yield name, case, partial(finite, scene.loss, scene.at({name: value}), strict=name in scene.ranges)


def _jumps(scene):
    for name, leaf in scene.leaves.items():
        if np.size(leaf) > 1 and np.all(leaf > 0) and name not in scene.ranges:
            sizes = {"jump of 1e8": np.where(np.arange(np.size(leaf)) < np.size(leaf) // 2, 1e-4, 1e4)}
            sizes["random over 8 decades"] = 10.0 ** generator(None).uniform(-4, 4, np.size(leaf))
            for case, size in sizes.items():
                value = leaf * size.reshape(np.shape(leaf))
                yield name, case, partial(finite, scene.loss, scene.at({name: value}), strict=False)


def _constant_added(scene):
    for name, leaf in scene.leaves.items():
        unit = float(np.sqrt(np.mean(np.square(leaf)))) if np.size(leaf) > 1 else 0.0
        for share in SHIFTS if unit else ():
            if scene.legal(name, leaf + share * unit):
                yield name, f"plus {share:g} of itself", partial(_shifted, scene, {name: leaf + share * unit}, share)


def _shifted(scene, other, share):
    """Incompatible data of a singular system: projected or refused, never amplified."""
    if share == 1:
        return finite(scene.loss, scene.at(other), strict=False)
    out = run(scene.loss, scene.at(other))
    if out.error is not None:
        return (REFUSED if out.typed else DEGRADED), math.nan, out.words
    gap = apart(out, scene.base)
    word = FAILED if gap > max(1e6 * share, LOST) else DEGRADED if gap > max(1e4 * share, WEAK) else PASSED
    return word, gap, "" if word == PASSED else f"amplified by {gap / share:.0e}: is a null space left in?"


def _not_finite(scene):
    for name, leaf in scene.leaves.items():
        place = scene.sensitive(name)
        for bad in (math.nan, math.inf) if place is not None else ():
            if np.ndim(leaf):
                spoilt = np.array(leaf)
                spoilt[place] = bad
            worse = scene.at({name: spoilt if np.ndim(leaf) else bad})
            yield name, f"one {bad}", partial(must_refuse, scene.loss, worse, spoilt=name)


def _kinds_of_arrays(scene):
    for name, leaf in scene.leaves.items():
        if not isinstance(leaf, np.ndarray) or not leaf.ndim:
            continue
        for case, other in _copies(leaf):
            yield name, case, partial(same, scene.loss, scene.at({name: other}), scene.base)
        single = leaf.astype(np.float32)
        yield name, "float32", partial(same, scene.loss, scene.at({name: single}), scene.base, 1e-4)
        longer = np.resize(leaf, (leaf.shape[0] + 1, *leaf.shape[1:]))
        yield name, f"shape {longer.shape}", partial(must_refuse, scene.loss, scene.at({name: longer}))
        yield name, "complex", partial(must_refuse, scene.loss, scene.at({name: leaf + 1j * leaf}))
    whole = {name: np.asarray(leaf).astype(int) for name, leaf in scene.leaves.items() if is_variable(leaf)}
    yield "", "all integers", partial(must_refuse, scene.loss, scene.at(whole))


def _copies(leaf):
    frozen = leaf.copy()
    frozen.flags.writeable = False
    apart_ = np.full((*leaf.shape[:-1], 2 * leaf.shape[-1]), np.nan)
    apart_[..., ::2] = leaf
    yield "read-only", frozen
    yield "Fortran order", np.asfortranarray(leaf)
    yield "strided", apart_[..., ::2]
    yield "reversed", leaf[::-1].copy()[::-1]


def _time_step_and_viscosity(scene):
    for kind, name in scene.named.items():
        if name is None:
            continue
        leaf = scene.leaves[name]
        for factor in SWEEP:
            if scene.legal(name, leaf * factor):
                yield name, f"times {factor:g}", partial(_steady, scene, {name: leaf * factor}, name in scene.ranges)
        wrong = (0.0 * leaf, -leaf) if kind == "time step" else (-leaf,)
        for value in wrong:
            yield name, f"{np.min(value):g}", partial(must_refuse, scene.loss, scene.at({name: value}))
        if kind == "viscosity" and scene.legal(name, 0.0 * leaf):
            yield name, "0", partial(finite, scene.loss, scene.at({name: 0.0 * leaf}))


GROUPS = (
    _as_given, _scaling, _legal_range, _zeros_and_signs, _jumps, _constant_added, _not_finite, _kinds_of_arrays,
    _time_step_and_viscosity,
)  # fmt: skip
