"""What a sweep of differences proves about the derivative along one direction.

Everything is judged on the gap m(t) = (f(x + t d) - f(x - t d)) / 2t - g . d, with the displacement that
rounding left of t d. For a right gradient m(t) = c t^2 + noise / t; for a wrong one it has a plateau.

Estimates of the plateau: each m(t) and each Richardson extrapolation of two neighbours. The error bar of
an estimate is its largest distance from the two estimates beside it, plus the noise of the loss divided by
the step. The estimate with the smallest bar counts.

Source: the extrapolation is that of C. J. F. Ridders, Advances in Engineering Software 4, 1982.
"""

from typing import NamedTuple

import numpy as np

from sparsedp.check.remainders import taylor

__all__ = ["NOISY", "ROUNDING", "Gaps", "Judgement", "judge"]

RESOLVED = 1e-3  # an error bar above this share of the derivative proves nothing
AGREED = 1e-8  # a gap below this share is agreement, whatever the bar
NOISY = 1e-6  # the same behind a solve that the ledger shows, or in noise: what a solve leaves may be smooth
LEFT = 1e-9  # a gap below this share of the loss may be what a solve leaves: not wrong, but not right either
LOOSE = 10.0  # the same in units of the tolerance of the solves, where that is looser
PER_NOISE = 1e4  # between the two: this multiple of the measured noise of the loss
VANISHED = 1e-6  # a derivative and bar below this share of the curvature are 0
FAR, NEAR = 10.0, 3.0  # gap over bar: beyond FAR it is wrong, below NEAR it is right
FINEST = 5  # levels that tell the noise of the loss
TINY = np.finfo(float).tiny
ROUNDING = 1e3  # noise above this many roundings has another cause: a solver, chaos, a staircase


class Judgement(NamedTuple):
    """The verdict along one direction, in a word.

    agrees, disagrees; vanishes: both derivatives are 0 to rounding; kink: the one-sided derivatives differ;
    outside: they differ, and the gradient is beyond both;
    rough: a Taylor remainder has the wrong order; noise, few: nothing is proved, by noise or for want of usable steps;
    masked: gap and bar are small, but noise that is no rounding leaves too few digits;
    constant: the loss does not change, as the gradient says; ripple: coarse and fine steps see two derivatives.
    """

    direction: str
    word: str
    difference: float  # best estimate of the derivative, from differences
    slope: float  # g . d
    gap: float
    bar: float
    scale: float  # what gap and bar are compared with
    step: float  # where the plateau is
    rate1: float  # order of f(x + t d) - f, the one farthest from 1; NaN when there is none
    rate2: float  # lowest order of f(x + t d) - f - t g . d; infinite when it is noise on all levels
    digits: float
    jitter: float  # noise of the loss, in units of its rounding
    note: str
    bend: float = np.nan  # d . H d, where a Hessian product was looked at
    rate3: float = np.nan  # order of f(x + t d) - f - t g . d - t^2/2 d . H d; infinite when it is noise

    @property
    def resolution(self):
        """Error bar relative to the derivative."""
        return self.bar / self.scale if self.scale > 0 else np.inf


class Gaps:
    """The usable levels of a line as arrays, with their noise and their estimates."""

    def __init__(self, line, eps, spread):
        levels = line.usable
        self.t = np.array([level.step for level in levels])
        plus, minus, ahead, behind, self.m = np.array(
            [(le.plus, le.minus, le.ahead, le.behind, le.difference - le.slope) for le in levels]
        ).T
        ahead_of, behind_of = plus - line.base, minus - line.base
        self.first = np.hypot(ahead_of, behind_of) / np.sqrt(2)
        self.rests = ahead_of - ahead, behind_of - behind  # without the gradient, on both sides
        self.second = np.hypot(*self.rests) / np.sqrt(2)
        # The gap of the one-sided differences, with the part that comes from unequal displacements taken out.
        self.kinks = (plus + minus - 2 * line.base - (ahead + behind)) / self.t
        sizes = np.maximum(np.maximum(np.abs(plus), np.abs(minus)), abs(line.base))
        # What the finest levels vary by, as a share of the loss. Rounding does that, or a solver inside.
        fine = slice(-FINEST, None)
        share = np.abs(np.diff(self.m[fine])) * self.t[fine][1:] / np.maximum(sizes[fine][1:], TINY)
        self.jitter = max(float(np.max(share, initial=0.0)) / eps, 2 * line.noise)
        self.noise = max(2.0, self.jitter) * eps * sizes
        least = NOISY if line.solved else AGREED
        self.agreed = max(float(np.clip(PER_NOISE * eps * self.jitter, least, NOISY)), 300 * spread)
        self.curvature = float(np.median(np.abs(self.kinks / self.t)[:3]))
        self.floor = 8 * spread * self.curvature + 4 * spread * line.typical

    def estimates(self, values, power, noise):
        """Plateau estimates of values(t) = v0 + c t^power: (estimate, bar, index of its finest level)."""
        found = []
        ratio = (self.t[:-1] / self.t[1:]) ** power
        extrapolated = (ratio * values[1:] - values[:-1]) / (ratio - 1)
        for series, offset in ((values, 0), (extrapolated, 1)):
            for j in range(1, len(series) - 1):
                spread = max(abs(series[j] - series[j - 1]), abs(series[j] - series[j + 1]))
                found.append((series[j], spread + 2 * noise[j + offset] / self.t[j + offset], j + offset))
        return found

    def lasts(self, estimate, bar, index):
        """Whether all finer levels agree with an estimate: a derivative is a limit, not a passing plateau."""
        finer = slice(index + 1, None)
        return bool(np.all(np.abs(self.m[finer] - estimate) <= bar + 6 * self.noise[finer] / self.t[finer]))

    def kink(self, index, scale):
        """The jump of the one-sided derivatives seen around a level, and its bar; 0 if it goes to 0."""
        near = [e for e in self.estimates(self.kinks, 1, 2 * self.noise) if abs(e[2] - index) <= 1]
        jump, bar, _ = min(near, key=lambda e: e[1], default=(0.0, 0.0, 0))
        return (abs(jump), bar) if abs(jump) > FAR * bar and abs(jump) > self.agreed * scale else (0.0, bar)


