"""Programs of `dp.jit`, translated to machine code by LLVM: loops over the entries of small arrays.

A list of recorded calls can be translated if each of them is of one of five kinds:

==================  ====================================================================================================
entrywise           arithmetic, comparisons and functions such as `sin`, with broadcasting; neighbours share a loop
movement            slices, `roll`, `reshape`, `concatenate` and others that only move entries. A call with numbered
                    entries shows where each entry comes from, so that none of these functions is written again
sum                 `sum` and `mean`
product             `dot`, `matmul`, `tensordot`, and an Operator by its matrix, as lists of products of two entries
check               that values are finite. If one is not, the recorded program runs and raises its error
==================  ====================================================================================================

Any other call raises `NotCompiled` with its name. Arrays with at most eight entries become local variables. Machine
code is not kept on disk, because the translation takes a tenth of a second.

Nothing imports this module before ``dp.jit(..., compile=True)`` is called.
"""

from __future__ import annotations

import ctypes
import operator
import sys
from threading import RLock
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
from autograd.numpy import numpy_vjps

from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.fast_derivatives import ARRAY, COPY, ITEM
from sparsedp.autodiff.program_trace import Slot, array_copy
from sparsedp.autodiff.tape import add_at, called, embedded, is_operator_call, sparse_add

try:
    from llvmlite import binding, ir
except ImportError as error:
    raise ImportError(
        "dp.jit with compile=True needs llvmlite; install it with: pip install 'sparsedp[fast]'"
    ) from error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sparsedp.autodiff.program_trace import ProgramCall, ProgramTrace

__all__ = ["CompiledLoop", "CompiledProgram", "NotCompiled"]

UNROLLED = 8  # arrays with at most this number of entries become local variables
MOST_CALLS = 4000  # longer programs would take many seconds to translate
MOST_NUMBERED = 2**20  # entries of the arrays of a movement
MOST_PRODUCTS = 2**18  # entries of one operand times those of the other
MOST_PAIRWISE = 4096  # longer sums are added in one loop

DIFFERENT = "rounding errors, which grew until the results differed from those of the recorded program"

DOUBLE = ir.DoubleType()
SINGLE = ir.FloatType()
BYTE = ir.IntType(8)
BIT = ir.IntType(1)
INDEX = ir.IntType(64)
TYPES = {"d": DOUBLE, "f": SINGLE, "?": BIT}  # of entries, by the character of their dtype
STORED_TYPES = {"d": DOUBLE, "f": SINGLE, "?": BYTE}
DTYPES: dict[str, Any] = {"d": np.dtype(np.float64), "f": np.dtype(np.float32), "?": np.dtype(np.bool_)}
_lock = RLock()


class NotCompiled(Exception):
    """A program that stays Python code; the message names the reason."""


# ---- functions of entries --------------------------------------------------------------------------------------------


def _maximum(builder, x, y):
    """Return the larger number, or NaN if one of them is NaN, as `numpy.maximum`."""
    takes_first = builder.or_(builder.fcmp_ordered(">=", x, y), builder.fcmp_unordered("uno", x, x))
    return builder.select(takes_first, x, y)


def _minimum(builder, x, y):
    takes_first = builder.or_(builder.fcmp_ordered("<=", x, y), builder.fcmp_unordered("uno", x, x))
    return builder.select(takes_first, x, y)


def _sign(builder, x):
    zero, one, minus_one = (ir.Constant(x.type, value) for value in (0.0, 1.0, -1.0))
    lower = builder.select(builder.fcmp_ordered("<", x, zero), minus_one, builder.fmul(x, zero))
    return builder.select(builder.fcmp_ordered(">", x, zero), one, _without_sign(builder, x, lower))


def _without_sign(builder, x, value):
    """Return +0 if x is a zero, else the value."""
    zero = ir.Constant(x.type, 0.0)
    return builder.select(builder.fcmp_ordered("==", x, zero), zero, value)


def _intrinsic(name):
    def act(builder, x):
        return builder.call(builder.module.declare_intrinsic(f"llvm.{name}", [x.type]), [x])

    return act


def _library(name):
    """Return a call of a function of the C library, which NumPy calls too, or replaces by one of its own."""

    def act(builder, *args):
        dtype = args[0].type
        word = name if dtype == DOUBLE else f"{name}f"
        if not _has_library_function(word):
            raise NotCompiled(f"{name}, which the C library of this system does not have")
        function = builder.module.globals.get(_symbol(word))
        if function is None:
            signature = ir.FunctionType(dtype, [dtype] * len(args))
            function = ir.Function(builder.module, signature, _symbol(word))
        return builder.call(function, args)

    return act


def _symbol(name):
    return f"sparsedp_{name}"


def _has_library_function(name):
    """Look up a function of the C library and tell LLVM its address; return whether it exists."""
    library = ctypes.cdll.ucrtbase if sys.platform == "win32" else ctypes.CDLL(None)
    try:
        function = getattr(library, name)
    except AttributeError:
        return False
    binding.add_symbol(_symbol(name), ctypes.cast(function, ctypes.c_void_p).value)
    return True


def _square(builder, x):
    return builder.fmul(x, x)


def _reciprocal(builder, x):
    return builder.fdiv(ir.Constant(x.type, 1.0), x)


def _positive(builder, x):
    return x


FLOATING = {  # functions of floating numbers
    np.add: lambda builder, x, y: builder.fadd(x, y),
    np.subtract: lambda builder, x, y: builder.fsub(x, y),
    np.multiply: lambda builder, x, y: builder.fmul(x, y),
    np.true_divide: lambda builder, x, y: builder.fdiv(x, y),
    np.power: _library("pow"),
    np.negative: lambda builder, x: builder.fneg(x),
    np.positive: _positive,
    np.conjugate: _positive,
    np.real: _positive,
    np.square: _square,
    np.reciprocal: _reciprocal,
    np.sqrt: _intrinsic("sqrt"),
    np.absolute: _intrinsic("fabs"),
    np.fabs: _intrinsic("fabs"),
    np.floor: _intrinsic("floor"),
    np.ceil: _intrinsic("ceil"),
    np.sign: _sign,
    np.maximum: _maximum,
    np.minimum: _minimum,
    np.arctan2: _library("atan2"),
    np.hypot: _library("hypot"),
    np.arcsin: _library("asin"),
    np.arccos: _library("acos"),
    np.arctan: _library("atan"),
    np.arcsinh: _library("asinh"),
    np.arccosh: _library("acosh"),
    np.arctanh: _library("atanh"),
}
for _name in ("exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sin", "cos", "tan", "sinh", "cosh", "tanh"):
    FLOATING[getattr(np, _name)] = _library(_name)
COMPARISONS = {
    np.greater: ">",
    np.greater_equal: ">=",
    np.less: "<",
    np.less_equal: "<=",
    np.equal: "==",
    np.not_equal: "!=",
}
LOGICAL = {  # functions of booleans
    np.logical_and: lambda builder, x, y: builder.and_(x, y),
    np.logical_or: lambda builder, x, y: builder.or_(x, y),
    np.logical_xor: lambda builder, x, y: builder.xor(x, y),
    np.logical_not: lambda builder, x: builder.not_(x),
    np.bitwise_and: lambda builder, x, y: builder.and_(x, y),
    np.bitwise_or: lambda builder, x, y: builder.or_(x, y),
    np.bitwise_xor: lambda builder, x, y: builder.xor(x, y),
    np.invert: lambda builder, x: builder.not_(x),
}
PYTHON_NAMES = {
    operator.add: np.add,
    operator.sub: np.subtract,
    operator.mul: np.multiply,
    operator.truediv: np.true_divide,
    operator.pow: np.power,
    operator.neg: np.negative,
    operator.getitem: ITEM.fun,
}
POWERS = {-1.0: _reciprocal, 0.5: _intrinsic("sqrt"), 1.0: _positive, 2.0: _square}
MOVEMENTS = {ITEM.fun, ARRAY.fun, COPY.fun, anp.concatenate_args.fun, array_copy, embedded} | {
    getattr(getattr(anp, name), "fun", getattr(anp, name))
    for name in (
        "atleast_1d atleast_2d atleast_3d broadcast_to diag diagonal expand_dims flip fliplr flipud moveaxis pad ravel "
        "repeat reshape roll rollaxis rot90 squeeze swapaxes take tile transpose tril triu"
    ).split()
}
ADJOINTS = {getattr(numpy_vjps, f"{name}_adjoint_{num}").fun for name in ("dot", "tensordot") for num in (0, 1)}
PRODUCTS = {np.dot, np.matmul, np.tensordot, np.inner, np.outer, np.einsum} | ADJOINTS
SUMS = {np.sum, np.mean}
# The cotangents of entries of an array: the first function describes them, the second adds them to those of the array.
DESCRIBE_PART = numpy_vjps.untake.fun
ADD_PART = sparse_add.fun


