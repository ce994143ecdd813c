"""Fields as datasets of xarray, and .nc and .zarr files of them. The only file that imports xarray (extra `files`)."""

from __future__ import annotations

import io
import json
import os
from math import prod
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import xarray

from sparsedp._utils.validation import check_type
from sparsedp.errors import ShapeError
from sparsedp.grid.grid import AXES, Grid, check_grid, node_axes
from sparsedp.io.atomic_files import path_errors, write_file, write_through
from sparsedp.io.file_format import KIND, check_fields, check_names

__all__ = ["dataset_of", "from_xarray", "read_dataset", "to_xarray", "write_dataset"]

TOLERANCE = 1e-3  # of the thinnest cell: largest deviation of coordinates, which float32 needs


def to_xarray(
    grid: Grid, /, *, times: Any = None, attrs: dict | None = None, at: dict[str, str] | None = None, **fields: Any
) -> xarray.Dataset:
    """Return fields on a grid as a Dataset of xarray, with coordinates.

    A variable on cells has the dimensions x, y, z, on nodes x_nodes, y_nodes, z_nodes. A field on faces or edges is a
    variable for each component, u_x on (x_nodes, y, z) and so on; leading axes are u_batch_0 and so on. The widths
    of the cells are the variables x_widths and so on.

    Parameters
    ----------
    grid : Grid
    times : array, shape (n,), optional
        Times [time] of a series, the coordinate `time`: then each field has n entries in its first axis.
    attrs : dict, optional
        Units, or a dict of attributes, by the name of a field, "x", "y", "z" or "times":
        ``{"x": "m", "u": {"units": "m/s", "long_name": "speed"}}``.
    at : dict of str, optional
        "cells", "faces", "nodes" or "edges" by the name of a field; default: the first of them whose shape fits.
    **fields : arrays, shape (..., *space.shape)

    Returns
    -------
    xarray.Dataset
        It may share memory with the fields.

    Raises
    ------
    ShapeError, TypeError
        If an array is no field on the grid, or no plain array of numbers.
    ValueError
        If two variables would have one name, or a key of `attrs` or `at` is unknown.

    See Also
    --------
    interop.from_xarray, save

    Examples
    --------
    >>> from sparsedp import Grid
    >>> to_xarray(Grid((4, 3)), u=np.ones((4, 3)), wind=np.zeros(31)).wind_y.dims
    ('x', 'y_nodes')
    """
    check_grid("to_xarray", grid)
    return dataset_of("to_xarray", grid, attrs, *check_fields("to_xarray", grid, times, at, fields))


def from_xarray(grid: Grid, array: xarray.DataArray, /) -> np.ndarray:
    """Return a DataArray of xarray as an array on the cells of a grid; dimensions are ordered by their names.

    Parameters
    ----------
    grid : Grid
    array : xarray.DataArray
        With the dimensions x, y, z of the grid. If these have coordinates, they are the centres of its cells, up to
        0.1 % of the thinnest cell. Other dimensions come first, as a batch, and have no coordinates.

    Returns
    -------
    array, shape (..., *grid.shape)
        A copy.

    Raises
    ------
    TypeError
        If `array` is no DataArray.
    ShapeError
        If its coordinates along an axis are not those of the grid.
    ValueError
        If a dimension is missing, or the array has coordinates that would be lost.

    See Also
    --------
    interop.to_xarray

    Examples
    --------
    >>> from sparsedp import Grid
    >>> array = xarray.DataArray([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dims=("y", "x"))
    >>> from_xarray(Grid((3, 2)), array)
    array([[1., 4.],
           [2., 5.],
           [3., 6.]])
    """
    check_grid("from_xarray", grid)
    check_type("from_xarray", array, xarray.DataArray, "a DataArray", "dataset['u']")
    others = sorted(set(array.coords) - set(grid.axes))
    if others or not set(grid.axes) <= set(array.dims):
        raise ValueError(
            f"from_xarray takes dimensions {grid.axes} and no coordinates but theirs, got {array.dims} and {others}; "
            "write u.rename(lon='x') or u.drop_vars('time')"
        )
    for number, axis in enumerate(grid.axes):
        centres = grid.coordinates(number)
        reach = TOLERANCE * np.min(grid.widths[number], initial=np.inf)
        places = array[axis].values if axis in array.coords else centres
        if array.sizes[axis] != centres.size or not np.allclose(places, centres, rtol=0, atol=reach):
            raise ShapeError(
                f"from_xarray takes {axis} at the {centres.size} centres of {grid}, got {array.sizes[axis]} from "
                f"{places[:1]} to {places[-1:]}; write another Grid, or u.sortby({axis!r})"
            )
    return np.array(array.transpose(..., *grid.axes).values)


