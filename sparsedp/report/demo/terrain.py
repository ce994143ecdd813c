"""The field that plays the hidden ground: real terrain, the reader's own file, or a generated one.

Of a file nothing is unpickled, and no memory is asked for before it is known to hold what its header promises.
"""

import os
import zipfile
from math import prod
from typing import NamedTuple

import numpy as np

import sparsedp as dp
from sparsedp.fields import check_finite
from sparsedp.report import plots

__all__ = ["Terrain", "hidden_ground", "load", "read_array", "read_field", "remap"]

SAMPLE = "jacksboro_fault_dem.npz"
FINEST = 8  # points along an axis that are averaged into one cell
STEEPEST = 3.5  # bound on |log k|: conductivities then span a factor of at most 1000
MOST = 10**8  # values of a file; a field of the demo is a map, not an archive
LEAST = 4  # values along an axis
DEFLATE = 1100  # no zip member can grow by more than this factor


class Terrain(NamedTuple):
    """A 2-D array, axis 0 is x, and where it came from."""

    field: np.ndarray
    source: str


def load(path=None):
    """Path of a file, or None -> Terrain. None: the sample data of matplotlib, or a generated terrain.

    Parameters
    ----------
    path : pathlib.Path or None

    Returns
    -------
    Terrain

    Raises
    ------
    ValueError, FileNotFoundError, ImportError
        From `read_field`, when `path` does not hold a usable field.
    """
    if path is not None:
        return Terrain(read_field(path), f"your file {path}")
    try:
        with np.load(plots.sample_file(SAMPLE), allow_pickle=False) as archive:
            rows = archive["elevation"]
    except (ImportError, OSError, KeyError, ValueError):
        return Terrain(generated((403, 344)), "a generated terrain (the real one comes with matplotlib)")
    # Rows run from north to south; a field has axis 0 to the east and axis 1 to the north.
    return Terrain(rows[::-1].T.astype(float), f"elevation model {SAMPLE} from matplotlib's sample data")


def generated(shape):
    """Shape -> crests and hollows, the same in every run.

    Minus the absolute value of a sum of waves has a crest wherever the sum changes sign; turned and shorter waves of
    less weight make the relief rough.
    """
    x, y = np.indices(shape) / max(shape)
    waves = (np.sin(k * (x * np.cos(3 * k) + y * np.sin(3 * k)) + k) / k for k in range(3, 40, 3))
    return -np.abs(sum(waves))


def remap(source, grid):
    """Two grids over the same box -> Operator from cells of the one to cells of the other: the mean over each cell.

    Each cell is cut into `FINEST` parts or fewer along each axis, the field is interpolated there
    (`sample`), and the parts are averaged (`restrict`). Linear fields are exact.

    Parameters
    ----------
    source, grid : Grid

    Returns
    -------
    Operator
        in: cells of `source` [unit]; out: cells of `grid` [unit].

    Examples
    --------
    >>> remap(dp.Grid(4, size=1.0), dp.Grid(2, size=1.0))(np.array([1.0, 2.0, 3.0, 4.0]))
    array([1.5, 3.5])
    """
    ratio = max(n / m for n, m in zip(source.shape, grid.shape))
    parts = int(np.clip(np.ceil(ratio), 1, FINEST))
    fine = dp.Grid(tuple(parts * m for m in grid.shape), size=grid.size)
    points = np.stack([centre.ravel() for centre in fine.centres()], axis=1)
    return dp.restrict(fine, parts) @ dp.sample(source, points)


def hidden_ground(grid, terrain):
    """Terrain -> log-conductivity of the ground on a grid: mean 0, standard deviation 1 (or a little less).

    Parameters
    ----------
    grid : Grid
    terrain : Terrain

    Returns
    -------
    array, shape `grid.shape`: log of the conductivity, relative to its geometric mean

    Raises
    ------
    ValueError
        If the field is constant once it is averaged over the cells.
    """
    heights = remap(dp.Grid(terrain.field.shape, size=grid.size), grid)(terrain.field)
    heights = heights - heights.mean()
    spread = heights.std()
    if spread <= 1e-12 * np.abs(terrain.field).max():
        raise ValueError(f"{terrain.source} is constant once averaged over {grid}; give a field with larger features")
    logk = heights / spread
    return logk * min(1.0, STEEPEST / np.abs(logk).max())


