"""Checks of operators: is the transpose the transpose, are two forms one operator, are its derivatives right?

Figures are in units of rounding times the size of the operator; each check is a function of random fields, and a row.
"""

import warnings
from functools import cached_property
from math import inf, isnan, log10, prod, sqrt
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import norm
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.derivative import hvp, pullback, pushforward, unwarned
from sparsedp.check.point import audit_generator
from sparsedp.check.properties import facts_of
from sparsedp.check.summary import Row, Summary, error_text
from sparsedp.errors import DerivativeError
from sparsedp.operators.given import check_operator
from sparsedp.operators.structure.base import Matrix

__all__ = ["OperatorSummary", "fault_of", "field", "layouts", "operator", "transpose", "twin"]

LIMIT = Summary.limit
DTYPES = ("float64", "complex128", "float32", "complex64")
LARGEST = 2**21  # unknowns above which no matrix is built for a check
MOST_COLUMNS = 512  # columns that are computed one application at a time
ROUGHLY = 1e-6  # share of the result up to which A (i u) is i A u
POWERS = 8  # products of a power iteration
DECADES = {"float32": 25, "float64": 290}  # sizes 10^+-d of operators fit into a dtype, with room for the fields


def field(rng, shape, dtype):
    """Random normal field of a dtype."""
    values = rng.standard_normal(shape)
    if np.dtype(dtype).kind == "c":
        values = values + 1j * rng.standard_normal(shape)
    return np.asarray(values, dtype)


