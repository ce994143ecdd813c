"""A field of which this rank holds a block: it behaves like one array of the whole shape.

Elementwise arithmetic acts on the block; sums, means, maxima and norms are those of the whole field, with the same bits
on every rank. What cannot be done on blocks (u[i, j], sorting, sums along an axis) is refused by name: nothing is
silently local, no program branches differently on two ranks, and every rank records the same tape. A plain array of the
whole shape is a field that every rank knows: beside a field on ranks, each takes its own block.
"""

from functools import partial

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.parallel.partition import slices
from sparsedp.shortcuts import BOX, ELSEWHERE
from sparsedp.tape import VSpace, autograd_rules, isbox, linear, plain

__all__ = ["DistributedField", "alike", "block", "everywhere", "total"]


class DistributedField(np.lib.mixins.NDArrayOperatorsMixin):
    """The flat block of this rank, read-only, and the space of the whole field."""

    __slots__ = ("__weakref__", "flat", "space")

    def __init__(self, flat, space):
        flat.flags.writeable = False
        self.flat, self.space = flat, space

    layout = property(lambda self: self.space.grid.layout)
    shape = property(lambda self: self.space.shape)
    ndim = property(lambda self: len(self.space.shape))
    size = property(lambda self: self.space.size)
    dtype = property(lambda self: self.flat.dtype)
    nbytes = property(lambda self: self.space.size * self.flat.dtype.itemsize)  # the same on every rank
    real = property(lambda self: self.like(self.flat.real))
    imag = property(lambda self: self.like(self.flat.imag))

    def like(self, flat):
        """Another field on the same space."""
        return DistributedField(np.ascontiguousarray(flat), self.space)

    def copy(self):
        """Itself: nobody can write into it."""
        return self

    def astype(self, dtype):
        """The same field in another dtype."""
        return self.like(self.flat.astype(dtype))

    def gather(self):
        """The whole field on every rank, a plain array."""
        return self.layout.gather(self.flat, self.space.parts).reshape(self.shape)

    def fingerprint(self):
        """A whole number for its bits, the same on every rank."""
        return int(self.layout.sum(np.int64(hash(self.flat.tobytes()) >> 16)))

    def refuse(self, what, *args, **options):
        """The answer to all that needs more than the block."""
        name = getattr(what, "__name__", what)
        raise TypeError(f"{name} does not work on a field that lies on ranks; write dp.gather(u) for the whole array")

    def __getitem__(self, index):
        self.refuse("u[...]")

    def __setitem__(self, index, value):
        self.refuse("u[...] = value")

    def __array__(self, *args, **options):
        self.refuse("conversion to an array")

    def __reduce__(self):
        self.refuse("pickling")

    def __bool__(self):
        self.refuse("a truth value")

    def __float__(self):
        self.refuse("conversion to a number")

    def __iter__(self):
        self.refuse("iteration")

    __complex__ = __int__ = __index__ = __float__
    __len__ = __iter__

    def __repr__(self):
        return f"<field on {self.space}, on rank {self.layout.comm.rank} of {self.layout.comm.size}>"

    def block_of(self, value):
        """Another operand -> its flat block; numbers as they are."""
        return value if np.ndim(value) == 0 else block(value, self.space).flat

    def __array_ufunc__(self, ufunc, method, *inputs, **options):
        if any(map(isbox, inputs)):
            return NotImplemented  # autograd's turn
        if method == "reduce" and options == {"axis": None} and ufunc in OVER_ALL:
            return OVER_ALL[ufunc](self)
        if method != "__call__" or ufunc.nout != 1 or ufunc.signature or not options.keys() <= {"dtype", "casting"}:
            self.refuse(f"{ufunc.__name__} with {method if method != '__call__' else 'out= or where='}")
        act = pow if ufunc is np.power and not options else ufunc  # the operator of arrays is quick for whole powers
        return self.like(act(*map(self.block_of, inputs), **options))

    def __array_function__(self, function, types, args, options):
        if any(map(isbox, args)):
            return NotImplemented
        return FUNCTIONS.get(function, partial(self.refuse, function))(*args, **options)


