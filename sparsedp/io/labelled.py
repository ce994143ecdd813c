"""Fields as xarray Datasets, and as .nc and .zarr files. Only this module imports xarray (extra `files`)."""

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

TOLERANCE = 1e-3  # largest deviation of coordinates relative to the thinnest cell; float32 coordinates need it


def to_xarray(
    grid: Grid, /, *, times: Any = None, attrs: dict | None = None, at: dict[str, str] | None = None, **fields: Any
) -> xarray.Dataset:
    """Return fields on a grid as an xarray Dataset with coordinates.

    A field on cells has the dimensions x, y, z; a field on nodes has x_nodes, y_nodes, z_nodes. A field u on faces or
    edges becomes one variable for each component; for example u_x on faces has the dimensions (x_nodes, y, z). Batch
    axes are named u_batch_0, u_batch_1, ... The variables x_widths, ... have the widths of the cells.

    Parameters
    ----------
    grid : Grid
    times : array, shape (n,), optional
        Times [time] of a series; they become the coordinate `time`. If given, the first axis of each field has
        length n.
    attrs : dict, optional
        Attributes. The keys are names of fields, "x", "y", "z" or "times"; a value is the unit, or a dict of
        attributes: ``{"x": "m", "u": {"units": "m/s", "long_name": "speed"}}``.
    at : dict of str, optional
        The space of a field: "cells", "faces", "nodes" or "edges", by the name of the field. Default: the first of
        these spaces whose shape matches.
    **fields : arrays, shape (..., *space.shape)
        Fields on cells, faces, nodes or edges of the grid. Leading axes are batch axes.

    Returns
    -------
    xarray.Dataset
        The Dataset may share memory with the fields.

    Raises
    ------
    ShapeError, TypeError
        If the shape of an array matches no space of the grid, or a field is not a plain array of numbers.
    ValueError
        If two variables would have the same name, or if `attrs` or `at` has an unknown key.

    See Also
    --------
    interop.from_xarray, interop.with_units, save

    Examples
    --------
    >>> from sparsedp import Grid
    >>> to_xarray(Grid((4, 3)), u=np.ones((4, 3)), wind=np.zeros(31)).wind_y.dims
    ('x', 'y_nodes')
    """
    check_grid("to_xarray", grid)
    return dataset_of("to_xarray", grid, attrs, *check_fields("to_xarray", grid, times, at, fields))


def from_xarray(grid: Grid, array: xarray.DataArray, /) -> np.ndarray:
    """Convert an xarray DataArray to a NumPy array on the cells of a grid.

    The dimensions are transposed to the order of the axes of the grid.

    Parameters
    ----------
    grid : Grid
    array : xarray.DataArray
        It has a dimension for each axis (x, y, z) of the grid. If such a dimension has coordinates, they must be equal
        to the cell centres, up to 0.1 % of the thinnest cell. Other dimensions become leading batch axes and must not
        have coordinates.

    Returns
    -------
    array, shape (..., *grid.shape)
        A copy of the values.

    Raises
    ------
    TypeError
        If `array` is not a DataArray.
    ShapeError
        If the coordinates along an axis are not the cell centres of the grid.
    ValueError
        If a dimension is missing, or if the array has other coordinates, which the result could not store.

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
    """Return a Dataset of fields that were checked by `check_fields`."""
    check_names(name, "attrs", attrs, [*content, *grid.axes, "times"])
    for key, one in (attrs or {}).items():
        if not isinstance(one, str) and not (isinstance(one, dict) and all(map(_is_attribute, one, one.values()))):
            raise TypeError(
                f"{name} takes units as a str, or a dict of str, numbers and arrays, in attrs, got {one!r} for {key}; "
                f"write {{{key!r}: 'm'}}"
            )
    attributes = {key: {"units": one} if isinstance(one, str) else one for key, one in (attrs or {}).items()}
    coords: dict[str, Any] = {}
    variables: dict[str, Any] = {}
    for number, axis in enumerate(grid.axes):
        coords[axis] = axis, grid.coordinates(number), attributes.get(axis)
        coords[f"{axis}_nodes"] = f"{axis}_nodes", grid.coordinates(number, "nodes"), attributes.get(axis)
        variables[f"{axis}_widths"] = axis, grid.widths[number], attributes.get(axis)
    if times is not None:
        coords["time"] = "time", times, attributes.get("times")
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
            variables[label] = batch + places, part.reshape(*lead, *space.parts[number]), attributes.get(field)
        notes["fields"][field] = space.kind, labels
    return xarray.Dataset(variables, coords, {"sparsedp": json.dumps(notes)})


def _is_attribute(key, value):
    """Return True if files can store an attribute: text, a number, or a list or array of numbers."""
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
    if _is_zarr(path):  # by default Zarr omits chunks of -0.0 or NaN, and loses their exact bits
        options = {"zarr_format": 2, "consolidated": True, "write_empty_chunks": True}
        write_through(path, lambda part: dataset.to_zarr(part, **options))
    else:
        import h5netcdf

        memory = io.BytesIO()  # written to memory first, because HDF5 aborts the process if the disk is full
        with h5netcdf.File(memory, "w") as file:
            dataset.dump_to_store(xarray.backends.H5NetCDFStore(file))
        write_file(path, memory.getbuffer())


def _is_zarr(path):
    """Return whether a path has the suffix of a Zarr folder."""
    return Path(path).suffix.lower() == ".zarr"


def read_dataset(path: Any) -> tuple[dict] | None:
    """Read a file that `write_dataset` wrote. Return (content,), or None if the file is another one or was changed."""
    with path_errors(path, reading=True):  # a missing or unreadable file raises OSError; damaged ones give None
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
    """Return a field, joined from the variables of its components."""
    parts = [dataset[label].values for label in labels]
    if kind in ("cells", "nodes"):
        return parts[0]
    lead = parts[0].ndim - len(labels)  # one component for each axis of the grid
    return np.concatenate([part.reshape(*part.shape[:lead], prod(part.shape[lead:])) for part in parts], axis=-1)


def _checksum(dataset):
    """Return a checksum of all variables and of the attribute `sparsedp` of a Dataset."""
    total = crc32(dataset.attrs["sparsedp"].encode())
    for name in sorted(dataset.variables):
        values = dataset[name].values
        total = crc32(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).data, total)
    return total
