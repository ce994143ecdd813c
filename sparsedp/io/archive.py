"""Save fields with their grid to files, and load them. The suffix of the file name selects the format."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparsedp._utils.validation import check_finite
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.io.atomic_files import load_tree, save_tree
from sparsedp.io.file_format import EXTRA_TYPE_CODES, KIND, REAL, check_fields

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["load", "save"]

LABELLED = (".nc", ".zarr")
PARAVIEW = (".vti", ".vtr", ".pvd")
NEEDS: dict[str, tuple[str, ...]] = {  # libraries of the extra `files`, by suffix
    ".npz": (),
    ".nc": ("xarray", "h5netcdf", "h5py"),
    ".zarr": ("xarray", "zarr"),
    **dict.fromkeys(PARAVIEW, ("pyevtk",)),
}
DTYPES = {".npz": None, **dict.fromkeys(LABELLED, REAL + EXTRA_TYPE_CODES), **dict.fromkeys(PARAVIEW, REAL)}


def save(
    path: str | os.PathLike,
    grid: Grid,
    /,
    *,
    times: ArrayLike | None = None,
    attrs: dict | None = None,
    at: dict[str, str] | None = None,
    **fields: ArrayLike,
) -> None:
    """Save a grid and fields on it to a file. The suffix of the file name selects the format.

    =========== ==============================================================================================
    .npz        Needs only NumPy. `load` returns bit-identical arrays.
    .nc, .zarr  An xarray Dataset (see `dp.interop.to_xarray`) as a NetCDF 4 file or a Zarr folder, with a checksum.
                `load` returns bit-identical values in native byte order.
    .vti, .vtr  For ParaView: .vti for a uniform grid, .vtr for any grid. Fields on cells become cell data, fields on
                nodes point data. Fields on faces or edges become cell vectors: each component is the mean over the 2
                faces, or over the 2 or 4 edges, of a cell. Batch entries are numbered in the name of the field. A 1-D
                or 2-D grid gets one cell along each missing axis, as wide as the first cell along x. `load` does not
                read these files.
    .pvd        A time series for ParaView: wind.pvd is the index, and wind/0000.vtr, ... have the fields at each time.
    =========== ==============================================================================================

    An existing file or folder with this name is replaced only when the new one is complete. The files of a .pvd series
    are replaced one by one.

    Parameters
    ----------
    path : str or path
    grid : Grid
        The file stores cell widths, origin and periodicity; files for ParaView do not store periodicity.
    times : array, shape (n,), optional
        Times [time] of a series. If given, the first axis of each field has length n.
    attrs : dict, optional
        Attributes for other programs that read .nc and .zarr files. The keys are names of fields, "x", "y", "z" or
        "times"; a value is the unit, or a dict of attributes:
        ``{"x": "m", "u": {"units": "m/s", "long_name": "speed"}}``.
    at : dict of str, optional
        The space of a field: "cells", "faces", "nodes" or "edges", by the name of the field. Default: the first of
        these spaces whose shape matches.
    **fields : arrays, shape (..., *space.shape)
        Fields on cells, faces, nodes or edges of the grid. Leading axes are batch axes.

    Raises
    ------
    ShapeError
        If the shape of an array matches no space of the grid, or its first axis does not match `times`.
    TypeError
        If a field is not a plain array of numbers (but a traced value, a tensor or a distributed field), if the format
        does not support its dtype (half precision in .nc and .zarr; in files for ParaView also complex and bool), or if
        an attribute is neither text nor numbers.
    ValueError
        If the suffix is unknown, or the format does not support the grid, a series, or attributes.
    ImportError
        If a library for the format is missing. The extra `files` installs all of them; .npz needs none.
    OSError
        If the file cannot be written.

    See Also
    --------
    load, interop.to_xarray

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> grid, path = Grid((4, 3), size=1.0, periodic=True), Path(tempfile.mkdtemp(), "wind.npz")
    >>> save(path, grid, wind=np.ones(grid.faces.size), times=None)
    >>> load(path)[0] == grid, load(path)[1]["wind"].shape
    (True, (24,))
    """
    suffix = _suffix("save", path, (".npz", *LABELLED, *PARAVIEW))
    check_grid("save", grid)
    times, content = check_fields("save", grid, times, at, fields, DTYPES[suffix])
    if attrs is not None and suffix not in LABELLED:
        raise ValueError(f"save keeps attrs in .nc and .zarr files, got {Path(path).name!r}; write 'fields.nc'")
    if suffix in PARAVIEW:
        _check_for_paraview(suffix, grid, times, content)
    _check_installed("save", suffix)
    if suffix == ".npz":
        arguments = {"shape": grid.shape, "spacing": grid.widths, "origin": grid.origin, "periodic": grid.periodic}
        arrays = {field: values for field, (_, values) in content.items()}
        save_tree(path, {"grid": arguments, "times": times, "fields": arrays}, KIND)
    elif suffix in LABELLED:
        from sparsedp.io import labelled

        labelled.write_dataset(path, labelled.dataset_of("save", grid, attrs, times, content))
    else:
        from sparsedp.io import paraview

        if times is None:
            paraview.write_grid(path, grid, content)
        else:
            paraview.write_series(path, grid, times, content)


def _check_for_paraview(suffix, grid, times, content):
    """Raise ValueError if a file for ParaView cannot store these fields, times or grid."""
    if (times is None) == (suffix == ".pvd"):
        raise ValueError(f"save puts one state into .vti or .vtr, and a series with times into .pvd, got {suffix}")
    if times is not None:
        check_finite("times of save", times)
    if suffix == ".vti" and not (content and grid.cells.size and all(grid.uniform)):
        raise ValueError(
            f"save puts fields on uniform grids into .vti, got {len(content)} on {grid}; write 'fields.vtr'"
        )


def load(path: str | os.PathLike) -> tuple[Grid, dict[str, Any]]:
    """Load the grid and the fields from a file that `save` wrote.

    Parameters
    ----------
    path : str or path
        A path that ends in .npz, .nc or .zarr.

    Returns
    -------
    grid : Grid
        Equal to the saved grid.
    fields : dict of arrays
        The fields by name, with the saved shapes and dtypes. If times were saved, they have the key "times".

    Raises
    ------
    ValueError
        If the suffix is not supported, or if the file was not written by `save`, is damaged, or was changed by another
        program.
    ImportError
        If a library for the format is missing. The extra `files` installs all of them; .npz needs none.
    OSError
        If the file does not exist or cannot be read.

    See Also
    --------
    save

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> path = Path(tempfile.mkdtemp(), "heat.npz")
    >>> save(path, Grid(2), times=[0.0, 0.5], u=np.eye(2))
    >>> grid, fields = load(path)
    >>> fields["times"]
    array([0. , 0.5])
    """
    suffix = _suffix("load", path, (".npz", *LABELLED))
    _check_installed("load", suffix)
    if suffix == ".npz":
        stored = load_tree(path, KIND)
    else:
        from sparsedp.io import labelled

        stored = labelled.read_dataset(path)
    if stored is None:
        reader = "np.load" if suffix == ".npz" else "xarray.open_dataset"
        raise ValueError(
            f"load takes a file that dp.save wrote, {path} is another one or damaged; write {reader}(path)"
        )
    [content] = stored
    times = {} if content["times"] is None else {"times": content["times"]}
    return Grid(**content["grid"]), {**content["fields"], **times}


def _suffix(name, path, allowed):
    """Return the suffix of a path, in lower case."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"{name} takes the path of a file first, got {type(path).__name__}; write 'fields.npz'")
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        *others, last = allowed
        instead = "save the fields as .npz too" if suffix in PARAVIEW else "write 'fields.npz'"
        raise ValueError(
            f"{name} takes a path that ends in {', '.join(others)} or {last}, got {Path(path).name!r}; {instead}"
        )
    return suffix


def _check_installed(name, suffix):
    """Raise ImportError if a library for a format is missing."""
    for library in NEEDS[suffix]:
        if find_spec(library) is None:
            raise ImportError(f"{name} needs {library} for {suffix} files; install sparsedp[files]")
