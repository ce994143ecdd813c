"""Atomic writing: a file is complete or unchanged, even if the disk is full or the process is killed; file locks."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO
from uuid import uuid4

import numpy as np

__all__ = ["UNFINISHED", "load_tree", "open_locked", "path_errors", "save_tree", "write_file", "write_through"]

PATH_ADVICE = {
    errno.EEXIST: "give the path of a folder, this is a file",
    errno.EISDIR: "give the path of a file, this is a folder",
    errno.ENAMETOOLONG: "shorten the name, most file systems take up to 255 bytes",
    errno.ENOENT: "create the folder first",
    errno.ENOTDIR: "give a path through folders, a part of this one is a file",
}
SEQUENCES = {"list": list, "tuple": tuple}
UNFINISHED = ".part"  # suffix of incomplete files; they remain only if the process was killed while it wrote them


def write_file(path: str | os.PathLike, content: Any, durable: bool = True) -> None:
    """Write a file atomically.

    The content is written to a temporary file in the same folder, flushed to disk, and renamed to `path`. Symbolic
    links are followed, and the mode of a replaced file is preserved. Devices and pipes are written directly.

    Parameters
    ----------
    path : str or path
    content : str, bytes or callable
        The content, or a function that is called with the open binary stream and writes the content.
    durable : bool
        Whether the file is flushed to disk, so that it survives a power failure. This may take milliseconds.

    Raises
    ------
    OSError
        If the file cannot be written. The message names `path`, and an existing file is unchanged.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "numbers.txt")
    >>> write_file(path, "1 2 3")
    >>> path.read_text(), len(os.listdir(path.parent))
    ('1 2 3', 1)
    """
    target = Path(os.path.realpath(path))
    part = target.parent / f"{target.name[:40]}.{uuid4().hex[:8]}{UNFINISHED}"  # a unique name, for concurrent writers
    with path_errors(path):
        try:
            exists = target.exists()
            if exists and not target.is_file():
                _write(target, "wb", content)
                return
            if exists:
                open(target, "rb+").close()  # raises an error for a read-only file, so that it is not replaced
            _write(part, "xb", content, durable)
            if exists:
                shutil.copymode(target, part)
            os.replace(part, target)
            if durable:
                _sync(target.parent)
        finally:
            with contextlib.suppress(OSError):  # without an error it has been renamed and does not exist
                part.unlink()


@contextlib.contextmanager
def path_errors(path: Any, reading: bool = False) -> Iterator[None]:
    """Change an OSError raised inside so that it names `path` (not a temporary file), and add advice about the path."""
    try:
        yield
    except OSError as error:
        if error.errno is not None:  # else a library raised it, with its own message
            advice = PATH_ADVICE.get(error.errno)
            if reading and error.errno == errno.ENOENT:  # to create the folder does not help a reader
                advice = None
            if advice and advice not in (error.strerror or ""):  # an inner block may have added it
                error.strerror = f"{error.strerror}; {advice}"
            error.filename = str(path)
            del error.filename2
        raise


def _write(path, mode, content, durable=False):
    """Open a file in the given mode and write content to it; flush it to disk if it is to be durable."""
    with open(path, mode) as stream:
        if callable(content):
            content(stream)
        else:
            if isinstance(content, str):
                content = content.encode("utf-8", "backslashreplace")
            stream.write(content)
        stream.flush()
        if durable:
            os.fsync(stream.fileno())


def _sync(folder):
    """Sync a folder, so that a renamed file is on disk. Ignore errors of systems that do not support it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def open_locked(path: str | os.PathLike) -> BinaryIO | None:
    """Open a file, create it if necessary, and lock it until it is closed or the process ends.

    Return None if another process or another part of this one has locked it, if its folder does not exist, or if it was
    removed in the meantime.
    """
    try:
        file = open(path, "ab")
    except OSError:
        return None
    try:
        _lock(file)
        if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):  # else the file was removed in the meantime
            return file
    except OSError:
        pass
    file.close()
    return None