def _plain_function(function):
    """Return the function of NumPy that a recorded call executes."""
    function = getattr(function, "fun", function)
    return PYTHON_NAMES.get(function, function)


def _name_of(call):
    """Return the name of the function, rule or Operator of a call."""
    owner = called(call.function, call.args)
    owner = getattr(owner, "func", owner)  # of a partial
    owner = getattr(owner, "__self__", owner)  # of the method of an opaque call
    name = getattr(owner, "name", None)
    if isinstance(name, str):
        return name
    return getattr(owner, "__name__", type(owner).__name__)


# ---- which entries a function moves or multiplies --------------------------------------------------------------------


def moved_entries(function: Callable, args: Sequence, options: dict, samples: Sequence, shape: tuple) -> tuple:
    """Return where the entries of the result of a function come from that moves entries and computes nothing.

    Parameters
    ----------
    function : callable
    args : sequence
        A Slot for each argument whose entries are moved.
    options : dict
    samples : sequence
        Values with the shapes of the arguments.
    shape : tuple of int
        Shape of the result.

    Returns
    -------
    places : array of int
        For each entry of the result its number among the entries of all slots, one after another; -1 for a constant.
    constants : array of float

    Raises
    ------
    NotCompiled
        If the function does something else.
    """
    total = sum(np.size(sample) for arg, sample in zip(args, samples, strict=True) if type(arg) is Slot)
    if total > MOST_NUMBERED:
        raise NotCompiled(f"{total} entries to be moved")
    results = []
    for base in (2**21, 3 * 2**21):  # a constant is the same in both runs; all numbers are exact in single precision
        start = base
        numbered = []
        for arg, sample in zip(args, samples, strict=True):
            if type(arg) is not Slot:
                numbered.append(arg)
                continue
            numbers = np.arange(start, start + np.size(sample), dtype=float).reshape(np.shape(sample))
            start += np.size(sample)
            numbered.append(numbers if isinstance(sample, np.ndarray) else numbers[()])
        result = np.asarray(function(*numbered, **options), float)
        if result.shape != shape:
            raise NotCompiled("a movement of entries whose shape depends on them")
        results.append(result.reshape(-1).copy())
    first, second = results
    places = np.where(first == second, -1, first - 2**21).astype(np.int64)
    is_moved = places >= 0
    if np.any(is_moved & ((second - first != 2**22) | (places >= total))):
        raise NotCompiled("a function that computes with the entries that it moves")
    return places, np.where(is_moved, 0.0, first)


class _Products:
    """A sum of products of an entry of one operand and an entry of another one: a list of pairs of numbers."""

    __slots__ = ("pairs",)

    def __init__(self, pairs: list) -> None:
        self.pairs = pairs

    def __add__(self, other: Any) -> _Products:
        if type(other) is _Products:
            return _Products(self.pairs + other.pairs)
        if isinstance(other, (int, float)) and other == 0:  # sums may begin with zero
            return self
        raise NotCompiled("a product with a constant term")

    __radd__ = __add__


class _Entry:
    """An entry of the first or second operand of a product."""

    __slots__ = ("number", "side")

    def __init__(self, side: int, number: int) -> None:
        self.side = side
        self.number = number

    def __mul__(self, other: Any) -> _Products:
        if type(other) is not _Entry or other.side == self.side:
            raise NotCompiled("a product of more than two operands")
        if self.side == 0:
            return _Products([(self.number, other.number)])
        return _Products([(other.number, self.number)])

    def conjugate(self) -> _Entry:
        return self


def multiplied_entries(function: Callable, args: Sequence, options: dict, shapes: Sequence) -> list[list]:
    """Return for each entry of a product the list of the pairs of entries that are multiplied and added.

    `shapes` has the shapes of the two operands; they are the first two arguments, or the second and third of einsum.
    """
    sizes = [int(np.prod(shape)) for shape in shapes]
    if sizes[0] * sizes[1] > MOST_PRODUCTS:
        raise NotCompiled(f"{function.__name__} of arrays with {sizes[0]} and {sizes[1]} entries")
    operands = []
    for side, (size, shape) in enumerate(zip(sizes, shapes, strict=True)):
        operand = np.empty(size, object)
        operand[:] = [_Entry(side, number) for number in range(size)]
        operands.append(operand.reshape(shape))
    if function is np.einsum:
        result = np.einsum(args[0], *operands, **options)
    else:
        result = function(*operands, *map(_of_objects, args[2:]), **options)
    entries = np.asarray(result, object).reshape(-1)
    return [entry.pairs if type(entry) is _Products else [] for entry in entries]


def _of_objects(arg):
    """Return an argument of an adjoint with the dtype of objects in place of that of numbers."""
    if type(arg) is tuple:
        return tuple(np.dtype(object) if isinstance(one, np.dtype) else one for one in arg)
    return arg


# ---- values ----------------------------------------------------------------------------------------------------------


class _Value:
    """An array of a program.

    Attributes
    ----------
    dtype : str
        Character of the dtype: "d", "f" or "?".
    size : int
        Number of entries, in the order of C.
    entries : list or None
        The entries, as local variables.
    pointer
        The place of the first entry in memory; None for local variables, and for a value that the open loop computes.
    places : array of int or None
        For each entry its place among `entries` or in memory; None for 0, 1, 2, ...
    last : int
        Position of the last call that uses the value, or a value that has its entries in the same place.
    region : _Region or None
        The memory of the value, if it belongs to the program.
    base : _Value
        The value in whose memory the entries are.
    """

    def __init__(self, dtype: str, size: int, last: int = -1) -> None:
        self.dtype = dtype
        self.size = size
        self.last = last
        self.entries: Any = None
        self.pointer: Any = None
        self.places: Any = None
        self.region: _Region | None = None
        self.base: _Value = self


class _Region(NamedTuple):
    """A part of the memory of a program."""

    dtype: str
    offset: int
    size: int


class _Operation(NamedTuple):
    """An entrywise operation of the open loop."""

    act: Callable
    operands: list[tuple[_Value, Any]]
    result: _Value


class _Memory:
    """The memory of a program: for each dtype one array, parts of which are used again.

    Attributes
    ----------
    sizes : dict
        For each dtype the number of entries that are needed.
    """

    def __init__(self) -> None:
        self.sizes = {"d": 0, "f": 0, "?": 0}
        self._free: list[_Region] = []

    def take(self, dtype: str, size: int) -> _Region:
        """Return a region that nothing uses."""
        for region in self._free:
            if region.dtype == dtype and region.size == size:
                self._free.remove(region)
                return region
        region = _Region(dtype, self.sizes[dtype], size)
        self.sizes[dtype] += size
        return region

    def release(self, region: _Region) -> None:
        """Make a region available again."""
        self._free.append(region)


# ---- translation -----------------------------------------------------------------------------------------------------


