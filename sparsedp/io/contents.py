"""What a file of fields may hold: arrays of numbers, each on a space of the grid."""

import numpy as np

from sparsedp._utils.validation import check_plain
from sparsedp.errors import ShapeError

__all__ = ["KIND", "OTHERS", "REAL", "check_fields", "check_names"]

KIND = "sparsedp fields 1"
REAL, OTHERS = "bBhHiIlLqQfd", "?FD"  # letters of dtypes: what all formats hold, and what not all do


def check_fields(name, grid, times, at, fields, dtypes=None):
    """Arguments of `save` -> times as an array, or None; and the space and the array of each field, by its name.

    dtypes: the letters of those that are allowed; None: all numbers.
    """
    check_names(name, "at", at, fields)
    if times is not None:
        times = _numbers(name, "times", times, dtypes)
        if times.ndim != 1:
            raise ShapeError(f"{name} takes times of shape (n,), got {times.shape}; write np.atleast_1d(times)")
    content = {}
    for field, value in fields.items():
        if dtypes and not field.isidentifier():
            raise ValueError(f"{name} takes names of fields as Python has them, got {field!r}; write another name")
        numbers = _numbers(name, field, value, dtypes)
        content[field] = _space(field, grid, numbers, times, at or {}), numbers
    return times, content


def check_names(name, argument, given, known):
    """Refuse what is no dict, or one with other keys than some names."""
    unknown = sorted(set(given or ()) - set(known), key=str) if isinstance(given or {}, dict) else given
    if unknown:
        raise ValueError(f"{name} takes {argument} as a dict with keys from {[*known]}, got {unknown}; leave them out")


def _numbers(name, field, value, dtypes):
    check_plain(name, value)
    numbers = np.asarray(value) if isinstance(value, (np.ndarray, np.generic, float, int, list, tuple)) else None
    if numbers is None or numbers.dtype.kind not in "biufc":
        raise TypeError(
            f"{name} takes arrays of numbers, {field} is of type {type(value).__name__}; "
            f"write np.asarray({field}), or dp.gather({field}) on ranks"
        )
    if dtypes and numbers.dtype.char not in dtypes:
        instead = f"{field}.real and {field}.imag" if numbers.dtype.kind == "c" else f"{field}.astype(float)"
        raise TypeError(f"{field} has dtype {numbers.dtype}, which such a file does not hold; write {instead}")
    return numbers.astype(numbers.dtype.name) if dtypes else numbers  # bytes in the order of this machine


def _space(field, grid, numbers, times, at):
    """The first space that holds an array, leading axes left out, or the one that `at` names."""
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
