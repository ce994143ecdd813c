"""Check the fields that are to be saved, and find the space of the grid on which each of them lives."""

from __future__ import annotations

from typing import Any

import numpy as np

from sparsedp._utils.validation import check_plain
from sparsedp.errors import ShapeError
from sparsedp.grid.grid import Grid

__all__ = ["KIND", "EXTRA_TYPE_CODES", "REAL", "check_fields", "check_names"]

KIND = "sparsedp fields 1"
REAL = "bBhHiIlLqQfd"  # type codes of the dtypes that all formats store
EXTRA_TYPE_CODES = "?FD"  # type codes of the dtypes that .nc and .zarr files also store


def check_fields(
    name: str, grid: Grid, times: Any, at: dict[str, str] | None, fields: dict[str, Any], dtypes: str | None = None
) -> tuple[Any, dict[str, Any]]:
    """Check the arguments of `save` and return them as arrays.

    Parameters
    ----------
    name : str
        Name of the calling function, for error messages.
    grid, times, at, fields
        See `save`.
    dtypes : str, optional
        Type codes of the allowed dtypes. Default: all numeric dtypes.

    Returns
    -------
    times : array or None
    content : dict
        The pair (space, array) of each field, by name.
    """
    check_names(name, "at", at, fields)
    if times is not None:
        times = _numbers(name, "times", times, dtypes)
        if times.ndim != 1:
            raise ShapeError(f"{name} takes times of shape (n,), got {times.shape}; write np.atleast_1d(times)")
    content = {}
    for field, value in fields.items():
        if dtypes and not field.isidentifier():
            raise ValueError(f"{name} takes Python identifiers as names of fields, got {field!r}; write another name")
        numbers = _numbers(name, field, value, dtypes)
        content[field] = _space(field, grid, numbers, times, at or {}), numbers
    return times, content


def check_names(name: str, argument: str, entries: Any, valid: Any) -> None:
    """Raise ValueError if an argument is not a dict, or has a key that is not in `valid`. None is allowed."""
    unknown = entries
    if isinstance(entries or {}, dict):
        unknown = sorted(set(entries or ()) - set(valid), key=str)
    if unknown:
        raise ValueError(f"{name} takes {argument} as a dict with keys from {[*valid]}, got {unknown}; leave them out")


def _numbers(name, field, value, dtypes):
    """Return a field as an array; raise TypeError if it is not an array of numbers with an allowed dtype."""
    check_plain(name, value)
    numbers = None
    if isinstance(value, (np.ndarray, np.generic, float, int, list, tuple)):
        numbers = np.asarray(value)
    if numbers is None or numbers.dtype.kind not in "biufc":
        raise TypeError(
            f"{name} takes arrays of numbers, {field} is of type {type(value).__name__}; "
            f"write np.asarray({field}), or dp.gather({field}) for a distributed field"
        )
    if dtypes and numbers.dtype.char not in dtypes:
        instead = f"{field}.astype(float)"
        if numbers.dtype.kind == "c":
            instead = f"{field}.real and {field}.imag"
        raise TypeError(f"{field} has dtype {numbers.dtype}, which such a file does not hold; write {instead}")
    if dtypes:
        return numbers.astype(numbers.dtype.name)  # native byte order
    return numbers


def _space(field, grid, numbers, times, at):
    """Return the first space whose shape matches the last axes of an array, or the space that `at` names."""
    shape = numbers.shape
    if times is not None:
        if shape[:1] != times.shape:
            raise ShapeError(f"{field} has shape {shape}, and there are {times.size} times; write np.stack(states)")
        shape = shape[1:]
    for space in (grid.cells, grid.faces, grid.nodes, grid.edges):
        lead = max(len(shape) - len(space.shape), 0)
        if at.get(field, space.kind) == space.kind and shape[lead:] == space.shape:
            return space
    raise ShapeError(
        f"{field} has shape {numbers.shape}, which is no field on {at.get(field, 'cells, faces, nodes or edges')} of "
        f"{grid}; those on cells have {grid.shape}"
    )