class _Translator:
    """Translates calls to one function of LLVM.

    Parameters
    ----------
    extra : sequence of types
        Types of the parameters of the function after the common ones: memory for each dtype, places, constants, status.

    Attributes
    ----------
    builder : llvmlite.ir.IRBuilder
    extra : sequence
        Values of the further parameters.
    status
        Pointer to a number that becomes NaN if a checked value is not finite.
    """

    def __init__(self, extra: Sequence) -> None:
        module = ir.Module("program")
        module.triple = binding.get_process_triple()
        pointers = [DOUBLE, SINGLE, BYTE, INDEX, DOUBLE, DOUBLE]
        signature = ir.FunctionType(ir.VoidType(), [kind.as_pointer() for kind in pointers] + list(extra))
        function = ir.Function(module, signature, "program")
        self.module = module
        self.builder = ir.IRBuilder(function.append_basic_block())
        self.memory = _Memory()
        self._memory_pointers = dict(zip("df?", function.args, strict=False))
        self._places_pointer, self._constants_pointer, self.status = function.args[3:6]
        self.extra = function.args[6:]
        self._places: list = []
        self._n_places = 0
        self._places_offsets: dict[bytes, int] = {}
        self._constants: list = []
        self._n_constants = 0
        self._group: list[_Operation] = []
        self._group_start = 0
        self._position = 0  # of the present call
        self._last = 0  # of the calls that use its result
        self._values: dict[int, _Value] = {}
        self._parts: dict[int, ProgramCall] = {}
        self._live: list[_Value] = []

    # ---- memory ----

    def pointer_to(self, region: _Region) -> Any:
        """Return the pointer to a region of the memory."""
        return self.shifted(self._memory_pointers[region.dtype], region.offset)

    def shifted(self, pointer: Any, offset: Any) -> Any:
        """Return the pointer to an entry; the offset is an integer, known or of LLVM."""
        if isinstance(offset, (int, np.integer)):
            offset = ir.Constant(INDEX, int(offset))
        return self.builder.gep(pointer, [offset])

    def load(self, pointer: Any, offset: Any, dtype: str) -> Any:
        """Return an entry in memory."""
        value = self.builder.load(self.shifted(pointer, offset))
        if dtype == "?":
            return self.builder.icmp_unsigned("!=", value, ir.Constant(BYTE, 0))
        return value

    def store(self, value: Any, pointer: Any, offset: Any, dtype: str) -> None:
        """Write an entry to memory."""
        if dtype == "?":
            value = self.builder.zext(value, BYTE)
        self.builder.store(value, self.shifted(pointer, offset))

    def new_region(self, value: _Value) -> None:
        """Give a value memory that no other value needs from now on."""
        start = self._position
        if self._group:
            start = min(start, self._group_start)
        still_live = []
        for other in self._live:
            if other.last < start:
                self.memory.release(other.region)  # type: ignore[arg-type]
            else:
                still_live.append(other)
        self._live = still_live
        value.region = self.memory.take(value.dtype, value.size)
        value.pointer = self.pointer_to(value.region)
        self._live.append(value)

    def _offset_of_places(self, places: Any) -> int:
        """Return the offset of an array of places, which the function gets as an argument."""
        places = np.ascontiguousarray(places, np.int64).reshape(-1)
        key = places.tobytes()
        offset = self._places_offsets.get(key)
        if offset is None:
            offset = self._places_offsets[key] = self._n_places
            self._places.append(places)
            self._n_places += places.size
        return offset

    # ---- loops ----

    def loop(self, count: Any, body: Callable, start: Sequence = ()) -> list:
        """Repeat ``sums = body(i, *sums)`` for i = 0 ... count - 1, at least once; return the last sums."""
        builder = self.builder
        before = builder.block
        block = builder.append_basic_block()
        after = builder.append_basic_block()
        builder.branch(block)
        builder.position_at_end(block)
        i = builder.phi(INDEX)
        i.add_incoming(ir.Constant(INDEX, 0), before)
        sums = []
        for value in start:
            phi = builder.phi(value.type)
            phi.add_incoming(value, before)
            sums.append(phi)
        results = list(body(i, *sums) or ())
        following = builder.add(i, ir.Constant(INDEX, 1))
        i.add_incoming(following, builder.block)
        for phi, value in zip(sums, results, strict=True):
            phi.add_incoming(value, builder.block)
        if isinstance(count, int):
            count = ir.Constant(INDEX, count)
        builder.cbranch(builder.icmp_signed("<", following, count), block, after)
        builder.position_at_end(after)
        return results

    # ---- entries ----

    def cast(self, value: Any, dtype: str, target: str) -> Any:
        """Convert an entry to another dtype."""
        if dtype == target:
            return value
        if target == "?":
            return self.builder.fcmp_unordered("!=", value, ir.Constant(value.type, 0.0))
        if dtype == "?":
            return self.builder.uitofp(value, TYPES[target])
        if isinstance(value, ir.Constant):
            return ir.Constant(TYPES[target], float(DTYPES[target].type(value.constant)))
        if target == "f":
            return self.builder.fptrunc(value, SINGLE)
        return self.builder.fpext(value, DOUBLE)

    def entry(self, value: _Value, place: int) -> Any:
        """Return one entry of a value."""
        self._finish(value)
        if value.places is not None:
            place = int(value.places[place])
        if value.entries is not None:
            return value.entries[place]
        return self.load(value.pointer, place, value.dtype)

    def reader(self, value: _Value, places: Any = None) -> Callable:
        """Return a function that returns the entry for an index of a loop, to be called inside this loop.

        Parameters
        ----------
        value : _Value
        places : array of int, optional
            For each index the place of the entry, an axis for each index. Default: the index itself.
        """
        self._finish(value)
        if value.places is not None:
            places = value.places if places is None else value.places[places]
        if places is None and value.entries is not None:
            places = np.arange(value.size)
        if places is not None and np.all(places == places.flat[0]):
            constant = self.entry(_source(value), int(places.flat[0]))
            return lambda *indices: constant
        pointer = value.pointer
        if value.entries is not None:
            pointer = self._stored_entries(value).pointer
        index_of = self._index(places)
        return lambda *indices: self.load(pointer, index_of(*indices), value.dtype)

    def _stored_entries(self, value):
        """Return a value in memory with the entries of local variables."""
        stored = _Value(value.dtype, len(value.entries), self._position)
        self.new_region(stored)
        for place, entry in enumerate(value.entries):
            self.store(entry, stored.pointer, place, value.dtype)
        return stored

    def _index(self, places):
        """Return a function of the indices of loops that returns a place in memory."""
        if places is None:
            return lambda i: i
        builder = self.builder
        corner = int(places.flat[0])
        strides = []
        for axis, length in enumerate(places.shape):
            step = np.zeros(places.ndim, int)
            step[axis] = min(1, length - 1)
            strides.append(int(places[tuple(step)]) - corner)
        grids = np.meshgrid(*map(np.arange, places.shape), indexing="ij")
        if np.array_equal(places, corner + sum(stride * grid for stride, grid in zip(strides, grids, strict=True))):
            return lambda *indices: self._linear(corner, strides, indices)
        offset = self._offset_of_places(places)
        shape = places.shape

        def looked_up(*indices):
            flat = indices[0]
            for length, index in zip(shape[1:], indices[1:], strict=True):
                flat = builder.add(builder.mul(flat, ir.Constant(INDEX, length)), index)
            return builder.load(self.shifted(self.shifted(self._places_pointer, offset), flat))

        return looked_up

    def _linear(self, corner, strides, indices):
        total = ir.Constant(INDEX, corner)
        for stride, index in zip(strides, indices, strict=True):
            if stride:
                total = self.builder.add(total, self.builder.mul(ir.Constant(INDEX, stride), index))
        return total

    # ---- arguments and results ----

    def constant(self, array: Any) -> _Value:
        """Return the value of a constant argument."""
        array = np.asarray(array)
        if array.dtype.kind not in "fiub":
            raise NotCompiled(f"a constant of dtype {array.dtype}")
        numbers = np.ascontiguousarray(array, float).reshape(-1)
        if array.dtype.kind in "iu" and np.any(np.abs(numbers) > 2**53):
            raise NotCompiled("an integer above 2**53")
        value = _Value("d", numbers.size)
        if numbers.size <= UNROLLED:
            value.entries = [ir.Constant(DOUBLE, float(number)) for number in numbers]
        elif (numbers.view(np.int64) == numbers[:1].view(np.int64)).all():
            value.entries = [ir.Constant(DOUBLE, float(numbers[0]))]
            value.places = np.zeros(numbers.size, np.int64)
        else:
            value.pointer = self.shifted(self._constants_pointer, self._n_constants)
            self._constants.append(numbers)
            self._n_constants += numbers.size
        return value

    def bind(self, slot: Slot, sample: Any, pointer: Any) -> None:
        """Define an argument of the program by its place in memory."""
        value = _Value(_dtype_of(sample, "an argument"), np.size(sample))
        value.last = sys.maxsize
        if value.size <= UNROLLED:
            value.entries = [self.load(pointer, place, value.dtype) for place in range(value.size)]
        else:
            value.pointer = pointer
        self._values[slot.number] = value

    def value_of(self, result: Any) -> _Value:
        """Return the value of a result of the program."""
        if type(result) is Slot:
            return self._values[self._aliases.get(result.number, result.number)]
        return self.constant(result)

    def write(self, result: Any, pointer: Any, dtype: str, is_checked: bool = True) -> None:
        """Write a result to memory, and check that it is finite."""
        value = self.value_of(result)
        if not value.size:
            return
        if value.size <= UNROLLED:
            for place in range(value.size):
                entry = self.cast(self.entry(value, place), value.dtype, dtype)
                self.store(entry, pointer, place, dtype)
                if is_checked and dtype != "?":
                    self._add_to_status(self._is_bad(entry))
            return
        read = self.reader(value)
        is_checked = is_checked and dtype != "?"

        def body(i, *bad):
            entry = self.cast(read(i), value.dtype, dtype)
            self.store(entry, pointer, i, dtype)
            return [self.builder.or_(one, self._is_bad(entry)) for one in bad]

        bad = self.loop(value.size, body, [ir.Constant(BIT, 0)] if is_checked else [])
        if is_checked:
            self._add_to_status(bad[0])

    def add_to(self, result: Any, pointer: Any, dtype: str) -> None:
        """Add a result to numbers in memory, and check that it is finite."""
        value = self.value_of(result)
        if not value.size:
            return
        read = self.reader(value)

        def body(i, bad):
            entry = self.cast(read(i), value.dtype, dtype)
            self.store(self.builder.fadd(self.load(pointer, i, dtype), entry), pointer, i, dtype)
            return [self.builder.or_(bad, self._is_bad(entry))]

        (bad,) = self.loop(value.size, body, [ir.Constant(BIT, 0)])
        self._add_to_status(bad)

    def _is_bad(self, entry):
        """Return whether an entry is NaN or infinite."""
        difference = self.builder.fsub(entry, entry)
        return self.builder.fcmp_unordered("uno", difference, difference)

    def _add_to_status(self, bad):
        with self.builder.if_then(bad):
            self.builder.store(ir.Constant(DOUBLE, float("nan")), self.status)

    # ---- calls ----

    def translate(self, trace: ProgramTrace, calls: Sequence[ProgramCall], results: Iterable) -> None:
        """Translate all calls."""
        if len(calls) > MOST_CALLS:
            raise NotCompiled(f"its {len(calls)} calls, more than {MOST_CALLS}")
        self._trace = trace
        calls, self._aliases = _without_repetitions(calls)
        self._last_use: dict[int, int] = {}
        described: dict[int, ProgramCall] = {}
        for position, call in enumerate(calls):
            if _plain_function(call.function) is DESCRIBE_PART:
                described[call.result.number] = call
            for arg in call.args:
                if type(arg) is Slot:
                    self._last_use[arg.number] = position
                    if arg.number in described:  # the addition reads the arguments of the description
                        for inner in described[arg.number].args:
                            if type(inner) is Slot:
                                self._last_use[inner.number] = position
        for result in results:
            if type(result) is Slot:
                self._last_use[self._aliases.get(result.number, result.number)] = sys.maxsize
        for position, call in enumerate(calls):
            self._position = position
            self._translate_call(call)
        self._position = len(calls)
        self._close()

    def _translate_call(self, call):
        if call.has_effect:
            self._check(call)
            return
        if _plain_function(call.function) is DESCRIBE_PART:
            self._parts[call.result.number] = call
            return
        sample = self._trace.sample(call.result)
        dtype = _dtype_of(sample, _name_of(call))
        self._last = self._last_use.get(call.result.number, self._position)
        function = _plain_function(call.function)
        if is_operator_call(call.function):
            value = self._operator(call, dtype)
        elif function is np.where and len(call.args) == 3 and not call.options:
            value = self._entrywise(call, self._where(dtype), sample, dtype)
        elif function in FLOATING or function in COMPARISONS or function in LOGICAL:
            value = self._entrywise(call, self._ufunc(call, function, dtype), sample, dtype)
        elif function is add_at:
            total, g, index = call.args
            value = self._add_at(total, g, index, dtype)
        elif function is ADD_PART:
            value = self._add_part(call, sample, dtype)
        elif function in MOVEMENTS:
            value = self._movement(call, function, sample, dtype)
        elif function in SUMS:
            value = self._sum(call, function, sample, dtype)
        elif function in PRODUCTS:
            value = self._product(call, function, dtype)
        else:
            raise NotCompiled(_name_of(call))
        value.base.last = max(value.base.last, value.last)
        self._values[call.result.number] = value

    def _new_value(self, dtype, size):
        """Return the value of the result of the present call."""
        return _Value(dtype, size, self._last)

    def _argument(self, arg):
        if type(arg) is Slot:
            return self._values[arg.number]
        return self.constant(arg)

    def _check(self, call):
        """Translate a check that values are finite."""
        function = getattr(call.function, "func", call.function)
        if function is not check_finite and not getattr(function, "checks_finiteness", False):
            raise NotCompiled(f"the check {_name_of(call)}")
        for arg in call.args:
            if type(arg) is not Slot:
                continue
            value = self._values[arg.number]
            if value.dtype == "?" or not value.size:
                continue
            if value.size <= UNROLLED:
                for place in range(value.size):
                    self._add_to_status(self._is_bad(self.entry(value, place)))
                continue
            read = self.reader(value)
            (bad,) = self.loop(
                value.size,
                lambda i, bad, read=read: [self.builder.or_(bad, self._is_bad(read(i)))],
                [ir.Constant(BIT, 0)],
            )
            self._add_to_status(bad)

    # ---- entrywise ----

    def _ufunc(self, call, function, dtype):
        """Return the function for a call of a ufunc; ``act(operands, values)`` returns an entry."""
        if call.options or len(call.args) > 2:
            raise NotCompiled(f"{_name_of(call)} with options")
        samples = list(map(self._trace.sample, call.args))
        if any(np.asarray(sample).dtype.kind == "c" for sample in samples):
            raise NotCompiled("complex numbers")
        act: Any
        if function in LOGICAL:
            act = LOGICAL[function]
            working = "?"
            kinds = {np.asarray(sample).dtype.kind for sample in samples}
            if dtype != "?" or (kinds != {"b"} and not function.__name__.startswith("logical")):
                raise NotCompiled(f"{function.__name__} of integers")
        elif function in COMPARISONS:
            working = np.result_type(*samples).char
            if working not in "df":
                raise NotCompiled(f"{function.__name__} of integers")
            sign = COMPARISONS[function]
            if sign == "!=":
                act = lambda builder, x, y: builder.fcmp_unordered(sign, x, y)
            else:
                act = lambda builder, x, y: builder.fcmp_ordered(sign, x, y)
        else:
            if dtype not in "df":
                raise NotCompiled(f"{function.__name__} of booleans")
            working = dtype
            act = FLOATING[function]
            if function is np.power:
                act = self._power(call, act)

        def act_on(values, entries):
            cast = [self.cast(entry, value.dtype, working) for entry, value in zip(entries, values, strict=True)]
            return act(self.builder, *cast)

        return act_on

    def _power(self, call, act):
        """Return a simpler operation for a power with a constant exponent, as NumPy does."""
        exponent = call.args[1]
        if type(exponent) is not Slot and np.size(exponent) == 1:
            simple = POWERS.get(float(np.asarray(exponent).reshape(())))
            if simple is not None:
                return lambda builder, x, y: simple(builder, x)
        return act

    def _where(self, dtype):
        def act_on(values, entries):
            condition = self.cast(entries[0], values[0].dtype, "?")
            first, second = (self.cast(entries[k], values[k].dtype, dtype) for k in (1, 2))
            return self.builder.select(condition, first, second)

        return act_on

    def _entrywise(self, call, act, sample, dtype):
        shape = np.shape(sample)
        operands = []
        for arg in call.args:
            arg_shape = np.shape(self._trace.sample(arg))
            places = None
            if arg_shape != shape:
                numbers = np.arange(int(np.prod(arg_shape))).reshape(arg_shape)
                places = np.broadcast_to(numbers, shape).reshape(-1)
            operands.append((self._argument(arg), places))
        result = self._new_value(dtype, int(np.prod(shape)))
        values = [value for value, _ in operands]
        if result.size <= UNROLLED:
            result.entries = []
            for k in range(result.size):
                entries = [self.entry(value, k if places is None else int(places[k])) for value, places in operands]
                result.entries.append(act(values, entries))
            return result
        if self._group and self._group[0].result.size != result.size:
            self._close()
        pending = {id(operation.result) for operation in self._group}
        if any(id(value) in pending and places is not None for value, places in operands):
            self._close()
        if not self._group:
            self._group_start = self._position
        self._group.append(_Operation(act, operands, result))
        return result

    def _finish(self, value):
        """Close the open loop if it computes a value that is needed now."""
        if any(operation.result is value for operation in self._group):
            self._close()

    def _close(self):
        """Write the open loop."""
        group = self._group
        if not group:
            return
        computed = {id(operation.result) for operation in group}
        readers = {}
        for operation in group:
            for value, places in operation.operands:
                key = id(value), id(places)
                if id(value) not in computed and key not in readers:
                    readers[key] = self.reader(value, places)
        stored = [operation.result for operation in group if operation.result.last >= self._position]
        for result in stored:
            self.new_region(result)
        self._group = []

        def body(i):
            local: dict = {}

            def operand(value, places):
                if id(value) in computed:
                    return local[id(value)]
                key = id(value), id(places)
                if key not in local:
                    local[key] = readers[key](i)
                return local[key]

            for operation in group:
                values = [value for value, _ in operation.operands]
                entries = [operand(value, places) for value, places in operation.operands]
                local[id(operation.result)] = operation.act(values, entries)
            for result in stored:
                self.store(local[id(result)], result.pointer, i, result.dtype)

        self.loop(group[0].result.size, body)

    # ---- movements ----

    def _movement(self, call, function, sample, dtype):
        samples = list(map(self._trace.sample, call.args))
        places, constants = moved_entries(function, call.args, call.options, samples, np.shape(sample))
        sources = [self._values[arg.number] for arg in call.args if type(arg) is Slot]
        ends = np.cumsum([source.size for source in sources])
        owners = np.where(places >= 0, np.searchsorted(ends, places, side="right"), -1)
        starts = np.concatenate([[0], ends])
        result = self._new_value(dtype, places.size)
        if result.size <= UNROLLED:
            result.entries = []
            for place, owner, constant in zip(places, owners, constants, strict=True):
                if owner < 0:
                    result.entries.append(self.cast(ir.Constant(DOUBLE, float(constant)), "d", dtype))
                else:
                    entry = self.entry(sources[owner], int(place - starts[owner]))
                    result.entries.append(self.cast(entry, sources[owner].dtype, dtype))
            return result
        if owners[0] >= 0 and np.all(owners == owners[0]) and sources[owners[0]].dtype == dtype:
            return self._view(sources[owners[0]], places - starts[owners[0]], result)
        self.new_region(result)
        for constant in np.unique(constants[owners < 0]):
            entry = self.cast(ir.Constant(DOUBLE, float(constant)), "d", dtype)
            self._copy(np.flatnonzero((owners < 0) & (constants == constant)), lambda *i, entry=entry: entry, result)
        for owner, source in enumerate(sources):
            positions = np.flatnonzero(owners == owner)
            if positions.size:
                read = self.reader(source, places[positions] - starts[owner])
                kind = source.dtype
                self._copy(positions, lambda i, read=read, kind=kind: self.cast(read(i), kind, dtype), result)
        return result

    def _view(self, source, places, result):
        """Return the entries of a value at some places, without copies."""
        self._finish(source)
        result.entries = source.entries
        result.pointer = source.pointer
        result.base = source.base
        if source.places is not None:
            places = source.places[places]
        if source.entries is not None or not np.array_equal(places, np.arange(places.size)):
            result.places = places
        return result

    def _copy(self, positions, read, result):
        """Write ``read(i)`` for each i to an entry of a result."""
        index_of = self._index(positions)
        self.loop(positions.size, lambda i: self.store(read(i), result.pointer, index_of(i), result.dtype))

    def _add_part(self, call, sample, dtype):
        """Translate the addition of the cotangents of entries, of which the index may select some twice."""
        _, total, part = call.args
        if type(part) is not Slot or part.number not in self._parts:
            raise NotCompiled(_name_of(call))
        g, index, _ = self._parts[part.number].args
        if total is None:
            total = np.zeros(np.shape(sample), DTYPES[dtype])
        return self._add_at(total, g, index, dtype)

    def _add_at(self, total_arg, g_arg, index, dtype):
        """Translate ``total[index] += g``, for an index that may select entries twice as ``numpy.add.at``."""
        total, g = map(self._argument, (total_arg, g_arg))
        if type(index) is Slot or (type(total_arg) is Slot and total.dtype != dtype):
            raise NotCompiled("an addition at a traced index")
        shape = np.shape(self._trace.sample(total_arg))
        places = np.arange(total.size).reshape(shape)[index]
        g_shape = np.shape(self._trace.sample(g_arg))
        numbers = np.arange(g.size).reshape(g_shape)
        numbers = np.broadcast_to(numbers, np.shape(places)).reshape(-1)
        places = np.reshape(places, -1)
        result = self._new_value(dtype, total.size)
        if result.size <= UNROLLED:
            result.entries = [self.cast(self.entry(total, place), total.dtype, dtype) for place in range(total.size)]
            for place, number in zip(places, numbers, strict=True):
                entry = self.cast(self.entry(g, int(number)), g.dtype, dtype)
                result.entries[place] = self.builder.fadd(result.entries[place], entry)
            return result
        owner = total.base
        if owner.region is not None and total.places is None and owner.last <= self._position:
            self._close()  # the open loop may read the old numbers
            result.pointer = total.pointer
            result.base = owner
        else:
            self.new_region(result)
            read_total = self.reader(total)
            self._copy(np.arange(total.size), lambda i: self.cast(read_total(i), total.dtype, dtype), result)
        if not places.size:
            return result
        read = self.reader(g, numbers)
        index_of = self._index(places)

        def body(i):
            place = index_of(i)
            entry = self.cast(read(i), g.dtype, dtype)
            self.store(self.builder.fadd(self.load(result.pointer, place, dtype), entry), result.pointer, place, dtype)

        self.loop(places.size, body)
        return result

    # ---- sums and products ----

    def _sum(self, call, function, sample, dtype):
        axis = call.options.get("axis")
        if len(call.args) == 2:
            axis = call.args[1]
        if call.options.keys() - {"axis", "keepdims"} or len(call.args) > 2 or dtype not in "df":
            raise NotCompiled(f"{function.__name__} with options, or of integers")
        value = self._argument(call.args[0])
        shape = np.shape(self._trace.sample(call.args[0]))
        numbers = np.arange(value.size).reshape(shape)
        axes = tuple(range(len(shape))) if axis is None else tuple(np.atleast_1d(axis) % max(len(shape), 1))
        if shape:
            numbers = np.moveaxis(numbers, axes, range(-len(axes), 0))
        result = self._new_value(dtype, np.size(sample))
        rows = numbers.reshape(result.size, -1)
        length = ir.Constant(TYPES[dtype], float(rows.shape[1]))

        def ended(total):
            return self.builder.fdiv(total, length) if function is np.mean else total

        if not rows.size:
            raise NotCompiled(f"{function.__name__} of an array without entries")
        if result.size <= UNROLLED:
            result.entries = []
            for row in rows:
                if row.size <= UNROLLED:
                    entries = [self.cast(self.entry(value, int(place)), value.dtype, dtype) for place in row]
                    result.entries.append(ended(self._added(entries)))
                else:
                    read = self.reader(value, row)
                    total = self._pairwise(lambda i, read=read: self.cast(read(i), value.dtype, dtype), 0, row.size)
                    result.entries.append(ended(total))
            return result
        read = self.reader(value, rows)
        self.new_region(result)

        def body(i):
            def inner(j, total):
                return [self.builder.fadd(total, self.cast(read(i, j), value.dtype, dtype))]

            (total,) = self.loop(rows.shape[1], inner, [ir.Constant(TYPES[dtype], -0.0)])
            self.store(ended(total), result.pointer, i, dtype)

        self.loop(result.size, body)
        return result

    def _added(self, entries):
        total = entries[0]
        for entry in entries[1:]:
            total = self.builder.fadd(total, entry)
        return total

    def _pairwise(self, read, start, n):
        """Return the sum of n entries in the order of NumPy, which adds pairs of partial sums."""
        at = lambda place: read(ir.Constant(INDEX, place))
        if n < 8:
            return self._added([at(start + k) for k in range(n)])
        if n > 128 and n <= MOST_PAIRWISE:
            half = n // 2
            half -= half % 8
            return self.builder.fadd(self._pairwise(read, start, half), self._pairwise(read, start + half, n - half))
        sums = [at(start + k) for k in range(8)]
        if n >= 16:

            def body(i, *sums):
                first = self.builder.add(self.builder.mul(i, ir.Constant(INDEX, 8)), ir.Constant(INDEX, start + 8))
                places = [self.builder.add(first, ir.Constant(INDEX, k)) for k in range(8)]
                return [self.builder.fadd(total, read(place)) for total, place in zip(sums, places, strict=True)]

            sums = self.loop(n // 8 - 1, body, sums)
        while len(sums) > 1:
            sums = [self.builder.fadd(sums[k], sums[k + 1]) for k in range(0, len(sums), 2)]
        return self._added(sums + [at(start + k) for k in range(n - n % 8, n)])

    def _product(self, call, function, dtype):
        args = call.args
        operands = args[1:3] if function is np.einsum else args[:2]
        if len(operands) < 2 or (function is np.einsum and len(args) != 3) or dtype not in "df":
            raise NotCompiled(f"{_name_of(call)} with options")
        shapes = [np.shape(self._trace.sample(arg)) for arg in operands]
        if function is np.einsum and type(args[0]) is not str:
            raise NotCompiled("einsum without a text")
        if any(type(arg) is Slot for arg in args if not any(arg is one for one in operands)):
            raise NotCompiled(f"{_name_of(call)} with options")
        pairs = multiplied_entries(function, args, call.options, shapes)
        first, second = map(self._argument, operands)
        return self._pair_sums(pairs, first, second, dtype)

    def _operator(self, call, dtype):
        """Translate the application of an Operator, by its matrix."""
        operator_, u = call.args
        value = self._argument(u)
        matrix = operator_.matrix.tocsr()
        if dtype != "d" or value.dtype != "d" or matrix.dtype != np.float64 or matrix.nnz > MOST_PRODUCTS:
            raise NotCompiled(f"{_name_of(call)} with this size or dtype")
        pairs = []
        for start, end in zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True):
            pairs.append([(number, int(matrix.indices[number])) for number in range(start, end)])
        return self._pair_sums(pairs, self.constant(matrix.data), value, dtype)

    def _pair_sums(self, pairs, first, second, dtype):
        """Return the value whose entry k is the sum of the products of the entries in pairs[k]."""
        result = self._new_value(dtype, len(pairs))
        zero = ir.Constant(TYPES[dtype], 0.0)
        longest = max(map(len, pairs), default=0)
        if longest == 0:  # such as an operator without entries
            result.entries = [zero]
            result.places = np.zeros(result.size, np.int64)
            return result
        if result.size <= UNROLLED and longest <= UNROLLED:
            result.entries = []
            for row in pairs:
                entries = []
                for a, b in row:
                    x = self.cast(self.entry(first, a), first.dtype, dtype)
                    y = self.cast(self.entry(second, b), second.dtype, dtype)
                    entries.append(self.builder.fmul(x, y))
                result.entries.append(self._added(entries) if entries else zero)
            return result
        lengths = {len(row) for row in pairs}
        flat = np.array([pair for row in pairs for pair in row], np.int64).reshape(-1, 2)
        memory = result
        if result.size <= UNROLLED:
            memory = _Value(dtype, result.size, self._position)
        shape = (result.size, len(pairs[0])) if len(lengths) == 1 and len(pairs[0]) else (len(flat),)
        readers = [self.reader(value, flat[:, side].reshape(shape)) for side, value in enumerate((first, second))]
        self.new_region(memory)

        def product(*indices):
            x, y = (
                self.cast(read(*indices), value.dtype, dtype)
                for read, value in zip(readers, (first, second), strict=True)
            )
            return self.builder.fmul(x, y)

        if len(shape) == 2:

            def row_sum(i):
                (total,) = self.loop(shape[1], lambda j, total: [self.builder.fadd(total, product(i, j))], [zero])
                self.store(total, memory.pointer, i, dtype)

            self.loop(result.size, row_sum)
        else:
            self._copy(np.arange(result.size), lambda i: zero, memory)
            rows = np.repeat(np.arange(result.size), [len(row) for row in pairs])
            index_of = self._index(rows)

            def add_product(i):
                place = index_of(i)
                total = self.builder.fadd(self.load(memory.pointer, place, dtype), product(i))
                self.store(total, memory.pointer, place, dtype)

            self.loop(len(flat), add_product)
        if memory is not result:
            result.entries = [self.load(memory.pointer, place, dtype) for place in range(result.size)]
        return result

    # ---- machine code ----

    def compile(self) -> _Function:
        """Return the compiled function."""
        self.builder.ret_void()
        places = np.concatenate([np.zeros(1, np.int64)[:0], *self._places])
        constants = np.concatenate([np.zeros(0), *self._constants])
        return _Function(str(self.module), len(self.extra), self.memory.sizes, places, constants)


