"""What checks and instruments give: frozen values that print themselves, and their columns of text."""

import math
import re
from typing import NamedTuple

__all__ = ["Result", "Row", "Summary", "table"]


class Result:
    """What an instrument gives: frozen, as plain data, as text; true unless it has a verdict other than "agrees".

    The attributes are the values it is made with; the docstring of each kind lists them, and nothing else does.
    """

    _word = ""  # what it is called; default: its class
    _plain: tuple = ()  # names of the attributes that are plain data; default: all that were given

    def __init__(self, **values):
        self.__dict__.update(values)

    def __getattr__(self, name):  # also tells type checkers that there are attributes which no class body names
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __setattr__(self, name, value):
        raise AttributeError(f"{self._word or f'a {type(self).__name__.lower()}'} is frozen; {name} cannot be set")

    @property
    def ok(self):
        """Whether the verdict is "agrees"."""
        return getattr(self, "verdict", "agrees") == "agrees"

    def __bool__(self):
        return self.ok

    def to_dict(self):
        """The result as plain numbers, strings, lists and dicts."""
        return {name: getattr(self, name) for name in self._plain or vars(self)}

    def __repr__(self):
        return str(self)


class Row(NamedTuple):
    """One property: its name, the measured figure, the largest figure allowed, and whether it holds.

    `ok` is None when the property does not apply; `note` says why, or what went wrong.
    """

    name: str
    figure: float | None
    limit: float | None
    ok: bool | None
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

    _word = "a finding"
    _plain = ("title", "verdict", "limit", "worst")

    def __init__(self, title, rows, limit=10.0, **values):
        failed = tuple(row.name for row in rows if row.ok is False)
        verdict = "disagrees" if failed else "agrees" if any(row.ok for row in rows) else "inconclusive"
        super().__init__(title=title, rows=tuple(rows), limit=limit, failed=failed, verdict=verdict, **values)

    @property
    def worst(self):
        """Largest figure of the tested rows (NaN counts as infinite); 0 without any."""
        figures = [row.figure for row in self.rows if row.figure is not None]
        return max((math.inf if math.isnan(figure) else figure for figure in figures), default=0.0)

    def to_dict(self):
        """The summary as plain numbers, strings and lists."""
        return super().to_dict() | {"rows": [row._asdict() for row in self.rows]}

    def _head(self):
        """Lines above the rows."""
        return [f"{self.title}: {self.verdict}"]

    def __str__(self):
        words = {True: "ok", False: "FAILS", None: "-"}
        rows = [(row.name, row.figure, row.limit, words[row.ok], row.note) for row in self.rows]
        cells = [["" if x is None else form.format(x) for form, x in zip(FORMS, row)] for row in rows]
        return "\n".join([*self._head(), table(cells)])


FORMS = "{}", "{:.3g}", "<= {:g}", "{}", "{}"  # of the cells of a row


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
    rows = [tuple(map(str, line)) for line in (*([head] if head else []), *lines)]
    if not rows:
        return "  nothing to show"
    columns = []
    for column in zip(*rows, strict=True):
        side, width = ">" if all(map(NUMBER, column[bool(head) :])) else "<", max(map(len, column))
        columns.append([f"{cell:{side}{width}}" for cell in column])
    return "\n".join(f"  {'  '.join(cells)}".rstrip() for cells in zip(*columns))


NUMBER = re.compile(r"[-+]?(\d[\d.]*(e[-+]\d+)?|nan|inf|exact)?").fullmatch  # what is set to the right of a column
