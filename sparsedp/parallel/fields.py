"""A field of which this rank holds a block: it behaves like one array of the whole shape.

Elementwise arithmetic acts on the block; sums, means, maxima and norms are those of the whole field, with the same bits
on every rank. What cannot be done on blocks (u[i, j], sorting, sums along an axis) is refused by name: nothing is
silently local, no program branches differently on two ranks, and every rank records the same tape. A plain array of the
whole shape is a field that every rank knows: beside a field on ranks, each takes its own block.
"""

from __future__ import annotations

from functools import partial, partialmethod
from operator import attrgetter
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.backend import ARRAY_KINDS, BOX, NUMPY, ArrayKind
from sparsedp.autodiff.tape import VSpace, autograd_rules, isbox, linear, plain
from sparsedp.errors import ShapeError
from sparsedp.parallel.agreement import course

__all__ = ["DistributedField", "alike", "block", "everywhere", "total"]


class DistributedField(np.lib.mixins.NDArrayOperatorsMixin):
    """The flat block of this rank, read-only, and the space of the whole field."""

    __slots__ = ("__weakref__", "flat", "space")

    def __init__(self, flat: np.ndarray, space: Any) -> None:
        flat.flags.writeable = False
        self.flat, self.space = flat, space

    layout = backend = property(lambda self: self.space.grid.backend)
    shape = property(lambda self: self.space.shape)
    ndim = property(lambda self: len(self.space.shape))
    size = property(lambda self: self.space.size)
    dtype = property(lambda self: self.flat.dtype)
    nbytes = property(lambda self: self.space.size * self.flat.dtype.itemsize)  # the same on every rank
    real = property(lambda self: self.like(self.flat.real))
    imag = property(lambda self: self.like(self.flat.imag))

    def like(self, flat: np.ndarray) -> Any:
        """Another field on the same space."""
        return DistributedField(np.ascontiguousarray(flat), self.space)

    def copy(self) -> Any:
        """Return the field itself: it is read-only."""
        return self

    def astype(self, dtype: Any, copy: Any = True) -> Any:
        """Return the same field in another dtype."""
        return self.like(self.flat.astype(dtype))

    def gather(self) -> Any:
        """Return the whole field on every rank, a plain array."""
        return self.layout.gather(self.flat, self.space.parts).reshape(self.shape)

    def fingerprint(self) -> Any:
        """Return a whole number for its bits, the same on every rank."""
        return int(self.layout.sum(np.int64(hash(self.flat.tobytes()) >> 16)))

    def refuse(self, what: str, *args: Any, **options: Any) -> None:
        """Return the answer to all that needs more than the block."""
        name = getattr(what, "__name__", what)
        raise TypeError(f"{name} does not work on a field that lies on ranks; write dp.gather(u) for the whole array")

    def __repr__(self):
        return f"<field on {self.space}, on rank {self.layout.comm.rank} of {self.layout.comm.size}>"

    def block_of(self, value: Any) -> Any:
        """Return the flat block of another operand; numbers are returned unchanged."""
        if np.ndim(value):
            return block(value, self.space).flat
        self.layout.tell(value)
        return value

    def __array_ufunc__(self, ufunc, method, *inputs, **options):
        if any(map(isbox, inputs)):
            return NotImplemented  # autograd's turn
        if method == "reduce" and options == {"axis": None} and ufunc in REDUCED:
            return REDUCED[ufunc](self)
        if method != "__call__" or ufunc.nout != 1 or ufunc.signature or not options.keys() <= {"dtype", "casting"}:
            self.refuse(f"{ufunc.__name__} with {method if method != '__call__' else 'out= or where='}")
        act = pow if ufunc is np.power and not options else ufunc  # the operator of arrays is quick for whole powers
        return self.like(act(*map(self.block_of, inputs), **options))

    def __array_function__(self, function, types, args, options):
        if any(map(isbox, args)):
            return NotImplemented
        return FUNCTIONS.get(function, partial(self.refuse, function))(*args, **options)


for name, what in {
    "__getitem__": "u[...]",
    "__setitem__": "u[...] = value",
    "__array__": "conversion to an array",
    "__reduce__": "pickling",
    "__bool__": "a truth value",
    "__iter__": "iteration",
    "__len__": "iteration",
    **dict.fromkeys(["__float__", "__complex__", "__int__", "__index__"], "conversion to a number"),
}.items():
    setattr(DistributedField, name, partialmethod(DistributedField.refuse, what))


def block(value: Any, space: Any) -> Any:
    """Return a field on ranks, from such a field, a number, or an array that every rank holds and that broadcasts."""
    if isinstance(value, DistributedField):
        if value.space.parts != space.parts or value.layout != space.grid.backend:
            raise ShapeError(f"a field on {space.described} is needed, got one on {value.space.described}")
        return value
    value, layout = np.asarray(value), space.grid.backend
    layout.tell(value)
    if np.ndim(value) == 0:
        return DistributedField(np.full(layout.size(space.parts), value), space)
    try:
        whole = np.broadcast_to(value, space.shape)
    except ValueError:
        raise ShapeError(
            f"a field on {space.described} is needed, got an array of shape {value.shape}; give the whole array"
        ) from None
    return DistributedField(layout.take(whole.reshape(-1), space.parts), space)


