"""What the numbers of a sweep prove: one table from the evidence along a line to a word and its reason, one from the
words of all lines to the verdict.

Everything is judged on the gap m(t) = (f(x + t d) - f(x - t d)) / 2t - g . d, with the displacement that
rounding left of t d. For a right gradient m(t) = c t^2 + noise / t; for a wrong one it has a plateau.

Estimates of the plateau: each m(t) and each Richardson extrapolation of two neighbours. The error bar of
an estimate is its largest distance from the two estimates beside it, plus the noise of the loss divided by
the step. The estimate with the smallest bar counts.

Taylor: R1(t), the size of f(x +- t d) - f without the gradient, must fall like t; R2(t), that of
f(x +- t d) - f -+ t g . d, like t^2 or faster. Each is the root mean square over both signs, so that
the t^2 and t^3 parts of a smooth loss cannot cancel.

Source: the extrapolation is that of C. J. F. Ridders, Advances in Engineering Software 4, 1982.
"""

from contextlib import suppress
from math import inf, isfinite, nan

import numpy as np

from sparsedp._utils.validation import place
from sparsedp.autodiff.derivative import NO_JVP, pushforward
from sparsedp.check.summary import Result
from sparsedp.check.sweep import REFUSALS, Line, noise_of

__all__ = ["PROVED", "at_kinks", "curvature", "forward_mode", "judgement", "looked_at", "verdict"]

RESOLVED = 1e-3  # an error bar above this share of the derivative proves nothing
AGREED = 1e-8  # a gap below this share is agreement, whatever the bar
NOISY = 1e-6  # the same behind a solve that the ledger shows, or in noise: what a solve leaves may be smooth
LEFT = 1e-9  # a gap below this share of the loss may be what a solve leaves: not wrong, but not right either
LOOSE = 10.0  # the same in units of the tolerance of the solves, where that is looser
STEPS = 10.0  # a gap below this many tolerances of time steps is what their error control leaves
PER_NOISE = 1e4  # between the two: this multiple of the measured noise of the loss
UNDERFLOW = 1e-303  # differences of a loss that changes by less are not normal numbers
VANISHED = 1e-6  # a derivative and bar below this share of the curvature are 0
FAR, NEAR = 10.0, 3.0  # gap over bar: beyond FAR it is wrong, below NEAR it is right
FINEST = 5  # levels that tell the noise of the loss
LEVELS = 4  # usable steps without which nothing is judged
TINY = np.finfo(float).tiny
ROUNDING = 1e3  # noise above this many roundings has another cause: a solver, chaos, a staircase
NEGLIGIBLE = 1e-6  # of the largest derivative: an open direction below it does not matter
SMALL = 1e-3  # the same for a direction that is resolved to a digit at least

MODES = 1e-10  # forward and reverse mode differ by rounding
SOLVED = 1e-6  # by more, when there are solves inside: each mode ends at another residual

# Taylor orders.
FIRST = 0.05  # order 1 is 1 to within this
SECOND = 1.95  # the least order with the gradient
THIRD = 2.9  # the least order with gradient and Hessian
WRONG = 2.1  # up to here the third order is that of a wrong Hessian, above that of a loss without third derivatives
ODD = 0.1  # share of a remainder that changes its sign with the step: then the Hessian jumps at x
FEWEST = 3  # usable levels
CLEAR = 100.0  # a usable remainder stands this far above the noise: the noise then moves an order by 0.03 at most
LINEAR = 5.0  # a level serves for order 1 where t |g . d| is this often the even part: it moves it by 0.03 at most
NEARBY = 70.0  # levels up to this multiple of the step of the plateau: coarser ones are no limit t -> 0
APART = 4.0  # least ratio of the two steps of a pair
MOST = 5  # usable levels that are read, the finest ones

# Steps beyond those of the sweep, where it leaves the derivative open.
GOAL = 1e-5  # error bar, relative, above which a sweep is extended
COARSER = tuple(2.0**k for k in range(1, 38, 3))
BETWEEN = 2.0 ** np.arange(-9, 7)  # around the step of the plateau
FINER = tuple(2.0**-k for k in range(33, 46, 3))

