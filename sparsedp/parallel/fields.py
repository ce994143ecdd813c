"""Distributed fields: each rank stores a block of the field, which behaves like an array of the shape of the whole.

Elementwise arithmetic is applied to the blocks. Sums, means, maxima and norms are computed over the whole field and are
bitwise the same on every rank. Operations that cannot be computed from the blocks, such as u[i, j], sorting or sums
along an axis, raise TypeError. Thus no result depends on the rank by accident, all ranks take the same branches of a
program, and autograd records the same graph on every rank. A NumPy array of the whole shape can be combined with a
distributed field; each rank then uses its own block of the array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, partialmethod
from operator import attrgetter
from typing import Any, NoReturn

import autograd.numpy as anp
import numpy as np
from numpy.typing import DTypeLike, NDArray

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.backend import ARRAY_KINDS, BOX, NUMPY, ArrayKind
from sparsedp.autodiff.tape import VSpace, autograd_rules, isbox, linear, plain, sample
from sparsedp.errors import ShapeError
from sparsedp.grid.space import Space
from sparsedp.parallel.agreement import Agreement, state

__all__ = ["DistributedField", "converted_like", "block", "everywhere", "total"]


class DistributedField(np.lib.mixins.NDArrayOperatorsMixin):
    """A field distributed over ranks: the flat, read-only block of this rank, and the space of the whole field."""

    __slots__ = ("__weakref__", "flat", "space")

    def __init__(self, flat: NDArray, space: Space) -> None:
        flat.flags.writeable = False
        self.flat = flat
        self.space = space

    layout = backend = property(lambda self: self.space.grid.backend)
    shape = property(lambda self: self.space.shape)
    ndim = property(lambda self: len(self.space.shape))
    size = property(lambda self: self.space.size)
    dtype = property(lambda self: self.flat.dtype)
    nbytes = property(lambda self: self.space.size * self.flat.dtype.itemsize)  # of the whole field, equal on all ranks
    real = property(lambda self: self.like(self.flat.real))
    imag = property(lambda self: self.like(self.flat.imag))

    def like(self, flat: NDArray) -> DistributedField:
        """Return a field on the same space, given the flat block of this rank."""
        return DistributedField(np.ascontiguousarray(flat), self.space)

    def copy(self) -> DistributedField:
        """Return the field itself, because it is read-only."""
        return self

    def astype(self, dtype: DTypeLike, copy: bool = True) -> DistributedField:
        """Return the same field in another dtype."""
        return self.like(self.flat.astype(dtype))

    def gather(self) -> NDArray:
        """Return the whole field as a NumPy array, on every rank."""
        return self.layout.gather(self.flat, self.space.parts).reshape(self.shape)

    def fingerprint(self) -> int:
        """Return a hash of the whole field, the same on every rank."""
        return int(self.layout.sum(np.int64(hash(self.flat.tobytes()) >> 16)))

    def refuse(self, what: str | Callable, *args: Any, **options: Any) -> NoReturn:
        """Raise TypeError for an operation that cannot be computed from the blocks."""
        name = getattr(what, "__name__", what)
        raise TypeError(f"{name} does not work on a field on ranks; write dp.gather(u) for the whole array")

    def __repr__(self):
        return f"<field on {self.space}, on rank {self.layout.comm.rank} of {self.layout.comm.size}>"

    def block_of(self, value: Any) -> Any:
        """Return the flat block of another operand; scalars are returned unchanged."""
        if np.ndim(value):
            return block(value, self.space).flat
        self.layout.compare(value)
        return value

    def __array_ufunc__(self, ufunc, method, *inputs, **options):
        if any(map(isbox, inputs)):
            return NotImplemented  # autograd handles the call
        if method == "reduce" and options == {"axis": None} and ufunc in REDUCED:
            return REDUCED[ufunc](self)
        if method != "__call__" or ufunc.nout != 1 or ufunc.signature or not options.keys() <= {"dtype", "casting"}:
            option = method
            if method == "__call__":
                option = "out= or where="
            self.refuse(f"{ufunc.__name__} with {option}")
        act: Callable = ufunc
        if ufunc is np.power and not options:
            act = pow  # the operator ** of arrays is faster than np.power for small integer exponents
        return self.like(act(*map(self.block_of, inputs), **options))

    def __array_function__(self, function, types, args, options):
        if any(map(isbox, args)):
            return NotImplemented
        implementation: Callable = FUNCTIONS.get(function, partial(self.refuse, function))
        return implementation(*args, **options)


REFUSED_METHODS = {
    "__getitem__": "u[...]",
    "__setitem__": "u[...] = value",
    "__array__": "conversion to an array",
    "__reduce__": "pickling",
    "__bool__": "a truth value",
    "__iter__": "iteration",
    "__len__": "iteration",
    "__float__": "conversion to a number",
    "__complex__": "conversion to a number",
    "__int__": "conversion to a number",
    "__index__": "conversion to a number",
}
for method_name, description in REFUSED_METHODS.items():
    setattr(DistributedField, method_name, partialmethod(DistributedField.refuse, description))


def block(value: Any, space: Space) -> DistributedField:
    """Return a distributed field, given one, a number, or a NumPy array that is the same on every rank.

    An array is broadcast to the shape of the space.
    """
    if isinstance(value, DistributedField):
        if value.space.parts != space.parts or value.layout != space.grid.backend:
            raise ShapeError(f"a field on {space.described} is needed, got one on {value.space.described}")
        return value
    value = np.asarray(value)
    layout = space.grid.backend
    layout.compare(value)
    if np.ndim(value) == 0:
        return DistributedField(np.full(layout.size(space.parts), value), space)
    try:
        whole = np.broadcast_to(value, space.shape)
    except ValueError:
        raise ShapeError(
            f"a field on {space.described} is needed, got an array of shape {value.shape}; give the whole array"
        ) from None
    return DistributedField(layout.take(whole.reshape(-1), space.parts), space)


# ---- implementations of NumPy functions for distributed fields ----


def _first(*values):
    return next(value for value in values if isinstance(value, DistributedField))


def _over_all(function, act, x, axis=None, *others, **options):
    """Return ``act(x)`` for a reduction over the whole field; raise TypeError for arguments such as an axis."""
    if axis is not None and options == {"keepdims": True} and x.shape[axis] == 1:
        return x  # a reduction along an axis of length 1 changes nothing
    if any(value is not None and value is not False for value in (axis, *others, *options.values())):
        x.refuse(f"{function.__name__} with a choice such as an axis")
    return act(x)


def _sum(x):
    """Return the sum of all entries."""
    return x.layout.sum(x.flat.sum())


def _mean(x):
    total_in_dtype = _sum(x)[None]  # an array of length 1, so that the division keeps the dtype
    return (total_in_dtype / x.size)[0]


def _max(x):
    """Return the largest entry; NaN if any entry is NaN."""
    smallest, _ = _range_of_dtype(x)
    return x.layout.max(np.maximum.reduce(x.flat, initial=smallest))


def _min(x):
    """Return the smallest entry; NaN if any entry is NaN."""
    _, largest = _range_of_dtype(x)
    return x.layout.min(np.minimum.reduce(x.flat, initial=largest))


def _any(x):
    return bool(_max(x.astype(bool)))


def _all(x):
    return bool(_min(x.astype(bool)))


def _max_from(x, *axis, initial=None, **options):
    largest = _over_all(np.max, _max, x, *axis, **options)
    if initial is None:
        return largest
    return np.maximum(largest, initial)


def _range_of_dtype(x):
    """Return the smallest and the largest value of the dtype of a field."""
    kind = x.dtype.kind
    if kind == "i":
        return np.iinfo(x.dtype).min, np.iinfo(x.dtype).max
    if kind == "f":
        return -np.inf, np.inf
    if kind == "b":
        return False, True
    return x.refuse("an order of complex numbers")


def _vdot(x, y):
    first = _first(x, y)
    local = np.vdot(block(x, first.space).flat, block(y, first.space).flat)
    return local.dtype.type(first.layout.sum(local))


def _norm(x):
    """Return the Euclidean norm."""
    x = 1.0 * x  # integers become float64
    return np.sqrt(_vdot(x, x).real)


def _count_nonzero(x):
    return int(x.layout.sum(np.count_nonzero(x.flat)))


def _by_entry(act, *values):
    first = _first(*values)
    return first.like(act(*map(first.block_of, values)))


def _equal(x, y, **options):
    if options:
        _first(x, y).refuse("array_equal with a choice")
    return np.shape(x) == np.shape(y) and bool(np.all(x == y))


def _place(extreme, x):
    """Return the flat index, in the whole field, of the first entry equal to `extreme(x)`, or of the first NaN."""
    is_extreme = (x.flat == extreme(x)) | np.isnan(x.flat)
    indices = x.layout.take(np.arange(x.size), x.space.parts)[is_extreme]
    return int(x.layout.min(np.min(indices, initial=x.size)))


def _reshape(x, shape, **options):
    if np.broadcast_to(0, x.shape).reshape(shape).shape != x.shape:
        x.refuse("reshape")
    return x


def _full_like(x, number, dtype=None):
    return x.like(np.full(x.flat.shape, number, dtype or x.dtype))


def _zeros_like(x, dtype=None):
    return _full_like(x, 0, dtype)


def _ones_like(x, dtype=None):
    return _full_like(x, 1, dtype)


def _repeat(x, repeats, axis=None):
    if repeats != 1 or axis is None:
        x.refuse("repeat")
    return x


def _where(condition, x, y):
    return _by_entry(np.where, condition, x, y)


def _clip(x, low=None, high=None):
    return _by_entry(np.clip, x, low, high)


def _is_complex(x):
    return x.dtype.kind == "c"


def _is_real(x):
    return x.dtype.kind != "c"


def _result_type(*values):
    return np.result_type(*(value.dtype if isinstance(value, DistributedField) else value for value in values))


FUNCTIONS: dict[Callable, Callable] = {
    **{getattr(np, name): attrgetter(name) for name in ("shape", "ndim", "size", "real", "imag")},
    np.iscomplexobj: _is_complex,
    np.isrealobj: _is_real,
    np.result_type: _result_type,
    np.max: _max_from,
    np.amax: _max_from,  # identical to np.max in new versions of NumPy, a separate function in old ones
    np.count_nonzero: _count_nonzero,
    np.argmin: partial(_place, _min),
    np.argmax: partial(_place, _max),
    np.vdot: _vdot,
    np.array_equal: _equal,
    np.where: _where,
    np.clip: _clip,
    np.reshape: _reshape,
    np.repeat: _repeat,
    np.copy: DistributedField.copy,
    np.zeros_like: _zeros_like,
    np.ones_like: _ones_like,
    np.full_like: _full_like,
}
OVER_ALL: dict[Any, Callable] = {
    np.sum: _sum,
    np.mean: _mean,
    np.min: _min,
    np.amin: _min,
    np.any: _any,
    np.all: _all,
    np.linalg.norm: _norm,
}
FUNCTIONS |= {function: partial(_over_all, function, act) for function, act in OVER_ALL.items()}
REDUCED: dict = {np.add: _sum, np.maximum: _max, np.minimum: _min}  # for calls such as ``np.add.reduce(u, axis=None)``


# ---- derivatives ----


def _spread(shape, space):
    """Return differentiable functions that distribute a number or whole array of a shape, and the transpose of this."""
    back = DistributedField.gather if shape else _sum
    return linear("block", lambda x: block(x, space), back)


def everywhere(x: Any, space: Space) -> Any:
    """Return a distributed field, given a number or an array that is the same on every rank. Differentiable."""
    if not isbox(x):
        return block(x, space)
    value = sample(x)
    if isinstance(value, DistributedField):
        return x
    if np.shape(value) not in ((), space.shape):
        x = x * np.ones(space.shape)  # broadcast by a product, whose VJP autograd provides
    return _spread(np.shape(value), space)[0](x)


def converted_like(derivative: Any, value: Any) -> Any:
    """Convert a cotangent or tangent to the kind of its value: a number, a whole array, or a distributed field."""
    plain_value = sample(value)
    if isinstance(plain_value, DistributedField):
        return everywhere(derivative, plain_value.space)
    plain_derivative = sample(derivative)
    if isinstance(plain_derivative, DistributedField):
        _, collect = _spread(np.shape(plain_value), plain_derivative.space)
        return collect(derivative)
    return derivative


def total(x: Any) -> Any:
    """Return the sum of all entries. Differentiable."""
    return converted_like(x, 0.0)


def formulas(fun: Callable, value: Any, args: Sequence[Any], nums: Sequence[int]) -> tuple | None:
    """Return the VJP and JVP of a call ``value = fun(*args)`` of a function of autograd.numpy; None if unknown.

    Numbers and whole arrays are first converted to distributed fields, by differentiable functions whose transposes add
    the cotangents over all ranks. Then autograd's own derivatives of elementwise functions can be used, to any order.
    """
    if fun not in AUTOGRAD_FUNCTIONS:
        return None
    space = next(sample(arg).space for arg in args if isinstance(sample(arg), DistributedField))
    if not isinstance(sample(value), DistributedField):
        if fun not in REDUCTIONS:
            raise TypeError(
                f"the derivative of {fun.__name__} of a field on ranks is not known; write sums of products"
            )
        return _formulas_of_reduction(REDUCTIONS[fun](args[0], value, space))
    fields = [everywhere(arg, space) if num in nums else arg for num, arg in enumerate(args)]
    autograd_vjp, autograd_jvp = autograd_rules(fun)

    def vjp(nums, args):
        pull_fields = autograd_vjp(nums, value, fields, {})

        def pull(g):
            derivatives = pull_fields(everywhere(g, space))
            return [converted_like(derivative, args[num]) for num, derivative in zip(nums, derivatives, strict=True)]

        return pull, ()

    def jvp(g, num, args, shape):
        return autograd_jvp((num,), [everywhere(g, space)], value, fields, {})

    return vjp, jvp


def _formulas_of_reduction(slope):
    """Return the VJP and JVP of a scalar function of one field, whose gradient is `slope`."""

    def vjp(nums, args):
        def pull(g):
            return (slope * g,)

        return pull, ()

    def jvp(g, num, args, shape):
        return total(slope * g)

    return vjp, jvp


# Functions slope(x, value, space) that return the gradients of reductions.


def _slope_of_sum(x, value, space):
    return block(1.0, space)


def _slope_of_mean(x, value, space):
    return block(1.0 / space.size, space)


def _slope_of_extreme(x, value, space):
    """Return the gradient of max or min, shared equally by all entries that attain the extreme value."""
    is_extreme = block(plain(x) == plain(value), space).astype(float)
    return is_extreme / _sum(is_extreme)


def _slope_of_norm(x, value, space):
    return x / value


REDUCTIONS = {
    anp.sum: _slope_of_sum,
    anp.mean: _slope_of_mean,
    getattr(anp.numpy_wrapper, "_primitive_mean", anp.mean): _slope_of_mean,
    anp.max: _slope_of_extreme,
    anp.amax: _slope_of_extreme,
    anp.min: _slope_of_extreme,
    anp.amin: _slope_of_extreme,
    anp.linalg.norm: _slope_of_norm,
}
AUTOGRAD_FUNCTIONS = {*REDUCTIONS, *filter(callable, vars(anp).values())}


class DistributedVSpace(VSpace):
    """autograd's vector space of distributed fields, by which it adds cotangents."""

    def __init__(self, value: DistributedField) -> None:
        self.shape = value.shape
        self.dtype = value.dtype
        self.value = value

    def zeros(self) -> DistributedField:
        """Return a field of zeros."""
        return _zeros_like(self.value)

    def _mut_add(self, x, y):
        return x + y


