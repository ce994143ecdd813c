"""Operations on rows for the structured multigrid, as LLVM vectors.

A row is the address of its first cell, PAD numbers into an array (..., rows, width). It is padded to
whole vectors, so there is no remainder to care for: rows are short in 3-D. What is written beyond the
last cell is never read as one: the coefficients are 0 there, or `ends` overwrites it, or sums leave it out.
The number behind the last cell may be the first of the padding of the next row.

`like` is a number of the type in which the cycle computes (T); conjugate gradients are in float64 (d).
"""

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from sparsedp.kernels.pointers import address, get, pointer, prefetch, put

__all__ = [
    "LANES",
    "PAD",
    "advance",
    "blend",
    "clear",
    "combine",
    "copy",
    "descend",
    "ends",
    "entry",
    "inner",
    "merge",
    "mix",
    "narrow",
    "plus",
    "rest",
    "rows",
    "split",
    "sum_up",
    "vectors",
    "weigh",
    "weigh_onto",
]

LANES = 8
PAD = LANES  # the first cell of a row
FETCHED = 1152  # bytes ahead, where weights are fetched before they are needed

_INT, _DOUBLE = ir.IntType(64), ir.DoubleType()


class _Row:
    """Emits loads and stores of vectors of one of the two types."""

    def __init__(self, context, builder, like):
        self.builder = builder
        self.kinds = {"d": _DOUBLE, "T": context.get_value_type(like)}
        self.index = None

    def place(self, address, kind, index):
        vector = ir.VectorType(self.kinds[kind], LANES)
        base = self.builder.inttoptr(address, vector.as_pointer())
        return self.builder.gep(base, [self.index if index is None else index])

    def load(self, address, kind, wanted, index=None):
        item, target = self.kinds[kind], self.kinds[wanted]
        value = self.builder.load(self.place(address, kind, index), align=4 if item != _DOUBLE else 8)
        return value if item == target else self.cast(value, target)

    def cast(self, value, target):
        widen = target == _DOUBLE
        return (self.builder.fpext if widen else self.builder.fptrunc)(value, ir.VectorType(target, LANES))

    def store(self, value, address, kind, index=None):
        item = self.kinds[kind]
        value = value if value.type.element == item else self.cast(value, item)
        self.builder.store(value, self.place(address, kind, index), align=4 if item != _DOUBLE else 8)

    def pair(self):
        """Indices of two vectors in natural order for one of the even and one of the odd columns."""
        first = self.builder.shl(self.index, _INT(1))
        return first, self.builder.add(first, _INT(1))

    def shuffle(self, a, b, order):
        return self.builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), order))

    def rounded(self, value):
        """Wide numbers as they are after being kept as T."""
        narrow = self.kinds["T"]
        return value if narrow == _DOUBLE else self.cast(self.cast(value, narrow), _DOUBLE)

    def splat(self, value, kind):
        item = self.kinds[kind]
        value = value if value.type == item else self.builder.fptrunc(value, item)
        vector = ir.VectorType(item, LANES)
        one = self.builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.IntType(32)(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)

    def times(self, a, b, c=None):
        """a b + c, rounded once or twice as the machine likes it."""
        if c is None:
            return self.builder.fmul(a, b)
        name = "llvm.fmuladd.v{}{}".format(LANES, "f64" if a.type.element == _DOUBLE else "f32")
        function = cgutils.get_or_insert_function(self.builder.module, ir.FunctionType(a.type, [a.type] * 3), name)
        return self.builder.call(function, [a, b, c])


def _operation(body):
    """A loop over the vectors of rows. body(row, addresses, factors) emits one step."""

    def operation(typingctx, like, count, places, factors):
        def generate(context, builder, signature, args):
            row = _Row(context, builder, signature.args[0])
            addresses = cgutils.unpack_tuple(builder, args[2])
            numbers = cgutils.unpack_tuple(builder, args[3])
            with cgutils.for_range(builder, args[1]) as loop:
                row.index = loop.index
                body(row, addresses, numbers)
            return context.get_dummy_value()

        return types.void(like, count, places, factors), generate

    operation.__name__ = operation.__qualname__ = body.__name__
    operation.__doc__ = body.__doc__
    return intrinsic(operation)


def _products(row, total, addresses):
    for weight, value in zip(addresses[::2], addresses[1::2]):
        total = row.times(row.load(weight, "T", "T"), row.load(value, "T", "T"), total)
    return total


@_operation
def weigh(row, places, factors):
    """(out, weight, row, weight, row, ...): out = sum of weight * row. Two factors: weights are fetched ahead."""
    for weight in places[1::2] if len(factors) > 1 else ():
        place = row.builder.bitcast(row.place(weight, "T", None), ir.IntType(8).as_pointer())
        prefetch(row.builder, place, _INT(FETCHED), (0, 3, 1))
    row.store(_products(row, None, places[1:]), places[0], "T")


@_operation
def weigh_onto(row, places, factors):
    """(out, base, weight, row, weight, row, ...): out = base + sum of weight * row."""
    row.store(_products(row, row.load(places[1], "T", "T"), places[2:]), places[0], "T")


@_operation
def narrow(row, places, factors):
    """(out, a), (factor,): out = factor a, from d to T."""
    row.store(row.builder.fmul(row.splat(factors[0], "d"), row.load(places[1], "d", "d")), places[0], "T")


