"""Operator: a constant linear map between two spaces that knows its transpose."""

from __future__ import annotations

import weakref
from functools import cached_property
from math import prod
from numbers import Number
from typing import Any, NoReturn

import numpy as np
from scipy.sparse import issparse

from sparsedp import kernels
from sparsedp._utils import buffers
from sparsedp._utils.calls import shortened
from sparsedp._utils.counters import active
from sparsedp._utils.html import facts, spy
from sparsedp._utils.reconstruction import Frozen, Reconstructible
from sparsedp._utils.validation import check_finite, check_native, check_out, check_shape, field_array
from sparsedp.autodiff.backend import NUMPY, Backend
from sparsedp.autodiff.tape import apply_operator, isbox
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError
from sparsedp.grid.space import Space, fits
from sparsedp.operators.structure.base import Matrix, Structure, assembled, result_dtype
from sparsedp.operators.structure.lazy import Diagonal, compose, times, total

__all__ = ["Operator"]

# Up to this number of unknowns for each pass, one sparse product costs less than stencil passes: benchmarks/apply.py.
EXPLICIT_BELOW_COMPILED = 4608
EXPLICIT_BELOW_PLAIN = 262144
AS_OPERATOR = "dp.from_matrix(M, A.domain, A.codomain)"  # a sparse matrix M beside an operator A
SPY_BELOW = 20_000  # rows and columns of a matrix that a notebook draws, in 0.1 s


