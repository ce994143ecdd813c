"""Vector blocks for the compiled kernels: weighted sums of streams, one cache line at a time.

The loops are written as LLVM vectors for two reasons. A store that bypasses the caches needs an
aligned vector of a full cache line, which no loop over scalars can ask for; it saves reading every
line of the output before it is overwritten. And a loop that is already a vector needs no
vectoriser, so it compiles quickly and its speed does not depend on what the vectoriser believes.

The beginning and the end of a line, up to the first and after the last full cache line, are one
masked block each. All blocks do the same operations on a cell in the same order, in float64 and
without contraction: the bits of a cell do not depend on where in its line it stands.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sparsedp.kernels.pointers import prefetch

__all__ = ["ADD", "STORE", "STREAM", "combine", "combine_varying", "stencil"]

LINE = 64  # bytes of a cache line
AHEAD = 4096  # bytes: how far to fetch in front of the stream that is read for the first time
STORE, ADD, STREAM = 0, 1, 2

_INT = ir.IntType(64)
_DOUBLE = ir.DoubleType()


class _Block:
    """Emits one block: loads widen to float64, the store rounds once."""

    def __init__(self, context, builder, out_type, out):
        self.builder, self.out = builder, out
        self.item = context.get_data_type(out_type.dtype)
        self.size = out_type.dtype.bitwidth // 8
        self.lanes = LINE // self.size
        self.wide = ir.VectorType(_DOUBLE, self.lanes)
        self.narrow = ir.VectorType(self.item, self.lanes)
        self.mask = None

    def address(self, data, index, vector):
        return self.builder.bitcast(self.builder.gep(data, [index]), vector.as_pointer())

    def splat(self, scalar):
        vector = ir.VectorType(scalar.type, self.lanes)
        one = self.builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.IntType(32)(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [0] * self.lanes)
        return self.builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)

    def limit(self, count):
        """Restrict what follows to the first `count` lanes; None lifts it."""
        if count is None:
            self.mask = None
            return
        numbers = ir.Constant(ir.VectorType(_INT, self.lanes), list(range(self.lanes)))
        self.mask = self.builder.icmp_unsigned("<", numbers, self.splat(count))

    def masked(self, kind, vector, result, *arguments):
        element = {"double": "f64", "float": "f32"}[str(vector.element)]
        name = f"llvm.masked.{kind}.v{self.lanes}{element}.p0"
        signature = ir.FunctionType(result, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(self.builder.module, signature, name)
        return self.builder.call(function, arguments)

    def load(self, data, index, vector=None):
        vector = vector or self.narrow
        where = self.address(data, index, vector)
        size = 8 if vector.element == _DOUBLE else 4
        if self.mask is None:
            value = self.builder.load(where, align=size)
        else:
            zero = ir.Constant(vector, [0.0] * self.lanes)
            value = self.masked("load", vector, vector, where, ir.IntType(32)(size), self.mask, zero)
        return value if vector.element == _DOUBLE else self.builder.fpext(value, self.wide)

    def store(self, value, index, stream):
        value = value if self.item == _DOUBLE else self.builder.fptrunc(value, self.narrow)
        where = self.address(self.out, index, self.narrow)
        if self.mask is not None:
            self.masked("store", self.narrow, ir.VoidType(), value, where, ir.IntType(32)(self.size), self.mask)
            return
        line = self.builder.store(value, where, align=LINE)
        if stream:
            line.set_metadata("nontemporal", self.builder.module.add_metadata([ir.IntType(32)(1)]))

    def fetch(self, data, index):
        """Ask for what is read a little later; not worth it in a masked block."""
        if self.mask is not None:
            return
        ahead = self.builder.add(index, _INT(AHEAD // self.size))
        prefetch(self.builder, data, ahead, (0, 2, 1))  # read, into L2, data

    def total(self, pairs):
        """Sum of coefficient * value."""
        products = [self.builder.fmul(*pair) for pair in pairs]
        total = products[0]
        for product in products[1:]:
            total = self.builder.fadd(total, product)
        return total

    def run(self, start, length, emit, whole):
        """Cover `length` cells of the output from index `start`.

        `emit(shift)` emits a masked block, `whole(loop)` the loops over full cache lines:
        `loop(body)` runs `body(shift)`, with `shift` the cells since `start`.
        """
        builder = self.builder
        address = builder.ptrtoint(builder.gep(self.out, [start]), _INT)
        head = builder.udiv(builder.and_(builder.neg(address), _INT(LINE - 1)), _INT(self.size))
        head = builder.select(builder.icmp_signed("<", head, length), head, length)
        blocks = builder.udiv(builder.sub(length, head), _INT(self.lanes))
        tail = builder.add(head, builder.mul(blocks, _INT(self.lanes)))

        def loop(body):
            with cgutils.for_range(builder, blocks) as state:
                body(builder.add(head, builder.mul(state.index, _INT(self.lanes))))

        whole(loop)
        with cgutils.for_range(builder, _INT(2)) as state:
            first = builder.icmp_signed("==", state.index, _INT(0))
            shift = builder.select(first, _INT(0), tail)
            count = builder.select(first, head, builder.sub(length, tail))
            with builder.if_then(builder.icmp_signed(">", count, _INT(0))):
                self.limit(count)
                emit(shift)
                self.limit(None)


def _cases(builder, selector, count, emit):
    """Emit `emit(case)` for each case in range(count) and jump to the one that `selector` names."""
    end = builder.append_basic_block("end")
    switch = builder.switch(selector, end)
    for case in range(count):
        block = builder.append_basic_block("case")
        switch.add_case(_INT(case), block)
        builder.position_at_end(block)
        emit(case)
        builder.branch(end)
    builder.position_at_end(end)


class _Stencil(_Block):
    """The blocks of `stencil`."""

    def read(self, args):
        self.u, self.arrays = args[1], cgutils.unpack_tuple(self.builder, args[2])
        self.at, *others, self.position, self.length = cgutils.unpack_tuple(self.builder, args[3])
        self.before1, self.after1, self.before0, self.after0, self.near = others
        self.base, *others = (self.splat(weight) for weight in cgutils.unpack_tuple(self.builder, args[4]))
        self.row, (self.b1, self.a1, self.b0, self.a0) = others[:3], others[3:]

    def coefficients(self, shift, varying):
        """Of the row: lower, centre, upper."""
        if not varying:
            return self.row
        place = self.builder.add(self.position, shift)
        lower, centre, upper = (self.load(array, place, self.wide) for array in self.arrays)
        return lower, self.builder.fadd(self.base, centre), upper

    def emit(self, shift, varying, seven, stream):
        def value(start):
            return self.load(self.u, self.builder.add(start, shift))

        left, right = self.builder.sub(self.at, self.near), self.builder.add(self.at, self.near)
        lower, centre, upper = self.coefficients(shift, varying)
        pairs = [
            [(lower, value(left)), (upper, value(right))],
            [(self.b1, value(self.before1)), (self.a1, value(self.after1))],
        ]
        if seven:
            pairs.append([(self.b0, value(self.before0)), (self.a0, value(self.after0))])
        self.fetch(self.u, self.builder.add(self.after0 if seven else self.after1, shift))
        total = self.builder.fmul(centre, value(self.at))
        for pair in pairs:
            total = self.builder.fadd(total, self.total(pair))
        self.store(total, self.builder.add(self.at, shift), stream)


@intrinsic
def stencil(typingctx, out, u, coefficients, places, weights, flags):
    """Part of a row of u -> the same part of a row of out: 5 or 7 points.

    `coefficients`: (lower, centre, upper) arrays along the row, read only if varying.
    `places`: index in u of the part and of its neighbours in axes 1 and 0 (before, after), the
    distance of the neighbours along the row, position of the part in the row, length.
    `weights`: centre without the row's own, lower, centre, upper of the row if not varying,
    then before and after of axis 1 and of axis 0.
    `flags`: mode (store 0, stream 1) + 2 varying + 4 seven points.
    """

    def generate(context, builder, signature, args):
        block = _Stencil(context, builder, signature.args[0], args[0])
        block.read(args)

        def masked(shift):
            kind = builder.lshr(args[5], _INT(1))
            _cases(builder, kind, 4, lambda case: block.emit(shift, case & 1, case & 2, False))

        def whole(loop):
            def emit(case):
                loop(lambda shift: block.emit(shift, case & 2, case & 4, bool(case & 1)))

            _cases(builder, args[5], 8, emit)

        block.run(block.at, block.length, masked, whole)
        return context.get_dummy_value()

    return types.void(out, u, coefficients, places, weights, flags), generate


class _Combination(_Block):
    """The blocks of `combine`."""

    def read(self, args, varying):
        self.u, self.values, self.varying = args[1], args[2], varying
        self.at, *places, self.length = cgutils.unpack_tuple(self.builder, args[3])
        self.places, self.table = places[:3], places[3:]
        *self.constants, self.scale = (self.splat(weight) for weight in cgutils.unpack_tuple(self.builder, args[4]))

    def weight(self, k, shift):
        if not self.varying:
            return self.constants[k]
        return self.load(self.values, self.builder.add(self.table[k], shift), self.wide)

    def emit(self, shift, mode, count):
        places = [self.builder.add(place, shift) for place in self.places[:count]]
        self.fetch(self.u, places[-1])
        pairs = [(self.weight(k, shift), self.load(self.u, place)) for k, place in enumerate(places)]
        total = self.builder.fmul(self.scale, self.total(pairs))
        at = self.builder.add(self.at, shift)
        if mode == ADD:
            total = self.builder.fadd(self.load(self.out, at), total)
        self.store(total, at, mode == STREAM)


def _combine(varying):
    """The intrinsic for constant weights, or for weights that vary along the line."""

    def combine(typingctx, out, u, values, places, weights, flags):
        def generate(context, builder, signature, args):
            block = _Combination(context, builder, signature.args[0], args[0])
            block.read(args, varying)
            mode, more = builder.and_(args[5], _INT(3)), builder.lshr(args[5], _INT(2))

            def masked(shift):  # one that streams is stored the ordinary way
                add = builder.and_(mode, _INT(ADD))
                _cases(builder, add, 2, lambda a: _cases(builder, more, 3, lambda k: block.emit(shift, a, k + 1)))

            def whole(loop):
                def emit(a, k):
                    loop(lambda shift: block.emit(shift, a, k + 1))

                _cases(builder, mode, 3, lambda a: _cases(builder, more, 3, lambda k: emit(a, k)))

            block.run(block.at, block.length, masked, whole)
            return context.get_dummy_value()

        return types.void(out, u, values, places, weights, flags), generate

    combine.__doc__ = """Parts of lines of u -> part of a line of out: weighted sum of 1, 2 or 3.

    `places`: index in out, three indices in u, three in values (used if varying), length.
    `weights`: three constants (used if not varying), scale.
    `flags`: mode (STORE, ADD, STREAM) + 4 (number of streams - 1).
    """
    return intrinsic(combine)


combine, combine_varying = _combine(False), _combine(True)
