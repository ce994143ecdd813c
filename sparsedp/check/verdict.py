"""The verdict of an audit over all directions, and the audit as a value that prints itself."""

import math

import numpy as np

from sparsedp.check.findings import table
from sparsedp.check.plateau import Judgement
from sparsedp.check.sweep import Line

__all__ = ["Audit", "decide"]

NEGLIGIBLE = 1e-6  # of the largest derivative: an open direction below it does not matter
SMALL = 1e-3  # the same for a direction that is resolved to a digit at least


def decide(judged, doubts):
    """Judgements of all directions and doubts -> (verdict, reason in words)."""
    firm = [doubt for doubt in doubts if doubt[0]]
    for word in ("inconclusive", "disagrees"):
        for verdict, reason in firm:
            if verdict == word:
                return verdict, reason
    rippled = next((one for one in judged if one.word == "ripple"), None)
    if rippled:
        return "inconclusive", f"along {rippled.direction}: {rippled.note}"
    wrong = [one for one in judged if one.word in ("disagrees", "outside")]
    if wrong:
        worst = max(wrong, key=lambda one: abs(one.gap) / one.scale if one.scale else math.inf)
        return "disagrees", f"along {worst.direction}: {worst.note}"
    for word, reason in doubts:
        if word == "open":
            return "inconclusive", reason
    largest = max((one.scale for one in judged), default=0.0)
    for one in judged:
        if one.word in ("kink", "rough"):
            return "inconclusive", f"along {one.direction}: {one.note}"
        if one.word in ("noise", "masked", "few") and not _negligible(one, largest):
            return "inconclusive", f"along {one.direction}: {one.note}"
    if not any(one.word in ("agrees", "vanishes") for one in judged):
        return "inconclusive", "the loss is constant to rounding"
    vanishing = all(one.word != "agrees" for one in judged)
    return "agrees", "the gradient is 0 to rounding, beside the curvature" if vanishing else ""


def _negligible(one, largest):
    """An open direction whose derivative, by gradient and by differences, is little beside the others."""
    if abs(one.gap) > 3 * one.bar:
        return False
    if one.scale + one.bar <= NEGLIGIBLE * largest:
        return True
    return one.word == "noise" and one.resolution <= 0.1 and one.bar <= SMALL * largest


class Audit:
    """The result of `check.gradient`. Frozen; true only when the gradient agrees.

    Attributes
    ----------
    verdict : "agrees", "disagrees" or "inconclusive"
    reason : str
        Why, when it does not simply agree.
    digits : int or None
        Digits that are proved, in the worst direction; None unless it agrees.
    culprit : str or None
        Name of the first operator, rule or function of autograd on the tape whose own VJP or JVP is at
        fault, when the verdict is "disagrees"; a note says what is wrong with it. None when each is right:
        then a value bypasses the tape, or the gradient was given.
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

    verdict: str
    reason: str
    digits: int | None
    culprit: str | None
    hessian: str | None
    lines: tuple[Judgement, ...]
    value: float
    evaluations: int
    size: int
    notes: tuple[str, ...]
    _sweeps: tuple[Line, ...]

    def __init__(self, verdict, reason, judged, lines, value, evaluations, size, notes=(), culprit=None, hessian=None):
        proved = [one.digits for one in judged if one.word in ("agrees", "vanishes")]
        digits = int(min(proved)) if verdict == "agrees" else None
        self.__dict__.update(verdict=verdict, reason=reason, digits=digits, culprit=culprit, hessian=hessian)
        self.__dict__.update(value=value, evaluations=evaluations, size=size)
        self.__dict__.update(lines=tuple(judged), notes=tuple(notes), _sweeps=tuple(lines))

    def __setattr__(self, name, value):
        raise AttributeError(f"an audit is frozen; {name} cannot be set")

    @property
    def ok(self):
        """Whether the verdict is "agrees"."""
        return self.verdict == "agrees"

    def __bool__(self):
        return self.ok

    @property
    def rows(self):
        """One dict for each direction and step: the numbers of the table and of the V-curve."""
        return tuple(
            {
                "direction": line.name,
                "step": level.step,
                "plus": level.plus,
                "minus": level.minus,
                "difference": level.difference,
                "slope": level.slope,
                "gap": _share(level.difference - level.slope, one.scale),
                "one_sided": _share((level.plus + level.minus - 2 * line.base) / level.step, one.scale),
                "note": level.note,
            }
            for line, one in zip(self._sweeps, self.lines, strict=True)
            for level in line.levels
        )

    def to_dict(self):
        """The audit as plain numbers, strings and lists."""
        names = ("verdict", "reason", "digits", "culprit", "hessian", "value", "evaluations", "size")
        return {
            **{name: getattr(self, name) for name in names},
            "notes": list(self.notes),
            "lines": [{key: _plain(entry) for key, entry in one._asdict().items()} for one in self.lines],
            "rows": [{key: _plain(entry) for key, entry in row.items()} for row in self.rows],
        }

    def __str__(self):
        parts = [f"gradient at {self.size} values, loss {self.value:.6g}, {self.evaluations} evaluations"]
        if self.lines:
            parts += [self._curves(), self._summary()]
        parts += [f"  {note}" for note in self.notes if note != self.reason]
        proved = f" to {self.digits} digits" if self.digits is not None else ""
        return "\n".join([*parts, f"verdict: {self.verdict}{proved}{': ' if self.reason else ''}{self.reason}"])

    def __repr__(self):
        """One line, which is what pytest shows of an assertion that fails."""
        words = [self.reason, *(note for note in self.notes if note.startswith("culprit"))]
        return f"<gradient {self.verdict}: {'; '.join(filter(None, words)) or f'{self.digits} digits'}>"

    def _curves(self):
        """|difference - g . d| relative to the derivative, over the steps (down) and directions (across)."""
        steps = sorted({level.step for line in self._sweeps for level in line.levels}, reverse=True)
        lines = []
        for step in steps:
            cells = [self._cell(line, one, step) for line, one in zip(self._sweeps, self.lines, strict=True)]
            lines.append((f"{step:.1e}", *cells))
        return table(lines, ("step", *(line.name for line in self._sweeps)))

    @staticmethod
    def _cell(line, one, step):
        level = next((level for level in line.levels if level.step == step), None)
        if level is None:
            return ""
        return "-" if level.note else f"{abs(_share(level.difference - level.slope, one.scale)):.0e}"

    def _summary(self):
        """One line for each direction."""
        lines = [
            (one.direction, f"{one.slope:.9g}", f"{one.difference:.9g}", f"{_share(abs(one.gap), one.scale):.0e}",
             f"{one.resolution:.0e}", _order(one.rate1), _order(one.rate2), _order(one.rate3), one.word, one.note)
            for one in self.lines
        ]  # fmt: skip
        head = ("direction", "g . d", "differences", "gap", "bar", "order 1", "order 2", "order 3", "", "")
        return table(lines, head)


def _order(rate):
    return "-" if math.isnan(rate) else "exact" if math.isinf(rate) else f"{rate:.2f}"


def _share(value, scale):
    return value / scale if scale > 0 else (0.0 if value == 0 else math.inf)


def _plain(entry):
    return float(entry) if isinstance(entry, (float, np.floating)) else entry
