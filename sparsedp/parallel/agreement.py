"""Checks that all ranks perform the same operations, and exceptions that are raised on all ranks together.

Each communication begins with one MPI_Allgather, in which every rank sends 32 bytes: its mark (8 bytes) and up to 24
bytes of data, such as a number to be reduced. The mark is a checksum of everything that must be the same on all ranks
(calls, numbers, arrays), or a code which says that an exception was raised on this rank. Therefore

- if one rank raises an exception, the others learn of it in the next communication, and all ranks raise it;
- if ranks use different random numbers or take different branches, the next communication raises an error;
- a reduction needs a single communication, as it would without these checks.
"""

from __future__ import annotations

import pickle
import sys
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest
from numbers import Number
from threading import Timer
from types import TracebackType
from typing import Any
from zlib import crc32

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray

from sparsedp._utils.counters import count
from sparsedp._utils.pytree import labels, leaves
from sparsedp.autodiff.backend import folded
from sparsedp.autodiff.tape import sample

__all__ = ["Agreement", "end_all", "end_all_after_error", "state"]

DATA_BYTES = 24  # bytes of data in a message, in addition to the mark
FAILED = (-1).to_bytes(8, "little", signed=True)  # the mark of a rank that raised an exception
# A failed rank aborts the program after this number of seconds if others, perhaps inside PETSc, do not answer.
ABORT_AFTER = 15.0


@dataclass
class ProcessState:
    """The state of the communication in this process.

    Attributes
    ----------
    messages : int
        Number of messages so far.
    last : Agreement or None
        The Agreement that was created or used last.
    messages_before_call : int or None
        Number of messages before the outermost call of `together` that is running; None if there is none.
    unrecorded : list of tuples
        (name, arguments) of running calls of `together` that have not been added to a mark yet.
    """

    messages: int = 0
    last: Agreement | None = None
    messages_before_call: int | None = None
    unrecorded: list[tuple[str, Any]] = field(default_factory=list)


state = ProcessState()


class Agreement:
    """Communication between the ranks of a communicator, with checks that all ranks perform the same operations.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    where : str
        Description of this rank, which is added to the messages of its exceptions.
    """

    def __init__(self, comm: MPI.Comm, where: str) -> None:
        self.comm = comm
        self.where = where
        state.last = self
        self._mark = 0
        self._log: deque = deque(maxlen=100)  # (label, mark) of each call of `record` since the last message
        self._sent = np.zeros(8 + DATA_BYTES, np.uint8)
        self._received = np.zeros((comm.size, 8 + DATA_BYTES), np.uint8)

    # ------------------------------------------------------------ checks that ranks agree

    def record(self, label: str, content: bytes) -> None:
        """Add an action or argument to the mark of this rank. The next message compares the marks of all ranks."""
        while state.unrecorded:
            name, arguments = state.unrecorded.pop(0)
            for number, tree in enumerate(arguments):
                self.record_leaves(f"argument {number}", name, tree)
        self._mark = crc32(content, self._mark)
        self._log.append((label, self._mark))

    def record_leaves(self, root: str, what: str, tree: Any) -> None:
        """Add the numbers, arrays and strings of a tree to the mark; distributed fields need no comparison."""
        for name, leaf in zip(labels(tree, root), leaves(tree)):
            value = sample(leaf)
            if isinstance(value, (Number, np.ndarray, np.generic, str)):
                self.record(f"{name} of {what}", folded(np.asarray(value)))

    def synchronize(self, label: str, content: bytes = b"") -> bytes:
        """Exchange one message between all ranks; return the bytes `content` of all ranks, in the order of the ranks.

        Raises
        ------
        Exception
            If a rank has failed: the exception of the lowest failed rank, on all ranks.
        ValueError
            If the marks of the ranks differ.
        """
        self.record(label, label.encode())
        mark = self._mark.to_bytes(8, "little")
        marks = self._send(mark, content)
        if marks == mark * self.comm.size:
            self._log.clear()
        elif FAILED in (marks[k : k + 8] for k in range(0, len(marks), 8)):
            self._raise_together()
        else:
            self._refuse()
        return self._received[:, 8 : 8 + len(content)].tobytes()

    def _send(self, head: bytes, content: bytes) -> bytes:
        """Send a mark and some bytes to all ranks; return the marks of all ranks."""
        state.messages += 1
        state.last = self
        self._sent[: 8 + len(content)] = np.frombuffer(head + content, np.uint8)
        self.comm.Allgather(self._sent, self._received)
        return self._received[:, :8].tobytes()

    def _refuse(self):
        """Raise ValueError, with the first difference between the logs of the ranks in its message."""
        logs = zip_longest(*self.comm.allgather(list(self._log)), fillvalue=("nothing", 0))
        entries = next(entries for entries in logs if len(set(entries)) > 1)
        rank = next(rank for rank, entry in enumerate(entries) if entry != entries[0])
        first = entries[0][0]
        other = entries[rank][0]
        self._forget()
        if first == other:
            message = (
                f"{first} is not the same on rank {rank} as on rank 0; give all ranks the same numbers, random ones by "
                "the same seed"
            )
        else:
            message = (
                f"rank {rank} has {other}, rank 0 has {first}; write no branches that depend on the number of the "
                "rank, on a clock or on numbers of one rank"
            )
        raise _marked(ValueError(message))

    def _forget(self):
        """Reset the mark and the log."""
        self._mark = 0
        self._log.clear()

    # ------------------------------------------------------------ reductions

    def reduce(self, number: ArrayLike, act: np.ufunc) -> Any:
        """Reduce a number or array over all ranks by a ufunc, in the order of the ranks.

        The result is therefore bitwise the same on all ranks.
        """
        count("ranks", "reduction")
        number = np.asarray(number)
        content = number.tobytes()
        label = f"{act.__name__} of shape {number.shape}, {number.dtype}"
        if len(content) <= DATA_BYTES:
            contents = self.synchronize(label, content)
        else:
            contents = b"".join(self.gather(content, label))
        numbers: NDArray = np.ndarray((self.comm.size, *number.shape), number.dtype, contents)
        return act.reduce(numbers, axis=0)[()]

    def gather(self, value: Any, label: str = "gather") -> list[Any]:
        """Return a list of the values of all ranks, on every rank."""
        self.synchronize(label)
        return self.comm.allgather(value)

    # ------------------------------------------------------------ errors

    def run(self, label: str, act: Callable, *args: Any, at_once: bool = False) -> Any:
        """Call ``act(*args)``. If it raises an exception on one rank, raise the exception on all ranks.

        Inside `together`, the outermost call communicates the exception to the other ranks. With `at_once` it is
        communicated here; this is needed if the caller catches the exception and continues.
        """
        informs = at_once or state.messages_before_call is None
        try:
            result = act(*args)
        except Exception as error:
            if informs:
                self.fail(error)
            if not hasattr(error, "on_all_ranks"):
                self.record(f"an error in {label}", b"failed")  # if a caller catches it, the marks differ
            raise
        if informs:
            self.synchronize(label)
        return result

    def fail(self, error: Exception) -> None:
        """Raise the exception of the lowest failed rank on all ranks, with the number of the rank in its message."""
        if hasattr(error, "on_all_ranks"):
            raise error
        watch = Timer(ABORT_AFTER, end_all, (type(error), error, error.__traceback__))
        watch.daemon = True
        watch.start()
        self._send(FAILED, b"")
        self._raise_together(error, watch)

    def _raise_together(self, error=None, watch=None):
        """Exchange the exceptions of all ranks and raise the first. `error` is None on a rank that has not failed."""
        entry = None
        if error is not None:
            where = f" (on rank {self.comm.rank}{self.where})"
            entry = f"{type(error)}{error}", _packed(error, where)
        entries = self.comm.allgather(entry)
        if watch:
            watch.cancel()
        self._forget()
        errors = [entry for entry in entries if entry is not None]
        texts = {text for text, _ in errors}
        if len(errors) == self.comm.size and len(texts) == 1:  # all ranks failed in the same way
            raise _marked(error)
        _, first_error = errors[0]
        raise _marked(first_error) from error


def _marked(error):
    """Flag an exception that is raised on all ranks, so that enclosing calls do not communicate it again."""
    error.on_all_ranks = True
    return error


def _packed(error, where):
    """Return a copy of an exception that can be pickled, with `where` added to its message.

    Its class is the nearest base class whose constructor accepts a single message.
    """
    for kind in type(error).__mro__:
        try:
            return pickle.loads(pickle.dumps(kind(f"{error}{where}")))
        except Exception:
            continue  # the constructor needs other arguments, or the exception cannot be pickled: try the base class


def end_all(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an exception of this rank and abort all ranks, so that no rank waits for messages of this one."""
    comm = MPI.COMM_WORLD
    text = "".join(traceback.format_exception(kind, error, trace))
    sys.stderr.write(f"rank {comm.rank} of {comm.size}: {text}")
    sys.stderr.flush()
    comm.Abort(1)


def end_all_after_error() -> None:
    """Abort all ranks if an uncaught exception ended this one. Called when the process exits."""
    error = getattr(sys, "last_value", None)
    if error is not None:
        end_all(type(error), error, error.__traceback__)
