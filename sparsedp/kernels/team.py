"""How a compiled loop is made and run: one signature each, kept on disk, slabs of rows for a pool of threads.

Threads are Python's own: a loop gives the lock back while it runs, and compiles in a fraction of the time that
numba takes for its own parallel loops. Which slab a row is in changes nothing in its bits.
"""

import contextlib
import os
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

__all__ = ["SERIAL", "Kernel", "kernel", "loops"]

SERIAL = 1 << 19  # numbers: below, a few tenths of a millisecond, a second thread costs more than it brings

_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}  # by process (a forked child has none of the threads) and size


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


def _pool(size):
    """The threads beside the one that asks; they wait between loops."""
    key = os.getpid(), size
    if key not in _pools:
        _pools[key] = ThreadPoolExecutor(size, "sparsedp")
    return _pools[key]


def _types(words, narrow):
    """Words such as "read3 write1 real int flag" -> types of numba; see `Kernel`."""
    from numba import types

    found = {"int": types.int64, "real": types.float64, "flag": types.boolean}
    kinds = {"": types.float64, "~": types.float32 if narrow else types.float64}
    for dimensions in (1, 2, 3, 4):
        for mark, kind in kinds.items():
            found[f"{mark}read{dimensions}"] = types.Array(kind, dimensions, "C", readonly=True)
            found[f"{mark}write{dimensions}"] = types.Array(kind, dimensions, "C")
        found[f"index{dimensions}"] = types.Array(types.int64, dimensions, "C", readonly=True)
    return [found[word] for word in words.split()]


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
        The types of its other arguments: read1 to read3 (may be read-only), write1 to write3 (float64), index1 to
        index3 (int64), real, int, flag. With ~ before it an array is of float32 in `single`.
    narrow : bool
        Whether such arrays are of float32 here.
    **options
        Of numba's ``njit``.

    Attributes
    ----------
    single : Kernel
        The same loop for arrays of float32, where its words have a ~.
    """

    def __init__(self, loop, words, narrow=False, **options):
        self.loop, self.words, self.options, self.__doc__ = loop, words, options, loop.__doc__
        self.narrow = narrow
        self.single = Kernel(loop, words, True, **options) if "~" in words and not narrow else self
        loops.append(self)

    @cached_property
    def compiled(self):
        """The compiled loop; None where it cannot be compiled, which is said once."""
        try:
            from numba import njit

            options = {"nogil": True, "error_model": "numpy", **self.options}
            signature = tuple(_types(self.words + " int int", self.narrow))
            with _announced():
                try:
                    return njit([signature], cache=True, **options)(self.loop)
                except (OSError, RuntimeError):  # there is no place to keep it
                    return njit([signature], **options)(self.loop)
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
        others = [_pool(parts - 1).submit(self.compiled, *args, *ends) for ends in zip(cuts[1:], cuts[2:])]
        try:
            self.compiled(*args, *cuts[:2])
        finally:
            for other in others:
                other.result()