def _source(value):
    """Return the value without its places."""
    if value.places is None:
        return value
    source = _Value(value.dtype, value.size)
    source.entries = value.entries
    source.pointer = value.pointer
    return source


def _dtype_of(sample, name):
    """Return the character of the dtype of a value of a program."""
    if isinstance(sample, float):  # NumPy's float64 is one
        return "d"
    if isinstance(sample, (np.ndarray, np.generic)) and sample.dtype.char in "df?" and sample.dtype.isnative:
        return sample.dtype.char
    if not isinstance(sample, (np.ndarray, np.generic)):
        raise NotCompiled(name)
    raise NotCompiled(f"{name}, which returns {sample.dtype}")


def _without_repetitions(calls):
    """Return the calls without those that repeat an earlier call, and for the results of these the earlier slots."""
    numbers: dict = {}
    aliases: dict[int, int] = {}
    kept = []
    for call in calls:
        args = tuple(
            Slot(aliases[arg.number]) if type(arg) is Slot and arg.number in aliases else arg for arg in call.args
        )
        call = call._replace(args=args)
        key = None
        if not call.has_effect and call.function is not add_at:
            parts = [_key(part) for part in (*args, *call.options.items())]
            if None not in parts:
                key = (_plain_function(call.function), *parts)
        if key in numbers and key is not None:
            aliases[call.result.number] = numbers[key]
            continue
        if key is not None:
            numbers[key] = call.result.number
        kept.append(call)
    return kept, aliases


