"""Checks of operators: their transposes, forms and derivatives.

Figures are in units of rounding times the size of the operator; each check is a function of random fields, and a row.
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
LARGEST = 2**21  # unknowns above which no matrix is built for a check
MOST_COLUMNS = 512  # columns that are computed one application at a time
LINEAR_SHARE = 1e-6  # share of the result up to which A (i u) is i A u
POWER_ITERATIONS = 8
DECADES = {"float32": 25, "float64": 290}  # sizes 10^+-d of operators fit into a dtype, with room for the fields
SCALING = 900  # power of two of the scaled fields

Rng = int | np.random.Generator | None


def field(rng: np.random.Generator, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return a random normal field of a dtype."""
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
        For A and A^T: |u| to |A| |u|, what rounding in A u is relative to, entry by entry. Empty without entries.
    size : float
        sqrt(|A|_1 |A|_inf), or a lower bound of the 2-norm from products. A bound from below makes the tests
        stricter, never weaker.
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
        self.listed = max(op.shape) <= largest and not self.real_linear  # a matrix is linear over complex numbers
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
        """The forms of the transpose, and the entries that it assembles by itself."""
        return [self.op.structure.transpose().explicit(), *(form.T for form in self.forms)]

    def domain(self, dtype: DTypeLike = float) -> NDArray[Any]:
        """Return a random field of the domain."""
        return field(self.rng, self.op.domain.shape, dtype)

    def codomain(self, dtype: DTypeLike = float) -> NDArray[Any]:
        """Return a random field of the codomain, complex where the operator is."""
        if not self.real:
            dtype = np.result_type(dtype, np.complex64)
        return field(self.rng, self.op.codomain.shape, dtype)

    def rows(self, name: str, dtypes: Sequence[str] = ()) -> list[Row]:
        """Return for each dtype (default: those of the identity) how far its two sides are apart, at worst."""
        rows: list[Row] = []
        default = IDENTITIES[name].dtypes or DTYPES[: 1 if self.real else 2]
        for dtype in map(np.dtype, dtypes or default):
            if self.real_linear == "domain" and dtype.kind == "c":
                continue
            # A clean refusal of complex fields is fine where real fields work.
            is_optional = dtype.kind == "c" and self.real and rows[0].ok is True
            rows.append(self._row(name, dtype, is_optional))
        return rows

    def _row(self, name: str, dtype: np.dtype[Any], is_optional: bool) -> Row:
        """Return the row of an identity in one dtype; where it is not optional, an error fails."""
        label = f"{name}, {dtype}"
        decades = DECADES[np.finfo(dtype).dtype.name] / IDENTITIES[name].power_of_size
        if self.size and abs(log10(self.size)) >= decades:
            return Row(label, note=f"entries of size {self.size:.1e} leave the range of {dtype}")
        try:
            gap = float(self.gap(name, dtype))
        except Exception as error:  # a function may raise anything
            note = error_text(error)
            if is_optional:
                return Row(label, note=f"refused, {note}")
            return Row(label, inf, LIMIT, False, note)
        return Row(label, inf if isnan(gap) else gap, LIMIT, gap <= LIMIT)

    def gap(self, name: str, dtype: np.dtype[Any]) -> float:
        """Return the distance of the two sides of an identity in units of rounding, at worst over entries and seeds."""
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
        """Return what rounding in A u is relative to: |A| |u|, entry by entry.

        Functions round relative to the whole result (transforms, solves): |A| |u| in norms.
        """
        if self.bounds:
            return self.bounds[transposed](np.abs(u).ravel().astype(float))
        return self.size * norm(u)

    def product(self, a: NDArray[Any], b: NDArray[Any]) -> Any:
        """Return the sum of a b; its real part where only that is the same for an operator and its transpose."""
        product = np.sum(a * b.astype(np.result_type(b, float)))  # in double precision: the sum is not what is tested
        if self.real_linear:
            return np.real(product)
        return product

    def transposed(self, g: NDArray[Any], real: bool) -> NDArray[Any]:
        """Return A^T g by the transposed matrix, or by `.T` without one; of real fields the real part."""
        if self.listed:
            result = (self.matrix.T @ g.ravel()).reshape(self.op.domain.shape)
        else:
            result = self.op.T.apply(g)
        if real:
            return result.real
        return result

    def _find_real_side(self) -> str:
        """Return which fields of an operator are real, if it is not linear over the complex numbers."""
        u = self.domain()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy may say that it discards imaginary parts
            of_real = self.op.apply(u)
            try:
                of_imaginary = self.op.apply(1j * u)
            except Exception:  # a foreign function may refuse complex fields in any way
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
        """Return the 2-norm, from below, by power iteration; only products of A itself count."""
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
    """Return the largest tolerance of a structure that solves, or has members that do; else 0.

    An inverse has it in `solver.system.rtol`: its residual is accepted there, whatever the method.
    """
    system = getattr(getattr(structure, "solver", None), "system", structure)
    members = getattr(structure, "members", ())
    return max(float(getattr(system, "rtol", 0.0)), *map(tolerance_of, members), 0.0)


# ------------------------------------------------------------ identities of a right operator
# Each returns the left side, the right side, and what their rounding is relative to.

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
    """Return the results for a field times 2^+-SCALING, scaled back."""
    return np.stack([op.apply(u * 2.0**k) * 2.0**-k for k in (SCALING, -SCALING)])


