"""Operator: a constant linear map between two spaces, with its transpose."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import cached_property
from math import prod
from numbers import Number
from typing import Any, NoReturn

import numpy as np
from scipy.sparse import issparse

from sparsedp import kernels
from sparsedp._utils import buffers
from sparsedp._utils.base_classes import Frozen, Reconstructible
from sparsedp._utils.calls import shortened
from sparsedp._utils.counters import active
from sparsedp._utils.html import facts, spy
from sparsedp._utils.validation import check_finite, check_native, check_out, check_shape, field_array
from sparsedp.autodiff.backend import NUMPY, Backend
from sparsedp.autodiff.tape import apply_operator, isbox
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError
from sparsedp.grid.space import Space, fits
from sparsedp.operators.structure.base import Matrix, Structure, assembled, result_dtype
from sparsedp.operators.structure.lazy import Diagonal, compose, times, total

__all__ = ["Operator"]

# Up to this number of unknowns (times the number of passes, if kernels are compiled), a sparse matrix product is faster
# than the matrix-free form: see benchmarks/apply.py.
EXPLICIT_BELOW_COMPILED = 4608
EXPLICIT_BELOW_PLAIN = 262144
AS_OPERATOR = "dp.from_matrix(M, A.domain, A.codomain)"  # advice when M, a sparse matrix, is combined with A
MOST_BOUND = 64  # number of forms of arguments for which an operator keeps a function
SPY_BELOW = 20_000  # matrices with at most this many rows and columns are drawn in notebooks, which takes 0.1 s


class Operator(Frozen, Reconstructible):
    """A constant, immutable linear map from fields on `domain` to fields on `codomain`.

    Functions such as `gradient` and `from_matrix` return operators. Operators can be combined by ``@``, ``+``, ``-``
    and ``*``, and ``op(u)`` applies an operator to a field. The VJP of ``op(u)`` for a cotangent g is ``op.T(g)``.

    Parameters
    ----------
    structure : Structure
        The linear map between flat arrays.
    domain, codomain : Space
    name : str
    form : "explicit" or "matrix-free", optional
        Whether the operator is applied by a sparse matrix. Default: chosen by a fixed rule that depends on the size,
        the structure, and whether numba is installed.

    Raises
    ------
    ShapeError
        If the shape of the structure does not match the spaces.

    See Also
    --------
    from_matrix, from_functions, from_linear_operator, inverse, check.operator

    Notes
    -----
    For complex fields and operators see docs/guides/complex_numbers.md.

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
    attribute_suggestions = {
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
    _bound: dict[tuple, Callable[[Any], Any]]  # (shape, dtype) of an array -> function of such arrays, see `bound`

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
            _bound={},
        )

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        arguments = self.structure, self.domain, self.codomain, self.name, self.form
        if self.form == "matrix-free" or "_origin" not in self.__dict__ or isinstance(self.structure, Matrix):
            return Operator, arguments
        # The matrix of this transpose was computed from that of its origin. The origin is not pickled, so the matrix
        # is: assembling it again could give other rounding errors.
        return _with_matrix, (self._matrix_structure, *arguments)

    # ------------------------------------------------------------ application

    def _origin(self):
        """Return the operator of which this is the transpose, or None.

        `_make_transpose` replaces this method by a weak reference, which returns None after that operator was deleted.
        """
        return None

    def __call__(self, u: Any) -> Any:
        """Apply the operator to a field, or to a batch of fields. Differentiable; returns a new array.

        Additional leading axes of `u` are batch axes: an array of shape (50, *domain.shape) gives a result of shape
        (50, *codomain.shape).
        """
        try:
            if active or isbox(u):
                return apply_operator(self, u)
            return self.apply(u)
        except Exception as error:
            raise shortened(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames

    def apply(self, u: Any, out: np.ndarray | None = None) -> Any:
        """Apply the operator to a plain array, without recording for differentiation.

        Parameters
        ----------
        u : array, shape (..., *`domain.shape`)
            Leading axes are batch axes.
        out : array, shape (..., *`codomain.shape`), optional
            Array into which the result is written. It must be contiguous, have the dtype of the result, and not overlap
            `u`.

        Returns
        -------
        array, shape (..., *`codomain.shape`)

        Raises
        ------
        ShapeError
            If `u` or `out` has another shape.
        TypeError
            If the entries of `u` are not numbers, or `out` has another dtype.
        ValueError
            If `out` overlaps `u` or is not contiguous.
        """
        if out is None and type(u) is np.ndarray:
            apply = self._bound.get((u.shape, u.dtype))
            if apply is not None and u.flags.c_contiguous:
                return apply(u)
        return self.backend.apply(self, u, out)

    def apply_array(self, u: Any, out: np.ndarray | None = None) -> np.ndarray:
        """Apply the operator to a NumPy array: see `apply`."""
        u = field_array(self, u, batch=True)
        if out is None:
            return self.bound(u)(u)
        lead = self._batch_shape(u)
        check_out(self, out, u, result_dtype(self.structure, u.dtype), lead + self.codomain.shape)
        count = prod(lead)
        rows, columns = self.shape
        for field, result in zip(u.reshape(count, columns), out.reshape(count, rows), strict=True):
            self._acting.apply(field, result)
        return out

    def bound(self, u: Any) -> Callable[[Any], Any]:
        """Return a function that applies the operator to plain arrays with the shape and the dtype of `u`.

        The function does not check its argument, which must be C-contiguous. It returns a new array, and may be called
        by several threads at once. What depends only on shape and dtype is decided here, once: the operator keeps the
        function. `apply` calls it too.

        Parameters
        ----------
        u : array, shape (..., *`domain.shape`)
            Its entries are not used.

        Returns
        -------
        callable
        """
        if not self.backend.whole_fields or type(u) is not np.ndarray:
            return self.apply
        key = u.shape, u.dtype
        apply = self._bound.get(key)
        if apply is None:
            if field_array(self, u, batch=True).dtype != u.dtype:
                return self.apply_array  # which converts integers, and numbers in another byte order
            apply = self._bind(self._batch_shape(u), u.dtype)
            if len(self._bound) >= MOST_BOUND:
                self._bound.clear()
            self._bound[key] = apply
        return apply

    def _bind(self, lead, dtype):
        """Return the function for arrays of this dtype with leading axes of shape `lead`. It must not refer to self."""
        shape = lead + self.codomain.shape
        count = prod(lead)
        rows, columns = self.shape
        write, zeros = self._acting.bound(dtype)
        new_array = buffers.allocator(shape, result_dtype(self.structure, dtype), zeros)

        def apply_to_flat(u):
            out = new_array()
            write(u, out)
            return out

        def apply(u):
            out = new_array()
            write(u.reshape(-1), out.reshape(-1))
            return out

        def apply_to_batch(u):
            out = new_array()
            for field, result in zip(u.reshape(count, columns), out.reshape(count, rows), strict=True):
                write(field, result)
            return out

        if lead:
            return apply_to_batch
        if len(shape) == len(self.domain.shape) == 1:
            return apply_to_flat
        return apply

    def _batch_shape(self, u):
        """Return the shape of the leading axes of an array of fields."""
        return u.shape[: u.ndim - len(self.domain.shape)]

    @cached_property
    def local_structure(self) -> Structure:
        """The linear map restricted to the field entries that are stored in this process."""
        return self.backend.local_structure(self)

    @cached_property
    def _acting(self):
        """The structure used to apply the operator: the matrix in explicit form, `structure` otherwise."""
        if self.form == "explicit":
            return self._matrix_structure
        return self.structure

    @cached_property
    def _matrix_structure(self):
        """The operator as a Matrix structure, assembled at the first access."""
        if isinstance(self.structure, Matrix):
            return self.structure
        origin = self._origin()
        if origin is not None:  # transpose the matrix of the origin, so that both have bitwise the same entries
            return origin._matrix_structure.transpose()
        return assembled(self.structure, self.name)

    # ------------------------------------------------------------ transpose and algebra

    @property
    def T(self) -> Operator:
        """The plain transpose (for complex entries too), from codomain to domain."""
        return self._origin() or self._transposed or self._make_transpose()

    def _make_transpose(self):
        """Build the transpose, store it for later calls, and return it."""
        if self.name.endswith(".T"):
            name = self.name[:-2]
        else:
            name = f"{_bracket(self.name)}.T"
        transposed = self._acting_as(self.structure.transpose(), self.codomain, self.domain, name)
        if self.tangent is self:  # otherwise (A.T).T is not A, but A without the checks of primal data
            # A weak reference, because a reference cycle would keep large matrices alive until garbage collection.
            transposed.__dict__["_origin"] = weakref.ref(self)
        self.__dict__["_transposed"] = transposed
        return transposed

    @property
    def tangent(self) -> Operator:
        """The same operator without checks of primal data, for tangents and cotangents in derivative rules."""
        return self._unchecked or self

    @cached_property
    def _unchecked(self):
        """The operator without checks of primal data; None if this operator has no such checks."""
        structure = self.structure.tangent()
        if structure is self.structure:
            return None  # returning self would create a reference cycle, which delays freeing the memory
        return self._acting_as(structure, self.domain, self.codomain, self.name)

    def _acting_as(self, structure, domain, codomain, name):
        """Return an operator with another structure and other spaces, in the same form."""
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
        """Return the operator self @ other."""
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

    __radd__ = __add__  # called only for operands that are not operators: raises an error with advice

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
        """Raise DerivativeError, because the factor of an operator must be constant, not traced by autograd."""
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
        number: Any = complex(factor)  # also converts Python integers of more than 64 bits, which NumPy cannot
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
        share, exponent = np.frexp(float(number))  # 1 / 1e308 is subnormal and inexact; dividing by 2^exponent is exact
        half = int(exponent) // 2  # two factors, because 2^-exponent overflows if `number` is subnormal
        structure = times(times(self.structure, 1.0 / float(share)), 2.0**-half)
        structure = times(structure, 2.0 ** (half - int(exponent)))
        return Operator(structure, self.domain, self.codomain, f"{_bracket(self.name)} / {number:g}")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Operator:
        """Support `number * op` for NumPy scalars; raise TypeError with advice for any other NumPy function."""
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
        """The matrix of the operator, a csr_array with 32-bit indices. It is assembled at the first access."""
        return self._matrix_structure.matrix

    @property
    def separable(self) -> bool:
        """Whether the operator is a Kronecker sum, that is, a sum of operators along single axes."""
        return self.structure.separable

    def explicit(self) -> Operator:
        """Return the same operator in explicit form, which is applied as a sparse matrix product."""
        return self._in_form("explicit")

    def matrix_free(self) -> Operator:
        """Return the same operator in matrix-free form; operators that are defined by a matrix are unchanged."""
        if isinstance(self.structure, Matrix):
            return self
        return self._in_form("matrix-free")

    def _in_form(self, form):
        """Return the same operator in the given form."""
        if form == self.form:
            return self
        return Operator(self.structure, self.domain, self.codomain, self.name, form)

    def matvec(self, x: Any) -> Any:
        """Return A x for a flat array x, as SciPy's LinearOperator does."""
        return self @ np.asarray(x).reshape(-1)

    def rmatvec(self, y: Any) -> Any:
        """Return A^H y for a flat array y, as SciPy's LinearOperator does. Unlike `T`, A^H is conjugated."""
        return np.conj(self.T @ np.conj(np.asarray(y).reshape(-1)))

    def to_scipy(self) -> Any:
        """Return the operator as a scipy.sparse.linalg.LinearOperator on flat arrays."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(self.shape, matvec=self.matvec, rmatvec=self.rmatvec, dtype=self.dtype)

    def __repr__(self) -> str:
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.form}>"

    def _repr_html_(self):
        """Return HTML for notebooks: the spaces, the form, and a plot of the nonzero entries if the matrix is small."""
        entries: dict[str, Any] = {"from": self.domain, "to": self.codomain, "acts": self.form, "dtype": self.dtype}
        if self.structure.has_entries and max(self.shape) <= SPY_BELOW:
            matrix = self._acting.explicit()
            entries["entries"] = f"{matrix.nnz} of {self.shape[0]} x {self.shape[1]}"
            if matrix.nnz:
                entries["where"] = spy(matrix)
        return facts(self.name, entries)


def _with_matrix(matrix, *arguments):
    """Return an Operator whose assembled matrix is already available."""
    op = Operator(*arguments)
    op.__dict__["_matrix_structure"] = matrix
    return op


def _chosen_form(structure):
    """Return the form by a fixed rule. Timings are not used, so that results are reproducible bit for bit."""
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
    """Return the name of an operator as a factor of a product: in parentheses if it is a sum."""
    if " + " in name or " - " in name:
        return f"({name})"
    return name