class Probe:
    """An operator under test: random fields for it, and what its rounding errors are measured against.

    Parameters
    ----------
    op : Operator
        Its tangent is tested: an inverse without its check of primal data.
    seeds : int
        Random fields of each test and dtype.
    rng : None, int or numpy Generator

    Attributes
    ----------
    real_linear : "", "domain" or "codomain"
        Of an operator on complex numbers that is linear over the real numbers only: which of its fields are real. A
        real FFT has a real domain, its inverse a real codomain.
    listed : bool
        Whether the entries can be listed at a fair price.
    forms : tuple of Operator
        Explicit and matrix-free, where they can.
    matrix : sparse matrix
        The entries, where they can.
    bounds : tuple of functions
        |u| -> what rounding in A u and in A^T u is relative to, entry by entry: |A| |u|. Empty without entries.
    size : float
        sqrt(|A|_1 |A|_inf), or a lower bound of the 2-norm from products. A bound from below makes the tests
        stricter, never laxer.
    """

    def __init__(self, op, seeds=1, rng=None):
        self.op, self.rng, self.seeds = op.tangent, audit_generator(rng), max(seeds, 1)
        self.real = op.dtype.kind != "c"
        structure, self.tolerance = self.op.structure, tolerance_of(self.op.structure)
        self.real_linear = "" if self.real or structure.has_entries else self._real_side()
        limit = LARGEST if structure.has_entries else MOST_COLUMNS
        self.listed = max(op.shape) <= limit and not self.real_linear  # a matrix is linear over complex numbers
        entries = self.listed and structure.has_entries
        self.bounds: tuple = (structure.magnitude(), structure.transpose().magnitude()) if entries else ()
        self.size = self._size() if entries else self._norm()
        self.forms: tuple = (self.op.explicit(), self.op.matrix_free()) if self.listed else ()
        self.matrix: Any = next((form.matrix for form in self.forms), None)

    @cached_property
    def turned(self):
        """The forms of the transpose, and the entries that it assembles by itself."""
        return [self.op.structure.transpose().explicit(), *(form.T for form in self.forms)]

    def domain(self, dtype=float):
        """Random field of the domain."""
        return field(self.rng, self.op.domain.shape, dtype)

    def codomain(self, dtype=float):
        """Random field of the codomain, complex where the operator is."""
        return field(self.rng, self.op.codomain.shape, dtype if self.real else np.result_type(dtype, np.complex64))

    def rows(self, name, dtypes=()):
        """A row for each dtype (default: those of KINDS): how far the sides of an identity are apart, at worst."""
        rows: list[Row] = []
        dtypes = [np.dtype(dtype) for dtype in dtypes or KINDS.get(name, DTYPES[: 1 if self.real else 2])]
        for dtype in dtypes:
            if self.real_linear == "domain" and dtype.kind == "c":
                continue
            # A clean refusal of complex fields is fine where real fields work.
            optional = dtype.kind == "c" and self.real and rows[0].ok is True
            rows.append(self._row(name, dtype, optional))
        return rows

    def _row(self, name, dtype, optional):
        """Row of an identity in one dtype; where it is not optional, an error fails: functions may raise anything."""
        label = f"{name}, {dtype}"
        if self.size and abs(log10(self.size)) >= DECADES[np.finfo(dtype).dtype.name] / EXPONENTS.get(name, 1):
            return Row(label, note=f"entries of size {self.size:.1e} leave the range of {dtype}")
        try:
            gap = float(self.gap(name, dtype))
        except Exception as error:
            note = error_text(error)
            return Row(label, note=f"refused, {note}") if optional else Row(label, inf, LIMIT, False, note)
        return Row(label, inf if isnan(gap) else gap, LIMIT, gap <= LIMIT)

    def gap(self, name, dtype):
        """Distance of the two sides of an identity in units of rounding, at worst over entries and seeds."""
        worst, rounding = 0.0, max(0.0 if name in EXACT else self.tolerance, float(np.finfo(dtype).eps))
        for _ in range(self.seeds):
            left, right, bound = IDENTITIES[name](self, self.domain(dtype), self.domain(dtype), self.codomain(dtype))
            gaps = np.abs(left - right).reshape(-1, max(np.size(bound), 1))
            with np.errstate(all="ignore"):
                shares = np.where(gaps == 0, 0.0, gaps / (bound * rounding))
            worst = np.maximum(worst, np.max(shares, initial=0.0))  # NaN stays NaN
        return worst

    def bound(self, u, transposed=False):
        """What rounding is relative to in A u: |A| |u|, entry by entry.

        Functions round relative to the whole result (transforms, solves): |A| |u| in norms.
        """
        if self.bounds:
            return self.bounds[transposed](np.abs(u).ravel().astype(float))
        return self.size * norm(u)

    def product(self, a, b):
        """Sum of a b; its real part where only that is the same for an operator and its transpose."""
        return np.real(_dot(a, b)) if self.real_linear else _dot(a, b)

    def transposed(self, g, real):
        """A^T g by the transposed matrix, or by `.T` when no matrix can be listed; its real part, of real fields."""
        back = (self.matrix.T @ g.ravel()).reshape(self.op.domain.shape) if self.listed else self.op.T.apply(g)
        return back.real if real else back

    def _real_side(self):
        """Which fields of an operator are real, if it is not linear over the complex numbers."""
        u = self.domain()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy may say that it discards imaginary parts
            straight = self.op.apply(u)
            try:
                turned = self.op.apply(1j * u)
            except Exception:  # a foreign function may refuse complex fields in any way
                return "domain"
            if norm(turned - 1j * straight) <= ROUGHLY * norm(straight):
                return ""
            if not np.any(turned):
                return "domain"
            return "" if np.any(np.imag([straight, turned])) else "codomain"

    def _size(self):
        """sqrt(|A|_1 |A|_inf)."""
        sums = [bound(np.ones(n)) for bound, n in zip(self.bounds, reversed(self.op.shape))]
        return prod(sqrt(np.max(sizes, initial=0.0)) for sizes in sums)

    def _norm(self):
        """The 2-norm, from below, by power iteration; only products of A itself count."""
        size, x = 0.0, self.domain()
        for _ in range(POWERS):
            y = self.op.apply(x / (norm(x) or 1.0))
            size = max(size, norm(y))
            try:
                x = self.op.T.apply(y)
                x = x.real if self.real_linear == "domain" else x
            except DerivativeError:  # it has no transpose
                x = self.domain()
        return size


