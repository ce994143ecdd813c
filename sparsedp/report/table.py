"""The one writer of tables: text, Markdown, CSV and files.

A table is a list of rows (dicts) and the names of the columns that are shown.
"""

import contextlib
from typing import Any

from sparsedp.check.summary import Result, csv_text, table, text_of
from sparsedp.files import write_file
from sparsedp.report import plots

__all__ = ["Result", "Table", "csv_text", "markdown_table", "text_table", "write_table"]


class Table(Result):
    """A result that is a table: as text, Markdown and CSV.

    Attributes
    ----------
    rows : list of dict
    left_out : list of str
        What was left out, with the reason.
    """

    left_out: tuple | list = ()

    _parts: Any  # () -> (lines above the table, the first a title; its rows, the names of its columns; lines below it)

    def __str__(self):
        above, rows, names, below = self._parts()
        skipped = (f"  left out: {sentence}" for sentence in self.left_out)
        return "\n".join([*above, text_table(rows, names), *skipped, *below])

    def markdown(self):
        """The table in Markdown, with what stands above and below it and what was left out."""
        (title, *above), rows, names, below = self._parts()
        skipped = (f"- left out: {sentence}" for sentence in self.left_out)
        lines = [f"### {title}", "", *above, "", *markdown_table(rows, names), "", "```text", *below, "```", ""]
        return "\n".join([*lines, *skipped, ""])


def text_table(rows, names):
    """Table -> text in columns."""
    return table([map(row.get, names) for row in rows], names)


def markdown_table(rows, names):
    """Table -> lines of Markdown."""
    lines = [names, *([text_of(row.get(name)) for name in names] for row in rows)]
    cells = [[" ".join(text.split()).replace("|", "\\|") for text in line] for line in lines]
    head, *body = [f"| {' | '.join(line)} |" for line in cells]
    return [head, f"|{'---|' * len(names)}", *body]


def write_table(folder, stem, markdown, csv, draw=None):
    """Texts of a table, and ``draw(axes) -> axes`` -> paths of stem.md, stem.csv and, with matplotlib, stem.png."""
    page, numbers, picture = [folder / f"{stem}.{kind}" for kind in ("md", "csv", "png")]
    write_file(page, markdown)
    write_file(numbers, csv)
    if draw is not None:
        with contextlib.suppress(ImportError):
            plots.write_picture(picture, draw)
            return [page, numbers, picture]
    return [page, numbers]