# Ripples: a small part of the loss with a derivative that is not small.
RIPPLED = 2.0 ** -np.arange(27, 46)  # steps that may see one
SMOOTH = 30.0  # roundings that the loss of a smooth function varies by at most
RUN = 3  # neighbouring fine levels that agree with each other
SEES = 0.1  # to this share; and the rounding of the loss, as a share of the gap, up to which a level tells
WITHIN = (1.0, 20.0)  # multiples of the step over which a gap moves the loss by its noise
JUMP = 1e-4  # of such a step: within it a ripple is smooth
NEARER = 0.01  # steps of the plateau: within this a smooth gradient does not bend

PROVED = "agrees", "vanishes"


def words(e):
    """Evidence along a line -> rows of (word, whether it holds, reason): the first that holds decides.

    Where few levels are usable, that is one of the first four.
    """
    return (
        ("constant", e.silent and e.slope == 0, "the loss does not change along this direction"),
        ("disagrees", e.silent and abs(e.slope) * e.silent > 2 * FAR * e.smallest_change,
         "the loss does not change along this direction, the gradient says it does"),
        ("noise", e.silent, "the rounding of the loss hides the derivative"),
        ("few", e.used < LEVELS, "{e.used} usable steps, at least 4 are needed ({e.refusals})"),
        # Between two one-sided derivatives every value is a matter of convention.
        ("outside", e.beyond > FAR * (e.bar + e.uncertain) and e.beyond > RESOLVED * e.scale,
         "outside the one-sided derivatives, off by {e.share:.1e}"),
        ("kink", e.split, "a kink: the one-sided derivatives differ by {e.split:.1e}, of {e.scale:.1e}"),
        ("noise", e.wrong and e.size <= e.left,
         "off by {e.share:.1e}: solves may leave this in such a loss, tighten their rtol"),
        ("loose steps", e.wrong and e.size <= e.left_by_steps,
         "off by {e.share:.1e}: the steps' tolerance of {e.line.trials.step_tolerance:g} leaves this, tighten it"),
        # Noise that swallows the whole difference may be a chaotic loss with a right gradient.
        ("disagrees", e.wrong and (e.jitter < ROUNDING or abs(e.difference) > FAR * e.bar),
         "off by {e.share:.1e}, with error bars of {e.resolution:.1e}"),
        ("noise", e.wrong, "the loss is noisy or chaotic: differences see no derivative at all"),
        ("noise", e.resolved and not e.close,
         "off by {e.share:.1e}, with error bars of {e.resolution:.1e}: not enough to tell"),
        ("masked", e.close and e.jitter > ROUNDING and e.bar > NOISY * e.scale,
         "noise of {e.loudness:.0e} of the loss leaves {e.digits:.0f} digits, 6 are needed"),
        ("rough", (e.close or e.zero) and e.used2 >= FEWEST and not e.rate2 >= SECOND,
         "the second Taylor remainder is of order {e.rate2:.2f}: not twice differentiable here"),
        ("rough", (e.close or e.zero) and e.used1 >= FEWEST and not abs(e.rate1 - 1) <= FIRST,
         "the loss changes with order {e.rate1:.2f} in the step, not 1"),
        ("few", e.close and 0 < e.used2 < FEWEST,
         "the second Taylor remainder stands out of the noise on {e.used2} steps, 3 are needed"),
        ("few", e.close and e.used1 < FEWEST and not e.flat,
         "the change of the loss stands out of the noise on {e.used1} steps, 3 are needed"),
        ("agrees", e.close and e.used1 < FEWEST, "flat: there is no climb to judge order 1 by"),
        ("agrees", e.close, ""),
        ("vanishes", e.zero, "the derivative is 0 to rounding, beside the curvature"),
        ("noise", True, "noise of {e.resolution:.1e} of the derivative hides it"),
    )  # fmt: skip


# The evidence at the end -> verdict: the first group with a member decides, by the member that counts most.
VERDICTS = (
    (("unsound",), "inconclusive"),
    (("broken",), "disagrees"),
    (("ripple",), "inconclusive"),
    (("disagrees", "outside"), "disagrees"),
    (("open", "hidden modes", "kink", "rough", "noise", "masked", "few", "loose steps"), "inconclusive"),
)