# ---------------------------------------------------------------- a file from anywhere


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
    readers = {".npy": _npy, ".npz": _npz, ".png": _png}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path} is not a .npy, .npz or .png file; save the field with numpy.save")
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long
        raise FileNotFoundError(f"{path} is not there or is no plain file; give the path of a .npy, .npz or .png file")
    try:
        with path.open("rb") as stream:
            field = reader(path, stream)
    except OSError as error:
        raise ValueError(f"{path} cannot be opened: {error.strerror}") from error
    _check_shape(path, field.shape)
    if min(field.shape) < LEAST:
        raise ValueError(f"{path} needs at least {LEAST} values along each axis, got shape {field.shape}")
    with np.errstate(over="ignore"):
        field = field.astype(float)
    check_finite(path, field, "needs finite values")
    largest = np.abs(field).max()
    if np.ptp(field / 2) <= 5e-13 * largest:  # halves: a difference of two values may overflow
        raise ValueError(f"{path} holds the same value everywhere ({largest:g}); the demo needs a field that varies")
    return np.ldexp(field, -np.frexp(largest)[1])  # by a power of two: nothing is rounded, nothing overflows


def _npy(path, stream):
    return read_array(path, stream, path.stat().st_size)


def _npz(path, stream):
    try:
        with zipfile.ZipFile(stream) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            maps = [member for member in members if len(_header(path, archive.open(member))[0]) == 2]
            if len(maps) == 1:
                size = min(maps[0].file_size, DEFLATE * maps[0].compress_size)
                return read_array(path, archive.open(maps[0]), size)
    except ValueError:
        raise
    except Exception as error:  # a broken archive fails in many ways, all with the same meaning
        raise ValueError(f"{path} is not a whole .npz archive; save the field with numpy.savez") from error
    names = ", ".join(member.filename[:24].removesuffix(".npy") for member in (maps or members)[:4]) or "nothing"
    raise ValueError(f"{path} needs exactly one 2-D array, got {len(maps)} among {len(members)} arrays ({names})")


def read_array(path, stream, size):
    """Open .npy stream of so many bytes, at most -> array."""
    shape, fortran, dtype = _header(path, stream)
    promised, held = prod(shape) * dtype.itemsize, max(size - stream.tell(), 0)
    if promised > held:
        raise ValueError(f"{path} promises {promised} bytes of data in its header, but holds {held}")
    _check_shape(path, shape)
    data = stream.read(promised)
    if len(data) < promised:
        raise ValueError(f"{path} ends before the data that its header promises")
    return np.ndarray(shape, dtype, data, order="F" if fortran else "C")


def _header(path, stream):
    """(shape, whether in Fortran order, dtype) that a .npy header promises. Nothing behind the header is read."""
    try:
        form = np.lib.format
        shape, fortran, dtype = getattr(form, "read_array_header_{}_{}".format(*form.read_magic(stream)))(stream)
    except Exception as error:  # whatever goes wrong in foreign bytes means the same
        raise ValueError(f"{path} has no readable .npy header (a pickle?); save the field with numpy.save") from error
    if not all(0 <= n < 2**63 for n in shape):
        raise ValueError(f"{path} promises an array of shape {str(shape)[:40]}, which cannot be")
    if dtype.hasobject:
        raise ValueError(f"{path} holds Python objects, which are never unpickled here; save it as floats")
    if dtype.kind not in "biuf":
        raise ValueError(f"{path} needs real numbers, got dtype {str(dtype)[:40]}; save it as floats")
    return shape, fortran, dtype


def _png(path, stream):
    head = stream.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError(f"{path} is not a PNG picture")
    _check_shape(path, [int.from_bytes(size, "big") for size in (head[16:20], head[20:])])
    try:
        return plots.read_picture(path)[::-1].T
    except ImportError:
        raise
    except Exception as error:  # a broken picture fails in many ways, all with the same meaning
        raise ValueError(f"{path} is not a whole PNG picture") from error


def _check_shape(path, shape):
    if prod(shape) > MOST:
        raise ValueError(f"{path} holds {prod(shape)} values, at most {MOST} are taken; thin it out first")
    if len(shape) != 2:
        raise ValueError(f"{path} needs a 2-D array, got shape {shape}")
