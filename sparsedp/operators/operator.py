"""Operator: a constant linear map between two spaces that knows its transpose."""

import weakref
from functools import cached_property
from math import prod
from numbers import Number

import numpy as np
from scipy.sparse import issparse

from sparsedp import kernels
from sparsedp._utils import buffers
from sparsedp._utils.calls import shortened
from sparsedp._utils.counters import active
from sparsedp._utils.html import facts, spy
from sparsedp._utils.reconstruction import Frozen, Remade
from sparsedp._utils.validation import check_finite, check_native, check_out, check_shape, field_array
from sparsedp.autodiff.backend import NUMPY, Backend
from sparsedp.autodiff.tape import apply_operator, isbox
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError
from sparsedp.grid.space import Space, fits
from sparsedp.operators.structure.base import Matrix, Structure, assembled, result_dtype
from sparsedp.operators.structure.lazy import Diagonal, compose, times, total

__all__ = ["Operator"]

# Most unknowns for which one sparse product costs less than stencil passes, for each pass: see benchmarks/apply.py.
EXPLICIT_BELOW_COMPILED = 4608
EXPLICIT_BELOW_PLAIN = 262144
AS_OPERATOR = "dp.from_matrix(M, A.domain, A.codomain)"  # a sparse matrix M beside an operator A
SPY_BELOW = 20_000  # rows and columns of a matrix that a notebook draws: that takes 0.1 s