def verdict(judged, doubts):
    """Judgements of all directions and doubts, pairs of word and reason -> (verdict, reason in words)."""
    largest = max((one.scale for one in judged), default=0.0)
    evidence = [(word, reason, inf) for word, reason in doubts]
    evidence += [
        (one.word, f"along {one.direction}: {one.note}", one.share if one.wrong else 0.0)
        for one in judged if not _negligible(one, largest)
    ]  # fmt: skip
    for words, outcome in VERDICTS:
        members = [pair for word, *pair in evidence if word in words]
        if members:
            return outcome, max(members, key=lambda pair: pair[1])[0]
    proved = {one.word for one in judged} & set(PROVED)
    if not proved:
        return "inconclusive", "the loss is constant to rounding"
    return "agrees", "" if "agrees" in proved else "the gradient is 0 to rounding, beside the curvature"


def _negligible(one, largest):
    """An open direction whose derivative, by gradient and by differences, is little beside the others."""
    if one.word not in ("noise", "masked", "few") or abs(one.gap) > NEAR * one.bar:
        return False
    small = one.word == "noise" and one.resolution <= 0.1 and one.bar <= SMALL * largest
    return small or one.scale + one.bar <= NEGLIGIBLE * largest


# ------------------------------------------------------------ evidence


class Judgement(Result):
    """What is proved along one direction, in a word, and the evidence for it.

    Attributes
    ----------
    direction : str
    word : str
        agrees, disagrees; vanishes: both derivatives are 0 to rounding; kink: the one-sided derivatives differ;
        outside: they differ, and the gradient is beyond both; rough: a Taylor remainder has the wrong order;
        noise, few: nothing is proved, by noise or for want of usable steps;
        loose steps: the gap is a few tolerances of time steps with error control;
        masked: gap and bar are small, but noise that is no rounding leaves too few digits;
        constant: the loss does not change, as the gradient says; ripple: coarse and fine steps see two derivatives.
    difference, slope : float
        Best estimate of the derivative, from differences; and g . d.
    gap, bar, scale : float
        Difference less slope, its error bar, and what both are compared with.
    step : float
        Where the plateau is.
    rate1, rate2, rate3 : float
        Orders of f(x + t d) - f, the one farthest from 1, NaN when there is none; the lowest with t g . d taken off,
        infinite when that is noise on all levels; and with t^2/2 d . H d too, where a Hessian product was looked at.
    bend : float
        d . H d.
    digits : float
    jitter : float
        Noise of the loss, in units of its rounding.
    note : str
    line : Line
    """

    _plain = (*"direction word difference slope gap bar scale step rate1 rate2 digits jitter note bend rate3".split(),)
    gap = size = share = jitter = step = rate1 = rate2 = bend = rate3 = nan
    bar, digits = inf, 0.0
    split = beyond = uncertain = used1 = used2 = off = jumps = nan
    close = wrong = zero = resolved = flat = False

    __str__ = __repr__ = object.__repr__

    def learn(self, **values):
        """Evidence that comes later, from more than the levels."""
        self.__dict__.update(values)


@np.errstate(all="ignore")  # losses near the limits of the floating point numbers are judged like others
def judgement(line):
    """Line -> what its levels prove."""
    notes = "; ".join(sorted({level.note for level in line.levels} - {""})) or "the sweep has too few steps"
    evidence = {"line": line, "direction": line.name, "slope": line.slope, "used": len(line.usable), "refusals": notes}
    evidence |= {"silent": max(line.silent, default=0.0), "scale": np.float64(max(abs(line.slope), line.typical))}
    evidence["smallest_change"] = line.trials.eps * abs(line.base)
    if abs(line.base) <= FAR * line.trials.deviation:
        # The loss is 0 to rounding: its noise along other directions, which grows with x, is the measure.
        evidence["smallest_change"] = line.trials.deviation * max(1.0, evidence["silent"])
    if len(line.usable) >= LEVELS:
        evidence |= _read(line)
        evidence |= _estimate(**evidence)
        evidence |= _compared(**evidence)
        evidence |= _taylor(**evidence)
    result = Judgement(**evidence)
    result.learn(difference=result.slope + result.gap, resolution=result.bar / result.scale)
    word, note = first(words, result)
    result.learn(word=word, note=note)
    return result


