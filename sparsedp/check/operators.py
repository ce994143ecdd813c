"""Checks of operators: their transposes, forms and derivatives.

Each check compares two sides of an identity for random fields. Its result is one row of a table, with the difference
in units of machine epsilon times the norm of the operator.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from math import inf, isnan, log10, prod, sqrt
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np
from numpy.typing import DTypeLike, NDArray

from sparsedp._utils.pytree import norm
from sparsedp._utils.validation import EPS
from sparsedp.autodiff.derivative import hvp, pullback, pushforward, unwarned
from sparsedp.check.point import audit_generator
from sparsedp.check.properties import facts_of
from sparsedp.check.summary import Row, Summary, error_text
from sparsedp.check.table import Table
from sparsedp.errors import DerivativeError
from sparsedp.operators.given import check_operator
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix

__all__ = ["OperatorSummary", "fault_of", "field", "layouts", "operator", "transpose", "twin"]

LIMIT = Summary.limit
DTYPES = ("float64", "complex128", "float32", "complex64")
LARGEST = 2**21  # no matrix is built for a check if an operator has more rows or columns
MOST_COLUMNS = 512  # an operator without entries is applied to all unit vectors up to this number of columns
LINEAR_SHARE = 1e-6  # A (i u) and i A u count as equal up to this relative difference
POWER_ITERATIONS = 8
DECADES = {"float32": 25, "float64": 290}  # norms within 10^+-d can be tested in this dtype
SCALING = 900  # exponent of the power of two by which fields are scaled

Rng = int | np.random.Generator | None


def field(rng: np.random.Generator, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return a field of normal random values in the given dtype."""
    values = rng.standard_normal(shape)
    if np.dtype(dtype).kind == "c":
        values = values + 1j * rng.standard_normal(shape)
    return np.asarray(values, dtype)


