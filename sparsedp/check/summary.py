"""Results of checks and instruments: frozen values that print themselves, as text, in Markdown and as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.calls import deprecated_attribute
from sparsedp._utils.html import Markup, curves, folded, paragraphs
from sparsedp._utils.reconstruction import Frozen
from sparsedp._utils.validation import number_beside
from sparsedp.check.table import Table, table_of

__all__ = ["Result", "Row", "Summary", "error_text"]


class Result(Frozen):
    """The result of an instrument: frozen, as plain data, as text; true unless it has a verdict other than "agrees".

    The attributes are the values of the constructor; the docstring of each kind lists them, and nothing else does.
    ``parts()`` of each kind returns its text from top to bottom, a list of str and Table: lines, the first one a title,
    and tables.
    """

    _plain: tuple[str, ...] = ()  # names of the attributes that are plain data; default: all
    skipped: Sequence[str] = ()  # sentences
    left_out = deprecated_attribute("left_out", "skipped", "0.5")

    def __getattr__(
        self, name: str
    ) -> Any:  # also tells type checkers that there are attributes which no class body names
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    def ok(self) -> bool:
        """Whether the verdict is "agrees"."""
        return getattr(self, "verdict", "agrees") == "agrees"

    def __bool__(self) -> bool:
        return self.ok

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain numbers, strings, lists and dicts; None where an array holds NaN."""
        data = {name: _plain(getattr(self, name)) for name in self._plain or vars(self)}
        if "skipped" in data:
            data["left_out"] = data["skipped"]  # deprecated
        return data

    def omissions(self) -> list[str]:
        """Return what was skipped, with the reason: lines of its text."""
        return [f"  skipped: {sentence}" for sentence in self.skipped]

    def __str__(self) -> str:
        return "\n".join(map(str, self.parts()))

    def markdown(self) -> str:
        """Return the text in Markdown: a heading, tables, and the other lines as a list."""
        title, *parts = self.parts()
        blocks = [f"\n{part.markdown()}\n" if isinstance(part, Table) else f"- {part.strip()}" for part in parts]
        return "\n".join([f"### {title}", "", *blocks, ""])

    def html(self) -> Markup:
        """Return the text as HTML: a title, tables, the other lines; what was skipped is folded away.

        Returns
        -------
        Markup
            A str that notebooks show as HTML.
        """
        title, *parts = self.parts()
        blocks = [paragraphs([title], "h4")]
        omissions = self.omissions()
        for part in parts:
            if isinstance(part, Table):
                blocks.append(part.html())
            elif part not in omissions:
                blocks.append(paragraphs([part]))
        return Markup("\n".join([*blocks, folded("What was skipped", self.skipped)]))

    def curves(self) -> tuple[dict[str, Any], str, str]:
        """Return what is drawn on logarithmic axes; nothing unless a kind of result says so.

        Returns
        -------
        curves : dict
            Name: points (x, y) of each curve. Without curves there is no picture.
        xlabel, ylabel : str
        """
        return {}, "", ""

    def _repr_html_(self) -> Markup:
        """Return the result for a notebook: with its picture, if it has one."""
        return Markup(self.html() + curves(*self.curves(), log=(True, True)))

    def csv(self) -> str:
        """Return the rows as CSV."""
        return table_of(_plain(self.rows)).csv()

    def __repr__(self) -> str:
        return str(self)


def _plain(value: Any) -> Any:
    """Return a value as plain data."""
    if isinstance(value, Result):
        return value.to_dict()
    if isinstance(value, Row):
        return value._asdict()
    if isinstance(value, np.ndarray):
        return np.where(np.isnan(value), np.array(None), value).tolist()
    if isinstance(value, (tuple, list)):
        return [_plain(part) for part in value]
    return value


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

    def __init__(self, title: str, rows: Sequence[Row], **values: Any) -> None:
        failed = tuple(row.name for row in rows if row.ok is False)
        if failed:
            verdict = "disagrees"
        elif any(row.ok for row in rows):
            verdict = "agrees"
        else:
            verdict = "inconclusive"
        super().__init__(title=title, rows=tuple(rows), failed=failed, verdict=verdict, **values)

    @property
    def worst(self) -> float:
        """Largest figure of the tested rows; 0 without any."""
        return max((row.figure for row in self.rows if row.figure is not None), default=0.0)

    def parts(self) -> list[Any]:
        """Return the verdict, and the rows."""
        words = {True: "ok", False: "FAILS", None: "-"}
        cells = []
        for row in self.rows:
            if row.limit is None:
                limit = ""
            else:
                limit = f"<= {row.limit:g}"
            cells.append((row.name, _figure(row), limit, words[row.ok], row.note))
        return [f"{self.title}: {self.verdict}", Table(("property", "figure", "limit", "", ""), cells)]


def _figure(row: Row) -> Any:
    """Return the figure of a row; as text where it fails and its first digits are those of the limit."""
    if row.ok is False and row.limit is not None and f"{row.figure:.2g}" == f"{row.limit:.2g}":
        return number_beside(row.figure, row.limit, digits=2)
    return row.figure


def error_text(error: BaseException) -> str:
    """Return an error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
