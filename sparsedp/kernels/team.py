"""Compilation and execution of compiled loops. Each has one signature, is cached on disk and runs on a thread pool.

The threads are Python threads; a loop releases the GIL while it runs. Such a loop compiles in a fraction of the time
that numba needs for its own parallel loops. The results are bit-identical for every number of threads.
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

# Number of values below which one thread is used. They take a few tenths of a millisecond, and starting a second thread
# costs more time than it saves.
SERIAL = 524_288

# Options of functions that are called only by compiled functions. Without wrappers for Python they compile faster.
INNER = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

loops: list[Kernel] = []  # all loops that are defined in modules imported so far

NOTICE = "sparsedp: compiling loops and storing them for later runs; `python -m sparsedp compile` compiles all loops\n"
_noticed: list[bool] = []

# If two threads create the same type at the same time, numba assigns two type codes to it and then does not find the
# compiled signature for its arguments. This lock prevents that.
_type_creation = RLock()


@contextlib.contextmanager
def _compilation_notice() -> Iterator[None]:
    """Print NOTICE on stderr when a function is compiled in this context, once in a process."""
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
    """Return the pool of threads that work in addition to the calling one. It is kept between loops.

    `process` is the process id: a forked process gets a new pool, because threads do not survive a fork.
    """
    return ThreadPoolExecutor(size, "sparsedp")


def _types(words: str) -> Iterator[Any]:
    """Yield the numba types for a string such as "read3 write1 real int flag"; see `Kernel`."""
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
    """Return an example argument of a numba type. An array is empty, and read-only unless `writable`."""
    from numba.np.numpy_support import as_dtype

    if not hasattr(kind, "ndim"):
        return as_dtype(kind).type(0).item()
    array = np.empty((0,) * kind.ndim, as_dtype(kind.dtype))
    array.flags.writeable = writable
    return array


@functools.cache
def _with_compiled(functions: tuple[Callable, ...]) -> dict[str, Any]:
    """Return a copy of the globals of a module in which the given functions are compiled and will be inlined."""
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
        Passed to `Kernel`.
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
        The types of the other arguments. Arrays, ending with the number of dimensions: read1 to read4 (float64), write1
        to write4 (float64), index1 to index4 (int64), place1 to place4 (int32) and mask1 to mask4 (bool); all except
        write1 to write4 may be read-only. Scalars: real, int and flag (bool). A prefix ~ marks arrays that have
        dtype float32 in `single`, which replaces it by ^. A prefix + marks arrays that have dtype complex128 in
        `complex`, which replaces it by *.
    uses : tuple of functions
        The functions that the loop calls, including those that they call. They are compiled once for all loops that
        use them, and must be in the same file as the loop: numba invalidates its cache by the time stamp of that file.
    functions : dict, optional
        {name: function}. The loop calls these functions by these names; other loops may use the names for other
        functions.
    name : str, optional
        Name of the loop, to distinguish loops with the same code but different `functions`.
    **options
        Passed to numba's ``njit``.

    Attributes
    ----------
    single : Kernel
        The same loop with float32 for the arrays that `words` marks with ~.
    complex : Kernel
        The same loop with complex128 for the arrays that `words` marks with +.
    """

    single: Kernel
    complex: Kernel

    def __init__(
        self,
        loop: Callable,
        words: str,
        uses: tuple[Callable, ...] = (),
        functions: dict[str, Callable] | None = None,
        name: str | None = None,
        **options: Any,
    ) -> None:
        self.loop = loop
        self.words = words
        self.uses = uses
        self.functions = functions or {}
        self.options = options
        self.name = name or loop.__name__
        self.__doc__ = loop.__doc__
        self._dispatcher: Any = None
        self._is_compiled = False
        self.single = self
        self.complex = self
        if "~" in words:
            self.single = Kernel(loop, words.replace("~", "^"), uses, functions, name, **options)
        if "+" in words:
            self.complex = Kernel(loop, words.replace("+", "*"), uses, functions, name, **options)
        loops.append(self)

    @property
    def compiled(self) -> Any:
        """The compiled loop. If compilation fails, a warning is issued once and the value is None."""
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
        except Exception as error:  # whatever LLVM or numba raises on this machine
            message = f"The compiled kernels do not work here ({error}); NumPy is used instead."
            warnings.warn(message, RuntimeWarning, stacklevel=5)
            return None

    def _compile(self) -> Any:
        from numba import njit

        options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **self.options}
        use_cache = options.pop("cache", True)
        signature = tuple(_types(self.words + " int int"))
        names = dict(_with_compiled(self.uses) if self.uses else self.loop.__globals__)
        for name, function in self.functions.items():
            names[name] = njit(forceinline=True, **options)(function)
        loop = FunctionType(self.loop.__code__, names, self.name)
        loop.__qualname__ = self.name  # numba uses it as the key of its cache
        with _compilation_notice():
            try:
                return njit([signature], cache=use_cache, **options)(loop)
            except (OSError, RuntimeError):  # no directory for the cache is writable
                return njit([signature], **options)(loop)

    def _register_types(self, dispatcher: Any) -> None:
        """Let numba create and store the types of all arguments, writable and read-only, without running the loop.

        The loop is called with strings as its last two arguments. numba determines the types of the arguments before it
        looks for a signature; it finds none for strings and raises TypeError.
        """
        for writable in (True, False):
            arguments = [_example(kind, writable) for kind in _types(self.words)]
            with contextlib.suppress(TypeError):
                dispatcher(*arguments, "start", "stop")

    def run_all(self, rows: int, work: int, threads: Any, args: tuple) -> bool:
        """Run the loop over range(rows) if it is available, and return whether it is.

        The parameters are those of `run`; `threads` may also be a function that returns the number of threads.
        """
        loop = self._dispatcher or self.compiled
        if loop is None:
            return False
        if work < SERIAL:
            loop(*args, 0, rows)
        else:
            self.run(rows, work, threads() if callable(threads) else threads, *args)
        return True

    def over(self, rows: int, work: int, threads: Any) -> Callable[..., bool]:
        """Return a function ``act(*args)`` that does what `run_all` does, with less overhead."""
        loop = self.compiled
        if loop is None:
            return lambda *args: False
        if work >= SERIAL:
            return lambda *args: self.run_all(rows, work, threads, args)

        def act(*args):
            loop(*args, 0, rows)
            return True

        return act

    def run(self, rows: int, work: int, threads: int, *args: Any) -> None:
        """Run the loop over range(rows), split into one part for each thread; on one thread if `work` is below SERIAL.

        An exception in one part is raised only after all parts have ended, so that no thread still writes into the
        arrays.

        Parameters
        ----------
        rows : int
        work : int
            Number of values to process.
        threads : int
            Maximum number of threads.
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
