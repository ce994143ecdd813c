"""How a compiled loop is made and run: one signature each, kept on disk, slabs of rows for a pool of threads.

Threads are Python's own: a loop gives the lock back while it runs, and compiles in a fraction of the time that
numba takes for its own parallel loops. Which slab a row is in changes nothing in its bits.
"""

import contextlib
import functools
import os
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from types import FunctionType

__all__ = ["INNER", "SERIAL", "Kernel", "kernel", "loops"]

SERIAL = 524_288  # numbers: below, a few tenths of a millisecond, a second thread costs more than it brings

# Of functions that only compiled ones call: Python could not call them, which saves compiling how it would.
INNER = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

loops: list["Kernel"] = []  # all that the imported modules define

NOTICE = "sparsedp: compiling loops for this machine, once; `python -m sparsedp compile` does all of them\n"
_noticed: list[bool] = []


@contextlib.contextmanager
def _announced():
    """Meanwhile, the first function that is not found on disk and has to be compiled is announced on stderr."""
    from numba.core import event

    class Notice(event.Listener):
        def on_start(self, _):
            if not _noticed:
                _noticed.append(True)
                sys.stderr.write(NOTICE)

        def on_end(self, _):
            pass

    with event.install_listener("numba:compile", Notice()):
        yield


@functools.cache
def _pool(size, process):
    """The threads beside the one that asks; they wait between loops. A forked process has none of its parent's."""
    return ThreadPoolExecutor(size, "sparsedp")


def _types(words):
    """Words such as "read3 write1 real int flag" -> types of numba; see `Kernel`."""
    from numba import types

    numbers = {"int": types.int64, "real": types.float64, "flag": types.boolean}
    entries = {
        "read": types.float64,
        "write": types.float64,
        "index": types.int64,
        "place": types.int32,
        "mask": types.boolean,
    }
    marked = {"^": types.float32, "*": types.complex128}
    for word in words.split():
        kind, axes = word.strip("~^+*")[:-1], word[-1]
        entry = marked.get(word[0]) or entries.get(kind)
        yield numbers.get(word) or types.Array(entry, int(axes), "C", readonly=kind != "write")


@functools.cache
def _with_compiled(functions):
    """Functions of a module -> its names, with these functions compiled: they stand where they are called."""
    from numba import njit

    names = dict(functions[0].__globals__)
    for function in functions:
        own = FunctionType(function.__code__, names, function.__name__)
        names[function.__name__] = njit(forceinline=True, fastmath={"contract"}, **INNER)(own)
    return names


def kernel(words, **options):
    """Decorator: the types of a loop's arguments but the last two -> Kernel."""
    return lambda loop: Kernel(loop, words, **options)


class Kernel:
    """A loop over C-contiguous arrays that numba compiles at its first use.

    Parameters
    ----------
    loop : function
        Its last two arguments are the rows it works on, `start` and `stop`.
    words : str
        The types of its other arguments: read1 to read4 (may be read-only), write1 to write4 (float64), index1 to
        index4 (int64), place1 to place4 (int32, may be read-only), mask1 to mask4 (bool), real, int, flag. With ~
        before it an array is of float32 in `single`, where ^ stands for it; with + of complex128 in `complex`, where
        * stands for it.
    uses : tuple of functions
        That the loop calls, and these functions themselves. They are compiled once for all loops that use them, and
        stand in the same file: that is where numba looks whether what it has kept is still good.
    given : dict, optional
        {name: function} that this loop alone calls by that name.
    name : str, optional
        Tells loops of the same code that are given other functions apart.
    **options
        Of numba's ``njit``.

    Attributes
    ----------
    single : Kernel
        The same loop for arrays of float32, where its words have a ~.
    complex : Kernel
        The same loop for arrays of complex128, where its words have a +.
    """

    def __init__(self, loop, words, uses=(), given=None, name=None, **options):
        self.loop, self.words, self.uses, self.given, self.options = loop, words, uses, given or {}, options
        self.name, self.__doc__ = name or loop.__name__, loop.__doc__
        self.single = Kernel(loop, words.replace("~", "^"), uses, given, name, **options) if "~" in words else self
        self.complex = Kernel(loop, words.replace("+", "*"), uses, given, name, **options) if "+" in words else self
        loops.append(self)

    @functools.cached_property
    def compiled(self):
        """The compiled loop; None where it cannot be compiled, which is said once."""
        try:
            from numba import njit

            options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **self.options}
            keep = options.pop("cache", True)
            signature = tuple(_types(self.words + " int int"))
            names = dict(_with_compiled(self.uses) if self.uses else self.loop.__globals__)
            for name, function in self.given.items():
                names[name] = njit(forceinline=True, **options)(function)
            loop = FunctionType(self.loop.__code__, names, self.name)
            loop.__qualname__ = self.name  # the kept code goes by it
            with _announced():
                try:
                    return njit([signature], cache=keep, **options)(loop)
                except (OSError, RuntimeError):  # there is no place to keep it
                    return njit([signature], **options)(loop)
        except Exception as error:  # whatever LLVM or numba object to on this machine
            message = f"The compiled kernels do not work here ({error}); NumPy is used instead."
            warnings.warn(message, RuntimeWarning, stacklevel=4)
            return None

    def run(self, rows, work, threads, *args):
        """loop(*args, start, stop) on slabs that cover range(rows); one thread for less than SERIAL numbers of work.

        Raises what a slab raises, when all have ended: nobody writes into the arrays after that.
        """
        parts = min(threads, rows) if work >= SERIAL else 1
        if parts <= 1:
            self.compiled(*args, 0, rows)
            return
        cuts = [rows * part // parts for part in range(parts + 1)]
        others = [_pool(parts - 1, os.getpid()).submit(self.compiled, *args, *ends) for ends in zip(cuts[1:], cuts[2:])]
        try:
            self.compiled(*args, *cuts[:2])
        finally:
            for other in others:
                other.result()
