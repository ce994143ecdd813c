"""What all instruments give: a value that prints itself, and one table as three texts (columns, Markdown, CSV)."""

import csv
import io

from sparsedp.check.findings import table as text_table

__all__ = ["Result", "csv_text", "markdown_cell", "markdown_table", "text_table"]


class Result:
    """What an instrument gives: attributes that nobody sets, plain data, a text."""

    _plain: tuple = ()  # names of the attributes that are plain data

    def __init__(self, **values):
        self.__dict__.update(values)

    def __setattr__(self, name, value):
        raise AttributeError(f"a {type(self).__name__.lower()} is frozen; {name} cannot be set")

    def to_dict(self):
        """The result as plain numbers, strings, lists and dicts."""
        return {name: getattr(self, name) for name in self._plain}

    def __repr__(self):
        return str(self)


def csv_text(rows, columns=None):
    """Rows (dicts) -> CSV with a line of names; default: the keys of the first row."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns or list(rows[0] if rows else ["nothing"]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def markdown_table(head, lines):
    """Names of the columns, and rows of texts -> lines of Markdown."""
    rows = [f"| {' | '.join(map(markdown_cell, line))} |" for line in (head, *lines)]
    return [rows[0], f"|{'---|' * len(head)}", *rows[1:]]


def markdown_cell(text):
    """A text as it may stand in a table of Markdown."""
    return " ".join(text.split()).replace("|", "\\|")
