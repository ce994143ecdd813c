"""Fields with their grid in files, and pictures as fields."""

from pathlib import Path

import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.fields import check_plain
from sparsedp.files import load_tree, save_tree
from sparsedp.grid import Grid, check_grid

__all__ = ["from_image", "load", "save"]

KIND = "sparsedp fields 1"
SHADES = {"1": 1, "L": 255, "P": 255, "RGB": 255, "I;16": 65535, "I;16L": 65535, "I;16B": 65535}  # what counts as white
SPACES = ("cells", "faces", "nodes", "edges")


def save(path, grid, /, *, times=None, **fields):
    """Grid and fields on it -> one .npz file that `load` gives back, the fields bit for bit. NumPy alone reads it too.

    A file of this name is replaced, once the new one is whole.

    Parameters
    ----------
    path : str or path
        Ends in .npz.
    grid : Grid
        Stretched axes, origin and periodic axes are kept.
    times : array, shape (n,), optional
        Times [time] of a series: then each field has n entries in its first axis.
    **fields : arrays, shape (..., *space.shape)
        On cells, faces, nodes or edges of the grid, of any dtype of numbers; leading axes are a batch.

    Raises
    ------
    ShapeError
        If an array is no field on the grid, or has not one entry for each time.
    TypeError
        If a field is no plain array of numbers: a value on a tape, a tensor, a field on ranks.
    ValueError
        If the name ends otherwise.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> grid, path = Grid((4, 3), size=1.0, periodic=True), Path(tempfile.mkdtemp(), "wind.npz")
    >>> save(path, grid, wind=np.ones(grid.faces.size), times=None)
    >>> load(path)[0] == grid, load(path)[1]["wind"].shape
    (True, (24,))
    """
    _suffix("save", path)
    check_grid("save", grid)
    if times is not None:
        times = _numbers("times", times)
        if times.ndim != 1:
            raise ShapeError(f"save takes times of shape (n,), got {times.shape}; write np.atleast_1d(times)")
    arrays = {name: _field(name, grid, value, times) for name, value in fields.items()}
    made = {"shape": grid.shape, "spacing": grid.widths, "origin": grid.origin, "periodic": grid.periodic}
    save_tree(path, {"grid": made, "times": times, "fields": arrays}, KIND)


def load(path):
    """File that `save` wrote -> (grid, fields).

    Parameters
    ----------
    path : str or path

    Returns
    -------
    grid : Grid
        Equal to the one that was saved.
    fields : dict of arrays
        By name, with shapes and dtypes as saved; and "times", where times were saved.

    Raises
    ------
    ValueError
        If the file is another one, or damaged.
    OSError
        If there is no such file, or it cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "heat.npz")
    >>> save(path, Grid(2), times=[0.0, 0.5], u=np.eye(2))
    >>> grid, fields = load(path)
    >>> fields["times"]
    array([0. , 0.5])
    """
    _suffix("load", path)
    found = load_tree(path, KIND)
    if found is None:
        raise ValueError(f"load takes a file that dp.save wrote, {path} is another one or damaged; write np.load(path)")
    [content] = found
    times = {} if content["times"] is None else {"times": content["times"]}
    return Grid(**content["grid"]), {**content["fields"], **times}


def from_image(path):
    """Picture -> array from 0 (black) to 1 (white), its axes turned: axis 0 is x, to the right, axis 1 is y, up.

    Parameters
    ----------
    path : str or path
        Of a .png, .jpg or any other format that Pillow reads; grey, coloured or of two colours.

    Returns
    -------
    array, shape (width, height), or (3, width, height) of a coloured picture: a batch of red, green and blue
        Write ``dp.Grid(u.shape[-2:])`` for a grid of its pixels.

    Raises
    ------
    ValueError
        If the picture has transparent parts, or numbers whose white is not known.
    ImportError
        If Pillow is missing; the extra `plot` brings it.
    OSError
        If there is no such file, or it is no picture.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "corner.pgm")
    >>> _ = path.write_bytes(b"P5 3 2 255 " + bytes([0, 0, 255, 0, 0, 0]))  # white: the upper right corner
    >>> from_image(path)
    array([[0., 0.],
           [0., 0.],
           [0., 1.]])
    """
    try:
        from PIL import Image, ImageOps
    except ImportError as error:
        raise ImportError("from_image needs Pillow; install sparsedp[plot]") from error
    with Image.open(path) as stored:
        image = ImageOps.exif_transpose(stored)
        if image.mode not in SHADES or "transparency" in image.info:
            raise ValueError(
                f"from_image takes grey or RGB pictures without transparency, {path} has mode {image.mode}; "
                "save it as RGB"
            )
        white = SHADES[image.mode]
        pixels = np.asarray(image.convert("RGB") if image.mode == "P" else image)
    return np.moveaxis(pixels[::-1], (0, 1), (-1, -2)) / white


def _suffix(name, path):
    if Path(path).suffix.lower() != ".npz":
        raise ValueError(f"{name} takes a path that ends in .npz, got {Path(path).name!r}; write 'fields.npz'")


def _numbers(name, value):
    check_plain("save", value)
    numbers = np.asarray(value) if isinstance(value, (np.ndarray, np.generic, float, int, list, tuple)) else None
    if numbers is None or numbers.dtype.kind not in "biufc":
        raise TypeError(
            f"save takes arrays of numbers, {name} is of type {type(value).__name__}; "
            f"write np.asarray({name}), or dp.gather({name}) on ranks"
        )
    return numbers


def _field(name, grid, value, times):
    field = _numbers(name, value)
    if times is not None and field.shape[:1] != times.shape:
        raise ShapeError(f"{name} has shape {field.shape}, and there are {times.size} times; write np.stack(states)")
    shape = field.shape if times is None else field.shape[1:]
    spaces = [getattr(grid, kind).shape for kind in SPACES]
    if not any(shape[len(shape) - len(wanted) :] == wanted for wanted in spaces if len(wanted) <= len(shape)):
        raise ShapeError(
            f"{name} has shape {field.shape}, which is no field on cells, faces, nodes or edges of {grid}; "
            f"those on cells have {grid.shape}"
        )
    return field