def _scaling(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the result with that for a field times 2^+-900, scaled back."""
    return _scaled_results(probe.op, u), probe.op.apply(u), probe.bound(u)


def _scaling_transposed(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare the result with that for a cotangent times 2^+-900, scaled back."""
    return _scaled_results(probe.op.T, g), probe.op.T.apply(g), probe.bound(g, True)


def _results_of_two_applications(op: Any, u: Array) -> Sides:
    """Return the result of a second application and of a first one, each with the field after and before."""
    before = u.copy()
    first = op.apply(u)
    return np.append(op.apply(u), u), np.append(first, before), 0.0


def _same_bits(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare two applications, and their argument before and after."""
    return _results_of_two_applications(probe.op, u)


def _same_bits_transposed(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare two applications of the transpose."""
    return _results_of_two_applications(probe.op.T, g)


def _forms_agree(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare all forms with the product with the matrix."""
    products = np.stack([form @ u.ravel() for form in probe.forms])
    return probe.matrix @ u.ravel(), products, probe.bound(u)


def _transposed_forms_agree(probe: Probe, u: Array, v: Array, g: Array) -> Sides:
    """Compare all forms of the transpose with the product with the transposed matrix."""
    products = np.stack([form @ g.ravel() for form in probe.transposed_forms])
    return probe.matrix.T @ g.ravel(), products, probe.bound(g, True)


class Identity(NamedTuple):
    """An identity of a right operator.

    Attributes
    ----------
    sides : callable
        ``sides(probe, u, v, g)`` with random fields u and v of the domain and g of the codomain.
    dtypes : tuple of str
        Default: float64, and complex128 of a complex operator.
    is_exact : bool
        Whether the tolerance of a solve does not enter.
    power_of_size : int
        Which power of the size of an operator has to be a number of the dtype, with room for the fields.
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
FORM_IDENTITIES = ("forward", "transposed")  # of an operator whose entries can be listed


# ------------------------------------------------------------ transpose


def transpose(op: Operator, seeds: int = 5, rng: Rng = None) -> Summary:
    """Compare an operator with its transpose by the scaled dot test.

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

    See Also
    --------
    check.operator, check.twin

    Notes
    -----
    The figure is |<A u, v> - <u, A^T v>| / (eps sqrt(|A|_1 |A|_inf) |u| |v|). The products are plain, without
    conjugation, as `.T` is; of an operator that is linear over the real numbers only (see `operator`) their real parts
    are compared. The norms come from the entries; without entries they are lower bounds from products with A, which
    makes the test stricter. An operator that contains a solve is measured by the tolerance of the solve in place of
    eps.

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
        Random fields for each dtype.
    rng : None, int or numpy Generator
        Source of the fields; default: a fixed seed.

    Returns
    -------
    Summary
        The difference of the two products, entry by entry, in units of eps |A| |u| (for products of
        operators |A| |B| |u|), each <= 10. The transposed products are also compared with the matrix that the
        transpose assembles by itself.

    See Also
    --------
    check.operator, check.transpose

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
    return Summary(f"twin of {op.name}, explicit against matrix-free", _rows_of_forms(Probe(op, seeds, rng)))


def _rows_of_forms(probe: Probe) -> list[Row]:
    """Return the rows that compare both forms in three dtypes, entry by entry."""
    if probe.real_linear:
        return [Row("forms", note="one form: given by functions, and no matrix of complex numbers stands for it")]
    rows = [Row("forms", note=_forms_in_words(probe.op.structure, probe.listed))]
    if probe.listed:
        for name in FORM_IDENTITIES:
            rows += probe.rows(name)
    return rows


def _forms_in_words(structure: Any, listed: bool) -> str:
    """Say which forms an operator has."""
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
    """Return in words what is wrong with the linearity or the transpose of an operator; empty if nothing."""
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
    """Return the same numbers in other layouts in memory, by name."""
    return {
        "Fortran order": np.asfortranarray(u),
        "strided": np.stack([u, np.nan * u], axis=-1)[..., 0],
        "read-only": np.broadcast_to(u.copy(), u.shape),
        "reversed": np.flip(np.flip(u).copy()),
    }


# ------------------------------------------------------------ the summary


def operator(op: Operator, seeds: int = 3, rng: Rng = None) -> OperatorSummary:
    """Check all properties of a right operator, and summarize its spaces, form and entries.

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

    See Also
    --------
    check.transpose, check.twin, Operator, check.order

    Notes
    -----
    Rows: linearity, transpose (scaled dot test in four dtypes), twin (explicit against matrix-free,
    forward and transposed), JVP, VJP, second order, same bits twice, the same digits for a field times 2^+-900.
    Beside them stand facts without a verdict (`facts`): row sums, spectrum, the largest stable step. Whether an
    operator is the derivative that it should be, and of which order, `check.order` tells. Figures are in units of
    rounding; an inverse is measured by the tolerance of its solve, without its check of primal data. Shapes, dtypes,
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
        """Dict of what the operator is."""
        op = self.op
        facts = {"domain": str(op.domain), "codomain": str(op.codomain), "form": op.form, "dtype": str(op.dtype)}
        facts |= {"nnz": self.nnz, "size": self.size}
        if self.size is not None:  # an operator that cannot be applied has no other facts
            facts |= facts_of(op, self.nnz is not None, not self.failed)
        return facts

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as plain numbers, strings and lists."""
        return super().to_dict() | self.facts

    def parts(self) -> list[str | Table]:
        """Return the verdict, the facts, and the rows."""
        verdict, rows = super().parts()
        lines = []
        for name, value in self.facts.items():
            if value is not None:
                lines.append(f"  {name}: {value:.4g}" if isinstance(value, float) else f"  {name}: {value}")
        return [verdict, *lines, rows]
