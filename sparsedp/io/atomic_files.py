"""Files that are there whole or not at all, a full disk and a kill included."""

import contextlib
import errno
import json
import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import uuid4

import numpy as np

__all__ = ["UNFINISHED", "load_tree", "path_errors", "save_tree", "write_file", "write_through"]

PATH_ADVICE = {
    errno.EEXIST: "give the path of a folder, this is a file",
    errno.EISDIR: "give the path of a file, this is a folder",
    errno.ENAMETOOLONG: "shorten the name, most file systems take up to 255 bytes",
    errno.ENOENT: "create the folder first",
    errno.ENOTDIR: "give a path through folders, a part of this one is a file",
}
SEQUENCES = {"list": list, "tuple": tuple}
UNFINISHED = ".part"  # how the name of a file ends that is being written, or was when its run was killed


def write_file(path, content):
    """Text, bytes or ``write(stream)`` -> a file that is whole, under its name; the only way to write one here.

    It is written under another name beside it, synced and renamed. A link is followed, and the mode of a file that
    is replaced is kept; a device or a pipe is written into.

    Parameters
    ----------
    path : str or path
    content : str, bytes or callable
        A function gets the open binary stream.

    Raises
    ------
    OSError
        If the file cannot be written. It names `path`, and what stood there stands there still.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "numbers.txt")
    >>> write_file(path, "1 2 3")
    >>> path.read_text(), len(os.listdir(path.parent))
    ('1 2 3', 1)
    """
    target = Path(os.path.realpath(path))
    part = target.parent / f"{target.name[:40]}.{uuid4().hex[:8]}{UNFINISHED}"  # whoever else writes has another
    with path_errors(path):
        try:
            there = target.exists()
            if there and not target.is_file():
                _write(target, "wb", content)
                return
            if there:
                open(target, "rb+").close()  # a file that may not be changed is not replaced either
            _write(part, "xb", content)
            if there:
                shutil.copymode(target, part)
            os.replace(part, target)
            _sync(target.parent)
        finally:
            with contextlib.suppress(OSError):  # it is gone when all went well
                part.unlink()


@contextlib.contextmanager
def path_errors(path, reading=False):
    """Let an OSError inside name `path`, not the unfinished file beside it, and say what to do about the path."""
    try:
        yield
    except OSError as error:
        if error.errno is not None:  # else it was raised by a library, with a sentence of its own
            advice = PATH_ADVICE.get(error.errno)
            if reading and error.errno == errno.ENOENT:  # a new folder does not help
                advice = None
            if advice and advice not in (error.strerror or ""):  # an inner block may have added it
                error.strerror = f"{error.strerror}; {advice}"
            error.filename = str(path)
            del error.filename2
        raise


def _write(path, mode, content):
    with open(path, mode) as stream:
        if callable(content):
            content(stream)
        else:
            stream.write(content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content)
        stream.flush()
        if mode == "xb":
            os.fsync(stream.fileno())


def _sync(folder):
    """The new name of a file on the disk too, where a folder can be synced."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_through(path, write):
    """``write(name)`` of a library that takes no stream -> a file or a folder that is whole, under its own name.

    Parameters
    ----------
    path : str or path
    write : callable
        Gets a name that ends as `path` does, in lower case, in a folder beside it.

    Raises
    ------
    OSError
        If it cannot be written. It names `path`, and what stood there stands there still.
    """
    target = Path(os.path.realpath(path))
    with path_errors(path), TemporaryDirectory(suffix=UNFINISHED, dir=target.parent) as folder:
        part, old = Path(folder, f"new{target.suffix.lower()}"), Path(folder, "old")
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
            if old.exists() and not target.exists():  # what is in this folder is deleted with it
                os.replace(old, target)
            raise


def save_tree(path, tree, kind):
    """Any nesting of tuples, lists and dicts of arrays, numbers, strings and None -> a .npz file without pickle.

    The structure stands beside the arrays as JSON, with a word for the kind of file.
    """
    arrays: list = []
    text = json.dumps({"format": kind, "tree": _words(tree, arrays)})
    write_file(path, lambda stream: np.savez(stream, np.frombuffer(text.encode(), np.uint8), *arrays))


def load_tree(path, kind):
    """File that `save_tree` wrote -> (the tree,); None when it is another file, or damaged.

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
                return (_tree(words["tree"], stored),) if words.get("format") == kind else None
        except Exception:  # there is no end to what the readers raise on damage
            return None


def _words(tree, arrays):
    """A tree as JSON holds it; arrays are moved to a list and stand there by number."""
    if isinstance(tree, dict):
        if not all(isinstance(key, str) for key in tree):
            raise TypeError("save needs dicts with strings as keys; write str(key)")
        return {"dict": [[key, _words(branch, arrays)] for key, branch in tree.items()]}
    for kind, sequence in SEQUENCES.items():
        if isinstance(tree, sequence):
            return {kind: [_words(branch, arrays) for branch in tree]}
    if isinstance(tree, (np.ndarray, np.generic)) and tree.dtype.kind in "biufc":
        arrays.append(np.asarray(tree))
        return {"array": len(arrays)}
    if tree is None or isinstance(tree, (int, float, str)):
        return {"value": tree}
    raise TypeError(f"save takes arrays, numbers, strings and None, got {type(tree).__name__}; write np.asarray(value)")


def _tree(words, stored):
    [(kind, value)] = words.items()
    if kind == "dict":
        return {key: _tree(branch, stored) for key, branch in value}
    if kind in SEQUENCES:
        return SEQUENCES[kind](_tree(branch, stored) for branch in value)
    return stored[f"arr_{value}"] if kind == "array" else value
