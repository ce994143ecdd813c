"""Tables of results, with representations as text, Markdown, HTML and CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from sparsedp._utils.html import Markup, table, text_of

__all__ = ["Table", "table_of"]

DIGITS = 2  # significant digits of a float in a cell
NUMBER = re.compile(r"[-+]?(\d[\d.]*(e[-+]\d+)?|nan|inf|exact)?")  # columns of such cells are right-aligned


class Table(NamedTuple):
    """Rows of cells, and the names of the columns. str() aligns numbers to the right and words to the left."""

    names: Sequence[Any]
    rows: Sequence[Sequence[Any]]

    def texts(self) -> list[tuple[str, ...]]:
        """Return the names and all cells as text. Empty columns are omitted, except the first one."""
        texts = ([text_of(cell, DIGITS) for cell in row] for row in (self.names, *self.rows))
        columns = list(zip(*texts, strict=True))
        nonempty = [column for column in columns[1:] if any(column[1:]) or not self.rows]
        return list(zip(*columns[:1], *nonempty))

    def __str__(self) -> str:
        columns = []
        for column in zip(*self.texts(), strict=True):
            if all(map(NUMBER.fullmatch, column[1:])):
                side = ">"
            else:
                side = "<"
            width = max(map(len, column))
            columns.append([f"{cell:{side}{width}}" for cell in column])
        return "\n".join(f"  {'  '.join(cells)}".rstrip() for cells in zip(*columns))

    def markdown(self) -> str:
        """Return the table in Markdown."""
        cells = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in self.texts()]
        head, *body = [f"| {' | '.join(row)} |" for row in cells]
        return "\n".join([head, f"|{'---|' * len(cells[0])}", *body])

    def html(self) -> Markup:
        """Return the table as HTML; an empty string if there are no rows."""
        names, *rows = self.texts()
        if rows:
            return table(rows, names)
        return Markup("")

    def csv(self) -> str:
        """Return the table as CSV with a header line. Numbers have all their digits."""
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows([self.names, *self.rows])
        return stream.getvalue()


def table_of(rows: Sequence[dict[str, Any]], names: Sequence[str] = ()) -> Table:
    """Return a table of dicts. `names` selects the columns; by default all keys, in the order of first use."""
    names = names or list(dict.fromkeys(name for row in rows for name in row)) or ["nothing"]
    return Table(names, [[row.get(name) for name in names] for row in rows])