# ---- what NumPy's functions do with them ----


def _first(*values):
    return next(value for value in values if isinstance(value, DistributedField))


def _over_all(function, act, x, axis=None, *others, **options):
    """Return a function of a whole field; what asks for more, such as an axis, is refused."""
    if axis is not None and options == {"keepdims": True} and x.shape[axis] == 1:
        return x  # along an axis of one entry
    if any(value is not None and value is not False for value in (axis, *others, *options.values())):
        x.refuse(f"{function.__name__} with a choice such as an axis")
    return act(x)


def _sum(x):
    """Sum of all entries."""
    return x.layout.sum(x.flat.sum())


def _extreme(act, end, x):
    """Return the least or the largest entry; NaN when one is NaN."""
    return x.layout.agreement.reduced(act.reduce(x.flat, initial=_ends(x)[end]), act)


_max, _min = partial(_extreme, np.maximum, 0), partial(_extreme, np.minimum, 1)


def _max_from(x, *axis, initial=None, **options):
    top = _over_all(np.max, _max, x, *axis, **options)
    return top if initial is None else np.maximum(top, initial)


def _ends(x):
    """Return the least and the largest number of the dtype of a field."""
    if x.dtype.kind == "i":
        return np.iinfo(x.dtype).min, np.iinfo(x.dtype).max
    return {"f": (-np.inf, np.inf), "b": (False, True)}.get(x.dtype.kind) or x.refuse("an order of complex numbers")


def _vdot(x, y):
    first = _first(x, y)
    here = np.vdot(*(block(value, first.space).flat for value in (x, y)))
    return here.dtype.type(first.layout.sum(here))


def _norm(x):
    """Root of the sum of the squares."""
    x = 1.0 * x  # of whole numbers, too
    return np.sqrt(_vdot(x, x).real)


def _by_entry(act, *values):
    first = _first(*values)
    return first.like(act(*map(first.block_of, values)))


def _equal(x, y, **options):
    if options:
        _first(x, y).refuse("array_equal with a choice")
    return np.shape(x) == np.shape(y) and bool(np.all(x == y))


def _place(extreme, x):
    """Flat number in the whole field of the first entry that is the least or the largest, or NaN."""
    here = (x.flat == extreme(x)) | np.isnan(x.flat)
    at = x.layout.take(np.arange(x.size), x.space.parts)[here]
    return int(x.layout.min(np.min(at, initial=x.size)))


def _shaped(x, shape, **options):
    return x if np.broadcast_to(0, x.shape).reshape(shape).shape == x.shape else x.refuse("reshape")


def _filled(number):
    return lambda x, dtype=None: x.like(np.full(x.flat.shape, number, dtype or x.dtype))


def _repeat(x, repeats, axis=None):
    return x if repeats == 1 and axis is not None else x.refuse("repeat")


def _result_type(*values):
    return np.result_type(*(value.dtype if isinstance(value, DistributedField) else value for value in values))


FUNCTIONS = {
    **{getattr(np, name): attrgetter(name) for name in ("shape", "ndim", "size", "real", "imag")},
    np.iscomplexobj: lambda x: x.dtype.kind == "c",
    np.isrealobj: lambda x: x.dtype.kind != "c",
    np.result_type: _result_type,
    np.max: _max_from,
    np.amax: _max_from,  # in new versions of NumPy the same, in old ones a function of its own
    np.count_nonzero: lambda x: int(x.layout.sum(np.count_nonzero(x.flat))),
    np.argmin: partial(_place, _min),
    np.argmax: partial(_place, _max),
    np.vdot: _vdot,
    np.array_equal: _equal,
    np.where: lambda condition, x, y: _by_entry(np.where, condition, x, y),
    np.clip: lambda x, low=None, high=None: _by_entry(np.clip, x, low, high),
    np.reshape: _shaped,
    np.repeat: _repeat,
    np.copy: DistributedField.copy,
    np.zeros_like: _filled(0),
    np.ones_like: _filled(1),
    np.full_like: lambda x, number: x.like(np.full(x.flat.shape, number, x.dtype)),
}
OVER_ALL = {
    np.sum: _sum,
    np.mean: lambda x: (_sum(x)[None] / x.size)[0],  # beside an array a number has no dtype
    np.min: _min,
    np.amin: _min,
    np.any: lambda x: bool(_max(x.astype(bool))),
    np.all: lambda x: bool(_min(x.astype(bool))),
    np.linalg.norm: _norm,
}
FUNCTIONS.update((function, partial(_over_all, function, act)) for function, act in OVER_ALL.items())
REDUCED: dict = {np.add: _sum, np.maximum: _max, np.minimum: _min}  # as ``np.add.reduce(u, axis=None)``


# ---- derivatives ----


def _spread(shape, space):
    """Return the rules from numbers or whole arrays of a shape to fields on ranks, and their transposes."""
    back = DistributedField.gather if shape else _sum
    return linear("block", lambda x: block(x, space), back)