# ---- calls that all ranks make together ----


def together(what: str, arguments: Any, act: Callable, *args: Any) -> Any:
    """Return act(*args), called by all ranks together.

    If one rank raises an exception, all ranks raise it. ValueError is raised unless arguments and result are equal on
    all ranks. If the call uses no distributed field, the ranks do not communicate.
    """
    is_outermost = state.messages_before_call is None
    entry = (what, arguments)
    if is_outermost:
        state.messages_before_call = state.messages
    state.unrecorded.append(entry)
    try:
        try:
            result = act(*args)
        except Exception as error:
            agreement = _agreement(arguments)
            if agreement is not None:
                agreement.fail(error)
            raise
        agreement = _agreement(arguments)
        if agreement is not None:
            agreement.record_leaves("the result", what, result)
            agreement.synchronize(what)
        return result
    finally:
        state.unrecorded[:] = [other for other in state.unrecorded if other is not entry]
        if is_outermost:
            state.messages_before_call = None


def _agreement(arguments: Any) -> Agreement | None:
    """Return the Agreement of the distributed fields among the arguments, else the one used last in this call."""
    for leaf in leaves(arguments):
        backend: Any = getattr(sample(leaf), "backend", NUMPY)
        if not backend.whole_fields:
            return backend.agreement
    if state.messages_before_call is not None and state.messages > state.messages_before_call:
        return state.last
    return None


BOX.register(DistributedField)
VSpace.register(DistributedField, DistributedVSpace)


class DistributedKind(ArrayKind):
    """See `ArrayKind`."""

    def formulas(self, fun: Callable, value: Any, args: tuple, nums: tuple) -> tuple | None:
        """See `formulas`."""
        return formulas(fun, value, args, nums)

    def match(self, derivative: Any, value: Any) -> Any:
        """See `converted_like`."""
        return converted_like(derivative, value)

    def collectively(self, what: str, arguments: Any, act: Callable, *args: Any) -> Any:
        """See `together`."""
        return together(what, arguments, act, *args)

    def process_count(self) -> int:
        """Return the number of ranks of the last communicator."""
        if state.last is None:
            return 1
        return state.last.comm.size


ARRAY_KINDS[DistributedField] = DistributedKind()
