"""Fields as data sets of xarray, and .nc and .zarr files of them. The only file that imports xarray (extra `files`)."""

import io
import json
import os
from math import prod
from pathlib import Path
from zlib import crc32

import numpy as np
import xarray

from sparsedp._utils.validation import check_type
from sparsedp.errors import ShapeError
from sparsedp.grid.grid import AXES, check_grid, node_axes
from sparsedp.io.atomic_files import path_errors, write_file, write_through
from sparsedp.io.contents import KIND, check_fields, check_names

__all__ = ["dataset_of", "from_xarray", "read_dataset", "to_xarray", "write_dataset"]

OFF = 1e-3  # of the thinnest cell: so far coordinates may lie from where the grid has them, as those in float32 do


def to_xarray(grid, /, *, times=None, attrs=None, at=None, **fields):
    """Fields on a grid -> a Dataset of xarray, with coordinates.

    A variable on cells has the dimensions x, y, z, on nodes x_nodes, y_nodes, z_nodes. A field on faces or edges is a
    variable for each component, u_x on (x_nodes, y, z) and so on; leading axes are u_batch_0 and so on. The widths
    of the cells stand in x_widths and so on.

    Parameters
    ----------
    grid : Grid
    times : array, shape (n,), optional
        Times [time] of a series, the coordinate `time`: then each field has n entries in its first axis.
    attrs : dict, optional
        Units, or a dict of attributes, by the name of a field, "x", "y", "z" or "times":
        ``{"x": "m", "u": {"units": "m/s", "long_name": "speed"}}``.
    at : dict of str, optional
        "cells", "faces", "nodes" or "edges" by the name of a field, where the first that fits is not the one.
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
        If two variables would have one name, or `attrs` or `at` name what is not there.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> to_xarray(Grid((4, 3)), u=np.ones((4, 3)), wind=np.zeros(31)).wind_y.dims
    ('x', 'y_nodes')
    """
    check_grid("to_xarray", grid)
    return dataset_of("to_xarray", grid, attrs, *check_fields("to_xarray", grid, times, at, fields))


