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
from sparsedp.trajectory.step_runner import State

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.trajectory.checkpoint_plan import CheckpointPlan
    from sparsedp.trajectory.specification import RolloutSpecification
    from sparsedp.trajectory.step_runner import StepRunner

__all__ = ["BackwardProgress", "DiskStates", "free_bytes", "state_digest"]

FORMAT = "sparsedp rollout 1"
PREFIX = "rollout-"
LOCK = "lock"  # name of the lock file in the folder of a run
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
            file.unlink(missing_ok=True)
        self._finalizer = weakref.finalize(self, _remove, self.path, lock)

    def remove(self) -> None:
        """Remove the folder and all of its files; also called when this object is garbage-collected."""
        self._finalizer()

    def preserve(self) -> None:
        """Unlock the folder, and do not remove it, so that a later run can continue from its files."""
        detached = self._finalizer.detach()
        if detached is not None:
            _, _, (_, lock), _ = detached
            lock.close()


def _new_run(parent: Path, key: str) -> tuple[Path, BinaryIO]:
    """Return a new folder and its locked file; warn if the folder above contains runs that did not end."""
    others = []
    for folder in parent.glob(f"{PREFIX}*"):
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
    while True:
        folder = parent / f"{PREFIX}{key}-{uuid4().hex[:8]}"
        folder.mkdir()
        lock = open_locked(folder / LOCK)
        if lock is not None:
            return folder, lock


def _unfinished_run(parent: Path, key: str) -> tuple[Path, BinaryIO] | None:
    """Return the folder of an interrupted run with the given key and its locked file, or None."""
    for folder in sorted(parent.glob(f"{PREFIX}{key}-*")):
        lock = open_locked(folder / LOCK)
        if lock is not None:
            return folder, lock
    return None


def _remove(folder: Path, lock: BinaryIO) -> None:
    """Remove the folder of a run. The lock file is removed last, so that no other run takes over a part."""
    for file in folder.glob("*"):
        if file.name != LOCK:
            with suppress(OSError):
                file.unlink()
    with suppress(OSError):
        (folder / LOCK).unlink()  # an open file cannot be removed on Windows
    lock.close()
    shutil.rmtree(folder, ignore_errors=True)


# ---- hash of a run ---------------------------------------------------------------------------------------------------


def run_key(specification: RolloutSpecification, args: Sequence) -> str:
    """Return a hash of the step, the arguments and the options of a rollout that is the same in every process.

    Of the step it contains the name, the code, and the numbers and arrays that the function refers to by its defaults
    and its enclosing functions. Global variables, and objects of other types, are not part of it.
    """
    statics = [form.statics for form in specification.forms]
    settings = (FORMAT, specification.n, specification.truncate, specification.differentiated, statics)
    texts = [fingerprint(settings), *map(fingerprint, args), *_step_texts(specification.step)]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:32]


def _step_texts(step: Any) -> list[str]:
    """Return texts that describe a step."""
    function = getattr(step, "function", step)  # the function that was jitted
    texts = [fingerprint(function)]
    function = getattr(function, "__func__", function)  # of a bound method
    code = getattr(function, "__code__", None)
    if code is None:
        return texts
    texts.append(_code_text(code))
    values = list(getattr(function, "__defaults__", None) or ())
    for cell in getattr(function, "__closure__", None) or ():
        with suppress(ValueError):  # an empty cell
            values.append(cell.cell_contents)
    for value in values:
        texts.append(fingerprint(value))
    return texts


def _code_text(code: Any) -> str:
    """Return a text that describes the code of a function and is the same in every process."""
    texts = [code.co_code.hex(), repr(code.co_names)]
    for constant in code.co_consts:
        if hasattr(constant, "co_code"):
            texts.append(_code_text(constant))
        elif isinstance(constant, frozenset):
            texts.append(repr(sorted(map(repr, constant))))
        else:
            texts.append(repr(constant))
    return " ".join(texts)


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
        key = run_key(specification, args) if self._is_resumable else uuid4().hex
        self._folder = RunFolder(parent, key)
        self._entries: list[State | FileState] = []
        self._popped: FileState | None = None  # its file is removed when the next state is appended or popped
        self._first_file: Path | None = None
        self.in_memory = 0
        self._is_full = False
        self._disk_indices = plan.disk_indices()
        self._is_forward = True
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
        for file in self._folder.path.glob("*"):
            if file.name != LOCK:
                file.unlink(missing_ok=True)
        self._entries.clear()
        self._popped = None
        self._first_file = None
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
        and the files are removed. The backward pass compares the other states when it runs their steps again.
        """
        entries = []
        last = None
        if self._is_resumable:
            last = read_state(self._folder.path / "last", self._form, first.statics)
            for path in sorted(self._folder.path.glob("state-*")):
                entries.append(FileState(int(path.name.removeprefix("state-")), first.statics, path))
        newest = self._confirmed(entries, runner, first)
        self._entries.append(first)
        self.in_memory = 1
        if newest is None:
            return first
        self._entries += entries
        self._first_file = entries[0].path
        if last is not None and last.i == self._plan.n:
            newest = last
        self.resumed_at = newest.i
        return newest

    def _confirmed(self, entries: list[FileState], runner: StepRunner, first: State) -> State | None:
        """Return the last of the states in files if the steps before it give it again; else remove all files."""
        newest = None
        if entries:
            newest = read_state(entries[-1].path, self._form, first.statics)
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

    def finish_forward(self, last: State) -> None:
        """Store the last state, so that an interrupted backward pass can be continued without the forward pass."""
        self._is_forward = False
        if self._entries[-1].i != last.i:  # the interrupted run had ended its forward pass
            self._entries.append(last)
            self.in_memory += 1
        if self._is_resumable and not self._is_full:
            self._written(self._folder.path / "last", last)

    def saved_progress(self, cotangents: Sequence) -> BackwardProgress | None:
        """Return what an interrupted backward pass of the same cotangents has computed, or None."""
        self._last_write_time = time.perf_counter()
        if not self._is_resumable or any(map(isbox, cotangents)):
            self._is_resumable = False
            return None
        self._cotangents = fingerprint(list(cotangents))
        path = self._folder.path / "backward.npz"
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
            save_tree(self._folder.path / "backward.npz", content, FORMAT)
        except OSError as error:
            if error.errno not in DISK_IS_FULL:
                raise
        self._last_write_time = time.perf_counter()
        self._last_write_seconds = self._last_write_time - begin


def _scalars(arrays: Sequence) -> list:
    """Return arrays with NumPy numbers in place of arrays without axes."""
    return [None if array is None else array[()] for array in arrays]