class Operator(Frozen, Remade):
    """A constant linear map from fields on `domain` to fields on `codomain`. Frozen.

    Make one with a builder (`gradient`, `from_matrix`, ...), combine with ``@ + - *``, apply with
    ``op(u)``. The VJP of ``op(u)`` is ``op.T(g)``.

    Parameters
    ----------
    structure : Structure
        How it acts on flat arrays.
    domain, codomain : Space
    name : str
    form : "explicit" or "matrix-free", optional
        Default: by a fixed rule, from the size, the structure and whether numba is installed.

    Raises
    ------
    ShapeError
        If the structure does not fit the spaces.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp.operators.given import from_matrix
    >>> double = 2 * from_matrix(np.eye(3), name="copy")
    >>> double(np.array([1.0, 2.0, 3.0]))
    array([2., 4., 6.])
    """

    structure: Structure
    domain: Space
    codomain: Space
    name: str
    form: str
    backend: Backend  # where the fields are stored
    meant = {
        "dot": "op(u), or A @ B",
        "toarray": "op.matrix.toarray()",
        "todense": "op.matrix.toarray()",
        "tocsr": "op.matrix",
        "tocsc": "op.matrix.tocsc()",
        "nnz": "op.matrix.nnz",
        "inv": "dp.inverse(op)",
        "H": "op.T; of complex entries from_matrix(op.matrix.conj().T)",
        "solve": "inv(b), with inv = dp.inverse(op)",
    }
    _transposed = None
    _origin = staticmethod(lambda: None)  # what it was turned from, while that is there

    def __init__(self, structure, domain, codomain, name, form=None):
        if structure.shape != (codomain.size, domain.size):
            raise ShapeError(f"{name} maps {domain} to {codomain}, but its matrix has shape {structure.shape}")
        super().__init__(
            structure=structure,
            domain=domain,
            codomain=codomain,
            name=name,
            form=form or _chosen_form(structure),
            backend=codomain.backend if domain.backend is NUMPY else domain.backend,
        )

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        given = self.structure, self.domain, self.codomain, self.name, self.form
        if self.form == "matrix-free" or "_origin" not in self.__dict__ or isinstance(self.structure, Matrix):
            return Operator, given
        return _with_matrix, (self._matrix_structure, *given)  # turned from that of its origin, which stays behind

    # ------------------------------------------------------------ application

    def __call__(self, u):
        """Apply to a field of the shape of the domain, or to a batch of them; differentiable; the result is fresh.

        Leading axes are a batch: from (50, *domain.shape) to (50, *codomain.shape).
        """
        try:
            return apply_operator(self, u) if active or isbox(u) else self.apply(u)
        except Exception as error:
            raise shortened(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames

    def apply(self, u, out=None):
        """Apply to a plain array, without the tape.

        Parameters
        ----------
        u : array, shape (..., *`domain.shape`)
            Leading axes are a batch: one field for each of their entries.
        out : array, shape (..., *`codomain.shape`), optional
            Reused for the result: contiguous, of the dtype of the result, no overlap with `u`.

        Returns
        -------
        array, shape (..., *`codomain.shape`)

        Raises
        ------
        ShapeError
            If `u` or `out` has another shape.
        TypeError
            If `u` does not hold numbers, or `out` has another dtype.
        ValueError
            If `out` overlaps `u` or is not contiguous.
        """
        return self.backend.apply(self, u, out)

    def apply_array(self, u, out=None):
        """Apply to a NumPy array: see `apply`."""
        u, shape = field_array(self, u, batch=True), self.codomain.shape
        dtype = result_dtype(self.structure, u.dtype)
        lead = u.shape[: u.ndim - len(self.domain.shape)]
        if out is None:
            out = buffers.empty(lead + shape, dtype)
        else:
            check_out(self, out, u, dtype, lead + shape)
        if lead:
            many = prod(lead)
            for field, result in zip(u.reshape(many, self.shape[1]), out.reshape(many, self.shape[0])):
                self._acting.apply(field, result)
        else:
            self._acting.apply(u.reshape(-1), out.reshape(-1))
        return out

    @cached_property
    def _acting(self):
        """The structure that does the work in this form."""
        return self._matrix_structure if self.form == "explicit" else self.structure

    @cached_property
    def _matrix_structure(self):
        if isinstance(self.structure, Matrix):
            return self.structure
        origin = self._origin()
        # Turned entry by entry, so that the two matrices hold the same bits.
        return origin._matrix_structure.transpose() if origin is not None else assembled(self.structure, self.name)

    # ------------------------------------------------------------ transpose and algebra

    @property
    def T(self):
        """The plain transpose (for complex entries too), from codomain to domain."""
        return self._origin() or self._transposed or self._make_transpose()

    def _make_transpose(self):
        name = self.name[:-2] if self.name.endswith(".T") else f"{_bracket(self.name)}.T"
        turned = self._acting_as(self.structure.transpose(), self.codomain, self.domain, name)
        if self.tangent is self:  # else the way back is the twin that checks nothing, as derivatives need it
            # Weak: a cycle would keep large matrices alive until the collector runs.
            vars(turned)["_origin"] = weakref.ref(self)
        vars(self)["_transposed"] = turned
        return turned

    @property
    def tangent(self):
        """The operator that carries tangents: this one, without checks of primal data."""
        return self._unchecked or self

    @cached_property
    def _unchecked(self):
        structure = self.structure.tangent()
        if structure is self.structure:
            return None  # an operator that refers to itself would never be freed
        return self._acting_as(structure, self.domain, self.codomain, self.name)

    def _acting_as(self, structure, domain, codomain, name):
        """An operator of the same kind and form."""
        return Operator(structure, domain, codomain, name, self.form)

    def __matmul__(self, other):
        if isinstance(other, Operator):
            return self._compose(other)
        if isbox(other) or isinstance(other, np.ndarray):
            check_shape(f"x of {self.name} @ x", other, (self.domain.size,), "; for a field write op(u)")
            return self._flat(other)
        check_native(self.name, other)
        if issparse(other):
            raise TypeError(f"{self.name} @ a sparse matrix is not defined; write A @ {AS_OPERATOR}")
        return NotImplemented

    def _compose(self, other):
        if not fits(self.domain, other.codomain):
            raise ShapeError(f"{self.name} takes {self.domain}, but {other.name} gives {other.codomain}")
        name = f"{_bracket(self.name)} @ {_bracket(other.name)}"
        return Operator(compose(self.structure, other.structure), other.domain, self.codomain, name)

    @cached_property
    def _flat(self):
        """The same map on flat arrays."""
        return Operator(self._acting, Space(self.domain.size), Space(self.codomain.size), self.name, self.form)

    def __add__(self, other):
        if isinstance(other, Number):
            raise TypeError(f"a number cannot be added to {self.name}; write {self.name} + c * dp.identity(space)")
        if issparse(other):
            raise TypeError(f"a sparse matrix cannot be added to {self.name}; write A + {AS_OPERATOR}")
        if not isinstance(other, Operator):
            return NotImplemented
        if not (fits(self.domain, other.domain) and fits(self.codomain, other.codomain)):
            mine, theirs = f"{self.domain} to {self.codomain}", f"{other.domain} to {other.codomain}"
            raise ShapeError(f"{self.name} maps {mine}, but {other.name} maps {theirs}")
        structure = total(self.structure, other.structure)
        return Operator(structure, self.domain, self.codomain, f"{self.name} + {other.name}")

    __radd__ = __add__  # for its advice: no sum of an operator and something else is defined

    def __sub__(self, other):
        return self + other * -1.0 if isinstance(other, (Operator, Number)) or issparse(other) else NotImplemented

    def __rsub__(self, other):
        return self + other  # refused with advice

    def __pow__(self, exponent):
        raise TypeError(f"{self.name} ** {exponent!r} is not defined; write A @ A, or dp.matrix_power(A, exponent)(u)")

    def __neg__(self):
        return self * -1.0

    def _refuse_traced_factor(self):
        raise DerivativeError(
            f"a traced number cannot scale an operator; write nu * {self.name}(u), and to solve a system with it "
            "dp.implicit(residual)"
        )

    def __mul__(self, factor):
        if isbox(factor):
            self._refuse_traced_factor()
        if isinstance(factor, Operator):
            raise TypeError(f"{self.name} * {factor.name} is not defined; write A @ B to compose operators")
        if not _is_scalar(factor):
            return NotImplemented
        number = complex(factor)  # NumPy takes no whole number beyond 64 bits
        check_finite(f"a factor of {self.name}", number if np.iscomplexobj(factor) else number.real)
        label = "-" if number == -1 else f"{factor:g} * "
        structure = times(self.structure, number if np.iscomplexobj(factor) else number.real)
        return Operator(structure, self.domain, self.codomain, f"{label}{_bracket(self.name)}")

    __rmul__ = __mul__

    def __truediv__(self, number):
        if isbox(number):
            return self * number  # refused
        if not _is_scalar(number):
            return NotImplemented
        if not 0 < abs(number) < np.inf:  # NumPy takes no whole number beyond 64 bits
            raise NonFiniteError(f"{self.name} can be divided by a finite number other than 0 only, got {number}")
        if np.iscomplexobj(number):
            return self * (1.0 / number)
        share, exponent = np.frexp(float(number))  # 1 / 1e308 has lost digits, 2^-1024 has not
        half = int(exponent) // 2  # 2^-exponent of a subnormal number is infinite
        structure = times(times(self.structure, 1.0 / float(share)), 2.0**-half)
        structure = times(structure, 2.0 ** (half - int(exponent)))
        return Operator(structure, self.domain, self.codomain, f"{_bracket(self.name)} / {number:g}")

    def __array_ufunc__(self, ufunc, method, *inputs, **options):
        """Let NumPy numbers scale an operator, and name the mistake when anything else is tried."""
        if any(map(isbox, inputs)):
            self._refuse_traced_factor()
        if method == "__call__" and ufunc is np.multiply and np.shape(inputs[0]) == ():
            return self * inputs[0]
        if ufunc is np.matmul:
            raise TypeError(f"{self.name} stands on the left of @; for x @ A write {self.name}.T @ x")
        raise TypeError(f"numpy.{ufunc.__name__} does not take an operator; write {self.name}(u) for a field u")

    def __array__(self, *args, **options):
        raise TypeError(f"{self.name} is no array; write op.matrix, op.to_scipy() or {self.name}(u)")

    # ------------------------------------------------------------ forms and borders

    @property
    def shape(self):
        """(codomain.size, domain.size)."""
        return self.structure.shape

    @property
    def dtype(self):
        """float64, or complex128 when the entries are complex."""
        return self.structure.dtype

    @property
    def matrix(self):
        """The entries as a csr_array with 32-bit indices: in the matrix-free form assembled when first asked for."""
        return self._matrix_structure.matrix

    @property
    def separable(self):
        """Whether it is a Kronecker sum: one 1-D factor for each axis."""
        return self.structure.separable

    def explicit(self):
        """The same operator, applied through its matrix."""
        return self._in_form("explicit")

    def matrix_free(self):
        """The same operator, applied without a matrix. One that was given as a matrix stays as it is."""
        return self if isinstance(self.structure, Matrix) else self._in_form("matrix-free")

    def _in_form(self, form):
        return self if form == self.form else Operator(self.structure, self.domain, self.codomain, self.name, form)

    def matvec(self, x):
        """Flat product A x, as SciPy calls it."""
        return self @ np.asarray(x).reshape(-1)

    def rmatvec(self, y):
        """Flat product A^H y: conjugated, as SciPy wants it (`.T` is not)."""
        return np.conj(self.T @ np.conj(np.asarray(y).reshape(-1)))

    def to_scipy(self):
        """The operator as a scipy.sparse.linalg.LinearOperator on flat arrays."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(self.shape, matvec=self.matvec, rmatvec=self.rmatvec, dtype=self.dtype)

    def __repr__(self):
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.form}>"

    def _repr_html_(self):
        """For a notebook: what it is, and where the entries of a small one are."""
        small = self.backend.whole_fields and self.structure.has_entries and max(self.shape) <= SPY_BELOW
        matrix = self._acting.explicit() if small else None
        entries = {
            "from": self.domain,
            "to": self.codomain,
            "acts": self.form,
            "dtype": self.dtype,
            "entries": None if matrix is None else f"{matrix.nnz} of {self.shape[0]} x {self.shape[1]}",
            "where": None if matrix is None or not matrix.nnz else spy(matrix),
        }
        return facts(self.name, entries)


def _with_matrix(matrix, *given):
    op = Operator(*given)
    op.__dict__["_matrix_structure"] = matrix
    return op


def _chosen_form(structure):
    """A fixed rule, never a timing: the same program gives the same bits everywhere."""
    if isinstance(structure, Matrix):
        return "explicit"
    if isinstance(structure, Diagonal) or not structure.has_entries:
        return "matrix-free"
    limit = EXPLICIT_BELOW_COMPILED * structure.passes if kernels.compiled() else EXPLICIT_BELOW_PLAIN
    return "explicit" if max(structure.shape) <= limit else "matrix-free"


def _is_scalar(value):
    return isinstance(value, Number) or (isinstance(value, np.ndarray) and value.shape == ())


def _bracket(name):
    return f"({name})" if " + " in name or " - " in name else name