def block(value, space):
    """A field in any form -> one on ranks: such a field, a number, or what every rank has whole (or broadcasts)."""
    if isinstance(value, DistributedField):
        if value.space.parts != space.parts or value.layout != space.grid.layout:
            raise ShapeError(f"a field on {space.described} is needed, got one on {value.space.described}")
        return value
    value, layout = np.asarray(value), space.grid.layout
    if np.ndim(value) == 0:
        return DistributedField(np.full(layout.size(space.parts), value), space)
    try:
        whole = np.broadcast_to(value, space.shape)
    except ValueError:
        raise ShapeError(
            f"a field on {space.described} is needed, got an array of shape {value.shape}; give the whole array"
        ) from None
    if len(space.parts) > 1:
        return DistributedField(layout.take(whole, space.parts), space)
    return DistributedField(whole[slices(layout.box(space.shape))].reshape(-1).copy(), space)


# ---- what NumPy's functions do with them ----


def _first(*values):
    return next(value for value in values if isinstance(value, DistributedField))


def _over_all(act):
    """A function of a field and no further choice -> the same, which refuses an axis."""

    def function(x, axis=None, dtype=None, out=None, keepdims=False, **options):
        if keepdims and axis is not None and not dtype and out is None and x.shape[axis] == 1:
            return x  # along an axis of one entry
        if axis is not None or keepdims or dtype is not None or out is not None or options:
            x.refuse(f"{act.__name__[1:]} with a choice such as an axis")
        return act(x)

    return function


def _sum(x):
    """Sum of all entries."""
    return x.layout.sum(x.flat.sum())


def _mean(x):
    """Mean of all entries."""
    return np.divide(_sum(x), x.size, dtype=np.result_type(x.dtype, float if x.dtype.kind in "biu" else x.dtype))


def _max(x):
    """The largest entry; NaN when one is NaN."""
    return x.layout.max(np.max(x.flat, initial=_ends(x)[0]))


def _min(x):
    """The least entry; NaN when one is NaN."""
    return x.layout.min(np.min(x.flat, initial=_ends(x)[1]))


def _ends(x):
    """The least and the largest number of the dtype of a field."""
    if x.dtype.kind == "i":
        return np.iinfo(x.dtype).min, np.iinfo(x.dtype).max
    return {"f": (-np.inf, np.inf), "b": (False, True)}.get(x.dtype.kind) or x.refuse("an order of complex numbers")


def _any(x):
    """Whether an entry is not 0."""
    return bool(x.layout.max(int(np.any(x.flat))))


def _all(x):
    """Whether no entry is 0."""
    return bool(x.layout.min(int(np.all(x.flat))))


def _vdot(x, y):
    first = _first(x, y)
    here = np.vdot(*(block(value, first.space).flat for value in (x, y)))
    return here.dtype.type(first.layout.sum(here))


def _norm(x, ord=None, axis=None, keepdims=False):
    if ord is not None or axis is not None or keepdims:
        x.refuse("norm with a choice such as an axis")
    x = x if x.dtype.kind in "fc" else x.astype(float)
    return np.sqrt(_vdot(x, x).real)


def _where(condition, x, y):
    first = _first(condition, x, y)
    return first.like(np.where(*map(first.block_of, (condition, x, y))))


def _clip(x, low=None, high=None):
    first = _first(x, low, high)
    return first.like(np.clip(*map(first.block_of, (x, low, high))))


def _equal(x, y, equal_nan=False):
    if np.shape(x) != np.shape(y):
        return False
    first = _first(x, y)
    return bool(first.layout.min(int(np.array_equal(first.block_of(x), first.block_of(y), equal_nan))))


def _argmin(x, sign=1):
    """Flat number in the whole field of the first least entry; NaN is less than all."""
    layout, flat = x.layout, x.flat if x.dtype.kind == "b" else sign * x.flat
    flat = flat.astype(float) * (sign if x.dtype.kind == "b" else 1)
    mine = layout.take(np.arange(x.size), x.space.parts)
    least = layout.min(np.min(flat, initial=np.inf))
    at = mine[np.isnan(flat) if np.isnan(least) else flat == least]
    return int(layout.min(np.min(at, initial=x.size)))