def _read(line):
    """Gaps, remainders and noise on all levels, from coarse to fine."""
    levels = np.array([level[:5] for level in line.usable]).T
    t, changes = levels[0], levels[1:3] - line.base
    rests = changes - levels[3:]  # without the gradient, on both sides
    m = (rests[0] - rests[1]) / (2 * t)
    # The gap of the one-sided differences, with the part that comes from unequal displacements taken out.
    kinks = (rests[0] + rests[1]) / t
    rounding = line.trials.eps * np.max(np.abs(levels[1:3]), axis=0, initial=max(abs(line.base), TINY))
    # What the finest levels vary by, in roundings of the loss. Rounding does that, or a solver inside.
    varied = np.abs(np.diff(m)) * t[1:] / rounding[1:]
    jitter = max(float(np.max(varied[1 - FINEST :])), 2 * line.trials.noise)
    return {
        "t": t, "changes": changes, "rests": rests, "m": m, "kinks": kinks, "rounding": rounding, "jitter": jitter,
        "noise": max(2.0, jitter) * rounding, "curvature": float(np.median(np.abs(kinks / t)[:3])),
    }  # fmt: skip


def _estimate(line, t, m, kinks, noise, jitter, scale, slope, curvature, **_):
    """The estimate with the smallest bar that no finer level contradicts, away from kinks if there is one."""
    spread, least = line.point.eps, NOISY if line.trials.solved else AGREED
    floor = 8 * spread * curvature + 4 * spread * line.typical
    agreed = max(float(np.clip(PER_NOISE * line.trials.eps * jitter, least, NOISY)), 300 * spread)
    bends, estimates = _estimates(t, kinks, 1, 2 * noise), []
    for gap, bar, index in _estimates(t, m, 2, noise):
        # The jump of the one-sided derivatives around the level, and its bar; 0 if it goes to 0.
        jump, error = next((pair[:2] for pair in bends if abs(pair[2] - index) <= 1), (0.0, 0.0))
        size = max(scale, abs(slope + gap))
        split = abs(jump) * (abs(jump) > max(FAR * error, agreed * size))
        estimates.append({
            "gap": gap, "bar": bar + floor, "step": float(t[index]), "scale": size, "split": split, "uncertain": error,
            "floor": floor, "agreed": agreed, "doubtful": bool(split) or bar > RESOLVED * size,
            # A derivative is a limit, not a passing plateau: all finer levels agree with it.
            "passing": np.any((np.abs(m - gap) > bar + 6 * noise / t)[index + 1 :]),
        })  # fmt: skip
    # Away from kinks the first, with the smallest bar; of passing ones the last.
    return min([one for one in estimates if not one["passing"]] or estimates[-1:], key=lambda one: one["doubtful"])


def _estimates(t, values, power, noise):
    """Estimates of v0 in values(t) = v0 + c t^power, best first: (estimate, bar, index of its finest level)."""
    ratio = (t[:-1] / t[1:]) ** power
    estimates: list = []
    for series in (values, (ratio * values[1:] - values[:-1]) / (ratio - 1)):
        jumps, start = np.abs(np.diff(series)), values.size - series.size + 1
        bars = np.maximum(jumps[:-1], jumps[1:]) + 2 * (noise / t)[start:-1]
        estimates += zip(series[1:-1], bars, range(start, values.size - 1))
    return sorted(estimates, key=lambda estimate: estimate[1])


def _compared(line, gap, bar, scale, split, jitter, agreed, curvature, **_):
    """How gap, bar, scale and noise compare."""
    size, base, trials = abs(gap), abs(line.base), line.trials
    far, resolved = bar * (FAR if jitter < ROUNDING else 3 * FAR), bar <= RESOLVED * scale
    zero = not resolved and size <= NEAR * bar and scale + bar <= max(VANISHED, agreed) * curvature
    return {
        "size": size, "share": size / scale, "beyond": (size - split / 2) * (split > 0), "resolved": resolved,
        "wrong": size > max(far, agreed * scale, agreed * 1e-4 * curvature),
        "left": max(LEFT * base, LOOSE * trials.tolerance * max(base, scale)) * trials.solved,
        "left_by_steps": STEPS * trials.step_tolerance * scale,
        "close": bool(resolved and size <= max(min(NEAR * bar, RESOLVED * scale - bar), agreed * scale)),
        "zero": zero, "loudness": jitter * trials.eps,
        "digits": float(np.clip(-np.log10(max(size, bar) / (curvature if zero else scale)), 0, 16)),
    }  # fmt: skip