def _scaled(op, u):
    """Results for a field times 2^900 and 2^-900, scaled back: the same digits."""
    return np.stack([op.apply(u * 2.0**k) * 2.0**-k for k in (900, -900)])


def _twice(op, u):
    """The result for a field and the field itself, of a second application and of a first: the same bits."""
    before, first = u.copy(), op.apply(u)
    return np.append(op.apply(u), u), np.append(first, before), 0.0


def _dot(a, b):
    """Summed in double precision: the sums are not what is tested."""
    return np.sum(a * b.astype(np.result_type(b, float)))


# Identities of a right operator: left side, right side, and what their rounding is relative to.
IDENTITIES = {
    "linearity": lambda p, u, v, g: (
        p.op.apply(0.75 * u - v),
        0.75 * p.op.apply(u) - p.op.apply(v),
        p.bound(u) + p.bound(v),
    ),
    "JVP": lambda p, u, v, g: (pushforward(p.op, u, v)[1], p.op.apply(v), p.bound(v)),
    "VJP": lambda p, u, v, g: (pullback(p.op, u)[1](g), p.transposed(g, u.dtype.kind != "c"), p.bound(g, True)),
    "transpose": lambda p, u, v, g: (
        p.product(p.op.apply(u), g),
        p.product(u, p.op.T.apply(g)),
        p.size * norm(u) * norm(g),
    ),
    "second order": lambda p, u, v, g: (
        hvp(lambda x: anp.sum(anp.real(p.op(x) ** 2)) / 2, u, v),
        p.transposed(p.op.apply(v), True),
        p.size * p.size * norm(v),
    ),
    "scaling by 2^+-900": lambda p, u, v, g: (_scaled(p.op, u), p.op.apply(u), p.bound(u)),
    "scaling by 2^+-900, transposed": lambda p, u, v, g: (_scaled(p.op.T, g), p.op.T.apply(g), p.bound(g, True)),
    "same bits twice": lambda p, u, v, g: _twice(p.op, u),
    "same bits twice, transposed": lambda p, u, v, g: _twice(p.op.T, g),
    "forward": lambda p, u, v, g: (
        p.matrix @ u.ravel(),
        np.stack([form @ u.ravel() for form in p.forms]),
        p.bound(u),
    ),
    "transposed": lambda p, u, v, g: (
        p.matrix.T @ g.ravel(),
        np.stack([form @ g.ravel() for form in p.turned]),
        p.bound(g, True),
    ),
}
FORMS = "forward", "transposed"  # identities of an operator that can be listed
# Those that are not tried in double precision alone, and those in real numbers only.
KINDS = {"transpose": DTYPES, "forward": DTYPES[:3], "transposed": DTYPES[:3], "second order": DTYPES[:1]}
EXACT = "scaling by 2^+-900", "scaling by 2^+-900, transposed"  # identities that no solve may blur
# Which power of the size of an operator has to be a number of the dtype, with room for the fields.
EXPONENTS = {"second order": 2} | dict.fromkeys(EXACT, 10)


def tolerance_of(structure):
    """Of a structure that solves, or has members that do, the largest; else 0.

    An inverse has it in `solver.system.rtol`: its residual is accepted there, whatever the method.
    """
    system = getattr(getattr(structure, "solver", None), "system", structure)
    return max(float(getattr(system, "rtol", 0.0)), *map(tolerance_of, getattr(structure, "members", ())), 0.0)


# ------------------------------------------------------------ transpose