class Probe:
    """An operator under test, with random fields and with the reference size of its rounding errors.

    Parameters
    ----------
    op : Operator
        Its tangent is tested (for an inverse: without the check that the right-hand side is compatible).
    seeds : int
        Number of random fields for each test and dtype.
    rng : None, int or numpy Generator

    Attributes
    ----------
    real_linear : "", "domain" or "codomain"
        For an operator of complex dtype that is linear only over the real numbers: which of its fields are real. A real
        FFT has a real domain, and its inverse has a real codomain. Empty for all other operators.
    listed : bool
        Whether the matrix is built for the tests.
    forms : tuple of Operator
        The explicit and the matrix-free form; empty if not `listed`.
    matrix : sparse matrix
        The matrix of the operator; None if not `listed`.
    bounds : tuple of functions
        Two functions that map |u| to |A| |u| and to |A^T| |u|. The rounding error in A u is relative to |A| |u|,
        elementwise. Empty if the operator was given by functions, or if its matrix is not built.
    size : float
        sqrt(|A|_1 |A|_inf) from the entries. Without entries: a lower bound of the 2-norm from products with A, which
        makes the tests stricter.
    """

    def __init__(self, op: Operator, seeds: int = 1, rng: Rng = None) -> None:
        self.op = op.tangent
        self.rng = audit_generator(rng)
        self.seeds = max(seeds, 1)
        self.real = op.dtype.kind != "c"
        structure = self.op.structure
        self.tolerance = tolerance_of(structure)
        if self.real or structure.has_entries:
            self.real_linear = ""
        else:
            self.real_linear = self._find_real_side()
        if structure.has_entries:
            largest = LARGEST
        else:
            largest = MOST_COLUMNS
        self.listed = max(op.shape) <= largest and not self.real_linear  # a complex matrix cannot represent it
        self.bounds: tuple[Callable[[Any], Any], ...] = ()
        if self.listed and structure.has_entries:
            self.bounds = (structure.magnitude(), structure.transpose().magnitude())
        if self.bounds:
            self.size = self._size_from_entries()
        else:
            self.size = self._size_from_products()
        self.forms: tuple[Operator, ...] = ()
        self.matrix: Any = None
        if self.listed:
            self.forms = (self.op.explicit(), self.op.matrix_free())
            self.matrix = self.forms[0].matrix

    @cached_property
    def transposed_forms(self) -> list[Any]:
        """The transpose assembled directly, and the transposes of both forms."""
        return [self.op.structure.transpose().explicit(), *(form.T for form in self.forms)]

    def domain(self, dtype: DTypeLike = float) -> NDArray[Any]:
        """Return a random field of the domain."""
        return field(self.rng, self.op.domain.shape, dtype)

    def codomain(self, dtype: DTypeLike = float) -> NDArray[Any]:
        """Return a random field of the codomain. It is complex if the operator is complex."""
        if not self.real:
            dtype = np.result_type(dtype, np.complex64)
        return field(self.rng, self.op.codomain.shape, dtype)

    def rows(self, name: str, dtypes: Sequence[str] = ()) -> list[Row]:
        """Return one row for each dtype, with the largest difference between the two sides of an identity."""
        rows: list[Row] = []
        default = IDENTITIES[name].dtypes or DTYPES[: 1 if self.real else 2]
        for dtype in map(np.dtype, dtypes or default):
            if self.real_linear == "domain" and dtype.kind == "c":
                continue
            # A real operator that works for real fields may raise an error for complex fields.
            is_optional = dtype.kind == "c" and self.real and rows[0].ok is True
            rows.append(self._row(name, dtype, is_optional))
        return rows

    def _row(self, name: str, dtype: np.dtype[Any], is_optional: bool) -> Row:
        """Return the row of an identity in one dtype. An exception fails the row unless it is optional."""
        label = f"{name}, {dtype}"
        decades = DECADES[np.finfo(dtype).dtype.name] / IDENTITIES[name].power_of_size
        if self.size and abs(log10(self.size)) >= decades:
            return Row(label, note=f"entries of size {self.size:.1e} leave the range of {dtype}")
        try:
            gap = float(self.gap(name, dtype))
        except Exception as error:  # a user's function may raise any exception
            note = error_text(error)
            if is_optional:
                return Row(label, note=f"refused, {note}")
            return Row(label, inf, LIMIT, False, note)
        return Row(label, inf if isnan(gap) else gap, LIMIT, gap <= LIMIT)

    def gap(self, name: str, dtype: np.dtype[Any]) -> float:
        """Return the largest difference between the two sides of an identity over entries and seeds, in roundings."""
        identity = IDENTITIES[name]
        if identity.is_exact:
            tolerance = 0.0
        else:
            tolerance = self.tolerance
        rounding = max(tolerance, float(np.finfo(dtype).eps))
        worst: Any = 0.0
        for _ in range(self.seeds):
            u = self.domain(dtype)
            v = self.domain(dtype)
            g = self.codomain(dtype)
            left, right, bound = identity.sides(self, u, v, g)
            gaps = np.abs(left - right).reshape(-1, max(np.size(bound), 1))
            with np.errstate(all="ignore"):
                shares = np.where(gaps == 0, 0.0, gaps / (bound * rounding))
            worst = np.maximum(worst, np.max(shares, initial=0.0))  # NaN stays NaN
        return worst

    def bound(self, u: NDArray[Any], transposed: bool = False) -> Any:
        """Return the reference size of the rounding errors in A u: |A| |u|, elementwise.

        For operators without entries (transforms, solves) the error of an entry is relative to the whole result, and
        the reference size is the product of the norms of A and u.
        """
        if self.bounds:
            return self.bounds[transposed](np.abs(u).ravel().astype(float))
        return self.size * norm(u)

    def product(self, a: NDArray[Any], b: NDArray[Any]) -> Any:
        """Return sum(a * b), or its real part for an operator that is linear only over the real numbers."""
        product = np.sum(a * b.astype(np.result_type(b, float)))  # in float64: the sum itself is not tested
        if self.real_linear:
            return np.real(product)
        return product

    def transposed(self, g: NDArray[Any], real: bool) -> NDArray[Any]:
        """Return A^T g by the transposed matrix, or by `.T` if there is no matrix; its real part if `real`."""
        if self.listed:
            result = (self.matrix.T @ g.ravel()).reshape(self.op.domain.shape)
        else:
            result = self.op.T.apply(g)
        if real:
            return result.real
        return result

    def _find_real_side(self) -> str:
        """Return which fields are real ("domain" or "codomain") if A is linear only over the real numbers, else ""."""
        u = self.domain()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy may warn that it discards imaginary parts
            of_real = self.op.apply(u)
            try:
                of_imaginary = self.op.apply(1j * u)
            except Exception:  # a user's function may raise any exception for complex fields
                return "domain"
            if norm(of_imaginary - 1j * of_real) <= LINEAR_SHARE * norm(of_real):
                return ""
            if not np.any(of_imaginary):
                return "domain"
            if np.any(np.imag([of_real, of_imaginary])):
                return ""
            return "codomain"

    def _size_from_entries(self) -> float:
        """Return sqrt(|A|_1 |A|_inf)."""
        sums = [bound(np.ones(n)) for bound, n in zip(self.bounds, reversed(self.op.shape))]
        return prod(sqrt(np.max(sizes, initial=0.0)) for sizes in sums)

    def _size_from_products(self) -> float:
        """Return a lower bound of the 2-norm by power iteration. It is valid even if the transpose is wrong."""
        size = 0.0
        x = self.domain()
        for _ in range(POWER_ITERATIONS):
            y = self.op.apply(x / (norm(x) or 1.0))
            size = max(size, norm(y))
            try:
                x = self.op.T.apply(y)
                if self.real_linear == "domain":
                    x = x.real
            except DerivativeError:  # it has no transpose
                x = self.domain()
        return size