def _key(part):
    """Return a hashable form of an argument, None if there is none."""
    if type(part) is Slot:
        return Slot, part.number
    if part is None or type(part) in (int, float, bool, str, slice):
        return type(part), repr(part)
    if type(part) is tuple:
        keys = tuple(map(_key, part))
        return None if None in keys else (tuple, keys)
    return None


class _Function:
    """Machine code, with the arrays that it reads.

    Parameters
    ----------
    text : str
        The module of LLVM.
    n_extra : int
        Number of parameters after the common ones.
    sizes : dict
        Entries of memory for each dtype.
    places, constants : arrays
    """

    def __init__(self, text: str, n_extra: int, sizes: dict, places: Any, constants: Any) -> None:
        self._sizes = sizes
        self._kept = places, constants
        self._fixed = places.ctypes.data, constants.ctypes.data
        with _lock:
            machine = _target_machine()
            module = binding.parse_assembly(text)
            module.verify()
            self._engine = binding.create_mcjit_compiler(module, machine)
            self._engine.finalize_object()
            address = self._engine.get_function_address("program")
        self._call = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * (6 + n_extra))(address)

    def memory(self) -> dict:
        """Return new memory for a call."""
        return {dtype: np.empty(size, DTYPES[dtype]) for dtype, size in self._sizes.items() if size}

    def __call__(self, memory: dict, *extra: int) -> bool:
        """Run the function; return whether all checked values were finite."""
        status = ctypes.c_double(0.0)
        addresses = [_address(memory[dtype]) if dtype in memory else 0 for dtype in "df?"]
        self._call(*addresses, *self._fixed, ctypes.addressof(status), *extra)
        return status.value == 0.0


