"""The field that serves as the true log-conductivity: real terrain, a file of the user, or a generated field.

Files are read by NumPy without pickle.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sparsedp as dp
from sparsedp._utils.validation import check_finite
from sparsedp.report import plots
from sparsedp.report.demo.scene import centres_of

__all__ = ["Terrain", "hidden_ground", "load", "read_field", "remap"]

SAMPLE = "jacksboro_fault_dem.npz"
FINEST = 8  # largest number of points along an axis that are averaged to one cell
STEEPEST = 3.5  # bound on |log k|, so that conductivities differ by a factor of at most 1000
MOST_VALUES = 10**8  # largest number of values in a file
LEAST = 4  # smallest number of values along an axis


class Terrain(NamedTuple):
    """A 2-D array, whose axis 0 is x, and a description of its source."""

    field: np.ndarray
    source: str


def load(path: Path | None = None) -> Terrain:
    """Load a terrain from a file.

    Parameters
    ----------
    path : pathlib.Path or None
        Default: the sample data of matplotlib, or a generated terrain if matplotlib is not installed.

    Returns
    -------
    Terrain

    Raises
    ------
    ValueError, ImportError
        Raised by `read_field` if the file has no usable field.
    """
    if path is not None:
        return Terrain(read_field(path), f"your file {path}")
    try:
        with plots.sample_data(SAMPLE) as archive:
            rows = archive["elevation"]
    except (ImportError, OSError, KeyError, ValueError):
        return Terrain(generated((403, 344)), "a generated terrain (the real one comes with matplotlib)")
    # Rows run from north to south; a field has axis 0 to the east and axis 1 to the north.
    return Terrain(rows[::-1].T.astype(float), f"elevation model {SAMPLE} from matplotlib's sample data")


def generated(shape: tuple[int, int]) -> np.ndarray:
    """Return a smooth field with winding ridges. It is the same in every run."""
    x, y = np.indices(shape) / max(shape)
    return np.sin(9 * x + 2 * np.sin(7 * y)) + 0.5 * np.cos(17 * y - 5 * x)


def remap(source: dp.Grid, grid: dp.Grid) -> dp.Operator:
    """Return the operator that averages a cell field to the cells of another grid on the same box.

    Each target cell is divided into at most `FINEST` parts along each axis. The field is interpolated to these parts
    (`sample`), which are then averaged (`restrict`). Linear fields are mapped exactly.

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
    return dp.restrict(fine, parts) @ dp.sample(source, centres_of(fine))


def hidden_ground(grid: dp.Grid, terrain: Terrain) -> np.ndarray:
    """Return a terrain as log-conductivity on a grid, with mean 0 and standard deviation 1 (or a little less).

    Parameters
    ----------
    grid : Grid
    terrain : Terrain

    Returns
    -------
    array, shape `grid.shape`
        Logarithm of the conductivity divided by its geometric mean.

    Raises
    ------
    ValueError
        If the field is constant after it is averaged to the cells.
    """
    heights = remap(dp.Grid(terrain.field.shape, size=grid.size), grid)(terrain.field)
    heights = heights - heights.mean()
    spread = heights.std()
    if spread <= 1e-12 * np.abs(terrain.field).max():
        raise ValueError(f"{terrain.source} is constant once averaged over {grid}; give a field with larger features")
    logk = heights / spread
    return logk * min(1.0, STEEPEST / np.abs(logk).max())


# ---------------------------------------------------------------- a file from anywhere


def read_field(path: Path) -> np.ndarray:
    """Read a finite field of shape (nx, ny) from a .npy, .npz or .png file.

    Axis 0 of an array is x. The rows of a .png image run from top to bottom; they are converted to this convention.

    Parameters
    ----------
    path : pathlib.Path

    Returns
    -------
    array of float64, scaled by a power of two so that no value is larger than 1

    Raises
    ------
    ValueError
        If the file does not exist, or does not have a real, finite 2-D array.
    ImportError
        If the file is an image and matplotlib is not installed.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "ground.npy")
    >>> np.save(path, np.outer([1, 2, 3, 4], [1, 1, 1, 4]))
    >>> read_field(path)[0]
    array([0.03125, 0.03125, 0.03125, 0.125  ])
    """
    readers: dict[str, Any] = {
        ".npy": partial(np.load, mmap_mode="r"),  # memory-mapped: a wrong header must not allocate memory
        ".npz": _only_map,
        ".png": _grey,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path} is not a .npy, .npz or .png file; save the field with numpy.save")
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long
        raise ValueError(f"{path} is not there or is no plain file; give the path of a .npy, .npz or .png file")
    try:
        field = reader(path)
    except ImportError:
        raise
    except Exception as error:  # readers raise errors of many classes for damaged files
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path} cannot be read ({reason}); save the field with numpy.save") from error
    if field.ndim != 2 or min(field.shape) < LEAST:
        raise ValueError(f"{path} needs a 2-D array, {LEAST} values or more along each axis, got shape {field.shape}")
    if field.size > MOST_VALUES:
        raise ValueError(f"{path} holds {field.size} values, at most {MOST_VALUES} are taken; thin it out first")
    if field.dtype.kind not in "biuf":
        raise ValueError(f"{path} needs real numbers, got dtype {str(field.dtype)[:40]}; save it as floats")
    with np.errstate(over="ignore"):
        field = field.astype(float)
    check_finite(path, field, "needs finite values")
    # Scale by a power of two, which causes no rounding errors.
    return np.ldexp(field, -np.frexp(np.abs(field).max())[1])


def _grey(path: Path) -> np.ndarray:
    """Return the grey values of an image. Its rows run from top to bottom; axis 0 of the result is x."""
    with plots.opened(path) as picture:
        return np.asarray(picture.convert("F"))[::-1].T


def _only_map(path: Path) -> np.ndarray:
    """Return the only 2-D array of a .npz file."""
    with np.load(path) as archive:
        maps = {name: values for name, values in archive.items() if np.ndim(values) == 2}
        if len(maps) != 1:
            names = ", ".join(name[:24] for name in list(maps or archive.files)[:4]) or "nothing"
            raise ValueError(f"it needs exactly one 2-D array, got {len(maps)} among {len(archive.files)}: {names}")
    return maps.popitem()[1]