def tolerance_of(structure: Any) -> float:
    """Return the largest relative tolerance of the solves in a structure and its members; 0 if there are none.

    All methods of an inverse accept the residual at `solver.system.rtol`.
    """
    system = getattr(getattr(structure, "solver", None), "system", structure)
    members = getattr(structure, "members", ())
    return max(float(getattr(system, "rtol", 0.0)), *map(tolerance_of, members), 0.0)


# ------------------------------------------------------------ identities that every correct operator satisfies
# Each function returns the left side, the right side, and the reference size of their rounding errors.

Sides = tuple[Any, Any, Any]
Array = NDArray[Any]


def _linearity(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare A (3/4 u - v) with 3/4 A u - A v."""
    apply = probe.op.apply
    return apply(0.75 * u - v), 0.75 * apply(u) - apply(v), probe.bound(u) + probe.bound(v)


def _jvp(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the JVP along v with A v."""
    _, tangent = pushforward(probe.op, u, v)
    return tangent, probe.op.apply(v), probe.bound(v)


def _vjp(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the VJP of g with A^T g."""
    _, pull = pullback(probe.op, u)
    return pull(g), probe.transposed(g, u.dtype.kind != "c"), probe.bound(g, True)


def _dot_test(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare <A u, g> with <u, A^T g>."""
    left = probe.product(probe.op.apply(u), g)
    right = probe.product(u, probe.op.T.apply(g))
    return left, right, probe.size * norm(u) * norm(g)


def _second_order(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the Hessian product of |A u|^2 / 2 along v with A^T A v."""

    def half_square(x: Any) -> Any:
        return anp.sum(anp.real(probe.op(x) ** 2)) / 2

    right = probe.transposed(probe.op.apply(v), True)
    return hvp(half_square, u, v), right, probe.size * probe.size * norm(v)


def _scaled_results(op: Any, u: Array) -> Array:
    """Return the results for fields times 2^SCALING and 2^-SCALING, scaled back."""
    return np.stack([op.apply(u * 2.0**k) * 2.0**-k for k in (SCALING, -SCALING)])


def _scaling(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare A u with the results for u times 2^900 and u times 2^-900, scaled back."""
    return _scaled_results(probe.op, u), probe.op.apply(u), probe.bound(u)


def _scaling_transposed(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare A^T g with the results for g times 2^900 and g times 2^-900, scaled back."""
    return _scaled_results(probe.op.T, g), probe.op.T.apply(g), probe.bound(g, True)


def _results_of_two_applications(op: Any, u: Array) -> Sides:
    """Return (second result, field afterwards) and (first result, field before), which must be bit for bit equal."""
    before = u.copy()
    first = op.apply(u)
    return np.append(op.apply(u), u), np.append(first, before), 0.0


def _same_bits(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare two applications bit for bit, and check that the argument is not modified."""
    return _results_of_two_applications(probe.op, u)


def _same_bits_transposed(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare two applications of the transpose bit for bit."""
    return _results_of_two_applications(probe.op.T, g)


def _forms_agree(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the products of all forms with the product of the matrix."""
    products = np.stack([form @ u.ravel() for form in probe.forms])
    return probe.matrix @ u.ravel(), products, probe.bound(u)


def _transposed_forms_agree(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the products of all forms of the transpose with the product of the transposed matrix."""
    products = np.stack([form @ g.ravel() for form in probe.transposed_forms])
    return probe.matrix.T @ g.ravel(), products, probe.bound(g, True)


class Identity(NamedTuple):
    """An identity that every correct operator satisfies.

    Attributes
    ----------
    sides : callable
        ``sides(probe, u, v, g)`` with random fields u and v of the domain and g of the codomain.
    dtypes : tuple of str
        Dtypes of the fields. Default: float64, and also complex128 for a complex operator.
    is_exact : bool
        If True, the two sides must agree to rounding even if the operator contains an iterative solve.
    power_of_size : int
        The test is skipped if this power of the norm of the operator would overflow or underflow in the dtype.
    """

    sides: Callable[[Probe, Array, Array, Array], Sides]
    dtypes: tuple[str, ...] = ()
    is_exact: bool = False
    power_of_size: int = 1


IDENTITIES = {
    "linearity": Identity(_linearity),
    "JVP": Identity(_jvp),
    "VJP": Identity(_vjp),
    "transpose": Identity(_dot_test, DTYPES),
    "second order": Identity(_second_order, DTYPES[:1], power_of_size=2),
    "scaling by 2^+-900": Identity(_scaling, is_exact=True, power_of_size=10),
    "scaling by 2^+-900, transposed": Identity(_scaling_transposed, is_exact=True, power_of_size=10),
    "same bits twice": Identity(_same_bits),
    "same bits twice, transposed": Identity(_same_bits_transposed),
    "forward": Identity(_forms_agree, DTYPES[:3]),
    "transposed": Identity(_transposed_forms_agree, DTYPES[:3]),
}
FORM_IDENTITIES = ("forward", "transposed")  # need the matrix of the operator


# ------------------------------------------------------------ transpose


def transpose(op: Operator, seeds: int = 5, rng: Rng = None) -> Summary:
    """Compare an operator with its transpose by the scaled dot test.

    Parameters
    ----------
    op : Operator
    seeds : int
        Number of pairs of random fields for each dtype.
    rng : None, int or numpy Generator
        Seed or generator of the random fields. Default: a fixed seed.

    Returns
    -------
    Summary
        One row for each of float64, complex128, float32 and complex64. The figure must be at most 10. It has the
        attributes `.verdict`, `.ok`, `.worst` and `.rows`, and str() returns the table.

    See Also
    --------
    check.operator, check.twin, testing.assert_transpose

    Notes
    -----
    The figure is |<A u, v> - <u, A^T v>| / (eps sqrt(|A|_1 |A|_inf) |u| |v|). The products <a, b> = sum(a * b) have no
    complex conjugation, because `.T` is the plain transpose. For an operator that is linear only over the real numbers
    (see `operator`), the real parts are compared. The norms are computed from the matrix entries. An operator without
    entries has lower bounds of its norm from products with A instead, which makes the test stricter. For an operator
    that contains a solve, the tolerance of the solve takes the place of eps.

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


def twin(op: Operator, seeds: int = 3, rng: Rng = None) -> Summary:
    """Compare the matrix of an operator with its matrix-free form, forward and transposed.

    Parameters
    ----------
    op : Operator
    seeds : int
        Number of random fields for each dtype.
    rng : None, int or numpy Generator
        Seed or generator of the random fields. Default: a fixed seed.

    Returns
    -------
    Summary
        The largest elementwise difference of the two products, in units of eps |A| |u| (for a product of operators:
        eps |A| |B| |u|). It must be at most 10. The transposed products are also compared with the matrix that the
        transpose of the operator assembles.

    See Also
    --------
    check.operator, check.transpose

    Notes
    -----
    Some operators have only one form; the first row says so. An operator given as a matrix is compared with SciPy's
    product of that matrix. An operator given by functions is compared with the matrix of its columns, which are
    computed one application at a time, up to 512 unknowns. For more unknowns there is nothing to compare with, and the
    verdict is "inconclusive".

    Examples
    --------
    >>> from sparsedp import Grid, divergence
    >>> twin(divergence(Grid((4, 3)))).verdict
    'agrees'
    """
    check_operator("check.twin", op)
    return Summary(f"twin of {op.name}, explicit against matrix-free", _rows_of_forms(Probe(op, seeds, rng)))


def _rows_of_forms(probe: Probe) -> list[Row]:
    """Return the rows that compare both forms elementwise in three dtypes."""
    if probe.real_linear:
        return [Row("forms", note="one form: given by functions, and no matrix of complex numbers stands for it")]
    rows = [Row("forms", note=_forms_in_words(probe.op.structure, probe.listed))]
    if probe.listed:
        for name in FORM_IDENTITIES:
            rows += probe.rows(name)
    return rows


def _forms_in_words(structure: Any, listed: bool) -> str:
    """Return a sentence that says which forms an operator has."""
    if isinstance(structure, Matrix):
        return "one form: given as a matrix; compared with the product by SciPy"
    if structure.has_entries:
        if listed:
            return "both"
        return "too large: the matrix was not built for this test"
    if listed:
        compared = "; compared with"
    else:
        compared = ", and too large to list"
    return f"one form: given by functions{compared} its columns"


def fault_of(op: Operator, rng: np.random.Generator) -> str:
    """Return a phrase that says what is wrong with the linearity or the transpose of an operator; "" if nothing is."""
    probe = Probe(op, 1, rng)
    if probe.real or probe.real_linear == "domain":
        dtypes = DTYPES[:1]
    else:
        dtypes = DTYPES[1:2]
    failed = []
    for name in ("linearity", "transpose"):
        failed += [row for row in probe.rows(name, dtypes) if row.ok is False]
    if not failed:
        return ""
    worst = max(failed, key=lambda row: row.figure or 0.0)
    how = worst.note or f"is off by about {(worst.figure or 0.0) * max(probe.tolerance, EPS):.0e}"
    return f"its {worst.name.split(',')[0]} {how}"


def layouts(u: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return arrays with the values of `u` in other memory layouts, by name of the layout."""
    return {
        "Fortran order": np.asfortranarray(u),
        "strided": np.stack([u, np.nan * u], axis=-1)[..., 0],
        "read-only": np.broadcast_to(u.copy(), u.shape),
        "reversed": np.flip(np.flip(u).copy()),
    }


# ------------------------------------------------------------ the summary


def operator(op: Operator, seeds: int = 3, rng: Rng = None) -> OperatorSummary:
    """Check all properties that a correct operator has, and summarize its spaces, form and entries.

    Parameters
    ----------
    op : Operator
        An operator of this library, or one from `from_matrix`, `from_functions` or `from_linear_operator`.
    seeds : int
        Number of random fields for each test and dtype.
    rng : None, int or numpy Generator
        Seed or generator of the random fields. Default: a fixed seed.

    Returns
    -------
    OperatorSummary
        It has the attributes `.verdict` and `.ok`; `.rows`, each with name, figure, limit, ok and note; and `.failed`,
        the names of the rows that failed. print(summary) shows the whole table.

    See Also
    --------
    check.transpose, check.twin, Operator, check.order

    Notes
    -----
    The rows are: linearity; transpose (scaled dot test in four dtypes); twin (explicit form against matrix-free form,
    forward and transposed); JVP; VJP; second derivatives; equal bits of two applications; and equal digits for fields
    scaled by 2^900 and 2^-900. The summary also has facts without a verdict (`facts`), such as row sums, spectrum and
    the largest stable time step. Use `check.order` to test whether an operator approximates the intended derivative,
    and with which order. Figures are in units of rounding. For an inverse they are in units of the tolerance of its
    solve, and its check of the right-hand side is switched off. Shapes, dtypes, integers, batches and memory layouts
    have no rows, because all Operators share the code that handles them.

    An operator with ``dtype=complex`` whose domain or codomain is real (a real FFT, or its inverse) is linear only over
    the real numbers. Its transpose is correct if Re sum(g * A u) = Re sum(A^T g * u) for all complex g, which is the
    condition for correct derivatives. A row says that real parts are compared. The twin is not tested, because no
    complex matrix represents such an operator.

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
    with np.errstate(all="ignore"), unwarned():  # an overflow shows in the figures
        try:
            probe = Probe(op, seeds, rng)
        except Exception as error:  # a user's function may raise any exception
            return OperatorSummary(op, None, [Row("application", inf, LIMIT, False, error_text(error))])
        return OperatorSummary(op, probe, _rows(probe))


REAL_SIDES = {
    "domain": "real numbers: it takes real fields only; its transpose is compared in real parts",
    "codomain": "real numbers: its results are real; its transpose is compared in real parts",
}


def _rows(probe: Probe) -> list[Row]:
    """Return the rows of all identities."""
    rows = []
    if probe.real_linear:
        rows.append(Row("linear over", note=REAL_SIDES[probe.real_linear]))
    for name in IDENTITIES:
        if name not in FORM_IDENTITIES:
            rows += probe.rows(name)
    return rows + [row._replace(name=f"twin, {row.name}") for row in _rows_of_forms(probe)]


class OperatorSummary(Summary):
    """The result of `check.operator`. str() returns the verdict, the facts and the table of rows.

    Attributes
    ----------
    op : Operator
    size : float or None
        sqrt(|A|_1 |A|_inf). For an operator without entries: a lower bound of its 2-norm.
    nnz : int or None
        Number of stored entries; None if the operator was given by functions or is too large.
    facts : dict
        Domain, codomain, form, dtype, nnz, size, row sums and symmetry. For a square operator also spectral radius,
        definiteness, dimension of the null space, and the largest stable step of explicit Euler for u' = A u. The
        facts are computed at first access. Facts that are too expensive to compute are omitted.
    """

    def __init__(self, op: Operator, probe: Probe | None, rows: Sequence[Row]) -> None:
        size = None
        nnz = None
        if probe is not None:
            size = probe.size
            if probe.bounds:
                nnz = int(op.matrix.nnz)
        super().__init__(f"{op.name}: {op.domain} -> {op.codomain}", rows, op=op, size=size, nnz=nnz)

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Facts about the operator, by name."""
        op = self.op
        facts = {"domain": str(op.domain), "codomain": str(op.codomain), "form": op.form, "dtype": str(op.dtype)}
        facts |= {"nnz": self.nnz, "size": self.size}
        if self.size is not None:  # an operator that cannot be applied has no other facts
            facts |= facts_of(op, self.nnz is not None, not self.failed)
        return facts

    def to_dict(self) -> dict[str, Any]:
        """Return the summary and the facts as plain numbers, strings and lists."""
        return super().to_dict() | self.facts

    def parts(self) -> list[str | Table]:
        """Return the verdict, the facts, and the rows."""
        verdict, rows = super().parts()
        lines = []
        for name, value in self.facts.items():
            if value is not None:
                lines.append(f"  {name}: {value:.4g}" if isinstance(value, float) else f"  {name}: {value}")
        return [verdict, *lines, rows]