def _shaped(x, shape, **options):
    if (shape if np.ndim(shape) else (shape,)) not in (x.shape, list(x.shape), (-1,) if x.ndim == 1 else x.shape):
        x.refuse("reshape")
    return x


def _filled(number):
    return lambda x, dtype=None: x.like(np.full(x.flat.shape, number, dtype or x.dtype))


def _repeat(x, repeats, axis=None):
    return x if repeats == 1 and axis is not None else x.refuse("repeat")


def _result_type(*values):
    return np.result_type(*(value.dtype if isinstance(value, DistributedField) else value for value in values))


FUNCTIONS = {
    np.shape: lambda x: x.shape,
    np.ndim: lambda x: x.ndim,
    np.size: lambda x: x.size,
    np.iscomplexobj: lambda x: x.dtype.kind == "c",
    np.isrealobj: lambda x: x.dtype.kind != "c",
    np.result_type: _result_type,
    np.real: lambda x: x.real,
    np.imag: lambda x: x.imag,
    np.sum: _over_all(_sum),
    np.mean: _over_all(_mean),
    np.max: _over_all(_max),
    np.min: _over_all(_min),
    np.any: _over_all(_any),
    np.all: _over_all(_all),
    np.count_nonzero: lambda x: int(x.layout.sum(np.count_nonzero(x.flat))),
    np.argmin: _argmin,
    np.argmax: partial(_argmin, sign=-1),
    np.vdot: _vdot,
    np.linalg.norm: _norm,
    np.array_equal: _equal,
    np.where: _where,
    np.clip: _clip,
    np.reshape: _shaped,
    np.repeat: _repeat,
    np.copy: lambda x: x,
    np.zeros_like: _filled(0),
    np.ones_like: _filled(1),
    np.full_like: lambda x, number: x.like(np.full(x.flat.shape, number, x.dtype)),
}  # in new versions of NumPy amax is max, in old ones a function of its own
FUNCTIONS.update({np.amax: FUNCTIONS[np.max], np.amin: FUNCTIONS[np.min]})


OVER_ALL = {np.add: _sum, np.maximum: _max, np.minimum: _min}  # as ``np.add.reduce(u, axis=None)``


# ---- derivatives ----


def everywhere(x, space):
    """A number, or what every rank has whole -> a field on ranks; on the tape too."""
    if not isbox(x):
        return block(x, space)
    if isinstance(plain(x), DistributedField):
        return x
    shape = np.shape(plain(x))
    if shape not in ((), space.shape):
        x = x * np.ones(space.shape)  # autograd adds up what is spread
    back = DistributedField.gather if shape else _sum
    return linear("block", lambda x: block(x, space), back)[0](x)


def alike(back, value):
    """A cotangent or tangent in the form of what it belongs to: a number, a whole array, or a field on ranks."""
    here, wanted = isinstance(plain(back), DistributedField), plain(value)
    if isinstance(wanted, DistributedField):
        return everywhere(back, wanted.space)
    if not here:
        return back
    space = plain(back).space
    act = _sum if np.ndim(wanted) == 0 else DistributedField.gather
    return linear("whole", act, lambda g: block(g, space))[0](back)


def total(x):
    """Sum of all entries, on the tape too."""
    return alike(x, 0.0)


def formulas(fun, value, args, nums):
    """A call ``value = fun(*args)`` of autograd.numpy -> its two formulas, as those of shortcuts.FORMULAS; else None.

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
    vjp, jvp = (rules[fun] for rules in autograd_rules)

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

    def __init__(self, value):
        self.shape, self.dtype, self.value = value.shape, value.dtype, value

    def zeros(self):
        """A field of zeros."""
        return np.zeros_like(self.value)

    def _mut_add(self, x, y):
        return x + y


BOX.register(DistributedField)
VSpace.register(DistributedField, Sums)
ELSEWHERE[DistributedField] = formulas, alike