def _lock(file):
    """Lock an open file; raise OSError if it is locked."""
    try:
        import fcntl
    except ImportError:  # on Windows
        import msvcrt

        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def write_through(path: str | os.PathLike, write: Callable) -> None:
    """Write a file or a folder atomically by a function that takes a path and not a stream.

    Parameters
    ----------
    path : str or path
    write : callable
        ``write(name)`` writes the file or folder `name`, which is in a temporary folder next to `path` and has the
        suffix of `path` in lower case.

    Raises
    ------
    OSError
        If the file or folder cannot be written. The message names `path`, and an existing file or folder is unchanged.
    """
    target = Path(os.path.realpath(path))
    with path_errors(path), TemporaryDirectory(suffix=UNFINISHED, dir=target.parent) as folder:
        part = Path(folder, f"new{target.suffix.lower()}")
        old = Path(folder, "old")
        write(part)
        if part.is_file():
            with open(part, "rb") as whole:
                write_file(target, lambda stream: shutil.copyfileobj(whole, stream))
            return
        try:
            if target.exists():
                os.replace(target, old)
            os.replace(part, target)
        except BaseException:
            if old.exists() and not target.exists():  # else the old folder would be deleted with the temporary one
                os.replace(old, target)
            raise


def save_tree(path: str | os.PathLike, tree: Any, kind: str) -> None:
    """Save nested tuples, lists and dicts of arrays, numbers, strings and None to an .npz file without pickle.

    The structure is stored as JSON in the same file. `kind` names the format; `load_tree` checks it.
    """
    arrays: list = []
    text = json.dumps({"format": kind, "tree": _to_json(tree, arrays)})

    def write(stream):
        try:
            np.savez(stream, np.frombuffer(text.encode(), np.uint8), *arrays)
        except ValueError as error:
            interruption = error.__context__
            if isinstance(interruption, KeyboardInterrupt):  # zipfile raised the error when it closed the stream
                raise interruption from None
            raise

    write_file(path, write)


def load_tree(path: str | os.PathLike, kind: str) -> tuple[Any] | None:
    """Load a tree that `save_tree` wrote. Return (tree,), or None if the file is damaged or of another kind.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "numbers.npz")
    >>> save_tree(path, {"a": np.ones(2), "n": (3, None)}, "numbers")
    >>> load_tree(path, "numbers"), load_tree(path, "words")
    (({'a': array([1., 1.]), 'n': (3, None)},), None)
    """
    with path_errors(path, reading=True):
        file = open(path, "rb")
    with file:
        try:
            with np.load(file, allow_pickle=False) as stored:
                words = json.loads(bytes(stored["arr_0"]).decode())
                if words.get("format") != kind:
                    return None
                return (_tree(words["tree"], stored),)
        except Exception:  # readers raise errors of many classes for damaged files
            return None


def _to_json(tree, arrays):
    """Return a tree as plain data for JSON. Arrays are appended to the list `arrays` and replaced by their number."""
    if isinstance(tree, dict):
        if not all(isinstance(key, str) for key in tree):
            raise TypeError("save needs dicts with strings as keys; write str(key)")
        return {"dict": [[key, _to_json(branch, arrays)] for key, branch in tree.items()]}
    for kind, sequence in SEQUENCES.items():
        if isinstance(tree, sequence):
            return {kind: [_to_json(branch, arrays) for branch in tree]}
    if isinstance(tree, (np.ndarray, np.generic)) and tree.dtype.kind in "biufc":
        arrays.append(np.asarray(tree))
        return {"array": len(arrays)}
    if tree is None or isinstance(tree, (int, float, str)):
        return {"value": tree}
    raise TypeError(f"save takes arrays, numbers, strings and None, got {type(tree).__name__}; write np.asarray(value)")


def _tree(words, stored):
    """Return the tree from its JSON data and the stored arrays."""
    [(kind, value)] = words.items()
    if kind == "dict":
        return {key: _tree(branch, stored) for key, branch in value}
    if kind in SEQUENCES:
        return SEQUENCES[kind](_tree(branch, stored) for branch in value)
    if kind == "array":
        return stored[f"arr_{value}"]
    return value