def everywhere(x: Any, space: Any) -> Any:
    """Return a field on ranks, from a number or an array that every rank holds, traced or not."""
    if not isbox(x):
        return block(x, space)
    value = plain(x)
    if isinstance(value, DistributedField):
        return x
    if np.shape(value) not in ((), space.shape):
        x = x * np.ones(space.shape)  # autograd adds up what is spread
    return _spread(np.shape(value), space)[0](x)


def alike(back: Any, value: Any) -> Any:
    """Return a cotangent or tangent in the form of what it belongs to: a number, a whole array, or a field on ranks."""
    field, wanted = plain(back), plain(value)
    if isinstance(wanted, DistributedField):
        return everywhere(back, wanted.space)
    return _spread(np.shape(wanted), field.space)[1](back) if isinstance(field, DistributedField) else back


def total(x: Any) -> Any:
    """Sum of all entries, on the tape too."""
    return alike(x, 0.0)


def formulas(fun: Any, value: Any, args: Any, nums: Any) -> Any:
    """Return the VJP and JVP of a call ``value = fun(*args)`` of autograd.numpy, as in FORMULAS; None if unknown.

    Numbers and whole arrays are made fields first; then every function entry by entry has the derivatives that
    autograd knows, to every order, and what spreads them adds up what comes back.
    """
    if fun not in KNOWN:
        return None
    space = next(plain(arg).space for arg in args if isinstance(plain(arg), DistributedField))
    if not isinstance(plain(value), DistributedField):
        if fun not in REDUCTIONS:
            raise TypeError(
                f"the derivative of {fun.__name__} of a field on ranks is not known; write sums of products"
            )
        slope = REDUCTIONS[fun](args[0], value, space)
        return lambda nums, args: (lambda g: (slope * g,), ()), lambda g, num, args, shape: total(slope * g)
    spread = [everywhere(arg, space) if num in nums else arg for num, arg in enumerate(args)]
    vjp, jvp = autograd_rules(fun)

    def back(nums, args):
        pull = vjp(nums, value, spread, {})
        return lambda g: [alike(one, args[num]) for num, one in zip(nums, pull(everywhere(g, space)))], ()

    return back, lambda g, num, args, shape: jvp((num,), [everywhere(g, space)], value, spread, {})


def _ties(x, value, space):
    least = block(plain(x) == plain(value), space).astype(float)
    return least / _sum(least)


REDUCTIONS = {
    anp.sum: lambda x, value, space: block(1.0, space),
    anp.max: _ties,
    anp.min: _ties,
    anp.linalg.norm: lambda x, value, space: x / value,
    **dict.fromkeys(
        [anp.mean, getattr(anp.numpy_wrapper, "_primitive_mean", anp.mean)],
        lambda x, value, space: block(1.0 / space.size, space),
    ),
}
REDUCTIONS.update({anp.amax: _ties, anp.amin: _ties})
KNOWN = {*REDUCTIONS, *filter(callable, vars(anp).values())}


class Sums(VSpace):
    """What autograd asks of a kind of values: to add them up."""

    def __init__(self, value: Any) -> None:
        self.shape, self.dtype, self.value = value.shape, value.dtype, value

    def zeros(self) -> Any:
        """Return a field of zeros."""
        return np.zeros_like(self.value)

    def _mut_add(self, x, y):
        return x + y


# ---- calls that all ranks make alike ----


def together(what: str, given: Any, act: Any, *args: Any) -> Any:
    """Return act(*args): an error of one rank is raised on all; `given` and the result must be equal on all ranks.

    Where no field on ranks was met, nothing is asked.
    """
    outermost, untold = course.begun is None, (what, given)
    if outermost:
        course.begun = course.met
    course.untold.append(untold)
    try:
        try:
            result = act(*args)
        except Exception as error:
            if agreement := _agreement(given):
                agreement.fail(error)
            raise
        if agreement := _agreement(given):
            agreement.tell_all("the result", what, result)
            agreement.meet(what)
        return result
    finally:
        course.untold[:] = [other for other in course.untold if other is not untold]
        if outermost:
            course.begun = None


def _agreement(given):
    """Return the agreement of the fields among some values, or of the last message of this call; else None."""
    for leaf in leaves(given):
        backend: Any = getattr(plain(leaf), "backend", NUMPY)
        if not backend.whole_fields:
            return backend.agreement
    return course.last if course.met > course.begun else None


BOX.register(DistributedField)
VSpace.register(DistributedField, Sums)


class DistributedKind(ArrayKind):
    """What the tape and public calls ask of fields on ranks."""

    def formulas(self, fun: Any, value: Any, args: Any, nums: Any) -> Any:
        """See `formulas`."""
        return formulas(fun, value, args, nums)

    def match(self, derivative: Any, value: Any) -> Any:
        """See `alike`."""
        return alike(derivative, value)

    def collectively(self, what: str, arguments: Any, act: Any, *args: Any) -> Any:
        """See `together`."""
        return together(what, arguments, act, *args)

    def process_count(self) -> Any:
        """Return the number of ranks of the last communicator."""
        return course.last.comm.size if course.last else 1


ARRAY_KINDS[DistributedField] = DistributedKind()