def _taylor(t, changes, rests, kinks, noise, slope, size, bar, scale, step, close, zero, **_):
    """Orders of the Taylor remainders, on levels near the plateau.

    Usable for order 2: R2 >= CLEAR (noise + t |gap|). Where they are fewer than FEWEST, the even part of R2 is
    judged, which no gap can hide, then the same on all levels; with no usable level at all the loss is linear to
    its noise, and there is no order to judge. Usable for order 1: R1 >= CLEAR noise, and t |g . d| >= LINEAR
    times the even part (f(x + t d) + f(x - t d)) / 2 - f. Where the slope is so small that f bends before it
    climbs (near a minimum), order 1 cannot be 1: the direction is flat and order 1 is not judged. So it is where
    neither the loss nor t g . d ever leaves the noise (the kernel of a Laplacian), if gap and bar are far below
    the terms of g . d.
    """
    clear, near, even, climb = CLEAR * noise, t <= NEARBY * step, np.abs(kinks * t) / 2, abs(slope) * t
    change, rest = both(changes), both(rests)
    usable = (rest, rest >= clear + CLEAR * t * size * (close or zero)), (even, even >= clear)
    candidates = [orders(t, values, some & place) for place in (near, t > 0) for values, some in usable]
    used2, rates2 = max(candidates, key=lambda one: min(one[0], FEWEST))  # the first of those with enough
    seen, climbs = near & (change >= clear), climb >= LINEAR * even
    used1, rates1 = orders(t, change, seen & climbs)
    still = bar + size <= VANISHED * scale and not np.any(seen | (climb >= clear))
    return {
        "used1": used1, "rate1": max(rates1, key=lambda rate: abs(rate - 1), default=nan),
        "used2": used2, "rate2": min(rates2, default=nan) if used2 else inf,
        "flat": bool(still or np.any(seen & ~climbs)),
    }  # fmt: skip


def first(rows, evidence):
    """Word and reason of the first row of a table that holds."""
    return next((word, text.format(e=evidence)) for word, holds, text in rows(evidence) if holds)


def both(sides):
    """Root mean square over both signs of a step."""
    return np.hypot(*sides) / np.sqrt(2)


def orders(t, remainder, usable, most=MOST):
    """(number, orders) of the finest usable levels; the two levels of a pair are at least a factor APART."""
    levels, rates = np.flatnonzero(usable)[-most:], []
    for coarse in levels:
        for fine in levels[t[levels] * APART <= t[coarse]][:1]:
            rates.append(float(np.log(remainder[coarse] / remainder[fine]) / np.log(t[coarse] / t[fine])))
    return len(levels), rates


# ------------------------------------------------------------ all directions


def looked_at(trials, count, rng, wanted=None):
    """Judgements along all directions (none where loss or gradient is not finite), and the doubts before them.

    Parameters
    ----------
    trials : Trials
    count, rng, wanted
        As in `Point.directions`.

    Notes
    -----
    The noise belongs to the loss, not to a direction: the larger one along the first and the last counts for all.
    """
    point = trials.point
    trials.start()
    base = trials.base
    with np.errstate(all="ignore"):
        vector, again = (trials.gradient_at(point.fresh()) for _ in range(2))
    trials.gradient = vector
    finite, change = isfinite(base), np.max(np.abs(vector * point.units), initial=0.0)
    evidence = [
        ("unsound", not finite, f"the loss is {base} at x"),
        ("unsound", finite and trials.value(point.fresh()) != base,
         "two evaluations of the loss differ: it is not deterministic"),
        ("unsound", not np.array_equal(vector, again, equal_nan=True),
         "two evaluations of the gradient differ: it is not deterministic"),
        ("unsound", 0 < change < UNDERFLOW, f"the loss changes by less than {UNDERFLOW:g}: it underflows, scale it"),
        *(("broken", not np.all(np.isfinite(values)),
           f"the gradient of {name} holds NaN or infinity{_first_non_finite(values)}")
          for name, values in zip(point.names, point.arrays(vector))),
    ]  # fmt: skip
    doubts = [(word, reason) for word, holds, reason in evidence if holds]
    if not (finite and np.all(np.isfinite(vector))):
        return [], doubts
    directions = point.directions(vector, count, rng, wanted)
    lines = [Line(name, direction, trials) for name, direction in directions]
    for line in lines[:1] + lines[1:][-1:]:
        noise, deviation = noise_of(line)
        trials.noise = max(trials.noise, noise)
        trials.deviation = max(trials.deviation, deviation)
    judged = [measured(line, line is lines[0]) for line in lines]
    for one in judged if callable(trials.slope) else ():
        explained(one)
    return judged, doubts


