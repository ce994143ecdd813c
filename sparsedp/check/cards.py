"""The card of an operator: everything that can be checked without knowing what it is for."""

import numpy as np

from sparsedp.check.adjointness import transpose_rows
from sparsedp.check.arguments import argument_rows
from sparsedp.check.calculus import derivative_rows
from sparsedp.check.findings import Findings, Row
from sparsedp.check.probes import generator, listable, size_of
from sparsedp.check.twins import twin_rows
from sparsedp.operator import Operator
from sparsedp.structure.explicit import Matrix

__all__ = ["Card", "operator"]


def operator(op, seeds=3, rng=None):
    """Operator -> its card: spaces, form, entries, and one row for each property of a right operator.

    Parameters
    ----------
    op : Operator
        From the catalogue, or from outside: `from_matrix`, `from_functions`, `from_linear_operator`.
    seeds : int
        Random fields for each test and dtype.
    rng : None, int or numpy Generator
        Source of the fields; default a fixed seed of its own.

    Returns
    -------
    Card
        `.verdict` and `.ok`; `.rows` with name, figure, limit, ok, note; `.failed` names what failed;
        print(card) shows it all.

    Notes
    -----
    Rows: linearity, transpose (scaled dot test in four dtypes), twin (explicit against matrix-free,
    forward, transposed and entry by entry), JVP, VJP, second order, wrong shapes refused, dtypes, memory
    layouts, fresh results, same bits twice. Figures are in units of rounding; an inverse is judged by
    the tolerance of its solve, without its check of primal data.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import from_functions
    >>> blur = from_functions(lambda u: u + np.roll(u, 1), lambda g: g + np.roll(g, -1), 6, 6, name="blur")
    >>> operator(blur).verdict
    'agrees'
    >>> wrong = from_functions(lambda u: u + np.roll(u, 1), lambda g: g + np.roll(g, 1), 6, 6, name="wrong")
    >>> "transpose, float64" in operator(wrong).failed
    True
    """
    with np.errstate(all="ignore"):  # what overflows shows in the figures
        return _card(op, op.tangent, seeds, generator(rng))


def _card(op, acting, seeds, rng):
    try:
        size = size_of(acting, rng)
    except Exception as error:  # a foreign function may raise anything
        return Card(op, None, [Row("application", None, 10.0, False, f"{type(error).__name__}: {error}")])
    rows = derivative_rows(acting, size, rng)
    rows += transpose_rows(acting, size, seeds, rng)
    rows += [row._replace(name=f"twin, {row.name}") for row in twin_rows(acting, seeds, rng)]
    rows += argument_rows(acting, rng)
    return Card(op, size, rows)


class Card(Findings):
    """What was found out about one operator. Prints itself.

    Attributes
    ----------
    op : Operator
    size : float or None
        sqrt(|A|_1 |A|_inf), from below when the entries are not known.
    """

    op: Operator
    size: float | None
    nnz: int | None

    def __init__(self, op, size, rows):
        super().__init__(f"{op.name}: {op.domain} -> {op.codomain}", rows)
        self.__dict__.update(op=op, size=size, nnz=_count(op))

    @property
    def facts(self):
        """Dict of what the operator is: spaces, form, entries, size."""
        return {
            "domain": str(self.op.domain),
            "codomain": str(self.op.codomain),
            "form": self.op.form,
            "dtype": str(self.op.dtype),
            "nnz": self.nnz,
            "size": self.size,
        }

    def to_dict(self):
        """The card as plain numbers, strings and lists."""
        return {**super().to_dict(), **self.facts}

    def __str__(self):
        head, rows = super().__str__().split("\n", 1)
        entries = "entries not listed" if self.nnz is None else f"{self.nnz} entries"
        size = "" if self.size is None else f", sqrt(|A|_1 |A|_inf) = {self.size:.3g}"
        return f"{head}\n  {self.op.form}, {self.op.dtype}, {entries}{size}\n{rows}"

    __repr__ = __str__


def _count(op):
    """Number of stored entries, where listing them costs no application."""
    if isinstance(op.structure, Matrix):
        return int(op.structure.matrix.nnz)
    return int(op.explicit().matrix.nnz) if op.structure.has_entries and listable(op.structure) else None