def _target_machine():
    """Return the description of this processor for LLVM.

    LLVM's passes before the generation of code are not run: they take two thirds of the time of a translation, and
    loops of 40 entries do not become faster by them.
    """
    if hasattr(binding, "create_pass_manager_builder"):  # newer versions initialize LLVM themselves
        binding.initialize()
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    target = binding.Target.from_default_triple()
    features = binding.get_host_cpu_features().flatten()
    return target.create_target_machine(cpu=binding.get_host_cpu_name(), features=features, opt=2, jit=True)


# ---- programs --------------------------------------------------------------------------------------------------------


class CompiledProgram:
    """A program as machine code.

    Parameters
    ----------
    parts : tuple
        The arguments of `program.compile_program`.
    recorded : callable
        The program as Python code, which runs instead if some value is not finite.
    agree : callable
        ``agree(a, b)`` returns whether two results are equal up to rounding.
    note : callable
        Called with the reason if the results differ; the recorded program is then used.

    Raises
    ------
    NotCompiled
        If some call cannot be translated.
    """

    def __init__(
        self,
        parts: tuple[ProgramTrace, Sequence[ProgramCall], Sequence[Slot], Sequence[Any]],
        recorded: Callable,
        agree: Callable,
        note: Callable,
    ) -> None:
        trace, calls, inputs, results = parts
        self._recorded = recorded
        self._agree = agree
        self._note = note
        self._is_refused = False
        self._is_checked = False
        translator = _Translator([])
        self._inputs = []
        for slot in inputs:
            sample = trace.sample(slot)
            region = translator.memory.take(_dtype_of(sample, "an argument"), np.size(sample))
            self._inputs.append(region)
            translator.bind(slot, sample, translator.pointer_to(region))
        translator.translate(trace, calls, results)
        self._outputs: list[tuple] = []
        for result in results:
            if type(result) is not Slot:
                self._outputs.append((None, result, None))
                continue
            sample = trace.sample(result)
            region = translator.memory.take(_dtype_of(sample, "a result"), np.size(sample))
            translator.write(result, translator.pointer_to(region), region.dtype)
            shape = sample.shape if isinstance(sample, np.ndarray) else None
            self._outputs.append((region, shape, type(sample)))
        self._run = translator.compile()

    def __call__(self, *values: Any) -> tuple:
        """Return the results as a tuple."""
        if self._is_refused:
            return self._recorded(*values)
        memory = self._run.memory()
        for region, value in zip(self._inputs, values, strict=True):
            if region.size:
                memory[region.dtype][region.offset : region.offset + region.size] = np.reshape(value, -1)
        if not self._run(memory):
            return self._recorded(*values)
        results = tuple(self._result(memory, *output) for output in self._outputs)
        if not self._is_checked:
            expected = self._recorded(*values)
            if not all(map(self._agree, expected, results)):
                self._is_refused = True
                self._note(DIFFERENT)
                return expected
            self._is_checked = True
        return results

    def _result(self, memory, region, shape, kind):
        if region is None:
            return shape
        if shape is None:
            number = memory[region.dtype][region.offset]
            return float(number) if kind is float else number
        if not region.size:
            return np.empty(shape, DTYPES[region.dtype])
        return memory[region.dtype][region.offset : region.offset + region.size].reshape(shape).copy()


