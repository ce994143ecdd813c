"""Programs of other libraries as functions between real vectors, with their derivatives.

A program maps a tree of arrays to a tree of arrays: a NumPy function, a torch function or module, a JAX function, a
SciPy LinearOperator, an Operator, or an object with methods ``apply`` and ``vjp``. A complex number is stored as two
real numbers in each vector, so that every inner product is an ordinary dot product.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.pytree import TreeStructure, keys, leaves, mapped
from sparsedp._utils.validation import advise
from sparsedp.autodiff.derivative import jvp as forward_derivative
from sparsedp.autodiff.flattening import Packing, joined
from sparsedp.autodiff.tape import is_variable
from sparsedp.check.point import Point
from sparsedp.check.summary import error_text
from sparsedp.errors import DerivativeError, ShapeError, SparsedpError
from sparsedp.interop.recording import recorded

__all__ = ["CONVENTIONS", "Library", "Program", "WrongResult", "library_of", "plain_numpy_refused", "real_part"]

CONVENTIONS = ("transpose", "adjoint")
ARGUMENTS = {"gradient": "gradient(x)", "vjp": "vjp(x, g)", "jvp": "jvp(x, t)"}
LONGEST_REASON = 200  # characters of the message of another library
IMAGINARY_SHARE = 1e-6  # larger imaginary parts of real numbers, relative to the largest number, are an error
IMAGINARY_EPS = 100.0  # the same in units of machine epsilon; matters in single precision


class WrongResult(Exception):
    """A derivative returned something that cannot be a derivative: a wrong structure, shape or dtype."""


def _no_parameters(f: Any, x: Any) -> tuple[Any, Any]:
    """Return a function and its point unchanged."""
    return f, x


class Library(NamedTuple):
    """How a library stores arrays, and its convention for complex cotangents.

    Attributes
    ----------
    name : "numpy", "torch" or "jax"
    arrays : callable
        ``arrays(tree)`` returns the tree with NumPy arrays.
    tensors : callable
        ``tensors(tree)`` returns the tree with arrays of the library.
    vjp, jvp : callable
        ``vjp(f, x, g)`` and ``jvp(f, x, t)`` return the derivatives by the library, for trees of its arrays.
    convention : "transpose" or "adjoint"
        The derivative of a real loss along dz is Re(sum(g * dz)) for "transpose", and Re(sum(conj(g) * dz)) for
        "adjoint".
    with_parameters : callable
        ``with_parameters(module, x)`` returns a function of input and parameters, and the tree of both.
    """

    name: str
    arrays: Callable[[Any], Any]
    tensors: Callable[[Any], Any]
    vjp: Callable[[Any, Any, Any], Any]
    jvp: Callable[[Any, Any, Any], Any]
    convention: str
    with_parameters: Callable[[Any, Any], tuple[Any, Any]] = _no_parameters


def _unchanged(thing: Any) -> Any:
    """Return the argument."""
    return thing


def _tape_vjp(f: Callable[[Any], Any], x: Any, g: Any) -> Any:
    """Return the VJP by the tape of this library, for a function whose result is a tree."""
    structure = TreeStructure(x, "x", is_variable)
    arrays = structure.variables(x)

    def of_arrays(arrays: Any) -> Any:
        return f(structure.build(arrays))

    values, _, gradients = recorded(of_arrays, arrays, [True] * len(arrays))
    _refuse_hidden_traces(values)
    return structure.build(gradients([g_leaf if is_variable(g_leaf) else None for g_leaf in leaves(g)]))


def _tape_jvp(f: Callable[[Any], Any], x: Any, t: Any) -> Any:
    """Return the JVP by the tape of this library."""
    value, tangent = forward_derivative(f, x, t)
    _refuse_hidden_traces(leaves(value))
    return tangent


def _refuse_hidden_traces(values: Any) -> None:
    """Raise an error if NumPy has stored traced numbers in an array, because their derivatives are lost."""
    if any(np.asarray(value).dtype == object for value in values):
        raise TypeError("NumPy has stored traced numbers in an array")


NUMPY = Library("numpy", _unchanged, _unchanged, _tape_vjp, _tape_jvp, "transpose")


def _torch() -> Library:
    """Return the library torch. It is imported only if something of torch was given."""
    from sparsedp.interop import torch_bridge

    bridge = torch_bridge
    functions = bridge.as_arrays, bridge.as_tensors, bridge.vjp_of, bridge.jvp_of
    return Library("torch", *functions, "adjoint", bridge.with_parameters)


def _jax() -> Library:
    """Return the library JAX. It is imported only if something of JAX was given."""
    from sparsedp.interop import jax_bridge

    bridge = jax_bridge
    return Library("jax", bridge.as_arrays, bridge.as_tensors, bridge.vjp_of, bridge.jvp_of, "transpose")


ROOTS = {"torch": _torch, "jax": _jax, "jaxlib": _jax}


def library_of(*things: Any) -> Library:
    """Return the library that one of some functions and arrays belongs to; NumPy if none belongs to another one."""
    for thing in things:
        for kind in type(thing).__mro__:
            root = kind.__module__.partition(".")[0]
            if root in ROOTS:
                return ROOTS[root]()
    return NUMPY


class Program:
    """A program at a point, as a function between real vectors.

    Parameters
    ----------
    f : callable
        ``f(x)``, a function of trees of arrays of its library.
    x : tree of arrays
    vjp, jvp : callable or None
        The derivatives under test, ``vjp(x, g)`` and ``jvp(x, t)``. None: the derivatives of the library.
    convention : "transpose" or "adjoint", optional
        The convention of `vjp` for complex numbers. Default: that of the library.

    Attributes
    ----------
    library : Library
    point : Point
    result : Packing
        The structure of f(x). Set by the first run.
    runs : dict
        Number of runs of "f", "vjp" and "jvp".
    changed : dict
        Name of an argument that a run changed in place, by name of the function that ran.
    value_name, vjp_name, jvp_name : str
        The calls of the function, of the VJP and of the JVP, for messages.
    jvp_result : Packing or None
        The structure of the JVP if it is not that of f(x).
    takes_arrays : bool
        Whether the derivatives under test take and return NumPy arrays for every library of `f`.
    less_precise : str
        A sentence about a cotangent whose dtype has less precision than x; empty if there is none.
    x_is_list : bool
        Whether x is a list or tuple of numbers, which a function of arrays may take for an array.
    """

    result: Packing

    def __init__(
        self,
        f: Callable[[Any], Any],
        x: Any,
        vjp: Callable[[Any, Any], Any] | None = None,
        jvp: Callable[[Any, Any], Any] | None = None,
        convention: str | None = None,
    ) -> None:
        self.library = library_of(f, *leaves(x))
        self.point = Point(self.library.arrays(x))
        self.f = f
        self._vjp = vjp
        self._jvp = jvp
        self.given_convention = convention
        self.convention = convention or self.library.convention
        self.value_name = "f(x)"
        self.vjp_name = "vjp(x, g)"
        self.jvp_name = "jvp(x, t)"
        self.jvp_result: Packing | None = None
        self.takes_arrays = False
        self.less_precise = ""
        self.x_is_list = isinstance(x, (tuple, list)) and all(isinstance(leaf, (int, float)) for leaf in leaves(x))
        self.runs = {"f": 0, "vjp": 0, "jvp": 0}
        self.changed: dict[str, str] = {}

    # ---------------------------------------------------------------- values

    def start(self) -> NDArray[Any]:
        """Run f at the point for the first time, and return its value as a vector."""
        value = self._first_value()
        if self.library is NUMPY:
            library = library_of(*leaves(value))
            if library is not NUMPY:  # a function of NumPy arrays that computes with another library
                self._change_library(library)
                value = self._first_value()
        arrays = self.library.arrays(value)
        for leaf in leaves(arrays):
            if np.asarray(leaf).dtype == object:
                kind = "an array of objects" if isinstance(leaf, np.ndarray) else type(leaf).__name__
                raise TypeError(
                    f"{self.value_name} must be an array or a tree of arrays, got {kind}; return arrays of numbers"
                )
        self.result = Packing(mapped(np.array, arrays), self.value_name)
        return joined(self.result.values)

    def _first_value(self) -> Any:
        """Run f at the point. If it does not take lists, or the dtype of x, the error says what to write."""
        try:
            return self._run(self.point.fresh())
        except TypeError as error:
            advise(error)
            if isinstance(self.point.template, tuple) and "positional argument" in str(error):
                error.args = (f"{error}; write lambda x: f(*x), because f(x) is called with the whole tuple",)
            raise
        except RuntimeError as error:
            if self.library.name != "torch" or "dtype" not in str(error):
                raise
            dtypes = sorted({str(values.dtype) for values in self.point.values})
            raise TypeError(
                f"f does not take x of dtype {' and '.join(dtypes)}: {error}; "
                "convert x by x.float(), or f by f.double()"
            ) from error

    def _change_library(self, library: Library) -> None:
        """Let the arguments be arrays of another library, in the dtypes that it gives them."""
        self.library = library
        self.point = Point(library.arrays(library.tensors(self.point.fresh())))
        self.convention = self.given_convention or library.convention

    def _run(self, tree: Any) -> Any:
        """Run f for a tree of NumPy arrays, and return what it returns."""
        self.runs["f"] += 1
        with np.errstate(all="ignore"):
            return self._watched("f", self.f, tree)

    def value(self, tree: Any) -> NDArray[Any]:
        """Run f for a tree of NumPy arrays, and return its value as a vector."""
        return joined(self._like_result(self.library.arrays(self._run(tree)), self.value_name))

    def _like_result(self, value: Any, name: str, result: Packing | None = None) -> list[NDArray[Any]]:
        """Return the leaves of a tree that must have the structure and the shapes of f(x), or of another result."""
        result = result or self.result
        advice = f"; return a tree like {result.root}"
        parts = []
        for leaf, part, y in zip(
            result.names_under(name), result.variables(value, name, advice=advice), result.values, strict=True
        ):
            part = np.asarray(part)
            if part.shape != y.shape:
                raise ShapeError(f"{leaf}: expected shape {y.shape}, got {part.shape}{advice}")
            if part.dtype.kind not in "biufc":
                raise ShapeError(f"{leaf}: expected numbers, got dtype {part.dtype}{advice}")
            if np.iscomplexobj(y):
                part = part.astype(np.result_type(y, complex))
            else:
                part = real_part(leaf, part)
            parts.append(part)
        return parts

    def _watched(self, name: str, function: Callable[..., Any], *trees: Any) -> Any:
        """Call a function with trees of NumPy arrays, and note if it changes one of them in place."""
        before = [_bytes_of(tree) for tree in trees]
        arguments = trees
        if not (self.takes_arrays and name != "f"):
            arguments = tuple(self.library.tensors(tree) for tree in trees)
        value = function(*arguments)
        if self.library is NUMPY or self.library.name == "torch":
            for number, (argument, bytes_before) in enumerate(zip(arguments, before)):
                if _bytes_of(self.library.arrays(argument)) != bytes_before:
                    self.changed.setdefault(name, ("x", "its cotangent or tangent")[number])
        return value

    def argument_of(self, kind: str) -> str:
        """Return the name of the vector that the VJP or the JVP takes, for messages."""
        if kind == "vjp":
            return "g"
        return "v" if self.jvp_name == "H(x, v)" else "t"

    def rounded(self, weights: NDArray[Any]) -> NDArray[Any]:
        """Return weights of the result, rounded to the dtypes of its leaves."""
        return joined(self.result.arrays(weights))

    # ---------------------------------------------------------------- derivatives

    def cotangent(self, weights: NDArray[Any], conjugate: bool = False) -> Any:
        """Return the cotangent of the functional sum(weights * f) as a tree like f(x), in the convention of `vjp`."""
        arrays = self.result.arrays(weights)
        if (self.convention == "transpose") != conjugate:
            arrays = [np.conj(array) for array in arrays]
        return self.result.tree(arrays)

    def pull(
        self, tree: Any, weights: NDArray[Any], conjugate_argument: bool = False, conjugate_result: bool = False
    ) -> NDArray[Any]:
        """Return J^T weights at a tree by the VJP under test.

        Parameters
        ----------
        tree : tree of NumPy arrays
        weights : ndarray
        conjugate_argument, conjugate_result : bool
            Whether the cotangent and the result are conjugated, to find a missing conjugate.

        Raises
        ------
        WrongResult
            If the result does not have the structure and the shapes of x.
        """
        self.runs["vjp"] += 1
        g = self.cotangent(weights, conjugate_argument)
        with np.errstate(all="ignore"):
            if self._vjp is None:
                slopes = self._own("vjp", tree, g)
            else:
                slopes = self.library.arrays(self._watched("vjp", self._vjp, tree, g))
        slopes = self._like_x(slopes, self.vjp_name)
        if (self.convention == "adjoint") != conjugate_result:
            slopes = mapped(_conjugated, slopes)
        try:
            self._check_leaves(slopes)
            return self.point.gradient(slopes)
        except (DerivativeError, ShapeError) as error:
            raise WrongResult(str(error).replace("gradient", self.vjp_name, 1)) from error

    def _check_leaves(self, slopes: Any) -> None:
        """Raise an error for a complex cotangent of a real leaf of x, and note one that has less precision than x."""
        names = self.point.names_under("gradient")
        parts = self.point.variables(slopes, "gradient", advice="; return a tree like x", error=DerivativeError)
        for name, part, values in zip(names, parts, self.point.values, strict=True):
            part = np.asarray(part)
            if not np.iscomplexobj(values):
                real_part(name, part)
            if part.dtype.kind in "fc" and np.finfo(part.dtype).eps > np.finfo(values.dtype).eps:
                self.less_precise = f"{self.vjp_name} returns {part.dtype}, but x has {values.dtype}"

    def push(self, tree: Any, tangent: NDArray[Any]) -> NDArray[Any]:
        """Return J tangent at a tree by the JVP under test.

        Raises
        ------
        WrongResult
            If the result does not have the structure and the shapes of f(x).
        """
        self.runs["jvp"] += 1
        t = self.point.unpack(tangent)
        with np.errstate(all="ignore"):
            if self._jvp is None:
                value = self._own("jvp", tree, t)
            else:
                value = self.library.arrays(self._watched("jvp", self._jvp, tree, t))
        try:
            return joined(self._like_result(value, self.jvp_name, self.jvp_result))
        except ShapeError as error:
            raise WrongResult(str(error)) from error

    def _like_x(self, slopes: Any, name: str) -> Any:
        """Return a cotangent of x. JAX returns a tuple with one entry for a function of one argument."""
        if slopes is None:
            raise WrongResult(f"{name}: expected a tree like x, got None; return the cotangent of x")
        template = self.point.template
        if keys(template) is None and isinstance(slopes, (tuple, list)) and len(slopes) == 1:
            return slopes[0]
        if self.x_is_list and isinstance(slopes, np.ndarray):
            kind = type(template).__name__
            raise TypeError(
                f"{name} returns an array, but x is a {kind} of numbers; write x=np.asarray(x), or return a {kind}"
            )
        return slopes

    def _own(self, name: str, tree: Any, direction: Any) -> Any:
        """Return the VJP or JVP by the library of f."""
        derivative = getattr(self.library, name)
        try:
            value = derivative(self.f, self.library.tensors(tree), self.library.tensors(direction))
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:
            if _is_of_a_rule(error):
                raise
            if self.library is NUMPY:  # its error would name traced numbers, of which the caller knows nothing
                raise _plain_numpy_error(name) from None
            reason = error_text(error)[:LONGEST_REASON]
            raise DerivativeError(
                f"f cannot be differentiated without {name}: {reason}; give a function {ARGUMENTS[name]}"
            ) from None
        return self.library.arrays(value)


def _plain_numpy_error(name: str) -> DerivativeError:
    """Return the error for a function that has no derivative by the tape, and no derivative of this name."""
    return DerivativeError(
        f"f cannot be differentiated without {name}: its code is for NumPy arrays only; give a function "
        f"{ARGUMENTS[name]}, or write f with autograd.numpy"
    )


@contextmanager
def plain_numpy_refused(name: str) -> Iterator[None]:
    """Replace errors about traced numbers by one that asks for the derivative of this name."""
    try:
        yield
    except DerivativeError as error:
        if "traced value" in str(error):
            raise _plain_numpy_error(name) from None
        raise


def _is_of_a_rule(error: BaseException) -> bool:
    """Return whether an error is one of a derivative rule, and not of code that takes no traced numbers."""
    return isinstance(error, SparsedpError) and "traced value" not in str(error)


def real_part(name: str, part: NDArray[Any]) -> NDArray[Any]:
    """Return the real part of numbers that have to be real. An FFT leaves imaginary parts of rounding errors.

    Raises
    ------
    ShapeError
        If the imaginary parts are larger than rounding errors.
    """
    if not np.iscomplexobj(part):
        return part
    largest = np.max(np.abs(part.imag), initial=0.0)
    share = max(IMAGINARY_SHARE, IMAGINARY_EPS * float(np.finfo(part.dtype).eps))
    if largest > share * np.max(np.abs(part), initial=0.0):
        raise ShapeError(
            f"{name}: expected real numbers, got imaginary parts of up to {largest:.1e}; return the real part"
        )
    return np.real(part)


def _bytes_of(tree: Any) -> list[bytes]:
    """Return the bytes of all arrays of a tree, to notice changes in place."""
    return [leaf.tobytes() for leaf in leaves(tree) if isinstance(leaf, np.ndarray)]


def _conjugated(leaf: Any) -> Any:
    """Return the complex conjugate of a leaf if it is complex; return all other leaves unchanged."""
    if np.iscomplexobj(leaf):
        return np.conj(leaf)
    return leaf
