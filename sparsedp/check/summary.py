"""What checks and instruments give: frozen values that print themselves, and their columns of text."""

import csv
import io
import math
import re
from typing import NamedTuple

import numpy as np

from sparsedp.recipe import Frozen

__all__ = ["Result", "Row", "Summary", "csv_text", "error_text", "table", "text_of"]


class Result(Frozen):
    """What an instrument gives: frozen, as plain data, as text; true unless it has a verdict other than "agrees".

    The attributes are the values it is made with; the docstring of each kind lists them, and nothing else does.
    """

    _columns: tuple = ()  # of its table as CSV; default: those of the first row
    _plain: tuple = ()  # names of the attributes that are plain data; default: all that were given

    def __getattr__(self, name):  # also tells type checkers that there are attributes which no class body names
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    def ok(self):
        """Whether the verdict is "agrees"."""
        return getattr(self, "verdict", "agrees") == "agrees"

    def __bool__(self):
        return self.ok

    def to_dict(self):
        """The result as plain numbers, strings, lists and dicts; None where an array holds NaN."""
        return {name: _plain(getattr(self, name)) for name in self._plain or vars(self)}

    def markdown(self):
        """The text in Markdown."""
        return f"```text\n{self}\n```\n"

    def csv(self):
        """The rows as CSV."""
        return csv_text(_plain(self.rows), self._columns)

    def __repr__(self):
        return str(self)


def _plain(value):
    if isinstance(value, Result):
        return value.to_dict()
    if isinstance(value, Row):
        return value._asdict()
    if isinstance(value, np.ndarray):
        return np.where(np.isnan(value), np.array(None), value).tolist()
    return [_plain(one) for one in value] if isinstance(value, (tuple, list)) else value


class Row(NamedTuple):
    """One property: its name, the measured figure, the largest one allowed, and whether it holds.

    The figure is infinite for NaN and errors. `ok` is None when the property does not apply; `note` says why, or what
    went wrong.
    """

    name: str
    figure: float | None = None
    limit: float | None = None
    ok: bool | None = None
    note: str = ""


class Summary(Result):
    """The rows of a check of an operator. Frozen; true when nothing failed and something was tested.

    Attributes
    ----------
    title : str
    rows : tuple of Row
    limit : float
        Largest figure allowed, in units of rounding.
    failed : tuple of str
        Names of the rows that failed.
    verdict : "agrees", "disagrees" or "inconclusive"
        Inconclusive where nothing could be tested.
    """

    _plain = ("title", "verdict", "limit", "worst", "rows")

    limit = 10.0

    def __init__(self, title, rows, **values):
        failed = tuple(row.name for row in rows if row.ok is False)
        verdict = "disagrees" if failed else "agrees" if any(row.ok for row in rows) else "inconclusive"
        super().__init__(title=title, rows=tuple(rows), failed=failed, verdict=verdict, **values)

    @property
    def worst(self):
        """Largest figure of the tested rows; 0 without any."""
        return max((row.figure for row in self.rows if row.figure is not None), default=0.0)

    def _head(self):
        """Lines above the rows."""
        return [f"{self.title}: {self.verdict}"]

    def __str__(self):
        words = {True: "ok", False: "FAILS", None: "-"}
        limits = ["" if row.limit is None else f"<= {row.limit:g}" for row in self.rows]
        cells = [(*row[:2], limit, words[row.ok], row.note) for row, limit in zip(self.rows, limits)]
        return "\n".join([*self._head(), table(cells)])


def error_text(error):
    """An error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def text_of(value):
    """A cell: two digits of a float, nothing for NaN and None."""
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.2g}"
    return "" if value is None else str(value)


def csv_text(rows, names=()):
    """Table -> CSV with a line of names; default: the keys of the first row."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, names or list(rows[0] if rows else ["nothing"]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def table(lines, head=None):
    """Rows of cells -> text in columns: words to the left, numbers to the right.

    Parameters
    ----------
    lines : sequence of equally long sequences
    head : sequence of str, optional

    Returns
    -------
    str
    """
    rows = [list(map(text_of, line)) for line in (*([head] if head else []), *lines)]
    if not rows:
        return "  nothing to show"
    columns = []
    for column in zip(*rows, strict=True):
        side, width = ">" if all(map(NUMBER, column[bool(head) :])) else "<", max(map(len, column))
        columns.append([f"{cell:{side}{width}}" for cell in column])
    return "\n".join(f"  {'  '.join(cells)}".rstrip() for cells in zip(*columns))


NUMBER = re.compile(r"[-+]?(\d[\d.]*(e[-+]\d+)?|nan|inf|exact)?").fullmatch  # what is set to the right of a column
