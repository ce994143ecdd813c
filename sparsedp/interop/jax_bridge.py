"""Bridge to JAX: functions of arrays as functions of JAX arrays, and the reverse.

This is the only module that imports jax (extra `jax`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import partial
from itertools import compress
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.pytree import mapped, placed
from sparsedp._utils.validation import check_function, check_precision
from sparsedp.autodiff.tape import Rule, dtype_of, is_variable, sample
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.interop.recording import owned, parts, recorded

__all__ = ["from_jax", "to_jax"]


# ---- functions of this library for JAX -------------------------------------------------------------------------------


def to_jax(f: Callable, like: Any = None) -> Callable:
    """Convert a function of NumPy arrays to a function of JAX arrays that supports jit, grad and vmap.

    Parameters
    ----------
    f : callable
        ``f(*args)``, written with this library and autograd.numpy: for example an Operator, an inverse, a solver, a
        rollout or a loss. Arguments and result are arrays, or pytrees of arrays.
    like : pytree of arrays, optional
        Arrays with the structure, shapes and dtypes of the result of `f`. Leaves are matched by their keys. By default,
        `f` is called once with ones for each new set of argument shapes under jit or vmap.

    Returns
    -------
    callable
        Takes and returns JAX arrays. Dtypes follow JAX: float32, unless ``jax_enable_x64`` is set.

    Raises
    ------
    TypeError
        If `f` is not callable. The returned function raises it if f fails for ones and `like` is not given, or if a
        dtype has neither single nor double precision.
    ShapeError
        Raised by the returned function if the result does not have the leaves and shapes of `like`.

    See Also
    --------
    interop.from_jax, from_blackbox

    Notes
    -----
    Compiled JAX code calls f in Python by a callback. f runs on the CPU and must be deterministic. An exception of f is
    raised unchanged; under jit, JAX wraps it in an exception of its own. vmap calls f once for each entry of the batch.
    Only arguments whose derivatives JAX requests are differentiated, in reverse mode, to every order. Forward mode
    (``jax.jvp``, ``jax.jacfwd``, ``jax.hessian``) is not supported; write ``jax.jacrev(jax.grad(f))`` for the Hessian.
    The backward pass runs f a second time, because JAX cannot store the tape of f.

    For complex numbers see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import sparsedp as dp
    >>> slope = to_jax(dp.gradient(dp.Grid(4, periodic=True)))
    >>> jax.jit(jax.grad(lambda u: jnp.sum(slope(u) ** 2)))(jnp.array([1.0, 2.0, 4.0, 8.0]))
    Array([-16.,  -2.,  -4.,  22.], dtype=float32)
    """
    check_function("to_jax", f, "dp.interop.to_jax(dp.laplacian(grid))")
    functions: dict = {}  # by structure, shapes and dtypes of the arguments, on which the result structure may depend

    def call(*args):
        entries, structure = jax.tree.flatten(args)
        arrays = [*map(jnp.asarray, entries)]
        key = structure, tuple((array.shape, array.dtype) for array in arrays)
        if key not in functions:
            functions[key] = _jax_function(f, structure, like)
        jax_function, result = functions[key]
        entries = jax_function.applied(*arrays)  # the first call sets the structure of the result
        return jax.tree.unflatten(result.structure, entries)

    return ReconstructibleFunction(call, to_jax, f, like)


def _jax_function(f, structure, like):
    """Return f as a function of JAX arrays, for arguments of one structure, and the structure of its result."""
    result = _ResultStructure("result of to_jax", like)
    forms_by_arguments: dict = {}

    def fun(arrays):
        for array in arrays:
            check_precision("an argument of to_jax", array)
        entries = result.leaves(f(*jax.tree.unflatten(structure, arrays)))
        for entry in entries:
            check_precision("result of to_jax", entry)
        return entries

    def forms(values):
        key = tuple((value.shape, value.dtype) for value in values)
        if like is not None:
            return jax.tree.leaves(like)
        if key not in forms_by_arguments:
            try:
                results = fun([np.ones(shape, dtype)[()] for shape, dtype in key])
            except Exception as error:
                raise TypeError(
                    "to_jax learns the shape of a result by one run with ones, which this function does not take "
                    f"({error}); give like, arrays of the shapes of the result"
                ) from error
            forms_by_arguments[key] = [*map(np.zeros_like, results)]
        return forms_by_arguments[key]

    return _JaxFunction(fun, forms), result


class _ResultStructure:
    """The tree structure of the result of a function: the structure of `like`, or else of its first result.

    The leaves of later results are reordered to this structure.

    Parameters
    ----------
    name : str
        Name of the result in messages.
    like : pytree of arrays, optional

    Attributes
    ----------
    structure : treedef
    """

    structure: Any = None

    def __init__(self, name, like=None):
        self._name = name
        self._shapes = None
        if like is not None:
            self._shapes = [np.shape(leaf) for leaf in self.leaves(like)]

    def leaves(self, tree):
        """Return the leaves of a result in the order of the structure, matched by their key paths."""
        rows, structure = jax.tree_util.tree_flatten_with_path(tree)
        if self.structure is None:
            self.structure = structure
            self._paths = [path for path, _ in rows]
        entries = [leaf for _, leaf in rows]
        if structure != self.structure:
            entries = self._paired(dict(rows))
        for path, shape, leaf in zip(self._paths, self._shapes or (), entries):
            if np.shape(leaf) != shape:
                place = f"{self._name}{jax.tree_util.keystr(path)}"
                raise ShapeError(f"{place}: expected shape {shape}, as like has it, got {np.shape(leaf)}")
        return entries

    def _paired(self, leaf_of_path):
        """Return the leaves of a dict {path: leaf} in the order of the structure."""
        if leaf_of_path.keys() != set(self._paths):
            expected = _joined(self._paths)
            got = _joined(leaf_of_path)
            raise ShapeError(f"{self._name}: expected the entries {expected}, got {got}; return the same each time")
        return [leaf_of_path[path] for path in self._paths]


def _joined(paths):
    """Return paths in a pytree as text."""
    return ", ".join(map(jax.tree_util.keystr, paths)) or "none"


class _JaxFunction:
    """A function of a list of NumPy arrays as a function of JAX arrays, with derivatives of every order.

    Parameters
    ----------
    fun : callable
        Takes and returns a list of arrays.
    forms : callable
        Takes a list of JAX arrays and returns arrays with the shapes and dtypes of the results.
    """

    def __init__(self, fun, forms):
        self.fun = fun
        self.forms = forms
        self._pulls: dict = {}
        self.call = jax.custom_vjp(self._run)
        self.call.defvjp(self._forward, self._backward, symbolic_zeros=True)

    def applied(self, *values):
        """Call the JAX function; explain the error that JAX raises in forward mode."""
        try:
            return self.call(*values)
        except TypeError as error:
            if "forward-mode" not in str(error) or "custom_vjp" not in str(error):
                raise
            raise DerivativeError(
                "a function of to_jax has reverse-mode derivatives only, and jax.hessian, jax.jacfwd and jax.jvp "
                "ask for forward-mode ones; write jax.jacrev(jax.grad(f)) for the Hessian, jax.jacrev(f) for "
                "the Jacobian, or dp.jvp and dp.hvp with arrays of NumPy"
            ) from error

    def _run(self, *values):
        """Run the function directly, or register a callback if JAX traces the arguments."""
        if not any(isinstance(value, jax.core.Tracer) for value in values):
            return [*map(jnp.array, self.fun([np.asarray(value)[()] for value in values]))]
        forms = jax.eval_shape(lambda *results: [*results], *self.forms(values))  # with dtypes as JAX converts them
        host = _HostCallback(self.fun, tuple(form.dtype for form in forms))
        return jax.pure_callback(host, forms, *values, vmap_method="sequential")

    def _forward(self, *primals):
        values = [primal.value for primal in primals]
        marks = [() if primal.perturbed else None for primal in primals]
        return [*self.applied(*values)], (values, marks)

    def _backward(self, kept, cotangents):
        values, marks = kept
        moving = tuple(mark is not None for mark in marks)
        nonzero = tuple(not (isinstance(g, SymbolicZero) or g.dtype == jax.dtypes.float0) for g in cotangents)
        if (moving, nonzero) not in self._pulls:
            self._pulls[moving, nonzero] = self._pull(moving, nonzero)
        slopes = self._pulls[moving, nonzero].applied(*values, *compress(cotangents, nonzero))
        variables = compress(range(len(moving)), moving)
        return tuple(placed([None] * len(moving), variables, slopes))

    def _pull(self, moving, nonzero):
        """Return the function from arguments and nonzero cotangents to the gradients of the variable arguments."""
        count = len(moving)
        places = [*compress(range(len(nonzero)), nonzero)]

        def slopes(arrays):
            gradients = recorded(self.fun, arrays[:count], moving)[2]
            return gradients(placed([None] * len(nonzero), places, arrays[count:]))

        def forms(values) -> Iterable:
            return compress(values, moving)

        return _JaxFunction(slopes, forms)


class _HostCallback(NamedTuple):
    """The function that JAX calls back. It compares by value, because JAX compiles equal callbacks only once."""

    fun: Any
    dtypes: tuple

    def __call__(self, *arrays):
        results = self.fun([np.asarray(array)[()] for array in arrays])
        return [np.asarray(y, dtype) for y, dtype in zip(results, self.dtypes, strict=True)]


# ---- functions of JAX on our tape ------------------------------------------------------------------------------------


def from_jax(function: Callable) -> Callable:
    """Convert a function of JAX arrays to a function of NumPy arrays that this library can differentiate.

    Parameters
    ----------
    function : callable
        ``function(*args)``, which ``jax.jit`` can compile. Arguments and result are arrays, or pytrees of arrays.

    Returns
    -------
    callable
        Takes and returns NumPy arrays. With float64 arguments it computes in float64, also if ``jax_enable_x64`` is
        not set.

    Raises
    ------
    TypeError
        If `function` is not callable. The returned function raises it if a dtype has neither single nor double
        precision.

    See Also
    --------
    interop.to_jax

    Notes
    -----
    JAX compiles the function at the first call with each set of shapes. The VJP is ``jax.vjp``, which runs the function
    again, and the JVP is ``jax.jvp``; derivatives of every order are supported. Only traced arguments are
    differentiated.

    For complex numbers see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import sparsedp as dp
    >>> cube = from_jax(lambda x: x**3)
    >>> dp.value_and_grad(lambda x: np.sum(cube(x)))(np.array([1.0, 2.0]))
    (9.0, array([ 3., 12.]))
    """
    check_function("from_jax", function, "dp.interop.from_jax(jax.numpy.sin)")
    rules: dict = {}  # by structure, shapes and dtypes of the arguments, on which the result structure may depend

    def call(*args):
        entries, structure = jax.tree.flatten(args)
        for entry in entries:
            check_precision("an argument of from_jax", entry)
        key = structure, tuple((np.shape(sample(entry)), dtype_of(entry)) for entry in entries)
        if key not in rules:
            form = _ResultStructure("result of from_jax")

            def of_entries(*entries):
                return form.leaves(function(*jax.tree.unflatten(structure, entries)))

            rules[key] = _JaxRule(of_entries), form
        traced, form = rules[key]
        results = traced.rule(*entries)
        return jax.tree.unflatten(form.structure, parts(results, form.structure.num_leaves))

    return ReconstructibleFunction(call, from_jax, function)


class _JaxRule:
    """Wrap a JAX function that returns a list, so that the tape records and differentiates it like a built-in function.

    Its derivatives are JAX functions, too.
    """

    def __init__(self, function):
        self.function = function
        self._compiled: Any = jax.jit(function)
        self._derivatives: dict = {}
        self.rule = Rule("jax function", self._run, self._vjp, self._jvp)

    def _run(self, *entries):
        wide = any(np.asarray(entry).dtype in (np.float64, np.complex128) for entry in entries)
        precision = jax.enable_x64(True) if wide else nullcontext()
        with precision:
            return tuple(map(owned, self._compiled(*entries)))

    def _vjp(self, nums, ans, *entries):
        def pull(g):
            rule, used = self._derivative(_pulled, nums, ans, entries)
            return parts(rule(*entries, *(g[k] for k in used)), len(nums))

        return pull

    def _jvp(self, nums, tangents, ans, *entries):
        return self._derivative(_pushed, nums, ans, entries)[0](*entries, *tangents)

    def _derivative(self, make, nums, ans, entries):
        """Return the rule of a derivative, and the positions of the floating results."""
        used = tuple(k for k, y in enumerate(sample(ans)) if dtype_of(y).kind in "fc")
        key = make, nums, used, len(entries)
        if key not in self._derivatives:
            self._derivatives[key] = _JaxRule(partial(make, self.function, *key[1:]))
        return self._derivatives[key].rule, used


def _pulled(function, nums, used, count, *values):
    """Return the gradients of the arguments `nums`, from the arguments and the cotangents of the results `used`."""

    def some(*moving):
        results = function(*placed(values[:count], nums, moving))
        return [results[k] for k in used]

    results, pull = jax.vjp(some, *(values[num] for num in nums))
    return [*pull(_alike(values[count:], results))]


def _pushed(function, nums, used, count, *values):
    """Return the tangents of all results from the arguments and the tangents of the arguments `nums`.

    Tangents of results that are not in `used` are 0.
    """
    moving = [values[num] for num in nums]
    tangents = _alike(values[count:], moving)

    def of_moving(*moving):
        return function(*placed(values[:count], nums, moving))

    results, slopes = jax.jvp(of_moving, moving, tangents)
    return placed(map(jnp.zeros_like, results), used, [slopes[k] for k in used])


def _alike(slopes, values):
    """Return derivatives converted to the dtypes of the values. JAX requires equal dtypes."""
    return [jnp.asarray(slope, jnp.result_type(x)) for slope, x in zip(slopes, values, strict=True)]


# ---- derivatives by JAX, for checks ----------------------------------------------------------------------------------


def as_tensors(tree: Any) -> Any:
    """Return a tree with JAX arrays in place of its arrays and floating numbers."""

    def tensor(leaf: Any) -> Any:
        if isinstance(leaf, np.ndarray) or is_variable(leaf):
            return jnp.array(leaf)
        return leaf

    return mapped(tensor, tree)


def as_arrays(tree: Any) -> Any:
    """Return a tree with NumPy arrays in place of its JAX arrays."""

    def array(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array):
            return np.asarray(leaf)
        return leaf

    return mapped(array, tree)


def vjp_of(f: Callable, x: Any, g: Any) -> Any:
    """Return the VJP of a function of a tree of JAX arrays by `jax.vjp`."""
    return jax.vjp(f, x)[1](g)[0]


def jvp_of(f: Callable, x: Any, t: Any) -> Any:
    """Return the JVP of a function of a tree of JAX arrays by `jax.jvp`."""
    return jax.jvp(f, (x,), (t,))[1]
