"""The card of an operator: everything that can be checked without knowing what it is for."""

from functools import cached_property

import numpy as np

from sparsedp.check.adjointness import transpose_rows
from sparsedp.check.arguments import argument_rows, scaling_rows
from sparsedp.check.calculus import derivative_rows
from sparsedp.check.findings import Findings, Row
from sparsedp.check.locality import integration_by_parts, order_inside
from sparsedp.check.probes import generator, listable, size_of
from sparsedp.check.traits import bytes_of, costs, signs, spectrum_of
from sparsedp.check.twins import twin_rows
from sparsedp.operator import Operator
from sparsedp.operators.given import check_operator
from sparsedp.space import fits
from sparsedp.structure.explicit import Matrix

__all__ = ["Card", "operator"]

SHOWN = ("row sums", "symmetric", "definite", "M-matrix", "null space", "spectral radius", "stable step")
LINES = "integration by parts", "order", "acts as"


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
    layouts, fresh results, same bits twice, the same digits for a
    field times 2^+-900. Beside them stand facts without a verdict (`Card.facts`): cost and bytes, row sums, spectrum,
    the largest stable step, what the operator is adjoint to, the derivative that it stands for and its order.
    Figures are in units of rounding; an inverse is judged by
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
    check_operator("check.operator", op)
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
    rows += argument_rows(acting, rng) + scaling_rows(acting, size, rng)
    return Card(op, size, rows)


class Card(Findings):
    """What was found out about one operator. Prints itself.

    Attributes
    ----------
    op : Operator
    size : float or None
        sqrt(|A|_1 |A|_inf), from below when the entries are not known.
    facts : dict
        What the operator is: domain, codomain, form, dtype, nnz, bytes, size; seconds of one application
        in each form; row sums, symmetry, M-matrix; integration by parts in the volumes of its grid, the derivative
        that a row inside stands for and its order, or why they are not known; of a square one
        spectral radius, definiteness, null space
        and the largest stable step of u' = A u by explicit Euler. Found when they are asked for; what cannot
        be found at a fair price is left out.
    """

    op: Operator
    size: float | None
    nnz: int | None

    def __init__(self, op, size, rows):
        super().__init__(f"{op.name}: {op.domain} -> {op.codomain}", rows)
        self.__dict__.update(op=op, size=size, nnz=_count(op))

    @cached_property
    def facts(self):
        """Dict of what the operator is."""
        op = self.op
        found = {
            "domain": str(op.domain),
            "codomain": str(op.codomain),
            "form": op.form,
            "dtype": str(op.dtype),
            "nnz": self.nnz,
            "size": self.size,
        }
        if self.size is None:  # it cannot even be applied
            return found
        with np.errstate(all="ignore"):
            found |= {} if hasattr(op, "solver") else {"bytes": bytes_of(op)}  # factors and hierarchies are not ours
            found |= {"seconds": costs(op.tangent, generator(None)), **signs(op)}
            found |= {"integration by parts": integration_by_parts(op.tangent, generator(None))}
            found |= order_inside(op.tangent)
            square = fits(op.domain, op.codomain) and op.dtype.kind != "c"
            return found | (spectrum_of(op, found.get("symmetric", False)) if square and not self.failed else {})

    def to_dict(self):
        """The card as plain numbers, strings and lists."""
        return {**super().to_dict(), **self.facts}

    def __str__(self):
        head, rows = super().__str__().split("\n", 1)
        op, facts = self.op, self.facts
        entries = "entries not listed" if self.nnz is None else f"{self.nnz} entries"
        size = "" if self.size is None else f", sqrt(|A|_1 |A|_inf) = {self.size:.3g}"
        stored = f", {facts['bytes']} bytes" if "bytes" in facts else ""
        lines = [head, f"  {op.form}, {op.dtype}, {entries}{stored}{size}"]
        if "seconds" in facts:
            times = ", ".join(f"{1e6 * t:.3g} us {form}" for form, t in facts["seconds"].items())
            lines.append(f"  one application: {times}")
        known = [f"{name} {_word(facts[name])}" for name in SHOWN if name in facts]
        lines += [f"  {', '.join(known)}"] if known else []
        lines += [f"  {name}: {facts[name]}" for name in LINES if name in facts]
        return "\n".join([*lines, rows])

    __repr__ = __str__


def _word(value):
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else f"{value:.4g}"


def _count(op):
    """Number of stored entries, where listing them costs no application."""
    if isinstance(op.structure, Matrix):
        return int(op.structure.matrix.nnz)
    return int(op.explicit().matrix.nnz) if op.structure.has_entries and listable(op.structure) else None