def _first_non_finite(values):
    """Return in words where the first NaN or infinity of an array is; empty for a single number."""
    finite = np.isfinite(values)
    return f", the first at {place(int(np.argmin(finite)), finite.shape)}" if finite.ndim else ""


def at_kinks(judged):
    """Whether kinks may explain what speaks against a gradient; one that is far in one direction is seen in others."""
    words = {one.word for one in judged}
    return "outside" in words or {"disagrees", "kink"} <= words or any(map(_bent, judged))


def _bent(result):
    """Whether the differences along two parts of a direction do not add up to those along the whole.

    Then there is no derivative, though every line through x is straight: x^3 / (x^2 + y^2) at 0, or a limited slope
    where neighbours are equal.
    """
    line, part = result.line, result.line.direction.copy()
    entries = np.flatnonzero(part)
    if result.word != "disagrees" or entries.size < 2:
        return False
    part[entries[::2]] = 0.0
    parts = [measured(Line(line.name, d, line.trials), False) for d in (part, line.direction - part)]
    gap = result.difference - sum(one.difference for one in parts)
    return abs(gap) > max(SEES * result.size, FAR * (result.bar + sum(one.bar for one in parts)))


def forward_mode(loss, judged):
    """Compare forward mode with reverse mode along some directions; return None where a rule has no JVP.

    Returns
    -------
    gap : float
        Largest difference of the two, as a share of the derivative.
    allowed : float
        What rounding explains: MODES, or SOLVED where the ledger shows a solve or the loss is noisy.
    hidden : bool
        Whether all larger gaps lie along directions where differences prove nothing, and below their error bars: the
        derivative may be rounding itself, as that of a loss whose terms cancel.
    """
    largest_gap = 0.0
    allowed = MODES
    gaps_in_noise = []
    for one in judged:
        point = one.line.point
        try:
            with np.errstate(all="ignore"):
                slope = float(pushforward(loss, point.fresh(), point.unpack(one.line.direction))[1])
        except NO_JVP:
            return None
        noisy = one.jitter > ROUNDING or one.line.trials.solved
        allowed = max(allowed, 300 * point.eps, SOLVED * noisy)
        difference = abs(slope - one.slope)
        if difference == 0:
            continue
        gap = difference / one.scale if one.scale else inf
        largest_gap = float(np.maximum(largest_gap, gap))  # NaN stays NaN
        if not gap <= allowed:
            gaps_in_noise.append(one.word not in PROVED and difference <= FAR * one.bar)
    return largest_gap, allowed, all(gaps_in_noise)


# ------------------------------------------------------------ more steps where the first leave it open


def measured(line, close):
    """Sweep, judge, and where the derivative stays open go on: finer if there may be finer features.

    Noise at the level of rounding asks for coarser steps: x may be small beside the scale of the loss.

    Parameters
    ----------
    line : Line
    close : bool
        Whether steps far below the plateau are looked at, where there is noise, though all agrees.
    """
    extend = line.trials.extend
    line.sweep(line.trials.steps)
    result = judgement(line)
    if extend and result.word in ("few", "rough") and result.step > 0:  # more levels between those there are
        line.sweep(result.step * BETWEEN)
        result = judgement(line)
    if extend and result.word != "vanishes" and result.resolution > max(GOAL, 1e4 * line.point.eps):
        line.sweep(FINER * (not result.jitter <= ROUNDING) + COARSER * (not result.jitter > ROUNDING))
        result = min(judgement(line), result, key=lambda one: one.resolution)
    if extend and close and result.close and result.jitter > SMOOTH:
        line.sweep(RIPPLED)
        _see_ripple(result, judgement(line))
    return result


