"""A file from anywhere -> a plain 2-D array of floats, or one sentence that says why not.

Nothing is unpickled, and no memory is asked for before the file is known to hold what its header promises.
"""

import os
import zipfile
from math import prod

import numpy as np

from sparsedp.report import plots

__all__ = ["read_field"]

MOST = 10**8  # values; a field of the demo is a map, not an archive
LEAST = 4  # values along an axis
DEFLATE = 1100  # no zip member can grow by more than this factor


def read_field(path):
    """Path of a .npy, .npz or .png file -> field, shape (nx, ny), finite, not constant.

    An array is taken as a field: axis 0 is x. A picture has its rows from the top, and is turned.

    Parameters
    ----------
    path : pathlib.Path

    Returns
    -------
    array of float64, scaled by a power of two so that no value is larger than 1

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not a real, finite, varying 2-D array.
    ImportError
        If a picture is given and matplotlib is not installed.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "ground.npy")
    >>> np.save(path, np.outer([1, 2, 3, 4], [1, 1, 1, 4]))
    >>> read_field(path)[0]
    array([0.03125, 0.03125, 0.03125, 0.125  ])
    """
    readers = {".npy": _read_npy, ".npz": _read_npz, ".png": _read_png}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path} is not a .npy, .npz or .png file; save the field with numpy.save")
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long
        raise FileNotFoundError(f"{path} is not there or is no plain file; give the path of a .npy, .npz or .png file")
    try:
        path.open("rb").close()
    except OSError as error:
        raise ValueError(f"{path} cannot be opened: {error.strerror}") from error
    return _checked(path, reader(path))


# ---------------------------------------------------------------- NumPy files


def _read_npy(path):
    with path.open("rb") as stream:
        shape, dtype = _header(path, stream)
        held = path.stat().st_size - stream.tell()
        _check_promise(path, shape, dtype, held)
        _check_rank(path, shape)
        stream.seek(0)
        return _data(path, stream)


def _read_npz(path):
    try:
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            maps = [member for member in members if _is_map(path, archive, member)]
            if len(maps) == 1:
                return _read_member(path, archive, maps[0])
    except ValueError:
        raise
    except Exception as error:  # a broken archive fails in many ways, all with the same meaning
        raise ValueError(f"{path} is not a whole .npz archive; save the field with numpy.savez") from error
    names = ", ".join(member.filename[:24].removesuffix(".npy") for member in (maps or members)[:4]) or "nothing"
    raise ValueError(f"{path} needs exactly one 2-D array, got {len(maps)} among {len(members)} arrays ({names})")


def _is_map(path, archive, member):
    with archive.open(member) as stream:
        return len(_header(path, stream)[0]) == 2


def _read_member(path, archive, member):
    with archive.open(member) as stream:
        shape, dtype = _header(path, stream)
        _check_promise(path, shape, dtype, min(member.file_size, DEFLATE * member.compress_size) - stream.tell())
    with archive.open(member) as stream:
        return _data(path, stream)


def _data(path, stream):
    try:
        return np.lib.format.read_array(stream, allow_pickle=False)
    except ValueError as error:
        raise ValueError(f"{path} ends before the data that its header promises") from error


def _header(path, stream):
    """Shape and dtype that a .npy header promises. Nothing behind the header is read."""
    try:
        version = np.lib.format.read_magic(stream)
        readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = readers[version](stream)
    except Exception as error:  # whatever goes wrong in foreign bytes means the same
        raise ValueError(f"{path} has no readable .npy header (a pickle?); save the field with numpy.save") from error
    if not all(0 <= n < 2**63 for n in shape):
        raise ValueError(f"{path} promises an array of shape {str(shape)[:40]}, which cannot be")
    if dtype.hasobject:
        raise ValueError(f"{path} holds Python objects, which are never unpickled here; save it as floats")
    if dtype.kind not in "biuf":
        raise ValueError(f"{path} needs real numbers, got dtype {str(dtype)[:40]}; save it as floats")
    return shape, dtype


def _check_promise(path, shape, dtype, held):
    promised = prod(shape) * dtype.itemsize
    if promised > held:
        raise ValueError(f"{path} promises {promised} bytes of data in its header, but holds {max(held, 0)}")
    _check_amount(path, prod(shape))


def _check_amount(path, count):
    if count > MOST:
        raise ValueError(f"{path} holds {count} values, at most {MOST} are taken; thin it out first")


# ---------------------------------------------------------------- pictures


def _read_png(path):
    with path.open("rb") as stream:
        head = stream.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError(f"{path} is not a PNG picture")
    _check_amount(path, int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big"))
    try:
        picture = plots.read_picture(path)
    except ImportError:
        raise
    except Exception as error:  # a broken picture fails in many ways, all with the same meaning
        raise ValueError(f"{path} is not a whole PNG picture") from error
    return picture[::-1].T


# ---------------------------------------------------------------- what every field must be


def _check_rank(path, shape):
    if len(shape) != 2:
        raise ValueError(f"{path} needs a 2-D array, got shape {shape}")


def _checked(path, field):
    _check_rank(path, field.shape)
    if min(field.shape) < LEAST:
        raise ValueError(f"{path} needs at least {LEAST} values along each axis, got shape {field.shape}")
    with np.errstate(over="ignore"):
        field = field.astype(float)
    bad = np.argwhere(~np.isfinite(field))
    if len(bad):
        first = tuple(bad[0].tolist())
        raise ValueError(f"{path} needs finite values, got {len(bad)} that are NaN or infinite, the first at {first}")
    largest = np.abs(field).max()
    if largest > 0:
        field = np.ldexp(field, -np.frexp(largest)[1])  # by a power of two: nothing is rounded, nothing overflows
    if np.ptp(field) <= 1e-12 * np.abs(field).max():
        raise ValueError(f"{path} holds the same value everywhere ({largest:g}); the demo needs a field that varies")
    return field