@np.errstate(all="ignore")  # losses near the limits of the floating point numbers are judged like others
def judge(line, eps, spread):
    """Line -> Judgement.

    Parameters
    ----------
    line : Line
    eps : float
        Rounding of the loss.
    spread : float
        Rounding of x.
    """
    if line.silent:
        return _silent(line, eps)
    if len(line.usable) < 4:
        notes = {level.note for level in line.levels if level.note} or {"the sweep has too few steps"}
        return _unknown(
            line, "few", f"{len(line.usable)} usable steps, at least 4 are needed ({'; '.join(sorted(notes))})"
        )
    gaps = Gaps(line, eps, spread)
    gap, bar, index, jump = _plateau(gaps, line)
    bar += gaps.floor
    scale = max(abs(line.slope), abs(line.slope + gap), line.typical)
    word, note = _word(gaps, line, (gap, bar, scale), jump, eps)
    sharp = bar + abs(gap) <= VANISHED * scale
    orders = taylor(gaps, line.slope, gap if word in ("agrees", "masked", "vanishes") else 0.0, index, sharp)
    if word == "agrees" or (word == "vanishes" and orders.word == "rough"):
        word, note = orders.word or word, orders.note
    reference = gaps.curvature if word == "vanishes" else scale
    share = max(abs(gap), bar) / reference if reference > 0 else np.inf
    digits = float(np.clip(-np.log10(share), 0, 16)) if share > 0 else 16.0
    return Judgement(
        line.name, word, line.slope + gap, line.slope, gap, bar, scale, gaps.t[index],
        orders.rate1, orders.rate2, digits, gaps.jitter, note,
    )  # fmt: skip


def _plateau(gaps, line):
    """The estimate with the smallest bar that no finer level contradicts, away from kinks if there is such a place."""
    ranked = sorted(gaps.estimates(gaps.m, 2, gaps.noise), key=lambda e: e[1])
    lasting = [estimate for estimate in ranked if gaps.lasts(*estimate)] or ranked[-1:]
    best = None
    for gap, bar, index in lasting:
        scale = max(abs(line.slope), abs(line.slope + gap), line.typical)
        jump = gaps.kink(index, scale)
        best = best or (gap, bar, index, jump)
        if bar > RESOLVED * scale:
            break
        if not jump[0]:
            return gap, bar, index, jump
    return best


def _word(gaps, line, measured, jump, eps):
    """The verdict, before the Taylor rates have a say."""
    gap, bar, scale = measured
    size, (split, uncertain) = abs(gap), jump
    if split:
        # Between the two one-sided derivatives every value is a matter of convention.
        outside = size - split / 2
        if outside > FAR * (bar + uncertain) and outside > RESOLVED * scale:
            return "outside", f"outside the one-sided derivatives by {outside / scale:.1e}"
        return "kink", f"a kink: the one-sided derivatives differ by {split / max(scale, split):.1e}"
    far = FAR if gaps.jitter < ROUNDING else 3 * FAR
    if size > far * bar and size > gaps.agreed * max(scale, 1e-4 * gaps.curvature):
        if line.solved and size <= max(LEFT * abs(line.base), LOOSE * line.tolerance * max(abs(line.base), scale)):
            return "noise", f"off by {size / scale:.1e}: solves may leave this in such a loss, tighten their rtol"
        # Noise that swallows the whole difference may be a chaotic loss with a right gradient.
        if gaps.jitter < ROUNDING or abs(line.slope + gap) > FAR * bar:
            return "disagrees", f"off by {size / scale:.1e}, {size / bar:.1e} error bars"
        return "noise", "the loss is noisy or chaotic: differences see no derivative at all"
    if bar <= RESOLVED * scale:
        if size <= max(min(NEAR * bar, RESOLVED * scale - bar), gaps.agreed * scale):
            if gaps.jitter > ROUNDING and bar > NOISY * scale:
                noise = f"noise of {eps * gaps.jitter:.0e} of the loss"
                return "masked", f"{noise} leaves {max(-np.log10(bar / scale), 0):.0f} digits, 6 are needed"
            return "agrees", ""
        return "noise", f"off by {size / scale:.1e}, {size / bar:.1f} error bars: not enough to tell"
    if size <= NEAR * bar and scale + bar <= max(VANISHED, gaps.agreed) * gaps.curvature:
        return "vanishes", "the derivative is 0 to rounding, beside the curvature"
    return "noise", f"noise of {bar / scale if scale else np.inf:.1e} of the derivative hides it"


def _silent(line, eps):
    """The loss is the same number on all levels."""
    if line.slope == 0:
        return _unknown(line, "constant", "the loss does not change along this direction")
    visible = 2 * eps * abs(line.base) / max(level.step for level in line.levels if level.plus == line.base)
    if abs(line.slope) > FAR * visible:
        return _unknown(line, "disagrees", "the loss does not change along this direction, the gradient says it does")
    return _unknown(line, "noise", "the rounding of the loss hides the derivative")


def _unknown(line, word, note):
    scale = max(abs(line.slope), line.typical)
    return Judgement(
        line.name, word, np.nan, line.slope, np.nan, np.inf, scale, np.nan, np.nan, np.nan, 0.0, np.nan, note
    )
