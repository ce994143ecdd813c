"""Numbers at addresses, for the compiled kernels.

Inside a kernel arrays are pointers: numba counts the users of every array that is handed to a
function, twice a row and atomically, which takes longer than a short row itself.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

__all__ = ["address", "call", "claim", "fence", "get", "pointer", "prefetch", "put"]

_INT = ir.IntType(64)
_DOUBLE = ir.DoubleType()


def prefetch(builder, data, index, kinds):
    """Emit a prefetch of data[index]; kinds: (write, locality 0 to 3, data)."""
    byte, small = ir.IntType(8).as_pointer(), ir.IntType(32)
    signature = ir.FunctionType(ir.VoidType(), [byte] + [small] * 3)
    function = builder.module.declare_intrinsic("llvm.prefetch", [byte], signature)
    where = builder.bitcast(builder.gep(data, [index]), byte)
    builder.call(function, [where] + [small(kind) for kind in kinds])


@intrinsic
def call(typingctx, function, numbers):
    """Call a C function at an address with the numbers of a tuple; nothing comes back."""

    def generate(context, builder, signature, args):
        values = cgutils.unpack_tuple(builder, args[1])
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in values])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)
        return context.get_dummy_value()

    return types.void(types.int64, numbers), generate


@intrinsic
def address(typingctx, array):
    """Array -> address of its first number. A number can be handed to a thread."""

    def generate(context, builder, signature, args):
        return builder.ptrtoint(context.make_array(signature.args[0])(context, builder, args[0]).data, _INT)

    return types.int64(array), generate


@intrinsic
def pointer(typingctx, place, like):
    """Address -> pointer to numbers of the type of `like`."""

    def generate(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_data_type(signature.args[1]).as_pointer())

    return types.CPointer(like)(types.int64, like), generate


@intrinsic
def get(typingctx, pointer, index):
    """Number at an index; floats as float64."""
    real = isinstance(pointer.dtype, types.Float)

    def generate(context, builder, signature, args):
        value = builder.load(builder.gep(args[0], [args[1]]))
        return builder.fpext(value, _DOUBLE) if real and value.type != _DOUBLE else value

    return (types.float64 if real else types.int64)(pointer, types.int64), generate


@intrinsic
def put(typingctx, pointer, index, value):
    """Round a float64 and store it at an index."""

    def generate(context, builder, signature, args):
        item = context.get_data_type(signature.args[0].dtype)
        value = args[2] if item == _DOUBLE else builder.fptrunc(args[2], item)
        builder.store(value, builder.gep(args[0], [args[1]]))
        return context.get_dummy_value()

    return types.void(pointer, types.int64, types.float64), generate


@intrinsic
def claim(typingctx, pointer, index):
    """Announce a store: the cache line of this index is fetched for writing."""

    def generate(context, builder, signature, args):
        prefetch(builder, args[0], args[1], (1, 3, 1))
        return context.get_dummy_value()

    return types.void(pointer, types.int64), generate


@intrinsic
def fence(typingctx):
    """Stores that bypassed the caches become visible before anything that follows."""

    def generate(context, builder, signature, args):
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate
