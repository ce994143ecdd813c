"""What all ranks do and know alike, and what one of them raises.

Whatever goes between ranks begins with one message of 32 bytes from each to all. It holds the mark of the rank, made of
all that ranks must do and be told alike (calls, numbers, arrays that every rank has), or the word that it has failed,
and up to 24 bytes that are reduced. So

- a rank that fails says so in the next message, and all raise its error in its words;
- unseeded random numbers, and a branch that only one rank takes, are errors where ranks meet next, not a drift;
- a reduction takes one message, as it would without all this.
"""

from __future__ import annotations

import pickle
import sys
import traceback
from collections import deque
from itertools import zip_longest
from numbers import Number
from threading import Timer
from types import SimpleNamespace
from typing import Any
from zlib import crc32

import numpy as np
from mpi4py import MPI

from sparsedp._utils.counters import count
from sparsedp._utils.pytree import labels, leaves
from sparsedp.autodiff.tape import plain
from sparsedp.trajectory.specification import folded

__all__ = ["Agreement", "course", "end_all", "end_all_after_error"]

ROOM = 24  # bytes beside the mark
FAILED = (-1).to_bytes(8, "little", signed=True)
PATIENCE = 15.0  # seconds that a rank which has failed waits for the others: they may be inside PETSc, and never come

# Of this process: how many messages there were; the agreement that was made or asked last; how many messages there were
# before the outermost call that is under way; and (name, arguments) of calls whose arguments were not compared yet.
course: Any = SimpleNamespace(met=0, last=None, begun=None, untold=[])


