"""Fields with their grid in files: what the end of a name means."""

import os
from importlib.util import find_spec
from pathlib import Path

from sparsedp._utils.validation import check_finite
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.io.atomic_files import load_tree, save_tree
from sparsedp.io.contents import KIND, OTHERS, REAL, check_fields

__all__ = ["load", "save"]

LABELLED, PARAVIEW = (".nc", ".zarr"), (".vti", ".vtr", ".pvd")
NEEDS = {  # of the extra `files`
    ".npz": (),
    ".nc": ("xarray", "h5netcdf", "h5py"),
    ".zarr": ("xarray", "zarr"),
    **dict.fromkeys(PARAVIEW, ("pyevtk",)),
}
DTYPES = {".npz": None, **dict.fromkeys(LABELLED, REAL + OTHERS), **dict.fromkeys(PARAVIEW, REAL)}


def save(path, grid, /, *, times=None, attrs=None, at=None, **fields):
    """Grid and fields on it -> a file, or a series of files; what its name ends in says of which kind.

    =========== ==============================================================================================
    .npz        NumPy alone. `load` gives the same bits.
    .nc, .zarr  A Dataset of xarray (`dp.interop.to_xarray` says what is in it) as NetCDF 4, or as a folder of
                Zarr, with a checksum. `load` gives the same bits, bytes in the order of this machine.
    .vti, .vtr  For ParaView, of a uniform grid or of any. Fields on cells are cell data, on nodes point data. Fields
                on faces or edges become vectors in the cells: each component is the mean of the 2 faces, or of the 2
                or 4 edges, of a cell. An entry of a batch has its number in the name. In 1-D and 2-D the other axes
                have one cell, as wide as the first of x. `load` does not read these files.
    .pvd        The same at each of `times`: wind.pvd, and wind/0000.vtr and so on.
    =========== ==============================================================================================

    What has this name is replaced, once the new file or folder is whole; the files of a series are so one by one.

    Parameters
    ----------
    path : str or path
    grid : Grid
        Stretched axes, origin and periodic axes are kept, but that ParaView knows of no periodic axes.
    times : array, shape (n,), optional
        Times [time] of a series: then each field has n entries in its first axis.
    attrs : dict, optional
        Units, or a dict of attributes, by the name of a field, "x", "y", "z" or "times", for those who read .nc and
        .zarr elsewhere: ``{"x": "m", "u": {"units": "m/s", "long_name": "speed"}}``.
    at : dict of str, optional
        "cells", "faces", "nodes" or "edges" by the name of a field, where the first that fits is not the one.
    **fields : arrays, shape (..., *space.shape)
        On cells, faces, nodes or edges of the grid; leading axes are a batch.

    Raises
    ------
    ShapeError
        If an array is no field on the grid, or has not one entry for each time.
    TypeError
        If a field is no plain array of numbers: a value on a tape, a tensor, a field on ranks; or has a dtype that the
        file has not: half precision; for ParaView complex numbers and truth values. Or if attributes are neither text
        nor numbers.
    ValueError
        If the name ends otherwise, or the file cannot hold this grid, a series, or attributes.
    ImportError
        If a library is missing; the extra `files` brings all but those of .npz.
    OSError
        If the file cannot be written.

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
        made = {"shape": grid.shape, "spacing": grid.widths, "origin": grid.origin, "periodic": grid.periodic}
        arrays = {field: values for field, (_, values) in content.items()}
        save_tree(path, {"grid": made, "times": times, "fields": arrays}, KIND)
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
    """Refuse what its files cannot hold."""
    if (times is None) == (suffix == ".pvd"):
        raise ValueError(f"save puts one state into .vti or .vtr, and a series with times into .pvd, got {suffix}")
    if times is not None:
        check_finite("times of save", times)
    if suffix == ".vti" and not (content and grid.cells.size and all(grid.uniform)):
        raise ValueError(
            f"save puts fields on uniform grids into .vti, got {len(content)} on {grid}; write 'fields.vtr'"
        )


def load(path):
    """File that `save` wrote -> (grid, fields).

    Parameters
    ----------
    path : str or path
        Ends in .npz, .nc or .zarr.

    Returns
    -------
    grid : Grid
        Equal to the one that was saved.
    fields : dict of arrays
        By name, with shapes and dtypes as saved; and "times", where times were saved.

    Raises
    ------
    ValueError
        If the file is another one, damaged, or changed by another program; or if its name ends otherwise.
    ImportError
        If a library is missing; the extra `files` brings all but those of .npz.
    OSError
        If there is no such file, or it cannot be read.

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
    for library in NEEDS[suffix]:
        if find_spec(library) is None:
            raise ImportError(f"{name} needs {library} for {suffix} files; install sparsedp[files]")