@_operation
def blend(row, places, factors):
    """(out, a, b), (factor,): out = a + factor b rounded to T; out is d, a and b are T."""
    out = row.times(row.splat(factors[0], "d"), row.load(places[2], "T", "d"), row.load(places[1], "T", "d"))
    row.store(row.rounded(out), places[0], "d")


@_operation
def combine(row, places, factors):
    """(out, a, b), (factor,): out = a + factor b, in d."""
    out = row.times(row.splat(factors[0], "d"), row.load(places[2], "d", "d"), row.load(places[1], "d", "d"))
    row.store(out, places[0], "d")


@_operation
def rest(row, places, factors):
    """(q, p, new, total): q = p - q, new = p, total += p q, in d; new is T."""
    p = row.load(places[1], "d", "d")
    q = row.builder.fsub(p, row.load(places[0], "d", "d"))
    row.store(q, places[0], "d")
    row.store(p, places[2], "T")
    row.store(row.times(p, q, row.load(places[3], "d", "d")), places[3], "d")


@_operation
def descend(row, places, factors):
    """(r, q, gauge, total), (factor,): r -= factor q, total += (gauge r)^2, in d; gauge is T."""
    change = row.builder.fmul(row.splat(factors[0], "d"), row.load(places[1], "d", "d"))
    r = row.builder.fsub(row.load(places[0], "d", "d"), change)
    row.store(r, places[0], "d")
    r = row.builder.fmul(r, row.load(places[2], "T", "d"))
    row.store(row.times(r, r, row.load(places[3], "d", "d")), places[3], "d")


@_operation
def advance(row, places, factors):
    """(out, x, a, b), two factors: out = x + factor a + factor b, in d; a and b are T."""
    x = row.load(places[1], "d", "d")
    for place, factor in zip(places[2:], factors):
        x = row.times(row.splat(factor, "d"), row.load(place, "T", "d"), x)
    row.store(x, places[0], "d")


@_operation
def sum_up(row, places, factors):
    """(z, r, p, total), (own, factor): z = own p + factor (z + r) in T, total += z r in d; r is d."""
    r, z = row.load(places[1], "d", "d"), row.load(places[0], "T", "T")
    z = row.builder.fadd(z, row.cast(r, row.kinds["T"]) if row.kinds["T"] != _DOUBLE else r)
    kept = row.builder.fmul(row.splat(factors[0], "T"), row.load(places[2], "T", "T"))
    z = row.times(row.splat(factors[1], "T"), z, kept)
    row.store(z, places[0], "T")
    wide = row.cast(z, _DOUBLE) if row.kinds["T"] != _DOUBLE else z
    row.store(row.times(wide, r, row.load(places[3], "d", "d")), places[3], "d")


@_operation
def mix(row, places, factors):
    """(out, a), (own, factor): out = own out + factor a, in T."""
    kept = row.builder.fmul(row.splat(factors[0], "T"), row.load(places[0], "T", "T"))
    row.store(row.times(row.splat(factors[1], "T"), row.load(places[1], "T", "T"), kept), places[0], "T")


@_operation
def plus(row, places, factors):
    """(out, a, b), (factor,): out = a + factor b, in T."""
    out = row.times(row.splat(factors[0], "T"), row.load(places[2], "T", "T"), row.load(places[1], "T", "T"))
    row.store(out, places[0], "T")


@_operation
def copy(row, places, factors):
    """(out, a): out = a, in T."""
    row.store(row.load(places[1], "T", "T"), places[0], "T")


@_operation
def clear(row, places, factors):
    """(out,): out = 0, in T."""
    row.store(row.splat(ir.Constant(_DOUBLE, 0.0), "T"), places[0], "T")


@_operation
def split(row, places, factors):
    """(even, odd, line): the cells of a line in natural order by the parity of their column, in T."""
    first, second = row.pair()
    a, b = row.load(places[2], "T", "T", first), row.load(places[2], "T", "T", second)
    row.store(row.shuffle(a, b, list(range(0, 2 * LANES, 2))), places[0], "T")
    row.store(row.shuffle(a, b, list(range(1, 2 * LANES, 2))), places[1], "T")


@_operation
def merge(row, places, factors):
    """(line, even, odd): the reverse of `split`."""
    first, second = row.pair()
    a, b = row.load(places[1], "T", "T"), row.load(places[2], "T", "T")
    order = [k // 2 + k % 2 * LANES for k in range(2 * LANES)]
    row.store(row.shuffle(a, b, order[:LANES]), places[0], "T", first)
    row.store(row.shuffle(a, b, order[LANES:]), places[0], "T", second)


# ---------------------------------------------------------------- rows of arrays

# `entry` is called from Python; `inner` only from other compiled functions, so it needs no wrappers for that.
entry = njit(nogil=True, error_model="numpy", cache=True)
inner = njit(nogil=True, error_model="numpy", cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


@inner
def vectors(count):
    """How many vectors hold `count` cells."""
    return (count + LANES - 1) // LANES


@inner
def rows(array):
    """Array (..., width) -> address of its first row, and bytes from one row to the next."""
    return address(array) + PAD * array.itemsize, array.shape[array.ndim - 1] * array.itemsize


@inner
def ends(row, count, like, periodic):
    """Repeat the first and the last cell of a row beyond its ends."""
    if periodic:
        cells = pointer(row, like)
        put(cells, -1, get(cells, count - 1))
        put(cells, count, get(cells, 0))
