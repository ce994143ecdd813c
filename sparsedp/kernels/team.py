"""Compilation and execution of compiled loops: one signature each, cached on disk, run by a pool of threads.

Threads are Python's own: a loop releases the GIL while it runs, and compiles in a fraction of the time that numba needs
for its own parallel loops. The distribution of rows over threads does not change the bits of a result.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from threading import RLock
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = ["INNER", "SERIAL", "Kernel", "kernel", "loops"]

SERIAL = 524_288  # values: below, a few tenths of a millisecond, a second thread costs more than it saves

# Options of functions that only compiled ones call: without the wrappers for calls from Python they compile faster.
INNER = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

loops: list[Kernel] = []  # all loops that the imported modules define

NOTICE = "sparsedp: compiling loops for this machine, once; `python -m sparsedp compile` does all of them\n"
_noticed: list[bool] = []

# numba gives one type two numbers where two threads create it at once, and then finds no signature for its arguments.
_type_creation = RLock()


@contextlib.contextmanager
def _announced() -> Iterator[None]:
    """Within this context, announce on stderr the first function that is not cached on disk and must be compiled."""
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
def _pool(size: int, process: int) -> ThreadPoolExecutor:
    """Return the threads beside the calling one, which wait between loops; a forked process gets new threads."""
    return ThreadPoolExecutor(size, "sparsedp")


def _types(words: str) -> Iterator[Any]:
    """Yield the numba types for words such as "read3 write1 real int flag"; see `Kernel`."""
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
        if word in numbers:
            yield numbers[word]
            continue
        kind = word.strip("~^+*")[:-1]
        dimensions = int(word[-1])
        entry = marked.get(word[0]) or entries[kind]
        yield types.Array(entry, dimensions, "C", readonly=kind != "write")


def _example(kind: Any, writable: bool) -> Any:
    """Return an argument of a numba type; an array is empty and read-only unless `writable`."""
    from numba.np.numpy_support import as_dtype

    if not hasattr(kind, "ndim"):
        return as_dtype(kind).type(0).item()
    array = np.empty((0,) * kind.ndim, as_dtype(kind.dtype))
    array.flags.writeable = writable
    return array


@functools.cache
def _with_compiled(functions: tuple[Callable, ...]) -> dict[str, Any]:
    """Return the globals of a module in which some of its functions are compiled, to be inlined where called."""
    from numba import njit

    names = dict(functions[0].__globals__)
    for function in functions:
        copy = FunctionType(function.__code__, names, function.__name__)
        names[function.__name__] = njit(forceinline=True, fastmath={"contract"}, **INNER)(copy)
    return names


def kernel(words: str, **options: Any) -> Callable[[Callable], Kernel]:
    """Return a decorator that turns a loop into a `Kernel`.

    Parameters
    ----------
    words : str
        Types of the arguments of the loop except the last two; see `Kernel`.
    **options
        As for `Kernel`.
    """

    def decorate(loop: Callable) -> Kernel:
        return Kernel(loop, words, **options)

    return decorate


class Kernel:
    """A loop over C-contiguous arrays that numba compiles at its first use.

    Parameters
    ----------
    loop : function
        Its last two arguments are the range of rows to work on, `start` and `stop`.
    words : str
        The types of its other arguments: read1 to read4 (float64, may be read-only), write1 to write4 (float64), index1
        to index4 (int64), place1 to place4 (int32, may be read-only), mask1 to mask4 (bool), real, int, flag. An array
        marked with ~ is of float32 in `single`, where ^ replaces the mark. An array marked with + is of complex128 in
        `complex`, where * replaces the mark.
    uses : tuple of functions
        The functions that the loop calls, including those that they call. They are compiled once for all loops that
        use them, and must be in the same file as the loop: numba invalidates its cache by the time stamp of that file.
    given : dict, optional
        {name: function} for functions that only this loop calls by that name.
    name : str, optional
        Distinguishes loops with the same code and other `given` functions.
    **options
        Of numba's ``njit``.

    Attributes
    ----------
    single : Kernel
        The same loop for arrays of float32 where its words have a ~.
    complex : Kernel
        The same loop for arrays of complex128 where its words have a +.
    """

    single: Kernel
    complex: Kernel

    def __init__(
        self,
        loop: Callable,
        words: str,
        uses: tuple[Callable, ...] = (),
        given: dict[str, Callable] | None = None,
        name: str | None = None,
        **options: Any,
    ) -> None:
        self.loop = loop
        self.words = words
        self.uses = uses
        self.given = given or {}
        self.options = options
        self.name = name or loop.__name__
        self.__doc__ = loop.__doc__
        self._dispatcher: Any = None
        self._is_compiled = False
        self.single = self
        self.complex = self
        if "~" in words:
            self.single = Kernel(loop, words.replace("~", "^"), uses, given, name, **options)
        if "+" in words:
            self.complex = Kernel(loop, words.replace("+", "*"), uses, given, name, **options)
        loops.append(self)

    @property
    def compiled(self) -> Any:
        """The compiled loop; None, after one warning, if it cannot be compiled."""
        if not self._is_compiled:
            with _type_creation:
                if not self._is_compiled:
                    self._dispatcher = self._compile_or_warn()
                    self._is_compiled = True
        return self._dispatcher

    def _compile_or_warn(self) -> Any:
        try:
            dispatcher = self._compile()
            self._register_types(dispatcher)
            return dispatcher
        except Exception as error:  # any problem of LLVM or numba on this machine
            message = f"The compiled kernels do not work here ({error}); NumPy is used instead."
            warnings.warn(message, RuntimeWarning, stacklevel=5)
            return None

    def _compile(self) -> Any:
        from numba import njit

        options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **self.options}
        use_cache = options.pop("cache", True)
        signature = tuple(_types(self.words + " int int"))
        names = dict(_with_compiled(self.uses) if self.uses else self.loop.__globals__)
        for name, function in self.given.items():
            names[name] = njit(forceinline=True, **options)(function)
        loop = FunctionType(self.loop.__code__, names, self.name)
        loop.__qualname__ = self.name  # the cache is keyed by it
        with _announced():
            try:
                return njit([signature], cache=use_cache, **options)(loop)
            except (OSError, RuntimeError):  # there is no place for the cache
                return njit([signature], **options)(loop)

    def _register_types(self, dispatcher: Any) -> None:
        """Let numba create and store the types of all arguments, writable and read-only, without running the loop.

        It determines the types of a call before it looks for a signature, and no signature has two strings at its end.
        """
        for writable in (True, False):
            arguments = [_example(kind, writable) for kind in _types(self.words)]
            with contextlib.suppress(TypeError):
                dispatcher(*arguments, "start", "stop")

    def run(self, rows: int, work: int, threads: int, *args: Any) -> None:
        """Call the loop on slabs that cover range(rows), on one thread for less than SERIAL values of work.

        An exception of a slab is raised when all slabs have ended: no thread writes into the arrays after that.

        Parameters
        ----------
        rows : int
        work : int
            Number of values to process.
        threads : int
            Largest number of threads.
        *args
            Arguments of the loop except the last two.
        """
        parts = 1
        if work >= SERIAL:
            parts = min(threads, rows)
        if parts <= 1:
            self.compiled(*args, 0, rows)
            return
        cuts = [rows * part // parts for part in range(parts + 1)]
        pool = _pool(parts - 1, os.getpid())
        futures = [pool.submit(self.compiled, *args, *ends) for ends in zip(cuts[1:], cuts[2:])]
        try:
            self.compiled(*args, *cuts[:2])
        finally:
            for future in futures:
                future.result()
