"""The states that a rollout keeps for its backward pass, in memory and in files.

Each run has a folder of its own below the folder that the user gives::

    rollout-<hash of step and arguments>-<random>/
        lock                 locked by the process that runs it
        state-<index>        one kept state: a line of JSON, then the bytes of the arrays
        last                 the last state
        backward.npz         the cotangents at some state of the backward pass

The folder is removed when the backward pass ends, and when the result is garbage-collected without a backward pass. It
remains if the process is killed or the run is interrupted; the lock is then free, and a later run with the same hash
continues from the files. Every file is written under a temporary name and renamed, so that a killed process leaves no
incomplete state, and the digest of a state is compared when the state is read.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import time
import warnings
import weakref
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple
from uuid import uuid4

import numpy as np

from sparsedp._utils.calls import frames_inside
from sparsedp.autodiff.backend import folded
from sparsedp.autodiff.tape import isbox
from sparsedp.errors import DiskWarning
from sparsedp.io.atomic_files import UNFINISHED, load_tree, open_locked, path_errors, save_tree, write_file
from sparsedp.io.fingerprint import fingerprint
from sparsedp.trajectory.run_key import RunKey, run_key
from sparsedp.trajectory.step_runner import State

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.trajectory.checkpoint_plan import CheckpointPlan
    from sparsedp.trajectory.specification import RolloutSpecification
    from sparsedp.trajectory.step_runner import StepRunner

__all__ = ["BackwardProgress", "DiskStates", "free_bytes", "state_digest"]

FORMAT = "sparsedp rollout 1"
PREFIX = "rollout-"
LOCK = "lock"  # names of the files in the folder of a run; those of states are state-<index>
LAST = "last"
BACKWARD = "backward.npz"
FOLDER_NAME = re.compile(PREFIX + "[0-9a-f]{32}-[0-9a-f]{8}")
STATE_NAME = re.compile("state-([0-9]{12})")
ATTEMPTS = 20  # to create a folder and to lock it; another process may lock a new folder first, to look into it
FREE_SHARE = 0.5  # fraction of the free space of the disk that is used if the user gives no limit
INTERVAL = 30.0  # least number of seconds between two writes of the cotangents
SHARE = 0.05  # writing the cotangents may take at most this fraction of the time
DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def free_bytes(folder: str | os.PathLike[str]) -> int:
    """Create a folder if it does not exist; return the bytes that a rollout without a limit may use there."""
    path = Path(folder)
    with path_errors(path):
        path.mkdir(parents=True, exist_ok=True)
        return int(FREE_SHARE * shutil.disk_usage(path).free)


# ---- the folder of a run ---------------------------------------------------------------------------------------------


class RunFolder:
    """The folder with the files of one run, locked while the run lasts.

    Parameters
    ----------
    parent : path
    key : str
        Hash of step and arguments. An unlocked folder with the same key is taken over, with its files.

    Attributes
    ----------
    path : Path
    """

    def __init__(self, parent: str | os.PathLike[str], key: str) -> None:
        parent = Path(parent)
        with path_errors(parent):
            parent.mkdir(parents=True, exist_ok=True)
            self.path, lock = _unfinished_run(parent, key) or _new_run(parent, key)
        for file in self.path.glob(f"*{UNFINISHED}"):
            with suppress(OSError):
                file.unlink()
        self._finalizer = weakref.finalize(self, _remove, self.path, lock, os.getpid())

    def remove(self) -> None:
        """Remove the folder with its files; also called when this object is garbage-collected."""
        self._finalizer()

    def clear(self) -> None:
        """Remove all files except the lock."""
        _remove_files(self.path)

    def preserve(self) -> None:
        """Unlock the folder, and do not remove it, so that a later run can continue from its files."""
        detached = self._finalizer.detach()
        if detached is not None:
            _, _, (_, lock, _), _ = detached
            lock.close()


def _new_run(parent: Path, key: str) -> tuple[Path, BinaryIO]:
    """Return a new folder and its locked file; warn if the folder above contains runs that did not end."""
    others = []
    for folder in _folders(parent, PREFIX):
        lock = open_locked(folder / LOCK)
        if lock is not None:
            others.append(sum(file.stat().st_size for file in folder.glob("*") if file.is_file()))
            lock.close()
    if others:
        warnings.warn(
            DiskWarning(
                f"{parent} holds {len(others)} rollout folders of {sum(others) / 1e6:.3g} MB, of runs that were "
                "interrupted; repeat the interrupted call to continue it, or delete the folders"
            ),
            stacklevel=frames_inside() + 1,
        )
    for _ in range(ATTEMPTS):
        folder = parent / f"{PREFIX}{key}-{uuid4().hex[:8]}"
        folder.mkdir()
        lock = open_locked(folder / LOCK)
        if lock is not None:
            return folder, lock
        with suppress(OSError):
            (folder / LOCK).unlink(missing_ok=True)
            folder.rmdir()
    raise OSError(f"no file can be created and locked in {parent}; name a folder on a local disk with free space")


def _unfinished_run(parent: Path, key: str) -> tuple[Path, BinaryIO] | None:
    """Return the folder of an interrupted run with the given key and its locked file, or None."""
    for folder in _folders(parent, f"{PREFIX}{key}-"):
        lock = open_locked(folder / LOCK)
        if lock is not None:
            return folder, lock
    return None


def _folders(parent: Path, prefix: str) -> list[Path]:
    """Return the folders of runs whose names begin with `prefix`; links and other names belong to the user."""
    paths = sorted(parent.glob(f"{prefix}*"))
    return [path for path in paths if FOLDER_NAME.fullmatch(path.name) and not path.is_symlink()]


def _remove_files(folder: Path) -> None:
    """Remove all files of a run, except the lock."""
    for path in folder.glob("*"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != LOCK:
            with suppress(OSError):
                path.unlink()


def _remove(folder: Path, lock: BinaryIO, process: int) -> None:
    """Remove the folder of a run, if this process created it. A forked process has a copy of the object only.

    The lock file is removed last, so that no other run takes over a part. Another run may create a new one after that;
    the folder then remains.
    """
    if os.getpid() != process:
        lock.close()
        return
    _remove_files(folder)
    with suppress(OSError):
        (folder / LOCK).unlink()  # an open file cannot be removed on Windows
    lock.close()
    with suppress(OSError):
        if os.name == "nt":
            (folder / LOCK).unlink(missing_ok=True)
        folder.rmdir()


# ---- files of states -------------------------------------------------------------------------------------------------


def state_digest(values: Sequence) -> str:
    """Return a hash of the arrays of a state that is the same in every process."""
    hashed = hashlib.blake2b(digest_size=16)
    for value in values:
        hashed.update(folded(np.asarray(value)))
    return hashed.hexdigest()


def _bytes_of(value: Any) -> memoryview:
    """Return the bytes of a number or a contiguous array."""
    return np.ascontiguousarray(value).reshape(-1).view(np.uint8).data


def write_state(path: Path, state: State) -> None:
    """Write the arrays of a state to a file. A full disk leaves no file."""
    header = {"format": FORMAT, "i": state.i, "depends": state.depends, "digest": state_digest(state.values)}

    def write(stream: BinaryIO) -> None:
        stream.write(json.dumps(header).encode() + b"\n")
        for value in state.values:
            stream.write(_bytes_of(value))

    write_file(path, write, durable=False)  # after a power failure the run begins anew


def read_state(path: Path, form: Any, statics: Sequence) -> State | None:
    """Return the state in a file, or None if the file is damaged or contains a state of another form."""
    try:
        with open(path, "rb") as file:
            header = json.loads(file.readline())
            values = []
            for shape, dtype in zip(form.shapes, form.dtypes, strict=True):
                array = np.empty(shape, dtype)
                if array.nbytes and file.readinto(_bytes_of(array)) != array.nbytes:
                    return None
                values.append(array[()])
            if header["format"] != FORMAT or header["digest"] != state_digest(values):
                return None
            return State(header["i"], values, statics, header["depends"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


# ---- the stack of states ---------------------------------------------------------------------------------------------


class BackwardProgress(NamedTuple):
    """What an interrupted backward pass has computed.

    Attributes
    ----------
    i : int
        Index of the next step to be differentiated.
    total : list
        Cotangents of state i + 1.
    sums : list
        For each variable of params the sum of its cotangents so far, or None.
    rows : list of arrays
        For each differentiated array of inputs the cotangents of its rows from i + 1 on.
    norms : list of (int, float)
    recomputed : int
    digest : str
        Hash of state i + 1.
    """

    i: int
    total: list
    sums: list
    rows: list
    norms: list
    recomputed: int
    digest: str


class FileState:
    """A state in a file: what of it stays in memory."""

    tape = None

    def __init__(self, i: int, statics: Sequence, path: Path) -> None:
        self.i = i
        self.statics = statics
        self.path = path


class DiskStates:
    """The stack of the states that a rollout keeps for its backward pass; some of them in files.

    The methods `append`, `pop` and `clear` are those of the list that is used without files.

    Parameters
    ----------
    specification : RolloutSpecification
    args : list of arrays
    plan : CheckpointPlan
    parent : path
        The folder that the user gave.
    is_resumable : bool
        Whether the result is determined by the last state, so that an interrupted run can be continued.

    Attributes
    ----------
    in_memory : int
        Number of states in memory.
    written : int
        Number of states that were written to files.
    resumed_at : int or None
        Index of the state from which an interrupted run was continued.
    """

    def __init__(
        self,
        specification: RolloutSpecification,
        args: Sequence,
        plan: CheckpointPlan,
        parent: str | os.PathLike[str],
        is_resumable: bool,
    ) -> None:
        form = specification.state
        self._form = form
        self._plan = plan
        self._is_resumable = is_resumable and len(form.places) == len(form.statics)
        key = RunKey(uuid4().hex, True)
        if self._is_resumable:
            key = run_key(specification, args)
        self._key_is_complete = key.is_complete
        self._folder = RunFolder(parent, key.text)
        self._entries: list[State | FileState] = []
        self._popped: FileState | None = None  # its file is removed when the next state is appended or popped
        self._first_file: Path | None = None
        self.in_memory = 0
        self._is_full = False
        self._disk_indices = plan.disk_indices()
        self._is_forward = True
        self._earlier_last: State | None = None  # the last state of the interrupted run, if the steps must confirm it
        self._last_write_time = time.perf_counter()
        self._last_write_seconds = 0.0
        self._cotangents = ""
        self.written = 0
        self.resumed_at: int | None = None

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, position: int) -> State | FileState:
        return self._entries[position]

    def append(self, state: State) -> None:
        """Add a state to the stack. If it belongs into a file and the disk is full, it is not kept."""
        if self._popped is not None and self._popped.i == state.i:
            self._entries.append(self._popped)
            self._popped = None
            return
        self._remove_popped()
        if not self._is_forward or state.i not in self._disk_indices:
            self._entries.append(state)
            self.in_memory += 1
        elif not self._is_full:
            path = self._folder.path / f"state-{state.i:012d}"
            self._first_file = self._first_file or path
            if self._written(path, state):
                self._entries.append(FileState(state.i, state.statics, path))
                self.written += 1

    def _written(self, path: Path, state: State) -> bool:
        """Write a state to a file; return whether there was enough space."""
        try:
            write_state(path, state)
        except OSError as error:
            if error.errno not in DISK_IS_FULL:
                raise
            self._is_full = True
            warnings.warn(
                DiskWarning(
                    f"the disk is full: {self._folder.path.parent} holds {self.written} states of this rollout, the "
                    "other steps will be run again; free space there, or name a folder on another disk"
                ),
                stacklevel=frames_inside() + 1,
            )
            return False
        return True

    def pop(self) -> State:
        """Remove the last state from the stack and return it."""
        self._remove_popped()
        entry = self._entries.pop()
        if isinstance(entry, State):
            self.in_memory -= 1
            return entry
        state = read_state(entry.path, self._form, entry.statics)
        if state is None or state.i != entry.i:
            raise OSError(f"{entry.path} was changed or removed during the rollout; run it again")
        self._popped = entry
        return state

    def _drop_last(self) -> None:
        entry = self._entries.pop()
        if isinstance(entry, State):
            self.in_memory -= 1
        else:
            self._popped = entry
            self._remove_popped()

    def _remove_popped(self) -> None:
        """Remove the file of the state that was popped; keep the first file, by which a later run confirms the step."""
        if self._popped is not None and self._popped.path != self._first_file:
            self._popped.path.unlink(missing_ok=True)
        self._popped = None

    def clear(self) -> None:
        """Remove all states."""
        self._folder.clear()
        self._entries.clear()
        self._popped = None
        self._first_file = None
        self._earlier_last = None
        self._is_forward = True
        self.in_memory = 0
        self.written = 0
        self.resumed_at = None

    def remove(self) -> None:
        """Remove the folder of the run."""
        self._folder.remove()

    def preserve(self) -> None:
        """Leave the folder to a later run if that could continue from it; remove it otherwise."""
        if self._is_resumable:
            self._folder.preserve()
        else:
            self._folder.remove()

    # ---- an interrupted run ----

    def resume(self, runner: StepRunner, first: State) -> State:
        """Append the states of an interrupted run; return the state from which the forward pass continues.

        The steps between the last two states in files are run again. If they give another state, the step has changed,
        and the files are removed. If the key does not cover everything that the step refers to, the steps after the
        last state in a file are run again, too; see `finish_forward`. The backward pass compares the other states when
        it runs their steps again.
        """
        entries = []
        last = None
        if self._is_resumable:
            last = read_state(self._folder.path / LAST, self._form, first.statics)
            entries = self._states_in_files(first.statics)
        newest = self._confirmed(entries, runner, first)
        self._entries.append(first)
        self.in_memory = 1
        if newest is None:
            return first
        self._entries += entries
        self._first_file = entries[0].path
        if last is not None and last.i == self._plan.n:
            if self._key_is_complete:
                newest = last
            else:
                self._earlier_last = last
        self.resumed_at = newest.i
        return newest

    def _states_in_files(self, statics: Sequence) -> list[FileState]:
        """Return the states of which the folder has files, in ascending order."""
        states = []
        for path in sorted(self._folder.path.glob("state-*")):
            match = STATE_NAME.fullmatch(path.name)
            if match and 0 < int(match[1]) < self._plan.n and path.is_file():
                states.append(FileState(int(match[1]), statics, path))
        return states

    def _confirmed(self, entries: list[FileState], runner: StepRunner, first: State) -> State | None:
        """Return the last of the states in files if the steps before it give it again; else remove all files."""
        newest = None
        if entries:
            newest = read_state(entries[-1].path, self._form, first.statics)
            if newest is not None and newest.i != entries[-1].i:
                newest = None
            before = first
            if len(entries) > 1:
                before = read_state(entries[-2].path, self._form, first.statics) or first
            while newest is not None and before.i < newest.i:
                before = runner.step(before, False)
            if newest is not None and state_digest(before.values) != state_digest(newest.values):
                newest = None
        if newest is None:
            self.clear()
        return newest

    def finish_forward(self, last: State) -> bool:
        """Store the last state, so that an interrupted backward pass can be continued without the forward pass.

        Return False if the interrupted run ended in another state: the step has changed, and all steps must be run.
        """
        if self._earlier_last is not None and state_digest(self._earlier_last.values) != state_digest(last.values):
            self.clear()
            return False
        self._is_forward = False
        if self._entries[-1].i != last.i:  # the interrupted run had ended its forward pass
            self._entries.append(last)
            self.in_memory += 1
        if self._is_resumable and not self._is_full:
            self._written(self._folder.path / LAST, last)
        return True

    def saved_progress(self, cotangents: Sequence) -> BackwardProgress | None:
        """Return what an interrupted backward pass of the same cotangents has computed, or None."""
        self._last_write_time = time.perf_counter()
        if not self._is_resumable or any(map(isbox, cotangents)):
            self._is_resumable = False
            return None
        self._cotangents = fingerprint(list(cotangents))
        path = self._folder.path / BACKWARD
        if not path.exists():
            return None
        content = load_tree(path, FORMAT)
        if content is None or content[0]["cotangents"] != self._cotangents:
            return None
        saved = BackwardProgress(*content[0]["progress"])
        while self._entries[-1].i > saved.i:  # the steps after these states have been differentiated
            self._drop_last()
        return saved._replace(total=_scalars(saved.total), sums=_scalars(saved.sums))

    def save(self, progress: Callable[[], BackwardProgress]) -> None:
        """Write the cotangents to a file if enough time has passed since the last write."""
        seconds = time.perf_counter() - self._last_write_time
        if not self._is_resumable or seconds < max(INTERVAL, self._last_write_seconds / SHARE):
            return
        begin = time.perf_counter()
        content = {"cotangents": self._cotangents, "progress": list(progress())}
        try:
            save_tree(self._folder.path / BACKWARD, content, FORMAT)
        except OSError as error:
            if error.errno not in DISK_IS_FULL:
                raise
        self._last_write_time = time.perf_counter()
        self._last_write_seconds = self._last_write_time - begin


def _scalars(arrays: Sequence) -> list:
    """Return arrays with NumPy numbers in place of arrays without axes."""
    return [None if array is None else array[()] for array in arrays]
