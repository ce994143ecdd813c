"""The one writer of tables: text, Markdown, CSV and files.

A table is a list of rows (dicts) and the names of the columns that are shown.
"""

import csv
import io
import math

from sparsedp.check.summary import Result, table
from sparsedp.files import write_file
from sparsedp.report import plots

__all__ = ["Result", "csv_text", "left_out", "markdown_table", "text_of", "text_table", "write_table"]


def text_of(value):
    """A cell: two digits of a float, nothing for NaN."""
    if not isinstance(value, float):
        return str(value)
    return "" if math.isnan(value) else f"{value:.2g}"


def text_table(rows, names):
    """Table -> text in columns."""
    return table(_cells(rows, names), names)


def markdown_table(rows, names):
    """Table -> lines of Markdown."""
    cells = [[" ".join(text.split()).replace("|", "\\|") for text in line] for line in (names, *_cells(rows, names))]
    head, *body = [f"| {' | '.join(line)} |" for line in cells]
    return [head, f"|{'---|' * len(names)}", *body]


def _cells(rows, names):
    return [[text_of(row.get(name, "")) for name in names] for row in rows]


def left_out(sentences, indent="- "):
    """What an instrument left out, and why -> lines."""
    return [f"{indent}left out: {sentence}" for sentence in sentences]


def csv_text(rows, names=None):
    """Table -> CSV with a line of names; default: the keys of the first row."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, names or list(rows[0] if rows else ["nothing"]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def write_table(folder, stem, markdown, csv, draw=None):
    """Texts of a table, and ``draw(axes) -> axes`` -> paths of stem.md, stem.csv and, with matplotlib, stem.png."""
    paths = [folder / f"{stem}.{kind}" for kind in ("md", "csv", "png")]
    write_file(paths[0], markdown)
    write_file(paths[1], csv)
    return [*paths[:2], *(plots.write_picture(paths[2], draw) if draw else ())]