class CompiledLoop:
    """All steps of a rollout as two functions of machine code, forward and backward.

    The trajectory of a variable of the state is an array with a row for each state. What the backward pass of a step
    needs, apart from state, params and inputs, is saved by the forward pass.

    Parameters
    ----------
    forward : tuple
        Trace, calls, arguments and results of the program of a step; the values to be saved are the last results.
    backward : tuple or None
        The same for its VJP. Its arguments are the saved values and the cotangents of the results. None for a loop
        without derivatives.
    order : sequence of int
        For each variable of the state its position among the results.
    n_params : int
        Number of variables of params; they follow those of the state among the arguments.
    nums : sequence of int
        Positions of the differentiated arguments, those of the whole state first.
    n_saved : int
        Number of values to be saved.

    Attributes
    ----------
    is_checked : bool
        Whether the loop has been compared with the recorded programs.
    saved_bytes : int
        Memory for the saved values of a step.

    Raises
    ------
    NotCompiled
        If some call cannot be translated.
    """

    DIFFERENT = DIFFERENT

    def __init__(
        self,
        forward: tuple,
        backward: tuple | None,
        order: Sequence[int],
        n_params: int,
        nums: Sequence[int] = (),
        n_saved: int = 0,
    ) -> None:
        trace, _, arguments, results = forward
        self.is_checked = False
        self._nums = nums
        self._trace = trace
        n_state = len(order)
        self._states = arguments[:n_state]
        self._params = arguments[n_state : n_state + n_params]
        self._inputs = arguments[n_state + n_params :]
        self._order = order
        self._forward_parts = forward
        numbers = {slot.number for slot in arguments}
        self._saved = [slot for slot in results[len(results) - n_saved :] if slot.number not in numbers]
        self._saved_sizes = {"d": 0, "f": 0, "?": 0}
        self._saved_places = {}
        for slot in self._saved:
            dtype = _dtype_of(trace.sample(slot), "a saved value")
            self._saved_places[slot.number] = dtype, self._saved_sizes[dtype]
            self._saved_sizes[dtype] += np.size(trace.sample(slot))
        self.saved_bytes = sum(DTYPES[dtype].itemsize * size for dtype, size in self._saved_sizes.items())
        self._param_regions: list = []
        self._backward: Any = None
        if backward is not None:
            self._backward = self._compiled_backward(*backward)
        self._forward = self._compiled_forward()

    # ---- translation ----

    def _size(self, slot):
        return np.size(self._trace.sample(slot))

    def _dtype(self, slot):
        return _dtype_of(self._trace.sample(slot), "an argument")

    def _pointer_type(self, slot):
        return STORED_TYPES[self._dtype(slot)].as_pointer()

    def _bind_params(self, translator):
        """Reserve memory for params at its beginning, the same in both functions."""
        self._param_regions = []
        for slot in self._params:
            region = translator.memory.take(self._dtype(slot), self._size(slot))
            self._param_regions.append(region)
            translator.bind(slot, self._trace.sample(slot), translator.pointer_to(region))

    def _bind_rows(self, translator, slots, pointers, row):
        """Bind arguments whose values in a step are a row of a block."""
        for slot, pointer in zip(slots, pointers, strict=True):
            place = translator.builder.mul(row, ir.Constant(INDEX, self._size(slot)))
            translator.bind(slot, self._trace.sample(slot), translator.shifted(pointer, place))

    def _saved_pointer(self, translator, blocks, slot, step):
        """Return the pointer to a saved value of a step."""
        dtype, offset = self._saved_places[slot.number]
        row = translator.builder.mul(step, ir.Constant(INDEX, self._saved_sizes[dtype]))
        return translator.shifted(translator.shifted(blocks[dtype], row), offset)

    def _compiled_forward(self):
        trace, calls, _, results = self._forward_parts
        types = [self._pointer_type(slot) for slot in (*self._states, *self._inputs)]
        types += [STORED_TYPES[dtype].as_pointer() for dtype in "df?"]
        translator = _Translator([*types, INDEX, INDEX, INDEX])
        builder = translator.builder
        n_state = len(self._states)
        states = translator.extra[:n_state]
        inputs = translator.extra[n_state : n_state + len(self._inputs)]
        blocks = dict(zip("df?", translator.extra[-6:-3], strict=True))
        begin, count, modulus = translator.extra[-3:]
        self._bind_params(translator)

        def body(s):
            step = builder.add(begin, s)
            row = builder.urem(step, modulus)
            next_row = builder.urem(builder.add(step, ir.Constant(INDEX, 1)), modulus)
            self._bind_rows(translator, self._states, states, row)
            self._bind_rows(translator, self._inputs, inputs, step)
            translator.translate(trace, calls, results)
            for slot, pointer, position in zip(self._states, states, self._order, strict=True):
                place = builder.mul(next_row, ir.Constant(INDEX, self._size(slot)))
                translator.write(results[position], translator.shifted(pointer, place), self._dtype(slot))
            for slot in self._saved:
                pointer = self._saved_pointer(translator, blocks, slot, step)
                dtype = self._saved_places[slot.number][0]
                translator.write(slot, pointer, dtype, is_checked=False)

        translator.loop(count, body)
        return translator.compile()

    def _compiled_backward(self, trace, calls, arguments, results):
        n_state = len(self._states)
        types = [self._pointer_type(slot) for slot in (*self._states, *self._inputs)]
        types += [STORED_TYPES[dtype].as_pointer() for dtype in "df?"]
        types += [self._pointer_type(slot) for slot in self._states]  # entering cotangents
        types += [self._pointer_type(slot) for slot in self._inputs]  # cotangents of inputs
        translator = _Translator([*types, DOUBLE.as_pointer(), *[INDEX] * 7])
        builder = translator.builder
        extra = iter(translator.extra)
        states = [next(extra) for _ in self._states]
        inputs = [next(extra) for _ in self._inputs]
        blocks = {dtype: next(extra) for dtype in "df?"}
        entering = [next(extra) for _ in self._states]
        input_cotangents = [next(extra) for _ in self._inputs]
        norms = next(extra)
        n, high, low, first, cut, interval, enters = extra
        self._bind_params(translator)
        self._state_regions = []  # two rows, which alternate
        for slot in self._states:
            self._state_regions.append(translator.memory.take(self._dtype(slot), 2 * self._size(slot)))
        self._sum_regions = []
        for slot in self._params:
            self._sum_regions.append(translator.memory.take(self._dtype(slot), self._size(slot)))
        cotangents = arguments[len(arguments) - n_state :]
        one = ir.Constant(INDEX, 1)

        def cotangent_row(k, step):
            """Return the pointer to the cotangent of a state."""
            row = builder.and_(step, one)
            place = builder.mul(row, ir.Constant(INDEX, self._size(self._states[k])))
            return translator.shifted(translator.pointer_to(self._state_regions[k]), place)

        def body(s):
            step = builder.sub(builder.sub(high, one), s)
            following = builder.add(step, one)
            self._bind_rows(translator, self._states, states, step)
            self._bind_rows(translator, self._inputs, inputs, step)
            for slot in self._saved:
                translator.bind(slot, trace.sample(slot), self._saved_pointer(translator, blocks, slot, step))
            for k, position in enumerate(self._order):
                slot = cotangents[position]
                translator.bind(slot, trace.sample(slot), cotangent_row(k, following))
            translator.translate(trace, calls, results)
            self._write_cotangents(translator, results, step, cotangent_row, input_cotangents)
            self._cut(translator, step, n, cut, cotangent_row)
            is_measured = builder.icmp_signed("==", builder.srem(step, interval), ir.Constant(INDEX, 0))
            with builder.if_then(is_measured):
                self._measure(translator, norms, builder.sdiv(step, interval), step, cotangent_row)
            is_entered = builder.and_(
                builder.icmp_signed("!=", enters, ir.Constant(INDEX, 0)), builder.icmp_signed(">=", step, first)
            )
            with builder.if_then(is_entered):
                for k, slot in enumerate(self._states):
                    self._add_row(translator, slot, cotangent_row(k, step), entering[k], step)

        translator.loop(builder.sub(high, low), body)
        return translator.compile()

    def _write_cotangents(self, translator, results, step, cotangent_row, input_cotangents):
        """Store the cotangents of the state and of the row of inputs, and add the cotangents of params."""
        n_state = len(self._states)
        n_params = len(self._params)
        for k, result in enumerate(results[:n_state]):
            slot = self._states[k]
            result = np.zeros(self._size(slot)) if result is None else result
            translator.write(result, cotangent_row(k, step), self._dtype(slot))
        for position, result in zip(self._nums[n_state:], results[n_state:], strict=True):
            if result is None:
                continue
            if position < n_state + n_params:
                region = self._sum_regions[position - n_state]
                translator.add_to(result, translator.pointer_to(region), region.dtype)
            else:
                k = position - n_state - n_params
                slot = self._inputs[k]
                place = translator.builder.mul(step, ir.Constant(INDEX, self._size(slot)))
                translator.write(result, translator.shifted(input_cotangents[k], place), self._dtype(slot))

    def _cut(self, translator, step, n, cut, cotangent_row):
        """Set the cotangent of the state to zero where truncation treats the state as a constant."""
        builder = translator.builder
        zero = ir.Constant(INDEX, 0)
        period = builder.select(builder.icmp_signed(">", cut, zero), cut, ir.Constant(INDEX, 1))
        is_multiple = builder.icmp_signed("==", builder.srem(builder.sub(n, step), period), zero)
        is_inside = builder.and_(builder.icmp_signed(">", cut, zero), builder.icmp_signed(">", step, zero))
        with builder.if_then(builder.and_(is_inside, is_multiple)):
            for k, slot in enumerate(self._states):
                dtype = self._dtype(slot)
                row = cotangent_row(k, step)
                empty = ir.Constant(TYPES[dtype], 0.0)
                if self._size(slot):
                    translator.loop(
                        self._size(slot),
                        lambda i, row=row, dtype=dtype, empty=empty: translator.store(empty, row, i, dtype),
                    )

    def _measure(self, translator, norms, place, step, cotangent_row):
        """Store the largest magnitude of the cotangent of a state."""
        builder = translator.builder
        largest = ir.Constant(DOUBLE, 0.0)
        for k, slot in enumerate(self._states):
            dtype = self._dtype(slot)
            row = cotangent_row(k, step)
            if self._size(slot):

                def body(i, largest, row=row, dtype=dtype):
                    entry = translator.cast(translator.load(row, i, dtype), dtype, "d")
                    return [_maximum(builder, FLOATING[np.absolute](builder, entry), largest)]

                (largest,) = translator.loop(self._size(slot), body, [largest])
        translator.store(largest, norms, place, "d")

    def _add_row(self, translator, slot, row, block, step):
        """Add a row of a block of entering cotangents to the cotangent of a state."""
        builder = translator.builder
        dtype = self._dtype(slot)
        if not self._size(slot):
            return
        source = translator.shifted(block, builder.mul(step, ir.Constant(INDEX, self._size(slot))))

        def body(i):
            total = builder.fadd(translator.load(row, i, dtype), translator.load(source, i, dtype))
            translator.store(total, row, i, dtype)

        translator.loop(self._size(slot), body)

    # ---- runs ----

    def trajectories(self, states: Sequence, rows: int) -> list:
        """Return an array for each variable of the state, the first row of which is its first value."""
        blocks = []
        for slot, value in zip(self._states, states, strict=True):
            block = np.empty((rows, *np.shape(value)), DTYPES[self._dtype(slot)])
            block[0] = value
            blocks.append(block)
        return blocks

    def saved_blocks(self, n: int) -> dict:
        """Return memory for the saved values of n steps."""
        return {dtype: np.empty((n, size), DTYPES[dtype]) for dtype, size in self._saved_sizes.items()}

    def _memory(self, function, params):
        memory = function.memory()
        for region, value in zip(self._param_regions, params, strict=True):
            if region.size:
                memory[region.dtype][region.offset : region.offset + region.size] = np.reshape(value, -1)
        return memory

    def forward(
        self, trajectories: list, params: Sequence, inputs: Sequence, saved: dict, begin: int, count: int
    ) -> bool:
        """Run `count` steps from state `begin`; return whether all states are finite.

        State i is in row ``i % rows`` of the trajectories.
        """
        memory = self._memory(self._forward, params)
        blocks = [*trajectories, *inputs, *(saved[dtype] for dtype in "df?")]
        return self._forward(memory, *map(_address, blocks), begin, count, len(trajectories[0]))

    def backward(
        self,
        trajectories: list,
        params: Sequence,
        inputs: Sequence,
        saved: dict,
        cotangents: Sequence,
        entering: Sequence | None,
        n: int,
        low: int,
        first: int,
        cut: int,
        interval: int,
    ) -> tuple[list, list, Any] | None:
        """Run the backward pass from state n to state `low`.

        Parameters
        ----------
        trajectories, params, inputs, saved
            Those of the forward pass; the trajectories have all states.
        cotangents : sequence of arrays
            Cotangents of the variables of the last state.
        entering : sequence of arrays or None
            For each variable of the state an array with the cotangents that enter at each state.
        n, low : int
        first : int
            Cotangents enter from this state on.
        cut : int
            Number of steps after which the cotangent is cut, counted from the last state; 0 for no cut.
        interval : int
            The largest magnitude of the cotangent is measured at states whose index is a multiple of this number.

        Returns
        -------
        cotangents : list of arrays
            Those of state `low`, then those of params; zero for what is not differentiated.
        input_cotangents : list of arrays
        norms : array
            The magnitudes that were measured. It is undefined for states below `low`.

        None if a value is not finite.
        """
        memory = self._memory(self._backward, params)
        for region, value in zip(self._state_regions, cotangents, strict=True):
            size = region.size // 2
            start = region.offset + size * (n % 2)
            if size:
                memory[region.dtype][start : start + size] = np.reshape(value, -1)
        for region in self._sum_regions:
            if region.size:
                memory[region.dtype][region.offset : region.offset + region.size] = 0.0
        input_cotangents = [np.zeros_like(block) for block in inputs]
        norms = np.zeros(n // interval + 1)
        blocks = [*trajectories, *inputs, *(saved[dtype] for dtype in "df?"), *(entering or trajectories)]
        blocks += [*input_cotangents, norms]
        numbers = n, n, low, first, cut, interval, int(entering is not None)
        if not self._backward(memory, *map(_address, blocks), *numbers):
            return None
        backs = []
        for slot, region in zip(self._states, self._state_regions, strict=True):
            size = region.size // 2
            start = region.offset + size * (low % 2)
            backs.append(self._array(memory, region.dtype, start, size, slot))
        for slot, region in zip(self._params, self._sum_regions, strict=True):
            backs.append(self._array(memory, region.dtype, region.offset, region.size, slot))
        return backs, input_cotangents, norms

    def _array(self, memory, dtype, start, size, slot):
        """Return a copy of a part of the memory in the shape of an argument."""
        shape = np.shape(self._trace.sample(slot))
        if not size:
            return np.zeros(shape, DTYPES[dtype])
        return memory[dtype][start : start + size].reshape(shape).copy()[()]


def _address(array):
    """Return the address of the entries of a contiguous array."""
    return array.__array_interface__["data"][0]