def from_xarray(grid, array, /):
    """DataArray of xarray -> an array on the cells of a grid: its dimensions are found by name and put in order.

    Parameters
    ----------
    grid : Grid
    array : xarray.DataArray
        With the dimensions x, y, z of the grid. Where these have coordinates, they are the centres of its cells, to
        0.1 % of the thinnest one. Other dimensions come first, as a batch, and have no coordinates.

    Returns
    -------
    array, shape (..., *grid.shape)
        A copy.

    Raises
    ------
    TypeError
        If `array` is no DataArray.
    ShapeError
        If it has other places along an axis than the grid.
    ValueError
        If a dimension is missing, or there are coordinates that would be lost.

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
        centres, reach = grid.coordinates(number), OFF * np.min(grid.widths[number], initial=np.inf)
        places = array[axis].values if axis in array.coords else centres
        if array.sizes[axis] != centres.size or not np.allclose(places, centres, rtol=0, atol=reach):
            raise ShapeError(
                f"from_xarray takes {axis} at the {centres.size} centres of {grid}, got {array.sizes[axis]} from "
                f"{places[:1]} to {places[-1:]}; write another Grid, or u.sortby({axis!r})"
            )
    return np.array(array.transpose(..., *grid.axes).values)


def dataset_of(name, grid, attrs, times, content):
    """What `check_fields` let through -> Dataset."""
    check_names(name, "attrs", attrs, [*content, *grid.axes, "times"])
    for key, one in (attrs or {}).items():
        if not isinstance(one, str) and not (isinstance(one, dict) and all(map(_is_attribute, one, one.values()))):
            raise TypeError(
                f"{name} takes units as a str, or a dict of str, numbers and arrays, in attrs, got {one!r} for {key}; "
                f"write {{{key!r}: 'm'}}"
            )
    given = {key: {"units": one} if isinstance(one, str) else one for key, one in (attrs or {}).items()}
    coords, variables = {}, {}
    for number, axis in enumerate(grid.axes):
        coords[axis] = axis, grid.coordinates(number), given.get(axis)
        coords[f"{axis}_nodes"] = f"{axis}_nodes", grid.coordinates(number, "nodes"), given.get(axis)
        variables[f"{axis}_widths"] = axis, grid.widths[number], given.get(axis)
    if times is not None:
        coords["time"] = "time", times, given.get("times")
    notes = {"format": KIND, "origin": grid.origin, "periodic": grid.periodic, "fields": {}}
    series = [] if times is None else ["time"]
    for field, (space, values) in content.items():
        lead = values.shape[: values.ndim - len(space.shape)]
        batch = series + [f"{field}_batch_{n}" for n in range(len(lead) - len(series))]
        flat = np.split(values.reshape(*lead, space.size), space.offsets[1:-1], axis=-1)
        labels = [f"{field}_{axis}" for axis in grid.axes] if space.kind in ("faces", "edges") else [field]
        for number, (label, part) in enumerate(zip(labels, flat)):
            if label in {*variables, *coords}:
                raise ValueError(f"{name} would store {field} as {label}, which is there; write another name")
            on_nodes = node_axes(space.kind, number, grid.dim) or ()
            places = [f"{axis}_nodes" if n in on_nodes else axis for n, axis in enumerate(grid.axes)]
            variables[label] = batch + places, part.reshape(*lead, *space.parts[number]), given.get(field)
        notes["fields"][field] = space.kind, labels
    return xarray.Dataset(variables, coords, {"sparsedp": json.dumps(notes)})


def _is_attribute(key, value):
    entries = value if isinstance(value, (list, tuple)) else [value]
    numbers = all(
        isinstance(x, (np.ndarray, np.generic, int, float))
        and np.asarray(x).dtype.kind in "iuf"
        and (x is value or np.ndim(x) == 0)
        for x in entries
    )
    return isinstance(key, str) and key != "" and (isinstance(value, str) or numbers)


def write_dataset(path, dataset):
    """Dataset -> a .nc file or a .zarr folder that is whole, with a checksum of all it holds."""
    dataset.attrs["sparsedp_crc32"] = _checksum(dataset)
    if _is_zarr(path):  # there -0.0 counts as empty, and so does a NaN with other bits
        options = {"zarr_format": 2, "consolidated": True, "write_empty_chunks": True}
        write_through(path, lambda part: dataset.to_zarr(part, **options))
    else:
        import h5netcdf

        memory = io.BytesIO()  # HDF5 that finds no room on a disk ends the process, after the error
        with h5netcdf.File(memory, "w") as file:
            dataset.dump_to_store(xarray.backends.H5NetCDFStore(file))
        write_file(path, memory.getbuffer())


def _is_zarr(path):
    return Path(path).suffix.lower() == ".zarr"


def read_dataset(path):
    """File that `write_dataset` wrote -> (what `save` puts into .npz,); None when it is another file, or changed."""
    with path_errors(path, reading=True):  # what is not there or may not be read is not damaged
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
    except Exception:  # there is no end to what the readers raise on damage
        return None
    fields = {field: _joined(dataset, *stored) for field, stored in notes.pop("fields").items()}
    widths = [dataset[f"{axis}_widths"].values for axis, _ in zip(AXES, notes["origin"])]
    times = dataset["time"].values if "time" in dataset.dims else None
    grid = {"shape": tuple(map(len, widths)), "spacing": widths, **notes}
    return ({"grid": grid, "times": times, "fields": fields},)


def _joined(dataset, kind, labels):
    """Variables of a field -> the field."""
    parts = [dataset[label].values for label in labels]
    if kind in ("cells", "nodes"):
        return parts[0]
    lead = parts[0].ndim - len(labels)  # there is a component for each axis of the grid
    return np.concatenate([part.reshape(*part.shape[:lead], prod(part.shape[lead:])) for part in parts], axis=-1)


def _checksum(dataset):
    total = crc32(dataset.attrs["sparsedp"].encode())
    for name in sorted(dataset.variables):
        values = dataset[name].values
        total = crc32(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).data, total)
    return total