def transpose(op, seeds=5, rng=None):
    """Operator -> summary of the scaled dot test, |<A u, v> - <u, A^T v>| / (eps sqrt(|A|_1 |A|_inf) |u| |v|).

    Parameters
    ----------
    op : Operator
    seeds : int
        Pairs of random fields for each dtype.
    rng : None, int or numpy Generator
        Source of the fields; default: a fixed seed.

    Returns
    -------
    Summary
        One row for float64, complex128, float32 and complex64, each <= 10. `.verdict`, `.ok`,
        `.worst`, `.rows`; str() is the table.

    Notes
    -----
    The products are plain, without conjugation, as `.T` is; of an operator that is linear over the real numbers only
    (see `operator`) their real parts are compared. The norms come from the entries; without
    entries they are lower bounds from products with A, which makes the test stricter. An operator
    that contains a solve is judged by the tolerance of the solve in place of eps.

    Examples
    --------
    >>> from sparsedp import Grid, from_functions, gradient
    >>> transpose(gradient(Grid((4, 3)))).verdict
    'agrees'
    >>> transpose(from_functions(np.cumsum, np.cumsum, 5, 5)).verdict
    'disagrees'
    """
    check_operator("check.transpose", op)
    rows = Probe(op, seeds, rng).rows("transpose")
    return Summary(f"transpose of {op.name}, {op.domain} -> {op.codomain}", rows)


# ------------------------------------------------------------ agreement of forms


def twin(op, seeds=3, rng=None):
    """Operator -> summary: its matrix against its matrix-free form, forward and transposed.

    Parameters
    ----------
    op : Operator
    seeds : int
        Random fields for each dtype.
    rng : None, int or numpy Generator
        Source of the fields; default: a fixed seed.

    Returns
    -------
    Summary
        The difference of the two products, entry by entry, in units of eps |A| |u| (for products of
        operators |A| |B| |u|), each <= 10. Beside the transposed products stands that of the matrix which the
        transpose assembles by itself.

    Notes
    -----
    Some operators have one form only, and the first row says so. One that was given as a matrix is
    compared with the product of that matrix by SciPy. One that was given by functions is compared
    with its columns, computed one application at a time, up to 512 unknowns; above, only the functions
    are there, nothing can be compared, and the verdict is inconclusive.

    Examples
    --------
    >>> from sparsedp import Grid, divergence
    >>> twin(divergence(Grid((4, 3)))).verdict
    'agrees'
    """
    check_operator("check.twin", op)
    return Summary(f"twin of {op.name}, explicit against matrix-free", _form_rows(Probe(op, seeds, rng)))


def _form_rows(probe):
    """Rows: both products in three dtypes, entry by entry."""
    if probe.real_linear:
        return [Row("forms", note="one form: given by functions, and no matrix of complex numbers stands for it")]
    rows = [Row("forms", note=_forms(probe.op.structure, probe.listed))]
    for name in FORMS if probe.listed else ():
        rows += probe.rows(name)
    return rows


def _forms(structure, listed):
    if isinstance(structure, Matrix):
        return "one form: given as a matrix; compared with the product by SciPy"
    if structure.has_entries:
        return "both" if listed else "too large: the matrix was not built for this test"
    return f"one form: given by functions{'; compared with' if listed else ', and too large to list'} its columns"


def fault_of(op, rng):
    """Operator -> what is wrong with its linearity or its transpose, in words; "" if nothing."""
    probe = Probe(op, 1, rng)
    kinds = DTYPES[:1] if probe.real or probe.real_linear == "domain" else DTYPES[1:2]
    failed = [one for name in ("linearity", "transpose") for one in probe.rows(name, kinds) if one.ok is False]
    if not failed:
        return ""
    worst = max(failed, key=lambda one: one.figure)
    how = worst.note or f"is off by about {worst.figure * max(probe.tolerance, EPS):.0e}"
    return f"its {worst.name.split(',')[0]} {how}"


def layouts(u):
    """Array -> its name in words: the same numbers, laid out otherwise in memory."""
    return {
        "Fortran order": np.asfortranarray(u),
        "strided": np.stack([u, np.nan * u], axis=-1)[..., 0],
        "read-only": np.broadcast_to(u.copy(), u.shape),
        "reversed": np.flip(np.flip(u).copy()),
    }


# ------------------------------------------------------------ the summary


