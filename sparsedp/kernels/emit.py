"""Formulas on streams of numbers, emitted as LLVM vectors: what `streams` compiles.

A formula is a Python function of numbers that know + - * and the three functions of `Lane`; it gets
NumPy arrays in `streams_plain` and vectors here, so that both do the same operations in the same order.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sparsedp.kernels.limited import FORMULAS

__all__ = ["run"]

LANES = 8
PLACE = 44  # bits of the place of a stream in its array; above them the number of the array

_INT, _DOUBLE = ir.IntType(64), ir.DoubleType()


class Lane:
    """A vector of float64, or one number in the rest of a segment."""

    def __init__(self, builder, value):
        self.builder, self.value = builder, value

    def _with(self, other, operation):
        if not isinstance(other, Lane):
            other = Lane(self.builder, ir.Constant(self.value.type, _filled(self.value.type, other)))
        return Lane(self.builder, getattr(self.builder, operation)(self.value, other.value))

    def __add__(self, other):
        return self._with(other, "fadd")

    def __sub__(self, other):
        return self._with(other, "fsub")

    def __mul__(self, other):
        return self._with(other, "fmul")

    def __truediv__(self, other):
        return self._with(other, "fdiv")

    def constant(self, number):
        return ir.Constant(self.value.type, _filled(self.value.type, number))

    def chosen(self, word, other, yes, no):
        other = other.value if isinstance(other, Lane) else self.constant(other)
        test = self.builder.fcmp_ordered(word, self.value, other)
        return Lane(self.builder, self.builder.select(test, self.constant(yes), self.constant(no)))

    def step(self):
        """1, 1/2, 0 where the number is > 0, = 0, < 0."""
        return self.chosen(">", 0.0, 0.5, 0.0) + self.chosen(">=", 0.0, 0.5, 0.0)

    def alike(self, other):
        """1 where both numbers are > 0 or both < 0, else 0."""
        zero, one, both = self.constant(0.0), self.constant(1.0), []
        for word in "><":
            tests = [self.builder.fcmp_ordered(word, lane.value, zero) for lane in (self, other)]
            both.append(self.builder.and_(*tests))
        return Lane(self.builder, self.builder.select(self.builder.or_(*both), one, zero))

    def zero(self):
        """1 where the number is 0, else 0."""
        return self.chosen("==", 0.0, 1.0, 0.0)

    def short_of(self, limit):
        """1 where the number is below the limit or NaN, else 0."""
        return self.chosen(">=", limit, 0.0, 1.0)

    def infinite(self):
        """1 where the number is NaN or infinite, else 0: x - x is 0 for all others."""
        return (self - self).chosen("==", 0.0, 0.0, 1.0)


def _filled(kind, number):
    return [float(number)] * LANES if isinstance(kind, ir.VectorType) else float(number)


class _Segment:
    """Emits the body of one segment."""

    def __init__(self, builder, formula, row, bases):
        self.builder, self.formula = builder, formula
        pointer = _DOUBLE.as_pointer()
        self.pointers = []
        for place in range(len(formula.streams)):
            code = builder.load(builder.gep(row, [_INT(place + 1)]))
            base = builder.load(builder.gep(bases, [builder.lshr(code, _INT(PLACE))]))
            offset = builder.shl(builder.and_(code, _INT((1 << PLACE) - 1)), _INT(3))
            self.pointers.append(builder.inttoptr(builder.add(base, offset), pointer))

    def emit(self, index, lanes, sums):
        """The formula on one vector or number; `sums` are places that get its sums added."""
        builder = self.builder
        kind = ir.VectorType(_DOUBLE, LANES) if lanes else _DOUBLE

        def place(pointer):
            where = builder.gep(pointer, [index])
            return builder.bitcast(where, kind.as_pointer()) if lanes else where

        def read(stream, pointer):
            if stream.fixed:
                return Lane(builder, self.splat(builder.load(pointer), kind) if lanes else builder.load(pointer))
            return Lane(builder, builder.load(place(pointer), align=8))

        pairs = list(zip(self.formula.streams, self.pointers, strict=True))
        given = {stream.name: read(stream, pointer) for stream, pointer in pairs if stream.read}
        stored, totals = self.formula.body(given)
        for stream, pointer in pairs:
            if stream.write:
                builder.store(stored[stream.name].value, place(pointer), align=8)
        for where, total in zip(sums, totals, strict=True):
            builder.store(builder.fadd(builder.load(where), total.value), where)

    def splat(self, scalar, kind):
        undefined = ir.Constant(kind, ir.Undefined)
        one = self.builder.insert_element(undefined, scalar, ir.IntType(32)(0))
        return self.builder.shuffle_vector(
            one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        )


def _totals(builder, kind, count):
    """Places on the stack that start at 0."""
    found = [cgutils.alloca_once(builder, kind) for _ in range(count)]
    for place in found:
        builder.store(ir.Constant(kind, _filled(kind, 0.0)), place)
    return found


def _emit(builder, formula, table, first, last, bases, sums):
    width = len(formula.streams) + 1
    with cgutils.for_range_slice(builder, first, last, _INT(1)) as (number, _):
        row = builder.gep(table, [builder.mul(number, _INT(width))])
        count = builder.load(row)
        segment = _Segment(builder, formula, row, bases)
        blocks = builder.udiv(count, _INT(LANES))
        rest = builder.mul(blocks, _INT(LANES))
        wide = _totals(builder, ir.VectorType(_DOUBLE, LANES), formula.sums)
        single = _totals(builder, _DOUBLE, formula.sums)
        with cgutils.for_range(builder, blocks) as loop:
            segment.emit(builder.mul(loop.index, _INT(LANES)), True, wide)
        with cgutils.for_range_slice(builder, rest, count, _INT(1)) as (index, _):
            segment.emit(index, False, single)
        for k in range(formula.sums):
            total, vector = builder.load(single[k]), builder.load(wide[k])
            for lane in range(LANES):
                total = builder.fadd(total, builder.extract_element(vector, ir.IntType(32)(lane)))
            place = builder.add(builder.mul(number, _INT(formula.sums)), _INT(k))
            builder.store(total, builder.gep(sums, [place]))


@intrinsic(prefer_literal=True)
def run(typingctx, number, table, first, last, bases, sums):
    """Formula number `number` on the segments first <= s < last of a table; all but first and last are addresses.

    A row of the table holds the count of a segment and where each of its streams starts. The sums of segment s
    go to row s of `sums`.
    """
    if not isinstance(number, types.IntegerLiteral):
        return None
    formula = FORMULAS[number.literal_value]

    def generate(context, builder, signature, args):
        whole, real = _INT.as_pointer(), _DOUBLE.as_pointer()
        table, bases = (builder.inttoptr(args[k], whole) for k in (1, 4))
        _emit(builder, formula, table, args[2], args[3], bases, builder.inttoptr(args[5], real))
        return context.get_dummy_value()

    return types.void(number, *[types.int64] * 5), generate
