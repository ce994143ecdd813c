"""Save fields with their grid in files, and load them; the suffix of a name chooses the format."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparsedp._utils.validation import check_finite
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.io.atomic_files import load_tree, save_tree
from sparsedp.io.file_format import KIND, OTHERS, REAL, check_fields

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["load", "save"]

LABELLED = (".nc", ".zarr")
PARAVIEW = (".vti", ".vtr", ".pvd")
NEEDS: dict[str, tuple[str, ...]] = {  # of the extra `files`
    ".npz": (),
    ".nc": ("xarray", "h5netcdf", "h5py"),
    ".zarr": ("xarray", "zarr"),
    **dict.fromkeys(PARAVIEW, ("pyevtk",)),
}
DTYPES = {".npz": None, **dict.fromkeys(LABELLED, REAL + OTHERS), **dict.fromkeys(PARAVIEW, REAL)}


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
    """Save a grid and fields on it in a file, or a series in several files; the suffix chooses the format.

    =========== ==============================================================================================
    .npz        NumPy alone. `load` returns the same bits.
    .nc, .zarr  A Dataset of xarray (see `dp.interop.to_xarray`) as NetCDF 4, or as a folder of Zarr, with a checksum.
                `load` returns the same bits, bytes in the order of this machine.
    .vti, .vtr  For ParaView: .vti for a uniform grid, .vtr for any grid. Fields on cells are cell data, on nodes point
                data. Fields on faces or edges are stored as vectors in the cells: each component is the mean of the 2
                faces, or of the 2 or 4 edges, of a cell. An entry of a batch has its number in the name. In 1-D and
                2-D the other axes have one cell, as wide as the first one along x. `load` does not read these files.
    .pvd        The same at each of `times`: wind.pvd, and wind/0000.vtr and so on.
    =========== ==============================================================================================

    An existing file or folder of this name is replaced once the new one is complete; of a series, file by file.

    Parameters
    ----------
    path : str or path
    grid : Grid
        Stretched axes, origin and periodic axes are stored; files for ParaView do not store periodicity.
    times : array, shape (n,), optional
        Times [time] of a series: then each field has n entries in its first axis.
    attrs : dict, optional
        Units, or a dict of attributes, by the name of a field, "x", "y", "z" or "times", for other readers of .nc and
        .zarr files: ``{"x": "m", "u": {"units": "m/s", "long_name": "speed"}}``.
    at : dict of str, optional
        "cells", "faces", "nodes" or "edges" by the name of a field; default: the first of them whose shape fits.
    **fields : arrays, shape (..., *space.shape)
        On cells, faces, nodes or edges of the grid; leading axes are a batch.

    Raises
    ------
    ShapeError
        If an array is no field on the grid, or does not have one entry for each time.
    TypeError
        If a field is no plain array of numbers (a traced value, a tensor, a distributed field), if its dtype cannot be
        stored (half precision; for ParaView also complex numbers and bools), or if attributes are neither text nor
        numbers.
    ValueError
        If the suffix is another one, or the file cannot hold this grid, a series, or attributes.
    ImportError
        If a library is missing; the extra `files` installs all of them; .npz needs none.
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
    """Raise ValueError if a file for ParaView cannot hold the fields."""
    if (times is None) == (suffix == ".pvd"):
        raise ValueError(f"save puts one state into .vti or .vtr, and a series with times into .pvd, got {suffix}")
    if times is not None:
        check_finite("times of save", times)
    if suffix == ".vti" and not (content and grid.cells.size and all(grid.uniform)):
        raise ValueError(
            f"save puts fields on uniform grids into .vti, got {len(content)} on {grid}; write 'fields.vtr'"
        )


def load(path: str | os.PathLike) -> tuple[Grid, dict[str, Any]]:
    """Load the grid and the fields of a file that `save` wrote.

    Parameters
    ----------
    path : str or path
        Ends in .npz, .nc or .zarr.

    Returns
    -------
    grid : Grid
        Equal to the one that was saved.
    fields : dict of arrays
        By name, with shapes and dtypes as saved; and "times", if times were saved.

    Raises
    ------
    ValueError
        If the file is of another kind, damaged, or changed by another program, or if its suffix is another one.
    ImportError
        If a library is missing; the extra `files` installs all of them; .npz needs none.
    OSError
        If there is no such file, or it cannot be read.

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