class Agreement:
    """What the ranks of a communicator agree on: numbers, errors, and that they do the same.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    where : str
        What an error says of this rank.
    """

    def __init__(self, comm: Any, where: str) -> None:
        self.comm = comm
        self.where = where
        course.last = self
        self._mark = 0
        self._log: deque = deque(maxlen=100)  # what was told since the last message: (label, mark)
        self._mine = np.zeros(8 + ROOM, np.uint8)
        self._all = np.zeros((comm.size, 8 + ROOM), np.uint8)

    # ------------------------------------------------------------ what must be the same

    def tell(self, label: str, content: bytes) -> None:
        """Note what this rank does, or was given, in words and as bytes: it is compared with the next message."""
        while course.untold:
            what, given = course.untold.pop(0)
            for number, tree in enumerate(given):
                self.tell_all(f"argument {number}", what, tree)
        self._mark = crc32(content, self._mark)
        self._log.append((label, self._mark))

    def tell_all(self, root: Any, what: str, tree: Any) -> None:
        """The same for the leaves of a tree, on the tape or not; those on ranks are agreed on already."""
        for name, leaf in zip(labels(tree, root), leaves(tree)):
            value = plain(leaf)
            if isinstance(value, (Number, np.ndarray, np.generic, str)):
                self.tell(f"{name} of {what}", folded(np.asarray(value)))

    def meet(self, label: str, content: bytes = b"") -> Any:
        """Send one message from each rank to all; return the bytes `content` of all ranks, in their order.

        Raises
        ------
        Exception
            That of the first rank that failed, on all of them.
        ValueError
            If ranks were told different things.
        """
        self.tell(label, label.encode())
        mark = self._mark.to_bytes(8, "little")
        found = self._sent(mark, content)
        if found == mark * self.comm.size:
            self._log.clear()
        elif FAILED in (found[k : k + 8] for k in range(0, len(found), 8)):
            self._raise_together()
        else:
            self._refuse()
        return self._all[:, 8 : 8 + len(content)].tobytes()

    def _sent(self, head, content):
        course.met = course.met + 1
        course.last = self
        self._mine[: 8 + len(content)] = np.frombuffer(head + content, np.uint8)
        self.comm.Allgather(self._mine, self._all)
        return self._all[:, :8].tobytes()

    def _refuse(self):
        """Say what the ranks were told that is not the same."""
        logs = zip_longest(*self.comm.allgather(list(self._log)), fillvalue=("nothing", 0))
        entries = next(entries for entries in logs if len(set(entries)) > 1)
        rank = next(rank for rank, entry in enumerate(entries) if entry != entries[0])
        first = entries[0][0]
        other = entries[rank][0]
        self._forget()
        raise _marked(
            ValueError(
                f"{first} is not the same on rank {rank} as on rank 0; give all ranks the same numbers, random ones by "
                "the same seed"
                if first == other
                else f"rank {rank} came to {other} where rank 0 came to {first}; let nothing depend on the number of "
                "the rank, on a clock or on numbers of one rank"
            )
        )

    def _forget(self):
        self._mark = 0
        self._log.clear()

    # ------------------------------------------------------------ numbers

    def reduced(self, number: Any, act: Any) -> Any:
        """The numbers of all ranks in one, in the order of the ranks: the same bits on each, whatever MPI does."""
        count("ranks", "reduction")
        number = np.asarray(number)
        content = number.tobytes()
        label = f"{act.__name__} of shape {number.shape}, {number.dtype}"
        found = self.meet(label, content) if len(content) <= ROOM else b"".join(self.gathered(content, label))
        return act.reduce(np.ndarray((self.comm.size, *number.shape), number.dtype, found), axis=0)[()]

    def gathered(self, value: Any, label: str = "gather") -> Any:
        """Return the values of all ranks as a list, on every rank."""
        self.meet(label)
        return self.comm.allgather(value)

    # ------------------------------------------------------------ errors

    def agreed(self, label: str, act: Any, *args: Any, at_once: bool = False) -> Any:
        """act(*args), which may fail on one rank only: then it fails on all.

        Inside of `together`, that tells them; `at_once`: they are told here, for the caller goes on in another way.
        """
        alone = at_once or course.begun is None
        try:
            result = act(*args)
        except Exception as error:
            if alone:
                self.fail(error)
            if not hasattr(error, "on_all_ranks"):
                self.tell(f"an error in {label}", b"failed")  # if it is caught on the way, the ranks differ
            raise
        if alone:
            self.meet(label)
        return result

    def fail(self, error: Any) -> None:
        """Raise an error on all ranks: that of the lowest one which has failed, in its words and with its place."""
        if hasattr(error, "on_all_ranks"):
            raise error
        watch = Timer(PATIENCE, end_all, (type(error), error, error.__traceback__))
        watch.daemon = True
        watch.start()
        self._sent(FAILED, b"")
        self._raise_together(error, watch)

    def _raise_together(self, error=None, watch=None):
        where = f" (on rank {self.comm.rank}{self.where})"
        mine = None if error is None else (f"{type(error)}{error}", _packed(error, where))
        told = self.comm.allgather(mine)
        if watch:
            watch.cancel()
        self._forget()
        if len({one and one[0] for one in told}) == 1:  # all have failed in the same way
            raise _marked(error)
        raise _marked(next(filter(None, told))[1]) from error


def _marked(error):
    """Mark an error that all ranks raise: callers on the stack do not exchange it again."""
    error.on_all_ranks = True
    return error


def _packed(error, where):
    """An error as others can raise it: of the nearest class that is made of words alone; with the place added."""
    for kind in type(error).__mro__:
        try:
            return pickle.loads(pickle.dumps(kind(f"{error}{where}")))
        except Exception:
            continue  # it takes other arguments, or other ranks do not know it


def end_all(kind: Any, error: Any, trace: Any) -> None:
    """End all ranks with the error of one, so that no rank waits for its messages."""
    comm = MPI.COMM_WORLD
    told = "".join(traceback.format_exception(kind, error, trace))
    sys.stderr.write(f"rank {comm.rank} of {comm.size}: {told}")
    sys.stderr.flush()
    comm.Abort(1)


def end_all_after_error() -> None:
    """End all ranks at the exit of this one if an uncaught error ended it."""
    error = getattr(sys, "last_value", None)
    if error is not None:
        end_all(type(error), error, error.__traceback__)