def dataset_of(name: str, grid: Grid, attrs: dict | None, times: Any, content: dict[str, Any]) -> xarray.Dataset:
    """Return the Dataset of fields that `check_fields` has checked."""
    check_names(name, "attrs", attrs, [*content, *grid.axes, "times"])
    for key, one in (attrs or {}).items():
        if not isinstance(one, str) and not (isinstance(one, dict) and all(map(_is_attribute, one, one.values()))):
            raise TypeError(
                f"{name} takes units as a str, or a dict of str, numbers and arrays, in attrs, got {one!r} for {key}; "
                f"write {{{key!r}: 'm'}}"
            )
    given = {key: {"units": one} if isinstance(one, str) else one for key, one in (attrs or {}).items()}
    coords: dict[str, Any] = {}
    variables: dict[str, Any] = {}
    for number, axis in enumerate(grid.axes):
        coords[axis] = axis, grid.coordinates(number), given.get(axis)
        coords[f"{axis}_nodes"] = f"{axis}_nodes", grid.coordinates(number, "nodes"), given.get(axis)
        variables[f"{axis}_widths"] = axis, grid.widths[number], given.get(axis)
    if times is not None:
        coords["time"] = "time", times, given.get("times")
    notes: dict[str, Any] = {"format": KIND, "origin": grid.origin, "periodic": grid.periodic, "fields": {}}
    series = [] if times is None else ["time"]
    for field, (space, values) in content.items():
        lead = values.shape[: values.ndim - len(space.shape)]
        batch = series + [f"{field}_batch_{n}" for n in range(len(lead) - len(series))]
        flat = np.split(values.reshape(*lead, space.size), space.offsets[1:-1], axis=-1)
        labels = [field]
        if space.kind in ("faces", "edges"):
            labels = [f"{field}_{axis}" for axis in grid.axes]
        for number, (label, part) in enumerate(zip(labels, flat)):
            if label in {*variables, *coords}:
                raise ValueError(f"{name} would store {field} as {label}, which exists; write another name")
            on_nodes = node_axes(space.kind, number, grid.dim) or ()
            places = [f"{axis}_nodes" if n in on_nodes else axis for n, axis in enumerate(grid.axes)]
            variables[label] = batch + places, part.reshape(*lead, *space.parts[number]), given.get(field)
        notes["fields"][field] = space.kind, labels
    return xarray.Dataset(variables, coords, {"sparsedp": json.dumps(notes)})


def _is_attribute(key, value):
    """Return whether files can store an attribute: text, numbers or an array of numbers."""
    entries = value if isinstance(value, (list, tuple)) else [value]
    numbers = all(
        isinstance(x, (np.ndarray, np.generic, int, float))
        and np.asarray(x).dtype.kind in "iuf"
        and (x is value or np.ndim(x) == 0)
        for x in entries
    )
    return isinstance(key, str) and key != "" and (isinstance(value, str) or numbers)


def write_dataset(path: Any, dataset: xarray.Dataset) -> None:
    """Write a Dataset atomically as a .nc file or a .zarr folder, with a checksum of its content."""
    dataset.attrs["sparsedp_crc32"] = _checksum(dataset)
    if _is_zarr(path):  # Zarr would drop chunks of -0.0, and of NaN with other bits, as empty
        options = {"zarr_format": 2, "consolidated": True, "write_empty_chunks": True}
        write_through(path, lambda part: dataset.to_zarr(part, **options))
    else:
        import h5netcdf

        memory = io.BytesIO()  # on a full disk HDF5 would end the process
        with h5netcdf.File(memory, "w") as file:
            dataset.dump_to_store(xarray.backends.H5NetCDFStore(file))
        write_file(path, memory.getbuffer())


def _is_zarr(path):
    """Return whether a path is a folder of Zarr."""
    return Path(path).suffix.lower() == ".zarr"


def read_dataset(path: Any) -> tuple[dict] | None:
    """Return the content of a file that `write_dataset` wrote, in a tuple; None if it is another file, or changed."""
    with path_errors(path, reading=True):  # a missing or unreadable file is not a damaged one
        if _is_zarr(path):
            os.scandir(path).close()
        else:
            open(path, "rb").close()
    try:
        engine = "zarr" if _is_zarr(path) else "h5netcdf"
        with xarray.open_dataset(path, engine=engine, mask_and_scale=False, decode_times=False) as stored:
            dataset = stored.load()
        notes = json.loads(dataset.attrs["sparsedp"])
        if notes.pop("format") != KIND or dataset.attrs["sparsedp_crc32"] != _checksum(dataset):
            return None
    except (MemoryError, PermissionError):
        raise
    except Exception:  # readers raise errors of many classes for damaged files
        return None
    fields = {field: _joined(dataset, *stored) for field, stored in notes.pop("fields").items()}
    widths = [dataset[f"{axis}_widths"].values for axis, _ in zip(AXES, notes["origin"])]
    times = dataset["time"].values if "time" in dataset.dims else None
    grid = {"shape": tuple(map(len, widths)), "spacing": widths, **notes}
    return ({"grid": grid, "times": times, "fields": fields},)


def _joined(dataset, kind, labels):
    """Return a field of its variables."""
    parts = [dataset[label].values for label in labels]
    if kind in ("cells", "nodes"):
        return parts[0]
    lead = parts[0].ndim - len(labels)  # one component for each axis of the grid
    return np.concatenate([part.reshape(*part.shape[:lead], prod(part.shape[lead:])) for part in parts], axis=-1)


def _checksum(dataset):
    """Return a checksum of all variables and notes of a Dataset."""
    total = crc32(dataset.attrs["sparsedp"].encode())
    for name in sorted(dataset.variables):
        values = dataset[name].values
        total = crc32(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).data, total)
    return total
