"""What checks and instruments give: frozen values that print themselves, as text, in Markdown and as HTML."""

from typing import NamedTuple

import numpy as np

from sparsedp._utils.calls import deprecated_attribute
from sparsedp._utils.html import Markup, curves, folded, paragraphs
from sparsedp._utils.reconstruction import Frozen
from sparsedp._utils.validation import number_beside
from sparsedp.check.table import Table, table_of

__all__ = ["Result", "Row", "Summary", "error_text"]


class Result(Frozen):
    """What an instrument gives: frozen, as plain data, as text; true unless it has a verdict other than "agrees".

    The attributes are the values it is made with; the docstring of each kind lists them, and nothing else does.
    ``parts()`` of each kind returns its text from top to bottom, a list of str and Table: lines, the first one a title,
    and tables.
    """

    _plain: tuple = ()  # names of the attributes that are plain data; default: all that were given
    skipped: tuple | list = ()  # sentences
    left_out = deprecated_attribute("left_out", "skipped", "0.5")

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
        data = {name: _plain(getattr(self, name)) for name in self._plain or vars(self)}
        if "skipped" in data:
            data["left_out"] = data["skipped"]  # deprecated
        return data

    def omissions(self):
        """What was left out, with the reason: lines of its text."""
        return [f"  left out: {sentence}" for sentence in self.skipped]

    def __str__(self):
        return "\n".join(map(str, self.parts()))

    def markdown(self):
        """The text in Markdown: a heading, tables, and the other lines as a list."""
        title, *parts = self.parts()
        blocks = (f"\n{part.markdown()}\n" if isinstance(part, Table) else f"- {part.strip()}" for part in parts)
        return "\n".join([f"### {title}", "", *blocks, ""])

    def html(self):
        """The text as HTML: a title, tables, the other lines; what was left out is folded away.

        Returns
        -------
        Markup
            A str that notebooks show as HTML.
        """
        title, *parts = self.parts()
        skipped = self.omissions()
        blocks = (
            part.html() if isinstance(part, Table) else paragraphs([part]) for part in parts if part not in skipped
        )
        return Markup("\n".join([paragraphs([title], "h4"), *blocks, folded("What was left out", self.skipped)]))

    def curves(self):
        """What is drawn on logarithmic axes; nothing unless a kind of result says so.

        Returns
        -------
        (dict, str, str)
            Name -> points (x, y) of each curve, and what is across and up. Without curves there is no picture.
        """
        return {}, "", ""

    def _repr_html_(self):
        """For a notebook: with its picture, if it has one."""
        return Markup(self.html() + curves(*self.curves(), log=(True, True)))

    def csv(self):
        """The rows as CSV."""
        return table_of(_plain(self.rows)).csv()

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

    def parts(self):
        """The verdict, and the rows."""
        words = {True: "ok", False: "FAILS", None: "-"}
        cells = [
            (row.name, _figure(row), "" if row.limit is None else f"<= {row.limit:g}", words[row.ok], row.note)
            for row in self.rows
        ]
        return [f"{self.title}: {self.verdict}", Table(("property", "figure", "limit", "", ""), cells)]


def _figure(row):
    """The figure of a row; as text where it fails and its first digits are those of the limit."""
    if row.ok is False and row.limit is not None and f"{row.figure:.2g}" == f"{row.limit:.2g}":
        return number_beside(row.figure, row.limit, digits=2)
    return row.figure


def error_text(error):
    """An error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