def _see_ripple(result, finer):
    """A plateau of coarse steps is no proof where fine ones, that rounding does not hide, agree on another derivative.

    Then the loss has a ripple: its derivative at x is one thing, the slope of the whole another.
    """
    for start in range(np.flatnonzero(finer.t < result.step)[0], finer.t.size - RUN + 1):
        run = slice(start, start + RUN)
        gap, rounding = float(np.median(finer.m[run])), np.max(4 * finer.rounding[run] / finer.t[run])
        visible = max(NOISY * result.scale, FAR * result.bar, rounding / SEES)
        if abs(gap) > visible and np.max(np.abs(finer.m[run] - gap)) <= SEES * abs(gap):
            note = f"a ripple: steps below {result.step:.0e} are off by {abs(gap) / result.scale:.1e}, others agree"
            result.learn(word="ripple", note=note)


@np.errstate(all="ignore")
def explained(result):
    """Whether a ripple below the noise of the loss, that the gradient shows, may explain a gap; then -> ripple.

    A gradient that bends by as much as the gap, within steps over which the gap does not move the loss beyond its
    noise, belongs to a loss whose ripple no difference can see.
    """
    line, point = result.line, result.line.point
    reach = max(2.0, result.jitter) * line.trials.eps * abs(line.base) / result.size

    def bend(step):
        ends = [point.unpack(point.vector + side * line.direction) for side in (step, -step)]
        return abs(sum(line.trials.gradient_at(end) @ line.direction for end in ends) - 2 * line.slope)

    for step in [times * reach for times in WITHIN] if result.word == "disagrees" else ():
        with suppress(*REFUSALS):
            size = bend(step) if step < NEARER * result.step else 0.0
            if size > SEES * result.size and size > 2 * bend(JUMP * step):  # at a kink it jumps, however near
                note = f"the gradient bends by {size / result.scale:.1e} of itself within a step of {step:.0e}: "
                result.learn(word="ripple", note=f"{note}a ripple below the noise of the loss may explain the gap")
                return


# ------------------------------------------------------------ Hessian products


def orders_of_hessians(e):
    """The same for a Hessian product."""
    return (
        ("disagrees", not isfinite(e.bend), "cannot be told: it is not finite"),
        ("agrees", not e.used3, "is noise"),
        ("inconclusive", e.used3 < FEWEST, "stands out of the noise on {e.used3} steps, 3 are needed"),
        ("agrees", e.rate3 >= THIRD, "of order {e.rate3:.2f}"),
        ("inconclusive", e.rate3 > WRONG or e.jumps, "of order {e.rate3:.2f}: not three times differentiable"),
        ("disagrees", True, "of order {e.rate3:.2f}: it is off by {e.off:.1e}"),
    )


@np.errstate(all="ignore")
def curvature(result, bend):
    """Judgement of a gradient and a Hessian product d . H d -> word and reason, by the third Taylor remainder.

    The order is read on the finest usable levels, those that stand out of noise, gap and the rounding of x.
    """
    e = judgement(result.line)
    rests = e.rests - e.t**2 / 2 * bend
    usable = both(rests) >= CLEAR * (e.noise + e.t * (result.size + e.floor))
    used, rates = orders(e.t, both(rests), usable, FEWEST)  # coarse ones are no limit t -> 0
    finest = np.max(np.flatnonzero(usable), initial=0)
    ahead, behind = rests[:, finest]
    result.learn(
        used3=used, bend=bend, rate3=min(rates, default=inf if not used else nan),
        off=abs(ahead + behind) / e.t[finest] ** 2 / abs(bend), jumps=abs(ahead - behind) > ODD * abs(ahead + behind),
    )  # fmt: skip
    word, text = first(orders_of_hessians, result)
    return word, f"d.Hd = {bend:.9g} along {result.direction}, third Taylor remainder {text}"
