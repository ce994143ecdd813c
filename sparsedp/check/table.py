"""Tables of results: as text, in Markdown, as HTML, as CSV."""

import csv
import io
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from sparsedp._utils import html as markup

__all__ = ["Table", "table_of"]

DIGITS = 2  # of a float in a cell
NUMBER = re.compile(r"[-+]?(\d[\d.]*(e[-+]\d+)?|nan|inf|exact)?").fullmatch  # what is set to the right of a column


class Table(NamedTuple):
    """Rows of cells, and the names of the columns. str() sets words to the left, numbers to the right."""

    names: Sequence
    rows: Sequence[Sequence[Any]]

    def texts(self):
        """The cells in words, below the names; without the columns that are empty, except the first one."""
        texts = ([markup.text_of(cell, DIGITS) for cell in row] for row in (self.names, *self.rows))
        columns = list(zip(*texts, strict=True))
        kept = [column for column in columns[1:] if any(column[1:]) or not self.rows]
        return list(zip(*columns[:1], *kept))

    def __str__(self):
        columns = []
        for column in zip(*self.texts(), strict=True):
            side, width = ">" if all(map(NUMBER, column[1:])) else "<", max(map(len, column))
            columns.append([f"{cell:{side}{width}}" for cell in column])
        return "\n".join(f"  {'  '.join(cells)}".rstrip() for cells in zip(*columns))

    def markdown(self):
        """The table in Markdown."""
        cells = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in self.texts()]
        head, *body = [f"| {' | '.join(row)} |" for row in cells]
        return "\n".join([head, f"|{'---|' * len(cells[0])}", *body])

    def html(self):
        """The table as HTML; nothing without a row."""
        names, *rows = self.texts()
        return markup.table(rows, names) if rows else markup.Markup("")

    def csv(self):
        """The table as CSV: every digit of a number, a line of names."""
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows([self.names, *self.rows])
        return stream.getvalue()


def table_of(rows, names=()):
    """Dicts -> Table of the entries of these names; default: all that they have, in the order of first use."""
    names = names or list(dict.fromkeys(name for row in rows for name in row)) or ["nothing"]
    return Table(names, [[row.get(name) for name in names] for row in rows])
