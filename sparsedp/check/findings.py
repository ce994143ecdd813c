"""Findings: what a check of an operator found, one row for each property, as a value that prints itself."""

import math
from typing import Any, NamedTuple

__all__ = ["Findings", "Row", "attempted", "judged", "skipped", "table"]


class Row(NamedTuple):
    """One property: its name, the measured figure, the largest figure allowed, and whether it holds.

    `ok` is None when the property does not apply; `note` says why, or what went wrong.
    """

    name: str
    figure: float | None
    limit: float | None
    ok: bool | None
    note: str = ""


def judged(name, figure, limit, note=""):
    """Row of a measured figure. NaN fails."""
    figure = float(figure)
    return Row(name, figure, float(limit), bool(figure <= limit), note)


def attempted(name, limit, measure, optional=False):
    """Row of what ``measure()`` returns. An error fails, or skips a row that is optional.

    Operators from outside may raise anything; the card goes on and shows it in its row.
    """
    try:
        return judged(name, measure(), limit)
    except Exception as error:
        note = f"{type(error).__name__}: {error}"
        return skipped(name, f"refused, {note}") if optional else Row(name, None, float(limit), False, note)


def skipped(name, note):
    """Row of a property that does not apply."""
    return Row(name, None, None, None, note)


class Findings:
    """The rows of a check and its verdict. Frozen; true when nothing failed and something was tested.

    Attributes
    ----------
    title : str
    rows : tuple of Row
    limit : float
        Largest figure allowed, in units of rounding.
    """

    title: str
    rows: tuple[Row, ...]
    limit: float

    def __init__(self, title, rows, limit=10.0):
        self.__dict__.update(title=title, rows=tuple(rows), limit=limit)

    def __setattr__(self, name, value):
        raise AttributeError(f"a finding is frozen; {name} cannot be set")

    @property
    def ok(self):
        """Whether no row failed and at least one was tested."""
        return not self.failed and any(row.ok for row in self.rows)

    @property
    def verdict(self):
        """agrees, disagrees or inconclusive (nothing could be tested)."""
        return "agrees" if self.ok else "disagrees" if self.failed else "inconclusive"

    @property
    def failed(self):
        """Names of the rows that failed."""
        return tuple(row.name for row in self.rows if row.ok is False)

    @property
    def worst(self):
        """Largest figure of the tested rows (NaN counts as infinite); 0 without any."""
        figures = [row.figure for row in self.rows if row.ok is not None and row.figure is not None]
        return max((math.inf if math.isnan(figure) else figure for figure in figures), default=0.0)

    def __bool__(self):
        return self.ok

    def to_dict(self):
        """The findings as plain numbers, strings and lists."""
        rows = [row._asdict() for row in self.rows]
        return {"title": self.title, "verdict": self.verdict, "limit": self.limit, "worst": self.worst, "rows": rows}

    def __str__(self):
        return f"{self.title}: {self.verdict}\n" + table([_cells(row) for row in self.rows])

    __repr__ = __str__


def _cells(row):
    word = {True: "ok", False: "FAILS", None: "-"}[row.ok]
    figure = "" if row.figure is None else f"{row.figure:.3g}"
    limit = "" if row.limit is None else f"<= {row.limit:g}"
    return row.name, figure, limit, word, row.note


def table(lines: Any, head=None, indent="  "):
    """Rows of strings -> text in columns: the first column to the left, numbers to the right.

    Parameters
    ----------
    lines : sequence of equally long tuples of str
    head : tuple of str, optional
    indent : str

    Returns
    -------
    str
    """
    lines = [tuple(map(str, line)) for line in ([head] if head else []) + list(lines)]
    if not lines:
        return indent + "nothing to show"
    wide = [max(len(line[c]) for line in lines) for c in range(len(lines[0]))]
    numeric = [all(_number(line[c]) for line in lines[bool(head) :]) for c in range(len(lines[0]))]
    texts = []
    for line in lines:
        cells = [cell.rjust(w) if right else cell.ljust(w) for cell, w, right in zip(line, wide, numeric, strict=True)]
        texts.append((indent + "  ".join(cells)).rstrip())
    return "\n".join(texts)


def _number(text):
    try:
        float(text or "0")
    except ValueError:
        return text in ("-", "exact")
    return True