class Operator(Frozen, Reconstructible):
    """A constant linear map from fields on `domain` to fields on `codomain`. Frozen.

    Builders such as `gradient` and `from_matrix` return operators; ``@ + - *`` combine them, ``op(u)`` applies one. The
    VJP of ``op(u)`` is ``op.T(g)``.

    Parameters
    ----------
    structure : Structure
        The linear map of flat arrays.
    domain, codomain : Space
    name : str
    form : "explicit" or "matrix-free", optional
        Default: by a fixed rule, from the size, the structure and the presence of numba.

    Raises
    ------
    ShapeError
        If the structure does not fit the spaces.

    See Also
    --------
    from_matrix, from_functions, from_linear_operator, inverse, check.operator

    Notes
    -----
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp.operators.given import from_matrix
    >>> double = 2 * from_matrix(np.eye(3), name="copy")
    >>> double(np.array([1.0, 2.0, 3.0]))
    array([2., 4., 6.])
    """

    structure: Any
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

    def __init__(
        self, structure: Structure, domain: Space, codomain: Space, name: str, form: str | None = None
    ) -> None:
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

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        arguments = self.structure, self.domain, self.codomain, self.name, self.form
        if self.form == "matrix-free" or "_origin" not in self.__dict__ or isinstance(self.structure, Matrix):
            return Operator, arguments
        # The matrix of a transpose has the bits of the matrix of its origin, which is not pickled.
        return _with_matrix, (self._matrix_structure, *arguments)

    # ------------------------------------------------------------ application

    def _origin(self):
        """Return the operator whose transpose this is, while it exists; else None. Replaced by a weak reference."""
        return None

    def __call__(self, u: Any) -> Any:
        """Apply to a field of the shape of the domain, or to a batch of them. Differentiable; the result is new.

        Leading axes are a batch: from (50, *domain.shape) to (50, *codomain.shape).
        """
        try:
            if active or isbox(u):
                return apply_operator(self, u)
            return self.apply(u)
        except Exception as error:
            raise shortened(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames

    def apply(self, u: Any, out: np.ndarray | None = None) -> Any:
        """Apply to a plain array, without the tape.

        Parameters
        ----------
        u : array, shape (..., *`domain.shape`)
            Leading axes are a batch of fields.
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

    def apply_array(self, u: Any, out: np.ndarray | None = None) -> np.ndarray:
        """Apply to a NumPy array: see `apply`."""
        u = field_array(self, u, batch=True)
        shape = self.codomain.shape
        dtype = result_dtype(self.structure, u.dtype)
        lead = u.shape[: u.ndim - len(self.domain.shape)]
        if out is None:
            out = buffers.empty(lead + shape, dtype)
        else:
            check_out(self, out, u, dtype, lead + shape)
        if lead:
            count = prod(lead)
            for field, result in zip(u.reshape(count, self.shape[1]), out.reshape(count, self.shape[0])):
                self._acting.apply(field, result)
        else:
            self._acting.apply(u.reshape(-1), out.reshape(-1))
        return out

    @cached_property
    def local_structure(self) -> Structure:
        """The linear map on the entries of fields that this process holds."""
        return self.backend.local_structure(self)

    @cached_property
    def _acting(self):
        """The structure that is applied in this form."""
        if self.form == "explicit":
            return self._matrix_structure
        return self.structure

    @cached_property
    def _matrix_structure(self):
        """The entries as a Matrix."""
        if isinstance(self.structure, Matrix):
            return self.structure
        origin = self._origin()
        if origin is not None:  # transposed entry by entry, so that the two matrices hold the same bits
            return origin._matrix_structure.transpose()
        return assembled(self.structure, self.name)

    # ------------------------------------------------------------ transpose and algebra

    @property
    def T(self) -> Operator:
        """The plain transpose (for complex entries too), from codomain to domain."""
        return self._origin() or self._transposed or self._make_transpose()

    def _make_transpose(self):
        """Return the transpose, and keep it."""
        if self.name.endswith(".T"):
            name = self.name[:-2]
        else:
            name = f"{_bracket(self.name)}.T"
        transposed = self._acting_as(self.structure.transpose(), self.codomain, self.domain, name)
        if self.tangent is self:  # otherwise the transpose of the transpose is the operator without checks
            # Weak: a cycle would keep large matrices alive until the garbage collector runs.
            transposed.__dict__["_origin"] = weakref.ref(self)
        self.__dict__["_transposed"] = transposed
        return transposed

    @property
    def tangent(self) -> Operator:
        """The operator for tangents: this one, without checks of primal data."""
        return self._unchecked or self

    @cached_property
    def _unchecked(self):
        """The operator without checks; None if it has none."""
        structure = self.structure.tangent()
        if structure is self.structure:
            return None  # not the operator itself: the reference cycle would be freed late
        return self._acting_as(structure, self.domain, self.codomain, self.name)

    def _acting_as(self, structure, domain, codomain, name):
        """Return an operator of the same class and form."""
        return Operator(structure, domain, codomain, name, self.form)

    def __matmul__(self, other: Any) -> Any:
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
        """Return the product with another operator."""
        if not fits(self.domain, other.codomain):
            raise ShapeError(f"{self.name} takes {self.domain}, but {other.name} gives {other.codomain}")
        name = f"{_bracket(self.name)} @ {_bracket(other.name)}"
        return Operator(compose(self.structure, other.structure), other.domain, self.codomain, name)

    @cached_property
    def _flat(self):
        """The same map on flat arrays."""
        return Operator(self._acting, Space(self.domain.size), Space(self.codomain.size), self.name, self.form)

    def __add__(self, other: Any) -> Operator:
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

    __radd__ = __add__  # raises with advice: only sums of operators are defined

    def __sub__(self, other: Any) -> Operator:
        if isinstance(other, (Operator, Number)) or issparse(other):
            return self + other * -1.0
        return NotImplemented

    def __rsub__(self, other: Any) -> Operator:
        return self + other  # raises with advice

    def __pow__(self, exponent: Any) -> NoReturn:
        raise TypeError(f"{self.name} ** {exponent!r} is not defined; write A @ A, or dp.matrix_power(A, exponent)(u)")

    def __neg__(self) -> Operator:
        return self * -1.0

    def _refuse_traced_factor(self):
        """Raise the error of a traced number that scales an operator."""
        raise DerivativeError(
            f"a traced number cannot scale an operator; write nu * {self.name}(u), and to solve a system with it "
            "dp.implicit(residual)"
        )

    def __mul__(self, factor: Any) -> Operator:
        if isbox(factor):
            self._refuse_traced_factor()
        if isinstance(factor, Operator):
            raise TypeError(f"{self.name} * {factor.name} is not defined; write A @ B to compose operators")
        if not _is_scalar(factor):
            return NotImplemented
        number: Any = complex(factor)  # NumPy has no integers of more than 64 bits
        label = "-" if number == -1 else f"{factor:g} * "
        if not np.iscomplexobj(factor):
            number = number.real
        check_finite(f"a factor of {self.name}", number)
        structure = times(self.structure, number)
        return Operator(structure, self.domain, self.codomain, f"{label}{_bracket(self.name)}")

    __rmul__ = __mul__

    def __truediv__(self, number: Any) -> Operator:
        if isbox(number):
            return self * number  # raises with advice
        if not _is_scalar(number):
            return NotImplemented
        if not 0 < abs(number) < np.inf:
            raise NonFiniteError(f"{self.name} can be divided by a finite number other than 0 only, got {number}")
        if np.iscomplexobj(number):
            return self * (1.0 / number)
        share, exponent = np.frexp(float(number))  # 1 / 1e308 is subnormal and loses digits, a power of two does not
        half = int(exponent) // 2  # in two steps, as 2^-exponent of a subnormal number is infinite
        structure = times(times(self.structure, 1.0 / float(share)), 2.0**-half)
        structure = times(structure, 2.0 ** (half - int(exponent)))
        return Operator(structure, self.domain, self.codomain, f"{_bracket(self.name)} / {number:g}")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Operator:
        """Let NumPy numbers scale an operator; raise TypeError with advice for any other NumPy function."""
        if any(map(isbox, inputs)):
            self._refuse_traced_factor()
        if method == "__call__" and ufunc is np.multiply and np.shape(inputs[0]) == ():
            return self * inputs[0]
        if ufunc is np.matmul:
            raise TypeError(f"{self.name} stands on the left of @; for x @ A write {self.name}.T @ x")
        raise TypeError(f"numpy.{ufunc.__name__} does not take an operator; write {self.name}(u) for a field u")

    def __array__(self, *args: Any, **options: Any) -> NoReturn:
        raise TypeError(f"{self.name} is no array; write op.matrix, op.to_scipy() or {self.name}(u)")

    # ------------------------------------------------------------ forms and exchange with SciPy

    @property
    def shape(self) -> tuple[int, int]:
        """(codomain.size, domain.size)."""
        return self.structure.shape

    @property
    def dtype(self) -> np.dtype:
        """float64, or complex128 if the entries are complex."""
        return self.structure.dtype

    @property
    def matrix(self) -> Any:
        """The entries as a csr_array with 32-bit indices; in the matrix-free form assembled at the first access."""
        return self._matrix_structure.matrix

    @property
    def separable(self) -> bool:
        """Whether it is a Kronecker sum: one 1-D factor for each axis."""
        return self.structure.separable

    def explicit(self) -> Operator:
        """Return the same operator, applied by its matrix."""
        return self._in_form("explicit")

    def matrix_free(self) -> Operator:
        """Return the same operator, applied without a matrix; an operator that is defined by a matrix is unchanged."""
        if isinstance(self.structure, Matrix):
            return self
        return self._in_form("matrix-free")

    def _in_form(self, form):
        """Return the same operator in a form."""
        if form == self.form:
            return self
        return Operator(self.structure, self.domain, self.codomain, self.name, form)

    def matvec(self, x: Any) -> Any:
        """Return the flat product A x, for SciPy."""
        return self @ np.asarray(x).reshape(-1)

    def rmatvec(self, y: Any) -> Any:
        """Return the flat product A^H y with the conjugate transpose, for SciPy (`.T` does not conjugate)."""
        return np.conj(self.T @ np.conj(np.asarray(y).reshape(-1)))

    def to_scipy(self) -> Any:
        """Return the operator as a scipy.sparse.linalg.LinearOperator on flat arrays."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(self.shape, matvec=self.matvec, rmatvec=self.rmatvec, dtype=self.dtype)

    def __repr__(self) -> str:
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.form}>"

    def _repr_html_(self):
        """Return HTML for a notebook: the spaces, the form, and a picture of the entries of a small operator."""
        entries: dict[str, Any] = {"from": self.domain, "to": self.codomain, "acts": self.form, "dtype": self.dtype}
        if self.structure.has_entries and max(self.shape) <= SPY_BELOW:
            matrix = self._acting.explicit()
            entries["entries"] = f"{matrix.nnz} of {self.shape[0]} x {self.shape[1]}"
            if matrix.nnz:
                entries["where"] = spy(matrix)
        return facts(self.name, entries)


def _with_matrix(matrix, *arguments):
    """Return an Operator whose matrix is known."""
    op = Operator(*arguments)
    op.__dict__["_matrix_structure"] = matrix
    return op


def _chosen_form(structure):
    """Return the form by a fixed rule, not by timings: the same program gives the same bits everywhere."""
    if isinstance(structure, Matrix):
        return "explicit"
    if isinstance(structure, Diagonal) or not structure.has_entries:
        return "matrix-free"
    limit = EXPLICIT_BELOW_PLAIN
    if kernels.compiled():
        limit = EXPLICIT_BELOW_COMPILED * structure.passes
    if max(structure.shape) <= limit:
        return "explicit"
    return "matrix-free"


def _is_scalar(value):
    """Return whether a value is one number."""
    return isinstance(value, Number) or (isinstance(value, np.ndarray) and value.shape == ())


def _bracket(name):
    """Return the name of an operator for products: a sum in parentheses."""
    if " + " in name or " - " in name:
        return f"({name})"
    return name
