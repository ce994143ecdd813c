"""Base classes of results: immutable objects with representations as text, Markdown, HTML, CSV and plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.calls import deprecated_attribute
from sparsedp._utils.html import Markup, curves, folded_list, paragraphs
from sparsedp._utils.validation import number_beside
from sparsedp.check.table import Table, table_of

__all__ = ["Result", "Row", "Summary", "error_text"]


class Result(Frozen):
    """Base class of immutable results. bool(result) is False if it has a verdict other than "agrees".

    The keyword arguments of the constructor become the attributes, which the docstring of each subclass lists. The
    method ``parts()`` of a subclass returns the content from top to bottom, as a list of str (lines, of which the first
    is the title) and Table.
    """

    _plain: tuple[str, ...] = ()  # names of the attributes in to_dict(); empty for all attributes
    skipped: Sequence[str] = ()  # sentences about what was skipped
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
        """Return the result as plain numbers, strings, lists and dicts. NaN in an array becomes None."""
        data = {name: _plain(getattr(self, name)) for name in self._plain or vars(self)}
        if "skipped" in data:
            data["left_out"] = data["skipped"]  # deprecated
        return data

    def omissions(self) -> list[str]:
        """Return lines of text about what was skipped, with the reasons."""
        return [f"  skipped: {sentence}" for sentence in self.skipped]

    def __str__(self) -> str:
        return "\n".join(map(str, self.parts()))

    def markdown(self) -> str:
        """Return the result in Markdown: the title as a heading, tables, and all other lines as a list."""
        title, *parts = self.parts()
        blocks = [f"\n{part.markdown()}\n" if isinstance(part, Table) else f"- {part.strip()}" for part in parts]
        return "\n".join([f"### {title}", "", *blocks, ""])

    def html(self) -> Markup:
        """Return the result as HTML: the title, tables and lines. What was skipped is in a collapsed section.

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
        return Markup("\n".join([*blocks, folded_list("What was skipped", self.skipped)]))

    def curves(self) -> tuple[dict[str, Any], str, str]:
        """Return curves to plot on logarithmic axes. The default is no curves; subclasses may override it.

        Returns
        -------
        curves : dict
            List of points (x, y) by name of the curve. If it is empty, there is no plot.
        xlabel, ylabel : str
        """
        return {}, "", ""

    def _repr_html_(self) -> Markup:
        """Return the result as HTML for a notebook, with a plot if there are curves."""
        return Markup(self.html() + curves(*self.curves(), log=(True, True)))

    def csv(self) -> str:
        """Return the rows as CSV."""
        return table_of(_plain(self.rows)).csv()

    def __repr__(self) -> str:
        return str(self)


def _plain(value: Any) -> Any:
    """Convert a value to plain numbers, strings, lists and dicts."""
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
    """One tested property: its name, the measured figure, the largest allowed figure, and whether it holds.

    The figure is infinite if the test gave NaN or raised an exception. `ok` is None if the property was not tested.
    `note` says why, or what went wrong.
    """

    name: str
    figure: float | None = None
    limit: float | None = None
    ok: bool | None = None
    note: str = ""


class Summary(Result):
    """The result of a check of an operator. bool(summary) is True if no row failed and at least one was tested.

    Attributes
    ----------
    title : str
    rows : tuple of Row
    limit : float
        Largest figure allowed, in units of rounding.
    failed : tuple of str
        Names of the rows that failed.
    verdict : "agrees", "disagrees" or "inconclusive"
        It is "inconclusive" if nothing could be tested.
    """

    _plain: tuple[str, ...] = ("title", "verdict", "limit", "worst", "rows")

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
        """Largest figure of all tested rows; 0 if there are none."""
        return max((row.figure for row in self.rows if row.figure is not None), default=0.0)

    def parts(self) -> list[Any]:
        """Return the title line with the verdict, and the table of rows."""
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
    """Return the figure of a row. If rounding would hide that it exceeds the limit, return text with more digits."""
    if row.ok is False and row.limit is not None and f"{row.figure:.2g}" == f"{row.limit:.2g}":
        return number_beside(row.figure, row.limit, digits=2)
    return row.figure


def error_text(error: BaseException) -> str:
    """Return type and message of an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
