"""Files that are there whole or not at all, a full disk and a kill included."""

import contextlib
import os
import shutil
from pathlib import Path
from uuid import uuid4

__all__ = ["UNFINISHED", "write_file"]

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
    try:
        known = target.exists()
        if known and not target.is_file():
            _write(target, "wb", content)
            return
        if known:
            open(target, "rb+").close()  # a file that may not be changed is not replaced either
        _write(part, "xb", content)
        if known:
            shutil.copymode(target, part)
        os.replace(part, target)
        _sync(target.parent)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        with contextlib.suppress(OSError):  # it is gone when all went well
            part.unlink()


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