def operator(op, seeds=3, rng=None):
    """Operator -> its summary: spaces, form, entries, and one row for each property of a right operator.

    Parameters
    ----------
    op : Operator
        From the catalogue, or from outside: `from_matrix`, `from_functions`, `from_linear_operator`.
    seeds : int
        Random fields for each test and dtype.
    rng : None, int or numpy Generator
        Source of the fields; default: a fixed seed.

    Returns
    -------
    OperatorSummary
        `.verdict` and `.ok`; `.rows` with name, figure, limit, ok, note; `.failed` names what failed;
        print(summary) shows it all.

    Notes
    -----
    Rows: linearity, transpose (scaled dot test in four dtypes), twin (explicit against matrix-free,
    forward and transposed), JVP, VJP, second order, same bits twice, the same digits for a field times 2^+-900.
    Beside them stand facts without a verdict (`facts`): row sums, spectrum, the largest stable step. Whether an
    operator is the derivative that it should be, and of which order, `check.order` tells. Figures are in units of
    rounding; an inverse is judged by the tolerance of its solve, without its check of primal data. Shapes, dtypes,
    integers, batches and memory layouts are the same code for every Operator: no rows.

    An operator with ``dtype=complex`` whose domain or codomain is real (a real FFT, or its inverse) is linear over the
    real numbers only. Its transpose is right if Re sum(g * A u) = Re sum(A^T g * u) for all complex g, which is what
    derivatives need; a row says so, and there is no matrix to compare with.

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
    with np.errstate(all="ignore"), unwarned():  # what overflows shows in the figures
        try:
            probe = Probe(op, seeds, rng)
        except Exception as error:  # a foreign function may raise anything
            return OperatorSummary(op, None, [Row("application", inf, LIMIT, False, error_text(error))])
        return OperatorSummary(op, probe, _rows(probe))


REAL_SIDES = {
    "domain": "real numbers: it takes real fields only; its transpose is compared in real parts",
    "codomain": "real numbers: its results are real; its transpose is compared in real parts",
}


def _rows(probe):
    rows = [Row("linear over", note=REAL_SIDES[probe.real_linear])] if probe.real_linear else []
    rows += [one for name in IDENTITIES if name not in FORMS for one in probe.rows(name)]
    return rows + [one._replace(name=f"twin, {one.name}") for one in _form_rows(probe)]


class OperatorSummary(Summary):
    """The properties of one operator, and whether it is right. Prints itself.

    Attributes
    ----------
    op : Operator
    size : float or None
        sqrt(|A|_1 |A|_inf), from below without entries.
    nnz : int or None
        Number of stored entries, where listing them costs no application.
    facts : dict
        What the operator is: domain, codomain, form, dtype, nnz, size; row sums, symmetry; of a square one spectral
        radius, definiteness, null space and the largest stable step of u' = A u by explicit Euler. Computed when they
        are asked for; what cannot be computed at a fair price is left out.
    """

    def __init__(self, op, probe, rows):
        nnz = int(op.matrix.nnz) if probe and probe.bounds else None
        super().__init__(f"{op.name}: {op.domain} -> {op.codomain}", rows, op=op, size=probe and probe.size, nnz=nnz)

    @cached_property
    def facts(self):
        """Dict of what the operator is."""
        op = self.op
        basic = {"domain": str(op.domain), "codomain": str(op.codomain), "form": op.form, "dtype": str(op.dtype)}
        basic |= {"nnz": self.nnz, "size": self.size}
        # One that cannot even be applied has no facts.
        return basic | (facts_of(op, self.nnz is not None, not self.failed) if self.size is not None else {})

    def to_dict(self):
        """The summary as plain numbers, strings and lists."""
        return super().to_dict() | self.facts

    def parts(self):
        """The verdict, the facts, and the rows."""
        verdict, rows = super().parts()
        texts = ((name, f"{value:.4g}" if isinstance(value, float) else value) for name, value in self.facts.items())
        return [verdict, *(f"  {name}: {value}" for name, value in texts if value is not None), rows]
